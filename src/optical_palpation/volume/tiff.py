"""TIFF, OME-TIFF and ImageJ stacks.

Pages are taken for B-scans (rows z, columns x), the way OCT software exports them, except in
OME-TIFF with a Z dimension, whose named dimensions are believed. Resolution tags are trusted only
where ImageJ or OME metadata name their unit: plain ones
more often hold a printer's 72 dpi.
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .archive import check_ratio
from .arrays import (
    MAX_BSCAN_BYTES,
    FileArray,
    PagedArray,
    check_array,
    nbytes,
    squeezed,
    squeezed_axes,
)
from .cf import Decoded
from .contents import Contents, Variable
from .metadata import Access, Stated, parse_xml
from .remarks import unclear_unit, units_of_remarks
from .units import length_unit, to_mm

FORMAT = "TIFF"

MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_MAX_PAGES, _MAX_TAGS = 100_000, 4096
_LZW, _ORIENTATION = 5, 274
_UNCALIBRATED = 20  # ImageJ's number of the calibration function "none"
_NO_CHANGE = {"scale": 1.0, "offset": 0.0}
_NO_UNIT = ("", "gray value", "grey value", "pixel value")  # of ImageJ's samples
# Vendors' multi-page conventions; some follow references to other files.
_VENDORS = (
    *("lsm", "mmstack", "ndtiff", "fluoview", "stk", "sis", "svs", "scn", "qpi", "ndpi", "bif"),
    *("avs", "eer", "philips", "scanimage", "nih", "mdgel", "ome"),
)


def recognises(path: Path, head: bytes) -> bool:
    """Tell by the byte-order mark of TIFF or BigTIFF."""
    return head[:4] in MAGIC


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the page directories."""
    import tifffile

    _check_directories(path)
    ignored: dict[str, Any] = {f"is_{vendor}": False for vendor in _VENDORS}
    with _tifffile_silent():
        file = tifffile.TiffFile(path, **ignored)
        try:
            return _contents(path, file)
        except BaseException:
            file.close()
            raise


@contextmanager
def _tifffile_silent() -> Iterator[None]:
    """Keep tifffile from reporting damage in the log as well."""
    log = logging.getLogger("tifffile")
    disabled, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = disabled


