"""Derivatives of force and stress by the inputs, and the error bands made of them."""

import json
import re

import numpy as np
import pytest

from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import neighbours, newton
from optical_palpation.mechanics.direct import DirectSolver
from optical_palpation.mechanics.iteration import NotConverged
from optical_palpation.mechanics.path import TOO_LONG
from optical_palpation.palpation import InputErrors, computational_stress, sensitivity
from optical_palpation.present import read_result, summarise, write_result
from optical_palpation.thickness import thickness_map

AXIS = np.linspace(0, 2, 41)
BASE = {"window_friction": 0.3, "sample_friction": 0.05, "thickness": 0.0, "initial_thickness": 0.5}
STEPS = {
    "window_friction": 0.02,
    "sample_friction": 0.02,
    "thickness": 0.002,
    "initial_thickness": 0.002,
}


def press(errors=None, size=0.25, modulus=1.0, **changes):
    given = BASE | changes
    x, y = np.meshgrid(AXIS, AXIS)
    relief = 0.42 - 0.05 * np.exp(-((x - 0.8) ** 2 + (y - 1.1) ** 2) / 0.2) + given["thickness"]
    return computational_stress(
        thickness_map(relief, x=AXIS, y=AXIS, where="bump"),
        given["initial_thickness"],
        MooneyRivlin(2.23, 0.703).scaled(modulus),
        window_friction=given["window_friction"],
        sample_friction=given["sample_friction"],
        element_size=size,
        threads=1,
        edge_check=False,
        input_errors=errors,
    )


def force(result):
    return result.maps.attrs["sample_force_mN"]


@pytest.fixture(scope="module")
def result():
    return press(InputErrors())


def compared(result, name, size=0.25, **base):
    """Derivatives of force and stress, and those by differences of solutions from scratch."""
    value = (BASE | base)[name]
    up, down = (press(None, size, **base | {name: value + s * STEPS[name]}) for s in (1, -1))
    width = 2 * STEPS[name]
    by_force = (force(up) - force(down)) / width
    by_stress = (up.maps["axial_stress"] - down.maps["axial_stress"]) / width
    mine = result.sensitivities.sel(input=name)
    off = float(np.sqrt(((mine["axial_stress"] - by_stress) ** 2).mean() / (by_stress**2).mean()))
    return float(mine["force"]) / by_force - 1, off


@pytest.mark.parametrize("name", list(STEPS))
def test_derivatives_are_differences_of_solutions_from_scratch(result, name):
    of_force, of_stress = compared(result, name)
    assert abs(of_force) < 0.03
    assert of_stress < 0.06


@pytest.mark.parametrize("friction", [0.1, 0.4])
def test_friction_of_the_window_when_small_and_large(friction):
    base = {"window_friction": friction}
    of_force, of_stress = compared(press(InputErrors(), **base), "window_friction", **base)
    assert abs(of_force) < 0.03
    assert of_stress < 0.06


def test_a_layer_that_is_hardly_pressed_may_be_pressed_more():
    """What the loaded surface gains counts as much as what the unloaded one does."""
    result = press(InputErrors(), thickness=0.0795)
    known = result.sensitivities["force"]
    loaded, unloaded = (float(known.sel(input=n)) for n in ("thickness", "initial_thickness"))
    assert loaded == pytest.approx(-unloaded, rel=0.03)
    more = force(press(None, thickness=0.0785)) - force(result)
    assert -0.001 * loaded == pytest.approx(more, rel=0.03)


def test_derivatives_of_a_coarse_grid_hold_on_the_finer_one():
    result = press(InputErrors(), 0.09)
    assert result.problem.grid.n_elements > 3000  # more than one grid
    of_force, of_stress = compared(result, "window_friction", 0.09)
    assert abs(of_force) < 0.05
    assert of_stress < 0.15


def test_derivatives_of_a_fine_grid_are_those_of_a_coarse_one():
    axis = np.linspace(0, 3, 151)
    x, y = np.meshgrid(axis, axis)
    wave = 0.41 + 0.05 * np.cos(0.8 * np.pi * x) * np.cos(0.8 * np.pi * y)
    derivatives = [
        computational_stress(
            thickness_map(wave, x=axis, y=axis, where="wave"),
            0.5,
            MooneyRivlin(2.23, 0.703),
            window_friction=0.3,
            sample_friction=0.05,
            element_size=size,
            edge_check=False,
            input_errors=InputErrors(),
        ).sensitivities["force"]
        for size in (0.125, 0.05)  # of the finer one, both grids have too many elements for paths
    ]
    np.testing.assert_allclose(derivatives[1], derivatives[0], rtol=0.1)


def test_stress_is_in_proportion_to_the_modulus(result):
    mine = result.sensitivities.sel(input="modulus")
    stiff = press(None, modulus=1.1)
    assert force(stiff) - force(result) == pytest.approx(0.1 * float(mine["force"]), rel=1e-3)


