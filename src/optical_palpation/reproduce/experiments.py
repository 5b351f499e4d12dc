"""Section 6 and 7: virtual experiments, and stress recovered from their thickness alone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import psutil
import xarray as xr

from optical_palpation.analysis import compare_maps, edge_response
from optical_palpation.experiment import ExperimentResult, read_scene, run_experiment
from optical_palpation.experiment.recovery import (
    recovered_stress,
    recovery_errors,
    spreading_sample,
)
from optical_palpation.experiment.scene import with_element_size
from optical_palpation.palpation import Progress
from optical_palpation.present.experiment import write_experiment_figure
from optical_palpation.present.output import atomic
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.thickness import read_thickness_map

_INTERIOR = " Errors are those of the interior, 0.5 mm and more off the edges."


def sinusoid(setting: Setting) -> Part:
    """Figure 3a and 3b: five ridges."""
    published, seconds = _run(setting, "sinusoid", 0.4 if setting.quick else None, 0.25)
    # the stress that is taken for the truth comes from smaller elements than the published ones
    true = published if setting.quick else _run(setting, "sinusoid", 0.1, 0.25, 0.25)[0]
    part = Part(_about(true) + _INTERIOR)
    if setting.data is not None:
        part.rows += _against_published(published, setting)
        part.pictures.append(("figure-3a.png", "Loaded thickness along x, at the centre."))
    _recover(part, setting, true, "3b", 0.5 if setting.quick else 0.08)
    part.rows.append(_time(published, seconds, setting))
    return part


def columns(setting: Setting) -> Part:
    """Figure 3d: a soft and a stiff column."""
    true, seconds = _run(setting, "soft_stiff_columns", 0.4 if setting.quick else None)
    part = Part(_about(true) + _INTERIOR)
    _recover(part, setting, true, "3d", 0.5 if setting.quick else 0.1)
    part.rows.append(_time(true, seconds, setting))
    return part


def cube(setting: Setting) -> Part:
    """Figure 5: a stiff cube on a plate."""
    true, seconds = _run(setting, "cube_on_plate", 0.1 if setting.quick else None)
    size = 0.1 if setting.quick else 0.01
    recovered = recovered_stress(
        true,
        element_size=(size, size, 0.0625),
        noise=0.0,
        threads=setting.threads,
        progress=_reporter(setting, 0.5, 0.5, "stress from its thickness"),
    )
    part = Part(_about(true))
    picture = "figure-5.png"
    write_experiment_figure(true, setting.folder / picture, recovered)
    part.pictures.append((picture, "A stiff cube: true stress and that of both methods (5a to d)."))
    names = {
        "algebraic": recovered.maps["algebraic_axial_stress"],
        "computational": recovered.maps["axial_stress"],
        "true": true.maps["axial_stress"],
    }
    edges = {name: _edge(field) for name, field in names.items()}
    rises = {name: 1e3 * rise for name, (rise, _) in edges.items()}
    part.rows += [
        Row(
            "Section 7, figure 5a, b",
            "10-90 % edge response on the virtual cube, um",
            "180 to 250 algebraic, 15 to 20 computational",
            f"algebraic {rises['algebraic']:.0f}, computational {rises['computational']:.0f} with "
            f"elements of {1e3 * size:g} um",
            f"true {rises['true']:.0f}: the edge of a stiff cube presses more than its middle, and "
            "stress passes that of the middle within an element",
        ),
        Row(
            "Section 7, figure 5a, b",
            "axial stress on the middle of the cube, kPa",
            f"{edges['true'][1]:.2f} (true)",
            f"computational {edges['computational'][1]:.2f}, algebraic {edges['algebraic'][1]:.2f}",
            "friction as in the scene: a stiff cube does not spread with the layer",
        ),
    ]
    part.rows.append(_time(true, seconds, setting))
    return part


def _run(
    setting: Setting,
    name: str,
    element_size: float | None,
    share: float = 0.5,
    start: float = 0.0,
) -> tuple[ExperimentResult, float]:
    """Run a scene, a ``share`` of the part from ``start`` on; return result and processor time."""
    scene = read_scene(name)
    if element_size is not None:
        scene = with_element_size(scene, element_size)
    started = time.process_time()
    true = run_experiment(
        scene, threads=setting.threads, progress=_reporter(setting, start, share, "experiment")
    )
    return true, time.process_time() - started


def _reporter(
    setting: Setting, start: float, share: float, what: str
) -> Callable[[Progress], None]:
    def report(now: Progress) -> None:
        setting.tell(start + share * now.load, f"{what}: {now.stage}, {now.newton} iterations")

    return report


def _about(true: ExperimentResult) -> str:
    scene, elements = true.scene, true.maps.attrs["elements"]
    return (
        f"{scene.title}, compressed by {scene.compression:g} mm: layer and sample are solved "
        f"together, {elements[0]:,} and {elements[1]:,} elements of "
        f"{1e3 * scene.mesh.element_size:g} um, friction {scene.friction.window:g} at the window, "
        f"{scene.friction.sample:g} at the sample and {scene.friction.plate:g} at the plate. "
        "Stress is then computed from what OCT would see, on another grid, and compared with the "
        "true stress at the interface."
    )


def _against_published(true: ExperimentResult, setting: Setting) -> list[Row]:
    """Loaded thickness against that of the published simulation."""
    path = setting.third_party("layers/sinusoid_simulated_L1.npz")
    theirs = read_thickness_map(path, variable="L1_mm", layer_extent=(0.0, 5.0, 0.0, 5.0))
    theirs = theirs.sel(x=slice(0, 5), y=slice(0, 5))
    ours = true.maps["loaded_thickness"]
    zones = compare_maps(ours, theirs, edge_width=0.5).sel(zone="interior")
    inner = {"x": slice(0.5, 4.5), "y": slice(0.5, 4.5)}
    line = theirs.sel(inner).mean("y")
    same = ours.interp(x=theirs["x"], y=theirs["y"]).sel(inner).mean("y")
    turning = np.flatnonzero(np.diff(np.sign(np.diff(line.values)))) + 1
    extremes = float(np.abs(same.values - line.values)[turning].max())
    _draw_thickness(ours, theirs, setting)
    return [
        Row(
            "Figure 3a",
            "loaded thickness against the published simulation, interior, RMS",
            "0",
            f"{1e3 * float(zones['rms']):.1f} um (bias {1e3 * float(zones['bias']):+.1f} um)",
            "the published thickness is linear between nodes 125 um apart and was smoothed",
        ),
        Row(
            "Figure 3a",
            "the same at peaks and valleys, largest",
            "0",
            f"{1e3 * extremes:.1f} um",
            "which cuts off up to 3 um of a ridge or valley that lies between two nodes",
        ),
    ]


def _recover(
    part: Part, setting: Setting, true: ExperimentResult, figure: str, size: float
) -> None:
    """Recover the stress from the thickness, without and with noise, and say how well."""
    friction = true.scene.friction.sample
    known = f"friction {friction:g} at the sample, as the scene's, its motion known"
    blind = f"friction {friction:g} at the sample, its motion unknown"
    cases: tuple[tuple[str, str, dict[str, Any]], ...] = (
        (
            known,
            "discretisation of both; where the layer hardly slides, "
            "motion that is off by a slip length, 1 um, turns friction round",
            {"sample_motion": true.maps},
        ),
        (f"{known}, pixel noise of 1 um", "", {"sample_motion": true.maps, "noise": 1e-3}),
        (
            f"friction {friction:g} at the sample, taken to spread evenly and to keep its volume",
            "needs only the travel of the plate and the thickness of the sample",
            {"sample_motion": spreading_sample(true)},
        ),
        (
            blind,
            "the imprint stands still sideways, where the real surface spreads and takes the layer "
            "along: its friction has the wrong direction",
            {},
        ),
        (
            f"{blind}, K/mu of 20",
            "the published code's default: a compressible layer is softer, "
            "which hides much of that",
            {"bulk_to_shear": 20.0},
        ),
        (
            "no friction at the sample",
            "the paper leaves friction at the sample out (section 4)",
            {"sample_friction": 0.0},
        ),
    )
    picture = f"figure-{figure}.png"
    share = 0.5 / len(cases)
    for number, (what, why, options) in enumerate(cases):
        recovered = recovered_stress(
            true,
            element_size=size,
            threads=setting.threads,
            progress=_reporter(setting, 0.5 + number * share, share, "stress from its thickness"),
            **{"noise": 0.0, **options},
        )
        if number == 0:
            write_experiment_figure(true, setting.folder / picture, recovered)
        errors = recovery_errors(true, recovered).sel(zone="interior")
        computational, algebraic = (errors.sel(approach=a) for a in ("computational", "algebraic"))
        force = recovered.maps.attrs["sample_force_mN"] / true.maps.attrs["sample_force_mN"] - 1
        part.rows.append(
            Row(
                f"Figure {figure}",
                f"computational stress against the true one, relative RMS, {what}",
                "within 5 %",
                f"{float(computational['relative_rms']):.1%} (bias "
                f"{float(computational['relative_bias']):+.1%}, force {force:+.1%}); algebraic "
                f"{float(algebraic['relative_rms']):.0%}",
                why,
            )
        )
    part.pictures.append(
        (
            picture,
            f"True stress and that of both methods, the motion of the sample known (figure "
            f"{figure} of the paper).",
        )
    )


def _edge(stress: xr.DataArray) -> tuple[float, float]:
    """Edge response along x at the middle of the cube, mean of both sides, mm, and its level."""
    middle = 0.5 * float(stress["x"][0] + stress["x"][-1])
    line = stress.interp(y=middle)
    level = float(line.sel(x=slice(middle - 0.1, middle + 0.1)).mean())
    left = line.sel(x=slice(middle - 0.9, middle))
    right = line.sel(x=slice(middle, middle + 0.9))
    sides = edge_response(left, (0.0, level)), edge_response(right, (level, 0.0))
    return 0.5 * (sides[0].rise + sides[1].rise), level


def _time(true: ExperimentResult, seconds: float, setting: Setting) -> Row:
    count = sum(true.maps.attrs["elements"])
    return Row(
        "Section 8",
        "time of the virtual experiment",
        "15 to 30 min for 100,000 elements",
        f"{seconds:.0f} s of processor time for {count:,} elements",
        f"threads: {setting.threads or psutil.cpu_count(logical=True)}; the paper's figure is for "
        "its layer alone",
        tolerance=math.inf,
    )


def _draw_thickness(ours: xr.DataArray, theirs: xr.DataArray, setting: Setting) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    here, there = ours.interp(y=2.5), theirs.interp(y=2.5)
    top.plot(here["x"], here, color="#0072B2", label="ours")
    top.plot(there["x"], there, "k.", label="published simulation")
    difference = here.interp(x=there["x"]) - there
    bottom.plot(there["x"], 1e3 * difference, color="#0072B2", marker=".")
    top.set(ylabel="loaded thickness (mm)")
    bottom.set(xlabel="x (mm)", ylabel="difference (um)")
    top.legend(frameon=False)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    with atomic(setting.folder / "figure-3a.png", "picture") as temporary:
        figure.savefig(temporary, dpi=150)
