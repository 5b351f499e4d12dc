"""Hyperelastic laws fitted to a uniaxial test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from optical_palpation.errors import InputError, MaterialError
from optical_palpation.material.laws import MooneyRivlin
from optical_palpation.material.uniaxial import UniaxialTest
from optical_palpation.regression import parameter_covariance

Array = NDArray[np.float64]
LawName = Literal["mooney-rivlin", "neo-hookean", "yeoh", "ogden"]


@dataclass(frozen=True)
class _Law:
    """An incompressible law: energy W of principal stretches, and engineering stress dW/dL."""

    parameters: tuple[str, ...]
    starts: tuple[tuple[float, ...], ...]
    energy: Callable[..., Array]
    stress: Callable[..., Array]
    modulus: tuple[float, ...]  # initial Young's modulus = modulus . parameters


def _invariants(stretches: Array) -> tuple[Array, Array]:
    return np.sum(stretches**2, axis=0) - 3.0, np.sum(stretches**-2, axis=0) - 3.0


def _yeoh_energy(stretches: Array, c10: float, c20: float, c30: float) -> Array:
    i1, _ = _invariants(stretches)
    return c10 * i1 + c20 * i1**2 + c30 * i1**3


def _yeoh_stress(stretch: Array, c10: float, c20: float, c30: float) -> Array:
    i1 = stretch**2 + 2.0 / stretch - 3.0
    return 2.0 * (stretch - stretch**-2) * (c10 + 2.0 * c20 * i1 + 3.0 * c30 * i1**2)


_LAWS: dict[str, _Law] = {
    "mooney-rivlin": _Law(
        ("c10", "c01"),
        ((1.0, 0.0),),
        lambda s, c10, c01: c10 * _invariants(s)[0] + c01 * _invariants(s)[1],
        lambda s, c10, c01: 2.0 * (s - s**-2) * (c10 + c01 / s),
        (6.0, 6.0),
    ),
    "neo-hookean": _Law(
        ("c10",),
        ((1.0,),),
        lambda s, c10: c10 * _invariants(s)[0],
        lambda s, c10: 2.0 * (s - s**-2) * c10,
        (6.0,),
    ),
    "yeoh": _Law(
        ("c10", "c20", "c30"), ((1.0, 0.0, 0.0),), _yeoh_energy, _yeoh_stress, (6.0, 0.0, 0.0)
    ),
    # One term; two of exponents 2 and -2 are the Mooney-Rivlin law. Its sum of squares may have
    # a minimum on either side of exponent 0, hence several starts.
    "ogden": _Law(
        ("mu", "alpha"),
        ((1.0, 2.0), (1.0, 8.0), (1.0, -2.0), (1.0, -8.0)),
        lambda s, mu, alpha: 2.0 * mu / alpha**2 * (np.sum(s**alpha, axis=0) - 3.0),
        lambda s, mu, alpha: 2.0 * mu / alpha * (s ** (alpha - 1.0) - s ** (-alpha / 2.0 - 1.0)),
        (3.0, 0.0),
    ),
}


@dataclass(frozen=True)
class UniaxialFit:
    """A law fitted to a uniaxial test.

    Attributes
    ----------
    law
        Name of the law.
    parameters
        Fitted values: kPa, but for Ogden's exponent ``alpha``.
    intervals
        95 % confidence intervals of the parameters, wider where residuals are correlated. They
        describe this test; specimens of one batch often differ by more.
    covariance
        Of the parameters, in their order.
    initial_youngs_modulus, initial_youngs_modulus_interval
        Young's modulus at zero strain and its 95 % confidence interval, kPa.
    rms
        Root mean square residual in the test's measure, kPa.
    strain_range
        Smallest and largest engineering strain of the fitted points.
    stable_stretches
        By mode (``"uniaxial"``, ``"planar"``) the axial stretches around 1 in which the law is
        stable in Drucker's sense, looked for between 0.1 and 10.
    stable
        Whether it is stable in both modes from zero strain to the end of the test. If not, it must
        not be used beyond the stable stretches, and ``material`` refuses it if these do not even
        cover the strains a layer is used at.
    test
        The fitted points.
    """

    law: LawName
    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    covariance: Array
    initial_youngs_modulus: float
    initial_youngs_modulus_interval: tuple[float, float]
    rms: float
    strain_range: tuple[float, float]
    stable_stretches: dict[str, tuple[float, float]]
    stable: bool
    test: UniaxialTest

    def stress(self, strain: ArrayLike) -> Array:
        """Stress at engineering strains in the test's measure, kPa, tension positive."""
        stretch = 1.0 + np.asarray(strain, dtype=np.float64)
        return _stress(_LAWS[self.law], stretch, self.test.measure, tuple(self.parameters.values()))

    def material(self, bulk_to_shear: float = 1e4) -> MooneyRivlin:
        """Return the law as the material of the layer.

        Raises
        ------
        MaterialError
            If the law is not Mooney-Rivlin or neo-Hookean, or is unstable.
        """
        if "c10" not in self.parameters or self.law == "yeoh":
            raise MaterialError(
                f"the solver takes Mooney-Rivlin and neo-Hookean layers, not {self.law}; fit one "
                "of them"
            )
        c10, c01 = self.parameters["c10"], self.parameters.get("c01", 0.0)
        return MooneyRivlin(c10, c01, bulk_to_shear)


