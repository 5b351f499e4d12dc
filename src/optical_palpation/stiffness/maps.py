"""Maps and attributes of a result with the sample in the model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.mechanics.grid import node_positions
from optical_palpation.mechanics.stack.assembly import Blocks
from optical_palpation.mechanics.stack.cascade import FINAL
from optical_palpation.mechanics.stack.newton import balance
from optical_palpation.mechanics.stack.problem import LAYER, WINDOW
from optical_palpation.palpation.algebraic import stress_of_pixels
from optical_palpation.palpation.computational import residuals
from optical_palpation.palpation.plausibility import unusual
from optical_palpation.palpation.result import StressResult
from optical_palpation.palpation.stack_maps import body_dataset, observed_maps
from optical_palpation.stiffness.errors import Band, Errors
from optical_palpation.stiffness.forward import Columns, Model, Pressed
from optical_palpation.stiffness.inversion import Estimate
from optical_palpation.stiffness.measurement import ThicknessSurface
from optical_palpation.stiffness.sample import Sample
from optical_palpation.thickness.frames import inside_layer
from optical_palpation.thickness.initial import match_initial_thickness

Array = NDArray[np.float64]

#: Standard deviation of the logarithm of a column's stiffness above which nothing is known of it.
_UNKNOWN = 0.5
#: Half the 95 % band of a height, in thicknesses of the layer, above which nothing is known of it.
_UNKNOWN_HEIGHT = 0.2

#: Misfit over what noise and mesh explain from which it is said that the model does not fit.
_DOUBTFUL = 3.0

#: Maps that a result with a sample has more than one without: units and meaning.
SAMPLE_MAPS = {
    "sample_displacement_x": ("mm", "lateral displacement of the sample's surface, x"),
    "sample_displacement_y": ("mm", "lateral displacement of the sample's surface, y"),
    "thickness_misfit": ("mm", "computed less measured loaded thickness"),
    "sample_shear_modulus": ("kPa", "initial shear modulus of the sample"),
    "sample_youngs_modulus": ("kPa", "initial Young's modulus of the sample"),
    "sample_modulus_error": ("1", "half the 95 % band of the modulus over the modulus"),
    "axial_stress_error": ("kPa", "half the 95 % band of the axial stress"),
}
#: Maps of a relief that was sought.
RELIEF_MAPS = {
    "sample_relief": ("mm", "height of the sample's unloaded surface above its mean"),
    "sample_relief_error": ("mm", "half the 95 % band of the height"),
}


def sample_result(
    estimate: Estimate,
    errors: Errors,
    loads: Sequence[xr.DataArray],
    initial_thickness: float | xr.DataArray,
    sample: Sample,
    model: Model,
    measured: Sequence[ThicknessSurface],
    doubts: Sequence[str] = (),
) -> StressResult:
    """Return the result of an estimate.

    Parameters
    ----------
    estimate, errors
        What was found, and its bands.
    loads, initial_thickness
        The loaded thickness at each load and the unloaded one, mm.
    sample
        What was known of the sample.
    model
        The model on the finest mesh.
    measured
        The surfaces of the loaded thickness.
    doubts
        What there is to say of it already.
    """
    blocks, columns = model.blocks, model.columns
    size = columns.x[1] - columns.x[0], columns.y[1] - columns.y[0]
    x0, x1, y0, y1 = blocks.extent
    x, y = node_positions(x1 - x0, size[0], x0), node_positions(y1 - y0, size[1], y0)
    each, of_pixels = [], []
    for pressed, band, loaded, surface in zip(
        estimate.pressed, errors.loads, loads, measured, strict=True
    ):
        initial = match_initial_thickness(initial_thickness, loaded)
        algebraic = stress_of_pixels(loaded, initial, blocks.law)
        each.append(_of_load(pressed, band, loaded, algebraic, surface, x, y))
        of_pixels.append(
            xr.Dataset({"algebraic_axial_stress": algebraic, "loaded_thickness": loaded})
        )
    maps = each[-1].copy()
    thickness = model.layer.typical_thickness
    there = np.meshgrid(x, y)
    # What is known is known from the thickness above it, which answers to no more than its own
    # thickness around: beyond that smoothing alone makes a number.
    near = np.any([surface.distance(*there) <= thickness for surface in measured], axis=0)
    _add_stiffness(maps, estimate, errors, blocks, columns, near)
    if estimate.sought.relief is not None:
        _add_relief(maps, estimate.sought.relief, errors, columns, thickness, near)
    stack, state = estimate.pressed[-1].stack, estimate.pressed[-1].state
    maps.attrs = {
        **{key: value for key, value in loads[-1].attrs.items() if key.startswith("source")},
        **_earlier(loads[:-1]),
        "method": "computational",
        **blocks.law.attributes,
        "bulk_to_shear": blocks.law.bulk_to_shear,
        "window_friction": blocks.friction[0],
        "sample_friction": blocks.friction[1],
        "initial_thickness_mm": float(initial.where(inside_layer(loads[-1])).mean()),
        **_sample_attributes(sample, blocks),
        **each[-1].attrs,
        **_of_inversion(estimate, errors, measured),
        "element_size_mm": list(stack.bodies[LAYER].grid.spacing[::-1]),
        "elements": stack.n_elements,
        "no_contact_share": algebraic.attrs["no_contact_share"],
        "slip_length_mm": stack.slip_length,
    }
    said = [*unusual(blocks.law, maps), *_doubts(estimate, errors, near), *doubts]
    maps.attrs["unusual"] = json.dumps(said)
    return StressResult(
        maps,
        body_dataset(stack, state, LAYER),
        pixels=of_pixels[-1].drop_attrs(deep=False),
        series=_series(each, estimate.sought.travels) if len(each) > 1 else None,
    )


def _doubts(estimate: Estimate, errors: Errors, near: NDArray[np.bool_]) -> list[str]:
    """Say what bands do not hold.

    That are points not ``near`` measured ones, a model that is off, and inputs with whose errors it
    does not reach the load.
    """
    said = []
    if left_out := [name for name, of in errors.inputs.items() if of["force_mN"] is None]:
        said.append(
            f"the bands leave out the error of {', '.join(left_out).replace('_', ' ')}: with an "
            "input that is off by so much the model does not reach the load"
        )
    if not near.all():
        said.append(
            f"on {1 - near.mean():.0%} of the map the thickness was not measured within a layer's "
            "thickness around: the sample there is taken to go on as beside it, and the bands of "
            "stress and force do not hold what it may be instead"
        )
    if estimate.over_tolerance > _DOUBTFUL:
        said.append(
            f"computed and measured thickness differ by {estimate.over_tolerance:.1f} times what "
            "noise and mesh explain: something in the model does not fit, and the error may be "
            "larger than the bands. Check the travel, the thickness and the relief of the sample "
            "and the unloaded thickness, and see whether smaller elements change it"
        )
    return said


def as_rigid(
    results: Sequence[StressResult], sample: Sample, blocks: Blocks, doubts: Sequence[str] = ()
) -> StressResult:
    """Return the last result of a layer on an imprint, as one with a sample that is rigid.

    ``doubts`` say what there is to say of it already. Nothing can be said of its stiffness. With
    several loads the earlier ones go into the series.
    """
    for result in results:
        still = xr.zeros_like(result.maps["axial_stress"])
        for name, (units, text) in SAMPLE_MAPS.items():
            if name == "axial_stress_error" and name in result.maps:
                continue
            values = still if name.startswith("sample_displacement") else np.nan * still
            result.maps[name] = values.assign_attrs(units=units, long_name=text)
        result.maps.attrs |= _sample_attributes(sample, blocks) | {"sample_rigid": "yes"}
    last = results[-1]
    unusual_so_far = json.loads(last.maps.attrs.get("unusual", "[]"))
    last.maps.attrs["unusual"] = json.dumps([*unusual_so_far, *doubts])
    travels = sample.travels
    if travels is not None:
        last.maps.attrs["compression_mm"] = travels[-1]
    if travels is None or len(results) == 1:
        return last
    keep = ("axial_stress", "contact_pressure", "loaded_thickness", "algebraic_axial_stress")
    each = [result.maps[list(keep)].assign_attrs(result.maps.attrs) for result in results]
    return StressResult(
        last.maps,
        last.layer,
        last.problem,
        last.state,
        pixels=last.pixels,
        sensitivities=last.sensitivities,
        series=_series(each, travels),
    )


def _of_load(
    pressed: Pressed,
    band: Band,
    loaded: xr.DataArray,
    algebraic: xr.DataArray,
    surface: ThicknessSurface,
    x: Array,
    y: Array,
) -> xr.Dataset:
    """Maps of one load, with its forces as attributes."""
    stack, state = pressed.stack, pressed.state
    maps = observed_maps(stack, state, x, y).drop_vars(["unloaded_thickness"])
    there = np.meshgrid(x, y)
    computed = maps["loaded_thickness"].values
    off = computed - surface(there[0].ravel(), there[1].ravel()).reshape(computed.shape)
    off[~surface.covers(*there)] = np.nan
    beyond = {"fill_value": "extrapolate"}
    maps["loaded_thickness"] = loaded.interp(x=x, y=y, kwargs=beyond)
    maps["algebraic_axial_stress"] = np.minimum(algebraic.interp(x=x, y=y, kwargs=beyond), 0.0)
    for name in ("loaded_thickness", "algebraic_axial_stress"):
        maps[name].attrs = {"units": "mm" if name == "loaded_thickness" else "kPa"}
    new = {
        "thickness_misfit": off,
        "axial_stress_error": np.where(np.isfinite(computed), band.stress_at(*there), np.nan),
    }
    for name, values in new.items():
        units, text = SAMPLE_MAPS[name]
        maps[name] = (("y", "x"), values, {"units": units, "long_name": text})
    window, interface, plate = stack.total_forces(state)
    sides = window - float(state.forces[WINDOW].sum())
    largest = max(window, interface, plate)
    maps.attrs |= {
        "window_force_mN": window,
        "sample_force_mN": interface,
        "plate_force_mN": plate,
        "force_error_mN": band.force,
        "force_mesh_error_mN": band.force_of_mesh,
        "force_balance": (largest - min(window, interface, plate)) / max(largest, 1e-30),
        "edges": "free",
        **residuals(balance(stack, state), FINAL),
        "sides_force_share": sides / max(window, 1e-30),
    }
    return maps


def _add_stiffness(
    maps: xr.Dataset,
    estimate: Estimate,
    errors: Errors,
    blocks: Blocks,
    columns: Columns,
    near: NDArray[np.bool_],
) -> None:
    """Add the stiffness of the columns that are at the points of the maps, if ``near`` pixels."""
    there = np.meshgrid(maps["x"].values, maps["y"].values)
    moved = [maps[f"sample_displacement_{axis}"].values for axis in "xy"]
    of_column = [points - shift for points, shift in zip(there, moved, strict=True)]
    law, order = blocks.sample_law, estimate.order
    spread = np.sqrt(np.diag(estimate.covariance)[order.of_stiffness])
    unknown = spread.reshape(columns.shape) > _UNKNOWN
    known = columns.at(np.where(unknown, np.nan, 0.0), *of_column) == 0.0
    known &= near & (maps["contact_state"].values > 0)
    known &= np.isfinite(maps["axial_stress"].values)
    modulus = law.shear_modulus * np.exp(columns.at(estimate.sought.stiffness, *of_column))
    modulus = np.where(known, modulus, np.nan)
    new = {
        "sample_shear_modulus": modulus,
        "sample_youngs_modulus": modulus * law.initial_youngs_modulus / law.shear_modulus,
        "sample_modulus_error": np.where(known, columns.at(errors.stiffness, *of_column), np.nan),
    }
    for name, values in new.items():
        units, text = SAMPLE_MAPS[name]
        maps[name] = (("y", "x"), values, {"units": units, "long_name": text})


def _add_relief(
    maps: xr.Dataset,
    relief: Array,
    errors: Errors,
    columns: Columns,
    thickness: float,
    near: NDArray[np.bool_],
) -> None:
    """Add the relief that was found, on unloaded positions ``near`` measured ones."""
    assert errors.relief is not None
    there = np.meshgrid(maps["x"].values, maps["y"].values)
    error = np.clip(columns.surface(errors.relief)(*there), 0.0, None)
    known = near & (error < _UNKNOWN_HEIGHT * thickness)
    height = np.where(known, columns.surface(relief - relief.mean())(*there), np.nan)
    for name, values in (
        ("sample_relief", height),
        ("sample_relief_error", np.where(known, error, np.nan)),
    ):
        units, text = RELIEF_MAPS[name]
        maps[name] = (("y", "x"), values, {"units": units, "long_name": text})


def _series(each: Sequence[xr.Dataset], travels: Sequence[float]) -> xr.Dataset:
    """The maps of all loads, with the dimension ``load``."""
    numbers = np.arange(1, len(each) + 1)
    load = xr.DataArray(numbers, {"load": numbers}, ("load",), attrs={"long_name": "load"})
    series = xr.concat(
        [maps.drop_attrs(deep=False) for maps in each], load, combine_attrs="drop_conflicts"
    )
    for name, text in (
        ("window_force_mN", "total force on the window"),
        ("sample_force_mN", "total force of the sample on the layer"),
        ("force_error_mN", "half the 95 % band of the total force"),
    ):
        if all(name in maps.attrs for maps in each):
            values = [maps.attrs[name] for maps in each]
            attrs = {"units": "mN", "long_name": text}
            series[name.removesuffix("_mN")] = ("load", values, attrs)
    attrs = {"units": "mm", "long_name": "travel of the plate"}
    return series.assign_coords(compression=("load", list(travels), attrs))


def _earlier(loads: Sequence[xr.DataArray]) -> dict[str, list[str]]:
    """The files of the earlier loads and their hashes, where they are from files."""
    known = [loaded for loaded in loads if "source" in loaded.attrs]
    return {
        f"earlier_{key}": [str(loaded.attrs[key]) for loaded in known]
        for key in ("source", "source_sha256")
        if known
    }


def _sample_attributes(sample: Sample, blocks: Blocks) -> dict[str, Any]:
    relief = sample.relief if isinstance(sample.relief, xr.DataArray) else None
    known = "found" if sample.relief_is_sought else "flat" if relief is None else "given"
    return {
        "plate_friction": float(sample.plate_friction),
        "sample_thickness_mm": float(sample.thickness),
        "sample_size_mm": [float(width) for width in blocks.sample_size],
        "sample_relief": known,
        "sample_law": json.dumps(blocks.sample_law.attributes),
        **({"total_force_given_mN": sample.forces[-1]} if sample.forces else {}),
        **{
            f"sample_relief_{key}": value
            for key, value in ({} if relief is None else relief.attrs).items()
            if key in ("source", "source_sha256")
        },
    }


def _of_inversion(
    estimate: Estimate, errors: Errors, measured: Sequence[ThicknessSurface]
) -> dict[str, Any]:
    travels, last = estimate.sought.travels, errors.loads[-1]
    noise = [surface.noise for surface in measured]
    attributes: dict[str, Any] = {"compression_mm": travels[-1]}
    if last.travel is not None:
        attributes["compression_error_mm"] = last.travel
    if len(travels) > 1:
        attributes["compressions_mm"] = list(travels)
    return {
        **attributes,
        "thickness_noise_mm": float(np.sqrt(np.mean(np.square(noise)))),
        "thickness_misfit_mm": float(np.sqrt(np.mean(estimate.misfit[estimate.measured] ** 2))),
        "misfit_over_tolerance": estimate.over_tolerance,
        "regularisation": estimate.alpha,
        "forward_solutions": len(estimate.solutions),
        "inversion": json.dumps(
            [
                {"elements": n, "misfit_over_tolerance": None if np.isnan(q) else round(q, 3)}
                for n, q in estimate.solutions
            ]
        ),
        "error_bands": json.dumps(errors.inputs),
    }
