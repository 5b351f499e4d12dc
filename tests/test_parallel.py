"""Work shared among threads: every row once, whatever their number, and failures reported."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numba as nb
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optical_palpation.parallel import in_parallel


class Pair(NamedTuple):
    factor: np.ndarray
    shift: float


@nb.njit
def _scale(counts, pair, seen, begin, end):
    for row in range(begin, end):
        line = counts[row]  # a view: counts a reference, if there is one to count
        line += pair.factor[row] + pair.shift
        seen[row] = nb.get_thread_id()


@nb.njit
def scale(counts, pair, seen):
    in_parallel(_scale, len(counts), (counts, pair, seen))


@nb.njit
def _twice(out, begin, end):
    for row in range(begin, end):
        out[row] *= 2


@nb.njit
def add_and_double(counts, pair, seen):
    in_parallel(_scale, len(counts), (counts, pair, seen))
    in_parallel(_twice, len(counts), (counts,))


@nb.njit
def _allocate(size, out, begin, end):
    work = np.empty(size)
    for row in range(begin, end):
        out[row] = work.size


@nb.njit
def allocate(size, out):
    in_parallel(_allocate, len(out), (size, out))


@pytest.fixture
def threads():
    before = nb.get_num_threads()
    yield before
    nb.set_num_threads(before)


@given(rows=st.integers(0, 50), number=st.integers(1, 64))
def test_every_row_is_worked_on_once(rows, number):
    before = nb.get_num_threads()
    nb.set_num_threads(min(number, before))
    try:
        counts, factor = np.zeros((rows, 3)), np.arange(rows, dtype=np.float32)
        seen = np.full(rows, -1)
        scale(counts, Pair(factor, 0.5), seen)
    finally:
        nb.set_num_threads(before)
    assert (counts == factor[:, None] + 0.5).all()
    assert len(set(seen)) <= min(rows, number, before)


@pytest.mark.skipif(nb.config.NUMBA_NUM_THREADS == 1, reason="there is one thread only")
def test_threads_work_side_by_side():
    counts, pair, seen = np.zeros((4000, 3)), Pair(np.ones(4000, np.float32), 0.0), np.zeros(4000)
    used = set()
    for _ in range(100):  # one thread may have done everything before another awakes
        scale(counts, pair, seen)
        used |= set(seen)
    assert len(used) > 1


def test_one_part_of_a_kernel_begins_when_all_of_that_before_are_done():
    counts = np.zeros((1000, 3))
    add_and_double(counts, Pair(np.ones(1000, np.float32), 0.0), np.zeros(1000, int))
    assert (counts == 2).all()


@pytest.mark.parametrize("number", [1, 2])
def test_want_of_memory_is_an_error(threads, number):
    nb.set_num_threads(min(number, threads))
    out = np.zeros(10, int)
    allocate(3, out)
    assert (out == 3).all()
    with pytest.raises(MemoryError, match="work arrays"):
        allocate(1 << 60, out)


def test_arrays_are_released():
    counts = np.zeros((40, 3))
    factor = np.ones(40, np.float32)
    before = sys.getrefcount(counts), sys.getrefcount(factor)
    scale(counts, Pair(factor, 0.0), np.zeros(40, int))
    assert (sys.getrefcount(counts), sys.getrefcount(factor)) == before


def test_importing_launches_no_threads():
    # a process with threads of OpenMP cannot be forked, as multiprocessing would
    program = "import numba, optical_palpation.cli.stress, optical_palpation.palpation\n"
    program += "try: print(numba.threading_layer())\nexcept ValueError: print('none')"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert said.stdout.strip() == "none", said


@pytest.mark.skipif(nb.config.NUMBA_NUM_THREADS > 1, reason="these tests had threads")
def test_all_of_this_on_two_threads():
    """Each worker of a parallel run has its share of the cores, which may be one thread."""
    stencil = Path(__file__).with_name("test_stencil.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--numprocesses=0"]
    done = subprocess.run(
        [*command, __file__, f"{stencil}::test_product_is_that_of_the_matrix"],
        env=os.environ | {"NUMBA_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
