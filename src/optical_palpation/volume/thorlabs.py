r"""Thorlabs ``.oct`` files as written by ThorImage OCT.

A zip archive. ``Header.xml`` (root ``Ocity``) lists the members as ``DataFile`` elements whose text
is the member's name and whose attributes are ``Type``, ``SizeZ``, ``SizeX``, ``SizeY`` (samples),
``RangeZ``, ``RangeX``, ``RangeY`` (mm) and ``BytesPerPixel``. The processed signal is
``data\Intensity.data``: float32 in dB, little-endian, z fastest, then x, then y.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ..errors import InputError
from .archive import find_member, member_array, open_archive, plain_name, read_small
from .arrays import check_array
from .contents import Contents, Variable
from .metadata import Access, Stated, parse_xml

FORMAT = "Thorlabs .oct"

_MAX_HEADER_BYTES = 8 * 2**20


def recognises(path: Path, head: bytes) -> bool:
    """Tell by a ``Header.xml`` in a zip archive."""
    if not head.startswith(b"PK\x03\x04"):
        return False
    with open_archive(path) as archive:
        return find_member(archive, "Header.xml") is not None


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the header and find ``Intensity.data``, or the real-valued member that is `wanted`."""
    archive = open_archive(path)
    try:
        return _read(path, archive, wanted or "Intensity")
    except BaseException:
        archive.close()
        raise


def _read(path: Path, archive: zipfile.ZipFile, variable: str) -> Contents:
    member = find_member(archive, "Header.xml")
    assert member is not None  # recognises() saw it
    root = parse_xml(read_small(archive, member, _MAX_HEADER_BYTES), f"{path}: Header.xml")
    files = root.findall("./DataFiles/DataFile")
    entry = _entry(path, files, variable)
    name = (entry.text or "").strip()

    axis_order = (root.findtext("./Image/AxisOrder") or "ZXY").strip()
    if not axis_order.startswith("ZXY"):
        raise InputError(f"{path}: AxisOrder {axis_order!r} is not supported, only ZXY")
    if (root.findtext("./Image/FreeformScanPatternIsActive") or "").strip() == "True":
        raise InputError(f"{path}: a freeform scan pattern is not a regular volume")
    if entry.get("BytesPerPixel", "4").strip() != "4":
        raise InputError(f"{path}: {name} has {entry.get('BytesPerPixel')} bytes per pixel, not 4")

    sizes = {a: _size(path, entry, a) for a in "ZXY"}
    data = find_member(archive, name)
    if data is None:
        inside = ", ".join(plain_name(m) for m in archive.namelist()[:10])
        raise InputError(f"{path}: Header.xml lists {name!r}, but the archive holds only {inside}")
    shape = [sizes[a] for a in ("YXZ" if sizes["Y"] > 1 else "XZ")]
    check_array(tuple(shape), np.dtype("<f4"), f"{path}: {name}")
    array = member_array(archive, data, np.dtype("<f4"), shape)
    order = "yxz" if len(shape) == 3 else "xz"
    spacing = tuple(_spacing(path, entry, a, sizes[a]) for a in order.upper())
    access: Access = "mapped" if data.compress_type == zipfile.ZIP_STORED else "streamed"
    stated = Stated(axes=order, spacing=spacing, scale="dB", optical_depth=True)
    found = Variable(array.shape, array.dtype, lambda: array, access, stated=stated)
    return Contents({variable: found}, archive.close)


def _entry(path: Path, files: list[Element], variable: str) -> Element:
    """Find the header's entry of a member, by name without folder and ``.data``."""
    stem = {
        f: plain_name((f.text or "").strip()).rpartition("/")[2].removesuffix(".data")
        for f in files
    }
    found = [f for f in files if stem[f].lower() == variable.removesuffix(".data").lower()]
    inside = (
        ", ".join(sorted({f"{stem[f]} ({f.get('Type', '?')})" for f in files})[:20]) or "nothing"
    )
    if not found:
        raise InputError(
            f"{path}: no {variable}.data; Header.xml lists {inside}. Raw spectra and complex data "
            "are not supported: have ThorImage store the processed data"
        )
    if len(found) > 1:
        raise InputError(f"{path}: Header.xml lists {variable} {len(found)} times")
    if found[0].get("Type") != "Real":
        raise InputError(
            f"{path}: {variable} is of type {found[0].get('Type')!r}; only processed data of type "
            f"'Real' are supported. Header.xml lists {inside}"
        )
    return found[0]


def _size(path: Path, entry: Element, axis: str) -> int:
    text = entry.get(f"Size{axis}", "1" if axis == "Y" else "")
    try:
        size = int(text)
    except ValueError:
        size = 0
    if not 1 <= size <= 10**7:
        raise InputError(f"{path}: Header.xml gives Size{axis}={text!r} for {entry.text}")
    return size


def _spacing(path: Path, entry: Element, axis: str, size: int) -> float | None:
    text = entry.get(f"Range{axis}", "0")
    try:
        extent = float(text)
    except ValueError:
        extent = float("nan")
    if not 0 <= extent < 1e5:
        raise InputError(f"{path}: Header.xml gives Range{axis}={text!r} mm for {entry.text}")
    # Zero is how the header says that an axis was not scanned (repeated B-scans).
    return extent / size if extent > 0 else None
