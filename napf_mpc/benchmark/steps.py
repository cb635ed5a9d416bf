"""Times of control steps in closed-loop missions: everything from the navigation solution to the command."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from napf_mpc.closed_loop import Scenario, closed_loop
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command, Planner
from napf_mpc.problem import Problem
from napf_mpc.world.obstacles import ObstacleSet


@dataclass(frozen=True)
class StepTime:
    """One call of a planner."""

    time_s: float
    """In the mission [s]."""
    uavs: int
    """UAVs of all runs that still fly: those that were planned for."""
    cpu_us: float
    """Thread-CPU time of the call."""
    wall_us: float
    """Wall time of the call."""


@dataclass
class TimedPlanner:
    """A planner that notes how long each of its steps takes."""

    planner: Planner
    """Who plans."""
    times: list[StepTime] = field(default_factory=list)
    """One a step."""

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self.planner.name

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map; times are kept."""
        self.planner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Command of the planner."""
        uavs = nav.available.size if nav.airborne is None else int(nav.airborne.sum())
        wall, cpu = time.perf_counter(), time.thread_time()
        command = self.planner.step(nav, time_s)
        cpu, wall = time.thread_time() - cpu, time.perf_counter() - wall
        self.times.append(StepTime(time_s, uavs, 1e6 * cpu, 1e6 * wall))
        return command


def step_times(problem: Problem, planner: Planner, scenario: Scenario, skip: int) -> list[StepTime]:
    """Times of a planner's steps on a flight, without the first so many.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planner : Planner
        Who flies.
    scenario : Scenario
        Runs, flown in lock-step.
    skip : int
        Steps that do not count: the first pays for what is done once.
    """
    timed = TimedPlanner(planner)
    closed_loop(problem, timed, scenario)
    return timed.times[skip:]
