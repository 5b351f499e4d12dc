"""Picture of a friction estimate: calibration curves and the measured profile (figure 2a)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from optical_palpation.friction.estimate import FrictionEstimate
from optical_palpation.present.figure import colour_map, figure_file
from optical_palpation.present.terms import ALGEBRAIC

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_friction_figure(
    calibration: xr.DataArray, path: str | Path, estimate: FrictionEstimate | None = None
) -> None:
    """Draw calibration curves and, if given, a measured profile (PNG, PDF or SVG).

    Parameters
    ----------
    calibration
        Normalised displacement over ``friction`` and ``depth``.
    path
        The picture.
    estimate
        Estimate whose profile is drawn, with standard errors, and whose deviation from the
        fitted curve is drawn below.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with figure_file(path, 120.0, 95.0 if estimate is None else 120.0) as figure:
        _draw(figure, calibration, estimate)


def _draw(figure: Figure, calibration: xr.DataArray, estimate: FrictionEstimate | None) -> None:
    if estimate is None:
        top, bottom = figure.subplots(), None
    else:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    friction = calibration["friction"].values
    # The palest end of the map would not show on white.
    shades = colour_map("viridis_r")(np.linspace(0.15, 1.0, friction.size))
    for mu, shade in zip(friction, shades, strict=True):
        curve = calibration.sel(friction=mu)
        top.plot(curve["depth"], curve, color=shade, lw=1.2, label=f"friction {mu:.3g}")
    top.plot([0, 1], [0, 1], color="0.5", lw=1.0, ls="--", label="even strain")
    if estimate is not None and bottom is not None:
        profile = estimate.profile
        deviation = profile["measured"] - profile["fitted"]
        error = profile.get("standard_error")
        marks: dict[str, Any] = {"color": ALGEBRAIC, "fmt": ".", "ms": 3, "elinewidth": 0.6}
        low, high = estimate.interval
        bound = ", at the limit of the calibration" if estimate.at_limit else ""
        top.errorbar(profile["depth"], profile["measured"], yerr=error, label="measured", **marks)
        top.plot(
            profile["depth"],
            profile["fitted"],
            color="black",
            lw=1.2,
            label=f"fit: {estimate.coefficient:.3f} (95 %: {low:.3f} to {high:.3f}){bound}",
        )
        bottom.errorbar(profile["depth"], deviation, yerr=error, **marks)
        bottom.axhline(0.0, color="0.5", lw=0.8)
        bottom.set(ylabel="measured − fit")
        bottom.grid()
    top.set(ylabel="incremental displacement / that at the sample", xlim=(0, 1))
    (top if bottom is None else bottom).set(xlabel="depth in the layer (0: window, 1: sample)")
    top.grid()
    top.legend()
