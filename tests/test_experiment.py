"""Virtual experiments: layer on a deformable sample."""

import json

import numpy as np
import pytest
import xarray as xr

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.experiment import Scene, read_scene, run_experiment, scene_names, virtual
from optical_palpation.experiment.assembly import build
from optical_palpation.experiment.scene import _random_field, with_compression, with_element_size
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.iteration import NotConverged
from optical_palpation.mechanics.stack.newton import LoadedStack
from optical_palpation.mechanics.stack.problem import LAYER, at_rest
from optical_palpation.palpation import computational_stress
from optical_palpation.thickness import clean_thickness

MATERIAL = MooneyRivlin(2.23, 0.703)


def scene(**changes):
    """A small scene: 2 x 2 mm, 8 x 8 elements; a dotted name changes an entry of a part."""
    content = {
        "compression": 0.15,
        "layer": {"size": (2.0, 2.0), "thickness": 0.5},
        "sample": {"size": (2.0, 2.0), "thickness": 1.0},
        "friction": {"window": 0.0, "sample": 0.0, "plate": 0.0},
        "mesh": {"element_size": 0.25, "layer_elements": 2, "growth": 1.2},
    }
    for name, value in changes.items():
        part, _, entry = name.partition("__")
        if entry:
            content[part][entry] = value
        else:
            content[part] = value
    return Scene.model_validate(content)


RIDGES = ({"kind": "sinusoid", "amplitude": 0.03, "wavelength": 1.3, "direction": 30.0},)
FRICTION = {"window": 0.3, "sample": 0.1, "plate": 0.3}


@pytest.fixture(scope="module")
def rough():
    """A rough sample of uneven stiffness, with friction everywhere."""
    lump = {"kind": "ellipsoid", "factor": 5.0, "centre": (0.7, 1.2, 0.3), "radii": (0.4, 0.5, 0.3)}
    return run_experiment(
        scene(sample__relief=RIDGES, sample__stiffness=(lump,), friction=FRICTION), threads=1
    )


def test_stack_of_one_material_is_compressed_uniformly():
    result = run_experiment(scene(compression=0.3), threads=1)
    stretch = 1 - 0.3 / 1.5
    spread = stretch**-0.5
    # the maps show all of the loaded layer, its unloaded extent is known, and outside is nothing
    maps = result.maps
    layer = (abs(maps["x"] - 1) < spread) & (abs(maps["y"] - 1) < spread)
    assert (maps["loaded_thickness"].notnull() == layer).all()
    assert spread - 0.05 < float(maps["x"].max()) - 1 < spread + 0.05
    assert maps["loaded_thickness"].attrs["layer_extent"] == [0.0, 2.0, 0.0, 2.0]
    loaded = maps.where(layer, drop=True)
    assert np.allclose(loaded["loaded_thickness"], 0.5 * stretch, atol=1e-5)
    stress = MATERIAL.uniaxial_stress(stretch - 1, "true")
    assert np.allclose(loaded["axial_stress"], stress, rtol=1e-3)
    assert np.allclose(loaded["contact_pressure"], -stress, rtol=1e-3)
    assert np.allclose(loaded["traction_x"], 0, atol=1e-3)
    for axis in "xy":
        # nothing holds the stack in place: its strain is known, not its displacement
        strain = loaded[f"sample_displacement_{axis}"].differentiate(axis)
        assert np.allclose(strain, 1 - 1 / spread, atol=1e-4)
    force = -MATERIAL.uniaxial_stress(stretch - 1) * 4.0
    for face in ("window", "sample", "plate"):
        assert result.maps.attrs[f"{face}_force_mN"] == pytest.approx(force, rel=1e-3)
    assert np.allclose(result.sample["cauchy_stress"].sel(tensor="zz"), stress, rtol=1e-3)


def test_a_stack_that_is_hardly_pressed_is_as_stiff_as_its_modulus_says():
    attrs = run_experiment(scene(compression=1e-4), threads=1).maps.attrs
    force = -MATERIAL.uniaxial_stress(-1e-4 / 1.5) * 4.0
    for face in ("window", "sample", "plate"):
        assert attrs[f"{face}_force_mN"] == pytest.approx(force, rel=1e-3)


def test_stiff_sample_and_soft_layer_are_springs_in_series():
    stiff = ({"kind": "box", "factor": 4.0},)
    result = run_experiment(scene(compression=0.01, sample__stiffness=stiff), threads=1)
    modulus = MATERIAL.initial_youngs_modulus
    stress = 0.01 / (0.5 / modulus + 1.0 / (4 * modulus))
    inside = result.maps.sel(x=slice(0.5, 1.5), y=slice(0.5, 1.5))
    assert np.allclose(-inside["axial_stress"], stress, rtol=0.03)
    assert np.allclose(0.5 - inside["loaded_thickness"], 0.5 * stress / modulus, rtol=0.03)


