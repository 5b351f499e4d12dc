"""Equilibrium of window, layer, sample and plate at one load, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..body import ElementForces
from ..contact import SMOOTHING
from ..friction import direction_step, friction_direction
from ..iteration import DAMPING, Direction, HardSystem, Tolerances, iterate
from ..path import Drag
from ..side_contact import SideContact
from .contact import ContactTerms, friction_memory, linearise, remembered
from .linear import BodyEquations, StackEquations, StackSolver
from .problem import LAYER, PLATE, SAMPLE, WINDOW, Stack, State
from .projection import Interface, Plane

Array = NDArray[np.float64]

#: Relative residual to which linear systems are solved.
_LINEAR = 1e-2
#: Stiffness, in shear moduli times an element's width, that holds each node.
_HOLD = 1e-3


@dataclass(frozen=True, eq=False)
class Balance:
    """Internal forces and contact of a state, and how far it is from equilibrium.

    ``directions`` are those of friction, unknowns of their own (see ``linearise``): of the
    contacts, (n, 2), and of the ``sides`` of both bodies, (1, 2, n). ``drag`` is what resists it.
    ``residual`` (n_nodes, 3) are the nodal forces out of balance, mN, ``imbalance`` the 2-norm of
    these and of the violations of the laws of contact, mN; ``force_error`` its share of the contact
    forces.
    """

    state: State
    directions: Sequence[Array]
    drag: Drag[State] | None
    bodies: list[ElementForces]
    terms: list[ContactTerms]
    sides: list[SideContact]
    residual: Array
    imbalance: float
    force_error: float
    volume_error: float
    min_jacobian: float


def balance(
    stack: Stack,
    state: State,
    smoothing: float = SMOOTHING,
    directions: Sequence[Array] | None = None,
    drag: Drag[State] | None = None,
) -> Balance:
    """Evaluate equilibrium, incompressibility and contact of a state (see ``linearise``)."""
    parts = [
        body.forces(u, p)
        for body, u, p in zip(stack.bodies, stack.split(state.u), state.p, strict=True)
    ]
    position = stack.position(state.u)
    if directions is None:
        directions = [
            friction_direction(friction_memory(contact, position, stack.slip_length))
            for contact in state.contacts
        ]
        directions += [friction_direction(w) for w in stack.side_slip(state)]
    sides = stack.side_contacts(state, directions[len(state.contacts) :])
    bounds = [None] * len(state.contacts) if drag is None else drag.bound
    terms = [
        linearise(
            contact.friction,
            projection,
            own,
            position,
            scale,
            smoothing * stack.shear_modulus * area,
            stack.slip_length,
            direction,
            bound,
        )
        for contact, projection, own, scale, area, direction, bound in zip(
            list[Plane | Interface](stack.contacts),
            stack.project(position, state.load),
            state.contacts,
            stack.scales,
            stack.areas,
            directions[: len(state.contacts)],
            bounds,
            strict=True,
        )
    ]
    for part, side in zip(parts, sides, strict=True):
        part.force[:, *side.nodes] += side.force
    out = np.concatenate([part.force.reshape(3, -1).T for part in parts])
    if drag is not None:
        out += drag.viscosity * stack.node_volumes[:, None] * (state.u - drag.origin.u)
    for term in terms:
        np.add.at(out, term.projection.nodes, term.residual)
    scale = max(float(np.linalg.norm(np.concatenate(state.forces))), 1e-30)
    violation = np.linalg.norm(np.concatenate([term.violation for term in terms]))
    imbalance = float(np.hypot(np.linalg.norm(out), violation))
    volume = np.concatenate(
        [(part.volume_residual / part.reference_volume).ravel() for part in parts]
    )
    return Balance(
        state=state,
        directions=directions,
        drag=drag,
        bodies=parts,
        terms=terms,
        sides=sides,
        residual=out,
        imbalance=imbalance,
        force_error=imbalance / scale,
        volume_error=float(np.sqrt(np.mean(volume**2))),
        min_jacobian=min(part.min_jacobian for part in parts),
    )


def newton_step(
    stack: Stack, now: Balance, solver: StackSolver, damping: float = 0.0
) -> tuple[Array, list[Array], list[Array], int]:
    """Changes of displacement, pressures and contact forces, and the Krylov iterations.

    ``damping``, kPa / mm^2, is a resistance of each volume of a stiffness factor of 1 to being
    displaced by the step, in the tangent alone.
    """
    state = now.state
    # A trace of stiffness in the tangent alone holds what nothing else holds: rounding errors would
    # move it far.
    hold = _HOLD * stack.shear_modulus * stack.bodies[LAYER].grid.spacing[2]
    held = np.full((stack.n_nodes, 3), hold)
    viscosity = 0.0 if now.drag is None else now.drag.viscosity
    held += (viscosity + damping) * stack.node_volumes[:, None]
    parts = zip(
        stack.split(state.u),
        state.p,
        stack.split(now.residual),
        stack.split(held),
        now.sides,
        now.bodies,
        strict=True,
    )
    layer, sample = (
        BodyEquations(u, p, residual, diagonal, side, part.volume_residual, part.reference_volume)
        for u, p, residual, diagonal, side, part in parts
    )
    window, interface, plate = now.terms
    _, contact, _ = stack.contacts
    equations = StackEquations(
        bodies=(layer, sample),
        outer=(
            window.surface(stack.slave_grids[WINDOW].node_shape[1:]),
            plate.surface(stack.slave_grids[PLATE].node_shape[1:]),
        ),
        interface=interface.coupling(contact.slaves, contact.master, stack.position(state.u)),
    )
    step = solver.solve(equations, _LINEAR)
    changes = [
        reaction.ravel() / term.projection.push[:, 2]
        for reaction, term in zip(step.reactions, now.terms, strict=True)
    ]
    du = np.concatenate([part.reshape(3, -1).T for part in step.displacement])
    return du, step.pressure, changes, step.iterations


def make_solver(stack: Stack) -> StackSolver:
    """Return a linear solver for a stack."""
    _, interface, _ = stack.contacts
    return StackSolver(stack.bodies, LAYER if interface.side < 0 else SAMPLE)


def equilibrate(
    stack: Stack,
    state: State,
    solver: StackSolver,
    tolerances: Tolerances,
    on_iteration: Callable[[int, Balance, int], None] | None = None,
    drag: Drag[State] | None = None,
) -> tuple[Balance, int]:
    """Return the equilibrium at the load of a state, and the number of Newton iterations.

    Raises
    ------
    NotConverged
        When the iterations run out, an element turns inside out or numbers overflow.
    """

    def direction(now: Balance, damping: float) -> Direction[Balance]:
        du, dp, dn, krylov = newton_step(stack, now, solver, damping)
        if not np.isfinite(du).all():
            raise HardSystem("the linear system could not be solved")
        turns = [
            term.turn(du, old, stack.slip_length)
            for term, old in zip(now.terms, now.directions, strict=False)
        ]
        slips, steps = stack.side_slip(now.state), stack.at_sides(du / stack.slip_length)
        turns += [
            direction_step(w, old, step)
            for w, old, step in zip(slips, now.directions[len(turns) :], steps, strict=True)
        ]

        def follow(fraction: float) -> Balance:
            turned = [
                old + fraction * turn for old, turn in zip(now.directions, turns, strict=True)
            ]
            turned = [d / np.maximum(1.0, np.linalg.norm(d, axis=1, keepdims=True)) for d in turned]
            stepped = now.state.stepped(fraction, du, dp, dn)
            return balance(stack, stepped, directions=turned, drag=drag)

        return Direction(follow, krylov)

    directions = [friction_direction(contact.memory) for contact in state.contacts]
    directions += [friction_direction(side.memory) for side in state.sides]
    start = balance(stack, state, directions=directions, drag=drag)
    return iterate(start, direction, tolerances, DAMPING * _stiffness(stack), on_iteration)


def _stiffness(stack: Stack) -> float:
    """Shear modulus of the layer per height of the stack squared, kPa / mm^2."""
    return stack.shear_modulus / stack.plate**2


@dataclass
class LoadedStack:
    """A stack as ``Path`` loads it."""

    stack: Stack
    solver: StackSolver

    @property
    def stiffness(self) -> float:
        """Shear modulus of the layer per height of the stack squared, kPa / mm^2."""
        return _stiffness(self.stack)

    @property
    def volumes(self) -> Array:
        """Volume of each node, (n), mm^3."""
        return self.stack.node_volumes

    def displacement(self, state: State) -> Array:
        """Displacement (x, y, z) of the nodes, (3, n), mm."""
        return state.u.T

    def contact_forces(self, state: State) -> Sequence[Array]:
        """Normal forces of each contact, (n), mN."""
        return state.forces

    def balance(self, state: State) -> Balance:
        """How far a state is from equilibrium."""
        return balance(self.stack, state)

    def equilibrate(
        self,
        trial: State,
        tolerances: Tolerances,
        on_iteration: Callable[[int, Balance, int], None],
        drag: Drag[State] | None,
    ) -> tuple[Balance, int]:
        """Equilibrium at the load of ``trial``, and the Newton iterations; else NotConverged."""
        return equilibrate(self.stack, trial, self.solver, tolerances, on_iteration, drag)

    def remember(self, state: State) -> State:
        """Return the state from which the next load starts: friction remembers, anchors move."""
        stack, position = self.stack, self.stack.position(state.u)
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
