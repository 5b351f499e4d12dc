"""The Mooney-Rivlin law."""

from __future__ import annotations

from dataclasses import dataclass

from optical_palpation.arguments import explained_fields
from optical_palpation.material.law import Array, InvariantLaw


@explained_fields
@dataclass(frozen=True)
class MooneyRivlin(InvariantLaw):
    """Mooney-Rivlin law W = c10 (I1bar - 3) + c01 (I2bar - 3), that of the paper (section 3).

    Parameters
    ----------
    c10, c01
        Coefficients in kPa. One of them may be negative as long as the law stays stable over the
        uniaxial stretches 0.5 to 1.5, see :meth:`stable_stretches`.
    bulk_to_shear
        Ratio of bulk to initial shear modulus, at least 10: below, Young's modulus is more than
        3 % under its incompressible value and the law describes no nearly incompressible solid.
    """

    name = "mooney-rivlin"
    parameters = ("c10", "c01")
    c10: float
    c01: float = 0.0
    bulk_to_shear: float = 1e4

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Coefficients (c10, c20, c30, c01) of the energy as the solver takes it, kPa."""
        return self.c10, 0.0, 0.0, self.c01

    def energy(self, i1: Array, i2: Array) -> Array:
        """Energy W(I1bar, I2bar) per unit volume, kPa."""
        return self.c10 * (i1 - 3) + self.c01 * (i2 - 3)

    def slopes(self, i1: Array, i2: Array) -> tuple[float, float]:
        """First derivatives of the energy by I1bar and I2bar, kPa."""
        return self.c10, self.c01

    def curvatures(self, i1: Array, i2: Array) -> tuple[float, float, float]:
        """Second derivatives of the energy: none."""
        return 0.0, 0.0, 0.0
