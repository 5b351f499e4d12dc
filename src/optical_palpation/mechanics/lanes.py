"""Kinematics, stress and stiffness of 16 elements at a time.

The innermost loops run over ``L`` = 16 lanes, elements of one grid row, so that the compiler turns
them into vector instructions. Everything of the lanes lies in one work array ``w``, at fixed
places: of separate arrays the compiler could not know that they do not overlap, and would compute
element by element.
"""

# ruff: noqa: E741 -- l is the lane
from __future__ import annotations

import numba as nb
import numpy as np

L = 16
# Places of the lanes in the work array: node positions (reference, current), shape gradients,
# b = F F^T, stress, scalars, nodal forces or volume gradients, elasticity, its products with a
# gradient, stiffness blocks.
REF, CUR, GRAD, B, TAU = 0, 24 * L, 48 * L, 72 * L, 78 * L
TRACE, DET, JAC, PRESSURE, FACTOR, V0, V1 = (n * L for n in range(84, 91))
FE, CC, HALF, GEO, KE = 91 * L, 115 * L, 136 * L, 154 * L, 157 * L
ROWS = 157 + 64 * 9
# Masking an index with this does not change it and proves to the compiler that it is not negative:
# negative indices count from the end, and testing for them forbids vector instructions.
LARGEST = 0x7FFFFFFF
# Bits from which a third of those of J is taken: J^(-1/3) to 4 %.
_CUBE_ROOT = 0x54A10000
# Division by zero must not raise, or nothing around it becomes a vector instruction.
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}


@nb.njit(fastmath=FAST, error_model="numpy")
def gather(nodes, u, k, j, i0, nx, w):
    """Node positions of the lanes' elements relative to the first node of each."""
    for a in range(8):
        kk, jj, di = k + (a >> 2), j + ((a >> 1) & 1), a & 1
        for c in range(3):
            there, here = nodes[c, kk, jj], nodes[c, k, j]
            moved, origin = u[c, kk, jj], u[c, k, j]
            for l in range(L):
                # lanes beyond the last element repeat it
                i = min(i0 + l, nx - 1) & LARGEST
                x = there[i + di] - here[i]
                w[REF + (3 * a + c) * L + l] = x
                w[CUR + (3 * a + c) * L + l] = x + (moved[i + di] - origin[i])


@nb.njit(fastmath=FAST, error_model="numpy")
def gather_pressure(p, factor, k, j, i0, w):
    """Stiffness factors of the lanes' elements, and the pressures divided by them.

    Of the pressure, too, the element is then a multiple: all of it but the volumes is multiplied by
    the factor. ``factor`` has one entry for each element, or one for all.
    """
    along = factor[min(k, factor.shape[0] - 1), min(j, factor.shape[1] - 1)]
    last, end = p.shape[2] - 1, along.shape[0] - 1
    for l in range(L):
        i = min(i0 + l, last) & LARGEST
        f = along[min(i, end) & LARGEST]
        w[FACTOR + l] = f
        w[PRESSURE + l] = p[k, j, i] / f


@nb.njit(fastmath=FAST, error_model="numpy")
def jacobians(dn, w):
    """Derivatives of reference and current positions, 9 s + 3 c + d that of x_c along d."""
    for s in range(2):
        for c in range(3):
            for d in range(3):
                d0, d1, d2, d3 = dn[0, d], dn[1, d], dn[2, d], dn[3, d]
                d4, d5, d6, d7 = dn[4, d], dn[5, d], dn[6, d], dn[7, d]
                for l in range(L):
                    x = REF + (24 * s + c) * L + l
                    w[HALF + (9 * s + 3 * c + d) * L + l] = (
                        (d0 * w[x] + d1 * w[x + 3 * L])
                        + (d2 * w[x + 6 * L] + d3 * w[x + 9 * L])
                        + (d4 * w[x + 12 * L] + d5 * w[x + 15 * L])
                        + (d6 * w[x + 18 * L] + d7 * w[x + 21 * L])
                    )


