"""From coarse to fine: the load path is followed on a coarse grid, and ends on the finest.

A Newton step costs little on a coarse grid, so the load is followed there. The loaded layer is then
carried from grid to grid, displacement, pressure, contact forces and friction memory together, and
brought into equilibrium on each.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .contact import remember_slip, slip_coordinate
from .direct import DirectSolver, direct_solver
from .effort import Effort, counted
from .friction import held_fast
from .grid import LayerGrid, contact_nodes, edge_width, face_and_sides, node_positions
from .imprint import Imprint
from .iteration import TOLERANCES, NotConverged, Tolerances, impatient, nearly_met, relaxed
from .krylov import MultigridSolver
from .multigrid import coarse_nodes
from .neighbours import Neighbours
from .newton import (
    CARRIED,
    FINE,
    SLOW,
    Balance,
    LinearSolver,
    LoadedLayer,
    Solvers,
    balance,
    equilibrate,
)
from .path import (
    FOLLOWED,
    NEARLY,
    SLID_AWAY,
    SLIDES,
    SNAPS,
    Guide,
    LoadNotReached,
    Path,
    StepControl,
)
from .problem import LayerProblem, LayerState
from .similar import Similar
from .untangle import untangled

Array = NDArray[np.float64]

#: How much further from balance than the last equilibrium others may be: the full load on coarser
#: grids, and smaller loads. Where the last one is loose these are not: they would end on other
#: branches.
_COARSER, _ON_THE_WAY = 20.0, 60.0
#: The same of a layer that is guided by a similar one. What the guide leaves of its own differs by
#: more than that.
_GUIDED = 2.0
#: The load is followed on a grid of at most this share of the finest one's elements: it must not
#: take longer than the finest. Below the first number that is not worth while; beyond the second,
#: where a path begins does not change the result.
_PATH_SHARE, _PATH_ELEMENTS = 1 / 6, (3000, 16000)
#: Share of a grid's elements that the next coarser one may have, or it is not worth while.
_FEWER = 0.55
#: Elements (z, y, x) from which on a grid is made coarser along an axis.
_HALVED = (4, 6, 6)
#: Share of the contact forces that may be out of balance in a layer carried to another grid. Beyond
#: it nodes move so much that friction becomes another one: the force is off by 0.2 % at a tenth, by
#: 2 % at a fifth.
_FAR = 0.1
#: The same at a smaller load, from which it is then followed on that grid: what slides on mends its
#: friction, but much that has turned round costs iterations.
_FAR_BEFORE = 0.07
#: How much larger the residual of linear systems may be when a layer of no more than ``FINE``
#: elements is carried to another grid. Newton's method hardly takes more iterations for it; with
#: more elements it may, and each of them costs as much as many of the linear solver.
_ROUGHLY = 2.0
#: Newton iterations in which the load must be followed on the finest grid, where that takes
#: seconds, and on coarser ones without narrow elements. Hard layers come nearer all the time and
#: want many; with narrow edges more of them gain little on coarse grids.
_ITERATIONS = 1000
#: Effort, s, after which the load of a layer of so many elements is followed no further, in
#: proportion on more; the share of it after which coarse free edges are tried; how much more
#: than that a loaded layer may take to come to rest, and one on a coarser grid if all else failed.
_PATIENCE, _PATIENT, _NARROW, _AT_LAST, _LATE = 45.0, 8000, 0.25, 1.05, 1.2
#: How many times what was spent until then the load may take to follow on a fine grid to which the
#: layer could not be carried over; and the elements beyond which that takes so long that a layer is
#: taken as it is if what is left changes its force by no more than ``NEARLY[1]``.
_AGAIN, _HUGE = 5.0, 2_000_000
#: Elements up to which an exact linear solver solves what the iterative one hardly does.
_EXACT = 10_000
#: Share of its smallest J that a layer must keep when it is carried to a finer grid.
_KEPT = 0.5
#: By how much the outermost elements become narrower at a time; how wide they may be at first, in
#: those inside, to be worth another solution; and from which share on they are no narrower.
_QUARTER, _NARROWER, _PLAIN = 4, 0.5, 0.9
#: What is as good as at rest on a coarser grid, if it came there against drag: what is left is less
#: than what the next grid adds.
_RESTING = 200.0


@dataclass
class Solution:
    """The loaded layer and the record of how it was reached.

    ``record`` lists (elements, load, Newton iterations) of every accepted equilibrium. ``coarser``
    is the fully loaded layer on the next coarser grid, where it was solved there. ``tolerances``
    are what the layer was to be brought to, ``guided`` says whether by a similar one. ``wider`` is
    the solution on the same elements, but for those at free edges, which are at least twice as
    wide; None where it was not needed. ``effort`` is what was spent on all of it.
    """

    problem: LayerProblem
    state: LayerState
    record: list[tuple[int, float, int]] = field(default_factory=list)
    coarser: tuple[LayerProblem, LayerState] | None = None
    tolerances: Tolerances = TOLERANCES
    guided: bool = False
    wider: Solution | None = None
    effort: Effort = field(default_factory=Effort)

    @property
    def newton_iterations(self) -> int:
        """Newton iterations over all grids and loads."""
        return sum(entry[2] for entry in self.record)


class OnlyOnCoarser(LoadNotReached):
    """The full load was reached on coarser elements only; carries the ``solution`` there.

    ``at_edges`` says that these are coarser at free edges alone.
    """

    def __init__(self, failure: LoadNotReached, solution: Solution, at_edges: bool = False) -> None:
        super().__init__(failure.load, failure.reason)
        self.solution = solution
        self.at_edges = at_edges


def grids(problem: LayerProblem) -> list[LayerProblem]:
    """Return the problem on all grids of the cascade, the finest first."""
    few = np.clip(_PATH_SHARE * problem.grid.n_elements, *_PATH_ELEMENTS)
    levels = [problem]
    while levels[-1].grid.n_elements > few and min(levels[-1].grid.shape[1:]) >= 12:
        coarse = coarsened(levels[-1])
        if coarse.grid.n_elements > _FEWER * levels[-1].grid.n_elements:
            break  # most elements are those of the free edges, which stay
        levels.append(coarse)
    return levels


def with_edges(problem: LayerProblem, edge: float | None) -> LayerProblem:
    """Return a problem with free edges of outermost elements of a width, mm.

    With None they are as wide as those inside. Axes along which they are that already stay as they
    are.
    """
    grid = problem.grid
    y, x = (
        node_positions(float(nodes[-1] - nodes[0]), _inner_size(nodes), float(nodes[0]), edge=edge)
        if _narrow_ends(nodes)
        else nodes
        for nodes in (grid.y, grid.x)
    )
    return _remeshed(problem, x, y, grid.depth, problem.imprint)


def _narrow_edges(problem: LayerProblem) -> bool:
    """Whether elements at free edges are narrower than those inside.

    So may be those at the ends of a padded layer, where elements inside are many thicknesses wide;
    but they are wider than the layer is thick.
    """
    grid = problem.grid
    ends = zip((grid.y, grid.x), grid.edge_widths, strict=True)
    narrow = (_narrow_ends(nodes) and edge < grid.typical_thickness for nodes, edge in ends)
    return problem.edges == "free" and any(narrow)


def _narrow_ends(nodes: Array) -> bool:
    return bool(nodes[1] - nodes[0] < _PLAIN * _inner_size(nodes))


def _edge_widths(problem: LayerProblem) -> list[float]:
    """Widths of outermost elements, mm, from coarse ones on, each a quarter of the one before."""
    inside = max(_inner_size(nodes) for nodes in (problem.grid.y, problem.grid.x))
    widths = [edge_width(problem.grid.depth, problem.grid.typical_thickness)]
    while _QUARTER * widths[-1] <= _NARROWER * inside:
        widths.append(_QUARTER * widths[-1])
    return widths[::-1]


def coarsened(problem: LayerProblem) -> LayerProblem:
    """Return the problem on a grid of about half as many elements each way.

    Axes of few or of long elements stay as they are; where all of them do, the problem itself is
    returned.
    """
    divisible = np.array(problem.grid.shape) >= _HALVED
    if not divisible.any():
        return problem
    sizes = np.array(problem.grid.spacing)
    return halved(problem, divisible & (sizes < 1.6 * sizes[divisible].min()))


def halved(problem: LayerProblem, halve: NDArray[np.bool_]) -> LayerProblem:
    """Return the problem on about half as many elements along some of the axes (z, y, x).

    Where elements become longer the imprint is smoothed to what they can follow.
    """
    grid = problem.grid
    depth = grid.depth[coarse_nodes(grid.shape[0], bool(halve[0]))]
    edge = edge_width(depth, grid.typical_thickness)
    y, x = (
        _coarse_axis(nodes, edge if problem.edges == "free" else None) if half else nodes
        for nodes, half in zip((grid.y, grid.x), halve[1:], strict=True)
    )
    if not halve[1:].any():
        return problem.on_grid(LayerGrid(x, y, depth, grid.thickness))
    imprint = problem.imprint.smoothed(0.5 * float(np.sqrt(_inner_size(x) * _inner_size(y))))
    return _remeshed(problem, x, y, depth, imprint)


def _remeshed(
    problem: LayerProblem, x: Array, y: Array, depth: Array, imprint: Imprint
) -> LayerProblem:
    """Return the problem on other nodes, as thick there as its imprint is unloaded."""
    unloaded = imprint.evaluate(*np.meshgrid(x, y), 0.0)[0]
    return problem.on_grid(LayerGrid(x, y, depth, unloaded), imprint)


def _coarse_axis(nodes: Array, edge: float | None) -> Array:
    """Node positions about twice as far apart, the outermost ones no further than ``edge``."""
    widths = np.diff(nodes)
    size = _inner_size(nodes)
    if widths[:2].min() > 1.01 * size:  # a padded layer is coarse where it ends
        return nodes[coarse_nodes(len(widths), True)]
    if edge is not None and widths[0] > 1.5 * edge:  # free edges were left coarse
        edge = float(widths[0]) if _narrow_ends(nodes) else None
    length = float(nodes[-1] - nodes[0])
    # longer ones would leave no room for those between the edges
    return node_positions(length, min(2 * size, 0.25 * length), float(nodes[0]), edge=edge)


def _inner_size(nodes: Array) -> float:
    """Size of the elements within the field of view: at its ends there may be more of another."""
    widths = np.diff(nodes)
    return float(widths[len(widths) // 2])


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


def _guide(path: list[LayerState], coarse: LayerProblem, fine: LayerProblem) -> Guide[LayerState]:
    """The path of a layer on a coarse grid, which its increments on a finer one follow."""
    prolonged: dict[int, LayerState] = {}

    def state(number: int) -> LayerState:
        if number not in prolonged:
            while len(prolonged) > 2:  # those of loads that are passed
                del prolonged[min(prolonged)]
            prolonged[number] = prolong(path[number], coarse, fine)
        return prolonged[number]

    return Guide([state.load for state in path], state)


def solve(
    problem: LayerProblem,
    bound_guess: Callable[[LayerProblem], Array],
    *,
    solver: str = "multigrid",
    cascade: bool = True,
    tolerances: Tolerances | None = None,
    control: StepControl | None = None,
    neighbours: Neighbours | None = None,
    similar: Similar | None = None,
    patience: float | None = None,
    other_edges: bool = True,
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
    similar
        The layer solved before this one, which guides it; this one takes its place. It is then
        brought to tolerances twice as loose by default.
    patience
        Effort, s, after which the load is followed no further: by default ``patience_with``.
    other_edges
        Whether free edges may be made coarse where the load is not reached with narrow ones.

    Raises
    ------
    LoadNotReached
        When the full load is not reached on the grid of the problem; as its subclass OnlyOnCoarser
        where it is on a coarser one, or on one that is coarser at free edges.
    """
    levels = grids(problem) if cascade else [problem]
    guided = similar is not None and any(similar.guides(level) for level in levels)
    with counted() as effort:
        nested = _Nested(
            problem,
            bound_guess,
            solver,
            tolerances or (relaxed(TOLERANCES, _GUIDED) if guided else TOLERANCES),
            control or StepControl(),
            neighbours,
            similar,
            on_iteration,
            guided,
            effort,
            patience_with(problem, solver) if patience is None else patience,
            other_edges,
        )
        solution = nested.solved(levels)
    if similar is not None:
        similar.become(nested.own)
    return solution


