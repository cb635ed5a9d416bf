"""Sigmas of measurements, remembered: what to leave room for when nothing says how sigma goes on.

A filter foretells its covariance; raw measurements do not. Their sigma is that of this moment, and what lies
ahead of a formation is passed ten or twenty seconds later. Who leaves room for the sigma of now plans through
narrow gaps whenever it happens to be small, and is between the obstacles when it is large again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.vehicle.plant import plain

Array = NDArray[np.float64]


class SigmaMemory:
    """Sigma of each axis, at least as large as its mean over the recent past.

    The mean fades exponentially. Unlike a largest value, and unlike a mean of variances, it soon forgets a
    single wild report.

    Parameters
    ----------
    runs, uavs : int
        Formations side by side, and UAVs of each.
    time_constant_s : float
        In which what was reported is forgotten; 0 remembers nothing [s].
    """

    def __init__(self, runs: int, uavs: int, time_constant_s: float) -> None:
        self._time_constant_s = time_constant_s
        self._mean: Array = np.full((runs, uavs, 3), np.nan)

    def raised(self, covariance: Array, elapsed_s: float) -> Array:
        """Covariance (run, uav, 3, 3) with no axis' sigma below its remembered mean; correlations stay [m^2].

        An axis that is reported as known exactly is left so.

        Parameters
        ----------
        covariance : array, shape (run, uav, 3, 3)
            As reported now [m^2].
        elapsed_s : float
            Since the last call [s].
        """
        out = np.empty_like(covariance)
        tau = self._time_constant_s
        part = -math.expm1(-elapsed_s / tau) if tau > 0.0 else 1.0
        _raise(plain(covariance), part, self._mean, out)
        return out


@compiled
def _raise(covariance: Array, part: float, mean: Array, out: Array) -> None:
    grown = np.empty(3)
    for run in range(covariance.shape[0]):
        for uav in range(covariance.shape[1]):
            now, kept = covariance[run, uav], mean[run, uav]
            for a in range(3):
                sigma = math.sqrt(now[a, a])
                kept[a] = sigma if math.isnan(kept[a]) else kept[a] + part * (sigma - kept[a])
                grown[a] = kept[a] / sigma if kept[a] > sigma > 0.0 else 1.0
            for a in range(3):
                for b in range(3):
                    out[run, uav, a, b] = grown[a] * grown[b] * now[a, b]
