"""The reference linear solver: exact, of displacement and pressure."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from .elements import corner_nodes
from .factors import Dissection, Factors
from .problem import LayerProblem
from .stencil import all_threads
from .system import NewtonSystem, RightHandSide, with_prescribed

Vector = NDArray[np.floating]
Array = NDArray[np.float64]

#: Corrections of a displacement by factors in single precision end where another one would change
#: no more than this share of it, and no more than this share of the forces is out of balance.
_EXACT, _BALANCED = 1e-4, 1e-6
#: Most of a correction that the next one may be: where they shrink more slowly, double precision is
#: cheaper.
_SHRINK = 0.25
#: Most systems that are solved in double precision before single precision is tried again.
_LONGEST = 64


class DirectSolver:
    """Solve Newton systems exactly, or so nearly that Newton's method takes the same steps.

    Memory grows faster than the number of elements; meant for small grids and as the reference.
    """

    dtype: ClassVar[type[np.floating]] = np.float64

    def __init__(self, node_shape: tuple[int, int, int], penalty: float) -> None:
        nz1, ny1, nx1 = self._node_shape = node_shape
        #: Penalty of the displacement block; the solution is the same for all. The bulk modulus
        #: condenses the pressure, unless sides are curved.
        self.gamma = penalty
        #: [z, y, neighbour, 3 * row + column, x].
        self.stencil = np.empty((nz1, ny1, 27, 9, nx1))
        #: Systems still to be solved in double precision, and how many after the next failure.
        self._pause, self._next_pause = 0, 1

    @property
    def work(self) -> float:
        """Multiplications and additions that a solution takes for each node, about."""
        return dissection(self._node_shape).operations / math.prod(self._node_shape)

    def store(self, k: int, plane: Vector) -> None:
        """Take plane k of the displacement block."""
        self.stencil[k] = plane[..., : self.stencil.shape[-1]]

    def prepare(self, system: NewtonSystem) -> None:
        """Take a system whose planes have all been stored."""
        self.system = system

    def solve(
        self, rhs: RightHandSide, tolerance: float, limit: int | None = None
    ) -> tuple[Vector, Vector, int]:
        """Return the step (du in contact coordinates, dp) and 1, the number of solves.

        ``tolerance`` and ``limit`` are not used.
        """
        system = self.system
        matrix = sparse_matrix(system.stencil, system.free)
        if system.flow is None and system.gamma == system.bulk_modulus:  # dp follows from du
            u: Vector = self._displacement(matrix, rhs.displacement.astype(float).ravel())
            u = u.reshape(rhs.displacement.shape)
            p: Vector = system.bulk_modulus / system.volume * (system.volume_change(u) - rhs.volume)
            return with_prescribed(u, rhs.prescribed), p, 1
        out, into = _pressure_blocks(system)
        compression = _compression(system)
        share = sp.diags_array(system.gamma / system.volume.ravel()) @ compression
        out = out @ (sp.eye_array(system.volume.size) - share)
        whole = sp.csr_matrix(sp.block_array([[matrix, out], [into, -compression]]))
        lu = splu(whole.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        both = lu.solve(np.concatenate([rhs.displacement.ravel(), rhs.volume.ravel()]))
        u = both[: system.free.size].reshape(system.free.shape)
        p = both[system.free.size :].reshape(system.volume.shape)
        return with_prescribed(u, rhs.prescribed), p, 1

    def _displacement(self, matrix: sp.csr_matrix, forces: Array) -> Array:
        """Solve for a displacement in single precision, with corrections, or else in double.

        Single precision fails for several systems in a row: each failure doubles the number of
        systems that follow in double precision.
        """
        if self._pause == 0:
            with all_threads():
                factors = factors_of(matrix, self._node_shape, np.float32)
            u = _corrected(matrix, factors, forces)
            if u is not None:
                self._next_pause = 1
                return u
            del factors
            self._pause, self._next_pause = self._next_pause, min(2 * self._next_pause, _LONGEST)
        self._pause -= 1
        with all_threads():
            factors = factors_of(matrix, self._node_shape)
        return factors.solve(forces[:, None])[:, 0]


def _corrected(matrix: sp.csr_matrix, factors: Factors, forces: Array) -> Array | None:
    """Solve a system by factors in single precision; None where corrections do not converge."""
    u, left = np.zeros_like(forces), forces
    last = math.inf
    while scale := float(np.abs(left).max()):
        # scaled, so that no force is too small or too large for single precision
        correction = scale * factors.solve(left[:, None] / scale)[:, 0]
        size = float(np.linalg.norm(correction))
        if not size < _SHRINK * last:
            return None
        u += correction
        left = forces - matrix @ u
        remains = size * size / last if last < math.inf else size
        balanced = np.linalg.norm(left) <= _BALANCED * np.linalg.norm(forces)
        if balanced and remains <= _EXACT * np.linalg.norm(u):
            break
        last = size
    return u


def direct_solver(problem: LayerProblem) -> DirectSolver:
    """Return an exact solver for a problem."""
    penalty = problem.shear_modulus if problem.curved_sides else problem.bulk_modulus
    return DirectSolver(problem.grid.node_shape, penalty)


@lru_cache(maxsize=64)
def dissection(node_shape: tuple[int, int, int]) -> Dissection:
    """How the nodes of a grid (nz + 1, ny + 1, nx + 1) are eliminated."""
    near = [sp.diags([1.0, 1.0, 1.0], [-1, 0, 1], shape=(n, n)) for n in node_shape]
    graph = sp.csr_matrix(sp.kron(near[0], sp.kron(near[1], near[2])))
    graph.eliminate_zeros()
    lateral = np.indices(node_shape)[1:].reshape(2, -1).T.astype(float)
    return Dissection(graph, lateral)


def factors_of(
    matrix: sp.csr_matrix,
    node_shape: tuple[int, int, int],
    dtype: type[np.floating] = np.float64,
) -> Factors:
    """Factors of a matrix of the displacement, (3, nz + 1, ny + 1, nx + 1), on a grid of nodes."""
    unknowns = np.arange(matrix.shape[0]).reshape(3, -1).T
    return Factors(matrix, dissection(node_shape), unknowns, dtype)


def _pressure_blocks(system: NewtonSystem) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """B and B^T in contact coordinates, of the free unknowns."""
    shape, cells = system.free.shape[1:], system.volume.shape
    node = np.arange(system.free.size).reshape(system.free.shape)
    element = np.arange(system.volume.size).reshape(cells)
    rows, columns, values = [], [], []
    for a in range(8):
        at = corner_nodes(a, cells)
        for c in range(3):
            rows.append(node[c][at].ravel())
            columns.append(element.ravel())
            values.append(system.divergence[:, :, 3 * a + c].ravel())
    size = node.size, element.size
    b = sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=size
    )
    # the lateral equations of both faces take in the vertical ones, and the vertical displacement
    # of the sample's face the lateral ones
    rows_of = columns_of = sp.eye_array(node.size)
    for face, k in ((0, 0), (1, shape[0] - 1)):
        for c in range(2):
            here = node[c, k].ravel(), node[2, k].ravel()
            row = system.friction.row[face, c].ravel()
            rows_of = rows_of + sp.csr_matrix((row, here), (size[0],) * 2)
            if face == 1:
                slope = system.contact.column[face, c].ravel()
                columns_of = columns_of + sp.csr_matrix((slope, here[::-1]), (size[0],) * 2)
    free = sp.diags_array(system.free.ravel().astype(float))
    return sp.csr_matrix(free @ rows_of @ b), sp.csr_matrix(b.T @ columns_of @ free)


def _compression(system: NewtonSystem) -> sp.csr_matrix:
    """C: volume by which pressures compress the elements."""
    matrix = sp.diags_array((system.volume / system.bulk_modulus).ravel())
    if system.flow is None:
        return sp.csr_matrix(matrix)
    element = np.arange(system.volume.size).reshape(system.volume.shape)
    y, x = system.flow.y, system.flow.x
    own = y[:, 1:] + y[:, :-1] + x[:, :, 1:] + x[:, :, :-1]
    matrix = matrix + sp.diags_array(own.ravel())
    for beside, here, there in (
        (y[:, 1:-1], element[:, 1:], element[:, :-1]),
        (x[:, :, 1:-1], element[:, :, 1:], element[:, :, :-1]),
    ):
        pairs = np.concatenate([here.ravel(), there.ravel()])
        others = np.concatenate([there.ravel(), here.ravel()])
        matrix = matrix - sp.csr_matrix((np.tile(beside.ravel(), 2), (pairs, others)), matrix.shape)
    return sp.csr_matrix(matrix)


def sparse_matrix(stencil: Vector, free: NDArray[np.bool_]) -> sp.csr_matrix:
    """Matrix of a constrained block stencil, with a unit-like diagonal where it is constrained.

    Entries that the stencil has as zero are stored.
    """
    pattern = _pattern(free.shape[1:])
    flat = free.ravel()
    entries = stencil.reshape(-1)[pattern.source].astype(float)
    scale = np.abs(entries[pattern.diagonal]).mean() or 1.0
    entries[pattern.diagonal[~flat]] += scale
    return sp.csr_matrix((entries, pattern.columns, pattern.begins), shape=(flat.size, flat.size))


class _Pattern(NamedTuple):
    """All entries that lie inside a grid, row by row, each from left to right.

    ``source`` are their positions in the stencil, ``diagonal`` says which are on the diagonal, row
    n begins at ``begins[n]``.
    """

    columns: NDArray[np.int32]
    begins: NDArray[np.int32]
    source: NDArray[np.intp]
    diagonal: NDArray[np.intp]


@lru_cache(maxsize=64)
def _pattern(node_shape: tuple[int, int, int]) -> _Pattern:
    """Entries of the matrix of a grid of so many nodes."""
    nz1, ny1, nx1 = node_shape
    k, j, i = np.indices(node_shape, np.int32).reshape(3, -1, 1)
    m = np.arange(27, dtype=np.int32)
    kk, jj, ii = k + m // 9 - 1, j + (m // 3) % 3 - 1, i + m % 3 - 1
    inside = (kk >= 0) & (kk < nz1) & (jj >= 0) & (jj < ny1) & (ii >= 0) & (ii < nx1)
    nodes, near = len(inside), inside.sum(1)
    # A row has the neighbours in their order, once for each component d of theirs.
    component = np.arange(3, dtype=np.int32)[:, None]
    each = np.broadcast_to(inside[:, None], (nodes, 3, 27))
    there = (component * nodes + ((kk * ny1 + jj) * nx1 + ii)[:, None])[each]
    start = ((k * ny1 + j) * 27 + m).astype(np.intp)[:, None] * 9 + component
    source = [((start + 3 * c) * nx1 + i[:, None])[each] for c in range(3)]
    begins = np.concatenate([[0], np.cumsum(np.tile(3 * near, 3))])
    before = np.concatenate([c * near + inside[:, :13].sum(1) for c in range(3)])
    return _Pattern(
        np.tile(there, 3),
        begins.astype(np.int32),
        np.concatenate(source),
        begins[:-1] + before,
    )
