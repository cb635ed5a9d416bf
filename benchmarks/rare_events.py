"""Subset simulation against limit states with known answers, and against counting on a mission.

Run ``python benchmarks/rare_events.py known`` and
``python benchmarks/rare_events.py mission --out out/rare``, some minutes each; the tables of
``docs/statistics.md``. Whole flights take longer:
``python benchmarks/rare_events.py mission --set planner.k=3 --runs 3000 --out out/whole``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import integrate, optimize, stats

from napf_mpc.campaign import run_campaign
from napf_mpc.problem_file import load_problem
from napf_mpc.rare_events.estimate import estimate_collision_risk, log_normal_interval
from napf_mpc.rare_events.subset import LimitState, SubsetResult, subset_simulation
from napf_mpc.risk import wilson

Array = NDArray[np.float64]

SHORT = [
    "mission={length_m = 1.0, initial_velocities_mps = [[2.0,0,0], [2.0,0,0], [2.0,0,0], [2.0,0,0]]}",
    "world.count=1",
    "world.along_range_m=[9.0,12.0]",
    "world.radius_m=[0.3,0.6]",
    "simulation.time_limit_s=5.0",
    "simulation.controller_rate_hz=25.0",
    "planner.rate_hz=5.0",
    "planner.k=2",
    "navigation.rate_hz=5.0",
]
"""Settings that make table1_8 a flight of five seconds past one small ball, cheap enough to be counted."""


def along(dimension: int) -> Array:
    """A direction in which all numbers count alike."""
    return np.full(dimension, 1.0 / math.sqrt(dimension))


def hyperplane(p: float) -> tuple[LimitState, int]:
    beta = float(stats.norm.isf(p))
    return lambda u: beta - u @ along(100), 100


def two_hyperplanes(p: float) -> tuple[LimitState, int]:
    """Two modes, equally likely, in opposite directions."""
    beta = float(stats.norm.isf(0.5 * p))
    return lambda u: beta - np.abs(u @ along(100)), 100


@cache
def parabola_height(p: float) -> float:
    def log_ratio(height: float) -> float:
        def density(x: float) -> float:
            return float(stats.norm.pdf(x) * stats.norm.sf(height - 0.5 * (x - 0.1) ** 2))

        pieces = [integrate.quad(density, a, b)[0] for a, b in pairwise((-12.0, -4.0, 0.0, 4.0, 12.0))]
        return math.log(math.fsum(pieces) / p)

    return float(optimize.brentq(log_ratio, 1.0, 40.0))


def parabola(p: float) -> tuple[LimitState, int]:
    """Two modes, not equally likely: both arms of a parabola (Der Kiureghian and Dakessian 1998)."""
    height = parabola_height(p)
    return lambda u: height - u[:, 1] - 0.5 * (u[:, 0] - 0.1) ** 2, 2


def hidden_mode(p: float) -> tuple[LimitState, int]:
    """Two modes, equally likely; far from failure one of them looks three times less dangerous."""
    beta, w = float(stats.norm.isf(0.5 * p)), along(100)
    return lambda u: np.where(u @ w < 0.0, 3.0 * (beta + u @ w), beta - u @ w), 100


CASES: dict[str, Callable[[float], tuple[LimitState, int]]] = {
    "hyperplane, 100 numbers": hyperplane,
    "two hyperplanes, 100 numbers": two_hyperplanes,
    "parabola, both arms, 2 numbers": parabola,
    "a mode that shows late, 100 numbers": hidden_mode,
}


def estimates(case: str, p: float, seeds: int, samples: int) -> list[SubsetResult]:
    return [subset_simulation(*CASES[case](p), seed=seed, samples=samples) for seed in range(seeds)]


def within_factor_2(ratio: Array) -> int:
    return int(((ratio > 0.5) & (ratio < 2.0)).sum())


def known(seeds: int, samples: int) -> None:
    print(
        "| limit state | true P | within a factor 2 | mean of estimate / P | spread | claimed | bound | "
        "interval holds P | most calls |"
    )
    print("| --- |" + " ---: |" * 8)
    for case in CASES:
        for p in (1e-3, 1e-6):
            results = estimates(case, p, seeds, samples)
            ratio = np.array([result.probability for result in results]) / p
            ends = [log_normal_interval(result.probability, result.cov_bound) for result in results]
            held = sum(low <= p <= high for low, high in ends)
            cells = [
                f"{p:.0e}",
                f"{within_factor_2(ratio)} of {seeds} ({within_factor_2(ratio[:20])} of the first 20)",
                f"{ratio.mean():.2f}",
                f"{ratio.std(ddof=1) / ratio.mean():.2f}",
                f"{np.mean([result.cov for result in results]):.2f}",
                f"{np.mean([result.cov_bound for result in results]):.2f}",
                f"{held} of {seeds}",
                f"{max(result.calls for result in results):,}",
            ]
            print(f"| {case} | " + " | ".join(cells) + " |", flush=True)
    print(f"\nN = {samples} samples a level, seeds 0 to {seeds - 1}.")


def mission(name: str, settings: list[str], runs: int, seeds: int, samples: int, out: Path) -> None:
    problem = load_problem(name, settings)
    counted = run_campaign(problem, ["napf"], runs, 0, out / "counted", name=name)["planners"]["napf"]
    rate = wilson(round(counted["collision_risk"] * runs), runs)
    print("| method | collision risk | 95 % interval | missions |")
    print("| --- | ---: | ---: | ---: |")
    print(f"| counting, seed 0 | {rate.value:.2e} | {rate.low:.2e} to {rate.high:.2e} | {runs:,} |")
    for seed in range(seeds):
        found = estimate_collision_risk(
            problem, "napf", out / f"seed_{seed}", samples=samples, seed=seed, name=name
        )
        ends = f"{found['collision_risk_low']:.2e} to {found['collision_risk_high']:.2e}"
        line = f"{found['collision_risk']:.2e} (cov {found['cov']:.2f}) | {ends} | {found['calls']:,}"
        print(f"| subset simulation, seed {seed} | {line} |", flush=True)
    print(f"\n{name} with {', '.join(settings)}; planner napf, {samples} missions a level.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("known", "mission"))
    parser.add_argument("--problem", default="table1_8")
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--samples", type=int)
    parser.add_argument("--out", type=Path, default=Path("out/rare"))
    given = parser.parse_args()
    if given.what == "known":
        known(given.seeds or 100, given.samples or 1500)
    else:
        settings = given.settings or SHORT
        mission(given.problem, settings, given.runs, given.seeds or 5, given.samples or 500, given.out)


if __name__ == "__main__":
    main()
