"""Tables of numbers in text files: a map with one line per row of pixels.

Lines are split by the standard library and not by pandas, which fills lines that are too short
with missing values, takes the first column for an index where lines are longer than the header,
and does not say which line was wrong.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import LazyArray
from .contents import Contents
from .metadata import Stated
from .remarks import unclear_unit, units_of_remarks
from .units import length_unit, split_unit, unit_in_words

FORMAT = "text"

#: Most values of a map: 4096 x 4096 pixels. What states more is damaged, or meant to fill memory.
MAX_VALUES = 2**24
# So few columns, so many times as many lines: points or a profile.
_FEW, _LONG = 4, 10
_MAX_LINE = 2**18  # characters: a row of 8192 numbers with all their digits
_MISSING = {"", "NA", "N/A", "NAN", "-NAN"}
# What else than _MISSING stands for a missing pixel, and names no column: --, <NA>, 1.#QNAN
_MARK = re.compile(
    r"[\W_]*(?:|null|none|nil|na|nd|n[./]?[ad]\.?|missing|invalid|undefined|masked|1\.#\w+"
    r"|nan\(\w+\))[\W_]*",
    re.IGNORECASE,
)
_EMPTY_ROW = "If this is a row of missing pixels, write nan into it; else remove the line"
_MAX_REMARKS = 10_000
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
# What Octave, and NumPy's users after its manual, write above each of several arrays.
_ONE_ARRAY = re.compile(r"\s*(?:name:|new slice)", re.IGNORECASE)
_SIZE = re.compile(r"\s*(?P<axis>rows|columns):\s*(?P<count>[0-9]{1,9})\s*", re.IGNORECASE)
_OTHER_MATRIX = re.compile(r"\s*type:\s*((?:sparse|diagonal|permutation|complex) .*matrix)\s*")
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9.]*,[0-9]+|[0-9]+\s+[-+]?[0-9]+")  # 0,5 0,6
# What a first column of coordinates or numbers is called.
_LABELS = re.compile(
    r"[xyz]|[xyz]?[ _-]*(?:pos(?:ition)?|coord(?:inate)?|distance|index|idx)s?|rows?|lines?|scans?"
    r"|b-?scans?|frames?|pixels?|points?|columns?|n[or]\.?|number|id|time|date",
    re.IGNORECASE,
)
# x=0 um is a position; x200um and col 200 um may be one.
_POSITION = re.compile(r"(?:.*[=:@]\s*)?[-+]?[0-9.]+(?:e[-+]?[0-9]+)?", re.IGNORECASE)
_PERHAPS_POSITION = re.compile(r"(?:.*\s|[xyz]|pos\w*|col\w*|row|at)_?[-+]?[0-9.]+", re.IGNORECASE)
_NUMBERED = re.compile(r"(.*[^\W\d_][)\]]?)[\s_.-]+[0-9.]+")  # L1_um_0
# A comment begins a line or follows a space: 1.#QNAN is a cell, and so are Excel's errors, in any
# language: #N/A, #NV, #DIV/0!, #NAME?
_ERROR = r"#(?:N/[A-Z]|NV|¡?[^\W_a-z][^\s,;a-z]*[!?])(?:[\s,;\"]|$)"
_COMMENT = {marks: re.compile(rf"(?:^|(?<=\s))(?!{_ERROR})[{marks}]") for marks in ("#", "#%")}
_SEPARATOR = re.compile(r'"?sep=(.)"?', re.IGNORECASE)  # Excel's first line


@dataclass(frozen=True)
class Line:
    """A line that holds more than a comment, split into its cells."""

    number: int
    cells: list[str]
    after_blank: bool = False


def recognises(path: Path, head: bytes) -> bool:
    """Any file without a zero byte, or one that begins with the mark of UTF-16."""
    return bool(head) and (b"\0" not in head or head.startswith(_UTF_16))


def contents(path: Path, wanted: str | None) -> Contents:
    """Read the table."""
    table, unit, unclear = read_table(path)
    texts = {"units": unit} if unit else {}
    found = Contents.single(LazyArray(table), Stated(), "loaded", texts=texts)
    found.unclear_unit = unclear
    return found


def read_table(path: Path) -> tuple[NDArray[np.float64], str | None, str | None]:
    """Read a table with one line per row of pixels, NaN where a cell is empty.

    Returns
    -------
    numpy.ndarray
        The numbers.
    str or None
        The unit that a comment (``units: um``) or the names of the columns state.
    str or None
        If there is none, what makes it unclear: a unit that may be of something else.

    Raises
    ------
    InputError
        If the file is no text or no table of numbers, naming line and column; or if a first line,
        first column or empty last column may be something else than pixels.
    """
    remarks: list[str] = []
    lines = split_lines(path, remarks=remarks)
    first = next(lines, None)
    if first is None:
        raise InputError(f"{path} holds no numbers, only blank lines or comments")
    header = None
    if all(_number(cell) is None or not cell for cell in first.cells) and any(first.cells):
        header = first
        _refuse_marks(path, header)
        _refuse_points(path, header)
        first = next(lines, None)
        if first is None:
            raise InputError(f"{path} holds a header line but no numbers")
    columns = len(first.cells)
    rows: list[NDArray[np.float64]] = []
    edges = [first, first]
    unfinished = unbegun = True  # whether every line ends, or begins, with an empty cell
    blocks = [0]  # lines of each part between blank lines
    german = columns > 1 and columns % 2 == 0  # 0,5 for 0.5, between commas
    padded = [False, False]  # whether a number of an even, or odd, column begins with a zero
    while first is not None:
        line, first = first, next(lines, None)
        blocks += [0] if line.after_blank and rows else []
        blocks[-1] += 1
        german = german and all(cell.isdecimal() for cell in line.cells)
        for odd in (0, 1) if german else ():
            padded[odd] |= any(cell[0] == "0" < cell[1:] for cell in line.cells[odd::2])
        if len(line.cells) != columns:
            raise InputError(
                f"{path}, line {line.number}: {len(line.cells)} columns where the lines before "
                f"have {columns}"
            )
        edges[1] = line
        unfinished &= not line.cells[-1]
        unbegun &= not line.cells[0]
        rows.append(_row(path, line))
        if len(rows) * columns > MAX_VALUES:
            raise InputError(
                f"{path}, line {line.number}: more than {MAX_VALUES} numbers, too many for a map"
            )
    for line in edges:
        if columns > 1 and not any(line.cells):
            raise InputError(f"{path}, line {line.number}: only separators. {_EMPTY_ROW}")
    table = np.stack(rows)
    _refuse_several(path, remarks, blocks)
    if german:
        _refuse_decimal_commas(path, table, padded == [False, True])
    if (unfinished or unbegun) and columns > 1 and header is None:
        end, column = ("ends", "last") if unfinished else ("begins", "first")
        raise InputError(
            f"{path}: every line {end} with a separator. If the {column} column is missing pixels, "
            "write nan into it; else remove the separators"
        )
    named = header is not None and len(header.cells) == columns and header.cells[-1]
    if unfinished and columns > 1 and header is not None and not named:
        table = table[:, :-1]  # no column of that name: the separator ends the line
        header = Line(header.number, header.cells[: columns - 1])
    labelled, table = table, _without_labels(path, header, table)
    _refuse_other_size(path, remarks, labelled.shape, table.shape)
    return table, *_stated_unit(path, remarks, header)


def _refuse_other_size(path: Path, remarks: list[str], *shapes: tuple[int, ...]) -> None:
    """Refuse a table of which no shape, with or without labels, is that of Octave's header."""
    for remark in remarks:
        if (said := _SIZE.fullmatch(remark)) is None:
            continue
        counts = [shape[said["axis"].lower() == "columns"] for shape in shapes]
        if int(said["count"]) not in counts:
            raise InputError(
                f"{path}: its header says {remark.strip()}, but the table has {counts[-1]}: it is "
                "cut short, or the header is of another table. Save it anew, or correct the header"
            )


