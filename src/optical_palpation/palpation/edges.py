"""How much the sides of the layer matter: where it ends decides part of what it carries.

The layer is solved twice more on a coarse grid, with the sides that it has and with others. Both
grids have the same nodes within the field of view: the difference is due to the sides alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.mechanics.cascade import LoadNotReached, Solution, solve
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.iteration import TOLERANCES, relaxed
from optical_palpation.mechanics.newton import Balance, balance
from optical_palpation.mechanics.path import StepControl
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem
from optical_palpation.palpation.meshing import PADDING, Edges, expected_forces, padded_nodes
from optical_palpation.palpation.surface import material_points, per_area

Array = NDArray[np.float64]

#: Influence from which figures and report mark it.
NOTABLE = 0.05
#: Elements across the field of view; with them the influence differs by a few hundredths from that
#: on four times as many.
_ACROSS = 16
#: Least width, in thicknesses, of the elements at the sides, on both grids.
_SIDE = 1 / 3
#: Newton iterations in which each coarse solution must arrive; most take 10 to 20.
_ALLOWED = 60
#: Load increments, longer ones than those of a result, and how much further from equilibrium a
#: coarse solution may be than that is. Ten times more still and solutions end on another branch.
_CONTROL, _RELAXED = StepControl(0.25, 0.5, iterations=6), 20.0


@dataclass(frozen=True)
class EdgeInfluence:
    """How much other sides would change what the layer carries.

    Attributes
    ----------
    other
        The sides that those of the layer were compared with: ``padded``, or ``free`` where the
        layer is padded.
    values
        |p' - p| / max(|p|, mean of |p|) at the points of the maps, where p is the contact pressure
        with the sides that the layer has and p' with the others; NaN where there is no layer, and
        where unknown.
    force
        Change of the force over the field of view with the other sides, as a fraction; NaN where
        unknown.
    fraction
        Of the map, where the values exceed ``NOTABLE``; NaN where unknown.
    beyond
        Change of the force, as a fraction, if the thickness went on beyond the unloaded extent of
        the layer as it is at its border; 0 where no pixel there counts.
    unknown
        Why it is not known, or "".
    """

    other: Edges
    values: Array
    force: float
    fraction: float
    beyond: float = 0.0
    unknown: str = ""

    def described(self) -> xr.DataArray:
        """Return the values as a map that says what they are."""
        return xr.DataArray(
            self.values,
            dims=("y", "x"),
            attrs={
                "units": "1",
                "long_name": "influence of the layer's sides",
                "comment": "change of the contact pressure on a coarse grid if the sides were "
                f"{self.other}, as a fraction of the pressure there or, where that is larger, of "
                "its mean",
            },
        )

    @property
    def attributes(self) -> dict[str, str | float]:
        """Attributes of the maps: what is known of the influence as numbers."""
        about: dict[str, str | float] = {"edge_influence_other": self.other}
        if self.unknown:
            return about | {"edge_influence_unknown": self.unknown}
        return about | {
            "edge_influence_fraction": self.fraction,
            "edge_influence_force": self.force,
            **({"beyond_extent_force": self.beyond} if self.beyond else {}),
        }


def edge_influence(
    problem: LayerProblem,
    edges: Edges,
    field: tuple[float, float, float, float],
    x: Array,
    y: Array,
    within: Imprint | None = None,
) -> EdgeInfluence:
    """Compare the sides of a layer with others, on a coarse grid.

    Parameters
    ----------
    problem
        The layer on its own grid.
    edges
        The sides that it has.
    field
        Extent (x0, x1, y0, y1) of the layer without padding, mm.
    x, y
        Points of the maps, mm.
    within
        Imprint of the pixels in the extent of a free layer alone, where its own has others.
    """
    other: Edges = "free" if edges == "padded" else "padded"
    size = _size(problem, field)
    # a layer whose free edges were left coarse bears no narrower ones
    own = min(max(problem.grid.edge_widths), size) if edges == "free" else 0.0
    edge = max(_SIDE * problem.grid.typical_thickness, own)
    problem = replace(problem, imprint=problem.imprint.smoothed(0.5 * size))
    apart = problem
    if within is not None:
        apart = replace(problem, imprint=within.smoothed(0.5 * size))
    cases: list[tuple[LayerProblem, Edges]] = [(problem, edges), (apart, other)]
    if within is not None:
        cases.append((apart, edges))
    pressures = []
    for case, sides in cases:
        try:
            pressures.append(_pressure(_solved(_coarse(case, sides, field, size, edge)), x, y))
        except LoadNotReached as failure:
            unknown = f"on a coarse grid, the layer with {sides} sides {failure}"
            nowhere = np.full((y.size, x.size), np.nan)
            return EdgeInfluence(other, nowhere, np.nan, np.nan, unknown=unknown)
    shares = np.outer(_shares(y), _shares(x))
    found = _compared(other, pressures[0], pressures[1], shares)
    if within is None:
        return found
    return replace(found, beyond=_compared(other, pressures[0], pressures[2], shares).force)


def _compared(other: Edges, here: Array, there: Array, shares: Array) -> EdgeInfluence:
    """Compare two contact pressures; ``shares`` of the area are those of the points."""
    covered = np.isfinite(here) | np.isfinite(there)
    here, there = np.nan_to_num(here), np.nan_to_num(there)
    mean = float((shares * np.abs(here)).sum())
    if mean == 0.0:  # nothing touches, whatever the sides
        return EdgeInfluence(other, np.where(covered, 0.0, np.nan), 0.0, 0.0)
    values = np.where(covered, np.abs(there - here) / np.maximum(np.abs(here), mean), np.nan)
    force, change = ((shares * pressure).sum() for pressure in (here, there - here))
    fraction = shares[values > NOTABLE].sum() / shares[covered].sum()
    return EdgeInfluence(other, values, float(change / abs(force)), float(fraction))


def _shares(axis: Array) -> Array:
    """Shares of the width for which the points of an axis stand; the outermost ones for half.

    At a side that sticks the pressure is many times its mean.
    """
    steps = np.diff(axis, append=axis[-1]) + np.diff(axis, prepend=axis[0])
    return np.asarray(steps / steps.sum())


def _size(problem: LayerProblem, field: tuple[float, float, float, float]) -> float:
    """Size of the elements of the coarse grid, mm."""
    x0, x1, y0, y1 = field
    finest = float(np.sqrt(np.prod(problem.grid.spacing[1:])))
    size = min(np.sqrt((x1 - x0) * (y1 - y0)) / _ACROSS, 0.25 * min(x1 - x0, y1 - y0))
    return max(float(size), finest)


def _coarse(
    problem: LayerProblem,
    sides: Edges,
    field: tuple[float, float, float, float],
    size: float,
    edge: float,
) -> LayerProblem:
    """Return the problem, its imprint smoothed, on the coarse grid of elements of a ``size``, mm.

    Its sides are free, roller or padded, elements there of a width ``edge``, mm.
    """
    x0, x1, y0, y1 = field
    thickness = problem.grid.typical_thickness
    x, y = (node_positions(b - a, size, a, edge=edge) for a, b in ((x0, x1), (y0, y1)))
    if sides == "padded":
        x, y = (padded_nodes(nodes, PADDING * thickness) for nodes in (x, y))
    layers = min(problem.grid.shape[0], int(np.clip(round(thickness / size), 2, 4)))
    unloaded = problem.imprint.evaluate(*np.meshgrid(x, y), 0.0)[0]
    return replace(
        problem,
        grid=LayerGrid(x, y, np.linspace(0.0, 1.0, layers + 1), unloaded),
        edges="roller" if sides == "roller" else "free",
    )


def _solved(problem: LayerProblem) -> Solution:
    """Solve a coarse problem, as well as is needed for a percentage.

    Raises
    ------
    LoadNotReached
        Also where it takes too long, or elements are inside out.
    """
    count = 0

    def limited(
        level: LayerProblem, load: float, iteration: int, now: Balance, krylov: int
    ) -> None:
        nonlocal count
        count += iteration > 0
        if count > _ALLOWED:
            raise LoadNotReached(load, f"{_ALLOWED} Newton iterations are not enough")

    solution = solve(
        problem,
        lambda level: expected_forces(level, problem.law),
        cascade=False,
        tolerances=relaxed(TOLERANCES, _RELAXED),
        control=_CONTROL,
        on_iteration=limited,
    )
    if balance(problem, solution.state).min_jacobian <= 0:
        raise LoadNotReached(1.0, "elements are inside out")
    return solution


def _pressure(solution: Solution, x: Array, y: Array) -> Array:
    """Contact pressure at points of the laboratory frame, (y, x), kPa; NaN without a layer."""
    from scipy.interpolate import RegularGridInterpolator  # slow to load

    grid = solution.problem.grid
    surface = grid.nodes[:, -1] + solution.state.u[:, -1]
    pressure = per_area(grid, surface, solution.state.normal_force[SAMPLE])
    target = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)
    reference, outside = material_points(grid, surface[0], surface[1], target)
    return np.where(outside, np.nan, RegularGridInterpolator((grid.y, grid.x), pressure)(reference))
