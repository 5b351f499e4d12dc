"""Force of a layer that sticks to both faces, by the number of elements through its depth.

    python benchmarks/stuck_layer.py [--strain 0.1] [--deep 2 4 8] [--lateral 0.125]

A flat layer of 3 x 3 x 0.5 mm (C10 2.23 kPa, C01 0.703 kPa, sides free, both faces glued) is
compressed, with straight and with curved sides of its elements; on one thread.
"""

from __future__ import annotations

import argparse
import time

import numba as nb
import numpy as np

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.cascade import solve
from optical_palpation.mechanics.grid import (
    LayerGrid,
    edge_width,
    graded_depths,
    node_positions,
)
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import LayerProblem

LAW = MooneyRivlin(2.23, 0.703)
WIDTH, THICKNESS = 3.0, 0.5


def flat_layer(deep: int, lateral: float, strain: float, curved: bool) -> LayerProblem:
    """Return the layer, ``deep`` elements through its depth, pressed by ``strain``."""
    depth = graded_depths(deep)
    x = node_positions(WIDTH, lateral, edge=edge_width(depth, THICKNESS))
    pixels, flat = np.linspace(-1, WIDTH + 1, 9), np.full((9, 9), THICKNESS)
    return LayerProblem(
        LayerGrid(x, x, depth, np.full((len(x), len(x)), THICKNESS)),
        Imprint(pixels, pixels, flat, (1 - strain) * flat),
        LAW,
        (0.0, 0.0),
        curved_sides=curved,
        glued=(True, True),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--strain", type=float, default=0.1)
    parser.add_argument("--deep", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--lateral", type=float, default=0.125, help="element size, mm")
    chosen = parser.parse_args()
    nb.set_num_threads(1)

    def guess(level: LayerProblem) -> np.ndarray:
        pressure = 10 * chosen.strain * LAW.shear_modulus
        return pressure * level.grid.areas

    for curved in (False, True):  # compiled before anything is timed
        solve(flat_layer(2, 0.3, 0.01, curved), guess)
    print("deep  elements  sides      force, mN  seconds  Newton iterations")
    for deep in chosen.deep:
        for curved in (False, True):
            problem = flat_layer(deep, chosen.lateral, chosen.strain, curved)
            start = time.perf_counter()
            solution = solve(problem, guess)
            seconds = time.perf_counter() - start
            force = solution.state.normal_force[1].sum()
            print(
                f"{deep:4}  {problem.grid.n_elements:8}  {'curved' if curved else 'straight':8}  "
                f"{force:10.2f}  {seconds:7.2f}  {solution.newton_iterations}"
            )


if __name__ == "__main__":
    main()
