"""Moving obstacles from the problem file to the verdict: who sees what, and what is stored."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.block import fly_block, simulate
from napf_mpc.closed_loop import Scenario, build_scenario, closed_loop
from napf_mpc.constraints.moving import MovingObstacleContact
from napf_mpc.errors import DataError, ProblemError
from napf_mpc.evaluate import METRICS, MissionScore, Outcome, Score
from napf_mpc.mission import fly_mission
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners.mpc import default_constraints
from napf_mpc.planners.planner import Command, Planner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import moving_from_json, moving_of, moving_to_json, read_moving, write_scenario
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Shape, Sphere

Array = NDArray[np.float64]

BALL = {"shape": "sphere", "start_m": [12.0, 12.0, 0.0], "velocity_mps": [0.0, -2.0, 0.0], "radius_m": 1.0}
QUICK = ["mission.length_m=14", "simulation.time_limit_s=9"]


def lone(*moving: dict[str, Any], **sections: Any) -> Problem:
    """One UAV along x at 2 m/s, 30 m, without navigation errors."""
    given: dict[str, Any] = {
        "formation": {"shape": "line", "count": 1},
        "mission": {"kind": "formation", "length_m": 30.0},
        "world": {"kind": "empty", "moving": list(moving)},
        "navigation": {"kind": "gauss_markov", "error_scale": 0.0, "sigma_min_m": 0.1, "sigma_max_m": 0.2},
        "simulation": {"time_limit_s": 30.0},
    }
    return Problem.model_validate_json(json.dumps(given | sections))


def setting(*moving: dict[str, Any]) -> str:
    """Moving obstacles as --set takes them."""
    tables = (
        "{" + ", ".join(f"{key} = {json.dumps(value)}" for key, value in each.items()) + "}"
        for each in moving
    )
    return f"world.moving=[{', '.join(tables)}]"


def fly(problem: Problem, planner: Planner, scenario: Scenario) -> Score:
    judge = MissionScore(problem, scenario)
    return judge.score(closed_loop(problem, planner, scenario, (judge,)))


# ------------------------------------------------------------------------------------------ the problem


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("world.moving[0].radius_m=0", "world.moving[0].radius_m = 0: must be >= 0.01"),
        (
            "world.moving[0].velocity_mps=[0, 200, 0]",
            "world.moving[0].velocity_mps[1] = 200: must be >= -100",
        ),
        (
            "world.moving[0].velocity_mps=[0, 2]",
            "world.moving[0].velocity_mps = [0, 2]: must be a list of 3",
        ),
        ("world.moving[1].start_m=[0, 2, 3]", "world.moving[1].start_m = [0, 2, 3]: must be a list of 2"),
        ("world.moving[0].start_m=[nan, 0, 0]", "world.moving[0].start_m[0]"),
        ("world.moving[0].shape=box", 'world.moving[0].shape = "box": must be "sphere" or "cylinder"'),
        ("world.moving[0].speed=3", "world.moving[0].speed: unknown key"),
        ("world.moving[2].acceleration_sigma_mps2=-1", "must be >= 0 and <= 20"),
        ("world.moving_sigma_m=0", "world.moving_sigma_m = 0: must be >= 0.001"),
        ("world.moving_rate_hz=7", "world.moving_rate_hz = 7 must divide 50 Hz a whole number of times"),
        ("world.moving_rate_hz=100", "world.moving_rate_hz = 100 must divide 50 Hz"),
    ],
)
def test_what_cannot_be_meant_is_named(setting: str, words: str) -> None:
    with pytest.raises(ProblemError) as caught:
        load_problem("crossing_traffic", [setting])
    assert any(words in line for line in caught.value.problems), caught.value.problems


@pytest.mark.parametrize("name", ["table1_8", "table1_40", "square_8", "street_canyon", "nishi_shinjuku"])
def test_every_kind_of_world_takes_them(name: str) -> None:
    problem = load_problem(name, [setting(BALL)])
    assert problem.world.moving[0].radius_m == 1.0
    moving = moving_of(problem, 1, range(2))
    assert moving is not None
    assert (moving.count, moving.runs) == (1, 2)


def test_a_walk_without_time_takes_none() -> None:
    with pytest.raises(ProblemError, match=r"world\.moving: a mission of kind goal"):
        load_problem("single_uav", [setting(BALL)])


def test_a_rate_of_observation_does_not_matter_without_anything_to_observe() -> None:
    load_problem(
        "table1_8", ["simulation.controller_rate_hz=25", "planner.rate_hz=5", "navigation.rate_hz=5"]
    )


# ------------------------------------------------------------------------- without any nothing changes


def test_without_any_planners_are_given_none_and_the_program_has_no_rows_for_them() -> None:
    problem = load_problem("table1_8", QUICK)
    assert build_scenario(problem, 1, range(1)).moving is None
    assert not any(isinstance(each, MovingObstacleContact) for each in default_constraints(problem))
    seen: list[NavSolution] = []
    fly(problem, _Tape(make_planner("apf", problem), seen), build_scenario(problem, 1, range(1)))
    assert all(nav.tracks is None for nav in seen)
    there = default_constraints(load_problem("crossing_traffic"))
    assert [each.obstacles for each in there if isinstance(each, MovingObstacleContact)] == [3]


@pytest.mark.parametrize("planner", ["apf", "napf"])
def test_one_that_is_far_away_changes_no_bit(planner: str) -> None:
    far = BALL | {"start_m": [0.0, 5e4, 0.0]}
    without, beside = (
        fly_block(load_problem("table1_8", [*QUICK, setting(*moving)]), [planner], 3, range(3)).rows
        for moving in ([], [far])
    )
    for name in METRICS:
        np.testing.assert_array_equal(beside[name], without[name], err_msg=name)


# ---------------------------------------------------------------------------------------------- verdicts


def test_at_rest_it_is_judged_like_an_obstacle_that_stands() -> None:
    """The same flight, straight through: least clearance to 1e-9 m, the same contacts."""
    calm = {"planner": {"repulsive_gain": 0.0}, "vehicle": {"radius_m": 0.3}}
    where = {"shape": "sphere", "radius_m": 1.0}
    still = lone(where | {"start_m": [12.0, 1.1, 0.0], "velocity_mps": [0.0, 0.0, 0.0]}, **calm)
    world = {"kind": "list", "obstacles": [where | {"centre_m": [12.0, 1.1, 0.0]}]}
    standing = lone(**calm, world=world)
    a, b = (simulate(problem, "apf", seed=2, runs=2).score for problem in (still, standing))
    np.testing.assert_allclose(a.metrics["min_clearance_m"], b.metrics["min_clearance_m"], rtol=0, atol=1e-9)
    assert a.outcome == b.outcome == (Outcome.COLLIDED,) * 2
    np.testing.assert_array_equal(a.obstacle_contact, b.obstacle_contact)


def test_one_that_shoots_through_the_path_between_two_samples_is_a_contact() -> None:
    """0.1 m of radius at 100 m/s: 2 m in a step of 0.02 s. The UAV is a point that passes x = 12 m then."""
    quiet = lone(planner={"repulsive_gain": 0.0}, vehicle={"radius_m": 0.0})
    track = simulate(quiet, "apf", seed=1, runs=1, record_every=1).trajectories
    when = int(np.argmin(np.abs(track["x_m"] - 12.0)))
    moment = float(track["t_s"][when]) + 0.01
    middle = 0.5 * (track["x_m"][when] + track["x_m"][when + 1])
    start = [float(middle), -100.0 * moment, 0.0]
    shot = {"shape": "sphere", "start_m": start, "velocity_mps": [0.0, 100.0, 0.0], "radius_m": 0.1}
    score = simulate(lone(shot, planner={"repulsive_gain": 0.0}, vehicle={"radius_m": 0.0}), "apf").score
    assert score.outcome == (Outcome.COLLIDED,)
    assert score.metrics["min_clearance_m"][0] == pytest.approx(-0.1, abs=0.01)


# ------------------------------------------------------------------------------------------ who sees what


class _Tape:
    """Planner that keeps what it is given."""

    name = "tape"

    def __init__(self, inner: Planner, seen: list[NavSolution]) -> None:
        self._inner, self._seen = inner, seen

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self._inner.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        self._seen.append(nav)
        return self._inner.step(nav, time_s)


class _Poisoned(_Tape):
    """Planner that computes while the truth about what moves is NaN, and spoils its tracks afterwards."""

    def __init__(self, inner: Planner, scenario: Scenario) -> None:
        super().__init__(inner, [])
        assert scenario.moving is not None
        self._truth = [getattr(scenario.moving, field.name) for field in fields(scenario.moving)]

    def step(self, nav: NavSolution, time_s: float) -> Command:
        tracks = nav.tracks
        assert isinstance(tracks, Tracks)
        numbers = [values for values in self._truth if values.dtype == np.float64]
        kept = [values.copy() for values in numbers]
        for values in numbers:
            values[...] = np.nan
        command = self._inner.step(nav, time_s)
        for values, before in zip(numbers, kept, strict=True):
            values[...] = before
        for name in ("position", "velocity", "covariance", "radius"):
            array = getattr(tracks, name)
            assert not any(np.shares_memory(array, values) for values in self._truth), name
            array[...] = np.nan
        return command


@pytest.mark.parametrize("planner", ["apf", "napf", "qp"])
def test_planners_do_not_look_at_the_truth(planner: str) -> None:
    problem = load_problem("crossing_traffic", ["mission.length_m=22", "simulation.time_limit_s=14"])
    scenario = build_scenario(problem, 5, range(2))
    plain = fly(problem, make_planner(planner, problem), scenario)
    poisoned = fly(problem, _Poisoned(make_planner(planner, problem), scenario), scenario)
    assert poisoned.outcome == plain.outcome
    for name in METRICS:
        np.testing.assert_array_equal(poisoned.metrics[name], plain.metrics[name], err_msg=name)


def test_planners_see_observations_not_places() -> None:
    """Twenty times the noise: the tracks are off by more than a metre, and say so."""
    for sigma, low, high in ((0.05, 0.0, 0.3), (5.0, 0.5, 15.0)):
        seen: list[NavSolution] = []
        problem = lone(BALL, world={"kind": "empty", "moving": [BALL], "moving_sigma_m": sigma})
        scenario = build_scenario(problem, 1, range(4))
        fly(problem, _Tape(make_planner("apf", problem), seen), scenario)
        assert scenario.moving is not None
        nav = seen[60]
        assert nav.tracks is not None
        error = nav.tracks.position - scenario.moving.position(nav.time_s)
        claimed = np.sqrt(nav.tracks.covariance[0, 0, 0, 0])
        assert low < np.abs(error).max() < high
        assert np.abs(error).max() < 5.0 * claimed < 25.0 * sigma


@pytest.mark.parametrize("planner", ["apf", "napf", "napf_guided"])
def test_runs_do_not_depend_on_their_block(planner: str) -> None:
    problem = load_problem("crossing_traffic", ["mission.length_m=30"])
    whole = fly_block(problem, [planner], 4, range(6)).rows
    parts = [fly_block(problem, [planner], 4, runs).rows for runs in (range(2), range(2, 6))]
    for name in METRICS:
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), whole[name])
    assert len(set(whole["min_clearance_m"].tolist())) == 6


# -------------------------------------------------------------------------------------------- they avoid


@pytest.mark.parametrize("planner", ["apf", "napf"])
@pytest.mark.parametrize("upright", [False, True])
def test_the_field_of_one_at_rest_and_certain_is_that_of_one_that_stands(planner: str, upright: bool) -> None:
    """Commands to 1e-9 for 50 x 4 UAVs around a ball or cylinder, inside it and at its centre too."""
    problem, centre = load_problem("table1_8", ["planner.k=2"]), np.array([3.0, 1.0, 0.5])
    rng = np.random.default_rng(8)
    place = centre + rng.normal(0.0, 2.0, (50, 4, 3))
    place[0, 0] = centre
    covariance = np.zeros((50, 4, 6, 6))
    covariance[..., [0, 1, 2], [0, 1, 2]] = rng.uniform(0.01, 0.5, (50, 4, 3))
    shape = (50, 4)
    nav = NavSolution(
        0.0, np.ones(shape, dtype=bool), place, np.zeros((*shape, 3)), np.zeros((*shape, 3)),
        np.zeros((*shape, 3)), covariance, np.zeros((*shape, 3, 1)),
    )  # fmt: skip
    tracks = Tracks(
        np.broadcast_to(centre, (50, 1, 3)), np.zeros((50, 1, 3)), np.zeros((50, 1, 6, 6)),
        np.array([1.2]), np.array([upright]), 0.0,
    )  # fmt: skip
    solid: Shape = Cylinder((3.0, 1.0), 1.2) if upright else Sphere((3.0, 1.0, 0.5), 1.2)
    commands = []
    for world, seen in ((ObstacleSet.empty(), tracks), (ObstacleSet.from_shapes([solid]), None)):
        pilot = make_planner(planner, problem)
        pilot.reset(world, 50)
        commands.append(pilot.step(replace(nav, tracks=seen), 0.0))
    for name in ("position", "velocity", "direction"):
        ours, theirs = (getattr(command, name) for command in commands)
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9, err_msg=name)
    assert np.abs(commands[0].velocity[..., 1]).max() > 0.5


def test_napf_inflates_by_the_uncertainty_of_the_track_too() -> None:
    """5 m off with rho_0 = 3 m: certain, nothing; tracked to 1.5 m, k = 2, it repels; APF never."""
    problem = load_problem("table1_8", ["planner.k=2"])
    place = np.array([[[6.403, 3.0, 0.0], [-6.403, -3.0, 0.0], [3.0, -6.403, 0.0], [-3.0, 6.403, 0.0]]])
    small = np.zeros((1, 4, 6, 6))
    small[..., [0, 1, 2], [0, 1, 2]] = 1e-4
    shape = (1, 4)
    nav = NavSolution(
        0.0, np.ones(shape, dtype=bool), place, np.zeros((*shape, 3)), np.zeros((*shape, 3)),
        np.zeros((*shape, 3)), small, np.zeros((*shape, 3, 1)),
    )  # fmt: skip
    aside = {}
    for planner in ("apf", "napf"):
        for sigma in (0.0, 1.5):
            tracks = Tracks(
                np.array([[[6.403, 9.0, 0.0]]]), np.zeros((1, 1, 3)), sigma**2 * np.eye(6)[None, None],
                np.array([1.0]), np.array([False]), 0.0,
            )  # fmt: skip
            pilot = make_planner(planner, problem)
            pilot.reset(ObstacleSet.empty(), 1)
            aside[planner, sigma] = pilot.step(replace(nav, tracks=tracks), 0.0).velocity[0, 0, 1]
    assert aside["apf", 0.0] == aside["apf", 1.5] == aside["napf", 0.0] == 0.0
    assert aside["napf", 1.5] < -0.1


@pytest.mark.parametrize("planner", ["apf", "napf_guided", "qp"])
def test_a_slow_crossing_ball_is_avoided(planner: str) -> None:
    """It would hit the UAV in the middle; avoided, there is air between, and the mission is flown."""
    slow = BALL | {"start_m": [12.0, 3.2, 0.0], "velocity_mps": [0.0, -0.5, 0.0]}
    hit = simulate(lone(slow, planner={"repulsive_gain": 0.0}), "apf").score
    assert hit.metrics["min_clearance_m"][0] < -0.5
    score = simulate(lone(slow), planner).score
    assert score.outcome == (Outcome.REACHED,)
    assert score.metrics["min_clearance_m"][0] > 0.1


def test_the_program_sees_a_fast_one_coming() -> None:
    """At 4 m/s across: the field acts from 3 m on, which is too late; the plan has seen it for seconds."""
    fast = BALL | {"start_m": [12.0, 26.5, 0.0], "velocity_mps": [0.0, -4.0, 0.0], "radius_m": 1.5}
    clear = {name: simulate(lone(fast), name).score.metrics["min_clearance_m"][0] for name in ("apf", "qp")}
    assert clear["apf"] < 0.0 < 0.3 < clear["qp"]


def test_a_tail_is_clear_only_of_where_they_will_be() -> None:
    problem = lone(BALL)
    planner: Any = make_planner("qp", problem)
    planner.reset(ObstacleSet.empty(), 1)
    seen: list[NavSolution] = []
    fly(problem, _Tape(planner, seen), build_scenario(problem, 1, range(1)))
    tracks = seen[-1].tracks
    assert tracks is not None
    plan = planner._plan
    ahead = np.cumsum(plan.step_s)[9]
    there = plan.states[0, 0, 9, 0:6:2]
    planner._tracks = replace(tracks, position=(there - tracks.velocity[0] * ahead)[None])
    assert planner._clearance(plan)[0, 0] == pytest.approx(-1.0 - problem.vehicle.radius_m, abs=1e-9)
    planner._tracks = None
    assert planner._clearance(plan)[0, 0] == np.inf


# ---------------------------------------------------------------------------------------------- the files


def test_every_verdict_can_be_recomputed_from_the_files(tmp_path: Path) -> None:
    """Trajectory and scenario file alone give the least clearance: relative motion straight between ticks."""
    problem = load_problem(
        "crossing_traffic", ["simulation.time_limit_s=15", "world.moving[0].start_m=[11, -16, 0]"]
    )
    flown = fly_mission(problem, "crossing", "apf", seed=7, run=3, out=tmp_path)
    (moving,) = read_moving(tmp_path / "scenario.json").values()
    track, least = flown.trajectories, np.inf
    for uav in range(4):
        mine = track["uav"] == uav
        path = np.column_stack([track[f"{axis}_m"][mine] for axis in "xyz"])
        centres = np.stack([moving.position(time)[0] for time in track["t_s"][mine].tolist()])
        apart = path[:, None] - centres
        apart[..., 2] = np.where(moving.upright, 0.0, apart[..., 2])
        share = np.linspace(0.0, 1.0, 201)[:, None, None, None]
        between = apart[:-1] + share * (apart[1:] - apart[:-1])
        least = min(least, float((np.linalg.norm(between, axis=-1) - moving.radius).min()))
    assert flown.row["min_clearance_m"] == pytest.approx(least - problem.vehicle.radius_m, abs=1e-4)
    assert flown.row["min_clearance_m"] < 5.0


def test_the_file_holds_the_truth_of_every_run(tmp_path: Path) -> None:
    problem = load_problem("crossing_traffic")
    write_scenario(tmp_path / "scenario.json", problem, 4, range(2, 5))
    stored = read_moving(tmp_path / "scenario.json")
    assert list(stored) == [2, 3, 4]
    truth = moving_of(problem, 4, range(2, 5))
    assert truth is not None
    for time in (0.0, 7.3, 55.0):
        for i, run in enumerate(stored):
            np.testing.assert_array_equal(stored[run].position(time), truth.position(time)[i : i + 1])


def test_what_never_accelerates_is_written_once(tmp_path: Path) -> None:
    write_scenario(tmp_path / "scenario.json", lone(BALL), 4, range(5))
    stored = read_moving(tmp_path / "scenario.json")
    assert list(stored) == [None]
    np.testing.assert_array_equal(stored[None].position(3.0), [[[12.0, 6.0, 0.0]]])
    write_scenario(tmp_path / "none.json", lone(), 4, range(5))
    assert "moving" not in json.loads((tmp_path / "none.json").read_text())
    assert read_moving(tmp_path / "none.json") == {}


@pytest.mark.parametrize(
    "change", [{"shape": "torus"}, {"radius_m": "wide"}, {"start_m": [1.0]}, {"accelerations_mps2": [[1.0]]}]
)
def test_what_is_no_moving_obstacle_of_ours_is_refused(change: dict[str, Any]) -> None:
    moving = moving_of(lone(BALL))
    assert moving is not None
    (table,) = moving_to_json(moving)
    np.testing.assert_array_equal(moving_from_json([table]).start, moving.start)
    with pytest.raises(DataError, match="not moving obstacles of ours"):
        moving_from_json([table | change])


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "scenario.json").write_text('{"moving": [{"run": 1}]}')
    with pytest.raises(DataError, match=r"scenario\.json: not a scenario of ours"):
        read_moving(tmp_path / "scenario.json")
