"""The Schur complement of the pressure, B^T A^-1 B, approximated in cosine modes.

For most modes the Schur complement is V / mu. Trilinear elements with constant pressures have a
family of others: a pressure that alternates from element to element in two directions exerts next
to no force on the nodes, and its Schur complement is smaller by the square of the number of
elements per side. Both are caught by the quotient of Fourier symbols of B^T B and of A,

    lambda = sum_d s_d c_e c_f / sum_d s_d m_e m_f,   s = (2 - 2 cos t) / h^2,
    c = (1 + cos t) / 2,   m = (2 + cos t) / 3,

over the phase t per element in each direction d, e and f the other two. Cosine modes of the element
grid fit it: they are exact on a box between frictionless planes.
"""

from __future__ import annotations

import numba as nb
import numpy as np
import scipy.fft
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Pressure = NDArray[np.float32]


class SchurComplement:
    """Approximate inverse of B^T (A + gamma B V^-1 B^T)^-1 B (1 - gamma V^-1 C) + C.

    C is V / K, with the flow through curved sides (``side_flow``) V / K + S. The uniform pressure
    is left out.

    Parameters
    ----------
    shape
        Numbers of elements (nz, ny, nx).
    spacing
        Element sizes (z, y, x), mm.
    shear_modulus, gamma
        mu and the penalty of the displacement block, kPa.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        spacing: tuple[float, float, float],
        shear_modulus: float,
        gamma: float,
    ) -> None:
        phases = np.ix_(*(np.cos(np.pi * np.arange(n, dtype=np.float32) / n) for n in shape))
        s = [(2 - 2 * t) / np.float32(h**2) for t, h in zip(phases, spacing, strict=True)]
        coupling, mass = ([(a + t) / (a + 1) for t in phases] for a in (1, 2))
        above, below = (
            s[0] * f[1] * f[2] + f[0] * s[1] * f[2] + f[0] * f[1] * s[2] for f in (coupling, mass)
        )
        below[0, 0, 0] = 1.0
        #: 1 / (mu / lambda + gamma), by mode, 1 / kPa.
        self._symbol = above / (np.float32(shear_modulus) * below + np.float32(gamma) * above)
        self.gamma = gamma
        #: V^-1 S by mode, 1 / kPa.
        self._flow = (s[1] + s[2]) * np.float32(spacing[0] ** 2 / (12 * shear_modulus))

    def prepare(self, volume: Pressure, bulk_modulus: float, curved_sides: bool = False) -> None:
        """Take the reference volumes of the elements, mm^3, and K, kPa; and whether S is there."""
        own = np.float32(1 / bulk_modulus) + (self._flow if curved_sides else np.float32(0))
        self._inverse = 1 / ((1 - np.float32(self.gamma) * own) * self._symbol + own)
        self._inverse[0, 0, 0] = 0
        self._scale = volume ** np.float32(-0.5)

    def solve(self, change: Pressure) -> Pressure:
        """Pressure that makes a change of volume."""
        threads = nb.get_num_threads()
        modes = scipy.fft.dctn(self._scale * change, norm="ortho", workers=threads)
        modes *= self._inverse
        return self._scale * scipy.fft.idctn(modes, norm="ortho", workers=threads)


#: Cells of the lubrication equation: no smaller than this many thicknesses, and no more of them
#: along an axis than the second number.
_CELL, _CELLS = 0.5, 64


class Lubrication:
    """The Schur complement of pressures that change slowly along a layer that sticks to a surface.

    What such a pressure moves is a thin film: the mean flow over the depth is m grad p, with a
    mobility m of h^2 / (12 mu) where both faces stick, four times that where one does, and

        S p = -div(m grad p) + open p.

    Cosine modes, which know frictionless planes, take S for 1 / mu: too much by (kh)^2 / 12. At
    free sides the pressure vanishes. ``open`` is the compliance of a column that touches nothing on
    one side: it gives way instead of passing the pressure on.

    Parameters
    ----------
    depth, y, x
        Positions of the nodes along each axis, mm; depth in mm of a layer of the median thickness.
    free_sides
        Whether the sides are free; else no material passes them.
    shear_modulus
        mu, kPa.
    """

    def __init__(
        self, depth: Array, y: Array, x: Array, free_sides: bool, shear_modulus: float
    ) -> None:
        self.shear_modulus = shear_modulus
        self.height = float(depth[-1] - depth[0])
        self.axes = [_aggregated(nodes, _CELL * self.height) for nodes in (y, x)]
        centres = [0.5 * (nodes[1:] + nodes[:-1]) for nodes in (y, x)]
        #: From cells to elements, along y and x.
        self.to_elements = [
            _hats(0.5 * (cells[1:] + cells[:-1]), at)
            for cells, at in zip(self.axes, centres, strict=True)
        ]
        ny, nx = (len(axis) - 1 for axis in self.axes)
        self._diffusion = _Diffusion((ny, nx), free_sides)

    def prepare(self, stiffness: Array, touching: Array, bulk_modulus: float) -> None:
        """Factorise the equation.

        Parameters
        ----------
        stiffness
            Resistance of both faces to sliding along y and x, (face, 2, ny, nx) of the elements,
            kPa / mm.
        touching
            Share of both faces that is in contact, (face, ny, nx).
        bulk_modulus
            K, kPa.
        """
        wy, wx = (w / w.sum(0) for w in self.to_elements)

        def averaged(field: Array) -> Array:
            return wy.T @ field @ wx

        mu, h = self.shear_modulus, self.height
        sizes = np.meshgrid(*(np.diff(axis) for axis in self.axes), indexing="ij")
        area = sizes[0] * sizes[1]
        opening = averaged(1 - touching.min(0)) / mu
        conductance = []
        for d, axis in enumerate(self.axes):
            mobility = _mobility(averaged(stiffness[0, d]), averaged(stiffness[1, d]), mu, h)
            # what nothing holds moves as far as the layer is long
            mobility = np.minimum(mobility, np.diff(axis).sum() ** 2 / mu)
            conductance.append(2 * mobility * area / sizes[d] ** 2)
        matrix = self._diffusion.matrix(conductance, area * (1 / bulk_modulus + opening))
        self._factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def solve(self, change: NDArray[np.floating]) -> Pressure:
        """Pressure (ny, nx), the same over the depth, that makes a change of volume."""
        column = change.sum(0, dtype=np.float64) / self.height
        wy, wx = self.to_elements
        cells = wy.T @ column @ wx
        pressure = self._factors.solve(cells.ravel()).reshape(cells.shape)
        return (wy @ pressure @ wx.T).astype(np.float32)


class _Diffusion:
    """The finite-volume form of -div(m grad p) + open p, on cells (ny, nx).

    What does not depend on m and open: which entries it has.
    """

    def __init__(self, shape: tuple[int, int], free_sides: bool) -> None:
        self.free_sides = free_sides
        number = np.arange(shape[0] * shape[1]).reshape(shape)
        #: Of the faces across y and across x: the cells before and behind each.
        self.pairs = [(number[:-1].ravel(), number[1:].ravel())]
        self.pairs.append((number[:, :-1].ravel(), number[:, 1:].ravel()))
        #: The cells at the ends along y and along x.
        self.ends = [number[[0, -1]].ravel(), number[:, [0, -1]].ravel()]
        here = [cells for low, high in self.pairs for cells in (low, high)]
        there = [cells for low, high in self.pairs for cells in (high, low)]
        rows, columns = (np.concatenate([*of, number.ravel()]) for of in (here, there))
        self._order = np.lexsort((rows, columns))
        self._rows = rows[self._order].astype(np.int32)
        begins = np.searchsorted(columns[self._order], np.arange(number.size + 1))
        self._begins = begins.astype(np.int32)

    def matrix(self, conductance: list[Array], source: Array) -> sp.csc_matrix:
        """Return the matrix.

        ``conductance`` are those between the middle of a cell and its faces along y and x,
        ``source`` is open times the cell's area; at free sides the pressure vanishes.
        """
        diagonal = source.copy().ravel()
        values = []
        for half, (low, high), ends in zip(conductance, self.pairs, self.ends, strict=True):
            flow = 1 / (1 / half.ravel()[low] + 1 / half.ravel()[high])
            values += [-flow, -flow]
            for cells in (low, high):
                diagonal[cells] += flow  # a cell is but once before or behind a face
            if self.free_sides:
                np.add.at(diagonal, ends, half.ravel()[ends])
        entries = np.concatenate([*values, diagonal])[self._order]
        size = diagonal.size
        return sp.csc_matrix((entries, self._rows, self._begins), shape=(size, size))


def _mobility(below: Array, above: Array, mu: float, h: float) -> Array:
    """Mean flow over the depth per pressure gradient, mm^2 / kPa, between resisting faces."""
    a, b = below * h / mu, above * h / mu  # as shares of the layer's own stiffness
    total = a + b + a * b
    # of mu u'' = p', mu u'(0) = below u(0), mu u'(h) = -above u(h), the mean of -u
    slip = (1 + b / 2) / np.maximum(total, 1e-12)
    return h**2 / mu * (slip * (1 + a / 2) - 1 / 6)


def _aggregated(nodes: Array, least: float) -> Array:
    """Bounds of cells that are at least ``least`` wide."""
    length = float(nodes[-1] - nodes[0])
    least = max(least, length / _CELLS)
    chosen = [0]
    for n in range(1, len(nodes)):
        if nodes[n] - nodes[chosen[-1]] >= 0.999 * least:
            chosen.append(n)
    if chosen[-1] != len(nodes) - 1:
        if len(chosen) > 2:
            chosen.pop()
        chosen.append(len(nodes) - 1)
    return nodes[chosen]


def _hats(cells: Array, at: Array) -> Array:
    """Linear interpolation from cell centres, level beyond the last; (len(at), len(cells))."""
    return np.stack([np.interp(at, cells, row) for row in np.eye(len(cells))], axis=1)
