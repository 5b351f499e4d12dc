"""How long a solution takes, told without a clock.

What does not come to rest has to be given up at some time. A clock would do so sooner on a slow or
a busy machine than on a fast one, and results would depend on it. So the Newton steps of a solution
are counted, each with the time that it takes on one core. Of seven hard random maps the sum was
0.85 to 1.05 times the processor time, of five easy ones 1.1 to 1.35 times.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from .stencil import padded, turned

#: Seconds on one core (AMD EPYC 9004, 2.6 GHz), whatever the size of the grid and on each node, of
#: a Newton step besides its linear system and of an iteration of the linear solver; and those of an
#: operation of the exact one.
_STEP, _ITERATION, _OPERATION = (4e-3, 4e-6), (5e-4, 2.7e-7), 5e-11


@dataclass
class Effort:
    """What has been spent, in seconds on one core."""

    spent: float = 0.0


_counted: ContextVar[Effort | None] = ContextVar("effort", default=None)


@contextmanager
def counted(effort: Effort | None = None) -> Iterator[Effort]:
    """Count what Newton steps take from here on, beside what was spent, and nowhere else."""
    effort = Effort() if effort is None else effort
    before = _counted.set(effort)
    try:
        yield effort
    finally:
        _counted.reset(before)


def spend(node_shape: tuple[int, ...], iterations: int, operations: float) -> None:
    """Count a Newton step.

    ``iterations`` of the iterative linear solver were taken on a grid of so many nodes (z, y, x),
    or ``operations`` (multiplications and additions) of the exact one.
    """
    effort = _counted.get()
    if effort is not None:
        ny1, nx1 = node_shape[1:]
        across = nx1 * padded(ny1) if turned(node_shape) else ny1 * padded(nx1)
        nodes = node_shape[0] * across
        each, on_node = (s + iterations * i for s, i in zip(_STEP, _ITERATION, strict=True))
        effort.spent += each + on_node * nodes + _OPERATION * operations
