"""Following the load path from the unloaded layer, with automatic step control.

Loads are increased step by step, each in equilibrium by Newton's method (``follow``). Where the
layer snaps, rolls or slides there is no equilibrium next to the last one, however small the step:
the layer then moves as if in honey until it is at rest (``settle``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .contact import remember_slip
from .iteration import NotConverged, Tolerances
from .neighbours import Neighbours
from .newton import Balance, Drag, LinearSolver, balance, equilibrate
from .problem import LayerProblem, LayerState

Array = NDArray[np.float64]
Report = Callable[[float, int, Balance, int], None]

#: Newton iterations in which a load path must arrive, and a layer that is carried over to another
#: grid come to rest; after that its load is followed on that grid.
_FOLLOWED, _CARRIED = 250, 80
#: Increment of the load below which drag takes over.
_SNAP = 0.02
#: Snaps after which the drag stays until the layer is fully loaded: there are always more.
_SNAPS = 1
#: Viscosity in shear moduli per thickness squared: at first, the least and the most. It is halved
#: after an easy step (a quarter of it is left once the layer is fully loaded), and four times as
#: large, with half the increment, after a failure.
_VISCOSITY, _LEAST, _MOST = 100.0, 0.01, 1e5
#: Least increment of the load against drag.
_CREEP = 1e-5
#: Drag, as a share of the contact forces, below which the layer is as good as at rest: fully
#: loaded, and on the way there.
_REST = (0.03, 0.01)
#: Share of the contact forces out of balance below which Newton's method is tried without drag.
_NEAR = 0.1
#: Steps in which a fully loaded layer must come to rest.
_HELD = 120


@dataclass(frozen=True)
class StepControl:
    """Load increments, as fractions of the full load.

    A load reached in at most ``easy`` Newton iterations lets the next increment grow. Where the
    increment falls below ``smallest`` there is taken to be no equilibrium near the last one.
    """

    first: float = 0.1
    largest: float = 0.3
    smallest: float = 1e-3
    easy: int = 6


@dataclass
class Path:
    """How far a load path has come, and its record of (load, Newton iterations).

    ``before`` is the state before the last one, ``spent`` counts all Newton iterations, those of
    loads that were not reached too, of ``allowed`` ones.
    """

    state: LayerState
    before: LayerState
    report: Report | None = None
    allowed: int = _FOLLOWED
    record: list[tuple[float, int]] = field(default_factory=list)
    spent: int = 0

    def counting(self, load: float) -> Callable[[int, Balance, int], None]:
        """Return a function that counts and reports the iterations at a load."""

        def count(iteration: int, now: Balance, krylov: int) -> None:
            self.spent += iteration > 0
            if self.report:
                self.report(load, iteration, now, krylov)

        return count

    def advance(self, state: LayerState, iterations: int) -> None:
        """Accept a state in equilibrium."""
        self.record.append((state.load, iterations))
        self.before, self.state = self.state, state

    def stopped(self, reason: object) -> LoadNotReached:
        """Return the error that says where the path ended, and why."""
        return LoadNotReached(self.state.load, str(reason))


class LoadNotReached(Exception):
    """The load path ended early; carries the load reached and the last reason."""

    def __init__(self, load: float, reason: str) -> None:
        super().__init__(f"stopped at {100 * load:.1f} % of the load: {reason}")
        self.load = load
        self.reason = reason


def extrapolated(state: LayerState, other: LayerState, load: float) -> LayerState:
    """Continue the straight line from one state through another, from ``state``, to ``load``."""
    out = state.copy()
    out.load = load
    ratio = (load - state.load) / (other.load - state.load)
    out.u += ratio * (other.u - state.u)
    out.p += ratio * (other.p - state.p)
    out.normal_force += ratio * (other.normal_force - state.normal_force)
    np.maximum(out.normal_force, 0.0, out=out.normal_force)
    return out


def follow(
    problem: LayerProblem,
    solver: LinearSolver,
    tolerances: Tolerances,
    intermediate: Tolerances,
    start: LayerState,
    full: LayerState,
    control: StepControl | None = None,
    report: Report | None = None,
    neighbours: Neighbours | None = None,
    exact: Callable[[], LinearSolver] | None = None,
) -> tuple[LayerState, list[tuple[float, int]]]:
    """Load the layer fully, from ``start`` on.

    Parameters
    ----------
    tolerances, intermediate
        When the full load is reached, and a smaller one.
    start
        A layer in equilibrium, its reference slip laid.
    full
        An estimate of the fully loaded layer, towards which the first step is begun.
    neighbours
        What is to be followed beside it.
    exact
        Makes a linear solver that is exact, to be tried where load increments get small: thin
        layers that stick make linear systems which the iterative one hardly solves.

    Returns
    -------
    tuple
        The loaded layer, and the record of (load, Newton iterations).

    Raises
    ------
    LoadNotReached
    """
    control = control or StepControl()
    path = Path(start, start, report)
    step = control.first
    snaps = 0
    while path.state.load < 1.0:
        steps = np.ceil((1.0 - path.state.load) / step - 1e-9)  # equal ones, not a small last one
        load = 1.0 if steps == 1 else path.state.load + (1.0 - path.state.load) / steps
        other = full if path.before is path.state else path.before
        trial = extrapolated(path.state, other, load)
        wanted = tolerances if load == 1.0 else intermediate
        try:
            now, count = equilibrate(problem, trial, solver, wanted, path.counting(load))
        except NotConverged as failure:
            step = 0.5 * (load - path.state.load)
            if path.spent > path.allowed:
                raise path.stopped(failure) from None
            if step < _SNAP and exact is not None:
                solver, exact = exact(), None
                step = _SNAP
                continue
            if step < _SNAP:
                if neighbours:
                    neighbours.stop(
                        f"at {path.state.load:.0%} of the load the layer snaps or slides"
                    )
                snaps += 1
                _settle(
                    problem,
                    solver,
                    tolerances,
                    intermediate,
                    path,
                    step,
                    control.easy,
                    stay=snaps > _SNAPS,
                )
                step = _SNAP
            continue
        if load < 1.0:
            remember_slip(problem, now.state)
        path.advance(now.state, count)
        if neighbours:
            neighbours.load(now.state)
        if count <= control.easy:
            step = min(control.largest, 1.5 * step)
    return path.state, path.record


def settle(
    problem: LayerProblem,
    solver: LinearSolver,
    tolerances: Tolerances,
    intermediate: Tolerances,
    start: LayerState,
    control: StepControl | None = None,
    report: Report | None = None,
) -> tuple[LayerState, list[tuple[float, int]]]:
    """Let a fully loaded layer that is not in equilibrium come to rest; as ``follow``.

    How it gets there is no part of its history: slip goes on counting from where it did at first.
    """
    path = Path(start, start, report, _CARRIED)
    control = control or StepControl()
    _settle(problem, solver, tolerances, intermediate, path, _SNAP, control.easy, moves=False)
    return path.state, path.record


def _settle(
    problem: LayerProblem,
    solver: LinearSolver,
    tolerances: Tolerances,
    intermediate: Tolerances,
    path: Path,
    step: float,
    easy: int,
    stay: bool = False,
    moves: bool = True,
) -> None:
    """Go on along a path against drag: to full load and rest, or to next to no drag before that.

    Friction is bounded by the contact forces before each step (``Drag``); of a fully loaded layer,
    by the mean of these and the bound before: great friction at free edges would swing with them.
    When they no longer change, and nothing moves, the state is one of equilibrium as it stands.
    Newton's method, with friction bounded by what is sought, is tried again whenever a tenth is
    left of what was out of balance. Where the layer ``moves``, it slips on its way, and friction
    remembers that.
    """
    unit = problem.shear_modulus / float(np.median(problem.grid.thickness)) ** 2
    viscosity, held, wanted, near = _VISCOSITY, 0, intermediate, np.inf
    bound = path.state.normal_force
    while True:
        load = min(1.0, path.state.load + step)
        drag = Drag(viscosity * unit, path.state, bound)
        trial = replace(path.state, load=load)
        try:
            now, count = equilibrate(problem, trial, solver, wanted, path.counting(load), drag)
        except NotConverged as failure:
            viscosity *= 4.0
            step *= 0.5
            if viscosity > _MOST or step < _CREEP or path.spent > path.allowed:
                raise path.stopped(failure) from None
            continue
        force = float(np.linalg.norm(drag.force(problem, now.state.u)))
        share = force / max(float(np.linalg.norm(now.state.normal_force)), 1e-30)
        if moves:
            remember_slip(problem, now.state)
        path.advance(now.state, count)
        if count <= easy:
            step *= 1.5
            viscosity = max(_LEAST, (0.5 if load < 1.0 else 0.25) * viscosity)
        if load < 1.0:
            bound = path.state.normal_force
            if share < _REST[1] and not stay:
                return
            continue
        bound = 0.5 * (bound + path.state.normal_force)
        rest = balance(problem, path.state)
        if rest.force_error < tolerances.force and rest.volume_error < tolerances.volume:
            return
        held += 1
        if held > _HELD:
            raise path.stopped(_restless(path, problem))
        if share < _REST[0] and rest.force_error < min(near, _NEAR):
            wanted, near = tolerances, 0.1 * rest.force_error
            try:
                now, count = equilibrate(
                    problem, path.state, solver, tolerances, path.counting(load)
                )
            except NotConverged:
                continue
            path.advance(now.state, count)
            return


def _restless(path: Path, problem: LayerProblem) -> str:
    """Why a fully loaded layer does not come to rest."""
    step = (path.state.u - path.before.u)[:2]
    weights = problem.grid.node_volumes / problem.grid.node_volumes.sum()
    together = float(np.linalg.norm((step * weights).sum((1, 2, 3))))
    if together > 0.5 * float(np.sqrt((step**2 * weights).sum())):
        return "nothing holds the layer sideways: it slides from under what presses it"
    return "the layer does not come to rest"
