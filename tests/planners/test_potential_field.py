"""APF and NAPF stepped alone, from navigation solutions made by hand: no simulator, no truth."""

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.apf import repulsion
from napf_mpc.errors import ProblemError
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.guided_field import GuidedNapfPlanner
from napf_mpc.planners.planner import Command, Reason
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner, PotentialFieldPlanner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Sphere

Array = NDArray[np.float64]

SLOTS = np.array([(6.403, 3.0, 0.0), (-6.403, -3.0, 0.0), (3.0, -6.403, 0.0), (-3.0, 6.403, 0.0)])


def problem(**sections: Any) -> Problem:
    given: dict[str, Any] = {
        "vehicle": {"radius_m": 0.0},
        "formation": {"shape": "square"},
        "mission": {"kind": "formation", "length_m": 100.0},
        "world": {"kind": "empty"},
    }
    return Problem.model_validate(given | sections)


def solution(position: Any, sigma: float = 0.5, **changes: Any) -> NavSolution:
    """Solution of UAVs at given places (run, uav, 3), at rest and level."""
    places = np.array(position, dtype=float)
    shape = places.shape[:2]
    covariance = np.zeros((*shape, 6, 6))
    covariance[..., [0, 1, 2], [0, 1, 2]] = sigma**2
    arrays: dict[str, Any] = {
        "available": np.ones(shape, dtype=bool),
        "position": places,
        "velocity": np.zeros((*shape, 3)),
        "attitude": np.zeros((*shape, 3)),
        "body_rates": np.zeros((*shape, 3)),
        "covariance": covariance,
        "common_factor": np.zeros((*shape, 3, 1)),
    }
    return NavSolution(time_s=0.0, **(arrays | changes))


def same_bits(a: Command, b: Command) -> None:
    for field in fields(Command):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def finite(command: Command) -> bool:
    given = [getattr(command, field.name) for field in fields(Command)]
    return all(np.isfinite(values).all() for values in given if values is not None)


def crowd(seed: int, runs: int, far_m: float = 60.0) -> tuple[ObstacleSet, NavSolution]:
    """Random places among spheres, one scene a run, with correlated covariances."""
    rng = np.random.default_rng(seed)
    scenes = ObstacleSet.from_spheres(
        rng.uniform((0.0, -10.0, -2.0), (far_m, 10.0, 2.0), (runs, 25, 3)), rng.uniform(0.5, 2.0, (runs, 25))
    )
    centre = rng.uniform(0.0, far_m, (runs, 1, 1)) * np.array([1.0, 0.0, 0.0])
    nav = solution(centre + SLOTS + rng.normal(0.0, 2.0, (runs, 4, 3)))
    root = rng.normal(0.0, 1.0, (runs, 4, 3, 3))
    nav.covariance[..., :3, :3] = root @ np.swapaxes(root, -1, -2)
    return scenes, nav


# ----------------------------------------------------------------------------------- formation motion


def test_without_obstacles_it_is_formation_motion() -> None:
    """In their slots: own lane, 2 m/s along the path, nothing held."""
    planner = NapfPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    command = planner.step(solution([SLOTS + np.array([20.0, 0.0, 0.0])]), 0.0)
    np.testing.assert_allclose(command.velocity[0], np.tile((2.0, 0.0, 0.0), (4, 1)), atol=1e-3)
    np.testing.assert_allclose(command.position[0, :, 1], [3.0, -3.0, -6.403, 6.403], atol=1e-3)
    np.testing.assert_array_equal(command.position[0, :, 2], np.zeros(4))
    np.testing.assert_array_equal(command.direction[0], np.tile((1.0, 0.0, 0.0), (4, 1)))
    assert not command.holding.any()
    assert (command.feedforward == 0.0).all()


