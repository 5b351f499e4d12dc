"""Element kernels: trilinear displacement, constant pressure (Q1-P0), 2 x 2 x 2 Gauss points.

A body is a nearly incompressible hyperelastic solid (section 3 of the paper) in mixed form,

    W(F, p) = s Wbar(I1bar, I2bar) + p (J - 1) - p^2 / (2 s K),

with the pressure p (tension positive) an independent unknown of each element, s its stiffness
factor and Wbar the energy of the law in the invariants of the isochoric deformation. Kernels work
on ``L`` elements of one grid row at a time (``lanes``). Rows of elements that share no nodes are
computed in parallel.

Wherever kernels take ``factor``, it is an array of the stiffness factors, (nz, ny, nx), or
(1, 1, 1) where all elements have the same; ``law`` holds the coefficients of the energy, a tuple
that ``isochoric_stress`` explains. Displacement-like arrays are ``[component, z, y, x]``; the
tangent comes plane by plane of nodes as ``[y, neighbour, 3 * row + column, x]`` with
neighbour = 9 (dz + 1) + 3 (dy + 1) + (dx + 1).
"""

from __future__ import annotations

from collections.abc import Iterator

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.parallel import in_parallel

from .intrinsics import add_lanes
from .lanes import (
    DET,
    FACTOR,
    FAST,
    FE,
    GRAD,
    JAC,
    KE,
    LARGEST,
    PRESSURE,
    ROWS,
    TAU,
    V0,
    V1,
    L,
    add_penalty,
    add_stiffness,
    add_volume_gradient,
    elasticity,
    gather,
    gather_pressure,
    isochoric_stress,
    kinematics,
)
from .stencil import padded

_G = 0.5 / np.sqrt(3.0)
#: Element rows that one thread adds to the tangent in turn.
_STRIP = 3


def _shape_gradients() -> np.ndarray:
    """Derivatives of the 8 shape functions on the unit cube, [gauss, node, xi] (node = 4z+2y+x)."""
    out = np.empty((8, 8, 3))
    for g in range(8):
        point = [0.5 + (_G if (g >> d) & 1 else -_G) for d in range(3)]
        for a in range(8):
            factor = [p if (a >> d) & 1 else 1 - p for d, p in enumerate(point)]
            slope = [1.0 if (a >> d) & 1 else -1.0 for d in range(3)]
            out[g, a, 0] = slope[0] * factor[1] * factor[2]
            out[g, a, 1] = factor[0] * slope[1] * factor[2]
            out[g, a, 2] = factor[0] * factor[1] * slope[2]
    return out


GRADIENTS = _shape_gradients()


def corner_nodes(corner: int, elements: tuple[int, ...]) -> tuple[slice, slice, slice]:
    """Where the nodes are that are a corner, 4 z + 2 y + x, of each of (nz, ny, nx) elements."""
    z, y, x = corner >> 2, (corner >> 1) & 1, corner & 1
    nz, ny, nx = elements
    return slice(z, z + nz), slice(y, y + ny), slice(x, x + nx)


