"""The forward model: layer and sample on a mesh, pressed, and what the thickness would then be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator, make_interp_spline

from optical_palpation.mechanics.grid import LayerGrid
from optical_palpation.mechanics.path import LoadNotReached
from optical_palpation.mechanics.stack.assembly import (
    Blocks,
    Mesh,
    assemble,
    count_elements,
    settled,
)
from optical_palpation.mechanics.stack.cascade import solve
from optical_palpation.mechanics.stack.problem import INTERFACE, LAYER, SAMPLE, WINDOW, Stack, State
from optical_palpation.mechanics.stack.tangent import Tangent, shape_forces, stiffness_forces
from optical_palpation.stiffness.measurement import ThicknessSurface
from optical_palpation.thickness.frames import smooth_map

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

    @property
    def corners(self) -> tuple[int, int]:
        """Numbers of corners of columns (y, x)."""
        return len(self.y), len(self.x)

    def between(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Matrices that bring heights at the corners to nodes, as ``surface`` does."""
        return _spline(self.y, y), _spline(self.x, x)

    def surface(self, heights: Array) -> Callable[[Array, Array], Array]:
        """Heights at the corners (y, x) as a function of x and y: a cubic spline, level outside."""
        return smooth_map(xr.DataArray(heights, {"y": self.y, "x": self.x}, ("y", "x")))

    def at(self, values: Array, x: Array, y: Array) -> Array:
        """Values of the columns (y, x) at points, linearly between the middles of columns."""
        middles = self.middles
        points = [np.clip(p, m[0], m[-1]) for p, m in zip((y, x), middles, strict=True)]
        at = RegularGridInterpolator(middles, values)
        return np.asarray(at(np.stack(points, axis=-1)), dtype=float)


@dataclass(frozen=True, eq=False)
class Sought:
    """What is sought of a sample, or taken for it.

    Attributes
    ----------
    stiffness
        Logarithms of the stiffness factors of the columns, (y, x).
    travels
        Of the plate at each load, mm, ascending.
    relief
        Height of the unloaded surface at the corners of the columns, mm, (y, x), towards the layer.
        At 0 it touches a layer of even thickness when the travel is 0, above it does so before.
        None where the relief is known.
    """

    stiffness: Array
    travels: tuple[float, ...]
    relief: Array | None = None


def carried(values: Array, of: LayerGrid, to: LayerGrid) -> Array:
    """Bring nodal values (ny + 1, nx + 1) linearly from one grid of a face to another."""
    return _linear(of.y, to.y) @ values @ _linear(of.x, to.x).T


def carrying(of: LayerGrid, to: LayerGrid) -> sp.csr_matrix:
    """Matrix of ``carried`` for values in one row."""
    return sp.csr_matrix(sp.kron(_linear(of.y, to.y), _linear(of.x, to.x)))


def _linear(nodes: Array, points: Array) -> Array:
    columns = [np.interp(points, nodes, unit) for unit in np.eye(len(nodes))]
    return np.stack(columns, axis=1).astype(float)


def _spline(nodes: Array, points: Array) -> Array:
    """Matrix (points, nodes) of the interpolating cubic spline, level beyond its ends."""
    inside = np.clip(points, nodes[0], nodes[-1])
    return np.asarray(make_interp_spline(nodes, np.eye(len(nodes)))(inside), dtype=float)


def _overlaps(borders: Array, others: Array) -> Array:
    """Shares (others, borders) in which intervals consist of other intervals."""
    upper = np.minimum(borders[1:], others[1:, None])
    shares = np.clip(upper - np.maximum(borders[:-1], others[:-1, None]), 0.0, None)
    return np.asarray(shares / shares.sum(1, keepdims=True), dtype=float)


def meshes_of(blocks: Blocks, mesh: Mesh) -> list[Mesh]:
    """Return a mesh and the coarser ones on which the load path begins, the coarsest first."""
    x0, x1, y0, y1 = blocks.extent
    smallest = min(x1 - x0, y1 - y0, *blocks.sample_size)
    thickness = float(np.median(blocks.thickness(*np.meshgrid([x0, x1], [y0, y1]))))
    meshes = [settled(mesh, blocks)]
    while count_elements(blocks, meshes[0]) > _COARSEST:
        factor = 2.0 ** len(meshes)
        if factor * mesh.size > smallest / _ACROSS:
            break
        meshes.insert(0, settled(mesh.coarser(factor, thickness), blocks))
    return meshes


