"""Opening a file of any known format, found out from its content."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..arguments import explained, file_path
from ..errors import InputError
from . import (
    dicom,
    hdf5,
    images,
    matlab,
    netcdf3,
    nifti,
    numpy_files,
    raw,
    text,
    thorlabs,
    tiff,
    zarr_store,
)
from .contents import Contents, Reader, translated_errors
from .volume import Volume, chosen

_HEAD_BYTES = 4096
#: Formats that are not read, by their first bytes, and what to do.
_OTHERS = {
    b"PK\x03\x04": "a zip archive (Excel writes them, too); save what it holds as CSV or .npy",
    b"\xd0\xcf\x11\xe0": "a file of Excel or another office program; save the map as CSV",
    b"\x1f\x8b": "compressed by gzip; unpack it",
    b"PAR1": "Parquet; save the map as .npy",
    b"ARROW1": "Arrow; save the map as .npy",
    b"\x80": "a Python pickle, which could run code; save the array with numpy.save",
    b"\0\0\0\0": "perhaps MATLAB's version 4; save it with -v7",
}

#: Formats of volumes. Raw files have no mark of their own: they come last, but for those that are
#: described, whose first samples may look like any mark.
READERS: tuple[Reader, ...] = (
    thorlabs,
    numpy_files,
    tiff,
    matlab,
    hdf5,
    netcdf3,
    nifti,
    dicom,
    zarr_store,
    images,
    raw,
)
#: Those of maps: text has no mark either.
MAP_READERS: tuple[Reader, ...] = (*READERS, text)


@explained
def open_volume(
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    axes: str | None = None,
    spacing: Mapping[str, float] | None = None,
    scale: str | None = None,
    refractive_index: float | None = None,
    origin: Mapping[str, float] | None = None,
    untrusted: bool = False,
) -> Volume:
    """Open an OCT volume; its samples stay on disk until B-scans are asked for.

    The format is found from the content: Thorlabs ``.oct``, TIFF and OME-TIFF stacks, a folder of
    B-scan images, MATLAB v5 and v7.3, HDF5 and netCDF, ``.npy`` and ``.npz``, raw binary with a
    sidecar, and with the extra ``formats`` Zarr, NIfTI and DICOM. What the file does not say must
    be given; what is given here overrides the file.

    Parameters
    ----------
    path
        File or folder.
    variable
        Name of the array in a file that holds several.
    axes
        Order of the axes in the file, slowest first as the format counts them (for MATLAB as
        MATLAB shows them), for example ``"yzx"`` for a stack of B-scans; ``"zx"`` for one B-scan.
    spacing
        Distance between samples in mm by axis, such as ``{"z": 0.0035, "y": 0.01, "x": 0.01}``.
        May name only some axes.
    scale
        ``"linear"`` (``"amplitude"`` or ``"intensity"``, where that is known) or ``"dB"``.
    refractive_index
        Group index by which the axial spacing and the stored axial origin, an optical path, are
        divided. Leave it out where the stored depth is physical.
    origin
        Position of the first sample in mm by axis; 0 where neither file nor user says more. One
        that is given along z is physical, not divided by the index.
    untrusted
        Let a process of its own, under limits, go through an HDF5 file before it is opened here,
        because the HDF5 library can crash or never end on one that was damaged on purpose.

    Returns
    -------
    Volume
        With ``metadata``, ``bscan(y)``, iteration over B-scans, ``to_xarray()`` and ``close()``.
        Samples that the file marks as missing are NaN.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged or unsupported, or a fact is missing or impossible.
    """
    given = {
        "axes": axes,
        "spacing": spacing,
        "scale": scale,
        "refractive_index": refractive_index,
        "origin": origin,
    }
    path = file_path(path)
    if variable is not None and not isinstance(variable, str):
        raise InputError(f"variable = {variable!r}: must be the name of an array in {path}")
    reader, contents = open_contents(path, variable, untrusted=untrusted)
    try:
        with translated_errors(path, reader.FORMAT):
            found = chosen(path, contents, variable)
            return Volume(found, path, reader.FORMAT, contents.close, **given)
    except BaseException:
        contents.close()
        raise


def is_known(path: Path, readers: Sequence[Reader] = READERS) -> bool:
    """Tell by its first bytes whether a file, or a folder, is of a format that can be read."""
    try:
        head = _head(path)
    except InputError:
        return False
    return any(reader.recognises(path, head) for reader in readers)


def _in_order(path: Path, head: bytes, readers: Sequence[Reader]) -> Sequence[Reader]:
    """Readers in the order in which they are asked whether a file, or a folder, is theirs."""
    return (raw, *readers) if head and raw.is_described(path) else readers


def open_contents(
    path: Path,
    wanted: str | None = None,
    *,
    readers: Sequence[Reader] = READERS,
    untrusted: bool = False,
) -> tuple[Reader, Contents]:
    """Find the reader of a file, and what the file holds; the caller closes it.

    Raises
    ------
    InputError
        If the file is missing, empty, unreadable, damaged or of an unknown format.
    """
    head = _head(path)
    if untrusted and hdf5.recognises(path, head):
        hdf5.try_out(path)
    for reader in _in_order(path, head, readers):
        with translated_errors(path, reader.FORMAT):
            if reader.recognises(path, head):
                return reader, reader.contents(path, wanted)
    known = ", ".join(reader.FORMAT for reader in readers)
    kind = next((kind for mark, kind in _OTHERS.items() if head.startswith(mark)), "")
    first = f"it is {kind}" if kind else f"its first bytes are {head[:16]!r}"
    raise InputError(
        f"{path}: unknown format; {first}. Known: {known}. A raw file "
        f"needs a sidecar {path.name}.toml or {path.name}.json that describes it"
    )


def _head(path: Path) -> bytes:
    try:
        if path.is_dir():
            return b""
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is neither a file nor a folder")
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; it cannot be opened") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be opened ({reason})") from error
    if not head:
        raise InputError(f"{path}: is empty")
    return head
