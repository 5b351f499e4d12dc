"""Following the load path from the unloaded layer, with automatic step control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .contact import remember_slip
from .newton import Balance, LinearSolver, NotConverged, Tolerances, equilibrate
from .problem import LayerProblem, LayerState

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepControl:
    """Load increments, as fractions of the full load."""

    first: float = 0.1
    largest: float = 0.25
    smallest: float = 1e-3
    #: A load reached in fewer Newton iterations lets the next increment grow.
    easy: int = 6


class LoadNotReached(Exception):
    """The load path ended early; carries the load reached and the last reason."""

    def __init__(self, load: float, reason: str) -> None:
        super().__init__(f"stopped at {100 * load:.1f} % of the load: {reason}")
        self.load = load
        self.reason = reason


def follow(
    problem: LayerProblem,
    solver: LinearSolver,
    tolerances: Tolerances,
    bound_guess: Array,
    control: StepControl | None = None,
    on_iteration: Callable[[float, int, Balance, int], None] | None = None,
) -> tuple[LayerState, LayerState, list[tuple[float, int]]]:
    """Load the layer from rest to the full imprint.

    Parameters
    ----------
    bound_guess
        Estimated contact forces at full load, (ny + 1, nx + 1), mN: a start for the first load.

    Returns
    -------
    tuple
        The state at full load, the last accepted state before it (whose friction memory the final
        step starts from), and the record of (load, Newton iterations).

    Raises
    ------
    LoadNotReached
    """
    control = control or StepControl()
    state = LayerState.unloaded(problem.grid)
    before: LayerState | None = None
    step = control.first
    record: list[tuple[float, int]] = []
    reason = ""
    while state.load < 1.0:
        load = min(1.0, state.load + step)
        if 1.0 - load < 0.1 * step:
            load = 1.0
        trial = state.copy()
        trial.load = load
        if before is not None:
            ratio = (load - state.load) / (state.load - before.load)
            trial.u = state.u + ratio * (state.u - before.u)
            trial.p = state.p + ratio * (state.p - before.p)
            trial.normal_force = np.maximum(
                0.0, state.normal_force + ratio * (state.normal_force - before.normal_force)
            )
        else:
            trial.normal_force[:] = load * bound_guess

        def report(iteration: int, now: Balance, krylov: int, load: float = load) -> None:
            if on_iteration:
                on_iteration(load, iteration, now, krylov)

        try:
            iterations = equilibrate(problem, trial, solver, tolerances, report)
        except NotConverged as failure:
            reason = str(failure)
            step = 0.5 * (load - state.load)
            if step < control.smallest:
                raise LoadNotReached(state.load, reason) from None
            continue
        record.append((load, iterations))
        if iterations <= control.easy:
            step = min(control.largest, 1.5 * step)
        if load == 1.0:
            return trial, state, record
        remember_slip(problem, trial)
        before, state = state, trial
    raise AssertionError("unreachable")
