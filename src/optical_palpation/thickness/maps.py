"""Reading and writing thickness maps."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.arguments import explained, file_path
from optical_palpation.errors import InputError
from optical_palpation.files import netcdf, readable_name, replacing
from optical_palpation.runtime import software_version
from optical_palpation.thickness.frames import (
    check_kind,
    checked_heights,
    checked_values,
    map_on_grid,
    thickness_map,
)
from optical_palpation.volume import zarr_store
from optical_palpation.volume.contents import Contents, Variable, translated_errors
from optical_palpation.volume.labels import attributes_of, axis_of, labelled
from optical_palpation.volume.masks import apply_masks, is_mask
from optical_palpation.volume.opening import MAP_READERS, open_contents
from optical_palpation.volume.units import MM, stated_unit


@explained
def read_thickness_map(
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    length_unit: str | None = None,
    field_of_view: Sequence[float] | None = None,
    pixel_spacing: Sequence[float] | None = None,
    layer_extent: Sequence[float] | None = None,
    untrusted: bool = False,
) -> xr.DataArray:
    """Read a thickness map from a file of any format that people keep them in.

    The format is told from the content. Lengths in the file are mm unless a suffix of the
    variable's name (``L1_um``), its attribute ``units`` (or ``unit``) or `length_unit` says
    otherwise. Dimensions and coordinates named x and y say how the map lies; where nothing does,
    rows are y and columns are x.

    Missing are pixels that are NaN, that the file marks by a fill value or a valid range, that were
    never written, or that a variable ``filled`` of the same file marks: their values were made up
    and not measured.

    Parameters
    ----------
    path
        MATLAB .mat (v5 to v7.3), .npy, .npz, .csv or .txt, floating-point .tif, NetCDF, HDF5; any
        format of :func:`~optical_palpation.volume.open_volume` that holds such a map.
    variable
        Name of the map in the file; may be left out when exactly one array of the file can be one
        (two dimensions, floating-point, at least 2 x 2), or one of these is called ``thickness``.
    length_unit
        ``"mm"`` or ``"um"`` (or nm, cm, m), the unit of the thickness values in the file.
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
    untrusted
        Try an HDF5 file out in a process of its own first, as ``open_volume`` does.

    Returns
    -------
    xarray.DataArray
        ``loaded_thickness`` in mm on ``(y, x)``, coordinates ascending in mm, NaN where missing.
        The attributes record the source, its SHA-256 hash, variable and unit, ``layer_extent``
        and ``missing_share`` (0 to 1, of the pixels in that extent).

    Raises
    ------
    InputError
        If the file cannot be read, holds no such map or more than one, if the map has a wrong
        shape or type, infinite, zero or negative values, marks of missing pixels that nothing
        declares as such, or less than half of the layer measured, and if labels, unit, field of
        view, spacing, coordinates, mask and layer extent are missing or contradict each other.
    """
    found = _read(file_path(path), variable, length_unit, untrusted, checked_values)
    coordinates = found.coordinates
    if field_of_view is None and pixel_spacing is None:
        coordinates = coordinates or found.stated
    stated = found.attrs.get("layer_extent") if layer_extent is None else layer_extent
    result = thickness_map(
        found.values,
        **coordinates,  # type: ignore[arg-type]
        field_of_view=field_of_view,
        pixel_spacing=pixel_spacing,
        layer_extent=stated,  # type: ignore[arg-type]
        where=found.where,
    )
    _check_spacing(result, found)
    result.attrs |= dict(found.source)
    return result


def read_height_map(
    path: str | os.PathLike[str], *, variable: str | None = None, untrusted: bool = False
) -> xr.DataArray:
    """Read a map of heights, which may be negative, from a file with coordinates.

    Parameters
    ----------
    path, variable, untrusted
        As for :func:`read_thickness_map`.

    Returns
    -------
    xarray.DataArray
        ``height`` in mm on ``(y, x)``, coordinates ascending in mm, NaN where missing.

    Raises
    ------
    InputError
        As :func:`read_thickness_map`, or if the file has no coordinates.
    """
    found = _read(Path(path), variable, None, untrusted, checked_heights)
    result = map_on_grid(
        found.values,
        **(found.coordinates or found.stated),  # type: ignore[arg-type]
        where=found.where,
    )
    return result.rename("height").assign_attrs(units="mm", **found.source)


@dataclass(frozen=True)
class _Found:
    """A map of a file: values [y, x] and coordinates in mm, by variables or by the format."""

    values: NDArray[np.float64]
    coordinates: dict[str, NDArray[np.float64]]
    stated: dict[str, NDArray[np.float64]]
    attrs: Mapping[str, object]
    where: str
    source: Mapping[str, object]


def _read(
    path: Path,
    variable: str | None,
    length_unit: str | None,
    untrusted: bool,
    checked: Callable[[NDArray, str], NDArray[np.float64]],
) -> _Found:
    if os.path.isdir(path) and not zarr_store.recognises(path, b""):
        raise InputError(f"{path} is a directory; give one file")
    reader, contents = open_contents(path, variable, readers=MAP_READERS, untrusted=untrusted)
    with contents, translated_errors(path, reader.FORMAT):
        contents.variables = {key: array.as_map() for key, array in contents.variables.items()}
        name = _choose(contents, variable, path)
        where = f"{path}, variable {name}" if name else str(path)
        array = contents.variables[name]
        attrs = attributes_of(path, contents, name)
        unit = stated_unit(name, attrs, where, length_unit)
        if unit is None and contents.unclear_unit:
            raise InputError(contents.unclear_unit)
        unit = unit or "mm"
        check_kind(array.shape, array.dtype, where)
        found = labelled(path, contents, name)
        values = found.values.astype(np.float64)
        apply_masks(path, contents, name, values)
        values = checked(values, where)
    coordinates = {axis: at for axis, at in found.positions.items() if at is not None}
    if path.is_file():
        with path.open("rb") as file:
            digest = {"source_sha256": hashlib.file_digest(file, "sha256").hexdigest()}
    else:
        digest = {}
    source = {"source": readable_name(path), **digest}
    source |= {"source_variable": name, "source_length_unit": unit}
    stated = _stated(array, found.order, values.shape, where)
    return _Found(values * MM[unit], coordinates, stated, array.attrs, where, source)


def _stated(
    array: Variable, order: tuple[str, ...], shape: tuple[int, ...], where: str
) -> dict[str, NDArray[np.float64]]:
    """Coordinates from the spacing that the format states, as ImageJ and NIfTI do, if it does."""
    steps, starts = array.stated.spacing, array.stated.origin or (0.0, 0.0)
    if steps is None or len(steps) != 2 or len(starts) != 2:
        return {}
    found = {}
    for axis, n in zip("yx", shape, strict=True):
        at = order.index(axis)
        step = steps[at]
        if step is None:
            return {}
        if not (np.isfinite(step) and step > 0.0 and np.isfinite(starts[at])):
            raise InputError(f"{where}: the file states a spacing of {step:g} mm along {axis}")
        found[axis] = starts[at] + step * np.arange(n, dtype=np.float64)
    return found


def _check_spacing(map_: xr.DataArray, found: _Found) -> None:
    for axis, positions in found.stated.items():
        step = positions[1] - positions[0]
        actual = float(np.ptp(map_[axis].values)) / (map_.sizes[axis] - 1)
        if abs(actual - step) > 1e-4 * step:
            raise InputError(
                f"{found.where}: the file states a pixel spacing of {step:g} mm along {axis}, what "
                f"is given makes it {actual:g} mm (the field of view is the distance between the "
                "centres of the first and the last pixel)"
            )


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
    content = netcdf(dataset, encoding=encoding)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _choose(contents: Contents, wanted: str | None, path: Path) -> str:
    variables = contents.variables
    described = {
        name: f"{name} ({' x '.join(map(str, array.shape)) or 'scalar'} {array.dtype})"
        for name, array in variables.items()
    }
    listing = ", ".join(described.values())
    if wanted is not None:
        if list(variables) == [""]:
            raise InputError(f"{path} holds one map without a name: leave out variable {wanted!r}")
        if wanted not in variables:
            raise InputError(
                f"{path} has no variable {wanted!r}; it holds {listing or 'none'}"
                + contents.passed_over()
            )
        return wanted
    if len(variables) == 1:
        return next(iter(variables))
    fitting = [
        name
        for name, array in variables.items()
        if len(array.shape) == 2
        and array.dtype.kind == "f"
        and min(array.shape) > 1
        and axis_of(name) not in ("x", "y")
        and not is_mask(name)
    ]
    if "thickness" in fitting:
        return "thickness"
    at_root = [name for name in fitting if "/" not in name]
    fitting = at_root or fitting
    if len(fitting) != 1:
        if fitting:
            raise InputError(
                f"{path} holds more than one array that can be a thickness map: "
                f"{', '.join(described[name] for name in fitting)}. "
                "Name one of them as variable (--variable)"
            )
        raise InputError(
            f"{path} holds no array that can be a thickness map (two-dimensional, floating-point, "
            f"at least 2 x 2 pixels): {listing or 'it has no arrays of numbers'}"
            + contents.passed_over()
        )
    return fitting[0]
