"""Faces crease, but do not pass through themselves."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dense_stiffness import product
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import solve
from optical_palpation.mechanics.folds import CREASED, STIFFNESS, folds
from optical_palpation.mechanics.grid import (
    LayerGrid,
    depth_positions,
    edge_width,
    node_positions,
)
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.palpation.meshing import expected_forces

LAW = MooneyRivlin(2.23, 0.703)
THICKNESS = 0.5


def layer(x, y, depth, loaded, friction=(0.3, 0.2), **options) -> LayerProblem:
    """A layer on an imprint of the loaded thickness ``loaded(x, y)``."""
    px = np.linspace(-4, 4, 161)
    flat = np.full((161, 161), THICKNESS)
    imprint = Imprint(px, px, flat, loaded(px, px[:, None]) + 0 * flat)
    grid = LayerGrid(x, y, depth, np.full((y.size, x.size), THICKNESS))
    return LayerProblem(grid, imprint, LAW, friction, **options)


@pytest.fixture
def crumpled():
    """A layer some of whose facets have turned over."""
    x, y = np.linspace(0, 1, 5), np.linspace(0, 0.6, 4)
    problem = layer(x, y, np.linspace(0, 1, 4), lambda x, y: 0.3 + 0.1 * np.sin(3 * x) * np.cos(y))
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    state.u = np.random.default_rng(1).normal(0, 0.1, state.u.shape)
    return problem, state


def forces(problem, state):
    out = np.zeros_like(state.u)
    for face in folds(problem, state):
        face.add_forces(out)
    return out


def energy(problem, state, level):
    """Energy of the facets of the window, with no derivative of it."""
    grid, spring = problem.grid, STIFFNESS * LAW.shear_modulus * THICKNESS * problem.grid.depth[1]
    x, y = grid.x + state.u[0, 0], grid.y[:, None] + state.u[1, 0]
    total = 0.0
    for s, t in np.ndindex(2, 2):
        s, t = (0.5 + (0.5 - q) / np.sqrt(3) for q in (s, t))

        def along(f, s=s, t=t):
            by_x = (1 - t) * np.diff(f[:-1]) + t * np.diff(f[1:])
            by_y = (1 - s) * np.diff(f, axis=0)[:, :-1] + s * np.diff(f, axis=0)[:, 1:]
            return by_x, by_y

        (xs, xt), (ys, yt) = along(x), along(y)
        unloaded = np.outer(np.diff(grid.y), np.diff(grid.x))
        missing = np.maximum(level - (xs * yt - xt * ys) / unloaded, 0.0)
        total += 0.25 * spring * (unloaded * missing**3).sum() / 3
    return total


def test_the_forces_are_the_gradient_of_the_energy(crumpled):
    problem, state = crumpled
    step = np.zeros_like(state.u)
    step[:, 0] = np.random.default_rng(2).normal(0, 1, state.u[:, 0].shape)
    after, before = (
        energy(problem, replace(state, u=state.u + size * step), CREASED) for size in (1e-6, -1e-6)
    )
    assert before > 0
    assert_allclose(np.vdot(forces(problem, state), step), (after - before) / 2e-6, rtol=1e-6)


def test_the_stiffness_is_the_derivative_of_the_forces(crumpled):
    problem, state = crumpled
    step = np.random.default_rng(5).normal(0, 1, state.u.shape)
    after, before = (
        forces(problem, replace(state, u=state.u + size * step)) for size in (1e-7, -1e-7)
    )
    found = sum(product(face, step) for face in folds(problem, state))
    expected = (after - before) / 2e-7
    assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_they_neither_push_nor_turn_the_layer(crumpled):
    problem, state = crumpled
    force = forces(problem, state)
    x, y = (problem.grid.nodes + state.u)[:2]
    assert_allclose(force.sum((1, 2, 3)), 0.0, atol=1e-12 * np.abs(force).max())
    torque = (x * force[1] - y * force[0])[[0, -1]].sum((1, 2))
    assert_allclose(torque, 0.0, atol=1e-12 * np.abs(force).max())


def test_glued_faces_and_those_that_are_not_pushed_together_do_not_resist(crumpled):
    problem, state = crumpled
    assert folds(replace(problem, glued=(True, True)), state) == []
    assert len(folds(replace(problem, glued=(True, False)), state)) == 1
    assert folds(problem, LayerState.unloaded(problem.grid)) == []


@pytest.mark.parametrize(("slope", "resists"), [(0.0, True), (4.0, False)])
def test_a_face_on_a_steep_imprint_is_not_folded(slope, resists):
    """Drawn together to a third, which on a slope of 4 is a stretch of 1.4 along it."""
    x = np.linspace(0, 0.3, 4)
    problem = layer(x, x, np.linspace(0, 1, 4), lambda x, y: 0.3 + slope * x)
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    state.u[0] = -0.66 * x
    state.u[2, -1] = slope * 0.34 * x
    state.u[0, 0] = 0.0
    (found,) = folds(problem, state) or [None]
    assert (found is not None and bool((found.missing > 0).any())) == resists


def test_a_rim_that_slides_and_rolls_does_not_turn_over():
    """In plane strain, on a wedge; without this the corner ends 1.6 widths beyond the next node."""
    size = 0.025
    depth = depth_positions(size / THICKNESS, True)
    x = node_positions(2.0, size, -1.0, edge=edge_width(depth, THICKNESS))
    problem = layer(
        x,
        np.array([0, size]),
        depth,
        lambda x, y: np.minimum(0.65 * THICKNESS + 0.03 * x, 0.6),
        friction=(0.15, 0.05),
        mirrors=(True, True, False, False),
    )
    solution = solve(problem, lambda level: expected_forces(level, LAW))
    u = solution.state.u[0, :, 0]
    stretch = 1 + np.diff(u[[0, -1]]) / np.diff(problem.grid.x)
    assert stretch.min() > 0
    assert solution.newton_iterations < 150
