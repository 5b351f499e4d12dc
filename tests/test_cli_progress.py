"""What a user sees while a computation runs."""

import io
from types import SimpleNamespace

from rich.console import Console

from optical_palpation.cli.progress import ProgressDisplay


def show(reports, **console):
    stream = io.StringIO()
    with ProgressDisplay(console=Console(file=stream, width=120, **console)) as display:
        for stage, load, newton in reports:
            display(SimpleNamespace(stage=stage, load=load, newton=newton, message=""))
    return stream.getvalue()


REPORTS = [
    ("compiling kernels, once per machine", 0.0, 0),
    *(("loading", k / 200, k) for k in range(201)),
]


def test_a_log_gets_a_line_per_stage_and_per_tenth_of_the_load():
    lines = show(REPORTS, force_terminal=False).splitlines()
    assert lines[0].startswith("compiling kernels, once per machine")
    assert 11 <= len(lines) <= 14
    assert "load 100%, 200 Newton iterations" in lines[-1]
    assert "s left for this stage" in lines[5]
    assert "left" not in lines[0]


def test_the_time_left_is_that_of_the_stage():
    """A finer grid starts at the load that the coarse one has reached: no time went into that."""
    lines = show([("coarse", 0.0, 0), ("coarse", 0.5, 5), ("fine", 0.8, 6)], force_terminal=False)
    assert "left" in lines.splitlines()[1]
    assert "left" not in lines.splitlines()[2]


def test_a_terminal_gets_one_line_that_is_kept_up_to_date():
    text = show(REPORTS, force_terminal=True)
    assert "100%" in text
    assert "200 Newton iterations" in text
    assert text.count("\n") <= 2


def test_quiet_says_nothing():
    stream = io.StringIO()
    console = Console(file=stream, quiet=True)
    with ProgressDisplay(quiet=True, console=console) as display:
        display(SimpleNamespace(stage="loading", load=0.5, newton=3, message=""))
    assert stream.getvalue() == ""
