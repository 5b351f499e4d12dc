"""Factors of a flat body's matrix, against a dense solution."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from optical_palpation.mechanics.direct import dissection
from optical_palpation.mechanics.factors import Dissection, Factors


def matrix_on(graph, rng):
    """A matrix that is not symmetric, its diagonal dominant, with every third entry left out."""
    matrix = sp.csr_matrix(sp.kron(graph, np.ones((3, 3))))
    matrix.data = rng.standard_normal(matrix.nnz) * (rng.random(matrix.nnz) < 0.67)
    matrix.eliminate_zeros()
    return sp.csr_matrix(matrix + sp.diags_array(np.asarray(np.abs(matrix).sum(1)).ravel() + 0.1))


@settings(deadline=None, max_examples=40)
@given(
    shape=st.tuples(st.integers(2, 4), st.integers(2, 13), st.integers(2, 13)),
    by_node=st.booleans(),
    seed=st.integers(0, 99),
)
def test_solution_is_that_of_the_dense_matrix(shape, by_node, seed):
    rng = np.random.default_rng(seed)
    order = dissection(shape)
    nodes = int(np.prod(shape))
    matrix = matrix_on(order.graph, rng)
    unknowns = np.arange(3 * nodes)
    unknowns = unknowns.reshape(-1, 3) if by_node else unknowns.reshape(3, -1).T
    mixed = np.empty(3 * nodes, int)
    mixed[unknowns.ravel()] = np.arange(3 * nodes)
    matrix = matrix[mixed][:, mixed]
    rhs = rng.standard_normal((3 * nodes, rng.choice([1, 3, 70])))
    found = Factors(matrix, order, unknowns).solve(rhs)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), rhs), atol=1e-10)


@settings(deadline=None, max_examples=20)
@given(
    nodes=st.integers(1, 200),
    share=st.sampled_from([0.0, 0.01, 0.1]),
    lines=st.booleans(),
    seed=st.integers(0, 99),
)
def test_bodies_of_any_shape(nodes, share, lines, seed):
    """Nodes that lie above one another, in one line, or are connected to none."""
    rng = np.random.default_rng(seed)
    links = sp.random_array((nodes, nodes), density=share, rng=rng) != 0
    graph = sp.csr_matrix((links + links.T + sp.eye_array(nodes)).astype(float))
    positions = rng.integers(0, 8, (nodes, 2)).astype(float)
    if lines:
        positions[:, 0] = 0.0
    matrix = matrix_on(graph, rng)
    rhs = rng.standard_normal((3 * nodes, 2))
    unknowns = np.arange(3 * nodes).reshape(-1, 3)
    found = Factors(matrix, Dissection(graph, positions), unknowns).solve(rhs)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), rhs), atol=1e-10)


def test_pivots_are_sought_within_a_block():
    """An interface whose diagonal is zero, as that of contact with a rigid surface."""
    matrix = np.eye(6)[[3, 4, 5, 0, 1, 2]] + 1e-3
    graph, unknowns = sp.csr_matrix(np.ones((2, 2))), np.arange(6).reshape(2, 3)
    factors = Factors(sp.csr_matrix(matrix), Dissection(graph, np.zeros((2, 2))), unknowns)
    rhs = np.arange(6.0)[:, None]
    np.testing.assert_allclose(factors.solve(rhs), np.linalg.solve(matrix, rhs), atol=1e-12)


@pytest.mark.parametrize("shape", [(3, 40, 9), (4, 21, 22)])
def test_number_of_threads_changes_no_bit(shape):
    from optical_palpation.palpation.threads import limited_threads

    rng = np.random.default_rng(0)
    order = dissection(shape)
    matrix = matrix_on(order.graph, rng)
    rhs = rng.standard_normal((matrix.shape[0], 1))
    unknowns = np.arange(matrix.shape[0]).reshape(-1, 3)
    solutions = []
    for threads in (1, 2):
        with limited_threads(threads):
            solutions.append(Factors(matrix, order, unknowns).solve(rhs))
    np.testing.assert_array_equal(*solutions)


def test_single_precision_is_as_good_as_its_digits():
    rng = np.random.default_rng(0)
    order = dissection((3, 40, 9))
    matrix = matrix_on(order.graph, rng)
    unknowns = np.arange(matrix.shape[0]).reshape(-1, 3)
    rhs = rng.standard_normal((matrix.shape[0], 40))
    double, single = (
        Factors(matrix, order, unknowns, kind).solve(rhs) for kind in (np.float64, np.float32)
    )
    error = np.abs(single - double).max() / np.abs(double).max()
    assert 1e-9 < error < 1e-5  # less would be double precision under another name


def test_work_grows_little_faster_than_the_nodes_of_a_sheet():
    small, large = (dissection((3, n, n)).operations for n in (20, 40))
    assert 4.0 < large / small < 11.0  # of a full matrix it would be 64
