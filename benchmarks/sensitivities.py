"""Derivatives by the inputs against differences of solutions from scratch, and what they cost.

    python benchmarks/sensitivities.py                  elements of 125 um
    python benchmarks/sensitivities.py --element-size 0.05

A wave and steps on a layer of 3 x 3 x 0.5 mm, friction 0.1, 0.3 and 0.4 at the window, 0.05 at the
sample. Of the maps of the stress the root mean square difference is shown, over that of the
derivative. Times are processor time. Of the coin, 5 x 5 mm, only the cost is shown.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

import performance
from optical_palpation.errors import ConvergenceError
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import InputErrors, StressResult, computational_stress
from optical_palpation.thickness import thickness_map

LAW = MooneyRivlin(2.23, 0.703)
AXIS = np.linspace(0.0, 3.0, 151)
STEPS = {
    "window_friction": 0.02,
    "sample_friction": 0.02,
    "thickness": 0.002,
    "initial_thickness": 0.002,
}


def reliefs() -> dict[str, xr.DataArray]:
    """Loaded thickness, mm."""
    x, y = np.meshgrid(AXIS, AXIS)
    heights = {
        "wave": 0.41 + 0.05 * np.cos(0.8 * np.pi * x) * np.cos(0.8 * np.pi * y),
        "steps": gaussian_filter(0.37 + 0.08 * ((x > 1.3) ^ (y > 2.2)), 2),
    }
    made = {name: thickness_map(z, x=AXIS, y=AXIS, where=name) for name, z in heights.items()}
    return made | {"coin": performance.loaded_thickness(performance.FIELD)}


def press(
    relief: xr.DataArray, size: float, given: dict[str, float], errors: InputErrors | None
) -> tuple[StressResult, float]:
    """Return the solution and its processor time."""
    start = time.process_time()
    result = computational_stress(
        relief + given["thickness"],
        given["initial_thickness"],
        LAW,
        window_friction=given["window_friction"],
        sample_friction=given["sample_friction"],
        element_size=size,
        edge_check=False,
        input_errors=errors,
    )
    return result, time.process_time() - start


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--element-size", type=float, default=0.125, help="mm")
    size = options.parse_args().element_size
    for name, relief in reliefs().items():
        for friction in (0.1, 0.3, 0.4):
            given = {
                "window_friction": friction,
                "sample_friction": 0.05,
                "thickness": 0.0,
                "initial_thickness": 0.5,
            }
            press(relief, size, given, InputErrors())  # compiles
            _, alone = press(relief, size, given, None)
            result, with_bands = press(relief, size, given, InputErrors())
            print(
                f"{name}, friction {friction}: solution {alone:.2f} s, sensitivities "
                f"{with_bands - alone:.2f} s ({(with_bands - alone) / alone:.0%})",
                flush=True,
            )
            if name == "coin":
                continue
            for key, step in STEPS.items():
                try:
                    up, down = (
                        press(relief, size, given | {key: given[key] + s * step}, None)[0]
                        for s in (1, -1)
                    )
                except ConvergenceError as failure:
                    print(f"  {key}: {str(failure)[:70]}", flush=True)
                    continue
                forces = [r.maps.attrs["sample_force_mN"] for r in (up, down)]
                by_force = (forces[0] - forces[1]) / (2 * step)
                if key not in result.sensitivities["input"]:
                    print(f"  {key}: {result.sensitivities.attrs['failure']}", flush=True)
                    continue
                of_input = result.sensitivities.sel(input=key)
                mine = float(of_input["force"])
                above, below = (r.maps["axial_stress"] for r in (up, down))
                by_stress = (above - below) / (2 * step)
                off = of_input["axial_stress"] - by_stress
                share = float(np.sqrt((off**2).mean() / (by_stress**2).mean()))
                print(
                    f"  {key}: {mine:.4g} mN per unit, by differences {by_force:.4g} "
                    f"({mine / by_force - 1:+.1%}); map {share:.0%} off",
                    flush=True,
                )


if __name__ == "__main__":
    main()
