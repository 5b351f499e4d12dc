"""Factors of the matrix of a flat body, by nested dissection.

A layer is much wider than deep, so its matrix is that of a sheet. A row of nodes cuts it in two
halves that share no entry, and each half is cut again (George 1973). From the smallest parts up,
each *front* eliminates its ``pivots``, the nodes of a cut or of an uncut part, and changes the
entries among its ``border``, the nodes next to them that come later (the multifrontal method of
Duff and Reid 1983). Fronts are dense, so that nearly all work is products of matrices.

Pivots are sought within blocks of a few nodes only. Where that is not good enough the solution is
not finite, or has a residual, and Newton's method sees it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from optical_palpation.parallel import in_parallel
from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Parts of at most so many nodes are not divided further.
_SMALL = 16
#: Cuts above the subtrees that threads take one by one.
_SUBTREES = 3
#: Unknowns up to which a block is inverted entry by entry.
_ENTRIES = 32
#: Right-hand sides that are solved for together.
_TOGETHER = 32


class Fronts(NamedTuple):
    """The fronts in the order of elimination, children before their parents.

    Attributes
    ----------
    order, rank
        Nodes as they are eliminated, (n), and when each of them is.
    pivots
        ``order[pivots[f] : pivots[f + 1]]`` are the pivots of front f.
    border, borders
        ``border[borders[f] : borders[f + 1]]`` are the ranks of its border, ascending.
    children, families
        ``children[families[f] : families[f + 1]]`` are the fronts whose parent it is.
    factors
        Where its factors begin.
    updates
        Where the change of its border is kept until its parent takes it.
    subtrees
        First front, front after the last, and entries of the stack of each subtree.
    shared
        Entries of the changes that subtrees leave, and fronts above them.
    """

    order: Numbers
    rank: Numbers
    pivots: Numbers
    border: Numbers
    borders: Numbers
    children: Numbers
    families: Numbers
    factors: Numbers
    updates: Numbers
    subtrees: Numbers
    shared: int


@dataclass(frozen=True, eq=False)
class Dissection:
    """How the nodes of a flat body are eliminated.

    Parameters
    ----------
    graph
        Which nodes have entries with which, (n, n); structurally symmetric, without stored zeros.
    positions
        Lateral positions of the nodes, (n, 2).
    """

    graph: sp.csr_matrix
    positions: Array

    @cached_property
    def fronts(self) -> Fronts:
        """The fronts."""
        pivots, parents = _cut(self.graph, self.positions)
        count = len(pivots)
        order = np.concatenate(pivots)
        rank = np.empty_like(order)
        rank[order] = np.arange(order.size)
        ends = np.cumsum([len(nodes) for nodes in pivots])
        families: list[list[int]] = [[] for _ in pivots]
        borders: list[Numbers] = []
        for front, (nodes, end) in enumerate(zip(pivots, ends, strict=True)):
            near = [rank[self.graph[nodes].indices], *(borders[c] for c in families[front])]
            reached = np.unique(np.concatenate(near))
            borders.append(reached[reached >= end])
            if parents[front] >= 0:
                families[parents[front]].append(front)
        p = 3 * np.array([len(nodes) for nodes in pivots])
        b = 3 * np.array([len(nodes) for nodes in borders])
        depth = np.zeros(count, np.intp)
        for front in range(count - 2, -1, -1):
            depth[front] = depth[parents[front]] + 1
        tops = [
            f
            for f in range(count)
            if depth[f] == _SUBTREES or (depth[f] < _SUBTREES and not families[f])
        ]
        updates, subtrees, shared, first = np.zeros(count, np.intp), [], 0, 0
        for front in range(count):
            if depth[front] < _SUBTREES or front in tops:
                updates[front] = shared
                shared += b[front] ** 2
        for root in tops:
            while depth[first] < _SUBTREES and first not in tops:
                first += 1
            top = most = 0
            for front in range(first, root):
                top -= int((b[families[front]] ** 2).sum())
                updates[front] = top
                top += int(b[front]) ** 2
                most = max(most, top)
            subtrees.append((first, root + 1, most))
            first = root + 1
        return Fronts(
            order=order,
            rank=rank,
            pivots=_begins([len(nodes) for nodes in pivots]),
            border=np.concatenate(borders),
            borders=_begins([len(nodes) for nodes in borders]),
            children=np.array([c for family in families for c in family], np.intp),
            families=_begins([len(family) for family in families]),
            factors=_begins(p * p + 2 * p * b),
            updates=updates,
            subtrees=np.array(subtrees, np.intp),
            shared=shared,
        )

    @cached_property
    def operations(self) -> float:
        """Multiplications and additions of one elimination."""
        fronts = self.fronts
        p, b = 3.0 * np.diff(fronts.pivots), 3.0 * np.diff(fronts.borders)
        return float((2 * p * (p + b) ** 2 - 2 * p * p * b).sum())


class Factors:
    """The factors of a matrix with three unknowns, x, y and z, for each node.

    Parameters
    ----------
    matrix
        (3 n, 3 n); entries where the graph of the dissection has none are not allowed.
    dissection
        Of the nodes.
    unknowns
        Numbers of the three unknowns of each node, (n, 3).
    """

    def __init__(self, matrix: sp.csr_matrix, dissection: Dissection, unknowns: Numbers) -> None:
        self._fronts, self._unknowns = dissection.fronts, unknowns
        by_column = matrix.tocsc()
        nodes, components = np.empty(unknowns.size, np.intp), np.empty(unknowns.size, np.intp)
        nodes[unknowns] = np.arange(len(unknowns))[:, None]
        components[unknowns] = np.arange(3)
        self._values = np.empty(self._fronts.factors[-1])
        # small products, of which many threads do one each
        with _libraries().limit(limits=1, user_api="blas"):
            _eliminate(
                (matrix.indptr, matrix.indices, matrix.data),
                (by_column.indptr, by_column.indices, by_column.data),
                (unknowns, nodes, components),
                self._fronts,
                self._values,
            )

    def solve(self, rhs: Array) -> Array:
        """Solutions of right-hand sides, both (3 n, m)."""
        size, count = rhs.shape
        width = min(_TOGETHER, count)
        work = np.zeros((-(-count // width), size, width))
        order = self._unknowns[self._fronts.order].ravel()
        for n, block in enumerate(work):
            part = rhs[order, n * width : (n + 1) * width]
            block[:, : part.shape[1]] = part
        with _libraries().limit(limits=1, user_api="blas"):
            _solve(self._fronts, self._values, work)
        out = np.empty((size, count))
        for n, block in enumerate(work):
            part = out[:, n * width : (n + 1) * width]
            part[order] = block[:, : part.shape[1]]
        return out


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


def _begins(lengths: NDArray | list[int]) -> Numbers:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.intp)


def _cut(graph: sp.csr_matrix, positions: Array) -> tuple[list[Numbers], list[int]]:
    """Cut a body in halves, these in halves, and so on.

    Returns the nodes of the uncut parts and of the cuts, each after the halves that it separates,
    and the number of the cut that separates each from another; -1 of the last.
    """
    pivots: list[Numbers] = []
    parents: list[int] = []
    beyond = np.zeros(len(positions))

    def add(nodes: Numbers, children: tuple[int, ...] = ()) -> int:
        pivots.append(nodes)
        parents.append(-1)
        for child in children:
            parents[child] = len(pivots) - 1
        return len(pivots) - 1

    def part(nodes: Numbers) -> int:
        here = positions[nodes]
        along = here[:, int(np.argmax(np.ptp(here, axis=0)))]
        right = along > np.median(along)
        if nodes.size <= _SMALL or not right.any():
            return add(nodes)
        left = nodes[~right]
        beyond[:] = 0.0
        beyond[nodes[right]] = 1.0
        cut = graph[left] @ beyond > 0
        halves = [left[~cut], nodes[right]]
        return add(left[cut], tuple(part(half) for half in halves if half.size))

    part(np.arange(len(positions)))
    return pivots, parents


# The first product of a process looks for BLAS with Python's lock, which must be free for it.
@nb.njit(cache=True, nogil=True)
def _eliminate(rows, columns, numbers, fronts, values):
    """Eliminate the subtrees, each by one thread, and then what separates them."""
    shared = np.empty(fronts.shared)
    subtrees = fronts.subtrees
    in_parallel(
        _eliminate_subtrees, len(subtrees), (rows, columns, numbers, fronts, values, shared)
    )
    places = np.empty(len(fronts.order), np.intp)
    first = 0
    for n in range(len(subtrees)):
        for front in range(first, subtrees[n, 0]):
            _eliminate_front(front, rows, columns, numbers, fronts, values, shared, shared, places)
        first = subtrees[n, 1]
    for front in range(first, len(fronts.updates)):
        _eliminate_front(front, rows, columns, numbers, fronts, values, shared, shared, places)


@nb.njit(fastmath=True, error_model="numpy")
def _eliminate_subtrees(rows, columns, numbers, fronts, values, shared, begin, end):
    places = np.empty(len(fronts.order), np.intp)
    for n in range(begin, end):
        first, after, most = fronts.subtrees[n]
        stack = np.empty(most)
        for front in range(first, after):
            to = stack if front < after - 1 else shared
            _eliminate_front(front, rows, columns, numbers, fronts, values, stack, to, places)


@nb.njit(fastmath=True, error_model="numpy")
def _eliminate_front(front, rows, columns, numbers, fronts, values, from_, to, places):
    """Replace a front F, of pivots P and border B, by its factors.

    These are P^-1, P^-1 F_PB and F_BP. F_BB - F_BP P^-1 F_PB is left to its parent.
    """
    unknowns, nodes, components = numbers
    begin, end = fronts.pivots[front], fronts.pivots[front + 1]
    border = fronts.border[fronts.borders[front] : fronts.borders[front + 1]]
    pp, pb, bp = _parts(front, fronts, values)
    pp[:] = 0
    pb[:] = 0
    bp[:] = 0
    bb = np.zeros((3 * len(border), 3 * len(border)))
    for n in range(len(border)):
        places[border[n]] = 3 * n
    for n in range(begin, end):
        for c in range(3):
            row = unknowns[fronts.order[n], c]
            here = 3 * (n - begin) + c
            starts, indices, entries = rows
            for m in range(starts[row], starts[row + 1]):
                other = fronts.rank[nodes[indices[m]]]
                component = components[indices[m]]
                if other >= end:
                    pb[here, places[other] + component] += entries[m]
                elif other >= begin:
                    pp[here, 3 * (other - begin) + component] += entries[m]
            starts, indices, entries = columns
            for m in range(starts[row], starts[row + 1]):
                other = fronts.rank[nodes[indices[m]]]
                if other >= end:
                    bp[places[other] + components[indices[m]], here] += entries[m]
    for n in range(fronts.families[front], fronts.families[front + 1]):
        child = fronts.children[n]
        its = fronts.border[fronts.borders[child] : fronts.borders[child + 1]]
        size = 3 * len(its)
        change = from_[fronts.updates[child] : fronts.updates[child] + size * size]
        inside = np.searchsorted(its, end)
        for m in range(inside):
            places[its[m]] = 3 * (its[m] - begin)
        for m in range(len(its)):
            for c in range(3):
                line = change[(3 * m + c) * size : (3 * m + c + 1) * size]
                row = places[its[m]] + c
                if m < inside:
                    _add(line, pp[row], its, places, 0, inside)
                    _add(line, pb[row], its, places, inside, len(its))
                else:
                    _add(line, bp[row], its, places, 0, inside)
                    _add(line, bb[row], its, places, inside, len(its))
    if end > begin:
        _invert(pp)
    if bp.size > 0:
        pb[:] = np.dot(pp, pb)
        bb -= np.dot(bp, pb)
    first = fronts.updates[front]
    to[first : first + bb.size] = bb.ravel()


@nb.njit(fastmath=True, error_model="numpy")
def _add(line, to, nodes, places, begin, end):
    for n in range(begin, end):
        there = places[nodes[n]]
        to[there] += line[3 * n]
        to[there + 1] += line[3 * n + 1]
        to[there + 2] += line[3 * n + 2]


@nb.njit(error_model="numpy")
def _parts(front, fronts, values):
    """The factors of a front: of pivots by pivots, pivots by border, border by pivots."""
    p = 3 * (fronts.pivots[front + 1] - fronts.pivots[front])
    b = 3 * (fronts.borders[front + 1] - fronts.borders[front])
    first = fronts.factors[front]
    second, third = first + p * p, first + p * p + p * b
    return (
        values[first:second].reshape(p, p),
        values[second:third].reshape(p, b),
        values[third : third + p * b].reshape(b, p),
    )


@nb.njit(fastmath=True, error_model="numpy")
def _invert(a):
    """Invert a matrix in place, by halves."""
    n = len(a)
    if n <= _ENTRIES:
        _invert_entries(a)
        return
    half = (n // 2 + 7) // 8 * 8
    first = a[:half, :half].copy()
    _invert(first)
    right, below = a[:half, half:].copy(), a[half:, :half].copy()
    from_right, from_below = np.dot(first, right), np.dot(below, first)
    rest = a[half:, half:] - np.dot(below, from_right)
    _invert(rest)
    mixed = np.dot(rest, from_below)
    a[:half, :half] = first + np.dot(from_right, mixed)
    a[:half, half:] = -np.dot(from_right, rest)
    a[half:, :half] = -mixed
    a[half:, half:] = rest


@nb.njit(fastmath=True, error_model="numpy")
def _invert_entries(a):
    """Invert a small matrix in place (Gauss and Jordan), the largest of a column as pivot."""
    n = len(a)
    taken = np.arange(n)
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        if best != k:
            taken[k], taken[best] = taken[best], taken[k]
            for j in range(n):
                a[k, j], a[best, j] = a[best, j], a[k, j]
        factor = 1 / a[k, k]
        row = a[k]
        row[k] = 1
        for j in range(n):
            row[j] *= factor
        for i in range(n):
            if i != k:
                line = a[i]
                factor = line[k]
                line[k] = 0
                for j in range(n):
                    line[j] -= factor * row[j]
    swapped = a.copy()
    for i in range(n):
        for j in range(n):
            a[i, taken[j]] = swapped[i, j]


@nb.njit(cache=True, nogil=True)
def _solve(fronts, values, work):
    in_parallel(_solve_blocks, len(work), (fronts, values, work))


@nb.njit(fastmath=True, error_model="numpy")
def _solve_blocks(fronts, values, work, begin, end):
    count = len(fronts.updates)
    for n in range(begin, end):
        x = work[n]
        for front in range(count):
            first, after = 3 * fronts.pivots[front], 3 * fronts.pivots[front + 1]
            pp, _, bp = _parts(front, fronts, values)
            if after > first:
                x[first:after] = np.dot(pp, x[first:after])
            if bp.size == 0:
                continue
            change = np.dot(bp, x[first:after])
            border = fronts.border[fronts.borders[front] : fronts.borders[front + 1]]
            for m in range(len(border)):
                for c in range(3):
                    x[3 * border[m] + c] -= change[3 * m + c]
        for front in range(count - 1, -1, -1):
            first, after = 3 * fronts.pivots[front], 3 * fronts.pivots[front + 1]
            _, pb, _ = _parts(front, fronts, values)
            if pb.size == 0:
                continue
            border = fronts.border[fronts.borders[front] : fronts.borders[front + 1]]
            known = np.empty((3 * len(border), x.shape[1]))
            for m in range(len(border)):
                known[3 * m : 3 * m + 3] = x[3 * border[m] : 3 * border[m] + 3]
            x[first:after] -= np.dot(pb, known)
