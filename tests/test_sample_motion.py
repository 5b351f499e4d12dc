"""An imprint that moves sideways with the sample, against closed forms and the moving sample."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.mechanics.cascade import solve
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.newton import Tolerances, balance
from optical_palpation.mechanics.problem import LayerProblem

C10, C01 = 2.23, 0.703
MU = 2 * (C10 + C01)
WIDTH, THICKNESS, STRETCH = 2.0, 0.5, 0.85
PIXELS = np.linspace(-0.5, 2.5, 31)


def pressed(motion: np.ndarray | None, friction: tuple[float, float]):
    """A flat square pressed to 0.85 of its thickness by an imprint with this motion."""
    x = np.linspace(0, WIDTH, 9)
    flat = np.full((31, 31), THICKNESS)
    problem = LayerProblem(
        LayerGrid(x, x, np.linspace(0, 1, 4), np.full((9, 9), THICKNESS)),
        Imprint(PIXELS, PIXELS, flat, STRETCH * flat, motion),
        C10,
        C01,
        1e4 * MU,
        friction,
    )
    uniform = MU * problem.grid.surface_areas(problem.grid.nodes[:, -1])
    tolerances = Tolerances(force=1e-6, volume=1e-8)
    return solve(problem, lambda _: 0.5 * uniform, solver="direct", tolerances=tolerances)


def spreading(lateral: float) -> np.ndarray:
    """Motion of a surface that is stretched about its centre by this factor."""
    moved = (1 - 1 / lateral) * (PIXELS - 0.5 * WIDTH)
    return np.stack(np.meshgrid(moved, moved))


def test_layer_that_is_carried_as_it_spreads_by_itself_stays_in_uniaxial_compression():
    # incompressible: true stress 2 (C10 + C01 / stretch) (stretch^2 - 1 / stretch) over 1 / stretch
    force = -2 * (C10 + C01 / STRETCH) * (STRETCH**2 - 1 / STRETCH) * WIDTH**2 / STRETCH
    carried = pressed(spreading(STRETCH**-0.5), (0.0, 0.5)).state
    held = pressed(None, (0.0, 0.5)).state
    assert_allclose(carried.normal_force.sum((1, 2)), force, rtol=2e-4)
    assert held.normal_force[1].sum() > 1.3 * force
    shift = carried.lateral()[1, 0, 0] - (STRETCH**-0.5 - 1) * np.linspace(-1, 1, 9)
    assert abs(shift).max() < 1e-4


@pytest.mark.parametrize("way", [(1.0, 0.0), (-0.6, 0.8)])
def test_imprint_that_slides_drags_the_layer_with_the_full_friction(way):
    motion = 0.3 * np.asarray(way)[:, None, None] * np.ones((2, 31, 31))
    solution = pressed(motion, (0.5, 0.1))
    state = solution.state
    drag = balance(solution.problem, state).force[:2, -1].sum((1, 2))  # of the imprint on the layer
    expected = 0.1 * state.normal_force[1].sum() * np.asarray(way)
    # where the rim lifts off, the surface beside it is inclined and takes a little of the drag
    assert_allclose(drag, expected, rtol=0.05, atol=0.01)


def test_points_of_the_imprint_move_straight_and_in_proportion_to_the_load():
    lateral = 1.12
    imprint = Imprint(PIXELS, PIXELS, *np.full((2, 31, 31), THICKNESS), spreading(lateral))
    start = np.array([0.3, 1.0, 1.7])
    for load in (0.0, 0.4, 1.0):
        moved = load * (lateral - 1) * (start - 1.0)
        velocity = imprint.velocity(start + moved, start, load)
        assert_allclose(velocity[0], (lateral - 1) * (start - 1.0), atol=1e-4)
