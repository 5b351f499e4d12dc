"""The pair of complex OCT volumes of a friction measurement."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optical_palpation.arguments import number
from optical_palpation.errors import InputError
from optical_palpation.volume import Volume, open_volume


def read_pair(
    before: str | Path, after: str | Path, region: float | None = None, **facts: Any
) -> tuple[NDArray[np.complexfloating], NDArray[np.complexfloating], float, float]:
    """Read two complex volumes, cut to a square about the middle of their field of view.

    Parameters
    ----------
    before, after
        Files of any known format, see :func:`~optical_palpation.volume.open_volume`.
    region
        Width of the square, mm; by default the largest that both sides of the field hold.
    facts
        What the files do not say, as for ``open_volume``; the scale is linear.

    Returns
    -------
    before, after : numpy.ndarray
        ``(z, y, x)``.
    spacing : float
        Along z, mm.
    region : float
        Width of the square, mm.

    Raises
    ------
    InputError
        If a volume cannot be read, the two differ in size or spacing, or the region does not fit.
    """
    if region is not None:
        region = number(region, "region", "a width in mm")
    facts["scale"] = "linear"  # as complex samples are; real ones are refused for being real
    with open_volume(before, **facts) as first, open_volume(after, **facts) as second:
        a, b = first.metadata, second.metadata
        for metadata in (a, b):
            if not metadata.is_complex:
                raise InputError(
                    f"{metadata.path}: holds real samples ({metadata.dtype}); friction needs "
                    "complex ones, with the phase"
                )
        if a.shape != b.shape or not np.allclose(a.spacing, b.spacing, rtol=1e-6, equal_nan=True):
            raise InputError(
                f"{before} has {a.shape} samples of {tuple(a.spacing)} mm, {after} {b.shape} of "
                f"{tuple(b.spacing)} mm (z, y, x); they must be alike"
            )
        if not np.allclose(a.origin, b.origin, atol=1e-3 * min(a.spacing.z, a.spacing.x)):
            raise InputError(
                f"{before} begins at {tuple(a.origin)} mm, {after} at {tuple(b.origin)} mm (z, y, "
                "x); they must show the same place"
            )
        if a.shape[1] < 2:
            raise InputError(
                f"{before}: is a single B-scan; friction needs the displacement averaged over a "
                "square, so a volume of several B-scans"
            )
        field = a.shape[1] * a.spacing.y, a.shape[2] * a.spacing.x
        width = min(field) if region is None else region
        if not 0.0 < width <= min(field) * (1.0 + 1e-6):
            raise InputError(
                f"region = {width:g} mm: must be positive and at most the field of view of "
                f"{before}, {field[1]:g} x {field[0]:g} mm (x, y)"
            )
        pair = [_middle(volume, width) for volume in (first, second)]
    for name, samples in zip((before, after), pair, strict=True):
        if not np.isfinite(samples).all():
            raise InputError(
                f"{name}: {int((~np.isfinite(samples)).sum())} samples of the square are missing "
                "or infinite; choose a region without them"
            )
    return pair[0], pair[1], a.spacing.z, width


def _middle(volume: Volume, width: float) -> NDArray[Any]:
    _, ny, nx = volume.shape
    count = [
        max(1, min(n, round(width / step)))
        for n, step in zip((ny, nx), volume.metadata.spacing[1:], strict=True)
    ]
    y, x = ((n - k) // 2 for n, k in zip((ny, nx), count, strict=True))
    data = volume.to_xarray().isel(y=slice(y, y + count[0]), x=slice(x, x + count[1]))
    return np.asarray(data.values)
