"""Propagation of input errors to the stress map and the total force with few extra solves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from optical_palpation.analysis.force import force_balance
from optical_palpation.arguments import number
from optical_palpation.errors import InputError
from optical_palpation.palpation.result import StressResult


@dataclass(frozen=True)
class Noise:
    """Random error of a map, different from place to place.

    Attributes
    ----------
    standard_deviation
        In the map's unit.
    correlation
        Standard deviation in pixels of the Gaussian that correlates neighbours; 0 for independent
        pixels.
    probes
        Number of random fields. Each costs two solves; the estimated error scatters by about
        ``1 / sqrt(2 probes)`` of itself before smoothing.
    smoothing
        Standard deviation in pixels of the Gaussian that averages the estimated variance, which
        varies more slowly than the noise does.
    seed
        Of the random fields.
    """

    standard_deviation: float
    correlation: float = 0.0
    probes: int = 4
    smoothing: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.standard_deviation > 0.0 and self.probes >= 1 and self.correlation >= 0.0):
            raise InputError(f"{self}: needs a positive standard deviation and at least one probe")


# A coefficient of friction cannot be pushed below zero.
BOUNDS = {"window_friction": (0.0, np.inf), "sample_friction": (0.0, np.inf)}


def propagate_uncertainty(
    solve: Callable[..., StressResult],
    values: Mapping[str, Any],
    errors: Mapping[str, float | Noise],
    *,
    nominal: StressResult | None = None,
    bounds: Mapping[str, tuple[float, float]] = BOUNDS,
    each: Callable[..., Iterable[Any]] = map,
) -> xr.Dataset:
    """Propagate errors of the inputs to the axial stress and the total force.

    The solution is linearised by central differences: two solves for each error that is the same
    everywhere, ``2 probes`` for one that is random from pixel to pixel. Random fields with the
    noise's statistics, sent through the linearised solution, have in the mean the variance that
    the noise causes, which spares a solve for every pixel. Errors are taken as independent and
    added in quadrature; those of correlated inputs (c10 and c01 of one fit) belong into one
    parameter, for example a factor on the modulus. The result is of the same kind as the inputs:
    standard deviations give standard deviations, half ranges such as a friction of +-0.05 give
    half ranges.

    Parameters
    ----------
    solve
        Called with `values`, one of them changed, as keyword arguments.
    values
        Names and values of the uncertain inputs: numbers, or maps (``DataArray``).
    errors
        Error of each: a number (a systematic error; of a map, one shift of all its values), or
        :class:`Noise` for a map.
    nominal
        Solution at `values`, if there is one already.
    bounds
        Lowest and highest admissible values; a difference is one-sided where it would leave them.
    each
        Applies a function to each changed input and gives the results in order, as ``map`` does:
        that of :func:`~optical_palpation.batch.worker_map` solves side by side, if `solve` can be
        pickled.

    Returns
    -------
    xarray.Dataset
        On ``(y, x)``: ``axial_stress`` and ``axial_stress_error`` (kPa), and ``contribution``
        over ``input`` too. Over ``input``: ``force_contribution`` (mN) and ``nonlinearity``, the
        second difference of the force over twice its first: where it is not small, the error is
        not symmetric and the linearisation is coarse. Attributes ``force_mN`` and
        ``force_error_mN``.

    Raises
    ------
    InputError
        If errors name unknown inputs, are not positive, or `Noise` is given for a number.
    """
    unknown = set(errors) - set(values)
    if unknown or not errors:
        raise InputError(
            f"errors of unknown inputs: {', '.join(sorted(unknown)) or 'none given'}; the inputs "
            f"are {', '.join(values)}"
        )
    for name, error in errors.items():
        if isinstance(error, Noise):
            if not isinstance(values[name], xr.DataArray):
                raise InputError(
                    f"{name}: random noise needs a map, got {type(values[name]).__name__}"
                )
        elif not number(error, f"error of {name}", "a number above 0") > 0.0:
            raise InputError(f"error of {name} = {error}: must be positive")

    stress, force = _stress_and_force(solve(**values) if nominal is None else nominal)
    pairs = {
        name: _pairs(values[name], error, *bounds.get(name, (-np.inf, np.inf)))
        for name, error in errors.items()
    }
    for name, found in pairs.items():
        if any(width == 0.0 for *_, width in found):
            lowest, highest = bounds.get(name, (-np.inf, np.inf))
            raise InputError(f"{name}: its bounds {lowest:g} to {highest:g} leave no room")
    changes = [
        (name, value) for name, found in pairs.items() for pair in found for value in pair[:2]
    ]
    solved = iter(each(partial(_solved, solve, values), changes))
    maps: list[xr.DataArray] = []
    forces: list[float] = []
    bends: list[float] = []
    for name, error in errors.items():
        variance, force_variance, bend = xr.zeros_like(stress), 0.0, 0.0
        count = len(pairs[name])
        for *_, width in pairs[name]:
            (high, force_high), (low, force_low) = next(solved), next(solved)
            variance = variance + ((high - low) / (2.0 * width)) ** 2 / count
            change = (force_high - force_low) / (2.0 * width)
            force_variance += change**2 / count
            if width > 1.0 - 1e-9 and change != 0.0:
                bend += abs((force_high - 2.0 * force + force_low) / (2.0 * change)) / count
        if isinstance(error, Noise) and error.smoothing > 0.0:
            variance = _smooth(variance, error.smoothing)
        maps.append(variance**0.5)
        forces.append(float(np.sqrt(force_variance)))
        bends.append(bend)

    contribution = xr.concat(maps, dim=xr.IndexVariable("input", list(errors)))
    return _together(stress, force, contribution, np.array(forces), np.array(bends))


def linear_uncertainty(result: StressResult, errors: Mapping[str, float]) -> xr.Dataset:
    """Propagate errors by the sensitivities of a result.

    Parameters
    ----------
    result
        A result with ``sensitivities``.
    errors
        Error of each input.

    Returns
    -------
    xarray.Dataset
        As from :func:`propagate_uncertainty`; ``nonlinearity`` is not known.

    Raises
    ------
    InputError
        If the result has no sensitivity to an input.
    """
    known = result.sensitivities
    names = [] if known is None else known["input"].values.tolist()
    if known is None or (absent := set(errors) - set(names)) or not errors:
        raise InputError(
            f"sensitivities to {', '.join(names) or 'nothing'}: none to "
            f"{', '.join(sorted(absent)) if known is not None else 'any input'}"
        )
    stress, force = _stress_and_force(result)
    each = xr.DataArray(list(errors.values()), {"input": list(errors)}, ("input",))
    known = known.sel(input=list(errors))
    contribution = abs(known["axial_stress"] * each).drop_vars("unit", errors="ignore")
    forces = abs(known["force"] * each).values
    return _together(stress, force, contribution, forces, np.full(len(errors), np.nan))


def _together(
    stress: xr.DataArray,
    force: float,
    contribution: xr.DataArray,
    forces: NDArray[np.float64],
    bends: NDArray[np.float64],
) -> xr.Dataset:
    """Add the contributions of the inputs in quadrature."""
    total = (contribution**2).sum("input", skipna=False) ** 0.5
    return xr.Dataset(
        {
            "axial_stress": stress.assign_attrs(units="kPa"),
            "axial_stress_error": total.assign_attrs(units="kPa"),
            "contribution": contribution.assign_attrs(units="kPa"),
            "force_contribution": ("input", forces, {"units": "mN"}),
            "nonlinearity": ("input", bends, {"units": "1"}),
        },
        attrs={"force_mN": force, "force_error_mN": float(np.linalg.norm(forces))},
    )


def combined_uncertainty(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Put errors of different inputs together, which are independent."""
    if len(parts) == 1:
        return parts[0]
    over = ["contribution", "force_contribution", "nonlinearity"]
    together = xr.concat([part[over] for part in parts], dim="input")
    total = (together["contribution"] ** 2).sum("input", skipna=False) ** 0.5
    together["axial_stress"] = parts[0]["axial_stress"]
    together["axial_stress_error"] = total.assign_attrs(units="kPa")
    error = float(np.linalg.norm(together["force_contribution"]))
    together.attrs = {"force_mN": parts[0].attrs["force_mN"], "force_error_mN": error}
    return together


