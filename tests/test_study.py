"""Studies and their first half as a user runs them: by commands, seen in the files they leave."""

import hashlib
import json
import shutil

import numpy as np
import pytest
import xarray as xr

from optical_palpation.present import read_result
from optical_palpation.study import read_study, run_study
from optical_palpation.study.script import reproducing_lines
from optical_palpation.thickness import read_thickness_map, thickness_map, write_thickness_map
from study_case import LOADED, NO_ESTIMATES, SPACING, UNLOADED, X, Y, make_volumes
from study_case import STUDY as WITH_ESTIMATES
from study_case import make_study as write_study

# The first test has the estimated errors, the others are of what else a study does.
STUDY = WITH_ESTIMATES + NO_ESTIMATES
LIT = np.ones(LOADED.shape, bool)  # far from the shadow
LIT[16:, :24] = False
READING = ["--axes", "yzx", "--spacing", *map(str, SPACING), "--scale", "linear"]
FILES = {
    *("boundaries-unloaded.nc", "boundaries-unloaded.png", "boundaries-loaded.nc"),
    *("boundaries-loaded.png", "thickness.nc", "algebraic.nc", "stress.nc", "stress.png"),
    *("layer.vts", "profiles.csv", "report.html", "provenance.json"),
}


def make_study(folder, text=STUDY):
    return write_study(folder, text)


@pytest.fixture(scope="module")
def volumes(tmp_path_factory):
    """A folder with both volumes."""
    folder = tmp_path_factory.mktemp("volumes")
    make_volumes(folder)
    return folder


@pytest.fixture(scope="module")
def finished(volumes, tmp_path_factory):
    """A folder with the volumes, the study and its results."""
    folder = tmp_path_factory.mktemp("finished") / "case"
    shutil.copytree(volumes, folder)
    run_study(read_study(make_study(folder)))
    return folder


@pytest.fixture
def here(volumes, tmp_path, monkeypatch):
    """A folder to work in, with the volumes and the study."""
    monkeypatch.chdir(tmp_path)
    for path in volumes.iterdir():
        (tmp_path / path.name).hardlink_to(path)
    make_study(tmp_path)
    return tmp_path


