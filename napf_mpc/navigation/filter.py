r"""The navigation filter: position, velocity, error of the fixes and accelerometer bias of every UAV.

It is given measurements alone: fixes with their reported covariance, GNSS velocity, and the velocity changes
that accelerometers measured. It takes as known

- sigma(t) of the fix as reported, that its error is sigma(t) g(t) with g a Gauss-Markov process of unit
  variance, and the correlation time of g (``filter_correlation_time_s``, or a barometer's own);
- the laws of the GNSS velocity's noise, of the accelerometer's noise and of its bias, as the problem gives
  them;
- attitude, and with it gravity in the body, without error;
- the common-mode share, for what it reports of two UAVs. (What emulated receivers have in common lasts for
  the mission and is kept out of the filter, see :mod:`napf_mpc.navigation.filtered`.)

With the monitor, fixes that the gate refuses are handled by these rules; position and velocity of a receiver
are two witnesses, and one of them may be right when the other is not.

1. A fix refused for its position leaves its velocity, if that is inside the gate.
2. A fix that stands still to a millimetre while its velocity says that the UAV moves is refused.
3. A fix that follows a refused one (the step between them is inside the gate) is refused as well, unless it
   is within :data:`~napf_mpc.navigation.kalman.PULL` sigmas of the estimate.
4. After :data:`~napf_mpc.navigation.fix_record.GATE_PATIENCE_S` of refused fixes, fixes and estimate are in
   dispute. The solution does not count as available, so the UAV holds: that it does not move both stories
   say. What was known of the fix's error is forgotten.
5. The dispute ends with a step that brings the fix inside the gate, or once fixes have been within
   :data:`CALM_SIGMAS` for :data:`CALM_S`. If the estimate's own sigma passes ``filter_coast_sigma_m`` first,
   or the dispute lasts longer than ``dispute_limit_s``, the filter begins anew with the fix, its sigma at
   least their distance.

The axes are filtered apart. Where a fix reports a covariance between axes, that is not used to estimate, but
carried through the gains that are, so the reported covariance has it (but that of a height for which a
barometer speaks).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation import cross_covariance, height_offset, kalman
from napf_mpc.navigation.filter_model import RECEIVER_NOISE_M, FilterModel
from napf_mpc.navigation.fix import is_symmetric
from napf_mpc.navigation.fix_record import GATE_PATIENCE_S, FixRecord
from napf_mpc.navigation.forecast import CovarianceForecast
from napf_mpc.navigation.monitor import InnovationMonitor, squared_innovations
from napf_mpc.navigation.solution import NavSolution

__all__ = ["KalmanFilter"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CALM_S, CALM_SIGMAS = 30.0, 3.0
"""Doubted fixes that stay this near to the estimate, in sigmas of both, for this long [s] are used again."""
REPEATED_SIGMAS = 5.0
"""A velocity beyond this many of its sigmas says that a UAV moves."""


class KalmanFilter:
    """The filters of all UAVs of a block of runs.

    Each begins with the first fix that it is given, at t = 0 also with one that is carried on from before:
    position = fix, with the reported sigma; velocity = GNSS velocity; bias zero, with its sigma. After
    :data:`~napf_mpc.navigation.fix_record.GATE_PATIENCE_S` of fixes that the gate refused it does so again,
    but for the monitor's rules.

    Parameters
    ----------
    model : FilterModel
        What is taken as known.
    runs, uavs : int
        How many.
    """

    def __init__(self, model: FilterModel, runs: int, uavs: int) -> None:
        self._model = model
        self._mean = np.full((runs, uavs, 3, kalman.STATES), np.nan)
        self._packed = np.full((runs, uavs, 3, kalman.PACKED), np.nan)
        self._record = FixRecord(runs, uavs, model.period_s * model.ticks_per_epoch)
        self._verdict = np.zeros((runs, uavs), dtype=np.int8)
        self._forecast = model.forecast()
        self._sigma = np.full((runs, uavs, 3), np.nan)
        self._monitor = InnovationMonitor(runs, uavs) if model.monitored else None
        self._doubted = np.zeros((runs, uavs), dtype=np.bool_)
        self._refused_miss = np.full((runs, uavs, 3), np.nan)
        self._since_miss = np.zeros((runs, uavs), dtype=np.int64)
        self._calm_s = np.zeros((runs, uavs))
        self._follows = np.zeros((runs, uavs), dtype=np.bool_)
        self._barred = np.zeros((runs, uavs), dtype=np.bool_)
        self._last_position = np.full((runs, uavs, 3), np.nan)
        self._epoch = 0
        self._offset = np.full((runs if model.barometer else 0, uavs, height_offset.NUMBERS), np.nan)

        shared = bool(model.common_share.any()) and 1 < uavs <= cross_covariance.MAX_UAVS
        kept = runs if shared or model.coupled else 0
        self._carried = np.empty((kept, uavs, 3, kalman.STATES, kalman.STATES))
        self._response = np.empty((kept, uavs, 3, kalman.STATES))
        self._common = np.zeros((runs if shared else 0, 3, uavs, uavs, kalman.STATES, kalman.STATES))
        self._cross = np.zeros((runs if model.coupled else 0, uavs, 3, kalman.STATES, kalman.STATES))
        tick = kalman.drift(model.period_s, model.bias_memory)
        self._since = [np.eye(kalman.STATES)]
        for _ in range(model.ticks_per_epoch):
            self._since.append(tick @ self._since[-1])
        self._age = 0
        self._common_rank = 3 * uavs if shared else 1

    @property
    def refused_fixes(self) -> NDArray[np.int64]:
        """(run, uav) number of fixes refused so far, by the gate or as unusable."""
        return self._record.refused.copy()

    @property
    def missed_fixes(self) -> NDArray[np.int64]:
        """(run, uav) number of epochs so far at which a fix was due and none came."""
        return self._record.missed.copy()

    @property
    def monitor(self) -> InnovationMonitor | None:
        """What watches the innovations; None if nothing does."""
        return self._monitor

    def predict(self, velocity_change: Array, active: Mask) -> None:
        """Carry the estimates over a tick.

        Parameters
        ----------
        velocity_change : array, shape (run, uav, 3)
            As the accelerometers measured it, in the world frame, without gravity [m/s].
        active : array of bool, shape (run,)
            Runs that fly.
        """
        model = self._model
        kalman.predict(
            self._mean,
            self._packed,
            velocity_change,
            model.period_s,
            model.bias_memory,
            model.velocity_change_noise,
            model.bias_noise,
            active,
        )
        if model.barometer is not None:
            height_offset.carry(
                self._offset, model.period_s, model.bias_memory, model.barometer.drift, active
            )
        self._age += 1
        if self._age == len(self._since):  # no epoch has come when it was due
            self._since.append(self._since[1] @ self._since[-1])

    def take_in_heights(self, height: Array, active: Mask) -> None:
        """Take in heights of barometers, with a fix or without; before the fix of the same epoch.

        Parameters
        ----------
        height : array, shape (run, uav)
            Measured, with the barometer's offset [m]; one that is not finite is none.
        active : array of bool, shape (run,)
            Runs that fly.
        """
        model = self._model
        assert model.barometer is not None
        height_offset.take_in_heights(
            self._mean, self._packed, self._offset, height, model.barometer.noise, model.gate,
            self._record.begun, active,
        )  # fmt: skip

    def correct(
        self, position: Array, velocity: Array, covariance: Array, available: Mask, new: bool, active: Mask
    ) -> None:
        """Take in one epoch of fixes. Epochs come at their rate, also while there is no fix.

        Parameters
        ----------
        position, velocity : array, shape (run, uav, 3)
            Measured [m, m/s].
        covariance : array, shape (run, uav, 3, 3)
            Of the position's error, as reported [m^2]. One that is not symmetric is no covariance, and its
            fix is refused.
        available : array of bool, shape (run, uav)
            Whether there is a fix.
        new : bool
            Whether the fix is a new one; one that the receiver repeats says nothing new.
        active : array of bool, shape (run,)
            Runs that fly.
        """
        model = self._model
        variance = np.einsum("...ii->...i", covariance)
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(variance)
        sound = is_symmetric(covariance)
        if not sound.all():
            sigma = np.where(sound[..., None], sigma, np.nan)
        begins = ~self._record.begun | self._gives_in()
        first = self._epoch == 0
        has_fix = (available | first) & (new | first)
        if self._monitor is not None:
            self._since_miss += 1
            self._bar_repeated(position, velocity)
            sigma, covariance = self._watched(position, sigma, covariance, has_fix, begins, active)
        self._epoch += 1
        self._carried[...] = self._since[model.ticks_per_epoch]
        kalman.correct(
            self._mean,
            self._packed,
            position,
            velocity,
            sigma,
            has_fix,
            model.fixless_axis,
            model.error_memory,
            model.error_noise,
            RECEIVER_NOISE_M**2,
            model.velocity_sigma_mps**2,
            model.bias_sigma_mps2**2,
            model.gate,
            self._doubted,
            self._follows,
            self._barred,
            model.monitored,
            begins,
            active,
            self._verdict,
            self._carried,
            self._response,
            self._offset,
            math.nan if model.barometer is None else model.barometer.offset,
        )
        if model.barometer is not None:
            # What heights change is not carried: it is told that height and plan have nothing in common.
            self._carried[:, :, height_offset.VERTICAL] = 0.0
            self._response[:, :, height_offset.VERTICAL] = 0.0
        self._age = 0
        self._sigma = sigma
        usable = np.isfinite(position) & np.isfinite(velocity) & np.isfinite(sigma) & (sigma > 0.0)
        self._record.note(self._verdict, available, new, np.asarray(usable.all(-1)), active)
        if self._monitor is not None:
            self._note_doubts(position, usable, sigma, available)
        self._advance_covariances(covariance, sigma, active)

    def _gives_in(self) -> Mask:
        """(run, uav): who begins anew with the next fix, after many that the gate refused.

        Unwatched, after its patience. With the monitor when the dispute has lasted too long, or the estimate
        has become worth nothing.
        """
        late = self._record.out_of_patience()
        if self._monitor is None:
            return late
        worthless = ~(self._packed[..., 0].max(-1) <= self._model.coast_sigma_m**2)
        too_long = self._record.refused_s >= GATE_PATIENCE_S + self._model.dispute_limit_s - 1e-9
        return np.asarray(late & (worthless | too_long))

    def _bar_repeated(self, position: Array, velocity: Array) -> None:
        """Refuse fixes that stand still while their own velocity says that the UAV moves."""
        model = self._model
        with np.errstate(invalid="ignore"):
            still = (np.abs(position - self._last_position) <= RECEIVER_NOISE_M).all(-1)
            moves = (np.abs(velocity) > REPEATED_SIGMAS * model.velocity_sigma_mps).any(-1)
        self._barred = still & moves
        self._last_position = position.copy()

    def _watched(
        self, position: Array, sigma: Array, covariance: Array, has_fix: Mask, begins: Mask, active: Mask
    ) -> tuple[Array, Array]:
        """Sigmas (run, uav, 3) and covariances (run, uav, 3, 3) as the monitor makes them believable."""
        monitor, model = self._monitor, self._model
        assert monitor is not None
        time_s = self._epoch * model.ticks_per_epoch * model.period_s
        anew = has_fix & begins & self._record.begun & active[:, None]
        if anew.any():
            with np.errstate(invalid="ignore", divide="ignore"):
                apart = (position - self._mean[..., 0]) ** 2 / (sigma**2 * monitor.scale)
            known = anew[..., None] & (sigma > 0.0) & np.isfinite(apart).all(-1, keepdims=True)
            monitor.disagree(np.where(known, apart, np.nan), time_s)
        measured = (has_fix[..., None] | model.fixless_axis) & ~begins[..., None] & active[:, None, None]
        squared = np.empty(sigma.shape)
        squared_innovations(
            self._mean, self._packed, position, sigma * np.sqrt(monitor.scale), measured,
            model.error_memory, model.error_noise, RECEIVER_NOISE_M**2, self._refused_miss,
            self._since_miss, squared,
        )  # fmt: skip
        stepped = (squared > model.gate**2).any(-1)
        calm = self._calm_s >= CALM_S - 1e-9
        self._follows = np.isfinite(self._refused_miss).all(-1) & ~stepped & ~calm
        change = monitor.observe(squared, time_s)
        if (change != 1.0).any():
            root = np.maximum(np.sqrt(change[..., height_offset.VERTICAL]), 1.0)
            height_offset.follow_alarm(self._packed, self._offset, root)
            kalman.rescale(self._mean, self._packed, change)
        if (monitor.scale == 1.0).all():
            return sigma, covariance
        root = np.sqrt(monitor.scale)
        return sigma * root, covariance * root[..., :, None] * root[..., None, :]

    def _note_doubts(self, position: Array, usable: Mask, sigma: Array, available: Mask) -> None:
        """Say whose fixes have been refused for long, and keep what the last was off if it was refused.

        It is kept as long as no new fix comes: receivers may be slower than the epochs.
        """
        assert self._monitor is not None
        fresh = self._verdict != kalman.NO_FIX
        refused = (self._verdict == kalman.REFUSED)[..., None] & usable
        miss = np.where(refused, position - self._mean[..., 0], np.nan)
        self._refused_miss = np.where(fresh[..., None], miss, self._refused_miss)
        self._since_miss[fresh] = 0
        self._doubted = self._record.begun & self._record.out_of_patience()
        spread = CALM_SIGMAS**2 * (self._packed[..., 0] + sigma**2)
        near = (self._refused_miss**2 <= spread).all(-1) & available
        epoch_s = self._model.ticks_per_epoch * self._model.period_s
        self._calm_s = np.where(self._doubted & near, self._calm_s + epoch_s, 0.0)
        time_s = (self._epoch - 1) * epoch_s
        self._monitor.doubt(self._doubted, self._verdict == kalman.BEGUN, time_s)

    def _advance_covariances(self, covariance: Array, sigma: Array, active: Mask) -> None:
        if len(self._common):
            begun = self._verdict == kalman.BEGUN
            cross_covariance.advance_pairs(
                self._common, self._carried, self._response, self._model.common_share, begun, active
            )
        if len(self._cross):
            correlation = np.empty(sigma.shape)
            for n, (a, b) in enumerate(cross_covariance.AXIS_PAIRS):
                known = covariance[..., a, b] / (sigma[..., a] * sigma[..., b])
                # That of a fix that is refused may be no number, and nothing would get it out again.
                correlation[..., n] = np.where(np.isfinite(known), known, 0.0)
            cross_covariance.advance_axes(self._cross, self._carried, self._response, correlation, active)

    def solution(self, time_s: float, attitude: Array, body_rates: Array) -> NavSolution:
        """Issue the solution of now.

        Parameters
        ----------
        time_s : float
            Time since the start of the mission [s].
        attitude, body_rates : array, shape (run, uav, 3)
            Handed through: they are taken as free of error [rad, rad/s].

        Returns
        -------
        NavSolution
            Available with a fix in use, and without one while every axis' sigma is at most
            ``filter_coast_sigma_m``.
        """
        runs, uavs = self._verdict.shape
        position, velocity = np.empty((runs, uavs, 3)), np.empty((runs, uavs, 3))
        covariance, widest = np.zeros((runs, uavs, 6, 6)), np.empty((runs, uavs))
        kalman.report(self._mean, self._packed, position, velocity, covariance, widest)
        if len(self._cross):
            cross_covariance.report_axes(self._cross, self._since[self._age], covariance)
        common_factor = np.zeros((runs, uavs, 3, self._common_rank))
        if len(self._common):
            cross_covariance.factorise(self._common, self._since[self._age], common_factor)
        return NavSolution(
            time_s=time_s,
            available=(self._record.used | (widest <= self._model.coast_sigma_m**2)) & ~self._doubted,
            position=position,
            velocity=velocity,
            attitude=attitude,
            body_rates=body_rates,
            covariance=covariance,
            common_factor=common_factor,
            disputed=None if self._monitor is None else self._doubted,
            filtered=True,
            forecast=CovarianceForecast(
                self._forecast,
                self._packed.copy(),
                self._sigma,
                self._record.used,
                self._age,
                self._record.epochs_to_new,
                self._record.epochs_per_new,
            ),
        )
