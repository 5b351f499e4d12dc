"""The structured hexahedral grid of the compliant layer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

Array = NDArray[np.float64]

#: Width of the outermost elements of a free side, in thicknesses of the layer: what the stress-free
#: side does to the layer's total force is resolved to about 1 %. Smaller ones fold in on themselves
#: where the rim rolls at the window, and so do flatter ones: with free sides, the elements at the
#: window are at least as high.
EDGE = 0.04


@dataclass(frozen=True, eq=False)
class LayerGrid:
    """Trilinear hexahedra over the field of view and [0, L0(x, y)].

    Attributes
    ----------
    x, y
        Lateral node coordinates, increasing, mm; shapes (nx + 1,), (ny + 1,).
    depth
        Node depths as fractions of the unloaded thickness, 0 at the window to 1 at the
        sample side; shape (nz + 1,).
    thickness
        Unloaded thickness L0 at the lateral nodes, mm; shape (ny + 1, nx + 1).
    """

    x: Array
    y: Array
    depth: Array
    thickness: Array

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of elements (nz, ny, nx)."""
        return len(self.depth) - 1, len(self.y) - 1, len(self.x) - 1

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Numbers of nodes (nz + 1, ny + 1, nx + 1)."""
        return len(self.depth), len(self.y), len(self.x)

    @property
    def node_axes(self) -> tuple[Array, Array, Array]:
        """Node positions along the axes (depth, y, x)."""
        return self.depth, self.y, self.x

    @property
    def n_elements(self) -> int:
        """Number of elements."""
        nz, ny, nx = self.shape
        return nz * ny * nx

    @cached_property
    def typical_thickness(self) -> float:
        """Median unloaded thickness, mm."""
        return float(np.median(self.thickness))

    @cached_property
    def nodes(self) -> Array:
        """Reference node positions, shape (3, nz + 1, ny + 1, nx + 1), mm."""
        nodes = np.empty((3, *self.node_shape))
        nodes[0] = self.x
        nodes[1] = self.y[:, None]
        nodes[2] = self.depth[:, None, None] * self.thickness
        return nodes

    @property
    def node_widths(self) -> list[Array]:
        """What belongs to the nodes along the axes (depth, y, x)."""
        halves = [0.5 * np.diff(nodes) for nodes in self.node_axes]
        return [np.concatenate([half, [0]]) + np.concatenate([[0], half]) for half in halves]

    @cached_property
    def node_volumes(self) -> Array:
        """Tributary volumes of the unloaded nodes, (nz + 1, ny + 1, nx + 1), mm^3."""
        z, y, x = np.ix_(*self.node_widths)
        return z * y * x * self.thickness

    @cached_property
    def side_nodes(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Indices (k, j, i) of the nodes on the four sides, those on both faces too."""
        j, i = _rim_nodes(self.node_shape[1:])
        k = np.arange(len(self.depth))
        return np.repeat(k, j.size), np.tile(j, k.size), np.tile(i, k.size)

    @cached_property
    def spacing(self) -> tuple[float, float, float]:
        """Typical (median) element sizes (z, y, x), mm."""
        return (
            float(np.median(np.diff(self.depth))) * self.typical_thickness,
            float(np.median(np.diff(self.y))),
            float(np.median(np.diff(self.x))),
        )

    @property
    def edge_widths(self) -> tuple[float, float]:
        """Widths of the outermost elements (y, x), mm."""
        return float(self.y[1] - self.y[0]), float(self.x[1] - self.x[0])

    @cached_property
    def areas(self) -> Array:
        """Tributary areas of the unloaded sample-side nodes, (ny + 1, nx + 1), mm^2."""
        return self.surface_areas(self.nodes[:, -1])

    def covered(self, u: Array) -> float:
        """Share of where the layer was, seen from above, that is within its bounds when moved by u.

        ``u`` (3, nz + 1, ny + 1, nx + 1), mm; the sample-side nodes count.
        """
        share = 1.0
        for nodes, position in (self.x, self.x + u[0, -1]), (self.y, self.y[:, None] + u[1, -1]):
            within = min(position.max(), nodes[-1]) - max(position.min(), nodes[0])
            share *= max(0.0, float(within / (nodes[-1] - nodes[0])))
        return share

    def interpolate_from(self, other: LayerGrid, field: Array) -> Array:
        """Smooth (Akima) interpolation of a node field of another grid of the same layer.

        ``field`` has trailing axes ``(y, x)`` or ``(z, y, x)`` of ``other``; leading axes are kept.
        The kinks of a linear interpolation are strains that neither grid has.
        """
        from scipy.interpolate import Akima1DInterpolator  # slow to load, not needed to begin with

        pairs = list(zip((other.depth, other.y, other.x), self.node_axes, strict=True))
        if field.shape[-3:] != other.node_shape:
            pairs = pairs[1:]
        for axis, (coarse, fine) in enumerate(pairs, start=field.ndim - len(pairs)):
            if not np.array_equal(coarse, fine):
                field = Akima1DInterpolator(coarse, field, axis=axis, method="makima")(
                    np.clip(fine, coarse[0], coarse[-1])
                )
        return np.ascontiguousarray(field)

    def interpolate_sides_from(self, other: LayerGrid, field: Array) -> Array:
        """Linear interpolation of a field (..., n) on the ``side_nodes`` of another grid."""
        source = field.reshape(*field.shape[:-1], len(other.depth), -1)
        rim = len(_rim_nodes(self.node_shape[1:])[0])
        out = np.zeros((*field.shape[:-1], len(self.depth), rim))
        down = _linear_weights(other.depth, self.depth)
        sides = zip(_sides(other.node_shape[1:]), _sides(self.node_shape[1:]), strict=True)
        axes = ((other.x, self.x), (other.x, self.x), (other.y, self.y), (other.y, self.y))
        for (theirs, mine), axis in zip(sides, axes, strict=True):
            out[..., mine] = down @ source[..., theirs] @ _linear_weights(*axis).T
        return out.reshape(*field.shape[:-1], -1)

    def interpolate_cells_from(self, other: LayerGrid, field: Array) -> Array:
        """Linear interpolation of an element field (nz, ny, nx) between element centres."""
        positions = []
        for mine, theirs in ((self.depth, other.depth), (self.y, other.y), (self.x, other.x)):
            centres = 0.5 * (theirs[1:] + theirs[:-1])
            positions.append(
                np.interp(0.5 * (mine[1:] + mine[:-1]), centres, np.arange(len(centres)))
            )
        grid = np.meshgrid(*positions, indexing="ij")
        return map_coordinates(field, grid, order=1, mode="nearest")

    def surface_areas(self, surface: Array) -> Array:
        """Tributary areas, shape (ny + 1, nx + 1), mm^2, of the nodes of a bilinear surface.

        ``surface`` holds node positions, shape (3, ny + 1, nx + 1).
        """
        d1 = surface[:, 1:, 1:] - surface[:, :-1, :-1]
        d2 = surface[:, 1:, :-1] - surface[:, :-1, 1:]
        quarter = 0.125 * np.linalg.norm(np.cross(d1, d2, axis=0), axis=0)
        areas = np.zeros(surface.shape[1:])
        for j in (slice(None, -1), slice(1, None)):
            for i in (slice(None, -1), slice(1, None)):
                areas[j, i] += quarter
        return areas


