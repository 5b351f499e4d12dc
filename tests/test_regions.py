"""Regions of interest, profiles along lines and comparison of results, against geometry by hand."""

import contextlib

import numpy as np
import pandas as pd
import pytest
import roifile
import tifffile
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from skimage.measure import points_in_poly

from optical_palpation.analysis import (
    Region,
    compare_results,
    line_profile,
    read_regions,
    region_statistics,
    write_regions,
)
from optical_palpation.analysis.tracing import traced
from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import algebraic_result
from optical_palpation.present import summarise
from optical_palpation.present.comparison import comparison_in_words
from optical_palpation.present.report.content import key_figures
from optical_palpation.present.summary import stress_figures
from optical_palpation.present.tables import result_columns
from optical_palpation.present.terms import plain, rounded
from optical_palpation.thickness import thickness_map

X, Y = 1.0 + 0.1 * np.arange(41), -0.5 + 0.05 * np.arange(61)


def maps_of(function, error=None, x=X, y=Y):
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    maps = xr.Dataset(
        {"axial_stress": (("y", "x"), function(grid_x, grid_y), {"units": "kPa"})},
        {"y": y, "x": x},
    )
    if error is not None:
        maps["axial_stress_error"] = maps["axial_stress"] * 0 + error
    return maps


@given(
    x0=st.floats(1.2, 2.5),
    y0=st.floats(-0.3, 0.8),
    width=st.floats(0.2, 1.5),
    height=st.floats(0.2, 1.2),
)
def test_area_and_force_of_a_rectangle_do_not_jump_with_the_pixels(x0, y0, width, height):
    region = Region.rectangle("r", x0, x0 + width, y0, y0 + height)
    found = region_statistics(maps_of(lambda x, y: -2.0 + 0 * x), [region]).sel(region="r")
    # counted by points an eighth of a pixel apart
    slack = 2 * (0.1 / 8) * height + 2 * (0.05 / 8) * width
    assert float(found["area"]) == pytest.approx(width * height, abs=slack)
    assert float(found["force"]) == pytest.approx(2.0 * float(found["area"]), rel=1e-12)
    assert float(found["mean"]) == pytest.approx(-2.0)
    assert float(found["standard_deviation"]) == pytest.approx(0.0, abs=1e-12)


def test_mean_over_an_ellipse_on_a_slope_is_the_value_at_its_centre():
    region = Region.ellipse("spot", (3.0, 1.0), (0.8, 0.4))
    found = region_statistics(maps_of(lambda x, y: -x - 3 * y), [region]).sel(region="spot")
    assert float(found["mean"]) == pytest.approx(-6.0, abs=0.005)
    assert float(found["area"]) == pytest.approx(np.pi * 0.32, rel=0.005)
    # of x + 3 y over the ellipse: semi-axes squared over four
    assert float(found["standard_deviation"]) == pytest.approx(
        np.sqrt((0.8**2 + (3 * 0.4) ** 2) / 4), rel=0.02
    )


def test_the_mean_of_a_result_is_that_of_a_region_all_over_it():
    at = np.linspace(0.0, 2.0, 21)
    grid_y, grid_x = np.meshgrid(at, at, indexing="ij")
    loaded = thickness_map(0.4 + 0.05 * (grid_x - 1) ** 2 + 0.04 * (grid_y - 1) ** 4, x=at, y=at)
    result = algebraic_result(loaded, 0.5, MooneyRivlin(2.23, 0.703))
    stress = result.maps["axial_stress"]
    result.maps["axial_stress_error"] = -0.1 * stress
    mean = float(stress.integrate(["y", "x"])) / 4.0
    assert abs(float(stress.mean()) - mean) > 0.02 * abs(mean)  # that of the points is another
    whole = [Region.rectangle("all", 0.0, 2.0, 0.0, 2.0)]
    assert float(region_statistics(result.maps, whole)["mean"][0]) == pytest.approx(mean)
    result.maps["contact_state"] = xr.ones_like(stress, int)
    result.maps.attrs |= {"window_force_mN": 11.0, "sample_force_mN": 11.0, "force_error_mN": 1.0}
    row = result_columns(result)
    assert row["mean_axial_stress_kPa"] == pytest.approx(mean)
    assert row["algebraic_mean_axial_stress_kPa"] == pytest.approx(mean)
    assert row["mean_axial_stress_error_kPa"] == pytest.approx(-0.1 * mean)
    said = rounded(mean, -0.1 * mean)
    assert stress_figures(result, "algebraic")[0] == said
    assert f"mean {plain(said)} kPa" in summarise(result)
    assert f"mean axial stress {plain(said)} kPa" in repr(result)
    assert ("Mean stress, algebraic", f"{said} kPa") in key_figures(
        result, loaded=None, unloaded=None
    )
    rest = region_statistics(result.maps, [Region.rectangle("m", 0.95, 1.05, 0.95, 1.05)])
    less = float(stress.sel(x=1.0, y=1.0, method="nearest")) * 0.1**2
    assert rest.attrs["background_mean"] == pytest.approx((4 * mean - less) / (4 - 0.1**2))


