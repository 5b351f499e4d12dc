"""Following the load path from the unloaded layer, with automatic step control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .contact import remember_slip
from .newton import Balance, LinearSolver, NotConverged, Tolerances, equilibrate, on_the_way
from .problem import LayerProblem, LayerState

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepControl:
    """Load increments, as fractions of the full load."""

    first: float = 0.1
    largest: float = 0.3
    smallest: float = 1e-3
    #: A load reached in fewer Newton iterations lets the next increment grow.
    easy: int = 6


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
    start: LayerState,
    full: LayerState,
    control: StepControl | None = None,
    on_iteration: Callable[[float, int, Balance, int], None] | None = None,
) -> tuple[LayerState, list[tuple[float, int]]]:
    """Load the layer fully, from ``start`` on.

    Parameters
    ----------
    start
        A layer in equilibrium, its friction memory laid.
    full
        An estimate of the fully loaded layer, towards which the first step is begun.

    Returns
    -------
    tuple
        The loaded layer, and the record of (load, Newton iterations).

    Raises
    ------
    LoadNotReached
    """
    control = control or StepControl()
    state = before = start
    step = control.first
    record: list[tuple[float, int]] = []
    while state.load < 1.0:
        steps = np.ceil((1.0 - state.load) / step - 1e-9)  # equal ones, not a small last one
        load = 1.0 if steps == 1 else state.load + (1.0 - state.load) / steps
        trial = extrapolated(state, full if before is state else before, load)

        def report(iteration: int, now: Balance, krylov: int, load: float = load) -> None:
            if on_iteration:
                on_iteration(load, iteration, now, krylov)

        try:
            wanted = tolerances if load == 1.0 else on_the_way(tolerances, problem)
            iterations = equilibrate(problem, trial, solver, wanted, report)
        except NotConverged as failure:
            step = 0.5 * (load - state.load)
            if step < control.smallest:
                raise LoadNotReached(state.load, str(failure)) from None
            continue
        record.append((load, iterations))
        if iterations <= control.easy:
            step = min(control.largest, 1.5 * step)
        if load < 1.0:
            remember_slip(problem, trial)
        before, state = state, trial
    return state, record
