"""Verdicts and metrics on flights made by hand, in metres."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.closed_loop import POSITION, Flight, build_scenario, formation_mission
from napf_mpc.evaluate import DELAYED, METRICS, MissionScore, Outcome, Score
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import REASON_WORDS, Reason
from napf_mpc.problem import Problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]
Motion = Callable[[float], Any]

TICK_S = 0.1
OF_NAVIGATION = ("shape_floor_m", "within_k_sigma", "nees", "gated_fixes", "missed_fixes", "monitor_")
"""Metrics that say what navigation was worth; all others are about the truth alone."""
ONE_OF_FOUR = np.array([(1.0,), (0.0,), (0.0,), (0.0,)])
EAST, NORTH, UP = np.eye(3)


def problem(**sections: Any) -> Problem:
    given: dict[str, Any] = {
        "vehicle": {"radius_m": 0.0},
        "formation": {"shape": "square"},
        "mission": {"kind": "formation", "length_m": 100.0},
        "world": {"kind": "empty"},
        "simulation": {"controller_rate_hz": 10.0},
    }
    return Problem.model_validate(given | sections)


def judged(
    offset: Motion,
    *,
    until_s: float = 30.0,
    from_s: float = 0.0,
    shapes: list[Shape] | None = None,
    nav_error: Motion = lambda _: 0.0,
    inputs: Any = (9.81, 0.0, 0.0, 0.0),
    speed_mps: float = 2.0,
    runs: int = 1,
    active: Any = True,
    flight: dict[str, Any] | None = None,
    **sections: Any,
) -> Score:
    """Score of a formation that flies at 2 m/s along its path, ``offset(t)`` (uav, 3) away from its slots."""
    given = problem(**sections)
    mission = formation_mission(given)
    frame, slots = PathFrame.of_mission(mission), formation_offsets(given.formation)
    scenario = build_scenario(given, 0, range(runs))
    if shapes is not None:
        scenario = replace(scenario, obstacles=ObstacleSet.from_shapes(shapes))
    uavs, flying = len(slots), np.broadcast_to(np.asarray(active, dtype=bool), (runs,)).copy()

    def state(time_s: float) -> Array:
        out = np.zeros((runs, uavs, 12))
        out[..., POSITION] = frame.to_world(slots + speed_mps * time_s * EAST + np.asarray(offset(time_s)))
        return out

    judge = MissionScore(given, replace(scenario, initial_state=state(from_s)))
    command: Any = None  # a judge looks at what was flown, not at what was asked
    for tick in range(round(from_s / TICK_S), round(until_s / TICK_S)):
        now = tick * TICK_S
        before, after = state(now), state(now + TICK_S)
        estimate = before[..., POSITION] + frame.directions_to_world(
            np.broadcast_to(np.asarray(nav_error(now)), (runs, uavs, 3))
        )
        covariance = np.zeros((runs, uavs, 6, 6))
        covariance[..., [0, 1, 2], [0, 1, 2]] = 1.0
        nav = NavSolution(
            now, np.ones((runs, uavs), bool), estimate, *(np.zeros((runs, uavs, 3)) for _ in range(3)),
            covariance, np.zeros((runs, uavs, 3, 1)),
        )  # fmt: skip
        given_inputs = np.broadcast_to(np.asarray(inputs, dtype=float), (runs, uavs, 4)).copy()
        judge.ticked(now, before, nav, command, given_inputs, flying)
        judge.moved(now + TICK_S, before, after, flying)
    ended: dict[str, Any] = {
        "reached": np.ones(runs, bool),
        "failed": np.zeros(runs, bool),
        "holding": np.zeros(runs, bool),
        "finish_time_s": np.full(runs, until_s),
        "duration_s": np.full(runs, until_s),
    }
    return judge.score(Flight(**(ended | (flight or {}))))


def metric(score: Score, name: str) -> float:
    return float(score.metrics[name][0])


# -------------------------------------------------------------------------------------- formation errors


def test_in_its_slots_a_formation_has_no_error() -> None:
    score = judged(lambda _: np.zeros((4, 3)))
    for name in ("path_rms_m", "shape_rms_m", "shape_floor_m"):
        assert metric(score, name) == pytest.approx(0.0, abs=1e-12)
    assert metric(score, "path_length_ratio") == pytest.approx(1.0, abs=1e-12)
    assert score.outcome == (Outcome.REACHED,)
    assert score.joint_success.all()
    assert np.isnan(metric(score, "min_clearance_m"))  # nothing to be clear of
    assert metric(score, "min_separation_m") == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("axis", "path_m"), [(EAST, math.sqrt(3.0) / 4.0), (NORTH, 0.5), (UP, 0.5)], ids=["along", "left", "up"]
)
def test_one_uav_a_metre_out_of_its_slot(axis: Array, path_m: float) -> None:
    """1 m of one in four: 0.5 m rms; without the best common shift of 0.25 m, sqrt(3) / 4 = 0.433 m.

    Along the path the slots move with the mean of all UAVs, so that the common shift never counts.
    """
    score = judged(lambda _: ONE_OF_FOUR * axis)
    assert metric(score, "path_rms_m") == pytest.approx(path_m, abs=1e-12)
    assert metric(score, "shape_rms_m") == pytest.approx(math.sqrt(3.0) / 4.0, abs=1e-12)


def test_a_common_shift_is_a_path_error_and_no_shape_error() -> None:
    """4 m to the left and 3 m down together: 5 m off the path, shape intact. Along the path it is neither."""
    score = judged(lambda _: np.tile(4.0 * NORTH - 3.0 * UP, (4, 1)))
    assert metric(score, "path_rms_m") == pytest.approx(5.0, abs=1e-12)
    assert metric(score, "shape_rms_m") == pytest.approx(0.0, abs=1e-12)
    late = judged(lambda _: np.tile(-7.0 * EAST, (4, 1)))
    assert metric(late, "path_rms_m") == pytest.approx(0.0, abs=1e-12)


def test_errors_are_those_of_the_path_whatever_its_direction() -> None:
    """To the left and up of a climbing path to the south-west."""
    mission = {"kind": "formation", "length_m": 100.0, "heading_deg": 210.0, "climb_deg": 20.0}
    score = judged(lambda _: ONE_OF_FOUR * (0.6 * NORTH + 0.8 * UP), mission=mission)
    assert metric(score, "path_rms_m") == pytest.approx(0.5, abs=1e-9)
    assert metric(score, "shape_rms_m") == pytest.approx(math.sqrt(3.0) / 4.0, abs=1e-9)


def test_what_the_formation_looked_like_while_it_took_shape_does_not_count() -> None:
    """8 m out until 12 s, then 1 m on one UAV for half of the time left."""

    def offset(time_s: float) -> Array:
        size = 8.0 if time_s < 11.95 else 1.0 if time_s < 21.95 else 0.0
        return size * ONE_OF_FOUR * UP

    score = judged(offset, until_s=32.0)
    assert metric(score, "path_rms_m") == pytest.approx(math.sqrt(0.5 * 0.25), abs=1e-12)
    short = judged(offset, until_s=11.0)
    assert np.isnan(metric(short, "path_rms_m"))
    assert np.isnan(metric(short, "shape_floor_m"))


def test_shape_floor_is_what_the_navigation_errors_alone_would_cause() -> None:
    """One estimate 1 m off floors the shape at sqrt(3) / 4 m; an error common to all does not."""
    own = judged(lambda _: np.zeros((4, 3)), nav_error=lambda _: ONE_OF_FOUR * EAST)
    assert metric(own, "shape_floor_m") == pytest.approx(math.sqrt(3.0) / 4.0, abs=1e-12)
    assert metric(own, "shape_rms_m") == pytest.approx(0.0, abs=1e-12)
    common = judged(lambda _: np.zeros((4, 3)), nav_error=lambda _: np.array([3.0, -4.0, 5.0]))
    assert metric(common, "shape_floor_m") == pytest.approx(0.0, abs=1e-12)
    noise = np.random.default_rng(1).normal(0.0, 2.0, (400, 4, 3))
    drawn = judged(lambda _: np.zeros((4, 3)), nav_error=lambda t: noise[round(t / TICK_S)], until_s=40.0)
    # Independent errors of 2 m on three axes, less their mean: 2 sqrt(3 * 3/4) = 3 m.
    assert metric(drawn, "shape_floor_m") == pytest.approx(3.0, rel=0.06)


@pytest.mark.parametrize(("axis", "name"), [(0, "east"), (1, "north"), (2, "up")])
def test_share_of_errors_within_the_reported_k_sigma(axis: int, name: str) -> None:
    """Sigma reported as 1 m, k = 3: 2.9 m of one in four is within, 3.1 m is not, on its own axis."""
    for size_m, share in ((2.9, 1.0), (3.1, 0.75), (-3.1, 0.75)):
        score = judged(
            lambda _: np.zeros((4, 3)),
            until_s=2.0,
            nav_error=lambda _, e=size_m: ONE_OF_FOUR * e * np.eye(3)[axis],
        )
        for other in ("east", "north", "up"):
            assert metric(score, f"within_k_sigma_{other}") == (share if other == name else 1.0)


# ------------------------------------------------------------------------------------- way, effort, time


def test_path_ratio_is_flown_over_gained() -> None:
    """Weaving 45 degrees left and right costs sqrt(2)."""
    weave = judged(lambda t: np.tile(2.0 * abs((t + 2.0) % 4.0 - 2.0) * NORTH, (4, 1)), until_s=20.0)
    assert metric(weave, "path_length_ratio") == pytest.approx(math.sqrt(2.0), abs=1e-9)
    back = judged(lambda _: np.zeros((4, 3)), speed_mps=-1.0)
    assert np.isnan(metric(back, "path_length_ratio"))


def test_effort_is_the_integral_of_squares_about_hover() -> None:
    """1 N above hover for 10 s on each of four: 40 N^2 s; a torque of 0.5 N m on each axis adds 4 * 7.5."""
    hover = judged(lambda _: np.zeros((4, 3)), until_s=10.0)
    assert metric(hover, "control_effort") == pytest.approx(0.0, abs=1e-12)
    thrust = judged(lambda _: np.zeros((4, 3)), until_s=10.0, inputs=(10.81, 0.0, 0.0, 0.0))
    assert metric(thrust, "control_effort") == pytest.approx(40.0)
    torque = judged(lambda _: np.zeros((4, 3)), until_s=10.0, inputs=(10.81, 0.5, -0.5, 0.5))
    assert metric(torque, "control_effort") == pytest.approx(70.0)
    heavy = {"mass_kg": 2.0}
    assert metric(
        judged(lambda _: np.zeros((4, 3)), until_s=10.0, vehicle=heavy, inputs=(19.62, 0, 0, 0)),
        "control_effort",
    ) == pytest.approx(0.0, abs=1e-12)


# ------------------------------------------------------------------------------------------- re-forming

REAR_M = -10.0 / math.sqrt(2.0) * math.cos(math.asin(3.0 * math.sqrt(2.0) / 10.0))


def rear_at(time_s: float) -> float:
    """Along-track place of the rear UAV of a formation in its slots."""
    return 2.0 * time_s + REAR_M


def test_re_forming_counts_from_the_last_obstacle_until_the_shape_holds() -> None:
    """A ball ends at 20 m; the rear passes it at 13.2 s; one UAV is 4 m out until 18 s."""
    score = judged(
        lambda t: (4.0 if t < 17.95 else 0.0) * ONE_OF_FOUR * UP, shapes=[Sphere((19.0, 0.0, 0.0), 1.0)]
    )
    passed_s = (20.0 - REAR_M) / 2.0
    assert metric(score, "reform_time_s") == pytest.approx(18.0 - passed_s, abs=0.101)
    assert rear_at(passed_s) == pytest.approx(20.0)


def test_a_formation_that_kept_its_shape_has_nothing_to_re_form() -> None:
    """1.9 m out of a bound of 2 m: the best common shift takes off a quarter."""
    score = judged(lambda _: 2.6 * ONE_OF_FOUR * UP, shapes=[Sphere((19.0, 4.0, 0.0), 1.0)])
    assert metric(score, "reform_time_s") == 0.0
    never = judged(lambda _: 2.7 * ONE_OF_FOUR * UP, shapes=[Sphere((19.0, 4.0, 0.0), 1.0)])
    assert np.isnan(metric(never, "reform_time_s"))
    assert not never.joint_success[0]
    loose = {"kind": "formation", "length_m": 100.0, "reform_bound_m": 2.1}
    wider = judged(lambda _: 2.7 * ONE_OF_FOUR * UP, shapes=[Sphere((19.0, 4.0, 0.0), 1.0)], mission=loose)
    assert metric(wider, "reform_time_s") == 0.0


def test_a_shape_that_holds_for_less_than_a_second_is_not_re_formed() -> None:
    """In shape for 0.9 s at 15 s and for good from 20 s."""

    def offset(time_s: float) -> Array:
        return (0.0 if 14.95 < time_s < 15.85 or time_s > 19.95 else 5.0) * ONE_OF_FOUR * UP

    ball: list[Shape] = [Sphere((19.0, 4.0, 0.0), 1.0)]
    passed_s = (20.0 - REAR_M) / 2.0
    score = judged(offset, shapes=ball)
    assert metric(score, "reform_time_s") == pytest.approx(20.0 - passed_s, abs=0.101)
    assert np.isnan(metric(judged(offset, shapes=ball, until_s=20.8), "reform_time_s"))


TURNED = Box((30.0, 0.0, 0.0), (10.0, 10.0, 4.0), math.radians(45.0))
HOUSE = Prism((np.array([(20.0, -3.0), (33.0, -3.0), (33.0, 5.0), (20.0, 5.0)]),), -10.0, 50.0)


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 90.0, 200.0])
@pytest.mark.parametrize(
    ("shapes", "end_m"),
    [
        ([Sphere((30.0, 1.0, 0.0), 1.5)], 31.5),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Cylinder((20.0, 0.0), 1.0)], 31.5),
        ([Cylinder((30.0, 0.0), 2.0)], 32.0),
        ([TURNED], 30.0 + math.sqrt(50.0)),
        ([HOUSE], 33.0),
        # Beside the corridor of 6.4 + 3 m, over it, under it, behind the start, beyond the end or across it.
        ([Sphere((30.0, 1.0, 0.0), 1.5), Sphere((99.0, 1.0, 0.0), 2.0)], 31.5),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Sphere((40.0, 12.0, 0.0), 2.0)], 31.5),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Sphere((40.0, 11.0, 0.0), 2.0)], 42.0),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Sphere((40.0, 0.0, 6.0), 2.0)], 31.5),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Box((40.0, 0.0, -10.0), (9.0, 9.0, 9.0))], 31.5),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Sphere((-20.0, 0.0, 0.0), 2.0)], 31.5),
        ([Sphere((30.0, 1.0, 0.0), 1.5), Sphere((150.0, 0.0, 0.0), 2.0)], 31.5),
    ],
    ids=lambda value: "" if isinstance(value, float) else "+".join(type(s).__name__ for s in value),
)
def test_where_the_last_obstacle_ends(shapes: list[Shape], end_m: float, heading_deg: float) -> None:
    """Seen through the re-forming time of a formation that is out of shape until 30 s, in every direction."""
    turn = math.radians(heading_deg)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])
    turned: list[Shape] = []
    for shape in shapes:
        match shape:
            case Sphere():
                turned.append(Sphere(tuple(rotation @ shape.centre_m), shape.radius_m))
            case Cylinder():
                turned.append(Cylinder(tuple(rotation[:2, :2] @ shape.centre_m), shape.radius_m))
            case Box():
                turned.append(Box(tuple(rotation @ shape.centre_m), shape.size_m, shape.heading_rad + turn))
            case Prism():
                turned.append(Prism((shape.rings[0] @ rotation[:2, :2].T,), shape.base_m, shape.top_m))
    mission = {"kind": "formation", "length_m": 100.0, "heading_deg": heading_deg}
    score = judged(
        lambda t: (9.0 if t < 29.95 else 0.0) * ONE_OF_FOUR * UP,
        shapes=turned, mission=mission, from_s=14.0, until_s=31.1,
    )  # fmt: skip
    passed_s = 30.0 - metric(score, "reform_time_s")
    assert rear_at(passed_s) == pytest.approx(end_m, abs=0.21)


def test_where_an_obstacle_ends_under_a_climbing_path() -> None:
    """A mast that ends 27 m ahead on the map is passed at 27 m / cos 30 deg, one under it is not met."""
    mission = {"kind": "formation", "length_m": 100.0, "heading_deg": 90.0, "climb_deg": 30.0}
    given = problem(mission=mission)
    scenario = build_scenario(given, 0, range(1))
    masts = ObstacleSet.from_shapes([Cylinder((0.0, 26.0), 1.0), Cylinder((0.0, 60.0), 1.0, -50.0, -4.0)])
    ends = MissionScore(given, replace(scenario, obstacles=masts))._last_obstacle
    assert ends[0] == pytest.approx(27.0 / math.cos(math.radians(30.0)))


def test_each_run_has_its_own_last_obstacle() -> None:
    given = problem()
    scenario = build_scenario(given, 0, range(3))
    scenes = ObstacleSet.stack(
        [
            ObstacleSet.from_shapes([Sphere((20.0, 0.0, 0.0), 1.0)]),
            ObstacleSet.empty(),
            ObstacleSet.from_shapes([Sphere((40.0, 0.0, 0.0), 1.0), Sphere((30.0, 0.0, 0.0), 1.0)]),
        ]
    )
    ends = MissionScore(given, replace(scenario, obstacles=scenes))._last_obstacle
    np.testing.assert_array_equal(ends, [21.0, np.nan, 41.0])
    alone = MissionScore(given, replace(scenario, obstacles=scenes.scene(2)))._last_obstacle
    np.testing.assert_array_equal(alone, [41.0] * 3)


# --------------------------------------------------------------------------------------------- contacts


@pytest.mark.parametrize(("gap_m", "hit"), [(0.3 - 1e-6, True), (0.3 + 1e-6, False), (-1.0, True)])
def test_contact_is_the_hull_touching_the_solid(gap_m: float, hit: bool) -> None:
    """UAV 1 flies at y = 3 m past a ball; its hull has 0.3 m."""
    ball = Sphere((20.0, 3.0 + 1.0 + gap_m, 0.0), 1.0)
    score = judged(lambda _: np.zeros((4, 3)), shapes=[ball], vehicle={"radius_m": 0.3}, until_s=15.0)
    assert score.obstacle_contact.tolist() == [[hit, False, False, False]]
    assert score.outcome == ((Outcome.COLLIDED if hit else Outcome.REACHED),)
    assert metric(score, "min_clearance_m") == pytest.approx(gap_m - 0.3, abs=1e-6)
    assert not score.uav_contact[0]


def test_two_uavs_too_close_are_a_collision_counted_apart() -> None:
    """UAV 1 crosses to 0.5 m of UAV 3's place after 10 s, then goes home."""
    slots = formation_offsets(problem().formation)
    towards = slots[2] - slots[0] + np.array([0.0, 0.0, 0.5])

    def offset(time_s: float) -> Array:
        return ONE_OF_FOUR * towards * max(0.0, 1.0 - abs(time_s - 10.0))

    score = judged(offset)
    assert score.uav_contact.tolist() == [True]
    assert not score.obstacle_contact.any()
    assert score.outcome == (Outcome.COLLIDED,)
    assert score.finished.all()
    assert not score.joint_success.any()
    nearest_m = 5.0 / math.sqrt(100.25)  # from UAV 3 to the line that UAV 1 flies
    assert metric(score, "min_separation_m") == pytest.approx(nearest_m, abs=1e-9)
    clear = judged(offset, vehicle={"radius_m": 0.0, "min_separation_m": nearest_m - 1e-6})
    assert clear.outcome == (Outcome.REACHED,)