def test_what_the_window_bears_the_sample_and_the_plate_bear(rough):
    assert rough.maps.attrs["force_balance"] < 1e-5
    assert float(rough.maps.attrs["window_force_mN"]) > 1
    # lateral forces on the layer by window and sample balance too
    total, layer = 0.0, rough.layer
    grid = build(rough.scene).bodies[LAYER].grid
    for face, k in (("window", 0), ("sample", -1)):
        area = grid.surface_areas(np.moveaxis(layer["position"].values[k], -1, 0))
        total = total + (layer[f"{face}_traction"].values * area[..., None]).sum((0, 1))
    assert np.abs(total).max() < 1e-3 * rough.maps.attrs["window_force_mN"]


def test_layer_and_sample_do_not_penetrate_one_another(rough):
    # both surfaces meet within the smoothing of the contact wherever they touch
    layer = rough.layer["position"].values[-1]
    sample = rough.sample["position"].values[0]
    closed = rough.layer["sample_contact_state"].values > 0
    assert closed.mean() > 0.9
    from scipy.interpolate import griddata

    height = griddata(sample[..., :2].reshape(-1, 2), sample[..., 2].ravel(), layer[..., :2])
    gap = (height - layer[..., 2])[1:-1, 1:-1][closed[1:-1, 1:-1]]
    assert np.abs(gap).max() < 2e-3  # the surfaces are interpolated differently between nodes
    assert np.abs(np.median(gap)) < 5e-4


@pytest.mark.slow
def test_mirrored_scene_gives_mirrored_maps():
    def run(low, high):
        columns = ({"kind": "box", "factor": 3.0, "x": (low, high), "y": (0.0, 0.75)},)
        return run_experiment(
            scene(sample__stiffness=columns, friction=FRICTION, compression=0.1), threads=1
        ).maps

    left, right = run(0.0, 1.0), run(1.0, 2.0)
    for name, sign in (
        ("axial_stress", 1),
        ("loaded_thickness", 1),
        ("traction_x", -1),
        ("traction_y", 1),
    ):
        scale = float(np.abs(left[name]).max())
        mirrored = sign * right[name].values[:, ::-1]
        assert np.allclose(left[name], mirrored, atol=2e-3 * scale, equal_nan=True), name


@pytest.mark.slow
def test_stiff_sample_acts_as_the_rigid_imprint():
    stiff = ({"kind": "box", "factor": 2000.0},)
    result = run_experiment(
        scene(
            sample__size=(2.8, 2.8),  # so that the layer has nothing to bulge over
            sample__relief=RIDGES,
            sample__stiffness=stiff,
            friction={"window": 0.2, "sample": 0.1, "plate": 0.3},
            mesh__layer_elements=3,
        ),
        threads=1,
    )
    recovered = computational_stress(
        clean_thickness(result.maps["loaded_thickness"])["thickness"],
        0.5,
        MATERIAL,
        window_friction=0.2,
        sample_friction=0.1,
        element_size=(0.25, 0.25, 0.5 / 3),
        imprint_smoothing=0.0,
        threads=1,
        edge_check=False,
        input_errors=None,
    )
    assert recovered.maps.attrs["window_force_mN"] == pytest.approx(
        result.maps.attrs["window_force_mN"], rel=0.01
    )
    inside = {"x": slice(0.5, 1.5), "y": slice(0.5, 1.5)}
    true = result.maps["axial_stress"].interp_like(recovered.maps["axial_stress"]).sel(inside)
    error = recovered.maps["axial_stress"].sel(inside) - true
    assert float(np.sqrt((error**2).mean() / (true**2).mean())) < 0.02


@pytest.mark.slow
def test_a_stiff_cube_is_pressed_to_the_end():
    """Under its edges linear systems are hard, and steps that do not solve them lead nowhere."""
    cube = with_element_size(read_scene("cube_on_plate"), 0.075)
    attrs = run_experiment(cube, threads=1).maps.attrs
    assert attrs["newton_iterations"] < 30
    assert attrs["force_balance"] < 1e-4


