"""How many threads a computation may use, and holding the kernels and libraries to it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from math import ceil

import numba as nb
from threadpoolctl import ThreadpoolController

from optical_palpation.palpation.memory import control_groups
from optical_palpation.parallel import is_fork, launch_threads

_ALONE = threading.RLock()


def available_threads() -> int:
    """Cores that this process may use, by its affinity and the quota of its control groups.

    One in a process that was forked from one with threads: these do not come along.
    """
    if is_fork():
        return 1
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    launched = nb.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    return max(1, ceil(min(count or 1, launched, _quota())))


@contextmanager
def limited_threads(threads: int | None = None) -> Iterator[int]:
    """Hold the kernels to ``threads``, at most all there are, and linear algebra libraries to one.

    After each product a library's own threads wait for the next one without sleeping, for
    milliseconds, on the cores that the kernels are about to use: all between products would take
    twice as long.

    One computation runs at a time, since the libraries know only one number of threads for the
    whole process; another thread of Python waits for it.
    Within another such context, at most those of the outer one.

    Yields
    ------
    int
        The number of threads.
    """
    launch_threads()
    with _ALONE:
        before = nb.get_num_threads()
        number = min(threads or available_threads(), available_threads(), before)
        nb.set_num_threads(number)
        try:
            with _libraries().limit(limits=1, user_api="blas"):
                yield number
        finally:
            nb.set_num_threads(before)


@cache
def _libraries() -> ThreadpoolController:
    """Return the libraries that are loaded; to find them takes milliseconds."""
    return ThreadpoolController()


def _quota() -> float:
    """Cores' worth of time that the control groups of the process grant it (Linux)."""
    quota = float("inf")
    for second, group in control_groups("cpu"):
        names = ["cpu.max"] if second else ["cpu.cfs_quota_us", "cpu.cfs_period_us"]
        try:
            granted, period = " ".join((group / name).read_text() for name in names).split()
            if int(granted) > 0:
                quota = min(quota, int(granted) / int(period))
        except (OSError, ValueError):  # no such group, or "max": no limit
            continue
    return quota
