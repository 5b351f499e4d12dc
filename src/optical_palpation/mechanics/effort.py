"""How long a solution takes, told without a clock.

What does not come to rest has to be given up at some time. A clock would do so sooner on a slow or
a busy machine than on a fast one, and results would depend on it. So the Newton steps of a solution
are counted, each with the time that it takes on one core. Of ten random maps, easy ones and hard
ones, the sum was 0.8 to 1.3 times the processor time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from .stencil import padded, turned

#: Seconds on one core (AMD EPYC 9004, 2.6 GHz) of a Newton step: whatever its size, and besides its
#: linear system on each node; of an iteration of the linear solver on a node; and of an operation
#: of the exact one.
_STEP, _ON_NODE, _ITERATION, _OPERATION = 1e-3, 3e-6, 4e-7, 9e-11


@dataclass
class Effort:
    """What has been spent, in seconds on one core."""

    spent: float = 0.0


_counted: ContextVar[Effort | None] = ContextVar("effort", default=None)


@contextmanager
def counted() -> Iterator[Effort]:
    """Count what Newton steps take from here on."""
    effort = Effort()
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
        on_node = _ON_NODE + _ITERATION * iterations
        effort.spent += _STEP + on_node * nodes + _OPERATION * operations
