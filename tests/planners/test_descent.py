"""No fix: hold, then go down, and stop above what may be below; heights in metres, by all planners alike."""

from dataclasses import replace
from itertools import count
from typing import Any, cast

import numpy as np
import pytest
from navigation_faults import FaultyErrors
from numpy.typing import NDArray
from pydantic import ValidationError

from napf_mpc.closed_loop import POSITION, build_scenario, closed_loop
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import MissionScore
from napf_mpc.navigation.fix import PositionErrors
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.descent import DESCENT_MPS, Descent, ground_m
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.planners.planner import Command, Planner, tally_of
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Planner as Settings
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape, Sphere

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EVERY = ["apf", "napf", "napf_guided", "qp"]
RADIUS, SIGMA, UP, K = 0.5, 0.4, 0.2, 3.0
ASIDE, ABOVE = RADIUS + K * SIGMA, RADIUS + K * UP  # 1.7 and 1.1 m
PLACE = (10.0, 0.0, 100.0)
GROUND = {"kind": "forest", "count": 0, "ground_m": 0.0}


def problem(
    world: dict[str, Any] | None = None, uavs: int = 1, climb: float = 0.0, **planner: Any
) -> Problem:
    return Problem.model_validate(
        {
            "vehicle": {"radius_m": RADIUS},
            "formation": {"shape": "line", "count": uavs, "spacing_m": 8.0},
            "mission": {
                "kind": "formation", "length_m": 100.0, "start_m": (0.0, 0.0, 100.0), "climb_deg": climb
            },
            "world": GROUND if world is None else world,
            "planner": {"descend_after_s": 2.0} | planner,
        }
    )  # fmt: skip


def solution(places: Any = ((PLACE,),), fix: bool = True) -> NavSolution:
    """At rest and level; 0.4 m along the larger diagonal of the plane, 0.2 m up."""
    position = np.array(places, dtype=float)
    shape = position.shape[:2]
    covariance = np.zeros((*shape, 6, 6))
    larger, smaller = SIGMA**2, 0.1**2
    covariance[..., [0, 1], [0, 1]] = 0.5 * (larger + smaller)
    covariance[..., [0, 1], [1, 0]] = 0.5 * (larger - smaller)
    covariance[..., 2, 2] = UP**2
    return NavSolution(
        time_s=0.0,
        available=np.full(shape, fix),
        position=position,
        velocity=np.zeros((*shape, 3)),
        attitude=np.zeros((*shape, 3)),
        body_rates=np.zeros((*shape, 3)),
        covariance=covariance,
        common_factor=np.zeros((*shape, 3, 1)),
    )


def lost(
    planner: Planner, scenes: ObstacleSet, nav: NavSolution, until_s: float, begin: int = 0
) -> list[Command]:
    """Commands at 10 Hz: one with navigation, then without, seconds counted from its loss on."""
    runs = nav.position.shape[0]
    if begin == 0:
        planner.reset(scenes, runs)
        planner.step(replace(nav, available=np.ones_like(nav.available)), 0.0)
    return [planner.step(nav, 0.1 * n) for n in range(begin + 1, round(10.0 * until_s) + 2)]


def heights(commands: list[Command]) -> Array:
    return np.array([command.position[0, 0, 2] for command in commands])


def end(name: str, *shapes: Shape, **settings: Any) -> float:
    """Height at which a UAV hovers in the end, from 100 m down."""
    planner = make_planner(name, problem(**settings))
    last = lost(planner, ObstacleSet.from_shapes(shapes), solution(fix=False), 205.0)[-1]
    assert not last.velocity.any()
    assert last.holding.all()
    return float(last.position[0, 0, 2])


# ------------------------------------------------------------------------------------------ how it goes


