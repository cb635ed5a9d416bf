"""The closed loop: take-off into formation, independence of runs, clocks, and runs that break."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.campaign import fly_block, simulate
from napf_mpc.closed_loop import (
    POSITION,
    VELOCITY,
    Scenario,
    build_scenario,
    closed_loop,
    hold_up,
    initial_state,
)
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import METRICS, MissionScore, Outcome, Score
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.fix import Fix
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command, Planner
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.record import TrajectoryRecorder
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

# Short flights of the shipped scenes: the same planners and errors, a quarter of the way.
SCENES = {
    "lanes": ("table1_8", ["mission.length_m=32", "world.count=3", "world.along_range_m=[8, 28]"]),
    "scatter": ("table1_40", ["mission.length_m=32", "world.count=9", "world.along_range_m=[8, 28]"]),
    "street_canyon": ("street_canyon", ["mission.length_m=32", "world.along_range_m=[8, 28]"]),
}


def short(scene: str, *settings: str) -> Problem:
    name, base = SCENES[scene]
    return load_problem(name, [*base, "simulation.time_limit_s=35", *settings])


def empty(*settings: str) -> Problem:
    """The paper's take-off in an empty world, without noise."""
    problem = load_problem("table1_8", ["mission.length_m=40", "navigation.error_scale=0", *settings])
    return Problem.model_validate(problem.model_dump() | {"world": {"kind": "empty"}})


def fly(
    problem: Problem, planner: Planner, scenario: Scenario, record_every: int = 0
) -> tuple[Score, Columns]:
    """Score and trajectories of a scenario that has been tampered with."""
    judge = MissionScore(problem, scenario)
    recorder = TrajectoryRecorder(planner.name, scenario.runs, max(1, record_every))
    observers = (judge, recorder) if record_every else (judge,)
    score = judge.score(closed_loop(problem, planner, scenario, observers))
    return score, recorder.columns()


