"""Coulomb's law of friction, smoothed.

The traction is t = mu N s in the x-y plane, with s = w / q, q = (1 + |w|^n)^(1/n) and
w = w0 + slip / slip_length, opposing the slip since the last accepted load; w0 makes it continuous
from one load to the next. w0 is remembered up to ``MEMORY`` only, so that a node that turns round
does not first have to slip all the way back. The law is so sharp that friction there is within
0.04 % of its bound: what is cut off would be missing from a layer that goes on sliding, the more of
it the shorter the load steps.

Where a node turns round, w crosses the whole range in which the law is nearly constant and Newton's
method on s(w) swings between its ends. So s is an unknown of its own, and what is linearised is
s q(w) = w (the primal-dual method of Chan, Golub and Mulet for the law with n = 2 in image
restoration): the stiffness is (I - s g^T) / q with g the gradient of q, symmetric part.

In all arrays the components (x, y) are on the second axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: The exponent n of the law, and the |w| up to which it remembers.
SHARPNESS, MEMORY = 4.0, 5.0

#: The |w| from which a node slides, and the one that it is given on other elements.
SLIDING, FAST = 3.0, 100.0


def friction_direction(w: Array) -> Array:
    """Friction as a share of its bound, s = w / q, of the slip w (m, 2, ...)."""
    return w / _growth(w)[0]


def direction_step(w: Array, direction: Array, dw: Array) -> Array:
    """Newton step of the ``direction`` s from its linearised law, for a step ``dw`` of the slip."""
    q, slope = _growth(w)
    along = direction * (slope * dw).sum(1, keepdims=True)
    along += slope * (direction * dw).sum(1, keepdims=True)
    return (w + dw - 0.5 * along) / q - direction


def friction_stiffness(w: Array, direction: Array) -> Array:
    """Derivative (xx, xy, yy) of s by w with the ``direction`` an unknown, (3, m, ...)."""
    q, slope = _growth(w)
    d = direction
    xx = 1 - slope[:, 0] * d[:, 0]
    xy = -0.5 * (slope[:, 0] * d[:, 1] + slope[:, 1] * d[:, 0])
    yy = 1 - slope[:, 1] * d[:, 1]
    return np.stack([xx, xy, yy]) / q[:, 0]


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


def _growth(w: Array) -> tuple[Array, Array]:
    """The factor q of each w, (m, 1, ...), and its gradient g, as w."""
    size = _size(w)
    q = (1 + size**SHARPNESS) ** (1 / SHARPNESS)
    return q, w / q * (size / q) ** (SHARPNESS - 2)


def _size(w: Array) -> Array:
    return np.sqrt((w**2).sum(1, keepdims=True))
