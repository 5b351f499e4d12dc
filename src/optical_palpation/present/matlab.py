"""Results as MATLAB files, which Octave, MATLAB and SciPy read."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from optical_palpation.palpation.result import StressResult
from optical_palpation.present.output import atomic, provenance
from optical_palpation.present.terms import STATE_NUMBERS, is_map, term

_LONGEST = 31  # characters of a name in a file of this format


def write_mat(result: StressResult, path: str | Path) -> None:
    """Write the maps of a result as a MATLAB file (format 5).

    Every map is a matrix (y, x), named as in the NetCDF file, beside ``x`` and ``y``, the positions
    of its columns and rows in mm. What is known on the pixels of the image begins with ``pixel_``,
    as do its positions ``pixel_x`` and ``pixel_y``. The structure ``units`` has the unit of each,
    ``meaning`` what it is in words, and ``provenance`` all parameters. Where a map has no value it
    is NaN.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from scipy.io import savemat

    maps = result.maps
    content: dict[str, Any] = {}
    units: dict[str, str] = {}
    meaning: dict[str, str] = {}
    grids = {"": maps} if result.pixels is None else {"": maps, "pixel_": result.pixels}
    for prefix, grid in grids.items():
        for axis, of in (("x", "columns"), ("y", "rows")):
            content[prefix + axis] = grid[axis].values.astype(float)
            units[prefix + axis], meaning[prefix + axis] = "mm", f"position of {of}"
        for key, field in grid.data_vars.items():
            if not is_map(field):
                continue
            what = term(grid, str(key))
            short = f"{prefix}{key}"[:_LONGEST]
            values = field.transpose("y", "x").values
            content[short] = values.astype(np.uint8) if values.dtype == bool else values
            units[short] = what.units or "1"
            meaning[short] = str(field.attrs.get("long_name", what.words))
            if "flag_meanings" in field.attrs or what.colours == "states":
                meaning[short] += f": {STATE_NUMBERS}"
    content["units"], content["meaning"] = units, meaning
    content["provenance"] = {k[:_LONGEST]: v for k, v in provenance(maps).items()}
    stream: Any = io.BytesIO()
    savemat(stream, content, do_compression=True, oned_as="column", long_field_names=False)
    with atomic(path, "MATLAB file") as temporary:
        temporary.write_bytes(stream.getvalue())
