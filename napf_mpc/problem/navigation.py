"""Keys of ``[navigation]``: the errors of positions, and what filters them."""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from napf_mpc.problem.section import Section


class _NavigationBase(Section):
    rate_hz: float = Field(10.0, ge=0.1, le=100.0)
    """Rate of position fixes; each error is held between."""
    filter: Literal["none", "kalman", "point_mass"] = "none"
    """Navigation filter between the fixes and the planner: ``kalman`` for errors whose law is known, ``point_mass`` for errors with heavy tails (docs/navigation.md)."""  # noqa: E501
    common_mode_share: float = Field(0.0, ge=0.0, le=1.0)
    """Share of the error variance that all UAVs have in common."""
    reported_sigma_scale: float = Field(1.0, ge=1e-3, le=1e3)
    """What navigation claims over the truth: 0.5 reports half the true sigma."""
    error_scale: float = Field(1.0, ge=0.0, le=100.0)
    """Factor on the errors themselves; what is reported does not follow it. 0 switches the noise off."""
    gnss_velocity_sigma_mps: float = Field(0.1, ge=1e-4, le=100.0)
    """Filter: sigma of the GNSS velocity, white, with each fix."""
    accelerometer_bias_mps2: float = Field(0.05, ge=0.0, le=10.0)
    """Filter: sigma of an accelerometer's bias on each axis [m/s^2]."""
    accelerometer_bias_time_s: float = Field(100.0, ge=0.1, le=1e6)
    """Filter: correlation time of that bias."""
    accelerometer_noise_mps_rts: float = Field(0.01, ge=1e-6, le=10.0)
    """Filter: white noise of an accelerometer, as sigma of the velocity after one second [m/s/√s]."""
    innovation_gate_sigma: float = Field(5.0, ge=0.0, le=100.0)
    """Filter: a fix farther than this many sigmas from what is expected is refused; 0 for no gate."""
    monitor: Literal["none", "innovations"] = "none"
    """Filter: whether its normalised innovations are watched, reported sigmas that are too small scaled, and by the Kalman filter fixes that contradict the estimate held out while the UAV holds (docs/integrity.md)."""  # noqa: E501
    filter_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """Filter: correlation time that it assumes of the fix's error; by default the error's own."""
    student_degrees_of_freedom: float = Field(3.0, ge=2.5, le=1e6)
    """Point-mass filter: degrees of freedom of the Student law that it assumes of the fix's error; fewer are heavier tails."""  # noqa: E501
    filter_coast_sigma_m: float = Field(10.0, ge=1e-3, le=1e4)
    """Filter: without a fix, the solution counts as available up to this sigma of an axis."""
    dispute_limit_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """Kalman filter with the monitor: when fixes and estimate have been in dispute this long, it begins anew with the fix; by default it does not while its own sigma is below ``filter_coast_sigma_m`` (docs/integrity.md)."""  # noqa: E501


class GaussMarkov(_NavigationBase):
    """Correlated errors whose sigma swings between two bounds (paper: 1-5 m on each axis)."""

    kind: Literal["gauss_markov"] = "gauss_markov"
    """Kind of navigation error."""
    sigma_min_m: float = Field(1.0, ge=1e-3, le=1e3)
    """Smallest sigma of an axis."""
    sigma_max_m: float = Field(5.0, ge=1e-3, le=1e3)
    """Largest sigma of an axis."""
    sigma_period_s: float = Field(20.0, ge=0.1, le=1e6)
    """Period of sigma's swing; its phase is random per UAV and axis."""
    correlation_time_s: float = Field(10.0, ge=0.0, le=1e6)
    """Correlation time of the error; 0 is white noise."""
    outage_interval_s: float = Field(0.0, ge=0.0, le=1e6)
    """Mean time between outages of a UAV's fixes (exponential); 0 for none."""
    outage_duration_s: float = Field(5.0, ge=0.0, le=1e4)
    """Length of an outage."""

    @model_validator(mode="after")
    def _bounds_ordered(self) -> GaussMarkov:
        if self.sigma_min_m > self.sigma_max_m:
            raise ValueError(
                f"sigma_min_m = {self.sigma_min_m:g} must be <= sigma_max_m = {self.sigma_max_m:g}"
            )
        return self


class ConstantBias(_NavigationBase):
    """An error drawn once per UAV and axis and kept for the whole mission."""

    kind: Literal["constant"]
    """Kind of navigation error."""
    sigma_min_m: float = Field(1.0, ge=1e-3, le=1e3)
    """Smallest sigma of an axis."""
    sigma_max_m: float = Field(5.0, ge=1e-3, le=1e3)
    """Largest sigma of an axis; each is uniform between the two, once per UAV and axis."""

    @model_validator(mode="after")
    def _bounds_ordered(self) -> ConstantBias:
        if self.sigma_min_m > self.sigma_max_m:
            raise ValueError(
                f"sigma_min_m = {self.sigma_min_m:g} must be <= sigma_max_m = {self.sigma_max_m:g}"
            )
        return self


