"""OCT volumes of an imaginary measurement or a virtual experiment, for work without data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.experiment.synthetic_oct import SyntheticOCT
from optical_palpation.files import replacing

Array = NDArray[np.float64]

_SPACING = (0.0029, 0.02, 0.02)  # z, y, x, mm
_PIXELS, _DEPTH = 251, 264
_FIELD = 5.0


def demo_volumes() -> dict[str, SyntheticOCT]:
    """Return the ``unloaded`` and the ``loaded`` volume of a 0.5 mm layer on an imaginary sample.

    A field of 5 x 5 mm, 251 x 251 A-scans of 264 samples. Unloaded, the layer lies on a flat
    support; it is a few micrometres thicker on one side. Loaded, it is pressed to 0.33 to 0.46 mm
    by a sample, slightly tilted, that carries three round bumps, a ridge, and a raised ring and
    bar with steep flanks like the lettering of a coin. The window is tilted, too; one A-scan in two
    hundred is saturated. Signal-to-noise ratio 20 dB.
    """
    axis = np.linspace(0.0, _FIELD, _PIXELS)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    unloaded = 0.5 + 0.001 * (x - 2.5)
    loaded = 0.445 - 0.004 * (x - 2.5) + 0.002 * (y - 2.5) - _relief(x, y)
    return {
        name: SyntheticOCT(
            thickness,
            _SPACING,
            _DEPTH,
            window_depth=0.08,
            tilt=(0.005, 0.01),
            saturated=0.005,
            seed=seed,
        )
        for name, thickness, seed in (("unloaded", unloaded, 1), ("loaded", loaded, 2))
    }


def experiment_volumes(maps: xr.Dataset) -> dict[str, SyntheticOCT]:
    """Return the ``unloaded`` and the ``loaded`` volume of a virtual experiment.

    Parameters
    ----------
    maps
        ``ExperimentResult.maps``. The volumes begin at its first x and y, with the pixels of
        :func:`demo_volumes`; beyond the layer its border goes on.
    """
    dz, dy, dx = _SPACING
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
        window = 0.08
        n_depth = int(np.ceil((window + thickness.max() + 0.2) / dz))
        volumes[name] = SyntheticOCT(thickness, _SPACING, n_depth, window_depth=window, seed=seed)
    return volumes


def write_volume(volume: SyntheticOCT, path: str | Path) -> None:
    """Write a volume, B-scan by B-scan, as a stack of B-scans in a NumPy file (axes y, z, x).

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    nz, ny, nx = volume.shape
    with replacing(path) as temporary:
        stack = np.lib.format.open_memmap(temporary, "w+", np.float32, (ny, nz, nx))
        for y, image in enumerate(volume):
            stack[y] = image
        stack.flush()


def _relief(x: Array, y: Array) -> Array:
    """Height of the sample above its plane, mm."""
    height = np.zeros_like(x)
    for x0, y0, width, bump in (
        (1.2, 3.8, 0.35, 0.09),
        (2.1, 4.2, 0.2, 0.05),
        (4.0, 1.1, 0.5, 0.1),
    ):
        height += bump * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width**2))
    height += 0.07 * np.exp(-(_distance(x, y, (0.8, 0.8), (2.6, 1.6)) ** 2) / (2 * 0.12**2))
    ring = np.abs(np.hypot(x - 3.6, y - 3.5) - 0.55)
    bar = _distance(x, y, (0.7, 2.3), (2.3, 2.7))
    return height + 0.06 * _step(0.12 - ring) + 0.06 * _step(0.12 - bar)


def _step(inside: Array) -> Array:
    """Go from 0 to 1 where the distance to the outline changes sign, within some 0.1 mm."""
    return 0.5 * (1.0 + np.tanh(inside / 0.05))


def _distance(x: Array, y: Array, start: tuple[float, float], end: tuple[float, float]) -> Array:
    """Return the distance from a line segment, mm."""
    along_x, along_y = end[0] - start[0], end[1] - start[1]
    share = ((x - start[0]) * along_x + (y - start[1]) * along_y) / (along_x**2 + along_y**2)
    share = np.clip(share, 0.0, 1.0)
    return np.hypot(x - start[0] - share * along_x, y - start[1] - share * along_y)
