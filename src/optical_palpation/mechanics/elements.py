"""Element kernels: trilinear displacement, constant pressure (Q1-P0), 2 x 2 x 2 Gauss points.

The layer is a nearly incompressible Mooney-Rivlin solid (section 3 of the paper) in mixed form,

    W(F, p) = C10 (I1bar - 3) + C01 (I2bar - 3) + p (J - 1) - p^2 / (2 K),

with the pressure p (tension positive) an independent unknown of each element. Kernels work on
``LANES`` elements of one grid row at a time, the innermost loops running over the lanes, so that
the compiler turns them into vector instructions. Element rows of equal parity in (z, y) share no
nodes: the four parities are swept one after the other, the rows of each in parallel.

Displacement-like arrays are ``[component, z, y, x]``; tangent stencils ``[z, y, neighbour,
3 * row + column, x]`` with neighbour = 9 (dz + 1) + 3 (dy + 1) + (dx + 1).
"""

from __future__ import annotations

import numba as nb
import numpy as np

LANES = 16
_G = 0.5 / np.sqrt(3.0)


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
GRADIENTS32 = GRADIENTS.astype(np.float32)
_fast = {"nsz", "arcp", "contract", "afn", "reassoc"}


@nb.njit(fastmath=_fast)
def _gather(nodes, u, k, j, i0, nx, ref, cur):
    """Node positions of the lanes' elements relative to the first node of each."""
    for a in range(8):
        kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), a & 1
        for c in range(3):
            for l in range(LANES):
                i = min(i0 + l, nx - 1)
                x = nodes[c, kk, jj, i + di] - nodes[c, k, j, i]
                ref[a, c, l] = x
                cur[a, c, l] = x + (u[c, kk, jj, i + di] - u[c, k, j, i])


@nb.njit(fastmath=_fast)
def _kinematics(dn, ref, cur, grad, b, det_ref, jac):
    """Spatial shape gradients, b = F F^T (xx yy zz yz xz xy), reference determinant and J."""
    for l in range(LANES):
        r00 = r01 = r02 = r10 = r11 = r12 = r20 = r21 = r22 = ref[0, 0, 0] * 0
        c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = ref[0, 0, 0] * 0
        for a in range(8):
            d0, d1, d2 = dn[a, 0], dn[a, 1], dn[a, 2]
            x, y, z = ref[a, 0, l], ref[a, 1, l], ref[a, 2, l]
            r00 += x * d0
            r01 += x * d1
            r02 += x * d2
            r10 += y * d0
            r11 += y * d1
            r12 += y * d2
            r20 += z * d0
            r21 += z * d1
            r22 += z * d2
            x, y, z = cur[a, 0, l], cur[a, 1, l], cur[a, 2, l]
            c00 += x * d0
            c01 += x * d1
            c02 += x * d2
            c10 += y * d0
            c11 += y * d1
            c12 += y * d2
            c20 += z * d0
            c21 += z * d1
            c22 += z * d2
        # inverse of the reference Jacobian
        i00 = r11 * r22 - r12 * r21
        i10 = r12 * r20 - r10 * r22
        i20 = r10 * r21 - r11 * r20
        det = r00 * i00 + r01 * i10 + r02 * i20
        s = 1 / det
        i00 *= s
        i10 *= s
        i20 *= s
        i01 = (r02 * r21 - r01 * r22) * s
        i11 = (r00 * r22 - r02 * r20) * s
        i21 = (r01 * r20 - r00 * r21) * s
        i02 = (r01 * r12 - r02 * r11) * s
        i12 = (r02 * r10 - r00 * r12) * s
        i22 = (r00 * r11 - r01 * r10) * s
        f00 = c00 * i00 + c01 * i10 + c02 * i20
        f01 = c00 * i01 + c01 * i11 + c02 * i21
        f02 = c00 * i02 + c01 * i12 + c02 * i22
        f10 = c10 * i00 + c11 * i10 + c12 * i20
        f11 = c10 * i01 + c11 * i11 + c12 * i21
        f12 = c10 * i02 + c11 * i12 + c12 * i22
        f20 = c20 * i00 + c21 * i10 + c22 * i20
        f21 = c20 * i01 + c21 * i11 + c22 * i21
        f22 = c20 * i02 + c21 * i12 + c22 * i22
        b[0, l] = f00 * f00 + f01 * f01 + f02 * f02
        b[1, l] = f10 * f10 + f11 * f11 + f12 * f12
        b[2, l] = f20 * f20 + f21 * f21 + f22 * f22
        b[3, l] = f10 * f20 + f11 * f21 + f12 * f22
        b[4, l] = f00 * f20 + f01 * f21 + f02 * f22
        b[5, l] = f00 * f10 + f01 * f11 + f02 * f12
        # inverse of the current Jacobian
        i00 = c11 * c22 - c12 * c21
        i10 = c12 * c20 - c10 * c22
        i20 = c10 * c21 - c11 * c20
        det_cur = c00 * i00 + c01 * i10 + c02 * i20
        det_ref[l] = det * 0.125
        jac[l] = det_cur / det
        s = 1 / det_cur
        i00 *= s
        i10 *= s
        i20 *= s
        i01 = (c02 * c21 - c01 * c22) * s
        i11 = (c00 * c22 - c02 * c20) * s
        i21 = (c01 * c20 - c00 * c21) * s
        i02 = (c01 * c12 - c02 * c11) * s
        i12 = (c02 * c10 - c00 * c12) * s
        i22 = (c00 * c11 - c01 * c10) * s
        for a in range(8):
            d0, d1, d2 = dn[a, 0], dn[a, 1], dn[a, 2]
            grad[a, 0, l] = d0 * i00 + d1 * i10 + d2 * i20
            grad[a, 1, l] = d0 * i01 + d1 * i11 + d2 * i21
            grad[a, 2, l] = d0 * i02 + d1 * i12 + d2 * i22