def same(a: Columns, b: Columns) -> None:
    assert list(a) == list(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def joined(blocks: Sequence[Columns]) -> Columns:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def positions(trajectories: Columns, uavs: int) -> Array:
    """Truth of a single run, (t, uav, 3)."""
    return np.stack([trajectories[name] for name in ("x_m", "y_m", "z_m")], axis=-1).reshape(-1, uavs, 3)


# --------------------------------------------------------------------------------------------- take-off


@pytest.mark.parametrize("planner", ["apf", "napf"])
def test_the_formation_takes_shape_from_the_papers_take_off_places(planner: str) -> None:
    """From 1.4-3.2 m apart to the 10 m square: after 12 s every UAV is in its slot to 0.1 m, none met."""
    missions = simulate(empty(), planner, record_every=1)
    truth = positions(missions.trajectories, 4)
    time = missions.trajectories["t_s"].reshape(-1, 4)[:, 0]
    offsets = formation_offsets(empty().formation)
    error = truth - offsets
    error[..., 0] -= truth[..., 0].mean(axis=1, keepdims=True)
    distance = np.linalg.norm(error, axis=-1).max(axis=1)
    assert distance[0] > 5.0
    assert distance[time >= 12.0].max() < 0.1
    apart = np.linalg.norm(truth[:, :, None] - truth[:, None], axis=-1)[:, ~np.eye(4, dtype=bool)]
    assert apart[0].min() == pytest.approx(np.sqrt(4.0), abs=0.6)
    assert apart.min() > 1.0
    metrics = missions.score.metrics
    assert missions.score.outcome == (Outcome.REACHED,)
    assert metrics["shape_rms_m"][0] < 0.02
    assert metrics["path_rms_m"][0] < 0.02
    assert metrics["shape_floor_m"][0] == 0.0
    # It flies at V_r: 40 m and the rear 6.4 m behind the middle.
    assert metrics["finish_time_s"][0] == pytest.approx((40.0 + 6.403) / 2.0, abs=2.0)


@pytest.mark.parametrize(
    "formation",
    [
        {"shape": "line", "count": 3},
        {"shape": "v", "count": 5},
        {"shape": "circle", "count": 8},
        {"shape": "list", "offsets_m": ((0.0, 0.0, 0.0), (4.0, 2.0, 3.0), (8.0, -2.0, -1.0))},
    ],
    ids=lambda f: f["shape"],
)
def test_any_formation_takes_shape_on_a_climbing_path_in_any_direction(formation: dict[str, Any]) -> None:
    """All start in a row across the path; from there two may meet, as these planners avoid obstacles only."""
    problem = Problem.model_validate(
        {
            "formation": formation,
            "mission": {
                "kind": "formation",
                "length_m": 60.0,
                "heading_deg": 130.0,
                "climb_deg": 10.0,
                "start_m": (50.0, -20.0, 30.0),
            },
            "world": {"kind": "empty"},
            "navigation": {"kind": "gauss_markov", "error_scale": 0.0},
        }
    )
    scenario = build_scenario(problem, 0, range(1))
    frame = PathFrame.of_mission(problem.mission)
    row = np.zeros((problem.uav_count, 3))
    row[:, 1] = 2.0 * np.arange(problem.uav_count)
    start = scenario.initial_state.copy()
    start[0, :, POSITION] = frame.to_world(row)
    score, track = fly(problem, NapfPlanner(problem), replace(scenario, initial_state=start), 1)
    assert score.finished.all()
    path = frame.to_path(positions(track, problem.uav_count)[-1])
    path[:, 0] -= path[:, 0].mean()
    np.testing.assert_allclose(path, formation_offsets(problem.formation), atol=0.05)


def test_initial_state_is_the_papers_or_in_the_slots_at_rest() -> None:
    state = initial_state(empty())
    np.testing.assert_array_equal(state[:, POSITION], [(0, -1, 0), (1, 1, 1), (2, -1, 0), (0, 2, 0)])
    np.testing.assert_array_equal(state[:, VELOCITY], [(0, 0, 0), (1, 1, 1), (2, 2, 0), (1, 0, 1)])
    slots = initial_state(load_problem("street_canyon"))
    np.testing.assert_array_equal(slots[:, VELOCITY], np.zeros((4, 3)))
    frame = PathFrame.of_mission(load_problem("street_canyon").mission)
    np.testing.assert_allclose(
        frame.to_path(slots[:, POSITION]),
        formation_offsets(load_problem("street_canyon").formation),
        atol=1e-9,
    )
    np.testing.assert_allclose(slots[:, 10], np.radians(30.0))


# -------------------------------------------------------------------------- independence of block and total


@pytest.mark.parametrize("scene", SCENES)
def test_rows_do_not_depend_on_the_block(scene: str) -> None:
    """Ten runs in one block, some one by one, and cut unevenly: the same bits in every column."""
    problem = short(scene)
    planners = ["apf", "napf"]
    whole = fly_block(problem, planners, 7, range(10)).rows
    for cuts in ((0, 1, 2, 10), (0, 3, 9, 10)):
        parts = [fly_block(problem, planners, 7, range(a, b)).rows for a, b in pairwise(cuts)]
        for planner in planners:
            of = joined([{k: v[part["planner"] == planner] for k, v in part.items()} for part in parts])
            same(of, {k: v[whole["planner"] == planner] for k, v in whole.items()})
    assert len(set(whole["min_clearance_m"].tolist())) == 20
    assert set(whole["outcome"].tolist()) >= {"reached"}


def test_the_first_fifty_of_a_hundred_runs_are_a_campaign_of_fifty() -> None:
    problem = short("lanes", "simulation.time_limit_s=15")
    hundred = fly_block(problem, ["napf"], 3, range(100)).rows
    fifty = fly_block(problem, ["napf"], 3, range(50)).rows
    same({name: values[:50] for name, values in hundred.items()}, fifty)


def test_a_longer_time_limit_changes_nothing_before() -> None:
    problem = short("lanes")
    long, cut = (
        simulate(
            short("lanes", f"simulation.time_limit_s={limit}"), "napf", runs=3, record_every=5
        ).trajectories
        for limit in (60.0, 8.0)
    )
    early = long["t_s"] < 8.0
    same({name: values[early] for name, values in long.items()}, cut)
    assert cut["t_s"].max() == pytest.approx(7.9)
    assert problem.simulation.time_limit_s == 35.0


def test_seeds_and_runs_differ() -> None:
    problem = short("lanes")
    runs = [
        simulate(problem, "apf", seed=seed, runs=range(run, run + 1))
        for seed, run in ((7, 0), (8, 0), (7, 1))
    ]
    clearances = {m.score.metrics["min_clearance_m"][0] for m in runs}
    assert len(clearances) == 3
    assert [m.score.runs.tolist() for m in runs] == [[0], [0], [1]]


def test_planners_fly_the_same_scenes_and_errors() -> None:
    """Paired: whoever flies, obstacles, start and errors are the same bits."""
    problem = short("scatter")
    a, b = (simulate(problem, planner, seed=5, runs=2, record_every=5) for planner in ("apf", "napf"))
    for x, y in zip(a.scenario.obstacles.shapes(1), b.scenario.obstacles.shapes(1), strict=True):
        assert x == y
    errors = []
    for missions in (a, b):
        track = missions.trajectories
        first = track["t_s"] < 4.0
        errors.append(np.stack([track[f"est_{axis}_m"] - track[f"{axis}_m"] for axis in "xyz"])[:, first])
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-12)


