"""The fast linear solver: iterations that do not grow with the grid, steps equal to the direct."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.direct import DirectSolver
from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.krylov import MultigridSolver, gmres
from optical_palpation.mechanics.newton import balance
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.system import assemble


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


@pytest.mark.parametrize("blown_up", [0.0, 1e4, 1e5])
def test_a_mode_blown_up_does_not_hinder_the_others(blown_up):
    rng = np.random.default_rng(0)
    eigenvalues = np.linspace(1, 2, 2000, dtype=np.float32)
    into, out_of = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 2000), np.float32))
    rhs = rng.standard_normal(2000, np.float32)

    def operator(v):
        return eigenvalues * v + np.float32(blown_up) * np.dot(out_of, v) * into

    solution, iterations = gmres(operator, lambda v: v, rhs, 1e-3, 10)
    assert iterations <= 7
    assert np.linalg.norm(operator(solution) - rhs) < 1.5e-3 * np.linalg.norm(rhs)