@pytest.mark.parametrize("name", EVERY)
def test_it_holds_then_goes_down_at_half_a_metre_per_second(name: str) -> None:
    """Lost at 0.1 s: at 100 m until 30 s later, then 0.5 m/s, and it is counted."""
    planner = make_planner(name, problem(descend_after_s=30.0))
    commands = lost(planner, ObstacleSet.empty(), solution(fix=False), 40.0)
    held, down = commands[:300], commands[300:]  # of 0.1 s each
    assert (heights(held) == 100.0).all()
    assert not any(command.velocity.any() for command in held)
    np.testing.assert_allclose(heights(down), 99.95 - 0.05 * np.arange(len(down)), atol=1e-9)
    for command in down:
        np.testing.assert_array_equal(command.velocity, [[(0.0, 0.0, -DESCENT_MPS)]])
        np.testing.assert_array_equal(command.position[0, 0, :2], PLACE[:2])
        assert command.direction[0, 0, 2] < 0.0
        assert command.holding.all()
    tally = tally_of(planner, 1)
    assert tally.counts["fall_back_descend"][0] == len(down)
    (event,) = [event for event in tally.events if event.action == "descend"]
    assert (event.time_s, event.uav, event.cause) == (pytest.approx(30.1), 0, "navigation")


@pytest.mark.parametrize("name", EVERY)
def test_null_holds_for_ever(name: str) -> None:
    planner = make_planner(name, problem(descend_after_s=None))
    commands = lost(planner, ObstacleSet.empty(), solution(fix=False), 120.0)
    assert (heights(commands) == 100.0).all()
    assert tally_of(planner, 1).counts["fall_back_descend"][0] == 0


@pytest.mark.parametrize("name", EVERY)
def test_with_fixes_back_it_flies_on_from_where_it_is_and_the_next_hold_is_a_new_one(name: str) -> None:
    planner = make_planner(name, problem())
    low = lost(planner, ObstacleSet.empty(), solution(fix=False), 12.0)[-1].position
    assert low[0, 0, 2] == pytest.approx(95.0, abs=0.1)
    back = solution(low)
    for n in range(122, 125):
        command = planner.step(back, 0.1 * n)
    assert not command.holding.any()
    if name != "qp":  # whose position and velocity are those of its plan's first state
        assert command.velocity[0, 0, 0] > 1.0
    again = lost(planner, ObstacleSet.empty(), solution(low, fix=False), 14.4, begin=124)
    assert (heights(again[:20]) == low[0, 0, 2]).all()  # 2 s
    assert heights(again)[-1] < low[0, 0, 2]


@pytest.mark.parametrize("name", ["napf", "napf_guided"])
def test_who_waits_for_another_stays_at_its_height(name: str) -> None:
    """One UAV of three in dispute: its formation waits, it alone goes down."""
    planner = make_planner(name, problem(uavs=3))
    nav = solution([[(0.0, -8.0, 100.0), (0.0, 0.0, 100.0), (0.0, 8.0, 100.0)]])
    fine = np.array([[True, False, True]])
    nav = replace(nav, available=fine, disputed=~fine)
    command = lost(planner, ObstacleSet.empty(), nav, 10.0)[-1]
    assert command.holding.all()
    np.testing.assert_allclose(command.position[0, :, 2], [100.0, 95.95, 100.0], atol=1e-6)
    np.testing.assert_array_equal(command.velocity[0, :, 2], [0.0, -0.5, 0.0])


def test_a_uav_without_a_plan_goes_down_to_the_ground_by_its_navigation() -> None:
    """Every answer is late: the ladder ends above the ground, and stays there though estimates go on."""
    clock = count(0.0, 10.0)
    planner = QpPlanner(problem(), clock=lambda: next(clock))
    planner.reset(ObstacleSet.empty(), 1)
    height = 4.0
    for n in range(200):
        command = planner.step(solution([[(*PLACE[:2], height)]]), 0.1 * n)
        height += 0.1 * command.velocity[0, 0, 2]
    assert height == pytest.approx(ABOVE, abs=0.051)
    command = planner.step(solution([[(*PLACE[:2], height + 1.0)]]), 20.0)
    assert not command.velocity.any()
    actions = [event.action for event in planner.ladder.events]
    assert actions == ["hover", "descend", "hover"]


# -------------------------------------------------------------------------------------- where it ends


@pytest.mark.parametrize("name", EVERY)
def test_it_stops_above_the_ground(name: str) -> None:
    """Radius and 3 sigma of its height; the apf's own margin of no sigma is for who knows where it is."""
    assert end(name, world=GROUND | {"ground_m": 20.0}) == pytest.approx(20.0 + ABOVE, abs=1e-9)


@pytest.mark.parametrize("name", EVERY)
def test_it_stops_above_a_roof_below(name: str) -> None:
    roof = Box((10.0, 0.0, 20.0), (10.0, 10.0, 40.0))
    assert end(name, roof) == pytest.approx(40.0 + ABOVE, abs=1e-9)


