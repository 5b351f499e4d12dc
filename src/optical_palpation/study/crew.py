"""Several processes that solve what arrives in a watched folder, one file each at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Self

from optical_palpation.errors import InputError
from optical_palpation.runtime.interrupts import interrupts_for_this_process
from optical_palpation.study.watch import Arrival, Watch

#: How often a file is begun whose process dies.
_ATTEMPTS = 2

#: What a worker watches; only its process sets this.
_watch: Watch


def _begin(watch: Watch) -> None:
    global _watch
    _watch = watch
    watch.warm_up()


def _solve(path: Path) -> Arrival:
    return _watch.solve(path)


def _nothing() -> None:
    """What each worker does first."""


class Crew:
    """Solves files that have arrived: one after another here, or side by side in processes.

    To be used in a ``with`` block, whose end ends the processes; Ctrl-C does so at once.

    Parameters
    ----------
    watch
        Prepared.
    workers
        Number of processes, which share the cores; with one, this process does it.
    """

    def __init__(self, watch: Watch, workers: int = 1) -> None:
        self._watch, self._workers = watch, workers
        self._here: list[Arrival] = []
        self._pool: ProcessPoolExecutor | None = None
        self._under_way: dict[Future[Arrival], Path] = {}
        self._begun: Counter[Path] = Counter()

    def __enter__(self) -> Self:
        """Start the processes and wait until one is ready.

        Raises
        ------
        InputError
            If they do not start.
        """
        if self._workers > 1:
            self._watch.share_cores(self._workers)
            try:
                self._start().result()
            except BrokenProcessPool as error:
                raise InputError(
                    f"{self._workers} workers could not be started. A script must call this below "
                    "if __name__ == '__main__': because each of them imports it first"
                ) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the processes."""
        if self._pool is None:
            return
        if kind is not None:  # results are written whole or not at all
            for child in self._children:
                child.terminate()
        self._pool.shutdown(cancel_futures=True)

    @property
    def busy(self) -> bool:
        """Whether there is something to come."""
        return bool(self._under_way or self._here)

    def solve(self, path: Path) -> None:
        """Solve a file, or begin to."""
        if self._pool is None:
            self._here.append(self._watch.solve(path))
            return
        self._watch.take(path)
        self._begun[path] += 1
        try:
            future = self._pool.submit(_solve, path)
        except BrokenProcessPool:  # one died that had nothing to do
            self._start()
            future = self._pool.submit(_solve, path)
        self._under_way[future] = path

    def solved(self) -> Iterator[Arrival]:
        """Go through what has been solved since the last time.

        Raises
        ------
        OutputError
            If a result or the table cannot be written.
        """
        while self._here:
            yield self._here.pop(0)
        lost: list[Path] = []
        while futures := [future for future in self._under_way if lost or future.done()]:
            for future in futures:  # a process that died is the end of all of them
                path = self._under_way.pop(future)
                try:
                    arrival = future.result()
                except BrokenProcessPool:
                    lost.append(path)
                else:
                    del self._begun[path]
                    yield arrival
        if lost:
            self._start()
        for path in lost:
            if self._begun[path] < _ATTEMPTS:
                self.solve(path)
                continue
            del self._begun[path]
            yield self._watch.give_up(
                path,
                "the process that solved it died twice, perhaps for lack of memory: use larger "
                "elements or fewer workers",
            )

    def _start(self) -> Future[None]:
        """Start the processes; what is returned is there when one is ready."""
        before = set(active_children())
        self._pool = ProcessPoolExecutor(
            self._workers, get_context("spawn"), initializer=_begin, initargs=(self._watch,)
        )
        with interrupts_for_this_process():
            ready = self._pool.submit(_nothing)
        self._children = set(active_children()) - before
        return ready
