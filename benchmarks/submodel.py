"""Regions of a map like that of a coin on fine elements, against the whole on such elements.

    python benchmarks/submodel.py [--coarse 0.0625] [--fine 0.025] [--margin 0.25]

Prints the relative difference of the axial stress (root mean square) of region and whole, that of
the coarse solution, what the result itself says of its sides, and the processor time.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from convergence import coin
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import StressResult, computational_stress, submodel_stress

LAW = MooneyRivlin(2.23, 0.703)
REGIONS = ((1.5, 2.5, 2.0, 3.0), (2.0, 2.75, 1.0, 1.75), (3.5, 4.25, 3.5, 4.25), (4.25, 5, 0, 0.75))


def error(result: StressResult, region: tuple[float, ...], reference: StressResult) -> float:
    """Relative difference of the axial stress in a region, at the points of the reference."""
    x0, x1, y0, y1 = region
    theirs = reference.maps["axial_stress"].sel(x=slice(x0, x1), y=slice(y0, y1))
    ours = result.maps["axial_stress"].interp(x=theirs["x"], y=theirs["y"])
    return float(np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--coarse", type=float, default=0.0625, help="element size, mm")
    parser.add_argument("--fine", type=float, default=0.025, help="element size, mm")
    parser.add_argument("--margin", type=float, help="mm; half of the thickness by default")
    chosen = parser.parse_args()
    loaded = coin()
    solved, seconds = {}, {}
    for size in (0.25, chosen.coarse, chosen.fine):  # the first one compiles
        start = time.process_time()
        solved[size] = computational_stress(
            loaded,
            0.5,
            LAW,
            window_friction=0.15,
            sample_friction=0.05,
            element_size=size,
            threads=1,
            edge_check=False,
        )
        seconds[size] = time.process_time() - start
    coarse, fine = solved[chosen.coarse], solved[chosen.fine]
    print(f"whole: {seconds[chosen.coarse]:.1f} s coarse, {seconds[chosen.fine]:.1f} s fine")
    print(
        "region, mm                 elements  error, %  coarse, %  sides, %  seconds  of the whole"
    )
    for region in REGIONS:
        start = time.process_time()
        part = submodel_stress(
            coarse, loaded, 0.5, region, element_size=chosen.fine, margin=chosen.margin, threads=1
        )
        taken = time.process_time() - start
        print(
            f"{', '.join(f'{edge:g}' for edge in region):25}  {np.prod(part.maps.elements):8}  "
            f"{100 * error(part, region, fine):8.2f}  {100 * error(coarse, region, fine):9.2f}  "
            f"{100 * part.maps.submodel_sides_error:8.2f}  {taken:7.1f}  "
            f"{taken / seconds[chosen.fine]:.1%}"
        )


if __name__ == "__main__":
    main()