class Recorded(_NavigationBase):
    """Errors replayed from a measured log with the covariance that it reported."""

    kind: Literal["recorded"]
    """Kind of navigation error."""
    file: str = Field(min_length=1, max_length=1000)
    """Path under the data folder: RTKLIB ``.pos``, NMEA ``.nmea``, u-blox ``.ubx``, PX4 ``.ulg``, or ``.csv`` with errors and covariances."""  # noqa: E501
    format: Literal["auto", "pos", "nmea", "ubx", "ulog", "smartloc"] = "auto"
    """Format of the file; ``auto`` goes by its suffix."""
    truth_file: str | None = Field(None, max_length=1000)
    """Path of the truth that positions are compared with, by the same clock or both by GPS time, UTC or JST;
    a ``.csv`` needs none."""
    truth_format: Literal["auto", "pos", "nmea", "ubx", "ulog", "smartloc"] = "auto"
    """Format of the truth's file."""
    part: Literal["all", "first_half", "second_half"] = "all"
    """Part of the log that is replayed; an overbound is fitted to the other half."""
    gaps: Literal["close", "outage"] = "close"
    """Epochs without a fix: left out, or replayed as outages."""
    vertical: Literal["barometer", "recorded"] = "barometer"
    """Where the height comes from: a barometer model, as on a real UAV, or the log."""
    barometer_sigma_m: float = Field(1.0, ge=1e-3, le=1e3)
    """Sigma of the barometer's height."""
    barometer_correlation_time_s: float = Field(300.0, ge=0.0, le=1e6)
    """Correlation time of the barometer's error."""
    filter_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] = 3.0
    """Filter: correlation time that it assumes of the log's errors (the barometer's is its own)."""
    credit: str = Field("", max_length=500)
    """Source and licence, printed on every figure."""