@nb.njit(fastmath=FAST, error_model="numpy")
def kinematics(dn, w):
    """Spatial shape gradients, b = F F^T (xx yy zz yz xz xy), reference determinant and J."""
    jacobians(dn, w)
    # of the lanes' precision: whole numbers and literals would make all else double
    one, eighth = w.dtype.type(1), w.dtype.type(0.125)
    for l in range(L):
        r00, r01, r02 = w[HALF + l], w[HALF + L + l], w[HALF + 2 * L + l]
        r10, r11, r12 = w[HALF + 3 * L + l], w[HALF + 4 * L + l], w[HALF + 5 * L + l]
        r20, r21, r22 = w[HALF + 6 * L + l], w[HALF + 7 * L + l], w[HALF + 8 * L + l]
        c00, c01, c02 = w[HALF + 9 * L + l], w[HALF + 10 * L + l], w[HALF + 11 * L + l]
        c10, c11, c12 = w[HALF + 12 * L + l], w[HALF + 13 * L + l], w[HALF + 14 * L + l]
        c20, c21, c22 = w[HALF + 15 * L + l], w[HALF + 16 * L + l], w[HALF + 17 * L + l]
        # inverse of the reference Jacobian
        i00 = r11 * r22 - r12 * r21
        i10 = r12 * r20 - r10 * r22
        i20 = r10 * r21 - r11 * r20
        det = r00 * i00 + r01 * i10 + r02 * i20
        s = one / det
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
        w[B + l] = f00 * f00 + f01 * f01 + f02 * f02
        w[B + L + l] = f10 * f10 + f11 * f11 + f12 * f12
        w[B + 2 * L + l] = f20 * f20 + f21 * f21 + f22 * f22
        w[B + 3 * L + l] = f10 * f20 + f11 * f21 + f12 * f22
        w[B + 4 * L + l] = f00 * f20 + f01 * f21 + f02 * f22
        w[B + 5 * L + l] = f00 * f10 + f01 * f11 + f02 * f12
        # inverse of the current Jacobian
        i00 = c11 * c22 - c12 * c21
        i10 = c12 * c20 - c10 * c22
        i20 = c10 * c21 - c11 * c20
        det_cur = c00 * i00 + c01 * i10 + c02 * i20
        w[DET + l] = det * eighth
        w[JAC + l] = det_cur / det
        s = one / det_cur
        i00 *= s
        i10 *= s
        i20 *= s
        i01 = (c02 * c21 - c01 * c22) * s
        i11 = (c00 * c22 - c02 * c20) * s
        i21 = (c01 * c20 - c00 * c21) * s
        i02 = (c01 * c12 - c02 * c11) * s
        i12 = (c02 * c10 - c00 * c12) * s
        i22 = (c00 * c11 - c01 * c10) * s
        w[HALF + l], w[HALF + L + l], w[HALF + 2 * L + l] = i00, i01, i02
        w[HALF + 3 * L + l], w[HALF + 4 * L + l], w[HALF + 5 * L + l] = i10, i11, i12
        w[HALF + 6 * L + l], w[HALF + 7 * L + l], w[HALF + 8 * L + l] = i20, i21, i22
    for a in range(8):
        d0, d1, d2 = dn[a, 0], dn[a, 1], dn[a, 2]
        for l in range(L):
            h = HALF + l
            w[GRAD + 3 * a * L + l] = d0 * w[h] + d1 * w[h + 3 * L] + d2 * w[h + 6 * L]
            h = HALF + L + l
            w[GRAD + (3 * a + 1) * L + l] = d0 * w[h] + d1 * w[h + 3 * L] + d2 * w[h + 6 * L]
            h = HALF + 2 * L + l
            w[GRAD + (3 * a + 2) * L + l] = d0 * w[h] + d1 * w[h + 3 * L] + d2 * w[h + 6 * L]


