"""Stress on a sample that nobody tracked, and its stiffness."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
import xarray as xr
from scipy.sparse.linalg import norm as spnorm
from scipy.sparse.linalg import spsolve

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.experiment import Scene, run_experiment
from optical_palpation.mechanics.iteration import TOLERANCES, relaxed
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh, assemble
from optical_palpation.mechanics.stack.cascade import solve
from optical_palpation.mechanics.stack.newton import balance, equilibrate, make_solver
from optical_palpation.mechanics.stack.problem import INTERFACE, SAMPLE
from optical_palpation.mechanics.stack.tangent import Tangent, stiffness_forces
from optical_palpation.palpation import InputErrors, computational_stress
from optical_palpation.present import read_result, summarise, write_result
from optical_palpation.stiffness import Sample, inversion, sample_stress
from optical_palpation.stiffness.errors import propagated
from optical_palpation.stiffness.forward import Columns, Model, Pressed, Sought, meshes_of
from optical_palpation.stiffness.inversion import first, invert
from optical_palpation.stiffness.measurement import ThicknessSurface
from optical_palpation.stiffness.sample import check_sample
from optical_palpation.stiffness.stress import _columns, _models
from optical_palpation.thickness import clean_thickness, thickness_map

FRICTION = {"window": 0.3, "sample": 0.1, "plate": 0.3}


def scene(*stiffness, compression=0.3, **sample):
    """A small scene, on other elements than those of the inversion."""
    return Scene.model_validate(
        {
            "compression": compression,
            "layer": {"size": (3.0, 3.0), "thickness": 0.5},
            "sample": {"size": (3.0, 3.0), "thickness": 1.0, "stiffness": stiffness, **sample},
            "friction": FRICTION,
            "mesh": {"element_size": 0.15},
            "pixel_spacing": 0.05,
        }
    )


def measured(result, noise=1e-3):
    maps, layer = result.maps, result.scene.layer
    values = maps["loaded_thickness"].values
    values = values + noise * np.random.default_rng(0).normal(size=values.shape)
    return thickness_map(
        values,
        x=maps["x"].values,
        y=maps["y"].values,
        layer_extent=(0.0, layer.size[0], 0.0, layer.size[1]),
    )


def cleaned(result):
    return clean_thickness(measured(result))["thickness"]


def known(result, **changed):
    """What is known of the sample of an experiment."""
    of = result.scene
    sample = Sample(of.sample.thickness, of.compression, of.friction.plate, law=of.sample.material)
    return replace(sample, **changed)


def computed(result, sample=None, loaded=None, **options):
    friction = result.scene.friction
    arguments = {
        "window_friction": friction.window,
        "sample_friction": friction.sample,
        "element_size": 0.1875,
        "input_errors": None,
        "initial_thickness": result.scene.layer.thickness,
    }
    return sample_stress(
        measured(result) if loaded is None else loaded,
        material=result.scene.layer.material,
        sample=sample or known(result),
        **(arguments | options),
    )


def error(maps, truth, margin=0.5):
    """Relative error of the axial stress (root mean square), ``margin`` mm from the sides."""
    true = truth["axial_stress"].interp(x=maps["x"], y=maps["y"])
    end = float(maps["x"][-1]) - margin
    inside = {axis: slice(margin, end) for axis in "xy"}
    true, here = true.sel(inside), maps["axial_stress"].sel(inside)
    return float(np.sqrt(((here - true) ** 2).mean() / (true**2).mean()))


@pytest.fixture(scope="module")
def columns():
    return run_experiment(scene({"kind": "box", "factor": 3.0, "x": [1.5, 3.0]}))


@pytest.fixture(scope="module")
def found(columns):
    return computed(columns, input_errors=InputErrors())


@pytest.mark.slow
def test_stress_force_and_stiffness_of_soft_and_stiff_columns(columns, found):
    maps, truth = found.maps, columns.maps
    still = computational_stress(
        cleaned(columns),
        0.5,
        columns.scene.layer.material,
        window_friction=0.3,
        sample_friction=0.1,
        element_size=0.1875,
        edge_check=False,
        input_errors=None,
    )
    assert error(maps, truth) < 0.04
    assert error(still.maps, truth) > 0.3
    assert maps.attrs["window_force_mN"] == pytest.approx(truth.attrs["window_force_mN"], rel=0.02)
    modulus = maps["sample_shear_modulus"].sel(y=slice(0.5, 2.5))
    soft, stiff = (float(modulus.sel(x=slice(*ends)).mean()) for ends in ((0.5, 1.1), (1.9, 2.5)))
    mu = columns.scene.sample.material.shear_modulus
    assert soft == pytest.approx(mu, rel=0.03)
    assert stiff / soft == pytest.approx(3.0, rel=0.05)
    # where it passes the middle between the two
    row = modulus.mean("y").values
    edge = np.interp(np.sqrt(soft * stiff), row[3:-3], modulus["x"].values[3:-3])
    assert edge == pytest.approx(1.5, abs=0.15)


def test_modulus_of_a_uniform_sample():
    truth = run_experiment(scene())
    maps = computed(truth).maps
    modulus = maps["sample_shear_modulus"].sel(x=slice(0.5, 2.5), y=slice(0.5, 2.5))
    mu = truth.scene.sample.material.shear_modulus
    assert float(np.abs(modulus / mu - 1).max()) < 0.03
    assert maps.attrs["window_force_mN"] == pytest.approx(
        truth.maps.attrs["window_force_mN"], rel=0.02
    )


@pytest.mark.slow
def test_bands_contain_the_truth_and_widen_with_the_errors_of_the_inputs(columns, found):
    maps = found.maps
    true = columns.maps["axial_stress"].interp(x=maps["x"], y=maps["y"])
    inside = {axis: slice(0.5, 2.5) for axis in "xy"}
    off = np.abs(maps["axial_stress"] - true).sel(inside)
    band = maps["axial_stress_error"].sel(inside)
    assert float((off < band).mean()) > 0.9
    exact = computed(columns).maps["axial_stress_error"].sel(inside)
    assert float(exact.mean()) < float(band.mean())
    assert maps.attrs["force_error_mN"] > 0


def test_errors_of_the_mesh_do_not_cancel_in_the_band_of_the_force():
    """What large elements do to the stiffness nearly hides what they do to the stress."""
    truth = run_experiment(scene({"kind": "box", "factor": 3.0}, compression=0.2))
    attrs = computed(truth, element_size=0.3).maps.attrs
    off = attrs["window_force_mN"] - truth.maps.attrs["window_force_mN"]
    assert abs(off) < attrs["force_error_mN"]


@pytest.mark.slow
def test_band_of_the_force_of_large_elements_at_large_compression():
    of = scene(compression=0.525)
    of = of.model_copy(update={"mesh": of.mesh.model_copy(update={"element_size": 0.1})})
    truth = run_experiment(of)
    attrs = computed(truth, element_size=0.3).maps.attrs
    off = attrs["window_force_mN"] - truth.maps.attrs["window_force_mN"]
    assert 0.1 * attrs["window_force_mN"] < abs(off) < attrs["force_error_mN"]


@pytest.fixture(scope="module")
def stopped():
    """A search that stopped within the tolerance of the misfit, its coarse model and its map."""
    truth = run_experiment(scene({"kind": "box", "factor": 0.6}))
    blocks, surface = _blocks(truth.scene), ThicknessSurface.fitted(measured(truth), 0.25)
    fine, coarse = _models(blocks, Mesh(0.25), _columns(blocks, 0.25), 0.5)
    start = Sought(np.full(fine.columns.shape, -0.3), (0.3,))
    return invert(fine, coarse, [surface], start), fine, coarse, surface


def test_the_coarse_mesh_tells_the_error_by_the_volume_of_its_elements(stopped):
    estimate, fine, coarse, _ = stopped
    assert (fine.layer.shape[0], coarse.layer.shape[0]) == (3, 2)
    assert fine.layer.spacing[2] == pytest.approx(0.5 * coarse.layer.spacing[2])
    assert 1.5**2 - 1 < estimate.refinement < 2**2 - 1


def test_bands_hold_what_a_search_leaves_unfinished(stopped):
    """Another search, for a little other input, stops elsewhere within the tolerance."""
    estimate, fine, coarse, surface = stopped
    (before,), row = estimate.pressed, estimate.order.row(estimate.sought)
    (after,) = fine.pressed(estimate.order.read(row + estimate.unfinished))
    told = float(estimate.sensitivities[0].force @ estimate.unfinished)
    assert after.force - before.force == pytest.approx(told, rel=0.5)
    nothing = replace(estimate, unfinished=0 * estimate.unfinished)
    bands, without = (
        propagated(each, coarse, [surface], None, lambda *_: None) for each in (estimate, nothing)
    )
    both = bands.loads[0].force, np.hypot(without.loads[0].force, told)
    assert both[0] == pytest.approx(both[1])
    assert (bands.stiffness >= np.abs(estimate.unfinished).reshape(bands.stiffness.shape)).all()


@pytest.mark.slow
def test_total_force_in_place_of_the_travel(columns, found):
    """It finds the travel; given beside a travel that contradicts it, it is refused."""
    force = columns.maps.attrs["window_force_mN"]
    sample = known(columns, compression=None, total_force=force)
    maps = computed(columns, sample, input_errors=InputErrors()).maps
    attrs = maps.attrs
    assert attrs["window_force_mN"] == pytest.approx(force, rel=0.02)
    assert abs(attrs["compression_mm"] - 0.3) < attrs["compression_error_mm"]
    assert error(maps, columns.maps) < 0.06
    with pytest.raises(ConvergenceError, match="contradict each other"):
        computed(columns, known(columns, total_force=2 * force), element_size=0.3)


def test_a_total_force_beyond_its_error_is_doubted_and_is_told(columns):
    options = {"element_size": 0.3}
    attrs = computed(columns, **options).maps.attrs
    force, band = attrs["window_force_mN"], attrs["force_error_mN"]
    assert "total_force_given_mN" not in attrs
    for share, doubted in ((0.5, False), (0.97, True)):
        given = (force + share * band) / (1 - share * 0.05)
        result = computed(columns, known(columns, total_force=given), **options)
        assert ("and the one given" in summarise(result)) == doubted
        assert f"; given {given:g} mN" in summarise(result)


def test_inputs_that_the_bands_leave_out_are_told(columns, monkeypatch):
    change = Model.changed

    def sometimes(model, **changed):
        if "friction" in changed and changed["friction"][1] != 0.1:
            raise LoadNotReached(0.5, "it stagnates")
        return change(model, **changed)

    monkeypatch.setattr(Model, "changed", sometimes)
    errors = InputErrors.parsed(["modulus=0", "thickness=0", "initial_thickness=0"])
    result = computed(columns, element_size=0.3, input_errors=errors)
    assert json.loads(result.maps.attrs["error_bands"])["sample_friction"]["force_mN"] is None
    assert "the bands leave out the error of sample friction: with" in summarise(result)


@pytest.mark.parametrize("compression", [0.15, 0.5])
def test_a_total_force_is_met_by_the_travel_that_was(compression):
    """Many nodes do not outvote one force, nor is it met by a travel that is far too large."""
    column = {"kind": "box", "factor": 3.0, "x": [1.0, 3.0]}
    of = scene(*[column] * (compression < 0.3), compression=compression)
    of = of.model_copy(update={"mesh": of.mesh.model_copy(update={"element_size": 0.2})})
    truth = run_experiment(of)
    force = truth.maps.attrs["window_force_mN"]
    maps = computed(truth, known(truth, compression=None, total_force=force)).maps
    assert maps.attrs["window_force_mN"] == pytest.approx(force, rel=0.02)
    assert maps.attrs["compression_mm"] == pytest.approx(compression, rel=0.05)
    assert error(maps, truth.maps) < 0.05


@pytest.fixture(scope="module")
def pressed_twice():
    """Two loads of a sample of unknown relief, of which one half is three times as stiff."""
    column = {"kind": "box", "factor": 3.0, "x": [1.5, 3.0]}
    relief = ({"kind": "random", "rms": 0.02, "correlation_length": 0.7, "seed": 3},)
    return [run_experiment(scene(column, compression=t, relief=relief)) for t in (0.15, 0.3)]


@pytest.fixture(scope="module")
def series(pressed_twice):
    sample = known(pressed_twice[-1], compression=(0.15, 0.3))
    loads = [measured(result) for result in pressed_twice]
    return computed(pressed_twice[-1], sample, loaded=loads, input_errors=InputErrors())


@pytest.mark.slow
def test_two_loads_tell_relief_from_stiffness(pressed_twice, series):
    maps, truth = series.maps, pressed_twice[-1].maps
    taken_as_flat = computed(pressed_twice[-1]).maps
    assert error(maps, truth) < 0.07
    assert error(taken_as_flat, truth) > 1.5 * error(maps, truth)
    x, y = np.meshgrid(maps["x"], maps["y"])
    (part,) = pressed_twice[-1].scene.sample.relief
    inside = {axis: slice(0.5, 2.5) for axis in "xy"}
    true = xr.DataArray(part.height(x, y), maps["sample_relief"].coords).sel(inside)
    found, band = (maps[f"sample_relief{end}"].sel(inside) for end in ("", "_error"))
    off = found - true
    assert float(off.std()) < 0.35 * float(true.std())
    assert float((np.abs(off - off.mean()) < band).mean()) > 0.9
    modulus = maps["sample_shear_modulus"].sel(y=slice(0.5, 2.5))
    soft, stiff = (float(modulus.sel(x=slice(*ends)).mean()) for ends in ((0.5, 1.1), (1.9, 2.5)))
    assert stiff / soft == pytest.approx(3.0, rel=0.2)
    assert maps.attrs["sample_relief"] == "found"


def test_a_series_has_the_stress_and_the_force_of_each_load(pressed_twice, series, tmp_path):
    for n, result in enumerate(pressed_twice, start=1):
        here = series.series.sel(load=n)
        assert error(here, result.maps) < 0.1
        force = result.maps.attrs["window_force_mN"]
        assert float(here["window_force"]) == pytest.approx(force, rel=0.06)
        assert abs(float(here["window_force"]) - force) < float(here["force_error"])
    np.testing.assert_array_equal(series.series["compression"], [0.15, 0.3])
    last = series.series.isel(load=-1)["axial_stress"]
    np.testing.assert_array_equal(last, series.maps["axial_stress"])
    write_result(series, tmp_path / "series.nc")
    again = read_result(tmp_path / "series.nc").series
    xr.testing.assert_allclose(again["axial_stress"], series.series["axial_stress"])
    assert again["axial_stress"].attrs["units"] == "kPa"
    words = summarise(series)
    assert "loads: 0.15 mm" in words
    assert "relief of the sample, found" in words


def test_nearly_rigid_sample_is_an_imprint():
    """Nothing can be said of its stiffness, and the stress is that of the layer alone."""
    relief = ({"kind": "sinusoid", "amplitude": 0.05, "wavelength": 1.5},)
    stiff = {"kind": "box", "factor": 500.0}
    result = run_experiment(scene(stiff, compression=0.12, relief=relief))
    x = np.linspace(0, 3, 121)
    height = xr.DataArray(
        np.tile(0.05 * np.sin(2 * np.pi * x / 1.5), (x.size, 1)), {"y": x, "x": x}, ("y", "x")
    )
    sample = known(result, relief=height)
    maps = computed(result, sample, loaded=cleaned(result)).maps
    assert maps.attrs["sample_rigid"] == "yes"
    assert error(maps, result.maps) < 0.05
    assert np.isnan(maps["sample_shear_modulus"]).all()


@pytest.fixture(scope="module")
def uneven():
    """A soft sample of known relief, and that relief."""
    result = run_experiment(
        scene(compression=0.25, relief=({"kind": "sinusoid", "amplitude": 0.05, "wavelength": 3},))
    )
    x = np.linspace(0, 3, 121)
    height = np.tile(0.05 * np.sin(2 * np.pi * x / 3), (x.size, 1))
    return result, xr.DataArray(height, {"y": x, "x": x}, ("y", "x"))


def test_a_relief_may_be_on_descending_coordinates(uneven):
    result, relief = uneven
    up, down = (
        computed(result, known(result, relief=each), element_size=0.3).maps["axial_stress"]
        for each in (relief, relief[::-1, ::-1].T)
    )
    np.testing.assert_array_equal(up, down)


def test_noise_of_the_unloaded_surfaces_is_not_where_they_touch_first():
    """Of many pixels the one that is off most would decide how far the sample was pressed."""
    result = run_experiment(scene())
    x = np.linspace(0, 3, 121)
    noise = 5e-3 * np.random.default_rng(3).normal(size=(2, x.size, x.size))
    unloaded, relief = (xr.DataArray(part, {"y": x, "x": x}, ("y", "x")) for part in noise)
    still = known(result, relief=xr.zeros_like(relief))
    modulus = [
        computed(result, sample, initial_thickness=0.5 + factor * unloaded, element_size=0.3).maps[
            "sample_youngs_modulus"
        ]
        for sample, factor in ((still, 0), (still, 1), (known(result, relief=relief), 0))
    ]
    exact, *others = (float(each.median()) for each in modulus)
    assert others == pytest.approx([exact, exact], rel=0.06)


def test_a_plate_that_moves_less_than_the_layer_gives_way_is_refused(uneven):
    """Even where a relief leaves room for the median: that is no rigid sample."""
    result, relief = uneven
    with pytest.raises(InputError, match=r"more than a compression of 0\.06 mm and the relief"):
        computed(result, known(result, relief=relief, compression=0.06), element_size=0.3)


def test_a_rigid_sample_keeps_the_errors_and_the_force_that_are_given():
    result = run_experiment(scene({"kind": "box", "factor": 500.0}, compression=0.1))
    loaded = cleaned(result)
    errors = InputErrors(window_friction=0.2)
    attrs = computed(result, loaded=loaded, element_size=0.3, input_errors=errors).maps.attrs
    assert attrs["sample_rigid"] == "yes"
    assert json.loads(attrs["input_errors"])["window_friction"] == 0.2
    wrong = known(result, total_force=2 * attrs["window_force_mN"])
    with pytest.raises(ConvergenceError, match="contradict each other"):
        computed(result, wrong, loaded=loaded, element_size=0.3)


def test_noise_is_no_contact(uneven):
    """Half of what nothing touches is thinner by noise: that says nothing of the sample."""
    result, relief = uneven
    exact = measured(result)
    noise = 1e-3 * np.random.default_rng(1).normal(size=exact.shape)
    for known_relief in (relief, None):
        with pytest.raises(InputError, match="does not touch"):
            computed(result, known(result, relief=known_relief), exact.copy(data=0.5 + noise))


def test_what_was_not_measured_counts_for_nothing(columns):
    """It is no misfit, and neither the stiffness there nor its band is given."""
    loaded = measured(columns)
    part = loaded.where(loaded["x"] > 1.5)
    maps = computed(columns, loaded=part, element_size=0.25).maps
    assert maps["thickness_misfit"].sel(x=slice(None, 1.4)).isnull().all()
    for name in ("sample_youngs_modulus", "sample_modulus_error"):
        assert maps[name].sel(x=slice(None, 0.9)).isnull().all()
        assert maps[name].sel(x=slice(1.5, 2.5), y=slice(0.5, 2.5)).notnull().all()
    assert maps.attrs["misfit_over_tolerance"] < 3
    (warning,) = json.loads(maps.attrs["unusual"])
    assert "was not measured" in warning


@pytest.mark.parametrize("wrong", [{"thickness": 2.0}, {"compression": 0.8}, {"compression": 1.1}])
def test_a_model_that_does_not_fit_is_said(columns, wrong):
    """What is known of the sample is off by these factors, which no stiffness makes good.

    A compression that is off by 1.2 or more is made good by a softer sample.
    """
    of = known(columns)
    stated = {key: factor * getattr(of, key) for key, factor in wrong.items()}
    result = computed(columns, known(columns, **stated), element_size=0.25)
    (warning,) = json.loads(result.maps.attrs["unusual"])
    assert "noise and mesh explain" in warning
    assert f"WARNING: {warning}" in summarise(result)


def test_a_model_that_fits_is_not_doubted(columns):
    assert not json.loads(computed(columns, element_size=0.25).maps.attrs["unusual"])


def test_a_sample_that_does_not_fit_is_refused_with_its_place(columns):
    hollow = columns.maps["loaded_thickness"].copy()
    hollow.values[25:35, 25:35] -= 0.2
    other = replace(columns, maps=columns.maps.assign(loaded_thickness=hollow))
    with pytest.raises(ConvergenceError, match=r"no stiffness .* x = 1\.\d+, y = 1\.\d+ mm"):
        computed(other, element_size=0.3)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"thickness": -1.0}, "thickness must be positive"),
        ({"thickness": float("nan")}, "thickness must be a number"),
        ({"compression": 0.0}, "compression, 0 mm, must be positive"),
        ({"compression": 2.0}, "more than layer and sample together"),
        ({"compression": 0.01}, "the plate cannot have moved less"),
        ({"compression": 1.2}, "the rest is more than 70%"),
        ({"plate_friction": 3.0}, "plate_friction must lie in"),
        ({"compression": None}, "give the compression"),
        ({"compression": None, "total_force": -1.0}, "total force, -1 mN, must be positive"),
        ({"compression": None, "total_force": 0.05}, "total force, 0.05 mN, is far from"),
        ({"compression": None, "total_force": 5e4}, "total force, 50000 mN, is far from"),
        ({"compression": (0.2, 0.3)}, "2 values of the compression for 1 maps"),
        ({"relief": "bumpy"}, "a map or .flat., not 'bumpy'"),
    ],
)
def test_samples_that_cannot_be_are_refused(columns, changed, match):
    loaded = measured(columns)
    unloaded = xr.full_like(loaded, 0.5)
    with pytest.raises(InputError, match=match):
        check_sample(known(columns, **changed), loaded, unloaded, columns.scene.layer.material)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"compression": (0.3, 0.2)}, "must rise from map to map.*order of loading"),
        ({"compression": (0.299, 0.3)}, "must rise from map to map, by 2%"),
        ({"compression": (0.01, 0.3), "relief": "flat"}, "compression of load 1 of 0.01 mm"),
        ({"compression": (0.2, 2.0)}, "compression of load 2, 2 mm, is more than"),
        ({"compression": None, "total_force": (20.0, 60.0)}, "do not tell relief from stiffness"),
    ],
)
def test_series_that_cannot_be_are_refused(columns, changed, match):
    loaded = measured(columns)
    unloaded = xr.full_like(loaded, 0.5)
    with pytest.raises(InputError, match=match):
        check_sample(
            known(columns, **changed), [loaded, loaded], unloaded, columns.scene.layer.material
        )
    part = loaded.sel(x=slice(0.0, 2.0))
    with pytest.raises(InputError, match=r"map 1 of 2 shows a layer of x 0 to 1\.95"):
        check_sample(
            known(columns, compression=(0.2, 0.3)),
            [part, loaded],
            unloaded,
            columns.scene.layer.material,
        )


def test_maps_that_are_not_in_the_order_of_loading_are_refused(columns):
    """Unless they differ by no more than a thickness is known to."""
    last = measured(columns)
    first, unloaded = last + 0.5 * (0.5 - last), xr.full_like(last, 0.5)
    law = columns.scene.layer.material
    for what in ({"compression": (0.2, 0.3)}, {"compression": None, "total_force": (20.0, 50.0)}):
        sample = known(columns, relief="flat", **what)
        check_sample(sample, [first, last], unloaded, law)
        check_sample(sample, [last - 0.001, last], unloaded, law)
        for maps, words in (
            ([last, first], "thicker on average than that of map 1.*order of loading"),
            ([last, last], "maps 1 and 2 of 2 are the same"),
        ):
            with pytest.raises(InputError, match=words):
                check_sample(sample, maps, unloaded, law)


def test_a_rigid_sample_may_seem_to_give_way_by_the_error_of_the_travel(columns):
    loaded = xr.full_like(measured(columns), 0.398)
    law, unloaded = columns.scene.layer.material, xr.full_like(loaded, 0.5)
    sample = known(columns, compression=0.1)
    check_sample(sample, loaded, unloaded, law)
    with pytest.raises(InputError, match="cannot have moved less"):
        check_sample(sample, loaded - 0.002, unloaded, law)
    relief = 0.01 * xr.ones_like(loaded)  # leaves it no more
    with pytest.raises(InputError, match="cannot have moved less"):
        check_sample(replace(sample, relief=relief), loaded - 0.002, unloaded, law)


def test_no_contact_is_an_error(columns):
    loaded = xr.full_like(measured(columns), 0.5)
    with pytest.raises(InputError, match="nothing is pressed"):
        sample_stress(
            loaded,
            0.5,
            columns.scene.layer.material,
            known(columns),
            window_friction=0.3,
            sample_friction=0.1,
            element_size=0.1875,
        )


@pytest.fixture(scope="module")
def small():
    """A model of few elements, pressed, and a surface to compare it with."""
    from optical_palpation.experiment.assembly import build

    of = scene({"kind": "random", "spread": 0.3, "correlation_length": 0.6}, compression=0.1)
    mesh = of.mesh.model_copy(update={"element_size": 0.375})
    stack = build(of.model_copy(update={"mesh": mesh}))
    return stack, solve([stack]).state


def test_tangent_is_the_derivative_of_equilibrium(small, monkeypatch):
    """Pressures and contact forces follow the displacement; the residual changes as it says."""
    from optical_palpation.mechanics.stack import tangent as module

    monkeypatch.setattr(module, "_CLOSED", 3.0)  # closed contact must not drown all else
    stack, state = small
    tangent = Tangent(stack, state)
    du = 1e-3 * np.random.default_rng(0).normal(size=state.u.shape)
    now = balance(stack, state)
    forces = [matrix @ du.ravel() for matrix in tangent.contact_forces]
    small_step = 1e-4

    def at(fraction):
        fields = stack.split(state.u + fraction * du)
        return [
            body.forces(u, p).volume
            for body, u, p in zip(stack.bodies, fields, state.p, strict=True)
        ]

    changes = [
        (a - b) / (2 * small_step) * body.bulk_modulus / part.reference_volume
        for a, b, body, part in zip(
            at(small_step), at(-small_step), stack.bodies, now.bodies, strict=True
        )
    ]

    def residual(fraction):
        return balance(stack, state.stepped(fraction, du, changes, forces)).residual.ravel()

    difference = (residual(small_step) - residual(-small_step)) / (2 * small_step)
    expected = tangent.matrix @ du.ravel()
    assert np.linalg.norm(difference - expected) < 1e-6 * np.linalg.norm(expected)


def test_stiffness_forces_are_the_derivative_of_internal_forces(small):
    stack, state = small
    body = stack.bodies[SAMPLE]
    u, p = stack.split(state.u)[SAMPLE], state.p[SAMPLE]
    forces = stiffness_forces(body, u, p)
    j, i, small_step = 2, 5, 1e-4

    def stiffer(logarithm):
        factor, pressure = np.array(body.factor), p.copy()
        factor[:, j, i] *= np.exp(logarithm)
        pressure[:, j, i] *= np.exp(logarithm)  # at the volume as it is
        return replace(body, stiffness=factor).forces(u, pressure).force

    derivative = (stiffer(small_step) - stiffer(-small_step)) / (2 * small_step)
    own = derivative[:, :, j : j + 2, i : i + 2]
    assert own == pytest.approx(forces[j, i], rel=1e-6, abs=1e-9)
    assert np.abs(derivative).sum() == pytest.approx(np.abs(own).sum())


def test_factors_solve_many_right_hand_sides(small):
    stack, state = small
    tangent = Tangent(stack, state)
    rhs = np.random.default_rng(0).normal(size=(tangent.matrix.shape[0], 40))
    solution = tangent.displacement(rhs)
    expected = spsolve(sp.csc_matrix(tangent.matrix), rhs[:, 7])
    assert np.linalg.norm(solution[:, 7] - expected) < 1e-6 * np.linalg.norm(expected)
    left = np.linalg.norm(tangent.matrix @ solution - rhs, axis=0)
    scale = spnorm(tangent.matrix) * np.linalg.norm(solution, axis=0)
    assert (left < 1e-13 * scale).all()


@pytest.mark.parametrize("what", ["stiffness", "travel", "relief"])
def test_what_a_sensitivity_leaves_is_of_second_order(what):
    """Of equilibria with the same slip before the last load step (Taylor test)."""
    grid = Columns(np.linspace(0, 3, 7), np.linspace(0, 3, 7))
    blocks = _blocks(scene(compression=0.15))
    model = Model(blocks, meshes_of(blocks, Mesh(0.375)), grid)
    x = np.linspace(0, 3, 31)
    flat = xr.DataArray(np.full((31, 31), 0.45), {"y": x, "x": x}, ("y", "x"))
    surface = ThicknessSurface.fitted(flat, 0.375)
    rng = np.random.default_rng(0)
    stiffness, heights = 0.3 * rng.normal(size=grid.shape), 0.005 * rng.normal(size=grid.corners)
    change = {
        "stiffness": rng.normal(size=grid.shape),
        "travel": 0.03,
        "relief": 0.01 * rng.normal(size=grid.corners),
    }

    def sought(step):
        moved = {name: step * value if name == what else 0.0 for name, value in change.items()}
        return Sought(
            stiffness + moved["stiffness"], (0.15 + moved["travel"],), heights + moved["relief"]
        )

    tight = replace(relaxed(TOLERANCES, 1e-3), iterations=100, patience=100)
    (start,) = model.pressed(sought(0.0))

    def at(step):
        stack = model.stacks(sought(step))[0][-1]
        return Pressed(stack, equilibrate(stack, start.state, make_solver(stack), tight)[0].state)

    here = at(0.0)
    told = here.sensitivity(surface, relief=True).of(model.derivatives(True, 1, 0))
    direction = np.concatenate(
        [(name == what) * np.ravel(change[name]) for name in ("stiffness", "relief", "travel")]
    )
    left = []
    for step in (0.2, 0.1, 0.05):
        there = at(step)
        thickness = (there.misfit(surface) - here.misfit(surface)).ravel()
        force = there.force - here.force
        left.append(
            (
                np.linalg.norm(thickness - step * told.thickness @ direction),
                abs(force - step * float(told.force @ direction)),
            )
        )
        assert left[-1][0] < 0.2 * np.linalg.norm(thickness)
    order = np.log2(np.array(left[:-1]) / left[1:])
    assert (order[:, 0] > 1.7).all()
    assert (order[:, 0] < 2.3).all()
    assert (order[:, 1] > 1.7).all()


def test_sensitivity_agrees_with_solutions_from_scratch():
    """On a load path of friction, to the part of it that the slip before the last step is."""
    of = scene(compression=0.15)
    blocks = _blocks(of)
    grid = Columns(np.linspace(0, 3, 7), np.linspace(0, 3, 7))
    model = Model(blocks, meshes_of(blocks, Mesh(0.375)), grid)
    x = np.linspace(0, 3, 31)
    flat = xr.DataArray(np.full((31, 31), 0.45), {"y": x, "x": x}, ("y", "x"))
    surface = ThicknessSurface.fitted(flat, 0.375)
    middle, change = np.zeros(grid.shape), np.zeros(grid.shape)
    change[2:4, 1:3] = 1.0
    (pressed,) = model.pressed(Sought(middle, (0.15,)))
    told = pressed.sensitivity(surface)
    direction = np.append(model.means @ change.ravel(), 0.0)
    expected = told.thickness @ direction
    up, down = (model.pressed(Sought(sign * 0.05 * change, (0.15,)))[0] for sign in (1, -1))
    actual = (up.misfit(surface) - down.misfit(surface)).ravel() / 0.1
    assert np.linalg.norm(actual - expected) < 0.1 * np.linalg.norm(actual)
    force = float(told.force @ direction)
    assert force == pytest.approx((up.force - down.force) / 0.1, rel=0.1)
    assert told.pressure.shape[0] == pressed.state.forces[INTERFACE].size
    up, down = (model.pressed(Sought(middle, (0.15 + sign * 0.005,)))[0] for sign in (1, -1))
    actual = (up.misfit(surface) - down.misfit(surface)).ravel() / 0.01
    assert np.linalg.norm(actual - told.thickness[:, -1]) < 0.1 * np.linalg.norm(actual)
    assert told.force[-1] == pytest.approx((up.force - down.force) / 0.01, rel=0.1)


def test_sensitivity_to_the_relief_agrees_with_solutions_from_scratch():
    """Without friction at the sample there is next to no path for the derivative to leave out."""
    blocks = replace(_blocks(scene(compression=0.15)), friction=(0.3, 0.0, 0.3))
    grid = Columns(np.linspace(0, 3, 9), np.linspace(0, 3, 9))
    model, travels = Model(blocks, meshes_of(blocks, Mesh(0.375)), grid), (0.08, 0.15)
    x = np.linspace(0, 3, 31)
    flat = xr.DataArray(np.full((31, 31), 0.45), {"y": x, "x": x}, ("y", "x"))
    surface = ThicknessSurface.fitted(flat, 0.375)
    rng = np.random.default_rng(0)
    heights, stiffness = (s * rng.normal(size=n) for s, n in ((0.01, grid.corners), (0.2, (8, 8))))
    change, small_step = np.full(grid.corners, 0.5), 5e-4
    change[2:5, 3:6] += rng.normal(size=(3, 3))
    pressed = model.pressed(Sought(stiffness, travels, heights))
    up, down = (
        model.pressed(Sought(stiffness, travels, heights + sign * small_step * change))
        for sign in (1, -1)
    )
    direction = np.append(np.zeros(stiffness.size), change.ravel())
    for load, (here, more, less) in enumerate(zip(pressed, up, down, strict=True)):
        told = here.sensitivity(surface, relief=True).of(model.derivatives(True, 0, load))
        actual = (more.misfit(surface) - less.misfit(surface)).ravel() / (2 * small_step)
        expected = told.thickness @ direction
        assert np.linalg.norm(actual - expected) < 0.01 * np.linalg.norm(actual)
        force = (more.force - less.force) / (2 * small_step)
        assert float(told.force @ direction) == pytest.approx(force, rel=0.01)


@pytest.mark.parametrize("name", ["sample_thickness", "thickness"])
def test_a_model_of_another_thickness_has_the_same_mesh(name):
    """Or the effect of an error of the thickness would be one of the mesh, too."""
    blocks, grid = _blocks(scene()), Columns(np.linspace(0, 3, 7), np.linspace(0, 3, 7))
    model = Model(blocks, meshes_of(blocks, Mesh(0.125)), grid)
    assert len(model.levels) > 1
    before = blocks.thickness
    thicker = {
        "sample_thickness": 1.5 * blocks.sample_thickness,
        "thickness": lambda x, y: 1.5 * before(x, y),
    }
    other = model.changed(**{name: thicker[name]})
    for level, same in zip(model.levels, other.levels, strict=True):
        for body, its in zip(level.bodies, same.bodies, strict=True):
            np.testing.assert_array_equal(body.grid.depth, its.grid.depth)
    fresh = meshes_of(other.blocks, Mesh(0.125))
    assert fresh[-1] != model.meshes[-1]


def _blocks(of):
    return Blocks(
        extent=(0.0, 3.0, 0.0, 3.0),
        thickness=lambda x, _: np.full(x.shape, of.layer.thickness),
        law=of.layer.material,
        sample_size=of.sample.size,
        sample_thickness=of.sample.thickness,
        sample_law=of.sample.material,
        relief=lambda x, _: np.zeros_like(x),
        friction=(of.friction.window, of.friction.sample, of.friction.plate),
        travel=of.compression,
    )


def test_what_stands_out_beside_the_layer_is_not_where_they_touch_first():
    """The travel of the plate counts from there."""
    blocks = replace(_blocks(scene()), sample_size=(4.0, 4.0))
    here, outside = (
        assemble(replace(blocks, relief=lambda x, _, at=at: 0.1 * (x > at)), Mesh(0.375))
        for at in (1.5, 3.1)
    )
    assert here.plate == pytest.approx(1.6)
    assert outside.plate == pytest.approx(1.5)


def test_surface_follows_what_elements_can_and_leaves_the_noise():
    rng = np.random.default_rng(1)
    x = np.linspace(0, 5, 201)
    true = 0.4 + 0.05 * np.sin(2 * np.pi * x / 1.1)[None] * np.cos(x)[:, None]
    noisy = xr.DataArray(true + 2e-3 * rng.normal(size=true.shape), {"y": x, "x": x}, ("y", "x"))
    noisy[50:60, 70:80] = np.nan
    surface = ThicknessSurface.fitted(noisy, 0.125)
    assert surface.noise == pytest.approx(2e-3, rel=0.03)
    at_x, at_y = rng.uniform(0.2, 1.0, (2, 500))
    exact = 0.4 + 0.05 * np.sin(2 * np.pi * at_x / 1.1) * np.cos(at_y)
    assert (
        np.sqrt(np.mean((surface(at_x, at_y) - exact) ** 2)) < 2e-3 / np.sqrt(surface.pixels) * 1.5
    )
    slope = 0.05 * 2 * np.pi / 1.1 * np.cos(2 * np.pi * at_x / 1.1) * np.cos(at_y)
    assert np.abs(surface(at_x, at_y, dx=1) - slope).mean() < 0.02


def test_surface_goes_straight_on_where_the_rim_was_not_measured():
    """Knots of which next to no pixel is known must not run away, and the rim does not count."""
    x = np.linspace(0, 4, 161)
    true = 0.4 + 0.05 * np.sin(2 * np.pi * x / 2.1)[None] * np.cos(x)[:, None]
    thickness = xr.DataArray(true.copy(), {"y": x, "x": x}, ("y", "x"))
    thickness[:, :2] = np.nan
    thickness[30:60, :4] = np.nan
    thickness[100:104, :9] = np.nan
    surface = ThicknessSurface.fitted(thickness, 0.0625)
    at_y, at_x = (points.ravel() for points in np.meshgrid(x, x, indexing="ij"))
    off = np.abs(surface(at_x, at_y) - true.ravel())
    assert off.max() < 0.01
    covered = surface.covers(at_x, at_y)
    np.testing.assert_array_equal(covered, np.isfinite(thickness.values).ravel())
    assert off[covered].max() < 2e-4
    assert not surface.covers(np.array([-0.001, 4.001]), np.array([1.0, 1.0])).any()


@pytest.mark.parametrize("last", range(18))
def test_the_first_number_is_found_sooner_from_near_it(last):
    for true, guess in np.ndindex(last + 1, last + 2):
        asked = []

        def holds(number, true=true, asked=asked):
            asked.append(number)
            return number >= true

        assert first(holds, last, guess) == true
        assert all(0 <= number < last for number in asked)
        assert len(asked) <= {0: 2, 1: 3}.get(abs(guess - true), 7)


@pytest.mark.parametrize(("travels", "tried"), [(False, [0.0, 3.0, 1.5]), (True, [0.0, 3.0, 6.0])])
def test_a_coarse_step_that_makes_the_misfit_worse_is_halved(monkeypatch, travels, tried):
    """The linear model steps by 3 where 1 was wanted, whatever the row."""
    here, rows = SimpleNamespace(thickness=np.ones((2, 2))), []

    def pressed(model, before, step, row):
        rows.append(float(row[0]))
        stack = SimpleNamespace(n_elements=1)
        state = SimpleNamespace(stack=stack, surface=np.zeros((3, 2, 2)), row=row)
        return [state], row

    monkeypatch.setattr(inversion, "carrying", lambda *_: None)
    monkeypatch.setattr(inversion, "_TRAVELLING_STEPS", 3)
    search = object.__new__(inversion._Search)
    search.order, search.coarse = SimpleNamespace(travels=travels), SimpleNamespace(layer=here)
    search.noise, search.solutions, search.forces = np.ones((1, 1, 1)), [], np.zeros(0)
    search._pressed = pressed
    search._misfit = lambda pressed: np.full((1, 2, 2), 10 * (pressed[0].row[0] - 1.0))
    search._weight = lambda pressed, tolerance: 1.0 / tolerance
    search._sensitivities = search._system = lambda *_: None
    search._step = lambda system, row: (np.full(1, 3.0), 1.0, None)
    end = search.on_coarse_mesh(np.zeros(1))
    assert rows == tried
    assert end == (0.0 if travels else 4.5)
