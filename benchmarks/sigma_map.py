"""Whether covariance that follows the place, Sigma(p), predicts better, and what the QP planner makes of it.

    python benchmarks/sigma_map.py [--problem nishi_shinjuku_gnss --data DIR] [--runs N] [--seed S] [--lanes]
                                   [--open-sky WEIGHT ...] [--planner napf_guided] [--room]

Flies every run twice on the same skies, scenes and errors, with ``planner.covariance = "expected"`` and
``"mapped"``. On both flights the navigation filter is asked, once a second, what covariance it expects 2 s
and 5 s ahead at the places of the plan, with the sigma map and without; that is held against what the filter
reports then, and the error of its estimate. Samples of a run are correlated: intervals are over runs. Prints
Markdown. The score is 0.5 (ln variance + error^2 / variance), mean over axes: the less, the better.

With ``--lanes`` nobody flies: UAVs stay in their slots at the reference speed, and what their receivers
report is held against the map, and against what was reported some metres before.

With ``--open-sky`` runs fly also with those weights of ``planner.open_sky_weight``, and nothing is forecast:
each is held against "mapped" without a price, and what the filter reports in flight against the errors it
makes. With ``--room`` nobody flies: what would fixes be if the formation went elsewhere, walls or not?

Seeds 300 to 399 are for development, 7000 to 7999 for reports.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.closed_loop import Scenario, build_scenario, closed_loop, formation_mission
from napf_mpc.evaluate import MissionScore, Score
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.gnss import GnssScene
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.gnss_sigma import expected_variance
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.guide_sky import NO_FIX_M2
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.planners.planner import Command
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.risk import clustered_rate, mcnemar, wilson

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WAYS = ("expected", "mapped")
TIMES_S = np.arange(0.5, 5.01, 0.5)
SHOWN_S = {2.0: 3, 5.0: 9}
"""Time ahead -> its index in TIMES_S."""
POSITION = slice(0, 6, 2)
SETTLED_S = 12.0
"""The filter's first seconds do not count."""


@dataclass
class Watch:
    """Asks for forecasts once a second, and keeps what is reported and true; an observer of the flight."""

    forecasts: dict[tuple[str, float], list[Array]] = field(default_factory=dict)
    """By way and time ahead: variances (run, uav, 3), one a second [m^2]."""
    reported: list[Array] = field(default_factory=list)
    """Variances (run, uav, 3), one a second [m^2]."""
    error: list[Array] = field(default_factory=list)
    """Errors of the estimate (run, uav, 3) [m]."""
    flying: list[Mask] = field(default_factory=list)
    """(run,)."""
    nav: NavSolution | None = None
    """What the planner was given last."""

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Nothing is kept of the plant's steps."""

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Keep what is known at whole seconds."""
        if abs(time_s - round(time_s)) > 1e-6:
            return
        assert command.plan is not None
        assert self.nav is not None
        places = np.stack([command.plan.at(time_s + ahead)[0][..., POSITION] for ahead in TIMES_S], axis=2)
        for way in WAYS:
            given = replace(nav, sigma_map=self.nav.sigma_map if way == "mapped" else None)
            ahead = np.einsum("...aa->...a", given.position_covariance_ahead(TIMES_S, True, places))
            for shown, index in SHOWN_S.items():
                self.forecasts.setdefault((way, shown), []).append(ahead[:, :, index])
        self.reported.append(np.einsum("...aa->...a", nav.position_covariance).copy())
        self.error.append(nav.position - state[..., POSITION])
        self.flying.append(active.copy())


class Flown(QpPlanner):
    """The planner, with what it is given shown to a watch."""

    def __init__(self, problem: Problem, watch: Watch) -> None:
        super().__init__(problem)
        self._watch = watch

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """As the planner does."""
        self._watch.nav = nav
        return super().step(nav, time_s)


def fly(problem: Problem, scenario: Scenario) -> tuple[Score, Watch, float]:
    """Verdicts, what was watched, and the processor time."""
    watch, judge = Watch(), MissionScore(problem, scenario)
    began = time.process_time()
    flight = closed_loop(problem, Flown(problem, watch), scenario, (judge, watch))
    return judge.score(flight), watch, time.process_time() - began


@dataclass
class Certainty:
    """Keeps once a second how certain the UAVs are of their places, and how wrong; an observer."""

    reported: list[Array] = field(default_factory=list)
    """(run,) mean over UAVs of the horizontal variance, both axes together [m^2]; NaN after the flight."""
    error: list[Array] = field(default_factory=list)
    """The same of the squared horizontal error [m^2]."""

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        """Nothing is kept of the plant's steps."""

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        """Keep what is known at whole seconds."""
        if abs(time_s - round(time_s)) > 1e-6 or time_s < SETTLED_S:
            return
        variance = np.einsum("...aa->...a", nav.position_covariance)[..., :2].sum(-1).mean(-1)
        error = ((nav.position - state[..., POSITION])[..., :2] ** 2).sum(-1).mean(-1)
        self.reported.append(np.where(active, variance, np.nan))
        self.error.append(np.where(active, error, np.nan))

    def metrics(self) -> dict[str, Array]:
        """Values (run,): median of the reported horizontal sigma, rms of the horizontal error [m]."""
        sigma = np.nanmedian(np.sqrt(np.array(self.reported)), axis=0)
        return {"sigma_m": sigma, "error_m": np.sqrt(np.nanmean(np.array(self.error), axis=0))}


