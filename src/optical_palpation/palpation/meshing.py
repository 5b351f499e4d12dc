"""The layer's elements and the imprint: from thickness maps to a boundary-value problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.material import Law
from optical_palpation.mechanics.contact import smoothness
from optical_palpation.mechanics.grid import (
    LayerGrid,
    depth_positions,
    edge_width,
    node_positions,
)
from optical_palpation.mechanics.imprint import Imprint
from optical_palpation.mechanics.problem import SAMPLE, LayerProblem
from optical_palpation.mechanics.similar import Similar
from optical_palpation.thickness.frames import inside_layer, layer_extent_of, typical_thickness

Array = NDArray[np.float64]
Edges = Literal["free", "roller", "padded"]
#: What holds a face of the layer: Coulomb friction of this coefficient, or glue.
Hold = float | Literal["glued"]

#: Slip length of the friction law, in thicknesses: by default (1 um on a layer of 0.5 mm) where it
#: is compressed by a tenth or more, and between which bounds.
SLIP_LENGTH, SLIP_LENGTHS = 2e-3, (1e-5, 0.05)
#: Times by which the pixels of an imprint are finer than those of an uneven map are in the mean, at
#: most.
_FINEST = 4
#: Width, in thicknesses, by which ``padded`` edges continue the layer past the field of view.
PADDING = 3.0


def layer_problem(
    loaded: xr.DataArray,
    initial: xr.DataArray,
    motion: xr.DataArray | None,
    material: Law,
    held: Mapping[str, Hold],
    sizes: tuple[float, float, float],
    edges: Edges,
    smoothing: float,
    slip_length: float | None,
    similar: Similar | None = None,
) -> LayerProblem:
    """Mesh the layer and make the imprint; ``held`` says what holds ``window`` and ``sample``.

    Without ``slip_length`` that is ``SLIP_LENGTH`` thicknesses, of a layer that is hardly pressed
    in proportion less (``smoothness``).
    """
    x0, x1, y0, y1 = layer_extent_of(loaded)
    thickness = typical_thickness(initial)
    beyond = edges == "free"
    imprint = imprint_of(loaded, initial, motion, smoothing, beyond=beyond, similar=similar)
    depth, nodes_y, nodes_x = layer_nodes((x0, x1, y0, y1), thickness, sizes, edges)
    unloaded = imprint.evaluate(*np.meshgrid(nodes_x, nodes_y), 0.0)[0]
    glued = held["window"] == "glued", held["sample"] == "glued"
    window, sample = (0.0 if hold == "glued" else hold for hold in (held["window"], held["sample"]))
    problem = LayerProblem(
        grid=LayerGrid(nodes_x, nodes_y, depth, unloaded),
        imprint=imprint,
        law=material,
        friction=(window, sample),
        edges="roller" if edges == "roller" else "free",
        glued=glued,
    )
    if slip_length is None:
        slip_length = SLIP_LENGTH * thickness * smoothness(problem.compression)
    return replace(problem, slip_length=float(slip_length))


def imprint_of(
    loaded: xr.DataArray,
    initial: xr.DataArray,
    motion: xr.DataArray | None,
    smoothing: float,
    *,
    beyond: bool,
    similar: Similar | None = None,
) -> Imprint:
    """Make the imprint, mm, smoothed; ``beyond`` says whether pixels beyond the layer count.

    A free side bulges over its unloaded extent, and what was measured there is the layer. Between
    rollers it does not, and a padded layer goes on as it is at the border.
    """
    fields = [loaded, initial] if motion is None else [loaded, initial, motion]
    if not beyond:
        inside = inside_layer(loaded)
        here = {"y": inside.any(axis=1), "x": inside.any(axis=0)}
        fields = [field.isel(here) for field in fields]
    loaded, initial = fields[:2]
    x, y = _uniform(loaded["x"].values), _uniform(loaded["y"].values)
    maps = []
    for field in fields:
        same = np.array_equal(x, field["x"]) and np.array_equal(y, field["y"])
        maps.append(field.values if same else field.interp(x=x, y=y).values)
    imprint = Imprint(x, y, maps[1], maps[0], maps[2] if motion is not None else None)
    if similar is not None:
        imprint = similar.imprint(imprint)
    return imprint.smoothed(smoothing) if smoothing > 0 else imprint


def layer_nodes(
    extent: tuple[float, float, float, float],
    thickness: float,
    sizes: tuple[float, float, float],
    edges: Edges,
) -> tuple[Array, Array, Array]:
    """Nodes of a layer along depth, as fractions of it, and along y and x, mm.

    ``extent`` is x0, x1, y0, y1, ``sizes`` are those of the elements along x, y and z; all in mm.
    """
    x0, x1, y0, y1 = extent
    depth = depth_positions(sizes[2] / thickness, edges == "free")
    edge = edge_width(depth, thickness) if edges == "free" else None
    x = node_positions(x1 - x0, sizes[0], x0, edge=edge)
    y = node_positions(y1 - y0, sizes[1], y0, edge=edge)
    if edges == "padded":
        x, y = (padded_nodes(nodes, PADDING * thickness) for nodes in (x, y))
    return depth, y, x


def _uniform(positions: Array) -> Array:
    steps = np.diff(positions)
    if np.ptp(steps) < 1e-3 * steps.mean():
        return positions
    # Two pixels may lie next to each other, and would make millions of all.
    step = max(steps.min(), steps.mean() / _FINEST)
    count = int(np.ceil((positions[-1] - positions[0]) / step)) + 1
    return np.linspace(positions[0], positions[-1], count)


def padded_nodes(nodes: Array, width: float) -> Array:
    """Continue node positions on both sides by ``width`` with slowly growing elements."""
    size = nodes[1] - nodes[0]
    count = 1
    while size * (1.2 ** (count + 1) - 1.2) / 0.2 < width:
        count += 1
    beyond = np.cumsum(1.2 ** np.arange(1, count + 1))
    beyond *= width / beyond[-1]  # how far the layer goes on decides the force
    return np.concatenate([nodes[0] - beyond[::-1], nodes, nodes[-1] + beyond])


def expected_forces(level: LayerProblem, material: Law) -> Array:
    """Nodal contact forces at full load that the algebraic method expects."""
    grid = level.grid
    height = level.imprint.evaluate(*np.meshgrid(grid.x, grid.y), 1.0)[0]
    strain = np.minimum(height / grid.thickness, 1.0) - 1.0
    stress = material.strain_adjusted_modulus(strain) * -strain
    if level.edges == "roller":
        # with nowhere to go the layer answers to the loss of volume with its bulk modulus
        highest = np.inf if level.glued[SAMPLE] else grid.thickness
        lost = 1 - np.minimum(height, highest).mean() / grid.thickness.mean()
        stress = stress + material.bulk_modulus * lost
    return stress * grid.areas
