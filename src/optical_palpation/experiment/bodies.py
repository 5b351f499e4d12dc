"""The stiffness matrix of a body."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from optical_palpation.mechanics.body import Body

Array = NDArray[np.float64]


def condensed_tangent(body: Body, u: Array, p: Array) -> tuple[sp.bsr_matrix, Array]:
    """Stiffness with the pressure condensed (unknown 3 node + component), and dv/du.

    The latter has shape (nz, ny, 24, nx), entry 3 * node + component.
    """
    nz, ny, nx = body.grid.shape
    divergence = np.empty((nz, ny, 24, nx))
    inside, columns, starts = _neighbours(body.grid.node_shape)
    data = np.empty((columns.size, 3, 3))
    first = 0
    planes = body.tangent_planes(u, p, body.law.bulk_modulus, divergence)
    for there, plane in zip(inside, planes, strict=True):
        blocks = plane[..., : nx + 1].transpose(0, 3, 1, 2)[there]
        data[first : first + len(blocks)] = blocks.reshape(-1, 3, 3)
        first += len(blocks)
    size = 3 * body.n_nodes
    return sp.bsr_matrix((data, columns, starts), shape=(size, size)), divergence


def _neighbours(
    shape: tuple[int, int, int],
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Which of 27 neighbours a node has, their numbers, and the row starts (in blocks)."""
    k, j, i = np.indices(shape)
    m = np.arange(27)
    kk, jj, ii = (
        axis[..., None] + step
        for axis, step in ((k, m // 9 - 1), (j, m // 3 % 3 - 1), (i, m % 3 - 1))
    )
    inside = np.ones(kk.shape, bool)
    for axis, count in zip((kk, jj, ii), shape, strict=True):
        inside &= (axis >= 0) & (axis < count)
    number = (kk * shape[1] + jj) * shape[2] + ii
    starts = np.concatenate([[0], np.cumsum(inside.sum(-1).ravel())])
    return inside, number[inside], starts
