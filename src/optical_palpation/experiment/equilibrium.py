"""Equilibrium of window, layer, sample and plate at one load, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from optical_palpation.experiment.contact import (
    ContactState,
    ContactTerms,
    Sides,
    linearise,
)
from optical_palpation.experiment.meeting import Interface, Meeting, Plane
from optical_palpation.mechanics.body import Body, ElementForces
from optical_palpation.mechanics.contact import friction_direction
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.stack import BodyEquations, StackEquations, StackSolver

Array = NDArray[np.float64]
LAYER, SAMPLE = 0, 1
WINDOW, INTERFACE, PLATE = 0, 1, 2

#: Smoothing of contact, as a pressure in units of the shear modulus.
_SMOOTHING = 1e-3
#: When the full load is reached: out-of-balance forces relative to contact forces, violation of
#: J - 1. Loads on the way to it are reached sooner by ``_ON_THE_WAY``.
_FORCE, _VOLUME = 1e-5, 1e-6
_ON_THE_WAY = 30.0
#: Relative residual to which linear systems are solved.
_LINEAR = 1e-2
#: A step must leave less out of balance than the most of so many iterations.
_MEMORY = 4
#: Least damping of a step that otherwise fails, in shear moduli per height of the stack squared,
#: and how often a step is tried.
_DAMPING, _ATTEMPTS = 30.0, 6
#: Share of its smallest volume ratio that the assembly must keep in a step.
_FLATTENING = 0.3


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

    ``residual`` (n_nodes, 3) are the nodal forces out of balance, mN, ``imbalance`` the 2-norm of
    these and of the violations of the laws of contact, mN; ``force_error`` its share of the contact
    forces.
    """

    bodies: list[ElementForces]
    terms: list[ContactTerms]
    residual: Array
    imbalance: float
    force_error: float
    volume_error: float
    min_jacobian: float


def balance(
    assembly: Assembly,
    state: State,
    smoothing: float = _SMOOTHING,
    directions: Sequence[Array] | None = None,
) -> Balance:
    """Evaluate equilibrium, incompressibility and contact of a state (see ``linearise``)."""
    parts = [
        body.forces(u, p)
        for body, u, p in zip(assembly.bodies, assembly.split(state.u), state.p, strict=True)
    ]
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
    out = np.concatenate([part.force.reshape(3, -1).T for part in parts])
    out[assembly.sides.nodes, 2] -= assembly.sides.force(position)[0]
    for term in terms:
        np.add.at(out, term.meeting.nodes, term.residual)
    scale = max(float(np.linalg.norm(np.concatenate(state.forces))), 1e-30)
    violation = np.linalg.norm(np.concatenate([term.violation for term in terms]))
    imbalance = float(np.hypot(np.linalg.norm(out), violation))
    volume = np.concatenate(
        [(part.volume_residual / part.reference_volume).ravel() for part in parts]
    )
    return Balance(
        bodies=parts,
        terms=terms,
        residual=out,
        imbalance=imbalance,
        force_error=imbalance / scale,
        volume_error=float(np.sqrt(np.mean(volume**2))),
        min_jacobian=min(part.min_jacobian for part in parts),
    )


def newton_step(
    assembly: Assembly, state: State, now: Balance, solver: StackSolver, damping: float = 0.0
) -> tuple[Array, list[Array], list[Array], int]:
    """Changes of displacement, pressures and contact forces, and the Krylov iterations.

    ``damping``, kPa / mm^2, is a resistance of each volume of a stiffness factor of 1 to being
    displaced by the step, in the tangent alone.
    """
    # a trace of stiffness in the tangent alone holds what nothing else holds yet
    hold = 1e-4 * assembly.shear_modulus * assembly.bodies[LAYER].grid.spacing[2]
    held = np.full((assembly.n_nodes, 3), hold)
    held[assembly.sides.nodes, 2] += assembly.sides.force(assembly.position(state.u))[1]
    if damping > 0:
        volumes = [body.grid.node_volumes.ravel() for body in assembly.bodies]
        held += damping * np.concatenate(volumes)[:, None]
    parts = zip(
        assembly.split(state.u),
        state.p,
        assembly.split(now.residual),
        assembly.split(held),
        now.bodies,
        strict=True,
    )
    layer, sample = (
        BodyEquations(u, p, residual, diagonal, part.volume_residual, part.reference_volume)
        for u, p, residual, diagonal, part in parts
    )
    window, interface, plate = now.terms
    _, contact, _ = assembly.contacts
    equations = StackEquations(
        bodies=(layer, sample),
        outer=(
            window.surface(assembly.slave_grids[WINDOW].node_shape[1:]),
            plate.surface(assembly.slave_grids[PLATE].node_shape[1:]),
        ),
        interface=interface.interface(contact.slaves, contact.master, assembly.position(state.u)),
    )
    step = solver.solve(equations, _LINEAR)
    changes = [
        reaction.ravel() / term.meeting.push[:, 2]
        for reaction, term in zip(step.reactions, now.terms, strict=True)
    ]
    du = np.concatenate([part.reshape(3, -1).T for part in step.displacement])
    return du, step.pressure, changes, step.iterations