@pytest.mark.parametrize("turn_deg", [90.0, 180.0, 37.0])
def test_turning_the_world_changes_no_metric(turn_deg: float) -> None:
    """Without noise, whose axes are the world's."""
    calm = ["navigation.error_scale=0", "planner.k=0.5"]
    here = short("lanes", *calm)
    mission = here.mission.model_dump() | {"heading_deg": turn_deg}
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    for key in ("initial_positions_m", "initial_velocities_mps"):
        mission[key] = tuple(
            (float(c * x - s * y), float(s * x + c * y), float(z)) for x, y, z in mission[key]
        )
    there = Problem.model_validate(here.model_dump() | {"mission": mission})
    a, b = (simulate(problem, "napf", seed=2, runs=5).score for problem in (here, there))
    assert a.outcome == b.outcome
    for name in METRICS:
        np.testing.assert_allclose(a.metrics[name], b.metrics[name], atol=1e-6, err_msg=name)
    assert (a.metrics["min_clearance_m"] < 3.0).all()
    assert np.isfinite(a.metrics["reform_time_s"]).any()


# ------------------------------------------------------------------------------------------------ clocks


@dataclass
class Asked:
    """Planner that writes down when it is asked and what it is given."""

    inner: ApfPlanner
    name: str = "asked"

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.inner.reset(obstacles, runs)
        self.times: list[float] = []
        self.seen: list[NavSolution] = []

    def step(self, nav: NavSolution, time_s: float) -> Command:
        self.times.append(time_s)
        self.seen.append(nav)
        return self.inner.step(nav, time_s)


def test_each_loop_runs_at_its_rate() -> None:
    """Planner 5 Hz, fixes 2 Hz: an error is held for half a second, while the place in it is current."""
    problem = short("lanes", "planner.rate_hz=5", "navigation.rate_hz=2", "simulation.time_limit_s=4")
    planner = Asked(ApfPlanner(problem))
    missions = simulate(problem, planner, record_every=1)
    np.testing.assert_allclose(planner.times, np.arange(20) * 0.2, atol=1e-12)
    np.testing.assert_allclose([nav.time_s for nav in planner.seen], planner.times)
    track = missions.trajectories
    error = (track["est_x_m"] - track["x_m"]).reshape(-1, 4)
    assert error.shape == (200, 4)
    np.testing.assert_allclose(error.reshape(8, 25, 4), error[::25][:, None].repeat(25, axis=1), atol=1e-12)
    assert (np.abs(np.diff(error[::25], axis=0)) > 1e-6).all()


