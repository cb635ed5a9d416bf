"""How long distance queries take as the number of obstacles grows, and a swept verdict per UAV and step.

Run ``python benchmarks/obstacle_queries.py``; it prints the machine, the versions and medians over repeats.
Obstacles stand at one density (one per 400 m2), so the area grows with their number. "Every" looks at every
obstacle instead of searching the tree. Compilation and the first touch of the arrays are not timed.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial

import numba
import numpy as np

from napf_mpc.world.bounding_tree import plant
from napf_mpc.world.obstacles import LEAF, ObstacleSet
from napf_mpc.world.shapes import Prism
from napf_mpc.world.sweep import SweptClearance

AREA_M2 = 400.0
HOUSE = np.array([(0.0, 0.0), (9.0, 0.0), (9.0, 6.0), (5.0, 6.0), (5.0, 9.0), (0.0, 9.0)])


def spheres(count: int, rng: np.random.Generator) -> ObstacleSet:
    width = np.sqrt(count * AREA_M2)
    centres = rng.uniform((0.0, 0.0, 0.0), (width, width, 60.0), (1, count, 3))
    return ObstacleSet.from_spheres(centres, rng.uniform(1.0, 4.0, (1, count)))


def houses(count: int, rng: np.random.Generator) -> ObstacleSet:
    places = rng.uniform(0.0, np.sqrt(count * AREA_M2), (count, 2))
    heights = rng.uniform(5.0, 60.0, count)
    return ObstacleSet.from_shapes(
        [Prism((HOUSE + place,), 0.0, height) for place, height in zip(places, heights, strict=True)]
    )


def median_us(call: Callable[[], object], queries: int, repeats: int) -> float:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e6 * statistics.median(times) / queries


def flight_ns(obstacles: ObstacleSet, rng: np.random.Generator, uavs: int, steps: int) -> float:
    """Time of a swept verdict per UAV and step, at 2 m/s and 50 Hz from random places."""
    lower, upper = obstacles.bounds()
    position = rng.uniform(lower, upper, (1, uavs, 3))
    heading = rng.uniform(0.0, 2.0 * np.pi, (1, uavs))
    step = 0.04 * np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
    sweep = SweptClearance(obstacles, 1, uavs)
    sweep.update(position, position)
    start = time.perf_counter()
    for _ in range(steps):
        sweep.update(position, position + step)
        position = position + step
    return 1e9 * (time.perf_counter() - start) / (uavs * steps)


def main() -> None:
    parser = argparse.ArgumentParser(description="Time obstacle queries against the number of obstacles.")
    parser.add_argument("--largest", type=int, default=1_000_000, help="most obstacles")
    parser.add_argument("--queries", type=int, default=20_000, help="points a call")
    parser.add_argument("--repeats", type=int, default=7, help="calls a median is taken over")
    parser.add_argument("--leaf", type=int, default=LEAF, help="obstacles in a leaf of the search tree")
    options = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, one used; {platform.system()} {platform.release()}")
    print(f"python {sys.version.split()[0]}, numpy {np.__version__}, numba {numba.__version__}")
    print(f"{options.queries} points a call, median of {options.repeats} calls, leaf of {options.leaf}\n")
    head = ("obstacles", "kind", "plant ms", "nearest us", "ratio", "near 30 m, 8 us", "every us", "sweep ns")
    print("".join(f"{word:>16}" for word in head))
    plant(*spheres(9, np.random.default_rng()).boxes, np.array([0, 9]), options.leaf)
    first: dict[str, float] = {}
    for kind, build, most in (("sphere", spheres, 1_000_000), ("prism", houses, 100_000)):
        for count in (8, 40, 100, 1_000, 10_000, 100_000, 1_000_000):
            if count > min(options.largest, most):
                continue
            rng = np.random.default_rng(count)
            obstacles = build(count, rng)
            boxes = obstacles.boxes
            start = time.perf_counter()
            obstacles.__dict__["tree"] = plant(*boxes, obstacles.scene_start, options.leaf)
            planted = 1e3 * (time.perf_counter() - start)
            lower, upper = obstacles.bounds()
            points = rng.uniform(lower, upper, (1, options.queries, 3))
            nearest = partial(obstacles.nearest, points)
            search = median_us(nearest, options.queries, options.repeats)
            ratio = search / first.setdefault(kind, search)
            near = median_us(partial(obstacles.near, points, 30.0, 8), options.queries, options.repeats)
            every = float("nan")
            if count <= 10_000:
                flat = ObstacleSet(obstacles.solids, obstacles.scene_start)
                flat.__dict__["tree"] = plant(*boxes, obstacles.scene_start, count)
                some = points[:, : max(20, min(options.queries, 2_000_000 // count))]
                every = median_us(partial(flat.nearest, some), some.shape[1], 3)
            sweep = flight_ns(obstacles, rng, 1_000, 200)
            print(
                f"{count:>16}{kind:>16}{planted:>16.2f}{search:>16.2f}{ratio:>16.1f}{near:>16.2f}"
                f"{every:>16.2f}{sweep:>16.0f}"
            )


if __name__ == "__main__":
    main()
