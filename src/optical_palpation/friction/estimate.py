"""Friction coefficient from a displacement profile and calibration curves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import t as student_t

from optical_palpation.arguments import file_path, number
from optical_palpation.errors import InputError
from optical_palpation.regression import independent_points
from optical_palpation.volume.text import read_columns
from optical_palpation.volume.units import MM, length_unit, split_unit

Array = NDArray[np.float64]

# Even strain and full sticking differ by 7 % of the step (rms), so that no friction bends a profile
# by more.
_DOUBTFUL, _IMPOSSIBLE = 0.1, 0.25
#: How much larger or smaller than that of the calibration a step may be.
_STEPS_ALIKE = 3.0


@dataclass(frozen=True)
class FrictionEstimate:
    """Coefficient of friction at the window, and how well the profile determines it.

    Attributes
    ----------
    coefficient
        Best fit within the calibrated range.
    interval
        95 % confidence interval, cut off at the ends of the calibrated range. Errors of the
        calibration itself (material, thickness, friction at the sample) are not in it.
    at_limit
        Whether the best fit is an end of the calibrated range: the coefficient is then a bound.
    step
        Displacement at the sample side, in the profile's unit.
    offset
        Displacement at the window, in the profile's unit; 0 unless it was fitted.
    residual
        Root mean square misfit relative to `step`.
    unit
        Unit of length of the profile, a key of ``volume.units.MM``, or None if it does not say.
    profile
        Over ``depth``: ``measured`` and ``fitted`` displacement and, if it was given,
        ``standard_error``, all relative to the step.
    """

    coefficient: float
    interval: tuple[float, float]
    at_limit: bool
    step: float
    offset: float
    residual: float
    unit: str | None
    profile: xr.Dataset


def estimate_friction(
    profile: xr.Dataset, calibration: xr.DataArray, *, fit_offset: bool = False
) -> FrictionEstimate:
    """Find the calibration curve that a measured profile follows (section 4 of the paper).

    The profile is fitted by ``step * curve(depth; friction)``, points weighted by their standard
    errors; scaling by a fitted step instead of by the last point keeps that point's noise out of
    all others. Between calibrated coefficients curves are interpolated monotonically. The interval
    is that of the profile likelihood, widened for correlated residuals.

    Parameters
    ----------
    profile
        ``displacement`` over ``depth`` (fraction of the loaded layer, 0 at the window), any unit,
        and optionally ``standard_error``; see :func:`displacement_profile` and
        :func:`read_profile`.
    calibration
        Normalised incremental displacement over ``friction`` and ``depth`` (fractions).
    fit_offset
        Whether the displacement at the window is unknown too. Not needed if the window is the
        reference of the interferometer.

    Raises
    ------
    InputError
        If profile and calibration are unusable or do not overlap; if the step is not different from
        zero, or the profile farther from all curves than friction can bend it.
    """
    friction, curves = _curves(calibration)
    depth, measured, error = _points(profile)
    shape = PchipInterpolator(friction, curves(depth), axis=0)

    def fit(mu: float) -> tuple[float, NDArray[np.floating], Array]:
        design = np.column_stack([shape(mu), np.ones_like(depth)])[:, : 1 + fit_offset]
        weighted = design / error[:, None]
        coefficients, *_ = np.linalg.lstsq(weighted, measured / error, rcond=None)
        residual = (design @ coefficients - measured) / error
        return float(residual @ residual), coefficients, np.asarray(residual, dtype=np.float64)

    low, high = float(friction[0]), float(friction[-1])
    grid = np.linspace(low, high, 201)
    misfit = np.array([fit(mu)[0] for mu in grid])
    k = int(np.argmin(misfit))
    bracket = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    best = minimize_scalar(
        lambda mu: fit(mu)[0], bounds=bracket, method="bounded", options={"xatol": 1e-7}
    )
    mu = float(best.x) if best.fun < misfit[k] else float(grid[k])
    smallest, coefficients, residual = fit(mu)
    step = float(coefficients[0])
    offset = float(coefficients[1]) if fit_offset else 0.0
    design = np.column_stack([shape(mu), np.ones_like(depth)])[:, : 1 + fit_offset]
    freedom = depth.size - design.shape[1]
    weighted = design / error[:, None]
    spread = np.sqrt(smallest / freedom * np.linalg.inv(weighted.T @ weighted)[0, 0])
    if not abs(step) > float(student_t.ppf(0.975, freedom)) * spread:
        raise InputError(
            f"the profile shows no displacement: the step of {step:.2g} is not different from zero "
            f"(standard error {spread:.2g}); was there a step?"
        )

    parameters = 2 + fit_offset
    independent = independent_points(residual, parameters)
    quantile = float(student_t.ppf(0.975, independent - parameters))
    variance = smallest / (depth.size - parameters) * depth.size / independent
    threshold = smallest + quantile**2 * variance

    def excess(value: float) -> float:
        return fit(value)[0] - threshold

    relative = xr.Dataset(
        {
            "measured": ("depth", (measured - offset) / step),
            "fitted": ("depth", shape(mu)),
            "standard_error": (
                "depth",
                error / abs(step) if "standard_error" in profile else np.full(depth.shape, np.nan),
            ),
        },
        coords={"depth": depth},
    )
    misfit_of_step = float(np.sqrt(np.mean((relative["measured"] - relative["fitted"]) ** 2)))
    if misfit_of_step > _IMPOSSIBLE:
        raise InputError(
            f"the profile differs from every calibration curve by {misfit_of_step:.0%} of the step "
            "(rms) or more, and friction bends a profile by less than a tenth of it; depth counts "
            "from the window, which stands still unless the offset is fitted: are depths and faces "
            "right, and is the profile no noise?"
        )
    return FrictionEstimate(
        coefficient=mu,
        interval=(
            low if excess(low) <= 0.0 else float(brentq(excess, low, mu)),
            high if excess(high) <= 0.0 else float(brentq(excess, mu, high)),
        ),
        at_limit=min(mu - low, high - mu) < 1e-3 * (high - low),
        step=step,
        offset=offset,
        residual=misfit_of_step,
        unit=length_unit(str(profile["displacement"].attrs.get("units", ""))),
        profile=relative,
    )


def doubts_about(estimate: FrictionEstimate, calibration: xr.DataArray) -> list[str]:
    """Say in plain words what casts doubt on an estimate: its misfit, sign and size of the step.

    Parameters
    ----------
    estimate
        As :func:`estimate_friction` gives it.
    calibration
        The curves that it was made with.
    """
    doubts = []
    if estimate.residual > _DOUBTFUL:
        doubts.append(
            f"the profile differs from every calibration curve by {estimate.residual:.0%} of the "
            "step (rms), more than friction can bend it: are layer, region and depths those of the "
            "calibration?"
        )
    if estimate.step > 0.0:
        doubts.append(
            "the layer moves away from the window, and a step that presses it moves it towards the "
            "window: are the volumes in their order, and is the sign of the displacement right? "
            "While the load is taken away, friction acts the other way round"
        )
    expected = calibration.attrs.get("step_mm")
    if estimate.unit and expected:
        step = abs(estimate.step) * MM[estimate.unit]
        if not 1.0 / _STEPS_ALIKE < step / expected < _STEPS_ALIKE:
            doubts.append(
                f"the step of {1e3 * step:.2g} um is not that of the calibration, "
                f"{1e3 * expected:.2g} um: are wavelength and units right? Else make curves for "
                "this step"
            )
    return doubts


def read_profile(
    path: str | Path, thickness: float | None = None, *, calibrated: float | None = None
) -> xr.Dataset:
    """Read a displacement profile from a CSV of depth, displacement and, if known, its error.

    Columns are found by name: *depth*, *displacement*, *error* (or *std*, *sd*). Depth is a
    length from the window if its name has a unit (*depth_um*), the fraction of the loaded layer if
    it says so (*depth_fraction*); else mm if `thickness` is given, and a fraction if it is not.
    Displacements may have any unit; errors must have the same.

    Parameters
    ----------
    path
        The file.
    thickness
        Loaded thickness of the layer, mm.
    calibrated
        That of the calibration curves, mm, which stands in for `thickness` where the depth has a
        unit. A depth that has none and could be either, mm or a fraction, is refused.

    Raises
    ------
    InputError
        If the file cannot be read, columns are missing or ambiguous, or values are no numbers.
    """
    path = file_path(path)
    if thickness is not None and not number(thickness, "thickness", "a length in mm") > 0.0:
        raise InputError(f"thickness = {thickness}: must be positive, in mm")
    table = read_columns(path)
    free = list(table.names)
    columns: dict[str, Array] = {}
    units: dict[str, str | None] = {}
    fraction = False
    for key, hints in (
        ("depth", ("depth",)),
        ("standard_error", ("error", "std", "sd")),
        ("displacement", ("displacement",)),
    ):
        found = [name for name in free if any(hint in name.lower() for hint in hints)]
        if len(found) > 1:
            raise InputError(
                f"{path}: several columns could be the {key}: {', '.join(found)}; leave one"
            )
        if not found:
            if key == "standard_error":
                continue
            raise InputError(f"{path}: no column for the {key}; the table has: {', '.join(free)}")
        free.remove(found[0])
        columns[key] = table.numbers(found[0])
        units[key] = split_unit(found[0])[1]
        fraction |= key == "depth" and "fraction" in found[0].lower()
    if units.get("standard_error", units["displacement"]) != units["displacement"]:
        raise InputError(
            f"{path}: the displacement is in {units['displacement']}, its error in "
            f"{units['standard_error']}; give both in one unit"
        )
    depth = columns.pop("depth")
    largest = depth.max(initial=0.0)
    if units["depth"] is not None:
        whole = thickness or calibrated
        if whole is None:
            raise InputError(
                f"{path}: the depth is in {units['depth']}; give the loaded thickness, or the "
                "depth as a fraction of it"
            )
        depth = depth * MM[units["depth"]] / whole
    elif thickness is not None and not fraction:
        depth = depth / thickness
    elif calibrated is not None and not fraction and largest <= calibrated:
        raise InputError(
            f"{path}: the depth has no unit, and could be mm or a fraction of the layer; call the "
            "column depth_mm or depth_fraction"
        )
    if depth.size and (depth.min() < -1e-9 or depth.max() > 1.0 + 1e-9):
        raise InputError(
            f"{path}: depth runs from {depth.min():g} to {depth.max():g} of the layer, but must "
            "lie within 0 and 1; without a unit it is mm if the loaded thickness is given, and a "
            "fraction if it is not or the column is called depth_fraction"
        )
    unit = units["displacement"]
    attrs = {} if unit is None else {"units": unit}
    return xr.Dataset({k: ("depth", v, attrs) for k, v in columns.items()}, coords={"depth": depth})


def _curves(calibration: xr.DataArray) -> tuple[Array, PchipInterpolator]:
    """Return the calibrated coefficients and their curves as functions of depth."""
    if set(calibration.dims) != {"friction", "depth"}:
        raise InputError(
            f"calibration has dimensions {calibration.dims}, it needs 'friction' and 'depth'"
        )
    curves = calibration.transpose("friction", "depth").sortby(["friction", "depth"])
    friction, depth = (curves[d].values.astype(np.float64) for d in ("friction", "depth"))
    if friction.size < 2 or depth.size < 3 or not np.isfinite(curves.values).all():
        raise InputError(
            f"calibration of {friction.size} coefficients at {depth.size} depths: at least 2 and 3 "
            "finite ones are needed"
        )
    if np.any(np.diff(friction) <= 0.0) or np.any(np.diff(depth) <= 0.0):
        raise InputError("calibration: coefficients and depths must all be different")
    return friction, PchipInterpolator(depth, curves.values.astype(np.float64), axis=1)


def _points(profile: xr.Dataset) -> tuple[Array, Array, Array]:
    """Depth, displacement and standard error (1 where none is given), checked."""
    if "displacement" not in profile or profile["displacement"].dims != ("depth",):
        raise InputError("a profile needs the variable 'displacement' over 'depth'")
    profile = profile.sortby("depth")
    depth = profile["depth"].values.astype(np.float64)
    measured = profile["displacement"].values.astype(np.float64)
    error = np.ones_like(depth)
    if "standard_error" in profile:
        error = profile["standard_error"].values.astype(np.float64)
    if not (np.isfinite(depth).all() and np.isfinite(measured).all() and np.isfinite(error).all()):
        raise InputError("a profile must be finite; leave out what is missing")
    if depth.size < 6 or depth[0] < 0.0 or depth[-1] > 1.0 or np.ptp(depth) < 0.3:
        raise InputError(
            f"a profile needs at least 6 depths within 0 and 1 that span a third of the layer; "
            f"got {depth.size}, from {depth.min():g} to {depth.max():g}"
        )
    if not np.all(error > 0.0):
        raise InputError("standard errors of a profile must be positive")
    return depth, measured, error
