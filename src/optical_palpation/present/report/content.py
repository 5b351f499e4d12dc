"""What the page shows: its maps with their colour scales, and its figures in words."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present.profiles import on_layer
from optical_palpation.present.report.maps import encode_map, limits

METHODS = {"algebraic": "algebraic_axial_stress", "computational": "axial_stress"}


def methods(result: StressResult) -> dict[str, xr.DataArray]:
    """Axial stress, kPa, by each method that the result has."""
    maps = on_layer(result.maps)
    # The algebraic method alone fills both variables with the same, and has no contact pressure.
    names = METHODS if "contact_pressure" in maps else {"algebraic": "axial_stress"}
    return {method: maps[name] for method, name in names.items()}


def thicknesses(
    result: StressResult, loaded: xr.Dataset | None, unloaded: xr.Dataset | None
) -> dict[str, xr.DataArray]:
    """Thickness, mm, in each state that there is a map of."""
    found = {} if unloaded is None else {"unloaded": unloaded["thickness"]}
    seen = on_layer(result.maps)["loaded_thickness"] if loaded is None else loaded["thickness"]
    return {**found, "loaded": seen}


def map_entries(
    result: StressResult,
    loaded: xr.Dataset | None,
    unloaded: xr.Dataset | None,
    projections: Mapping[str, xr.DataArray],
) -> dict[str, Any]:
    """Maps, masks of filled pixels, colour scales and profiles for the page's data."""
    maps = on_layer(result.maps)
    stress, thickness = methods(result), thicknesses(result, loaded, unloaded)
    shown: dict[str, Any] = {}
    masks: dict[str, Any] = {}
    layers = {"unloaded": unloaded, "loaded": loaded}

    def show(
        group: str,
        key: str,
        title: str,
        scale: str,
        field: xr.DataArray,
        mask: str | None = None,
        digits: int = 4,
    ) -> None:
        about = {"group": group, "title": title, "scale": scale, "mask": mask}
        shown[key] = about | encode_map(field, digits)

    for state, layer in layers.items():
        if layer is not None and "filled" in layer:
            masks[state] = encode_map(layer["filled"])
    if "filled" in maps:
        masks["result"] = encode_map(maps["filled"].fillna(0).astype(bool))
    of_stress = "result" if "result" in masks else "loaded"

    for method, field in stress.items():
        show("stress", method, f"{method.title()} stress", "stress", field, of_stress)
    sides = {"contact_state": "sample", "window_contact_state": "window"}
    for name, side in sides.items():
        if name in maps:
            show("stress", name, f"Contact with the {side}", "contact", maps[name])
    for state, field in thickness.items():
        mask = of_stress if layers[state] is None else state
        show("layer", f"{state}-thickness", f"{state.title()} thickness", "thickness", field, mask)
    for state, layer in layers.items():
        if layer is not None and "quality" in layer:
            title = f"{state.title()} quality"
            show("layer", f"{state}-quality", title, "quality", layer["quality"], state, digits=2)
    for state, field in projections.items():
        title = f"Max. intensity, {state}"
        show("layer", f"{state}-projection", title, f"{state} signal", field, digits=2)

    scales = {
        "stress": _scale("viridis_r", "kPa", *limits(*stress.values())),
        "thickness": _scale("cividis", "mm", *limits(*thickness.values())),
        "quality": _scale("cividis", "", 0.0, 1.0),
        **{
            f"{state} signal": _scale("gray", "dB", *limits(field))
            for state, field in projections.items()
        },
    }
    return {
        "maps": shown,
        "masks": masks,
        "scales": scales,
        "colours": {s["colours"]: _colours(s["colours"]) for s in scales.values()},
        "profiles": {
            "stress": {
                "label": "axial stress (kPa)",
                "range": limits(*stress.values(), share=0.1),
                "maps": list(stress),
            },
            "layer": {
                "label": "thickness (mm)",
                "range": limits(*thickness.values(), share=0.1),
                "maps": [f"{state}-thickness" for state in thickness],
            },
        },
        "states": {int(s): s.name.lower() for s in ContactState},
    }


