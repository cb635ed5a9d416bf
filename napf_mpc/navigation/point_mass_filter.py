"""The robust navigation filter: fixes with heavy tails about a dead-reckoned way.

A Kalman filter must believe a reflected signal or refuse it, and then either stays wrong when fixes return to
the truth, or starts anew from one that is wrong (:mod:`napf_mpc.navigation.filter`). This one keeps the whole
density of the position on each axis (:mod:`napf_mpc.navigation.point_mass`): a fix far off is a second
possibility that raises the variance, and fades or takes over with what comes after. No position is refused.

It is given the same measurements and takes the same as known, but for the error of a fix: that has a Student
law with ``student_degrees_of_freedom`` and the reported sigma as its scale, and is worth what its
correlation leaves of it: over time, and of emulated receivers over the way flown as well
(``filter_correlation_length_m``, ``filter_standing_time_s``). What a known change of sigma would tell of a
Gauss-Markov error is not used.

Axes are filtered apart, and what UAVs have in common is not told: their relative covariance is the sum.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation import height_offset, kalman, point_mass
from napf_mpc.navigation.filter_model import RECEIVER_NOISE_M, FilterModel
from napf_mpc.navigation.fix import is_symmetric
from napf_mpc.navigation.fix_record import FixRecord
from napf_mpc.navigation.forecast import CovarianceForecast
from napf_mpc.navigation.scale_evidence import ScaleEvidence
from napf_mpc.navigation.solution import NavSolution

__all__ = ["PointMassFilter"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNINFORMATIVE = 1e12
"""Factor on a fix's variance from which on a forecast takes it as saying nothing."""


