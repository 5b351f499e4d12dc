"""Contact and friction of deformable bodies with rigid planes and with one another.

A contact is a set of nodes (the slaves) and what each of them meets: a rigid plane z = const, or
the surface of another body (the master), interpolated smoothly through its nodes. Penetration phi
is measured along z, as in the layer's own solver (``mechanics.contact``), and so are the law of
contact, N = S(N + c phi) with the vertical force N as unknown, and Coulomb's smoothed law in the
x-y plane.

A slave at (x, y) lies above the master's point xi at which S_xy(xi) = (x, y). With w the weights
of the master's nodes there, W = (1, -w) over slave and master nodes and v = (-h_x, -h_y, 1) from
the slope of the surface (its opposite for slaves on the -z side),

    d phi = -sum_a W_a v . dx_a,

exactly, sliding included. The contact force acts along the area vector of the slave's deformed
element faces (``mechanics.contact`` tells why), and what the slave bears the master's nodes give,
in the shares w. The slip since the last load is that from the point of the master the slave was at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.mechanics.contact import _turning_stiffness, area_vectors

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Friction is remembered from load to load up to this |w|, as in ``mechanics.contact``.
_MEMORY = 10.0
#: A contact spring is at most this many times stiffer than the scale c of its law. What a Newton
#: step thereby leaves of the law's violation is its inverse.
_STIFFEST = 1e4
#: Beyond its edge the master goes on straight but bends away as s^2 / 2 times this many elements,
#: s the distance from the edge in elements: slaves that slide off it let go smoothly.
_ROUNDING = 2.0
#: Distance from the edge, in elements, beyond which nothing is met.
_REACH = 2.0


@dataclass(frozen=True, eq=False)
class Meeting:
    """Where the n slaves of a contact are on what they meet, q nodes taking part in each.

    ``nodes`` (n, q) and ``weights`` W (n, q), slave first; ``gradient`` (n, q, 2) of the weights by
    x and y; ``direction`` v (n, 3); ``push`` (n, 3), that of the contact force, of equal z;
    ``penetration`` (n), mm. ``turning`` (n, 9, 2, 3) is the derivative of the lateral push by the
    positions of the ``neighbours`` (n, 9) on the slave's surface.
    """

    nodes: Numbers
    weights: Array
    gradient: Array
    direction: Array
    push: Array
    penetration: Array
    neighbours: Numbers | None = None
    turning: Array | None = None

    def lateral_offset(self, position: Array) -> Array:
        """Sum of W x, y over the nodes (n, 2)."""
        return np.einsum("nq,nqc->nc", self.weights, position[self.nodes, :2])


@dataclass(frozen=True, eq=False)
class Plane:
    """Slaves against a rigid plane that lies on the side ``sign`` (-1 window, +1 plate) of them."""

    slaves: Numbers
    sign: float
    friction: float

    def meet(self, position: Array, height: float) -> Meeting:
        """Return where the slaves are on the plane z = ``height``."""
        n = self.slaves.size
        direction = np.tile([0.0, 0.0, -self.sign], (n, 1))
        return Meeting(
            nodes=self.slaves[:, None],
            weights=np.ones((n, 1)),
            gradient=np.zeros((n, 1, 2)),
            direction=direction,
            push=direction,
            penetration=self.sign * (position[self.slaves, 2] - height),
        )


@dataclass(frozen=True, eq=False)
class Interface:
    """Structured surface of one body, ``slaves``, on that of another, ``master`` (ny + 1, nx + 1).

    The slaves lie on the +z side of the surface. ``start`` (n, 2): the slaves' first guess of
    their (column, row) on the surface.
    """

    slaves: Numbers
    master: Numbers
    friction: float
    side: float
    start: Array
    element: float

    def meet(self, position: Array) -> Meeting:
        """Return where the slaves are on the master's surface."""
        numbers = self.slaves.ravel()
        n = numbers.size
        nodes = np.empty((n, 17), np.intp)
        nodes[:, 0] = numbers
        weights, gradient = np.zeros((n, 17)), np.zeros((n, 17, 2))
        weights[:, 0] = 1.0
        direction, depth = np.empty((n, 3)), np.empty(n)
        _project(
            position[numbers],
            position[self.master],
            self.master,
            self.start,
            self.element,
            self.side,
            nodes,
            weights,
            gradient,
            direction,
            depth,
        )
        surface = np.moveaxis(position[self.slaves], -1, 0)
        area = area_vectors(surface)
        turning = np.zeros((*self.slaves.shape, 9, 2, 3))
        _turning_stiffness(surface, self.side / area[2], -area[:2] / area[2], turning)
        around = np.pad(self.slaves, 1, mode="edge")
        ny, nx = self.slaves.shape
        neighbours = [around[j : j + ny, i : i + nx].ravel() for j in range(3) for i in range(3)]
        return Meeting(
            nodes=nodes,
            weights=weights,
            gradient=gradient,
            direction=direction,
            push=self.side * (area / area[2]).reshape(3, -1).T,
            penetration=depth,
            neighbours=np.stack(neighbours, axis=1),
            turning=turning.reshape(n, 9, 2, 3),
        )


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
        return cls(force, np.zeros((force.size, 2)), meeting, meeting.lateral_offset(position))


