"""Picture of the layer's boundaries: thickness, quality, and two B-scans with what was found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.present.figure import draw_map, figure_file, letter
from optical_palpation.present.terms import percent, term
from optical_palpation.thickness.boundaries import side_filled
from optical_palpation.thickness.intensity import intensity_reader

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    from optical_palpation.volume import Volume

_WINDOW, _SAMPLE, _FILLED = "#56B4E9", "#E69F00", "#D55E00"
_STYLES = ("--", ":")


def write_boundaries_figure(found: xr.Dataset, volume: Volume, path: str | Path) -> None:
    """Draw what :func:`~optical_palpation.thickness.find_layer` found (PNG, PDF or SVG).

    Maps of thickness and quality, with the interpolated pixels marked, and two B-scans with both
    boundaries: the middle one, and the one of the lowest mean quality.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with figure_file(path, "double", 130.0) as figure:
        _draw(figure, found, volume)


def _draw(figure: Figure, found: xr.Dataset, volume: Volume) -> None:
    (left, right), (middle, worst) = figure.subplots(2, 2)
    rows = {"middle B-scan": found.sizes["y"] // 2}
    rows["B-scan of the lowest quality"] = int(np.argmin(found["quality"].mean("x").values))
    filled = float(found["filled"].mean())
    interpolated = f", {percent(filled)} interpolated" if filled else ""
    for axes, name, title in (
        (left, "thickness", f"Thickness of the layer (mm){interpolated}"),
        (right, "quality", f"Quality, median {float(found['quality'].median()):.2f}"),
    ):
        if found.sizes["y"] > 1:
            _map(axes, found, name)
            for y, style in zip(rows.values(), _STYLES, strict=True):
                axes.axhline(float(found["y"][y]), color="white", lw=1.2, ls=style)
        else:
            axes.plot(found["x"], found[name][0])
            axes.set(xlabel="x (mm)")
        axes.set_title(title, loc="left")
    read = intensity_reader(volume, volume.metadata.scale)
    for axes, (name, y), style in zip((middle, worst), rows.items(), _STYLES, strict=True):
        _bscan(axes, found.isel(y=y), read(y), volume)
        line = "dashed" if style == "--" else "dotted"
        axes.set_title(
            f"{name[0].upper()}{name[1:]} ({line}), y = {float(found['y'][y]):.4g} mm", loc="left"
        )
    lines = {
        label: handle
        for axes in (middle, worst)
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)
    letter([left, right, middle, worst])


def _map(axes: Axes, found: xr.Dataset, name: str) -> None:
    limits = (0.0, 1.0) if name == "quality" else None
    draw_map(axes, found[name], term(found, name), limits=limits)
    marked = np.where(found["filled"], 1.0, np.nan)
    axes.pcolormesh(
        found["x"], found["y"], marked, shading="nearest", cmap=_only(_FILLED), rasterized=True
    )


def _bscan(axes: Axes, line: xr.Dataset, intensity: NDArray[np.float32], volume: Volume) -> None:
    """Draw a B-scan in decibels down to some way below the layer, and both boundaries on it."""
    z0, dz = volume.metadata.origin.z, volume.metadata.spacing.z
    with np.errstate(divide="ignore", invalid="ignore"):
        decibels = 10.0 * np.log10(np.where(intensity > 0, intensity, np.nan))
    low, high = np.nanpercentile(decibels, [5, 99.8])
    depth = z0 + dz * np.arange(len(decibels))
    axes.pcolormesh(
        line["x"], depth, decibels, shading="nearest", cmap="gray", vmin=low, vmax=high,
        rasterized=True,
    )  # fmt: skip
    for name, colour in (("window", _WINDOW), ("sample", _SAMPLE)):
        boundary = line[f"{name}_depth"].values
        axes.plot(line["x"], boundary, color=colour, lw=1.2, label=f"{name} side")
        filled = side_filled(line, name).values
        if filled.any():
            made_up = np.where(filled, boundary, np.nan)
            axes.plot(line["x"], made_up, color=_FILLED, lw=2.5, label="interpolated")
    deepest = float(line["sample_depth"].max() + line["thickness"].mean())
    axes.set(xlabel="x (mm)", ylabel="depth (mm)", ylim=(min(depth[-1], deepest), depth[0]))


def _only(colour: str) -> ListedColormap:
    from matplotlib.colors import ListedColormap

    return ListedColormap([colour])
