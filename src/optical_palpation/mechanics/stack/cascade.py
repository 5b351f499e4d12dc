"""From coarse to fine: the load path begins on a coarse mesh and ends on the finest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..iteration import TOLERANCES, NotConverged, relaxed
from ..path import Guide, LoadNotReached, Path, StepControl
from .contact import ContactState, SideState
from .newton import Balance, LoadedStack, equilibrate, make_solver
from .problem import Stack, State, at_rest, fully_loaded

Array = NDArray[np.float64]
Report = Callable[[Stack, float, Balance], None]

#: Tolerances at the full load and on the way. Bodies that press on each other under the edges of a
#: stiff one carry forces that agree less than each body is out of balance.
FINAL, _ON_THE_WAY = relaxed(TOLERANCES, 0.2), relaxed(TOLERANCES, 6.0)
#: Load increments, longer ones than those of a layer on an imprint: with two and a half iterations
#: for each the forces are the same, and a solution takes nearly half as many again.
_CONTROL = StepControl(largest=0.3, iterations=6)
#: Fraction of the full load at which a solution changes meshes. Friction depends on the path, and
#: what happens late, at the free edges above all, depends on the mesh.
_HANDOVER = 0.25
#: Factor by which friction is softened while it does.
_CHANGE_OF_MESH = 20.0


@dataclass
class Solution:
    """The compressed stack, and how it was reached.

    ``record`` lists (elements, load, Newton iterations) of every accepted equilibrium, ``stops``
    are the states at the loads that were asked for. ``paths`` has the accepted states of each
    mesh.
    """

    state: State
    record: list[tuple[int, float, int]]
    stops: list[State]
    paths: list[list[State]]


def solve(
    levels: list[Stack],
    report: Report | None = None,
    stops: Sequence[float] = (),
    control: StepControl | None = None,
    target: float = 1.0,
    similar: Sequence[list[State]] | None = None,
) -> Solution:
    """Compress to a share ``target`` of the full travel; ``levels`` are meshes, coarse to fine.

    The states of the finest mesh at the loads ``stops`` are kept. The paths of a ``similar`` stack
    on the same meshes, if they are given, guide the way.

    Raises
    ------
    LoadNotReached
        When the load is not reached on some mesh.
    """
    path: Path[State] | None = None
    record: list[tuple[int, float, int]] = []
    kept: list[State] | None = None
    paths: list[list[State]] = []
    handover = min(_HANDOVER, *(0.5 * load for load in stops)) if stops else _HANDOVER
    for n, level in enumerate(levels):
        to, here = (target, stops) if level is levels[-1] else (handover, ())
        guide = _guide(similar[n]) if similar else None
        kept = None
        if path is not None:
            try:
                path = _carried(path, levels[n - 1], level, report, guide)
                kept = path.follow(path.state, to, here)
            except (NotConverged, LoadNotReached):
                kept = None
        if path is None or kept is None:
            path = _path(level, at_rest(level), report, control, guide=guide)
            kept = path.follow(fully_loaded(level), to, here)
        record += [(level.n_elements, *step) for step in path.record]
        assert path.visited is not None
        paths.append(path.visited)
    assert path is not None
    assert kept is not None
    return Solution(path.state, record, kept, paths)


def _path(
    stack: Stack,
    state: State,
    report: Report | None,
    control: StepControl | None,
    before: State | None = None,
    guide: Guide[State] | None = None,
) -> Path[State]:
    """Return a load path from a state on."""
    if guide and (guide.loads[0] > state.load or guide.loads[0] == guide.loads[-1]):
        guide = None

    def on_iteration(load: float, iteration: int, now: Balance, krylov: int) -> None:
        if report:
            report(stack, load, now)

    loaded = LoadedStack(stack, make_solver(stack))
    return Path(
        loaded,
        FINAL,
        _ON_THE_WAY,
        state,
        control or _CONTROL,
        on_iteration,
        before,
        guide=guide,
        visited=[],
    )


def _guide(path: list[State]) -> Guide[State]:
    return Guide([state.load for state in path], path.__getitem__)


def _carried(
    path: Path[State],
    coarse: Stack,
    fine: Stack,
    report: Report | None,
    guide: Guide[State] | None,
) -> Path[State]:
    """Return a path that goes on from where one on a coarser mesh has come."""
    assert path.before is not None  # it has gone to the handover
    state, before = (_prolonged(s, coarse, fine) for s in (path.state, path.before))
    step_u = state.u - before.u
    step_p = [p - q for p, q in zip(state.p, before.p, strict=True)]
    step_n = [n - m for n, m in zip(state.forces, before.forces, strict=True)]
    # The bodies move by micrometres from one mesh to the next. That is no slip: they do so under a
    # friction that hardly feels it, and the memory is laid anew.
    soft = replace(fine, slip_length=_CHANGE_OF_MESH * fine.slip_length)

    def on_iteration(iteration: int, now: Balance, krylov: int) -> None:
        if report:
            report(fine, state.load, now)

    now, count = equilibrate(soft, state, make_solver(fine), _ON_THE_WAY, on_iteration)
    state = _anchored(now.state, fine)
    before = replace(state, load=before.load).moved(
        state.u - step_u,
        tuple(p - d for p, d in zip(state.p, step_p, strict=True)),
        tuple(n - d for n, d in zip(state.forces, step_n, strict=True)),
    )
    path = _path(fine, state, report, replace(_CONTROL, first=_CONTROL.largest), before, guide)
    path.record.append((state.load, count))
    return path


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