@pytest.fixture
def done(finished, tmp_path, monkeypatch):
    """A folder to work in, in which the study is done."""
    shutil.copytree(finished, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work" / "study-results"


def stages(folder):
    return json.loads((folder / "provenance.json").read_text())["stages"]


def made_again(before, folder):
    """Files of a result folder that a second run made, by the record."""
    return {name for name, stage in stages(folder).items() if before.get(name) != stage}


def listed(folder):
    """Names of the files of a result folder; its lock is hidden and stays."""
    return {path.name for path in folder.iterdir()} - {".lock"}


def rms(a):
    return float(np.sqrt(np.mean(np.asarray(a) ** 2)))


def test_from_new_to_results(here, run):
    """What the first pages of the documentation tell a user to do."""
    (here / "study.toml").unlink()
    status, out, _ = run("new", "study.toml")
    assert (status, "optical-palpation run study.toml" in out) == (0, True)
    text = (here / "study.toml").read_text()
    for old, new in (
        ("unloaded.oct", "unloaded.npy"),
        ("loaded.oct", "loaded.npy"),
        ('#axes = "yzx"', 'axes = "yzx"'),
        ("#spacing = { z = 0.0035, y = 0.01, x = 0.01 }", "spacing = {z=0.0029, y=0.03, x=0.03}"),
        ('#scale = "dB"', 'scale = "linear"'),
        ('c10 = "FILL IN"', "c10 = 2.23"),
        ('c01 = "FILL IN"', "c01 = 0.703"),
        ('window = "FILL IN"', "window = 0.15"),
        ('sample = "FILL IN"', "sample = 0.05"),
        ('element_size = "FILL IN"', "element_size = [0.2, 0.2, 0.1]"),
        ("#threads = 2", "threads = 1"),
    ):
        assert old in text
        text = text.replace(old, new)
    (here / "study.toml").write_text(text)
    status, out, err = run("run", "study.toml")
    assert status == 0
    assert listed(here / "study-results") == FILES
    for words in ("boundaries of the unloaded layer: 100%", "load 100%", "report"):
        assert words in err
    for words in ("total force: window", "WARNING", "could not be measured", "stress.nc"):
        assert words in out


def test_results_are_those_of_the_true_layer(finished):
    results = finished / "study-results"
    with xr.open_dataset(results / "thickness.nc") as thickness:
        seen = ~thickness["filled"].values
        assert 0.02 < 1 - seen.mean() < 0.2
        assert not seen[30:38, 2:8].any()  # the shadow
        assert seen[LIT].all()
        for name, true, limit in (
            ("loaded_thickness", LOADED, 0.7),
            ("initial_thickness", UNLOADED, 0.7),
        ):
            error = (thickness[name].values - true)[LIT] / SPACING[0]
            assert rms(error) < limit
        assert (thickness["quality"].values[~seen] == 0).all()
        assert thickness["quality"].values[seen].min() > 0.2
    maps = read_result(results / "stress.nc").maps
    assert maps.attrs["window_force_mN"] == pytest.approx(maps.attrs["sample_force_mN"], 1e-3)
    # Quality and filled pixels go with the stress.
    assert maps["filled"].dtype == bool
    assert bool(maps["filled"].sel(x=0.2, y=1.0, method="nearest"))
    assert not bool(maps["filled"].sel(x=1.0, y=0.5, method="nearest"))
    assert float(maps["quality"].sel(x=0.2, y=1.0, method="nearest")) == 0
    # The algebraic stress keeps the pixels of the volume.
    assert read_result(results / "algebraic.nc").maps["axial_stress"].shape == LOADED.shape


def test_the_record_tells_inputs_versions_and_parameters(finished):
    record = json.loads((finished / "study-results" / "provenance.json").read_text())
    assert record["complete"] is True
    assert set(record["stages"]) == FILES - {"provenance.json"}
    for side in ("unloaded", "loaded"):
        data = (finished / f"{side}.npy").read_bytes()
        assert record["inputs"][side]["sha256"] == hashlib.sha256(data).hexdigest()
    assert record["parameters"]["grid"]["edges"] == "free"  # defaults, too
    assert "sample" not in record["parameters"]  # but not of what is not in the model
    assert "c30" not in record["parameters"]["material"]
    assert {"optical-palpation", "numpy", "numba", "python"} <= set(record["versions"])
    for name, stage in record["stages"].items():
        data = (finished / "study-results" / name).read_bytes()
        assert stage["sha256"] == hashlib.sha256(data).hexdigest()
    attrs = read_result(finished / "study-results" / "stress.nc").maps.attrs
    assert attrs["input"] == "loaded.npy"
    assert attrs["input_sha256"] == record["inputs"]["loaded"]["sha256"]
    assert attrs["initial_thickness_input_sha256"] == record["inputs"]["unloaded"]["sha256"]
    assert json.loads(attrs["boundaries"])["loaded"]["parameters"]["window"] == "line"


def test_the_python_lines_give_the_same_stress_to_the_last_bit(finished, monkeypatch):
    monkeypatch.chdir(finished)
    names = {}
    exec(reproducing_lines(read_study("study.toml")), names)
    expected = read_result("study-results/stress.nc").maps
    for name in ("axial_stress", "traction_x", "contact_state"):
        np.testing.assert_array_equal(names["result"].maps[name], expected[name])


def test_a_second_run_repeats_nothing(done, run):
    before = {path.name: path.stat().st_mtime_ns for path in done.iterdir()}
    record = stages(done)
    status, out, err = run("run", "study.toml")
    assert status == 0
    assert out.count("(from an earlier run)") == len(FILES) - 1
    assert "boundaries" not in err
    assert stages(done) == record
    after = {path.name: path.stat().st_mtime_ns for path in done.iterdir()}
    assert {n for n in after if after[n] != before[n]} == {"provenance.json"}


OF_LOADED = {"boundaries-loaded.nc", "boundaries-loaded.png", "thickness.nc"}
OF_STRESS = {"stress.nc", "stress.png", "layer.vts", "profiles.csv", "report.html"}


@pytest.mark.parametrize(
    ("old", "new", "again"),
    [
        ("window = 0.15", "window = 0.2", OF_STRESS),
        ("c10 = 2.23", "c10 = 2.5", {"algebraic.nc", *OF_STRESS}),
        ("[loaded]", "[loaded]\nmethod = 'canny'", {*OF_LOADED, "algebraic.nc", *OF_STRESS}),
        ("[unloaded]", 'title = "Another"\n[unloaded]', {"report.html"}),
    ],
    ids=["friction", "material", "boundaries", "title"],
)
def test_what_depends_on_a_change_is_made_again_and_nothing_else(done, run, old, new, again):
    before = stages(done)
    make_study(done.parent, STUDY.replace(old, new))
    status, _, _ = run("run", "study.toml")
    assert status == 0
    assert made_again(before, done) == again


def test_a_changed_volume_is_noticed(done, run):
    before = stages(done)
    volume = np.load("loaded.npy")
    volume[3, 40, 5] *= 1.5
    np.save("loaded.npy", volume)
    assert run("run", "study.toml", "--thickness-only")[0] == 0
    again = made_again(before, done)
    assert again == OF_LOADED
    assert json.loads((done / "provenance.json").read_text())["complete"] is False
    # What the stress was made of is gone, and so is the stress.
    assert listed(done) == {
        *again,
        *("boundaries-unloaded.nc", "boundaries-unloaded.png", "provenance.json"),
    }


@pytest.mark.parametrize("damage", ["gone", "cut"])
def test_a_file_that_is_gone_or_damaged_is_made_again(done, run, damage):
    expected = (done / "stress.nc").read_bytes()
    before = stages(done)
    if damage == "gone":
        (done / "stress.nc").unlink()
    else:
        (done / "stress.nc").write_bytes(expected[:-100])
    assert run("run", "study.toml")[0] == 0
    assert made_again(before, done) <= {"stress.nc"}
    assert (done / "stress.nc").read_bytes() == expected


@pytest.mark.slow
def test_the_thickness_first_and_the_stress_later(here, run):
    status, out, _ = run("run", "study.toml", "--thickness-only")
    assert status == 0
    assert "stress" not in out
    results = here / "study-results"
    names = listed(results)
    assert names == {name for name in FILES if "boundaries" in name} | {
        "thickness.nc",
        "provenance.json",
    }
    before = stages(results)
    assert run("run", "study.toml", "--quiet") == (0, "", "")
    assert not set(before) & made_again(before, results)
    assert listed(results) == FILES


def test_the_thickness_alone_leaves_a_finished_study_as_it_is(done, run):
    before = {path.name: path.read_bytes() for path in done.iterdir()}
    assert run("run", "study.toml", "--thickness-only")[0] == 0
    assert {path.name: path.read_bytes() for path in done.iterdir()} == before


def test_files_that_are_no_longer_asked_for_go(done, run):
    before = stages(done)
    make_study(done.parent, STUDY + '[outputs]\nwrite = ["panel", "report"]\n')
    assert run("run", "study.toml")[0] == 0
    assert not made_again(before, done)
    assert listed(done) == FILES - {"layer.vts", "profiles.csv"}


def test_maps_and_numbers_in_place_of_volumes(here, run):
    np.save("pressed.npy", LOADED)
    inputs = '[unloaded]\nthickness = 0.42\n[loaded]\nmap = "pressed.npy"\n'
    inputs += "pixel_spacing = [0.03, 0.03]\n"
    make_study(here, inputs + STUDY[STUDY.index("[material]") :] + "[outputs]\nwrite = []\n")
    status, out, _ = run("run", "study.toml")
    assert status == 0
    assert "WARNING" not in out
    command = ["stress", "pressed.npy", "--pixel-spacing", "0.03", "0.03", "--c10", "2.23"]
    command += ["--c01", "0.703", "--initial-thickness", "0.42", "--window-friction", "0.15"]
    command += ["--sample-friction", "0.05", "--element-size", "0.2", "0.2", "0.1"]
    assert run(*command, "--threads", "1", "--no-estimates", "--output", "by-hand.nc")[0] == 0
    by_hand, by_study = (
        read_result(path).maps for path in ("by-hand.nc", "study-results/stress.nc")
    )
    np.testing.assert_allclose(by_study["axial_stress"], by_hand["axial_stress"], rtol=1e-9)
    assert by_study.attrs["input_sha256"] == by_hand.attrs["input_sha256"]
    assert not (here / "study-results" / "boundaries-loaded.nc").exists()


def test_the_unloaded_map_is_registered_to_the_loaded_one(here, run):
    relief = 0.03 * np.exp(-((X - 0.7) ** 2 + (Y - 0.6) ** 2) / 0.03)
    for name, offset, values in (("before", 0.0, 0.45 - relief), ("after", 0.06, 0.4 - relief)):
        shift = round(offset / 0.03)
        map_ = thickness_map(np.roll(values, shift, axis=1), pixel_spacing=(0.03, 0.03))
        write_thickness_map(map_, f"{name}.nc")
    inputs = '[layer]\nregistration = true\n[unloaded]\nmap = "before.nc"\n'
    inputs += '[loaded]\nmap = "after.nc"\n'
    make_study(here, inputs + STUDY[STUDY.index("[material]") :])
    status, _, _ = run("run", "study.toml", "--thickness-only")
    assert status == 0
    with xr.open_dataset("study-results/thickness.nc") as thickness:
        assert thickness.attrs["registration_shift_mm"] == pytest.approx([0, -0.06], abs=0.003)
        difference = thickness["initial_thickness"] - thickness["loaded_thickness"]
        assert float(np.abs(difference - 0.05)[:, 4:-4].max()) < 0.002
        assert thickness["initial_filled"].values[:, 0].all()  # beyond the unloaded map


def test_what_is_interpolated_from_a_filled_pixel_is_filled(here, run):
    """The unloaded map has pixels four times as far apart, one of them missing."""
    before, after = np.full((11, 11), 0.5), np.full((41, 41), 0.4)
    before[5, 5] = np.nan
    for name, values, step in (("before", before, 0.2), ("after", after, 0.05)):
        write_thickness_map(thickness_map(values, pixel_spacing=(step, step)), f"{name}.nc")
    inputs = '[unloaded]\nmap = "before.nc"\n[loaded]\nmap = "after.nc"\n'
    make_study(here, inputs + STUDY[STUDY.index("[material]") :])
    assert run("run", "study.toml", "--thickness-only")[0] == 0
    with xr.open_dataset("study-results/thickness.nc") as thickness:
        expected = np.zeros((41, 41), bool)
        expected[17:24, 17:24] = True
        np.testing.assert_array_equal(thickness["initial_filled"].values, expected)


def test_corrections_reach_the_thickness(here, run):
    (here / "fix.txt").write_text("exclude sample 0.6 0.9 0.3 0.6\n")
    make_study(here, STUDY.replace("[loaded]", '[loaded]\ncorrections = "fix.txt"'))
    assert run("run", "study.toml", "--thickness-only")[0] == 0
    first = stages(here / "study-results")
    with xr.open_dataset("study-results/thickness.nc") as thickness:
        assert thickness["filled"].sel(x=slice(0.61, 0.89), y=slice(0.31, 0.59)).all()
    (here / "fix.txt").write_text("exclude sample 0.6 0.8 0.3 0.6\n")
    assert run("run", "study.toml", "--thickness-only")[0] == 0
    again = made_again(first, here / "study-results")
    assert again == OF_LOADED


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("anchor sample 0.6 99 0.3", "corrections: anchor sample 0.6 99 0.3 lies outside the vol"),
        ("exclude window 5 6 0 1", "corrections: exclude window 5 6 0 1 lies outside the volume"),
        ("anchor sample 0.6", "fix.txt, line 1: 'anchor sample 0.6': anchor takes 3 numbers"),
    ],
)
@pytest.mark.parametrize("options", [[], ["--check"]])
def test_corrections_that_cannot_be_used_are_refused_before_anything_is_computed(
    here, run, options, line, words
):
    (here / "fix.txt").write_text(f"{line}\n")
    make_study(here, STUDY.replace("[loaded]", '[loaded]\ncorrections = "fix.txt"'))
    status, _, err = run("run", "study.toml", *options)
    assert (status, words in err) == (2, True)
    assert "study.toml, [loaded]: " in err
    assert not (here / "study-results").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('scale = "linear"', "", "[unloaded]: unloaded.npy"),
        ("element_size = [0.2, 0.2, 0.1]", "element_size = 7", "element size"),
        ('axes = "yzx"', "window_range = [5, 6]\naxes = 'yzx'", "search range"),
        ("[grid]", "[layer]\nextent = [0, 9, 0, 1]\n[grid]", "extent"),
        ("[grid]", "[outputs]\nfolder = '.'\n[grid]", "no record"),
        ("[grid]", "[outputs]\nfolder = 'loaded.npy'\n[grid]", "cannot be made"),
    ],
)
def test_a_study_that_cannot_be_done_says_why(here, run, old, new, words):
    make_study(here, STUDY.replace(old, new))
    before = {path.name for path in here.iterdir()}
    status, out, err = run("run", "study.toml")
    message = err[err.index("error:") :]
    assert (status, out) == (2, "")
    assert words in message
    assert "study.toml" in message or "outputs" in message
    assert {path.name for path in here.iterdir()} - before <= {"study-results"}