@nb.njit(cache=True)
def internal_force(nodes, u, p, factor, law, dn, force, volume, volume_ref, min_jacobian):
    """Internal nodal force (mN), deformed and reference element volumes (mm^3).

    Parameters
    ----------
    nodes, u
        Reference positions and displacement, shape (3, nz + 1, ny + 1, nx + 1), mm.
    p
        Element pressure, tension positive, shape (nz, ny, nx), kPa.
    dn
        ``GRADIENTS``.
    force, volume, volume_ref
        Outputs, shapes of ``u``, ``p``, ``p``.
    min_jacobian
        Output, shape (nz, ny): smallest J at any Gauss point of each element row.
    """
    nz, ny, _ = p.shape
    force[:] = 0
    for colour in range(4):
        k0, j0 = colour >> 1, colour & 1
        rows = ((nz - k0 + 1) // 2) * ((ny - j0 + 1) // 2)
        in_parallel(
            _force_rows,
            rows,
            (nodes, u, p, factor, law, dn, force, volume, volume_ref, min_jacobian, k0, j0),
        )


@nb.njit(fastmath=FAST, error_model="numpy")
def _force_rows(
    nodes, u, p, factor, law, dn, force, volume, volume_ref, min_jacobian, k0, j0, begin, end
):
    """Every second row of elements of every second layer, from (k0, j0): they share no nodes."""
    _, ny, nx = p.shape
    nj = (ny - j0 + 1) // 2
    for row in range(begin, end):
        k, j = k0 + 2 * (row // nj), j0 + 2 * (row % nj)
        w = np.empty(ROWS * L)
        smallest = 1e30
        for i0 in range(0, nx, L):
            i0 &= LARGEST
            n = min(L, nx - i0)
            gather(nodes, u, k, j, i0, nx, w)
            gather_pressure(p, factor, k, j, i0, w)
            for l in range(L):
                w[V1 + l] = 0
                w[V0 + l] = 0
            w[FE : FE + 24 * L] = 0
            for g in range(8):
                kinematics(dn[g], w)
                isochoric_stress(law, w)
                for l in range(L):
                    smallest = min(smallest, w[JAC + l])
                for l in range(L):
                    weight = w[DET + l]
                    w[V0 + l] += weight
                    w[V1 + l] += weight * w[JAC + l]
                    weight *= w[FACTOR + l]
                    hydrostatic = w[PRESSURE + l] * w[JAC + l]
                    w[TAU + l] = (w[TAU + l] + hydrostatic) * weight
                    w[TAU + L + l] = (w[TAU + L + l] + hydrostatic) * weight
                    w[TAU + 2 * L + l] = (w[TAU + 2 * L + l] + hydrostatic) * weight
                    w[TAU + 3 * L + l] *= weight
                    w[TAU + 4 * L + l] *= weight
                    w[TAU + 5 * L + l] *= weight
                for a in range(8):
                    for l in range(L):
                        g0, g1, g2 = (
                            w[GRAD + 3 * a * L + l],
                            w[GRAD + (3 * a + 1) * L + l],
                            w[GRAD + (3 * a + 2) * L + l],
                        )
                        w[FE + 3 * a * L + l] += (
                            w[TAU + l] * g0 + w[TAU + 5 * L + l] * g1 + w[TAU + 4 * L + l] * g2
                        )
                        w[FE + (3 * a + 1) * L + l] += (
                            w[TAU + 5 * L + l] * g0 + w[TAU + L + l] * g1 + w[TAU + 3 * L + l] * g2
                        )
                        w[FE + (3 * a + 2) * L + l] += (
                            w[TAU + 4 * L + l] * g0
                            + w[TAU + 3 * L + l] * g1
                            + w[TAU + 2 * L + l] * g2
                        )
            for l in range(n):
                volume[k, j, i0 + l] = w[V1 + l]
                volume_ref[k, j, i0 + l] = w[V0 + l]
            for a in range(8):
                kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), a & 1
                for c in range(3):
                    for l in range(n):
                        force[c, kk, jj, i0 + l + di] += w[FE + (3 * a + c) * L + l]
        min_jacobian[k, j] = smallest


@nb.njit(fastmath=FAST, error_model="numpy")
def _tangent_row(nodes, u, p, factor, law, gamma, dn, k, j, w, below, above, divergence):
    """Add one row of elements to the stencils of the node planes below and above it."""
    nx = p.shape[2]
    for i0 in range(0, nx, L):
        i0 &= LARGEST
        n = min(L, nx - i0)
        gather(nodes, u, k, j, i0, nx, w)
        gather_pressure(p, factor, k, j, i0, w)
        for l in range(L):
            w[V0 + l] = 0
        w[KE:] = 0
        w[FE : FE + 24 * L] = 0
        for g in range(8):
            kinematics(dn[g], w)
            isochoric_stress(law, w)
            elasticity(law, w)
            for l in range(L):
                w[V0 + l] += w[DET + l]
                pj = w[PRESSURE + l] * w[JAC + l]
                w[JAC + l] *= w[DET + l]
                weight = w[DET + l] * w[FACTOR + l]
                w[TAU + l] = (w[TAU + l] + pj) * weight
                w[TAU + L + l] = (w[TAU + L + l] + pj) * weight
                w[TAU + 2 * L + l] = (w[TAU + 2 * L + l] + pj) * weight
                w[TAU + 3 * L + l] *= weight
                w[TAU + 4 * L + l] *= weight
                w[TAU + 5 * L + l] *= weight
            add_volume_gradient(w)
            add_stiffness(w)
        add_penalty(gamma, w)
        for a in range(8):
            for c in range(3):
                for l in range(n):
                    divergence[k, j, 3 * a + c, i0 + l] = w[FE + (3 * a + c) * L + l]
        for a in range(8):
            az, ay, ax = a >> 2, (a >> 1) & 1, a & 1
            row = (above if az else below)[j + ay]
            for bb in range(8):
                bz, by, bx = bb >> 2, (bb >> 1) & 1, bb & 1
                blocks = row[9 * (bz - az + 1) + 3 * (by - ay + 1) + (bx - ax + 1)]
                for c in range(3):
                    for d in range(3):
                        entries, node = blocks[3 * c + d], i0 + ax
                        if bb <= a:
                            start = KE + (9 * (8 * a + bb) + 3 * c + d) * L
                        else:
                            start = KE + (9 * (8 * bb + a) + 3 * d + c) * L
                        if n == L:
                            add_lanes(entries, node, w, start)
                        else:
                            for l in range(n):
                                entries[node + l] += w[start + l]


@nb.njit(cache=True)
def _tangent_layer(nodes, u, p, factor, law, gamma, dn, k, below, above, divergence):
    """Add the element layer k to the stencils of the node planes k and k + 1, the latter new."""
    # Strips of element rows, the even ones first: neighbouring strips share a row of nodes.
    strips = (p.shape[1] + _STRIP - 1) // _STRIP
    for odd in range(2):
        in_parallel(
            _tangent_strips,
            (strips + 1 - odd) // 2,
            (nodes, u, p, factor, law, gamma, dn, k, odd, below, above, divergence),
        )


@nb.njit(fastmath=FAST, error_model="numpy")
def _tangent_strips(
    nodes, u, p, factor, law, gamma, dn, k, odd, below, above, divergence, begin, end
):
    ny = p.shape[1]
    for pair in range(begin, end):
        w = np.empty(ROWS * L, below.dtype)
        first = (2 * pair + odd) * _STRIP
        last = min(first + _STRIP, ny)
        for j in range(first + odd, last + 1 if last == ny or odd == 0 else last):
            above[j] = 0
            if k == 0:
                below[j] = 0
        for j in range(first, last):
            _tangent_row(nodes, u, p, factor, law, gamma, dn, k, j, w, below, above, divergence)


def tangent_planes(
    nodes: NDArray[np.float64],
    u: NDArray[np.float64],
    p: NDArray[np.float64],
    factor: NDArray[np.float64],
    law: tuple[float, ...],
    gamma: float,
    divergence: NDArray[np.floating],
) -> Iterator[NDArray[np.floating]]:
    """Tangent stiffness as a 27-point block stencil, with the penalty s gamma / V b b^T.

    b = dv/du is the gradient of an element's deformed volume, s its stiffness factor. With gamma
    equal to the bulk modulus this is the tangent with the pressure condensed; with a smaller one it
    is the augmented-Lagrangian displacement block.

    Parameters
    ----------
    divergence
        Output b, shape (nz, ny, 24, nx), entry 3 * node + component; its precision is that of the
        computation. Complete at the end.

    Yields
    ------
    NDArray
        The stencils of one plane of nodes after the other, [y, neighbour, 3 * row + column, x], x
        filled up with zeros to whole lanes. Each is overwritten when the next but one is made.
    """
    nz1, ny1, nx1 = u.shape[1:]
    real = divergence.dtype.type
    dn = GRADIENTS.astype(real)
    coefficients = tuple(real(c) for c in law)
    shape = (ny1, 27, 9, padded(nx1))
    below, above = np.zeros(shape, divergence.dtype), np.zeros(shape, divergence.dtype)
    for k in range(nz1 - 1):
        _tangent_layer(
            nodes, u, p, factor, coefficients, real(gamma), dn, k, below, above, divergence
        )
        yield below
        below, above = above, below
    yield below


@nb.njit(cache=True)
def element_stress(nodes, u, p, factor, law, dn, stress):
    """Volume-averaged Cauchy stress of each element, shape (6, nz, ny, nx), kPa.

    Components xx, yy, zz, yz, xz, xy; the average is over the deformed volume.
    """
    nz, ny, _ = p.shape
    in_parallel(_stress_rows, nz * ny, (nodes, u, p, factor, law, dn, stress))


@nb.njit(fastmath=FAST, error_model="numpy")
def _stress_rows(nodes, u, p, factor, law, dn, stress, begin, end):
    _, ny, nx = p.shape
    for row in range(begin, end):
        k, j = row // ny, row % ny
        w = np.empty(ROWS * L)
        for i0 in range(0, nx, L):
            i0 &= LARGEST
            n = min(L, nx - i0)
            gather(nodes, u, k, j, i0, nx, w)
            gather_pressure(p, factor, k, j, i0, w)
            w[KE : KE + 6 * L] = 0
            w[V1 : V1 + L] = 0
            for g in range(8):
                kinematics(dn[g], w)
                isochoric_stress(law, w)
                for l in range(L):
                    w[V1 + l] += w[DET + l] * w[JAC + l]
                for c in range(6):
                    for l in range(L):
                        w[KE + c * L + l] += w[TAU + c * L + l] * w[DET + l]
            for c in range(6):
                for l in range(n):
                    hydrostatic = p[k, j, i0 + l] if c < 3 else 0.0
                    isochoric = w[FACTOR + l] * w[KE + c * L + l] / w[V1 + l]
                    stress[c, k, j, i0 + l] = isochoric + hydrostatic
