"""Keys of ``[simulation]`` and ``[reference]``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from napf_mpc.problem.section import Section


class Simulation(Section):
    """Rates and limits of the closed loop."""

    time_limit_s: float = Field(110.0, ge=0.1, le=3600.0)
    """Mission time after which a run is over."""
    step_s: float = Field(0.02, ge=0.001, le=0.02)
    """Step of the RK4 integration; the truth is swept between steps."""
    controller_rate_hz: float = Field(50.0, ge=10.0, le=1000.0)
    """Rate of the inner loop (LQR)."""


class Reference(Section):
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
