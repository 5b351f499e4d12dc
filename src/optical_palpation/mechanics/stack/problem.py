"""A layer on a deformable sample, between the window and a plate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from ..body import Body
from ..friction import node_stiffness
from ..grid import LayerGrid
from ..side_contact import PlaneSides, SideContact
from .contact import ContactState, SideState
from .projection import Interface, Plane, Projection

Array = NDArray[np.float64]
LAYER, SAMPLE = 0, 1
WINDOW, INTERFACE, PLATE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Stack:
    """Window (z = 0), layer, sample and plate; nodes are numbered layer first.

    ``contacts`` are those at the window, between layer and sample and at the plate, ``sides`` those
    of the layer's sides with the window and of the sample's with the plate. ``slave_grids`` are the
    grids of the bodies that the slaves belong to,
    ``areas`` the slaves' shares of the surface and ``scales`` c of their law; ``plate`` the plate's
    z at rest, ``travel`` how far it moves, mm; ``slip_length`` that of the friction law.
    """

    bodies: tuple[Body, Body]
    contacts: tuple[Plane, Interface, Plane]
    sides: tuple[PlaneSides, PlaneSides]
    slave_grids: tuple[LayerGrid, LayerGrid, LayerGrid]
    areas: tuple[Array, Array, Array]
    plate: float
    travel: float
    slip_length: float

    @property
    def n_nodes(self) -> int:
        """Number of nodes of both bodies."""
        return self.bodies[LAYER].n_nodes + self.bodies[SAMPLE].n_nodes

    @property
    def n_elements(self) -> int:
        """Number of elements of both bodies."""
        return sum(body.grid.n_elements for body in self.bodies)

    @cached_property
    def node_volumes(self) -> Array:
        """Volume of each node, (n_nodes), mm^3."""
        return np.concatenate([body.grid.node_volumes.ravel() for body in self.bodies])

    def resistance(self, moved: Array) -> Array:
        """Forces, mN, of unit resistance (1 kPa / mm^2) to displacements, mm: (n_nodes, 3)."""
        forces = [
            body.resistance.force(part)
            for body, part in zip(self.bodies, self.split(moved), strict=True)
        ]
        return np.concatenate([force.reshape(3, -1).T for force in forces])

    @property
    def shear_modulus(self) -> float:
        """Shear modulus of the layer, kPa, the scale of pressures."""
        return self.bodies[LAYER].law.shear_modulus

    @property
    def compression(self) -> float:
        """What the layer is compressed by at most, a share of its thickness."""
        return self.travel / self.bodies[LAYER].grid.typical_thickness

    @property
    def scales(self) -> list[Array]:
        """Scale c of the law of each contact, mN / mm."""
        height = self.bodies[LAYER].grid.spacing[0]
        return [area * self.shear_modulus / height for area in self.areas]

    @cached_property
    def elastic(self) -> list[Array]:
        """How the slaves of each contact resist being moved sideways, (n), mN / mm, about."""

        def alone(body: Body, area: Array) -> Array:
            height = body.grid.typical_thickness
            return node_stiffness(body.median_shear_modulus, area, height)

        (layer, sample), (at_window, between, at_plate) = self.bodies, self.areas
        # one gives way to the other
        series = 1 / (1 / alone(layer, between) + 1 / alone(sample, between))
        return [alone(layer, at_window), series, alone(sample, at_plate)]

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

    def nodal(self, field: Array) -> list[Array]:
        """Views (nz + 1, ny + 1, nx + 1, ...) of a nodal field (n_nodes, ...) on the two bodies."""
        n = self.bodies[LAYER].n_nodes
        return [
            part.reshape(*body.grid.node_shape, *field.shape[1:])
            for part, body in zip((field[:n], field[n:]), self.bodies, strict=True)
        ]

    def project(self, position: Array, load: float) -> list[Projection]:
        """Where the slaves of each contact are."""
        window, interface, plate = self.contacts
        height = self.plate - load * self.travel
        return [
            window.project(position, 0.0),
            interface.project(position),
            plate.project(position, height),
        ]

    def plane(self, body: int, load: float) -> float:
        """Height of the rigid plane that a body lies on, mm."""
        return 0.0 if body == LAYER else self.plate - load * self.travel

    def at_sides(self, u: Array) -> list[Array]:
        """Lateral part (1, 2, n) of ``u`` (n_nodes, 3) on the ``LayerGrid.side_nodes`` of both."""
        fields = zip(self.split(u), self.bodies, strict=True)
        return [field[None, :2, *body.grid.side_nodes] for field, body in fields]

    def side_contacts(self, state: State) -> list[SideContact]:
        """Contact of the sides of both bodies."""
        fields = zip(self.sides, self.split(state.u), self.side_slip(state), strict=True)
        return [
            sides.contact(u, self.plane(body, state.load), self.slip_length, w)
            for body, (sides, u, w) in enumerate(fields)
        ]

    def side_slip(self, state: State) -> list[Array]:
        """Present w of the friction law of the side nodes of both bodies, (1, 2, n)."""
        places = self.at_sides(state.u)
        return [own.slip(u, self.slip_length) for own, u in zip(state.sides, places, strict=True)]

    def total_forces(self, state: State) -> tuple[float, float, float]:
        """Forces on window, interface and plate, those of the sides included, mN."""
        window, interface, plate = (float(force.sum()) for force in state.forces)
        layer, sample = (float(c.normal_force.sum()) for c in self.side_contacts(state))
        return window + layer, interface, plate + sample


@dataclass(frozen=True, eq=False)
class State:
    """Displacement (n_nodes, 3), element pressures of both bodies, contacts; at one load.

    ``sides`` is the friction of the sides of both bodies.
    """

    load: float
    u: Array
    p: tuple[Array, Array]
    contacts: tuple[ContactState, ...]
    sides: tuple[SideState, SideState]

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
        return replace(self, u=u, p=(p[0], p[1]), contacts=contacts)

    def at_load(self, load: float) -> State:
        """Return the same state at another load."""
        return replace(self, load=load)

    def towards(self, other: State, load: float) -> State:
        """Go on to a load on the straight line through another state."""
        ratio = (load - self.load) / (other.load - self.load)
        return self.at_load(load).moved(
            self.u + ratio * (other.u - self.u),
            tuple(p + ratio * (q - p) for p, q in zip(self.p, other.p, strict=True)),
            tuple(
                np.maximum(0.0, n + ratio * (m - n))
                for n, m in zip(self.forces, other.forces, strict=True)
            ),
        )

    def following(self, start: State, end: State) -> State:
        """Go on as another stack did from ``start`` to ``end``, to the load of ``end``."""
        return self.at_load(end.load).moved(
            self.u + end.u - start.u,
            tuple(p + q - o for p, q, o in zip(self.p, end.p, start.p, strict=True)),
            tuple(
                np.maximum(0.0, n + m - o)
                for n, m, o in zip(self.forces, end.forces, start.forces, strict=True)
            ),
        )

    def stepped(
        self, fraction: float, du: Array, dp: Sequence[Array], dn: Sequence[Array]
    ) -> State:
        """Return the state after a fraction of a step of displacement, pressures and forces."""
        return self.moved(
            self.u + fraction * du,
            tuple(p + fraction * d for p, d in zip(self.p, dp, strict=True)),
            tuple(n + fraction * d for n, d in zip(self.forces, dn, strict=True)),
        )


def at_rest(stack: Stack) -> State:
    """Return the unloaded state."""
    u = np.zeros((stack.n_nodes, 3))
    position = stack.position(u)
    return State(
        load=0.0,
        u=u,
        p=(
            np.zeros(stack.bodies[LAYER].grid.shape),
            np.zeros(stack.bodies[SAMPLE].grid.shape),
        ),
        contacts=tuple(
            ContactState.resting(projection, position, np.zeros(projection.penetration.size))
            for projection in stack.project(position, 0.0)
        ),
        sides=side_states(stack.at_sides(u)),
    )


def fully_loaded(stack: Stack) -> State:
    """Return a first estimate at full load: the sample moved with the plate, columns as springs."""
    rest = at_rest(stack)
    u = rest.u.copy()
    u[stack.bodies[LAYER].n_nodes :, 2] -= stack.travel
    return rest.at_load(1.0).moved(u, rest.p, column_forces(stack))


def side_states(places: Sequence[Array]) -> tuple[SideState, SideState]:
    """Return sides without friction, where they are (1, 2, n)."""
    layer, sample = (SideState(np.zeros_like(place), place) for place in places)
    return layer, sample


def column_forces(stack: Stack) -> tuple[Array, ...]:
    """Contact forces at full load if every column of layer and sample were a spring of its own."""
    layer, sample = stack.bodies
    thickness = layer.grid.thickness[0, 0]
    height = np.diff(sample.grid.depth)[:, None, None]
    nodal = np.pad(1 / sample.factor, ((0, 0), (0, 1), (0, 1)), mode="edge")
    compliance = thickness / (3 * layer.law.shear_modulus)
    compliance = compliance + sample.grid.thickness * (height * nodal).sum(0) / (
        3 * sample.law.shear_modulus
    )
    pressure = np.maximum(stack.travel - (sample.top - thickness), 0.0) / compliance
    on_sample = RegularGridInterpolator(
        (sample.grid.y, sample.grid.x), pressure, "nearest", bounds_error=False, fill_value=0.0
    )
    on_layer = on_sample(np.stack(np.meshgrid(layer.grid.y, layer.grid.x, indexing="ij"), -1))
    of_slaves = on_layer if stack.slave_grids[INTERFACE] is layer.grid else pressure
    return tuple(
        p.ravel() * area
        for p, area in zip((on_layer, of_slaves, pressure), stack.areas, strict=True)
    )
