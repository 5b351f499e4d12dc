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

    Attributes
    ----------
    stiffness
        Logarithms of the stiffness factors of the columns, (y, x).
    pressed
        Layer and sample of that stiffness on the finest mesh.
    misfit, tolerance
        Computed less measured thickness at the layer's nodes, and what it may be off by, mm.
    gain
        Matrix (columns, coarse nodes) by which stiffness answers to the thickness.
    covariance
        Of the stiffness by noise and mesh error, (columns, columns).
    sensitivity
        On the coarse mesh, by the columns.
    refinement
        By this share of their difference the fine mesh is nearer to the truth than the coarse one.
    alpha
        Regularisation.
    solutions
        Forward solutions: number of elements and misfit over tolerance (root mean square) of each.
    """

    stiffness: Array
    pressed: Pressed
    misfit: Array
    tolerance: Array
    gain: Array
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
    smoothing
        Alpha; by default that of the discrepancy principle.
    progress
        Called with the stage and the share of the load.

    Raises
    ------
    LoadNotReached
        If even the start cannot be pressed.
    """
    search = _Search(fine, coarse, measured, noise, smoothing, progress)
    stiffness = search.on_coarse_mesh(start)
    return search.on_fine_mesh(stiffness)


class _Search:
    """The state of a search for the stiffness."""

    def __init__(
        self,
        fine: Model,
        coarse: Model,
        measured: ThicknessSurface,
        noise: float,
        smoothing: float | None,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        self.fine, self.coarse, self.measured = fine, coarse, measured
        self.noise, self.smoothing, self.progress = noise, smoothing, progress
        self.solutions: list[tuple[int, float]] = []
        #: Brings values at the layer's nodes from the coarse mesh to the fine one.
        self.carry = carrying(coarse.layer, fine.layer)
        #: The fine mesh is off by the difference of the two over this.
        self.refinement = (coarse.layer.spacing[2] / fine.layer.spacing[2]) ** 2 - 1
        self.thickness = float(np.median(fine.layer.thickness))

    def on_coarse_mesh(self, stiffness: Array) -> Array:
        """Steps on the coarse mesh, down to about the errors of that."""
        before = step = None
        for n in range(_COARSE_STEPS):
            pressed, stiffness = self._pressed(self.coarse, before, step, stiffness)
            misfit = pressed.misfit(self.measured)
            indentation = self.coarse.layer.thickness - pressed.surface[2]
            error = _COARSE_ERROR * float(np.sqrt(np.mean(indentation**2)))
            tolerance = np.full(misfit.shape, np.hypot(self.noise, error))
            weight = self._weight(pressed, tolerance)
            left = _rms(weight * misfit)
            self.solutions.append((pressed.stack.n_elements, left))
            if n > 0 and left <= 1.0:
                break
            jacobian = pressed.sensitivity(self.measured).thickness @ self.coarse.means
            step, _, _ = self._step(jacobian, misfit, weight, stiffness)
            before, stiffness = stiffness, stiffness + step
        return stiffness

    def on_fine_mesh(self, stiffness: Array) -> Estimate:
        """Steps for the misfit of the fine mesh, with the sensitivity of the coarse one.

        Both meshes are solved for the first two steps. After that the stiffness changes too little
        to change the sensitivity, or the error of the mesh.
        """
        before = step = None
        best: tuple[float, Array, Pressed, Array] | None = None
        for n in range(_FINE_STEPS + 1):
            pressed, stiffness = self._pressed(self.fine, before, step, stiffness)
            misfit = pressed.misfit(self.measured)
            if n < 2:
                rough = self.coarse.pressed(stiffness)
                tolerance = self._tolerance(misfit, rough.misfit(self.measured))
                self.solutions.append((rough.stack.n_elements, np.nan))
                best = None  # of another tolerance
            weight = self._weight(pressed, tolerance)
            left = _rms(weight * misfit)
            self.solutions.append((pressed.stack.n_elements, left))
            if best is not None and left > _NO_GAIN * best[0]:
                break
            best = left, stiffness, pressed, misfit
            if left <= 1.0 and n > 0:
                break
            if n < 2:
                sensitivity = rough.sensitivity(self.measured)
                jacobian = self.carry @ sensitivity.thickness @ self.coarse.means
            step, alpha, _ = self._step(jacobian, misfit, weight, stiffness)
            if _rms(step) < _STILL:
                break
            before, stiffness = stiffness, stiffness + step
        assert best is not None
        _, stiffness, pressed, misfit = best
        weight = self._weight(pressed, tolerance)
        _, alpha, normal = self._step(jacobian, misfit, weight, stiffness)
        covariance = np.asarray(np.linalg.inv(normal), dtype=float)
        gain = covariance @ (jacobian * weight.reshape(-1, 1) ** 2).T
        return Estimate(
            stiffness=stiffness,
            pressed=pressed,
            misfit=misfit,
            tolerance=tolerance,
            gain=gain,
            covariance=covariance,
            sensitivity=sensitivity,
            refinement=self.refinement,
            alpha=alpha,
            solutions=self.solutions,
        )

    def _pressed(
        self, model: Model, before: Array | None, step: Array | None, stiffness: Array
    ) -> tuple[Pressed, Array]:
        """Press, or where that fails, press after half of the last step."""
        elements = model.levels[-1].n_elements

        def report(_: object, load: float, __: object) -> None:
            if self.progress:
                count = len(self.solutions) + 1
                self.progress(f"solution {count}, {elements:,} elements", load)

        for _ in range(3):
            try:
                return model.pressed(stiffness, report), stiffness
            except LoadNotReached:
                if before is None or step is None:
                    raise
                step = 0.5 * step
                stiffness = before + step
        return model.pressed(stiffness, report), stiffness

    def _tolerance(self, misfit: Array, rough: Array) -> Array:
        """What the misfit may be: noise, and the error of the mesh, from the coarse one's."""
        error = (misfit - carried(rough, self.coarse.layer, self.fine.layer)) / self.refinement
        reach = 0.5 * self.thickness / self.fine.layer.spacing[2]
        return np.sqrt(self.noise**2 + gaussian_filter(error**2, reach, mode="nearest"))

    def _weight(self, pressed: Pressed, tolerance: Array) -> Array:
        x, y, _ = pressed.surface.reshape(3, -1)
        return self.measured.covers(x, y).reshape(tolerance.shape) / tolerance

    def _step(
        self, jacobian: Array, misfit: Array, weight: Array, stiffness: Array
    ) -> tuple[Array, float, Array]:
        """Return the step, alpha and the matrix of the normal equations."""
        columns = self.fine.columns
        smooth = _roughness(columns, stiffness, self.thickness)
        weighted = weight.reshape(-1, 1) * jacobian
        left = (weight * misfit).ravel()
        normal, rhs = weighted.T @ weighted, -weighted.T @ left
        unit = np.trace(normal) / np.trace(smooth)
        uneven = smooth @ stiffness.ravel()
        hold = 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))

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
        step = np.clip(step, -_LARGEST, _LARGEST).reshape(stiffness.shape)
        return step, float(alpha), matrix


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
