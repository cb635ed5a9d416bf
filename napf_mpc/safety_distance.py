"""Safety distance from the navigation variance (section 3.2): one function for potential field and QP alike.

The paper prints an error interval ``[x - k sigma, x + k sigma]`` and no formula. As read: the obstacle is
inflated by k sigma, so the distance that enters the potential field is ``rho_eff = rho - k sigma``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.navigation.integrity.tails import confidence_factor as confidence_factor
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import Planner, Problem
from napf_mpc.risk_budget import RiskBudget

Array = NDArray[np.float64]
Safety = Literal["k_sigma", "overbound", "protection_level"]
SigmaReading = Literal["directional", "largest", "rms", "chi2"]

DEFAULT_K = 3.0
"""The paper's k: 99.73 % of a normal error, two-sided, in one axis (the paper prints 99.74 %)."""


def directional_sigma(covariance: Array, normal: Array) -> Array:
    """Standard deviation sqrt(n^T Sigma n) of the position along unit vectors n.

    Parameters
    ----------
    covariance : array, shape (..., 3, 3)
        Position covariance [m^2].
    normal : array, shape (..., 3)
        Unit vectors; leading axes broadcast against those of the covariance.

    Returns
    -------
    array, shape (...)
        [m].
    """
    c = covariance
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    # Written out: a contraction by BLAS may differ in the last bit with the size of the batch.
    variance = c[..., 0, 0] * x * x + c[..., 1, 1] * y * y + c[..., 2, 2] * z * z
    variance = variance + (c[..., 0, 1] + c[..., 1, 0]) * x * y
    variance = variance + (c[..., 0, 2] + c[..., 2, 0]) * x * z
    variance = variance + (c[..., 1, 2] + c[..., 2, 1]) * y * z
    return np.sqrt(np.maximum(variance, 0.0))


def largest_sigma(covariance: Array) -> Array:
    """Standard deviation (...) along the ellipsoid's largest axis, in no direction exceeded [m]."""
    # Matrix by matrix, so the last bit does not depend on the batch.
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., -1], 0.0)))


def rms_sigma(covariance: Array) -> Array:
    """Root mean square (...) of the standard deviations of the axes [m]."""
    trace = covariance[..., 0, 0] + covariance[..., 1, 1] + covariance[..., 2, 2]
    return np.asarray(np.sqrt(np.maximum(trace, 0.0) / 3.0))


def clearance_margin(covariance: Array, normal: Array, confidence: float) -> Array:
    r"""Distance by which an obstacle is inflated for the navigation error along one direction (section 3.2).

    ``margin = k sqrt(n^T Sigma n)``, ``k = sqrt(2) erfinv(confidence)``; as read, no formula is printed.

    Parameters
    ----------
    covariance : array, shape (..., 3, 3)
        Position covariance as navigation reports it [m^2].
    normal : array, shape (..., 3)
        Unit gradient of the distance, from the obstacle to the UAV.
    confidence : float
        Two-sided probability in (0, 1); 0.9974 gives k = 3.01.

    Returns
    -------
    array, shape (...)
        Margin [m].

    Raises
    ------
    ValueError
        If confidence is outside (0, 1), a shape does not fit, a number is not finite, a normal is no unit
        vector, or a covariance has a negative eigenvalue.
    """
    factor = confidence_factor(confidence)
    covariance = np.asarray(covariance, dtype=float)
    normal = np.asarray(normal, dtype=float)
    if covariance.shape[-2:] != (3, 3):
        raise ValueError(f"covariance has shape {covariance.shape}, must be (..., 3, 3)")
    if normal.shape[-1:] != (3,):
        raise ValueError(f"normal has shape {normal.shape}, must be (..., 3)")
    try:
        np.broadcast_shapes(covariance.shape[:-2], normal.shape[:-1])
    except ValueError as error:
        raise ValueError(
            f"covariance has shape {covariance.shape}, normal {normal.shape}: leading axes must broadcast"
        ) from error
    if not (np.isfinite(covariance).all() and np.isfinite(normal).all()):
        raise ValueError("covariance and normal must be finite")
    lengths = np.linalg.norm(normal, axis=-1)
    astray = np.abs(lengths - 1.0) > 1e-6
    if astray.any():
        raise ValueError(f"normal must be unit vectors, one has the length {lengths[astray][0]:.6g}")
    symmetric = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    lowest = float(np.linalg.eigvalsh(symmetric).min(initial=0.0))
    if lowest < -1e-9 * max(1.0, float(np.abs(covariance).max(initial=0.0))):
        raise ValueError(
            f"covariance has the negative eigenvalue {lowest:g}; it must be positive semidefinite"
        )
    return factor * directional_sigma(covariance, normal)


