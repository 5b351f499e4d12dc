"""Numeric arrays of MATLAB v5 to v7 files, after the published "MAT-File Format" document.

Read here and not by ``scipy.io``, which allocates whatever a damaged header declares, and loads
arrays that could stay on disk: those of uncompressed files (``save -v6``) are mapped.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .archive import check_ratio
from .arrays import MAX_LOADED_BYTES, FileArray, LazyArray, nbytes

_MATRIX, _COMPRESSED = 14, 15
_STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CHAR_CLASS, _OPAQUE_CLASS = 4, 17
_CLASSES = {
    6: "f8",
    7: "f4",
    8: "i1",
    9: "u1",
    10: "i2",
    11: "u2",
    12: "i4",
    13: "u4",
    14: "i8",
    15: "u8",
}
_LOGICAL_FLAG = 0x02
_COMPLEX_FLAG = 0x08
_MAX_VARIABLES = 10_000


class _Stream(Protocol):
    def read(self, n: int, /) -> bytes: ...


@dataclass(frozen=True)
class Variable:
    """A numeric or text variable, and where its element begins in the file."""

    name: str
    shape: tuple[int, ...]
    kind: int
    is_complex: bool
    is_logical: bool
    position: int
    size: int
    compressed: bool
    order: str

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """Type of the values, None for text."""
        if self.kind == _CHAR_CLASS:
            return None
        if self.is_logical:
            return np.dtype(bool)
        real = np.dtype(self.order + _CLASSES[self.kind])
        if not self.is_complex:
            return real
        single = real.itemsize <= 4 and real.kind == "f"
        return np.dtype(np.complex64 if single else np.complex128)


def variables(path: Path) -> dict[str, Variable | None]:
    """Read the headers of all variables; None for what is neither an array of numbers nor text."""
    found: dict[str, Variable | None] = {}
    with path.open("rb") as file:
        order = "<" if file.read(128)[126:128] == b"IM" else ">"
        total = path.stat().st_size
        position = 128
        for _ in range(_MAX_VARIABLES):
            if position >= total:
                return found
            file.seek(position)
            kind, size = _words(file.read(8), order, path)
            if position + 8 + size > total:
                raise InputError(f"{path}: a variable ends beyond the end of the file: truncated")
            if kind in (_MATRIX, _COMPRESSED):
                stream = _content(file, position, size, kind == _COMPRESSED, order, path)
                name, variable = _header(stream, position, size, kind == _COMPRESSED, order, path)
                if name:  # MATLAB keeps what belongs to its objects in one without
                    found[name] = variable
            position += 8 + size
    raise InputError(f"{path}: holds more than {_MAX_VARIABLES} variables")


def load(path: Path, variable: Variable) -> FileArray | LazyArray | str:
    """Text, or an array with its axes as MATLAB counts them: mapped where possible, else loaded."""
    where = f"{path}: {variable.name}"
    with path.open("rb") as file:
        stream = _content(
            file, variable.position, variable.size, variable.compressed, variable.order, path
        )
        _header(stream, variable.position, variable.size, variable.compressed, variable.order, path)
        found = _values(path, variable, file, stream)
        if isinstance(stream, _Inflated):
            stream.finish(where)
        return found


def _values(
    path: Path, variable: Variable, file: IO[bytes], stream: _Stream
) -> FileArray | LazyArray | str:
    """What follows the header of a variable."""
    where = f"{path}: {variable.name}"
    count = int(np.prod([int(n) for n in variable.shape], dtype=object))
    stored, size, small = _tag(stream, variable.order, path)
    if variable.kind == _CHAR_CLASS:
        if size > 10_000 or stored not in _TEXT:
            raise InputError(f"{where}: text of an unsupported kind")
        codec = _TEXT[stored] + (
            {"<": "-le", ">": "-be"}[variable.order] if stored in (4, 17, 18) else ""
        )
        return (small or _exactly(stream, size, where)).decode(codec, errors="replace").strip()
    target = np.dtype(variable.order + _CLASSES[variable.kind])
    part = np.dtype(variable.order + _STORED.get(stored, "V1"))
    if part.kind == "V" or size != count * part.itemsize:
        raise InputError(
            f"{where}: {size} bytes of stored type {stored} cannot be {variable.shape} samples "
            f"of type {target}: damaged"
        )
    plain = not (variable.compressed or variable.is_complex or variable.is_logical)
    if small is None and plain and part == target:
        return FileArray(path, target, variable.shape, file.tell(), order="F")

    check_ratio(size, variable.size, where)
    if nbytes(variable.shape, target) * (1 + variable.is_complex) > MAX_LOADED_BYTES:
        raise InputError(f"{where}: too large to load whole; save it with -v7.3")
    real = _samples(stream, count, part, small, where).astype(target, copy=False)
    if not variable.is_complex:
        real = real.astype(bool) if variable.is_logical else real
        return LazyArray(real.reshape(variable.shape, order="F"))
    _exactly(stream, -size % 8 if small is None else 0, where)
    stored, size, small = _tag(stream, variable.order, path)
    part = np.dtype(variable.order + _STORED.get(stored, "V1"))
    if part.kind == "V" or size != count * part.itemsize:
        raise InputError(f"{where}: the imaginary part does not fit the real one")
    values = np.empty(count, variable.dtype)
    values.real, values.imag = real, _samples(stream, count, part, small, where)
    return LazyArray(values.reshape(variable.shape, order="F"))


class _Inflated:
    """Reads forward in a zlib stream that fills ``size`` bytes of a file."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left, self._zlib = file, size, zlib.decompressobj()

    def read(self, n: int) -> bytes:
        parts: list[bytes] = []
        while n > 0 and not self._zlib.eof:
            raw = self._zlib.unconsumed_tail
            if not raw:
                raw = self._file.read(min(2**16, self._left))
                self._left -= len(raw)
            try:
                part = self._zlib.decompress(raw, n)
            except zlib.error as error:
                raise InputError(f"{self._file.name}: damaged variable ({error})") from error
            if not part and not raw:
                break
            parts.append(part)
            n -= len(part)
        return b"".join(parts)

    def finish(self, where: str) -> None:
        """Read the checksum, before which at most padding is left."""
        self.read(8)
        if not self._zlib.eof:
            raise InputError(f"{where}: is not followed by the end of its stream: damaged")