def test_a_finer_physics_step_flies_the_same_mission() -> None:
    a, b = (simulate(empty(f"simulation.step_s={step}"), "apf").score.metrics for step in (0.02, 0.004))
    for name in ("path_rms_m", "path_length_ratio", "control_effort", "finish_time_s"):
        np.testing.assert_allclose(a[name], b[name], rtol=1e-4, err_msg=name)


def test_a_mission_ends_when_the_last_uav_has_passed_its_length() -> None:
    missions = simulate(empty(), "apf", record_every=1)
    along = positions(missions.trajectories, 4)[:, :, 0].min(axis=1)
    assert (along < 40.0).all()
    assert along[-1] == pytest.approx(40.0, abs=0.05)
    out_of_time = simulate(empty("simulation.time_limit_s=10"), "apf")
    assert out_of_time.score.outcome == (Outcome.TIMEOUT,)
    assert not out_of_time.score.finished[0]
    assert np.isnan(out_of_time.score.metrics["finish_time_s"][0])


def test_runs_that_are_over_stand_still_while_the_others_fly() -> None:
    """Flown with a slower one, a run ends at its own time and keeps its metrics."""
    problem = short("scatter")
    together = simulate(problem, "napf", seed=1, runs=6).score
    times = together.metrics["finish_time_s"]
    assert np.nanmax(times) - np.nanmin(times) > 1.0
    first = int(np.nanargmin(times))
    alone = simulate(problem, "napf", seed=1, runs=range(first, first + 1)).score
    for name in METRICS:
        np.testing.assert_array_equal(alone.metrics[name][0], together.metrics[name][first], err_msg=name)


# ----------------------------------------------------------------------------------------- runs that break


@dataclass
class Broken:
    """Planner that spoils the command of one UAV from some time on."""

    inner: NapfPlanner
    run: int
    value: float
    name: str = "broken"

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.inner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        command = self.inner.step(nav, time_s)
        if time_s >= 5.0:
            command.velocity[self.run, 2, 1] = self.value
        return command


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_run_with_a_number_that_is_not_finite_has_failed_and_no_other(value: float) -> None:
    """`nan < r` is False: such a run must never count as safe."""
    problem = short("lanes")
    scenario = build_scenario(problem, 4, range(5))
    good, _ = fly(problem, NapfPlanner(problem), scenario)
    score, _ = fly(problem, Broken(NapfPlanner(problem), 3, value), scenario)
    assert score.outcome[3] is Outcome.FAILED
    assert not score.finished[3]
    assert not score.joint_success[3]
    for name in METRICS:
        assert np.isnan(score.metrics[name][3]), name
    for run in (0, 1, 2, 4):
        assert score.outcome[run] is good.outcome[run]
        for name in METRICS:
            np.testing.assert_array_equal(score.metrics[name][run], good.metrics[name][run], err_msg=name)
    assert sum(score.outcome.count(outcome) for outcome in Outcome) == 5


