"""Running a batch: scans go to idle workers one by one, and their rows come back."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optical_palpation.batch.cluster import (
    About,
    Workers,
    about_worker,
    checked,
    connected,
    threads_of,
)
from optical_palpation.batch.reading import Batch, Scan
from optical_palpation.batch.scan import Outcome, predicted_need, run_scan
from optical_palpation.errors import InputError

if TYPE_CHECKING:
    from distributed import Future

#: A scan whose workers were lost so often is given up: it may be what ends them.
_LOSSES = 3
_POLL = 0.5  # s
_REPORT = 1.0  # s between reports of a running scan


@dataclass(frozen=True)
class BatchProgress:
    """What a running batch reports.

    Attributes
    ----------
    total, done, earlier, failed
        Numbers of scans; `done` counts those of `earlier` runs, and not the failed ones.
    running
        Stage and share of it that is done, by the name of each scan under way.
    workers
        Number of workers.
    seconds_left
        Estimate, or None before there is one.
    finished
        The scan whose end is reported, if any.
    message
        Something to tell, such as a lost worker.
    """

    total: int
    done: int
    earlier: int
    failed: int
    running: dict[str, tuple[str, float]]
    workers: int
    seconds_left: float | None
    finished: Outcome | None = None
    message: str = ""


@dataclass(frozen=True)
class BatchResult:
    """What became of the scans of a batch, in its order, and where the tables are.

    Attributes
    ----------
    folder
        Folder of the results.
    outcomes
        Of the scans that were finished or failed.
    files
        Tables and index.
    """

    folder: Path
    outcomes: tuple[Outcome, ...]
    files: tuple[Path, ...]

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """The scans that failed."""
        return tuple(outcome for outcome in self.outcomes if outcome.status == "failed")


def run_batch(
    batch: Batch,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[BatchProgress], None] | None = None,
) -> BatchResult:
    """Run the scans of a batch on Dask.

    What an earlier run has done is not done again. A scan that fails is reported in the table and
    harms no other. A scan whose worker is lost is done again on another. Each worker computes one
    scan at a time, with its share of the cores.

    Parameters
    ----------
    batch
        As :func:`read_batch` gives it.
    scheduler
        Address of a Dask scheduler (``tcp://host:8786``) or path of its scheduler file; all its
        workers must see the files by the same paths. By default workers are started on this
        machine, as many as cores and predicted memory allow.
    workers
        Number of workers to start on this machine.
    progress
        Called with a :class:`BatchProgress` now and then.

    Raises
    ------
    InputError
        If Dask is missing, the scheduler cannot be reached, or a worker has another version.
    OutputError
        If the folder of the results cannot be made or written.
    """
    from optical_palpation.batch.index import write_index
    from optical_palpation.batch.table import check_folder, write_tables

    if workers is not None and (workers < 1 or scheduler is not None):
        raise InputError(
            f"workers = {workers}: must be at least 1, and is for workers on this machine alone"
        )
    check_folder(batch.folder)
    # Workers of a cluster have working directories of their own.
    scans = [
        Scan(s.name, s.study.resolve(), s.overrides, s.regions and s.regions.resolve())
        for s in batch.scans
    ]
    folder = batch.folder.resolve()
    needs = {scan.name: predicted_need(scan) for scan in scans}
    outcomes: dict[str, Outcome] = {}
    try:
        with connected(scheduler, workers, list(needs.values())) as crew:
            _Dispatcher(crew, folder, scans, needs, outcomes, progress or (lambda _: None)).run()
    finally:  # an interrupted batch leaves tables of what it has
        ordered = [outcomes[scan.name] for scan in scans if scan.name in outcomes]
        files = write_tables(batch, ordered)
        files.append(write_index(batch, ordered))
    return BatchResult(batch.folder, tuple(ordered), tuple(files))


@dataclass
class _Dispatcher:
    """Gives each idle worker a scan, and takes back the scans of workers that are lost.

    Which worker gets a scan is decided here and not by the scheduler, because a worker computes
    one scan at a time with all of its threads, whatever number of tasks it would take.
    """

    crew: Workers
    folder: Path
    scans: list[Scan]
    needs: dict[str, float | None]
    outcomes: dict[str, Outcome]
    tell: Callable[[BatchProgress], None]
    known: dict[str, About] = field(default_factory=dict)
    running: dict[str, tuple[Scan, str, Future]] = field(default_factory=dict)
    stages: dict[str, tuple[str, float]] = field(default_factory=dict)
    losses: Counter[str] = field(default_factory=Counter)
    started: float = field(default_factory=time.monotonic)

    def run(self) -> None:
        client = self.crew.client
        # Those that need most first: the last ones to end are then short.
        waiting = deque(sorted(self.scans, key=lambda scan: -(self.needs[scan.name] or 0.0)))
        topic = f"optical-palpation-{os.urandom(6).hex()}"
        client.subscribe_topic(topic, self._hear)
        self._report()
        idle_since = time.monotonic()
        try:
            while waiting or self.running:
                present = self._workers()
                if present:
                    idle_since = time.monotonic()
                elif time.monotonic() > idle_since + 10:
                    idle_since = time.monotonic()
                    self._report(message="waiting for workers: the scheduler has none")
                for name in self._lost(present):
                    scan = self.running.pop(name)[0]
                    self.stages.pop(name, None)
                    self.losses[name] += 1
                    if self.losses[name] < _LOSSES:
                        waiting.append(scan)
                        self._report(message=f"{name}: its worker was lost; it is done again")
                    else:
                        self._finish(Outcome(name, "failed", self._why_lost(name)))
                busy = {address for _, address, _ in self.running.values()}
                for address in present:
                    if waiting and address not in busy and self._fits(waiting[0]):
                        self._submit(waiting.popleft(), address, topic)
                self._collect()
        finally:
            client.cancel([future for _, _, future in self.running.values()], force=True)
            client.unsubscribe_topic(topic)

    def _workers(self) -> list[str]:
        """Addresses of the workers that are there now; new ones are looked at first."""
        client = self.crew.client
        # Not client.scheduler_info, which other threads refresh with a few workers alone.
        scheduler: Any = client.scheduler
        identity: Any = client.sync(scheduler.identity, n_workers=-1)
        present = list(identity["workers"])
        for address in self.known.keys() - set(present):
            del self.known[address]
        new = [address for address in present if address not in self.known]
        if new:
            told = client.run(about_worker, workers=new, on_error="return")
            for address, about in told.items():
                if isinstance(about, OSError):  # lost again already
                    continue
                self.known[address] = checked(address, about)
        return [address for address in present if address in self.known]

    def _lost(self, present: list[str]) -> list[str]:
        return [
            name
            for name, (_, address, future) in self.running.items()
            if (address not in present and not future.done())
            or future.status in ("lost", "cancelled")
        ]

    def _why_lost(self, name: str) -> str:
        need = self.needs[name]
        known = f" Its stress needs about {need / 1e9:.1f} GB." if need else ""
        return (
            f"its worker was lost {_LOSSES} times (killed, out of memory, or the machine went "
            f"away), so it is not tried again.{known} Run the batch again to try once more"
        )

    def _fits(self, scan: Scan) -> bool:
        """Whether the memory of this machine bears one more scan."""
        if self.crew.memory is None or not self.running:
            return True
        names = [scan.name, *self.running]
        taken = sum(self.crew.process + (self.needs[name] or 0.0) for name in names)
        return taken <= self.crew.memory

    def _submit(self, scan: Scan, address: str, topic: str) -> None:
        future = self.crew.client.submit(
            _work,
            scan,
            self.folder,
            threads_of(address, self.known),
            topic,
            key=f"{scan.name}-{topic}-{self.losses[scan.name]}",
            workers=[address],
            allow_other_workers=False,
            pure=False,
        )
        self.running[scan.name] = (scan, address, future)
        self.stages[scan.name] = ("starting", 0.0)

    def _collect(self) -> None:
        """Wait a moment for scans to end, and take what they return."""
        from distributed import wait

        if not self.running:
            time.sleep(_POLL)
            return
        futures = [future for _, _, future in self.running.values()]
        try:
            wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
        except TimeoutError:
            self._report()
        for name, (_, _, future) in list(self.running.items()):
            if future.status == "finished":
                outcome = future.result()
            elif future.status == "error":
                error = future.exception()
                outcome = Outcome(name, "failed", f"{type(error).__name__}: {error}")
            else:
                continue
            del self.running[name]
            self._finish(outcome)

    def _finish(self, outcome: Outcome) -> None:
        self.stages.pop(outcome.name, None)
        self.outcomes[outcome.name] = outcome
        self._report(finished=outcome)

    def _hear(self, event: Any) -> None:
        """Take a report of a running scan; called in another thread."""
        _, (name, stage, load) = event
        if name in self.stages:
            self.stages[name] = (stage, float(load))

    def _report(self, finished: Outcome | None = None, message: str = "") -> None:
        status = Counter(outcome.status for outcome in self.outcomes.values())
        computed = status["done"] + status["failed"]
        left = None
        if computed >= max(1, min(4, len(self.known))):
            elapsed = time.monotonic() - self.started
            left = elapsed / computed * (len(self.scans) - len(self.outcomes))
        self.tell(
            BatchProgress(
                total=len(self.scans),
                done=status["done"] + status["earlier"],
                earlier=status["earlier"],
                failed=status["failed"],
                running=dict(self.stages),
                workers=len(self.known),
                seconds_left=left,
                finished=finished,
                message=message,
            )
        )


class _Cancelled(BaseException):
    """Nobody waits for this scan any longer."""


def _work(scan: Scan, folder: Path, threads: int, topic: str) -> Outcome:
    """Run a scan in a worker, and report on it."""
    import dask
    from distributed import get_worker
    from distributed.core import Status

    worker = get_worker()
    key = worker.get_current_task()
    last = -_REPORT

    def tell(report: Any) -> None:
        nonlocal last
        now = time.monotonic()
        if now < last + _REPORT:
            return
        last = now
        task = worker.state.tasks.get(key)
        if task is None or task.state == "cancelled" or worker.status != Status.running:
            raise _Cancelled
        worker.log_event(topic, (scan.name, report.stage, float(report.load)))

    try:
        # xarray would write through locks of the cluster, which a file in memory cannot have.
        with dask.config.set(scheduler="synchronous"):
            return run_scan(scan, folder, threads, tell)
    except _Cancelled:
        return Outcome(scan.name, "failed", "cancelled")
