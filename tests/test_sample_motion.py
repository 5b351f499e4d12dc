"""An imprint that moves sideways with the sample, against closed forms and the moving sample."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from optical_palpation.errors import InputError
from optical_palpation.experiment import Scene, run_experiment
from optical_palpation.experiment.assembly import build
from optical_palpation.experiment.recovery import (
    recovered_stress,
    recovery_errors,
    spreading_sample,
)
from optical_palpation.experiment.scene import Box
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import make_solver, solve
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import Tolerances
from optical_palpation.mechanics.newton import balance, equilibrate
from optical_palpation.mechanics.path import StepControl
from optical_palpation.mechanics.problem import LayerProblem, LayerState
from optical_palpation.mechanics.stack.cascade import solve as compress
from optical_palpation.mechanics.stack.problem import (
    INTERFACE,
    LAYER,
    SAMPLE,
)
from optical_palpation.palpation import computational_stress, read_sample_motion, uniform_motion
from optical_palpation.palpation.motion import match_sample_motion
from optical_palpation.present import read_result
from optical_palpation.study import read_study, run_study
from optical_palpation.study.script import reproducing_lines
from optical_palpation.thickness import thickness_map

C10, C01 = 2.23, 0.703
MU = 2 * (C10 + C01)
WIDTH, THICKNESS, STRETCH = 2.0, 0.5, 0.85
PIXELS = np.linspace(-0.5, 2.5, 31)


def pressed(motion: np.ndarray | None, friction: tuple[float, float]):
    """A flat square pressed to 0.85 of its thickness by an imprint with this motion."""
    x = np.linspace(0, WIDTH, 9)
    flat = np.full((31, 31), THICKNESS)
    problem = LayerProblem(
        LayerGrid(x, x, np.linspace(0, 1, 4), np.full((9, 9), THICKNESS)),
        Imprint(PIXELS, PIXELS, flat, STRETCH * flat, motion),
        MooneyRivlin(C10, C01),
        friction,
    )
    uniform = MU * problem.grid.surface_areas(problem.grid.nodes[:, -1])
    tolerances = Tolerances(force=1e-6, volume=1e-8)
    return solve(problem, lambda _: 0.5 * uniform, solver="direct", tolerances=tolerances)


def spreading(lateral: float) -> np.ndarray:
    """Motion of a surface that is stretched about its centre by this factor."""
    moved = (1 - 1 / lateral) * (PIXELS - 0.5 * WIDTH)
    return np.stack(np.meshgrid(moved, moved))


def test_layer_that_is_carried_as_it_spreads_by_itself_stays_in_uniaxial_compression():
    # incompressible: true stress 2 (C10 + C01 / stretch) (stretch^2 - 1 / stretch) over 1 / stretch
    force = -2 * (C10 + C01 / STRETCH) * (STRETCH**2 - 1 / STRETCH) * WIDTH**2 / STRETCH
    carried = pressed(spreading(STRETCH**-0.5), (0.0, 0.5)).state
    held = pressed(None, (0.0, 0.5)).state
    assert_allclose(carried.normal_force.sum((1, 2)), force, rtol=2e-4)
    assert held.normal_force[1].sum() > 1.3 * force
    shift = carried.u[0, -1, 0] - (STRETCH**-0.5 - 1) * np.linspace(-1, 1, 9)
    assert abs(shift).max() < 1e-4


@pytest.mark.parametrize("way", [(1.0, 0.0), (-0.6, 0.8)])
def test_imprint_that_slides_drags_the_layer_with_the_full_friction(way):
    motion = 0.3 * np.asarray(way)[:, None, None] * np.ones((2, 31, 31))
    solution = pressed(motion, (0.5, 0.1))
    state = solution.state
    drag = balance(solution.problem, state).force[:2, -1].sum((1, 2))  # of the imprint on the layer
    expected = 0.1 * state.normal_force[1].sum() * np.asarray(way)
    # where the rim lifts off, the surface beside it is inclined and takes a little of the drag
    assert_allclose(drag, expected, rtol=0.05, atol=0.01)


def test_points_of_the_imprint_move_straight_and_in_proportion_to_the_load():
    lateral = 1.12
    imprint = Imprint(PIXELS, PIXELS, *np.full((2, 31, 31), THICKNESS), spreading(lateral))
    start = np.array([0.3, 1.0, 1.7])
    for load in (0.0, 0.4, 1.0):
        moved = load * (lateral - 1) * (start - 1.0)
        velocity = imprint.velocity(start + moved, start, load)
        assert_allclose(velocity[0], (lateral - 1) * (start - 1.0), atol=1e-4)


def bump(n: int = 13) -> xr.DataArray:
    x = np.linspace(0, 1.5, n)
    dent = 0.03 * np.exp(-((x - 0.6) ** 2 + (x[:, None] - 0.9) ** 2) / 0.2)
    return thickness_map(0.42 - dent, x=x, y=x)


SETTINGS = {
    **{"window_friction": 0.2, "sample_friction": 0.2, "element_size": 0.25, "threads": 1},
    **{"mesh_check": False, "edge_check": False, "input_errors": None},
}


def stress(loaded: xr.DataArray, motion: xr.Dataset | None, **changes) -> xr.Dataset:
    options = SETTINGS | changes
    return computational_stress(
        loaded, 0.5, MooneyRivlin(C10, C01), sample_motion=motion, solver="direct", **options
    ).maps


def test_a_sample_that_spreads_takes_the_layer_along_and_is_pressed_less():
    loaded = bump()
    fixed, moving = (stress(loaded, m) for m in (None, uniform_motion(loaded, 0.2)))
    assert moving.attrs["sample_force_mN"] < 0.8 * fixed.attrs["sample_force_mN"]
    for maps, sense in ((fixed, -1), (moving, 1)):
        inside = maps.sel(x=slice(0.2, 1.3))
        outward = (inside["traction_x"] * np.sign(inside["x"] - 0.75)).sum()
        assert sense * float(outward) > 0
    assert moving.attrs["sample_motion_largest_mm"] == pytest.approx(0.2 / 1.2 * 0.75 * 2**0.5)
    assert "sample_motion_largest_mm" not in fixed.attrs


def test_a_sample_that_stays_is_the_fixed_imprint():
    loaded = bump()
    still = stress(loaded, uniform_motion(loaded, 0.0))
    assert_allclose(still["axial_stress"], stress(loaded, None)["axial_stress"], rtol=1e-12)


def test_swapped_axes_give_swapped_stress():
    loaded = bump()
    y, x = xr.broadcast(loaded["y"], loaded["x"])
    moved = {"sample_displacement_x": 0.1 * (x - 0.5) + 0.02, "sample_displacement_y": 0.03 * x * y}
    motion = xr.Dataset(moved)
    swapped = xr.Dataset(
        {f"sample_displacement_{a}": motion[f"sample_displacement_{b}"] for a, b in ("xy", "yx")}
    ).rename(x="y", y="x")
    one = stress(loaded, motion)["axial_stress"]
    other = stress(loaded.rename(x="y", y="x"), swapped)["axial_stress"]
    assert_allclose(other.values.T, one.values, atol=2e-4 * float(abs(one).max()))


SOFT = Scene.model_validate(
    {
        "compression": 0.25,
        "layer": {"size": (2.0, 2.0), "thickness": 0.5},
        "sample": {
            "size": (2.0, 2.0),
            "thickness": 1.0,
            "relief": [{"kind": "sinusoid", "amplitude": 0.03, "wavelength": 1.3}],
        },
        "friction": {"window": 0.3, "sample": 0.2, "plate": 0.1},
        "mesh": {"element_size": 0.16, "layer_elements": 3},
    }
)


def seen_surface(assembly, u, pixels):
    """Height and lateral displacement of the sample's surface at points, as the experiment has it.

    The points are given to the experiment's own contact as if they were nodes of the layer.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(pixels, pixels))
    interface, sample = assembly.contacts[INTERFACE], assembly.bodies[SAMPLE].grid
    number = assembly.n_nodes + np.arange(x.size)
    start = [
        np.interp(at, nodes, np.arange(nodes.size)) for at, nodes in ((x, sample.x), (y, sample.y))
    ]
    shape = (pixels.size, pixels.size)
    points = replace(
        interface,
        slaves=number.reshape(shape),
        start=np.stack(start, axis=1),
        unloaded=np.zeros(shape),
    )
    level = np.stack([x, y, np.full(x.size, 0.3)], axis=1)
    met = points.project(np.concatenate([assembly.position(u), level]))
    moved = -met.lateral(np.concatenate([u, np.zeros_like(level)]))
    return (0.3 - met.penetration).reshape(number.size // pixels.size, -1), moved.T.reshape(
        2, pixels.size, -1
    )


