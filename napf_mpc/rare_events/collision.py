"""Collision of a mission as a limit state: its least clearance, as a function of all that chance decides."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from napf_mpc.block import MAX_RUNS
from napf_mpc.campaign import block_size
from napf_mpc.closed_loop import build_scenario, closed_loop, formation_mission
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import MissionScore, Outcome
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.rare_events.given import DrawnNumbers, GivenNumbers, Layout
from napf_mpc.streams import Seed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LeastClearance:
    """Limit state of a mission: least clearance of any UAV to an obstacle [m], contact at 0 or below.

    A point is all the standard-normal numbers that scene, navigation errors and moving obstacles are drawn
    from. A mission that failed (a number stopped being finite) counts as a contact at minus infinity: it was
    not safe. One that never came near anything has a clearance of plus infinity.
    """

    problem: Problem
    """Formation problem."""
    planner: str
    """Name of the planner."""
    seed: int = 0
    """Of the numbers that a point does not hold, see :class:`~napf_mpc.rare_events.given.GivenNumbers`."""
    data_folder: Path | None = None
    """Where data files lie."""

    @cached_property
    def layout(self) -> Layout:
        """What each number of a point drives, found by flying one mission.

        Raises
        ------
        NapfError
            If the problem cannot be flown, or there is nothing to touch.
        """
        numbers = DrawnNumbers(self.seed)
        pilot = make_planner(self.planner, self.problem)
        scenario = build_scenario(self.problem, numbers, range(1), self.data_folder)
        if not len(scenario.obstacles.solids.kind) and scenario.moving is None:
            raise ProblemError("world", ["has no obstacle: there is no collision to estimate"])
        before = numbers.counts()
        flight = closed_loop(self.problem, pilot, scenario)
        share = float(flight.duration_s[0]) / self.problem.simulation.time_limit_s
        return numbers.layout(before, max(share, 0.01))

    @property
    def dimension(self) -> int:
        """Numbers of a point."""
        return self.layout.dimension

    @cached_property
    def lock_step(self) -> int:
        """Missions to fly at once."""
        formation_mission(self.problem)
        scenario = build_scenario(self.problem, self.seed, range(1), self.data_folder)
        return block_size(self.problem, scenario, MAX_RUNS)

    def __call__(self, points: Array) -> Array:
        """Fly the missions of some points (n, dimension); least clearance (n,) [m]."""
        parts = [points[i : i + self.lock_step] for i in range(0, len(points), self.lock_step)]
        return np.concatenate([self.fly(part) for part in parts])

    def fly(self, points: Array) -> Array:
        """Fly the missions of some points in lock-step; least clearance (n,) [m]."""
        return clearance(
            self.problem,
            self.planner,
            GivenNumbers(points, self.layout, self.seed),
            range(len(points)),
            self.data_folder,
        )


def clearance(
    problem: Problem, planner: str, seed: Seed, runs: range, data_folder: Path | None = None
) -> Array:
    """Least clearance of each run [m], minus infinity if it failed, plus infinity if nothing came near.

    Raises
    ------
    NapfError
        If the problem cannot be flown or data are missing.
    """
    with threadpool_limits(1):
        scenario = build_scenario(problem, seed, runs, data_folder)
        judge = MissionScore(problem, scenario)
        score = judge.score(closed_loop(problem, make_planner(planner, problem), scenario, (judge,)))
    least = score.metrics["min_clearance_m"]
    failed = np.array([outcome == Outcome.FAILED for outcome in score.outcome])
    return np.where(failed, -np.inf, np.where(np.isnan(least), np.inf, least))
