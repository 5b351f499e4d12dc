"""Contrast of features and correlation of fine structure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from optical_palpation.analysis.maps import check_map, pixel_size, plane_noise
from optical_palpation.averages import gaussian_average
from optical_palpation.errors import InputError


@dataclass(frozen=True)
class FeatureContrast:
    """How far a feature stands out of what surrounds it.

    Attributes
    ----------
    stress
        Mean stress of the feature, kPa.
    background
        Mean stress of its surroundings, kPa.
    noise
        Standard deviation of the surroundings about a plane, kPa.
    stress_to_noise
        ``|stress| / noise``, the paper's contrast (figure 6).
    contrast_to_noise
        ``|stress - background| / noise``.
    """

    stress: float
    background: float
    noise: float
    stress_to_noise: float
    contrast_to_noise: float


def feature_contrast(
    stress: xr.DataArray, feature: xr.DataArray, width: float, gap: float = 0.0
) -> FeatureContrast:
    """Contrast of a feature against the ring around it.

    Parameters
    ----------
    stress
        Stress on ``(y, x)``, kPa.
    feature
        True inside the feature, on the same grid.
    width
        Width of the ring that is its surroundings, mm.
    gap
        Distance from the feature to the ring, mm, to leave out a blurred rim.

    Raises
    ------
    InputError
        If map and mask do not fit, or either region has fewer than 6 values.
    """
    field = check_map(stress, "stress")
    mask = feature.transpose("y", "x")
    if mask.shape != field.shape or mask.dtype != bool:
        raise InputError(
            f"feature: needs a mask (bool) of the map's shape {field.shape}, got {mask.dtype} "
            f"{mask.shape}"
        )
    distance = distance_transform_edt(~mask.values, sampling=pixel_size(field))
    valid = np.isfinite(field.values)
    inside = mask.values & valid
    ring = (distance > gap) & (distance <= gap + width) & valid & ~mask.values
    if inside.sum() < 6 or ring.sum() < 6:
        raise InputError(
            f"feature of {inside.sum()} and surroundings of {ring.sum()} pixels with a value: at "
            "least 6 of each are needed; widen the ring"
        )
    around = field.values[ring]
    noise = plane_noise(field, ring)
    if noise == 0.0:
        raise InputError("the surroundings of the feature have no noise: the contrast is infinite")
    mean, background = float(field.values[inside].mean()), float(around.mean())
    return FeatureContrast(
        mean, background, noise, abs(mean) / noise, abs(mean - background) / noise
    )


@dataclass(frozen=True)
class PerturbationCorrelation:
    """Correlation of the fine structure of two maps.

    Attributes
    ----------
    coefficient
        Pearson's coefficient of the perturbations, -1 to 1.
    peak
        Extreme of the normalised cross-correlation over all shifts up to the scale.
    shift
        Shift (y, x) of the second map against the first at the peak, mm.
    """

    coefficient: float
    peak: float
    shift: tuple[float, float]


def perturbation_correlation(
    thickness: xr.DataArray, stress: xr.DataArray, scale: float
) -> PerturbationCorrelation:
    """Correlate the fine structure of layer thickness and stress (section 7 of the paper).

    A high coefficient says that texture in the stress comes from the sample's surface and not
    from the computation. Perturbations are what a Gaussian average of standard deviation `scale`
    leaves over. Where the sample's surface stands out the layer is thinner and stress more
    negative, so that the coefficient of thickness with axial stress is positive.

    Parameters
    ----------
    thickness, stress
        Maps on the same ``(y, x)`` grid.
    scale
        Length below which structure counts as perturbation, mm. Pixels within two scales of the
        border or of a missing value are left out.

    Raises
    ------
    InputError
        If the maps cannot be used or are constant.
    """
    a, b = check_map(thickness, "thickness"), check_map(stress, "stress")
    if a.shape != b.shape:
        raise InputError(f"thickness {a.shape} and stress {b.shape} must be on the same grid")
    dy, dx = pixel_size(a)
    if not scale > max(dy, dx):
        raise InputError(f"scale = {scale:g} mm: must be larger than a pixel ({dy:g} x {dx:g} mm)")
    valid = np.isfinite(a.values) & np.isfinite(b.values)
    sigma = (scale / dy, scale / dx)
    weight = gaussian_average(valid.astype(np.float64), sigma, "constant")
    # Two standard deviations from a straight border: nearer, the average is one-sided and takes
    # slopes for perturbations.
    inner = valid & (weight > 0.977)
    if inner.sum() < 9:
        raise InputError(
            f"scale = {scale:g} mm: nothing is left two scales from the border and from missing "
            "values; choose a smaller one"
        )
    p, q = (_perturbation(field.values, valid, weight, sigma) * inner for field in (a, b))
    p, q = ((r - r[inner].mean()) * inner for r in (p, q))
    norm = np.sqrt(np.sum(p**2) * np.sum(q**2))
    if norm == 0.0:
        raise InputError("thickness or stress has no perturbations at all")

    reach = [min(int(s), n // 4) for s, n in zip(sigma, a.shape, strict=True)]
    coefficient = float(np.sum(p * q) / norm)
    correlation = _cross_correlation(p, q, reach) / norm
    k = np.unravel_index(int(np.argmax(np.abs(correlation))), correlation.shape)
    shift = (int(k[0]) - reach[0]) * dy, (int(k[1]) - reach[1]) * dx
    return PerturbationCorrelation(coefficient, float(correlation[k]), shift)


def _perturbation(
    field: NDArray[np.float64],
    valid: NDArray[np.bool_],
    weight: NDArray[np.float64],
    sigma: tuple[float, float],
) -> NDArray[np.float64]:
    """Deviation from the Gaussian average of the valid pixels, zero elsewhere."""
    average = gaussian_average(np.where(valid, field, 0.0), sigma, "constant")
    return np.where(valid, field - average / np.maximum(weight, 1e-12), 0.0)


def _cross_correlation(
    p: NDArray[np.float64], q: NDArray[np.float64], reach: list[int]
) -> NDArray[np.float64]:
    """Sum of ``p[r] q[r + s]`` for shifts s of up to `reach` pixels."""
    size = [n + r for n, r in zip(p.shape, reach, strict=True)]
    product = np.conj(np.fft.rfft2(p, size)) * np.fft.rfft2(q, size)
    full = np.fft.irfft2(product, size)
    rows = np.arange(-reach[0], reach[0] + 1)
    columns = np.arange(-reach[1], reach[1] + 1)
    return full[np.ix_(rows, columns)]