@nb.njit(fastmath=_fast)
def _isochoric_stress(b, jac, c10, c01, tau, trace_bar):
    """Isochoric Kirchhoff stress tau (xx yy zz yz xz xy); b becomes b bar = J^(-2/3) b.

    ``trace_bar`` receives the trace of the stress before its deviator is taken, as the tangent
    needs it.
    """
    third = b[0, 0] * 0 + 1 / 3
    for l in range(LANES):
        # inverted elements are found by the caller; here they must only not raise
        trace_bar[l] = max(jac[l], third * 1e-3) ** (-2 * third)
    for l in range(LANES):
        s = trace_bar[l]
        b0, b1, b2 = b[0, l] * s, b[1, l] * s, b[2, l] * s
        b3, b4, b5 = b[3, l] * s, b[4, l] * s, b[5, l] * s
        i1 = b0 + b1 + b2
        q0 = b0 * b0 + b5 * b5 + b4 * b4
        q1 = b5 * b5 + b1 * b1 + b3 * b3
        q2 = b4 * b4 + b3 * b3 + b2 * b2
        q3 = b5 * b4 + b1 * b3 + b3 * b2
        q4 = b0 * b4 + b5 * b3 + b4 * b2
        q5 = b0 * b5 + b5 * b1 + b4 * b3
        t0 = 2 * (c10 * b0 + c01 * (i1 * b0 - q0))
        t1 = 2 * (c10 * b1 + c01 * (i1 * b1 - q1))
        t2 = 2 * (c10 * b2 + c01 * (i1 * b2 - q2))
        trace = t0 + t1 + t2
        mean = trace * third
        tau[0, l] = t0 - mean
        tau[1, l] = t1 - mean
        tau[2, l] = t2 - mean
        tau[3, l] = 2 * (c10 * b3 + c01 * (i1 * b3 - q3))
        tau[4, l] = 2 * (c10 * b4 + c01 * (i1 * b4 - q4))
        tau[5, l] = 2 * (c10 * b5 + c01 * (i1 * b5 - q5))
        trace_bar[l] = trace
        b[0, l], b[1, l], b[2, l] = b0, b1, b2
        b[3, l], b[4, l], b[5, l] = b3, b4, b5


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def internal_force(nodes, u, p, c10, c01, dn, force, volume, volume_ref, min_jacobian):
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
    nz, ny, nx = p.shape
    force[:] = 0
    for colour in range(4):
        k0, j0 = colour >> 1, colour & 1
        nk, nj = (nz - k0 + 1) // 2, (ny - j0 + 1) // 2
        for row in nb.prange(nk * nj):
            k, j = k0 + 2 * (row // nj), j0 + 2 * (row % nj)
            ref = np.empty((8, 3, LANES))
            cur = np.empty((8, 3, LANES))
            grad = np.empty((8, 3, LANES))
            b = np.empty((6, LANES))
            tau = np.empty((6, LANES))
            trace = np.empty(LANES)
            det = np.empty(LANES)
            jac = np.empty(LANES)
            pe = np.empty(LANES)
            fe = np.empty((8, 3, LANES))
            v1 = np.empty(LANES)
            v0 = np.empty(LANES)
            smallest = 1e30
            for i0 in range(0, nx, LANES):
                n = min(LANES, nx - i0)
                _gather(nodes, u, k, j, i0, nx, ref, cur)
                for l in range(LANES):
                    pe[l] = p[k, j, min(i0 + l, nx - 1)]
                    v1[l] = 0
                    v0[l] = 0
                fe[:] = 0
                for g in range(8):
                    _kinematics(dn[g], ref, cur, grad, b, det, jac)
                    _isochoric_stress(b, jac, c10, c01, tau, trace)
                    for l in range(LANES):
                        smallest = min(smallest, jac[l])
                    for l in range(LANES):
                        w = det[l]
                        v0[l] += w
                        v1[l] += w * jac[l]
                        hydrostatic = pe[l] * jac[l]
                        tau[0, l] = (tau[0, l] + hydrostatic) * w
                        tau[1, l] = (tau[1, l] + hydrostatic) * w
                        tau[2, l] = (tau[2, l] + hydrostatic) * w
                        tau[3, l] *= w
                        tau[4, l] *= w
                        tau[5, l] *= w
                    for a in range(8):
                        for l in range(LANES):
                            g0, g1, g2 = grad[a, 0, l], grad[a, 1, l], grad[a, 2, l]
                            fe[a, 0, l] += tau[0, l] * g0 + tau[5, l] * g1 + tau[4, l] * g2
                            fe[a, 1, l] += tau[5, l] * g0 + tau[1, l] * g1 + tau[3, l] * g2
                            fe[a, 2, l] += tau[4, l] * g0 + tau[3, l] * g1 + tau[2, l] * g2
                for l in range(n):
                    volume[k, j, i0 + l] = v1[l]
                    volume_ref[k, j, i0 + l] = v0[l]
                for a in range(8):
                    kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), a & 1
                    for c in range(3):
                        for l in range(n):
                            force[c, kk, jj, i0 + l + di] += fe[a, c, l]
            min_jacobian[k, j] = smallest


