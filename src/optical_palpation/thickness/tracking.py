"""Surfaces of least cost through a whole volume, to within a few pixels.

The volume is reduced laterally to blocks, which averages speckle and bounds memory; each boundary
is then the surface of least cost in the reduced volume, found by dynamic programming along the
four lateral directions (semi-global matching: Hirschmueller, IEEE Trans. Pattern Anal. Mach.
Intell. 30:328, 2008). `refinement` finishes the job at full resolution.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from optical_palpation.errors import InputError
from optical_palpation.parallel import in_parallel

from .intensity import Read

Edge = Literal["rise", "fall", "line"]

BLOCK = 4  # lateral pixels per side of a block: some ten looks at the speckle
QUIET_ROWS = 32  # an A-scan's noise floor is taken from stretches of this many pixels
SLOPE_COST = 0.12  # cost of a slope of 1 from block to block; a clear edge is worth 1
ANCHOR_COST = 20.0  # of leaving an anchor, which falls off over this many blocks:
ANCHOR_REACH = 4.0
JUMP_COST = 0.6  # the most that two neighbouring blocks can disagree for


@njit(cache=True, nogil=True)
def _noise_floor(intensity):
    """Lower quartile over depth of the mean intensity of quiet stretches, per column."""
    nz, nx = intensity.shape
    n = nz // QUIET_ROWS
    floor = np.zeros(nx, np.float32)
    means = np.empty((nx, max(n, 1)), np.float32)
    count = np.zeros(nx, np.int64)
    for block in range(n):
        total = np.zeros(nx, np.float32)
        valid = np.zeros(nx, np.int64)
        for z in range(block * QUIET_ROWS, (block + 1) * QUIET_ROWS):
            for x in range(nx):
                if intensity[z, x] >= 0:
                    total[x] += intensity[z, x]
                    valid[x] += 1
        for x in range(nx):
            if valid[x] == QUIET_ROWS:
                means[x, count[x]] = total[x] / QUIET_ROWS
                count[x] += 1
    for x in range(nx):
        if count[x] > 0:
            floor[x] = np.sort(means[x, : count[x]])[count[x] // 4]
    return floor


@njit(cache=True, nogil=True)
def _add_to_blocks(intensity, weight, total, share):
    """Add the weighted columns of a B-scan `[z, x]` to sums per block `[block, z]`."""
    nz, nx = intensity.shape
    last = total.shape[0] - 1
    for z in range(nz):
        for x in range(nx):
            if intensity[z, x] >= 0:
                block = min(x // BLOCK, last)
                total[block, z] += weight[x] * intensity[z, x]
                share[block, z] += weight[x]


@dataclass(frozen=True)
class Reduced:
    """Volume reduced to lateral blocks, and the noise floor of each A-scan.

    `log` is the logarithm of the mean intensity `[y, x, z]` (NaN: no data); the block centres are
    at the pixels `y` and `x`; `floor[y, x]` is at full lateral resolution, in linear intensity.
    """

    log: NDArray[np.float32]
    y: NDArray[np.float64]
    x: NDArray[np.float64]
    floor: NDArray[np.float32]

    @property
    def nodes(self) -> tuple[NDArray[np.intp], ...]:
        """Index of the pixels next to the block centres in a map `[y, x]`."""
        return np.ix_(np.round(self.y).astype(int), np.round(self.x).astype(int))


def column_weights(floor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weights of A-scans in an average: those that a saturated detector lifted count less."""
    typical = max(np.median(floor), 1e-30)
    return (np.minimum(1.0, typical / np.maximum(floor, 1e-30)) ** 2).astype(np.float32)


