"""What every hyperelastic law of a layer offers, and when it is that of a layer."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optical_palpation.errors import InputError, MaterialError

Array = NDArray[np.float64]
Mode = Literal["uniaxial", "planar"]

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
# Stretches within which limits of stability are looked for.
_SEARCHED = (0.01, 100.0)


class Law(ABC):
    """A nearly incompressible, isotropic hyperelastic law (section 3 of the paper).

    Its energy is an isochoric part, which a subclass defines, plus a volumetric one with bulk
    modulus ``bulk_to_shear * shear_modulus``. The curves below are those of the incompressible
    solid.

    Raises
    ------
    MaterialError
        If a parameter is not finite, the shear modulus is not positive or no soft solid's, the law
        is unstable in the working range, or ``bulk_to_shear`` is outside 10 to 1e8.
    """

    name: ClassVar[str]
    #: Names of the parameters in their order; all in kPa but ``alpha``, an exponent.
    parameters: ClassVar[tuple[str, ...]]
    bulk_to_shear: float

    def __post_init__(self) -> None:
        for name in (*self.parameters, "bulk_to_shear"):
            try:
                if isinstance(getattr(self, name), str | bool):
                    raise TypeError
                value = float(getattr(self, name))
            except (TypeError, ValueError):
                raise MaterialError(f"{name} = {getattr(self, name)!r} is no number") from None
            if not math.isfinite(value):
                raise MaterialError(f"{name} = {value} is not finite")
            object.__setattr__(self, name, value)
        if not self.shear_modulus > 0.0:
            raise MaterialError(
                f"unstable material: the initial shear modulus, {self.shear_modulus:g} kPa, is not "
                f"positive ({self.describe()})"
            )
        softest, hardest = PLAUSIBLE_SHEAR_MODULUS
        if not softest <= self.shear_modulus <= hardest:
            raise MaterialError(
                f"a shear modulus of {self.shear_modulus:g} kPa is that of no soft layer, "
                f"{softest:g} to {hardest:g} kPa ({self.describe()}): are the coefficients in kPa?"
            )
        lowest, highest = self.stable_stretches()
        if lowest > WORKING_STRETCHES[0] or highest < WORKING_STRETCHES[1]:
            raise MaterialError(
                f"unstable material: with {self.describe()} the law is stable only between "
                f"{_percent(lowest)} and {_percent(highest)} uniaxial strain; "
                f"{_percent(WORKING_STRETCHES[0])} to {_percent(WORKING_STRETCHES[1])} is needed. "
                "Fit a law with fewer coefficients (neo-Hookean), or a wider range of strain"
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

    @classmethod
    def unchecked(cls, *values: float) -> Self:
        """Return a law of any parameters, of which a fit asks how stable they are."""
        law = object.__new__(cls)
        for name, value in zip((*cls.parameters, "bulk_to_shear"), (*values, 1e4), strict=True):
            object.__setattr__(law, name, float(value))
        return law

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name."""
        return {name: getattr(self, name) for name in self.parameters}

    @property
    def attributes(self) -> dict[str, str | float]:
        """The law and its parameters as files record them."""
        named = {name + ("" if name == "alpha" else "_kPa"): v for name, v in self.values.items()}
        return {"law": self.name, **named}

    @property
    def arguments(self) -> dict[str, Any]:
        """The law as ``make_law`` takes it: name, parameters and ``bulk_to_shear``."""
        return {"law": self.name, **self.values, "bulk_to_shear": self.bulk_to_shear}

    def describe(self) -> str:
        """Return the parameters in words."""
        units = ("" if name == "alpha" else " kPa" for name in self.parameters)
        pairs = zip(self.values.items(), units, strict=True)
        return ", ".join(f"{name} = {value:g}{unit}" for (name, value), unit in pairs)

    def scaled(self, factor: float) -> Self:
        """Return a law ``factor`` times as stiff."""
        moduli = {n: factor * v for n, v in self.values.items() if n != "alpha"}
        return self.of(self.values | moduli, self.bulk_to_shear)

    @classmethod
    def of(cls, values: Mapping[str, float], bulk_to_shear: float = 1e4) -> Self:
        """Return the law of these parameters, by name."""
        arguments: dict[str, Any] = {**values, "bulk_to_shear": bulk_to_shear}
        return cls(**arguments)

    @property
    @abstractmethod
    def shear_modulus(self) -> float:
        """Initial shear modulus mu, kPa."""

    @property
    @abstractmethod
    def coefficients(self) -> tuple[float, float, float, float]:
        """Coefficients (c10, c20, c30, c01) of the energy as the solver takes it, kPa.

        It is c10 x + c20 x^2 + c30 x^3 + c01 y with x = I1bar - 3, y = I2bar - 3.

        Raises
        ------
        MaterialError
            If the law's energy has another form.
        """

    @abstractmethod
    def _secant(self, stretch: Array) -> Array:
        """Uniaxial true stress over engineering strain, kPa."""

    @abstractmethod
    def _log_hessian(self, squares: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Second derivatives (aa, ab, bb) of the energy by the first two log strains, kPa.

        ``squares`` are those of the principal stretches, whose product is 1: the third log strain
        is minus the sum of the others.
        """

    @property
    def bulk_modulus(self) -> float:
        """Bulk modulus, kPa."""
        return self.bulk_to_shear * self.shear_modulus

    @property
    def initial_youngs_modulus(self) -> float:
        """Young's modulus at zero strain of the incompressible solid, 3 mu, kPa."""
        return 3.0 * self.shear_modulus

    def strain_adjusted_modulus(self, strain: ArrayLike) -> Array:
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
        return np.asarray(self._secant(stretch), dtype=np.float64)

    def uniaxial_stress(
        self, strain: ArrayLike, measure: Literal["engineering", "true"] = "engineering"
    ) -> Array:
        """Uniaxial stress of the incompressible solid, closed form, kPa (tension positive).

        The engineering stress is the true (Cauchy) stress divided by the stretch.

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

    def stable_stretches(self, mode: Mode = "uniaxial") -> tuple[float, float]:
        """Range of axial stretch around 1 in which the incompressible law is stable.

        Drucker's criterion: an increment of Cauchy stress does positive work on every
        volume-preserving increment of logarithmic strain along the principal axes, which is to say
        that the energy is convex in these strains.

        Parameters
        ----------
        mode
            The path away from rest: ``"uniaxial"`` stress, or ``"planar"`` strain.

        Returns
        -------
        tuple of float
            Lowest and highest stretch; 0 and infinity where there is no bound between 0.01 and 100;
            1 and 1 if the law is unstable at rest.
        """
        if all(v >= 0.0 for n, v in self.values.items() if n != "alpha") and self.shear_modulus > 0:
            return 0.0, math.inf  # a sum of convex functions
        logs = np.linspace(np.log(_SEARCHED[0]), np.log(_SEARCHED[1]), 4001)
        curvature = self._least_curvature(logs, mode)
        rest = logs.size // 2
        if not curvature[rest] > 0:
            return 1.0, 1.0
        below = np.flatnonzero(~(curvature[:rest] > 0))
        above = np.flatnonzero(~(curvature[rest:] > 0))
        lowest = self._limit(logs[below[-1] : below[-1] + 2], mode) if below.size else 0.0
        end = rest + above[0] if above.size else 0
        highest = self._limit(logs[end - 1 : end + 1], mode) if above.size else math.inf
        return lowest, highest

    def _limit(self, between: Array, mode: Mode) -> float:
        """Stretch between two logarithms at which the law turns unstable."""
        from scipy.optimize import brentq  # slow to load, and seldom needed

        return float(np.exp(brentq(lambda at: float(self._least_curvature(at, mode)), *between)))

    def _least_curvature(self, log_stretch: ArrayLike, mode: Mode) -> Array:
        """Smallest second derivative of the energy by log strains, kPa."""
        a = np.asarray(log_stretch, dtype=np.float64)
        b = -0.5 * a if mode == "uniaxial" else 0.0 * a
        with np.errstate(over="ignore", invalid="ignore"):
            aa, ab, bb = self._log_hessian((np.exp(2 * a), np.exp(2 * b), np.exp(-2 * (a + b))))
            return np.asarray(0.5 * (aa + bb) - np.hypot(0.5 * (aa - bb), ab))


class InvariantLaw(Law):
    """A law whose isochoric energy is a function of the invariants I1bar and I2bar."""

    @abstractmethod
    def energy(self, i1: Array, i2: Array) -> Array:
        """Energy W(I1bar, I2bar) per unit volume, kPa."""

    @abstractmethod
    def slopes(self, i1: Array, i2: Array) -> tuple[Array | float, Array | float]:
        """First derivatives of the energy by I1bar and I2bar, kPa."""

    @abstractmethod
    def curvatures(
        self, i1: Array, i2: Array
    ) -> tuple[Array | float, Array | float, Array | float]:
        """Second derivatives of the energy: twice by I1bar, by both, twice by I2bar, kPa."""

    @property
    def shear_modulus(self) -> float:
        """Initial shear modulus 2 (dW/dI1 + dW/dI2), kPa."""
        first, second = self.slopes(np.array(3.0), np.array(3.0))
        return 2.0 * float(first + second)

    def _secant(self, stretch: Array) -> Array:
        first, second = self.slopes(stretch**2 + 2 / stretch, 2 * stretch + stretch**-2)
        # (L^2 - 1/L) / (L - 1) written out, so that nothing is divided by zero at L = 1
        return np.asarray(2.0 * (stretch + 1.0 + 1.0 / stretch) * (first + second / stretch))

    def _log_hessian(self, squares: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x1, x2, x3 = squares
        y1, y2, y3 = 1 / x1, 1 / x2, 1 / x3
        w1, w2 = self.slopes(x1 + x2 + x3, y1 + y2 + y3)
        w11, w12, w22 = self.curvatures(x1 + x2 + x3, y1 + y2 + y3)
        # derivatives of the invariants by the log strains a and b
        a1, b1, a2, b2 = 2 * (x1 - x3), 2 * (x2 - x3), 2 * (y3 - y1), 2 * (y3 - y2)

        def second(i1: Array, i2: Array, p1: Array, p2: Array, q1: Array, q2: Array) -> Array:
            bent = w11 * p1 * q1 + w12 * (p1 * q2 + p2 * q1) + w22 * p2 * q2
            return np.asarray(4 * (w1 * i1 + w2 * i2) + bent)

        return (
            second(x1 + x3, y1 + y3, a1, a2, a1, a2),
            second(x3, y3, a1, a2, b1, b2),
            second(x2 + x3, y2 + y3, b1, b2, b1, b2),
        )


def _percent(stretch: float) -> str:
    return f"{100.0 * (stretch - 1.0):.3g} %"
