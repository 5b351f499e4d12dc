"""Opening a volume of any known format, found out from its content."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from ..errors import InputError
from . import dicom, hdf5, images, matlab, nifti, numpy_files, raw, thorlabs, tiff, zarr_store
from .volume import Source, Volume, translated_errors

_HEAD_BYTES = 4096


class Reader(Protocol):
    """What the module of a format offers."""

    FORMAT: str

    def recognises(self, path: Path, head: bytes) -> bool:
        """Tell whether a file, by its first bytes, or a folder (no bytes) is of this format."""

    def read(self, path: Path, variable: str | None) -> Source:
        """Read the header and hand over the array, unread."""


# Raw files have no mark of their own: they come last.
READERS: tuple[Reader, ...] = (
    thorlabs,
    numpy_files,
    tiff,
    matlab,
    hdf5,
    nifti,
    dicom,
    zarr_store,
    images,
    raw,
)


def open_volume(
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    axes: str | None = None,
    spacing: Mapping[str, float] | None = None,
    scale: str | None = None,
    refractive_index: float | None = None,
    origin: Mapping[str, float] | None = None,
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
        ``"linear"`` or ``"dB"``.
    refractive_index
        Group index by which the stored axial spacing, an optical path, is divided. Leave it out
        where the stored depth is physical.
    origin
        Position of the first sample in mm by axis; 0 where neither file nor user says more.

    Returns
    -------
    Volume
        With ``metadata``, ``bscan(y)``, iteration over B-scans, ``to_xarray()`` and ``close()``.

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
    path = Path(path)
    head = _head(path)
    for reader in READERS:
        with translated_errors(path, reader.FORMAT):
            if not reader.recognises(path, head):
                continue
            source = reader.read(path, variable)
        try:
            return Volume(source, path, reader.FORMAT, **given)
        except BaseException:
            source.close()
            raise
    known = ", ".join(reader.FORMAT for reader in READERS)
    raise InputError(
        f"{path}: unknown format; its first bytes are {head[:16]!r}. Known: {known}. A raw file "
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
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be opened ({error})") from error
    if not head:
        raise InputError(f"{path}: is empty")
    return head
