"""A result folder never mixes: inputs that change, runs at the same time, code that changed."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from optical_palpation.errors import InputError, OutputError
from optical_palpation.runtime import software_version
from optical_palpation.study import read_study, record, run_study
from study_case import LOADED, STUDY, make_study

MAPS = """
[unloaded]
thickness = 0.42
[loaded]
map = "pressed.npy"
pixel_spacing = [0.03, 0.03]
[errors]
estimates = false
[outputs]
write = ["profiles"]
"""
FILES = {"thickness.nc", "algebraic.nc", "stress.nc", "profiles.csv", "provenance.json"}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a study of a map."""
    monkeypatch.chdir(tmp_path)
    np.save("pressed.npy", LOADED)
    make_study(tmp_path, MAPS + STUDY[STUDY.index("[material]") :])
    return tmp_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "case"
    folder.mkdir()
    np.save(folder / "pressed.npy", LOADED)
    run_study(read_study(make_study(folder, MAPS + STUDY[STUDY.index("[material]") :])))
    return folder


@pytest.fixture
def done(finished, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work" / "study-results"


def visible(folder):
    return {path.name for path in folder.iterdir() if not path.name.startswith(".")}


@pytest.mark.parametrize("how", ["replaced", "overwritten", "removed"])
@pytest.mark.parametrize("moment", ["algebraic stress", "profiles.csv"])
def test_an_input_that_changes_meanwhile_leaves_nothing_that_counts(here, how, moment):
    def change(report):
        if report.stage != moment or getattr(change, "done", False):
            return
        change.done = True
        if how == "removed":
            (here / "pressed.npy").unlink()
        elif how == "overwritten":
            np.save("pressed.npy", LOADED - 0.01)
        else:
            np.save("new.npy", LOADED - 0.01)
            os.replace("new.npy", "pressed.npy")

    study = read_study("study.toml")
    with pytest.raises(InputError, match=r"pressed\.npy has changed while"):
        run_study(study, progress=change)
    results = here / "study-results"
    made = json.loads((results / "provenance.json").read_text())
    assert made["complete"] is False
    assert visible(results) == {"provenance.json", *made["stages"]}
    if how != "removed":
        run_study(study)
        with xr.open_dataset(results / "thickness.nc") as thickness:
            np.testing.assert_allclose(thickness["loaded_thickness"], LOADED - 0.01)


def test_an_input_that_changes_while_it_is_hashed_is_noticed(here, monkeypatch):
    from optical_palpation.study import run

    hashed = run.facts

    def facts(study, source):
        found = hashed(study, source)
        np.save("pressed.npy", LOADED - 0.01)
        return found

    monkeypatch.setattr(run, "facts", facts)
    with pytest.raises(InputError, match="has changed while"):
        run_study(read_study("study.toml"))
    assert not (here / "study-results").exists()


RUN = """
import sys
from optical_palpation.study import read_study, run_study

def hold(report):
    if report.stage == "algebraic stress":
        print("here", flush=True)
        sys.stdin.read()

run_study(read_study("study.toml"), progress=hold)
"""


def test_two_runs_in_one_folder_and_a_lock_that_dies_with_its_process(here):
    first = subprocess.Popen(
        [sys.executable, "-c", RUN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert first.stdout.readline() == "here\n"
        with pytest.raises(OutputError, match="another run works in this folder"):
            run_study(read_study("study.toml"))
        assert first.poll() is None
    finally:
        first.kill()
        first.communicate()
    run_study(read_study("study.toml"))
    assert visible(here / "study-results") == FILES


def test_files_of_the_user_stay(done):
    results = done
    mine = [".notes.2024.txt", ".stress.12.nc", ".hidden", ".backup.99999999.tar"]
    for name in mine:
        (results / name).write_text("mine")
    begun = results / ".stress.99999999-0123abcd.partial.nc"
    begun.write_text("of a run that was killed")
    run_study(read_study("study.toml"))
    assert all((results / name).read_text() == "mine" for name in mine)
    assert not begun.exists()


def test_what_other_code_made_is_made_anew(done, monkeypatch):
    before = json.loads((done / "provenance.json").read_text())["stages"]
    assert run_study(read_study("study.toml")).earlier == run_study(read_study("study.toml")).files
    digest = record.source_digest
    monkeypatch.setattr(
        record,
        "source_digest",
        lambda *parts: digest(*parts) + ("another solver" if "palpation" in parts else ""),
    )
    run_study(read_study("study.toml"))
    after = json.loads((done / "provenance.json").read_text())["stages"]
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"algebraic.nc", "stress.nc", "profiles.csv"}


def test_what_another_folder_holds_whole_is_copied_from_there(done):
    damaged = done.with_name("damaged")
    shutil.copytree(done, damaged)
    (damaged / "thickness.nc").write_bytes(b"damaged")
    other = {"friction.window": 0.3, "outputs.folder": "other"}
    study = read_study(done.parent / "study.toml", other)
    beside = [done.with_name("missing"), damaged, done, study.folder]
    assert run_study(study, beside=beside).earlier == ()
    kept = json.loads((study.folder / "provenance.json").read_text())["stages"]
    copied = {file: entry.get("copied_from") for file, entry in kept.items()}
    # the algebraic stress knows of no friction, the computational one does
    expected = {"thickness.nc": done.name, "algebraic.nc": "damaged"}
    assert copied == dict.fromkeys(FILES - {"provenance.json"}) | expected
    for file in expected:
        assert (study.folder / file).read_bytes() == (done / file).read_bytes()
    assert set(run_study(study).earlier) == FILES - {"provenance.json"}


def test_another_number_of_threads_makes_nothing_anew(done):
    study = read_study("study.toml", {"grid.threads": 2, "outputs.folder": "study-results"})
    assert study.grid.threads == 2
    again = run_study(study)
    assert again.earlier == again.files


def test_version_and_commit_are_in_every_file(done):
    said = software_version()
    made = json.loads((done / "provenance.json").read_text())
    assert made["software_version"] == said
    assert {stage["software_version"] for stage in made["stages"].values()} == {said}
    for name in ("thickness.nc", "algebraic.nc", "stress.nc"):
        with xr.open_dataset(done / name) as maps:
            assert maps.attrs["software_version"] == said
    assert said in (done / "profiles.csv").read_text()
