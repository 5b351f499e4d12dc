"""The verification ladder of the layer solver, from contact to independent codes."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline, RectBivariateSpline

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import cascade
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.cascade import solve
from optical_palpation.mechanics.direct import DirectSolver, sparse_matrix
from optical_palpation.mechanics.faces import area_vectors, push_slope
from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import Tolerances
from optical_palpation.mechanics.newton import balance
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.system import assemble
from optical_palpation.palpation import computational_stress
from optical_palpation.palpation.meshing import expected_forces

C10, C01 = 2.23, 0.703
MU = 2 * (C10 + C01)
EXACT = Tolerances(force=1e-9, volume=1e-10)


def algebraic(problem: LayerProblem) -> np.ndarray:
    """Contact forces by the algebraic method."""
    return expected_forces(problem, MooneyRivlin(C10, C01))


def deformed(seed: int = 0):
    rng = np.random.default_rng(seed)
    x, y = np.cumsum(rng.uniform(0.1, 0.3, 6)), np.cumsum(rng.uniform(0.1, 0.3, 5))
    grid = LayerGrid(x, y, graded_depths(3, 1.3), 0.5 + 0.05 * rng.random((5, 6)))
    u = 0.02 * rng.standard_normal((3, *grid.node_shape))
    return rng, grid, u, rng.standard_normal(grid.shape)


def test_area_vectors_are_the_gradient_of_the_volume_beneath():
    _, grid, u, p = deformed(2)
    surface = (grid.nodes + u)[:, -1]
    step, expected = 1e-6, np.empty_like(surface)
    for index in np.ndindex(surface.shape):
        volumes = []
        for sign in (1, -1):
            moved = u.copy()
            moved[index[0], -1, index[1], index[2]] += sign * step
            volumes.append(Body(grid, MooneyRivlin(C10, C01)).forces(moved, p).volume.sum())
        expected[index] = (volumes[0] - volumes[1]) / (2 * step)
    inner = (slice(None), slice(1, -1), slice(1, -1))  # elsewhere the sides belong to it too
    assert_allclose(area_vectors(surface)[inner], expected[inner], atol=1e-9)


def test_faces_folded_in_a_plane_are_pushed_along_its_normal():
    """However the nodes lie in it, and whatever area that leaves them."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0))
    unloaded = LayerGrid(x[0], y[:, 0], graded_depths(2), np.ones(x.shape)).areas
    x, y = (at + 1.5 * rng.standard_normal(at.shape) for at in (x, y))
    slope = np.array([0.4, -0.7])
    met = np.broadcast_to(slope[:, None, None], (2, *x.shape))
    push, area, missing = push_slope(np.stack([x, y, slope[0] * x + slope[1] * y]), unloaded, met)
    assert (missing > 1).any()  # turned over
    assert (missing == 0).any()
    assert (area >= 0.1 * unloaded).all()
    assert_allclose(push, met, rtol=1e-12)


