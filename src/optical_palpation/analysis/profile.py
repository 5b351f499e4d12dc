"""Values of maps along a line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from optical_palpation.arguments import check_instance, number
from optical_palpation.errors import InputError


def line_profile(
    maps: xr.Dataset, start: Sequence[float], end: Sequence[float], width: float = 0.0
) -> xr.Dataset:
    """Read maps along a line, by linear interpolation between pixels.

    Parameters
    ----------
    maps
        Maps on ``(y, x)``, coordinates in mm; others are left out.
    start, end
        Ends of the line, (x, y) in mm.
    width
        Average over a band of this width about the line, mm.

    Returns
    -------
    xarray.Dataset
        The maps over ``distance`` from the start (mm), in steps of a pixel, with coordinates
        ``x`` and ``y``. States and flags are those of the nearest pixel, on the line itself.
        Nothing beyond the map has a value.

    Raises
    ------
    InputError
        If the ends are no two different places, the width is negative, or the line misses the map.
    """
    what = "a Dataset of maps, as result.maps; a map alone is one by map.to_dataset(name='stress')"
    check_instance(maps, xr.Dataset, "maps", what)
    ends = []
    for name, point in (("start", start), ("end", end)):
        try:
            place = np.asarray(point, dtype=np.float64)
        except (TypeError, ValueError):
            place = np.empty(0)
        if place.shape != (2,) or not np.isfinite(place).all():
            raise InputError(f"{name}: a point of a profile is (x, y) in mm, not {point!r}")
        ends.append(place)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length > 0.0:
        raise InputError(
            f"start and end of the profile are the same place, ({ends[0][0]:g}, {ends[0][1]:g}) mm"
        )
    if number(width, "width", "a number of mm, at least 0") < 0.0:
        raise InputError(f"width: a number of mm, at least 0, not {width!r}")
    maps = maps[[n for n, v in maps.data_vars.items() if set(v.dims) == {"y", "x"}]]
    maps = maps.sortby(["y", "x"])
    step = min(float(np.diff(maps[axis].values).mean()) for axis in ("y", "x"))
    count = max(int(np.ceil(length / step)) + 1, 2)
    share = np.linspace(0.0, 1.0, count)
    along = (ends[1] - ends[0]) / length
    # not start + share (end - start), whose end is off by rounding, and may lie beyond the map
    x, y = ((1.0 - share)[:, None] * ends[0] + share[:, None] * ends[1]).T
    lanes = max(int(np.ceil(width / step)), 1)
    beside = (np.arange(lanes) + 0.5) / lanes * width - width / 2
    lane = xr.DataArray(beside, dims="lane")
    at_x = xr.DataArray(x, dims="distance") - lane * along[1]
    at_y = xr.DataArray(y, dims="distance") + lane * along[0]
    found: dict[Any, xr.DataArray] = {}
    for key, field in maps.data_vars.items():
        if field.dtype.kind == "f":
            values = field.interp(x=at_x, y=at_y, method="linear").mean("lane", skipna=False)
        else:
            line = {"x": xr.DataArray(x, dims="distance"), "y": xr.DataArray(y, dims="distance")}
            values = field.astype(float).interp(line, method="nearest")
        found[key] = values.drop_vars(["x", "y"], errors="ignore").assign_attrs(field.attrs)
    profile = xr.Dataset(
        found,
        {
            "distance": (
                "distance",
                length * share,
                {"units": "mm", "long_name": "distance along the line"},
            ),
            "x": ("distance", x, maps["x"].attrs | {"units": "mm"}),
            "y": ("distance", y, maps["y"].attrs | {"units": "mm"}),
        },
        {"start_mm": list(map(float, ends[0])), "end_mm": list(map(float, ends[1]))}
        | ({"width_mm": float(width)} if width else {}),
    )
    if all(bool(v.isnull().all()) for v in profile.data_vars.values()):
        raise InputError(
            f"the line from {tuple(ends[0])} to {tuple(ends[1])} mm misses the map, x "
            f"{float(maps['x'].min()):g} to {float(maps['x'].max()):g} and y "
            f"{float(maps['y'].min()):g} to {float(maps['y'].max()):g} mm"
        )
    return profile
