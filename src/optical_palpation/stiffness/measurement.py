"""The measured loaded thickness as a smooth surface, and the noise that is left over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import splu

from optical_palpation.errors import InputError

Array = NDArray[np.float64]
_DEGREE = 3
#: Standard deviation of normal noise over the median of its absolute values.
_NORMAL = 1.4826
#: Weight of the surface's bending over that of the pixels: as little as holds it where there are
#: none. The shortest waves that knots can follow lose half a per cent.
_STRAIGHT = 1e-4


@dataclass(frozen=True, eq=False)
class ThicknessSurface:
    """Cubic spline through a thickness map, by least squares.

    Its knots are as far apart as the elements that must follow it: what varies faster is noise to
    them. Unlike a Gaussian filter it does not flatten what they can follow.

    Attributes
    ----------
    knots
        Along y and x, mm.
    coefficients
        Of the splines, (y, x), mm.
    noise
        Standard deviation of a pixel from the surface, mm.
    pixels
        Measured pixels for each coefficient.
    axes, known
        Pixels along y and x, mm, and which of them were measured, (y, x).
    """

    knots: tuple[Array, Array]
    coefficients: Array
    noise: float
    pixels: float
    axes: tuple[Array, Array]
    known: NDArray[np.bool_]

    @classmethod
    def fitted(cls, thickness: xr.DataArray, spacing: float) -> ThicknessSurface:
        """Fit a map on ``(y, x)``, mm, NaN where nothing is known, with knots ``spacing`` apart.

        Raises
        ------
        InputError
            If there are fewer pixels than the surface needs.
        """
        axes = [thickness[axis].values for axis in "yx"]
        steps = [float(np.diff(axis).mean()) for axis in axes]
        knots = [
            _knots(axis, max(spacing, 2 * step)) for axis, step in zip(axes, steps, strict=True)
        ]
        values = thickness.transpose("y", "x").values.ravel()
        known = np.isfinite(values)
        along_y, along_x = (
            BSpline.design_matrix(axis, knot, _DEGREE)
            for axis, knot in zip(axes, knots, strict=True)
        )
        design = sp.csr_matrix(sp.kron(along_y, along_x))[known]
        count = design.shape[1]
        if known.sum() < 1.2 * count:
            raise InputError(
                f"the loaded thickness has {int(known.sum())} measured pixels, too few for "
                f"elements of {spacing:g} mm: give a larger element_size"
            )
        shape = along_y.shape[1], along_x.shape[1]
        # Where pixels are missing the surface goes straight on.
        straight = _STRAIGHT * known.sum() / count * _bends(shape)
        normal = design.T @ design + straight
        coefficients = splu(sp.csc_matrix(normal)).solve(design.T @ values[known])
        left = values[known] - design @ coefficients
        noise = _NORMAL * float(np.median(np.abs(left)))
        noise *= float(np.sqrt(known.sum() / (known.sum() - count)))
        return cls(
            (knots[0], knots[1]),
            coefficients.reshape(shape),
            noise,
            float(known.sum() / count),
            (axes[0], axes[1]),
            known.reshape(axes[0].size, axes[1].size),
        )

    def __call__(self, x: Array, y: Array, dx: int = 0, dy: int = 0) -> Array:
        """Thickness at points, mm, or a derivative of it; straight on beyond the map."""
        along = [
            _basis(points, knots, order)
            for points, knots, order in zip((y, x), self.knots, (dy, dx), strict=True)
        ]
        return np.einsum("na,ab,nb->n", along[0], self.coefficients, along[1])

    def covers(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Whether points lie on the map, where it was measured."""
        on = np.ones(np.shape(x), dtype=bool)
        for points, axis in zip((y, x), self.axes, strict=True):
            on &= (points >= axis[0]) & (points <= axis[-1])
        return on & self.known[self._nearest(x, y)]

    def distance(self, x: Array, y: Array) -> Array:
        """How far the pixels nearest to points are from one that was measured, mm."""
        steps = [float(np.diff(axis).mean()) for axis in self.axes]
        return np.asarray(distance_transform_edt(~self.known, steps)[self._nearest(x, y)])

    def _nearest(self, x: Array, y: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        row, column = (
            np.searchsorted(0.5 * (axis[1:] + axis[:-1]), points)
            for points, axis in zip((y, x), self.axes, strict=True)
        )
        return row, column


def without_noise(field: xr.DataArray, spacing: float) -> xr.DataArray:
    """Return a map on ``(y, x)`` as elements ``spacing`` apart, mm, can follow it.

    Where layer and sample touch first their thickest place decides, and of noise that is the
    largest one. A map that has less than two pixels for each element is left as it is, and so is
    the same thickness everywhere.
    """
    if np.ptp(field.values) == 0:
        return field
    if max(float(np.diff(field[axis]).max()) for axis in "yx") > 0.5 * spacing:
        return field
    surface = ThicknessSurface.fitted(field, spacing)
    at_y, at_x = (_basis(*along, 0) for along in zip(surface.axes, surface.knots, strict=True))
    return field.copy(data=at_y @ surface.coefficients @ at_x.T)


def _knots(axis: Array, spacing: float) -> Array:
    count = max(4, round((axis[-1] - axis[0]) / spacing))
    inner = np.linspace(axis[0], axis[-1], count + 1)
    return np.concatenate([[axis[0]] * _DEGREE, inner, [axis[-1]] * _DEGREE])


def _bends(shape: tuple[int, int]) -> sp.csr_array:
    """D^T D of the second differences of coefficients (y, x) along both axes."""
    of_axis = []
    for count in shape:
        second = sp.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
        of_axis.append(second.T @ second)
    y, x = of_axis
    eye_y, eye_x = (sp.eye_array(count) for count in shape)
    return sp.csr_array(sp.kron(y, eye_x) + sp.kron(eye_y, x))


def _basis(points: Array, knots: Array, order: int) -> Array:
    """Values or derivatives (points, coefficients) of the splines; straight beyond the ends."""
    splines = BSpline(knots, np.eye(len(knots) - _DEGREE - 1), _DEGREE)
    inside = np.clip(points, knots[0], knots[-1])
    if order:
        return splines.derivative(order)(inside)
    slope = splines.derivative(1)(inside)
    return splines(inside) + (points - inside)[:, None] * slope
