"""The point of contact of a uniaxial test, and its toe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optical_palpation.errors import InputError
from optical_palpation.material.uniaxial import UniaxialTest
from optical_palpation.regression import parameter_covariance


@dataclass(frozen=True)
class Contact:
    """Point of contact of a test and the end of its toe, engineering strains as recorded.

    Attributes
    ----------
    strain
        Strain at which full contact would have begun had there been no toe.
    standard_error
        Of `strain`.
    toe_end
        Strain beyond which the toe no longer shows (under 0.5 % of the strain since contact).
    """

    strain: float
    standard_error: float
    toe_end: float


def find_contact(test: UniaxialTest, within: float = 0.15) -> Contact:
    """Find where the platen really met the specimen.

    A rough or slightly tilted face comes into contact little by little: stress starts as a curved
    toe. The model is a neo-Hookean solid of unknown modulus, strained by
    ``w log(1 + exp((strain - contact) / w))``: nothing before contact, the full strain after it
    and a smooth toe of width ``w`` between. Modulus, contact and width are fitted together, to
    the points up to `within` past the contact, where every rubber is close to neo-Hookean.

    Parameters
    ----------
    test
        The test as recorded.
    within
        Strain past contact that the fit may use, positive.

    Raises
    ------
    InputError
        If the test holds too few points to find a contact, or does not load the specimen.
    """
    sign = -1.0 if test.loading == "compression" else 1.0
    strain = sign * test.strain
    stress = test.stress / test.stretch if test.measure == "true" else test.stress
    load = sign * stress
    if load[np.argmax(strain)] <= 0.0:
        raise InputError(f"uniaxial test {test.source}: no load at the largest strain; check signs")

    def predict(p: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        contact, log_width, modulus = p
        width = np.exp(log_width)
        since = width * np.logaddexp(0.0, (x - contact) / width)
        stretch = np.maximum(1.0 + sign * since / (1.0 + sign * contact), 1e-3)
        return np.asarray(sign * modulus / 3.0 * (stretch - stretch**-2))

    from scipy.optimize import least_squares  # slow to load, not needed to compute a stress

    start = float(np.interp(0.02 * load.max(), np.maximum.accumulate(load), strain))
    last = start
    used = np.zeros(strain.size, dtype=bool)
    for _ in range(10):  # the range follows the contact; it settles in two or three rounds
        selected = strain <= last + within
        if np.array_equal(selected, used):
            break
        used = selected
        if used.sum() < 8:
            raise InputError(
                f"uniaxial test {test.source}: only {used.sum()} points up to a strain of "
                f"{last + within:g}; 8 are needed to find the contact. Give the strain at contact, "
                "where 0 trusts the recorded zero"
            )
        x, y = strain[used], load[used]
        modulus = max((y[-1] - y[0]) / max(x[-1] - start, 1e-6), 1e-6)

        def residual(
            p: NDArray[np.float64],
            x: NDArray[np.float64] = x,
            y: NDArray[np.float64] = y,
        ) -> NDArray[np.float64]:
            return predict(p, x) - y

        fits = [
            least_squares(
                residual,
                [start, np.log(width), modulus],
                bounds=(
                    [-within, np.log(1e-5), 0.0],
                    [min(strain.max(), 0.9), np.log(0.1), np.inf],
                ),
                x_scale=[0.01, 1.0, modulus],
            )
            for width in (0.002, 0.01, 0.03)
        ]
        fit = min(fits, key=lambda result: float(result.cost))
        last = float(fit.x[0])
    covariance, _ = parameter_covariance(fit.fun, np.asarray(fit.jac))
    width = float(np.exp(fit.x[1]))
    return Contact(
        strain=sign * last,
        standard_error=float(np.sqrt(covariance[0, 0])),
        # log(1 + exp(4)) / 4 = 1.0045
        toe_end=sign * (last + 4.0 * width),
    )
