"""Compiled kernels are taken up again where they are current and whole, and never otherwise."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import optical_palpation
from optical_palpation.runtime.kernels import CheckedFile
from optical_palpation.runtime.source import PACKAGE, modules_digest, source_digest

RUN = """
import hashlib, sys
import numpy as np
from numba.core import event
from optical_palpation.volume import lzw
from optical_palpation.mechanics.imprint import Imprint

class Compiling(event.Listener):
    count = 0
    def on_start(self, event):
        self.count += 1
    def on_end(self, event):
        pass

seen = Compiling()
with event.install_listener("numba:compile", seen):
    x = np.linspace(0.0, 1.0, 5)
    field = np.cos(7 * np.add.outer(x, x))
    found = Imprint(x, x, np.ones((5, 5)), 1 + 0.1 * field).evaluate(x, x, 1.0)
print(seen.count, hashlib.sha256(np.asarray(found).tobytes()).hexdigest())
"""


def evaluate(cache: Path, **environment) -> tuple[int, str, str]:
    """Evaluate an imprint in a new process: kernels compiled, digest of the result, complaints."""
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache), **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    compiled, digest = done.stdout.split()
    return int(compiled), digest, done.stderr


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """A folder of compiled kernels, and the result that they give."""
    folder = tmp_path_factory.mktemp("kernels")
    compiled, digest, said = evaluate(folder)
    assert compiled > 0
    assert said == ""
    return folder, digest


@pytest.fixture
def cache(warm, tmp_path):
    return shutil.copytree(warm[0], tmp_path / "kernels")


def test_kernels_are_compiled_once_and_give_the_same_to_the_last_bit(warm, cache):
    assert evaluate(cache) == (0, warm[1], "")


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "text"])
def test_damaged_kernels_are_compiled_anew(warm, cache, ending, damage):
    files = sorted(cache.rglob(f"imprint.*{ending}"))
    assert files
    for file in files:
        content = bytearray(file.read_bytes())
        if damage == "flipped":
            content[len(content) // 2] ^= 0x10
        file.write_bytes(
            {
                "empty": b"",
                "cut": content[: len(content) // 3],
                "flipped": content,
                "text": b"no kernel\n" * 50,
            }[damage]
        )
    _, digest, said = evaluate(cache)
    assert (digest, said) == (warm[1], "")
    assert evaluate(cache) == (0, warm[1], "")  # and mended


def test_processes_that_compile_at_once_never_take_each_others_kernel(tmp_path):
    """Both find the folder empty and call their file number 1; whose index is last has it."""
    ours, theirs = (CheckedFile(str(tmp_path), "kernel", ("optical-palpation", "x")) for _ in "ab")
    ours.save("int", "kernel of int")
    index = (tmp_path / "kernel.nbi").read_bytes()
    (tmp_path / "kernel.nbi").unlink()
    theirs.save("float", "kernel of float")
    assert theirs.load("float") == "kernel of float"
    (tmp_path / "kernel.nbi").write_bytes(index)
    assert ours.load("int") is None
    ours.save("int", "kernel of int")
    assert ours.load("int") == "kernel of int"


FULL = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
"""


def test_a_full_disk_is_said_once_and_does_no_harm(warm, tmp_path):
    """The system refuses to let files grow beyond the limit, as a full disk would."""
    done = subprocess.run(
        [sys.executable, "-c", FULL + RUN],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "new")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[1] == warm[1]
    assert done.stderr.count("compiled kernels cannot be kept") == 1
    assert not list(tmp_path.rglob("*.tmp.*"))


def test_a_folder_that_is_a_file_is_done_without(warm, tmp_path):
    (tmp_path / "file").touch()
    assert evaluate(tmp_path / "file" / "kernels")[1] == warm[1]


def test_kernels_of_another_code_are_not_taken(tmp_path):
    """Numba looks only at the file of the function itself; what that calls may have changed."""
    package = tmp_path / "optical_palpation"
    shutil.copytree(
        Path(optical_palpation.__file__).parent,
        package,
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    environment = {"PYTHONPATH": str(tmp_path)}
    first = evaluate(tmp_path / "kernels", **environment)
    assert evaluate(tmp_path / "kernels", **environment)[0] == 0
    called = package / "parallel.py"
    called.write_text(called.read_text() + "\n# another\n")
    again = evaluate(tmp_path / "kernels", **environment)
    assert again[0] > 0
    assert again[1] == first[1]


def test_the_digest_of_a_module_covers_what_it_imports():
    digest = modules_digest(PACKAGE / "mechanics" / "imprint.py")
    assert digest != modules_digest(PACKAGE / "parallel.py")


def test_the_digest_of_a_part_follows_imports_and_files_stand_alone():
    import optical_palpation.runtime.source as source

    def covers(*parts):
        found = []
        original, source._digest = source._digest, lambda files: found.extend(files) or ""
        try:
            source.source_digest.__wrapped__(*parts)
        finally:
            source._digest = original
        return {file.relative_to(PACKAGE).as_posix() for file in found}

    assert "mechanics/newton.py" in covers("palpation")
    assert "mechanics/newton.py" not in covers("thickness", "volume")
    assert "errors.py" in covers("thickness")
    assert covers("study/stages.py") == {"study/stages.py"}
    assert "present/report/templates/report.html" in covers("present")
    assert not any("__pycache__" in file for file in covers("present"))
    with pytest.raises(ValueError, match="no part 'nothing'"):
        source_digest("nothing")
