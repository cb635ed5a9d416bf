"""Keys of ``[planner]``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from napf_mpc.problem.section import Coordinate, Section


class Planner(Section):
    """The planner and its potential field (Eq. 23-39, section 3.2)."""

    kind: Literal["apf", "napf", "napf_guided", "qp", "qp_unguided"] = "napf"
    """Planner that commands for one planner fly unless told otherwise."""
    rate_hz: float = Field(10.0, ge=0.5, le=100.0)
    """Rate at which the planner is asked."""
    influence_m: float = Field(3.0, ge=0.01, le=1e3)
    """rho_0: the potential field acts inside this distance (Eq. 23)."""
    repulsive_gain: float = Field(15.0, ge=0.0, le=1e6)
    """k_r of Eq. 23 [m^4/s]."""
    min_distance_m: float = Field(0.1, ge=1e-3, le=1e2)
    """Distances below this count as this in Eq. 28: the force stays finite at contact."""
    max_turn_deg: float = Field(60.0, ge=0.0, le=90.0)
    """Largest turn of the commanded direction against the path (Eq. 39)."""
    min_speed_ratio: float = Field(0.2, ge=0.0, le=1.0)
    """Least synchronised reference speed over V_r."""
    max_speed_ratio: float = Field(1.5, ge=1.0, le=10.0)
    """Largest commanded speed over V_r."""
    guidance: Literal["none", "blended"] = "blended"
    """QP planner: whether references bend around what the formation cannot pass."""
    solver: str = Field("kernel", min_length=1, max_length=50)
    """QP planner: name of the solver."""
    horizon: int = Field(20, ge=2, le=100)
    """QP planner: stages N of the horizon; the first have the planner's period, later ones grow."""
    look_ahead_s: float = Field(6.5, ge=0.1, le=60.0)
    """QP planner: length of the horizon."""
    passes: int = Field(1, ge=1, le=10)
    """QP planner: times that a step's programs are made linear at the last answer and solved."""
    obstacle_rows: int = Field(4, ge=1, le=50)
    """QP planner: nearest obstacles that each stage of each UAV keeps rows for, in each of two shells."""
    position_weight: float = Field(5.0, ge=1e-6, le=1e6)
    """QP planner: weight of the distance to the slot [1/(m^2 s)]."""
    cohesion: float = Field(0.87, ge=0.0, le=0.95)
    """QP planner: share of the UAVs' mean sideways deviation that each is drawn along with; behind a filter, or without guidance."""  # noqa: E501
    cohesion_room_m: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    """QP planner, with guidance and behind a filter: a UAV that has to pass something goes along with those that are farther out, where this far from its lane nothing is in the way, by default 3; with 0, only as far as its way is loose."""  # noqa: E501
    velocity_weight: float = Field(6.0, ge=0.0, le=1e6)
    """QP planner: weight of the velocity error [s/m^2]."""
    attitude_weight: float = Field(1.0, ge=0.0, le=1e6)
    """QP planner: weight of roll, pitch and yaw error [1/(rad^2 s)]; a fifth of it on body rates."""
    thrust_weight: Annotated[float, Field(ge=1e-9, le=1e6)] | None = None
    """QP planner: weight of the thrust about hover [1/(N^2 s)]; by default 60 for the paper's vehicle, and for others what prices the same acceleration alike."""  # noqa: E501
    torque_weight: Annotated[float, Field(ge=1e-9, le=1e6)] | None = None
    """QP planner: weight of the torques [1/(N^2 m^2 s)]; by default 600 for the paper's vehicle, and for others what prices the same angular acceleration alike."""  # noqa: E501
    contact_price: Annotated[float, Field(ge=0.0, le=1e9)] | None = None
    """QP planner: linear price of being inside an obstacle's or a neighbour's margin [1/(m s)]; by default 300, and for formations faster than 4 m/s, whose slots run away from who has to wait or turn, 3000 behind a filter and 1000 on raw measurements; for slower ones that of obstacles rises to the same where k sigma is less than 1.3 m."""  # noqa: E501
    tilt_thrust: bool | None = None
    """QP planner: whether thrust makes up for tilt, so that nobody sinks in sharp turns; by default for formations faster than 4 m/s."""  # noqa: E501
    margin: Literal["half_space", "passage"] = "half_space"
    """QP planner: margin beside spheres: k sigma as behind a wall, or what makes a hit in passing as likely as there, which is less."""  # noqa: E501
    contact_extra_m: float = Field(0.75, ge=0.0, le=1e3)
    """QP planner: distance kept from obstacles on top of the margin, at most."""
    contact_extra_sigmas: float = Field(0.95, ge=0.0, le=1e3)
    """QP planner: distance on top of the margin in sigmas; at most ``contact_extra_m``."""
    leaving_mps: Annotated[float, Field(ge=1e-3, le=100.0)] | None = None
    """QP planner: a UAV inside an obstacle's margin is asked to leave it no faster; by default 2 behind a filter, and 0.3 on raw measurements, which wander in and out of margins."""  # noqa: E501
    altitude_m: tuple[Coordinate, Coordinate] | None = None
    """QP planner: least and largest height to fly at; none by default."""
    descend_after_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = 30.0
    """A UAV that has held its place for this long for want of navigation, or of a plan, goes down at 0.5 m/s until something may be near below (docs/navigation.md); null, or a time longer than the mission, to hold for ever."""  # noqa: E501
    influence_scale: float = Field(0.01, ge=1e-9, le=1e6)
    """QP planner: price per metre and second for each m/s of NAPF's repulsion."""
    k: Annotated[float, Field(ge=0.0, le=20.0)] | None = None
    """Inflation in reported sigmas; 3 unless ``confidence`` or ``risk_per_mission`` is given."""
    confidence: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Two-sided probability from which k follows: k = sqrt(2) erfinv(confidence)."""
    risk_per_mission: Annotated[float, Field(ge=1e-9, le=0.5)] | None = None
    """Chance that any UAV touches an obstacle in a mission, from which k follows (docs/risk_budget.md)."""
    active_time_s: float = Field(15.0, ge=0.1, le=3600.0)
    """With ``risk_per_mission``: time for which each UAV has an obstacle at its margin, in all."""
    risk_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """With ``risk_per_mission``: correlation time of the position's error; by default navigation's own."""
    covariance: Literal["held", "expected", "mapped", "propagated"] = "expected"
    """QP planner: over the horizon, the covariance reported now; what the filter expects if fixes go on as now; with fixes as a sigma map has them at the planned places (navigation.kind "gnss"); or if none comes any more. Guidance leaves room for what is expected at the horizon's end, or for the one now."""  # noqa: E501
    open_sky_weight: float = Field(0.0, ge=0.0, le=10.0)
    """Guidance: price of a fix's variance as the sigma map expects it, its three axes together, in m^2 of squared offset from the lane for each m^2; 0 does not look at the sky. With covariance = "mapped"."""  # noqa: E501
    inflation: Literal["shift", "range"] = "shift"
    """k sigma shifts the distance to the obstacle, or only widens the range of influence."""
    sigma: Literal["directional", "largest", "rms", "chi2"] = "directional"
    """Which sigma: along the gradient, the largest axis, the root mean square; chi2 = directional with k from the 3-D chi-square law."""  # noqa: E501

    safety: Literal["k_sigma", "overbound", "protection_level"] = "k_sigma"
    """What drives the safety distance: k reported sigmas; k sigmas of the reported law's overbound; or the protection level, whatever k is (docs/integrity.md)."""  # noqa: E501

    @property
    def room_m(self) -> float:
        """``cohesion_room_m``, or its default; only looked for with guidance and behind a filter [m]."""
        return 3.0 if self.cohesion_room_m is None else self.cohesion_room_m

    @model_validator(mode="after")
    def _one_confidence(self) -> Planner:
        if self.k is not None and self.confidence is not None:
            raise ValueError("exactly one of k and confidence may be given, not both")
        if self.risk_per_mission is not None and not (self.k is None and self.confidence is None):
            rival = "confidence" if self.k is None else "k"
            raise ValueError(f"exactly one of {rival} and risk_per_mission may be given, not both")
        if self.risk_per_mission is not None and self.safety == "protection_level":
            raise ValueError(
                'safety = "protection_level" has its own risk: leave risk_per_mission out, or use k_sigma'
            )
        if self.sigma == "chi2" and self.confidence is None:
            raise ValueError('sigma = "chi2" needs confidence (k follows from it)')
        if self.confidence is not None and self.confidence > 1.0 - 1e-12:
            raise ValueError(f"confidence = {self.confidence!r} must be <= 1 - 1e-12")
        if self.altitude_m is not None and not self.altitude_m[0] < self.altitude_m[1]:
            low, high = self.altitude_m
            raise ValueError(f"altitude_m must be [low, high] with low < high, got [{low:g}, {high:g}]")
        if self.min_distance_m > self.influence_m:
            raise ValueError(
                f"min_distance_m = {self.min_distance_m:g} must be <= influence_m = {self.influence_m:g}"
            )
        return self