@pytest.mark.parametrize(("spreading", "folded"), [(0.0, 0.0), (0.02, 0.0), (0.0, 0.19)])
def test_newton_matrix_is_the_derivative_of_the_equations_with_contact_and_friction(
    spreading, folded
):
    rng = np.random.default_rng(1)
    x, px = np.linspace(0, 1, 6), np.linspace(-0.2, 1.2, 20)
    xx, yy = np.meshgrid(px, px)
    loaded = 0.42 + 0.03 * np.cos(5 * xx) * np.cos(4 * yy)
    problem = LayerProblem(
        LayerGrid(x, x, graded_depths(2), np.full((6, 6), 0.5)),
        Imprint(px, px, np.full((20, 20), 0.5), loaded, spreading * np.stack([xx, yy])),
        MooneyRivlin(C10, C01, 5e2 / MU),
        (0.3, 0.1),
    )
    state = LayerState.unloaded(problem.grid)
    state.load, state.anchor_load = 1.0, 0.7
    state.u = 0.01 * rng.standard_normal(state.u.shape)
    state.u[2] = 0.3 * state.u[2] - 0.17 * problem.grid.nodes[2]
    state.u[1, -1, 0] += folded  # almost to the next row, 0.2 mm away
    state.p = -5 + rng.standard_normal(state.p.shape)

    def at(u):
        moved = state.copy()
        moved.u = u
        return balance(problem, moved)

    now = at(state.u)
    state.normal_force = np.maximum(0, np.stack([now.force[2, 0], -now.force[2, -1]]))
    now = at(state.u)
    # friction is linearised where the nodes would come to rest: here, were nothing out of balance
    nothing, bound = np.zeros_like(now.force), np.ones(problem.grid.node_shape)
    at_rest = replace(
        now,
        friction=now.contact.friction(problem, nothing, bound),
        side_friction=now.sides.friction(nothing, bound),
    )
    system = assemble(problem, at_rest, DirectSolver(problem.grid.node_shape, 0.0))
    step = np.where(system.free, rng.standard_normal(state.u.shape), 0.0)
    cartesian = 1e-7 * system.to_cartesian(step)
    ahead, behind = (at(state.u + way * cartesian).residual(problem) for way in (1, -1))
    expected = (ahead - behind) / 2e-7
    matrix = sparse_matrix(system.stencil, system.free)
    error = abs((matrix @ step.ravel()).reshape(step.shape) - expected)
    carrying = np.stack([now.force[2, 0] > 0, now.force[2, -1] < 0])
    assert carrying.sum() > 30
    for face, k in ((0, 0), (1, -1)):
        assert error[:2, k][:, carrying[face]].max() < 2e-6 * abs(expected[:2, k]).max()
    assert error[:, 1:-1].max() < 1e-8 * abs(expected).max()


def test_error_of_a_layer_of_sloping_thickness_falls_at_second_order():
    forces = []
    for n in (2, 4, 8):
        x, y = np.linspace(-0.5, 0.5, 2 * n + 1), np.linspace(0, 2, 3)
        px, py = np.linspace(-1, 1, 65), np.linspace(-2, 4, 5)
        thickness, unloaded = (
            np.tile(0.5 + 0.05 * np.cos(np.pi * at), (rows, 1)) for at, rows in ((x, 3), (px, 5))
        )
        problem = LayerProblem(
            LayerGrid(x, y, graded_depths(n), thickness),
            Imprint(px, py, unloaded, np.full_like(unloaded, 0.45)),
            MooneyRivlin(C10, C01),
            (0.0, 0.0),
        )
        solution = solve(problem, algebraic, solver="direct", tolerances=EXACT)
        forces.append(solution.state.normal_force[1].sum())
    coarse, fine = np.diff(forces)
    assert 3.5 < coarse / fine < 4.5
    assert abs(fine) < 0.005 * forces[-1]


@pytest.mark.parametrize("compression", [1e-5, 1e-3, 0.02])
def test_a_layer_that_is_hardly_pressed_is_as_stiff_as_its_modulus_says(compression):
    """The smoothing of contact must not carry a part of a small load."""
    x, thickness = np.linspace(0, 1, 11), 0.5 * (1 - compression)
    loaded = xr.DataArray(np.full((11, 11), thickness), {"y": x, "x": x}, ("y", "x"))
    law = MooneyRivlin(C10, C01)
    result = computational_stress(
        loaded.assign_attrs(units="mm"), 0.5, law, **SETTINGS | dict.fromkeys(HELD, 0.0)
    )
    exact = law.uniaxial_stress(-compression)
    assert result.maps.attrs["sample_force_mN"] == pytest.approx(-exact, rel=1e-3)


@pytest.mark.parametrize(("ridges", "along"), [(0.0, "xy"), (0.02, "x"), (0.02, "y")])
def test_a_layer_that_nothing_drives_stays_where_it_is(ridges, along):
    """Rounding errors alone would move it along what is the same everywhere, and off its map."""
    x = np.linspace(0, 1, 21)
    height = np.tile(0.3 - ridges * np.cos(2 * np.pi * x), (21, 1))
    dims = ("x", "y") if along == "x" else ("y", "x")
    loaded = xr.DataArray(height, {"y": x, "x": x}, dims, attrs={"units": "mm"})
    given = SETTINGS | dict.fromkeys(HELD, 0.0) | {"element_size": 0.1}
    result = computational_stress(loaded.transpose("y", "x"), 0.5, MooneyRivlin(C10, C01), **given)
    for axis, moved in zip("xy", result.state.u, strict=False):
        if axis in along:
            assert abs(moved.mean()) < 1e-4
    if not ridges:
        exact = MooneyRivlin(C10, C01).uniaxial_stress(-0.4, "true")
        assert_allclose(result.maps["axial_stress"], exact, rtol=2e-3)


