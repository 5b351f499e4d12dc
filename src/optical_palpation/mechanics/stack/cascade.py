"""From coarse to fine: the load path begins on a coarse mesh and ends on the finest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..iteration import NotConverged
from ..path import LoadNotReached, StepControl
from .contact import ContactState, SideState
from .linear import StackSolver
from .newton import Balance, equilibrate, make_solver
from .path import Path, follow, tolerances
from .problem import Stack, State, at_rest, column_forces

Array = NDArray[np.float64]
Report = Callable[[Stack, float, Balance], None]

#: Fraction of the full load at which a solution changes meshes. Friction depends on the path, and
#: what happens late, at the free edges above all, depends on the mesh.
_HANDOVER = 0.25
#: Factor by which friction is softened while it does.
_CHANGE_OF_MESH = 20.0


def solve(levels: list[Stack], report: Report | None = None, stops: Sequence[float] = ()) -> Path:
    """Compress to the full travel; ``levels`` are meshes of one scene, coarse to fine.

    The states of the finest mesh at the loads ``stops`` are kept.

    Raises
    ------
    LoadNotReached
        When the full load is not reached on some mesh.
    """
    path: Path | None = None
    handover = min(_HANDOVER, *(0.5 * load for load in stops)) if stops else _HANDOVER
    for n, level in enumerate(levels):
        last = level is levels[-1]
        target, here = (1.0, stops) if last else (handover, ())

        def on_iteration(load: float, now: Balance, level: Stack = level) -> None:
            if report:
                report(level, load, now)

        solver = make_solver(level)
        if path is not None:
            try:
                path = _carried(path, levels[n - 1], level, solver, on_iteration, target, here)
                continue
            except (NotConverged, LoadNotReached):
                pass
        record = path.record if path is not None else []
        guess = column_forces(level)
        path = follow(level, at_rest(level), guess, solver, on_iteration, target=target, stops=here)
        path.record[:0] = record
    assert path is not None
    return path


def _carried(
    path: Path,
    coarse: Stack,
    fine: Stack,
    solver: StackSolver,
    on_iteration: Callable[[float, Balance], None],
    target: float,
    stops: Sequence[float],
) -> Path:
    """Go on with a path on a finer mesh."""
    state, before = (_prolonged(s, coarse, fine) for s in (path.state, path.previous))
    step_u = state.u - before.u
    step_p = [p - q for p, q in zip(state.p, before.p, strict=True)]
    step_n = [n - m for n, m in zip(state.forces, before.forces, strict=True)]
    # The bodies move by micrometres from one mesh to the next. That is no slip: they do so under a
    # friction that hardly feels it, and the memory is laid anew.
    soft = replace(fine, slip_length=_CHANGE_OF_MESH * fine.slip_length)
    state, count = equilibrate(soft, state, solver, tolerances(state.load), on_iteration)
    state = _anchored(state, fine)
    record = [*path.record, (fine.n_elements, state.load, count)]
    before = replace(state, load=before.load).moved(
        state.u - step_u,
        tuple(p - d for p, d in zip(state.p, step_p, strict=True)),
        tuple(n - d for n, d in zip(state.forces, step_n, strict=True)),
    )
    if state.load == target:
        return Path(state, before, record)
    control = StepControl(first=StepControl.largest)
    rest = follow(fine, state, state.forces, solver, on_iteration, control, before, target, stops)
    return Path(rest.state, rest.previous, record + rest.record, rest.stops)


def _prolonged(state: State, coarse: Stack, fine: Stack) -> State:
    """Interpolate a state to another mesh of the same scene."""
    pairs = list(zip(fine.bodies, coarse.bodies, strict=True))
    fields = [
        to.grid.interpolate_from(of.grid, u)
        for (to, of), u in zip(pairs, coarse.split(state.u), strict=True)
    ]
    contacts = []
    for n, contact in enumerate(state.contacts):
        to, of = fine.slave_grids[n], coarse.slave_grids[n]
        shape = of.node_shape[1:]
        pressure = (contact.force / coarse.areas[n]).reshape(shape)
        memory = contact.memory.T.reshape(2, *shape)
        force = to.interpolate_from(of, pressure).ravel() * fine.areas[n]
        contacts.append((force, to.interpolate_from(of, memory).reshape(2, -1).T))
    p = tuple(
        to.grid.interpolate_cells_from(of.grid, p)
        for (to, of), p in zip(pairs, state.p, strict=True)
    )
    u = np.concatenate([field.reshape(3, -1).T for field in fields])
    sides = [
        SideState(to.grid.interpolate_sides_from(of.grid, own.memory), place)
        for (to, of), own, place in zip(pairs, state.sides, fine.at_sides(u), strict=True)
    ]
    position = fine.position(u)
    return State(
        load=state.load,
        u=u,
        p=(p[0], p[1]),
        contacts=tuple(
            ContactState(force, memory, projection, projection.lateral(position))
            for (force, memory), projection in zip(
                contacts, fine.project(position, state.load), strict=True
            )
        ),
        sides=(sides[0], sides[1]),
    )


def _anchored(state: State, stack: Stack) -> State:
    """Return the state with the anchors where it is and the friction memory it had."""
    position = stack.position(state.u)
    contacts = tuple(
        replace(contact, anchor=projection, offset=projection.lateral(position))
        for contact, projection in zip(
            state.contacts, stack.project(position, state.load), strict=True
        )
    )
    layer, sample = (
        replace(own, anchor=place)
        for own, place in zip(state.sides, stack.at_sides(state.u), strict=True)
    )
    return replace(state, contacts=contacts, sides=(layer, sample))
