"""The result folder and its record: what was made of what, and what is still valid.

Every stage makes one file. The record, ``provenance.json``, names a file only after it is complete,
with its hash and with a key, the hash of all that the file depends on: the parameters, the inputs
and the source of the code that makes it. Files are replaced and never written in place, so that the
folder can be left at any moment and taken up again. One run works in a folder at a time: it holds a
lock that the system releases should the process die.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from optical_palpation.errors import ConvergenceError, FolderBusyError, InputError, OutputError
from optical_palpation.files import check_target, is_left_over_of, place_of, replacing
from optical_palpation.runtime import software_version, source_digest

RECORD = "provenance.json"
_LOCK = ".lock"
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
    code
        Parts of the package that make it, as :func:`source_digest` takes them.
    """

    file: str
    facts: Mapping[str, object]
    needs: Sequence[str]
    make: Make
    code: Sequence[str] = field(kw_only=True)


def make_all(
    folder: Path,
    study: Path,
    about: Mapping[str, object],
    stages: Sequence[Stage],
    tell: Tell,
    until: str | None = None,
    *,
    check_inputs: Callable[[], None] = lambda: None,
    beside: Sequence[Path] = (),
) -> tuple[list[str], list[str]]:
    """Make the files that are not there yet, and remove those that are no longer true.

    Parameters
    ----------
    folder
        Result folder; made if need be.
    study
        The study file that the folder belongs to.
    about
        What the record says beyond the stages.
    stages
        In an order in which they can be made.
    tell
        Called with a :class:`Progress` now and then.
    until
        Last file to make; all of them by default.
    check_inputs
        Called when a file is made and before it counts as done; raises if the inputs are no longer
        those that `about` and the stages tell of.
    beside
        Other result folders. A file that one of them holds with the same key is copied from there.

    Returns
    -------
    list of str
        Files that are there now.
    list of str
        Those of them that were there already.

    Raises
    ------
    OutputError
        If the folder cannot be made or holds something else, or another run works in it.
    """
    _open(folder, study)
    with _alone(folder):
        # what it holds may have changed before the lock was ours
        known = _open(folder, study)
        return _make_all(folder, study, about, stages, known, tell, until, check_inputs, beside)


def _make_all(
    folder: Path,
    study: Path,
    about: Mapping[str, object],
    stages: Sequence[Stage],
    known: Mapping[str, Any],
    tell: Tell,
    until: str | None,
    check_inputs: Callable[[], None],
    beside: Sequence[Path],
) -> tuple[list[str], list[str]]:
    keys: dict[str, str] = {}
    for stage in stages:
        parts = [source_digest(*stage.code), stage.file, stage.facts]
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
        "software_version": software_version(),
        "study": study.name,
        "study_file": place_of(study, folder),
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
    _remove_leftovers(folder, [RECORD, *known, *keys])
    for stage in stages[: 1 + list(keys).index(until) if until else None]:
        if stage.file in done:
            continue
        started = time.monotonic()
        origin = {}
        try:
            if source := _copied(folder / stage.file, keys[stage.file], beside):
                origin = {"copied_from": source.name}
            else:
                stage.make(folder / stage.file, tell)
            check_inputs()
        except (InputError, ConvergenceError):
            (folder / stage.file).unlink(missing_ok=True)
            raise
        done[stage.file] = {
            "key": keys[stage.file],
            "sha256": sha256(folder / stage.file),
            "software_version": software_version(),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - started, 2),
            **origin,
        }
        _write(folder, record)
    record["complete"] = done.keys() == keys.keys()
    _write(folder, record)
    return [file for file in keys if file in done], earlier


def _copied(path: Path, key: str, beside: Sequence[Path]) -> Path | None:
    """Copy a file from the first other folder that holds it whole; return that folder."""
    for folder in beside:
        try:
            record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            entry = record["stages"][path.name]
            if entry["key"] != key:
                continue
            with replacing(path) as temporary:
                shutil.copyfile(folder / path.name, temporary)
                if sha256(temporary) != entry["sha256"]:
                    raise ValueError("not the file that the record tells of")
        except (OSError, OutputError, ValueError, KeyError, TypeError):  # not there, or no longer
            continue
        return folder
    return None


def sha256(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_folder(folder: Path, study: Path) -> None:
    """Refuse a result folder that cannot be made, or holds something else than a study's results.

    Raises
    ------
    OutputError
        As :func:`make_all`.
    """
    try:
        if folder.exists():
            _open(folder, study)
            check_target(folder / RECORD)
            return
        there = next(path for path in folder.parents if os.path.lexists(path))
        with tempfile.TemporaryDirectory(dir=there) as trial:
            (Path(trial) / folder.relative_to(there)).mkdir(parents=True)
        if folder.is_symlink():
            raise FileExistsError("a link to nothing")
    except OSError as error:
        raise _not_made(folder, error) from error


def _not_made(folder: Path, error: OSError) -> OutputError:
    reason = error.strerror or error
    return OutputError(
        f"{folder}: the result folder cannot be made ({reason}); choose another in [outputs]"
    )


def _open(folder: Path, study: Path) -> dict[str, Any]:
    """Make the folder, or return what its record knows about the files in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        visible = [path.name for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise _not_made(folder, error) from error
    if not visible:
        return {}
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        owner, place = record["study"], record.get("study_file")
        stages = {file: dict(entry) for file, entry in record["stages"].items()}
        if any(Path(file).name != file for file in stages):
            raise ValueError("a name that is no file of this folder")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise OutputError(
            f"{folder}: holds files but no record ({RECORD}) of a study; empty it, or choose "
            "another folder in [outputs]"
        ) from error
    # records of earlier versions tell the name alone
    if owner != study.name or place not in (None, place_of(study, folder)):
        raise OutputError(
            f"{folder}: holds the results of another study, {owner}"
            + (f" ({place})" if place else "")
            + "; choose another folder in [outputs]"
        )
    return stages


def _write(folder: Path, record: Mapping[str, object]) -> None:
    with replacing(folder / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def _remove_leftovers(folder: Path, files: Sequence[str]) -> None:
    """Remove what runs that were killed had begun to write of these files, and nothing else."""
    for path in folder.glob(".*"):
        if any(is_left_over_of(path.name, file) for file in files):
            path.unlink(missing_ok=True)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder's lock."""
    lock = FileLock(folder / _LOCK, blocking=False, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise FolderBusyError(
            f"{folder}: another run works in this folder; wait until it has finished, or choose "
            "another folder in [outputs]"
        ) from None
    except (OSError, NotImplementedError) as error:
        raise OutputError(
            f"{folder}: cannot be locked against other runs ({error}); choose another folder in "
            "[outputs]"
        ) from error
    try:
        yield
    finally:
        lock.release()
