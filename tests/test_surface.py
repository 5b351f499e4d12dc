"""Points of the laboratory frame find the material points that lie there."""

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from optical_palpation.analysis import force_balance
from optical_palpation.analysis.maps import point_areas
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.palpation import computational_stress, surface
from optical_palpation.palpation.surface import (
    MapReading,
    force_within,
    material_points,
    surface_axial_stress,
    surface_field,
)
from optical_palpation.present import summarise
from optical_palpation.present.report.content import force_rows
from optical_palpation.thickness import thickness_map


def grid() -> LayerGrid:
    x, y = node_positions(3.0, 0.1, edge=0.02), node_positions(2.0, 0.1, edge=0.02)
    return LayerGrid(x, y, np.linspace(0, 1, 3), np.full((y.size, x.size), 0.5))


def targets(x0, x1, y0, y1, finer=1):
    y, x = np.linspace(y0, y1, 23 * finer), np.linspace(x0, x1, 31 * finer)
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


@pytest.mark.parametrize("width", [0.1, 0.03, 0.01])
def test_rows_that_are_nearly_folded_at_a_rim_catch_no_points(width):
    layer = grid()
    # the outermost rows keep a share of their width, and the rest spreads, as a rim that rolls
    moved = []
    for nodes in (layer.x, layer.y):
        widths = 1.25 * np.diff(nodes)
        widths[[0, 1, -2, -1]] *= width
        at = np.concatenate([[0.0], np.cumsum(widths)])
        moved.append(at + nodes.mean() - at.mean())
    x, y = np.meshgrid(*moved)
    inside = targets(x.min() + 1e-4, x.max() - 1e-4, y.min() + 1e-4, y.max() - 1e-4, 8)
    reference, outside = material_points(layer, x, y, inside)
    assert not outside.any()
    for component, nodes, there in ((0, layer.y[:, None], y), (1, layer.x, x)):
        found = reference[..., component] + surface_field(layer, there - nodes)(reference)
        assert_allclose(found, inside[..., component], atol=1e-4)
    far = targets(x.min() - 2.0, x.max() + 2.0, y.min() - 2.0, y.max() + 2.0)
    _, outside = material_points(layer, x, y, far)
    slack = 1e-6
    beyond = (far[..., 1] < x.min() - slack) | (far[..., 1] > x.max() + slack)
    beyond |= (far[..., 0] < y.min() - slack) | (far[..., 0] > y.max() + slack)
    np.testing.assert_array_equal(outside, beyond)


def test_points_under_a_rim_that_is_folded_over_belong_to_the_sheet_that_is_not_turned():
    layer = grid()
    widths = np.diff(layer.x)
    widths[-1] *= -0.8  # the outermost row lies upside down on the one before it
    x, y = np.meshgrid(np.append(0.0, np.cumsum(widths)), layer.y)
    sought = targets(x[0, -1] + 1e-3, x[0, -2] - 1e-3, 0.5, 1.5).reshape(-1, 2)
    found = surface._between_nodes((layer.y, layer.x), np.stack([y, x], axis=-1), sought)
    assert_allclose(found, sought, atol=1e-12)  # but for the outermost row nothing has moved
    assert np.isnan(
        surface._between_nodes((layer.y, layer.x), np.stack([y, x], -1), sought + 1)
    ).all()


def reading(layer, retreat=0.0):
    """A map of points 0.1 mm apart on a layer whose rim has moved inwards, and their areas."""
    x, y = np.meshgrid(layer.x, layer.y)
    map_x, map_y = np.linspace(0, 3, 31), np.linspace(0, 2, 21)
    frame = xr.DataArray(np.ones((21, 31)), {"y": map_y, "x": map_x}, ("y", "x"))
    x, y = (at + retreat * (1 - 2 * at / at.max()) for at in (x, y))
    return MapReading(layer, x, y, map_x, map_y), point_areas(frame).values


