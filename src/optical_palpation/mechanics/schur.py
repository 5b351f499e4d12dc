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
from numpy.typing import NDArray

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