@dataclass(frozen=True, eq=False)
class ContactTerms:
    """A linearised contact.

    ``residual`` (n, q, 3): nodal forces to add to the internal ones, mN; ``violation`` (n) of the
    law of contact, mN. A step changes N by ``spring`` d phi - ``jump``. ``sliding`` (n, 2) is the
    friction at the present N, as a share of N.
    """

    meeting: Meeting
    state: ContactState
    residual: Array
    violation: Array
    spring: Array
    jump: Array
    sliding: Array
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


def linearise(
    friction: float,
    meeting: Meeting,
    state: ContactState,
    position: Array,
    scale: Array,
    smoothing: Array,
    slip_length: float,
) -> ContactTerms:
    """Linearise a contact; ``scale`` c and ``smoothing`` eps of its law are per slave."""
    normal = state.force
    t = normal + scale * meeting.penetration
    root = np.sqrt(t**2 + 4 * smoothing**2)
    # of S and 1 - S' the small one of two terms is formed without cancellation
    value = np.where(t > 0, 0.5 * (t + root), 2 * smoothing**2 / (root - t))
    other = np.where(t > 0, 2 * smoothing**2 / (root * (root + t)), 0.5 * (1 - t / root))
    slope = 1 - other
    violation = normal - value
    other = np.maximum(other, 1 / _STIFFEST)

    slip = state.anchor.lateral_offset(position) - state.offset
    w = state.memory + slip / slip_length
    q = np.sqrt(1 + (w**2).sum(1))
    s = w / q[:, None]
    sliding = friction * s
    stiff = friction * np.maximum(normal, 0.0) / (slip_length * q)
    friction_stiffness = stiff[:, None, None] * (np.eye(2) - s[:, :, None] * s[:, None, :])
    terms = ContactTerms(
        meeting=meeting,
        state=state,
        residual=np.empty(0),
        violation=violation,
        spring=slope * scale / other,
        jump=violation / other,
        sliding=sliding,
        friction_stiffness=friction_stiffness,
    )
    return replace(terms, residual=terms.rows * normal[:, None, None])


def touching(meeting: Meeting, state: ContactState, scale: Array) -> NDArray[np.bool_]:
    """Return which slaves are in contact."""
    return state.force > -scale * meeting.penetration


def friction_memory(state: ContactState, position: Array, slip_length: float) -> Array:
    """Present w of the friction law (n, 2)."""
    return state.memory + (state.anchor.lateral_offset(position) - state.offset) / slip_length


def remembered(
    meeting: Meeting, state: ContactState, position: Array, scale: Array, slip_length: float
) -> ContactState:
    """Return the state from which the next load starts."""
    w = friction_memory(state, position, slip_length)
    size = np.sqrt((w**2).sum(1, keepdims=True))
    w = w * np.minimum(1.0, _MEMORY / np.maximum(size, 1e-300))
    w = np.where(touching(meeting, state, scale)[:, None], w, 0.0)
    return ContactState(state.force, w, meeting, meeting.lateral_offset(position))


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