def relief(seed: int, n: int = 13, size: float = 1.5):
    rng = np.random.default_rng(seed)
    x = np.linspace(0, size, n)
    xx, yy = np.meshgrid(x, x)
    bumps = sum(
        rng.uniform(-1, 1) * np.cos(rng.uniform(1, 5) * xx + rng.uniform(1, 5) * yy + a)
        for a in range(4)
    )
    loaded = 0.42 + 0.02 * bumps
    return xr.DataArray(loaded, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})


#: Without what the sides and the inputs may change, which takes twice as long as the solution.
ALONE = {"edge_check": False, "input_errors": None}
HELD = {"window_friction": 0.2, "sample_friction": 0.05}
SETTINGS = {**HELD, "element_size": 0.125, **ALONE}


@pytest.mark.parametrize("edges", ["free", "padded", "roller"])
def test_forces_at_window_and_imprint_balance(edges):
    ratio = 20.0 if edges == "roller" else 1e4
    maps = computational_stress(
        relief(3), 0.5, MooneyRivlin(C10, C01, ratio), **SETTINGS, edges=edges
    ).maps
    assert maps.attrs["force_balance"] < 1e-4
    assert maps.attrs["window_force_mN"] > 1.0


@pytest.mark.parametrize(
    "turn",
    [
        lambda m: m[::-1],
        lambda m: m[:, ::-1],
        lambda m: m.T,
        lambda m: np.rot90(m),
    ],
)
def test_turned_input_gives_turned_output(turn):
    loaded = relief(4)
    material = MooneyRivlin(C10, C01)
    one = computational_stress(loaded, 0.5, material, **SETTINGS, solver="direct").maps
    other = computational_stress(
        loaded.copy(data=turn(loaded.values)), 0.5, material, **SETTINGS, solver="direct"
    ).maps
    for name in ("axial_stress", "contact_pressure"):
        expected = turn(one[name].values)
        assert_allclose(other[name], expected, atol=2e-4 * abs(expected).max())


@pytest.mark.parametrize(("ratio", "size"), [(1e4, 0.125), (20.0, (0.11, 0.15, 0.2))])
def test_multigrid_agrees_with_direct(ratio, size):
    loaded = relief(5) + 0.05  # partly out of contact
    material = MooneyRivlin(C10, C01, ratio)
    settings = {**SETTINGS, "element_size": size}
    maps = {
        solver: computational_stress(loaded, 0.5, material, **settings, solver=solver).maps
        for solver in ("multigrid", "direct")
    }
    assert (maps["direct"]["contact_state"] == 0).any()
    a, b = (maps[s]["contact_pressure"].values for s in ("multigrid", "direct"))
    assert np.linalg.norm(a - b) < 1e-3 * np.linalg.norm(b)


@pytest.fixture
def sinusoid(shared_data):
    data = np.load(shared_data / "layers" / "sinusoid_simulated_L1.npz")
    coords = {"y": data["y_mm"], "x": data["x_mm"]}
    extent = [0.0, 5.0, 0.0, 5.0]
    return xr.DataArray(
        data["L1_mm"], coords, ("y", "x"), attrs={"units": "mm", "layer_extent": extent}
    )


@pytest.mark.parametrize(("ratio", "reference"), [(1e4, 163.0), (20.0, 123.0)])
def test_sinusoid_of_independent_codes(sinusoid, shared_data, ratio, reference):
    maps = computational_stress(
        sinusoid,
        0.5,
        MooneyRivlin(C10, C01, ratio),
        window_friction=0.3,
        sample_friction=0.05,
        element_size=0.125,
        imprint_smoothing=0.0,
        **ALONE,
    ).maps
    assert maps.attrs["force_balance"] < 1e-4
    # the reference has outermost elements of 0.25 mm, and no friction where the side has rolled
    assert_allclose(maps.attrs["sample_force_mN"], reference, rtol=0.02)
    if ratio == 1e4:
        published = np.load(shared_data / "layers" / "sinusoid_reference_stress.npz")
        inner = maps["contact_pressure"].sel(x=slice(0.1, 4.9), y=slice(0.1, 4.9))
        spline = RectBivariateSpline(inner.y, inner.x, inner.values)
        ours = spline.ev(published["deformed_y_mm"], published["deformed_x_mm"])[4:-4, 4:-4]
        expected = published["contact_pressure_kPa"][4:-4, 4:-4]
        assert np.linalg.norm(ours - expected) < 0.04 * np.linalg.norm(expected)


