"""What the page shows: its maps with their colour scales, and its figures in words."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.analysis import Region, compare_results, region_statistics, traced
from optical_palpation.analysis.maps import area_mean, at_points_of, map_error, on_layer
from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present.figure import colour_map
from optical_palpation.present.report.maps import encode_map, encode_maps
from optical_palpation.present.summary import (
    INPUTS,
    edge_influence,
    equilibrium,
    force_error,
    has_bands,
    input_errors,
    mean_error,
    mesh_error,
    methods,
    of_relief,
    of_series,
    of_submodel,
    stress_error,
    stress_figures,
    touching_share,
    within_map,
    without_inputs,
)
from optical_palpation.present.tables import region_figure
from optical_palpation.present.terms import (
    DIFFERENCE,
    ERROR,
    LENGTH,
    QUALITY,
    STRESS,
    as_given,
    common_limits,
    in_percent,
    is_map,
    percent,
    rounded,
    term,
)


def thicknesses(
    result: StressResult, loaded: xr.Dataset | None, unloaded: xr.Dataset | None
) -> dict[str, xr.DataArray]:
    """Thickness, mm, in each state that there is a map of."""
    found = {} if unloaded is None else {"unloaded": unloaded["thickness"]}
    own = on_layer(result.maps if result.pixels is None else result.pixels)
    seen = own["loaded_thickness"] if loaded is None else loaded["thickness"]
    return {**found, "loaded": seen}


def comparisons(result: StressResult, others: Mapping[str, StressResult]) -> dict[str, xr.Dataset]:
    """What :func:`compare_results` finds of each other result against this one, by name."""
    return {
        name: compare_results({"this": result.maps, "other": other.maps})
        for name, other in others.items()
    }


def map_entries(
    result: StressResult,
    loaded: xr.Dataset | None,
    unloaded: xr.Dataset | None,
    projections: Mapping[str, xr.DataArray],
    compared: Mapping[str, xr.Dataset],
    regions: Sequence[Region],
) -> dict[str, Any]:
    """Maps, masks of interpolated pixels, colour scales and profiles for the page's data."""
    maps = in_percent(on_layer(result.maps))
    stress, thickness = methods(result), thicknesses(result, loaded, unloaded)
    shown: dict[str, dict[str, Any]] = {}
    fields: dict[str, tuple[xr.DataArray, int]] = {}
    scales: dict[str, dict[str, Any]] = {}
    members: dict[str, dict[str, xr.DataArray]] = {}
    layers = {"unloaded": unloaded, "loaded": loaded}

    def show(
        key: str,
        title: str,
        scale: str,
        field: xr.DataArray,
        *,
        group: str | None = None,
        mask: str | None = None,
        digits: int = 4,
        force: float = 0.0,
    ) -> None:
        if is_uniform(field):
            group = None
        about = {"group": group, "title": title, "scale": scale, "mask": mask, "force": force}
        shown[key], fields[key] = about, (field, digits)
        if scale != "contact":
            members.setdefault(scale, {})[key] = field

    masks: dict[str, Any] = {}
    for state, layer in layers.items():
        if layer is not None and "filled" in layer:
            masks[state] = encode_map(layer["filled"])
    if "filled" in maps:
        masks["result"] = encode_map(maps["filled"].fillna(0).astype(bool))
    of_stress = "result" if "result" in masks else "loaded"

    names = {"computational": "axial_stress", "algebraic": "algebraic_axial_stress"}
    for method in sorted(stress, reverse=True):
        title, field = f"{method.title()} stress", stress[method]
        measured = method == "algebraic" and "loaded" in masks
        mask = "loaded" if measured else of_stress
        show(method, title, "stress", field, group="stress", mask=mask, force=-1.0)
    scales["stress"] = {"colours": STRESS, "units": "kPa"}
    for number, (name, found) in enumerate(compared.items()):
        other = found[found.attrs["variable"]].isel(result=1)
        show(f"other-{number}", f"{name}: stress", "stress", other, group="stress", force=-1.0)
        show(
            f"difference-{number}",
            f"{name} less this",
            "difference",
            found["difference"].isel(compared=0),
            group="stress",
        )
        scales["difference"] = {"colours": DIFFERENCE, "units": "kPa"}
        if "difference_error" in found:
            error = found["difference_error"].isel(compared=0)
            show(f"difference-{number}-error", f"Error of {name} less this", "error", error)
            scales["error"] = {"colours": ERROR, "units": "kPa"}
    for name, side in {"contact_state": "sample", "window_contact_state": "window"}.items():
        if name in maps:
            show(name, f"Contact with the {side}", "contact", maps[name], group="stress")
    known = {*names.values(), "contact_state", "window_contact_state", "loaded_thickness", "filled"}
    for variable, field in maps.data_vars.items():
        if str(variable) in known | {"quality"} or not is_map(field):
            continue
        what = term(maps, str(variable))
        if not what.has_limits or not field.notnull().any():
            continue
        group = "stress" if variable == "sample_youngs_modulus" else None
        force = 1.0 if variable == "contact_pressure" else 0.0
        show(
            str(variable),
            what.words,
            what.scale,
            field,
            group=group,
            mask=of_stress,
            digits=3,
            force=force,
        )
        scales.setdefault(what.scale, {"colours": what.colours, "units": what.units})
    # the page's own numbers have the errors of those of the library
    of_method = {method: f"{name}_error" for method, name in names.items()}
    both = map_error(maps, "axial_stress")
    if both is not None and "axial_stress_mesh_error" in shown:
        of_method["computational"] = "computational-error"
        title = "Error of the axial stress, inputs and mesh"
        show("computational-error", title, "error", both, mask=of_stress, digits=3)
    for state, field in thickness.items():
        mask = of_stress if layers[state] is None else state
        title = f"{state.title()} thickness"
        show(f"{state}-thickness", title, "thickness", field, group="layer", mask=mask)
        scales["thickness"] = {"colours": LENGTH, "units": "mm"}
    for state, layer in layers.items():
        if layer is not None and "quality" in layer:
            title, field = f"{state.title()} quality", layer["quality"]
            show(f"{state}-quality", title, "quality", field, group="layer", mask=state, digits=2)
            scales["quality"] = {"colours": QUALITY, "units": "", "low": 0.0, "high": 1.0}
    for state, field in projections.items():
        title, scale = f"Max. intensity, {state}", f"{state} signal"
        show(f"{state}-projection", title, scale, field, group="layer", digits=2)
        scales[scale] = {"colours": "gray", "units": "dB"}

    for name, entry in shown.items():
        own = of_method.get(name, f"{name}_error")
        if name.startswith("difference-"):
            own = f"{name}-error"
        elif name in ("sample_shear_modulus", "sample_youngs_modulus"):
            own = "sample_modulus_error"
        if own in shown:  # that of moduli is a share of them
            entry |= {"error": own, "relative": own == "sample_modulus_error"}
    for name, entry in scales.items():
        if "low" not in entry:
            entry["low"], entry["high"] = common_limits(members[name], entry["colours"])
        entry["start"] = {key: entry[key] for key in ("low", "high", "colours")}
    for key, entry in encode_maps(fields).items():
        shown[key] |= entry
    palettes = dict.fromkeys([*_PALETTES, *(scale["colours"] for scale in scales.values())])
    glued = any((field == ContactState.GLUED).any() for field, _ in fields.values())
    states = [s for s in ContactState if glued or s is not ContactState.GLUED]
    return {
        "maps": shown,
        "stage": list(shown),
        "masks": masks,
        "scales": scales,
        "colours": {name: _colours(name) for name in palettes},
        "regions": [
            {"name": r.name, "outlines": [np.round(o, 5).tolist() for o in _outlines(r)]}
            for r in regions
        ],
        "profiles": {
            "stress": {
                "label": "axial stress (kPa)",
                "range": _profile_range(maps, stress, names),
                "maps": sorted(stress),
                "errors": {
                    method: of_method[method] for method in stress if of_method[method] in shown
                },
            },
            "layer": {
                "label": "thickness (mm)",
                "range": common_limits(thickness, "", share=0.1),
                "maps": [f"{state}-thickness" for state in thickness],
                "errors": {},
            },
        },
        "states": {int(s): s.name.lower() for s in states},
    }


