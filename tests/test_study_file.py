"""The study file: its template, and what is said of a file that cannot be used."""

import re
import tomllib

import pytest

from optical_palpation.errors import InputError, MaterialError
from optical_palpation.study import Study, read_study, write_template
from optical_palpation.study.schema import MapInput, Material, NumberInput, VolumeInput
from study_case import STUDY, make_study


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("unloaded.npy", "loaded.npy", "unloaded.oct", "loaded.oct", "before.mat"):
        (tmp_path / name).write_bytes(b"not looked into yet")
    return tmp_path


def keys_of(model, tables=()):
    """All keys that a study file may hold, as paths."""
    for name, field in model.model_fields.items():
        types = [field.annotation, *getattr(field.annotation, "__args__", ())]
        inner = next((t for t in types if hasattr(t, "model_fields")), None)
        yield (*tables, name)
        if inner and name not in ("unloaded", "loaded"):  # of several kinds, looked at below
            yield from keys_of(inner, (*tables, name))


def paths_in(table, tables=()):
    for key, value in table.items():
        yield (*tables, key)
        if isinstance(value, dict):
            yield from paths_in(value, (*tables, key))


def test_the_template_is_a_study_and_shows_every_key(here):
    write_template("new.toml")
    filled = (here / "new.toml").read_text()
    for key, value in (("c10", 2.23), ("c01", 0.703), ("window", 0.15), ("sample", 0.05)):
        filled = filled.replace(f'{key} = "FILL IN"', f"{key} = {value}")
    (here / "new.toml").write_text(filled.replace('"FILL IN"    # or [x', "0.125    # or [x"))
    study = read_study("new.toml")
    assert isinstance(study.loaded, VolumeInput)
    text = (here / "new.toml").read_text()
    for name in ("unloaded-corrections.txt", "loaded-corrections.txt"):
        (here / name).touch()
    # With every key that may be left out in its place, it is a study, too: with the defaults.
    full = re.sub(r"^#(?=\w+ = )", "", text, flags=re.M)
    (here / "full.toml").write_text(full)
    filled_in = read_study("full.toml")
    assert filled_in.grid.edges == study.grid.edges
    assert filled_in.outputs.write == study.outputs.write
    assert filled_in.volumes.window == study.volumes.window
    assert filled_in.material == study.material
    shown = set(paths_in(tomllib.loads(full)))
    # of which some exclude each other
    of_sample = text[text.index("[sample]") : text.index("[grid]")]
    before = of_sample.index("[[sample.earlier]]")
    for table, part in (
        (("sample",), of_sample[:before]),
        (("sample", "earlier"), of_sample[before:]),
        (("grid",), text[text.index("[grid]") : text.index("[errors]")]),
        (("errors",), text[text.index("[errors]") : text.index("[outputs]")]),
    ):
        shown |= {(*table, key) for key in re.findall(r"^# (\w+) = ", part, re.M)}
    shown.add(("sample", "earlier"))
    # said elsewhere: those of any law, and of any map
    laws = {("sample", "law", key) for key in Material.model_fields}
    maps = {("sample", "earlier", key) for key in MapInput.model_fields}
    assert shown >= set(keys_of(Study)) - laws - (maps - {("sample", "earlier", "map")})
    given = re.sub(r"^# (?=\w+ = |\[\[)", "", of_sample, flags=re.M)
    given = "".join(line for line in given.splitlines(True) if not line.startswith("motion"))
    for name in ("relief.nc", "loaded-1.nc"):
        (here / name).touch()
    tables = tomllib.loads(given)["sample"]
    assert read_study(
        make_study(here, STUDY.replace("[0.2, 0.2, 0.1]", "0.2")), {"sample": tables}
    ).sample.modelled
    for kind in (VolumeInput, MapInput, NumberInput):
        for key in kind.model_fields:
            if key not in ("method", "window", "sample"):
                assert re.search(rf"^#? ?{key} = ", text, re.M), f"the template lacks {key}"


