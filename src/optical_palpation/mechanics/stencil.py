"""Products with 27-point block stencils, and their Galerkin coarsening.

What a product costs is the passage of its stencil through the memory. Its entries are therefore
16-bit integers with one factor for each row of the matrix, and lie in the order in which they are
read: ``L`` nodes of a grid row at a time, all 27 neighbours, 3 * row + column. The diagonal
blocks, whose contact springs and friction may exceed all else, stay apart in single precision.

Vectors carry a halo of zero nodes, one on every side and on the far side of x as many as fill the
lanes: ``[component, z + 2, y + 2, width + 2]``.
"""

# ruff: noqa: E741 -- l is the lane
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.parallel import in_parallel

from .intrinsics import prefetch
from .lanes import FAST, LARGEST, L

#: Nodes below which a grid is left to one thread: to wake others takes longer than they save.
_NODES_OF_ONE_THREAD = 20000
#: Threads that were there before a small grid was left to one.
_allowed = ContextVar("threads", default=1)
#: Entries of one neighbour of the lanes.
_BLOCK = 9 * L
_LARGEST_ENTRY = 32767.0
#: Entries in 64 bytes.
_CACHE_LINE = 32


class Stencil(NamedTuple):
    """The matrix of a grid; entry = ``scale`` of its row x ``entries``, + ``diagonal``.

    Attributes
    ----------
    entries
        [z, y, lanes, 27 x 9 x L], 0 where the neighbour is the node itself.
    scale
        [z, y, row of the block, x], x filled up to whole lanes.
    diagonal
        Block of the node itself, [z, y, 3 * row + column, x], and what all others of its row lost
        by rounding: a displacement that is the same everywhere meets the exact forces, a smooth
        one nearly so.
    """

    entries: NDArray[np.int16]
    scale: NDArray[np.float32]
    diagonal: NDArray[np.float32]


