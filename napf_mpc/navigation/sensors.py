"""Sensors beside the position fix, simulated from the truth: GNSS velocity, accelerometers, barometers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.problem import Gnss, Navigation
from napf_mpc.streams import NormalSequence, Seed, Stream
from napf_mpc.vehicle.plant import plain

__all__ = ["Barometers", "Sensors", "bias_memory"]

Array = NDArray[np.float64]


def bias_memory(navigation: Navigation, period_s: float) -> float:
    """Correlation of the accelerometer bias over a time: exp(-time / correlation time)."""
    return math.exp(-period_s / navigation.accelerometer_bias_time_s)


class Sensors:
    r"""What receiver velocity and accelerometers of every UAV of every run measure.

    GNSS velocity is the true one plus white noise. The accelerometers measure the change of the true velocity
    over a tick, in the world frame (attitude and gravity are known without error), plus bias and noise:

    .. math:: \Delta v_{meas} = \Delta v + dt\, b_k + \sqrt{dt}\, q\, n_k, \qquad
              b_{k+1} = \phi\, b_k + \sigma_b \sqrt{1 - \phi^2}\, z_{k+1}, \quad b_0 = \sigma_b z_0.

    All these errors carry ``error_scale``. They depend on the seed, the run, the UAV, the axis and the number
    of the tick alone, so all planners of a comparison fly the same ones.

    Parameters
    ----------
    navigation : Navigation
        Sigmas and times.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Runs of the block.
    uavs : int
        Number of UAVs.
    period_s : float
        Length of a tick [s].
    velocity : array, shape (run, uav, 3)
        True velocity at the start [m/s].
    """

    def __init__(
        self, navigation: Navigation, seed: Seed, runs: range, uavs: int, period_s: float, velocity: Array
    ) -> None:
        scale = navigation.error_scale
        self._period_s = period_s
        self._memory = bias_memory(navigation, period_s)
        self._velocity_sigma = scale * navigation.gnss_velocity_sigma_mps
        self._noise_sigma = scale * navigation.accelerometer_noise_mps_rts * math.sqrt(period_s)
        self._bias_sigma = scale * navigation.accelerometer_bias_mps2
        self._new_bias_sigma = self._bias_sigma * math.sqrt(
            -math.expm1(-2.0 * period_s / navigation.accelerometer_bias_time_s)
        )
        # Five seconds ahead at the usual rates.
        self._velocity_noise = NormalSequence(seed, runs, Stream.GNSS_VELOCITY, uavs, ahead=50)
        self._bias_noise = NormalSequence(seed, runs, Stream.ACCELEROMETER_BIAS, uavs)
        self._noise = NormalSequence(seed, runs, Stream.ACCELEROMETER_NOISE, uavs)
        self._bias = self._bias_sigma * self._bias_noise.take()
        self._velocity = velocity.copy()

    def gnss_velocity(self, velocity: Array) -> Array:
        """Measured velocity (run, uav, 3) of the next epoch of fixes [m/s]."""
        return velocity + self._velocity_sigma * self._velocity_noise.take()

    def velocity_change(self, velocity: Array) -> Array:
        """Measured change of the velocity over a tick that ends with the given true one (run, uav, 3)."""
        measured = np.empty(velocity.shape)
        _measure(
            plain(velocity), self._velocity, self._bias, self._noise.take(), self._bias_noise.take(),
            self._period_s, self._noise_sigma, self._memory, self._new_bias_sigma, measured,
        )  # fmt: skip
        return measured


class Barometers:
    r"""What the barometer of every UAV of every run says of its height.

    .. math:: z = h + \sigma_w g_w(t) + \sigma_d g_{d,i}(t) + \sigma_n n,

    :math:`g_w`, of all UAVs of a run, and :math:`g_{d,i}`, each one's own, Gauss-Markov processes of unit
    variance, and white noise n. Heights carry ``error_scale``, as all errors do.

    Parameters
    ----------
    receiver : Gnss
        Sigmas and times.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Runs of the block.
    uavs : int
        Number of UAVs.
    epoch_s : float
        Time between two epochs [s].
    """

    def __init__(self, receiver: Gnss, seed: Seed, runs: range, uavs: int, epoch_s: float) -> None:
        self._scale = receiver.error_scale
        self._noise_m = receiver.barometer_noise_m
        self._noise = NormalSequence(seed, runs, Stream.BAROMETER_NOISE, uavs, axes=1)
        self._parts = [
            _Wander(
                NormalSequence(seed, runs, Stream.BAROMETER_WEATHER, 1, axes=1),
                receiver.barometer_weather_m,
                receiver.barometer_weather_time_s,
                epoch_s,
            ),
            _Wander(
                NormalSequence(seed, runs, Stream.BAROMETER_DRIFT, uavs, axes=1),
                receiver.barometer_drift_m,
                receiver.barometer_drift_time_s,
                epoch_s,
            ),
        ]

    def height(self, height: Array) -> Array:
        """Measured heights (run, uav) of the next epoch, of true ones [m]."""
        error = self._noise_m * self._noise.take()[..., 0]
        for part in self._parts:
            error = error + part.take()
        return np.asarray(height + self._scale * error)


class _Wander:
    """A Gauss-Markov process of many series, epoch by epoch."""

    def __init__(self, new: NormalSequence, sigma: float, time_s: float, epoch_s: float) -> None:
        self._new, self._sigma = new, sigma
        self._memory = math.exp(-epoch_s / time_s)
        self._share = math.sqrt(-math.expm1(-2.0 * epoch_s / time_s))
        self._now: Array | None = None

    def take(self) -> Array:
        """Values (run, series) of the next epoch."""
        new = self._new.take()[..., 0]
        self._now = new.copy() if self._now is None else self._memory * self._now + self._share * new
        return self._sigma * self._now


@compiled
def _measure(
    velocity: Array, before: Array, bias: Array, noise: Array, new: Array, period_s: float,
    noise_sigma: float, memory: float, new_bias_sigma: float, measured: Array,
) -> None:  # fmt: skip
    """Write the velocity change (run, uav, 3) that is measured, and carry bias and velocity on, in place."""
    for run in range(measured.shape[0]):
        for uav in range(measured.shape[1]):
            for axis in range(3):
                at = run, uav, axis
                change = velocity[at] - before[at] + period_s * bias[at]
                measured[at] = change + noise_sigma * noise[at]
                bias[at] = bias[at] * memory + new_bias_sigma * new[at]
                before[at] = velocity[at]