def test_the_template_replaces_nothing(here):
    (here / "mine.toml").write_text("work of a day")
    with pytest.raises(OSError, match=r"mine\.toml: exists already"):
        write_template("mine.toml")
    assert (here / "mine.toml").read_text() == "work of a day"


def test_what_holds_for_both_volumes_can_be_said_otherwise_for_one(here):
    own = 'volume = "loaded.npy"\nsample = "line"\nspacing = { z = 0.003, y = 0.03, x = 0.03 }'
    study = read_study(make_study(here, STUDY.replace('volume = "loaded.npy"', own)))
    assert (study.unloaded.sample, study.loaded.sample) == ("rise", "line")
    assert (study.unloaded.spacing.z, study.loaded.spacing.z) == (0.0029, 0.003)
    assert study.loaded.axes == "yzx"


def test_other_kinds_of_input(here):
    number = read_study(make_study(here, STUDY.replace('volume = "unloaded.npy"', "thickness = 1")))
    assert number.unloaded == NumberInput(thickness=1.0)
    map_ = read_study(
        make_study(here, STUDY.replace('volume = "unloaded.npy"', 'map = "before.mat"'))
    )
    assert map_.unloaded == MapInput(map="before.mat")


def test_files_that_are_not_trusted(here):
    from optical_palpation.study.inputs import reading

    text = STUDY.replace('volume = "unloaded.npy"', 'map = "before.mat"\nuntrusted = true')
    text = text.replace('volume = "loaded.npy"', 'volume = "loaded.npy"\nuntrusted = true')
    study = read_study(make_study(here, text))
    assert study.unloaded == MapInput(map="before.mat", untrusted=True)
    assert isinstance(study.loaded, VolumeInput)
    assert reading(study.loaded)["untrusted"] is True


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("c10 = 2.23", "c1O = 2.23", ["material.c10: is missing", "did you mean c10?"]),
        ("c10 = 2.23", 'c10 = "2.23"', ['material.c10 = "2.23"', "must be a number", "kPa"]),
        ("c10 = 2.23", "c10 = nan", ["material.c10 = nan", "finite"]),
        ("c10 = 2.23", "c10 = true", ["material.c10 = true", "number"]),
        ("[friction]", "[frictoin]", ["friction: is missing", "did you mean friction?"]),
        ("window = 0.15", "window = -0.15", ["friction.window = -0.15", "greater"]),
        ("window = 0.15", "windw = 0.15", ["friction.windw = 0.15", "did you mean window?"]),
        ("element_size = [0.2, 0.2, 0.1]", "element_size = [0.2, 0.2]", ["x, y and z", "array"]),
        ("[0.2, 0.2, 0.1]", "0.2\naccuracy = 0.05", ["grid: takes", "accuracy", "one of them"]),
        ("element_size = [0.2, 0.2, 0.1]", "", ["grid: takes element_size (mm) or accuracy"]),
        ("element_size = [0.2, 0.2, 0.1]", "accuracy = 2", ["grid.accuracy = 2", "0.02 for 2 %"]),
        ("threads = 1", "threads = 1.5", ["grid.threads = 1.5", "a whole number"]),
        ("threads = 1", "edges = 'open'", ['grid.edges = "open"', "'free', 'roller' or 'padded'"]),
        ('scale = "linear"', 'scale = "log"', ['volumes.scale = "log"', "'intensity' or 'dB'"]),
        ('scale = "linear"', "scales = 1", ["volumes.scales = 1", "did you mean scale?"]),
        ("z = 0.0029", "z = 0", ["volumes.spacing.z = 0", "greater than 0"]),
        ("{ z = 0.0029, y = 0.03, x = 0.03 }", "[1, 2, 3]", ["volumes.spacing", "must be a table"]),
        ('volume = "loaded.npy"', "thickness = 1", ["[loaded] takes a volume or a map"]),
        ('volume = "loaded.npy"', "", ["loaded.volume: is missing"]),
        ('volume = "loaded.npy"', 'volume = "lost.npy"', ["loaded.volume", "there is no", "lost"]),
        ("[loaded]", "[loaded]\nmap = 'a.mat'", ["loaded.map", "one of them"]),
        ("[loaded]", "[loaded]\ncorrections = 'a.txt'", ["loaded.corrections", "there is no"]),
        ("[loaded]", "[loaded]\ncorrections = '.'", ["loaded.corrections", "is a folder"]),
        ("[friction]", "[outputs]", ["friction: is missing; [friction] takes window and sample"]),
        ("[grid]", "[outputs]\nwrite = ['pannel']\n[grid]", ["outputs.write", "'panel'"]),
        (
            "[grid]",
            "[layer]\nregistration = 'yes'\n[grid]",
            ["layer.registration", "true or false"],
        ),
        ("[grid]", "[grid", ["no valid TOML", "line"]),
        ("c10 = 2.23", "c10 = (2, 1)", ["no valid TOML", "line 14", "c10 = (2, 1)"]),
        ("threads = 1", 'threads = "', ["no valid TOML"]),
        ("c10 = 2.23", "c10 = 2,23", ["line 14", "c10 = 2,23 (decimals have a point)"]),
        ("[grid]", "[friction]", ["Cannot declare [friction] twice", "line"]),
        ('"loaded.npy"', '"C:\\Users\\loaded.npy"', ["(write / for \\ in a path)"]),
        ('"loaded.npy"', "loaded.npy", ["volume = loaded.npy (text stands in quotes)"]),
        ("threads = 1", "threads = " + 5000 * "[", ["no valid TOML"]),
    ],
)
def test_errors_name_file_key_value_and_what_would_be_right(here, old, new, words):
    assert old in STUDY
    make_study(here, STUDY.replace(old, new))
    with pytest.raises(InputError) as error:
        read_study("study.toml")
    text = str(error.value)
    for word in ["study.toml", *words]:
        assert word in text
    assert "pydantic" not in text


