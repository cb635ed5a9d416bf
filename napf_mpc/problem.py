"""The problem: who flies where among what, with which navigation. Pure data and its validation.

A problem is read from TOML by :func:`napf_mpc.problem_file.load_problem`. Every key carries its unit, is
limited to a range in which the equations make sense, and has a default unless it says who flies where
among what. Unknown keys, text for numbers and numbers that are not finite are refused.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

__all__ = [
    "BoxObstacle",
    "Circle",
    "City",
    "ConstantBias",
    "CylinderObstacle",
    "EmptyWorld",
    "Forest",
    "Formation",
    "FormationMission",
    "GaussMarkov",
    "Gnss",
    "GoalMission",
    "InitialPosition",
    "Lanes",
    "Line",
    "Listed",
    "Mission",
    "MovingCylinder",
    "MovingObstacle",
    "MovingSphere",
    "Navigation",
    "ObstacleItem",
    "ObstacleList",
    "Planner",
    "PrismObstacle",
    "Problem",
    "Recorded",
    "Reference",
    "Scatter",
    "Simulation",
    "SphereObstacle",
    "Square",
    "StreetCanyon",
    "Vee",
    "Vehicle",
    "World",
]

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Point2 = tuple[Coordinate, Coordinate]
Point3 = tuple[Coordinate, Coordinate, Coordinate]
Speed = Annotated[float, Field(ge=-100.0, le=100.0)]
Velocity2 = tuple[Speed, Speed]
Velocity3 = tuple[Speed, Speed, Speed]
InitialPosition = Point3
Size = Annotated[float, Field(ge=0.01, le=1e5)]
Inertia = Annotated[float, Field(ge=1e-6, le=1e3)]
StateWeight = Annotated[float, Field(ge=0.0, le=1e6)]
InputWeight = Annotated[float, Field(ge=1e-6, le=1e6)]
Count = Annotated[int, Field(ge=0, le=1_000_000)]
MAX_UAVS = 4096
MAX_FIXES = 20_000_000
"""Position fixes of all UAVs in one run: about a gigabyte of errors, drawn before the run starts."""


class _Section(BaseModel):
    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        validate_default=True,
    )


def _ordered(low_high: tuple[float, float]) -> tuple[float, float]:
    if low_high[0] > low_high[1]:
        raise ValueError(f"must be [low, high] with low <= high, got [{low_high[0]:g}, {low_high[1]:g}]")
    return low_high


# ---------------------------------------------------------------------------------------------- vehicle


class Vehicle(_Section):
    """Quadrotor, its rotors and its LQR (Eq. 1-13). Defaults are the paper's."""

    mass_kg: float = Field(1.0, ge=0.01, le=1000.0)
    """Mass."""
    inertia_kgm2: tuple[Inertia, Inertia, Inertia] = (8.1e-3, 8.1e-3, 14.2e-3)
    """Moments of inertia about the body's x, y, z axes."""
    arm_m: float = Field(0.24, ge=0.01, le=10.0)
    """Distance from the centre to a rotor; not printed in the paper, enters only the mixer."""
    lift_coefficient: float = Field(54.2e-6, ge=1e-9, le=1.0)
    """Rotor thrust over squared speed [N s^2]."""
    drag_coefficient: float = Field(4.2e-6, ge=1e-10, le=1.0)
    """Rotor drag torque over squared speed [N m s^2]."""
    thrust_to_weight: float = Field(2.2, ge=1.05, le=20.0)
    """Largest total thrust over weight; each rotor gives a quarter of it at most and zero at least."""
    radius_m: float = Field(0.3, ge=0.0, le=10.0)
    """Radius of the ball that holds the UAV, for clearance and collision."""
    min_separation_m: float = Field(0.6, ge=0.0, le=100.0)
    """Centre distance under which two UAVs count as in contact."""
    lqr_q_diagonal: tuple[
        StateWeight, StateWeight, StateWeight, StateWeight, StateWeight, StateWeight,
        StateWeight, StateWeight, StateWeight, StateWeight, StateWeight, StateWeight,
    ] = (0.1,) * 12  # fmt: skip
    """Diagonal of Q (Eq. 12), in the order of the state (Eq. 1)."""
    lqr_r_diagonal: tuple[InputWeight, InputWeight, InputWeight, InputWeight] = (0.1, 10.0, 100.0, 10.0)
    """Diagonal of R (Eq. 12), in the order of the input (Eq. 2)."""
    max_velocity_error_mps: float = Field(2.0, ge=0.1, le=100.0)
    """Largest velocity error that the LQR is shown; a larger one would tumble the UAV."""
    max_position_error_m: float = Field(1.5, ge=0.1, le=1000.0)
    """Largest position error that the LQR is shown."""