def _check_directories(path: Path) -> None:
    """Walk the chain of page directories once: tifffile follows a circular one for ever."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = _exactly(stream, 16, path)
        order = "<" if head[:2] == b"II" else ">"
        big = head[2:4] in (b"+\x00", b"\x00+")
        count, tag, link = ("Q", 20, "Q") if big else ("H", 12, "I")
        link_size = struct.calcsize(link)
        (position,) = struct.unpack_from(order + link, head, 8 if big else 4)
        seen: set[int] = set()
        while position:
            if position in seen or len(seen) >= _MAX_PAGES:
                raise InputError(f"{path}: its chain of pages is circular or too long: damaged")
            if position >= size:
                raise InputError(
                    f"{path}: page directory {len(seen)} lies beyond the end: truncated"
                )
            seen.add(position)
            stream.seek(position)
            (tags,) = struct.unpack(order + count, _exactly(stream, struct.calcsize(count), path))
            end = position + struct.calcsize(count) + tags * tag
            if tags > _MAX_TAGS or end > size:
                raise InputError(f"{path}: page directory {len(seen) - 1} is damaged")
            entries = _exactly(stream, tags * tag, path)
            for at in range(0, len(entries), tag):
                if struct.unpack_from(order + "H", entries, at)[0] == _ORIENTATION:
                    value = struct.unpack_from(order + "H", entries, at + tag - link_size)[0]
                    _check_orientation(path, value)
            (position,) = struct.unpack(order + link, _exactly(stream, struct.calcsize(link), path))


def _check_orientation(path: Path, orientation: int) -> None:
    if orientation != 1:
        raise InputError(
            f"{path}: its orientation tag says {orientation}, that rows or columns run from "
            "another corner than the top left, which most software overlooks: turn the image as it "
            "should be and save it with orientation 1"
        )


def _exactly(stream: IO[bytes], n: int, path: Path) -> bytes:
    data = stream.read(n)
    if len(data) != n:
        raise InputError(f"{path}: ends within its chain of pages: truncated")
    return data


def page_array(path: Path, file: Any) -> Any:
    """Array of an open TIFF file's only series of pages, but for smaller copies of it."""
    if file.is_imagej:
        _check_planes(path, file)
    if not file.series:
        raise InputError(f"{path}: holds no pages")
    series, *others = (s for n, s in enumerate(file.series) if n == 0 or not s.keyframe.is_reduced)
    if others:
        kinds = "; ".join(map(_kind, (series, *others[:4])))
        raise InputError(
            f"{path}: its pages differ: {kinds}. One stack is needed: save it alone, with NaN "
            "where a mask marks values as missing"
        )
    page = series.keyframe
    shape, dtype = tuple(series.shape[axis] for axis in _axes(series)), series.dtype
    if dtype is None or page.dtype is None:
        raise InputError(f"{path}: samples of an unsupported type")
    if page.samplesperpixel != 1 or page.photometric not in (0, 1):
        raise InputError(f"{path}: colour images; save the OCT signal in grey")
    if page.photometric == 0:
        raise InputError(f"{path}: inverted grey (0 is white); save it with 0 as black")
    if page.is_volumetric:
        raise InputError(f"{path}: volumetric tiles {page.tile}; save it as a stack of pages")
    if page.compression == _LZW and page.fillorder != 1:
        raise InputError(f"{path}: LZW with reversed bits; save it uncompressed or with deflate")
    check_array(shape, dtype, str(path))
    if series.dataoffset is not None and page.is_memmappable:
        return FileArray(path, dtype.newbyteorder(file.byteorder), shape, series.dataoffset)

    rows, columns = page.shape
    pages = len(series)
    if (pages, rows, columns) != (shape if len(shape) == 3 else (1, *shape)):
        raise InputError(f"{path}: {pages} pages of {page.shape} do not make up {shape}")
    if nbytes(page.shape, dtype) > MAX_BSCAN_BYTES:
        raise InputError(f"{path}: pages of {page.shape} samples are too large")
    for number, single in enumerate(series.pages):
        _check_segments(path, number, single, page)

    def read_page(index: int) -> NDArray[Any]:
        if page.compression == _LZW:
            _check_lzw(path, index, series.pages[index])
        with _tifffile_silent():
            return np.asarray(series.pages[index].asarray(maxworkers=1))

    array: Any = PagedArray(read_page, dtype, (pages, rows, columns))
    return squeezed(array, keep=2) if len(shape) == 2 else array


