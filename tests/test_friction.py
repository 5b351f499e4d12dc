from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from optical_palpation.errors import InputError, OutputError
from optical_palpation.experiment.synthetic_oct import complex_pair
from optical_palpation.friction import (
    axial_strain,
    calibration_curves,
    displacement_profile,
    doubts_about,
    estimate_friction,
    read_profile,
    slab_profile,
)
from optical_palpation.material import MooneyRivlin

PHASE = Path(__file__).resolve().parents[2] / "shared" / "data" / "phase" / "lpl2024_figure5.npz"
needs_phase = pytest.mark.skipif(not PHASE.is_file(), reason="no published phase data at hand")
OPTICS = {"wavelength": 1.3e-3, "refractive_index": 1.4}
LAYER = MooneyRivlin(2.23, 0.703)


# ---- strain


def published():
    data = np.load(PHASE)
    optics = {
        "spacing": float(data["dz_um"]) / 1e3,
        "wavelength": float(data["wavelength_um"]) / 1e3,
        "refractive_index": float(data["refractive_index"]),
    }
    return data, optics


@needs_phase
@pytest.mark.parametrize("cut", [0, 2, 5])
@pytest.mark.parametrize(("layer", "stated"), [(0, 1.01e-2), (1, 9.1e-4)])
def test_strain_of_published_layers(layer, stated, cut):
    data, optics = published()
    first, last = data["layer_rows"][layer]
    rows = slice(first + cut, last - cut)
    strain, error = axial_strain(data["before"][rows], data["after"][rows], **optics)
    assert -strain == pytest.approx(stated, rel=0.02)
    assert 0.0 < error < 0.02 * stated


@needs_phase
def test_strain_range_of_the_published_layer_that_varies_laterally():
    data, optics = published()
    first, last = data["layer_rows"][2]
    before, after = data["before"][first + 4 : last - 4], data["after"][first + 4 : last - 4]
    strain = np.array(
        [-axial_strain(before[:, [k]], after[:, [k]], **optics)[0] for k in range(before.shape[1])]
    )
    assert strain.min() == pytest.approx(float(data["strain_L3_min"]), rel=0.02)
    assert strain.max() == pytest.approx(float(data["strain_L3_max"]), rel=0.02)


@pytest.mark.parametrize("strain", [-0.012, -0.002, 0.004])
def test_strain_of_synthetic_speckle(strain):
    # 5.5 um resolution sampled at 2 um: neighbours share the point-spread function.
    z = 0.002 * np.arange(64)
    u = np.broadcast_to((strain * z)[:, None, None], (64, 6, 40)).copy()
    before, after = complex_pair(u, spacing=(0.002, 0.01, 0.01), snr_db=15.0, seed=2)
    found, error = axial_strain(before, after, spacing=0.002, **OPTICS)
    assert found == pytest.approx(strain, abs=0.01 * abs(strain) + 4.0 * error)
    assert error < 0.02 * abs(strain) + 2e-5
    # Phases that jump from A-scan to A-scan do not matter.
    jitter = np.exp(2j * np.pi * np.random.default_rng(0).random((6, 40)))
    again, _ = axial_strain(before, after * jitter, spacing=0.002, **OPTICS)
    assert again == pytest.approx(found, rel=1e-6)


# ---- displacement profiles


def pair(curve, *, step=8e-4, snr_db=10.0, seed=0, shape=(128, 24, 24), window=0.04, layer=0.4):
    """Complex volumes of a layer from `window` to `window + layer` mm on a sample, 4 um pixels."""
    z = 0.004 * np.arange(shape[0])
    u = -step * curve(np.clip((z - window) / layer, 0.0, 1.0))
    u = np.broadcast_to(u[:, None, None], shape).copy()
    return complex_pair(u, spacing=(0.004, 0.01, 0.01), snr_db=snr_db, seed=seed)


def stuck(depth):
    """Profile of a thin layer that sticks to both faces (Reynolds' squeeze film)."""
    return 3.0 * depth**2 - 2.0 * depth**3


FACES = {"window_depth": 0.04, "sample_depth": 0.44}