# -------------------------------------------------------------------------------------------- formation


class _FormationBase(_Section):
    sync_gain: float = Field(-0.5, ge=-5.0, le=0.0)
    """k_f of Eq. 18 [1/s]: a UAV that is ahead of its slot slows down."""


class Square(_FormationBase):
    """The paper's square of four, turned so that no UAV flies in another's track (Eq. 15, 17)."""

    shape: Literal["square"]
    """Name of the shape."""
    side_m: float = Field(10.0, ge=0.1, le=1e4)
    """Side s of the square."""
    first_lane_m: float = Field(3.0, ge=0.0, le=1e4)
    """Lateral place of UAV 1 (UAV 2 mirrors it); at most side / sqrt(2)."""

    @model_validator(mode="after")
    def _lane_inside_square(self) -> Square:
        limit = self.side_m / math.sqrt(2.0)
        if self.first_lane_m > limit:
            raise ValueError(f"first_lane_m = {self.first_lane_m:g} must be <= side_m / sqrt(2) = {limit:g}")
        return self


class Line(_FormationBase):
    """UAVs on a straight line through the formation's centre."""

    shape: Literal["line"]
    """Name of the shape."""
    count: int = Field(4, ge=1, le=MAX_UAVS)
    """Number of UAVs."""
    spacing_m: float = Field(5.0, ge=0.1, le=1e4)
    """Distance between neighbours."""
    bearing_deg: float = Field(90.0, ge=-180.0, le=180.0)
    """Angle of the line from the path: 90 abreast, 0 in file."""


class Vee(_FormationBase):
    """UAVs on a V, the leader in front."""

    shape: Literal["v"]
    """Name of the shape."""
    count: int = Field(5, ge=1, le=MAX_UAVS)
    """Number of UAVs."""
    spacing_m: float = Field(5.0, ge=0.1, le=1e4)
    """Distance between neighbours along an arm."""
    opening_deg: float = Field(90.0, ge=10.0, le=170.0)
    """Angle between the arms."""


class Circle(_FormationBase):
    """UAVs evenly on a horizontal circle."""

    shape: Literal["circle"]
    """Name of the shape."""
    count: int = Field(6, ge=1, le=MAX_UAVS)
    """Number of UAVs."""
    radius_m: float = Field(8.0, ge=0.1, le=1e4)
    """Radius of the circle."""
    phase_deg: float = Field(0.0, ge=-360.0, le=360.0)
    """Angle of UAV 1 from the path direction, to the left."""


class Listed(_FormationBase):
    """Any offsets."""

    shape: Literal["list"]
    """Name of the shape."""
    offsets_m: Annotated[tuple[Point3, ...], Field(min_length=1, max_length=MAX_UAVS)]
    """Offset of each UAV: along the path, to its left, up. The mean along the path is taken out."""


Formation = Annotated[Square | Line | Vee | Circle | Listed, Field(discriminator="shape")]


# ---------------------------------------------------------------------------------------------- mission


