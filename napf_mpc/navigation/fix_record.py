"""What becomes of fixes: who has begun, whose are in use, how many were refused, when new ones come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.kalman import BEGUN, OUTVOTED, REFUSED, USED

__all__ = ["GATE_PATIENCE_S", "FixRecord"]

Mask = NDArray[np.bool_]

GATE_PATIENCE_S = 3.0
"""Time of refused fixes without one used in between [s], after which the next starts the filter anew; with
the Kalman filter's monitor, after which they are in doubt."""


class FixRecord:
    """Record of the fixes of all UAVs of a block of runs, whatever filter takes them in.

    Parameters
    ----------
    runs, uavs : int
        How many.
    epoch_s : float
        Time between two epochs of fixes [s].
    """

    def __init__(self, runs: int, uavs: int, epoch_s: float) -> None:
        self.begun: Mask = np.zeros((runs, uavs), dtype=np.bool_)
        """(run, uav) whose filter has begun."""
        self.used: Mask = np.zeros((runs, uavs), dtype=np.bool_)
        """(run, uav) whose fixes are in use."""
        self.refused_s = np.zeros((runs, uavs))
        """(run, uav) how long fixes have disagreed without one used in between [s]."""
        self.refused = np.zeros((runs, uavs), dtype=np.int64)
        """(run, uav) number of fixes refused or outvoted so far."""
        self.missed = np.zeros((runs, uavs), dtype=np.int64)
        """(run, uav) number of epochs so far at which a fix was due and none came."""
        self.epochs_per_new = 1
        """Epochs from one new fix to the next."""
        self._epoch_s = epoch_s
        self._epochs_since_new = 0

    @property
    def epochs_to_new(self) -> int:
        """Epochs until the receiver has a new fix, as they have come so far."""
        return max(1, self.epochs_per_new - self._epochs_since_new)

    def out_of_patience(self) -> Mask:
        """(run, uav): whose fixes have been refused for :data:`GATE_PATIENCE_S`."""
        return np.asarray(self.refused_s >= GATE_PATIENCE_S - 1e-9)

    def note(self, verdict: NDArray[np.int8], available: Mask, new: bool, usable: Mask, active: Mask) -> None:
        """Take down one epoch.

        Parameters
        ----------
        verdict : array of int8, shape (run, uav)
            What was made of the fixes, see :func:`napf_mpc.navigation.kalman.correct`.
        available : array of bool, shape (run, uav)
            Whether there is a fix.
        new : bool
            Whether the fix is a new one.
        usable : array of bool, shape (run, uav)
            Whether it is a measurement at all.
        active : array of bool, shape (run,)
            Runs that fly.
        """
        flying = active[:, None]
        self._epochs_since_new += 1
        if new:
            self._epochs_since_new, self.epochs_per_new = 0, max(1, self._epochs_since_new)
        self.missed += new & ~available & flying
        begun, refused = (verdict == BEGUN) & flying, (verdict == REFUSED) & flying
        outvoted = (verdict == OUTVOTED) & flying
        taken = ((verdict == USED) & flying) | begun | outvoted
        self.begun |= begun
        self.refused += refused | outvoted
        self.used = (self.used | taken) & ~refused & available
        # A fix that is no measurement says nothing against the estimate: patience is for those that disagree.
        waiting = available & usable & ~self.used & flying
        self.refused_s = np.where(self.used, 0.0, self.refused_s + self._epoch_s * waiting)
