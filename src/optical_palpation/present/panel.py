"""One picture of a result: thickness, stress by both methods, contact and profiles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import map_error, on_layer
from optical_palpation.errors import InputError
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.figure import (
    Width,
    common_frame,
    draw_map,
    figure_file,
    finest,
    hatch_edges,
    hatch_interpolated,
    letter,
    width_in_mm,
)
from optical_palpation.present.profiles import centre_profiles
from optical_palpation.present.summary import methods_in
from optical_palpation.present.terms import ALGEBRAIC, COMPUTATIONAL, common_limits, term

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width below which labels of neighbouring maps run into each other, mm.
_NARROWEST = 170.0


def write_panel(result: StressResult, path: str | Path, width: Width = "double") -> None:
    """Draw the result as a picture (PNG, PDF or SVG by the name's ending).

    Loaded thickness, axial stress by the algebraic and, if there is one, by the computational
    method on one colour scale, the state of contact with the sample, and the profiles through the
    centre along x and y. The colour scale spans the 1st to 99th percentile of both maps, so that
    the few extreme values at the free edges do not hide the rest. Of a sample in the model its
    Young's modulus, left white where nothing is known of it, and the 95 % band of the stress. Where
    the layer's sides change the contact pressure by more than 5 % the map of the computational
    method is hatched; where the thickness was interpolated, its map and that of the algebraic
    method are. Thickness and algebraic stress have the resolution of the image, not that of the
    elements.

    Parameters
    ----------
    result
        Stress by either method.
    path
        The picture.
    width
        As for :func:`~optical_palpation.present.write_maps`.

    Raises
    ------
    InputError
        If the width is less than 170 mm: the panel would not be legible.
    OutputError
        The file cannot be written.
    """
    if (given := width_in_mm(width)) < _NARROWEST:
        raise InputError(
            f"width: a panel of all maps needs {_NARROWEST:g} mm to be legible, not {given:g} mm; "
            "for a narrower figure choose a map (--map axial_stress, or write_maps in Python)"
        )
    with figure_file(path, width, panel_height(result.maps), result.maps) as figure:
        draw_panel(result.maps, figure, result.pixels)


def panel_height(maps: xr.Dataset) -> float:
    """Height of the panel in mm at double width."""
    maps = on_layer(maps)
    aspect = _aspect(maps)
    if "contact_pressure" not in maps:  # two columns
        return 41.0 + 2 * min(64.0 * aspect, 80.0)
    return 41.0 + 2 * 40.0 * aspect + (17.0 + 40.0 * aspect) * _has_stiffness(maps)


def _aspect(maps: xr.Dataset) -> float:
    """Height over width of the room for a map."""
    across = float(np.ptp(maps["x"].values)) or 1.0
    return float(np.clip(np.ptp(maps["y"].values) / across, 0.5, 1.6))


def _has_stiffness(maps: xr.Dataset) -> bool:
    """Whether the stiffness of the sample is known anywhere."""
    return "sample_youngs_modulus" in maps and bool(maps["sample_youngs_modulus"].notnull().any())


def draw_panel(maps: xr.Dataset, figure: Figure, pixels: xr.Dataset | None = None) -> None:
    """Draw the panel into an empty figure.

    Thickness and algebraic stress are drawn on the pixels, where these are given, else on the
    points of the maps.
    """
    maps = on_layer(maps)
    fine = maps if pixels is None else on_layer(pixels)
    computational = "contact_pressure" in maps  # the algebraic method alone has none
    methods = methods_in(maps)
    shown = ["loaded_thickness", *methods.values(), *(["contact_state"] if computational else [])]
    fields = finest(maps, fine, shown)
    stress = common_limits({n: fields[n] for n in methods.values()}, "")
    places, rows = ("TACS", ["TTAACC", "SSXXYY"]) if computational else ("TA", ["TA", "XY"])
    if "algebraic" not in methods:  # as in the truth of a virtual experiment
        places, rows = "TCS", ["TTCCSS", "XXXYYY"]
    if _has_stiffness(maps):
        places, rows = f"{places}ME", ["TTAACC", "MMEESS", "XXXYYY"]
        if "algebraic" not in methods:
            rows[:2] = "TTCCSS", "MMMEEE"
        for name in ("sample_youngs_modulus", "axial_stress_error"):
            shown.append(name)
            fields[name] = maps[name]
    frame = common_frame(fields.values())
    axes = figure.subplot_mosaic([list(row) for row in rows])
    for place, name in zip(places, shown, strict=True):
        what = term(maps, name)
        limits = stress if what.scale == "stress" else None
        draw_map(axes[place], fields[name], what, limits=limits, frame=frame)
    if computational:
        hatch_edges(axes["C"], maps)
    axes["Y"].sharey(axes["X"])
    for place in "XY":  # in line with the maps
        axes[place].set_box_aspect(_aspect(maps))
    both = zip("xy", centre_profiles(maps), centre_profiles(fine), strict=True)
    for axis, profile, measured in both:
        _plot_profile(axes[axis.upper()], axis, profile, measured, methods)
    # below the profiles: within them it would lie on a curve or on an error band
    # not in the map of the computational method, where the influence of the sides is hatched
    gaps = [axes[place] for place in "TA" if place in axes]
    handles = [*axes["X"].get_lines(), *hatch_interpolated(gaps, maps)]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    letter([axes[place] for place in dict.fromkeys("".join(rows))])


def _plot_profile(
    axes: Axes, axis: str, profile: xr.Dataset, measured: xr.Dataset, methods: dict[str, str]
) -> None:
    across = "y" if axis == "x" else "x"
    colours = {"algebraic": ALGEBRAIC, "computational": COMPUTATIONAL}
    for method, name in methods.items():
        line = measured if name in measured and name != "axial_stress" else profile
        axes.plot(line[axis], line[name], color=colours[method], label=method)
        if (error := map_error(profile, name)) is not None:
            low, high = profile[name] - error, profile[name] + error
            axes.fill_between(profile[axis], low, high, color=colours[method], alpha=0.25, lw=0)
    axes.set_title(f"{across} = {float(profile[across]):.3g} mm", loc="left")
    axes.set(xlabel=f"{axis} (mm)", ylabel="axial stress (kPa)")
    axes.grid()
