r"""Monitor for fixes with heavy tails: the evidence that reported sigmas are too small, and by how much.

The median of the last few innovations (:mod:`.monitor`) says nothing where a reflection lasts for seconds.
The point-mass filter's law says what a fix is worth as evidence: with the scale :math:`s\sigma` instead of
:math:`\sigma`, a fix that is off the estimate by d, of variance P, adds

.. math:: \Delta_s = w \left[\ln t_\nu(d;\ \sqrt{s^2 \sigma^2 + P})
          - \ln t_\nu(d;\ \sqrt{\sigma^2 + P})\right]

to the logarithm of the odds of s against 1, with :math:`t_\nu` the Student law's density of that scale and w
what the fix is worth beside the one before (:mod:`.point_mass`). Evidence of all axes that the receiver
measures is taken together: one that believes too much does so on all of them. Below none it does not fall, so
that an over-confidence is seen whenever it begins (E. S. Page, "Continuous inspection schemes", Biometrika
41, 1954). Receivers of a formation are of one kind: what all of them but any one say together counts for
each, so a fault of one alone is told of that one only. With :data:`ALARM` for any scale, sigmas are taken as
too small by the likeliest one; they are taken as reported again when less than half of that is left.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.monitor import Monitor

__all__ = ["ALARM", "SCALES", "ScaleEvidence"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SCALES: Array = np.exp2(0.5 * np.arange(1, 11))
"""(10,) factors on sigma that are thought of: 1.4 to 32."""
ALARM = 9.0
"""Log-odds at which an alarm is raised."""


class ScaleEvidence(Monitor):
    """Evidence on the sigmas of all UAVs of a block of runs.

    Parameters
    ----------
    degrees : float
        nu, degrees of freedom of the Student law.
    axes : array of bool, shape (3,)
        Which axes the receiver measures; those of another sensor are left alone.
    runs, uavs : int
        How many.
    """

    def __init__(self, degrees: float, axes: Mask, runs: int, uavs: int) -> None:
        super().__init__(runs, uavs)
        self._degrees, self._axes = degrees, axes
        self._odds = np.zeros((runs, uavs, len(SCALES)))
        self._without = np.zeros((runs, uavs, len(SCALES)))

    def observe(self, off: Array, variance: Array, sigma: Array, weight: Array, time_s: float) -> Array:
        """Take in one epoch and return by how much each scale changes.

        Parameters
        ----------
        off : array, shape (run, uav, 3)
            Fix less estimate before it [m]; NaN for none, or for an axis that is not watched.
        variance : array, shape (run, uav, 3)
            Of the estimate [m^2].
        sigma : array, shape (run, uav, 3)
            As the fix reports it [m].
        weight : array, shape (run, uav, 3)
            What the fix is worth, 0 to 1.
        time_s : float
            Time of the epoch [s].

        Returns
        -------
        array, shape (run, uav, 3)
            Factor on :attr:`~napf_mpc.navigation.monitor.Monitor.scale`, already in it.
        """
        # An unknown sigma is no statement that a fix could contradict.
        told = np.where((sigma > 0.0) & (sigma < np.inf) & self._axes, sigma, np.nan)[..., None]
        says = self._log_density(off, variance, told * SCALES) - self._log_density(off, variance, told)
        said = np.where(np.isfinite(says), weight[..., None] * says, 0.0)
        own = said[:, :, 0] + said[:, :, 1] + said[:, :, 2]
        self._odds = _weighed(self._odds + own)
        self._without = _weighed(self._without + own.sum(axis=1, keepdims=True) - own)
        odds = np.maximum(self._odds, self._without.min(axis=1, keepdims=True))
        best, before = odds.max(axis=-1), self.scale.max(axis=-1)
        wanted = SCALES[odds.argmax(axis=-1)] ** 2
        # A step of SCALES down and up again is no news.
        wanted = np.where((wanted < before) & (wanted > before / 4.0), before, wanted)
        scale = np.where(best >= np.where(before > 1.0, 0.5 * ALARM, ALARM), wanted, 1.0)
        after = np.where(self._axes, scale[..., None], 1.0)
        change, self.scale = after / self.scale, after
        for at in np.argwhere(change > 1.0).tolist():
            self._alarm(tuple(at), float(after[tuple(at)]), time_s)
        return np.asarray(change)

    def _log_density(self, off: Array, variance: Array, scale: Array) -> Array:
        """Logarithms (run, uav, 3, n) of the Student law's density but for a constant, at scales (..., n)."""
        square = scale**2 + variance[..., None]
        with np.errstate(invalid="ignore", divide="ignore"):
            tail = np.log1p(off[..., None] ** 2 / (self._degrees * square))
            return np.asarray(-0.5 * (np.log(square) + (self._degrees + 1.0) * tail))


def _weighed(odds: Array) -> Array:
    """Keep log-odds (..., scale) from none to what an alarm takes twice.

    Were more kept, an honest sigma would be long in being believed again.
    """
    return np.asarray(np.maximum(odds - np.maximum(odds.max(axis=-1, keepdims=True) - 2.0 * ALARM, 0.0), 0.0))
