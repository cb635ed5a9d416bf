"""The linear quadratic regulator at hover, and whether it stays stable when sampled and held (Eq. 10-13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_continuous_are

from napf_mpc.errors import ProblemError
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle.quadrotor import discretize, linearize, model_matrices

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LqrGain:
    """A regulator ``u = u_hover - K (chi - chi_ref)`` with what proves it."""

    gain: Array
    """(m, n) K = R^-1 B^T P; for the quadrotor (4, 12), rows thrust and torques, columns the state."""
    riccati: Array
    """(n, n) P, the positive semi-definite solution of the algebraic Riccati equation."""
    poles: NDArray[np.complex128]
    """(n,) eigenvalues of A - B K [1/s], slowest first; all have a negative real part."""


def lqr(a: ArrayLike, b: ArrayLike, q: ArrayLike, r: ArrayLike) -> LqrGain:
    """Solve the infinite-horizon LQR (Eq. 12, 13 as read: ``K = R^-1 B^T P``, the print lacks P).

    P solves ``A^T P + P A - P B R^-1 B^T P + Q = 0``. The solver accepts weights for which this means
    nothing (Q = -I gives a finite "solution"), so weights, residual and closed loop are checked here.

    Parameters
    ----------
    a, b : array, shapes (n, n) and (n, m)
        Continuous-time model.
    q : array, shape (n, n)
        State weight, symmetric, positive semi-definite.
    r : array, shape (m, m)
        Input weight, symmetric, positive definite.

    Returns
    -------
    LqrGain
        Gain, Riccati solution, closed-loop poles.

    Raises
    ------
    ProblemError
        Shapes do not fit, a number is not finite, a weight is not as above, or no stable regulator exists
        (for example because a state that drifts has no weight).
    """
    a, b = model_matrices(a, b, "lqr")
    n, m = b.shape
    q = _weight("q", q, n, strictly=False)
    r = _weight("r", r, m, strictly=True)
    unsolvable = (
        "no stable regulator is found for these weights: give each state that drifts a weight in q, "
        "and keep the weights within some orders of magnitude of each other"
    )
    try:
        p = np.asarray(solve_continuous_are(a, b, q, r), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ProblemError("lqr", [f"{unsolvable} ({error})"]) from error
    p = 0.5 * (p + p.T)
    k = np.asarray(np.linalg.solve(r, b.T @ p), dtype=np.float64)
    if not np.isfinite(k).all():
        raise ProblemError("lqr", [unsolvable])
    drift = a.T @ p
    cost = p @ b @ k
    residual = np.abs(drift + drift.T - cost + q).max()
    size = max(np.abs(drift).max(), np.abs(cost).max(), np.abs(q).max())
    poles = np.linalg.eigvals(a - b @ k).astype(np.complex128)
    poles = poles[np.lexsort((poles.imag, -poles.real))]
    if not residual <= 1e-6 * size or not poles.real.max() < 0.0:
        raise ProblemError(
            "lqr",
            [f"{unsolvable} (slowest pole {poles.real.max():.3g} 1/s, Riccati residual {residual:.3g})"],
        )
    return LqrGain(gain=k, riccati=p, poles=poles)


def _weight(name: str, weight: ArrayLike, size: int, *, strictly: bool) -> Array:
    w = np.asarray(weight, dtype=np.float64)
    if w.shape != (size, size) or not np.isfinite(w).all():
        raise ProblemError("lqr", [f"{name} must be finite with shape ({size}, {size}), got shape {w.shape}"])
    scale = np.abs(w).max()
    if np.abs(w - w.T).max() > 1e-12 * scale:
        raise ProblemError("lqr", [f"{name} must be symmetric"])
    smallest = np.linalg.eigvalsh(w).min()
    if strictly and not smallest > 0.0:
        raise ProblemError("lqr", [f"{name} must be positive definite, its least eigenvalue is {smallest:g}"])
    if smallest < -1e-12 * scale:
        raise ProblemError("lqr", [f"{name} must be positive semi-definite, least eigenvalue {smallest:g}"])
    return w


def hover_gain(vehicle: Vehicle) -> LqrGain:
    """Return the LQR of a vehicle at hover and yaw zero with its own Q and R (Eq. 12, 13).

    With the paper's vehicle: ``K[thrust, z] = 1``, ``K[roll torque, y] = -0.1``,
    ``K[pitch torque, x] = 0.0316``, slowest poles -0.87 +/- 0.5j and -1, fastest -12.3 1/s.

    Raises
    ------
    ProblemError
        The vehicle's weights give no stable regulator.
    """
    try:
        return lqr(*linearize(vehicle), np.diag(vehicle.lqr_q_diagonal), np.diag(vehicle.lqr_r_diagonal))
    except ProblemError as error:
        raise ProblemError("vehicle.lqr_q_diagonal, vehicle.lqr_r_diagonal", error.problems) from error


def sampled_spectral_radius(vehicle: Vehicle, gain: LqrGain, period_s: float) -> float:
    """Return the spectral radius of the hover loop whose input is computed each period and held between.

    Parameters
    ----------
    vehicle : Vehicle
        The vehicle, linearised at hover.
    gain : LqrGain
        Its regulator.
    period_s : float
        Sampling period [s], positive.

    Returns
    -------
    float
        Largest absolute eigenvalue of ``Ad - Bd K`` with the exact zero-order hold; stable below 1.
    """
    ad, bd = discretize(*linearize(vehicle), period_s)
    return float(np.abs(np.linalg.eigvals(ad - bd @ gain.gain)).max())


def check_sampled_loop(vehicle: Vehicle, period_s: float) -> None:
    """Refuse a controller rate at which the vehicle's LQR, sampled and held, is unstable.

    Parameters
    ----------
    vehicle : Vehicle
        The vehicle.
    period_s : float
        Period of the inner loop [s].

    Raises
    ------
    ProblemError
        Naming ``simulation.controller_rate_hz`` and a rate that works, or the weights if none does.
    """
    gain = hover_gain(vehicle)
    radius = sampled_spectral_radius(vehicle, gain, period_s)
    if radius < 1.0:
        return
    way_out = "soften the LQR: smaller vehicle.lqr_q_diagonal or larger vehicle.lqr_r_diagonal"
    for rate_hz in (10, 20, 25, 50, 100, 200, 250, 500, 1000):
        if rate_hz * period_s > 1.0 and sampled_spectral_radius(vehicle, gain, 1.0 / rate_hz) < 1.0:
            way_out = f"use {rate_hz} or more, with simulation.step_s at most {1.0 / rate_hz:g}"
            break
    raise ProblemError(
        "simulation.controller_rate_hz",
        [
            f"{1.0 / period_s:g} is too slow: the LQR sampled and held at this rate is unstable "
            f"(spectral radius {radius:.3g}, must be < 1); {way_out}"
        ],
    )
