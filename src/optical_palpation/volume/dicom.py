"""DICOM files with one frame per B-scan; needs pydicom."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import MAX_BSCAN_BYTES, PagedArray, check_array, nbytes, squeezed
from .contents import Contents
from .metadata import Stated

FORMAT = "DICOM"

_DEFLATED = "1.2.840.10008.1.2.1.99"
_MAX_RATIO = 1000
#: Where the frames of a file are placed, and in what: numbers count them in their order.
_PLACES = (
    ("PlanePositionSequence", "ImagePositionPatient", "mm"),
    ("FrameContentSequence", "InStackPositionNumber", "number"),
    ("FrameContentSequence", "DimensionIndexValues", "number"),
    ("OphthalmicFrameLocationSequence", "ReferenceCoordinates", "pixels"),
)


def recognises(path: Path, head: bytes) -> bool:
    """``DICM`` after the preamble of 128 bytes."""
    return head[128:132] == b"DICM"


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the header, without the frames."""
    try:
        import pydicom
        from pydicom.pixels import pixel_array
    except ImportError:
        raise InputError(
            f"{path}: reading DICOM needs pydicom: pip install 'optical-palpation[formats]'"
        ) from None

    meta = pydicom.filereader.read_file_meta_info(path)
    if str(meta.get("TransferSyntaxUID")) == _DEFLATED:
        raise InputError(
            f"{path}: deflated DICOM would have to be unpacked whole; save it undeflated"
        )
    header = pydicom.dcmread(path, stop_before_pixels=True)
    if (
        header.get("SamplesPerPixel", 1) != 1
        or header.get("PhotometricInterpretation") != "MONOCHROME2"
    ):
        raise InputError(
            f"{path}: frames are {header.get('PhotometricInterpretation')}; only grey ones "
            "(MONOCHROME2) are supported"
        )
    frames = int(_number(path, header, "NumberOfFrames", 1) or 1)
    names = ("Rows", "Columns", "BitsAllocated")
    rows, columns, bits = (int(_number(path, header, n, 0)) for n in names)
    if bits not in (8, 16, 32):
        raise InputError(f"{path}: {bits} bits per sample are not supported")
    bits_stored, high_bit = (_number(path, header, n, -1) for n in ("BitsStored", "HighBit"))
    if min(bits_stored, high_bit) >= 0 and high_bit != bits_stored - 1:
        raise InputError(
            f"{path}: the highest of {bits_stored:g} bits is bit {high_bit:g}, not "
            f"{bits_stored - 1:g}: its samples are shifted; save it with samples in the lowest bits"
        )
    stored = np.dtype(f"{'i' if header.get('PixelRepresentation', 0) else 'u'}{bits // 8}")
    if bits == 32 and "BitsStored" not in header:  # those of FloatPixelData
        stored = np.dtype("f4")
    check_array((frames, rows, columns), stored, str(path))
    size = path.stat().st_size
    needed = nbytes((frames, rows, columns), stored)
    syntax = meta.get("TransferSyntaxUID")
    if not (syntax is None or isinstance(syntax, pydicom.uid.UID)):
        raise InputError(f"{path}: damaged DICOM header (several transfer syntaxes)")
    compressed = syntax is not None and syntax.is_compressed
    if needed > (size * _MAX_RATIO if compressed else size):
        raise InputError(
            f"{path}: {frames} frames of {rows} x {columns} do not fit in {size} bytes"
        )
    if not compressed:
        _check_length(path, frames, nbytes((rows, columns), stored))
    if nbytes((rows, columns), stored) > MAX_BSCAN_BYTES:
        raise InputError(f"{path}: frames of {rows} x {columns} samples are too large")

    transform = _transform(path, header)
    slope = _number(path, transform, "RescaleSlope", 1)
    intercept = _number(path, transform, "RescaleIntercept", 0)
    padding = _padding(path, header)
    scaled = (slope, intercept) != (1.0, 0.0) or padding is not None

    def read_page(index: int) -> NDArray[Any]:
        frame = pixel_array(path, index=index)
        if not scaled:
            return frame
        values = frame * np.float32(slope) + np.float32(intercept)
        if padding is not None:
            values[(frame >= padding[0]) & (frame <= padding[1])] = np.nan
        return values

    array: Any = PagedArray(
        read_page, np.dtype(np.float32) if scaled else stored, (frames, rows, columns)
    )
    if frames == 1:
        array = squeezed(array, keep=2)
    return Contents.single(array, _stated(path, header, frames), "streamed")