def test_two_uavs_may_be_close_while_they_take_off() -> None:
    """The paper's take-off places are 1.4 m apart: separation counts from 5 s on."""
    slots = formation_offsets(problem().formation)
    together = slots[2] - slots[0]
    score = judged(lambda t: ONE_OF_FOUR * together * max(0.0, 4.5 - t) / 4.5)
    assert score.outcome == (Outcome.REACHED,)
    assert metric(score, "min_separation_m") == pytest.approx(10.0)
    late = judged(lambda t: ONE_OF_FOUR * together * float(t < 5.5))
    assert late.outcome == (Outcome.COLLIDED,)


def test_two_uavs_that_pass_through_each_other_between_samples_are_seen() -> None:
    """UAV 1 jumps 10 m through UAV 3's place in one step."""
    slots = formation_offsets(problem().formation)
    through = 2.0 * (slots[2] - slots[0])
    score = judged(lambda t: ONE_OF_FOUR * through * float(t > 15.01))
    assert score.uav_contact[0]
    assert metric(score, "min_separation_m") < 0.05


def test_one_uav_alone_has_no_separation() -> None:
    score = judged(lambda _: np.zeros((1, 3)), formation={"shape": "line", "count": 1})
    assert score.outcome == (Outcome.REACHED,)
    assert np.isnan(metric(score, "min_separation_m"))


