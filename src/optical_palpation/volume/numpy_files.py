"""NumPy ``.npy`` and ``.npz`` files. Pickled objects are never loaded."""

from __future__ import annotations

import io
import zipfile
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ..errors import InputError
from .archive import member_array, open_archive, open_member, read_small
from .arrays import Array, FileArray, nbytes
from .contents import Contents, Variable
from .metadata import DESCRIPTIONS, described
from .units import is_unit_key

FORMAT = "NumPy .npy/.npz"


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the NumPy magic, or a ``.npy`` member in a zip archive."""
    if head.startswith(b"PK\x03\x04"):
        with open_archive(path) as archive:
            return any(m.endswith(".npy") for m in archive.namelist())
    return head.startswith(npy.MAGIC_PREFIX)


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the headers, and the short texts and numbers beside the arrays of an ``.npz``."""
    if _is_npy(path):
        with path.open("rb") as stream:
            shape, order, dtype, offset = header(stream, str(path))
        rest = path.stat().st_size - offset - nbytes(shape, dtype)
        if rest > 0 and not dtype.hasobject:
            raise InputError(
                f"{path}: {rest} bytes follow its array; store several arrays as .npz, or each in "
                "a file of its own"
            )
        whole = partial(FileArray, path, dtype, shape, offset, order=order)
        return Contents({"": Variable(shape, dtype, whole)})

    archive = open_archive(path)
    try:
        members = {
            m.filename.removesuffix(".npy"): m
            for m in archive.infolist()
            if m.filename.endswith(".npy")
        }
        stated: dict[str, Any] = {}
        texts: dict[str, str] = {}
        headers = {}
        for name, member in members.items():
            with open_member(archive, member) as content:
                shape, order, dtype, offset = header(content, f"{path}: {name}")
            if name in DESCRIPTIONS:
                data = io.BytesIO(read_small(archive, member, 2**16))
                stated[name] = np.load(data, allow_pickle=False)
            elif is_unit_key(name) and dtype.kind in "US" and shape in ((), (1,)):
                data = io.BytesIO(read_small(archive, member, 2**16))
                texts[name] = _text(np.load(data, allow_pickle=False))
            elif not dtype.hasobject:  # notes beside the array; never unpickled
                headers[name] = shape, order, dtype, offset
        facts = described(stated, str(path))

        def variable(name: str) -> Variable:
            shape, order, dtype, offset = headers[name]
            stored = members[name].compress_type == zipfile.ZIP_STORED

            def opened() -> Array:
                return member_array(archive, members[name], dtype, shape, skip=offset, order=order)

            access = "mapped" if stored else "streamed"
            return Variable(shape, dtype, opened, access, stated=facts)  # type: ignore[arg-type]

        unread = [name for name in members if is_unit_key(name) and name not in texts]
        return Contents({name: variable(name) for name in headers}, archive.close, texts, unread)
    except BaseException:
        archive.close()
        raise


def _text(value: Any) -> str:
    """Text of an array of one, without characters that are none."""
    if value.dtype.kind == "S":
        return value.tobytes().decode(errors="replace").strip("\0 ")
    order = "-be" if value.dtype.str[0] == ">" else "-le"
    return value.tobytes().decode("utf-32" + order, errors="replace").strip("\0 ")


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
