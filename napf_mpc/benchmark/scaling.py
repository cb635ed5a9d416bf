"""How the cost grows: with UAVs in lock-step, UAVs of a formation, obstacles, the horizon, and missions.

Control steps are timed on closed-loop flights behind the navigation filter, from a time on at which obstacles
are near. A size whose flight is expected to take longer than asked for is left out, and so are those beyond
it; the smallest size is flown once more before, to load compiled code.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from napf_mpc.benchmark.growth import Point, Study
from napf_mpc.benchmark.steps import step_times
from napf_mpc.block import fly_block
from napf_mpc.campaign import block_size, chunks
from napf_mpc.closed_loop import Scenario, build_scenario
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.streams import Stream, generator
from napf_mpc.world.obstacles import ObstacleSet

BASE: dict[str, object] = {"navigation.filter": "kalman", "simulation.time_limit_s": 20.0}
"""Flights of the studies: 20 s of study_40s."""
FROM_S = 10.0
"""Steps before this do not count: obstacles begin 20 m from the start, at 2 m/s [s]."""
AREA_M2 = 90.0
"""Area for one obstacle: the density of study_40s."""
MIDDLE_M = 30.0
"""A growing field's middle: where the formation is half-way through the time that counts [m]."""
CLEAR_M = 8.0
"""No obstacle of a growing field has its centre nearer to the start than this [m]."""
SLOT_M = 6.0
"""Distance of the slots of a growing formation [m]."""


def _steps_of(study: str, size: int, problem: Problem, scenario: Scenario) -> Point:
    times = step_times(problem, QpPlanner(problem), scenario, 0)
    late = [step for step in times if step.time_s >= FROM_S]
    cpu = np.array([step.cpu_us for step in late])
    return Point(
        study, size, max(step.uavs for step in late), len(late), float(np.median(cpu)), float(cpu.mean()),
        float(np.percentile(cpu, 99.0)),
    )  # fmt: skip


def _lock_step(size: int, seed: int) -> Point:
    problem = load_problem("study_40s", BASE)
    runs = max(1, size // problem.uav_count)
    return _steps_of("UAVs in lock-step", size, problem, build_scenario(problem, seed, range(runs)))


def _formation(size: int, seed: int) -> Point:
    side = math.isqrt(size)
    offsets = [[-SLOT_M * (i % side), SLOT_M * (i // side - (side - 1) / 2.0), 0.0] for i in range(size)]
    free: dict[str, object] = {
        "formation": {"shape": "list", "offsets_m": offsets},
        "mission.initial_positions_m": None,
        "mission.initial_velocities_mps": None,
    }
    problem = load_problem("study_40s", {**BASE, **free})
    return _steps_of("UAVs of a formation", size, problem, build_scenario(problem, seed, range(1)))


def _obstacles(size: int, seed: int) -> Point:
    problem = load_problem("study_40s", {**BASE, "world": {"kind": "empty"}})
    scenario = build_scenario(problem, seed, range(4))
    return _steps_of("obstacles", size, problem, replace(scenario, obstacles=field_of(size, seed)))


def field_of(count: int, seed: int) -> ObstacleSet:
    """Spheres of 0.5 to 2 m in a square field around where steps are timed, at the density of study_40s."""
    rng = generator(seed, count, Stream.SCENE)
    half = 0.5 * math.sqrt(AREA_M2 * count)
    centres = np.empty((count, 3))
    drawn = 0
    while drawn < count:
        low, high = (MIDDLE_M - half, -half, -3.0), (MIDDLE_M + half, half, 3.0)
        more = rng.uniform(low, high, (count - drawn, 3))
        more = more[np.hypot(more[:, 0], more[:, 1]) >= CLEAR_M]
        centres[drawn : drawn + len(more)] = more
        drawn += len(more)
    return ObstacleSet.from_spheres(centres[None], rng.uniform(0.5, 2.0, (1, count)))


def _horizon(size: int, seed: int) -> Point:
    problem = load_problem("study_40s", {**BASE, "planner.horizon": size})
    return _steps_of("stages of the horizon", size, problem, build_scenario(problem, seed, range(4)))


def _missions(size: int, seed: int) -> Point:
    problem = load_problem("study_40s", {**BASE, "simulation.time_limit_s": 110.0})
    block = block_size(problem, build_scenario(problem, seed, range(1)), size)
    began = time.process_time()
    for runs in chunks(range(size), block):
        fly_block(problem, ["qp"], seed, runs)
    cost = 1e6 * (time.process_time() - began)
    return Point("missions", size, problem.uav_count * min(block, size), 1, cost, cost, math.nan)


UAVS = (4, 16, 64, 256, 1024, 4096)
OBSTACLES = (8, 100, 1000, 10_000, 100_000, 1_000_000)
STUDIES: dict[str, Study] = {
    "UAVs in lock-step": Study("UAVs", "UAV", UAVS, "control step", _lock_step),
    "UAVs of a formation": Study("UAVs", "UAV", UAVS, "control step", _formation),
    "obstacles": Study("obstacles", "UAV", OBSTACLES, "control step", _obstacles),
    "stages of the horizon": Study("stages", "UAV", (10, 20, 30, 50, 70, 100), "control step", _horizon),
    "missions": Study("missions", "mission", (1, 10, 100, 1000, 10_000), "whole missions", _missions),
}
"""Label -> study."""


def grown(
    label: str, study: Study, seed: int, budget_s: float, tell: Callable[[str], None]
) -> Iterator[Point]:
    """Points of a study, one size after the other, as long as each can be expected within a budget.

    Parameters
    ----------
    label : str
        Of the study.
    study : Study
        What grows.
    seed : int
        Campaign seed.
    budget_s : float
        Wall time for one size [s]. The next is expected to take longer by the power of its size by which the
        last two did; after a single one, as long.
    tell : callable
        Is told of what is left out.
    """
    study.measure(study.sizes[0], seed)  # compiles, or loads what is compiled
    walls: list[tuple[int, float]] = []
    for size in study.sizes:
        if _expected_s(walls, size) > budget_s:
            left = ", ".join(f"{other:,}" for other in study.sizes if other >= size)
            tell(f"{label}: {left} left out, would take longer than {budget_s:g} s each")
            return
        began = time.perf_counter()
        yield study.measure(size, seed)
        walls.append((size, time.perf_counter() - began))


def _expected_s(walls: list[tuple[int, float]], size: int) -> float:
    """Wall time of a size from those of the sizes before [s]."""
    if len(walls) < 2:
        return walls[0][1] if walls else 0.0
    (before, short), (last, long) = walls[-2:]
    power = max(0.0, math.log(long / short) / math.log(last / before))
    return float(long * (size / last) ** power)