@nb.njit(fastmath=FAST, error_model="numpy")
def isochoric_stress(law, w):
    """Isochoric Kirchhoff stress tau (xx yy zz yz xz xy); b becomes b bar = J^(-2/3) b.

    ``law`` holds the coefficients (c10, c20, c30, c01) of the energy
    W = c10 x + c20 x^2 + c30 x^3 + c01 y with x = I1bar - 3 and y = I2bar - 3, so that
    tau is the deviator of 2 (dW/dI1 + I1bar dW/dI2) bbar - 2 dW/dI2 bbar^2. ``TRACE`` receives the
    trace before the deviator is taken, as the tangent needs it.
    """
    real = w.dtype.type
    one, two, three, third = real(1), real(2), real(3), real(1 / 3)
    c10, c20, c30, c01 = law
    linear, quadratic = two * c20, three * c30
    second, cubic = real(2 / 9), real(14 / 81)
    for l in range(L):
        # inverted elements are found by the caller; here they must only not raise
        j = max(w[JAC + l], third * real(1e-3))
        # J^(-1/3), as a power does not become a vector instruction: the bits of a number are nearly
        # its logarithm, of which shifts take a third; then two steps of fourth order
        bits = np.float32(j).view(np.int32)
        part = (bits >> 2) + (bits >> 4) + (bits >> 6) + (bits >> 8) + (bits >> 10) + (bits >> 12)
        y = real(np.int32(_CUBE_ROOT - part).view(np.float32))
        off = one - j * y * y * y
        y += y * off * (third + off * (second + off * cubic))
        off = one - j * y * y * y
        y += y * off * (third + off * (second + off * cubic))
        w[TRACE + l] = y * y
    for l in range(L):
        s = w[TRACE + l]
        b0, b1, b2 = w[B + l] * s, w[B + L + l] * s, w[B + 2 * L + l] * s
        b3, b4, b5 = w[B + 3 * L + l] * s, w[B + 4 * L + l] * s, w[B + 5 * L + l] * s
        i1 = b0 + b1 + b2
        x = i1 - three
        slope = c10 + x * (linear + x * quadratic)
        q0 = b0 * b0 + b5 * b5 + b4 * b4
        q1 = b5 * b5 + b1 * b1 + b3 * b3
        q2 = b4 * b4 + b3 * b3 + b2 * b2
        q3 = b5 * b4 + b1 * b3 + b3 * b2
        q4 = b0 * b4 + b5 * b3 + b4 * b2
        q5 = b0 * b5 + b5 * b1 + b4 * b3
        t0 = two * (slope * b0 + c01 * (i1 * b0 - q0))
        t1 = two * (slope * b1 + c01 * (i1 * b1 - q1))
        t2 = two * (slope * b2 + c01 * (i1 * b2 - q2))
        trace = t0 + t1 + t2
        mean = trace * third
        w[TAU + l] = t0 - mean
        w[TAU + L + l] = t1 - mean
        w[TAU + 2 * L + l] = t2 - mean
        w[TAU + 3 * L + l] = two * (slope * b3 + c01 * (i1 * b3 - q3))
        w[TAU + 4 * L + l] = two * (slope * b4 + c01 * (i1 * b4 - q4))
        w[TAU + 5 * L + l] = two * (slope * b5 + c01 * (i1 * b5 - q5))
        w[TRACE + l] = trace
        w[B + l], w[B + L + l], w[B + 2 * L + l] = b0, b1, b2
        w[B + 3 * L + l], w[B + 4 * L + l], w[B + 5 * L + l] = b3, b4, b5


