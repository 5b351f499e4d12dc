"""Thickness maps as tables in text files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError

#: Most values of a map: 4096 x 4096 pixels. What states more is damaged, or meant to fill memory.
MAX_VALUES = 2**24
_MAX_LINE = 2**18  # characters: a row of 8192 numbers with all their digits


def read_table(path: Path) -> NDArray[np.float64]:
    """Read a table with one line per row of pixels, NaN where a cell is empty.

    Raises
    ------
    InputError
        If the file is no UTF-8 text or no table of numbers; it names line and column.
    """
    lines = _lines(path)
    number, line = next(lines, (0, ""))
    if not line:
        raise InputError(f"{path} holds no numbers, only blank lines or comments")
    delimiter = next((mark for mark in "\t;," if mark in line), None)
    header = _cells(line, delimiter)
    if all(_number(cell) is None for cell in header):
        if {cell.lower().split("_")[0] for cell in header} >= {"x", "y"}:
            raise InputError(
                f"{path}, line {number}: the header {', '.join(header)} says that this is a "
                "list of points; a map needs one line per row of pixels"
            )
        number, line = next(lines, (0, ""))
        if not line:
            raise InputError(f"{path} holds a header line but no numbers")
    rows = [_row(path, number, _cells(line, delimiter))]
    columns = rows[0].size
    for number, line in lines:
        cells = _cells(line, delimiter)
        if len(cells) != columns:
            raise InputError(
                f"{path}, line {number}: {len(cells)} columns where the lines before have {columns}"
            )
        rows.append(_row(path, number, cells))
        if len(rows) * columns > MAX_VALUES:
            raise InputError(
                f"{path}, line {number}: more than {MAX_VALUES} numbers, too many for a map"
            )
    return np.stack(rows)


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(delimiter)]


def _row(path: Path, number: int, cells: list[str]) -> NDArray[np.float64]:
    values = [_number(cell) for cell in cells]
    if None in values:
        column = values.index(None)
        raise InputError(
            f"{path}, line {number}, column {column + 1}: {cells[column][:40]!r} is no number"
        )
    return np.array(values, dtype=np.float64)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that hold more than a comment, with their numbers."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            number = 0
            while raw := file.readline(_MAX_LINE):
                number += 1
                if len(raw) == _MAX_LINE:
                    raise InputError(
                        f"{path}, line {number}: longer than {_MAX_LINE} characters, which no row "
                        "of a thickness map is"
                    )
                if (line := raw.split("#")[0].split("%")[0].rstrip()).strip():
                    yield number, line
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is neither UTF-8 text nor in another format that holds a thickness map"
        ) from error


def _number(cell: str) -> float | None:
    """Value of a cell, NaN if it is empty (a missing pixel), None if it is no number."""
    if not cell or cell.upper() in ("NA", "N/A"):
        return np.nan
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