class FormationMission(_Section):
    """Fly the formation along a straight path."""

    kind: Literal["formation"] = "formation"
    """Kind of mission."""
    length_m: float = Field(ge=1.0, le=1e5)
    """Along-track distance from the path's start that every UAV has to pass."""
    speed_mps: float = Field(2.0, ge=0.05, le=50.0)
    """Reference speed V_r."""
    heading_deg: float = Field(0.0, ge=-360.0, le=360.0)
    """Direction of the path, counter-clockwise from east (+x)."""
    climb_deg: float = Field(0.0, ge=-45.0, le=45.0)
    """Climb angle of the path."""
    start_m: Point3 = (0.0, 0.0, 0.0)
    """Start of the path: east, north, up."""
    initial_positions_m: tuple[Point3, ...] | None = None
    """Where each UAV starts (east, north, up); by default in its slot."""
    initial_velocities_mps: tuple[Velocity3, ...] | None = None
    """Velocity each UAV starts with; by default zero."""
    reform_bound_m: float = Field(2.0, ge=0.01, le=1e3)
    """Shape error under which the formation counts as re-formed."""


class GoalMission(_Section):
    """One UAV as a point walks to a goal by the traditional potential field (Eq. 23-35), in the plane."""

    kind: Literal["goal"]
    """Kind of mission."""
    start_m: Point2
    """Start: east, north."""
    goal_m: Point2
    """Goal: east, north."""
    step_m: float = Field(0.02, ge=1e-4, le=10.0)
    """Length gamma of one step (Eq. 35)."""
    attractive_gain: float = Field(2.5, ge=0.0, le=1e6)
    """k_a of Eq. 25."""
    arrival_m: float = Field(0.1, ge=1e-3, le=1e3)
    """Distance to the goal that counts as arrived."""
    max_steps: int = Field(5000, ge=1, le=1_000_000)
    """Steps after which the walk is given up."""

    @model_validator(mode="after")
    def _reachable(self) -> GoalMission:
        if self.arrival_m < self.step_m / 2:
            raise ValueError(f"arrival_m = {self.arrival_m:g} must be >= step_m / 2 = {self.step_m / 2:g}")
        return self


Mission = Annotated[FormationMission | GoalMission, Field(discriminator="kind")]


# ------------------------------------------------------------------------------------------------ world


class SphereObstacle(_Section):
    """A ball."""

    shape: Literal["sphere"]
    """Name of the shape."""
    centre_m: Point3
    """Centre: east, north, up."""
    radius_m: Size
    """Radius."""


class CylinderObstacle(_Section):
    """A vertical cylinder; without base and top it has no end."""

    shape: Literal["cylinder"]
    """Name of the shape."""
    centre_m: Point2
    """Axis: east, north."""
    radius_m: Size
    """Radius."""
    base_m: Coordinate | None = None
    """Height of the base; by default the cylinder has none."""
    top_m: Coordinate | None = None
    """Height of the top; by default the cylinder has none."""

    @model_validator(mode="after")
    def _upright(self) -> CylinderObstacle:
        if self.base_m is not None and self.top_m is not None and self.top_m <= self.base_m:
            raise ValueError(f"top_m = {self.top_m:g} must be > base_m = {self.base_m:g}")
        return self


class BoxObstacle(_Section):
    """A box with vertical sides."""

    shape: Literal["box"]
    """Name of the shape."""
    centre_m: Point3
    """Centre: east, north, up."""
    size_m: tuple[Size, Size, Size]
    """Length, width, height."""
    heading_deg: float = Field(0.0, ge=-360.0, le=360.0)
    """Direction of its length, counter-clockwise from east."""


class PrismObstacle(_Section):
    """A polygon pulled up from base to top."""

    shape: Literal["prism"]
    """Name of the shape."""
    footprint_m: Annotated[tuple[Point2, ...], Field(min_length=3, max_length=10_000)]
    """Corners: east, north."""
    base_m: Coordinate = 0.0
    """Height of the base."""
    top_m: Coordinate
    """Height of the top."""

    @model_validator(mode="after")
    def _solid(self) -> PrismObstacle:
        if self.top_m <= self.base_m:
            raise ValueError(f"top_m = {self.top_m:g} must be > base_m = {self.base_m:g}")
        x, y = zip(*self.footprint_m, strict=True)
        twice_area = sum(x[i - 1] * y[i] - x[i] * y[i - 1] for i in range(len(x)))
        if abs(twice_area) < 1e-6:
            raise ValueError("footprint_m must enclose an area; its corners lie on one line")
        return self


