"""Synthetic spectral-domain OCT of a transparent layer on a scattering sample.

The field is built in the spectral domain, as the instrument builds it: reflectors and scatterers
are summed into a depth-resolved reflectivity, its spectrum is multiplied by that of the source and
transformed back. Scatterers are circular complex Gaussian and independent from voxel to voxel, so
that the speckle is fully developed (exponential intensity) and is correlated over the
point-spread function, and over nothing else. The noise of each pixel is independent, circular
complex Gaussian with a mean intensity of 1, which makes intensities signal-to-noise ratios.

Signal-to-noise ratio: mean speckle intensity of the sample at its surface, before attenuation and
away from shadows, over the mean noise intensity, in decibels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import convolve1d

from optical_palpation.errors import InputError

FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))  # full width at half maximum of a unit Gaussian


@dataclass(frozen=True)
class Optics:
    """The imaging system; the defaults are those of a 1300 nm elastography system.

    Attributes
    ----------
    axial_resolution, lateral_resolution
        Full width at half maximum of the intensity point-spread function, mm (axially in the
        layer, not in air).
    wavelength
        Central wavelength in vacuum, mm.
    refractive_index
        Of the layer.
    spectral_window
        The Gaussian source spectrum is cut off this many standard deviations from its centre;
        the cut is what gives a strong reflection its side lobes.
    """

    axial_resolution: float = 5.5e-3
    lateral_resolution: float = 13e-3
    wavelength: float = 1.3e-3
    refractive_index: float = 1.4
    spectral_window: float = 2.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"Optics: {name} is {value}; it must be a positive number")

    def spectrum(self, n: int, spacing: float) -> NDArray[np.float32]:
        """Source spectrum over `n` axial frequencies, of unit-energy point-spread function."""
        amplitude_sigma = np.sqrt(2.0) * self.axial_resolution / FWHM / spacing  # pixels
        u = 2.0 * np.pi * scipy.fft.fftfreq(n) * amplitude_sigma
        spectrum = np.where(np.abs(u) <= self.spectral_window, np.exp(-(u**2) / 2.0), 0.0)
        return (spectrum / np.sqrt(np.mean(spectrum**2))).astype(np.float32)

    def lateral_kernel(self, spacing: float) -> NDArray[np.float32]:
        """Lateral amplitude point-spread function of unit energy, sampled at `spacing` mm."""
        sigma = np.sqrt(2.0) * self.lateral_resolution / FWHM / spacing
        reach = int(np.ceil(3.0 * sigma))
        kernel = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2.0 * sigma**2))
        return (kernel / np.sqrt(np.sum(kernel**2))).astype(np.float32)


def _speckle(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.complex64]:
    """Circular complex Gaussian numbers of unit mean intensity."""
    parts = rng.standard_normal((*shape, 2), dtype=np.float32) * np.float32(np.sqrt(0.5))
    return parts.view(np.complex64)[..., 0]


@dataclass(frozen=True, eq=False)
class SyntheticOCT:
    """OCT volume of a layer between a window and a sample, made B-scan by B-scan.

    Iterating over it, or :meth:`bscan`, yields amplitude images `[z, x]`; every B-scan depends on
    the seed and its own index alone.

    Attributes
    ----------
    thickness
        Layer thickness `[y, x]`, mm.
    spacing
        Pixel spacing (z, y, x), mm; pixel 0 has its centre at 0.
    n_depth
        Number of pixels along z.
    window_depth
        Depth of the face of the window that touches the layer, mm, at the centre of the map.
    tilt
        Slope of the window along (y, x), mm per mm.
    gap
        Distance from the layer to the sample where they do not touch, mm, a number or `[y, x]`.
    snr_db
        Signal-to-noise ratio as the module defines it.
    attenuation
        Attenuation coefficient of the sample, 1/mm; intensity falls as exp(-2 attenuation depth).
    layer_db
        Scattering of the layer relative to that of the sample.
    window_db, interface_db
        Intensity of the reflections of the window and of the face of the layer that touches the
        sample, relative to the sample's speckle; None for no reflection.
    ghosts
        Spurious reflections parallel to the window: (depth below it in mm, relative intensity
        in dB).
    transmission
        Share of the light that is left below the window, `[y, x]` in [0, 1]: shadows.
    saturated
        Share of A-scans in which a saturated detector lifts the noise by 10 to 25 dB.
    saturation_db
        The amplitude is clipped at this intensity above the sample's speckle.
    """

    thickness: NDArray[np.float64]
    spacing: tuple[float, float, float]
    n_depth: int
    window_depth: float = 0.15
    tilt: tuple[float, float] = (0.0, 0.0)
    gap: float | NDArray[np.float64] = 0.0
    snr_db: float = 20.0
    attenuation: float = 4.0
    layer_db: float = -40.0
    window_db: float | None = 25.0
    interface_db: float | None = None
    ghosts: tuple[tuple[float, float], ...] = ()
    transmission: NDArray[np.float64] | None = None
    saturated: float = 0.0
    saturation_db: float = 22.0
    optics: Optics = Optics()
    seed: int = 0

    def __post_init__(self) -> None:
        if np.ndim(self.thickness) != 2 or not np.all(np.isfinite(self.thickness)):
            raise InputError("SyntheticOCT: thickness must be a finite map [y, x] in mm")
        if len(self.spacing) != 3 or not min(self.spacing) > 0:
            raise InputError(f"SyntheticOCT: spacing {self.spacing} must be three positive mm")
        deepest = float(np.max(self.window_map + self.thickness + self.gap)) / self.spacing[0]
        if np.min(self.thickness) <= 0 or np.min(self.window_map) < 0 or deepest > self.n_depth:
            raise InputError(
                "SyntheticOCT: the layer must have a positive thickness and lie inside the "
                f"volume of {self.n_depth} pixels; its deepest point is at pixel {deepest:.0f}"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of pixels along (z, y, x)."""
        return (self.n_depth, *self.thickness.shape)

    @property
    def window_map(self) -> NDArray[np.float64]:
        """Depth of the window `[y, x]`, mm."""
        ny, nx = self.thickness.shape
        _, dy, dx = self.spacing
        y, x = dy * (np.arange(ny) - (ny - 1) / 2), dx * (np.arange(nx) - (nx - 1) / 2)
        return self.window_depth + self.tilt[0] * y[:, None] + self.tilt[1] * x[None, :]

    def _scatterers(self, y: int) -> NDArray[np.complex64]:
        """Scattered field `[z, x]` of one row of voxels, before the point-spread function.

        The row may lie outside the map, whose border is then repeated, as is its left and right
        margin: the point-spread function reaches over the edges.
        """
        ny, nx = self.thickness.shape
        margin = len(self.optics.lateral_kernel(self.spacing[2])) // 2
        row, columns = np.clip(y, 0, ny - 1), np.clip(np.arange(-margin, nx + margin), 0, nx - 1)
        window = self.window_map[row, columns]
        gap = np.broadcast_to(self.gap, self.thickness.shape)[row, columns]
        surface = window + self.thickness[row, columns] + gap
        dz = self.spacing[0]
        z = dz * np.arange(self.n_depth)[:, None]

        def share_below(depth: NDArray[np.float64]) -> NDArray[np.float64]:
            """Share of each voxel that lies below `depth`."""
            return np.clip((z - depth) / dz + 0.5, 0.0, 1.0)

        decay = np.exp(-2.0 * self.attenuation * np.clip(z - surface, 0.0, None))
        in_layer = share_below(window) - share_below(surface - gap)
        intensity = share_below(surface) * decay + 10 ** (self.layer_db / 10) * in_layer
        intensity *= 10 ** (self.snr_db / 10)
        if self.transmission is not None:
            intensity *= self.transmission[row, columns]
        rng = np.random.default_rng([self.seed, 0, y + 2**20])
        return np.sqrt(intensity).astype(np.float32) * _speckle(rng, intensity.shape)

    def _reflections(self, y: int) -> NDArray[np.complex64]:
        """Spectrum `[kz, x]` of the specular reflections, whose depth needs no voxel grid."""
        window = self.window_map[y]
        below = np.ones_like(window) if self.transmission is None else self.transmission[y]
        lines = []
        if self.window_db is not None:
            lines.append((window, self.window_db, np.ones_like(window)))
        if self.interface_db is not None:
            lines.append((window + self.thickness[y], self.interface_db, below))
        lines += [(window + depth, level, below) for depth, level in self.ghosts]
        k = 2.0 * np.pi * scipy.fft.fftfreq(self.n_depth)[:, None]
        spectrum = np.zeros((self.n_depth, len(window)), np.complex64)
        # A unit reflector has the peak intensity that `Optics.spectrum` gives to a point.
        peak = np.mean(self.optics.spectrum(self.n_depth, self.spacing[0]))
        for depth, level, share in lines:
            amplitude = 10 ** ((self.snr_db + level) / 20) / peak * np.sqrt(share)
            # The optical path, and with it the carrier phase, turns many times over a tilt.
            carrier = 4.0 * np.pi * self.optics.refractive_index * depth / self.optics.wavelength
            spectrum += amplitude * np.exp(-1j * (k * depth / self.spacing[0] + carrier))
        return spectrum

    def field(self, y: int) -> NDArray[np.complex64]:
        """Complex B-scan `[z, x]` with its noise; the noise has a mean intensity of 1."""
        ny, nx = self.thickness.shape
        if not 0 <= y < ny:
            raise InputError(f"SyntheticOCT: there is no B-scan {y}; there are {ny}")
        along_y = self.optics.lateral_kernel(self.spacing[1])
        along_x = self.optics.lateral_kernel(self.spacing[2])
        reach, margin = len(along_y) // 2, len(along_x) // 2
        rows = _recent_scatterers(self)
        scattered = sum(
            w * rows(y + k) for w, k in zip(along_y, range(-reach, reach + 1), strict=True)
        )
        scattered = convolve1d(scattered, along_x, axis=1)[:, margin : margin + nx]
        spectrum = scipy.fft.fft(scattered, axis=0) + self._reflections(y)
        spectrum *= self.optics.spectrum(self.n_depth, self.spacing[0])[:, None]
        rng = np.random.default_rng([self.seed, 1, y])
        noise = _speckle(rng, (self.n_depth, nx))
        lifted = rng.random(nx) < self.saturated
        noise *= np.where(lifted, 10 ** (rng.uniform(10, 25, nx) / 20), 1.0).astype(np.float32)
        return np.asarray(scipy.fft.ifft(spectrum, axis=0) + noise, np.complex64)

    def bscan(self, y: int) -> NDArray[np.float32]:
        """Amplitude image `[z, x]` of row `y`."""
        ceiling = np.float32(10 ** ((self.snr_db + self.saturation_db) / 20))
        return np.minimum(np.abs(self.field(y)), ceiling)

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        return (self.bscan(y) for y in range(self.shape[1]))


