"""Look through the heaps of texts and references of an HDF5 file before its library does.

The library goes from object to object of a heap by the sizes that they state. A size of zero keeps
it at the same place for ever, and one beyond the heap leads it out of it. Layout: "Level 1E, Global
Heap" of the HDF5 File Format Specification, version 3.
"""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError

#: Larger files are not looked through: it would take as long as reading them.
LARGEST = 64 * 2**20
_SIGNATURE = b"GCOL"
#: Bytes of the head of a heap, and of an object, in files whose lengths have eight bytes.
_HEAD = 16


def check_heaps(path: Path) -> None:
    """Refuse a file with a heap that the HDF5 library would not get through.

    Raises
    ------
    InputError
        If an object of a heap states a size that cannot be.
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


def _check_objects(path: Path, heap: bytes, start: int) -> None:
    at = _HEAD
    while at + _HEAD <= len(heap):
        index = int.from_bytes(heap[at : at + 2], "little")
        size = int.from_bytes(heap[at + 8 : at + _HEAD], "little")
        # that of the free space, object 0, counts its head
        step = size if index == 0 else _HEAD + (size + 7) // 8 * 8
        if not 0 < step <= len(heap) - at:
            raise InputError(
                f"{path}: damaged HDF5 file (object {index} of the heap at byte {start} states a "
                f"size of {size} bytes)"
            )
        at += step
