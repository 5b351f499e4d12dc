"""Deformable bodies on structured grids, each element with a stiffness of its own.

The energy of an element of stiffness factor s is s times that of the layer's solver
(``mechanics.elements``) with an unscaled pressure p,

    W = s (C10 (I1bar - 3) + C01 (I2bar - 3)) + p (J - 1) - p^2 / (2 s K).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.elements import GRADIENTS
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.lanes import (
    DET,
    GRAD,
    JAC,
    KE,
    PRESSURE,
    ROWS,
    TAU,
    add_stiffness,
    elasticity,
    gather,
    isochoric_stress,
    kinematics,
)
from optical_palpation.mechanics.lanes import L as LANES
from optical_palpation.parallel import in_parallel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Body:
    """A hyperelastic body between two surfaces, nearly incompressible, Q1-P0 elements.

    Attributes
    ----------
    grid
        Lateral nodes, depth fractions and thickness of the body.
    top
        z of its face nearest the window, (ny + 1, nx + 1), mm.
    material
        The law of a stiffness factor of 1.
    stiffness
        Factor of each element, (nz, ny, nx).
    """

    grid: LayerGrid
    top: Array
    material: MooneyRivlin
    stiffness: Array

    @cached_property
    def nodes(self) -> Array:
        """Reference node positions, (3, nz + 1, ny + 1, nx + 1), mm."""
        nodes = self.grid.nodes.copy()
        nodes[2] += self.top
        return nodes

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.grid.node_shape))

    @cached_property
    def _neighbours(self) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
        """Which of 27 neighbours a node has, their numbers, and the row starts (in blocks)."""
        shape = self.grid.node_shape
        k, j, i = np.indices(shape)
        m = np.arange(27)
        kk, jj, ii = (
            axis[..., None] + step
            for axis, step in ((k, m // 9 - 1), (j, m // 3 % 3 - 1), (i, m % 3 - 1))
        )
        inside = np.ones(kk.shape, bool)
        for axis, count in zip((kk, jj, ii), shape, strict=True):
            inside &= (axis >= 0) & (axis < count)
        number = (kk * shape[1] + jj) * shape[2] + ii
        starts = np.concatenate([[0], np.cumsum(inside.sum(-1).ravel())])
        return inside, number[inside], starts

    def forces(self, u: Array, p: Array) -> BodyForces:
        """Internal forces and volumes at displacement ``u`` and pressure ``p``."""
        force = np.empty_like(u)
        volume, reference = np.empty(self.grid.shape), np.empty(self.grid.shape)
        jacobian = np.empty(self.grid.shape[:2])
        law = self.material
        _forces(
            self.nodes,
            u,
            p,
            self.stiffness,
            law.c10,
            law.c01,
            GRADIENTS,
            force,
            volume,
            reference,
            jacobian,
        )
        compressed = reference * p / (self.stiffness * law.bulk_modulus)
        return BodyForces(force, volume - reference - compressed, reference, float(jacobian.min()))

    def tangent(self, u: Array, p: Array) -> tuple[sp.bsr_matrix, Array]:
        """Stiffness with the pressure condensed (unknown 3 node + component), and dv/du.

        The latter has shape (nz, ny, 24, nx), entry 3 * node + component.
        """
        nz, ny, nx = self.grid.shape
        stencil = np.zeros((*self.grid.node_shape, 27, 3, 3))
        divergence = np.empty((nz, ny, 24, nx))
        law = self.material
        _tangent(
            self.nodes,
            u,
            p,
            self.stiffness,
            law.c10,
            law.c01,
            law.bulk_modulus,
            GRADIENTS,
            stencil,
            divergence,
        )
        inside, columns, starts = self._neighbours
        size = 3 * self.n_nodes
        matrix = sp.bsr_matrix((stencil[inside], columns, starts), shape=(size, size))
        return matrix, divergence

    def stress(self, u: Array, p: Array) -> Array:
        """Volume-averaged Cauchy stress of the elements, (6, nz, ny, nx), kPa."""
        stress = np.empty((6, *self.grid.shape))
        law = self.material
        _stress(self.nodes, u, p, self.stiffness, law.c10, law.c01, GRADIENTS, stress)
        return stress


@dataclass(frozen=True)
class BodyForces:
    """Internal forces of a body (shape of u, mN), volume residual v - V (1 + p / K), V, min J."""

    force: Array
    volume_residual: Array
    volume: Array
    min_jacobian: float


@nb.njit
def _views(w):
    """Shape gradients, stress, reference determinant and J in the work array of the lanes."""
    grad, tau = w[GRAD : GRAD + 24 * LANES], w[TAU : TAU + 6 * LANES]
    return (
        grad.reshape(8, 3, LANES),
        tau.reshape(6, LANES),
        w[DET : DET + LANES],
        w[JAC : JAC + LANES],
    )


@nb.njit(cache=True)
def _forces(nodes, u, p, stiffness, c10, c01, dn, force, volume, reference, jacobian):
    nz, ny, _ = p.shape
    force[:] = 0
    for colour in range(4):
        k0, j0 = colour >> 1, colour & 1
        rows = ((nz - k0 + 1) // 2) * ((ny - j0 + 1) // 2)
        given = nodes, u, p, stiffness, c10, c01, dn, force, volume, reference, jacobian, k0, j0
        in_parallel(_force_rows, rows, given)


@nb.njit
def _force_rows(
    nodes, u, p, stiffness, c10, c01, dn, force, volume, reference, jacobian, k0, j0, begin, end
):
    """Every second row of elements of every second layer, from (k0, j0): they share no nodes."""
    _, ny, nx = p.shape
    nj = (ny - j0 + 1) // 2
    for row in range(begin, end):
        k, j = k0 + 2 * (row // nj), j0 + 2 * (row % nj)
        w = np.empty(ROWS * LANES)
        grad, tau, det, jac = _views(w)
        smallest = 1e30
        for i0 in range(0, nx, LANES):
            n = min(LANES, nx - i0)
            gather(nodes, u, k, j, i0, nx, w)
            volume[k, j, i0 : i0 + n] = 0
            reference[k, j, i0 : i0 + n] = 0
            for g in range(8):
                kinematics(dn[g], w)
                isochoric_stress(c10, c01, w)
                for i in range(n):
                    e = i0 + i
                    smallest = min(smallest, jac[i])
                    reference[k, j, e] += det[i]
                    volume[k, j, e] += det[i] * jac[i]
                    shear = det[i] * stiffness[k, j, e]
                    hydrostatic = det[i] * jac[i] * p[k, j, e]
                    for c in range(6):
                        tau[c, i] *= shear
                    for c in range(3):
                        tau[c, i] += hydrostatic
                for a in range(8):
                    kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), i0 + (a & 1)
                    for i in range(n):
                        g0, g1, g2 = grad[a, 0, i], grad[a, 1, i], grad[a, 2, i]
                        force[0, kk, jj, di + i] += tau[0, i] * g0 + tau[5, i] * g1 + tau[4, i] * g2
                        force[1, kk, jj, di + i] += tau[5, i] * g0 + tau[1, i] * g1 + tau[3, i] * g2
                        force[2, kk, jj, di + i] += tau[4, i] * g0 + tau[3, i] * g1 + tau[2, i] * g2
        jacobian[k, j] = smallest


@nb.njit(cache=True)
def _tangent(nodes, u, p, stiffness, c10, c01, bulk, dn, stencil, divergence):
    nz, ny, _ = p.shape
    for colour in range(4):
        k0, j0 = colour >> 1, colour & 1
        rows = ((nz - k0 + 1) // 2) * ((ny - j0 + 1) // 2)
        given = nodes, u, p, stiffness, c10, c01, bulk, dn, stencil, divergence, k0, j0
        in_parallel(_tangent_rows, rows, given)


@nb.njit
def _tangent_rows(
    nodes, u, p, stiffness, c10, c01, bulk, dn, stencil, divergence, k0, j0, begin, end
):
    """Every second row of elements of every second layer, from (k0, j0): they share no nodes."""
    _, ny, nx = p.shape
    nj = (ny - j0 + 1) // 2
    for row in range(begin, end):
        k, j = k0 + 2 * (row // nj), j0 + 2 * (row % nj)
        w = np.empty(ROWS * LANES)
        grad, tau, det, jac = _views(w)
        pe, ke = w[PRESSURE : PRESSURE + LANES], w[KE:].reshape(64, 9, LANES)
        factor, v0 = np.empty(LANES), np.empty(LANES)
        be = np.empty((24, LANES))
        for i0 in range(0, nx, LANES):
            n = min(LANES, nx - i0)
            gather(nodes, u, k, j, i0, nx, w)
            for i in range(LANES):
                e = min(i0 + i, nx - 1)
                factor[i] = stiffness[k, j, e]
                pe[i] = p[k, j, e] / factor[i]
            v0[:] = 0
            ke[:] = 0
            be[:] = 0
            for g in range(8):
                kinematics(dn[g], w)
                isochoric_stress(c10, c01, w)
                for a in range(8):
                    for c in range(3):
                        for i in range(LANES):
                            be[3 * a + c, i] += grad[a, c, i] * jac[i] * det[i]
                for i in range(LANES):
                    v0[i] += det[i]
                    det[i] *= factor[i]
                elasticity(c01, w)
                for i in range(LANES):
                    for c in range(3):
                        tau[c, i] += pe[i] * jac[i]
                    for c in range(6):
                        tau[c, i] *= det[i]
                add_stiffness(w)
            for i in range(LANES):
                v0[i] = bulk * factor[i] / v0[i]
            for q in range(24):
                for i in range(n):
                    divergence[k, j, q, i0 + i] = be[q, i]
            for a in range(8):
                kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), i0 + (a & 1)
                for bb in range(8):
                    m = 9 * ((bb >> 2) - (a >> 2) + 1)
                    m += 3 * (((bb >> 1) & 1) - ((a >> 1) & 1) + 1) + (bb & 1) - (a & 1) + 1
                    for c in range(3):
                        for d in range(3):
                            if bb <= a:
                                block, cd = 8 * a + bb, 3 * c + d
                            else:
                                block, cd = 8 * bb + a, 3 * d + c
                            for i in range(n):
                                stencil[kk, jj, di + i, m, c, d] += (
                                    ke[block, cd, i] + v0[i] * be[3 * a + c, i] * be[3 * bb + d, i]
                                )


@nb.njit(cache=True)
def _stress(nodes, u, p, stiffness, c10, c01, dn, stress):
    nz, ny, _ = p.shape
    in_parallel(_stress_rows, nz * ny, (nodes, u, p, stiffness, c10, c01, dn, stress))


@nb.njit
def _stress_rows(nodes, u, p, stiffness, c10, c01, dn, stress, begin, end):
    _, ny, nx = p.shape
    for row in range(begin, end):
        k, j = row // ny, row % ny
        w = np.empty(ROWS * LANES)
        _, tau, det, jac = _views(w)
        volume = np.empty(LANES)
        for i0 in range(0, nx, LANES):
            n = min(LANES, nx - i0)
            gather(nodes, u, k, j, i0, nx, w)
            volume[:] = 0
            stress[:, k, j, i0 : i0 + n] = 0
            for g in range(8):
                kinematics(dn[g], w)
                isochoric_stress(c10, c01, w)
                for i in range(n):
                    volume[i] += det[i] * jac[i]
                    for c in range(6):
                        stress[c, k, j, i0 + i] += tau[c, i] * det[i] * stiffness[k, j, i0 + i]
            for i in range(n):
                for c in range(6):
                    stress[c, k, j, i0 + i] /= volume[i]
                for c in range(3):
                    stress[c, k, j, i0 + i] += p[k, j, i0 + i]
