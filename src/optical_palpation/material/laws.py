"""Hyperelastic laws of the compliant layer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optical_palpation.errors import InputError, MaterialError

# Below this ratio the law is no longer one of a nearly incompressible solid: Young's modulus is
# more than 3 % under 3 mu, so that the incompressible uniaxial curve misses the stress by as much,
# and the isochoric-volumetric split of the energy predicts wrong lateral strains.
LOWEST_BULK_TO_SHEAR = 10.0
# Water over the softest gel; 1e4 is already as good as incompressible.
HIGHEST_BULK_TO_SHEAR = 1e8
# kPa, from 1 Pa to 1 GPa: softer than any gel, harder than any layer that a sample could press.
PLAUSIBLE_SHEAR_MODULUS = (1e-3, 1e6)

# Uniaxial stretches over which a law must be stable to be accepted. Layers are used to about 50 %
# compression; beyond it the published method itself breaks down (section 4).
WORKING_STRETCHES = (0.5, 1.5)


@dataclass(frozen=True)
class MooneyRivlin:
    """Nearly incompressible Mooney-Rivlin solid (section 3 of the paper).

    The energy is ``c10 (I1bar - 3) + c01 (I2bar - 3)`` plus a volumetric part with bulk modulus
    ``bulk_to_shear * shear_modulus``.

    Parameters
    ----------
    c10, c01
        Coefficients in kPa. One of them may be negative as long as the law stays stable in
        Drucker's sense over the uniaxial stretches 0.5 to 1.5, see :func:`stable_stretches`.
    bulk_to_shear
        Ratio of bulk to initial shear modulus, at least 10: below, Young's modulus is more than
        3 % under its incompressible value and the law describes no nearly incompressible solid.

    Raises
    ------
    MaterialError
        If a parameter is not finite, the shear modulus is not positive or no soft solid's, the law
        is unstable in the working range, or ``bulk_to_shear`` is outside 10 to 1e8.
    """

    c10: float
    c01: float = 0.0
    bulk_to_shear: float = 1e4

    def __post_init__(self) -> None:
        for name in ("c10", "c01", "bulk_to_shear"):
            try:
                value = float(getattr(self, name))
            except (TypeError, ValueError):
                raise MaterialError(f"{name} = {getattr(self, name)!r} is no number") from None
            if not math.isfinite(value):
                raise MaterialError(f"{name} = {value} is not finite")
            object.__setattr__(self, name, value)
        given = f"(c10 = {self.c10:g} kPa, c01 = {self.c01:g} kPa)"
        if not self.shear_modulus > 0.0:
            raise MaterialError(
                f"unstable material: the shear modulus 2 (c10 + c01) = {self.shear_modulus:g} kPa "
                f"is not positive {given}"
            )
        softest, hardest = PLAUSIBLE_SHEAR_MODULUS
        if not softest <= self.shear_modulus <= hardest:
            raise MaterialError(
                f"a shear modulus 2 (c10 + c01) of {self.shear_modulus:g} kPa is that of no soft "
                f"layer, {softest:g} to {hardest:g} kPa {given}: are the coefficients in kPa?"
            )
        lowest, highest = stable_stretches(self.c10, self.c01)
        if lowest > WORKING_STRETCHES[0] or highest < WORKING_STRETCHES[1]:
            raise MaterialError(
                f"unstable material: with c10 = {self.c10:g} kPa and c01 = {self.c01:g} kPa the "
                f"law is stable only between {_percent(lowest)} and {_percent(highest)} uniaxial "
                f"strain; {_percent(WORKING_STRETCHES[0])} to {_percent(WORKING_STRETCHES[1])} is "
                "needed. Refit with c01 = 0 (neo-Hookean) or over a wider range of strain"
            )
        if self.bulk_to_shear < LOWEST_BULK_TO_SHEAR:
            raise MaterialError(
                f"bulk_to_shear = {self.bulk_to_shear:g} is too low: the law holds for nearly "
                f"incompressible layers, bulk_to_shear >= {LOWEST_BULK_TO_SHEAR:g} "
                "(the published runs used 20; the default is 10000)"
            )
        if self.bulk_to_shear > HIGHEST_BULK_TO_SHEAR:
            raise MaterialError(
                f"bulk_to_shear = {self.bulk_to_shear:g} is beyond that of any material, "
                f"{HIGHEST_BULK_TO_SHEAR:g}; 10000 is as good as incompressible"
            )

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Coefficients (c10, c20, c30, c01) of I1bar - 3, its powers, and I2bar - 3, kPa."""
        return self.c10, 0.0, 0.0, self.c01

    @property
    def shear_modulus(self) -> float:
        """Initial shear modulus 2 (c10 + c01), kPa."""
        return 2.0 * (self.c10 + self.c01)

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus, kPa."""
        return self.bulk_to_shear * self.shear_modulus

    @property
    def initial_youngs_modulus(self) -> float:
        """Young's modulus at zero strain of the incompressible solid, 3 mu, kPa."""
        return 3.0 * self.shear_modulus

    def strain_adjusted_modulus(self, strain: ArrayLike) -> NDArray[np.float64]:
        """Secant Young's modulus E(strain) of uniaxial stress, kPa.

        Defined by ``true stress = E(strain) * strain``. The paper prints the algebraic method as
        ``E / strain``, a misprint: the stress would be infinite at zero strain.

        Parameters
        ----------
        strain
            Engineering strain of any shape, negative in compression, above -1.

        Returns
        -------
        numpy.ndarray
            E of the shape of `strain`; 3 mu at zero strain; NaN where `strain` is NaN.

        Raises
        ------
        InputError
            If a strain is -1 or below, or infinite.
        """
        stretch = 1.0 + np.asarray(strain, dtype=np.float64)
        if np.any(stretch <= 0.0) or np.any(np.isinf(stretch)):
            raise InputError(
                "uniaxial strain must be finite and above -1 (-1 leaves no thickness at all); "
                f"found {np.nanmin(stretch) - 1.0:g} to {np.nanmax(stretch) - 1.0:g}"
            )
        # (L^2 - 1/L) / (L - 1) written out, so that nothing is divided by zero at L = 1.
        modulus = 2.0 * (stretch + 1.0 + 1.0 / stretch) * (self.c10 + self.c01 / stretch)
        return np.asarray(modulus, dtype=np.float64)

    def uniaxial_stress(
        self, strain: ArrayLike, measure: Literal["engineering", "true"] = "engineering"
    ) -> NDArray[np.float64]:
        """Uniaxial stress of the incompressible solid, closed form, kPa (tension positive).

        With stretch L = 1 + strain the true (Cauchy) stress is ``2 (L^2 - 1/L) (c10 + c01/L)`` and
        the engineering stress is the true stress divided by L. The bulk modulus does not enter:
        the curve is that of the incompressible solid.

        Parameters
        ----------
        strain
            Engineering strain of any shape, negative in compression, above -1.
        measure
            ``"engineering"`` (force per undeformed area) or ``"true"`` (force per deformed area).

        Returns
        -------
        numpy.ndarray
            Stress of the shape of `strain`.

        Raises
        ------
        InputError
            If a strain is -1 or below or infinite, or `measure` is unknown.
        """
        if measure not in ("engineering", "true"):
            raise InputError(f"measure = {measure!r}: choose 'engineering' or 'true'")
        strain = np.asarray(strain, dtype=np.float64)
        true = self.strain_adjusted_modulus(strain) * strain
        return np.asarray(true if measure == "true" else true / (1.0 + strain))