class PointMassFilter:
    """The point-mass filters of all UAVs of a block of runs.

    Each begins with the first fix that it is given, at t = 0 also with one that is carried on from before:
    density = the Student law about the fix; velocity = GNSS velocity; bias zero, with its sigma. After
    :data:`~napf_mpc.navigation.fix_record.GATE_PATIENCE_S` of fixes whose velocity the gate
    refused it does so again.

    Parameters
    ----------
    model : FilterModel
        What is taken as known.
    degrees : float
        Degrees of freedom of the Student law of the fixes' errors, at least 1.
    runs, uavs : int
        How many.
    """

    def __init__(self, model: FilterModel, degrees: float, runs: int, uavs: int) -> None:
        self._model, self._degrees = model, degrees
        shape = (runs, uavs, 3)
        self._mean = np.full((*shape, kalman.STATES), np.nan)
        self._packed = np.full((*shape, kalman.PACKED), np.nan)
        self._density = np.full((*shape, point_mass.NODES), 1.0 / point_mass.NODES)
        self._grids = np.ones((*shape, 2))
        self._astray = np.zeros((*shape, 2))
        self._lag = np.zeros(shape)
        self._verdict = np.zeros((runs, uavs), dtype=np.int8)
        self._record = FixRecord(runs, uavs, model.period_s * model.ticks_per_epoch)
        self._sigma = np.full(shape, np.nan)
        self._age = 0
        self._epoch = 0
        self.monitor: ScaleEvidence | None = None
        """What watches the innovations; None if nothing does."""
        self._unseen = np.zeros(shape)
        if model.monitored:
            self.monitor = ScaleEvidence(degrees, ~model.fixless_axis, runs, uavs)
        self._offset = np.full((runs if model.barometer else 0, uavs, height_offset.NUMBERS), np.nan)
        self._forecast = replace(
            model.forecast(), error_memory=np.where(model.fixless_axis, model.error_memory, 0.0)
        )
        self._law = (degrees + 3.0) / (degrees + 1.0)

    @property
    def refused_fixes(self) -> NDArray[np.int64]:
        """(run, uav) number of fixes so far that were refused, or outvoted.

        Refused are unusable ones and those with a velocity, or a barometer's height, beyond the gate; a
        position beyond the gate is outvoted: it is used, and counts for little.
        """
        return self._record.refused.copy()

    @property
    def missed_fixes(self) -> NDArray[np.int64]:
        """(run, uav) number of epochs so far at which a fix was due and none came."""
        return self._record.missed.copy()

    def predict(self, velocity_change: Array, active: Mask) -> None:
        """Carry the estimates over a tick; parameters are those of the Kalman filter's."""
        model = self._model
        kalman.predict(
            self._mean, self._packed, velocity_change, model.period_s, model.bias_memory,
            model.velocity_change_noise, model.bias_noise, active,
        )  # fmt: skip
        if model.barometer is not None:
            height_offset.carry(
                self._offset, model.period_s, model.bias_memory, model.barometer.drift, active
            )
        self._age += 1

    def take_in_heights(self, height: Array, active: Mask) -> None:
        """Take in heights of barometers; parameters are those of the Kalman filter's."""
        model = self._model
        assert model.barometer is not None
        height_offset.take_in_heights(
            self._mean, self._packed, self._offset, height, model.barometer.noise, model.gate,
            self._record.begun, active,
        )  # fmt: skip

    def correct(
        self, position: Array, velocity: Array, covariance: Array, available: Mask, new: bool, active: Mask
    ) -> None:
        """Take in one epoch of fixes; parameters are those of the Kalman filter's."""
        model = self._model
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.einsum("...ii->...i", covariance))
        sigma = np.where(is_symmetric(covariance)[..., None], sigma, np.nan)
        has_fix = np.ones_like(available) if self._epoch == 0 else available & new
        change = self._change()
        begins = ~self._record.begun | self._record.out_of_patience()
        if self.monitor is not None:
            sigma = self._watched(position, sigma, change, has_fix & ~begins & active[:, None])
        self._epoch += 1
        point_mass.correct(
            self._mean, self._packed, self._density, self._grids, self._astray, self._lag,
            position, velocity, sigma, has_fix, model.fixless_axis, model.error_memory, model.error_noise,
            change, self._degrees, RECEIVER_NOISE_M**2, model.velocity_sigma_mps**2, model.bias_sigma_mps2**2,
            model.gate, begins, active, self._verdict, self._offset,
            math.nan if model.barometer is None else model.barometer.offset,
        )  # fmt: skip
        self._age, self._sigma = 0, sigma
        usable = np.isfinite(position) & np.isfinite(velocity) & np.isfinite(sigma) & (sigma > 0.0)
        self._record.note(self._verdict, available, new, np.asarray(usable.all(-1)), active)
        self._foresee(change)

    def solution(self, time_s: float, attitude: Array, body_rates: Array) -> NavSolution:
        """Issue the solution of now; parameters and availability are those of the Kalman filter's."""
        runs, uavs = self._verdict.shape
        position, velocity = np.empty((runs, uavs, 3)), np.empty((runs, uavs, 3))
        covariance, widest = np.zeros((runs, uavs, 6, 6)), np.empty((runs, uavs))
        kalman.report(self._mean, self._packed, position, velocity, covariance, widest)
        return NavSolution(
            time_s=time_s,
            available=self._record.used | (widest <= self._model.coast_sigma_m**2),
            position=position,
            velocity=velocity,
            attitude=attitude,
            body_rates=body_rates,
            covariance=covariance,
            common_factor=np.zeros((runs, uavs, 3, 1)),
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

    def _watched(self, position: Array, sigma: Array, change: Array, fresh: Mask) -> Array:
        """Sigmas (run, uav, 3) as the monitor makes them believable."""
        assert self.monitor is not None
        off = np.where(fresh[..., None], position - self._mean[..., 0], np.nan)
        # Since the last one looked at: a fix that is refused for its velocity is no less like the one before.
        self._unseen += change
        weight = np.tanh(0.5 * self._unseen)
        self._unseen[np.isfinite(off)] = 0.0
        epoch_s = self._model.period_s * self._model.ticks_per_epoch
        grown = self.monitor.observe(off, self._packed[..., 0], sigma, weight, self._epoch * epoch_s)
        if (grown > 1.0).any():
            # What was made of the fixes so far is as uncertain as they are; the density follows its variance.
            root = np.sqrt(np.maximum(grown, 1.0))
            height_offset.follow_alarm(self._packed, self._offset, root[..., height_offset.VERTICAL])
            self._packed[..., 0] *= root * root
            self._packed[..., 1] *= root
            self._packed[..., 3] *= root
        return np.asarray(sigma * np.sqrt(self.monitor.scale))

    def _change(self) -> Array:
        """(run, uav, 3) correlation times by which the fix's error changes in an epoch.

        Where the error is one of the place, as a reflection's, it stays while a UAV stands.
        """
        model = self._model
        # Less what the estimate's own error adds on average: who stands must not seem to move.
        squared = (self._mean[..., 1] ** 2 - self._packed[..., 4]).sum(axis=-1)
        speed = np.sqrt(np.fmax(squared, 0.0))
        by_place = model.error_rate_standing_hz + model.error_rate_per_m * speed
        rate = np.minimum(model.error_rate_hz, by_place[..., None])
        return np.asarray(model.period_s * model.ticks_per_epoch * rate)

    def _foresee(self, change: Array) -> None:
        """Say how the variance goes on: as if the density were normal, at the speed of now.

        To the forecast's filter a fix has white noise then, worth as much as it is here: a Student law has
        (nu + 1) / (nu + 3) of a normal one's information, and fixes count by weight. Its variance is that of
        the state g, in which this filter keeps nothing.
        """
        model = self._model
        with np.errstate(divide="ignore"):
            factor = np.minimum(
                self._law / np.tanh(0.5 * self._record.epochs_per_new * change), UNINFORMATIVE
            )
        noise = np.where(model.fixless_axis, model.error_noise, factor)
        self._packed[..., 7] = np.where(model.fixless_axis, self._packed[..., 7], noise)
        self._forecast = replace(self._forecast, error_noise=noise)
