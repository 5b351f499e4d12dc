"""Equilibrium of window, layer, sample and plate: Newton's method along the load path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.experiment.bodies import Body, BodyForces
from optical_palpation.experiment.contact import (
    ContactState,
    ContactTerms,
    Interface,
    Meeting,
    Plane,
    assembled,
    linearise,
    remembered,
)
from optical_palpation.experiment.linear import LinearSolver
from optical_palpation.mechanics.grid import LayerGrid

Array = NDArray[np.float64]
LAYER, SAMPLE = 0, 1
WINDOW, INTERFACE, PLATE, SIDES = 0, 1, 2, 3

#: Smoothing of contact, as a pressure in units of the shear modulus: at first, and in the end.
_SMOOTHING = (3e-2, 1e-3)
#: Least smoothing of the sides' contact, of few nodes and little force.
_SIDES = 1e-2
#: When the full load is reached: out-of-balance forces relative to contact forces, violation of
#: J - 1. Loads on the way to it are reached sooner by ``_ON_THE_WAY``.
_FORCE, _VOLUME = 1e-5, 1e-6
_ON_THE_WAY = 30.0
#: Out-of-balance forces below which the tangent hardly changes any more.
_NEAR = 3e-3


@dataclass(frozen=True, eq=False)
class Assembly:
    """Window (z = 0), layer, sample and plate; nodes are numbered layer first.

    Contacts are those at the window, between layer and sample, at the plate, and of the layer's
    sides with the window, onto which they roll. ``slave_grids`` are the grids of the bodies that
    the slaves of the first three belong to, ``areas`` the slaves' shares of the surface and
    ``scales`` c of their law; ``plate`` the plate's z at rest, ``compression`` its travel, mm;
    ``slip_length`` that of the friction law.
    """

    bodies: tuple[Body, Body]
    contacts: tuple[Plane, Interface, Plane, Plane]
    slave_grids: tuple[LayerGrid, LayerGrid, LayerGrid]
    areas: tuple[Array, Array, Array, Array]
    plate: float
    compression: float
    slip_length: float

    @property
    def n_nodes(self) -> int:
        """Number of nodes of both bodies."""
        return self.bodies[LAYER].n_nodes + self.bodies[SAMPLE].n_nodes

    @property
    def n_elements(self) -> int:
        """Number of elements of both bodies."""
        return sum(body.grid.n_elements for body in self.bodies)

    @property
    def shear_modulus(self) -> float:
        """Shear modulus of the layer, kPa, the scale of pressures."""
        return self.bodies[LAYER].material.shear_modulus

    @property
    def scales(self) -> list[Array]:
        """Scale c of the law of each contact, mN / mm."""
        height = self.bodies[LAYER].grid.spacing()[0]
        return [area * self.shear_modulus / height for area in self.areas]

    def position(self, u: Array) -> Array:
        """Node positions (n_nodes, 3) at displacement ``u`` (n_nodes, 3)."""
        nodes = [body.nodes.reshape(3, -1).T for body in self.bodies]
        return np.concatenate(nodes) + u

    def split(self, u: Array) -> list[Array]:
        """Fields (3, nz + 1, ny + 1, nx + 1) of the two bodies from (n_nodes, 3)."""
        n = self.bodies[LAYER].n_nodes
        return [
            np.ascontiguousarray(part.T).reshape(3, *body.grid.node_shape)
            for part, body in zip((u[:n], u[n:]), self.bodies, strict=True)
        ]

    def meet(self, position: Array, load: float) -> list[Meeting]:
        """Where the slaves of each contact are."""
        window, interface, plate, sides = self.contacts
        height = self.plate - load * self.compression
        return [
            window.meet(position, 0.0),
            interface.meet(position),
            plate.meet(position, height),
            sides.meet(position, 0.0),
        ]


@dataclass(frozen=True, eq=False)
class State:
    """Displacement (n_nodes, 3), element pressures of both bodies, contacts; at one load."""

    load: float
    u: Array
    p: tuple[Array, Array]
    contacts: tuple[ContactState, ...]

    @property
    def forces(self) -> tuple[Array, ...]:
        """Vertical contact forces at window, interface, plate and sides, mN."""
        return tuple(contact.force for contact in self.contacts)

    def moved(self, u: Array, p: tuple[Array, ...], forces: tuple[Array, ...]) -> State:
        """Return the state with other unknowns and the same friction memory."""
        contacts = tuple(
            replace(contact, force=force)
            for contact, force in zip(self.contacts, forces, strict=True)
        )
        return State(self.load, u, (p[0], p[1]), contacts)


class NotConverged(Exception):
    """Newton's method failed at this load; carries the reason."""


