"""Equilibrium of window, layer, sample and plate at one load, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.experiment.bodies import condensed_tangent
from optical_palpation.experiment.contact import (
    ContactState,
    ContactTerms,
    Sides,
    assembled,
    linearise,
)
from optical_palpation.experiment.linear import LinearSolver
from optical_palpation.experiment.meeting import Interface, Meeting, Plane
from optical_palpation.mechanics.body import Body, ElementForces
from optical_palpation.mechanics.contact import friction_direction
from optical_palpation.mechanics.grid import LayerGrid

Array = NDArray[np.float64]
LAYER, SAMPLE = 0, 1
WINDOW, INTERFACE, PLATE = 0, 1, 2

#: Smoothing of contact, as a pressure in units of the shear modulus: at first, and in the end.
_SMOOTHING = (3e-2, 1e-3)
#: When the full load is reached: out-of-balance forces relative to contact forces, violation of
#: J - 1. Loads on the way to it are reached sooner by ``_ON_THE_WAY``.
_FORCE, _VOLUME = 1e-5, 1e-6
_ON_THE_WAY = 30.0
#: Out-of-balance forces below which the tangent hardly changes any more.
_NEAR = 3e-3


@dataclass(frozen=True, eq=False)
class Assembly:
    """Window (z = 0), layer, sample and plate; nodes are numbered layer first.

    ``contacts`` are those at the window, between layer and sample and at the plate, ``sides`` that
    of the layer's sides. ``slave_grids`` are the grids of the bodies that the slaves belong to,
    ``areas`` the slaves' shares of the surface and ``scales`` c of their law; ``plate`` the plate's
    z at rest, ``compression`` its travel, mm; ``slip_length`` that of the friction law.
    """

    bodies: tuple[Body, Body]
    contacts: tuple[Plane, Interface, Plane]
    sides: Sides
    slave_grids: tuple[LayerGrid, LayerGrid, LayerGrid]
    areas: tuple[Array, Array, Array]
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
        return self.bodies[LAYER].law.shear_modulus

    @property
    def scales(self) -> list[Array]:
        """Scale c of the law of each contact, mN / mm."""
        height = self.bodies[LAYER].grid.spacing[0]
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
        window, interface, plate = self.contacts
        height = self.plate - load * self.compression
        return [
            window.meet(position, 0.0),
            interface.meet(position),
            plate.meet(position, height),
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
        """Vertical contact forces at window, interface and plate, mN."""
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


@dataclass(frozen=True, eq=False)
class Balance:
    """Internal forces and contact of a state, and how far it is from equilibrium.

    ``internal`` (n_nodes, 3) includes the contact of the sides.
    """

    bodies: list[ElementForces]
    terms: list[ContactTerms]
    internal: Array
    force_error: float
    volume_error: float
    min_jacobian: float


def balance(
    assembly: Assembly,
    state: State,
    smoothing: float = _SMOOTHING[1],
    directions: Sequence[Array] | None = None,
) -> Balance:
    """Evaluate equilibrium, incompressibility and contact of a state (see ``linearise``)."""
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
            smoothing * assembly.shear_modulus * area,
            assembly.slip_length,
            direction,
        )
        for contact, meeting, own, scale, area, direction in zip(
            list[Plane | Interface](assembly.contacts),
            assembly.meet(position, state.load),
            state.contacts,
            assembly.scales,
            assembly.areas,
            directions or (None,) * 3,
            strict=True,
        )
    ]
    internal[assembly.sides.nodes, 2] -= assembly.sides.force(position)[0]
    out = internal.copy()
    for term in terms:
        np.add.at(out, term.meeting.nodes, term.residual)
    scale = max(float(np.linalg.norm(np.concatenate(state.forces))), 1e-30)
    violation = np.linalg.norm(np.concatenate([term.violation for term in terms]))
    volume = np.concatenate(
        [(part.volume_residual / part.reference_volume).ravel() for part in parts]
    )
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
        tangent, divergence = condensed_tangent(body, u, p)
        blocks.append(tangent)
        divergences.append(divergence)
        bulk = body.bulk_modulus / part.reference_volume
        lifted.append(bulk)
        extra = _scatter(divergence, bulk * part.volume_residual)
        start = 0 if body is assembly.bodies[LAYER] else assembly.bodies[LAYER].n_nodes
        force[start : start + body.n_nodes] += extra.reshape(3, -1).T
    residual = now.internal + force
    # a trace of stiffness in the tangent alone holds what nothing else holds yet
    hold = 1e-6 * assembly.shear_modulus * assembly.bodies[LAYER].grid.spacing[2]
    held = np.full((assembly.n_nodes, 3), hold)
    held[assembly.sides.nodes, 2] += assembly.sides.force(assembly.position(state.u))[1]
    matrix = _stacked(blocks) + contact + _diagonal(held)
    du = solver.solve(matrix, -residual.ravel(), now.force_error < _NEAR).reshape(-1, 3)
    dp = [
        bulk * (_gather(divergence, u) + part.volume_residual)
        for bulk, divergence, u, part in zip(
            lifted, divergences, assembly.split(du), now.bodies, strict=True
        )
    ]
    return du, dp, [term.change_of_force(du) for term in now.terms]


def _stacked(blocks: list[sp.bsr_matrix]) -> sp.bsr_matrix:
    """Block-diagonal matrix of two."""
    first, second = blocks
    n = first.indptr.size - 1
    parts = (
        np.concatenate([first.data, second.data]),
        np.concatenate([first.indices, second.indices + n]),
        np.concatenate([first.indptr, second.indptr[1:] + first.indptr[-1]]),
    )
    size = first.shape[0] + second.shape[0]
    return sp.bsr_matrix(parts, shape=(size, size))


def _diagonal(values: Array) -> sp.bsr_matrix:
    """Diagonal matrix of values (n, 3)."""
    n = len(values)
    blocks = values[:, :, None] * np.eye(3)
    return sp.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))


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
    directions = [friction_direction(contact.memory) for contact in state.contacts]
    now = balance(assembly, state, smoothing, directions)
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
        turns = [
            term.turn(du, direction, assembly.slip_length)
            for term, direction in zip(now.terms, directions, strict=True)
        ]
        best: tuple[Balance, State, list[Array]] | None = None
        for fraction in (1.0, 0.5, 0.25, 0.125):
            trial = state.moved(
                state.u + fraction * du,
                tuple(p + fraction * d for p, d in zip(state.p, dp, strict=True)),
                tuple(n + fraction * d for n, d in zip(state.forces, dn, strict=True)),
            )
            turned = [d + fraction * turn for d, turn in zip(directions, turns, strict=True)]
            turned = [d / np.maximum(1.0, np.linalg.norm(d, axis=1)[:, None]) for d in turned]
            after = balance(assembly, trial, smoothing, turned)
            if after.min_jacobian < 0.02 or not np.isfinite(after.force_error):
                continue
            if best is None or after.force_error < best[0].force_error:
                best = after, trial, turned
            # the first step crosses the new load: it may leave more out of balance than it found
            if iteration == 0 or after.force_error < (1 - 0.3 * fraction) * now.force_error:
                break
        if best is None:
            raise NotConverged("an element turned inside out")
        now, state, directions = best
        if now.force_error < 0.3 * smoothing and smoothing > _SMOOTHING[1]:
            smoothing = max(_SMOOTHING[1], 0.2 * smoothing)
            now = balance(assembly, state, smoothing, directions)
    raise NotConverged(f"no convergence in {iterations} Newton iterations")
