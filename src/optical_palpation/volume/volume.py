"""The open volume: metadata, and B-scans on demand."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
from .arrays import MAX_BSCAN_BYTES, MAX_LOADED_BYTES, Array, LazyArray, check_array, nbytes
from .metadata import Access, Stated, VolumeMetadata, settle

# What is read at once where B-scans cut across the order of the file.
_SLAB_BYTES = 64 * 2**20


@dataclass
class Source:
    """What a reader hands over: an array on disk and what the file says about it."""

    array: Array
    stated: Stated
    access: Access
    close: Callable[[], None] = lambda: None


class Volume:
    """An OCT volume that is read B-scan by B-scan.

    Open it with :func:`open_volume`; use it as a context manager, or call :meth:`close`. Not for
    several threads at once.
    """

    def __init__(self, source: Source, path: Path, fmt: str, **given: Any) -> None:
        array = source.array
        check_array(array.shape, array.dtype, str(path))
        self._close = source.close
        # Settled twice: the axes decide whether the pages are B-scans.
        metadata = settle(
            source.stated,
            shape=array.shape,
            dtype=array.dtype.str,
            path=path,
            fmt=fmt,
            access=source.access,
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
        if m.refractive_index is not None:
            # Not "refractive_index": that would ask a reader to divide the depth once more.
            attrs["refractive_index_applied"] = str(m.refractive_index)
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


@contextmanager
def translated_errors(path: Path, fmt: str) -> Iterator[None]:
    """Turn whatever a format's library raises on a damaged file into an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # parsers raise anything on damaged input
        detail = f"{type(error).__name__}: {error}"[:300]
        raise InputError(
            f"{path}: cannot be read as {fmt}; damaged or unsupported ({detail})"
        ) from error


def _loaded(array: Array, path: Path) -> Array:
    size = nbytes(array.shape, array.dtype)
    if size > MAX_LOADED_BYTES:
        raise InputError(
            f"{path}: its compressed pages are not B-scans, so the {size} bytes would have to be "
            f"loaded whole; the limit is {MAX_LOADED_BYTES}. Save it uncompressed"
        )
    with translated_errors(path, "compressed pages"):
        return LazyArray(array[(slice(None),) * len(array.shape)])
