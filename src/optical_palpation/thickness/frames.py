"""Thickness maps as xarray objects: values checked, on coordinates in mm, inside a layer extent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from optical_palpation.arguments import explained
from optical_palpation.errors import InputError
from optical_palpation.volume.axes import axes_of_dimensions, unclear_dimension
from optical_palpation.volume.labels import PIXEL, check_units, counts_pixels, unit_of_positions
from optical_palpation.volume.units import MM, stated_unit

# Of the width of a map, by which the extent of the layer may reach beyond it: rounding.
EXTENT_SLACK = 1e-6
# Where less of the layer is measured, most of what is computed rests on pixels that are made up.
_LEAST_MEASURED = 0.5
# Sizes of numbers that programs write where they have none; of thickness, any below zero is wrong.
_MARKS: tuple[float, ...] = (99.0, 999.0, 9999.0, 99999.0, 999999.0, 99.9, 999.9, 9999.9)
_MARKS += (99.99, 999.25, 9999.25, 32767.0, 32768.0, 65535.0)
# Of coordinates, over the median step: meshes are graded, but not so.
_LARGEST_JUMP = 50.0
# Above so many medians, a thickness that occurs several times is a mark as well.
_FAR = 10.0


@explained
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

    Masked pixels of a ``numpy.ma`` array are missing. Of an ``xarray.DataArray`` the dimensions
    say how it lies, its coordinates and its ``layer_extent`` are taken where no others are given,
    and values and coordinates are converted where its attributes state another unit than mm.

    The lateral frame is given by `x` and `y` (pixel centres in mm, ascending or descending), or
    by `field_of_view` or `pixel_spacing`; these, `layer_extent`, the result and the errors are
    those of :func:`read_thickness_map`. `where` names the map in error messages.
    """
    plain, own = _unlabelled(values, where)
    if x is None and y is None and len(own) == 2:
        x, y = own["x"], own["y"]
    result = map_on_grid(
        checked_values(plain, where),
        x=x,
        y=y,
        field_of_view=field_of_view,
        pixel_spacing=pixel_spacing,
        where=where,
    )
    if layer_extent is None and "layer_extent" in getattr(values, "attrs", {}):
        layer_extent = layer_extent_of(result.assign_attrs(values.attrs))  # type: ignore[union-attr]
    result.attrs = {
        "units": "mm",
        "long_name": "loaded thickness of the layer",
        "layer_extent": _layer_extent(result, layer_extent, where),
    }
    measured = float(np.mean(np.isfinite(result.values[inside_layer(result)])))
    result.attrs["missing_share"] = 1.0 - measured
    if measured < _LEAST_MEASURED:
        raise InputError(
            f"{where}: only {measured:.1%} of the layer's pixels are measured; with less than "
            f"{_LEAST_MEASURED:.0%} the stress would rest on thickness that is made up. Measure "
            "more, or give the extent of the part that was measured as layer extent"
        )
    return result.rename("loaded_thickness")


def map_on_grid(
    data: NDArray[np.float64],
    *,
    x: ArrayLike | None = None,
    y: ArrayLike | None = None,
    field_of_view: Sequence[float] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    where: str = "map",
) -> xr.DataArray:
    """Put values [y, x] on ascending coordinates in mm, as :func:`thickness_map` does."""
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
                f"{where} carries no coordinates in mm (numbers of pixels, such as whole numbers "
                "without a unit, are none): give the field of view (x, y) or the pixel spacing "
                "(x, y) in mm, or say the unit of the coordinates in the file"
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
    return xr.DataArray(
        data,
        {
            axis: (axis, axes[axis], {"units": "mm", "long_name": f"lateral position {axis}"})
            for axis in "yx"
        },
        ("y", "x"),
    ).sortby(["y", "x"])


def layer_extent_of(thickness: xr.DataArray) -> tuple[float, float, float, float]:
    """Return (x0, x1, y0, y1) of the layer in mm: the part of ``layer_extent`` inside the map."""
    x, y = thickness["x"].values, thickness["y"].values
    whole = [float(edge) for edge in (x[0], x[-1], y[0], y[-1])]
    x0, x1, y0, y1 = map(float, thickness.attrs.get("layer_extent", whole))
    # A map that was cropped after reading still has the attribute of the whole one.
    return max(x0, whole[0]), min(x1, whole[1]), max(y0, whole[2]), min(y1, whole[3])