@pytest.mark.slow
def test_smaller_sample_leaves_the_rest_of_the_layer_alone():
    result = run_experiment(
        scene(
            sample__size=(1.0, 1.0),
            sample__stiffness=({"kind": "box", "factor": 30.0},),
            friction=FRICTION,
            mesh__element_size=0.125,
        ),
        threads=1,
    )
    maps = result.maps
    outside = maps.sel(x=slice(0.0, 0.25), y=slice(0.0, 2.0))
    assert np.allclose(outside["contact_pressure"], 0, atol=0.02)
    assert (outside["contact_state"] == 0).all()
    middle = maps["loaded_thickness"].sel(y=1.0, method="nearest")
    assert float(middle.sel(x=1.0, method="nearest")) == pytest.approx(0.36, abs=0.015)
    # pushed aside above the sample, the layer curls off the window at its ends
    assert 0.48 < float(middle.sel(x=0.1, method="nearest")) < 0.5
    assert (maps["window_contact_state"].sel(x=slice(0.0, 0.05)) == 0).any()
    assert maps.attrs["force_balance"] < 1e-5


def test_free_edge_that_rolls_onto_the_window_takes_few_iterations():
    """Many nodes turn round there: friction must not swing, nor a side snap down and jam."""
    result = run_experiment(
        scene(
            compression=0.5,
            layer__size=(1.0, 1.0),
            sample__size=(1.0, 1.0),
            friction=FRICTION,
            mesh__element_size=0.125,
            mesh__layer_elements=4,
        ),
        threads=1,
    )
    record = json.loads(result.maps.attrs["convergence"])
    assert max(entry["newton"] for entry in record) <= 8
    assert len(record) <= 6
    z = result.layer["position"].sel(component="z").values
    assert z[1:-1].min() > 0  # no side goes through the window
    assert result.maps.attrs["force_balance"] < 1e-5


@pytest.mark.slow
def test_path_begun_on_a_coarse_mesh_ends_where_the_whole_path_on_the_fine_one_does(monkeypatch):
    rough = scene(
        compression=0.3, friction=FRICTION, sample__relief=RIDGES, mesh__element_size=0.125
    )
    inside = {"x": slice(0.25, 1.75), "y": slice(0.25, 1.75)}
    whole = run_experiment(rough, threads=1).maps.sel(inside)
    monkeypatch.setattr(virtual, "_COARSEST", 500)
    begun = run_experiment(rough, threads=1).maps.sel(inside)
    assert len({entry["elements"] for entry in json.loads(begun.attrs["convergence"])}) == 2
    difference = begun["loaded_thickness"] - whole["loaded_thickness"]
    assert float(np.sqrt((difference**2).mean())) < 1.5e-4
    error = begun["axial_stress"] - whole["axial_stress"]
    assert float(np.sqrt((error**2).mean() / (whole["axial_stress"] ** 2).mean())) < 2e-3


@pytest.mark.slow
def test_sinusoid_agrees_with_the_published_simulation(shared_data):
    """Figure 3a: an independent code, on elements of the same size."""
    published = np.load(shared_data / "layers/sinusoid_simulated_L1.npz")
    x, y = published["x_mm"], published["y_mm"]
    inner = np.ix_((y >= 0.5) & (y <= 4.5), (x >= 0.5) & (x <= 4.5))
    theirs = published["L1_mm"][inner]
    thickness = run_experiment(read_scene("sinusoid")).maps["loaded_thickness"]
    ours = thickness.interp(x=x, y=y).values[inner]
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 3e-3
    assert abs((ours - theirs).mean()) < 1e-3
    along = theirs.mean(0)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(along)))) + 1
    assert turns.size >= 7
    assert np.abs(ours - theirs)[:, turns].max() < 6e-3


def test_forces_of_the_interface_balance_and_so_do_their_moments():
    assembly = build(scene(sample__relief=RIDGES, friction=FRICTION))
    state = at_rest(assembly)
    u = state.u.copy()
    u[assembly.bodies[LAYER].n_nodes :] += (0.031, -0.017, -0.06)
    position = assembly.position(u)
    projection = assembly.project(position, 0.0)[1]
    assert np.allclose(projection.weights.sum(1), 0, atol=1e-12)
    assert np.allclose(projection.lateral(position), 0, atol=1e-9)


def test_a_soft_sample_carries_the_layer_outwards_and_a_stiff_one_holds_it():
    """Which of the two spreads more decides the sense of friction (section 4 of the paper)."""

    def outward(factor):
        stiffness = ({"kind": "box", "factor": factor},)
        maps = run_experiment(
            scene(
                sample__size=(2.8, 2.8),
                sample__stiffness=stiffness,
                friction={"window": 0.3, "sample": 0.1, "plate": 0.0},
                compression=0.2,
            ),
            threads=1,
        ).maps
        drag = (maps["traction_x"] * np.sign(maps["x"] - 1.0)).sum()
        return float(drag / maps["contact_pressure"].sum())

    assert outward(0.3) > 0.01
    assert -0.1 < outward(30.0) < -0.02


