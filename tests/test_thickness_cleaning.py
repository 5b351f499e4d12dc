"""Cleaning touches spikes and missing pixels, fills them smoothly, and nothing else."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from optical_palpation.errors import InputError
from optical_palpation.thickness import clean_thickness, read_thickness_map, thickness_map
from optical_palpation.thickness.frames import map_on_grid

MAPS = hnp.arrays(
    float,
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=9),
    elements=st.one_of(st.floats(0.3, 0.5), st.floats(0.01, 2.0), st.just(float("nan"))),
).filter(lambda map_: np.isfinite(map_).any())


def wavy(shape=(60, 80), seed=None):
    y, x = np.mgrid[: shape[0], : shape[1]] / 20
    map_ = 0.4 + 0.05 * np.sin(3 * x) * np.cos(2 * y)
    if seed is not None:
        map_ += np.random.default_rng(seed).normal(0, 0.003, shape)
    return map_


def clean(values, **frame):
    return clean_thickness(map_on_grid(values, **(frame or {"pixel_spacing": (0.01, 0.01)})))


def test_shares_count_the_layer_and_not_what_lies_beyond_it():
    values = np.full((20, 20), 0.4)
    values[:, 10:] = np.nan  # the layer ends here
    values[0:2, 0:5] = np.nan
    values[10, 4] = 0.9
    extent = (0.0, 0.095, 0.0, 0.19)
    layer = thickness_map(values, pixel_spacing=(0.01, 0.01), layer_extent=extent)
    assert layer.attrs["missing_share"] == pytest.approx(10 / 200)
    about = clean_thickness(layer).attrs
    assert about["missing_share"] == pytest.approx(10 / 200)
    assert about["spike_share"] == pytest.approx(1 / 200)
    assert about["filled_share"] == pytest.approx(11 / 200)


@given(values=MAPS)
def test_good_pixels_are_untouched_and_filled_ones_stay_in_range(values):
    result = clean(values)
    good = ~result["filled"].values
    np.testing.assert_array_equal(result["thickness"].values[good], values[good])
    assert np.all(result["filled"].values[np.isnan(values)])
    assert good.any()
    # Laplace's equation has its extremes on the boundary: among the good pixels.
    tolerance = 1e-9
    assert result["thickness"].values.min() >= values[good].min() - tolerance
    assert result["thickness"].values.max() <= values[good].max() + tolerance
    assert result.attrs["missing_share"] == pytest.approx(np.isnan(values).mean())
    assert result.attrs["filled_share"] == pytest.approx(1 - good.mean())
    assert result.attrs["filled_share"] == pytest.approx(
        result.attrs["missing_share"] + result.attrs["spike_share"]
    )


@given(
    values=MAPS,
    turn=st.sampled_from([np.flipud, np.fliplr, np.transpose, np.rot90]),
    spacing=st.tuples(st.floats(0.01, 0.05), st.floats(0.01, 0.05)),
)
def test_flips_and_transposition_commute_with_cleaning(values, turn, spacing):
    turned_spacing = spacing[::-1] if turn in (np.transpose, np.rot90) else spacing
    plain = clean(values, pixel_spacing=spacing)
    turned = clean(turn(values), pixel_spacing=turned_spacing)
    np.testing.assert_array_equal(turned["filled"], turn(plain["filled"].values))
    np.testing.assert_allclose(turned["thickness"], turn(plain["thickness"].values), rtol=1e-9)


@given(
    seed=st.integers(0, 99),
    row=st.integers(0, 59),
    column=st.integers(0, 79),
    height=st.sampled_from([-0.2, -0.1, 0.1, 0.2, 1.0]),
)
def test_one_spike_is_found_and_mended_wherever_it_is(seed, row, column, height):
    values = wavy(seed=seed)
    values[row, column] += height
    result = clean(values)
    assert result["filled"].values[row, column]
    assert result["filled"].sum() == 1
    mended = float(result["thickness"][row, column])
    assert mended == pytest.approx(wavy()[row, column], abs=0.012)


@given(noise=st.floats(0, 0.05), seed=st.integers(0, 99))
def test_noise_alone_is_not_taken_for_spikes(noise, seed):
    values = 0.5 + noise * np.random.default_rng(seed).normal(size=(100, 100)).clip(-5, 5)
    assert clean(values)["filled"].sum() <= 1


def test_steps_ridges_and_peaks_of_the_sample_stay():
    step = np.where(np.arange(40) < 20, 0.3, 0.5) * np.ones((30, 1))
    ridge = np.full((30, 40), 0.5)
    ridge[:, 20] = 0.3
    diagonal = np.where(np.eye(30, 40, dtype=bool), 0.3, 0.5)
    corner = np.full((30, 40), 0.5)
    corner[15:, 20:] = 0.3
    y, x = np.mgrid[:30, :40] - 15.0
    cone = 0.3 + 0.008 * np.hypot(x, y)
    for relief in (step, ridge, diagonal, corner, cone, wavy()):
        assert not clean(relief)["filled"].any()


def test_real_relief_stays(shared_data):
    layers = shared_data / "layers"
    coin = read_thickness_map(layers / "coin_5c_1-thickness.mat", field_of_view=(5, 5))
    assert clean_thickness(coin).attrs["filled_share"] == 0
    sinusoid = read_thickness_map(layers / "sinusoid_simulated_L1.npz")
    assert clean_thickness(sinusoid).attrs["filled_share"] == 0


def test_spikes_on_real_relief_are_all_found_and_nothing_else(shared_data):
    coin = read_thickness_map(
        shared_data / "layers" / "coin_5c_1-thickness.mat", field_of_view=(5, 5)
    )
    random = np.random.default_rng(0)
    spikes = random.random(coin.shape) < 0.001
    damaged = coin.copy(
        data=coin.values + np.where(spikes, random.choice([-0.1, 0.1], coin.shape), 0)
    )
    damaged.values[random.random(coin.shape) < 0.02] = np.nan
    result = clean_thickness(damaged)
    np.testing.assert_array_equal(result["filled"], spikes | np.isnan(damaged.values))
    error = np.abs(result["thickness"] - coin).values[result["filled"].values]
    assert np.median(error) < 0.0005
    assert error.max() < 0.02


def test_large_gap_is_filled_with_the_harmonic_function():
    y, x = np.mgrid[:60, :80] / 50
    harmonic = 0.5 + 0.02 * (x**2 - y**2) + 0.05 * x * y
    values = harmonic.copy()
    values[10:50, 10:70] = np.nan
    np.testing.assert_allclose(clean(values)["thickness"], harmonic, atol=1e-12)
    # Pixels twice as wide as high: the same function of position.
    values, wide = values[:, ::2], harmonic[:, ::2]
    result = clean(values, pixel_spacing=(0.04, 0.02))
    np.testing.assert_allclose(result["thickness"], wide, atol=1e-12)


def test_gap_reaching_the_border_and_islands():
    values = np.full((20, 30), np.nan)
    values[3, 4] = 0.4
    np.testing.assert_allclose(clean(values)["thickness"], 0.4)
    values[:, 20:] = 0.5
    filled = clean(values)["thickness"].values
    assert filled[3, 4] == 0.4
    assert np.all((filled >= 0.4) & (filled <= 0.5 + 1e-12))


def test_coordinates_and_attributes_are_kept():
    map_ = thickness_map(wavy(), x=np.geomspace(1, 2, 80), y=np.arange(60.0), where="here")
    result = clean_thickness(map_.transpose("x", "y"))
    assert result["thickness"].dims == ("y", "x")
    xr.testing.assert_equal(result["x"], map_["x"])
    assert result["thickness"].attrs["layer_extent"] == map_.attrs["layer_extent"]
    assert result["thickness"].attrs["units"] == "mm"


def test_nothing_to_fill_from():
    map_ = thickness_map(wavy(), pixel_spacing=(0.01, 0.01))
    with pytest.raises(InputError, match="all of the thickness map is missing"):
        clean_thickness(map_ * np.nan)
    with pytest.raises(InputError, match=r"\(y, x\)"):
        clean_thickness(map_.rename(x="z"))


@pytest.mark.parametrize("gap", ["third of the pixels", "half of the map"])
def test_full_map_with_a_large_gap(gap):
    values = wavy((500, 500))
    if gap == "third of the pixels":
        values[np.random.default_rng(1).random(values.shape) < 1 / 3] = np.nan
    else:
        values[50:400, 80:430] = np.nan
    map_ = thickness_map(values, field_of_view=(5, 5))
    filled = clean_thickness(map_)["thickness"].values
    seen = ~np.isnan(values)
    np.testing.assert_array_equal(filled[seen], values[seen])
    # Laplace's equation: no extremum but at the good pixels
    assert values[seen].min() <= filled.min()
    assert filled.max() <= values[seen].max()
