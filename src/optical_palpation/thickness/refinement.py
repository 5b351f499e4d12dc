"""Boundaries to a fraction of a pixel, from the intensity around a first estimate of them.

The intensity is flattened along the estimate, so that averaging laterally over a few resolution
cells leaves the edge sharp. The boundary is then where the averaged profile is most likely: speckle
being exponential, an average of it is gamma distributed, with the mean of a step that is blurred
by the point-spread function. A reflection along the step adds the point-spread function itself.
Estimate and average are repeated until the surface stays.
"""

import math
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d, median_filter, uniform_filter
from scipy.special import ndtr

from optical_palpation.parallel import in_parallel

from .tracking import Edge, column_weights

# Each round tries positions this far to either side, in profiles this long (widths of the step).
SEARCHES = ((7.0, 13.0), (3.0, 10.0), (2.0, 9.0))
FAR = 4.0  # widths above the step from which on its tail, 3e-5 of the bright side, is lost in noise
NEAR = 6.0  # widths below the step over which the brightness of the sample counts
# What is this much brighter than the layer is sample; how much brighter says nothing about where
# it begins. Real samples often grow brighter below their surface.
CEILING = 20.0
# A reflection narrows the rise of the step that it lies on, and so would a finer resolution than
# that measured: what one finer by this factor explains as well is no reflection.
FINER = 0.9
PATCH = 6.0  # lateral averages (standard deviations) over which a reflection is equally bright
# Reflections tried, as bright as the sample is over so many axial resolutions (deviations).
GLINTS: NDArray[np.float64] = np.array([0.0, *(0.25 * 1.25 ** np.arange(21))])
# Widths of the point-spread function: half as many again as the widest step that is fitted has. A
# surface whose slope blurs it by more follows noise.
ROUGH = 8.0
OFFSET = 0.05  # of the bright side, added to the profile: keeps faint tails from steering
PIXEL_VARIANCE = 1 / 12 + 1 / 12  # blur by the pixel itself and by interpolation between pixels


@njit(cache=True, nogil=True)
def take_band(intensity, first, out):
    """Copy the rows first[x] ... of each column of a B-scan `[z, x]` to out `[x, k]`."""
    nz, nx = intensity.shape
    for k in range(out.shape[1]):
        for x in range(nx):
            z = first[x] + k
            if 0 <= z < nz:
                out[x, k] = intensity[z, x]
            else:
                out[x, k] = -1.0


@njit(cache=True)
def _flatten(band, centre, weight, profile, share):
    """Weighted profiles around `centre[y, x]` (pixels of the band), and their weights."""
    in_parallel(_flatten_rows, len(profile), (band, centre, weight, profile, share))


@njit
def _flatten_rows(band, centre, weight, profile, share, begin, end):
    _, nx, nk = profile.shape
    half = nk // 2
    for y in range(begin, end):
        for x in range(nx):
            for k in range(nk):
                at = centre[y, x] + k - half
                lower = math.floor(at)
                part = np.float32(at - lower)
                value = np.float32(0.0)
                count = np.float32(0.0)
                if lower >= 0 and lower + 1 < band.shape[2]:
                    a, b = band[y, x, lower], band[y, x, lower + 1]
                    if a >= 0 and b >= 0:
                        value = weight[y, x] * ((1 - part) * a + part * b)
                        count = weight[y, x]
                profile[y, x, k] = value
                share[y, x, k] = count


@njit(cache=True)
def _fit_step(profile, level, rises, dark_ends, bright_starts, bright_ends, step, shift, contrast):
    """Most likely position of a blurred step in each profile, and the contrast of its sides.

    `rises[i, t, k]` is the unit step of width i at trial position t. It is dark up to pixel
    `dark_ends[i, t]`, and its height is taken between `bright_starts[i, t]` and
    `bright_ends[i, t]`; `level[y, x]` chooses the width.
    A parabola through the best three trials gives the fraction. The contrast is that of Michelson,
    (bright - dark) / (bright + dark).
    """
    in_parallel(
        _fit_step_rows,
        len(profile),
        (profile, level, rises, dark_ends, bright_starts, bright_ends, step, shift, contrast),
    )


