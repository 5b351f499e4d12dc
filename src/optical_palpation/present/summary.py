"""A result in a few lines of words."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import area_mean, at_points_of, map_error, on_layer
from optical_palpation.palpation.edges import NOTABLE
from optical_palpation.palpation.plausibility import SOFT_SAMPLE
from optical_palpation.palpation.result import ContactState, Status, StressResult
from optical_palpation.present.terms import percent, plain, rounded

# Percent; an incompressible layer that is free to spread stays far below.
_NOTABLE_VOLUME_CHANGE = 1.0
# Share of the total force that sides carry which roll onto window or sample.
_NOTABLE_SIDES = 0.001
# Share of the force that acts where the layer reaches beyond the map.
_NOTABLE_BEYOND = 0.02
#: Fraction of the map on which sides of the layer may matter before it is worth a word.
NOTABLE_FRACTION = 0.01
# Share of the map; more gaps than this say that something is wrong with it.
_NOTABLE_FILLED = 0.2


def equilibrium(attrs: Mapping[Hashable, Any]) -> str:
    """Say how near to equilibrium a result is, and what its free sides carry."""
    text = (
        f"{attrs['status']}, residual {attrs['force_residual']:.0e} of the contact "
        f"forces (tolerance {attrs['force_tolerance']:.0e}), smallest volume ratio "
        f"{attrs['smallest_volume_ratio']:.2f}"
    )
    if attrs["sides_force_share"] > _NOTABLE_SIDES:
        text += f", sides carry {percent(attrs['sides_force_share'])} of the force"
    return text


def edge_influence(attrs: Mapping[Hashable, Any], always: bool = False) -> str:
    """Say how much the sides of the layer matter; "" where that is not known to be notable.

    With `always`, also where it is not notable.
    """
    if unknown := attrs.get("edge_influence_unknown"):
        return f"unknown ({unknown})"
    if "edge_influence_fraction" not in attrs:
        return ""
    fraction, force = attrs["edge_influence_fraction"], attrs["edge_influence_force"]
    if not always and fraction < NOTABLE_FRACTION and abs(force) < NOTABLE:
        return ""
    given = f"taken as {attrs['edges']}; " if "edges" in attrs else ""
    where = "everywhere" if fraction == 1.0 else f"on {percent(fraction)} of the map"
    change = "rise" if force > 0 else "fall"
    return (
        f"{given}were they {attrs['edge_influence_other']}, the pressure would change by more than "
        f"{percent(NOTABLE)} {where}, and the force {change} by {percent(abs(force))}"
    )


def of_sides(attrs: Mapping[Hashable, Any]) -> list[str]:
    """Say what sides of the layer that matter ask of the user; nothing where they do not."""
    sides = edge_influence(attrs)
    return [
        f"sides of the layer: {sides}. See to it that the layer ends where it is said to, at the "
        "border of the map or of the extent that was given, and has such edges"
    ] * bool(sides)


def has_bands(attrs: Mapping[Hashable, Any]) -> bool:
    """Whether the errors of a result are 95 % bands, which contain those of the mesh."""
    return "error_bands" in attrs


def of_unknown_sample(maps: xr.Dataset) -> str:
    """Say what a result does not know that has no sample in the model, nor its motion; else ""."""
    known = "sample_shear_modulus" in maps or "sample_motion_largest_mm" in maps.attrs
    return "" if known or "sample_force_mN" not in maps.attrs else SOFT_SAMPLE


def force_error(attrs: Mapping[Hashable, Any]) -> float | None:
    """Error of the total force, mN, of inputs and mesh together; None where neither is known."""
    if has_bands(attrs):
        return float(attrs["force_error_mN"])
    known = [float(attrs[k]) for k in ("force_error_mN", "force_mesh_error_mN") if k in attrs]
    return float(np.hypot.reduce(known)) if known else None


def without_inputs(attrs: Mapping[Hashable, Any]) -> str:
    """Say of what alone the known error is, where it leaves the inputs out; else ""."""
    if has_bands(attrs):
        return "" if json.loads(attrs["error_bands"]) else "noise and mesh"
    return "mesh" if force_error(attrs) is not None and "force_error_mN" not in attrs else ""


def mean_stress(maps: xr.Dataset, name: str = "axial_stress") -> float:
    """Mean of the axial stress, or its error, over the area of the layer, kPa."""
    return area_mean(on_layer(maps)[name])


def touching_share(maps: xr.Dataset) -> float:
    """Share of the layer's area that is in contact with the sample."""
    return 1.0 - contact_share(maps, ContactState.OPEN)


