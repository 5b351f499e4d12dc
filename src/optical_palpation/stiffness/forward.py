"""The forward model: layer and sample on a mesh, pressed, and what the thickness would then be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.stack.assembly import Blocks, Mesh, assemble
from optical_palpation.mechanics.stack.cascade import solve
from optical_palpation.mechanics.stack.problem import INTERFACE, LAYER, SAMPLE, WINDOW, Stack, State
from optical_palpation.mechanics.stack.tangent import Tangent, stiffness_forces
from optical_palpation.stiffness.measurement import ThicknessSurface

Array = NDArray[np.float64]

#: Elements up to which the load path is followed on the mesh itself.
_COARSEST = 4000
#: Coarser meshes have at least so many elements across the smaller of layer and sample.
_ACROSS = 8


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of the sample, whose stiffness is sought: their borders along y and x, mm."""

    y: Array
    x: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of columns (y, x)."""
        return len(self.y) - 1, len(self.x) - 1

    @property
    def middles(self) -> tuple[Array, Array]:
        """Middles of the columns along y and x, mm."""
        return 0.5 * (self.y[1:] + self.y[:-1]), 0.5 * (self.x[1:] + self.x[:-1])

    def means(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Matrices by which values of the columns are averaged between other borders."""
        return _overlaps(self.y, y), _overlaps(self.x, x)

    def at(self, values: Array, x: Array, y: Array) -> Array:
        """Values of the columns (y, x) at points, linearly between the middles of columns."""
        middles = self.middles
        points = [np.clip(p, m[0], m[-1]) for p, m in zip((y, x), middles, strict=True)]
        at = RegularGridInterpolator(middles, values)
        return np.asarray(at(np.stack(points, axis=-1)), dtype=float)


def carried(values: Array, of: LayerGrid, to: LayerGrid) -> Array:
    """Bring nodal values (ny + 1, nx + 1) linearly from one grid of a face to another."""
    return _linear(of.y, to.y) @ values @ _linear(of.x, to.x).T


def carrying(of: LayerGrid, to: LayerGrid) -> Array:
    """Matrix of ``carried`` for values in one row."""
    return np.asarray(np.kron(_linear(of.y, to.y), _linear(of.x, to.x)), dtype=float)


def _linear(nodes: Array, points: Array) -> Array:
    columns = [np.interp(points, nodes, unit) for unit in np.eye(len(nodes))]
    return np.stack(columns, axis=1).astype(float)


def _overlaps(borders: Array, others: Array) -> Array:
    """Shares (others, borders) in which intervals consist of other intervals."""
    upper = np.minimum(borders[1:], others[1:, None])
    shares = np.clip(upper - np.maximum(borders[:-1], others[:-1, None]), 0.0, None)
    return np.asarray(shares / shares.sum(1, keepdims=True), dtype=float)


class Model:
    """Layer and sample on one mesh, solved from coarse to fine.

    Parameters
    ----------
    blocks, mesh
        What is pressed, and the elements of the finest mesh.
    columns
        Where the stiffness of the sample is given.
    """

    def __init__(self, blocks: Blocks, mesh: Mesh, columns: Columns) -> None:
        self.blocks, self.mesh, self.columns = blocks, mesh, columns
        x0, x1, y0, y1 = blocks.extent
        smallest = min(x1 - x0, y1 - y0, *blocks.sample_size)
        thickness = float(np.median(blocks.thickness(*np.meshgrid([x0, x1], [y0, y1]))))
        self.levels = [assemble(blocks, mesh)]
        while self.levels[0].n_elements > _COARSEST:
            factor = 2.0 ** len(self.levels)
            if factor * mesh.size > smallest / _ACROSS:
                break
            self.levels.insert(0, assemble(blocks, mesh.coarser(factor, thickness)))
        self._means = [
            columns.means(level.bodies[SAMPLE].grid.y, level.bodies[SAMPLE].grid.x)
            for level in self.levels
        ]

    @property
    def means(self) -> Array:
        """Matrix (columns of elements, columns) by which stiffness comes to the finest mesh."""
        return np.asarray(np.kron(*self._means[-1]), dtype=float)

    @property
    def layer(self) -> LayerGrid:
        """The layer's grid on the finest mesh."""
        return self.levels[-1].bodies[LAYER].grid

    def changed(self, **inputs: Any) -> Model:
        """Return the model with other values of ``blocks``."""
        return Model(replace(self.blocks, **inputs), self.mesh, self.columns)

    def pressed(
        self,
        stiffness: Array,
        report: Callable[[Stack, float, object], None] | None = None,
        travel: float | None = None,
    ) -> Pressed:
        """Press a sample of the logarithmic ``stiffness`` factors (y, x) of its columns.

        ``travel`` of the plate, mm, by default that of the blocks.

        Raises
        ------
        LoadNotReached
        """
        levels = [
            _of_stiffness(level, by_y @ stiffness @ by_x.T, travel or self.blocks.travel)
            for level, (by_y, by_x) in zip(self.levels, self._means, strict=True)
        ]
        return Pressed(levels[-1], solve(levels, report).state)


