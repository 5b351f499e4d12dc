"""What resists displacement: the forces, their tangent, and what they mean."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.mechanics.direct import sparse_matrix
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.resistance import Resistance

RNG = np.random.default_rng(4)


def uneven(thickness=0.5):
    x, y = node_positions(2.0, 0.2, edge=0.03), node_positions(1.5, 0.15, edge=0.03)
    relief = thickness * (1 + 0.2 * np.sin(3 * x) * np.cos(2 * y)[:, None])
    return LayerGrid(x, y, np.array([0.0, 0.1, 0.4, 0.8, 1.0]), relief)


def matrix(grid, much):
    nz1, ny1, nx1 = grid.node_shape
    planes = np.zeros((nz1, ny1, 27, 9, nx1))
    held = Resistance(grid)
    for k, plane in enumerate(planes):
        held.add_to(plane, k, much)
    return sparse_matrix(planes, np.ones((3, *grid.node_shape), bool))


def test_the_tangent_is_that_of_the_forces_and_symmetric():
    grid = uneven()
    tangent, u = matrix(grid, 7.0), RNG.normal(size=(3, *grid.node_shape))
    assert_allclose(tangent @ u.ravel(), 7.0 * Resistance(grid).force(u).ravel(), atol=1e-12)
    assert abs(tangent - tangent.T).max() < 1e-15
    assert_allclose(tangent.diagonal(), np.tile(7.0 * Resistance(grid).own.ravel(), 3), rtol=1e-12)


def test_a_rigid_motion_is_held_by_the_volume_alone():
    grid = uneven()
    u = np.ones((3, *grid.node_shape)) * np.array([1.0, -2.0, 0.5])[:, None, None, None]
    assert_allclose(Resistance(grid).force(u), grid.node_volumes * u, rtol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_waves_are_held_by_the_square_of_their_number(axis):
    """V u - r^2 V u'': a wave between mirrors is an eigenfunction, of 1 + (r k)^2."""
    height, count = 0.4, 64
    n = [6, 6, 6]
    n[axis] = count
    axes = [np.linspace(0, 1, m + 1) for m in n]
    grid = LayerGrid(axes[2], axes[1], axes[0], np.full((n[1] + 1, n[2] + 1), height))
    length = height if axis == 0 else 1.0
    for waves in (1, 3):
        k = np.pi * waves / length
        u = np.cos(np.pi * waves * np.meshgrid(*axes, indexing="ij")[axis]) * np.ones((3, 1, 1, 1))
        expected = (1 + height**2 * k**2 / 80) * grid.node_volumes * u
        error = np.abs(Resistance(grid).force(u) - expected).max() / np.abs(expected).max()
        assert error < 0.005


def test_a_part_is_held_as_in_the_whole():
    grid = uneven()
    u = RNG.normal(size=(3, *grid.node_shape))
    box = slice(2, 9), slice(3, 10)
    part = LayerGrid(grid.x[box[1]], grid.y[box[0]], grid.depth, grid.thickness[box])
    inside = (..., slice(1, -1), slice(1, -1))
    whole = Resistance(grid).force(u)[:, :, *box][inside]
    assert_allclose(Resistance(part).force(u[:, :, *box])[inside], whole, rtol=1e-12)
