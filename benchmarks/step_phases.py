"""Where the time of a control step goes: the named phases of ``QpPlanner.step``, one beside the other.

Run ``python benchmarks/step_phases.py``. A mission is flown once, and what navigation reported is given to
the planner again and again: each step's time is the least of its repetitions, each phase's figure the median
over the steps. Phases overlap as they call each other: the answer holds the solve, the programs the rows.
"""

from __future__ import annotations

import argparse
import copy
import platform
import time
from collections import defaultdict
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
from plant_speed import machine
from threadpoolctl import threadpool_limits

from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners import mpc
from napf_mpc.planners.planner import Command
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet

PHASES = (
    "_state", "_covariance", "_carried", "_references", "_guess", "_horizon", "_programs", "_answer_to",
    "_choose", "_contact_slack", "_command",
)  # fmt: skip
"""Methods of the planner."""


class Heard:
    """A planner, and what it was told."""

    def __init__(self, planner: mpc.QpPlanner) -> None:
        self.planner = planner
        self.told: list[tuple[NavSolution, float]] = []
        self.world: tuple[ObstacleSet, int] = (ObstacleSet.empty(), 0)

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self.planner.name

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map."""
        self.world = obstacles, runs
        self.planner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Keep the solution, and pass it on."""
        self.told.append((copy.deepcopy(nav), time_s))
        return self.planner.step(nav, time_s)


class Watch:
    """Wraps functions and adds up their times within a step."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)

    def on(self, owner: Any, name: str, label: str) -> None:
        """Time a function from now on."""
        function: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **settings: Any) -> Any:
            began = time.thread_time()
            answer = function(*args, **settings)
            self.spent[label] += time.thread_time() - began
            return answer

        setattr(owner, name, timed)


def main() -> None:
    """Fly, repeat and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", default="study_40s")
    parser.add_argument("--runs", type=int, default=1, help="missions in lock-step")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--limit-s", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=7501)
    arguments = parser.parse_args()
    problem = load_problem(
        arguments.problem,
        {"navigation.filter": "kalman", "simulation.time_limit_s": arguments.limit_s},
    )
    with threadpool_limits(1):
        heard = Heard(mpc.QpPlanner(problem))
        closed_loop(problem, heard, build_scenario(problem, arguments.seed, range(arguments.runs)))
        planner, watch = mpc.QpPlanner(problem), Watch()
        for constraint in planner.constraints:
            watch.on(type(constraint), "rows", f"rows: {constraint.name}")
        for phase in PHASES:
            watch.on(planner, phase, phase.strip("_").replace("_", " "))
        watch.on(planner._guidance, "step", "guidance")
        watch.on(mpc, "refusals", "refusals")
        tables = []
        for _ in range(arguments.repeat):
            planner.reset(*heard.world)
            steps = []
            for nav, time_s in heard.told:
                watch.spent.clear()
                began = time.thread_time()
                planner.step(nav, time_s)
                steps.append({"whole step": time.thread_time() - began, **watch.spent})
            tables.append(steps)
    labels = sorted({label for steps in tables for step in steps for label in step})
    times = np.array([[[step.get(label, 0.0) for label in labels] for step in steps] for steps in tables])
    least = 1e6 * times.min(0)[3:]
    print(
        f"{machine()}, python {platform.python_version()}, numpy {version('numpy')}, numba {version('numba')}"
    )
    print(
        f"{arguments.problem}, {arguments.runs} x {problem.uav_count} UAVs, {len(least)} steps, "
        f"least of {arguments.repeat}, seed {arguments.seed}; thread-CPU time\n"
    )
    print("| phase | median (us) | mean (us) |\n|---|---:|---:|")
    for median, mean, label in sorted(
        zip(np.median(least, 0), least.mean(0), labels, strict=True), reverse=True
    ):
        print(f"| {label} | {median:.1f} | {mean:.1f} |")


if __name__ == "__main__":
    main()