def _check_planes(path: Path, file: Any) -> None:
    """Refuse an ImageJ stack of more or fewer planes than its description says.

    It may have one page directory only: the other planes follow the first one. A description of
    one plane says nothing of a stack that was put together of such files.
    """
    metadata = file.imagej_metadata or {}
    page, pages = file.pages.first, len(file.pages)
    said = {metadata.get("images", 1)}
    said.add(math.prod(metadata.get(name, 1) for name in ("frames", "slices", "channels")))
    for planes in sorted(n for n in said if n != 1):
        held = pages
        if pages < planes and page.is_memmappable and page.nbytes:
            end = file.pages[1].offset if pages > 1 else path.stat().st_size
            held = max(pages, min(planes, (end - page.dataoffsets[0]) // page.nbytes))
        if held != planes:
            raise InputError(
                f"{path}: ImageJ's description tells of {planes} planes, the file holds {held}: it "
                "is cut short, or its pages were changed; save the stack anew"
            )


def _axes(series: Any) -> list[int]:
    """Numbers of the axes without those of length one that nobody needs."""
    one_page = len(series) == 1 and series.shape[:1] != (1,)
    return squeezed_axes(series.shape, keep=2 if one_page else 3)


def _kind(series: Any) -> str:
    """How the pages of a series are stored, in words."""
    page = series.keyframe
    count = "a page" if len(series) == 1 else f"{len(series)} pages"
    size = " x ".join(map(str, page.shape[:2]))
    mask = ", a mask" if page.is_mask else ""
    packed = getattr(page.compression, "name", str(page.compression)).lower()
    return f"{count} of {size} {page.dtype} ({packed}){mask}"


def _check_segments(path: Path, number: int, single: Any, keyframe: Any) -> None:
    """Refuse pages whose strips or tiles are missing: tifffile fills them with zeros."""
    offsets, counts = (
        (single.dataoffsets, single.databytecounts) if single is not None else ((), ())
    )
    whole = all(isinstance(n, int | np.integer) and n > 0 for n in (*counts, *offsets))
    if not counts or len(offsets) != len(counts) or not whole:
        raise InputError(f"{path}: page {number} has no samples: truncated or damaged")
    if len(counts) != (needed := math.prod(keyframe.chunked)):
        raise InputError(
            f"{path}: page {number} has {len(counts)} of {needed} strips or tiles: damaged"
        )
    end = max(o + n for o, n in zip(offsets, counts, strict=True))
    if end > path.stat().st_size:
        raise InputError(f"{path}: page {number} lies beyond the end of the file: truncated")
    check_ratio(nbytes(keyframe.shape, keyframe.dtype), sum(counts), f"{path}: page {number}")


def _check_lzw(path: Path, number: int, page: Any) -> None:
    """Refuse streams on which the decoder would crash; damage elsewhere it reports itself."""
    from .lzw import is_valid

    with path.open("rb") as stream:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            stream.seek(offset)
            if not is_valid(np.frombuffer(stream.read(count), np.uint8)):
                raise InputError(f"{path}: the LZW stream of page {number} is damaged")


def _contents(path: Path, file: Any) -> Contents:
    array = page_array(path, file)
    page = file.pages[0]
    stack = len(array.shape) == 3
    stated = Stated(axes="yzx" if stack else "zx")
    description = page.description
    access: Access = "mapped" if isinstance(array, FileArray) else "streamed"
    attrs: dict[str, object] = {}
    unclear: dict[str, str] = {}
    if "<OME" in description[:2000]:
        stated = _ome(description, array.shape, str(path))
    elif file.is_imagej:
        metadata = file.imagej_metadata or {}
        stated = _imagej(metadata, page, stack, str(path))
        array = _calibrated(metadata, array, str(path))
        unit = str(metadata.get("vunit", "")).strip()
        if unit.lower() not in _NO_UNIT:
            attrs["units"] = unit
    else:
        units, unclear = units_of_remarks(description.splitlines())
        if units:  # several are refused where it matters
            attrs["units"] = " or ".join(sorted(units))
        if described := file.shaped_metadata:
            attrs |= described[0]
            stated = Stated(axes=_shaped(file.series[0], described[0]) or stated.axes)
    attrs |= _gdal(path, page)
    array = _without_nodata(path, page, array)
    attrs = {key: value for key, value in attrs.items() if value}
    found = Variable(array.shape, array.dtype, lambda: array, access, attrs=attrs, stated=stated)
    contents = Contents({"": found}, file.close)
    if unclear:
        contents.unclear_unit = unclear_unit(path, unclear)
    return contents


def _gdal(path: Path, page: Any) -> dict[str, object]:
    """Attributes by GDAL's metadata; an InputError if values would have to be scaled."""
    attrs: dict[str, object] = {}
    metadata = str(_tag(page, "GDAL_METADATA", ""))
    if not metadata:
        return attrs
    for item in parse_xml(metadata.encode(), f"{path}: GDAL metadata").iter("Item"):
        text = (item.text or "").strip()
        role = item.get("role") or item.get("name", "").lower()
        attrs["units" if role == "unittype" else role] = text
        if role in _NO_CHANGE and text != "" and _number(text, str(path)) != _NO_CHANGE[role]:
            raise InputError(
                f"{path}: its GDAL metadata state a {role} of {text}; save the values themselves"
            )
    return attrs


def _shaped(series: Any, described: Mapping[str, object]) -> str | None:
    """Axes as tifffile's own description names them, where it does."""
    axes = "".join(series.axes[axis] for axis in _axes(series))
    known = sorted(axes) in (["X", "Y", "Z"], ["X", "Z"], ["X", "Y"])
    return axes.lower() if known and "axes" in described else None


def _calibrated(metadata: dict[str, Any], array: Any, path: str) -> Any:
    """Samples by ImageJ's calibration: a straight line, or none."""
    function = metadata.get("cf", _UNCALIBRATED)
    if function == _UNCALIBRATED:
        return array
    line = [metadata.get(name) for name in ("c0", "c1")]
    if function != 0 or not all(isinstance(c, int | float) and np.isfinite(c) for c in line):
        raise InputError(
            f"{path}: ImageJ's calibration function {function} of its values is not supported; "
            "save the values themselves (Image > Type > 32-bit)"
        )
    attrs = {"add_offset": float(line[0]), "scale_factor": float(line[1])}  # type: ignore[arg-type]
    dims = [f"axis {number}" for number in range(len(array.shape))]
    return Decoded(array, dims, attrs, where=path)


def _without_nodata(path: Path, page: Any, array: Any) -> Any:
    """The array with NaN for the value that GDAL's tag calls missing."""
    text = str(_tag(page, "GDAL_NODATA", "")).strip("\0 ")
    if not text or text.lower() == "nan":
        return array
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{path}: GDAL_NODATA is {text!r}, no number") from None
    dims = [f"axis {number}" for number in range(len(array.shape))]
    return Decoded(array, dims, {}, fills=[value], where=str(path))


def _tag(page: Any, name: str, default: Any) -> Any:
    return page.tags[name].value if name in page.tags else default


def _ome(description: str, shape: tuple[int, ...], path: str) -> Stated:
    root = parse_xml(description.encode(), f"{path}: OME-XML")
    pixels = root.find(".//{*}Pixels")
    if pixels is None:
        raise InputError(f"{path}: OME-XML without Pixels")

    def step(axis: str) -> float | None:
        value = pixels.get(f"PhysicalSize{axis}")
        unit = pixels.get(f"PhysicalSize{axis}Unit", "um")
        if value is None or length_unit(unit) is None:  # also "pixel" and "reference frame"
            return None
        return to_mm(_number(value, path), unit, path)

    if pixels.get("SizeC", "1") != "1":
        raise InputError(f"{path}: holds {pixels.get('SizeC')} channels, not one volume")
    pages = str(shape[0]) if len(shape) == 3 else "1"
    if sorted((pixels.get("SizeZ", "1"), pixels.get("SizeT", "1"))) != sorted(("1", pages)):
        raise InputError(
            f"{path}: OME-XML tells of {pixels.get('SizeZ')} planes along Z and "
            f"{pixels.get('SizeT')} times, the file holds {pages} pages: not one volume, or not "
            "all of it"
        )
    for planes in pixels.iterfind("{*}TiffData"):
        page, *place = (_number(planes.get(n, 0), path) for n in ("IFD", "FirstZ", "FirstT"))
        if page != sum(place):
            raise InputError(
                f"{path}: OME-XML tells of planes in another order than that of the pages; save "
                "them in order"
            )
    if len(shape) == 2:
        return Stated(axes="zx", spacing=(step("Y"), step("X")))
    if pixels.get("SizeZ") == str(shape[0]) and shape[0] > 1:
        return Stated(axes="zyx", spacing=(step("Z"), step("Y"), step("X")))
    # A series in time: pages are B-scans, their distance is not recorded.
    return Stated(axes="yzx", spacing=(None, step("Y"), step("X")))


def _imagej(metadata: dict[str, Any], page: Any, stack: bool, path: str) -> Stated:
    axes = "yzx" if stack else "zx"
    unit = metadata.get("unit")
    if metadata.get("channels", 1) != 1:
        raise InputError(
            f"{path}: holds {metadata['channels']} channels, not one volume; if they are B-scans, "
            'make them slices (tifffile writes them with metadata={"axes": "ZYX"})'
        )
    if any(metadata.get(f"{axis}unit", unit) != unit for axis in "yz"):
        raise InputError(f"{path}: its pixel sizes are in different units; state one in ImageJ")
    if not isinstance(unit, str) or length_unit(unit) is None:
        return Stated(axes=axes)

    def step(tag: str) -> float | None:
        if tag not in page.tags:
            return None
        value = page.tags[tag].value
        if not isinstance(value, tuple) or len(value) != 2:
            raise InputError(f"{path}: {tag} is {value!r}, not a ratio")
        per_unit, one = value
        return to_mm(one / per_unit, unit, path) if per_unit else None

    rows, columns = step("YResolution"), step("XResolution")
    # of a series in time, the depth of a voxel, not the distance of its B-scans
    distance = None if metadata.get("frames", 1) != 1 else metadata.get("spacing")
    between = None if distance is None else to_mm(_number(distance, path), unit, path)
    return Stated(axes=axes, spacing=(between, rows, columns) if stack else (rows, columns))


def _number(value: Any, path: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {value!r} is no number") from None
