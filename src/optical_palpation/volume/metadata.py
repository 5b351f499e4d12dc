"""What is known about a volume, and the rules by which it is put together.

A fact comes from the file or from the user, and the user wins. A missing fact is asked for, never
guessed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args
from xml.etree import ElementTree

import numpy as np

from ..errors import InputError
from .axes import axes_of_text

Scale = Literal["linear", "amplitude", "intensity", "dB"]
Access = Literal["mapped", "streamed", "loaded"]

# mm: from less than a coherence length to more than any range or scanning lens.
_EXTENT = (1e-3, 200.0)
# Largest ratio of lateral to axial spacing, either way; 1000 is that of um to mm.
_ANISOTROPY = 500.0

#: Entries by which array formats can describe their array.
DESCRIPTIONS = ("axes", "spacing_mm", "origin_mm", "scale", "refractive_index")


class ZYX(NamedTuple):
    """One number per axis, in mm."""

    z: float
    y: float
    x: float


@dataclass(frozen=True)
class VolumeMetadata:
    """What a volume is.

    Attributes
    ----------
    shape
        Numbers of samples along z, y and x, whatever the order in the file.
    axes
        Order of the axes in the file, slowest first as the format counts them, for example
        ``"yxz"``; without ``y`` for a single B-scan.
    spacing
        Physical distance between samples in mm; NaN along y for a single B-scan.
    scale
        ``"linear"`` (``"amplitude"`` or ``"intensity"``, where that is known) or ``"dB"``.
    refractive_index
        The index by which the stored optical depth was divided to give ``spacing.z``;
        None where the stored depth was taken as physical.
    origin
        Position of the first sample in mm.
    dtype
        Type of the stored samples.
    path, format
        The file (or folder) and its format.
    access
        ``"mapped"``: only the samples asked for are read. ``"streamed"``: whole pages or
        chunks are decoded, those of the B-scan asked for. ``"loaded"``: the format
        forces the whole volume into memory.
    """

    shape: tuple[int, int, int]
    axes: str
    spacing: ZYX
    scale: Scale
    refractive_index: float | None
    origin: ZYX
    dtype: str
    path: Path
    format: str
    access: Access

    @property
    def is_complex(self) -> bool:
        """Whether the samples are complex (amplitude and phase)."""
        return self.dtype.lstrip("<>=|").startswith("c")


@dataclass(frozen=True)
class Stated:
    """What a file says about its array. One entry per axis of the array, None where it is silent.

    ``described`` marks what its author wrote into it: a format whose images are taken for B-scans
    does not know that they are. ``optical_depth`` marks formats whose depth is an optical path, so
    that the refractive index must be known. ``index_applied`` is the index by which the depth was
    divided before it was written, as :meth:`Volume.to_xarray` records it. ``no_axes`` says why a
    format that has axes does not state them here.
    """

    axes: str | None = None
    spacing: tuple[float | None, ...] | None = None
    origin: tuple[float, ...] | None = None
    scale: Scale | None = None
    refractive_index: float | None = None
    optical_depth: bool = False
    described: bool = False
    index_applied: str | None = None
    no_axes: str | None = None


def described(entries: Mapping[str, Any], where: str) -> Stated:
    """Read the entries by which array formats can describe their array.

    ``axes`` (text, or a list of names), ``spacing_mm`` and ``origin_mm`` (one number per axis, in
    that order), ``scale`` and ``refractive_index``. Used for HDF5 and Zarr attributes, variables of
    ``.npz`` and ``.mat`` files and sidecars of raw files.
    """
    spacing, origin = (
        _numbers(entries.get(k), f"{where}: {k}") for k in ("spacing_mm", "origin_mm")
    )
    index = _numbers(entries.get("refractive_index"), f"{where}: refractive_index")
    if index is not None and len(index) != 1:
        raise InputError(f"{where}: refractive_index must be one number, not {len(index)}")
    names = np.atleast_1d(np.asarray(entries.get("axes", ())))
    if names.size > 10:
        raise InputError(f"{where}: axes {_otherwise('yx')}")
    # as arrays of one: NumPy makes no str of broken ones
    axes = [_text(name, f"{where}: axes", "yx") or "" for name in names.reshape(-1, 1)]
    return Stated(
        axes=axes_of_text(axes) if axes else None,
        spacing=spacing,
        origin=origin,
        scale=_scale(_text(entries.get("scale"), f"{where}: scale", "linear"), where),
        refractive_index=index[0] if index else None,
        described=True,
    )


def settle(
    stated: Stated,
    *,
    shape: tuple[int, ...],
    dtype: str,
    path: Path,
    fmt: str,
    access: Access,
    axes: str | None,
    spacing: Mapping[str, float] | None,
    scale: str | None,
    refractive_index: float | None,
    origin: Mapping[str, float] | None,
) -> VolumeMetadata:
    """Join what the file states and what the user gives.

    Raises
    ------
    InputError
        For a fact that is missing (all of them are named) or impossible.
    """
    missing: list[str] = []
    order = axes if axes is not None else stated.axes
    if order is None:
        why = f"; {stated.no_axes}" if stated.no_axes else ""
        missing.append(
            f"axes (order of the {len(shape)} axes {shape}, such as 'zyx' or 'yzx'{why})"
        )
    else:
        order = _check_axes(order, shape, path)

    steps: dict[str, float] = {}
    starts: dict[str, float] = {}
    if order is not None:
        for values, facts, name in (
            (stated.spacing, steps, "spacing"),
            (stated.origin, starts, "origin"),
        ):
            if values is not None:
                if len(values) != len(shape):
                    raise InputError(
                        f"{path}: {name} has {len(values)} values for {len(shape)} axes"
                    )
                facts |= {a: v for a, v in zip(order, values, strict=True) if v is not None}
    steps |= _by_axis(spacing, "spacing")
    given_starts = _by_axis(origin, "origin")
    needed = "zyx" if order is None or "y" in order else "zx"
    if absent := [a for a in needed if a not in steps]:
        missing.append(f"spacing (mm along {', '.join(absent)})")

    final_scale = _scale(scale, str(path)) or stated.scale
    if dtype.lstrip("<>=|").startswith("c"):
        final_scale = final_scale or "linear"
        if final_scale == "dB":
            raise InputError(f"{path}: complex samples cannot be in dB: their scale is 'linear'")
    if final_scale is None:
        missing.append("scale ('linear' or 'dB')")

    index = refractive_index if refractive_index is not None else stated.refractive_index
    depth_given = spacing is not None and "z" in spacing
    if index is None and stated.optical_depth and not depth_given:
        missing.append(
            "refractive_index (the file stores optical path length; 1.0 keeps it undivided)"
        )
    if missing or order is None or final_scale is None:
        raise InputError(
            f"{path} ({fmt}) does not say: {'; '.join(missing)}. Give what it does not say."
        )
    real = isinstance(index, int | float | np.number)
    if index is not None and not (real and 1.0 <= index <= 4.0):
        raise InputError(f"{path}: refractive index {index!r} is not between 1 and 4")
    if not depth_given and (index or 1.0) != 1.0 and is_physical(stated.index_applied):
        raise InputError(
            f"{path}: its depth was divided by the refractive index {stated.index_applied} before "
            f"it was written (refractive_index_applied), and would be divided by {index} once "
            "more: give 1.0, which keeps it, or open the volume that this one was made from"
        )
    for axis, value in steps.items():
        if not (math.isfinite(value) and 1e-7 <= value <= 100.0):
            raise InputError(
                f"{path}: spacing along {axis} is {value!r} mm; it must lie between 1e-7 and 100 mm"
            )
    lengths = dict(zip(order, shape, strict=True))
    _check_extents({a: steps[a] for a in needed}, lengths, path)
    if "z" in starts:
        starts["z"] /= index or 1.0  # an optical path as well
    starts |= given_starts
    for axis, value in starts.items():
        if not (math.isfinite(value) and abs(value) <= 1e5):
            raise InputError(f"{path}: origin along {axis} is {value!r} mm")
    return VolumeMetadata(
        shape=(lengths["z"], lengths.get("y", 1), lengths["x"]),
        axes=order,
        spacing=ZYX(steps["z"] / (index or 1.0), steps.get("y", math.nan), steps["x"]),
        scale=final_scale,
        refractive_index=index,
        origin=ZYX(*(starts.get(a, 0.0) for a in "zyx")),
        dtype=dtype,
        path=path,
        format=fmt,
        access=access,
    )


def is_physical(index_applied: str | None) -> bool:
    """Tell whether a depth by which this index was divided, if any, is no optical path."""
    try:
        return index_applied is not None and float(index_applied) != 1.0
    except ValueError:
        return True  # by something that is no number


def _check_extents(steps: dict[str, float], lengths: dict[str, int], path: Path) -> None:
    """Refuse spacings with which the volume would be larger or flatter than OCT can image."""
    for axis, step in steps.items():
        n = lengths[axis]
        if n > 1 and not _EXTENT[0] <= n * step <= _EXTENT[1]:
            raise InputError(
                f"{path}: {n} samples {step:g} mm apart along {axis} make {n * step:g} mm, which "
                "no OCT volume is; is the spacing in another unit? It must be in mm"
            )
    for axis in steps:
        ratio = steps[axis] / steps["z"]
        if not 1.0 / _ANISOTROPY <= ratio <= _ANISOTROPY:
            raise InputError(
                f"{path}: the spacing along {axis} is {ratio:.3g} times that along z; are they in "
                "different units? Both must be in mm"
            )


def parse_xml(data: bytes, where: str) -> ElementTree.Element:
    """Parse XML that may be hostile: no document type, hence no entities to expand."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    text = text.rstrip("\x00")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{where}: has a document type declaration, which no OCT header needs")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{where}: is not well-formed XML ({error})") from error


