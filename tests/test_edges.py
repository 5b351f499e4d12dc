"""The influence of the layer's sides: nil where theory says so, and what finer grids find."""

import numpy as np
import pytest
import xarray as xr

from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress, edges
from optical_palpation.palpation.plausibility import BEYOND_EXTENT
from optical_palpation.present import read_result, summarise, write_result
from optical_palpation.present.figure import new_figure
from optical_palpation.present.panel import draw_panel
from optical_palpation.present.report.content import force_rows
from optical_palpation.study import warnings_about
from optical_palpation.thickness import thickness_map

LAYER, FIELD = 0.5, 4.0
LAW = MooneyRivlin(2.23, 0.703)


def dent(depth, width, level=0.0, field=FIELD):
    """Loaded thickness under a Gaussian bump of the sample."""
    axis = np.linspace(0, field, 81)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    bump = depth * np.exp(-((x - field / 2) ** 2 + (y - field / 2) ** 2) / (2 * width**2))
    return thickness_map(LAYER - level - bump, x=axis, y=axis)


def solved(loaded, friction=0.0, **options):
    settings = {"window_friction": friction, "sample_friction": friction, "element_size": 0.25}
    return computational_stress(loaded, LAYER, LAW, **settings | options)


@pytest.fixture(scope="module")
def rough():
    """A flat layer between rough faces, by its sides, on finer elements than the comparison's."""
    flat = dent(0.0, 1.0, level=0.05)
    return {
        sides: solved(flat, 0.3, edges=sides, element_size=(0.16, 0.16, 0.125))
        for sides in ("free", "padded")
    }


def test_without_friction_the_sides_of_a_flat_layer_do_not_matter():
    """Uniaxial compression everywhere, whether the layer ends or goes on."""
    result = solved(dent(0.0, 1.0, level=0.05), friction=1e-4)  # enough to hold it
    maps = result.maps
    assert maps["edge_influence"].dims == ("y", "x")
    assert maps["edge_influence"].attrs["units"] == "1"
    assert float(maps["edge_influence"].max()) < 2e-3
    assert maps.attrs["edge_influence_fraction"] == 0
    assert maps.attrs["edge_influence_force"] == pytest.approx(0, abs=2e-3)
    assert "sides of the layer" not in summarise(result)


def test_the_coarse_comparison_finds_what_finer_grids_do(rough):
    forces, pressures = {}, {}
    for sides, result in rough.items():
        pressures[sides] = result.maps["contact_pressure"].fillna(0)
        forces[sides] = float(pressures[sides].mean())
    here, there = pressures["free"], pressures["padded"]
    true = np.abs(there - here) / np.maximum(here, here.mean())
    found = rough["free"].maps["edge_influence"]
    assert found.attrs["comment"].count("padded") == 1
    assert rough["free"].maps.attrs["edge_influence_force"] == pytest.approx(
        forces["padded"] / forces["free"] - 1, rel=0.15
    )
    assert rough["padded"].maps.attrs["edge_influence_force"] == pytest.approx(
        forces["free"] / forces["padded"] - 1, rel=0.1
    )
    inner = {"x": slice(0.6, 3.4), "y": slice(0.6, 3.4)}
    assert float(true.sel(inner).min()) > edges.NOTABLE
    assert float(np.abs(found - true).sel(inner).mean()) < 0.15 * float(true.sel(inner).mean())
    assert rough["free"].maps.attrs["edge_influence_fraction"] > 0.9


def test_points_count_by_the_area_they_stand_for():
    """At a side that sticks the pressure is many times its mean."""
    axis = np.linspace(0, 1, 5)
    here = np.full((5, 5), 2.0)
    here[[0, -1]] = here[:, [0, -1]] = 20.0
    there = here + 1.0
    shares = np.outer(edges._shares(axis), edges._shares(axis))
    found = edges._compared("padded", here, there, shares)
    force = np.trapezoid(np.trapezoid(here, axis), axis)
    assert found.force == pytest.approx(1 / force)
    # of the rim, 7/16 of the area, the pressure changes by 5 % of itself at the most
    assert found.fraction == pytest.approx(9 / 16)
    # a force that pulls changes by a fraction of its size, towards pressing
    pulled = edges._compared("padded", here - 20.0, there - 20.0, shares)
    assert pulled.force == pytest.approx(1 / (20 - force))


def test_it_fades_with_the_distance_of_the_sides():
    """The same dent in a field of twice the width."""
    middle = {}
    for width in (3.0, 6.0):
        influence = solved(dent(0.06, 0.4, field=width), 0.1).maps["edge_influence"]
        middle[width] = float(influence.sel(x=width / 2, y=width / 2, method="nearest"))
    assert middle[6.0] < 0.6 * middle[3.0]
    assert middle[3.0] < edges.NOTABLE


def test_a_comparison_that_does_not_arrive_is_unknown_and_the_result_stays(monkeypatch, tmp_path):
    monkeypatch.setattr(edges, "_ALLOWED", 1)
    result = solved(dent(0.05, 0.4), 0.1)
    assert result.maps.attrs["status"] == "converged"
    assert bool(result.maps["edge_influence"].isnull().all())
    assert "1 Newton iterations" in result.maps.attrs["edge_influence_unknown"]
    assert "edge_influence_force" not in result.maps.attrs
    assert "sides of the layer: unknown" in summarise(result)
    write_result(result, tmp_path / "result.nc")
    again = read_result(tmp_path / "result.nc")
    xr.testing.assert_equal(again.maps["edge_influence"], result.maps["edge_influence"])


