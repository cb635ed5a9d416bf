"""What a planner did in each run: solves by status, iterations, fall-backs, largest slack.

Of one without a solver, its descents.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.quadratic_program import QpStatus

Array = NDArray[np.float64]

COUNTED = tuple(status for status in QpStatus if status is not QpStatus.SKIPPED)
FALL_BACKS = ("tail", "hover", "descend")
"""What flew instead of a new plan, see :class:`napf_mpc.planners.fallback.Action`."""
COLUMNS = (
    *(f"solves_{status.value}" for status in COUNTED),
    "iterations",
    "answers_refused",
    *(f"fall_back_{name}" for name in FALL_BACKS),
    "margin_short",
)
"""Counts of a run, summed over UAVs and planner steps."""


@dataclass(frozen=True)
class Event:
    """One step down the ladder."""

    time_s: float
    """When [s]."""
    run: int
    """Run within the block."""
    uav: int
    """UAV."""
    cause: str
    """Why the new plan was refused."""
    action: str
    """What flies instead, a name of :data:`FALL_BACKS`, or what navigation did about its cause."""


@dataclass(frozen=True)
class Tally:
    """Counts of each run of a block."""

    counts: dict[str, NDArray[np.int64]]
    """Name of :data:`COLUMNS` -> (run,)."""
    largest_slack_m: Array
    """(run,) most that a flown plan is inside an obstacle's margin, NaN if none was asked for [m]."""

    events: list[Event] = field(default_factory=list)
    """Every time that a UAV took to a fall-back, or to another one, and every alarm of the navigation
    filter's monitor; runs count from the block's first."""

    @classmethod
    def none(cls, runs: int) -> Tally:
        """Tally of a planner that solves nothing."""
        return cls.over(np.zeros((len(COLUMNS), runs), dtype=np.int64))

    @classmethod
    def over(cls, counts: NDArray[np.int64]) -> Tally:
        """Tally of counts (column, run) in the order of :data:`COLUMNS`: the same memory."""
        return cls(dict(zip(COLUMNS, counts, strict=True)), np.full(counts.shape[1], np.nan))

    def columns(self) -> dict[str, NDArray[np.int64] | Array]:
        """Columns of ``runs.parquet``."""
        return {**self.counts, "largest_slack_m": self.largest_slack_m}

    def event_columns(self, planner: str, first_run: int) -> dict[str, NDArray[Any]]:
        """Columns of ``events.parquet``, by run, then time, whatever runs fly together."""
        events = sorted(self.events, key=lambda event: (event.run, event.time_s))
        return {
            "planner": np.full(len(events), planner, dtype=f"<U{max(1, len(planner))}"),
            "run": np.array([first_run + event.run for event in events], dtype=np.int64),
            "t_s": np.array([event.time_s for event in events], dtype=np.float64),
            "uav": np.array([event.uav for event in events], dtype=np.int64),
            "cause": np.array([event.cause for event in events], dtype=np.str_),
            "action": np.array([event.action for event in events], dtype=np.str_),
        }
