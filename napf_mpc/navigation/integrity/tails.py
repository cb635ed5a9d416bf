"""Factors k for which an error stays within k sigma with a given probability, by the law of its tail."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

__all__ = ["StudentTail", "confidence_factor", "fit_student", "student_factor"]

Array = NDArray[np.float64]

MIN_DOF, MAX_DOF = 0.5, 1e3
"""Degrees of freedom among which a fit looks; at the upper end the law is normal to a per mille."""


def confidence_factor(confidence: float, dimensions: int = 1) -> float:
    """Return k for which a normal error stays within k sigma with the given probability.

    In one dimension k = sqrt(2) erfinv(p), two-sided normal (p = 0.9974 gives 3.01); in more, the square
    root of the chi-square quantile, so that the whole error vector lies in the k-sigma ellipsoid.

    Raises
    ------
    ValueError
        If confidence is outside (0, 1) or dimensions is not a positive whole number.
    """
    _check(confidence, dimensions)
    return math.sqrt(2.0 * float(special.gammaincinv(dimensions / 2.0, confidence)))


def student_factor(confidence: float, degrees_of_freedom: float, dimensions: int = 1) -> float:
    r"""Return k for which an error of Student's t law stays within k scales with the given probability.

    In d dimensions the error has the multivariate t law with scale matrix :math:`\Sigma` (not its covariance,
    which is :math:`\nu / (\nu - 2)` times as large), so that :math:`e^T \Sigma^{-1} e / d` has the F law with
    d and :math:`\nu` degrees of freedom and :math:`k = \sqrt{d F^{-1}_{d, \nu}(p)}` (Kotz and Nadarajah 2004,
    section 1.7). One degree of freedom is Cauchy's law: p = 0.9973 gives k = 236.

    Parameters
    ----------
    confidence : float
        Probability in (0, 1), two-sided in one dimension.
    degrees_of_freedom : float
        :math:`\nu` > 0; infinity is the normal law.
    dimensions : int
        1, 2 or 3.

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    if math.isinf(degrees_of_freedom) and degrees_of_freedom > 0.0:
        return confidence_factor(confidence, dimensions)
    _check(confidence, dimensions)
    if not degrees_of_freedom > 0.0:
        raise ValueError(f"degrees_of_freedom = {degrees_of_freedom!r} must be > 0")
    quantile = float(special.fdtri(dimensions, degrees_of_freedom, confidence))
    return math.sqrt(dimensions * quantile)


def _check(confidence: float, dimensions: int) -> None:
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence = {confidence!r} must be > 0 and < 1")
    if not (math.isfinite(dimensions) and dimensions >= 1 and dimensions == int(dimensions)):
        raise ValueError(f"dimensions = {dimensions!r} must be a whole number >= 1")


@dataclass(frozen=True)
class StudentTail:
    """Student's t law about zero, in units of the reported sigma."""

    degrees_of_freedom: float
    """The fewer, the heavier the tail."""
    scale: float
    """Reported sigmas of one scale."""

    def factor(self, confidence: float) -> float:
        """Reported sigmas that an error stays within, on one axis."""
        return self.scale * student_factor(confidence, self.degrees_of_freedom)


def fit_student(normalised: Array) -> StudentTail:
    """Fit Student's t law about zero to errors over their reported sigmas, by greatest likelihood.

    Parameters
    ----------
    normalised : array, shape (n,)
        Errors over reported sigmas of one axis, at least 10.

    Raises
    ------
    ValueError
        Fewer than 10 values, or one that is not finite, or all of them zero.
    """
    z = np.asarray(normalised, dtype=np.float64)
    if z.ndim != 1 or len(z) < 10 or not np.isfinite(z).all() or not z.any():
        raise ValueError(f"normalised must be 10 or more finite numbers, not all zero; got {z.size}")
    from scipy import optimize  # half a second, and only a fit needs it

    square = z**2

    def cost(logs: Array) -> float:
        dof, variance = math.exp(logs[0]), math.exp(2.0 * logs[1])
        constant = special.gammaln(0.5 * (dof + 1.0)) - special.gammaln(0.5 * dof)
        constant -= 0.5 * math.log(dof * math.pi * variance)
        return float(-len(z) * constant + 0.5 * (dof + 1.0) * np.log1p(square / (dof * variance)).sum())

    middle = math.log(max(float(np.median(np.abs(z))) / 0.6745, 1e-6))
    bounds = ((math.log(MIN_DOF), math.log(MAX_DOF)), (middle - 5.0, middle + 5.0))
    found = optimize.minimize(cost, np.array([math.log(5.0), middle]), method="L-BFGS-B", bounds=bounds)
    return StudentTail(math.exp(float(found.x[0])), math.exp(float(found.x[1])))
