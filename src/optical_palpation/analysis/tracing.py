"""Outlines of masks, so that they can be drawn and changed like any other region."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optical_palpation.analysis.regions import Region

#: Corners about a pixel, in order, and the neighbour across the side that starts at each.
_CORNERS = ((0, 0), (0, 1), (1, 1), (1, 0))
_NEIGHBOURS = ((-1, 0), (0, 1), (1, 0), (0, -1))

#: Width of the pixel of a map that has no other, mm.
_ALONE = 0.1


def traced(region: Region) -> Region:
    """Return a region with outlines along the sides of its pixels in place of its mask.

    A hole is an outline of its own, and so is each part of several.

    Parameters
    ----------
    region
        Of a mask the pixels of which less than half belongs to it are left out; one that has
        outlines stays as it is.

    Returns
    -------
    Region
        The same pixels, to the last one where the mask holds whole pixels.
    """
    if region.mask is None:
        return region
    mask = region.mask.transpose("y", "x")
    along = {axis: mask[axis].values for axis in "yx"}
    steps = [abs(np.diff(at)).mean() for at in along.values() if at.size > 1]
    y, x = (_between(at, min(steps, default=_ALONE)) for at in along.values())
    loops = _loops(mask.values >= 0.5)
    return Region(region.name, tuple(np.stack([x[at[:, 1]], y[at[:, 0]]], -1) for at in loops))


def _between(centres: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Sides of pixels along an axis; a single one has a width."""
    if centres.size == 1:
        return np.array([centres[0] - width / 2, centres[0] + width / 2])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def _loops(mask: ArrayLike) -> list[NDArray[np.int64]]:
    """Corners (row, column) of the closed lines about the pixels of a mask; none meets itself."""
    inside = np.pad(np.asarray(mask, bool), 1)
    following: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(inside):
        for side, (down, right) in enumerate(_NEIGHBOURS):
            if not inside[row + down, column + right]:
                start, end = (_CORNERS[(side + n) % 4] for n in (0, 1))
                corner = (int(row + start[0]) - 1, int(column + start[1]) - 1)
                other = (int(row + end[0]) - 1, int(column + end[1]) - 1)
                following.setdefault(corner, []).append(other)
    loops = []
    while following:
        path = [next(iter(following))]
        place = {path[0]: 0}
        while ends := following.get(path[-1]):
            end = ends.pop()
            if not ends:
                del following[path[-1]]
            if end in place:  # closed; where pixels touch at a corner, the rest goes on from there
                loops.append(_straight(np.array(path[place[end] :])))
                for corner in path[place[end] + 1 :]:
                    del place[corner]
                del path[place[end] + 1 :]
            else:
                place[end] = len(path)
                path.append(end)
    return loops


def _straight(loop: NDArray[np.int64]) -> NDArray[np.int64]:
    """Leave out the corners at which a closed line goes straight on."""
    turns = (np.roll(loop, -1, 0) - loop != loop - np.roll(loop, 1, 0)).any(1)
    return loop[turns]
