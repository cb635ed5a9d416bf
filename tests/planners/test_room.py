"""Room outwards: how far from its lane a UAV could still pass what it passes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame
from napf_mpc.planners.guide_clearance import frame_of
from napf_mpc.planners.room import STEP_M, room_outwards
from napf_mpc.planners.taut import Clearance
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Shape, Sphere

Array = NDArray[np.float64]

STATIONS, RADIUS, SIGMA, K = 49, 0.3, 0.5, 3.0
NEED = RADIUS + K * SIGMA
PATH = PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0)


def room(left: float, up: float, shapes: list[Shape], most_m: float = 4.0, lane: float = 3.0) -> Array:
    """Of one UAV that starts at 0, with the same offset everywhere."""
    return room_outwards(
        np.tile([left, up], (1, 1, STATIONS, 1)), np.zeros((1, 1)), 1.0, np.array([[lane, 0.0]]),
        frame_of(PATH), ObstacleSet.from_shapes(shapes), SIGMA**2 * np.eye(3)[None, None],
        Clearance(K, RADIUS, 0.4, 10.0), most_m,
    )[0, 0]  # fmt: skip


def test_with_nothing_there_is_all_the_room_that_was_looked_for() -> None:
    np.testing.assert_array_equal(room(1.0, 0.5, [Sphere((24.0, -40.0, 0.0), 1.0)]), 4.0)


def test_it_ends_at_the_margin_of_what_is_farther_out() -> None:
    """A wall to the left, its face 7 m from the path, 4 m from the lane; the margin is 2.2 m."""
    wall = Box((24.0, 9.0, 0.0), (200.0, 4.0, 100.0))
    there = room(0.5, 0.0, [wall])
    free = 4.0 - NEED - 0.4
    assert (there <= free).all()
    assert (there > free - STEP_M).all()
    # The same wall is no matter to who goes the other way, nor beyond what is asked about.
    np.testing.assert_array_equal(room(-0.5, 0.0, [wall]), 4.0)
    np.testing.assert_array_equal(room(0.5, 0.0, [wall], most_m=1.25), 1.25)
    np.testing.assert_array_equal(room(1.5, 0.0, [wall], most_m=1.75), 1.75)


def test_what_is_passed_lies_inwards_and_takes_no_room() -> None:
    ball = Sphere((24.0, 3.0 - 1.0, 0.0), 1.0)
    np.testing.assert_array_equal(room(2.5, 0.0, [ball]), 4.0)


@pytest.mark.parametrize(("offset", "expected"), [(0.0, 0.0), (6.0, 6.0)])
def test_on_the_lane_there_is_no_direction_and_beyond_what_is_looked_for_the_offset_is_kept(
    offset: float, expected: float
) -> None:
    np.testing.assert_array_equal(room(offset, 0.0, []), expected)


def test_where_nobody_looks_for_room_asking_for_it_is_an_error() -> None:
    room, kalman = "planner.cohesion_room_m=3", 'navigation.filter="kalman"'
    with pytest.raises(ProblemError, match=r'cohesion_room_m = 3 is looked for by guidance.*"blended"'):
        load_problem("study_8s", [room, kalman, 'planner.guidance="none"'])
    with pytest.raises(ProblemError, match=r'cohesion_room_m = 3 is for ways behind a filter.*"kalman"'):
        load_problem("study_8s", [room])
    assert load_problem("study_8s", [room, kalman]).planner.room_m == 3.0


def test_by_default_room_is_asked_for_and_problems_that_have_none_to_look_for_are_sound() -> None:
    for settings in ([], ['planner.guidance="none"'], ['navigation.filter="kalman"']):
        assert load_problem("study_8s", settings).planner.room_m == 3.0
    assert load_problem("study_8s", ["planner.cohesion_room_m=0"]).planner.room_m == 0.0
