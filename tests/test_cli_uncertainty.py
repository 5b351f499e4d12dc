"""``optical-palpation uncertainty`` by what it prints, the files it leaves and its exit status."""

import re

import numpy as np
import pytest
import xarray as xr

from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.thickness import thickness_map

STUDY = """
[unloaded]
thickness = 0.5
[loaded]
map = "map.npy"
field_of_view = [2.0, 1.5]
[material]
c10 = 2.23
c01 = 0.703
[friction]
window = 0.15
sample = 0.02
[grid]
element_size = 0.25
[outputs]
folder = "results"
write = []
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a study of a small map in it."""
    monkeypatch.chdir(tmp_path)
    y, x = np.meshgrid(np.linspace(0, 1.5, 13), np.linspace(0, 2, 17), indexing="ij")
    np.save("map.npy", 0.42 - 0.03 * np.exp(-((x - 0.7) ** 2 + (y - 1) ** 2) / 0.2))
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def test_end_to_end(here, run):
    status, out, err = run(
        "uncertainty", "study.toml", "--modulus", 0.03, "--thickness-noise", 0.001, "--probes", 1
    )
    assert status == 0
    assert "solve 2 of 2" in err
    assert (here / "results" / "uncertainty.png").stat().st_size > 10000
    with xr.open_dataset(here / "results" / "uncertainty.nc", engine="h5netcdf") as errors:
        errors.load()
    names = ["window_friction", "sample_friction", "modulus", "thickness_noise"]
    assert errors["input"].values.tolist() == names
    assert errors["axial_stress_error"].attrs["units"] == "kPa"
    # Stress is proportional to the stiffness of the layer at every point.
    of_modulus = errors["contribution"].sel(input="modulus")
    np.testing.assert_allclose(of_modulus, 0.03 * abs(errors["axial_stress"]), atol=2e-3)
    force = errors.attrs["force_mN"]
    by_input = dict(zip(names, errors["force_contribution"].values, strict=True))
    assert by_input["modulus"] == pytest.approx(0.03 * force, rel=1e-3)
    assert errors.attrs["force_error_mN"] == pytest.approx(np.linalg.norm(list(by_input.values())))
    np.testing.assert_allclose(
        errors["axial_stress_error"] ** 2, (errors["contribution"] ** 2).sum("input"), rtol=1e-6
    )
    said = re.search("total force ([0-9.]+) ± ([0-9.]+) mN", out)
    assert float(said[2]) == pytest.approx(errors.attrs["force_error_mN"], rel=0.05)
    assert abs(float(said[1]) - force) <= 0.06 * float(said[2])

    # What friction does is what solutions that follow the load anew say.
    def force_with(**changed):
        loaded = np.load("map.npy")
        x, y = np.linspace(0, 2, 17), np.linspace(0, 1.5, 13)
        result = computational_stress(
            thickness_map(loaded, x=x, y=y, where="map"),
            0.5,
            MooneyRivlin(2.23, 0.703),
            **({"window_friction": 0.15, "sample_friction": 0.02} | changed),
            element_size=0.25,
        )
        return result.maps.attrs["sample_force_mN"]

    assert force_with() == pytest.approx(force, rel=1e-6)
    expected = (force_with(sample_friction=0.03) - force_with(sample_friction=0.01)) * 0.05 / 0.02
    assert by_input["sample_friction"] == pytest.approx(expected, rel=0.03)


def test_the_mesh_that_an_accuracy_has_chosen_is_kept(here, run):
    text = STUDY.replace("element_size = 0.25", "accuracy = 0.1")
    (here / "study.toml").write_text(text)
    status, _, err = run("uncertainty", "study.toml", "--thickness-noise", 0.001, "--probes", 1)
    assert status == 0, err
    assert "solve 2 of 2" in err
    assert "solve 3" not in err
    with xr.open_dataset(here / "results" / "stress.nc", engine="h5netcdf") as maps:
        elements = int(np.prod(maps.attrs["elements"]))
    of_solves = set(re.findall(r"solve \d of 2: ([\d,]+) elements", err))
    assert f"{elements:,}" in of_solves


def test_files_of_choice_and_the_study_is_not_solved_again(here, run):
    only = ["--window-friction", 0.05, "--sample-friction", 0]
    assert run("uncertainty", "study.toml", *only)[0] == 0
    solved = (here / "results" / "stress.nc").stat().st_mtime_ns
    status, out, err = run("uncertainty",
        "study.toml", *only, "--output", "e.nc", "--plot", "e.pdf", "--quiet"
    )  # fmt: skip
    assert (status, out, err) == (0, "", "")
    assert (here / "results" / "stress.nc").stat().st_mtime_ns == solved
    assert (here / "e.pdf").stat().st_size > 10000
    with xr.open_dataset("e.nc", engine="h5netcdf") as errors:
        assert errors["input"].values.tolist() == ["window_friction"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent.toml"], "absent.toml"),
        (["broken.toml"], "map.npy"),
        (["study.toml", "--probes", 0], "--probes"),
        (["study.toml", "--window-friction", 0, "--sample-friction", 0], "at least one"),
        (["study.toml", "--modulus", -1], "--modulus"),
        (["study.toml", "--output", "e.txt"], "e.txt"),
        (["study.toml", "--plot", "absent/e.png"], "absent"),
    ],
)
def test_bad_input_is_named_and_nothing_written(here, run, arguments, message):
    (here / "broken.toml").write_text(STUDY.replace("[2.0, 1.5]", "[2.0, 1.5]\nvariable = 'a'"))
    before = {path.name for path in here.iterdir()}
    status, out, err = run("uncertainty", *arguments)
    assert status == 2
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    left = {path.name for path in here.iterdir()} - before
    assert left <= {"results"}
    assert not list(here.glob("results/uncertainty*"))
