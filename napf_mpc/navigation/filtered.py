"""Filtered navigation in the closed loop: sensors see the truth, the filter sees the sensors.

Of an emulated receiver's errors the part that UAVs have in common (orbits, clocks, atmosphere) stays as it
is for minutes. No filter can take it out, and one that believed the whole error to change would soon claim to
have done so. The filter is therefore given the covariance of the rest, S C S^T - L L^T, and L L^T is added to
what it reports: a Schmidt-Kalman filter's treatment of a constant, but for gains that ignore it. The same L
is the common factor of the UAVs.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.filter import KalmanFilter
from napf_mpc.navigation.filter_model import FilterModel
from napf_mpc.navigation.fix import FixSource, PlacedErrors, PositionErrors, check_shapes, fixes_of_flight
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.integrity.overbound import Overbound
from napf_mpc.navigation.monitor import Monitor
from napf_mpc.navigation.point_mass_filter import PointMassFilter
from napf_mpc.navigation.replay import RecordedErrors
from napf_mpc.navigation.sensors import Barometers, Sensors
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import Gnss, Navigation
from napf_mpc.streams import Seed

__all__ = ["FilteredNavigation"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class FilteredNavigation:
    """Navigation of a block of runs with a filter: ``navigation.filter = "kalman"`` or ``"point_mass"``.

    Parameters
    ----------
    navigation : Navigation
        Sensors and filter.
    errors : PositionErrors or PlacedErrors
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
    fixes : FixSource, optional
        Fixes of this flight, instead of a new flight of the errors.
    """

    def __init__(
        self,
        navigation: Navigation,
        errors: PositionErrors | PlacedErrors,
        seed: Seed,
        runs: range,
        period_s: float,
        ticks_per_fix: int,
        velocity: Array,
        fixes: FixSource | None = None,
    ) -> None:
        uavs = velocity.shape[1]
        self._errors = errors
        self._fixes = fixes_of_flight(errors) if fixes is None else fixes
        self._lasting: Array | None = None
        if isinstance(errors, GnssErrors):
            self._lasting = np.zeros((*velocity.shape[:2], 3, len(errors.scene.names)))
        self._ticks_per_fix = ticks_per_fix
        self._overbound: Overbound | None = None
        self._sensors = Sensors(navigation, seed, runs, uavs, period_s, velocity)
        self._barometers: Barometers | None = None
        if isinstance(navigation, Gnss) and navigation.barometer != "none":
            self._barometers = Barometers(navigation, seed, runs, uavs, period_s * ticks_per_fix)
        model = FilterModel.of_navigation(navigation, period_s, ticks_per_fix)
        self._filter: KalmanFilter | PointMassFilter
        if navigation.filter == "point_mass":
            degrees = navigation.student_degrees_of_freedom
            self._filter = PointMassFilter(model, degrees, len(runs), uavs)
        else:
            self._filter = KalmanFilter(model, len(runs), uavs)

    @property
    def gated_fixes(self) -> NDArray[np.int64]:
        """(run,) number of fixes that were refused or outvoted so far, of all UAVs."""
        return np.asarray(self._filter.refused_fixes.sum(axis=-1), dtype=np.int64)

    @property
    def missed_fixes(self) -> NDArray[np.int64]:
        """(run,) number of epochs so far at which a fix was due and none came, of all UAVs."""
        return np.asarray(self._filter.missed_fixes.sum(axis=-1), dtype=np.int64)

    @property
    def monitor(self) -> Monitor | None:
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

        Raises
        ------
        ValueError
            If a fix is of other runs or UAVs than the position.
        """
        if tick > 0:
            self._filter.predict(self._sensors.velocity_change(velocity), active)
        if tick % self._ticks_per_fix == 0:
            epoch = tick // self._ticks_per_fix
            fix = self._fixes.fix(epoch, position)
            check_shapes(fix, epoch, *position.shape[:2])
            self._overbound = fix.overbound
            covariance = fix.covariance
            if self._lasting is not None:
                self._lasting = np.where(fix.available[..., None, None], fix.common_factor, self._lasting)
                covariance = covariance - _square(fix.common_factor)
            if self._barometers is not None:
                self._filter.take_in_heights(self._barometers.height(position[..., 2]), active)
            self._filter.correct(
                position + fix.error,
                self._sensors.gnss_velocity(velocity),
                covariance,
                fix.available,
                _is_new(self._errors, epoch),
                active,
            )
        found = self._filter.solution(time_s, attitude.copy(), body_rates.copy())
        if self._lasting is not None:
            lasting = self._lasting
            if isinstance(self._filter, PointMassFilter) and self.monitor is not None:
                # A receiver that believes too much of its own errors does so of what it shares with others.
                # The Kalman filter's monitor scales by single disagreements too, which say nothing of these.
                lasting = lasting * np.sqrt(self.monitor.scale)[..., None]
            found = _with_lasting(found, lasting)
        # A protection level is one of the fix, and says nothing of an estimate: it ends here.
        return found if self._overbound is None else replace(found, overbound=self._overbound)


def _square(factor: Array) -> Array:
    """L L^T of factors (..., 3, rank)."""
    return np.asarray(np.einsum("...ak,...bk->...ab", factor, factor))


def _with_lasting(found: NavSolution, factor: Array) -> NavSolution:
    """Add what no filter can take out, an error that stays for the mission, to a filter's report."""
    lasting = _square(factor)
    covariance = found.covariance.copy()
    covariance[..., :3, :3] += lasting
    return replace(found, covariance=covariance, common_factor=factor, lasting=lasting)


def _is_new(errors: PositionErrors | PlacedErrors, epoch: int) -> bool:
    """Whether an epoch's fix is more than the last one repeated: a log slower than the fixes is held."""
    if epoch == 0 or not isinstance(errors, RecordedErrors):
        return True
    before, now = (math.floor(n * errors.period_s / errors.table.period_s + 1e-6) for n in (epoch - 1, epoch))
    return now > before
