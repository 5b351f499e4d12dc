"""Masks beside a map: which of its pixels a file marks as missing."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .contents import Contents, Variable
from .labels import labelled, values_of

FILLED = "filled"
#: Words in names of masks that do not say which of their values means missing.
_WORDS = {"mask", "masked", "valid", "invalid", "missing", "measured", "nodata", "nan", "nans"}
_WORDS |= {"bad", "good", "ok", "outlier", "outliers", "interpolated", "extrapolated", FILLED}
_WORDS |= {"flag", "flags", "status", "qc", "qa", "exclude", "excluded", "reliable", "trusted"}


def is_mask(name: str) -> bool:
    """Tell by its name whether an array marks pixels."""
    stem = name.rpartition("/")[2]
    words = re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem).lower())
    return not _WORDS.isdisjoint(words)


def apply_masks(path: Path, contents: Contents, name: str, values: NDArray[np.float64]) -> None:
    """Set what the mask of a map marks to NaN; refuse masks that may mean either.

    That is an array ``filled`` beside the map, or of a map ``initial_thickness`` one that is called
    ``initial_filled``; where it is there, others do not count.

    Raises
    ------
    InputError
        If such a mask does not fit, or there is another one whose name does not say what it marks.
    """
    group, _, stem = name.rpartition("/")
    beside = {
        other.rpartition("/")[2].lower(): other
        for other in (*contents.variables, *contents.unread)
        if other != name and other.rpartition("/")[0] == group
    }
    of_this = stem.lower().replace("thickness", FILLED)
    own = beside.get(of_this) if of_this != stem.lower() else None
    if (mask := own or beside.get(FILLED)) is not None:
        values[_flags(path, contents, mask, name, values.shape)] = np.nan
        return
    listing = str(contents.variables[name].attrs.get("ancillary_variables", "")).split()
    for other in beside.values():
        variable = contents.variables.get(other)
        if variable is None:
            unclear = is_mask(other)
        else:
            same = variable.shape == contents.variables[name].shape
            listed = other.rpartition("/")[2] in listing
            unclear = same and _may_mark(path, other, variable, listed)
        if unclear:
            raise InputError(
                f"{path}, variable {other} looks like a mask of the map, but its name does not say "
                f"what it marks: call it {FILLED}, nonzero where a pixel is missing, or write NaN "
                "into the map and leave it out"
            )


def _may_mark(path: Path, name: str, variable: Variable, listed: bool) -> bool:
    """Tell whether an array marks pixels: by its name or what it says, or as it holds 0 and 1."""
    if variable.dtype.kind not in "biuf":
        return False
    meanings = str(variable.attrs.get("flag_meanings", ""))
    known = listed or any(map(is_mask, (name, meanings)))
    if meanings and not known:
        return False  # flags of something else
    values = values_of(path, name, variable)
    varies = bool(values.size and (values != values.flat[0]).any())
    return varies and (known or bool(np.isin(values, (0, 1, 255)).all()))


def _flags(
    path: Path, contents: Contents, mask: str, name: str, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    where = f"{path}, variable {mask}"
    variable = contents.variables.get(mask)
    if variable is None or variable.dtype.kind not in "biuf" or len(variable.shape) != 2:
        found = f"its shape is {variable.shape} and its type {variable.dtype}" if variable else ""
        raise InputError(
            f"{where} should mark pixels that are missing by 1 or true, but "
            + (found or "it is no array of numbers")
        )
    flags = labelled(path, contents, mask, like=name).values
    if flags.shape != shape:
        raise InputError(
            f"{where} marks {flags.shape[0]} x {flags.shape[1]} pixels (y, x), the map has "
            f"{shape[0]} x {shape[1]}"
            + ("; is it transposed?" if flags.shape == shape[::-1] else "")
        )
    if not np.isin(flags, (0, 1)).all():
        raise InputError(f"{where} should hold 0 and 1, nonzero where a pixel is missing")
    return flags.astype(bool)
