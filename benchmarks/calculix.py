"""CalculiX on the same problem, beside the solver of this project.

    python benchmarks/calculix.py ../shared/data/layers/sinusoid_simulated_L1.npz

runs the sinusoid imprint with 20 x 20 x 2 quadratic elements in CalculiX and prints its time and
total force. CalculiX is the Debian package calculix-ccx.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optical_palpation.errors import InputError
from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.grid import LayerGrid, graded_depths, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.present.deck import DeckResult, read_deck_result, write_deck


@dataclass(frozen=True)
class CalculixResult:
    """How a CalculiX run ended.

    ``force_window`` and ``force_imprint`` are the total axial forces that press the layer, mN,
    both positive; NaN, and ``fields`` None, when the run did not converge.
    """

    force_window: float
    force_imprint: float
    seconds: float
    converged: bool
    fields: DeckResult | None = None


def calculix_installed() -> bool:
    return shutil.which("ccx") is not None


def run_calculix(
    problem: LayerProblem,
    directory: str | Path,
    time_limit: float,
    *,
    threads: int | None = None,
    **deck: object,
) -> CalculixResult:
    """Write the deck in ``directory``, run CalculiX on it for at most ``time_limit`` seconds.

    The time is that of CalculiX alone, wall clock, on all cores unless ``threads`` says otherwise.
    Further keywords go to ``write_deck``; what CalculiX said is left in ``layer.log``.
    """
    directory = Path(directory)
    write_deck(problem, directory / "layer.inp", **deck)
    environment = os.environ | {"OMP_NUM_THREADS": str(threads or os.cpu_count())}
    start = time.perf_counter()
    with (directory / "layer.log").open("w") as log:
        try:
            subprocess.run(
                ["ccx", "-i", "layer"],
                cwd=directory,
                env=environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                timeout=time_limit,
                check=True,
            )
        except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
            return CalculixResult(np.nan, np.nan, time.perf_counter() - start, converged=False)
    seconds = time.perf_counter() - start
    try:
        fields = read_deck_result(directory / "layer.dat", problem.grid.shape)
    except InputError:
        return CalculixResult(np.nan, np.nan, seconds, converged=False)
    return CalculixResult(
        float(fields.window_force[2]), float(-fields.imprint_force[2]), seconds, True, fields
    )


def sinusoid(
    path: str | Path,
    lateral: int,
    deep: int,
    bulk_to_shear: float = 100.0,
    edge: float | None = None,
) -> LayerProblem:
    """Return the problem of the sinusoid imprint: 5 x 5 x 0.5 mm, free edges, friction 0.3, 0.05.

    ``lateral`` and ``deep`` are numbers of elements. The default K/mu is as much as CalculiX bears.
    ``edge`` is the width, mm, of the outermost elements, from which widths double inwards.
    """
    with np.load(path) as data:
        x, y, loaded = data["x_mm"], data["y_mm"], data["L1_mm"]
        thickness = float(data["L0_mm"])
    nodes = node_positions(5.0, 5.0 / lateral, edge=edge)
    grid = LayerGrid(nodes, nodes, graded_depths(deep), np.full((nodes.size,) * 2, thickness))
    imprint = Imprint(x, y, np.full_like(loaded, thickness), loaded)
    c10, c01 = 2.23, 0.703
    return LayerProblem(grid, imprint, MooneyRivlin(c10, c01, bulk_to_shear), friction=(0.3, 0.05))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("imprint", type=Path, help="sinusoid_simulated_L1.npz")
    parser.add_argument("--elements", type=int, nargs=2, default=(20, 2), help="lateral, deep")
    parser.add_argument("--edge", type=float, help="width of the outermost elements, mm")
    parser.add_argument("--type", default="C3D20R", help="element type")
    parser.add_argument("--time-limit", type=float, default=1800.0, help="seconds")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    problem = sinusoid(arguments.imprint, *arguments.elements, edge=arguments.edge)
    with tempfile.TemporaryDirectory() as directory:
        result = run_calculix(
            problem,
            directory,
            arguments.time_limit,
            threads=arguments.threads,
            element=arguments.type,
        )
    print(
        f"CalculiX {arguments.type}: {problem.grid.n_elements} elements, K/mu 100, "
        f"{arguments.threads} thread(s): "
        + (
            f"{result.seconds:.0f} s, {result.force_window:.1f} mN at the window, "
            f"{result.force_imprint:.1f} mN at the imprint"
            if result.converged
            else f"no solution in {result.seconds:.0f} s"
        )
    )


if __name__ == "__main__":
    main()
