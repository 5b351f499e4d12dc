"""What a user sees while a computation runs."""

import ctypes
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba import njit
from rich.console import Console

import optical_palpation
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


def test_a_terminal_keeps_finished_stages(monkeypatch):
    now = 100.0
    monkeypatch.setattr("optical_palpation.cli.progress.time.monotonic", lambda: now)
    stream = io.StringIO()
    console = Console(file=stream, width=120, force_terminal=True)
    with ProgressDisplay(console=console) as display:
        for stage, until in (("boundaries", 103.2), ("thickness", 103.3), ("800 elements", 105.0)):
            display(SimpleNamespace(stage=stage, load=0.0, newton=0, message=""))
            now = until
            display(SimpleNamespace(stage=stage, load=1.0, newton=0, message=""))
    text = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", stream.getvalue())
    kept = re.findall(r"([\w ]+: [\d.]+ s)$", text, re.M)
    assert kept == ["boundaries: 3.2 s", "800 elements: 1.7 s"]


def test_the_clock_goes_on_after_the_first_stage():
    stream = io.StringIO()
    console = Console(file=stream, width=120, force_terminal=True)
    with ProgressDisplay(console=console) as display:
        display(SimpleNamespace(stage="boundaries", load=1.0, newton=0, message=""))
        task = display._bar.tasks[0]
        assert task.finished_time is None
        assert not task.finished


def test_a_terminal_says_when_kernels_compile():
    stream = io.StringIO()
    console = Console(file=stream, width=120, force_terminal=True)
    with ProgressDisplay(console=console) as display:
        display(SimpleNamespace(stage="800 elements", load=0.1, newton=0, message=""))
        njit(lambda x: x + 1)(1.0)
        display._bar.refresh()
        during = stream.getvalue()
        display(SimpleNamespace(stage="800 elements", load=0.2, newton=0, message=""))
        display._bar.refresh()
        after = stream.getvalue()[len(during) :]
    assert "compiling kernels, once per machine" in during
    assert "compiling" not in after


def test_quiet_says_nothing():
    stream = io.StringIO()
    console = Console(file=stream, quiet=True)
    with ProgressDisplay(quiet=True, console=console) as display:
        display(SimpleNamespace(stage="loading", load=0.5, newton=3, message=""))
    assert stream.getvalue() == ""


COMPILE_OR_LOAD = """
import numpy as np
from optical_palpation.cli.progress import ProgressDisplay
with ProgressDisplay():
    from optical_palpation.mechanics.imprint import Imprint
    x = np.linspace(0.0, 1.0, 5)
    Imprint(x, x, np.ones((5, 5)), np.ones((5, 5))).evaluate(x, x, 1.0)
"""


def test_compilation_is_announced_once_per_machine(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "missing" / "cache")}
    said = [
        subprocess.run(
            [sys.executable, "-c", COMPILE_OR_LOAD],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stderr
        for _ in range(2)
    ]
    assert said[0].count("compiling kernels, once per machine") == 1
    assert said[1] == ""


@pytest.mark.skipif(sys.platform != "linux", reason="takes a privilege away as Linux does")
def test_kernels_work_where_no_compiled_ones_can_be_kept(tmp_path):
    """A package installed read-only, used by somebody without a home."""
    package = tmp_path / "optical_palpation"
    shutil.copytree(
        Path(optical_palpation.__file__).parent,
        package,
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    folders = [tmp_path, package, *package.glob("**/*/")]
    for folder in folders:
        folder.chmod(0o555)
    try:
        done = subprocess.run(
            [sys.executable, "-c", COMPILE_OR_LOAD],
            env={
                "PATH": os.environ["PATH"],
                "PYTHONPATH": str(tmp_path),
                "HOME": str(tmp_path / "home"),
                "NUMBA_CACHE_DIR": str(package / "cache"),
            },
            preexec_fn=bound_by_permissions,
            capture_output=True,
            text=True,
        )
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert done.returncode == 0, done.stderr
    assert "compiling kernels" in done.stderr
    assert not list(package.glob("**/*.nbi"))


def bound_by_permissions():
    """Drop the superuser's privilege to write anywhere (PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)."""
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)