@pytest.mark.parametrize("step", [8e-4, 2e-4, -8e-4])
@pytest.mark.parametrize("snr_db", [15.0, 0.0])
def test_displacement_is_measured_within_its_error(step, snr_db):
    before, after = pair(stuck, step=step, snr_db=snr_db)
    profile = displacement_profile(before, after, spacing=0.004, **OPTICS, **FACES)
    depth = profile["depth"].values
    assert depth[0] == pytest.approx(0.03, abs=0.011)
    deviation = profile["displacement"].values + step * stuck(depth)
    pull = deviation / profile["standard_error"].values
    assert np.sqrt(np.mean(pull**2)) < 1.5
    assert np.sqrt(np.mean(deviation**2)) < 0.02 * abs(step)
    # About one speckle in 10 x 13 um, the lateral spacing and resolution.
    assert 24**2 / 8 < profile.attrs["independent_speckles"] <= 24**2


def test_phase_wraps_are_undone():
    # 3 um are 81 rad over 100 pixels.
    before, after = pair(stuck, step=3e-3, snr_db=20.0)
    profile = displacement_profile(before, after, spacing=0.004, **OPTICS, **FACES)
    expected = -3e-3 * stuck(profile["depth"].values)
    np.testing.assert_allclose(profile["displacement"], expected, atol=6e-5)


def test_noise_dominated_a_scans_drop_out():
    before, after = pair(stuck, snr_db=15.0)
    rng = np.random.default_rng(4)
    dark = rng.random((24, 24)) < 0.5
    for volume in (before, after):
        noise = rng.standard_normal((2, *volume.shape))
        volume[:, dark] = (noise[0] + 1j * noise[1])[:, dark] * 0.3
    profile = displacement_profile(before, after, spacing=0.004, **OPTICS, **FACES)
    expected = -8e-4 * stuck(profile["depth"].values)
    np.testing.assert_allclose(profile["displacement"], expected, atol=4e-5)


def test_window_is_the_reference_without_a_common_path():
    before, after = pair(stuck, snr_db=15.0)
    for volume in (before, after):
        volume[10] += 200.0  # the window's reflection at 40 um
    jitter = np.exp(2j * np.pi * np.random.default_rng(0).random((24, 24)))
    arguments = {"spacing": 0.004, **OPTICS, **FACES, "margin": 0.03}
    with pytest.raises(InputError, match="coherence"):
        displacement_profile(before, after * jitter, **arguments)
    profile = displacement_profile(before, after * jitter, common_path=False, **arguments)
    expected = -8e-4 * stuck(profile["depth"].values)
    np.testing.assert_allclose(profile["displacement"], expected, atol=4e-5)


def test_unusable_volumes_are_refused():
    before, after = pair(stuck, shape=(128, 4, 4))
    arguments = {"spacing": 0.004, **OPTICS}
    cases = [
        ((np.abs(before), after), FACES, "complex"),
        ((before, after[1:]), FACES, "shapes"),
        ((before * np.nan, after), FACES, "finite"),
        ((0.0 * before, after), FACES, "there is no signal"),
        ((before, before.copy()), FACES, "are the same"),
        ((before, after), {"window_depth": 0.5, "sample_depth": 0.1}, "in this order"),
        ((before, after), {"window_depth": 0.1, "sample_depth": 9.0}, "inside the volume"),
        ((before, after), {"window_depth": 0.1, "sample_depth": 0.13}, "at least 8"),
    ]
    for volumes, faces, message in cases:
        with pytest.raises(InputError, match=message):
            displacement_profile(*volumes, **arguments, **faces)
    for wavelength in (-1.0, 1300.0, 1.3, np.nan):
        with pytest.raises(InputError, match="wavelength"):
            axial_strain(before, after, spacing=0.004, wavelength=wavelength, refractive_index=1.4)
    with pytest.raises(InputError, match="4 pixels"):
        axial_strain(before[:3], after[:3], **arguments)


# ---- the estimator, on a family of curves between even strain and full sticking


def family(mu, depth):
    share = mu / (mu + 0.3)
    return (1.0 - share) * depth + share * stuck(depth)