def on_grid(thickness: xr.DataArray, name: str = "thickness") -> xr.DataArray:
    """Return the map on ``(y, x)``, or raise an InputError that names it if it lacks that frame."""
    if not isinstance(thickness, xr.DataArray):
        hint = ": take its variable 'thickness'" if isinstance(thickness, xr.Dataset) else ""
        raise InputError(
            f"{name}: a thickness map is an xarray.DataArray, not {type(thickness).__name__}{hint}"
            ". Make one of an array with thickness_map"
        )
    if thickness.dtype.kind not in "fiu" or not thickness.size:
        raise InputError(
            f"{name}: a thickness map holds lengths in mm; found {thickness.dtype}, "
            f"{thickness.size} values"
        )
    if set(thickness.dims) != {"y", "x"} or not {"y", "x"} <= set(thickness.coords):
        raise InputError(
            f"{name}: a thickness map has the dimensions (y, x) with coordinates in mm; found "
            f"dimensions {thickness.dims} with coordinates {tuple(thickness.coords)}. Make one of "
            "an array with thickness_map"
        )
    for part, values in (("map", thickness), ("x", thickness["x"]), ("y", thickness["y"])):
        unit = stated_unit("", values.attrs, f"{name}, {part}")
        if unit not in (None, "mm"):
            raise InputError(
                f"{name}: {part} is in {unit}; give mm: thickness_map(map), which converts "
                "coordinates that state their unit, too"
            )
    for axis in ("x", "y"):
        _ascending(thickness[axis].values, axis, thickness.sizes[axis], name)
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


def typical_thickness(field: xr.DataArray) -> float:
    """Median of a map without gaps over the extent of the layer, mm: of nothing beside it."""
    return float(np.median(field.values[inside_layer(field)]))


def smooth_map(
    field: xr.DataArray,
) -> Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]:
    """Return a map on ``(y, x)`` as a function of x and y, mm: a cubic spline, level beyond ends.

    Raises
    ------
    InputError
        If values are missing.
    """
    if not np.isfinite(field.values).all():
        raise InputError("the field has missing values: fill them first")
    field_y, field_x = (field[axis].values.astype(float) for axis in "yx")
    values = field.transpose("y", "x").values.astype(float)
    order_y, order_x = (min(3, axis.size - 1) for axis in (field_y, field_x))
    spline = RectBivariateSpline(field_y, field_x, values, kx=order_y, ky=order_x)

    def at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        inside_y = np.clip(y, field_y[0], field_y[-1])
        inside_x = np.clip(x, field_x[0], field_x[-1])
        return np.asarray(spline.ev(inside_y, inside_x), dtype=np.float64)

    return at


def checked_values(values: ArrayLike, where: str) -> NDArray[np.float64]:
    """Return `values` as float64 if they can be a thickness map, else raise an InputError."""
    array = checked_heights(values, where)
    _refuse(array, "zero or negative", array <= 0.0, where)
    largest = float(np.nanmax(array))
    if largest > _FAR * float(np.nanmedian(array)) and (array == largest).sum() > 1:
        _refuse(
            array,
            f"{largest:g}, far above all others, as marks of missing pixels are",
            array == largest,
            where,
        )
    return array


def checked_heights(values: ArrayLike, where: str) -> NDArray[np.float64]:
    """Return `values` as float64 if they can be a map of lengths, else raise an InputError."""
    array = np.asarray(values)
    check_kind(array.shape, array.dtype, where)
    array = array.astype(np.float64)
    if np.isnan(array).all():
        raise InputError(f"{where}: all values are missing (NaN)")
    _refuse(array, "infinite", np.isinf(array), where)
    _refuse_marks(array, where)
    return array


def _refuse(array: NDArray[np.float64], problem: str, bad: NDArray[np.bool_], where: str) -> None:
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"{where}: {bad.sum()} of {array.size} values are {problem}, the first "
            f"({array[row, column]:g}) in row {row}, column {column}; mark missing pixels with NaN"
        )