def test_a_region_ends_where_the_layer_does():
    at = np.linspace(0.0, 2.0, 21)
    grid_y, grid_x = np.meshgrid(at, at, indexing="ij")
    thickness = 0.4 + 0.05 * (grid_x - 1) ** 2 + 0.02 * grid_y
    whole = thickness_map(thickness, x=at, y=at, layer_extent=(0.3, 1.6, 0.2, 2.0))
    part = thickness_map(thickness[2:, 3:17], x=at[3:17], y=at[2:])
    found = [algebraic_result(each, 0.5, MooneyRivlin(2.23, 0.703)) for each in (whole, part)]
    outline = Region.rectangle("all", 0.0, 2.0, 0.0, 2.0)
    tables = [result.regions(outline) for result in found]
    for name in ("mean", "force", "area", "missing"):
        assert float(tables[0][name][0]) == pytest.approx(float(tables[1][name][0]))
    said = stress_figures(found[0], "algebraic")[0]
    assert rounded(tables[0]["mean"][0]) == said


def test_a_region_without_gaps_misses_nothing():
    maps = maps_of(lambda x, y: x + y)
    ellipse = Region.ellipse("e", (2.7, 1.0), (0.31, 0.23))
    assert float(region_statistics(maps, [ellipse])["missing"][0]) == 0.0


def test_the_mean_lies_between_the_extremes_however_small_the_region():
    maps = maps_of(lambda x, y: x + 0.3 * y)
    dx, dy = float(maps["x"][1] - maps["x"][0]), float(maps["y"][1] - maps["y"][0])
    for size in (0.2, 0.7, 1.1, 1.5):
        for shift in np.linspace(0.0, 1.0, 7):
            x, y = 2.0 + shift * dx, 1.0 + shift * dy
            corners = [(x, y), (x + size * dx, y), (x + size * dx, y + size * dy)]
            found = region_statistics(maps, [Region.polygon("small", corners)]).isel(region=0)
            low, mean, high = (float(found[name]) for name in ("minimum", "mean", "maximum"))
            assert low - 1e-12 <= mean <= high + 1e-12


def test_extremes_errors_gaps_and_contrast():
    noise = np.random.default_rng(1).normal(0, 0.1, (Y.size, X.size))
    maps = maps_of(lambda x, y: -1.0 + noise, error=0.3)
    inside = (abs(maps["x"] - 3.0) < 0.5) & (abs(maps["y"] - 1.0) < 0.4)
    maps["axial_stress"] = maps["axial_stress"] - 4.0 * inside.transpose("y", "x")
    maps["axial_stress"][30, 20] = np.nan
    region = Region.of_mask("bump", inside.transpose("y", "x"))
    found = region_statistics(maps, [region]).sel(region="bump")
    values = maps["axial_stress"].values[inside.transpose("y", "x").values]
    assert float(found["mean"]) == pytest.approx(np.nanmean(values))
    assert float(found["minimum"]) == np.nanmin(values)
    assert float(found["maximum"]) == np.nanmax(values)
    assert float(found["missing"]) == pytest.approx(1 / values.size)
    assert float(found["mean_error"]) == pytest.approx(0.3)
    covered = float(found["area"]) * (1 - float(found["missing"]))
    assert float(found["force_error"]) == pytest.approx(0.3 * covered)
    maps["axial_stress_error"][31:, :] = np.nan
    partly = region_statistics(maps, [region]).sel(region="bump")
    assert float(partly["mean_error"]) == pytest.approx(0.3)
    maps["axial_stress_error"] = maps["axial_stress_error"].where(~inside)
    assert np.isnan(region_statistics(maps, [region])["force_error"]).all()
    assert float(found["contrast"]) == pytest.approx(4.0 / 0.1, rel=0.1)
    assert found.attrs["background_mean"] == pytest.approx(-1.0, abs=0.02)
    dark = Region.rectangle("dark", 1.2, 1.8, -0.3, 0.5)
    against = region_statistics(maps, [region], background=dark)
    assert float(against["difference"][0]) == pytest.approx(-4.0, abs=0.1)
    assert "contrast" not in region_statistics(maps, [region], background=None)