class Model:
    """Layer and sample, solved from coarse to fine.

    A relief that is sought comes in place of that of ``blocks``; the thickness of the sample is
    then the mean one.

    Parameters
    ----------
    blocks, meshes
        What is pressed, and its meshes (``meshes_of``).
    columns
        Where the stiffness of the sample is given.
    """

    def __init__(self, blocks: Blocks, meshes: Sequence[Mesh], columns: Columns) -> None:
        self.blocks, self.meshes, self.columns = blocks, meshes, columns
        self.levels = [assemble(blocks, mesh) for mesh in meshes]
        #: Of the last sample that was pressed, on each mesh: they guide those of the next one.
        self.paths: list[list[State]] | None = None
        self._means = [
            columns.means(level.bodies[SAMPLE].grid.y, level.bodies[SAMPLE].grid.x)
            for level in self.levels
        ]

    def derivatives(self, relief: bool, travels: int, load: int) -> Array:
        """Matrix that brings what is sought to the parameters of ``Pressed.sensitivity``.

        Sought are the stiffness of the columns, the heights at their corners if there is a
        ``relief`` to be found, and as many ``travels``, of which this ``load`` has one.
        """
        sample = self.levels[-1].bodies[SAMPLE].grid
        nodes = np.kron(*self.columns.between(sample.y, sample.x)) if relief else np.zeros((0, 0))
        of_elements, columns = self.means.shape
        rows, heights = of_elements + nodes.shape[0], nodes.shape[1]
        out = np.zeros((rows + relief + 1, columns + heights + travels))
        out[:of_elements, :columns] = self.means
        if relief:
            # The mean thickness is known: with the mean height the plate moves, and with it the
            # lower face of the unloaded sample.
            out[of_elements:rows, columns : columns + heights] = nodes
            out[rows:, columns : columns + heights] = 1 / heights
        if travels:
            out[-1, columns + heights + load] = 1.0
        return out

    @property
    def means(self) -> Array:
        """Matrix (columns of elements, columns) by which stiffness comes to the finest mesh."""
        return np.asarray(np.kron(*self._means[-1]), dtype=float)

    @property
    def layer(self) -> LayerGrid:
        """The layer's grid on the finest mesh."""
        return self.levels[-1].bodies[LAYER].grid

    def changed(self, **inputs: Any) -> Model:
        """Return the model with other values of ``blocks``, on the same meshes."""
        model = Model(replace(self.blocks, **inputs), self.meshes, self.columns)
        model.paths = self.paths
        return model

    def pressed(
        self, sought: Sought, report: Callable[[Stack, float, object], None] | None = None
    ) -> list[Pressed]:
        """Press a sample to one travel of the plate after the other, on one load path.

        Raises
        ------
        LoadNotReached
            Also where a sample of such a relief would not be touched.
        """
        levels, stops = self.stacks(sought)
        solution = solve(levels, report, stops, similar=self.paths)
        self.paths = solution.paths
        return [Pressed(levels[-1], state) for state in solution.stops]

    def stacks(self, sought: Sought) -> tuple[list[Stack], list[float]]:
        """What is pressed, on all meshes from the coarsest on, and the loads of the travels.

        Raises
        ------
        LoadNotReached
            Where a sample of such a relief would not be touched.
        """
        levels, met = self.levels, [0.0] * len(self.levels)
        if sought.relief is not None:
            mean = float(sought.relief.mean())
            surface = self.columns.surface(sought.relief - mean)
            levels = self.changed(relief=surface, travel=sought.travels[-1]).levels
            met = [
                mean + level.plate - flat.plate
                for level, flat in zip(levels, self.levels, strict=True)
            ]
        if sought.travels[0] + min(met) <= 0:
            raise LoadNotReached(0.0, "the sample would not touch the layer")
        if not (np.diff(sought.travels) > 0).all():
            raise LoadNotReached(0.0, "the plate would have to go back between two loads")
        of_sample = [
            _of_stiffness(level, by_y @ sought.stiffness @ by_x.T, sought.travels[-1] + before)
            for level, (by_y, by_x), before in zip(levels, self._means, met, strict=True)
        ]
        full = sought.travels[-1] + met[-1]
        return of_sample, [*((travel + met[-1]) / full for travel in sought.travels[:-1]), 1.0]


