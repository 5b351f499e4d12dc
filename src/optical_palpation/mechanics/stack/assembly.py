"""Meshes of a layer on a deformable sample, and the contacts between window, both and plate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import prod

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.material import Law

from ..body import Body
from ..contact import smoothness
from ..grid import LayerGrid, node_positions
from ..side_contact import Facets, PlaneSides
from .problem import WINDOW, Stack, column_forces
from .projection import Interface, Plane

Array = NDArray[np.float64]
Axes = tuple[Array, Array, Array]
Field = Callable[[Array, Array], Array]

#: Points for each element at which the highest one is sought.
_BETWEEN = 8
_GROWTH_OUTSIDE = 1.3  # of the layer's elements beyond the sample
#: Slip over which friction builds up, as a share of the layer's thickness, if that is pressed by a
#: tenth of it or more.
_SLIP_LENGTH = 2e-3


@dataclass(frozen=True)
class Mesh:
    """Sizes of elements, mm.

    ``size`` is that of the layer, laterally and, unless ``layers`` says how many there are, across
    it; ``edge`` that of the outermost ones; the sample's grow by ``growth`` each towards the plate,
    from those of the layer on, unless ``below`` says how many there are.
    """

    size: float
    edge: float | None = None
    layers: int | None = None
    growth: float = 1.25
    below: int | None = None

    def coarser(self, factor: float, thickness: float) -> Mesh:
        """Return elements ``factor`` times as large for a layer of that thickness."""
        wanted = self.layers or max(3, round(thickness / self.size))
        return Mesh(
            factor * self.size,
            self.edge and factor * self.edge,
            max(2, round(wanted / factor)),
            self.growth**factor,
        )


@dataclass(frozen=True)
class Blocks:
    """A layer and the sample below it, which is centred there.

    ``extent`` (x0, x1, y0, y1) of the layer, its unloaded ``thickness`` and the sample's
    ``relief``, both functions of x and y, ``sample_size`` (x, y) and ``sample_thickness``, that
    below a relief of 0; all in mm. ``friction`` at window, interface and plate; ``travel`` of the
    plate after layer and sample have met, mm.
    """

    extent: tuple[float, float, float, float]
    thickness: Field
    law: Law
    sample_size: tuple[float, float]
    sample_thickness: float
    sample_law: Law
    relief: Field
    friction: tuple[float, float, float]
    travel: float

    @property
    def layer_size(self) -> tuple[float, float]:
        """Width of the layer along x and y, mm."""
        x0, x1, y0, y1 = self.extent
        return x1 - x0, y1 - y0

    def reach(self, x: Array, y: Array) -> float:
        """How far layer and relief stand out together where they touch first, mm.

        That is where both are thickest together, which need not be at one of the nodes ``x`` and
        ``y`` of the sample, and never where the sample goes on beyond the layer.
        """
        x0, x1, y0, y1 = self.extent
        at = np.meshgrid(np.clip(_divided(x), x0, x1), np.clip(_divided(y), y0, y1))
        return float((self.thickness(*at) + self.relief(*at)).max())


def assemble(
    blocks: Blocks, mesh: Mesh, stiffness: Callable[[LayerGrid], Array] | None = None
) -> Stack:
    """Mesh layer and sample; ``stiffness`` gives the factor of each element of the sample.

    Raises
    ------
    InputError
        If the elements are too large, or the relief leaves next to nothing of the sample.
    """
    (layer_depth, layer_y, layer_x), (depth, sample_y, sample_x) = _node_axes(blocks, mesh)
    unloaded = blocks.thickness(*np.meshgrid(layer_x, layer_y))
    layer_grid = LayerGrid(layer_x, layer_y, layer_depth, unloaded)
    layer = Body(layer_grid, blocks.law)

    at = np.meshgrid(sample_x, sample_y)
    height = blocks.relief(*at)
    reach = blocks.reach(sample_x, sample_y)
    top = reach - height
    plate = reach + blocks.sample_thickness
    if (plate - top).min() < 0.1 * blocks.sample_thickness:
        raise InputError(
            f"sample: the relief reaches down to {(plate - top).min():.3g} mm above the plate; "
            f"make the sample thicker than {blocks.sample_thickness:g} mm or the relief flatter"
        )
    sample_grid = LayerGrid(sample_x, sample_y, depth, plate - top)
    factors = stiffness(sample_grid) if stiffness else np.ones(sample_grid.shape)
    sample = Body(sample_grid, blocks.sample_law, factors, top)

    number = np.arange(layer.n_nodes).reshape(layer_grid.node_shape)
    below = number.size + np.arange(sample.n_nodes).reshape(sample_grid.node_shape)
    # The slaves are those of the smaller body, so that none slides off the other's edge; of equal
    # ones the layer's, as it is held by the window.
    if any(
        own < length * (1 - 1e-9)
        for own, length in zip(blocks.sample_size, blocks.layer_size, strict=True)
    ):
        slave, master, side = sample_grid, layer_grid, 1.0
        faces = below[0], number[-1]
    else:
        slave, master, side = layer_grid, sample_grid, -1.0
        faces = number[-1], below[0]
    start = np.stack(
        [
            np.tile(np.interp(slave.x, master.x, np.arange(master.x.size)), slave.y.size),
            np.repeat(np.interp(slave.y, master.y, np.arange(master.y.size)), slave.x.size),
        ],
        axis=1,
    )
    surfaces = (
        (layer_grid, layer.nodes[:, 0]),
        (slave, (sample.nodes[:, 0] if side > 0 else layer.nodes[:, -1])),
        (sample_grid, sample.nodes[:, -1]),
    )
    window, interface, base = (grid.surface_areas(nodes) for grid, nodes in surfaces)
    at_window, at_interface, at_plate = blocks.friction
    free = (True, True, True, True)
    stack = Stack(
        bodies=(layer, sample),
        contacts=(
            Plane(number[0].ravel(), -1.0, at_window),
            Interface(faces[0], faces[1], at_interface, side, start, master.spacing[2], interface),
            Plane(below[-1].ravel(), 1.0, at_plate),
        ),
        sides=(
            PlaneSides(layer, Facets.of(layer_grid, free), -1.0, at_window, 1.0),
            PlaneSides(sample, Facets.of(sample_grid, free), 1.0, at_plate, 1.0),
        ),
        slave_grids=(layer_grid, slave, sample_grid),
        areas=(window.ravel(), interface.ravel(), base.ravel()),
        plate=plate,
        travel=blocks.travel,
        slip_length=_SLIP_LENGTH * layer_grid.typical_thickness,
    )
    pressure = column_forces(stack)[WINDOW].sum() / window.sum()
    on_layer, on_sample = (
        replace(sides, flattened=1 - min(0.5, pressure / (3 * sides.body.law.shear_modulus)))
        for sides in stack.sides
    )
    slip_length = stack.slip_length * smoothness(stack.compression)
    return replace(stack, sides=(on_layer, on_sample), slip_length=slip_length)


def count_elements(blocks: Blocks, mesh: Mesh) -> int:
    """Elements that layer and sample will have.

    Raises
    ------
    InputError
        If the elements are too large.
    """
    return sum(prod(len(nodes) - 1 for nodes in axes) for axes in _node_axes(blocks, mesh))


def settled(mesh: Mesh, blocks: Blocks) -> Mesh:
    """Return the mesh with as many elements across layer and sample as it has for these blocks.

    Others, whose thickness is a little different, then get the same mesh, and do not differ by it.
    """
    (layer_depth, _, _), (depth, _, _) = _node_axes(blocks, mesh)
    return replace(mesh, layers=len(layer_depth) - 1, below=len(depth) - 1)


def _node_axes(blocks: Blocks, mesh: Mesh) -> tuple[Axes, Axes]:
    """Nodes of layer and sample along z, as fractions of their thickness, y and x, mm."""
    x0, _, y0, _ = blocks.extent
    lateral = [
        _lateral(length, own, mesh.size, mesh.edge, axis)
        for length, own, axis in zip(blocks.layer_size, blocks.sample_size, "xy", strict=True)
    ]
    (layer_x, sample_x), (layer_y, sample_y) = (
        (start + a, start + b) for start, (a, b) in zip((x0, y0), lateral, strict=True)
    )
    typical = float(np.median(blocks.thickness(*np.meshgrid(layer_x, layer_y))))
    count = mesh.layers or max(3, round(typical / mesh.size))
    below = mesh.below or _graded(blocks.sample_thickness, typical / count, mesh.growth)
    widths = mesh.growth ** np.arange(below)
    depth = np.concatenate([[0.0], np.cumsum(widths) / widths.sum()])
    return (np.linspace(0, 1, count + 1), layer_y, layer_x), (depth, sample_y, sample_x)


def _lateral(
    layer: float, sample: float, size: float, edge: float | None, axis: str
) -> tuple[Array, Array]:
    """Lateral nodes of layer and sample along one axis, equal where both bodies are."""
    smaller = min(layer, sample)
    if size > 0.25 * smaller * (1 + 1e-9):
        raise InputError(
            f"mesh: element_size {size:g} mm is larger than a quarter of the smaller body along "
            f"{axis}, {0.25 * smaller:g} mm"
        )
    start = 0.5 * (layer - smaller)
    if edge is not None and edge > size:
        within = start + edge + node_positions(smaller - 2 * edge, size)
        inner = np.concatenate([[start], within, [start + smaller]])
    else:
        inner = node_positions(smaller, size, start, edge=edge)
    return _extended(inner, start, size), _extended(inner, 0.5 * (sample - smaller), size)


def _divided(nodes: Array) -> Array:
    """Nodes with further points between them."""
    numbers = np.linspace(0, len(nodes) - 1, _BETWEEN * (len(nodes) - 1) + 1)
    return np.interp(numbers, np.arange(len(nodes)), nodes)


def _extended(inner: Array, width: float, size: float) -> Array:
    """Continue nodes on both sides by ``width`` with growing elements."""
    if width < 1e-9:
        return inner
    widths = [min(_GROWTH_OUTSIDE * (inner[1] - inner[0]), size)]
    while sum(widths) < width:
        widths.append(min(widths[-1] * _GROWTH_OUTSIDE, 2 * size))
    outside = np.cumsum(widths) * width / sum(widths)
    return np.concatenate([inner[0] - outside[::-1], inner, inner[-1] + outside])


def _graded(thickness: float, first: float, growth: float) -> int:
    """How many elements that grow from about ``first`` by ``growth`` each fill a thickness."""
    widths = [first]
    while sum(widths) < thickness - 0.5 * widths[-1] * growth:
        widths.append(widths[-1] * growth)
    return max(2, len(widths))
