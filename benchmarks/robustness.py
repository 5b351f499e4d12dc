"""Random maps: does the computational method converge, or fail as it promises to?

    python benchmarks/robustness.py                       200 maps, counts by class
    python benchmarks/robustness.py --json failures.json  the same; what did not converge to a file
    python benchmarks/robustness.py --replay 17           one of them, with its progress
    python benchmarks/robustness.py --increment 0.05      does the force depend on the increments?
    python benchmarks/robustness.py --press 0.05          the same maps, hardly pressed

A map is rough, stepped, wavy, tilted, flat or bumpy, or shows a sphere, needles or a checkerboard
of punches; it may have holes that the sample does not reach, and presses the layer by up to half of
its thickness, a sphere up to 60 %. The layer is 0.1 to 2 mm thick and from a few thicknesses to 50
wide, up to four times as long as wide, unloaded flat or not. Friction is 0 to 1 on either face,
K/mu 20 to 1e5, edges free, padded or rollers, elements 8,000 at most. The law is the paper's
silicone in two of five, else another one of Mooney-Rivlin, neo-Hookean or Yeoh. Each map follows
from its number alone.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from unittest import mock

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from optical_palpation.errors import ConvergenceError
from optical_palpation.material import Law, MooneyRivlin, NeoHookean, Yeoh
from optical_palpation.mechanics import cascade
from optical_palpation.mechanics.path import StepControl
from optical_palpation.palpation import (
    InputErrors,
    Progress,
    StressResult,
    computational_stress,
)
from optical_palpation.palpation.meshing import layer_nodes
from optical_palpation.palpation.result import Status
from optical_palpation.thickness import thickness_map

RELIEFS = (
    "rough",
    "stepped",
    "tilted",
    "bumps",
    "wave",
    "flat",
    "sphere",
    "needles",
    "checkerboard",
)
#: What results are called that are not simply ``converged``: by an attribute that they have, and
#: those that are a little out of balance.
INSTEAD = {"asked_edges_failure": "coarse edges", "asked_elements_failure": "on coarser"}
NEARLY = "nearly"
#: Elements of a problem, at the most: without those that edges add, and with them.
MOST_ELEMENTS, MOST_WITH_EDGES = 6000, 8000


@dataclass(frozen=True)
class Case:
    """One random problem; ``compression`` is the greatest there is, a share of the thickness."""

    number: int
    relief: str
    holes: bool
    compression: float
    window_friction: float
    sample_friction: float
    bulk_to_shear: float
    edges: str
    uneven: bool
    thickness: float
    element_size: tuple[float, float, float]
    field: tuple[float, float]
    #: Whether the influence of the sides and the error bands are found, too.
    estimates: bool = True

    def elements(self) -> int:
        """How many elements the layer has, those that its edges add too."""
        extent = 0.0, self.field[0], 0.0, self.field[1]
        axes = layer_nodes(extent, self.thickness, self.element_size, self.edges)
        return int(np.prod([len(nodes) - 1 for nodes in axes]))

    def law(self) -> Law:
        """The law of the layer."""
        rng = np.random.default_rng([self.number, 2])
        kind = rng.choice(
            ["silicone", "mooney-rivlin", "neo-hookean", "yeoh"], p=[0.4, 0.2, 0.2, 0.2]
        )
        modulus = 100 ** rng.random()
        ratio = self.bulk_to_shear
        if kind == "silicone":
            return MooneyRivlin(2.23, 0.703, ratio)
        if kind == "mooney-rivlin":
            share = rng.uniform(0, 0.5)
            return MooneyRivlin((1 - share) * modulus, share * modulus, ratio)
        if kind == "neo-hookean":
            return NeoHookean(modulus, ratio)
        # softens first at most as far as it stays stable at any stretch: c20^2 < 3 c10 c30
        c20, c30 = rng.uniform(-0.05, 0.3) * modulus, rng.uniform(0.005, 0.1) * modulus
        return Yeoh(modulus, c20, c30, ratio)

    def maps(self) -> tuple[xr.DataArray, xr.DataArray]:
        """Loaded and unloaded thickness, mm."""
        rng = np.random.default_rng([self.number, 1])
        pixel = 0.2 * min(self.element_size[:2])
        axes = [np.linspace(0, size, round(size / pixel) + 1) for size in self.field]
        x, y = np.meshgrid(*axes)
        pressed = relief(self.relief, x, y, rng)
        if self.holes:
            bounded = np.minimum(pressed, 1.6 * _blobs(x, y, rng) - 0.3)
            pressed = bounded if bounded.max() > 0.05 else pressed
        if self.edges == "roller":
            # between rollers the layer keeps its volume: what is pressed here must rise elsewhere
            pressed = pressed - pressed.mean()
        unloaded = np.full_like(x, self.thickness)
        if self.uneven:
            unloaded *= 1 + 0.1 * (2 * relief("tilted", x, y, rng) - 1)
        loaded = unloaded * (1 - self.compression * pressed / max(pressed.max(), 1e-9))
        return tuple(
            thickness_map(values, x=axes[0], y=axes[1], where=f"random map {self.number}")
            for values in (loaded, unloaded)
        )

    def solve(self, solver: str = "auto", progress=None) -> StressResult:
        return computational_stress(
            *self.maps(),
            self.law(),
            window_friction=self.window_friction,
            sample_friction=self.sample_friction,
            element_size=self.element_size,
            edges=self.edges,
            solver=solver,
            threads=1,
            edge_check=self.estimates,
            input_errors=InputErrors() if self.estimates else None,
            progress=progress,
        )


def random_case(number: int) -> Case:
    rng = np.random.default_rng([number, 0])
    kind = str(rng.choice(RELIEFS))
    edges = str(rng.choice(["free", "padded", "roller"], p=[0.7, 0.15, 0.15]))
    if kind == "flat" and edges == "roller":  # would have to change its volume
        edges = "padded"
    thickness = float(0.1 * 20 ** rng.random())
    width = thickness * 2.5 * 20 ** rng.random()
    length = width * 4 ** (rng.random() if rng.random() < 0.4 else 0.0)
    deep = int(rng.integers(2, 7))
    across = np.sqrt(MOST_ELEMENTS * rng.uniform(0.15, 1.0) / deep)
    # no flatter than 1 : 10, no slenderer than 1 : 1.5
    size = np.clip(np.sqrt(width * length) / across, thickness / deep / 1.5, 10 * thickness / deep)
    case = Case(
        number=number,
        relief=kind,
        holes=bool(rng.random() < 0.25),
        compression=float(rng.uniform(0.03, 0.6 if kind == "sphere" else 0.5)),
        window_friction=_friction(rng),
        sample_friction=_friction(rng),
        bulk_to_shear=float(20 * 5000 ** rng.random()),
        edges=edges,
        uneven=bool(rng.random() < 0.3),
        thickness=thickness,
        element_size=(*(size * rng.uniform(0.8, 1.25, 2)).tolist(), thickness / deep),
        field=(float(width), float(length)),
    )
    while case.elements() > MOST_WITH_EDGES:
        x, y, z = case.element_size
        case = replace(case, element_size=(1.1 * x, 1.1 * y, z))
    return case


def _friction(rng) -> float:
    """None in one of eight, else up to 1, small coefficients more often than large ones."""
    return float(rng.choice([0.0, 1.0], p=[0.125, 0.875]) * rng.random() ** 1.5)


def relief(kind: str, x, y, rng):
    """How much the layer is pressed at (x, y), 0 to about 1; lengths in those of the field."""
    size = np.sqrt(x.max() * y.max())
    pixel = x[0, 1] - x[0, 0]
    if kind == "rough":
        sigma = rng.uniform(0.03, 0.15) * size / pixel
        field = gaussian_filter(rng.standard_normal(x.shape), sigma, mode="reflect")
        return 0.5 + 0.25 * (field - field.mean()) / max(field.std(), 1e-9)
    if kind == "stepped":
        levels = np.floor(3 * (_blobs(x, y, rng) + _plane(x, y, rng))) / 3
        return gaussian_filter(levels - levels.min(), rng.uniform(0.0, 0.03) * size / pixel)
    if kind == "tilted":
        return _plane(x, y, rng)
    if kind == "wave":
        count = rng.uniform(1, 6)
        return 0.5 + 0.5 * np.sin(2 * np.pi * count * _plane(x, y, rng))
    if kind == "flat":
        return np.ones_like(x)
    if kind == "sphere":
        x0, y0 = rng.uniform(0.3, 0.7) * x.max(), rng.uniform(0.3, 0.7) * y.max()
        radius = rng.uniform(0.15, 0.6) * size
        return np.maximum(1 - ((x - x0) ** 2 + (y - y0) ** 2) / radius**2, -0.5)
    if kind == "needles":
        height = np.zeros_like(x)
        for _ in range(int(rng.integers(1, 8))):
            x0, y0 = rng.uniform(0, x.max()), rng.uniform(0, y.max())
            width = rng.uniform(0.02, 0.06) * size
            height = np.maximum(height, np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width**2)))
        return height + 0.1
    if kind == "checkerboard":
        count = rng.integers(2, 6)
        waves = np.sin(np.pi * count * x / x.max()) * np.sin(np.pi * count * y / y.max())
        return 0.5 + 0.5 * np.tanh(waves / rng.uniform(0.1, 0.6))
    return 0.2 + 0.8 * _blobs(x, y, rng)


def _plane(x, y, rng):
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * x + np.sin(angle) * y
    return (along - along.min()) / np.ptp(along)


def _blobs(x, y, rng):
    """Round bumps, 0 to 1."""
    height = np.zeros_like(x)
    for _ in range(int(rng.integers(1, 5))):
        x0, y0 = rng.uniform(0, x.max()), rng.uniform(0, y.max())
        width = rng.uniform(0.08, 0.3) * np.sqrt(x.max() * y.max())
        height = np.maximum(height, np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width**2)))
    return height


@dataclass(frozen=True)
class Outcome:
    """How a case ended: as ``_ended`` says, in a ``ConvergenceError``, or badly."""

    case: Case
    kind: str
    seconds: float
    newton: int = 0
    text: str = ""
    #: At the sample, mN, and what the mesh may be off by, if there is a result.
    force: float | None = None
    mesh_error: float | None = None

    @property
    def allowed(self) -> bool:
        return self.kind in ("converged", NEARLY, *INSTEAD.values(), "ConvergenceError")


class TimeLimit(Exception):
    pass


def attempt(case: Case, solver: str = "auto", limit: int = 120, progress=None) -> Outcome:
    """Solve a case and check what came out."""

    def out_of_time(*_: object) -> None:
        raise TimeLimit

    newton, attrs = 0, dict[str, float]()

    def count(report: Progress) -> None:
        nonlocal newton
        newton = report.newton
        if progress:
            progress(report)

    # processor time of this process, so that others on the machine do not matter
    signal.signal(signal.SIGPROF, out_of_time)
    signal.setitimer(signal.ITIMER_PROF, limit)
    start = time.process_time()
    try:
        result = case.solve(solver, count)
        attrs = result.maps.attrs
        text = "; ".join(faults(result))
        kind = "wrong result" if text else _ended(result)
    except TimeLimit:
        kind, text = "time limit", f"{limit} s"
    except ConvergenceError as error:
        kind, text = "ConvergenceError", str(error)
    except Exception as error:
        kind, text = type(error).__name__, str(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    seconds = time.process_time() - start
    forces = attrs.get("sample_force_mN"), attrs.get("force_mesh_error_mN")
    return Outcome(case, kind, seconds, newton, text, *forces)


def in_increments(case: Case, increment: float, limit: int) -> tuple[Outcome, Outcome | None]:
    """Solve a case as usual and, if it arrives, in small increments, four times as long at most."""
    control = StepControl(min(StepControl.first, increment), increment)
    usual = attempt(case, limit=limit)
    if usual.force is None:
        return usual, None
    with (
        mock.patch.object(cascade, "StepControl", return_value=control),
        mock.patch.object(cascade, "_PATIENCE", 4 * cascade._PATIENCE),
    ):
        return usual, attempt(case, limit=4 * limit)


def increments(cases: list[Case], increment: float, limit: int, jobs: int) -> None:
    """Print how much of the force depends on the increments, map by map."""
    changes = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        solve = partial(in_increments, increment=increment, limit=limit)
        for usual, small in pool.map(solve, cases):
            text = f"map {usual.case.number}: {usual.kind}"
            if small is not None:
                text += f", in small increments {small.kind}"
            if small is not None and small.force:
                change = 100 * (usual.force / small.force - 1)
                error = 100 * (usual.mesh_error or np.nan) / usual.force
                text += f", {change:+.3f} % of the force, error of the mesh {error:.2f} %"
                if usual.kind == small.kind == "converged":
                    changes.append(abs(change))
            print(text, flush=True)
    if changes:
        shares = ", ".join(f"{q} %: {np.percentile(changes, q):.3f}" for q in (50, 95, 100))
        print(f"{len(changes)} that converge: the force differs by ({shares}) %")


def _ended(result: StressResult) -> str:
    """What a result is called in the tables."""
    attrs = result.maps.attrs
    for failure, name in INSTEAD.items():
        if failure in attrs:
            return name
    return NEARLY if attrs["status"] == Status.NEARLY else "converged"


def faults(result: StressResult) -> list[str]:
    """What is wrong with a result that claims to be an equilibrium; nothing should be."""
    layer, problem = result.layer, result.problem
    assert layer is not None
    assert problem is not None
    found = []
    pressure = result.maps["contact_pressure"]
    if not np.isfinite(layer["position"]).all() or not np.isfinite(layer["cauchy_stress"]).all():
        found.append("numbers that are not finite")
    if float(pressure.min()) < -1e-9:
        found.append(f"the sample pulls by {-float(pressure.min()):.2g} kPa")
    if result.maps.attrs["force_balance"] > 1e-3:
        found.append(f"forces differ by {100 * result.maps.attrs['force_balance']:.2g} %")
    x, y, z = np.moveaxis(layer["position"].values, -1, 0)
    height = problem.imprint.evaluate(x[-1], y[-1], 1.0)[0]
    depth = max(float((z[-1] - height).max()), float(-z[0].min()))
    if depth > 0.005 * result.maps.attrs["initial_thickness_mm"]:
        found.append(f"the layer enters a rigid surface by {1000 * depth:.2g} um")
    return found


def tables(outcomes: list[Outcome]) -> str:
    """Counts of how the cases ended, in all and by class of problem."""
    kinds = sorted({o.kind for o in outcomes}, key=lambda k: (k != "converged", k))
    classes = {
        "all": lambda c: "",
        "relief": lambda c: c.relief,
        "holes": lambda c: "yes" if c.holes else "no",
        "edges": lambda c: c.edges,
        "length / thickness": lambda c: _bin(max(c.field) / c.thickness, (10, 20, 50)),
        "compression": lambda c: _bin(c.compression, (0.15, 0.3, 0.4)),
        "greater friction": lambda c: (
            _bin(friction, (0.1, 0.3, 0.6))
            if (friction := max(c.window_friction, c.sample_friction)) > 0
            else "none: may slide"
        ),
        "law": lambda c: c.law().name,
        "K/mu": lambda c: _bin(c.bulk_to_shear, (100, 1000, 10000)),
        "unloaded layer": lambda c: "uneven" if c.uneven else "flat",
    }
    lines = [f"{'':32}{'maps':>6}" + "".join(f"{kind:>18}" for kind in kinds)]
    for name, of in classes.items():
        for value in sorted({of(o.case) for o in outcomes}):
            members = [o for o in outcomes if of(o.case) == value]
            count = Counter(o.kind for o in members)
            lines.append(
                f"{name:17}{value:15}{len(members):6}" + "".join(f"{count[k]:18}" for k in kinds)
            )
    seconds = np.sort([o.seconds for o in outcomes])
    shares = ", ".join(f"{q} %: {np.percentile(seconds, q):.1f}" for q in (10, 50, 90, 99, 100))
    lines.append(f"Seconds of processor time per map ({shares}); {seconds.sum():.0f} in all")
    return "\n".join(lines)


def _bin(value: float, limits: tuple[float, ...]) -> str:
    for limit in limits:
        if value < limit:
            return f"< {limit:g}"
    return f">= {limits[-1]:g}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first map")
    parser.add_argument("--limit", type=int, default=120, help="seconds of processor time per map")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--solver", default="auto", choices=["auto", "multigrid", "direct"])
    parser.add_argument("--increment", type=float, help="of the load, in a second solution")
    parser.add_argument("--press", type=float, default=1.0, help="share of each compression")
    parser.add_argument("--json", type=Path, help="file for the maps that did not converge")
    parser.add_argument("--replay", type=int, help="solve this map alone, in sight")
    arguments = parser.parse_args()

    def pressed(number: int) -> Case:
        case = random_case(number)
        return replace(case, compression=arguments.press * case.compression)

    if arguments.replay is not None:
        case = pressed(arguments.replay)
        print(case)
        outcome = attempt(case, arguments.solver, arguments.limit, print)
        print(
            f"{outcome.kind}, {outcome.seconds:.1f} s, {outcome.newton} iterations {outcome.text}"
        )
        sys.exit(not outcome.allowed)
    attempt(replace(random_case(0), compression=0.01))  # compiles, once for all
    cases = [pressed(arguments.first + n) for n in range(arguments.maps)]
    # one thread each, the libraries' own included, or the maps would stand in each other's way
    os.environ |= {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    if arguments.increment:
        increments(cases, arguments.increment, arguments.limit, arguments.jobs)
        return
    outcomes = []
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(attempt, c, arguments.solver, arguments.limit) for c in cases]
        for future in futures:
            outcomes.append(future.result())
            o = outcomes[-1]
            if o.kind != "converged":
                print(
                    f"map {o.case.number}: {o.kind} after {o.seconds:.1f} s: {o.text}", flush=True
                )
            if arguments.json:
                _write(arguments.json, outcomes)
    print(tables(outcomes))
    sys.exit(not all(o.allowed for o in outcomes))


def _write(path: Path, outcomes: list[Outcome]) -> None:
    failed = [o for o in outcomes if o.kind != "converged"]
    seconds = [round(o.seconds, 2) for o in outcomes]
    record = {
        "maps": len(outcomes),
        "counts": Counter(o.kind for o in outcomes),
        "seconds": seconds,
        "newton": [o.newton for o in outcomes],
        "not_converged": [asdict(o) for o in failed],
    }
    path.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