class LoadNotReached(Exception):
    """The load path ended early; carries the load reached and the reason."""

    def __init__(self, load: float, reason: str) -> None:
        super().__init__(reason)
        self.load, self.reason = load, reason


@dataclass(frozen=True, eq=False)
class Balance:
    """Internal forces and contact of a state, and how far it is from equilibrium."""

    bodies: list[BodyForces]
    terms: list[ContactTerms]
    internal: Array
    force_error: float
    volume_error: float
    min_jacobian: float


def balance(assembly: Assembly, state: State, smoothing: float = _SMOOTHING[1]) -> Balance:
    """Evaluate equilibrium, incompressibility and contact of a state."""
    parts = [
        body.forces(u, p)
        for body, u, p in zip(assembly.bodies, assembly.split(state.u), state.p, strict=True)
    ]
    internal = np.concatenate([part.force.reshape(3, -1).T for part in parts])
    position = assembly.position(state.u)
    terms = [
        linearise(
            contact.friction,
            meeting,
            own,
            position,
            scale,
            max(smoothing, least) * assembly.shear_modulus * area,
            assembly.slip_length,
        )
        for contact, meeting, own, scale, area, least in zip(
            list[Plane | Interface](assembly.contacts),
            assembly.meet(position, state.load),
            state.contacts,
            assembly.scales,
            assembly.areas,
            (0.0, 0.0, 0.0, _SIDES),
            strict=True,
        )
    ]
    out = internal.copy()
    for term in terms:
        np.add.at(out, term.meeting.nodes, term.residual)
    scale = max(float(np.linalg.norm(np.concatenate(state.forces))), 1e-30)
    violation = np.linalg.norm(np.concatenate([term.violation for term in terms]))
    volume = np.concatenate([(part.volume_residual / part.volume).ravel() for part in parts])
    return Balance(
        bodies=parts,
        terms=terms,
        internal=internal,
        force_error=float(np.hypot(np.linalg.norm(out), violation)) / scale,
        volume_error=float(np.sqrt(np.mean(volume**2))),
        min_jacobian=min(part.min_jacobian for part in parts),
    )


def newton_step(
    assembly: Assembly, state: State, now: Balance, solver: LinearSolver
) -> tuple[Array, list[Array], list[Array]]:
    """Changes of displacement, pressures and contact forces."""
    contact, force = assembled(now.terms, assembly.n_nodes)
    blocks, divergences, lifted = [], [], []
    for body, part, u, p in zip(
        assembly.bodies, now.bodies, assembly.split(state.u), state.p, strict=True
    ):
        tangent, divergence = body.tangent(u, p)
        blocks.append(tangent)
        divergences.append(divergence)
        bulk = body.stiffness * body.material.bulk_modulus / part.volume
        lifted.append(bulk)
        extra = _scatter(divergence, bulk * part.volume_residual)
        start = 0 if body is assembly.bodies[LAYER] else assembly.bodies[LAYER].n_nodes
        force[start : start + body.n_nodes] += extra.reshape(3, -1).T
    matrix = sp.bsr_matrix(sp.block_diag(blocks, "bsr")) + contact
    residual = now.internal + force
    # a trace of stiffness in the tangent alone holds what nothing else holds yet
    hold = 1e-6 * assembly.shear_modulus * assembly.bodies[LAYER].grid.spacing()[2]
    matrix = matrix.tocsr() + hold * sp.identity(matrix.shape[0], format="csr")
    du = solver.solve(matrix, -residual.ravel(), now.force_error < _NEAR).reshape(-1, 3)
    dp = [
        bulk * (_gather(divergence, u) + part.volume_residual)
        for bulk, divergence, u, part in zip(
            lifted, divergences, assembly.split(du), now.bodies, strict=True
        )
    ]
    return du, dp, [term.change_of_force(du) for term in now.terms]