@dataclass
class Misshapen:
    """Planner whose commands have one field of another form."""

    inner: NapfPlanner
    change: Callable[[Command], Any]
    name: str = "mine"

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.inner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Any:
        return self.change(self.inner.step(nav, time_s))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: replace(c, yaw=0.0), "yaw is a float, must be an array (run, uav) = (2, 4)"),
        (lambda c: replace(c, yaw=np.zeros(4)), "yaw has shape (4,), must be (run, uav) = (2, 4)"),
        (lambda c: replace(c, feedforward=None), "feedforward is a NoneType, must be an array (run, uav, 4)"),
        (lambda c: replace(c, position=c.position.tolist()), "position is a list, must be an array"),
        (lambda c: replace(c, velocity=c.velocity[0]), "velocity has shape (4, 3), must be (run, uav, 3)"),
        (lambda c: replace(c, direction=c.direction[..., :2]), "direction has shape (2, 4, 2), must be"),
        (lambda c: replace(c, holding=c.holding.tolist()), "holding is a list, must be an array (run, uav)"),
        (lambda c: replace(c, holding=c.holding[0]), "holding has shape (4,), must be (run, uav) = (2, 4)"),
        (lambda c: replace(c, reason=np.zeros(2, np.int8)), "reason has shape (2,), must be (run, uav)"),
        (lambda c: replace(c, planned=[True]), "planned is a list, must be an array (run, uav)"),
        (lambda c: replace(c, slack_m=0.0), "slack_m is a float, must be an array (run, uav)"),
        (lambda c: replace(c, solver_status="solved"), "solver_status is a str, must be an array (run, uav)"),
        (lambda c: replace(c, plan=c.position), "plan is a ndarray, must be a Plan of (run, uav) = (2, 4)"),
        (lambda c: None, "step() returned a NoneType, must return a Command"),
        (lambda c: (c.position, c.velocity), "step() returned a tuple, must return a Command"),
    ],
)
def test_a_command_of_another_form_is_refused_by_planner_and_field(
    change: Callable[[Command], Any], told: str
) -> None:
    problem = short("lanes")
    with pytest.raises(ProblemError) as caught:
        closed_loop(problem, Misshapen(NapfPlanner(problem), change), build_scenario(problem, 4, range(2)))
    assert caught.value.source == 'planner "mine"'
    assert len(caught.value.problems) == 1
    assert told in caught.value.problems[0]


def test_all_fields_that_do_not_fit_are_told_at_once() -> None:
    problem = short("lanes")
    planner = Misshapen(NapfPlanner(problem), lambda c: replace(c, yaw=0.0, holding=None))
    with pytest.raises(ProblemError) as caught:
        closed_loop(problem, planner, build_scenario(problem, 4, range(2)))
    assert [line.split()[0] for line in caught.value.problems] == ["yaw", "holding"]


@dataclass(frozen=True)
class Spoiled:
    """Errors of a scenario with one UAV's set to a value from some epoch on."""

    good: Any
    run: int
    value: float

    @property
    def period_s(self) -> float:
        return float(self.good.period_s)

    def fix(self, epoch: int) -> Fix:
        fix = self.good.fix(epoch)
        error = fix.error.copy()
        if epoch >= 40:
            error[self.run, 1] = self.value
        return replace(fix, error=error)


def test_navigation_that_goes_blind_fails_its_run_and_no_other() -> None:
    problem = short("lanes")
    scenario = build_scenario(problem, 4, range(3))
    good, _ = fly(problem, NapfPlanner(problem), scenario)
    spoiled = replace(scenario, errors=Spoiled(scenario.errors, 1, np.nan))
    score, _ = fly(problem, NapfPlanner(problem), spoiled)
    assert score.outcome[1] is Outcome.FAILED
    for run in (0, 2):
        assert score.outcome[run] is good.outcome[run]
        for name in METRICS:
            np.testing.assert_array_equal(score.metrics[name][run], good.metrics[name][run], err_msg=name)


@dataclass(frozen=True)
class OfOneRun:
    """Errors of a scenario's first run, whatever is flown."""

    good: Any

    @property
    def period_s(self) -> float:
        return float(self.good.period_s)

    def fix(self, epoch: int) -> Fix:
        fix = self.good.fix(epoch)
        return Fix(fix.error[:1], fix.covariance[:1], fix.common_factor[:1], fix.available[:1])


@pytest.mark.parametrize("filter_", ["none", "kalman"])
def test_errors_of_fewer_runs_are_no_failed_runs(filter_: str) -> None:
    """The second run would have read past the end of the first one's, and been filed as failed."""
    problem = short("lanes", f"navigation.filter={filter_}")
    scenario = build_scenario(problem, 4, range(2))
    with pytest.raises(ValueError, match=r"fix of epoch 0 has error of shape .* must be \(2, 4, 3\)"):
        fly(problem, NapfPlanner(problem), replace(scenario, errors=OfOneRun(scenario.errors)))


