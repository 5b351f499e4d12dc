"""Errors of friction, material and thickness, propagated through the computational method."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import xarray as xr

from optical_palpation.analysis.uncertainty import (
    Noise,
    combined_uncertainty,
    linear_uncertainty,
    propagate_uncertainty,
)
from optical_palpation.arguments import check_instance, explained, number
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.material import Law
from optical_palpation.palpation.computational import Hold, computational_stress
from optical_palpation.palpation.input_errors import InputErrors
from optical_palpation.palpation.progress import Progress
from optical_palpation.palpation.result import StressResult


@explained
def stress_uncertainty(
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    material: Law,
    *,
    window_friction: Hold,
    sample_friction: Hold,
    window_friction_error: float = 0.05,
    sample_friction_error: float = 0.05,
    modulus_error: float = 0.0,
    thickness_error: float = 0.0,
    thickness_noise: Noise | None = None,
    nominal: StressResult | None = None,
    progress: Callable[[Progress], None] | None = None,
    each: Callable[..., Iterable[Any]] | None = None,
    **options: Any,
) -> xr.Dataset:
    """Propagate errors of the inputs to the computational stress and the total force.

    The error bars of section 5 of the paper, as maps. Errors common to the whole map follow from
    the sensitivities of the solution; noise costs two solves for each probe. Where a solution has
    no sensitivities, every error costs two solves.

    Parameters
    ----------
    loaded, initial_thickness, material, window_friction, sample_friction
        As for :func:`~optical_palpation.palpation.computational_stress`.
    window_friction_error, sample_friction_error
        Errors of the coefficients; a glued face has none.
    modulus_error
        Relative error of the material's stiffness, common to its coefficients, which come from one
        fit.
    thickness_error
        Error common to all of the loaded thickness, mm, as from a wrong refractive index.
    thickness_noise
        Error of the loaded thickness that differs from place to place, mm.
    nominal
        Solution for the inputs as they are, if there is one already.
    progress
        As for ``computational_stress``; the stage also counts the solves.
    each
        Computes what the noise costs side by side: the function that
        :func:`~optical_palpation.batch.worker_map` gives. By default one solve follows another.
    options
        Further arguments of ``computational_stress``.

    Returns
    -------
    xarray.Dataset
        As from :func:`~optical_palpation.analysis.propagate_uncertainty`.

    Raises
    ------
    InputError
        If no error is given, or an input or error cannot be used.
    ConvergenceError
        If a solve does not reach the full load.
    """
    values: dict[str, Any] = {
        "window_friction": window_friction,
        "sample_friction": sample_friction,
        "modulus": 1.0,
        "thickness": loaded,
        "thickness_noise": xr.zeros_like(loaded),
    }
    given: dict[str, float | Noise | None] = {
        "window_friction": window_friction_error,
        "sample_friction": sample_friction_error,
        "modulus": modulus_error,
        "thickness": thickness_error,
        "thickness_noise": thickness_noise,
    }
    errors = {
        name: error
        for name, error in given.items()
        if error and not (isinstance(values[name], str) and values[name] == "glued")
    }
    if not errors:
        raise InputError("all errors are zero: give at least one")
    for name, error in errors.items():
        if not isinstance(error, Noise) and number(error, f"{name}_error") < 0.0:
            raise InputError(f"{name}_error: a number of at least 0, not {error!r}")
    if nominal is not None:
        check_instance(nominal, StressResult, "nominal", "a StressResult (op.read_result)")
    solves = sum(2 * e.probes for e in errors.values() if isinstance(e, Noise))
    solves += nominal is None
    count = 0
    alone = _Solve(loaded, initial_thickness, material, options)

    def solve(**inputs: Any) -> StressResult:
        nonlocal count
        count += 1
        stage = f"solve {count} of {solves}"

        def report(now: Progress) -> None:
            if progress:
                progress(replace(now, stage=f"{stage}: {now.stage}"))

        first = nominal is None and count == 1
        return alone(**inputs, estimates=first, progress=report)

    def side_by_side(function: Callable[..., Any], changes: Iterable[Any]) -> Iterator[Any]:
        nonlocal count
        assert each is not None
        for found in each(function, changes):
            count += 1
            if progress:
                progress(Progress(f"{count} of {solves} solves", count / solves, None))
            yield found

    how: dict[str, Any] = {"solve": solve}
    if each is not None:
        how = {"solve": alone, "each": side_by_side}
    here = solve(**values) if nominal is None else nominal
    known = here.sensitivities
    if known is None or known.attrs["failure"]:
        solves += 2 * sum(not isinstance(error, Noise) for error in errors.values())
        return propagate_uncertainty(values=values, errors=errors, nominal=here, **how)
    common = {name: e for name, e in errors.items() if not isinstance(e, Noise)}
    noise = {name: e for name, e in errors.items() if isinstance(e, Noise)}
    parts = [linear_uncertainty(here, common)] if common else []
    if noise:
        parts.append(propagate_uncertainty(values=values, errors=noise, nominal=here, **how))
    return combined_uncertainty(parts)


@dataclass(frozen=True)
class _Solve:
    """The stress for inputs that are given; it can be pickled."""

    loaded: xr.DataArray
    initial_thickness: float | xr.DataArray
    material: Law
    options: Mapping[str, Any]

    def __call__(
        self,
        window_friction: Hold,
        sample_friction: Hold,
        modulus: float,
        thickness: xr.DataArray,
        thickness_noise: xr.DataArray,
        *,
        estimates: bool = False,
        progress: Callable[[Progress], None] | None = None,
    ) -> StressResult:
        # Sums of maps lose what the map says of itself, such as the extent of the layer.
        here = (thickness + thickness_noise).assign_attrs(self.loaded.attrs)
        result = computational_stress(
            here,
            self.initial_thickness,
            self.material.scaled(modulus),
            window_friction=window_friction,
            sample_friction=sample_friction,
            mesh_check=estimates,
            edge_check=estimates,
            input_errors=InputErrors() if estimates else None,
            progress=progress,
            **self.options,
        )
        attrs = result.maps.attrs
        for key in ("asked_elements_failure", "asked_edges_failure"):
            if key in attrs:  # differences between meshes are no errors of inputs
                raise ConvergenceError(attrs[key])
        return result
