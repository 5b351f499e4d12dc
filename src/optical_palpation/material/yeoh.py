"""The Yeoh law."""

from __future__ import annotations

from dataclasses import dataclass

from optical_palpation.arguments import explained_fields
from optical_palpation.material.law import Array, InvariantLaw


@explained_fields
@dataclass(frozen=True)
class Yeoh(InvariantLaw):
    """Yeoh law W = c10 x + c20 x^2 + c30 x^3 with x = I1bar - 3 (Rubber Chem. Technol. 66:754).

    Parameters
    ----------
    c10, c20, c30
        Coefficients in kPa; the shear modulus is 2 c10. A negative c20 is common and lets the law
        soften before it stiffens; it must stay stable over the uniaxial stretches 0.5 to 1.5.
    bulk_to_shear
        Ratio of bulk to initial shear modulus, at least 10.
    """

    name = "yeoh"
    parameters = ("c10", "c20", "c30")
    c10: float
    c20: float = 0.0
    c30: float = 0.0
    bulk_to_shear: float = 1e4

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Coefficients (c10, c20, c30, c01) of the energy as the solver takes it, kPa."""
        return self.c10, self.c20, self.c30, 0.0

    def energy(self, i1: Array, i2: Array) -> Array:
        """Energy W(I1bar, I2bar) per unit volume, kPa."""
        x = i1 - 3
        return x * (self.c10 + x * (self.c20 + x * self.c30))

    def slopes(self, i1: Array, i2: Array) -> tuple[Array, float]:
        """First derivatives of the energy by I1bar and I2bar, kPa."""
        x = i1 - 3
        return self.c10 + x * (2 * self.c20 + x * 3 * self.c30), 0.0

    def curvatures(self, i1: Array, i2: Array) -> tuple[Array, float, float]:
        """Second derivatives of the energy: twice by I1bar, by both, twice by I2bar, kPa."""
        return 2 * self.c20 + 6 * self.c30 * (i1 - 3), 0.0, 0.0
