"""From coarse to fine: the load path on a coarse grid, the finish at full load on finer ones.

A Newton step costs little on a coarse grid, so the load path is followed there. Its last two states
are carried to the next finer grid, displacement, pressure, contact forces and friction memory
together, and the last load step is repeated there from the coarse solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .direct import DirectSolver
from .grid import LayerGrid
from .krylov import MultigridSolver
from .multigrid import coarse_nodes
from .newton import Balance, LinearSolver, NotConverged, Tolerances, equilibrate
from .path import LoadNotReached, StepControl, follow
from .problem import LayerProblem, LayerState

Array = NDArray[np.float64]

#: Elements up to which a grid is the start of the cascade.
_COARSEST = 2000
#: Factor by which friction is softened while a solution changes grids.
_CHANGE_OF_GRID = 20.0
#: Newton iterations after which the exact change of grids gives way to the robust one.
_PATIENCE = 14


@dataclass
class Solution:
    """The loaded layer and the record of how it was reached.

    ``record`` lists (elements, load, Newton iterations) of every accepted equilibrium.
    """

    problem: LayerProblem
    state: LayerState
    previous: LayerState
    record: list[tuple[int, float, int]] = field(default_factory=list)

    @property
    def newton_iterations(self) -> int:
        """Newton iterations over all grids and loads."""
        return sum(entry[2] for entry in self.record)


def coarsened(problem: LayerProblem) -> LayerProblem | None:
    """Return the problem on a grid of about half as many elements each way, None at the coarsest.

    The imprint is smoothed to what the coarser elements can follow.
    """
    grid = problem.grid
    nz, ny, nx = grid.shape
    if grid.n_elements <= _COARSEST or min(nx, ny) < 12:
        return None
    sizes = grid.spacing()
    halve = [size < 1.6 * min(sizes) for size in sizes]
    k, j, i = (
        coarse_nodes(count, half and count > smallest)
        for count, half, smallest in zip((nz, ny, nx), halve, (3, 5, 5), strict=True)
    )
    coarse = LayerGrid(grid.x[i], grid.y[j], grid.depth[k], grid.thickness[np.ix_(j, i)])
    imprint = problem.imprint.smoothed(
        0.5 * float(np.sqrt(coarse.spacing()[2] * coarse.spacing()[1]))
    )
    return problem.on_grid(coarse, imprint)


def prolong(state: LayerState, coarse: LayerProblem, fine: LayerProblem) -> LayerState:
    """Interpolate a state of one grid to another grid of the same layer."""
    source, target = coarse.grid, fine.grid
    pressure = state.normal_force / source.surface_areas(source.nodes[:, -1])
    return LayerState(
        load=state.load,
        u=target.interpolate_from(source, state.u),
        p=target.interpolate_cells_from(source, state.p),
        slip=target.interpolate_from(source, state.slip),
        anchor=target.interpolate_from(source, state.anchor),
        normal_force=target.interpolate_from(source, pressure)
        * target.surface_areas(target.nodes[:, -1]),
    )


def solve(
    problem: LayerProblem,
    bound_guess: Callable[[LayerProblem], Array],
    *,
    solver: str = "multigrid",
    cascade: bool = True,
    tolerances: Tolerances | None = None,
    control: StepControl | None = None,
    on_iteration: Callable[[LayerProblem, float, int, Balance, int], None] | None = None,
) -> Solution:
    """Solve the layer problem at full load.

    Parameters
    ----------
    bound_guess
        Function of a problem that returns estimated contact forces at full load, (ny + 1, nx + 1).
    solver
        ``multigrid`` or ``direct``.
    cascade
        Follow the load path on a coarse grid first (else on the grid itself).

    Raises
    ------
    LoadNotReached
        When the full load is not reached on some grid.
    """
    tolerances = tolerances or Tolerances(force=1e-5, volume=1e-6)
    levels = [problem]
    while cascade and (coarser := coarsened(levels[-1])) is not None:
        levels.append(coarser)
    record: list[tuple[int, float, int]] = []
    state = previous = None
    for n in reversed(range(len(levels))):
        level = levels[n]
        linear = make_solver(level, solver)
        report = None
        if on_iteration:

            def report(load, iteration, now, krylov, level=level):
                on_iteration(level, load, iteration, now, krylov)

        elements = level.grid.n_elements
        if state is not None and previous is not None:
            refined = None
            for soften in (True, False):
                limit = replace(tolerances, iterations=_PATIENCE) if soften else tolerances
                try:
                    refined = _refine(
                        state, previous, levels[n + 1], level, linear, limit, report, soften
                    )
                    break
                except NotConverged:
                    continue
            if refined is not None:
                state, previous, counts = refined
                record += [(elements, load, count) for load, count in counts]
                continue
            # the coarse solution is too far away: follow the load on this grid
        state, previous, path = follow(
            level, linear, tolerances, bound_guess(level), control, report
        )
        record += [(elements, load, count) for load, count in path]
    assert state is not None
    assert previous is not None
    return Solution(problem, state, previous, record)


def _refine(
    state: LayerState,
    previous: LayerState,
    coarse: LayerProblem,
    fine: LayerProblem,
    linear: LinearSolver,
    tolerances: Tolerances,
    report: Callable[[float, int, Balance, int], None] | None,
    soften: bool,
) -> tuple[LayerState, LayerState, list[tuple[float, int]]]:
    """Repeat the last load step of ``coarse``, from ``previous`` to ``state``, on ``fine``.

    With ``soften`` the previous state is first brought into equilibrium on the fine grid; without,
    the change of grids counts as slip, which is more robust and less exact.
    """

    def reach(problem: LayerProblem, target: LayerState) -> tuple[float, int]:
        def forward(iteration: int, now: Balance, krylov: int) -> None:
            if report:
                report(target.load, iteration, now, krylov)

        return target.load, equilibrate(problem, target, linear, tolerances, forward)

    state, previous = prolong(state, coarse, fine), prolong(previous, coarse, fine)
    step = state.u - previous.u, state.p - previous.p
    counts = []
    if soften and previous.load > 0:
        # The layer moves by a few micrometres from one grid to the next. That is no slip: the
        # grids change under a friction that hardly feels it, and the memory is laid anew.
        counts.append(
            reach(replace(fine, slip_length=_CHANGE_OF_GRID * fine.slip_length), previous)
        )
        previous.anchor = np.stack([previous.u[:2, 0], previous.u[:2, -1]])
        state.u, state.p = previous.u + step[0], previous.p + step[1]
    state.slip, state.anchor = previous.slip.copy(), previous.anchor.copy()
    counts.append(reach(fine, state))
    return state, previous, counts


def make_solver(problem: LayerProblem, name: str) -> LinearSolver:
    """Return the named linear solver for a problem."""
    if name == "direct":
        return DirectSolver(problem.bulk_modulus)
    return MultigridSolver(problem.grid, problem.shear_modulus)


__all__ = ["LoadNotReached", "Solution", "make_solver", "solve"]