def test_the_results_of_another_study_are_left_alone(done, run):
    other = done.parent / "other.toml"
    other.write_text(STUDY + '[outputs]\nfolder = "study-results"\n')
    before = {path.name: path.read_bytes() for path in done.iterdir()}
    status, _, err = run("run", other)
    assert status == 2
    assert "another study, study.toml" in err
    assert {path.name: path.read_bytes() for path in done.iterdir()} == before
    # nor is one of the same name in another folder the same study
    (done.parent / "day2").mkdir()
    same = STUDY.replace('volume = "', 'volume = "../') + '[outputs]\nfolder = "../study-results"\n'
    (done.parent / "day2" / "study.toml").write_text(same)
    for how in ([], ["--check"]):
        status, _, err = run("run", done.parent / "day2" / "study.toml", *how)
        assert status == 2
        assert "another study, study.toml (../study.toml)" in err
    assert {path.name: path.read_bytes() for path in done.iterdir()} == before


def test_a_record_of_an_earlier_version_goes_on(done, run):
    record = json.loads((done / "provenance.json").read_text())
    assert record.pop("study_file") == "../study.toml"
    (done / "provenance.json").write_text(json.dumps(record))
    status, out, _ = run("run", done.parent / "study.toml")
    assert status == 0
    assert "(from an earlier run)" in out


