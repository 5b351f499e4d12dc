"""Stencils of 16-bit integers: what rounding may change, and what it may not."""

import numba as nb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from optical_palpation.mechanics import stencil as stencils
from optical_palpation.mechanics.direct import sparse_matrix
from optical_palpation.mechanics.multigrid import Hierarchy

SHAPES = [(2, 3, 2), (3, 4, 17), (5, 5, 16), (4, 7, 33)]


def random_planes(shape, seed=0):
    """Entries of very different sizes, none of which reaches out of the grid."""
    rng = np.random.default_rng(seed)
    nz1, ny1, nx1 = shape
    full = rng.standard_normal((nz1, ny1, 27, 9, nx1)) * 10.0 ** rng.integers(
        -3, 3, (nz1, 1, 27, 1, 1)
    )
    full[:, :, 13] *= 1e4
    for m in range(27):
        for axis, (step, where) in enumerate(
            zip((m // 9, m // 3 % 3, m % 3), (0, 1, 4), strict=True)
        ):
            if step != 1:
                outside = [slice(None)] * 5
                outside[2], outside[where] = m, 0 if step == 0 else shape[axis] - 1
                full[tuple(outside)] = 0
    return full.astype(np.float32)


def stored(full):
    nz1, ny1, _, _, nx1 = full.shape
    out = stencils.empty_stencil((nz1, ny1, nx1))
    plane = np.zeros((ny1, 27, 9, stencils.padded(nx1)), np.float32)
    for k in range(nz1):
        plane[..., :nx1] = full[k]
        stencils.store(plane, out, k)
    return out


@pytest.mark.parametrize("shape", SHAPES)
def test_rounding_is_a_share_of_the_largest_neighbour_and_leaves_rigid_motion_alone(shape):
    full = random_planes(shape)
    rounded = stencils.expanded(stored(full), shape[2])
    rows = full.reshape(*shape[:2], 27, 3, 3, shape[2])
    others = np.delete(abs(rows), 13, 2).max((2, 4))  # by row of the block
    error = abs(rounded - full).reshape(rows.shape)
    assert (np.delete(error, 13, 2) <= 0.51 * others[:, :, None, :, None] / 32767).all()
    # the diagonal takes up what its row lost: the same displacement everywhere meets the same force
    change = abs(rounded.astype(float).sum(2) - full.astype(float).sum(2))
    assert (change <= 1e-6 * abs(full).astype(float).sum(2)).all()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("shape", SHAPES)
def test_product_is_that_of_the_matrix(shape, threads):
    rounded = stored(random_planes(shape))
    matrix = sparse_matrix(stencils.expanded(rounded, shape[2]), np.ones((3, *shape), bool))
    x, y = stencils.halo_zeros(shape), stencils.halo_zeros(shape)
    vector = np.random.default_rng(1).standard_normal((3, *shape)).astype(np.float32)
    stencils.interior(x, shape)[:] = vector
    before = nb.get_num_threads()
    nb.set_num_threads(min(threads, before))
    try:
        stencils.subtract_product(rounded, x, stencils.halo_zeros(shape), y)
    finally:
        nb.set_num_threads(before)
    expected = (matrix @ vector.ravel().astype(float)).reshape(vector.shape)
    size = (abs(matrix) @ abs(vector.ravel())).reshape(vector.shape)
    assert (abs(stencils.interior(y, shape) + expected) <= 1e-6 * size + 1e-30).all()
    assert (y != 0).sum() == (stencils.interior(y, shape) != 0).sum()  # the halo stays empty


@pytest.mark.parametrize("shape", SHAPES)
def test_product_is_the_same_with_the_axes_exchanged(shape):
    full = random_planes(shape)
    nz1, ny1, nx1 = shape
    other = nz1, nx1, ny1
    turned = stencils.empty_stencil(other)
    plane = np.zeros((ny1, 27, 9, stencils.padded(nx1)), np.float32)
    for k in range(nz1):
        plane[..., :nx1] = full[k]
        stencils.store(stencils.exchanged(plane, nx1), turned, k)
    vector = np.random.default_rng(1).standard_normal((3, *shape)).astype(np.float32)
    products = []
    for stencil, own, values in (
        (stored(full), shape, vector),
        (turned, other, vector.swapaxes(2, 3)),
    ):
        x, y = stencils.halo_zeros(own), stencils.halo_zeros(own)
        stencils.interior(x, own)[:] = values
        stencils.subtract_product(stencil, x, stencils.halo_zeros(own), y)
        products.append(stencils.interior(y, own))
    straight, exchanged = products[0], products[1].swapaxes(2, 3)
    assert_allclose(exchanged, straight, atol=1e-6 * abs(straight).max())


def test_axes_are_exchanged_where_that_fills_fewer_lanes():
    assert stencils.turned((5, 49, 20))  # 20 x 64 instead of 49 x 32
    assert not stencils.turned((5, 20, 49))
    assert not stencils.turned((5, 17, 17))


@settings(max_examples=20, deadline=None)
@given(
    counts=st.tuples(st.integers(1, 4), st.integers(2, 9), st.integers(2, 20)),
    seed=st.integers(0, 1000),
)
def test_coarse_operator_is_the_galerkin_product(counts, seed):
    rng = np.random.default_rng(seed)
    positions = tuple(np.cumsum(np.r_[0.0, 0.5 + rng.random(n)]) for n in counts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("optical_palpation.mechanics.multigrid._COARSEST", 20)
        hierarchy = Hierarchy(positions)
    if len(hierarchy.levels) == 1:
        return
    fine, coarse = hierarchy.levels[:2]
    full = random_planes(fine.node_shape, seed)
    hierarchy.levels[0].stencil = stored(full)
    free = rng.random((3, *fine.node_shape)) > 0.2
    interpolation = np.ones((1, 1))
    for transfer in fine.transfers:
        nodes = np.arange(len(transfer.low))
        one = np.zeros((len(nodes), len(transfer.nodes)))
        one[nodes, transfer.low] = 1 - transfer.weight
        one[nodes, transfer.low + 1] += transfer.weight
        interpolation = np.kron(interpolation, one)
    interpolation = np.kron(np.eye(3), interpolation)
    everywhere = np.ones((3, *fine.node_shape), bool)
    matrix = sparse_matrix(stencils.expanded(fine.stencil, fine.node_shape[2]), everywhere)
    expected = interpolation.T @ (matrix @ interpolation)
    kept = free[np.ix_(range(3), *(t.nodes for t in fine.transfers))]
    expected[~kept.ravel()] = 0
    expected[:, ~kept.ravel()] = 0
    hierarchy.update(free)
    found = sparse_matrix(
        stencils.expanded(coarse.stencil, coarse.node_shape[2]), np.ones_like(kept)
    ).toarray()
    assert_allclose(found, expected, atol=1e-3 * abs(expected).max())
    off = ~np.eye(len(found), dtype=bool)
    assert abs(found - expected)[off].max() <= 1e-4 * abs(expected).max()
