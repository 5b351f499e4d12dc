"""Stiffness of the sample's columns from the loaded thickness: regularised Gauss-Newton.

Sought are the logarithms m of the stiffness of the columns and, from several loads, the heights h
of the unloaded surface at their corners. With r the computed less the measured thickness at all
loads, J its derivative and D the differences between neighbours, a step d minimises

    |W (r + J d)|^2 + alpha |D ((m, h) + d)|^2,

W the inverse of what r may be off by: the noise of the measured thickness and the error of the
mesh. Of that error, as two meshes tell it, half is taken off r. Alpha is the largest for which what
is then left, if the model were linear, is as large as W says (Morozov's discrepancy principle); of
m and h it is in units of what J makes of them. J is that of a coarse mesh, r that of the finest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.ndimage import gaussian_filter

from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.stiffness.forward import (
    Columns,
    Model,
    Pressed,
    Sensitivity,
    Sought,
    carried,
    carrying,
)
from optical_palpation.stiffness.measurement import ThicknessSurface

Array = NDArray[np.float64]

#: Steps on the coarse mesh and on the finest one at most; more on the coarse one towards a travel.
_COARSE_STEPS, _FINE_STEPS = 3, 3
_TRAVELLING_STEPS = 8
#: What the coarse mesh may leave, as a share of the indentation: more than that is its own error.
_COARSE_ERROR = 0.02
#: Largest change of a logarithm in a step.
_LARGEST = 1.0
#: Largest change of a height in a step, in thicknesses of the layer.
_HIGHEST = 0.2
#: Largest change of the travel in a step, as a share of it.
_FARTHEST = 0.2
#: Tolerance of a given total force.
FORCE = 0.01
#: A step counts as none if stiffness, and heights in thicknesses of the layer, change by less than
#: this (root mean square).
_STILL = 0.01
#: Slope of the logarithm over one thickness of the layer from which stiffness has an edge.
_STEEP = 0.8
#: A step must leave less than this share of what was left before it.
_NO_GAIN = 0.95
#: Regularisation, in units that make both terms alike, from strong to weak.
_ALPHAS = 10.0 ** np.arange(1.0, -7.1, -0.5)
#: What is left may exceed the least that can be left by this factor where the noise is below that.
_NEAR_LEAST = 1.1
#: Share of what is left by which the derivative of the coarse mesh may be wrong on the fine one: a
#: step that is to leave less follows what it does not know.
_UNKNOWN = 0.5
#: Share of the estimated error of the mesh that is taken off the misfit: the true one lies anywhere
#: between none of the estimate and all of it.
_TAKEN_OFF = 0.5


@dataclass(frozen=True, eq=False)
class Order:
    """How what is sought is written in one row: stiffness, relief, travels.

    ``relief`` and ``travels`` say whether these are sought; ``given`` are the travels, mm, to begin
    with or as they are known.
    """

    columns: Columns
    relief: bool
    travels: bool
    given: tuple[float, ...]

    @property
    def of_stiffness(self) -> slice:
        """Where the stiffness of the columns is."""
        return slice(0, self.columns.shape[0] * self.columns.shape[1])

    @property
    def of_relief(self) -> slice:
        """Where the heights are."""
        first = self.of_stiffness.stop
        return slice(first, first + self.relief * self.columns.corners[0] * self.columns.corners[1])

    @property
    def of_travels(self) -> slice:
        """Where the travels are."""
        first = self.of_relief.stop
        return slice(first, first + self.travels * len(self.given))

    @property
    def size(self) -> int:
        """How much is sought."""
        return self.of_travels.stop

    def row(self, sought: Sought) -> Array:
        """Write what is sought in a row."""
        parts = [sought.stiffness.ravel()]
        if self.relief:
            assert sought.relief is not None
            parts.append(sought.relief.ravel())
        if self.travels:
            parts.append(np.array(sought.travels))
        return np.concatenate(parts)

    def read(self, row: Array) -> Sought:
        """Read it back."""
        relief = row[self.of_relief].reshape(self.columns.corners) if self.relief else None
        travels = tuple(row[self.of_travels].tolist()) if self.travels else self.given
        return Sought(row[self.of_stiffness].reshape(self.columns.shape), travels, relief)


@dataclass(frozen=True, eq=False)
class Estimate:
    """What the thickness says of the sample.

    What is sought are the stiffness of the columns, the relief where it is unknown, and where total
    forces are given instead of them the travels of the plate.

    Attributes
    ----------
    sought, order
        What was found, and how it is written in a row.
    pressed
        Layer and sample of that kind on the finest mesh, at each load.
    misfit, tolerance
        Computed less measured thickness at the layer's nodes at each load, half the estimated error
        of the mesh taken off, and what it may be off by, (loads, ny + 1, nx + 1), mm.
    measured
        Whether the thickness was measured there: elsewhere the misfit is that of a surface that
        goes straight on.
    gain, gain_by_force
        How what is sought answers to the thickness, (sought, loads x nodes), and to the total
        forces, (sought, loads).
    covariance
        Of what is sought, by noise and mesh error, (sought, sought).
    unfinished
        The step that would come next, (sought,).
    sensitivities
        At each load, on the coarse mesh, by what is sought.
    refinement
        The fine mesh is off by the difference of the two over this, as their volumes tell.
    alpha
        Regularisation.
    solutions
        Forward solutions: number of elements and misfit over tolerance (root mean square) of each.
    """

    sought: Sought
    order: Order
    pressed: list[Pressed]
    misfit: Array
    tolerance: Array
    measured: NDArray[np.bool_]
    gain: Array
    gain_by_force: Array
    covariance: Array
    unfinished: Array
    sensitivities: list[Sensitivity]
    refinement: float
    alpha: float
    solutions: list[tuple[int, float]]

    @property
    def over_tolerance(self) -> float:
        """Misfit over what it may be off by, root mean square of where it was measured."""
        return _rms((self.misfit / self.tolerance)[self.measured])


def invert(
    fine: Model,
    coarse: Model,
    measured: Sequence[ThicknessSurface],
    start: Sought,
    *,
    total_forces: Sequence[float] | None = None,
    smoothing: float | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Estimate:
    """Find the stiffness of the columns with which the model has the measured thickness.

    Parameters
    ----------
    fine, coarse
        The model on two meshes of the same columns.
    measured
        The loaded thickness at each load.
    start
        What to begin with; its relief is sought if it has one.
    total_forces
        On the window at each load, mN. If they are given the travels are sought too.
    smoothing
        Alpha; by default that of the discrepancy principle.
    progress
        Called with the stage and the share of the load.

    Raises
    ------
    LoadNotReached
        If even the start cannot be pressed.
    """
    search = _Search(fine, coarse, measured, start, total_forces, smoothing, progress)
    return search.on_fine_mesh(search.on_coarse_mesh(search.order.row(start)))


@dataclass(frozen=True, eq=False)
class _System:
    """A linearised problem of least squares.

    The derivative of the misfit is that of the coarse mesh, ``thickness`` of each load (coarse
    nodes, sought), times what brings it to the nodes, ``carry`` (nodes, coarse nodes): apart, they
    are far smaller than together. ``weight`` is that of the misfit; ``by_force`` (loads, sought)
    are the derivatives of the total forces and ``off`` what these are off by, both times their
    weight; no loads where travels are given.
    """

    thickness: Sequence[Array]
    carry: sp.csr_matrix
    misfit: Array
    weight: Array
    by_force: Array
    off: Array

    @property
    def left(self) -> Array:
        """Weighted misfit, (loads x nodes)."""
        return (self.weight * self.misfit).ravel()

    def change(self, step: Array) -> Array:
        """Change of the weighted misfit by a step."""
        return self.weight.ravel() * np.concatenate(
            [self.carry @ (s @ step) for s in self.thickness]
        )

    def normal(self) -> Array:
        """Matrix of the normal equations without smoothing, (sought, sought)."""
        out = self.by_force.T @ self.by_force
        for by_sought, weight in zip(self.thickness, self.weight, strict=True):
            weighted = sp.diags_array(weight.ravel()) @ self.carry
            out += by_sought.T @ ((weighted.T @ weighted) @ by_sought)
        return np.asarray(out)

    def falling(self) -> Array:
        """Direction in which the squares of what is left fall, (sought)."""
        left = np.split(self.weight.ravel() * self.left, len(self.thickness))
        out = -self.by_force.T @ self.off
        for by_sought, part in zip(self.thickness, left, strict=True):
            out -= by_sought.T @ (self.carry.T @ part)
        return np.asarray(out)

    def gain(self, covariance: Array) -> Array:
        """How what is sought answers to the thickness, (sought, loads x nodes)."""
        return np.concatenate(
            [
                (covariance @ by_sought.T) @ (self.carry.T @ sp.diags_array(weight.ravel() ** 2))
                for by_sought, weight in zip(self.thickness, self.weight, strict=True)
            ],
            axis=1,
        )


class _Search:
    """The state of a search for the stiffness."""

    def __init__(
        self,
        fine: Model,
        coarse: Model,
        measured: Sequence[ThicknessSurface],
        start: Sought,
        total_forces: Sequence[float] | None,
        smoothing: float | None,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        self.fine, self.coarse, self.measured = fine, coarse, measured
        self.smoothing, self.progress = smoothing, progress
        self.forces = np.array(total_forces or [])
        relief, unknown = start.relief is not None, total_forces is not None
        self.order = Order(fine.columns, relief, unknown, start.travels)
        #: Standard deviation of each measured surface at a node.
        self.noise = np.array([m.noise / np.sqrt(m.pixels) for m in measured])[:, None, None]
        self.solutions: list[tuple[int, float]] = []
        #: Number of the last alpha.
        self.weakness = len(_ALPHAS) // 2
        travels = unknown * len(measured)
        #: Brings what is sought to the parameters of the coarse mesh at each load.
        self.expand = [coarse.derivatives(relief, travels, n) for n in range(len(measured))]
        #: Brings values at the layer's nodes from the coarse mesh to the fine one.
        self.carry = carrying(coarse.layer, fine.layer)
        #: The fine mesh is off by the difference of the two over this, if its elements are smaller
        #: along all axes as they are laterally. Through the depth they may not be: the misfit is
        #: then held to less than the error of the mesh.
        self.refinement = (coarse.layer.spacing[2] / fine.layer.spacing[2]) ** 2 - 1
        self.thickness = fine.layer.typical_thickness

    def on_coarse_mesh(self, row: Array) -> Array:
        """Steps on the coarse mesh, down to about the errors of that.

        A step that leaves more than there was before is halved; but where travels are sought, steps
        to and fro are the way to a total force.
        """
        travels = self.order.travels
        before = step = None
        best, better = (np.inf, row), False
        here = carrying(self.coarse.layer, self.coarse.layer)
        for n in range(_TRAVELLING_STEPS if travels else _COARSE_STEPS):
            pressed, row = self._pressed(self.coarse, before, step, row)
            misfit = self._misfit(pressed)
            indentation = np.stack([self.coarse.layer.thickness - p.surface[2] for p in pressed])
            error = _COARSE_ERROR * np.sqrt(np.mean(indentation**2, axis=(1, 2), keepdims=True))
            tolerance = np.hypot(self.noise, error) * np.ones(misfit.shape)
            weight = self._weight(pressed, tolerance)
            left = _left(weight * misfit, weight)
            self.solutions.append((pressed[-1].stack.n_elements, left))
            off = _rms(self._off(pressed))
            if n > 0 and max(left, off) <= 1.0:
                return row
            better = np.hypot(left, off) < best[0]
            if better:
                best = float(np.hypot(left, off)), row
            if better or travels:
                system = self._system(self._sensitivities(pressed), here, misfit, weight, pressed)
                step, _, _ = self._step(system, row)
                before = row
            else:
                assert before is not None  # the first one is always better
                step = 0.5 * (row - before)
            row = before + step
        return row if better and not travels else best[1]

    def on_fine_mesh(self, row: Array) -> Estimate:
        """Steps for the misfit of the fine mesh, with the sensitivity of the coarse one.

        Each is judged by the error of the mesh, which the coarse mesh tells for the same stiffness:
        for that of the start it may be several times as large.
        """
        before = step = None
        best: tuple[Array, list[Pressed], Array] | None = None
        sensitivities: list[Sensitivity] = []
        of_mesh = tolerance = np.zeros(0)
        for _ in range(_FINE_STEPS + 1):
            pressed, row = self._pressed(self.fine, before, step, row)
            own = self._misfit(pressed)
            try:
                rough = self.coarse.pressed(self.order.read(row))
            except LoadNotReached:
                if best is None:
                    raise
            else:  # otherwise the error of the mesh is that of the step before
                self.solutions.append((rough[-1].stack.n_elements, np.nan))
                sensitivities = sensitivities or self._sensitivities(rough)
                of_mesh, tolerance = self._error_of_mesh(own, self._misfit(rough))
            misfit = own + of_mesh
            weight = self._weight(pressed, tolerance)
            left = _left(weight * misfit, weight)
            self.solutions.append((pressed[-1].stack.n_elements, left))
            off = _rms(self._off(pressed))
            whole, least = np.hypot(left, off), np.inf
            if best is not None:
                _, before_it, its_own = best
                was = _left(self._weight(before_it, tolerance) * (its_own + of_mesh), weight)
                least = np.hypot(was, _rms(self._off(before_it)))
            if whole < least:
                best = row, pressed, own
            if whole >= _NO_GAIN * least or max(left, off) <= 1.0:
                break
            system = self._system(sensitivities, self.carry, misfit, weight, pressed)
            step, _, _ = self._step(system, row, _UNKNOWN * left)
            change = step[: self.order.of_travels.start].copy()
            change[self.order.of_relief] /= self.thickness
            if _rms(change) < _STILL:
                break
            before, row = row, row + step
        assert best is not None
        row, pressed, own = best
        misfit = own + of_mesh
        weight = self._weight(pressed, tolerance)
        system = self._system(sensitivities, self.carry, misfit, weight, pressed)
        unfinished, alpha, factor = self._step(system, row)
        covariance = _inverse(factor)
        more = self.fine.levels[-1].n_elements / self.coarse.levels[-1].n_elements
        return Estimate(
            sought=self.order.read(row),
            order=self.order,
            pressed=pressed,
            misfit=misfit,
            tolerance=tolerance,
            measured=weight > 0,
            gain=system.gain(covariance),
            gain_by_force=covariance @ system.by_force.T * self._per_force(weight),
            covariance=covariance,
            unfinished=unfinished,
            sensitivities=sensitivities,
            refinement=more ** (2 / 3) - 1,
            alpha=alpha,
            solutions=self.solutions,
        )

    def _pressed(
        self, model: Model, before: Array | None, step: Array | None, row: Array
    ) -> tuple[list[Pressed], Array]:
        """Press, or where that fails, press after half of the last step."""
        elements = model.levels[-1].n_elements

        def report(_: object, load: float, __: object) -> None:
            if self.progress:
                count = len(self.solutions) + 1
                self.progress(f"solution {count}, {elements:,} elements", load)

        for attempt in range(4):
            try:
                return model.pressed(self.order.read(row), report), row
            except LoadNotReached:
                if before is None or step is None or attempt == 3:
                    raise
                step = 0.5 * step
                row = before + step
        raise AssertionError

    def _misfit(self, pressed: list[Pressed]) -> Array:
        return np.stack([p.misfit(m) for p, m in zip(pressed, self.measured, strict=True)])

    def _sensitivities(self, pressed: list[Pressed]) -> list[Sensitivity]:
        """Sensitivities of the coarse mesh, by what is sought."""
        return [
            p.sensitivity(m, self.order.relief).of(expand)
            for p, m, expand in zip(pressed, self.measured, self.expand, strict=True)
        ]

    def _error_of_mesh(self, misfit: Array, rough: Array) -> tuple[Array, Array]:
        """Return what a finer mesh would add to the misfit, and what the misfit may be off by."""
        coarse = [carried(values, self.coarse.layer, self.fine.layer) for values in rough]
        error = (misfit - np.stack(coarse)) / self.refinement
        reach = 0.5 * self.thickness / self.fine.layer.spacing[2]
        near = gaussian_filter(error**2, reach, mode="nearest", axes=(1, 2))
        return _TAKEN_OFF * error, np.sqrt(self.noise**2 + near)

    def _weight(self, pressed: list[Pressed], tolerance: Array) -> Array:
        there = [
            measured.covers(*p.surface.reshape(3, -1)[:2])
            for p, measured in zip(pressed, self.measured, strict=True)
        ]
        return np.stack(there).reshape(tolerance.shape) / tolerance

    def _system(
        self,
        sensitivities: list[Sensitivity],
        carry: sp.csr_matrix,
        misfit: Array,
        weight: Array,
        pressed: list[Pressed],
    ) -> _System:
        thickness = [s.thickness for s in sensitivities]
        if not self.forces.size:
            nothing = np.zeros((0, self.order.size))
            return _System(thickness, carry, misfit, weight, nothing, np.zeros(0))
        per_force = self._per_force(weight)
        off = (np.array([p.force for p in pressed]) - self.forces) * per_force
        by_force = np.stack([s.force for s in sensitivities]) * per_force[:, None]
        return _System(thickness, carry, misfit, weight, by_force, off)

    def _off(self, pressed: list[Pressed]) -> Array:
        """What the total forces are off by, over their tolerance; none where travels are given."""
        if not self.forces.size:
            return np.zeros(0)
        return (np.array([p.force for p in pressed]) / self.forces - 1) / FORCE

    def _per_force(self, weight: Array) -> Array:
        """Weight of the forces, 1/mN: each counts as much as the thickness at all nodes.

        The error of the mesh is alike at many of them, and they would outvote it.
        """
        return np.sqrt(np.count_nonzero(weight)) / (FORCE * self.forces)

    def _step(
        self, system: _System, row: Array, unknown: float = 0.0
    ) -> tuple[Array, float, tuple[Array, bool]]:
        """Return the step, alpha and the Cholesky factor of the normal equations.

        ``unknown`` is what the linear model does not know of what a step leaves.
        """
        sought, order = self.order.read(row), self.order
        normal, left, falling = system.normal(), system.left, system.falling()
        # in units of what the data say of each kind
        parts, held = [], np.zeros(len(row))
        rough = [(order.of_stiffness, _roughness(order.columns, sought.stiffness, self.thickness))]
        if sought.relief is not None:
            rough.append((order.of_relief, _slopes(order.columns)))
        for place, squares in rough:
            known = float(np.trace(normal[place, place]))
            parts.append(known / float(squares.trace()) * squares)
            held[place] = 1e-9 * known / squares.shape[0]
        held[order.of_travels] = held[0]
        beyond = len(row) - order.of_relief.stop
        smooth = sp.csr_matrix(sp.block_diag([*parts, sp.csr_matrix((beyond, beyond))]))
        uneven = smooth @ row

        def solved(alpha: float) -> tuple[Array, float, tuple[Array, bool]]:
            added = sp.coo_matrix(alpha * smooth + sp.diags_array(held))
            matrix = normal.copy()
            matrix[added.row, added.col] += added.data
            factor = cho_factor(matrix)
            step = cho_solve(factor, falling - alpha * uneven)
            return step, _left(left + system.change(step), system.weight), factor

        if self.smoothing is not None:
            alpha = self.smoothing
            step, _, factor = solved(alpha)
        else:
            found = solved(_ALPHAS[-1])
            target = max(1.0, _NEAR_LEAST * found[1], float(np.hypot(found[1], unknown)))

            def weak_enough(number: int) -> bool:
                nonlocal found
                tried = solved(_ALPHAS[number])
                if tried[1] <= target:
                    found = tried
                return tried[1] <= target

            # The weaker, the less is left. An alpha is mostly that of the step before.
            self.weakness = first(weak_enough, len(_ALPHAS) - 1, self.weakness)
            alpha = _ALPHAS[self.weakness]
            step, _, factor = found
        largest = np.full(len(row), _LARGEST)
        largest[order.of_relief] = _HIGHEST * self.thickness
        if order.travels:
            largest[order.of_travels] = _FARTHEST * np.array(sought.travels)
        return np.clip(step, -largest, largest), float(alpha), factor


def first(holds: Callable[[int], bool], last: int, guess: int) -> int:
    """Return the first number that something holds for, as for all after it up to ``last``.

    That it holds for the last one is known. Where the guess is right it is asked twice at the most,
    where the guess is off by one three times; then bisection goes on.
    """
    low, high, number = 0, last, min(guess, last - 1)
    asked = 0
    while low < high:
        asked += 1
        if holds(number):
            high = number
            beside = high - 1
        else:
            low = beside = number + 1
        number = beside if low <= beside and asked <= 2 else (low + high) // 2
    return high


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _left(weighted: Array, weight: Array) -> float:
    """Root mean square of a weighted misfit, of the nodes that have a weight."""
    return float(np.sqrt(np.sum(weighted**2) / max(int(np.count_nonzero(weight)), 1)))


def _inverse(factor: tuple[Array, bool]) -> Array:
    """Inverse of the matrix of which this is the (upper) Cholesky factor."""
    half, failed = lapack.dpotri(factor[0])
    if failed:
        raise np.linalg.LinAlgError("the matrix is singular")
    return np.asarray(np.triu(half) + np.triu(half, 1).T, dtype=float)


def _roughness(columns: Columns, stiffness: Array, thickness: float) -> sp.csr_matrix:
    """D^T D: squares of the slopes of stiffness, edges that are there already counting less."""
    whole = []
    for axis, borders in enumerate((columns.y, columns.x)):
        pitch = 0.5 * (borders[2:] - borders[:-2])
        slope = np.diff(stiffness, axis=axis) / np.expand_dims(pitch, 1 - axis)
        edge = 1 / np.sqrt(1 + (slope * thickness / _STEEP) ** 2)
        whole.append(sp.diags_array(np.sqrt(edge.ravel())) @ _differences(pitch, axis, edge.shape))
    matrix = sp.csr_matrix(sp.vstack(whole))
    return sp.csr_matrix(matrix.T @ matrix)


def _slopes(columns: Columns) -> sp.csr_matrix:
    """D^T D: squares of the slopes of heights at the corners."""
    ny, nx = columns.corners
    matrix = sp.csr_matrix(
        sp.vstack(
            [
                _differences(np.diff(columns.y), 0, (ny - 1, nx)),
                _differences(np.diff(columns.x), 1, (ny, nx - 1)),
            ]
        )
    )
    return sp.csr_matrix(matrix.T @ matrix)


def _differences(pitch: Array, axis: int, shape: tuple[int, ...]) -> sp.csr_matrix:
    """Slopes (of ``shape``) of values in one row between neighbours along an axis."""
    count = len(pitch)
    steps = sp.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count, count + 1))
    one = sp.diags_array(1 / pitch) @ steps
    other = sp.eye_array(shape[1 - axis])
    return sp.csr_matrix(sp.kron(one, other) if axis == 0 else sp.kron(other, one))
