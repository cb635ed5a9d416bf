"""What a navigation filter takes as known of sensors and errors, from a problem's navigation section."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.forecast import ForecastModel, drifts
from napf_mpc.navigation.sensors import bias_memory
from napf_mpc.problem import ConstantBias, GaussMarkov, Gnss, Navigation, Recorded

__all__ = ["RECEIVER_NOISE_M", "BarometerModel", "FilterModel"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RECEIVER_NOISE_M = 1e-3
"""Sigma of a white noise of the position fix that the filter assumes beside the correlated error [m].

There is none in the simulated fixes. It covers the trapezoidal rule of the prediction (under 1 mm) and keeps
the arithmetic sound where an error never changes, so that two fixes would tell the velocity exactly.
"""


@dataclass(frozen=True)
class BarometerModel:
    """What the filter takes as known of barometers."""

    noise: float
    """Variance of the white noise [m^2]."""
    offset: float
    """Variance of an offset of which nothing is known [m^2]."""
    drift: float
    """Variance by which an offset wanders in a tick [m^2]."""

    @classmethod
    def of_receiver(cls, receiver: Gnss, period_s: float) -> BarometerModel:
        """Take weather and sensor as one offset, that wanders as fast as both do at first."""
        weather, own = receiver.barometer_weather_m**2, receiver.barometer_drift_m**2
        rate = weather / receiver.barometer_weather_time_s + own / receiver.barometer_drift_time_s
        return cls(receiver.barometer_noise_m**2, weather + own, 2.0 * rate * period_s)


@dataclass(frozen=True)
class FilterModel:
    """What the filter takes as known."""

    period_s: float
    """Length of a tick [s]."""
    ticks_per_epoch: int
    """Ticks from one epoch of fixes to the next."""
    error_memory: Array
    """(3,) correlation of the fix's error from one epoch to the next, on each axis."""
    error_noise: Array
    """(3,) variance of what is new in the unit error, 1 - memory^2."""
    error_rate_hz: Array
    """(3,) one over the error's correlation time [1/s]."""
    error_rate_standing_hz: float
    """The same where an error of the place meets a UAV that stands [1/s]; infinite for one of time."""
    error_rate_per_m: float
    """What each metre of the way adds to it [1/m]."""
    common_share: Array
    """(3,) share of the fix's error variance that UAVs have in common."""
    fixless_axis: Mask
    """(3,) axes that are measured without a fix too (a barometer's)."""
    coupled: bool
    """Whether fixes report covariances between axes."""
    velocity_sigma_mps: float
    """Sigma of the GNSS velocity [m/s]."""
    bias_sigma_mps2: float
    """Sigma of the accelerometer's bias [m/s^2]."""
    bias_memory: float
    """Correlation of the bias over a tick."""
    bias_noise: float
    """Variance of what is new in the bias in a tick [m^2/s^4]."""
    velocity_change_noise: float
    """Variance of the noise in a measured velocity change [m^2/s^2]."""
    gate: float
    """Largest innovation in its sigmas; 0 for none."""
    coast_sigma_m: float
    """Largest sigma of an axis with which a solution without a fix counts as available [m]."""
    monitored: bool = False
    """Whether innovations are watched, and sigmas that are too small scaled."""
    barometer: BarometerModel | None = None
    """Of barometers whose offset is to be learnt; None for no such sensor."""
    dispute_limit_s: float = math.inf
    """Watched: how long fixes and estimate may be in dispute before it begins anew with the fix [s]."""

    @classmethod
    def of_navigation(cls, navigation: Navigation, period_s: float, ticks_per_epoch: int) -> FilterModel:
        """Take the model from a problem's navigation section."""
        own = navigation.filter_correlation_time_s
        share = np.full(3, navigation.common_mode_share)
        match navigation:
            case GaussMarkov():
                times = [navigation.correlation_time_s if own is None else own] * 3
            case ConstantBias():
                times = [math.inf if own is None else own] * 3
            case Recorded() | Gnss():
                assert own is not None
                times = [own] * 3
        barometer = isinstance(navigation, Recorded) and navigation.vertical == "barometer"
        if isinstance(navigation, Recorded) and barometer:
            times[2] = navigation.barometer_correlation_time_s
            share[2] = 0.0
        rates = np.array([1.0 / time if time > 0.0 else math.inf for time in times])
        lags = np.array([period_s * ticks_per_epoch / time if time > 0.0 else math.inf for time in times])
        standing, per_m = math.inf, 0.0
        if isinstance(navigation, Gnss):
            standing = 1.0 / navigation.filter_standing_time_s
            per_m = 1.0 / navigation.filter_correlation_length_m
        return cls(
            period_s=period_s,
            ticks_per_epoch=ticks_per_epoch,
            error_memory=np.exp(-lags),
            error_noise=-np.expm1(-2.0 * lags),
            error_rate_hz=rates,
            error_rate_standing_hz=standing,
            error_rate_per_m=per_m,
            common_share=share,
            fixless_axis=np.array([False, False, barometer]),
            coupled=isinstance(navigation, Recorded | Gnss),
            velocity_sigma_mps=navigation.gnss_velocity_sigma_mps,
            bias_sigma_mps2=navigation.accelerometer_bias_mps2,
            bias_memory=bias_memory(navigation, period_s),
            bias_noise=navigation.accelerometer_bias_mps2**2
            * -math.expm1(-2.0 * period_s / navigation.accelerometer_bias_time_s),
            velocity_change_noise=navigation.accelerometer_noise_mps_rts**2 * period_s,
            gate=navigation.innovation_gate_sigma,
            coast_sigma_m=navigation.filter_coast_sigma_m,
            monitored=navigation.monitor == "innovations",
            barometer=(
                BarometerModel.of_receiver(navigation, period_s)
                if isinstance(navigation, Gnss) and navigation.barometer != "none"
                else None
            ),
            dispute_limit_s=math.inf if navigation.dispute_limit_s is None else navigation.dispute_limit_s,
        )

    def forecast(self) -> ForecastModel:
        """Return the part that tells how the covariance goes on."""
        return ForecastModel(
            period_s=self.period_s,
            ticks_per_epoch=self.ticks_per_epoch,
            drift=drifts(
                self.period_s,
                self.bias_memory,
                self.velocity_change_noise,
                self.bias_noise,
                self.ticks_per_epoch,
            ),
            error_memory=self.error_memory,
            error_noise=self.error_noise,
            fixless_axis=self.fixless_axis,
            position_noise=RECEIVER_NOISE_M**2,
            velocity_noise=self.velocity_sigma_mps**2,
        )
