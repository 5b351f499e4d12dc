"""Following a load path, with automatic step control, of a layer on an imprint or of a stack.

Loads are increased step by step, each in equilibrium by Newton's method (``Path.follow``). Where
that fails, friction follows the contact forces from one solution to the next instead of within each
(``Path._lagged``). Where a body snaps, rolls or slides there is no equilibrium next to the last
one, however small the step: it then moves as if in honey until it is at rest (``Path.settle``).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from .iteration import (
    Iterate,
    NotConverged,
    Tolerances,
    impatient,
    met,
    nearly_met,
    relaxed,
    stagnates,
    volume_nearly_met,
)

Array = NDArray[np.float64]

#: Newton iterations in which a load path must arrive by default, and bodies that are carried over
#: to another grid come to rest; after that their load is followed on that grid.
FOLLOWED, _CARRIED = 250, 80
#: Increment of the load below which drag takes over.
_SNAP = 0.02
#: By how much an increment is at least and at most of the last one.
_CHANGE = (0.5, 1.5)
#: Nothing snaps before it is loaded: increment down to which the first load is made smaller.
_TOUCH = 1e-3
#: Failures in a row, at ever smaller increments, after which drag takes over, too.
_FAILURES = 2
#: Snaps after which the drag stays until the full load is reached: there are always more.
SNAPS = 1
#: Viscosity, in the ``stiffness`` of what is loaded: at first, the least and the most. It is halved
#: after an easy step (a quarter of it is left at the full load), and four times as large, with half
#: the increment, after a failure.
_VISCOSITY, _LEAST, _MOST = 10.0, 0.01, 1e5
#: Newton iterations up to which a step against drag is easy, and from which on a load is hard.
_EASY, _HARD = 6, 10
#: Least increment of the load against drag.
_CREEP = 1e-5
#: Drag, as a share of the contact forces, below which all is as good as at rest: at the full load,
#: and on the way there.
_REST = (0.03, 0.01)
#: Drag, as a share of the contact forces, without which nothing moves any more.
_STILL = 1e-5
#: Solutions of one load in which friction must come to be bounded by the contact forces of its own:
#: on the way, where these may differ by a share from those that bound it, and at the full load.
_ROUNDS, _APART, _ROUNDS_AT_LAST = 12, 0.002, 32
#: Newton iterations in which the distance must fall to three tenths where there is another way;
#: solutions in which that must fall so far which nearly is one of equilibrium.
_PATIENCE, _FLICKERS = 5, 4
#: Share of the contact forces out of balance below which Newton's method is tried without drag.
_NEAR = 0.1
#: Steps in which fully loaded bodies must come to rest, and after which those that still move as a
#: whole slide.
_HELD, _SLIDING = 50, 10
#: Share of where it was that a layer must cover; one that covers less has slid away.
COVERED = 0.5
#: Why they do not.
SLIDES = "nothing holds the layer sideways: it slides from under what presses it"
SLID_AWAY = "nothing holds the layer sideways: it has slid out of most of the field of view"
_RESTLESS = "the layer does not come to rest"
#: Why a path is given up that might lead there.
TOO_LONG = "it took too long"
#: Distance at which a state counts as nearly one of equilibrium where contact at a few nodes
#: changes for ever, once Newton's method fails there; share of the contact forces out of balance if
#: there is no other way, and at last.
NEARLY = (1e-4, 1e-3, 0.02)
#: Share of what may be out of balance on the way that may be left where Newton's method fails.
_NEARLY = 0.1
#: How much of a change of the contact forces the bound of friction follows: the least and the most,
#: and at first in steps against drag.
_RELAXATION, _AGAINST_DRAG = (0.1, 2.0), 0.5
#: Smallest singular value of two ways, by the largest: what is less apart counts as one way.
_ALIKE = 1e-3
#: Iterations of the linear solver that a load may take: more of them cost more than a smaller one.
_KRYLOV = 60


class Loadable(Protocol):
    """A state at a load, from 0 to 1."""

    @property
    def load(self) -> float: ...  # noqa: D102

    def at_load(self, load: float) -> Self:
        """Return the same state at another load."""
        ...

    def towards(self, other: Self, load: float) -> Self:
        """Go on to a load on the straight line through another state."""
        ...

    def following(self, start: Self, end: Self) -> Self:
        """Go on as another state did from ``start`` to ``end``, to the load of ``end``."""
        ...


AnyState = TypeVar("AnyState", bound=Loadable)
Given = TypeVar("Given", bound=Loadable, covariant=True)
Taken = TypeVar("Taken", bound=Loadable, contravariant=True)


@dataclass(frozen=True, eq=False)
class Drag(Generic[AnyState]):
    """One implicit Euler step of bodies in honey, from the state ``origin``.

    ``viscosity``, kPa / mm^2, is that by which ``resistance`` holds them; zero is no honey at all.
    Friction of each contact is bounded by given normal forces, ``bound``, mN: where it is bounded
    by those that are sought, nodes at free edges stick, lose contact, slip back and touch again for
    ever.
    """

    viscosity: float
    origin: AnyState
    bound: Sequence[Array]


@dataclass
class Bound:
    """Contact forces, mN, that bound friction and follow those found with it (Aitken's method).

    ``part`` is how much of a change they follow: at first, and then of the last one.
    """

    forces: Sequence[Array]
    part: float = 1.0
    _change: Sequence[Array] | None = field(default=None, init=False)

    def apart(self, found: Sequence[Array]) -> float:
        """How far what was found is from them, as a 2-norm, mN; glue that is pulled bounds none."""
        return _norm(_less(_pressing(found), self.forces))

    def follow(self, found: Sequence[Array], most: float = _RELAXATION[1]) -> None:
        """Follow what was found, by at most so many times the change.

        A change that grows leads away from an equilibrium that is not stable, and is followed as
        far as may be.
        """
        last, self._change = self._change, _less(_pressing(found), self.forces)
        if last is not None:
            turn = _less(self._change, last)
            along = sum(float((then * by).sum()) for then, by in zip(last, turn, strict=True))
            ahead = np.inf if along >= 0.0 else -self.part * along / _norm(turn) ** 2
            self.part = float(np.clip(ahead, _RELAXATION[0], most))
        pairs = zip(self.forces, self._change, strict=True)
        self.forces = _pressing([then + self.part * by for then, by in pairs])


class Reached(Iterate, Protocol[Given]):
    """A state, and how far it is from equilibrium."""

    @property
    def state(self) -> Given: ...  # noqa: D102


class Loaded(Protocol[AnyState]):
    """What is loaded, with a linear solver for it."""

    @property
    def stiffness(self) -> float:
        """Shear modulus per height squared, kPa / mm^2, the scale of damping and drag."""
        ...

    @property
    def volumes(self) -> Array:
        """Volume of each node, (n), mm^3."""
        ...

    def resistance(self, moved: Array) -> Array:
        """Forces, mN, of unit resistance (1 kPa / mm^2) to displacements, mm; both (3, n)."""
        ...

    def displacement(self, state: AnyState) -> Array:
        """Displacement (x, y, z) of the nodes, (3, n), mm."""
        ...

    def covered(self, state: AnyState) -> float:
        """Share of where the layer was that it still covers."""
        ...

    def contact_forces(self, state: AnyState) -> Sequence[Array]:
        """Normal forces of each contact, mN."""
        ...

    def balance(self, state: AnyState) -> Reached[AnyState]:
        """How far a state is from equilibrium."""
        ...

    def equilibrate(
        self,
        trial: AnyState,
        tolerances: Tolerances,
        on_iteration: Callable[[int, Any, int], None],
        drag: Drag[AnyState] | None,
    ) -> tuple[Reached[AnyState], int]:
        """Equilibrium at the load of ``trial``, and the Newton iterations; else NotConverged."""
        ...

    def remember(self, now: Any) -> AnyState:
        """Return the state of a balance, its reference slip laid: the next load starts there."""
        ...


class Beside(Protocol[Taken]):
    """What is followed beside a path."""

    def load(self, state: Taken) -> None:
        """Follow to a state of the path."""
        ...

    def stop(self, failure: str) -> None:
        """Follow no further."""
        ...


@dataclass(frozen=True)
class StepControl:
    """Load increments, as fractions of the full load.

    They are chosen so that a load takes about so many ``iterations`` of Newton's method, at most
    the ``largest``. What takes more is loaded too far at once: of a flat layer between rough faces
    the hill of friction becomes too high, by several percent in increments of 0.3.
    """

    first: float = 0.1
    largest: float = 0.15
    iterations: float = 2.5

    def after(self, step: float, iterations: int) -> float:
        """Return the increment after one that took so many iterations."""
        factor = np.clip(self.iterations / max(iterations, 1), *_CHANGE)
        return max(_SNAP, min(self.largest, float(factor) * step))


@dataclass(frozen=True, eq=False)
class Guide(Generic[AnyState]):
    """The path of something similar, which the increments of another path follow.

    It knows of the ``loads``, ascending, at which there is a ``state``, by its number.
    """

    loads: list[float]
    state: Callable[[int], AnyState]

    def __call__(self, state: AnyState, load: float) -> AnyState:
        """Go on from a state of the other path to a load."""
        return state.following(self.at(state.load), self.at(load))

    def at(self, load: float) -> AnyState:
        """Interpolate the state at a load; where it moved at that load, after that.

        Beyond the last load it is on the straight line through the last two.
        """
        after = bisect_right(self.loads, load)
        before = self.state(after - 1)
        if before.load == load:
            return before
        if after == len(self.loads):
            return before.towards(self.state(bisect_left(self.loads, before.load) - 1), load)
        return before.towards(self.state(after), load)


class LoadNotReached(Exception):
    """The load path ended early; carries the load reached and the last reason."""

    def __init__(self, load: float, reason: str) -> None:
        self.load = load
        self.reason = reason
        end = f"stopped at {self._share} of the load"
        if load >= 1.0:
            end = "came to the full load, but to no equilibrium there"
        super().__init__(f"{end}: {reason}")

    def how_far(self, whole: str = "") -> str:
        """Say how far it was loaded, or compressed by a `whole` such as "0.2 mm"."""
        if self.load >= 1.0:
            done = f"by the whole {whole}" if whole else "fully"
            return f"{done}, but did not come to equilibrium there"
        return f"to {self._share}{whole and f' of {whole}'} only"

    @property
    def _share(self) -> str:
        """The load reached in percent, to the digits that tell it from all of it."""
        left = max(100.0 * (1.0 - self.load), 1e-12)
        return f"{100 * self.load:.{max(1, -int(np.floor(np.log10(left))))}f} %"


@dataclass
class Path(Generic[AnyState]):
    """The way from one state to others, each in equilibrium at its load.

    Attributes
    ----------
    loaded
        What is loaded.
    tolerances, intermediate
        When the full load and other loads that were asked for are reached, and those on the way.
    state
        The last state that was accepted; at first one in equilibrium, its reference slip laid.
    control
        Of the load increments.
    report
        Called with the load, the number of the Newton iteration, the balance and the iterations of
        the linear solver.
    before
        The state accepted before the last one.
    guide
        Tells what to try at the next load; by default that is on the straight line through the last
        two states.
    similar
        The path of something similar, which says that instead until it leads to no equilibrium:
        from the second load on, that mixture of it and of the straight line which would have been
        nearest at the load before.
    resting
        When bodies that came to the full load against drag are as good as at rest; by default as
        ``tolerances``.
    visited
        If a list is given, the first state and all that were accepted.
    allowed
        Newton iterations in which the path must arrive.
    snaps
        How often it may snap or slide on its way, if not as often as it likes.
    enough
        Says when it is given up wherever it is, because it takes too long.
    record
        (load, Newton iterations) of all that were accepted.
    spent
        All Newton iterations, those of loads that were not reached too.
    """

    loaded: Loaded[AnyState]
    tolerances: Tolerances
    intermediate: Tolerances
    state: AnyState
    control: StepControl = field(default_factory=StepControl)
    report: Callable[[float, int, Any, int], None] | None = None
    before: AnyState | None = None
    resting: Tolerances | None = None
    guide: Guide[AnyState] | None = None
    similar: Guide[AnyState] | None = None
    visited: list[AnyState] | None = None
    allowed: int = FOLLOWED
    snaps: int | None = None
    enough: Callable[[], bool] | None = None
    record: list[tuple[float, int]] = field(default_factory=list, init=False)
    spent: int = field(default=0, init=False)
    _lags: bool = field(default=False, init=False)  # friction, as what led to the last load
    _mixture: tuple[float, float] = field(default=(1.0, 0.0), init=False)  # guide, line

    def __post_init__(self) -> None:
        if self.visited is not None:
            self.visited.append(self.state)

    @property
    def smooth(self) -> bool:
        """Whether every load was reached at the first try, and none of them was hard."""
        counts = [count for _, count in self.record]
        return sum(counts) == self.spent and max(counts, default=0) < _HARD

    def follow(
        self,
        full: AnyState,
        target: float = 1.0,
        stops: Sequence[float] = (),
        beside: Beside[AnyState] | None = None,
    ) -> list[AnyState]:
        """Load up to ``target``.

        Parameters
        ----------
        full
            An estimate at full load, towards which the first step is begun where there is no state
            ``before``.
        stops
            Loads on the way, the states at which are kept.
        beside
            Followed beside it.

        Returns
        -------
        list
            The states at the stops.

        Raises
        ------
        LoadNotReached
        """
        step, snaps, failed = self.control.first, 0, 0
        ends, kept = sorted({*stops, target}), list[AnyState]()
        while self.state.load < target:
            start = self.state.load
            end = next(load for load in ends if load > start)
            steps = np.ceil((end - start) / step - 1e-9)  # equal ones, not a small last one
            load = end if steps == 1 else start + float((end - start) / steps)
            exact = load == 1.0 or load in stops
            tried = list[AnyState]()
            if self.guide and failed == 0 and not self.similar:
                trial = self.guide(self.state, load)
            else:
                trial = self.state.towards(full if self.before is None else self.before, load)
            if self.similar:
                tried = [self.similar(self.state, load), trial]
                trial = self._mixed(tried)
            wanted = self.tolerances if exact else self.intermediate
            # on the way, what is near enough already is left as the similar path suggests it
            least = 0 if tried and not exact else wanted.least
            nearly = NEARLY[0] if exact else _NEARLY * wanted.force
            wanted = replace(wanted, krylov=_KRYLOV, least=least)
            try:
                now, counts = self._equilibrium(trial, wanted, nearly, exact)
            except NotConverged as failure:
                if self.spent > self.allowed:
                    raise self._stopped(failure) from None
                if self.similar:
                    self.similar = None
                    continue
                smaller = 0.5 * (load - start)
                if start == 0.0 and smaller > _TOUCH:
                    step = 0.5 * smaller
                    continue
                step = max(_SNAP, smaller)
                failed += 1
                if smaller >= _SNAP and failed < _FAILURES:
                    continue
                if beside:
                    beside.stop(f"at {start:.0%} of the load the layer snaps or slides")
                snaps += 1
                if self.snaps is not None and snaps > self.snaps:
                    raise self._stopped(failure) from None
                self._creep(end, smaller, self.allowed, stay=snaps > SNAPS)
                failed = 0
                if self.state.load in stops:
                    kept.append(self.state)
                continue
            if load in stops:
                kept.append(now.state)
            if tried and sum(counts) > 0 and self.before is not None:
                self._mix(tried, now.state)
            self._accept(self.loaded.remember(now) if load < 1.0 else now.state, sum(counts))
            failed = 0
            if beside:
                beside.load(self.state)
            if start > 0.0:  # contact that is made tells nothing of the next load
                step = self.control.after(step, max(counts))
        return kept

    def settle(self) -> None:
        """Let loaded bodies that are not in equilibrium come to rest.

        How they get there is no part of their history: slip goes on counting from where it did at
        first.

        Raises
        ------
        LoadNotReached
        """
        self._creep(self.state.load, _SNAP, _CARRIED, moves=False)

    def _equilibrium(
        self, trial: AnyState, wanted: Tolerances, nearly: float, exact: bool
    ) -> tuple[Reached[AnyState], list[int]]:
        """Equilibrium at the load of ``trial``, and the iterations of all solutions on the way.

        Friction follows the contact forces within Newton's method or, where that comes no nearer
        for a while, from one solution to the next. What led to the last load is tried first.
        """

        def coupled(wanted: Tolerances, nearly: float) -> tuple[Reached[AnyState], list[int]]:
            now, count = self._reach(trial, wanted, nearly=nearly)
            return now, [count]

        def lagged() -> tuple[Reached[AnyState], list[int]]:
            drag = Drag(0.0, self.state, _pressing(self.loaded.contact_forces(trial)))
            loose = replace(self.intermediate, patience=_PATIENCE, krylov=_KRYLOV)
            if exact:
                return self._lagged_at_last(trial, loose, drag, replace(wanted, nearly=nearly))
            now, counts, _ = self._lagged(trial, loose, drag)
            return now, counts

        if self.state.load > 0.0 and not self.similar:
            soon = partial(coupled, replace(wanted, patience=_PATIENCE), 0.0)
            first, second = (lagged, soon) if self._lags else (soon, lagged)
            with suppress(NotConverged):
                return first()
            with suppress(NotConverged):
                found = second()
                self._lags = not self._lags
                return found
        return coupled(wanted, nearly)

    def _lagged(
        self, trial: AnyState, wanted: Tolerances, drag: Drag[AnyState]
    ) -> tuple[Reached[AnyState], list[int], Drag[AnyState]]:
        """Equilibrium with friction bounded by contact forces that come to be nearly its own.

        Friction with a given bound has a potential, and Newton's method arrives where it does not
        with a bound that is sought, too. So each solution is bounded by the contact forces of those
        before (``Bound``). Drag is a quarter from one to the next until it holds next to nothing.

        Returns
        -------
        tuple
            The last solution, the iterations of each, and the drag against which it was found.

        Raises
        ------
        NotConverged
            Where the first of them does not arrive or, without drag, none is near enough.
        """
        kept, counts = None, list[int]()
        bound = Bound(drag.bound)
        for _ in range(_ROUNDS):
            try:
                now, count = self._reach(trial, wanted, drag)
            except NotConverged:
                if kept is None or drag.viscosity == 0.0:
                    raise
                return kept
            counts.append(count)
            kept = now, counts, drag
            forces = self.loaded.contact_forces(now.state)
            if self._force(drag, now.state) > _REST[1] * _norm(forces):
                drag = replace(drag, viscosity=0.25 * drag.viscosity)
                bound = Bound(bound.forces)
            elif bound.apart(forces) < _APART * _norm(forces):
                return kept
            bound.follow(forces)
            drag = replace(drag, bound=bound.forces)
            trial = now.state
        if kept is None or drag.viscosity == 0.0:
            raise NotConverged("friction and contact forces do not settle")
        return kept

    def _lagged_at_last(
        self, trial: AnyState, wanted: Tolerances, drag: Drag[AnyState], final: Tolerances
    ) -> tuple[Reached[AnyState], list[int]]:
        """Equilibrium by way of friction bounded by contact forces that come to be its own.

        As ``_lagged``, without drag, until ``final`` is met with friction bounded by what is
        sought.

        Returns
        -------
        tuple
            The last solution, the nearest where they flicker next to equilibrium, and the
            iterations of each.

        Raises
        ------
        NotConverged
            Where one of them does not arrive, or none is near enough.
        """
        counts, left = list[int](), list[float]()
        nearest = None
        bound = Bound(drag.bound)
        for _ in range(_ROUNDS_AT_LAST):
            now, count = self._reach(trial, wanted, drag)
            counts.append(count)
            rest = self.loaded.balance(now.state)
            if met(rest, final):
                return rest, counts
            left.append(rest.distance)
            if nearest is None or rest.distance < nearest.distance:
                nearest = rest
            if nearly_met(nearest, final) and stagnates(left, _FLICKERS):
                return nearest, counts
            tenth = self._tenth(rest.force_error)
            wanted = replace(wanted, force=tenth.force, volume=tenth.volume)
            bound.follow(self.loaded.contact_forces(now.state))
            drag = replace(drag, bound=bound.forces)
            trial = now.state
        raise NotConverged("friction and contact forces do not settle")

    def _creep(
        self,
        end: float,
        step: float,
        allowed: int,
        stay: bool = False,
        moves: bool = True,
    ) -> None:
        """Go on against drag: to a load and rest, or to next to no drag before that.

        Friction is bounded by given contact forces (``Drag``), on the way by those at the same load
        (``_lagged``); once the load is reached, its bound follows them from step to step: great
        friction at free edges would swing with them. When they no longer change, and nothing moves,
        the state is one of equilibrium as it stands; where they change for ever, it may nearly be
        one. Newton's method, with friction bounded by what is sought, is tried again whenever a
        tenth is left of what was out of balance. What ``moves`` slips on its way, and friction
        remembers that.
        """
        loaded = self.loaded
        viscosity, wanted, near = _VISCOSITY, self.intermediate, np.inf
        held, left = 0, np.inf
        bound = Bound(loaded.contact_forces(self.state), _AGAINST_DRAG)

        def stopped(reason: object) -> LoadNotReached:
            return self._stopped(SLIDES if held > _SLIDING and self._together() else reason)

        while True:
            load = min(end, self.state.load + step)
            drag = Drag(viscosity * loaded.stiffness, self.state, bound.forces)
            trial = self.state.at_load(load)
            try:
                if moves and load > self.state.load:
                    now, counts, drag = self._lagged(trial, wanted, drag)
                    viscosity = drag.viscosity / loaded.stiffness
                    bound.forces = drag.bound
                else:
                    now, count = self._reach(trial, wanted, drag)
                    counts = [count]
            except NotConverged as failure:
                viscosity *= 4.0
                step *= 0.5
                over = viscosity > _MOST or step < _CREEP or self.spent > allowed
                if left < NEARLY[1 + over]:
                    return
                if over:
                    raise stopped(failure) from None
                continue
            except LoadNotReached as failure:  # it took too long
                raise stopped(failure.reason) from None
            forces = loaded.contact_forces(now.state)
            share = self._force(drag, now.state) / max(_norm(forces), 1e-30)
            passed = moves and load < 1.0
            self._accept(loaded.remember(now) if passed else now.state, sum(counts))
            if max(counts) <= _EASY:
                step = min(self.control.largest, 1.5 * step)
                viscosity = max(_LEAST, (0.5 if load < end else 0.25) * viscosity)
            if load < end:
                bound.forces = forces
                if share < _REST[1] and not stay:
                    return
                continue
            # slip by too low a bound would be remembered
            bound.follow(forces, 1.0 if passed else _RELAXATION[1])
            rest = loaded.balance(self.state)
            if met(rest, self.resting or self.tolerances):
                return
            wanted = self._tenth(rest.force_error)
            held += 1
            at_rest = share < _STILL or rest.distance < NEARLY[0]
            will_do = at_rest and volume_nearly_met(rest, self.tolerances)
            left = rest.force_error if will_do else np.inf
            if held > _HELD:
                if left < NEARLY[2]:
                    return
                raise stopped(_RESTLESS)
            if share < _REST[0] and rest.force_error < min(near, _NEAR):
                near = 0.1 * rest.force_error
                try:
                    now, count = self._reach(self.state, impatient(self.tolerances))
                except NotConverged:
                    if left < NEARLY[1]:
                        return
                    continue
                self._accept(now.state, count)
                return

    def _mixed(self, tried: Sequence[AnyState]) -> AnyState:
        """Go on from the present state by a mixture of what leads to two others."""
        start = self.state
        load = tried[0].load
        mixed = start
        for share, other in zip(self._mixture, tried, strict=True):
            part = start.towards(other, start.load + share * (load - start.load))
            mixed = mixed.following(start, part)
        return mixed.at_load(load)

    def _mix(self, tried: Sequence[AnyState], found: AnyState) -> None:
        """Choose the mixture that would have been nearest to what was found."""
        start = self.loaded.displacement(self.state).ravel()
        ways = [self.loaded.displacement(state).ravel() - start for state in (*tried, found)]
        by_guide, by_line = np.linalg.lstsq(np.stack(ways[:2], 1), ways[2], rcond=_ALIKE)[0]
        self._mixture = float(by_guide), float(by_line)

    def _reach(
        self,
        trial: AnyState,
        wanted: Tolerances,
        drag: Drag[AnyState] | None = None,
        nearly: float = NEARLY[0],
    ) -> tuple[Reached[AnyState], int]:
        """Equilibrium at the load of ``trial``, and the iterations; all of them are counted.

        Where Newton's method fails, what is as near as ``nearly`` counts as one.
        """

        def count(iteration: int, now: Any, krylov: int) -> None:
            self.spent += iteration > 0
            if self.report:
                self.report(trial.load, iteration, now, krylov)

        if self.enough and self.enough():
            raise self._stopped(TOO_LONG)
        wanted = replace(wanted, nearly=nearly)
        try:
            return self.loaded.equilibrate(trial, wanted, count, drag)
        except NotConverged as failure:
            if failure.nearest and nearly_met(failure.nearest[0], wanted):
                return failure.nearest
            raise

    def _tenth(self, error: float) -> Tolerances:
        """Tolerances for a tenth of an error, between the final and the intermediate ones."""
        final = self.tolerances.force
        most = self.intermediate.force / final
        return relaxed(self.tolerances, float(np.clip(0.1 * error / final, 1.0, most)))

    def _force(self, drag: Drag[AnyState], state: AnyState) -> float:
        """What the drag of a step held, as a 2-norm, mN."""
        moved = self.loaded.displacement(state) - self.loaded.displacement(drag.origin)
        return float(np.linalg.norm(drag.viscosity * self.loaded.resistance(moved)))

    def _accept(self, state: AnyState, iterations: int) -> None:
        if self.loaded.covered(state) < COVERED:
            raise self._stopped(SLID_AWAY)
        self.record.append((state.load, iterations))
        self.before, self.state = self.state, state
        if self.visited is not None:
            self.visited.append(state)

    def _stopped(self, reason: object) -> LoadNotReached:
        return LoadNotReached(self.state.load, str(reason))

    def _together(self) -> bool:
        """Whether the bodies moved sideways as a whole, more than otherwise, in the last step."""
        assert self.before is not None  # a step was accepted before
        at, before = (self.loaded.displacement(s) for s in (self.state, self.before))
        step, weights = (at - before)[:2], self.loaded.volumes / self.loaded.volumes.sum()
        together = float(np.linalg.norm((step * weights).sum(1)))
        return together > 0.5 * float(np.sqrt((step**2 * weights).sum()))


def _pressing(forces: Sequence[Array]) -> list[Array]:
    return [np.maximum(force, 0.0) for force in forces]


def _less(forces: Sequence[Array], others: Sequence[Array]) -> list[Array]:
    return [one - other for one, other in zip(forces, others, strict=True)]


def _norm(forces: Sequence[Array]) -> float:
    return float(np.sqrt(sum(float((force**2).sum()) for force in forces)))
