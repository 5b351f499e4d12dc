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

# Kernels are looked for when their module is executed: in each folder anew, by the same process.
RUN = """
import hashlib, importlib, sys
import numba
import numpy as np
from numba.core import event
from optical_palpation.volume import lzw
from optical_palpation.mechanics import imprint

class Compiling(event.Listener):
    count = 0
    def on_start(self, event):
        self.count += 1
    def on_end(self, event):
        pass

x = np.linspace(0.0, 1.0, 5)
field = np.cos(7 * np.add.outer(x, x))
for folder in sys.argv[1:] or [numba.config.CACHE_DIR]:
    numba.config.CACHE_DIR = folder
    importlib.reload(imprint)
    seen = Compiling()
    with event.install_listener("numba:compile", seen):
        found = imprint.Imprint(x, x, np.ones((5, 5)), 1 + 0.1 * field).evaluate(x, x, 1.0)
    print(seen.count, hashlib.sha256(np.asarray(found).tobytes()).hexdigest())
"""


def evaluate(*caches: Path | None, **environment) -> tuple[list[int], set[str], str]:
    """Evaluate an imprint with each cache, None beside the package, in a new process.

    Kernels compiled each time, different digests of the results, complaints.
    """
    folders = [str(cache or "") for cache in caches]
    done = subprocess.run(
        [sys.executable, "-c", RUN, *folders],
        env=os.environ | {"NUMBA_CACHE_DIR": folders[0], **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert len(lines) == len(caches)
    return [int(compiled) for compiled, _ in lines], {digest for _, digest in lines}, done.stderr


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """A folder of compiled kernels, and the result that they give."""
    folder = tmp_path_factory.mktemp("kernels")
    (compiled,), (digest,), said = evaluate(folder)
    assert compiled > 0
    assert said == ""
    return folder, digest


@pytest.fixture
def cache(warm, tmp_path):
    return shutil.copytree(warm[0], tmp_path / "kernels")


def test_kernels_are_compiled_once_and_give_the_same_to_the_last_bit(warm, cache):
    assert evaluate(cache) == ([0], {warm[1]}, "")


def damaged(content: bytes) -> dict[str, bytes]:
    """What may have become of a file with this content."""
    middle = len(content) // 2
    return {
        "empty": b"",
        "cut": content[: len(content) // 3],
        "flipped": content[:middle] + bytes([content[middle] ^ 0x10]) + content[middle + 1 :],
        "text": b"no kernel\n" * 50,
    }


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
def test_damaged_kernels_are_compiled_anew(warm, tmp_path, ending):
    caches = []
    for damage in damaged(b"..."):
        caches.append(shutil.copytree(warm[0], tmp_path / damage))
        files = list(caches[-1].rglob(f"imprint.*{ending}"))
        assert files
        for file in files:
            file.write_bytes(damaged(file.read_bytes())[damage])
    # the second time shows whether they are mended
    compiled, digests, said = evaluate(*(cache for cache in caches for _ in range(2)))
    assert (digests, said) == ({warm[1]}, "")
    assert compiled[0] > 0  # nothing is left in an empty file
    assert set(compiled[1::2]) == {0}


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
    assert evaluate(tmp_path / "file" / "kernels")[1] == {warm[1]}


def copied(folder):
    """Copy the package to a folder, as another installation, and say so in the environment."""
    shutil.copytree(
        Path(optical_palpation.__file__).parent,
        folder / "optical_palpation",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    return {"PYTHONPATH": str(folder)}


def test_another_installation_of_the_same_code_takes_them(warm, cache, tmp_path):
    environment = copied(tmp_path / "another")
    (compiled,), digests, _ = evaluate(cache, **environment)
    assert (compiled, digests) == (0, {warm[1]})


@pytest.mark.parametrize("where", ["a folder that is named", "beside the package"])
def test_kernels_of_another_code_are_not_taken(tmp_path, where):
    """Numba looks only at the file of the function itself; what that calls may have changed."""
    environment = copied(tmp_path)
    kernels = tmp_path / "kernels" if where == "a folder that is named" else None
    first = evaluate(kernels, kernels, **environment)
    assert first[0][0] > 0
    assert first[0][1] == 0
    called = tmp_path / "optical_palpation" / "parallel.py"
    called.write_text(called.read_text() + "\n# another\n")
    again = evaluate(kernels, **environment)
    assert again[0][0] > 0
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