@pytest.mark.parametrize(
    ("gap", "height"), [(ASIDE - 0.01, 40.0 + ABOVE), (ASIDE + 0.01, ABOVE)], ids=["near", "far"]
)
def test_a_roof_counts_within_radius_and_three_sigma_of_the_worst_direction(
    gap: float, height: float
) -> None:
    turned = Box((10.0, -5.0 - gap, 20.0), (30.0, 10.0, 40.0))
    assert end("napf", turned) == pytest.approx(height, abs=1e-9)
    trunk = Cylinder((10.0 + gap + 2.0, 0.0), 2.0, 0.0, 40.0)
    assert end("napf", trunk) == pytest.approx(height, abs=1e-9)
    ball = Sphere((10.0, gap + 5.0, 35.0), 5.0)
    assert end("napf", ball) == pytest.approx(height, abs=1e-9)


def test_it_stops_above_the_highest_of_many() -> None:
    balls = [Sphere((10.0, 0.0, z), 1.0) for z in (10.0, 50.0, 30.0)]
    assert end("napf", *balls) == pytest.approx(51.0 + ABOVE, abs=1e-9)


def test_beside_a_tower_it_stays_and_under_a_bridge_it_goes() -> None:
    """Within 3 sigma of a wall it may be above it, for all that it knows, or drift against it."""
    tower = Box((10.0, 6.0, 100.0), (10.0, 10.0, 200.0))  # 1 m beside
    assert end("napf", tower) == 100.0
    endless = Cylinder((10.0, 3.0), 2.0)
    assert end("napf", endless) == 100.0
    bridge = Box((10.0, 0.0, 100.0 + ABOVE + 1.1), (10.0, 10.0, 2.0))
    assert end("napf", bridge) == pytest.approx(ABOVE, abs=1e-9)


def test_the_least_height_to_fly_at_holds_for_all() -> None:
    for name in EVERY:
        assert end(name, altitude_m=(70.0, 120.0)) == pytest.approx(70.0, abs=1e-9)


def test_in_the_open_it_does_not_leave_the_lanes_downwards() -> None:
    """From 2 m above a level lane down to it; the lowest height of a path that falls is at its end."""
    empty = {"kind": "empty"}
    planner = make_planner("napf", problem(empty))
    above = lost(planner, ObstacleSet.empty(), solution([[(10.0, 0.0, 102.0)]], fix=False), 20.0)
    assert heights(above)[-1] == pytest.approx(100.0, abs=1e-9)
    assert end("napf", world=empty, climb=-30.0) == pytest.approx(50.0, abs=1e-9)
    assert end("napf", world=empty, climb=30.0) == 100.0


def test_the_ground_is_that_of_the_world() -> None:
    assert ground_m(problem(GROUND | {"ground_m": -7.0})) == -7.0
    assert ground_m(problem({"kind": "street_canyon", "ground_m": 3.0})) == 3.0
    assert ground_m(problem({"kind": "city", "file": "any.geojson"})) == 0.0
    for kind in ("empty", "lanes", "scatter"):
        assert ground_m(problem({"kind": kind})) == -np.inf


# ---------------------------------------------------------------------------------------- what it trusts


def sinks(planner: Planner, covariance_scale: float) -> float:
    nav = solution(fix=False)
    planner.reset(ObstacleSet.empty(), 1)
    planner.step(solution(), 0.0)
    worse = replace(nav, covariance=np.full_like(nav.covariance, covariance_scale) * (nav.covariance + 1e-30))
    for n in range(1, 2060):
        command = planner.step(worse, 0.1 * n)
    return float(command.position[0, 0, 2])


@pytest.mark.parametrize("name", EVERY)
def test_what_is_reported_without_a_fix_counts_as_far_as_it_is_worse(name: str) -> None:
    """Ten times the sigma: 6.5 m above ground. Less, none at all, or nonsense: that of the last fix."""
    assert sinks(make_planner(name, problem()), 100.0) == pytest.approx(RADIUS + K * 10.0 * UP)
    for scale in (0.01, 0.0, -1.0, np.nan):
        assert sinks(make_planner(name, problem()), scale) == pytest.approx(ABOVE)
    assert sinks(make_planner(name, problem()), np.inf) == 100.0