def contact_nodes(field: Array) -> Array:
    """Values of a nodal field (c, nz + 1, ny + 1, nx + 1) where window and sample side may touch.

    Returns
    -------
    Array
        (2, c, m): the nodes of the face itself, row by row, and then the ``LayerGrid.side_nodes``,
        which both may touch.
    """
    j, i = _rim_nodes(field.shape[2:])
    sides = field[:, :, j, i].reshape(len(field), -1)
    return np.stack(
        [np.concatenate([field[:, k].reshape(len(field), -1), sides], axis=1) for k in (0, -1)]
    )


def face_and_sides(values: Array, face_shape: tuple[int, int]) -> tuple[Array, Array]:
    """Values at ``contact_nodes`` as those of the face, (..., ny + 1, nx + 1), and of the sides."""
    count = face_shape[0] * face_shape[1]
    return values[..., :count].reshape(*values.shape[:-1], *face_shape), values[..., count:]


def _rim_nodes(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (j, i) of the outermost lateral nodes, row by row."""
    rim = np.ones(shape, bool)
    rim[1:-1, 1:-1] = False
    j, i = np.nonzero(rim)
    return j, i


def rim_numbers(shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Which of the outermost lateral nodes, row by row, each of ``shape`` is; -1 inside."""
    number = np.full(shape, -1)
    rim = _rim_nodes(shape)
    number[rim] = np.arange(rim[0].size)
    return number


def _sides(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], ...]:
    """Which of ``_rim_nodes`` are on each side: the lowest and highest in y, then in x."""
    number = rim_numbers(shape)
    return number[0], number[-1], number[:, 0], number[:, -1]


def _linear_weights(source: Array, target: Array) -> Array:
    """Weights (target, source) of linear interpolation, constant beyond the ends."""
    return np.stack([np.interp(target, source, unit) for unit in np.eye(len(source))], axis=1)


def node_positions(
    length: float, size: float, origin: float = 0.0, *, edge: float | None = None
) -> Array:
    """Node coordinates from ``origin`` over ``length`` with elements of about ``size``.

    They are uniform, but for ``edge``: the width of the two outermost elements, from which the
    widths double inwards until they reach ``size``; a wider one stands alone.
    """
    widths: list[float] = []
    if edge is not None and edge > 1.05 * size:
        widths.append(edge)
    while edge is not None and edge * 2 ** len(widths) < (0.75 if widths else 0.95) * size:
        widths.append(edge * 2 ** len(widths))
    inner = length - 2 * sum(widths)
    count = max(1, round(inner / size))
    widths += [inner / count] * count + widths[::-1]
    return origin + np.concatenate([[0.0], np.cumsum(widths)]) * length / sum(widths)


def edge_width(depth: Array, thickness: float) -> float:
    """Width of the outermost elements of a free side, mm; as flat as 1 : 6.7 at the most."""
    return max(EDGE, 0.15 * float(depth[1])) * thickness


def depth_positions(size: float, free_edges: bool) -> Array:
    """Node depths for elements of about ``size``, as fractions of the thickness."""
    if free_edges and 1.05 * size < EDGE:
        return np.concatenate([[0.0], node_positions(1.0 - EDGE, size, EDGE)])
    return node_positions(1.0, size)


def graded_depths(count: int, grading: float = 1.0) -> Array:
    """Depth fractions of ``count`` elements, each ``grading`` times thinner than the last.

    ``grading`` > 1 refines towards the sample side; 1 is uniform.
    """
    sizes = grading ** -np.arange(count, dtype=float)
    return np.concatenate([[0.0], np.cumsum(sizes) / sizes.sum()])
