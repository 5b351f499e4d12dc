"""Sparse direct solution of the coupled system, with factors kept for as long as they serve."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres, splu

Array = NDArray[np.float64]

#: Relative residual to which a system is solved with old factors, and the iterations it may take.
_TOLERANCE, _PATIENCE = 1e-3, 20


class LinearSolver:
    """Solves one Newton system after the other; MKL PARDISO where it is installed, else SuperLU.

    The factors of one system precondition GMRES on the next ones. Use as a context manager.
    """

    def __init__(self) -> None:
        self._factors: Any = None
        self.factorisations = 0

    def __enter__(self) -> LinearSolver:
        return self

    def __exit__(self, *_: object) -> None:
        self._release()

    def solve(self, matrix: sp.csr_matrix, rhs: Array, similar: bool = False) -> Array:
        """Solve one system; ``similar`` ones are tried with the factors of the last."""
        if similar and self._factors is not None and self._size == rhs.size:
            operator = LinearOperator(matrix.shape, matvec=self._apply, dtype=float)
            start = np.linalg.norm(rhs)
            solution, failed = gmres(
                matrix, rhs, M=operator, rtol=_TOLERANCE, restart=_PATIENCE, maxiter=1
            )
            if not failed and np.linalg.norm(matrix @ solution - rhs) < 2 * _TOLERANCE * start:
                return solution
        self._release()
        self._factorise(matrix)
        return self._apply(rhs)

    def _factorise(self, matrix: sp.csr_matrix) -> None:
        self._size = matrix.shape[0]
        self.factorisations += 1
        try:
            import pypardiso
        except ImportError:
            self._factors = splu(
                matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
            )
            return
        solver = pypardiso.PyPardisoSolver(mtype=11)
        # no scaling and matching, which a matrix with a strong diagonal does without
        for number, value in ((1, 1), (2, 3), (10, 13), (11, 0), (13, 0), (8, 1)):
            solver.set_iparm(number, value)
        self._matrix = sp.csr_matrix(matrix, copy=True)
        self._matrix.sort_indices()
        solver.set_phase(12)
        solver._call_pardiso(self._matrix, np.zeros(self._size))
        self._factors = solver

    def _apply(self, rhs: Array) -> Array:
        rhs = np.ascontiguousarray(rhs, float)
        if hasattr(self._factors, "solve") and not hasattr(self._factors, "set_phase"):
            return self._factors.solve(rhs)
        self._factors.set_phase(33)
        return self._factors._call_pardiso(self._matrix, rhs).reshape(rhs.shape)

    def _release(self) -> None:
        if hasattr(self._factors, "free_memory"):
            self._factors.free_memory(everything=True)
        self._factors = None
