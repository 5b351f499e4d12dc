"""Contact of the free sides, which roll onto window and imprint.

A free side bulges and, under a large compression, rolls onto the window and the imprint: in plane
strain at 42 % a third of it lies on the window and drags there. A side is no face, and has no
contact forces of its own as unknowns: it is pressed back by a penalty,

    pressure = kappa S(phi),

at integration points, so that it rolls on along an element and not node by node, each with a snap.
phi is the penetration of a point, -z at the window and z - h(x, y) at the imprint, and S sets in
smoothly a share of an element's height before they touch. Both the sinking in and the share vanish
with the elements.

Friction is that of the faces, at the nodes: bounded by what presses each, along the slip since the
last accepted load. A face that is glued has none for the sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .faces import add_blocks
from .friction import Ahead, friction_direction, look_ahead, node_stiffness
from .grid import LayerGrid, rim_numbers

if TYPE_CHECKING:
    from .body import Body
    from .problem import LayerProblem, LayerState

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Penalty kappa in shear moduli per height of the outermost element.
PENALTY = 60.0
#: Where the penalty begins, as a share of the height at which a point would be if the layer were
#: pressed evenly, no further than that share of the outermost element; and that where the face is
#: glued: the side of a layer that slides arrives with a snap, and must be felt before.
GAP, GLUED_GAP = 0.65, 0.1
#: Integration points of a side's element through the depth and along it.
_POINTS = 3, 2


def penalty(penetration: Array, gap: Array | float) -> tuple[Array, Array]:
    """The length S of a penalty that sets in smoothly at a ``gap``, mm, and its derivative."""
    near = np.clip(1 + penetration / np.maximum(gap, 1e-12), 0.0, 2.0)
    return 0.25 * gap * near**2 + np.maximum(penetration - gap, 0.0), 0.5 * near


def outermost_height(grid: LayerGrid) -> Array:
    """Height of the outermost elements at window and sample side, in thicknesses, (2,)."""
    return np.array([grid.depth[1], 1 - grid.depth[-2]])


@dataclass(frozen=True, eq=False)
class Facets:
    """The element faces of some sides, n of them in each of nz layers.

    Attributes
    ----------
    nodes
        Indices (k, j, i) of the corners a, the two lower ones first, (3, 4, nz, n).
    shape
        Shape functions of the corners at the integration points, (points, 4).
    depth
        Depth of the integration points as a fraction of the thickness, (points, nz, 1).
    area
        Unloaded area that belongs to each point, (points, nz, n), mm^2.
    """

    nodes: Indices
    shape: Array
    depth: Array
    area: Array

    def at_points(self, field: Array, these: NDArray[np.bool_] | EllipsisType) -> Array:
        """A nodal field (c, nz + 1, ny + 1, nx + 1) at the points of ``these``, (c, points, m).

        Of all of them, ``...``, it is (c, points, nz, n).
        """
        corners = field[:, *self.nodes[:, :, these]]
        return np.tensordot(self.shape, corners, (1, 1)).swapaxes(0, 1)

    @classmethod
    def of(cls, grid: LayerGrid, sides: tuple[bool, bool, bool, bool]) -> Facets:
        """Return those of some sides: the lowest and highest in y, then in x."""
        (z, wz), (t, wt) = (_gauss(count) for count in _POINTS)
        z, t, weight = np.repeat(z, t.size), np.tile(t, z.size), np.outer(wz, wt).ravel()
        shape = np.stack([(1 - z) * (1 - t), (1 - z) * t, z * (1 - t), z * t], axis=1)
        nz, (j, i) = len(grid.depth) - 1, _along_sides(grid.node_shape[1:], sides)
        lower = np.arange(nz)[:, None]
        nodes = np.stack(
            [np.broadcast_arrays(lower + (a >> 1), j[a & 1], i[a & 1]) for a in range(4)],
            axis=1,
        )
        width = np.hypot(np.diff(grid.x[i], axis=0), np.diff(grid.y[j], axis=0))[0]
        thickness = grid.thickness[j, i]
        height = np.diff(grid.depth)[:, None]
        local = np.stack([(1 - s) * thickness[0] + s * thickness[1] for s in t])
        return cls(
            nodes,
            shape,
            grid.depth[:-1, None] + z[:, None, None] * height,
            weight[:, None, None] * width * height * local[:, None],
        )


@dataclass(frozen=True, eq=False)
class SideTangent:
    """How what presses the sides changes.

    Attributes
    ----------
    blocks
        Stiffness between the corners a and b of those ``facets`` that touch, (3, 3, 4, 4, m),
        mN / mm.
    facets
        Indices (k, j, i) of their corners, (3, 4, m).
    hold
        Stiffness of friction at the nodes (xx, xy, yx, yy), (2, 2, n), mN / mm.
    change
        What friction (x, y) is to begin with beyond that of the state (``friction.look_ahead``),
        (2, n), mN.
    nodes
        The ``LayerGrid.side_nodes``.
    """

    blocks: Array
    facets: Indices
    hold: Array
    change: Array
    nodes: tuple[Indices, Indices, Indices]

    def add_stiffness(self, plane: NDArray[np.floating], k: int) -> None:
        """Add the stiffness to plane k of the tangent, [y, neighbour, 3 * row + column, x]."""
        add_blocks(plane, k, self.facets, self.blocks)
        here = self.nodes[0] == k
        j, i = self.nodes[1][here], self.nodes[2][here]
        for c, d in np.ndindex(2, 2):
            plane[j, 13, 3 * c + d, i] += self.hold[c, d, here]


@dataclass(frozen=True, eq=False)
class SideContact:
    """What window and imprint do to the sides.

    Attributes
    ----------
    normal_force
        Vertical, compression positive, on the ``LayerGrid.side_nodes``, (2, n), mN.
    force
        What the nodes must balance, friction included, (3, n), mN.
    nodes
        The ``LayerGrid.side_nodes``.
    """

    normal_force: Array
    force: Array
    nodes: tuple[Indices, Indices, Indices]
    _touch: _Touch
    _corners: _Corners
    _rubs: Array
    _slip: Array | None
    _elastic: float
    _slip_length: float

    @property
    def bound(self) -> Array:
        """The bound of friction at each node, (surfaces, n), mN."""
        return self._rubs[:, None] * self.normal_force

    def friction(
        self, residual: Array, whole: Array, resistance: Array | float = 0.0
    ) -> Ahead | None:
        """Linearise friction, where there is any, as ``ContactLinearisation.friction``.

        ``resistance`` is that of the side nodes, (n).
        """
        if self._slip is None or not self._touch.corners.size:
            return None
        lateral = np.broadcast_to(residual[:2, *self.nodes], self._slip.shape)
        whole = np.broadcast_to(whole[self.nodes], self.normal_force.shape)
        elastic = np.asarray((self._elastic + resistance) * self._slip_length)
        return look_ahead(self._slip, lateral, elastic, whole)

    def turned(self, ahead: Ahead) -> Array:
        """What friction (x, y) will be beyond that of the state, (2, n), mN."""
        return (self.bound[:, None] * ahead.turned).sum(0)

    def tangent(self, ahead: Ahead | None) -> SideTangent:
        """Linearise it, friction where it will be."""
        touch, corners, rubs = self._touch, self._corners, self._rubs[:, None]
        g = touch.gradient
        stiffness = (touch.stiffness[:, None, None] * g[:, :, None] * g[:, None, :]).sum(0)
        stiffness[:2, :2] -= touch.force[-1] * touch.curvature
        blocks = corners.between(stiffness)
        hold, change = np.zeros((2, 2, self.nodes[0].size)), np.zeros((2, self.nodes[0].size))
        if ahead is not None:
            bound = self.bound[:, None]
            # of the normal force of corner a by the displacement d of corner b
            pressed = corners.between(touch.stiffness[:, None] * g)
            along = (rubs[:, None] * ahead.direction)[:, :, corners.number]
            blocks[:2] += (along[:, :, None, :, None] * pressed[:, None]).sum(0)
            xx, xy, yy = (bound * ahead.slope).sum(0) / self._slip_length
            hold = np.array([[xx, xy], [xy, yy]])
            change = (bound * ahead.change).sum(0)
        return SideTangent(blocks, touch.corners, hold, change, self.nodes)


def side_contact(
    problem: LayerProblem, state: LayerState, slip: Array | None = None
) -> SideContact:
    """Contact of the free sides with window and imprint at ``state``.

    ``slip`` is the w of the side nodes, (2, 2, n); without it there is no friction in what is
    returned.
    """
    rubs = np.where(problem.glued, 0.0, problem.friction)
    touch = _touching(problem, state)
    grid, height = problem.grid, problem.grid.typical_thickness
    elastic = float(node_stiffness(problem.shear_modulus, grid.spacing[0] ** 2, height))
    return _contact(grid, problem.side_facets, touch, rubs, problem.slip_length, elastic, slip)


def _touching(problem: LayerProblem, state: LayerState) -> _Touch:
    grid, facets = problem.grid, problem.side_facets
    outermost = outermost_height(grid)[:, None, None]
    share = np.where(problem.glued, GLUED_GAP, GAP)[:, None, None] * problem.side_reach
    lowest = problem.imprint.lowest(state.load)
    z = (grid.nodes[2] + state.u[2])[*facets.nodes]
    # no gap is larger than its share of the outermost element
    reach = (share * outermost)[:, 0, 0] * np.max(grid.thickness)
    near = (z.min(0) < reach[0]) | (z.max(0) > lowest - reach[1])
    unloaded, (before, after) = problem.side_points
    x, y, z = unloaded[:, :, near] + facets.at_points(state.u, near)
    h, *slopes = problem.imprint.evaluate(x, y, state.load)
    pressed_evenly = before[:, near] + state.load * (after[:, near] - before[:, near])
    depth = np.broadcast_to(facets.depth, facets.area.shape)[:, near]
    gap = share * pressed_evenly * np.minimum(np.stack([depth, 1 - depth]), outermost)
    spring = PENALTY * problem.shear_modulus / (outermost * grid.typical_thickness)
    hx, hy, hxx, hxy, hyy = slopes
    flat, one = np.zeros_like(hx), np.ones_like(hx)
    return _touch(
        facets,
        near,
        np.stack([-z, z - h]),
        gap,
        spring,
        np.array([[flat, flat, -one], [-hx, -hy, one]]),
        np.array([[hxx, hxy], [hxy, hyy]]),
    )


@dataclass(frozen=True, eq=False)
class PlaneSides:
    """Contact of the free sides of a body with the rigid plane on which its outer face lies.

    Attributes
    ----------
    body, facets
        The body, and the element faces of its sides.
    sign
        On which side of the body the plane is: -1 towards -z, +1 towards +z.
    friction
        At the plane.
    flattened
        Height of the body where it is pressed evenly, as a share of its unloaded one.
    """

    body: Body
    facets: Facets
    sign: float
    friction: float
    flattened: float

    def contact(self, u: Array, height: float, slip_length: float, slip: Array) -> SideContact:
        """Contact with the plane z = ``height`` at a displacement, as ``side_contact``.

        ``u`` (3, nz + 1, ny + 1, nx + 1), mm; ``slip``: w of the side nodes, (1, 2, n).
        """
        grid, facets, sign = self.body.grid, self.facets, self.sign
        outermost = outermost_height(grid)[0 if sign < 0 else 1]
        thickness = grid.typical_thickness
        z = (self.body.nodes[2] + u[2])[*facets.nodes]
        near = (sign * (z - height)).max(0) > -GAP * outermost * np.max(grid.thickness)
        unloaded = facets.at_points(self.body.nodes, near)[2]
        z = unloaded + facets.at_points(u, near)[2]
        face = float(self.body.nodes[2, 0 if sign < 0 else -1].mean())
        away = np.minimum(sign * (face - unloaded), outermost * thickness)
        element = np.minimum(facets.nodes.min(1), np.array(grid.shape)[:, None, None] - 1)
        factor = np.broadcast_to(self.body.factor, grid.shape)[*element][near]
        flat = np.zeros_like(z)
        touch = _touch(
            facets,
            near,
            sign * (z - height)[None],
            GAP * self.flattened * away[None],
            PENALTY * self.body.law.shear_modulus * factor / (outermost * thickness),
            np.array([[flat, flat, flat + sign]]),
            np.zeros((2, 2, *z.shape)),
        )
        rubs = np.array([self.friction])
        modulus = self.body.median_shear_modulus
        elastic = float(node_stiffness(modulus, grid.spacing[0] ** 2, thickness))
        return _contact(grid, facets, touch, rubs, slip_length, elastic, slip)


@dataclass(frozen=True, eq=False)
class _Touch:
    """What presses the integration points of those m facets that touch one of some surfaces.

    ``corners`` (3, 4, m) are their indices (k, j, i), ``force`` (surfaces, points, m), mN, and
    ``stiffness`` mN / mm, those of the penalty; ``gradient`` (surfaces, 3, points, m) that of the
    penetration and ``curvature`` (2, 2, points, m), 1 / mm, that of the last surface.
    """

    corners: Indices
    force: Array
    stiffness: Array
    gradient: Array
    curvature: Array


def _touch(
    facets: Facets,
    near: NDArray[np.bool_],
    penetration: Array,
    gap: Array,
    spring: Array,
    gradient: Array,
    curvature: Array,
) -> _Touch:
    """Press on those facets that touch of those that are ``near``; ``spring`` in kPa / mm."""
    length, slope = penalty(penetration, gap)
    stiffness = facets.area[:, near] * spring
    touch = (slope > 0).any((0, 1))
    return _Touch(
        facets.nodes[:, :, near][:, :, touch],
        (stiffness * length)[..., touch],
        (stiffness * slope)[..., touch],
        gradient[..., touch],
        curvature[..., touch],
    )


@dataclass(frozen=True, eq=False)
class _Corners:
    """From the integration points of facets to their corners.

    ``shape`` are the shape functions (points, 4), ``number`` (4, m) which of ``count`` side nodes
    the corners are.
    """

    shape: Array
    number: Indices
    count: int

    def sums(self, values: Array) -> Array:
        """Sums at each node of values (..., points, m) on the facets."""
        corners = np.tensordot(self.shape, values, (0, -2))
        out = np.zeros((*values.shape[:-2], self.count))
        for at in np.ndindex(values.shape[:-2]):
            out[at] = np.bincount(self.number.ravel(), corners[:, *at].ravel(), self.count)
        return out

    def between(self, values: Array) -> Array:
        """The stiffness (..., a, b, m) of values (..., points, m)."""
        pairs = self.shape[:, :, None] * self.shape[:, None, :]
        return np.moveaxis(np.tensordot(values, pairs, (-2, 0)), -3, -1)


def _contact(
    grid: LayerGrid,
    facets: Facets,
    touch: _Touch,
    rubs: Array,
    slip_length: float,
    elastic: float,
    slip: Array | None,
) -> SideContact:
    """Forces at the nodes.

    ``rubs`` is the friction of each surface, (surfaces,); ``elastic``, mN / mm, how a node resists
    being moved sideways.
    """
    nodes = grid.side_nodes
    corners = _Corners(facets.shape, _numbers(grid, touch.corners), nodes[0].size)
    normal = corners.sums(touch.force)
    force = corners.sums((touch.force[:, None] * touch.gradient).sum(0))
    if slip is not None and touch.corners.size:
        rubbing = (rubs[:, None] * normal)[:, None] * friction_direction(slip)
        force[:2] += rubbing.sum(0)
    return SideContact(normal, force, nodes, touch, corners, rubs, slip, elastic, slip_length)


def _numbers(grid: LayerGrid, indices: Indices) -> Indices:
    """Which of the ``LayerGrid.side_nodes`` have indices (k, j, i), (3, ...)."""
    number = rim_numbers(grid.node_shape[1:])
    return indices[0] * (number.max() + 1) + number[indices[1], indices[2]]


def _along_sides(
    shape: tuple[int, ...], sides: tuple[bool, bool, bool, bool]
) -> tuple[Indices, Indices]:
    """Indices j and i, each (2, n), of the two ends of the elements along some sides."""
    ny1, nx1 = shape
    found = []
    for number, there in enumerate(sides):
        if not there:
            continue
        along, last = (nx1, ny1 - 1) if number < 2 else (ny1, nx1 - 1)
        ends = np.stack([np.arange(along - 1), np.arange(1, along)])
        fixed = np.full_like(ends, last if number % 2 else 0)
        found.append((fixed, ends) if number < 2 else (ends, fixed))
    if not found:
        return np.zeros((2, 0), np.intp), np.zeros((2, 0), np.intp)
    return (
        np.concatenate([j for j, _ in found], axis=1),
        np.concatenate([i for _, i in found], axis=1),
    )


def _gauss(count: int) -> tuple[Array, Array]:
    """Points and weights on 0 to 1."""
    points, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 + 0.5 * points, 0.5 * weights
