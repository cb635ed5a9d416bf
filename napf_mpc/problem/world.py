"""Keys of ``[world]``: obstacles given one by one, drawn at random, or of a city."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from napf_mpc.problem.section import (
    Coordinate,
    Count,
    Point2,
    Point3,
    Section,
    Size,
    Velocity2,
    Velocity3,
    ordered,
)


class SphereObstacle(Section):
    """A ball."""

    shape: Literal["sphere"]
    """Name of the shape."""
    centre_m: Point3
    """Centre: east, north, up."""
    radius_m: Size
    """Radius."""


class CylinderObstacle(Section):
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


class BoxObstacle(Section):
    """A box with vertical sides."""

    shape: Literal["box"]
    """Name of the shape."""
    centre_m: Point3
    """Centre: east, north, up."""
    size_m: tuple[Size, Size, Size]
    """Length, width, height."""
    heading_deg: float = Field(0.0, ge=-360.0, le=360.0)
    """Direction of its length, counter-clockwise from east."""


class PrismObstacle(Section):
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
        from shapely import LinearRing  # slow to load, and few problems have prisms of their own

        x, y = zip(*self.footprint_m, strict=True)
        twice_area = sum(x[i - 1] * y[i] - x[i] * y[i - 1] for i in range(len(x)))
        if abs(twice_area) < 1e-6:
            raise ValueError(
                "footprint_m must enclose an area; its corners lie on one line, or what they enclose cancels"
            )
        if not LinearRing(self.footprint_m).is_simple:
            raise ValueError("footprint_m crosses or touches itself; list its corners in order around it")
        return self


ObstacleItem = Annotated[
    SphereObstacle | CylinderObstacle | BoxObstacle | PrismObstacle, Field(discriminator="shape")
]


class _Moving(Section):
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


class _WorldBase(Section):
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

    _radius_ordered = field_validator("radius_m")(ordered)


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

    _range_ordered = field_validator("along_range_m")(ordered)


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

    _range_ordered = field_validator("along_range_m", "lateral_range_m", "height_range_m")(ordered)


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
        ordered
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
    )(ordered)


_Projected = Annotated[float, Field(ge=-1e8, le=1e8)]  # northings of UTM go to 1e7, zoned eastings to 6e7


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
    origin_m: tuple[_Projected, _Projected, _Projected] | None = None
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
