"""MATLAB files, v5 to v7 and v7.3.

Axes are counted as MATLAB counts them. Variables ``axes``, ``spacing_mm``, ``origin_mm``, ``scale``
and ``refractive_index`` beside the array describe it. The arrays of v5 to v7 files are loaded
whole where they are compressed (each is one zlib stream) or complex; those of v7.3 files, which are
HDF5, are not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from . import hdf5, matlab_v5
from .arrays import FileArray, reversed_axes
from .metadata import Access, described
from .numpy_files import pick
from .volume import Source

FORMAT = "MATLAB .mat"

_DESCRIPTIONS = ("axes", "spacing_mm", "origin_mm", "scale", "refractive_index")
_ALL = (slice(None),) * 32


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the text at the start and the byte-order mark at byte 126."""
    return head.startswith(b"MATLAB ") and head[126:128] in (b"IM", b"MI")


def read(path: Path, variable: str | None) -> Source:
    """Find the array and its description."""
    with path.open("rb") as stream:
        is_v73 = stream.read(10) == b"MATLAB 7.3"
    return _read_v73(path, variable) if is_v73 else _read_v5(path, variable)


def _read_v73(path: Path, variable: str | None) -> Source:
    import h5py

    file = hdf5.open_file(path)
    try:
        stated: dict[str, Any] = {}
        for name in _DESCRIPTIONS:
            item = file.get(name) if file.get(name, getlink=True) is not None else None
            if isinstance(item, h5py.Dataset) and item.size is not None and item.size <= 100:
                value = item[()]
                text = item.dtype == np.uint16  # MATLAB's char
                stated[name] = "".join(map(chr, np.ravel(value))) if text else value
        dataset = hdf5.find_dataset(path, file, variable)
        array = reversed_axes(hdf5.dataset_array(path, dataset))
        access: Access = "streamed" if dataset.chunks else "mapped"
        return Source(array, described(stated, str(path)), access, file.close)
    except BaseException:
        file.close()
        raise


def _read_v5(path: Path, variable: str | None) -> Source:
    found = matlab_v5.variables(path)
    texts = {n: matlab_v5.load(path, found[n]) for n in _DESCRIPTIONS if n in found}
    stated = {n: t if isinstance(t, str) else t[_ALL[: len(t.shape)]] for n, t in texts.items()}
    arrays = {n: v.shape for n, v in found.items() if n not in _DESCRIPTIONS}
    array = matlab_v5.load(path, found[pick(path, arrays, variable, list(found))])
    if isinstance(array, str):
        raise InputError(f"{path}: {variable} is text, not an array")
    mapped = isinstance(array, FileArray)
    return Source(array, described(stated, str(path)), "mapped" if mapped else "loaded")
