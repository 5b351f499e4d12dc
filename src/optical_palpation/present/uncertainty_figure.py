"""Picture of a stress map with its error: map of the error, profiles with bands, budget."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.present.output import atomic


def write_uncertainty_figure(uncertainty: xr.Dataset, path: str | Path) -> None:
    """Draw the result of ``propagate_uncertainty`` (PNG, PDF or SVG by the name's ending).

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    stress, error = uncertainty["axial_stress"], uncertainty["axial_stress_error"]
    figure = Figure(figsize=(10.5, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    (top_left, top_right), (left, right) = figure.subplots(2, 2)
    x, y = stress["x"].values, stress["y"].values
    half_x, half_y = (x[-1] - x[0]) / (x.size - 1) / 2, (y[-1] - y[0]) / (y.size - 1) / 2
    image = top_left.imshow(
        error.transpose("y", "x"),
        origin="lower",
        extent=(x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y),
        cmap="magma",
        vmin=0.0,
        vmax=float(np.nanpercentile(error, 99)),
        interpolation="nearest",
    )
    figure.colorbar(image, ax=top_left, extend="max", shrink=0.85)
    top_left.set(title="Error of the axial stress (kPa)", xlabel="x (mm)", ylabel="y (mm)")

    names = [str(name) for name in uncertainty["input"].values]
    top_right.barh(names, uncertainty["force_contribution"], color="#0072B2")
    force, spread = uncertainty.attrs["force_mN"], uncertainty.attrs["force_error_mN"]
    top_right.set(
        title=f"Total force {force:.4g} ± {spread:.2g} mN", xlabel="contribution to its error (mN)"
    )
    for axes, axis, across in ((left, "x", "y"), (right, "y", "x")):
        middle = {across: stress.sizes[across] // 2}
        line, band = stress.isel(middle), error.isel(middle)
        axes.fill_between(line[axis], line - band, line + band, color="#0072B2", alpha=0.3, lw=0)
        axes.plot(line[axis], line, color="#0072B2", lw=1.3)
        at = float(stress[across][middle[across]])
        axes.set(
            title=f"Along {axis} at {across} = {at:.3g} mm",
            xlabel=f"{axis} (mm)",
            ylabel="axial stress (kPa)",
        )
        axes.grid(alpha=0.3)
    with atomic(path, "picture") as temporary:
        figure.savefig(temporary, dpi=150)
