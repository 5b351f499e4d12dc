"""The linear solvers, and Newton's method: iterations, steps equal to the direct, giving up."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse.linalg import splu

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.direct import DirectSolver, factors_of, sparse_matrix
from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import (
    TOLERANCES,
    Direction,
    NotConverged,
    Tolerances,
    iterate,
    softness,
)
from optical_palpation.mechanics.krylov import MultigridSolver, gmres
from optical_palpation.mechanics.newton import balance, equilibrate, equilibrate_by
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.system import RightHandSide, assemble, with_prescribed


def pressed(n: int, depth: int, edges: str = "free") -> tuple[LayerProblem, LayerState]:
    """Layer in full contact that has not yet answered to a rippled imprint."""
    x, px = np.linspace(0, 2, n + 1), np.linspace(0, 2, 41)
    ripple = 0.01 * np.cos(4 * px) * np.cos(5 * px)[:, None]
    flat = np.full((41, 41), 0.4)
    grid = LayerGrid(x, x, graded_depths(depth), np.full((n + 1, n + 1), 0.4))
    imprint = Imprint(px, px, flat, flat - 0.03 + ripple)
    problem = LayerProblem(grid, imprint, MooneyRivlin(2.23, 0.703), (0.2, 0.1), edges=edges)
    state = LayerState.unloaded(grid)
    state.load = 1.0
    state.normal_force[:] = 2.0 * grid.surface_areas(grid.nodes[:, -1])
    return problem, state


def out_of_balance(problem, state, solver):
    now = balance(problem, state)
    return assemble(problem, now, solver).right_hand_side(problem, now)


@pytest.mark.parametrize("edges", ["free", "roller"])
def test_iterations_do_not_grow_with_the_grid(edges):
    """Pressures that alternate from element to element are part of a random volume residual."""
    counts = []
    for n in (10, 20, 40):
        problem, state = pressed(n, n // 5, edges)
        solver = MultigridSolver(
            problem.grid, problem.shear_modulus, free_sides=problem.edges == "free"
        )
        rhs = out_of_balance(problem, state, solver)
        noise = np.random.default_rng(0).standard_normal(problem.grid.shape)
        rhs.displacement[:] = 0.0
        rhs.volume = 1e-4 * solver.volume * noise
        counts.append(solver.solve(rhs, 1e-3)[2])
    assert max(counts) <= 12, counts


def test_newton_step_equals_the_direct_one():
    problem, state = pressed(15, 3)
    steps = []
    for solver in (
        MultigridSolver(problem.grid, problem.shear_modulus, free_sides=True),
        DirectSolver(problem.grid.node_shape, problem.bulk_modulus),
    ):
        steps.append(solver.solve(out_of_balance(problem, state, solver), 1e-6)[:2])
    for fast, exact in zip(*steps, strict=True):
        assert_allclose(fast, exact, atol=2e-3 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("bulk_to_shear", "attempts"), [(1e2, (8, 0)), (1e4, (8, 0)), (1e8, (4, 8))]
)
def test_direct_step_is_that_of_double_precision(monkeypatch, bulk_to_shear, attempts):
    """Single precision is tried more and more rarely where it loses the shear modulus."""
    problem, state = pressed(8, 3)
    problem = replace(problem, law=MooneyRivlin(2.23, 0.703, bulk_to_shear))
    solver = DirectSolver(problem.grid.node_shape, problem.bulk_modulus)
    rhs = out_of_balance(problem, state, solver)
    matrix = sparse_matrix(solver.system.stencil, solver.system.free)
    found = splu(matrix.tocsc()).solve(rhs.displacement.astype(float).ravel())
    expected = with_prescribed(found.reshape(rhs.displacement.shape), rhs.prescribed)
    tried = []

    def factors(matrix, shape, dtype=np.float64):
        tried.append(dtype)
        return factors_of(matrix, shape, dtype)

    monkeypatch.setattr("optical_palpation.mechanics.direct.factors_of", factors)
    for _ in range(8):
        error = np.linalg.norm(solver.solve(rhs, 0.0)[0] - expected)
        assert error < 1e-5 * np.linalg.norm(expected)
    assert (tried.count(np.float32), tried.count(np.float64)) == attempts


def test_direct_step_of_a_layer_in_equilibrium_is_none():
    problem, state = pressed(8, 3)
    solver = DirectSolver(problem.grid.node_shape, problem.bulk_modulus)
    rhs = out_of_balance(problem, state, solver)
    rhs.displacement[:] = 0.0
    rhs.prescribed[:] = 0.0
    assert not solver.solve(rhs, 0.0)[0].any()


def test_what_stiff_contact_takes_up_does_not_drown_the_forces_in_the_body():
    problem, state = pressed(12, 3, "roller")  # no rigid motions
    steps = []
    for solver in (
        MultigridSolver(problem.grid, problem.shear_modulus, free_sides=False),
        DirectSolver(problem.grid.node_shape, problem.bulk_modulus),
    ):
        now = balance(problem, state)
        now.contact.rigid[:] = False
        now.contact.spring[:] = 1e5 * problem.shear_modulus * problem.grid.areas
        system = assemble(problem, now, solver)
        rng = np.random.default_rng(0)
        force = rng.standard_normal(system.free.shape)
        force[2, [0, -1]] *= 1e4
        force[:2, [0, -1]] = 0.0
        rhs = RightHandSide(
            system.free * force, np.zeros_like(system.volume), np.zeros((2, 3, 1, 1))
        )
        steps.append(solver.solve(rhs, 1e-2)[0])
    fast, exact = steps
    assert np.linalg.norm(fast - exact) < 0.05 * np.linalg.norm(exact)


def test_pressures_of_a_damped_step_stay_small():
    problem, state = pressed(8, 3)
    solver = DirectSolver(problem.grid.node_shape, problem.bulk_modulus)
    state = equilibrate(problem, state, solver, TOLERANCES)[0].state
    state.u[:, 1:-1] += 1e-3 * np.random.default_rng(0).standard_normal(state.u[:, 1:-1].shape)
    now = balance(problem, state)
    mu, height = problem.shear_modulus, 0.4

    def step(damping, soften=True):
        stiffness = mu / height**2
        soft = softness(damping * stiffness, stiffness, mu) if soften else 0.0
        system = assemble(problem, now, solver, damping * stiffness, soft)
        du, dp, _ = solver.solve(system.right_hand_side(problem, now), 0.0)
        return np.linalg.norm(du), np.linalg.norm(system.pressure_force(dp))

    moved, pushed = step(0.0)
    moved_damped, pushed_damped = step(1e6)
    assert moved_damped < 1e-3 * moved
    assert pushed_damped < 0.1 * pushed
    # all of the volume put right, whatever resists it
    assert step(1e6, soften=False)[1] > 10 * pushed


@pytest.mark.parametrize("blown_up", [0.0, 1e4, 1e5])
def test_a_mode_blown_up_does_not_hinder_the_others(blown_up):
    rng = np.random.default_rng(0)
    eigenvalues = np.linspace(1, 2, 2000, dtype=np.float32)
    into, out_of = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 2000), np.float32))
    rhs = rng.standard_normal(2000, np.float32)

    def operator(v, out):
        out[:] = eigenvalues * v + np.float32(blown_up) * np.dot(out_of, v) * into

    def precondition(v, out):
        out[:] = v

    solution, iterations = gmres(operator, precondition, rhs, 1e-3, 10)
    assert iterations <= 7
    product = np.empty_like(rhs)
    operator(solution, product)
    assert np.linalg.norm(product - rhs) < 1.5e-3 * np.linalg.norm(rhs)


@pytest.mark.parametrize(("step", "arrives"), [(1e-4, True), (0.2, False)])
def test_the_tangent_of_a_neighbour_leads_to_equilibrium_from_near_by_alone(step, arrives):
    problem, state = pressed(10, 2)
    solver = MultigridSolver(problem.grid, problem.shear_modulus, free_sides=True)
    now, _ = equilibrate(problem, state, solver, TOLERANCES)
    system = assemble(problem, now, solver)
    moved = Imprint(
        problem.imprint.x,
        problem.imprint.y,
        problem.imprint.unloaded,
        problem.imprint.loaded - step * 0.4,
    )
    neighbour = replace(problem, imprint=moved)
    wanted = Tolerances(force=1e-4, volume=1e-5)
    found = equilibrate_by(system, neighbour, now.state, solver, wanted)
    assert (found is not None) == arrives
    if found is not None:
        assert balance(neighbour, now.state).force_error > 2e-4
        assert balance(neighbour, found).force_error < 1e-4


@dataclass
class Point:
    """An iterate of which nothing counts but its error."""

    force_error: float
    volume_error: float = 0.0
    min_jacobian: float = 1.0

    @property
    def imbalance(self):
        return self.force_error

    @property
    def volume_distance(self):
        return self.volume_error

    merit = distance = imbalance


@dataclass
class Snaps(Point):
    """An iterate of which a node that snaps has nearly all that is out of balance."""

    distance: float = 0.0

    @property
    def merit(self):
        return self.distance


def test_an_error_that_does_not_fall_is_not_waited_for():
    seen = []

    def linearise(now, damping):
        return Direction(lambda fraction: Point(0.95 * now.force_error), 3)

    with pytest.raises(NotConverged, match="stagnates"):
        iterate(Point(1.0), linearise, Tolerances(patience=4), 1.0, lambda n, *_: seen.append(n))
    assert seen[-1] == 4


@pytest.mark.parametrize(
    ("patience", "last"),
    [({}, 4), ({"patience": 5}, 2), ({"patience": 5, "lingers": 1}, 1)],
)
def test_an_iterate_that_will_do_is_soon_content(patience, last):
    seen = []

    def linearise(now, damping):
        return Direction(lambda fraction: Point(0.95 * now.force_error), 3)

    wanted = Tolerances(force=1e-6, nearly=1e-4, **patience)
    with pytest.raises(NotConverged, match="stagnates") as failure:
        iterate(Point(9e-5), linearise, wanted, 1.0, lambda n, *_: seen.append(n))
    assert seen[-1] == last
    assert failure.value.nearest[0].force_error < 9e-5


def test_equilibrium_is_equilibrium_however_slowly_it_was_reached():
    def linearise(now, damping):
        return Direction(lambda fraction: Point(0.9 * now.force_error), 3)

    wanted = Tolerances(force=1e-6, nearly=1e-4, lingers=1, patience=1)
    found, iterations = iterate(Point(1.05e-6), linearise, wanted, 1.0)
    assert found.force_error < wanted.force
    assert iterations == 1


def test_what_snaps_for_ever_does_not_hide_that_all_else_comes_nearer():
    """It is not given up, and what came nearest is not where the node snaps least."""
    distances = iter([1e-2, 3e-3, 1e-3, 3e-4, 9e-5, 8e-5, 8.5e-5, 9e-5, 9e-5])

    def linearise(now, damping):
        after = Snaps(0.95 * now.force_error, distance=next(distances))
        return Direction(lambda fraction: after, 3)

    wanted = Tolerances(force=1e-6, nearly=1e-4, patience=4)
    with pytest.raises(NotConverged, match="stagnates") as failure:
        iterate(Snaps(2e-2, distance=3e-2), linearise, wanted, 1.0)
    nearest, number = failure.value.nearest
    assert (nearest.distance, number) == (8e-5, 6)
