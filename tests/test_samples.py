import tomllib

import numpy as np
import pytest
import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.experiment.sample_data import (
    SAMPLES,
    make_sample,
    sample_truth,
    store_truth,
)
from optical_palpation.experiment.synthetic_oct import SyntheticOCT
from optical_palpation.experiment.volumes import experiment_volumes, write_volume
from optical_palpation.present import read_result
from optical_palpation.study import read_study
from optical_palpation.thickness import find_layer
from optical_palpation.volume import open_volume
from study_case import NO_ESTIMATES

MAPS = xr.Dataset(
    {
        "unloaded_thickness": (("y", "x"), np.full((21, 25), 0.5)),
        "loaded_thickness": (
            ("y", "x"),
            0.4
            + 0.05
            * np.sin(3 * np.linspace(-0.1, 1.1, 25))
            * np.cos(2 * np.linspace(0, 1, 21)[:, None]),
        ),
    },
    {"x": np.linspace(-0.1, 1.1, 25), "y": np.linspace(0.0, 1.0, 21)},
)


def test_volumes_are_written_as_they_are_and_are_the_same_every_time(tmp_path):
    volume, again = (experiment_volumes(MAPS, saturated=0.01)["loaded"] for _ in range(2))
    write_volume(volume, tmp_path / "v.npy")
    spacing = dict(zip("zyx", volume.spacing, strict=True))
    with open_volume(tmp_path / "v.npy", axes="yzx", spacing=spacing, scale="linear") as opened:
        assert opened.shape == volume.shape
        np.testing.assert_array_equal(opened.bscan(4), again.bscan(4))
    assert not np.array_equal(volume.bscan(4), volume.bscan(5))


def test_a_volume_is_no_mapped_file_while_it_is_written(tmp_path, monkeypatch):
    """A full disk is an error of a write, but the end of a process that writes to a mapped file."""
    volume = SyntheticOCT(np.full((3, 4), 0.1), (0.01, 0.1, 0.1), 30)
    monkeypatch.setattr(np, "memmap", None)
    write_volume(volume, tmp_path / "v.npy")
    read = np.load(tmp_path / "v.npy")
    assert read.dtype == np.float32
    assert read.flags.c_contiguous
    assert np.array_equal(read, np.stack(list(volume)))


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.02, 0.03)])
def test_layer_of_an_experiment_is_found_again_in_its_volumes(tilt):
    maps = MAPS.copy(deep=True)
    maps["loaded_thickness"][:, 0] = np.nan  # no layer here
    volumes = experiment_volumes(maps, tilt=tilt)
    for name, volume in volumes.items():
        found = find_layer(volume, spacing=volume.spacing, scale="linear").thickness
        truth = maps[f"{name}_thickness"].interp(x=found.x.values - 0.1, y=found.y.values)
        error = (found.values - truth.values)[:, 10:]
        assert np.sqrt(np.mean(error**2)) < 0.6 * volume.spacing[0]
    # the border goes on where there is no layer
    border = maps["loaded_thickness"].values[0, 1]
    np.testing.assert_allclose(volumes["loaded"].thickness[0, 0], border)


@pytest.mark.parametrize("name", SAMPLES)
def test_truth_is_whole_and_adds_up_to_its_force(name):
    truth = sample_truth(name)
    layer = {"x": slice(-1e-9, 4 + 1e-9), "y": slice(-1e-9, 4 + 1e-9)}
    inside = truth.sel(layer)
    assert not any(np.isnan(inside[v]).any() for v in truth if truth[v].dtype.kind == "f")
    assert truth["x"][0] < 0
    assert truth["x"][-1] > 4
    assert truth["axial_stress"].attrs["units"] == "kPa"
    assert truth["loaded_thickness"].attrs["units"] == "mm"
    # what bulges over the border of the field carries the rest
    on_field = -float(inside["axial_stress"].mean()) * 4.0 * 4.0
    assert 0.8 < on_field / truth.attrs["window_force_mN"] <= 1.01
    # layer and sample of the same law keep their volume: thinner means wider
    spread = truth["sample_displacement_x"].isel(x=-1) - truth["sample_displacement_x"].isel(x=0)
    assert float(spread.mean()) > (0 if name == "relief" else 0.05)


