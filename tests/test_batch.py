"""Batches: the table, the workers, and what comes of lost ones."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

import optical_palpation as op
from optical_palpation.analysis import Noise
from optical_palpation.batch import Batch, BatchResult, read_batch, run_batch, sweeping, worker_map
from optical_palpation.batch import run as run_module
from optical_palpation.batch.cluster import About, Workers, threads_of
from optical_palpation.batch.dispatch import LOSSES, Dispatcher, Outcome
from optical_palpation.batch.index import write_index
from optical_palpation.batch.reading import CSV
from optical_palpation.batch.scan import predicted_need, run_scan
from optical_palpation.batch.table import claim_folder, table_of
from optical_palpation.errors import (
    ConvergenceError,
    InputError,
    OpticalPalpationError,
    OutputError,
)
from optical_palpation.friction import calibration_curves
from optical_palpation.present import read_result
from optical_palpation.study import read_study, run_study
from study_case import NO_ESTIMATES, map_study

STUDY = map_study('map = "0.npz"', "[outputs]\nwrite = []")
REGIONS = "name,x_mm,y_mm\nbump,0.5,0.5\nbump,1,0.5\nbump,1,1\nbump,0.5,1\n"


def make_scans(folder, count):
    """A study file, maps that differ, and a map that is damaged."""
    axis = np.linspace(0, 1.5, 16)
    bump = np.exp(-((axis - 0.75) ** 2 + (axis[:, None] - 0.75) ** 2) / 0.2)
    for n in range(count):
        np.savez(folder / f"{n}.npz", L1_mm=0.45 - 0.01 * n * bump, x_mm=axis, y_mm=axis)
    (folder / "damaged.npz").write_bytes((folder / "0.npz").read_bytes()[:100])
    (folder / "study.toml").write_text(STUDY)
    (folder / "regions.csv").write_text(REGIONS)


def table(folder, maps, **columns):
    rows = [f"s{Path(m).stem},study.toml,{m}" for m in maps]
    path = folder / "table.csv"
    path.write_text("\n".join(["name,study,loaded.map", *rows]) + "\n")
    return path


def test_script_without_a_main_guard_is_told_what_to_do(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from optical_palpation.batch import worker_map\n"
        "with worker_map(workers=1) as each:\n"
        "    print(list(each(abs, [-1])))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "if __name__ == '__main__':" in done.stderr.splitlines()[-1]


# ------------------------------------------------------------------------------------- the table


def test_csv(tmp_path):
    path = tmp_path / "t.csv"
    (tmp_path / "deep").mkdir()
    path.write_text(
        "name;study;loaded.map;friction.window;grid.element_size;sample.motion\n"
        "one;deep/study.toml;1.npz;0.2;[0.2, 0.2, 0.1];0.1\n"
        ";deep/study.toml;;;;m.nc\n"
    )
    batch = read_batch(path)
    assert batch.folder == tmp_path / "t-results"
    assert [scan.name for scan in batch.scans] == ["one", "0002-study"]
    assert batch.scans[0].study == tmp_path / "deep/study.toml"
    assert batch.scans[0].overrides == {
        "loaded.map": "../1.npz",  # from the folder of the study
        "friction.window": 0.2,
        "grid.element_size": [0.2, 0.2, 0.1],
        "sample.motion": 0.1,
    }
    assert batch.scans[1].overrides == {"sample.motion": "../m.nc"}


def test_csv_of_a_spreadsheet(tmp_path):
    path = tmp_path / "t.csv"
    rows = ["name;study;loaded.map;;", "a;study.toml;m 1,2.npz;;", "b;study.toml;;;", ";;;;", ""]
    text = "\r\n".join(["sep=;", *rows])
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    one, other = read_batch(path).scans
    assert one.overrides == {"loaded.map": "m 1,2.npz"}
    assert (other.name, other.overrides) == ("b", {})
    path.write_text(text.replace("b;study.toml", "b;"))
    with pytest.raises(InputError, match="line 4: column study is empty"):
        read_batch(path)
    for encoding in ("utf-16", "cp1252"):
        path.write_bytes("name,study\nmüller,study.toml\n".encode(encoding))
        with pytest.raises(InputError, match="'CSV UTF-8'"):
            read_batch(path)


def test_files_of_a_sample_count_from_the_folder_of_the_table(tmp_path):
    (tmp_path / "t.toml").write_text(
        """
        study = "deep/study.toml"
        [overrides]
        sample.earlier = [{ map = "1.npz", compression = 0.1 }]
        [sweep]
        sample.relief = ["flat", "relief.nc"]
        """
    )
    one, other = (scan.overrides for scan in read_batch(tmp_path / "t.toml").scans)
    assert one["sample.earlier"] == [{"map": "../1.npz", "compression": 0.1}]
    assert (one["sample.relief"], other["sample.relief"]) == ("flat", "../relief.nc")
    rows = ["deep/study.toml,flat,\"[{ map = '1.npz', compression = 0.1 }]\"", "study.toml,r.nc,3"]
    (tmp_path / "t.csv").write_text("\n".join(["study,sample.relief,sample.earlier", *rows]))
    first, second = read_batch(tmp_path / "t.csv").scans
    assert first.overrides == {k: one[k] for k in ("sample.relief", "sample.earlier")}
    assert second.overrides == {"sample.relief": "r.nc", "sample.earlier": 3}  # for the study


def test_keys_of_every_kind_of_input_are_columns(tmp_path):
    path = tmp_path / "t.csv"
    columns = "title,loaded.field_of_view,unloaded.thickness,volumes.spacing.z,sample.law"
    path.write_text(f'study,{columns}\nstudy.toml,12,"[4, 4]",0.5,0.004,layer\n')
    assert read_batch(path).scans[0].overrides == {
        "title": "12",
        "loaded.field_of_view": [4, 4],
        "unloaded.thickness": 0.5,
        "volumes.spacing.z": 0.004,
        "sample.law": "layer",
    }


def test_toml_with_a_sweep(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text(
        """
        study = "study.toml"
        folder = "out"
        regions = "r.csv"
        [overrides]
        friction.sample = 0.1
        [sweep]
        friction.window = [0.1, 0.2]
        grid.element_size = [0.25, [0.2, 0.2, 0.1]]
        [[scan]]
        name = "a"
        loaded.map = "a.npz"
        [[scan]]
        name = "b"
        study = "other.toml"
        friction.sample = 0.3
        regions = "own.csv"
        """
    )
    with pytest.raises(InputError, match=r"regions: there is no file .*r\.csv"):
        read_batch(path)
    for name in ("r.csv", "own.csv"):
        (tmp_path / name).write_text(REGIONS)
    batch = read_batch(path)
    assert batch.folder == tmp_path / "out"
    assert [scan.name for scan in batch.scans] == [
        f"{scan}-window_{window}-element_size_{size}"
        for scan in "ab"
        for window in (0.1, 0.2)
        for size in (0.25, 2)
    ]
    first, last = batch.scans[0], batch.scans[-1]
    assert first.overrides == {
        "friction.sample": 0.1,
        "loaded.map": "a.npz",
        "friction.window": 0.1,
        "grid.element_size": 0.25,
    }
    assert last.overrides["friction.sample"] == 0.3
    assert last.overrides["grid.element_size"] == [0.2, 0.2, 0.1]
    assert first.regions == tmp_path / "r.csv"
    assert last.regions == tmp_path / "own.csv"
    assert last.study == tmp_path / "other.toml"


def test_folder(tmp_path):
    for name in ("a/study.toml", "b/study.toml", "c.toml", "a/.hidden/study.toml"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).write_text(STUDY)
    batch = read_batch(tmp_path / "in")
    assert [scan.name for scan in batch.scans] == ["a", "b", "c"]
    assert batch.folder == tmp_path / "in-results"


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("t.csv", "name,loaded.map\na,b", "no column named study"),
        ("t.csv", "study,frction.window\ns,1", "frction.window"),
        ("t.csv", "study,loaded\ns,1.npz", "did you mean loaded.volume or loaded.map"),
        ("t.csv", "study,material\ns,PDMS", "material is a table; did you mean material.law"),
        ("t.csv", "study,friction.windw\ns,0.3", "did you mean window"),
        ("t.csv", "study,friction.window.x\ns,0.3", "friction.window is no table"),
        ("t.csv", "study,window\ns,0.3", "did you mean .*friction.window"),
        ("t.csv", "study,map\ns,1.npz", "did you mean unloaded.map or loaded.map"),
        ("t.toml", "study = 's'\n[[scan]]\nloaded = '1.npz'", "did you mean .*loaded.map"),
        ("t.csv", "Name,Study\na,s", "column 'Name': write name"),
        ("t.csv", "study;grid.element_size\ns;0.2\ns;0,2", "line 3: .*0,2: decimals have a point"),
        ("t.csv", "study,name,,\ns,a,,b", "line 2: 4 cells below 2"),
        ("t.csv", "study,,name\ns,,b", "is unknown"),
        ("t.csv", "study,study\ns,s", "several columns"),
        ("t.csv", "study,outputs.folder\ns,s", "outputs.folder"),
        ("t.csv", "study,name\ns,a\ns,A", "both called"),
        ("t.csv", "study,name\ns,a,b\n,c", "line 2.*line 3|line 2"),
        ("t.csv", "study,friction.window,friction.sample\ns,0.2", "line 2: 2 cells below 3"),
        ("t.csv", "", "no study"),
        ("t.csv", "study\n", "no study"),
        ("t.csv", "study,name\ns,Scans.csv", "scan 1 is called 'scans.csv'.* file of the results"),
        ("t.csv", "study,name\ns,index.html", "file of the results"),
        ("t.csv", "study,name\ns,a\ns,a.error.txt", "scan 2 .* file of the results"),
        ("scans.csv", "study,name\ns,a", "choose another folder for them"),
        ("t.toml", "study = 1", "text in quotes"),
        ("t.toml", "study = 's'\nsweeps.a = [1]", "sweeps is unknown"),
        ("t.toml", "study = 's'\nsweep.friction.window = 1", "list of values"),
        ("t.toml", "study = 's'\nsweep.frcton.window = [1]", "frcton"),
        ("t.toml", "[[scan]]\nname = 'a'", "study is missing"),
        ("t.toml", "study = 's'\nscan = 4", "array of tables"),
        ("t.toml", "study =", "no valid TOML"),
        ("t.toml", "study = " + "[" * 5000, "no valid TOML"),
        ("t.xlsx", "", "a batch is a table"),
    ],
)
def test_tables_that_cannot_be_used(tmp_path, name, text, told):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=f"(?s){name}.*({told})"):
        read_batch(path, tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_batch(tmp_path / "none.csv")
    with pytest.raises(InputError, match="File name too long"):
        read_batch(tmp_path / f"{'n' * 300}.csv")


@given(content=st.binary(max_size=300) | st.text(max_size=300).map(str.encode))
@pytest.mark.parametrize("name", ["t.csv", "t.toml"])
def test_any_content_is_read_or_refused(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes((b"study,name,loaded.map\n" if name == "t.csv" else b"") + content)
    try:
        batch = read_batch(path)
    except OpticalPalpationError:
        return
    for scan in batch.scans:
        assert scan.name
        assert Path(scan.name).name == scan.name  # stays within the folder
        assert scan.name not in (".", "..")


# ----------------------------------------------------------------------------------- the workers


def test_workers_on_the_same_cores_share_them():
    def about(host, cores):
        return About("1", host, frozenset(cores), len(cores))

    here = {"a": about("h", range(8)), "b": about("h", range(8)), "c": about("g", range(6))}
    assert [threads_of(address, here) for address in "abc"] == [4, 4, 6]
    # jobs of a cluster that were given cores of their own on one machine
    bound = {"a": about("h", range(4)), "b": about("h", range(4, 8))}
    assert [threads_of(address, bound) for address in "ab"] == [4, 4]
    crowded = {str(n): about("h", range(2)) for n in range(5)}
    assert threads_of("0", crowded) == 1


def test_need_grows_with_the_elements_and_is_unknown_of_a_broken_scan(tmp_path, monkeypatch):
    make_scans(tmp_path, 1)
    sizes = ["0.25", "0.1", "0.05"]
    rows = [f"n{n},study.toml,{size}" for n, size in enumerate(sizes)]
    (tmp_path / "t.csv").write_text("\n".join(["name,study,grid.element_size", *rows]))
    needs = [predicted_need(scan) for scan in read_batch(tmp_path / "t.csv").scans]
    assert 4e6 < needs[0] < needs[1] < needs[2] < 2e9
    keys = "sample.thickness,sample.compression,sample.plate_friction"
    (tmp_path / "t.csv").write_text(f"study,grid.element_size,{keys}\nstudy.toml,0.05,1,0.2,0.1\n")
    with_sample = predicted_need(read_batch(tmp_path / "t.csv").scans[0])
    assert needs[2] < with_sample < 2e9
    (tmp_path / "t.csv").write_text("study,grid.accuracy\nstudy.toml,0.05\n")
    assert 4e6 < predicted_need(read_batch(tmp_path / "t.csv").scans[0]) < 2e9
    batch = read_batch(table(tmp_path, ["damaged.npz"]))
    assert predicted_need(batch.scans[0]) is None
    monkeypatch.setattr("optical_palpation.study.read_study", lambda *_: 1 / 0)
    assert predicted_need(batch.scans[0]) is None  # one scan does not end the batch


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Results of studies run one after another, after the kernels were compiled."""
    folder = tmp_path_factory.mktemp("reference")
    make_scans(folder, 4)
    contents = {}
    for n in range(4):
        changes = {"loaded.map": f"{n}.npz", "outputs.folder": f"r{n}", "grid.threads": None}
        done = run_study(read_study(folder / "study.toml", changes))
        contents[f"s{n}"] = content(done.folder)
    return contents


