"""What small changes of the inputs do to the stress, the whole load path included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.mechanics.cascade import (
    LoadNotReached,
    Solution,
    coarsened,
    make_solver,
    prolong,
    solve,
)
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.neighbours import Neighbours
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.palpation.mesh_error import Quantities

Array = NDArray[np.float64]
#: Inputs, and the units of their changes.
UNITS = {
    "window_friction": "1",
    "sample_friction": "1",
    "modulus": "1",
    "thickness": "mm",
    "initial_thickness": "mm",
}
#: Changes from which derivatives are computed: so small that the solution is linear in them, so
#: large that the tolerance of the neighbours' equilibrium does not show. Thicknesses by fractions
#: of the layer's.
_FRICTION, _THICKNESS = 0.005, 0.002
#: The load path of the neighbours is followed on a grid of at most so many elements.
_PATH_ELEMENTS = 4000


def changed(problem: LayerProblem, name: str) -> tuple[LayerProblem, float]:
    """Return a problem one of whose inputs is slightly changed, and the change."""
    imprint, grid = problem.imprint, problem.grid
    if name in ("window_friction", "sample_friction"):
        friction = list(problem.friction)
        friction[name == "sample_friction"] += _FRICTION
        return replace(problem, friction=(friction[0], friction[1])), _FRICTION
    step = _THICKNESS * float(np.median(imprint.unloaded))
    if name == "thickness":
        loaded = imprint.loaded + step
        moved = Imprint(imprint.x, imprint.y, imprint.unloaded, loaded, imprint.motion)
        return replace(problem, imprint=moved), step
    unloaded = imprint.unloaded + step
    moved = Imprint(imprint.x, imprint.y, unloaded, imprint.loaded, imprint.motion)
    thicker = LayerGrid(grid.x, grid.y, grid.depth, grid.thickness + step)
    return replace(problem, imprint=moved, grid=thicker), step


def sensitivities(
    solution: Solution,
    quantities: Callable[[LayerProblem, LayerState], Quantities],
    bound_guess: Callable[[LayerProblem], Array],
    y: Array,
    x: Array,
) -> xr.Dataset:
    """Differentiate the total force and the axial stress by the inputs.

    The load path of the changed inputs is followed on a small grid, and what it leads to carried to
    the coarser grid of the solution. Derivatives are those of that grid, in proportion to the
    forces there and in the solution. With the modulus, all coefficients of the law growing by the
    same factor, force and stress grow in proportion.

    Parameters
    ----------
    quantities
        Function that returns total force and axial stress of a solution.
    bound_guess
        As for :func:`~optical_palpation.mechanics.cascade.solve`.
    y, x
        Points of the map, mm.

    Returns
    -------
    xarray.Dataset
        ``force`` (mN per unit of the input) over ``input`` and ``axial_stress`` (kPa) on
        ``(input, y, x)``; the ``unit`` of each input. The attribute ``failure`` says why there is
        only the modulus, which needs no further solution; empty where there are all.
    """
    names = [name for name in UNITS if name != "modulus"]
    glued = solution.problem.glued
    for name, stuck in zip(("window_friction", "sample_friction"), glued, strict=True):
        if stuck:
            names.remove(name)
    neighbours = Neighbours([partial(_changed, name=name) for name in names])
    _follow(solution, neighbours, bound_guess)
    force, stress = quantities(solution.problem, solution.state)
    found: dict[str, Quantities] = {"modulus": (force, stress)}
    if not neighbours.failure:
        problems, states = neighbours.problems, neighbours.states
        here = quantities(problems[0], states[0])
        scale = force / here[0] if here[0] else 1.0
        for name, problem, state in zip(names, problems[1:], states[1:], strict=True):
            factor = scale / changed(problems[0], name)[1]
            there = quantities(problem, state)
            found[name] = factor * (there[0] - here[0]), factor * (there[1] - here[1])
    order = [name for name in UNITS if name in found]
    per = "per unit of the input"
    return xr.Dataset(
        {
            "force": ("input", [found[name][0] for name in order], {"units": f"mN {per}"}),
            "axial_stress": (
                ("input", "y", "x"),
                np.array([found[name][1] for name in order]),
                {"units": f"kPa {per}"},
            ),
        },
        {
            "input": order,
            "unit": ("input", [UNITS[name] for name in order]),
            "y": ("y", y, {"units": "mm"}),
            "x": ("x", x, {"units": "mm"}),
        },
        {"failure": neighbours.failure},
    )


def _follow(
    solution: Solution, neighbours: Neighbours, bound_guess: Callable[[LayerProblem], Array]
) -> None:
    """Follow the neighbours to the coarser grid of a solution, or to its own if it has no other."""
    problem, state = solution.coarser or (solution.problem, solution.state)
    small = problem
    while small.grid.n_elements > _PATH_ELEMENTS and min(small.grid.shape[1:]) >= 12:
        small = coarsened(small)
    try:
        followed = solve(small, bound_guess, cascade=False, neighbours=neighbours)
    except LoadNotReached as failure:
        neighbours.stop(f"on {small.grid.n_elements:,} elements the layer {failure}")
        return
    if small is not problem:
        linear = make_solver(problem, "multigrid")
        neighbours.carry(prolong, followed.state, problem, linear, state)


def _changed(problem: LayerProblem, name: str) -> LayerProblem:
    return changed(problem, name)[0]