def _check_axes(axes: object, shape: tuple[int, ...], path: Path) -> str:
    letters = axes.lower() if isinstance(axes, str) else ""
    if sorted(letters) not in (sorted("zyx"), sorted("zx")):
        raise InputError(f"{path}: axes {axes!r} must be an order of z, y, x (or of z, x)")
    if len(letters) != len(shape):
        raise InputError(f"{path}: axes {axes!r} for an array of {len(shape)} axes {shape}")
    return letters


def _by_axis(values: Mapping[str, float] | None, name: str) -> dict[str, float]:
    if values is None:
        return {}
    if not isinstance(values, Mapping) or not set(values) <= set("zyx"):
        raise InputError(
            f"{name}= must map axes to mm, e.g. {{'z': 0.0035, 'y': 0.01}}: {values!r}"
        )
    try:
        return {axis: float(value) for axis, value in values.items()}
    except (TypeError, ValueError):
        raise InputError(f"{name}= must hold numbers in mm: {values!r}") from None


def _scale(value: object, where: str) -> Scale | None:
    if value is None:
        return None
    for known in get_args(Scale):
        if isinstance(value, str) and value.lower() == known.lower():
            return known
    raise InputError(f"{where}: scale {value!r} is neither 'linear' nor 'dB'")


def _otherwise(example: str) -> str:
    return (
        f"must be a short text such as {example!r}; give an array that means something else "
        "another name, or leave it out"
    )


def _text(value: Any, where: str, example: str) -> str | None:
    """Text from a str, bytes, or the 0-d or 1-element arrays that file formats make of it."""
    if value is None:
        return None
    array = np.asarray(value)
    otherwise = InputError(f"{where} {_otherwise(example)}")
    if array.size != 1 or array.dtype.itemsize > 400:
        raise otherwise
    # NumPy makes strings, broken ones, of numbers that are no characters.
    if array.dtype.kind == "U":
        codes = np.frombuffer(array.tobytes(), array.dtype.str[0] + "u4")
        if codes.max(initial=0) > 0x10FFFF:
            raise InputError(f"{where} is no text")
    value = array.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if not isinstance(value, str) or len(value) > 100:
        raise otherwise
    return value


def _numbers(value: Any, where: str) -> tuple[float, ...] | None:
    if value is None:
        return None
    array = np.asarray(value)
    if array.dtype.kind not in "iuf" or array.size > 10:
        raise InputError(f"{where} must be a few real numbers")
    return tuple(float(v) for v in array.ravel())
