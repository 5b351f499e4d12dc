"""A folder of B-scan images (PNG, BMP, JPEG, single-page TIFF), or one such image.

Rows are z, columns x; the files follow each other along y in the natural order of their names
(``scan_9`` before ``scan_10``). Files that are no images are passed over.
"""

from __future__ import annotations

import re
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import tiff
from .arrays import MAX_BSCAN_BYTES, PagedArray, check_array, nbytes, squeezed
from .contents import Contents
from .metadata import Stated

FORMAT = "B-scan images"

_MAGIC = (b"\x89PNG\r\n\x1a\n", b"BM", b"\xff\xd8\xff")
_SUFFIXES = (".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff")
_NOT_READ = (".gif", ".webp", ".jp2", ".j2k", ".pgm", ".pnm", ".ppm", ".dng", ".avif", ".heic")
#: What a folder may hold in place of images, by the first bytes or those after DICOM's preamble.
_OTHERS = {
    b"DICM": "DICOM files: give one file with all B-scans as its frames, or save them as images",
    b"\x93NUMPY": "NumPy files: give one of them, or all in one (numpy.save of numpy.stack)",
}
_SIGN = re.compile(r"(?:^|[^0-9A-Za-z])[-+]$")
_ORIENTATION = 274  # of EXIF
_PILLOW_FORMATS = ("PNG", "BMP", "JPEG")
_TYPES = {"L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.int32, "F": np.float32}
_NOT_GREY = {
    "1": "has one bit per pixel, black or white",
    "P": "has a palette of colours",
    "LA": "is grey with transparency",
}


def recognises(path: Path, head: bytes) -> bool:
    """Tell by being a folder, or the magic of PNG, BMP and JPEG files."""
    return path.is_dir() or head.startswith(_MAGIC)


def contents(path: Path, wanted: str | None) -> Contents:
    """Read every image's header; they must agree."""
    files = _images(path) if path.is_dir() else [path]
    if not files:
        raise InputError(f"{path}: holds no images (PNG, BMP, JPEG, TIFF){_instead(path)}")
    shape, dtype = _header(files[0])
    for file in files[1:]:
        other = _header(file)
        if other != (shape, dtype):
            raise InputError(
                f"{path}: {file.name} has shape {other[0]} and type {other[1]}, but "
                f"{files[0].name} has {shape} and {dtype}; all B-scans must agree"
            )
    _check_sequence(files)
    array: Any = PagedArray(lambda i: _pixels(files[i]), dtype, (len(files), *shape))
    if len(files) == 1:
        return Contents.single(squeezed(array, keep=2), Stated(axes="zx"), "streamed")
    return Contents.single(array, Stated(axes="yzx"), "streamed")


def _images(folder: Path) -> list[Path]:
    found = []
    for file in folder.iterdir():
        if file.is_file() and not file.name.startswith("."):
            with file.open("rb") as stream:
                if stream.read(8).startswith(_MAGIC + tiff.MAGIC):
                    found.append(file)
                elif file.suffix.lower() in _SUFFIXES:
                    # Passed over, it would leave a gap along y.
                    raise InputError(
                        f"{file}: is no image, whatever its name says; empty or damaged?"
                    )
                elif file.suffix.lower() in _NOT_READ:
                    raise InputError(f"{file}: save it as PNG or TIFF; this format is not read")
    return sorted(found, key=_natural)


def _instead(folder: Path) -> str:
    """Say what to give in place of a folder of other files, for the end of an error."""
    for file in sorted(folder.iterdir()):
        if file.is_file():
            with file.open("rb") as stream:
                head = stream.read(132)
            for mark, said in _OTHERS.items():
                if mark in (head[: len(mark)], head[128:]):
                    return f", but {said}"
    return ""


def _check_sequence(files: list[Path]) -> None:
    """Refuse files whose order their names do not make clear, or among which one is missing."""
    names = [re.split(r"([0-9]+)", file.name) for file in files]
    if not any(len(name) > 1 for name in names):
        _check_letters(files)
        return
    for name, file in zip(names, files, strict=True):
        if name[::2] != names[0][::2]:
            raise InputError(
                f"{file.parent}: {files[0].name} and {file.name} are not named alike but for whole "
                "numbers, which give the B-scans their order; rename them, or move away what is no "
                "B-scan"
            )
    columns = list(zip(*names, strict=True))
    varying = [n for n, column in enumerate(columns) if len(set(column)) > 1]
    for whole, digits in pairwise(varying):
        fraction = digits == whole + 2 and columns[whole + 1][0] in (".", ",")
        if fraction and len({len(part) for part in columns[digits]}) > 1:
            raise InputError(
                f"{files[0].parent}: decimals in names, as in {files[0].name}, do not give an "
                "order; number the B-scans with whole numbers"
            )
    if any(_SIGN.search("".join(names[0][:n])) for n in varying):
        raise InputError(
            f"{files[0].parent}: a sign or a dash before a number, as in {files[0].name}, does not "
            "give a clear order; number the B-scans with whole numbers from 0"
        )
    numbers = [[int(part) for part in columns[n]] for n in varying]
    if len(numbers) > 1:
        if not (_is_counted(numbers) or _is_grid(numbers)):
            raise InputError(
                f"{files[0].parent}: several numbers in the names of the B-scans do not give a "
                f"clear order, or a B-scan is missing: {_listing(files)}; number them 1, 2, 3, ..."
            )
        return
    for steps in map(_steps, numbers):
        for (before, after), step in zip(pairwise(files), steps, strict=True):
            if step != max(1, min(steps)):
                raise InputError(
                    f"{before.parent}: {before.name} is followed by {after.name}; a B-scan is "
                    "missing between them, or a file of another series is among them"
                )


def _check_letters(files: list[Path]) -> None:
    """Without numbers only letters that follow each other, as a, b, c, make an order."""
    names = [file.name for file in files]
    varying = [column for column in zip(*names, strict=False) if len(set(column)) > 1]
    alike = len({len(name) for name in names}) == 1 and len(varying) <= 1
    if not (alike and all(set(_steps(list(map(ord, column)))) == {1} for column in varying)):
        raise InputError(
            f"{files[0].parent}: the names of the B-scans do not give an order: {_listing(files)}; "
            "number them 1, 2, 3, ..."
        )


def _is_counted(numbers: list[list[int]]) -> bool:
    """Tell whether one of the numbers counts the files, and the rest, a date perhaps, rises too."""
    for column in numbers:
        rest = list(zip(*(other for other in numbers if other is not column), strict=True))
        steps = set(_steps(column))
        if len(steps) == 1 and min(steps) > 0 and rest == sorted(rest):
            return True
    return False


def _is_grid(numbers: list[list[int]]) -> bool:
    """Tell whether every number goes with every other one, each of them evenly spaced."""
    values = [sorted(set(column)) for column in numbers]
    even = all(len(set(_steps(column))) == 1 for column in values)
    return even and list(zip(*numbers, strict=True)) == list(product(*values))


def _steps(numbers: list[int]) -> list[int]:
    return [after - before for before, after in pairwise(numbers)]


def _listing(files: list[Path]) -> str:
    names = [file.name for file in files]
    return ", ".join(names if len(names) < 8 else [*names[:6], "...", names[-1]])


def _natural(file: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"([0-9]+)", file.name)
    return [(0, int(p), p) if p[:1].isdigit() else (1, 0, p) for p in parts]


def _header(file: Path) -> tuple[tuple[int, int], np.dtype[Any]]:
    if _is_tiff(file):
        array, close = _open_tiff(file)
        close()
        if len(array.shape) == 3 and array.shape[0] != 1:
            raise InputError(f"{file}: is a stack of its own; a folder holds one B-scan per file")
        shape, dtype = array.shape[-2:], array.dtype
    else:
        with _open_image(file) as image:
            if image.mode not in _TYPES:
                kind = _NOT_GREY.get(image.mode, f"is a colour image ({image.mode})")
                raise InputError(f"{file}: {kind}; save it in grey, with 8 or 16 bits")
            if (orientation := image.getexif().get(_ORIENTATION, 1)) != 1:
                raise InputError(
                    f"{file}: its orientation tag says {orientation}, that it lies on its side or "
                    "is mirrored, which most software overlooks: save it upright"
                )
            shape, dtype = (image.height, image.width), np.dtype(_TYPES[image.mode])
    check_array(shape, dtype, str(file))
    if nbytes(shape, dtype) > MAX_BSCAN_BYTES:
        raise InputError(f"{file}: an image of {shape} samples is too large")
    return shape, dtype


def _pixels(file: Path) -> NDArray[Any]:
    if _is_tiff(file):
        array, close = _open_tiff(file)
        try:
            return array[(slice(None),) * len(array.shape)].reshape(array.shape[-2:])
        finally:
            close()
    with _open_image(file) as image:
        return np.asarray(image)


def _is_tiff(file: Path) -> bool:
    with file.open("rb") as stream:
        return tiff.recognises(file, stream.read(4))


def _open_tiff(file: Path) -> tuple[Any, Any]:
    found = tiff.contents(file, None)
    return found.variables[""].open(), found.close


def _open_image(file: Path) -> Any:
    from PIL import Image

    try:
        return Image.open(file, formats=_PILLOW_FORMATS)
    except Image.DecompressionBombError as error:
        raise InputError(f"{file}: {error}") from error