@pytest.mark.parametrize("period_s", [0.03, 0.001, 0.0, -0.1, float("nan")])
def test_errors_whose_period_does_not_fit_the_inner_loop_are_refused(period_s: float) -> None:
    """Rounded to whole ticks, a drift of an own error model would run at another pace."""
    problem = empty()
    scenario = build_scenario(problem, 0, range(1))

    class Own:
        def __init__(self) -> None:
            self.period_s = period_s

        def fix(self, epoch: int) -> Fix:
            raise AssertionError("not to be asked")

    with pytest.raises(ValueError, match=r"errors have period_s = .*, must be one or more whole periods"):
        closed_loop(problem, ApfPlanner(problem), replace(scenario, errors=Own()))


@pytest.mark.parametrize("filter_", ["none", "kalman"])
def test_errors_that_return_no_fix_are_told(filter_: str) -> None:
    problem = empty(f"navigation.filter={filter_}")
    scenario = build_scenario(problem, 0, range(1))

    class Own:
        period_s = 0.1

        def fix(self, epoch: int) -> Fix:
            return None  # type: ignore[return-value]

    with pytest.raises(ValueError, match="fix of epoch 0 is a NoneType, must be a Fix"):
        closed_loop(problem, ApfPlanner(problem), replace(scenario, errors=Own()))


def test_a_run_beyond_all_numbers_has_failed() -> None:
    """An estimate 1e6 km off: whatever that run does, the others fly as before."""
    problem = short("lanes")
    scenario = build_scenario(problem, 4, range(2))
    start = scenario.initial_state.copy()
    start[1, 0, 0] = 2e7
    good, _ = fly(problem, ApfPlanner(problem), scenario)
    score, _ = fly(problem, ApfPlanner(problem), replace(scenario, initial_state=start))
    assert score.outcome[1] is Outcome.FAILED
    assert score.outcome[0] is good.outcome[0]
    np.testing.assert_array_equal(score.metrics["min_clearance_m"][0], good.metrics["min_clearance_m"][0])


def test_outages_hold_and_are_told_apart() -> None:
    """Half of the time without a fix: the formation is late, and UAVs that hover at the end are `held`."""
    settings = [
        "navigation.outage_interval_s=4",
        "navigation.outage_duration_s=4",
        "simulation.time_limit_s=20",
    ]
    problem = short("lanes", *settings)
    missions = simulate(problem, "napf", runs=20, record_every=5)
    score = missions.score
    holding = missions.trajectories["holding"]
    assert 0.3 < holding.mean() < 0.7
    assert holding[missions.trajectories["available"]].mean() < 0.05
    speed = np.sqrt(sum(missions.trajectories[f"ref_v{axis}_mps"] ** 2 for axis in "xyz"))
    assert (speed[holding] == 0.0).all()
    assert Outcome.HELD in score.outcome
    assert not any(outcome is Outcome.FAILED for outcome in score.outcome)


# --------------------------------------------------------------------------------------------- refusals


def test_a_walk_of_one_point_is_not_for_the_closed_loop() -> None:
    with pytest.raises(ProblemError, match=r"mission\.kind"):
        build_scenario(load_problem("single_uav"), 0, range(1))


def test_an_inner_loop_that_would_be_unstable_is_refused_before_flight() -> None:
    slow = [
        "simulation.controller_rate_hz=10",
        "planner.rate_hz=10",
        "vehicle.lqr_r_diagonal=[0.001, 0.1, 0.1, 0.1]",
    ]
    with pytest.raises(ProblemError, match="stable"):
        build_scenario(load_problem("table1_8", slow), 0, range(1))


# -------------------------------------------------------------------------------------------- recording


