"""The imprint: the surface, of known shape and motion, that carries the measured thickness."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from optical_palpation.averages import gaussian_average
from optical_palpation.parallel import in_parallel

Array = NDArray[np.float64]

#: Steps in which a point of the moving surface is tracked to full load; each reduces the error by
#: about the strain of the surface.
_TRACKING = 4
#: Share of the thickness by which smoothing makes equal heights differ at most.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Imprint:
    """A surface z = h(x, y; load), lowered from the unloaded layer.

    h = L0 + load (L1 - L0): at load 0 the imprint fits the unloaded sample side, at load 1 it is
    the measured loaded thickness. Both maps are bicubic splines through their pixels; beyond the
    last pixel the surface continues level.

    Its points may move sideways in a known way, as those of a sample that spreads under its load:
    in proportion to the load, along straight lines. Only friction feels that.

    Attributes
    ----------
    x, y
        Uniform pixel coordinates, mm.
    unloaded, loaded
        Maps (y, x) of L0 and L1, mm.
    motion
        Lateral displacement (2, y, x) at full load of the point that is then there, mm; ``None``
        for a surface that is fixed laterally.
    smoothing
        Standard deviation of the Gaussian by which the maps were smoothed, mm.
    """

    x: Array
    y: Array
    unloaded: Array
    loaded: Array
    motion: Array | None = None
    smoothing: float = 0.0

    @cached_property
    def _coefficients(self) -> tuple[Array, Array]:
        """Those of the unloaded map's spline, and how they change."""
        start, end = (_spline_coefficients(field) for field in (self.unloaded, self.loaded))
        return start, end - start

    @cached_property
    def _lowest(self) -> tuple[float, float]:
        return float(np.min(self.unloaded)), float(np.min(self.loaded))

    @cached_property
    def strains(self) -> tuple[float, float]:
        """Least and greatest compression at full load, as shares of the thickness."""
        strain = 1 - self.loaded / self.unloaded
        return float(strain.min()), float(strain.max())

    @property
    def level(self) -> tuple[bool, bool]:
        """Whether it is the same all along x and along y, at every load."""

        def along(axis: int) -> bool:
            differ = max(float(np.ptp(at, axis).max()) for at in (self.unloaded, self.loaded))
            return differ <= _ROUNDING * self._lowest[0]

        return along(1), along(0)

    def lowest(self, load: float) -> float:
        """A height that the surface stays above, but for the splines' overshoot, mm."""
        unloaded, loaded = self._lowest
        return (1 - load) * unloaded + load * loaded

    def smoothed(self, sigma: float) -> Imprint:
        """Return the imprint smoothed by a Gaussian of standard deviation ``sigma``, mm."""
        widths = (sigma / (self.y[1] - self.y[0]), sigma / (self.x[1] - self.x[0]))

        def smooth(field: Array) -> Array:
            if np.ptp(field) == 0:  # a layer of one thickness
                return field
            return gaussian_average(field, widths, "nearest")

        motion = None if self.motion is None else smooth(self.motion)
        return replace(
            self,
            unloaded=smooth(self.unloaded),
            loaded=smooth(self.loaded),
            motion=motion,
            smoothing=float(np.hypot(self.smoothing, sigma)),
        )

    def velocity(self, x: Array, y: Array, load: float) -> Array:
        """Lateral motion, mm per unit of load, of the points that ``load`` finds at x, y."""
        moved = np.zeros((2, *x.shape))
        if self.motion is None:
            return moved
        first, step = (self.y[0], self.x[0]), (self.y[1] - self.y[0], self.x[1] - self.x[0])
        for _ in range(_TRACKING):  # a point now at x is at x + (1 - load) moved at full load
            end = y + (1 - load) * moved[1], x + (1 - load) * moved[0]
            at = [(e - f) / s for e, f, s in zip(end, first, step, strict=True)]
            moved = np.stack([map_coordinates(m, at, order=1, mode="nearest") for m in self.motion])
        return moved

    def evaluate(self, x: Array, y: Array, load: float) -> Array:
        """Height and its derivatives (h, hx, hy, hxx, hxy, hyy) at points; shape (6, *x.shape)."""
        start, change = self._coefficients
        dx = (self.x[-1] - self.x[0]) / (len(self.x) - 1)
        dy = (self.y[-1] - self.y[0]) / (len(self.y) - 1)
        out = np.empty((6, x.size))
        _spline(
            (x.ravel() - self.x[0]) / dx, (y.ravel() - self.y[0]) / dy, start, change, load, out
        )
        out /= np.array([1, dx, dy, dx * dx, dx * dy, dy * dy])[:, None]
        return out.reshape(6, *x.shape)


def _spline_coefficients(field: Array) -> Array:
    field = np.asarray(field, float)
    if np.ptp(field) == 0:  # the spline of a constant
        return field.copy()  # in C order and writable, for which the kernel is compiled
    return spline_filter(field, order=3, mode="mirror")


@nb.njit
def _weights(t, w):
    """Cubic B-spline weights and their first two derivatives for the fraction t, w[3, 4]."""
    s = 1 - t
    w[0, 0], w[0, 3] = s * s * s / 6, t * t * t / 6
    w[0, 1], w[0, 2] = 2 / 3 - t * t * (1 - t / 2), 2 / 3 - s * s * (1 - s / 2)
    w[1, 0], w[1, 3] = -s * s / 2, t * t / 2
    w[1, 1], w[1, 2] = t * (1.5 * t - 2), -s * (1.5 * s - 2)
    w[2, 0], w[2, 1], w[2, 2], w[2, 3] = s, 3 * t - 2, 3 * s - 2, t


@nb.njit
def _mirror(i, n):
    if n == 1:
        return 0
    i = abs(i)
    return 2 * (n - 1) - i if i > n - 1 else i


@nb.njit(cache=True)
def _spline(px, py, start, change, load, out):
    in_parallel(_spline_points, px.size, (px, py, start, change, load, out))


@nb.njit
def _spline_points(px, py, start, change, load, out, begin, end):
    ny, nx = start.shape
    wx, wy = np.empty((3, 4)), np.empty((3, 4))
    for q in range(begin, end):
        x, y = min(max(px[q], 0.0), nx - 1.0), min(max(py[q], 0.0), ny - 1.0)
        i, j = min(int(x), nx - 2), min(int(y), ny - 2)
        _weights(x - i, wx)
        _weights(y - j, wy)
        h = hx = hy = hxx = hxy = hyy = 0.0
        for b in range(4):
            jj = _mirror(j - 1 + b, ny)
            v = vx = vxx = 0.0
            for a in range(4):
                ii = _mirror(i - 1 + a, nx)
                c = start[jj, ii] + load * change[jj, ii]
                v += wx[0, a] * c
                vx += wx[1, a] * c
                vxx += wx[2, a] * c
            h += wy[0, b] * v
            hx += wy[0, b] * vx
            hxx += wy[0, b] * vxx
            hy += wy[1, b] * v
            hxy += wy[1, b] * vx
            hyy += wy[2, b] * v
        outside_x, outside_y = x != px[q], y != py[q]
        out[0, q] = h
        out[1, q] = 0.0 if outside_x else hx
        out[2, q] = 0.0 if outside_y else hy
        out[3, q] = 0.0 if outside_x else hxx
        out[4, q] = 0.0 if outside_x or outside_y else hxy
        out[5, q] = 0.0 if outside_y else hyy
