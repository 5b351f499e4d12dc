"""Faces that crease without passing through themselves.

Where a side rolls onto the window the corner of the layer is pushed together, and below a stretch
of a half its face creases (Biot 1963; Hohlfeld and Mahadevan 2011). A crease is closed: its lips
touch. Elements know nothing of that. The outermost facet turns over, the corner passes beneath the
nodes next to it, and from there no equilibrium is to be found. The finer the elements are, the more
of them fold.

Facets next to each other that turn towards each other touch when both are upright, and nothing is
left of their horizontal area. So each facet resists once that area A falls below a share c of its
unloaded area A0, with the energy

    W = k A0 max(0, c - A / A0)^3 / 3,    k = beta mu h,

h the least extent of the element. Both what it takes up and how wide a crease is vanish with the
elements. The cube lets it set in smoothly: stiffness that jumps costs a third more iterations.
Where the imprint is steep a face is upright without being folded: c is smaller there,
by the cosine of the slope.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.runtime.kernels import keep_kernels

from .faces import SLOPE, add_blocks
from .problem import SAMPLE, WINDOW, LayerProblem, LayerState
from .side_contact import outermost_height

keep_kernels()

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Share c of its unloaded area below which a facet resists, and beta: what has no area left is held
#: by ten shear moduli over the least extent of its element.
CREASED, STIFFNESS = 0.4, 60.0
#: Weight of a quadrature point.
_WEIGHT = 0.25


@dataclass(frozen=True, eq=False)
class Folds:
    """The m facets of a face that resist.

    Attributes
    ----------
    corners
        Indices (k, j, i) of their corners, in the order of rows and columns, (3, 4, m).
    missing
        c - A / A0 at the quadrature points, 0 where there is more than c, (4, m).
    gradient
        Of A, by the position (x, y) of the corners, (4, 2, 4, m), mm.
    stiffness
        k, mN / mm, (m).
    unloaded
        A0, mm^2, (m).
    turning
        Derivative of c by the position (x, y) of each corner, (2, m), 1 / mm.
    """

    corners: Indices
    missing: Array
    gradient: Array
    stiffness: Array
    unloaded: Array
    turning: Array

    def add_forces(self, force: Array) -> None:
        """Add what they resist with to the nodal forces (3, nz + 1, ny + 1, nx + 1), mN."""
        pushed = (
            -_WEIGHT * self.stiffness * np.einsum("qm,qcam->cam", self.missing**2, self.gradient)
        )
        for axis in range(2):
            np.add.at(force[axis], tuple(self.corners), pushed[axis])

    def add_stiffness(self, plane: NDArray[np.floating], k: int) -> None:
        """Add the stiffness to plane k of the tangent, [y, neighbour, 3 * row + column, x]."""
        if k == self.corners[0, 0, 0]:
            add_blocks(plane, k, self.corners, self._blocks)

    @cached_property
    def _blocks(self) -> Array:
        """Stiffness between the corners a and b, (3, 3, 4, 4, m), mN / mm."""
        out = np.zeros((3, 3, 4, 4, self.unloaded.size))
        resists = _WEIGHT * self.stiffness * 2.0 * self.missing
        less = self.gradient / self.unloaded - self.turning[:, None]
        out[:2, :2] = np.einsum("qm,qcam,qdbm->cdabm", resists, self.gradient, less)
        # A is bilinear in x and y
        turn = SLOPE[:, :, None, 0] * SLOPE[:, None, :, 1]
        turn = turn - turn.swapaxes(1, 2)
        turned = _WEIGHT * self.stiffness * np.tensordot(turn, self.missing**2, (0, 0))
        out[0, 1] -= turned
        out[1, 0] += turned
        return out


def folds(problem: LayerProblem, state: LayerState) -> list[Folds]:
    """Those facets of window and sample side that resist at ``state``, of each face that has some.

    Facets of glued faces are as they were.
    """
    grid = problem.grid
    across, along = np.diff(grid.y), np.diff(grid.x)
    unloaded = np.outer(across, along)
    heights = outermost_height(grid) * grid.typical_thickness
    found = []
    for face, k in ((WINDOW, 0), (SAMPLE, len(grid.depth) - 1)):
        if problem.glued[face]:
            continue
        j, i = np.nonzero(_narrow(grid.x, grid.y, state.u[:2, k], CREASED * unloaded))
        if not j.size:
            continue
        corners = np.stack([np.full((4, j.size), k), [j, j, j + 1, j + 1], [i, i + 1, i, i + 1]])
        x, y = np.stack([grid.x[corners[2]], grid.y[corners[1]]]) + state.u[:2, *corners]
        least_extent = np.minimum(np.minimum(across[j], along[i]), heights[face])
        least, turning = np.full(j.size, CREASED), np.zeros((2, j.size))
        if face == SAMPLE:
            at = x.mean(0), y.mean(0), state.load
            _, hx, hy, hxx, hxy, hyy = problem.imprint.evaluate(*at)
            steeper = 1 + hx**2 + hy**2
            least /= np.sqrt(steeper)
            turning = -0.25 * least / steeper * np.stack([hx * hxx + hy * hxy, hx * hxy + hy * hyy])
        x_1, x_2, y_1, y_2 = (SLOPE[:, :, d] @ at for at in (x, y) for d in range(2))
        found.append(
            Folds(
                corners=corners,
                missing=np.maximum(least - (x_1 * y_2 - x_2 * y_1) / unloaded[j, i], 0.0),
                gradient=np.stack([_across(y_2, y_1), -_across(x_2, x_1)], axis=1),
                stiffness=STIFFNESS * problem.shear_modulus * least_extent,
                unloaded=unloaded[j, i],
                turning=turning,
            )
        )
    return found


def _across(first: Array, second: Array) -> Array:
    """Shape functions' slopes times one of two tangents (4, m) each, (4, 4, m)."""
    return SLOPE[:, :, :1] * first[:, None] - SLOPE[:, :, 1:] * second[:, None]


@nb.njit(cache=True)
def _narrow(x, y, u, least):
    """Which facets have less than the ``least`` area (ny, nx), mm^2, by one of their corners.

    At a quadrature point a facet has at least what it has by that corner.
    """
    ny, nx = least.shape
    out = np.zeros((ny, nx), np.bool_)
    for j in range(ny):
        for i in range(nx):
            for a in range(4):
                jj, ii = j + (a >> 1), i + (a & 1)
                x_1 = x[i + 1] - x[i] + u[0, jj, i + 1] - u[0, jj, i]
                y_1 = u[1, jj, i + 1] - u[1, jj, i]
                x_2 = u[0, j + 1, ii] - u[0, j, ii]
                y_2 = y[j + 1] - y[j] + u[1, j + 1, ii] - u[1, j, ii]
                if x_1 * y_2 - x_2 * y_1 < least[j, i]:
                    out[j, i] = True
    return out


__all__ = ["Folds", "folds"]
