"""A study that is killed at any moment leaves nothing half done, and can be taken up again."""

import json
import multiprocessing
import random
import shutil
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import wait
from pathlib import Path

import pytest

from optical_palpation.cli import main
from optical_palpation.study.record import RECORD
from study_case import NO_ESTIMATES, STUDY, make_study, make_volumes

# A process that has imported all it needs and is copied for every run: the kills are to strike
# while the study runs, and not while Python starts.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "test_study_interrupted",
        *(
            "optical_palpation.cli.study",
            "optical_palpation.palpation",
            "optical_palpation.present",
        ),
        *("dask.array", "distributed", "pint"),  # for which xarray looks where they are installed
        *("matplotlib.backends.backend_agg", "matplotlib.figure"),
    ]
)
# Every start also polls the processes of the other threads, and the status of a process can be
# read once only: the second reader finds 255.
POLLING = threading.Lock()


def run_study(folder: str) -> None:
    main(["run", f"{folder}/study.toml", "--quiet"])


def start(folder: Path) -> multiprocessing.process.BaseProcess:
    process = CONTEXT.Process(target=run_study, args=(str(folder),))
    with POLLING:
        process.start()
    return process


def finish(process: multiprocessing.process.BaseProcess) -> int | None:
    """Wait for the end of a process; its exit status."""
    wait([process.sentinel])
    with POLLING:
        process.join()
    return process.exitcode


def record(results: Path) -> dict:
    return json.loads((results / RECORD).read_text())


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A folder with a finished study, run twice so that all is compiled."""
    folder = tmp_path_factory.mktemp("undisturbed")
    make_volumes(folder)
    outputs = '[outputs]\nwrite = ["vtk", "profiles", "report"]\n'
    make_study(folder, STUDY + NO_ESTIMATES + outputs)
    for _ in range(2):
        shutil.rmtree(folder / "study-results", ignore_errors=True)
        assert finish(start(folder)) == 0
    return folder


def wait_for(stages: int, results: Path) -> None:
    """Wait until so many stages are finished."""
    limit = time.monotonic() + 120
    while time.monotonic() < limit:
        if (results / RECORD).exists() and len(record(results)["stages"]) >= stages:
            return
        time.sleep(0.002)
    raise TimeoutError(f"stage {stages} is not reached")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_killed_at_random_moments(undisturbed, tmp_path):
    whole = undisturbed / "study-results"
    expected = {p.name: p.read_bytes() for p in whole.iterdir() if p.name != ".lock"}
    seconds = [
        stage["seconds"] for stage in record(undisturbed / "study-results")["stages"].values()
    ]

    def kill_and_resume(stages: list[int]) -> int:
        folder = tmp_path / str(stages[0])
        folder.mkdir()
        for path in undisturbed.glob("*.*"):
            (folder / path.name).hardlink_to(path)
        results = folder / "study-results"
        killed, before = 0, {}
        for n in stages:
            # Somewhere in stage n; how long it takes depends on what else the machine does.
            process = start(folder)
            if n:
                wait_for(n, results)
            time.sleep(random.Random(n).random() * seconds[n])
            process.kill()
            killed += finish(process) == -signal.SIGKILL
            after = check_whole(results, expected)
            # What was finished was not done again: its time stamp is the old one.
            assert {name: after[name] for name in before} == before
            before = after

        assert finish(start(folder)) == 0
        after = record(results)
        assert after["complete"] is True
        assert {name: after["stages"][name] for name in before} == before
        # The same files to the last bit, and no leftovers of the runs that were killed.
        assert {p.name for p in results.iterdir()} == {".lock", *expected}
        for name in expected.keys() - {RECORD}:
            assert (results / name).read_bytes() == expected[name], name
        return killed

    # Killed in every stage; each run that is killed has first gone on from an earlier one.
    studies = [list(range(first, len(seconds), 2)) for first in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        killed = sum(pool.map(kill_and_resume, studies))
    assert killed >= len(seconds) - 2  # the last may come too late


def check_whole(results: Path, expected: dict[str, bytes]) -> dict[str, dict]:
    """Check that every file with a final name is final; return what the record says is finished."""
    if not (results / RECORD).exists():
        assert not results.exists() or all(p.name.startswith(".") for p in results.iterdir())
        return {}
    for path in results.iterdir():
        if not path.name.startswith(".") and path.name != RECORD:
            assert path.read_bytes() == expected[path.name], f"{path.name} is half done"
    stages = record(results)["stages"]
    assert record(results)["complete"] is (stages.keys() == expected.keys() - {RECORD})
    assert all((results / name).exists() for name in stages)
    return stages
