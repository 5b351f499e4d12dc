"""Uniaxial curve, secant modulus and stability against independent derivations."""

import csv

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from optical_palpation.errors import InputError, MaterialError
from optical_palpation.material import (
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Yeoh,
    make_law,
    neo_hookean,
    stable_stretches,
)

COEFFICIENTS = st.floats(0.01, 1e3)
STRAINS = st.floats(-0.9, 2.0)


def energy(c10, c01, stretches):
    """Strain energy density of the incompressible law from its definition."""
    squares = np.asarray(stretches) ** 2
    return c10 * (squares.sum(0) - 3) + c01 * ((1 / squares).sum(0) - 3)


@given(c10=COEFFICIENTS, c01=st.one_of(st.just(0.0), COEFFICIENTS), strain=STRAINS)
def test_engineering_stress_is_the_derivative_of_the_energy(c10, c01, strain):
    def uniaxial_energy(stretch):
        return energy(c10, c01, [stretch, stretch**-0.5, stretch**-0.5])

    stretch, step = 1 + strain, 1e-4 * (1 + strain)
    material = MooneyRivlin(c10, c01)
    slope = (uniaxial_energy(stretch + step) - uniaxial_energy(stretch - step)) / (2 * step)
    scale = material.shear_modulus / stretch**3
    engineering = material.uniaxial_stress(strain)
    assert engineering == pytest.approx(slope, abs=1e-6 * scale)
    assert material.uniaxial_stress(strain, "true") == pytest.approx(stretch * engineering)


@given(c10=COEFFICIENTS, c01=COEFFICIENTS, strain=STRAINS)
def test_stress_is_secant_modulus_times_strain(c10, c01, strain):
    material = MooneyRivlin(c10, c01)
    modulus = material.strain_adjusted_modulus(strain)
    true = material.uniaxial_stress(strain, "true")
    assert true == pytest.approx(modulus * strain, rel=1e-12)
    assert material.strain_adjusted_modulus(0.0) == pytest.approx(6 * (c10 + c01), rel=1e-12)
    assert material.initial_youngs_modulus == pytest.approx(6 * (c10 + c01), rel=1e-12)


def test_paper_material_by_hand():
    material = MooneyRivlin(2.23, 0.703)
    assert material.shear_modulus == pytest.approx(5.866)
    assert material.bulk_modulus == pytest.approx(58660)
    # Half the height: 2 (0.25 - 2) (2.23 + 0.703 / 0.5) = -12.726 kPa.
    assert material.uniaxial_stress(-0.5, "true") == pytest.approx(-12.726)
    assert material.uniaxial_stress(-0.5) == pytest.approx(-25.452)
    # The apparent modulus grows with compression (section 3).
    assert np.all(np.diff(material.strain_adjusted_modulus(-np.linspace(0, 0.9, 50))) > 0)
    assert neo_hookean(2.933) == NeoHookean(2.933)


