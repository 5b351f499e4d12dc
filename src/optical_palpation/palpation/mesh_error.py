"""How far a solution may be from that of an infinitely fine mesh, told from a coarser one.

What the solution changes by from a coarser grid to its own is extrapolated as Richardson does, and
enlarged by a safety factor (the grid convergence index of Roache, J. Fluids Eng. 116:405, 1994).
The nested iteration has solved the problem on a coarser grid anyway, but one that need not be
coarser along all axes. What elements are off by along the others that grid does not tell: this is
compared on further grids. A small problem, which has been solved on one grid only, is compared
along and across its depth separately: a layer that sticks is too stiff on few elements through the
depth, relief that is smoothed away is too soft, and together the two may cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from optical_palpation.mechanics.cascade import (
    LoadNotReached,
    Solution,
    halved,
    patience_with,
    solve,
)
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.problem import LayerProblem, LayerState

Array = NDArray[np.float64]
#: What a state is compared by: total force, mN, and axial stress on the points of the map, kPa.
Quantities = tuple[float, Array]
#: The layer on some grid, and its state at full load.
Loaded = tuple[LayerProblem, LayerState]

#: Safety factor, and the order of convergence that is counted on: the error of most maps falls with
#: an order between one and two, the lower one by the more.
SAFETY, ORDER = 1.25, 1.0
#: Share of the force by which free edges may be off besides: the widths of their outermost elements
#: and the smoothing of contact at the rim stay what they are on all grids.
FREE_EDGES = 0.005
#: Least ratio of two grids that tells anything.
_LEAST_RATIO = 1.2
#: The axes x and y; elements along them, at least, of a grid that has a coarser one.
_LATERAL, _LEAST_LATERAL = np.array([False, True, True]), 4
#: Elements of the largest grid on which the depth is compared, if the nested iteration has not.
_ELEMENTS = 4000
#: Further grids may take as much effort together as the solution itself, or so many seconds, and
#: with it no more than that share of what a solution may take, but for the seconds at last.
_EFFORT, _SHARE, _AT_LAST = 9.0, 1.2, 3.0
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


@dataclass(frozen=True)
class _Comparison:
    """Two solutions on grids that differ along some axes, and what the error is in differences."""

    pair: tuple[Loaded, Loaded]
    factor: float


def mesh_error(
    solution: Solution,
    quantities: Callable[[LayerProblem, LayerState], Quantities],
    bound_guess: Callable[[LayerProblem], Array],
    *,
    further: bool = True,
) -> MeshError | None:
    """Estimate the discretisation error of a solution.

    Parameters
    ----------
    quantities
        Function that returns what is compared of a solution.
    bound_guess
        As for :func:`~optical_palpation.mechanics.cascade.solve`.
    further
        Whether to solve the problem on further grids, if those of the nested iteration do not tell
        the whole error.

    Returns
    -------
    MeshError or None
        None where part of the error is unknown: the grid is too coarse itself, the load was not
        reached on another one or would have taken too long, or those that would tell must not be
        solved.
    """
    try:
        comparisons = _comparisons(solution, bound_guess, further)
    except LoadNotReached:
        return None
    if not comparisons or any(each.factor == np.inf for each in comparisons):
        return None
    known = dict[int, Quantities]()  # most solutions are compared with two others

    def of(problem: LayerProblem, state: LayerState) -> Quantities:
        if id(state) not in known:
            known[id(state)] = quantities(problem, state)
        return known[id(state)]

    problem = solution.problem
    force = of(problem, solution.state)[0]
    edges = FREE_EDGES * abs(force) if problem.edges == "free" else 0.0
    errors = [_difference(each, of) for each in comparisons]
    return MeshError(
        force=sum(of_force for of_force, _ in errors) + edges,
        stress=np.sum([of_stress for _, of_stress in errors], axis=0),
        elements=comparisons[0].pair[1][0].grid.n_elements,
    )


def _difference(
    comparison: _Comparison, quantities: Callable[[LayerProblem, LayerState], Quantities]
) -> Quantities:
    """Return the error that two solutions tell."""
    (force, stress), (other_force, other_stress) = (quantities(*each) for each in comparison.pair)
    return (
        comparison.factor * abs(force - other_force),
        comparison.factor * _surrounding(stress - other_stress),
    )


def _comparisons(
    solution: Solution, bound_guess: Callable[[LayerProblem], Array], further: bool
) -> list[_Comparison]:
    """Compare solutions on grids that together differ along all axes; none where they would not.

    Raises
    ------
    LoadNotReached
    """
    here: Loaded = solution.problem, solution.state
    found: list[_Comparison] = []
    if solution.wider is not None:
        wider = solution.wider.problem, solution.wider.state
        edges = _Comparison((here, wider), SAFETY / (2**ORDER - 1))
        while solution.wider is not None:
            solution = solution.wider
        # what elements inside are off by is told by the grids with edges as coarse as these
        inside = _comparisons(solution, bound_guess, further)
        return [edges, *inside] if inside else []
    if solution.coarser is not None:
        found.append(_coarser(here, solution.coarser))
        here = solution.coarser
    seen = _ratios(solution.problem, here[0]) > 1.0
    if seen.all():
        return found
    if not further:
        return []

    spent = solution.effort.spent
    most = max(_AT_LAST, _SHARE * patience_with(solution.problem) - spent)
    left = min(max(_EFFORT, spent), most)

    def solved(problem: LayerProblem) -> Loaded:
        nonlocal left
        other = solve(problem, bound_guess, patience=left, other_edges=False)
        left -= other.effort.spent
        return problem, other.state

    across = ~seen & _LATERAL
    if across.any():
        if min(here[0].grid.shape[1:]) < _LEAST_LATERAL:
            return []
        there = solved(halved(here[0], across))
        found.append(_coarser(here, there))
        here = there
    if not seen[0]:
        small = here[0]
        while 2 * small.grid.n_elements > _ELEMENTS and min(small.grid.shape[1:]) >= 12:
            fewer = halved(small, _LATERAL)
            if fewer.grid.n_elements >= small.grid.n_elements:
                break  # all are those of free edges, which stay
            small = fewer
        if small is not here[0]:
            here = solved(small)
        gained = 1 - 2.0**-ORDER
        found.append(_Comparison((here, solved(_deeper(small))), SAFETY / gained))
    return found


def _coarser(fine: Loaded, coarse: Loaded) -> _Comparison:
    """Compare with a solution on a coarser grid."""
    ratios = np.log(_ratios(fine[0], coarse[0]))
    ratio = float(np.exp(ratios.sum() / max(1, (ratios > 0).sum())))
    factor = SAFETY / (ratio**ORDER - 1) if ratio >= _LEAST_RATIO else np.inf
    return _Comparison((fine, coarse), factor)


def _ratios(fine: LayerProblem, coarse: LayerProblem) -> Array:
    """Return how much larger elements are along each axis (z, y, x) of a coarser grid."""
    sizes = [[_size(nodes) for nodes in level.grid.node_axes] for level in (fine, coarse)]
    return np.round(np.asarray(sizes[1]) / np.asarray(sizes[0]), 3)


def _size(nodes: Array) -> float:
    """Return the mean size of the element in which a point lies.

    Elements of free edges are as wide on all grids, and few points lie in them.
    """
    widths = np.diff(nodes)
    return float((widths**2).sum() / widths.sum())


def _deeper(problem: LayerProblem) -> LayerProblem:
    """Return the problem on twice as many elements through the depth.

    On half as many a layer that sticks can hardly flow sideways, and all but nothing would be told.
    """
    grid = problem.grid
    depth = np.interp(np.arange(2 * grid.shape[0] + 1) / 2, np.arange(len(grid.depth)), grid.depth)
    return problem.on_grid(LayerGrid(grid.x, grid.y, depth, grid.thickness))


def _surrounding(difference: Array) -> Array:
    """Root mean square of a map over the surroundings of each point, NaN where it is."""
    known = np.isfinite(difference)
    weight = gaussian_filter(known.astype(float), _AVERAGED, mode="nearest")
    squares = gaussian_filter(np.where(known, difference, 0.0) ** 2, _AVERAGED, mode="nearest")
    return np.where(known, np.sqrt(squares / np.maximum(weight, 1e-12)), np.nan)
