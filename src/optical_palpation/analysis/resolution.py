"""Lateral resolution from the response to an edge (section 7 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import InputError


@dataclass(frozen=True)
class EdgeResponse:
    """How wide a stress map draws an edge.

    Attributes
    ----------
    rise
        Distance from 10 to 90 % of the step, mm.
    gradient_width
        Full width at half maximum of the gradient, mm.
    position
        Where half the step is reached, mm.
    levels
        Stress before and behind the edge, between which the percentages are taken, kPa.
    """

    rise: float
    gradient_width: float
    position: float
    levels: tuple[float, float]


def edge_response(profile: xr.DataArray, levels: tuple[float, float] | None = None) -> EdgeResponse:
    """Measure the 10-90 % response and the width of the gradient across one edge.

    Crossings are those next to the middle of the edge, linear between samples, so that ripples on
    the plateaus do not count. The gradient is that between neighbouring samples; average the map
    along the edge first if it is noisy.

    Parameters
    ----------
    profile
        Stress against one coordinate in mm, cut so that it holds one edge and some plateau on
        both sides.
    levels
        Stress on the plateaus, in the order of the coordinate; by default the medians of the
        first and last fifth of the profile.

    Raises
    ------
    InputError
        If the profile is unusable or holds no edge between the levels.
    """
    if profile.ndim != 1 or profile.dims[0] not in profile.coords or profile.size < 5:
        raise InputError(
            f"edge profile: needs at least 5 values over one coordinate, got {dict(profile.sizes)}"
        )
    x = profile[profile.dims[0]].values.astype(np.float64)
    stress = profile.values.astype(np.float64)
    if not (np.isfinite(stress).all() and np.all(np.diff(x) > 0.0)):
        raise InputError("edge profile: values must be finite and coordinates increase")
    if levels is None:
        end = max(1, x.size // 5)
        levels = float(np.median(stress[:end])), float(np.median(stress[-end:]))
    if levels[0] == levels[1]:
        raise InputError(f"edge profile: both plateaus are at {levels[0]:g} kPa; there is no edge")
    rise = (stress - levels[0]) / (levels[1] - levels[0])

    crossings = _crossings(x, rise - 0.5)
    if crossings.size == 0:
        raise InputError("edge profile: the stress does not pass the middle of the two levels")
    slope = np.abs(np.diff(rise) / np.diff(x))
    centres = 0.5 * (x[1:] + x[:-1])
    # Of several crossings (noise) the one nearest to the steepest place is the edge.
    position = float(crossings[np.argmin(np.abs(crossings - centres[np.argmax(slope)]))])
    low, high = _crossings(x, rise - 0.1), _crossings(x, rise - 0.9)
    before, behind = low[low <= position], high[high >= position]
    if before.size == 0 or behind.size == 0:
        raise InputError(
            "edge profile: the stress does not reach 10 and 90 % of the step on both sides of "
            f"{position:g} mm; take a longer profile or give the levels"
        )
    return EdgeResponse(
        rise=float(behind[0] - before[-1]),
        gradient_width=_half_width(centres, slope, position),
        position=position,
        levels=levels,
    )


def _crossings(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zeros of the piecewise linear function."""
    at = np.flatnonzero((y[:-1] < 0.0) != (y[1:] < 0.0))
    return x[at] - y[at] * (x[at + 1] - x[at]) / (y[at + 1] - y[at])


def _half_width(x: NDArray[np.float64], slope: NDArray[np.float64], position: float) -> float:
    """Full width at half maximum of the peak nearest to the edge."""
    # The edge lies between the two half-maximum points, so the peak is sought around it only.
    near = np.abs(x - position)
    start = int(np.argmin(near))
    while 0 < start < x.size - 1 and slope[start] < max(slope[start - 1], slope[start + 1]):
        start += 1 if slope[start + 1] > slope[start - 1] else -1
    half = _crossings(x, slope - 0.5 * slope[start])
    below, above = half[half <= x[start]], half[half >= x[start]]
    left = below[-1] if below.size else x[0]
    right = above[0] if above.size else x[-1]
    return float(right - left)
