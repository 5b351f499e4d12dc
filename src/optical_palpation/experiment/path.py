"""The load path: from the unloaded assembly to the full travel of the plate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from optical_palpation.experiment.contact import remembered
from optical_palpation.experiment.equilibrium import (
    LAYER,
    Assembly,
    Balance,
    NotConverged,
    State,
    equilibrate,
)
from optical_palpation.mechanics.stack import StackSolver

Array = NDArray[np.float64]


class LoadNotReached(Exception):
    """The load path ended early; carries the load reached and the reason."""

    def __init__(self, load: float, reason: str) -> None:
        super().__init__(reason)
        self.load, self.reason = load, reason


@dataclass(frozen=True)
class StepControl:
    """Load increments, as fractions of the full load."""

    first: float = 0.1
    largest: float = 0.25
    smallest: float = 2e-3
    easy: int = 8
    #: Newton iterations after which a load counts as not reached.
    iterations: int = 25


@dataclass
class Path:
    """The last two accepted states and the record of (elements, load, Newton iterations)."""

    state: State
    previous: State
    record: list[tuple[int, float, int]] = field(default_factory=list)


def follow(
    assembly: Assembly,
    start: State,
    guess: tuple[Array, ...],
    solver: StackSolver,
    on_iteration: Callable[[float, Balance], None] | None = None,
    control: StepControl | None = None,
    before: State | None = None,
    target: float = 1.0,
) -> Path:
    """Compress from ``start`` to a load, by default the full travel of the plate.

    The first step is extrapolated from ``before`` if given; otherwise ``guess``, estimated contact
    forces at full load, starts it.

    Raises
    ------
    LoadNotReached
    """
    control = control or StepControl()
    state = start
    step, record = control.first, []
    while True:
        steps = np.ceil((target - state.load) / step - 1e-9)  # equal ones, not a small last one
        load = target if steps == 1 else state.load + float((target - state.load) / steps)
        trial = replace(state, load=load)
        if before is not None:
            ratio = (load - state.load) / (state.load - before.load)
            trial = trial.moved(
                state.u + ratio * (state.u - before.u),
                tuple(p + ratio * (p - q) for p, q in zip(state.p, before.p, strict=True)),
                tuple(
                    np.maximum(0.0, n + ratio * (n - m))
                    for n, m in zip(state.forces, before.forces, strict=True)
                ),
            )
        else:
            u = state.u.copy()
            u[assembly.bodies[LAYER].n_nodes :, 2] -= load * assembly.compression
            trial = trial.moved(u, state.p, tuple(load * force for force in guess))
        try:
            reached, count = equilibrate(assembly, trial, solver, on_iteration, control.iterations)
        except NotConverged as failure:
            step = 0.5 * (load - state.load)
            if step < control.smallest:
                raise LoadNotReached(state.load, str(failure)) from None
            continue
        record.append((assembly.n_elements, load, count))
        if load == 1.0:
            return Path(reached, state, record)
        if count <= control.easy:
            step = min(control.largest, 1.5 * step)
        before, state = state, remember(assembly, reached)
        if load == target:
            return Path(state, before, record)


def remember(assembly: Assembly, state: State) -> State:
    """Return the state from which the next load starts: friction remembers, anchors move."""
    position = assembly.position(state.u)
    contacts = tuple(
        remembered(meeting, contact, position, scale, assembly.slip_length)
        for meeting, contact, scale in zip(
            assembly.meet(position, state.load), state.contacts, assembly.scales, strict=True
        )
    )
    return replace(state, contacts=contacts)
