"""A paraboloid pressed on and then moved sideways: stick and slip of Cattaneo and Mindlin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optical_palpation.errors import ConvergenceError
from optical_palpation.mechanics.cascade import make_solver
from optical_palpation.mechanics.contact import friction_fraction
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import Tolerances
from optical_palpation.mechanics.newton import LoadedLayer, balance
from optical_palpation.mechanics.path import LoadNotReached, Path, StepControl
from optical_palpation.mechanics.problem import SAMPLE
from optical_palpation.palpation.surface import SLIP_SHARE
from optical_palpation.reproduce.record import Part, Setting
from optical_palpation.reproduce.verification.closed_forms import paraboloid
from optical_palpation.reproduce.verification.layers import MU, graded, press, row

#: Radius of contact over thickness, and over the radius of the paraboloid.
_CONTACT, _SLOPE = 0.25, 0.05
_FRICTION = 0.3


def sideways(moved: float, across: int) -> tuple[float, float]:
    """Tangential over limiting force, Q / (f P), and radius of the stick zone over contact, c / a.

    Half of the layer, mirrored by rollers; it is glued to the window. The radii are those of discs
    of the same area.

    Parameters
    ----------
    moved
        How far the paraboloid moves sideways, over the displacement at which all of a half-space
        slips, 3 (2 - nu) f P / 16 mu a with nu = 1/2.
    across
        Elements over the radius of contact.
    """
    h, a, size = 1.0, _CONTACT, _CONTACT / across
    radius = a / _SLOPE
    indentation, force = paraboloid(a / h, "stuck")
    indentation, force = indentation * h**2 / radius, force * MU * h**3 / radius
    half = graded(1.25 * a, size, 1.25 * a + 2.5 * h, ratio=1.5)
    x = np.concatenate([-half[:0:-1], half])
    depth = np.unique(1 - graded(4 * size, size, 1.0, ratio=1.5))
    grid = LayerGrid(x, half, depth, np.full((half.size, x.size), h))
    along, beside = np.linspace(x[0], x[-1], 321), np.linspace(0, half[-1], 161)
    unloaded = np.full((161, 321), h)
    pressed = h - indentation + (beside[:, None] ** 2 + along**2) / (2 * radius)
    first = press(
        grid,
        Imprint(along, beside, unloaded, pressed),
        glued=(True, False),
        rollers=True,
        pressure=0.1 * MU * _SLOPE,
        solver="multigrid",
        accuracy=1e-5,
        first_step=0.25,
    )
    limit = 3 * _FRICTION * force * (2 - 0.5) / (16 * MU * a)
    shift = np.zeros((2, *pressed.shape))
    shift[0] = moved * limit
    problem = replace(
        first.problem,
        imprint=Imprint(along, beside, pressed, pressed, shift),
        friction=(0.0, _FRICTION),
        slip_length=1e-3 * limit,
    )
    start = replace(first.state, load=0.0, anchor_load=0.0)
    start.slip = np.zeros_like(start.slip)
    start.anchor = start.lateral()
    tolerances = Tolerances(force=1e-5, volume=1e-7)
    layer = LoadedLayer(problem, make_solver(problem, "multigrid"))
    path = Path(layer, tolerances, tolerances, start, StepControl(first=0.25, largest=0.25))
    try:
        path.follow(replace(start, load=1.0))
    except LoadNotReached as failure:
        raise ConvergenceError(str(failure)) from None
    state = path.state
    now = balance(problem, state)
    vertical = float(state.normal_force[SAMPLE].sum())
    tangential = abs(float(now.force[0, -1].sum()))
    touching = state.touching(problem)[SAMPLE]
    fraction = friction_fraction(problem, state)[SAMPLE]
    weight = grid.areas
    contact = float(weight[touching].sum())
    stick = float(weight[touching & (fraction < SLIP_SHARE)].sum())
    return tangential / (_FRICTION * vertical), float(np.sqrt(stick / contact))


def tangential(setting: Setting) -> Part:
    """Radius of the stick zone at two displacements."""
    sizes = (2, 3) if setting.quick else (4, 8)
    part = Part(
        "A paraboloid is pressed on, without friction, and then moved sideways with friction "
        f"{_FRICTION:g}. The middle sticks, the rim slips: $c / a = (1 - Q / f P)^{{1/3}}$ "
        "(Cattaneo 1938, Mindlin 1949), for a half-space; the layer here is four times as thick "
        "as the contact is wide in radius, and $Q$ and $P$ are those of the solution. A node "
        f"sticks where friction is below 0.9 of its bound. Meshes of {sizes[0]} and {sizes[1]} "
        "elements over $a$."
    )
    for number, moved in enumerate((0.3, 0.6)):
        setting.tell(number / 2, f"moved by {moved:g} of the slip displacement")
        found = [sideways(moved, across) for across in sizes]
        force = found[-1][0]
        part.rows.append(
            row(
                "Cattaneo 1938, Mindlin 1949",
                f"radius of the stick zone over that of contact, Q / fP {force:.3f}",
                (1 - force) ** (1 / 3),
                [radius for _, radius in found],
                "an area counted in nodes",
                digits=3,
            )
        )
    return part