def contact_share(maps: xr.Dataset, state: ContactState) -> float:
    """Share of the layer's area that is in a state of contact with the sample."""
    return area_mean(on_layer(maps)["contact_state"] == state)


def mean_stress_error(maps: xr.Dataset) -> float | None:
    """Error of the mean axial stress, kPa, of inputs and mesh together; None where unknown."""
    attrs = maps.attrs
    name = "axial_stress_error"
    errors = [mean_stress(maps, name)] if name in maps else []
    if not has_bands(attrs) and attrs.get("sample_force_mN") and "force_mesh_error_mN" in attrs:
        share = attrs["force_mesh_error_mN"] / attrs["sample_force_mN"]
        errors.append(share * mean_stress(maps))
    return float(np.hypot.reduce(np.nan_to_num(errors))) if errors else None


METHODS = {"algebraic": "algebraic_axial_stress", "computational": "axial_stress"}


def methods_in(maps: xr.Dataset) -> dict[str, str]:
    """Name of the axial stress by each method that the maps hold."""
    # The algebraic method alone fills both variables with the same, and has no contact pressure.
    if "contact_pressure" not in maps:
        return {"algebraic": "axial_stress"}
    return {method: name for method, name in METHODS.items() if name in maps}


def methods(result: StressResult) -> dict[str, xr.DataArray]:
    """Axial stress, kPa, by each method that the result has; the algebraic one of each pixel."""
    maps = on_layer(result.maps)
    fields = {method: maps[name] for method, name in methods_in(maps).items()}
    if result.pixels is not None and len(fields) > 1:
        fields["algebraic"] = on_layer(result.pixels)[METHODS["algebraic"]]
    return fields


def stress_error(method: str, maps: xr.Dataset) -> xr.DataArray | None:
    """Error of the axial stress by a method, kPa, of inputs and mesh, where it is known."""
    if (error := map_error(maps, METHODS[method])) is not None:
        return error
    alone = "contact_pressure" not in maps  # the algebraic method, whose stress is *the* stress
    return maps.get("axial_stress_error") if alone else None


def mean_error(method: str, maps: xr.Dataset) -> float | None:
    """Error of the mean axial stress by a method, kPa."""
    if method == "computational":
        return mean_stress_error(maps)
    error = stress_error(method, maps)
    return None if error is None else area_mean(error)


def stress_figures(result: StressResult, method: str) -> tuple[str, str, str]:
    """Mean, 1st percentile and lowest axial stress by a method, kPa, to their errors."""
    maps, field = on_layer(result.maps), methods(result)[method]
    values = field.values[np.isfinite(field.values)]
    if not values.size:
        return "unknown", "unknown", "unknown"
    error = stress_error(method, maps)
    error = None if error is None else at_points_of(error, field)

    def at(value: float) -> str:
        place = np.nanargmin(abs(field.values - value))
        return rounded(value, None if error is None else error.values.flat[place])

    first, lowest = at(np.percentile(values, 1)), at(values.min())
    return rounded(area_mean(field), mean_error(method, maps)), first, lowest


def mesh_error(attrs: Mapping[Hashable, Any]) -> str:
    """Say by how much the mesh may be off, in the total force."""
    error, force = attrs["force_mesh_error_mN"], attrs["sample_force_mN"]
    said = f"{rounded(error, digits=2)} mN"
    return f"{said} ({percent(error / abs(force))})" if force else said


