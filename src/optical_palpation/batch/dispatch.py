"""Jobs go to idle workers one by one; those of lost workers are done again on others."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from optical_palpation.batch.cluster import About, Workers, about_worker, checked, threads_of

if TYPE_CHECKING:
    from distributed import Future

#: A job whose workers were lost so often is given up: it may be what ends them.
LOSSES = 3
_POLL = 0.5  # s
_REPORT = 1.0  # s between reports of a running job


@dataclass(frozen=True)
class Outcome:
    """What became of a job: a scan of a batch, or a tile of a field.

    Attributes
    ----------
    name
        Of the job.
    status
        ``done``, ``earlier`` (an earlier run had done it all) or ``failed``.
    message
        Why it failed; else what is worth telling, if anything.
    error
        Name of the class of the error that it failed with.
    row
        Entries of a scan in the table, by column.
    thumbnail
        Small map of the axial stress of a scan, kPa, or None.
    seconds
        How long it took this time.
    """

    name: str
    status: str
    message: str = ""
    error: str = ""
    row: dict[str, Any] = field(default_factory=dict)
    thumbnail: NDArray[np.float32] | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class BatchProgress:
    """What running jobs report.

    Attributes
    ----------
    total, done, earlier, failed
        Numbers of jobs; `done` counts those of `earlier` runs, and not the failed ones.
    running
        Stage and share of it that is done, by the name of each job under way.
    workers
        Number of workers.
    seconds_left
        Estimate, or None before there is one.
    finished
        The job whose end is reported, if any.
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


#: Does a job on some threads.
Work = Callable[[Any, int, Callable[[Any], None]], Outcome]


@dataclass
class Dispatcher:
    """Gives each idle worker a job, and takes back the jobs of workers that are lost.

    Which worker gets a job is decided here and not by the scheduler, because a worker computes
    one job at a time with all of its threads, whatever number of tasks it would take.

    Attributes
    ----------
    crew
        The workers.
    work
        Does a job: takes it, a number of threads and what to call with reports of progress.
    jobs
        What there is to do, by name.
    needs
        Predicted memory of each, bytes, where it is known.
    outcomes
        What has become of each so far.
    tell
        Called with a :class:`BatchProgress` now and then.
    """

    crew: Workers
    work: Work
    jobs: Mapping[str, Any]
    needs: Mapping[str, float | None]
    outcomes: dict[str, Outcome]
    tell: Callable[[BatchProgress], None]
    known: dict[str, About] = field(default_factory=dict)
    running: dict[str, tuple[str, Future]] = field(default_factory=dict)
    stages: dict[str, tuple[str, float]] = field(default_factory=dict)
    losses: Counter[str] = field(default_factory=Counter)
    started: float = field(default_factory=time.monotonic)

    def run(self) -> None:
        """Do all jobs; what fails or is given up is told in the outcomes."""
        client = self.crew.client
        # Those that need most first: the last ones to end are then short.
        waiting = deque(sorted(self.jobs, key=lambda name: -(self.needs[name] or 0.0)))
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
                    del self.running[name]
                    self.stages.pop(name, None)
                    self.losses[name] += 1
                    if self.losses[name] < LOSSES:
                        waiting.append(name)
                        self._report(message=f"{name}: its worker was lost; it is done again")
                    else:
                        self._finish(Outcome(name, "failed", self._why_lost(name)))
                busy = {address for address, _ in self.running.values()}
                for address in present:
                    if waiting and address not in busy and self._fits(waiting[0]):
                        self._submit(waiting.popleft(), address, topic)
                self._collect()
        finally:
            client.cancel([future for _, future in self.running.values()], force=True)
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
            for name, (address, future) in self.running.items()
            if (address not in present and not future.done())
            or future.status in ("lost", "cancelled")
        ]

    def _why_lost(self, name: str) -> str:
        need = self.needs[name]
        known = f" It needs about {need / 1e9:.1f} GB." if need else ""
        return (
            f"its worker was lost {LOSSES} times (killed, out of memory, or the machine went "
            f"away), so it is not tried again.{known} The same command tries once more"
        )

    def _fits(self, name: str) -> bool:
        """Whether the memory of this machine bears one more job."""
        if self.crew.memory is None or not self.running:
            return True
        taken = sum(self.crew.process + (self.needs[n] or 0.0) for n in (name, *self.running))
        return taken <= self.crew.memory

    def _submit(self, name: str, address: str, topic: str) -> None:
        future = self.crew.client.submit(
            _work,
            self.work,
            name,
            self.jobs[name],
            threads_of(address, self.known),
            topic,
            key=f"{name}-{topic}-{self.losses[name]}",
            workers=[address],
            allow_other_workers=False,
            pure=False,
        )
        self.running[name] = (address, future)
        self.stages[name] = ("starting", 0.0)

    def _collect(self) -> None:
        """Wait a moment for jobs to end, and take what they return."""
        from distributed import wait

        if not self.running:
            time.sleep(_POLL)
            return
        futures = [future for _, future in self.running.values()]
        try:
            wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
        except TimeoutError:
            self._report()
        for name, (_, future) in list(self.running.items()):
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
        """Take a report of a running job; called in another thread."""
        _, (name, stage, load) = event
        if name in self.stages:
            self.stages[name] = (stage, float(load))

    def _report(self, finished: Outcome | None = None, message: str = "") -> None:
        status = Counter(outcome.status for outcome in self.outcomes.values())
        computed = status["done"] + status["failed"]
        left = None
        if computed >= max(1, min(4, len(self.known))):
            elapsed = time.monotonic() - self.started
            left = elapsed / computed * (len(self.jobs) - len(self.outcomes))
        self.tell(
            BatchProgress(
                total=len(self.jobs),
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
    """Nobody waits for this job any longer."""


def _work(work: Work, name: str, job: Any, threads: int, topic: str) -> Outcome:
    """Do a job in a worker, and report on it."""
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
        worker.log_event(topic, (name, report.stage, float(report.load)))

    try:
        # xarray would write through locks of the cluster, which a file in memory cannot have.
        with dask.config.set(scheduler="synchronous"):
            return work(job, threads, tell)
    except _Cancelled:
        return Outcome(name, "failed", "cancelled")
