"""Other surfaces in a volume that may be the layer's boundary as well as the one that was taken."""

import numpy as np
from numpy.typing import NDArray

from .tracking import Reduced, bridged, line_evidence, mean_over, without_lines

APART = 12.0  # axial resolutions (standard deviations) from a boundary on which a rival is another
NEARLY = 0.8  # of the decibels by which the window's line stands out of its surroundings
BRIGHTER = np.log(2.0)  # what becomes so much brighter within the layer is no haze


def rival_line(
    reduced: Reduced,
    sigma: float,
    window: NDArray[np.float64],
    sample: NDArray[np.float64],
    search: tuple[float, float],
) -> float | None:
    """How far from the window (pixels) another line lies that is nearly as bright.

    Parameters
    ----------
    reduced, sigma
        As for `tracking.track`.
    window, sample
        Depths `[y, x]` of the boundaries, pixels; near the sample a reflection is the sample's.
    search
        Depths between which the window was searched, pixels.
    """
    z = np.arange(reduced.log.shape[-1])
    inside = np.broadcast_to((z >= search[0]) & (z <= search[1]), reduced.log.shape)
    evidence = line_evidence(reduced.log, sigma, inside)
    top, bottom = (depth[reduced.nodes][..., None] for depth in (window, sample))
    own = np.max(np.where(np.abs(z - top) <= 2.0 * sigma, evidence, 0.0), axis=-1)
    apart = (np.abs(z - top) > APART * sigma) & (np.abs(z - bottom) > APART * sigma)
    others = np.where(apart & inside, evidence, 0.0)
    if np.median(np.max(others, axis=-1)) < NEARLY * np.median(own):
        return None
    return float(np.median(np.abs(np.argmax(others, axis=-1) - top[..., 0])))


def rival_rise(
    reduced: Reduced, sigma: float, window: NDArray[np.float64], sample: NDArray[np.float64]
) -> float | None:
    """How far above the sample (pixels) something begins to scatter all along its surface.

    Haze that fills the layer is none. Parameters are those of :func:`rival_line`.
    """
    top, bottom = (depth[reduced.nodes] for depth in (window, sample))
    log = bridged(reduced.log)
    opened = without_lines(log, sigma)
    offsets = np.arange(-int(np.ceil(np.max(bottom - top))), 1)
    z = np.round(bottom)[..., None].astype(np.int64) + offsets
    within = (z > (top + APART * sigma)[..., None]) & (z < log.shape[-1])
    along = np.take_along_axis(opened, np.clip(z, 0, log.shape[-1] - 1), axis=-1)
    seen = np.mean(within, axis=(0, 1)) > 0.5
    profile = np.nanmedian(np.where(within, along, np.nan)[..., seen], axis=(0, 1))
    # A block of a steep surface holds some of the sample above its centre.
    steep = [np.median(np.abs(np.diff(bottom, axis=a))) for a in (0, 1) if bottom.shape[a] > 1]
    near = round(4.0 * max(sigma, 1.0) + 0.5 * sum(steep))
    mean = round(6.0 * max(sigma, 1.0))
    rise = (mean_over(profile, 1, mean) - mean_over(profile, -mean, -1))[mean : -near - mean]
    if len(rise) == 0 or np.max(rise) < BRIGHTER:
        return None
    return -float(offsets[seen][mean + int(np.argmax(rise))])