@pytest.mark.parametrize("name", EVERY)
def test_who_never_knew_where_it_is_stays(name: str) -> None:
    planner = make_planner(name, problem())
    planner.reset(ObstacleSet.empty(), 1)
    nav = solution(fix=False)
    for n in range(200):
        command = planner.step(nav, 0.1 * n)
    assert not command.velocity.any()
    assert tally_of(planner, 1).counts["fall_back_descend"][0] == 0


@pytest.mark.parametrize("name", EVERY)
def test_no_run_depends_on_its_block(name: str) -> None:
    """Towns, places and losses of their own, alone and together, to the last bit."""
    rng = np.random.default_rng(5)
    boxes = rng.uniform((0.0, -12.0, 90.0, 0.0), (20.0, 12.0, 98.0, 3.0), (3, 6, 4))
    towns = [
        ObstacleSet.from_shapes(
            [Box((x, y, 0.5 * top), (5.0, 5.0, top), turn) for x, y, top, turn in town.tolist()]
        )
        for town in boxes
    ]
    slots = np.array([(10.0, -8.0, 100.0), (10.0, 0.0, 100.0), (10.0, 8.0, 100.0)])
    places = slots + rng.uniform(0.0, 2.0, (3, 3, 3))
    available = rng.random((3, 3)) < 0.3
    nav = replace(solution(places), available=available)
    together = make_planner(name, problem(uavs=3))
    last = lost(together, ObstacleSet.stack(towns), nav, 30.0)
    fallen = tally_of(together, 3).counts["fall_back_descend"]
    ends = last[-1].position[..., 2][~available]
    assert (ends > 90.0).any()  # above a roof
    assert (ends < 88.0).any()  # beside all of them
    for run in range(3):
        alone = make_planner(name, problem(uavs=3))
        one = replace(solution(places[run : run + 1]), available=available[run : run + 1])
        mine = lost(alone, towns[run], one, 30.0)
        assert tally_of(alone, 1).counts["fall_back_descend"][0] == fallen[run]
        for a, b in zip(last, mine, strict=True):
            np.testing.assert_array_equal(a.position[run], b.position[0])
            np.testing.assert_array_equal(a.velocity[run], b.velocity[0])


def test_every_uav_has_a_hold_of_its_own() -> None:
    """2 s without a fix: one of them has had one meanwhile, and goes down 2 s after the next loss."""
    descent = Descent(problem(uavs=2))
    descent.reset(ObstacleSet.empty(), 1, 2)
    place = np.array([[PLACE, PLACE]])
    descent.note(solution(place), np.ones((1, 2), dtype=bool))
    begun = {}
    for n in range(50):
        down = descent.lower(0.1 * n, np.array([[True, n != 15]]), place)
        for uav in np.flatnonzero(down[0]).tolist():
            begun.setdefault(uav, n)
    assert begun == {0: 20, 1: 36}
    np.testing.assert_allclose(place[0, :, 2], [98.5, 99.3])


# ------------------------------------------------------------------------------------------------- key


@pytest.mark.parametrize("value", [0.0, 30.0, 1e6, None])
def test_the_key_takes_a_time_or_null(value: float | None) -> None:
    assert Settings(descend_after_s=value).descend_after_s == value
    assert Settings().descend_after_s == 30.0


@pytest.mark.parametrize(
    ("value", "words"),
    [(-1.0, "greater than or equal to 0"), (2e6, "less than or equal"), (np.nan, "finite")],
)
def test_the_key_has_limits(value: float, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Settings(descend_after_s=value)


def test_a_file_with_a_wrong_time_is_told_so() -> None:
    with pytest.raises(ProblemError, match=r"planner\.descend_after_s = -1"):
        load_problem("study_8s", ["planner.descend_after_s=-1"])
    with pytest.raises(ProblemError, match=r"planner\.descend_after_s"):
        load_problem("study_8s", ["planner.descend_after_s=never"])


# ------------------------------------------------------------------------------------------ closed loop


class Lowest:
    """True and commanded heights of the first UAV."""

    def __init__(self) -> None:
        self.true_m, self.asked_m = np.inf, np.inf

    def moved(self, time_s: float, before: Array, after: Array, active: Mask) -> None:
        self.true_m = min(self.true_m, float(after[:, 0, 4].min()))

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Mask
    ) -> None:
        self.asked_m = min(self.asked_m, float(command.position[:, 0, 2].min()))


