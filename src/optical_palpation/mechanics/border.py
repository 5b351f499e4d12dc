"""Sides at which a layer goes on, where it is part of a larger one that is solved already.

The sides of such a part are held by what the rest of the layer does to them,

    t = t0 - k (u - u0),

the traction t0 and the displacement u0 of the coarse solution there, and a stiffness k that stands
for the rest of the layer. Displacement alone, prescribed, would also prescribe the volume: an
imprint that is finer than that of the coarse solution has another volume beneath it, and a nearly
incompressible part answers to a difference of 1e-4 with several kPa. Traction alone would let the
part slide. With k of a few shear moduli per thickness, displacements hold but for what the volume
needs.

The pressure in t0 follows the sides as they turn, as that of the neighbouring elements would. As a
dead load of many shear moduli it would fold them.

A cut through a layer that is sheared a lot makes a surface that wrinkles (Biot): k alone holds the
long waves of u - u0, while what the rest of the layer does to shorter ones grows with their wave
number. A membrane on the cut, of tension T, stands for that,

    t = t0 - k (u - u0) + T div grad (u - u0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .faces import add_blocks, area_derivatives, area_vectors, gradient_products
from .grid import LayerGrid

Array = NDArray[np.float64]
Indices = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]

#: Order of the sides: those across y at its lowest and highest, then those across x.
SIDES = ("y0", "y1", "x0", "x1")

#: Nodes beyond a part, or a side, that its interpolation needs, and some more.
_NEAR = 5


@dataclass(frozen=True, eq=False)
class CutSide:
    """A cut side, a surface of nodes (nz + 1, n).

    ``nodes`` are their indices (k, j, i), ``unloaded`` their positions and ``displacement`` u0 of
    each, (3, nz + 1, n), mm, ``pressure`` that of the coarse solution, kPa, ``sign`` that of the
    area vectors outwards, and ``tension`` that of the membrane, mN / mm.
    """

    nodes: Indices
    unloaded: Array
    displacement: Array
    pressure: Array
    sign: float
    tension: float

    @cached_property
    def corners(self) -> NDArray[np.intp]:
        """Indices (k, j, i) of the corners of the m faces, (3, 4, m)."""
        return np.stack([_at_corners(index) for index in self.nodes])

    @cached_property
    def membrane(self) -> Array:
        """Stiffness of the membrane between the corners of each face, (4, 4, m), mN / mm."""
        return self.tension * gradient_products(self.unloaded + self.displacement)

    def resistance(self, u: Array) -> Array:
        """What the nodes pull at pressure and membrane with, (3, nz + 1, n), mN."""
        now = u[:, *self.nodes]
        off = np.stack([_at_corners(component) for component in now - self.displacement])
        pulled = np.einsum("abm,cbm->cam", self.membrane, off)
        out = self.sign * self.pressure * area_vectors(self.unloaded + now)
        rows, columns = now.shape[1:]
        for a, part in enumerate(pulled.reshape(3, 4, rows - 1, columns - 1).swapaxes(0, 1)):
            y, x = divmod(a, 2)
            out[:, y : rows - 1 + y, x : columns - 1 + x] += part
        return out

    def stiffness(self, u: Array) -> tuple[NDArray[np.intp], Array]:
        """The derivative of that, as ``add_blocks`` takes it."""
        change = area_derivatives(self.unloaded + u[:, *self.nodes])
        blocks = self.sign * _at_corners(self.pressure)[:, None] * change
        for c in range(3):
            blocks[c, c] += self.membrane
        return self.corners, blocks


def _at_corners(field: NDArray) -> NDArray:
    """Nodal values (ny, nx) at the four corners of each face, (4, m)."""
    here = slice(None, -1), slice(1, None)
    return np.stack([field[y, x].reshape(-1) for y in here for x in here])


@dataclass(frozen=True, eq=False)
class Border:
    """What holds the nodes of cut sides.

    Attributes
    ----------
    sides
        The cut sides, with the pressure on them.
    nodes
        Indices (k, j, i) of their n nodes, those on both faces too.
    displacement
        u0 of each, (3, n), mm.
    force
        The traction t0 without the pressure, on the share of each, (3, n), mN.
    stiffness
        k times the share of each, (n,), mN / mm.
    """

    sides: tuple[CutSide, ...]
    nodes: Indices
    displacement: Array
    force: Array
    stiffness: Array

    def add_resistance(self, u: Array, force: Array) -> None:
        """Add the forces with which the nodes pull at what is around them to nodal ones, mN."""
        held = self.stiffness * (u[:, *self.nodes] - self.displacement) - self.force
        force[:, *self.nodes] += held
        for side in self.sides:
            force[:, *side.nodes] += side.resistance(u)

    def side_stiffness(self, u: Array) -> list[tuple[NDArray[np.intp], Array]]:
        """The stiffness of pressure and membrane of each side, for ``add_stiffness``."""
        return [side.stiffness(u) for side in self.sides]

    def add_stiffness(
        self,
        plane: NDArray[np.floating],
        k: int,
        sides: Sequence[tuple[NDArray[np.intp], Array]],
    ) -> None:
        """Add the stiffness to plane k of the tangent, [y, neighbour, 3 * row + column, x]."""
        _, j, i = self.nodes
        here = self.nodes[0] == k
        for c in (0, 4, 8):
            plane[j[here], 13, c, i[here]] += self.stiffness[here]
        for corners, blocks in sides:
            add_blocks(plane, k, corners, blocks)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A larger layer, solved, of which a part is cut out.

    Attributes
    ----------
    grid
        Its grid.
    displacement
        (3, nz + 1, ny + 1, nx + 1), mm.
    stress
        Cauchy stress of its elements (xx, yy, zz, yz, xz, xy), (6, nz, ny, nx), kPa.
    stiffness
        k, kPa / mm.
    tension
        T, mN / mm.
    extent
        x0, x1, y0, y1 of the layer, mm, of which ``grid`` may be what is near the part.
    """

    grid: LayerGrid
    displacement: Array
    stress: Array
    stiffness: float
    tension: float
    extent: tuple[float, float, float, float]

    def near(self, part: LayerGrid) -> Surroundings:
        """Return what of the surroundings matters to a part."""
        y, x = (
            slice(
                max(int(np.searchsorted(theirs, mine[0])) - _NEAR, 0),
                int(np.searchsorted(theirs, mine[-1])) + _NEAR,
            )
            for mine, theirs in ((part.y, self.grid.y), (part.x, self.grid.x))
        )
        grid = LayerGrid(self.grid.x[x], self.grid.y[y], self.grid.depth, self.grid.thickness[y, x])
        cells = tuple(slice(s.start, s.start + len(n) - 1) for s, n in ((y, grid.y), (x, grid.x)))
        return replace(
            self,
            grid=grid,
            displacement=self.displacement[:, :, y, x],
            stress=self.stress[:, :, cells[0], cells[1]],
        )

    def cut(self, part: LayerGrid) -> tuple[bool, bool, bool, bool]:
        """Which sides of a part are cut, in the order of ``SIDES``; the others are the layer's."""
        x0, x1, y0, y1 = self.extent
        slack = 1e-6 * (x1 - x0)
        return (
            bool(part.y[0] > y0 + slack),
            bool(part.y[-1] < y1 - slack),
            bool(part.x[0] > x0 + slack),
            bool(part.x[-1] < x1 - slack),
        )

    def border(self, part: LayerGrid) -> Border | None:
        """What holds the cut sides of a part, on the nodes of its grid; None of the whole layer."""
        if not any(self.cut(part)):
            return None
        nz1, ny1, nx1 = part.node_shape
        numbers = np.arange(nz1 * ny1 * nx1).reshape(part.node_shape)
        found, sides = [], []
        for name, cut in zip(SIDES, self.cut(part), strict=True):
            if not cut:
                continue
            across_x, end = name[0] == "x", -1 if name[1] == "1" else 0
            plane = (slice(None), slice(None), end) if across_x else (slice(None), end)
            side = LayerGrid(
                part.x[[end]] if across_x else part.x,
                part.y if across_x else part.y[[end]],
                part.depth,
                part.thickness[:, [end]] if across_x else part.thickness[[end]],
            )
            around = self.near(side)
            moved = side.interpolate_from(around.grid, around.displacement)
            tensor = side.interpolate_from(around.grid, _at_nodes(around.stress))
            moved, tensor, at = (
                field[..., 0] if across_x else field[:, :, 0]
                for field in (moved, tensor, side.nodes)
            )
            # outwards: those across x point along x, those across y against y
            sign = (1.0 if end else -1.0) * (1.0 if across_x else -1.0)
            area = sign * area_vectors(at + moved)
            xx, yy, zz, yz, xz, xy = tensor
            pressure = -(xx + yy + zz) / 3
            rows = np.array(
                [[xx + pressure, xy, xz], [xy, yy + pressure, yz], [xz, yz, zz + pressure]]
            )
            index = np.unravel_index(numbers[plane], part.node_shape)
            on_side = index[0], index[1], index[2]
            sides.append(CutSide(on_side, at, moved, pressure, sign, self.tension))
            force = np.einsum("cdkn,dkn->ckn", rows, area)
            size = np.linalg.norm(area, axis=0)
            found.append(
                (numbers[plane].ravel(), *(f.reshape(3, -1) for f in (moved, force)), size.ravel())
            )
        each = np.concatenate([number for number, *_ in found])
        nodes, first, place = np.unique(each, return_index=True, return_inverse=True)
        moved = np.concatenate([m for _, m, *_ in found], axis=1)[:, first]
        force, size = np.zeros((3, nodes.size)), np.zeros(nodes.size)
        for c in range(3):
            np.add.at(force[c], place, np.concatenate([f[c] for *_, f, _ in found]))
        np.add.at(size, place, np.concatenate([s for *_, s in found]))
        indices = np.unravel_index(nodes, part.node_shape)
        found_nodes = indices[0], indices[1], indices[2]
        return Border(tuple(sides), found_nodes, moved, force, self.stiffness * size)


def _at_nodes(field: Array) -> Array:
    """Nodal values of an element field (n, nz, ny, nx), which alternates from element to element.

    The mean of the elements around each node; beyond both faces the field goes on in a straight
    line.
    """
    below, above = field[:, :1], field[:, -1:]
    if field.shape[1] > 1:
        below, above = 2 * below - field[:, 1:2], 2 * above - field[:, -2:-1]
    padded = np.concatenate([below, field, above], axis=1)
    padded = np.pad(padded, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge")
    for axis in (1, 2, 3):
        low = [slice(None)] * 4
        high = [slice(None)] * 4
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        padded = 0.5 * (padded[tuple(low)] + padded[tuple(high)])
    return padded