@dataclass(frozen=True)
class Inflation:
    """How k sigma enters the distance to an obstacle."""

    k: float
    """Inflation in sigmas; 0 is the fixed safety distance of the original APF."""
    mode: Literal["shift", "range"] = "shift"
    """Shift the distance (the obstacle grows), or only widen the range of influence rho_0."""
    reading: SigmaReading = "directional"
    """Which sigma."""
    budget: RiskBudget | None = None
    """What k is to be good for over a whole mission; None if it speaks of one moment."""
    safety: Safety = "k_sigma"
    """What the margin is made of."""

    def __post_init__(self) -> None:
        # A factor of NaN would make every comparison with rho_0 False: "no obstacle".
        if not (math.isfinite(self.k) and self.k >= 0.0):
            raise ValueError(f"k = {self.k!r} must be a finite number >= 0")
        for name, value, choices in (
            ("mode", self.mode, ("shift", "range")),
            ("reading", self.reading, get_args(SigmaReading)),
            ("safety", self.safety, get_args(Safety)),
        ):
            if value not in choices:
                raise ValueError(f"{name} = {value!r} must be one of {', '.join(choices)}")

    @classmethod
    def of_problem(cls, problem: Problem) -> Inflation:
        """Inflation as a problem asks for it: by k, by a confidence, or by a risk per mission."""
        planner = problem.planner
        if planner.risk_per_mission is not None:
            budget = RiskBudget.of_problem(problem)
            return cls(budget.k, planner.inflation, planner.sigma, budget, planner.safety)
        return cls.of_planner(planner)

    @classmethod
    def of_planner(cls, planner: Planner) -> Inflation:
        """Inflation as a planner section asks for it by k or by a confidence.

        Raises
        ------
        ValueError
            If it asks for a risk per mission, which depends on the whole problem.
        """
        if planner.risk_per_mission is not None:
            raise ValueError("planner.risk_per_mission needs the whole problem: use Inflation.of_problem")
        if planner.confidence is not None:
            k = confidence_factor(planner.confidence, 3 if planner.sigma == "chi2" else 1)
        else:
            k = DEFAULT_K if planner.k is None else planner.k
        return cls(k, planner.inflation, planner.sigma, safety=planner.safety)

    def informed(self, nav: NavSolution) -> NavSolution:
        r"""Solution whose covariance is such that k sigma is the margin that was asked for.

        A planner works with what this returns, so that obstacles, neighbours, guidance and the horizon
        follow one margin. ``k_sigma``: the solution itself. ``overbound``: D Sigma D, D the overbound's
        factors of the axes at k, and D L for what UAVs share. ``protection_level``: variances (PL / k)^2, so
        that k sigma is HPL towards every horizontal direction, VPL up and down, and
        sqrt((n_h HPL)^2 + (n_v VPL)^2) between, which is up to sqrt(2) less than what a cylinder of that
        radius and half height would reach; nothing counts as shared. Where there is no protection level,
        nothing bounds the error, and the solution does not count as available.

        Raises
        ------
        ProblemError
            If navigation does not tell what is asked for.
        """
        if self.safety == "k_sigma" or self.k == 0.0:
            return nav
        if self.safety == "overbound":
            if nav.overbound is None:
                raise ProblemError(
                    "planner.safety",
                    [
                        '"overbound" needs a log to be fitted to, which this navigation has not: use '
                        'navigation.kind = "recorded" with part = "first_half" or "second_half", or "k_sigma"'
                    ],
                )
            grown = np.ones(6)
            grown[:3] = nav.overbound.factors(self.k)
            return replace(
                nav,
                covariance=nav.covariance * grown[:, None] * grown,
                common_factor=nav.common_factor * grown[:3, None],
            )
        if nav.protection is None:
            raise ProblemError(
                "planner.safety",
                [
                    '"protection_level" is not computed by this navigation: use navigation.kind = "gnss" '
                    'with integrity = "araim", or "k_sigma"'
                ],
            )
        known = np.asarray((np.isfinite(nav.protection) & (nav.protection > 0.0)).all(-1))
        level = np.where(known[..., None], nav.protection, 1.0) / self.k
        covariance = np.zeros_like(nav.covariance)
        covariance[..., 3:, 3:] = nav.covariance[..., 3:, 3:]
        for axis, column in enumerate((0, 0, 1)):
            covariance[..., axis, axis] = level[..., column] ** 2
        return replace(
            nav,
            available=nav.available & known,
            covariance=covariance,
            common_factor=np.zeros_like(nav.common_factor),
            forecast=None,
        )

    def margin(self, covariance: Array, normal: Array) -> Array:
        """Inflation k sigma [m]: covariance (..., 3, 3) against normals (..., m, 3) gives (..., m)."""
        if self.reading in ("largest", "rms"):
            sigma = largest_sigma(covariance) if self.reading == "largest" else rms_sigma(covariance)
            return np.broadcast_to(self.k * sigma[..., None], normal.shape[:-1])
        return self.k * directional_sigma(covariance[..., None, :, :], normal)

    def largest_margin(self, covariance: Array) -> Array:
        """Bound (...) on the margin over all directions: k times the root of the covariance's trace [m]."""
        return self.k * math.sqrt(3.0) * rms_sigma(covariance)

    def margin_covariance(self, covariance: Array) -> Array:
        """Covariance (..., 3, 3) whose k sigma along any direction is the margin, in every reading."""
        if self.reading not in ("largest", "rms"):
            return covariance
        sigma = largest_sigma(covariance) if self.reading == "largest" else rms_sigma(covariance)
        return np.asarray((sigma**2)[..., None, None] * np.eye(3))

    def apply(self, distance: Array, margin: Array, influence_m: float) -> tuple[Array, Array]:
        """Distance and range that enter Eq. 23 and 28, each (...) [m]: (rho_eff, rho_0)."""
        if self.mode == "shift":
            return distance - margin, np.full_like(distance, influence_m)
        return distance, influence_m + margin
