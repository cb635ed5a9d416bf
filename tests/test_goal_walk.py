"""A point walks to a goal: judged on the same truth as a flight."""

import numpy as np
import pytest

from napf_mpc.block import Block
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import METRICS
from napf_mpc.goal_walk import goal_mission, goal_scenes, walk_block, walk_to_goal
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import scenes_of
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Sphere

BALL = {"shape": "sphere", "radius_m": 1.0}


def walk(*obstacles: tuple[float, float], **settings: object) -> tuple[Problem, Block]:
    listed = [BALL | {"centre_m": [x, y, 0.0]} for x, y in obstacles]
    problem = load_problem("single_uav", {"world": {"kind": "list", "obstacles": listed}} | settings)
    return problem, walk_block(problem, "apf", 3, 7, goal_scenes(problem))


def test_a_free_way_is_walked_straight() -> None:
    problem, block = walk()
    assert block.rows["outcome"][0] == "reached"
    assert block.rows["joint_success"][0]
    # The walk stops within arrival_m = 0.1 m of the goal.
    length = 0.02 * (len(block.trajectories["step"]) - 1)
    assert length == pytest.approx(np.hypot(10.0, 10.0) - 0.1, abs=0.03)
    assert block.rows["path_length_ratio"][0] == pytest.approx(length / np.hypot(10.0, 10.0))
    assert np.isnan(block.rows["min_clearance_m"][0])  # nothing to be clear of
    assert goal_mission(problem).step_m == 0.02


def test_clearance_is_that_of_the_path_not_of_its_corners() -> None:
    _, block = walk((3.0, 4.2))
    points = np.column_stack([block.trajectories["x_m"], block.trajectories["y_m"]])
    sampled = np.hypot(points[:, 0] - 3.0, points[:, 1] - 4.2).min() - 1.0
    clearance = block.rows["min_clearance_m"][0]
    assert 0.0 < clearance <= sampled + 1e-7
    assert sampled - clearance < 1e-3
    assert block.rows["path_length_ratio"][0] > 1.0


def test_an_obstacle_right_in_the_way_stops_the_walk() -> None:
    _, block = walk((5.0, 5.0))
    assert block.rows["outcome"][0] == "timeout"
    assert not block.rows["finished"][0]
    assert np.isnan(block.rows["path_length_ratio"][0])
    assert 0.0 < block.rows["min_clearance_m"][0] < 3.0


def test_a_start_inside_an_obstacle_is_a_collision() -> None:
    # Such a problem is refused when its scene is built; whoever brings a scene is judged all the same.
    problem, _ = walk()
    block = walk_block(problem, "apf", 3, 7, ObstacleSet.from_shapes([Sphere((0.0, 0.3, 0.0), 1.0)]))
    assert block.rows["outcome"][0] == "collided"
    assert block.rows["uavs_hit"][0] == 1
    assert block.rows["min_clearance_m"][0] == pytest.approx(-0.7, abs=0.05)


def test_a_body_needs_more_room_than_a_point() -> None:
    _, point = walk((3.0, 4.2))
    room = float(point.rows["min_clearance_m"][0])
    _, slim = walk((3.0, 4.2), **{"vehicle.radius_m": room - 0.01})
    _, stout = walk((3.0, 4.2), **{"vehicle.radius_m": room + 0.01})
    assert (slim.rows["outcome"][0], stout.rows["outcome"][0]) == ("reached", "collided")


def test_a_start_at_the_goal_is_an_arrival_without_a_ratio() -> None:
    _, block = walk(**{"mission.goal_m": [0.0, 0.0]})
    assert block.rows["outcome"][0] == "reached"
    assert len(block.trajectories["step"]) == 1
    assert np.isnan(block.rows["path_length_ratio"][0])


def test_the_row_is_that_of_a_flight() -> None:
    _, block = walk()
    assert (block.rows["planner"][0], block.rows["run"][0], block.rows["seed"][0]) == ("apf", 7, 3)
    assert set(METRICS) <= set(block.rows)
    assert block.timing["first_run"][0] == 7
    assert not block.rows["uav_contact"][0]


def test_a_random_world_lies_along_the_way_and_changes_with_the_run() -> None:
    problem = load_problem(
        "single_uav", {"world": {"kind": "scatter", "count": 5, "along_range_m": [3.0, 11.0]}}
    )
    first, second = (scenes_of(problem, 1, range(run, run + 1)) for run in (0, 1))
    assert first.shapes() != second.shapes()
    ahead = [np.dot(shape.centre_m[:2], [1.0, 1.0]) / np.sqrt(2.0) for shape in first.shapes()]  # type: ignore[union-attr]
    assert all(3.0 <= place <= 11.0 for place in ahead)


def test_what_cannot_walk_is_refused() -> None:
    walking, flying = load_problem("single_uav"), load_problem("table1_8")
    with pytest.raises(ProblemError, match='"napf" cannot walk to a goal'):
        walk_block(walking, "napf", 0, 0, goal_scenes(walking))
    for call in (goal_mission, goal_scenes, lambda problem: walk_to_goal(problem, goal_scenes(walking))):
        with pytest.raises(ProblemError, match=r"mission\.kind"):
            call(flying)
