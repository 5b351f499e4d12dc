"""Comparisons of results out: NetCDF, figure and words."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.files import netcdf
from optical_palpation.present.figure import draw_map, figure_file, letter
from optical_palpation.present.output import atomic
from optical_palpation.present.terms import DIFFERENCE, Term, common_limits, percent, term

_LONGEST = 22  # letters of a name that a panel has room for


def write_comparison(comparison: xr.Dataset, path: str | Path) -> None:
    """Write what :func:`~optical_palpation.analysis.compare_results` found as a NetCDF-4 file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    about = {"Conventions": "CF-1.11", "software": "optical-palpation"}
    dataset = comparison.assign_attrs(
        about | {"software_version": version("optical-palpation")} | comparison.attrs
    )
    compressed = {name: {"zlib": True} for name, v in dataset.data_vars.items() if v.ndim > 2}
    content = netcdf(dataset, encoding=compressed)
    with atomic(path, "result") as temporary:
        temporary.write_bytes(content)


def write_comparison_figure(comparison: xr.Dataset, path: str | Path) -> None:
    """Draw the results on one colour scale, and below each its difference from the first.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    variable = comparison.attrs["variable"]
    fields = {str(n): comparison[variable].sel(result=n) for n in comparison["result"].values}
    first = next(iter(fields.values()))
    what = term(first.to_dataset(name=variable), variable)
    limits = common_limits(fields, what.colours)
    differences = {
        str(n): comparison["difference"].sel(compared=n) for n in comparison["compared"].values
    }
    spread = common_limits(differences, DIFFERENCE)
    y, x = comparison["y"].values, comparison["x"].values
    aspect = float(np.clip(np.ptp(y) / max(np.ptp(x), 1e-12), 0.3, 2.0))
    each = 178.0 / max(len(fields), 3)
    width = each * len(fields)
    with figure_file(path, width, 2 * ((each - 20.0) * aspect + 20.0)) as figure:
        figure.suptitle(what.words)
        axes = figure.subplots(2, len(fields), squeeze=False)
        for k, (name, field) in enumerate(fields.items()):
            short = name if len(name) <= _LONGEST else f"…{name[1 - _LONGEST :]}"
            named = Term(short, what.units, what.colours, what.scale)
            draw_map(axes[0, k], field, named, limits=limits)
            if name in differences:
                named = Term(f"({chr(ord('a') + k)}) less (a)", what.units, DIFFERENCE, "")
                draw_map(axes[1, k], differences[name], named, limits=spread)
        axes[1, 0].remove()
        letter([*axes[0], *axes[1, 1:]])


def comparison_in_words(comparison: xr.Dataset) -> str:
    """Return the differences in a line for each result."""
    units = comparison["difference"].attrs.get("units", "1")
    units = "" if units == "1" else f" {units}"
    lines = [f"{comparison.attrs['variable']}, compared with {comparison.attrs['reference']}:"]
    for name in comparison["compared"].values:
        row = comparison.sel(compared=name)
        whole, inner = row.sel(zone="all"), row.sel(zone="interior")
        parts = [
            f"rms difference {float(whole['rms']):.3g}{units} "
            f"({percent(whole['relative_rms'])}; interior {percent(inner['relative_rms'])})",
            f"mean {float(whole['bias']):+.3g}{units}",
            f"largest {float(whole['largest']):.3g}{units}",
        ]
        if "within_error" in row and np.isfinite(row["within_error"]):
            parts.append(f"{percent(row['within_error'])} of the map within the error")
        known = comparison[comparison.attrs["variable"]].isel(result=0).notnull()
        shared = float(row["difference"].notnull().sum() / known.sum())
        if shared < 1.0:
            parts.append(f"on the {percent(shared)} of the map that both have")
        y, x = row["shift"].values
        if x or y:
            parts.append(f"shifted by x {-x:+.3g} and y {-y:+.3g} mm")
        lines.append(f"  {name}: {', '.join(parts)}")
    return "\n".join(lines)