def _refuse_several(path: Path, remarks: list[str], blocks: list[int]) -> None:
    titles = sum(1 for remark in remarks if _ONE_ARRAY.match(remark))
    if titles > 1 or (len(blocks) > 1 and min(blocks) > 1):
        raise InputError(
            f"{path}: holds {max(titles, len(blocks))} tables one below the other; save the map in "
            "a file of its own"
        )
    if len(blocks) > 1 and max(blocks) > 1:
        raise InputError(
            f"{path}: blank lines divide the table into parts of {', '.join(map(str, blocks))} "
            "lines. Remove what is no row of pixels, such as means, and the blank lines"
        )
    for remark in remarks:
        if kind := _OTHER_MATRIX.fullmatch(remark):
            raise InputError(
                f"{path}: holds a {kind[1]} of Octave; save the map as a full matrix (full)"
            )


def _refuse_decimal_commas(path: Path, table: NDArray[np.float64], padded: bool) -> None:
    """Refuse whole numbers of which every second column holds what may be decimals.

    They have leading zeros, or single digits, or none of the values of the other columns, or take
    up most of a range 0 to 9...9 and a third as much at most is taken up by the others.
    """
    whole, decimals = table[:, ::2], table[:, 1::2]
    apart = decimals.max() < whole.min() or whole.max() < decimals.min()
    spread, other = (np.ptp(np.quantile(part, (0.1, 0.9))) for part in (decimals, whole))
    wide = spread > max(3.0 * other, 0.5 * 10 ** len(f"{decimals.max():.0f}"))
    single = decimals.max() < 10 <= whole.min()
    if padded or single or (table.shape[1] > 2 and (apart or wide)):
        raise InputError(
            f"{path}: every second column differs from those beside it, as decimals do: are these "
            "decimal commas, between commas? Write decimal points"
        )


