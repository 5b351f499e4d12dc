"""The open volume: metadata, and B-scans on demand."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from optical_palpation.files import readable_name

from ..errors import InputError
from .arrays import (
    MAX_BSCAN_BYTES,
    MAX_LOADED_BYTES,
    Array,
    FileArray,
    LazyArray,
    check_array,
    nbytes,
)
from .contents import Contents, Variable, translated_errors
from .labels import coordinate
from .metadata import Stated, VolumeMetadata, is_physical, settle
from .units import MM, is_unit_key, split_unit

# What is read at once where B-scans cut across the order of the file.
_SLAB_BYTES = 64 * 2**20
# By how much two statements of it may differ, relatively.
_SAME_SPACING = 1e-2
_INDEX_APPLIED = "refractive_index_applied"


class Volume:
    """An OCT volume that is read B-scan by B-scan.

    Open it with :func:`open_volume`; use it as a context manager, or call :meth:`close`. Not for
    several threads at once.
    """

    def __init__(
        self, variable: Variable, path: Path, fmt: str, close: Callable[[], None], **given: Any
    ) -> None:
        check_array(variable.shape, variable.dtype, str(path))
        array = variable.open()
        self._close = close
        stated = variable.stated
        if (applied := variable.attrs.get(_INDEX_APPLIED)) is not None:
            stated = replace(stated, index_applied=str(applied))
        access = variable.access
        if access is None:
            access = "mapped" if isinstance(array, FileArray) else "loaded"
        # Settled twice: the axes decide whether the pages are B-scans.
        metadata = settle(
            stated,
            shape=array.shape,
            dtype=array.dtype.str,
            path=path,
            fmt=fmt,
            access=access,
            **given,
        )
        nz, _, nx = metadata.shape
        self._dtype = np.dtype(np.complex64 if metadata.is_complex else np.float32)
        bscan_bytes = nz * nx * max(self._dtype.itemsize, array.dtype.itemsize)
        if bscan_bytes > MAX_BSCAN_BYTES:
            raise InputError(
                f"{path}: a B-scan of {nz} x {nx} samples needs {bscan_bytes} bytes, more than "
                f"the limit of {MAX_BSCAN_BYTES}; are the axes ({metadata.axes}) right?"
            )
        y_chunk = array.chunks[metadata.axes.index("y")] if "y" in metadata.axes else 1
        if not array.random_access and y_chunk > 1:
            array = _loaded(array, path)
            metadata = VolumeMetadata(**{**vars(metadata), "access": "loaded"})
            y_chunk = 1
        self._array = array
        self._slab_length = max(1, min(y_chunk, _SLAB_BYTES // bscan_bytes))
        self._slab: tuple[int, NDArray[Any]] | None = None
        self._open = True
        self.metadata = metadata
        index = metadata.refractive_index
        if "z" not in (given.get("spacing") or {}) and is_physical(stated.index_applied):
            self._index_applied = stated.index_applied
        else:
            self._index_applied = None if index is None else str(index)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of samples along z, y and x."""
        return self.metadata.shape

    def __len__(self) -> int:
        return self.shape[1]

    def __repr__(self) -> str:
        m = self.metadata
        return (
            f"Volume({m.path.name!r}, {m.format}, [z, y, x] = {m.shape}, {m.spacing} mm, {m.scale})"
        )

    def bscan(self, y: int) -> NDArray[Any]:
        """Read one B-scan.

        Parameters
        ----------
        y
            Index of the B-scan, from 0.

        Returns
        -------
        ndarray, shape (z, x)
            A copy, float32, or complex64 where the file is complex.

        Raises
        ------
        InputError
            If there is no such B-scan or its samples cannot be read.
        """
        ny = self.shape[1]
        if not 0 <= y < ny:
            raise InputError(f"{self.metadata.path}: no B-scan {y}; there are {ny} (0 to {ny - 1})")
        if self._slab is None or not 0 <= y - self._slab[0] < self._slab[1].shape[1]:
            start = y - y % self._slab_length
            stop = min(ny, start + self._slab_length)
            self._slab = None  # freed before the next is read
            self._slab = start, self._read(slice(None), slice(start, stop), slice(None))
        start, slab = self._slab
        return slab[:, y - start].astype(self._dtype, order="C", copy=True)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        for y in range(len(self)):
            yield self.bscan(y)

    def to_xarray(self) -> xr.DataArray:
        """Return the volume as a lazy ``DataArray`` (z, y, x), coordinates in mm.

        Samples are read when they are used: select first, then call ``.values`` or ``.load()``.
        The volume must stay open as long.
        """
        m = self.metadata
        coords = {}
        for axis, n, step, start in zip("zyx", m.shape, m.spacing, m.origin, strict=True):
            positions = start + (step * np.arange(n) if n > 1 else np.zeros(1))
            coords[axis] = (axis, positions, {"units": "mm"})
        lazy = indexing.LazilyIndexedArray(_Backend(self))
        variable = xr.Variable(("z", "y", "x"), lazy)
        attrs = {
            "long_name": "OCT signal",
            "units": "dB" if m.scale == "dB" else "1",
            "scale": m.scale,
            "source": readable_name(m.path),
            "source_format": m.format,
            "source_axes": m.axes,
        }
        if self._index_applied is not None:
            # Not "refractive_index": that would ask a reader to divide the depth once more.
            attrs[_INDEX_APPLIED] = self._index_applied
        return xr.DataArray(variable, coords=coords, name="volume", attrs=attrs)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the file, or of the names and contents of a folder's files; hex."""
        path = self.metadata.path
        with translated_errors(path, self.metadata.format):
            if path.is_file():
                with path.open("rb") as stream:
                    return hashlib.file_digest(stream, "sha256").hexdigest()
            total = hashlib.sha256()
            for file in sorted(p for p in path.rglob("*") if p.is_file()):
                with file.open("rb") as stream:
                    content = hashlib.file_digest(stream, "sha256").hexdigest()
                total.update(f"{file.relative_to(path).as_posix()}\0{content}\n".encode())
            return total.hexdigest()

    def close(self) -> None:
        """Close the file. Further reading raises InputError."""
        if self._open:
            self._open = False
            self._slab = None
            self._close()

    def __enter__(self) -> Volume:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _read(self, z: slice, y: slice, x: slice) -> NDArray[Any]:
        """Read a block [z, y, x] of this volume in its own type of sample."""
        m = self.metadata
        if not self._open:
            raise InputError(f"{m.path}: the volume is closed")
        parts = {"z": z, "y": y, "x": x}
        with translated_errors(m.path, m.format):
            block = self._array[tuple(parts[a] for a in m.axes)]
        if "y" not in m.axes:
            only = range(1)[y]
            block = block[..., np.newaxis][..., : len(only)]
        order = m.axes if "y" in m.axes else m.axes + "y"
        block = block.transpose(*(order.index(a) for a in "zyx"))
        with np.errstate(over="ignore", invalid="ignore"):
            return block.astype(self._dtype, copy=False)