def _content(
    file: IO[bytes], position: int, size: int, compressed: bool, order: str, path: Path
) -> _Stream:
    """Position a stream at the first element within a matrix."""
    file.seek(position + 8)
    if not compressed:
        return file
    stream = _Inflated(file, size)
    kind, _ = _words(stream.read(8), order, path)
    return stream if kind == _MATRIX else _Inflated(file, 0)


def _header(
    stream: _Stream, position: int, size: int, compressed: bool, order: str, path: Path
) -> tuple[str, Variable | None]:
    """Read flags, dimensions and name; the name alone of what is neither numbers nor text."""
    flags_kind, flags_size, _ = _tag(stream, order, path)
    if flags_kind != 6 or flags_size != 8:
        return "", None
    flags, _ = _words(_exactly(stream, 8, str(path)), order, path)
    kind = flags & 0xFF
    # string, table and datetime have no dimensions
    dims = b"" if kind == _OPAQUE_CLASS else _element(stream, order, path)
    name = _element(stream, order, path).rstrip(b"\0").decode("latin-1")
    if len(dims) % 4:
        raise InputError(f"{path}: the dimensions of {name} take {len(dims)} bytes: damaged")
    shape = tuple(int(n) for n in np.frombuffer(dims, order + "i4"))
    if any(n < 0 for n in shape):
        raise InputError(f"{path}: {name} has a negative dimension {shape}")
    if kind not in _CLASSES and kind != _CHAR_CLASS:
        return name, None
    is_complex = bool(flags >> 8 & _COMPLEX_FLAG)
    is_logical = kind != _CHAR_CLASS and bool(flags >> 8 & _LOGICAL_FLAG)
    where = position, size, compressed, order
    return name, Variable(name, shape, kind, is_complex, is_logical, *where)


def _element(stream: _Stream, order: str, path: Path) -> bytes:
    """Read a short element with its padding."""
    _, size, small = _tag(stream, order, path)
    if small is not None:
        return small
    if size > 1024:
        raise InputError(f"{path}: a variable's header claims {size} bytes: damaged")
    return _exactly(stream, size + -size % 8, str(path))[:size]


def _tag(stream: _Stream, order: str, path: Path) -> tuple[int, int, bytes | None]:
    """Type and size of the next element, and its bytes where they are packed into the tag."""
    raw = _exactly(stream, 8, str(path))
    first, size = _words(raw, order, path)
    if first >> 16:
        size = first >> 16
        if size > 4:
            raise InputError(f"{path}: a packed element of {size} bytes: damaged")
        return first & 0xFFFF, size, raw[4 : 4 + size]
    return first, size, None


def _samples(
    stream: _Stream, count: int, dtype: np.dtype[Any], small: bytes | None, where: str
) -> NDArray[Any]:
    if small is not None:
        return np.frombuffer(small, dtype)
    samples = np.empty(count, dtype)
    bytes_ = samples.view(np.uint8)
    for start, block in _blocks(stream, samples.nbytes, where):
        bytes_[start : start + len(block)] = np.frombuffer(block, np.uint8)
    return samples


def _blocks(stream: _Stream, size: int, where: str) -> Iterator[tuple[int, bytes]]:
    start = 0
    while start < size:
        block = _exactly(stream, min(2**22, size - start), where)
        yield start, block
        start += len(block)


def _exactly(stream: _Stream, n: int, where: str) -> bytes:
    data = stream.read(n)
    if len(data) != n:
        raise InputError(f"{where}: ends within a variable: truncated or damaged")
    return data


def _words(raw: bytes, order: str, path: Path) -> tuple[int, int]:
    if len(raw) != 8:
        raise InputError(f"{path}: ends within a variable: truncated or damaged")
    first, second = np.frombuffer(raw, order + "u4")
    return int(first), int(second)
