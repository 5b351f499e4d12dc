"""What a batch consists of: read from a CSV or TOML table, or from a folder of studies."""

from __future__ import annotations

import csv
import io
import itertools
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from optical_palpation.arguments import toml_fault
from optical_palpation.errors import InputError
from optical_palpation.files import seen_from
from optical_palpation.study.reading import fault_of_name, relocated

#: Values that are paths, besides those of a sample; they count from the folder of the table.
_PATHS = frozenset(
    f"{side}.{key}" for side in ("unloaded", "loaded") for key in ("volume", "map", "corrections")
)
#: Tables, page and record in the folder of the results.
CSV, PARQUET, INDEX, RECORD = "scans.csv", "scans.parquet", "index.html", "batch.json"
#: What a table says of a scan besides values of its study.
_OWN = ("name", "study", "regions")
#: Ending of the file that says why a scan failed, which has its name.
ERROR = ".error.txt"
_COMMA = re.compile(r"[-+]?\d*,\d+")
_LARGEST = 32 * 1024**2  # bytes of a table
_MOST = 100_000  # scans


@dataclass(frozen=True)
class Scan:
    """One study of a batch.

    Attributes
    ----------
    name
        Of its folder and in the table of results.
    study
        The study file.
    overrides
        Values that go before those of the file, by table and key: ``{"friction.window": 0.2}``.
    regions
        A file of regions of interest, as :func:`~optical_palpation.analysis.read_regions` takes
        it, or None.
    title
        The name as its table has it, where `name` is not the same: folders take fewer characters.
    """

    name: str
    study: Path
    overrides: Mapping[str, Any]
    regions: Path | None = None
    title: str | None = None


@dataclass(frozen=True)
class Batch:
    """Scans, and the folder of their results.

    Attributes
    ----------
    source
        The table or folder that it was read from.
    scans
        In the order of the source; names differ.
    folder
        Each scan has a folder of its name in it.
    """

    source: Path
    scans: tuple[Scan, ...]
    folder: Path


def read_batch(
    source: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    regions: str | os.PathLike[str] | None = None,
) -> Batch:
    """Read a table of studies.

    Parameters
    ----------
    source
        A CSV file with a row for each scan: column ``study``, and if need be ``name``, ``regions``
        and values that differ from the study's, such as ``friction.window``; a TOML file with the
        same in ``[[scan]]`` tables, with values for all in ``[overrides]`` and lists of values in
        ``[sweep]``, of which every combination is made; or a folder, of which every study file is
        taken. Paths in a table count from its folder.
    folder
        Folder of the results; by default named after the source, beside it.
    regions
        Regions of interest for every scan that has no such file of its own.

    Raises
    ------
    InputError
        Naming everything in the table that cannot be used. What is wrong within a study is told
        when the study is run.
    """
    source = Path(source)
    if os.path.isdir(source):
        scans = list(_studies(source))
        settings: dict[str, Any] = {}
    else:
        suffix = source.suffix.lower()
        if suffix not in (".csv", ".tsv", ".txt", ".toml"):
            raise InputError(
                f"{source}: a batch is a table (.csv, .toml) or a folder of study files"
            )
        text = _text(source)
        if suffix == ".toml":
            scans, settings = _from_toml(source, text)
        else:
            scans, settings = _from_csv(source, text), {}
    if not scans:
        raise InputError(f"{source}: there is no study in it")
    if len(scans) > _MOST:
        raise InputError(f"{source}: makes {len(scans):,} scans; more than {_MOST:,} are refused")
    seen: dict[str, int] = {}
    for n, scan in enumerate(scans, 1):
        if scan.name.casefold() in seen:
            raise InputError(
                f"{source}: scans {seen[scan.name.casefold()]} and {n} are both called "
                f"{scan.name!r}; give them names that differ"
            )
        seen[scan.name.casefold()] = n
    for name in seen:
        of_other = name.endswith(ERROR) and name.removesuffix(ERROR) in seen
        if of_other or name in (CSV, PARQUET, INDEX, RECORD):
            raise InputError(
                f"{source}: scan {seen[name]} is called {name!r}, which is a file of the results; "
                "give it another name"
            )
    if regions is not None:
        shared = Path(regions)
        if not os.path.isfile(shared):
            raise InputError(f"{shared}: no such file of regions")
        scans = [replace(scan, regions=scan.regions or shared) for scan in scans]
    for file in dict.fromkeys(scan.regions for scan in scans if scan.regions is not None):
        if not os.path.isfile(file):
            raise InputError(f"{source}: regions: there is no file {file}")
    given = settings.get("folder")
    default = source.resolve() if source.is_dir() else source
    target = folder or (source.parent / given if given else None)
    if target is None:
        target = default.with_name(f"{default.name if source.is_dir() else source.stem}-results")
    target = Path(target)
    if source.resolve() in {(target / name).resolve() for name in (CSV, PARQUET, INDEX, RECORD)}:
        raise InputError(
            f"{source}: is where the results of the batch go; choose another folder for them, or "
            "rename the table"
        )
    return Batch(source, tuple(scans), target)


