"""The neo-Hookean law."""

from __future__ import annotations

from dataclasses import dataclass

from optical_palpation.arguments import explained_fields
from optical_palpation.material.law import Array, InvariantLaw


@explained_fields
@dataclass(frozen=True)
class NeoHookean(InvariantLaw):
    """Neo-Hookean law W = c10 (I1bar - 3); the shear modulus is 2 c10.

    Parameters
    ----------
    c10
        Coefficient in kPa.
    bulk_to_shear
        Ratio of bulk to initial shear modulus, at least 10.
    """

    name = "neo-hookean"
    parameters = ("c10",)
    c10: float
    bulk_to_shear: float = 1e4

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Coefficients (c10, c20, c30, c01) of the energy as the solver takes it, kPa."""
        return self.c10, 0.0, 0.0, 0.0

    def energy(self, i1: Array, i2: Array) -> Array:
        """Energy W(I1bar, I2bar) per unit volume, kPa."""
        return self.c10 * (i1 - 3)

    def slopes(self, i1: Array, i2: Array) -> tuple[float, float]:
        """First derivatives of the energy by I1bar and I2bar, kPa."""
        return self.c10, 0.0

    def curvatures(self, i1: Array, i2: Array) -> tuple[float, float, float]:
        """Second derivatives of the energy: none."""
        return 0.0, 0.0, 0.0