def content(folder):
    """All values and attributes of a result, to the bit.

    Not the bytes of the file: HDF5 may lay out the same content in another order.
    """
    result = read_result(folder / "stress.nc")
    return {
        name: (variable.values.tobytes(), str(variable.attrs))
        for part in (result.maps, result.layer)
        for name, variable in part.variables.items()
    } | {"attributes": str(result.maps.attrs)}


@contextmanager
def scheduler_process(folder):
    """A scheduler as users start it; gives the path of its file."""
    file = folder / "scheduler.json"
    with running("scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", file):
        deadline = time.monotonic() + 120
        while not file.exists() or not file.read_text().strip():
            assert time.monotonic() < deadline, "the scheduler does not start"
            time.sleep(0.1)
        yield file


@contextmanager
def running(*arguments):
    command = [sys.executable, "-m", "dask", *map(str, arguments)]
    environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def worker(file):
    return running(
        "worker", "--scheduler-file", file, "--no-nanny", "--nthreads", "2", "--no-dashboard"
    )


@pytest.mark.slow
def test_real_scheduler_lost_workers_and_a_damaged_scan(tmp_path, reference):
    make_scans(tmp_path, 4)
    batch = read_batch(
        table(tmp_path, ["0.npz", "1.npz", "damaged.npz", "2.npz", "3.npz"]),
        regions=tmp_path / "regions.csv",
    )
    killed = []
    with ExitStack() as stack:
        file = stack.enter_context(scheduler_process(tmp_path))
        processes = [stack.enter_context(worker(file)) for _ in range(2)]

        def kill_in_between(report):
            # in the middle of computations, three times; a new one comes in its place
            if len(killed) < 3 and report.running and report.done >= len(killed):
                process = processes.pop(0)
                process.send_signal(signal.SIGKILL)
                process.wait()
                killed.append(report)
                processes.append(stack.enter_context(worker(file)))

        result = run_batch(batch, scheduler=str(file), progress=kill_in_between)
        assert len(killed) == 3
        again = run_batch(batch, scheduler=str(file))

    assert [outcome.name for outcome in result.failed] == ["sdamaged"]
    assert "damaged.npz" in result.failed[0].message
    done = [outcome.name for outcome in result.outcomes if outcome.status != "failed"]
    assert {name: content(batch.folder / name) for name in done} == reference
    assert [o.status for o in again.outcomes] == ["earlier"] * 2 + ["failed"] + ["earlier"] * 2

    written = pd.read_csv(batch.folder / "scans.csv")
    assert list(written["scan"]) == ["s0", "s1", "sdamaged", "s2", "s3"]
    assert list(written["status"]) == ["done", "done", "failed", "done", "done"]
    assert written["window_force_mN"].notna().sum() == 4
    assert list(written["bump.area_mm2"].dropna()) == pytest.approx([0.25] * 4)
    assert list(written["bump.missing"].dropna()) == [0.0] * 4
    assert (written["bump.mean_kPa"].dropna() < 0).all()
    stored = pd.read_parquet(batch.folder / "scans.parquet")
    numbers = list(stored.select_dtypes("number"))
    assert {"window_force_mN", "bump.mean_kPa", "seconds"} <= set(numbers)
    pd.testing.assert_frame_equal(stored[numbers], written[numbers], check_dtype=False)
    page = (batch.folder / "index.html").read_text()
    assert page.count("data:image/png") == 4 + 1  # and the scale
    assert 'href="sdamaged.error.txt"' in page
    assert "4 done, 1 failed" in page


