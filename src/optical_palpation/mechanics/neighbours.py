"""Problems that differ slightly from one, each followed along that one's load path.

Friction remembers the path of loading, so what a small change of the problem does to the solution
is not told by its last state. Its neighbours are therefore loaded beside it, at the same loads and
on the same grids. Each begins at a load from the state there of the problem itself and from what it
differed by at the load before, which is so near that a step or two by the tangent of the problem
itself are enough. What they remember is their own: each ends where it would have ended alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from .contact import remember_slip
from .effort import Effort, counted
from .iteration import NotConverged, Tolerances
from .newton import LinearSolver, Solvers, equilibrate, equilibrate_by
from .path import TOO_LONG, LoadNotReached
from .problem import LayerProblem, LayerState
from .system import assemble

#: A neighbour returns the problem that it is, on the grid of a given one.
Vary = Callable[[LayerProblem], LayerProblem]
#: Between neighbours that differ by one percent in the total force.
_TOLERANCES = Tolerances(force=1e-4, volume=1e-5, iterations=8)
#: How often an increment of the load is halved where one of them does not arrive.
_HALVINGS = 1
#: Effort, s, that they may take: on most maps they take 1 to 6 s, but hard ones without end.
PATIENCE = 10.0


class Neighbours:
    """The problem itself, to the neighbours' tolerances, and its neighbours.

    Attributes
    ----------
    most
        Elements of the largest grid on which a whole load path is followed.
    problems, states
        On the grid that they were followed on; the problem itself comes first.
    failure
        Why there are none; empty if there are.
    begun
        Whether a load path was followed, or at least begun.
    """

    def __init__(self, vary: Sequence[Vary], most: int) -> None:
        self._vary: tuple[Vary, ...] = (lambda problem: problem, *vary)
        self.most = most
        self.problems: list[LayerProblem] = []
        self.states: list[LayerState] = []
        self.begun = False
        self.failure = "the load was not followed"

    def begin(
        self, problem: LayerProblem, rest: LayerState, solver: LinearSolver | Solvers
    ) -> None:
        """Begin a load path with an unloaded layer, and a linear solver for the neighbours alone.

        What a solver has learnt from them must not touch the problem.
        """
        self.problems = [vary(problem) for vary in self._vary]
        self.states = [rest for _ in self._vary]
        self.begun, self.failure = True, ""
        self._beside, self._solver, self._effort = rest, solver, Effort()

    def stop(self, failure: str) -> None:
        """Follow no further."""
        self.problems, self.states, self.failure = [], [], failure

    def load(self, state: LayerState) -> None:
        """Follow to a state of the problem, its reference slip laid."""
        if self.failure:
            return
        before, self._beside = self._beside, state
        with counted(self._effort):
            try:
                self._follow(before, state, _HALVINGS)
            except NotConverged as failure:
                self.stop(f"a slightly different layer {LoadNotReached(before.load, str(failure))}")

    def _follow(self, before: LayerState, state: LayerState, halvings: int) -> None:
        """Follow from one state of the problem to another, all in increments as large.

        Raises
        ------
        NotConverged
        """
        trials = [_shifted(state, before, mine) for mine in self.states]
        try:
            self.states = self._equilibrated(trials)
        except NotConverged:
            if halvings == 0 or before.load == 0.0:  # contact that is made is no nearer by half
                raise
            middle = state.towards(before, 0.5 * (before.load + state.load))
            self._follow(before, middle, halvings - 1)
            self._follow(middle, state, halvings - 1)
            return
        if state.load < 1.0:
            for problem, mine in zip(self.problems, self.states, strict=True):
                remember_slip(problem, mine)

    def _equilibrated(self, trials: Sequence[LayerState]) -> list[LayerState]:
        """Bring all into equilibrium, from where each is expected.

        The problem itself comes first; where that is off, so are the others.
        """
        first, *others = self.problems
        now, _ = equilibrate(first, trials[0], self._solver, _TOLERANCES, self._watch)
        shifted = [_shifted(now.state, trials[0], trial) for trial in trials[1:]]
        linear = self._solver.last if isinstance(self._solver, Solvers) else self._solver
        system = assemble(first, now, linear)
        near = [
            equilibrate_by(system, problem, trial, linear, _TOLERANCES)
            for problem, trial in zip(others, shifted, strict=True)
        ]
        states = [now.state]
        for problem, trial, state in zip(others, shifted, near, strict=True):
            if state is None:  # its own tangents lead further
                own, _ = equilibrate(problem, trial, self._solver, _TOLERANCES, self._watch)
                state = own.state
            states.append(state)
        return states

    def _watch(self, *_: object) -> None:
        """Look in each iteration whether they take too long, which is none of the problem's time.

        Raises
        ------
        NotConverged
        """
        if self._effort.spent > PATIENCE:
            raise NotConverged(TOO_LONG)


def _shifted(state: LayerState, before: LayerState, mine: LayerState) -> LayerState:
    """Return a state shifted by what mine differed from the one before, with my reference slip."""
    normal = state.normal_force + (mine.normal_force - before.normal_force)
    return replace(
        state,
        u=state.u + (mine.u - before.u),
        p=state.p + (mine.p - before.p),
        normal_force=normal,
        slip=mine.slip.copy(),
        anchor=mine.anchor.copy(),
        anchor_load=mine.anchor_load,
    )
