"""Ctrl-C where one process has started others."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def interrupts_for_this_process() -> Iterator[None]:
    """Let Ctrl-C pass by the processes that are started here, and those that their starter adds.

    A terminal sends it to all of them, and workers would answer with a traceback each. The process
    that started them ends them. Threads and processes inherit the signals that are blocked; the
    resource tracker of multiprocessing unblocks this one as it starts, so it goes first.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
