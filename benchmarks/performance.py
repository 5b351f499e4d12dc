"""Time, memory and iterations of the computational method, written to docs/performance.md.

    python benchmarks/performance.py            6,400 to 1,000,000 elements, references, CalculiX
    python benchmarks/performance.py --huge     12,500,000 elements

Each case runs in a process of its own, on the measured map of a coin where there is one
(``../shared/data``), else on one that is made. ``--only`` measures some cases
again; the others keep what an earlier run found. Results are kept in benchmarks/performance.json,
from which the page is written.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from unittest import mock

import numpy as np
import psutil
import xarray as xr

import performance_page
from performance_probe import Probe, copy_bandwidth

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "benchmarks" / "performance.json"
PAGE = ROOT / "docs" / "performance.md"
LAYERS = ROOT / ".." / "shared" / "data" / "layers"
COIN = LAYERS / "coin_5c_1-thickness.mat"
SINUSOID = LAYERS / "sinusoid_simulated_L1.npz"
FIELD, THICKNESS = 5.0, 0.5  # of the coin's map, mm
ENOUGH = 5.0  # seconds for which a case is repeated


@dataclass(frozen=True)
class Case:
    """A run on the coin's map."""

    text: str
    element_size: tuple[float, float, float]
    field: float = FIELD
    solver: str = "auto"
    cascade: bool = True
    huge: bool = False


CASES = {
    "6,400": Case("coin 125 um, 4 deep", (0.125, 0.125, 0.125)),
    "100,000": Case("coin 50 um, 10 deep", (0.05, 0.05, 0.05)),
    "240,000": Case("7 x 7 mm at 35 um, 6 deep", (0.035, 0.035, THICKNESS / 6), field=7.0),
    "1,000,000": Case("coin 25 um, 25 deep", (0.025, 0.025, 0.02)),
    "12,500,000": Case("coin 10 um, 50 deep", (0.01, 0.01, 0.01), huge=True),
    "6,400 direct": Case("the first, sparse-direct", (0.125, 0.125, 0.125), solver="direct"),
    "6,400 slow": Case("the first, without nested iteration", (0.125, 0.125, 0.125), cascade=False),
    "100,000 slow": Case("the second, without nested iteration", (0.05, 0.05, 0.05), cascade=False),
}


def loaded_thickness(field: float) -> xr.DataArray:
    """Loaded thickness over ``field`` x ``field`` mm, the map mirrored where it is too small."""
    from optical_palpation.thickness import clean_thickness, read_thickness_map, thickness_map

    if COIN.exists():
        measured = read_thickness_map(COIN, variable="in_L0", field_of_view=(FIELD, FIELD))
        cleaned = clean_thickness(measured)["thickness"]
    else:
        axis = np.linspace(0, FIELD, 501)
        cleaned = thickness_map(made_coin(axis), x=axis, y=axis, where="made coin")
    if field == FIELD:
        return cleaned
    pixel = FIELD / (cleaned.sizes["x"] - 1)
    extra = round((field - FIELD) / pixel)
    axis = pixel * np.arange(cleaned.sizes["x"] + extra)
    values = np.pad(cleaned.values, ((0, extra), (0, extra)), mode="reflect")
    return thickness_map(values, x=axis, y=axis, where="extended map")


def made_coin(axis: np.ndarray) -> np.ndarray:
    """Loaded thickness under an imaginary coin: a raised rim, a digit-like ring and two bars."""
    y, x = np.meshgrid(axis, axis, indexing="ij")

    def raised(distance: np.ndarray, half_width: float) -> np.ndarray:
        return 0.5 * (1 + np.tanh((half_width - distance) / 0.05))

    rim = raised(np.abs(np.hypot(x - 2.5, y + 3.0) - 7.0), 0.2)
    ring = raised(np.abs(np.hypot(x - 3.2, y - 1.5) - 0.7), 0.15)
    bars = raised(np.maximum(np.abs(x - 1.2) - 0.6, np.abs(y - 2.6) - 0.15), 0.05)
    bars += raised(np.maximum(np.abs(x - 0.7) - 0.12, np.abs(y - 1.8) - 0.8), 0.05)
    return 0.44 + 0.003 * (x - y) - 0.07 * np.clip(rim + ring + bars, 0, 1)


def solve(
    loaded: xr.DataArray,
    element_size: float | tuple[float, ...],
    solver: str = "auto",
    cascade: bool = True,
    threads: int | None = None,
):
    from optical_palpation.material import MooneyRivlin
    from optical_palpation.palpation import computational

    with ExitStack() as stack:
        if not cascade:
            slow = partial(computational.solve, cascade=False)
            stack.enter_context(mock.patch.object(computational, "solve", slow))
        return computational.computational_stress(
            loaded,
            THICKNESS,
            MooneyRivlin(2.23, 0.703),
            window_friction=0.15,
            sample_friction=0.05,
            element_size=element_size,
            solver=solver,
            threads=threads,
            edge_check=False,  # the solution alone
            input_errors=None,
        )