#: Inputs in words.
INPUTS = {
    "window_friction": "friction at the window",
    "sample_friction": "friction at the sample",
    "modulus": "stiffness of the layer",
    "thickness": "loaded thickness",
    "thickness_noise": "noise of the loaded thickness",
    "initial_thickness": "unloaded thickness",
    "plate_friction": "friction at the plate",
    "compression": "travel of the plate",
    "sample_thickness": "thickness of the sample",
    "total_force": "total force",
}


def input_errors(attrs: Mapping[Hashable, Any]) -> str:
    """Say what errors of the inputs do to the total force; "" where that was not asked for."""
    if unknown := attrs.get("input_errors_unknown"):
        return f"unknown ({unknown})"
    if "force_error_mN" not in attrs or "input_errors" not in attrs:
        return ""
    error, force = attrs["force_error_mN"], attrs["sample_force_mN"]
    given = json.loads(attrs["input_errors"])
    parts = json.loads(attrs["force_error_contributions_mN"])
    units = {"thickness": " mm", "initial_thickness": " mm"}
    said = []
    for name in sorted(parts, key=parts.__getitem__, reverse=True):
        if given[name]:
            size = f"{given[name]:.3g}{units.get(name, '')}"
            if name == "modulus":
                size = percent(given[name])
            said.append(
                f"{rounded(parts[name], digits=2)} mN by {INPUTS[name]} \N{PLUS-MINUS SIGN}{size}"
            )
    share = f" ({percent(error / abs(force))})" if force else ""
    return f"\N{PLUS-MINUS SIGN}{rounded(error, digits=2)} mN{share} at 95 %" + (
        "; " + ", ".join(said) if said else ""
    )


def _of_sample(maps: xr.Dataset) -> list[str]:
    """What a result says of the sample."""
    attrs = maps.attrs
    if "sample_rigid" in attrs:
        return [
            "sample: as good as rigid, it takes next to nothing of the compression; its stiffness "
            "cannot be told, and the stress is that of the layer on an imprint"
        ]
    modulus = maps["sample_youngs_modulus"].values
    error = maps["sample_modulus_error"].values
    alone = f", of {of} alone" if (of := without_inputs(attrs)) else ""
    lines = [
        f"total force: 95 % band ±{rounded(attrs['force_error_mN'], digits=2)} mN; axial stress: "
        f"±{rounded(np.nanmedian(maps['axial_stress_error']), digits=2)} kPa (median){alone}"
    ]
    if np.isfinite(modulus).any():
        low, middle, high = np.nanpercentile(modulus, [5, 50, 95])
        band = middle * np.nanmedian(error)
        ends = " ... ".join(rounded(end, band).split()[0] for end in (low, high))
        lines.append(
            f"Young's modulus of the sample: median {rounded(middle, band)} kPa, 90 % of the map "
            f"within {ends} kPa, 95 % band ±{percent(np.nanmedian(error))} (median), "
            f"known on {percent(np.isfinite(modulus).mean())} of the map"
        )
    if "sample_relief" in maps and maps["sample_relief"].notnull().any():
        lines.append(f"relief of the sample, found: {of_relief(maps)}")
    lines.append(
        f"thickness: computed and measured differ by {1e3 * attrs['thickness_misfit_mm']:.2g} um, "
        f"{attrs['misfit_over_tolerance']:.1f} times what noise "
        f"({1e3 * attrs['thickness_noise_mm']:.2g} um a pixel) and mesh explain, after "
        f"{attrs['forward_solutions']} forward solutions"
    )
    return lines


def of_relief(maps: xr.Dataset) -> str:
    """Say what relief of the sample was found."""
    low, high = 1e3 * np.nanpercentile(maps["sample_relief"].values, [1, 99])
    band = 1e3 * np.nanmedian(maps["sample_relief_error"].values)
    ends = " ... ".join(rounded(end, band).split()[0] for end in (low, high))
    return (
        f"98 % of it within {ends} um of its mean height, 95 % band ±{rounded(band, digits=2)} um "
        "(median)"
    )