def neo_hookean(c10: float, bulk_to_shear: float = 1e4) -> MooneyRivlin:
    """Neo-Hookean solid: the Mooney-Rivlin law with ``c01 = 0``; shear modulus 2 c10 (kPa)."""
    return MooneyRivlin(c10, 0.0, bulk_to_shear)


def stable_stretches(c10: float, c01: float) -> tuple[float, float]:
    """Range of uniaxial stretch around 1 in which the incompressible law is stable.

    Drucker's criterion in the uniaxial state: an increment of Cauchy stress does positive work on
    every volume-preserving increment of logarithmic strain along the principal axes. With stretch
    L it is two conditions:

    - along the axis, the true stress grows with L:
      ``c10 (2 L^4 + L) + c01 (L^3 + 2) > 0``;
    - across it, the two lateral strains cannot drift apart: ``c10 + c01 L^2 > 0``.

    Both always hold when neither coefficient is negative. A negative c01 bounds the range by the
    first condition in compression, a negative c10 by the second.

    Parameters
    ----------
    c10, c01
        Coefficients in kPa.

    Returns
    -------
    tuple of float
        Lowest and highest stretch, 0 and infinity where there is no bound.

    Raises
    ------
    MaterialError
        If ``c10 + c01`` is not positive: the law is unstable at rest.
    """
    if not c10 + c01 > 0.0:
        raise MaterialError(
            f"unstable material: c10 + c01 = {c10 + c01:g} kPa must be positive "
            f"(c10 = {c10:g} kPa, c01 = {c01:g} kPa)"
        )
    ratio = min(c10, c01) / max(c10, c01)
    if ratio >= 0.0:
        return 0.0, math.inf
    from scipy.optimize import brentq  # slow to load, and seldom needed

    # Exchanging the coefficients and inverting the stretch leaves both conditions as they are.
    along = brentq(lambda stretch: 2 * stretch**4 + stretch + ratio * (stretch**3 + 2), 0.0, 1.0)
    across = math.sqrt(-ratio)
    if c01 < 0.0:
        return along, 1.0 / across
    return across, 1.0 / along if along > 0.0 else math.inf


def _percent(stretch: float) -> str:
    return f"{100.0 * (stretch - 1.0):.3g} %"
