"""Fixtures and settings common to all tests."""

import os
import re
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# The same examples in every run, so that a failure can be repeated; no deadline, because the first
# call of a kernel includes its compilation.
settings.register_profile(
    "project",
    deadline=None,
    derandomize=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("project")

# Whatever starts the tests may have signals ignored, as nohup and the background of a shell do; the
# commands under test would inherit that and could not be interrupted.
for _name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGXFSZ"):
    _number = getattr(signal, _name, None)
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(
            _number,
            signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL,
        )

# Workers of a parallel run share the cores, and so do the commands that they start: threads beyond
# these wait for each other, which takes twice the processor time.
if _workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    _share = max(1, (os.cpu_count() or 1) // int(_workers))
    os.environ.setdefault("NUMBA_NUM_THREADS", str(_share))

#: Test files that need no solver of the layer but a small one: what to run after every change.
QUICK = {
    *("algebraic", "analysis", "elements", "files", "material_laws", "plausibility", "regions"),
    *("stencil", "study_file", "thickness_cleaning", "thickness_maps", "volume_readers"),
}


def pytest_addoption(parser):
    parser.addoption(
        "--allowed-skips",
        type=Path,
        help="file of regular expressions, one a line: skips for any other reason are failures",
    )


def pytest_configure(config):
    config.addinivalue_line("markers", "quick: one of the files that make test-quick runs")


def pytest_collection_modifyitems(items):
    """Mark the quick ones; files with slow tests go first, so that all workers end together.

    The very first compiles kernels of its own: all others would wait for those that they share.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.stem != "test_public_numba", item.path not in slow))
    for item in items:
        if item.path.stem.removeprefix("test_") in QUICK and not item.get_closest_marker("slow"):
            item.add_marker("quick")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A file at a time on each core: its tests share solutions. A page of docs is on its own."""
    from xdist.scheduler import LoadScopeScheduling

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            alone = "::test_every_block_runs[" in nodeid
            return nodeid if alone else super()._split_scope(nodeid)

    return Files(config, log) if config.getoption("dist") == "loadscope" else None


def pytest_sessionfinish(session):
    """Fail where a test was skipped that should run; with xdist where the reports arrive."""
    path = session.config.getoption("--allowed-skips")
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if path is None or reporter is None or hasattr(session.config, "workerinput"):
        return
    lines = path.read_text(encoding="utf-8").splitlines()
    allowed = [line for line in lines if line.strip() and not line.startswith("#")]
    for report in reporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reason = reason.removeprefix("Skipped: ")
        if not any(re.fullmatch(pattern, reason) for pattern in allowed):
            reporter.write_line(f"UNEXPECTED SKIP {report.nodeid}: {reason}", red=True)
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of third-party test data beside the repository, or skip."""
    folder = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("third-party test data not found in ../shared/data")
    return folder.resolve()


@pytest.fixture
def run(capsys):
    """Run a command as a user would; the exit status and what it wrote to stdout and stderr."""
    from optical_palpation.cli import main

    def run(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as leaving:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return leaving.value.code or 0, out, err

    return run