def _outlines(region: Region) -> list[NDArray[np.float64]]:
    """Closed polygons of x and y in mm, the longest first; of a mask, along the edges of pixels."""
    return sorted(
        traced(region).outlines, key=lambda at: -np.abs(np.diff(at, axis=0, append=at[:1])).sum()
    )


def _profile_range(
    maps: xr.Dataset, stress: Mapping[str, xr.DataArray], names: Mapping[str, str]
) -> tuple[float, float]:
    """Range of the profiles of stress: with their error bands, unless these dwarf the stress."""
    low, high = common_limits(stress, "", share=0.1)
    ends = dict(stress)
    for method, field in stress.items():
        if (error := map_error(maps, names[method])) is not None:
            error = at_points_of(error, field)
            ends |= {f"{method}, low": field - error, f"{method}, high": field + error}
    lowest, highest = common_limits(ends, "", share=0.1)
    return max(lowest, 2 * low - high), min(highest, 2 * high - low)


def is_uniform(field: xr.DataArray) -> bool:
    """Whether a map says the same everywhere; such a one is told in words."""
    values = field.values.astype(float)
    values = values[np.isfinite(values)]
    return bool(values.size) and bool(np.ptp(values) <= 1e-9 * abs(values).max())


def uniform_maps(shown: Mapping[str, Mapping[str, Any]], result: StressResult) -> list[str]:
    """Say in words what maps show that are the same everywhere."""
    maps = on_layer(result.maps)
    said = []
    for name, side in (("contact_state", "sample"), ("window_contact_state", "window")):
        if name in shown and name in maps and is_uniform(maps[name]):
            state = ContactState(int(maps[name].values.flat[0])).name.lower()
            said.append(f"contact with the {side}: {state} everywhere")
    for name, entry in shown.items():
        if entry["group"] is None and name in ("unloaded-thickness", "loaded-thickness"):
            said.append(f"{entry['title'].lower()}: the same everywhere")
        if entry["scale"] == "difference" and entry["group"] is None:
            said.append(f"{entry['title']}: the same everywhere")
    return said