def test_a_recording_holds_what_was_flown() -> None:
    """Every tick once a UAV, in order, estimate and sigma beside the truth; reported sigma as configured."""
    problem = short(
        "lanes", "simulation.time_limit_s=3", "navigation.sigma_min_m=2", "navigation.sigma_max_m=2"
    )
    scenario = build_scenario(problem, 9, range(4, 7))
    recorder = TrajectoryRecorder("napf", scenario.runs, every=10)
    closed_loop(problem, make_planner("napf", problem), scenario, (recorder,))
    track = recorder.columns()
    assert len(track["run"]) == 3 * 15 * 4
    assert track["run"].reshape(3, 15, 4)[:, 0, 0].tolist() == [4, 5, 6]
    np.testing.assert_allclose(track["t_s"].reshape(3, 15, 4)[1, :, 2], np.arange(15) * 0.2)
    assert track["uav"].reshape(3, 15, 4)[2, 7].tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(track["sigma_y_m"], 2.0)
    first = np.stack([track[f"{axis}_m"].reshape(3, 15, 4)[0, 0] for axis in "xyz"], axis=-1)
    np.testing.assert_array_equal(first, scenario.initial_state[0][:, POSITION])
    error = np.stack([track[f"est_{axis}_m"] - track[f"{axis}_m"] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(error.reshape(3, 15, 4, 3)[:, 0], scenario.errors.fix(0).error, atol=1e-12)
    assert set(track["planner"].tolist()) == {"napf"}
    assert np.isnan(track["slack_m"]).all()
    assert TrajectoryRecorder("napf", range(1)).columns() == {}


def test_a_recording_shows_no_run_after_its_end() -> None:
    problem = short("scatter")
    missions = simulate(problem, "apf", seed=1, runs=3, record_every=1)
    for run in range(3):
        last = missions.trajectories["t_s"][missions.trajectories["run"] == run].max()
        assert last == pytest.approx(missions.score.metrics["finish_time_s"][run] - 0.02)


def test_observers_see_every_step_once() -> None:
    """Each physics step begins where the last ended, and the judge's way is the sum of them."""

    class Steps:
        def __init__(self) -> None:
            self.end: Array | None = None
            self.moments: list[float] = []
            self.way = 0.0

        def moved(self, time_s: float, before: Array, after: Array, active: NDArray[np.bool_]) -> None:
            if self.end is not None:
                np.testing.assert_array_equal(before, self.end)
            self.end = after.copy()
            self.moments.append(time_s)
            self.way += float(np.linalg.norm((after - before)[..., POSITION], axis=-1).mean())

        def ticked(self, *_: object) -> None:
            pass

    problem = empty("simulation.step_s=0.01", "simulation.time_limit_s=6")
    scenario: Scenario = build_scenario(problem, 0, range(1))
    steps, judge = Steps(), MissionScore(problem, scenario)
    score = judge.score(closed_loop(problem, ApfPlanner(problem), scenario, (steps, judge)))
    np.testing.assert_allclose(steps.moments, 0.01 * np.arange(1, 601), atol=1e-9)
    assert steps.end is not None
    progress = (steps.end - scenario.initial_state)[..., 0].mean()
    assert score.metrics["path_length_ratio"][0] == pytest.approx(steps.way / progress, rel=1e-12)


class Hesitant(NapfPlanner):
    """Flies as always, and says that it holds."""

    def step(self, nav: NavSolution, time_s: float) -> Command:
        command = super().step(nav, time_s)
        return replace(command, holding=np.ones_like(command.holding))


def test_a_run_does_not_wait_once_it_has_ended() -> None:
    """Each run of a block arrives at its own time, and what the others wait after that is not its own."""
    problem = load_problem("table1_8", ["mission.length_m=12", "world.count=1", "world.along_range_m=[4, 8]"])
    flight = closed_loop(problem, Hesitant(problem), build_scenario(problem, 7, range(6)))
    assert flight.reached.all()
    assert len(set(flight.finish_time_s.tolist())) > 2
    assert flight.waited_s is not None
    np.testing.assert_allclose(flight.waited_s, flight.finish_time_s, atol=1e-9)


class Careless(NapfPlanner):
    """Decides as always, then writes into what it was given, as ``nav.position -= centre`` does."""

    def step(self, nav: NavSolution, time_s: float) -> Command:
        command = super().step(nav, time_s)
        for values in (nav.position, nav.velocity, nav.covariance, nav.common_factor, nav.available):
            values[...] = 0
        return command


@pytest.mark.parametrize("kind", ["none", "kalman", "point_mass"])
def test_a_planner_that_writes_into_what_it_is_given_changes_nothing_else(kind: str) -> None:
    """The inner loop and the verdict must not see a formation that it made up."""
    problem = short("lanes", f"navigation.filter={kind}")
    careful, careless = (
        simulate(problem, planner, seed=3, record_every=25)
        for planner in (NapfPlanner(problem), Careless(problem))
    )
    for name, values in careful.score.metrics.items():
        np.testing.assert_array_equal(careless.score.metrics[name], values, err_msg=name)
    for name in ("x_m", "est_x_m", "sigma_x_m", "available"):
        np.testing.assert_array_equal(careless.trajectories[name], careful.trajectories[name], err_msg=name)


class Inflating(NapfPlanner):
    """Makes obstacles larger where they stand, at the reset or under way."""

    when_s = -1.0

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        super().reset(obstacles, runs)
        self.map = obstacles
        if self.when_s < 0.0:
            obstacles.solids.parameters[:] += 0.5

    def step(self, nav: NavSolution, time_s: float) -> Command:
        if time_s == self.when_s:
            self.map.solids.parameters[:] += 0.5
        return super().step(nav, time_s)


@pytest.mark.parametrize("when_s", [-1.0, 1.0])
def test_a_planner_that_writes_into_the_map_is_refused_and_the_map_is_as_it_was(when_s: float) -> None:
    problem = short("lanes")
    scenario = build_scenario(problem, 3, range(2))
    before = scenario.obstacles.solids.parameters.copy()
    planner = Inflating(problem)
    planner.when_s = when_s
    with pytest.raises(ProblemError, match='planner "napf": wrote into the obstacles that it was given'):
        closed_loop(problem, planner, scenario)
    np.testing.assert_array_equal(scenario.obstacles.solids.parameters, before)


# ------------------------------------------------------------------------------------------ thrust for tilt


def test_thrust_makes_up_for_tilt_within_what_rotors_can_spare() -> None:
    follows = np.array([[True, True, True, False]])
    tilt = np.array([0.0, 0.5, 1.4, 0.5])
    attitude = np.zeros((1, 4, 3))
    attitude[0, :, 0], attitude[0, 1, 1] = tilt, -0.4
    feedforward = np.zeros((1, 4, 4))
    feedforward[..., 0], feedforward[..., 1] = 1.0, 0.2
    hold_up(follows, attitude, 10.0, 25.0, feedforward)
    held = (10.0 + feedforward[0, :, 0]) * np.cos(attitude[0, :, 0]) * np.cos(attitude[0, :, 1])
    np.testing.assert_allclose(held[:2], 11.0)  # as a vehicle that is level
    assert feedforward[0, 2, 0] == pytest.approx(0.8 * 25.0 - 10.0)  # the rest is for torques
    assert feedforward[0, 3, 0] == 1.0  # who follows no plan
    np.testing.assert_array_equal(feedforward[..., 1], 0.2)
    asked = np.full((1, 1, 4), 12.0)
    hold_up(follows[:, :1], attitude[:, :1], 10.0, 25.0, asked)
    assert asked[0, 0, 0] == 12.0  # never lowered, also beyond what tilt may take


def test_a_fast_formation_does_not_sink_when_it_takes_off() -> None:
    """To 8 m/s it tilts to its limits for seconds; without thrust for that it loses metres."""
    lowest = {}
    for tilt in ("true", "false"):
        problem = empty("mission.speed_mps=8", f"planner.tilt_thrust={tilt}")
        _, columns = fly(problem, make_planner("qp", problem), build_scenario(problem, 3, range(1)), 20)
        first = (columns["uav"] == 0) & (columns["t_s"] < 4.0)  # it starts at the height of its lane
        lowest[tilt] = columns["z_m"][first].min()
    assert lowest["true"] > -1.0
    assert lowest["false"] < -2.0