def _stated_unit(
    path: Path, remarks: list[str], header: Line | None
) -> tuple[str | None, str | None]:
    """Unit that comments or the names of the columns state, and what is unclear if none does."""
    stated, unclear = units_of_remarks(remarks)
    names = [name for name in header.cells if len(name) < 100] if header else []
    numbers = [float(found[0]) for name in names if (found := re.search(r"[0-9]+\.?[0-9]*", name))]
    counted = len(numbers) == len(names) and _counts(np.array(numbers))  # col1_um, col2_um
    for cell in names:
        unit, sure = _unit_of(cell)
        if unit and (sure or counted):
            stated.add(unit)
        elif unit and length_unit(unit) != "mm":
            unclear[unit] = cell
    if len({length_unit(unit) or unit for unit in stated}) > 1:
        raise InputError(
            f"{path}: states several units: {', '.join(sorted(stated))}; leave only that of the "
            "thickness"
        )
    if stated or not unclear:
        return next(iter(stated), None), None
    return None, f"{unclear_unit(path, unclear)}, or add a comment '# units: mm', or um"


def _unit_of(name: str) -> tuple[str | None, bool]:
    """Unit in the name of a column, None if of a position, and whether it surely is no such."""
    numbered = _NUMBERED.fullmatch(name)
    words = numbered[1] if numbered else name
    quantity, unit = unit_in_words(words)
    if _POSITION.fullmatch(quantity):
        return None, True
    if numbered:
        perhaps = quantity.lower() in ("x", "y")
    else:
        perhaps = bool(_PERHAPS_POSITION.fullmatch(quantity)) and not name.endswith((")", "]"))
    return unit or length_unit(words), not perhaps


