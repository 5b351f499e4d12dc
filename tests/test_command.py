"""The installed command in hostile surroundings: it ends, says why, and loses no result."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from optical_palpation.present import read_result

COMMAND = [sys.executable, "-m", "optical_palpation"]
ALGEBRAIC = [
    *("stress", "map.npy", "--field-of-view", "2", "1.5", "--initial-thickness", "0.5"),
    *("--c10", "2.23", "--c01", "0.703", "--method", "algebraic", "--output", "o.nc"),
]
COMPUTATIONAL = [
    *(word for word in ALGEBRAIC if word not in ("--method", "algebraic")),
    *("--window-friction", "0.15", "--sample-friction", "0.05", "--element-size", "0.25"),
    *("--threads", "1", "--no-estimates"),
]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    y, x = np.meshgrid(np.linspace(0, 1.5, 13), np.linspace(0, 2, 17), indexing="ij")
    np.save("map.npy", 0.42 - 0.04 * np.exp(-((x - 0.7) ** 2 + (y - 1) ** 2) / 0.2))
    return tmp_path


def command(*arguments, environment=(), **options):
    options = {"capture_output": True, "text": True, "timeout": 300} | options
    return subprocess.run([*COMMAND, *arguments], env=os.environ | dict(environment), **options)


def test_a_closed_pipe_loses_no_result(here):
    first, second = os.pipe()
    os.close(first)
    done = command(*ALGEBRAIC, capture_output=False, stdout=second, stderr=subprocess.PIPE)
    os.close(second)
    assert (done.returncode, done.stderr) == (0, "")
    assert read_result("o.nc").maps["axial_stress"].min() < 0


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no such device")
def test_full_output_and_error_lose_no_result(here):
    with open("/dev/full", "w") as full:
        done = command(*COMPUTATIONAL, capture_output=False, stdout=full, stderr=full)
    assert done.returncode == 0
    assert read_result("o.nc").maps["axial_stress"].min() < 0


def test_closed_streams_lose_no_result(here):
    script = " ".join([*COMMAND, *ALGEBRAIC, "--plot o.png", "<&- >&- 2>&-"])
    assert subprocess.run(["sh", "-c", script]).returncode == 0
    assert read_result("o.nc").maps["axial_stress"].min() < 0
    assert Path("o.png").read_bytes().startswith(b"\x89PNG")


def test_names_that_are_no_utf_8(here):
    os.rename(b"map.npy", b"map\xff.npy")
    arguments = [b"map\xff.npy" if a == "map.npy" else a for a in ALGEBRAIC]
    done = command(*(b"o\xfe.nc" if a == "o.nc" else a for a in arguments), "--plot", b"p\xfd.png")
    assert done.returncode == 0, done.stderr
    assert r"o\xfe.nc" in done.stdout.replace("\\udcfe", r"\xfe")
    assert read_result(os.fsdecode(b"o\xfe.nc")).maps.attrs["input"] == r"map\xff.npy"
    assert os.path.exists(b"p\xfd.png")
    done = command(*(b"lost\xff.npy" if a == b"map\xff.npy" else a for a in arguments))
    assert done.returncode == 2
    assert "no such file" in done.stderr


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("NUMBA_NUM_THREADS", "many"),
        ("NUMBA_NUM_THREADS", "0"),
        ("NUMBA_THREADING_LAYER", "nonsense"),
        ("NUMBA_DISABLE_JIT", "1"),
        ("OPTICAL_PALPATION_NUMBA", "private"),
    ],
)
def test_unusable_settings_of_numba_are_named(here, name, value):
    done = command(*ALGEBRAIC, environment={name: value})
    assert done.returncode == 2
    assert f"environment variable {name} is {value!r}; unset it" in done.stderr
    assert not Path("o.nc").exists()


def test_a_threading_layer_that_is_not_there_is_named(here):
    if command("--version", environment={"NUMBA_THREADING_LAYER": "tbb"}).returncode:
        raise AssertionError("tbb is a layer that numba knows")
    probe = "import numba; numba.get_num_threads()"
    there = subprocess.run(
        [sys.executable, "-c", probe],
        env=os.environ | {"NUMBA_THREADING_LAYER": "tbb"},
        capture_output=True,
    )
    done = command(*COMPUTATIONAL, environment={"NUMBA_THREADING_LAYER": "tbb"})
    assert done.returncode == (0 if there.returncode == 0 else 2), done.stderr
    assert "Traceback" not in done.stderr


def test_a_backend_of_matplotlib_for_the_screen_does_not_matter(here):
    done = command(*ALGEBRAIC, "--plot", "o.png", environment={"MPLBACKEND": "nonsense"})
    assert done.returncode == 0, done.stderr
    assert Path("o.png").stat().st_size > 1000


@pytest.mark.parametrize("megabytes", [300, 500, 700])
def test_too_little_address_space_is_told_and_does_not_hang(here, megabytes):
    limit = megabytes * 1_000_000
    done = command(
        *COMPUTATIONAL,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        timeout=60,
    )
    assert done.returncode == 2
    assert "ulimit -v" in done.stderr
    assert not Path("o.nc").exists()


def begin(*arguments):
    """Start the command as a shell in a terminal does: Ctrl-C is not ignored."""
    return subprocess.Popen(
        [*COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


# Python itself takes some hundredths of a second before it runs any line of ours.
@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.15, 0.2, 0.4, 0.8, 1.5])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_while_it_starts(here, seconds, number):
    begun = begin(*COMPUTATIONAL)
    wait_until_it_runs(begun)
    time.sleep(seconds)
    begun.send_signal(number)
    _, said = begun.communicate(timeout=60)
    # where Python ends by the signal itself, which a shell shows as 130, too
    ended = (130, -signal.SIGINT) if number == signal.SIGINT else (143,)
    assert begun.returncode in (0, *ended), said
    assert "Traceback" not in said
    left = {path.name for path in here.iterdir()}
    assert left == ({"map.npy", "o.nc"} if begun.returncode == 0 else {"map.npy"})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_while_signals_are_taken_over(number):
    code = (
        "import runpy, signal, sys\n"
        f"sys.argv, number = ['optical-palpation', '--version'], {int(number)}\n"
        "take = signal.signal\n"
        "def taken(of, handler):\n"
        "    before = take(of, handler)\n"
        "    if of == number and getattr(handler, '__name__', '') == '_end':\n"
        "        signal.raise_signal(of)\n"
        "    return before\n"
        "signal.signal = taken\n"
        "runpy.run_module('optical_palpation', run_name='__main__')\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == (130 if number == signal.SIGINT else 143)
    assert "Traceback" not in ran.stderr


# What runs as the command, and gets the signal where an exception would be lost or changed.
_LOSES = {
    "a module that is being imported": "import module",
    "a callback from C": (
        "import ctypes\nctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()"
    ),
}


@pytest.mark.parametrize("place", _LOSES)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_not_lost_in(here, number, place):
    Path("module.py").write_text(
        "import signal\nfrom __main__ import number\n"
        "try:\n    signal.raise_signal(number)\n"
        "except BaseException:\n    raise ImportError('initialization failed')\n"
    )
    script = f"""