def test_the_layer_alone_on_the_moving_surface_is_the_layer_of_the_experiment():
    """The two solvers share the grid here, and one load step: they must agree on every node."""
    scene = SOFT.model_copy(
        update={
            "compression": 0.12,
            "sample": SOFT.sample.model_copy(update={"size": (2.8, 2.8)}),
            "mesh": SOFT.mesh.model_copy(update={"element_size": 0.25}),
        }
    )
    assembly = build(scene)
    path = compress([assembly], control=StepControl(1.0))
    assert len(path.record) == 1
    u, p = assembly.split(path.state.u)[LAYER], path.state.p[LAYER]
    grid, pixels = assembly.bodies[LAYER].grid, np.linspace(-0.2, 2.2, 241)
    height, motion = seen_surface(assembly, path.state.u, pixels)
    assert abs(motion).max() > 0.03
    flat = np.full_like(height, 0.5)
    errors = []
    for moves in (motion, None):
        problem = LayerProblem(
            grid,
            Imprint(pixels, pixels, flat, height, moves),
            MooneyRivlin(C10, C01),
            (0.3, 0.2),
            slip_length=assembly.slip_length,
        )
        forces = [force.reshape(grid.node_shape[1:]) for force in path.state.forces[:2]]
        state = replace(LayerState.unloaded(grid), load=1.0, u=u.copy(), p=p.copy())
        state.normal_force = np.stack(forces)
        now, _ = equilibrate(problem, state, make_solver(problem, "direct"), Tolerances())
        state = now.state
        change = np.linalg.norm(state.normal_force - forces, axis=(1, 2))
        errors.append(float((change / np.linalg.norm(forces, axis=(1, 2))).max()))
    assert errors[0] < 3e-4
    assert errors[1] > 0.1


