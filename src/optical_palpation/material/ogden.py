"""The Ogden law of one term."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optical_palpation.arguments import explained_fields
from optical_palpation.errors import MaterialError
from optical_palpation.material.law import Array, Law


@explained_fields
@dataclass(frozen=True)
class Ogden(Law):
    """Ogden law W = 2 mu / alpha^2 (l1^alpha + l2^alpha + l3^alpha - 3) of the stretches l.

    One term; that of exponent 2 is neo-Hookean, and two of exponents 2 and -2 are Mooney-Rivlin.

    Parameters
    ----------
    mu
        Initial shear modulus, kPa.
    alpha
        Exponent, not 0.
    bulk_to_shear
        Ratio of bulk to initial shear modulus, at least 10.
    """

    name = "ogden"
    parameters = ("mu", "alpha")
    mu: float
    alpha: float
    bulk_to_shear: float = 1e4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.alpha == 0.0:
            raise MaterialError("alpha = 0: the exponent of the Ogden law must not be 0")

    @property
    def shear_modulus(self) -> float:
        """Initial shear modulus mu, kPa."""
        return self.mu

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Raise that the energy is no function of the invariants that the solver takes."""
        raise MaterialError(
            "the computational method takes laws of the invariants (mooney-rivlin, neo-hookean, "
            "yeoh), not ogden: fit one of them, or use the algebraic method"
        )

    def _secant(self, stretch: Array) -> Array:
        # 2 mu / alpha (L^alpha - L^(-alpha / 2)) / (L - 1), 3 mu at L = 1
        power, logs = 1.5 * self.alpha, np.log(stretch)
        rest = stretch == 1.0
        ratio = np.expm1(power * logs) / np.where(rest, 1.0, stretch - 1.0)
        scale = 2.0 * self.mu / self.alpha * np.exp(-0.5 * self.alpha * logs)
        return np.asarray(scale * np.where(rest, power, ratio))

    def _log_hessian(self, squares: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        e1, e2, e3 = (2.0 * self.mu * x ** (0.5 * self.alpha) for x in squares)
        return e1 + e3, e3, e2 + e3
