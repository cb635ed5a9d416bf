"""Ways in which such a simulation fools its author; one detector for each, named by what it would do."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from napf_mpc.campaign import compare, fly_block, simulate
from napf_mpc.closed_loop import POSITION, Scenario, build_scenario, closed_loop
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import METRICS, MissionScore, Outcome, Score
from napf_mpc.navigation.fix import Fix, diagonal
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command, Planner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.record import TrajectoryRecorder
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Shape, Sphere

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

SHORT = ["mission.length_m=55", "world.count=3", "world.along_range_m=[20, 50]", "simulation.time_limit_s=50"]


def _is_built(navigation_filter: str) -> bool:
    try:
        load_problem("table1_8", [f"navigation.filter={navigation_filter}"])
    except ProblemError:
        return False
    return True


FILTERS = [name for name in ("none", "kalman", "point_mass") if _is_built(name)]


@cache
def score_of(planner: str, runs: int, *settings: str) -> Score:
    return simulate(load_problem("table1_8", settings), planner, seed=1, runs=runs).score


def hits(score: Score) -> int:
    """Runs in which any UAV touched an obstacle."""
    return int(score.obstacle_contact.any(-1).sum())


def fly(
    problem: Problem, planner: Planner, scenario: Scenario, record_every: int = 0
) -> tuple[Score, Columns]:
    """Score and trajectories of a scenario that has been tampered with."""
    judge = MissionScore(problem, scenario)
    recorder = TrajectoryRecorder(planner.name, scenario.runs, max(1, record_every))
    observers = (judge, recorder) if record_every else (judge,)
    score = judge.score(closed_loop(problem, planner, scenario, observers))
    return score, recorder.columns()


def lone(**sections: Any) -> Problem:
    """One UAV along the x axis, 40 m, without noise; a point unless told otherwise."""
    given: dict[str, Any] = {
        "vehicle": {"radius_m": 0.0},
        "formation": {"shape": "line", "count": 1},
        "mission": {"kind": "formation", "length_m": 40.0},
        "world": {"kind": "empty"},
        "navigation": {"kind": "gauss_markov", "error_scale": 0.0},
    }
    return Problem.model_validate(given | sections)


@dataclass(frozen=True)
class Biased:
    """The same error at every fix, reported as 1 m."""

    error: Array
    period_s: float = 0.1

    def fix(self, epoch: int) -> Fix:
        shape = self.error.shape[:2]
        return Fix(
            self.error.copy(), diagonal(np.ones((*shape, 3))), np.zeros((*shape, 3, 1)), np.ones(shape, bool)
        )


# --------------------------------------------------------------- truth in the planner or the inner loop


def test_the_risk_follows_the_errors() -> None:
    """A loop that flies on the truth would show the same risk whatever the errors are.

    Without errors hardly anything is hit: only where two balls nearly close a lane, in one run of a thousand.
    Five times the errors under the same reported sigma are more than the margin is for.
    """
    runs = 60
    none, as_is, large = (
        hits(score_of("napf", runs, *SHORT, f"navigation.error_scale={scale}")) for scale in (0, 1, 5)
    )
    assert none <= 1
    assert none + 2 < as_is < large - 3
    assert hits(score_of("apf", runs, *SHORT, "navigation.error_scale=0")) <= 2
    assert hits(score_of("apf", runs, *SHORT)) > as_is + 10


def test_the_risk_of_the_papers_scene_is_the_one_to_be_expected() -> None:
    """APF around 75 %, NAPF (k = 1.7) around 17 %: 100 runs within the 99.9 % binomial range of each."""
    for planner, risk in (("apf", 0.75), ("napf", 0.17)):
        low, high = stats.binom.interval(0.999, 100, risk)
        assert low <= hits(score_of(planner, 100)) <= high


class Watch:
    """Keeps hold of the true state so that it can be spoiled while somebody computes."""

    def __init__(self) -> None:
        self.state: Array = np.zeros(0)
        self.spoiled_times = 0

    def spoiled(self, compute: Callable[[], Any]) -> Any:
        kept = self.state.copy()
        self.state[...] = np.nan
        self.spoiled_times += self.state.size > 0
        try:
            return compute()
        finally:
            self.state[...] = kept


@dataclass
class Poisoned:
    """Planner that computes while the truth is NaN everywhere."""

    inner: Planner
    watch: Watch
    name: str = "poisoned"

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.inner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        for each in fields(NavSolution)[1:]:
            assert not np.shares_memory(getattr(nav, each.name), self.watch.state), each.name
        command: Command = self.watch.spoiled(lambda: self.inner.step(nav, time_s))
        return command


@pytest.mark.parametrize("navigation", FILTERS)
@pytest.mark.parametrize("planner", ["apf", "napf"])
def test_nobody_who_flies_looks_at_the_truth(
    planner: str, navigation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the truth NaN while planner and inner loop compute, every metric stays the same bits."""
    settings = [*SHORT, "simulation.time_limit_s=14", f"navigation.filter={navigation}"]
    problem = load_problem("table1_8", settings)
    scenario = build_scenario(problem, 6, range(4))
    plain, track = fly(problem, make_planner(planner, problem), scenario, 5)

    watch = Watch()
    loop = import_module("napf_mpc.closed_loop")
    inner_loop, advance = loop._inner_loop, loop.advance

    def move(state: Array, *rest: Any) -> None:
        watch.state = state
        advance(state, *rest)

    monkeypatch.setattr(loop, "advance", move)
    monkeypatch.setattr(loop, "_inner_loop", lambda *given: watch.spoiled(lambda: inner_loop(*given)))
    pilot = Poisoned(make_planner(planner, problem), watch)
    score, poisoned_track = fly(problem, pilot, scenario, 5)

    assert watch.spoiled_times == 699 + 139  # ticks and plans, but for the first of each
    assert score.outcome == plain.outcome
    for name in METRICS:
        np.testing.assert_array_equal(score.metrics[name], plain.metrics[name], err_msg=name)
    for name in ("x_m", "ref_x_m", "ref_vy_mps", "thrust_n"):
        np.testing.assert_array_equal(poisoned_track[name], track[name], err_msg=name)


