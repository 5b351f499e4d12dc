"""Whether the pages say what the code beside them computes: every number against a fresh run."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from optical_palpation.errors import ConvergenceError, InputError
from optical_palpation.reproduce.page import Page, page_text
from optical_palpation.reproduce.record import Row, Setting, load_part, run_part

#: A number, and the sign of percent that may follow it.
_NUMBER = re.compile(r"(?<![\w.])[-+\N{MINUS SIGN}]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?( ?%)?")
_TEXTS = tuple(field.name for field in fields(Row) if field.name not in ("tolerance",))


@dataclass(frozen=True)
class Checked:
    """What a check found.

    Attributes
    ----------
    numbers
        How many numbers were compared.
    differences
        What differs, by part, in words.
    left_out
        Why parts were not made anew, by name.
    """

    numbers: int
    differences: Mapping[str, Sequence[str]]
    left_out: Mapping[str, Exception]


def check_pages(
    folder: str | Path,
    pages: Sequence[Page],
    *,
    only: Sequence[str] = (),
    data: str | Path | None = None,
    references: str | Path | None = None,
    quick: bool = False,
    threads: int | None = None,
    tell: Callable[[str, float, str], None] | None = None,
) -> Checked:
    """Make parts anew, in a folder of their own, and compare them with those of a folder.

    A number agrees if it is within the tolerance of its row, as a fraction of it; one in per cent
    within as many points. The words around the numbers must be the same, and the page must be what
    its parts' records give.

    Parameters
    ----------
    folder
        Folder of the pages; nothing in it is changed.
    pages
        The pages.
    only, data, references, threads, tell
        As for :func:`~optical_palpation.reproduce.reproduce`.
    quick
        Compare with records that were made quickly.

    Raises
    ------
    InputError
        If the folder holds none of the parts that were asked for.
    """
    folder = Path(folder)
    numbers, differences, left_out = 0, dict[str, list[str]](), dict[str, Exception]()
    found = False
    for page in pages:
        names = [name for name in page.chapters if not only or name in only or page.name in only]
        records = {name: load_part(name, folder / page.name) for name in names}
        if not any(records.values()):
            continue
        found = True
        path = folder / f"{page.name}.md"
        written = path.read_text("utf-8") if path.is_file() else ""
        for block in page_text(folder, page, {}).split("\n\n"):
            if block.strip() not in written and not block.startswith("Not made: "):
                differences.setdefault(page.name, []).append(
                    f"{path} does not say what its records do: {block.strip()[:70]} ..."
                )
        for name, record in records.items():
            if record is None or record["quick"] != quick:
                which = "not there" if record is None else "of the other kind (--quick)"
                differences[name] = [f"{folder / page.name / name}.json is {which}"]
                continue
            with tempfile.TemporaryDirectory() as fresh:
                setting = Setting(
                    Path(fresh),
                    quick,
                    Path(data) if data else None,
                    partial(tell or _silent, name),
                    threads,
                    Path(references) if references else None,
                )
                try:
                    run_part(name, page.chapters[name].make, setting)
                except (InputError, ConvergenceError) as failure:
                    left_out[name] = failure
                    continue
                again = load_part(name, Path(fresh))
            assert again is not None
            if data is None and (absent := len(record["rows"]) - len(again["rows"])) > 0:
                made = {row["statement"] for row in again["rows"]}
                there = [row for row in record["rows"] if row["statement"] in made]
                record = record | {"rows": there}
                left_out[name] = InputError(f"{absent} of its rows need third-party data (--data)")
            count, said = compared(record, again)
            numbers += count
            if said:
                differences[name] = said
    if not found:
        raise InputError(f"{folder}: holds no part of the pages that were asked for")
    return Checked(numbers, differences, left_out)


def compared(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[int, list[str]]:
    """Compare two records of a part: how many numbers there are, and what differs."""
    said = []
    if there["text"] != here["text"]:
        said.append("its introduction is another one")
    if len(there["rows"]) != len(here["rows"]):
        return 0, [*said, f"{len(there['rows'])} rows, a fresh run has {len(here['rows'])}"]
    count = 0
    for old, new in zip(there["rows"], here["rows"], strict=True):
        tolerance = new["tolerance"]
        for column in _TEXTS:
            numbers, agree = _agree(old[column], new[column], tolerance)
            count += numbers
            if not agree:
                said.append(
                    f"{old['statement']}: {old[column]!r}, a fresh run has {new[column]!r} "
                    f"(tolerance {tolerance:g})"
                )
    return count, said


def _agree(there: str, here: str, tolerance: float) -> tuple[int, bool]:
    """How many numbers a text holds, and whether another one agrees with it."""
    if not math.isfinite(tolerance):
        return 0, True
    olds, news = list(_NUMBER.finditer(there)), list(_NUMBER.finditer(here))
    if _NUMBER.sub("#", there) != _NUMBER.sub("#", here):
        return len(olds), False
    for old, new in zip(olds, news, strict=True):
        a, b = _value(old[0]), _value(new[0])
        # "(+2e-07)" is a relative error, as are per cent: they agree within points
        relative = old[1] is not None or there[: old.start()].endswith("(")
        scale = 100.0 if old[1] is not None else 1.0
        allowed = tolerance * (scale if relative else abs(b)) + _last_digit(new[0])
        if abs(a - b) > allowed:
            return len(olds), False
    return len(olds), True


def _value(text: str) -> float:
    return float(text.replace(",", "").replace("\N{MINUS SIGN}", "-").rstrip(" %"))


def _last_digit(text: str) -> float:
    """Worth of one in the last digit."""
    mantissa, _, power = text.replace(",", "").rstrip(" %").partition("e")
    places = len(mantissa.partition(".")[2])
    return 10.0 ** (float(power or 0) - places)


def _silent(part: str, share: float, what: str) -> None:
    """Report nothing."""
