"""Picture of a stress map with its error: map of the error, profiles with bands, budget."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.present.figure import draw_map, figure_file, letter
from optical_palpation.present.summary import INPUTS
from optical_palpation.present.terms import COMPUTATIONAL, rounded, term


def write_uncertainty_figure(uncertainty: xr.Dataset, path: str | Path) -> None:
    """Draw the result of ``propagate_uncertainty`` (PNG, PDF or SVG by the name's ending).

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    stress, error = uncertainty["axial_stress"], uncertainty["axial_stress_error"]
    aspect = float(
        np.clip(np.ptp(stress["y"].values) / max(np.ptp(stress["x"].values), 1e-12), 0.5, 1.5)
    )
    with figure_file(path, "double", 70.0 + 68.0 * aspect) as figure:
        (top_left, top_right), (left, right) = figure.subplots(2, 2)
        what = term(uncertainty, "axial_stress_error")
        limits = (0.0, float(np.nanpercentile(error, 99)) or 1.0)
        draw_map(top_left, error, what, limits=limits)
        names = [INPUTS.get(str(n), str(n).replace("_", " ")) for n in uncertainty["input"].values]
        top_right.barh(names, uncertainty["force_contribution"], color=COMPUTATIONAL)
        force, spread = uncertainty.attrs["force_mN"], uncertainty.attrs["force_error_mN"]
        top_right.set_title(f"Total force {rounded(force, spread)} mN", loc="left")
        top_right.set_xlabel("contribution to its error (mN)")
        for axes, axis, across in ((left, "x", "y"), (right, "y", "x")):
            middle = {across: stress.sizes[across] // 2}
            line, band = stress.isel(middle), error.isel(middle)
            low, high = line - band, line + band
            axes.fill_between(line[axis], low, high, color=COMPUTATIONAL, alpha=0.25, lw=0)
            axes.plot(line[axis], line, color=COMPUTATIONAL)
            at = float(stress[across][middle[across]])
            axes.set_title(f"{across} = {at:.3g} mm", loc="left")
            axes.set(xlabel=f"{axis} (mm)", ylabel="axial stress (kPa)")
            axes.grid()
        right.sharey(left)
        right.autoscale(axis="y")
        letter([top_left, top_right, left, right])
