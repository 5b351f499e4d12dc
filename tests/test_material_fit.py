import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from optical_palpation.errors import InputError, MaterialError, OutputError
from optical_palpation.material import LAWS, MooneyRivlin, Ogden, make_law, stable_stretches
from optical_palpation.material.contact import find_contact
from optical_palpation.material.fitting import fit_uniaxial
from optical_palpation.material.uniaxial import UniaxialTest, read_uniaxial_test

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "uniaxial"
needs_data = pytest.mark.skipif(not SHARED.is_dir(), reason="no measured uniaxial tests at hand")


def oracle() -> list[dict[str, str]]:
    if not SHARED.is_dir():
        return []
    with (SHARED / "oracle.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@needs_data
@pytest.mark.parametrize("row", oracle(), ids=lambda r: "-".join(list(r.values())[:3]))
def test_published_coefficients(row):
    test = read_uniaxial_test(
        SHARED / f"abd_{row['phantom']}_mean10.csv", measure=row["stress_measure"]
    ).between(1e-9)
    assert test.stretch.size == int(row["n_points"])
    if row["model"] == "neo-Hookean":
        fit = fit_uniaxial(test, "neo-hookean")
        assert 2.0 * fit.parameters["c10"] == pytest.approx(float(row["mu_kPa"]), abs=1e-4)
    else:
        fit = fit_uniaxial(test, "mooney-rivlin")
        assert fit.parameters["c10"] == pytest.approx(float(row["C10_kPa"]), abs=1e-4)
        assert fit.parameters["c01"] == pytest.approx(float(row["C01_kPa"]), abs=1e-4)
        assert fit.stable_stretches["uniaxial"] == pytest.approx(
            (
                float(row["Drucker_uniaxial_stretch_min"]),
                float(row["Drucker_uniaxial_stretch_max"]),
            ),
            rel=2e-3,
        )
        # Tested to a stretch of 1/3, where only EF10's coefficients are outside their limits.
        assert fit.stable == (row["phantom"] != "EF10_50T")
        if float(row["Drucker_uniaxial_stretch_min"]) > 0.5:
            with pytest.raises(MaterialError, match="stable only"):
                fit.material()
    assert fit.rms**2 * test.stretch.size == pytest.approx(float(row["oracle_SSE_kPa2"]), rel=1e-4)


@needs_data
def test_one_sample_tested_three_times_has_one_modulus():
    tests = [read_uniaxial_test(SHARED / f"jones_SmoothOn45_11_S1T{n}.csv") for n in (1, 2, 3)]
    raw = [fit_uniaxial(test).initial_youngs_modulus for test in tests]
    assert max(raw) / min(raw) > 3.0
    for law in ("mooney-rivlin", "neo-hookean"):
        moduli = []
        for test in tests:
            contact = find_contact(test)
            fit = fit_uniaxial(test.from_contact(contact.strain, contact.toe_end), law)
            assert fit.stable
            moduli.append(fit.initial_youngs_modulus)
        assert max(moduli) / min(moduli) < 1.03, (law, moduli)


@needs_data
@pytest.mark.parametrize(("number", "stable"), [(1, True), (2, False), (3, False)])
def test_wrong_contact_point_is_flagged_as_unstable(number, stable):
    test = read_uniaxial_test(SHARED / f"jones_SmoothOn45_11_S1T{number}.csv")
    fit = fit_uniaxial(test)
    # To the end of the test (20 to 25 %), in the uniaxial and in the planar mode.
    assert fit.stable == stable


@needs_data
def test_wacker_layer_material_from_the_same_laboratory():
    test = read_uniaxial_test(SHARED / "jones_Layer3_2nd0_S1T1.csv")
    assert test.loading == "compression"
    assert test.strain.min() == pytest.approx(-0.5001, abs=1e-4)
    # Their own least squares of a true linear modulus gave 7.526 kPa; Mooney-Rivlin 8.30.
    assert fit_uniaxial(test).initial_youngs_modulus == pytest.approx(8.30, abs=0.01)


stretches = np.concatenate([np.linspace(0.4, 0.99, 12), np.linspace(1.01, 2.0, 12)])
PARAMETERS = {
    "mooney-rivlin": (2.23, 0.703),
    "neo-hookean": (3.0,),
    "yeoh": (2.0, -0.05, 0.01),
    "ogden": (5.0, 3.7),
}


@pytest.mark.parametrize("law", list(PARAMETERS))
@pytest.mark.parametrize("measure", ["engineering", "true"])
def test_laws_are_derivatives_of_their_energy_and_recovered(law, measure):
    p = PARAMETERS[law]
    given = make_law(law, **dict(zip(LAWS[law].parameters, p, strict=True)))

    def energy(s):
        if isinstance(given, Ogden):
            mu, alpha = p
            return 2 * mu / alpha**2 * (s**alpha + 2 * s ** (-alpha / 2) - 3)
        return given.energy(s**2 + 2 / s, 2 * s + s**-2)

    h = 1e-5
    derivative = (energy(stretches + h) - energy(stretches - h)) / (2.0 * h)
    np.testing.assert_allclose(
        given.uniaxial_stress(stretches - 1), derivative, rtol=1e-6, atol=1e-8
    )
    slope = (energy(1.0 + 1e-3) - 2.0 * energy(1.0) + energy(1.0 - 1e-3)) / 1e-6
    assert given.initial_youngs_modulus == pytest.approx(slope, rel=1e-4)

    stress = derivative * stretches if measure == "true" else derivative
    fit = fit_uniaxial(UniaxialTest(stretches, stress, measure), law)
    np.testing.assert_allclose(list(fit.parameters.values()), p, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(fit.stress(stretches - 1.0), stress, atol=1e-4)
    assert fit.initial_youngs_modulus == pytest.approx(slope, rel=1e-3)


def test_stability_limits_agree_with_the_closed_form_of_mooney_rivlin():
    for c10, c01 in ((-0.5, 1.62), (8.0, -1.0), (2.23, 0.703)):
        stress = 2.0 * (stretches - stretches**-2) * (c10 + c01 / stretches)
        fit = fit_uniaxial(UniaxialTest(stretches, stress))
        low, high = stable_stretches(c10, c01)
        assert fit.stable_stretches["uniaxial"] == pytest.approx(
            (max(low, 0.1), min(high, 10.0)), rel=2e-3
        )


def test_planar_limit_by_hand():
    # In the planar state (L, 1, 1/L) of W = c10 (I1 - 3) + c01 (I2 - 3) the second derivatives by
    # the log strains a = log L and b (third: -a - b) are, with h(l) = 4 (c10 l^2 + c01 / l^2),
    # [[h(L) + h(1/L), h(1/L)], [h(1/L), h(1) + h(1/L)]]; its determinant vanishes at the limit.
    c10, c01 = 8.0, -1.0

    def determinant(s):
        h = [4.0 * (c10 * v**2 + c01 * v**-2) for v in (s, 1.0, 1.0 / s)]
        return (h[0] + h[2]) * (h[1] + h[2]) - h[2] ** 2

    stress = 2.0 * (stretches - stretches**-2) * (c10 + c01 / stretches)
    low, high = fit_uniaxial(UniaxialTest(stretches, stress)).stable_stretches["planar"]
    assert determinant(1.01 * low) > 0.0 > determinant(0.99 * low)
    assert low == pytest.approx(1.0 / high, rel=2e-3)


@settings(max_examples=25, deadline=None)
@given(
    contact=st.floats(0.0, 0.12),
    width=st.floats(0.002, 0.012),
    modulus=st.floats(5.0, 200.0),
    compression=st.booleans(),
    measure=st.sampled_from(["engineering", "true"]),
    seed=st.integers(0, 2**16),
)
def test_contact_and_modulus_of_a_specimen_with_a_rough_face(
    contact, width, modulus, compression, measure, seed
):
    # Strips of the face, their heights spread evenly, meet the platen one after the other: a toe
    # of another shape than the one that is fitted.
    sign = -1.0 if compression else 1.0
    recorded = np.linspace(0.0, 0.35, 250)
    strips = contact + width * np.linspace(-2.0, 2.0, 81)
    stress = np.zeros_like(recorded)
    for at in strips:
        stretch = 1.0 + sign * np.maximum(recorded - at, 0.0) / (1.0 + sign * at)
        stress += modulus / 3.0 * (stretch - stretch**-2) / strips.size
    stretch = 1.0 + sign * recorded
    stress = stress * stretch if measure == "true" else stress
    noise = np.random.default_rng(seed).normal(0.0, 2e-4 * modulus, recorded.size)
    test = UniaxialTest(stretch, stress + noise, measure)
    found = find_contact(test)
    assert found.strain == pytest.approx(sign * contact, abs=0.002)
    corrected = test.from_contact(found.strain, found.toe_end)
    for law in ("neo-hookean", "mooney-rivlin"):
        fit = fit_uniaxial(corrected, law)
        assert fit.initial_youngs_modulus == pytest.approx(modulus, rel=0.03)


@pytest.mark.parametrize("measure", ["engineering", "true"])
def test_moving_the_contact_changes_the_height(measure):
    # 10 mm specimen, platen starts 0.4 mm above it and the height is taken for 10.4 mm.
    material = MooneyRivlin(2.23, 0.703)
    travel = np.linspace(0.5, 5.0, 30)
    true_strain = -(travel - 0.4) / 10.0
    force_per_area = material.uniaxial_stress(true_strain)
    stretch = 1.0 - travel / 10.4
    stress = force_per_area * stretch if measure == "true" else force_per_area
    test = UniaxialTest(stretch, stress, measure).from_contact(-0.4 / 10.4)
    np.testing.assert_allclose(test.strain, true_strain, atol=1e-12)
    np.testing.assert_allclose(
        test.stress, material.uniaxial_stress(true_strain, measure), rtol=1e-12
    )


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_confidence_intervals_cover(correlation):
    rng = np.random.default_rng(7)
    strain = np.linspace(-0.4, -0.02, 200)
    truth = MooneyRivlin(2.23, 0.703)
    exact = truth.uniaxial_stress(strain)
    hits = np.zeros(2)
    trials = 200
    for _ in range(trials):
        white = rng.normal(0.0, 0.05, strain.size + 300)
        noise = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white)[300:]
        fit = fit_uniaxial(UniaxialTest(1.0 + strain, exact + noise))
        low, high = fit.intervals["c10"]
        hits += [low < truth.c10 < high, 0.0]
        low, high = fit.initial_youngs_modulus_interval
        hits += [0.0, low < truth.initial_youngs_modulus < high]
    assert np.all(hits / trials > 0.88)
    if correlation == 0.0:
        assert np.all(hits / trials < 0.99)  # and are not simply wide


def write(path: Path, header: str, *columns) -> Path:
    rows = "\n".join(",".join(f"{v:.10g}" for v in row) for row in zip(*columns, strict=True))
    path.write_text(f"{header}\n{rows}\n", encoding="utf-8")
    return path


def test_every_convention_reads_as_the_same_test(tmp_path):
    material = MooneyRivlin(2.23, 0.703)
    e = np.linspace(0.01, 0.5, 25)
    engineering, true = -material.uniaxial_stress(-e), -material.uniaxial_stress(-e, "true")
    files = {
        "strain,stress": (-e, -engineering),
        "strain_percent,stress_kPa": (100 * e, -engineering),
        "Strain (%),Stress (Pa)": (-100 * e, 1000 * engineering),
        "compressive strain,compression stress MPa": (e, engineering / 1000),
        "compression_mm,load_N": (30.0 * e, engineering * 1962.5 / 1000),
        "displacement um,force mN": (30000.0 * e, -engineering * 1962.5),
        "Extension (mm),Load (N)": (-30.0 * e, -engineering * 1962.5 / 1000),
    }
    for header, columns in files.items():
        test = read_uniaxial_test(
            write(tmp_path / "t.csv", header, *columns), height=30.0, area=1962.5
        )
        assert test.loading == "compression"
        assert test.measure == "engineering"
        np.testing.assert_allclose(test.strain, -e, rtol=1e-8, err_msg=header)
        np.testing.assert_allclose(test.stress, -engineering, rtol=1e-8, err_msg=header)

    logarithmic = -np.log(1.0 - e)
    both = write(
        tmp_path / "t.csv",
        "engineering_strain,engineering_stress_kPa,engineering_stress_sd_kPa,true_strain,true_stress_kPa",
        e, -engineering, 0 * e, logarithmic, -true,
    )  # fmt: skip
    test = read_uniaxial_test(both, measure="true")
    np.testing.assert_allclose(test.strain, -e, rtol=1e-8)
    np.testing.assert_allclose(test.stress, -true, rtol=1e-8)
    np.testing.assert_allclose(read_uniaxial_test(both).stress, -engineering, rtol=1e-8)
    only = write(tmp_path / "t.csv", "true strain,true stress (kPa)", -logarithmic, -true)
    np.testing.assert_allclose(read_uniaxial_test(only).stress, -true, rtol=1e-8)
    with pytest.raises(InputError, match="but the columns are: true strain"):
        read_uniaxial_test(only, measure="engineering")


@pytest.mark.parametrize(
    "header",
    [
        "strain,true stress",
        "strain,Cauchy stress",
        "logarithmic strain,stress",
        "log strain,engineering stress",
        "Hencky strain,stress",
        "true strain,force",
    ],
)
def test_measures_that_may_differ_are_refused(tmp_path, header):
    e = np.linspace(0.0, 0.4, 20)
    path = write(tmp_path / "t.csv", header, -e, -8.0 * e)
    with pytest.raises(InputError, match=r"different measures|nothing is said"):
        read_uniaxial_test(path, area=100.0)
    if "stress" in header and "engineering" not in header:
        test = read_uniaxial_test(path, measure="true")
        np.testing.assert_allclose(test.stretch, np.exp(-e), rtol=1e-8)


def test_the_direction_is_said_once(tmp_path):
    e = np.linspace(0.0, 0.4, 20)
    for header, loading in (
        ("tensile strain,stress", "tension"),
        ("compressive strain,stress", "compression"),
        ("strain,stress (tension)", "tension"),
    ):
        path = write(tmp_path / "t.csv", header, e, 8.0 * e)
        assert read_uniaxial_test(path).loading == loading
    with pytest.raises(InputError, match="say which"):
        read_uniaxial_test(write(tmp_path / "t.csv", "compressive strain,tensile stress", e, e * 8))


def test_tension_and_unloading(tmp_path):
    e = np.concatenate([np.linspace(0.0, 0.6, 30), np.linspace(0.55, 0.0, 10)])
    stress = np.concatenate([e[:30] * 10.0, e[30:] * 8.0])
    path = write(tmp_path / "t.csv", "strain,stress", e, stress)
    with pytest.raises(InputError, match="say which"):
        read_uniaxial_test(path)
    test = read_uniaxial_test(path, loading="tension")
    assert test.loading == "tension"
    assert test.strain.size == 30
    assert test.stress[-1] == pytest.approx(6.0)
    assert read_uniaxial_test(path, loading="compression").stress[-1] == pytest.approx(-6.0)


SLOPE = "0,0\n-.1,-1\n-.2,-2\n-.3,-3\n-.4,-4\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read"),
        ("a,b\n1,2\n", "no column for the strain"),
        ("strain,stress\n0,0\n", "at least 5"),
        ("strain,stress\n0,0\n-.1,x\n-.2,-2\n-.3,-3\n-.4,-4\n", "row 2 holds 'x'"),
        ("strain,stress\n0,0\n-.1,-1\n-.2,\n-.3,-3\n-.4,-4\n", "row 3 holds"),
        ("strain,stress\n0,0\n-10,-1\n-20,-2\n-30,-3\n-40,-4\n", "percent"),
        ("displacement,stress\n0,0\n-1,-1\n-2,-2\n-3,-3\n-4,-4\n", "height"),
        ("strain,force\n0,0\n-.1,-1\n-.2,-2\n-.3,-3\n-.4,-4\n", "area"),
        ("strain,strain b,stress\n0,0,0\n-.1,0,0\n-.2,0,0\n-.3,0,0\n-.4,0,0\n", "name one"),
        ("strain (%),stress\n" + SLOPE, "a strain of 0.004 only"),
        ("strain,stress (Pa)\n" + SLOPE, "modulus of 0.01"),
        ("strain,stress\n" + "\n".join(SLOPE.split()[::-1]), "largest in data row 1"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        read_uniaxial_test(path)
    assert "bad.csv" in str(caught.value)


def test_bad_calls_are_refused(tmp_path):
    path = write(tmp_path / "t.csv", "compression,force (mN)", [0, 1, 2, 3, 4], [0, 1, 2, 3, 4])
    for options, said in (({"loading": "comp"}, "loading"), ({"height": "5"}, "height")):
        with pytest.raises(InputError, match=said):
            read_uniaxial_test(path, **{"height": 5.0, "area": 1.0} | options)
    test = UniaxialTest(np.linspace(0.6, 0.99, 20), np.linspace(-9.0, -0.1, 20))
    with pytest.raises(InputError, match="choose one of"):
        fit_uniaxial(test, "hooke")
    with pytest.raises(InputError, match="zero everywhere"):
        fit_uniaxial(UniaxialTest(test.stretch, 0.0 * test.stress))
    with pytest.raises(InputError, match="do not determine"):
        fit_uniaxial(UniaxialTest(np.full(20, 0.8), test.stress), "mooney-rivlin")
    with pytest.raises(InputError, match="at least 5"):
        test.between(0.9)
    with pytest.raises(InputError, match="give the strains at contact"):
        test.from_contact(-0.39)
    with pytest.raises(InputError, match="above -1"):
        test.from_contact(-1.5)
    with pytest.raises(InputError, match="no load"):
        find_contact(UniaxialTest(test.stretch, -test.stress))
    with pytest.raises(InputError, match="cannot be read"):
        read_uniaxial_test(tmp_path / "absent.csv")


@pytest.mark.parametrize("law", list(PARAMETERS))
def test_every_law_fitted_is_one_a_layer_may_have(law):
    truth = make_law(law, 300.0, **dict(zip(LAWS[law].parameters, PARAMETERS[law], strict=True)))
    strain = np.linspace(-0.5, -0.01, 40)
    fit = fit_uniaxial(UniaxialTest(1.0 + strain, truth.uniaxial_stress(strain)), law)
    material = fit.material(bulk_to_shear=300.0)
    assert type(material) is type(truth)
    assert material.bulk_to_shear == 300.0
    np.testing.assert_allclose(list(material.values.values()), PARAMETERS[law], rtol=1e-4)


def test_fit_becomes_the_material_of_a_layer():
    truth = MooneyRivlin(2.23, 0.703)
    strain = np.linspace(-0.5, -0.01, 40)
    fit = fit_uniaxial(UniaxialTest(1.0 + strain, truth.uniaxial_stress(strain)))
    material = fit.material(bulk_to_shear=500.0)
    assert material.c10 == pytest.approx(2.23, abs=1e-6)
    assert material.c01 == pytest.approx(0.703, abs=1e-6)
    assert material.bulk_to_shear == 500.0


def test_figure(tmp_path):
    from optical_palpation.present.material_figure import write_material_figure

    strain = np.linspace(-0.5, -0.01, 40)
    test = UniaxialTest(1.0 + strain, MooneyRivlin(2.23, 0.703).uniaxial_stress(strain))
    fits = [fit_uniaxial(test, law) for law in PARAMETERS]
    write_material_figure(fits, tmp_path / "fit.svg", recorded=test, contact=find_contact(test))
    text = (tmp_path / "fit.svg").read_text(encoding="utf-8")
    assert text.count('<g id="line2d_') > 20
    with pytest.raises(OutputError):
        write_material_figure(fits, tmp_path / "no" / "fit.png")
    assert [p.name for p in tmp_path.iterdir()] == ["fit.svg"]
