"""Faces that are glued: no slip, no opening, and they can pull."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from optical_palpation.analysis import stress_uncertainty
from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.contact import glued_displacement
from optical_palpation.mechanics.direct import DirectSolver, sparse_matrix
from optical_palpation.mechanics.grid import LayerGrid, graded_depths
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.krylov import MultigridSolver
from optical_palpation.mechanics.newton import balance
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem, LayerState
from optical_palpation.mechanics.system import assemble
from optical_palpation.palpation import ContactState, computational_stress
from optical_palpation.present import read_result
from optical_palpation.study import read_study
from optical_palpation.study.script import reproducing_lines

C10, C01 = 2.23, 0.703
MU = 2 * (C10 + C01)
THICKNESS = 0.5


def thickness(values, size=2.0) -> xr.DataArray:
    n = np.shape(values)[0] if np.ndim(values) else 33
    x = np.linspace(0, size, n)
    full = np.broadcast_to(np.asarray(values, float), (n, n)).copy()
    return xr.DataArray(full, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})


def wavy(mean: float = THICKNESS) -> xr.DataArray:
    """Thinner than the unloaded layer in places, thicker in others."""
    x = np.linspace(0, 2, 33)
    return thickness(mean + 0.03 * np.sin(4 * x) * np.cos(5 * x)[:, None])


def solved(loaded, window="glued", sample="glued", ratio=1e4, size=0.125, **options):
    return computational_stress(
        loaded,
        THICKNESS,
        MooneyRivlin(C10, C01, ratio),
        window_friction=window,
        sample_friction=sample,
        element_size=size,
        **{"edge_check": False, "input_errors": None} | options,
    )


def force(result) -> float:
    assert_allclose(
        result.maps.attrs["window_force_mN"], result.maps.attrs["sample_force_mN"], rtol=1e-4
    )
    return result.maps.attrs["sample_force_mN"]


def test_pressed_it_is_the_limit_of_great_friction():
    """Friction that never slips, over ever shorter slip lengths, before the sides touch."""
    loaded = thickness(0.9 * THICKNESS)
    rubbed = [force(solved(loaded, 2.0, 2.0, slip_length=s)) for s in (1e-3, 2.5e-4)]
    glued = force(solved(loaded))
    off = [abs(f / glued - 1) for f in rubbed]
    assert off[1] < 0.5 * off[0] < 0.005


def confined(stretch: float, ratio: float) -> float:
    """Axial stress of a layer that can't move sideways, from the energy by differences, kPa."""

    def energy(j):
        i1, i2 = j ** (-2 / 3) * (2 + j**2), j ** (-4 / 3) * (1 + 2 * j**2)
        return C10 * (i1 - 3) + C01 * (i2 - 3) + ratio * MU / 2 * (j - 1) ** 2

    return (energy(stretch + 1e-5) - energy(stretch - 1e-5)) / 2e-5


@pytest.mark.parametrize("stretch", [0.9, 1.1])
@pytest.mark.parametrize("window", ["glued", 0.1])
def test_between_rollers_its_stress_is_that_of_the_energy(stretch, window):
    """Pulled from a window that does not hold it, the layer comes off and is free of stress."""
    result = solved(thickness(stretch * THICKNESS), window, "glued", ratio=20.0, edges="roller")
    expected = confined(stretch, 20.0) if stretch < 1 or window == "glued" else 0.0
    axial = result.maps["axial_stress"].values
    assert_allclose(axial, expected, rtol=1e-4, atol=2e-4 * MU)
    assert_allclose(result.maps["contact_pressure"], -axial, atol=2e-4 * MU)
    assert force(result) == pytest.approx(-4.0 * expected, rel=1e-3, abs=1e-3 * MU)
    lifted = stretch > 1 and window != "glued"
    assert (result.maps["window_contact_state"] == ContactState.OPEN).all() == lifted


def test_small_tension_is_small_compression_with_another_sign():
    pulled, pressed = (force(solved(thickness((1 + s) * THICKNESS))) for s in (1e-3, -1e-3))
    assert pulled < 0
    assert_allclose(pulled, -pressed, rtol=0.02)


def test_what_is_neither_pressed_nor_pulled_is_free_of_stress():
    result = solved(thickness(THICKNESS))
    assert result.maps.attrs["status"] == "converged"
    assert_allclose(result.maps["contact_pressure"], 0.0, atol=1e-9 * MU)


