"""Factors of the matrix of a flat body, by nested dissection.

A layer is much wider than deep, so its matrix is that of a sheet. A row of nodes cuts it in two
halves that share no entry, and each half is cut again (George 1973). From the smallest parts up,
each *front* eliminates its ``pivots``, the nodes of a cut or of an uncut part, and changes the
entries among its ``border``, the nodes next to them that come later (the multifrontal method of
Duff and Reid 1983). Fronts are dense, and their pivots are taken in panels, so that nearly all work
is products of matrices.

Rows are exchanged within a panel only, and seldom. Where that is not good enough the solution is
not finite, or has a residual, and Newton's method sees it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.parallel import in_parallel
from optical_palpation.runtime.kernels import keep_kernels

from .intrinsics import subtract_matrix_product

keep_kernels()

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Parts of at most so many nodes are not divided further.
_SMALL = 16
#: Cuts above the subtrees that threads take one by one.
_SUBTREES = 3
#: Most pivots, unknowns, of a panel.
_PANEL = 32
#: Share of the largest entry of its column in a panel below which a pivot is exchanged. Each row of
#: a stiff matrix has its own largest entry on the diagonal, which is lost with the exchange.
_EXCHANGED = 1e-8
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
        order = np.concatenate(pivots)
        rank = np.empty_like(order)
        rank[order] = np.arange(order.size)
        ends = np.cumsum([len(nodes) for nodes in pivots])
        families: list[list[int]] = [[] for _ in pivots]
        borders: list[Numbers] = []
        for front, (nodes, end) in enumerate(zip(pivots, ends, strict=True)):
            near = [rank[_near(self.graph, nodes)[0]], *(borders[c] for c in families[front])]
            reached = np.unique(np.concatenate(near))
            borders.append(reached[reached >= end])
            if parents[front] >= 0:
                families[parents[front]].append(front)
        p = 3 * np.array([len(nodes) for nodes in pivots])
        b = 3 * np.array([len(nodes) for nodes in borders])
        updates, subtrees, shared = _changes(families, parents, b)
        return Fronts(
            order=order,
            rank=rank,
            pivots=_begins([len(nodes) for nodes in pivots]),
            border=np.concatenate(borders),
            borders=_begins([len(nodes) for nodes in borders]),
            children=np.array([c for family in families for c in family], np.intp),
            families=_begins([len(family) for family in families]),
            factors=_begins(_entries(p, b)),
            updates=updates,
            subtrees=subtrees,
            shared=shared,
        )

    @cached_property
    def operations(self) -> float:
        """Multiplications and additions that one elimination takes at the most."""
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
    dtype
        Of the factors; in single precision they take two thirds of the time.
    """

    def __init__(
        self,
        matrix: sp.csr_matrix,
        dissection: Dissection,
        unknowns: Numbers,
        dtype: type[np.floating] = np.float64,
    ) -> None:
        self._fronts = dissection.fronts
        self._order = unknowns[self._fronts.order].ravel()
        by_column = matrix.tocsc()
        nodes, components = np.empty(unknowns.size, np.intp), np.empty(unknowns.size, np.intp)
        nodes[unknowns] = np.arange(len(unknowns))[:, None]
        components[unknowns] = np.arange(3)
        self._values = np.empty(self._fronts.factors[-1], dtype)
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
        work = np.zeros((-(-count // width), size, width), self._values.dtype)
        for n, block in enumerate(work):
            part = rhs[self._order, n * width : (n + 1) * width]
            block[:, : part.shape[1]] = part
        _solve(self._fronts, self._values, work)
        out = np.empty((size, count))
        for n, block in enumerate(work):
            part = out[:, n * width : (n + 1) * width]
            part[self._order] = block[:, : part.shape[1]]
        return out


def _entries(p: Numbers, b: Numbers) -> Numbers:
    """How many entries the factors of fronts of p pivots and b unknowns of a border have."""
    panels, last = p // _PANEL, p % _PANEL
    beside = p * (p + b) - panels * _PANEL * ((panels + 1) * _PANEL) // 2 - last * p
    within = panels * _PANEL**2 + last**2
    return np.asarray(2 * (beside + within))


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
        near, row = _near(graph, left)
        cut = np.bincount(row, beyond[near], left.size) > 0
        halves = [left[~cut], nodes[right]]
        return add(left[cut], tuple(part(half) for half in halves if half.size))

    part(np.arange(len(positions)))
    return pivots, parents


def _near(graph: sp.csr_matrix, nodes: Numbers) -> tuple[NDArray[np.integer], Numbers]:
    """The nodes that have entries with some, and which of these each of them has its entry with.

    Sparse matrices say the same, but take ten times as long for a few rows.
    """
    begin = graph.indptr[nodes]
    count = graph.indptr[nodes + 1] - begin
    row = np.repeat(np.arange(nodes.size), count)
    skipped = begin - np.cumsum(count) + count
    return graph.indices[np.arange(row.size) + skipped[row]], row


def _changes(
    families: list[list[int]], parents: list[int], border: Numbers
) -> tuple[Numbers, Numbers, int]:
    """Where fronts, whose ``border`` is so many unknowns, leave what their parents take.

    Returns ``updates``, ``subtrees`` and ``shared`` of :class:`Fronts`. Within a subtree changes
    are stacked: a parent's replaces those of its children.
    """
    count, sizes = len(parents), border**2
    depth = np.zeros(count, np.intp)
    for front in range(count - 2, -1, -1):
        depth[front] = depth[parents[front]] + 1
    roots = [
        front
        for front in range(count)
        if depth[front] == _SUBTREES or (depth[front] < _SUBTREES and not families[front])
    ]
    updates, subtrees, shared = np.zeros(count, np.intp), [], 0
    for front in range(count):
        if depth[front] <= _SUBTREES:
            updates[front] = shared
            shared += int(sizes[front])
    for root in roots:
        first = root
        while first > 0 and depth[first - 1] > _SUBTREES:
            first -= 1
        top = most = 0
        for front in range(first, root):
            top -= int(sizes[families[front]].sum())
            updates[front] = top
            top += int(sizes[front])
            most = max(most, top)
        subtrees.append((first, root + 1, most))
    return updates, np.array(subtrees, np.intp), shared


# The first product of a process looks for BLAS with Python's lock, which must be free for it.
@nb.njit(cache=True, nogil=True)
def _eliminate(rows, columns, numbers, fronts, values):
    """Eliminate the subtrees, each by one thread, and then what separates them."""
    shared = np.empty(fronts.shared, values.dtype)
    subtrees = fronts.subtrees
    in_parallel(
        _eliminate_subtrees, len(subtrees), (rows, columns, numbers, fronts, values, shared)
    )
    places = np.empty(len(fronts.order), np.intp)
    front = n = 0
    while front < len(fronts.updates):
        if n < len(subtrees) and front == subtrees[n, 0]:
            front = subtrees[n, 1]
            n += 1
        else:
            _eliminate_front(front, rows, columns, numbers, fronts, values, shared, shared, places)
            front += 1


@nb.njit(fastmath=True, error_model="numpy")
def _eliminate_subtrees(rows, columns, numbers, fronts, values, shared, begin, end):
    places = np.empty(len(fronts.order), np.intp)
    for n in range(begin, end):
        first, after, most = fronts.subtrees[n]
        stack = np.empty(most, values.dtype)
        for front in range(first, after):
            to = stack if front < after - 1 else shared
            _eliminate_front(front, rows, columns, numbers, fronts, values, stack, to, places)


@nb.njit(fastmath=True, error_model="numpy")
def _eliminate_front(front, rows, columns, numbers, fronts, values, from_, to, places):
    """Assemble a front, keep its factors panel by panel, and leave the rest to its parent."""
    unknowns, nodes, components = numbers
    begin, end = fronts.pivots[front], fronts.pivots[front + 1]
    border = fronts.border[fronts.borders[front] : fronts.borders[front + 1]]
    p = 3 * (end - begin)
    size = p + 3 * len(border)
    f = np.zeros((size, size), values.dtype)
    for n in range(begin, end):
        places[n] = 3 * (n - begin)
    for n in range(len(border)):
        places[border[n]] = p + 3 * n
    for n in range(begin, end):
        for c in range(3):
            row = unknowns[fronts.order[n], c]
            here = places[n] + c
            starts, indices, entries = rows
            for m in range(starts[row], starts[row + 1]):
                other = fronts.rank[nodes[indices[m]]]
                if other >= begin:
                    f[here, places[other] + components[indices[m]]] += entries[m]
            starts, indices, entries = columns
            for m in range(starts[row], starts[row + 1]):
                other = fronts.rank[nodes[indices[m]]]
                if other >= end:
                    f[places[other] + components[indices[m]], here] += entries[m]
    for n in range(fronts.families[front], fronts.families[front + 1]):
        child = fronts.children[n]
        its = fronts.border[fronts.borders[child] : fronts.borders[child + 1]]
        width = 3 * len(its)
        change = from_[fronts.updates[child] : fronts.updates[child] + width * width]
        for m in range(len(its)):
            for c in range(3):
                line = change[(3 * m + c) * width : (3 * m + c + 1) * width]
                to_line = f[places[its[m]] + c]
                for k in range(len(its)):
                    there = places[its[k]]
                    to_line[there] += line[3 * k]
                    to_line[there + 1] += line[3 * k + 1]
                    to_line[there + 2] += line[3 * k + 2]
    at = fronts.factors[front]
    for k in range(0, p, _PANEL):
        after = min(k + _PANEL, p)
        lower, upper, right, below, at = _panel(values, at, after - k, size - after)
        inverses = _triangles(_block(f, k, after, k, after))
        _put(lower, 0, inverses[0])
        _put(upper, 0, inverses[1])
        if after < size:
            np.dot(lower, _block(f, k, after, after, size), right)
            np.dot(_block(f, after, size, k, after), upper, below)
            subtract_matrix_product(f[after:, after:], below, right)
    first = fronts.updates[front]
    for row in f[p:, p:]:
        to[first : first + size - p] = row
        first += size - p


@nb.njit(fastmath=True, error_model="numpy")
def _triangles(a):
    """L^-1 P and U^-1 of a small matrix, P a = L U; the matrix is overwritten."""
    n = len(a)
    lower, upper = np.eye(n, n, 0, a.dtype), np.zeros((n, n), a.dtype)
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        if abs(a[k, k]) > _EXCHANGED * abs(a[best, k]):
            best = k
        for matrix in (a, lower):
            for j in range(n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        for i in range(k + 1, n):
            factor = a[i, k] / a[k, k]
            for matrix in (a, lower):
                line, from_ = matrix[i], matrix[k]
                for j in range(n):
                    line[j] -= factor * from_[j]
    for i in range(n - 1, -1, -1):
        line = upper[i]
        line[i] = 1.0
        for k in range(i + 1, n):
            factor, from_ = a[i, k], upper[k]
            for j in range(n):
                line[j] -= factor * from_[j]
        pivot = a[i, i]
        for j in range(n):
            line[j] /= pivot
    return lower, upper


@nb.njit(error_model="numpy")
def _panel(values, at, pivots, others):
    """The parts of a panel, and where the next one begins."""
    square, beside = pivots * pivots, pivots * others
    ends = at + square, at + 2 * square, at + 2 * square + beside, at + 2 * (square + beside)
    return (
        values[at : ends[0]].reshape(pivots, pivots),
        values[ends[0] : ends[1]].reshape(pivots, pivots),
        values[ends[1] : ends[2]].reshape(pivots, others),
        values[ends[2] : ends[3]].reshape(others, pivots),
        ends[3],
    )


@nb.njit(cache=True, nogil=True)
def _solve(fronts, values, work):
    in_parallel(_solve_blocks, len(work), (fronts, values, work))


@nb.njit(fastmath=True, error_model="numpy")
def _solve_blocks(fronts, values, work, begin, end):
    count = len(fronts.updates)
    for n in range(begin, end):
        x = work[n]
        for front in range(count):
            _forwards(front, fronts, values, x)
        for front in range(count - 1, -1, -1):
            _backwards(front, fronts, values, x)


@nb.njit(fastmath=True, error_model="numpy")
def _gathered(front, fronts, x):
    """The rows of pivots and border of a front, and how many of them are pivots."""
    begin, end = fronts.pivots[front], fronts.pivots[front + 1]
    border = fronts.border[fronts.borders[front] : fronts.borders[front + 1]]
    p = 3 * (end - begin)
    own = np.empty((p + 3 * len(border), x.shape[1]), x.dtype)
    _put(own, 0, x[3 * begin : 3 * end])
    for n in range(len(border)):
        _put(own, p + 3 * n, x[3 * border[n] : 3 * border[n] + 3])
    return own, p


@nb.njit(fastmath=True, error_model="numpy")
def _forwards(front, fronts, values, x):
    own, p = _gathered(front, fronts, x)
    at = fronts.factors[front]
    for k in range(0, p, _PANEL):
        after = min(k + _PANEL, p)
        lower, _, _, below, at = _panel(values, at, after - k, len(own) - after)
        _put(own, k, np.dot(lower, own[k:after]))
        if after < len(own):
            _subtract(own, after, np.dot(below, own[k:after]))
    _put(x, 3 * fronts.pivots[front], own[:p])
    border = fronts.border[fronts.borders[front] : fronts.borders[front + 1]]
    for n in range(len(border)):
        _put(x, 3 * border[n], own[p + 3 * n : p + 3 * n + 3])


@nb.njit(fastmath=True, error_model="numpy")
def _backwards(front, fronts, values, x):
    own, p = _gathered(front, fronts, x)
    at = fronts.factors[front + 1]
    for k in range((p - 1) // _PANEL * _PANEL, -1, -_PANEL):
        after = min(k + _PANEL, p)
        m, others = after - k, len(own) - after
        at -= 2 * m * (m + others)
        _, upper, right, _, _ = _panel(values, at, m, others)
        if others > 0:
            _subtract(own, k, np.dot(right, own[after:]))
        _put(own, k, np.dot(upper, own[k:after]))
    _put(x, 3 * fronts.pivots[front], own[:p])


# Loops, where slices say the same: numba makes half as much code of them.
@nb.njit(fastmath=True, error_model="numpy")
def _block(f, top, bottom, left, right):
    """A copy of a block of a matrix."""
    out = np.empty((bottom - top, right - left), f.dtype)
    for i in range(bottom - top):
        for j in range(right - left):
            out[i, j] = f[top + i, left + j]
    return out


@nb.njit(fastmath=True, error_model="numpy")
def _put(to, first, rows):
    """Put rows into a matrix from the row ``first`` on."""
    for n in range(len(rows)):
        for c in range(rows.shape[1]):
            to[first + n, c] = rows[n, c]


@nb.njit(fastmath=True, error_model="numpy")
def _subtract(from_, first, rows):
    """Subtract rows from those of a matrix from the row ``first`` on."""
    for n in range(len(rows)):
        for c in range(rows.shape[1]):
            from_[first + n, c] -= rows[n, c]
