"""Gaussian averages of maps, however wide."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import gaussian_filter1d

Array = NDArray[np.float64]

#: Standard deviation in pixels from which Fourier transforms are faster than sums.
_WIDE = 4.0


def gaussian_average(
    field: Array, widths: tuple[float, float], mode: Literal["nearest", "constant"]
) -> Array:
    """Average of maps (..., y, x) by a Gaussian, as of ``scipy.ndimage.gaussian_filter``.

    That sums over all pixels of a wide Gaussian for each pixel, seconds for a large map.

    Parameters
    ----------
    field
        The maps, without missing values.
    widths
        Standard deviations (y, x), pixels.
    mode
        What lies beyond the border: the ``nearest`` pixel, or ``constant`` zero.
    """
    for axis, sigma in zip((-2, -1), widths, strict=True):
        if sigma < _WIDE:
            field = gaussian_filter1d(field, sigma, axis, mode=mode)
        else:
            field = _by_transforms(field, sigma, axis, mode)
    return field


def _by_transforms(field: Array, sigma: float, axis: int, mode: str) -> Array:
    along = np.moveaxis(field, axis, -1)
    size, reach = along.shape[-1], int(4 * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    beyond = [(0, 0)] * (field.ndim - 1) + [(reach, reach)]
    padded = np.pad(along, beyond, mode="edge" if mode == "nearest" else "constant")
    # what goes round the ends is not shown
    length = next_fast_len(size + 2 * reach, real=True)
    product = rfft(padded, length) * rfft(weights / weights.sum(), length)
    averages = irfft(product, length, overwrite_x=True)[..., 2 * reach : 2 * reach + size]
    return np.moveaxis(averages, -1, axis)
