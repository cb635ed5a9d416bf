"""Faults injected into the position fixes, and reported sigmas that are too small or too large.

Run ``python benchmarks/navigation_faults.py --runs 100 --table all`` (some minutes on one core); it prints
Markdown. The fault is that of the first UAV's receiver, from ``START_S`` on; the other UAVs, the scenes and
all errors are those of the flight without it. Seeds 300 to 399 are for development, 7000 and more for
reports.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import cast

import numpy as np
from numpy.typing import NDArray

from napf_mpc.block import Missions, simulate
from napf_mpc.closed_loop import POSITION, build_scenario, closed_loop
from napf_mpc.evaluate import MissionScore, Score
from napf_mpc.navigation.fix import Fix, PositionErrors
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.risk import mcnemar, wilson
from napf_mpc.vehicle.quadrotor import mixer_inverse, rotor_limit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

START_S = 15.0
PROBLEM = "study_8s"
SETTINGS = (
    'navigation.filter="kalman"',
    'navigation.monitor="innovations"',
    "simulation.time_limit_s=200",  # so that who waits for a minute can still arrive
)


@dataclass(frozen=True)
class Fault:
    """What happens to the fixes of the first UAV."""

    words: str
    """For the table."""
    lasts_s: float
    """How long [s]."""


FAULTS = {
    "none": Fault("none", 0.0),
    "nan": Fault("position not a number, 5 s", 5.0),
    "zero": Fault("variance zero, 5 s", 5.0),
    "negative": Fault("variance negative, 5 s", 5.0),
    "asymmetric": Fault("covariance not symmetric, 5 s", 5.0),
    "jump": Fault("jump of 10 m, 20 s", 20.0),
    "jump_stays": Fault("jump of 10 m to the end", 1e3),
    "drift": Fault("drift of 0.1 m/s to the end", 1e3),
    "stuck": Fault("position stuck, 10 s", 10.0),
    "delayed": Fault("fixes 0.5 s late to the end", 1e3),
    "slow": Fault("fixes at 1 Hz, 30 s", 30.0),
    "outage_1": Fault("outage of 1 s", 1.0),
    "outage_5": Fault("outage of 5 s", 5.0),
    "outage_69": Fault("outage of 69 s", 69.0),
    "back": Fault("every other fix is that of 1 s before, 10 s", 10.0),
}


class FaultyErrors:
    """Position errors with a fault; an observer of the truth, as a receiver that lags or sticks needs it.

    Parameters
    ----------
    inner : PositionErrors
        Errors without the fault.
    kind : str
        Key of :data:`FAULTS`.
    position : array, shape (run, uav, 3)
        True position at the start [m].
    """

    def __init__(self, inner: PositionErrors, kind: str, position: Array) -> None:
        self._inner, self._kind, self._fault = inner, kind, FAULTS[kind]
        self._truth = position.copy()
        self._measured: list[Array] = []

    @property
    def period_s(self) -> float:
        """Time between two epochs [s]."""
        return self._inner.period_s

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Note where the UAVs are."""
        self._truth = after[..., POSITION].copy()

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Nothing to note."""

    def fix(self, epoch: int) -> Fix:
        """Return the fix of an epoch, with the fault in that of the first UAV."""
        fix = self._inner.fix(epoch)
        time_s = epoch * self.period_s
        measured = self._truth[:, 0] + fix.error[:, 0]
        self._measured.append(measured)
        since = time_s - START_S
        if not 0.0 <= since < self._fault.lasts_s:
            return fix
        error, covariance = fix.error.copy(), fix.covariance.copy()
        available = fix.available.copy()
        first = round(START_S / self.period_s)
        match self._kind:
            case "nan":
                error[:, 0] = np.nan
            case "zero":
                covariance[:, 0] = 0.0
            case "negative":
                covariance[:, 0] *= -1.0
            case "asymmetric":
                covariance[:, 0, 0, 1] += 0.5 * covariance[:, 0, 0, 0]
            case "jump" | "jump_stays":
                error[:, 0, 1] += 10.0
            case "drift":
                error[:, 0, 1] += 0.1 * since
            case "stuck":
                error[:, 0] = self._measured[first] - self._truth[:, 0]
            case "delayed":
                error[:, 0] = self._measured[epoch - round(0.5 / self.period_s)] - self._truth[:, 0]
            case "slow":
                available[:, 0] &= epoch % round(1.0 / self.period_s) == 0
            case "back":
                if epoch % 2:
                    error[:, 0] = self._measured[epoch - round(1.0 / self.period_s)] - self._truth[:, 0]
            case _:  # outages
                available[:, 0] = False
        return replace(fix, error=error, covariance=covariance, available=available)


class Watch:
    """What the first UAV's navigation said, and whether any command or input left its limits."""

    def __init__(self, problem: Problem, runs: int) -> None:
        mission = problem.mission
        assert isinstance(mission, FormationMission)
        self._speed = problem.planner.max_speed_ratio * mission.speed_mps
        self._inverse = mixer_inverse(problem.vehicle)
        self._rotor = rotor_limit(problem.vehicle)
        self.tick_s = 1.0 / problem.simulation.controller_rate_hz
        self.unavailable = np.zeros(runs, dtype=np.int64)
        self.outside = np.zeros(runs, dtype=np.bool_)
        self.largest_error_m = np.zeros(runs)

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Nothing to note."""

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Note availability, the estimate's error, and limits."""
        self.unavailable += active & ~nav.available[:, 0]
        off = np.sqrt(((nav.position[:, 0] - state[:, 0, POSITION]) ** 2).sum(-1))
        flown = active & (time_s >= START_S)
        self.largest_error_m = np.where(flown, np.fmax(self.largest_error_m, off), self.largest_error_m)
        speed = np.sqrt((command.velocity**2).sum(-1))
        rotors = np.einsum("ab,rub->rua", self._inverse, inputs)
        beyond = ~((rotors >= -1e-6) & (rotors <= self._rotor + 1e-6)).all(-1)
        if command.plan is None:
            beyond |= ~(speed <= self._speed + 1e-9)
        self.outside |= active & beyond.any(-1)


