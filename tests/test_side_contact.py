"""Free sides roll onto window and imprint: their contact, its tangent, and what is remembered."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dense_stiffness import product
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import make_solver, prolong, solve
from optical_palpation.mechanics.contact import slip_coordinate
from optical_palpation.mechanics.friction import (
    MEMORY,
    friction_direction,
    held_fast,
    look_ahead,
    remembered,
)
from optical_palpation.mechanics.grid import LayerGrid, face_and_sides, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import TOLERANCES, relaxed
from optical_palpation.mechanics.newton import LoadedLayer, balance, equilibrate
from optical_palpation.mechanics.path import Path, StepControl
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.side_contact import side_contact
from optical_palpation.palpation.meshing import expected_forces

LAW = MooneyRivlin(2.23, 0.703)


def layer(x, y, depth, friction=(0.3, 0.2), loaded=0.3, **options) -> LayerProblem:
    px = np.linspace(-1, 3, 41)
    relief = loaded + 0.02 * np.cos(2 * px) * np.cos(px)[:, None]
    flat = np.full((41, 41), 0.5)
    grid = LayerGrid(x, y, depth, np.full((y.size, x.size), 0.5))
    return LayerProblem(grid, Imprint(px, px, flat, relief), LAW, friction, **options)


@pytest.fixture
def rolled():
    """A layer whose sides have sunk into window and imprint here and there."""
    problem = layer(np.linspace(0, 1, 4), np.linspace(0, 0.8, 3), np.linspace(0, 1, 4))
    rng = np.random.default_rng(3)
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    state.u = rng.normal(0, 0.05, state.u.shape)
    state.u[2] -= 0.3 * problem.grid.nodes[2] + 0.02
    state.slip = rng.normal(0, 1.0, state.slip.shape)
    state.anchor = state.lateral() - rng.normal(0, 1e-3, state.anchor.shape)
    return problem, state


def pressed(problem, state):
    _, w = face_and_sides(slip_coordinate(problem, state), problem.grid.node_shape[1:])
    return side_contact(problem, state, w)


def test_the_stiffness_is_the_derivative_of_the_forces(rolled):
    problem, state = rolled
    shape = problem.grid.node_shape
    contact = pressed(problem, state)
    assert (contact.normal_force > 0).any(1).all()
    rng = np.random.default_rng(5)
    step = rng.normal(0, 1, state.u.shape)
    expected = np.zeros(state.u.shape)
    expected[:, *contact.nodes] = (
        pressed(problem, replace(state, u=state.u + 1e-7 * step)).force
        - pressed(problem, replace(state, u=state.u - 1e-7 * step)).force
    ) / 2e-7
    at_rest = contact.friction(np.zeros(state.u.shape), np.ones(shape))
    tangent = contact.tangent(at_rest)
    found = product(tangent, step)
    assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_a_glued_face_has_no_friction_for_the_sides(rolled):
    problem, state = rolled
    slippery = pressed(replace(problem, friction=(0.0, 0.0)), state)
    glued = pressed(replace(problem, friction=(0.3, 0.2), glued=(True, True)), state)
    # the imprint pushes sideways where it is inclined, the window never
    window_only = slippery.normal_force[1] == 0
    assert window_only.any()
    assert_allclose(glued.force[:2, window_only], 0.0, atol=1e-12)


def test_what_presses_the_sides_is_seen_by_both_ends():
    """All of the force at the window arrives at the imprint, the sides' included."""
    x = node_positions(1.6, 0.2, edge=0.06)
    problem = layer(x, x, np.linspace(0, 1, 5), loaded=0.27)
    solution = solve(problem, lambda level: expected_forces(level, LAW))
    sides = side_contact(solution.problem, solution.state).normal_force.sum(1)
    window, sample = solution.state.normal_force.sum((1, 2)) + sides
    assert sides.max() > 1e-3 * window
    assert_allclose(window, sample, rtol=1e-4)


@pytest.mark.parametrize("size", [0.3, 2.0, 40.0])
def test_law_of_friction(size):
    rng = np.random.default_rng(1)
    angle = rng.uniform(0, 2 * np.pi, 5)
    w = size * np.stack([np.cos(angle), np.sin(angle)])[None]
    s = friction_direction(w)
    assert (np.hypot(s[:, 0], s[:, 1]) < 1).all()
    ahead = look_ahead(w, np.zeros(w.shape), np.full((1, 5), 0.02), np.full((1, 5), 0.3))
    dw = 1e-6 * rng.normal(0, 1, w.shape)
    change = friction_direction(w + dw) - friction_direction(w - dw)
    # in equilibrium the law is linearised where it is
    assert_allclose(change, 2 * along(ahead.slope, dw), atol=1e-11)
    assert_allclose(ahead.direction, s, atol=1e-6)
    assert_allclose(ahead.change, 0.0, atol=1e-6)


def along(slope, dw):
    xx, xy, yy = np.moveaxis(slope, 1, 0)
    return np.stack([xx * dw[:, 0] + xy * dw[:, 1], xy * dw[:, 0] + yy * dw[:, 1]], 1)