def test_a_region_of_few_pixels_has_its_area():
    at = 0.125 * np.arange(33)
    maps = maps_of(lambda x, y: -2.0 + 0 * x, x=at, y=at)
    for size in (0.1, 0.3, 0.8):
        region = Region.rectangle("r", 1.2, 1.2 + size, 0.6, 0.6 + size)
        found = region_statistics(maps, [region])
        assert float(found["area"][0]) == pytest.approx(size**2, rel=0.02 if size < 0.3 else 0.01)


def test_a_hole_is_no_part_of_a_region():
    outer = Region.rectangle("o", 1.5, 4.5, 0.0, 2.0).outlines[0]
    inner = Region.rectangle("i", 2.5, 3.5, 0.5, 1.5).outlines[0]
    found = region_statistics(
        maps_of(lambda x, y: x * 0 - 1.0), [Region("ring", (outer, inner))], background=None
    )
    assert float(found["area"][0]) == pytest.approx(6.0 - 1.0, abs=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_a_pixel_belongs_to_an_outline_by_the_points_that_lie_in_it(seed):
    """Outlines that cross themselves and each other, against a test of every point."""
    rng = np.random.default_rng(seed)
    field = maps_of(lambda x, y: -x)["axial_stress"]
    outlines = tuple(rng.uniform((1.0, -0.5), (5.0, 2.5), (n, 2)) for n in (5, 30))
    count = 8  # points along each side of a pixel of a region as large as the map
    offsets = (np.arange(count) + 0.5) / count - 0.5
    fine_y, fine_x = (
        (axis[:, None] + offsets * (axis[1] - axis[0])).ravel() for axis in (field.y.values, X)
    )
    points = np.stack(np.meshgrid(fine_x, fine_y), -1).reshape(-1, 2)
    inside = np.logical_xor(*(points_in_poly(points, outline) for outline in outlines))
    inside = inside.reshape(Y.size, count, X.size, count).mean(axis=(1, 3))
    held = Region("two", outlines).weights(field).values
    # pixels at the border of the map are cut by it
    np.testing.assert_array_equal(held[1:-1, 1:-1], inside[1:-1, 1:-1])


def test_regions_that_cannot_be_used():
    maps = maps_of(lambda x, y: -x)
    region = Region.rectangle("a", 2, 3, 0, 1)
    with pytest.raises(InputError, match="outside of the map"):
        region_statistics(maps, [Region.rectangle("far", 20, 30, 0, 1)])
    with pytest.raises(InputError, match="names must differ"):
        region_statistics(maps, [region, region])
    with pytest.raises(InputError, match="no map 'strain'; known are axial_stress"):
        region_statistics(maps, [region], "strain")
    with pytest.raises(InputError, match="at least one"):
        region_statistics(maps, [])
    with pytest.raises(InputError, match="three vertices"):
        Region.polygon("line", [(0, 0), (1, 1)])
    with pytest.raises(InputError, match="on a line and enclose no area"):
        Region.polygon("line", [(0, 0), (1, 1), (3, 3)])
    with pytest.raises(InputError, match="x0 < x1"):
        Region.rectangle("turned", 3, 2, 0, 1)
    with pytest.raises(InputError, match="true somewhere"):
        Region.of_mask("none", xr.zeros_like(maps["axial_stress"], dtype=bool))
    maps["axial_stress"][:] = np.where(maps["x"] > 1.9, np.nan, maps["axial_stress"])
    with pytest.raises(InputError, match="holds no value"):
        region_statistics(maps, [region])


def test_there_is_nothing_beyond_the_outermost_points():
    maps = maps_of(lambda x, y: -1.0 - x)
    low, high = (
        [float(maps[axis].min()) for axis in "xy"],
        [float(maps[axis].max()) for axis in "xy"],
    )
    whole = Region.rectangle("whole", low[0], high[0], low[1], high[1])
    wider = Region.rectangle("wider", low[0] - 5, high[0] + 5, low[1] - 5, high[1] + 5)
    mask = Region.of_mask("mask", xr.ones_like(maps["axial_stress"], dtype=bool))
    found = region_statistics(maps, [whole, wider, mask], background=None)
    expected = -maps["axial_stress"].integrate(("x", "y"))
    np.testing.assert_allclose(found["force"], expected, rtol=1e-12)
    assert float(found["area"].sel(region="mask")) == pytest.approx(
        (high[0] - low[0]) * (high[1] - low[1])
    )
    outside = Region.rectangle("outside", high[0] + 1e-3, high[0] + 1.0, low[1], high[1])
    with pytest.raises(InputError, match="lies outside of the map"):
        region_statistics(maps, [outside])


def test_what_lies_beyond_the_map_is_missing():
    maps = maps_of(lambda x, y: x * 0 - 2.0)
    edge = X[-1]
    half = Region.rectangle("half", edge - 1.0, edge + 1.0, 0.0, 1.0)
    found = region_statistics(maps, [half], background=None).sel(region="half")
    assert float(found["area"]) == pytest.approx(2.0, rel=0.03)
    assert float(found["missing"]) == pytest.approx(0.5, abs=0.01)
    assert float(found["force"]) == pytest.approx(2.0, rel=0.03)
    all_of_it = Region.rectangle("all", X[0], edge, Y[0], Y[-1])
    assert float(region_statistics(maps, [all_of_it], background=None)["missing"][0]) == 0.0
    ring = (all_of_it.outlines[0], Region.rectangle("hole", 2, 3, 0, 1).outlines[0])
    assert Region("ring", ring).beyond(maps["axial_stress"]) == 0.0
    shifted = xr.DataArray(np.ones((4, 4), bool), {"y": Y[:4], "x": X[-2] + 0.1 * np.arange(4)})
    found = region_statistics(maps, [Region.of_mask("m", shifted)], background=None)
    # the second column and the first row lie on the border: half of each
    assert float(found["missing"][0]) == pytest.approx(2 / 3.5)
    assert float(found["area"][0]) == pytest.approx(3.5 * 3.5 * 0.005)


def test_imagej_regions_lie_where_they_were_drawn(tmp_path):
    """Corners of pixels in ImageJ are whole numbers: its box covers columns 10 to 19."""
    maps = maps_of(lambda x, y: -x)
    box = roifile.ImagejRoi(
        roitype=roifile.ROI_TYPE.RECT, left=10, top=20, right=20, bottom=40, name="box"
    )
    polygon = roifile.ImagejRoi.frompoints(
        np.array([(5.5, 5.5), (15.5, 5.5), (5.5, 25.5)]), name="triangle"
    )
    roifile.roiwrite(tmp_path / "set.zip", [box, polygon])
    regions = read_regions(tmp_path / "set.zip", maps)
    assert [r.name for r in regions] == ["box", "triangle"]
    found = region_statistics(maps, regions)
    assert float(found["area"].sel(region="box")) == pytest.approx(10 * 0.1 * 20 * 0.05)
    inside = X[10:20].mean()
    assert float(found["mean"].sel(region="box")) == pytest.approx(-inside)
    assert float(found["area"].sel(region="triangle")) == pytest.approx(0.5 * 1.0 * 1.0, rel=0.02)
    box.tofile(tmp_path / "one.roi")
    (one,) = read_regions(tmp_path / "one.roi", maps["axial_stress"])
    np.testing.assert_allclose(one.weights(maps["axial_stress"]), regions[0].weights(
        maps["axial_stress"]
    ))  # fmt: skip


def test_an_imagej_oval_has_its_area(tmp_path):
    maps = maps_of(lambda x, y: -x)
    oval = roifile.ImagejRoi(
        roitype=roifile.ROI_TYPE.OVAL, left=10, top=10, right=30, bottom=50, name="oval"
    )
    oval.tofile(tmp_path / "oval.roi")
    found = region_statistics(maps, read_regions(tmp_path / "oval.roi", maps))
    assert float(found["area"][0]) == pytest.approx(np.pi * 1.0 * 1.0, rel=0.01)
    assert float(found["mean"][0]) == pytest.approx(-(1.0 + 0.1 * 19.5), abs=0.01)
    oval.roitype, oval.rounded_rect_arc_size = roifile.ROI_TYPE.RECT, 8
    oval.tofile(tmp_path / "rounded.roi")
    with pytest.raises(InputError, match="rounded corners"):
        read_regions(tmp_path / "rounded.roi", maps)


def napari_table(path, shapes):
    rows = [
        (number, kind, k, *corner)
        for number, (kind, corners) in enumerate(shapes)
        for k, corner in enumerate(corners)
    ]
    columns = ["index", "shape-type", "vertex-index", "axis-0", "axis-1"]
    pd.DataFrame(rows, columns=columns).to_csv(path, index=False)


def test_napari_shapes_count_from_the_centre_of_the_first_pixel(tmp_path):
    maps = maps_of(lambda x, y: -x)
    corners = [(9.5, 4.5), (9.5, 14.5), (29.5, 14.5), (29.5, 4.5)]
    napari_table(tmp_path / "s.csv", [("rectangle", corners), ("ellipse", corners)])
    regions = read_regions(tmp_path / "s.csv", maps)
    found = region_statistics(maps, regions)
    assert list(found["region"].values) == ["rectangle 0", "ellipse 1"]
    assert float(found["area"][0]) == pytest.approx(1.0)
    assert float(found["mean"][0]) == pytest.approx(-X[5:15].mean())
    assert float(found["area"][1]) == pytest.approx(np.pi / 4, rel=0.01)
    for kind, message in (("line", "no area"), ("star", "a 'star', which is not known")):
        napari_table(tmp_path / "l.csv", [(kind, corners[:3])])
        with pytest.raises(InputError, match=message):
            read_regions(tmp_path / "l.csv", maps)


def test_shapes_in_mm_are_not_taken_for_pixels(tmp_path):
    """As napari's own menu saves what was drawn over a map in mm."""
    maps = maps_of(lambda x, y: -x)
    corners = [(y, x) for x, y in ((1.5, -0.3), (1.5, 1.4), (3.0, 1.4), (3.0, -0.3))]
    napari_table(tmp_path / "mm.csv", [("rectangle", corners)])
    with pytest.raises(InputError, match="seem to be in mm, not in pixels"):
        read_regions(tmp_path / "mm.csv", maps)


@pytest.mark.parametrize("ending", ["tif", "npy", "png"])
def test_labels_are_regions(tmp_path, ending):
    maps = maps_of(lambda x, y: -x)
    labels = np.zeros((Y.size, X.size), np.uint8)
    labels[2:10, 3:7] = 1
    labels[20:30, 10:20] = 7
    path = tmp_path / f"cells.{ending}"
    if ending == "tif":
        tifffile.imwrite(path, labels)
    elif ending == "npy":
        np.save(path, labels)
    else:
        from PIL import Image

        Image.fromarray(labels).save(path)
    found = region_statistics(maps, read_regions(path, maps))
    assert list(found["region"].values) == ["label 1", "label 7"]
    assert float(found["area"][1]) == pytest.approx(100 * 0.005)
    assert float(found["mean"][0]) == pytest.approx(-X[3:7].mean())


def test_each_label_is_a_region_of_its_own_part_of_the_map(tmp_path):
    """Of one pixel, in a corner, and of several parts; none keeps the whole map."""
    maps = maps_of(lambda x, y: -x)
    labels = np.zeros((Y.size, X.size), np.uint16)
    labels[0, 0], labels[5, 7], labels[10:20, 3:9], labels[12, 4:6], labels[30, 3] = 9, 4, 2, 0, 2
    np.save(tmp_path / "labels.npy", labels)
    regions = read_regions(tmp_path / "labels.npy", maps)
    assert [region.name for region in regions] == ["label 2", "label 4", "label 9"]
    for number, region in zip((2, 4, 9), regions, strict=True):
        np.testing.assert_array_equal(region.weights(maps["axial_stress"]), labels == number)
        assert region.mask.size <= 23 * 8
        whole = Region.of_mask("whole", maps["axial_stress"].copy(data=labels == number))
        assert region.beyond(maps["axial_stress"]) == whole.beyond(maps["axial_stress"])
        for one, other in zip(traced(region).outlines, traced(whole).outlines, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)


def test_a_table_of_outlines(tmp_path):
    (tmp_path / "r.csv").write_text("name,x_mm,y_mm\na,2,0\na,3,0\na,3,1\na,2,1\n")
    maps = maps_of(lambda x, y: -x)
    (region,) = read_regions(tmp_path / "r.csv", maps)
    assert float(region_statistics(maps, [region])["area"][0]) == pytest.approx(1.0, rel=0.03)


def test_masks_holes_and_names_come_back_from_a_table(tmp_path):
    maps = maps_of(lambda x, y: -x)
    ring = np.zeros((Y.size, X.size), bool)
    ring[2:9, 3:12] = True
    ring[4:7, 5:8] = False  # a hole
    ring[10:12, 1:3] = True  # and a second part
    whole = Region.rectangle("a", 2, 3, 0, 1), Region.rectangle("a", 3, 4, 0, 1)
    written = [Region.of_mask("ring", maps["axial_stress"].copy(data=ring)), *whole]
    write_regions(written, tmp_path / "r.csv")
    found = read_regions(tmp_path / "r.csv", maps)
    assert [region.name for region in found] == ["ring", "a 1", "a 2"]
    assert len(found[0].outlines) == 3
    for one, other in zip(found, written, strict=True):
        here, there = (it.weights(maps["axial_stress"]).values for it in (one, other))
        np.testing.assert_allclose(here, there, atol=1e-12)
    thin = Region("thin", mask=maps["axial_stress"].copy(data=0.2 * ring))
    with pytest.raises(InputError, match="'thin': its mask holds no whole pixel"):
        write_regions([thin], tmp_path / "none.csv")
    assert not (tmp_path / "none.csv").exists()


CORNERS = ((2, 0), (3, 0), (3, 1), (2, 1))


def outline(row, header="name,x_mm,y_mm"):
    return "".join(f"{line}\n" for line in [header, *(row.format(x=x, y=y) for x, y in CORNERS)])


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (outline("NA,{x},{y}"), ["NA"]),  # the name of a region, no missing value
        (outline("nan,{x},{y}") + outline("null,{x},{y}", "# b"), ["nan", "null"]),
        (outline("1,{x},{y}"), ["1"]),
        (outline("0,a,{x},{y}", ",name,x_mm,y_mm"), ["a"]),  # with pandas' index
        (outline("a,{x},{y},"), ["a"]),
        (outline("a;{x};{y}", "name;x_mm;y_mm"), ["a"]),
        (outline('"a, b",{x},{y}'), ["a, b"]),
        ("\ufeff" + outline("a,{x},{y}"), ["a"]),
        (outline("a,{x},{y},7"), "4 cells under a header of 3"),
        (outline("7,a,{x},{y}"), "4 cells under a header of 3"),
        (outline("b,{x},{y}") + outline(",{x},{y}", "# no name"), "line 7: has no name"),
        (outline("a,{x},{y},{y}", "name,x_mm,y_mm,x_mm"), "2 columns are called 'x_mm'"),
        (outline("a;{x},5;{y},5", "name;x_mm;y_mm"), "write decimal points"),
        (outline("a,{x} mm,{y}"), "'2 mm', not a number"),
        (outline("a,one,{x},{y}", "name,outline,x_mm,y_mm"), "'one', not a number"),
        (outline("a,{x},{y}", "name,x_um,y_um"), "needs the columns name, x_mm, y_mm"),
    ],
)
def test_a_table_of_outlines_is_read_rightly_or_refused(tmp_path, text, names):
    (tmp_path / "r.csv").write_text(text, encoding="utf-8")
    maps = maps_of(lambda x, y: -x)
    if isinstance(names, str):
        with pytest.raises(InputError, match=names) as caught:
            read_regions(tmp_path / "r.csv", maps)
        assert "r.csv" in str(caught.value)
        return
    regions = read_regions(tmp_path / "r.csv", maps)
    assert [region.name for region in regions] == names
    for region in regions:
        np.testing.assert_array_equal(region.outlines[0], CORNERS)


