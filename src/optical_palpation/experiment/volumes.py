"""OCT volumes of a virtual experiment, for work without data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.experiment.synthetic_oct import SyntheticOCT
from optical_palpation.files import replacing

_SPACING = (0.0029, 0.02, 0.02)  # z, y, x, mm
_WINDOW, _BELOW = 0.08, 0.2


def experiment_volumes(
    maps: xr.Dataset,
    spacing: tuple[float, float, float] = _SPACING,
    tilt: tuple[float, float] = (0.0, 0.0),
    saturated: float = 0.0,
) -> dict[str, SyntheticOCT]:
    """Return the ``unloaded`` and the ``loaded`` volume of a virtual experiment.

    Parameters
    ----------
    maps
        ``ExperimentResult.maps``: ``unloaded_thickness`` and ``loaded_thickness`` on ``(y, x)``,
        mm. The volumes begin at the first x and y; beyond the layer its border goes on.
    spacing
        Pixels (z, y, x) of the volumes, mm.
    tilt, saturated
        Slope of the window and share of saturated A-scans, as for
        :class:`~optical_palpation.experiment.synthetic_oct.SyntheticOCT`.
    """
    dz, dy, dx = spacing
    axes = []
    for name, step in (("x", dx), ("y", dy)):
        first, last = float(maps[name][0]), float(maps[name][-1])
        axes.append(np.minimum(np.arange(first, last + 1e-6 * step, step), last))
    x, y = axes
    volumes = {}
    for seed, name in enumerate(("unloaded", "loaded"), 1):
        field = maps[f"{name}_thickness"]
        for axis in "xy":
            field = field.interpolate_na(axis, method="nearest", fill_value="extrapolate")
        thickness = field.interp(x=x, y=y).values
        slope = sum(abs(t) * np.ptp(axis) / 2 for t, axis in zip(tilt, (y, x), strict=True))
        n_depth = int(np.ceil((_WINDOW + slope + thickness.max() + _BELOW) / dz))
        volumes[name] = SyntheticOCT(
            thickness,
            spacing,
            n_depth,
            window_depth=_WINDOW,
            tilt=tilt,
            saturated=saturated,
            seed=seed,
        )
    return volumes


def write_volume(volume: SyntheticOCT, path: str | Path) -> None:
    """Write a volume, B-scan by B-scan, as a stack of B-scans in a NumPy file (axes y, z, x).

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    nz, ny, nx = volume.shape
    header = {"descr": "<f4", "fortran_order": False, "shape": (ny, nz, nx)}
    # A stream, and no mapped file: one that the disk has no room for kills the process.
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for image in volume:
            file.write(image.astype("<f4").tobytes())
