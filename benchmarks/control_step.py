"""How long one control step takes, with each solver, and beside other ways to do the same.

Run ``python benchmarks/control_step.py``; ``--steps 100000`` counts misses of a 50 ms period. A control step
is the whole of ``QpPlanner.step``: obstacle query, rows, solve, checks, fall-backs. One planner flies the
mission; at each step all others are given the same navigation solution, one after the other in turn, so that
whatever else the machine does falls on all alike. Four UAVs are planned for at once, as in a simulation, and
times are a quarter of the step's (the UAV's share); how often that share, and the whole step of all four on
one thread, take longer than the period is counted apart.
Further rows are of a single UAV, which has no neighbour rows and shares the step's fixed cost with nobody.

cvxpy (one program with parameters, compiled once), CVXPYgen (the same as generated C) and do-mpc are shown
the first UAV of ten steps one after the other in every hundred, see other_controllers.py; the planner's own
query and rows are in their times.
Each is left out, by name, where it is not installed. "Refused" are answers that the planner did not fly, or
that these do not call solved; "thrust off" says how far their first thrust is from the one that is flown.
"""

from __future__ import annotations

import argparse
import gc
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray
from other_controllers import CvxpyController, CvxpygenController, DoMpcController
from plant_speed import machine
from threadpoolctl import threadpool_limits

from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.constraints.constraint import Constraint, Horizon, LinearRows
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.planners.planner import Command
from napf_mpc.problem import FormationMission, Line, Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.qp import HorizonQp
from napf_mpc.solvers.batch import BatchResult, BatchSolver, WarmStart, make_batch_solver
from napf_mpc.vehicle.quadrotor import discretize, linearize
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PERIOD_S = 0.05
"""A step that takes longer has missed it."""
GROUP = 10
"""Steps one after the other that other controllers are shown."""
WAYS: dict[str, dict[str, object]] = {
    "kernel": {},
    "osqp": {},
    "osqp, not polished": {"polishing": False},
    "osqp, setup each step": {},
}
"""Ways by name, which begins with the solver's, and the solver's settings."""


@dataclass
class Stopwatch:
    """Thread-CPU and wall time spent in a part of the step."""

    cpu_s: float = 0.0
    wall_s: float = 0.0

    def __enter__(self) -> Stopwatch:
        self._wall, self._cpu = time.perf_counter(), time.thread_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.cpu_s += time.thread_time() - self._cpu
        self.wall_s += time.perf_counter() - self._wall


class TimedRows:
    """A constraint whose rows are timed; its first look at the map is the obstacle query."""

    def __init__(self, constraint: Constraint, watch: Stopwatch) -> None:
        self._constraint, self._watch = constraint, watch

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return self._constraint.name

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows of the constraint."""
        with self._watch:
            return self._constraint.rows(horizon)


class TimedSolver:
    """A solver whose work is timed."""

    def __init__(self, solver: BatchSolver, watch: Stopwatch, afresh: bool) -> None:
        self._solver, self._watch, self._afresh = solver, watch, afresh

    def reset(self) -> None:
        """Forget all workspaces."""
        self._solver.reset()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        """Answer of the solver."""
        with self._watch:
            if self._afresh:
                self._solver.reset()
            return self._solver.solve_batch(horizon, None if self._afresh else warm, active)


@dataclass
class Way:
    """A way to make the control step, and the times of all its steps."""

    name: str
    uavs: int
    cpu: list[float] = field(default_factory=list)
    """Thread-CPU time of each step of all UAVs [s]."""
    wall: list[float] = field(default_factory=list)
    """The same on the wall clock [s]."""
    rows: list[float] = field(default_factory=list)
    """Part of cpu in obstacle query and rows [s]."""
    solve: list[float] = field(default_factory=list)
    """Part of cpu in the solver [s]."""
    refused: int = 0
    """Answers that were not flown, or not called solved."""

    def timed(self, call: Callable[[], Command]) -> Command:
        """Make a step and keep its time."""
        with Stopwatch() as watch:
            command = call()
        self.cpu.append(watch.cpu_s)
        self.wall.append(watch.wall_s)
        return command


class OwnWay:
    """The library's planner with a solver, timed."""

    def __init__(self, name: str, problem: Problem) -> None:
        self.way = Way(name, problem.uav_count)
        self._rows, self._solve = Stopwatch(), Stopwatch()
        solver = make_batch_solver(name.partition(",")[0], **WAYS[name])
        self.planner = QpPlanner(problem, solver=TimedSolver(solver, self._solve, "setup" in name))
        self.planner.constraints = [TimedRows(rows, self._rows) for rows in self.planner.constraints]

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Make a step."""
        self._rows.cpu_s, self._solve.cpu_s = 0.0, 0.0
        command = self.way.timed(lambda: self.planner.step(nav, time_s))
        self.way.rows.append(self._rows.cpu_s)
        self.way.solve.append(self._solve.cpu_s)
        return command

    def close(self) -> None:
        """Take over the planner's counts before it forgets them."""
        self.way.refused += int(self.planner.tally.counts["answers_refused"].sum())


