"""Lateral registration of two maps of the same layer."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import shift as shifted

from optical_palpation.errors import InputError

SUBPIXEL = 20  # the shift is found to a twentieth of a pixel
ROUNDS = 3  # the taper stays where it is while the features move: shift back and look again


def lateral_shift(reference: xr.DataArray, moving: xr.DataArray) -> tuple[float, float]:
    """How far the features of `moving` lie from those of `reference`.

    The maps are freed of their mean plane and fade out towards their borders; missing values count
    as the plane. The shift is the peak of the phase cross-correlation.

    Parameters
    ----------
    reference, moving
        Maps ``(y, x)`` on grids of equal shape and spacing, which may begin at different places;
        coordinates in mm.

    Returns
    -------
    (y, x)
        Shift in mm: a feature at p in `reference` is at p + shift in `moving`.

    Raises
    ------
    InputError
        If the grids differ, or a map has no features to register by.
    """
    from skimage.registration import phase_cross_correlation  # slow to import

    if reference.dims != ("y", "x") or moving.dims != ("y", "x"):
        raise InputError("lateral_shift: both maps must be on (y, x)")
    if reference.shape != moving.shape or min(reference.shape) < 8:
        raise InputError(
            f"lateral_shift: maps of {reference.shape} and {moving.shape} pixels; they must have "
            "the same shape, and at least 8 pixels along each axis"
        )
    steps = [_step(reference, axis) for axis in ("y", "x")]
    other = [_step(moving, axis) for axis in ("y", "x")]
    if not np.allclose(steps, other, rtol=1e-3):
        raise InputError(f"lateral_shift: pixel spacings {steps} and {other} mm differ")
    # by number of pixel, since two scans of one sample may begin anywhere
    total = np.zeros(2)
    sought = _features(reference)
    for _ in range(ROUNDS):
        rest = _features(shift_map(moving, (total[0], total[1])))
        found, *_ = phase_cross_correlation(
            sought, rest, upsample_factor=SUBPIXEL, normalization=None
        )
        # skimage gives the shift that takes `moving` back to `reference`.
        total -= np.asarray(found) * steps
    y, x = (float(moving[a].values[0] - reference[a].values[0]) for a in ("y", "x"))
    return float(total[0]) + y, float(total[1]) + x


def shift_map(moving: xr.DataArray, shift: tuple[float, float]) -> xr.DataArray:
    """Take back a `shift` (y, x) in mm: the map on its own grid, NaN where nothing was measured."""
    pixels = [-s / _step(moving, axis) for s, axis in zip(shift, ("y", "x"), strict=True)]
    values = shifted(moving.values.astype(float), pixels, order=1, cval=np.nan)
    return moving.copy(data=values)


def _step(a: xr.DataArray, axis: str) -> float:
    return float(np.median(np.diff(a[axis].values)))


def _features(a: xr.DataArray) -> NDArray[np.float64]:
    """Map without its mean plane, tapered to its borders."""
    values = a.values.astype(float)
    y, x = (np.linspace(-1.0, 1.0, n) for n in values.shape)
    basis = np.stack(
        [np.ones(values.size), *(g.ravel() for g in np.meshgrid(y, x, indexing="ij"))], 1
    )
    good = np.isfinite(values).ravel()
    if np.sum(good) < 3:
        raise InputError("lateral_shift: a map is empty")
    plane, *_ = np.linalg.lstsq(basis[good], values.ravel()[good], rcond=None)
    rest = np.where(good, values.ravel() - basis @ plane, 0.0).reshape(values.shape)
    if np.std(rest) <= 1e-9 * max(float(np.max(np.abs(values.ravel()[good]))), 1e-30):
        raise InputError("lateral_shift: a map without features cannot be registered")
    return rest * np.outer(np.hanning(len(y)), np.hanning(len(x)))
