"""Protection levels of emulated receivers along a problem's path: how often there is one, and is it true.

Run ``python benchmarks/integrity_gnss.py --problem street_canyon_gnss --runs 40 [--data DIR] [--out DIR]``
(minutes on one core); it prints Markdown, and with ``--out`` draws Stanford diagrams. Receivers move along
their lanes at the mission's speed, at some heights, one epoch a second: places do not depend on navigation.
Seeds 300 to 399 are for development, 7000 and more for reports.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.closed_loop import POSITION, build_scenario, formation_mission, initial_state
from napf_mpc.formation import PathFrame
from napf_mpc.navigation.gnss_fixes import GnssErrors, solve_observation, solver_settings
from napf_mpc.navigation.gnss_levels import levels_of, with_levels
from napf_mpc.navigation.integrity.levels import NoLevel
from napf_mpc.navigation.pseudorange_solution import Check
from napf_mpc.plot import StanfordPanel, draw_stanford
from napf_mpc.problem import Gnss
from napf_mpc.problem_file import load_problem
from napf_mpc.risk import wilson
from napf_mpc.streams import NormalRows, Stream

Array = NDArray[np.float64]

K = 3.0
ALERT_LIMITS_M = (40.0, 50.0)
"""Of the approach APV-I, for want of one for UAVs."""
FAR_M = 400.0
"""Larger levels are drawn here [m]."""


@dataclass(frozen=True)
class Walked:
    """Epochs of all receivers, in a row."""

    error: Array
    """(n, 2) horizontal and vertical error of the position with levels where there is one, else the other."""
    level: Array
    """(n, 2) HPL and VPL, infinite without."""
    usual_error: Array
    """(n, 2) of the robust solution, NaN without a fix."""
    usual_level: Array
    """(n, 2) k sigma of its report."""
    why: NDArray[np.int8]
    """(n,) codes of :class:`NoLevel`."""
    excluded: NDArray[np.int64]
    """(n,) satellites excluded by alarms."""
    run: NDArray[np.int64]
    """(n,) which run, as epochs of one are not independent."""
    trusted: NDArray[np.int64]
    """(n,) satellites in the position with a level, 0 without."""
    level_ms: float
    """Processor time of a level [ms]."""


def walk(
    name: str, seed: int, runs: int, height_m: float | None, data: Path | None, settings: Sequence[str]
) -> Walked:
    """Move receivers along their lanes; heights are above the ground, None for the mission's own."""
    problem = load_problem(name, ['navigation.integrity="araim"', 'navigation.filter="none"', *settings])
    mission = formation_mission(problem)
    scenario = build_scenario(problem, seed, range(runs), data)
    errors = scenario.errors
    assert isinstance(errors, GnssErrors)
    assert isinstance(problem.navigation, Gnss)
    frame = PathFrame.of_mission(mission)
    start = initial_state(problem)[None, :, POSITION]
    noise = NormalRows(seed, range(runs), Stream.GNSS_NOISE, problem.uav_count, len(errors.scene.names), 1)
    found: list[tuple[NDArray[Any], ...]] = []
    spent = 0.0
    steps = int(mission.length_m / mission.speed_mps)
    for step in range(steps):
        place = np.repeat(start + float(step) * mission.speed_mps * frame.along, runs, axis=0)
        if height_m is not None:
            place[..., 2] = height_m
        observed = errors.scene.observe(float(step), place, noise.take())
        if step == 0:
            levels_of(observed, errors.scene)  # compiles
        before = time.process_time()
        levels = levels_of(observed, errors.scene)
        spent += time.process_time() - before
        usual = solve_observation(observed, errors.scene, solver_settings(problem.navigation))
        mine = with_levels(usual, levels, observed, errors.scene)
        inside = errors.scene.obstacles.signed_distance(place).reshape(-1) < 0.0  # nobody flies there
        lost = (usual.check == Check.NONE) | inside
        sigma = np.sqrt(np.einsum("nii->ni", usual.covariance))
        at = np.repeat(np.arange(runs), problem.uav_count)
        rows = (
            _split(mine.offset), levels.level_m, np.where(lost[:, None], np.nan, _split(usual.offset)),
            K * np.stack([np.hypot(sigma[:, 0], sigma[:, 1]), sigma[:, 2]], -1),
            levels.why, levels.excluded, at,
            np.where(levels.why == NoLevel.NONE, levels.used.sum(-1), 0),
        )  # fmt: skip
        found.append(tuple(row[~inside] for row in rows))
    joined = [np.concatenate(parts) for parts in zip(*found, strict=True)]
    error, level, usual_error, usual_level, why, excluded, run, trusted = joined
    return Walked(
        error, level, usual_error, usual_level, why, excluded, run, trusted,
        1e3 * spent / (steps * runs * problem.uav_count),
    )  # fmt: skip


