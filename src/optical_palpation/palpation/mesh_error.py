"""How far a solution may be from that of an infinitely fine mesh, told from a coarser one.

The nested iteration has solved the problem on a coarser grid anyway. What the solution changes by
from that grid to its own is extrapolated as Richardson does, and enlarged by a safety factor (the
grid convergence index of Roache, J. Fluids Eng. 116:405, 1994). Grids are not halved throughout:
free edges keep the width of their elements. So the ratio of two grids is the cube root of that of
their numbers of elements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from optical_palpation.mechanics.cascade import LoadNotReached, Solution, coarsened, solve
from optical_palpation.mechanics.problem import LayerProblem, LayerState

Array = NDArray[np.float64]
#: What a state is compared by: total force, mN, and axial stress on the points of the map, kPa.
Quantities = tuple[float, Array]

#: Safety factor, and the order of convergence that is counted on: the error of most maps falls with
#: an order between one and two, the lower one by the more.
SAFETY, ORDER = 1.25, 1.0
#: Share of the force by which free edges may be off besides: the widths of their outermost elements
#: and the smoothing of contact at the rim stay what they are on all grids.
FREE_EDGES = 0.005
#: Least ratio of two grids that tells anything.
_LEAST_RATIO = 1.2
#: Grids with fewer elements (z, y, x) have no coarser one to compare with.
_LEAST_ELEMENTS = (2, 4, 4)
#: Standard deviation, in elements, of the Gaussian over which the error of the map is averaged. The
#: difference of two solutions has zeros where neither of them is right.
_AVERAGED = 2.0


@dataclass(frozen=True)
class MeshError:
    """Estimated bounds of the discretisation error.

    Attributes
    ----------
    force
        Of the total force, mN.
    stress
        Of the axial stress, on the points of the map, kPa; root mean square of the surroundings.
    elements
        Of the coarser grid.
    """

    force: float
    stress: Array
    elements: int


def mesh_error(
    solution: Solution,
    quantities: Callable[[LayerProblem, LayerState], Quantities],
    bound_guess: Callable[[LayerProblem], Array],
) -> MeshError | None:
    """Estimate the discretisation error of a solution.

    Parameters
    ----------
    quantities
        Function that returns what is compared of a solution.
    bound_guess
        As for :func:`~optical_palpation.mechanics.cascade.solve`: small problems, which have been
        solved on one grid only, are solved on a coarser one.

    Returns
    -------
    MeshError or None
        None where there is no coarser solution: the grid is too coarse itself, or the load was not
        reached on the coarser one.
    """
    coarser = solution.coarser or _solved_coarser(solution.problem, bound_guess)
    if coarser is None:
        return None
    problem = solution.problem
    elements = coarser[0].grid.n_elements
    ratio = (problem.grid.n_elements / elements) ** (1 / 3)
    if ratio < _LEAST_RATIO:
        return None
    factor = SAFETY / (ratio**ORDER - 1)
    force, stress = quantities(problem, solution.state)
    coarse_force, coarse_stress = quantities(*coarser)
    edges = FREE_EDGES * abs(force) if problem.edges == "free" else 0.0
    return MeshError(
        force=factor * abs(force - coarse_force) + edges,
        stress=factor * _surrounding(stress - coarse_stress),
        elements=elements,
    )


def _solved_coarser(
    problem: LayerProblem, bound_guess: Callable[[LayerProblem], Array]
) -> tuple[LayerProblem, LayerState] | None:
    """Solve on the next coarser grid, if there is one."""
    coarse = coarsened(problem, _LEAST_ELEMENTS)
    if coarse is problem:
        return None
    try:
        return coarse, solve(coarse, bound_guess, cascade=False).state
    except LoadNotReached:
        return None


def _surrounding(difference: Array) -> Array:
    """Root mean square of a map over the surroundings of each point, NaN where it is."""
    known = np.isfinite(difference)
    weight = gaussian_filter(known.astype(float), _AVERAGED, mode="nearest")
    squares = gaussian_filter(np.where(known, difference, 0.0) ** 2, _AVERAGED, mode="nearest")
    return np.where(known, np.sqrt(squares / np.maximum(weight, 1e-12)), np.nan)
