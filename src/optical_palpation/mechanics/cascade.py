"""From coarse to fine: the load path is followed on a coarse grid, and ends on the finest.

A Newton step costs little on a coarse grid, so the load is followed there. The loaded layer is then
carried from grid to grid, displacement, pressure, contact forces and friction memory together, and
brought into equilibrium on each.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .contact import slip_coordinate
from .direct import DirectSolver, direct_solver
from .friction import held_fast
from .grid import LayerGrid, contact_nodes, edge_width, face_and_sides, node_positions
from .iteration import TOLERANCES, NotConverged, Tolerances, impatient, relaxed
from .krylov import MultigridSolver
from .multigrid import coarse_nodes
from .neighbours import Neighbours
from .newton import Balance, LinearSolver, LoadedLayer, Solvers, balance, equilibrate
from .path import LoadNotReached, Path, StepControl
from .problem import LayerProblem, LayerState
from .untangle import untangled

Array = NDArray[np.float64]

#: How much further from balance than the last equilibrium others may be: the full load on coarser
#: grids, and smaller loads. Where the last one is loose these are not: they would end on other
#: branches.
_COARSER, _ON_THE_WAY = 100.0, 300.0
#: The load is followed on a grid of at most this share of the finest one's elements: it must not
#: take longer than the finest. Below the first number that is not worth while; beyond the second,
#: where a path begins does not change the result.
_PATH_SHARE, _PATH_ELEMENTS = 1 / 6, (3000, 16000)
#: Elements (z, y, x) from which on a grid is made coarser along an axis.
_HALVED = (4, 6, 6)
#: Share of the contact forces that may be out of balance in a layer carried to another grid. Beyond
#: it nodes move so much that friction becomes another one: the force is off by 0.2 % at a tenth, by
#: 2 % at a fifth.
_FAR = 0.1
#: Elements up to which the load of a layer that was carried over, and finds no equilibrium, is
#: followed on that grid. It takes seconds; on finer grids drag is sooner at rest.
_QUICK = 30_000
#: Elements up to which an exact linear solver solves what the iterative one hardly does.
_EXACT = 10_000
#: Share of its smallest J that a layer must keep when it is carried to a finer grid.
_KEPT = 0.5
#: What is as good as at rest on a coarser grid, if it came there against drag: what is left is less
#: than what the next grid adds.
_RESTING = 1000.0


@dataclass
class Solution:
    """The loaded layer and the record of how it was reached.

    ``record`` lists (elements, load, Newton iterations) of every accepted equilibrium. ``coarser``
    is the fully loaded layer on the next coarser grid, where it was solved there.
    """

    problem: LayerProblem
    state: LayerState
    record: list[tuple[int, float, int]] = field(default_factory=list)
    coarser: tuple[LayerProblem, LayerState] | None = None

    @property
    def newton_iterations(self) -> int:
        """Newton iterations over all grids and loads."""
        return sum(entry[2] for entry in self.record)


def grids(problem: LayerProblem) -> list[LayerProblem]:
    """Return the problem on all grids of the cascade, the finest first."""
    few = np.clip(_PATH_SHARE * problem.grid.n_elements, *_PATH_ELEMENTS)
    levels = [problem]
    while levels[-1].grid.n_elements > few and min(levels[-1].grid.shape[1:]) >= 12:
        levels.append(coarsened(levels[-1]))
    return levels


def coarsened(problem: LayerProblem, least: tuple[int, int, int] = _HALVED) -> LayerProblem:
    """Return the problem on a grid of about half as many elements each way.

    The imprint is smoothed to what the coarser elements can follow. Axes (z, y, x) with fewer than
    ``least`` elements stay as they are; where all of them do, the problem itself is returned.
    """
    grid = problem.grid
    divisible = np.array(grid.shape) >= least
    if not divisible.any():
        return problem
    sizes = np.array(grid.spacing)
    halve = divisible & (sizes < 1.6 * sizes[divisible].min())
    depth = grid.depth[coarse_nodes(grid.shape[0], bool(halve[0]))]
    edge = edge_width(depth, float(np.median(grid.thickness)))
    y, x = (
        _coarse_axis(nodes, edge if problem.edges == "free" else None) if half else nodes
        for nodes, half in zip((grid.y, grid.x), halve[1:], strict=True)
    )
    imprint = problem.imprint.smoothed(
        0.5 * float(np.sqrt(np.median(np.diff(x)) * np.median(np.diff(y))))
    )
    unloaded = imprint.evaluate(*np.meshgrid(x, y), 0.0)[0]
    coarse = LayerGrid(x, y, depth, unloaded)
    return problem.on_grid(coarse, imprint)


def _coarse_axis(nodes: Array, edge: float | None) -> Array:
    """Node positions about twice as far apart, the outermost ones no further than ``edge``."""
    widths = np.diff(nodes)
    size = float(np.median(widths))
    if widths[:2].min() > 1.01 * size:  # a padded layer is coarse where it ends
        return nodes[coarse_nodes(len(widths), True)]
    return node_positions(float(nodes[-1] - nodes[0]), 2 * size, float(nodes[0]), edge=edge)


def prolong(state: LayerState, coarse: LayerProblem, fine: LayerProblem) -> LayerState:
    """Interpolate a state of one grid to another grid of the same layer."""
    source, target = coarse.grid, fine.grid
    pressure = state.normal_force / source.areas

    def at_contact(field: Array) -> Array:
        face, sides = face_and_sides(field, source.node_shape[1:])
        face = target.interpolate_from(source, face)
        sides = target.interpolate_sides_from(source, sides)
        return np.concatenate([face.reshape(2, 2, -1), sides], axis=-1)

    u = target.interpolate_from(source, state.u)
    p = target.interpolate_cells_from(source, state.p)
    least = _KEPT * coarse.body.forces(state.u, state.p).min_jacobian
    if fine.body.forces(u, p).min_jacobian < least:
        u = untangled(fine.body, u, least)
    return LayerState(
        load=state.load,
        u=u,
        p=p,
        slip=at_contact(held_fast(slip_coordinate(coarse, state))),
        anchor=contact_nodes(u[:2]),
        normal_force=np.maximum(target.interpolate_from(source, pressure), 0.0) * target.areas,
    )


@dataclass
class _Guide:
    """The path of a layer on a coarse grid, which its increments on a finer one follow."""

    path: list[LayerState]
    coarse: LayerProblem
    fine: LayerProblem
    prolonged: dict[int, LayerState] = field(default_factory=dict, init=False)

    def __call__(self, state: LayerState, load: float) -> LayerState:
        """Go on from a state on the fine grid to a load."""
        return state.following(self._at(state.load), self._at(load))

    def _at(self, load: float) -> LayerState:
        """The layer of the coarse grid at a load; where it moved at that load, after that."""
        after = bisect_right([state.load for state in self.path], load)
        before = self._state(after - 1)
        if before.load == load or after == len(self.path):
            return before
        return before.towards(self._state(after), load)

    def _state(self, number: int) -> LayerState:
        if number not in self.prolonged:
            while len(self.prolonged) > 2:  # those of loads that are passed
                del self.prolonged[min(self.prolonged)]
            self.prolonged[number] = prolong(self.path[number], self.coarse, self.fine)
        return self.prolonged[number]


def solve(
    problem: LayerProblem,
    bound_guess: Callable[[LayerProblem], Array],
    *,
    solver: str = "multigrid",
    cascade: bool = True,
    tolerances: Tolerances | None = None,
    control: StepControl | None = None,
    neighbours: Neighbours | None = None,
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
    neighbours
        To be followed beside it where the grid of the load path is small enough.

    Raises
    ------
    LoadNotReached
        When the full load is not reached on some grid.
    """
    tolerances, control = tolerances or TOLERANCES, control or StepControl()
    record: list[tuple[int, float, int]] = []

    least = min(tolerances, TOLERANCES, key=lambda wanted: wanted.force)
    coarser_grid, on_the_way = relaxed(least, _COARSER), relaxed(least, _ON_THE_WAY)

    def wanted(level: LayerProblem) -> Tolerances:
        return tolerances if level is problem else coarser_grid

    def resting(level: LayerProblem) -> Tolerances | None:
        return None if level is problem else relaxed(least, _RESTING)

    def balanced(level: LayerProblem, state: LayerState) -> LayerState | None:
        """Bring a state near full load into equilibrium; None where it is too far away."""
        report = partial(on_iteration, level, 1.0) if on_iteration else None
        try:
            linear = make_solver(level, solver)
            now, count = equilibrate(level, state, linear, impatient(wanted(level)), report)
        except NotConverged:
            return None
        record.append((level.grid.n_elements, 1.0, count))
        return now.state

    def settled(level: LayerProblem, state: LayerState) -> LayerState | None:
        """Let a loaded layer come to rest; None where it does not."""
        report = partial(on_iteration, level) if on_iteration else None
        layer = LoadedLayer(level, solvers(level))
        path = Path(
            layer, wanted(level), coarser_grid, state, control, report, resting=resting(level)
        )
        try:
            path.settle()
        except LoadNotReached:
            return None
        record.extend((level.grid.n_elements, *step) for step in path.record)
        return path.state

    def solvers(level: LayerProblem) -> LinearSolver | Solvers:
        given = make_solver(level, solver)
        if isinstance(given, DirectSolver) or level.grid.n_elements > _EXACT:
            return given
        return Solvers(given, make_solver(level, "direct"))

    state: LayerState | None = None
    coarser: tuple[LayerProblem, LayerState] | None = None
    levels = grids(problem) if cascade else [problem]
    followed: tuple[LayerProblem, list[LayerState]] | None = None
    for n in reversed(range(len(levels))):
        level = levels[n]
        coarser = None if state is None else (levels[n + 1], state)
        carried = None
        if state is not None:
            carried = prolong(state, levels[n + 1], level)
            near = balance(level, carried).force_error < _FAR
            state = balanced(level, carried) if near else None
            if state is None and near and level.grid.n_elements > _QUICK:
                state = settled(level, carried)
        if state is None:  # the load is followed on this grid
            rest = LayerState.unloaded(level.grid)
            full = replace(rest, load=1.0, normal_force=rest.normal_force + bound_guess(level))
            report = partial(on_iteration, level) if on_iteration else None
            few = neighbours is not None and level.grid.n_elements <= neighbours.most
            beside = neighbours if few else None
            if beside:
                beside.begin(level, rest, make_solver(level, solver))
            layer = LoadedLayer(level, solvers(level))
            visited: list[LayerState] = []
            path = Path(
                layer,
                wanted(level),
                on_the_way,
                rest,
                control,
                report,
                resting=resting(level),
                guide=_Guide(followed[1], followed[0], level) if followed else None,
                visited=None if level is problem else visited,
            )
            try:
                path.follow(full, beside=beside)
                followed = level, visited
            except LoadNotReached:
                if beside:
                    beside.stop("the load was not reached")
                if carried:
                    state = settled(level, carried)
                if state is None and level is problem:
                    raise
                # what a coarse grid cannot bear a finer one may
            else:
                state = path.state
                record += [(level.grid.n_elements, *step) for step in path.record]
    assert state is not None  # there is at least one level
    return Solution(problem, state, record, coarser)


def make_solver(problem: LayerProblem, name: str) -> LinearSolver:
    """Return the named linear solver for a problem."""
    if name == "direct":
        return direct_solver(problem)
    return MultigridSolver(problem.grid, problem.shear_modulus, problem.edges == "free")


__all__ = ["LoadNotReached", "Solution", "make_solver", "prolong", "solve"]