def _refuse_marks(array: NDArray[np.float64], where: str) -> None:
    """Refuse numbers by which programs mark missing pixels, where they stand far from the rest."""
    lengths = np.abs(array[~np.isnan(array)])
    largest = float(lengths.max())
    others = lengths[lengths < largest]
    is_mark = largest >= 1e9 or any(abs(largest - mark) <= 1e-6 * mark for mark in _MARKS)
    if is_mark and (largest >= 1e9 or (others.size and largest > 1.5 * others.max())):
        _refuse(
            array,
            f"{largest:g} in size, which is no length but a mark of missing pixels",
            np.abs(array) == largest,
            where,
        )


def _unlabelled(values: Any, where: str) -> tuple[NDArray[Any], dict[str, NDArray[np.float64]]]:
    """Return values as [y, x] in mm, NaN where masked, and the coordinates that they carry."""
    if isinstance(values, np.ma.MaskedArray):
        check_kind(values.shape, values.dtype, where)
        return np.ma.filled(values.astype(np.float64), np.nan), {}
    if not isinstance(values, xr.DataArray):
        if hasattr(values, "columns") or hasattr(values, "unit") or hasattr(values, "units"):
            raise InputError(
                f"{where}: a {type(values).__name__} carries labels or units that would be lost; "
                "give an array of mm, or an xarray.DataArray"
            )
        if isinstance(values, xr.Dataset):
            raise InputError(f"{where}: is an xarray.Dataset; give one of its variables")
        try:
            return np.asarray(values), {}
        except ValueError as error:  # rows of several lengths
            raise InputError(f"{where}: is no array of numbers ({error})") from None
    if packed := {"scale_factor", "add_offset"} & set(values.attrs):
        raise InputError(
            f"{where}: its attributes state {' and '.join(sorted(packed))}, so its values are "
            "still packed; decode them (xarray.decode_cf) first"
        )
    check_kind(values.shape, values.dtype, where)
    dims = [str(dim) for dim in values.dims]
    order = axes_of_dimensions(dims)
    if any(order) or unclear_dimension(dims):
        if set(order) != {"x", "y"}:
            raise InputError(f"{where}: has the dimensions {values.dims}, not (y, x)")
        values = values.transpose(*(dims[order.index(axis)] for axis in "yx"))
    coordinates, stored = {}, []
    for axis, dim in zip("yx", values.dims, strict=True):
        if dim in values.coords and order.count(axis):
            own = values[dim]
            unit = unit_of_positions(str(dim), own.attrs, f"{where}, coordinate {dim}")
            positions = _floats(own.values, axis, where)
            if unit != PIXEL and (unit or not counts_pixels(own.values)):
                stored.append((str(dim), positions, unit))
                coordinates[axis] = positions * MM[unit or "mm"]
            elif positions[0] > positions[-1]:
                values = values.isel({dim: slice(None, None, -1)})
    check_units(stored, where)
    unit = stated_unit(str(values.name or ""), values.attrs, where) or "mm"
    return np.asarray(values.values, np.float64) * MM[unit], coordinates


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
    positions = _floats(given, axis, where)
    if positions.shape != (count,):
        raise InputError(f"{where}: {positions.size} {axis} coordinates for {count} pixels")
    steps = np.diff(positions)
    if not np.all(np.isfinite(positions)) or not (np.all(steps > 0.0) or np.all(steps < 0.0)):
        raise InputError(
            f"{where}: the {axis} coordinates must be finite and rise or fall steadily"
        )
    at = int(np.argmax(np.abs(steps)))
    if abs(steps[at]) > _LARGEST_JUMP * float(np.median(np.abs(steps))):
        raise InputError(
            f"{where}: the {axis} coordinates jump from {positions[at]:g} to {positions[at + 1]:g} "
            "mm, far beyond the other steps; a map is one piece"
        )
    return positions


def _floats(given: ArrayLike, axis: str, where: str) -> NDArray[np.float64]:
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: the {axis} coordinates are no numbers") from None


def _numbers(name: str, given: Sequence[float], count: int) -> list[float]:
    try:
        numbers = [] if isinstance(given, str) else [float(number) for number in given]
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
    slack = EXTENT_SLACK * max(whole[1] - whole[0], whole[3] - whole[2])
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
