"""Where surface nodes are on what they meet: a rigid plane, or the surface of another body.

A contact is a set of nodes (the slaves) and what each of them meets: a rigid plane z = const, or
the surface of another body (the master), interpolated smoothly through its nodes. Penetration phi
is measured along z, as in the layer's own solver (``mechanics.contact``).

A slave at (x, y) lies above the master's point xi at which S_xy(xi) = (x, y). With w the weights
of the master's nodes there, W = (1, -w) over slave and master nodes and v = (-h_x, -h_y, 1) from
the slope of the surface (its opposite for slaves on the -z side),

    d phi = -sum_a W_a v . dx_a,

exactly, sliding included. The contact force acts along the area vector of the slave's deformed
element faces (``mechanics.contact`` tells why), and what the slave bears the master's nodes give,
in the shares w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ..contact import turning_stiffness
from ..faces import push_slope

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Beyond its edge the master goes on straight but bends away as s^2 / 2 times this many elements,
#: s the distance from the edge in elements: slaves that slide off it let go smoothly.
_ROUNDING = 2.0
#: Distance from the edge, in elements, beyond which nothing is met.
_REACH = 2.0


@dataclass(frozen=True, eq=False)
class Projection:
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

    def lateral(self, field: Array) -> Array:
        """Lateral part (n, 2) of a nodal field (n_nodes, 3), that of a slave less the master's."""
        return np.einsum("nq,nqc->nc", self.weights, field[self.nodes, :2])


@dataclass(frozen=True, eq=False)
class Plane:
    """Slaves against a rigid plane that lies on the side ``sign`` (-1 window, +1 plate) of them."""

    slaves: Numbers
    sign: float
    friction: float

    def project(self, position: Array, height: float) -> Projection:
        """Return where the slaves are on the plane z = ``height``."""
        n = self.slaves.size
        direction = np.tile([0.0, 0.0, -self.sign], (n, 1))
        return Projection(
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
    their (column, row) on the surface; ``unloaded`` (ny + 1, nx + 1), mm^2, their areas.
    """

    slaves: Numbers
    master: Numbers
    friction: float
    side: float
    start: Array
    element: float
    unloaded: Array

    def project(self, position: Array) -> Projection:
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
        met = -self.side * direction[:, :2].T.reshape(2, *self.slaves.shape)
        push, area, missing = push_slope(surface, self.unloaded, met)
        turning = np.zeros((*self.slaves.shape, 9, 2, 3))
        slope = np.where(missing > 0, met, push)
        turning_stiffness(surface, self.side / area, slope, turning)
        around = np.pad(self.slaves, 1, mode="edge")
        ny, nx = self.slaves.shape
        neighbours = [around[j : j + ny, i : i + nx].ravel() for j in range(3) for i in range(3)]
        return Projection(
            nodes=nodes,
            weights=weights,
            gradient=gradient,
            direction=direction,
            push=self.side * np.stack([-push[0], -push[1], np.ones_like(area)]).reshape(3, -1).T,
            penetration=depth,
            neighbours=np.stack(neighbours, axis=1),
            turning=turning.reshape(n, 9, 2, 3),
        )


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