@lru_cache(maxsize=2)
def _recent_scatterers(volume: SyntheticOCT):
    """Rows of scatterers of `volume`; neighbouring B-scans share all but one of them."""
    return lru_cache(maxsize=2 * len(volume.optics.lateral_kernel(volume.spacing[1])))(
        volume._scatterers
    )


def complex_pair(
    displacement: ArrayLike,
    *,
    spacing: tuple[float, float, float],
    snr_db: float = 30.0,
    reflectivity: ArrayLike = 1.0,
    optics: Optics | None = None,
    seed: int = 0,
) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Complex OCT volumes before and after a small axial displacement of the scatterers.

    Scatterers move with the material: each takes its carrier phase and its envelope along, so that
    a strain within the point-spread function decorrelates the speckle as it does in a measurement.
    The phase obeys angle(before conj(after)) = 4 pi n u_z / wavelength.

    Parameters
    ----------
    displacement
        Axial displacement u_z `[z, y, x]` of the material at each voxel, mm, positive deeper.
    spacing
        Pixel spacing (z, y, x), mm.
    snr_db
        Mean speckle intensity where `reflectivity` is 1 over the mean noise intensity.
    reflectivity
        Relative scattered intensity, broadcast to the shape of `displacement`.
    optics, seed
        As for :class:`SyntheticOCT`; noise is independent in the two volumes.

    Returns
    -------
    before, after : complex64 arrays `[z, y, x]`
    """
    u = np.asarray(displacement, float)
    optics = Optics() if optics is None else optics
    if u.ndim != 3 or not np.all(np.isfinite(u)):
        raise InputError("complex_pair: displacement must be a finite array [z, y, x] in mm")
    if len(spacing) != 3 or not min(spacing) > 0:
        raise InputError(f"complex_pair: spacing {spacing} must be three positive mm")
    rng = np.random.default_rng([seed, 2])
    kernels = [optics.lateral_kernel(s) for s in spacing[1:]]
    margins = [len(kernel) // 2 for kernel in kernels]
    pad = [(0, 0), *((m, m) for m in margins)]
    intensity = 10 ** (snr_db / 10) * np.broadcast_to(np.asarray(reflectivity, float), u.shape)
    amplitude = np.sqrt(np.pad(intensity, pad, mode="edge")).astype(np.float32)
    scatterers = amplitude * _speckle(rng, amplitude.shape)
    spectrum = optics.spectrum(u.shape[0], spacing[0])[:, None, None]

    def image(source: NDArray[np.complex64]) -> NDArray[np.complex64]:
        for axis in (1, 2):
            source = convolve1d(source, kernels[axis - 1], axis=axis)
        inner = tuple(slice(m, n - m) for m, n in zip((0, *margins), source.shape, strict=True))
        field = scipy.fft.ifft(scipy.fft.fft(source[inner], axis=0) * spectrum, axis=0)
        return np.asarray(field + _speckle(rng, u.shape), np.complex64)

    return image(scatterers), image(
        _moved(scatterers, np.pad(u, pad, mode="edge"), spacing, optics)
    )


def _moved(
    scatterers: NDArray[np.complex64],
    u: NDArray[np.float64],
    spacing: tuple[float, float, float],
    optics: Optics,
) -> NDArray[np.complex64]:
    """Scatterers after the displacement `u` (mm), shared out between the two nearest voxels."""
    phase = 4.0 * np.pi * optics.refractive_index * u / optics.wavelength
    turned = scatterers * np.exp(-1j * phase).astype(np.complex64)
    nz = len(u)
    position = np.arange(nz)[:, None, None] + u / spacing[0]
    lower = np.floor(position).astype(np.intp)
    share = (position - lower).astype(np.float32)
    y, x = np.arange(u.shape[1])[:, None], np.arange(u.shape[2])
    moved = np.zeros_like(turned)
    for voxel, part in ((lower, 1.0 - share), (lower + 1, share)):
        np.add.at(moved, (voxel % nz, *np.broadcast_arrays(y, x)), turned * part)
    return moved