def warm_up(threads: int | None, solver: str = "auto") -> None:
    """Compile, or load, the kernels on a map that is solved at once."""
    flat = loaded_thickness(FIELD)[::25, ::25] * 0 + 0.98 * THICKNESS
    for size in (0.5, 0.2):  # the second with cascade
        solve(flat, (size, size, 0.125), solver, threads=threads)


def peak_memory() -> int:
    """Bytes this process has held at most (``getrusage`` would count those of its parent, too)."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.search(r"VmHWM:\s*(\d+) kB", status)[1])


def run_case(name: str, folder: Path, threads: int | None) -> dict:
    """Measure one case in this process, kernels compiled."""
    from optical_palpation.mechanics.krylov import longest
    from optical_palpation.palpation.memory import predicted_memory

    case = CASES[name]
    warm_up(threads, case.solver)
    loaded = loaded_thickness(case.field)
    held = psutil.Process().memory_info().rss
    plain = None
    if not case.huge:
        runs: list[float] = []
        while sum(runs) < ENOUGH and len(runs) < 9:
            start = time.perf_counter()
            solve(loaded, case.element_size, case.solver, case.cascade, threads)
            runs.append(time.perf_counter() - start)
        plain = float(np.median(runs))
    peak = peak_memory() if plain else None
    probe = Probe()
    with probe:  # once more, watched
        start = time.perf_counter()
        result = solve(loaded, case.element_size, case.solver, case.cascade, threads)
        watched = time.perf_counter() - start
    nz, ny, nx = (len(result.layer[d]) - 1 for d in "zyx")
    elements = nz * ny * nx
    np.savez(
        folder / "pressure.npz",
        **{v: result.maps[v].values for v in ("contact_pressure", "x", "y")},
    )
    steps = json.loads(result.maps.attrs["convergence"])
    unknowns = 3 * (nx + 1) * (ny + 1) * (nz + 1) + elements
    return {
        "elements": elements,
        "grid": [nx, ny, nz],
        "unknowns": unknowns,
        "seconds": plain or watched,
        "watched_seconds": watched,
        "newton": result.maps.attrs["newton_iterations"],
        "newton_finest": sum(s["newton"] for s in steps if s["elements"] == elements),
        "krylov": probe.krylov,
        "krylov_largest": max(probe.krylov_each, default=0),
        "krylov_ended": sum(k >= longest(unknowns) for k in probe.krylov_each),
        "peak_bytes": peak or peak_memory(),
        "predicted_bytes": held + predicted_memory((nz, ny, nx), case.solver),
        "shares": {phase: s / watched for phase, s in probe.seconds.items()},
        "bytes_moved": probe.bytes_moved,
        "force_mN": result.maps.attrs["sample_force_mN"],
    }


def run_sinusoid(threads: int | None, limit: float) -> dict:
    """CalculiX and this solver on one problem at K/mu 100, one after the other."""
    from calculix import calculix_installed, run_calculix, sinusoid
    from optical_palpation.material import MooneyRivlin
    from optical_palpation.mechanics import cascade
    from optical_palpation.palpation.meshing import expected_forces

    if not SINUSOID.exists():
        return {"failed": "the imprint's file is not there"}
    material = MooneyRivlin(2.23, 0.703, 100.0)
    warm_up(threads)
    warm_up(threads, "direct")
    problem = sinusoid(SINUSOID, 40, 4)
    found: dict = {}
    for solver in ("multigrid", "direct"):
        start = time.perf_counter()
        solution = cascade.solve(problem, lambda p: expected_forces(p, material), solver=solver)
        found[solver] = {
            "seconds": time.perf_counter() - start,
            "force_mN": float(solution.state.normal_force[1].sum()),
            "elements": problem.grid.n_elements,
        }
    if not calculix_installed():
        return found | {"failed": "CalculiX (ccx) is not installed"}
    with tempfile.TemporaryDirectory() as folder:
        result = run_calculix(
            sinusoid(SINUSOID, 20, 2), folder, limit, threads=threads, element="C3D20R"
        )
    if result.converged:
        found["calculix"] = {
            "seconds": result.seconds,
            "force_mN": result.force_imprint,
            "elements": 800,
        }
    else:
        found["failed"] = f"CalculiX: no solution in {result.seconds:.0f} s"
    return found


def run_start(folder: Path, threads: int | None) -> dict:
    """How long the command takes until it solves, with an empty and with a filled kernel cache.

    The latter is the median of five.
    """
    from optical_palpation.thickness import write_thickness_map

    write_thickness_map(loaded_thickness(FIELD), folder / "loaded.nc")
    command = [sys.executable, "-c", "from optical_palpation.cli import main; main()", "stress"]
    command += [str(folder / "loaded.nc"), "--output", str(folder / "stress.nc")]
    command += f"--initial-thickness {THICKNESS} --c10 2.23 --c01 0.703".split()
    command += ["--window-friction", "0.15", "--sample-friction", "0.05", "--element-size", "0.25"]
    command += ["--threads", str(threads)] if threads else []
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    runs = defaultdict(list)
    for name in ("compiling", *5 * ("compiled",)):
        start = time.perf_counter()
        solving, said_compiling = None, False
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as run:
            assert run.stderr is not None
            for line in run.stderr:
                said_compiling |= "compiling kernels" in line
                if solving is None and re.match(r"[\d,]+ elements", line):
                    solving = time.perf_counter() - start
        if run.returncode or solving is None:
            raise RuntimeError(f"the command ended with status {run.returncode}")
        runs[name].append(
            {
                "solving_s": solving,
                "whole_s": time.perf_counter() - start,
                "said_compiling": said_compiling,
            }
        )
    return {
        name: sorted(of, key=itemgetter("solving_s"))[len(of) // 2] for name, of in runs.items()
    }


def child(name: str, threads: int | None, limit: float, calculix_limit: float) -> dict:
    """Run one measurement in a process of its own; what it found, or why it found nothing."""
    if name == "sinusoid":
        limit += calculix_limit
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--child", name, folder]
        command += ["--calculix-limit", str(calculix_limit)]
        if threads:
            command += ["--threads", str(threads)]
        log = Path(folder) / "log"
        with log.open("w") as stream:
            # a session of its own, so that a case out of time ends with all that it has started
            process = subprocess.Popen(
                command, stdout=stream, stderr=stream, start_new_session=True
            )
            try:
                process.wait(limit)
            except subprocess.TimeoutExpired:
                return {"failed": f"no result within {limit:.0f} s"}
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
        if process.returncode:
            said = log.read_text().strip().splitlines() or [f"exit status {process.returncode}"]
            return {"failed": said[-1]}
        found = json.loads((Path(folder) / "found.json").read_text())
        pressure = Path(folder) / "pressure.npz"
        if pressure.exists():
            with np.load(pressure) as data:
                found["_pressure"] = data["contact_pressure"]
        return found


def difference(found: dict, reference: dict) -> dict:
    """Relative differences of contact pressure (L2) and total force; empty where one failed."""
    if "_pressure" not in found or "_pressure" not in reference:
        return {}
    a, b = found["_pressure"], reference["_pressure"]
    both = np.isfinite(a) & np.isfinite(b)
    return {
        "pressure": float(np.linalg.norm((a - b)[both]) / np.linalg.norm(b[both])),
        "force": found["force_mN"] / reference["force_mN"] - 1,
    }


def machine(threads: int | None) -> dict:
    from optical_palpation.runtime import software_version

    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "processor": model,
        "cores": len(os.sched_getaffinity(0)),
        "threads": threads or len(os.sched_getaffinity(0)),
        "memory_bytes": psutil.virtual_memory().total,
        "load_before": os.getloadavg()[0],
        "bandwidth": copy_bandwidth(threads),
        "python": platform.python_version(),
        "map": "coin" if COIN.exists() else "made",
        "date": time.strftime("%Y-%m-%d"),
        "version": software_version(),
    }


def main() -> None:
    names = [*CASES, "sinusoid", "start"]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--huge", action="store_true", help="the case of 12,500,000 elements")
    parser.add_argument("--only", nargs="+", choices=names, metavar="CASE", help="; ".join(names))
    parser.add_argument("--limit", type=float, help="seconds per case (600; 3600 with --huge)")
    parser.add_argument("--calculix-limit", type=float, default=1800.0, help="seconds")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--dry", action="store_true", help="print; write neither record nor page")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    # a case does not go on alone where this process is told to end
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    threads = arguments.threads
    if arguments.child:
        name, folder = arguments.child[0], Path(arguments.child[1])
        if name == "compile":
            warm_up(threads)
            warm_up(threads, "direct")
            found = {}
        elif name == "sinusoid":
            found = run_sinusoid(threads, arguments.calculix_limit)
        elif name == "start":
            found = run_start(folder, threads)
        else:
            found = run_case(name, folder, threads)
        (folder / "found.json").write_text(json.dumps(found))
        return

    chosen = arguments.only or [
        n for n in names if n not in CASES or CASES[n].huge == arguments.huge
    ]
    if arguments.huge and not arguments.only:
        chosen = [n for n in CASES if CASES[n].huge]
    limit = arguments.limit or (3600.0 if arguments.huge else 600.0)
    here = machine(threads)
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    new = {}
    child("compile", threads, limit, 0.0)  # what compilation takes is no part of the cases
    for name in chosen:
        print(f"{name} ...", flush=True)
        started = time.perf_counter()
        found = child(name, threads, limit, arguments.calculix_limit)
        new[name] = found | {"machine": here}
        if name in CASES:
            print(performance_page.case_line(name, CASES[name], new[name]), flush=True)
        elif "failed" in new[name]:
            print(new[name]["failed"])
        print(f"  ({time.perf_counter() - started:.0f} s in all)", flush=True)
    for name, reference in (
        ("6,400", "6,400 direct"),
        ("6,400", "6,400 slow"),
        ("100,000", "100,000 slow"),
    ):
        if name in new and reference in new:
            new[reference]["difference"] = difference(new[name], new[reference])
    for found in new.values():
        found.pop("_pressure", None)
    record |= new
    page = performance_page.page(CASES, record)
    print(page)
    if not arguments.dry:
        RECORD.write_text(json.dumps(record, indent=1) + "\n")
        PAGE.write_text(page)


if __name__ == "__main__":
    main()
