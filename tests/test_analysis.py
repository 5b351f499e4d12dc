from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from scipy.special import erf

from optical_palpation.analysis import (
    Noise,
    compare_maps,
    edge_response,
    feature_contrast,
    force_balance,
    perturbation_correlation,
    propagate_uncertainty,
)
from optical_palpation.errors import InputError
from optical_palpation.palpation.result import StressResult


def grid(ny=81, nx=101, dy=0.05, dx=0.04):
    return np.arange(ny) * dy, np.arange(nx) * dx


def field(values, y=None, x=None, **attrs):
    values = np.asarray(values, dtype=float)
    y = np.arange(values.shape[0]) * 0.05 if y is None else y
    x = np.arange(values.shape[1]) * 0.04 if x is None else x
    return xr.DataArray(values, dims=("y", "x"), coords={"y": y, "x": x}, attrs=attrs)


# ---- force


def test_force_of_a_paraboloid_of_pressure():
    # Pressure p0 (1 - r^2/a^2) over a disc adds up to pi a^2 p0 / 2.
    step = 0.01
    y = x = np.arange(-1.5, 1.5 + step / 2, step)
    r2 = y[:, None] ** 2 + x[None, :] ** 2
    p0, a = 12.0, 1.2
    balance = force_balance(field(-p0 * np.clip(1.0 - r2 / a**2, 0.0, None), y, x))
    assert balance.force == pytest.approx(np.pi * a**2 * p0 / 2.0, rel=1e-4)
    assert balance.mean_stress == pytest.approx(balance.force / balance.area)
    assert balance.missing == 0.0


def test_force_and_mean_of_a_slope_over_all_of_a_map():
    y, x = grid(ny=5, nx=4)  # so few points that those at the rim count
    stress = field(-(x**2 + 3 * y[:, None]), y, x)
    balance = force_balance(stress)
    force = -float(stress.integrate(["y", "x"]))
    assert balance.force == pytest.approx(force)
    assert balance.area == pytest.approx(x[-1] * y[-1])
    assert balance.mean_stress == pytest.approx(force / (x[-1] * y[-1]))


def test_load_cell_sees_the_whole_layer_and_the_map_a_part():
    stress = field(np.full((51, 41), -8.0))
    stress[:10] = np.nan
    balance = force_balance(stress, measured_force=250.0, layer_area=25.0)
    assert balance.mean_stress == pytest.approx(8.0)
    assert balance.area == pytest.approx(40.5 * 40 * 0.05 * 0.04)
    assert balance.force == pytest.approx(8.0 * balance.area)
    assert balance.missing == pytest.approx(9.5 / 50)
    assert balance.expected_stress == pytest.approx(10.0)
    assert balance.relative_difference == pytest.approx(-0.2)
    with pytest.raises(InputError, match="positive"):
        force_balance(stress, measured_force=-250.0)
    with pytest.raises(InputError, match="no finite"):
        force_balance(stress * np.nan)
    with pytest.raises(InputError, match="equal steps"):
        force_balance(stress.assign_coords(x=stress["x"] ** 2))
    with pytest.raises(InputError, match=r"sortby\('y'\)"):
        force_balance(stress[::-1])
    with pytest.raises(InputError, match="over y and x"):
        force_balance(stress[0])


# ---- resolution


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_gaussian_edge(sign, noise):
    # An edge blurred by a Gaussian of standard deviation s rises from 10 to 90 % over 2.5631 s
    # and its gradient is 2.3548 s wide at half maximum.
    s, at = 0.03, 0.413
    x = np.arange(0.0, 1.0, 0.004)
    stress = -20.0 + sign * 7.5 * erf((x - at) / (np.sqrt(2.0) * s))
    # Ripples away from the edge must not matter.
    stress += 0.6 * np.sin(60.0 * x) * (np.abs(x - at) > 0.2)
    stress += 15.0 * noise * np.random.default_rng(1).standard_normal(x.size)
    edge = edge_response(
        xr.DataArray(stress, dims="x", coords={"x": x}),
        levels=(-20.0 - sign * 7.5, -20.0 + sign * 7.5),
    )
    tolerance = 0.002 if noise == 0.0 else 0.05
    assert edge.rise == pytest.approx(2.5631 * s, rel=tolerance)
    assert edge.gradient_width == pytest.approx(2.3548 * s, rel=0.01 if noise == 0.0 else 0.3)
    assert edge.position == pytest.approx(at, abs=0.002)


def test_linear_ramp_and_plateaus_found():
    x = np.linspace(-1.0, 1.0, 401)
    stress = np.interp(x, [-0.1, 0.2], [-3.0, -9.0])
    edge = edge_response(xr.DataArray(stress, dims="y", coords={"y": x}))
    assert edge.levels == (-3.0, -9.0)
    assert edge.rise == pytest.approx(0.8 * 0.3, rel=1e-6)
    assert edge.gradient_width == pytest.approx(0.3, abs=0.011)
    assert edge.position == pytest.approx(0.05, abs=1e-9)