class _Backend(BackendArray):
    """Lets xarray read parts of a volume when they are asked for."""

    def __init__(self, volume: Volume) -> None:
        self._volume = volume
        self.shape = volume.shape
        self.dtype = volume._dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._block
        )

    def _block(self, key: tuple[int | slice, ...]) -> NDArray[Any]:
        whole: list[slice] = []
        inner: list[int | slice] = []
        for part, n in zip(key, self.shape, strict=True):
            if isinstance(part, slice):
                span = range(n)[part]
                low, high = (min(span), max(span) + 1) if len(span) else (0, 0)
                whole.append(slice(low, high))
                inner.append(slice(None, None, span.step))
            else:
                index = range(n)[part]
                whole.append(slice(index, index + 1))
                inner.append(0)
        return self._volume._read(*whole)[tuple(inner)]


def chosen(path: Path, contents: Contents, name: str | None) -> Variable:
    """Choose the array that the user names, or the only one with three axes (else with two).

    Where the file names its axes z, y and x, they and their coordinates describe it.
    """
    name = name.strip("/") if name is not None else None
    variables = contents.variables
    if name is not None and list(variables) != [""]:
        if name not in variables:
            raise InputError(
                f"{path}: no array {name!r}; it holds {', '.join(list(variables)[:20]) or 'none'}"
                + contents.passed_over()
            )
        return _described(path, contents, name)
    for axes in (3, 2):
        found = [n for n, v in variables.items() if len(v.shape) == axes and min(v.shape) > 1]
        if len(found) == 1:
            return _described(path, contents, found[0])
        if found:
            raise InputError(
                f"{path}: holds several arrays; choose one by variable (on the command line "
                f"--variable): {', '.join(found[:20])}"
            )
    if len(variables) == 1:
        (only,) = variables
        if not contents.unread or any(n != 1 for n in variables[only].shape):
            return _described(path, contents, only)
    inside = ", ".join(f"{name} {v.shape}" for name, v in list(variables.items())[:20])
    raise InputError(
        f"{path}: no array with three axes; it holds {inside or 'none'}{contents.passed_over()}"
    )