@nb.njit(fastmath=FAST, error_model="numpy")
def elasticity(law, w):
    """Spatial elasticity tensor times Gauss weight and factor, 6 x 6 Voigt, from b bar and tau.

    c = P : cbar : P + 2/3 tr(taubar) P - 2/3 (I x tau + tau x I) + p J (I x I - 2 II), with
    cbar = 4 dW/dI2 (bbar x bbar - bbar (.) bbar) + 4 d2W/dI1^2 bbar x bbar and P the deviatoric
    projector.
    """
    real = w.dtype.type
    _, c20, c30, c01 = law
    two, four, third, inhalf = real(2), real(4), real(1 / 3), real(0.5)
    for l in range(L):
        weight = w[DET + l] * w[FACTOR + l]
        b0, b1, b2, b3, b4, b5 = (
            w[B + l],
            w[B + L + l],
            w[B + 2 * L + l],
            w[B + 3 * L + l],
            w[B + 4 * L + l],
            w[B + 5 * L + l],
        )
        h = four * c01
        half = inhalf * h
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
        t23 = two * third
        t0, t1, t2 = t23 * w[TAU + l], t23 * w[TAU + L + l], t23 * w[TAU + 2 * L + l]
        t3, t4, t5 = t23 * w[TAU + 3 * L + l], t23 * w[TAU + 4 * L + l], t23 * w[TAU + 5 * L + l]
        shear = t23 * w[TRACE + l]
        pj = w[PRESSURE + l] * w[JAC + l]
        diag = total + t23 * shear - pj
        off = total - third * shear + pj
        w[CC + l] = weight * (diag - two * s0 - two * t0)
        w[CC + L + l] = weight * (m01 + off - s0 - s1 - t0 - t1)
        w[CC + 2 * L + l] = weight * (m02 + off - s0 - s2 - t0 - t2)
        w[CC + 3 * L + l] = weight * (m03 - s3 - t3)
        w[CC + 4 * L + l] = weight * (-s4 - t4)
        w[CC + 5 * L + l] = weight * (-s5 - t5)
        w[CC + 6 * L + l] = weight * (diag - two * s1 - two * t1)
        w[CC + 7 * L + l] = weight * (m12 + off - s1 - s2 - t1 - t2)
        w[CC + 8 * L + l] = weight * (-s3 - t3)
        w[CC + 9 * L + l] = weight * (m14 - s4 - t4)
        w[CC + 10 * L + l] = weight * (-s5 - t5)
        w[CC + 11 * L + l] = weight * (diag - two * s2 - two * t2)
        w[CC + 12 * L + l] = weight * (-s3 - t3)
        w[CC + 13 * L + l] = weight * (-s4 - t4)
        w[CC + 14 * L + l] = weight * (m25 - s5 - t5)
        w[CC + 15 * L + l] = weight * (m33 + inhalf * shear - pj)
        w[CC + 16 * L + l] = weight * m34
        w[CC + 17 * L + l] = weight * m35
        w[CC + 18 * L + l] = weight * (m44 + inhalf * shear - pj)
        w[CC + 19 * L + l] = weight * m45
        w[CC + 20 * L + l] = weight * (m55 + inhalf * shear - pj)
    if c20 != 0 or c30 != 0:
        add_curvature(c20, c30, w)


@nb.njit(fastmath=FAST, error_model="numpy")
def add_curvature(c20, c30, w):
    """Add 4 d2W/dI1^2 dev bbar x dev bbar to the elasticity tensor."""
    real = w.dtype.type
    three, third, eight, slope = real(3), real(1 / 3), real(8) * c20, real(24) * c30
    for l in range(L):
        b0, b1, b2 = w[B + l], w[B + L + l], w[B + 2 * L + l]
        d3, d4, d5 = w[B + 3 * L + l], w[B + 4 * L + l], w[B + 5 * L + l]
        i1 = b0 + b1 + b2
        mean = i1 * third
        d0, d1, d2 = b0 - mean, b1 - mean, b2 - mean
        s = w[DET + l] * w[FACTOR + l] * (eight + slope * (i1 - three))
        s0, s1, s2, s3, s4, s5 = s * d0, s * d1, s * d2, s * d3, s * d4, s * d5
        w[CC + l] += s0 * d0
        w[CC + L + l] += s0 * d1
        w[CC + 2 * L + l] += s0 * d2
        w[CC + 3 * L + l] += s0 * d3
        w[CC + 4 * L + l] += s0 * d4
        w[CC + 5 * L + l] += s0 * d5
        w[CC + 6 * L + l] += s1 * d1
        w[CC + 7 * L + l] += s1 * d2
        w[CC + 8 * L + l] += s1 * d3
        w[CC + 9 * L + l] += s1 * d4
        w[CC + 10 * L + l] += s1 * d5
        w[CC + 11 * L + l] += s2 * d2
        w[CC + 12 * L + l] += s2 * d3
        w[CC + 13 * L + l] += s2 * d4
        w[CC + 14 * L + l] += s2 * d5
        w[CC + 15 * L + l] += s3 * d3
        w[CC + 16 * L + l] += s3 * d4
        w[CC + 17 * L + l] += s3 * d5
        w[CC + 18 * L + l] += s4 * d4
        w[CC + 19 * L + l] += s4 * d5
        w[CC + 20 * L + l] += s5 * d5


