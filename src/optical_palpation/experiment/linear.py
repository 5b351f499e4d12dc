"""Sparse direct solution of the coupled system, with factors kept for as long as they serve."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres, splu

from optical_palpation.mechanics.direct import pardiso

Array = NDArray[np.float64]

#: Relative residual to which a system is solved with old factors, and the iterations it may take.
_TOLERANCE, _PATIENCE = 1e-3, 20
#: Relative residual to which one is solved with its own, and the refinements it may take.
_EXACT, _REFINEMENTS = 1e-8, 5


class LinearSolver:
    """Solves one Newton system after the other; MKL PARDISO where it is installed, else SuperLU.

    Factors are of single precision, which halves their time and memory, and solutions are refined;
    where that does not make them exact the factors are of double precision. The factors of one
    system precondition GMRES on the next ones. Use as a context manager.
    """

    def __init__(self) -> None:
        self._places: NDArray[np.intp] = np.empty(0, np.intp)
        self._factors: _Pardiso | _SuperLU | None = None
        self.factorisations = 0

    def __enter__(self) -> LinearSolver:
        return self

    def __exit__(self, *_: object) -> None:
        self._release()

    def solve(self, blocks: sp.bsr_matrix, rhs: Array, similar: bool = False) -> Array:
        """Solve one system; ``similar`` ones are tried with the factors of the last."""
        matrix = self._widened(blocks)
        if similar and self._factors is not None:
            operator = LinearOperator(matrix.shape, matvec=self._factors.solve, dtype=float)
            start = np.linalg.norm(rhs)
            solution, failed = gmres(
                matrix, rhs, M=operator, rtol=_TOLERANCE, restart=_PATIENCE, maxiter=1
            )
            if not failed and np.linalg.norm(matrix @ solution - rhs) < 2 * _TOLERANCE * start:
                return solution
        solution, exact = self._refined(matrix, rhs, np.float32)
        if not exact:
            solution, _ = self._refined(matrix, rhs, np.float64)
        return solution

    def _widened(self, blocks: sp.bsr_matrix) -> sp.csr_matrix:
        """Matrix with a place for every block met so far, so that its pattern seldom changes."""
        n = blocks.indptr.size - 1
        blocks.sort_indices()
        places = np.repeat(n * np.arange(n), np.diff(blocks.indptr)) + blocks.indices
        if not np.isin(places, self._places, assume_unique=True).all():
            self._places = np.union1d(self._places, places)
        data = np.zeros((self._places.size, *blocks.data.shape[1:]))
        data[np.searchsorted(self._places, places)] = blocks.data
        starts = np.searchsorted(self._places, n * np.arange(n + 1))
        return sp.bsr_matrix((data, self._places % n, starts), shape=blocks.shape).tocsr()

    def _refined(
        self, matrix: sp.csr_matrix, rhs: Array, precision: type[np.floating]
    ) -> tuple[Array, bool]:
        """Return the solution by factors of a precision, and whether it is exact."""
        self.factorisations += 1
        if not (self._factors and self._factors.renew(matrix, precision)):
            self._release()
            try:
                self._factors = _Pardiso(matrix, precision)
            except ImportError:
                self._factors = _SuperLU(matrix, precision)
        solution, left = np.zeros_like(rhs), rhs
        for _ in range(1 + _REFINEMENTS):
            solution = solution + self._factors.solve(left)
            left = rhs - matrix @ solution
            if np.linalg.norm(left) <= _EXACT * np.linalg.norm(rhs):
                return solution, True
        return solution, False

    def _release(self) -> None:
        if self._factors:
            self._factors.release()
        self._factors = None


class _Pardiso:
    """Factors by MKL PARDISO; matrices of equal pattern share the analysis of the first."""

    def __init__(self, matrix: sp.csr_matrix, precision: type[np.floating]) -> None:
        self._solver = pardiso(mtype=11)
        self._precision = precision
        # no scaling and matching, which a matrix with a strong diagonal does without
        single = int(precision is np.float32)
        for number, value in ((1, 1), (2, 2), (10, 13), (11, 0), (13, 0), (8, 0), (28, single)):
            self._solver.set_iparm(number, value)
        self._load(matrix)
        self._call(12, np.zeros(matrix.shape[0]))

    def renew(self, matrix: sp.csr_matrix, precision: type[np.floating]) -> bool:
        """Factorise another matrix of the same pattern; return whether it is one."""
        same = precision is self._precision and (
            np.array_equal(matrix.indptr, self._matrix.indptr)
            and np.array_equal(matrix.indices, self._matrix.indices)
        )
        if same:
            self._load(matrix)
            self._call(22, np.zeros(matrix.shape[0]))
        return same

    def solve(self, rhs: Array) -> Array:
        return self._call(33, rhs)

    def release(self) -> None:
        self._solver.free_memory(everything=True)

    def _load(self, matrix: sp.csr_matrix) -> None:
        self._matrix = matrix.astype(self._precision)

    def _call(self, phase: int, rhs: Array) -> Array:
        self._solver.set_phase(phase)
        scaled = np.ascontiguousarray(rhs.ravel(), self._precision)
        return self._solver._call_pardiso(self._matrix, scaled).astype(float)


class _SuperLU:
    """Factors by SuperLU."""

    def __init__(self, matrix: sp.csr_matrix, precision: type[np.floating]) -> None:
        self._precision = precision
        self._factors = splu(
            matrix.tocsc().astype(precision),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
        )

    def renew(self, matrix: sp.csr_matrix, precision: type[np.floating]) -> bool:
        return False

    def solve(self, rhs: Array) -> Array:
        return self._factors.solve(np.asarray(rhs, self._precision)).astype(float)

    def release(self) -> None:
        pass
