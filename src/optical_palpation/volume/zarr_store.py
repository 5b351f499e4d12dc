"""Zarr stores (v2 and v3) and OME-Zarr images in a folder; needs zarr."""

from __future__ import annotations

import base64
import json
import math
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import MAX_BSCAN_BYTES, Array, Incomplete, LazyArray, View, nbytes, squeezed_axes
from .axes import axes_of_dimensions
from .cf import Decoded
from .contents import Contents, Variable, unit_texts, unit_texts_above
from .metadata import DESCRIPTIONS, Stated, described
from .units import to_mm

FORMAT = "Zarr"

_MARKS = ("zarr.json", ".zarray", ".zgroup")
_METADATA = (*_MARKS, ".zattrs", ".zmetadata")
# Others exist that unpickle what they decode, which would run code from the file.
_CODECS = {
    *("bytes", "transpose", "crc32c", "sharding_indexed", "blosc", "zstd", "gzip", "zlib", "lz4"),
    *("bz2", "lzma", "shuffle", "delta"),
}
# Whose axes have names only, or none.
_OLD_OME = ("0.1", "0.2", "0.3", "before 0.4")
_MAX_ARRAYS = 1000
# Of a B-scan, each of them a file.
_MAX_CHUNKS = 10_000


def recognises(path: Path, head: bytes) -> bool:
    """Tell by Zarr metadata in a folder."""
    return path.is_dir() and any((path / mark).is_file() for mark in _MARKS)


def contents(path: Path, wanted: str | None) -> Contents:
    """Find the arrays and what their attributes say."""
    try:
        import zarr
    except ImportError:
        raise InputError(
            f"{path}: reading Zarr needs zarr: pip install 'optical-palpation[formats]'"
        ) from None

    for mark in path.rglob("*"):
        if mark.name in _METADATA and mark.stat().st_size > 2**20:
            raise InputError(f"{mark}: metadata of more than 1 MiB")
    node: Any = zarr.open(str(path), mode="r")
    if not isinstance(node, zarr.Group):
        return Contents({"": _variable(path, node)})
    image = _ome_image(dict(node.attrs), str(path)) if wanted is None else None
    if image is None:
        found = dict(_arrays(node, "", path))
        texts = unit_texts(dict(node.attrs), "")
        for name in found:
            texts |= unit_texts_above(name, lambda group: dict(node[group].attrs))
        return Contents({n: _variable(path, array) for n, array in found.items()}, texts=texts)
    array: Any = node[image["datasets"][0]["path"]]
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: {image['datasets'][0]['path']} is not an array")
    stated, kept = _ome(image, array.shape, str(path))
    return Contents({"": _variable(path, array, stated, kept)})


def _fill_values(array: Any, attrs: dict[str, Any], where: str) -> list[float]:
    """Values that stand for missing ones; of ``_FillValue`` the text that xarray makes of it."""
    fills = []
    if isinstance(coded := attrs.get("_FillValue"), str):
        try:
            (fill,) = struct.unpack("<d", base64.b64decode(attrs.pop("_FillValue"), validate=True))
        except (ValueError, struct.error):
            raise InputError(f"{where}: _FillValue is {coded!r}, no number") from None
        fills.append(fill)
    # As in HDF5, one of 256 values may be data as well, unless xarray wrote it as what is missing.
    chosen = np.dtype(array.dtype).itemsize > 1 or "_ARRAY_DIMENSIONS" in array.attrs
    if array.fill_value is not None and array.fill_value != 0 and chosen:
        fills.append(float(array.fill_value))
    return [fill for fill in fills if math.isfinite(fill)]