def _scale(colours: str, units: str, low: float, high: float) -> dict[str, Any]:
    return {"colours": colours, "units": units, "low": low, "high": high}


def _colours(name: str) -> str:
    """256 colours as hexadecimal digits."""
    from matplotlib import colormaps

    return (colormaps[name](np.arange(256), bytes=True)[:, :3]).tobytes().hex()


def force_rows(result: StressResult) -> list[tuple[str, str]]:
    """Total forces and how well they balance."""
    attrs = result.maps.attrs
    rows = [
        (f"Force on the {side}", f"{_number(attrs[key])} mN")
        for side in ("window", "sample")
        if (key := f"{side}_force_mN") in attrs
    ]
    if "force_balance" in attrs:
        off = 100 * attrs["force_balance"]
        rows.append(("Difference of the two", f"{off:.2g} %" if off > 1e-3 else "below 0.001 %"))
    for method, stress in methods(result).items():
        force = -float(stress.fillna(0.0).integrate(["y", "x"]))
        rows.append((f"Integral of the {method} map", f"{_number(force)} mN"))
    return rows


def stress_rows(result: StressResult) -> list[tuple[str, ...]]:
    """Name and value by each method of the mean, the 1st percentile and the lowest stress."""
    fields = [field.values[np.isfinite(field.values)] for field in methods(result).values()]
    return [
        ("Mean", *(_number(v.mean()) if v.size else "" for v in fields)),
        ("1st percentile", *(_number(np.percentile(v, 1)) if v.size else "" for v in fields)),
        ("Most compressed", *(_number(v.min()) if v.size else "" for v in fields)),
    ]


def key_figures(
    result: StressResult, loaded: xr.Dataset | None, unloaded: xr.Dataset | None
) -> list[tuple[str, str]]:
    """The numbers that a reader wants first."""
    attrs, maps = result.maps.attrs, on_layer(result.maps)
    figures = []
    if "sample_force_mN" in attrs:
        figures.append(("Force on the sample", f"{_number(attrs['sample_force_mN'])} mN"))
    for method, stress in methods(result).items():
        figures.append((f"Mean stress, {method}", f"{_number(float(stress.mean()))} kPa"))
    touching = float(np.mean(maps["contact_state"].values != ContactState.OPEN))
    figures.append(("In contact with the sample", _percent(touching)))
    thickness = thicknesses(result, loaded, unloaded)
    if "unloaded" not in thickness and "initial_thickness_mm" in attrs:
        given = _number(attrs["initial_thickness_mm"])
        figures.append(("Unloaded thickness, mean", f"{given} mm"))
    for state, field in thickness.items():
        figures.append((f"{state.title()} thickness, median", f"{_number(field.median())} mm"))
    for state, layer in (("unloaded", unloaded), ("loaded", loaded)):
        if layer is not None and "filled" in layer:
            figures.append((f"Filled pixels, {state}", _percent(float(layer["filled"].mean()))))
    return figures


def _number(value: Any) -> str:
    """Four digits, with the minus of print."""
    return f"{float(value):.4g}".replace("-", "\N{MINUS SIGN}")


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


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
    """Parameters as text; a mapping within becomes a section, one within that dotted names."""
    plain: list[tuple[str, str]] = []
    sections = [("", plain)]
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            sections.append((str(name), _flat(value)))
        else:
            plain.append((str(name), _text(value)))
    return [section for section in sections if section[1]]


def _flat(parameters: Mapping[str, object], prefix: str = "") -> list[tuple[str, str]]:
    rows = []
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", _text(value)))
    return rows


def _text(value: object) -> str:
    if value is None:
        return "not given"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.10g}"
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return ", ".join(_text(v) for v in value)
    return str(value)
