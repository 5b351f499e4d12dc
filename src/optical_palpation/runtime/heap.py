"""Memory that the C library keeps after arrays are freed."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache


@cache
def _trim() -> Callable[[int], int] | None:
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it, musl has not


def give_back() -> None:
    """Give freed memory back to the system.

    glibc keeps that of arrays of up to 32 MB for the next ones, a sixth of all that a solution on
    10^6 elements takes. Other C libraries are left alone.
    """
    trim = _trim()
    if trim is not None:
        trim(0)
