"""Coulomb's law of friction, smoothed.

The traction is t = mu N s in the x-y plane, with s = w / q, q = (1 + |w|^4)^(1/4) and
w = w0 + slip / slip_length, opposing the slip since the last accepted load; w0 makes it continuous
from one load to the next. w0 is remembered up to ``MEMORY`` only, so that a node that turns round
does not first have to slip all the way back. The law is so sharp that friction there is within
0.04 % of its bound: what is cut off would be missing from a layer that goes on sliding, the more of
it the shorter the load steps.

A node that sticks after it has slid, or slides after it has stuck, crosses a range of w in which
the law is anything but linear: Newton's method on s(w) swings between its ends. So the law is
linearised where the node would come to rest if it moved alone, held by an elastic body of about the
right stiffness (``look_ahead``). Whether it sticks or slides, and which way, is then known before
the step of all nodes.

In all arrays the components (x, y) are on the second axis.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

Array = NDArray[np.float64]

#: The |w| up to which the law remembers.
MEMORY = 5.0
#: Steps in which the place is found where a node would come to rest, at most, and how nearly.
_STEPS, _NEARLY = 30, 1e-5
#: The |w| from which a node slides, and the one that it is given on other elements.
SLIDING, FAST = 3.0, 100.0


def friction_direction(w: Array) -> Array:
    """Friction as a share of its bound, s = w / q, of the slip w (m, 2, ...)."""
    return w / _growth(_size(w))


def _growth(size):
    """The factor q of a slip |w|."""
    return np.sqrt(np.sqrt(1 + (size * size) ** 2))


_growth_of_node = nb.njit(_growth)


class Ahead(NamedTuple):
    """The law linearised at another slip than the present w: s(w + dw) = s(w) + change + slope dw.

    Attributes
    ----------
    direction
        s at that slip, as w.
    slope
        Derivative (xx, xy, yy) of s by w there, (m, 3, ...).
    change
        By how much the line is off the law at w, as w.
    turned
        ``direction`` less s at w, as w.
    """

    direction: Array
    slope: Array
    change: Array
    turned: Array


#: Lateral stiffness of a node in shear moduli times the width of what belongs to it. Measured on
#: the coin: 1.7. Half and twice of it take as many iterations.
_ELASTIC = 1.5


def node_stiffness(shear_modulus: float, area: Array | float, height: float) -> Array:
    """How a body of a height, mm, resists a node of its surface moving alone, mN / mm, about.

    As a half-space does or, where what belongs to the node is wider than high, as a column.
    """
    return np.asarray(shear_modulus * np.maximum(_ELASTIC * np.sqrt(area), area / height))


def look_ahead(w: Array, residual: Array, elastic: Array, bound: Array) -> Ahead:
    """Linearise the law where each node would come to rest, the others held.

    There ``elastic`` w + ``bound`` s(w) is what it is now, less what is out of balance.

    Parameters
    ----------
    w
        Slip, (m, 2, ...).
    residual
        Lateral force out of balance, as w, mN.
    elastic
        Force by which the body resists a unit of w, (m, ...), mN; more than none.
    bound
        mu N of all friction at the node, (m, ...), mN.
    """
    m, shape = len(w), w.shape[2:]
    w, residual = (np.ascontiguousarray(field).reshape(m, 2, -1) for field in (w, residual))
    elastic = np.broadcast_to(elastic, bound.shape)
    elastic, bound = (np.ascontiguousarray(field).reshape(m, -1) for field in (elastic, bound))
    out = np.empty((m, 9, w.shape[2]))
    _look_ahead(w, residual, elastic, bound, out)
    out = out.reshape(m, 9, *shape)
    return Ahead(out[:, :2], out[:, 2:5], out[:, 5:7], out[:, 7:])


@nb.njit(cache=True)
def _look_ahead(w, residual, elastic, bound, out):
    for f in range(len(w)):
        for i in range(w.shape[2]):
            x, y = w[f, 0, i], w[f, 1, i]
            e, b = elastic[f, i], bound[f, i]
            now = 1 / _growth_of_node(math.sqrt(x * x + y * y))
            aim_x = (e + b * now) * x - residual[f, 0, i]
            aim_y = (e + b * now) * y - residual[f, 1, i]
            aim = math.sqrt(aim_x * aim_x + aim_y * aim_y)
            # e v + b v / q(v) = aim is concave in v: from below Newton's method never passes it
            v = max(aim / (e + b), (aim - b) / e)
            for _ in range(_STEPS):
                q = _growth_of_node(v)
                step = (aim - e * v - b * v / q) / (e + b / q**5)
                v += step
                if step <= _NEARLY * v:
                    break
            q = _growth_of_node(v)
            nx, ny = (aim_x / aim, aim_y / aim) if aim > 0 else (0.0, 0.0)
            # across the slip s turns by 1 / q, along it it grows by 1 / q^5
            across, less = 1 / q, 1 / q - 1 / q**5
            xx, xy, yy = across - less * nx * nx, -less * nx * ny, across - less * ny * ny
            dx, dy = x - v * nx, y - v * ny
            out[f, 0, i], out[f, 1, i] = v / q * nx, v / q * ny
            out[f, 2, i], out[f, 3, i], out[f, 4, i] = xx, xy, yy
            out[f, 7, i], out[f, 8, i] = v / q * nx - now * x, v / q * ny - now * y
            out[f, 5, i] = out[f, 7, i] + xx * dx + xy * dy
            out[f, 6, i] = out[f, 8, i] + xy * dx + yy * dy


def remembered(w: Array) -> Array:
    """What is kept of the slip w for the next load."""
    return w * np.minimum(1.0, MEMORY / np.maximum(_size(w), 1e-300))


def held_fast(w: Array) -> Array:
    """The slip w from which a solution on other elements starts.

    From one mesh to the next nodes move by more than they slip until friction turns round, and that
    is no slip. What slides is given much of it, and goes on sliding.
    """
    size = _size(w)
    return w * np.where(size > SLIDING, np.maximum(1.0, FAST / np.maximum(size, 1e-300)), 1.0)


def _size(w: Array) -> Array:
    return np.sqrt((w**2).sum(1, keepdims=True))
