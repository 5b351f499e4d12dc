"""Closed forms for an incompressible elastic layer, each with its source or derivation.

``mu`` is the shear modulus (kPa), ``h`` the thickness (mm); small strain unless said otherwise.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from optical_palpation.material import InvariantLaw

Array = NDArray[np.float64]
Base = Literal["sliding", "stuck"]

#: Coefficients of x, x^2, x^3, x^4 in the correction of Dimitriadis et al., Biophys. J. 82:2798
#: (2002), x = sqrt(R delta) / h, for a layer not bonded and bonded to its base.
DIMITRIADIS = {"sliding": (0.884, 0.781, 0.386, 0.0048), "stuck": (1.133, 1.283, 0.769, 0.0975)}


def uniaxial_compression(law: InvariantLaw, stretch: float) -> float:
    """Axial Cauchy stress, kPa, at an axial stretch with stress-free sides, finite strain.

    The lateral stretch is that at which the lateral stress of the compressible law,
    dev(2 W1 b + 2 W2 (tr(b) b - b^2)) / J + K (J - 1) with the isochoric b, vanishes.
    """

    def stresses(lateral: float) -> Array:
        volume = stretch * lateral**2
        b = np.array([lateral**2, lateral**2, stretch**2]) * volume ** (-2 / 3)
        i1 = b.sum()
        first, second = law.slopes(i1, 0.5 * (i1**2 - (b**2).sum()))
        t = 2 * (first * b + second * (i1 * b - b**2))
        return np.asarray((t - t.mean()) / volume + law.bulk_modulus * (volume - 1))

    lateral = brentq(lambda s: float(stresses(s)[0]), 0.5, 3.0, xtol=1e-15)
    return float(stresses(lateral)[2])


def transfer(k: float, h: float, mu: float, base: Base) -> float:
    """Pressure over displacement, kPa / mm, of a frictionless face with a wave of number ``k``.

    The layer slides or sticks at z = 0. Stokes' equations with a stream function of the terms
    sinh kz, cosh kz, z sinh kz, z cosh kz; without shear traction at z = h and, if it slides, at 0.
    """
    s, c, a = np.sinh(k * h), np.cosh(k * h), k * h
    if base == "sliding":
        return float(2 * mu * k * (s * c + a) / s**2)
    return float(2 * mu * k * (c**2 + a**2) / (s * c - a))


def paraboloid(contact: float, base: Base, points: int = 48) -> tuple[float, float]:
    """Frictionless paraboloid on a layer: indentation and force at a radius of contact.

    Everything is scaled: ``contact`` is a / h, the indentation is in h^2 / R, the force in
    mu h^3 / R. The pressure is written by its Abel transform phi(t), 0 < t < a, which turns the
    dual integral equations of the layer, whose compliance is that of the half-space times
    1 - g(kh), into phi(x) - (2 / pi) int_0^a phi(t) int_0^inf g(k) cos(kx) cos(kt) dk dt =
    (4 / pi) (indentation - x^2) with phi(a) = 0 (Lebedev and Ufliand, J. Appl. Math. Mech. 22:442,
    1958). Solved by Gauss quadrature; for g = 0 it is Hertz.
    """
    node, weight = np.polynomial.legendre.leggauss(points)
    x, w = 0.5 * contact * (node + 1), 0.5 * contact * weight
    node, weight = np.polynomial.legendre.leggauss(20 * points)
    k, wk = 15.0 * (node + 1), 15.0 * weight  # g is below 1e-11 beyond 30
    decay = np.exp(-2 * k)
    if base == "sliding":
        compliance = (0.5 * (1 + decay**2) - decay) / (0.5 * (1 - decay**2) + 2 * k * decay)
    else:
        numerator = 0.5 * (1 - decay**2) - 2 * k * decay
        compliance = numerator / (0.5 * (1 + decay**2) + (1 + 2 * k**2) * decay)
    g = (1 - compliance) * wk
    cosines, end = np.cos(np.outer(x, k)), np.cos(contact * k)
    matrix = np.eye(points) - (2 / np.pi) * (cosines * g) @ cosines.T * w
    unit, square = np.linalg.solve(matrix, (4 / np.pi) * np.stack([np.ones(points), x**2]).T).T
    at_end = (2 / np.pi) * ((end * g) @ cosines.T) * w
    indentation = (4 / np.pi * contact**2 + at_end @ square) / (4 / np.pi + at_end @ unit)
    return float(indentation), float(2 * np.pi * w @ (indentation * unit - square))


def hertz(indentation: float) -> float:
    """Force on a half-space, scaled as in ``paraboloid``: (16 / 9) E sqrt(R) delta^1.5."""
    return 16 / 3 * indentation**1.5


def dimitriadis(indentation: float, base: Base) -> float:
    """Force by the series of Dimitriadis et al., scaled as in ``paraboloid``."""
    x = np.sqrt(indentation)
    series = 1 + sum(c * x ** (n + 1) for n, c in enumerate(DIMITRIADIS[base]))
    return float(hertz(indentation) * series)


def thin_paraboloid(indentation: float, faces: Literal["sliding", "one stuck", "stuck"]) -> float:
    """Force on a thin layer (a >> h), scaled as in ``paraboloid``.

    Stuck on both faces, a Poiseuille flow of displacement: (h^3 / 12 mu) laplace(p) =
    -(delta - r^2 / 2R) with p = p' = 0 at a, so a^2 = 4 R delta, F = 8 pi mu R^2 delta^3 / h^3; a
    frictionless face leaves h^3 / 3 instead of h^3 / 12. Sliding on both, plane stress in the
    plane of the layer: p = 4 mu (delta - r^2 / 2R) / h, F = 4 pi mu R delta^2 / h.
    """
    if faces == "sliding":
        return 4 * np.pi * indentation**2
    return (8 if faces == "stuck" else 2) * np.pi * indentation**3


def block_modulus(shape: float, mu: float) -> float:
    """Apparent modulus, kPa, of a square block bonded to both plates, S >> 1.

    ``shape`` is S, loaded over free area, L / 4h. Gent and Lindley (Proc. Inst. Mech. Eng. 173:111,
    1959) add to E the modulus of the flow between the plates, (h^2 / 12 mu) laplace(p) = -strain
    with p = 0 at the sides: 2 E S^2 for a disc. The mean of the solution over a square of side L is
    0.0351443 L^2 times the right-hand side, which makes it 2.2492 E S^2.
    """
    odd = np.arange(1, 200, 2)
    m, n = np.meshgrid(odd, odd)
    mean = 64 / np.pi**6 * (1 / (m**2 * n**2 * (m**2 + n**2))).sum()
    return float(3 * mu + 12 * mu * mean * 16 * shape**2)


def mean_radius(side: float) -> float:
    """Mean distance, mm, of the points of a square from its middle."""
    return side * float(np.sqrt(2) + np.log(1 + np.sqrt(2))) / 6
