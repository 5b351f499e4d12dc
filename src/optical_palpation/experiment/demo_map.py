"""A loaded-thickness map from an explicit formula, for trying the software without data."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from optical_palpation.thickness import thickness_map

Array = NDArray[np.float64]

_PIXELS = 251
_FIELD = 5.0
_RESOLUTION = 0.015  # standard deviation of the lateral response of the imaging, mm
_NOISE = 0.0005  # standard deviation of the detected thickness, mm
_MISSING, _SPIKES = 0.002, 0.0005


def demo_thickness_map(seed: int = 1) -> xr.DataArray:
    """Return the loaded thickness of a 0.5 mm layer pressed on an imaginary sample, as OCT sees it.

    A field of 5 x 5 mm, 251 x 251 pixels. The sample, slightly tilted, carries three round bumps,
    a ridge, and a raised ring and bar with steep flanks like the lettering of a coin. The map is
    blurred by the lateral resolution of the imaging; detection noise (0.5 um), missing values
    (0.2 %) and spikes (0.05 % of the pixels, 120 um off) are added.

    Parameters
    ----------
    seed
        Of the random numbers for noise, missing values and spikes; the relief does not depend on
        it.

    Returns
    -------
    xarray.DataArray
        ``loaded_thickness`` in mm on ``(y, x)``, 0.33 to 0.46 mm apart from the spikes, NaN where
        missing.
    """
    axis = np.linspace(0.0, _FIELD, _PIXELS)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    thickness = 0.445 - 0.004 * (x - 2.5) + 0.002 * (y - 2.5) - _relief(x, y)
    blurred = ndimage.gaussian_filter(
        thickness, _RESOLUTION * (_PIXELS - 1) / _FIELD, mode="nearest"
    )
    random = np.random.default_rng(seed)
    seen = blurred + random.normal(0.0, _NOISE, blurred.shape)
    chance = random.random(blurred.shape)
    spikes = (chance > _MISSING) & (chance < _MISSING + _SPIKES)
    seen[spikes] += random.choice([-0.12, 0.12], size=int(spikes.sum()))
    seen[chance < _MISSING] = np.nan
    return thickness_map(seen, x=axis, y=axis, where="demo map")


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
