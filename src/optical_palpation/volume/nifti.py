"""NIfTI-1 and NIfTI-2 files (``.nii``, ``.nii.gz``); needs nibabel.

The three axes are called x, y, z in the order of the format unless the user says otherwise; where
the header's transform swaps them or turns z around, the user has to say. Voxel sizes are believed
only where the header names their unit.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .archive import check_ratio
from .arrays import MAX_LOADED_BYTES, LazyArray, View, check_array, nbytes
from .contents import Contents
from .metadata import Stated

FORMAT = "NIfTI"

_MOST_MORE = 64 * 2**20
_GZIP = b"\x1f\x8b"


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the NIfTI magic, also within gzip."""
    if head.startswith(_GZIP):
        try:
            head = zlib.decompressobj(wbits=31).decompress(head, 540)
        except zlib.error:
            return False
    size = head[:4]
    return (
        size in (struct.pack("<i", 348), struct.pack(">i", 348)) and head[344:347] == b"n+1"
    ) or (size in (struct.pack("<i", 540), struct.pack(">i", 540)) and head[4:7] == b"n+2")


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the header."""
    try:
        import nibabel
    except ImportError:
        raise InputError(
            f"{path}: reading NIfTI needs nibabel: pip install 'optical-palpation[formats]'"
        ) from None

    with path.open("rb") as stream:
        compressed = stream.read(2) == _GZIP
    with gzip.open(path) if compressed else path.open("rb") as stream:
        block = stream.read(540)
    # From the block alone: extensions, of any declared size, stay unread.
    if 540 in struct.unpack("<i", block[:4]) + struct.unpack(">i", block[:4]):
        header: Any = nibabel.Nifti2Header(block)
    else:
        header = nibabel.Nifti1Header(block[:348])
    shape = tuple(int(n) for n in header.get_data_shape())
    dtype = header.get_data_dtype()
    proxy = nibabel.arrayproxy.ArrayProxy(str(path), header, mmap=False)
    needed = proxy.offset + nbytes(shape, dtype)
    if len(shape) > 3 and set(shape[3:]) != {1}:
        raise InputError(f"{path}: holds a series of volumes {shape}, not one")
    check_array(shape[:3], dtype, str(path))
    if proxy.offset < 0:
        raise InputError(f"{path}: samples begin at byte {proxy.offset}")
    if compressed:
        check_ratio(needed, path.stat().st_size, str(path))
        if needed > MAX_LOADED_BYTES:
            raise InputError(f"{path}: too large to load whole; store it as .nii without gzip")
    elif needed > path.stat().st_size:
        raise InputError(
            f"{path}: {shape} samples need {needed} bytes, the file has {path.stat().st_size}: "
            "it is truncated, or its header is wrong"
        )
    # As it is stored: of whole numbers, scaled ones take up to eight times the memory.
    data: Any
    spec = (proxy.shape, dtype, proxy.offset)
    if compressed:
        data = _unpacked(path, spec, needed)
    else:
        data = nibabel.arrayproxy.ArrayProxy(str(path), spec, mmap=False)
    # A slope of 0 or NaN in the header means "not scaled": nibabel sees to that.
    if proxy.slope != 1 or proxy.inter != 0:
        data = _Scaled(data, dtype, proxy.slope, proxy.inter)
    whole = LazyArray(data, None if compressed else (*shape[:2], *[1] * len(shape[2:])))
    array = View(whole, tuple(range(len(shape[:3]))))  # without time and what else follows
    turned = _turned(header, array.shape)
    stated = _stated(header, array.shape, turned, str(path))
    dims = tuple("xyz"[: len(array.shape)]) if turned is None else ()
    return Contents.single(array, stated, "loaded" if compressed else "mapped", dims=dims)


def _unpacked(path: Path, spec: tuple[Any, ...], needed: int) -> NDArray[Any]:
    """Samples of a file that is packed, whatever it is called; its sum is checked."""
    from nibabel.arrayproxy import ArrayProxy

    with gzip.open(path) as stream:
        data = np.asanyarray(ArrayProxy(stream, spec, mmap=False))
        while stream.read(2**20):
            if stream.tell() > 2 * needed + _MOST_MORE:
                raise InputError(f"{path}: far more follows the samples: damaged")
    return data


class _Scaled:
    """Stored samples, scaled block by block as they are read."""

    def __init__(self, stored: Any, dtype: np.dtype[Any], slope: float, inter: float) -> None:
        self._stored, self._slope, self._inter = stored, slope, inter
        self.shape = stored.shape
        self.dtype = np.result_type(dtype, np.float32)

    def __getitem__(self, key: Any) -> Any:
        block = np.asarray(self._stored[key])
        return (block * self._slope + self._inter).astype(self.dtype)


def _stated(header: Any, shape: tuple[int, ...], turned: str | None, path: str) -> Stated:
    import nibabel

    axes = "xyz" if len(shape) == 3 and turned is None else None
    unit = header.get_xyzt_units()[0]
    factor = {"mm": 1.0, "meter": 1e3, "micron": 1e-3}.get(unit)
    if factor is None:
        return Stated(axes=axes, no_axes=turned)
    zooms = header.get_zooms()[: len(shape)]
    if header["qform_code"] > 0 or header["sform_code"] > 0:
        of_transform = nibabel.affines.voxel_sizes(header.get_best_affine())[: len(shape)]
        if not np.allclose(of_transform, zooms, rtol=1e-3):
            raise InputError(
                f"{path}: its header says voxels of {tuple(map(float, zooms))} {unit}, its "
                f"transform {tuple(map(float, of_transform))}; save it with one of them"
            )
    spacing = tuple(float(step) * factor for step in zooms)
    return Stated(axes=axes, spacing=spacing, no_axes=turned)


def _turned(header: Any, shape: tuple[int, ...]) -> str | None:
    """Say how the transform to world coordinates turns the axes, None if it keeps them.

    Mirrored lateral axes are left: ITK writes them into every file. A z of one sample, as that of
    a map, has no direction.
    """
    import nibabel

    if not (header["qform_code"] > 0 or header["sform_code"] > 0):
        return None
    world = nibabel.orientations.io_orientation(header.get_best_affine())[: len(shape)]
    swapped = [
        axis for axis, (n, to) in zip("xyz", enumerate(world[:, 0]), strict=False) if n != to
    ]
    if swapped:
        return f"its header swaps {' and '.join(swapped)}"
    if len(shape) == 3 and shape[2] > 1 and world[2, 1] != 1:
        return "its header turns z around"
    return None
