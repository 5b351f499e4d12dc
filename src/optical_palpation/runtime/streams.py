"""Standard output and error that can fail without taking a result with them."""

from __future__ import annotations

import io
import os
import select
import sys
from typing import Any


class Unfailing(io.RawIOBase):
    """Writes to a file descriptor; what it cannot write, to a closed pipe or full disk, is lost.

    Parameters
    ----------
    descriptor
        Number of the file; it is left open.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._failed = False

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the number of the file."""
        return self._descriptor

    def isatty(self) -> bool:
        """Tell whether it is a terminal."""
        return os.isatty(self._descriptor)

    def write(self, data: Any) -> int:
        """Write some of the data, or nothing any more once that has failed."""
        while not self._failed:
            try:
                return os.write(self._descriptor, data)
            except BlockingIOError:
                select.select([], [self._descriptor], [])
            except OSError:
                self._failed = True
        return len(data)


def take_over_streams() -> None:
    r"""Let standard output and error lose what they cannot write.

    Names of files that are no text in the encoding of the terminal are shown as ``\xff``. Streams
    that the parent has closed are opened on nothing: no other file may come to their numbers, to
    which libraries print.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        given = getattr(sys, name)
        raw = Unfailing(descriptor)
        stream = io.TextIOWrapper(
            io.BufferedWriter(raw),
            encoding=getattr(given, "encoding", None) or "utf-8",
            errors="backslashreplace",
            line_buffering=True,  # both in one file stand in the order in which they were said
        )
        setattr(sys, name, stream)
