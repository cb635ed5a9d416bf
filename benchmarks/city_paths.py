"""Missions on random paths among real towers: how often planners hit, arrive, or give up.

Run ``NAPF_MPC_DATA=DIR python benchmarks/city_paths.py``. Paths are drawn over Nishi-Shinjuku (the data of
the problem ``nishi_shinjuku``): formation, spacing, speed of 2 to 6 m/s, height of 30 to 100 m, heading,
length, sigma and filter at random. Kept are those whose start and finish are clear and whose lanes lead into
a building. ``--straight`` keeps those that a shift of all lanes by up to 28 m aside and 12 m up makes clear;
without it those that no such shift does are kept, which are hard: the way is to be found between blocks.

What is drawn does not depend on how anything flies: ``PYTHONPATH`` of another checkout flies the same paths.
"""

from __future__ import annotations

import argparse
import platform
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from plant_speed import machine

from napf_mpc import NapfError, load_problem, simulate
from napf_mpc.closed_loop import build_scenario
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.risk import wilson
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

TOWERS = """
title = "a path among towers"
[formation]
[mission]
[world]
kind = "city"
file = "city_tokyo_nishi_shinjuku/buildings.geojson"
origin_latitude_deg = 35.6895  # the city hall
origin_longitude_deg = 139.6917
[navigation]
kind = "gauss_markov"
correlation_time_s = 10.0
sigma_period_s = 20.0
"""
CLEAR_START_M, CLEAR_FINISH_M = 8.0, 6.0
"""Least distance of all slots to a building over the first 8 m and the last 12 m."""
AT_LEAST_M = 4.0
"""Distance that a straight way keeps."""
ASIDE_M, UP_M = np.arange(-28.0, 29.0, 2.0), (0.0, 6.0, 12.0)


def drawn(rng: np.random.Generator) -> list[str]:
    """Settings of a random mission, as overrides of a shipped problem."""
    count = int(rng.integers(2, 6))
    shape = str(rng.choice(["line", "v"])) if count in (3, 5) else "square" if count == 4 else "line"
    formation = [f'formation.shape="{shape}"']
    if shape != "square":
        formation += [f"formation.count={count}", f"formation.spacing_m={rng.choice([5.0, 6.0, 8.0, 10.0])}"]
    if shape == "line":
        formation.append(f"formation.bearing_deg={rng.choice([0.0, 45.0, 90.0])}")
    speed, length = rng.choice([2.0, 3.0, 4.0, 5.0, 6.0]), rng.choice([200.0, 300.0, 400.0])
    east, north, height = *rng.uniform(-300.0, 300.0, 2), rng.choice([30.0, 45.0, 60.0, 80.0, 100.0])
    low, high = ((0.2, 0.6), (0.5, 1.5), (0.5, 2.0))[int(rng.integers(3))]
    return [
        *formation,
        f"mission.speed_mps={speed}",
        f"mission.length_m={length}",
        f"mission.heading_deg={rng.uniform(-180.0, 180.0):.1f}",
        f"mission.start_m=[{east:.1f}, {north:.1f}, {height}]",
        f"navigation.sigma_min_m={low}",
        f"navigation.sigma_max_m={high}",
        f'navigation.filter="{rng.choice(["kalman", "kalman", "none"])}"',
        f"simulation.time_limit_s={3.0 * length / speed + 60.0}",
    ]


def lane_distances(problem: Problem, obstacles: ObstacleSet, aside: float, up: float) -> Array:
    """Least distance (metre of the path,) of any slot to a building, with all lanes shifted [m]."""
    assert isinstance(problem.mission, FormationMission)
    frame, slots = PathFrame.of_mission(problem.mission), formation_offsets(problem.formation)
    along = np.arange(0.0, problem.mission.length_m + 1.0)
    shift = np.stack([along, np.full(along.shape, aside), np.full(along.shape, up)], axis=-1)
    places = frame.to_world((slots + shift[:, None]).reshape(-1, 3))
    return np.asarray(obstacles.signed_distance(places[None]).reshape(len(along), -1).min(1))


def is_kept(problem: Problem, obstacles: ObstacleSet, straight: bool) -> bool:
    """Whether a path is clear at its ends, meets a building, and has a straight way past or none."""
    distance = lane_distances(problem, obstacles, 0.0, 0.0)
    ends = distance[:8].min() >= CLEAR_START_M and distance[-12:].min() >= CLEAR_FINISH_M
    if not ends or distance.min() > 1.0:
        return False
    shifted = (
        lane_distances(problem, obstacles, aside, up)[20:-20].min() for aside in ASIDE_M for up in UP_M
    )
    return any(each > AT_LEAST_M for each in shifted) == straight


def missions(count: int, seed: int, straight: bool, file: Path) -> list[tuple[list[str], Problem]]:
    """The first missions of a seed that are kept, with their settings; ``file`` holds :data:`TOWERS`."""
    rng = np.random.default_rng(seed)
    kept: list[tuple[list[str], Problem]] = []
    while len(kept) < count:
        settings = drawn(rng)
        problem = load_problem(file, settings)
        try:
            obstacles = build_scenario(problem, seed, range(1)).obstacles
        except NapfError:  # it would start inside a building
            continue
        if is_kept(problem, obstacles, straight):
            kept.append((settings, problem))
    return kept


def rate(events: int, of: int) -> str:
    """Events, share and 95 % interval."""
    found = wilson(events, of)
    return f"{events} of {of} = {100 * events / of:.1f} % [{100 * found.low:.1f}, {100 * found.high:.1f}]"


def main() -> None:
    """Draw, fly and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--missions", type=int, default=16)
    parser.add_argument("--runs", type=int, default=6, help="of each mission, with errors of their own")
    parser.add_argument("--seed", type=int, default=9)
    parser.add_argument("--straight", action="store_true")
    parser.add_argument("--planners", default="napf,qp")
    options = parser.parse_args()
    names = options.planners.split(",")
    print(f"{machine()}, Python {platform.python_version()}, numpy {version('numpy')}, seed {options.seed}")
    totals = np.zeros((len(names), 4), dtype=int)
    with TemporaryDirectory() as folder:
        file = Path(folder, "towers.toml")
        file.write_text(TOWERS, encoding="utf-8")
        chosen = missions(options.missions, options.seed, options.straight, file)
    for n, (settings, problem) in enumerate(chosen):
        print(f"{n}: {' '.join(settings)}")
        for row, name in enumerate(names):
            score = simulate(problem, name, seed=options.seed, runs=options.runs).score
            hit = score.obstacle_contact.any(axis=-1)
            clean = score.finished & ~hit & ~score.uav_contact
            counts = [int(each.sum()) for each in (hit, score.uav_contact, score.finished, clean)]
            totals[row] += counts
            print(f"   {name:12s} hit {counts[0]}, UAV-UAV {counts[1]}, finished {counts[2]}", flush=True)
    flown = options.missions * options.runs
    for name, (hit, apart, finished, clean) in zip(names, totals.tolist(), strict=True):
        print(f"{name}: hit {rate(hit, flown)}; UAV-UAV {rate(apart, flown)};")
        print(f"   finished {rate(finished, flown)}; without any contact {rate(clean, flown)}")
    print("Intervals count all flights alike: those on the same path share its difficulty.")


if __name__ == "__main__":
    main()
