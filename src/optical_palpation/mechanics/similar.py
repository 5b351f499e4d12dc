"""A layer is guided by a similar one that was solved before it.

It is loaded from rest as without that, because friction remembers the path of loading. What the
other layer did only says where Newton's method begins at each load.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from .imprint import Imprint
from .path import Guide
from .problem import LayerProblem, LayerState

#: Shape of the nodes, and extent along x and y in nm: grids on which states may be compared.
_Key = tuple[int, ...]


@dataclass
class Similar:
    """How the layer solved last was loaded and carried from grid to grid; at first, none was.

    A layer of another extent or of other elements is solved as without it.
    """

    _paths: dict[_Key, tuple[float, list[LayerState]]] = field(default_factory=dict)
    _moves: dict[_Key, tuple[float, LayerState, LayerState]] = field(default_factory=dict)
    _imprint: _KeptImprint | None = None

    def guides(self, problem: LayerProblem) -> bool:
        """Whether the last layer was loaded on the grid of a problem, or carried to it."""
        return _key(problem) in self._paths or _key(problem) in self._moves

    def guide(self, problem: LayerProblem) -> Guide[LayerState] | None:
        """The load path of the last layer on the grid of a problem, if it was followed there."""
        if _key(problem) not in self._paths:
            return None
        modulus, path = self._paths[_key(problem)]
        ratio = problem.shear_modulus / modulus
        return Guide([state.load for state in path], lambda n: _stiffer(path[n], ratio))

    def moved(self, problem: LayerProblem, carried: LayerState) -> LayerState | None:
        """Move a layer that was carried to a grid as the last one moved after that."""
        if _key(problem) not in self._moves:
            return None
        modulus, *states = self._moves[_key(problem)]
        ratio = problem.shear_modulus / modulus
        return carried.following(*(_stiffer(state, ratio) for state in states))

    def imprint(self, made: Imprint) -> Imprint:
        """The imprint of the last layer if it is the same, and is smoothed already; else this."""
        of_maps = {it.name: getattr(made, it.name) for it in fields(made)}
        if self._imprint is None or not self._imprint.has(of_maps):
            self._imprint = _KeptImprint(**of_maps)
        return self._imprint

    def followed(self, problem: LayerProblem, path: list[LayerState]) -> None:
        """Remember a load path."""
        self._paths[_key(problem)] = problem.shear_modulus, path

    def settled(self, problem: LayerProblem, carried: LayerState, settled: LayerState) -> None:
        """Remember a layer as it was carried to a grid, and in equilibrium there."""
        self._moves[_key(problem)] = problem.shear_modulus, carried, settled

    def become(self, other: Similar) -> None:
        """Guide as another one does."""
        self._paths, self._moves = other._paths, other._moves


@dataclass(frozen=True, eq=False)
class _KeptImprint(Imprint):
    """An imprint that keeps what it has been smoothed to."""

    @cached_property
    def _smoothed(self) -> dict[float, Imprint]:
        return {}

    def smoothed(self, sigma: float) -> Imprint:
        """Return the imprint smoothed by a Gaussian of standard deviation ``sigma``, mm."""
        if sigma not in self._smoothed:
            self._smoothed[sigma] = super().smoothed(sigma)
        return self._smoothed[sigma]

    def has(self, maps: dict[str, Any]) -> bool:
        """Whether these are its fields."""
        return all(np.array_equal(getattr(self, name), of) for name, of in maps.items())


def _key(problem: LayerProblem) -> _Key:
    grid = problem.grid
    extent = grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]
    return *grid.node_shape, *(round(1e6 * float(at)) for at in extent)


def _stiffer(state: LayerState, ratio: float) -> LayerState:
    """The state of a layer whose moduli are larger by a ratio."""
    return replace(state, p=ratio * state.p, normal_force=ratio * state.normal_force)