def patience_with(problem: LayerProblem, solver: str = "multigrid") -> float:
    """Effort, s, after which the load of a layer is followed no further, unless told otherwise.

    45 s on 8,000 elements and in proportion on more; without end with the direct solver.
    """
    if solver == "direct":
        return np.inf
    return _PATIENCE * max(1.0, problem.grid.n_elements / _PATIENT)


@dataclass
class _Nested:
    """The nested iteration of one problem; for its arguments see ``solve``.

    ``effort`` is what was spent of ``patience``; ``narrows`` says whether this makes the free edges
    of another solution narrower. ``path`` is the last load path that was followed, from the first
    of its states on, and the problem on its grid; ``failure`` is the one that came farthest, on
    whatever elements, ``instead`` a solution on others than those of the problem.
    """

    problem: LayerProblem
    bound_guess: Callable[[LayerProblem], Array]
    solver: str
    tolerances: Tolerances
    control: StepControl
    neighbours: Neighbours | None
    similar: Similar | None
    on_iteration: Callable[[LayerProblem, float, int, Balance, int], None] | None
    guided: bool
    effort: Effort
    patience: float
    other_edges: bool
    narrows: bool = False
    record: list[tuple[int, float, int]] = field(default_factory=list, init=False)
    path: tuple[LayerProblem, list[LayerState]] | None = field(default=None, init=False)
    failure: LoadNotReached | None = field(default=None, init=False)
    instead: Solution | None = field(default=None, init=False)
    own: Similar = field(default_factory=Similar, init=False)

    def __post_init__(self) -> None:
        least = min(self.tolerances, TOLERANCES, key=lambda wanted: wanted.force)
        self._coarser, self._on_the_way = relaxed(least, _COARSER), relaxed(least, _ON_THE_WAY)
        self._resting = relaxed(least, _RESTING)
        self._limit = self.patience
        # until that was tried
        self._may_widen = self.other_edges and _narrow_edges(self.problem)

    def solved(self, levels: list[LayerProblem]) -> Solution:
        """Solve on all grids, the last of them first."""
        found: list[tuple[int, LayerState]] = []  # by grid
        for n in reversed(range(len(levels))):
            level = levels[n]
            carried = state = None
            if found and found[-1][0] == n + 1:
                carried = prolong(found[-1][1], levels[n + 1], level)
                state = self._carried_over(level, carried)
                if state is None and level.grid.n_elements > FINE:
                    again = max(_PATIENCE, _AGAIN * self.effort.spent)
                    self._limit = min(self.patience, again)
            try:
                state = state or self._loaded(level, carried)
            except LoadNotReached as failure:
                if failure.reason == SLID_AWAY and not found:  # as it does on finer elements
                    raise
                self._remember(failure)
                if self._may_widen and failure.reason != SLIDES:
                    solution = self._by_wider_edges()
                    self._may_widen = False
                    if solution is not None:
                        return solution
                if carried:
                    state = self._settled(level, carried)
                # what a coarse grid cannot bear a finer one may, if there is time
                if state is None and (level is self.problem or self._enough(level)):
                    raise self._failed(levels, found) from None
            if state is not None:
                found.append((n, state))
        return self._solution(levels, found)

    def _by_wider_edges(self) -> Solution | None:
        """Solve with free edges as coarse as all else; then make them narrower by and by.

        Narrow elements at the rim of a layer that sticks roll, lift and slip in turns, and are what
        keeps it from equilibrium. The load is followed anew for each width, guided by the path of
        the one before.

        Returns
        -------
        Solution or None
            None where the layer does not arrive on these elements with coarse edges either.

        Raises
        ------
        OnlyOnCoarser
            Where it does, but not with edges as narrow as those of the problem.
        """
        coarse = with_edges(self.problem, None)
        nested = replace(self, problem=coarse, neighbours=None, similar=None, guided=False)
        try:
            solution = nested.solved(grids(coarse))
        except LoadNotReached as failure:
            self._remember(failure)
            return None
        widths = _edge_widths(self.problem)
        for width in widths:
            level = self.problem if width == widths[-1] else with_edges(self.problem, width)
            path, nested = nested.path, replace(nested, problem=level, narrows=True)
            nested.path, nested.record = path, [*solution.record]
            carried = prolong(solution.state, solution.problem, level)
            try:
                state = nested._carried_over(level, carried) or nested._loaded(level, carried)
            except LoadNotReached as failure:
                raise OnlyOnCoarser(failure, solution, at_edges=True) from None
            solution = replace(
                solution,
                problem=level,
                state=state,
                record=nested.record,
                coarser=None,
                wider=solution,
            )
        return solution

    def _solution(
        self, levels: list[LayerProblem], found: list[tuple[int, LayerState]]
    ) -> Solution:
        """The last of what was found, and what was found on the next coarser grid."""
        number, state = found[-1]
        coarser = None
        if len(found) > 1 and found[-2][0] == number + 1:
            coarser = levels[number + 1], found[-2][1]
        return Solution(
            levels[number],
            state,
            self.record,
            coarser,
            self.tolerances,
            self.guided,
            effort=self.effort,
        )

    def _remember(self, failure: LoadNotReached) -> None:
        """Keep the failure that came farthest, and what there is instead."""
        if isinstance(failure, OnlyOnCoarser):
            self.instead = failure.solution
        if self.failure is None or failure.load >= self.failure.load:
            self.failure = failure

    def _failed(
        self, levels: list[LayerProblem], found: list[tuple[int, LayerState]]
    ) -> LoadNotReached:
        """The failure that came farthest, with what there is instead."""
        assert self.failure is not None  # one was remembered
        instead = self._instead(levels, found) or self.instead
        if instead is None:
            return self.failure
        return OnlyOnCoarser(self.failure, instead)

    def _instead(
        self, levels: list[LayerProblem], found: list[tuple[int, LayerState]]
    ) -> Solution | None:
        """The finest of what was found on coarser grids that is one of equilibrium, if any is."""
        for last in range(len(found) - 1, -1, -1):
            number, nearly = found[last]
            level = levels[number]
            nearest, reached = self._balanced(level, nearly, self.tolerances)
            state = nearest if reached else self._settled(level, nearly, self.tolerances, _LATE)
            if state is not None and balance(level, state).force_error < NEARLY[1]:
                return self._solution(levels, [*found[:last], (number, state)])
        return None

    def _carried_over(self, level: LayerProblem, carried: LayerState) -> LayerState | None:
        """Bring a loaded layer into equilibrium where it was carried to; None where it is too far.

        What is farther than ``_FAR`` from equilibrium would end with another friction.
        """
        error = balance(level, carried).force_error
        if error > _FAR:
            return None
        begin = carried
        moved = self.similar.moved(level, carried) if self.similar else None
        if moved and balance(level, moved).force_error < error:
            begin = moved
        wanted = self._wanted(level)
        if self.problem.grid.n_elements <= FINE:
            wanted = replace(wanted, linear=_ROUGHLY * wanted.linear)
        if level.grid.n_elements > FINE:  # the load path takes longer
            wanted = replace(wanted, nearly=NEARLY[0], lingers=1)
        if level.grid.n_elements > _HUGE:
            wanted = replace(wanted, nearly=NEARLY[1], lingers=2)
        state, reached = self._balanced(level, begin, wanted)
        if not reached:
            return None
        if self.similar is not None:
            self.own.settled(level, carried, state)
        return state

    def _loaded(self, level: LayerProblem, carried: LayerState | None) -> LayerState:
        """Follow the load on a grid: on a fine one from where it can be carried over, if it can be.

        Otherwise from the beginning, which takes seconds on other grids.

        Raises
        ------
        LoadNotReached
        """
        rest = LayerState.unloaded(level.grid)
        full = replace(rest, load=1.0, normal_force=rest.normal_force + self.bound_guess(level))
        guide = None if self.path is None else _guide(self.path[1], self.path[0], level)
        if guide and carried and level.grid.n_elements > FINE:
            begin = self._begun(level, guide)
            if begin is not None:
                with suppress(LoadNotReached):  # else from the beginning
                    return self._followed(level, begin, carried, guide)
            if guide.loads[0] > 0.0:
                guide = None
        return self._followed(level, rest, full, guide)

    def _begun(self, level: LayerProblem, guide: Guide[LayerState]) -> LayerState | None:
        """Return the layer at the last load at which a coarser grid's path can be carried over."""
        for load in reversed(guide.loads):
            if 0.0 < load < 1.0:
                carried = guide.at(load)
                if balance(level, carried).force_error < _FAR_BEFORE:
                    state, reached = self._balanced(level, carried, self._on_the_way)
                    if not reached:
                        return None
                    remember_slip(level, state)
                    return state
        return None

    def _followed(
        self,
        level: LayerProblem,
        begin: LayerState,
        full: LayerState,
        guide: Guide[LayerState] | None,
    ) -> LayerState:
        """Follow the load on a grid, from a state in equilibrium; ``full`` is an estimate.

        Raises
        ------
        LoadNotReached
        """
        whole = begin.load == 0.0
        few = self.neighbours is not None and level.grid.n_elements <= self.neighbours.most
        beside = self.neighbours if few and whole else None
        solver = self._solvers(level)
        if beside:
            own = make_solver(level, self.solver)
            apart = replace(solver, iterative=own) if isinstance(solver, Solvers) else own
            beside.begin(level, begin, apart)
        visited: list[LayerState] = []
        kept = self.similar is not None and whole  # guides the next layer
        quick = level.grid.n_elements <= FINE
        finest = level is self.problem
        guides = kept or not finest or quick
        path = Path(
            LoadedLayer(level, solver, CARRIED if self.guided else SLOW),
            self._wanted(level),
            self._on_the_way,
            begin,
            self.control if whole else replace(self.control, first=self.control.largest),
            partial(self.on_iteration, level) if self.on_iteration else None,
            resting=self._rest(level),
            guide=guide,
            similar=self.similar.guide(level) if self.similar and whole else None,
            visited=visited if guides else None,
            allowed=_ITERATIONS if quick and (finest or not self._may_widen) else FOLLOWED,
            snaps=SNAPS if self._soon(level) else None,
            enough=partial(self._enough, level),
        )
        try:
            path.follow(full, beside=beside)
        except LoadNotReached:
            if beside:
                beside.stop("the load was not reached")
            raise
        if guides:
            self.path = level, visited
        if kept and path.smooth:
            self.own.followed(level, visited)
        self.record += [(level.grid.n_elements, *step) for step in path.record]
        return path.state

    def _balanced(
        self, level: LayerProblem, state: LayerState, wanted: Tolerances
    ) -> tuple[LayerState, bool]:
        """Bring a state at its load into equilibrium, or so near that it will do.

        Returns
        -------
        tuple
            The state nearest to equilibrium, and whether it is one.
        """
        report = partial(self.on_iteration, level, state.load) if self.on_iteration else None
        linear = make_solver(level, self.solver)
        due = CARRIED if level.grid.n_elements > FINE else None
        try:
            now, count = equilibrate(level, state, linear, impatient(wanted), report, eliminate=due)
        except NotConverged as failure:
            if failure.nearest is None:
                raise
            now, count = failure.nearest
            if not nearly_met(now, wanted):
                return now.state, False
        self.record.append((level.grid.n_elements, state.load, count))
        return now.state, True

    def _settled(
        self,
        level: LayerProblem,
        state: LayerState,
        wanted: Tolerances | None = None,
        more: float = _AT_LAST,
    ) -> LayerState | None:
        """Let a loaded layer come to rest, as near to equilibrium as ``wanted``; None where not."""
        path = Path(
            LoadedLayer(level, self._solvers(level)),
            wanted or self._wanted(level),
            self._coarser,
            state,
            self.control,
            partial(self.on_iteration, level) if self.on_iteration else None,
            resting=wanted or self._rest(level),
            enough=partial(self._enough, level, more),
        )
        try:
            path.settle()
        except LoadNotReached:
            return None
        self.record += [(level.grid.n_elements, *step) for step in path.record]
        return path.state

    def _soon(self, level: LayerProblem) -> bool:
        """Whether a load path is given up soon, because coarse edges get there sooner."""
        return self._may_widen and level.grid.n_elements <= FINE

    def _enough(self, level: LayerProblem, more: float = 1.0) -> bool:
        """Whether what a path may take, or ``more`` than that, has been spent."""
        share = _NARROW if self._soon(level) and not self.narrows else 1.0
        return self.effort.spent > share * more * self._limit

    def _wanted(self, level: LayerProblem) -> Tolerances:
        return self.tolerances if level is self.problem else self._coarser

    def _rest(self, level: LayerProblem) -> Tolerances | None:
        return None if level is self.problem else self._resting

    def _solvers(self, level: LayerProblem) -> LinearSolver | Solvers:
        given = make_solver(level, self.solver)
        if isinstance(given, DirectSolver) or level.grid.n_elements > _EXACT:
            return given
        return Solvers(given, direct_solver(level))


def make_solver(problem: LayerProblem, name: str) -> LinearSolver:
    """Return the named linear solver for a problem."""
    if name == "direct":
        return direct_solver(problem)
    return MultigridSolver(problem.grid, problem.shear_modulus, problem.edges == "free")


__all__ = ["LoadNotReached", "Solution", "make_solver", "patience_with", "prolong", "solve"]
