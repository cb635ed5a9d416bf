"""What planners take: their control steps for one formation, and missions a second on one core."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from napf_mpc.benchmark.contenders import Scene, present
from napf_mpc.benchmark.steps import StepTime, TimedPlanner, step_times
from napf_mpc.block import simulate
from napf_mpc.closed_loop import build_scenario
from napf_mpc.planners.registry import make_planner, own_planners, planner_names
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.solvers.batch import make_batch_solver

TIMED_ALONE = 3
"""Missions whose steps are timed one mission at a time."""
SKIP = 3
"""Steps of a mission that do not count: compiled code is loaded, guidance plans for the first time."""


@dataclass(frozen=True)
class Pilot:
    """A planner and how it is set."""

    planner: str
    """Name of a planner, see :data:`napf_mpc.planners.registry.PLANNERS`."""
    overrides: Mapping[str, object] = field(default_factory=dict)
    """Of the problem."""

    @property
    def solver(self) -> str:
        """Name of the solver that it needs, if it plans by programs."""
        return str(self.overrides.get("planner.solver", "kernel"))


PILOTS: dict[str, Pilot] = {
    "apf": Pilot("apf"),
    "napf": Pilot("napf"),
    "napf_guided": Pilot("napf_guided"),
    "qp": Pilot("qp"),
    "qp, osqp": Pilot("qp", {"planner.solver": "osqp"}),
    "qp_unguided": Pilot("qp_unguided"),
}
"""Label -> pilot."""


def pilots() -> dict[str, Pilot]:
    """Label -> pilot: planners that were registered, by their names, behind the shipped ones."""
    own = {name: Pilot(name) for name in own_planners(planner_names())}
    return PILOTS | {name: one for name, one in own.items() if name not in PILOTS}


@dataclass(frozen=True)
class PlannerRow:
    """A planner in a scene."""

    scene: str
    """Label."""
    planner: str
    """Label."""
    steps: int
    """Control steps timed, each for one formation."""
    uavs: int
    """Of the formation."""
    median_us: float
    """Thread-CPU time of a step for the formation: median, ..."""
    p95_us: float
    """... 95th percentile, ..."""
    p99_us: float
    """... 99th percentile and ..."""
    max_us: float
    """... the longest, without the first :data:`SKIP` of a mission."""
    late: int
    """Steps whose wall time was longer than the planner's period."""
    missions: int
    """Flown in lock-step, whole and judged."""
    mission_ms: float
    """Processor time of one of these."""
    planning: float
    """Part of it that is the planner's."""


def installed_pilots(pilots: Mapping[str, Pilot], tell: Callable[[str], None]) -> dict[str, Pilot]:
    """Pilots whose solvers are there; ``tell`` is told of the others.

    Raises
    ------
    SolverError
        If none is there.
    """
    return present(pilots, lambda one: make_batch_solver(one.solver), tell)


def measure_planner(
    label: str, scene: Scene, name: str, pilot: Pilot, *, missions: int, seed: int
) -> tuple[PlannerRow, list[StepTime]]:
    """One planner in one scene.

    Parameters
    ----------
    label, name : str
        Of scene and planner.
    scene : Scene
        What is flown, behind the navigation filter.
    pilot : Pilot
        Who flies.
    missions : int
        Flown in lock-step; the steps of the first three of them are timed one mission at a time.
    seed : int
        Campaign seed.

    Returns
    -------
    row : PlannerRow
        What it took.
    times : list of StepTime
        Of all steps for one formation.
    """
    settings = {"navigation.filter": "kalman", **scene.overrides, **pilot.overrides}
    problem = load_problem(scene.problem, settings)
    times: list[StepTime] = []
    for run in range(min(TIMED_ALONE, missions)):
        scenario = build_scenario(problem, seed, range(run, run + 1))
        times += step_times(problem, make_planner(pilot.planner, problem), scenario, SKIP)
    cpu = np.array([step.cpu_us for step in times])
    wall = np.array([step.wall_us for step in times])
    mission_s, planning = _together(problem, pilot, missions, seed)
    median, p95, p99 = np.percentile(cpu, (50.0, 95.0, 99.0)).tolist()
    row = PlannerRow(
        label, name, len(times), problem.uav_count, median, p95, p99, float(cpu.max()),
        int((wall > 1e6 / problem.planner.rate_hz).sum()), missions, 1e3 * mission_s, planning,
    )  # fmt: skip
    return row, times


def _together(problem: Problem, pilot: Pilot, missions: int, seed: int) -> tuple[float, float]:
    """Processor time of a mission with its verdict [s], and the planner's part of it."""
    simulate(problem, pilot.planner, seed=seed)  # compiles, or loads what is compiled
    timed = TimedPlanner(make_planner(pilot.planner, problem))
    began = time.process_time()
    simulate(problem, timed, seed=seed, runs=missions)
    whole = time.process_time() - began
    return whole / missions, 1e-6 * sum(step.cpu_us for step in timed.times) / whole