def test_the_layer_on_a_nearly_rigid_sample_is_the_layer_on_an_imprint():
    """Each follows its own load path, on the same grid; the forces agree to 1 %."""
    stiff = SOFT.sample.model_copy(
        update={
            "size": (2.8, 2.8),
            "stiffness": (Box(kind="box", factor=1000.0),),
        }
    )
    scene = SOFT.model_copy(
        update={
            "compression": 0.15,
            "sample": stiff,
            "mesh": SOFT.mesh.model_copy(update={"element_size": 0.2}),
        }
    )
    assembly = build(scene)
    state = compress([assembly]).state
    grid, pixels = assembly.bodies[LAYER].grid, np.linspace(-0.2, 2.2, 241)
    height, motion = seen_surface(assembly, state.u, pixels)
    assert abs(motion).max() < 2e-3
    unloaded = np.full_like(height, 0.5)
    problem = LayerProblem(
        grid,
        Imprint(pixels, pixels, unloaded, height),
        MooneyRivlin(C10, C01),
        (0.3, 0.2),
        slip_length=assembly.slip_length,
    )
    force = state.forces[1].reshape(grid.node_shape[1:])
    alone = solve(problem, lambda _: force, cascade=False).state
    assert alone.normal_force[1].sum() == pytest.approx(force.sum(), rel=0.01)
    error = np.linalg.norm(alone.normal_force[1] - force) / np.linalg.norm(force)
    assert error < 0.03


