"""The load path: from the unloaded stack to the full travel of the plate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..iteration import TOLERANCES, NotConverged, Tolerances, relaxed
from ..path import LoadNotReached, StepControl
from .contact import remembered
from .linear import StackSolver
from .newton import Balance, equilibrate
from .problem import LAYER, Stack, State

Array = NDArray[np.float64]

#: How much further from balance an equilibrium on the way may be.
_ON_THE_WAY = 30.0


def tolerances(load: float, stops: Sequence[float] = ()) -> Tolerances:
    """Return when a load is reached."""
    exact = load == 1.0 or load in stops
    return TOLERANCES if exact else relaxed(TOLERANCES, _ON_THE_WAY)


@dataclass
class Path:
    """The last two accepted states and the record of (elements, load, Newton iterations).

    ``stops`` are the states in equilibrium at the loads that were asked for.
    """

    state: State
    previous: State
    record: list[tuple[int, float, int]] = field(default_factory=list)
    stops: list[State] = field(default_factory=list)


def follow(
    stack: Stack,
    start: State,
    guess: tuple[Array, ...],
    solver: StackSolver,
    on_iteration: Callable[[float, Balance], None] | None = None,
    control: StepControl | None = None,
    before: State | None = None,
    target: float = 1.0,
    stops: Sequence[float] = (),
) -> Path:
    """Compress from ``start`` to a load, by default the full travel of the plate.

    The first step is extrapolated from ``before`` if given; otherwise ``guess``, estimated contact
    forces at full load, starts it. The states at the loads ``stops``, none of them before the
    start, are kept.

    Raises
    ------
    LoadNotReached
    """
    control = control or StepControl()
    state = start
    step, record = control.first, []
    ends, kept = sorted({*stops, target}), list[State]()
    while True:
        end = next(load for load in ends if load > state.load)
        steps = np.ceil((end - state.load) / step - 1e-9)  # equal ones, not a small last one
        load = end if steps == 1 else state.load + float((end - state.load) / steps)
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
            u[stack.bodies[LAYER].n_nodes :, 2] -= load * stack.compression
            trial = trial.moved(u, state.p, tuple(load * force for force in guess))
        try:
            reached, count = equilibrate(
                stack, trial, solver, tolerances(load, stops), on_iteration
            )
        except NotConverged as failure:
            step = 0.5 * (load - state.load)
            if step < control.smallest:
                raise LoadNotReached(state.load, str(failure)) from None
            continue
        record.append((stack.n_elements, load, count))
        if load in stops:
            kept.append(reached)
        if load == 1.0:
            return Path(reached, state, record, kept)
        if count <= control.easy:
            step = min(control.largest, 1.5 * step)
        before, state = state, remember(stack, reached)
        if load == target:
            return Path(state, before, record, kept)


def remember(stack: Stack, state: State) -> State:
    """Return the state from which the next load starts: friction remembers, anchors move."""
    position = stack.position(state.u)
    contacts = tuple(
        remembered(projection, contact, position, scale, stack.slip_length)
        for projection, contact, scale in zip(
            stack.project(position, state.load), state.contacts, stack.scales, strict=True
        )
    )
    layer, sample = (
        own.remembered(u, stack.slip_length, side.normal_force > 0)
        for own, u, side in zip(
            state.sides, stack.at_sides(state.u), stack.side_contacts(state), strict=True
        )
    )
    return replace(state, contacts=contacts, sides=(layer, sample))