@nb.njit(fastmath=FAST, error_model="numpy")
def add_stiffness(w):
    """Add one Gauss point to the node blocks 8 a + b <= a of the lower triangle."""
    for b in range(8):
        for l in range(L):
            g0, g1, g2 = (
                w[GRAD + 3 * b * L + l],
                w[GRAD + (3 * b + 1) * L + l],
                w[GRAD + (3 * b + 2) * L + l],
            )
            w[HALF + l] = w[CC + l] * g0 + w[CC + 5 * L + l] * g1 + w[CC + 4 * L + l] * g2
            w[HALF + 3 * L + l] = (
                w[CC + L + l] * g0 + w[CC + 10 * L + l] * g1 + w[CC + 9 * L + l] * g2
            )
            w[HALF + 6 * L + l] = (
                w[CC + 2 * L + l] * g0 + w[CC + 14 * L + l] * g1 + w[CC + 13 * L + l] * g2
            )
            w[HALF + 9 * L + l] = (
                w[CC + 3 * L + l] * g0 + w[CC + 17 * L + l] * g1 + w[CC + 16 * L + l] * g2
            )
            w[HALF + 12 * L + l] = (
                w[CC + 4 * L + l] * g0 + w[CC + 19 * L + l] * g1 + w[CC + 18 * L + l] * g2
            )
            w[HALF + 15 * L + l] = (
                w[CC + 5 * L + l] * g0 + w[CC + 20 * L + l] * g1 + w[CC + 19 * L + l] * g2
            )
            w[HALF + L + l] = w[CC + 5 * L + l] * g0 + w[CC + L + l] * g1 + w[CC + 3 * L + l] * g2
            w[HALF + 4 * L + l] = (
                w[CC + 10 * L + l] * g0 + w[CC + 6 * L + l] * g1 + w[CC + 8 * L + l] * g2
            )
            w[HALF + 7 * L + l] = (
                w[CC + 14 * L + l] * g0 + w[CC + 7 * L + l] * g1 + w[CC + 12 * L + l] * g2
            )
            w[HALF + 10 * L + l] = (
                w[CC + 17 * L + l] * g0 + w[CC + 8 * L + l] * g1 + w[CC + 15 * L + l] * g2
            )
            w[HALF + 13 * L + l] = (
                w[CC + 19 * L + l] * g0 + w[CC + 9 * L + l] * g1 + w[CC + 16 * L + l] * g2
            )
            w[HALF + 16 * L + l] = (
                w[CC + 20 * L + l] * g0 + w[CC + 10 * L + l] * g1 + w[CC + 17 * L + l] * g2
            )
            w[HALF + 2 * L + l] = (
                w[CC + 4 * L + l] * g0 + w[CC + 3 * L + l] * g1 + w[CC + 2 * L + l] * g2
            )
            w[HALF + 5 * L + l] = (
                w[CC + 9 * L + l] * g0 + w[CC + 8 * L + l] * g1 + w[CC + 7 * L + l] * g2
            )
            w[HALF + 8 * L + l] = (
                w[CC + 13 * L + l] * g0 + w[CC + 12 * L + l] * g1 + w[CC + 11 * L + l] * g2
            )
            w[HALF + 11 * L + l] = (
                w[CC + 16 * L + l] * g0 + w[CC + 15 * L + l] * g1 + w[CC + 12 * L + l] * g2
            )
            w[HALF + 14 * L + l] = (
                w[CC + 18 * L + l] * g0 + w[CC + 16 * L + l] * g1 + w[CC + 13 * L + l] * g2
            )
            w[HALF + 17 * L + l] = (
                w[CC + 19 * L + l] * g0 + w[CC + 17 * L + l] * g1 + w[CC + 14 * L + l] * g2
            )
            w[GEO + l] = w[TAU + l] * g0 + w[TAU + 5 * L + l] * g1 + w[TAU + 4 * L + l] * g2
            w[GEO + L + l] = w[TAU + 5 * L + l] * g0 + w[TAU + L + l] * g1 + w[TAU + 3 * L + l] * g2
            w[GEO + 2 * L + l] = (
                w[TAU + 4 * L + l] * g0 + w[TAU + 3 * L + l] * g1 + w[TAU + 2 * L + l] * g2
            )
        for a in range(b, 8):
            m = 8 * a + b
            for l in range(L):
                g0, g1, g2 = (
                    w[GRAD + 3 * a * L + l],
                    w[GRAD + (3 * a + 1) * L + l],
                    w[GRAD + (3 * a + 2) * L + l],
                )
                g = g0 * w[GEO + l] + g1 * w[GEO + L + l] + g2 * w[GEO + 2 * L + l]
                w[KE + (9 * m + 0) * L + l] += (
                    g0 * w[HALF + l] + g1 * w[HALF + 15 * L + l] + g2 * w[HALF + 12 * L + l] + g
                )
                w[KE + (9 * m + 1) * L + l] += (
                    g0 * w[HALF + L + l] + g1 * w[HALF + 16 * L + l] + g2 * w[HALF + 13 * L + l]
                )
                w[KE + (9 * m + 2) * L + l] += (
                    g0 * w[HALF + 2 * L + l] + g1 * w[HALF + 17 * L + l] + g2 * w[HALF + 14 * L + l]
                )
                w[KE + (9 * m + 3) * L + l] += (
                    g0 * w[HALF + 15 * L + l] + g1 * w[HALF + 3 * L + l] + g2 * w[HALF + 9 * L + l]
                )
                w[KE + (9 * m + 4) * L + l] += (
                    g0 * w[HALF + 16 * L + l]
                    + g1 * w[HALF + 4 * L + l]
                    + g2 * w[HALF + 10 * L + l]
                    + g
                )
                w[KE + (9 * m + 5) * L + l] += (
                    g0 * w[HALF + 17 * L + l] + g1 * w[HALF + 5 * L + l] + g2 * w[HALF + 11 * L + l]
                )
                w[KE + (9 * m + 6) * L + l] += (
                    g0 * w[HALF + 12 * L + l] + g1 * w[HALF + 9 * L + l] + g2 * w[HALF + 6 * L + l]
                )
                w[KE + (9 * m + 7) * L + l] += (
                    g0 * w[HALF + 13 * L + l] + g1 * w[HALF + 10 * L + l] + g2 * w[HALF + 7 * L + l]
                )
                w[KE + (9 * m + 8) * L + l] += (
                    g0 * w[HALF + 14 * L + l]
                    + g1 * w[HALF + 11 * L + l]
                    + g2 * w[HALF + 8 * L + l]
                    + g
                )