@nb.njit(fastmath=_fast)
def _elasticity(b, tau, trace_bar, jac, pe, det, c01, cc):
    """Spatial elasticity tensor times the Gauss weight, 6 x 6 Voigt, from b bar and tau.

    c = P : cbar : P + 2/3 tr(taubar) P - 2/3 (I x tau + tau x I) + p J (I x I - 2 II), with
    cbar = 4 C01 (bbar x bbar - bbar (.) bbar) and P the deviatoric projector.
    """
    third = b[0, 0] * 0 + 1 / 3
    for l in range(LANES):
        w = det[l]
        b0, b1, b2, b3, b4, b5 = b[0, l], b[1, l], b[2, l], b[3, l], b[4, l], b[5, l]
        h = 4 * c01
        half = h * 0.5
        # cbar; an off-diagonal strain e_ij enters as engineering shear 2 e_ij
        m01 = h * (b0 * b1 - b5 * b5)
        m02 = h * (b0 * b2 - b4 * b4)
        m12 = h * (b1 * b2 - b3 * b3)
        m03 = h * (b0 * b3 - b5 * b4)
        m14 = h * (b1 * b4 - b5 * b3)
        m25 = h * (b2 * b5 - b4 * b3)
        m33 = half * (b3 * b3 - b1 * b2)
        m44 = half * (b4 * b4 - b0 * b2)
        m55 = half * (b5 * b5 - b0 * b1)
        m34 = half * (b3 * b4 - b5 * b2)
        m35 = half * (b3 * b5 - b1 * b4)
        m45 = half * (b4 * b5 - b0 * b3)
        # rows of cbar : I, and its full trace (the entries not listed above vanish)
        s0 = m01 + m02
        s1 = m01 + m12
        s2 = m02 + m12
        s3 = m03
        s4 = m14
        s5 = m25
        total = (s0 + s1 + s2) * third * third
        s0 *= third
        s1 *= third
        s2 *= third
        s3 *= third
        s4 *= third
        s5 *= third
        t23 = 2 * third
        t0, t1, t2 = t23 * tau[0, l], t23 * tau[1, l], t23 * tau[2, l]
        t3, t4, t5 = t23 * tau[3, l], t23 * tau[4, l], t23 * tau[5, l]
        shear = t23 * trace_bar[l]
        pj = pe[l] * jac[l]
        diag = total + t23 * shear - pj
        off = total - third * shear + pj
        cc[0, l] = w * (diag - 2 * s0 - 2 * t0)
        cc[1, l] = w * (m01 + off - s0 - s1 - t0 - t1)
        cc[2, l] = w * (m02 + off - s0 - s2 - t0 - t2)
        cc[3, l] = w * (m03 - s3 - t3)
        cc[4, l] = w * (-s4 - t4)
        cc[5, l] = w * (-s5 - t5)
        cc[6, l] = w * (diag - 2 * s1 - 2 * t1)
        cc[7, l] = w * (m12 + off - s1 - s2 - t1 - t2)
        cc[8, l] = w * (-s3 - t3)
        cc[9, l] = w * (m14 - s4 - t4)
        cc[10, l] = w * (-s5 - t5)
        cc[11, l] = w * (diag - 2 * s2 - 2 * t2)
        cc[12, l] = w * (-s3 - t3)
        cc[13, l] = w * (-s4 - t4)
        cc[14, l] = w * (m25 - s5 - t5)
        cc[15, l] = w * (m33 + 0.5 * shear - pj)
        cc[16, l] = w * m34
        cc[17, l] = w * m35
        cc[18, l] = w * (m44 + 0.5 * shear - pj)
        cc[19, l] = w * m45
        cc[20, l] = w * (m55 + 0.5 * shear - pj)


