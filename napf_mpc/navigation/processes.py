"""Error processes as maps from standard-normal and uniform arrays; nothing in here is random.

A campaign feeds them with its random streams; a rare-event method may feed them with anything else. Each
series is computed on its own, in time order: the first n samples of a longer series are the same bits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["gauss_markov", "has_fix", "last_fix", "mixed", "outage_starts", "swinging_sigma"]

Array = NDArray[np.float64]


def gauss_markov(z: Array, period_s: float, correlation_time_s: float) -> Array:
    """First-order Gauss-Markov process of unit variance, exactly discretised.

    g_0 = z_0, g_k = phi g_(k-1) + sqrt(1 - phi^2) z_k with phi = exp(-period / correlation time): the
    process is stationary from its first sample, and its correlation at a lag of n periods is phi^n.

    Parameters
    ----------
    z : array, shape (..., epoch)
        Standard-normal numbers.
    period_s : float
        Time between two samples [s], > 0.
    correlation_time_s : float
        Correlation time [s], >= 0; 0 is white noise, infinity a constant.

    Returns
    -------
    array, shape (..., epoch)
        Stored with time first, whatever the layout of ``z``.

    Raises
    ------
    ValueError
        A number is out of range or not finite.
    """
    if not (math.isfinite(period_s) and period_s > 0.0):
        raise ValueError(f"period_s = {period_s!r} must be a finite number > 0")
    if not correlation_time_s >= 0.0:
        raise ValueError(f"correlation_time_s = {correlation_time_s!r} must be a number >= 0")
    _require_finite("z", z)
    g = np.moveaxis(z, -1, 0).astype(np.float64, order="C", copy=True)
    if correlation_time_s > 0.0:
        lag = period_s / correlation_time_s
        phi = math.exp(-lag)
        g[1:] *= math.sqrt(-math.expm1(-2.0 * lag))  # exact where 1 - phi^2 would lose its digits
        for k in range(1, len(g)):
            g[k] += phi * g[k - 1]
    return np.moveaxis(g, 0, -1)


def swinging_sigma(
    time_s: ArrayLike, low_m: float, high_m: float, period_s: float, phase: ArrayLike
) -> Array:
    """Sigma that swings between two bounds: mean + amplitude sin(2 pi t / period + phase).

    Parameters
    ----------
    time_s : array_like
        Time [s]; broadcasts with ``phase``.
    low_m, high_m : float
        Bounds of sigma [m].
    period_s : float
        Period of the swing [s].
    phase : array_like
        Phase of each UAV and axis [rad].
    """
    mean, amplitude = 0.5 * (high_m + low_m), 0.5 * (high_m - low_m)
    angle = np.asarray(time_s) * (2.0 * math.pi / period_s) + np.asarray(phase)
    return np.asarray(mean + amplitude * np.sin(angle))


def mixed(own: Array, common: Array, share: float) -> Array:
    """Unit processes with a share in common: g_i = sqrt(c) g_common + sqrt(1 - c) g_i,own.

    Two UAVs then correlate by c, and each process keeps its unit variance.

    Parameters
    ----------
    own, common : array
        Shapes that broadcast, for example (run, uav, 3, epoch) and (run, 1, 3, epoch).
    share : float
        c, the share of the variance that all have in common, 0 to 1.
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share = {share!r} must be a number from 0 to 1")
    if share == 0.0:
        return own
    return math.sqrt(share) * common + math.sqrt(1.0 - share) * own


def outage_starts(u: Array, interval_s: float, duration_s: float) -> Array:
    """Start of each outage: exponential times with fixes, each followed by an outage of fixed length.

    Parameters
    ----------
    u : array, shape (..., count)
        Uniform numbers on [0, 1), one for each time with fixes.
    interval_s : float
        Mean time from the end of an outage to the start of the next [s].
    duration_s : float
        Length of an outage [s].

    Returns
    -------
    array, shape (..., count)
        Starts, ascending [s]. In the long run the share of outages is duration / (interval + duration).
    """
    if not (np.all(u >= 0.0) and np.all(u < 1.0)):
        raise ValueError("u must hold numbers on [0, 1)")
    gaps = -interval_s * np.log1p(-u)
    return np.cumsum(gaps + duration_s, axis=-1) - duration_s


def has_fix(starts_s: Array, duration_s: float, time_s: Array) -> NDArray[np.bool_]:
    """Whether there is a fix at each time.

    Parameters
    ----------
    starts_s : array, shape (..., count)
        Starts of the outages, ascending [s].
    duration_s : float
        Length of an outage [s].
    time_s : array, shape (epoch,)
        Times [s].

    Returns
    -------
    bool array, shape (epoch, ...)
        False from a start (inclusive) to its end (exclusive).
    """
    series = starts_s.reshape(-1, starts_s.shape[-1])
    out = np.ones((len(time_s), len(series)), dtype=np.bool_)
    for i, starts in enumerate(series):
        before = np.searchsorted(starts, time_s, side="right") - 1
        out[:, i] = (before < 0) | (time_s >= starts[before] + duration_s)
    return out.reshape(len(time_s), *starts_s.shape[:-1])


def last_fix(available: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Index of the last fix at or before each epoch; 0 where there was none yet (what one starts with).

    Parameters
    ----------
    available : bool array, shape (epoch, ...)
        Whether there is a fix.
    """
    index = np.arange(len(available), dtype=np.int32).reshape(-1, *(1,) * (available.ndim - 1))
    return np.maximum.accumulate(np.where(available, index, np.int32(0)), axis=0)


def _require_finite(name: str, values: Array) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds numbers that are not finite")
