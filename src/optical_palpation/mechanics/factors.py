"""Sparse LU of flat bodies: SuperLU with the unknowns in an order that keeps the factors small.

A layer is much wider than deep, so its matrix is that of a sheet. Nested dissection by the lateral
positions of the nodes suits it far better than the minimum-degree orders that come with SuperLU:
of a stack of 3600 elements the factors have a seventh of the entries.
"""

from __future__ import annotations

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from optical_palpation.parallel import in_parallel
from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Parts of at most so many nodes are not divided further.
_SMALL = 60
#: Right-hand sides that are solved for together.
_TOGETHER = 32


class Factors:
    """LU factors of a matrix with three unknowns, x, y and z, for each node.

    Parameters
    ----------
    matrix
        Unknowns node by node, (3 n, 3 n); structurally symmetric.
    positions
        Lateral positions of the nodes, (n, 2).
    """

    def __init__(self, matrix: sp.csr_matrix, positions: Array) -> None:
        n = len(positions)
        rows = np.repeat(np.arange(3 * n), np.diff(matrix.indptr)) // 3
        graph = sp.csr_matrix((np.ones(matrix.nnz), (rows, matrix.indices // 3)), shape=(n, n))
        order = _dissected(sp.csr_matrix(graph + graph.T), positions, np.arange(n))
        unknowns = (3 * order[:, None] + np.arange(3)).ravel()
        lu = splu(
            matrix[unknowns][:, unknowns].tocsc(),
            permc_spec="NATURAL",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        #: Unknown that is the n-th of the triangular systems, before and after.
        self._first, self._last = np.empty_like(unknowns), unknowns[np.argsort(lu.perm_c)]
        self._first[lu.perm_r] = unknowns
        self._lower, self._upper = (sp.csc_matrix(part) for part in (lu.L, lu.U))
        for part in (self._lower, self._upper):
            part.sort_indices()

    def solve(self, rhs: Array) -> Array:
        """Solutions of right-hand sides, both (3 n, m)."""
        size, count = rhs.shape
        width = min(_TOGETHER, count)
        blocks = -(-count // width)
        work = np.zeros((blocks, size, width))
        for n in range(blocks):
            part = rhs[self._first, n * width : (n + 1) * width]
            work[n, :, : part.shape[1]] = part
        lower, upper = self._lower, self._upper
        _solve(
            (lower.indptr, lower.indices, lower.data),
            (upper.indptr, upper.indices, upper.data),
            work,
        )
        out = np.empty((size, count))
        for n in range(blocks):
            part = out[:, n * width : (n + 1) * width]
            part[self._last] = work[n, :, : part.shape[1]]
        return out


def _dissected(graph: sp.csr_matrix, positions: Array, nodes: Numbers) -> Numbers:
    """Order nodes so that each half of a region comes before the nodes that separate the two."""
    if nodes.size <= _SMALL:
        return nodes
    here = positions[nodes]
    along = here[:, int(np.argmax(np.ptp(here, axis=0)))]
    right = along > np.median(along)
    if not right.any():
        return nodes
    beyond = np.zeros(graph.shape[0])
    beyond[nodes[right]] = 1.0
    left = nodes[~right]
    border = graph[left] @ beyond > 0
    return np.concatenate(
        [
            _dissected(graph, positions, left[~border]),
            _dissected(graph, positions, nodes[right]),
            left[border],
        ]
    )


@nb.njit(cache=True)
def _solve(lower, upper, work):
    in_parallel(_solve_blocks, work.shape[0], (lower, upper, work))


@nb.njit(fastmath=True, error_model="numpy")
def _solve_blocks(lower, upper, work, begin, end):
    for block in range(begin, end):
        b = work[block]
        n, m = b.shape
        starts, rows, values = lower  # ones on the diagonal, which comes first
        for j in range(n):
            for q in range(starts[j] + 1, starts[j + 1]):
                for c in range(m):
                    b[rows[q], c] -= values[q] * b[j, c]
        starts, rows, values = upper  # the diagonal comes last
        for j in range(n - 1, -1, -1):
            last = starts[j + 1] - 1
            for c in range(m):
                b[j, c] /= values[last]
            for q in range(starts[j], last):
                for c in range(m):
                    b[rows[q], c] -= values[q] * b[j, c]