def test_masks_that_programs_show_differently_are_refused(tmp_path):
    maps = maps_of(lambda x, y: -x)
    mask = np.zeros((Y.size, X.size), np.uint8)
    mask[2:10, 3:7] = 255
    for options, message in (
        ({"extratags": [(274, "H", 1, 4)]}, "orientation tag says 4"),
        ({"photometric": "miniswhite"}, "inverted grey"),
    ):
        tifffile.imwrite(tmp_path / "mask.tif", mask, **options)
        with pytest.raises(InputError, match=message):
            read_regions(tmp_path / "mask.tif", maps)
    smooth = np.where(mask == 0, np.arange(mask.shape[1]) * 9, mask).astype(np.uint8)
    tifffile.imwrite(tmp_path / "smooth.tif", smooth)
    with pytest.raises(InputError, match="greys up to 255 are no labels"):
        read_regions(tmp_path / "smooth.tif", maps)
    tifffile.imwrite(tmp_path / "mask.tif", mask, compression="zlib")
    (region,) = read_regions(tmp_path / "mask.tif", maps)
    assert float(region.weights(maps["axial_stress"]).sum()) == 32


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.roi", None, "no such file"),
        ("a.roi", b"nothing of the kind", "a.roi"),
        ("a.zip", b"PK nothing", "a.zip"),
        ("a.csv", b"x,y\n1,2\n", "name, x_mm, y_mm"),
        ("a.csv", b"", "a.csv"),
        ("a.csv", b"name,x_mm,y_mm\na,1,2\na,3,4\n", "a.csv: region 'a', .*, not 2 of them"),
        ("a.npy", b"\x93NUMPY", "a.npy"),
        ("a.txt", b"", "regions are read from"),
    ],
)
def test_files_that_hold_no_regions(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_regions(tmp_path / name, maps_of(lambda x, y: -x))


@given(at=st.integers(0, 10_000), bit=st.integers(0, 7), cut=st.booleans())
def test_damaged_roi_files_are_refused_or_read(tmp_path_factory, at, bit, cut):
    folder = tmp_path_factory.getbasetemp()
    polygon = roifile.ImagejRoi.frompoints(np.array([(5.5, 5.5), (15.5, 5.5), (5.5, 25.5)]))
    content = bytearray(polygon.tobytes())
    at %= len(content)
    if cut:
        content = content[:at]
    else:
        content[at] ^= 1 << bit
    path = folder / "damaged.roi"
    path.write_bytes(content)
    maps = maps_of(lambda x, y: -x)
    with contextlib.suppress(InputError):
        for region in read_regions(path, maps):
            assert all(np.isfinite(o).all() for o in region.outlines)


@given(angle=st.floats(0, 6.28), width=st.floats(0, 0.4))
def test_a_profile_across_a_plane_is_a_straight_line(angle, width):
    maps = maps_of(lambda x, y: 2 * x - y)
    start = np.array([3.0, 1.0])
    end = start + 0.8 * np.array([np.cos(angle), np.sin(angle)])
    found = line_profile(maps, start, end, width)
    np.testing.assert_allclose(
        found["axial_stress"], 2 * found["x"].values - found["y"].values, atol=1e-9
    )
    assert float(found["distance"][-1]) == pytest.approx(0.8)
    assert found["axial_stress"].attrs["units"] == "kPa"


def test_a_profile_keeps_states_whole_and_has_no_value_outside():
    maps = maps_of(lambda x, y: x)
    maps["contact_state"] = (maps["axial_stress"] > 3).astype(np.int8) * 2
    found = line_profile(maps, (0.0, 0.5), (4.0, 0.5))
    assert set(found["contact_state"].dropna("distance").values) == {0, 2}
    assert np.isnan(found["axial_stress"][0])
    for wrong, message in (
        (((1, 1), (1, 1)), "same place"),
        ((1.0, (2, 2)), "start"),
        (((1, 1), "end"), "end"),
        (((50, 1), (60, 1)), "misses"),
    ):
        with pytest.raises(InputError, match=message):
            line_profile(maps, *wrong)
    with pytest.raises(InputError, match="a map alone is one by map"):
        line_profile(maps["axial_stress"], (0, 1), (1, 1))


def bumps(x, y):
    return -1 - np.exp(-((x - 2.2) ** 2 + (y - 0.9) ** 2) / 0.1) - np.exp(
        -((x - 3.6) ** 2 + (y - 1.7) ** 2) / 0.05
    )  # fmt: skip


def with_thickness(maps):
    return maps.assign(loaded_thickness=0.5 + 0.1 * maps["axial_stress"])


def test_two_results_are_compared_with_their_errors():
    first = maps_of(bumps, error=0.3)
    second = maps_of(lambda x, y: bumps(x, y) + 0.1 * (x > 3) + 1.0 * (y > 2), error=0.4)
    found = compare_results({"before": first, "after": second})
    assert found.attrs["reference"] == "before"
    assert list(found["result"].values) == ["before", "after"]
    np.testing.assert_allclose(found["axial_stress"].sel(result="after"), second["axial_stress"])
    np.testing.assert_allclose(
        found["difference"].sel(compared="after"),
        second["axial_stress"] - first["axial_stress"],
        atol=1e-12,
    )
    np.testing.assert_allclose(found["difference_error"], 0.5)
    assert float(found["within_error"][0]) == pytest.approx(float((Y <= 2).mean()))
    assert found["rms"].sizes == {"compared": 1, "zone": 3}
    without = compare_results({"before": first, "after": second.drop_vars("axial_stress_error")})
    assert "difference_error" not in without


def test_an_error_that_is_missing_does_not_spread():
    first, second = maps_of(bumps, error=0.3), maps_of(bumps, error=0.4)
    second["axial_stress_error"][5, 7] = np.nan
    found = compare_results({"before": first, "after": second})["difference_error"].sel(
        compared="after"
    )
    assert int(found.isnull().sum()) == 1


def test_grids_that_end_on_the_same_sides_share_their_borders():
    low, high = 0.9, 2.2
    ends = np.linspace(low, high, 9)
    off = np.linspace(np.nextafter(low, 1.0), np.nextafter(high, 1.0), 17)
    first, second = (maps_of(lambda x, y: x + y, 0.1, x=at, y=at) for at in (ends, off))
    for one, other in ((first, second), (second, first)):
        found = compare_results({"a": one, "b": other})
        assert found["difference"].notnull().all()
        assert found["difference_error"].notnull().all()
    mask = Region.of_mask("all", first["axial_stress"] > 0)
    assert (mask.weights(second["axial_stress"]) == 1).all()
    assert high + 1.0 * (low - high) < low
    for end in (low, high), (high, low):
        profile = line_profile(first, *[(at, at) for at in end])
        assert profile["axial_stress"].notnull().all()
        assert profile["x"].values[[0, -1]].tolist() == list(end)


def test_registration_takes_a_shift_back():
    first = with_thickness(maps_of(bumps))
    shifted = with_thickness(maps_of(lambda x, y: bumps(x - 0.3, y + 0.1)))
    found = compare_results({"a": first, "b": shifted}, register=True)
    np.testing.assert_allclose(found["shift"][0], [-0.1, 0.3], atol=0.01)
    loose = compare_results({"a": first, "b": shifted})
    at = {"compared": "b", "zone": "all"}
    assert float(found["rms"].sel(at)) < 0.1 * float(loose["rms"].sel(at))


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.4])
def test_registration_of_other_pixels_and_another_extent(factor):
    first = with_thickness(maps_of(bumps))
    step = factor * float(X[1] - X[0])
    x, y = np.arange(X[0], X[-1], step), np.arange(Y[0], Y[-1] - 0.3, step)
    shifted = with_thickness(maps_of(lambda x, y: bumps(x - 0.3, y + 0.1), x=x, y=y))
    found = compare_results({"a": first, "b": shifted}, register=True)
    np.testing.assert_allclose(found["shift"][0], [-0.1, 0.3], atol=0.03)
    at = {"compared": "b", "zone": "all"}
    loose = compare_results({"a": first, "b": shifted})
    assert float(found["rms"].sel(at)) < 0.3 * float(loose["rms"].sel(at))
    shared = float(found["difference"].notnull().mean())
    assert shared < 0.95
    assert f"on the {100 * shared:.0f} % of the map that both have" in comparison_in_words(found)


