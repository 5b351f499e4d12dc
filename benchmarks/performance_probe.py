"""Watches a computation from outside: time by phase, Krylov iterations, bytes that kernels move."""

from __future__ import annotations

import functools
import importlib
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from unittest import mock

import numba as nb
import numpy as np

PACKAGE = "optical_palpation.mechanics"

#: Function (module, name) by the phase whose time is its own, less that of functions listed here
#: which it calls.
PHASES = {
    "assembly": [("system", "assemble"), ("newton", "balance")],
    "contact": [
        ("contact", "linearise"),
        ("side_contact", "side_contact"),
        ("contact", "remember_slip"),
        ("imprint", "Imprint.evaluate"),
    ],
    "smoother": [("multigrid", "Level.smooth")],
    "coarse operators": [("multigrid", "Hierarchy.update")],
    "transfers": [("multigrid", "Hierarchy.cycle")],
    "Krylov": [("krylov", "MultigridSolver.solve")],
    "direct": [("direct", "DirectSolver.solve")],
}

#: Kernels that touch a part only of the arrays they are given: left out of the bytes.
PARTIAL = {"_constrain", "_galerkin_plane", "_tangent_layer"}


class Probe:
    """Context manager; afterwards ``seconds`` by phase, ``krylov`` iterations, ``bytes_moved``.

    ``bytes_moved`` counts every array given to a kernel once per call, read or written: the least
    that has to pass between processor and memory while arrays exceed the caches.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.krylov_each: list[int] = []
        self.bytes_moved = 0
        self._running: list[list[float]] = []

    @property
    def krylov(self) -> int:
        return sum(self.krylov_each)

    def __enter__(self) -> Probe:
        self._stack = ExitStack()
        for phase, functions in PHASES.items():
            for module, name in functions:
                owner, attribute = importlib.import_module(f"{PACKAGE}.{module}"), name
                if "." in name:
                    class_name, attribute = name.split(".")
                    owner = getattr(owner, class_name)
                original = getattr(owner, attribute)
                note = self._note_krylov if name == "MultigridSolver.solve" else None
                self._replace(owner, original, self._timed(original, phase, note))
        for module in _modules():
            for value in list(vars(module).values()):
                if isinstance(value, nb.core.registry.CPUDispatcher) and _entry(value):
                    self._replace(module, value, self._counted(value))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _replace(self, owner: object, original: Callable, watched: Callable) -> None:
        """Put ``watched`` wherever ``original`` is known by name."""
        places = [owner] if isinstance(owner, type) else _modules()
        for place in places:
            for name, value in list(vars(place).items()):
                if value is original:
                    self._stack.enter_context(mock.patch.object(place, name, watched))

    def _timed(self, function: Callable, phase: str, note: Callable | None) -> Callable:
        @functools.wraps(function)
        def watched(*args, **keywords):
            inner = [0.0]
            self._running.append(inner)
            start = time.perf_counter()
            try:
                result = function(*args, **keywords)
            finally:
                taken = time.perf_counter() - start
                self._running.pop()
                self.seconds[phase] += taken - inner[0]
                if self._running:
                    self._running[-1][0] += taken
            if note:
                note(result)
            return result

        return watched

    def _note_krylov(self, result: tuple) -> None:
        self.krylov_each.append(result[2])

    def _counted(self, kernel: Callable) -> Callable:
        @functools.wraps(kernel)
        def watched(*args):
            given = [a for arg in args for a in (arg if isinstance(arg, tuple) else (arg,))]
            arrays = {id(a): a.nbytes for a in given if isinstance(a, np.ndarray)}
            self.bytes_moved += sum(arrays.values())
            return kernel(*args)

        return watched


def _modules() -> list:
    return [m for name, m in sys.modules.items() if name.startswith("optical_palpation")]


def _entry(kernel) -> bool:
    """Whether a kernel is called from Python: only those are kept on disk."""
    return kernel.stats.cache_path is not None and kernel.__name__ not in PARTIAL


def copy_bandwidth(threads: int | None = None) -> float:
    """Bytes per second that all threads together move in a = b + s c."""
    a, b, c = (np.ones(40_000_000, np.float32) for _ in range(3))
    before = nb.get_num_threads()
    nb.set_num_threads(threads or before)
    try:
        _triad(a, b, c)
        best = np.inf
        for _ in range(5):
            start = time.perf_counter()
            _triad(a, b, c)
            best = min(best, time.perf_counter() - start)
    finally:
        nb.set_num_threads(before)
    return 3 * a.nbytes / best


@nb.njit(parallel=True)
def _triad(a, b, c):
    for i in nb.prange(a.size):
        a[i] = b[i] + np.float32(0.5) * c[i]
