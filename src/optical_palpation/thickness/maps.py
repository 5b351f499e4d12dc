"""Reading and writing thickness maps."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.files import readable_name, replacing
from optical_palpation.runtime import software_version
from optical_palpation.thickness.formats import Variable, read_variables
from optical_palpation.thickness.frames import check_kind, checked_values, thickness_map

LengthUnit = Literal["mm", "um"]

_UNITS: dict[str, LengthUnit] = {"mm": "mm", "millimeter": "mm", "millimetre": "mm"}
_UNITS |= dict.fromkeys(("um", "µm", "μm", "micron", "micrometer", "micrometre"), "um")
_FACTORS = {"mm": 1.0, "um": 1e-3}


def read_thickness_map(
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    length_unit: str | None = None,
    field_of_view: Sequence[float] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    layer_extent: Sequence[float] | None = None,
) -> xr.DataArray:
    """Read a thickness map from a file of any format that people keep them in.

    The format is told from the content. Lengths in the file are mm unless a suffix of the
    variable's name (``L1_um``), its ``units`` attribute or `length_unit` says otherwise.

    Pixels that a variable ``filled`` of the same file marks are missing: their values were made up
    and not measured.

    Parameters
    ----------
    path
        MATLAB .mat (v5 to v7.3), .npy, .npz, .csv or .txt, floating-point .tif or NetCDF.
    variable
        Name of the map in the file; may be left out when exactly one array of the file can be one
        (two dimensions, floating-point, at least 2 x 2), or one of these is called ``thickness``.
    length_unit
        ``"mm"`` or ``"um"``, the unit of the thickness values in the file.
    field_of_view
        (x, y) distance in mm from the centre of the first to the centre of the last pixel, so that
        the pixel spacing is the field of view over (number of pixels - 1). The first pixel lies at
        x = y = 0. Needed, unless `pixel_spacing` is given, when the file carries no coordinates.
    pixel_spacing
        (x, y) distance in mm between the centres of neighbouring pixels.
    layer_extent
        (x0, x1, y0, y1) in mm: where the layer lies in the coordinates of the map, which may reach
        beyond it. By default the extent stated in a file of :func:`write_thickness_map`, else
        the whole map.

    Returns
    -------
    xarray.DataArray
        ``loaded_thickness`` in mm on ``(y, x)``, coordinates ascending in mm, NaN where missing.
        The attributes record the source, its SHA-256 hash, variable and unit, ``layer_extent``
        and ``missing_share`` (0 to 1).

    Raises
    ------
    InputError
        If the file cannot be read, holds no such map or more than one, if the map has a wrong
        shape or type, infinite, zero or negative values or nothing but missing ones, or if unit,
        field of view, spacing, coordinates and layer extent are missing or contradict each other.
    """
    path = Path(path)
    variables = read_variables(path)
    name = _choose(variables, variable, path)
    where = f"{path}, variable {name}" if name else str(path)
    array = variables[name]
    unit = _length_unit(name, array.unit, length_unit, where) or "mm"
    check_kind(array.shape, array.dtype, where)
    values = checked_values(array.values, where)
    filled = variables.get("filled")
    if filled is not None and filled.shape == values.shape and filled.dtype.kind in "biu":
        values[filled.values != 0] = np.nan
    dims = [_axis(dim) for dim in array.dims]
    if dims == ["x", "y"]:
        values = values.T
    x, y = (_coordinate(variables, values.shape, axis, array.dims, path) for axis in "xy")
    result = thickness_map(
        values * _FACTORS[unit],
        x=x,
        y=y,
        field_of_view=field_of_view,
        pixel_spacing=pixel_spacing,
        layer_extent=array.attrs.get("layer_extent") if layer_extent is None else layer_extent,  # type: ignore[arg-type]
        where=where,
    )
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    result.attrs |= {
        "source": readable_name(path),
        "source_sha256": digest,
        "source_variable": name,
        "source_length_unit": unit,
    }
    return result


def write_thickness_map(thickness: xr.DataArray | xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a thickness map, or the result of :func:`clean_thickness`, as NetCDF.

    Units, coordinates, layer extent and provenance go with it; :func:`read_thickness_map` reads it
    back. An existing file is replaced only once the new one is complete.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    dataset = thickness.to_dataset() if isinstance(thickness, xr.DataArray) else thickness.copy()
    dataset.attrs |= {
        "software": "optical-palpation",
        "software_version": software_version(),
        "axis_order": "(y, x)",
    }
    encoding = {name: {"zlib": True} for name in dataset.data_vars}
    content = dataset.to_netcdf(engine="h5netcdf", encoding=encoding)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _choose(variables: dict[str, Variable], wanted: str | None, path: Path) -> str:
    listing = ", ".join(
        f"{name} ({' x '.join(map(str, array.shape)) or 'scalar'} {array.dtype})"
        for name, array in variables.items()
    )
    if wanted is not None:
        if list(variables) == [""]:
            raise InputError(f"{path} holds one map without a name: leave out variable {wanted!r}")
        if wanted not in variables:
            raise InputError(f"{path} has no variable {wanted!r}; it holds {listing or 'none'}")
        return wanted
    if len(variables) == 1:
        return next(iter(variables))
    fitting = [
        name
        for name, array in variables.items()
        if len(array.shape) == 2
        and array.dtype.kind == "f"
        and min(array.shape) > 1
        and _axis(name) not in ("x", "y")
    ]
    if "thickness" in fitting:
        return "thickness"
    if len(fitting) != 1:
        problem = "more than one array that can be" if fitting else "no array that can be"
        raise InputError(
            f"{path} holds {problem} a thickness map (two-dimensional, floating-point, at least "
            f"2 x 2 pixels): {listing or 'it has no arrays of numbers'}"
            + (". Name one of them as variable" if fitting else "")
        )
    return fitting[0]


def _split_unit(name: str) -> tuple[str, LengthUnit | None]:
    match = re.fullmatch(r"(.*)_(mm|um|µm|μm)", name)
    return (match[1], _UNITS[match[2]]) if match else (name, None)


def _axis(name: str) -> str:
    return _split_unit(name)[0].lower()


def _length_unit(
    name: str, attribute: str | None, given: str | None, where: str
) -> LengthUnit | None:
    """Return the unit that name, attribute and user agree on, None if none of them says one."""
    stated: dict[str, LengthUnit] = {}
    suffix = _split_unit(name)[1]
    if suffix:
        stated["its name"] = suffix
    for origin, text in (("its units attribute", attribute), ("length_unit", given)):
        if text is None:
            continue
        unit = _UNITS.get(text.strip().lower().removesuffix("s"))
        if unit is None:
            raise InputError(f"{where}: {origin} is {text!r}; known units of length are mm and um")
        stated[origin] = unit
    if len(set(stated.values())) > 1:
        says = ", ".join(f"{origin} says {unit}" for origin, unit in stated.items())
        raise InputError(f"{where}: contradicting units of length: {says}")
    return next(iter(stated.values()), None)


def _coordinate(
    variables: dict[str, Variable],
    shape: tuple[int, ...],
    axis: str,
    dims: tuple[str, ...],
    path: Path,
) -> NDArray[np.float64] | None:
    """Pixel centres along an axis in mm, None if the file has none."""
    names = [name for name in variables if _axis(name) == axis]
    own = [name for name in names if name in dims] or names
    if not own:
        return None
    where = f"{path}, variable {own[0]}"
    if len(own) > 1:
        raise InputError(f"{path} has several coordinates along {axis}: {', '.join(own)}")
    array = variables[own[0]]
    count = shape["yx".index(axis)]
    vector = np.empty(0)
    if array.dtype.kind in "fiu" and tuple(n for n in array.shape if n > 1) in ((count,), shape):
        vector = array.values.squeeze()
    if vector.shape == shape:  # a coordinate of every pixel, as meshgrid makes them
        grid = vector if axis == "x" else vector.T
        vector = grid[0] if np.array_equal(grid, np.broadcast_to(grid[0], grid.shape)) else grid
    if vector.shape != (count,):
        raise InputError(
            f"{where} should hold the {axis} coordinates of {count} pixels (the map has "
            f"{shape[0]} rows along y and {shape[1]} columns along x), but its shape is "
            f"{array.shape} and its type {array.dtype}. If it is something else, "
            "store the map in a file of its own"
        )
    unit = _length_unit(own[0], array.unit, None, where) or "mm"
    return vector.astype(np.float64) * _FACTORS[unit]