def test_random_fields_do_not_depend_on_the_mesh_and_have_unit_variance():
    axis = np.linspace(0.0, 20.0, 201)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    field = _random_field((y, x), 0.6, seed=3)
    assert field.std() == pytest.approx(1.0, abs=0.1)
    assert np.mean(field[6:] * field[:-6]) / np.var(field) == pytest.approx(np.exp(-1), abs=0.06)
    assert np.allclose(field[::4, ::4], _random_field((y[::4, ::4], x[::4, ::4]), 0.6, seed=3))


def test_arrays_act_as_entries_of_the_scene():
    x = np.linspace(0.0, 2.0, 41)
    ramp = np.broadcast_to(0.02 * (x - 1), (41, 41))
    relief = xr.DataArray(ramp, {"y": x, "x": x}, ("y", "x"))
    factor = xr.DataArray(
        np.where(x < 1.0, 3.0, 1.0) * np.ones((2, 41, 1)),
        {"z": [0.0, 1.0], "y": x, "x": x},
        ("z", "y", "x"),
    )
    held = scene(compression=0.05, friction=FRICTION)
    result = run_experiment(held, relief=relief, stiffness=factor, threads=1)
    stiffness = result.sample["stiffness"].values
    assert set(np.unique(stiffness)) == {1.0, 3.0}
    assert (stiffness[..., :4] == 3.0).all()
    top = result.sample["position"].values[0] - result.sample["displacement"].values[0]
    assert top[4, 0, 2] - top[4, -1, 2] == pytest.approx(0.04)


def test_shipped_scenes_are_whole():
    assert set(scene_names()) == {
        "cube_on_plate",
        "nodule",
        "random_tissue",
        "relief",
        "sinusoid",
        "soft_stiff_columns",
    }
    for name in scene_names():
        assembly = build(with_element_size(read_scene(name), 0.1))
        assert np.isfinite(assembly.bodies[1].nodes).all()
        assert (assembly.bodies[1].stiffness > 0).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("compression = ", "no valid TOML"),
        ("compression = -1.0", "compression"),
        ("speed = 3", "speed"),
        ("[layer]\nsize = [1.0]", "layer.size"),
        ("[layer]\nsize = [1.0, nan]", "layer.size"),
        ("[[sample.relief]]\nkind = 'hill'", "relief"),
        ("[friction]\nwindow = -0.1", "friction.window"),
        ("[friction]\nwindow = 9.0", "friction.window"),
        ("[mesh]\nelement_size = 0", "mesh.element_size"),
        ("compression = true", "compression"),
        ("compression = '0.1'", "compression"),
        ("compression = " + "[" * 5000, "no valid TOML"),
    ],
)
def test_bad_scene_files_are_named(tmp_path, text, message):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_scene(path)
    assert str(path) in str(error.value)


def test_other_travels_of_a_scene():
    assert with_compression(read_scene("sinusoid"), 0.2).compression == 0.2
    for wrong in (0.0, -0.1, np.nan):
        with pytest.raises(InputError, match="compression must be a positive number in mm"):
            with_compression(read_scene("sinusoid"), wrong)


def test_the_highest_point_between_two_nodes_touches_first():
    """Where layer and sample meet does not depend on where the nodes are."""
    ridge = {"kind": "sinusoid", "amplitude": 0.1, "wavelength": 2.0, "phase": 36.0}
    scene = Scene.model_validate(
        {
            "compression": 0.2,
            "layer": {"size": (2.0, 2.0)},
            "sample": {"size": (2.0, 2.0), "thickness": 1.0, "relief": (ridge,)},
            "mesh": {"element_size": 0.5},
        }
    )
    for size in (0.5, 0.2):
        stack = build(with_element_size(scene, size))
        assert stack.plate == pytest.approx(0.5 + 0.1 + 1.0, abs=1e-3)