ObstacleItem = Annotated[
    SphereObstacle | CylinderObstacle | BoxObstacle | PrismObstacle, Field(discriminator="shape")
]


class _Moving(_Section):
    acceleration_sigma_mps2: float = Field(0.0, ge=0.0, le=20.0)
    """Sigma of its true acceleration on each axis, drawn anew every second; 0 moves evenly and straight."""


class MovingSphere(_Moving):
    """A ball that moves."""

    shape: Literal["sphere"]
    """Name of the shape."""
    start_m: Point3
    """Centre at the start of the mission: east, north, up."""
    velocity_mps: Velocity3
    """Velocity at the start: east, north, up."""
    radius_m: Size
    """Radius."""


class MovingCylinder(_Moving):
    """A vertical cylinder without ends that moves in the plane: a vehicle that nobody may fly over."""

    shape: Literal["cylinder"]
    """Name of the shape."""
    start_m: Point2
    """Axis at the start of the mission: east, north."""
    velocity_mps: Velocity2
    """Velocity at the start: east, north."""
    radius_m: Size
    """Radius."""


MovingObstacle = Annotated[MovingSphere | MovingCylinder, Field(discriminator="shape")]


class _WorldBase(_Section):
    moving: Annotated[tuple[MovingObstacle, ...], Field(max_length=1000)] = ()
    """Moving obstacles, the same in every run but for their accelerations; they pass through everything."""
    moving_sigma_m: float = Field(0.2, ge=1e-3, le=1e3)
    """Sigma of an observation of a moving obstacle's centre on each axis, white."""
    moving_rate_hz: float = Field(10.0, ge=0.1, le=100.0)
    """Rate at which moving obstacles are observed, all of them each time."""
    moving_acceleration_sigma_mps2: float = Field(0.3, ge=0.0, le=20.0)
    """Acceleration that the tracker assumes of moving obstacles, drawn anew every second on each axis."""


class EmptyWorld(_WorldBase):
    """Nothing to hit."""

    kind: Literal["empty"]
    """Kind of world."""


class ObstacleList(_WorldBase):
    """Obstacles one by one."""

    kind: Literal["list"]
    """Kind of world."""
    obstacles: Annotated[tuple[ObstacleItem, ...], Field(max_length=100_000)]
    """The obstacles."""


class _RandomWorld(_WorldBase):
    count: Count
    """Number of obstacles."""
    radius_m: tuple[Size, Size] = (0.5, 2.0)
    """Smallest and largest radius, uniform between."""
    shape: Literal["sphere", "cylinder"] = "sphere"
    """Balls, or vertical cylinders without top (no fly-over)."""

    _radius_ordered = field_validator("radius_m")(_ordered)


class Lanes(_RandomWorld):
    """Obstacles on the formation's lanes, one in each along-track stratum (the paper's 8)."""

    kind: Literal["lanes"]
    """Kind of world."""
    count: Annotated[int, Field(ge=0, le=100_000)] = 8
    """Number of obstacles, one a stratum."""
    along_range_m: tuple[Coordinate, Coordinate] = (20.0, 100.0)
    """Along-track range, cut into ``count`` strata."""
    lane_jitter_m: float = Field(1.0, ge=0.0, le=1e4)
    """Largest lateral distance from the lane, uniform."""
    height_jitter_m: float = Field(1.0, ge=0.0, le=1e4)
    """Largest vertical distance from the path, uniform."""

    _range_ordered = field_validator("along_range_m")(_ordered)


