"""Maps as text for a page: kept to four digits, compressed, on evenly spaced pixels."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.analysis.maps import evenly

#: Pixels along the longer side; of larger maps every second (third, ...) pixel is kept.
LARGEST = 1024
#: Characters of all maps of a page together.
BYTES = 2_200_000


def stride(pixels: int, largest: int = LARGEST) -> int:
    """Return the step by which `pixels` are thinned to no more than `largest`."""
    return -(-pixels // largest)


def encode_map(field: xr.DataArray, digits: int = 4, largest: int = LARGEST) -> dict[str, Any]:
    """Return a map with its coordinates as an entry of the page's data.

    Parameters
    ----------
    field
        Map on ``(y, x)``; whole numbers and logicals stay as they are (one byte each), other
        numbers are rounded. What is not finite becomes NaN.
    digits
        Significant digits that are kept.
    largest
        Pixels along the longer side.
    """
    thin = {axis: slice(None, None, stride(field.sizes[axis], largest)) for axis in ("y", "x")}
    field = evenly(field.transpose("y", "x").sortby(["y", "x"]).isel(thin))
    whole = field.dtype.kind in "bui"
    values = field.values.astype(np.uint8) if whole else field.values
    return {
        "shape": list(field.shape),
        "y": _axis(field["y"].values),
        "x": _axis(field["x"].values),
        **(encode_bytes(values) if whole else encode_floats(values, digits)),
    }


def encode_bytes(values: NDArray[Any]) -> dict[str, str]:
    """Encode whole numbers from 0 to 255."""
    return {"type": "u1", "data": _packed(values.astype(np.uint8).tobytes())}


def encode_floats(values: NDArray[Any], digits: int) -> dict[str, str]:
    """Encode numbers in single precision, rounded so that they compress.

    The bits that carry no significant digit are set to zero, and the bytes are sorted by
    significance: equal bytes stand together.
    """
    single = np.where(np.isfinite(values), values, np.nan).astype(np.float32)
    superfluous = 23 - int(np.ceil(digits * np.log2(10)))
    bits = single.view(np.uint32)
    rounded = (bits + np.uint32(1 << (superfluous - 1))) & np.uint32(-(1 << superfluous) % 2**32)
    rounded = np.where(np.isnan(single), np.uint32(0x7FC00000), rounded)
    shuffled = rounded.astype("<u4").reshape(-1, 1).view(np.uint8).T
    return {"type": "f4", "data": _packed(shuffled.tobytes())}


def encode_maps(fields: Mapping[str, tuple[xr.DataArray, int]]) -> dict[str, dict[str, Any]]:
    """Encode maps by name, each with its digits, so that together they stay within ``BYTES``.

    Where they do not, as maps of pure noise would not, one digit less is kept, then all but the
    first two maps are thinned.
    """
    encoded = {name: encode_map(field, digits) for name, (field, digits) in fields.items()}
    for lost, largest in ((1, LARGEST), (1, LARGEST // 4), (2, LARGEST // 8)):
        if sum(len(entry["data"]) for entry in encoded.values()) <= BYTES:
            break
        for k, (name, (field, digits)) in enumerate(fields.items()):
            kept = LARGEST if k < 2 else largest
            encoded[name] = encode_map(field, max(digits - lost, 2), kept)
    return encoded


def _axis(at: NDArray[Any]) -> list[float]:
    """First position and step, mm; a single pixel is taken to be a tenth of a millimetre wide."""
    step = (at[-1] - at[0]) / (at.size - 1) if at.size > 1 else 0.1
    return [float(at[0]), float(step)]


def _packed(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 6)).decode("ascii")