@nb.njit(cache=True)
def _weights(s, n, w):
    """Catmull-Rom weights w[2, 4] (value, derivative) on nodes base..base + 3.

    At its ends the curve has a third-order one-sided tangent, and beyond them it is straight.
    Returns the base and how far s lies outside 0..n.
    """
    outside = s if s < 0 else (s - n if s > n else 0.0)
    i = min(max(int(np.floor(s)), 0), n - 1)
    t = min(max(s - i, 0.0), 1.0)
    v = np.empty((2, 4))
    v[0, 0] = t * (-0.5 + t * (1 - 0.5 * t))
    v[0, 1] = 1 + t * t * (-2.5 + 1.5 * t)
    v[0, 2] = t * (0.5 + t * (2 - 1.5 * t))
    v[0, 3] = t * t * (-0.5 + 0.5 * t)
    v[1, 0] = -0.5 + t * (2 - 1.5 * t)
    v[1, 1] = t * (-5 + 4.5 * t)
    v[1, 2] = 0.5 + t * (4 - 4.5 * t)
    v[1, 3] = t * (-1 + 1.5 * t)
    base = min(max(i - 1, 0), n - 3)
    w[:] = 0
    for d in range(2):
        for a in range(4):
            node = i - 1 + a
            if node < 0:
                w[d, 0] += 3 * v[d, a]
                w[d, 1] -= 3 * v[d, a]
                w[d, 2] += v[d, a]
            elif node > n:
                w[d, 3] += 3 * v[d, a]
                w[d, 2] -= 3 * v[d, a]
                w[d, 1] += v[d, a]
            else:
                w[d, node - base] += v[d, a]
    if outside != 0:
        for a in range(4):
            w[0, a] += outside * w[1, a]
    return base, outside


@nb.njit(cache=True)
def _project(
    slaves,
    surface,
    numbers,
    start,
    size,
    side,
    nodes,
    weights,
    gradient,
    direction,
    depth,
):
    ny, nx = surface.shape[0] - 1, surface.shape[1] - 1
    wx, wy = np.empty((2, 4)), np.empty((2, 4))
    d = np.empty((3, 3))  # S and its derivatives by the parameters
    for s in range(slaves.shape[0]):
        px, py = start[s, 0], start[s, 1]
        bx = by = 0
        ox = oy = det = 0.0
        for _ in range(50):
            bx, ox = _weights(px, nx, wx)
            by, oy = _weights(py, ny, wy)
            d[:] = 0
            for b in range(4):
                for a in range(4):
                    for c in range(3):
                        x = surface[by + b, bx + a, c]
                        d[0, c] += wy[0, b] * wx[0, a] * x
                        d[1, c] += wy[0, b] * wx[1, a] * x
                        d[2, c] += wy[1, b] * wx[0, a] * x
            det = d[1, 0] * d[2, 1] - d[2, 0] * d[1, 1]
            rx, ry = slaves[s, 0] - d[0, 0], slaves[s, 1] - d[0, 1]
            sx = (rx * d[2, 1] - ry * d[2, 0]) / det
            sy = (ry * d[1, 0] - rx * d[1, 1]) / det
            if abs(sx) + abs(sy) < 1e-12:
                break
            px += min(max(sx, -1.0), 1.0)
            py += min(max(sy, -1.0), 1.0)
            px = min(max(px, -2 * _REACH), nx + 2 * _REACH)
            py = min(max(py, -2 * _REACH), ny + 2 * _REACH)
        start[s, 0], start[s, 1] = px, py
        met = abs(ox) < _REACH and abs(oy) < _REACH
        # the rounding of the edge
        drop = side * _ROUNDING * size
        d[0, 2] -= 0.5 * drop * (ox * ox + oy * oy)
        d[1, 2] -= drop * ox
        d[2, 2] -= drop * oy
        hx = (d[1, 2] * d[2, 1] - d[2, 2] * d[1, 1]) / det
        hy = (d[2, 2] * d[1, 0] - d[1, 2] * d[2, 0]) / det
        # inverse Jacobian: parameters by x (i00, i10) and by y (i01, i11)
        i00, i01, i10, i11 = d[2, 1] / det, -d[2, 0] / det, -d[1, 1] / det, d[1, 0] / det
        direction[s, 0], direction[s, 1], direction[s, 2] = -side * hx, -side * hy, side
        depth[s] = side * (d[0, 2] - slaves[s, 2])
        for b in range(4):
            for a in range(4):
                n = 1 + 4 * b + a
                nodes[s, n] = numbers[by + b, bx + a]
                weights[s, n] = -wy[0, b] * wx[0, a]
                gx, gy = wy[0, b] * wx[1, a], wy[1, b] * wx[0, a]
                gradient[s, n, 0] = gx * i00 + gy * i10
                gradient[s, n, 1] = gx * i01 + gy * i11
        if not met:
            depth[s] = -10 * size
            direction[s, 0] = direction[s, 1] = 0
            gradient[s] = 0
