"""Stiffness of the sample's columns from the loaded thickness: regularised Gauss-Newton.

Sought are the logarithms m of the stiffness of the columns. With r the computed less the measured
thickness, J its derivative and D the differences between neighbouring columns, a step d minimises

    |W (r + J d)|^2 + alpha |D (m + d)|^2,

W the inverse of what r may be off by: the noise of the measured thickness and the error of the
mesh. Alpha is the largest for which what is then left, if the model were linear, is as large as
these (Morozov's discrepancy principle). J is that of a coarse mesh, r that of the finest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter

from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.stiffness.forward import (
    Columns,
    Model,
    Pressed,
    Sensitivity,
    carried,
    carrying,
)
from optical_palpation.stiffness.measurement import ThicknessSurface

Array = NDArray[np.float64]

#: Steps on the coarse mesh and on the finest one at most.
_COARSE_STEPS, _FINE_STEPS = 3, 4
#: What the coarse mesh may leave, as a share of the indentation: more than that is its own error.
_COARSE_ERROR = 0.02
#: Largest change of a logarithm in a step.
_LARGEST = 1.0
#: Largest change of the travel in a step, as a share of it.
_FARTHEST = 0.2
#: Tolerance of a given total force.
_FORCE = 0.01
#: A step counts as none if stiffness changes by less than this (root mean square).
_STILL = 0.01
#: Slope of the logarithm over one thickness of the layer from which stiffness has an edge.
_STEEP = 0.8
#: A step must leave less than this share of what was left before it.
_NO_GAIN = 0.98
#: Regularisation, in units that make both terms alike, from strong to weak.
_ALPHAS = 10.0 ** np.arange(1.0, -7.1, -0.5)
#: What is left may exceed the least that can be left by this factor where the noise is below that.
_NEAR_LEAST = 1.1


@dataclass(frozen=True, eq=False)
class Estimate:
    """What the thickness says of the sample.

    What is sought are the stiffness of the columns and, where the total force is given instead of
    it, the travel of the plate.

    Attributes
    ----------
    stiffness
        Logarithms of the stiffness factors of the columns, (y, x).
    travel
        Of the plate, mm.
    pressed
        Layer and sample of that stiffness on the finest mesh.
    misfit, tolerance
        Computed less measured thickness at the layer's nodes, and what it may be off by, mm.
    gain, gain_by_force
        How what is sought answers to the thickness, (sought, nodes), and to the force, (sought).
    covariance
        Of what is sought, by noise and mesh error, (sought, sought).
    sensitivity
        On the coarse mesh, by what is sought.
    refinement
        By this share of their difference the fine mesh is nearer to the truth than the coarse one.
    alpha
        Regularisation.
    solutions
        Forward solutions: number of elements and misfit over tolerance (root mean square) of each.
    """

    stiffness: Array
    travel: float
    pressed: Pressed
    misfit: Array
    tolerance: Array
    gain: Array
    gain_by_force: Array
    covariance: Array
    sensitivity: Sensitivity
    refinement: float
    alpha: float
    solutions: list[tuple[int, float]]


def invert(
    fine: Model,
    coarse: Model,
    measured: ThicknessSurface,
    start: Array,
    *,
    noise: float,
    total_force: float | None = None,
    smoothing: float | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Estimate:
    """Find the stiffness of the columns with which the model has the measured thickness.

    Parameters
    ----------
    fine, coarse
        The model on two meshes of the same columns.
    measured
        The loaded thickness.
    start
        Logarithms of stiffness factors to begin with, (y, x).
    noise
        Standard deviation of the measured surface at a node, mm.
    total_force
        On the window, mN. If it is given the travel of the plate is sought too.
    smoothing
        Alpha; by default that of the discrepancy principle.
    progress
        Called with the stage and the share of the load.

    Raises
    ------
    LoadNotReached
        If even the start cannot be pressed.
    """
    search = _Search(fine, coarse, measured, noise, total_force, smoothing, progress)
    sought = start.ravel()
    if total_force is not None:
        sought = np.append(sought, coarse.blocks.travel)
    return search.on_fine_mesh(search.on_coarse_mesh(sought))


@dataclass(frozen=True, eq=False)
class _System:
    """A linearised problem of least squares.

    ``jacobian`` (nodes, sought) of the misfit, ``weight`` of the nodes; ``by_force`` is the
    derivative of the total force and ``off`` what that is off by, both over its tolerance.
    """

    jacobian: Array
    misfit: Array
    weight: Array
    by_force: Array
    off: float


class _Search:
    """The state of a search for the stiffness."""

    def __init__(
        self,
        fine: Model,
        coarse: Model,
        measured: ThicknessSurface,
        noise: float,
        total_force: float | None,
        smoothing: float | None,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        self.fine, self.coarse, self.measured = fine, coarse, measured
        self.noise, self.force = noise, total_force
        self.smoothing, self.progress = smoothing, progress
        self.solutions: list[tuple[int, float]] = []
        #: Brings what is sought to the columns of elements of the coarse mesh and the travel.
        unknown = int(total_force is not None)
        self.expand = np.zeros((coarse.means.shape[0] + 1, coarse.means.shape[1] + unknown))
        self.expand[:-1, : coarse.means.shape[1]] = coarse.means
        self.expand[-1, -1] = unknown
        #: Brings values at the layer's nodes from the coarse mesh to the fine one.
        self.carry = carrying(coarse.layer, fine.layer)
        #: The fine mesh is off by the difference of the two over this.
        self.refinement = (coarse.layer.spacing[2] / fine.layer.spacing[2]) ** 2 - 1
        self.thickness = float(np.median(fine.layer.thickness))

    def split(self, sought: Array) -> tuple[Array, float]:
        """Return stiffness (y, x) and travel."""
        columns = self.fine.columns
        count = columns.shape[0] * columns.shape[1]
        travel = self.fine.blocks.travel if self.force is None else float(sought[-1])
        return sought[:count].reshape(columns.shape), travel

    def on_coarse_mesh(self, sought: Array) -> Array:
        """Steps on the coarse mesh, down to about the errors of that."""
        before = step = None
        for n in range(_COARSE_STEPS):
            pressed, sought = self._pressed(self.coarse, before, step, sought)
            misfit = pressed.misfit(self.measured)
            indentation = self.coarse.layer.thickness - pressed.surface[2]
            error = _COARSE_ERROR * float(np.sqrt(np.mean(indentation**2)))
            tolerance = np.full(misfit.shape, np.hypot(self.noise, error))
            weight = self._weight(pressed, tolerance)
            left = _rms(weight * misfit)
            self.solutions.append((pressed.stack.n_elements, left))
            if n > 0 and left <= 1.0:
                break
            sensitivity = pressed.sensitivity(self.measured).of(self.expand)
            system = self._system(sensitivity.thickness, sensitivity, misfit, weight, pressed)
            step, _, _ = self._step(system, sought)
            before, sought = sought, sought + step
        return sought

    def on_fine_mesh(self, sought: Array) -> Estimate:
        """Steps for the misfit of the fine mesh, with the sensitivity of the coarse one.

        The coarse mesh is solved once more at the start: after that the stiffness changes too
        little to change the sensitivity, or the error of the mesh.
        """
        before = step = None
        best: tuple[float, Array, Pressed, Array] | None = None
        stiffness, travel = self.split(sought)
        rough = self.coarse.pressed(stiffness, travel=travel)
        self.solutions.append((rough.stack.n_elements, np.nan))
        sensitivity = rough.sensitivity(self.measured).of(self.expand)
        jacobian = self.carry @ sensitivity.thickness
        tolerance: Array | None = None
        for _ in range(_FINE_STEPS + 1):
            pressed, sought = self._pressed(self.fine, before, step, sought)
            misfit = pressed.misfit(self.measured)
            if tolerance is None:
                tolerance = self._tolerance(misfit, rough.misfit(self.measured))
            weight = self._weight(pressed, tolerance)
            left = _rms(weight * misfit)
            self.solutions.append((pressed.stack.n_elements, left))
            if best is not None and left > _NO_GAIN * best[0]:
                break
            best = left, sought, pressed, misfit
            system = self._system(jacobian, sensitivity, misfit, weight, pressed)
            if left <= 1.0 and abs(system.off) <= 1.0:
                break
            step, _, _ = self._step(system, sought)
            if _rms(step) < _STILL:
                break
            before, sought = sought, sought + step
        assert best is not None
        assert tolerance is not None
        _, sought, pressed, misfit = best
        weight = self._weight(pressed, tolerance)
        system = self._system(jacobian, sensitivity, misfit, weight, pressed)
        _, alpha, normal = self._step(system, sought)
        covariance = np.asarray(np.linalg.inv(normal), dtype=float)
        stiffness, travel = self.split(sought)
        by_force = np.zeros(len(sought))
        if self.force is not None:
            by_force = covariance @ system.by_force / (_FORCE * self.force)
        return Estimate(
            stiffness=stiffness,
            travel=travel,
            pressed=pressed,
            misfit=misfit,
            tolerance=tolerance,
            gain=covariance @ (jacobian * weight.reshape(-1, 1) ** 2).T,
            gain_by_force=by_force,
            covariance=covariance,
            sensitivity=sensitivity,
            refinement=self.refinement,
            alpha=alpha,
            solutions=self.solutions,
        )

    def _pressed(
        self, model: Model, before: Array | None, step: Array | None, sought: Array
    ) -> tuple[Pressed, Array]:
        """Press, or where that fails, press after half of the last step."""
        elements = model.levels[-1].n_elements

        def report(_: object, load: float, __: object) -> None:
            if self.progress:
                count = len(self.solutions) + 1
                self.progress(f"solution {count}, {elements:,} elements", load)

        for attempt in range(4):
            stiffness, travel = self.split(sought)
            try:
                return model.pressed(stiffness, report, travel), sought
            except LoadNotReached:
                if before is None or step is None or attempt == 3:
                    raise
                step = 0.5 * step
                sought = before + step
        raise AssertionError

    def _tolerance(self, misfit: Array, rough: Array) -> Array:
        """What the misfit may be: noise, and the error of the mesh, from the coarse one's."""
        error = (misfit - carried(rough, self.coarse.layer, self.fine.layer)) / self.refinement
        reach = 0.5 * self.thickness / self.fine.layer.spacing[2]
        return np.sqrt(self.noise**2 + gaussian_filter(error**2, reach, mode="nearest"))

    def _weight(self, pressed: Pressed, tolerance: Array) -> Array:
        x, y, _ = pressed.surface.reshape(3, -1)
        return self.measured.covers(x, y).reshape(tolerance.shape) / tolerance

    def _system(
        self,
        jacobian: Array,
        sensitivity: Sensitivity,
        misfit: Array,
        weight: Array,
        pressed: Pressed,
    ) -> _System:
        if self.force is None:
            return _System(jacobian, misfit, weight, np.zeros(jacobian.shape[1]), 0.0)
        tolerance = _FORCE * self.force
        off = (pressed.force - self.force) / tolerance
        return _System(jacobian, misfit, weight, sensitivity.force / tolerance, off)

    def _step(self, system: _System, sought: Array) -> tuple[Array, float, Array]:
        """Return the step, alpha and the matrix of the normal equations."""
        stiffness, travel = self.split(sought)
        smooth = np.zeros((len(sought), len(sought)))
        smooth[: stiffness.size, : stiffness.size] = _roughness(
            self.fine.columns, stiffness, self.thickness
        )
        weighted = system.weight.reshape(-1, 1) * system.jacobian
        left = (system.weight * system.misfit).ravel()
        normal = weighted.T @ weighted + np.outer(system.by_force, system.by_force)
        rhs = -weighted.T @ left - system.by_force * system.off
        of_columns = np.trace(normal[: stiffness.size, : stiffness.size])
        unit = of_columns / np.trace(smooth)
        uneven = smooth @ sought
        hold = 1e-9 * of_columns / stiffness.size * np.eye(len(normal))

        def solved(alpha: float) -> tuple[Array, float, Array]:
            matrix = normal + alpha * unit * smooth + hold
            step = cho_solve(cho_factor(matrix), rhs - alpha * unit * uneven)
            return step, _rms(left + weighted @ step), matrix

        if self.smoothing is not None:
            alpha = self.smoothing
            step, _, matrix = solved(alpha)
        else:
            least = solved(_ALPHAS[-1])[1]
            target = max(1.0, _NEAR_LEAST * least)
            for alpha in _ALPHAS:
                step, remaining, matrix = solved(alpha)
                if remaining <= target:
                    break
        largest = np.full(len(sought), _LARGEST)
        largest[stiffness.size :] = _FARTHEST * travel
        return np.clip(step, -largest, largest), float(alpha), matrix


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _roughness(columns: Columns, stiffness: Array, thickness: float) -> Array:
    """D^T D: squares of the slopes of stiffness, edges that are there already counting less."""
    ny, nx = columns.shape
    parts = []
    for axis, (borders, count) in enumerate(((columns.y, ny), (columns.x, nx))):
        pitch = 0.5 * (borders[2:] - borders[:-2])
        slope = np.diff(stiffness, axis=axis) / np.expand_dims(pitch, 1 - axis)
        edge = 1 / np.sqrt(1 + (slope * thickness / _STEEP) ** 2)
        difference = sp.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count))
        one = sp.diags_array(1 / pitch) @ difference
        first, second = (one, sp.eye_array(nx)) if axis == 0 else (sp.eye_array(ny), one)
        parts.append(sp.diags_array(np.sqrt(edge.ravel())) @ sp.kron(first, second))
    whole = sp.csr_matrix(sp.vstack(parts))
    return (whole.T @ whole).toarray()