def beside(value, **options):
    """A layer in a map that is wider, and shows one value beside it."""
    whole = dent(0.1, 1.0, level=0.05)
    kept = {axis: slice(0.99, 3.01) for axis in "xy"}
    loaded = whole.sel(kept).reindex_like(whole, fill_value=value)
    return solved(loaded.assign_attrs(layer_extent=[1.0, 3.0, 1.0, 3.0]), 0.2, **options)


@pytest.mark.parametrize("sides", ["padded", "roller"])
def test_what_lies_beside_the_layer_does_not_matter_to_sides_that_do_not_bulge(sides):
    options = {"edges": sides, "mesh_check": False, "input_errors": None}
    one, other = (beside(value, **options).maps for value in (0.5, 0.3))
    xr.testing.assert_identical(one["axial_stress"], other["axial_stress"])
    xr.testing.assert_identical(one["edge_influence"], other["edge_influence"])
    assert "beyond_extent_force" not in one.attrs


def test_a_result_says_what_the_map_shows_beside_free_sides_does_to_the_force():
    options = {"mesh_check": False, "input_errors": None}
    wrong = beside(0.5, **options)
    whole = dent(0.1, 1.0, level=0.05).assign_attrs(layer_extent=[1.0, 3.0, 1.0, 3.0])
    right = solved(whole, 0.2, **options)
    alone = solved(whole.sel(x=slice(0.99, 3.01), y=slice(0.99, 3.01)), 0.2, **options)
    true = alone.maps.attrs["window_force_mN"] / wrong.maps.attrs["window_force_mN"] - 1
    assert true > 0.2
    assert wrong.maps.attrs["beyond_extent_force"] == pytest.approx(true, rel=0.3)
    assert "beyond the extent of the layer" in summarise(wrong)
    assert abs(right.maps.attrs["beyond_extent_force"]) < BEYOND_EXTENT
    assert "beyond the extent of the layer" not in summarise(right)
    assert "beyond_extent_force" not in alone.maps.attrs


def test_the_thickness_of_a_layer_is_that_within_its_extent():
    at = np.linspace(0, FIELD, 81)
    here = (abs(at - 2) < 1.01)[:, None] & (abs(at - 2) < 1.01)
    unloaded = thickness_map(np.where(here, LAYER, 0.2), x=at, y=at)
    loaded = dent(0.1, 1.0, level=0.05).assign_attrs(layer_extent=[1.0, 3.0, 1.0, 3.0])
    options = {"window_friction": 0.2, "sample_friction": 0.2, "element_size": 0.25}
    options |= {"edges": "padded", "mesh_check": False, "edge_check": False, "input_errors": None}
    one, other = (
        computational_stress(loaded, initial, LAW, **options).maps for initial in (unloaded, LAYER)
    )
    xr.testing.assert_allclose(one["axial_stress"], other["axial_stress"])
    assert one.attrs["slip_length_mm"] == other.attrs["slip_length_mm"]


def test_it_can_be_left_out():
    maps = solved(dent(0.05, 0.4), 0.1, edge_check=False).maps
    assert "edge_influence" not in maps
    assert not any(key.startswith("edge_influence") for key in maps.attrs)


def test_the_picture_and_the_report_say_where_the_sides_matter(rough, tmp_path):
    maps = rough["free"].maps.copy()
    for fraction, words in ((1.0, "sides matter everywhere"), (0.5, "hatched: sides matter")):
        inside = np.arange(maps.sizes["x"]) < fraction * maps.sizes["x"]
        maps["edge_influence"] = maps["edge_influence"].where(xr.DataArray(inside, dims="x"), 0.0)
        with new_figure() as figure:
            draw_panel(maps, figure)
            assert any(words in axes.get_xlabel() for axes in figure.axes), words
    (row,) = (text for name, text in force_rows(rough["free"]) if name == "Sides of the layer")
    assert row.startswith("taken as free; were they padded, the pressure would change by more than")
    (said,) = (text for text in warnings_about(rough["free"]) if "sides of the layer" in text)
    assert f"WARNING: {said}" in summarise(rough["free"]).splitlines()


def test_the_panel_shows_the_algebraic_map_on_the_pixels(rough, tmp_path):
    result = rough["free"]
    pixels = result.pixels["algebraic_axial_stress"]
    assert pixels.shape == (81, 81)
    assert pixels.shape != result.maps["algebraic_axial_stress"].shape
    write_result(result, tmp_path / "result.nc")
    again = read_result(tmp_path / "result.nc").pixels
    xr.testing.assert_allclose(again, result.pixels, rtol=1e-6)
    with new_figure() as figure:
        draw_panel(result.maps, figure, again)
        drawn = {
            axes.get_title("left"): axes.collections[0].get_array().shape
            for axes in figure.axes
            if axes.collections and "(kPa)" in axes.get_title("left")
        }
    assert drawn["Axial stress, algebraic (kPa)"] == pixels.shape
    assert drawn["Axial stress, computational (kPa)"] == result.maps["axial_stress"].shape
