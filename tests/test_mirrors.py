"""Sides that are planes of symmetry: parts of a layer, and plane strain."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import solve
from optical_palpation.mechanics.grid import LayerGrid, depth_positions, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import Tolerances
from optical_palpation.mechanics.path import StepControl
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem
from optical_palpation.mechanics.side_contact import side_contact
from optical_palpation.palpation.meshing import expected_forces

LAW = MooneyRivlin(2.23, 0.703)


def pressed(x, y, mirrors):
    """A layer 0.5 mm thick under a ripple that is symmetric in x = 0 and y = 0; its sides roll."""
    px = np.linspace(-1.2, 1.2, 97)
    loaded = 0.33 + 0.02 * np.cos(4 * px) * np.cos(3 * px)[:, None]
    flat = np.full((97, 97), 0.5)
    grid = LayerGrid(x, y, depth_positions(0.25, True), np.full((y.size, x.size), 0.5))
    problem = LayerProblem(grid, Imprint(px, px, flat, loaded), LAW, (0.3, 0.2), mirrors=mirrors)
    return solve(
        problem,
        lambda level: expected_forces(level, LAW),
        solver="direct",
        cascade=False,
        tolerances=Tolerances(force=1e-7, volume=1e-9),
        control=StepControl(iterations=np.inf),  # the same load increments in both
    )


def test_nodes_that_turn_round_are_found_at_once():
    """Where friction is not in the way Newton's method converges as it should, at all loads."""
    nodes = node_positions(2.0, 0.25, -1.0, edge=0.08)
    half = nodes[nodes > -1e-9]
    quarter = pressed(half, half, (True, False, True, False))
    assert [count for _, _, count in quarter.record] == pytest.approx([5] * 8, abs=3)


def side_force(solution):
    return side_contact(solution.problem, solution.state).normal_force.sum()


def test_a_quarter_between_planes_of_symmetry_is_that_of_the_whole_layer():
    nodes = node_positions(2.0, 0.25, -1.0, edge=0.08)
    half = nodes[nodes > -1e-9]
    whole = pressed(nodes, nodes, (False,) * 4)
    quarter = pressed(half, half, (True, False, True, False))
    part = np.s_[..., -half.size :, -half.size :]
    scale = np.abs(whole.state.u).max()
    assert_allclose(quarter.state.u, whole.state.u[part], atol=2e-5 * scale)
    # the planes halve the areas of the nodes on them
    share = np.ones((half.size, half.size))
    share[0] *= 0.5
    share[:, 0] *= 0.5
    expected = (share * whole.state.normal_force[part]).sum()
    assert_allclose(quarter.state.normal_force.sum(), expected, rtol=1e-4)
    assert side_force(whole) > 2e-4 * expected
    assert_allclose(4 * side_force(quarter), side_force(whole), rtol=1e-3)


def test_plane_strain_between_two_planes():
    x, y = np.linspace(0, 1, 5), np.linspace(0, 0.5, 3)
    px = np.linspace(-1, 3, 5)
    flat = np.full((5, 5), 0.5)
    grid = LayerGrid(x, y, np.linspace(0, 1, 4), np.full((3, 5), 0.5))
    problem = LayerProblem(
        grid,
        Imprint(px, px, flat, 0.6 * flat),
        replace(LAW, bulk_to_shear=1e6),
        (0.0, 0.0),
        mirrors=(True, True, True, False),
    )
    state = solve(problem, lambda level: 5 * level.grid.areas, solver="direct", cascade=False).state
    # stretches 0.6, 1 and 1 / 0.6: the stress of both invariants is the same in plane strain
    stress = 2 * (LAW.c10 + LAW.c01) * (0.6**-2 - 0.6**2)
    assert_allclose(state.normal_force[SAMPLE].sum(), stress * 0.5 / 0.6, rtol=1e-3)
