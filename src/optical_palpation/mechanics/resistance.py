"""What resists a body that moves: honey, in which each node drags its neighbours along.

Damped Newton steps and bodies that come to rest against drag are held by it. The force on a node by
the displacements u is

    V u - r^2 sum_d  d(V du/dx_d) / dx_d,

in finite volumes, with V its volume and the reach r a share of the thickness: what a node moves by
itself, and by more than its neighbours. The first alone, a resistance of each volume, holds what is
wider than r. But a rim folds, and a node snaps, by elements, and their stiffness grows as these get
smaller: the second holds them by its modulus, whatever their size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .grid import LayerGrid

Array = NDArray[np.float64]

#: The reach r in thicknesses, squared: either holds waves as long as 0.7 thicknesses as much.
_REACH = 1 / 80
#: Neighbours of a node within a stencil, before and behind it along z, y and x.
_NEIGHBOURS = ((4, 22), (10, 16), (12, 14))
#: Where the xx, yy and zz entries of a stencil are.
_DIAGONAL = (0, 4, 8)


@dataclass(frozen=True, eq=False)
class Resistance:
    """Unit resistance (1 kPa / mm^2) of a body on a grid to displacement."""

    grid: LayerGrid

    @cached_property
    def own(self) -> Array:
        """Resistance to a node that moves alone, (nz + 1, ny + 1, nx + 1), mm^3."""
        own = self.grid.node_volumes.copy()
        for axis, (depth, lateral) in enumerate(self._bonds):
            bond = depth[:, None, None] * lateral
            for part in (slice(None, -1), slice(1, None)):
                own[_along(axis, part)] += bond
        return own

    def force(self, u: Array) -> Array:
        """Forces, mN, by displacements u, mm; both (3, nz + 1, ny + 1, nx + 1)."""
        force = self.grid.node_volumes * u
        for axis, (depth, lateral) in enumerate(self._bonds, start=1):
            pulled = depth[:, None, None] * lateral * np.diff(u, axis=axis)
            before, behind = (_along(axis, part) for part in (slice(None, -1), slice(1, None)))
            force[before] -= pulled
            force[behind] += pulled
        return force

    def add_to(self, plane: NDArray[np.floating], k: int, much: float) -> None:
        """Add a resistance of ``much``, kPa / mm^2, to plane k of a tangent (in place).

        ``plane`` is [y, neighbour, 3 * row + column, x].
        """
        nx1 = len(self.grid.x)
        plane[:, 13, _DIAGONAL, :nx1] += much * self.own[k][:, None]
        (down, column), (height, along_y), (_, along_x) = self._bonds
        for entry in _DIAGONAL:
            before, behind = _NEIGHBOURS[0]
            if k > 0:
                plane[:, before, entry, :nx1] -= much * down[k - 1] * column
            if k < len(down):
                plane[:, behind, entry, :nx1] -= much * down[k] * column
            before, behind = _NEIGHBOURS[1]
            plane[1:, before, entry, :nx1] -= much * height[k] * along_y
            plane[:-1, behind, entry, :nx1] -= much * height[k] * along_y
            before, behind = _NEIGHBOURS[2]
            plane[:, before, entry, 1:nx1] -= much * height[k] * along_x
            plane[:, behind, entry, : nx1 - 1] -= much * height[k] * along_x

    @cached_property
    def _bonds(self) -> list[tuple[Array, Array]]:
        """Resistance between neighbours along z, y and x, mm^3: factors by depth and by (y, x).

        Those of a part of a layer are those of the whole.
        """
        z, y, x = self.grid.node_widths
        h = self.grid.thickness
        along_y, along_x = 0.5 * (h[1:] + h[:-1]), 0.5 * (h[:, 1:] + h[:, :-1])
        return [
            (1 / np.diff(self.grid.depth), _REACH * h * y[:, None] * x),
            (z, _REACH * along_y**3 * x / np.diff(self.grid.y)[:, None]),
            (z, _REACH * along_x**3 * y[:, None] / np.diff(self.grid.x)),
        ]


def _along(axis: int, part: slice) -> tuple[slice, ...]:
    return (*(slice(None),) * axis, part)