def test_a_sample_pulls_where_the_layer_is_thicker_than_before():
    result = solved(wavy(), size=0.0625)
    maps = result.maps
    assert (maps["contact_state"] == ContactState.GLUED).all()
    assert (maps["window_contact_state"] == ContactState.GLUED).all()
    inside = {axis: slice(0.4, 1.6) for axis in "xy"}
    here = maps.sel(inside)
    change = here["loaded_thickness"] - THICKNESS
    pressure = here["contact_pressure"]
    assert float(pressure.min()) < -0.5 < 0.5 < float(pressure.max())
    assert np.corrcoef(change.values.ravel(), pressure.values.ravel())[0, 1] < -0.8
    assert float(maps["algebraic_axial_stress"].max()) > 0  # it pulls by that method, too
    assert maps.attrs["no_contact_share"] == 0
    assert maps.attrs["window_contact"] == maps.attrs["sample_contact"] == "glued"
    assert "window_friction" not in maps.attrs
    z = result.layer["position"].sel(component="z").values
    x, y = (result.layer["position"].sel(component=c).values for c in "xy")
    assert_allclose(z[0], 0.0, atol=1e-12)
    assert_allclose(z[-1], result.problem.imprint.evaluate(x[-1], y[-1], 1.0)[0], atol=1e-7)
    for face in (0, -1):
        assert_allclose(result.layer["displacement"][face, ..., :2], 0.0, atol=1e-12)


@pytest.mark.parametrize("holds", [("glued", "glued"), ("glued", 0.1), (0.3, "glued")])
def test_multigrid_agrees_with_direct(holds):
    loaded = wavy(0.97 * THICKNESS)
    pressure = [
        solved(loaded, *holds, solver=solver).maps["contact_pressure"].values
        for solver in ("multigrid", "direct")
    ]
    assert np.linalg.norm(pressure[0] - pressure[1]) < 1e-3 * np.linalg.norm(pressure[1])


def spread(scale: float) -> tuple[LayerProblem, LayerState]:
    """A layer glued to a window and a wavy imprint that spreads, far from equilibrium."""
    rng = np.random.default_rng(2)
    x, px = np.linspace(0, 1, 6), np.linspace(-0.2, 1.2, 20)
    xx, yy = np.meshgrid(px, px)
    loaded = 0.48 + 0.03 * np.cos(5 * xx) * np.cos(4 * yy)
    problem = LayerProblem(
        LayerGrid(x, x, graded_depths(3), np.full((6, 6), 0.5)),
        Imprint(px, px, np.full((20, 20), 0.5), loaded, scale * np.stack([xx, yy])),
        MooneyRivlin(C10, C01, 5e2 / MU),
        (0.0, 0.0),
        glued=(True, True),
    )
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    state.u = 0.01 * rng.standard_normal(state.u.shape)
    state.p = rng.standard_normal(state.p.shape)
    return problem, state


@pytest.mark.parametrize("scale", [0.0, 0.05])
def test_the_newton_step_takes_the_faces_where_they_belong_and_foretells_the_forces(scale):
    problem, state = spread(scale)
    now = balance(problem, state)
    step = 1e-6  # of a Newton step, against which differences are taken
    steps = []
    for solver in (
        DirectSolver(problem.grid.node_shape, problem.bulk_modulus),
        MultigridSolver(problem.grid, problem.shear_modulus, free_sides=True),
    ):
        system = assemble(problem, now, solver)
        du, dp, _ = solver.solve(system.right_hand_side(problem, now), 1e-6)
        steps.append(du)
        for face, k in ((0, 0), (1, -1)):
            expected = glued_displacement(problem, face, 1.0) - state.u[:, k]
            assert_allclose(du[:, k], expected, atol=1e-6)
        foretold = system.contact_forces(now.force, du, dp) - now.state.normal_force
        moved = [state.copy(), state.copy()]
        for sign, other in zip((1, -1), moved, strict=True):
            other.u += sign * step * du
            other.p += sign * step * dp
        ahead, behind = (balance(problem, other) for other in moved)
        change = (ahead.state.normal_force - behind.state.normal_force) / (2 * step)
        assert_allclose(foretold, change, atol=2e-4 * abs(change).max())
        out = now.residual(problem)
        residual = (ahead.residual(problem) - behind.residual(problem)) / (2 * step)
        assert_allclose(residual, -out, atol=1e-3 * abs(out).max())
    assert_allclose(steps[0], steps[1], atol=1e-3 * abs(steps[0]).max())


def test_the_matrix_is_the_derivative_of_the_equations():
    problem, state = spread(0.05)
    now = balance(problem, state)
    system = assemble(problem, now, DirectSolver(problem.grid.node_shape, 0.0))
    rng = np.random.default_rng(3)
    du = np.where(system.free, rng.standard_normal(state.u.shape), 0.0)
    assert not system.free[:, [0, -1]].any()
    residuals = []
    for sign in (1, -1):
        moved = state.copy()
        moved.u += sign * 1e-7 * du
        residuals.append(balance(problem, moved).residual(problem))
    expected = (residuals[0] - residuals[1]) / 2e-7
    product = (sparse_matrix(system.stencil, system.free) @ du.ravel()).reshape(du.shape)
    assert abs(product - expected)[system.free].max() < 1e-6 * abs(expected).max()


def test_a_glued_face_goes_with_the_points_that_it_lay_on():
    problem, _ = spread(0.05)
    x, y = problem.grid.nodes[:2, -1]
    moved = glued_displacement(problem, SAMPLE, 0.4)
    # of the point that is at X at full load, 0.05 X of the way is behind it
    assert_allclose(moved[0], 0.4 * x * 0.05 / 0.95, rtol=1e-3, atol=1e-9)
    height = problem.imprint.evaluate(x + moved[0], y + moved[1], 0.4)[0]
    assert_allclose(problem.grid.nodes[2, -1] + moved[2], height, atol=1e-12)


