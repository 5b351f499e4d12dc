"""Difference of two maps, in the interior and at the edge."""

from __future__ import annotations

import numpy as np
import xarray as xr

from optical_palpation.analysis.maps import check_map
from optical_palpation.errors import InputError

ZONES = ("interior", "edge", "all")


def compare_maps(
    field: xr.DataArray, reference: xr.DataArray, edge_width: float = 0.5
) -> xr.Dataset:
    """Compare a map with a reference.

    Parameters
    ----------
    field
        Map on ``(y, x)``; taken to the reference's pixels by linear interpolation.
    reference
        Map on ``(y, x)`` in the same unit.
    edge_width
        Pixels nearer than this to the border of the reference are its edge, mm.

    Returns
    -------
    xarray.Dataset
        ``difference`` (field less reference) on the reference's grid, and over ``zone``
        (interior, edge, all): ``rms``, ``relative_rms`` (rms of the difference over rms of the
        reference), ``bias`` (mean difference), ``relative_bias`` (over the mean of the reference),
        ``largest`` absolute difference, and ``pixels``. Pixels without a value in either map are
        left out.

    Raises
    ------
    InputError
        If the maps cannot be used, their units differ, or they do not overlap.
    """
    a, b = check_map(field, "map"), check_map(reference, "reference")
    units = a.attrs.get("units"), b.attrs.get("units")
    if None not in units and units[0] != units[1]:
        raise InputError(f"the map is in {units[0]} and the reference in {units[1]}")
    if a.sizes != b.sizes or any(
        not np.allclose(a[d], b[d], rtol=0.0, atol=1e-9) for d in ("y", "x")
    ):
        a = a.interp(y=b["y"], x=b["x"], method="linear")
    difference = (a - b.assign_coords(y=a["y"], x=a["x"])).rename("difference")
    if not np.isfinite(difference.values).any():
        raise InputError(
            "map and reference do not overlap: x "
            f"{float(field['x'].min()):g} to {float(field['x'].max()):g} and "
            f"{float(b['x'].min()):g} to {float(b['x'].max()):g} mm, y "
            f"{float(field['y'].min()):g} to {float(field['y'].max()):g} and "
            f"{float(b['y'].min()):g} to {float(b['y'].max()):g} mm"
        )
    if units[1] is not None:
        difference.attrs["units"] = units[1]

    y, x = b["y"].values, b["x"].values
    border = np.minimum.outer(np.minimum(y - y[0], y[-1] - y), np.minimum(x - x[0], x[-1] - x))
    inner = border >= edge_width - 1e-9
    valid = np.isfinite(difference.values)
    rows = []
    for zone in (inner, ~inner, np.ones_like(inner)):
        d, r = difference.values[zone & valid], b.values[zone & valid]
        if d.size == 0:
            rows.append((np.nan,) * 5 + (0,))
            continue
        rms, bias = float(np.sqrt(np.mean(d**2))), float(d.mean())
        scale, mean = float(np.sqrt(np.mean(r**2))), float(r.mean())
        rows.append(
            (
                rms,
                rms / scale if scale > 0.0 else np.nan,
                bias,
                bias / mean if mean != 0.0 else np.nan,
                float(np.abs(d).max()),
                d.size,
            )
        )
    names = ("rms", "relative_rms", "bias", "relative_bias", "largest", "pixels")
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    return xr.Dataset(
        {"difference": difference} | {k: ("zone", list(v)) for k, v in columns.items()},
        coords={"zone": list(ZONES)},
        attrs={"edge_width_mm": edge_width},
    )