def test_all_that_is_wrong_is_told_at_once_and_each_thing_once(here):
    text = STUDY.replace("c10", "c11").replace("sample = 0.05", "sample = 7").replace("yzx", "")
    make_study(here, text)
    with pytest.raises(InputError) as error:
        read_study("study.toml")
    lines = str(error.value).splitlines()[1:]
    assert [line.split()[0].rstrip(":") for line in sorted(lines)] == [
        "friction.sample",
        "material.c10",
        "material.c11",
        "volumes.axes",
    ]


def test_an_unstable_material_is_refused_with_its_table(here):
    make_study(here, STUDY.replace("c10 = 2.23", "c10 = -2.23"))
    with pytest.raises(MaterialError, match=r"study\.toml, \[material\]: unstable"):
        read_study("study.toml")


def test_a_number_cannot_be_registered(here):
    text = STUDY.replace('volume = "unloaded.npy"', "thickness = 0.4")
    make_study(here, text + "[layer]\nregistration = true\n")
    with pytest.raises(InputError, match=r"layer\.registration = true needs"):
        read_study("study.toml")


def test_a_file_of_the_windows_editor_is_read(here):
    make_study(here, STUDY)
    (here / "marked.toml").write_bytes(b"\xef\xbb\xbf" + STUDY.replace("\n", "\r\n").encode())
    assert read_study("marked.toml").material == read_study("study.toml").material


def test_names_longer_than_a_file_system_takes(here):
    with pytest.raises(InputError, match="File name too long"):
        read_study(f"{'n' * 300}.toml")
    make_study(here, STUDY.replace("loaded.npy", f"{'n' * 300}.npy"))
    with pytest.raises(InputError, match=r"n\.npy.*no such file|n\.npy"):
        read_study("study.toml")


def test_a_missing_file_tells_how_to_make_one(here):
    with pytest.raises(InputError, match=r"optical-palpation new nowhere\.toml"):
        read_study("nowhere.toml")
    (here / "binary.toml").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="line 2 is not UTF-8"):
        read_study("binary.toml")