def test_unknown_scene_lists_the_known():
    with pytest.raises(InputError, match="sinusoid"):
        read_scene("sinus")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mesh__element_size": 0.9}, "element_size"),
        ({"compression": 1.4}, "compression"),
        ({"sample__c10": -5.0}, "unstable"),
        ({"sample__c10": 2e5}, "10000"),
        (
            {"sample__relief": ({"kind": "sinusoid", "amplitude": 2.0, "wavelength": 1.0},)},
            "relief",
        ),
        ({"sample__relief": ({"kind": "file", "path": "missing.nc"},)}, "missing.nc"),
        ({"sample__stiffness": ({"kind": "file", "path": "missing.nc"},)}, "missing.nc"),
        (
            {"sample__relief": ({"kind": "sinusoid", "amplitude": 0.01, "wavelength": 1e-3},)},
            "wavelength of 0.001 mm is too short",
        ),
        ({"pixel_spacing": 10.0}, "pixel_spacing: 10 mm must lie between"),
        ({"pixel_spacing": 1e-5}, "pixel_spacing"),
        (
            {"sample__relief": ({"kind": "random", "rms": 0.01, "correlation_length": 1e-5},)},
            "correlation_length",
        ),
    ],
)
def test_scenes_that_cannot_be_computed(changes, message):
    with pytest.raises(InputError, match=message):
        run_experiment(scene(**changes), threads=1)


def test_bad_arrays():
    flat = xr.DataArray(np.zeros((2, 2)), {"y": [0.0, 1.0], "x": [0.0, 1.0]}, ("y", "x"))
    with pytest.raises(InputError, match="positive"):
        run_experiment(scene(), stiffness=flat, threads=1)
    with pytest.raises(InputError, match="missing"):
        run_experiment(scene(), relief=flat * np.nan, threads=1)
    with pytest.raises(InputError, match="y, x"):
        run_experiment(scene(), relief=flat.rename(x="u"), threads=1)
    with pytest.raises(InputError, match="threads"):
        run_experiment(scene(), threads=0)


def test_compression_out_of_reach_says_how_far_it_came(monkeypatch):
    """Loads above 0.3 fail here, so that the path must halve its steps and give up near there."""
    equilibrate = LoadedStack.equilibrate

    def fails_late(self, state, *arguments):
        if state.load > 0.3:
            raise NotConverged("an element turned inside out")
        return equilibrate(self, state, *arguments)

    monkeypatch.setattr(LoadedStack, "equilibrate", fails_late)
    with pytest.raises(ConvergenceError, match=r"to (29\.\d|30\.0) % of 0\.05 mm only: an element"):
        run_experiment(scene(compression=0.05, friction=FRICTION), threads=1)
    with pytest.raises(ConvergenceError, match="Nothing holds the layer and the sample sideways"):
        run_experiment(scene(compression=0.05), threads=1)


def test_files_of_a_result(rough, tmp_path):
    from optical_palpation.present.experiment import (
        write_bodies,
        write_experiment,
        write_experiment_figure,
    )
    from optical_palpation.thickness import read_thickness_map

    path = tmp_path / "experiment.nc"
    write_experiment(rough, path)
    maps = xr.load_dataset(path, engine="h5netcdf")
    assert np.allclose(maps["axial_stress"], rough.maps["axial_stress"], equal_nan=True)
    assert json.loads(maps.attrs["scene"])["compression"] == 0.15
    assert maps["axial_stress"].attrs["units"] == "kPa"
    sample = xr.load_dataset(path, engine="h5netcdf", group="sample")
    assert np.allclose(sample["stiffness"], rough.sample["stiffness"], rtol=1e-6)
    thickness = read_thickness_map(path, variable="loaded_thickness")
    assert np.allclose(thickness, rough.maps["loaded_thickness"], equal_nan=True)

    write_bodies(rough, tmp_path / "layer.vts", tmp_path / "sample.vts")
    assert (tmp_path / "sample.vts").read_text().startswith("<?xml")
    write_experiment_figure(rough, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@pytest.mark.filterwarnings("error:constrained_layout")  # a picture without a layout
def test_command(tmp_path, capsys):
    from optical_palpation.cli import main

    path = tmp_path / "scene.toml"
    path.write_text(
        "compression = 0.05\n[layer]\nsize = [1.0, 1.0]\n[sample]\nsize = [1.0, 1.0]\n"
        "thickness = 0.5\n[mesh]\nelement_size = 0.25\nlayer_elements = 2\n"
    )
    arguments = ["experiment", str(path), "--output", str(tmp_path / "out"), "--threads", "1"]
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert not exit_.value.code
    assert "force at window" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "experiment.nc",
        "experiment.png",
        "layer.vts",
        "sample.vts",
    }
    with pytest.raises(SystemExit) as exit_:
        main(["experiment", "nowhere.toml", "--output", str(tmp_path / "other")])
    assert exit_.value.code == 2
    assert not (tmp_path / "other").exists()
