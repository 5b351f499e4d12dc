"""Bilinear faces: their quadrature and their area vectors."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

Array = NDArray[np.float64]


def _face_quadrature() -> tuple[Array, Array]:
    """Shape functions [gauss, node] and derivatives [gauss, node, 2] of a bilinear face."""
    g = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    shape, slope = np.empty((4, 4)), np.empty((4, 4, 2))
    for q in range(4):
        point = g[q & 1], g[q >> 1]
        for a in range(4):
            fx, fy = (t if (a >> d) & 1 else 1 - t for d, t in enumerate(point))
            sx, sy = (1.0 if (a >> d) & 1 else -1.0 for d in range(2))
            shape[q, a], slope[q, a] = fx * fy, (sx * fy, fx * sy)
    return shape, slope


#: Shape functions [gauss, node] and their derivatives [gauss, node, 2].
SHAPE, SLOPE = _face_quadrature()


def area_vectors(surface: Array) -> Array:
    """Area vectors, mm^2, of the nodes of a bilinear surface (3, ny + 1, nx + 1), along +z.

    The gradient of the volume beneath the surface with respect to each node's position.
    """
    out = np.zeros(surface.shape)
    _area_vectors(np.ascontiguousarray(surface), out)
    return out


@nb.njit(cache=True)
def _area_vectors(surface, out):
    _, ny1, nx1 = surface.shape
    x, y, corner = np.empty(3), np.empty(3), np.empty(4)
    for j in range(ny1 - 1):
        for i in range(nx1 - 1):
            for q in range(4):
                for c in range(3):
                    x[c] = y[c] = 0.0
                    for a in range(4):
                        corner[a] = surface[c, j + (a >> 1), i + (a & 1)]
                        x[c] += SLOPE[q, a, 0] * corner[a]
                        y[c] += SLOPE[q, a, 1] * corner[a]
                v0 = 0.25 * (x[1] * y[2] - x[2] * y[1])
                v1 = 0.25 * (x[2] * y[0] - x[0] * y[2])
                v2 = 0.25 * (x[0] * y[1] - x[1] * y[0])
                for a in range(4):
                    jj, ii = j + (a >> 1), i + (a & 1)
                    out[0, jj, ii] += SHAPE[q, a] * v0
                    out[1, jj, ii] += SHAPE[q, a] * v1
                    out[2, jj, ii] += SHAPE[q, a] * v2


#: Horizontal area of a node, as a share of its unloaded one, below which its faces are folded.
FOLDED = 0.2


def carrying_areas(areas: Array, unloaded: Array) -> Array:
    """Areas by which forces of nodes become stress, mm^2, each ``FOLDED`` of the unloaded at least.

    Of a node between folded faces next to nothing is left, and with it a force that is small would
    be a stress of thousands of kPa.
    """
    return np.maximum(areas, FOLDED * unloaded)


def push_slope(surface: Array, unloaded: Array, met: Array) -> tuple[Array, Array, Array]:
    """The slope (a_x, a_y) along which what is met pushes the nodes of a bilinear surface.

    That of the faces themselves, a = -(A_x, A_y) / A_z with A the area vector of a node. Where a
    body has rolled so far that its outermost faces are folded, A is next to nothing and has no
    direction: below D = ``FOLDED`` times the ``unloaded`` area, the slope of what is ``met`` makes
    up for what is missing, a = (-(A_x, A_y) + (D - A_z) (h_x, h_y)) / D.

    Parameters
    ----------
    surface
        Positions, (3, ny + 1, nx + 1), mm.
    unloaded
        Horizontal area of the unloaded nodes, (ny + 1, nx + 1), mm^2.
    met
        Slope (h_x, h_y) of what is met at each node, (2, ny + 1, nx + 1).

    Returns
    -------
    tuple
        The slope, (2, ny + 1, nx + 1), the area A_z or D by which it is divided, (ny + 1, nx + 1),
        mm^2, and the share (D - A_z) / D that is missing of it.
    """
    area = area_vectors(surface)
    least = carrying_areas(area[2], unloaded)
    missing = 1 - area[2] / least
    return -area[:2] / least + missing * met, least, missing


def area_derivatives(surface: Array) -> Array:
    """Derivative of the area vectors of a bilinear surface (3, ny + 1, nx + 1), mm.

    Of what each of the m faces adds to that of its corner a, by the position of its corner b:
    (3, 3, 4, 4, m), the corners in the order of rows and columns.
    """
    corners = np.stack(
        [surface[:, :-1, :-1], surface[:, :-1, 1:], surface[:, 1:, :-1], surface[:, 1:, 1:]]
    ).reshape(4, 3, -1)
    out = np.zeros((3, 3, 4, 4, corners.shape[-1]))
    for q in range(4):
        x, y = (_cross_matrix(np.tensordot(SLOPE[q, :, d], corners, 1)) for d in range(2))
        for a, b in np.ndindex(4, 4):
            along_x, along_y = SLOPE[q, b]
            out[:, :, a, b] += 0.25 * SHAPE[q, a] * (along_y * x - along_x * y)
    return out


def gradient_products(surface: Array) -> Array:
    """Integrals of the products of the gradients of shape functions over each face, (4, 4, m).

    Of a bilinear surface (3, ny + 1, nx + 1), the corners as in ``area_derivatives``.
    """
    corners = np.stack(
        [surface[:, :-1, :-1], surface[:, :-1, 1:], surface[:, 1:, :-1], surface[:, 1:, 1:]]
    ).reshape(4, 3, -1)
    out = np.zeros((4, 4, corners.shape[-1]))
    for slope in SLOPE:
        x, y = (np.tensordot(slope[:, d], corners, 1) for d in range(2))
        xx, xy, yy = (x * x).sum(0), (x * y).sum(0), (y * y).sum(0)
        area = np.sqrt(xx * yy - xy**2)
        for a, b in np.ndindex(4, 4):
            (ax, ay), (bx, by) = slope[a], slope[b]
            out[a, b] += 0.25 * (ax * bx * yy - (ax * by + ay * bx) * xy + ay * by * xx) / area
    return out


def _cross_matrix(v: Array) -> Array:
    """The matrix of v x w, (3, 3, m), of vectors v (3, m)."""
    zero = np.zeros_like(v[0])
    return np.array([[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]])


@nb.njit(cache=True)
def add_blocks(plane, k, corners, blocks):
    """Add a stiffness between the corners of faces to plane k of a tangent.

    ``plane`` is [y, neighbour, 3 * row + column, x]; ``corners`` are the indices (k, j, i) of the
    corners of m faces, (3, 4, m), and ``blocks`` (3, 3, 4, 4, m) the stiffness of their corners a
    by b, mN / mm.
    """
    for f in range(corners.shape[2]):
        for a in range(4):
            if corners[0, a, f] != k:
                continue
            j, i = corners[1, a, f], corners[2, a, f]
            for b in range(4):
                dk, dj, di = corners[0, b, f] - k, corners[1, b, f] - j, corners[2, b, f] - i
                m = 9 * (dk + 1) + 3 * (dj + 1) + di + 1
                for c in range(3):
                    for d in range(3):
                        plane[j, m, 3 * c + d, i] += blocks[c, d, a, b, f]
