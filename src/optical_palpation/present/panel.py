"""One picture of a result: thickness, stress by both methods, contact and profiles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from optical_palpation.palpation.result import ContactState, StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.profiles import centre_profiles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, told apart by all kinds of colour vision.
_STATE_COLOURS = {
    ContactState.OPEN: "#DDDDDD",
    ContactState.SLIP: "#E69F00",
    ContactState.STICK: "#0072B2",
}
_ALGEBRAIC, _COMPUTATIONAL = "#D55E00", "#0072B2"
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

    maps = result.maps
    algebraic = maps["axial_stress"]
    computational = None
    if "contact_pressure" in maps:  # the algebraic method alone has none
        algebraic, computational = maps["algebraic_axial_stress"], maps["axial_stress"]
    both = np.concatenate([m.values.ravel() for m in (algebraic, computational) if m is not None])
    low, high = np.nanpercentile(both, [1, 99])
    stress = {"cmap": _STRESS_MAP, "vmin": low, "vmax": high}

    figure = Figure(figsize=(13.5, 8), layout="constrained")
    FigureCanvasAgg(figure)
    (top_left, top_middle, top_right), (left, middle, right) = figure.subplots(2, 3)
    thickness = maps["loaded_thickness"]
    _show(figure, top_left, thickness, "Loaded thickness (mm)", cmap=_THICKNESS_MAP)
    _show(figure, top_middle, algebraic, "Axial stress, algebraic (kPa)", **stress)
    if computational is not None:
        _show(figure, top_right, computational, "Axial stress, computational (kPa)", **stress)
    else:
        top_right.set_axis_off()
    _show_contact(figure, left, maps["contact_state"])
    for axes, axis, profile in zip((middle, right), "xy", centre_profiles(maps), strict=True):
        _plot_profile(axes, axis, profile, algebraic.name, computational is not None)
    low, high = middle.get_ylim()
    low, high = min(low, right.get_ylim()[0]), max(high, right.get_ylim()[1])
    middle.set_ylim(low, high)
    right.set_ylim(low, high)
    figure.suptitle(_title(maps))
    return figure


def _extent(field: xr.DataArray) -> tuple[float, float, float, float]:
    """Return the outer borders of the first and last pixels: pixels are areas, not points."""
    x, y = field["x"].values, field["y"].values
    dx, dy = (x[-1] - x[0]) / (x.size - 1) / 2, (y[-1] - y[0]) / (y.size - 1) / 2
    return x[0] - dx, x[-1] + dx, y[0] - dy, y[-1] + dy


def _show(figure: Figure, axes: Axes, field: xr.DataArray, title: str, **colours: Any) -> None:
    image = axes.imshow(
        field.transpose("y", "x").values,
        origin="lower",
        extent=_extent(field),
        interpolation="nearest",
        **colours,
    )
    extend = "both" if "vmin" in colours else "neither"
    figure.colorbar(image, ax=axes, shrink=0.85, extend=extend)
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)")


def _show_contact(figure: Figure, axes: Axes, state: xr.DataArray) -> None:
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    values = state.transpose("y", "x").values
    axes.imshow(
        values,
        origin="lower",
        extent=_extent(state),
        interpolation="nearest",
        cmap=ListedColormap(list(_STATE_COLOURS.values())),
        vmin=-0.5,
        vmax=len(ContactState) - 0.5,
    )
    axes.set(title="Contact with the sample", xlabel="x (mm)", ylabel="y (mm)")
    handles = [
        Patch(facecolor=colour, edgecolor="black", label=f"{s.name.lower()} {share:.1%}")
        for s, colour in _STATE_COLOURS.items()
        if (share := float(np.mean(values == s))) > 0
    ]
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.02, 1), frameon=False)


def _plot_profile(
    axes: Axes, axis: str, profile: xr.Dataset, algebraic: Any, computational: bool
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
    axes.legend(frameon=False)


def _title(maps: xr.Dataset) -> str:
    parts = []
    for side in ("window", "sample"):
        if (force := maps.attrs.get(f"{side}_force_mN")) is not None:
            parts.append(f"{side} force {float(force):.1f} mN")
    parts.append(f"mean axial stress {float(maps['axial_stress'].mean()):.3g} kPa")
    return "Tactile stress: " + ", ".join(parts)
