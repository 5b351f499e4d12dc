"""Time and force of a sphere that is pressed deep into a wide layer of gel.

    python benchmarks/sphere_in_gel.py [--friction 0.6 1 1.5] [--threads 1] [--increment 0.02]

A sphere of radius 7.5 mm is pressed 2 mm into 20 x 25 x 4 mm (C10 2.23 kPa, C01 0.703 kPa, sides
free, friction 2 at the window), on elements of 0.5 mm. Where friction, on its way, follows the
contact forces within Newton's method alone, such a layer does not get to its load in increments of
15 %. ``--increment`` follows it in smaller ones, with friction bounded to 0.2 %.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from unittest import mock

import numpy as np

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics import cascade, path
from optical_palpation.palpation import StressResult, computational_stress
from optical_palpation.thickness import thickness_map

WIDTH, LENGTH, THICKNESS, RADIUS, PRESSED = 20.0, 25.0, 4.0, 7.5, 2.0


def pressed(friction: float, size: float, threads: int) -> StressResult:
    """Solve with a friction coefficient at the sphere and an element size, mm."""
    x, y = np.linspace(0, WIDTH, 201), np.linspace(0, LENGTH, 251)
    apart = np.hypot(x - WIDTH / 2, y[:, None] - LENGTH / 2)
    sphere = RADIUS - np.sqrt(np.maximum(RADIUS**2 - apart**2, 0.0))
    return computational_stress(
        thickness_map(THICKNESS - PRESSED + sphere, x=x, y=y, where="sphere"),
        THICKNESS,
        MooneyRivlin(2.23, 0.703),
        window_friction=2.0,
        sample_friction=friction,
        element_size=size,
        threads=threads,
        edge_check=False,  # the solution alone
        input_errors=None,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--friction", type=float, nargs="+", default=[0.6, 1.0, 1.5])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--increment", type=float, help="of the load")
    chosen = parser.parse_args()
    if given := chosen.increment:
        control = partial(path.StepControl, first=given, largest=given)
        mock.patch.object(cascade, "StepControl", control).start()
        mock.patch.multiple(path, _APART=0.002, _ROUNDS=32).start()
    pressed(1.0, 4.0, chosen.threads)  # compiled before anything is timed
    for friction in chosen.friction:
        start = time.perf_counter()
        result = pressed(friction, 0.5, chosen.threads)
        seconds = time.perf_counter() - start
        attrs = result.maps.attrs
        print(
            f"friction {friction}: {result.problem.grid.n_elements} elements, {seconds:.1f} s, "
            f"{attrs['newton_iterations']} Newton iterations, {attrs['sample_force_mN']:.1f} mN, "
            f"{attrs['status']}",
            flush=True,
        )


if __name__ == "__main__":
    main()
