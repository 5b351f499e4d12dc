"""Unilateral contact and Coulomb friction at the window and at the imprint.

Each surface node has a vertical gap to a rigid surface: z >= 0 at the window, z <= h(x, y) at the
imprint. The multiplier of an active gap is the vertical contact force N of the node, found from
equilibrium, so that a node's three equations become

* the gap, phi = 0, in place of the vertical one, and
* two lateral ones, f_x + (h_x - mu s_x) f_z = 0 at the imprint and f_x + mu s_x f_z = 0 at the
  window, in which the vertical internal force f_z = -+N carries both the slope and the friction
  bound.

In this form friction is exactly linearised together with the pressure that bounds it.

Friction is the smooth Coulomb law t = mu N s, s = w / sqrt(1 + |w|^2), w = w0 + slip / slip_length,
in the x-y plane, opposing the slip since the last accepted load; w0 makes the traction continuous
from one load to the next.
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


@dataclass(frozen=True)
class ContactLinearisation:
    """Everything the Newton system needs from both contact surfaces.

    ``penetration`` (2, ny + 1, nx + 1) is positive where a node is beyond the rigid surface.
    ``row`` and ``column`` (2, 2, ny + 1, nx + 1) are the factors with which the vertical equation
    and the vertical displacement enter the lateral ones; ``block`` (2, 3, ny + 1, nx + 1) the
    additional lateral stiffness (xx, xy, yy).
    """

    penetration: Array
    row: Array
    column: Array
    block: Array
    normal_force: Array
    friction_direction: Array


def linearise(
    problem: LayerProblem,
    state: LayerState,
    force: Array,
    bound_guess: Array | None = None,
    secant: bool = False,
) -> ContactLinearisation:
    """Linearise contact and friction at ``state`` with the internal nodal ``force``.

    ``bound_guess`` is a normal force that sets the friction stiffness while the true one is still
    unknown (the first iteration from the unloaded layer); it does not enter the equations.
    """
    nodes = problem.grid.nodes
    bottom = nodes[:, 0] + state.u[:, 0]
    top = nodes[:, -1] + state.u[:, -1]
    h, hx, hy, hxx, hxy, hyy = problem.imprint.evaluate(top[0], top[1], state.load)
    penetration = np.stack([-bottom[2], top[2] - h])
    normal = np.where(state.active, np.stack([force[2, 0], -force[2, -1]]), 0.0)
    bound = np.maximum(normal, 0.0)

    lateral = np.stack([state.u[:2, 0], state.u[:2, -1]])
    w = state.slip + (lateral - state.anchor) / problem.slip_length
    q = np.sqrt(1 + (w**2).sum(1))
    s = w / q[:, None]

    friction = np.asarray(problem.friction)[:, None, None]
    slope = np.stack([hx, hy])
    row = np.zeros_like(w)
    column = np.zeros_like(w)
    carries = (bound > 0)[:, None] * friction[:, None] * s
    row[WINDOW] = carries[WINDOW]
    row[SAMPLE] = slope - carries[SAMPLE]
    column[SAMPLE] = slope

    stiff = bound if bound_guess is None else np.maximum(bound, bound_guess)
    stiff = friction * np.where(state.active, stiff, 0.0) / problem.slip_length / q
    along = np.zeros_like(s) if secant else s
    block = np.stack(
        [
            stiff * (1 - along[:, 0] ** 2),
            -stiff * along[:, 0] * along[:, 1],
            stiff * (1 - along[:, 1] ** 2),
        ],
        axis=1,
    )
    block[SAMPLE] -= normal[SAMPLE] * np.stack([hxx, hxy, hyy])
    return ContactLinearisation(penetration, row, column, block, normal, s)


def remember_slip(problem: LayerProblem, state: LayerState) -> None:
    """Carry the friction state to the next load (in place)."""
    lateral = np.stack([state.u[:2, 0], state.u[:2, -1]])
    w = state.slip + (lateral - state.anchor) / problem.slip_length
    size = np.sqrt((w**2).sum(1, keepdims=True))
    w *= np.minimum(1.0, _MEMORY / np.maximum(size, 1e-300))
    state.slip = np.where(state.active[:, None], w, 0.0)
    state.anchor = lateral