def test_a_record_cannot_make_it_remove_files_elsewhere(done, run):
    record = json.loads((done / "provenance.json").read_text())
    record["stages"]["../study.toml"] = {"key": "x", "sha256": "x"}
    (done / "provenance.json").write_text(json.dumps(record))
    status, _, err = run("run", "study.toml")
    assert status == 2
    assert "no record" in err
    assert (done.parent / "study.toml").exists()


def test_thickness_of_a_volume_and_the_stress_of_it(here, finished, run):
    """The first half by hand gives what the study gives."""
    for side in ("unloaded", "loaded"):
        command = [
            "thickness",
            f"{side}.npy",
            *READING,
            "--window",
            "LINE",
            "--output",
            f"{side}.nc",
        ]
        status, out, err = run(*command, "--plot", f"{side}.png")
        assert status == 0
        assert "boundaries: 100%" in err
        assert (here / f"{side}.png").stat().st_size > 10_000
    assert "interpolated pixels: " in out
    loaded = read_thickness_map("loaded.nc")
    missing = np.isnan(loaded.values)
    assert missing[30:38, 2:8].all()
    assert rms((loaded.values - LOADED)[LIT] / SPACING[0]) < 0.7
    with xr.open_dataset("loaded.nc") as found:
        assert set(found) == {
            *("thickness", "quality", "filled", "specular", "window_depth", "sample_depth"),
            *("window_filled", "sample_filled"),
        }
        data = (here / "loaded.npy").read_bytes()
        assert found.attrs["source_sha256"] == hashlib.sha256(data).hexdigest()
    status, out, _ = run(
        *("stress", "loaded.nc", "--initial-thickness", "unloaded.nc", "--c10", "2.23"),
        *("--c01", "0.703", "--method", "algebraic", "--output", "stress.nc"),
    )
    assert status == 0
    assert f"interpolated pixels: {100 * missing.mean():.2g} %" in out
    by_study = read_result(finished / "study-results/algebraic.nc").maps
    by_hand = read_result("stress.nc").maps
    for name in ("axial_stress", "filled"):
        np.testing.assert_array_equal(by_hand[name], by_study[name])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["lost.npy", *READING], "lost.npy"),
        (["loaded.npy"], "axes"),
        (["loaded.npy", *READING, "--scale", "log"], "log"),
        (["loaded.npy", *READING, "--window", "bump"], "bump"),
        (["loaded.npy", *READING, "--sample-range", "0.5", "0.4"], "search range"),
        (["loaded.npy", *READING, "--corrections", "lost.txt"], "lost.txt"),
        (["loaded.npy", *READING, "--plot", "o.bmp"], "o.bmp"),
        (["loaded.npy", *READING, "--output", "loaded.npy"], "loaded.npy"),
    ],
)
def test_thickness_refuses_what_it_cannot_use_and_writes_nothing(here, run, arguments, words):
    before = {path.name for path in here.iterdir()}
    status, out, err = run("thickness", "--output", "o.nc", *arguments)
    assert (status, out) == (2, "")
    assert words in " ".join(err.replace("│", " ").split())
    assert {path.name for path in here.iterdir()} == before


def test_what_else_may_be_a_boundary_is_a_warning(here, run):
    """A line of the instrument beside the window's."""
    unloaded = np.load("unloaded.npy")
    unloaded[:, 100:103] += 0.3 * unloaded.max()
    (here / "unloaded.npy").unlink()  # it is shared with other tests
    np.save("unloaded.npy", unloaded)
    status, _, err = run("thickness", "unloaded.npy", *READING, "--output", "unloaded.nc")
    assert status == 0
    assert "warning: a line nearly as bright as the window's" in err
    for options in (["--thickness-only"], []):
        status, out, _ = run("run", "study.toml", *options)
        assert status == 0
        assert "WARNING: unloaded volume: a line nearly as bright as the window's" in out
        assert "loaded volume: a line" not in out.replace("unloaded", "")
        assert "of the loaded thickness could not be measured" in out