def _corners(divergence: Array) -> list[tuple[int, tuple[slice, slice, slice]]]:
    nz, ny, nx = divergence.shape[0], divergence.shape[1], divergence.shape[3]
    return [
        (
            a,
            (
                slice(a >> 2, (a >> 2) + nz),
                slice((a >> 1) & 1, ((a >> 1) & 1) + ny),
                slice(a & 1, (a & 1) + nx),
            ),
        )
        for a in range(8)
    ]


def _gather(divergence: Array, u: Array) -> Array:
    """Volume change of each element."""
    return sum(
        (divergence[:, :, 3 * a + c] * u[c][at]) for a, at in _corners(divergence) for c in range(3)
    )


def _scatter(divergence: Array, p: Array) -> Array:
    """Nodal forces (3, ...) of element pressures."""
    out = np.zeros((3, *(n + 1 for n in p.shape)))
    for a, at in _corners(divergence):
        for c in range(3):
            out[c][at] += divergence[:, :, 3 * a + c] * p
    return out


def equilibrate(
    assembly: Assembly,
    state: State,
    solver: LinearSolver,
    on_iteration: Callable[[float, Balance], None] | None = None,
    iterations: int = 25,
) -> tuple[State, int]:
    """Return the state in equilibrium at its load, and the number of Newton iterations.

    Raises
    ------
    NotConverged
        When the iterations run out, an element turns inside out or numbers overflow.
    """
    first = not any(contact.memory.any() for contact in state.contacts)
    smoothing = _SMOOTHING[0 if first else 1]
    enough = 1.0 if state.load == 1.0 else _ON_THE_WAY
    now = balance(assembly, state, smoothing)
    for iteration in range(iterations):
        if on_iteration:
            on_iteration(state.load, now)
        if (
            iteration > 0
            and smoothing == _SMOOTHING[1]
            and now.force_error < enough * _FORCE
            and now.volume_error < enough * _VOLUME
        ):
            return state, iteration
        du, dp, dn = newton_step(assembly, state, now, solver)
        if not np.isfinite(du).all():
            raise NotConverged("the linear system could not be solved")
        best: tuple[Balance, State] | None = None
        for fraction in (1.0, 0.5, 0.25, 0.125):
            trial = state.moved(
                state.u + fraction * du,
                tuple(p + fraction * d for p, d in zip(state.p, dp, strict=True)),
                tuple(n + fraction * d for n, d in zip(state.forces, dn, strict=True)),
            )
            after = balance(assembly, trial, smoothing)
            if after.min_jacobian < 0.02 or not np.isfinite(after.force_error):
                continue
            if best is None or after.force_error < best[0].force_error:
                best = after, trial
            # the first step crosses the new load: it may leave more out of balance than it found
            if iteration == 0 or after.force_error < (1 - 0.3 * fraction) * now.force_error:
                break
        if best is None:
            raise NotConverged("an element turned inside out")
        now, state = best
        if now.force_error < 0.3 * smoothing and smoothing > _SMOOTHING[1]:
            smoothing = max(_SMOOTHING[1], 0.2 * smoothing)
            now = balance(assembly, state, smoothing)
    raise NotConverged(f"no convergence in {iterations} Newton iterations")


@dataclass(frozen=True)
class StepControl:
    """Load increments, as fractions of the full load."""

    first: float = 0.1
    largest: float = 0.25
    smallest: float = 2e-3
    easy: int = 8
    #: Newton iterations after which a load counts as not reached.
    iterations: int = 25
    #: The last one is repeated on finer meshes: the smaller, the surer.
    last: float = 0.1


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
    solver: LinearSolver,
    on_iteration: Callable[[float, Balance], None] | None = None,
    control: StepControl | None = None,
    before: State | None = None,
) -> Path:
    """Compress from ``start`` to the full travel of the plate.

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
        load = min(1.0, state.load + step)
        if load > 1.0 - control.last and state.load < 1.0 - 1.5 * control.last:
            load = 1.0 - control.last
        elif 1.0 - load < 0.1 * step:
            load = 1.0
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
