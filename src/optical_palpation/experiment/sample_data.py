"""Small measurements with known answers: OCT volumes, the study of them, and the truth.

``plate`` is a closed form. ``relief`` and ``nodule`` are virtual experiments, the scenes of these
names; what the scenes give is stored in ``samples``, so that a sample is made in seconds.
:func:`store_truth` made it.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.errors import InputError, OutputError
from optical_palpation.experiment.scene import read_scene
from optical_palpation.experiment.virtual import run_experiment
from optical_palpation.experiment.volumes import experiment_volumes, write_volume
from optical_palpation.files import netcdf, replacing
from optical_palpation.material import MooneyRivlin

#: What each sample is, in a sentence.
SAMPLES = {
    "plate": "a flat plate without friction presses a layer of 0.5 mm to 0.42 mm: "
    "uniaxial compression, known in closed form",
    "relief": "a sample a hundred times stiffer than the layer, with a random relief: "
    "it hardly moves, as a coin or bone",
    "nodule": "tissue as soft as the layer, with a stiff nodule below its surface: "
    "it spreads sideways under the layer",
}
_SPACING = (0.0029, 0.04, 0.04)  # z, y, x, mm
_WIDTH = 4.0  # of the unloaded layer, mm
_TILT, _SATURATED = (0.005, 0.01), 0.005
#: In the study of the plate: without any friction nothing would keep the layer in its place. It
#: changes the force by a few parts in a thousand.
_LUBRICATED = 0.001
_STORED = (
    "unloaded_thickness",
    "loaded_thickness",
    "sample_displacement_x",
    "sample_displacement_y",
    "axial_stress",
    "contact_pressure",
    "contact_state",
)

_STUDY = """\
title = "Sample data: {name}"

[unloaded]
volume = "unloaded.npy"

[loaded]
volume = "loaded.npy"

[volumes]
axes = "yzx"              # a stack of B-scans
spacing = {{ z = {z}, y = {y}, x = {x} }}    # mm
scale = "linear"
origin = {{ z = 0.0, y = {y0}, x = {x0} }}       # mm; the volumes reach beyond the unloaded layer

[layer]
extent = [0.0, {width}, 0.0, {width}]    # mm

[material]                # kPa
c10 = {c10}
c01 = {c01}

[friction]
window = {window}
sample = {sample}
{motion}
[grid]
element_size = 0.125      # mm

[outputs]
folder = "results"
"""
_MOTION = """
[sample]
motion = "truth.nc"       # its measured lateral displacement; without it the stress is wrong
"""


def sample_truth(name: str) -> xr.Dataset:
    """What is known of a sample.

    Parameters
    ----------
    name
        A key of ``SAMPLES``.

    Returns
    -------
    xarray.Dataset
        Variables on ``(y, x)`` in mm; the unloaded layer reaches from 0 to 4 mm. As in
        :attr:`~optical_palpation.experiment.ExperimentResult.maps`: thickness in mm,
        ``axial_stress`` in kPa (tension positive), the lateral displacement of the sample's surface
        in mm; NaN where there is no layer. Attributes: ``window_force_mN``, material, friction.

    Raises
    ------
    InputError
        If there is no such sample.
    """
    if name not in SAMPLES:
        raise InputError(f"there is no sample {name!r}; choose one of {', '.join(SAMPLES)}")
    if name == "plate":
        return _plate()
    with as_file(files("optical_palpation.experiment") / "samples" / f"{name}.nc") as path:
        return xr.load_dataset(path, engine="h5netcdf")


def make_sample(name: str, folder: str | Path) -> Path:
    """Write a sample: ``unloaded.npy``, ``loaded.npy``, ``truth.nc`` and ``study.toml``.

    Parameters
    ----------
    name
        A key of ``SAMPLES``.
    folder
        Made if need be; files of these names in it are replaced.

    Returns
    -------
    Path
        The study file.

    Raises
    ------
    InputError
        If there is no such sample.
    OutputError
        If the folder cannot be made or written.
    """
    truth = sample_truth(name)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: the folder cannot be made ({reason})") from error
    for side, volume in experiment_volumes(truth, _SPACING, _TILT, _SATURATED).items():
        write_volume(volume, folder / f"{side}.npy")
    _write_truth(truth, folder / "truth.nc")
    z, y, x = _SPACING
    about = truth.attrs
    study = folder / "study.toml"
    with replacing(study) as temporary:
        text = _STUDY.format(
            name=name,
            x=x,
            y=y,
            z=z,
            x0=round(float(truth["x"][0]), 6),
            y0=round(float(truth["y"][0]), 6),
            width=_WIDTH,
            c10=about["c10_kPa"],
            c01=about["c01_kPa"],
            window=about["window_friction"],
            sample=about["sample_friction"],
            motion=_MOTION if name == "nodule" else "",
        )
        temporary.write_text(text, encoding="utf-8")
    return study


def store_truth(name: str, path: str | Path, element_size: float | None = None) -> None:
    """Run the scene of a sample and store what :func:`sample_truth` returns.

    Raises
    ------
    ConvergenceError
        If the full compression is not reached.
    """
    from optical_palpation.experiment.scene import with_element_size

    scene = read_scene(name)
    if element_size is not None:
        scene = with_element_size(scene, element_size)
    maps = run_experiment(scene).maps
    _write_truth(maps[list(_STORED)], Path(path))


def _plate() -> xr.Dataset:
    """A layer between two plates without friction: uniaxial stress everywhere."""
    unloaded, loaded, width = 0.5, 0.42, _WIDTH
    law = MooneyRivlin(c10=2.23, c01=0.703)
    stress = float(law.uniaxial_stress(loaded / unloaded - 1, "true"))
    axis = np.linspace(-0.2, width + 0.2, 89)
    # A layer that keeps its volume spreads evenly from the middle of its field.
    spread = (unloaded / loaded) ** 0.5
    moved = (axis - width / 2) * (1 - 1 / spread)
    flat = np.ones((axis.size, axis.size))
    lengths = {
        "unloaded_thickness": unloaded * flat,
        "loaded_thickness": loaded * flat,
        "sample_displacement_x": moved * flat,
        "sample_displacement_y": moved[:, None] * flat,
    }
    stresses = {"axial_stress": stress * flat, "contact_pressure": -stress * flat}
    return xr.Dataset(
        {k: (("y", "x"), v, {"units": "mm"}) for k, v in lengths.items()}
        | {k: (("y", "x"), v, {"units": "kPa"}) for k, v in stresses.items()},
        {axis_name: (axis_name, axis, {"units": "mm"}) for axis_name in "yx"},
        {
            "method": "closed form without friction",
            "c10_kPa": law.c10,
            "c01_kPa": law.c01,
            "window_friction": _LUBRICATED,
            "sample_friction": _LUBRICATED,
            "initial_thickness_mm": unloaded,
            "window_force_mN": -stress * (spread * width) ** 2,
        },
    )


def _write_truth(truth: xr.Dataset, path: Path) -> None:
    """Write in single precision and compressed; by way of memory, as all NetCDF files."""
    single = {
        name: {"zlib": True, "complevel": 9, "shuffle": True}
        | ({"dtype": np.float32} if variable.dtype.kind == "f" else {})
        for name, variable in truth.data_vars.items()
    }
    content = netcdf(truth, encoding=single)
    with replacing(path) as temporary:
        temporary.write_bytes(content)
