"""Raw binary samples with a sidecar ``<name>.toml`` or ``<name>.json`` that describes them.

The sidecar of ``scan.raw`` is ``scan.raw.toml`` and gives ``dtype`` (such as ``"float32"``),
``shape`` (slowest axis first) and, as it knows them, ``byte_order`` (``"little"`` or ``"big"``),
``offset`` (bytes before the first sample), ``axes``, ``spacing_mm``, ``origin_mm`` (one number per
axis, in the order of ``axes``), ``scale`` and ``refractive_index``.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .arrays import FileArray, check_array, nbytes
from .contents import Contents
from .metadata import described

FORMAT = "raw binary with sidecar"

_KEYS = {
    "dtype",
    "shape",
    "byte_order",
    "offset",
    "axes",
    "spacing_mm",
    "origin_mm",
    "scale",
    "refractive_index",
}
_TYPES = {
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    *("float16", "float32", "float64", "complex64", "complex128"),
}


def recognises(path: Path, head: bytes) -> bool:
    """Any file beside which a sidecar with ``dtype`` or ``shape`` lies."""
    return bool(head) and _sidecar(path) is not None


def is_described(path: Path) -> bool:
    """Tell whether a sidecar describes a file to the last byte: whatever its samples look like."""
    try:
        return _sidecar(path) is not None and bool(contents(path, None).variables)
    except (InputError, OSError, TypeError, ValueError):  # of notes of another program, perhaps
        return False


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the sidecar."""
    found = _sidecar(path)
    assert found is not None  # recognises() saw it
    sidecar, entries = found
    if unknown := sorted(set(entries) - _KEYS):
        raise InputError(f"{sidecar}: unknown entries {unknown}; known: {sorted(_KEYS)}")
    if entries.get("dtype") not in _TYPES:
        raise InputError(
            f"{sidecar}: dtype {entries.get('dtype')!r} is not one of {sorted(_TYPES)}"
        )
    byte_order = entries.get("byte_order", "little")
    if byte_order not in ("little", "big"):
        raise InputError(f"{sidecar}: byte_order {byte_order!r} is neither 'little' nor 'big'")
    dtype = np.dtype(entries["dtype"]).newbyteorder("<" if byte_order == "little" else ">")
    shape = entries.get("shape")
    if not isinstance(shape, list) or not all(type(n) is int for n in shape):
        raise InputError(f"{sidecar}: shape {shape!r} must be a list of whole numbers")
    check_array(tuple(shape), dtype, str(sidecar))
    offset = entries.get("offset", 0)
    if type(offset) is not int or offset < 0:
        raise InputError(f"{sidecar}: offset {offset!r} must be a number of bytes")
    array = FileArray(path, dtype, tuple(shape), offset)
    if (extra := path.stat().st_size - offset - nbytes(tuple(shape), dtype)) != 0:
        raise InputError(f"{path}: {extra} bytes more than {sidecar.name} describes")
    return Contents.single(array, described(entries, str(sidecar)), "mapped")


def _sidecar(path: Path) -> tuple[Path, dict[str, Any]] | None:
    """Find the sidecar and its entries.

    Other programs, too, keep notes on ``map.csv`` in ``map.csv.json``.
    """
    both = [path.with_name(path.name + suffix) for suffix in (".toml", ".json")]
    read = [(sidecar, _entries(sidecar)) for sidecar in both if sidecar.is_file()]
    found = [(sidecar, entries) for sidecar, entries in read if {"dtype", "shape"} & set(entries)]
    if len(found) > 1:
        raise InputError(f"{path}: has two sidecars, {both[0].name} and {both[1].name}; keep one")
    return found[0] if found else None


def _entries(sidecar: Path) -> dict[str, Any]:
    if sidecar.stat().st_size > 2**16:
        raise InputError(f"{sidecar}: too large for a sidecar")
    try:
        text = sidecar.read_text("utf-8-sig")
        entries = tomllib.loads(text) if sidecar.suffix == ".toml" else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{sidecar}: cannot be read ({error})") from error
    return entries if isinstance(entries, dict) else {}
