"""NumPy ``.npy`` and ``.npz`` files. Pickled objects are never loaded."""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ..errors import InputError
from .archive import member_array, open_archive, open_member, read_small
from .arrays import FileArray, check_array
from .metadata import Stated, described
from .volume import Source

FORMAT = "NumPy .npy/.npz"

_DESCRIPTIONS = ("axes", "spacing_mm", "origin_mm", "scale", "refractive_index")


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the NumPy magic, or a ``.npy`` member in a zip archive."""
    if head.startswith(b"PK\x03\x04"):
        with open_archive(path) as archive:
            return any(m.endswith(".npy") for m in archive.namelist())
    return head.startswith(npy.MAGIC_PREFIX)


def read(path: Path, variable: str | None) -> Source:
    """Read the header; in an ``.npz`` find the array, and what its other entries say about it."""
    if _is_npy(path):
        with path.open("rb") as stream:
            shape, order, dtype, offset = header(stream, str(path))
        check_array(shape, dtype, str(path))
        return Source(FileArray(path, dtype, shape, offset, order=order), Stated(), "mapped")

    archive = open_archive(path)
    try:
        members = {
            m.filename.removesuffix(".npy"): m
            for m in archive.infolist()
            if m.filename.endswith(".npy")
        }
        stated = {}
        for name in _DESCRIPTIONS:
            if name in members:
                data = io.BytesIO(read_small(archive, members[name], 2**16))
                stated[name] = np.load(data, allow_pickle=False)
        headers = {}
        for name in [variable] if variable in members else members:
            if name not in _DESCRIPTIONS:
                with open_member(archive, members[name]) as stream:
                    headers[name] = header(stream, f"{path}: {name}")
        name = pick(path, {n: h[0] for n, h in headers.items()}, variable, list(members))
        shape, order, dtype, offset = headers[name]
        array, access = member_array(archive, members[name], dtype, shape, skip=offset, order=order)
        return Source(
            array,
            described(stated, str(path)),
            access,
            archive.close,
        )
    except BaseException:
        archive.close()
        raise


def pick(
    path: Path, shapes: dict[str, tuple[int, ...]], variable: str | None, names: list[str]
) -> str:
    """Choose the array that the user names, or the only one with three axes (else with two)."""
    if variable is not None:
        if variable not in shapes:
            raise InputError(f"{path}: no array {variable!r}; it holds {', '.join(names[:20])}")
        return variable
    for axes in (3, 2):
        found = [name for name, shape in shapes.items() if len(shape) == axes and min(shape) > 1]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"{path}: holds several arrays; choose one with variable=: {', '.join(found[:20])}"
            )
    inside = ", ".join(f"{name} {shape}" for name, shape in list(shapes.items())[:20])
    raise InputError(f"{path}: no array with three axes; it holds {inside or 'none'}")


def _is_npy(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(6) == npy.MAGIC_PREFIX


def header(stream: IO[bytes], where: str) -> tuple[tuple[int, ...], str, np.dtype[Any], int]:
    """Read shape, memory order ("C" or "F"), type and place of the first value."""
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise InputError(f"{where}: .npy version {version} is not supported")
    reader = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = reader(stream)
    return shape, "F" if fortran else "C", dtype, stream.tell()
