"""Live progress of a computation: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from optical_palpation.palpation import Progress as OfStress
    from optical_palpation.study import Progress as OfStudy

    Report = OfStress | OfStudy

_LOAD_STEP = 0.1
# Of a stage; before that its first steps, which compile and read, say nothing about the rest.
_LOAD_KNOWN = 0.05
_SILENCE = 10.0
_KEPT = 0.5  # s that a stage must have taken for a line of its own


class Display:
    """A bar on a terminal and a console for lines; a context manager.

    Parameters
    ----------
    quiet
        Whether to show nothing.
    console
        Where; by default stderr.
    column
        How the bar says what is done.
    """

    def __init__(self, quiet: bool, console: Console | None, column: ProgressColumn) -> None:
        self._console = console or Console(stderr=True, quiet=quiet, highlight=False)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            column,
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._console,
            transient=True,
            disable=quiet or not self._console.is_terminal,
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()


class ProgressDisplay(Display):
    """Shows what it is called with; use as a context manager and pass as ``progress=``.

    On a terminal one line is kept up to date, and finished stages stay above it with the time that
    they took. Elsewhere (a log file, a pipe) a line is printed when the stage changes, at every
    tenth of the load, and at least every ten seconds of reports. Where kernels are compiled, as in
    the first run on a machine, it says so, for as long as it lasts.
    """

    def __init__(self, quiet: bool = False, console: Console | None = None) -> None:
        super().__init__(quiet, console, TextColumn("{task.fields[reached]}"))
        self._started = self._last_time = time.monotonic()
        self._last: tuple[str, float] = ("", -1.0)
        self._stage: tuple[str, float, float] = ("", 0.0, self._started)  # name, load, time
        # rich stops the clock of a task that has reached its total, and there are more stages
        self._task = self._bar.add_task("starting", total=1.0 + 1e-9, reached="", left="")
        self._said_compiling = False
        self._compiling = 0  # kernels, those that others call included
        self._description = ""
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        from numba.core import event

        count = self._count_compiling

        class Compiling(event.Listener):
            def on_start(self, event: object) -> None:
                count(1)

            def on_end(self, event: object) -> None:
                count(-1)

        self._stack.enter_context(event.install_listener("numba:compile", Compiling()))
        return super().__enter__()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        super().__exit__(kind, error, traceback)
        self._stack.close()
        if error is None:
            self._keep_stage()

    def _count_compiling(self, change: int) -> None:
        if not self._said_compiling:
            self._said_compiling = True
            self._console.print("compiling kernels, once per machine: up to two minutes")
        self._compiling += change
        self._describe()

    def _describe(self) -> None:
        note = f"{self._description}, compiling kernels".lstrip(", ")
        self._bar.update(self._task, description=note if self._compiling else self._description)

    def _keep_stage(self) -> None:
        """Leave a line on a terminal for a stage that has ended."""
        name, _, start = self._stage
        seconds = time.monotonic() - start
        if name and seconds >= _KEPT and self._console.is_terminal:
            self._console.print(f"{name}: {seconds:.1f} s", markup=False, highlight=False)

    def __call__(self, report: Report) -> None:
        """Show one report."""
        description = f"{report.stage}: {report.message}" if report.message else report.stage
        if report.stage != self._stage[0]:
            self._keep_stage()
            self._stage = (report.stage, report.load, time.monotonic())
        left = self._time_left(report)
        if self._console.is_terminal:
            self._description = description
            self._describe()
            self._bar.update(
                self._task,
                completed=report.load,
                reached=_reached(report).removesuffix(", "),
                left=left,
            )
            return
        now = time.monotonic()
        stage, load = self._last
        finished = report.load >= 1 > load
        if (
            report.stage == stage
            and report.load < load + _LOAD_STEP
            and not finished
            and now < self._last_time + _SILENCE
        ):
            return
        self._last, self._last_time = (report.stage, report.load), now
        self._console.print(
            f"{description}: {_reached(report)}{now - self._started:.0f} s"
            + (f", {left}" if left else ""),
            soft_wrap=True,
            markup=False,
        )

    def _time_left(self, report: Report) -> str:
        """Return the time left of this stage if load goes on growing as it has done in it."""
        now = time.monotonic()
        _, load, start = self._stage
        if report.load >= 1 or report.load - load < _LOAD_KNOWN:
            return ""
        seconds = (now - start) * (1 - report.load) / (report.load - load)
        text = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"about {text} left for this stage"


def _reached(report: Report) -> str:
    if report.newton is None:  # a stage without a load; a short one only tells that it begins
        return f"{report.load:.0%}, " if report.load else ""
    iterations = "iteration" if report.newton == 1 else "iterations"
    return f"load {report.load:.0%}, {report.newton} Newton {iterations}, "