# --------------------------------------------------------------------------------------------- outcomes


@pytest.mark.parametrize(
    ("failed", "hit", "reached", "holding", "outcome"),
    [
        (True, True, True, True, Outcome.FAILED),
        (True, False, False, False, Outcome.FAILED),
        (False, True, True, True, Outcome.COLLIDED),
        (False, True, False, False, Outcome.COLLIDED),
        (False, False, True, True, Outcome.REACHED),
        (False, False, False, True, Outcome.HELD),
        (False, False, False, False, Outcome.TIMEOUT),
    ],
)
def test_outcomes_are_decided_in_their_order(
    failed: bool, hit: bool, reached: bool, holding: bool, outcome: Outcome
) -> None:
    """Failed, collided, then the rest. A failed run has no metrics; it is never safe."""
    score = judged(
        lambda _: np.zeros((4, 3)),
        until_s=15.0,
        shapes=[Sphere((20.0, 3.0 if hit else 50.0, 0.0), 1.0)],
        flight={
            "failed": np.array([failed]),
            "reached": np.array([reached]),
            "holding": np.array([holding]),
            "finish_time_s": np.array([15.0 if reached else np.nan]),
        },
    )
    assert score.outcome == (outcome,)
    assert score.joint_success.tolist() == [outcome is Outcome.REACHED]
    assert score.finished.tolist() == [reached and not failed]
    assert list(score.metrics) == list(METRICS)
    if failed:
        assert all(np.isnan(score.metrics[name]).all() for name in METRICS)
    else:
        assert np.isnan(metric(score, "finish_time_s")) == (not reached)


