"""The result folder and its record: what was made of what, and what is still valid.

Every stage makes one file. The record, ``provenance.json``, names a file only after it is complete,
with its hash and with a key, the hash of all that the file depends on. Files are replaced and never
written in place, so that the folder can be left at any moment and taken up again.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from optical_palpation.errors import ConvergenceError, InputError, OutputError
from optical_palpation.files import replacing

RECORD = "provenance.json"
_PACKAGES = ("optical-palpation", "numpy", "scipy", "numba", "xarray", "h5py", "scikit-image")


@dataclass(frozen=True)
class Progress:
    """What a running study reports: the stage, and the share of it that is done (0 to 1)."""

    stage: str
    load: float
    newton: int | None = None
    message: str = ""


Tell = Callable[[Any], None]
Make = Callable[[Path, Tell], None]


@dataclass(frozen=True)
class Stage:
    """A file of the result folder and how it is made.

    Attributes
    ----------
    file
        Its name.
    facts
        Parameters and hashes of inputs on which its content depends, as JSON takes them.
    needs
        Files of earlier stages that it is made from.
    make
        Called with the path and a function to tell the progress to.
    """

    file: str
    facts: Mapping[str, object]
    needs: Sequence[str]
    make: Make


def make_all(
    folder: Path,
    study: str,
    about: Mapping[str, object],
    stages: Sequence[Stage],
    tell: Tell,
    until: str | None = None,
) -> tuple[list[str], list[str]]:
    """Make the files that are not there yet, and remove those that are no longer true.

    Parameters
    ----------
    folder
        Result folder; made if need be.
    study
        Name of the study file that the folder belongs to.
    about
        What the record says beyond the stages.
    stages
        In an order in which they can be made.
    tell
        Called with a :class:`Progress` now and then.
    until
        Last file to make; all of them by default.

    Returns
    -------
    list of str
        Files that are there now.
    list of str
        Those of them that were there already.

    Raises
    ------
    OutputError
        If the folder cannot be made or holds something else.
    """
    known = _open(folder, study)
    keys: dict[str, str] = {}
    for stage in stages:
        parts = [version("optical-palpation"), stage.file, stage.facts]
        text = json.dumps([*parts, [keys[file] for file in stage.needs]], sort_keys=True)
        keys[stage.file] = hashlib.sha256(text.encode()).hexdigest()
    done = {
        file: known[file]
        for file in keys
        if file in known
        and known[file].get("key") == keys[file]
        and (folder / file).is_file()
        and known[file].get("sha256") == sha256(folder / file)
    }
    record = {
        "software": "optical-palpation",
        "study": study,
        "complete": False,
        **about,
        "versions": {"python": platform.python_version()} | {p: version(p) for p in _PACKAGES},
        "platform": platform.platform(),
        "stages": done,
    }
    # First the record forgets them, then they go: no file is ever valid by a key of another.
    earlier = list(done)
    _write(folder, record)
    for file in (known.keys() | keys.keys()) - done.keys():
        (folder / file).unlink(missing_ok=True)
    _remove_leftovers(folder)
    for stage in stages[: 1 + list(keys).index(until) if until else None]:
        if stage.file in done:
            continue
        started = time.monotonic()
        try:
            stage.make(folder / stage.file, tell)
        except (InputError, ConvergenceError) as error:
            raise type(error)(f"{study}: {error}") from error
        done[stage.file] = {
            "key": keys[stage.file],
            "sha256": sha256(folder / stage.file),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - started, 2),
        }
        _write(folder, record)
    record["complete"] = done.keys() == keys.keys()
    _write(folder, record)
    return [file for file in keys if file in done], earlier


def sha256(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _open(folder: Path, study: str) -> dict[str, Any]:
    """Make the folder, or return what its record knows about the files in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        visible = [path.name for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{folder}: the result folder cannot be made ({reason}); choose another in [outputs]"
        ) from error
    if not visible:
        return {}
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        owner = record["study"]
        stages = {file: dict(entry) for file, entry in record["stages"].items()}
        if any(Path(file).name != file for file in stages):
            raise ValueError("a name that is no file of this folder")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise OutputError(
            f"{folder}: holds files but no record ({RECORD}) of a study; empty it, or choose "
            "another folder in [outputs]"
        ) from error
    if owner != study:
        raise OutputError(
            f"{folder}: holds the results of another study, {owner}; choose another folder in "
            "[outputs]"
        )
    return stages


def _write(folder: Path, record: Mapping[str, object]) -> None:
    with replacing(folder / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of runs that were killed."""
    for path in folder.glob(".*"):
        process = re.fullmatch(r"\..+\.(\d+)(\.\w+)?", path.name)
        if process and not psutil.pid_exists(int(process[1])):
            path.unlink(missing_ok=True)
