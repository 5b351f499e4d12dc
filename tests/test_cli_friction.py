"""``optical-palpation friction`` by what it prints, the files it leaves and its exit status."""

import json
import shutil

import numpy as np
import pytest
import xarray as xr

from optical_palpation.cli import main
from optical_palpation.experiment.synthetic_oct import complex_pair
from optical_palpation.friction import slab_profile
from optical_palpation.material import MooneyRivlin

# A small layer on a coarse grid: what the command does with the curves is tested, not the curves.
SLAB = {
    "layer_size": (2.0, 2.0),
    "initial_thickness": 0.5,
    "loaded_thickness": 0.42,
    "material": MooneyRivlin(2.23, 0.703),
    "region": 1.6,
    "elements": 2,
}
LAYER = ["--layer-size", 2, 2, "--initial-thickness", 0.5, "--c10", 2.23, "--c01", 0.703]
LAYER += ["--elements", 2]
PRELOAD = ["--loaded-thickness", 0.42, "--region", 1.6]
OPTICS = ["--wavelength", 1.3e-3, "--refractive-index", 1.4]
FACES = ["--window-depth", 0.04, "--sample-depth", 0.46]
VOLUMES = ["--axes", "zyx", "--spacing", 0.004, 0.05, 0.05]
COEFFICIENTS = ["--coefficients", "0.05,0.2,0.35"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A profile and a pair of volumes of a layer of friction 0.15, and its calibration curves."""
    folder = tmp_path_factory.mktemp("made")
    slab = slab_profile(0.15, **SLAB)
    depth = np.linspace(0.03, 0.97, 60)
    profile = np.interp(depth, slab["depth"], slab["increment"])
    noisy = profile * (1 + np.random.default_rng(0).normal(0.0, 0.005, depth.size))
    table = np.column_stack([depth * 0.42, noisy * 1e6])
    header = "depth_mm,displacement_nm"
    np.savetxt(folder / "profile.csv", table, delimiter=",", header=header, comments="")
    z = 0.004 * np.arange(125)
    u = np.interp((z - 0.04) / 0.42, slab["depth"], slab["increment"])
    # Wider than the region: the command cuts out the middle, and outside lies something else.
    u = np.broadcast_to(u[:, None, None], (125, 40, 44)).copy()
    u[:, :4] = 0.0
    before, after = complex_pair(u, spacing=(0.004, 0.05, 0.05), snr_db=15.0)
    np.save(folder / "before.npy", before.astype(np.complex64))
    np.save(folder / "after.npy", after.astype(np.complex64))
    arguments = [folder / "profile.csv", "--depth-in-mm", *LAYER, *PRELOAD, *COEFFICIENTS]
    arguments += ["--save-calibration", folder / "curves.nc"]
    arguments += ["--output", folder / "mu.json", "--plot", folder / "mu.png"]
    with pytest.raises(SystemExit) as leaving:
        main(["friction", *map(str, arguments)])
    assert not leaving.value.code
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch, made):
    """A folder of its own with the measurements in it."""
    monkeypatch.chdir(tmp_path)
    for name in ("profile.csv", "before.npy", "after.npy"):
        shutil.copy(made / name, tmp_path)
    return tmp_path


def test_profile_end_to_end(here, made, run):
    record = json.loads((made / "mu.json").read_text())
    assert record["friction"] == pytest.approx(0.15, abs=0.02)
    low, high = record["interval_95"]
    assert low - 0.02 < 0.15 < high + 0.02
    assert record["loaded_thickness_mm"] == 0.42
    assert record["measurement"] == ["profile.csv"]
    assert (made / "mu.png").stat().st_size > 10000
    curves = xr.load_dataset(made / "curves.nc")["normalised_displacement"]
    np.testing.assert_array_equal(curves["friction"], [0.05, 0.2, 0.35])
    # What was saved gives the same answer, without being computed again.
    status, out, err = run(
        "friction",
        *("profile.csv", "--depth-in-mm", *PRELOAD, "--calibration", made / "curves.nc"),
        *("--output", "again.json"),
    )
    assert (status, err) == (0, "")
    assert json.loads((here / "again.json").read_text())["friction"] == record["friction"]
    assert f"friction at the window: {record['friction']:.3f}" in out


def test_depth_has_the_unit_of_its_column(here, made, run):
    expected = json.loads((made / "mu.json").read_text())["friction"]
    depth, displacement = np.loadtxt("profile.csv", delimiter=",", skiprows=1).T
    given = PRELOAD[:2]
    for name, factor, options in (
        ("depth_um", 1e3, given),
        ("depth_um", 1e3, []),  # the calibration tells the thickness
        ("depth", 1.0, given),
        ("depth_fraction", 1 / 0.42, given),
        ("depth", 1 / 0.42, []),  # beyond 0.42 it can be no length
    ):
        table = np.column_stack([factor * depth, displacement])
        header = f"{name},displacement_nm"
        np.savetxt("other.csv", table, delimiter=",", header=header, comments="")
        curves = ["--calibration", made / "curves.nc"]
        status, _, err = run("friction", "other.csv", *curves, *options, "--output", "other.json")
        assert (status, err) == (0, "")
        found = json.loads((here / "other.json").read_text())["friction"]
        assert found == pytest.approx(expected, rel=1e-6)


def test_volumes_end_to_end(here, made, run):
    measurement = ["before.npy", "after.npy", *VOLUMES, *FACES, *OPTICS]
    curves = ["--calibration", made / "curves.nc", "--region", 1.6]
    status, out, _ = run(
        "friction", *measurement, *curves, "--output", "mu.json", "--plot", "mu.pdf"
    )
    assert status == 0
    record = json.loads((here / "mu.json").read_text())
    assert record["friction"] == pytest.approx(0.15, abs=0.03)
    assert record["step"] == pytest.approx(-5e-4, rel=0.02)
    assert record["units"]["step"] == "mm"
    assert record["doubts"] == []
    assert "95 %" in out
    assert "um at the sample; that of the calibration is -0.5 um" in out
    assert "WARNING" not in out
    swapped = ["after.npy", "before.npy", *VOLUMES, *FACES, *OPTICS]
    status, out, _ = run("friction", *swapped, *curves)
    assert status == 0
    assert "WARNING: the layer moves away from the window" in out
    # An optical path is divided by the index: the faces of the layer move with it.
    optical = [str(v) if v != 0.004 else "0.0056" for v in VOLUMES]
    status, _, _ = run(
        "friction",
        *("before.npy", "after.npy", *optical, *FACES, *OPTICS, *curves),
        *("--optical-depth", "--output", "optical.json"),
    )
    assert status == 0
    assert json.loads((here / "optical.json").read_text())["friction"] == record["friction"]


def test_curves_alone(here, made, run):
    status, out, _ = run("friction", "--calibration", made / "curves.nc", "--plot", "curves.svg")
    assert status == 0
    assert out.strip() == "picture: curves.svg"
    assert "friction 0.35" in (here / "curves.svg").read_text()


def test_coefficient_outside_the_curves_is_said(here, made, run):
    depth = np.linspace(0.05, 0.95, 30)
    table = np.column_stack([depth, depth**2])
    np.savetxt("bent.csv", table, delimiter=",", header="depth,displacement", comments="")
    status, out, _ = run("friction", "bent.csv", "--calibration", made / "curves.nc")
    assert status == 0
    assert "friction at the window: 0.350" in out
    assert "WARNING" in out


CURVES = ["--calibration", "CURVES"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a", "b", "c"], "one profile, or two volumes"),
        ([], "--plot or --save-calibration"),
        (["profile.csv", *LAYER], "--loaded-thickness, --region"),
        (["profile.csv", "--depth-in-mm", *CURVES], "--loaded-thickness"),
        (["before.npy", "after.npy", *CURVES], "--window-depth"),
        (["profile.csv", *CURVES, "--c10", 2], "--calibration already tells --c10"),
        (
            ["profile.csv", *CURVES, "--sample-friction", 0.4, "--c01", 1],
            "--calibration already tells --c01, --sample-friction",
        ),
        (["absent.csv", *CURVES], "absent.csv"),
        (["profile.csv", "--depth-in-mm", *PRELOAD, "--calibration", "absent.nc"], "absent.nc"),
        (["profile.csv", "--calibration", "profile.csv"], "profile.csv"),
        (["profile.csv", *CURVES, "--depth-in-mm", "--loaded-thickness", 0.3], "depth runs"),
        (["nameless.csv", *CURVES], "depth_mm or depth_fraction"),
        (["profile.csv", *CURVES, "--depth-in-mm", *PRELOAD[:3], 0.8], "region of 1.6"),
        (["before.npy", "profile.csv", *VOLUMES, *FACES, *OPTICS, *CURVES], "profile.csv"),
        (["before.npy", "short.npy", *VOLUMES, *FACES, *OPTICS, *CURVES], "alike"),
        (["before.npy", "after.npy", *FACES, *OPTICS, *CURVES], "axes ("),
        (["before.npy", "after.npy", *VOLUMES, *FACES, *OPTICS, *CURVES, "--region", 5], "2.2"),
        (["real.npy", "real.npy", *VOLUMES, *FACES, *OPTICS, *CURVES, "--region", 1.6], "complex"),
        (["profile.csv", "--depth-in-mm", *LAYER, *PRELOAD, "--coefficients", "a,b"], "'a,b'"),
        (["profile.csv", "--depth-in-mm", *LAYER, *PRELOAD, "--coefficients", "0.3"], "two"),
        (["profile.csv", "--depth-in-mm", *LAYER, "--loaded-thickness", 0.6, *PRELOAD[2:]], "0.6"),
        (["profile.csv", *LAYER, *PRELOAD, "--law", "ogden"], "'ogden' is not one of"),
        (["profile.csv", *CURVES, "--plot", "mu.txt"], "mu.txt"),
        (["profile.csv", *CURVES, "--output", "profile.csv"], "profile.csv"),
    ],
)
def test_bad_input_is_named_and_nothing_written(here, made, run, arguments, message):
    np.save("short.npy", np.load("before.npy")[:100])
    np.save("real.npy", np.abs(np.load("before.npy")))
    text = (here / "profile.csv").read_text()
    (here / "nameless.csv").write_text(text.replace("depth_mm", "depth"))
    arguments = [str(made / "curves.nc") if a == "CURVES" else a for a in arguments]
    outputs = [] if {"--output", "--plot"} & set(arguments) else ["--output", "o.json"]
    before = {path.name: path.read_bytes() for path in here.iterdir()}
    status, out, err = run("friction", *arguments, *outputs) if arguments else run("friction")
    assert status == 2
    assert message in " ".join(err.split()).replace("│ ", "").replace(" │", "")
    assert "Traceback" not in err
    assert out == ""
    assert {path.name: path.read_bytes() for path in here.iterdir()} == before
