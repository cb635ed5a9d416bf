"""Filtered navigation in the closed loop: sensors see the truth, the filter sees the sensors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.filter import FilterModel, KalmanFilter
from napf_mpc.navigation.fix import PositionErrors
from napf_mpc.navigation.integrity.overbound import Overbound
from napf_mpc.navigation.monitor import InnovationMonitor
from napf_mpc.navigation.replay import RecordedErrors
from napf_mpc.navigation.sensors import Sensors
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import Navigation
from napf_mpc.streams import Seed

__all__ = ["FilteredNavigation"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class FilteredNavigation:
    """Navigation of a block of runs with ``navigation.filter = "kalman"``.

    Parameters
    ----------
    navigation : Navigation
        Sensors and filter.
    errors : PositionErrors
        Of the position fixes.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Runs of the block.
    period_s : float
        Length of a tick [s].
    ticks_per_fix : int
        Ticks from one epoch of fixes to the next.
    velocity : array, shape (run, uav, 3)
        True velocity at the start [m/s].
    """

    def __init__(
        self,
        navigation: Navigation,
        errors: PositionErrors,
        seed: Seed,
        runs: range,
        period_s: float,
        ticks_per_fix: int,
        velocity: Array,
    ) -> None:
        uavs = velocity.shape[1]
        self._errors = errors
        self._ticks_per_fix = ticks_per_fix
        self._overbound: Overbound | None = None
        self._sensors = Sensors(navigation, seed, runs, uavs, period_s, velocity)
        self._filter = KalmanFilter(
            FilterModel.of_navigation(navigation, period_s, ticks_per_fix), len(runs), uavs
        )

    @property
    def gated_fixes(self) -> NDArray[np.int64]:
        """(run,) number of fixes that were refused so far, of all UAVs."""
        return np.asarray(self._filter.refused_fixes.sum(axis=-1), dtype=np.int64)

    @property
    def missed_fixes(self) -> NDArray[np.int64]:
        """(run,) number of epochs so far at which a fix was due and none came, of all UAVs."""
        return np.asarray(self._filter.missed_fixes.sum(axis=-1), dtype=np.int64)

    @property
    def monitor(self) -> InnovationMonitor | None:
        """What watches the innovations; None if nothing does."""
        return self._filter.monitor

    def solution(
        self,
        tick: int,
        time_s: float,
        position: Array,
        velocity: Array,
        attitude: Array,
        body_rates: Array,
        active: Mask,
    ) -> NavSolution:
        """Measure the truth at a tick and issue the solution; to be called once a tick, from tick 0 on.

        Parameters
        ----------
        tick, time_s : int, float
            Number of the tick and its time [s].
        position, velocity, attitude, body_rates : array, shape (run, uav, 3)
            The truth [m, m/s, rad, rad/s]. Attitude and rates are copied into the solution, position and
            velocity reach it through measurements only.
        active : array of bool, shape (run,)
            Runs that fly; the estimates of others stand still.
        """
        if tick > 0:
            self._filter.predict(self._sensors.velocity_change(velocity), active)
        if tick % self._ticks_per_fix == 0:
            epoch = tick // self._ticks_per_fix
            fix = self._errors.fix(epoch)
            self._overbound = fix.overbound
            self._filter.correct(
                position + fix.error,
                self._sensors.gnss_velocity(velocity),
                fix.covariance,
                fix.available,
                _is_new(self._errors, epoch),
                active,
            )
        solution = self._filter.solution(time_s, attitude.copy(), body_rates.copy())
        # A protection level is one of the fix, and says nothing of an estimate: it ends here.
        return solution if self._overbound is None else replace(solution, overbound=self._overbound)


def _is_new(errors: PositionErrors, epoch: int) -> bool:
    """Whether an epoch's fix is more than the last one repeated: a log slower than the fixes is held."""
    if epoch == 0 or not isinstance(errors, RecordedErrors):
        return True
    before, now = (math.floor(n * errors.period_s / errors.table.period_s + 1e-6) for n in (epoch - 1, epoch))
    return now > before
