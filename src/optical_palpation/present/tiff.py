"""Maps as TIFF files that open in ImageJ with their scale and unit."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optical_palpation.errors import InputError
from optical_palpation.palpation.result import StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.terms import common_limits, is_map, term


def write_tiff(result: StressResult, path: str | Path, names: Sequence[str] | None = None) -> None:
    """Write maps of a result as a TIFF stack for ImageJ: one slice a map, single precision.

    Pixels carry their size in mm and slices their name and unit. The first row is the lowest y, as
    :func:`~optical_palpation.analysis.read_regions` expects of regions that are drawn on it. Where
    a map has no value it is NaN.

    Parameters
    ----------
    result
        Stress by either method.
    path
        ``.tif`` or ``.tiff``.
    names
        Maps to write; all that are not states or flags, by default.

    Raises
    ------
    InputError
        If there is no such map, or pixels are not evenly spaced.
    OutputError
        The file cannot be written.
    """
    import tifffile

    maps = result.maps.sortby(["y", "x"])
    known = [str(name) for name, field in maps.data_vars.items() if is_map(field)]
    if names is None:
        names = [n for n in known if term(maps, n).has_limits]
    if absent := [name for name in names if name not in known]:
        raise InputError(f"there is no map {absent[0]!r}; known are {', '.join(known)}")
    steps = {}
    for axis in "yx":
        step = np.diff(maps[axis].values)
        if step.size == 0 or np.ptp(step) > 1e-3 * step.mean():
            raise InputError(f"{path}: a TIFF file needs evenly spaced pixels along {axis}")
        steps[axis] = float(step.mean())
    stack = np.stack([maps[n].transpose("y", "x").values.astype(np.float32) for n in names])
    first = term(maps, names[0])
    low, high = common_limits({names[0]: maps[names[0]]}, first.colours)
    stream = io.BytesIO()
    tifffile.imwrite(
        stream,
        stack,
        imagej=True,
        resolution=(1 / steps["x"], 1 / steps["y"]),  # pixels per unit
        metadata={
            "axes": "ZYX",
            "unit": "mm",
            "Labels": [term(maps, name).label for name in names],
            "min": low,
            "max": high,
            # pixels from the corner of the image to the place x = y = 0
            "xorigin": -float(maps["x"][0]) / steps["x"],
            "yorigin": -float(maps["y"][0]) / steps["y"],
            "Info": json.dumps(provenance(maps)),
        },
    )
    with atomic(path, "TIFF file") as temporary:
        temporary.write_bytes(stream.getvalue())