def reduce_volume(
    intensity: Read, shape: tuple[int, int, int], progress: Callable[[float], None]
) -> Reduced:
    """Read the volume once, B-scan by B-scan, into blocks; intensities below 0 are no data."""
    nz, ny, nx = shape
    nby, nbx = max(ny // BLOCK, 1), max(nx // BLOCK, 1)
    log = np.empty((nby, nbx, nz), np.float32)
    floor = np.empty((ny, nx), np.float32)
    for by in range(nby):
        total, share = np.zeros((2, nbx, nz), np.float32)
        for y in range(by * BLOCK, ny if by == nby - 1 else (by + 1) * BLOCK):
            image = intensity(y)
            floor[y] = _noise_floor(image)
            _add_to_blocks(image, column_weights(floor[y]), total, share)
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(share > 0, total / share, np.nan)
            log[by] = np.log(np.maximum(mean, np.float32(1e-3) * np.median(floor[y])))
        progress((by + 1) / nby)
    if np.isnan(log).all():
        raise InputError(
            "the volume holds no data: its samples are zero or missing, or most are negative (if a "
            "background was subtracted, give the volume with it)"
        )
    centres = [
        np.array([(i * BLOCK + (n if i == nb - 1 else (i + 1) * BLOCK) - 1) / 2 for i in range(nb)])
        for n, nb in ((ny, nby), (nx, nbx))
    ]
    return Reduced(log, centres[0], centres[1], floor)


def mean_over(a: NDArray, first: int, last: int) -> NDArray:
    """Mean of `a` over the pixels z + first ... z + last along the last axis, edges repeated."""
    size = last - first + 1
    shifted = np.clip(np.arange(a.shape[-1]) + first + size // 2, 0, a.shape[-1] - 1)
    return uniform_filter1d(a, size, axis=-1, mode="nearest")[..., shifted]


def bridged(log: NDArray[np.float32]) -> NDArray[np.float32]:
    """Take the nearest sample along depth where there is no data, or its end would be an edge.

    A boundary within a gap lies in its middle; where a whole column is missing there is none.
    """
    missing = np.isnan(log)
    if not missing.any():
        return log
    z = np.arange(log.shape[-1], dtype=np.int32)
    last = log.shape[-1]
    above = np.maximum.accumulate(np.where(missing, -last, z), axis=-1)
    below = np.minimum.accumulate(np.where(missing, 2 * last, z)[..., ::-1], axis=-1)[..., ::-1]
    nearest = np.clip(np.where(z - above <= below - z, above, below), 0, last - 1)
    filled = np.take_along_axis(log, nearest, axis=-1)
    return np.where(np.isnan(filled), np.nanmin(log), filled)


def without_lines(log: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """A grey opening along depth: what is bright over less than ten resolutions is taken away."""
    line = round(10.0 * max(sigma, 1.0))
    return maximum_filter1d(minimum_filter1d(log, line, axis=-1), line, axis=-1)


def gaps_between(
    reduced: Reduced, top: NDArray[np.float64], bottom: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Samples that are missing in each column between two depths `[y, x]`, pixels.

    What is missing from the top of a column on is where the volume begins, and no gap.
    """
    missing = np.isnan(reduced.log)
    if not missing.any():
        return np.zeros(top.shape, np.int32)
    gaps = missing & np.logical_or.accumulate(~missing, axis=-1)
    above = np.cumsum(gaps, axis=-1, dtype=np.int32)
    blocks = [
        np.minimum(np.arange(n) // BLOCK, m - 1)
        for n, m in zip(top.shape, above.shape[:2], strict=True)
    ]
    y, x = np.ix_(*blocks)
    first, last = (np.clip(np.round(z), 0, above.shape[-1] - 1).astype(int) for z in (top, bottom))
    between: NDArray[np.int32] = above[y, x, last] - above[y, x, first]
    return between


def _rise(log: NDArray[np.float32], sigma: float, inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Evidence for a step from dark to bright that lasts."""
    above, below = (round(n * max(sigma, 1.0)) for n in (6.0, 16.0))
    no_data = np.isnan(log)
    filled = bridged(log)
    opened = without_lines(filled, sigma)
    step = mean_over(opened, 1, below) - mean_over(opened, -above, -1)
    # A lone reflection (a metal sample, say) still beats nothing at all.
    step = 0.8 * step + 0.2 * (mean_over(filled, 1, below) - mean_over(filled, -above, -1))
    step[mean_over(no_data.astype(np.float32), -above, -1) > 0.5] = 0.0
    scale = _typical_maximum(step, inside)
    # The layer above is clear: scattering there counts against a candidate, and so does a lack of
    # data, or the structures inside the sample would be as good as its surface.
    dark = np.nanpercentile(log, 20)
    clouded = np.clip(opened - dark - 0.5 * scale, 0.0, scale) / scale
    clouded[no_data] = 1.0
    return np.clip(step / scale, 0.0, 1.0) - 3.0 * mean_over(clouded, -3 * below, -1)


def line_evidence(
    log: NDArray[np.float32], sigma: float, inside: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Evidence for a bright line between darker flanks."""
    near, far, half = (max(round(n * sigma), k) for n, k in ((4.0, 3), (9.0, 5), (1.0, 1)))
    filled = bridged(log)
    centre = mean_over(filled, -half, half)
    flank = np.maximum(mean_over(filled, -far, -near), mean_over(filled, near, far))
    line = np.maximum(centre - flank, 0.0)
    return line / _typical_maximum(line, inside)


def _typical_maximum(evidence: NDArray[np.float32], inside: NDArray[np.bool_]) -> np.float32:
    """Median over the columns of the largest evidence in each."""
    strongest = np.max(np.where(inside, evidence, 0.0), axis=-1)
    return np.float32(max(np.median(strongest), 1e-6))


@njit(cache=True)
def _pass_along(cost, previous, slope, jump):
    """One step of dynamic programming: `previous` becomes the path costs of the next node."""
    nz = len(cost)
    best = previous[0]
    for z in range(1, nz):
        best = min(best, previous[z])
        previous[z] = min(previous[z], previous[z - 1] + slope)
    for z in range(nz - 2, -1, -1):
        previous[z] = min(previous[z], previous[z + 1] + slope)
    for z in range(nz):
        previous[z] = cost[z] + min(previous[z], best + jump) - best


@njit(cache=True)
def _aggregate(cost, total, slope, jump):
    """Add the path costs along the rows of `cost[row, node, z]`, in both senses, to `total`."""
    in_parallel(_aggregate_rows, len(cost), (cost, total, slope, jump))


@njit
def _aggregate_rows(cost, total, slope, jump, begin, end):
    _, nodes, nz = cost.shape
    path = np.empty(nz, np.float32)
    for row in range(begin, end):
        path[:] = 0
        for node in range(nodes):
            _pass_along(cost[row, node], path, slope, jump)
            for z in range(nz):
                total[row, node, z] += path[z]
        path[:] = 0
        for node in range(nodes - 1, -1, -1):
            _pass_along(cost[row, node], path, slope, jump)
            for z in range(nz):
                total[row, node, z] += path[z]


def track(
    reduced: Reduced,
    edge: Edge,
    *,
    sigma: float,
    spacing: tuple[float, float, float],
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    anchors: Sequence[tuple[float, float, float]] = (),
    excluded: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Depth (pixels, at full lateral resolution) of the surface of least cost.

    Parameters
    ----------
    reduced
        The volume.
    edge
        What the boundary looks like: dark to bright, bright to dark, or a line.
    sigma
        Standard deviation of the axial intensity point-spread function, pixels.
    spacing
        Pixel spacing (z, y, x), mm.
    first, last
        Depths `[y, x]`, pixels, between which the surface lies.
    anchors
        Points (y, x, z), pixels, through which it passes.
    excluded
        Pixels `[y, x]` that say nothing about it.
    """
    nodes = reduced.nodes
    z = np.arange(reduced.log.shape[-1])
    dz, dy, dx = spacing
    steps = [BLOCK * d / dz for d in (dy, dx)]  # pixels along z per block for a slope of 1
    inside = (z >= first[nodes][..., None]) & (z <= last[nodes][..., None])
    if edge == "fall":
        cost = -_rise(reduced.log[..., ::-1], sigma, inside[..., ::-1])[..., ::-1]
    else:
        cost = -(_rise if edge == "rise" else line_evidence)(reduced.log, sigma, inside)
    cost = np.ascontiguousarray(cost, np.float32)
    if excluded is not None:
        cost[excluded[nodes]] = 0.0
    cost[~inside] = 5.0
    for y, x, depth in anchors:
        _anchor(cost, z - depth, [(reduced.y - y) / BLOCK, (reduced.x - x) / BLOCK], steps, sigma)
    total = -3.0 * cost if len(reduced.y) > 1 else -cost
    _aggregate(cost, total, np.float32(SLOPE_COST / steps[1]), np.float32(JUMP_COST))
    if len(reduced.y) > 1:
        turned, turned_total = cost.transpose(1, 0, 2), total.transpose(1, 0, 2)
        _aggregate(turned, turned_total, np.float32(SLOPE_COST / steps[0]), np.float32(JUMP_COST))
    coarse = np.argmin(total, axis=-1).astype(float)
    return _to_full(coarse, reduced)


def _anchor(
    cost: NDArray[np.float32],
    off: NDArray[np.floating],
    distances: list[NDArray[np.float64]],
    steps: list[float],
    sigma: float,
) -> None:
    """Make depths `off` pixels from an anchor dear, the more so the nearer (blocks) it is.

    Around it lies a cone with a slope of 1 in which the surface is free to go where it is seen.
    """
    near = np.ix_(*(np.flatnonzero(np.abs(d) < 4.0 * ANCHOR_REACH) for d in distances))
    dy, dx = (d[i] for d, i in zip(distances, near, strict=True))
    free = 2.0 * sigma + np.maximum(np.hypot(dy * steps[0], dx * steps[1]) - min(steps), 0.0)
    pull = ANCHOR_COST * np.exp(-0.5 * (dy**2 + dx**2) / ANCHOR_REACH**2)
    excess = (np.abs(off) - free[..., None]) / (4.0 * sigma)
    cost[near] += (pull[..., None] * np.clip(excess, 0.0, 1.0)).astype(np.float32)


def _to_full(coarse: NDArray[np.float64], reduced: Reduced) -> NDArray[np.float64]:
    """Bilinear interpolation of a block map to every pixel, with its slope beyond the ends."""
    for axis, (centres, n) in enumerate(
        ((reduced.y, reduced.floor.shape[0]), (reduced.x, reduced.floor.shape[1]))
    ):
        if len(centres) == 1:
            coarse = np.repeat(coarse, n, axis=axis)
        else:
            from scipy.interpolate import make_interp_spline  # slow to load

            line = make_interp_spline(centres, coarse, k=1, axis=axis)
            coarse = line(np.arange(n))
    return coarse
