"""Keys of ``[formation]``: the slots of the virtual structure."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from napf_mpc.problem.section import MAX_UAVS, Point3, Section


class _FormationBase(Section):
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
