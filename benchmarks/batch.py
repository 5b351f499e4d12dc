"""Many studies on local workers against the same one after another.

Usage: python benchmarks/batch.py [--studies 200] [--workers 2 4] [--element-size 0.25]

Every study has a thickness map of its own: a layer of 4 x 4 x 0.5 mm on a random relief. One after
another they run as ``optical-palpation run``, side by side as ``optical-palpation batch``, one
thread each, with all files that a study writes. The forces must be the same. Told are wall-clock
time, processor time of all processes, and how far the speed-up is from the number of workers. On
a machine with other work the processor time is the more honest: without loss by side-by-side work
it is the same in both.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
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


def timed(folder: Path, *arguments: str) -> tuple[float, float]:
    """Run the command and return its wall-clock and processor time, s."""
    environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    code = "from optical_palpation.cli import main; main()"
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-c", code, *arguments]
    subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--element-size", type=float, default=0.25)
    arguments = parser.parse_args()
    cores, load = psutil.cpu_count(), psutil.getloadavg()[0]
    print(f"{arguments.studies} studies, {cores} cores, load before the run {load:.1f}", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        names = make_studies(folder, arguments.studies, arguments.element_size)
        timed(folder, "run", f"{names[0]}.toml", "--quiet", "--set", "outputs.folder='warm'")
        alone = one_after_another(folder, names)
        print(f"one after another: {alone.wall:.0f} s, processors {alone.processor:.0f} s")
        for workers in arguments.workers:
            beside = side_by_side(folder, workers)
            assert np.array_equal(beside.forces, alone.forces.loc[beside.forces.index])
            speed = alone.wall / beside.wall
            ideal = min(workers, cores)
            print(
                f"{workers} workers: {beside.wall:.0f} s, processors {beside.processor:.0f} s; "
                f"{speed:.2f} times as fast, {speed / ideal:.2f} of the ideal for {ideal} cores; "
                f"processor time {beside.processor / alone.processor:.2f} times that of one",
                flush=True,
            )


if __name__ == "__main__":
    main()