MU = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5])
DEPTH = np.linspace(0.0, 1.0, 41)
CALIBRATION = xr.DataArray(
    [family(mu, DEPTH) for mu in MU],
    dims=("friction", "depth"),
    coords={"friction": MU, "depth": DEPTH},
)


def profile_of(mu, noise=0.0, seed=0, step=-7e-4, offset=0.0, error=True):
    depth = np.linspace(0.03, 0.97, 90)
    rng = np.random.default_rng(seed)
    spread = noise * (0.3 + depth)
    values = step * (family(mu, depth) + spread * rng.standard_normal(depth.size)) + offset
    data = {"displacement": ("depth", values)}
    if error and noise > 0.0:
        data["standard_error"] = ("depth", abs(step) * spread)
    return xr.Dataset(data, coords={"depth": depth})


@pytest.mark.parametrize("mu", [0.03, 0.12, 0.25, 0.47])
def test_exact_profile_gives_the_coefficient(mu):
    found = estimate_friction(profile_of(mu), CALIBRATION)
    assert found.coefficient == pytest.approx(mu, abs=0.002)
    assert found.step == pytest.approx(-7e-4, rel=1e-3)
    assert not found.at_limit
    with_offset = estimate_friction(profile_of(mu, offset=2e-4), CALIBRATION, fit_offset=True)
    assert with_offset.coefficient == pytest.approx(mu, abs=0.002)
    assert with_offset.offset == pytest.approx(2e-4, abs=2e-6)


@pytest.mark.parametrize("error", [True, False])
def test_confidence_interval_covers(error):
    estimates = [
        estimate_friction(profile_of(0.2, 0.01, seed, error=error), CALIBRATION)
        for seed in range(100)
    ]
    hits = sum(e.interval[0] <= 0.2 <= e.interval[1] for e in estimates)
    assert 86 <= hits <= 100
    widths = np.array([e.interval[1] - e.interval[0] for e in estimates])
    spread = np.std([e.coefficient for e in estimates])
    assert np.median(widths) == pytest.approx(2.0 * 1.96 * spread, rel=0.4)


def test_outside_the_calibration_is_said():
    found = estimate_friction(profile_of(0.9, 0.003), CALIBRATION)
    assert found.at_limit
    assert found.coefficient == pytest.approx(0.5)
    assert found.interval[1] == 0.5