_PALETTES = ("viridis", "viridis_r", "cividis", "magma", "gray", "vik")


def _colours(name: str) -> str:
    """256 colours as hexadecimal digits."""
    return (colour_map(name)(np.arange(256), bytes=True)[:, :3]).tobytes().hex()


def region_rows(
    result: StressResult, regions: Sequence[Region]
) -> tuple[list[str], list[tuple[str, ...]]]:
    """Headings and rows of a table of regions of interest."""
    if not regions:
        return [], []
    found = region_statistics(result.maps, regions)
    columns = [
        str(name)
        for name in found.data_vars
        if not str(name).endswith("_error") and not (name == "missing" and not found[name].any())
    ]
    headings = ["Region"]
    for name in columns:
        units = found[name].attrs.get("units", "1")
        words = _HEADINGS[name] + " \N{PLUS-MINUS SIGN} error" * (f"{name}_error" in found)
        units = {"1": "", "mm2": "mm\N{SUPERSCRIPT TWO}"}.get(units, units)
        headings.append(words + (f" ({units})" if units else ""))
    rows = []
    for k, region in enumerate(found["region"].values):
        row = found.isel(region=k)
        rows.append((str(region), *(region_figure(row, name) for name in columns)))
    return headings, rows


# Words of the table of regions, short enough for a phone.
_HEADINGS = {
    "mean": "Mean",
    "standard_deviation": "s.d.",
    "minimum": "Lowest",
    "maximum": "Highest",
    "force": "Force",
    "area": "Area",
    "missing": "No value",
    "difference": "Less background",
    "contrast": "Contrast",
}


