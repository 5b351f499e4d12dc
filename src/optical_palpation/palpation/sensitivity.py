"""What small changes of the inputs do to the stress, the whole load path included.

So it is told, too, what part of the force is due to the model of the rim: a free side that rolls
onto window or sample is caught before it touches (``mechanics.side_contact``), or Newton's method
would not get past the moment at which it does. The reach of that is a share of an element's height.
"""

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
    patience_with,
    solve,
)
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.neighbours import PATIENCE, Neighbours
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.side_contact import outermost_height, side_contact
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
#: of the layer's, the reach of the sides by one of itself.
_FRICTION, _THICKNESS, _REACH = 0.005, 0.002, -0.1
#: Elements of the largest grid on which the load path of the neighbours is followed.
_PATH_ELEMENTS = 4000


def changed(problem: LayerProblem, name: str) -> tuple[LayerProblem, float]:
    """Return a problem one of whose inputs is slightly changed, and the change."""
    imprint, grid = problem.imprint, problem.grid
    if name == "side_reach":
        return replace(problem, side_reach=problem.side_reach + _REACH), _REACH
    if name in ("window_friction", "sample_friction"):
        friction = list(problem.friction)
        friction[name == "sample_friction"] += _FRICTION
        return replace(problem, friction=(friction[0], friction[1])), _FRICTION
    step = _THICKNESS * float(np.median(imprint.unloaded))
    if name == "thickness":
        # thinner, so that both thicknesses press the layer more: the layer gains contact, and an
        # error of the one does as much as that of the other where the layer is hardly pressed
        loaded = imprint.loaded - step
        return replace(problem, imprint=replace(imprint, loaded=loaded)), -step
    unloaded = imprint.unloaded + step
    moved = replace(imprint, unloaded=unloaded)
    thicker = LayerGrid(grid.x, grid.y, grid.depth, grid.thickness + step)
    return replace(problem, imprint=moved, grid=thicker), step


def changes(problem: LayerProblem) -> Neighbours:
    """Return the problems with a slightly changed input, to be followed beside a solution."""
    return Neighbours(
        [partial(_changed, name=name) for name in _varied(problem)], most=_PATH_ELEMENTS
    )


def _varied(problem: LayerProblem) -> list[str]:
    names = [name for name in UNITS if name != "modulus"]
    for name, stuck in zip(("window_friction", "sample_friction"), problem.glued, strict=True):
        if stuck:
            names.remove(name)
    return [*names, "side_reach"] if problem.edges == "free" else names


def _changed(problem: LayerProblem, name: str) -> LayerProblem:
    return changed(problem, name)[0]


def sensitivities(
    solution: Solution,
    neighbours: Neighbours,
    quantities: Callable[[LayerProblem, LayerState], Quantities],
    bound_guess: Callable[[LayerProblem], Array],
    y: Array,
    x: Array,
) -> xr.Dataset:
    """Differentiate the total force and the axial stress by the inputs.

    The load path of the changed inputs is followed on a small grid. Derivatives are those of that
    grid, in proportion to the forces there and in the solution. With the modulus, all coefficients
    of the law growing by the same factor, force and stress grow in proportion.

    Parameters
    ----------
    neighbours
        The ``changes`` of the problem, which were beside it when it was solved.
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
        only the modulus, which needs no further solution; empty where there are all. The attribute
        ``force_rim_model_mN`` is the part of the force that is due to the model of the rim, to
        first order, positive where that makes the layer stiffer.
    """
    _follow(solution, neighbours, bound_guess)
    force, stress = quantities(solution.problem, solution.state)
    found: dict[str, Quantities] = {"modulus": (force, stress)}
    attributes: dict[str, str | float] = {"failure": neighbours.failure}
    if solution.problem.edges != "free":
        attributes["force_rim_model_mN"] = 0.0
    if not neighbours.failure:
        problems, states = neighbours.problems, neighbours.states
        here = quantities(problems[0], states[0])
        scale = force / here[0] if here[0] else 1.0
        names = _varied(solution.problem)
        for name, problem, state in zip(names, problems[1:], states[1:], strict=True):
            step = changed(problems[0], name)[1]
            there = quantities(problem, state)
            if name == "side_reach":
                whole = (there[0] - here[0]) / step
                attributes["force_rim_model_mN"] = _rim_effect(solution, problems[0], whole)
                continue
            factor = scale / step
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
        attributes,
    )


def _rim_effect(solution: Solution, coarser: LayerProblem, effect: float) -> float:
    """Carry the effect of the model of the rim over from a grid, in proportion to its reach."""
    problem = solution.problem
    caught = side_contact(problem, solution.state).normal_force.any()
    if not caught:
        return 0.0
    reach, there = (outermost_height(each.grid).mean() for each in (problem, coarser))
    return float(effect * reach / there)


def _follow(
    solution: Solution, neighbours: Neighbours, bound_guess: Callable[[LayerProblem], Array]
) -> None:
    """Follow the neighbours on a small grid, unless they were beside the solution on one."""
    if neighbours.begun:
        return
    small = solution.problem
    while small.grid.n_elements > neighbours.most and min(small.grid.shape[1:]) >= 12:
        small = coarsened(small)
    neighbours.most = small.grid.n_elements
    # a path for them alone must not take longer than the solution, or with edges of another kind
    patience = min(patience_with(small), max(PATIENCE, solution.effort.spent))
    try:
        solve(
            small,
            bound_guess,
            cascade=False,
            neighbours=neighbours,
            patience=patience,
            other_edges=False,
        )
    except LoadNotReached as failure:
        neighbours.stop(f"on {small.grid.n_elements:,} elements the layer {failure}")
