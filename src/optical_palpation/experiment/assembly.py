"""From a scene to bodies and contacts."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from optical_palpation.experiment.scene import Scene, map_height, volume_factor
from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh, assemble
from optical_palpation.mechanics.stack.problem import Stack
from optical_palpation.palpation.memory import check_stack_memory

Array = NDArray[np.float64]


def build(
    scene: Scene,
    *,
    coarsening: float = 1.0,
    relief: xr.DataArray | None = None,
    stiffness: xr.DataArray | None = None,
) -> Stack:
    """Mesh a scene with elements ``coarsening`` times as large as it asks for.

    Raises
    ------
    InputError
        If the elements are too large, or the relief leaves next to nothing of the sample.
    InsufficientMemoryError
        If they are too many.
    """
    layer, sample, friction = scene.layer, scene.sample, scene.friction

    def height(x: Array, y: Array) -> Array:
        total = sum((part.height(x, y) for part in sample.relief), np.zeros_like(x))
        return total if relief is None else total + map_height(relief, x, y)

    blocks = Blocks(
        extent=(0.0, layer.size[0], 0.0, layer.size[1]),
        thickness=lambda x, _: np.full(x.shape, layer.thickness),
        law=layer.material,
        sample_size=sample.size,
        sample_thickness=sample.thickness,
        sample_law=sample.material,
        relief=height,
        friction=(friction.window, friction.sample, friction.plate),
        travel=scene.compression,
    )
    asked = scene.mesh
    mesh = Mesh(asked.element_size, asked.edge_size, asked.layer_elements, asked.growth)
    if coarsening != 1.0:
        mesh = mesh.coarser(coarsening, layer.thickness)
    check_stack_memory(blocks, mesh)
    return assemble(blocks, mesh, lambda grid: _stiffness(scene, grid, stiffness))


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
