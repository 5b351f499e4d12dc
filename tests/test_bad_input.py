"""The ``stress`` command against input that nobody can use.

Each case: exit status 2, an error of its own on standard error, nothing on standard output, nothing
written, and no mechanical solution started. The commonest cases are in ``test_cli.py``, what only
the readers can meet in ``test_thickness_errors.py``.
"""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import scipy.io
import tifffile
import xarray as xr

from optical_palpation import palpation
from optical_palpation.cli import main
from optical_palpation.errors import ConvergenceError
from optical_palpation.palpation import computational

FRAME = ["--field-of-view", "2", "1.5"]
MATERIAL = ["--initial-thickness", "0.5", "--c10", "2.23", "--c01", "0.703"]
FRICTION = ["--window-friction", "0.15", "--sample-friction", "0.05"]
COMPUTATIONAL = [*MATERIAL, *FRICTION, "--element-size", "0.25", "--output", "o.nc"]
GOOD = ["map.npy", *FRAME, *COMPUTATIONAL]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with good and bad files, in which nothing can be solved."""
    monkeypatch.chdir(tmp_path)

    def solve(*arguments, **options):
        raise AssertionError("the input got as far as the solver")

    monkeypatch.setattr(computational, "solve", solve)
    x, y = np.linspace(0, 2, 17), np.linspace(0, 1.5, 13)
    good = 0.42 - 0.04 * np.exp(-((x - 0.7) ** 2 + (y[:, None] - 1) ** 2) / 0.2)
    np.save("map.npy", good)
    xr.Dataset({"L1": (("y", "x"), good)}, {"x": x, "y": y}).to_netcdf("map.nc", engine="h5netcdf")
    (tmp_path / "link.nc").symlink_to("map.nc")
    (tmp_path / "folder.nc").mkdir()
    for name, values in {
        "complex": good + 0j,
        "whole": (1000 * good).astype(int),
        "flags": good > 0.4,
        "words": good.astype(str),
        "number": np.float64(0.4),
        "row": good[0],
        "nothing": np.empty((0, 0)),
        "infinite": np.where(good == good.min(), np.inf, good),
        "missing": np.full_like(good, np.nan),
        "micrometres": 1000 * good,
    }.items():
        np.save(f"{name}.npy", values)
    for name, coordinates in {
        "twice": {"x": np.repeat(x, 2)[:17], "y": y},
        "zigzag": {"x": np.roll(x, 3), "y": y},
        "transposed": {"x": y, "y": x},
        "one-axis": {"x": x},
        "widths-in-um": {"x": 1000 * x, "y": 1000 * y},
        "named-x": {"x": x.astype(str), "y": y},
        "contradicting": {"x": x, "y": y},
        "short": {"x": x[:9], "y": y[:9]},
    }.items():
        np.savez(f"{name}.npz", L1=good, **coordinates)
    np.savez("small-before.npz", L0=good + 0.1, x=x / 2, y=y / 2)
    (tmp_path / "prose.txt").write_text("thickness of the layer\nas measured on Monday\n")
    large = np.tile(good, (9, 9))
    np.savez("cut.npz", L1=large)
    scipy.io.savemat("cut.mat", {"L1": large})
    tifffile.imwrite("cut.tif", large, compression="zlib")
    xr.Dataset({"L1": (("y", "x"), large)}).to_netcdf("cut.nc", engine="h5netcdf")
    for name in ("cut.npz", "cut.mat", "cut.tif", "cut.nc"):
        os.truncate(name, (tmp_path / name).stat().st_size * 2 // 3)
        (tmp_path / name.replace("cut", "empty")).touch()
    return tmp_path


def files(folder):
    return {path.name: path.lstat().st_mtime_ns for path in folder.iterdir()}


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as leaving:
        main(["stress", *arguments])
    out, err = capsys.readouterr()
    return leaving.value.code, out, " ".join(err.replace("│", " ").split())


MAPS = {
    "complex.npy": "complex128",
    "whole.npy": "pixel counts",
    "flags.npy": "type bool",
    "words.npy": "floating-point",
    "number.npy": "single number",
    "row.npy": "two dimensions",
    "nothing.npy": "0 x 0",
    "infinite.npy": "infinite",
    "prose.txt": "no number",
    "folder.nc": "is a directory",
} | {
    f"{state}.{suffix}": message
    for state, message in (("cut", "truncated"), ("empty", "is empty"))
    for suffix in ("npz", "mat", "tif", "nc")
}
OWN_FRAMES = {
    "twice.npz": "rise or fall",
    "zigzag.npz": "rise or fall",
    "transposed.npz": "13 rows along y and 17 columns along x",
    "short.npz": "13 rows along y and 17 columns along x",
    "one-axis.npz": "along both x and y",
    "widths-in-um.npz": "say the unit of the coordinates",
    "named-x.npz": "its type <U",
    "contradicting.npz --field-of-view 2 2": "contradicts",
}
OPTIONS = {
    "--field-of-view nan 1": "field of view",
    "--field-of-view inf 1": "field of view",
    "--field-of-view -2 1": "must be positive",
    "--field-of-view 2": "2 arguments",
    "--field-of-view 2000 1500": "no instrument sees 500 mm",
    "--field-of-view 0.002 0.0015": "one of them is probably not in mm",
    "--pixel-spacing 0 1": "must be positive",
    "--pixel-spacing nan 1": "pixel spacing",
    "--pixel-spacing 1 1": "contradicts",
    "--layer-extent 2 0 0 1.5": "x0 < x1",
    "--layer-extent 0 3 0 1.5": "reaches beyond the map",
    "--layer-extent 0 nan 0 1.5": "finite",
    "--layer-extent 0.51 0.52 0 1.5": "0 pixels along x",
    "--layer-extent 0 2 0 0.01": "1 pixels along y",
    "--variable L1": "leave out variable",
    "--length-unit um": "read as um",
    "--initial-thickness 0": "positive and finite",
    "--initial-thickness inf": "positive and finite",
    "--initial-thickness 500": "in um",
    "--initial-thickness 0.0005": "a layer of 0.0005 mm is thinner than 0.005 mm",
    "--initial-thickness 0,5": "0,5: no such file",
    "--initial-thickness folder.nc": "is a directory",
    "--initial-thickness missing.npy": "missing.npy: all values are missing",
    "--initial-thickness micrometres.npy": "in um",
    "--c10 inf": "c10 = inf",
    "--c01 nan": "c01 = nan",
    "--c01 -10": "unstable",
    "--c10 0 --c01 0": "unstable",
    "--c10 1e9": "in kPa?",
    "--c10 1e308": "in kPa?",
    "--c10 1e-9 --c01 0": "in kPa?",
    "--c10 -0.4 --c01 1": "stable",
    "--bulk-to-shear 0": "bulk_to_shear = 0",
    "--bulk-to-shear 5": "too low",
    "--bulk-to-shear 1e12": "beyond that of any material",
    "--bulk-to-shear nan": "bulk_to_shear = nan",
    "--bulk-to-shear inf": "bulk_to_shear = inf",
    "--window-friction nan": "window_friction",
    "--window-friction inf": "window_friction",
    "--window-friction 15": "no interface",
    "--sample-friction -0.1": "sample_friction",
    "--sample-friction high": "--sample-friction",
    "--element-size -0.1": "positive",
    "--element-size nan": "positive",
    "--element-size inf": "positive",
    "--element-size 0.6 0.2 0.2": "along x",
    "--element-size 0.2 0.6 0.2": "along y",
    "--element-size 0.2 0.2 0.6": "thickness of the layer",
    "--element-size 1 1 1 1": "three for x, y, z",
    "--element-size 0.0001": "beyond any memory",
    "--element-size 1e-300": "beyond any memory",
    "--element-size small": "'small'",
    "--imprint-smoothing -1": "imprint_smoothing",
    "--imprint-smoothing nan": "imprint_smoothing",
    "--imprint-smoothing inf": "imprint_smoothing",
    "--imprint-smoothing 0.5": "quarter of the field of view",
    "--imprint-smoothing 1e9": "quarter of the field of view",
    "--edges clamped": "clamped",
    "--threads 0": "--threads",
    "--output o": "ends in .nc",
    f"--output {'long' * 70}.nc": "File name too long",
    "--output /dev/null": "ends in .nc",
    "--plot no/o.png": "no folder no",
    "--plot o.nc": "ends in .png",
    "--profiles o.txt": "ends in .csv",
    "--vtk o.vtk": "ends in .vts",
    "--deck folder.nc": "ends in .inp",
}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(pytest.param([name, *FRAME], message, id=name) for name, message in MAPS.items()),
        *(pytest.param(text.split(), message, id=text) for text, message in OWN_FRAMES.items()),
        pytest.param(
            ["map.nc", "--output", "map.nc"], "map.nc: is also an input", id="output=input"
        ),
        pytest.param(
            ["map.nc", "--output", "folder.nc/../map.nc"], "is also an input", id="output=input2"
        ),
        pytest.param(["map.nc", "--output", "link.nc"], "is also an input", id="output=link"),
    ],
)
def test_maps_and_frames(here, capsys, arguments, message):
    refused(here, capsys, [*COMPUTATIONAL, *arguments], message)


@pytest.mark.parametrize("option", [*OPTIONS])
def test_options(here, capsys, option):
    refused(here, capsys, [*GOOD, *option.split()], OPTIONS[option])


def refused(here, capsys, arguments, message):
    before = files(here)
    status, out, err = run(capsys, *arguments)
    assert status == 2, err
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    assert files(here) == before


def test_good_input_gets_as_far_as_the_solver(here):
    """What the cases above are variants of is refused by none of the checks."""
    with pytest.raises(AssertionError, match="as far as the solver"):
        main(["stress", *GOOD])


def test_load_that_is_not_reached_leaves_older_results(here, capsys, monkeypatch):
    def fail(*arguments, **options):
        raise ConvergenceError("loaded to 40 % only")

    monkeypatch.setattr(palpation, "computational_stress", fail)
    (here / "o.nc").write_text("older")
    before = files(here)
    status, out, err = run(capsys, *GOOD, "--plot", "o.png", "--vtk", "o.vts", "--deck", "o.inp")
    assert (status, out, err) == (3, "", "error: loaded to 40 % only")
    assert files(here) == before


def test_interrupt_while_solving(here):
    """Ctrl-C once the load is on its way: one line, status 130, no file."""
    before = files(here)
    arguments = [*GOOD, "--element-size", "0.03", "--threads", "1", "--plot", "o.png"]
    with subprocess.Popen(
        [sys.executable, "-m", "optical_palpation", "stress", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        for line in process.stderr:
            if "elements: load" in line:
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert out == ""
    assert err.strip().splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in err
    assert files(here) == before