@dataclass
class Tape:
    """Planner that keeps copies of all it is given and all it answers."""

    inner: Planner
    name: str = "tape"
    given: list[tuple[float, NavSolution]] = field(default_factory=list)
    answers: list[Command] = field(default_factory=list)

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.map, self.runs = obstacles, runs
        self.inner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        copies = {each.name: copy.deepcopy(getattr(nav, each.name)) for each in fields(NavSolution)[1:]}
        self.given.append((time_s, NavSolution(nav.time_s, **copies)))
        command = self.inner.step(nav, time_s)
        self.answers.append(command)
        return command


@pytest.mark.parametrize("navigation", FILTERS)
@pytest.mark.parametrize("planner", ["apf", "napf"])
def test_commands_follow_from_the_navigation_solutions_alone(planner: str, navigation: str) -> None:
    """Replayed on the ground from what navigation had reported, every command is the same bits."""
    outages = [
        "navigation.outage_interval_s=5",
        "navigation.outage_duration_s=2",
        "simulation.time_limit_s=15",
    ]
    problem = load_problem("table1_8", [*SHORT, *outages])
    tape = Tape(make_planner(planner, problem))
    closed_loop(problem, tape, build_scenario(problem, 6, range(3)))
    assert len(tape.given) == 150
    again = make_planner(planner, problem)
    again.reset(tape.map, tape.runs)
    for (time_s, nav), answer in zip(tape.given, tape.answers, strict=True):
        command = again.step(nav, time_s)
        for each in fields(Command):
            np.testing.assert_array_equal(getattr(command, each.name), getattr(answer, each.name))
    if navigation == "none":
        assert any(answer.holding.any() for answer in tape.answers)


# ------------------------------------------------------------------ collisions judged on the estimate


@pytest.mark.parametrize(
    ("ball_y_m", "truth_hits"), [(-5.0, True), (0.0, False)], ids=["on the true path", "on the measured path"]
)
def test_a_bias_of_five_metres_is_judged_on_the_truth(ball_y_m: float, truth_hits: bool) -> None:
    """Measured on its lane, in truth 5 m to the right of it."""
    problem = lone(planner={"repulsive_gain": 0.0})
    scenario = build_scenario(problem, 0, range(1))
    start = scenario.initial_state.copy()
    start[..., 2] = -5.0
    ball = ObstacleSet.from_shapes([Sphere((20.0, ball_y_m, 0.0), 1.0)])
    scenario = replace(
        scenario, obstacles=ball, initial_state=start, errors=Biased(np.array([[[0.0, 5.0, 0.0]]]))
    )
    score, track = fly(problem, make_planner("apf", problem), scenario, 1)
    measured = np.stack([track[f"est_{axis}_m"] for axis in "xyz"], axis=-1)
    assert (ball.signed_distance(measured[None]).min() <= 0.0) == (not truth_hits)
    assert score.obstacle_contact.tolist() == [[truth_hits]]
    assert score.outcome == ((Outcome.COLLIDED if truth_hits else Outcome.REACHED),)


