"""Axial displacement and strain from phase-sensitive OCT."""

from __future__ import annotations

import numpy as np
import scipy.fft
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from optical_palpation.errors import InputError

Complex = NDArray[np.complexfloating]


def displacement_profile(
    before: ArrayLike,
    after: ArrayLike,
    *,
    spacing: float,
    wavelength: float,
    refractive_index: float,
    window_depth: float,
    sample_depth: float,
    margin: float = 0.01,
    common_path: bool = True,
) -> xr.Dataset:
    """Mean axial displacement of the layer against depth, between two complex volumes.

    Phase differences ``angle(before conj(after)) = 4 pi n u / wavelength`` are averaged laterally
    as vectors, so that each A-scan counts by its amplitude and noise that dominates an A-scan
    drops out, and are unwrapped along depth after the mean strain has been taken off (section 4
    of the paper; u is positive away from the window). Crop the volumes to the centre of the
    layer, where lateral flow does not tilt the profile.

    Parameters
    ----------
    before, after
        Complex OCT, ``(z, ...)``, before and after the small step; the depth of pixel 0 is 0.
    spacing
        Axial pixel spacing in the layer, mm.
    wavelength
        Central wavelength in vacuum, mm.
    refractive_index
        Of the layer.
    window_depth, sample_depth
        Depth of the layer's two faces, mm.
    margin
        Depth next to both faces that is left out, mm: a few axial resolutions, because the bright
        reflection of a face reaches into the layer.
    common_path
        Whether the window is the reference reflector, so that its phase is zero. If not, phases
        of each A-scan are taken relative to the window's reflection.

    Returns
    -------
    xarray.Dataset
        Over ``depth`` (fraction of the loaded layer, 0 at the window): ``displacement`` and
        ``standard_error`` in mm, ``coherence`` from 0 (noise) to 1. The standard error follows
        from coherence and the number of independent speckles; the scale of an estimate of
        friction does not depend on it.

    Raises
    ------
    InputError
        Volumes are not complex, not alike or the same, depths are outside, or the phase is noise.
    """
    b, a = _pair(before, after)
    _positive(spacing=spacing, refractive_index=refractive_index)
    _check_wavelength(wavelength)
    z = spacing * np.arange(b.shape[0])
    if not 0.0 <= window_depth < sample_depth <= z[-1] + spacing:
        raise InputError(
            f"faces of the layer at {window_depth:g} and {sample_depth:g} mm: must be in this "
            f"order and inside the volume (0 to {z[-1]:g} mm)"
        )
    inside = (z >= window_depth + margin) & (z <= sample_depth - margin)
    if inside.sum() < 8:
        raise InputError(
            f"{inside.sum()} pixels lie between the faces of the layer ({window_depth:g} to "
            f"{sample_depth:g} mm less a margin of {margin:g} mm); at least 8 are needed"
        )
    product = (b * np.conj(a)).reshape(b.shape[0], -1)
    if not common_path:
        at = round(window_depth / spacing)
        reference = product[max(at - 1, 0) : at + 2].sum(axis=0)
        product = product * np.exp(-1j * np.angle(reference))
    product = product[inside]

    total = product.sum(axis=1)
    power = np.sqrt(_power(b[inside]) * _power(a[inside]))
    coherence = np.abs(total) / np.maximum(power, np.finfo(float).tiny)
    looks = _independent(b[inside])
    # The mean of unrelated phases has a coherence of about 1 / sqrt(looks).
    if np.median(coherence) < 2.0 / np.sqrt(looks):
        raise InputError(
            f"the phases of the two volumes are hardly related (median coherence "
            f"{np.median(coherence):.3f}; noise alone gives {1.0 / np.sqrt(looks):.3f}): the step "
            "was too large, the signal is noise, phases jump between A-scans, or the displacement "
            "varies over the region"
        )
    pixel = np.arange(total.size)
    ramp = _phase_rate(_autocorrelation(total[:, None])) * pixel
    phase = ramp + np.unwrap(np.angle(total * np.exp(-1j * ramp)))
    # Multiples of 2 pi are fixed by the window, which stays: the profile, continued to it on a
    # straight line, must pass near zero there.
    near = pixel < max(4, pixel.size // 5)
    slope, start = np.polyfit(z[inside][near], phase[near], 1)
    phase -= 2.0 * np.pi * np.round((slope * window_depth + start) / (2.0 * np.pi))

    floor = np.clip(coherence, 1e-3, 1.0 - 1e-9)
    error = np.sqrt((1.0 - floor**2) / (2.0 * looks * floor**2))
    to_mm = wavelength / (4.0 * np.pi * refractive_index)
    depth = (z[inside] - window_depth) / (sample_depth - window_depth)
    return xr.Dataset(
        {
            "displacement": ("depth", phase * to_mm, {"units": "mm"}),
            "standard_error": ("depth", error * to_mm, {"units": "mm"}),
            "coherence": ("depth", coherence, {"units": "1"}),
        },
        coords={"depth": ("depth", depth, {"units": "1", "long_name": "depth in the layer"})},
        attrs={
            "loaded_thickness_mm": sample_depth - window_depth,
            "wavelength_mm": wavelength,
            "refractive_index": refractive_index,
            "independent_speckles": looks,
        },
    )


def axial_strain(
    before: ArrayLike,
    after: ArrayLike,
    *,
    spacing: float,
    wavelength: float,
    refractive_index: float,
) -> tuple[float, float]:
    """Axial strain of a block of material that is strained evenly along depth.

    The strain is the rate of phase along depth that the block as a whole supports best: the
    maximum of the periodogram of ``before conj(after)``, summed over A-scans without their phases.
    It is the maximum-likelihood estimate for a steady phase rate in noise. Differences between
    neighbouring pixels would be biased: they share the point-spread function, hence scatterers and
    phase, so that their difference is too small (by a third to a half at two pixels per
    resolution, whatever the average), while the ends of a block share nothing.

    Parameters
    ----------
    before, after
        Complex OCT of the block, ``(z, ...)``.
    spacing, wavelength, refractive_index
        As for :func:`displacement_profile`.

    Returns
    -------
    strain, standard_error : float
        ``du/dz``, negative in compression; the error by leaving out groups of A-scans, NaN for
        fewer than four.

    Raises
    ------
    InputError
        Volumes are not complex or not alike, or hold fewer than 4 pixels along z.
    """
    b, a = _pair(before, after)
    _positive(spacing=spacing, refractive_index=refractive_index)
    _check_wavelength(wavelength)
    if b.shape[0] < 4:
        raise InputError(f"strain needs at least 4 pixels along z, got {b.shape[0]}")
    product = (b * np.conj(a)).reshape(b.shape[0], -1)
    to_strain = wavelength / (4.0 * np.pi * refractive_index) / spacing
    # Neighbouring A-scans share speckle, so groups are of neighbours, not drawn at random.
    groups = np.array_split(product, min(20, product.shape[1]), axis=1)
    correlations = np.array([_autocorrelation(group) for group in groups])
    total = correlations.sum(axis=0)
    strain = _phase_rate(total) * to_strain
    if len(groups) < 4:
        return strain, float("nan")
    left = np.array([_phase_rate(total - one) for one in correlations]) * to_strain
    variance = (len(groups) - 1) / len(groups) * np.sum((left - left.mean()) ** 2)
    return strain, float(np.sqrt(variance))


def _autocorrelation(product: Complex) -> Complex:
    """Autocorrelation along axis 0 at lags 0 to n - 1, summed over columns."""
    n = product.shape[0]
    size = scipy.fft.next_fast_len(2 * n)
    power = np.zeros(size)
    block = max(1, 2**22 // size)  # keeps the padded transform small
    for first in range(0, product.shape[1], block):
        spectrum = scipy.fft.fft(product[:, first : first + block], size, axis=0)
        power += np.sum(np.abs(spectrum) ** 2, axis=1)
    return np.asarray(scipy.fft.ifft(power)[:n])


def _phase_rate(correlation: Complex) -> float:
    """Phase per pixel at the maximum of the periodogram of this autocorrelation, in (-pi, pi]."""
    lags = np.arange(1, correlation.size)
    size = int(2 ** np.ceil(np.log2(16 * correlation.size)))
    coarse = np.fft.fftfreq(size)[np.argmax(np.real(scipy.fft.fft(2.0 * correlation, size)))]
    best = minimize_scalar(
        lambda rate: -float(np.real(np.sum(correlation[1:] * np.exp(-1j * rate * lags)))),
        bounds=(2.0 * np.pi * (coarse - 1.0 / size), 2.0 * np.pi * (coarse + 1.0 / size)),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(best.x)


def _independent(field: Complex) -> float:
    """Independent speckles across a volume ``(z, ...)``: equivalent number of lateral modes."""
    lateral = tuple(range(1, field.ndim))
    spectrum = np.mean(np.abs(scipy.fft.fftn(field, axes=lateral)) ** 2, axis=0)
    # Power estimated from nz rows scatters by 1 / nz of its square.
    return float(spectrum.sum() ** 2 / np.sum(spectrum**2) * (1.0 + 1.0 / field.shape[0]))


def _power(field: Complex) -> NDArray[np.float64]:
    return np.asarray(np.sum(np.abs(field.reshape(field.shape[0], -1)) ** 2, axis=1))


def _pair(before: ArrayLike, after: ArrayLike) -> tuple[Complex, Complex]:
    b, a = np.asarray(before), np.asarray(after)
    if not (np.iscomplexobj(b) and np.iscomplexobj(a)):
        raise InputError(
            f"phase needs complex OCT, got {b.dtype} and {a.dtype}: export the complex signal, not "
            "its magnitude"
        )
    if b.shape != a.shape or b.ndim < 2 or b.size == 0:
        raise InputError(
            f"volumes before and after have shapes {b.shape} and {a.shape}; they must be equal, "
            "(z, x) or (z, y, x)"
        )
    if not (np.isfinite(b).all() and np.isfinite(a).all()):
        raise InputError("volumes before and after must be finite; cut out what is missing")
    if np.array_equal(b, a):
        raise InputError(
            "volumes before and after are the same, sample by sample; give that after the step, too"
        )
    if not (b.any() and a.any()):
        raise InputError(
            "volumes before and after: all samples of one are zero, there is no signal"
        )
    return b, a


def _check_wavelength(wavelength: float) -> None:
    if not 1e-4 <= wavelength <= 1e-2:
        raise InputError(
            f"wavelength = {wavelength:g} mm: must be that of light, 1.3e-3 mm for 1300 nm"
        )


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"{name} = {value}: must be positive")