class Scatter(_RandomWorld):
    """Obstacles anywhere in a box, with a least gap between them (the paper's 40)."""

    kind: Literal["scatter"]
    """Kind of world."""
    count: Annotated[int, Field(ge=0, le=100_000)] = 40
    """Number of obstacles."""
    along_range_m: tuple[Coordinate, Coordinate] = (20.0, 110.0)
    """Along-track range of the centres."""
    lateral_range_m: tuple[Coordinate, Coordinate] = (-20.0, 20.0)
    """Lateral range of the centres."""
    height_range_m: tuple[Coordinate, Coordinate] = (-3.0, 3.0)
    """Vertical range of the centres about the path."""
    min_gap_m: float = Field(2.0, ge=0.0, le=1e4)
    """Least gap between two surfaces, in the horizontal plane."""

    _range_ordered = field_validator("along_range_m", "lateral_range_m", "height_range_m")(_ordered)


class Forest(_WorldBase):
    """Tree trunks as vertical cylinders, at least a gap apart."""

    kind: Literal["forest"]
    """Kind of world."""
    count: Annotated[int, Field(ge=0, le=100_000)] = 120
    """Number of trees."""
    radius_m: tuple[Size, Size] = (0.2, 0.6)
    """Smallest and largest trunk radius."""
    tree_height_m: tuple[Size, Size] = (8.0, 20.0)
    """Smallest and largest height above ground."""
    ground_m: Coordinate = 0.0
    """Height of the ground."""
    along_range_m: tuple[Coordinate, Coordinate] = (20.0, 110.0)
    """Along-track range of the trees."""
    lateral_range_m: tuple[Coordinate, Coordinate] = (-30.0, 30.0)
    """Lateral range of the trees."""
    min_gap_m: float = Field(3.0, ge=0.0, le=1e4)
    """Least gap between two trunks."""

    _ranges_ordered = field_validator("radius_m", "tree_height_m", "along_range_m", "lateral_range_m")(
        _ordered
    )


class StreetCanyon(_WorldBase):
    """A synthetic street: buildings of random size on both sides, masts in it."""

    kind: Literal["street_canyon"]
    """Kind of world."""
    street_width_m: float = Field(40.0, ge=2.0, le=1e3)
    """Width between the building lines."""
    building_length_m: tuple[Size, Size] = (15.0, 40.0)
    """Smallest and largest length of a front along the street."""
    building_height_m: tuple[Size, Size] = (15.0, 60.0)
    """Smallest and largest height of a building."""
    building_depth_m: float = Field(20.0, ge=1.0, le=1e3)
    """Depth of a building away from the street."""
    setback_m: float = Field(6.0, ge=0.0, le=1e3)
    """Fronts stand between the building line and this far *into* the street, uniform."""
    gap_m: float = Field(4.0, ge=0.0, le=1e3)
    """Gap between two buildings."""
    along_range_m: tuple[Coordinate, Coordinate] = (15.0, 115.0)
    """Along-track range of the street."""
    ground_m: Coordinate = 0.0
    """Height of the ground."""
    mast_count: Annotated[int, Field(ge=0, le=10_000)] = 6
    """Masts that stand in the street."""
    mast_radius_m: tuple[Size, Size] = (0.2, 0.5)
    """Smallest and largest radius of a mast."""
    mast_height_m: tuple[Size, Size] = (30.0, 60.0)
    """Smallest and largest height of a mast."""

    _ranges_ordered = field_validator(
        "building_length_m", "building_height_m", "along_range_m", "mast_radius_m", "mast_height_m"
    )(_ordered)