@nb.njit(fastmath=_fast)
def _add_stiffness(grad, cc, tau, ke):
    """Add one Gauss point to the lower triangle of node blocks, ke[block(a, b <= a), 9, lane]."""
    half = np.empty((6, 3, LANES), cc.dtype)
    geo = np.empty((3, LANES), cc.dtype)
    for b in range(8):
        for l in range(LANES):
            g0, g1, g2 = grad[b, 0, l], grad[b, 1, l], grad[b, 2, l]
            half[0, 0, l] = cc[0, l] * g0 + cc[5, l] * g1 + cc[4, l] * g2
            half[1, 0, l] = cc[1, l] * g0 + cc[10, l] * g1 + cc[9, l] * g2
            half[2, 0, l] = cc[2, l] * g0 + cc[14, l] * g1 + cc[13, l] * g2
            half[3, 0, l] = cc[3, l] * g0 + cc[17, l] * g1 + cc[16, l] * g2
            half[4, 0, l] = cc[4, l] * g0 + cc[19, l] * g1 + cc[18, l] * g2
            half[5, 0, l] = cc[5, l] * g0 + cc[20, l] * g1 + cc[19, l] * g2
            half[0, 1, l] = cc[5, l] * g0 + cc[1, l] * g1 + cc[3, l] * g2
            half[1, 1, l] = cc[10, l] * g0 + cc[6, l] * g1 + cc[8, l] * g2
            half[2, 1, l] = cc[14, l] * g0 + cc[7, l] * g1 + cc[12, l] * g2
            half[3, 1, l] = cc[17, l] * g0 + cc[8, l] * g1 + cc[15, l] * g2
            half[4, 1, l] = cc[19, l] * g0 + cc[9, l] * g1 + cc[16, l] * g2
            half[5, 1, l] = cc[20, l] * g0 + cc[10, l] * g1 + cc[17, l] * g2
            half[0, 2, l] = cc[4, l] * g0 + cc[3, l] * g1 + cc[2, l] * g2
            half[1, 2, l] = cc[9, l] * g0 + cc[8, l] * g1 + cc[7, l] * g2
            half[2, 2, l] = cc[13, l] * g0 + cc[12, l] * g1 + cc[11, l] * g2
            half[3, 2, l] = cc[16, l] * g0 + cc[15, l] * g1 + cc[12, l] * g2
            half[4, 2, l] = cc[18, l] * g0 + cc[16, l] * g1 + cc[13, l] * g2
            half[5, 2, l] = cc[19, l] * g0 + cc[17, l] * g1 + cc[14, l] * g2
            geo[0, l] = tau[0, l] * g0 + tau[5, l] * g1 + tau[4, l] * g2
            geo[1, l] = tau[5, l] * g0 + tau[1, l] * g1 + tau[3, l] * g2
            geo[2, l] = tau[4, l] * g0 + tau[3, l] * g1 + tau[2, l] * g2
        for a in range(b, 8):
            m = a * (a + 1) // 2 + b
            for l in range(LANES):
                g0, g1, g2 = grad[a, 0, l], grad[a, 1, l], grad[a, 2, l]
                g = g0 * geo[0, l] + g1 * geo[1, l] + g2 * geo[2, l]
                ke[m, 0, l] += g0 * half[0, 0, l] + g1 * half[5, 0, l] + g2 * half[4, 0, l] + g
                ke[m, 1, l] += g0 * half[0, 1, l] + g1 * half[5, 1, l] + g2 * half[4, 1, l]
                ke[m, 2, l] += g0 * half[0, 2, l] + g1 * half[5, 2, l] + g2 * half[4, 2, l]
                ke[m, 3, l] += g0 * half[5, 0, l] + g1 * half[1, 0, l] + g2 * half[3, 0, l]
                ke[m, 4, l] += g0 * half[5, 1, l] + g1 * half[1, 1, l] + g2 * half[3, 1, l] + g
                ke[m, 5, l] += g0 * half[5, 2, l] + g1 * half[1, 2, l] + g2 * half[3, 2, l]
                ke[m, 6, l] += g0 * half[4, 0, l] + g1 * half[3, 0, l] + g2 * half[2, 0, l]
                ke[m, 7, l] += g0 * half[4, 1, l] + g1 * half[3, 1, l] + g2 * half[2, 1, l]
                ke[m, 8, l] += g0 * half[4, 2, l] + g1 * half[3, 2, l] + g2 * half[2, 2, l] + g


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def tangent_stencil(nodes, u, p, c10, c01, gamma, dn, stencil, divergence):
    """Tangent stiffness as a 27-point block stencil, with the penalty gamma / V b b^T.

    b = dv/du is the gradient of an element's deformed volume. With gamma equal to the bulk modulus
    this is the tangent with the pressure condensed; with a smaller one it is the
    augmented-Lagrangian displacement block.

    Parameters
    ----------
    dn
        ``GRADIENTS`` or ``GRADIENTS32``: sets the working precision, with that of ``stencil``.
    stencil
        Output, shape (nz + 1, ny + 1, 27, 9, nx + 1).
    divergence
        Output b, shape (nz, ny, 24, nx), entry 3 * node + component.
    """
    nz, ny, nx = p.shape
    dtype = stencil.dtype
    for k in nb.prange(nz + 1):
        stencil[k] = 0
    for colour in range(4):
        k0, j0 = colour >> 1, colour & 1
        nk, nj = (nz - k0 + 1) // 2, (ny - j0 + 1) // 2
        for row in nb.prange(nk * nj):
            k, j = k0 + 2 * (row // nj), j0 + 2 * (row % nj)
            ref = np.empty((8, 3, LANES), dtype)
            cur = np.empty((8, 3, LANES), dtype)
            grad = np.empty((8, 3, LANES), dtype)
            b = np.empty((6, LANES), dtype)
            tau = np.empty((6, LANES), dtype)
            trace = np.empty(LANES, dtype)
            det = np.empty(LANES, dtype)
            jac = np.empty(LANES, dtype)
            pe = np.empty(LANES, dtype)
            cc = np.empty((21, LANES), dtype)
            ke = np.empty((36, 9, LANES), dtype)
            be = np.empty((8, 3, LANES), dtype)
            v0 = np.empty(LANES, dtype)
            material1 = dtype.type(c10)
            material2 = dtype.type(c01)
            for i0 in range(0, nx, LANES):
                n = min(LANES, nx - i0)
                _gather(nodes, u, k, j, i0, nx, ref, cur)
                for l in range(LANES):
                    pe[l] = p[k, j, min(i0 + l, nx - 1)]
                    v0[l] = 0
                ke[:] = 0
                be[:] = 0
                for g in range(8):
                    _kinematics(dn[g], ref, cur, grad, b, det, jac)
                    _isochoric_stress(b, jac, material1, material2, tau, trace)
                    _elasticity(b, tau, trace, jac, pe, det, material2, cc)
                    for l in range(LANES):
                        v0[l] += det[l]
                        pj = pe[l] * jac[l]
                        tau[0, l] = (tau[0, l] + pj) * det[l]
                        tau[1, l] = (tau[1, l] + pj) * det[l]
                        tau[2, l] = (tau[2, l] + pj) * det[l]
                        tau[3, l] *= det[l]
                        tau[4, l] *= det[l]
                        tau[5, l] *= det[l]
                        jac[l] *= det[l]
                    for a in range(8):
                        for c in range(3):
                            for l in range(LANES):
                                be[a, c, l] += grad[a, c, l] * jac[l]
                    _add_stiffness(grad, cc, tau, ke)
                for l in range(LANES):
                    v0[l] = gamma / v0[l]
                for a in range(8):
                    for bb in range(a + 1):
                        m = a * (a + 1) // 2 + bb
                        for c in range(3):
                            for d in range(3):
                                for l in range(LANES):
                                    ke[m, 3 * c + d, l] += v0[l] * be[a, c, l] * be[bb, d, l]
                for a in range(8):
                    for c in range(3):
                        for l in range(n):
                            divergence[k, j, 3 * a + c, i0 + l] = be[a, c, l]
                for a in range(8):
                    az, ay, ax = a >> 2, (a >> 1) & 1, a & 1
                    for bb in range(8):
                        bz, by, bx = bb >> 2, (bb >> 1) & 1, bb & 1
                        neighbour = 9 * (bz - az + 1) + 3 * (by - ay + 1) + (bx - ax + 1)
                        for c in range(3):
                            for d in range(3):
                                if bb <= a:
                                    m, cd = a * (a + 1) // 2 + bb, 3 * c + d
                                else:
                                    m, cd = bb * (bb + 1) // 2 + a, 3 * d + c
                                for l in range(n):
                                    stencil[k + az, j + ay, neighbour, 3 * c + d, i0 + l + ax] += (
                                        ke[m, cd, l]
                                    )


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def element_stress(nodes, u, p, c10, c01, dn, stress):
    """Volume-averaged Cauchy stress of each element, shape (6, nz, ny, nx), kPa.

    Components xx, yy, zz, yz, xz, xy; the average is over the deformed volume.
    """
    nz, ny, nx = p.shape
    for row in nb.prange(nz * ny):
        k, j = row // ny, row % ny
        ref = np.empty((8, 3, LANES))
        cur = np.empty((8, 3, LANES))
        grad = np.empty((8, 3, LANES))
        b = np.empty((6, LANES))
        tau = np.empty((6, LANES))
        trace = np.empty(LANES)
        det = np.empty(LANES)
        jac = np.empty(LANES)
        total = np.empty((6, LANES))
        volume = np.empty(LANES)
        for i0 in range(0, nx, LANES):
            n = min(LANES, nx - i0)
            _gather(nodes, u, k, j, i0, nx, ref, cur)
            total[:] = 0
            volume[:] = 0
            for g in range(8):
                _kinematics(dn[g], ref, cur, grad, b, det, jac)
                _isochoric_stress(b, jac, c10, c01, tau, trace)
                for l in range(LANES):
                    volume[l] += det[l] * jac[l]
                for c in range(6):
                    for l in range(LANES):
                        total[c, l] += tau[c, l] * det[l]
            for c in range(6):
                for l in range(n):
                    hydrostatic = p[k, j, i0 + l] if c < 3 else 0.0
                    stress[c, k, j, i0 + l] = total[c, l] / volume[l] + hydrostatic
