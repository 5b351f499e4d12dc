"""The laws of contact and friction of slaves with what they meet (``projection``).

They are those of the layer's own solver (``mechanics.contact``): the law of contact N = S(N +
c phi) with the vertical force N as unknown, and Coulomb's smoothed law in the x-y plane, linearised
with its direction as an unknown of its own. The slip since the last load is that from the point of
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
from ..friction import direction_step, friction_direction, friction_stiffness
from .linear import Coupling, Surface
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
class ContactTerms:
    """A linearised contact.

    ``residual`` (n, q, 3): nodal forces to add to the internal ones, mN; ``violation`` (n) of the
    law of contact, mN. A step changes N by ``spring`` d phi - ``jump``, but where ``rigid`` phi
    changes by ``step``. ``sliding`` (n, 2) is the friction at the present N, as a share of N, and
    ``slip`` (n, 2) the w of its law; ``traction`` (n, 2), mN, is friction of a bound that is given.
    """

    projection: Projection
    state: ContactState
    residual: Array
    violation: Array
    spring: Array
    jump: Array
    rigid: NDArray[np.bool_]
    step: Array
    sliding: Array
    traction: Array
    slip: Array
    friction_stiffness: Array

    @property
    def rows(self) -> Array:
        """What a unit of N puts on the nodes (n, q, 3)."""
        projection = self.projection
        rows = -projection.weights[:, :, None] * projection.push[:, None, :]
        rows[:, :, :2] += projection.weights[:, :, None] * self.sliding[:, None, :]
        return rows

    def turn(self, du: Array, direction: Array, slip_length: float) -> Array:
        """Change of the direction of friction (n, 2) for a step (n_nodes, 3)."""
        return direction_step(self.slip, direction, self.state.anchor.lateral(du) / slip_length)

    def surface(self, shape: tuple[int, int]) -> Surface:
        """Return the contact as the linear solver takes it; ``shape`` is that of the slaves."""
        push, direction = self.projection.push, self.projection.direction

        def on_face(values: NDArray[Any]) -> NDArray[Any]:
            return np.moveaxis(values, 0, -1).reshape(*values.shape[1:], *shape)

        return Surface(
            row=on_face((self.sliding - push[:, :2]) / push[:, 2:]),
            column=on_face(-direction[:, :2] / direction[:, 2:]),
            friction=on_face(self.friction_stiffness),
            spring=on_face(self.spring * push[:, 2] * direction[:, 2]),
            load=on_face(self.jump * push[:, 2]),
            rigid=on_face(self.rigid),
            step=on_face(-self.step / direction[:, 2]),
        )

    def coupling(self, slaves: Numbers, master: Numbers, position: Array) -> Coupling:
        """Return the contact with the surface of another body as the linear solver takes it."""
        projection = self.projection
        anchor, first = self.state.anchor, master.flat[0]

        def matrix(at: Projection, values: Array) -> sp.csr_matrix:
            rows = np.repeat(np.arange(slaves.size), values.shape[1])
            entries = values.ravel(), (rows, at.nodes[:, 1:].ravel() - first)
            return sp.csr_matrix(entries, shape=(slaves.size, master.size))

        normal = np.maximum(self.state.force, 0.0)[:, None]
        force = normal * projection.push
        force[:, :2] -= normal * self.sliding + self.traction
        area = area_vectors(np.moveaxis(position[master], -1, 0))
        assert projection.turning is not None
        assert projection.neighbours is not None
        return Coupling(
            surface=self.surface(slaves.shape),
            weights=matrix(projection, -projection.weights[:, 1:]),
            gradient=(
                matrix(projection, projection.gradient[:, 1:, 0]),
                matrix(projection, projection.gradient[:, 1:, 1]),
            ),
            reference=matrix(anchor, -anchor.weights[:, 1:]),
            force=force,
            turning=normal[:, :, None, None] * projection.turning,
            neighbours=projection.neighbours - slaves.flat[0],
            slope=-area[:2] / area[2],
        )


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
    direction: Array | None = None,
    bound: Array | None = None,
) -> ContactTerms:
    """Linearise a contact; ``scale`` c and ``smoothing`` eps of its law are per slave.

    ``direction`` is that of friction, by default the one that belongs to the slip. Friction is
    bounded by the contact forces themselves or, if given, by the normal forces ``bound`` (n), mN.
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
    xx, xy, yy = friction_stiffness(w, s if direction is None else direction)
    turned = np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0)
    stiff = friction * (np.maximum(normal, 0.0) if bound is None else bound) / slip_length
    given = np.zeros_like(normal) if bound is None else bound
    terms = ContactTerms(
        projection=projection,
        state=state,
        residual=np.empty(0),
        violation=violation,
        spring=np.where(rigid, 0.0, slope * scale / other),
        jump=np.where(rigid, 0.0, violation / other),
        rigid=rigid,
        step=np.where(rigid, violation / (np.where(rigid, slope, 1.0) * scale), 0.0),
        sliding=friction * s if bound is None else np.zeros_like(s),
        traction=friction * given[:, None] * s,
        slip=w,
        friction_stiffness=stiff[:, None, None] * turned,
    )
    residual = terms.rows * normal[:, None, None]
    residual[:, :, :2] += projection.weights[:, :, None] * terms.traction[:, None, :]
    return replace(terms, residual=residual)


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
