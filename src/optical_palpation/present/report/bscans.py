"""B-scans as pictures for a page, and the maximum-intensity projection."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.present.report.maps import encode_bytes, encode_floats, stride
from optical_palpation.thickness.boundaries import side_filled

if TYPE_CHECKING:
    from optical_palpation.volume import Volume

LARGEST = 512  # pixels of a picture along either side
SLICES = 50  # pictures of a volume
BYTES = 900_000  # all pictures of a volume together, before they become text
QUALITIES = (75, 65, 55, 45, 35, 25, 15, 5)  # of JPEG, tried until the pictures are small enough
SHADES = (20.0, 99.5)  # percentiles of the signal that are black and white


def draw_volume(
    volume: Volume, layer: xr.Dataset | None, name: str
) -> tuple[dict[str, Any], xr.DataArray]:
    """Draw a volume, reading it once.

    Parameters
    ----------
    volume
        The open volume.
    layer
        What was found in it, on the same pixels, or None.
    name
        What to call the volume in an error.

    Returns
    -------
    tuple
        The entry of the page's data: pictures (JPEG), where they lie in mm, and the boundaries on
        them; and the maximum-intensity projection below the layer ``(y, x)``, in dB above the
        level that is black.

    Raises
    ------
    InputError
        If `layer` does not have the volume's pixels.
    """
    from optical_palpation.thickness.intensity import intensity_reader

    _, ny, nx = volume.shape
    if layer is not None and layer["thickness"].shape != (ny, nx):
        raise InputError(
            f"{name} volume: {ny} x {nx} A-scans, but the layer's map has "
            f"{' x '.join(map(str, layer['thickness'].shape))} pixels; give the layer as it was "
            "found in this volume"
        )
    m = volume.metadata
    y, x = _positions(volume, layer)
    z0, dz, dx = m.origin.z, m.spacing.z, m.spacing.x
    read = intensity_reader(volume, m.scale)
    first, last = _depths(volume, layer)
    block = stride(last - first, LARGEST), stride(nx, LARGEST)
    slices = range(0, ny, stride(ny, SLICES))
    black, white = _shades(read, slices, block, first, last)

    def picture(image: NDArray[Any]) -> NDArray[np.uint8]:
        return np.clip(
            (_decibels(image[first:last], block) - black) * 255 / (white - black), 0, 255
        ).astype("u1")

    tried = [picture(read(slices[i])) for i in _some(len(slices))]
    quality = next((q for q in QUALITIES if _size(tried, q) * len(slices) < BYTES), QUALITIES[-1])
    pictures, projection = [], np.empty((ny, nx))
    for row, image, below in _rows(volume, read, layer):
        with np.errstate(divide="ignore", invalid="ignore"):
            projection[row] = 10 * np.log10(np.max(image, axis=0, where=below, initial=0.0)) - black
        if row % slices.step == 0:
            pictures.append(base64.b64encode(_jpeg(picture(image), quality)).decode("ascii"))

    rows, columns = slice(None, None, slices.step), slice(None, None, block[1])
    depth = ((last - first) // block[0]) * block[0] * dz
    width = (nx // block[1]) * block[1] * dx
    entry: dict[str, Any] = {
        "pictures": pictures,
        "rows": list(slices),
        "count": ny,
        "y": [float(v) for v in y[rows]],
        # From edge to edge, while the positions are those of the centres of pixels.
        "extent": [float(v) for v in (x[0] - dx / 2, width, z0 + (first - 0.5) * dz, depth)],
        "range": float(white - black),
        "lines": {},
    }
    if layer is not None and "sample_depth" in layer:
        for side in ("window", "sample"):
            values = layer[f"{side}_depth"].values[rows, columns]
            entry["lines"][side] = encode_floats(values, digits=4)
            filled = side_filled(layer, side).values[rows, columns]
            entry["lines"][f"{side}_filled"] = encode_bytes(filled)
        entry["x"] = [float(x[0]), float(dx * block[1])]
    return entry, xr.DataArray(projection, {"y": y, "x": x}, ("y", "x"))


def _positions(volume: Volume, layer: xr.Dataset | None) -> tuple[NDArray[Any], NDArray[Any]]:
    """Where the A-scans lie, mm; the layer's map may have been shifted to fit another."""
    if layer is not None:
        return layer["y"].values, layer["x"].values
    _, ny, nx = volume.shape
    m = volume.metadata
    dy = m.spacing.y if ny > 1 else 0.0  # unknown for a single B-scan
    return m.origin.y + dy * np.arange(ny), m.origin.x + m.spacing.x * np.arange(nx)


def _rows(
    volume: Volume, read: Any, layer: xr.Dataset | None
) -> Iterator[tuple[int, NDArray[Any], NDArray[np.bool_]]]:
    """Every B-scan `[z, x]`, and what of it lies below the layer."""
    nz, ny, nx = volume.shape
    m = volume.metadata
    depth = (m.origin.z + m.spacing.z * np.arange(nz))[:, None]
    for row in range(ny):
        below = np.ones((nz, nx), bool)
        if layer is not None and "sample_depth" in layer:
            below = depth >= layer["sample_depth"].values[row]
        yield row, read(row), below


def _depths(volume: Volume, layer: xr.Dataset | None) -> tuple[int, int]:
    """First and last sample that are drawn: of a deep volume, the layer with what is around it.

    So the picture keeps the resolution that the volume has, where the layer is.
    """
    nz = volume.shape[0]
    if layer is None or "sample_depth" not in layer or nz <= LARGEST:
        return 0, nz
    m = volume.metadata
    upper, lower = float(layer["window_depth"].min()), float(layer["sample_depth"].max())
    if not (np.isfinite(upper) and np.isfinite(lower)):
        return 0, nz
    around = 0.5 * (lower - upper)
    first = int(np.floor((upper - around - m.origin.z) / m.spacing.z))
    last = int(np.ceil((lower + around - m.origin.z) / m.spacing.z)) + 1
    first, last = max(first, 0), min(last, nz)
    return (first, last) if last - first > 1 else (0, nz)


def _shades(
    read: Any, slices: range, block: tuple[int, int], first: int, last: int
) -> tuple[float, float]:
    """Levels in dB that are drawn black and white."""
    rows = (read(slices[i])[first:last] for i in _some(len(slices)))
    seen = np.concatenate([_decibels(row, block).ravel() for row in rows])
    seen = seen[np.isfinite(seen)]
    if seen.size == 0:
        return 0.0, 1.0
    black, white = (float(v) for v in np.percentile(seen, SHADES))
    return black, max(white, black + 1.0)


def _decibels(image: NDArray[Any], block: tuple[int, int]) -> NDArray[np.float64]:
    """Mean intensity of blocks of pixels in dB, -inf where there is no signal."""
    (nz, nx), (bz, bx) = image.shape, block
    kept = np.maximum(image[: nz // bz * bz, : nx // bx * bx], 0.0)
    mean = kept.reshape(nz // bz, bz, nx // bx, bx).mean(axis=(1, 3))
    with np.errstate(divide="ignore"):
        return 10 * np.log10(mean)


def _some(n: int) -> list[int]:
    """Return a few indices, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, n - 1, 7)})


def _size(pictures: list[NDArray[np.uint8]], quality: int) -> float:
    return float(np.mean([len(_jpeg(p, quality)) for p in pictures]))


def _jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=quality)
    return stream.getvalue()
