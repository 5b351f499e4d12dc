"""What a running computation of stress reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from optical_palpation.mechanics.problem import LayerProblem


@dataclass(frozen=True)
class Progress:
    """What a running computation reports: the stage, the load reached and the work done.

    ``newton`` counts iterations; where it is None, ``load`` is the share of the stage that is done.
    """

    stage: str
    load: float
    newton: int | None
    message: str = ""


class Iterations:
    """Counts the Newton iterations of a computation, and reports them.

    Parameters
    ----------
    progress
        Called with a :class:`Progress` now and then, if given.
    """

    def __init__(self, progress: Callable[[Progress], None] | None) -> None:
        self._progress = progress
        self._newton = 0

    def __call__(
        self, level: LayerProblem, load: float, iteration: int, now: object, krylov: int
    ) -> None:
        """Report an iteration, as the solver calls ``on_iteration``."""
        self._newton += iteration > 0
        self.stage(f"{level.grid.n_elements:,} elements", load)

    def stage(self, name: str, load: float) -> None:
        """Report a stage."""
        if self._progress:
            self._progress(Progress(name, load, self._newton))