# ------------------------------------------------------------------------- collisions sampled at ticks


@pytest.mark.parametrize("thickness_m", [0.01, 1e-4])
def test_a_thin_plate_between_two_samples_is_hit(thickness_m: float) -> None:
    """At 2 m/s a sample is 40 mm from the next: all of them are clear of the plate that was flown through."""
    problem = lone(planner={"repulsive_gain": 0.0}, mission={"kind": "formation", "length_m": 12.0})
    free = simulate(problem, "apf", record_every=1).trajectories["x_m"]
    between = 0.5 * (free[200] + free[201])
    plate = ObstacleSet.from_shapes([Box((between, 0.0, 0.0), (thickness_m, 20.0, 20.0))])
    scenario = replace(build_scenario(problem, 0, range(1)), obstacles=plate)
    score, track = fly(problem, make_planner("apf", problem), scenario, 1)
    places = np.stack([track[f"{axis}_m"] for axis in "xyz"], axis=-1)
    assert plate.signed_distance(places[None]).min() > 0.01
    assert score.outcome == (Outcome.COLLIDED,)
    assert score.metrics["min_clearance_m"][0] == pytest.approx(-0.5 * thickness_m, abs=1e-6)


# ------------------------------------------------------------- only the range of influence is inflated


def test_more_reported_sigma_pushes_harder_at_the_same_place_by_as_much_as_it_should() -> None:
    """5 m abreast of a ball, k = 3, rho_0 = 3 m: 15 (1/d - 1/3) / d^2 with d = 5 - 3 sigma.

    A reading that widens only rho_0 would push with 15 (1/5 - 1/(3 + 3 sigma)) / 25 instead: 0.02 m/s at 1 m.
    """
    problem = lone(planner={"k": 3.0, "max_speed_ratio": 10.0})
    planner = make_planner("napf", problem)
    for sigma in (0.6, 0.8, 1.0, 1.2):
        planner.reset(ObstacleSet.from_shapes([Sphere((10.0, 6.0, 0.0), 1.0)]), 1)
        still = np.zeros((1, 1, 3))
        covariance = np.zeros((1, 1, 6, 6))
        covariance[..., [0, 1, 2], [0, 1, 2]] = sigma**2
        place = np.array([[(10.0, 0.0, 0.0)]])
        nav = NavSolution(
            0.0, np.ones((1, 1), bool), place, still, still, still, covariance, still[..., None]
        )
        away = -planner.step(nav, 0.0).velocity[0, 0, 1]
        d = 5.0 - 3.0 * sigma
        assert away == pytest.approx(max(0.0, 15.0 * (1.0 / d - 1.0 / 3.0) / d**2), abs=1e-12)


# -------------------------------------------------------------------------------------- white noise only


@pytest.mark.parametrize("tau_s", [0.0, 0.3, 10.0])
def test_errors_in_the_loop_remember_as_long_as_they_should(tau_s: float) -> None:
    """Lag-1 correlation of what the planner is given less the truth is exp(-0.1 s / tau), at 10 Hz."""
    settings = [
        f"navigation.correlation_time_s={tau_s}",
        "navigation.sigma_min_m=3",
        "navigation.sigma_max_m=3",
    ]
    problem = load_problem("table1_8", [*SHORT, *settings, "simulation.time_limit_s=10"])
    scenario = build_scenario(problem, 2, range(60))
    recorder = TrajectoryRecorder("apf", scenario.runs, every=5)
    closed_loop(problem, make_planner("apf", problem), scenario, (recorder,))
    track = recorder.columns()
    error = np.stack([track[f"est_{axis}_m"] - track[f"{axis}_m"] for axis in "xyz"])
    series = error.reshape(3, 60, 100, 4)
    assert series.std() == pytest.approx(3.0, rel=0.1)
    lagged = (series[:, :, 1:] * series[:, :, :-1]).mean() / (series**2).mean()
    expected = np.exp(-0.1 / tau_s) if tau_s > 0.0 else 0.0
    assert lagged == pytest.approx(expected, abs=0.02)


