"""Computations beside the event loop: one at a time, with progress, to be cancelled."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from napari.qt.threading import create_worker
from qtpy.QtCore import QObject, Signal

from optical_palpation.errors import OpticalPalpationError

Tell = Callable[[Any], None]
_INTERVAL = 0.05  # seconds between two reports that are shown


class Cancelled(Exception):
    """Raised in a computation by its own report of progress, once nobody wants it any more."""


class Background(QObject):
    """Runs computations in a thread, the next one after the last has ended.

    Kernels share their threads, so that two computations never run at the same time. One that is
    cancelled ends with its next report of progress.
    """

    #: Stage and the share of it that is done.
    progressed = Signal(str, float)
    #: Whether something runs.
    busy = Signal(bool)
    #: What was wrong with the last one, for the user to read.
    failed = Signal(str)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._cancel = threading.Event()
        self._running: Any = None
        self._waiting: tuple[Callable[[Tell], Any], Callable[[Any], None]] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether something runs or waits."""
        return self._running is not None

    def run(self, compute: Callable[[Tell], Any], then: Callable[[Any], None]) -> None:
        """Compute in the background, and hand the result on in the event loop.

        What runs is cancelled, and what waits forgotten: the last call counts.

        Parameters
        ----------
        compute
            Called with a function that takes reports of progress (``stage`` and ``load``).
        then
            Called with what it returns; not if it fails or is cancelled.
        """
        self._waiting = compute, then
        if self._running is None:
            self._next()
        else:
            self._cancel.set()

    def cancel(self) -> None:
        """End what runs and forget what waits."""
        self._waiting = None
        self._cancel.set()

    def _next(self) -> None:
        if self._waiting is None:
            self.busy.emit(False)
            return
        compute, then = self._waiting
        self._waiting = None
        self._cancel = cancel = threading.Event()
        last = 0.0

        def tell(report: Any) -> None:
            nonlocal last
            if cancel.is_set():
                raise Cancelled
            now = time.monotonic()
            if now >= last + _INTERVAL or report.load >= 1.0:
                last = now
                self.progressed.emit(report.stage, float(report.load))

        def work() -> tuple[bool, Any]:
            try:
                return True, compute(tell)
            except (Cancelled, OpticalPalpationError) as error:
                return False, error

        def ended(outcome: tuple[bool, Any]) -> None:
            self._running = None
            done, value = outcome
            try:
                if done and not cancel.is_set():
                    then(value)
                elif not done and not isinstance(value, Cancelled):
                    self.failed.emit(str(value))
            finally:
                self._next()

        def broke(error: Exception) -> None:  # a defect; napari shows it
            self._running = None
            self.failed.emit(f"{type(error).__name__}: {error}")
            self._next()

        self.busy.emit(True)
        worker: Any = create_worker(work)
        worker.returned.connect(ended)
        worker.errored.connect(broke)
        self._running = worker
        worker.start()
