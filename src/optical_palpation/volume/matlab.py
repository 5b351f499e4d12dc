"""MATLAB files, v5 to v7 and v7.3.

Axes are counted as MATLAB counts them. Variables ``axes``, ``spacing_mm``, ``origin_mm``, ``scale``
and ``refractive_index`` beside the array describe it. The arrays of v5 to v7 files are loaded
whole where they are compressed (each is one zlib stream) or complex; those of v7.3 files, which are
HDF5, are not.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from . import hdf5, matlab_v5
from .arrays import Array, reversed_axes
from .contents import Contents, Variable
from .metadata import DESCRIPTIONS, described
from .units import is_unit_key

FORMAT = "MATLAB .mat"

_ALL = (slice(None),) * 32


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the text at the start and the byte-order mark at byte 126."""
    return head.startswith(b"MATLAB ") and (
        head[126:128] in (b"IM", b"MI") or hdf5.recognises(path, head)
    )


def contents(path: Path, wanted: str | None) -> Contents:
    """Find the arrays, and the short texts and numbers beside them."""
    with path.open("rb") as stream:
        head = stream.read(4096)
    return _v73(path) if hdf5.recognises(path, head) else _v5(path)


def _v73(path: Path) -> Contents:
    file = hdf5.open_file(path)
    try:
        found: dict[str, Variable] = {}
        stated: dict[str, Any] = {}
        texts: dict[str, str] = {}
        unread = []
        for name, item in hdf5.datasets(path, file):
            matlab_class = item.attrs.get("MATLAB_class", b"")
            text = matlab_class == b"char" or (name in DESCRIPTIONS and item.dtype == np.uint16)
            unit = is_unit_key(name.rpartition("/")[2])
            if matlab_class in (b"cell", b"function_handle") or (unit and not text):
                unread.append(name)
                continue
            if item.size <= 100 and (name in DESCRIPTIONS or unit):
                value = item[()]
                if text:  # UTF-16, down the columns
                    value = texts[name] = "".join(map(chr, np.ravel(value)))
                if name in DESCRIPTIONS:
                    stated[name] = value
            elif (
                not text
                and name not in DESCRIPTIONS
                and (item.dtype.kind in "biufc" or item.dtype.names)
            ):
                found[name] = _v73_variable(path, item, matlab_class)
        _check_descriptions(path, unread)
        facts = described(stated, str(path))
        found = {n: Variable(**vars(v) | {"stated": facts}) for n, v in found.items()}
        return Contents(found, file.close, texts, unread)
    except BaseException:
        file.close()
        raise


def _check_descriptions(path: Path, unread: list[str]) -> None:
    """Refuse what is called like a description but cannot be read, as a MATLAB ``string``."""
    if found := sorted(set(unread).intersection(DESCRIPTIONS)):
        raise InputError(
            f"{path}: {found[0]} should describe the array, but is neither characters nor numbers: "
            "save it in single quotes ('yzx') or as numbers, or leave it out"
        )


def _v73_variable(path: Path, item: Any, matlab_class: bytes) -> Variable:
    shape, dtype = item.shape[::-1], item.dtype
    if "MATLAB_empty" in item.attrs:  # holds its shape
        shape = (0, 0)
    elif hdf5.is_complex_pair(dtype):
        dtype = np.dtype(np.complex128)
    elif matlab_class == b"logical":
        dtype = np.dtype(bool)

    def opened() -> Array:
        return reversed_axes(hdf5.stored_array(path, item))

    return Variable(shape, dtype, opened, "streamed" if item.chunks else "mapped")


def _v5(path: Path) -> Contents:
    found = matlab_v5.variables(path)
    unread = [name for name, header in found.items() if header is None]
    _check_descriptions(path, unread)
    unread += [n for n, header in found.items() if is_unit_key(n) and header and header.dtype]
    stated: dict[str, Any] = {}
    texts: dict[str, str] = {}
    for name, header in found.items():
        if header is None:
            continue
        if name in DESCRIPTIONS or (header.dtype is None and is_unit_key(name)):
            value = matlab_v5.load(path, header)
            if isinstance(value, str):
                texts[name] = value
            if name in DESCRIPTIONS:
                stated[name] = value if isinstance(value, str) else value[_ALL[: len(value.shape)]]
    facts = described(stated, str(path))

    def opened(header: matlab_v5.Variable) -> Array:
        array = matlab_v5.load(path, header)
        if isinstance(array, str):
            raise InputError(f"{path}: {header.name} is text, not an array")
        return array

    return Contents(
        {
            name: Variable(
                header.shape,
                header.dtype,
                partial(opened, header),
                None,  # its data element tells
                stated=facts,
            )
            for name, header in found.items()
            if header and header.dtype is not None and name not in DESCRIPTIONS
        },
        texts=texts,
        unread=unread,
    )
