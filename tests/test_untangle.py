"""Elements that are inside out after the interpolation from a coarser grid."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.untangle import smallest_jacobians, untangled


@pytest.fixture
def body():
    x, y = np.linspace(0, 2, 11), np.linspace(0, 1.5, 8)
    depth = np.array([0, 0.2, 0.6, 1])
    thickness = 0.4 + 0.05 * np.sin(3 * x) * np.cos(2 * y)[:, None]
    return Body(LayerGrid(x, y, depth, thickness), MooneyRivlin(2.23, 0.703))


def test_homogeneous_deformation_and_the_kernels_own(body):
    gradient = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.3], [0.1, 0.0, 0.8]])
    u = np.tensordot(gradient - np.eye(3), body.nodes, 1)
    assert_allclose(smallest_jacobians(body, u), np.linalg.det(gradient), rtol=1e-12)
    u += np.random.default_rng(1).normal(0, 0.01, u.shape)
    p = np.zeros(body.grid.shape)
    assert_allclose(smallest_jacobians(body, u).min(), body.forces(u, p).min_jacobian, rtol=1e-12)


@pytest.mark.parametrize("size", [0.3, 1.5])
def test_a_fold_is_smoothed_and_the_rest_stays(body, size):
    u = 0.02 * np.sin(body.nodes)
    folded = u.copy()
    folded[:, 2, 3, 4] += size * np.array([0.3, -0.2, -1.0])
    folded[0, 1, 3, 5] -= size
    assert smallest_jacobians(body, folded).min() < 0
    repaired = untangled(body, folded, 0.5)
    assert smallest_jacobians(body, repaired).min() >= 0.5
    assert_array_equal(repaired[..., 9:], folded[..., 9:])
    assert untangled(body, u, 0.5) is u