def _variable(
    path: Path, array: Any, stated: Stated | None = None, kept: list[int] | None = None
) -> Variable:
    """An array, or of an OME-Zarr image what is stated of it and the axes that are spatial."""
    where = f"{path}: {array.path or 'array'}"
    attrs = dict(array.attrs)
    if stated is None:
        stated = described({key: attrs[key] for key in DESCRIPTIONS if key in attrs}, where)
    named = getattr(array.metadata, "dimension_names", None) or attrs.pop("_ARRAY_DIMENSIONS", ())
    named = [str(name or "") for name in named] if len(named) == array.ndim else []
    kept = kept or _kept_axes(array.shape, named)
    dims = tuple(named[a] for a in kept) if named else ()
    dtype = np.dtype(array.dtype)
    shape = tuple(array.shape[a] for a in kept)
    if dtype.kind not in "iuf":
        return Variable(
            shape, dtype, lambda: _opened(path, array, kept, where), "streamed", dims, attrs, stated
        )
    axes = [f"axis {number}" for number in range(len(shape))]
    decoding = partial(
        Decoded, dims=axes, attrs=attrs, fills=_fill_values(array, attrs, where), where=where
    )
    unread = decoding(np.broadcast_to(np.zeros((), dtype), shape))

    def opened() -> Array:
        return decoding(_opened(path, array, kept, where))

    return Variable(shape, unread.dtype, opened, "streamed", dims, unread.attrs, stated)


def _kept_axes(shape: tuple[int, ...], named: list[str]) -> list[int]:
    """Axes but for those of length one that are not spatial; all, where it is unclear which.

    Of several that lie apart one could be y, as of (1, 400, 500, 1); neighbours are the same.
    """
    spatial = [axis for axis, of in enumerate(axes_of_dimensions(named)) if of is not None]
    single = [axis for axis, n in enumerate(shape) if n == 1 and axis not in spatial]
    kept = squeezed_axes(shape, spatial=spatial)
    apart = bool(single) and single[-1] - single[0] >= len(single)
    unclear = apart and len(shape) - len(kept) < len(single)
    return list(range(len(shape))) if unclear else kept


