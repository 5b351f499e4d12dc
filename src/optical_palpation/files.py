"""Output files that are either whole or absent."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from optical_palpation.errors import OutputError


def check_target(path: str | os.PathLike[str]) -> None:
    """Raise :class:`OutputError` now if no file could be written there later.

    Raises
    ------
    OutputError
        Missing folder, a folder or device in the file's place, or no permission to write.
    """
    path = Path(path)
    try:
        folder = Path(os.path.realpath(path)).parent
        if not folder.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent}; create it first")
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is no regular file; choose another name")
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError("the file exists and is write-protected")
        # Asking for permissions is not enough: only an actual file shows that one can be made.
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OutputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"{path}: cannot be written ({reason}); choose another place") from error


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside the target, which replaces the target if all goes well.

    Write HDF5 to it by way of memory (:func:`netcdf`): the HDF5 library can crash on a disk that
    fills up under it.

    Raises
    ------
    OutputError
        The target cannot be written; it is then as it was before.
    """
    check_target(path)
    target = Path(os.path.realpath(path))  # a link stays a link
    temporary = _temporary(target)
    try:
        yield temporary
        _to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{path}: could not be written ({reason}); is the disk full or the folder protected?"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def netcdf(data: Any, **options: Any) -> bytes:
    """Return xarray's data as the content of a NetCDF file.

    Parameters
    ----------
    data
        Dataset or DataTree.
    options
        Of its ``to_netcdf``.
    """
    local: Any = nullcontext()
    if "distributed" in sys.modules:
        import dask

        # Beside a client xarray locks by way of the scheduler, which knows no buffer in memory.
        local = dask.config.set(scheduler="threads")
    with local:
        return bytes(data.to_netcdf(engine="h5netcdf", **options))


def is_left_over_of(name: str, target: str) -> bool:
    """Tell by its name whether a file is what an ended process had begun to write for a target."""
    whole = Path(target)
    pattern = (
        rf"\.{re.escape(whole.stem[:40])}\.\d+-[0-9a-f]{{8}}\.partial{re.escape(whole.suffix)}"
    )
    return re.fullmatch(pattern, name) is not None


def seen_from(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> str:
    """Path as seen from a folder; the whole of it where that is on another drive."""
    try:
        return os.path.relpath(path, folder)
    except ValueError:
        return str(Path(path).resolve())


def place_of(file: Path, folder: Path) -> str:
    """Where a file lies, seen from a folder, on any system: both may be moved together."""
    return Path(seen_from(folder.resolve(), file.resolve())).as_posix()


def readable_name(path: str | os.PathLike[str]) -> str:
    r"""Name of a file as text that any file can hold: bytes that are no UTF-8 become ``\xff``."""
    return os.fsencode(Path(path).name).decode("utf-8", "backslashreplace")


def _temporary(target: Path) -> Path:
    """A name that no other process or thread uses, nor a user; programs go by its ending."""
    token = os.urandom(4).hex()
    return target.with_name(f".{target.stem[:40]}.{os.getpid()}-{token}.partial{target.suffix}")


def _to_disk(path: Path) -> None:
    """Wait until the content has reached the disk: only then may it take the old one's place."""
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())
