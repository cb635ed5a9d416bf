"""Keys of ``[mission]``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from napf_mpc.problem.section import Point2, Point3, Section, Velocity3


class FormationMission(Section):
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


class GoalMission(Section):
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
