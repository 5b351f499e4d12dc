"""Checks that every analysis of a map shares."""

from __future__ import annotations

from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import InputError


def check_map(field: xr.DataArray, name: str) -> xr.DataArray:
    """Return the map as floats on ``(y, x)``, coordinates increasing and evenly spaced.

    Raises
    ------
    InputError
        If it is no such map, is smaller than 3 x 3, or holds no finite value.
    """
    if not isinstance(field, xr.DataArray) or set(field.dims) != {"y", "x"}:
        dims = field.dims if isinstance(field, xr.DataArray) else type(field).__name__
        raise InputError(f"{name}: needs a DataArray over y and x, got {dims}")
    field = field.transpose("y", "x").astype(np.float64)
    for axis in ("y", "x"):
        if axis not in field.coords or field.sizes[axis] < 3:
            raise InputError(f"{name}: needs at least 3 points with coordinates in mm along {axis}")
        steps = np.diff(field[axis].values)
        if not np.all(steps > 0.0):
            raise InputError(
                f"{name}: coordinates along {axis} must increase; map.sortby('{axis}') sorts them"
            )
        if np.ptp(steps) > 1e-3 * steps.mean():
            raise InputError(
                f"{name}: coordinates along {axis} must increase in equal steps, not in steps of "
                f"{steps.min():.3g} to {steps.max():.3g} mm; map.interp({axis}=...) takes it to "
                "such points, best the thickness map before its stress is computed"
            )
    if not np.isfinite(field.values).any():
        raise InputError(f"{name}: holds no finite value")
    return field


def on_layer(maps: xr.Dataset) -> xr.Dataset:
    """Return the part of the maps that the layer covers; maps may reach beyond it."""
    thickness = maps.get("loaded_thickness")
    extent = None if thickness is None else thickness.attrs.get("layer_extent")
    if extent is None:
        return maps
    x0, x1, y0, y1 = extent
    slack = 1e-9 * max(x1 - x0, y1 - y0)
    return maps.sel(x=slice(x0 - slack, x1 + slack), y=slice(y0 - slack, y1 + slack))


def map_error(maps: xr.Dataset, variable: str) -> xr.DataArray | None:
    """Error of a map in its unit, of inputs and mesh together; None where none of inputs is known.

    With the sample in the model the error bands contain that of the mesh.
    """
    own, of_mesh = (maps.get(f"{variable}_{what}") for what in ("error", "mesh_error"))
    if own is None or of_mesh is None or "error_bands" in maps.attrs:
        return own
    return (own**2 + of_mesh.fillna(0.0) ** 2) ** 0.5


def pixel_size(field: xr.DataArray) -> tuple[float, float]:
    """Pixel spacing (y, x) in mm."""
    y, x = field["y"].values, field["x"].values
    return float(y[-1] - y[0]) / (y.size - 1), float(x[-1] - x[0]) / (x.size - 1)


def at_points_of(
    field: xr.DataArray,
    like: xr.DataArray | xr.Dataset,
    method: Literal["linear", "nearest"] = "linear",
    beyond: float = np.nan,
) -> xr.DataArray:
    """Read a map at the points of another one, `beyond` where it has none.

    What lies beyond its outermost points by rounding alone, as the last point of another grid that
    ends on the same side of the layer, lies on them.
    """
    at = {}
    for axis in ("y", "x"):
        own, wanted = field[axis].values, like[axis].values
        nearest = np.clip(wanted, own.min(), own.max())
        slack = 1e-6 * np.ptp(own)
        at[axis] = np.where(np.abs(wanted - nearest) < slack, nearest, wanted)
    read = field.interp(at, method=method, kwargs={"fill_value": beyond})
    return read.assign_coords(y=like["y"], x=like["x"])


def evenly(field: xr.DataArray) -> xr.DataArray:
    """Return the map on evenly spaced points: where its own are not, each has the nearest one's."""
    for axis in ("y", "x"):
        at = field[axis].values
        even = np.linspace(at[0], at[-1], at.size)
        if at.size > 1 and np.max(np.abs(at - even)) > 1e-3 * abs(even[1] - even[0]):
            field = field.sel({axis: even}, method="nearest").assign_coords({axis: even})
    return field


def point_areas(field: xr.DataArray) -> xr.DataArray:
    """Area that each point of a map stands for on ``(y, x)``, mm2: what is nearest to it.

    Of the outermost points only half lies in the map, of its corners a quarter.
    """
    y, x = (_widths(field[axis].values) for axis in "yx")
    return xr.DataArray(np.outer(y, x), {"y": field["y"], "x": field["x"]}, ("y", "x"))


def area_mean(field: xr.DataArray) -> float:
    """Mean of a map, or share of a mask, over the area on which it has values; NaN without any."""
    field = field.astype(float)
    return float(field.where(np.isfinite(field)).weighted(point_areas(field)).mean())


def _widths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if points.size == 1:  # of a single row or column, which has no width, all points count alike
        return np.ones(1)
    middles = 0.5 * (points[1:] + points[:-1])
    return np.diff(np.concatenate([points[:1], middles, points[-1:]]))


def plane_noise(field: xr.DataArray, mask: NDArray[np.bool_]) -> float:
    """Standard deviation about a plane of the pixels in a mask, in the unit of the map.

    A slope is no noise. `field` is a map as :func:`check_map` gives it, the mask holds at least
    four of its pixels, all with a value.
    """
    y, x = np.meshgrid(field["y"].values, field["x"].values, indexing="ij")
    plane = np.column_stack(
        [np.ones(mask.sum()), x[mask] - x[mask].mean(), y[mask] - y[mask].mean()]
    )
    values = field.values[mask]
    coefficients, *_ = np.linalg.lstsq(plane, values, rcond=None)
    return float(np.sqrt(np.sum((values - plane @ coefficients) ** 2) / (values.size - 3)))
