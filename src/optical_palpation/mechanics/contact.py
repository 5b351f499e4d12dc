"""Unilateral contact and Coulomb friction at the window and at the imprint.

Each surface node has a vertical penetration phi of a rigid surface, -z at the window and z - h(x, y)
at the imprint, and a vertical contact force N, the multiplier of phi <= 0. Complementarity of the
two is written as one smooth equation per node,

    psi = N - S(N + c phi) = 0,    S(t) = (t + sqrt(t^2 + 4 eps^2)) / 2,

which for eps -> 0 is N = max(0, N + c phi). N phi = -eps^2 / c: with the final eps of a thousandth
of the shear modulus a pressed node keeps a gap of less than a nanometre. A hard active set instead
of it flickers for ever on a few nodes at free edges.

Friction is the smooth Coulomb law t = mu N s, s = w / sqrt(1 + |w|^2), w = w0 + slip / slip_length,
in the x-y plane, opposing the slip since the last accepted load; w0 makes the traction continuous
from one load to the next. The lateral equations of a surface node are

    f_x + (h_x - mu s_x) f_z = 0 (imprint),    f_x + mu s_x f_z = 0 (window),

in which the vertical internal force f_z = -+N carries both the slope and the friction bound, so
that friction is linearised exactly together with the pressure that bounds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .problem import SAMPLE, WINDOW, LayerProblem, LayerState

Array = NDArray[np.float64]

#: |w| is remembered from load to load up to this value only (friction 0.995 of its bound), so that
#: a node that turns round does not first have to slip all the way back.
_MEMORY = 10.0
#: A contact spring stiffer than this many times its scale c is a prescribed displacement.
_RIGID = 1e3


@dataclass(frozen=True)
class ContactLinearisation:
    """Everything the Newton system needs from both contact surfaces.

    All arrays end in ``(ny + 1, nx + 1)`` and begin with the face. ``row`` and ``column`` (x, y) are
    the factors with which the vertical equation and the vertical displacement enter the lateral
    ones; ``block`` (xx, xy, yy) the additional lateral stiffness; ``spring`` the stiffness of the
    contact coordinate d, ``load`` the right-hand side that belongs to it; where ``rigid``, d is
    prescribed as ``step`` instead. ``violation`` is psi, mN.
    """

    penetration: Array
    violation: Array
    row: Array
    column: Array
    block: Array
    spring: Array
    load: Array
    rigid: NDArray[np.bool_]
    step: Array


def complementarity_scale(problem: LayerProblem) -> Array:
    """Scale c of the complementarity equation, mN / mm, shape (ny + 1, nx + 1)."""
    grid = problem.grid
    areas = grid.surface_areas(grid.nodes[:, -1])
    return areas * problem.shear_modulus / grid.spacing()[0]


def linearise(
    problem: LayerProblem, state: LayerState, force: Array, smoothing: float
) -> ContactLinearisation:
    """Linearise contact and friction at ``state`` with the internal nodal ``force``.

    ``smoothing`` is eps as a pressure in units of the shear modulus.
    """
    nodes = problem.grid.nodes
    bottom = nodes[:, 0] + state.u[:, 0]
    top = nodes[:, -1] + state.u[:, -1]
    h, hx, hy, hxx, hxy, hyy = problem.imprint.evaluate(top[0], top[1], state.load)
    penetration = np.stack([-bottom[2], top[2] - h])
    normal = state.normal_force
    reaction = np.stack([force[2, 0], -force[2, -1]])

    c = complementarity_scale(problem)
    eps = smoothing * c * problem.grid.spacing()[0]
    t = normal + c * penetration
    root = np.sqrt(t**2 + 4 * eps**2)
    # of S and 1 - S' the small one of two terms is formed without cancellation
    s_value = np.where(t > 0, 0.5 * (t + root), 2 * eps**2 / (root - t))
    other = np.where(t > 0, 2 * eps**2 / (root * (root + t)), 0.5 * (1 - t / root))
    slope = 1 - other
    violation = normal - s_value
    rigid = slope > _RIGID * other
    other = np.where(rigid, 1.0, other)
    spring = np.where(rigid, 0.0, slope * c / other)
    sign = np.array([-1.0, 1.0])[:, None, None]  # d is z: penetration grows with -d at the window
    load = np.where(rigid, 0.0, sign * (violation / other - normal))
    step = np.where(rigid, sign * violation / (slope * c), 0.0)

    lateral = np.stack([state.u[:2, 0], state.u[:2, -1]])
    w = state.slip + (lateral - state.anchor) / problem.slip_length
    q = np.sqrt(1 + (w**2).sum(1))
    s = w / q[:, None]
    friction = np.asarray(problem.friction)[:, None, None]
    carries = (reaction > 0)[:, None] * friction[:, None] * s
    row = carries.copy()
    row[SAMPLE] = np.stack([hx, hy]) - carries[SAMPLE]
    column = np.zeros_like(row)
    column[SAMPLE] = hx, hy

    stiff = friction * np.maximum(reaction, normal) / problem.slip_length / q
    block = np.stack(
        [stiff * (1 - s[:, 0] ** 2), -stiff * s[:, 0] * s[:, 1], stiff * (1 - s[:, 1] ** 2)], axis=1
    )
    block[SAMPLE] -= normal[SAMPLE] * np.stack([hxx, hxy, hyy])
    return ContactLinearisation(
        penetration, violation, row, column, block, spring, load, rigid, step
    )


def remember_slip(problem: LayerProblem, state: LayerState) -> None:
    """Carry the friction state to the next load (in place)."""
    lateral = np.stack([state.u[:2, 0], state.u[:2, -1]])
    w = state.slip + (lateral - state.anchor) / problem.slip_length
    size = np.sqrt((w**2).sum(1, keepdims=True))
    w *= np.minimum(1.0, _MEMORY / np.maximum(size, 1e-300))
    state.slip = np.where(state.touching(problem)[:, None], w, 0.0)
    state.anchor = lateral


def friction_fraction(problem: LayerProblem, state: LayerState) -> Array:
    """Share of the friction bound in use at each surface node, (2, ny + 1, nx + 1); 1 if no friction."""
    lateral = np.stack([state.u[:2, 0], state.u[:2, -1]])
    w2 = ((state.slip + (lateral - state.anchor) / problem.slip_length) ** 2).sum(1)
    used = np.sqrt(w2 / (1 + w2))
    return np.where(np.asarray(problem.friction)[:, None, None] > 0, used, 1.0)
