"""The laws of contact and friction of slaves with what they meet (``projection``).

They are those of the layer's own solver (``mechanics.contact``): the law of contact N = S(N +
c phi) with the vertical force N as unknown, and Coulomb's smoothed law in the x-y plane, linearised
where a slave would come to rest alone. The slip since the last load is that from the point of
the master the slave was at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from .. import friction as law
from ..contact import STIFF, smooth_maximum
from ..faces import area_vectors
from ..friction import friction_direction, look_ahead
from .linear import ContactTangent, Coupling, Surface
from .projection import Projection

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ContactState:
    """Vertical forces N (n), mN, and friction memory w (n, 2) of a contact.

    ``anchor`` is where the slaves were at the last accepted load and ``offset`` its lateral offset.
    """

    force: Array
    memory: Array
    anchor: Projection
    offset: Array

    @classmethod
    def resting(cls, projection: Projection, position: Array, force: Array) -> ContactState:
        """Return a contact with forces and without friction."""
        return cls(force, np.zeros((force.size, 2)), projection, projection.lateral(position))


@dataclass(frozen=True, eq=False)
class ContactFriction:
    """Friction of the slaves of a contact, linearised.

    ``sliding`` (n, 2) is what follows N, as a share of N, ``traction`` (n, 2), mN, what is given;
    ``stiffness`` (n, 2, 2), mN / mm, ``change`` (n, 2), mN, what it is to begin with beyond that of
    the state, ``turned`` what it will be beyond that where each slave comes to rest alone.
    """

    sliding: Array
    traction: Array
    stiffness: Array
    change: Array
    turned: Array


@dataclass(frozen=True, eq=False)
class ContactTerms:
    """A linearised contact.

    ``residual`` (n, q, 3): nodal forces to add to the internal ones, mN; ``violation`` (n) of the
    law of contact, mN. A step changes N by ``spring`` d phi - ``jump``, but where ``rigid`` phi
    changes by ``step``. ``slip`` (n, 2) is the w of the law of friction, ``bound`` its mu N, (n),
    mN: of that ``coupled`` times N follows N, and ``given``, mN, does not.
    """

    projection: Projection
    state: ContactState
    residual: Array
    violation: Array
    spring: Array
    jump: Array
    rigid: NDArray[np.bool_]
    step: Array
    slip: Array
    bound: Array
    coupled: float
    given: Array

    def friction(
        self, residual: Array, whole: Array, elastic: Array, slip_length: float
    ) -> ContactFriction:
        """Linearise friction (``friction.look_ahead``).

        ``residual`` (n_nodes, 3) is what is out of balance, mN, ``whole`` (n_nodes), mN, the bound
        of all friction at a node; ``elastic`` (n), mN / mm, how the slaves resist being moved
        sideways.
        """
        slaves = self.projection.nodes[:, 0]
        w, lateral = self.slip.T[None], residual[slaves, :2].T[None]
        ahead = look_ahead(w, lateral, (elastic * slip_length)[None], whole[slaves][None])
        xx, xy, yy = self.bound / slip_length * ahead.slope[0]
        return ContactFriction(
            sliding=self.coupled * ahead.direction[0].T,
            traction=self.given[:, None] * ahead.direction[0].T,
            stiffness=np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0),
            change=self.bound[:, None] * ahead.change[0].T,
            turned=self.bound[:, None] * ahead.turned[0].T,
        )

    def rows(self, sliding: Array) -> Array:
        """What a unit of N puts on the nodes (n, q, 3), with ``sliding`` as friction."""
        rows = -self.projection.weights[:, :, None] * self.projection.push[:, None, :]
        return rows + self.along(sliding)

    def along(self, friction: Array) -> Array:
        """What lateral forces on the slaves (n, 2) put on the nodes (n, q, 3)."""
        out = np.zeros((*self.projection.nodes.shape, 3))
        out[:, :, :2] = self.projection.weights[:, :, None] * friction[:, None, :]
        return out

    def surface(self, shape: tuple[int, int], friction: ContactFriction) -> Surface:
        """Return the contact as the linear solver takes it; ``shape`` is that of the slaves."""
        push, direction = self.projection.push, self.projection.direction

        def on_face(values: NDArray[Any]) -> NDArray[Any]:
            return np.moveaxis(values, 0, -1).reshape(*values.shape[1:], *shape)

        return Surface(
            row=on_face((friction.sliding - push[:, :2]) / push[:, 2:]),
            column=on_face(-direction[:, :2] / direction[:, 2:]),
            friction=on_face(friction.stiffness),
            spring=on_face(self.spring * push[:, 2] * direction[:, 2]),
            load=on_face(self.jump * push[:, 2]),
            rigid=on_face(self.rigid),
            step=on_face(-self.step / direction[:, 2]),
        )

    def coupling(
        self, slaves: Numbers, master: Numbers, position: Array, friction: ContactFriction
    ) -> Coupling:
        """Return the contact with the surface of another body as the linear solver takes it."""
        projection = self.projection
        assert projection.turning is not None
        numbers = np.zeros(position.shape[0], np.intp)
        numbers[slaves.ravel()] = np.arange(slaves.size)
        numbers[master.ravel()] = slaves.size + np.arange(master.size)
        masters = numbers[projection.nodes[:, 1:]] - slaves.size
        area = area_vectors(np.moveaxis(position[master], -1, 0))
        return Coupling(
            surface=self.surface(slaves.shape, friction),
            weights=sparse_rows(masters, -projection.weights[:, 1:], master.size),
            tangent=self.tangent(friction, numbers, slaves.size + master.size),
            turning=np.maximum(self.state.force, 0.0)[:, None, None, None] * projection.turning,
            slope=-area[:2] / area[2],
        )

    def tangent(self, friction: ContactFriction, numbers: Numbers, size: int) -> ContactTangent:
        """Derivative of its forces by displacements; ``numbers`` counts the nodes, up to size."""
        at, anchor = self.projection, self.state.anchor
        normal = np.maximum(self.state.force, 0.0)
        force = normal[:, None] * at.push
        force[:, :2] -= normal[:, None] * friction.sliding + friction.traction
        n, ways = normal.size, np.arange(2)
        width = 3 * size

        def unknowns(nodes: Numbers, count: int) -> Numbers:
            """Of each slave, the first ``count`` unknowns of these nodes."""
            return (3 * numbers[nodes][..., None] + np.arange(count)).reshape(n, -1)

        nodes = 3 * numbers[at.nodes][:, None] + ways[:, None]
        slips = friction.stiffness[:, :, None] * anchor.weights[:, None, :, None]
        lateral = slips.reshape(n, 2, -1)
        columns = unknowns(anchor.nodes, 2)
        if at.turning is not None:
            assert at.neighbours is not None
            turns = -normal[:, None, None, None] * np.moveaxis(at.turning, 2, 1)
            lateral = np.concatenate([lateral, turns.reshape(n, 2, -1)], -1)
            columns = np.concatenate([columns, unknowns(at.neighbours, 3)], -1)
        shares = np.moveaxis(at.gradient, 2, 1)[..., None] * force[:, None, None]
        both = lambda of_slave: np.repeat(of_slave, 2, axis=0)  # noqa: E731
        return ContactTangent(
            way=sparse_rows(nodes.reshape(2 * n, -1), both(at.weights), width),
            lateral=sparse_rows(both(columns), lateral.reshape(2 * n, -1), width),
            shares=sparse_rows(both(unknowns(at.nodes, 3)), shares.reshape(2 * n, -1), width),
        )


def sparse_rows(columns: Numbers, values: Array, width: int) -> sp.csr_matrix:
    """Sparse matrix of as many entries in each row; both (rows, entries)."""
    starts = np.arange(0, values.size + 1, values.shape[1])
    return sp.csr_matrix((values.ravel(), columns.ravel(), starts), shape=(len(values), width))


@dataclass(frozen=True, eq=False)
class SideState:
    """Friction memory w of the side nodes of a body, and where they were, mm, both (1, 2, n)."""

    memory: Array
    anchor: Array

    def slip(self, u: Array, slip_length: float) -> Array:
        """Present w of the friction law, of their lateral displacement u, both (1, 2, n)."""
        return self.memory + (u - self.anchor) / slip_length

    def remembered(self, u: Array, slip_length: float, touching: NDArray[np.bool_]) -> SideState:
        """Return the state from which the next load starts."""
        w = law.remembered(self.slip(u, slip_length))
        return SideState(np.where(touching[:, None], w, 0.0), u)


def linearise(
    friction: float,
    projection: Projection,
    state: ContactState,
    position: Array,
    scale: Array,
    smoothing: Array,
    slip_length: float,
    bound: Array | None = None,
) -> ContactTerms:
    """Linearise a contact; ``scale`` c and ``smoothing`` eps of its law are per slave.

    Friction is bounded by the contact forces themselves or, if given, by the normal forces
    ``bound`` (n), mN.
    """
    normal = state.force
    t = normal + scale * projection.penetration
    value, other = smooth_maximum(t, smoothing)
    slope = 1 - other
    violation = normal - value
    rigid = slope > STIFF * other
    other = np.where(rigid, 1.0, other)

    w = friction_memory(state, position, slip_length)
    s = friction_direction(w)
    terms = ContactTerms(
        projection=projection,
        state=state,
        residual=np.empty(0),
        violation=violation,
        spring=np.where(rigid, 0.0, slope * scale / other),
        jump=np.where(rigid, 0.0, violation / other),
        rigid=rigid,
        step=np.where(rigid, violation / (np.where(rigid, slope, 1.0) * scale), 0.0),
        slip=w,
        bound=friction * np.maximum(normal if bound is None else bound, 0.0),
        coupled=friction if bound is None else 0.0,
        given=np.zeros_like(normal) if bound is None else friction * np.maximum(bound, 0.0),
    )
    residual = terms.rows(terms.coupled * s) * normal[:, None, None]
    return replace(terms, residual=residual + terms.along(terms.given[:, None] * s))


def touching(projection: Projection, state: ContactState, scale: Array) -> NDArray[np.bool_]:
    """Return which slaves are in contact."""
    return state.force > -scale * projection.penetration


def friction_memory(state: ContactState, position: Array, slip_length: float) -> Array:
    """Present w of the friction law (n, 2)."""
    return state.memory + (state.anchor.lateral(position) - state.offset) / slip_length


def remembered(
    projection: Projection, state: ContactState, position: Array, scale: Array, slip_length: float
) -> ContactState:
    """Return the state from which the next load starts."""
    w = friction_memory(state, position, slip_length)
    w = np.where(touching(projection, state, scale)[:, None], law.remembered(w), 0.0)
    return ContactState(state.force, w, projection, projection.lateral(position))