def command(*arguments):
    return subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from optical_palpation.cli import main; main()",
            *map(str, arguments),
        ],
        env=os.environ | {"NUMBA_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.slow
def test_all_that_takes_a_scheduler_gives_what_one_process_gives(tmp_path):
    make_scans(tmp_path, 1)
    (tmp_path / "study.toml").write_text(STUDY + NO_ESTIMATES)
    study = op.Study.read(tmp_path / "study.toml")
    values = {"friction.window": [0.1, 0.2], "material.c10": (2.0, 2.23)}
    slab = {
        "layer_size": (2.0, 2.0),
        "initial_thickness": 0.5,
        "loaded_thickness": 0.45,
        "material": op.MooneyRivlin(2.23, 0.703),
        "region": 1.6,
        "elements": 3,
    }
    told = []
    with ExitStack() as stack:
        file = str(stack.enter_context(scheduler_process(tmp_path)))
        for _ in range(2):
            stack.enter_context(worker(file))
        found = op.sweep(study, values, scheduler=file, folder=tmp_path / "s", progress=told.append)
        with pytest.raises(InputError, match="folder"):
            op.sweep(study, values, scheduler=file)
        with worker_map(scheduler=file) as each:
            curves = calibration_curves([0.1, 0.3], each=each, on_curve=told.append, **slab)
            errors = errors_of(study, each=each)
    xr.testing.assert_identical(errors, errors_of(study))
    xr.testing.assert_identical(found, op.sweep(study, values))
    records = (tmp_path / "s" / "points").glob("*/provenance.json")
    stages = [json.loads(path.read_text())["stages"] for path in records]
    copied = ["copied_from" in entry["thickness.nc"] for entry in stages]
    assert len(copied) == 4
    assert sum(copied) >= 2  # two workers may begin at the same time
    assert not any("copied_from" in entry["stress.nc"] for entry in stages)
    assert told[0].stage.startswith("0 of 4")
    assert told[-1] == 0.3
    xr.testing.assert_identical(curves, calibration_curves([0.1, 0.3], **slab))


def errors_of(study, **how):
    """Errors of the stress of a study by noise of its map, and by friction."""
    measured = study.thickness()
    return op.stress_uncertainty(
        measured["loaded_thickness"],
        measured["initial_thickness"],
        op.MooneyRivlin(2.23, 0.703),
        window_friction=0.15,
        sample_friction=0.05,
        element_size=0.25,
        thickness_noise=Noise(0.001, probes=1),
        nominal=study.run(),
        **how,
    )


def test_quiet_does_not_keep_failures_to_itself(tmp_path, monkeypatch, run):
    make_scans(tmp_path, 1)

    def failing(batch, **_):
        outcomes = (Outcome("s0", "done"), Outcome("s1", "failed", "no luck"))
        return BatchResult(batch.folder, outcomes, ())

    monkeypatch.setattr("optical_palpation.batch.run_batch", failing)
    scans = table(tmp_path, ["0.npz", "damaged.npz"])
    assert run("batch", scans, "--quiet") == (1, "", "failed: s1: no luck\n")
    status, out, err = run("batch", scans)
    assert (status, err) == (1, "failed: s1: no luck\n")
    assert "1 of 2 scans done" in out


def test_points_of_a_sweep_that_fail_on_workers(tmp_path, monkeypatch):
    make_scans(tmp_path, 1)
    study = op.Study.read(tmp_path / "study.toml")
    error = "ConvergenceError"

    def failing(batch, **_):
        outcomes = tuple(Outcome(s.name, "failed", "no luck", error) for s in batch.scans)
        return BatchResult(batch.folder, outcomes, ())

    monkeypatch.setattr(sweeping, "run_batch", failing)
    with pytest.raises(ConvergenceError, match="no point has a solution; the first: no luck"):
        op.sweep(study, {"friction.window": [0.1]}, workers=1)
    error = "InputError"
    with pytest.raises(InputError, match=r"friction.window.*0\.1.*no luck"):
        op.sweep(study, {"friction.window": [0.1]}, workers=1)


def here(batch, **_):
    """Run a batch in this process, which takes no workers."""
    alike = {scan.name: [] for scan in batch.scans}
    done = [run_scan(batch.folder, alike, scan, 1, lambda _: None) for scan in batch.scans]
    return BatchResult(batch.folder, tuple(done), ())


def test_regions_that_cannot_be_read_cost_no_row(tmp_path):
    make_scans(tmp_path, 1)
    (tmp_path / "study.toml").write_text(STUDY + NO_ESTIMATES)
    batch = read_batch(table(tmp_path, ["0.npz"]), regions=tmp_path / "regions.csv")
    (tmp_path / "regions.csv").write_text("name,x_mm,y_mm\nelsewhere,8,8\n")
    (done,) = here(batch).outcomes
    assert done.status == "done"
    assert done.row["window_force_mN"] > 0
    assert "no regions: " in done.row["warnings"]


def test_point_of_a_sweep_that_is_refused_does_not_lose_the_others(tmp_path, monkeypatch):
    make_scans(tmp_path, 1)
    (tmp_path / "study.toml").write_text(STUDY + NO_ESTIMATES)
    study = op.Study.read(tmp_path / "study.toml")
    monkeypatch.setattr(sweeping, "run_batch", here)
    values = {"unloaded.thickness": [0.5, 0.3]}  # the second is thinner than the loaded layer
    for how in ({}, {"workers": 1}):
        found = op.sweep(study, values, **how)
        assert list(np.isfinite(found["window_force"].values)) == [True, False]
        assert str(found["failure"][0].values) == ""
        assert "nothing is pressed" in str(found["failure"][1].values)
    with pytest.raises(OutputError, match="x: the folder cannot be made"):
        op.sweep(study, values, folder="/proc/x")


def test_files_of_a_sweep_count_from_the_folder_of_the_study(tmp_path, monkeypatch):
    make_scans(tmp_path, 2)
    study = op.Study.read(tmp_path / "study.toml")
    in_memory = op.Study(**study.given | {"loaded": {"map": "0.npz"}}, folder=tmp_path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    maps = ["0.npz", "1.npz"]
    asked = []

    def failing(batch, **_):
        asked.extend(read_study(s.study, s.overrides).loaded.map for s in batch.scans)
        return BatchResult(
            batch.folder, tuple(Outcome(s.name, "failed", "", "x") for s in batch.scans), ()
        )

    monkeypatch.setattr(sweeping, "run_batch", failing)
    for base in study, in_memory:
        here = [base.with_({"loaded.map": name}).given["loaded"]["map"] for name in maps]
        assert here == [str(tmp_path / name) for name in maps]
        for folder in (None, tmp_path / "swept"):
            with pytest.raises(OpticalPalpationError):
                op.sweep(base, {"loaded.map": maps}, workers=1, folder=folder)
            assert asked == here
            asked.clear()


@pytest.mark.slow
def test_client_that_is_killed_or_interrupted_goes_on_later(tmp_path, reference):
    make_scans(tmp_path, 4)
    source = table(tmp_path, [f"{n}.npz" for n in range(4)])
    results = tmp_path / "table-results"

    def finished():
        return sum(
            json.loads(path.read_text())["complete"] for path in results.glob("*/provenance.json")
        )

    def started_and_some_done(count):
        process = command("batch", source, "--workers", "2")
        deadline = time.monotonic() + 300
        while finished() < count:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return process

    process = started_and_some_done(1)
    process.kill()
    process.communicate()

    # one more than the first client left: this one has then begun to work
    process = started_and_some_done(min(4, finished() + 1))
    before = finished()
    if before < 4:
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does on Ctrl-C
        _, err = process.communicate(timeout=120)
        if finished() < 4:
            assert process.returncode == 130, err
            assert "interrupted" in err
            assert "Traceback" not in err  # of no worker either
            written = pd.read_csv(results / "scans.csv")
            assert len(written) == 4
    else:
        process.communicate()

    process = command("batch", source, "--workers", "1")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "4 of 4 scans done" in out
    assert {f"s{n}": content(results / f"s{n}") for n in range(4)} == reference
    leftovers = [p for p in results.rglob(".*") if p.name != ".lock"]
    assert not leftovers


def test_job_that_ends_its_workers_is_given_up(monkeypatch):
    """A dispatcher on workers that vanish: no other job suffers."""
    names = ["good", "deadly", "fine"]

    class Scheduler:
        def identity(self, n_workers):
            raise AssertionError

    class Future:
        def __init__(self, name):
            self.name = name
            self.status = "pending" if name == "deadly" else "finished"

        def done(self):
            return self.status == "finished"

        def result(self):
            return Outcome(self.name, "done")

    class Client:
        scheduler = Scheduler()

        def __init__(self):
            self.count, self.workers = 0, ["w0"]

        def sync(self, *_, **__):
            return {"workers": dict.fromkeys(self.workers)}

        def run(self, function, workers, on_error):
            return dict.fromkeys(workers, function())

        def submit(self, function, work, name, *_, **options):
            assert options["workers"] == [self.workers[0]]
            if name == "deadly":  # takes its worker along, and another comes
                self.count += 1
                self.workers = [f"w{self.count}"]
            return Future(name)

        def subscribe_topic(self, *_):
            pass

        unsubscribe_topic = subscribe_topic

        def cancel(self, futures, force):
            assert not futures

    monkeypatch.setattr("distributed.wait", lambda *_, **__: None)
    outcomes = {}
    needs = dict.fromkeys(names, 1e9)
    client = Client()
    crew = Workers(client, None)
    Dispatcher(crew, None, dict.fromkeys(names), needs, outcomes, lambda _: None).run()
    assert client.count == LOSSES
    assert {name: outcome.status for name, outcome in outcomes.items()} == {
        "good": "done",
        "fine": "done",
        "deadly": "failed",
    }
    assert "lost 3 times" in outcomes["deadly"].message
    assert "1.0 GB" in outcomes["deadly"].message


def test_memory_of_this_machine_is_not_promised_twice():
    from optical_palpation.batch.cluster import _workers_for

    needs = {"a": 6e9, "b": 1e9, "c": 3e9}
    crew = Workers(None, memory=9e9, process=0.5e9)
    dispatcher = Dispatcher(crew, None, dict.fromkeys(needs), needs, {}, lambda _: None)
    assert dispatcher._fits("a")
    dispatcher.running = {"a": ("w0", None)}
    assert dispatcher._fits("b")  # 0.5 + 6 + 0.5 + 1
    assert not dispatcher._fits("c")
    assert _workers_for([1e9] * 10, 4, 100e9) == 4
    assert _workers_for([1e9] * 2, 4, 100e9) == 2
    assert _workers_for([1e9] * 10, 4, 3.2e9) == 2
    assert _workers_for([None, 50e9], 4, 3e9) == 1


def test_folder_of_another_batch_is_left_alone(tmp_path):
    make_scans(tmp_path, 1)
    out = tmp_path / "out"
    for folder in ("day1", "day2"):
        (tmp_path / folder).mkdir()
        table(tmp_path / folder, ["../0.npz"])

    def claim(folder):
        claim_folder(read_batch(tmp_path / folder / "table.csv", out))

    claim("day1")
    claim("day1")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(OutputError, match=r"another batch, \.\./day1/table\.csv.*batch\.json"):
        claim("day2")
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    # what an earlier version left has no record; what somebody else left is no result
    (out / "batch.json").unlink()
    (out / "scans.csv").write_text("scan,status,message,seconds\n")
    claim("day2")
    (out / "batch.json").unlink()
    (out / "scans.csv").write_text("patient,age\n")
    with pytest.raises(OutputError, match=r"scans\.csv: is no result of a batch"):
        claim("day2")


def test_batch_that_ends_early_keeps_what_there_was(tmp_path, monkeypatch):
    make_scans(tmp_path, 3)
    (tmp_path / "study.toml").write_text(STUDY + NO_ESTIMATES)
    source = table(tmp_path, ["0.npz", "1.npz", "damaged.npz", "2.npz"])
    end = {"s2"}
    seen = []

    class InThisProcess(Dispatcher):
        def run(self):
            for name, job in self.jobs.items():
                if name in end:
                    raise KeyboardInterrupt
                self._finish(self.work(job, 1, lambda _: None))
                seen.append(written()["status"].to_list() if results.joinpath(CSV).exists() else [])

    monkeypatch.setattr(run_module, "connected", lambda *_: nullcontext(Workers(None, None)))
    monkeypatch.setattr(run_module, "Dispatcher", InThisProcess)
    monkeypatch.setattr(run_module, "_EVERY", 0.0)
    results = tmp_path / "table-results"

    def written():
        return pd.read_csv(results / CSV).set_index("scan")

    with pytest.raises(KeyboardInterrupt):
        run_batch(read_batch(source))
    assert list(written()["status"]) == ["done", "done", "failed", "not run"]
    assert seen[0] == ["done", "not run", "not run", "not run"]  # a running batch tells, too
    end.clear()
    run_batch(read_batch(source))
    before, page = written(), (results / "index.html").read_text()
    assert list(before["status"]) == ["done", "done", "failed", "done"]
    for last in ("s1", "s0"):
        end.add(last)
        with pytest.raises(KeyboardInterrupt):
            run_batch(read_batch(source))
        pd.testing.assert_frame_equal(written(), before)
        assert (results / "index.html").read_text() == page
    # of another study, what there was tells nothing
    source.write_text(source.read_text().replace("2.npz", "1.npz").replace("s0,", "s9,"))
    end.remove("s0")
    with pytest.raises(KeyboardInterrupt):
        run_batch(read_batch(source))
    assert written()["status"].to_dict() == {
        "s9": "done",
        "s1": "done",
        "sdamaged": "failed",
        "s2": "not run",
    }


def test_columns_do_not_depend_on_the_first_scan_and_names_stay(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("name,study,friction.window,grid.edges\nProbe 1/2,s,,padded\nb,s,0.1,\n")
    batch = read_batch(path)
    done = Outcome("b", "done", row={"window_force_mN": 1.0, "seconds": 2.0})
    failed = Outcome("Probe_1_2", "failed", "no luck")
    swapped = replace(batch, scans=batch.scans[::-1])
    for of in batch, swapped:
        columns = list(table_of(of, [failed, done]).columns)
        assert columns[:4] == ["scan", "status", "message", "name"]
        assert set(columns[4:6]) == {"friction.window", "grid.edges"}
        assert columns[6:] == ["window_force_mN", "seconds"]
    found = table_of(batch, [failed, done])
    assert list(found["scan"]) == ["Probe_1_2", "b"]
    assert list(found["name"]) == ["Probe 1/2", "b"]
    assert "name" not in table_of(replace(batch, scans=batch.scans[1:]), [done])


def test_scan_that_failed_has_no_link_to_what_it_made_before(tmp_path):
    make_scans(tmp_path, 1)
    batch = read_batch(table(tmp_path, ["0.npz"]))
    (batch.folder / "s0").mkdir(parents=True)
    (batch.folder / "s0" / "report.html").touch()
    write_index(batch, [Outcome("s0", "done")])
    assert 'href="s0/report.html"' in (batch.folder / "index.html").read_text()
    (batch.folder / "s0.error.txt").touch()
    write_index(batch, [Outcome("s0", "failed", "no luck")])
    page = (batch.folder / "index.html").read_text()
    assert 'href="s0.error.txt"' in page
    assert "report.html" not in page


def test_no_scheduler_there(tmp_path):
    make_scans(tmp_path, 1)
    batch = Batch(tmp_path, read_batch(table(tmp_path, ["0.npz"])).scans, tmp_path / "out")
    with pytest.raises(InputError, match="at least 1"):
        run_batch(batch, workers=0)
    missing = str(tmp_path / "none.json")
    with pytest.raises(InputError, match=r"none\.json: no such scheduler file"):
        run_batch(batch, scheduler=missing)
