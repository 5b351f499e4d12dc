"""The commands around results, several studies at once, and one grammar for all commands."""

import json
import re
import shlex
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import roifile
import scipy.io
import tifffile
import typer.main
import xarray as xr

from optical_palpation.analysis import read_regions, region_statistics
from optical_palpation.cli import app
from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import algebraic_result, memory
from optical_palpation.present import read_result, write_mat, write_result, write_tiff
from optical_palpation.thickness import thickness_map

X, Y = 0.5 + 0.1 * np.arange(31), 1.0 + 0.05 * np.arange(41)

STUDY = """
unloaded = { thickness = 0.5 }
loaded = { map = "map.npy", field_of_view = [3.0, 2.0] }
material = { c10 = 2.23, c01 = 0.703 }
friction = { window = 0.15, sample = 0.05 }
grid = { element_size = 0.25, threads = 1 }
outputs = { write = [] }
"""


def result(bump=0.05):
    y, x = np.meshgrid(Y, X, indexing="ij")
    values = 0.44 - bump * np.exp(-((x - 2.0) ** 2 + (y - 2.0) ** 2) / 0.2)
    return algebraic_result(thickness_map(values, x=X, y=Y), 0.5, MooneyRivlin(2.23, 0.703))


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with two results, regions, a thickness map and a study of it."""
    monkeypatch.chdir(tmp_path)
    write_result(result(), "a.nc")
    write_result(result(0.06), "b.nc")
    box = roifile.ImagejRoi(
        roitype=roifile.ROI_TYPE.RECT, left=10, top=10, right=20, bottom=30, name="bump"
    )
    box.tofile("bump.roi")
    np.save("map.npy", result().maps["loaded_thickness"].values)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def test_a_figure_of_a_result(here, run):
    assert run("figure", "a.nc", "--output", "panel.pdf")[0] == 0
    options = ["--map", "axial_stress", "--map", "algebraic_axial_stress", "--width", "100"]
    options += ["--limits", "-9", "0", "--scale-bar", "--regions", "bump.roi"]
    status, out, err = run("figure", "a.nc", *options, "--output", "maps.svg")
    assert (status, err) == (0, "")
    assert "maps.svg" in out
    assert "bump" in (here / "maps.svg").read_text()
    status, _, err = run("figure", "a.nc", "--map", "strain", "--output", "x.png")
    assert status == 2
    assert "known are" in err
    status, _, err = run("figure", "a.nc", "--scale-bar", "--columns", 2, "--output", "x.png")
    assert status == 2
    assert "--columns, --scale-bar: only of maps" in err
    assert run("figure", "a.nc", "--map", "axial_stress", "--width", "wide", "--output", "x.png")[
        0
    ] == 2  # fmt: skip
    assert not (here / "x.png").exists()


def test_regions_of_a_result(here, run):
    status, out, err = run(
        "regions", "a.nc", "bump.roi", "--output", "table.csv", "--plot", "regions.png"
    )
    assert (status, err) == (0, "")
    maps = read_result("a.nc").maps
    expected = region_statistics(maps, read_regions("bump.roi", maps)).isel(region=0)
    assert f"mean {float(expected['mean']):.3g} kPa" in out
    assert f"force {float(expected['force']):.3g} mN" in out
    rows = [r for r in (here / "table.csv").read_text().splitlines() if not r.startswith("#")]
    row = dict(zip(rows[0].split(","), rows[1].split(","), strict=True))
    assert row["region"] == "bump"
    assert float(row["mean_kPa"]) == pytest.approx(float(expected["mean"]), rel=1e-5)
    assert float(row["area_mm2"]) == pytest.approx(1.0)
    assert (here / "regions.png").stat().st_size > 1000
    assert run("regions", "a.nc", "nothing.roi")[0] == 2
    assert "no value" not in out
    x0, x1 = float(maps["x"][-1]) - 0.2, float(maps["x"][-1]) + 0.6
    corners = [(x0, 1.0), (x1, 1.0), (x1, 2.0), (x0, 2.0)]
    text = "name,x_mm,y_mm\n" + "".join(f"edge,{x},{y}\n" for x, y in corners)
    (here / "edge.csv").write_text(text)
    status, out, _ = run("regions", "a.nc", "edge.csv")
    assert status == 0
    assert "75 % of it has no value" in out


def test_comparison_of_results(here, run):
    status, out, err = run("compare", "a.nc", "b.nc", "--output", "c.nc", "--plot", "c.png")
    assert (status, err) == (0, "")
    assert re.search(r"b: rms difference [\d.]+ kPa", out)
    found = xr.load_dataset("c.nc", engine="h5netcdf")
    maps = [read_result(name).maps["axial_stress"] for name in ("a.nc", "b.nc")]
    np.testing.assert_allclose(found["difference"][0], maps[1] - maps[0], atol=1e-12)
    assert (here / "c.png").stat().st_size > 1000
    status, _, err = run("figure", "c.nc", "--output", "x.png")
    assert status == 2
    assert "c.nc: holds a comparison of results and no result" in err
    assert run("compare", "a.nc")[0] == 2
    assert run("compare", "a.nc", "a.nc")[0] == 2


def test_results_of_one_name_are_told_apart_by_their_folders(here, run):
    for folder, bump in {"before": 0.05, "after": 0.06, "last": 0.07}.items():
        (here / folder).mkdir()
        write_result(result(bump), here / folder / "stress.nc")
    files = [f"{folder}/stress.nc" for folder in ("before", "after", "last")]
    status, out, _ = run("compare", *files, "--plot", "c.svg")
    assert status == 0
    assert "after: rms" in out
    assert "last: rms" in out
    drawn = (here / "c.svg").read_text()
    for words in ("before (kPa)", "(b) less (a) (kPa)", "(c) less (a) (kPa)"):
        assert words in drawn
    options = [option for file in files[1:] for option in ("--compare", file)]
    assert run("report", files[0], "--output", "r.html", *options)[0] == 0
    text = (here / "r.html").read_text()
    assert "after less this" in text
    assert "last less this" in text
    assert run("report", files[0], "--output", "s.html", "--compare", files[0])[0] == 2


def test_report_of_a_result(here, run):
    options = ["--compare", "b.nc", "--regions", "bump.roi", "--title", "First <b>loading</b>"]
    assert run("report", "a.nc", "--output", "r.html", *options)[0] == 0
    text = (here / "r.html").read_text()
    assert "First &lt;b&gt;loading&lt;/b&gt;" in text
    assert 'href="a.nc"' in text
    assert "b less this" in text
    assert run("report", "a.nc", "--output", "r.txt")[0] == 2


def test_a_report_is_headed_by_what_says_something(here, run):
    (here / "coin-results").mkdir()
    shutil.copy(here / "a.nc", here / "coin-results" / "stress.nc")
    for result, heading in (("a.nc", "a"), ("coin-results/stress.nc", "coin: stress")):
        assert run("report", result, "--output", "r.html")[0] == 0
        assert f"<title>{heading}" in (here / "r.html").read_text()


def test_results_for_other_programs(here, run):
    names = ["o.mat", "o.tif", "o.csv", "o.png"]
    status, out, err = run("convert", "a.nc", *(f"--output={name}" for name in names))
    assert (status, err) == (0, "")
    assert out.split() == names
    assert run("convert", "a.nc", "--output", "o.docx")[0] == 2
    assert run("convert", "a.nc", "--output", "o.vts")[0] == 2  # the method has no layer


def test_matlab_file_has_axes_and_units(tmp_path):
    it = result()
    it.maps.attrs["a_parameter_with_a_name_of_more_than_31_letters"] = 1.0
    flags = {"flag_values": [0, 1, 2], "flag_meanings": "open slip stick"}
    it.maps["contact_state"] = xr.zeros_like(it.maps["axial_stress"], np.int8).assign_attrs(flags)
    fine = it.maps[["loaded_thickness"]].interp(x=np.linspace(1, 2, 51), y=np.linspace(1, 2, 41))
    it = replace(it, pixels=fine)
    write_mat(it, tmp_path / "o.mat")
    content = scipy.io.loadmat(tmp_path / "o.mat", simplify_cells=True)
    np.testing.assert_array_equal(content["axial_stress"], it.maps["axial_stress"])
    np.testing.assert_array_equal(content["x"].ravel(), X)
    assert content["units"]["axial_stress"] == "kPa"
    assert content["units"]["loaded_thickness"] == "mm"
    np.testing.assert_array_equal(content["pixel_loaded_thickness"], fine["loaded_thickness"])
    np.testing.assert_array_equal(content["pixel_y"].ravel(), fine["y"])
    assert content["units"]["pixel_loaded_thickness"] == content["units"]["pixel_x"] == "mm"
    assert "0 open, 1 slip" in content["meaning"]["contact_state"]
    assert content["provenance"]["c10_kPa"] == 2.23


@pytest.mark.skipif(shutil.which("octave") is None, reason="Octave is not installed")
def test_octave_reads_the_matlab_file(tmp_path):
    it = result()
    write_mat(it, tmp_path / "o.mat")
    code = (
        "s = load('o.mat'); printf('%.9g %s %d\\n', min(s.axial_stress(:)), "
        "s.units.axial_stress, columns(s.axial_stress))"
    )
    done = subprocess.run(
        ["octave", "--eval", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    low, units, columns = done.stdout.split()
    assert float(low) == pytest.approx(float(it.maps["axial_stress"].min()))
    assert (units, int(columns)) == ("kPa", X.size)


def test_tiff_opens_in_imagej_with_its_scale(tmp_path):
    it = result()
    write_tiff(it, tmp_path / "o.tif")
    with tifffile.TiffFile(tmp_path / "o.tif") as file:
        assert file.is_imagej
        about = file.imagej_metadata
        assert about["unit"] == "mm"
        labels = about["Labels"]
        page = file.pages[0]
        per_unit = [page.tags[t].value for t in ("XResolution", "YResolution")]
        assert [n / d for n, d in per_unit] == pytest.approx([10.0, 20.0], rel=1e-6)
        stack = file.asarray()
        assert json.loads(about["Info"])["c10_kPa"] == 2.23
    assert "Axial stress (kPa)" in labels
    at = labels.index("Axial stress (kPa)")
    np.testing.assert_array_equal(stack[at], it.maps["axial_stress"].astype(np.float32))
    # what is drawn on it lies where it was drawn
    label = np.zeros(stack.shape[1:], np.uint8)
    label[10:30, 10:20] = 1
    tifffile.imwrite(tmp_path / "label.tif", label)
    (region,) = read_regions(tmp_path / "label.tif", it.maps)
    weight = region.weights(it.maps["axial_stress"])
    assert float(weight.sum()) == 200
    assert float((weight * weight["y"]).sum() / weight.sum()) == pytest.approx(Y[10:30].mean())
    with pytest.raises(InputError, match="known are"):
        write_tiff(it, tmp_path / "p.tif", ["strain"])
    assert not (tmp_path / "p.tif").exists()


# ---- several studies, other values


@pytest.fixture
def told(monkeypatch):
    """What would be run, in place of running it."""
    from optical_palpation import study

    asked = []

    def note(it, **options):
        asked.append(it)
        raise InputError(f"{it.file}: is not run here")

    monkeypatch.setattr(study, "run_study", note)
    return asked


def test_values_on_the_command_line_go_before_those_of_the_file(here, run, told):
    changes = ["--set", "friction.window=0.2", "--set", "grid.edges=padded", "--threads", "2"]
    run("run", "study.toml", *changes)
    (asked,) = told
    assert asked.friction.window == 0.2
    assert asked.friction.sample == 0.05
    assert asked.grid.edges == "padded"
    assert asked.grid.threads == 2
    assert asked.folder.name == "study-friction.window=0.2-grid.edges=padded-results"
    run("run", "study.toml", "--output", "elsewhere")
    assert told[1].folder == here / "elsewhere"
    run("run", "study.toml", "--set", "outputs.folder=mine")
    assert told[2].folder.name == "mine"
    for title in ("12", "true", "a b", '"12"'):
        run("run", "study.toml", "--set", f"title={title}")
        assert told[-1].title == title.strip('"')


def test_long_changes_that_end_differently_have_folders_of_their_own(here, run, told):
    errors = [f"errors.{key}=0.0123" for key in ("window_friction", "sample_friction", "modulus")]
    for last in ("0.001", "0.002"):
        changes = [*errors, "errors.initial_thickness=0.001", f"errors.thickness={last}"]
        run("run", "study.toml", *(word for text in changes for word in ("--set", text)))
    names = [asked.folder.name for asked in told]
    assert len(set(names)) == 2
    assert max(map(len, names)) < 120


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("friction.windw=0.2", "did you mean window"),
        ("window=0.2", "did you mean volumes.window or friction.window?"),
        ("friction.window=-1", "friction.window = -1"),
        ("friction", "KEY=VALUE"),
        ("friction.window=", "KEY=VALUE"),
        ("title.x=1", "title"),
    ],
)
def test_values_that_cannot_be_used(here, run, told, change, message):
    status, _, err = run("run", "study.toml", "--set", change)
    assert status == 2
    assert message in err
    assert told == []


def test_one_key_has_one_value(here, run, told):
    changes = ["--set", "friction.window=0.2", "--set", "grid.edges=padded"]
    status, _, err = run("run", "study.toml", *changes, "--set", "friction.window =0.3")
    assert (status, told) == (2, [])
    assert "--set friction.window: is given more than once" in err
    for option, key in ("--output", "outputs.folder"), ("--threads", "grid.threads"):
        status, _, err = run("run", "study.toml", option, "1", "--set", f"{key} = 2")
        assert (status, told) == (2, [])
        assert f"{option} and --set {key} say the same" in err


def test_several_studies_are_run_and_one_that_fails_does_not_stop_the_rest(here, run, told):
    (here / "other.toml").write_text(STUDY)
    status, _, err = run("run", "study.toml", "other.toml")
    assert status == 2
    assert [it.file.name for it in told] == ["study.toml", "other.toml"]
    assert "other.toml: is not run here" in err
    assert "2 of 2 studies failed" in err
    (here / "bad.toml").write_text(STUDY.replace("0.15", "-1"))
    told.clear()
    assert run("run", "study.toml", "bad.toml")[0] == 2
    assert told == []  # all are read first
    assert run("run", "study.toml", "study.toml")[0] == 2
    assert run("run", "study.toml", "other.toml", "--output", "x")[0] == 2
    assert told == []


def test_check_reads_everything_and_writes_nothing(here, run, told):
    before = sorted(path.name for path in here.iterdir())
    status, out, err = run("run", "study.toml", "--check")
    assert (status, err) == (0, "")
    assert "loaded map of 41 x 31 pixels" in out
    assert "WARNING" not in out
    assert told == []
    status, out, _ = run("run", "study.toml", "--check", "--set", "material.c10=1000")
    assert status == 0
    assert "WARNING: study.toml, [material]: the layer is as stiff as hard rubber" in out
    status, _, err = run("run", "study.toml", "--check", "--set", "material.c10=2230")
    assert status == 2
    assert "coefficients in Pa" in err
    (here / "other.toml").write_text(STUDY.replace("0.5", "0.3", 1))
    (here / "bad.toml").write_text(STUDY.replace("0.15", "-1"))
    status, out, err = run("run", "bad.toml", "other.toml", "study.toml", "--check")
    assert status == 2
    assert "study.toml: can be run" in out
    assert "bad.toml: cannot be used" in err
    assert "2 of 3 studies failed" in err
    for name in ("other.toml", "bad.toml"):
        (here / name).unlink()
    (here / "map.npy").write_bytes(b"damaged")
    status, _, err = run("run", "study.toml", "--check")
    assert status == 2
    assert "[loaded]" in err
    assert sorted(path.name for path in here.iterdir()) == before
    (here / "photos").mkdir()
    (here / "photos" / "holiday.jpg").write_bytes(b"")
    status, _, err = run("run", "study.toml", "--check", "--output", "photos")
    assert status == 2
    assert "photos: holds files but no record" in err


def test_check_refuses_a_folder_that_cannot_be_made(here, run, told):
    before = sorted(path.name for path in here.iterdir())
    for folder in ("map.npy/results", "x" * 300, "a/" + "x" * 300):
        status, _, err = run("run", "study.toml", "--check", "--output", folder)
        assert status == 2
        assert "the result folder cannot be made" in err
    assert run("run", "study.toml", "--check", "--output", "a/b/c")[0] == 0
    assert sorted(path.name for path in here.iterdir()) == before


@pytest.mark.parametrize(
    "sample", [[], ["thickness=2.0", "compression=0.3", "plate_friction=0.2"]], ids=["", "sample"]
)
def test_check_refuses_what_memory_cannot_hold(here, run, monkeypatch, sample):
    options = [text for value in sample for text in ("--set", f"sample.{value}")]
    assert run("run", "study.toml", "--check", *options)[0] == 0
    monkeypatch.setattr(memory, "available_memory", lambda: 1e6)
    status, _, err = run("run", "study.toml", "--check", *options)
    assert status == 2
    assert "[grid]" in err
    assert "of memory" in err


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("stress", ["missing: MAP..., --initial-thickness NUMBER|MAP, --output FILE"]),
        ("regions a.nc", ["missing: REGIONS"]),
        ("run .", [".: is a folder; give a study file, such as study.toml"]),
        ("run map.npy", ["map.npy: line 1 is not UTF-8", "optical-palpation new study.toml"]),
        ("run study.toml --threads two", ["--threads", "must be a whole number"]),
        ("run study.toml --threads 0", ["--threads", "at least 1"]),
        ("figure a.nc --output f.pdf --map axial_stress --limits low high", ["must be a number"]),
        (
            "stress a.csv --initial-thickness 1 --pixel-spacing 0.05 --output r.nc",
            ["--pixel-spacing", "must be a number; it takes 2 values, X Y"],
        ),
        ("figure study.toml --output f.pdf", ["give the result folder of a study, such as mine"]),
        ("figure . --output f.pdf", ["give the result folder of a study, such as mine"]),
        ("figure map.npy --output f.pdf", ["map.npy: is no result"]),
        ("compare a.nc", ["Error: give two results at least"]),
        ("sample coin", ["'coin' is not one of 'plate', 'relief', 'nodule'"]),
    ],
)
def test_errors_that_a_stranger_meets_say_what_to_do(here, run, command, words):
    (here / "mine").mkdir()
    write_result(result(), here / "mine" / "stress.nc")
    status, out, err = run(*command.split())
    assert (status, out) == (2, "")
    for word in words:
        assert word in err
    for python in ("Traceback", "Errno", "Value error", "Input should"):
        assert python not in err


def test_errors_of_a_study_file_are_told_in_its_own_language(here, run):
    for old, new, words in (
        ("0.15", "true", "friction.window = true"),
        ("0.15", '"much"', 'friction.window = "much"'),
        ("0.15", "{ a = [1, false] }", "friction.window = { a = [1, false] }"),
        ('"map.npy"', '"m.npy"', 'loaded.map = "m.npy"'),
    ):
        (here / "study.toml").write_text(STUDY.replace(old, new))
        status, _, err = run("run", "study.toml")
        assert status == 2
        assert words in err
        for python in ("True", "False", "None", "{'", "Traceback", "dict", "tuple"):
            assert python not in err


# ---- one grammar


COMMANDS = typer.main.get_command(app).commands


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_has_an_example_that_names_real_options(name):
    command = COMMANDS[name]
    assert command.epilog, name
    assert f"optical-palpation {name}" in command.epilog
    known = {option for p in command.params for option in p.opts} | {"--help"}
    for option in re.findall(r"(?<!\S)--[a-z][\w-]*", command.epilog):
        assert option in known, option


@pytest.mark.parametrize("name", COMMANDS)
def test_a_shell_takes_the_examples_of_every_help(name, run):
    """Lines that are broken give the command, and the command line takes it."""
    _, out, _ = run(name, "--help")
    examples = out[out.index("\nExample") :].partition("Cost:")[0].splitlines()[2:]
    commands = [shlex.split(line) for line in "\n".join(examples).replace("\\\n", "").split("\n")]
    given = [words for words in commands if words]
    assert given
    for program, command, *arguments in given:
        assert (program, command) == ("optical-palpation", name)
        COMMANDS[name].make_context(name, arguments)


LONG = {"stress", "submodel", "run", "watch", "friction", "experiment", "uncertainty", "demo"}


@pytest.mark.parametrize("name", COMMANDS)
def test_all_commands_speak_alike(name, run):
    command = COMMANDS[name]
    options = {option for p in command.params for option in p.opts}
    assert {"--quiet", "-q"} <= options
    assert ("-o" in options) == ("--output" in options)
    assert ("--threads" in options) >= (name in LONG)
    _, out, _ = run(name, "--help")
    usage = out.splitlines()[0].removeprefix(f"Usage: optical-palpation {name} [OPTIONS]")
    assert usage == usage.upper()
    assert ("Cost: " in out) >= (name in LONG)
    for parameter in command.params:
        metavar = parameter.metavar
        for part in metavar.split("|") if metavar else ():  # words that are typed as they stand
            assert part == part.upper() or part in ("line", "fall", "rise"), metavar
        long = [option for option in parameter.opts if option.startswith("--")]
        assert not [o for o in long if "out" in o and o not in ("--output",)], long
        assert not any(o in ("--silent", "--verbose", "--jobs") for o in parameter.opts)
    flags = [p for p in command.params if "--quiet" in p.opts]
    assert all(not flag.secondary_opts for flag in flags), "--no-quiet"


@pytest.mark.parametrize("name", COMMANDS)
def test_no_help_speaks_python(name, run):
    status, out, _ = run(name, "--help")
    assert status == 0
    for word in ("<path>", "<str>", "<float>", "<int>", "<bool>", "list[", "None"):
        assert word not in out


def test_shell_completion_is_there(run):
    _, out, _ = run("--help")
    assert "--install-completion" in out


def test_regions_and_result_of_a_study_folder(here, run):
    folder = here / "some-results"
    folder.mkdir()
    write_result(result(), folder / "stress.nc")
    assert run("figure", "some-results", "--output", "f.png")[0] == 0
    status, out, _ = run("regions", "some-results", "bump.roi")
    assert status == 0
    assert "bump" in out
    before = (folder / "stress.nc").read_bytes()
    for command in (["compare", "some-results", "b.nc"], ["convert", "some-results"]):
        status, _, err = run(*command, "--output", "some-results/stress.nc")
        assert status == 2
        assert "choose another name" in err
        assert (folder / "stress.nc").read_bytes() == before