def test_flat_slab_of_independent_codes():
    thickness, x = 0.4769376, np.linspace(0, 5, 41)
    loaded = xr.DataArray(
        np.full((41, 41), thickness - 0.1997982),
        {"y": x, "x": x},
        ("y", "x"),
        attrs={"units": "mm"},
    )
    solved = computational_stress(
        loaded,
        thickness,
        MooneyRivlin(C10, C01),
        window_friction=0.12,
        sample_friction=0.05,
        element_size=0.125,
        **ALONE,
    )
    # the reference has outermost elements of 0.25 mm, and no friction where the side has rolled
    assert_allclose(solved.maps.attrs["window_force_mN"], 1068.0, rtol=0.03)
    # Averaged over the middle element: nodes that lie exactly on the line of symmetry cannot slip
    # at all, and whether there are any depends on the number of elements.
    middle = 2.5 + 0.125 * np.linspace(-0.5, 0.5, 11)
    axial = solved.layer["displacement"].sel(component="z").interp(x=middle, y=middle)
    axial = axial.mean(("x", "y"))
    profile = CubicSpline(axial.z, axial / axial[-1])(np.linspace(0, 1, 11))
    reference = [0.001, 0.043, 0.116, 0.219, 0.342, 0.467, 0.594, 0.725, 0.842, 0.933, 1]
    assert_allclose(profile, reference, atol=0.02)


@pytest.fixture
def coin(shared_data):
    with h5py.File(shared_data / "layers" / "coin_5c_1-thickness.mat") as file:
        values = file["in_L0"][:].T.astype(float)
    x = np.linspace(0, 5, 502)
    return xr.DataArray(values, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})


@pytest.mark.slow
@pytest.mark.parametrize("edges", ["free", "roller", "padded"])
def test_real_coin_reaches_full_load_and_two_grids_agree(coin, edges):
    total = [
        computational_stress(
            coin,
            0.5,
            MooneyRivlin(C10, C01),
            window_friction=0.15,
            sample_friction=0.05,
            element_size=size,
            edges=edges,
            **ALONE,
        ).maps.attrs["sample_force_mN"]
        for size in (0.125, 5 / 60)
    ]
    assert_allclose(total[0], total[1], rtol=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"window_friction": -0.1}, "window_friction"),
        ({"sample_friction": np.nan}, "sample_friction"),
        ({"element_size": 0.6}, "larger than the thickness"),
        ({"element_size": (0.1, 0.1)}, "one or three"),
        ({"edges": "loose"}, "edges"),
        ({"imprint_smoothing": -1.0}, "imprint_smoothing"),
        ({"solver": "magic"}, "solver"),
        ({"threads": 0}, "threads"),
    ],
)
def test_parameters_that_cannot_be_used(change, message):
    with pytest.raises(InputError, match=message):
        computational_stress(relief(1), 0.5, MooneyRivlin(C10, C01), **{**SETTINGS, **change})


def test_missing_values_must_be_filled_first():
    with pytest.raises(InputError, match="clean_thickness"):
        computational_stress(
            relief(1).where(lambda m: m > m.min()), 0.5, MooneyRivlin(C10, C01), **SETTINGS
        )


@pytest.mark.slow
def test_a_load_that_is_not_reached_is_an_error_that_says_how_far_it_came(monkeypatch):
    monkeypatch.setattr(cascade, "_PATIENCE", 0.2)  # it arrives in less than two seconds
    loaded = relief(1, n=7, size=0.75)
    steps = loaded.copy(data=np.where(np.indices(loaded.shape).sum(0) % 2, 0.02, 0.49))
    with pytest.raises(ConvergenceError, match=r"loaded to [\d.]+ % only"):
        computational_stress(steps, 0.5, MooneyRivlin(C10, C01), **SETTINGS, imprint_smoothing=0.0)
