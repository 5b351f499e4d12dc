"""What the samples of a volume are, by the statistics of its noise and of its speckle.

Noise and fully developed speckle have an exponentially distributed intensity. Its contrast, the
standard deviation over the mean, is 1, that of the amplitude 0.52, and the standard deviation of
the logarithm 5.6 dB. The average of several intensities is gamma distributed and smoother, so that
contrast alone takes it for an amplitude. But cumulants of independent numbers add, and the *shape*
k3 k1 / k2^2 of the first three of them stays as it is however many are averaged: 2 for intensities,
1.2 for amplitudes, 1 for roots of averaged intensities. So does k3 / k2^2 of a logarithm, which is
-0.89 to -1 over its unit. Frames that are averaged at one place smooth the noise and leave the
speckle; its contrast then is that of a single frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

DB = np.log(10.0) / 10.0
# Of the logarithm of an exponential number: standard deviation, 90 % quantile less the median.
LOG_SPREAD = np.pi / np.sqrt(6.0)
LOG_RISE = np.log(np.log(10.0) / np.log(2.0))
DYNAMIC_RANGE = 60.0  # dB, of a spectrometer within one B-scan
ROUGHEST = 8.0  # dB, standard deviation beyond that of noise and speckle
SAMPLES = 7  # B-scans looked at for what holds for the whole volume
TILE = (32, 16)  # pixels along z and x over which statistics are taken
CONTRAST = 0.75  # between those of amplitude and intensity
BACKGROUND = 1.2  # beyond that of an intensity
SHAPE = 1.6  # likewise
AMPLITUDE_SHAPE = 1.21
LOG_SHAPE = -0.94  # to 6 %, times the unit
FEWEST = 4  # tiles that tell a shape
SURE = 2.0  # standard errors
MORE_AVERAGED = 0.7  # noise of less than so much of the contrast of speckle
OFF = 1.5  # factor by which the unit of a logarithm is off for certain
STRUCTURED = 2.0  # of more structure than this, a tile says nothing of speckle
HOMOGENEOUS = 1.3  # rougher than the smoother tiles by this, a tile holds structure


def tiles_of(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Tiles `[tile, z, x]` of a B-scan; the last ones end with it, and may overlap others."""
    size = [min(t, n) for t, n in zip(TILE, image.shape, strict=True)]
    starts = [
        np.unique([*range(0, n - t, t), n - t]) for t, n in zip(size, image.shape, strict=True)
    ]
    return sliding_window_view(image, size)[np.ix_(*starts)].reshape(-1, *size)


def some_of(ny: int) -> NDArray[np.int64]:
    """Numbers of some B-scans of `ny`."""
    return np.unique(np.linspace(0, ny - 1, SAMPLES).astype(np.int64))


def tile_statistics(samples: NDArray[np.float32], logarithmic: bool) -> NDArray[np.float64]:
    """Mean, second and third cumulant, spread, share of zeros and structure, `[6, tile]`.

    Cumulants are those of a linear signal over its mean; what is level or upright in a tile is
    structure and taken away. The spread of a logarithm is its standard deviation, from upper
    quantiles alone where samples are clipped to zero. Structure is the variance with it over that
    without it.
    """
    black = np.mean(samples == 0, (1, 2))
    tiles = samples.astype(float)
    mean = tiles.mean((1, 2))
    if not logarithmic:
        tiles = tiles / np.where(mean > 0, mean, np.inf)[:, None, None]
    rest = tiles - tiles.mean(1, keepdims=True) - tiles.mean(2, keepdims=True)
    rest += tiles.mean((1, 2), keepdims=True)
    cumulants = []
    for power in (2, 3):
        # Independent numbers less the means of their rows and columns keep this share of it.
        left = [(1 - 1 / n) ** power + (n - 1) * (-1 / n) ** power for n in tiles.shape[1:]]
        cumulants.append(np.mean(rest**power, (1, 2)) / max(np.prod(left), 1e-30))
    middle, upper = np.quantile(tiles, (0.5, 0.9), axis=(1, 2))
    spread = np.where(
        black > 0, (upper - middle) * LOG_SPREAD / LOG_RISE, np.sqrt(np.maximum(cumulants[0], 0.0))
    )
    structure = np.var(tiles, (1, 2)) / np.maximum(cumulants[0], 1e-30)
    return np.stack([mean, *cumulants, spread, black, structure])


