"""What all sections of a problem have in common: strictness, and ranges of numbers."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

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


class Section(BaseModel):
    """A table of keys; each key's docstring is its documentation."""

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        validate_default=True,
    )


def ordered(low_high: tuple[float, float]) -> tuple[float, float]:
    """Refuse a range whose ends are in the wrong order."""
    if low_high[0] > low_high[1]:
        raise ValueError(f"must be [low, high] with low <= high, got [{low_high[0]:g}, {low_high[1]:g}]")
    return low_high