def _opened(path: Path, array: Any, kept: list[int], where: str) -> Array:
    """Check what the library does not, and hand the array over with the axes that are kept."""
    _check_codecs(array.metadata.to_dict(), where)
    if min(array.chunks, default=0) < 1:
        raise InputError(f"{where} has chunks of {array.chunks} samples: damaged")
    if nbytes(array.chunks, np.dtype(array.dtype)) > MAX_BSCAN_BYTES:
        raise InputError(f"{where} has chunks of {array.chunks} samples: too large to read")
    per_axis = [-(-n // c) for n, c in zip(array.shape, array.chunks, strict=True)]
    if math.prod(sorted(per_axis)[-2:]) > _MAX_CHUNKS:
        raise InputError(
            f"{where} has chunks of {array.chunks} samples: too small to read; rechunk it"
        )
    # what is a file: a chunk, or a shard of several
    size = getattr(array, "shards", None) or array.chunks
    stored = _stored_chunks(path / array.path, array, size)
    absent = stored.size - np.count_nonzero(stored)
    if absent == stored.size:
        raise InputError(f"{where} has no samples stored")
    if array.fill_value is None and absent:
        raise InputError(
            f"{where} lacks {absent} of {stored.size} chunks, and no fill value says what they "
            "hold: copy it whole, or give it the fill value NaN"
        )
    _check_blosc(path / array.path, array, where)
    whole: Array = LazyArray(array, array.chunks)
    if absent:
        whole = Incomplete(whole, size, stored)
    return View(whole, tuple(kept))


def _stored_chunks(folder: Path, array: Any, size: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which chunks, or shards, lie in the folder of an array."""
    files = {file.relative_to(folder).as_posix() for file in folder.rglob("*")}
    key_of = array.metadata.encode_chunk_key
    counts = [-(-n // step) for n, step in zip(array.shape, size, strict=True)]
    stored = [key_of(place) in files for place in np.ndindex(*counts)]
    return np.array(stored, bool).reshape(counts)


def _arrays(group: Any, prefix: str, path: Path) -> list[tuple[str, Any]]:
    found = []
    for name, member in group.members(max_depth=3):
        found.append((prefix + name, member))
        if len(found) > _MAX_ARRAYS:
            raise InputError(f"{path}: holds more than {_MAX_ARRAYS} arrays")
    return [(name, member) for name, member in found if hasattr(member, "chunks")]


def _check_codecs(metadata: Any, where: str) -> None:
    """Allow known codecs only, at any depth (shards hold codecs of their own)."""
    if isinstance(metadata, dict):
        for key in ("codecs", "index_codecs", "filters"):
            for codec in metadata.get(key) or ():
                _check_codec(codec, where)
        if metadata.get("compressor"):
            _check_codec(metadata["compressor"], where)


def _check_blosc(folder: Path, array: Any, where: str) -> None:
    """Check the sizes that Blosc chunks claim: its decoder reads beyond the end of short ones."""
    codecs = json.dumps(array.metadata.to_dict(), default=lambda codec: codec.get_config())
    if '"blosc"' not in codecs:
        return
    if '"sharding_indexed"' in codecs:
        raise InputError(f"{where} has Blosc in shards; write it with Zstandard")
    size = nbytes(array.chunks, array.dtype)
    for chunk in folder.rglob("*"):
        if chunk.is_file() and chunk.name not in _METADATA:
            with chunk.open("rb") as stream:
                head = stream.read(16)
            if len(head) < 16 or struct.unpack_from("<I4xI", head, 4) != (
                size,
                chunk.stat().st_size,
            ):
                raise InputError(f"{where}: chunk {chunk.name} is damaged")


def _check_codec(codec: Any, where: str) -> None:
    entries = codec if isinstance(codec, dict) else codec.get_config()
    name = entries.get("name") or entries.get("id")
    if name not in _CODECS:
        raise InputError(f"{where} is coded by {name!r}; known: {', '.join(sorted(_CODECS))}")
    _check_codecs(entries.get("configuration"), where)


def _ome_image(attributes: Any, where: str) -> Any:
    """Find the description of an OME-Zarr image, of the layout that the rest relies on."""
    for level in (attributes, attributes.get("ome")):
        if isinstance(level, dict) and level.get("multiscales"):
            try:
                image = level["multiscales"][0]
                version = image.get("version", "before 0.4")
                bare = all(isinstance(axis, str) for axis in image.get("axes", ()))
                if bare and version in _OLD_OME:
                    raise InputError(
                        f"{where}: its OME-Zarr metadata, version {version}, are too old, without "
                        "units and scale; convert it to version 0.4 or later"
                    )
                axes_named = all(isinstance(axis["name"], str) for axis in image["axes"])
                if axes_named and isinstance(image["datasets"][0]["path"], str):
                    return image
            except (AttributeError, LookupError, TypeError):
                pass
            raise InputError(f"{where}: its OME-Zarr metadata are damaged")
    return None


def _ome(image: Any, shape: tuple[int, ...], where: str) -> tuple[Stated, list[int]]:
    """Axes, scale and origin of an OME-Zarr image, and the numbers of its spatial axes."""
    axes = image["axes"]
    factors: Any = np.ones(len(shape))
    shifts: Any = np.zeros(len(shape))
    for level in (image["datasets"][0], image):  # applied one after the other
        for transform in level.get("coordinateTransformations") or ():
            kind = transform.get("type")
            values = np.asarray(transform.get(kind, np.nan), float).ravel()
            if kind not in ("scale", "translation") or values.size != len(shape):
                raise InputError(f"{where}: its coordinateTransformations are not understood")
            shifts = shifts * values if kind == "scale" else shifts + values
            factors = factors * values if kind == "scale" else factors
    if not len(axes) == len(factors) == len(shape):
        raise InputError(f"{where}: {len(axes)} named axes for an array of shape {shape}")
    kept = [i for i, axis in enumerate(axes) if axis["name"] in ("z", "y", "x")]
    if any(shape[i] != 1 for i in range(len(shape)) if i not in kept):
        raise InputError(f"{where}: holds several channels or times {shape}, not one volume")
    spacing = [
        to_mm(factors[i], axes[i]["unit"], where) if axes[i].get("unit") else None for i in kept
    ]
    origin = None
    if shifts.any() and all(axes[i].get("unit") for i in kept):
        origin = tuple(to_mm(shifts[i], axes[i]["unit"], where) for i in kept)
    return Stated("".join(axes[i]["name"] for i in kept), tuple(spacing), origin), kept
