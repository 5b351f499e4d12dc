"""``optical-palpation batch``: many studies at once."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import MofNCompleteColumn

from optical_palpation.cli.options import Quiet, Scheduler, Workers
from optical_palpation.cli.progress import Display

if TYPE_CHECKING:
    from optical_palpation.batch import BatchProgress

_SILENCE = 10.0  # s


def batch(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE",
            help="CSV or TOML table of studies and what differs from them, or a folder of studies.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Folder of the results.  [default: named after TABLE, beside it]",
        ),
    ] = None,
    regions: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Regions of interest for all scans (ImageJ, napari, CSV or a mask).",
        ),
    ] = None,
    scheduler: Scheduler = None,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Run many studies at once, here or on a Dask cluster; one table and one page of all.

    Continues where an earlier run was interrupted. Exit status 1: some scans failed; the table says
    which and why.
    """
    from optical_palpation.batch import read_batch, run_batch

    asked = read_batch(source, output, regions)
    with BatchDisplay(quiet) as display:
        done = run_batch(asked, scheduler=scheduler, workers=workers, progress=display)
    if not quiet:
        earlier = sum(outcome.status == "earlier" for outcome in done.outcomes)
        print(
            f"{len(done.outcomes) - len(done.failed)} of {len(asked.scans)} scans done"
            + (f", {earlier} of them by an earlier run" if earlier else "")
        )
        for path in done.files:
            print(path)
    for outcome in done.failed:
        print(f"failed: {outcome.name}: {outcome.message}", file=sys.stderr)
    if done.failed:
        raise typer.Exit(1)


class BatchDisplay(Display):
    """A bar on a terminal; elsewhere a line for each scan that ends, and every ten seconds."""

    def __init__(self, quiet: bool) -> None:
        super().__init__(quiet, None, MofNCompleteColumn())
        self._task = self._bar.add_task("starting workers", total=None, left="")
        self._last = time.monotonic()

    def __call__(self, report: BatchProgress) -> None:
        """Show one report."""
        ended = report.done + report.failed
        left = "" if report.seconds_left is None else f"about {_time(report.seconds_left)} left"
        failed = f", {report.failed} failed" if report.failed else ""
        self._bar.update(
            self._task,
            description=f"{report.workers} workers{failed}: {_under_way(report)}",
            completed=ended,
            total=report.total,
            left=left,
        )
        if report.message:
            self._console.print(report.message, markup=False, soft_wrap=True)
        if (outcome := report.finished) is not None and outcome.status == "failed":
            first = outcome.message.splitlines()[0] if outcome.message else ""
            self._console.print(f"{outcome.name}: failed: {first}", markup=False, soft_wrap=True)
        if self._console.is_terminal:
            return
        now = time.monotonic()
        if report.finished is None and now < self._last + _SILENCE:
            return
        self._last = now
        what = report.finished.name if report.finished else _under_way(report)
        line = f"{ended} of {report.total}{failed}: {what}" + (f", {left}" if left else "")
        self._console.print(line, markup=False, soft_wrap=True)


def _under_way(report: BatchProgress) -> str:
    shown = [
        f"{name} ({stage} {load:.0%})" for name, (stage, load) in list(report.running.items())[:2]
    ]
    more = len(report.running) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