def test_profiles_without_an_edge_are_refused():
    x = np.linspace(0.0, 1.0, 50)

    def profile(values):
        return xr.DataArray(values, dims="x", coords={"x": x})

    with pytest.raises(InputError, match="no edge"):
        edge_response(profile(np.ones(50)))
    with pytest.raises(InputError, match="middle"):
        edge_response(profile(np.linspace(0.0, 1.0, 50)), levels=(3.0, 5.0))
    with pytest.raises(InputError, match="longer profile"):
        edge_response(profile(np.linspace(0.3, 1.0, 50)), levels=(0.0, 1.0))
    with pytest.raises(InputError, match="finite"):
        edge_response(profile(np.full(50, np.nan)))
    with pytest.raises(InputError, match="at least 5"):
        edge_response(profile(x)[:3])


# ---- features


def test_contrast_of_a_disc_in_noise():
    y, x = grid(161, 161, 0.02, 0.02)
    r = np.hypot(y[:, None] - 1.6, x[None, :] - 1.6)
    rng = np.random.default_rng(3)
    # A slope under the feature is background, not noise.
    stress = -5.0 - 4.0 * (r <= 0.3) + 0.8 * (x - 1.6) + rng.normal(0.0, 0.25, r.shape)
    mask = xr.DataArray(r <= 0.3, dims=("y", "x"))
    contrast = feature_contrast(field(stress, y, x), mask, width=0.5, gap=0.1)
    assert contrast.noise == pytest.approx(0.25, rel=0.03)
    assert contrast.stress == pytest.approx(-9.0, abs=0.03)
    assert contrast.background == pytest.approx(-5.0, abs=0.03)
    assert contrast.stress_to_noise == pytest.approx(9.0 / 0.25, rel=0.03)
    assert contrast.contrast_to_noise == pytest.approx(4.0 / 0.25, rel=0.03)
    with pytest.raises(InputError, match="widen"):
        feature_contrast(field(stress, y, x), mask, width=0.001)
    with pytest.raises(InputError, match="mask"):
        feature_contrast(field(stress, y, x), mask.astype(int), width=0.5)


@pytest.mark.parametrize("ratio", [0.0, 0.62, 2.0])
def test_correlation_of_texture_in_noise(ratio):
    # Texture t in both maps and independent noise of `ratio` its power in one of them: the
    # coefficient is 1 / sqrt(1 + ratio). Form on the large scale must not count.
    y, x = grid(200, 220, 0.02, 0.02)
    rng = np.random.default_rng(5)
    texture = rng.standard_normal((200, 220))
    form = 50.0 * np.sin(x)[None, :] + 20.0 * y[:, None]
    noise = np.sqrt(ratio) * rng.standard_normal((200, 220))
    thickness = field(0.5 + 0.007 * texture + 0.002 * form, y, x)
    stress = field(-10.0 + 3.0 * (texture + noise) - 0.3 * form, y, x)
    stress[:20, 30:60] = np.nan
    found = perturbation_correlation(thickness, stress, scale=0.1)
    assert found.coefficient == pytest.approx(1.0 / np.sqrt(1.0 + ratio), abs=0.015)
    assert found.shift == (0.0, 0.0)
    assert perturbation_correlation(thickness, -stress, 0.1).coefficient == pytest.approx(
        -found.coefficient
    )


def test_shift_between_maps_is_found():
    y, x = grid(200, 220, 0.02, 0.03)
    texture = np.random.default_rng(6).standard_normal((210, 230))
    a = field(texture[5:205, 5:225], y, x)
    b = field(texture[8:208, 3:223], y, x)  # b[r] = a[r + (3, -2)]: b's content sits at (-3, +2)
    found = perturbation_correlation(a, b, scale=0.2)
    assert found.peak == pytest.approx(1.0, abs=0.05)
    assert abs(found.coefficient) < 0.05
    assert found.shift == pytest.approx((-3 * 0.02, 2 * 0.03))
    with pytest.raises(InputError, match="same grid"):
        perturbation_correlation(a, b[1:], 0.2)
    with pytest.raises(InputError, match="larger than a pixel"):
        perturbation_correlation(a, b, 0.01)
    with pytest.raises(InputError, match="no perturbations"):
        perturbation_correlation(a, b * 0.0, 0.2)


# ---- comparison


