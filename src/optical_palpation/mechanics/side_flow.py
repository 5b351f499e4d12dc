"""Volume that a parabolic profile carries past the straight sides of elements.

Trilinear elements have straight upright edges. Between faces that stick, a pressure gradient bends
the material into a parabola through the depth, and elements h high miss the part between parabola
and chord: of a layer that sticks on both faces, n elements let through 1 - 1 / n^2 of the volume
that they should, and are that much too stiff. The part missed is a bubble on each upright side,

    4 t (1 - t) a,  t from 0 to 1 through the element's depth,

whose displacement a, lateral and across the side, is resisted by the shear of the elements beside
it, (16 / 3) mu V / h^2 with V the reference volume between their centres. It moves the volume
(2 / 3) A a from one to the other, with A the part of the side's deformed area across x or y. Where
its forces balance, the pressures p of two neighbours i and j drive the volume

    c (p_j - p_i),  c = A^2 h^2 / (12 mu V),

out of j into i, so that the bubbles need no unknowns of their own: the volume equation of element i
reads v - V (1 + p / K) - (S p) = 0 with the symmetric S of these flows. The term vanishes with the
square of h. Its coefficients move with the deformed sides; that they do is left out of the tangent.
Nothing pushes on the outermost sides, where the material is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.parallel import in_parallel

from .lanes import FAST

#: Height over width beyond which an element counts as no higher: beside a free side, where elements
#: are narrow, the material does not flow along the layer as between plates.
_SLENDER = 2.0

Array = NDArray[np.float64]
Pressure = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class SideFlow:
    """Volume between elements, per difference of their pressures, mm^3 / kPa.

    Attributes
    ----------
    y, x
        Coefficients of the sides across y, (nz, ny + 1, nx), and across x, (nz, ny, nx + 1). Those
        of the outermost sides are 0: nothing pushes there.
    """

    y: Pressure
    x: Pressure

    def astype(self, kind: type[np.floating]) -> SideFlow:
        """Return the coefficients in another precision."""
        return SideFlow(self.y.astype(kind), self.x.astype(kind))

    def outflow(self, p: Pressure) -> Pressure:
        """Volume that leaves each element at pressures ``p`` (nz, ny, nx), mm^3; S p."""
        out = np.empty(p.shape, p.dtype)
        _outflow(self.y, self.x, p, out)
        return out


def side_flow(nodes: Array, u: Array, factor: Array, shear_modulus: float) -> SideFlow:
    """Return the coefficients at a displacement.

    Parameters
    ----------
    nodes, u
        Reference positions and displacement, (3, nz + 1, ny + 1, nx + 1), mm.
    factor
        Stiffness factors, (nz, ny, nx) or (1, 1, 1).
    shear_modulus
        That of a stiffness factor of 1, kPa.
    """
    nz, ny, nx = (n - 1 for n in u.shape[1:])
    flow = SideFlow(np.empty((nz, ny + 1, nx)), np.empty((nz, ny, nx + 1)))
    _coefficients(nodes, u, factor, shear_modulus, flow.y, flow.x)
    flow.y[:, [0, -1]] = 0
    flow.x[:, :, [0, -1]] = 0
    return flow


@nb.njit(cache=True)
def _coefficients(nodes, u, factor, mu, across_y, across_x):
    in_parallel(
        _coefficient_rows,
        across_x.shape[0] * across_y.shape[1],
        (nodes, u, factor, mu, across_y, across_x),
    )


@nb.njit(fastmath=FAST, error_model="numpy")
def _coefficient_rows(nodes, u, factor, mu, across_y, across_x, begin, end):
    _, ny1, nx = across_y.shape
    ny = ny1 - 1
    for row in range(begin, end):
        k, j = row // ny1, row % ny1
        kf = min(k, factor.shape[0] - 1)
        for i in range(nx):
            i_f = min(i, factor.shape[2] - 1)
            stiff, wide = 0.0, 0.0
            for jj in range(max(j - 1, 0), min(j + 1, ny)):
                width = nodes[1, k, jj + 1, i] - nodes[1, k, jj, i]
                stiff += factor[kf, min(jj, factor.shape[1] - 1), i_f] * width
                wide += width
            across_y[k, j, i] = _coefficient(nodes, u, k, j, i, 0, 1, stiff, wide, mu)
        if j == ny:
            continue
        jf = min(j, factor.shape[1] - 1)
        for i in range(nx + 1):
            stiff, wide = 0.0, 0.0
            for ii in range(max(i - 1, 0), min(i + 1, nx)):
                width = nodes[0, k, j, ii + 1] - nodes[0, k, j, ii]
                stiff += factor[kf, jf, min(ii, factor.shape[2] - 1)] * width
                wide += width
            across_x[k, j, i] = _coefficient(nodes, u, k, j, i, 1, 0, stiff, wide, mu)


@nb.njit(fastmath=FAST, error_model="numpy")
def _coefficient(nodes, u, k, j, i, dj, di, stiff, wide, mu):
    """A^2 h^2 / (12 mu V) of the side from node (k, j, i) to (k + 1, j + dj, i + di).

    ``stiff`` is the sum of width times stiffness factor of the elements beside it, half of which
    are V.
    """
    j1, i1, c = j + dj, i + di, dj
    # of the deformed side's area the part across x or y, from its diagonals
    a = nodes[c, k + 1, j1, i1] + u[c, k + 1, j1, i1] - nodes[c, k, j, i] - u[c, k, j, i]
    a2 = nodes[2, k + 1, j1, i1] + u[2, k + 1, j1, i1] - nodes[2, k, j, i] - u[2, k, j, i]
    b = nodes[c, k + 1, j, i] + u[c, k + 1, j, i] - nodes[c, k, j1, i1] - u[c, k, j1, i1]
    b2 = nodes[2, k + 1, j, i] + u[2, k + 1, j, i] - nodes[2, k, j1, i1] - u[2, k, j1, i1]
    area = 0.5 * (a * b2 - a2 * b)
    low = nodes[2, k + 1, j, i] - nodes[2, k, j, i]
    high = nodes[2, k + 1, j1, i1] - nodes[2, k, j1, i1]
    h = 0.5 * (low + high)
    along = (nodes[0, k, j1, i1] - nodes[0, k, j, i]) + (nodes[1, k, j1, i1] - nodes[1, k, j, i])
    # the distance of the elements' centres, of which those at a border are half a width
    apart = 0.5 * wide
    part = min(1.0, (_SLENDER * apart / h) ** 2)
    return part * area * area * h / (6.0 * mu * stiff * along)


@nb.njit(cache=True)
def _outflow(across_y, across_x, p, out):
    in_parallel(_outflow_rows, p.shape[0] * p.shape[1], (across_y, across_x, p, out))


@nb.njit(fastmath=FAST)
def _outflow_rows(across_y, across_x, p, out, begin, end):
    _, ny, nx = p.shape
    for row in range(begin, end):
        k, j = row // ny, row % ny
        own, line = p[k, j], out[k, j]
        low, high, along = across_y[k, j], across_y[k, j + 1], across_x[k, j]
        for i in range(nx):
            line[i] = (low[i] + high[i] + along[i] + along[i + 1]) * own[i]
        if j > 0:
            for i in range(nx):
                line[i] -= low[i] * p[k, j - 1, i]
        if j < ny - 1:
            for i in range(nx):
                line[i] -= high[i] * p[k, j + 1, i]
        for i in range(1, nx):
            line[i] -= along[i] * own[i - 1]
        for i in range(nx - 1):
            line[i] -= along[i + 1] * own[i + 1]
