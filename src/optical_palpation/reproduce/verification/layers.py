"""Layer problems of the verification, on meshes of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import ConvergenceError
from optical_palpation.material import InvariantLaw, MooneyRivlin
from optical_palpation.mechanics.cascade import LoadNotReached, Solution, solve
from optical_palpation.mechanics.faces import area_vectors
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.newton import Tolerances
from optical_palpation.mechanics.path import StepControl
from optical_palpation.mechanics.problem import LayerProblem, Sides
from optical_palpation.reproduce.record import Row

Array = NDArray[np.float64]
#: The layer of the paper, C10 2.23 and C01 0.703 kPa, and its shear modulus, kPa.
MATERIAL = MooneyRivlin(2.23, 0.703)
MU = 2 * (MATERIAL.c10 + MATERIAL.c01)


def graded(inner: float, size: float, outer: float, ratio: float = 1.3) -> Array:
    """Positions from 0: equal ``size`` to ``inner``, then growing by ``ratio``, to ``outer``."""
    count = round(inner / size)
    widths = [size * ratio]
    while sum(widths) < outer - inner:
        widths.append(widths[-1] * ratio)
    beyond = np.cumsum(widths) * (outer - inner) / sum(widths)
    return np.concatenate([np.linspace(0.0, inner, count + 1), inner + beyond])


def press(
    grid: LayerGrid,
    imprint: Imprint,
    *,
    law: InvariantLaw = MATERIAL,
    friction: tuple[float, float] = (0.0, 0.0),
    glued: tuple[bool, bool] = (False, False),
    rollers: bool = False,
    mirrors: Sides = (False, False, False, False),
    slip_length: float = 1e-3,
    curved_sides: bool = False,
    pressure: float,
    solver: str = "direct",
    accuracy: float = 1e-7,
    first_step: float = 0.1,
) -> Solution:
    """Press a layer.

    ``pressure`` is a guess of the contact pressure, kPa; ``accuracy`` the out-of-balance force as a
    share of the contact force; ``first_step`` the first share of the load.

    Raises
    ------
    ConvergenceError
        If the full load is not reached.
    """
    problem = LayerProblem(
        grid,
        imprint,
        law,
        friction,
        edges="roller" if rollers else "free",
        mirrors=mirrors,
        slip_length=slip_length,
        glued=glued,
        curved_sides=curved_sides,
    )
    try:
        return solve(
            problem,
            lambda level: pressure * level.grid.areas,
            solver=solver,
            cascade=False,
            tolerances=Tolerances(force=accuracy, volume=1e-2 * accuracy),
            control=StepControl(first=first_step, largest=1.0),
        )
    except LoadNotReached as failure:
        raise ConvergenceError(str(failure)) from None


def contact_pressure(solution: Solution) -> Array:
    """Vertical contact force per vertical area at the nodes of the sample side, kPa."""
    surface = (solution.problem.grid.nodes + solution.state.u)[:, -1]
    return solution.state.normal_force[1] / area_vectors(surface)[2]


def row(
    source: str,
    quantity: str,
    exact: float,
    ours: Sequence[float],
    comment: str = "",
    *,
    digits: int = 4,
) -> Row:
    """One line of a table: our numbers from the coarse to the fine mesh, each with its error."""
    numbers = ", ".join(f"{value:.{digits}g} ({error(value, exact)})" for value in ours)
    return Row(source, quantity, f"{exact:.{digits}g}", numbers, comment)


def error(value: float, exact: float) -> str:
    """Relative error as text, with two significant digits."""
    relative = value / exact - 1
    return f"{relative:+.1e}" if abs(relative) < 1e-4 else f"{100 * relative:+.2g} %"
