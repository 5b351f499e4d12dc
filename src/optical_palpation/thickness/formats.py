"""Arrays and the units they carry out of files, told apart by content and not by suffix."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.thickness.text import MAX_VALUES, read_table
from optical_palpation.volume import archive, hdf5, matlab_v5, numpy_files, tiff

FORMATS = "MATLAB .mat (v5, v7, v7.3), .npy, .npz, .csv, .txt, .tif, NetCDF"


@dataclass(frozen=True)
class Variable:
    """One array of a file, with names of dimensions and attributes as far as the file has them.

    The values stay in the file until they are asked for, so that arrays beside the map, a volume
    perhaps, cost nothing.
    """

    path: Path
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    load: Callable[[], NDArray]
    dims: tuple[str, ...] = ()
    attrs: Mapping[str, object] = field(default_factory=dict)

    @property
    def unit(self) -> str | None:
        """The ``units`` attribute."""
        return str(self.attrs["units"]) if "units" in self.attrs else None

    @property
    def values(self) -> NDArray:
        """The array, read now; an InputError if it is damaged or too large for any map."""
        if math.prod(self.shape) * max(self.dtype.itemsize, 8) > 8 * MAX_VALUES:
            raise InputError(
                f"{self.path}: it states {self.shape} values of type {self.dtype}, far too many "
                f"for a thickness map (at most {MAX_VALUES} values)"
            )
        with _damage_told(self.path):
            return self.load()


def read_variables(path: Path) -> dict[str, Variable]:
    """Find every array of a file.

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
    with _damage_told(path):
        return reader(path)


