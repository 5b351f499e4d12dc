"""Arrays and the units they carry out of files, told apart by content and not by suffix."""

from __future__ import annotations

import logging
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError

_MAX_BYTES = 2**29  # of one array; maps have a hundredth of it
FORMATS = "MATLAB .mat (v5, v7, v7.3), .npy, .npz, .csv, .txt, .tif, NetCDF"


@dataclass(frozen=True)
class Variable:
    """One array of a file, with names of dimensions and attributes as far as the file has them."""

    values: NDArray
    dims: tuple[str, ...] = ()
    attrs: Mapping[str, object] = field(default_factory=dict)

    @property
    def unit(self) -> str | None:
        """The ``units`` attribute."""
        return str(self.attrs["units"]) if "units" in self.attrs else None


def read_variables(path: Path) -> dict[str, Variable]:
    """Read every array of a file.

    Parameters
    ----------
    path
        File in one of the formats of ``FORMATS``; recognised by its first bytes.

    Returns
    -------
    dict
        Arrays by name, indexed [row, column] as their authors saw them (MATLAB's column order is
        undone). The name is ``""`` in formats that hold a single unnamed array.

    Raises
    ------
    InputError
        If the file is missing, empty, a directory, unreadable, damaged or of an unknown format.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a directory; give one file ({FORMATS})")
        if not path.exists():
            raise InputError(f"{path}: no such file")
        if not path.is_file():
            raise InputError(f"{path} is no regular file")
        with path.open("rb") as file:
            head = file.read(4096)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read: {error}") from error
    if not head:
        raise InputError(f"{path} is empty")
    reader = _reader_for(head)
    if reader is None:
        raise InputError(
            f"{path} is in no format that holds a thickness map ({FORMATS}); "
            f"it begins with the bytes {head[:8].hex(' ')}"
        )
    try:
        return reader(path)
    except InputError:
        raise
    except Exception as error:  # whatever a library makes of a damaged file
        kind = reader.__name__.removeprefix("_read_").replace("_", " ")
        raise InputError(
            f"{path} is damaged, truncated or no valid {kind} file: {error or type(error).__name__}"
        ) from error


def _reader_for(head: bytes) -> Callable[[Path], dict[str, Variable]] | None:
    hdf5 = b"\x89HDF\r\n\x1a\n"
    if head.startswith(b"MATLAB 7.3 MAT-file") or (
        head.startswith(b"MATLAB") and head[512:520] == hdf5
    ):
        return _read_matlab_73
    if head.startswith(b"MATLAB 5.0 MAT-file") or head[126:128] in (b"IM", b"MI"):
        return _read_matlab_5
    if head.startswith(hdf5):
        return _read_netcdf_4
    if head[:4] in (b"CDF\x01", b"CDF\x02"):
        return _read_netcdf_3
    if head.startswith(b"\x93NUMPY"):
        return _read_npy
    if head.startswith(b"PK\x03\x04"):
        return _read_npz
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _read_tiff
    if b"\0" not in head:
        return _read_text
    return None


def _read_matlab_5(path: Path) -> dict[str, Variable]:
    from scipy.io import loadmat

    content = path.read_bytes()
    _check_matlab_elements(content[128:], "<" if content[126:128] == b"IM" else ">")
    contents = loadmat(path, appendmat=False)
    return {
        name: Variable(values)
        for name, values in contents.items()
        if isinstance(values, np.ndarray) and not name.startswith("__")
    }


def _check_matlab_elements(content: bytes, order: str) -> None:
    """Raise ValueError unless the elements of a MATLAB 5 file have known types and fit in it.

    SciPy's compiled reader trusts both, and takes the whole process down where they are wrong.
    """
    position = 0
    while position < len(content):
        kind, size = struct.unpack_from(f"{order}2I", content, position)
        start = position + 8
        position = start + size + -size % 8
        room = len(content) - start
        if kind >> 16:  # a small element: size, type and up to four bytes of data in eight bytes
            kind, size, room = kind & 0xFFFF, kind >> 16, 4
            position = start
        if kind not in _MATLAB_TYPES or size > room:
            raise ValueError("an element has an unknown type or reaches beyond the end")
        if kind == _MATLAB_COMPRESSED:  # the only elements that are not padded
            _check_matlab_elements(zlib.decompress(content[start : start + size]), order)
            position = start + size
        elif kind == _MATLAB_MATRIX:
            _check_matlab_elements(content[start : start + size], order)


_MATLAB_MATRIX, _MATLAB_COMPRESSED = 14, 15
_MATLAB_TYPES = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, _MATLAB_MATRIX, _MATLAB_COMPRESSED, 16, 17, 18}


def _read_matlab_73(path: Path) -> dict[str, Variable]:
    import h5py

    variables = {}
    _check_hdf5_heaps(path.read_bytes())
    with h5py.File(path, "r") as file:
        for name, item in file.items():
            if not isinstance(item, h5py.Dataset) or name.startswith("#"):
                continue
            matlab_class = item.attrs.get("MATLAB_class", b"")
            if matlab_class in (b"char", b"cell", b"function_handle"):
                continue
            values = _hdf5_values(item)
            if "MATLAB_empty" in item.attrs:
                values = np.empty([int(length) for length in values.ravel()])
            elif values.dtype.names == ("real", "imag"):
                values = (values["real"] + 1j * values["imag"]).T
            else:
                values = values.astype(bool).T if matlab_class == b"logical" else values.T
            variables[name] = Variable(values)
    return variables


def _check_hdf5_heaps(content: bytes) -> None:
    """Raise ValueError where HDF5 would walk along the objects of a damaged heap for ever."""
    heap = b"GCOL\x01\0\0\0"
    start = content.find(heap)
    while start >= 0:
        position, end = (
            start + 16,
            start + int.from_bytes(content[start + 8 : start + 16], "little"),
        )
        while position + 16 <= min(end, len(content)):
            index, size = struct.unpack_from("<H6xQ", content, position)
            step = (16 + size + -size % 8 if index else size) % 2**64  # HDF5's arithmetic
            if step == 0:
                raise ValueError("a heap has an object without size")
            position += step
        start = content.find(heap, start + 8)


def _bounded(array: Any) -> Any:
    """Return `array` unless its size, which a damaged header may state, would exhaust memory."""
    if array.size * array.dtype.itemsize > _MAX_BYTES:
        raise ValueError(f"it states {array.shape} values of type {array.dtype}, far too many")
    return array


def _hdf5_values(dataset: Any) -> NDArray:
    """Values of a dataset; of a volume beside the map only shape and type, which stay unread."""
    if dataset.ndim > 2:
        return np.broadcast_to(np.zeros((), dataset.dtype), dataset.shape)
    return np.asarray(_bounded(dataset)[()])


def _read_netcdf_4(path: Path) -> dict[str, Variable]:
    # Not through h5netcdf, which leaves damaged files open and prints tracebacks about them.
    import h5py

    variables = {}
    _check_hdf5_heaps(path.read_bytes())
    with h5py.File(path, "r") as file:
        for name, item in file.items():
            if not isinstance(item, h5py.Dataset):
                continue
            attrs = {key: _plain(item.attrs[key]) for key in item.attrs if key not in _HDF5_ATTRS}
            if "This is a netCDF dimension but not a netCDF variable" in str(
                _plain(item.attrs.get("NAME", ""))
            ):
                continue
            # By hand, because HDF5's own search for scales may never end in a damaged file.
            scales = list(item.attrs.get("DIMENSION_LIST", [()] * item.ndim))
            if "DIMENSION_SCALE" in str(_plain(item.attrs.get("CLASS", ""))):
                dims = [name]
            else:
                dims = [
                    file[of_axis[0]].name.lstrip("/") if len(of_axis) else f"dim_{axis}"
                    for axis, of_axis in enumerate(scales)
                ]
            variables[name] = _decoded(name, dims, _hdf5_values(item), attrs)
    return variables


_HDF5_ATTRS = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"}


def _read_netcdf_3(path: Path) -> dict[str, Variable]:
    import xarray as xr

    with xr.open_dataset(path, engine="scipy", decode_times=False) as dataset:
        return {
            str(name): Variable(
                np.asarray(variable.values), tuple(map(str, variable.dims)), variable.attrs
            )
            for name, variable in dataset.variables.items()
        }


def _decoded(name: str, dims: Sequence[str], values: NDArray, attrs: dict[str, object]) -> Variable:
    """Apply the conventions for missing values, scale and offset."""
    import xarray as xr

    raw = xr.Variable(dims, values, attrs)
    decoded = xr.conventions.decode_cf_variable(name, raw, decode_times=False)
    return Variable(np.asarray(decoded.values), tuple(map(str, decoded.dims)), decoded.attrs)


def _plain(value: object) -> object:
    """Text for bytes, a scalar for an array of one number."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return value.decode() if isinstance(value, bytes) else value


