"""Uncertainty of least-squares fits whose residuals are not independent."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def independent_points(residual: ArrayLike, parameters: int) -> float:
    """Count the independent points that serially correlated residuals amount to.

    Neighbouring points of a stress-strain curve or of a displacement profile share errors, and a
    law that misses the curve leaves residuals that are all correlation. Counting every point as
    new information would give intervals that are far too narrow. Residuals are taken for a
    first-order autoregressive series of lag-1 correlation r, in which n points carry as much as
    ``n (1 - r) / (1 + r)`` independent ones.

    Parameters
    ----------
    residual
        Residuals in the order of the abscissa, ``(n,)``, weighted if the fit was.
    parameters
        Number p of fitted parameters.

    Returns
    -------
    float
        Between ``p + 2`` (so that Student's t stays finite) and n.
    """
    r = np.asarray(residual, dtype=np.float64)
    energy = float(r @ r)
    correlation = float(r[1:] @ r[:-1]) / energy if energy > 0.0 else 0.0
    if correlation <= 0.0:
        return float(r.size)
    # The fit takes out p slow components, which biases the correlation low by about (1 + p) / n.
    correlation = min(correlation + (1.0 + parameters) / r.size, 1.0)
    independent = r.size * (1.0 - correlation) / (1.0 + correlation)
    return min(max(independent, parameters + 2.0), float(r.size))


def parameter_covariance(
    residual: ArrayLike, jacobian: ArrayLike
) -> tuple[NDArray[np.float64], float]:
    """Covariance of fitted parameters, allowing for serially correlated residuals.

    The covariance of ordinary least squares, widened by the ratio of points to
    :func:`independent_points`.

    Parameters
    ----------
    residual
        Residuals in the order of the abscissa, ``(n,)``, weighted if the fit was.
    jacobian
        Derivatives of the residuals by the ``p`` parameters, ``(n, p)``.

    Returns
    -------
    covariance : numpy.ndarray
        ``(p, p)``; infinite if the data do not determine the parameters.
    degrees_of_freedom : float
        Independent points less parameters, at least 1, for Student's t.
    """
    r = np.asarray(residual, dtype=np.float64)
    j = np.asarray(jacobian, dtype=np.float64)
    n, p = j.shape
    independent = independent_points(r, p)
    # Jacobians by finite differences are good to eight digits, and no rank is visible beyond.
    size = np.linalg.norm(j, axis=0)
    if np.all(size > 0.0) and np.linalg.cond(j / size) < 1e7:
        inverse = np.linalg.inv(j.T @ j)
    else:
        inverse = np.full((p, p), np.inf)
    covariance = inverse * (float(r @ r) / max(n - p, 1)) * (n / independent)
    return covariance, max(independent - p, 1.0)
