"""HDF5 and netCDF-4 files.

The dataset's attributes ``axes``, ``spacing_mm``, ``origin_mm``, ``scale`` and
``refractive_index`` describe it as a volume; so do its named dimensions and their coordinates.
Axes are named by netCDF's dimensions, HDF5's dimension scales or its dimension labels. Chunks that
were never written are missing, not zero.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import MAX_BSCAN_BYTES, Array, Incomplete, Key, LazyArray, View, nbytes, reversed_axes
from .axes import axes_of_dimensions
from .cf import Decoded
from .contents import Contents, Variable, unit_texts, unit_texts_above
from .hdf5_checks import check_heaps, check_superblock, check_text, find_superblock
from .metadata import DESCRIPTIONS, described
from .units import is_unit_key

FORMAT = "HDF5"

_MAX_OBJECTS = 10_000
_TRIAL_SECONDS = 3.0
_MAX_RATIO = 10_000
# pandas stores the columns of each type apart.
_PANDAS_BLOCK = re.compile(r"(.*/block)(\d+)_values")
#: Attributes by which HDF5 and netCDF keep their own books.
_OWN_ATTRS = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "DIMENSION_LABELS"}
_OWN_ATTRS |= {"_Netcdf4Dimid", "_Netcdf4Coordinates"}

#: What :func:`_numbered_scales` tells of a group, by its name.
_ScalesIn = Callable[[str], Mapping[int, tuple[str, int]]]


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the HDF5 signature at byte 0, 512, 1024 or 2048."""
    return find_superblock(head) is not None


def contents(path: Path, wanted: str | None) -> Contents:
    """Find the datasets, what names their axes and what their attributes say."""
    file = open_file(path)
    try:
        found, texts, unread = {}, unit_texts(_attributes(file), ""), []
        # of a group once: it may hold thousands of arrays
        attributes_of = cache(lambda group: _attributes(file[group]))
        scales_in = cache(lambda group: _numbered_scales(file[group]))
        for name, item in datasets(path, file):
            group = name.rpartition("/")[0]
            texts |= unit_texts_above(name, attributes_of)
            by_octave = group != "" and "OCTAVE_NEW_FORMAT" in file[group].attrs
            if by_octave and name == f"{group}/value":
                name = group
            try:
                kind = item.dtype.kind
            except TypeError:  # times of HDF5 itself, which NumPy has no type for
                unread.append(name)
                continue
            is_text = kind in "SO" and item.size == 1
            if is_text and is_unit_key(name.rpartition("/")[2]):
                check_text(path, item)
                texts[name] = str(_plain(np.asarray(item[()]).ravel()[0]))
            elif kind not in "biufc" and not is_complex_pair(item.dtype):
                unread.append(name)
            elif not _is_bare(item):
                columns_first = by_octave or "MATLAB_class" in item.attrs
                found[name] = _variable(path, file, name, item, columns_first, scales_in)
        unread += [name for name in found if is_unit_key(name.rpartition("/")[2])]
        if wanted is not None and wanted.strip("/") not in found:
            _refuse_links(path, file, wanted.strip("/"))
        return Contents(found, file.close, texts, unread)
    except BaseException:
        file.close()
        raise


def open_file(path: Path) -> Any:
    """Open an HDF5 file for reading.

    Raises
    ------
    InputError
        If its first block is damaged, or its heaps would keep the HDF5 library busy for ever.
    """
    import h5py

    check_superblock(path)
    check_heaps(path)
    return h5py.File(path, "r")


def try_out(path: Path) -> None:
    """Let a process of its own go through a file that may be hostile, under limits.

    Raises
    ------
    InputError
        If it crashes, takes too much memory or does not come to an end.
    """
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