def split_lines(
    path: Path, comments: str = "#%", remarks: list[str] | None = None
) -> Iterator[Line]:
    """Yield the lines of a table, without comments and blank lines, split into stripped cells.

    Cells are separated by tabs, semicolons, commas or spaces, whichever of these the first line
    has, in this order of preference; quotes around cells are taken off. Comments are added to
    `remarks`.
    """
    delimiter: str | None = None
    first = True
    after_blank = False
    columns = 0
    spaces: dict[int, int] = {}  # how many, in a line of nothing else: its number
    for number, line in _lines(path, comments, remarks):
        if number == 1 and (stated := _SEPARATOR.fullmatch(line.strip())):
            delimiter, first = stated[1], False
            continue
        # Tabs alone are a row of empty cells where tabs separate them.
        if not line.strip() and not ("\t" in line and (first or delimiter == "\t")):
            after_blank = True
            spaces.setdefault(len(line), number)
            continue
        if first:
            delimiter, first = next((mark for mark in "\t;," if mark in line), None), False
        if delimiter is None:
            cells = [cell.strip('"') for cell in line.split()]
        elif '"' in line:
            cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
        else:
            cells = line.split(delimiter)
        columns = len(cells)
        yield Line(number, [cell.strip() for cell in cells], after_blank)
        after_blank = False
    if delimiter is None and columns > 1 and columns - 1 in spaces:
        raise InputError(f"{path}, line {spaces[columns - 1]}: only spaces. {_EMPTY_ROW}")


@dataclass(frozen=True)
class Columns:
    """A table whose columns have names: their cells, and the numbers of the lines."""

    path: Path
    names: list[str]
    rows: list[Line]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Values of a column.

        Raises
        ------
        InputError
            If there is no such column or there are several, or a cell is no finite number.
        """
        at = [number for number, other in enumerate(self.names) if other == name]
        if len(at) != 1:
            problem = f"{len(at)} columns are called" if at else "there is no column"
            raise InputError(
                f"{self.path}: {problem} {name!r}; the table has: {', '.join(self.names)}"
            )
        values = np.array([_number(row.cells[at[0]]) for row in self.rows], np.float64)
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            cell = self.rows[row].cells[at[0]]
            comma = ": write decimal points, no commas" if "," in cell else ""
            raise InputError(
                f"{self.path}: column {name!r}, data row {row + 1} holds {cell[:40]!r}, not a "
                f"number{comma}"
            )
        return values


def read_columns(path: Path) -> Columns:
    """Read a table with a header, and perhaps a second line with units, which joins the names.

    Raises
    ------
    InputError
        If the file is no UTF-8 text, or its lines do not have one cell for each name.
    """
    lines = split_lines(path, comments="#")
    header = next(lines, None)
    if header is None:
        raise InputError(f"{path}: cannot be read as a table: it has no lines")
    rows: list[Line] = []
    for line in lines:
        if not any(line.cells):
            continue
        rows.append(line)
        if len(rows) * len(line.cells) > MAX_VALUES // 16:
            raise InputError(f"{path}: too long for a table of measurements")
    names = header.cells
    if any(_number(name) is not None and name for name in names):
        raise InputError(f"{path}, line {header.number}: no header with the names of columns")
    counts = {len(row.cells) for row in rows}
    if counts == {len(names) + 1} and not any(row.cells[-1] for row in rows):
        rows = [Line(row.number, row.cells[:-1]) for row in rows]  # a separator ends every line
    for row in rows:
        if len(row.cells) != len(names):
            raise InputError(
                f"{path}, line {row.number}: {len(row.cells)} cells under a header of {len(names)}"
            )
    first = rows[0].cells if rows else []
    comma = any(map(_DECIMAL_COMMA.fullmatch, first))
    if any(first) and not comma and all(_number(c) is None or not c for c in first):
        names = [f"{name} {unit}".strip() for name, unit in zip(names, rows[0].cells, strict=True)]
        rows = rows[1:]
    return Columns(path, names, rows)


def _refuse_marks(path: Path, header: Line) -> None:
    """Refuse a first line without numbers that may be pixels: missing, or with decimal commas."""
    cells = list(filter(None, header.cells))
    if any(map(_DECIMAL_COMMA.fullmatch, cells)):
        raise InputError(f"{path}, line {header.number}: write decimal points, no commas")
    same = len(cells) > 1 and len(set(cells)) == 1 and not _unit_of(cells[0])[0]
    if same or all(map(_MARK.fullmatch, cells)):
        raise InputError(
            f"{path}, line {header.number}: {cells[0][:40]!r} is no number. If it stands for "
            "missing pixels, write nan; if the line is a header, remove it"
        )


def _refuse_points(path: Path, header: Line) -> None:
    names = [
        cell.lower().replace("(", "_").replace("[", "_").split("_")[0] for cell in header.cells
    ]
    if {"x", "y"} <= {name.strip() for name in names}:
        raise InputError(
            f"{path}, line {header.number}: the header {', '.join(header.cells)} says that this is "
            "a list of points; a map needs one line per row of pixels"
        )


def _without_labels(
    path: Path, header: Line | None, table: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Take off numbers of rows and columns, as pandas and R write them; refuse other labels."""
    rows, columns = table.shape
    corner_empty = np.isnan(table[0, 0])
    if header is not None and len(header.cells) not in (columns, columns - 1):
        raise InputError(
            f"{path}, line {header.number}: the header has {len(header.cells)} columns, the lines "
            f"below have {columns}"
        )
    first_column, first_row = table[:, 0], table[0]
    if header is not None:
        named = len(header.cells) == columns and header.cells[0]
        if not named and columns > 2:  # a column without a name, or with none at all
            if not _counts(first_column):
                raise InputError(
                    f"{path}: the first column has no name in the header and is no count of the "
                    "lines: its labels may be coordinates. Remove them, and give field of view or "
                    "pixel spacing"
                )
            return table[:, 1:]
        if rows > 2 and columns > 2 and _counts(first_column):
            raise InputError(
                f"{path}: the first column, {header.cells[0]!r}, counts the lines; remove it"
            )
        if columns > 1 and _names_labels(header):
            raise InputError(
                f"{path}: the first column is called {header.cells[0]!r}: its numbers may be "
                "coordinates. Remove it, and give field of view or pixel spacing; or give it the "
                "name of a thickness"
            )
        if rows > 2 and columns > 2:
            _refuse_coordinates(path, "column", table.T)
        _refuse_points_or_profile(path, table)
        return table
    if rows > 2 and columns > 2:
        if corner_empty and _counts(first_row[1:]) and _counts(first_column[1:]):
            return table[1:, 1:]
        if corner_empty and _steady(first_row[1:]) and _steady(first_column[1:]):
            raise InputError(
                f"{path}: the first cell holds no number, first line and first column rise or fall "
                "steadily: they may be coordinates. Remove them, and give field of view or pixel "
                "spacing; or save the map as .npy or .mat if the first cell is a missing pixel"
            )
        if _counts(first_row) and not _counts(table[1]):
            if first_row[0] == 0.0:  # which is no thickness
                return _without_labels(path, None, table[1:])
            raise InputError(
                f"{path}: the first line counts the columns, {first_row[0]:g} to "
                f"{first_row[-1]:g}; remove it if it is no thickness"
            )
        if _counts(first_column):
            raise InputError(f"{path}: the first column counts the lines; remove it")
        _refuse_coordinates(path, "line", table)
        _refuse_coordinates(path, "column", table.T)
    _refuse_points_or_profile(path, table)
    return table