def make_solver(assembly: Assembly) -> StackSolver:
    """Return a linear solver for an assembly."""
    _, interface, _ = assembly.contacts
    slave = LAYER if interface.side < 0 else SAMPLE
    return StackSolver(assembly.bodies, slave)


def equilibrate(
    assembly: Assembly,
    state: State,
    solver: StackSolver,
    on_iteration: Callable[[float, Balance], None] | None = None,
    iterations: int = 25,
) -> tuple[State, int]:
    """Return the state in equilibrium at its load, and the number of Newton iterations.

    Raises
    ------
    NotConverged
        When the iterations run out, an element turns inside out or numbers overflow.
    """
    enough = 1.0 if state.load == 1.0 else _ON_THE_WAY
    directions = [friction_direction(contact.memory) for contact in state.contacts]
    now = balance(assembly, state, directions=directions)
    imbalances: list[float] = []
    least = _DAMPING * assembly.shear_modulus / assembly.plate**2
    damping = 0.0
    for iteration in range(iterations):
        if on_iteration:
            on_iteration(state.load, now)
        imbalances.append(now.imbalance)
        if (
            iteration > 0
            and now.force_error < enough * _FORCE
            and now.volume_error < enough * _VOLUME
        ):
            return state, iteration
        for _ in range(_ATTEMPTS):
            step = newton_step(assembly, state, now, solver, damping)
            if not np.isfinite(step[0]).all():
                raise NotConverged("the linear system could not be solved")
            # The first step crosses the new load and a damped one a snap: both may leave more out
            # of balance than they found.
            growth = 2.0 if iteration == 0 or damping > 0 else None
            highest = max(imbalances[-_MEMORY:])
            found = _search(assembly, state, now, directions, step, highest, growth)
            if found is not None:
                break
            damping = max(least, 5.0 * damping)
        else:
            raise NotConverged("no step leads nearer to equilibrium")
        after, state, directions = found
        damping *= 0.5 * min(1.0, after.imbalance / now.imbalance)
        if damping < 0.1 * least:
            damping = 0.0
        now = after
    raise NotConverged(f"no convergence in {iterations} Newton iterations")


def _search(
    assembly: Assembly,
    state: State,
    now: Balance,
    directions: Sequence[Array],
    step: tuple[Array, list[Array], list[Array], int],
    highest: float,
    growth: float | None,
) -> tuple[Balance, State, list[Array]] | None:
    """Take the largest fraction of a Newton step that leads on; None if there is none.

    What it leaves out of balance must be less than ``highest`` times ``growth``, or, by default,
    less than ``highest``, the more so the larger the fraction.
    """
    du, dp, dn, _ = step
    turns = [
        term.turn(du, direction, assembly.slip_length)
        for term, direction in zip(now.terms, directions, strict=True)
    ]
    for fraction in (1.0, 0.5, 0.25, 0.125):
        trial = state.moved(
            state.u + fraction * du,
            tuple(p + fraction * d for p, d in zip(state.p, dp, strict=True)),
            tuple(n + fraction * d for n, d in zip(state.forces, dn, strict=True)),
        )
        turned = [d + fraction * turn for d, turn in zip(directions, turns, strict=True)]
        turned = [d / np.maximum(1.0, np.linalg.norm(d, axis=1)[:, None]) for d in turned]
        after = balance(assembly, trial, directions=turned)
        allowed = growth or 1 - 0.3 * fraction
        if (
            after.min_jacobian > _FLATTENING * now.min_jacobian
            and after.imbalance < allowed * highest
        ):
            return after, trial, turned
    return None