@pytest.mark.parametrize(
    ("waited_s", "holding", "reason", "words"),
    [
        (38.1, False, Reason.NONE, ""),
        (38.3, False, Reason.NONE, DELAYED),
        (38.3, False, Reason.WAITING, REASON_WORDS[Reason.WAITING]),
        (38.3, True, Reason.NONE, ""),  # not on its way, and its planner does not say why
        (38.3, True, Reason.NAVIGATION, REASON_WORDS[Reason.NAVIGATION]),
    ],
)
def test_a_late_run_that_would_have_arrived_but_for_its_waits_says_so(
    waited_s: float, holding: bool, reason: Reason, words: str
) -> None:
    """After 15 s at 2 m/s the last UAV, 6.4 m behind the middle, has 76.4 m left: 38.2 s."""
    score = judged(
        lambda _: np.zeros((4, 3)),
        until_s=15.0,
        flight={
            "reached": np.array([False]),
            "finish_time_s": np.array([np.nan]),
            "waited_s": np.array([waited_s]),
            "holding": np.array([holding]),
            "reason": np.array([reason], dtype=np.int8),
        },
    )
    assert score.outcome == (Outcome.HELD if holding else Outcome.TIMEOUT,)
    assert score.reason == (words,)
    assert metric(score, "waited_s") == waited_s