# --------------------------------------------------------------------------- deadlock counted as safe


def test_a_formation_that_never_arrives_is_not_safe() -> None:
    """In front of an endless wall, free to turn by 90 degrees: no contact, no arrival, a timeout.

    Risk and finished share are both over all missions, so that a planner which stops looks as bad as it is.
    """
    wall = {
        "kind": "list",
        "obstacles": ({"shape": "box", "centre_m": (25.0, 0.0, 0.0), "size_m": (1.0, 1e3, 1e3)},),
    }
    problem = load_problem("table1_8", ["navigation.error_scale=0", "simulation.time_limit_s=30"])
    problem = Problem.model_validate(
        problem.model_dump() | {"world": wall, "planner": {"kind": "apf", "max_turn_deg": 90.0}}
    )
    missions = simulate(problem, "apf", runs=3)
    assert missions.score.outcome == (Outcome.TIMEOUT,) * 3
    assert not missions.score.obstacle_contact.any()
    assert not missions.score.finished.any()
    assert not missions.score.joint_success.any()
    assert np.isnan(missions.score.metrics["finish_time_s"]).all()
    summary = compare(problem, ["apf"], runs=3)
    apf = summary["planners"]["apf"]
    assert (apf["runs"], apf["timeout"], apf["reached"], apf["finished"]) == (3, 3, 0, 0.0)
    assert (apf["collision_risk"], apf["joint_success"]) == (0.0, 0.0)
    assert apf["collision_risk_high"] > 0.5  # three missions prove nothing


def test_every_mission_counts_once() -> None:
    """Outcomes sum to the number of runs, and the risk is a fraction of all of them."""
    settings = [*SHORT, "navigation.outage_interval_s=20", "simulation.time_limit_s=25"]
    problem = load_problem("table1_8", settings)
    rows = fly_block(problem, ["apf", "napf"], 3, range(40)).rows
    summary = compare(problem, ["apf", "napf"], runs=40, seed=3)
    for planner, part in summary["planners"].items():
        assert sum(part[str(outcome)] for outcome in Outcome) == part["runs"] == 40
        touched = rows["obstacle_contact"][rows["planner"] == planner].sum()
        assert part["collision_risk"] == touched / 40
        assert part["finished"] < 1.0


# ------------------------------------------------------------------------- risk bought by flying away


