"""Fixtures and settings common to all tests."""

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