@pytest.mark.parametrize("bound", [0.0, 0.01, 1.0])
def test_a_node_on_a_spring_comes_to_rest_in_one_step(bound):
    """Whether it sticks or slides, and however it did before."""
    rng = np.random.default_rng(4)
    w = rng.normal(0, 1, (2, 2, 300)) * 10 ** rng.uniform(-2, 2, (2, 1, 300))
    pull = rng.normal(0, 1, w.shape) * 10 ** rng.uniform(-2, 2, (2, 1, 300)) * max(bound, 0.01)
    spring, bound = 0.02, np.full((2, 300), bound)

    def residual(w):
        return spring * w + bound[:, None] * friction_direction(w) - pull

    ahead = look_ahead(w, residual(w), np.array(spring), bound)
    xx, xy, yy = np.moveaxis(
        spring * np.array([1.0, 0, 1.0])[:, None] + bound[:, None] * ahead.slope, 1, 0
    )
    rx, ry = np.moveaxis(residual(w) + bound[:, None] * ahead.change, 1, 0)
    step = -np.stack([yy * rx - xy * ry, xx * ry - xy * rx], 1) / (xx * yy - xy**2)[:, None]
    assert_allclose(residual(w + step), 0.0, atol=2e-5 * np.abs(pull).max())


@pytest.mark.parametrize("hardness", [1.0, 1e3, 1e6])
def test_what_is_in_equilibrium_stays_where_it_is(hardness):
    """However hard the law is beside the body: no step begins with a change of friction."""
    w = np.geomspace(1e-3, 1e3, 200) * np.array([0.6, -0.8])[:, None]
    ahead = look_ahead(
        w[None], np.zeros((1, *w.shape)), np.ones((1, 200)), np.full((1, 200), hardness)
    )
    assert np.abs(ahead.change).max() < 1e-8
    assert_allclose(ahead.direction, friction_direction(w[None]), atol=1e-8)


def test_the_merit_is_less_than_what_is_out_of_balance_by_no_more_than_friction():
    problem = layer(np.linspace(0, 1, 9), np.linspace(0, 0.8, 7), np.linspace(0, 1, 4))
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    state.u[2] = -0.4 * problem.grid.nodes[2]
    state.u[0] = 0.05 * problem.grid.nodes[0]
    state.normal_force += 0.1
    now = balance(problem, state)
    friction = np.hypot(np.linalg.norm(now.friction.turned), np.linalg.norm(now.contact.carried))
    assert now.merit < 0.99 * now.imbalance
    assert now.imbalance < now.merit + friction


def test_what_is_remembered_of_slip():
    far = remembered(np.array([[[300.0], [400.0]]]))
    assert_allclose(np.hypot(*far[0]), MEMORY)
    assert np.hypot(*friction_direction(far)[0]) > 0.9995
    near = np.array([[[0.3], [0.4]]])
    assert_allclose(remembered(near), near)
    # a node that slides goes on sliding on other elements, one that sticks does not begin to
    assert_allclose(held_fast(near), near)
    assert np.hypot(*held_fast(far)[0]) > 10 * MEMORY


def test_fields_of_the_sides_are_interpolated():
    def grid(nx, ny, nz):
        depth = np.linspace(0, 1, nz) ** 1.2
        return LayerGrid(
            np.linspace(0, 1, nx), np.linspace(0, 2, ny) ** 0.9, depth, np.ones((ny, nx))
        )

    def field(of):
        _, y, x = (n[of.side_nodes] for n in of.nodes[::-1])
        z = of.nodes[2][of.side_nodes]
        return np.stack([x + 2 * y - z, 3 - z * (x + y)])

    coarse, fine = grid(4, 5, 3), grid(9, 7, 6)
    exact = field(fine)[0]
    assert_allclose(fine.interpolate_sides_from(coarse, field(coarse))[0], exact, atol=1e-12)
    assert_allclose(fine.interpolate_sides_from(fine, field(fine)), field(fine), atol=1e-12)


def waves_under_a_flat_layer() -> LayerProblem:
    x = node_positions(3.0, 0.1, edge=0.04)
    px = np.linspace(-1, 4, 201)
    flat = np.full((201, 201), 0.5)
    waves = 0.42 + 0.05 * np.cos(3 * px) * np.cos(2.5 * px)[:, None]
    grid = LayerGrid(x, x, np.linspace(0, 1, 5), np.full((x.size, x.size), 0.5))
    return LayerProblem(grid, Imprint(px, px, flat, waves), LAW, (0.3, 0.1))


@pytest.mark.parametrize("longest", [0.3, 0.05])
def test_the_history_of_friction_survives_a_finer_grid(longest):
    """The load followed on a coarse grid ends with the force of one followed on the fine grid."""
    problem = waves_under_a_flat_layer()
    control = StepControl(first=min(0.1, longest), largest=longest)
    forces = []
    for cascade in (False, True):
        found = solve(
            problem, lambda level: expected_forces(level, LAW), cascade=cascade, control=control
        )
        forces.append(found.state.normal_force[1].sum())
        assert (found.coarser is not None) is cascade
    assert_allclose(forces[1], forces[0], rtol=6e-3)


def test_the_history_of_friction_survives_drag():
    """Carried to a finer grid, a layer comes to the same rest by drag as by Newton's method."""
    problem = waves_under_a_flat_layer()
    found = solve(problem, lambda level: expected_forces(level, LAW))
    assert found.coarser is not None
    coarse, state = found.coarser
    solver = make_solver(problem, "multigrid")
    carried = prolong(state, coarse, problem)
    by_newton = equilibrate(problem, carried, solver, TOLERANCES)[0].state
    # as far from equilibrium as where Newton's method does not get there by itself
    k, j, i = np.indices(problem.grid.node_shape)
    carried.u[:, 1:-1] += 0.003 * np.sin(1.3 * k + 0.7 * j + 0.4 * i)[1:-1]
    path = Path(LoadedLayer(problem, solver), TOLERANCES, relaxed(TOLERANCES, 100.0), carried)
    path.settle()
    assert path.record
    assert balance(problem, path.state).force_error < TOLERANCES.force
    assert_allclose(
        path.state.normal_force.sum((1, 2)), by_newton.normal_force.sum((1, 2)), rtol=3e-3
    )
