"""What the environment of the process forbids, told before anything is computed."""

from __future__ import annotations

import os
import sys

from optical_palpation.errors import InputError

_LAYERS = ("default", "safe", "threadsafe", "forksafe", "omp", "tbb", "workqueue")
#: Address space that the libraries take before anything is computed, and for each core.
_LIBRARIES, _PER_CORE = 0.9e9, 4e7


def public_numba() -> bool:
    """Whether kernels are to do without the private parts of numba.

    They are what ``parallel``, ``mechanics.intrinsics`` and ``runtime.kernels`` lean on: faster
    compilation, all threads, prefetching, kept kernels that are never stale. Should a version of
    numba break them, the environment variable ``OPTICAL_PALPATION_NUMBA=public`` replaces them by
    what numba documents; kernels then run on one thread.
    """
    return os.environ.get("OPTICAL_PALPATION_NUMBA", "").strip() == "public"


def check_environment() -> None:
    """Refuse environment variables of numba with which kernels cannot run.

    Raises
    ------
    InputError
        Naming the variable, its value and what to do.
    """
    for name, usable, hint in (
        ("NUMBA_NUM_THREADS", lambda v: v.isdecimal() and int(v) > 0, "a number of at least 1"),
        ("NUMBA_THREADING_LAYER", lambda v: v in _LAYERS, f"one of {', '.join(_LAYERS)}"),
        ("OPTICAL_PALPATION_NUMBA", lambda v: v == "public", "public"),
        ("NUMBA_DISABLE_JIT", lambda v: v == "0", "0: the kernels work compiled only"),
    ):
        value = os.environ.get(name, "").strip()
        if value and not usable(value):
            raise InputError(
                f"the environment variable {name} is {value!r}; unset it, or give it {hint}"
            )


def check_address_space() -> None:
    """Refuse to begin where a limit leaves too little address space for the libraries.

    The linear algebra libraries wait for ever for memory that they do not get.

    Raises
    ------
    InputError
        With the limit, and what it should be at least.
    """
    limit = address_space_limit()
    needed = _LIBRARIES + _PER_CORE * (os.cpu_count() or 1)
    if limit is not None and limit < needed:
        raise InputError(
            f"the address space of this process is limited to {limit / 1e6:.0f} MB (ulimit -v); "
            f"the program with its libraries needs {needed / 1e6:.0f} MB before it computes "
            "anything. Raise the limit, or use one on resident memory"
        )


def address_space_limit() -> int | None:
    """Limit on the address space of the process, bytes; None where there is none."""
    if sys.platform == "win32":
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit
