"""Tables: regions of interest, as CSV and as words; results, a row for each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import area_mean, on_layer
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.output import atomic
from optical_palpation.present.summary import (
    force_error,
    mean_stress_error,
    methods,
    touching_share,
    without_inputs,
)
from optical_palpation.present.terms import percent, plain, rounded


def write_table(table: xr.Dataset, path: str | Path) -> None:
    """Write the statistics of regions as CSV; the names of columns end in their units.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    frame = table.to_dataframe().reset_index()
    units = {str(n): str(v.attrs.get("units", "1")) for n, v in table.data_vars.items()}
    named = {n: f"{n}_{u}" for n, u in units.items() if u not in ("1", "")}
    with atomic(path, "table") as temporary, temporary.open("w", newline="") as file:
        file.write(f"# {table.attrs['long_name']}\n")
        for key in ("background_mean", "background_noise"):
            if key in table.attrs:
                file.write(f"# {key}: {table.attrs[key]:.6g} {units['mean']}\n")
        frame.rename(columns=named).to_csv(file, index=False, float_format="%.6g")


def table_in_words(table: xr.Dataset) -> str:
    """Return the statistics of regions, a line for each."""
    units = table["mean"].attrs.get("units", "")
    lines = [str(table.attrs["long_name"])]
    for name in table["region"].values:
        row = table.sel(region=name)
        spread = _said(row, "standard_deviation")
        parts = [f"mean {_said(row, 'mean')} {units} (standard deviation {spread})"]
        parts.append(f"{_said(row, 'minimum')} to {_said(row, 'maximum')} {units}")
        if "force" in row:
            parts.append(f"force {_said(row, 'force')} mN")
        parts.append(f"area {_said(row, 'area')} mm2")
        if "contrast" in row:
            parts.append(f"contrast {float(row['contrast']):.3g}")
        if (missing := float(row["missing"])) > 1e-6:  # more than rounding leaves
            parts.append(f"{percent(missing)} of it has no value")
        lines.append(f"  {name}: {', '.join(parts)}")
    return "\n".join(lines)


# Numbers in the unit of the map without an error of their own: no more digits than the mean has.
_LIKE_MEAN = ("minimum", "maximum", "standard_deviation", "difference")


def region_figure(row: xr.Dataset, name: str) -> str:
    """A number of one region to the digits that its error leaves, with that error where known."""
    own = row.get(f"{name}_error")
    if own is not None:
        return rounded(row[name], own)
    error = row.get("mean_error") if name in _LIKE_MEAN else None
    return rounded(row[name], error).partition(" ")[0]


def _said(row: xr.Dataset, name: str) -> str:
    return plain(region_figure(row, name))


def result_columns(result: StressResult) -> dict[str, Any]:
    """Key figures of a result as entries of a table, units in the names of the columns.

    Forces, mean and extremes of the axial stress by both methods, errors of force and mean where
    they are known, contact, what was interpolated, and the parameters.
    """
    maps, about = on_layer(result.maps), result.maps.attrs
    row: dict[str, Any] = {}
    for side in ("window", "sample"):
        row[f"{side}_force_mN"] = float(about[f"{side}_force_mN"])
    complete = not without_inputs(about)  # what leaves them out is a part of the error
    if complete and (error := force_error(about)) is not None:
        row["force_error_mN"] = error
    for method, stress in (
        ("", maps["axial_stress"]),
        ("algebraic_", methods(result)["algebraic"]),  # of each pixel, as in the summary
    ):
        row[f"{method}mean_axial_stress_kPa"] = area_mean(stress)
        if complete and not method and (error := mean_stress_error(maps)) is not None:
            row["mean_axial_stress_error_kPa"] = error
        row[f"{method}first_percentile_axial_stress_kPa"] = float(np.nanpercentile(stress, 1))
        row[f"{method}most_compressed_axial_stress_kPa"] = float(np.nanmin(stress))
    if "sample_youngs_modulus" in maps:
        for name, column in (
            ("sample_youngs_modulus", "median_sample_youngs_modulus_kPa"),
            ("sample_modulus_error", "median_sample_modulus_error_fraction"),
        ):
            if name == "sample_modulus_error" and not complete:
                continue
            known = maps[name].values[np.isfinite(maps[name].values)]
            row[column] = float(np.median(known)) if known.size else np.nan
        row["compression_mm"] = float(about.get("compression_mm", np.nan))
    row["in_contact_fraction"] = touching_share(maps)
    row["interpolated_fraction"] = float(about.get("filled_share", 0.0))
    row["mean_loaded_thickness_mm"] = area_mean(maps["loaded_thickness"])
    for key in ("c10_kPa", "c01_kPa", "bulk_to_shear", "window_friction", "sample_friction"):
        if key in about:
            row[key] = float(about[key])
    for key in ("window_contact", "sample_contact"):
        if key in about:
            row[key] = str(about[key])
    if "elements" in about:
        row["elements"] = int(np.prod(about["elements"]))
    if "newton_iterations" in about:
        row["newton_iterations"] = int(about["newton_iterations"])
    return row
