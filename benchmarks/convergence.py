"""Total force against the size of the elements, and against the slip length of the friction law.

    python benchmarks/convergence.py                            125, 62.5 and 31.25 um
    python benchmarks/convergence.py --cases slab --sizes 0.25 0.125 0.0625
    python benchmarks/convergence.py --slip-lengths 4 2 1 0.5   in um, at 125 um
    python benchmarks/convergence.py --strips                   125 to 15.625 um, some minutes

Each halving of the elements is followed by the observed order, log2 of the ratio of two changes of
the force, and the limit that Richardson's extrapolation gives with it. The imprint is the same on
all meshes: it is smoothed by half of the largest element, or not at all.

sinusoid  that of docs/method.md, 5 x 5 x 0.5 mm, friction 0.3 and 0.05
          (../shared/data/layers/sinusoid_simulated_L1.npz)
slab      flat, 5 x 5 x 0.477 mm, compressed by 42 %, friction 0.12 and 0.05
coin      a map like that of a coin, friction 0.15 and 0.05
stuck     flat, 3 x 3 x 0.5 mm, compressed by 10 %, glued on both faces

Strips are those of the verification page, half a layer in plane strain loaded in steps of 4 %, in
mN/mm. Force and limit are followed by how far they are from the force of NGSolve, whose mesh
resolves the free side, and the last line of each says how far off that may be itself.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.errors import ConvergenceError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.reproduce.verification.layers import error
from optical_palpation.reproduce.verification.strips import (
    TITLES,
    read_reference,
    solve_strip,
    strip_force,
)
from optical_palpation.thickness import thickness_map
from performance import SINUSOID, made_coin
from performance_probe import Probe

LAW = MooneyRivlin(2.23, 0.703)
REFERENCES = Path(__file__).parents[1] / "tests" / "data" / "references"


@dataclass(frozen=True)
class Case:
    """Loaded and unloaded thickness, mm, and arguments of ``computational_stress``."""

    loaded: Callable[[], xr.DataArray]
    unloaded: float
    arguments: dict[str, Any]


def flat(width: float, thickness: float) -> xr.DataArray:
    axis = np.linspace(0, width, 41)
    return thickness_map(np.full((41, 41), thickness), x=axis, y=axis, where="flat map")


def coin() -> xr.DataArray:
    axis = np.linspace(0, 5, 501)
    return thickness_map(made_coin(axis), x=axis, y=axis, where="made coin")


def sinusoid() -> xr.DataArray:
    with np.load(SINUSOID) as data:
        values, x, y = data["L1_mm"], data["x_mm"], data["y_mm"]
    loaded = thickness_map(values, x=x, y=y, where=SINUSOID.name)
    return loaded.assign_attrs(layer_extent=[0.0, 5.0, 0.0, 5.0])


def friction(window: float | str, sample: float | str, **other: Any) -> dict[str, Any]:
    return {"window_friction": window, "sample_friction": sample, **other}


CASES = {
    "sinusoid": Case(sinusoid, 0.5, friction(0.3, 0.05, imprint_smoothing=0.0)),
    "slab": Case(lambda: flat(5.0, 0.4769376 - 0.1997982), 0.4769376, friction(0.12, 0.05)),
    "coin": Case(coin, 0.5, friction(0.15, 0.05, imprint_smoothing=0.0625)),
    "stuck": Case(lambda: flat(3.0, 0.45), 0.5, friction("glued", "glued")),
}


def solve(case: Case, size: float, slip_length: float | None = None) -> dict[str, Any]:
    """Return force (mN), its part on the sides, iterations and processor time (s)."""
    start = time.process_time()
    with Probe() as probe:
        result = computational_stress(
            case.loaded(),
            case.unloaded,
            LAW,
            element_size=size,
            slip_length=slip_length,
            threads=1,
            edge_check=False,
            **case.arguments,
        )
    about = result.maps.attrs
    return {
        "force": about["sample_force_mN"],
        "sides": about["sides_force_share"],
        "newton": about["newton_iterations"],
        "krylov": probe.krylov,
        "seconds": time.process_time() - start,
    }


def richardson(forces: list[float]) -> tuple[float, float]:
    """Observed order and limit from three meshes, each of half the size of the one before."""
    coarse, fine = forces[-2] - forces[-3], forces[-1] - forces[-2]
    ratio = coarse / fine if fine else np.inf
    order = float(np.log2(ratio)) if ratio > 0 else np.nan
    return order, forces[-1] + fine / (ratio - 1) if ratio > 1 else np.nan


def refine(
    row: str,
    sizes: list[float],
    solved: Callable[[float], tuple[float, str]],
    told: Callable[[float], str],
) -> None:
    """Print what each mesh gives.

    ``row`` is formatted with the size of the elements, um; ``solved`` returns the force and the
    other columns, ``told`` what is said of a limit.
    """
    forces: list[float] = []
    for size in sizes:
        text = row.format(1e3 * size)
        try:
            force, columns = solved(size)
        except ConvergenceError as failure:
            print(f"{text}  {failure}", flush=True)
            break
        forces.append(force)
        text += columns
        if len(forces) > 2:
            order, limit = richardson(forces)
            text += f"  {order:5.2f}  {'none' if np.isnan(limit) else told(limit)}"
        print(text, flush=True)


def case(name: str, sizes: list[float], slip: float) -> None:
    """Print the forces of a case, mN; the slip length in mm."""

    def solved(size: float) -> tuple[float, str]:
        it = solve(CASES[name], size, slip)
        return it["force"], (
            f"  {it['force']:9.2f}  {100 * it['sides']:8.2f}  {it['newton']:6}"
            f"  {it['krylov']:6}  {it['seconds']:7.1f}"
        )

    refine(f"{name:9} {{:8.5g}}  {1e3 * slip:8.3g}", sizes, solved, "{:.2f}".format)


def strip(name: str, sizes: list[float]) -> None:
    """Print the forces of a layer in plane strain, mN/mm, and that of NGSolve."""
    reference = read_reference(REFERENCES / f"{name}.json")

    def told(force: float) -> str:
        return f"{force:.4g} ({error(force, reference.force)})"

    def solved(size: float) -> tuple[float, str]:
        start = time.perf_counter()
        solution = solve_strip(reference, size)
        seconds, force = time.perf_counter() - start, strip_force(solution)
        return force, f"  {told(force):>16}  {solution.newton_iterations:6}  {seconds:7.1f}"

    refine(f"{name:9} {{:8.5g}}", sizes, solved, told)
    print(f"{name:9}  NGSolve  {reference.force:9.4g} +- {reference.error:.2%}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--sizes", nargs="+", type=float, help="mm, each half of the one before")
    parser.add_argument("--slip-lengths", nargs="+", type=float, help="um")
    parser.add_argument("--strips", nargs="*", choices=TITLES, help="in plane strain; all if none")
    chosen = parser.parse_args()
    if chosen.strips is not None:
        print("strip     size, um      force, mN/mm  Newton  seconds  order  limit")
        for name in chosen.strips or TITLES:
            strip(name, chosen.sizes or [0.125, 0.0625, 0.03125, 0.015625])
        return
    sizes = chosen.sizes or ([0.125] if chosen.slip_lengths else [0.125, 0.0625, 0.03125])
    solve(CASES["stuck"], 0.25)  # compiles
    print(
        "case      size, um  slip, um  force, mN  sides, %  Newton  Krylov  seconds  order  limit"
    )
    for name in chosen.cases:
        for slip in chosen.slip_lengths or [2.0 * CASES[name].unloaded]:
            case(name, sizes, 1e-3 * slip)


if __name__ == "__main__":
    main()