def _described(path: Path, contents: Contents, name: str) -> Variable:
    variable = contents.variables[name]
    axes = "".join(split_unit(dim)[0].lower() for dim in variable.dims)
    stated = variable.stated
    unit = next((str(v).strip().lower() for k, v in variable.attrs.items() if is_unit_key(k)), "")
    if unit in ("db", "decibel", "decibels"):
        if stated.scale not in (None, "dB"):
            raise InputError(
                f"{path}, variable {name}: its scale is said to be {stated.scale}, its unit "
                f"{unit}; leave the true one"
            )
        stated = replace(stated, scale="dB")
        variable = replace(variable, stated=stated)
    named = sorted(axes) in (["x", "y", "z"], ["x", "z"])
    if named and stated.axes is not None and stated.axes.lower() != axes:
        raise InputError(
            f"{path}, variable {name}: its axes are said to be {stated.axes}, but its dimensions "
            f"are ({', '.join(variable.dims)})"
        )
    if not named:
        return variable
    if stated.spacing is not None:
        stated = replace(stated, axes=axes)
        _check_spacing(path, contents, name, stated)
        return replace(variable, stated=stated)
    spacing: list[float | None] = []
    origin = []
    for axis, n in zip(axes, variable.shape, strict=True):
        found = coordinate(path, contents, name, axis)
        if found is None or found.unit is None or found.values.shape != (n,):
            return replace(variable, stated=replace(stated, axes=axes))
        steps = np.diff(found.values) * MM[found.unit]
        if len(steps) and not np.allclose(steps, steps.mean(), rtol=1e-3, atol=0):
            raise InputError(f"{path}, variable {name}: coordinate {axis} is not evenly spaced")
        if len(steps) and steps.mean() <= 0.0:
            raise InputError(
                f"{path}, variable {name}: coordinate {axis} falls; turn the array around"
            )
        spacing.append(steps.mean() if len(steps) else None)
        origin.append(found.values[0] * MM[found.unit])
    stated = replace(stated, axes=axes, spacing=tuple(spacing), origin=tuple(origin))
    return replace(variable, stated=stated)


def _check_spacing(path: Path, contents: Contents, name: str, stated: Stated) -> None:
    """Refuse coordinates that lie at another distance than the spacing that is stated."""
    for axis, n, spacing in zip(
        stated.axes or "", contents.variables[name].shape, stated.spacing or (), strict=False
    ):
        try:
            found = coordinate(path, contents, name, axis)
        except InputError:  # nothing that could be compared
            continue
        if n < 2 or not spacing or found is None or not found.unit or found.values.shape != (n,):
            continue
        step = (found.values[-1] - found.values[0]) / (n - 1) * MM[found.unit]
        index = (stated.refractive_index if axis == "z" else None) or 1.0
        # a coordinate may have been divided by the index already
        if not any(np.isclose(step * by, spacing, rtol=_SAME_SPACING) for by in (1.0, index)):
            raise InputError(
                f"{path}, variable {name}: its spacing along {axis} is said to be {spacing:g} mm, "
                f"but its coordinate {found.name} has steps of {step:g} mm; leave the true one"
            )


def _loaded(array: Array, path: Path) -> Array:
    size = nbytes(array.shape, array.dtype)
    if size > MAX_LOADED_BYTES:
        raise InputError(
            f"{path}: its compressed pages are not B-scans, so the {size} bytes would have to be "
            f"loaded whole; the limit is {MAX_LOADED_BYTES}. Save it uncompressed"
        )
    with translated_errors(path, "compressed pages"):
        return LazyArray(array[(slice(None),) * len(array.shape)])