def _of_stiffness(stack: Stack, logarithm: Array, travel: float) -> Stack:
    layer, sample = stack.bodies
    factor = np.broadcast_to(np.exp(logarithm), sample.grid.shape).copy()
    bodies = layer, replace(sample, stiffness=factor)
    return replace(stack, bodies=bodies, compression=travel)


@dataclass(frozen=True, eq=False)
class Pressed:
    """Layer and sample in equilibrium under the full travel."""

    stack: Stack
    state: State

    @property
    def surface(self) -> Array:
        """Positions (3, ny + 1, nx + 1) of the layer's nodes on the side of the sample, mm."""
        return self._layer[:, -1]

    @property
    def layer(self) -> LayerGrid:
        """The layer's grid."""
        return self.stack.bodies[LAYER].grid

    @property
    def _layer(self) -> Array:
        return self.stack.bodies[LAYER].nodes + self.stack.split(self.state.u)[LAYER]

    @property
    def force(self) -> float:
        """Total force on the window, mN."""
        sides = self.stack.sides.force(self.stack.position(self.state.u))[0].sum()
        return float(self.state.forces[WINDOW].sum() + sides)

    @property
    def slaves(self) -> LayerGrid:
        """Grid of the body whose nodes are held against the surface of the other."""
        return self.stack.slave_grids[INTERFACE]

    @property
    def pressure(self) -> Array:
        """Contact pressure of the slaves, kPa of unloaded area, (ny + 1, nx + 1)."""
        shape = self.slaves.node_shape[1:]
        return (self.state.forces[INTERFACE] / self.stack.areas[INTERFACE]).reshape(shape)

    def misfit(self, measured: ThicknessSurface) -> Array:
        """Thickness where the layer's nodes are, less the measured one, (ny + 1, nx + 1), mm."""
        position, grid = self._layer, self.stack.bodies[LAYER].grid
        x, y, z = position[:, -1].reshape(3, -1)
        at = np.stack([np.clip(y, grid.y[0], grid.y[-1]), np.clip(x, grid.x[0], grid.x[-1])], -1)
        window = RegularGridInterpolator((grid.y, grid.x), position[2, 0])(at)
        return (z - window - measured(x, y)).reshape(position.shape[2:])

    def sensitivity(self, measured: ThicknessSurface) -> Sensitivity:
        """Return what changes with the stiffness of the columns of elements and the travel."""
        stack, (ny, nx) = self.stack, self.stack.bodies[SAMPLE].grid.shape[1:]
        sample, first = stack.bodies[SAMPLE], stack.bodies[LAYER].n_nodes
        tangent = Tangent(stack, self.state)
        forces = stiffness_forces(sample, stack.split(self.state.u)[SAMPLE], self.state.p[SAMPLE])
        number = first + np.arange(sample.n_nodes).reshape(sample.grid.node_shape)
        rhs = np.zeros((3 * stack.n_nodes, ny * nx + 1))
        rhs[:, -1] = -tangent.by_travel()
        for b in range(2):
            for a in range(2):
                nodes = number[:, b : ny + b, a : nx + a].reshape(-1, ny * nx)
                for c in range(3):
                    own = forces[:, :, c, :, b, a].reshape(ny * nx, -1).T
                    rhs[3 * nodes + c, np.arange(ny * nx)] = -own
        moved = tangent.displacement(rhs)
        x, y, _ = self.surface.reshape(3, -1)
        top = np.arange(first).reshape(stack.bodies[LAYER].grid.node_shape)[-1].ravel()
        slope_x, slope_y = measured(x, y, dx=1), measured(x, y, dy=1)
        thickness = moved[3 * top + 2]
        thickness -= slope_x[:, None] * moved[3 * top] + slope_y[:, None] * moved[3 * top + 1]
        contact = tangent.contact_forces[INTERFACE] @ moved
        return Sensitivity(
            thickness=thickness,
            pressure=contact / stack.areas[INTERFACE][:, None],
            force=np.asarray((tangent.contact_forces[WINDOW] @ moved).sum(0)),
        )


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives by the logarithms of the stiffness of the columns of elements and the travel.

    They are on the last axis, the travel, mm, at its end.
    ``thickness`` of ``Pressed.misfit``, mm, ``pressure`` of the slaves, kPa, and ``force`` on the
    window, mN. Friction is taken from the slip since the last load step.
    """

    thickness: Array
    pressure: Array
    force: Array

    def of(self, parameters: Array) -> Sensitivity:
        """By other parameters, of which these are the matrix ``parameters`` times."""
        return Sensitivity(
            self.thickness @ parameters, self.pressure @ parameters, self.force @ parameters
        )
