"""The plugin without Qt: what it shows, what was drawn, and the study that is worked on."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from optical_palpation.analysis import Region, read_regions, traced, write_regions
from optical_palpation.errors import InputError, MaterialError, OutputError
from optical_palpation.present.terms import STATES
from optical_palpation.study import read_study, run_study
from optical_palpation.thickness import Corrections
from optical_palpation.thickness.corrections import Anchor, Exclusion
from optical_palpation.viewer.layers import (
    COLOURS,
    KEY,
    Frame,
    anchor_layer,
    boundary_layers,
    corrections_from,
    exclusion_layer,
    map_layers,
    region_layer,
    regions_from,
    volume_layer,
)
from optical_palpation.viewer.session import Session
from optical_palpation.volume import open_volume
from study_case import STUDY, UNLOADED, make_study, make_volumes
from volume_samples import WRITERS, volume

FRAME = Frame((0.003, 0.02, 0.01), (0.1, -0.2, 0.3), (100, 50, 80))


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_is_shown_in_mm_with_the_samples_of_its_file(tmp_path, kind):
    path, how = WRITERS[kind](tmp_path, volume())
    with open_volume(path, **how) as opened:
        layer = volume_layer(opened, str(path), how)
        about = opened.metadata
        assert layer.kind == "image"
        assert layer.keywords["scale"] == tuple(about.spacing)
        assert layer.keywords["translate"] == tuple(about.origin)
        assert layer.keywords["units"] == ("mm", "mm", "mm")
        assert layer.keywords["metadata"][KEY]["input"] == {"volume": str(path), **how}
        assert layer.data.shape == about.shape
        for y in range(about.shape[1]):
            assert np.array_equal(layer.data[:, y, :], np.abs(opened.bscan(y)))
        assert np.array_equal(layer.data[2, 1:3, ::2], np.asarray(layer.data)[2, 1:3, ::2])


def test_limits_of_decibels_may_be_negative(tmp_path):
    np.save(tmp_path / "a.npy", -volume())
    how = {"axes": "zyx", "spacing": {"z": 0.003, "y": 0.01, "x": 0.01}, "scale": "dB"}
    with open_volume(tmp_path / "a.npy", **how) as opened:
        low, high = volume_layer(opened, "a.npy", how).keywords["contrast_limits"]
    assert low < high < 0


def found(shape=(50, 80)) -> xr.Dataset:
    y, x = (FRAME.origin[i] + FRAME.spacing[i] * np.arange(FRAME.shape[i]) for i in (1, 2))
    random = np.random.default_rng(3)
    top = 0.15 + 0.01 * random.random(shape)
    here = {"y": y, "x": x}
    window, sample = random.random((2, *shape)) < 0.1
    return xr.Dataset(
        {
            "window_depth": (("y", "x"), top),
            "sample_depth": (("y", "x"), top + 0.1),
            "filled": (("y", "x"), window | sample),
            "window_filled": (("y", "x"), window),
            "sample_filled": (("y", "x"), sample),
        },
        here,
    )


def test_boundaries_lie_where_they_were_found():
    layer = found()
    for shown, name in zip(boundary_layers(layer, FRAME, "loaded"), ("window", "sample"),
                           strict=True):  # fmt: skip
        assert shown.keywords["name"] == f"loaded: {name} side"
        ends = shown.data * shown.keywords["scale"]
        ends[:, 0] += shown.keywords["translate"]
        z, y, x = ends[:, 0].reshape(50, 79, 3).transpose(2, 0, 1)
        assert np.allclose(z, layer[f"{name}_depth"].values[:, :-1], atol=1e-6)
        assert np.allclose(y, layer["y"].values[:, None])
        assert np.allclose(x, layer["x"].values[:-1])
        assert np.allclose(ends[:, 1, 2], FRAME.spacing[2])  # from A-scan to A-scan
        colours = shown.keywords["edge_color"].reshape(50, 79)
        filled = layer[f"{name}_filled"].values
        made_up = filled[:, :-1] | filled[:, 1:]
        assert (colours[made_up] == COLOURS["filled"]).all()
        assert (colours[~made_up] == COLOURS[name]).all()


inside = {
    axis: st.floats(start, start + (n - 1) * step)
    for axis, start, n, step in zip("zyx", FRAME.origin, FRAME.shape, FRAME.spacing, strict=True)
}
sides = st.sampled_from(["window", "sample"])


@given(
    anchors=st.lists(st.builds(Anchor, sides, inside["x"], inside["y"], inside["z"])),
    exclusions=st.lists(
        st.builds(
            lambda side, x, y: Exclusion(side, *sorted(x), *sorted(y)),
            sides,
            st.tuples(inside["x"], inside["x"]),
            st.tuples(inside["y"], inside["y"]),
        )
    ),
)
def test_corrections_that_are_shown_and_taken_back_are_the_same(anchors, exclusions):
    given = Corrections(tuple(anchors), tuple(exclusions))
    points, shapes = anchor_layer(given, FRAME, "loaded"), exclusion_layer(given, FRAME, "loaded")
    back = corrections_from(
        points.data,
        list(points.keywords["features"]["boundary"]),
        shapes.data,
        list(shapes.keywords["features"]["boundary"]),
        FRAME,
    )
    assert back.exclusions == given.exclusions
    for a, b in zip(back.anchors, given.anchors, strict=True):
        assert a.boundary == b.boundary
        assert np.allclose(a[1:], b[1:], rtol=0, atol=1e-12)


def test_corrections_outside_the_volume_are_refused():
    with pytest.raises(InputError, match="outside the volume"):
        corrections_from([[0, 0, 500]], ["sample"], [], [], FRAME)
    with pytest.raises(InputError, match="window or sample"):
        corrections_from([[0, 0, 5]], ["top"], [], [], FRAME)


def maps() -> xr.Dataset:
    x = np.linspace(0, 2, 21)
    wave = np.sin(x) * np.ones((11, 1))
    here = {"y": np.linspace(1, 2, 11), "x": x}
    kpa = {"units": "kPa"}
    return xr.Dataset(
        {
            "axial_stress": (("y", "x"), -5 - 3 * wave, kpa),
            "algebraic_axial_stress": (("y", "x"), -2 - wave, kpa),
            "contact_pressure": (("y", "x"), 5 + wave, kpa),
            "contact_state": (("y", "x"), (wave > 0.5).astype(np.int8)),
            "quality": (("y", "x"), wave, {"units": "1"}),
            "total": ((), 3.0),
        },
        here,
    )


def test_maps_lie_where_their_points_are_however_these_are_spaced():
    at = {"y": np.linspace(1.0, 0.0, 11), "x": np.linspace(0.0, 1.0, 41) ** 2}
    place = xr.DataArray(at["x"], {"x": at["x"]}, "x") + xr.DataArray(at["y"], {"y": at["y"]}, "y")
    (layer,) = map_layers(xr.Dataset({"thickness": place.assign_attrs(units="mm")}))
    y, x = (
        first + step * np.arange(count)
        for first, step, count in zip(
            layer.keywords["translate"], layer.keywords["scale"], layer.data.shape, strict=True
        )
    )
    assert np.abs(layer.data - (y[:, None] + x)).max() < np.diff(at["x"]).max()


def test_maps_carry_units_and_those_of_a_kind_share_their_limits():
    layers = {layer.keywords["metadata"][KEY]["variable"]: layer for layer in map_layers(maps())}
    assert set(layers) == set(maps().data_vars) - {"total"}
    computed, algebraic = layers["axial_stress"], layers["algebraic_axial_stress"]
    assert computed.keywords["name"] == "Axial stress, computational (kPa)"
    assert layers["quality"].keywords["name"] == "Quality of the boundaries"
    assert computed.keywords["contrast_limits"] == algebraic.keywords["contrast_limits"]
    assert (
        computed.keywords["contrast_limits"]
        != layers["contact_pressure"].keywords["contrast_limits"]
    )
    assert computed.keywords["scale"] == pytest.approx([0.1, 0.1])
    assert computed.keywords["translate"] == [1.0, 0.0]
    assert np.array_equal(computed.data, maps()["axial_stress"].values.astype(np.float32))
    assert len(layers["contact_state"].keywords["colormap"]["colors"]) == len(STATES)
    said = layers["contact_state"].keywords["metadata"][KEY]["caption"]
    assert said.endswith("Contact with the sample\n0 open, 1 slip, 2 stick, 3 glued")


def test_regions_that_are_drawn_and_written_are_those_that_the_command_reads(tmp_path):
    corners = np.array([[1.2, 0.2], [1.2, 1.2], [1.8, 1.2], [1.8, 0.2]])  # y, x
    turned = np.array([[1.3, 0.9], [1.5, 1.1], [1.7, 0.9], [1.5, 0.7]])
    drawn = regions_from(
        [corners, turned, turned, corners[:2]],
        ["rectangle", "ellipse", "polygon", "line"],
        ["nodule", "", "nodule", ""],
    )
    assert [region.name for region in drawn] == ["nodule", "region 2", "nodule 3"]
    whole = maps()["axial_stress"]
    areas = [float(region.weights(whole).sum()) * 0.01 for region in drawn]
    assert areas[0] == pytest.approx(0.6, rel=1e-6)
    assert areas[1] == pytest.approx(np.pi * 0.02, rel=0.04)  # of a turned box, 0.2828 wide
    assert areas[2] == pytest.approx(0.08, rel=0.04)
    write_regions(drawn, tmp_path / "regions.csv")
    again = read_regions(tmp_path / "regions.csv", whole)
    assert [r.name for r in again] == [r.name for r in drawn]
    for a, b in zip(again, drawn, strict=True):
        assert a.weights(whole).equals(b.weights(whole))
    shown = region_layer(maps(), again)
    back = regions_from(shown.data, ["polygon"] * 3, shown.keywords["features"]["name"])
    assert all(a.weights(whole).equals(b.weights(whole)) for a, b in zip(back, drawn, strict=True))


def test_without_a_region_it_says_what_to_draw():
    with pytest.raises(InputError, match="draw a rectangle"):
        regions_from([np.zeros((2, 2))], ["line"], [""])


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    make_volumes(folder)
    return make_study(folder)


ANCHOR = Corrections(
    (Anchor("sample", 0.6, 0.6, 0.06 + 0.35),), (Exclusion("sample", 0.9, 1.2, 0.0, 0.3),)
)


def test_a_saved_session_runs_to_the_same_bits(study_file, tmp_path):
    session = Session.open(study_file)
    first = session.find("loaded")
    session.corrections["loaded"] = ANCHOR
    assert not session.find("loaded")["thickness"].equals(first["thickness"])
    session.change({"friction.window": 0.2, "outputs.write": []})
    reports = []
    result = session.solve(reports.append)
    assert {"thickness", "preparing"} < {report.stage for report in reports}
    session.save(tmp_path / "mine.toml")
    done = run_study(read_study(tmp_path / "mine.toml"))
    assert done.folder == tmp_path / "mine-results"
    again = xr.load_dataset(done.folder / "stress.nc", engine="h5netcdf")
    for name, field in result.maps.data_vars.items():
        assert np.array_equal(again[name].values, field.values, equal_nan=field.dtype.kind == "f")
    assert again.attrs["sample_force_mN"] == result.maps.attrs["sample_force_mN"]
    reopened = Session.open(tmp_path / "mine.toml")
    assert reopened.corrections == {"loaded": ANCHOR}
    assert reopened.tables["friction"] == {"window": 0.2, "sample": 0.05}
    session.close()


def test_a_session_finds_again_only_what_has_changed(study_file, tmp_path):
    session = Session.open(study_file)
    thickness = session.thickness()
    session.change({"friction.window": 0.3, "material.c10": 3.0})
    assert session.thickness() is thickness
    session.change({"layer.extent": [0.1, 1.2, 0.1, 1.0]})
    cropped = session.thickness()
    assert cropped is not thickness
    loaded = session.find("loaded")
    session.change({"layer.extent": None})
    assert session.thickness()["loaded_thickness"].equals(thickness["loaded_thickness"])
    assert session.find("loaded").identical(loaded)
    session.change({"unloaded.sample_range": [0.2, 0.6]})
    assert session.thickness() is not thickness
    session.close()


def test_a_volume_that_changed_on_the_disk_is_read_again(tmp_path):
    make_volumes(tmp_path)
    session = Session.open(make_study(tmp_path, STUDY.replace(
        '[unloaded]\nvolume = "unloaded.npy"', "[unloaded]\nthickness = 0.45"
    )))  # fmt: skip
    before = session.thickness()
    (tmp_path / "loaded.npy").unlink()
    np.save(tmp_path / "loaded.npy", np.load(tmp_path / "unloaded.npy"))
    after = session.thickness()
    inner = np.s_[5:-5, 5:-5]
    off = after["loaded_thickness"].values - UNLOADED
    assert np.abs(off[inner]).max() < 0.01
    assert not after["loaded_thickness"].equals(before["loaded_thickness"])
    session.close()


def test_what_is_missing_is_named(study_file, tmp_path):
    session = Session()
    with pytest.raises(InputError, match="no volume"):
        session.find("loaded")
    session.change({"loaded": {"volume": str(study_file.parent / "loaded.npy")}})
    with pytest.raises(InputError, match=r"axes \("):
        session.find("loaded")
    with pytest.raises(InputError, match="material: is missing"):
        session.solve()
    with pytest.raises(InputError, match="find the layer"):
        session.frame("loaded")
    whole = Session.open(study_file)
    with pytest.raises(OutputError, match=r"ends in \.toml"):
        whole.save(tmp_path / "study.txt")
    whole.change({"material.c10": -1.0})
    with pytest.raises(MaterialError):
        whole.save(tmp_path / "study.toml")
    assert not list(tmp_path.iterdir())


@given(st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=5, max_size=5))
def test_the_outline_of_a_mask_holds_its_pixels_and_no_others(rows):
    pixels = np.array(rows)
    here = {"y": 0.2 + 0.3 * np.arange(5), "x": -0.1 + 0.1 * np.arange(6)}
    like = xr.DataArray(np.zeros(pixels.shape), here, dims=("y", "x"))
    if not pixels.any():
        return
    outlined = traced(Region.of_mask("mask", like.copy(data=pixels)))
    assert np.array_equal(outlined.weights(like).values, pixels)
    for outline in outlined.outlines:  # what napari can fill: none meets itself
        assert len({tuple(corner) for corner in outline}) == len(outline)
    # drawn as shapes and taken back, holes are holes
    drawn = region_layer(like.to_dataset(name="stress"), [outlined])
    names, wholes = (list(drawn.keywords["features"][key]) for key in ("name", "part of"))
    (back,) = regions_from(drawn.data, ["polygon"] * len(names), names, wholes)
    assert np.array_equal(back.weights(like).values, pixels)


def test_names_that_are_numbers_of_others_stay_apart():
    square = np.array([(0, 0), (0, 1), (1, 1), (1, 0)], float)
    named = regions_from([square] * 4, ["polygon"] * 4, ["a", "region 3", "", "a"])
    assert [region.name for region in named] == ["a", "region 3", "region 3 2", "a 4"]