@dataclass(frozen=True)
class Flown:
    """Missions with one fault."""

    score: Score
    """On the truth."""
    watch: Watch
    """Of the first UAV."""
    alarms: NDArray[np.int64]
    """(run,) alarms of the monitor, first UAV."""
    gated: NDArray[np.int64]
    """(run,) refused fixes, all UAVs."""
    missed: Array
    """(run,) epochs without a fix, all UAVs."""


def fly(
    kind: str, planner: str, seed: int, runs: int, settings: Sequence[str] = SETTINGS, name: str = PROBLEM
) -> Flown:
    """Fly missions with one fault."""
    problem = load_problem(name, list(settings))
    scenario = build_scenario(problem, seed, range(runs))
    drawn = cast(PositionErrors, scenario.errors)  # of a problem whose errors do not depend on places
    faulty = FaultyErrors(drawn, kind, scenario.initial_state[..., POSITION])
    scenario = replace(scenario, errors=faulty)
    judge, watch = MissionScore(problem, scenario), Watch(problem, runs)
    flight = closed_loop(problem, make_planner(planner, problem), scenario, [judge, watch, faulty])
    assert flight.gated_fixes is not None
    alarms = np.zeros(runs, dtype=np.int64) if flight.monitor is None else flight.monitor.alarms[:, 0]
    score = judge.score(flight)
    return Flown(score, watch, alarms, flight.gated_fixes, score.metrics["missed_fixes"])


def flags(flown: Flown, clean: Flown) -> dict[str, Mask]:
    """Who noticed, run by run: what is counted more often than without the fault."""
    return {
        "gate": flown.gated > clean.gated,
        "missed": flown.missed > clean.missed,
        "monitor": flown.alarms > clean.alarms,
        "unavailable": flown.watch.unavailable > clean.watch.unavailable,
    }