def _split(offset: Array) -> Array:
    return np.stack([np.hypot(offset[:, 0], offset[:, 1]), np.abs(offset[:, 2])], axis=-1)


def rows_of(words: str, walked: Walked) -> str:
    """One row of Markdown."""
    known = walked.why == NoLevel.NONE
    wrong = known & (walked.error > walked.level).any(-1)
    rate = wilson(int(wrong.sum()), max(1, int(known.sum())))
    fixed = np.isfinite(walked.usual_error).all(-1)
    usual = fixed & (walked.usual_error > walked.usual_level).any(-1)
    other = wilson(int(usual.sum()), max(1, int(fixed.sum())))
    median = np.median(walked.level[known], axis=0) if known.any() else np.full(2, np.nan)
    sigma = np.median(walked.usual_level[fixed], axis=0)
    limit = 100.0 * (walked.level <= ALERT_LIMITS_M).all(-1).mean()
    reasons = [
        f"{100 * (walked.why == kind).mean():.0f}"
        for kind in (NoLevel.FEW, NoLevel.UNMONITORED, NoLevel.ALARM)
    ]
    hit = f"[{1e3 * rate.low:.2f}, {1e3 * rate.high:.2f}] e-3, {len(np.unique(walked.run[wrong]))} runs"
    cells = (
        words,
        f"{len(known)}",
        f"{100 * known.mean():.1f} %",
        f"{', '.join(reasons)} %",
        f"{100 * (known & (walked.excluded > 0)).mean():.1f} %",
        f"{median[0]:.1f}, {median[1]:.1f}",
        f"{limit:.1f} %",
        f"{rate.count} of {known.sum()} {hit}",
        f"{100 * fixed.mean():.1f} %",
        f"{sigma[0]:.1f}, {sigma[1]:.1f}",
        f"{other.count} [{1e3 * other.low:.1f}, {1e3 * other.high:.1f}] e-3",
    )
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problem", default="street_canyon_gnss")
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=300)
    parser.add_argument("--heights", default="")
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--set", action="append", default=[])
    chosen = parser.parse_args()
    print(
        "| height | epochs | with a level | none: few satellites, unmonitored faults, alarm "
        "| after exclusion | HPL, VPL, median [m] | within 40, 50 m | misleading [95 %] | with a fix "
        "| 3 sigma of it, median [m] | beyond 3 sigma [95 %] |"
    )
    print("| --- " * 11 + "|")
    heights = [None, *(float(h) for h in chosen.heights.split(",") if h)]
    for height in heights:
        walked = walk(chosen.problem, chosen.seed, chosen.runs, height, chosen.data, chosen.set)
        print(rows_of("the mission's" if height is None else f"{height:g} m", walked), flush=True)
        if height is None:
            first = walked
    count = np.median(first.trusted[first.trusted > 0])
    print(f"\n{first.level_ms:.3f} ms a level; {count:.0f} satellites in it")
    if chosen.out is not None:
        usual = np.where(np.isnan(first.usual_error), np.inf, first.usual_level)
        # Levels of kilometres would take the room of those that matter.
        level = np.where(np.isfinite(first.level), np.minimum(first.level, FAR_M), np.inf)
        sources = (("3 reported sigmas", first.usual_error, usual), ("protection level", first.error, level))
        panels = [
            StanfordPanel(f"{word}, {what}", error[:, a], bound[:, a], ALERT_LIMITS_M[a])
            for a, word in enumerate(("Horizontal", "Vertical"))
            for what, error, bound in sources
        ]
        draw_stanford(panels, chosen.out, f"{chosen.problem}_stanford", "")


if __name__ == "__main__":
    main()