@nb.njit(fastmath=FAST, error_model="numpy")
def add_volume_gradient(w):
    """Add one Gauss point to the gradient of the elements' volumes; J holds its weight, too."""
    # two nodes at a time: of shorter loops the compiler makes single operations
    for a in range(4):
        for l in range(L):
            j = w[JAC + l]
            w[FE + 3 * a * L + l] += w[GRAD + 3 * a * L + l] * j
            w[FE + (3 * a + 1) * L + l] += w[GRAD + (3 * a + 1) * L + l] * j
            w[FE + (3 * a + 2) * L + l] += w[GRAD + (3 * a + 2) * L + l] * j
            w[FE + (3 * a + 12) * L + l] += w[GRAD + (3 * a + 12) * L + l] * j
            w[FE + (3 * a + 13) * L + l] += w[GRAD + (3 * a + 13) * L + l] * j
            w[FE + (3 * a + 14) * L + l] += w[GRAD + (3 * a + 14) * L + l] * j


@nb.njit(fastmath=FAST, error_model="numpy")
def add_penalty(penalty, w):
    """Add s penalty / V times the volume gradient twice to the node blocks 8 a + b <= a.

    s is the stiffness factor.
    """
    for b in range(8):
        for l in range(L):
            s = penalty * w[FACTOR + l] / w[V0 + l]
            w[HALF + l] = s * w[FE + 3 * b * L + l]
            w[HALF + L + l] = s * w[FE + (3 * b + 1) * L + l]
            w[HALF + 2 * L + l] = s * w[FE + (3 * b + 2) * L + l]
        for a in range(b, 8):
            m = 8 * a + b
            for l in range(L):
                f0, f1, f2 = (
                    w[FE + 3 * a * L + l],
                    w[FE + (3 * a + 1) * L + l],
                    w[FE + (3 * a + 2) * L + l],
                )
                h0, h1, h2 = w[HALF + l], w[HALF + L + l], w[HALF + 2 * L + l]
                w[KE + (9 * m + 0) * L + l] += f0 * h0
                w[KE + (9 * m + 1) * L + l] += f0 * h1
                w[KE + (9 * m + 2) * L + l] += f0 * h2
                w[KE + (9 * m + 3) * L + l] += f1 * h0
                w[KE + (9 * m + 4) * L + l] += f1 * h1
                w[KE + (9 * m + 5) * L + l] += f1 * h2
                w[KE + (9 * m + 6) * L + l] += f2 * h0
                w[KE + (9 * m + 7) * L + l] += f2 * h1
                w[KE + (9 * m + 8) * L + l] += f2 * h2
