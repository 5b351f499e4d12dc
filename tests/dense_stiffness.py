"""The stiffness that something adds to the tangent, plane by plane, as a matrix."""

import numpy as np


def product(adds, step):
    """Forces (3, nz + 1, ny + 1, nx + 1) by a displacement of what has ``add_stiffness``."""
    shape = step.shape[1:]
    size = 3 * np.prod(shape)
    matrix = np.zeros((size, size))
    numbers = np.arange(np.prod(shape)).reshape(shape)
    for k in range(shape[0]):
        plane = np.zeros((shape[1], 27, 9, shape[2]))
        adds.add_stiffness(plane, k)
        for j, m, entry, i in np.argwhere(plane):
            dk, dj, di = m // 9 - 1, m // 3 % 3 - 1, m % 3 - 1
            row = 3 * numbers[k, j, i] + entry // 3
            column = 3 * numbers[k + dk, j + dj, i + di] + entry % 3
            matrix[row, column] += plane[j, m, entry, i]
    out = matrix @ np.moveaxis(step, 0, -1).ravel()
    return np.moveaxis(out.reshape(*shape, 3), -1, 0)
