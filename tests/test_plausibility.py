"""Numbers that can be read and make no sense are refused before anything is computed, or said."""

import json

import numpy as np
import pytest

from optical_palpation.cli import main
from optical_palpation.errors import InputError, MaterialError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import InputErrors, algebraic_result
from optical_palpation.palpation.motion import MOTION
from optical_palpation.present import summarise
from optical_palpation.study import (
    compute,
    describe_inputs,
    read_study,
    run_study,
    stages,
    warnings_about,
    write_template,
)
from optical_palpation.thickness import match_initial_thickness, thickness_map
from study_case import LOADED, STUDY, UNLOADED, make_study

MAPS = (
    STUDY[STUDY.index("[material]") :]
    + """
[unloaded]
thickness = 0.42
[loaded]
map = "pressed.npy"
pixel_spacing = [0.03, 0.03]
"""
)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Volumes and a map, in a folder where no boundary is sought and no stress computed."""

    def work(*arguments, **options):
        raise AssertionError("the study got as far as the work")

    for module, name in (
        (stages, "find_boundaries"),
        (compute, "computational_stress"),
        (compute, "read_thickness_map"),
    ):
        monkeypatch.setattr(module, name, work)
    monkeypatch.chdir(tmp_path)
    nz = 230
    for name, thickness in (("unloaded", UNLOADED), ("loaded", LOADED)):
        np.save(f"{name}.npy", np.ones((thickness.shape[0], nz, thickness.shape[1]), np.float32))
    np.save("pressed.npy", LOADED)
    return tmp_path


SPACED = "spacing = { z = 0.0029, y = 0.03, x = 0.03 }"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("c10 = 2.23", "c10 = 22300.0", ["Young's modulus", "Pa", "1000"]),
        (SPACED, "spacing = { z = 2.9, y = 30.0, x = 30.0 }", ["spacing in another unit", "mm"]),
        (
            "[0.2, 0.2, 0.1]",
            "30",
            ["[grid]", "element size along z, 30 mm", "depth"],
        ),
        ("[0.2, 0.2, 0.1]", "[0.2, 0.2, 0.7]", ["element size along z, 0.7 mm", "depth"]),
        ("[0.2, 0.2, 0.1]", "125", ["element size", "in mm"]),
        ("[0.2, 0.2, 0.1]", "1e-5", ["[grid]", "would be at least", "beyond any memory"]),
        ("threads = 1", "imprint_smoothing = 62.5", ["imprint_smoothing = 62.5", "in mm"]),
        (
            "sample = 0.05",
            "sample = 0.05\nslip_length = 1.0",
            ["friction.slip_length = 1", "in mm"],
        ),
        ("[grid]", "[errors]\nthickness = 2.0\n[grid]", ["error of thickness: 2 mm", "in um"]),
        ('volume = "unloaded.npy"', "thickness = 420.0", ["unloaded.thickness", "420"]),
        ('volume = "unloaded.npy"', "thickness = 1.5", ["more than the depth of the loaded"]),
        ("[volumes]", "[volumes]\nsample_range = [300, 400]", ["sample_range", "outside"]),
        ("[volumes]", "[volumes]\nwindow = 60.0", ["window = 60", "outside"]),
        ("[grid]", "[layer]\nextent = [20, 30, 0, 1]\n[grid]", ["layer.extent", "must lie within"]),
        ("[grid]", "[layer]\nextent = [0, 30, 0, 1]\n[grid]", ["layer.extent", "must lie within"]),
    ],
)
def test_a_study_of_volumes_is_refused_before_they_are_worked_on(here, old, new, words):
    assert old in STUDY
    study = read_study(make_study(here, STUDY.replace(old, new)))
    with pytest.raises(InputError) as error:
        run_study(study)
    for word in ["study.toml", *words]:
        assert word in str(error.value)
    assert not (here / "study-results").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[0.03, 0.03]", "[30.0, 30.0]", "field of view"),
        ("[0.2, 0.2, 0.1]", "30", "element size"),
        ("[0.2, 0.2, 0.1]", "[0.2, 0.2, 0.45]", "along z, 0.45 mm, is larger than"),
        ("[0.2, 0.2, 0.1]", "[0.2, 0.2, 1e-9]", r"would be \d.* in all, beyond any memory"),
    ],
)
def test_a_study_of_maps(here, old, new, words):
    study = read_study(make_study(here, MAPS.replace(old, new)))
    with pytest.raises(InputError, match=words):
        run_study(study)


def test_lengths_in_metres_are_told_from_large_elements(here):
    """Elements of 0.1 mm are too large for a layer of 0.42e-3 mm, but that is not what is wrong."""
    study = read_study(make_study(here, MAPS.replace("= 0.42", "= 0.42e-3")))
    with pytest.raises(InputError, match=r"unloaded\.thickness: a layer of 0\.00042 mm .* in mm:"):
        run_study(study)
    np.save("pressed.npy", 1e-3 * LOADED)
    study = read_study(make_study(here, MAPS))
    with pytest.raises(InputError, match=r"the loaded layer: a layer of 0\.000\d* mm .* in mm:"):
        run_study(study)


def test_thin_and_thick_layers_that_there_are():
    for thickness in (0.01, 0.05, 5.0, 50.0):
        width = 20 * thickness
        loaded = thickness_map(np.full((5, 5), 0.6 * thickness), field_of_view=(width, width))
        match_initial_thickness(thickness, loaded)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("thickness = 0.42", "thickness = 0.2", "nothing is pressed"),
        ("thickness = 0.42", "thickness = 5.0", "can be pressed to 7"),
        ("c10 = 2.23", "c10 = 2230.0", "kPa on average"),
        ("sample = 0.05", "sample = 0.05\nslip_length = 1e-7", "slip_length = 1e-07 mm is less"),
        (
            "[grid]",
            "[sample]\nmotion = 'half.npz'\n[grid]",
            "y 0 to 0.6 mm and does",
        ),
        ("[grid]", "[sample]\nmotion = 'um.npz'\n[grid]", r"\[sample\]: .* Is it in um"),
        ("[grid]", "[sample]\nmotion = 'gap.npz'\n[grid]", r"\[sample\]: .* 1 missing"),
    ],
)
def test_what_a_check_of_maps_tells_before_a_run(tmp_path, old, new, words):
    assert old in MAPS
    np.save(tmp_path / "pressed.npy", LOADED)
    y, x = 0.03 * np.arange(40), 0.03 * np.arange(48)
    moved = 0.01 * np.broadcast_to(x, LOADED.shape)
    gap = moved.copy()
    gap[3, 4] = np.nan
    for name, motion, rows in (("half", moved, 21), ("um", 1e3 * moved, 40), ("gap", gap, 40)):
        arrays = dict.fromkeys(MOTION, motion[:rows])
        np.savez(tmp_path / f"{name}.npz", **arrays, x_mm=x, y_mm=y[:rows])
    with pytest.raises(InputError, match=words):
        describe_inputs(read_study(make_study(tmp_path, MAPS.replace(old, new))))


@pytest.mark.parametrize(
    ("key", "value"), [("modulus", 5.0), ("window_friction", 5.0), ("thickness", 2.0)]
)
def test_errors_of_inputs_in_another_unit(here, key, value):
    """5 % is 0.05, and 2 um are 0.002 mm; whatever they were, all bands would be too wide."""
    make_study(here, MAPS + f"[errors]\n{key} = {value}\n")
    with pytest.raises(InputError, match=f"errors.*{key}"):
        run_study(read_study("study.toml"))
    with pytest.raises(InputError, match=f"error of {key}"):
        InputErrors(**{key: value}).check_thickness(0.5)


def test_the_good_studies_get_as_far_as_the_work(here):
    for text in (STUDY, MAPS):
        with pytest.raises(AssertionError, match="as far as the work"):
            run_study(read_study(make_study(here, text)))


def test_coefficients_in_pa_are_refused_by_the_stress_they_would_mean(here, run, monkeypatch):
    arguments = ["stress", "pressed.npy", "--pixel-spacing", 0.03, 0.03, "--initial-thickness"]
    arguments += [0.42, "--c01", 703, "--method", "algebraic", "--output", "o.nc"]
    status, _, err = run(*arguments, "--c10", 2230)
    assert status == 2
    assert "kPa on average" in err
    assert "Pa (divide them by 1000)" in err
    assert not (here / "o.nc").exists()
    status, _, err = run(*arguments, "--c10", 5230)
    assert status == 2
    assert "hardest rubbers" in err


def test_what_is_only_unusual_is_said():
    loaded = thickness_map(np.full((5, 5), 0.49), pixel_spacing=(0.2, 0.2))
    usual = algebraic_result(loaded, 0.5, MooneyRivlin(2.23, 0.703))
    stiff = algebraic_result(loaded, 0.5, MooneyRivlin(600.0))
    soft = MooneyRivlin(2.23e-3, 0.703e-3)  # in MPa
    thick = thickness_map(np.full((5, 5), 0.49), pixel_spacing=(0.05, 0.05))
    for result, words in (
        (usual, None),
        (stiff, "as stiff as hard rubber"),
        (algebraic_result(loaded, 0.5, soft), "Young's modulus 17.6 Pa"),
        (algebraic_result(thick, 0.5, MooneyRivlin(2.23)), "thicker"),
    ):
        said = json.loads(result.maps.attrs["unusual"])
        assert len(said) == (words is not None)
        assert ("WARNING" in summarise(result)) == (words is not None)
        if words:
            assert words in said[0]
            assert words in warnings_about(result)[0]


def test_the_template_refuses_until_it_is_filled_in(here):
    write_template("new.toml")
    text = (here / "new.toml").read_text()
    assert not [line for line in text.splitlines() if line.startswith(("c10 = 2", "window = 0"))]
    with pytest.raises(InputError) as error:
        read_study("new.toml")
    for key in ("material.c10", "material.c01", "friction.window", "friction.sample"):
        assert f"  {key}" in str(error.value)
    assert "grid.element_size (mm" in str(error.value)
    assert "have still to be filled in" in str(error.value)


def test_a_material_that_no_rubber_is():
    from optical_palpation.palpation.plausibility import check_layer

    check_layer(MooneyRivlin(3000.0))
    with pytest.raises(MaterialError, match="if they are in Pa"):
        check_layer(MooneyRivlin(4000.0))


def test_an_unusual_material_is_told_before_the_work(here, capsys):
    text = MAPS.replace("c10 = 2.23", "c10 = 0.00223").replace("c01 = 0.703", "c01 = 0.0007")
    make_study(here, text)
    with pytest.raises(AssertionError, match="as far as the work"):
        main(["run", "study.toml"])
    assert (
        "WARNING: study.toml, [material]: the layer is softer than gels" in capsys.readouterr().out
    )