@pytest.mark.parametrize("nodes", [9, 17, 33])
def test_iterations_do_not_grow_with_the_grid(nodes):
    x, px = np.linspace(0, 2, nodes), np.linspace(0, 2, 41)
    flat = np.full((41, 41), 0.4)
    imprint = Imprint(px, px, flat, 0.95 * flat + 0.01 * np.cos(4 * px) * np.cos(5 * px)[:, None])
    problem = LayerProblem(
        LayerGrid(x, x, graded_depths((nodes - 1) // 4), np.full((nodes, nodes), 0.4)),
        imprint,
        MooneyRivlin(C10, C01),
        (0.0, 0.0),
        glued=(True, True),
    )
    state = LayerState.unloaded(problem.grid)
    state.load = 1.0
    solver = MultigridSolver(problem.grid, problem.shear_modulus, free_sides=True)
    now = balance(problem, state)
    rhs = assemble(problem, now, solver).right_hand_side(problem, now)
    assert solver.solve(rhs, 1e-2)[2] <= 12


def test_a_pulled_layer_that_would_tear_is_named():
    result = solved(thickness(1.25 * THICKNESS))
    assert "tears open" in result.maps.attrs["unusual"]
    assert "tears open" not in solved(thickness(0.8 * THICKNESS)).maps.attrs["unusual"]


def test_only_a_glued_sample_can_pull():
    with pytest.raises(InputError, match="only a glued sample can pull"):
        solved(thickness(1.1 * THICKNESS), "glued", 0.1)
    with pytest.raises(InputError, match=r'sample_friction must be .* or "glued"'):
        solved(thickness(0.9 * THICKNESS), "glued", "stuck")


def test_command_and_study_say_glued(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    values = wavy(0.98 * THICKNESS)
    np.savez("m.npz", L1=values.values, x=values["x"].values, y=values["y"].values)
    common = ["--initial-thickness", "0.5", "--c10", "2.23", "--c01", "0.703"]
    grid = ["--element-size", "0.25", "--quiet", "--output"]
    glued = ["--window", "glued", "--sample", "glued"]
    assert run("stress", "m.npz", *common, *glued, *grid, "r.nc")[0] == 0
    Path("s.toml").write_text(
        'loaded = { map = "m.npz" }\nunloaded = { thickness = 0.5 }\n'
        "material = { c10 = 2.23, c01 = 0.703 }\n"
        'friction = { window = "glued", sample = "glued", slip_length = 0.002 }\n'
        'grid = { element_size = 0.25 }\noutputs = { write = ["report"] }\n'
    )
    assert run("run", "s.toml", "--quiet")[0] == 0
    one, other = (read_result(p).maps for p in ("r.nc", "s-results/stress.nc"))
    for maps in (one, other):
        assert (maps["contact_state"] == ContactState.GLUED).all()
        assert maps.attrs["sample_contact"] == "glued"
    assert_allclose(one["axial_stress"], other["axial_stress"], rtol=1e-6)
    change = abs(1 - values / THICKNESS)  # less where the imprint is smoothed
    most = one.attrs["slip_length_mm"] / 0.001 * 0.1
    assert float(change.mean()) < most < float(change.max())
    assert other.attrs["slip_length_mm"] == 0.002
    assert '"3": "glued"' in Path("s-results/report.html").read_text().replace('"3":"', '"3": "')
    lines = reproducing_lines(read_study("s.toml"))
    assert "window_friction='glued', sample_friction='glued', slip_length=0.002" in lines

    for wrong, said in (
        (["--window", "glued", "--window-friction", "0.1", "--sample", "glued"], "no place"),
        (["--window", "glued"], "--sample glued"),
        (["--window", "glued", "--sample", "glued", "--deck", "d.inp"], "no glued faces"),
    ):
        code, _, error = run("stress", "m.npz", *common, *wrong, *grid, "x.nc")
        assert code != 0
        assert said in " ".join(error.split())


@pytest.mark.parametrize("value", ['"stuck"', "3.0", "true", "-0.1"])
def test_a_study_takes_a_coefficient_or_glued(tmp_path, value):
    file = tmp_path / "s.toml"
    (tmp_path / "m.npz").touch()
    file.write_text(
        'loaded = { map = "m.npz" }\nunloaded = { thickness = 0.5 }\nmaterial = { c10 = 2.23 }\n'
        f"friction = {{ window = {value}, sample = 0.1 }}\ngrid = {{ element_size = 0.25 }}\n"
    )
    with pytest.raises(InputError, match=f"friction.window = {value}.*: must be .*'glued'"):
        read_study(file)


def test_error_bars_leave_out_glued_faces():
    errors = stress_uncertainty(
        wavy(0.95 * THICKNESS),
        THICKNESS,
        MooneyRivlin(C10, C01),
        window_friction="glued",
        sample_friction=0.2,
        element_size=0.25,
    )
    assert errors["input"].values.tolist() == ["sample_friction"]