def open_sky(name: str, planner: str, weights: list[float], scenario: Scenario) -> None:
    """Fly with and without prices of the sky, and print the tables."""
    ways: dict[str, dict[str, object]] = {way: {"planner.covariance": way} for way in WAYS}
    for weight in weights:
        ways[f"weight {weight:g}"] = {"planner.covariance": "mapped", "planner.open_sky_weight": weight}
    scores: dict[str, Score] = {}
    shown = ("path_rms_m", "shape_rms_m", "min_clearance_m", "finish_time_s", "sigma_m", "error_m")
    print(
        "| planner | contact [95 %] | finished | path, rms [m] | shape, rms [m] | clearance [m] | finish [s] "
        "| CPU | sigma [m] | error, rms [m] |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for way, keys in ways.items():
        problem = load_problem(name, keys)
        judge, certainty = MissionScore(problem, scenario), Certainty()
        began = time.process_time()
        flight = closed_loop(problem, make_planner(planner, problem), scenario, (judge, certainty))
        cost_s = time.process_time() - began
        scores[way] = score = judge.score(flight)
        score.metrics.update(certainty.metrics())
        row = flight_row(way, score, cost_s)
        print(row, spread(score, "sigma_m"), "|", spread(score, "error_m"), "|", flush=True)
    mapped = scores.pop("mapped")
    hit = np.asarray(mapped.obstacle_contact.any(-1))
    for way, score in scores.items():
        other = np.asarray(score.obstacle_contact.any(-1))
        only = int((hit & ~other).sum()), int((other & ~hit).sum())
        print(
            f"\n{way}, less mapped, mean of pairs; contacts of one only: {only[0]} mapped, {only[1]} {way}; ",
            end="",
        )
        print(f"McNemar p = {mcnemar(*only):.3g}")
        for metric in shown:
            change = score.metrics[metric] - mapped.metrics[metric]
            print(f"- {metric}: {mean_with_interval(change[np.isfinite(change)])}")


def room_rows(problem: Problem, scenario: Scenario) -> list[str]:
    """Root mean square of the fix to be expected over lanes that are moved, the formation as a whole."""
    made = scenario.sigma_map
    assert made is not None
    mission = formation_mission(problem)
    frame, slots = PathFrame.of_mission(mission), formation_offsets(problem.formation)
    along = np.arange(0.0, mission.length_m, 2.0)

    def square(left_m: float, up_m: float) -> Array:
        moved = [slots + np.array([place, left_m, up_m]) for place in along]
        places = np.repeat(frame.to_world(np.array(moved).reshape(-1, 3))[None], len(scenario.runs), axis=0)
        own, lasting = made.variance(places)
        bound = np.minimum((own + lasting).sum(-1), NO_FIX_M2)
        return np.asarray(bound.reshape(len(places), len(along), -1).mean(-1))

    lefts = np.arange(-10.0, 10.1, 1.0)
    over = np.array([square(left, 0.0) for left in lefts])
    rows = [f"| on the lanes | {mean_with_interval(np.sqrt(square(0.0, 0.0).mean(-1)))} |"]
    for most in (2.0, 5.0, 10.0):
        best = over[np.abs(lefts) <= most].min(0)
        rows.append(f"| best within {most:g} m aside | {mean_with_interval(np.sqrt(best.mean(-1)))} |")
    rows.append(f"| 10 m higher | {mean_with_interval(np.sqrt(square(0.0, 10.0).mean(-1)))} |")
    return rows


def lane_rows(problem: Problem, seed: int, runs: int, folder: Path | None) -> list[str]:
    """How far sigmas that receivers report on their lanes are from what was foreseen, as a table's rows."""
    scenario = build_scenario(problem, seed, range(runs), folder)
    errors, made = scenario.errors, scenario.sigma_map
    assert isinstance(errors, GnssErrors)
    assert made is not None
    mission = formation_mission(problem)
    frame, slots = PathFrame.of_mission(mission), formation_offsets(problem.formation)
    fixes = errors.begin()
    reported: list[Array] = []
    foreseen: dict[str, list[Array]] = {
        "at the place, as due": [],
        "at the place, sky of the start": [],
        "map": [],
    }
    for epoch in range(int(mission.length_m / mission.speed_mps)):
        moved = frame.to_world(slots + np.array([mission.speed_mps * epoch, 0.0, 0.0]))
        fix = fixes.fix(epoch, np.repeat(moved[None], runs, axis=0))
        variance = np.einsum("...aa->...a", fix.covariance)
        reported.append(np.where(fix.available[..., None], variance, np.nan))
        for name, time_s in (("at the place, as due", float(epoch)), ("at the place, sky of the start", 0.0)):
            parts = [expected_variance(_of_run(errors.scene, run), moved, time_s) for run in range(runs)]
            foreseen[name].append(np.array(parts)[..., :3] + np.array(parts)[..., 3:])
        own, lasting = made.variance(np.repeat(moved[None], runs, axis=0))
        foreseen["map"].append(own + lasting)
    then = np.array(reported)
    rows = []
    free = np.isfinite(np.array(foreseen["at the place, as due"]))  # a lane may lead through a house
    for name, values in foreseen.items():
        rows.append(_lane_row(name, 0.5 * np.log(np.array(values) / then), free))
    for ahead in (2, 5):
        apart = 0.5 * np.log(then[:-ahead] / then[ahead:])
        rows.append(_lane_row(f"as reported {ahead} s before", apart, free[ahead:] & free[:-ahead]))
    return rows


def _lane_row(name: str, apart: Array, free: Mask) -> str:
    sound = free & np.isfinite(apart)
    squares = np.where(sound, apart, 0.0) ** 2
    rms = np.sqrt(squares.sum((0, 2, 3)) / sound.sum((0, 2, 3)))
    low, middle, high = np.quantile(apart[sound], (0.05, 0.5, 0.95))
    return f"| {name} | {mean_with_interval(rms)} | {middle:+.3f} [{low:+.3f}, {high:+.3f}] |"


def _of_run(scene: GnssScene, run: int) -> GnssScene:
    return scene.of_run(run, scene.obstacles if scene.obstacles.n_scenes == 1 else scene.obstacles.scene(run))


def mean_with_interval(values: Array) -> str:
    """Mean of one value a run, with 95 % by the spread over runs."""
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.3f} [{values.mean() - half:.3f}, {values.mean() + half:.3f}]"


