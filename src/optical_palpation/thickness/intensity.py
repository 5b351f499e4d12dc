"""B-scans as intensity, whatever they were stored as, and the resolution that their speckle shows.

Both rest on the statistics of the noise and of fully developed speckle: an intensity is
exponentially distributed, so its standard deviation is its mean, that of an amplitude 0.52 of it,
and that of a logarithm a fixed number, 5.6 dB.
"""

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np
from numba import njit
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from optical_palpation.arguments import choice
from optical_palpation.errors import InputError
from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

Scale = Literal["linear", "dB"]
Read = Callable[[int], NDArray[np.float32]]

DB = np.log(10.0) / 10.0
LOG_SPREAD = np.pi / np.sqrt(6.0)  # standard deviation of the logarithm of an exponential number
DYNAMIC_RANGE = 60.0  # dB, of a spectrometer within one B-scan
SAMPLES = 7  # B-scans looked at for what holds for the whole volume
MOST_NEGATIVE = 0.2  # of the sum of linear samples: noise less its background is, signal is not
TILE = (32, 16)  # pixels along z and x over which statistics are taken
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


def _tiles(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Tiles `[tile, z, x]` of a B-scan; the last ones end with it, and may overlap others."""
    size = [min(t, n) for t, n in zip(TILE, image.shape, strict=True)]
    starts = [
        np.unique([*range(0, n - t, t), n - t]) for t, n in zip(size, image.shape, strict=True)
    ]
    return sliding_window_view(image, size)[np.ix_(*starts)].reshape(-1, *size)


def _some(ny: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, ny - 1, SAMPLES).astype(np.int64))


def intensity_reader(volume: BScans, scale: Scale) -> Read:
    """Return a function that gives B-scans as intensity, -1 where there is no data.

    A linear signal is an amplitude or an intensity, which its noise tells. Decibels whose noise
    is much rougher than noise can be are a logarithm in another unit, and are scaled to it; but
    where averaging has smoothed the noise, the range of a spectrometer is the limit.
    """
    choice(scale, "scale", "linear", "dB")

    def raw(y: int) -> NDArray[np.float32]:
        image = np.asarray(volume.bscan(y))
        if image.ndim != 2 or image.shape != (volume.shape[0], volume.shape[2]):
            raise InputError(f"B-scan {y} has the shape {image.shape}, not that of the volume")
        image = np.abs(image) if np.iscomplexobj(image) else image
        return np.array(image, np.float32, order="C")

    spread, level, highest, negative, roughness = [], [], [], [], []
    for y in _some(volume.shape[1]):
        image = raw(int(y))
        size = np.abs(image, dtype=float)
        negative.append(np.nansum(size[image < 0]) / max(np.nansum(size), 1e-300))
        tiles = _tiles(image)
        tiles = tiles[np.all(np.isfinite(tiles) & (tiles != 0 if scale == "dB" else True), (1, 2))]
        if len(tiles) == 0:
            continue
        mean, deviation = tiles.mean((1, 2), float), tiles.std((1, 2), float)
        quiet = mean <= np.quantile(mean, 0.25)
        spread.append(np.median(deviation[quiet]))
        level.append(np.median(mean[quiet]))
        highest.append(np.max(tiles))
        # Structures, steps of the digitizer and padding make a tile rougher than speckle is.
        relative = np.divide(deviation, mean, out=np.full_like(mean, np.inf), where=mean > 0)
        roughness.append(np.quantile(relative, 0.25, method="lower"))
    if not spread:
        raise InputError("the volume holds no stretch of finite data to tell noise from signal by")
    if scale == "linear" and (share := float(np.mean(negative))) > MOST_NEGATIVE:
        raise InputError(
            f"samples that are negative, as no amplitude or intensity is, make up {share:.0%} of "
            "the signal: is it in decibels (scale 'dB'), or the raw one of the interferometer?"
        )
    deviation, mean = float(np.median(spread)), float(np.median(level))
    square, unit, gain, offset = False, 1.0, 0.0, 0.0
    if scale == "linear":
        square = float(np.median(roughness)) < 0.75
        unit = 1.0 / (float(max(highest)) or 1.0)  # squares of squares, too, are finite numbers
    else:
        if deviation > 8.0:
            gain = min(LOG_SPREAD / deviation, DYNAMIC_RANGE * DB / (max(highest) - mean))
        else:
            gain = DB
        offset = gain * mean

    def read(y: int) -> NDArray[np.float32]:
        image = raw(y) * np.float32(unit)
        _convert(image, square, np.float32(gain), np.float32(offset))
        return image

    return read


def point_spread(read: Read, ny: int) -> tuple[float, float]:
    """Measure the standard deviations (z, x), pixels, of the intensity point-spread function.

    The speckle of many independent scatterers has the intensity correlation exp(-d^2 / 4 s^2)
    for a Gaussian point-spread function of standard deviation s, and so has the image of a single
    reflector. Lag 0 holds the noise too and is left out.
    """
    products: tuple[list[NDArray], list[NDArray]] = ([], [])
    for y in _some(ny):
        tiles = _tiles(np.maximum(read(int(y)), 0.0))
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
    if not products[0]:
        return SIGMA_RANGE[0], SIGMA_RANGE[0]
    along_z, along_x = (np.mean(np.concatenate(p, axis=1), axis=1) for p in products)
    sigma_z = _width(along_z)
    # The axial fit gives the variance of the speckle without that of the noise, so that one lateral
    # lag is enough: pixels are often as far apart as the resolution.
    variance = along_z[1] * np.exp(1.0 / (4.0 * sigma_z**2))
    if along_x[1] > 0.5 * variance:
        return sigma_z, _width(along_x)
    measured, sigma_x = float(np.clip(along_x[1] / max(variance, 1e-30), 0.01, 0.5)), SIGMA_RANGE[0]
    for _ in range(4):
        # The mean over the tile's columns, taken away above, held this share of the speckle.
        taken = min(np.sqrt(4.0 * np.pi) * sigma_x / TILE[1], 0.5)
        drop = -np.log(measured * (1.0 - taken) + taken)
        sigma_x = float(np.clip(np.sqrt(1.0 / (4.0 * drop)), *SIGMA_RANGE))
    return sigma_z, sigma_x


def _width(products: NDArray[np.float64]) -> float:
    """Width of the point-spread function from sums of lagged products."""
    first, lags = products[1], products[2:]
    if first <= 0.05 * products[0]:
        return SIGMA_RANGE[0]
    far = 2 + int(np.argmax(lags < 0.5 * first)) if np.any(lags < 0.5 * first) else len(lags) + 1
    drop = np.log(first / max(products[far], 0.02 * first))
    return float(np.clip(np.sqrt((far**2 - 1) / (4.0 * max(drop, 1e-9))), *SIGMA_RANGE))
