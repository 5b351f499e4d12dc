"""Arrays on disk: a shape, a type, and slices read on demand."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

# A larger B-scan (8192 x 8192 float32) is taken for a damaged header: memory stays bounded.
MAX_BSCAN_BYTES = 256 * 2**20
# Largest volume that is loaded whole where the format leaves no choice.
MAX_LOADED_BYTES = 4 * 2**30

Key = tuple[slice, ...]


class Array(Protocol):
    """An array that is read by slices with step 1, one per axis.

    ``chunks`` is the block that one access has to touch anyway. ``random_access`` is False where
    a block is decoded whole whatever part of it is asked for.
    """

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102
    @property
    def dtype(self) -> np.dtype[Any]: ...  # noqa: D102
    @property
    def chunks(self) -> tuple[int, ...]: ...  # noqa: D102
    @property
    def random_access(self) -> bool: ...  # noqa: D102
    def __getitem__(self, key: Key, /) -> NDArray[Any]: ...


class FileArray:
    """Uncompressed samples at a fixed place in a file.

    Each access maps the file anew and copies what it needs, so that pages already used do not
    stay in this process's memory.
    """

    random_access = True

    def __init__(
        self,
        path: Path,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        offset: int,
        *,
        order: str = "C",
    ) -> None:
        self.path, self.dtype, self.shape, self.offset = path, dtype, shape, offset
        self._order = "F" if order == "F" else "C"
        needed, size = offset + nbytes(shape, dtype), path.stat().st_size
        if offset < 0 or needed > size:
            raise InputError(
                f"{path}: {shape} samples of type {dtype} from byte {offset} need {needed} bytes, "
                f"the file has {size}: it is truncated, or its header is wrong"
            )
        fastest_last = (1, *shape[1:])
        self.chunks = fastest_last if self._order == "C" else (*shape[:-1], 1)

    def __getitem__(self, key: Key) -> NDArray[Any]:
        mapped = np.memmap(
            self.path,
            dtype=self.dtype,
            mode="r",
            offset=self.offset,
            shape=self.shape,
            order="F" if self._order == "F" else "C",
        )
        return np.array(mapped[key])


class PagedArray:
    """A stack of 2-D pages, each decoded whole by ``read_page(index)``."""

    random_access = False

    def __init__(
        self,
        read_page: Callable[[int], NDArray[Any]],
        dtype: np.dtype[Any],
        shape: tuple[int, int, int],
    ) -> None:
        self._read_page, self.dtype, self.shape = read_page, dtype, shape
        self.chunks = (1, *shape[1:])

    def __getitem__(self, key: Key) -> NDArray[Any]:
        indices = range(*key[0].indices(self.shape[0]))
        rows, columns = (len(range(n)[k]) for n, k in zip(self.shape[1:], key[1:], strict=True))
        block = np.empty((len(indices), rows, columns), self.dtype)
        for target, index in zip(block, indices, strict=True):
            target[...] = self._page(index)[key[1:]]
        return block

    def _page(self, index: int) -> NDArray[Any]:
        page = self._read_page(index)
        if page.shape != self.shape[1:]:
            raise InputError(f"page {index} has shape {page.shape}, not {self.shape[1:]}")
        if not np.can_cast(page.dtype, self.dtype, "same_kind"):
            raise InputError(f"page {index} holds {page.dtype}, not {self.dtype}")
        return page


class WholeArray:
    """An array that is decoded whole, by ``read()``, whatever part of it is asked for."""

    random_access = False

    def __init__(
        self, read: Callable[[], NDArray[Any]], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        self._read, self.dtype, self.shape, self.chunks = read, dtype, shape, shape

    def __getitem__(self, key: Key) -> NDArray[Any]:
        return self._read()[key]


class LazyArray:
    """An array of a library that reads slices by itself (h5py, zarr, nibabel), or in memory."""

    random_access = True

    def __init__(self, data: Any, chunks: tuple[int, ...] | None = None) -> None:
        self._data = data
        self.shape: tuple[int, ...] = tuple(int(n) for n in data.shape)
        self.dtype: np.dtype[Any] = np.dtype(data.dtype)
        self.chunks = tuple(chunks) if chunks else (1,) * len(self.shape)

    def __getitem__(self, key: Key) -> NDArray[Any]:
        return np.asarray(self._data[key])


class View:
    """Another array with its axes in another order; axes of length one may be left out."""

    def __init__(self, base: Array, axes: tuple[int, ...]) -> None:
        self._base, self._axes = base, axes
        self.shape = tuple(base.shape[a] for a in axes)
        self.chunks = tuple(base.chunks[a] for a in axes)
        self.dtype, self.random_access = base.dtype, base.random_access

    def __getitem__(self, key: Key) -> NDArray[Any]:
        full = [slice(0, 1)] * len(self._base.shape)
        for axis, part in zip(self._axes, key, strict=True):
            full[axis] = part
        block = self._base[tuple(full)]
        left_out = tuple(a for a in range(block.ndim) if a not in self._axes)
        return block.transpose(*self._axes, *left_out).reshape(
            tuple(block.shape[a] for a in self._axes)
        )


class Incomplete:
    """Another array, in parts of which some were never stored: their values are missing, NaN.

    The type is that of what is stored; a block with missing values is floating-point.

    Parameters
    ----------
    base
        What is read, with anything where a part is absent.
    size
        Lengths of a part, along each axis.
    stored
        Which parts are there.
    """

    def __init__(self, base: Array, size: tuple[int, ...], stored: NDArray[np.bool_]) -> None:
        self._base, self._size, self._stored = base, size, stored
        self.shape, self.chunks, self.dtype = base.shape, base.chunks, base.dtype
        self.random_access = base.random_access

    def __getitem__(self, key: Key) -> NDArray[Any]:
        values = self._base[key]
        part_of = [
            np.arange(*along.indices(n)) // size
            for along, n, size in zip(key, self.shape, self._size, strict=True)
        ]
        absent = ~self._stored[np.ix_(*part_of)]
        if absent.any():
            values = values.astype(np.result_type(values.dtype, np.float32))
            values[absent] = np.nan
        return values


def reversed_axes(base: Array) -> View:
    """View column-major samples, as MATLAB and Fortran count their axes."""
    return View(base, tuple(reversed(range(len(base.shape)))))


def squeezed(base: Array, keep: int = 3) -> Array:
    """Leave out axes of length one, the first ones first, until ``keep`` axes remain."""
    axes = squeezed_axes(base.shape, keep)
    return base if len(axes) == len(base.shape) else View(base, tuple(axes))


def squeezed_axes(
    shape: tuple[int, ...], keep: int = 3, spatial: Collection[int] = ()
) -> list[int]:
    """Numbers of the axes that :func:`squeezed` leaves; `spatial` ones only go after all others."""
    axes = list(range(len(shape)))
    for axis in sorted(axes, key=lambda axis: axis in spatial):
        if len(axes) > keep and shape[axis] == 1:
            axes.remove(axis)
    return axes


def nbytes(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Bytes of an array, in integers that cannot overflow."""
    return math.prod(int(n) for n in shape) * dtype.itemsize


def check_array(shape: tuple[int, ...], dtype: np.dtype[Any], where: str) -> None:
    """Refuse what cannot be an OCT volume, before anything of its size is allocated."""
    if dtype.kind not in "iufc" or dtype.itemsize > 16:
        raise InputError(f"{where}: samples of type {dtype} are not real or complex numbers")
    if len(shape) not in (2, 3):
        raise InputError(f"{where}: an array of {len(shape)} axes {shape}; a volume has 3")
    if any(n < 1 for n in shape):
        raise InputError(f"{where}: an array of shape {shape} has no samples")