@pytest.mark.parametrize(("kind", "start_m", "down_m"), [("kalman", 120.0, 10.0), ("none", 40.0, 10.0)])
@pytest.mark.parametrize("name", ["napf", "qp"])
def test_an_outage_of_a_minute_over_a_wood_ends_well(
    name: str, kind: str, start_m: float, down_m: float
) -> None:
    """It goes down by metres, keeps off crowns of at most 8 m and the ground, and arrives with fixes back.

    Behind a filter its sigma grows until it stops; unfiltered it comes down to 3 sigma above the crowns.
    """
    wood = load_problem(
        "study_8s",
        {
            "world": {"kind": "forest", "count": 120, "tree_height_m": (3.0, 8.0), "ground_m": 0.0},
            "mission.start_m": (0.0, 0.0, start_m),
            "mission.initial_positions_m": None,
            "navigation.filter": kind,
            "navigation.filter_coast_sigma_m": 2.0,
            "planner.descend_after_s": 5.0,
            "simulation.time_limit_s": 200.0,
        },
    )
    scenario = build_scenario(wood, 300, range(2))
    drawn = cast(PositionErrors, scenario.errors)
    faulty = FaultyErrors(drawn, "outage_69", scenario.initial_state[..., POSITION])
    scenario = replace(scenario, errors=faulty)
    judge, lowest, planner = MissionScore(wood, scenario), Lowest(), make_planner(name, wood)
    score = judge.score(closed_loop(wood, planner, scenario, [judge, lowest, faulty]))
    down = DESCENT_MPS / wood.planner.rate_hz * tally_of(planner, 2).counts["fall_back_descend"]
    assert (down > down_m).all()
    assert lowest.asked_m < start_m - down_m
    assert lowest.true_m > 8.0 + wood.vehicle.radius_m
    assert not score.obstacle_contact.any()
    assert not score.uav_contact.any()
    assert score.finished.all()


@pytest.mark.parametrize("variance", [1e300, np.inf])
def test_who_is_lost_in_the_plane_stays_however_that_is_told(variance: float) -> None:
    """Both sigmas of the plane beyond all bounds: something high stands within them, or nothing is known."""
    planner = make_planner("napf", problem())
    nav = solution(fix=False)
    covariance = nav.covariance.copy()
    covariance[..., [0, 1], [0, 1]] = variance
    roof = ObstacleSet.from_shapes([Box((10.0, 15.0, 40.0), (4.0, 4.0, 80.0))])
    commands = lost(planner, roof, replace(nav, covariance=covariance), 205.0)
    assert heights(commands)[-1] >= 80.0


def test_the_timer_of_who_was_lost_and_then_had_no_plan_goes_on() -> None:
    """Due while its sigma was infinite, and then it is known where it is: it goes down after all."""
    descent = Descent(problem())
    descent.reset(ObstacleSet.empty(), 1, 1)
    place, holds = np.array([[PLACE]]), np.ones((1, 1), dtype=bool)
    for n in range(50):  # never trusted so far
        assert not descent.lower(0.1 * n, holds, place).any()
    descent.note(solution(), holds)
    assert descent.lower(5.0, holds, place).all()


@pytest.mark.parametrize("name", ["napf", "qp"])
def test_without_a_level_nobody_goes_down(name: str) -> None:
    """The last level held over a roof; the fix without one is 40 m aside, over the street, or so it says."""
    settings = problem(safety="protection_level").model_dump(mode="python")
    settings["navigation"] = {"kind": "gnss", "integrity": "araim"}
    planner = make_planner(name, Problem.model_validate(settings))
    roof = ObstacleSet.from_shapes([Box((10.0, 0.0, 20.0), (10.0, 10.0, 40.0))])
    known = replace(solution(), protection=np.full((1, 1, 2), 2.0))
    planner.reset(roof, 1)
    planner.step(known, 0.0)
    aside = replace(solution([[(50.0, 0.0, 100.0)]]), protection=np.full((1, 1, 2), np.nan))
    commands = [planner.step(aside, 0.1 * n) for n in range(1, 500)]
    assert (heights(commands) == 100.0).all()