def test_bands_are_made_of_the_derivatives(result, tmp_path):
    attrs, known = result.maps.attrs, result.sensitivities
    given = json.loads(attrs["input_errors"])
    assert given == {
        "window_friction": 0.05,
        "sample_friction": 0.05,
        "modulus": 0.05,
        "thickness": 0.002,
        "initial_thickness": 0.002,
    }
    forces = [float(known["force"].sel(input=name)) * error for name, error in given.items()]
    assert attrs["force_error_mN"] == pytest.approx(np.linalg.norm(forces))
    parts = [known["axial_stress"].sel(input=name) * error for name, error in given.items()]
    band = np.sqrt(sum(part**2 for part in parts))
    np.testing.assert_allclose(result.maps["axial_stress_error"], band)
    assert f"{attrs['force_error_mN']:.2g} mN" in summarise(result)
    write_result(result, tmp_path / "r.nc")
    back = read_result(tmp_path / "r.nc").sensitivities
    np.testing.assert_array_equal(back["axial_stress"], known["axial_stress"])
    assert back["unit"].values.tolist() == known["unit"].values.tolist()
    np.testing.assert_array_equal(back["x"], result.maps["x"])


def test_neighbours_that_do_not_arrive_leave_the_result_as_it_is(monkeypatch, result):
    def fails(*_, **__):
        raise NotConverged("on purpose")

    monkeypatch.setattr("optical_palpation.mechanics.neighbours.equilibrate", fails)
    alone = press(InputErrors())
    assert force(alone) == force(result)
    assert "force_error_mN" not in alone.maps.attrs
    assert "axial_stress_error" not in alone.maps
    assert alone.sensitivities["input"].values.tolist() == ["modulus"]
    assert "error from the inputs: unknown (a slightly different layer" in summarise(alone)


def test_neighbours_that_do_not_arrive_at_once_go_on_in_smaller_increments(monkeypatch, result):
    solved, reached = neighbours.equilibrate, [0.1]

    def fails_far_away(problem, state, *given):
        if state.load > reached[-1] + 0.08:
            raise NotConverged("on purpose")
        found = solved(problem, state, *given)
        reached.append(state.load)
        return found

    monkeypatch.setattr(neighbours, "equilibrate", fails_far_away)
    careful = press(InputErrors())
    assert force(careful) == force(result)
    assert reached[-1] == 1.0
    np.testing.assert_allclose(
        careful.sensitivities["force"], result.sensitivities["force"], rtol=0.05
    )


def test_neighbours_that_take_too_long_are_given_up(monkeypatch, result):
    monkeypatch.setattr(neighbours, "PATIENCE", 0.05)
    hurried = press(InputErrors())
    assert force(hurried) == force(result)
    assert "error from the inputs: unknown (a slightly different layer" in summarise(hurried)
    assert TOO_LONG in hurried.sensitivities.attrs["failure"]


def test_a_path_for_neighbours_alone_is_given_up(monkeypatch, result):
    """Where the path of the solution is on too fine a grid to follow them beside it."""
    monkeypatch.setattr(sensitivity, "_PATH_ELEMENTS", 100)
    assert not press(InputErrors()).sensitivities.failure
    monkeypatch.setattr(sensitivity, "patience_with", lambda _: 0.01)
    hurried = press(InputErrors())
    assert force(hurried) == force(result)
    assert re.match(r"on [\d,]+ elements the layer .*too long", hurried.sensitivities.failure)


def test_neighbours_by_the_exact_solver_are_the_same(monkeypatch, result):
    """It takes over where the iterative one hardly gets there; here it is said never to."""
    monkeypatch.setattr(newton, "_LONG", 1)
    found, exact = neighbours.equilibrate_by, []

    def watched(system, problem, state, solver, tolerances):
        exact.append(isinstance(solver, DirectSolver))
        return found(system, problem, state, solver, tolerances)

    monkeypatch.setattr(neighbours, "equilibrate_by", watched)
    by_factors = press(InputErrors())
    assert force(by_factors) == pytest.approx(force(result), rel=1e-4)
    assert np.mean(exact) > 0.8
    for name in ("force", "axial_stress"):
        np.testing.assert_allclose(
            by_factors.sensitivities[name],
            result.sensitivities[name],
            rtol=0.01,
            atol=0.01 * float(np.abs(result.sensitivities[name]).max()),
        )


def test_none_where_none_are_asked_for():
    nothing = InputErrors(0, 0, 0, 0, 0)
    for errors in (None, nothing):
        assert press(errors).sensitivities is None


def test_errors_as_text():
    assert InputErrors.parsed(["window-friction=0.03"]) == InputErrors(window_friction=0.03)
    for wrong in ("friction=1", "modulus", "modulus=x", "thickness=-1", "modulus=inf"):
        with pytest.raises(InputError, match="error"):
            InputErrors.parsed([wrong])
    with pytest.raises(InputError, match="window_friction is given more than once"):
        InputErrors.parsed(["window_friction=0.03", "modulus=0.1", "window-friction=0.04"])
