"""Turning elements right side out that interpolation from a coarser grid has turned inside out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, uniform_filter1d

from .body import Body
from .elements import GRADIENTS, corner_nodes

Array = NDArray[np.float64]

#: Steps of smoothing, and after how many of them it takes in the next nodes around.
_STEPS, _WIDENED = 60, 5


def untangled(body: Body, u: Array, least: float) -> Array:
    """Smooth a displacement where elements would lose too much of their volume.

    Of a flat element in a fold, the halves on a finer grid may have a negative volume somewhere.
    The nodes there move to the mean of their neighbours, again and again, and more nodes with them,
    until no volume ratio is below ``least``. Where that does not help, the displacement is as far
    as that came.

    Parameters
    ----------
    u
        Displacement, (3, nz + 1, ny + 1, nx + 1), mm.
    least
        Smallest J that is left, at any Gauss point.

    Returns
    -------
    Array
        The displacement; the given one where nothing is wrong.
    """
    touched = np.zeros(u.shape[1:], bool)
    for step in range(1, _STEPS + 1):
        bad = smallest_jacobians(body, u) < least
        if not bad.any():
            break
        for corner in range(8):
            touched[corner_nodes(corner, bad.shape)] |= bad
        if step % _WIDENED == 0:
            touched = binary_dilation(touched)
        means = [uniform_filter1d(u, 3, axis=axis, mode="nearest") for axis in (1, 2, 3)]
        u = np.where(touched, np.mean(means, axis=0), u)
    return u


def smallest_jacobians(body: Body, u: Array) -> Array:
    """Smallest J of each element at a Gauss point, (nz, ny, nx)."""
    nz, ny, nx = body.grid.shape
    smallest = np.full((nz, ny, nx), np.inf)
    for k in range(nz):  # one layer of elements after the other: a large grid has millions
        nodes = body.nodes[:, k : k + 2]
        before, after = (
            np.stack([layer[:, *corner_nodes(corner, (1, ny, nx))] for corner in range(8)])
            for layer in (nodes, nodes + u[:, k : k + 2])
        )
        for gradients in GRADIENTS:
            ratio = _volumes(gradients, after) / _volumes(gradients, before)
            np.minimum(smallest[k], ratio[0], out=smallest[k])
    return smallest


def _volumes(gradients: Array, corners: Array) -> Array:
    """Volume per reference volume at a Gauss point of elements with these corners, (8, 3, ...)."""
    mapped = np.tensordot(gradients, corners, (0, 0))
    return np.linalg.det(np.moveaxis(mapped, (0, 1), (-2, -1)))