def test_a_steep_rim_counts_for_what_it_covers():
    layer = grid()
    field = np.full(layer.areas.shape, 2.0)
    for side in (0, -1):
        field[side], field[:, side] = 100.0, 100.0
    maps, areas = reading(layer)
    shown = maps.read(field)
    assert (areas * shown).sum() == pytest.approx((layer.areas * field).sum(), rel=1e-3)
    assert_allclose(shown[2:-2, 2:-2], 2.0, rtol=1e-9)


@pytest.mark.parametrize("retreat", [0.0, 2e-4, 0.01])
def test_a_rim_that_has_hardly_moved_leaves_no_gap(retreat):
    layer = grid()
    maps, _ = reading(layer, retreat)
    assert not maps.outside.any()
    assert_allclose(maps.read(np.full(layer.areas.shape, 3.0)), 3.0)
    maps, _ = reading(layer, 0.04)  # half of the outermost parts is 0.025 mm
    assert maps.outside[0].all()
    assert not maps.outside[1:-1, 1:-1].any()


def press_glued():
    axis = np.linspace(0, 2, 41)
    loaded = thickness_map(np.full((41, 41), 0.45), x=axis, y=axis)
    return computational_stress(
        loaded,
        0.5,
        MooneyRivlin(2.23, 0.703),
        window_friction="glued",
        sample_friction="glued",
        element_size=(0.25, 0.25, 0.125),
        threads=1,
        mesh_check=False,
        edge_check=False,
        input_errors=None,
    )


def test_the_map_of_a_layer_that_sticks_adds_up_to_the_force():
    result = press_glued()
    attrs = result.maps.attrs
    shown = force_balance(result.maps["axial_stress"])
    assert shown.missing == 0
    assert shown.force == pytest.approx(attrs["sample_force_mN"], rel=0.02)
    assert attrs["map_force_mN"] == pytest.approx(attrs["sample_force_mN"], rel=1e-3)
    assert attrs["map_force_difference"] < 0.02
    assert "adds up" not in summarise(result)
    attrs["map_force_mN"] *= 0.8
    within = dict(force_rows(result))["Within the map"]
    assert f"; within the map {within}" in summarise(result)


def test_a_map_that_shows_another_force_is_told(monkeypatch):
    def astray(grid, x, y, target):
        found, outside = material_points(grid, x, y, target)
        found[..., 1] = np.where(target[..., 1] > 1.5, grid.x[-1], found[..., 1])
        return found, outside

    monkeypatch.setattr(surface, "material_points", astray)
    result = press_glued()
    assert result.maps.attrs["map_force_difference"] > 0.2
    assert "WARNING: the stress map adds up to a force that differs by" in summarise(result)


def test_the_force_within_an_extent():
    layer = grid()
    x, y = np.meshgrid(layer.x, layer.y)
    moved = np.stack([1.5 + 1.2 * (x - 1.5), y + 0.1 * x])
    everywhere = (-9.0, 9.0, -9.0, 9.0)
    assert force_within(moved, np.full(x.shape, 5.0), everywhere) == pytest.approx(5 * 1.2 * 6)
    assert force_within(moved, x, everywhere) == pytest.approx(1.5 * 1.2 * 6)
    part = force_within(moved, np.full(x.shape, 5.0), (1.0, 2.0, 0.5, 1.5))
    assert part == pytest.approx(5.0, rel=0.02)


def test_axial_stress_of_a_slope_with_friction():
    """Of any even stress, whatever the hydrostatic part of the elements."""
    rng = np.random.default_rng(1)
    xx, yy, zz, yz, xz, xy = even = rng.normal(size=6)
    slope = np.array([0.4, -0.2])
    stress = np.broadcast_to(even[:, None, None, None], (6, 3, 4, 5)).copy()
    stress[:3] += rng.normal(size=(3, 4, 5))
    normal = np.array([-slope[0], -slope[1], 1.0])
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    carried = np.full((5, 6), -(tensor @ normal)[2])
    slopes = np.broadcast_to(slope[:, None, None], (2, 5, 6))
    assert_allclose(surface_axial_stress(stress, slopes, carried), zz)