def test_the_true_motion_brings_back_the_true_stress_of_a_soft_sample():
    """Experiment and method share the laws, but no grid; the friction is the scene's."""
    true = run_experiment(SOFT, threads=1)

    def error(motion: xr.Dataset | None) -> float:
        found = recovered_stress(true, element_size=0.125, sample_motion=motion, threads=1)
        errors = recovery_errors(true, found).sel(approach="computational", zone="interior")
        return float(errors["relative_rms"])

    fixed = error(None)
    assert fixed > 0.5
    assert error(true.maps) < 0.03
    assert error(spreading_sample(true)) < 0.5 * fixed


@settings(max_examples=25, deadline=None)
@given(
    strain=st.floats(-0.15, 0.3),
    pixels=st.tuples(st.integers(3, 9), st.integers(3, 9)),
    beyond=st.floats(0.0, 0.3),
)
def test_motion_on_other_pixels_is_the_same_motion(strain, pixels, beyond):
    coarse = thickness_map(
        np.full(pixels, 0.4),
        x=np.linspace(-beyond, 2 + beyond, pixels[1]),
        y=np.linspace(-beyond, 3 + beyond, pixels[0]),
    )
    loaded = thickness_map(np.full((31, 21), 0.4), x=np.linspace(0, 2, 21), y=np.linspace(0, 3, 31))
    expected = uniform_motion(loaded, strain)
    flipped = uniform_motion(coarse, strain).isel(x=slice(None, None, -1))
    found = match_sample_motion(flipped, loaded)
    assert_allclose(
        found.sel(component="sample_displacement_x"), expected["sample_displacement_x"], atol=1e-12
    )
    assert_allclose(
        found.sel(component="sample_displacement_y"), expected["sample_displacement_y"], atol=1e-12
    )


def in_um(motion: xr.Dataset) -> xr.Dataset:
    return xr.Dataset(
        {k: (v.dims, 1e3 * v.values, {"units": "um"}) for k, v in motion.data_vars.items()},
        motion.coords,
    )


def changed(how) -> xr.Dataset:
    return how(uniform_motion(bump(), 0.1))


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (bump(), "xarray.Dataset of sample_displacement_x"),
        (
            changed(lambda m: m[["sample_displacement_x"]]),
            "found a Dataset of sample_displacement_x",
        ),
        (changed(lambda m: m.rename(x="u")), "dimensions"),
        (changed(lambda m: m.drop_vars("x")), "dimensions"),
        (changed(lambda m: m.where(m["x"] > 0.2)), "26 missing"),
        (changed(lambda m: 1000 * m), "in um"),
        (changed(in_um), "is in um"),
        (changed(lambda m: m.sel(x=slice(0.2, None))), "does not cover the layer"),
        (changed(lambda m: m.assign_coords(x=np.zeros(13))), "rise or fall"),
    ],
)
def test_motion_that_cannot_be_used_is_named(motion, message):
    with pytest.raises(InputError, match=message):
        match_sample_motion(motion, bump())


@pytest.mark.parametrize("strain", [-0.5, 1.0, np.nan])
def test_impossible_spreading_is_refused(strain):
    with pytest.raises(InputError, match="spreads by a strain"):
        uniform_motion(bump(), strain)


def test_files_of_motion(tmp_path):
    motion = uniform_motion(bump(), 0.1)
    path = tmp_path / "motion.nc"
    motion.to_netcdf(path, engine="h5netcdf")
    found = read_sample_motion(path)
    xr.testing.assert_allclose(found, motion)
    assert found.attrs["source"] == "motion.nc"
    assert len(found.attrs["source_sha256"]) == 64
    in_um(motion).transpose("x", "y").to_netcdf(path, engine="h5netcdf")
    xr.testing.assert_allclose(read_sample_motion(path), motion)
    np.savez(tmp_path / "motion.npz", **{k: v.values for k, v in motion.variables.items()})
    xr.testing.assert_allclose(read_sample_motion(tmp_path / "motion.npz"), motion)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"y": np.arange(3.0)}, "no variable 'sample_displacement_x'"),
        ({"x": np.arange(4.0)}, "3 rows along y and 3 columns along x"),
        ({"x": np.array(["a", "b", "c"])}, "its type <U1"),
    ],
)
def test_files_without_a_motion_are_named(tmp_path, content, message):
    path = tmp_path / "motion.npz"
    good = {name: np.zeros((3, 3)) for name in ("sample_displacement_x", "sample_displacement_y")}
    good |= {"x": np.arange(3.0), "y": np.arange(3.0)}
    np.savez(path, **(content if len(content) == 1 and "y" in content else good | content))
    with pytest.raises(InputError, match=message) as error:
        read_sample_motion(path)
    assert str(path) in str(error.value)