@njit
def _fit_step_rows(
    profile, level, rises, dark_ends, bright_starts, bright_ends, step, shift, contrast, begin, end
):
    _, nx, nk = profile.shape
    tries = rises.shape[1]
    score = np.empty(tries)
    contrasts = np.empty(tries)
    total = np.empty(nk + 1)
    for y in range(begin, end):
        for x in range(nx):
            p = profile[y, x]
            total[0] = 0.0
            for k in range(nk):
                total[k + 1] = total[k] + p[k]
            quarter = nk // 4
            ceiling = CEILING * total[quarter] / quarter + 1e-30
            offset = OFFSET * min(ceiling, (total[nk] - total[nk - quarter]) / quarter) + 1e-30
            best = 0
            for t in range(tries):
                i = level[y, x]
                rise = rises[i, t]
                top, start, end = dark_ends[i, t], bright_starts[i, t], bright_ends[i, t]
                dark = total[top] / top
                height = (total[end] - total[start] - (end - start) * dark) / rise[start:end].sum()
                score[t] = np.inf
                contrasts[t] = max(0.0, height / (height + 2.0 * dark + 1e-30))
                if height > 0:
                    score[t] = 0.0
                    for k in range(nk):
                        mean = min(dark + height * rise[k], ceiling) + offset
                        score[t] += math.log(mean) + (min(p[k], ceiling) + offset) / mean
                if score[t] < score[best]:
                    best = t
            contrast[y, x] = contrasts[best]
            shift[y, x] = (best - tries // 2) * step
            if 0 < best < tries - 1:
                a, b = score[best - 1] - score[best], score[best + 1] - score[best]
                if 0 < a + b < np.inf:
                    shift[y, x] += 0.5 * step * (a - b) / (a + b)


@njit(cache=True)
def _fit_line(profile, kernel, reach, shift, quality):
    """Centre of the line in each profile, by correlation of its logarithm with `kernel`.

    The logarithm makes a saturated line and its side lobes as symmetric as they are, and no
    brighter than they need be.
    """
    in_parallel(_fit_line_rows, len(profile), (profile, kernel, reach, shift, quality))


@njit
def _fit_line_rows(profile, kernel, reach, shift, quality, begin, end):
    _, nx, nk = profile.shape
    half, wide = nk // 2, len(kernel) // 2
    log = np.empty(nk)
    score = np.empty(2 * reach + 1)
    for y in range(begin, end):
        for x in range(nx):
            brightest = max(profile[y, x].max(), 1e-30)
            for k in range(nk):
                log[k] = math.log(profile[y, x, k] + 1e-4 * brightest)
            best = 0
            for t in range(2 * reach + 1):
                score[t] = np.sum(
                    log[half + t - reach - wide : half + t - reach + wide + 1] * kernel
                )
                if score[t] > score[best]:
                    best = t
            shift[y, x] = best - reach
            k = half + best - reach
            line = profile[y, x, k]
            flank = max(profile[y, x, : k - wide + 1].mean(), profile[y, x, k + wide :].mean())
            quality[y, x] = max(0.0, (line - flank) / (line + flank + 1e-30))
            if 0 < best < 2 * reach:
                a, b = score[best] - score[best - 1], score[best] - score[best + 1]
                if a + b > 0:
                    shift[y, x] += 0.5 * (a - b) / (a + b)


def averaged(
    profile: NDArray[np.float32], share: NDArray[np.float32], sigmas: tuple[float, float]
) -> NDArray[np.float32]:
    """Gaussian lateral average of weighted profiles `[y, x, k]`; no data take the mean of all.

    The weights `share` are averaged in place.
    """
    for axis, sigma in enumerate(sigmas):
        if profile.shape[axis] > 1:
            gaussian_filter1d(
                profile, sigma, axis=axis, mode="reflect", truncate=2.5, output=profile
            )
            gaussian_filter1d(share, sigma, axis=axis, mode="reflect", truncate=2.5, output=share)
    weight = np.sum(share, axis=2, keepdims=True)
    mean = np.sum(profile, axis=2, keepdims=True) / np.maximum(weight, 1e-30)
    return np.where(share > 1e-6, profile / np.maximum(share, 1e-6), mean)


def refine(
    band: NDArray[np.float32],
    first: NDArray[np.int64],
    start: NDArray[np.float64],
    floor: NDArray[np.float32],
    edge: Edge,
    *,
    sigma: float,
    cell: tuple[float, float],
    lateral: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth of a boundary to a fraction of a pixel, and its quality in [0, 1].

    Parameters
    ----------
    band
        Intensity `[y, x, k]` from the row `first[y, x]` of the volume on; negative: no data.
    start
        First estimate `[y, x]`, pixels.
    floor
        Noise floor of the A-scans `[y, x]`.
    edge, sigma
        As for `tracking.track`.
    cell
        Standard deviations of the lateral point-spread function along (y, x), pixels.
    lateral
        Those of the lateral average.
    """
    if edge == "fall":
        last = band.shape[2] - 1
        flipped = np.ascontiguousarray(band[..., ::-1])
        depth, quality = refine(
            flipped, -(first + last), -start, floor, "rise", sigma=sigma, cell=cell, lateral=lateral
        )
        return -depth, quality
    weight = column_weights(floor)
    depth = start.copy()
    for reach, span in SEARCHES:
        # Flattening along the noise of the last estimate would confirm it: smooth it first.
        depth = _smooth(depth, lateral)
        blur = _blur(depth, cell, sigma)
        typical = float(np.median(blur))
        half = max(round(span * typical), 8)
        profile, share = np.empty((2, *start.shape, 2 * half + 1), np.float32)
        _flatten(band, depth - first, weight, profile, share)
        mean = averaged(profile, share, lateral)
        if edge == "rise":
            shift, quality = _step_shift(mean, sigma, blur, reach * typical, lateral)
            # Without data below there is nothing bright to tell a step by: not seen.
            below = share[..., half : half + round(NEAR * typical) + 1].min(axis=2)
            quality[below < 0.5 * share.max(axis=2)] = 0.0
        else:
            shift, quality = np.zeros((2, *start.shape))
            wide = max(round(4.0 * sigma), 2)
            kernel = np.exp(-(np.arange(-wide, wide + 1) ** 2) / (4.0 * sigma**2))
            _fit_line(mean, kernel, min(round(reach * typical), half - wide - 1), shift, quality)
        depth = depth + shift
    return depth, quality


def _step_shift(
    mean: NDArray[np.float32],
    sigma: float,
    blur: NDArray[np.float64],
    reach: float,
    lateral: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shift of a step of width `blur` in averaged profiles, and its contrast.

    Below the step the mean falls as the sample attenuates the light. On it may lie a reflection.
    """
    half = mean.shape[2] // 2
    # Where a surface is as rough as noise, no finer than that: profiles and searches are long.
    step = max(sigma, float(np.median(blur)) / ROUGH) / 3.0
    trials = step * np.arange(-round(reach / step), round(reach / step) + 1)
    depth = np.arange(-half, half + 1) - trials[:, None]
    decay = _decay(mean)
    widths = sigma * 1.2 ** np.arange(10)[:, None, None]
    rises = ndtr(depth / widths) * np.exp(-decay * np.maximum(depth, 0.0))
    dark_ends = np.maximum(np.sum(depth < -FAR * widths, axis=-1), max(half // 4, 1))
    bright_starts = np.minimum(np.sum(depth <= 2.0 * widths, axis=-1), 2 * half - 2)
    bright_ends = np.maximum(np.sum(depth <= NEAR * widths, axis=-1), bright_starts + 3)
    level = np.argmin(np.abs(np.log(blur[..., None] / widths.ravel())), axis=-1)
    # One unit step after the other for every width, with every strength of a reflection.
    strengths = sigma * GLINTS
    glint = _glints(mean, blur, decay, lateral)
    strength = np.rint(np.interp(glint, strengths, np.arange(len(strengths)))).astype(np.intp)
    # of those that occur, which are a few
    used, level_used = np.unique(level + len(widths) * strength, return_inverse=True)
    used_strength, width = np.divmod(used, len(widths))
    rises = rises[width] + strengths[used_strength, None, None] * _spread(depth, widths)[width]
    shift, contrast = np.zeros((2, *level.shape))
    _fit_step(
        mean,
        level_used.reshape(level.shape),
        rises.astype(np.float32),
        dark_ends[width],
        bright_starts[width],
        bright_ends[width],
        step,
        shift,
        contrast,
    )
    return shift, contrast


def _spread(depth: NDArray, width: NDArray | float) -> NDArray[np.float64]:
    """Point-spread function of a unit reflection."""
    return np.exp(-0.5 * (depth / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)


def _glints(
    mean: NDArray[np.float32],
    blur: NDArray[np.float64],
    decay: float,
    lateral: tuple[float, float],
) -> NDArray[np.float64]:
    """Reflection along the step, as bright as so many pixels of what lies below it.

    It is taken from the median profiles of patches of the map, in which it stands out of speckle
    that hides it in the single ones, and from the flatter half of each, which steep slopes blur
    less.
    """
    size = [min(max(round(PATCH * s), 1), n) for s, n in zip(lateral, blur.shape, strict=True)]
    rows, columns = (
        np.array_split(np.arange(n), max(n // s, 1)) for n, s in zip(blur.shape, size, strict=True)
    )
    found = np.empty((len(rows), len(columns)))
    for i, y in enumerate(rows):
        for j, x in enumerate(columns):
            patch = np.ix_(y, x)
            flat = blur[patch] <= np.median(blur[patch])
            profile = np.median(mean[patch][flat], axis=0).astype(float)
            found[i, j] = _glint(profile, FINER * float(np.median(blur[patch][flat])), decay)
    found = median_filter(found, 3, mode="nearest")
    for axis, parts in enumerate((rows, columns)):
        found = np.repeat(found, [len(part) for part in parts], axis=axis)
    return uniform_filter(found, size, mode="nearest")


def _glint(profile: NDArray[np.float64], width: float, decay: float) -> float:
    """Reflection on the step of a profile, by least squares of relative errors, as speckle has."""
    half = len(profile) // 2
    seen = np.arange(-half, half + 1) <= NEAR * width
    trials = width * np.linspace(-2.0, 2.0, 49)[:, None]
    depth = np.arange(-half, half + 1)[seen] - trials
    step = ndtr(depth / width) * np.exp(-decay * np.maximum(depth, 0.0))
    parts = np.stack([np.ones_like(depth), step, _spread(depth, width)], axis=-1)
    parts /= np.maximum(profile[seen], 1e-3 * profile[seen].max() + 1e-30)[:, None]

    def fitted(parts: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Shares of the parts whose sum is nearest to 1, and how much of it they explain."""
        onto = parts.sum(axis=1)
        products = parts.transpose(0, 2, 1) @ parts
        products += 1e-12 * np.max(products) * np.eye(parts.shape[2])
        shares = np.linalg.solve(products, onto[..., None])[..., 0]
        return shares, np.sum(shares * onto, axis=1)

    shares, explained = fitted(parts)
    reflects = (shares[:, 1] > 0.0) & (shares[:, 2] > 0.0)
    best = int(np.argmax(np.where(reflects, explained, fitted(parts[..., :2])[1])))
    if not reflects[best] or best in (0, len(trials) - 1):  # at an end it is not on the step
        return 0.0
    return float(shares[best, 2] / shares[best, 1])


def _blur(
    depth: NDArray[np.float64], cell: tuple[float, float], sigma: float
) -> NDArray[np.float64]:
    """Width of the step at a surface, pixels.

    The axial point-spread function widens it, the slope of the surface within the lateral one,
    and the pixels themselves.
    """
    variance = np.full_like(depth, sigma**2 + PIXEL_VARIANCE)
    for axis, width in enumerate(cell):
        if depth.shape[axis] > 1:
            variance += (width * np.gradient(depth, axis=axis)) ** 2
    return np.sqrt(variance)


def _decay(mean: NDArray[np.float32]) -> float:
    """Attenuation below the surface, per pixel: a median over all profiles."""
    half = mean.shape[2] // 2
    cuts = [half + round(share * half) for share in (0.36, 0.66, 0.96)]
    near, far = (np.mean(mean[..., a:b], axis=-1) for a, b in pairwise(cuts))
    good = (near > 0) & (far > 0)
    ratio = np.median(near[good] / far[good]) if np.any(good) else 1.0
    return max(float(np.log(ratio)) / (0.5 * (cuts[2] - cuts[0])), 0.0)


def _smooth(depth: NDArray[np.float64], lateral: tuple[float, float]) -> NDArray[np.float64]:
    """Lateral average of a surface; it goes on over the border with its slope."""
    sigmas = [0.5 * s if n > 1 else 0.0 for s, n in zip(lateral, depth.shape, strict=True)]
    pad = [min(int(4 * s) + 1, n - 1) for s, n in zip(sigmas, depth.shape, strict=True)]
    padded = np.pad(depth, [(p, p) for p in pad], mode="reflect", reflect_type="odd")
    inner = tuple(slice(p, n - p) for p, n in zip(pad, padded.shape, strict=True))
    return gaussian_filter(padded, sigmas)[inner]
