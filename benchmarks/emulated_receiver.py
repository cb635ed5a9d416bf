"""Errors of emulated receivers along the path of a problem, and what they report: by settings.

    python benchmarks/emulated_receiver.py [--problem nishi_shinjuku_gnss --data DIR] [--runs N] [--seed S]

UAVs stay in their slots at the reference speed, one epoch a second, no filter, no planner; every run has its
own time of the day. Epochs of a run are correlated: N is the number of runs.
"""

import argparse
from pathlib import Path

import numpy as np

from napf_mpc.closed_loop import build_scenario, formation_mission
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.pseudorange_solution import Check
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem

SETTINGS = [
    [],
    ["believed_reflection_m=0"],
    ["believed_reflection_m=5"],
    ["carrier_to_noise_mask_dbhz=35"],
    ['weighting="plain"'],
    ['weighting="cauchy"'],
    ['fault_exclusion="none"'],
    ['weighting="plain"', 'fault_exclusion="none"'],
]


def row(problem: Problem, seed: int, runs: int, folder: Path | None) -> str:
    """One line of the table."""
    errors = build_scenario(problem, seed, range(runs), folder).errors
    assert isinstance(errors, GnssErrors)
    mission = formation_mission(problem)
    frame, offsets = PathFrame.of_mission(mission), formation_offsets(problem.formation)
    fixes = errors.begin()
    error, sigma, there, check, shared = [], [], [], [], []
    for epoch in range(int(mission.length_m / mission.speed_mps)):
        slots = offsets + np.array([mission.speed_mps * epoch, 0.0, 0.0])
        fix = fixes.fix(epoch, np.repeat(frame.to_world(slots)[None], runs, axis=0))
        deviation = np.sqrt(np.einsum("ruaa->rua", fix.covariance))
        between = np.einsum("rak,rak->ra", fix.common_factor[:, 0], fix.common_factor[:, 1])
        shared.append(between / (deviation[:, 0] * deviation[:, 1]))
        error.append(fix.error)
        sigma.append(deviation)
        there.append(fix.available)
        check.append(fixes.check.copy())
    available = np.array(there)
    e, s = np.array(error)[available], np.array(sigma)[available]
    across = np.hypot(e[:, 0], e[:, 1])
    inside = " | ".join(
        " ".join(f"{100 * share:.1f}" for share in (np.abs(e) < k * s).mean(axis=0)) for k in (1, 2, 3)
    )
    faulty = np.mean(np.array(check) == Check.FAULTY)
    return (
        f"{100 * available.mean():.1f} % | {np.median(across):.2f} / {np.quantile(across, 0.95):.1f} "
        f"| {np.median(np.abs(e[:, 2])):.2f} / {np.quantile(np.abs(e[:, 2]), 0.95):.1f} "
        f"| {' '.join(f'{q:.1f}' for q in np.median(s, axis=0))} | {inside} "
        f"| {np.median(np.array(shared)):.2f} | {100 * faulty:.1f} %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", default="street_canyon_gnss")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{options.problem}, N = {options.runs} runs, seed {options.seed}; east, north, up")
    print(
        "| settings | fix | H error median / 95 % [m] | V [m] | sigma, median [m] | in 1 sigma [%] | in 2 "
        "| in 3 | shared | faulty |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for settings in SETTINGS:
        keys = [f"navigation.{setting}" for setting in settings]
        problem = load_problem(options.problem, ["navigation.rate_hz=1", *keys])
        line = row(problem, options.seed, options.runs, options.data)
        print(f"| {', '.join(settings) or 'default'} | {line} |", flush=True)


if __name__ == "__main__":
    main()