def _names_labels(header: Line) -> bool:
    """Tell whether the name of the first column, unlike those of the others, is of positions."""
    stems = [split_unit(name)[0] for name in header.cells]
    return bool(_LABELS.fullmatch(stems[0])) and stems[0] not in stems[1:]


def _refuse_coordinates(path: Path, what: str, table: NDArray[np.float64]) -> None:
    """Refuse a first line, or with the table turned a first column, that may be coordinates."""
    if _evenly_spaced(table[0]) and not _evenly_spaced(table[1]):
        raise InputError(
            f"{path}: the numbers of the first {what} are evenly spaced: they may be coordinates. "
            "Remove them, or save the map as .npy or .mat if they are thickness"
        )
    edge, inside = table[0, 1:], table[1:, 1:]
    low, high = np.nanmin(inside, initial=np.inf), np.nanmax(inside, initial=0.0)
    beyond = edge.max() > 2.0 * high or edge.min() < 0.5 * low
    if edge.size > 3 and _steady(edge) and beyond:
        raise InputError(
            f"{path}: the numbers of the first {what} rise or fall steadily, far beyond all "
            "others: they may be coordinates. Remove them, and give field of view or pixel spacing"
        )


def _counts(values: NDArray[np.float64]) -> bool:
    """Tell whether values are 0, 1, 2, ... or 1, 2, 3, ..."""
    return bool(
        values.size > 1
        and values[0] in (0.0, 1.0)
        and np.array_equal(values, values[0] + np.arange(values.size))
    )