def comparison_rows(
    result: StressResult,
    others: Mapping[str, StressResult],
    compared: Mapping[str, xr.Dataset],
) -> list[tuple[str, ...]]:
    """Rows of a table of other results: differences of the stress, error of these, forces."""

    def force(one: StressResult) -> str:
        attrs = one.maps.attrs
        if "sample_force_mN" not in attrs:  # the algebraic method has none
            return ""
        return rounded(attrs["sample_force_mN"], force_error(attrs))

    rows: list[tuple[str, ...]] = [("this", "", "", "", "", "", force(result))] if others else []
    for name, other in others.items():
        found = compared[name].isel(compared=0)
        whole = found.sel(zone="all")
        error, within = "", ""
        if "difference_error" in found:
            error = rounded(np.sqrt((found["difference_error"] ** 2).mean()), digits=2)
            within = percent(found["within_error"])
        rows.append(
            (
                name,
                rounded(whole["bias"]),
                rounded(whole["rms"]),
                percent(whole["relative_rms"]),
                error,
                within,
                force(other),
            )
        )
    return rows


def force_rows(result: StressResult) -> list[tuple[str, str]]:
    """Total forces and how well they balance."""
    attrs, maps = result.maps.attrs, on_layer(result.maps)
    rows = [
        (f"Force on the {side}", f"{rounded(attrs[key], force_error(attrs))} mN")
        for side in ("window", "sample")
        if (key := f"{side}_force_mN") in attrs
    ]
    if "total_force_given_mN" in attrs:
        rows.append(("Given", f"{attrs['total_force_given_mN']:g} mN"))
    if "submodel_region_mm" in attrs:
        rows += [("Part of a layer", text) for text in of_submodel(attrs)]
    elif within := within_map(attrs):
        rows.append(("Within the map", within))
    if result.series is not None:
        rows.append(("Travel of the plate and force at each load", of_series(result.series)))
    if "force_balance" in attrs:
        rows.append(("Difference of the two", percent(attrs["force_balance"])))
    if "force_mesh_error_mN" in attrs:
        rows.append(("Error of the mesh, estimated", mesh_error(attrs)))
    if of_inputs := input_errors(attrs):
        rows.append(("Error from the inputs", of_inputs))
    if "force_residual" in attrs:
        rows.append(("Equilibrium", equilibrium(attrs)))
    if sides := edge_influence(attrs, always=True):
        rows.append(("Sides of the layer", sides))
    for method, stress in methods(result).items():
        force = -float(stress.fillna(0.0).integrate(["y", "x"]))
        error = stress_error(method, maps)
        of_force = None if error is None else error.fillna(0.0).integrate(["y", "x"])
        rows.append((f"Integral of the {method} map", f"{rounded(force, of_force)} mN"))
    return rows


def stress_rows(result: StressResult) -> list[tuple[str, ...]]:
    """Name and value by each method of the mean, the 1st percentile and the lowest stress."""
    columns = [stress_figures(result, method) for method in methods(result)]
    names = ("Mean", "1st percentile", "Most compressed")
    return list(zip(names, *columns, strict=True))


def key_figures(
    result: StressResult, loaded: xr.Dataset | None, unloaded: xr.Dataset | None
) -> list[tuple[str, str]]:
    """The numbers that a reader wants first."""
    attrs, maps = result.maps.attrs, on_layer(result.maps)
    figures = []
    bands = has_bands(attrs)
    if "sample_force_mN" in attrs:
        force = rounded(attrs["sample_force_mN"], force_error(attrs))
        alone = f", ± by the {of} alone" if (of := without_inputs(attrs)) else ""
        figures.append((f"Force on the sample{', 95 % band' * bands}{alone}", f"{force} mN"))
    for method, stress in methods(result).items():
        mean = rounded(area_mean(stress), mean_error(method, maps))
        figures.append((f"Mean stress, {method}", f"{mean} kPa"))
    figures += _sample_figures(maps)
    if "contact_state" in maps:  # the algebraic method computes none
        figures.append(("In contact with the sample", percent(touching_share(maps))))
    thickness = thicknesses(result, loaded, unloaded)
    errors = _thickness_errors(attrs)
    if "unloaded" not in thickness and "initial_thickness_mm" in attrs:
        mean, error = attrs["initial_thickness_mm"], errors.get("unloaded")
        given = rounded(mean, error) if error else as_given(mean)
        figures.append(("Unloaded thickness, mean", f"{given} mm"))
    for state, field in thickness.items():
        middle = rounded(_within(field, maps).median(), errors.get(state))
        figures.append((f"{state.title()} thickness, median", f"{middle} mm"))
    for state, layer, key in (
        ("unloaded", unloaded, "initial_filled_share"),
        ("loaded", loaded, "filled_share"),
    ):
        if layer is not None and "filled" in layer:
            fraction = attrs.get(key, float(_within(layer["filled"], maps).mean()))
            if fraction:
                figures.append((f"Interpolated pixels, {state}", percent(fraction)))
    return figures