def _check_length(path: Path, frames: int, frame_bytes: int) -> None:
    """Refuse more or fewer uncompressed frames than the header says."""
    import pydicom

    names = ["PixelData", "FloatPixelData"]
    found = pydicom.dcmread(path, defer_size=1024, specific_tags=names)  # too large to be read
    for name in names:
        if name in found:
            element: Any = found.get_item(name, keep_deferred=True)
            length = element.length if hasattr(element, "length") else len(element.value)
            if (held := length // frame_bytes) != frames:
                raise InputError(
                    f"{path}: NumberOfFrames is {frames}, but {name} holds {held} frames of "
                    f"{frame_bytes} bytes: it is damaged, or not all of the volume"
                )


def _transform(path: Path, header: Any) -> Any:
    """Where slope and intercept stand: in the header, or in what all frames share."""
    if header.get("ModalityLUTSequence"):
        raise InputError(f"{path}: samples are coded by a table (Modality LUT), not supported")
    for frame in _items(path, header, "PerFrameFunctionalGroupsSequence"):
        if frame.get("PixelValueTransformationSequence"):
            raise InputError(f"{path}: every frame has a scale of its own, which is not supported")
    return _shared(path, header, "PixelValueTransformationSequence")


def _shared(path: Path, header: Any, name: str) -> Any:
    """What all frames share of a kind; the header if it holds no such item."""
    groups = _items(path, header, "SharedFunctionalGroupsSequence")
    items = _items(path, groups[0], name) if len(groups) == 1 else []
    return items[0] if len(items) == 1 else header


def _items(path: Path, header: Any, name: str) -> list[Any]:
    """Items of a sequence, none where it is absent."""
    value = header.get(name)
    if value is None:
        return []
    try:
        return list(value)
    except TypeError:
        raise InputError(f"{path}: {name} is {value!r}: damaged") from None


def _padding(path: Path, header: Any) -> tuple[float, float] | None:
    """Lowest and highest stored value that stands for no sample."""
    for kind in ("", "Float", "DoubleFloat"):
        name = f"{kind}PixelPaddingValue"
        given = header.get(name)
        # NaN stands for no sample anyway.
        if given in (None, "") or given != given:
            continue
        value = _number(path, header, name, 0)
        limit = _number(path, header, f"{kind}PixelPaddingRangeLimit", value)
        return min(value, limit), max(value, limit)
    return None


def _stated(path: Path, header: Any, frames: int) -> Stated:
    """Take spacing from the frame's pixel measures, wherever the kind of image keeps them."""
    measures = _shared(path, header, "PixelMeasuresSequence")
    rows, columns = _numbers(path, measures, "PixelSpacing", 2)
    (between,) = _numbers(path, measures, "SpacingBetweenSlices", 1)
    _check_positions(path, header, frames, between)
    if frames == 1:
        return Stated(axes="zx", spacing=(rows, columns))
    return Stated(axes="yzx", spacing=(between, rows, columns))


def _check_positions(path: Path, header: Any, frames: int, between: float | None) -> None:
    """Refuse frames that do not follow each other evenly, by all that the file tells of it."""
    groups = _items(path, header, "PerFrameFunctionalGroupsSequence")
    for sequence, name, kind in _PLACES:
        at = _places(path, groups, sequence, name)
        if at is None:
            continue
        steps = np.diff(at, axis=0)
        mean = steps.mean(axis=0)
        length = float(np.linalg.norm(mean))
        allowed = 0.01 * length
        if kind == "pixels":  # of another image, often rounded
            allowed = 0.5 * length + np.array_equal(at, at.round())
        falls = kind == "number" and bool((mean < 0.0).any())
        if len(at) != frames or falls or not np.all(np.abs(steps - mean) <= allowed):
            raise InputError(
                f"{path}: by {name} its {frames} frames are not stored in the order of their "
                "positions, or not evenly spaced; sort them"
            )
        if kind == "mm" and between is not None and abs(length - abs(between)) > 0.01 * length:
            raise InputError(
                f"{path}: its frames lie {length:g} mm apart, SpacingBetweenSlices says {between:g}"
            )


def _places(path: Path, groups: list[Any], sequence: str, name: str) -> NDArray[np.float64] | None:
    """What an element says of every frame, a row each; None where one of them lacks it."""
    items = [_items(path, frame, sequence) for frame in groups]
    if len(items) < 2 or not all(items):
        return None
    values = [item[0].get(name) for item in items]
    if any(value is None or np.size(value) == 0 for value in values):
        return None
    count = np.size(values[0])
    return np.array([_numbers(path, item[0], name, count) for item in items], float)


def _number(path: Path, header: Any, name: str, default: float) -> float:
    (value,) = _numbers(path, header, name, 1)
    return default if value is None else value


def _numbers(path: Path, header: Any, name: str, count: int) -> list[float | None]:
    """Values of an element, or None for each where the element is absent or empty."""
    value = header.get(name)
    if value is None or value == "":
        return [None] * count
    try:
        values: list[float | None] = [float(v) for v in (value if count > 1 else [value])]
    except (TypeError, ValueError):
        values = []
    if len(values) != count or not all(v is not None and math.isfinite(v) for v in values):
        raise InputError(f"{path}: {name} is {value!r}")
    return values
