"""The element and the laws: energy, force and tangent; the kernels against the readable element."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optical_palpation.material import MooneyRivlin, NeoHookean, Yeoh
from optical_palpation.mechanics import reference_element as element
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.direct import sparse_matrix
from optical_palpation.mechanics.grid import LayerGrid, graded_depths

LAWS = {
    f"{kind.name}-{ratio:g}": kind(*values, bulk_to_shear=ratio)
    for kind, values in (
        (MooneyRivlin, (2.23, 0.703)),
        (NeoHookean, (2.9,)),
        (Yeoh, (2.0, -0.1, 0.05)),
    )
    for ratio in (1e4, 20.0)
}
each_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


def deformed(seed, law, size=(3, 4, 5)):
    """A body of uneven elements, factors and top, its displacement and pressure."""
    rng = np.random.default_rng(seed)
    nz, ny, nx = size
    x, y = (np.cumsum(rng.uniform(0.1, 0.3, n + 1)) for n in (nx, ny))
    surface = (ny + 1, nx + 1)
    grid = LayerGrid(x, y, graded_depths(nz, 1.3), 0.5 + 0.05 * rng.random(surface))
    body = Body(grid, law, rng.uniform(0.1, 10, size), 0.1 * rng.random(surface))
    u = 0.02 * rng.standard_normal((3, *grid.node_shape))
    u += np.array([0.2, 0.25, -0.35])[:, None, None, None] * body.nodes  # by a third flatter
    return rng, body, u, rng.standard_normal(size)


def elements(body, u, p):
    """Place and corners of each element, and what the readable one takes of it."""
    factors = np.broadcast_to(body.factor, body.grid.shape)
    for k, j, i in np.ndindex(body.grid.shape):
        corners = [(k + (a >> 2), j + (a >> 1) % 2, i + a % 2) for a in range(8)]
        before = np.array([body.nodes[:, *c] for c in corners])
        moved = np.array([u[:, *c] for c in corners])
        yield (k, j, i), corners, (body.law, factors[k, j, i], before, before + moved, p[k, j, i])


@each_law
def test_kernels_agree_with_the_readable_element(law):
    # 17 elements along x: one more than the kernels compute at a time
    _, body, u, p = deformed(0, law, (2, 2, 17))
    gamma = 0.7 * law.bulk_modulus
    divergence = np.empty((2, 2, 24, 17))
    planes = body.tangent_planes(u, p, gamma, divergence)
    stencil = np.stack([plane[..., :18].copy() for plane in planes])
    matrix = sparse_matrix(stencil, np.ones(u.shape, bool)).toarray()
    computed = body.forces(u, p)
    stresses = body.stress(u, p)
    force, expected = np.zeros(u.shape), np.zeros(matrix.shape)
    number = np.arange(u.size).reshape(u.shape)
    for place, corners, arguments in elements(body, u, p):
        nodal, gradient = element.force(*arguments)
        unknowns = np.array([number[:, *c] for c in corners]).ravel()
        force.ravel()[unknowns] += nodal.ravel()
        expected[np.ix_(unknowns, unknowns)] += element.stiffness(*arguments, gamma)
        assert_allclose(divergence[place[0], place[1], :, place[2]], gradient.ravel(), atol=1e-12)
        tensor = element.stress(*arguments)
        assert_allclose(
            stresses[:, *place], tensor[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]], atol=1e-8
        )
    assert_allclose(computed.force, force, atol=1e-10 * abs(force).max())
    assert_allclose(matrix, expected, atol=1e-10 * abs(expected).max())
    shapes = [given[2:4] for *_, given in elements(body, u, p)]
    jacobians = [np.linalg.det(f) for shape in shapes for f, *_ in element.points(*shape)]
    assert computed.min_jacobian == pytest.approx(min(jacobians))


@each_law
def test_energy_force_and_tangent_are_derivatives_of_one_another(law):
    """Taylor: what the derivative leaves falls with the square of the step."""
    rng, body, u, p = deformed(1, law, (1, 1, 1))
    ((_, _, (_, factor, before, after, pressure)),) = elements(body, u, p)
    direction = rng.standard_normal((8, 3)) * 0.02

    def at(step):
        moved = after + step * direction
        return (
            element.energy(law, factor, before, moved, pressure),
            element.force(law, factor, before, moved, pressure)[0],
        )

    energy, force = at(0.0)
    slope = (force * direction).sum()
    matrix = element.stiffness(law, factor, before, after, pressure)
    bend = (matrix @ direction.ravel()).reshape(8, 3)
    steps = 0.5 ** np.arange(3, 7)
    left = np.array(
        [
            [abs(e - energy - h * slope), np.linalg.norm(f - force - h * bend)]
            for h in steps
            for e, f in (at(h),)
        ]
    )
    orders = np.log2(left[:-1] / left[1:])
    assert (abs(orders[-1] - 2) < 0.1).all(), orders


@each_law
def test_laws_derivatives_are_those_of_their_energy(law):
    i1, i2, h = np.array([3.0, 3.4, 5.0]), np.array([3.0, 3.3, 6.0]), 1e-4
    first, second = law.slopes(i1, i2)
    assert_allclose(
        (law.energy(i1 + h, i2) - law.energy(i1 - h, i2)) / (2 * h), first * np.ones(3), rtol=1e-6
    )
    assert_allclose(
        (law.energy(i1, i2 + h) - law.energy(i1, i2 - h)) / (2 * h), second * np.ones(3), atol=1e-8
    )
    steps = (h, 0), (0, h)
    for n, (d1, d2) in enumerate(steps):
        ahead, behind = law.slopes(i1 + d1, i2 + d2), law.slopes(i1 - d1, i2 - d2)
        for m in range(2):
            expected = (ahead[m] - behind[m]) / (2 * h) * np.ones(3)
            assert_allclose(law.curvatures(i1, i2)[n + m] * np.ones(3), expected, atol=1e-8)


def test_stress_of_a_body_without_factors_is_that_of_ones():
    _, body, u, p = deformed(2, LAWS["yeoh-20"])
    ones = Body(body.grid, body.law, np.ones(body.grid.shape), body.top)
    one = Body(body.grid, body.law, 1.0, body.top)
    assert_allclose(one.forces(u, p).force, ones.forces(u, p).force, rtol=1e-13)
    assert_allclose(one.stress(u, p), ones.stress(u, p), rtol=1e-13)


@pytest.mark.parametrize("factors", [np.ones((2, 2, 2)), 0.0, -1.0, np.nan])
def test_stiffness_factors_of_another_shape_or_without_stiffness_are_refused(factors):
    _, body, u, p = deformed(0, LAWS["yeoh-20"])
    with pytest.raises(ValueError, match="stiffness"):
        Body(body.grid, body.law, factors).forces(u, p)
