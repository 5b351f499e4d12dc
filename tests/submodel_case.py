"""A relief in which submodels and tiles are computed, and how far off they are."""

import numpy as np
import xarray as xr

from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import StressResult, computational_stress

GEL = MooneyRivlin(2.23, 0.703)
SIZE, THICKNESS = 2.4, 0.4


def relief(depth: float = 0.03) -> xr.DataArray:
    """Loaded thickness with waves of several lengths."""
    x = np.linspace(0, SIZE, 97)
    wave = np.sin(7 * x) * np.cos(6 * x)[:, None] + 0.5 * np.cos(11 * x)
    loaded = 0.36 + depth * wave
    return xr.DataArray(loaded, {"y": x, "x": x}, ("y", "x"), attrs={"units": "mm"})


def whole(size: float, window=0.2, sample=0.1, loaded=None, **options) -> StressResult:
    """The whole layer on elements of one size."""
    return computational_stress(
        relief() if loaded is None else loaded,
        THICKNESS,
        GEL,
        window_friction=window,
        sample_friction=sample,
        element_size=size,
        edge_check=False,
        input_errors=None,
        **options,
    )


def error(part: StressResult, reference: StressResult) -> float:
    """Relative difference of the axial stress (root mean square)."""
    ours = part.maps["axial_stress"]
    theirs = reference.maps["axial_stress"].interp(x=ours["x"], y=ours["y"])
    return float(np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean()))
