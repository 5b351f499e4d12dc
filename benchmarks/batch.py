"""Many studies on local workers against the same one after another.

Usage: python benchmarks/batch.py [--studies 200] [--workers 2 4] [--element-size 0.25] [--losses]

Every study has a thickness map of its own: a layer of 4 x 4 x 0.5 mm on a random relief. One after
another they run as ``optical-palpation run``, side by side as ``optical-palpation batch``, one
thread each, with all files that a study writes. One half runs one after another before the batches
and the other half after them, so that a drift of the machine's speed does not count. The forces
must be the same. Told are wall-clock time, processor time of all processes, and how far the
speed-up is from the number of workers. On a machine with other work the processor time is the more
honest: without loss by side-by-side work it is the same in both.

With ``--losses`` they also run as a batch of which three workers are killed (SIGKILL) at an eighth,
two and three eighths of the studies, and the client at five eighths; the same command then goes on.
Every result must be that of the studies one after another, to the bit, and what was complete when
the client was killed must not have been written again.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
from scipy.ndimage import gaussian_filter

from optical_palpation.present import read_result

STUDY = """\
unloaded = {{ thickness = 0.5 }}
loaded = {{ map = "{name}.npz" }}
material = {{ c10 = 2.23, c01 = 0.703 }}
friction = {{ window = 0.15, sample = 0.1 }}
grid = {{ element_size = {size} }}
"""


@dataclass(frozen=True)
class Run:
    """What a run took: seconds by the clock, seconds of processors, and the forces it found, mN."""

    wall: float
    processor: float
    forces: pd.Series


def make_studies(folder: Path, count: int, size: float) -> list[str]:
    """Write studies and their maps; every one has another relief."""
    axis = np.linspace(0.0, 4.0, 81)
    names = [f"s{n:03d}" for n in range(count)]
    for seed, name in enumerate(names):
        relief = gaussian_filter(np.random.default_rng(seed).normal(size=(81, 81)), 12, mode="wrap")
        loaded = 0.43 - 0.02 * relief / relief.std()
        np.savez(folder / f"{name}.npz", L1_mm=np.clip(loaded, 0.35, 0.49), x_mm=axis, y_mm=axis)
        (folder / f"{name}.toml").write_text(STUDY.format(name=name, size=size))
    rows = [f"{name},{name}.toml" for name in names]
    (folder / "table.csv").write_text("\n".join(["name,study", *rows]) + "\n")
    return names


def started(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start the command, on one thread."""
    environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    code = "from optical_palpation.cli import main; main()"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL)


def timed(folder: Path, *arguments: str) -> tuple[float, float]:
    """Run the command and return its wall-clock and processor time, s."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    if status := started(folder, *arguments).wait():
        raise SystemExit(f"{' '.join(arguments[:2])}... ended with status {status}")
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, sum(after[:2]) - sum(before[:2])


def one_after_another(folder: Path, names: list[str]) -> Run:
    """Run the studies by one command."""
    wall, processor = timed(folder, "run", *(f"{name}.toml" for name in names), "--quiet")
    results = (read_result(folder / f"{name}-results" / "stress.nc") for name in names)
    forces = [float(result.maps.attrs["window_force_mN"]) for result in results]
    return Run(wall, processor, pd.Series(forces, names))


def side_by_side(folder: Path, workers: int) -> Run:
    """Run them as a batch."""
    output = f"with-{workers}"
    options = ("--workers", str(workers), "--output", output, "--quiet")
    wall, processor = timed(folder, "batch", "table.csv", *options)
    table = pd.read_csv(folder / output / "scans.csv").set_index("scan")
    assert (table["status"] == "done").all()
    return Run(wall, processor, table["window_force_mN"])


def complete(folder: Path) -> dict[str, int]:
    """Studies that are done in a folder of a batch, and when their stress was written."""
    found = {}
    for record in folder.glob("*/provenance.json"):
        with suppress(OSError, ValueError):  # it is being replaced
            if json.loads(record.read_text())["complete"]:
                found[record.parent.name] = (record.parent / "stress.nc").stat().st_mtime_ns
    return found


def content(path: Path) -> dict[str, object]:
    """All values and attributes of a result, to the bit; HDF5 may lay them out in another order."""
    result = read_result(path)
    assert result.layer is not None
    return {
        str(name): (variable.values.tobytes(), str(variable.attrs))
        for part in (result.maps, result.layer)
        for name, variable in part.variables.items()
    } | {"attributes": str(result.maps.attrs)}


def with_losses(folder: Path, names: list[str], workers: int) -> None:
    """Run the batch with workers and the client killed, and compare what comes of it."""
    command = ("batch", "table.csv", "--workers", str(workers), "--output", "losses", "--quiet")
    client = started(folder, *command)
    for share in (1, 2, 3, 5):
        while len(complete(folder / "losses")) < share * len(names) / 8:
            assert client.poll() is None, "the batch has ended too early"
            time.sleep(0.05)
        if share == 5:
            client.kill()
            client.wait()
            break
        one = next(
            child
            for child in psutil.Process(client.pid).children()
            if "spawn_main" in " ".join(child.cmdline())
        )
        one.send_signal(signal.SIGKILL)
    before = complete(folder / "losses")
    timed(folder, *command)
    after = complete(folder / "losses")
    assert set(after) == set(names), "studies are lost"
    assert all(after[name] == written for name, written in before.items()), "done twice"
    for name in names:
        alone = content(folder / f"{name}-results" / "stress.nc")
        assert content(folder / "losses" / name / "stress.nc") == alone, f"{name} differs"
    table = pd.read_csv(folder / "losses" / "scans.csv")
    assert list(table["scan"]) == names
    assert (table["status"] == "done").all()
    print(
        f"three workers and the client killed: {len(names)} results the same to the bit, none "
        f"lost, none of the {len(before)} that were complete done again",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--element-size", type=float, default=0.25)
    parser.add_argument("--losses", action="store_true", help="also with killed processes")
    arguments = parser.parse_args()
    cores, load = psutil.cpu_count(), psutil.getloadavg()[0]
    print(f"{arguments.studies} studies, {cores} cores, load before the run {load:.1f}", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        names = make_studies(folder, arguments.studies, arguments.element_size)
        timed(folder, "run", f"{names[0]}.toml", "--quiet", "--set", "outputs.folder='warm'")
        half = len(names) // 2
        runs = [one_after_another(folder, names[:half])]
        beside = {workers: side_by_side(folder, workers) for workers in arguments.workers}
        runs.append(one_after_another(folder, names[half:]))
        wall, processor = sum(run.wall for run in runs), sum(run.processor for run in runs)
        forces = pd.concat([run.forces for run in runs])
        print(f"one after another: {wall:.0f} s, processors {processor:.0f} s")
        for workers, run in beside.items():
            assert np.array_equal(run.forces, forces.loc[run.forces.index])
            speed, ideal = wall / run.wall, min(workers, cores)
            print(
                f"{workers} workers: {run.wall:.0f} s, processors {run.processor:.0f} s; "
                f"{speed:.2f} times as fast, {speed / ideal:.2f} of the ideal for {ideal} cores; "
                f"processor time {run.processor / processor:.2f} times that of one",
                flush=True,
            )
        if arguments.losses:
            with_losses(folder, names, arguments.workers[0])


if __name__ == "__main__":
    main()