def prediction_rows(label: str, watch: Watch) -> list[str]:
    """Table of how good forecasts were on one flight."""
    rows = []
    reported, error, flying = np.array(watch.reported), np.array(watch.error), np.array(watch.flying)
    for shown in SHOWN_S:
        lag, start = round(shown), round(SETTLED_S)
        there = flying[start + lag :]
        scores = {}
        for way in WAYS:
            forecast = np.array(watch.forecasts[way, shown])[start:-lag]
            then, wrong = reported[start + lag :], error[start + lag :]
            apart = 0.5 * np.log(forecast / then)
            squared = wrong**2 / forecast
            weight = there.sum(0)

            def over_run(values: Array, there: Mask = there, weight: Array = weight) -> Array:
                return np.asarray((values.mean((-1, -2)) * there).sum(0) / weight)

            rms = np.sqrt(over_run(apart**2))
            scores[way] = over_run(0.5 * (np.log(forecast) + squared))
            inside = ((squared < 9.0) & there[..., None, None]).sum((0, 2, 3)).astype(np.int64)
            size = int(weight.max()) * reported.shape[2] * 3
            share = clustered_rate(np.rint(inside / weight * weight.max()).astype(np.int64), size)
            rows.append(
                f"| {label} | {shown:g} s | {way} | {mean_with_interval(rms)} "
                f"| {np.median(apart[there]):+.3f} | {100 * share.value:.2f} % [{100 * share.low:.2f}, "
                f"{100 * share.high:.2f}] | {mean_with_interval(over_run(squared))} "
                f"| {mean_with_interval(scores[way])} |"
            )
        gain = scores["expected"] - scores["mapped"]
        rows.append(f"| {label} | {shown:g} s | gain, paired | | | | | {mean_with_interval(gain)} |")
    return rows


