"""The laws of contact and friction of slaves with what they meet (``experiment.meeting``).

They are those of the layer's own solver (``mechanics.contact``): the law of contact N = S(N +
c phi) with the vertical force N as unknown, and Coulomb's smoothed law in the x-y plane, linearised
with its direction as an unknown of its own. The slip since the last load is that from the point of
the master the slave was at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.experiment.meeting import Meeting
from optical_palpation.mechanics.contact import (
    direction_step,
    friction_direction,
    side_penalty,
    smooth_maximum,
)

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Friction is remembered from load to load up to this |w|, as in ``mechanics.contact``.
_MEMORY = 10.0
#: A contact spring is at most this many times stiffer than the scale c of its law. What a Newton
#: step thereby leaves of the law's violation is its inverse.
_STIFFEST = 1e4
#: Penalty of the sides in shear moduli per element height, and the gap at which it begins, a share
#: of that height. A node that is caught only when it touches snaps down and jams its neighbours.
_SIDE_PENALTY, _SIDE_GAP = 8.0, 0.6


@dataclass(frozen=True, eq=False)
class ContactState:
    """Vertical forces N (n), mN, and friction memory w (n, 2) of a contact.

    ``anchor`` is where the slaves were at the last accepted load and ``offset`` its lateral offset.
    """

    force: Array
    memory: Array
    anchor: Meeting
    offset: Array

    @classmethod
    def resting(cls, meeting: Meeting, position: Array, force: Array) -> ContactState:
        """Return a contact with forces and without friction."""
        return cls(force, np.zeros((force.size, 2)), meeting, meeting.lateral(position))


@dataclass(frozen=True, eq=False)
class ContactTerms:
    """A linearised contact.

    ``residual`` (n, q, 3): nodal forces to add to the internal ones, mN; ``violation`` (n) of the
    law of contact, mN. A step changes N by ``spring`` d phi - ``jump``. ``sliding`` (n, 2) is the
    friction at the present N, as a share of N, and ``slip`` (n, 2) the w of its law.
    """

    meeting: Meeting
    state: ContactState
    residual: Array
    violation: Array
    spring: Array
    jump: Array
    sliding: Array
    slip: Array
    friction_stiffness: Array

    @property
    def rows(self) -> Array:
        """What a unit of N puts on the nodes (n, q, 3)."""
        meeting = self.meeting
        rows = -meeting.weights[:, :, None] * meeting.push[:, None, :]
        rows[:, :, :2] += meeting.weights[:, :, None] * self.sliding[:, None, :]
        return rows

    def change_of_force(self, du: Array) -> Array:
        """Change of N for a step (n_nodes, 3)."""
        meeting = self.meeting
        moved = np.einsum("nq,nqc->nc", meeting.weights, du[meeting.nodes])
        return -self.spring * (moved * meeting.direction).sum(1) - self.jump

    def turn(self, du: Array, direction: Array, slip_length: float) -> Array:
        """Change of the direction of friction (n, 2) for a step (n_nodes, 3)."""
        return direction_step(self.slip, direction, self.state.anchor.lateral(du) / slip_length)

    def blocks(self) -> list[tuple[Numbers, Numbers, Array]]:
        """Tangent of the nodal forces: nodes (n, a) and (n, b), and blocks (n, a, b, 3, 3)."""
        meeting = self.meeting
        w = meeting.weights
        normal = np.maximum(self.state.force, 0.0)[:, None, None]
        own = np.einsum(
            "nac,nbd->nabcd",
            self.rows,
            -self.spring[:, None, None] * w[:, :, None] * meeting.direction[:, None, :],
        )
        own[..., :2, :2] += np.einsum("na,nb,ncd->nabcd", w, w, self.friction_stiffness)
        force = normal[:, 0] * meeting.push
        force[:, :2] -= normal[:, 0] * self.sliding
        own[..., :2] += np.einsum("nc,nad,nb->nabcd", force, meeting.gradient, w)
        out = [(meeting.nodes, meeting.nodes, own)]
        if meeting.turning is not None and meeting.neighbours is not None:
            turn = np.zeros((*w.shape, 9, 3, 3))
            turn[..., :2, :] = np.einsum("na,nbcd->nabcd", -w * normal[:, 0], meeting.turning)
            out.append((meeting.nodes, meeting.neighbours, turn))
        return out


@dataclass(frozen=True, eq=False)
class Sides:
    """Contact of the layer's sides with the window, onto which they roll.

    As in ``mechanics.contact`` a stiff smooth penalty without friction. ``nodes`` (n) are numbers,
    ``stiffness`` the shear modulus by a node's width, kPa mm, ``height`` that of an element, mm.
    """

    nodes: Numbers
    stiffness: float
    height: float

    def force(self, position: Array) -> tuple[Array, Array]:
        """Vertical force (n), mN, and its derivative by the penetration, mN / mm."""
        c, gap = _SIDE_PENALTY * self.stiffness, _SIDE_GAP * self.height
        return side_penalty(-position[self.nodes, 2], gap, c)


def linearise(
    friction: float,
    meeting: Meeting,
    state: ContactState,
    position: Array,
    scale: Array,
    smoothing: Array,
    slip_length: float,
    direction: Array | None = None,
) -> ContactTerms:
    """Linearise a contact; ``scale`` c and ``smoothing`` eps of its law are per slave.

    ``direction`` is that of friction, by default the one that belongs to the slip.
    """
    normal = state.force
    t = normal + scale * meeting.penetration
    value, other = smooth_maximum(t, smoothing)
    slope = 1 - other
    violation = normal - value
    other = np.maximum(other, 1 / _STIFFEST)

    w = friction_memory(state, position, slip_length)
    q = np.sqrt(1 + (w**2).sum(1))
    s = friction_direction(w)
    d = s if direction is None else direction
    turned = 0.5 * (s[:, :, None] * d[:, None, :] + d[:, :, None] * s[:, None, :])
    stiff = friction * np.maximum(normal, 0.0) / (slip_length * q)
    terms = ContactTerms(
        meeting=meeting,
        state=state,
        residual=np.empty(0),
        violation=violation,
        spring=slope * scale / other,
        jump=violation / other,
        sliding=friction * s,
        slip=w,
        friction_stiffness=stiff[:, None, None] * (np.eye(2) - turned),
    )
    return replace(terms, residual=terms.rows * normal[:, None, None])


def touching(meeting: Meeting, state: ContactState, scale: Array) -> NDArray[np.bool_]:
    """Return which slaves are in contact."""
    return state.force > -scale * meeting.penetration


def friction_memory(state: ContactState, position: Array, slip_length: float) -> Array:
    """Present w of the friction law (n, 2)."""
    return state.memory + (state.anchor.lateral(position) - state.offset) / slip_length


def remembered(
    meeting: Meeting, state: ContactState, position: Array, scale: Array, slip_length: float
) -> ContactState:
    """Return the state from which the next load starts."""
    w = friction_memory(state, position, slip_length)
    size = np.sqrt((w**2).sum(1, keepdims=True))
    w = w * np.minimum(1.0, _MEMORY / np.maximum(size, 1e-300))
    w = np.where(touching(meeting, state, scale)[:, None], w, 0.0)
    return ContactState(state.force, w, meeting, meeting.lateral(position))


def assembled(terms: list[ContactTerms], n_nodes: int) -> tuple[sp.bsr_matrix, Array]:
    """Tangent and forces (n_nodes, 3) of contacts; forces are those after the jump of N."""
    force = np.zeros((n_nodes, 3))
    rows, columns, blocks = [], [], []
    for term in terms:
        nodes = term.meeting.nodes
        np.add.at(force, nodes, term.residual - term.rows * term.jump[:, None, None])
        for left, right, block in term.blocks():
            rows.append(np.repeat(left, right.shape[1], axis=1).ravel())
            columns.append(np.tile(right, left.shape[1]).ravel())
            blocks.append(block.reshape(-1, 9))
    keys, place = np.unique(
        np.concatenate(rows) * n_nodes + np.concatenate(columns), return_inverse=True
    )
    gather = sp.csr_matrix(
        (np.ones(place.size), (place, np.arange(place.size))), shape=(keys.size, place.size)
    )
    data = (gather @ np.concatenate(blocks)).reshape(-1, 3, 3)
    starts = np.searchsorted(keys, n_nodes * np.arange(n_nodes + 1))
    matrix = sp.bsr_matrix((data, keys % n_nodes, starts), shape=(3 * n_nodes, 3 * n_nodes))
    return matrix, force
