"""Curved sides of elements: what a layer lets through that sticks to both faces."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.cascade import make_solver, solve
from optical_palpation.mechanics.grid import LayerGrid, graded_depths, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.newton import balance
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.side_flow import side_flow
from optical_palpation.mechanics.system import assemble

LAW = MooneyRivlin(2.23, 0.703)
MU = LAW.shear_modulus


def stuck(deep: int, curved: bool, strain: float = 0.01, width: float = 0.3) -> LayerProblem:
    """A flat layer, 6 times as wide as it is thick, held by friction on both faces."""
    x = node_positions(3.0, width, edge=0.1)
    pixels, flat = np.linspace(-1, 4, 9), np.full((9, 9), 0.5)
    grid = LayerGrid(x, x, graded_depths(deep), np.full((len(x), len(x)), 0.5))
    imprint = Imprint(pixels, pixels, flat, (1 - strain) * flat)
    return LayerProblem(grid, imprint, LAW, (2.0, 2.0), curved_sides=curved)


def force(problem: LayerProblem, **options) -> float:
    def guess(level: LayerProblem) -> np.ndarray:
        return 0.2 * MU * level.grid.surface_areas(level.grid.nodes[:, -1])

    return float(solve(problem, guess, **options).state.normal_force[1].sum())


def test_half_the_elements_through_the_depth_carry_the_same_error():
    straight = {deep: force(stuck(deep, False)) for deep in (2, 4, 8)}
    curved = {deep: force(stuck(deep, True)) for deep in (2, 4, 8)}
    # straight sides err by 1 / (n^2 - 1), and the two agree in the limit
    limit = straight[8] + (straight[8] - straight[4]) / 3
    assert curved[8] == pytest.approx(limit, rel=0.01)
    for deep in (2, 4):
        assert straight[deep] > limit * (1 + 0.8 / (deep**2 - 1))
        assert abs(curved[deep] - limit) < 0.5 * abs(straight[deep] - limit)


def test_the_term_vanishes_with_the_square_of_the_height():
    gains = [force(stuck(d, False)) - force(stuck(d, True)) for d in (4, 8)]
    assert 3.0 < gains[0] / gains[1] < 5.0


def test_multigrid_agrees_with_direct_on_a_deformed_layer():
    problem = stuck(3, True, 0.1)
    forces = [force(problem, solver=name) for name in ("multigrid", "direct")]
    assert forces[0] == pytest.approx(forces[1], rel=1e-4)


def test_one_newton_step_is_that_of_the_reference_solver():
    problem = stuck(2, True, 0.05)
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    rng = np.random.default_rng(0)
    state.p = rng.standard_normal(state.p.shape)
    state.normal_force += 0.01
    now = balance(problem, state)
    nothing, bound = np.zeros_like(now.force), np.ones(problem.grid.node_shape)
    sticks = now.contact.friction(problem, nothing, bound)  # such pressures would let it slide
    now = replace(now, friction=sticks)
    steps = []
    for name in ("multigrid", "direct"):
        solver = make_solver(problem, name)
        rhs = assemble(problem, now, solver).right_hand_side(problem, now)
        du, dp, _ = solver.solve(rhs, 1e-6)
        steps.append((du, dp))
    for one, other in zip(*steps, strict=True):
        assert np.linalg.norm(one - other) < 2e-3 * np.linalg.norm(other)  # in single precision


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_flow_by_hand_and_its_symmetry(scale):
    x, y = scale * np.array([0.0, 1.0, 3.0]), scale * np.array([0.0, 2.0])
    grid = LayerGrid(x, y, graded_depths(2), np.full((2, 3), scale))
    stiffness = np.array([2.0, 4.0])[None, None] * np.ones((2, 1, 2))
    body = Body(grid, LAW, stiffness)
    flow = side_flow(body.nodes, np.zeros((3, *grid.node_shape)), body.factor, MU)
    # 0.5 high, 2 wide sides between elements whose centres are 1.5 apart; a volume over a pressure
    area, high = 2 * 0.5, 0.5
    resistance = 12 * MU * area * 0.5 * (1.0 * 2 + 2.0 * 4)
    assert_allclose(flow.x[:, :, 1], scale**3 * area**2 * high**2 / resistance)
    assert not flow.x[:, :, [0, 2]].any()
    assert not flow.y.any()
    p, q = np.random.default_rng(0).standard_normal((2, *grid.shape))
    assert_allclose((q * flow.outflow(p)).sum(), (p * flow.outflow(q)).sum())
    assert_allclose(flow.outflow(p).sum(), 0, atol=1e-12 * scale**3)  # nothing is lost
    assert_allclose(flow.outflow(np.ones(grid.shape)), 0, atol=1e-12 * scale**3)
