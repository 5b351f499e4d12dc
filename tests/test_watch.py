"""Watching a folder: what is complete is solved once, what fails is told, Ctrl-C ends it."""

import os
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import active_children

import numpy as np
import pandas as pd
import psutil
import pytest
import xarray as xr

from optical_palpation.errors import InputError, OutputError
from optical_palpation.study import read_study, run_study
from optical_palpation.study.crew import Crew
from optical_palpation.study.watch import TABLE, Watch
from study_case import STUDY, make_study, make_volumes, map_study

OF_MAPS = map_study('map = "first.npy"\npixel_spacing = [0.05, 0.05]', "threads = 1")


def pressed(depth):
    x = np.linspace(-1, 1, 41)
    return 0.46 - depth * np.exp(-(x**2 + x[:, None] ** 2) / 0.3)


@pytest.fixture
def maps(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "study.toml").write_text(OF_MAPS)
    return tmp_path


def table(folder):
    return pd.read_csv(folder / TABLE, keep_default_na=False).set_index("file")


def all_arrived(watch, seconds=20):
    end = time.monotonic() + seconds
    while not (found := watch.arrived()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


def test_a_map_that_arrives_has_the_stress_that_run_gives(maps):
    watch = Watch(maps / "study.toml", maps / "in", settle=0.05, pattern="*.npy", estimates=True)
    np.save(maps / "in" / "first.npy", pressed(0.03))
    (maps / "in" / "notes.txt").write_text("not a map")
    (path,) = all_arrived(watch)
    done = watch.solve(path)
    assert (done.file, done.status, done.message) == ("first.npy", "done", "")
    assert watch.arrived() == []
    changes = {"loaded.map": str(path), "outputs.write": []}
    by_run = run_study(read_study(maps / "study.toml", changes))
    expected = xr.load_dataset(by_run.folder / "stress.nc", engine="h5netcdf")
    found = xr.load_dataset(maps / "in-stress" / "first.npy.stress.nc", engine="h5netcdf")
    assert "edge_influence" in expected
    for name in expected.data_vars:
        assert np.array_equal(found[name], expected[name], equal_nan=found[name].dtype.kind == "f")
    row = table(maps / "in-stress").loc["first.npy"]
    assert row["sample_force_mN"] == pytest.approx(expected.attrs["sample_force_mN"])
    assert row["status"] == "done"


def test_half_a_file_is_waited_for(maps):
    watch = Watch(maps / "study.toml", maps / "in", settle=2.0)
    np.save(maps / "whole.npy", pressed(0.03))
    content = (maps / "whole.npy").read_bytes()
    target = maps / "in" / "slow.npy"
    with target.open("wb") as stream:
        for part in range(5):
            stream.write(content[part * len(content) // 5 : (part + 1) * len(content) // 5])
            stream.flush()
            assert watch.arrived() == []
            time.sleep(0.1)
    assert all_arrived(watch) == [target]
    assert watch.solve(target).status == "done"


def test_a_failure_is_told_and_tried_again_when_the_file_changes(maps):
    watch = Watch(maps / "study.toml", maps / "in", settle=0.05)
    np.save(maps / "in" / "a.npy", pressed(0.03) * 1000)
    np.save(maps / "in" / "b.npy", pressed(0.04))
    outcomes = {p.name: watch.solve(p) for p in all_arrived(watch)}
    while len(outcomes) < 2:
        outcomes |= {p.name: watch.solve(p) for p in all_arrived(watch)}
    assert outcomes["a.npy"].status == "failed"
    assert "um" in outcomes["a.npy"].message
    assert outcomes["b.npy"].status == "done"
    assert not (maps / "in-stress" / "a.npy.stress.nc").exists()
    np.save(maps / "in" / "a.npy", pressed(0.03))
    assert watch.solve(all_arrived(watch)[0]).status == "done"
    assert set(table(maps / "in-stress")["status"]) == {"done"}
    # another watch takes up what is there, unless it has changed
    np.save(maps / "in" / "b.npy", pressed(0.05))
    again = Watch(maps / "study.toml", maps / "in", settle=0.0)
    again.arrived()
    status = {p.name: again.solve(p).status for p in all_arrived(again)}
    assert status == {"a.npy": "earlier", "b.npy": "done"}
    # another number of threads is no other study, and the estimates are another result
    text = (maps / "study.toml").read_text()
    for options, status in (({"threads": 2}, "earlier"), ({"estimates": True}, "done")):
        other = Watch(maps / "study.toml", maps / "in", settle=0.0, **options)
        other.arrived()
        assert {other.solve(p).status for p in all_arrived(other)} == {status}
    (maps / "study.toml").write_text(text.replace("window = 0.15", "window = 0.2"))
    late = again.solve(maps / "in" / "b.npy")
    assert (late.status, "start the watch again" in late.message) == ("failed", True)
    changed = Watch(maps / "study.toml", maps / "in", settle=0.0)
    changed.arrived()
    assert {changed.solve(p).status for p in all_arrived(changed)} == {"done"}


def test_another_unloaded_map_makes_another_result_and_no_row_is_lost(maps):
    text = OF_MAPS.replace("thickness = 0.5", 'map = "flat.npy"\npixel_spacing = [0.05, 0.05]')
    (maps / "study.toml").write_text(text)
    np.save(maps / "flat.npy", np.full((41, 41), 0.5))
    first, second = (Watch(maps / "study.toml", maps / "in", settle=0.0) for _ in range(2))
    for name, watch in (("a.npy", first), ("b.npy", second)):
        np.save(maps / "in" / name, pressed(0.03))
        assert watch.solve(maps / "in" / name).status == "done"
    assert set(table(maps / "in-stress").index) == {"a.npy", "b.npy"}
    force = table(maps / "in-stress")["sample_force_mN"]["a.npy"]
    assert first.solve(maps / "in" / "a.npy").status == "earlier"
    np.save(maps / "flat.npy", np.full((41, 41), 0.51))
    assert first.solve(maps / "in" / "a.npy").status == "done"
    assert table(maps / "in-stress")["sample_force_mN"]["a.npy"] > 1.05 * force


def test_volumes_against_an_unloaded_one_that_is_found_once(tmp_path):
    make_volumes(tmp_path)
    (tmp_path / "in").mkdir()
    make_study(tmp_path, STUDY.replace('volume = "loaded.npy"', 'volume = "not-yet-there.npy"'))
    watch = Watch(tmp_path / "study.toml", tmp_path / "in", tmp_path / "out", settle=0.0)
    stages = set()
    watch.prepare(lambda report: stages.add(report.stage))
    assert "boundaries of the unloaded layer" in stages
    shutil.copy(tmp_path / "loaded.npy", tmp_path / "in" / "scan.npy")
    watch.arrived()
    done = watch.solve(all_arrived(watch)[0])
    assert done.status == "done", done.message
    changes = {"loaded.volume": "loaded.npy", "outputs.write": [], "errors.estimates": False}
    by_run = run_study(read_study(tmp_path / "study.toml", changes))
    expected = xr.load_dataset(by_run.folder / "stress.nc", engine="h5netcdf")
    found = xr.load_dataset(tmp_path / "out" / "scan.npy.stress.nc", engine="h5netcdf")
    assert np.array_equal(found["axial_stress"], expected["axial_stress"])
    np.save(tmp_path / "unloaded.npy", np.load(tmp_path / "unloaded.npy") * 2)
    os.utime(tmp_path / "in" / "scan.npy", (1, 1))
    watch.arrived()
    late = watch.solve(all_arrived(watch)[0])
    assert late.status == "failed"
    assert "start the watch again" in late.message


def all_solved(crew, count, seconds=60):
    found, end = [], time.monotonic() + seconds
    while len(found) < count:
        found += crew.solved()
        assert time.monotonic() < end
        time.sleep(0.02)
    assert not crew.busy
    return {arrival.file: arrival for arrival in found}


def test_two_processes_find_what_one_finds(maps):
    """To the bit, on as many threads; what dies is begun again, and what dies twice has failed."""
    names = [f"{n}.npy" for n in range(4)]
    for n, name in enumerate(names):
        np.save(maps / "in" / name, pressed(0.02 + 0.003 * n))
    alone = Watch(maps / "study.toml", maps / "in", maps / "alone")
    with Crew(alone) as crew:
        for name in names:
            crew.solve(maps / "in" / name)
        assert set(all_solved(crew, 4)) == set(names)
    watch = Watch(maps / "study.toml", maps / "in", maps / "beside")
    with Crew(watch, 2) as crew:
        for name in names[:3]:
            crew.solve(maps / "in" / name)
        first = active_children()
        first[0].kill()
        assert {arrival.status for arrival in all_solved(crew, 3).values()} <= {"done", "earlier"}
        crew.solve(maps / "in" / names[3])
        arrivals = []
        while not arrivals:  # none lives long enough
            for child in active_children():
                child.kill()
            arrivals = list(crew.solved())
        (lost,) = arrivals
        assert (lost.status, "died twice" in lost.message) == ("failed", True)
    assert not active_children()
    rows = table(maps / "beside")
    assert list(rows["status"][names]) == ["done"] * 3 + ["failed"]
    assert "died twice" in rows["message"][names[3]]
    for name in names[:3]:
        one, two = (
            xr.load_dataset(maps / where / f"{name}.stress.nc", engine="h5netcdf")
            for where in ("alone", "beside")
        )
        assert one["axial_stress"].equals(two["axial_stress"])
    again = Watch(maps / "study.toml", maps / "in", maps / "beside")
    assert again.solve(maps / "in" / names[3]).status == "done"


def test_what_cannot_be_watched_is_refused(maps):
    with pytest.raises(InputError, match="no such folder"):
        Watch(maps / "study.toml", maps / "nowhere")
    with pytest.raises(OutputError, match="watched folder"):
        Watch(maps / "study.toml", maps / "in", maps / "in")
    with pytest.raises(InputError, match="no such file"):
        Watch(maps / "none.toml", maps / "in")
    (maps / "out").mkdir()
    (maps / "out" / TABLE).write_text("a,b\n1,2\n")
    with pytest.raises(OutputError, match="no table of an earlier watch"):
        Watch(maps / "study.toml", maps / "in", maps / "out")


def test_the_command_tells_each_file_and_ends_with_ctrl_c(maps):
    command = [sys.executable, "-m", "optical_palpation", "watch", "in", "study.toml"]
    np.save(maps / "in" / "bad.npy", np.full((9, 9), -1.0))
    process = subprocess.Popen(
        [*command, "--settle", "0.1"],
        cwd=maps,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        assert "ready after" in process.stdout.readline()
        assert process.stdout.readline().startswith("bad.npy: failed: ")
        np.save(maps / "in" / "good.npy", pressed(0.03))
        assert process.stdout.readline().startswith("good.npy: force ")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    # Ctrl-C in the middle of a print may repeat that line
    assert out.splitlines()[-2:] == [
        "1 done, 1 failed",
        str((maps / "in-stress" / TABLE).resolve()),
    ]
    assert sorted(p.name for p in (maps / "in-stress").iterdir() if p.name[0] != ".") == [
        TABLE,
        "good.npy.stress.nc",
    ]
    again = subprocess.run(
        [*command, "--settle", "0", "--idle", "0.5"], cwd=maps, capture_output=True, text=True
    )
    assert again.returncode == 0, again.stderr
    assert "1 by an earlier watch, 1 failed" in again.stdout


def test_ctrl_c_ends_the_processes_too(maps):
    np.save(maps / "in" / "good.npy", pressed(0.03))
    command = [sys.executable, "-m", "optical_palpation", "watch", "in", "study.toml"]
    process = subprocess.Popen(
        [*command, "--settle", "0.1", "--workers", "2"],
        cwd=maps,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        assert "ready after" in process.stdout.readline()
        assert process.stdout.readline().startswith("good.npy: force ")
        workers = psutil.Process(process.pid).children(recursive=True)
        assert len(workers) >= 2
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert "1 done, 0 failed" in out
    _, left = psutil.wait_procs(workers, timeout=20)
    assert all(worker.status() == psutil.STATUS_ZOMBIE for worker in left)