def test_published_curves_of_silicones(shared_data):
    """Residuals that the authors report for their own fits, from the measured curves."""
    folder = shared_data / "uniaxial"
    with (folder / "oracle.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["has_curve_files"] == "yes"]
    checked = 0
    for row in rows:
        if row["stress_measure"] != "engineering":
            continue
        if row["model"] == "neo-Hookean":
            material = neo_hookean(float(row["mu_kPa"]) / 2)
        else:
            coefficients = float(row["C10_kPa"]), float(row["C01_kPa"])
            if min(coefficients) < 0:
                continue
            material = MooneyRivlin(*coefficients)
        curve = np.genfromtxt(
            folder / f"abd_{row['phantom']}_mean10.csv", delimiter=",", names=True, comments="#"
        )[1:]
        stress = material.uniaxial_stress(curve["engineering_strain"])
        squares = np.sum((stress - curve["engineering_stress_kPa"]) ** 2)
        assert squares == pytest.approx(float(row["oracle_SSE_kPa2"]), rel=1e-3)
        checked += 1
    assert checked >= 4


def test_stable_range_agrees_with_independent_values(shared_data):
    """Drucker limits of fits to real silicones, computed elsewhere on a grid of stretches."""
    for name in ("oracle.csv", "jones_summary.csv"):
        with (shared_data / "uniaxial" / name).open() as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            c10 = row.get("C10_kPa") or row.get("our_MR_C10_kPa")
            c01 = row.get("C01_kPa") or row.get("our_MR_C01_kPa")
            if not c10 or not c01:
                continue
            lowest, highest = stable_stretches(float(c10), float(c01))
            expected = (
                float(row["Drucker_uniaxial_stretch_min"]),
                float(row["Drucker_uniaxial_stretch_max"]),
            )
            # Their grid ends at 0.1 and 10.
            assert max(lowest, 0.1) == pytest.approx(expected[0], abs=0.002)
            assert min(highest, 10.0) == pytest.approx(expected[1], abs=0.012)


@given(c10=st.floats(-1, 1), c01=st.floats(-1, 1), log_stretch=st.floats(-1.2, 1.2))
def test_stability_is_convexity_in_logarithmic_strain(c10, c01, log_stretch):
    """The smallest curvature of the energy over volume-preserving strains decides."""
    assume(c10 + c01 > 0.02)
    base = log_stretch * np.array([1.0, -0.5, -0.5])
    directions = np.array([[2.0, -1.0, -1.0], [0.0, 1.0, -1.0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hessian = np.diag(4 * (c10 * np.exp(2 * base) + c01 * np.exp(-2 * base)))
    curvature = np.linalg.eigvalsh(directions @ hessian @ directions.T).min()
    lowest, highest = stable_stretches(c10, c01)
    margin = 1e-6
    stretch = np.exp(log_stretch)
    if lowest * (1 + margin) < stretch < highest * (1 - margin):
        assert curvature > 0
    # One condition fails at each end and stays failed beyond it.
    elif stretch < lowest * (1 - margin) or stretch > highest * (1 + margin):
        assert curvature < 0


@given(c10=st.floats(0.1, 10), ratio=st.floats(-0.9, 0))
def test_stress_grows_over_the_stable_range(c10, ratio):
    """Where a law with a negative coefficient is accepted, its curve is monotone."""
    try:
        material = MooneyRivlin(c10, ratio * c10)
    except MaterialError:
        return
    lowest, _ = stable_stretches(material.c10, material.c01)
    assert lowest <= 0.5
    strain = np.linspace(max(lowest, 0.01) - 1, 0.5, 400)
    assert np.all(np.diff(material.uniaxial_stress(strain, "true")) > 0)
    assert np.all(np.diff(material.uniaxial_stress(strain)) > 0)
    if lowest > 0.01:
        # ... and at the limit the true stress has its turning point.
        turn = minimize_scalar(
            lambda e: material.uniaxial_stress(e, "true"), bounds=(-0.995, -0.4), method="bounded"
        )
        assert turn.x == pytest.approx(lowest - 1, abs=1e-3)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ((0.0,), "shear modulus"),
        ((-1.0, 0.5), "shear modulus"),
        ((1.0, -1.0), "shear modulus"),
        ((1.0, -0.5), "stable only between -30.3 %"),
        ((-0.5, 1.0), "stable only between -29.3 %"),
        ((float("nan"),), "c10 = nan is not finite"),
        ((1.0, float("inf")), "c01 = inf"),
        ((1.0, 0.0, float("inf")), "bulk_to_shear = inf"),
        ((1.0, 0.0, 9.99), "too low"),
        ((1.0, 0.0, -5.0), "too low"),
        (("soft",), "no number"),
        ((None,), "no number"),
    ],
)
def test_unstable_material_is_refused(parameters, message):
    with pytest.raises(MaterialError, match=message):
        MooneyRivlin(*parameters)


@pytest.mark.parametrize("strain", [-1.0, -2.0, float("inf"), [0.1, -1.0]])
def test_strain_that_leaves_no_layer_is_refused(strain):
    with pytest.raises(InputError, match="above -1"):
        MooneyRivlin(1.0).uniaxial_stress(strain)


def test_shapes_missing_values_and_unknown_measure():
    stress = MooneyRivlin(1.0).uniaxial_stress(np.array([[0.0, np.nan, -0.1]]))
    assert stress.shape == (1, 3)
    assert np.isnan(stress[0, 1])
    assert stress[0, 0] == 0
    with pytest.raises(InputError, match="nominal"):
        MooneyRivlin(1.0).uniaxial_stress(0.1, "nominal")


def log_energy(law, logs):
    """Energy of the incompressible law at principal log strains, from its definition."""
    squares = np.exp(2 * np.asarray(logs))
    if isinstance(law, Ogden):
        powers = np.exp(law.alpha * np.asarray(logs)).sum()
        return 2 * law.mu / law.alpha**2 * (powers - 3)
    return float(law.energy(squares.sum(), (1 / squares).sum()))


@given(
    law=st.one_of(
        st.builds(Yeoh.unchecked, st.just(1.0), st.floats(-0.5, 0.5), st.floats(-0.1, 0.1)),
        st.builds(Ogden.unchecked, st.just(1.0), st.floats(0.5, 9) | st.floats(-9, -0.5)),
        st.builds(MooneyRivlin.unchecked, st.just(1.0), st.floats(-0.9, 1)),
    ),
    log_stretch=st.floats(-1.0, 1.0),
    planar=st.booleans(),
)
def test_law_is_stable_where_its_energy_is_convex_in_log_strains(law, log_stretch, planar):
    a, b, h = log_stretch, 0.0 if planar else -0.5 * log_stretch, 1e-3

    def at(d1, d2):
        return log_energy(law, [a + d1, b + d2, -a - b - d1 - d2])

    along = at(h, 0) - 2 * at(0, 0) + at(-h, 0)
    across = at(0, h) - 2 * at(0, 0) + at(0, -h)
    mixed = 0.25 * (at(h, h) - at(h, -h) - at(-h, h) + at(-h, -h))
    least = np.linalg.eigvalsh([[along, mixed], [mixed, across]])[0] / h**2
    low, high = law.stable_stretches("planar" if planar else "uniaxial")
    stretch = np.exp(log_stretch)
    if low * 1.001 < stretch < high / 1.001:
        assert least > -1e-4 * law.shear_modulus
    elif low / 1.05 < stretch < low / 1.001 or high * 1.001 < stretch < high * 1.05:
        assert least < 1e-4 * law.shear_modulus  # just outside; further out it may be stable again


def test_special_cases_of_laws_agree():
    strain = np.linspace(-0.6, 1.0, 33)
    neo = NeoHookean(3.0)
    for same in (MooneyRivlin(3.0, 0.0), Yeoh(3.0), Ogden(6.0, 2.0)):
        assert same.uniaxial_stress(strain) == pytest.approx(neo.uniaxial_stress(strain))
        assert same.shear_modulus == pytest.approx(6.0)
    # an Ogden law of exponent -2 is that of the second invariant
    second = MooneyRivlin.unchecked(0.0, 3.0).uniaxial_stress(strain)
    assert Ogden(6.0, -2.0).uniaxial_stress(strain) == pytest.approx(second)


def test_laws_by_name():
    assert make_law(c10=2.23, c01=0.703) == MooneyRivlin(2.23, 0.703)
    assert make_law("neo-hookean", 20, c10=2.0, c01=None) == NeoHookean(2.0, 20.0)
    assert make_law("yeoh", c10=2.0, c20=-0.1) == Yeoh(2.0, -0.1, 0.0)
    assert make_law("ogden", mu=5.0, alpha=3.0) == Ogden(5.0, 3.0)
    law = Yeoh(2.0, -0.1, 0.05)
    assert law.scaled(2.0) == Yeoh(4.0, -0.2, 0.1)
    assert law.attributes == {
        "law": "yeoh",
        "c10_kPa": 2.0,
        "c20_kPa": -0.1,
        "c30_kPa": 0.05,
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"law": "hooke", "c10": 1.0}, "choose one of"),
        ({}, "mooney-rivlin law takes c10, c01: c10 is missing"),
        ({"law": "yeoh", "c10": 1.0, "c01": 0.5}, "c01 belongs to another law"),
        ({"law": "ogden", "c10": 1.0}, "mu is missing; alpha is missing; c10 belongs"),
        ({"law": "ogden", "mu": 1.0, "alpha": 0.0}, "alpha = 0"),
        ({"law": "yeoh", "c10": 1.0, "c20": -1.0}, "stable only between"),
        ({"law": "yeoh", "c10": 1.0, "c30": float("nan")}, "c30 = nan"),
    ],
)
def test_laws_that_cannot_be_made_are_refused(arguments, message):
    with pytest.raises(MaterialError, match=message):
        make_law(**arguments)


def test_the_solver_refuses_a_law_of_another_form():
    with pytest.raises(MaterialError, match="not ogden"):
        _ = Ogden(5.0, 3.0).coefficients
