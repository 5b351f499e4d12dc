"""The algebraic method, and the initial thickness on the pixels of the loaded map."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from optical_palpation.errors import InputError, MaterialError
from optical_palpation.material import MooneyRivlin, neo_hookean
from optical_palpation.palpation import algebraic_result, algebraic_stress
from optical_palpation.thickness import match_initial_thickness, read_thickness_map, thickness_map

LAYER = MooneyRivlin(2.23, 0.703)


def flat(*thickness, **frame):
    return thickness_map(
        np.array([thickness, thickness]), **(frame or {"field_of_view": (5.0, 5.0)})
    )


def test_stress_by_hand():
    stress = algebraic_stress(flat(0.25, 0.5, 0.6, np.nan), 0.5, LAYER)
    # Half the height: 2 (0.25 - 2) (2.23 + 0.703 / 0.5) kPa.
    np.testing.assert_allclose(stress[0], [-12.726, 0.0, 0.0, np.nan])
    assert stress.values[0, 1] == 0.0
    assert stress.name == "algebraic_axial_stress"
    assert stress.attrs["units"] == "kPa"
    assert stress.attrs["long_name"]
    assert stress.attrs["no_contact_share"] == pytest.approx(2 / 3)
    np.testing.assert_allclose(stress["x"], [0, 5 / 3, 10 / 3, 5])
    assert stress["x"].attrs["units"] == "mm"


def test_small_strain_is_hookes_law():
    stress = algebraic_stress(flat(0.5, 0.5 * (1 - 1e-6)), 0.5, LAYER)
    assert stress.values[0, 1] == pytest.approx(-3 * LAYER.shear_modulus * 1e-6, rel=1e-5)


@given(
    first=st.floats(0.06, 0.49),
    second=st.floats(0.06, 0.49),
    c10=st.floats(0.1, 100),
    c01=st.floats(0.0, 100),
)
def test_thinner_means_more_stress(first, second, c10, c01):
    stress = algebraic_stress(flat(first, second), 0.5, MooneyRivlin(c10, c01)).values[0]
    assert np.all(stress < 0)
    if first < second * (1 - 1e-9):
        assert stress[0] < stress[1]


@given(values=st.lists(st.floats(0.2, 0.6), min_size=4, max_size=4))
def test_pixels_are_independent_and_bulk_modulus_does_not_enter(values):
    values = [*values, 0.4]
    together = algebraic_stress(flat(*values), 0.5, LAYER)
    np.testing.assert_array_equal(
        together[0, ::-1], algebraic_stress(flat(*values[::-1]), 0.5, LAYER)[0]
    )
    soft = algebraic_stress(flat(*values), 0.5, MooneyRivlin(2.23, 0.703, bulk_to_shear=20))
    np.testing.assert_array_equal(together, soft)


def test_beyond_the_layer_there_is_no_stress():
    loaded = flat(0.4, 0.4, 0.4, 0.6, layer_extent=(1.0, 2.0, 0, 1), pixel_spacing=(1.0, 1.0))
    stress = algebraic_stress(loaded, 0.5, LAYER)
    np.testing.assert_array_equal(np.isnan(stress[0]), [True, False, False, True])
    assert stress.attrs["no_contact_share"] == 0


def test_result_holds_the_stress_what_touches_and_what_it_came_from():
    loaded = flat(0.4, 0.45, 0.5, 0.6).assign_attrs(source="coin.mat", units="mm")
    result = algebraic_result(loaded, 0.5, LAYER)
    stress = algebraic_stress(loaded, 0.5, LAYER)
    for name in ("axial_stress", "algebraic_axial_stress"):
        np.testing.assert_array_equal(result.maps[name], stress)
        assert result.maps[name].attrs["units"] == "kPa"
    xr.testing.assert_identical(result.maps["loaded_thickness"], loaded)
    assert "contact_state" not in result.maps  # which it does not compute
    assert result.layer is None
    about = {"method": "algebraic", "law": "mooney-rivlin", "c10_kPa": 2.23, "c01_kPa": 0.703}
    about |= {"initial_thickness_mm": 0.5, "no_contact_share": 0.5, "unusual": "[]"}
    assert result.maps.attrs == about


def test_crop_and_order_of_axes_do_not_change_a_pixel():
    loaded = thickness_map(np.linspace(0.3, 0.5, 20).reshape(4, 5), pixel_spacing=(1.0, 1.0))
    whole = algebraic_stress(loaded, 0.51, LAYER)
    part = {"x": slice(1, 3), "y": slice(0, 2)}
    xr.testing.assert_equal(algebraic_stress(loaded.sel(part), 0.51, LAYER), whole.sel(part))
    xr.testing.assert_equal(algebraic_stress(loaded.T[::-1], 0.51, LAYER), whole)


def test_coin(shared_data):
    path = shared_data / "layers" / "coin_5c_1-thickness.mat"
    coin = read_thickness_map(path, field_of_view=(5, 5))
    stress = algebraic_stress(coin, 0.5, LAYER)
    # The thinnest pixel, 0.31660 mm: 2 (L^2 - 1/L) (2.23 + 0.703 / L) at L = 0.6332.
    stretch = float(coin.min()) / 0.5
    assert float(stress.min()) == pytest.approx(
        2 * (stretch**2 - 1 / stretch) * (2.23 + 0.703 / stretch)
    )
    assert np.all(stress.values <= 0)


def test_refused():
    with pytest.raises(MaterialError, match=r"compressed by 80 %.*only up to 68.2 %"):
        algebraic_stress(flat(0.1, 0.4), 0.5, MooneyRivlin(-0.1, 0.988))
    assert np.all(algebraic_stress(flat(0.1, 0.4), 0.5, neo_hookean(1)) < 0)
    for bad in (0.0, -0.1, np.inf):
        loaded = flat(0.4, 0.4)
        loaded[0, 0] = bad
        with pytest.raises(InputError, match="positive and finite"):
            algebraic_stress(loaded, 0.5, LAYER)


def test_initial_map_is_interpolated_to_the_loaded_pixels():
    y, x = np.meshgrid(np.linspace(0, 5, 11), np.linspace(0, 5, 21), indexing="ij")
    slope = thickness_map(0.5 + 0.01 * x + 0.02 * y, field_of_view=(5, 5))
    loaded = thickness_map(np.full((7, 9), 0.4), field_of_view=(5, 5))
    matched = match_initial_thickness(slope, loaded)
    expected = 0.5 + 0.01 * loaded["x"] + 0.02 * loaded["y"]
    xr.testing.assert_allclose(matched, expected.transpose("y", "x").rename("initial_thickness"))
    assert matched.attrs["units"] == "mm"
    assert matched.attrs["no_contact_share"] == 0
    np.testing.assert_allclose(
        algebraic_stress(loaded, slope, LAYER),
        LAYER.uniaxial_stress(0.4 / expected.transpose("y", "x").values - 1, "true"),
    )


def test_initial_map_must_cover_the_layer_but_not_the_map():
    loaded = flat(0.4, 0.4, 0.4, 0.4, pixel_spacing=(1.0, 1.0))
    smaller = thickness_map(np.full((2, 3), 0.5), pixel_spacing=(1.0, 1.0))
    with pytest.raises(InputError, match=r"spans x 0 to 2, .* does not cover the layer"):
        match_initial_thickness(smaller, loaded)
    in_um = thickness_map(np.full((3, 5), 0.5), pixel_spacing=(1000.0, 1000.0))
    with pytest.raises(InputError, match=r"spans 4000 mm along x, the layer .* in um\?"):
        match_initial_thickness(in_um, loaded)
    inner = flat(0.4, 0.4, 0.4, 0.4, pixel_spacing=(1.0, 1.0), layer_extent=(0, 2, 0, 1))
    np.testing.assert_allclose(match_initial_thickness(smaller, inner), 0.5)


def test_a_small_punch_may_leave_most_of_the_layer_thicker():
    needle = flat(0.502, 0.502, 0.502, 0.2)  # it keeps its volume
    assert match_initial_thickness(0.5, needle).attrs["no_contact_share"] == 0.75
    noise = flat(0.501, 0.503, 0.502, 0.499)
    match_initial_thickness(0.5, noise)


def test_a_computed_imprint_may_say_how_far_the_sample_is_from_a_flat_layer():
    sphere = flat(0.9, 0.8, 0.6, 0.45, 0.4, 0.45, 0.6, 0.8, 0.9)
    assert match_initial_thickness(0.5, sphere).attrs["no_contact_share"] == pytest.approx(2 / 3)
    # but not from a layer that shows the sphere before it is loaded: the two are swapped
    before = flat(0.4, 0.42, 0.45, 0.51, pixel_spacing=(1.0, 1.0))
    with pytest.raises(InputError, match="are the two swapped"):
        match_initial_thickness(before, flat(0.5, 0.5, 0.5, 0.5, pixel_spacing=(1.0, 1.0)))


@pytest.mark.parametrize(
    ("loaded", "initial", "message"),
    [
        (flat(400.0, 410.0), 0.5, "loaded thickness: a layer of 410 mm .*length_unit 'um'"),
        (flat(40.0, 41.0), 0.05, "loaded thickness is probably in um"),
        (flat(0.4, 0.41), 500.0, "initial thickness: a layer of 500 mm .* 1000 if it is in um"),
        (flat(0.04, 0.041), 50.0, "initial thickness is in um"),
        (flat(0.4e-3, 0.41e-3), 0.5, "loaded thickness: a layer of 0.00041 mm .* was read as um"),
        (flat(0.4e-3, 0.41e-3), 0.5e-3, r"initial .* 0\.0005 mm .*in mm: multiply .* is in m,"),
        (flat(0.4, 0.41, field_of_view=(5000, 5000)), 0.5, "5000 mm wide along x"),
        (flat(0.4, 0.41, field_of_view=(5, 0.005)), 0.5, "0.005 mm wide along y"),
        (flat(0.5, 0.6), 0.5, "nowhere below"),
        (flat(0.57, 0.56, 0.58, 0.495), 0.5, "by 65 um in the median, .* are the two swapped"),
        (flat(0.4, 0.4), 0.0, "positive and finite"),
        (flat(0.4, 0.4), -0.5, "positive and finite"),
        (flat(0.4, 0.4), float("nan"), "positive and finite"),
        (flat(0.4, 0.4), "thick", "or a map, not 'thick'"),
        (flat(0.4, 0.4), None, "or a map, not None"),
        (flat(0.4, 0.4), flat(0.5, np.nan, 0.5), "clean_thickness"),
        (
            flat(0.4, 0.4, 0.4).where(lambda m: m.x < 0),
            0.5,
            "missing everywhere in the layer",
        ),
    ],
)
def test_pairs_that_do_not_fit(loaded, initial, message):
    with pytest.raises(InputError, match=message):
        match_initial_thickness(initial, loaded)
    with pytest.raises(InputError, match=message):
        algebraic_stress(loaded, initial, LAYER)
