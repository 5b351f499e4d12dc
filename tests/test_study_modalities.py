"""The same study of volumes from other instruments: the configuration tells, and nothing else."""

import re
import shutil

import numpy as np
import pytest
import xarray as xr

from optical_palpation.experiment.synthetic_oct import Optics, SyntheticOCT
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.present import read_result
from optical_palpation.study import read_study, run_study
from optical_palpation.thickness import thickness_map
from study_case import NO_ESTIMATES, STUDY, make_study

# name: lateral pixel and field along x, y, axial pixel and layer thickness, mm
INSTRUMENTS = {
    # pixels of 0.2 mm in all directions on 40 mm: a gel pad of 14 mm under a linear array
    "ultrasound": (0.2, (40.0, 24.0), 0.2, 14.0),
    # pixels of 0.5 um on 0.14 mm: a film of 40 um on cells
    "confocal": (0.0005, (0.14, 0.07), 0.0005, 0.04),
}


@pytest.mark.slow
@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_only_the_configuration_differs(instrument, tmp_path):
    pixel, field, depth_pixel, thick = INSTRUMENTS[instrument]
    nx, ny = (round(f / pixel) + 1 for f in field)
    y, x = np.meshgrid(pixel * np.arange(ny), pixel * np.arange(nx), indexing="ij")
    unloaded = np.full((ny, nx), thick)
    bump = np.exp(-((x / field[0] - 0.5) ** 2 + (y / field[0] - 0.15) ** 2) / 0.02)
    loaded = unloaded * (0.85 - 0.12 * bump)
    spacing = (depth_pixel, pixel, pixel)
    optics = Optics(
        axial_resolution=2 * depth_pixel, lateral_resolution=2 * pixel, wavelength=0.5 * depth_pixel
    )
    window = 20 * depth_pixel
    for name, thickness, seed in (("unloaded", unloaded, 1), ("loaded", loaded, 2)):
        volume = SyntheticOCT(
            thickness,
            spacing,
            round(1.6 * thick / depth_pixel) + 20,
            window_depth=window,
            attenuation=0.2 / thick,
            optics=optics,
            seed=seed,
        )
        np.save(tmp_path / f"{name}.npy", np.stack(list(volume)))
    size = [thick / 3] * 3
    text = STUDY.replace("element_size = [0.2, 0.2, 0.1]", f"element_size = {size}")
    text = re.sub(
        r"spacing = .*", f"spacing = {{ z = {depth_pixel}, y = {pixel}, x = {pixel} }}", text
    )
    text += NO_ESTIMATES + "[outputs]\nwrite = []\n"
    study = read_study(make_study(tmp_path, text))
    results = run_study(study).folder

    with xr.open_dataset(results / "thickness.nc") as found:
        assert float(found["x"][-1]) == pytest.approx(field[0])
        error = (found["loaded_thickness"].values - loaded) / depth_pixel
        assert np.sqrt(np.mean(error**2)) < 0.7
        assert float(found["filled"].mean()) < 0.01
    maps = read_result(results / "stress.nc").maps
    true = computational_stress(
        thickness_map(loaded, pixel_spacing=(pixel, pixel)),
        thick,
        MooneyRivlin(2.23, 0.703),
        window_friction=0.15,
        sample_friction=0.05,
        element_size=size,
        threads=1,
        mesh_check=False,
        edge_check=False,
        input_errors=None,
    ).maps
    difference = maps["axial_stress"] - true["axial_stress"]
    assert float(np.abs(difference).mean()) < 0.05 * float(np.abs(true["axial_stress"]).mean())
    force, expected = maps.attrs["window_force_mN"], true.attrs["window_force_mN"]
    assert force == pytest.approx(expected, rel=0.03)
    shutil.rmtree(tmp_path)  # some hundred megabytes
