"""Figures for papers: what is in them is measured in the files, not asked of the code that drew."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from optical_palpation.analysis import Region
from optical_palpation.errors import InputError, OutputError
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present import write_maps, write_panel
from optical_palpation.present.figure import (
    colour_map,
    draw_map,
    figure_file,
    hatch_interpolated,
    new_figure,
)
from optical_palpation.present.panel import draw_panel, panel_height
from optical_palpation.present.summary import contact_share
from optical_palpation.present.terms import term

X, Y = np.linspace(0, 4, 33), np.linspace(1, 3, 17)


def result(computational=True):
    y, x = np.meshgrid(Y, X, indexing="ij")
    grid = ("y", "x")
    maps = xr.Dataset(
        {
            "axial_stress": (grid, -3 - np.sin(2 * x) * np.cos(3 * y), {"units": "kPa"}),
            "algebraic_axial_stress": (grid, -2 - np.sin(2 * x), {"units": "kPa"}),
            "loaded_thickness": (grid, 0.4 + 0.02 * x, {"units": "mm"}),
            "contact_state": (grid, (1 + (x > 2)).astype(np.int8)),
            "strain_energy": (
                grid,
                np.exp(-x),
                {"units": "kPa", "long_name": "strain energy"},
            ),
        },
        {"y": Y, "x": X},
    )
    if computational:
        maps["contact_pressure"] = -maps["axial_stress"]
    return StressResult(maps)


def size_in_mm(path):
    if path.suffix == ".png":
        picture = Image.open(path)
        return [n / d * 25.4 for n, d in zip(picture.size, picture.info["dpi"], strict=True)]
    root = ET.parse(path).getroot()
    return [float(root.get(k).removesuffix("pt")) * 25.4 / 72 for k in ("width", "height")]


def texts(path):
    root = ET.parse(path).getroot()
    return " ".join("".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text"))


@pytest.mark.parametrize("size", [(3.0, 12.0), (4.0, 4.0), (12.0, 3.0)])
def test_the_colour_bar_is_as_high_as_the_map(size):
    field = xr.DataArray(
        np.arange(81.0).reshape(9, 9),
        {"y": np.linspace(0, size[1], 9), "x": np.linspace(0, size[0], 9)},
        ("y", "x"),
    )
    with new_figure("double", 120.0) as figure:
        pair = figure.subplots(1, 2)
        for axes in pair:
            draw_map(axes, field, term(xr.Dataset({"axial_stress": field}), "axial_stress"))
        figure.canvas.draw()
        for axes in pair:
            (bar,) = axes.child_axes
            shaft, box = bar.get_window_extent(), axes.get_window_extent()
            assert shaft.height == pytest.approx(box.height, rel=0.08)  # tips may be added
            assert bar.get_tightbbox().x1 <= figure.bbox.x1
        assert pair[0].child_axes[0].get_tightbbox().x1 < pair[1].get_tightbbox().x0


def of_size(across, along):
    """The result on a field of other proportions."""
    maps = result().maps
    maps = maps.assign_coords(x=np.linspace(0, across, X.size), y=np.linspace(0, along, Y.size))
    return StressResult(maps)


@pytest.mark.parametrize("size", [(3.0, 8.0), (4.0, 4.0), (8.0, 3.0)])
def test_nothing_is_cut_off_at_the_border_of_a_figure(tmp_path, size):
    one = of_size(*size)
    names = ["axial_stress", "loaded_thickness", "contact_state", "strain_energy"]
    write_panel(one, tmp_path / "panel.png")
    write_maps(one, tmp_path / "double.png", names, width="double")
    write_maps(one, tmp_path / "single.png", names[1:3], width="single")
    for path in tmp_path.iterdir():
        picture = np.asarray(Image.open(path).convert("L"))
        rim = [picture[:2], picture[-2:], picture[:, :2], picture[:, -2:]]
        assert min(part.min() for part in rim) == 255, path.name


@pytest.mark.parametrize("size", [(4.0, 4.0), (8.0, 3.0)])
def test_names_of_contact_states_do_not_lie_on_each_other(tmp_path, size):
    maps = of_size(*size).maps
    with figure_file(tmp_path / "panel.png", "double", panel_height(maps)) as figure:
        draw_panel(maps, figure)
    found = [it for it in figure.findobj(Text) if it.get_visible() and " %" in it.get_text()]
    boxes = sorted((it.get_window_extent() for it in found), key=lambda box: box.y0)
    assert len(boxes) == 3
    assert all(lower.y1 < upper.y0 for lower, upper in pairwise(boxes))


def test_the_colour_bar_of_a_figure_without_a_layout_leaves_the_next_axes_alone():
    figure = Figure(figsize=(8.0, 3.5))
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        result().plot("loaded_thickness", ax=axes)
    figure.draw_without_rendering()
    for axes, bar in zip((left, right), figure.axes[2:], strict=True):
        shaft, box = bar.get_window_extent(), axes.get_window_extent()
        assert shaft.height == pytest.approx(box.height, rel=0.08)
        assert bar.get_tightbbox().x0 > box.x1
    assert figure.axes[2].get_tightbbox().x1 < right.get_tightbbox().x0


@pytest.mark.parametrize(("width", "height"), [(4.0, 2.0), (4.0, 4.2), (20.0, 12.0), (0.3, 0.25)])
def test_ticks_are_as_far_apart_along_both_axes(width, height):
    field = xr.DataArray(
        np.ones((9, 9)),
        {"y": np.linspace(0, height, 9), "x": np.linspace(0, width, 9)},
        ("y", "x"),
        name="axial_stress",
    )
    with new_figure("single") as figure:
        axes = figure.subplots()
        draw_map(axes, field, term(field.to_dataset(), "axial_stress"))
        figure.draw_without_rendering()
        steps = [np.diff(axis.get_majorticklocs()) for axis in (axes.xaxis, axes.yaxis)]
    assert steps[0][0] == pytest.approx(steps[1][0])
    assert all(len(step) >= 2 for step in steps)


@pytest.mark.parametrize("ending", ["png", "svg"])
@pytest.mark.parametrize(("width", "mm"), [("single", 85), ("double", 178), (120.0, 120)])
def test_a_figure_is_as_wide_as_its_column(tmp_path, ending, width, mm):
    path = tmp_path / f"f.{ending}"
    write_maps(result(), path, width=width)
    assert size_in_mm(path)[0] == pytest.approx(mm, abs=0.2)


def test_terms_are_words_with_units_and_panels_have_letters(tmp_path):
    path = tmp_path / "f.svg"
    names = ["axial_stress", "algebraic_axial_stress", "loaded_thickness", "strain_energy"]
    write_maps(result(), path, names, width="double")
    said = texts(path)
    for words in (
        "Axial stress, computational (kPa)",
        "Axial stress, algebraic (kPa)",
        "Loaded thickness (mm)",
        "Strain energy (kPa)",
    ):
        assert words in said
    assert "_" not in said
    plain = re.sub(r"\s", "", said)
    assert all(f"({letter})" in plain for letter in "abcd")
    assert "(e)" not in plain


def test_a_figure_is_vectors_with_pixels_only_where_maps_are(tmp_path):
    write_maps(result(), tmp_path / "f.svg", ["axial_stress"])
    text = (tmp_path / "f.svg").read_text()
    # the map and its colour bar
    assert 1 <= text.count("<image") <= 2
    assert "x (mm)" in texts(tmp_path / "f.svg")
    write_maps(result(), tmp_path / "f.pdf", ["axial_stress"])
    content = (tmp_path / "f.pdf").read_bytes()
    assert b"/TrueType" in content or b"/Type0" in content
    assert b"/Type3" not in content


def test_the_same_result_gives_the_same_file(tmp_path):
    for name in ("a.svg", "b.svg", "a.pdf", "b.pdf"):
        write_maps(result(), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


def test_fractions_are_shown_in_percent(tmp_path):
    maps = result().maps
    share = 0.014 * maps["x"] / maps["x"].max() + 0 * maps["axial_stress"]
    maps["edge_influence"] = share.drop_attrs()
    maps["sample_modulus_error"] = maps["edge_influence"].assign_attrs(units="1")
    write_maps(maps, tmp_path / "f.svg", ["edge_influence", "sample_modulus_error"])
    said = texts(tmp_path / "f.svg")
    assert "Influence of the sides (%)" in said
    assert "95 % band of the modulus, ± (%)" in said
    axes = StressResult(maps).plot("edge_influence", ax=Figure().subplots())
    assert axes.collections[0].get_array().max() == pytest.approx(1.4)
    assert float(maps["edge_influence"].max()) == pytest.approx(0.014)


def test_contact_is_the_share_of_the_area_that_the_summary_gives(tmp_path):
    coarse = result().maps.isel(x=slice(None, None, 8), y=slice(None, None, 4))
    write_maps(coarse, tmp_path / "f.svg", ["contact_state"])
    said = texts(tmp_path / "f.svg")
    # of five columns the last two stick, and of the last one half lies in the map
    assert contact_share(coarse, ContactState.STICK) == pytest.approx(0.375)
    assert "slip 62 %" in said
    assert "stick 38 %" in said


def test_profiles_of_the_panel_have_the_error_of_inputs_and_mesh():
    maps = result().maps
    for name, error in {"axial_stress_error": 0.3, "axial_stress_mesh_error": 0.4}.items():
        maps[name] = xr.full_like(maps["axial_stress"], error)
    with new_figure("double", 120.0) as figure:
        draw_panel(maps, figure)
        (profile,) = (axes for axes in figure.axes if axes.get_title(loc="left") == "y = 2 mm")
        band = profile.collections[0].get_paths()[0].vertices
    ends = band[band[:, 0] == X[0], 1]
    assert ends.max() - ends.min() == pytest.approx(1.0)


def test_what_was_interpolated_is_hatched_and_said_so(tmp_path):
    whole = result()
    gap = (whole.maps["x"] > 1) & (whole.maps["x"] < 2) & (whole.maps["y"] > 2)
    pictures = {}
    for name, filled in {"whole": gap & False, "gap": gap}.items():
        one = StressResult(whole.maps.assign(filled=filled.transpose("y", "x")))
        write_panel(one, tmp_path / f"{name}-panel.svg")
        write_maps(one, tmp_path / f"{name}-map.svg", ["axial_stress"])
        for kind in ("panel", "map"):
            said = texts(tmp_path / f"{name}-{kind}.svg")
            assert ("interpolated" in said) == (name == "gap")
        with new_figure("single", 60) as figure:
            axes = figure.subplots()
            draw_map(axes, one.maps["axial_stress"], term(one.maps, "axial_stress"))
            hatch_interpolated([axes], one.maps)
            figure.canvas.draw()
            pictures[name] = np.asarray(figure.canvas.buffer_rgba())
            at = axes.transData.transform([[1.2, 2.2], [1.8, 2.8], [2.5, 1.2], [3.5, 1.8]])
    changed = (pictures["whole"] != pictures["gap"]).any(-1)[::-1]
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = at.astype(int)
    assert changed[y0:y1, x0:x1].any()
    assert not changed[y2:y3, x2:x3].any()


def test_a_scale_bar_takes_the_place_of_axes(tmp_path):
    write_maps(result(), tmp_path / "f.svg", scale_bar=True)
    said = texts(tmp_path / "f.svg")
    assert "1 mm" in said
    assert "x (mm)" not in said


@pytest.mark.parametrize(("scale", "text"), [(1.0, "1 mm"), (0.1, "0.1 mm"), (0.01, "10 µm")])
def test_a_scale_bar_is_a_round_quarter_of_the_map(scale, text):
    maps = result().maps
    maps = maps.assign_coords(x=maps["x"] * scale, y=maps["y"] * scale)
    with new_figure("single", 60) as figure:
        axes = figure.subplots()
        draw_map(axes, maps["axial_stress"], term(maps, "axial_stress"), scale_bar=True)
        (bar,) = axes.artists
        assert bar.txt_label.get_text() == text
        length = bar.size_bar.get_children()[0].get_width()
        assert 0.1 < length / (4.125 * scale) <= 0.25


def test_limits_are_those_that_were_chosen_and_shared():
    maps = result().maps
    with new_figure() as figure:
        axes = figure.subplots()
        what = term(maps, "axial_stress")
        mesh = draw_map(axes, maps["axial_stress"], what, limits=(-4.0, 0.0))
    assert mesh.get_clim() == (-4.0, 0.0)


def test_maps_of_one_kind_share_their_limits(tmp_path, monkeypatch):
    seen = {}
    from optical_palpation.present import figure as module

    def watched(axes, field, what, **options):
        seen[what.words] = options["limits"]
        return draw_map(axes, field, what, **options)

    monkeypatch.setattr(module, "draw_map", watched)
    names = ["axial_stress", "algebraic_axial_stress", "loaded_thickness"]
    write_maps(result(), tmp_path / "f.png", names, width="double")
    assert seen["Axial stress, computational"] == seen["Axial stress, algebraic"]
    assert seen["Loaded thickness"] != seen["Axial stress, algebraic"]
    write_maps(result(), tmp_path / "f.png", names, limits={"algebraic_axial_stress": (-9, 0)})
    assert seen["Axial stress, computational"] == (-9.0, 0.0)


def with_pixels():
    """The result with what is known on pixels that are ten times as small as the elements."""
    it = result()
    x, y = np.linspace(0, 4, 321), np.linspace(1, 3, 161)
    return replace(
        it, pixels=it.maps[["algebraic_axial_stress", "loaded_thickness"]].interp(x=x, y=y)
    )


def test_single_maps_are_as_fine_as_those_of_the_panel(tmp_path, monkeypatch):
    from optical_palpation.present import figure as module

    seen = {}

    def watched(axes, field, what, **options):
        seen[field.name] = field.shape, axes, options
        return draw_map(axes, field, what, **options)

    monkeypatch.setattr(module, "draw_map", watched)
    names = ["axial_stress", "algebraic_axial_stress", "loaded_thickness"]
    write_maps(with_pixels(), tmp_path / "f.png", names)
    assert [seen[name][0] for name in names] == [(17, 33), (161, 321), (161, 321)]
    frames = {(*axes.get_xlim(), *axes.get_ylim()) for _, axes, _ in seen.values()}
    assert len(frames) == 1
    axes = with_pixels().plot("loaded_thickness", ax=Figure().subplots())
    assert axes.collections[0].get_array().shape == (161, 321)


def test_maps_of_the_panel_show_the_same_part_of_the_plane():
    it = with_pixels()
    with new_figure() as figure:
        draw_panel(it.maps, figure, it.pixels)
    maps = [axes for axes in figure.axes if axes.get_xlabel().startswith("x") and axes.collections]
    maps = [axes for axes in maps if axes.get_ylabel() == "y (mm)"]
    assert len(maps) == 4
    for axes in maps:  # what pixels cover, half of one beyond their centres
        assert axes.get_xlim() == pytest.approx((-0.00625, 4.00625))
        assert axes.get_ylim() == pytest.approx((0.99375, 3.00625))


def lightness(colours):
    """CIE L* of sRGB colours."""
    rgb = np.asarray(colours)[:, :3]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(luminance > 0.008856, 116 * np.cbrt(luminance) - 16, 903.3 * luminance)


@pytest.mark.parametrize("name", ["viridis_r", "viridis", "cividis", "magma"])
def test_lightness_of_colour_maps_runs_one_way(name):
    steps = np.diff(lightness(colour_map(name)(np.linspace(0, 1, 64))))
    assert (steps > 0).all() or (steps < 0).all()


def test_lightness_of_the_diverging_map_is_symmetric():
    levels = lightness(colour_map("vik")(np.linspace(0, 1, 65)))
    assert np.argmax(levels) in range(30, 35)
    assert np.abs(levels - levels[::-1]).max() < 12


def test_regions_are_outlined_by_name(tmp_path):
    regions = [
        Region.rectangle("dense", 0.5, 1.5, 1.2, 2.0),
        Region.of_mask("soft", (result().maps["axial_stress"] * 0 + result().maps["x"]) > 3),
    ]
    write_maps(result(), tmp_path / "f.svg", regions=regions)
    assert "dense" in texts(tmp_path / "f.svg")
    assert "soft" in texts(tmp_path / "f.svg")


def drawn(regions):
    """Axes with the map and regions on it."""
    maps = result().maps
    with new_figure("single", 60) as figure:
        axes = figure.subplots()
        draw_map(axes, maps["axial_stress"], term(maps, "axial_stress"), regions=regions)
        figure.draw_without_rendering()
    return axes


def test_a_mask_is_outlined_along_the_edges_of_its_pixels():
    x, y = result().maps["x"], result().maps["y"]
    mask = ((x >= 3) & (y > 2.5)) | ((x < 1) & (y < 1.3) & (y > 1.1))
    axes = drawn([Region.of_mask("corner and island", mask.transpose("y", "x"))])
    corners = [line.get_xydata() for line in axes.lines]
    assert all(np.array_equal(line[0], line[-1]) for line in corners)
    at = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in corners])
    np.testing.assert_allclose((at[..., 0] / 0.125) % 1, 0.5)  # half way between pixels
    np.testing.assert_allclose((at[..., 1] / 0.125) % 1, 0.5)
    # closed at the border of the map, too: 9 x 4 and 8 x 2 pixels
    assert np.abs(np.diff(at, axis=1)).sum() == pytest.approx(0.125 * (2 * (9 + 4) + 2 * (8 + 2)))


def test_names_of_regions_are_at_the_centres_of_their_areas():
    corners = [(0.5, 1.5), (0.6, 1.5), (0.7, 1.5), (0.8, 1.5), (3.5, 1.5), (3.5, 2.5), (0.5, 2.5)]
    (label,) = drawn([Region.polygon("a", corners)]).texts
    assert label.get_position() == pytest.approx((2.0, 2.0))


def test_names_of_regions_neither_lie_on_each_other_nor_cross_the_map():
    long = "the upper part of the second specimen before it was cut, region "
    regions = [
        Region.ellipse("core", (2, 2), (0.3, 0.3)),
        Region.ellipse("surroundings", (2, 2), (0.8, 0.8)),
        Region.rectangle(f"{long} 1", 0.1, 0.4, 1.1, 1.4),
        Region.rectangle(f"{long} 2", 0.5, 0.8, 1.1, 1.4),
    ]
    axes = drawn(regions)
    boxes = [text.get_window_extent() for text in axes.texts]
    whole = axes.get_window_extent()
    for k, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:k])
        assert whole.x0 <= box.x0
        assert box.width < 0.6 * whole.width
    names = [text.get_text() for text in axes.texts]
    assert names[:2] == ["core", "surroundings"]
    assert len(set(names)) == 4  # still told apart


def test_options_that_cannot_be_used_leave_nothing(tmp_path):
    path = tmp_path / "f.png"
    with pytest.raises(InputError, match="known are axial_stress"):
        write_maps(result(), path, ["strain"])
    with pytest.raises(InputError, match="lowest and highest"):
        write_maps(result(), path, limits=(1.0, 0.0))
    with pytest.raises(InputError, match="limits: the maps are in kPa and mm"):
        write_maps(result(), path, ["axial_stress", "loaded_thickness"], limits=(-5.0, 0.0))
    with pytest.raises(InputError, match="did you mean viridis"):
        write_maps(result(), path, colours="virids")
    with pytest.raises(InputError, match="'single', 'double'"):
        write_maps(result(), path, width="triple")
    with pytest.raises(InputError, match="at least one"):
        write_maps(result(), path, [])
    with pytest.raises(OutputError, match="ends in"):
        write_maps(result(), tmp_path / "f.gif")
    with pytest.raises(InputError, match="legible, not 85 mm"):
        write_panel(result(), path, width="single")
    assert not list(tmp_path.iterdir())


def test_where_a_figure_is_from_is_in_its_file(tmp_path):
    it = result()
    it.maps.attrs["window_friction"] = 0.15
    write_panel(it, tmp_path / "f.png")
    assert "window_friction 0.15" in Image.open(tmp_path / "f.png").info["Description"]
    write_panel(it, tmp_path / "f.svg")
    assert "window_friction 0.15" in (tmp_path / "f.svg").read_text()


@pytest.mark.parametrize(("width", "columns"), [(20, 1), (60, 3)])
def test_a_figure_without_room_is_refused(tmp_path, width, columns):
    names = ["axial_stress", "algebraic_axial_stress", "loaded_thickness"]
    with pytest.raises(InputError, match=f"width: {width} mm leave no room"):
        write_maps(result(), tmp_path / "a.png", names, width=width, columns=columns)
    assert not list(tmp_path.iterdir())
