"""Layers in plane strain, their free side resolved, against an independent code."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.files import replacing
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import LoadNotReached, Solution, solve
from optical_palpation.mechanics.grid import (
    LayerGrid,
    depth_positions,
    edge_width,
    node_positions,
)
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.path import StepControl
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem
from optical_palpation.mechanics.side_contact import side_contact
from optical_palpation.palpation.meshing import expected_forces
from optical_palpation.reproduce.record import Part, Row, Setting
from optical_palpation.reproduce.verification.layers import error

Array = NDArray[np.float64]
#: What the names of the references stand for, in the order of the table.
TITLES = {
    "slab": "flat slab pressed by 42 %",
    "ridges": "ridges",
    "stuck": "layer glued to both faces, pressed by 10 %",
}
#: Loaded thickness, mm, over the distance from the middle, by its formula in the reference's file.
FORMULAS: dict[str, Callable[[Array], Array]] = {
    "0.2771394": lambda x: np.full_like(x, 0.2771394),
    "0.45": lambda x: np.full_like(x, 0.45),
    "0.46 + 0.05 * cos(2 * pi * x)": lambda x: 0.46 + 0.05 * np.cos(2 * np.pi * x),
    "0.43 - 0.04 * tanh((1 - x) / 0.05)": lambda x: 0.43 - 0.04 * np.tanh((1 - x) / 0.05),
}
#: Load steps whose scatter of the force is shown.
_SHORT_STEPS = 0.05, 0.04, 0.03, 0.02, 0.01
#: Distance between the points at which the formula of an imprint is evaluated, mm.
_PIXEL = 0.0025


@dataclass(frozen=True)
class Reference:
    """What a file of ``benchmarks/references.py`` says; forces in mN per mm, half the layer.

    ``error`` is the relative change of the force by the last refinement, by half the load steps and
    by contact of infinite stiffness, added up; ``pressure`` the mean contact pressure, kPa, up to
    each of ``bounds``, mm.
    """

    about: dict[str, Any]
    force: float
    error: float
    bounds: Array
    pressure: Array

    @property
    def loaded(self) -> Callable[[Array], Array]:
        """Loaded thickness, mm, over the distance from the middle, mm."""
        return FORMULAS[self.about["loaded_thickness_mm"]]


def read_reference(path: Path) -> Reference:
    """Read a reference.

    Raises
    ------
    InputError
        If it is not there.
    """
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except OSError as failure:
        raise InputError(
            f"{path}: the reference cannot be read ({failure.strerror or failure}); it lies in "
            "tests/data/references of the repository (--references)"
        ) from None
    forces = about["force_of_half_the_layer_mN_per_mm"]
    changes = about["relative_change_of_force_on_the_first_mesh_with"]
    steps, contact = (
        changes[what] for what in ("half_the_load_steps", "a_quarter_of_the_contact_stiffness")
    )
    return Reference(
        about,
        forces[-1],
        # a penalty lets contact sink in as the inverse of its stiffness: a third is still to come
        abs(forces[-1] / forces[-2] - 1) + abs(steps) + abs(contact) / 3,
        np.array(about["pressure_bin_ends_mm"]),
        np.array(about["contact_pressure_kPa"]),
    )


def solve_strip(reference: Reference, size: float, largest_step: float = 0.04) -> Solution:
    """Our solution: half the layer, one element along y between two planes of symmetry.

    Elements are those of :func:`~optical_palpation.palpation.computational_stress` with this
    ``element_size``, mm, with a node in the middle; no load step is longer than ``largest_step``.

    Raises
    ------
    ConvergenceError
        If the full load is not reached.
    """
    about = reference.about
    thickness, half = about["thickness_mm"], about["half_width_mm"]
    depth = depth_positions(size / thickness, free_edges=True)
    edge = edge_width(depth, thickness)
    widths = np.diff(node_positions(2 * half, size, edge=edge))
    outer = widths[: widths.size // 2][widths[: widths.size // 2] < 0.99 * np.median(widths)]
    inner = half - outer.sum()
    x = np.linspace(0.0, inner, round(inner / size) + 1)
    x = np.concatenate([x, inner + np.cumsum(outer[::-1])])
    y = np.array([0.0, size])
    pixels = np.arange(-half, 2 * half, _PIXEL)
    beside = np.linspace(-size, 2 * size, 4)
    loaded = np.tile(reference.loaded(np.abs(pixels)), (4, 1))
    held = [about[f"{face}_friction"] for face in ("window", "sample")]
    law = MooneyRivlin(about["c10_kPa"], about["c01_kPa"], about["bulk_to_shear"])
    problem = LayerProblem(
        LayerGrid(x, y, depth, np.full((2, x.size), thickness)),
        Imprint(pixels, beside, np.full_like(loaded, thickness), loaded),
        law,
        (0.0 if held[0] == "glued" else held[0], 0.0 if held[1] == "glued" else held[1]),
        mirrors=(True, True, True, False),
        slip_length=about["slip_length_mm"],
        glued=(held[0] == "glued", held[1] == "glued"),
    )
    try:
        return solve(
            problem,
            lambda level: expected_forces(level, law),
            solver="direct",
            cascade=False,
            control=StepControl(first=min(largest_step, StepControl.first), largest=largest_step),
        )
    except LoadNotReached as failure:
        raise ConvergenceError(f"{size:g} mm: {failure}") from None


def strip_force(solution: Solution) -> float:
    """Force on the imprint, mN per mm along y."""
    sides = side_contact(solution.problem, solution.state).normal_force[SAMPLE].sum()
    width = np.ptp(solution.problem.grid.y)
    return float((solution.state.normal_force[SAMPLE].sum() + sides) / width)


def strip_pressure(solution: Solution, bounds: Array) -> Array:
    """Mean contact pressure of the imprint up to each of ``bounds`` (mm, from 0), kPa."""
    grid = solution.problem.grid
    x = grid.x + solution.state.u[0, -1].mean(0)
    force = solution.state.normal_force[SAMPLE].sum(0) / np.ptp(grid.y)
    middles = np.concatenate([x[:1], 0.5 * (x[1:] + x[:-1]), x[-1:]])
    total = np.concatenate([[0.0], np.cumsum(force)])
    ends = np.concatenate([[0.0], bounds])
    return np.diff(np.interp(ends, middles, total)) / np.diff(ends)


def strips(setting: Setting) -> Part:
    """Force and contact pressure of every reference on two meshes."""
    folder = setting.references
    if folder is None:
        raise InputError("the references of independent codes are not there (--references)")
    part = Part(
        "Half of a layer in plane strain, one side free, under an imprint given by a formula in "
        "the reference's file. The references come from NGSolve, with triangles of Taylor-Hood "
        "type that become small towards the corners of the free side and contact at integration "
        "points (`benchmarks/references.py`, `tests/data/references`); their own error, by "
        "the change of mesh, load steps and penalty, stands in the remarks. The slab is a flat "
        "imprint, the ridges are $L_1 = 0.46 + 0.05 \\cos 2 \\pi x$ on a layer of 0.5 mm, $x$ from "
        "the middle, 2.5 mm to the side. Ours are meshes as of "
        "`--element-size`, one element along y, loaded in steps of at most 4 % as theirs. The side "
        "rolls onto the window; the remarks say what the reference finds without friction there."
    )
    sizes = (0.25, 0.125) if setting.quick else (0.125, 0.0625, 0.03125)
    meshes = ", ".join(f"{1e3 * size:g}" for size in sizes)
    pictures = {}
    for number, (name, title) in enumerate(TITLES.items()):
        reference = read_reference(folder / f"{name}.json")
        forces, differences = [], []
        for step, size in enumerate(sizes):
            setting.tell((number + step / len(sizes)) / len(TITLES), f"{title}, {1e3 * size:g} um")
            try:
                solution = solve_strip(reference, size)
            except ConvergenceError as failure:
                forces.append(f"not reached ({failure})")
                continue
            force = strip_force(solution)
            forces.append(f"{force:.4g} ({error(force, reference.force)})")
            if reference.bounds.size:
                ours = strip_pressure(solution, reference.bounds)
                difference = np.linalg.norm(ours - reference.pressure)
                differences.append(difference / np.linalg.norm(reference.pressure))
                pictures[title] = reference, ours
        about = reference.about
        code = ", ".join(f"{code} {version}" for code, version in about["codes"].items())
        changes = about["relative_change_of_force_on_the_first_mesh_with"]
        remarks = [f"theirs: {reference.error:.1%}"]
        if (slippery := changes.get("no_friction_on_the_free_side")) is not None:
            remarks.append(f"without friction on the free side {slippery:+.1%}")
        if (shorter := changes.get("a_quarter_of_the_slip_length")) is not None:
            remarks.append(f"with a quarter of the slip length {shorter:+.1%}")
        part.rows.append(
            Row(
                code,
                f"{title}, {_held(about)}: force at {meshes} um, mN/mm",
                f"{reference.force:.4g}",
                ", ".join(forces),
                "; ".join(remarks),
            )
        )
        if name == "slab":
            tell = partial(setting.tell, (number + 1) / len(TITLES))
            part.rows += _by_load_steps(code, title, reference, sizes, tell, setting.quick)
        if differences:
            part.rows.append(
                Row(
                    code,
                    f"{title}: contact pressure, relative RMS difference at {meshes} um",
                    "0",
                    ", ".join(f"{100 * d:.2g} %" for d in differences),
                    "means over 0.1 mm",
                )
            )
    _draw(pictures, setting.folder / "strips.png")
    part.pictures.append(
        ("strips.png", "Contact pressure under the imprint: NGSolve (dots) and ours (lines).")
    )
    return part


def _by_load_steps(
    code: str,
    title: str,
    reference: Reference,
    sizes: Sequence[float],
    tell: Callable[[str], None],
    quick: bool,
) -> list[Row]:
    """How the force depends on the load steps: friction remembers the path."""

    def force_at(size: float, step: float) -> float:
        tell(f"{title}, {1e3 * size:g} um, load steps of {step:.0%}")
        return strip_force(solve_strip(reference, size, step))

    longest = StepControl.largest
    force = force_at(sizes[0], longest)
    rows = [
        Row(
            code,
            f"{title}: the same at {1e3 * sizes[0]:g} um in load steps of at most {longest:.0%}, "
            "as by default, mN/mm",
            f"{reference.force:.4g}",
            f"{force:.4g} ({error(force, reference.force)})",
            "shorter where a step takes more than two or three iterations",
        )
    ]
    if quick:
        return rows
    shorter = [force_at(sizes[1], step) for step in _SHORT_STEPS]
    least, most = min(shorter), max(shorter)
    steps = [f"{100 * step:g}" for step in _SHORT_STEPS]
    rows.append(
        Row(
            code,
            f"{title}: the same at {1e3 * sizes[1]:g} um in load steps of at most "
            f"{', '.join(steps[:-1])} and {steps[-1]} %, mN/mm",
            f"{reference.force:.4g}",
            f"{least:.4g} ({error(least, reference.force)}) to {most:.4g} "
            f"({error(most, reference.force)})",
            "friction remembers the path, and within a load step that is taken as straight",
        )
    )
    return rows


def _held(about: dict[str, Any]) -> str:
    held = [about[f"{face}_friction"] for face in ("window", "sample")]
    if held == ["glued", "glued"]:
        return "no slip"
    return " and ".join(f if f == "glued" else f"friction {f:g}" for f in held)


def _draw(pictures: dict[str, tuple[Reference, Array]], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = (len(pictures) + 1) // 2
    figure = Figure(figsize=(7.0, 2.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (title, (reference, ours)) in enumerate(pictures.items()):
        axes = figure.add_subplot(rows, 2, number + 1)
        middle = reference.bounds - 0.5 * reference.bounds[0]
        axes.plot(middle, reference.pressure, "k.", markersize=4)
        axes.plot(middle, ours, color="#0072B2", linewidth=1.2)
        axes.set_title(title, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    figure.supxlabel("distance from the middle (mm)", fontsize=8)
    figure.supylabel("contact pressure (kPa)", fontsize=8)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")
