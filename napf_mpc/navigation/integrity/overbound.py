r"""Gaussian overbounds of measured errors: how much a reported sigma has to grow until it is a bound.

A pair of normal laws, one shifted to each side, bounds the errors' law from both sides (paired overbounding:
J. Rife, S. Pullen, P. Enge, B. Pervan, "Paired overbounding for nonideal LAAS and WAAS error distributions",
IEEE Trans. AES 42(4), 2006; for samples see J. Blanch, T. Walter, P. Enge, "Gaussian bounds of sample
distributions for integrity analysis", IEEE Trans. AES 55(4), 2019). In units of the reported sigma, with the
shift b >= 0 and the width s,

.. math:: P(z \ge x) \le \bar\Phi\!\left(\frac{x - b}{s}\right), \qquad
          P(z \le -x) \le \bar\Phi\!\left(\frac{x - b}{s}\right).

As read: the inequalities are asked for beyond the sample's quartiles, where a safety distance is; the core
is left alone, where the papers ask for them too so that sums of errors stay bounded.

A sample cannot say more than it holds: the deepest tail that n independent errors tell of is 1 / n, and the
errors of a log are correlated in time. :func:`effective_sample_size` counts what they are worth, and
:attr:`AxisOverbound.supported_k` says up to where the bound speaks of what was seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from napf_mpc.errors import DataError
from napf_mpc.navigation.recorded import ErrorLog, sample_period

__all__ = ["AxisOverbound", "Overbound", "effective_sample_size", "fit_overbound", "paired_overbound"]

Array = NDArray[np.float64]

_TAIL = 0.25  # errors inside the quartiles are nothing that a safety distance of a sigma or more meets
_WINDOW = 5.0  # correlation times, 1/2 + sum
_MOST_PERIODS = 10_000_000
MIN_FIXES = 20
"""Fewer fixes make no overbound, ..."""
MIN_EFFECTIVE = 5.0
"""... and neither do fewer effective ones."""


@dataclass(frozen=True)
class AxisOverbound:
    """Pair of normal laws that bounds the errors of one axis, in reported sigmas."""

    bias: float
    """Shift b of the two laws to either side, >= 0."""
    sigma: float
    """Width s."""
    n: int
    """Errors that it was fitted to."""
    effective_n: float
    """What they are worth as independent ones."""

    @property
    def supported_k(self) -> float:
        """Largest k at which the sample still says something: one-sided tail 1 / effective_n."""
        return -float(special.ndtri(min(0.5, 1.0 / self.effective_n)))

    def factor(self, k: float) -> float:
        """Factor on the reported sigma for which k sigma is b + k s; never below 1.

        A bulk that is overstated would allow less, but no log is to be trusted more than the receiver.
        """
        return max(1.0, self.sigma + self.bias / k) if k > 0.0 else 1.0


@dataclass(frozen=True)
class Overbound:
    """Overbounds of the three axes, east, north, up, and where they come from."""

    axes: tuple[AxisOverbound, AxisOverbound, AxisOverbound]
    """East, north, up."""
    source: str
    """Log that they were fitted to."""

    def factors(self, k: float) -> Array:
        """Factors (3,) on the reported sigmas."""
        return np.array([axis.factor(k) for axis in self.axes])


def effective_sample_size(time_s: Array, values: Array, period_s: float) -> float:
    r"""Independent samples that correlated ones are worth: n / (1 + 2 sum of correlations).

    .. math:: n_{eff} = \frac{n}{1 + 2 \sum_{l \ge 1} (m_l / n)\, r_l}

    with :math:`r_l` the correlation over the :math:`m_l` pairs that lie l periods apart, gaps left out. The
    sum ends where a correlation is not positive, or where l is five times the sum's own correlation time
    (A. Sokal, "Monte Carlo methods in statistical mechanics", 1997): beyond, there is only noise to add.

    Parameters
    ----------
    time_s, values : array, shape (n,)
        Times on an even grid with gaps [s], ascending, and the series.
    period_s : float
        Period of the grid [s].

    Returns
    -------
    float
        From 1 to n; n for a series that does not vary.

    Raises
    ------
    ValueError
        If the shapes differ or are not (n,) with n >= 1, a value is not finite, times do not ascend or span
        more than ten million periods, or the period is not a finite number > 0.
    """
    time_s, values = np.asarray(time_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
    n = len(values) if values.ndim == 1 else 0
    if n < 1 or time_s.shape != (n,):
        raise ValueError(
            f"time_s has shape {time_s.shape}, values {values.shape}: both must be (n,) with n >= 1"
        )
    if not (math.isfinite(period_s) and period_s > 0.0):
        raise ValueError(f"period_s = {period_s!r} must be a finite number > 0")
    if not np.isfinite(values).all():
        raise ValueError("values must be finite; leave out what is not, times are a grid with gaps")
    if not (np.isfinite(time_s).all() and (np.diff(time_s) > 0.0).all()):
        raise ValueError("time_s must ascend and be finite; sort the series by time")
    span = (time_s[-1] - time_s[0]) / period_s
    if not span <= _MOST_PERIODS:
        raise ValueError(
            f"time_s spans {span:.6g} periods, at most {_MOST_PERIODS:.6g} are looked at; cut the series at "
            "its longest gap"
        )
    slots = np.round((time_s - time_s[0]) / period_s).astype(np.int64)
    away = values - math.fsum(values.tolist()) / n
    variance = float((away**2).mean())
    if variance <= 0.0 or n < 2:
        return float(n)
    line = np.zeros(int(slots[-1]) + 1)
    here = np.zeros(len(line))
    line[slots], here[slots] = away, 1.0
    total = 0.0
    for lag in range(1, len(line)):
        if lag > _WINDOW * (0.5 + total):
            break
        pairs = float((here[lag:] * here[:-lag]).sum())
        if pairs == 0.0:
            continue
        correlation = float((line[lag:] * line[:-lag]).sum()) / pairs / variance
        if correlation <= 0.0:
            break
        total += pairs / n * correlation
    return float(min(n, max(1.0, n / (1.0 + 2.0 * total))))


def paired_overbound(normalised: Array, effective_n: float | None = None) -> AxisOverbound:
    r"""Fit a pair of normal laws that bounds a sample on both sides.

    The shift is the sample's median, the width the least one with which no error beyond the quartiles is
    outside. An error counts with the share of the sample that is at least as far out, or with
    1 / ``effective_n`` where that is more: a few large errors in a row are one event, and the largest is
    bounded too.

    Parameters
    ----------
    normalised : array, shape (n,)
        Errors over their reported sigmas.
    effective_n : float, optional
        What they are worth as independent ones; by default n.

    Raises
    ------
    ValueError
        Fewer than 20 values, or one that is not finite, or fewer than 5 effective ones.
    """
    z = np.sort(np.asarray(normalised, dtype=np.float64))
    n = len(z)
    if n < MIN_FIXES or not np.isfinite(z).all():
        raise ValueError(f"normalised must be {MIN_FIXES} or more finite numbers, got {n}")
    worth = float(n) if effective_n is None else effective_n
    if not worth >= MIN_EFFECTIVE:
        raise ValueError(
            f"effective_n = {worth:.3g} must be >= {MIN_EFFECTIVE:g}: the sample says too little"
        )
    bias = abs(float(np.median(z)))
    outside = np.arange(n, 0, -1) / n
    tail = outside <= _TAIL
    quantile = -special.ndtri(np.maximum(outside[tail], 1.0 / worth))
    sides = np.stack([z[tail], -z[::-1][tail]])
    sigma = float(np.maximum((sides - bias) / quantile, 0.0).max())
    return AxisOverbound(bias, sigma, n, worth)


def fit_overbound(log: ErrorLog) -> Overbound:
    """Overbound of a log's errors over their reported sigmas, axis by axis.

    Parameters
    ----------
    log : ErrorLog
        Not the one that is reported on: a bound that is fitted to what it is judged by always holds.

    Raises
    ------
    DataError
        Too few fixes, or too few effective ones.
    """
    fixes = log.available
    if (count := int(fixes.sum())) < MIN_FIXES:
        raise DataError(f"{log.source}: {count} fixes, at least {MIN_FIXES} are needed for an overbound")
    sigma = np.sqrt(np.einsum("nii->ni", log.covariance[fixes]))
    normalised, times = log.error[fixes] / sigma, log.time_s[fixes]
    period_s = sample_period(log.time_s)
    try:
        east, north, up = (
            paired_overbound(z, effective_sample_size(times, z, period_s)) for z in normalised.T
        )
    except ValueError as error:
        raise DataError(f"{log.source}: no overbound: {error}") from error
    return Overbound((east, north, up), log.source)