def _text(source: Path) -> str:
    try:
        if source.stat().st_size > _LARGEST:
            raise InputError(f"{source}: is too large for a table of studies")
        return source.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{source}: no such file or folder") from None
    except OSError as error:
        raise InputError(f"{source}: the table cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"{source}: is no table, which is UTF-8 text; a spreadsheet saves it as 'CSV UTF-8'"
        ) from error


def _studies(folder: Path) -> Iterator[Scan]:
    """Every study file below a folder, named after its path; ``a/study.toml`` is ``a``."""
    for path in sorted(folder.rglob("*.toml")):
        inside = path.relative_to(folder)
        if any(part.startswith(".") for part in inside.parts):
            continue
        parts = [*inside.parts[:-1], inside.stem]
        if len(parts) > 1 and parts[-1] == "study":
            parts.pop()
        yield _named(Scan("", path, {}), "-".join(parts))


def _from_csv(source: Path, text: str) -> list[Scan]:
    said = re.match(r"\s*sep=([,;\t])(?=[\r\n])", text)  # a first line that Excel takes
    if said:
        text = "\n" * text[: said.end()].count("\n") + text[said.end() :]
    first = next((line for line in text.splitlines() if line.strip()), "")
    delimiter = said[1] if said else max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    numbered = []
    try:
        for row in reader:
            cells_of_row = [cell.strip() for cell in row]
            if any(cells_of_row):
                numbered.append((reader.line_num, cells_of_row))
    except csv.Error as error:
        raise InputError(f"{source}, line {reader.line_num}: is no CSV ({error})") from error
    if not numbered:
        return []
    (_, header), *body = numbered
    while header and not header[-1]:  # columns that are empty from top to bottom
        header.pop()
    _check_columns(source, header)
    scans: list[Scan] = []
    problems = []
    for line, row in body:
        while len(row) > len(header) and not row[-1]:
            row.pop()
        if len(row) != len(header):  # one that is short may lack a cell anywhere
            problems.append(f"line {line}: {len(row)} cells below {len(header)} columns")
            continue
        cells = {key: cell for key, cell in zip(header, row, strict=True) if cell}
        if "study" not in cells:
            problems.append(f"line {line}: column study is empty")
            continue
        commas = [key for key, cell in cells.items() if "." in key and _COMMA.fullmatch(cell)]
        if commas:
            wrong = ", ".join(f"{key} = {cells[key]}" for key in commas)
            problems.append(f"line {line}: {wrong}: decimals have a point")
            continue
        overrides = {
            key: cell if key == "title" or _is_path(key, cell) else _value(cell)
            for key, cell in cells.items()
            if key not in _OWN
        }
        scans.append(_scan(source, cells, overrides, len(scans) + 1))
    if problems:
        raise InputError("\n  ".join([f"{source}: cannot be used:", *problems]))
    return scans


def _check_columns(source: Path, header: Sequence[str]) -> None:
    for column in header:
        if (plain := column.casefold()) in _OWN and plain != column:
            raise InputError(f"{source}: column {column!r}: write {plain}")
        if fault := "" if column in _OWN else fault_of_name(column):
            raise InputError(
                f"{source}: {column} is unknown ({fault}); a table has study, name, regions, and "
                "values of a study such as friction.window"
            )
    if "study" not in header:
        raise InputError(f"{source}: has no column named study; found {', '.join(header)}")
    if doubled := sorted({c for c in header if list(header).count(c) > 1}):
        raise InputError(f"{source}: has several columns named {', '.join(doubled)}")
    if "outputs.folder" in header:
        raise InputError(f"{source}: outputs.folder: a batch gives each scan a folder of its name")


