"""A layer under a tilted plate, with narrow elements at its free edges."""

import numpy as np
import xarray as xr

from optical_palpation.material import MooneyRivlin
from optical_palpation.mechanics.problem import LayerProblem
from optical_palpation.palpation.meshing import expected_forces, layer_problem
from optical_palpation.thickness import thickness_map

SILICONE = MooneyRivlin(2.23, 0.703)
AXIS = np.linspace(0, 2, 41)
SIZE, DEPTH = 0.25, 0.1
HELD = {"window": 0.3, "sample": 0.3}
#: How ``computational_stress`` is asked for it.
GIVEN = {
    "window_friction": HELD["window"],
    "sample_friction": HELD["sample"],
    "element_size": (SIZE, SIZE, DEPTH),
}


def tilted() -> xr.DataArray:
    """Loaded thickness; unloaded it is 0.5 mm everywhere."""
    heights = np.tile(0.5 - 0.15 * AXIS / 2, (41, 1))
    return thickness_map(heights, x=AXIS, y=AXIS, where="tilted plate")


def problem(edges="free", size=SIZE, depth=DEPTH) -> LayerProblem:
    loaded = tilted()
    unloaded = loaded.copy(data=np.full(loaded.shape, 0.5))
    sizes = size, size, depth
    return layer_problem(loaded, unloaded, None, SILICONE, HELD, sizes, edges, size / 2, 0.001)


def bound(level: LayerProblem) -> np.ndarray:
    """The contact forces that ``cascade.solve`` begins with."""
    return expected_forces(level, SILICONE)
