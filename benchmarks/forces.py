"""The forces by which the pages compare what can be chosen: friction, edges, elements, K/mu.

    python benchmarks/forces.py                       all of them, some minutes
    python benchmarks/forces.py --only sinusoid

sinusoid  that of docs/method.md, 5 x 5 x 0.5 mm, friction 0.3 and 0.05, 125 um, unless given;
          it is smooth, so that its imprint is not smoothed
          (../shared/data/layers/sinusoid_simulated_L1.npz)
coin      the measured map of a coin, 5 x 5 x 0.5 mm, friction 0.15 and 0.05, 125 um, unless given
          (../shared/data/layers/coin_5c_1-thickness.mat)

Forces of the sample in mN, by the defaults of the software but for the estimates of errors.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import xarray as xr

from convergence import sinusoid
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from performance import loaded_thickness

VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "sinusoid": {
        "as above": {},
        "8 elements deep": {"element_size": (0.125, 0.125, 0.0625)},
        "50 um, 10 deep": {"element_size": 0.05},
        "friction at the sample 0": {"sample_friction": 0.0},
        "friction at the sample 0.1": {"sample_friction": 0.1},
        "friction at the window 0.25": {"window_friction": 0.25},
        "K/mu 100": {"bulk_to_shear": 100.0},
        "K/mu 20": {"bulk_to_shear": 20.0},
    },
    "coin": {
        "as above": {},
        "8 elements deep": {"element_size": (0.125, 0.125, 0.0625)},
        "83 um, 6 deep": {"element_size": 0.5 / 6},
        "50 um, 10 deep": {"element_size": 0.05},
        "padded": {"edges": "padded"},
        "roller": {"edges": "roller"},
    },
}
COMMON: dict[str, dict[str, Any]] = {
    "sinusoid": {"window_friction": 0.3, "sample_friction": 0.05, "imprint_smoothing": 0.0},
    "coin": {"window_friction": 0.15, "sample_friction": 0.05},
}


def force(name: str, loaded: xr.DataArray, changed: dict[str, Any]) -> tuple[float, float]:
    """Force of the sample, all of it and that within the field of view, mN."""
    given = {"element_size": 0.125, **COMMON[name], **changed}
    law = MooneyRivlin(2.23, 0.703, given.pop("bulk_to_shear", 1e4))
    maps = computational_stress(
        loaded, 0.5, law, threads=1, edge_check=False, input_errors=None, **given
    ).maps
    seen = -float(np.trapezoid(np.trapezoid(maps["axial_stress"], maps["x"]), maps["y"]))
    return maps.attrs["sample_force_mN"], seen


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=VARIANTS)
    chosen = parser.parse_args()
    for name in [chosen.only] if chosen.only else VARIANTS:
        loaded = sinusoid() if name == "sinusoid" else loaded_thickness(5.0)
        for what, changed in VARIANTS[name].items():
            total, seen = force(name, loaded, changed)
            text = f"{name:9} {what:28} {total:12.1f}"
            print(text + (f"  ({seen:.0f} in view)" if what == "padded" else ""), flush=True)


if __name__ == "__main__":
    main()
