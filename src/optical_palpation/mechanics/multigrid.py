"""Geometric multigrid for block stencils on the structured grid.

Chebyshev smoothing over 3 x 3 block Jacobi, trilinear interpolation between nested node sets of
any length, Galerkin coarse operators, exact factors on the coarsest level. Coarse unknowns are
constrained where the fine node they sit on is.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from . import stencil as st
from .direct import factors_of, sparse_matrix

Vector = NDArray[np.float32]

#: Unknowns below which the coarsest level is solved directly.
_COARSEST = 700
#: Chebyshev steps before and after the coarse correction.
_BEFORE, _AFTER = 3, 4
#: The smoother acts on the eigenvalues of D^-1 A from largest / _RANGE to largest.
_RANGE = 8.0


@dataclass(frozen=True)
class Transfer:
    """Linear interpolation between node sets along one axis.

    ``nodes`` are the fine indices of the coarse nodes; fine node n lies between coarse nodes
    ``low[n]`` and ``low[n] + 1`` with weight ``weight[n]`` of the latter; coarse node N reaches the
    fine nodes ``first[N] + s`` with weights ``table[N, s]``.
    """

    nodes: NDArray[np.intp]
    low: NDArray[np.intp]
    weight: Vector
    first: NDArray[np.intp]
    table: Vector

    @classmethod
    def build(cls, positions: NDArray[np.float64], nodes: NDArray[np.intp]) -> Transfer:
        """Interpolate from the subset ``nodes`` to all ``positions``."""
        coarse = positions[nodes]
        low = np.clip(np.searchsorted(coarse, positions, side="right") - 1, 0, len(nodes) - 2)
        weight = (positions - coarse[low]) / np.diff(coarse)[low]
        dense = np.zeros((len(nodes), len(positions)))
        dense[low, np.arange(len(positions))] = 1 - weight
        dense[low + 1, np.arange(len(positions))] += weight
        first = np.array([np.flatnonzero(row)[0] for row in dense])
        last = np.array([np.flatnonzero(row)[-1] for row in dense])
        width = int((last - first).max()) + 1
        # every node between the coarse neighbours is addressed, also where its weight is zero
        table = np.zeros((len(nodes), width + 2), np.float32)
        start = np.maximum(first - 1, 0)
        for n, f in enumerate(start):
            part = dense[n, f : f + width + 2]
            table[n, : len(part)] = part
        return cls(nodes, low, weight.astype(np.float32), start, table)


def coarse_nodes(count: int, halve: bool) -> NDArray[np.intp]:
    """Indices of the coarse nodes of an axis of ``count`` elements."""
    if not halve or count == 1:
        return np.arange(count + 1)
    return np.unique(np.round(np.linspace(0, count, count // 2 + 1)).astype(np.intp))


class Level:
    """One grid of the hierarchy with its work vectors."""

    def __init__(self, node_shape: tuple[int, int, int], transfers: tuple[Transfer, ...]) -> None:
        self.node_shape = node_shape
        self.transfers = transfers
        self.stencil = st.empty_stencil(node_shape)
        self.inverse = np.empty_like(self.stencil.diagonal)
        #: Solution, right-hand side, smoothing direction, residual.
        self.x, self.b, self.d, self.r = (st.halo_zeros(node_shape) for _ in range(4))
        #: Factors of the smoothing steps before and after the coarse correction.
        self.before = self.after = np.zeros((2, 0), np.float32)
        self.mode: Vector | None = None

    def prepare(self) -> None:
        """Invert the diagonal blocks and fit the smoother to the largest eigenvalue of D^-1 A."""
        st.invert_blocks(self.stencil.diagonal, self.inverse)
        steps = 2
        if self.mode is None:
            steps = 12
            rng = np.random.default_rng(0)
            self.mode = st.halo_zeros(self.node_shape)
            inside = st.interior(self.mode, self.node_shape)
            inside[:] = rng.standard_normal(inside.shape, np.float32)
        self.b[:] = 0
        jacobi = np.array([[0], [1]], np.float32)
        for _ in range(steps):
            st.subtract_product(self.stencil, self.mode, self.b, self.r)
            self._go_on(jacobi, True, self.r, self.mode)
            size = float(np.linalg.norm(self.mode.ravel()))
            if size == 0:  # nothing is free: one element deep, between glued faces
                self.mode, size = None, 1.0
                break
            self.mode /= np.float32(size)
        self.before, self.after = (_chebyshev(1.1 * size, count) for count in (_BEFORE, _AFTER))

    def smooth(self, from_zero: bool) -> None:
        """Chebyshev steps on x for the right-hand side b."""
        self._go_on(self.before if from_zero else self.after, from_zero, self.b, self.x)

    def residual(self) -> Vector:
        """Return b - S x, in r."""
        st.subtract_product(self.stencil, self.x, self.b, self.r)
        return self.r

    def _go_on(self, factors: Vector, from_zero: bool, b: Vector, x: Vector) -> None:
        """Go through smoothing steps on x for the right-hand side b."""
        keep, gain = factors
        st.smooth(self.stencil, self.inverse, keep, gain, from_zero, b, self.r, self.d, x)


def _chebyshev(largest: float, steps: int) -> Vector:
    """What each step keeps of the last one's direction, and its gain, (2, steps)."""
    high, low = largest, largest / _RANGE
    centre, half = 0.5 * (high + low), 0.5 * (high - low)
    sigma = centre / half
    rho = 1 / sigma
    keeps, gains = [0.0], [1 / centre]
    for _ in range(steps - 1):
        new = 1 / (2 * sigma - rho)
        keeps.append(new * rho)
        gains.append(2 * new / half)
        rho = new
    return np.array([keeps, gains], np.float32)


