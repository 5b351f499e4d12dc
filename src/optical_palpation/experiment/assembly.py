"""From a scene to bodies, contacts and the unloaded state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.experiment.scene import Scene, map_height, volume_factor
from optical_palpation.mechanics.body import Body
from optical_palpation.mechanics.grid import LayerGrid, node_positions
from optical_palpation.mechanics.stack.contact import Sides
from optical_palpation.mechanics.stack.problem import WINDOW, Stack, column_forces
from optical_palpation.mechanics.stack.projection import Interface, Plane

Array = NDArray[np.float64]
_GROWTH_OUTSIDE = 1.3  # of the layer's elements beyond the sample


def build(
    scene: Scene,
    *,
    coarsening: float = 1.0,
    relief: xr.DataArray | None = None,
    stiffness: xr.DataArray | None = None,
) -> Stack:
    """Mesh a scene with elements ``coarsening`` times as large as it asks for."""
    layer, sample, mesh = scene.layer, scene.sample, scene.mesh
    size = coarsening * mesh.element_size
    edge = mesh.edge_size and coarsening * mesh.edge_size
    lateral = [_lateral(layer.size[n], sample.size[n], size, edge, "xy"[n]) for n in range(2)]
    (layer_x, sample_x), (layer_y, sample_y) = lateral

    wanted = mesh.layer_elements or max(3, round(layer.thickness / mesh.element_size))
    count = max(2, round(wanted / coarsening))
    flat = np.zeros((layer_y.size, layer_x.size))
    layer_grid = LayerGrid(layer_x, layer_y, np.linspace(0, 1, count + 1), flat + layer.thickness)
    bodies_layer = Body(layer_grid, layer.material)

    x, y = np.meshgrid(sample_x, sample_y)
    height = sum((part.height(x, y) for part in sample.relief), np.zeros_like(x))
    if relief is not None:
        height = height + map_height(relief, x, y)
    top = layer.thickness + height.max() - height
    plate = layer.thickness + height.max() + sample.thickness
    if (plate - top).min() < 0.1 * sample.thickness:
        raise InputError(
            f"sample: the relief reaches down to {(plate - top).min():.3g} mm above the plate; "
            f"make the sample thicker than {sample.thickness:g} mm or the relief flatter"
        )
    depth = _graded(sample.thickness, layer.thickness / count, mesh.growth**coarsening)
    sample_grid = LayerGrid(sample_x, sample_y, depth, plate - top)
    factors = _stiffness(scene, sample_grid, stiffness)
    bodies_sample = Body(sample_grid, sample.material, factors, top)

    number = np.arange(bodies_layer.n_nodes).reshape(layer_grid.node_shape)
    below = number.size + np.arange(bodies_sample.n_nodes).reshape(sample_grid.node_shape)
    # The slaves are those of the smaller body, so that none slides off the other's edge; of equal
    # ones the layer's, as it is held by the window.
    if any(sample.size[n] < layer.size[n] * (1 - 1e-9) for n in range(2)):
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
    friction = scene.friction
    surfaces = (
        (layer_grid, bodies_layer.nodes[:, 0]),
        (slave, (bodies_sample.nodes[:, 0] if side > 0 else bodies_layer.nodes[:, -1])),
        (sample_grid, bodies_sample.nodes[:, -1]),
    )
    element_height, _, width = layer_grid.spacing
    window, interface, base = (grid.surface_areas(nodes).ravel() for grid, nodes in surfaces)
    stack = Stack(
        bodies=(bodies_layer, bodies_sample),
        contacts=(
            Plane(number[0].ravel(), -1.0, friction.window),
            Interface(faces[0], faces[1], friction.sample, side, start, master.spacing[2]),
            Plane(below[-1].ravel(), 1.0, friction.plate),
        ),
        sides=Sides(
            number[layer_grid.side_nodes].ravel(),
            bodies_layer.law.shear_modulus * width,
            element_height,
        ),
        slave_grids=(layer_grid, slave, sample_grid),
        areas=(window, interface, base),
        plate=float(plate),
        compression=scene.compression,
        slip_length=2e-3 * layer.thickness,
    )
    pressure = column_forces(stack)[WINDOW].sum() / window.sum()
    strain = min(0.5, pressure / (3 * stack.shear_modulus))
    sides = replace(stack.sides, height=(1 - strain) * element_height)
    return replace(stack, sides=sides)


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


def _extended(inner: Array, width: float, size: float) -> Array:
    """Continue nodes on both sides by ``width`` with growing elements."""
    if width < 1e-9:
        return inner
    widths = [min(_GROWTH_OUTSIDE * (inner[1] - inner[0]), size)]
    while sum(widths) < width:
        widths.append(min(widths[-1] * _GROWTH_OUTSIDE, 2 * size))
    outside = np.cumsum(widths) * width / sum(widths)
    return np.concatenate([inner[0] - outside[::-1], inner, inner[-1] + outside])


def _graded(thickness: float, first: float, growth: float) -> Array:
    """Depth fractions of elements that grow from about ``first`` by ``growth`` each."""
    widths = [first]
    while sum(widths) < thickness - 0.5 * widths[-1] * growth:
        widths.append(widths[-1] * growth)
    if len(widths) < 2:
        widths = [1.0, 1.0]
    return np.concatenate([[0.0], np.cumsum(widths) / sum(widths)])


def _stiffness(scene: Scene, grid: LayerGrid, given: xr.DataArray | None) -> Array:
    """Stiffness factor of each element, taken at its centre."""
    z, y, x = np.meshgrid(
        *(0.5 * (n[1:] + n[:-1]) for n in (grid.depth, grid.y, grid.x)), indexing="ij"
    )
    thickness = grid.thickness
    mean = 0.25 * (
        thickness[1:, 1:] + thickness[1:, :-1] + thickness[:-1, 1:] + thickness[:-1, :-1]
    )
    depth = scene.sample.thickness - (1 - z) * mean
    factor = np.ones(grid.shape)
    for feature in scene.sample.stiffness:
        factor = feature.apply(factor, x, y, depth)
    if given is not None:
        factor = factor * volume_factor(given, x, y, depth)
    return factor