def test_zones_of_a_difference():
    y, x = grid(81, 101, 0.05, 0.04)  # 4 x 4 mm
    reference = field(np.full((81, 101), -10.0), y, x, units="kPa")
    border = np.minimum.outer(np.minimum(y, 4.0 - y), np.minimum(x, 4.0 - x))
    other = reference + xr.where(field(border, y, x) < 0.5 - 1e-9, 3.0, -1.0)
    result = compare_maps(other, reference, edge_width=0.5).set_index(zone="zone")
    inner, edge, everything = (result.sel(zone=z) for z in ("interior", "edge", "all"))
    assert float(inner["rms"]) == pytest.approx(1.0)
    assert float(inner["relative_rms"]) == pytest.approx(0.1)
    assert float(inner["bias"]) == pytest.approx(-1.0)
    assert float(inner["relative_bias"]) == pytest.approx(0.1)
    assert float(edge["bias"]) == pytest.approx(3.0)
    assert float(edge["largest"]) == pytest.approx(3.0)
    assert int(inner["pixels"]) + int(edge["pixels"]) == int(everything["pixels"]) == 81 * 101
    share = int(edge["pixels"]) / (81 * 101)
    assert float(everything["rms"]) == pytest.approx(np.sqrt(9.0 * share + 1.0 - share))
    assert result["difference"].attrs["units"] == "kPa"


def test_maps_on_different_grids():
    # A plane is reproduced exactly by linear interpolation.
    def plane(y, x):
        return field(-3.0 - 2.0 * y[:, None] + 0.5 * x[None, :], y, x)

    coarse = plane(np.linspace(0.0, 2.0, 11), np.linspace(-1.0, 1.5, 9))
    fine = plane(np.linspace(-0.5, 2.0, 60), np.linspace(-1.0, 2.0, 70))
    result = compare_maps(coarse, fine + 0.25, edge_width=0.2)
    inside = (fine["y"] >= 0.0).sum() * (fine["x"] <= 1.5).sum()
    assert int(result["pixels"][2]) == int(inside)
    np.testing.assert_allclose(result["bias"][:2], -0.25, atol=1e-12)
    np.testing.assert_allclose(result["rms"][2], 0.25, atol=1e-12)
    with pytest.raises(InputError, match="do not overlap"):
        compare_maps(coarse.assign_coords(x=coarse["x"] + 9.0), fine)
    with pytest.raises(InputError, match="MPa"):
        compare_maps(coarse.assign_attrs(units="MPa"), fine.assign_attrs(units="kPa"))


# ---- uncertainty


def result_of(stress, **attrs):
    return StressResult(xr.Dataset({"axial_stress": stress}, attrs=attrs))


def test_systematic_errors_by_hand():
    shape = field(1.0 + np.arange(12.0).reshape(3, 4))
    calls = []

    def solve(window_friction, modulus):
        calls.append((window_friction, modulus))
        # Quadratic in friction: central differences are still exact.
        return result_of(
            -modulus * (1.0 + 4.0 * window_friction + 5.0 * window_friction**2) * shape
        )

    errors = {"window_friction": 0.05, "modulus": 0.3}
    out = propagate_uncertainty(solve, {"window_friction": 0.2, "modulus": 10.0}, errors)
    assert len(calls) == 5
    by_friction = 10.0 * (4.0 + 10.0 * 0.2) * 0.05 * shape
    by_modulus = (1.0 + 0.8 + 0.2) * 0.3 * shape
    contribution = out["contribution"]
    np.testing.assert_allclose(contribution.sel(input="window_friction"), by_friction)
    np.testing.assert_allclose(contribution.sel(input="modulus"), by_modulus)
    np.testing.assert_allclose(out["axial_stress_error"], np.hypot(by_friction, by_modulus))
    expected = np.hypot(*(part.integrate(["y", "x"]) for part in (by_friction, by_modulus)))
    assert out.attrs["force_error_mN"] == pytest.approx(float(expected))
    area = 0.1 * 0.12  # over which the slope is 6.5 on average
    assert out.attrs["force_mN"] == pytest.approx(20.0 * 6.5 * area)
    # Second difference 10 * 5 * 0.05^2 * 2 over twice the first, 10 * 6 * 0.05 * 2.
    np.testing.assert_allclose(
        out["nonlinearity"], [0.05**2 * 50.0 / (60.0 * 0.05), 0.0], atol=1e-9
    )

    # The force the solver reports goes before the sum of its map, and a given solution is used.
    calls.clear()
    nominal = result_of(-shape, sample_force_mN=7.0)
    out = propagate_uncertainty(
        solve, {"window_friction": 0.2, "modulus": 10.0}, errors, nominal=nominal
    )
    assert len(calls) == 4
    assert out.attrs["force_mN"] == 7.0


