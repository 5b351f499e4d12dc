"""Problems that differ slightly from one, each followed along that one's load path.

Friction remembers the path of loading, so what a small change of the problem does to the solution
is not told by its last state. Its neighbours are therefore loaded beside it, at the same loads and
on the same grids. Each begins at a load from the state there of the problem itself and from what it
differed by at the load before, which is so near that a Newton iteration or two are enough. What
they remember is their own: each ends where it would have ended alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from .contact import remember_slip
from .iteration import NotConverged, Tolerances
from .newton import LinearSolver, equilibrate
from .problem import LayerProblem, LayerState

#: A neighbour returns the problem that it is, on the grid of a given one.
Vary = Callable[[LayerProblem], LayerProblem]
#: Between neighbours that differ by one percent in the total force.
_TOLERANCES = Tolerances(force=1e-4, volume=1e-5, iterations=8)


class Neighbours:
    """The problem itself, to the neighbours' tolerances, and its neighbours.

    Attributes
    ----------
    problems, states
        On the last grid that they were followed on; the problem itself comes first.
    failure
        Why there are none; empty if there are.
    """

    def __init__(self, vary: Sequence[Vary]) -> None:
        self._vary: tuple[Vary, ...] = (lambda problem: problem, *vary)
        self.problems: list[LayerProblem] = []
        self.states: list[LayerState] = []
        self.failure = "the load was not followed"
        self._beside: LayerState | None = None

    def begin(self, problem: LayerProblem, rest: LayerState) -> None:
        """Begin a load path with an unloaded layer."""
        self.problems = [vary(problem) for vary in self._vary]
        self.states = [rest for _ in self._vary]
        self._beside, self.failure = rest, ""

    def stop(self, failure: str) -> None:
        """Follow no further."""
        self.problems, self.states, self.failure = [], [], failure

    def load(self, solver: LinearSolver, state: LayerState) -> None:
        """Follow to a state of the problem, its reference slip laid."""
        if not self.failure:
            assert self._beside is not None
            self._equilibrate(solver, state, self._beside, self.states)
            self._beside = state

    def carry(
        self,
        prolong: Callable[[LayerState, LayerProblem, LayerProblem], LayerState],
        coarse: LayerState,
        problem: LayerProblem,
        solver: LinearSolver,
        state: LayerState,
    ) -> None:
        """Go on to a finer grid, on which the problem has gone from ``coarse`` to ``state``."""
        if self.failure:
            return
        finer = [vary(problem) for vary in self._vary]
        each = zip(self.states, self.problems, finer, strict=True)
        carried = [prolong(mine, before, after) for mine, before, after in each]
        beside = prolong(coarse, self.problems[0], problem)
        self.problems = finer
        self._equilibrate(solver, state, beside, carried)
        self._beside = state

    def _equilibrate(
        self,
        solver: LinearSolver,
        state: LayerState,
        beside: LayerState,
        before: Sequence[LayerState],
    ) -> None:
        """Bring all into equilibrium at a state, from what they were when it was ``beside`` them.

        The problem itself, with its own reference slip, comes first, and the others start from it.
        """
        states: list[LayerState] = []
        try:
            for problem, mine in zip(self.problems, before, strict=True):
                trial = (
                    _shifted(states[0], before[0], mine)
                    if states
                    else _shifted(state, beside, mine)
                )
                now, _ = equilibrate(problem, trial, solver, _TOLERANCES, near=True)
                states.append(now.state)
        except NotConverged as failure:
            at = f"{state.load:.0%} of the load"
            self.stop(f"a slightly different layer stopped at {at}: {failure}")
            return
        if state.load < 1.0:
            for problem, mine in zip(self.problems, states, strict=True):
                remember_slip(problem, mine)
        self.states = states


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
