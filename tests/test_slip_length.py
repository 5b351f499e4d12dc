"""The slip length of the friction law, and what a change of units changes: nothing."""

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import ContactState, computational_stress


def relief(scale: float = 1.0, share: float = 1.0) -> xr.DataArray:
    """Thickness under a share of the load, all lengths ``scale`` times as large."""
    x = np.linspace(0, 1.5, 31)
    loaded = 0.43 + 0.02 * np.sin(4 * x) * np.cos(5 * x)[:, None] + 0.01 * x
    loaded = 0.5 - share * (0.5 - loaded)
    at = scale * x
    return xr.DataArray(scale * loaded, {"y": at, "x": at}, ("y", "x"), attrs={"units": "mm"})


def solved(scale: float = 1.0, stiffness: float = 1.0, window=0.2, share=1.0, **options):
    return computational_stress(
        relief(scale, share),
        0.5 * scale,
        MooneyRivlin(2.23, 0.703).scaled(stiffness),
        window_friction=window,
        sample_friction=0.1,
        element_size=0.1 * scale,
        edge_check=False,
        input_errors=None,
        **options,
    )


@pytest.mark.parametrize("window", [0.2, "glued"])
@pytest.mark.parametrize("slip_length", [None, 3e-4])
def test_lengths_times_ten_and_moduli_times_a_hundred_change_nothing_but_units(window, slip_length):
    one = solved(window=window, slip_length=slip_length)
    other = solved(
        10.0, 100.0, window, slip_length=None if slip_length is None else 10 * slip_length
    )
    assert other.maps.attrs["slip_length_mm"] == pytest.approx(
        10 * one.maps.attrs["slip_length_mm"]
    )
    assert other.maps.attrs["sample_force_mN"] == pytest.approx(
        1e4 * one.maps.attrs["sample_force_mN"], rel=1e-5
    )
    for name in ("axial_stress", "contact_pressure", "traction_x"):
        expected = 100 * one.maps[name].values
        assert_allclose(other.maps[name], expected, atol=2e-4 * np.abs(expected).max())
    assert_allclose(
        other.layer["displacement"], 10 * one.layer["displacement"].values, atol=2e-5 * 10
    )
    for name in ("contact_state", "window_contact_state"):
        assert (other.maps[name].values == one.maps[name].values).mean() > 0.99


def test_friction_approaches_coulombs_law_as_the_slip_length_falls():
    """Where nodes have slipped for long, friction is at its bound at once; else it creeps to it."""
    forces = [
        solved(slip_length=length).maps.attrs["sample_force_mN"] for length in (8e-3, 2e-3, 5e-4)
    ]
    assert forces[0] < forces[1] < forces[2]
    assert forces[2] - forces[1] < 0.5 * (forces[1] - forces[0])


def test_it_is_recorded_and_by_default_in_proportion_to_the_thickness():
    result = solved()
    assert result.maps.attrs["slip_length_mm"] == result.problem.slip_length == 0.001


def test_what_is_hardly_pressed_slips_in_proportion():
    """All is linear then, and friction at its bound all the same."""
    little, less = (solved(share=share).maps for share in (1e-2, 1e-4))
    assert less.attrs["slip_length_mm"] == pytest.approx(0.01 * little.attrs["slip_length_mm"])
    assert less.attrs["sample_force_mN"] == pytest.approx(
        0.01 * little.attrs["sample_force_mN"], rel=5e-3
    )
    slips = (maps["contact_state"] == ContactState.SLIP for maps in (little, less))
    assert all(share.mean() > 0.5 for share in slips)


@pytest.mark.parametrize("wrong", [0.0, -1e-3, np.nan, "1 um", 1.0, 1e-7])
def test_slip_lengths_that_cannot_be_used(wrong):
    with pytest.raises(InputError, match=r"slip_length .*mm"):
        solved(slip_length=wrong)
