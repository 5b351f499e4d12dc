"""Measured and published layers: the coin, and the sinusoid against an independent code."""

from __future__ import annotations

import math
import time

import numpy as np
import psutil
import xarray as xr

from optical_palpation.analysis import edge_response, perturbation_correlation
from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import Progress, StressResult, computational_stress
from optical_palpation.present import write_panel
from optical_palpation.present.output import atomic
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.thickness import clean_thickness, read_thickness_map

_MATERIAL = MooneyRivlin(2.23, 0.703)


def independent_code(setting: Setting) -> Part:
    """Our solution on a published imprint against another code's."""
    path = setting.third_party("layers/sinusoid_simulated_L1.npz")
    loaded = read_thickness_map(path, variable="L1_mm", layer_extent=(0.0, 5.0, 0.0, 5.0))
    with np.load(setting.third_party("layers/sinusoid_reference_stress.npz")) as data:
        theirs = {name: data[name] for name in ("x_mm", "y_mm", "contact_pressure_kPa")}
        force = float(data["total_force_mN"])
    size = 0.25 if setting.quick else 0.0625
    result = _solve(setting, loaded, size, (0.3, 0.05))
    assert result.layer is not None
    part = Part(
        "The layer pressed by a rigid sinusoidal imprint, the loaded thickness that the paper's "
        "commercial code computed; friction 0.3 and 0.05. The reference is another code with other "
        "elements (NGSolve 6.2, Q2-Q1, 60 x 60 x 5 equivalent), on the nodes of the unloaded layer."
    )
    ours = float(result.maps.attrs["sample_force_mN"])
    elements = f"{1e3 * size:g} um elements"
    part.rows.append(
        Row(
            "Independent code",
            f"total force on the sinusoidal imprint, {elements}",
            f"{force:.1f} mN",
            f"{ours:.1f} mN",
            f"{ours / force - 1:+.1%}; linear elements against quadratic ones",
        )
    )
    pressure = _on_reference(result)
    there = pressure.interp(x=theirs["x_mm"], y=theirs["y_mm"]).values
    inner = np.minimum(theirs["x_mm"], 5 - theirs["x_mm"]) > 0.499
    inner = np.logical_and.outer(inner, inner)
    difference = np.linalg.norm((there - theirs["contact_pressure_kPa"])[inner])
    difference /= np.linalg.norm(theirs["contact_pressure_kPa"][inner])
    part.rows.append(
        Row(
            "Independent code",
            "contact pressure, interior (0.5 mm off the edges)",
            "0",
            f"{difference:.1%} relative RMS difference",
            f"linear elements of {1e3 * size:g} um against quadratic ones of 83 um; both draw the "
            "ridges",
        )
    )
    picture = "independent-code.png"
    _draw_pressures(pressure, theirs, setting)
    part.pictures.append((picture, "Contact pressure along x by both codes."))
    return part


def coin(setting: Setting) -> Part:
    """The published coin: stress, edges and computing time."""
    path = setting.third_party("layers/coin_5c_1-thickness.mat")
    loaded = read_thickness_map(path, field_of_view=(5.0, 5.0))
    size = 0.25 if setting.quick else 0.05
    started = time.process_time()
    result = _solve(setting, clean_thickness(loaded)["thickness"], size, (0.15, 0.05))
    seconds = time.process_time() - started
    count = int(np.prod(result.maps.attrs["elements"]))
    part = Part(
        "Measured thickness of the layer on an Australian 5-cent coin (5 x 5 mm of it), friction "
        f"0.15 and 0.05, {count:,} elements."
    )
    picture = "figure-5f.png"
    write_panel(result, setting.folder / picture)
    part.pictures.append((picture, "Tactile stress of a coin (figure 5f)."))
    part.rows.append(
        Row(
            "Section 8",
            "computing time",
            "15 to 30 min for 100,000 elements",
            f"{seconds:.0f} s of processor time for {count:,} elements",
            f"threads: {setting.threads or psutil.cpu_count(logical=True)}; quasi-static and "
            "implicit, multigrid",
            tolerance=math.inf,
        )
    )
    scale = 4 * size
    texture = perturbation_correlation(
        result.maps["loaded_thickness"], result.maps["axial_stress"], scale
    )
    part.rows.append(
        Row(
            "Section 7",
            "correlation of perturbations in thickness and stress",
            "0.85 (rough cube)",
            f"{texture.coefficient:.2f} (coin, structure below {scale:g} mm)",
            "texture of the stress comes from the surface of the sample; thinner is more "
            "compressed. The rough cube's data are not published",
        )
    )
    sharpest = {
        name: _sharpest_edge(result.maps[name])
        for name in ("axial_stress", "algebraic_axial_stress")
    }
    part.rows.append(
        Row(
            "Section 7",
            "sharpest edges of the coin, 10-90 %",
            "below 25 um for selected edges (10 um elements)",
            f"{sharpest['axial_stress']} with {1e3 * size:g} um elements; algebraic "
            f"{sharpest['algebraic_axial_stress']}",
            "limited by the elements and by the smoothing of the imprint; sharpest tenth of the "
            "steepest places",
        )
    )
    return part


def _solve(
    setting: Setting, loaded: xr.DataArray, size: float, friction: tuple[float, float]
) -> StressResult:
    def report(now: Progress) -> None:
        setting.tell(now.load, f"{now.stage}, {now.newton} Newton iterations")

    return computational_stress(
        loaded,
        0.5,
        _MATERIAL,
        window_friction=friction[0],
        sample_friction=friction[1],
        element_size=size,
        threads=setting.threads,
        progress=report,
    )


def _on_reference(result: StressResult) -> xr.DataArray:
    """Contact pressure on the nodes of the unloaded layer."""
    assert result.layer is not None
    layer = result.layer
    surface = layer["position"].isel(z=-1)
    maps = result.maps["contact_pressure"]
    at = {c: surface.sel(component=c) for c in ("x", "y")}
    return maps.interp(x=at["x"], y=at["y"])


def _draw_pressures(ours: xr.DataArray, theirs: dict[str, np.ndarray], setting: Setting) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    line = ours.interp(y=2.5)
    axes.plot(line["x"], line, color="#0072B2", label="ours")
    middle = theirs["contact_pressure_kPa"][theirs["y_mm"].size // 2]
    axes.plot(theirs["x_mm"], middle, "k.", label="NGSolve")
    axes.set(xlabel="x in the unloaded layer (mm)", ylabel="contact pressure (kPa)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    with atomic(setting.folder / "independent-code.png", "picture") as temporary:
        figure.savefig(temporary, dpi=150)


def _sharpest_edge(stress: xr.DataArray, length: float = 0.4) -> str:
    """Tenth percentile of the edge responses along x at the steepest places of the map."""
    steep = abs(stress.differentiate("x"))
    inner = steep.sel(x=slice(0.7, 4.3), y=slice(0.7, 4.3))
    threshold = float(inner.quantile(0.99))
    rises = []
    for y, x in zip(*np.nonzero(inner.values > threshold), strict=True):
        at = float(inner["x"][x])
        line = stress.sel(y=inner["y"][y]).sel(x=slice(at - length / 2, at + length / 2))
        try:
            rises.append(edge_response(line).rise)
        except InputError:  # not one clear edge
            continue
    return f"{1e3 * float(np.percentile(rises, 10)):.0f} um" if rises else "no clear edge"