class Gnss(_NavigationBase):
    """An emulated GNSS receiver on each UAV: pseudoranges by geometry, buildings and error laws, solved."""

    kind: Literal["gnss"]
    """Kind of navigation error."""
    file: str | None = Field(None, min_length=1, max_length=1000)
    """RINEX navigation file (2, 3, 4) under the data folder; by default a nominal constellation of GPS and
    Galileo."""
    systems: Annotated[tuple[Literal["GPS", "Galileo", "QZSS"], ...], Field(min_length=1, max_length=3)] = (
        "GPS",
        "Galileo",
        "QZSS",
    )
    """Systems that are received (QZSS from a file only); QZSS shares the receiver's clock with GPS."""
    start_gps_time: str = Field("2023-07-11T00:00:00", max_length=40)
    """GPS time of the mission's start, or of the earliest start."""
    start_spread_h: float = Field(24.0, ge=0.0, le=240.0)
    """Each run starts at a random time up to this long after ``start_gps_time``; 0 for one sky always."""
    origin_latitude_deg: Annotated[float, Field(ge=-89.9, le=89.9)] | None = None
    """Latitude of the local frame's origin; by default a city's own, else 50."""
    origin_longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    """Longitude of the local frame's origin; by default a city's own, else 10."""
    elevation_mask_deg: float = Field(10.0, ge=0.0, le=60.0)
    """Satellites lower than this are not used."""
    carrier_to_noise_dbhz: tuple[
        Annotated[float, Field(ge=20.0, le=60.0)], Annotated[float, Field(ge=20.0, le=60.0)]
    ] = (38.0, 50.0)
    """C/N0 of a visible signal at the horizon and at the zenith, growing with the sine of elevation."""
    carrier_to_noise_mask_dbhz: float = Field(30.0, ge=0.0, le=60.0)
    """Signals weaker than this are not used."""
    fading_db: float = Field(2.0, ge=0.0, le=20.0)
    """Sigma of a visible signal's C/N0 about its value."""
    signal_in_space: Literal["constant", "broadcast"] = "constant"
    """Sigma of satellites' orbits and clocks: ``signal_in_space_m``, or what each broadcasts (URA, SISA)."""
    signal_in_space_m: float = Field(1.0, ge=0.0, le=100.0)
    """Sigma of the range error by a satellite's orbit and clock, the same for all UAVs."""
    ionosphere_m: float = Field(1.0, ge=0.0, le=100.0)
    """Sigma of the ionosphere's residual delay in the zenith, the same for all UAVs."""
    troposphere_m: float = Field(0.12, ge=0.0, le=10.0)
    """Sigma of the troposphere's residual delay in the zenith, the same for all UAVs."""
    code_noise_m: float = Field(0.3, ge=1e-3, le=100.0)
    """Sigma of code noise at 45 dB Hz, white, each UAV's own; tenfold for 20 dB less."""
    multipath_scale: float = Field(2.0, ge=0.0, le=100.0)
    """Multipath of visible signals over the airborne model's 0.13 m + 0.53 m exp(-elevation / 10 deg)."""
    multipath_length_m: float = Field(5.0, ge=0.1, le=1e4)
    """Distance over which reflections change (multipath, delays and losses of reflected signals)."""
    multipath_time_s: float = Field(60.0, ge=0.1, le=1e5)
    """Time over which they change at one place, as satellites move."""
    reflected_delay_m: float = Field(20.0, ge=0.0, le=1e3)
    """Mean extra path of a signal that arrives by reflection alone, exponential."""
    reflected_loss_db: float = Field(12.0, ge=0.0, le=60.0)
    """Mean loss of such a signal; what falls under the mask is not used."""
    reflected_loss_sigma_db: float = Field(4.0, ge=0.0, le=20.0)
    """Sigma of that loss."""
    believed_reflection_m: float = Field(2.0, ge=0.0, le=1e3)
    """What the receiver believes of reflections: sigma at 45 dB Hz, in its weights and its covariance; tenfold for 20 dB less. 0 for one that counts on signals in sight alone."""  # noqa: E501
    weighting: Literal["plain", "huber", "cauchy"] = "huber"
    """Weights of the solution: by elevation and C/N0, and by Huber's or Cauchy's function of residuals."""
    fault_exclusion: Literal["none", "residuals"] = "residuals"
    """Whether residuals are tested and satellites excluded."""
    false_alarm: float = Field(1e-3, ge=1e-9, le=0.5)
    """Probability of a test of residuals to fail without a fault."""
    max_pdop: float = Field(20.0, ge=1.0, le=1e6)
    """Position dilution of precision above which there is no fix."""
    integrity: Literal["none", "araim"] = "none"
    """Whether receivers compute protection levels, of plain positions of the signals that they trust (docs/integrity.md)."""  # noqa: E501
    p_hmi: float = Field(1e-3, ge=1e-9, le=0.1)
    """Protection levels: probability that the error of a fix leaves one of them without an alarm."""
    prior_reflected: float = Field(0.7, ge=0.0, le=0.99)
    """Protection levels: chance that a signal on the horizon is a reflection alone, before its C/N0 is known; it falls with the angle to 0 in the zenith."""  # noqa: E501
    p_satellite: float = Field(1e-5, ge=0.0, le=0.1)
    """Protection levels: chance that a satellite is faulty."""
    barometer: Literal["none", "offset"] = "none"
    """Whether each UAV has a barometer too, with an offset that the filter learns from the receiver's heights and then keeps the height by where no fix comes."""  # noqa: E501
    barometer_weather_m: float = Field(8.0, ge=0.0, le=1e4)
    """Barometer: sigma of the offset by the weather, the same for all UAVs (8 m are 1 hPa)."""
    barometer_weather_time_s: float = Field(10_800.0, ge=1.0, le=1e7)
    """Barometer: correlation time of that offset."""
    barometer_drift_m: float = Field(1.0, ge=0.0, le=1e3)
    """Barometer: sigma of each sensor's own offset."""
    barometer_drift_time_s: float = Field(300.0, ge=1.0, le=1e7)
    """Barometer: correlation time of that offset."""
    barometer_noise_m: float = Field(0.1, ge=1e-3, le=100.0)
    """Barometer: sigma of its white noise, at each epoch of fixes."""
    filter_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] = 2.0
    """Filter: correlation time that it assumes of the error but for what UAVs have in common, which lasts."""
    filter_correlation_length_m: float = Field(5.0, ge=0.1, le=1e4)
    """Point-mass filter: way of a UAV over which the error changes, if that takes longer than ``filter_correlation_time_s``."""  # noqa: E501
    filter_standing_time_s: float = Field(60.0, ge=0.1, le=1e6)
    """Point-mass filter: correlation time that it assumes of the error of a UAV that stands."""
    credit: str = Field("", max_length=500)
    """Source and licence, printed on every figure."""

    @field_validator("start_gps_time")
    @classmethod
    def _a_moment(cls, text: str) -> str:
        try:
            moment = dt.datetime.fromisoformat(text)
        except ValueError:
            moment = None
        if moment is None or moment.tzinfo is not None or not 1981 <= moment.year <= 2100:
            raise ValueError('must be GPS time such as "2023-07-11T06:30:00", without a zone, 1981 to 2100')
        return text

    @model_validator(mode="after")
    def _own_share(self) -> Gnss:
        if self.common_mode_share != 0.0:
            raise ValueError("common_mode_share must be left out: it follows from the satellites in common")
        if (self.origin_latitude_deg is None) != (self.origin_longitude_deg is None):
            raise ValueError("origin_latitude_deg and origin_longitude_deg go together: give both or none")
        if self.barometer != "none" and self.filter == "none":
            raise ValueError(
                f'barometer = "{self.barometer}", but filter = "none": it takes one to learn its offset; set '
                'filter = "point_mass" or "kalman", or leave the barometer out'
            )
        if self.file is None and set(self.systems) == {"QZSS"}:
            raise ValueError("systems: QZSS is in files only; name one, or receive GPS or Galileo")
        return self


Navigation = Annotated[GaussMarkov | ConstantBias | Recorded | Gnss, Field(discriminator="kind")]