def _from_toml(source: Path, text: str) -> tuple[list[Scan], dict[str, Any]]:
    try:
        given = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{source}: is no valid TOML: {toml_fault(error, text)}") from error
    known = {"study": str, "folder": str, "regions": str, "overrides": dict, "sweep": dict}
    rows: Any = given.pop("scan", [{}])
    for key, value in given.items():
        if key not in known:
            raise InputError(
                f"{source}: {key} is unknown; a batch has study, folder, regions, [overrides], "
                "[sweep] and [[scan]]"
            )
        if not isinstance(value, known[key]):
            kind = "a table" if known[key] is dict else "text in quotes"
            raise InputError(f"{source}: {key} = {value!r}: must be {kind}")
    if not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
        raise InputError(f"{source}: scan: must be an array of tables, [[scan]]")
    common = dict(_flat(given.get("overrides", {})))
    sweep = dict(_flat(given.get("sweep", {})))
    for key, values in sweep.items():
        if not (isinstance(values, list) and values):
            raise InputError(f"{source}: sweep.{key} = {values!r}: must be a list of values")
    scans: list[Scan] = []
    count = len(rows)
    for values in sweep.values():
        count *= len(values)
    if count > _MOST:
        raise InputError(f"{source}: makes {count:,} scans; more than {_MOST:,} are refused")
    for n, row in enumerate(rows, 1):
        about = {key: row[key] for key in _OWN if key in row}
        for key, value in about.items():
            if not isinstance(value, str):
                raise InputError(f"{source}: scan {n}: {key} = {value!r}: must be text in quotes")
        own = dict(_flat({key: value for key, value in row.items() if key not in about}))
        about = {k: given[k] for k in ("study", "regions") if k in given} | about
        if "study" not in about:
            raise InputError(f"{source}: scan {n}: study is missing, here and for all")
        for chosen in itertools.product(*sweep.values()):
            swept = dict(zip(sweep, chosen, strict=True))
            overrides = common | own | swept
            _check_columns(source, ["study", *overrides])
            scan = _scan(source, about, overrides, n)
            said = scan.title or scan.name
            if swept and (len(rows) == 1 and "name" not in about):
                said = ""
            ending = "-".join(
                f"{key.rpartition('.')[2]}_{_short(value, values)}"
                for (key, value), values in zip(swept.items(), sweep.values(), strict=True)
            )
            scans.append(_named(scan, "-".join(part for part in (said, ending) if part)))
    return scans, given


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Values of nested tables by their full keys; spacing and origin are values themselves."""
    for key, value in table.items():
        if isinstance(value, dict) and key not in ("spacing", "origin"):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _scan(
    source: Path, about: Mapping[str, str], overrides: Mapping[str, Any], number: int
) -> Scan:
    study = source.parent / about["study"]
    moved = {
        key: seen_from(study.parent, source.parent / value)
        if key in _PATHS and isinstance(value, str)
        else value
        for key, value in overrides.items()
    }
    sample = {
        key.removeprefix("sample."): value
        for key, value in overrides.items()
        if key.startswith("sample.")
    }
    files = relocated(sample, lambda _, name: seen_from(study.parent, source.parent / name))
    moved |= {f"sample.{key}": value for key, value in files.items()}
    regions = source.parent / about["regions"] if "regions" in about else None
    said = about.get("name", f"{number:04d}-{study.stem}")
    return _named(Scan("", study, moved, regions), said)


def _named(scan: Scan, said: str) -> Scan:
    """A scan with the name that it was given, and one that its folder can have."""
    name = _file_name(said)
    return replace(scan, name=name, title=None if name == said else said)


def _value(cell: str) -> Any:
    """A cell as TOML has it, or as text."""
    if "\n" in cell or "\r" in cell:
        return cell
    try:
        return tomllib.loads(f"value = {cell}")["value"]
    except (tomllib.TOMLDecodeError, KeyError, RecursionError):
        return cell


def _is_path(key: str, cell: str) -> bool:
    """Whether a cell is a path; the motion of the sample may be a number instead."""
    if key == "sample.motion":
        return not isinstance(_value(cell), int | float)
    return key in _PATHS or key == "sample.relief"


def _short(value: Any, among: Sequence[Any]) -> str:
    """A swept value in the name of a folder; what is no number or text goes by its place."""
    if isinstance(value, bool | int | float | str):
        return Path(value).stem if isinstance(value, str) else str(value)
    return str(1 + list(among).index(value))


def _file_name(name: str) -> str:
    """A name that every file system takes."""
    cleaned = re.sub(r"[^\w.+-]+", "_", name).strip("._ ")[:120]
    return cleaned or "scan"
