"""The rules of the tests: where a release is checked no skip goes unnoticed."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ALLOWED = ROOT / ".ci" / "allowed-skips"
TESTS = """
import signal
import pytest

def test_signals_are_not_those_of_the_parent():
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

@pytest.mark.skip(reason={reason!r})
def test_skipped():
    pass
"""


@pytest.mark.parametrize("workers", ["0", "2"])
@pytest.mark.parametrize(
    ("reason", "status"),
    [("third-party test data not found in ../shared/data", 0), ("no Chromium on this machine", 1)],
)
def test_an_unexpected_skip_fails(tmp_path, workers, reason, status):
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "test_some.py").write_text(TESTS.format(reason=reason))
    command = [sys.executable, "-m", "pytest", "-q", "-n", workers, "-p", "no:cacheprovider"]
    script = 'trap "" INT; exec "$@"'  # as a shell's background does
    done = subprocess.run(
        ["sh", "-c", script, "sh", *command, "--allowed-skips", ALLOWED, "."],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == status, done.stdout
    assert ("UNEXPECTED SKIP" in done.stdout) == bool(status)
    assert "1 passed, 1 skipped" in done.stdout


def test_allowed_reasons_are_regular_expressions():
    for line in ALLOWED.read_text().splitlines():
        re.compile(line)
