"""Points of the laboratory frame find the material points that lie there."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.palpation.surface import material_points, surface_field


def grid() -> LayerGrid:
    x, y = node_positions(3.0, 0.1, edge=0.02), node_positions(2.0, 0.1, edge=0.02)
    return LayerGrid(x, y, np.linspace(0, 1, 3), np.full((y.size, x.size), 0.5))


def targets(x0, x1, y0, y1):
    y, x = np.linspace(y0, y1, 23), np.linspace(x0, x1, 31)
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)


@pytest.mark.parametrize("amount", [0.0, 0.05, 0.3])
def test_the_points_found_lie_where_they_were_sought(amount):
    layer = grid()
    x, y = np.meshgrid(layer.x, layer.y)
    moved_x = x + amount * np.sin(2 * x) * np.cos(y) + 0.02
    moved_y = y + amount * np.cos(x) * np.sin(2 * y)
    inside = targets(0.5, 2.5, 0.5, 1.5)
    reference, outside = material_points(layer, moved_x, moved_y, inside)
    assert not outside.any()
    for component, nodes, moved in ((0, layer.y[:, None], moved_y), (1, layer.x, moved_x)):
        there = reference[..., component] + surface_field(layer, moved - nodes)(reference)
        assert_allclose(there, inside[..., component], atol=1e-6)


def test_what_the_layer_does_not_cover_is_outside():
    layer = grid()
    x, y = np.meshgrid(layer.x, layer.y)
    # spread by a tenth about its centre: it covers -0.15 to 3.15 mm
    _, outside = material_points(layer, 1.5 + 1.1 * (x - 1.5), y, targets(-0.3, 3.3, 0.0, 2.0))
    at = np.linspace(-0.3, 3.3, 31)
    np.testing.assert_array_equal(outside.all(0), (at < -0.15 - 1e-6) | (at > 3.15 + 1e-6))
    np.testing.assert_array_equal(outside.any(0), outside.all(0))


def test_a_surface_that_is_nearly_folded_is_no_trap():
    layer = grid()
    x, y = np.meshgrid(layer.x, layer.y)
    moved = x - 0.9 / 4 * np.sin(4 * x)  # as little as a tenth of its width
    inside = targets(0.6, 2.4, 0.5, 1.5)
    reference, _ = material_points(layer, moved, y, inside)
    there = reference[..., 1] + surface_field(layer, moved - layer.x)(reference)
    assert_allclose(there, inside[..., 1], atol=1e-4)
