"""Reading members of zip archives that may be hostile. Nothing is ever extracted to disk."""

from __future__ import annotations

import os
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import Array, FileArray, PagedArray, WholeArray, nbytes, reversed_axes, squeezed

# Room for 100,000 members; zipfile holds the whole directory in memory.
_MAX_DIRECTORY_BYTES = 8 * 2**20
# Samples with speckle hardly compress: a higher ratio is a zip bomb or a wrong size.
_MAX_RATIO = 200
_SMALL_BYTES = 64 * 2**20


def open_archive(path: Path) -> zipfile.ZipFile:
    """Open a zip file after checking that its directory is of a sane size."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(max(0, size - 65557))
        tail = stream.read()
        end = tail.rfind(b"PK\x05\x06")
        if end < 0 or len(tail) - end < 22:
            raise InputError(f"{path}: a zip archive without its directory at the end: truncated")
        (directory,) = struct.unpack_from("<I", tail, end + 12)
        locator = end - 20
        if directory == 0xFFFFFFFF and locator >= 0 and tail[locator:].startswith(b"PK\x06\x07"):
            (position,) = struct.unpack_from("<Q", tail, locator + 8)
            if position + 56 > size:
                raise InputError(f"{path}: the zip64 directory lies outside the file: truncated")
            stream.seek(position)
            (directory,) = struct.unpack_from("<Q", stream.read(56), 40)
    if directory > _MAX_DIRECTORY_BYTES:
        raise InputError(f"{path}: a zip directory of {directory} bytes is not that of a volume")
    archive = zipfile.ZipFile(path)
    for member in archive.infolist():
        name = plain_name(member.filename)
        if name.startswith("/") or ":" in name or ".." in name.split("/"):
            archive.close()
            raise InputError(
                f"{path}: has a member {member.filename!r} that points out of the archive: not "
                "written by OCT software, and not safe to unpack"
            )
    return archive


def plain_name(name: str) -> str:
    """Member name with slashes, for comparison only: some writers use backslashes."""
    return name.replace("\\", "/")


def find_member(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo | None:
    """Find the one member of this name, upper and lower case and kind of slash being equal."""
    wanted = plain_name(name).lower()
    found = [m for m in archive.infolist() if plain_name(m.filename).lower() == wanted]
    if len(found) > 1:
        raise InputError(f"{archive.filename}: holds {name!r} {len(found)} times")
    return found[0] if found else None


def read_small(archive: zipfile.ZipFile, member: zipfile.ZipInfo, limit: int) -> bytes:
    """Read a member that must be small, whatever its declared size."""
    with open_member(archive, member) as stream:
        data = stream.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"{archive.filename}: {member.filename} is larger than {limit} bytes")
    return data


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> IO[bytes]:
    """Open a member for reading; refuse encryption and implausible compression."""
    where = f"{archive.filename}: {member.filename}"
    if member.flag_bits & 0x1:
        raise InputError(f"{where} is encrypted")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(
            f"{where} uses zip compression {member.compress_type}; only stored and deflated "
            "members are supported: pack the archive again"
        )
    check_ratio(member.file_size, member.compress_size, where)
    return archive.open(member)


def check_ratio(size: int, compressed: int, where: str) -> None:
    """Refuse data that claim to have been compressed more than an OCT signal can be."""
    if size > max(_SMALL_BYTES, _MAX_RATIO * compressed):
        raise InputError(
            f"{where} claims {size} bytes from {compressed} compressed ones: damaged, or a zip bomb"
        )


def member_array(
    archive: zipfile.ZipFile,
    member: zipfile.ZipInfo,
    dtype: np.dtype[Any],
    shape: Sequence[int],
    *,
    skip: int = 0,
    order: str = "C",
) -> Array:
    """Make an array of a member's samples.

    A stored member is mapped in place, and a small one is read once to check its sum. A deflated
    one is streamed page by page: forward reading is cheap, going back starts anew.
    """
    shape = tuple(shape)
    where = f"{archive.filename}: {member.filename}"
    expected = skip + nbytes(shape, dtype)
    if member.file_size != expected:
        raise InputError(
            f"{where}: {shape} samples of type {dtype} need {expected} bytes, the member has "
            f"{member.file_size}"
        )
    stream = open_member(archive, member)
    if member.compress_type == zipfile.ZIP_STORED:
        with stream:
            if expected <= _SMALL_BYTES:
                while stream.read(2**20):
                    pass  # at its end zipfile compares the sum
        path = Path(os.fspath(archive.filename or ""))
        return FileArray(path, dtype, shape, _data_offset(path, member) + skip, order=order)

    if len(shape) not in (2, 3):

        def read_all() -> NDArray[Any]:
            stream.seek(skip)
            data = stream.read(nbytes(shape, dtype))
            return np.frombuffer(data, dtype).reshape(shape, order="F" if order == "F" else "C")

        return WholeArray(read_all, dtype, shape)
    pages = shape if order == "C" else shape[::-1]
    slowest, rows, columns = pages if len(pages) == 3 else (1, *pages)
    page_bytes = nbytes((rows, columns), dtype)

    def read_page(index: int) -> NDArray[Any]:
        stream.seek(skip + index * page_bytes)
        data = stream.read(page_bytes)
        if len(data) != page_bytes:
            raise InputError(f"{where}: ends within page {index}: truncated")
        return np.frombuffer(data, dtype).reshape(rows, columns)

    array: Any = PagedArray(read_page, dtype, (slowest, rows, columns))
    if len(pages) == 2:
        array = squeezed(array, keep=2)
    return array if order == "C" else reversed_axes(array)


def _data_offset(path: Path, member: zipfile.ZipInfo) -> int:
    with path.open("rb") as stream:
        stream.seek(member.header_offset)
        local = stream.read(30)
    if len(local) < 30 or local[:4] != b"PK\x03\x04":
        raise InputError(f"{path}: {member.filename} is not where the zip directory says")
    name_length, extra_length = struct.unpack_from("<HH", local, 26)
    return member.header_offset + 30 + name_length + extra_length