def _evenly_spaced(values: NDArray[np.float64]) -> bool:
    """Tell whether five values or more rise or fall by the same step, as no measured ones do."""
    steps = np.diff(values)
    return values.size > 4 and steps[0] != 0.0 and bool(np.allclose(steps, steps[0], rtol=1e-6))


def _steady(values: NDArray[np.float64]) -> bool:
    steps = np.diff(values)
    return bool(values.size > 1 and (np.all(steps > 0.0) or np.all(steps < 0.0)))


def _refuse_points_or_profile(path: Path, table: NDArray[np.float64]) -> None:
    """Refuse few long columns, and three of which two run through the points of a grid."""
    rows, columns = table.shape
    if columns <= _FEW and rows >= _LONG * columns:
        raise InputError(
            f"{path}: {rows} lines of {columns} numbers: this looks like a list of points or a "
            "profile; a map needs one line per row of pixels. Save it as .npy if it is a map"
        )
    if columns == 3 and rows >= 4:
        for one, other in ((0, 1), (1, 0)):
            positions = np.unique(table[:, one])
            if 1 < positions.size < rows and rows % positions.size == 0:
                repeats = rows // positions.size
                slow = np.array_equal(np.repeat(table[::repeats, one], repeats), table[:, one])
                block = table[:repeats, other]
                if slow and np.array_equal(np.tile(block, positions.size), table[:, other]):
                    raise InputError(
                        f"{path}: columns 1 and 2 run through the points of a grid: this is a "
                        "list of points; a map needs one line per row of pixels"
                    )


def _row(path: Path, line: Line) -> NDArray[np.float64]:
    try:  # most lines, several times as fast
        if not any("_" in cell for cell in line.cells):
            return np.array(list(map(float, line.cells)))
    except ValueError:
        pass
    values = [_number(cell) for cell in line.cells]
    if None in values:
        column = values.index(None)
        decimal_comma = _DECIMAL_COMMA.fullmatch(line.cells[column])
        raise InputError(
            f"{path}, line {line.number}, column {column + 1}: {line.cells[column][:40]!r} is no "
            "number" + ("; write decimal points, no commas" if decimal_comma else "")
        )
    return np.array(values, dtype=np.float64)


def _lines(path: Path, comments: str, remarks: list[str] | None) -> Iterator[tuple[int, str]]:
    """Lines without their comments, and their numbers; none that holds only a comment."""
    try:
        with path.open("rb") as raw_file:
            wide = raw_file.read(2) in _UTF_16
        with path.open(encoding="utf-16" if wide else "utf-8-sig") as file:
            number = 0
            while raw := file.readline(_MAX_LINE):
                number += 1
                if len(raw) == _MAX_LINE:
                    raise InputError(
                        f"{path}, line {number}: longer than {_MAX_LINE} characters, which no row "
                        "of a table is"
                    )
                line = raw.rstrip("\r\n")
                line, *remark = _COMMENT[comments].split(line, maxsplit=1)
                if remark and remarks is not None and len(remarks) < _MAX_REMARKS:
                    remarks += remark
                if line.strip() or not remark:
                    yield number, line
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        if error.object[error.start : error.start + 2] == b"\xb5m":
            raise InputError(
                f"{path}: its unit µm is written in Latin-1, as Windows does; save it as text in "
                "UTF-8, or write um"
            ) from error
        raise InputError(
            f"{path} is neither text in UTF-8 nor in another known format; if it is a table, save "
            "it as text in UTF-8"
        ) from error


def _number(cell: str) -> float | None:
    """Value of a cell, NaN if it is empty (a missing pixel), None if it is no number."""
    if cell.upper() in _MISSING:
        return np.nan
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