class Hierarchy:
    """All levels for one grid.

    Once the operator is stored in the stencil of the finest, ``update`` coarsens it and ``cycle``
    does a V-cycle. Between these, the vectors of all levels but ``mode`` are free for other use.
    """

    def __init__(
        self, positions: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
    ) -> None:
        """Build the levels for the node ``positions`` (z, y, x), mm."""
        self.levels: list[Level] = []
        while True:
            shape = tuple(len(p) for p in positions)
            sizes = [np.median(np.diff(p)) for p in positions]
            divisible = [s for s, p in zip(sizes, positions, strict=True) if len(p) > 2]
            last = 3 * np.prod(shape) <= _COARSEST or not divisible
            if last:
                self.levels.append(Level(shape, ()))  # type: ignore[arg-type]
                break
            chosen = [
                coarse_nodes(len(p) - 1, bool(s < 1.6 * min(divisible)))
                for p, s in zip(positions, sizes, strict=True)
            ]
            transfers = tuple(Transfer.build(p, n) for p, n in zip(positions, chosen, strict=True))
            self.levels.append(Level(shape, transfers))  # type: ignore[arg-type]
            positions = tuple(p[n] for p, n in zip(positions, chosen, strict=True))  # type: ignore[assignment]

    def update(self, free: NDArray[np.bool_]) -> None:
        """Coarsen the operator of the finest level, whose ``free`` unknowns are given."""
        for level, coarser in pairwise(self.levels):
            with st.threads_for(level.node_shape):
                level.prepare()
                tz, ty, tx = level.transfers
                free = free[np.ix_(np.arange(3), tz.nodes, ty.nodes, tx.nodes)]
                tables = [a for t in (tz, ty, tx) for a in (t.low, t.first, t.table)]
                planes = st.galerkin(level.stencil, coarser.node_shape, tables)
                for k, plane in enumerate(planes):
                    st.constrain(plane, free, k)
                    st.store(plane, coarser.stencil, k)
        coarsest = self.levels[-1]
        self._free = free
        matrix = sparse_matrix(st.expanded(coarsest.stencil, coarsest.node_shape[2]), free)
        self._factors = factors_of(matrix, coarsest.node_shape, np.float32)

    def cycle(self) -> Vector:
        """One V-cycle from zero for the ``b`` of the finest level; returns its ``x``."""
        self._cycle(0)
        return self.levels[0].x

    def compliance(self) -> float:
        """Return b^T A^-1 b for a smooth ``b`` of the finest level, by a V-cycle on the second."""
        finest = self.levels[0]
        if len(self.levels) == 1:
            return float(np.vdot(finest.b, self.cycle()))
        second = self.levels[1]
        with st.threads_for(finest.node_shape):
            st.restrict(finest.b, second.b, *_to_coarse(finest))
        self._cycle(1)
        return float(np.vdot(second.b, second.x))

    def _cycle(self, first: int) -> None:
        """One V-cycle on the levels from ``first`` on, from the ``b`` of that to its ``x``."""
        levels = self.levels[first:]
        for level, coarser in pairwise(levels):
            with st.threads_for(level.node_shape):
                level.smooth(from_zero=True)
                st.restrict(level.residual(), coarser.b, *_to_coarse(level))
        coarsest = levels[-1]
        rhs = np.where(self._free, st.interior(coarsest.b, coarsest.node_shape), 0.0)
        solution = self._factors.solve(rhs.reshape(-1, 1))
        st.interior(coarsest.x, coarsest.node_shape)[:] = solution.reshape(self._free.shape)
        for coarser, level in pairwise(levels[::-1]):
            with st.threads_for(level.node_shape):
                to_fine = (a for t in level.transfers for a in (t.low, t.weight))
                st.prolong_add(coarser.x, level.x, *to_fine)
                level.smooth(from_zero=False)


def _to_coarse(level: Level) -> list[NDArray]:
    return [a for t in level.transfers for a in (t.first, t.table)]
