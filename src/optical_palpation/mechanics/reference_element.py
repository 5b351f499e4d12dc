"""The element again, to be read: one element of a body in plain NumPy, term by term.

The kernels of ``elements`` compute the same for many elements at a time, and are tested against it.
``reference`` and ``current`` are the positions (8, 3) of an element's nodes before and after the
deformation, mm, node = 4 z + 2 y + x; ``pressure`` is in kPa, tension positive, ``factor`` the
stiffness factor of the element.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from optical_palpation.material import InvariantLaw

from .elements import GRADIENTS

Array = NDArray[np.float64]
_I = np.eye(3)
_IXI = np.einsum("ij,kl->ijkl", _I, _I)
_SYMMETRIC = 0.5 * (np.einsum("ik,jl->ijkl", _I, _I) + np.einsum("il,jk->ijkl", _I, _I))
_DEVIATORIC = _SYMMETRIC - _IXI / 3


def points(reference: Array, current: Array) -> Iterator[tuple[Array, Array, float]]:
    """Yield F, the shape functions' gradients (8, 3) in space, and the volume of a Gauss point."""
    for gradients in GRADIENTS:
        before, after = reference.T @ gradients, current.T @ gradients
        yield (
            after @ np.linalg.inv(before),
            gradients @ np.linalg.inv(after),
            float(np.linalg.det(before)) / 8,
        )


def invariants(f: Array) -> tuple[float, Array, Array, Array]:
    """J, the isochoric left Cauchy-Green tensor b = J^(-2/3) F F^T, and its I1 and I2."""
    j = float(np.linalg.det(f))
    b = j ** (-2 / 3) * f @ f.T
    i1 = np.trace(b)
    return j, b, i1, 0.5 * (i1**2 - np.trace(b @ b))


def energy(
    law: InvariantLaw, factor: float, reference: Array, current: Array, pressure: float
) -> float:
    """Energy of the element at fixed pressure, s W + p (J - 1) - p^2 / (2 s K), uJ."""
    total = 0.0
    for f, _, volume in points(reference, current):
        j, _, i1, i2 = invariants(f)
        isochoric = factor * float(law.energy(i1, i2))
        bulk = pressure * (j - 1) - pressure**2 / (2 * factor * law.bulk_modulus)
        total += volume * (isochoric + bulk)
    return total


def _stresses(law: InvariantLaw, factor: float, f: Array, pressure: float) -> tuple[Array, Array]:
    """Isochoric Kirchhoff stress, before its deviator is taken, and the whole one, kPa."""
    j, b, i1, i2 = invariants(f)
    w1, w2 = law.slopes(i1, i2)
    isochoric = factor * 2 * ((w1 + i1 * w2) * b - w2 * b @ b)
    return isochoric, isochoric - np.trace(isochoric) / 3 * _I + pressure * j * _I


def force(
    law: InvariantLaw, factor: float, reference: Array, current: Array, pressure: float
) -> tuple[Array, Array]:
    """Nodal forces (8, 3), mN, and the gradient (8, 3) of the element's volume, mm^2."""
    nodal, divergence = np.zeros((8, 3)), np.zeros((8, 3))
    for f, gradient, volume in points(reference, current):
        _, kirchhoff = _stresses(law, factor, f, pressure)
        nodal += volume * gradient @ kirchhoff
        divergence += volume * np.linalg.det(f) * gradient
    return nodal, divergence


def stress(
    law: InvariantLaw, factor: float, reference: Array, current: Array, pressure: float
) -> Array:
    """Cauchy stress (3, 3), kPa, averaged over the deformed volume."""
    total, deformed = np.zeros((3, 3)), 0.0
    for f, _, volume in points(reference, current):
        total += volume * _stresses(law, factor, f, pressure)[1]
        deformed += volume * float(np.linalg.det(f))
    return total / deformed


def stiffness(
    law: InvariantLaw,
    factor: float,
    reference: Array,
    current: Array,
    pressure: float,
    gamma: float = 0.0,
) -> Array:
    """Derivative of the nodal forces, (24, 24), mN / mm, with the penalty s gamma / V b b^T.

    b is the gradient of the volume, V the reference volume. Spatial form, with the elasticity
    tensor of Holzapfel, Nonlinear Solid Mechanics (2000), section 6.6.
    """
    matrix, whole = np.zeros((8, 3, 8, 3)), 0.0
    for f, gradient, volume in points(reference, current):
        j, b, i1, i2 = invariants(f)
        isochoric, kirchhoff = _stresses(law, factor, f, pressure)
        deviator = kirchhoff - pressure * j * _I
        _, w2 = law.slopes(i1, i2)
        w11, w12, w22 = law.curvatures(i1, i2)
        b1, b2 = b, i1 * b - b @ b  # b times the derivatives of the invariants by b
        products = np.einsum("ik,jl->ijkl", b, b) + np.einsum("il,jk->ijkl", b, b)
        bent = w2 * (np.einsum("ij,kl->ijkl", b, b) - 0.5 * products)
        for weight, one, other in ((w11, b1, b1), (w12, b1, b2), (w12, b2, b1), (w22, b2, b2)):
            bent = bent + weight * np.einsum("ij,kl->ijkl", one, other)
        tensor = 4 * factor * np.einsum("ijmn,mnpq,pqkl->ijkl", _DEVIATORIC, bent, _DEVIATORIC)
        tensor += 2 / 3 * np.trace(isochoric) * _DEVIATORIC
        tensor -= 2 / 3 * np.einsum("ij,kl->ijkl", _I, deviator)
        tensor -= 2 / 3 * np.einsum("ij,kl->ijkl", deviator, _I)
        tensor += pressure * j * (_IXI - 2 * _SYMMETRIC)
        matrix += volume * np.einsum("aj,ijkl,bl->aibk", gradient, tensor, gradient)
        turned = np.einsum("aj,jl,bl->ab", gradient, kirchhoff, gradient)
        matrix += volume * np.einsum("ab,ik->aibk", turned, _I)
        whole += volume
    divergence = force(law, factor, reference, current, pressure)[1].ravel()
    penalty = factor * gamma / whole * np.outer(divergence, divergence)
    return matrix.reshape(24, 24) + penalty