def within_map(attrs: Mapping[Hashable, Any]) -> str:
    """Say what part of the force acts within the map, where the layer is larger; else ""."""
    within, force = attrs.get("map_force_mN"), attrs.get("sample_force_mN")
    if within is None or not force or abs(within / force - 1) < _NOTABLE_BEYOND:
        return ""
    return f"{rounded(within, force_error(attrs))} mN"


def of_series(series: xr.Dataset) -> str:
    """Travel and force of each load of a series."""
    forces = series["window_force"]
    errors = series.get("force_error", xr.full_like(forces, np.nan))
    return ", ".join(
        f"{travel:.3g} mm {rounded(force, error)} mN"
        for travel, force, error in zip(
            series["compression"].values, forces.values, errors.values, strict=True
        )
    )


def of_solution(attrs: Mapping[Hashable, Any]) -> list[str]:
    """Say what casts doubt on how a solution ended."""
    said = []
    change = attrs.get("volume_change_percent", 0.0)
    if abs(change) > _NOTABLE_VOLUME_CHANGE:
        said.append(
            f"the volume of the layer changed by {change:.1f} %, which causes stress: between "
            "roller edges a layer that is thinner all over is laterally confined"
        )
    if "asked_elements_failure" in attrs:
        sizes, asked = (
            " x ".join(f"{size:.2g}" for size in attrs[key])
            for key in ("element_size_mm", "asked_element_size_mm")
        )
        said.append(
            f"this is the solution on elements of {sizes} mm, not of {asked} mm: on those "
            f"{attrs['asked_elements_failure']}"
        )
    if "asked_edges_failure" in attrs:
        widths, asked = (
            " and ".join(f"{size:.2g}" for size in attrs[key])
            for key in ("edge_element_size_mm", "asked_edge_element_size_mm")
        )
        said.append(
            f"this is the solution with outermost elements {widths} mm wide along x and y, not "
            f"{asked} mm: with those {attrs['asked_edges_failure']}"
        )
    if attrs.get("status") == Status.NEARLY:
        said.append(
            "nearly converged: friction at some edges goes on changing, and "
            f"{percent(attrs['force_residual'])} of the contact forces are out of balance there"
        )
    return said


def of_submodel(attrs: Mapping[Hashable, Any]) -> list[str]:
    """Say what part of a layer was computed, and how well."""
    x0, x1, y0, y1 = attrs["submodel_region_mm"]
    part = "part" if "tiles" not in attrs else "worst tile"
    level = attrs.get("submodel_coarse_force_error")
    of_mesh = "unknown, as is the error of its force by its mesh"
    if level is not None:
        of_mesh = f"up to {percent(level)}, the error of its force by its mesh"
    lines = [
        f"region: x {x0:g} to {x1:g} mm, y {y0:g} to {y1:g} mm, force of the sample on it "
        f"{attrs['sample_force_mN']:.1f} mN",
        f"axial stress differs by {percent(attrs['submodel_change'])} from that of the coarse "
        f"solution; the sides of the {part} account for about "
        f"{percent(attrs['submodel_sides_error'])}, and what the coarse solution gets wrong of the "
        f"pressure everywhere for {of_mesh}",
    ]
    if "tiles" not in attrs:
        return lines
    across, along = attrs["tiles"]
    tiles = f"{across} x {along} tiles"
    if "seam_error" in attrs:
        tiles += (
            f"; where they overlap their axial stress differs by {percent(attrs['seam_error'])}, "
            f"{attrs['seam_error_largest_kPa']:.2g} kPa at most, before it is blended"
        )
    return [*lines, tiles]