def test_runs_that_are_over_are_not_judged_further() -> None:
    """Three runs fly into a ball; the second is over."""
    score = judged(
        lambda _: np.zeros((4, 3)),
        runs=3, active=[True, False, True], until_s=15.0, shapes=[Sphere((20.0, 3.0, 0.0), 1.0)],
    )  # fmt: skip
    assert score.obstacle_contact[:, 0].tolist() == [True, False, True]
    assert np.isnan(score.metrics["path_rms_m"][1])
    assert score.metrics["control_effort"][1] == 0.0
    assert score.runs.tolist() == [0, 1, 2]
    assert len(score.outcome) == 3


def test_the_judge_looks_at_truth_and_not_at_the_estimate() -> None:
    """Estimates far out or in a solid change what is said of the estimates, and nothing else."""
    ball: list[Shape] = [Sphere((20.0, 12.0, 0.0), 1.0)]
    plain = judged(lambda _: np.zeros((4, 3)), shapes=ball, until_s=20.0)
    astray = judged(
        lambda _: np.zeros((4, 3)), shapes=ball, until_s=20.0, nav_error=lambda _: ONE_OF_FOUR * 9.0
    )
    assert plain.outcome == astray.outcome
    for name in METRICS:
        if name != "shape_floor_m" and not name.startswith("within_k_sigma"):
            np.testing.assert_array_equal(plain.metrics[name], astray.metrics[name], err_msg=name)
    assert metric(astray, "shape_floor_m") == pytest.approx(9.0 * math.sqrt(3.0) * math.sqrt(3.0) / 4.0)
    for axis in ("east", "north", "up"):  # one UAV of four is nine sigma away
        assert metric(plain, f"within_k_sigma_{axis}") == 1.0
        assert metric(astray, f"within_k_sigma_{axis}") == 0.75