class City(_WorldBase):
    """Buildings from a file: GeoJSON footprints with heights, or CityJSON LoD1."""

    kind: Literal["city"]
    """Kind of world."""
    file: str = Field(min_length=1, max_length=1000)
    """Path under the data folder; ``.geojson``, or ``.json`` / ``.city.json`` for CityJSON."""
    origin_latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    """Latitude of the local frame's origin (GeoJSON; by default the middle of the buildings)."""
    origin_longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    """Longitude of the local frame's origin (GeoJSON)."""
    origin_m: Point3 | None = None
    """Origin in the file's own projected coordinates (CityJSON; by default the middle of the buildings)."""
    height_property: str = Field("height_m", min_length=1, max_length=200)
    """GeoJSON property that holds the height above ground."""
    min_height_m: float = Field(0.0, ge=0.0, le=1e4)
    """Buildings lower than this are left out (a formation that flies above them needs none)."""
    radius_m: float = Field(5000.0, ge=1.0, le=1e5)
    """Buildings farther than this from the origin are left out."""
    credit: str = Field("", max_length=500)
    """Source and licence, printed on every figure."""

    @model_validator(mode="after")
    def _both(self) -> City:
        if (self.origin_latitude_deg is None) != (self.origin_longitude_deg is None):
            raise ValueError("origin_latitude_deg and origin_longitude_deg go together: give both or none")
        return self


World = Annotated[
    EmptyWorld | ObstacleList | Lanes | Scatter | Forest | StreetCanyon | City, Field(discriminator="kind")
]


# ------------------------------------------------------------------------------------------- navigation


class _NavigationBase(_Section):
    rate_hz: float = Field(10.0, ge=0.1, le=100.0)
    """Rate of position fixes; each error is held between."""
    filter: Literal["none", "kalman"] = "none"
    """Navigation filter between the fixes and the planner."""
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
    """Filter: whether its normalised innovations are watched and reported sigmas that are too small scaled (docs/integrity.md)."""  # noqa: E501
    filter_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """Filter: correlation time that it assumes of the fix's error; by default the error's own."""
    filter_coast_sigma_m: float = Field(10.0, ge=1e-3, le=1e4)
    """Filter: without a fix, the solution counts as available up to this sigma of an axis."""


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
    """Path of the truth that positions are compared with, in the same time system; a ``.csv`` needs none."""
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
    """RINEX 3 navigation file under the data folder; by default a nominal GPS and Galileo constellation."""
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
    filter_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] = 2.0
    """Filter: correlation time that it assumes of the error but for what UAVs have in common, which lasts."""
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
        if self.file is None and set(self.systems) == {"QZSS"}:
            raise ValueError("systems: QZSS is in files only; name one, or receive GPS or Galileo")
        return self


Navigation = Annotated[GaussMarkov | ConstantBias | Recorded | Gnss, Field(discriminator="kind")]


# ------------------------------------------------------------------------------- planner and simulation