def fit_uniaxial(test: UniaxialTest, law: LawName = "mooney-rivlin") -> UniaxialFit:
    """Fit an incompressible law to a uniaxial test by unweighted least squares of stress.

    Parameters
    ----------
    test
        The points to fit, toe removed: see :func:`find_contact`, ``UniaxialTest.from_contact`` and
        ``UniaxialTest.between``.
    law
        ``"mooney-rivlin"`` (c10, c01), ``"neo-hookean"`` (c10), ``"yeoh"`` (c10, c20, c30) or
        one-term ``"ogden"`` (mu, alpha; mu is the initial shear modulus).

    Raises
    ------
    InputError
        If the law is unknown or the points do not determine it.
    """
    if law not in _LAWS:
        raise InputError(f"law = {law!r}: choose one of {', '.join(_LAWS)}")
    definition = _LAWS[law]
    scale = float(np.max(np.abs(test.stress)))
    if scale == 0.0:
        raise InputError(f"uniaxial test {test.source}: stress is zero everywhere")

    from scipy.optimize import least_squares  # slow to load, not needed to compute a stress

    def residual(p: Array) -> Array:
        return _stress(definition, test.stretch, test.measure, p) / scale - test.stress / scale

    with np.errstate(over="ignore", invalid="ignore"):
        fits = [
            least_squares(
                residual, _scaled(definition, start, scale), x_scale="jac", xtol=1e-13, ftol=1e-13
            )
            for start in definition.starts
        ]
    best = min(fits, key=lambda fit: float(fit.cost))
    covariance, freedom = parameter_covariance(best.fun, np.asarray(best.jac))
    if not np.isfinite(covariance).all():
        raise InputError(
            f"uniaxial test {test.source}: the points do not determine the {law} law (strains "
            f"{test.strain.min():g} to {test.strain.max():g}); widen the range or take fewer "
            "parameters"
        )
    quantile = float(stdtrit(freedom, 0.975))
    values = dict(zip(definition.parameters, (float(v) for v in best.x), strict=True))
    half = quantile * np.sqrt(np.diag(covariance))
    weights = np.asarray(definition.modulus)
    modulus = float(weights @ best.x)
    modulus_half = quantile * float(np.sqrt(weights @ covariance @ weights))
    limits = {mode: _stable_stretches(definition, best.x, mode) for mode in ("uniaxial", "planar")}
    ends = min(test.stretch.min(), 1.0), max(test.stretch.max(), 1.0)
    return UniaxialFit(
        law=law,
        parameters=values,
        intervals={
            name: (value - h, value + h)
            for (name, value), h in zip(values.items(), half, strict=True)
        },
        covariance=covariance,
        initial_youngs_modulus=modulus,
        initial_youngs_modulus_interval=(modulus - modulus_half, modulus + modulus_half),
        rms=scale * float(np.sqrt(np.mean(best.fun**2))),
        strain_range=(float(test.strain.min()), float(test.strain.max())),
        stable_stretches=limits,
        stable=all(low <= ends[0] and ends[1] <= high for low, high in limits.values()),
        test=test,
    )


def _scaled(law: _Law, start: tuple[float, ...], scale: float) -> list[float]:
    """Bring the moduli of a start to the size of the stress; an exponent has none."""
    return [
        v if name == "alpha" else v * scale for name, v in zip(law.parameters, start, strict=True)
    ]


def _stress(law: _Law, stretch: Array, measure: str, parameters: ArrayLike) -> Array:
    engineering = law.stress(stretch, *np.asarray(parameters))
    return engineering * stretch if measure == "true" else engineering


def _stable_stretches(law: _Law, parameters: Array, mode: str) -> tuple[float, float]:
    """Axial stretches around 1 where the energy is convex in volume-preserving log strains.

    That is Drucker's criterion for increments along the principal axes: the 2 x 2 matrix of second
    derivatives of W by two log strains (the third is minus their sum) is positive definite.
    """
    logs = np.log(10.0) * np.linspace(-1.0, 1.0, 4001)
    second = -0.5 * logs if mode == "uniaxial" else np.zeros_like(logs)
    h = 1e-3

    def energy(d1: float, d2: float) -> Array:
        a, b = logs + d1, second + d2
        return law.energy(np.exp(np.array([a, b, -a - b])), *parameters)

    centre = energy(0.0, 0.0)
    along = energy(h, 0.0) - 2.0 * centre + energy(-h, 0.0)
    across = energy(0.0, h) - 2.0 * centre + energy(0.0, -h)
    mixed = 0.25 * (energy(h, h) - energy(h, -h) - energy(-h, h) + energy(-h, -h))
    stable = (along > 0.0) & (across > 0.0) & (along * across > mixed**2)
    rest = logs.size // 2
    if not stable[rest]:
        return 1.0, 1.0
    below, above = np.flatnonzero(~stable[:rest]), np.flatnonzero(~stable[rest:])
    lowest = logs[below[-1] + 1] if below.size else logs[0]
    highest = logs[rest + above[0] - 1] if above.size else logs[-1]
    return float(np.exp(lowest)), float(np.exp(highest))
