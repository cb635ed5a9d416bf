"""Past the end of a wall with errors of centimetres, as of RTK: contacts and finished missions by speed.

Run ``python benchmarks/small_margins.py``. Four UAVs in the 10 m square fly 110 m; a wall of 24 m stands
across their path, on a station of guidance's search or between two, thin or deep.
"""

from __future__ import annotations

import argparse
from itertools import product
from typing import Any

from napf_mpc import compare
from napf_mpc.problem import Problem
from napf_mpc.risk import wilson

PLACES_M, DEPTHS_M, SIGMAS_M = (50.0, 51.0), (0.2, 4.0), (0.02, 0.2, 0.5)


def scene(speed_mps: float, at_m: float, deep_m: float, sigma_m: float) -> Problem:
    """The square before a wall from 8 m to the left to 16 m to the right."""
    mission = {"kind": "formation", "length_m": 110.0, "speed_mps": speed_mps, "start_m": (0.0, 0.0, 10.0)}
    wall = {"shape": "box", "centre_m": (at_m, -4.0, 10.0), "size_m": (deep_m, 24.0, 60.0)}
    sigma = {"sigma_min_m": sigma_m, "sigma_max_m": sigma_m}
    given: dict[str, Any] = {
        "formation": {"shape": "square"},
        "mission": mission,
        "world": {"kind": "list", "obstacles": (wall,)},
        "navigation": {"kind": "gauss_markov", "filter": "kalman"} | sigma,
    }
    return Problem.model_validate(given)


def main() -> None:
    """Print one row for each speed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planner", default="qp")
    parser.add_argument("--runs", type=int, default=10, help="missions of each scene")
    parser.add_argument("--seed", type=int, default=3101)
    parser.add_argument("--speeds", default="2,4,8", help="m/s")
    arguments = parser.parse_args()
    print("| speed | obstacle contact [95 %] | unfinished | N |\n|---|---|---|---|")
    for speed in map(float, arguments.speeds.split(",")):
        hits = finished = total = 0
        for at_m, deep_m, sigma_m in product(PLACES_M, DEPTHS_M, SIGMAS_M):
            problem = scene(speed, at_m, deep_m, sigma_m)
            summary = compare(problem, (arguments.planner,), runs=arguments.runs, seed=arguments.seed)
            flown = summary["planners"][arguments.planner]
            hits += round(flown["collision_risk"] * arguments.runs)
            finished += round(flown["finished"] * arguments.runs)
            total += arguments.runs
        risk = wilson(hits, total)
        print(
            f"| {speed:g} m/s | {hits} = {risk.value:.1%} [{risk.low:.1%}, {risk.high:.1%}] "
            f"| {total - finished} | {total} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
