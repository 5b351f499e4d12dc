"""Fields in tiles: the tiles, their blending, and one map of all of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from optical_palpation.analysis.maps import area_mean
from optical_palpation.batch import field, field_stress
from optical_palpation.batch.field import remove_tiles
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.palpation import plausibility
from optical_palpation.palpation.meshing import imprint_of
from optical_palpation.palpation.submodel import submodel_inputs, submodel_stress
from optical_palpation.palpation.tiling import Blend, tiled
from optical_palpation.present import percent, read_result
from submodel_case import THICKNESS, error, relief, whole

LENGTHS = st.floats(0.3, 6.0)


@st.composite
def tilings(draw):
    size = draw(st.floats(0.05, 0.2)), draw(st.floats(0.05, 0.2)), 0.1
    x0, y0 = draw(st.floats(-5, 5)), draw(st.floats(-5, 5))
    width, height = draw(LENGTHS), draw(LENGTHS)
    overlap = draw(st.floats(4.01, 12)) * max(size[:2])
    tile = draw(st.floats(2.0, 6.0)) * overlap
    assume(width / size[0] * height / size[1] < 4e3)
    assume(min(width, height) > 2 * max(size))
    return tiled((x0, x0 + width, y0, y0 + height), size, tile, overlap)


@given(tilings())
def test_weights_of_tiles_add_up_to_one_everywhere(tiling):
    total = np.zeros((len(tiling.y), len(tiling.x)))
    count = np.zeros_like(total)
    for tile in tiling.tiles:
        (j0, j1), (i0, i1) = tile.rows, tile.columns
        weights = tiling.weights(tile)
        assert (weights > 0).all()
        total[j0 : j1 + 1, i0 : i1 + 1] += weights
        count[j0 : j1 + 1, i0 : i1 + 1] += 1
    assert_allclose(total, 1.0, rtol=1e-12)
    assert count.max() <= 4  # no more than neighbours meet


def part_of(maps: xr.Dataset, tile) -> xr.Dataset:
    (j0, j1), (i0, i1) = tile.rows, tile.columns
    return maps.isel(y=slice(j0, j1 + 1), x=slice(i0, i1 + 1)).copy(deep=True)


def maps_on(tiling) -> xr.Dataset:
    x, y = tiling.x, tiling.y
    stress = -3 + np.sin(5 * x) * np.cos(4 * y)[:, None]
    state = (stress > -3).astype(np.int8)
    return xr.Dataset(
        {"axial_stress": (("y", "x"), stress), "contact_state": (("y", "x"), state)},
        {"y": y, "x": x},
    )


@given(tilings())
def test_tiles_that_agree_give_the_field_back(tiling):
    expected, blend = maps_on(tiling), Blend(tiling)
    for tile in tiling.tiles:
        blend.add(tile, part_of(expected, tile))
    found = blend.maps()
    assert_allclose(found["axial_stress"], expected["axial_stress"], rtol=1e-12)
    assert (found["contact_state"] == expected["contact_state"]).all()
    assert found["contact_state"].dtype == np.int8
    assert found.attrs.get("seam_error", 0.0) == 0.0


def test_tiles_that_differ_blend_smoothly_and_say_by_how_much():
    tiling = tiled((0.0, 4.0, 0.0, 1.0), (0.05, 0.05, 0.1), 2.0, 0.4)
    assert tiling.shape == (1, 2)
    blend = Blend(tiling)
    for tile, level in zip(tiling.tiles, (-2.0, -2.5), strict=True):
        maps = part_of(maps_on(tiling), tile)
        maps["axial_stress"][:] = level
        blend.add(tile, maps)
    found = blend.maps()
    profile = found["axial_stress"].values[3]
    assert profile[0] == -2.0
    assert profile[-1] == -2.5
    assert (np.diff(profile) <= 0).all()
    assert np.abs(np.diff(profile)).max() < 0.5 / 8 * 1.6  # a ramp over eight elements, no step
    shared = np.isfinite(found["axial_stress_seam_error"].values)
    assert_allclose(found["x"].values[shared[0]][[0, -1]], [1.8, 2.2])
    assert_allclose(found["axial_stress_seam_error"].values[shared], 0.5)
    assert found.attrs["seam_error"] == pytest.approx(0.5 / 2.26, rel=0.01)
    assert found.attrs["seam_error_largest_kPa"] == 0.5


def test_a_tile_without_maps_is_a_hole_and_maps_of_another_tile_are_refused():
    tiling = tiled((0.0, 4.0, 0.0, 4.0), (0.1, 0.1, 0.1), 2.0, 0.6)
    blend = Blend(tiling)
    for tile in tiling.tiles[:3]:
        blend.add(tile, part_of(maps_on(tiling), tile))
    stress = blend.maps()["axial_stress"]
    assert bool(stress.sel(x=slice(2.35, 4), y=slice(2.35, 4)).isnull().all())
    assert int(stress.isnull().sum()) == 17**2  # and nothing beyond that
    with pytest.raises(ValueError, match="tile-2-2: maps on other points"):
        blend.add(tiling.tiles[3], part_of(maps_on(tiling), tiling.tiles[0]))


@pytest.mark.parametrize(
    ("width", "overlap", "told"),
    [
        (1.0, 0.1, "at least 0.2 mm, 4 elements"),
        (0.5, 0.3, "tile must be at least 0.6 mm"),
        (np.nan, 0.3, "tile must be"),
        (1.0, np.nan, "overlap must be"),
    ],
)
def test_tiles_that_cannot_be(width, overlap, told):
    with pytest.raises(InputError, match=told):
        tiled((0.0, 2.0, 0.0, 2.0), (0.05, 0.05, 0.1), width, overlap)


# --------------------------------------------------------------------------------- with a solver


@pytest.fixture(scope="module")
def coarse():
    return whole(0.1)


@pytest.fixture
def here(monkeypatch):
    """Compute the tiles in this process, as a worker would; gives what became of each."""
    outcomes = {}

    class Dispatcher:
        def __init__(self, crew, work, jobs, needs, found, tell):
            self.work, self.jobs, self.found, self.tell = work, jobs, found, tell
            assert all(need > 1e6 for need in needs.values())

        def run(self):
            for name, job in self.jobs.items():
                self.found[name] = self.work(job, 1, lambda _: None)
            outcomes.clear()
            outcomes.update(self.found)

    class Connected:
        def __init__(self, *_):
            pass

        def __enter__(self):
            return None

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(field, "Dispatcher", Dispatcher)
    monkeypatch.setattr(field, "connected", Connected)
    return outcomes


def solved(coarse, folder, **options):
    given = {"element_size": 0.06, "tile": 1.2, "overlap": 0.3} | options
    return field_stress(coarse, relief(), THICKNESS, folder=folder, **given)


def test_the_field_is_that_of_the_whole_on_fine_elements(coarse, here, tmp_path):
    found, reference = solved(coarse, tmp_path), whole(0.06)
    maps = found.maps
    assert len(here) == 4
    assert {outcome.status for outcome in here.values()} == {"done"}
    assert maps.attrs["tiles"] == [2, 2]
    assert maps.sizes == {"y": 41, "x": 41}
    assert error(found, reference) < 0.02
    assert 1e-4 < maps.attrs["seam_error"] < 0.02
    assert maps.attrs["submodel_sides_error"] < 0.05
    assert 0 < maps.attrs["map_force_difference"] < 0.05
    expected = float(reference.maps["contact_pressure"].integrate(["x", "y"]))
    assert maps.attrs["sample_force_mN"] == pytest.approx(expected, rel=0.02)
    # seams are not seen, although the overlaps are next to cut sides
    off = np.abs(maps["axial_stress"] - reference.maps["axial_stress"].interp(maps.coords))
    shared = maps["axial_stress_seam_error"].notnull()
    assert 0.1 < float(shared.mean()) < 0.5
    size = float(np.sqrt((maps["axial_stress"] ** 2).mean()))
    assert float(off.where(shared).mean()) < 0.005 * size
    # but where friction changes its side tiles keep that of the coarse solution
    assert float(off.max()) < 0.06 * size
    assert float(off.quantile(0.98)) < 0.02 * size
    # and what they are said to be off by is what they are off by
    said = float(np.sqrt((maps["axial_stress_seam_error"] ** 2).mean()))
    assert 0.2 < float(np.sqrt((off.where(shared) ** 2).mean())) / said < 3

    again = solved(coarse, tmp_path)
    assert {outcome.status for outcome in here.values()} == {"earlier"}
    xr.testing.assert_identical(again.maps, maps)
    solved(coarse, tmp_path, imprint_smoothing=0.05)
    assert {outcome.status for outcome in here.values()} == {"done"}  # these are others

    path = tmp_path / "field.nc"
    found.save(path)
    xr.testing.assert_allclose(read_result(path).maps, maps)
    found.save(tmp_path / "field.png")
    remove_tiles(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"field.nc", "field.png"}


def test_one_tile_of_the_whole_has_no_cut_sides(coarse, here, tmp_path):
    found = solved(coarse, tmp_path, tile=9.0)
    assert found.maps.attrs["tiles"] == [1, 1]
    assert error(found, whole(0.06)) < 0.02


def test_elements_that_do_not_divide_the_field_widen_the_margin(coarse, here, tmp_path):
    size = 0.0588  # twenty elements of 0.06 mm fill 1.2 mm
    options = {"region": (0.0, 1.2, 0.0, 1.2), "margin": 4 * size}
    found = solved(coarse, tmp_path, element_size=size, tile=9.0, **options)
    assert found.maps.attrs["submodel_margin_mm"] == pytest.approx(4 * 0.06)


def test_a_tile_whose_map_shows_another_force_is_named(coarse, here, tmp_path, monkeypatch):
    def misread(*arguments, **options):
        result = submodel_stress(*arguments, **options)
        if arguments[3][0] == arguments[3][2] == 0.0:
            result.maps.attrs["map_force_difference"] = 0.3
        return result

    monkeypatch.setattr(field, "submodel_stress", misread)
    about_coarse = coarse.maps.attrs | {"map_force_difference": 0.2}
    said = ["of the layer", *plausibility.misread(about_coarse)]
    maps = coarse.maps.assign_attrs(about_coarse | {"unusual": json.dumps(said)})
    attrs = solved(replace(coarse, maps=maps), tmp_path).maps.attrs
    assert attrs["map_force_difference"] == 0.3
    of_layer, of_tile = json.loads(attrs["unusual"])
    assert of_layer == "of the layer"
    assert of_tile.startswith("tile-1-1: the stress map adds up to a force that differs by 30 %")


def test_a_part_says_what_is_so_in_its_region(coarse):
    loaded = relief()
    loaded[:, loaded["x"] > 1.8] += 0.5
    initial = xr.full_like(loaded, THICKNESS) + 0.01 * loaded["y"]
    smoothing = coarse.maps.attrs["imprint_smoothing_mm"]
    imprint = imprint_of(loaded, initial, None, smoothing, beyond=True)
    coarse = replace(coarse, problem=replace(coarse.problem, imprint=imprint))
    inputs = submodel_inputs(coarse, loaded, initial, 0.06, None)
    assert inputs.of_region((0.2, 1.7, 0.2, 1.0))["no_contact_share"] == 0.0
    open_part = inputs.of_region((1.9, 2.3, 0.2, 1.0))
    assert open_part["no_contact_share"] == 1.0
    assert open_part["initial_thickness_mm"] == pytest.approx(THICKNESS + 0.006, abs=5e-4)


def test_a_tile_that_fails_is_tried_again_and_never_a_silent_hole(
    coarse, here, tmp_path, monkeypatch
):
    tries = []

    def refused(*arguments, margin, **options):
        region = arguments[3]
        tries.append((region[:1] + region[2:3], margin))
        first_row = region[2] == 0.0
        if region[0] == 0.0 and (not first_row or margin < 0.3):
            raise ConvergenceError("no luck")
        return submodel_stress(*arguments, margin=margin, **options)

    monkeypatch.setattr(field, "submodel_stress", refused)
    found = solved(coarse, tmp_path, margin=0.25)
    attrs = found.maps.attrs
    assert [here[f"tile-{n}"].status for n in ("1-1", "1-2", "2-1", "2-2")] == [
        *("done", "done", "failed", "done")
    ]
    assert [margin for at, margin in tries if at == (0.0, 0.0)] == [0.25, 0.5]
    assert json.loads(attrs["tiles_wider_margin"]) == ["tile-1-1"]
    assert "no luck" in here["tile-1-1"].message
    assert json.loads(attrs["tiles_failed"]) == {"tile-2-1": "no luck"}
    assert "tile-2-1 (x 0 to 1.38, y 1.02 to 2.4 mm) has no solution" in attrs["unusual"]
    assert attrs["status"] == "incomplete"
    hole = found.maps["axial_stress"].isnull()
    assert bool(hole.sel(x=slice(0, 1.0), y=slice(1.4, 2.4)).all())
    assert not bool(hole.sel(x=slice(1.05, 2.4)).any())
    assert not bool(hole.sel(y=slice(0, 1.35)).any())

    monkeypatch.setattr(field, "submodel_stress", submodel_stress)
    whole_again = solved(coarse, tmp_path, margin=0.25)
    statuses = [outcome.status for outcome in here.values()]
    assert sorted(statuses) == ["done", "earlier", "earlier", "earlier"]
    assert not bool(whole_again.maps["axial_stress"].isnull().any())
    assert "tiles_failed" not in whole_again.maps.attrs


def test_if_no_tile_has_a_solution_the_error_says_why(coarse, here, tmp_path, monkeypatch):
    def refused(*_, **__):
        raise ConvergenceError("no luck")

    monkeypatch.setattr(field, "submodel_stress", refused)
    with pytest.raises(ConvergenceError, match="no tile has a solution; the first, tile-1-1: no"):
        solved(coarse, tmp_path)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"element_size": 0.1}, "no smaller than those of the coarse"),
        ({"tile": 0.3}, "twice the overlap"),
        ({"region": (1.0, 2.5, 1.0, 1.5)}, "beyond the layer"),
        ({"workers": 0}, "at least 1"),
        ({"scheduler": "tcp://nowhere:1", "folder": None}, "folder"),
    ],
)
def test_fields_that_cannot_be_computed(coarse, here, tmp_path, options, told):
    with pytest.raises(InputError, match=told):
        solved(coarse, options.pop("folder", tmp_path), **options)
    assert not list(tmp_path.iterdir())


def test_command(coarse, tmp_path, monkeypatch, run):
    """With a worker on this machine, of a region of a folder that also holds something else."""
    monkeypatch.chdir(tmp_path)
    values = relief()
    values[30:32, 40:42] = np.nan
    np.savez("m.npz", L1=values.values, x=values["x"].values, y=values["y"].values)
    coarse.save("whole.nc")
    (tmp_path / "field-tiles").mkdir()
    (tmp_path / "field-tiles" / "mine.txt").write_text("of the user")
    code, out, err = run(
        *["submodel", "whole.nc", "m.npz", "--initial-thickness", THICKNESS, "--workers", 1],
        *["--region", 0.3, 1.5, 0.6, 1.5, "--element-size", 0.06, "--tile", 0.7],
        *["--overlap", 0.3, "--output", "field.nc"],
    )
    assert code == 0, err
    assert "2 x 2 tiles; where they overlap their axial stress differs by" in out
    assert "the sides of the worst tile account for about" in out
    assert "4 of 4" in err
    maps = read_result("field.nc").maps
    assert_allclose(maps["x"].values[[0, -1]], [0.3, 1.5])
    assert 0 < int(maps["filled"].sum()) < 10
    # of the region, and not of the whole
    assert maps.attrs["filled_share"] == area_mean(maps["filled"])
    assert f"interpolated pixels: {percent(maps.attrs['filled_share'])} of the map\n" in out
    assert bool(np.isfinite(maps["axial_stress"]).all())
    assert [path.name for path in (tmp_path / "field-tiles").iterdir()] == ["mine.txt"]
    for options, told in (
        (["--workers", 1], "--tile is needed"),
        ([], "--region is needed"),
        (["--tile", 1, "--threads", 1], "--threads"),
    ):
        code, _, err = run(
            *["submodel", "whole.nc", "m.npz", "--initial-thickness", THICKNESS],
            *["--element-size", 0.06, "--output", "field.nc", *options],
        )
        assert code == 2
        assert told in err
