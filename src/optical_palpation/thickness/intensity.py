"""B-scans as intensity, whatever they were stored as, and the resolution that their speckle shows.

Both rest on the statistics of the noise and of fully developed speckle; see `speckle`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optical_palpation.arguments import choice
from optical_palpation.errors import InputError
from optical_palpation.runtime.kernels import keep_kernels

from .speckle import TILE, Look, some_of, tile_statistics, tiles_of

keep_kernels()

Scale = Literal["linear", "amplitude", "intensity", "dB"]
Read = Callable[[int], NDArray[np.float32]]

MOST_BLACK = 0.5  # of the samples of a tile: its median is one of the others
MOST_NEGATIVE = 0.2  # of the sum of linear samples: noise less its background is, signal is not
NARROWER = 1.2  # a reflection narrower by this is no matter of chance
SIGMA_RANGE = (0.4, 12.0)  # pixels; beyond it speckle does not tell its width


class BScans(Protocol):
    """Anything that gives B-scans `[z, x]` by their number; `shape` counts (z, y, x)."""

    @property
    def shape(self) -> tuple[int, int, int]: ...  # noqa: D102
    def bscan(self, y: int, /) -> NDArray: ...  # noqa: D102


@njit(cache=True, nogil=True)
def _convert(image, square, gain, offset):
    """Intensity of a B-scan in place: exp(gain v - offset), or v or v^2 if gain is 0.

    Padding (zeros or no numbers at either end of a column) and missing values become -1.
    """
    nz, nx = image.shape
    missing = np.zeros((nz, nx), np.bool_)
    for way in range(2):
        inside = np.zeros(nx, np.bool_)
        for i in range(nz):
            z = i if way == 0 else nz - 1 - i
            for x in range(nx):
                v = image[z, x]
                if v != 0.0 and np.isfinite(v):
                    inside[x] = True
                elif not inside[x] or v != 0.0:
                    missing[z, x] = True
    for z in range(nz):
        for x in range(nx):
            v = image[z, x]
            if missing[z, x]:
                image[z, x] = -1.0
            elif gain > 0:
                image[z, x] = np.exp(gain * v - offset)
            else:
                image[z, x] = v * v if square else max(v, np.float32(0.0))


@dataclass(frozen=True)
class Intensity:
    """B-scans of a volume as intensity, -1 where there is no data.

    `doubt` says in words why the samples may be something else than they were taken for.
    """

    volume: BScans
    unit: float
    square: bool
    gain: float
    offset: float
    doubt: str | None

    def __call__(self, y: int) -> NDArray[np.float32]:
        """B-scan `[z, x]` by its number."""
        image = _raw(self.volume, y) * np.float32(self.unit)
        _convert(image, self.square, np.float32(self.gain), np.float32(self.offset))
        return image


def _raw(volume: BScans, y: int) -> NDArray[np.float32]:
    image = np.asarray(volume.bscan(y))
    if image.ndim != 2 or image.shape != (volume.shape[0], volume.shape[2]):
        raise InputError(f"B-scan {y} has the shape {image.shape}, not that of the volume")
    image = np.abs(image) if np.iscomplexobj(image) else image
    return np.array(image, np.float32, order="C")


def intensity_reader(volume: BScans, scale: Scale) -> Intensity:
    """Return a function that gives B-scans as intensity.

    Whether a linear signal is an amplitude or an intensity shows in its noise and speckle, unless
    the scale says so. Decibels that are rougher than noise or speckle can be are a logarithm in
    another unit, and are scaled to it; but where averaging has smoothed both, the range of a
    spectrometer is the limit.
    """
    choice(scale, "scale", "linear", "amplitude", "intensity", "dB")
    logarithmic = scale == "dB"
    looks, highest, negative = [], [], []
    for y in some_of(volume.shape[1]):
        image = _raw(volume, int(y))
        size = np.abs(image, dtype=float)
        negative.append(np.nansum(size[image < 0]) / max(np.nansum(size), 1e-300))
        tiles = tiles_of(image)
        # A zero is no data, or what a logarithmic image shows where the signal is below its range.
        tiles = tiles[
            np.all(np.isfinite(tiles), (1, 2)) & (np.mean(tiles == 0, (1, 2)) < MOST_BLACK)
        ]
        if len(tiles) == 0:
            continue
        highest.append(np.max(tiles))
        looks.append(tile_statistics(tiles, logarithmic))
    if not looks:
        raise InputError(
            "the volume holds no stretch of finite data to tell noise from signal by: of every "
            f"{TILE[0]} x {TILE[1]} samples some are missing, or most are 0. If it is an image "
            "whose black hides the noise, store it over a wider range, in decibels or linear"
        )
    if not logarithmic and (share := float(np.mean(negative))) > MOST_NEGATIVE:
        raise InputError(
            f"samples that are negative, as no amplitude or intensity is, make up {share:.0%} of "
            "the signal: is it in decibels (scale 'dB'), or the raw one of the interferometer?"
        )
    look = Look(np.concatenate(looks, axis=1), logarithmic)
    if logarithmic:
        gain, doubt = look.gain(float(max(highest)))
        return Intensity(volume, 1.0, False, gain, gain * look.level, doubt)
    unit = 1.0 / (float(max(highest)) or 1.0)  # squares of squares, too, are finite numbers
    square, doubt = look.amplitude() if scale == "linear" else (scale == "amplitude", None)
    return Intensity(volume, unit, square, 0.0, 0.0, doubt)


def point_spread(read: Read, ny: int) -> tuple[float, float, bool]:
    """Measure the standard deviations (z, x), pixels, of the intensity point-spread function.

    Also tells whether its speckle shows them.

    The speckle of many independent scatterers has the intensity correlation exp(-d^2 / 4 s^2)
    for a Gaussian point-spread function of standard deviation s, and so has the image of a single
    reflector. Lag 0 holds the noise too and is left out. Where speckle is averaged away, or the
    sample has none, what correlates is its structure: a reflection that is narrower shows the
    point-spread function itself.
    """
    peaks = []
    products: tuple[list[NDArray], list[NDArray]] = ([], [])
    for y in some_of(ny):
        image = np.maximum(read(int(y)), 0.0)
        peaks.append(_peaks(image))
        tiles = tiles_of(image)
        mean = tiles.mean((1, 2), keepdims=True)
        columns = tiles.mean(axis=1)  # an A-scan of a saturated detector stands out of its tile
        even = columns.max(axis=1) < 4.0 * np.median(columns, axis=1)
        even &= tiles.std((1, 2)) < 1.5 * mean.ravel()  # and so does a reflection
        if not np.any(even):
            continue
        bright = even & (mean.ravel() >= np.quantile(mean[even], 0.8))
        speckle = np.minimum(tiles[bright] / np.maximum(mean[bright], 1e-30), 6.0)
        speckle = speckle - speckle.mean(axis=2, keepdims=True)  # what is level is structure
        for axis in (1, 2):
            n = speckle.shape[axis]
            lagged = [
                np.mean(
                    np.take(speckle, range(n - lag), axis) * np.take(speckle, range(lag, n), axis),
                    axis=(1, 2),
                )
                for lag in range(n // 2)
            ]
            products[axis - 1].append(np.stack(lagged))
    line = _line_width(np.concatenate(peaks, axis=1))
    if not products[0]:
        return line or SIGMA_RANGE[0], SIGMA_RANGE[0], False
    along_z, along_x = (np.mean(np.concatenate(p, axis=1), axis=1) for p in products)
    sigma_z = _width(along_z)
    sigma_x = _width_across(along_x, sigma_z, float(along_z[1]))
    if sigma_z == SIGMA_RANGE[0] or (line and sigma_z > NARROWER * line):
        # What widens one of the two widens the other.
        taken = line or sigma_z
        return taken, max(sigma_x * min(taken / sigma_z, 1.0), SIGMA_RANGE[0]), False
    return sigma_z, sigma_x, True


def _width_across(along_x: NDArray[np.float64], sigma_z: float, first: float) -> float:
    """Lateral width, where `first` is the axial product at lag 1.

    The axial fit gives the variance of the speckle without that of the noise, so that one lateral
    lag is enough: pixels are often as far apart as the resolution.
    """
    variance = first * np.exp(1.0 / (4.0 * sigma_z**2))
    if along_x[1] > 0.5 * variance:
        return _width(along_x)
    measured, sigma_x = float(np.clip(along_x[1] / max(variance, 1e-30), 0.01, 0.5)), SIGMA_RANGE[0]
    for _ in range(4):
        # The mean over the tile's columns, taken away above, held this share of the speckle.
        taken = min(np.sqrt(4.0 * np.pi) * sigma_x / TILE[1], 0.5)
        drop = -np.log(measured * (1.0 - taken) + taken)
        sigma_x = float(np.clip(np.sqrt(1.0 / (4.0 * drop)), *SIGMA_RANGE))
    return sigma_x


def _peaks(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The brightest sample of each A-scan between its neighbours, `[3, x]`."""
    top = np.clip(np.argmax(image, axis=0), 1, len(image) - 2)
    return np.take_along_axis(image, top + np.array([[-1], [0], [1]]), axis=0)


def _line_width(peaks: NDArray[np.float32]) -> float | None:
    """Standard deviation of a reflection from its three brightest samples, where they show it."""
    before, peak, after = peaks
    clipped = (peak == peak.max()) & (np.sum(peak == peak.max()) > 1)
    good = (before > 0) & (after > 0) & (peak > before) & (peak > after) & ~clipped
    if np.mean(good) < 0.5:
        return None
    before, peak, after = np.log(peaks[:, good])
    width = 1.0 / np.sqrt(np.median(2.0 * peak - before - after))
    return float(np.clip(width, *SIGMA_RANGE))


def _width(products: NDArray[np.float64]) -> float:
    """Width of the point-spread function from sums of lagged products."""
    first, lags = products[1], products[2:]
    if first <= 0.05 * products[0]:
        return SIGMA_RANGE[0]
    far = 2 + int(np.argmax(lags < 0.5 * first)) if np.any(lags < 0.5 * first) else len(lags) + 1
    drop = np.log(first / max(products[far], 0.02 * first))
    return float(np.clip(np.sqrt((far**2 - 1) / (4.0 * max(drop, 1e-9))), *SIGMA_RANGE))