def fault_table(planner: str, seed: int, runs: int, kinds: Sequence[str]) -> Iterator[str]:
    """Markdown: each fault, who flags it, and what comes of it."""
    clean = fly("none", planner, seed, runs)
    yield from (
        f"{planner}, {PROBLEM} behind the filter with its monitor, seed {seed}, N = {runs} missions a row.",
        "",
        "| fault | refused by gate | missed | monitor | not available | flagged at all | "
        "not available, median [s] | largest error of the estimate, median [m] | contacts [95 %] | "
        "two UAVs | finished | outside limits |",
        "| --- " * 12 + "|",
    )
    for kind in kinds:
        fault = FAULTS[kind]
        flown = clean if kind == "none" else fly(kind, planner, seed, runs)
        seen = flags(flown, clean)
        cells = [f"{int(mask.sum())}" for mask in seen.values()]
        any_flag = int(np.any(list(seen.values()), axis=0).sum())
        hit = wilson(int(flown.score.obstacle_contact.any(-1).sum()), runs)
        yield (
            f"| {fault.words} | {' | '.join(cells)} | {any_flag} of {runs} | "
            f"{np.median(flown.watch.unavailable) * flown.watch.tick_s:.1f} | "
            f"{np.median(flown.watch.largest_error_m):.1f} | "
            f"{hit.count} [{100 * hit.low:.1f}, {100 * hit.high:.1f}] % | "
            f"{int(flown.score.uav_contact.any(-1).sum())} | "
            f"{int(flown.score.finished.sum())} | {int(flown.watch.outside.sum())} |"
        )


def median_interval(values: Array) -> tuple[float, float, float]:
    """Median and its distribution-free 95 % interval, from order statistics (binomial, normal limit)."""
    ordered = np.sort(values)
    n = len(ordered)
    half = 0.98 * np.sqrt(n)
    low, high = max(0, int(np.floor(n / 2 - half)) - 1), min(n - 1, int(np.ceil(n / 2 + half)))
    return float(np.median(ordered)), float(ordered[low]), float(ordered[high])


def confidence_table(planner: str, seed: int, runs: int) -> list[str]:
    """Markdown: sigma reported a fifth, as it is, and five times; with and without the monitor, paired."""

    def missions(scale: float, monitor: str) -> Missions:
        settings = [
            SETTINGS[0],
            f'navigation.monitor="{monitor}"',
            f"navigation.reported_sigma_scale={scale}",
        ]
        return simulate(load_problem(PROBLEM, settings), planner, seed=seed, runs=runs)

    lines = [
        f"{planner}, {PROBLEM}, seed {seed}, N = {runs} missions a row; differences to the first row.",
        "",
        "| sigma reported x | monitor | contacts [95 %] | McNemar p | least clearance, median [m] | its "
        "difference, median [95 %] [m] | flagged axes | last first alarm [s] | NEES of the position |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    base = missions(1.0, "none")
    hits = base.score.obstacle_contact.any(-1)
    for scale, monitor in product((1.0, 0.2, 0.5, 5.0), ("none", "innovations")):
        flown = base if (scale, monitor) == (1.0, "none") else missions(scale, monitor)
        mine = flown.score.obstacle_contact.any(-1)
        rate = wilson(int(mine.sum()), runs)
        clear = flown.score.metrics["min_clearance_m"]
        shift = median_interval(clear - base.score.metrics["min_clearance_m"])
        first: dict[tuple[int, int, str], float] = {}
        for event in flown.tally.events:
            if "innovations" in event.cause:
                first.setdefault((event.run, event.uav, event.cause), event.time_s)
        axes = runs * 3 * mine_uavs(flown)
        told = f"{len(first)} of {axes}" if monitor != "none" else ""
        last = f"{max(first.values()):.1f}" if first else ""
        lines.append(
            f"| {scale:g} | {monitor} | {rate.count} [{100 * rate.low:.1f}, {100 * rate.high:.1f}] % | "
            f"{mcnemar(int((mine & ~hits).sum()), int((hits & ~mine).sum())):.2g} | {np.median(clear):.2f} | "
            f"{shift[0]:+.2f} [{shift[1]:+.2f}, {shift[2]:+.2f}] | {told} | {last} | "
            f"{np.median(flown.score.metrics['nees_position']):.2f} |"
        )
    return lines


def mine_uavs(flown: Missions) -> int:
    return int(flown.score.obstacle_contact.shape[1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=300)
    parser.add_argument("--planner", default="napf")
    parser.add_argument("--faults", default=",".join(FAULTS), help="some of them")
    parser.add_argument("--table", choices=("faults", "confidence", "all"), default="all")
    chosen = parser.parse_args()
    if chosen.table in ("faults", "all"):
        for line in fault_table(chosen.planner, chosen.seed, chosen.runs, chosen.faults.split(",")):
            print(line, flush=True)
        print()
    if chosen.table in ("confidence", "all"):
        print("\n".join(confidence_table(chosen.planner, chosen.seed, chosen.runs)))


if __name__ == "__main__":
    main()