def test_plate_is_uniaxial_compression():
    truth = sample_truth("plate")
    stretch = 0.42 / 0.5
    stress = 2 * (stretch**2 - 1 / stretch) * (2.23 + 0.703 / stretch)
    np.testing.assert_allclose(truth["axial_stress"], stress)
    assert truth.attrs["window_force_mN"] == pytest.approx(-stress * 16.0 / stretch)


def test_scene_gives_the_stored_truth(tmp_path):
    # On a coarser mesh than the stored one; the difference is that of the meshes.
    store_truth("nodule", tmp_path / "coarse.nc", element_size=0.25)
    coarse, stored = xr.load_dataset(tmp_path / "coarse.nc"), sample_truth("nodule")
    assert set(coarse.data_vars) == set(stored.data_vars)
    force = [maps.attrs["window_force_mN"] for maps in (coarse, stored)]
    assert force[0] == pytest.approx(force[1], rel=0.05)
    inside = {"x": slice(0.5, 3.5), "y": slice(0.5, 3.5)}
    difference = (coarse["axial_stress"] - stored["axial_stress"]).sel(inside)
    scale = float(np.sqrt((stored["axial_stress"].sel(inside) ** 2).mean()))
    assert float(np.sqrt((difference**2).mean())) < 0.1 * scale
    thickness = (coarse["loaded_thickness"] - stored["loaded_thickness"]).sel(inside)
    assert float(np.abs(thickness).max()) < 0.01


@pytest.mark.parametrize("name", SAMPLES)
def test_a_sample_is_a_study_with_its_truth(tmp_path, name):
    study = read_study(make_sample(name, tmp_path / "made" / name))
    again = make_sample(name, tmp_path / "again")
    assert study.file.read_bytes() == again.read_bytes()
    for file in ("unloaded.npy", "loaded.npy", "truth.nc"):
        first, second = (folder / file for folder in (study.file.parent, again.parent))
        assert first.read_bytes() == second.read_bytes() or file == "truth.nc"
    stored = xr.load_dataset(study.file.parent / "truth.nc")
    xr.testing.assert_allclose(stored, sample_truth(name), rtol=1e-6)
    assert study.material.c10 == stored.attrs["c10_kPa"]
    assert study.friction.window == stored.attrs["window_friction"]
    assert (study.sample.motion == "truth.nc") == (name == "nodule")
    volume = np.load(study.file.parent / "loaded.npy", mmap_mode="r")
    assert 101 <= volume.shape[0] == volume.shape[2] <= 120
    assert volume.nbytes < 2e7


def test_unknown_sample():
    with pytest.raises(InputError, match="plate, relief, nodule"):
        sample_truth("coin")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance"), [("plate", 0.05), ("relief", 0.08), ("nodule", 0.1)]
)
def test_command_makes_a_sample_whose_stress_is_found(here, run, name, tolerance):
    status, out, _ = run("sample", name, "--output", "made")
    assert status == 0
    command = out[out.index("run made") :].split()
    text = (here / "made/study.toml").read_text()
    quick = f"threads = 1\n{NO_ESTIMATES}\n[outputs]\nwrite = []"
    study = tomllib.loads(text)
    (here / "made/study.toml").write_text(text.replace("[outputs]", quick))
    assert study["grid"]["element_size"] == 0.125
    status, _, err = run(*command)
    assert status == 0, err
    maps = read_result(here / "made/results/stress.nc").maps
    truth = sample_truth(name)
    force = truth.attrs["window_force_mN"]
    assert maps.attrs["window_force_mN"] == pytest.approx(force, rel=tolerance)
    inside = {"x": slice(0.5, 3.5), "y": slice(0.5, 3.5)}
    true = truth["axial_stress"].interp(x=maps.x, y=maps.y).sel(inside)
    error = (maps["axial_stress"].sel(inside) - true) / np.sqrt((true**2).mean())
    assert float(np.sqrt((error**2).mean())) < tolerance


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path