import signal, sys, time
import optical_palpation.cli
from optical_palpation.__main__ import main

number = {int(number)}
signal.signal(signal.SIGINT, signal.default_int_handler)

def command():
    try:
        exec({_LOSES[place]!r}, globals())
        print("went on", flush=True)
        time.sleep(10)
    except KeyboardInterrupt:
        sys.exit(130)

optical_palpation.cli.main = command
main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130 if number == signal.SIGINT else 143, "")
    assert done.stdout == "went on\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_a_signal_leaves_half_made_says_nothing(number):
    script = f"""
import signal, sys
from optical_palpation import cli
from optical_palpation.__main__ import main

class Foreign:
    def __init__(self):
        signal.raise_signal({int(number)})
        self.handle = 1

    def __del__(self):
        self.handle

signal.signal(signal.SIGINT, signal.default_int_handler)
cli.app = lambda *_, **__: Foreign()
main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == (130 if number == signal.SIGINT else 143)
    assert "AttributeError" not in done.stderr


def wait_until_it_runs(begun):
    """Wait until Python has taken care of the signals: they are caught, as the kernel tells."""
    status = Path(f"/proc/{begun.pid}/status")
    if not status.exists():
        return
    limit = time.monotonic() + 60
    while time.monotonic() < limit and begun.poll() is None:
        caught = int(status.read_text().split("SigCgt:")[1].split()[0], 16)
        if caught & (1 << (signal.SIGTERM - 1)):
            return
        time.sleep(0.002)


def test_a_file_that_cannot_be_written_keeps_the_others_and_has_a_status(here, run, monkeypatch):
    from optical_palpation.errors import OutputError
    from optical_palpation.present.writing import WRITERS

    def full(result, path):
        raise OutputError(f"{path}: could not be written (No space left on device)")

    monkeypatch.setitem(WRITERS, "picture", full)
    status, out, err = run(*ALGEBRAIC, "--plot", "o.png", "--profiles", "o.csv")
    assert status == 4
    assert "No space left on device" in err
    assert "Written: o.nc, o.csv" in err
    assert "mean" in out
    assert {path.name for path in here.iterdir()} == {"map.npy", "o.nc", "o.csv"}


TWO_THREADS = """
import hashlib, sys, threading
import numpy as np
from optical_palpation.material import MooneyRivlin
from optical_palpation.palpation import computational_stress
from optical_palpation.thickness import thickness_map

def solve(size):
    axis = np.linspace(0.0, 2.0, 21)
    x, y = np.meshgrid(axis, axis)
    loaded = 0.45 - 0.04 * np.exp(-((x - 0.9) ** 2 + (y - 1.1) ** 2) / 0.2)
    result = computational_stress(
        thickness_map(loaded, x=axis, y=axis), 0.5, MooneyRivlin(2.23, 0.703),
        window_friction=0.15, sample_friction=0.05, element_size=size,
        threads=2 if size == 0.5 else 1,
        mesh_check=False, edge_check=False, input_errors=None,
    )
    return hashlib.sha256(result.state.u.tobytes()).hexdigest()

sizes = [0.5, 0.4] * 2
"""
THREADS = """
alone = [solve(size) for size in sizes[:2]] * 2
found = [None] * len(sizes)
def work(n):
    found[n] = solve(sizes[n])
threads = [threading.Thread(target=work, args=(n,)) for n in range(len(sizes))]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert found == alone, (found, alone)
"""
FORK = """
import multiprocessing
alone = [solve(0.5), solve(0.4)]
with multiprocessing.get_context("fork").Pool(2) as pool:
    assert pool.map_async(solve, sizes).get(200) == [alone[0], alone[1]] * 2
"""


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
@pytest.mark.parametrize("program", [THREADS, FORK], ids=["threads", "fork"])
def test_solves_in_two_threads_and_after_a_fork(here, layer, program):
    done = subprocess.run(
        [sys.executable, "-c", TWO_THREADS + program],
        env=os.environ | {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr


def test_what_is_said_stands_in_one_file_in_its_order():
    script = """
import sys
from optical_palpation.runtime.streams import take_over_streams

take_over_streams()
print("first")
print("second", file=sys.stderr)
print("third")
"""
    done = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert done.stdout.split() == ["first", "second", "third"]
