"""Parts of a layer that are brought into equilibrium alone, the rest of it held.

Where a rim rolls or slips and catches again, a hundredth of the columns holds nearly all that is
out of balance, iteration after iteration, and all else is as good as in equilibrium. Newton's
method of the whole layer is a dear way to move these few. Nonlinear elimination (Lanzkron, Rose and
Wilkes 1996; Cai and Li 2011) solves them first, as a small layer that is cut out with a margin, and
goes on from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .grid import LayerGrid, face_and_sides, rim_numbers
from .problem import LayerProblem, LayerState, Sides

Array = NDArray[np.float64]
#: Columns of nodes: slices along y and x.
Box = tuple[slice, slice]
#: Where columns were cut out, as a layer of their own, and its state.
Part = tuple[Box, LayerProblem, LayerState]


def unbalanced_columns(imbalance: Array, margin: int, most: float, share: float) -> list[Box]:
    """Boxes around the columns that hold a share of what is out of balance.

    Parameters
    ----------
    imbalance
        Square of the forces out of balance in each column, (ny + 1, nx + 1).
    margin
        Columns that go with them on all sides. One more around each box is held.
    most
        Share of all columns that they may be, their margin included: of more, no part is a small
        one.
    share
        Of the sum of ``imbalance``.

    Returns
    -------
    list
        Boxes that share none but held columns; none where they would be more than ``most``.
    """
    order = np.argsort(imbalance, axis=None)[::-1]
    sums = np.cumsum(imbalance.ravel()[order])
    count = int(np.searchsorted(sums, share * sums[-1])) + 1
    chosen = np.zeros(imbalance.shape, bool)
    chosen.ravel()[order[:count]] = True
    around = np.ones((3, 3), bool)
    chosen = ndimage.binary_dilation(chosen, around, iterations=margin)
    while True:  # boxes that meet become one
        boxes = [(y, x) for y, x in ndimage.find_objects(ndimage.label(chosen, around)[0])]
        filled = chosen.copy()
        for box in boxes:
            filled[box] = True
        if (filled == chosen).all():
            break
        chosen = filled
    if chosen.mean() > most:
        return []
    return [widened(box, imbalance.shape) for box in boxes]


def widened(box: Box, shape: tuple[int, ...]) -> Box:
    """A box with one more column on all sides, but for those of the layer of columns (y, x)."""
    y, x = (
        slice(max(along.start - 1, 0), min(along.stop + 1, count))
        for along, count in zip(box, shape, strict=True)
    )
    return y, x


def at_free_side(problem: LayerProblem, box: Box) -> bool:
    """Whether some of the columns of a box are at a free side of the layer itself."""
    (y, x), (_, ny, nx) = box, problem.grid.node_shape
    ends = y.start == 0, y.stop == ny, x.start == 0, x.stop == nx
    own = zip(ends, problem.own_sides, strict=True)
    return problem.edges == "free" and any(end and free for end, free in own)


def within(box: Box, other: Box) -> Box:
    """Where a box is in another one."""
    y, x = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(box, other, strict=True))
    return y, x


def cut_out(problem: LayerProblem, state: LayerState, box: Box) -> tuple[LayerProblem, LayerState]:
    """Cut columns out of a layer; the sides where it goes on are held."""
    grid, (y, x) = problem.grid, box
    own = LayerGrid(grid.x[x], grid.y[y], grid.depth, grid.thickness[box])
    _, ny, nx = grid.node_shape
    held = y.start > 0, y.stop < ny, x.start > 0, x.stop < nx
    y0, y1, x0, x1 = (m and not cut for m, cut in zip(problem.mirrors, held, strict=True))
    mirrors: Sides = (y0, y1, x0, x1)

    # which of the layer's outermost columns each of these outermost ones is, or -1
    which = rim_numbers((ny, nx))[box][rim_numbers(own.node_shape[1:]) >= 0]

    def at_contact(values: Array) -> Array:
        face, sides = face_and_sides(values, (ny, nx))
        leading = values.shape[:-1]
        mine = sides.reshape(*leading, len(grid.depth), -1)[..., which]
        mine[..., which < 0] = 0.0
        return np.concatenate(
            [field.reshape(*leading, -1) for field in (face[..., y, x], mine)], -1
        )

    return replace(problem, grid=own, held=held, mirrors=mirrors), replace(
        state,
        u=state.u[..., y, x].copy(),
        p=state.p[:, *_elements(box)].copy(),
        slip=at_contact(state.slip),
        anchor=at_contact(state.anchor),
        normal_force=state.normal_force[:, y, x].copy(),
    )


def put_back(state: LayerState, parts: Sequence[Part]) -> LayerState:
    """Return a state with parts of it that were solved."""
    out = state.copy()
    for box, problem, solved in parts:
        held = problem.held_columns
        free = np.ones(solved.u.shape[2:], bool) if held is None else ~held
        out.u[:, :, *box][..., free] = solved.u[..., free]
        out.normal_force[:, *box][..., free] = solved.normal_force[..., free]
        out.p[:, *_elements(box)] = solved.p
    return out


def _elements(box: Box) -> Box:
    """The elements between the columns of a box."""
    y, x = box
    return slice(y.start, y.stop - 1), slice(x.start, x.stop - 1)