def padded(count: int) -> int:
    """Length of a grid row that fills the lanes."""
    return -(-count // L) * L


def turned(node_shape: tuple[int, ...]) -> bool:
    """Whether a grid is better stored with its axes y and x exchanged.

    Short rows fill their lanes badly: 17 nodes take as long as 32. To exchange the axes costs a
    little, so a tenth must be saved.
    """
    ny1, nx1 = node_shape[-2:]
    return 10 * padded(ny1) * nx1 < 9 * padded(nx1) * ny1


def exchanged(plane: NDArray, nx1: int) -> NDArray:
    """Plane of a tangent, [y, neighbour, 3 * row + column, x], with the axes y and x exchanged."""
    ny1 = len(plane)
    by_neighbour = plane[..., :nx1].reshape(ny1, 3, 3, 3, 9, nx1)
    out = np.zeros((nx1, 3, 3, 3, 9, padded(ny1)), plane.dtype)
    out[..., :ny1] = by_neighbour.transpose(5, 1, 3, 2, 4, 0)
    return out.reshape(nx1, 27, 9, -1)


def empty_stencil(node_shape: tuple[int, int, int]) -> Stencil:
    """Return storage for the stencil of a grid."""
    nz1, ny1, nx1 = node_shape
    lanes = padded(nx1) // L
    return Stencil(
        np.empty((nz1, ny1, lanes, 27 * _BLOCK), np.int16),
        np.empty((nz1, ny1, 3, lanes * L), np.float32),
        np.empty((nz1, ny1, 9, lanes * L), np.float32),
    )


@contextmanager
def threads_for(node_shape: tuple[int, ...]) -> Iterator[None]:
    """Leave small grids to one thread."""
    small = math.prod(node_shape) < _NODES_OF_ONE_THREAD
    if not small or (allowed := nb.get_num_threads()) == 1:
        yield
        return
    given = _allowed.set(max(allowed, _allowed.get()))
    nb.set_num_threads(1)
    try:
        yield
    finally:
        nb.set_num_threads(allowed)
        _allowed.reset(given)


@contextmanager
def all_threads() -> Iterator[None]:
    """Give all threads to long work on a grid that is left to one."""
    before = nb.get_num_threads()
    nb.set_num_threads(max(before, _allowed.get()))
    try:
        yield
    finally:
        nb.set_num_threads(before)


def halo_zeros(node_shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Return a zero vector with its halo."""
    nz1, ny1, nx1 = node_shape
    return np.zeros((3, nz1 + 2, ny1 + 2, padded(nx1) + 2), np.float32)


def interior(vector: NDArray, node_shape: tuple[int, int, int]) -> NDArray:
    """View of a vector without its halo."""
    return vector[:, 1:-1, 1:-1, 1 : node_shape[2] + 1]


def expanded(stencil: Stencil, nx1: int) -> NDArray[np.float32]:
    """All entries of a stencil, [z, y, neighbour, 3 * row + column, x]."""
    nz1, ny1, lanes, _ = stencil.entries.shape
    out = stencil.entries.reshape(nz1, ny1, lanes, 27, 9, L).astype(np.float32)
    out = np.moveaxis(out, 2, 4).reshape(nz1, ny1, 27, 9, lanes * L)
    out *= np.repeat(stencil.scale, 3, axis=2)[:, :, None]
    out[:, :, 13] += stencil.diagonal
    return out[..., :nx1]


@nb.njit(fastmath=FAST, error_model="numpy")
def _row_product(s, q, near):
    """One row of the blocks from entry q with the displacements of the three neighbours in x."""
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = near
    f32 = nb.float32
    return (
        (f32(s[q]) * a0 + f32(s[q + L]) * a1 + f32(s[q + 2 * L]) * a2)
        + (f32(s[q + 9 * L]) * b0 + f32(s[q + 10 * L]) * b1 + f32(s[q + 11 * L]) * b2)
        + (f32(s[q + 18 * L]) * c0 + f32(s[q + 19 * L]) * c1 + f32(s[q + 20 * L]) * c2)
    )


@nb.njit(fastmath=FAST, error_model="numpy")
def _product(stencil, x, k, j, out):
    """out[c, i] = (S x)_c of the nodes i of the row (k, j)."""
    nz1, _, lanes, _ = stencil.entries.shape
    # planes beyond the faces hold nothing but zeros
    first, last = k == 0, k == nz1 - 1
    sums = np.empty(3 * L, np.float32)
    for block in range(lanes):
        i0 = (block * L) & LARGEST
        s = stencil.entries[k, j, block]
        sums[:] = 0
        for m in range(9):
            kk, jj = k + m // 3, j + m % 3
            if (first and m < 3) or (last and m > 5):
                continue
            x0, x1, x2 = x[0, kk, jj], x[1, kk, jj], x[2, kk, jj]
            q = 27 * m * L
            # among so many arrays the processor loses sight of the one that counts
            for ahead in range(q + 27 * _BLOCK, q + 27 * (_BLOCK + L), _CACHE_LINE):
                prefetch(s, ahead)
            for l in range(L):
                i = (i0 + l) & LARGEST
                a0, a1, a2 = x0[i], x1[i], x2[i]
                b0, b1, b2 = x0[i + 1], x1[i + 1], x2[i + 1]
                c0, c1, c2 = x0[i + 2], x1[i + 2], x2[i + 2]
                near = a0, a1, a2, b0, b1, b2, c0, c1, c2
                sums[l] += _row_product(s, q + l, near)
                sums[L + l] += _row_product(s, q + 3 * L + l, near)
                sums[2 * L + l] += _row_product(s, q + 6 * L + l, near)
        for c in range(3):
            for l in range(L):
                out[c, i0 + l] = sums[c * L + l]
    # Loops of few operations become vector instructions only if they run along the whole row and
    # touch few arrays
    x0, x1, x2 = x[0, k + 1, j + 1], x[1, k + 1, j + 1], x[2, k + 1, j + 1]
    for c in range(3):
        line, f = out[c], stencil.scale[k, j, c]
        d0, d1, d2 = (
            stencil.diagonal[k, j, 3 * c],
            stencil.diagonal[k, j, 3 * c + 1],
            stencil.diagonal[k, j, 3 * c + 2],
        )
        for i in range(len(line)):
            line[i] = f[i] * line[i] + (d0[i] * x0[i + 1] + d1[i] * x1[i + 1] + d2[i] * x2[i + 1])


@nb.njit(cache=True)
def subtract_product(stencil, x, b, r):
    """R = b - S x."""
    nz1, ny1 = stencil.scale.shape[:2]
    in_parallel(_subtract_rows, nz1 * ny1, (stencil, x, b, r))


@nb.njit(fastmath=FAST, error_model="numpy")
def _subtract_rows(stencil, x, b, r, begin, end):
    _, ny1, _, width = stencil.scale.shape
    product = np.empty((3, width), np.float32)
    for row in range(begin, end):
        k, j = row // ny1, row % ny1
        _product(stencil, x, k, j, product)
        for c in range(3):
            line, from_, less = r[c, k + 1, j + 1], b[c, k + 1, j + 1], product[c]
            for i in range(width):
                line[i + 1] = from_[i + 1] - less[i]


@nb.njit(cache=True)
def smooth(stencil, inverse, keeps, gains, from_zero, b, r, d, x):
    """Go through smoothing steps on x for the right-hand side b, from x = 0 on if so wished.

    Each is d = keep d + gain D^-1 (b - S x), x = x + d, with D^-1 the ``inverse`` of the block
    diagonal; r is for b - S x. One call does them all: on small grids a call takes longer than what
    it does.
    """
    nz1, ny1 = inverse.shape[:2]
    if from_zero:
        x[:] = 0
    for step in range(len(gains)):
        residual = b
        if step > 0 or not from_zero:
            in_parallel(_subtract_rows, nz1 * ny1, (stencil, x, b, r))
            residual = r
        keep, gain = keeps[step], gains[step]
        in_parallel(_smooth_rows, nz1 * ny1, (inverse, residual, keep, gain, d, x))


@nb.njit(fastmath=FAST, error_model="numpy")
def _smooth_rows(inverse, r, keep, gain, d, x, begin, end):
    _, ny1, _, width = inverse.shape
    change = np.empty(width, np.float32)
    for row in range(begin, end):
        k, j = row // ny1, row % ny1
        r0, r1, r2 = r[0, k + 1, j + 1], r[1, k + 1, j + 1], r[2, k + 1, j + 1]
        for c in range(3):
            line, step = x[c, k + 1, j + 1], d[c, k + 1, j + 1]
            v0, v1, v2 = inverse[k, j, 3 * c], inverse[k, j, 3 * c + 1], inverse[k, j, 3 * c + 2]
            for i in range(width):
                change[i] = gain * (v0[i] * r0[i + 1] + v1[i] * r1[i + 1] + v2[i] * r2[i + 1])
            if keep != 0:  # d may be anything at first
                for i in range(width):
                    change[i] += keep * step[i + 1]
            for i in range(width):
                step[i + 1] = change[i]
                line[i + 1] += change[i]


@nb.njit(cache=True)
def invert_blocks(diagonal, inverse):
    """Invert the diagonal blocks; constrained unknowns (zero diagonal) get zero rows, columns."""
    nz1, ny1 = inverse.shape[:2]
    in_parallel(_invert_rows, nz1 * ny1, (diagonal, inverse))


@nb.njit(error_model="numpy")
def _invert_rows(diagonal, inverse, begin, end):
    _, ny1, _, width = diagonal.shape
    a = np.empty((3, 3))
    for row in range(begin, end):
        k, j = row // ny1, row % ny1
        d, v = diagonal[k, j], inverse[k, j]
        for i in range(width):
            for c in range(9):
                a[c // 3, c % 3] = d[c, i]
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


def store(plane: NDArray[np.floating], stencil: Stencil, k: int) -> None:
    """Round plane k, [y, neighbour, 3 * row + column, x], into a stencil."""
    rounded = np.empty((len(plane), plane.shape[3]), np.int16)
    entries = stencil.entries[k].view(np.int64)
    _store(plane, entries, stencil.scale[k], stencil.diagonal[k], rounded, rounded.view(np.int64))


@nb.njit(cache=True)
def _store(plane, entries, scales, diagonals, rounded, by_four):
    """``entries`` takes them four at a time; ``by_four`` is how ``rounded``, a row, is read so."""
    in_parallel(_store_rows, len(plane), (plane, entries, scales, diagonals, rounded, by_four))


@nb.njit(error_model="numpy")
def _store_rows(plane, entries, scales, diagonals, rounded, by_four, begin, end):
    width = plane.shape[3]
    for j in range(begin, end):
        # Loops run along the whole row: over the lanes alone they would not become vector
        # instructions. Assignments of arrays would take seconds longer to compile.
        row, scale, diagonal = plane[j], scales[j], diagonals[j]
        whole, quarter, target = rounded[j], by_four[j], entries[j]
        factor = np.empty((3, width), np.float32)
        for c in range(3):
            for i in range(width):
                scale[c, i] = 0
        for m in range(27):
            if m != 13:
                for e in range(9):
                    line, largest = row[m, e], scale[e // 3]
                    for i in range(width):
                        size = abs(line[i])
                        largest[i] = size if size > largest[i] else largest[i]
        for c in range(3):
            for i in range(width):
                scale[c, i] *= nb.float32(1 / _LARGEST_ENTRY)
                factor[c, i] = nb.float32(1) / (scale[c, i] + nb.float32(1e-30))
        for e in range(9):
            near, s, f = diagonal[e], scale[e // 3], factor[e // 3]
            for i in range(width):
                near[i] = row[13, e, i]
            for m in range(27):
                line = row[m, e]
                if m == 13:
                    for i in range(width):
                        whole[i] = 0
                else:
                    for i in range(width):
                        value = np.rint(line[i] * f[i])
                        whole[i] = np.int16(value)
                        near[i] += line[i] - s[i] * value
                place = ((m * _BLOCK + e * L) // 4) & LARGEST
                for block in range(width // L):
                    for l in range(L // 4):
                        target[block, place + l] = quarter[block * (L // 4) + l]


def constrain(plane: NDArray[np.floating], free: NDArray[np.bool_], k: int) -> None:
    """Clear rows and columns of unknowns that are not ``free``, [component, z, y, x], in plane k.

    ``plane`` is [y, neighbour, 3 * row + column, x].
    """
    whole = free[:, max(k - 1, 0) : k + 2].all(3)
    if not whole.all():
        _constrain(plane, free, whole, k)


@nb.njit(cache=True)
def _constrain(plane, free, whole, k):
    """``whole`` tells where all of a grid row is free, from the plane below k on."""
    in_parallel(_constrain_rows, len(plane), (plane, free, whole, k))


@nb.njit
def _constrain_rows(plane, free, whole, k, begin, end):
    _, nz1, ny1, nx1 = free.shape
    first = max(k - 1, 0)
    for j in range(begin, end):
        for m in range(27):
            kk, jj, di = k + m // 9 - 1, j + (m // 3) % 3 - 1, m % 3 - 1
            if kk < 0 or kk >= nz1 or jj < 0 or jj >= ny1:
                continue
            for c in range(3):
                for d in range(3):
                    if whole[c, k - first, j] and whole[d, kk - first, jj]:
                        continue
                    here, there, line = free[c, k, j], free[d, kk, jj], plane[j, m, 3 * c + d]
                    for i in range(max(0, -di), min(nx1, nx1 - di)):
                        if not (here[i] and there[i + di]):
                            line[i] = 0


@nb.njit(cache=True)
def prolong_add(coarse, fine, lo_z, w_z, lo_y, w_y, lo_x, w_x):
    """Add the trilinear interpolation of a coarse vector: node n lies between lo and lo + 1."""
    rows = len(lo_z) * len(lo_y)
    in_parallel(_prolong_rows, rows, (coarse, fine, lo_z, w_z, lo_y, w_y, lo_x, w_x))


@nb.njit
def _prolong_rows(coarse, fine, lo_z, w_z, lo_y, w_y, lo_x, w_x, begin, end):
    ny1, nx1 = len(lo_y), len(lo_x)
    line = np.empty(coarse.shape[3], coarse.dtype)
    for row in range(begin, end):
        k, j = row // ny1, row % ny1
        kc, jc = lo_z[k] + 1, lo_y[j] + 1
        wk, wj = w_z[k], w_y[j]
        for c in range(3):
            for i in range(len(line)):
                line[i] = (1 - wk) * (
                    (1 - wj) * coarse[c, kc, jc, i] + wj * coarse[c, kc, jc + 1, i]
                ) + wk * ((1 - wj) * coarse[c, kc + 1, jc, i] + wj * coarse[c, kc + 1, jc + 1, i])
            for i in range(nx1):
                ic = lo_x[i] + 1
                fine[c, k + 1, j + 1, i + 1] += (1 - w_x[i]) * line[ic] + w_x[i] * line[ic + 1]


@nb.njit(cache=True)
def restrict(fine, coarse, first_z, p_z, first_y, p_y, first_x, p_x):
    """Transpose of the interpolation: coarse node N sums fine nodes first[N] + s by p[N, s]."""
    rows = len(first_z) * len(first_y)
    in_parallel(_restrict_rows, rows, (fine, coarse, first_z, p_z, first_y, p_y, first_x, p_x))


@nb.njit
def _restrict_rows(fine, coarse, first_z, p_z, first_y, p_y, first_x, p_x, begin, end):
    my1, mx1 = len(first_y), len(first_x)
    width = fine.shape[3]
    line = np.empty(width, fine.dtype)
    for row in range(begin, end):
        kc, jc = row // my1, row % my1
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


def galerkin(
    fine: Stencil, node_shape: tuple[int, int, int], tables: Sequence[NDArray]
) -> Iterator[NDArray[np.float32]]:
    """Coarse stencil P^T S P, plane by plane.

    Parameters
    ----------
    node_shape
        That of the coarse grid.
    tables
        For each of z, y, x the ``low``, ``first`` and ``table`` of its ``Transfer``.

    Yields
    ------
    NDArray
        [y, neighbour, 3 * row + column, x], rows filled up to whole lanes; each is overwritten when
        the next is made.
    """
    nz1, ny1, nx1 = node_shape
    plane = np.zeros((ny1, 27, 9, padded(nx1)), np.float32)
    for k in range(nz1):
        _galerkin_plane(fine, k, plane, *tables)
        yield plane


@nb.njit(cache=True)
def _galerkin_plane(
    fine, kc, plane, index_z, first_z, p_z, index_y, first_y, p_y, index_x, first_x, p_x
):
    """Plane kc of P^T S P, axis by axis; ``index[n]`` are the two coarse parents of fine node n.

    Weights come from the dense tables p[N, n - first[N]].
    """
    in_parallel(
        _galerkin_rows,
        len(first_y),
        (fine, kc, plane, index_z, first_z, p_z, index_y, first_y, p_y, index_x, first_x, p_x),
    )


@nb.njit(error_model="numpy", fastmath=FAST)
def _galerkin_rows(
    fine, kc, plane, index_z, first_z, p_z, index_y, first_y, p_y, index_x, first_x, p_x, begin, end
):
    mz1, my1, mx1 = len(first_z), len(first_y), len(first_x)
    nz1, ny1, lanes, _ = fine.entries.shape
    nx1 = len(index_x)
    part = np.empty((9, lanes * 3 * _BLOCK), np.float32)
    values, factor = np.empty_like(part), np.empty(3 * _BLOCK, np.float32)
    sums = np.empty((mx1, 3, 9, 9), np.float32)
    for jc in range(begin, end):
        part[:] = 0
        sums[:] = 0
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
                _read_row(fine, k, j, values, factor)
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
                                if w != 0:
                                    source = values[3 * dk + dj]
                                    out = part[3 * (kc2 - kc + 1) + jc2 - jc + 1]
                                    for i in range(len(out)):
                                        out[i] += w * source[i]
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
                            _add_column(part, i, di, w, sums[ic, ic2 - ic + 1])
        for ic in range(mx1):
            for di in range(3):
                for m in range(9):
                    for c in range(9):
                        plane[jc, 3 * m + di, c, ic] = sums[ic, di, m, c]


@nb.njit(fastmath=FAST, error_model="numpy")
def _read_row(stencil, k, j, out, factor):
    """Entries of the nodes (k, j), [3 dz + dy, (lanes, 9 dx + 3 * row + column, L)]."""
    scale, diagonal = stencil.scale[k, j], stencil.diagonal[k, j]
    for block in range(stencil.entries.shape[2]):
        entries, i0 = stencil.entries[k, j, block], block * L
        for e in range(27):
            for l in range(L):
                factor[e * L + l] = scale[(e % 9) // 3, i0 + l]
        begin = (3 * _BLOCK * block) & LARGEST
        for m in range(9):
            target, start = out[m], (3 * _BLOCK * m) & LARGEST
            for l in range(3 * _BLOCK):
                target[begin + l] = factor[l] * nb.float32(entries[start + l])
        target = out[4]
        for e in range(9):
            for l in range(L):
                target[begin + _BLOCK + e * L + l] += diagonal[e, i0 + l]


@nb.njit(fastmath=FAST, error_model="numpy")
def _add_column(part, i, di, weight, out):
    """Add the entries of node i for its neighbour di in x, for all neighbours in z and y."""
    begin = i // L * 3 * _BLOCK + 9 * di * L + i % L
    for m in range(9):
        source = part[m]
        for c in range(9):
            out[m, c] += weight * source[begin + c * L]