def test_registration_does_not_depend_on_where_a_scan_begins():
    first = with_thickness(maps_of(bumps))
    elsewhere = first.assign_coords(x=first["x"] + 7.0, y=first["y"] - 3.0)
    found = compare_results({"a": first, "b": elsewhere}, register=True)
    np.testing.assert_allclose(found["shift"][0], [-3.0, 7.0], atol=1e-9)
    assert float(found["rms"].sel(zone="all")[0]) < 1e-9


def test_results_that_cannot_be_compared():
    first = maps_of(bumps)
    with pytest.raises(InputError, match="at least two"):
        compare_results({"a": first})
    with pytest.raises(InputError, match="b: has no map"):
        compare_results({"a": first, "b": xr.Dataset()})
    with pytest.raises(InputError, match="to register by"):
        compare_results({"a": first, "b": first}, register=True)
    states = first.assign(contact_state=(first["axial_stress"] < -1).astype(np.int8))
    with pytest.raises(InputError, match="contact_state: holds states"):
        compare_results({"a": states, "b": states}, "contact_state")


@pytest.mark.parametrize(
    ("attrs", "words"), [({}, "0 ("), ({"units": "1"}, "0 ("), ({"units": "kPa"}, "0 kPa (")]
)
def test_a_comparison_says_the_unit_where_there_is_one(attrs, words):
    maps = maps_of(bumps)
    maps["axial_stress"].attrs = attrs
    text = comparison_in_words(compare_results({"a": maps, "b": maps}))
    assert f"rms difference {words}" in text
    assert "  " not in text.splitlines()[1].strip()


def test_the_error_of_a_modulus_is_a_share_of_it():
    maps = maps_of(lambda x, y: 4.0 + 0 * x * y)
    maps["sample_youngs_modulus"] = maps["axial_stress"].assign_attrs(units="kPa")
    maps["sample_modulus_error"] = 0.1 + 0 * maps["axial_stress"]
    region = Region.rectangle("all", 1.0, 2.0, 0.5, 1.5)
    found = region_statistics(maps, [region], "sample_youngs_modulus", None)
    assert float(found["mean_error"][0]) == pytest.approx(0.4)
    assert "force_error" not in found