class OtherWay:
    """Another controller, given the planner's program of one UAV now and then."""

    def __init__(self, maker: Callable[[HorizonQp], CvxpyController | DoMpcController], name: str) -> None:
        self.way = Way(name, 1)
        self._maker = maker
        self._controller: CvxpyController | DoMpcController | None = None
        self.off: list[float] = []
        """How far the first thrust is from the kernel solver's [N]."""

    def step(self, planner: QpPlanner, nav: NavSolution, time_s: float) -> Array:
        """Make a step of the first UAV; return its first input."""
        uavs = nav.available.shape[1]
        with Stopwatch() as build:
            horizon = planner.build(nav, time_s)
        first = self._controller is None
        if self._controller is None:
            self._controller = self._maker(horizon)
        with Stopwatch() as watch:
            inputs = self._controller.solve(horizon)
        if not first:  # the first one compiles
            self.way.cpu.append(build.cpu_s / uavs + watch.cpu_s)
            self.way.wall.append(build.wall_s / uavs + watch.wall_s)
            self.way.rows.append(build.cpu_s / uavs)
            self.way.solve.append(watch.cpu_s)
            self.way.refused += not self._controller.solved
        return inputs


class Bench:
    """Flies by the first way, and shows every step to all others."""

    def __init__(self, problem: Problem, ways: list[str], others: list[OtherWay], every: int) -> None:
        self.own = [OwnWay(name, problem) for name in ways]
        self.others, self._every = others, every
        self.steps = 0

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self.own[0].planner.name

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map."""
        # The ladder asks this at the first refused answer only: compiling it is no part of that step.
        obstacles.nearest(np.zeros((runs, 1, 3)))
        for own in self.own:
            own.close()
            own.planner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Make the step in all ways, in an order that goes round; fly the first."""
        looked = []
        # In groups, so that a warm start is of the step before.
        if self.others and self.steps // GROUP % self._every == 0:
            looked = [(other, other.step(self.own[0].planner, nav, time_s)) for other in self.others]
        commands: dict[int, Command] = {}
        for place in range(len(self.own)):
            which = (place + self.steps) % len(self.own)
            commands[which] = self.own[which].step(nav, time_s)
        plan = commands[0].plan
        assert plan is not None
        for other, inputs in looked:
            other.off.append(abs(float(inputs[0] - plan.inputs[0, 0, 0, 0])))
        self.steps += 1
        return commands[0]


def fly(problem: Problem, bench: Bench, steps: int, seed: int) -> None:
    """Fly missions one after the other until there are enough steps."""
    run = 0
    while bench.steps < steps:
        left_s = (steps - bench.steps) / problem.planner.rate_hz
        limit = problem.simulation.model_copy(
            update={"time_limit_s": max(0.1, min(problem.simulation.time_limit_s, left_s))}
        )
        shortened = problem.model_copy(update={"simulation": limit})
        closed_loop(shortened, bench, build_scenario(shortened, seed, range(run, run + 1)))
        run += 1
    for own in bench.own:
        own.close()


def alone(problem: Problem) -> Problem:
    """Return the same problem for a single UAV."""
    assert isinstance(problem.mission, FormationMission)
    start = {"initial_positions_m": None, "initial_velocities_mps": None}
    return problem.model_copy(
        update={
            "formation": Line(shape="line", count=1),
            "mission": problem.mission.model_copy(update=start),
        }
    )


