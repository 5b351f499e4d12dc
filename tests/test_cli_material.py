"""``optical-palpation material`` by what it prints, the files it leaves and its exit status."""

import json

import numpy as np
import pandas as pd
import pytest

from optical_palpation.material import MooneyRivlin

LAYER = MooneyRivlin(2.23, 0.703)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_test(path, *, contact=0.0, largest=0.4, noise=0.005, header="strain,stress_kPa", sign=-1):
    """Write a compression test of the layer, whose recorded zero lies `contact` before contact."""
    recorded = np.linspace(0.0, largest, 200)
    since = np.maximum(recorded - contact, 0.0) / (1.0 - contact)
    stress = LAYER.uniaxial_stress(-since)
    stress = stress + np.random.default_rng(1).normal(0.0, noise, stress.size)
    table = np.column_stack([sign * recorded, -sign * stress])
    np.savetxt(path, table, delimiter=",", header=header, comments="")


def test_fit_end_to_end(here, run):
    write_test("test.csv", contact=0.03)
    status, out, err = run("material", "test.csv", "--output", "fits.json", "--plot", "fits.png")
    assert (status, err) == (0, "")
    assert (here / "fits.png").stat().st_size > 10000
    record = json.loads((here / "fits.json").read_text())
    assert record["contact_strain"] == pytest.approx(-0.03, abs=0.002)
    first = record["fits"][0]
    assert [fit["law"] for fit in record["fits"]] == [
        "mooney-rivlin",
        "neo-hookean",
        "yeoh",
        "ogden",
    ]
    assert first["initial_youngs_modulus_kPa"] == pytest.approx(17.6, rel=0.02)
    options = dict(
        zip(*[iter(out.split("for the layer: ")[1].split("\n")[0].split())] * 2, strict=True)
    )
    assert float(options["--c10"]) == pytest.approx(first["parameters"]["c10"], rel=1e-3)
    assert float(options["--c01"]) == pytest.approx(first["parameters"]["c01"], rel=1e-3)


def test_contact_and_range_by_hand(here, run):
    write_test("test.csv", contact=0.03)
    arguments = "--contact", 0.03, "--strain-range", 0.05, 0.2, "--law", "neo-hookean"
    status, out, _ = run(
        "material", "test.csv", *arguments, "--output", "fits.json", "--plot", "fits.pdf"
    )
    assert status == 0
    record = json.loads((here / "fits.json").read_text())
    assert record["contact_strain"] == -0.03
    assert -0.2 <= record["strain_range"][0] < -0.19
    assert -0.06 < record["strain_range"][1] <= -0.05
    assert [fit["law"] for fit in record["fits"]] == ["neo-hookean"]
    assert "0.03 (given)" in out
    run(
        "material",
        "test.csv",
        "--contact",
        0.03,
        "--law",
        "mooney-rivlin",
        "--output",
        "whole.json",
    )
    intervals = json.loads((here / "whole.json").read_text())["fits"][0]["intervals_95"]
    assert intervals["c10"][0] < 2.23 < intervals["c10"][1]
    assert intervals["c01"][0] < 0.703 < intervals["c01"][1]
    assert intervals["c10"][1] - intervals["c10"][0] < 0.1
    # Trusting the recorded zero gives a layer that is too soft.
    run("material", "test.csv", "--contact", 0, "--law", "neo-hookean", "--output", "trusted.json")
    trusted = json.loads((here / "trusted.json").read_text())["fits"][0]
    fitted = record["fits"][0]
    assert trusted["initial_youngs_modulus_kPa"] < 0.97 * fitted["initial_youngs_modulus_kPa"]


def test_displacement_and_force_counted_positive(here, run):
    recorded = np.linspace(0.0, 4.0, 100)  # mm of a specimen 10 mm high and 50 mm2 wide
    force = -LAYER.uniaxial_stress(-recorded / 10.0) * 50.0 / 1e3
    pd.DataFrame({"travel": recorded, "load_N": force}).to_csv("machine.csv", index=False)
    size = "--height", 10, "--area", 50, "--strain-column", "travel"
    status, _, err = run("material", "machine.csv", *size)
    assert status == 2
    assert "compression" in err
    status, out, _ = run(
        "material", "machine.csv", *size, "--loading", "compression", "--contact", 0
    )
    assert status == 0
    assert "c10 2.23 kPa" in out
    assert "c01 0.703 kPa" in out


def test_published_fits_by_their_protocol(here, run, shared_data):
    folder = shared_data / "uniaxial"
    oracle = pd.read_csv(folder / "oracle.csv")
    oracle = oracle[
        (oracle["model"] == "Mooney-Rivlin_2term") & (oracle["has_curve_files"] == "yes")
    ]
    assert len(oracle) == 6
    for _, row in oracle.iterrows():
        status, _, _ = run(
            "material",
            folder / f"abd_{row['phantom']}_mean10.csv",
            *("--measure", row["stress_measure"], "--contact", 0, "--strain-range", 1e-9, 1),
            *("--law", "mooney-rivlin", "--output", "fits.json"),
        )
        assert status == 0
        found = json.loads((here / "fits.json").read_text())["fits"][0]["parameters"]
        assert found["c10"] == pytest.approx(row["C10_kPa"], abs=1e-4)
        assert found["c01"] == pytest.approx(row["C01_kPa"], abs=1e-4)


def test_unstable_fit_is_flagged_and_not_recommended(here, run, shared_data):
    status, out, _ = run("material", shared_data / "uniaxial" / "abd_EF10_50T_mean10.csv")
    assert status == 0
    assert "mooney-rivlin: UNSTABLE" in out
    assert "WARNING" in out
    assert "for the layer" not in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent.csv"], "absent.csv"),
        (["test.csv", "--law", "hooke"], "hooke"),
        (["test.csv", "--strain-column", "travel"], "travel"),
        (["test.csv", "--contact", "0.5"], "points lie beyond"),
        (["test.csv", "--contact", "1.5"], "above -1"),
        (["test.csv", "--strain-range", "0.8", "0.9"], "between 0.8 and 0.9"),
        (["text.csv"], "row 3"),
        (["force.csv"], "is a force; give the specimen's unloaded area in mm2\n"),
        (["force.csv", "--area", "-3"], "area in mm2, a positive number and not -3\n"),
        (["travel.csv", "--area", "3"], "is a displacement; give the specimen's unloaded height"),
        (["travel.csv", "--area", "3", "--height", "0"], "height in mm, a positive number and no"),
        (["test.csv", "--plot", "fits.txt"], "fits.txt"),
        (["test.csv", "--output", "absent/fits.json"], "absent"),
        (["test.csv", "--output", "test.csv"], "test.csv"),
    ],
)
def test_bad_input_is_named_and_nothing_written(here, run, arguments, message):
    write_test("test.csv")
    (here / "text.csv").write_text("strain,stress\n0,0\n-0.1,-1\nx,y\n-0.2,-2\n-0.3,-3\n-0.4,-4\n")
    for name, strain in (("force", "strain"), ("travel", "displacement")):
        rows = [f"{-0.1 * n},{-n}" for n in range(6)]
        (here / f"{name}.csv").write_text("\n".join([f"{strain},force", *rows]))
    outputs = [] if {"--output", "--plot"} & set(arguments) else ["--output", "o.json"]
    before = {path.name: path.read_bytes() for path in here.iterdir()}
    status, out, err = run("material", *arguments, *outputs)
    assert status == 2
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    assert {path.name: path.read_bytes() for path in here.iterdir()} == before