@dataclass
class Runaway:
    """Planner that lifts every UAV 25 m over all obstacles."""

    inner: Planner
    name: str = "runaway"

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.inner.reset(ObstacleSet.empty(), runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        command = self.inner.step(nav, time_s)
        return replace(command, position=command.position + np.array([0.0, 0.0, 25.0]))


def test_safety_bought_by_flying_away_shows_in_the_path() -> None:
    """No risk, a shape of sorts, and 15 m and more off the path: all three stand in the same row."""
    settings = ["mission.length_m=70", "navigation.error_scale=0"]
    problem = load_problem("table1_8", settings)
    away = simulate(problem, Runaway(make_planner("apf", problem)), runs=3).score
    home = simulate(problem, "apf", runs=3).score
    assert hits(away) == hits(home) == 0
    assert (away.metrics["shape_rms_m"] < 2.0).all()
    assert (away.metrics["path_rms_m"] > 15.0).all()
    assert (home.metrics["path_rms_m"] < 2.0).all()
    assert {"path_rms_m", "shape_rms_m", "shape_floor_m", "path_length_ratio"} <= set(METRICS)


# -------------------------------------------------------------------------------------- UAV-UAV ignored


def test_uavs_that_meet_are_a_collision_of_their_own_kind() -> None:
    """Two lanes 4 m apart, the left UAV 4 m to the right of where it believes to be."""
    problem = lone(formation={"shape": "line", "count": 2, "spacing_m": 4.0})
    scenario = build_scenario(problem, 0, range(2))
    error = np.zeros((2, 2, 3))
    error[1, 1, 1] = 4.0  # in the second run only
    score, _ = fly(problem, make_planner("apf", problem), replace(scenario, errors=Biased(error)))
    assert score.uav_contact.tolist() == [False, True]
    assert not score.obstacle_contact.any()
    assert score.outcome == (Outcome.REACHED, Outcome.COLLIDED)
    assert score.joint_success.tolist() == [True, False]
    assert score.metrics["min_separation_m"][1] < 0.1


# ------------------------------------------------------------------------------------------ printed signs


def flown(shapes: Sequence[Shape], start: Any, heading_deg: float = 0.0) -> tuple[Score, Array]:
    """One UAV without noise past solids; its score and its path (t, 3)."""
    problem = lone(mission={"kind": "formation", "length_m": 40.0, "heading_deg": heading_deg})
    scenario = build_scenario(problem, 0, range(1))
    state = scenario.initial_state.copy()
    state[0, 0, POSITION] = start
    scenario = replace(scenario, initial_state=state, obstacles=ObstacleSet.from_shapes(shapes))
    score, track = fly(problem, make_planner("apf", problem), scenario, 1)
    return score, np.stack([track[f"{axis}_m"] for axis in "xyz"], axis=-1)


def test_formation_takes_its_slots_and_does_not_fly_abreast() -> None:
    """Signed offsets (Eq. 17, 18): UAV 1 ends 6.403 m ahead of the middle on lane 3, and so on."""
    problem = load_problem("table1_8", ["mission.length_m=40", "navigation.error_scale=0"])
    problem = Problem.model_validate(problem.model_dump() | {"world": {"kind": "empty"}})
    track = simulate(problem, "apf", record_every=1).trajectories
    end = np.stack([track[f"{axis}_m"] for axis in "xyz"], axis=-1)[-4:]
    end[:, 0] -= end[:, 0].mean()
    slots = [(6.403, 3.0, 0.0), (-6.403, -3.0, 0.0), (3.0, -6.403, 0.0), (-3.0, 6.403, 0.0)]
    np.testing.assert_allclose(end, slots, atol=5e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("axis", [1, 2])
def test_an_obstacle_pushes_away_and_never_pulls(side: float, axis: int) -> None:
    """A ball 0.5 m to one side of the lane is passed on the other (Eq. 33's printed angle attracts)."""
    centre = np.array([20.0, 0.0, 0.0])
    centre[axis] = 0.5 * side
    score, path = flown([Sphere(tuple(centre), 1.0)], (0.0, 0.0, 0.0))
    abreast = path[np.argmin(np.abs(path[:, 0] - 20.0))]
    assert score.outcome == (Outcome.REACHED,)
    assert score.metrics["min_clearance_m"][0] > 0.5
    assert abreast[axis] * side < -1.0
    assert path[-1, axis] == pytest.approx(0.0, abs=0.2)  # and back on its lane


def test_turning_the_world_by_ninety_degrees_turns_the_flight() -> None:
    """Eq. 39 as printed, arctan(V_x / V_y), is true in one direction only."""
    quarter = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    balls = [((15.0, 0.4, 0.0), 1.0), ((24.0, -0.8, 0.3), 1.5)]
    here, path = flown([Sphere(centre, radius) for centre, radius in balls], (0.0, 0.0, 0.0))
    turned = [Sphere(tuple(quarter @ centre), radius) for centre, radius in balls]
    there, turned_path = flown(turned, (0.0, 0.0, 0.0), 90.0)
    np.testing.assert_allclose(turned_path, path @ quarter.T, atol=1e-9)
    assert here.outcome == there.outcome == (Outcome.REACHED,)
    assert np.abs(path[:, 1]).max() > 1.0


# ----------------------------------------------------------------------------- a claim that is not true


def test_reporting_half_the_sigma_costs_risk() -> None:
    """The margin is only as good as the reported sigma; nothing else in the mission changes."""
    honest = hits(score_of("napf", 60, *SHORT, "planner.k=2"))
    boastful = hits(score_of("napf", 60, *SHORT, "planner.k=2", "navigation.reported_sigma_scale=0.25"))
    assert boastful > honest + 8


def test_the_verdict_uses_the_solids_and_the_planner_the_same_map() -> None:
    """The judge's solids are those of the scenario, for every planner of a comparison."""
    problem = load_problem("table1_8", SHORT)
    scenario = build_scenario(problem, 0, range(3))
    tape = Tape(make_planner("apf", problem))
    judge = MissionScore(problem, scenario)
    closed_loop(problem, tape, scenario, (judge,))
    assert tape.map is scenario.obstacles
    assert judge._clearance.obstacles is scenario.obstacles