def spread(score: Score, name: str) -> str:
    """Median of a metric over runs, with 5 % and 95 %."""
    values = score.metrics[name][np.isfinite(score.metrics[name])]
    low, median, high = np.quantile(values, (0.05, 0.5, 0.95))
    return f"{median:.2f} [{low:.2f}, {high:.2f}]"


def flight_row(way: str, score: Score, cost_s: float) -> str:
    """Line of one way to fly."""
    hit = np.asarray(score.obstacle_contact.any(-1))
    rate = wilson(int(hit.sum()), len(hit))

    return (
        f"| {way} | {rate.count} / {rate.total}, {100 * rate.value:.1f} % [{100 * rate.low:.1f}, "
        f"{100 * rate.high:.1f}] | {int(score.finished.sum())} | {spread(score, 'path_rms_m')} "
        f"| {spread(score, 'shape_rms_m')} | {spread(score, 'min_clearance_m')} "
        f"| {spread(score, 'finish_time_s')} "
        f"| {cost_s / len(hit):.2f} s |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", default="street_canyon_gnss")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--lanes", action="store_true")
    parser.add_argument("--open-sky", type=float, nargs="+")
    parser.add_argument("--room", action="store_true")
    parser.add_argument("--planner", choices=("qp", "napf_guided"), default="qp", help="with --open-sky")
    options = parser.parse_args()
    if options.lanes:
        problem = load_problem(options.problem, {"planner.covariance": "mapped", "navigation.rate_hz": 1.0})
        print(f"{options.problem}, N = {options.runs}, seed {options.seed}")
        print(
            "| sigma foreseen | ln(sigma / reported), rms [95 %] | median [5 %, 95 %] |\n| --- | --- | --- |"
        )
        print("\n".join(lane_rows(problem, options.seed, options.runs, options.data)))
        return
    if options.room:
        problem = load_problem(options.problem, {"planner.covariance": "mapped"})
        scenario = build_scenario(problem, options.seed, range(options.runs), options.data)
        print(f"{options.problem}, N = {options.runs}, seed {options.seed}")
        print("| place | fix, three axes, rms [m] |\n| --- | --- |")
        print("\n".join(room_rows(problem, scenario)))
        return
    if options.open_sky:
        problem = load_problem(options.problem, {"planner.covariance": "mapped"})
        scenario = build_scenario(problem, options.seed, range(options.runs), options.data)
        print(f"{options.problem}, {options.planner}, N = {options.runs}, seed {options.seed}; ", end="")
        print("median [5 %, 95 %] of runs\n")
        open_sky(options.problem, options.planner, options.open_sky, scenario)
        return
    problems = {way: load_problem(options.problem, {"planner.covariance": way}) for way in WAYS}
    began = time.process_time()
    plain = build_scenario(problems["expected"], options.seed, range(options.runs), options.data)
    without = time.process_time() - began
    began = time.process_time()
    scenario = build_scenario(problems["mapped"], options.seed, range(options.runs), options.data)
    cost = (time.process_time() - began - without) / len(plain.runs)
    assert scenario.sigma_map is not None
    grid = scenario.sigma_map.nodes.shape[1:4]
    print(f"{options.problem}, N = {options.runs}, seed {options.seed}; median [5 %, 95 %] of runs")
    print(
        f"Map: {' x '.join(map(str, grid))} nodes, {scenario.sigma_map.cell_m[0]:.1f} m, {cost:.2f} s a run\n"
    )
    flown = {way: fly(problems[way], scenario) for way in WAYS}
    print(
        "| covariance | contact [95 %] | finished | path, rms [m] | shape, rms [m] | clearance [m] "
        "| finish [s] | CPU |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for way, (score, _, cost_s) in flown.items():
        print(flight_row(way, score, cost_s))
    hits = [np.asarray(flown[way][0].obstacle_contact.any(-1)) for way in WAYS]
    only = int((hits[0] & ~hits[1]).sum()), int((hits[1] & ~hits[0]).sum())
    print(f"\nContacts of one only: {only[0]} expected, {only[1]} mapped; McNemar p = {mcnemar(*only):.3g}")
    for name in ("path_rms_m", "shape_rms_m", "min_clearance_m", "finish_time_s"):
        change = flown["mapped"][0].metrics[name] - flown["expected"][0].metrics[name]
        print(f"{name}, mapped less expected, mean: {mean_with_interval(change[np.isfinite(change)])}")
    print(
        "\n| flight | ahead | forecast | ln(sigma / reported then), rms | median | in 3 sigma [95 %] "
        "| error^2 / variance | score |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for way in WAYS:
        print("\n".join(prediction_rows(way, flown[way][1])))


if __name__ == "__main__":
    main()