def datasets(path: Path, file: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of a file that hold values, not those that links point to."""
    import h5py

    names: list[str] = []
    count = 0

    def visit(name: str, item: Any) -> bool | None:
        nonlocal count
        count += 1
        if isinstance(item, h5py.Dataset) and item.shape is not None:
            names.append(name)
        return True if count > _MAX_OBJECTS else None

    for root in file:
        # Follows neither soft nor external links: nothing outside this file is opened. Groups with
        # a # are MATLAB's own, and may hold a dataset for every cell.
        if isinstance(file.get(root, getlink=True), h5py.HardLink) and not root.startswith("#"):
            item = file[root]
            visit(root, item)
            if isinstance(item, h5py.Group):
                item.visititems(lambda name, inner, root=root: visit(f"{root}/{name}", inner))
        if count > _MAX_OBJECTS:
            raise InputError(f"{path}: holds more than {_MAX_OBJECTS} objects")
    for name in names:
        yield name, file[name]


def _refuse_links(path: Path, file: Any, name: str) -> None:
    """Refuse a name that leads over a link, and say where it points."""
    import h5py

    parts = name.split("/")
    for n in range(1, len(parts) + 1):
        part = "/".join(parts[:n])
        link = file.get(part, getlink=True)
        if isinstance(link, h5py.SoftLink):
            raise InputError(f"{path}: {part} is a link to {link.path}; name the array by that")
        if isinstance(link, h5py.ExternalLink):
            raise InputError(
                f"{path}: {part} is a link into another file, {link.filename}, and is not followed"
            )
        if link is None:
            return


def stored_array(path: Path, dataset: Any) -> Array:
    """Values of a dataset that lie in this file, NaN where a chunk was never written."""
    _check_stored(path, dataset)
    array = _Stored(path, dataset)
    written = _written_chunks(path, dataset)
    return array if written is None else Incomplete(array, array.chunks, written)


def is_complex_pair(dtype: np.dtype[Any]) -> bool:
    """Tell whether values are pairs ``real`` and ``imag``, as MATLAB stores complex numbers."""
    return set(dtype.names or ()) in ({"real", "imag"}, {"r", "i"})


def _variable(
    path: Path, file: Any, name: str, item: Any, columns_first: bool, scales_in: _ScalesIn
) -> Variable:
    where = f"{path}, variable {name}"
    attrs = {key: value for key, value in _attributes(item).items() if key not in _OWN_ATTRS}
    # a list of variable length is no description: it is refused as a text would be
    stated = {n: _attribute(item, n, "a list") for n in DESCRIPTIONS if n in item.attrs}
    facts = described(stated, where)
    access = "streamed" if item.chunks else "mapped"
    if item.dtype.kind not in "iuf" or columns_first:
        dtype = np.dtype(np.complex128) if item.dtype.names else item.dtype
        if columns_first:  # MATLAB and Octave store the transpose

            def reversed_() -> View:
                return reversed_axes(stored_array(path, item))

            return Variable(item.shape[::-1], dtype, reversed_, access, (), attrs, facts)  # type: ignore[arg-type]
        opened: Any = partial(stored_array, path, item)
        dims = _dims(file, item, scales_in)
        return Variable(item.shape, dtype, opened, access, dims, attrs, facts)  # type: ignore[arg-type]
    dims = _dims(file, item, scales_in)
    decoding = partial(
        Decoded,
        # xarray, which decodes, wants names for all axes, and all of them different.
        dims=[f"axis {number}" for number in range(item.ndim)],
        attrs=attrs,
        fills=_fill_value(item, attrs),
        by_netcdf="_NCProperties" in file.attrs or "_Netcdf4Dimid" in item.attrs,
        where=where,
    )
    unread = decoding(np.broadcast_to(np.zeros((), item.dtype), item.shape))

    def open_decoded() -> LazyArray:
        return LazyArray(decoding(stored_array(path, item)), item.chunks)

    return Variable(item.shape, unread.dtype, open_decoded, access, dims, unread.attrs, facts)  # type: ignore[arg-type]


def _check_stored(path: Path, dataset: Any) -> None:
    """Refuse a dataset whose values lie elsewhere, or are more than what is stored can hold."""
    where = f"{path}: {dataset.name}"
    block = _PANDAS_BLOCK.fullmatch(dataset.name)
    if block and f"{block[1]}{1 - min(int(block[2]), 1)}_values" in dataset.parent:
        raise InputError(
            f"{where} is one part of a pandas table whose columns are of several types; write a "
            "table of floating-point numbers only, or the map alone"
        )
    if dataset.external or dataset.is_virtual:
        raise InputError(f"{where} keeps its samples in other files; copy them into one")
    if dataset.chunks and nbytes(dataset.chunks, dataset.dtype) > MAX_BSCAN_BYTES:
        raise InputError(f"{where} has chunks of {dataset.chunks} samples: too large to read")
    stored = dataset.id.get_storage_size()
    if stored == 0 or nbytes(dataset.shape, dataset.dtype) > max(2**26, _MAX_RATIO * stored):
        raise InputError(f"{where} of shape {dataset.shape} has only {stored} bytes stored")


class _Stored:
    """A dataset; complex where it holds pairs."""

    random_access = True

    def __init__(self, path: Path, dataset: Any) -> None:
        self._dataset, self._where = dataset, f"{path}: {dataset.name}"
        self.shape: tuple[int, ...] = dataset.shape
        pairs = is_complex_pair(dataset.dtype)
        self._parts = [n for n in ("real", "r", "imag", "i") if pairs and n in dataset.dtype.names]
        self.dtype = np.dtype(np.complex128) if pairs else dataset.dtype
        self.chunks = dataset.chunks or (1,) * len(self.shape)

    def __getitem__(self, key: Key) -> NDArray[Any]:
        try:
            stored = self._dataset[key]
        except OSError as error:
            if absent := _absent_filters(self._dataset):
                raise InputError(
                    f"{self._where} is compressed by a filter that is not installed: "
                    f"{', '.join(absent)}. Where it is, write the file anew by "
                    "h5repack -f GZIP=4 old.h5 new.h5"
                ) from error
            raise
        if self._parts:
            values = np.empty(stored.shape, np.complex128)
            values.real, values.imag = (stored[part] for part in self._parts)
            return values
        return np.asarray(stored)


def _absent_filters(dataset: Any) -> list[str]:
    """Filters of a dataset that the library lacks, by their registered number and name."""
    import h5py

    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(number) for number in range(plist.get_nfilters())]
    return [
        f"{code} ({name.decode(errors='replace') or 'without a name'})"
        for code, _, _, name in filters
        if not h5py.h5z.filter_avail(code)
    ]


def _written_chunks(path: Path, dataset: Any) -> NDArray[np.bool_] | None:
    """Which chunks are in the file; None if all are."""
    if not dataset.chunks:
        return None
    counts = [-(-n // size) for n, size in zip(dataset.shape, dataset.chunks, strict=True)]
    expected, stored = int(np.prod(counts, dtype=object)), dataset.id.get_num_chunks()
    if stored >= expected:
        return None
    if expected > 10**7:
        raise InputError(f"{path}: {dataset.name} has {stored} of {expected} chunks written")
    written = np.zeros(counts, bool)
    for number in range(stored):
        offset = dataset.id.get_chunk_info(number).chunk_offset
        at = tuple(start // size for start, size in zip(offset, dataset.chunks, strict=True))
        if all(i < n for i, n in zip(at, counts, strict=True)):
            written[at] = True
    return written


def _is_bare(item: Any) -> bool:
    """Tell whether a dataset stands for a netCDF dimension without coordinates."""
    name = _attribute(item, "NAME", b"") if item.ndim == 1 else b""
    return "This is a netCDF dimension but not a netCDF variable" in str(_plain(name))


def _fill_value(item: Any, attrs: Mapping[str, object]) -> list[float]:
    """Value that the dataset's author chose for what is not written, where it cannot be data."""
    import h5py

    if "_FillValue" in attrs or item.dtype.itemsize < 2:
        return []
    defined = item.id.get_create_plist().fill_value_defined()
    fill = item.fillvalue if defined == h5py.h5d.FILL_VALUE_USER_DEFINED else 0
    return [] if fill == 0 or fill != fill else [fill]  # NaN is missing as it is


def _attributes(item: Any) -> dict[str, object]:
    """Attributes with text for bytes, and a scalar for an array of one number."""
    return {key: _plain(item.attrs[key]) for key in item.attrs if not _is_list(item, key)}


def _attribute(item: Any, key: str, default: object) -> Any:
    """One attribute as the library gives it."""
    return item.attrs[key] if key in item.attrs and not _is_list(item, key) else default


def _is_list(item: Any, key: str) -> bool:
    """Whether an attribute holds lists of variable length, such as references to dimension scales.

    But for those they are never needed, and on damaged ones the library loops or crashes.
    """
    import h5py

    kind = item.attrs.get_id(key).get_type()
    return kind.get_class() == h5py.h5t.VLEN or key == "REFERENCE_LIST"


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _dims(file: Any, item: Any, scales_in: _ScalesIn) -> tuple[str, ...]:
    """Names of a dataset's axes, empty where an axis has none."""
    own = item.name.rpartition("/")[2]
    labels = [str(_plain(label) or "") for label in _attribute(item, "DIMENSION_LABELS", ())]
    if "DIMENSION_SCALE" in str(_plain(_attribute(item, "CLASS", ""))) and item.ndim == 1:
        names = [own]
    else:
        names = _netcdf_dims(item, scales_in) or _scale_dims(file, item)
    if labels and names:
        for axis, (label, name) in enumerate(zip(labels, names, strict=False)):
            if label and name and label != name and item.ndim > 1:
                raise InputError(
                    f"{file.filename}: {item.name}: axis {axis} is labelled {label!r}, but has the "
                    f"scale {name!r}"
                )
        names = [name or label for name, label in zip(names, labels, strict=False)]
    names, listed = names or (labels if any(labels) else []), _listed_dims(item)
    for one, other in zip(*map(axes_of_dimensions, (names, listed)), strict=False):
        if one and other and one != other:
            raise InputError(
                f"{file.filename}: {item.name}: its axes are said to be ({', '.join(listed)}), but "
                f"its dimensions are ({', '.join(names)})"
            )
    names = names or listed or _tagged_dims(item)
    return tuple(names) if len(names) == item.ndim and any(names) else ()


def _listed_dims(item: Any) -> list[str]:
    """Names of axes by an attribute of xarray, or of a NeXus group whose signal this is."""
    names = _attribute(item, "_ARRAY_DIMENSIONS", ())
    above = item.parent
    if str(_plain(_attribute(above, "signal", ""))) == item.name.rpartition("/")[2]:
        names = _attribute(above, "axes", names)
    listed = [str(_plain(name)) for name in np.ravel(names)]
    listed = re.split("[,:]", listed[0].strip("[]")) if len(listed) == 1 else listed
    return ["" if name == "." else name for name in listed]


def _tagged_dims(item: Any) -> list[str]:
    """Names of axes by vigra's and ilastik's attribute."""
    try:
        axes = json.loads(str(_plain(_attribute(item, "axistags", "{}"))))["axes"]
        return [str(axis["key"]) for axis in axes]
    except (ValueError, LookupError, TypeError, RecursionError):
        return []


def _netcdf_dims(item: Any, scales_in: _ScalesIn) -> list[str]:
    """Names of axes by the numbers of netCDF's dimensions.

    Tried before HDF5's lists of references to them: those are of variable length, and a damaged
    length makes the library loop or take gigabytes.
    """
    numbers = np.ravel(_attribute(item, "_Netcdf4Coordinates", ()))
    if len(numbers) != item.ndim:
        return []
    by_number = scales_in(item.parent.name)
    found = [by_number.get(int(number)) for number in numbers]
    fits = all(f is not None and f[1] == n for f, n in zip(found, item.shape, strict=True))
    return [f[0] for f in found if f is not None] if fits else []


def _numbered_scales(group: Any) -> dict[int, tuple[str, int]]:
    """Names and lengths of the dimensions of a group, by netCDF's numbers."""
    import h5py

    by_number = {}
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            scale = group[name]
            if isinstance(scale, h5py.Dataset) and "_Netcdf4Dimid" in scale.attrs:
                number = _attribute(scale, "_Netcdf4Dimid", None)
                if np.shape(number) == () and scale.ndim == 1:
                    by_number[int(number)] = (name, scale.size)
    return by_number


def _scale_dims(file: Any, item: Any) -> list[str]:
    import h5py

    names = []
    for references in item.attrs.get("DIMENSION_LIST", ()):
        first = next(iter(np.ravel(references)), None)
        scale = file[first] if isinstance(first, h5py.Reference) else None
        name = scale.name if scale else None  # None, too, of one that no name leads to any more
        names.append((name or "").rpartition("/")[2])
    return names
