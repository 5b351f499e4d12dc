"""The command line end to end, by the files it leaves and the status it exits with."""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import xarray as xr

from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import ContactState, algebraic_stress, computational_stress
from optical_palpation.present import read_result
from optical_palpation.thickness import clean_thickness, read_thickness_map

MATERIAL = ["--initial-thickness", "0.5", "--c10", "2.23", "--c01", "0.703"]
FRAME = ["--field-of-view", "2", "1.5"]
ALGEBRAIC = ["--method", "algebraic", *MATERIAL]
FRICTION = ["--window-friction", "0.15", "--sample-friction", "0.05"]
COMPUTATIONAL = [*MATERIAL, *FRICTION, "--element-size", "0.25"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in, with a good map of 13 x 17 pixels in it."""
    monkeypatch.chdir(tmp_path)
    y, x = np.meshgrid(np.linspace(0, 1.5, 13), np.linspace(0, 2, 17), indexing="ij")
    np.save("map.npy", 0.42 - 0.04 * np.exp(-((x - 0.7) ** 2 + (y - 1) ** 2) / 0.2))
    return tmp_path


def test_algebraic_method_end_to_end(here, run):
    files = ["--output", "o.nc", "--plot", "o.png", "--profiles", "o.csv"]
    status, out, err = run("stress", "map.npy", *FRAME, *ALGEBRAIC, *files)
    assert (status, err) == (0, "")
    for name in files[1::2]:
        assert (here / name).stat().st_size > 1000
        assert name in out
    maps = xr.open_dataset("o.nc", engine="h5netcdf")
    loaded = xr.DataArray(np.load("map.npy"), dims=("y", "x"), coords=maps["axial_stress"].coords)
    expected = algebraic_stress(loaded, 0.5, MooneyRivlin(2.23, 0.703))
    xr.testing.assert_allclose(maps["axial_stress"], expected, rtol=1e-12)
    assert maps["axial_stress"].attrs["units"] == "kPa"
    np.testing.assert_allclose(maps["x"], np.linspace(0, 2, 17))
    area = float(np.ptp(maps["x"].values) * np.ptp(maps["y"].values))
    assert f"mean {float(expected.integrate(['y', 'x'])) / area:.3g} kPa" in out


@pytest.mark.parametrize("law", ["yeoh", "ogden"])
def test_what_material_fits_stress_takes(here, run, law):
    truth = MooneyRivlin(2.23, 0.703)
    strain = np.linspace(0.0, 0.5, 100)
    table = np.column_stack([-strain, truth.uniaxial_stress(-strain)])
    np.savetxt("test.csv", table, delimiter=",", header="strain,stress_kPa", comments="")
    status, out, _ = run("material", "test.csv", "--contact", "0", "--law", law)
    assert status == 0
    options = out.split("for the layer: ")[1].split("\n")[0].split()
    assert options[:2] == ["--law", law]
    frame = ["map.npy", *FRAME, "--initial-thickness", "0.5"]
    method = [*FRICTION, "--element-size", "0.25"] if law == "yeoh" else ["--method", "algebraic"]
    for name, arguments in (("o.nc", options), ("p.nc", ["--c10", "2.23", "--c01", "0.703"])):
        assert run("stress", *frame, *arguments, *method, "--output", name)[0] == 0
    same, expected = (xr.open_dataset(name, engine="h5netcdf") for name in ("o.nc", "p.nc"))
    assert same.attrs["law"] == law
    assert "c20_kPa" in same.attrs or "alpha" in same.attrs
    # both laws follow the same curve, so that they are stressed alike
    assert float(same["axial_stress"].min()) == pytest.approx(
        float(expected["axial_stress"].min()), rel=0.05
    )


def test_the_computational_method_refuses_a_law_that_the_solver_does_not_take(here, run):
    law = ["--initial-thickness", "0.5", "--law", "ogden", "--mu", "5.9", "--alpha", "3"]
    arguments = [*law, *FRICTION, "--element-size", "0.25", "--output", "o.nc"]
    status, _, err = run("stress", "map.npy", *FRAME, *arguments)
    assert status == 2
    assert "not ogden" in err
    assert not (here / "o.nc").exists()


def test_computational_method_end_to_end(here, run):
    files = ["--output", "o.nc", "--plot", "o.png", "--profiles", "o.csv", "--vtk", "o.vts"]
    files += ["--deck", "o.inp"]
    status, out, err = run("stress", "map.npy", *FRAME, *COMPUTATIONAL, *files, "--threads", "1")
    assert status == 0
    assert "load 100%" in err
    for name in files[1::2]:
        assert (here / name).stat().st_size > 1000
        assert name in out
    with xr.open_dataset("o.nc", engine="h5netcdf") as maps:
        expected = {"axial_stress", "contact_pressure", "traction_x", "traction_y", "traction_z"}
        expected |= {"contact_state", "loaded_thickness", "algebraic_axial_stress"}
        assert expected <= set(maps.data_vars)
        assert {maps[name].dims for name in expected} == {("y", "x")}
        assert maps.attrs["window_force_mN"] == pytest.approx(maps.attrs["sample_force_mN"], 1e-4)
        said = re.search("window ([0-9.]+) \u00b1 ([0-9.]+) mN", out)
        off = float(said[1]) - maps.attrs["window_force_mN"]
        assert abs(off) <= 0.06 * float(said[2])  # to two digits of the error
        assert maps.attrs["input"] == "map.npy"
        sample_force = maps.attrs["sample_force_mN"]
    # Traction times deformed area of the sample side, quadrilateral by quadrilateral.
    layer = read_result("o.nc").layer
    corners = layer["position"].values[-1]
    diagonals = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
    area = np.linalg.norm(np.cross(*diagonals), axis=-1) / 2
    traction = layer["sample_traction"].sel(component="z").values
    mean = (traction[1:, 1:] + traction[:-1, 1:] + traction[1:, :-1] + traction[:-1, :-1]) / 4
    assert -(mean * area).sum() == pytest.approx(sample_force, rel=0.02)

    loaded = read_thickness_map("map.npy", field_of_view=(2, 1.5))
    again = computational_stress(
        clean_thickness(loaded)["thickness"],
        0.5,
        MooneyRivlin(2.23, 0.703),
        window_friction=0.15,
        sample_friction=0.05,
        element_size=0.25,
        threads=1,
    )
    np.testing.assert_allclose(
        read_result("o.nc").maps["axial_stress"], again.maps["axial_stress"], rtol=1e-9
    )


def test_the_algebraic_method_ignores_what_only_the_other_one_needs(here, run):
    status, _, _ = run(
        "stress", "map.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc", "--method", "algebraic"
    )
    assert status == 0
    assert "contact_pressure" not in read_result("o.nc").maps


def test_filled_pixels_are_marked_on_the_nodes_of_the_elements(here, run):
    values = np.load("map.npy")
    values[4:7, 6:9] = np.nan
    np.save("holes.npy", values)
    status, _, _ = run("stress", "holes.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc")
    assert status == 0
    filled = read_result("o.nc").maps["filled"]
    assert filled.dtype == bool
    # The hole spans x 0.75 to 1 mm, y 0.5 to 0.75 mm; nodes lie 0.25 mm apart.
    expected = (filled["x"] >= 0.74) & (filled["x"] <= 1.01)
    expected = expected & (filled["y"] >= 0.49) & (filled["y"] <= 0.76)
    xr.testing.assert_equal(filled, expected.transpose("y", "x").drop_attrs())


def test_demo(here, run):
    status, out, _ = run("demo", "--output", "made/here")
    assert status == 0
    folder = here / "made/here"
    assert {path.name for path in folder.iterdir()} == {
        "loaded.npy",
        "results",
        "study.toml",
        "truth.nc",
        "unloaded.npy",
    }
    maps = read_result(folder / "results/stress.nc").maps
    assert f"window {maps.attrs['window_force_mN']:.0f} \u00b1 " in out
    thickness, computational, algebraic = re.search(
        r"off by ([\d.]+) um.*?by (\d+)%.*?and (\d+)%", out, re.S
    ).groups()
    assert float(thickness) < 0.7 * 2.9  # axial pixels of the volumes
    assert float(computational) < 8 < 30 < float(algebraic)
    # The file that it shows is a study like any other, and done.
    command = out[out.index("run made") :].splitlines()[0].split()
    status, out, _ = run(*command)
    assert status == 0
    assert "stress.nc (from an earlier run)" in out


def test_demo_where_no_folder_can_be_made(here, run):
    status, _, err = run("demo", "--output", "map.npy")
    assert status == 2
    assert "map.npy" in err


def test_missing_pixels_and_spikes_are_filled_and_reported(here, run):
    values = np.load("map.npy")
    values[3, 4] = np.nan
    values[8, 9] = 0.1
    np.save("holes.npy", values)
    status, out, _ = run("stress", "holes.npy", *FRAME, *ALGEBRAIC, "--output", "o.nc")
    assert status == 0
    assert "interpolated pixels: 0.9 % of the map (missing 0.45 %, spikes 0.45 %)" in out
    filled = read_result("o.nc").maps["filled"].values
    assert np.argwhere(filled).tolist() == [[3, 4], [8, 9]]


def test_where_the_layer_is_not_thinner_there_is_no_contact(here, run):
    values = np.load("map.npy")
    values[:, :4] = 0.51
    np.save("gap.npy", values)
    status, out, _ = run("stress", "gap.npy", *FRAME, *ALGEBRAIC, "--output", "o.nc")
    assert status == 0
    assert "taken as open: 24 % of the map" in out
    maps = read_result("o.nc").maps
    assert (maps["axial_stress"][:, :4] == 0).all()
    assert "contact" not in out.replace("taken as open", "")
    assert "contact_state" not in maps
    assert (maps["axial_stress"][:, 4:] < 0).all()


def test_the_computational_method_reports_where_the_layer_is_not_thinner(here, run):
    """A sample that tilts away from the layer, which it leaves at the last four columns."""
    np.save("tilt.npy", np.linspace(0.44, 0.519, 17) * np.ones((13, 1)))
    status, out, _ = run("stress", "tilt.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc")
    assert status == 0
    assert "taken as open: 24 % of the map" in out
    state = read_result("o.nc").maps["contact_state"]
    assert (state.sel(x=slice(1.8, 2)) == ContactState.OPEN).all()
    assert (state.sel(x=slice(0.3, 1)) != ContactState.OPEN).all()


def test_initial_thickness_may_be_a_map_of_its_own(here, run):
    shared = np.linspace(0.5, 0.6, 17) * np.ones((13, 1))
    scipy.io.savemat("before.mat", {"L0": shared, "other": shared})
    command = ["stress", "map.npy", *FRAME, "--method", "algebraic", "--c10", "2.23"]
    command += ["--initial-thickness", "before.mat", "--output", "o.nc"]
    assert run(*command)[0] == 2
    status, _, _ = run(*command, "--initial-variable", "L0")
    assert status == 0
    loaded = np.load("map.npy")
    expected = MooneyRivlin(2.23).uniaxial_stress(loaded / shared - 1, measure="true")
    maps = read_result("o.nc").maps
    np.testing.assert_allclose(maps["axial_stress"], expected, rtol=1e-9)
    for attribute, file in (("input", "map.npy"), ("initial_thickness_input", "before.mat")):
        assert maps.attrs[attribute] == file
        digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
        assert maps.attrs[f"{attribute}_sha256"] == digest


def test_gaps_of_the_unloaded_map_are_told(here, run):
    gaps = np.full((13, 17), 0.5)
    gaps[2:8, 3:13] = np.nan
    np.save("before.npy", gaps)
    command = ["stress", "map.npy", *FRAME, "--method", "algebraic", "--c10", "2.23"]
    command += ["--initial-thickness", "before.npy", "--output", "o.nc"]
    status, out, _ = run(*command)
    assert status == 0
    share = 6 * 10 / (13 * 17)
    assert f"interpolated pixels, unloaded: {100 * share:.0f} % of the map" in out
    assert "WARNING: so much of the thickness map is made up" in out
    assert read_result("o.nc").maps.attrs["initial_filled_share"] == pytest.approx(share)


def test_no_point_of_a_layer_that_ends_between_pixels_lacks_a_stress(here, run):
    extent = ["--layer-extent", "0.25", "1.6", "0.3", "1.5"]
    status, _, _ = run("stress", "map.npy", *FRAME, *COMPUTATIONAL, *extent, "--output", "o.nc")
    assert status == 0
    maps = read_result("o.nc").maps
    assert not any(maps[name].isnull().any() for name in maps.data_vars)
    loaded = read_thickness_map("map.npy", field_of_view=(2, 1.5))
    expected = algebraic_stress(loaded, 0.5, MooneyRivlin(2.23, 0.703)).interp(x=maps.x, y=maps.y)
    np.testing.assert_allclose(maps["algebraic_axial_stress"], expected, atol=0.1)


def test_quiet_prints_nothing(here, run):
    assert run("stress", "map.npy", *FRAME, *ALGEBRAIC, "--output", "o.nc", "--quiet") == (
        0,
        "",
        "",
    )


def bad_maps():
    """Maps that cannot be used, made in the current folder."""
    good = np.load("map.npy")
    for name, values in {
        "pixel": good[:1, :1],
        "missing": np.full_like(good, np.nan),
        "micrometres": good * 1000,
        "metres": good / 1000,
        "zero": np.where(good == good[5, 5], 0, good),
        "negative": np.where(good == good[5, 5], -0.4, good),
        "above": good + 0.2,
        "cube": np.stack([good, good]),
    }.items():
        np.save(f"{name}.npy", values)
    np.savez("two.npz", a=good, b=good)
    Path("text.csv").write_text("0.4,0.4\n0.4,thin\n")
    Path("empty.mat").touch()


NO_MAP = ["--output", "o.nc", *FRAME, *ALGEBRAIC]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mat", *NO_MAP], "nowhere.mat: no such file"),
        (["two.npz", *NO_MAP, "--variable", "c"], "no variable 'c'"),
        (["two.npz", *NO_MAP], "more than one"),
        (["text.csv", *NO_MAP], "text.csv"),
        (["empty.mat", *NO_MAP], "empty"),
        (["pixel.npy", *NO_MAP], "1 x 1"),
        (["cube.npy", *NO_MAP], "two dimensions"),
        (["missing.npy", *NO_MAP], "missing"),
        (["micrometres.npy", *NO_MAP], "um"),
        (["metres.npy", *NO_MAP], "mm"),
        (["zero.npy", *NO_MAP], "zero or negative"),
        (["negative.npy", *NO_MAP], "zero or negative"),
        (["above.npy", *NO_MAP], "nothing is pressed"),
        (["map.npy", "--output", "o.nc", *ALGEBRAIC], "field of view"),
        (["map.npy", *NO_MAP, "--field-of-view", "0", "1"], "positive"),
        (["map.npy", *NO_MAP, "--length-unit", "inch"], "inch"),
        (["map.npy", *NO_MAP, "--initial-thickness", "-0.5"], "initial thickness"),
        (["map.npy", *NO_MAP, "--initial-thickness", "nan"], "initial thickness"),
        (["map.npy", *NO_MAP, "--initial-thickness", "nowhere.npy"], "nowhere.npy"),
        (["map.npy", *NO_MAP, "--c10", "-1"], "-1"),
        (["map.npy", *NO_MAP, "--c10", "nan"], "nan"),
        (["map.npy", *NO_MAP, "--c10", "thick"], "--c10"),
        (["map.npy", *NO_MAP, "--bulk-to-shear", "-3"], "bulk"),
        (["map.npy", *NO_MAP, "--law", "hooke"], "hooke"),
        (["map.npy", *NO_MAP, "--c20", "0.1"], "c20 belongs to another law"),
        (["map.npy", *NO_MAP, "--law", "ogden", "--mu", "5"], "alpha is missing"),
        (["map.npy", *NO_MAP, "--method", "magic"], "magic"),
        (["map.npy", *NO_MAP, "--vtk", "o.vts"], "--vtk"),
        (["map.npy", *NO_MAP, "--plot", "o.bmp"], "o.bmp"),
        (["map.npy", *NO_MAP, "--output", "nowhere/o.nc"], "no folder nowhere"),
        (["map.npy", *NO_MAP, "--output", "folder.nc"], "is a folder"),
        (["map.npy", *NO_MAP, "--output", "/proc/self/o.nc"], "cannot be written"),
        (["map.nc", *NO_MAP, "--output", "map.nc"], "map.nc"),
        (["map.npy", *FRAME, *MATERIAL, "--output", "o.nc"], "--window-friction"),
        (
            ["map.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc", "--window-friction", "-0.1"],
            "frict",
        ),
        (
            ["map.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc", "--sample-friction", "nan"],
            "frict",
        ),
        (["map.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc", "--element-size", "7"], "element"),
        (["map.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc", "--element-size", "0"], "element"),
        (
            ["map.npy", *FRAME, *COMPUTATIONAL, "--output", "o.nc", "--element-size", "1", "2"],
            "three",
        ),
    ],
    ids=lambda value: " ".join(value)[:60] if isinstance(value, list) else "",
)
def test_bad_input_is_refused_and_nothing_written(here, run, arguments, message):
    bad_maps()
    (here / "folder.nc").mkdir()
    xr.Dataset({"loaded_thickness": (("y", "x"), np.load("map.npy"))}).to_netcdf(
        "map.nc", engine="h5netcdf"
    )
    before = {path.name: path.stat().st_mtime_ns for path in here.iterdir()}
    status, out, err = run("stress", *arguments)
    assert status == 2, err
    assert message in " ".join(err.replace("│", " ").split())
    assert "Traceback" not in err
    assert out == ""
    assert {path.name: path.stat().st_mtime_ns for path in here.iterdir()} == before


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["0.125"], 0.125),
        (["0.125", "0.125", "0.1"], (0.125, 0.125, 0.1)),
        (["0.125,0.125,0.1"], (0.125, 0.125, 0.1)),
    ],
)
@pytest.mark.parametrize("form", ["separate", "equals"])
@pytest.mark.parametrize("place", ["before", "after"])
def test_element_size_takes_one_value_or_three(
    here, run, monkeypatch, given, expected, form, place
):
    """What the Python interface is called with, whatever way the numbers were written."""
    from optical_palpation import palpation
    from optical_palpation.errors import ConvergenceError

    def record(*arguments, element_size, **options):
        raise ConvergenceError(f"called with {element_size}")

    monkeypatch.setattr(palpation, "computational_stress", record)
    option = ["--element-size", *given]
    if form == "equals":
        option = [f"--element-size={given[0]}", *given[1:]]
    rest = ["map.npy", *FRAME, *MATERIAL, *FRICTION, "--output", "o.nc"]
    arguments = [*option, *rest] if place == "before" else [*rest, *option]
    status, _, err = run("stress", *arguments)
    assert status == 3
    assert f"error: called with {expected}" in err
    assert not (here / "o.nc").exists()


def test_installed_command_runs_and_starts_fast():
    command = [sys.executable, "-X", "importtime", "-c"]
    program = "from optical_palpation.cli import main; main(['--help'])"
    done = subprocess.run([*command, program], capture_output=True, text=True, check=True)
    assert "stress" in done.stdout
    for heavy in ("numba", "matplotlib", "xarray", "scipy"):
        assert f" {heavy}\n" not in done.stderr, f"{heavy} is imported for --help"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--compression", "0.3"], "--compression: with a deformable sample --sample-thickness"),
        (["map.npy"], "several maps are a series of loads: --sample-thickness is needed"),
        (
            ["--sample-thickness", "1", "--compression", "0.3,x", "--plate-friction", "0.3"],
            "--compression takes a number for each map; found '0.3,x'",
        ),
        (
            ["--input-error", "sample_thickness=0.01"],
            "--input-error sample_thickness: only with --sample-thickness",
        ),
        (
            ["--sample-thickness", "1"],
            "also needs --compression or --total-force",
        ),
        (
            [
                *["--sample-thickness", "1", "--compression", "0.3", "--plate-friction", "0.3"],
                "--edges",
                "roller",
                "--sample-motion",
                "0.05",
            ],
            "cannot go with --sample-motion, --edges roller",
        ),
    ],
)
def test_options_of_a_deformable_sample_go_together(here, run, options, reason):
    status, _out, err = run(
        "stress", "map.npy", *FRAME, *COMPUTATIONAL, *options, "--output", "o.nc"
    )
    assert status == 2
    assert reason in " ".join(re.sub(r"[│╭╮╰╯─]", " ", err).split())
    assert list(here.iterdir()) == [here / "map.npy"]


def test_deformable_sample_end_to_end(here, run):
    """A map as of a soft sample: stress and stiffness with bands; what cannot be exits with 2."""
    y, x = np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 2, 41), indexing="ij")
    np.save("soft.npy", 0.44 + 0.01 * ((x - 1) ** 2 + (y - 1) ** 2))
    options = [*MATERIAL, *FRICTION, "--element-size", "0.25", "--field-of-view", "2", "2"]
    sample = ["--sample-thickness", "1", "--plate-friction", "0.2", "--compression"]
    status, _, err = run(
        "stress", "soft.npy", *options, *sample, "0.2", "--output", "o.nc", "--quiet"
    )
    assert (status, err) == (0, "")
    maps = xr.open_dataset("o.nc", engine="h5netcdf")
    assert maps["sample_youngs_modulus"].attrs["units"] == "kPa"
    assert 5 < float(maps["sample_youngs_modulus"].median()) < 60
    assert float((maps["axial_stress_error"] > 0).mean()) == 1
    assert maps.attrs["sample_thickness_mm"] == 1
    status, _, err = run("stress", "soft.npy", *options, *sample, "3", "--output", "p.nc")
    assert status == 2
    assert "more than layer and sample together are thick" in " ".join(err.split())
    assert not (here / "p.nc").exists()


def test_a_series_of_loads_end_to_end(here, run):
    """Maps and travels in the order of loading give the relief, and the stress of each load."""
    y, x = np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 2, 41), indexing="ij")
    bowl = (x - 1) ** 2 + (y - 1) ** 2
    for name, share in (("first", 0.5), ("last", 1.0)):
        np.save(f"{name}.npy", 0.5 - share * (0.06 - 0.01 * bowl))
    options = [*MATERIAL, *FRICTION, "--element-size", "0.25", "--field-of-view", "2", "2"]
    sample = ["--sample-thickness", "1", "--plate-friction", "0.2", "--compression", "0.1", "0.2"]
    arguments = ["stress", "first.npy", "last.npy", *options, *sample]
    status, out, err = run(*arguments, "--output", "o.nc", "--no-estimates")
    assert status == 0, err
    assert "loads: 0.1 mm" in out
    maps = xr.open_dataset("o.nc", engine="h5netcdf")
    assert maps["sample_relief"].attrs["units"] == "mm"
    assert json.loads(maps.attrs["earlier_source"]) == ["first.npy"]
    assert maps.attrs["error_bands"] == "{}"
    series = xr.open_dataset("o.nc", engine="h5netcdf", group="series")
    assert series["compression"].values.tolist() == [0.1, 0.2]
    first, last = (-float(series["axial_stress"].sel(load=n).mean()) for n in (1, 2))
    assert 0 < first < last
    arguments[arguments.index("0.1")] = "0.3"
    status, _, err = run(*arguments, "--output", "p.nc")
    assert status == 2
    assert "must rise from map to map" in " ".join(err.split())
    status, _, err = run("stress", "last.npy", *arguments[3:], "--output", "p.nc")
    assert status == 2
    assert "2 values of the compression for 1 maps" in " ".join(err.split())
    assert not (here / "p.nc").exists()
