"""One picture of a result: thickness, stress by both methods, contact and profiles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.profiles import centre_profiles, on_layer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

# Okabe and Ito's palette, told apart by all kinds of colour vision.
_STATE_COLOURS = {
    ContactState.OPEN: "#DDDDDD",
    ContactState.SLIP: "#E69F00",
    ContactState.STICK: "#0072B2",
}
_ALGEBRAIC, _COMPUTATIONAL = "#D55E00", "#0072B2"
# Legends stand below the axes, where they hide nothing.
_BELOW: dict[str, Any] = {
    "loc": "upper center",
    "bbox_to_anchor": (0.5, -0.16),
    "ncols": 3,
    "frameon": False,
    "columnspacing": 1,
    "handlelength": 1.2,
}
# Brighter means more compressed, as in the published maps: stress is negative there.
_STRESS_MAP, _THICKNESS_MAP = "viridis_r", "cividis"


def write_panel(result: StressResult, path: str | Path) -> None:
    """Draw the result as a picture (PNG, PDF or SVG by the name's ending).

    Loaded thickness, axial stress by the algebraic and, if there is one, by the computational
    method on one colour scale, the state of contact with the sample, and the profiles through the
    centre along x and y. The colour scale spans the 1st to 99th percentile of both maps, so that
    the few extreme values at the free edges do not hide the rest.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with atomic(path, "picture") as temporary:
        figure = _draw(result)
        about = "; ".join(f"{key} {value}" for key, value in provenance(result.maps).items())
        kind = temporary.suffix.lower()
        key = {".png": "Description", ".pdf": "Subject", ".svg": "Description"}[kind]
        figure.savefig(temporary, dpi=150, metadata={key: about})


def _draw(result: StressResult) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    maps = on_layer(result.maps)
    computational = "contact_pressure" in maps  # the algebraic method alone has none
    algebraic = "algebraic_axial_stress" if computational else "axial_stress"
    both = np.stack([maps[algebraic].values, maps["axial_stress"].values])
    low, high = np.nanpercentile(both, [1, 99])
    stress = {"cmap": _STRESS_MAP, "vmin": low, "vmax": high}

    figure = Figure(figsize=(13.5, 8.2), layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1))
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([list("TTAACC"), list("SSXXYY" if computational else "XXXYYY")])
    _show(figure, axes["T"], maps["loaded_thickness"], "Loaded thickness (mm)", cmap=_THICKNESS_MAP)
    _show(figure, axes["A"], maps[algebraic], "Axial stress, algebraic (kPa)", **stress)
    if computational:
        title = "Axial stress, computational (kPa)"
        _show(figure, axes["C"], maps["axial_stress"], title, **stress)
    _show_contact(axes["S" if computational else "C"], maps["contact_state"])
    axes["Y"].sharey(axes["X"])
    for axis, profile in zip("xy", centre_profiles(maps), strict=True):
        _plot_profile(axes[axis.upper()], axis, profile, algebraic, computational)
    figure.suptitle(_title(maps))
    return figure


def _show(figure: Figure, axes: Axes, field: xr.DataArray, title: str, **colours: Any) -> None:
    image = _draw_map(axes, field, title, **colours)
    figure.colorbar(image, ax=axes, shrink=0.85, extend="both" if "vmin" in colours else "neither")


def _show_contact(axes: Axes, state: xr.DataArray) -> None:
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    colours = ListedColormap(list(_STATE_COLOURS.values()))
    _draw_map(axes, state, "Contact with the sample", cmap=colours, vmin=-0.5, vmax=2.5)
    handles = [
        Patch(facecolor=colour, edgecolor="black", label=f"{s.name.lower()} {share:.1%}")
        for s, colour in _STATE_COLOURS.items()
        if (share := float(np.mean(state.values == s))) > 0
    ]
    axes.legend(handles=handles, **_BELOW)


def _draw_map(axes: Axes, field: xr.DataArray, title: str, **colours: Any) -> QuadMesh:
    values = field.transpose("y", "x").values
    mesh = axes.pcolormesh(
        field["x"], field["y"], values, shading="nearest", rasterized=True, **colours
    )
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    return mesh


def _plot_profile(
    axes: Axes, axis: str, profile: xr.Dataset, algebraic: str, computational: bool
) -> None:
    across = "y" if axis == "x" else "x"
    axes.plot(profile[axis], profile[algebraic], color=_ALGEBRAIC, lw=1.2, label="algebraic")
    if computational:
        axes.plot(
            profile[axis],
            profile["axial_stress"],
            color=_COMPUTATIONAL,
            lw=1.6,
            label="computational",
        )
    axes.set(
        title=f"Along {axis} at {across} = {float(profile[across]):.3g} mm",
        xlabel=f"{axis} (mm)",
        ylabel="axial stress (kPa)",
    )
    axes.grid(alpha=0.3)
    axes.legend(**_BELOW)


def _title(maps: xr.Dataset) -> str:
    parts = []
    for side in ("window", "sample"):
        if (force := maps.attrs.get(f"{side}_force_mN")) is not None:
            parts.append(f"{side} force {float(force):.1f} mN")
    parts.append(f"mean axial stress {float(maps['axial_stress'].mean()):.3g} kPa")
    return "Tactile stress: " + ", ".join(parts)
