"""What the HDF5 library takes on trust from a file, looked at before it does.

It goes from object to object of a heap by the sizes that they state. A size of zero keeps it at the
same place for ever, and one beyond the heap leads it out of it. For a driver's block and for texts
and lists it allocates the size that is stated, up to 4 GB. Layout: levels 0A (superblock), 0B (file
driver info), 1E (global heap) and 2A2 (dataspace, datatype and attribute messages) of the HDF5 File
Format Specification, version 3.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ..errors import InputError

_MAGIC = b"\x89HDF\r\n\x1a\n"
#: Where a file may begin: what lies before is the user's.
_STARTS = 0, 512, 1024, 2048
#: In which the first block ends, if it lies at the last of these.
_HEAD_OF_FILE = _STARTS[-1] + 256
#: Of an address, bytes.
_WIDTHS = 2, 4, 8, 16, 32
#: Larger files are not looked through: it would take as long as reading them.
LARGEST = 64 * 2**20
_SIGNATURE = b"GCOL"
#: Bytes of the head of a heap, and of an object, in files whose lengths have eight bytes.
_HEAD = 16
#: First bytes of a type of variable length, in its versions, and what follows three bytes later.
_VARIABLE_LENGTH = b"\x19\x29\x39\x49"
_SIZE_OF_REFERENCE = re.compile(rb"\x10\0\0\0")
#: Bytes of the name of an attribute, and values that are looked at.
_LONGEST_NAME, _MOST_VALUES = 256, 256


def find_superblock(head: bytes) -> int | None:
    """Return the byte at which the first block begins; None where there is no HDF5 signature."""
    return next((at for at in _STARTS if head[at : at + len(_MAGIC)] == _MAGIC), None)


def check_superblock(path: Path) -> None:
    """Refuse a file whose first block, of the versions without a checksum, cannot be right.

    Raises
    ------
    InputError
        If it states an end beyond the file's, or a driver that is none of ours.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_OF_FILE).ljust(_HEAD_OF_FILE, b"\0")
    start = find_superblock(head)
    if start is None or head[start + 8] > 1:
        return
    if (width := head[start + 13]) not in _WIDTHS:
        raise InputError(f"{path}: damaged HDF5 file (addresses of {width} bytes)")
    first = start + (24 if head[start + 8] == 0 else 28)
    _, _, end, driver = (
        int.from_bytes(head[at : at + width], "little")
        for at in range(first, first + 4 * width, width)
    )
    size = path.stat().st_size
    if end > size:
        raise InputError(
            f"{path}: truncated or damaged HDF5 file (it ends at byte {size} and says {end})"
        )
    if driver != (1 << 8 * width) - 1:
        raise InputError(
            f"{path}: damaged HDF5 file, or one of several that belong together (it names a driver)"
        )


def check_text(path: Path, item: Any) -> None:
    """Refuse a dataset of one text of variable length that would be longer than the file.

    Raises
    ------
    InputError
        If it states such a length.
    """
    at = item.id.get_offset()
    if at is None or item.dtype.kind != "O":
        return
    with path.open("rb") as file:
        file.seek(at)
        length = int.from_bytes(file.read(4), "little")
    if length > path.stat().st_size:
        raise InputError(
            f"{path}: damaged HDF5 file (the text {item.name} states a length of {length} bytes)"
        )


def check_heaps(path: Path) -> None:
    """Refuse a file with a heap that the HDF5 library would not get through.

    Raises
    ------
    InputError
        If an object of a heap states a size that cannot be, or an attribute a length beyond the
        file's.
    """
    if path.stat().st_size > LARGEST:
        return
    data = path.read_bytes()
    at = data.find(_SIGNATURE)
    while at >= 0:
        size = int.from_bytes(data[at + 8 : at + _HEAD], "little")
        # samples may hold these four bytes too: a heap has version 1 and three zeros, and fits
        if data[at + 4 : at + 8] == b"\x01\0\0\0" and _HEAD <= size <= len(data) - at:
            _check_objects(path, data[at : at + size], at)
        at = data.find(_SIGNATURE, at + 1)
    _check_lists(path, data)


def _check_objects(path: Path, heap: bytes, start: int) -> None:
    at = _HEAD
    while at + _HEAD <= len(heap):
        index = int.from_bytes(heap[at : at + 2], "little")
        size = int.from_bytes(heap[at + 8 : at + _HEAD], "little")
        # that of the free space, object 0, counts its head
        step = size if index == 0 else _HEAD + _filled(size, 8)
        if not 0 < step <= len(heap) - at:
            raise InputError(
                f"{path}: damaged HDF5 file (object {index} of the heap at byte {start} states a "
                f"size of {size} bytes)"
            )
        at += step


def _check_lists(path: Path, data: bytes) -> None:
    """Refuse attributes with texts or lists of variable length that are longer than the file."""
    for found in _SIZE_OF_REFERENCE.finditer(data, 4):
        kind = found.start() - 4
        if data[kind] not in _VARIABLE_LENGTH:
            continue
        values = _values(data, kind)
        if values and data[kind + 1] & 0x0F > 1:
            raise InputError(
                f"{path}: damaged HDF5 file (the type at byte {kind} is neither text nor list)"
            )
        # each value begins with the number of items, and these have a size
        for at in (found.end() + 4, *values) if values else ():
            length = int.from_bytes(data[at : at + 4], "little")
            if length > len(data):
                raise InputError(
                    f"{path}: damaged HDF5 file (a text or list at byte {at} states a length of "
                    f"{length})"
                )


def _values(data: bytes, kind: int) -> range:
    """Where the values of an attribute lie whose type is at a byte; none if it is no attribute's.

    Samples may look like a type, but not behind what an attribute begins with.

    An attribute is its version, the sizes of name, type and shape, and then these and the values.
    In version 1 each is filled up to 8 bytes; from version 3 on a byte for the name's encoding
    comes before the name.
    """
    end = kind
    while end > kind - 8 and data[end - 1] == 0:
        end -= 1
    # the sizes, of which the last one's second byte is zero, end where the name begins
    name = data.rfind(b"\0", max(end - _LONGEST_NAME, 0), end) + 1
    for version, start, unit in (
        (1, name - 8, 8),
        (2, name - 8, 1),
        (3, name - 9, 1),  # encoded as ASCII, 0
        (3, name - 8, 1),  # or UTF-8, 1
    ):
        begin = start + (9 if version == 3 else 8)
        if start < 0 or data[start] != version:
            continue
        of_name, of_kind, of_shape = (
            int.from_bytes(data[at : at + 2], "little") for at in range(start + 2, start + 8, 2)
        )
        if of_name == end - begin + 1 and begin + _filled(of_name, unit) == kind:
            shape = kind + _filled(of_kind, unit)
            values = shape + _filled(of_shape, unit)
            return range(values, min(values + 16 * _count(data, shape), len(data)), 16)
    return range(0)


def _filled(size: int, unit: int) -> int:
    return -(-size // unit) * unit


def _count(data: bytes, shape: int) -> int:
    """Values of a shape; of no more axes than one, which are all that texts and lists have here."""
    if shape + 16 > len(data) or data[shape + 1] == 0:
        return 0 if data[shape : shape + 1] == b"\2" and data[shape + 3] == 2 else 1
    first = shape + (8 if data[shape] == 1 else 4)
    return min(int.from_bytes(data[first : first + 8], "little"), _MOST_VALUES)