def _within(field: xr.DataArray, maps: xr.Dataset) -> xr.DataArray:
    """The part of a field of the whole image that maps of the layer cover."""
    for axis in "yx":
        low, high = float(maps[axis].min()), float(maps[axis].max())
        slack = 1e-6 * (high - low)
        field = field.sel({axis: (field[axis] >= low - slack) & (field[axis] <= high + slack)})
    return field


def _thickness_errors(attrs: Mapping[Any, Any]) -> dict[str, float]:
    """Errors of both thicknesses, mm, that the error bands rest on; empty where there are none."""
    try:
        given = json.loads(attrs.get("input_errors", "{}"))
        bands = json.loads(attrs.get("error_bands", "{}"))  # of a sample in the model
        given |= {name: band["half_width"] for name, band in bands.items()}
        names = {"unloaded": "initial_thickness", "loaded": "thickness"}
        return {state: float(given[name]) for state, name in names.items() if name in given}
    except (TypeError, KeyError, ValueError, AttributeError):  # a result that other software wrote
        return {}


def _sample_figures(maps: xr.Dataset) -> list[tuple[str, str]]:
    """What was found of the sample, and how well it explains the thickness."""
    attrs, figures = maps.attrs, []
    if "sample_rigid" in attrs:
        figures.append(("Sample", "as good as rigid; its stiffness cannot be told"))
    if "sample_youngs_modulus" in maps and maps["sample_youngs_modulus"].notnull().any():
        modulus = float(maps["sample_youngs_modulus"].median())
        error = modulus * float(maps["sample_modulus_error"].median())
        title = "Young's modulus of the sample, median"
        figures.append((title, f"{rounded(modulus, error)} kPa"))
        known = float(maps["sample_youngs_modulus"].notnull().mean())
        figures.append(("Modulus known", percent(known)))
    if "sample_relief" in maps and maps["sample_relief"].notnull().any():
        figures.append(("Relief of the sample, found", of_relief(maps)))
    if "compression_error_mm" in attrs:
        found = rounded(attrs["compression_mm"], attrs["compression_error_mm"])
        figures.append(("Travel of the plate, found", f"{found} mm"))
    if "misfit_over_tolerance" in attrs:
        off = 1e3 * attrs["thickness_misfit_mm"]
        figures.append(("Misfit of the thickness", f"{off:.2g} \N{MICRO SIGN}m"))
        times = f"{attrs['misfit_over_tolerance']:.2g}"
        figures.append(("Misfit over noise and mesh error", times))
    if "forward_solutions" in attrs:
        figures.append(("Forward solutions", str(int(attrs["forward_solutions"]))))
    return figures


def band_rows(result: StressResult) -> list[tuple[str, str, str, str]]:
    """What the error bands are made of: input, its error, change of force and mean stress."""
    try:
        bands = json.loads(result.maps.attrs.get("error_bands", "{}"))
        rows = []
        for name, entry in bands.items():
            error = float(entry["half_width"])
            changes = [
                "unknown" if entry[key] is None else f"{rounded(entry[key], digits=2)} {units}"
                for key, units in (("force_mN", "mN"), ("mean_stress_kPa", "kPa"))
            ]
            text = percent(error)
            if name.endswith("friction"):
                text = as_given(error)
            elif name in ("thickness", "initial_thickness"):
                text = f"{as_given(1e3 * error)} \N{MICRO SIGN}m"
            text = f"\N{PLUS-MINUS SIGN}{text}"
            rows.append((INPUTS.get(name, name), text, *changes))
        return rows
    except (TypeError, ValueError, KeyError, AttributeError):  # written by other software
        return []


