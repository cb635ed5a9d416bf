r"""Monitor of normalised innovations: tells when reported sigmas are too small, and by how much.

The innovation of a fix over its own sigma is a standard-normal number if the filter's model holds, and
independent of those before (R. K. Mehra, J. Peschon, "An innovations approach to fault detection and
diagnosis in dynamic systems", Automatica 7, 1971). On each axis of each UAV the last :data:`WINDOW` are
kept. With :data:`ALARM_HITS` or more of them beyond two sigmas, where a consistent filter has 1.4, the
reported sigma is taken as too small: its square grows by the median of the squared innovations over that of
the chi-square law, 0.455. Counts and medians, not means: one wild fix is the gate's affair. The scale falls
again where the median of :data:`WINDOW` innovations is less than half of what it should be, never below 1.
Where the filter begins anew with a fix that it had refused, the sigma is then at least their distance. As
long as no alarm is raised and no fix refused, nothing is changed to the last bit.

A fix after a refused one is compared with that one, carried on by the estimate: a jump counts once, however
long it lasts, and sigmas that are too small count as before. What else a refused fix means with the monitor
is in :mod:`napf_mpc.navigation.filter`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled

__all__ = [
    "ALARM_HITS",
    "HIT",
    "WINDOW",
    "DoubtEvent",
    "InnovationMonitor",
    "Monitor",
    "MonitorEvent",
    "squared_innovations",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WINDOW = 30
"""Innovations of an axis that are looked at: 3 s at 10 Hz."""
HIT = 4.0
"""A squared normalised innovation beyond this is a hit."""
ALARM_HITS = 10
"""Hits among the window at which an alarm is raised: chance 5e-7 for independent innovations."""
MEDIAN = 0.454_936_423_119_572_8
"""Median of the chi-square law with one degree of freedom."""
SLACK = 2.0
"""A scale falls to this many times what a window asks for: half of all windows ask for less than is right."""
MAX_SCALE = 1e6
"""Largest factor on a variance."""


@dataclass(frozen=True)
class DoubtEvent:
    """Fixes and estimate disagree for long, or no longer, or are given in to."""

    time_s: float
    """When [s]."""
    run: int
    """Run within the block."""
    uav: int
    """UAV."""
    turn: Literal["begins", "ends", "given in"]
    """What happens to the doubt."""


@dataclass(frozen=True)
class MonitorEvent:
    """An alarm: the sigma of an axis is too small, and what it is multiplied by for now."""

    time_s: float
    """When [s]."""
    run: int
    """Run within the block."""
    uav: int
    """UAV."""
    axis: int
    """0 east, 1 north, 2 up."""
    sigma_scale: float
    """Factor on the reported sigma."""


class Monitor:
    """What a monitor tells of all axes of all UAVs of a block of runs.

    Parameters
    ----------
    runs, uavs : int
        How many.
    """

    def __init__(self, runs: int, uavs: int) -> None:
        self.scale: Array = np.ones((runs, uavs, 3))
        """(run, uav, 3) factor on the variances that fixes report, at least 1."""
        self.alarms = np.zeros((runs, uavs), dtype=np.int64)
        """(run, uav) number of alarms so far."""
        self.largest: Array = np.ones((runs, uavs))
        """(run, uav) largest factor on a sigma so far."""
        self.events: list[MonitorEvent] = []
        """Alarms one by one."""
        self.doubts: list[DoubtEvent] = []
        """Disputes of fixes and estimate, of filters that have them."""

    def _alarm(self, at: tuple[Any, ...], scale: float, time_s: float) -> None:
        """Note that an axis has a new and larger factor on its variance."""
        run, uav, axis = (int(i) for i in at)
        self.alarms[run, uav] += 1
        self.largest[run, uav] = max(self.largest[run, uav], scale**0.5)
        self.events.append(MonitorEvent(time_s, run, uav, axis, scale**0.5))


class InnovationMonitor(Monitor):
    """Windows of innovations of all axes of all UAVs of a block of runs.

    Parameters
    ----------
    runs, uavs : int
        How many.
    """

    def __init__(self, runs: int, uavs: int) -> None:
        super().__init__(runs, uavs)
        shape = (runs, uavs, 3)
        self.doubted: Mask = np.zeros((runs, uavs), dtype=np.bool_)
        self._window = np.full((*shape, WINDOW), np.nan)
        self._count = np.zeros(shape, dtype=np.int64)

    def observe(self, squared: Array, time_s: float) -> Array:
        """Take in one epoch and return by how much each scale changes.

        Parameters
        ----------
        squared : array, shape (run, uav, 3)
            Squared innovations over the variances that the filter expected; NaN for none.
        time_s : float
            Time of the epoch [s].

        Returns
        -------
        array, shape (run, uav, 3)
            Factor on :attr:`scale`, already in it: above 1 for an alarm, below where it falls, else 1.
        """
        change = np.ones(squared.shape)
        seen = np.isfinite(squared)
        slot = self._count % WINDOW
        for at in zip(*np.nonzero(seen), strict=True):
            self._window[*at, slot[at]] = squared[at]
        self._count += seen
        hits = (self._window > HIT).sum(-1)
        alarm = seen & (hits >= ALARM_HITS)
        # Only scales above 1 can fall, and only a full window of fresh innovations lets them.
        ripe = seen & ~alarm & (self.scale > 1.0) & (self._count >= WINDOW)
        for at in zip(*np.nonzero(alarm | ripe), strict=True):
            ratio = float(np.nanmedian(self._window[at])) / MEDIAN
            if alarm[at]:
                after = min(MAX_SCALE, self.scale[at] * max(ratio, HIT))
            else:
                after = max(1.0, self.scale[at] * min(1.0, SLACK * ratio))
            change[at] = after / self.scale[at]
            self._set(at, after, time_s, bool(alarm[at]))
        return change

    def disagree(self, squared: Array, time_s: float) -> None:
        """Note where a filter begins anew with a fix that it had refused.

        Estimate and fix were both believed, and they are so far apart: which of them was wrong nobody knows,
        so the sigma of the fix is from now on at least that distance, until innovations let it fall.

        Parameters
        ----------
        squared : array, shape (run, uav, 3)
            Squared distances of fix and estimate over the squared sigmas of the fix, with their scales; NaN
            where nothing begins anew.
        time_s : float
            Time of the epoch [s].
        """
        for at in zip(*np.nonzero(squared > 1.0), strict=True):
            self._set(at, min(MAX_SCALE, float(self.scale[at] * squared[at])), time_s, True)

    def doubt(self, doubted: Mask, given_in: Mask, time_s: float) -> None:
        """Note whose fixes are in doubt from now on; that it begins counts as an alarm.

        Parameters
        ----------
        doubted : array of bool, shape (run, uav)
            Whose fixes are.
        given_in : array of bool, shape (run, uav)
            Whose filter begins anew with the doubted fix.
        time_s : float
            Time of the epoch [s].
        """
        for run, uav in np.argwhere(doubted != self.doubted).tolist():
            turn: Literal["begins", "ends", "given in"] = "begins" if doubted[run, uav] else "ends"
            if given_in[run, uav]:
                turn = "given in"
            self.alarms[run, uav] += turn == "begins"
            self.doubts.append(DoubtEvent(time_s, run, uav, turn))
        self.doubted = doubted.copy()

    def _set(self, at: tuple[Any, ...], scale: float, time_s: float, alarm: bool) -> None:
        self.scale[at] = scale
        self._window[at] = np.nan
        self._count[at] = 0
        if alarm:
            self._alarm(at, scale, time_s)


@compiled
def squared_innovations(
    mean: Array,
    packed: Array,
    fix_position: Array,
    fix_sigma: Array,
    measured: Mask,
    error_memory: Array,
    error_noise: Array,
    position_noise: float,
    refused_miss: Array,
    since_miss: NDArray[np.int64],
    out: Array,
) -> None:
    """Write squared innovations of the position over their variances, before any gate.

    Parameters
    ----------
    mean, packed : array, shape (run, uav, 3, 4) and (run, uav, 3, 10)
        States before the epoch, see :mod:`napf_mpc.navigation.kalman`; left as they are.
    fix_position, fix_sigma : array, shape (run, uav, 3)
        Measured position and the sigma that the filter takes for it [m].
    measured : array of bool, shape (run, uav, 3)
        What there is to compare.
    error_memory, error_noise : array, shape (3,)
        phi and 1 - phi^2 of the fix's error from one epoch to the next.
    position_noise : float
        Variance of the white noise in the position [m^2].
    refused_miss : array, shape (run, uav, 3)
        What the last fix was off the estimate if it was refused [m]; NaN if it was not. A fix after a refused
        one is compared with that, moved on by the estimate, and not with the estimate: a jump is one wild
        innovation, however long it lasts.
    since_miss : array of int, shape (run, uav)
        Epochs from that fix to this one.
    out : array, shape (run, uav, 3)
        Out; NaN where nothing is measured, or a number is not finite.
    """
    for r in range(out.shape[0]):
        for i in range(out.shape[1]):
            for a in range(3):
                out[r, i, a] = np.nan
                if not measured[r, i, a]:
                    continue
                x, c, memory = mean[r, i, a], packed[r, i, a], error_memory[a]
                sigma = fix_sigma[r, i, a]
                spread = c[0] + 2.0 * sigma * memory * c[2] + position_noise
                spread += sigma * sigma * (memory * memory * c[7] + error_noise[a])
                miss = fix_position[r, i, a] - x[0] - sigma * memory * x[2]
                if np.isfinite(refused_miss[r, i, a]):
                    miss = fix_position[r, i, a] - x[0] - refused_miss[r, i, a]
                    left = memory ** since_miss[r, i]
                    spread = 2.0 * ((1.0 - left) * sigma * sigma + position_noise)
                # A sigma of zero means unknown: the fix is refused, and says nothing of sigmas.
                if sigma > 0.0 and spread > 0.0 and np.isfinite(miss):
                    out[r, i, a] = miss * miss / spread
