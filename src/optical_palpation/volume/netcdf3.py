"""NetCDF-3 files (classic and 64-bit offset), by way of SciPy."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import Key
from .cf import Decoded
from .contents import Contents, Variable
from .metadata import DESCRIPTIONS, described
from .units import is_unit_key

FORMAT = "netCDF-3"


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the magic; the fifth kind, which SciPy does not read, is recognised to say so."""
    return head[:4] in (b"CDF\x01", b"CDF\x02", b"CDF\x05")


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the header."""
    from scipy.io import netcdf_file

    with path.open("rb") as stream:
        if stream.read(4) == b"CDF\x05":
            raise InputError(f"{path}: is of netCDF's 64-bit data kind; convert it to netCDF-4")
    file: Any = netcdf_file(path, "r", mmap=True)

    def close() -> None:
        with warnings.catch_warnings():  # SciPy warns of arrays that refer to the file
            warnings.simplefilter("ignore")
            file.close()

    try:
        found = {}
        for name, variable in file.variables.items():
            values = _Stored(variable)
            attrs = {key: _plain(value) for key, value in variable._attributes.items()}
            if values.dtype.kind not in "iuf":
                continue
            where = f"{path}, variable {name}"
            stated = described({key: attrs[key] for key in DESCRIPTIONS if key in attrs}, where)
            axes = [f"axis {number}" for number in range(len(values.shape))]
            array = Decoded(values, axes, attrs, by_netcdf=True, where=where)
            found[name] = Variable(
                array.shape,
                array.dtype,
                lambda array=array: array,  # type: ignore[misc]
                "mapped",
                tuple(variable.dimensions),
                array.attrs,
                stated,
            )
        texts = {k: str(_plain(v)) for k, v in file._attributes.items() if is_unit_key(k)}
        return Contents(found, close, texts)
    except BaseException:
        close()
        raise


class _Stored:
    """A variable's values, copied as they are read: they lie in a map of the file."""

    def __init__(self, variable: Any) -> None:
        self._data = variable.data
        self.shape: tuple[int, ...] = tuple(int(n) for n in variable.data.shape)
        self.dtype = variable.data.dtype.newbyteorder("=")

    def __getitem__(self, key: Key) -> NDArray[Any]:
        return np.array(self._data[key], self.dtype)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return value.decode(errors="replace") if isinstance(value, bytes) else value
