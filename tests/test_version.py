"""The version tells the commit: in a working copy, and in what was built from one."""

import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import optical_palpation
from optical_palpation.runtime import software_version
from optical_palpation.runtime.version import _of_repository

ROOT = Path(__file__).resolve().parents[1]


def test_the_version_names_a_commit():
    assert re.fullmatch(
        rf"{re.escape(version('optical-palpation'))}\+(g[0-9a-f]{{12}}(\.dirty)?|unknown)",
        software_version(),
    )


def git(folder, *arguments):
    who = ["-c", "user.name=nobody", "-c", "user.email=nobody@localhost"]
    done = subprocess.run(
        ["git", "-C", str(folder), *who, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def copy(tmp_path):
    """A repository of the project's sources."""
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(
        Path(optical_palpation.__file__).parent,
        tmp_path / "src" / "optical_palpation",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    (tmp_path / ".gitignore").write_text("dist/\n__pycache__/\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "all")
    return tmp_path


def test_changes_since_the_commit_are_told(copy):
    commit = f"g{git(copy, 'rev-parse', '--short=12', 'HEAD')}"
    assert _of_repository(copy) == commit
    (copy / "notes.txt").write_text("no code")
    assert _of_repository(copy) == commit
    with (copy / "src" / "optical_palpation" / "errors.py").open("a") as file:
        file.write("# changed\n")
    assert _of_repository(copy) == f"{commit}.dirty"
    (copy / "hatch_build.py").unlink()  # a repository of something else around the package
    assert _of_repository(copy) == ""


BUILD = """
import sys
from hatchling import build
print(getattr(build, sys.argv[1])(sys.argv[2]))
"""


def build(folder, kind, into):
    done = subprocess.run(
        [sys.executable, "-c", BUILD, kind, str(into)],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return into / done.stdout.split()[-1]


def test_a_wheel_and_one_from_a_source_distribution_know_their_commit(copy):
    commit = f"g{git(copy, 'rev-parse', '--short=12', 'HEAD')}"
    out = copy / "dist"
    out.mkdir()
    wheels = [build(copy, "build_wheel", out)]
    source = build(copy, "build_sdist", out)
    shutil.unpack_archive(source, out)
    wheels.append(build(out / source.name.removesuffix(".tar.gz"), "build_wheel", out / "again"))
    for wheel in wheels:
        installed = out / f"installed-{wheel.parent.name}"
        zipfile.ZipFile(wheel).extractall(installed)
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from optical_palpation.runtime import software_version as v; print(v())",
            ],
            env={"PYTHONPATH": str(installed)},
            cwd=installed,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip() == f"{version('optical-palpation')}+{commit}"
