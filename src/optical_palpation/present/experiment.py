"""Virtual experiments out: NetCDF, ParaView files and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from optical_palpation.experiment.virtual import ExperimentResult
from optical_palpation.files import netcdf
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.figure import draw_map, figure_file, letter
from optical_palpation.present.netcdf import _NODE_AXES, _compression, _described
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.profiles import centre_profiles
from optical_palpation.present.terms import ALGEBRAIC, COMPUTATIONAL, STRESS, Term, term
from optical_palpation.present.vtk import write_vtk

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"true": "black", "algebraic": ALGEBRAIC, "computational": COMPUTATIONAL}


def write_experiment(result: ExperimentResult, path: str | Path) -> None:
    """Write a virtual experiment as NetCDF-4.

    Maps at the root, the deformed bodies in the groups ``layer`` and ``sample`` (single precision,
    axes ``node_z``, ``node_y``, ``node_x``). The maps can be read like those of any result and the
    loaded thickness like any thickness map.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    maps = _described(result.maps)
    maps.attrs = {"Conventions": "CF-1.11", **provenance(result.maps)}
    groups, encoding = {"/": maps}, {"/": _compression(maps)}
    for name, body in (("/layer", result.layer), ("/sample", result.sample)):
        body = _described(body)
        groups[name] = body.rename({a: b for a, b in _NODE_AXES.items() if a in body.dims})
        encoding[name] = _compression(body, dtype=np.float32)
    content = netcdf(xr.DataTree.from_dict(groups), encoding=encoding)
    with atomic(path, "result") as temporary:
        temporary.write_bytes(content)


def write_bodies(result: ExperimentResult, layer: str | Path, sample: str | Path) -> None:
    """Write the two deformed bodies as ``.vts`` files for ParaView.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    for body, path in ((result.layer, layer), (result.sample, sample)):
        write_vtk(StressResult(result.maps, body), path)


def write_experiment_figure(
    result: ExperimentResult, path: str | Path, recovered: StressResult | None = None
) -> None:
    """Draw a virtual experiment (PNG, PDF or SVG by the name's ending).

    A section through the loaded assembly along x, the loaded thickness, the true axial stress, and
    its profiles through the centre beside those of the algebraic and, if ``recovered`` is given,
    of the computational method (figures 3b and 3d of the paper).

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with figure_file(path, "double", 105.0, result.maps) as figure:
        _draw(figure, result, recovered)


def _draw(figure: Figure, result: ExperimentResult, recovered: StressResult | None) -> None:
    rows: Any = figure.subfigures(2, 1)
    above, below = rows
    nodes = [body["position"].values.reshape(-1, 3) for body in (result.layer, result.sample)]
    width, _, height = np.ptp(np.concatenate(nodes), axis=0)
    wide = float(np.clip(width / height, 1.0, 1.6))
    section, thickness, stress = above.subplots(1, 3, width_ratios=[wide, 1.0, 1.0])
    profiles = below.subplots(1, 2, sharey=True)
    _draw_section(figure, section, result)
    maps = result.maps
    truth = Term("True axial stress", "kPa", STRESS, "stress")
    draw_map(thickness, maps["loaded_thickness"], term(maps, "loaded_thickness"))
    draw_map(stress, maps["axial_stress"], truth)
    source = result.maps if recovered is None else recovered.maps
    along: dict[str, Any] = {"true": (maps, "axial_stress")}
    along["algebraic"] = (source, "algebraic_axial_stress")
    if recovered is not None:
        along["computational"] = (source, "axial_stress")
    for n, (axis, panel) in enumerate(zip("xy", profiles, strict=True)):
        for label, (dataset, name) in along.items():
            profile = centre_profiles(dataset)[n]
            panel.plot(profile[axis], profile[name], color=_COLOURS[label], label=label)
        panel.set_title(f"Through the centre along {axis}", loc="left")
        panel.set_xlabel(f"{axis} (mm)")
        panel.grid()
    profiles[0].set_ylabel("axial stress (kPa)")
    below.legend(
        *profiles[0].get_legend_handles_labels(), ncols=3, loc="outside upper right", fontsize=7
    )
    letter([section, thickness, stress, *profiles])


def _draw_section(figure: Figure, axes: Axes, result: ExperimentResult) -> None:
    """Draw the section along x through the centre, coloured by axial stress."""
    section, values = [], []
    for body in (result.layer, result.sample):
        position = body["position"].transpose("z", "y", "x", "component").values
        axial = body["cauchy_stress"].sel(tensor="zz").transpose("cell_z", "cell_y", "cell_x")
        middle = position.shape[1] // 2
        section.append(position[:, middle])
        values.append(axial.values[:, middle])
    low, high = np.percentile(np.concatenate([v.ravel() for v in values]), [1, 99])
    meshes = [
        axes.pcolormesh(
            nodes[..., 0],
            nodes[..., 2],
            stress,
            cmap=STRESS,
            vmin=low,
            vmax=high,
            edgecolors="white",
            linewidth=0.1,
            rasterized=True,
        )
        for nodes, stress in zip(section, values, strict=True)
    ]
    axes.plot(section[1][0, :, 0], section[1][0, :, 2], color="black", lw=0.8)
    axes.invert_yaxis()
    axes.set_title("Section, axial stress (kPa)", loc="left")
    axes.set(xlabel="x (mm)", ylabel="z (mm)")
    axes.set_aspect("equal")
    # beside the drawing as it is to scale, not beside all the room there is for it
    figure.colorbar(meshes[0], cax=axes.inset_axes((1.03, 0.0, 0.04, 1.0)))