def summarise(result: StressResult) -> str:
    """Return forces, stress and contact of a result as readable lines.

    Total forces in mN, mean and peak axial stress in kPa by each method (the percentile beside the
    most compressed pixel tells whether that pixel stands alone), and the shares of the map that
    are in contact and that were interpolated. Numbers have the digits that their error leaves.
    """
    maps = on_layer(result.maps)
    lines = []
    forces = [
        f"{side} {rounded(maps.attrs[key], force_error(maps.attrs))} mN"
        for side in ("window", "sample")
        if (key := f"{side}_force_mN") in maps.attrs
    ]
    if "submodel_region_mm" in maps.attrs:
        lines += of_submodel(maps.attrs)
    elif forces:
        within = within_map(maps.attrs)
        given = maps.attrs.get("total_force_given_mN")
        lines.append(
            "total force: "
            + ", ".join(forces)
            + f"; within the map {within}" * bool(within)
            + ("" if given is None else f"; given {given:g} mN")
        )
    if "force_mesh_error_mN" in maps.attrs:
        said = mesh_error(maps.attrs)
        if "accuracy" in maps.attrs:
            sizes = " x ".join(f"{size:.3g}" for size in maps.attrs["element_size_mm"])
            said += f", on elements of {sizes} mm chosen for {percent(maps.attrs['accuracy'])}"
        lines.append(f"error of the mesh, estimated: {said}")
    elif forces and not ("submodel_region_mm" in maps.attrs or "sample_shear_modulus" in maps):
        lines.append(
            "error of the mesh: unknown, because estimates were left out, or there is no solution "
            "on coarser elements"
        )
    if rim := maps.attrs.get("force_rim_model_mN", 0.0):
        lines.append(
            f"of the force, about {rounded(rim, digits=2)} mN is due to the model of the rim, "
            "where sides of the layer roll onto window or sample"
        )
    glued = [side for side in ("window", "sample") if maps.attrs.get(f"{side}_contact") == "glued"]
    if glued:
        lines.append(f"glued: {' and '.join(glued)}")
    if of_inputs := input_errors(maps.attrs):
        lines.append(f"error from the inputs: {of_inputs}")
    if "force_residual" in maps.attrs:
        lines.append("equilibrium: " + equilibrium(maps.attrs))
    for method in sorted(methods(result), reverse=True):
        mean, first, lowest = (f"{value} kPa" for value in stress_figures(result, method))
        lines.append(
            f"axial stress, {method}: mean {mean}, 99 % of the map above {first}, most compressed "
            f"{lowest}"
        )
    if "contact_state" in maps:  # the algebraic method computes none
        shares = [
            f"{kind.name.lower()} {percent(contact_share(maps, kind))}"
            for kind in reversed(ContactState)
            if (maps["contact_state"] == kind).any()
        ]
        lines.append("contact with the sample: " + ", ".join(shares))
        if "glued" in shares[0] and (pulled := area_mean(maps["contact_pressure"] < 0)):
            lines.append(f"pulled by the sample: {percent(pulled)} of the map")
    if result.series is not None:
        lines.append("loads: " + of_series(result.series))
    if "sample_shear_modulus" in maps:
        lines += _of_sample(maps)
    elif unknown := of_unknown_sample(maps):
        lines.append(unknown)
    if open_share := maps.attrs.get("no_contact_share"):
        lines.append(
            f"not thinner than unloaded, so taken as open: {percent(open_share)} of the map"
        )
    if "filled_share" in maps.attrs:
        parts = [
            f"{kind} {percent(share)}"
            for kind, key in (("missing", "missing_share"), ("spikes", "spike_share"))
            if (share := maps.attrs.get(key))
        ]
        filled = maps.attrs["filled_share"]
        said = f"{percent(filled)} of the map" if filled else "none"
        said += f" ({', '.join(parts)})" * bool(parts)
        lines.append(f"interpolated pixels: {said}")
        if unloaded := maps.attrs.get("initial_filled_share"):
            lines.append(f"interpolated pixels, unloaded: {percent(unloaded)} of the map")
        if max(filled, unloaded or 0.0) > _NOTABLE_FILLED:
            lines.append(
                "WARNING: so much of the thickness map is made up that the stress in and around "
                "the gaps is a guess"
            )
    doubts = [*of_solution(maps.attrs), *json.loads(maps.attrs.get("unusual", "[]"))]
    doubts += of_sides(maps.attrs)
    lines += [f"WARNING: {text}" for text in doubts]
    return plain("\n".join(lines))
