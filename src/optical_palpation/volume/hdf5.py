"""HDF5 and netCDF-4 files.

The dataset's attributes ``axes``, ``spacing_mm``, ``origin_mm``, ``scale`` and
``refractive_index`` describe it; in netCDF the named dimensions and their coordinates do.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import MAX_BSCAN_BYTES, LazyArray, check_array, nbytes
from .metadata import Access, Stated, described, to_mm
from .numpy_files import pick
from .volume import Source

FORMAT = "HDF5"

MAGIC = b"\x89HDF\r\n\x1a\n"
_MAX_OBJECTS = 10_000
_TRIAL_SECONDS = 3.0
_MAX_RATIO = 10_000


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the HDF5 signature at byte 0, 512, 1024 or 2048."""
    return any(head[at : at + 8] == MAGIC for at in (0, 512, 1024, 2048))


def read(path: Path, variable: str | None) -> Source:
    """Find the dataset and what its attributes say."""
    file = open_file(path)
    try:
        dataset = find_dataset(path, file, variable)
        access: Access = "streamed" if dataset.chunks else "mapped"
        return Source(dataset_array(path, dataset), _stated(path, dataset), access, file.close)
    except BaseException:
        file.close()
        raise


def open_file(path: Path) -> Any:
    """Open an HDF5 file that a process of its own has been through without harm."""
    import h5py

    script = str(Path(__file__).with_name("hdf5_trial.py"))
    trial = subprocess.Popen(
        [sys.executable, "-P", script, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert trial.stdout is not None
        trial.stdout.readline()  # "ready": a slow start does not count
        _, complaint = trial.communicate(timeout=_TRIAL_SECONDS)
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{path}: the HDF5 library did not get through it in {_TRIAL_SECONDS} s: damaged"
        ) from None
    finally:
        trial.kill()
        trial.communicate()
    if trial.returncode != 0:
        reason = (complaint.strip().splitlines() or ["the HDF5 library crashed"])[-1][:200]
        raise InputError(f"{path}: damaged HDF5 file ({reason})")
    return h5py.File(path, "r")


def find_dataset(path: Path, file: Any, variable: str | None) -> Any:
    """Find the dataset of that name, or the only one that can be a volume."""
    import h5py

    shapes: dict[str, tuple[int, ...]] = {}
    count = 0

    def visit(name: str, item: Any) -> bool | None:
        nonlocal count
        count += 1
        if isinstance(item, h5py.Dataset) and item.shape:
            shapes[name] = item.shape
        return True if count > _MAX_OBJECTS else None

    # Follows neither soft nor external links: nothing outside this file is opened.
    if file.visititems(visit):
        raise InputError(f"{path}: holds more than {_MAX_OBJECTS} objects")
    name = variable.strip("/") if variable is not None else None
    return file[pick(path, shapes, name, list(shapes))]


def dataset_array(path: Path, dataset: Any) -> LazyArray:
    """Array of a dataset whose samples lie in this file."""
    names = dataset.dtype.names
    parts = set(names or ()) == {"real", "imag"}
    dtype = np.dtype(np.complex128) if parts else dataset.dtype
    check_array(dataset.shape, dtype, f"{path}: {dataset.name}")
    check_stored(path, dataset)
    return LazyArray(_MatlabComplex(dataset) if parts else dataset, dataset.chunks)


def check_stored(path: Path, dataset: Any) -> None:
    """Refuse a dataset whose values lie elsewhere, or are more than what is stored can hold."""
    where = f"{path}: {dataset.name}"
    if dataset.external or dataset.is_virtual:
        raise InputError(f"{where} keeps its samples in other files; copy them into one")
    if dataset.chunks and nbytes(dataset.chunks, dataset.dtype) > MAX_BSCAN_BYTES:
        raise InputError(f"{where} has chunks of {dataset.chunks} samples: too large to read")
    stored = dataset.id.get_storage_size()
    if stored == 0 or nbytes(dataset.shape, dataset.dtype) > max(2**26, _MAX_RATIO * stored):
        raise InputError(f"{where} of shape {dataset.shape} has only {stored} bytes stored")


class _MatlabComplex:
    """Complex samples stored as pairs named ``real`` and ``imag``, as MATLAB does."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self.shape = dataset.shape
        self.dtype = np.dtype(np.complex128)

    def __getitem__(self, key: tuple[slice, ...]) -> NDArray[Any]:
        pairs = self._dataset[key]
        values = np.empty(pairs.shape, np.complex128)
        values.real, values.imag = pairs["real"], pairs["imag"]
        return values


def _stated(path: Path, dataset: Any) -> Stated:
    where = f"{path}: {dataset.name}"
    names = ("axes", "spacing_mm", "origin_mm", "scale", "refractive_index")
    stated = described({n: dataset.attrs[n] for n in names if n in dataset.attrs}, where)
    if stated.axes is None and stated.spacing is None and len(dataset.shape) == 3:
        return _netcdf(dataset, stated, where)
    return stated


def _netcdf(dataset: Any, stated: Stated, where: str) -> Stated:
    """Axes, spacing and origin from dimension scales called z, y and x."""
    import h5py

    # By the numbers of netCDF's dimensions, not by HDF5's lists of references to them: those are of
    # variable length, and a damaged length makes the library loop or take gigabytes.
    numbers = np.ravel(dataset.attrs.get("_Netcdf4Coordinates", ()))
    by_number = {
        int(item.attrs["_Netcdf4Dimid"]): item
        for name in ("z", "y", "x")
        if isinstance(item := dataset.parent.get(name), h5py.Dataset)
        and np.shape(item.attrs.get("_Netcdf4Dimid")) == ()
    }
    scales = [by_number.get(int(n)) for n in numbers]
    axes = "".join(s.name.rpartition("/")[2] if s is not None else "?" for s in scales)
    if sorted(axes) != ["x", "y", "z"] or dataset.shape != tuple(s.size for s in scales if s):
        return stated
    spacing: list[float | None] = []
    origin = []
    for axis in axes:
        scale = dataset.parent[axis]
        units = scale.attrs.get("units")
        if units is None or scale.ndim != 1 or not 1 <= scale.size <= 10**7:
            return Stated(axes=axes, scale=stated.scale, refractive_index=stated.refractive_index)
        unit = units.decode() if isinstance(units, bytes) else str(units)
        positions = np.asarray(scale[()], float)
        steps = np.diff(positions)
        if len(steps) and not np.allclose(steps, steps.mean(), rtol=1e-3, atol=0):
            raise InputError(f"{where}: coordinate {axis} is not evenly spaced")
        spacing.append(to_mm(steps.mean(), unit, where) if len(steps) else None)
        origin.append(to_mm(positions[0], unit, where))
    return Stated(axes, tuple(spacing), tuple(origin), stated.scale, stated.refractive_index)