def test_profile_from_csv(tmp_path):
    profile = profile_of(0.25, 0.002)
    table = np.column_stack(
        [profile["depth"] * 0.4, profile["displacement"] * 1e6, profile["standard_error"] * 1e6]
    )
    path = tmp_path / "profile.csv"
    header = "depth_mm,displacement_nm,displacement_error_nm"
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    found = estimate_friction(read_profile(path, thickness=0.4), CALIBRATION)
    same = estimate_friction(profile, CALIBRATION)
    assert found.coefficient == pytest.approx(same.coefficient, abs=1e-5)
    assert found.step == pytest.approx(same.step * 1e6, rel=1e-6)
    np.savetxt(path, table[:, :2], delimiter=",", header="Depth (mm),Displacement", comments="")
    assert "standard_error" not in read_profile(path, thickness=0.4)
    with pytest.raises(InputError, match="within 0 and 1"):
        read_profile(path, thickness=0.2)
    for text, message in [
        ("", "cannot be read"),
        ("depth,height\n0,1\n", "no column for the displacement"),
        ("depth,displacement\n0,1\n0.1,x\n", "row 2"),
    ]:
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=message):
            read_profile(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_profile(tmp_path / "absent.csv")


def test_unusable_profiles_and_calibrations_are_refused():
    good = profile_of(0.2)
    for profile, message in [
        (good.rename(displacement="u"), "displacement"),
        (good.isel(depth=slice(4)), "at least 6"),
        (good.assign_coords(depth=good["depth"] * 300.0), "within 0 and 1"),
        (good * np.nan, "finite"),
        (good.assign(standard_error=0.0 * good["displacement"]), "positive"),
        (good * 0.0, "no displacement"),
    ]:
        with pytest.raises(InputError, match=message):
            estimate_friction(profile, CALIBRATION)
    for calibration, message in [
        (CALIBRATION.rename(friction="mu"), "dimensions"),
        (CALIBRATION[:1], "at least 2"),
        (CALIBRATION * np.nan, "finite"),
        (CALIBRATION.assign_coords(friction=np.zeros(7)), "different"),
    ]:
        with pytest.raises(InputError, match=message):
            estimate_friction(good, calibration)


@pytest.mark.parametrize("fit_offset", [False, True])
def test_what_no_friction_gives_is_refused(fit_offset):
    good = profile_of(0.2, 0.002)
    noise = np.random.default_rng(0).standard_normal((20, good["depth"].size))
    cases = [good.assign(displacement=("depth", row)) for row in noise]
    cases.append(good.assign(displacement=("depth", 1.0 + 0.01 * noise[0])))
    if not fit_offset:
        cases.append(good.assign_coords(depth=1.0 - good["depth"]))
    for profile in cases:
        with pytest.raises(InputError, match=r"no displacement|from every calibration curve by"):
            estimate_friction(
                profile.drop_vars("standard_error"), CALIBRATION, fit_offset=fit_offset
            )


def test_what_casts_doubt_on_an_estimate():
    calibration = CALIBRATION.assign_attrs(step_mm=5e-4)

    def doubts(profile, **attrs):
        profile["displacement"].attrs |= attrs
        return doubts_about(estimate_friction(profile, calibration), calibration)

    assert doubts(profile_of(0.2), units="mm") == []
    assert doubts(profile_of(0.2, step=-7.0)) == []  # in which unit, nobody knows
    (size,) = doubts(profile_of(0.2), units="um")
    assert "step of 0.0007 um is not that of the calibration, 0.5 um" in size
    (sign,) = doubts(profile_of(0.2, step=7e-4), units="mm")
    assert "volumes in their order" in sign
    bent = profile_of(0.2)
    bent["displacement"] += 1.5e-4 * np.sin(20.0 * bent["depth"])
    (misfit,) = doubts(bent, units="mm")
    assert "% of the step" in misfit


def test_figure(tmp_path):
    from optical_palpation.present.friction_figure import write_friction_figure

    estimate = estimate_friction(profile_of(0.2, 0.01), CALIBRATION)
    write_friction_figure(CALIBRATION, tmp_path / "a.svg", estimate)
    write_friction_figure(CALIBRATION, tmp_path / "b.svg")
    texts = [(tmp_path / name).read_text(encoding="utf-8") for name in ("a.svg", "b.svg")]
    assert all(text.count('<g id="line2d_') > 15 for text in texts)
    assert len(texts[0]) > len(texts[1])
    with pytest.raises(OutputError):
        write_friction_figure(CALIBRATION, tmp_path / "c.txt")


# ---- calibration


@pytest.mark.slow
def test_thin_layer_that_sticks_flows_as_a_squeeze_film():
    # Small compression and friction that holds: Reynolds' lubrication profile, whatever the
    # region, for a layer much wider than thick.
    slab = slab_profile(
        5.0,
        layer_size=(3.0, 3.0),
        initial_thickness=0.3,
        loaded_thickness=0.297,
        material=LAYER,
        region=1.2,
        sample_friction=5.0,
        elements=6,
    )
    increment = (slab["increment"] / slab["increment"][-1]).values
    np.testing.assert_allclose(increment, stuck(slab["depth"].values), atol=0.012)


def test_no_friction_strains_evenly():
    slab = slab_profile(
        0.0,
        layer_size=(2.0, 1.2),
        initial_thickness=0.5,
        loaded_thickness=0.35,
        material=LAYER,
        region=1.0,
        sample_friction=1e-4,  # enough to keep the layer from floating sideways
        elements=2,
    )
    np.testing.assert_allclose(slab["increment"] / slab["increment"][-1], slab["depth"], atol=1e-3)
    np.testing.assert_allclose(slab["depth"], slab["unloaded_depth"], atol=1e-3)
    stretch = 0.7
    force = -float(LAYER.uniaxial_stress(stretch - 1.0)) * 2.4
    assert slab.attrs["force_mN"] == pytest.approx(force, rel=1e-3)


def test_impossible_slabs_are_refused():
    good = {
        "layer_size": (3.0, 3.0),
        "initial_thickness": 0.5,
        "loaded_thickness": 0.4,
        "material": LAYER,
        "region": 1.0,
    }
    for change, message in [
        ({"loaded_thickness": 0.6}, "between 0"),
        ({"step": 0.0}, "step"),
        ({"region": 4.0}, "region"),
        ({"sample_friction": -0.1}, "negative"),
        ({"sample_friction": np.nan}, "sample_friction: a coefficient"),
        ({"layer_size": (np.inf, 3.0)}, "layer_size: two lengths"),
        ({"initial_thickness": np.inf}, "initial_thickness: a length"),
        ({"step": np.nan}, "step: a length"),
    ]:
        with pytest.raises(InputError, match=message):
            slab_profile(0.1, **{**good, **change})
    with pytest.raises(InputError, match="increasing"):
        calibration_curves([0.2, 0.1], **good)
    for coefficients, changes, message in [
        ([0.1, np.nan], {}, "friction: coefficients"),
        ([0.1, np.inf], {}, "friction: coefficients"),
        ([0.1, 3.0], {}, "friction = 3: .* between 0 and 2"),
        ([-0.1, 0.3], {}, r"friction = -0\.1: .* between 0 and 2"),
        ([0.1, 0.3], {"sample_friction": 2.5}, r"friction = 2\.5: .* between 0 and 2"),
    ]:
        with pytest.raises(InputError, match=message):
            calibration_curves(coefficients, **{**good, **changes})


@pytest.mark.slow
def test_flat_slab_of_independent_codes():
    # Centre line, 42 % compression; total profile, and the increment over the last 1.8 % of it.
    total = [0.001, 0.043, 0.116, 0.219, 0.342, 0.467, 0.594, 0.725, 0.842, 0.933, 1.0]
    increment = [0.003, 0.080, 0.178, 0.294, 0.420, 0.541, 0.656, 0.767, 0.865, 0.942, 1.0]
    initial, compression = 0.4769376, 0.1997982
    step = 0.018 * compression
    slab = slab_profile(
        0.12,
        layer_size=(5.0, 5.0),
        initial_thickness=initial,
        loaded_thickness=initial - compression + step,
        material=LAYER,
        region=0.0,
        sample_friction=0.05,
        step=step,
    ).interp(unloaded_depth=np.linspace(0.0, 1.0, 11), method="pchip")
    ours = slab["displacement"] + slab["increment"]
    np.testing.assert_allclose(ours / ours[-1], total, atol=0.02)
    np.testing.assert_allclose(slab["increment"] / slab["increment"][-1], increment, atol=0.02)


@pytest.mark.slow
def test_friction_recovered_from_noisy_phase_volumes():
    # Layers of 5 x 5 x 0.5 mm under a preload to 0.45 mm, measured over 4.6 mm. The volumes come
    # from solutions on another grid and for other coefficients than the calibration.
    layer = {
        "layer_size": (5.0, 5.0),
        "initial_thickness": 0.5,
        "loaded_thickness": 0.45,
        "material": LAYER,
        "region": 4.6,
    }
    calibration = calibration_curves([0.02, 0.1, 0.2, 0.3, 0.36, 0.44], elements=6, **layer)
    # Figure 2a: more friction bends the curve more, at every depth between the faces.
    middle = calibration.sel(depth=slice(0.15, 0.75)).values
    assert np.all(np.diff(middle, axis=0) < -0.004)

    for mu in (0.05, 0.15, 0.25, 0.4):
        slab = slab_profile(mu, elements=7, **layer)
        curve = slab["increment"] / slab["increment"][-1]

        def shape(depth, curve=curve.values, at=slab["depth"].values):
            return np.interp(depth, at, curve)

        before, after = pair(shape, step=5e-4, snr_db=10.0, shape=(140, 32, 32), layer=0.45)
        profile = displacement_profile(
            before, after, spacing=0.004, window_depth=0.04, sample_depth=0.49, **OPTICS
        )
        found = estimate_friction(profile, calibration)
        assert found.coefficient == pytest.approx(mu, abs=0.02)
        assert found.interval[0] - 0.01 < mu < found.interval[1] + 0.01
        assert found.step == pytest.approx(-5e-4, rel=0.01)
