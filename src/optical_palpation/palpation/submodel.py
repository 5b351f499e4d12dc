"""Part of the field of view on finer elements than the whole, from the solution of the whole on."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.arguments import check_instance, explained
from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.submodel import Bounds, part_of, solve_part
from optical_palpation.palpation.algebraic import stress_of_pixels
from optical_palpation.palpation.computational import checked, element_sizes, outcome
from optical_palpation.palpation.memory import check_memory
from optical_palpation.palpation.meshing import PADDING, Hold, imprint_of, layer_problem
from optical_palpation.palpation.plausibility import misread
from optical_palpation.palpation.progress import Iterations, Progress
from optical_palpation.palpation.result import StressResult
from optical_palpation.palpation.surface import deformed_layer, force_on_map, surface_maps
from optical_palpation.palpation.threads import limited_threads
from optical_palpation.thickness.frames import (
    inside_layer,
    layer_extent_of,
    on_grid,
    typical_thickness,
)
from optical_palpation.thickness.initial import match_initial_thickness

#: Width in thicknesses of what is computed around the region and left out of the result.
MARGIN = 0.5
#: Difference in thicknesses up to which maps are the same, one of them rounded in a file.
SAME = 1e-3


@explained
def submodel_stress(
    coarse: StressResult,
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    region: Sequence[float],
    *,
    element_size: float | Sequence[float],
    margin: float | None = None,
    imprint_smoothing: float | None = None,
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> StressResult:
    """Compute the stress in a region on finer elements than the whole was.

    The part of the layer around the region is cut out of the whole and held at its sides by what
    the coarse solution says of traction and displacement there. Material, friction, slip length,
    edges and the motion of the sample are those of the coarse solution.

    Parameters
    ----------
    coarse
        The whole layer, from :func:`~optical_palpation.palpation.computational_stress`.
    loaded, initial_thickness
        The thickness maps from which it was computed, mm.
    region
        x0, x1, y0, y1 in mm, in the coordinates of the maps.
    element_size
        As for ``computational_stress``; smaller than that of the coarse solution.
    margin
        Width in mm of what is computed around the region and left out of the result; by default
        half of the thickness, and no less than four elements. Where it reaches a border of the
        layer the part ends there.
    imprint_smoothing
        As for ``computational_stress``: half of the lateral element size by default.
    threads, progress
        As for ``computational_stress``.

    Returns
    -------
    StressResult
        Maps of the region. ``submodel_sides_error`` among the attributes estimates what the cut
        sides get wrong: the change of contact pressure in the region with half of the margin along
        x, and that along y, as fractions (root mean squares), added. What they have in common with
        the whole, such as a pressure that its mesh makes too high everywhere, it does not see:
        ``submodel_coarse_force_error`` is the estimated error of the whole's force by its mesh, as
        a fraction, where that is known. ``submodel_change`` is by how
        much the axial stress differs from that of the coarse solution, ``sample_force_mN`` the
        force on the region.

    Raises
    ------
    InputError
        If the coarse result holds no solution, its maps are others, or a number cannot be used.
    ConvergenceError
        If the part finds no equilibrium.
    """
    inputs = submodel_inputs(coarse, loaded, initial_thickness, element_size, margin)
    loaded, initial, margin, sizes = inputs.loaded, inputs.initial, inputs.margin, inputs.sizes
    whole, state = coarse.problem, coarse.state
    assert whole is not None and state is not None  # noqa: PT018
    about = coarse.maps.attrs
    x0, x1, y0, y1 = checked_region(region, loaded)
    smoothing = 0.5 * float(np.sqrt(sizes[0] * sizes[1]))
    if imprint_smoothing is not None:
        smoothing = float(imprint_smoothing)
    fine = layer_problem(
        loaded,
        initial,
        None,
        whole.law,
        inputs.held,
        sizes,
        about["edges"],
        smoothing,
        whole.slip_length,
    )
    imprint = fine.imprint
    if whole.imprint.motion is not None:
        fine = replace(fine, imprint=replace(imprint, motion=whole.imprint.motion))
    inner = _before_load(whole, state, (x0, x1, y0, y1))
    wide, near = (
        (inner[0] - width, inner[1] + width, inner[2] - width, inner[3] + width)
        for width in (margin, 0.5 * margin)
    )
    part = part_of(fine, whole, state, wide)
    check_memory(part)
    report = Iterations(progress)
    try:
        with limited_threads(threads):
            solution, error = solve_part(part, whole, state, inner, near, report)
    except LoadNotReached as failure:
        raise ConvergenceError(
            f"the part around x {x0:g} to {x1:g}, y {y0:g} to {y1:g} mm finds no equilibrium: "
            f"{failure.reason}. Try elements nearer to the size of the coarse ones, or a larger "
            "margin"
        ) from None
    now = checked(solution)
    layer, surface = deformed_layer(solution, now)
    algebraic = stress_of_pixels(loaded, initial, whole.law, glued=inputs.pulls)
    here = loaded.assign_attrs(layer_extent=[x0, x1, y0, y1])
    maps = surface_maps(solution, surface, here, algebraic, sizes)
    stress = maps["axial_stress"]
    before = coarse.maps["axial_stress"].interp(x=stress["x"], y=stress["y"])
    change = float(np.sqrt(((stress - before) ** 2).mean() / (stress**2).mean()))
    ending = outcome(solution, now)
    for key in ("window_force_mN", "sample_force_mN", "force_balance", "volume_change_percent"):
        del ending[key]  # of the part with its margin, whose sides carry forces too
    pressure = maps["contact_pressure"].fillna(0.0)
    maps.attrs = {
        **settings_of(about),
        "element_size_mm": list(part.grid.spacing[::-1]),
        "elements": list(part.grid.shape[::-1]),
        "imprint_smoothing_mm": smoothing,
        **inputs.of_region((x0, x1, y0, y1)),
        "sample_force_mN": float(pressure.integrate(["x", "y"])),
        **ending,
        "submodel_region_mm": [x0, x1, y0, y1],
        "submodel_margin_mm": margin,
        "submodel_coarse_element_size_mm": about["element_size_mm"],
        "submodel_sides_error": error,
        "submodel_change": change,
        **force_on_map(maps, surface),
    }
    of_whole = json.loads(maps.attrs.get("unusual", "[]"))
    maps.attrs["unusual"] = json.dumps([*of_whole, *misread(maps.attrs)])
    return StressResult(maps, layer, part, solution.state)


def _before_load(whole: LayerProblem, state: LayerState, region: Bounds) -> Bounds:
    """Where what is in a region under load lies in the unloaded layer: x0, x1, y0, y1, mm."""
    grid = whole.grid
    moved = state.u[:2, -1]
    place = grid.nodes[:2, -1] + moved
    element = 1.01 * max(float(np.diff(at, axis=1 - axis).max()) for axis, at in enumerate(place))
    sides = np.reshape(region, (2, 2))
    near = np.all(
        [
            (at > low - element) & (at < high + element)
            for at, (low, high) in zip(place, sides, strict=True)
        ],
        axis=0,
    )
    found = []
    for at, by, nodes, both in zip(place, moved, (grid.x, grid.y), sides, strict=True):
        for end, border, side in zip((0, 1), (nodes[0], nodes[-1]), both, strict=True):
            here = by[near & (np.abs(at - side) < element)]
            if here.size and np.abs(side - border) > 1e-6 * (nodes[-1] - nodes[0]):
                found.append(float(side - (here.min() if end else here.max())))
            else:  # the layer ends there, or has moved in from there
                found.append(float(border))
    return found[0], found[1], found[2], found[3]


@dataclass(frozen=True, eq=False)
class SubmodelInputs:
    """What a part of a layer is computed from, checked.

    Attributes
    ----------
    loaded, initial
        Thickness maps, mm, on the same pixels.
    held
        What holds ``window`` and ``sample``.
    sizes
        Element sizes (x, y, z), mm.
    margin
        Width of what is computed around a region, mm.
    """

    loaded: xr.DataArray
    initial: xr.DataArray
    held: Mapping[str, Hold]
    sizes: tuple[float, float, float]
    margin: float

    @property
    def pulls(self) -> bool:
        """Whether the sample is glued, and may pull."""
        return self.held["sample"] == "glued"

    def of_region(self, region: Bounds) -> dict[str, float]:
        """Attributes that say of a region what those of the coarse result say of the whole."""
        there = inside_layer(self.loaded.assign_attrs(layer_extent=list(region)))
        if not there.any():  # it lies between pixels
            return {}
        loaded, initial = self.loaded.values[there], self.initial.values[there]
        return {
            "initial_thickness_mm": float(initial.mean()),
            "no_contact_share": 0.0 if self.pulls else float((loaded >= initial).mean()),
        }


def least_margin(sizes: Sequence[float]) -> float:
    """Narrowest margin, four elements: half of it is whole elements of twice the size."""
    return 4 * max(sizes[:2])


def submodel_inputs(
    coarse: StressResult,
    loaded: xr.DataArray,
    initial_thickness: float | xr.DataArray,
    element_size: float | Sequence[float],
    margin: float | None,
) -> SubmodelInputs:
    """Check what a part of a layer is to be computed from; as for :func:`submodel_stress`.

    Raises
    ------
    InputError
        If the coarse result holds no solution, its maps are others, or a number cannot be used.
    """
    check_instance(coarse, StressResult, "coarse", "a StressResult of the whole layer")
    whole = coarse.problem
    if whole is None or coarse.state is None:
        raise InputError(
            "the coarse result holds no solution to start from: only results of the computational "
            "method do, and files of them that this version has written"
        )
    if whole.surroundings is not None:
        raise InputError("the coarse result is itself a part of a layer: give the whole")
    loaded = on_grid(loaded, "loaded")
    if bool(loaded.isnull().any()):
        raise InputError("the loaded thickness has missing values: fill them with clean_thickness")
    held: dict[str, Hold] = {
        face: "glued" if glued else friction
        for face, glued, friction in zip(
            ("window", "sample"), whole.glued, whole.friction, strict=True
        )
    }
    pulls = held["sample"] == "glued"
    initial = match_initial_thickness(initial_thickness, loaded, glued=pulls)
    thickness = typical_thickness(initial)
    _check_extent(layer_extent_of(loaded), coarse, PADDING * thickness)
    _check_maps(loaded, initial, coarse)
    sizes = element_sizes(element_size, loaded, thickness)
    if sizes[0] * sizes[1] >= whole.grid.spacing[1] * whole.grid.spacing[2]:
        raise InputError(
            f"elements of {sizes[0]:g} x {sizes[1]:g} mm are no smaller than those of the coarse "
            f"solution, {whole.grid.spacing[2]:.3g} x {whole.grid.spacing[1]:.3g} mm"
        )
    least = least_margin(sizes)
    margin = max(MARGIN * thickness, least) if margin is None else float(margin)
    if not margin >= least * (1 - 1e-6) or not np.isfinite(margin):
        raise InputError(f"margin must be at least {least:g} mm, four elements, not {margin:g} mm")
    return SubmodelInputs(loaded, initial, held, sizes, margin)


def _check_extent(
    given: tuple[float, float, float, float], coarse: StressResult, padding: float
) -> None:
    """Refuse a map whose layer lies elsewhere than that of the coarse solution."""
    assert coarse.problem is not None
    grid = coarse.problem.grid
    beyond = padding if coarse.maps.attrs["edges"] == "padded" else 0.0
    own = (grid.x[0] + beyond, grid.x[-1] - beyond, grid.y[0] + beyond, grid.y[-1] - beyond)
    if np.abs(np.subtract(given, own)).max() > 1e-3 * (own[1] - own[0]):
        said = (" to ".join(f"{edge:.4g}" for edge in pair) for pair in (own[:2], own[2:]))
        here = (" to ".join(f"{edge:.4g}" for edge in pair) for pair in (given[:2], given[2:]))
        raise InputError(
            f"the layer of the map covers x {', y '.join(here)} mm, that of the coarse solution x "
            f"{', y '.join(said)} mm: give the same map with the same layer extent"
        )


def _check_maps(loaded: xr.DataArray, initial: xr.DataArray, coarse: StressResult) -> None:
    """Refuse maps that are not those of the coarse solution: its sides would not fit the part."""
    assert coarse.problem is not None
    own = coarse.problem.imprint
    smoothing = float(coarse.maps.attrs["imprint_smoothing_mm"])
    free = coarse.maps.attrs["edges"] == "free"
    given = imprint_of(loaded, initial, None, smoothing, beyond=free)
    if given.loaded.shape != own.loaded.shape:
        raise InputError(
            f"the thickness map has {given.loaded.shape[::-1]} pixels, that of the coarse "
            f"solution {own.loaded.shape[::-1]}: give the map that it was computed from"
        )
    pairs = {"initial": (given.unloaded, own.unloaded), "loaded": (given.loaded, own.loaded)}
    for name, (here, there) in pairs.items():
        off = float(np.abs(here - there).max())
        if off > SAME * float(np.median(own.unloaded)):
            raise InputError(
                f"the {name} thickness differs by up to {off:.2g} mm from that of the coarse "
                "solution: give the one that it was computed from"
            )


_SETTINGS = ("method", "edges", "bulk_to_shear", "initial_thickness", "no_contact_share", "unusual")


def settings_of(attrs: Mapping[Hashable, Any]) -> dict[Hashable, Any]:
    """Return the attributes of a coarse result that hold for its parts as well."""
    settings = {key: value for key, value in attrs.items() if _is_setting(str(key))}
    if "force_mesh_error_mN" in attrs and attrs.get("sample_force_mN"):
        share = abs(attrs["force_mesh_error_mN"] / attrs["sample_force_mN"])
        settings["submodel_coarse_force_error"] = share
    if "unusual" in settings:  # what there is to say of its map is not said of theirs
        of_map = misread(attrs)
        said = [text for text in json.loads(settings["unusual"]) if text not in of_map]
        settings["unusual"] = json.dumps(said)
    return settings


def _is_setting(name: str) -> bool:
    kinds = ("law", "source", "sample_motion", "slip_length", "window_", "sample_")
    settings = name.startswith((*kinds, *_SETTINGS)) or name.endswith("_kPa") or name == "alpha"
    return settings and not name.endswith("_force_mN")


def checked_region(
    given: Sequence[float], loaded: xr.DataArray
) -> tuple[float, float, float, float]:
    """Return a region, x0, x1, y0, y1 in mm, that lies in the layer.

    Raises
    ------
    InputError
        If it is no such region.
    """
    try:
        x0, x1, y0, y1 = (float(v) for v in given)
    except (TypeError, ValueError):
        raise InputError(f"region: x0, x1, y0, y1 in mm, not {given!r}") from None
    a0, a1, b0, b1 = layer_extent_of(loaded)
    slack = 1e-6 * (a1 - a0)
    if not (x0 < x1 and y0 < y1):
        raise InputError(f"region: x0 < x1 and y0 < y1 in mm, not {(x0, x1, y0, y1)}")
    if x0 < a0 - slack or x1 > a1 + slack or y0 < b0 - slack or y1 > b1 + slack:
        raise InputError(
            f"region {(x0, x1, y0, y1)} (x0, x1, y0, y1 in mm) reaches beyond the layer, "
            f"{(a0, a1, b0, b1)}"
        )
    return x0, x1, y0, y1