@dataclass(frozen=True)
class Look:
    """Statistics of tiles of a volume, as from :func:`tile_statistics`."""

    tiles: NDArray[np.float64]
    logarithmic: bool

    @property
    def level(self) -> float:
        """Mean of the noise."""
        return float(np.median(self._pools()[0][0]))

    def amplitude(self) -> tuple[bool, str | None]:
        """Whether a linear signal is an amplitude, and why it may not be."""
        noise, speckle = map(_homogeneous, self._pools())
        smooth, rough = (float(np.sqrt(np.median(pool[1]))) for pool in (noise, speckle))
        shape, error = _shape(noise)
        sure = abs(shape - SHAPE) > SURE * error
        if shape + SURE * error < 0.0:
            return True, (
                "the samples were taken for linear ones, and are skewed as a logarithm is: if they "
                "are one, say scale 'dB', or the boundaries are off"
            )
        if rough > CONTRAST:
            textured = smooth < CONTRAST and sure and shape < SHAPE
            return textured, self._doubt(textured) if textured else None
        alike = smooth > MORE_AVERAGED * rough
        if sure and (alike or shape < SHAPE):
            return shape < SHAPE, None
        shape, error = _shape(speckle)
        return True, None if shape + SURE * error < AMPLITUDE_SHAPE else self._doubt(True)

    @staticmethod
    def _doubt(amplitude: bool) -> str:
        taken, other = ("amplitude", "intensity")[:: 1 if amplitude else -1]
        return (
            f"noise and speckle do not tell clearly whether the samples are amplitude or "
            f"intensity (averaged, or with an offset?). They were taken for {taken}; if they are "
            f"not, the sample side is off by up to a third of the axial resolution: say scale "
            f"'{taken}' or '{other}'"
        )

    def gain(self, highest: float) -> tuple[float, str | None]:
        """Unit of a logarithm (of the intensity, natural), and why it may be another."""
        noise, speckle = self._pools()
        noise = noise[:, noise[4] == 0.0]  # what is clipped has another shape
        spread = max(np.quantile(pool[3], 0.25) for pool in (noise, speckle) if pool.size)
        gain = DB
        if spread > ROUGHEST:
            gain = min(LOG_SPREAD / spread, DYNAMIC_RANGE * DB / (highest - self.level))
        shape, error = _shape(_homogeneous(noise)) if noise.size else (0.0, np.inf)
        unit = shape / LOG_SHAPE
        if SURE * error < (1.0 - 1.0 / OFF) * abs(shape) and not 1.0 / OFF < unit / gain < OFF:
            return gain, self._another(gain, unit)
        if gain * spread < LOG_SPREAD / OFF**2 and noise.size and np.median(noise[3]) < spread:
            return gain, self._another(gain, LOG_SPREAD / spread)
        return gain, None

    @staticmethod
    def _another(gain: float, unit: float) -> str:
        taken = f"the samples were taken for a logarithm in units of {gain / DB:.2g} dB, "
        off = "or the sample side is off by up to half of the axial resolution"
        if unit < 0.0:
            return f"{taken}and are skewed as linear ones are: if they are, say so by scale, {off}"
        return (
            f"{taken}and look like one in units of {unit / DB:.2g} dB: if they are, convert them "
            f"to decibels, {off}"
        )

    def _pools(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Tiles of noise, and those of speckle well above it (or noise again)."""
        even = self.tiles[5] < STRUCTURED
        if not self.logarithmic:
            # Rougher than speckle can be is noise less its background, whose mean says nothing.
            even &= (self.tiles[0] > 0.0) & (self.tiles[1] < BACKGROUND**2)
        tiles = self.tiles[:, even] if even.any() else self.tiles
        mean = tiles[0]
        noise = tiles[:, mean <= np.quantile(mean, 0.25)]
        level = float(np.median(noise[0]))
        above = 2.0 * float(np.median(np.sqrt(noise[1])))
        bright = mean > (level + above if self.logarithmic else 2.0 * level)
        if not bright.any():
            return noise, noise
        return noise, tiles[:, bright & (mean >= np.median(mean[bright]))]


def _homogeneous(pool: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tiles without a line or an edge."""
    return pool[:, pool[1] <= HOMOGENEOUS**2 * np.quantile(pool[1], 0.25)]


def _shape(pool: NDArray[np.float64]) -> tuple[float, float]:
    """Third cumulant over the square of the second, and its standard error (delta method)."""
    second, third = pool[1:3]
    if len(second) < FEWEST:
        return 0.0, np.inf
    square = max(float(np.mean(second)) ** 2, 1e-300)
    shape = float(np.mean(third)) / square
    scatter = third - 2.0 * shape * np.mean(second) * second
    return shape, float(np.std(scatter)) / square / np.sqrt(len(second) - 1)
