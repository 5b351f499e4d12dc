"""Hyperelastic laws fitted to a uniaxial test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from optical_palpation.errors import InputError
from optical_palpation.material.law import Law, Mode
from optical_palpation.material.laws import LAWS, LawName, make_law
from optical_palpation.material.uniaxial import Measure, UniaxialTest
from optical_palpation.regression import parameter_covariance

Array = NDArray[np.float64]

MODES: tuple[Mode, ...] = ("uniaxial", "planar")
#: Stretches between which stability is reported.
_SEARCHED = (0.1, 10.0)
#: Where fits start, in units of the largest stress but for Ogden's exponent. Its sum of squares may
#: have a minimum on either side of exponent 0, hence several.
_STARTS: dict[str, tuple[tuple[float, ...], ...]] = {
    "mooney-rivlin": ((1.0, 0.0),),
    "neo-hookean": ((1.0,),),
    "yeoh": ((1.0, 0.0, 0.0),),
    "ogden": ((1.0, 2.0), (1.0, 8.0), (1.0, -2.0), (1.0, -8.0)),
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
    stable_stretches: dict[Mode, tuple[float, float]]
    stable: bool
    test: UniaxialTest

    def stress(self, strain: ArrayLike) -> Array:
        """Stress at engineering strains in the test's measure, kPa, tension positive."""
        stretch = 1.0 + np.asarray(strain, dtype=np.float64)
        values = np.array(list(self.parameters.values()))
        return _stress(LAWS[self.law], stretch, self.test.measure, values)

    def material(self, bulk_to_shear: float = 1e4) -> Law:
        """Return the law as the material of the layer.

        The computational method takes all but Ogden's, the algebraic one all.

        Raises
        ------
        MaterialError
            If the law is unstable at the strains a layer is used at.
        """
        return make_law(self.law, bulk_to_shear, **self.parameters)


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
    if law not in LAWS:
        raise InputError(f"law = {law!r}: choose one of {', '.join(LAWS)}")
    definition = LAWS[law]
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
            for start in _STARTS[law]
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
    # Young's modulus is linear in the coefficients; an exponent has no part in it
    weights = np.array(
        [definition.unchecked(*unit).initial_youngs_modulus for unit in np.eye(best.x.size)]
    )
    modulus = float(weights @ best.x)
    modulus_half = quantile * float(np.sqrt(weights @ covariance @ weights))
    found = definition.unchecked(*best.x)
    limits = {mode: _within(found.stable_stretches(mode)) for mode in MODES}
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


def _scaled(law: type[Law], start: tuple[float, ...], scale: float) -> list[float]:
    """Bring the moduli of a start to the size of the stress; an exponent has none."""
    return [
        v if name == "alpha" else v * scale for name, v in zip(law.parameters, start, strict=True)
    ]


def _stress(law: type[Law], stretch: Array, measure: Measure, parameters: Array) -> Array:
    return law.unchecked(*parameters).uniaxial_stress(stretch - 1.0, measure)


def _within(stretches: tuple[float, float]) -> tuple[float, float]:
    low, high = stretches
    return max(low, _SEARCHED[0]), min(high, _SEARCHED[1])
