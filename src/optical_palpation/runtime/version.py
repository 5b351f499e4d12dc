"""The version of the running code: of the release, and of the commit that it is."""

from __future__ import annotations

import subprocess
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

#: Written into built packages (``hatch_build.py``), where there is no repository to ask.
COMMIT_FILE = "commit.txt"
_TIMEOUT = 10.0


@cache
def software_version() -> str:
    """Version of the code that runs, such as ``0.1.0+g753793a1b2c3`` (PEP 440).

    The part after ``+`` is the commit: of the repository that the package lies in, else the one
    that the package was built from. ``.dirty`` follows where files had been changed since, and
    ``+unknown`` stands where neither a repository nor a built package tells.
    """
    release = version("optical-palpation")
    commit = _of_repository(Path(__file__).resolve().parents[3]) or _of_build() or "unknown"
    return f"{release}+{commit}"


def _of_build() -> str:
    try:
        written = files("optical_palpation").joinpath(COMMIT_FILE).read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""
    return written.strip()


def _of_repository(root: Path) -> str:
    """Commit of a working copy at `root`; empty if there is none, or no git to ask."""
    if not ((root / ".git").exists() and (root / "hatch_build.py").is_file()):
        return ""  # whatever repository this is, it is not the one of the project
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    if not commit:
        return ""
    changed = _git(root, "status", "--porcelain", "--", "src", "pyproject.toml")
    return f"g{commit}" + (".dirty" if changed or changed is None else "")


def _git(root: Path, *arguments: str) -> str | None:
    """Output of a git command; None if it fails or there is no git."""
    command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIMEOUT, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