def test_friction_near_zero_is_differenced_one_sided():
    shape = field(np.ones((3, 4)))
    seen = []

    def solve(window_friction):
        seen.append(window_friction)
        return result_of(-(2.0 + 3.0 * window_friction) * shape)

    out = propagate_uncertainty(solve, {"window_friction": 0.02}, {"window_friction": 0.05})
    assert min(seen) == 0.0
    np.testing.assert_allclose(out["axial_stress_error"], 3.0 * 0.05)


def test_random_noise_of_a_map():
    # Each pixel's stress is the sum of its 3 x 3 neighbours times a gain: independent noise of
    # standard deviation s gives gain * 3 s, and the total force sees 9 gain s sqrt(pixels) dA.
    y, x = grid(60, 60, 0.05, 0.04)
    gain = field(np.where(x[None, :] < 1.2, 2.0, 5.0) * np.ones((60, 1)), y, x)

    def solve(thickness):
        total = sum(
            np.roll(thickness.values, (i, j), axis=(0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)
        )
        return result_of(gain * thickness.copy(data=total))

    values = {"thickness": field(np.full((60, 60), 0.5), y, x)}
    noise = Noise(0.001, probes=6, smoothing=2.0)
    out = propagate_uncertainty(solve, values, {"thickness": noise})
    error = out["axial_stress_error"]
    left, right = error[8:-8, 8:22], error[8:-8, 40:-8]
    assert float((left**2).mean()) ** 0.5 == pytest.approx(2.0 * 3.0 * 0.001, rel=0.1)
    assert float((right**2).mean()) ** 0.5 == pytest.approx(5.0 * 3.0 * 0.001, rel=0.1)
    assert float(left.std() / left.mean()) < 0.25
    exact = 9.0 * 0.001 * float((gain**2).sum()) ** 0.5 * 0.05 * 0.04
    many = propagate_uncertainty(solve, values, {"thickness": Noise(0.001, probes=60)})
    assert many.attrs["force_error_mN"] == pytest.approx(exact, rel=0.25)


def test_correlated_noise_has_the_stated_deviation():
    y, x = grid(80, 80)

    def solve(thickness):
        return result_of(3.0 * thickness)

    values = {"thickness": field(np.zeros((80, 80)), y, x)}
    errors = [
        propagate_uncertainty(
            solve, values, {"thickness": Noise(0.01, correlation=c, probes=20, smoothing=0.0)}
        )
        for c in (0.0, 2.0)
    ]
    for out in errors:
        rms = float((out["axial_stress_error"] ** 2).mean() ** 0.5)
        assert rms == pytest.approx(0.03, rel=0.05)
    # Neighbours that err together do not cancel in the force.
    forces = [out.attrs["force_error_mN"] for out in errors]
    assert forces[1] > 3.0 * forces[0]


def test_error_halves_linearly_and_bad_calls_are_refused():
    def solve(a, loaded):
        return result_of(-np.exp(a) * loaded)

    values = {"a": 0.1, "loaded": field(np.ones((4, 4)))}
    sizes = [
        propagate_uncertainty(solve, values, {"a": error}).attrs["force_error_mN"]
        for error in (0.04, 0.02, 0.01)
    ]
    assert all(a / b == pytest.approx(2.0, abs=1e-3) for a, b in pairwise(sizes))
    with pytest.raises(InputError, match="unknown inputs: b"):
        propagate_uncertainty(solve, values, {"b": 0.1})
    with pytest.raises(InputError, match="positive"):
        propagate_uncertainty(solve, values, {"a": 0.0})
    with pytest.raises(InputError, match="needs a map"):
        propagate_uncertainty(solve, values, {"a": Noise(0.1)})
    with pytest.raises(InputError, match="probe"):
        Noise(0.1, probes=0)
    with pytest.raises(InputError, match="leave no room"):
        propagate_uncertainty(solve, values, {"a": 0.1}, bounds={"a": (0.1, 0.1)})


def test_uncertainty_figure(tmp_path):
    from optical_palpation.present.uncertainty_figure import write_uncertainty_figure

    y, x = grid(40, 60)
    loaded = field(0.4 + 0.03 * np.cos(4.0 * x)[None, :] * np.cos(3.0 * y)[:, None], y, x)

    def solve(window_friction, loaded):
        return result_of(-(20.0 + 60.0 * window_friction) * (0.5 - loaded) / 0.5)

    values = {"window_friction": 0.15, "loaded": loaded}
    out = propagate_uncertainty(solve, values, {"window_friction": 0.05, "loaded": Noise(0.005)})
    write_uncertainty_figure(out, tmp_path / "u.svg")
    text = (tmp_path / "u.svg").read_text(encoding="utf-8")
    assert "FillBetweenPolyCollection" in text or "PolyCollection" in text
    write_uncertainty_figure(out, tmp_path / "u.png")
    assert (tmp_path / "u.png").stat().st_size > 20_000
