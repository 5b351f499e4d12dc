"""From coarse to fine: the load path on a coarse mesh, its last step again on finer ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from optical_palpation.experiment.assembly import at_rest, column_forces
from optical_palpation.experiment.contact import ContactState
from optical_palpation.experiment.equilibrium import (
    Assembly,
    Balance,
    NotConverged,
    State,
    equilibrate,
)
from optical_palpation.experiment.linear import LinearSolver
from optical_palpation.experiment.path import LoadNotReached, Path, StepControl, follow

Array = NDArray[np.float64]
Report = Callable[[Assembly, float, Balance], None]

#: Factor by which friction is softened while a solution changes meshes.
_CHANGE_OF_MESH = 20.0
#: Newton iterations after which a step on a finer mesh is halved.
_PATIENCE = 20


def solve(levels: list[Assembly], report: Report | None = None) -> Path:
    """Compress to the full travel; ``levels`` are meshes of one scene, coarse to fine.

    Raises
    ------
    LoadNotReached
        When the full load is not reached on some mesh.
    """
    path: Path | None = None
    for n, level in enumerate(levels):

        def on_iteration(load: float, now: Balance, level: Assembly = level) -> None:
            if report:
                report(level, load, now)

        with LinearSolver() as solver:
            if path is not None:
                try:
                    path = _refined(path, levels[n - 1], level, solver, on_iteration)
                    continue
                except (NotConverged, LoadNotReached):
                    pass
            record = path.record if path is not None else []
            path = follow(level, at_rest(level), column_forces(level), solver, on_iteration)
            path.record[:0] = record
    assert path is not None
    return path


def _refined(
    path: Path,
    coarse: Assembly,
    fine: Assembly,
    solver: LinearSolver,
    on_iteration: Callable[[float, Balance], None],
) -> Path:
    """Repeat the last load step of a path on a finer mesh."""
    state, previous = (_prolonged(s, coarse, fine) for s in (path.state, path.previous))
    step_u = state.u - previous.u
    step_p = [p - q for p, q in zip(state.p, previous.p, strict=True)]
    record = list(path.record)
    if previous.load > 0:
        # The bodies move by micrometres from one mesh to the next. That is no slip: they do so
        # under a friction that hardly feels it, and the memory is laid anew.
        soft = replace(fine, slip_length=_CHANGE_OF_MESH * fine.slip_length)
        previous, count = equilibrate(soft, previous, solver, on_iteration, _PATIENCE)
        previous = _anchored(previous, fine)
        record.append((fine.n_elements, previous.load, count))
    # extrapolated from here the next step is that of the coarse mesh
    before = replace(previous, load=2 * previous.load - 1.0).moved(
        previous.u - step_u,
        tuple(p - d for p, d in zip(previous.p, step_p, strict=True)),
        tuple(2 * n - m for n, m in zip(previous.forces, state.forces, strict=True)),
    )
    control = StepControl(first=1.0 - previous.load, iterations=_PATIENCE)
    rest = follow(fine, previous, column_forces(fine), solver, on_iteration, control, before)
    return Path(rest.state, rest.previous, record + rest.record)


def _prolonged(state: State, coarse: Assembly, fine: Assembly) -> State:
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
    position = fine.position(u)
    return State(
        load=state.load,
        u=u,
        p=(p[0], p[1]),
        contacts=tuple(
            ContactState(force, memory, meeting, meeting.lateral(position))
            for (force, memory), meeting in zip(
                contacts, fine.meet(position, state.load), strict=True
            )
        ),
    )


def _anchored(state: State, assembly: Assembly) -> State:
    """Return the state with the anchors where it is and the friction memory it had."""
    position = assembly.position(state.u)
    contacts = tuple(
        replace(contact, anchor=meeting, offset=meeting.lateral(position))
        for contact, meeting in zip(
            state.contacts, assembly.meet(position, state.load), strict=True
        )
    )
    return replace(state, contacts=contacts)
