"""Products with 27-point block stencils, and their Galerkin coarsening.

Vectors carry a halo of one zero node on every side, ``[component, z + 2, y + 2, x + 2]``, so that
products need no branches. Stencils are ``[z, y, neighbour, 3 * row + column, x]``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba as nb
import numpy as np
from numpy.typing import NDArray

#: Nodes that make it worth while to wake one more thread.
_NODES_PER_THREAD = 4000
_fast = {"nsz", "arcp", "contract", "reassoc"}


@contextmanager
def threads_for(node_shape: tuple[int, ...]) -> Iterator[None]:
    """Use no more threads than a grid of this size keeps busy."""
    allowed = nb.get_num_threads()
    nb.set_num_threads(max(1, min(allowed, int(np.prod(node_shape)) // _NODES_PER_THREAD)))
    try:
        yield
    finally:
        nb.set_num_threads(allowed)


def halo_zeros(node_shape: tuple[int, int, int], dtype: type[np.floating]) -> NDArray:
    """Return a zero vector with its halo."""
    return np.zeros((3, *(n + 2 for n in node_shape)), dtype)


def interior(vector: NDArray) -> NDArray:
    """View of a vector without its halo."""
    return vector[:, 1:-1, 1:-1, 1:-1]


@nb.njit(fastmath=_fast)
def _row_product(stencil, x, k, j, out):
    """out[c, i] = (S x) for the row of nodes (k, j)."""
    nx1 = out.shape[1]
    out[:] = 0
    for m in range(9):
        blocks, kk, jj = stencil[k, j, 3 * m : 3 * m + 3], k + m // 3, j + m % 3
        left, middle, right = blocks[0], blocks[1], blocks[2]
        x0, x1, x2 = x[0, kk, jj], x[1, kk, jj], x[2, kk, jj]
        for c in range(3):
            line = out[c]
            a0, a1, a2 = left[3 * c], left[3 * c + 1], left[3 * c + 2]
            b0, b1, b2 = middle[3 * c], middle[3 * c + 1], middle[3 * c + 2]
            c0, c1, c2 = right[3 * c], right[3 * c + 1], right[3 * c + 2]
            for i in range(nx1):
                line[i] += (
                    (a0[i] * x0[i] + a1[i] * x1[i] + a2[i] * x2[i])
                    + (b0[i] * x0[i + 1] + b1[i] * x1[i + 1] + b2[i] * x2[i + 1])
                    + (c0[i] * x0[i + 2] + c1[i] * x1[i + 2] + c2[i] * x2[i + 2])
                )


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def multiply(stencil, x, y):
    """Y = S x."""
    nz1, ny1, _, _, nx1 = stencil.shape
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        line = np.empty((3, nx1), x.dtype)
        _row_product(stencil, x, k, j, line)
        for c in range(3):
            y[c, k + 1, j + 1, 1 : nx1 + 1] = line[c]


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def subtract_product(stencil, x, b, r):
    """R = b - S x."""
    nz1, ny1, _, _, nx1 = stencil.shape
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        line = np.empty((3, nx1), x.dtype)
        _row_product(stencil, x, k, j, line)
        for c in range(3):
            for i in range(nx1):
                r[c, k + 1, j + 1, i + 1] = b[c, k + 1, j + 1, i + 1] - line[c, i]


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def smoothing_direction(stencil, inverse, x, b, d, keep, gain):
    """D = keep d + gain D^-1 (b - S x), D the block diagonal."""
    nz1, ny1, _, _, nx1 = stencil.shape
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        line = np.empty((3, nx1), x.dtype)
        _row_product(stencil, x, k, j, line)
        v = inverse[k, j]
        b0, b1, b2 = b[0, k + 1, j + 1, 1:], b[1, k + 1, j + 1, 1:], b[2, k + 1, j + 1, 1:]
        d0, d1, d2 = d[0, k + 1, j + 1, 1:], d[1, k + 1, j + 1, 1:], d[2, k + 1, j + 1, 1:]
        for i in range(nx1):
            r0, r1, r2 = b0[i] - line[0, i], b1[i] - line[1, i], b2[i] - line[2, i]
            d0[i] = keep * d0[i] + gain * (v[0, i] * r0 + v[1, i] * r1 + v[2, i] * r2)
            d1[i] = keep * d1[i] + gain * (v[3, i] * r0 + v[4, i] * r1 + v[5, i] * r2)
            d2[i] = keep * d2[i] + gain * (v[6, i] * r0 + v[7, i] * r1 + v[8, i] * r2)


@nb.njit(parallel=True, fastmath=_fast, cache=True)
def scale_by_blocks(inverse, b, d, gain):
    """D = gain D^-1 b."""
    nz1, ny1, _, nx1 = inverse.shape
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        v = inverse[k, j]
        b0, b1, b2 = b[0, k + 1, j + 1, 1:], b[1, k + 1, j + 1, 1:], b[2, k + 1, j + 1, 1:]
        for i in range(nx1):
            r0, r1, r2 = b0[i], b1[i], b2[i]
            d[0, k + 1, j + 1, i + 1] = gain * (v[0, i] * r0 + v[1, i] * r1 + v[2, i] * r2)
            d[1, k + 1, j + 1, i + 1] = gain * (v[3, i] * r0 + v[4, i] * r1 + v[5, i] * r2)
            d[2, k + 1, j + 1, i + 1] = gain * (v[6, i] * r0 + v[7, i] * r1 + v[8, i] * r2)


@nb.njit(parallel=True, cache=True)
def invert_blocks(stencil, inverse):
    """Invert the diagonal blocks; constrained unknowns (zero diagonal) get zero rows, columns."""
    nz1, ny1, _, _, nx1 = stencil.shape
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        a = np.empty((3, 3))
        for i in range(nx1):
            for c in range(9):
                a[c // 3, c % 3] = stencil[k, j, 13, c, i]
            fixed = (a[0, 0] == 0, a[1, 1] == 0, a[2, 2] == 0)
            for c in range(3):
                if fixed[c]:
                    a[c, :] = 0
                    a[:, c] = 0
                    a[c, c] = 1
            v00 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
            v10 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
            v20 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
            s = 1 / (a[0, 0] * v00 + a[0, 1] * v10 + a[0, 2] * v20)
            v = inverse[k, j]
            v[0, i] = v00 * s
            v[3, i] = v10 * s
            v[6, i] = v20 * s
            v[1, i] = (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]) * s
            v[4, i] = (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]) * s
            v[7, i] = (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1]) * s
            v[2, i] = (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]) * s
            v[5, i] = (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]) * s
            v[8, i] = (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) * s
            for c in range(3):
                if fixed[c]:
                    v[4 * c, i] = 0


@nb.njit(parallel=True, cache=True)
def constrain(stencil, free):
    """Clear the rows and columns of constrained unknowns (free: [component, z, y, x] bool)."""
    nz1, ny1, _, _, nx1 = stencil.shape
    whole = np.empty((nz1, ny1), np.bool_)
    for row in nb.prange(nz1 * ny1):
        whole[row // ny1, row % ny1] = free[:, row // ny1, row % ny1].all()
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        for m in range(27):
            kk, jj, di = k + m // 9 - 1, j + (m // 3) % 3 - 1, m % 3 - 1
            if kk < 0 or kk >= nz1 or jj < 0 or jj >= ny1 or (whole[k, j] and whole[kk, jj]):
                continue
            for c in range(3):
                for d in range(3):
                    for i in range(max(0, -di), min(nx1, nx1 - di)):
                        if not (free[c, k, j, i] and free[d, kk, jj, i + di]):
                            stencil[k, j, m, 3 * c + d, i] = 0


@nb.njit(parallel=True, cache=True)
def prolong_add(coarse, fine, lo_z, w_z, lo_y, w_y, lo_x, w_x):
    """Add the trilinear interpolation of a coarse vector: node n lies between lo and lo + 1."""
    nz1, ny1, nx1 = len(lo_z), len(lo_y), len(lo_x)
    for row in nb.prange(nz1 * ny1):
        k, j = row // ny1, row % ny1
        kc, jc = lo_z[k] + 1, lo_y[j] + 1
        wk, wj = w_z[k], w_y[j]
        line = np.empty(coarse.shape[3], coarse.dtype)
        for c in range(3):
            for i in range(len(line)):
                line[i] = (1 - wk) * (
                    (1 - wj) * coarse[c, kc, jc, i] + wj * coarse[c, kc, jc + 1, i]
                ) + wk * ((1 - wj) * coarse[c, kc + 1, jc, i] + wj * coarse[c, kc + 1, jc + 1, i])
            for i in range(nx1):
                ic = lo_x[i] + 1
                fine[c, k + 1, j + 1, i + 1] += (1 - w_x[i]) * line[ic] + w_x[i] * line[ic + 1]


@nb.njit(parallel=True, cache=True)
def restrict(fine, coarse, first_z, p_z, first_y, p_y, first_x, p_x):
    """Transpose of the interpolation: coarse node N sums fine nodes first[N] + s by p[N, s]."""
    mz1, my1, mx1 = len(first_z), len(first_y), len(first_x)
    width = fine.shape[3]
    for row in nb.prange(mz1 * my1):
        kc, jc = row // my1, row % my1
        line = np.empty(width, fine.dtype)
        for c in range(3):
            line[:] = 0
            for a in range(p_z.shape[1]):
                for b in range(p_y.shape[1]):
                    w = p_z[kc, a] * p_y[jc, b]
                    if w != 0:
                        source = fine[c, first_z[kc] + a + 1, first_y[jc] + b + 1]
                        for i in range(width):
                            line[i] += w * source[i]
            for ic in range(mx1):
                total = line[0] * 0
                for s in range(p_x.shape[1]):
                    if p_x[ic, s] != 0:
                        total += p_x[ic, s] * line[first_x[ic] + s + 1]
                coarse[c, kc + 1, jc + 1, ic + 1] = total


@nb.njit(parallel=True, cache=True)
def galerkin(fine, coarse, index_z, first_z, p_z, index_y, first_y, p_y, index_x, first_x, p_x):
    """Coarse stencil P^T S P, axis by axis; ``index[n]`` are the two coarse parents of fine node n.

    Weights come from the dense tables p[N, n - first[N]].
    """
    mz1, my1, mx1 = len(first_z), len(first_y), len(first_x)
    nz1, ny1, _, _, nx1 = fine.shape
    for row in nb.prange(mz1 * my1):
        kc, jc = row // my1, row % my1
        part = np.zeros((3, 3, 3, 9, nx1), fine.dtype)
        for a in range(p_z.shape[1]):
            k = first_z[kc] + a
            wk = p_z[kc, a]
            if wk == 0:
                continue
            for b in range(p_y.shape[1]):
                j = first_y[jc] + b
                wj = p_y[jc, b]
                if wj == 0:
                    continue
                for dk in range(3):
                    k2 = k + dk - 1
                    if k2 < 0 or k2 >= nz1:
                        continue
                    for dj in range(3):
                        j2 = j + dj - 1
                        if j2 < 0 or j2 >= ny1:
                            continue
                        for pk in range(2):
                            kc2 = index_z[k2] + pk
                            if kc2 >= mz1 or abs(kc2 - kc) > 1:
                                continue
                            vk = p_z[kc2, k2 - first_z[kc2]]
                            for pj in range(2):
                                jc2 = index_y[j2] + pj
                                if jc2 >= my1 or abs(jc2 - jc) > 1:
                                    continue
                                w = wk * wj * vk * p_y[jc2, j2 - first_y[jc2]]
                                if w == 0:
                                    continue
                                m = 9 * dk + 3 * dj
                                source = fine[k, j, m : m + 3].reshape(-1)
                                out = part[kc2 - kc + 1, jc2 - jc + 1].reshape(-1)
                                for i in range(len(out)):
                                    out[i] += w * source[i]
        for dk in range(3):
            for dj in range(3):
                target = coarse[kc, jc, 9 * dk + 3 * dj : 9 * dk + 3 * dj + 3]
                target[:] = 0
                for ic in range(mx1):
                    for s in range(p_x.shape[1]):
                        wi = p_x[ic, s]
                        if wi == 0:
                            continue
                        i = first_x[ic] + s
                        for di in range(3):
                            i2 = i + di - 1
                            if i2 < 0 or i2 >= nx1:
                                continue
                            for pi in range(2):
                                ic2 = index_x[i2] + pi
                                if ic2 >= mx1 or abs(ic2 - ic) > 1:
                                    continue
                                w = wi * p_x[ic2, i2 - first_x[ic2]]
                                if w != 0:
                                    for c in range(9):
                                        target[ic2 - ic + 1, c, ic] += w * part[dk, dj, di, c, i]