@contextmanager
def _damage_told(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # whatever a library makes of a damaged file
        raise InputError(
            f"{path} is damaged, truncated or of an unsupported kind: "
            f"{str(error)[:300] or type(error).__name__}"
        ) from error


def _reader_for(head: bytes) -> Callable[[Path], dict[str, Variable]] | None:
    if head.startswith(b"MATLAB 7.3 MAT-file") or (
        head.startswith(b"MATLAB") and head[512:520] == hdf5.MAGIC
    ):
        return _read_matlab_73
    if head.startswith(b"MATLAB 5.0 MAT-file") or head[126:128] in (b"IM", b"MI"):
        return _read_matlab_5
    if head.startswith(hdf5.MAGIC):
        return _read_netcdf_4
    if head[:4] in (b"CDF\x01", b"CDF\x02"):
        return _read_netcdf_3
    if head.startswith(b"\x93NUMPY"):
        return _read_npy
    if head.startswith(b"PK\x03\x04"):
        return _read_npz
    if head[:4] in tiff.MAGIC:
        return _read_tiff
    if b"\0" not in head:
        return _read_text
    return None


def _read_matlab_5(path: Path) -> dict[str, Variable]:
    def load(variable: matlab_v5.Variable) -> NDArray:
        array: Any = matlab_v5.load(path, variable)
        return array[(slice(None),) * len(variable.shape)]

    return {
        name: Variable(path, variable.shape, variable.dtype, partial(load, variable))
        for name, variable in matlab_v5.variables(path).items()
        if variable.dtype is not None
    }


def _datasets(file: Any) -> Iterator[tuple[str, Any]]:
    """Datasets at the root of an open HDF5 file, not those that links point to."""
    import h5py

    for name in file:
        if isinstance(file.get(name, getlink=True), h5py.HardLink):
            item = file[name]
            if isinstance(item, h5py.Dataset) and item.shape is not None:
                yield name, item


def _hdf5_values(path: Path, name: str) -> NDArray:
    import h5py

    with h5py.File(path, "r") as file:
        hdf5.check_stored(path, file[name])
        return np.asarray(file[name][()])


def _read_matlab_73(path: Path) -> dict[str, Variable]:
    def load(name: str, kind: np.dtype[Any]) -> NDArray:
        values = _hdf5_values(path, name)
        if kind.kind == "c":
            values = values["real"] + 1j * values["imag"]
        return values.T.astype(kind, copy=False)

    variables = {}
    with hdf5.open_file(path) as file:
        for name, item in _datasets(file):
            matlab_class = item.attrs.get("MATLAB_class", b"")
            if name.startswith("#") or matlab_class in (b"char", b"cell", b"function_handle"):
                continue
            shape, dtype = item.shape[::-1], item.dtype
            if "MATLAB_empty" in item.attrs:  # holds its shape
                shape = (0, 0)
            elif dtype.names == ("real", "imag"):
                dtype = np.dtype(np.complex128)
            elif matlab_class == b"logical":
                dtype = np.dtype(bool)
            variables[name] = Variable(path, shape, dtype, partial(load, name, dtype))
    return variables


def _read_netcdf_4(path: Path) -> dict[str, Variable]:
    # Not through h5netcdf, which leaves damaged files open and prints tracebacks about them.
    def load(name: str, dims: list[str], attrs: dict[str, object]) -> NDArray:
        return np.asarray(_decoded(name, dims, _hdf5_values(path, name), attrs).values)

    variables = {}
    with hdf5.open_file(path) as file:
        for name, item in _datasets(file):
            if "This is a netCDF dimension but not a netCDF variable" in str(
                _plain(item.attrs.get("NAME", ""))
            ):
                continue
            attrs = {key: _plain(item.attrs[key]) for key in item.attrs if key not in _HDF5_ATTRS}
            # By hand, because HDF5's own search for scales may never end in a damaged file.
            scales = list(item.attrs.get("DIMENSION_LIST", [()] * item.ndim))
            if "DIMENSION_SCALE" in str(_plain(item.attrs.get("CLASS", ""))):
                dims = [name]
            else:
                dims = [
                    file[of_axis[0]].name.lstrip("/") if len(of_axis) else f"dim_{axis}"
                    for axis, of_axis in enumerate(scales)
                ]
            unread = np.broadcast_to(np.zeros((), item.dtype), item.shape)
            decoded = _decoded(name, dims, unread, attrs)
            variables[name] = Variable(
                path,
                item.shape,
                decoded.dtype,
                partial(load, name, dims, attrs),
                tuple(map(str, decoded.dims)),
                decoded.attrs,
            )
    return variables


_HDF5_ATTRS = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"}


def _decoded(name: str, dims: Sequence[str], values: NDArray, attrs: dict[str, object]) -> Any:
    """Apply the conventions for missing values, scale and offset."""
    import xarray as xr

    raw = xr.Variable(dims, values, attrs)
    return xr.conventions.decode_cf_variable(name, raw, decode_times=False)


def _plain(value: object) -> object:
    """Text for bytes, a scalar for an array of one number."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return value.decode() if isinstance(value, bytes) else value


def _read_netcdf_3(path: Path) -> dict[str, Variable]:
    import xarray as xr

    def load(name: str) -> NDArray:
        with xr.open_dataset(path, engine="scipy", decode_times=False) as dataset:
            return np.array(dataset.variables[name].values)

    with xr.open_dataset(path, engine="scipy", decode_times=False) as dataset:
        return {
            str(name): Variable(
                path,
                variable.shape,
                variable.dtype,
                partial(load, str(name)),
                tuple(map(str, variable.dims)),
                variable.attrs,
            )
            for name, variable in dataset.variables.items()
        }


def _read_npy(path: Path) -> dict[str, Variable]:
    with path.open("rb") as stream:
        shape, _, dtype, _ = numpy_files.header(stream, str(path))
    return {"": Variable(path, shape, dtype, partial(np.load, path, allow_pickle=False))}


def _read_npz(path: Path) -> dict[str, Variable]:
    def load(member: str) -> NDArray:
        with (
            archive.open_archive(path) as file,
            archive.open_member(file, file.getinfo(member)) as stream,
        ):
            return np.lib.format.read_array(stream, allow_pickle=False)

    variables = {}
    with archive.open_archive(path) as file:
        for member in file.infolist():
            name = member.filename
            if not name.endswith(".npy"):
                continue
            with archive.open_member(file, member) as stream:
                shape, _, dtype, _ = numpy_files.header(stream, f"{path}: {name}")
            if not dtype.hasobject:  # notes beside the map; never unpickled
                variables[name.removesuffix(".npy")] = Variable(
                    path, shape, dtype, partial(load, name)
                )
    return variables


def _read_tiff(path: Path) -> dict[str, Variable]:
    def load() -> NDArray:
        with _tifffile_silent():
            source = tiff.read(path, None)
            try:
                return source.array[(slice(None),) * len(source.array.shape)]
            finally:
                source.close()

    with _tifffile_silent():
        source = tiff.read(path, None)
        source.close()
    return {"": Variable(path, source.array.shape, source.array.dtype, load)}


@contextmanager
def _tifffile_silent() -> Iterator[None]:
    """Keep tifffile from reporting damage in the log as well."""
    log = logging.getLogger("tifffile")
    disabled, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = disabled


def _read_text(path: Path) -> dict[str, Variable]:
    values = read_table(path)
    return {"": Variable(path, values.shape, values.dtype, lambda: values)}
