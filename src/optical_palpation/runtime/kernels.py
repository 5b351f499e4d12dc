"""Where compiled kernels are kept, and when they may be used again.

Numba keeps what it has compiled beside the source and takes it up again if the file of the function
is the same. Here all files count from which the function may call something, what is kept is
checked before it is run, and where nothing can be kept kernels are compiled in every process.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba.core.caching

from optical_palpation.runtime.environment import public_numba
from optical_palpation.runtime.source import PACKAGE, modules_digest, source_digest

# Mostly private to numba: keep_kernels alone leans on it.
caching: Any = numba.core.caching
_MARK = "optical-palpation"


class KernelLocator(caching._CacheLocator):
    """Finds the folder for the kernels of a module of this package, as numba asks for it."""

    def __init__(self, folder: str, file: Path, line: int) -> None:
        self._folder, self._py_file, self._line = folder, file, line

    def get_cache_path(self) -> str:
        """Return the folder."""
        return self._folder

    def get_source_stamp(self) -> tuple[str, str]:
        """Return a digest of the module and of all modules of the package that it imports."""
        return _MARK, modules_digest(self._py_file)

    def get_disambiguator(self) -> str:
        """Tell functions of the same name apart."""
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelLocator | None:
        """Return the locator of a function of this package; of others, None."""
        file = Path(py_file)
        if not file.is_relative_to(PACKAGE):
            return None
        line = py_func.__code__.co_firstlineno
        config: Any = numba.config
        if config.CACHE_DIR:
            # not by where the package is installed: installations of the same sources share them
            folder = Path(config.CACHE_DIR) / f"{_MARK}-{modules_digest(file)[:16]}"
            shared = cls(str(folder), file, line)
            with suppress(OSError):
                shared.ensure_cache_path()
                return shared
        others = (c for c in caching.CacheImpl._locator_classes if c is not cls)
        found = next((f for c in others if (f := c.from_function(py_func, py_file))), None)
        return cls(found.get_cache_path() if found else _of_this_process(), file, line)


class CheckedFile(caching.IndexDataCacheFile):
    """Index and data of a function; of this package's functions, no damage there does any harm.

    Two processes that compile at the same time may take each other's file for their own, a disk
    may be full, and a file may be cut: what is kept says for which types it is, and has a digest.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep compiled code; where that is impossible, say so once."""
        if not self._is_ours():
            return super().save(key, data)
        try:
            super().save(key, (key, data))
        except OSError as error:
            _say_not_kept(self._cache_path, error.strerror or str(error))

    def load(self, key: Any) -> Any:
        """Return compiled code for these types, or None."""
        if not self._is_ours():
            return super().load(key)
        try:
            for_types, data = super().load(key) or (None, None)
        except Exception:  # whatever unpickling something damaged may raise
            return None
        return data if for_types == key else None

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:
            if not self._is_ours():
                raise
            return {}

    def _save_data(self, name: str, data: Any) -> None:
        if not self._is_ours():
            return super()._save_data(name, data)
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as stream:
            stream.write(hashlib.sha256(content).digest() + content)

    def _load_data(self, name: str) -> Any:
        if not self._is_ours():
            return super()._load_data(name)
        content = Path(self._data_path(name)).read_bytes()
        digest, content = content[:32], content[32:]
        return pickle.loads(content) if hashlib.sha256(content).digest() == digest else None

    def _is_ours(self) -> bool:
        return isinstance(self._source_stamp, tuple) and self._source_stamp[0] == _MARK


def keep_kernels() -> None:
    """Let numba keep this package's kernels in this way; call it before they are defined.

    Without numba's private parts they are kept as numba does it, in a folder of this state of the
    sources.
    """
    if public_numba():
        base = os.environ.get("NUMBA_CACHE_DIR") or Path.home() / ".cache" / "optical-palpation"
        state = source_digest("mechanics", "thickness", "volume")[:16]
        config: Any = numba.config
        config.CACHE_DIR = str(Path(base) / f"public-{state}")
        return
    if KernelLocator not in caching.CacheImpl._locator_classes:
        caching.CacheImpl._locator_classes.insert(0, KernelLocator)
        caching.IndexDataCacheFile = CheckedFile


@cache
def _of_this_process() -> str:
    """Name of a folder that goes with the process."""
    import atexit

    folder = tempfile.TemporaryDirectory(prefix="optical-palpation-kernels-")
    atexit.register(folder.cleanup)
    return folder.name


@cache
def _say_not_kept(folder: str, reason: str) -> None:
    warnings.warn(
        f"compiled kernels cannot be kept in {folder} ({reason}): the next run compiles them again."
        " Make room there, or name another folder in the environment variable NUMBA_CACHE_DIR",
        RuntimeWarning,
        stacklevel=1,
    )