def test_command_takes_a_strain_or_a_file(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    loaded = bump()
    np.save("map.npy", loaded.values)
    uniform_motion(loaded, 0.2).to_netcdf("motion.nc", engine="h5netcdf")
    arguments = "map.npy --field-of-view 1.5 1.5 --initial-thickness 0.5 --c10 2.23 --c01 0.703"
    arguments += " --window-friction 0.2 --sample-friction 0.2 --element-size 0.25 --threads 1"
    arguments += " --no-estimates"
    forces = []
    for motion in ([], ["--sample-motion", "0.2"], ["--sample-motion", "motion.nc"]):
        status, _, err = run("stress", *arguments.split(), *motion, "--output", "o.nc")
        assert status == 0, err
        maps = read_result("o.nc").maps
        forces.append(maps.attrs["sample_force_mN"])
    assert maps.attrs["sample_motion_source"] == "motion.nc"
    assert forces[1] == pytest.approx(forces[2], rel=1e-6)
    assert forces[1] < 0.8 * forces[0]
    for motion, message in (("absent.nc", "absent.nc"), ("map.npy", "sample_displacement_x")):
        status, _, err = run(
            "stress", *arguments.split(), "--sample-motion", motion, "--output", "other.nc"
        )
        assert (status, message in err) == (2, True)
        assert not (tmp_path / "other.nc").exists()
    status, _, err = run(
        "stress",
        *arguments.split(),
        "--sample-motion",
        "0.2",
        "--output",
        "o.nc",
        "--method",
        "algebraic",
    )
    assert status == 2
    assert "--sample-motion" in err


STUDY = """
[loaded]
map = "map.npy"
field_of_view = [1.5, 1.5]
[unloaded]
thickness = 0.5
[material]
c10 = 2.23
c01 = 0.703
[friction]
window = 0.2
sample = 0.2
[grid]
element_size = 0.25
threads = 1
[errors]
estimates = false
[outputs]
write = []
[sample]
motion = """


@pytest.mark.slow
def test_study_takes_a_strain_or_a_file_and_follows_what_is_in_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    loaded = bump()
    np.save("map.npy", loaded.values)
    path = tmp_path / "study.toml"

    def force(motion: str) -> float:
        path.write_text(STUDY + motion)
        maps = read_result(run_study(read_study(path)).folder / "stress.nc").maps
        return float(maps.attrs["sample_force_mN"])

    def again() -> float:
        result = {"np": np}
        exec(reproducing_lines(read_study(path)), result)  # what the report shows
        return float(result["result"].maps.attrs["sample_force_mN"])

    by_strain = force("0.2")
    assert again() == pytest.approx(by_strain, rel=1e-9)
    uniform_motion(loaded, 0.2).to_netcdf("motion.nc", engine="h5netcdf")
    assert force("'motion.nc'") == pytest.approx(by_strain, rel=1e-6)
    assert again() == pytest.approx(by_strain, rel=1e-6)
    uniform_motion(loaded, 0.0).to_netcdf("motion.nc", engine="h5netcdf")
    assert force("'motion.nc'") > 1.2 * by_strain
    uniform_motion(loaded, 0.0).drop_vars("x").to_netcdf("motion.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=r"study.toml, \[sample\]: motion.nc has no variable 'x'"):
        run_study(read_study(path.relative_to(tmp_path)))


@pytest.mark.parametrize("motion", ["'absent.nc'", "2.0", "true", "''"])
def test_study_names_a_motion_that_cannot_be(tmp_path, motion):
    np.save(tmp_path / "map.npy", bump().values)
    path = tmp_path / "study.toml"
    path.write_text(STUDY + motion)
    with pytest.raises(InputError, match=r"sample\.motion"):
        read_study(path)