def test_one_that_is_ahead_is_slowed_and_bounds_hold() -> None:
    planner = ApfPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    ahead = SLOTS + np.array([(2.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    speed = planner.step(solution([ahead]), 0.0).velocity[0, :, 0]
    np.testing.assert_allclose(speed, [2.0 - 0.75, 2.25, 2.25, 2.25], atol=1e-3)
    far = SLOTS + np.array([(99.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    np.testing.assert_allclose(planner.step(solution([far]), 0.0).velocity[0, :, 0], [0.4, 3.0, 3.0, 3.0])


@pytest.mark.parametrize("count", [1, 2, 13])
def test_any_number_of_uavs(count: int) -> None:
    planner = NapfPlanner(problem(formation={"shape": "circle", "count": count}))
    planner.reset(ObstacleSet.from_shapes([Sphere((5.0, 0.0, 0.0), 1.0)]), 2)
    command = planner.step(solution(np.random.default_rng(1).normal(0.0, 5.0, (2, count, 3))), 0.0)
    assert command.velocity.shape == (2, count, 3)
    assert finite(command)


# ------------------------------------------------------------------------------------------ avoidance


def lone(kind: type[PotentialFieldPlanner] = ApfPlanner, **planner: Any) -> PotentialFieldPlanner:
    """One UAV on the x axis, heading east."""
    made = kind(problem(formation={"shape": "line", "count": 1}, planner=planner))
    assert isinstance(made, PotentialFieldPlanner)
    return made


def test_inside_the_range_it_turns_away_and_the_path_point_follows() -> None:
    """2 m abreast of a ball: 0.625 m/s to the side on 2 m/s ahead, and the lane is let go."""
    planner = lone()
    planner.reset(ObstacleSet.from_shapes([Sphere((10.0, 3.0, 0.0), 1.0)]), 1)
    command = planner.step(solution([[(10.0, 0.0, 0.0)]]), 0.0)
    np.testing.assert_allclose(command.velocity[0, 0], (2.0, -0.625, 0.0), atol=1e-12)
    np.testing.assert_array_equal(command.position[0, 0], (10.0, 0.0, 0.0))
    past = planner.step(solution([[(14.0, -0.5, 0.0)]]), 0.0)
    np.testing.assert_allclose(past.velocity[0, 0], (2.0, 0.0, 0.0))
    np.testing.assert_array_equal(past.position[0, 0], (0.0, 0.0, 0.0))  # back to the lane


def test_its_body_counts() -> None:
    """The distance is that of the hull: a UAV of 0.5 m feels the ball 0.5 m earlier."""
    body = problem(formation={"shape": "line", "count": 1}, vehicle={"radius_m": 0.5})
    planner = ApfPlanner(body)
    planner.reset(ObstacleSet.from_shapes([Sphere((10.0, 3.0, 0.0), 1.0)]), 1)
    command = planner.step(solution([[(10.0, -0.5, 0.0)]]), 0.0)
    np.testing.assert_allclose(command.velocity[0, 0], (2.0, -0.625, 0.0), atol=1e-12)


def test_direction_stays_within_the_limit_and_speed_under_its_cap() -> None:
    scenes, nav = crowd(3, 50)
    planner = NapfPlanner(problem())
    planner.reset(scenes, 50)
    command = planner.step(nav, 0.0)
    assert np.linalg.norm(command.velocity, axis=-1).max() <= 3.0 + 1e-12
    assert command.direction[..., 0].min() >= math.cos(math.radians(60.0)) - 1e-9
    np.testing.assert_allclose(np.linalg.norm(command.direction, axis=-1), 1.0)
    # Both limits bind somewhere.
    assert (command.direction[..., 0] < 0.5 + 1e-9).any()
    assert (np.linalg.norm(command.velocity, axis=-1) > 3.0 - 1e-9).any()


def test_contact_and_concentric_places_give_finite_commands() -> None:
    planner = lone()
    planner.reset(ObstacleSet.from_shapes([Sphere((10.0, 0.0, 0.0), 1.0), Cylinder((20.0, 0.0), 1.0)]), 1)
    for x in (9.0, 9.5, 10.0, 11.0, 20.0, 20.0 + 1e-12):
        command = planner.step(solution([[(x, 0.0, 0.0)]]), 0.0)
        assert finite(command)
        assert np.linalg.norm(command.velocity) == pytest.approx(3.0)


def test_turning_the_world_turns_the_command() -> None:
    quarter = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    scenes, nav = crowd(4, 20)
    here = NapfPlanner(problem())
    here.reset(scenes, 20)
    a = here.step(nav, 0.0)
    north = problem(mission={"kind": "formation", "length_m": 100.0, "heading_deg": 90.0})
    there = NapfPlanner(north)
    turned_scenes = ObstacleSet.stack(
        [
            ObstacleSet.from_shapes(
                [Sphere(tuple(quarter @ s.centre_m), s.radius_m) for s in scenes.shapes(r)]
            )
            for r in range(20)
        ]
    )
    there.reset(turned_scenes, 20)
    covariance = np.zeros_like(nav.covariance)
    covariance[..., :3, :3] = quarter @ nav.position_covariance @ quarter.T
    b = there.step(replace(nav, position=nav.position @ quarter.T, covariance=covariance), 0.0)
    np.testing.assert_allclose(b.velocity, a.velocity @ quarter.T, atol=1e-9)
    np.testing.assert_allclose(b.position, a.position @ quarter.T, atol=1e-9)
    np.testing.assert_allclose(b.yaw, a.yaw + math.pi / 2.0)


# ------------------------------------------------------------------------------------- the two readings


@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.4, 1.7])
def test_shift_answers_as_if_the_ball_were_larger_by_k_sigma(sigma: float) -> None:
    """Abreast of a ball, 5 m from its surface, k = 3: the push is that at 5 - 3 sigma."""
    planner = lone(NapfPlanner, k=3.0)
    planner.reset(ObstacleSet.from_shapes([Sphere((10.0, 6.0, 0.0), 1.0)]), 1)
    velocity = planner.step(solution([[(10.0, 0.0, 0.0)]], sigma), 0.0).velocity[0, 0]
    left = np.array(5.0 - 3.0 * sigma)
    push = float(repulsion(left, 15.0, 3.0, 0.1))
    expected = np.array([2.0, -push, 0.0])
    expected *= min(1.0, 3.0 / np.linalg.norm(expected))
    if push <= 2.0 * math.tan(math.radians(60.0)):
        np.testing.assert_allclose(velocity, expected, atol=1e-12)
    else:
        np.testing.assert_allclose(velocity, 3.0 * np.array([0.5, -math.sqrt(0.75), 0.0]), atol=1e-12)
    assert (velocity[1] < 0.0) == (sigma > 2.0 / 3.0)


def test_range_only_answers_earlier() -> None:
    """Sigma 1 m: rho_0 = 6 m, so 15 (1/5 - 1/6) / 25 = 0.02 m/s; shifted to 2 m it is 0.625 m/s."""
    ball = ObstacleSet.from_shapes([Sphere((10.0, 6.0, 0.0), 1.0)])
    sideways = {}
    for inflation in ("shift", "range"):
        planner = lone(NapfPlanner, k=3.0, inflation=inflation)
        planner.reset(ball, 1)
        sideways[inflation] = planner.step(solution([[(10.0, 0.0, 0.0)]], 1.0), 0.0).velocity[0, 0, 1]
    assert sideways["range"] == pytest.approx(-0.02, abs=1e-12)
    assert sideways["shift"] == pytest.approx(-0.625, abs=1e-12)


def test_apf_does_not_look_at_the_reported_sigma() -> None:
    scenes, nav = crowd(5, 30)
    commands = []
    for scale in (0.01, 1.0, 100.0):
        planner = ApfPlanner(problem())
        planner.reset(scenes, 30)
        commands.append(planner.step(replace(nav, covariance=scale * nav.covariance), 0.0))
    same_bits(commands[0], commands[1])
    same_bits(commands[0], commands[2])


@pytest.mark.parametrize("inflation", ["shift", "range"])
@pytest.mark.parametrize("sigma", ["directional", "largest", "rms"])
def test_napf_with_k_of_zero_is_apf_bit_by_bit(inflation: str, sigma: str) -> None:
    scenes, nav = crowd(6, 30)
    napf = NapfPlanner(problem(planner={"k": 0.0, "inflation": inflation, "sigma": sigma}))
    apf = ApfPlanner(problem())
    for planner in (napf, apf):
        planner.reset(scenes, 30)
    same_bits(napf.step(nav, 0.0), apf.step(nav, 0.0))


def test_napf_flies_what_it_is_told_about_sigma() -> None:
    """More reported sigma, more UAVs that avoid: in range of 25 balls each."""
    scenes, nav = crowd(7, 40)
    avoiding = []
    for scale in (0.0001, 0.1, 1.0, 4.0):
        planner = NapfPlanner(problem(planner={"k": 3.0}))
        planner.reset(scenes, 40)
        command = planner.step(replace(nav, covariance=scale * nav.covariance), 0.0)
        avoiding.append(int((np.abs(command.velocity[..., 1:]).sum(-1) > 0.0).sum()))
    assert avoiding == sorted(avoiding)
    assert avoiding[0] < avoiding[-1]


# --------------------------------------------------------------------------------- independence of runs


@pytest.mark.parametrize("kind", [ApfPlanner, NapfPlanner])
@pytest.mark.parametrize("sigma", ["directional", "largest", "rms"])
def test_a_run_gets_the_same_bits_alone_and_in_company(kind: type, sigma: str) -> None:
    runs = 16
    scenes, nav = crowd(8, runs)
    together = kind(problem(planner={"k": 1.7, "sigma": sigma}))
    together.reset(scenes, runs)
    all_runs = together.step(nav, 0.0)
    for run in range(runs):
        alone = kind(problem(planner={"k": 1.7, "sigma": sigma}))
        alone.reset(scenes.scene(run), 1)
        of_run = [getattr(nav, field.name) for field in fields(NavSolution)[1:]]
        part = NavSolution(
            0.0, *(each[run : run + 1] if isinstance(each, np.ndarray) else each for each in of_run)
        )
        command = alone.step(part, 0.0)
        for field in fields(Command):
            mine, theirs = getattr(command, field.name), getattr(all_runs, field.name)
            if not isinstance(mine, np.ndarray):
                assert mine == theirs
            else:
                np.testing.assert_array_equal(mine[0], theirs[run], err_msg=field.name)


def test_a_planner_leaves_what_it_was_given_alone() -> None:
    scenes, nav = crowd(9, 5)
    nav.available[2, 1] = False
    before = {field.name: np.copy(getattr(nav, field.name)) for field in fields(NavSolution)}
    for kind in (ApfPlanner, NapfPlanner):
        planner = kind(problem())
        planner.reset(scenes, 5)
        planner.step(nav, 0.0)
        planner.step(nav, 0.1)
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(nav, name), values, err_msg=name)


def test_reset_forgets_the_last_flight() -> None:
    scenes, nav = crowd(10, 3)
    used, fresh = NapfPlanner(problem()), NapfPlanner(problem())
    used.reset(scenes, 3)
    used.step(nav, 0.0)
    lost = replace(nav, position=np.full_like(nav.position, np.nan))
    for planner in (used, fresh):
        planner.reset(scenes, 3)
    same_bits(used.step(lost, 0.0), fresh.step(lost, 0.0))


# ------------------------------------------------------------------------- navigation not to be trusted


def spoil(nav: NavSolution, how: str, run: int, uav: int) -> NavSolution:
    """Make the solution of one UAV one that is not to be trusted."""
    arrays = {
        name: np.copy(getattr(nav, name))
        for name in ("available", "position", "velocity", "attitude", "body_rates", "covariance")
    }
    at = (run, uav)
    match how:
        case "no fix":
            arrays["available"][at] = False
        case "position NaN" | "velocity NaN" | "attitude NaN" | "body_rates NaN":
            arrays[how.split()[0]][at] = np.nan
        case "position infinite":
            arrays["position"][at] = np.inf
        case "far away without a fix":
            arrays["position"][at] = 1e300
            arrays["available"][at] = False
        case "sigma zero":
            arrays["covariance"][at][..., 0, 0] = 0.0
        case "sigma negative":
            arrays["covariance"][at][..., 2, 2] = -1.0
        case "sigma NaN":
            arrays["covariance"][at][..., 1, 1] = np.nan
        case "all lost":
            for values in arrays.values():
                values[at] = False if values.dtype == bool else np.nan
    return replace(nav, **arrays)


BAD = [
    "no fix",
    "position NaN",
    "position infinite",
    "far away without a fix",
    "velocity NaN",
    "attitude NaN",
    "body_rates NaN",
    "sigma zero",
    "sigma negative",
    "sigma NaN",
    "all lost",
]


@pytest.mark.parametrize("kind", [ApfPlanner, NapfPlanner])
@pytest.mark.parametrize("how", BAD)
def test_without_navigation_to_trust_a_uav_holds_its_last_place(
    kind: type[PotentialFieldPlanner], how: str
) -> None:
    """And nobody else notices: not the other UAVs by a NaN in u_c, not the other runs at all."""
    scenes, nav = crowd(11, 3)
    planner, undisturbed = kind(problem()), kind(problem())
    for each in (planner, undisturbed):
        each.reset(scenes, 3)
        each.step(nav, 0.0)
    good = undisturbed.step(nav, 0.1)
    command = planner.step(spoil(nav, how, 1, 2), 0.1)
    assert finite(command)
    expected = np.zeros((3, 4), dtype=bool)
    expected[1, 2] = True
    np.testing.assert_array_equal(command.holding, expected)
    np.testing.assert_array_equal(command.position[1, 2], nav.position[1, 2])
    np.testing.assert_array_equal(command.velocity[1, 2], np.zeros(3))
    np.testing.assert_array_equal(command.direction[1, 2], np.zeros(3))
    # It stood still for a tenth of a second: for the others nothing has changed.
    for name in ("position", "velocity", "direction", "yaw"):
        a, b = getattr(command, name), getattr(good, name)
        np.testing.assert_array_equal(a[~expected], b[~expected], err_msg=name)


def test_who_holds_stays_where_it_was_and_the_others_wait_for_it() -> None:
    """30 steps without a fix, while the carried position runs away: the place to hold does not move."""
    planner = ApfPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    start = SLOTS + np.array([40.0, 0.0, 0.0])
    planner.step(solution([start]), 0.0)
    for step in range(1, 31):
        places = start + np.array([0.2 * step, 0.0, 0.0])
        nav = spoil(solution([places]), "no fix", 0, 3)
        command = planner.step(nav, 0.1 * step)
        assert command.holding.tolist() == [[False, False, False, True]]
        np.testing.assert_array_equal(command.position[0, 3], start[3])
    # Three are 6 m ahead of the one that holds: ef = 1.5 m, 2 - 0.75 m/s.
    np.testing.assert_allclose(command.velocity[0, :3, 0], 1.25, atol=2e-3)
    # Back with a fix, it flies on from there.
    again = planner.step(
        solution([start + np.array([(6.0, 0, 0), (6.0, 0, 0), (6.0, 0, 0), (0, 0, 0)])]), 3.1
    )
    assert not again.holding.any()
    assert again.velocity[0, 3, 0] == pytest.approx(3.0)


@pytest.mark.parametrize("make", [NapfPlanner, GuidedNapfPlanner])
def test_a_formation_waits_for_a_uav_in_dispute_but_others_do_not(make: type[PotentialFieldPlanner]) -> None:
    nav = solution(np.stack([SLOTS, SLOTS]))
    disputed = np.zeros((2, 4), dtype=bool)
    disputed[0, 2] = True
    planner = make(problem())
    planner.reset(ObstacleSet.empty(), 2)
    command = planner.step(replace(nav, available=~disputed, disputed=disputed), 0.0)
    assert command.holding.tolist() == [[True] * 4, [False] * 4]
    assert command.reason is not None
    waits, none, lost = Reason.WAITING, Reason.NONE, Reason.NAVIGATION
    assert command.reason.tolist() == [[waits, waits, lost, waits], [none] * 4]
    assert (command.velocity[0] == 0.0).all()
    assert (np.linalg.norm(command.velocity[1], axis=-1) > 1.0).all()
    # Without a dispute, one that is not available holds alone.
    planner.reset(ObstacleSet.empty(), 2)
    alone = planner.step(replace(nav, available=~disputed), 0.0)
    assert alone.holding.sum() == 1
    assert alone.reason is not None
    assert alone.reason.tolist() == [[none, none, lost, none], [none] * 4]


def test_an_obstacle_is_not_forgotten_for_want_of_a_sigma() -> None:
    """2 m from a ball with sigma reported as zero or NaN: hold, and never fly on as if nothing were there."""
    for how in ("sigma zero", "sigma NaN", "sigma negative"):
        planner = lone(NapfPlanner, k=3.0)
        planner.reset(ObstacleSet.from_shapes([Sphere((13.0, 0.0, 0.0), 1.0)]), 1)
        planner.step(solution([[(10.0, 0.0, 0.0)]]), 0.0)
        command = planner.step(spoil(solution([[(10.0, 0.0, 0.0)]]), how, 0, 0), 0.1)
        assert command.holding.all()
        np.testing.assert_array_equal(command.velocity, np.zeros((1, 1, 3)))
        np.testing.assert_array_equal(command.position, [[(10.0, 0.0, 0.0)]])


def test_never_a_solution_to_trust_is_holding_from_the_start() -> None:
    """At the first place that is a number; without one at the start of its lane."""
    planner = ApfPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    places = SLOTS + np.array([1.0, 2.0, 3.0])
    nav = spoil(spoil(solution([places]), "no fix", 0, 0), "all lost", 0, 1)
    for _ in range(3):
        command = planner.step(nav, 0.0)
        assert finite(command)
        assert command.holding.tolist() == [[True, True, False, False]]
        np.testing.assert_array_equal(command.position[0, 0], places[0])
        np.testing.assert_allclose(command.position[0, 1], (0.0, -3.0, 0.0), atol=1e-12)


# ---------------------------------------------------------------------------------------------- choice


def test_planners_by_name() -> None:
    assert make_planner("apf", problem()).name == "apf"
    napf = make_planner("napf", problem(planner={"k": 1.7, "sigma": "rms"}))
    assert isinstance(napf, NapfPlanner)
    assert napf.inflation == Inflation(1.7, "shift", "rms")
    assert make_planner("qp", problem()).name == "qp"
    for name in ("", "APF", "apf "):
        with pytest.raises(ProblemError, match="is not a planner; choose from apf, napf"):
            make_planner(name, problem())


def test_a_walk_to_a_goal_is_not_for_these_planners() -> None:
    with pytest.raises(ProblemError, match=r"mission\.kind"):
        NapfPlanner(load_problem("single_uav"))
