"""Equilibrium of window, layer, sample and plate at one load, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..body import ElementForces
from ..contact import smoothing
from ..friction import Ahead
from ..iteration import DAMPING, Direction, HardSystem, Tolerances, iterate, softness
from ..path import Drag
from ..side_contact import SideContact, SideTangent
from .contact import ContactFriction, ContactTerms, linearise, remembered
from .linear import BodyEquations, StackEquations, StackSolver
from .problem import LAYER, PLATE, SAMPLE, WINDOW, Stack, State
from .projection import Interface, Plane

Array = NDArray[np.float64]

#: Relative residual to which linear systems are solved: with more, the forces of a stiff body drown
#: those of a soft one.
_LINEAR = 1e-2
#: Stiffness, in shear moduli times an element's width, that holds each node.
_HOLD = 1e-3


@dataclass(frozen=True, eq=False)
class Balance:
    """Internal forces and contact of a state, and how far it is from equilibrium.

    ``sides`` are those of both bodies, ``drag`` is what resists the state.
    ``residual`` (n_nodes, 3) are the nodal forces out of balance, mN, ``imbalance`` the 2-norm of
    these and of the violations of the laws of contact, mN; ``force_error`` its share of the contact
    forces, ``merit`` that of ``Iterate``. ``frictions`` and ``side_frictions`` are linearised.
    """

    state: State
    drag: Drag[State] | None
    bodies: list[ElementForces]
    terms: list[ContactTerms]
    sides: list[SideContact]
    frictions: list[ContactFriction]
    side_frictions: list[Ahead | None]
    residual: Array
    imbalance: float
    merit: float
    force_error: float
    volume_error: float
    min_jacobian: float

    @property
    def distance(self) -> float:
        """That of ``Iterate``: ``force_error``."""
        return self.force_error

    @property
    def volume_distance(self) -> float:
        """That of ``Iterate``: ``volume_error``."""
        return self.volume_error

    def side_tangents(self) -> list[SideTangent]:
        """What presses the sides of both bodies, linearised."""
        each = zip(self.sides, self.side_frictions, strict=True)
        return [side.tangent(friction) for side, friction in each]


def balance(
    stack: Stack,
    state: State,
    drag: Drag[State] | None = None,
) -> Balance:
    """Evaluate equilibrium, incompressibility and contact of a state (see ``linearise``)."""
    parts = [
        body.forces(u, p)
        for body, u, p in zip(stack.bodies, stack.split(state.u), state.p, strict=True)
    ]
    position = stack.position(state.u)
    sides = stack.side_contacts(state)
    bounds = [None] * len(state.contacts) if drag is None else drag.bound
    eps = smoothing(stack.compression) * stack.shear_modulus
    terms = [
        linearise(
            contact.friction,
            projection,
            own,
            position,
            scale,
            eps * area,
            stack.slip_length,
            bound,
        )
        for contact, projection, own, scale, area, bound in zip(
            list[Plane | Interface](stack.contacts),
            stack.project(position, state.load),
            state.contacts,
            stack.scales,
            stack.areas,
            bounds,
            strict=True,
        )
    ]
    for part, side in zip(parts, sides, strict=True):
        part.force[:, *side.nodes] += side.force
    out = np.concatenate([part.force.reshape(3, -1).T for part in parts])
    if drag is not None:
        out += drag.viscosity * stack.resistance(state.u - drag.origin.u)
    for term in terms:
        np.add.at(out, term.projection.nodes, term.residual)
    frictions, side_frictions = linearised_friction(stack, terms, sides, out)
    eased = out.copy()
    for term, friction in zip(terms, frictions, strict=True):
        np.add.at(eased, term.projection.nodes, term.along(friction.turned))
    for side, ahead, own in zip(sides, side_frictions, stack.nodal(eased), strict=True):
        if ahead is not None:
            own[*side.nodes, :2] += side.turned(ahead).T
    scale = max(float(np.linalg.norm(np.concatenate(state.forces))), 1e-30)
    violation = np.linalg.norm(np.concatenate([term.violation for term in terms]))
    imbalance = float(np.hypot(np.linalg.norm(out), violation))
    volume = np.concatenate(
        [(part.volume_residual / part.reference_volume).ravel() for part in parts]
    )
    return Balance(
        state=state,
        drag=drag,
        bodies=parts,
        terms=terms,
        sides=sides,
        frictions=frictions,
        side_frictions=side_frictions,
        residual=out,
        imbalance=imbalance,
        merit=float(np.hypot(np.linalg.norm(eased), violation)),
        force_error=imbalance / scale,
        volume_error=float(np.sqrt(np.mean(volume**2))),
        min_jacobian=min(part.min_jacobian for part in parts),
    )


def linearised_friction(
    stack: Stack, terms: list[ContactTerms], sides: list[SideContact], residual: Array
) -> tuple[list[ContactFriction], list[Ahead | None]]:
    """Friction of all contacts and of the sides of both bodies, linearised."""
    whole = np.zeros(stack.n_nodes)
    for term in terms:
        whole[term.projection.nodes[:, 0]] += term.bound
    bounds = stack.nodal(whole)
    for side, bound in zip(sides, bounds, strict=True):
        bound[side.nodes] += side.bound.sum(0)
    contacts = [
        term.friction(residual, whole, elastic, stack.slip_length)
        for term, elastic in zip(terms, stack.elastic, strict=True)
    ]
    each = zip(sides, stack.split(residual), bounds, strict=True)
    return contacts, [side.friction(out, bound) for side, out, bound in each]


def newton_step(
    stack: Stack, now: Balance, solver: StackSolver, damping: float = 0.0
) -> tuple[Array, list[Array], list[Array], int]:
    """Changes of displacement, pressures and contact forces, and the Krylov iterations.

    ``damping``, kPa / mm^2, is a resistance of both bodies to being displaced by the step, in the
    tangent alone, with the compressibility that goes with it.
    """
    state = now.state
    viscosity = 0.0 if now.drag is None else now.drag.viscosity
    residual = now.residual.copy()
    for term, friction in zip(now.terms, now.frictions, strict=True):
        np.add.at(residual, term.projection.nodes, term.along(friction.change))
    sides = now.side_tangents()
    out_of_balance = stack.split(residual)
    for side, out in zip(sides, out_of_balance, strict=True):
        out[:2, *side.nodes] += side.change
    parts = zip(
        stack.split(state.u),
        state.p,
        out_of_balance,
        sides,
        now.bodies,
        strict=True,
    )
    layer, sample = (
        BodyEquations(u, p, residual, side, part.volume_residual, part.reference_volume)
        for u, p, residual, side, part in parts
    )
    (window, interface, plate), (at_window, between, at_plate) = now.terms, now.frictions
    _, contact, _ = stack.contacts
    equations = StackEquations(
        bodies=(layer, sample),
        outer=(
            window.surface(stack.slave_grids[WINDOW].node_shape[1:], at_window),
            plate.surface(stack.slave_grids[PLATE].node_shape[1:], at_plate),
        ),
        interface=interface.coupling(
            contact.slaves, contact.master, stack.position(state.u), between
        ),
        # A trace of stiffness in the tangent alone holds what nothing else holds: rounding errors
        # would move it far.
        hold=_HOLD * stack.shear_modulus * stack.bodies[LAYER].grid.spacing[2],
        resistance=viscosity + damping,
        softness=softness(damping, _stiffness(stack), stack.shear_modulus),
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

        def follow(fraction: float) -> Balance:
            return balance(stack, now.state.stepped(fraction, du, dp, dn), drag=drag)

        return Direction(follow, krylov)

    start = balance(stack, state, drag=drag)
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

    def resistance(self, moved: Array) -> Array:
        """Forces, mN, of unit resistance (1 kPa / mm^2) to displacements, mm; both (3, n)."""
        return self.stack.resistance(moved.T).T

    def displacement(self, state: State) -> Array:
        """Displacement (x, y, z) of the nodes, (3, n), mm."""
        return state.u.T

    def covered(self, state: State) -> float:
        """Share of where the layer was that it still covers."""
        return self.stack.bodies[LAYER].grid.covered(self.stack.split(state.u)[LAYER])

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

    def remember(self, now: Balance) -> State:
        """Return the state from which the next load starts: friction remembers, anchors move."""
        state = now.state
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
