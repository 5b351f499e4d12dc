"""Thickness maps as xarray objects: values checked, on coordinates in mm, inside a layer extent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from optical_palpation.errors import InputError

_MICROMETRES = ("um", "µm", "μm", "micron", "micrometer", "micrometre")


def thickness_map(
    values: ArrayLike,
    *,
    x: ArrayLike | None = None,
    y: ArrayLike | None = None,
    field_of_view: Sequence[float] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    layer_extent: Sequence[float] | None = None,
    where: str = "thickness map",
) -> xr.DataArray:
    """Make a thickness map of an array in memory; `values` is [y, x] in mm, NaN where missing.

    The lateral frame is given by `x` and `y` (pixel centres in mm, ascending or descending), or
    by `field_of_view` or `pixel_spacing`; these, `layer_extent`, the result and the errors are
    those of :func:`read_thickness_map`. `where` names the map in error messages.
    """
    data = checked_values(values, where)
    rows, columns = data.shape
    if (x is None) != (y is None):
        raise InputError(f"{where}: coordinates along both x and y are needed, or along neither")
    spacing = None if pixel_spacing is None else _numbers("pixel spacing", pixel_spacing, 2)
    field = None if field_of_view is None else _numbers("field of view", field_of_view, 2)
    axes: dict[str, NDArray[np.float64]] = {}
    for index, (axis, count, given) in enumerate((("x", columns, x), ("y", rows, y))):
        if given is not None:
            positions = _ascending(given, axis, count, where)
        elif field is not None:
            positions = np.linspace(0.0, field[index], count)
        elif spacing is not None:
            positions = np.linspace(0.0, (count - 1) * spacing[index], count)
        else:
            raise InputError(
                f"{where} carries no coordinates: give the field of view (x, y) or the pixel "
                "spacing (x, y) in mm"
            )
        for name, numbers, extent in (
            ("field of view", field, 1.0),
            ("pixel spacing", spacing, count - 1.0),
        ):
            actual = abs(positions[-1] - positions[0])
            if numbers is not None and abs(numbers[index] * extent - actual) > 1e-4 * actual:
                raise InputError(
                    f"{where}: a {name} of {numbers[index]:g} mm along {axis} contradicts "
                    f"{'the coordinates' if given is not None else 'the field of view'}: "
                    f"{count} pixels, {actual:g} mm from the first to the last centre, "
                    f"{actual / (count - 1):g} mm apart"
                )
        axes[axis] = positions
    result = xr.DataArray(
        data,
        {
            axis: (axis, axes[axis], {"units": "mm", "long_name": f"lateral position {axis}"})
            for axis in "yx"
        },
        ("y", "x"),
        name="loaded_thickness",
    ).sortby(["y", "x"])
    result.attrs = {
        "units": "mm",
        "long_name": "loaded thickness of the layer",
        "layer_extent": _layer_extent(result, layer_extent, where),
        "missing_share": float(np.isnan(data).mean()),
    }
    return result


def layer_extent_of(thickness: xr.DataArray) -> tuple[float, float, float, float]:
    """Return (x0, x1, y0, y1) of the layer in mm: the part of ``layer_extent`` inside the map."""
    x, y = thickness["x"].values, thickness["y"].values
    whole = [float(edge) for edge in (x[0], x[-1], y[0], y[-1])]
    x0, x1, y0, y1 = map(float, thickness.attrs.get("layer_extent", whole))
    # A map that was cropped after reading still has the attribute of the whole one.
    return max(x0, whole[0]), min(x1, whole[1]), max(y0, whole[2]), min(y1, whole[3])


def on_grid(thickness: xr.DataArray) -> xr.DataArray:
    """Return the map on ``(y, x)``, or raise an InputError if it lacks that frame."""
    if not isinstance(thickness, xr.DataArray):
        hint = ": take its variable 'thickness'" if isinstance(thickness, xr.Dataset) else ""
        raise InputError(
            f"a thickness map is an xarray.DataArray, not {type(thickness).__name__}{hint}. Make "
            "one of an array with thickness_map"
        )
    if set(thickness.dims) != {"y", "x"} or not {"y", "x"} <= set(thickness.coords):
        raise InputError(
            f"a thickness map has the dimensions (y, x) with coordinates in mm; found dimensions "
            f"{thickness.dims} with coordinates {tuple(thickness.coords)}. Make one of an array "
            "with thickness_map"
        )
    for axis in ("x", "y"):
        _ascending(thickness[axis].values, axis, thickness.sizes[axis], "thickness map")
    for name, values in (("map", thickness), ("x", thickness["x"]), ("y", thickness["y"])):
        if (unit := values.attrs.get("units", "mm")) in _MICROMETRES:
            change = (
                f"assign_coords({name}=(map.{name} / 1000).assign_attrs(units='mm'))"
                if name in ("x", "y")
                else "(map / 1000).assign_attrs(map.attrs, units='mm')"
            )
            raise InputError(f"thickness map: {name} is in {unit}; give mm: {change}")
    thickness = thickness.transpose("y", "x")
    if all(thickness[axis].values[0] < thickness[axis].values[-1] for axis in ("x", "y")):
        return thickness
    return thickness.sortby(["y", "x"])


def inside_layer(thickness: xr.DataArray) -> NDArray[np.bool_]:
    """Pixels [y, x] whose centres lie in the extent of the layer."""
    x, y = thickness["x"].values, thickness["y"].values
    x0, x1, y0, y1 = layer_extent_of(thickness)
    slack = 1e-9 * max(x1 - x0, y1 - y0)
    return np.outer(
        (y >= y0 - slack) & (y <= y1 + slack),
        (x >= x0 - slack) & (x <= x1 + slack),
    )


def checked_values(values: ArrayLike, where: str) -> NDArray[np.float64]:
    """Return `values` as float64 if they can be a thickness map, else raise an InputError."""
    array = np.asarray(values)
    check_kind(array.shape, array.dtype, where)
    array = array.astype(np.float64)
    missing = np.isnan(array)
    if missing.all():
        raise InputError(f"{where}: all values are missing (NaN)")
    for problem, bad in (
        ("infinite", np.isinf(array)),
        ("zero or negative", ~missing & (array <= 0.0)),
    ):
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise InputError(
                f"{where}: {bad.sum()} of {array.size} values are {problem}, the first "
                f"({array[row, column]:g}) in row {row}, column {column}; "
                "mark missing pixels with NaN"
            )
    return array


def check_kind(shape: tuple[int, ...], dtype: np.dtype[Any], where: str) -> None:
    """Raise an InputError if no array of this shape and type can be a thickness map."""
    if dtype.kind != "f":
        raise InputError(
            f"{where} holds values of type {dtype}; a thickness map needs floating-point "
            "lengths" + (" (whole numbers may be pixel counts)" if dtype.kind in "iu" else "")
        )
    if len(shape) != 2 or min(shape) < 2:
        raise InputError(
            f"{where} has the shape {' x '.join(map(str, shape)) or 'of a single number'}; "
            "a thickness map has two dimensions of at least 2 pixels"
        )


def _ascending(given: ArrayLike, axis: str, count: int, where: str) -> NDArray[np.float64]:
    try:
        positions = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: the {axis} coordinates are no numbers") from None
    if positions.shape != (count,):
        raise InputError(f"{where}: {positions.size} {axis} coordinates for {count} pixels")
    steps = np.diff(positions)
    if not np.all(np.isfinite(positions)) or not (np.all(steps > 0.0) or np.all(steps < 0.0)):
        raise InputError(
            f"{where}: the {axis} coordinates must be finite and rise or fall steadily"
        )
    return positions


def _numbers(name: str, given: Sequence[float], count: int) -> list[float]:
    try:
        numbers = [float(number) for number in given]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise InputError(f"{name} must be {count} finite numbers in mm, not {given!r}")
    if count == 2 and min(numbers) <= 0.0:
        raise InputError(f"{name} must be positive, not {given!r}")
    return numbers


def _layer_extent(
    thickness: xr.DataArray, given: Sequence[float] | None, where: str
) -> list[float]:
    whole = list(layer_extent_of(thickness))
    if given is None:
        return whole
    x0, x1, y0, y1 = extent = _numbers("layer extent", given, 4)
    slack = 1e-6 * max(whole[1] - whole[0], whole[3] - whole[2])
    if x0 >= x1 or y0 >= y1:
        raise InputError(f"layer extent must be x0 < x1 and y0 < y1, not {given!r}")
    if min(x0 - whole[0], y0 - whole[2]) < -slack or max(x1 - whole[1], y1 - whole[3]) > slack:
        raise InputError(
            f"{where}: the layer extent {extent} reaches beyond the map, {whole} (x0, x1, y0, y1 "
            "in mm)"
        )
    for axis, low, high in (("x", x0, x1), ("y", y0, y1)):
        positions = thickness[axis].values
        count = np.sum((positions >= low - slack) & (positions <= high + slack))
        if count < 2:
            raise InputError(
                f"{where}: the layer extent {extent} holds {count} pixels along {axis}; at least 2 "
                "are needed (it is in mm)"
            )
    return extent