def _read_npy(path: Path) -> dict[str, Variable]:
    return {"": Variable(np.asarray(np.load(path, allow_pickle=False)))}


def _read_npz(path: Path) -> dict[str, Variable]:
    variables = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            if not member.endswith(".npy"):
                continue
            with archive.open(member) as file:
                try:
                    values = np.lib.format.read_array(file, allow_pickle=False)
                except ValueError as error:
                    if "Object arrays" in str(error):  # notes beside the map; never unpickled
                        continue
                    raise
            variables[member.removesuffix(".npy")] = Variable(values)
    return variables


def _read_tiff(path: Path) -> dict[str, Variable]:
    import tifffile

    log = logging.getLogger("tifffile")
    disabled, log.disabled = log.disabled, True  # it reports damage there, too
    try:
        with tifffile.TiffFile(path) as file:
            return {"": Variable(np.asarray(_bounded(file.series[0]).asarray()))}
    finally:
        log.disabled = disabled


def _read_text(path: Path) -> dict[str, Variable]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is neither UTF-8 text nor in another format that holds a thickness map "
            f"({FORMATS})"
        ) from error
    lines = [
        (number, line)
        for number, raw in enumerate(text.splitlines(), start=1)
        if (line := raw.split("#")[0].split("%")[0].rstrip()).strip()
    ]
    if not lines:
        raise InputError(f"{path} holds no numbers, only blank lines or comments")
    delimiter = next((mark for mark in "\t;," if mark in lines[0][1]), None)
    rows = [(number, [cell.strip() for cell in line.split(delimiter)]) for number, line in lines]
    header = rows[0][1]
    if all(_number(cell) is None for cell in header):
        if {cell.lower().split("_")[0] for cell in header} >= {"x", "y"}:
            raise InputError(
                f"{path}, line {rows[0][0]}: the header {', '.join(header)} says that this is a "
                "list of points; a map needs one line per row of pixels"
            )
        del rows[0]
    if not rows:
        raise InputError(f"{path} holds a header line but no numbers")
    values = np.empty((len(rows), len(rows[0][1])))
    for row, (number, cells) in enumerate(rows):
        if len(cells) != values.shape[1]:
            raise InputError(
                f"{path}, line {number}: {len(cells)} columns where the lines before have "
                f"{values.shape[1]}"
            )
        for column, cell in enumerate(cells):
            value = _number(cell)
            if value is None:
                raise InputError(
                    f"{path}, line {number}, column {column + 1}: {cell[:40]!r} is no number"
                )
            values[row, column] = value
    return {"": Variable(values)}


def _number(cell: str) -> float | None:
    """Value of a cell, NaN if it is empty (a missing pixel), None if it is no number."""
    if not cell or cell.upper() in ("NA", "N/A"):
        return np.nan
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
