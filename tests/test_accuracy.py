"""A mesh for a wanted accuracy."""

import numpy as np
import pytest
import xarray as xr

from optical_palpation.errors import ConvergenceError, InputError, InsufficientMemoryError
from optical_palpation.palpation import StressResult, computational_stress
from optical_palpation.palpation.accuracy import solve_to_accuracy
from optical_palpation.thickness import thickness_map
from test_mesh_error import AXIS, GEL, press

FIELD = (4.0, 5.0)


def result_of(size, error):
    attrs = {"sample_force_mN": 100.0, "force_mesh_error_mN": 100 * error, "size": size}
    stress = xr.DataArray(np.zeros((2, 2)), dims=("y", "x"))
    return StressResult(xr.Dataset({"axial_stress": stress}, attrs=attrs))


@pytest.mark.parametrize("order", [0.7, 1.0, 2.0])
def test_elements_become_as_fine_as_needed_and_little_finer(order):
    tried = []

    def solve(size):
        tried.append(size)
        return result_of(size, 0.08 * (size / 0.125) ** order)

    attrs = solve_to_accuracy(0.02, 0.5, FIELD, solve).maps.attrs
    assert attrs["force_mesh_error_mN"] <= 2.0
    assert attrs["accuracy"] == 0.02
    assert tried[0] == 0.125
    assert attrs["size"] == tried[-1] == min(tried)
    assert attrs["force_mesh_error_mN"] > 0.2  # not by far too fine


def test_what_cannot_be_had_is_refused():
    for wrong in (0.0, 0.005, 0.5, "2 %", np.nan):
        with pytest.raises(InputError, match="accuracy must lie between"):
            solve_to_accuracy(wrong, 0.5, FIELD, lambda size: result_of(size, 0.0))
    with pytest.raises(ConvergenceError, match=r"no mesh was found.*5\.0%"):
        solve_to_accuracy(0.02, 0.5, FIELD, lambda size: result_of(size, 0.05))

    def solve(size):
        if size < 0.1:
            raise InsufficientMemoryError("needs 1 TB")
        return result_of(size, 0.05)

    with pytest.raises(InsufficientMemoryError, match=r"takes elements of about .*5\.0%.*1 TB"):
        solve_to_accuracy(0.02, 0.5, FIELD, solve)


def test_a_mesh_is_chosen():
    relief = 0.42 - 0.04 * np.exp(-((AXIS - 0.5) ** 2 + (AXIS[:, None] - 0.7) ** 2) / 0.05)
    loaded = thickness_map(relief, x=AXIS, y=AXIS, where="bump")
    options = {"window_friction": 0.2, "sample_friction": 0.1, "threads": 1, "edge_check": False}
    result = computational_stress(loaded, 0.5, GEL, accuracy=0.03, input_errors=None, **options)
    attrs = result.maps.attrs
    assert attrs["force_mesh_error_mN"] <= 0.03 * attrs["sample_force_mN"]
    for both in ({}, {"accuracy": 0.02, "element_size": 0.1}):
        with pytest.raises(InputError, match="one of them"):
            computational_stress(loaded, 0.5, GEL, **options, **both)
    true = press(0.05).maps.attrs["sample_force_mN"]
    assert attrs["sample_force_mN"] == pytest.approx(true, rel=0.03)