def others_installed(problem: Problem) -> list[OtherWay]:
    """Other controllers that can be imported; the others are named."""
    step_s = problem.planner.look_ahead_s / problem.planner.horizon
    a, b = discretize(*linearize(problem.vehicle), step_s)
    makers: tuple[tuple[str, str, Callable[[HorizonQp], CvxpyController | DoMpcController]], ...] = (
        ("cvxpy", CvxpyController.name, CvxpyController),
        ("cvxpygen", CvxpygenController.name, CvxpygenController),
        ("do_mpc", DoMpcController.name, lambda horizon: DoMpcController(horizon, a, b, step_s)),
    )
    found = []
    for package, name, maker in makers:
        if find_spec(package) is None:
            print(f"{name}: left out, {package} is not installed")
        else:
            found.append(OtherWay(maker, name))
    return found


def line(scene: str, way: Way, off: list[float] | None = None) -> str:
    """Row of the table: milliseconds per UAV."""
    cpu, wall = (1e3 * np.array(times) / way.uavs for times in (way.cpu, way.wall))
    rows, solve = (1e3 * np.array(times) / way.uavs for times in (way.rows, way.solve))
    medians = [np.median(rows), np.median(solve), np.median(cpu - rows - solve)]
    late = [
        " / ".join(str(int((np.array(times) > PERIOD_S * parts).sum())) for times in (way.cpu, way.wall))
        for parts in (way.uavs, 1)
    ]
    quantiles = [np.quantile(times, [0.5, 0.99, 1.0]) for times in (cpu, wall)]
    cells = [scene, way.name, f"{len(cpu)} x {way.uavs}"]
    cells += [f"{value:.2f}" for value in (*quantiles[0], *quantiles[1], *medians)]
    cells += [*late, str(way.refused)]
    cells.append(f"{np.median(off):.1e} / {max(off):.1e}" if off else "-")
    return "| " + " | ".join(cells) + " |"


def versions() -> str:
    """Packages that matter here."""
    words = [f"python {platform.python_version()}"]
    for name in ("numpy", "numba", "osqp", "cvxpy", "cvxpygen", "casadi", "do-mpc"):
        try:
            words.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            words.append(f"no {name}")
    return ", ".join(words)


def main() -> int:
    """Fly and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=3000, help="steps of UAVs of each way and scene")
    parser.add_argument("--problem", nargs="+", default=["study_8s", "study_40s"])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument(
        "--others-every", type=int, default=10, help="steps between those of the others, 0: none"
    )
    parser.add_argument("--seed", type=int, default=7501)
    parser.add_argument("--no-single", action="store_true", help="leave the scenes of one UAV out")
    arguments = parser.parse_args()
    if arguments.steps < 100 or arguments.others_every < 0:
        parser.error("steps must be 100 or more, others-every 0 or more")
    print(f"{machine()}; {versions()}")
    print(
        f"Milliseconds per UAV and step of {', '.join(arguments.problem)} with navigation filter, N = 20, 8 "
        f"obstacle rows a stage, seed {arguments.seed}; one thread"
    )
    table = [
        "| scene | way | steps x UAVs | thread-CPU median | p99 | max | wall median | p99 | max "
        "| query and rows | solve | rest | shares over 50 ms, thread-CPU / wall "
        "| whole steps over 50 ms | refused "
        "| thrust off [N], median / max |",
        "|---|---|" + "---:|" * 14,
    ]
    with threadpool_limits(1):
        for name in arguments.problem:
            problem = load_problem(name, {"navigation.filter": "kalman", "planner.kind": "qp"})
            single = [] if arguments.no_single else [(f"{name}, one UAV", alone(problem))]
            for scene, flown in [(name, problem), *single]:
                every = arguments.others_every
                others = others_installed(flown) if every and flown is problem else []
                fly(flown, Bench(flown, arguments.ways, [], 1), 3, arguments.seed)  # compile what is compiled
                bench = Bench(flown, arguments.ways, others, max(1, every))
                gc.collect()
                gc.freeze()
                fly(flown, bench, arguments.steps // problem.uav_count, arguments.seed)
                table += [line(scene, own.way) for own in bench.own]
                table += [line(scene, other.way, other.off) for other in others if other.way.cpu]
    print("\n".join(table))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
