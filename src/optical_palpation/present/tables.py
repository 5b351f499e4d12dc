"""Tables of regions of interest, as CSV and as words."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from optical_palpation.present.output import atomic


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
        spread = float(row["standard_deviation"])
        parts = [f"mean {float(row['mean']):.4g} {units} (standard deviation {spread:.2g})"]
        parts.append(f"{float(row['minimum']):.4g} to {float(row['maximum']):.4g} {units}")
        if "force" in row:
            parts.append(f"force {float(row['force']):.4g} mN")
        parts.append(f"area {float(row['area']):.4g} mm2")
        if "contrast" in row:
            parts.append(f"contrast {float(row['contrast']):.3g}")
        if "mean_error" in row:
            parts.append(f"error {float(row['mean_error']):.2g} {units}")
        lines.append(f"  {name}: {', '.join(parts)}")
    return "\n".join(lines)
