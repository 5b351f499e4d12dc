"""The linear solver of the virtual experiments."""

import sys

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from optical_palpation.experiment import linear
from optical_palpation.experiment.linear import LinearSolver


def system(seed, extra=0):
    """A chain of 3 x 3 blocks, not symmetric, some of them coupled to a far one."""
    rng = np.random.default_rng(seed)
    n = 40
    rows = [*range(n), *range(n - 1), *range(1, n), *range(extra)]
    columns = [*range(n), *range(1, n), *range(n - 1), *range(n - extra, n)]
    blocks = 0.3 * rng.normal(size=(len(rows), 3, 3))
    blocks[:n] += 3.0 * np.eye(3)
    order = np.lexsort((columns, rows))
    starts = np.searchsorted(np.sort(rows), np.arange(n + 1))
    matrix = sp.bsr_matrix((blocks[order], np.array(columns)[order], starts), shape=(3 * n, 3 * n))
    return matrix, rng.normal(size=3 * n)


@pytest.fixture(params=["best", "without MKL"])
def solver(request, monkeypatch):
    if request.param == "without MKL":
        monkeypatch.setitem(sys.modules, "pypardiso", None)
    else:
        pytest.importorskip("pypardiso")
    with LinearSolver() as solver:
        yield solver


def relative_error(solution, matrix, rhs):
    exact = spsolve(matrix.tocsc(), rhs)
    return np.linalg.norm(solution - exact) / np.linalg.norm(exact)


def test_solutions_are_exact_while_the_pattern_changes(solver):
    for seed, extra in ((0, 0), (1, 0), (2, 3), (3, 0), (4, 5)):
        matrix, rhs = system(seed, extra)
        assert relative_error(solver.solve(matrix, rhs), matrix, rhs) < 1e-7


def test_system_beyond_single_precision_is_solved_in_double(solver):
    """A free chain of springs, held by a trace of stiffness alone."""
    n = 120
    chain = sp.diags_array([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
    chain = chain.tolil()
    chain[0, 0] = chain[-1, -1] = 1.0
    matrix = sp.bsr_matrix(chain.tocsr() + 1e-9 * sp.identity(n), blocksize=(3, 3))
    rhs = np.random.default_rng(0).normal(size=n)
    solution = solver.solve(matrix, rhs)
    assert np.linalg.norm(matrix @ solution - rhs) < 1e-5 * np.linalg.norm(rhs)
    assert solver.factorisations == 2


def test_matrices_within_the_pattern_met_share_its_analysis(monkeypatch):
    pytest.importorskip("pypardiso")
    phases = []
    call = linear._Pardiso._call
    monkeypatch.setattr(
        linear._Pardiso,
        "_call",
        lambda self, phase, rhs: phases.append(phase) or call(self, phase, rhs),
    )
    with LinearSolver() as solver:
        for seed, extra in ((0, 0), (1, 3), (2, 0), (3, 2), (4, 3)):
            matrix, rhs = system(seed, extra)
            assert relative_error(solver.solve(matrix, rhs), matrix, rhs) < 1e-7
    # 12 analyses and factorises, 22 only factorises; the second system brings blocks of its own
    assert [phase for phase in phases if phase != 33][:3] == [12, 12, 22]
    assert phases.count(12) <= 3


def test_similar_systems_take_no_new_factors(solver):
    matrix, rhs = system(0)
    solver.solve(matrix, rhs)
    close, _ = system(0)
    close.data *= 1 + 1e-3 * np.random.default_rng(1).normal(size=close.data.shape)
    solution = solver.solve(close, rhs, similar=True)
    assert solver.factorisations == 1
    assert np.linalg.norm(close @ solution - rhs) < 2e-3 * np.linalg.norm(rhs)
    other, _ = system(9)
    solution = solver.solve(other, rhs, similar=True)
    assert np.linalg.norm(other @ solution - rhs) < 2e-3 * np.linalg.norm(rhs)