def _pairs(
    value: Any, error: float | Noise, lowest: float, highest: float
) -> list[tuple[Any, Any, float]]:
    """Values on both sides of one, and the fraction of the full width that its bounds leave."""
    if isinstance(error, Noise):
        return [(value + field, value - field, 1.0) for field in _fields(value, error)]
    up, down = (_clip(value + step, lowest, highest) for step in (error, -error))
    return [(up, down, float(np.max(np.abs(up - down))) / (2.0 * float(error)))]


def _solved(
    solve: Callable[..., StressResult], values: Mapping[str, Any], change: tuple[str, Any]
) -> tuple[xr.DataArray, float]:
    """Stress and force with one of the values changed."""
    name, value = change
    return _stress_and_force(solve(**{**values, name: value}))


def _stress_and_force(result: StressResult) -> tuple[xr.DataArray, float]:
    stress = result.maps["axial_stress"].drop_attrs()
    force = result.maps.attrs.get("sample_force_mN")
    return stress, float(force) if force is not None else force_balance(stress).force


def _fields(value: xr.DataArray, noise: Noise) -> list[xr.DataArray]:
    """Random fields of the noise's standard deviation and correlation."""
    rng = np.random.default_rng(noise.seed)
    fields = []
    for _ in range(noise.probes):
        field = rng.standard_normal(value.shape)
        if noise.correlation > 0.0:
            field = gaussian_filter(field, noise.correlation, mode="wrap")
            impulse = np.zeros(value.shape)
            impulse[tuple(n // 2 for n in value.shape)] = 1.0
            kernel = gaussian_filter(impulse, noise.correlation, mode="wrap")
            field /= np.sqrt(np.sum(kernel**2))
        fields.append(value.copy(data=noise.standard_deviation * field))
    return fields


def _clip(value: Any, lowest: float, highest: float) -> Any:
    if isinstance(value, xr.DataArray):
        return value.clip(lowest, highest)
    return min(max(value, lowest), highest)


def _smooth(variance: xr.DataArray, sigma: float) -> xr.DataArray:
    """Gaussian average over the pixels with a value."""
    valid = np.isfinite(variance.values)
    weight = gaussian_filter(valid.astype(np.float64), sigma)
    average = gaussian_filter(np.where(valid, variance.values, 0.0), sigma)
    smooth = np.where(valid, average / np.maximum(weight, 1e-12), np.nan)
    return variance.copy(data=smooth)
