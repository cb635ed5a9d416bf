r"""When a correlated error first passes a level: from the chance at one moment to the chance of a mission.

The error of one axis in units of its sigma is a stationary Gauss-Markov (Ornstein-Uhlenbeck) process g of
unit variance and correlation time tau, seen every ``period`` seconds. With rho = exp(-period / tau) and
s^2 = 1 - rho^2, the chance q_n(x) that it passes a level k within n further samples of being at x <= k is

    q_0 = 0,   q_n(x) = Phi((rho x - k) / s) + \int_{-\infty}^{k} phi((y - rho x) / s) / s q_(n-1)(y) dy,

and the chance of a mission of n samples is Phi(-k) + \int_{-\infty}^{k} phi(x) q_(n-1)(x) dx. Integrals are
taken at Gauss-Legendre nodes (Nystrom's method); all terms are positive, so that small chances keep their
digits. Seen at all times, q follows the backward equation tau q_t = q_xx - x q_x; its eigenfunctions are
found by Galerkin's method. No simulation is involved.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, special

__all__ = ["first_passage_probability", "long_run", "mission_k"]

Array = NDArray[np.float64]

_TAIL = 9.0  # A normal law has 1e-19 beyond so many sigmas.
_MOST_NODES = 1000  # For more, samples are so dense that the corrected process seen at all times is as exact.
_SMALL_STEP = 0.1  # For the long run the correction is then good to 2 %, on the careful side.
_MODES = 64
_CORRECTION = 0.5825971579390106
"""-zeta(1/2) / sqrt(2 pi): how far a level seen at intervals lies in effect above one seen at all times, in
standard deviations of a step (Chernoff 1965; Siegmund 1985, "Sequential Analysis")."""


def first_passage_probability(
    k: float, duration_s: float, correlation_time_s: float, period_s: float
) -> float:
    """Chance that a unit Gauss-Markov process exceeds a level at some time, the start included.

    One-sided: errors towards the obstacle count.

    Parameters
    ----------
    k : float
        Level in sigmas.
    duration_s : float
        Time for which the level counts [s], >= 0. It holds ceil(duration / period) samples, at least one.
    correlation_time_s : float
        Correlation time tau [s], >= 0: 0 is white, infinity a constant.
    period_s : float
        Time between two samples [s], >= 0; 0 for a process seen at all times.

    Returns
    -------
    float
        Probability, to a relative 1e-4 or better where it is 1e-9 or more.

    Raises
    ------
    ValueError
        If a number is out of range, or the process is white and seen at all times.
    """
    _check(duration_s, correlation_time_s, period_s)
    if not math.isfinite(k):
        raise ValueError(f"k = {k!r} must be finite")
    return _probability(float(k), float(duration_s), float(correlation_time_s), float(period_s))


@lru_cache(maxsize=4096)
def mission_k(risk: float, duration_s: float, correlation_time_s: float, period_s: float) -> float:
    """Level that a unit Gauss-Markov process exceeds at some time with a given probability.

    The inverse of :func:`first_passage_probability`, to 1e-8.

    Parameters
    ----------
    risk : float
        Probability in (0, 1).
    duration_s, correlation_time_s, period_s : float
        As in :func:`first_passage_probability`.

    Returns
    -------
    float
        k; 0 where a level of zero is exceeded less often than asked for.

    Raises
    ------
    ValueError
        If a number is out of range, or the process is white and seen at all times.
    """
    _check(duration_s, correlation_time_s, period_s)
    if not 0.0 < risk < 1.0:
        raise ValueError(f"risk = {risk!r} must be > 0 and < 1")

    def excess(k: float) -> float:
        probability = first_passage_probability(k, duration_s, correlation_time_s, period_s)
        return math.log(probability) - math.log(risk)

    low = max(0.0, -float(special.ndtri(risk)))  # One moment of the mission alone.
    if excess(low) <= 0.0:
        return low
    high = low + 1.0
    while excess(high) > 0.0:
        low, high = high, high + 1.0
    return float(optimize.brentq(excess, low, high, xtol=1e-8))


@lru_cache(maxsize=8192)
def long_run(k: float, correlation_time_s: float, period_s: float) -> tuple[float, float]:
    r"""Chance of passing a level in the form "once for being there, and so much a second".

    The process is reversible, so that the chance of not passing in n samples is
    sum_i c_i^2 mu_i^(n-1) with all mu_i >= 0. Its first term alone bounds it from below, hence

        P(n samples) <= 1 - exp(-entry - rate n period),   rate = -log(mu_0) / period,
        entry = -log(c_0^2 / mu_0),

    an equality in the long run. White noise has no entry, a constant no rate.

    Parameters
    ----------
    k : float
        Level in sigmas.
    correlation_time_s, period_s : float
        As in :func:`first_passage_probability`.

    Returns
    -------
    entry : float
        -log of a probability; up to 2 % too much, never too little.
    rate : float
        [1/s]; to 0.3 %.
    """
    _check(0.0, correlation_time_s, period_s)
    if not math.isfinite(k):
        raise ValueError(f"k = {k!r} must be finite")
    if math.isinf(correlation_time_s):
        return -float(special.log_ndtr(k)), 0.0
    if correlation_time_s == 0.0:
        return 0.0, -float(special.log_ndtr(k)) / period_s
    step = _step(correlation_time_s, period_s)
    low = -_TAIL + min(k, 0.0)
    if period_s > 0.0 and step > _SMALL_STEP:
        x, w, kernel = _kernel(low, k, math.exp(-period_s / correlation_time_s), step)
        # Similar to a symmetric matrix, since the process is reversible.
        root = np.sqrt(w * _density(x))
        symmetric = kernel * (root[:, None] / root[None, :])
        values, vectors = linalg.eigh(
            0.5 * (symmetric + symmetric.T), subset_by_index=[len(x) - 1, len(x) - 1]
        )
        mu, share = float(values[0]), float((vectors[:, 0] * root).sum()) ** 2
        return math.log(mu) - math.log(share), -math.log(mu) / period_s
    values, shares = _modes(low, k + _CORRECTION * step)
    return -math.log(shares[0]), float(values[0]) / correlation_time_s


def _check(duration_s: float, correlation_time_s: float, period_s: float) -> None:
    for name, value in (("duration_s", duration_s), ("period_s", period_s)):
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} = {value!r} must be a finite number >= 0")
    if not correlation_time_s >= 0.0:
        raise ValueError(f"correlation_time_s = {correlation_time_s!r} must be a number >= 0")
    if correlation_time_s == 0.0 and period_s == 0.0:
        raise ValueError("white noise seen at all times exceeds every level: give a period_s > 0")


def _samples(duration_s: float, period_s: float) -> int:
    return max(1, math.ceil(duration_s / period_s - 1e-9))


def _step(correlation_time_s: float, period_s: float) -> float:
    """Standard deviation s of what is new in a sample."""
    return math.sqrt(-math.expm1(-2.0 * period_s / correlation_time_s))


def _density(x: Array) -> Array:
    return np.asarray(np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi))


@lru_cache(maxsize=4096)
def _probability(k: float, duration_s: float, correlation_time_s: float, period_s: float) -> float:
    once = float(special.ndtr(-k))
    travel = 0.0 if math.isinf(correlation_time_s) else 1.0
    if correlation_time_s > 0.0:
        travel = math.sqrt(-math.expm1(-2.0 * duration_s / correlation_time_s))
    if travel == 0.0:
        return once
    if period_s > 0.0:
        samples = _samples(duration_s, period_s)
        if samples == 1:
            return once
        if correlation_time_s == 0.0:
            return -math.expm1(samples * float(special.log_ndtr(k)))
        step = _step(correlation_time_s, period_s)
        low = _lowest(k, _step(correlation_time_s, samples * period_s))
        if _nodes_needed(k - low, step) <= _MOST_NODES:
            x, w, kernel = _kernel(low, k, math.exp(-period_s / correlation_time_s), step)
            first = special.ndtr((math.exp(-period_s / correlation_time_s) * x - k) / step)
            later = float((w * _density(x) * _accumulated(kernel, first, samples - 1)).sum())
            return min(once + later, 1.0)
        level = k + _CORRECTION * step
    else:
        level = k
    low = _lowest(level, travel)
    values, shares = _modes(low, level)
    below = float(special.ndtr(level) - special.ndtr(low))
    passed = below - float((shares * np.exp(-values * duration_s / correlation_time_s)).sum())
    # Samples are fewer than all times: the start counts at the level itself.
    return min(max(once, float(special.ndtr(-level)) + passed), 1.0)


def _lowest(k: float, travel: float) -> float:
    """Start from which a level is out of reach: far out in the stationary law, or too far for this travel.

    Travel is the standard deviation of the change over the whole time. The mean returns to zero meanwhile,
    which for a level below zero takes it nearer; three more sigmas cover that.
    """
    return max(-_TAIL + min(k, 0.0), k - (_TAIL + 3.0) * travel)


def _nodes_needed(width: float, step: float) -> int:
    return 24 + math.ceil(1.4 * width / step)


def _kernel(low: float, k: float, rho: float, step: float) -> tuple[Array, Array, Array]:
    """Nodes, weights, and weighted density of the next sample at the nodes (to) from the nodes (from)."""
    nodes, weights = np.polynomial.legendre.leggauss(_nodes_needed(k - low, step))
    x = low + 0.5 * (k - low) * (1.0 + nodes)
    w = 0.5 * (k - low) * weights
    return x, w, _density((x[None, :] - rho * x[:, None]) / step) / step * w[None, :]


def _accumulated(kernel: Array, first: Array, count: int) -> Array:
    """Sum of kernel^i first over i < count, by doubling."""
    total = np.zeros_like(first)
    power, chunk = kernel, first
    while count:
        if count & 1:
            total = chunk + power @ total
        count >>= 1
        if count:
            chunk = chunk + power @ chunk
            power = power @ power
    return np.asarray(total)


@lru_cache(maxsize=1)
def _legendre() -> tuple[Array, Array, Array, Array]:
    """Nodes, weights, and at the nodes (node, mode) P_j - P_(j-1), zero at the right end, and its slope."""
    legendre = np.polynomial.legendre
    nodes, weights = legendre.leggauss(_MODES + 64)
    values = legendre.legvander(nodes, _MODES)
    slopes = np.stack([legendre.legval(nodes, legendre.legder(row)) for row in np.eye(_MODES + 1)], axis=1)
    return nodes, weights, values[:, 1:] - values[:, :-1], slopes[:, 1:] - slopes[:, :-1]


def _modes(low: float, k: float) -> tuple[Array, Array]:
    """Decay rates times tau and shares c_i^2 of the modes between a reflecting and an absorbing end.

    With u = psi / sqrt(phi) the backward equation is symmetric: the form is the integral of
    (psi' + x psi / 2) (chi' + x chi / 2), in Legendre polynomials that vanish at the level.
    """
    nodes, weights, basis, derivative = _legendre()
    half = 0.5 * (k - low)
    x, w = low + half * (1.0 + nodes), half * weights
    slope = derivative / half + 0.5 * x[:, None] * basis
    form = (slope * w[:, None]).T @ slope
    mass = (basis * w[:, None]).T @ basis
    rates, vectors = linalg.eigh(form, mass)
    shares = ((w * np.sqrt(_density(x))) @ basis @ vectors) ** 2
    return np.asarray(np.maximum(rates, 0.0)), np.asarray(shares)
