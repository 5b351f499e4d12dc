"""Does the true error of the mesh lie within the estimate that each result carries?

    python benchmarks/mesh_error.py             elements of 250 and 125 um
    python benchmarks/mesh_error.py --explicit  the same, imprint smoothed by 0.05 mm on all

Five maps, three pairs of frictions, layers of 2 x 2 x 0.5 mm. The truth is the solution on elements
a quarter as large. For each case: the total force, its true error and the estimate, and the share
of the map's points at which the error of the axial stress lies within its estimate.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.ndimage import gaussian_filter

from optical_palpation.errors import ConvergenceError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import StressResult, computational_stress
from optical_palpation.thickness import thickness_map

FIELD, THICKNESS = 2.0, 0.5  # mm
FRICTION = ((0.15, 0.05), (0.3, 0.1), (0.5, 0.3))  # window, sample
SIZES = (0.25, 0.125)  # mm
LAW = MooneyRivlin(2.23, 0.703)
AXIS = np.linspace(0.0, FIELD, 129)


def reliefs() -> dict[str, np.ndarray]:
    """Loaded thickness, mm."""
    x, y = np.meshgrid(AXIS, AXIS)
    bar = (abs(x - 0.5) < 0.15) & (abs(y - 1.0) < 0.7)
    disc = np.hypot(x - 1.3, y - 1.0) < 0.35
    return {
        "sinusoid": 0.40 + 0.04 * np.cos(2 * np.pi * x) * np.cos(2 * np.pi * y),
        "sphere": np.minimum(0.55, 4.38 - np.sqrt(16 - (x - 0.9) ** 2 - (y - 1.1) ** 2)),
        "steps": gaussian_filter(0.37 + 0.06 * ((x > 0.7) ^ (y > 1.2)), 2),
        "slab": np.full_like(x, 0.38),
        "letters": 0.42 - 0.06 * gaussian_filter((bar | disc).astype(float), 3) - 0.01 * x,
    }


def press(
    relief: np.ndarray, friction: tuple[float, float], size: float, smoothing: float | None
) -> StressResult:
    """Solve one case."""
    return computational_stress(
        thickness_map(relief, x=AXIS, y=AXIS, where="relief"),
        THICKNESS,
        LAW,
        window_friction=friction[0],
        sample_friction=friction[1],
        element_size=size,
        imprint_smoothing=smoothing,
    )


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--explicit", action="store_true", help="imprint smoothed by 0.05 mm")
    smoothing = 0.05 if options.parse_args().explicit else None
    within, points, tight = [], [], []
    print("relief    friction     size  force (mN)  error  estimate  map within")
    for name, relief in reliefs().items():
        for friction in FRICTION:
            for size in SIZES:
                try:
                    result = press(relief, friction, size, smoothing)
                    truth = press(relief, friction, size / 4, smoothing)
                except ConvergenceError as failure:
                    print(f"{name:9} {friction} {size:5.3f}  {str(failure)[:60]}", flush=True)
                    continue
                force, true = (r.maps.attrs["sample_force_mN"] for r in (result, truth))
                estimate = result.maps.attrs.get("force_mesh_error_mN", np.nan)
                here = {axis: result.maps[axis] for axis in "xy"}
                off = abs(result.maps["axial_stress"] - truth.maps["axial_stress"].interp(here))
                bound = result.maps["axial_stress_mesh_error"].where(np.isfinite(off))
                share = float((off <= bound).sum() / np.isfinite(off).sum())
                within.append(abs(force - true) <= estimate)
                tight.append(estimate / abs(force - true))
                points.append(share)
                print(
                    f"{name:9} {friction[0]:.2f} {friction[1]:.2f}  {size:5.3f}  {force:10.2f}  "
                    f"{(force - true) / true:+5.1%}  {estimate / true:7.1%}  {share:9.0%}"
                    f"{'' if within[-1] else '   outside'}",
                    flush=True,
                )
    print(
        f"force: {np.mean(within):.0%} of {len(within)} within the estimate, which is "
        f"{np.median(tight):.2g} times the error (median)\nmaps: {np.mean(points):.0%} of the "
        "points within"
    )


if __name__ == "__main__":
    main()
