"""What a part of a page says, and its file in the folder of the page."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import psutil

from optical_palpation.errors import InputError
from optical_palpation.files import replacing
from optical_palpation.runtime import software_version


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    where
        Figure, section or other source of the statement.
    statement
        What is compared.
    reference
        The number of that source.
    ours
        Ours.
    why
        Why they differ, or what the agreement means.
    tolerance
        Within which a fresh run must find the same numbers, as a fraction of them (of those in per
        cent, and of errors, in points); infinite for what the machine decides, such as times.
    """

    where: str
    statement: str
    reference: str
    ours: str
    why: str = ""
    tolerance: float = 0.01


@dataclass
class Part:
    """Rows and pictures of one part, and what they were made with.

    ``pictures`` lists (file name, caption); ``text`` says how the numbers were obtained.
    """

    text: str
    rows: list[Row] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class Setting:
    """What a part is made with.

    Attributes
    ----------
    folder
        Where pictures go.
    quick
        Whether to use the coarsest grids and fewest cases that run at all.
    data
        Folder of third-party data, or None.
    tell
        Called with the share of the part that is done and what comes next.
    threads
        Number of threads, None for all.
    references
        Folder of what independent codes found, ``tests/data/references`` of the repository, or
        None.
    """

    folder: Path
    quick: bool
    data: Path | None
    tell: Callable[[float, str], None]
    threads: int | None = None
    references: Path | None = None

    def third_party(self, name: str) -> Path:
        """Path of a file of the third-party data.

        Raises
        ------
        InputError
            If it is not there.
        """
        path = (self.data or Path()) / name
        if self.data is None or not path.exists():
            raise InputError(f"{path}: the third-party data are not there (--data)")
        return path


def run_part(name: str, make: Callable[[Setting], Part], setting: Setting) -> None:
    """Make a part and keep it as ``NAME.json`` in the folder."""
    started = time.monotonic()
    part = make(setting)
    record = asdict(part) | {
        "software_version": software_version(),
        "quick": setting.quick,
        "seconds": round(time.monotonic() - started, 1),
        "processors": psutil.cpu_count(logical=True),
        "processor": platform.machine(),
    }
    with replacing(setting.folder / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def load_part(name: str, folder: Path) -> dict | None:
    """Return the record of a part, or None if there is none or a picture of it is missing."""
    try:
        record = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        whole = all((folder / file).is_file() for file, _ in record["pictures"])
        return record if whole and "rows" in record else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