def solution_rows(result: StressResult) -> list[tuple[str, str]]:
    """Forward solutions of an inversion: elements, and misfit over what noise and mesh explain."""
    try:
        solutions = json.loads(result.maps.attrs.get("inversion", "[]"))
        return [
            (
                f"{int(step['elements']):,}",
                "for the sensitivities alone"
                if step["misfit_over_tolerance"] is None
                else f"{float(step['misfit_over_tolerance']):.3g}",
            )
            for step in solutions
        ]
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError):
        return []


def convergence_rows(result: StressResult) -> list[dict[str, float]]:
    """Steps of the solution: elements, share of the load reached, Newton iterations."""
    kinds = {"elements": int, "load": float, "newton": int}
    try:
        steps = json.loads(result.maps.attrs.get("convergence", "[]"))
        rows = [{name: kind(step[name]) for name, kind in kinds.items()} for step in steps]
        json.dumps(rows, allow_nan=False)
        return rows
    except (TypeError, ValueError, KeyError, OverflowError):  # a result that other software wrote
        return []


def parameter_sections(parameters: Mapping[str, object]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Parameters as text with units; a mapping within becomes a section, in it dotted names."""
    single: list[tuple[str, str]] = []
    sections = [("", single)]
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            sections.append((str(name), _flat(value, str(name))))
        else:
            single.append(_row(str(name), value, ""))
    return [section for section in sections if section[1]]


def _flat(
    parameters: Mapping[str, object], section: str, prefix: str = ""
) -> list[tuple[str, str]]:
    rows = []
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            rows += _flat(value, section, f"{prefix}{name}.")
        else:
            rows.append(_row(f"{prefix}{name}", value, section))
    return rows


def _row(name: str, value: object, section: str) -> tuple[str, str]:
    """A parameter's name without the unit that it ends in, and its value with it."""
    text = _text(value)
    unit = ""
    for ending, written in _ENDINGS.items():
        if name.endswith(ending):
            name, unit = name.removesuffix(ending), written
    last = name.split(".")[-1]
    if not unit and f"{section}.{name}".split(".")[-2] in ("spacing", "origin"):
        unit = "mm"
    if not unit and _is_numeric(value):
        unit = _UNITS.get(last, "")
        if section == "friction" or "friction" in last:
            unit = "(coefficient)"
        if section in _OF_SECTION:
            unit = _OF_SECTION[section].get(last, unit)
    return name, f"{text} {unit}" if unit and text != "not given" else text


# Units that names of attributes end in, and those of the parameters of a study.
_ENDINGS = {
    "_mm": "mm",
    "_kPa": "kPa",
    "_mN": "mN",
    "_percent": "%",
    "_mm2": "mm\N{SUPERSCRIPT TWO}",
}
_UNITS = {
    **dict.fromkeys(("c10", "c01", "c20", "c30"), "kPa"),
    **dict.fromkeys(("bulk_to_shear", "refractive_index"), "(ratio)"),
    **dict.fromkeys(("modulus", "accuracy"), "(fraction)"),
    **dict.fromkeys(
        (
            "thickness",
            "initial_thickness",
            "slip_length",
            "element_size",
            "extent",
            "imprint_smoothing",
            "field_of_view",
            "pixel_spacing",
            "window_range",
            "sample_range",
            "layer_extent",
        ),
        "mm",
    ),
}


_OF_SECTION = {
    "sample": {"motion": "(strain)", "compression": "mm", "size": "mm", "total_force": "mN"},
    "errors": dict.fromkeys(("compression", "sample_thickness", "total_force"), "(fraction)"),
}


def _is_numeric(value: object) -> bool:
    if isinstance(value, bool | str) or value is None:
        return False
    if isinstance(value, Sequence):
        return all(_is_numeric(v) for v in value) and len(value) > 0
    return isinstance(value, int | float | np.number | np.ndarray)


def _text(value: object) -> str:
    if value is None:
        return "not given"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.7g}"
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return ", ".join(_text(v) for v in value)
    return str(value)
