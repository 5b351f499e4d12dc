"""A part of a layer on finer elements than the whole, with the whole's solution at its sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .border import Surroundings
from .cascade import Solution, make_solver, prolong
from .grid import LayerGrid
from .iteration import TOLERANCES, NotConverged, impatient, relaxed
from .multigrid import coarse_nodes
from .newton import Balance, LoadedLayer, equilibrate
from .path import LoadNotReached, Path
from .problem import SAMPLE, LayerProblem, LayerState

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
Report = Callable[[LayerProblem, float, int, Balance, int], None]

#: Stiffness of what is around the part, in shear moduli per thickness.
_STIFFNESS = 4.0
#: Tension of the membrane on its cut sides, in shear moduli times thickness.
_TENSION = 0.5
#: Elements that much finer than those of the whole are reached in more than one step.
_STEP = 3.0
#: How much further from equilibrium the part may be left on coarser elements.
_ON_THE_WAY = 20.0


def part_of(
    fine: LayerProblem,
    coarse: LayerProblem,
    state: LayerState,
    bounds: Bounds,
) -> LayerProblem:
    """Return the part of a problem within bounds, held at its sides by the whole's solution.

    Parameters
    ----------
    fine
        The whole layer on fine elements, which need not be solvable.
    coarse, state
        The same layer on coarser elements, and its solution at full load.
    bounds
        x0, x1, y0, y1 of the part in the unloaded layer, mm; widened to whole elements.
    """
    thickness = coarse.grid.typical_thickness
    surroundings = Surroundings(
        coarse.grid,
        state.u,
        coarse.body.stress(state.u, state.p),
        _STIFFNESS * coarse.shear_modulus / thickness,
        _TENSION * coarse.shear_modulus * thickness,
        (coarse.grid.x[0], coarse.grid.x[-1], coarse.grid.y[0], coarse.grid.y[-1]),
    )
    grid = _cut(fine.grid, bounds)
    return replace(fine, grid=grid, surroundings=surroundings.near(grid))


def solve_part(
    part: LayerProblem,
    coarse: LayerProblem,
    state: LayerState,
    region: Bounds,
    nearer: Bounds,
    on_iteration: Report | None = None,
) -> tuple[Solution, float]:
    """Solve a part of a layer, from the solution of the whole on.

    Parameters
    ----------
    part
        From :func:`part_of`.
    coarse, state
        The whole layer on coarser elements, and its solution at full load.
    region
        x0, x1, y0, y1 of what is wanted of the part, in the unloaded layer, mm.
    nearer
        Bounds of a smaller part around that region, likewise.
    on_iteration
        Called with the problem, the load, the number of the iteration, its balance and the Krylov
        iterations.

    Returns
    -------
    tuple
        The solution, and how much the cut sides matter: the change of contact pressure in the
        region, on elements of twice the size, when the part ends at the nearer bounds along x, and
        that along y (root mean squares, as fractions of that pressure, added). What the whole's
        shear gets wrong at the sides fades inwards; its pressure there does not, and the three
        parts are as many samples of it.

    Raises
    ------
    LoadNotReached
        When the part does not come to rest.
    """
    levels = [part, _coarsened(part)]
    while _size(coarse.grid) > _STEP * _size(levels[-1].grid):
        levels.append(_coarsened(levels[-1]))
    record: list[tuple[int, float, int]] = []
    error, before = 0.0, coarse
    for level in reversed(levels):
        grid = level.grid
        carried = prolong(state, before, level)
        state = _at_rest(level, carried, level is part, record, on_iteration)
        if level is levels[1]:
            wide = grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]
            for bounds in ((*nearer[:2], *wide[2:]), (*wide[:2], *nearer[2:])):
                smaller = replace(level, grid=_cut(grid, bounds))
                start = prolong(state, level, smaller)
                other = _at_rest(smaller, start, False, record, on_iteration)
                one, two = (
                    _pressure(at, found, region) for at, found in ((level, state), (smaller, other))
                )
                size = max(float(np.linalg.norm(one)), 1e-30)
                error += float(np.linalg.norm(two - one)) / size
        before = level
    return Solution(part, state, record), error


def _at_rest(
    level: LayerProblem,
    state: LayerState,
    last: bool,
    record: list[tuple[int, float, int]],
    on_iteration: Report | None,
) -> LayerState:
    """Bring a state at full load into equilibrium, against drag if need be."""
    loose = relaxed(TOLERANCES, _ON_THE_WAY)
    wanted = TOLERANCES if last else loose
    linear = make_solver(level, "multigrid")
    report = partial(on_iteration, level) if on_iteration else None
    try:
        at_load = partial(report, 1.0) if report else None
        now, count = equilibrate(level, state, linear, impatient(wanted), at_load)
    except NotConverged:
        path = Path(LoadedLayer(level, linear), wanted, loose, state, report=report)
        path.settle()
        record.extend((level.grid.n_elements, *step) for step in path.record)
        return path.state
    record.append((level.grid.n_elements, 1.0, count))
    return now.state


def _pressure(problem: LayerProblem, state: LayerState, region: Bounds) -> Array:
    """Contact pressure at the nodes of a region, per unloaded area, kPa."""
    x0, x1, y0, y1 = region
    x, y = _within(problem.grid.x, x0, x1), _within(problem.grid.y, y0, y1)
    return state.normal_force[SAMPLE][y, x] / problem.grid.areas[y, x]


def _cut(grid: LayerGrid, bounds: Bounds) -> LayerGrid:
    """Return the part of a grid within bounds, widened to whole elements."""
    x0, x1, y0, y1 = bounds
    x, y = _within(grid.x, x0, x1), _within(grid.y, y0, y1)
    return LayerGrid(grid.x[x], grid.y[y], grid.depth, grid.thickness[y, x])


def _within(nodes: Array, low: float, high: float) -> slice:
    """The nodes from the last one at or before ``low`` to the first at or beyond ``high``."""
    slack = 1e-6 * (nodes[-1] - nodes[0])
    first = int(np.searchsorted(nodes, low + slack, side="right")) - 1
    last = int(np.searchsorted(nodes, high - slack, side="left"))
    return slice(max(first, 0), min(last, len(nodes) - 1) + 1)


def _size(grid: LayerGrid) -> float:
    return float(np.sqrt(grid.spacing[1] * grid.spacing[2]))


def _coarsened(problem: LayerProblem) -> LayerProblem:
    """Return the problem on every second node along each axis, with an imprint to match."""
    grid = problem.grid
    z, y, x = (nodes[coarse_nodes(len(nodes) - 1, len(nodes) > 4)] for nodes in grid.node_axes)
    imprint = problem.imprint.smoothed(0.5 * 2 * _size(grid))
    unloaded = imprint.evaluate(*np.meshgrid(x, y), 0.0)[0]
    return problem.on_grid(LayerGrid(x, y, z, unloaded), imprint)


__all__ = ["Bounds", "LoadNotReached", "part_of", "solve_part"]