class Planner(_Section):
    """The planner and its potential field (Eq. 23-39, section 3.2)."""

    kind: Literal["apf", "napf", "napf_guided", "qp", "qp_unguided"] = "napf"
    """Planner that ``run`` flies unless told otherwise."""
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
    cohesion: float = Field(0.86, ge=0.0, le=0.95)
    """QP planner: share of the UAVs' mean sideways deviation that each is drawn along with."""
    velocity_weight: float = Field(4.0, ge=0.0, le=1e6)
    """QP planner: weight of the velocity error [s/m^2]."""
    attitude_weight: float = Field(1.0, ge=0.0, le=1e6)
    """QP planner: weight of roll, pitch and yaw error [1/(rad^2 s)]; a fifth of it on body rates."""
    thrust_weight: float = Field(80.0, ge=1e-9, le=1e6)
    """QP planner: weight of the thrust about hover [1/(N^2 s)]."""
    torque_weight: float = Field(600.0, ge=1e-9, le=1e6)
    """QP planner: weight of the torques [1/(N^2 m^2 s)]."""
    contact_price: float = Field(300.0, ge=0.0, le=1e9)
    """QP planner: linear price of being inside an obstacle's or a neighbour's margin [1/(m s)]."""
    margin: Literal["half_space", "passage"] = "half_space"
    """QP planner: margin beside spheres: k sigma as behind a wall, or what makes a hit in passing as likely as there, which is less."""  # noqa: E501
    contact_extra_m: float = Field(0.75, ge=0.0, le=1e3)
    """QP planner: distance kept from obstacles on top of the margin, at most."""
    contact_extra_sigmas: float = Field(0.95, ge=0.0, le=1e3)
    """QP planner: distance on top of the margin in sigmas; at most ``contact_extra_m``."""
    altitude_m: tuple[Coordinate, Coordinate] | None = None
    """QP planner: least and largest height to fly at; none by default."""
    influence_scale: float = Field(0.01, ge=1e-9, le=1e6)
    """QP planner: price per metre and second for each m/s of NAPF's repulsion."""
    k: Annotated[float, Field(ge=0.0, le=20.0)] | None = None
    """Inflation in reported sigmas; 3 unless ``confidence`` is given."""
    confidence: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Two-sided probability from which k follows: k = sqrt(2) erfinv(confidence)."""
    risk_per_mission: Annotated[float, Field(ge=1e-9, le=0.5)] | None = None
    """Chance that any UAV touches an obstacle in a mission, from which k follows (docs/risk_budget.md)."""
    active_time_s: float = Field(15.0, ge=0.1, le=3600.0)
    """With ``risk_per_mission``: time for which each UAV has an obstacle at its margin, in all."""
    risk_correlation_time_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """With ``risk_per_mission``: correlation time of the position's error; by default navigation's own."""
    covariance: Literal["held", "expected", "propagated"] = "expected"
    """QP planner: over the horizon, the covariance reported now; what the filter expects if fixes go on as now; or if none comes any more. Guidance leaves room for what is expected at the horizon's end, or for the one now."""  # noqa: E501
    inflation: Literal["shift", "range"] = "shift"
    """k sigma shifts the distance to the obstacle, or only widens the range of influence."""
    sigma: Literal["directional", "largest", "rms", "chi2"] = "directional"
    """Which sigma: along the gradient, the largest axis, the root mean square; chi2 = directional with k from the 3-D chi-square law."""  # noqa: E501

    safety: Literal["k_sigma", "overbound", "protection_level"] = "k_sigma"
    """What drives the safety distance: k reported sigmas; k sigmas of the reported law's overbound; or the protection level, whatever k is (docs/integrity.md)."""  # noqa: E501

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


class Simulation(_Section):
    """Rates and limits of the closed loop."""

    time_limit_s: float = Field(110.0, ge=0.1, le=3600.0)
    """Mission time after which a run is over."""
    step_s: float = Field(0.02, ge=0.001, le=0.02)
    """Step of the RK4 integration; the truth is swept between steps."""
    controller_rate_hz: float = Field(50.0, ge=10.0, le=1000.0)
    """Rate of the inner loop (LQR)."""


class Reference(_Section):
    """Published figures that a comparison prints beside its own."""

    source: str = Field(min_length=1, max_length=500)
    """Where they were published."""
    runs: int = Field(ge=1, le=1_000_000_000)
    """Runs behind them."""
    collision_risk: dict[
        Literal["apf", "napf", "napf_guided", "qp", "qp_unguided"], Annotated[float, Field(ge=0.0, le=1.0)]
    ]
    """Planner -> published collision risk."""
    note: str = Field("", max_length=1000)
    """What may and may not be concluded."""


