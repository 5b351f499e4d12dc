"""The lateral motion of the sample's surface, where it was measured."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import xarray as xr

from optical_palpation.errors import InputError
from optical_palpation.files import readable_name
from optical_palpation.thickness.frames import layer_extent_of
from optical_palpation.volume.contents import Contents, translated_errors
from optical_palpation.volume.labels import attributes_of, labelled
from optical_palpation.volume.masks import apply_masks
from optical_palpation.volume.opening import MAP_READERS, open_contents
from optical_palpation.volume.units import MM, stated_unit

MOTION = ("sample_displacement_x", "sample_displacement_y")
_SOURCE = ("source", "source_sha256")
#: Largest displacement, in widths of the layer; one in um is far beyond.
_LARGEST = 0.25


def read_sample_motion(path: str | os.PathLike[str], *, untrusted: bool = False) -> xr.Dataset:
    """Read the lateral displacement of the sample's surface from a file.

    Parameters
    ----------
    path
        File of any format of thickness maps that holds several arrays with names (NetCDF, MATLAB,
        .npz): ``sample_displacement_x`` and ``sample_displacement_y`` on (y, x), in mm unless their
        ``units`` attribute says another unit, and ``x`` and ``y``, the positions of their pixels,
        likewise. A file of a virtual experiment is one.
    untrusted
        Try an HDF5 file out in a process of its own first, as
        :func:`~optical_palpation.volume.open_volume` does.

    Returns
    -------
    xarray.Dataset
        As :func:`~optical_palpation.palpation.computational_stress` takes it; the attributes name
        ``source`` and ``source_sha256``.

    Raises
    ------
    InputError
        If the file cannot be read or lacks one of the arrays, or these do not fit together.
    """
    path = Path(path)
    reader, contents = open_contents(path, readers=MAP_READERS, untrusted=untrusted)
    with contents, translated_errors(path, reader.FORMAT):
        for name in MOTION:
            if name not in contents.variables:
                held = ", ".join(map(repr, contents.variables)) or "none"
                raise InputError(
                    f"{path} has no variable {name!r}; the motion of the sample needs "
                    f"{', '.join(MOTION)}, x and y. It holds {held}"
                )
        fields = {name: _field(path, contents, name) for name in MOTION}
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return xr.Dataset(fields, attrs={"source": readable_name(path), "source_sha256": digest})


def _field(path: Path, contents: Contents, name: str) -> xr.DataArray:
    variable = contents.variables[name]
    where = f"{path}, variable {name}"
    if variable.dtype.kind not in "fiu":
        raise InputError(f"{where} holds values of type {variable.dtype}, no lengths")
    unit = stated_unit(name, attributes_of(path, contents, name), where) or "mm"
    found = labelled(path, contents, name)
    positions = {}
    for axis, at in found.positions.items():
        if at is None:
            raise InputError(
                f"{path} has no variable {axis!r} with positions in mm (numbers of pixels are "
                f"none); the motion of the sample needs "
                f"{', '.join(MOTION)}, x and y"
            )
        positions[axis] = (axis, at, {"units": "mm"})
    values = found.values.astype(np.float64) * MM[unit]
    apply_masks(path, contents, name, values)
    return xr.DataArray(values, positions, ("y", "x"), attrs={"units": "mm"})


def uniform_motion(loaded: xr.DataArray, strain: float) -> xr.Dataset:
    """Motion of a sample whose surface spreads evenly about the centre of the layer.

    Parameters
    ----------
    loaded
        Loaded thickness, on whose pixels the motion is given.
    strain
        How much longer lines on the surface become, 0.1 for 10 %; measured between two landmarks,
        say. A sample that keeps its volume and is compressed evenly by a share e of its thickness
        spreads by (1 - e)^(-1/2) - 1.

    Raises
    ------
    InputError
        If `strain` is no number above -0.5 and below 1.
    """
    if not -0.5 < strain < 1.0:
        raise InputError(
            f"the sample spreads by a strain above -0.5 and below 1, not {strain!r} (0.1 is 10 %)"
        )
    x0, x1, y0, y1 = layer_extent_of(loaded)
    x, y = loaded["x"], loaded["y"]
    share = strain / (1 + strain)  # of the position under load
    flat = xr.zeros_like(loaded, dtype=float).drop_attrs(deep=False).transpose("y", "x")
    parts = share * (x - 0.5 * (x0 + x1)), share * (y - 0.5 * (y0 + y1))
    return xr.Dataset(
        {
            name: (flat + part).assign_attrs(units="mm")
            for name, part in zip(MOTION, parts, strict=True)
        }
    )


def match_sample_motion(motion: xr.Dataset, loaded: xr.DataArray) -> xr.DataArray:
    """Check the motion of the sample and put it on the pixels of the loaded thickness.

    Parameters
    ----------
    motion
        ``sample_displacement_x`` and ``sample_displacement_y`` in mm on ``(y, x)``: how far the
        point of the sample's surface that is at (x, y) under load has moved sideways since the
        layer was unloaded. It must cover the extent of the layer; beyond its last pixels the
        surface moves as these do.
    loaded
        Loaded thickness, mm, on ``(y, x)``.

    Returns
    -------
    xarray.DataArray
        The displacement in mm on ``(component, y, x)``, component x and y, coordinates those of
        `loaded`. The attributes are for the record of a result.

    Raises
    ------
    InputError
        If a component, a coordinate or a value is missing, if the layer is not covered, or if the
        displacement cannot be that of a surface (because it is in um, say).
    """
    if not isinstance(motion, xr.Dataset) or not set(MOTION) <= set(motion.data_vars):
        raise InputError(
            f"sample_motion: an xarray.Dataset of {' and '.join(MOTION)}, mm on "
            f"(y, x); found {_content(motion)}"
        )
    motion = motion[list(MOTION)]
    for name, field in motion.items():
        if set(field.dims) != {"y", "x"} or not {"y", "x"} <= set(field.coords):
            raise InputError(
                f"{name} has the dimensions (y, x) with coordinates in mm; found dimensions "
                f"{field.dims} with coordinates {tuple(field.coords)}"
            )
        for part in (field, field["x"], field["y"]):
            unit = stated_unit("", part.attrs, str(part.name))
            if unit not in (None, "mm"):
                raise InputError(f"{part.name} is in {unit}: give it in mm")
    motion = motion.transpose("y", "x").sortby(["y", "x"])
    check_motion(motion, layer_extent_of(loaded))
    at = {}
    for axis in "xy":
        positions = motion[axis].values
        at[axis] = np.clip(loaded[axis].values, positions[0], positions[-1])
    attrs = {f"sample_motion_{key}": v for key, v in motion.attrs.items() if key in _SOURCE}
    matched = motion.interp(at).to_array("component").assign_coords(x=loaded["x"], y=loaded["y"])
    largest = np.sqrt((matched**2).sum("component")).max()
    matched.attrs = attrs | {"sample_motion_largest_mm": float(largest)}
    return matched


def check_motion(motion: xr.Dataset, extent: tuple[float, float, float, float]) -> None:
    """Refuse a motion of the sample that does not cover a layer, or is none of its surface.

    Parameters
    ----------
    motion
        As for :func:`match_sample_motion`.
    extent
        x0, x1, y0, y1 of the layer, mm.

    Raises
    ------
    InputError
        With the axis, the numbers, and what may have happened.
    """
    for name, field in motion.items():
        if not np.isfinite(field.values).all():
            raise InputError(
                f"{name} has {int((~np.isfinite(field.values)).sum())} missing or infinite values: "
                "fill them first, smoothly"
            )
    x0, x1, y0, y1 = extent
    slack = 1e-6 * max(x1 - x0, y1 - y0)
    for axis, low, high in (("x", x0, x1), ("y", y0, y1)):
        positions = np.sort(motion[axis].values)
        steps = np.diff(positions)
        if not (positions.size > 1 and np.isfinite(positions).all() and (steps > 0).all()):
            raise InputError(
                f"the {axis} coordinates of the motion of the sample must rise or fall"
            )
        if low - positions[0] < -slack or high - positions[-1] > slack:
            raise InputError(
                f"the motion of the sample spans {axis} {positions[0]:g} to {positions[-1]:g} mm "
                f"and does not cover the layer, {low:g} to {high:g} mm"
            )
        largest = float(np.abs(motion[f"sample_displacement_{axis}"]).max())
        if largest > _LARGEST * (high - low):
            raise InputError(
                f"sample_displacement_{axis} is up to {largest:.3g} mm, more than a quarter of the "
                f"layer's width of {high - low:g} mm. Is it in um, or has it outliers?"
            )


def _content(motion: object) -> str:
    if isinstance(motion, xr.Dataset):
        return f"a Dataset of {', '.join(map(str, motion.data_vars)) or 'nothing'}"
    return f"{type(motion).__name__}"
