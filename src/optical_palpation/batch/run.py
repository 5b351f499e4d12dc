"""Running a batch: its scans go to workers, and their rows come back."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from optical_palpation.batch.cluster import connected
from optical_palpation.batch.dispatch import BatchProgress, Dispatcher, Outcome
from optical_palpation.batch.reading import CSV, Batch, Scan
from optical_palpation.batch.scan import earlier_outcome, predicted_need, run_scan
from optical_palpation.errors import InputError, OutputError

#: Tables of a study that tell what was measured.
_INPUTS = ("loaded", "unloaded", "volumes")
#: Seconds after which the tables of a running batch are written again.
_EVERY = 60.0


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
        If the folder of the results cannot be made or written, or holds those of another batch.
    """
    from optical_palpation.batch.index import write_index
    from optical_palpation.batch.table import claim_folder, write_tables

    if workers is not None and (workers < 1 or scheduler is not None):
        raise InputError(
            f"workers = {workers}: must be at least 1, and is for workers on this machine alone"
        )
    claim_folder(batch)
    # Workers of a cluster have working directories of their own.
    scans = [
        replace(s, study=s.study.resolve(), regions=s.regions and s.regions.resolve())
        for s in batch.scans
    ]
    folder = batch.folder.resolve()
    needs = {scan.name: predicted_need(scan) for scan in scans}
    outcomes: dict[str, Outcome] = {}
    earlier: dict[str, Outcome | None] = {}
    last = time.monotonic()

    def write() -> list[Path]:
        # a scan that has not been reached keeps what an earlier run made of it
        for scan in scans:
            if scan.name not in outcomes and scan.name not in earlier:
                earlier[scan.name] = earlier_outcome(folder, scan)
        known = [outcomes.get(scan.name) or earlier[scan.name] for scan in scans]
        there = [outcome for outcome in known if outcome is not None]
        return [*write_tables(batch, there), write_index(batch, there)]

    def tell(report: BatchProgress) -> None:
        nonlocal last
        if report.finished and time.monotonic() > last + _EVERY:
            with suppress(OutputError):  # the end tells, if it is still so
                write()
            last = time.monotonic()
        if progress:
            progress(report)

    files: list[Path] = []
    try:
        with connected(scheduler, workers, list(needs.values())) as crew:
            work = partial(run_scan, folder, _alike(scans))
            jobs = {scan.name: scan for scan in scans}
            Dispatcher(crew, work, jobs, needs, outcomes, tell).run()
    finally:  # an interrupted batch leaves tables of what it has
        if outcomes or not (folder / CSV).exists():
            files = write()
    ordered = [outcomes[scan.name] for scan in scans if scan.name in outcomes]
    return BatchResult(batch.folder, tuple(ordered), tuple(files))


def _alike(scans: Sequence[Scan]) -> dict[str, list[str]]:
    """By the name of a scan, those of the others with the same study and the same inputs."""
    groups: dict[tuple[Path, str], list[str]] = {}
    member = {}
    for scan in scans:
        inputs = {k: v for k, v in scan.overrides.items() if k.split(".")[0] in _INPUTS}
        group = groups.setdefault((scan.study, repr(sorted(inputs.items()))), [])
        group.append(scan.name)
        member[scan.name] = group
    return {name: [other for other in group if other != name] for name, group in member.items()}