def _on_nodes(forces: Array, number: NDArray[np.intp]) -> Array:
    """Forces (y, x, 3, nz + 1, b, a) of columns on those of ``number`` from (y, x) on: a matrix."""
    ny, nx, _, depth, around, _ = forces.shape
    out = np.zeros((3 * (int(number.max()) + 1), ny * nx))
    for b in range(around):
        for a in range(around):
            nodes = number[:, b : ny + b, a : nx + a].reshape(depth, ny * nx)
            for c in range(3):
                own = forces[:, :, c, :, b, a].reshape(ny * nx, depth).T
                np.add.at(out, (3 * nodes + c, np.arange(ny * nx)), own)
    return out


def _of_stiffness(stack: Stack, logarithm: Array, travel: float) -> Stack:
    layer, sample = stack.bodies
    factor = np.broadcast_to(np.exp(logarithm), sample.grid.shape).copy()
    bodies = layer, replace(sample, stiffness=factor)
    return replace(stack, bodies=bodies, travel=travel)


@dataclass(frozen=True, eq=False)
class Pressed:
    """Layer and sample in equilibrium at one travel of the plate."""

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
        return self.stack.total_forces(self.state)[WINDOW]

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

    def sensitivity(self, measured: ThicknessSurface, relief: bool = False) -> Sensitivity:
        """Return what changes with stiffness and travel, and with the ``relief`` if asked for."""
        stack = self.stack
        first = stack.bodies[LAYER].n_nodes
        tangent = Tangent(stack, self.state)
        sample = stack.bodies[SAMPLE]
        u, p = stack.split(self.state.u)[SAMPLE], self.state.p[SAMPLE]
        number = np.arange(sample.n_nodes).reshape(sample.grid.node_shape)
        of_sample = [_on_nodes(stiffness_forces(sample, u, p), number)]
        if relief:
            by_height, shorter = shape_forces(sample, u, p)
            of_sample.append(_on_nodes(by_height, np.pad(number, ((0, 0), (1, 1), (1, 1)))))
            of_sample.append(shorter.reshape(3, -1).T.reshape(-1, 1))
        count = sum(part.shape[1] for part in of_sample)
        rhs = np.zeros((3 * stack.n_nodes, count + 1))
        rhs[3 * first :, :-1] = -np.concatenate(of_sample, axis=1)
        rhs[:, -1] = -tangent.by_travel()
        moved = tangent.displacement(rhs)
        x, y, _ = self.surface.reshape(3, -1)
        top = np.arange(first).reshape(stack.bodies[LAYER].grid.node_shape)[-1].ravel()
        slope_x, slope_y = measured(x, y, dx=1), measured(x, y, dy=1)
        thickness = moved[3 * top + 2]
        thickness -= slope_x[:, None] * moved[3 * top] + slope_y[:, None] * moved[3 * top + 1]
        contact = tangent.contact_forces[INTERFACE] @ moved  # all that the layer carries
        return Sensitivity(
            thickness=thickness,
            pressure=contact / stack.areas[INTERFACE][:, None],
            force=np.asarray(contact.sum(0)),
        )


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of what a pressed stack shows.

    They are those of the ``thickness`` (``Pressed.misfit``), mm, of the ``pressure`` of the slaves,
    kPa, and of the ``force`` on the window, mN. The last axis has the parameters: the logarithms of
    the stiffness of the columns of elements; where the relief is sought, the height of the sample's
    unloaded surface at its nodes and by how much nearer its lower face is, mm; the travel of the
    plate, mm. Friction is taken from the slip since the last load step.
    """

    thickness: Array
    pressure: Array
    force: Array

    def of(self, parameters: Array) -> Sensitivity:
        """By other parameters, of which these are the matrix ``parameters`` times."""
        return Sensitivity(
            self.thickness @ parameters, self.pressure @ parameters, self.force @ parameters
        )