class Problem(_Section):
    """A whole problem file."""

    title: str = Field("", max_length=200)
    """One line for lists."""
    description: str = Field("", max_length=10_000)
    """What the problem is for."""
    source: str = Field("", max_length=2000)
    """Where its numbers come from."""
    vehicle: Vehicle = Vehicle()
    """The UAV."""
    formation: Formation
    """Who flies."""
    mission: Mission
    """Where to."""
    world: World
    """Among what."""
    navigation: Navigation = GaussMarkov()
    """With which navigation."""
    planner: Planner = Planner()
    """How it avoids."""
    simulation: Simulation = Simulation()
    """How it is simulated."""
    reference: Reference | None = None
    """Published figures to print beside the results."""

    @property
    def uav_count(self) -> int:
        """Number of UAVs."""
        match self.formation:
            case Square():
                return 4
            case Listed():
                return len(self.formation.offsets_m)
            case _:
                return self.formation.count

    def digest(self) -> str:
        """SHA-256 of everything that decides a result; words and the reference do not count."""
        words = {"title", "description", "source", "reference"}
        return hashlib.sha256(self.model_dump_json(exclude=words).encode()).hexdigest()

    @model_validator(mode="after")
    def _consistent(self) -> Problem:
        faults = [
            *self._initial_faults(), *self._rate_faults(), *self._size_faults(), *self._safety_faults()
        ]  # fmt: skip
        if isinstance(self.mission, GoalMission) and self.uav_count != 1:
            faults.append(f"formation has {self.uav_count} UAVs, a mission of kind goal needs exactly 1")
        if isinstance(self.mission, GoalMission) and self.planner.kind != "apf":
            faults.append(
                f'planner.kind = "{self.planner.kind}", a mission of kind goal is flown by "apf" only'
            )
        if isinstance(self.mission, GoalMission) and self.world.moving:
            faults.append("world.moving: a mission of kind goal is a walk without time; leave it out")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _initial_faults(self) -> list[str]:
        if isinstance(self.mission, GoalMission):
            return []
        faults = []
        for key in ("initial_positions_m", "initial_velocities_mps"):
            rows = getattr(self.mission, key)
            if rows is not None and len(rows) != self.uav_count:
                faults.append(f"mission.{key} has {len(rows)} rows, the formation has {self.uav_count} UAVs")
        return faults

    def _safety_faults(self) -> list[str]:
        """What is to drive the safety distance must be told by navigation."""
        navigation = self.navigation
        if navigation.monitor != "none" and navigation.filter == "none":
            return [
                f'navigation.monitor = "{navigation.monitor}" watches a filter\'s innovations: set '
                'navigation.filter = "kalman"'
            ]
        if self.planner.safety == "overbound":
            if not isinstance(navigation, Recorded):
                return [
                    f'planner.safety = "overbound": navigation.kind = "{navigation.kind}" has no log to fit '
                    'one to; use kind = "recorded", or safety = "k_sigma"'
                ]
            if navigation.part == "all":
                return [
                    'planner.safety = "overbound" is fitted to the half of the log that is not flown: set '
                    'navigation.part = "first_half" or "second_half"'
                ]
        if self.planner.safety == "protection_level" and navigation.filter != "none":
            return [
                'planner.safety = "protection_level" bounds the error of fixes, not of a filter\'s estimate: '
                'set navigation.filter = "none", or safety = "k_sigma"'
            ]
        return []

    def _size_faults(self) -> list[str]:
        """Each of these may be large, but not all of them at once."""
        limit_s, rate_hz = self.simulation.time_limit_s, self.navigation.rate_hz
        fixes = self.uav_count * limit_s * rate_hz
        if isinstance(self.mission, GoalMission) or fixes <= MAX_FIXES:
            return []
        return [
            f"{self.uav_count} UAVs, simulation.time_limit_s = {limit_s:g}, navigation.rate_hz = {rate_hz:g}"
            f" make {fixes:.3g} position fixes a run, must be <= {MAX_FIXES:.3g}: lower one of the three"
        ]

    def _rate_faults(self) -> list[str]:
        """Each slower rate must divide the faster one, so that every loop is a whole number of steps."""
        faults = []
        controller_hz = self.simulation.controller_rate_hz
        rates = [
            ("simulation.controller_rate_hz", 1.0 / self.simulation.step_s, controller_hz),
            ("planner.rate_hz", controller_hz, self.planner.rate_hz),
            ("navigation.rate_hz", controller_hz, self.navigation.rate_hz),
        ]
        if self.world.moving:
            rates.append(("world.moving_rate_hz", controller_hz, self.world.moving_rate_hz))
        for name, fast_hz, slow_hz in rates:
            ratio = fast_hz / slow_hz
            if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-6 * ratio:
                faults.append(f"{name} = {slow_hz:g} must divide {fast_hz:g} Hz a whole number of times")
        return faults
