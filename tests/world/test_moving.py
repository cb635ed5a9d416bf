"""Moving obstacles: where they truly are, how they are drawn from streams, and the verdicts on a flight."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.problem import EmptyWorld, World
from napf_mpc.world.moving import MovingObstacles, moving_obstacles, round_distance
from napf_mpc.world.moving_sweep import MovingClearance
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Sphere
from napf_mpc.world.sweep import SweptClearance

Array = NDArray[np.float64]

BALL = {"shape": "sphere", "start_m": (1.0, 2.0, 3.0), "velocity_mps": (0.5, -1.0, 0.25), "radius_m": 1.0}
MAST = {"shape": "cylinder", "start_m": (4.0, 0.0), "velocity_mps": (0.0, 2.0), "radius_m": 0.5}


def world(*items: dict[str, Any], **keys: Any) -> World:
    return EmptyWorld.model_validate({"kind": "empty", "moving": items, **keys})


def built(*items: dict[str, Any], seed: int = 1, runs: range = range(1), duration_s: float = 20.0) -> Any:
    return moving_obstacles(world(*items), seed, runs, duration_s)


def at_rest(centre: tuple[float, float, float], radius: float, upright: bool = False) -> MovingObstacles:
    shape = "cylinder" if upright else "sphere"
    axes = 2 if upright else 3
    item = {"shape": shape, "start_m": centre[:axes], "velocity_mps": (0.0,) * axes, "radius_m": radius}
    return built(item)  # type: ignore[no-any-return]


def test_a_world_without_any_has_none() -> None:
    assert moving_obstacles(world(), 1, range(3), 10.0) is None


def test_without_acceleration_they_move_evenly_and_straight() -> None:
    moving = built(BALL, MAST, runs=range(4, 6))
    assert (moving.count, moving.runs) == (2, 2)
    for time in (-2.0, 0.0, 0.3, 7.77, 20.0, 500.0):
        expected = [[1.0 + 0.5 * time, 2.0 - time, 3.0 + 0.25 * time], [4.0, 2.0 * time, 0.0]]
        np.testing.assert_array_equal(moving.position(time), [expected, expected])


def test_acceleration_adds_up_to_the_velocity_and_the_way() -> None:
    """Against a sum over steps of 1 ms, to a micrometre."""
    moving = built(BALL | {"acceleration_sigma_mps2": 0.8}, duration_s=6.0)
    place, velocity, step = np.array(BALL["start_m"]), np.array(BALL["velocity_mps"]), 1e-3
    for i in range(6000):
        if i % 1500 == 700:
            np.testing.assert_allclose(moving.position(i * step)[0, 0], place, rtol=0.0, atol=1e-6)
        held = moving.acceleration[0, 0, i // 1000]
        place = place + velocity * step + 0.5 * held * step**2
        velocity = velocity + held * step
    before = built(BALL).position(-1.0)
    np.testing.assert_array_equal(moving.position(-1.0), before)


def test_the_path_is_continuous_where_the_acceleration_changes() -> None:
    moving = built(MAST | {"acceleration_sigma_mps2": 2.0})
    for second in (1.0, 2.0, 9.0):
        before, after = moving.position(second - 1e-9), moving.position(second + 1e-9)
        np.testing.assert_allclose(before, after, rtol=0.0, atol=1e-7)
    np.testing.assert_array_equal(moving.position(9.5)[..., 2], 0.0)


def test_the_wandering_has_the_sigma_that_was_asked_for() -> None:
    """After T whole seconds sigma of the velocity is s sqrt(T), of 2000 x 3 drawn; within 3 %."""
    moving = built(BALL | {"acceleration_sigma_mps2": 0.5}, runs=range(2000), duration_s=9.0)
    gained = (moving.position(9.0) - moving.position(9.0 - 1e-4)) / 1e-4 - np.array(BALL["velocity_mps"])
    assert abs(gained.std() / (0.5 * 3.0) - 1.0) < 0.03


def test_first_seconds_runs_and_obstacles_do_not_change_with_the_total() -> None:
    wild = BALL | {"acceleration_sigma_mps2": 0.5}
    small = built(wild, runs=range(2, 4), duration_s=5.0)
    large = built(wild, MAST | {"acceleration_sigma_mps2": 1.0}, runs=range(1, 9), duration_s=60.0)
    for time in (0.0, 1.3, 4.9):
        np.testing.assert_array_equal(large.position(time)[1:3, :1], small.position(time))
    other = built(wild, seed=2, runs=range(2, 4), duration_s=5.0)
    assert (other.acceleration != small.acceleration).all()
    np.testing.assert_array_equal(large.of_run(3).position(7.7), large.position(7.7)[3:4])


@pytest.mark.parametrize("upright", [False, True])
def test_distances_are_those_of_obstacles_that_stand(upright: bool) -> None:
    """Signed distance and gradient, inside, outside and at the centre, to 1e-9 m."""
    centre, radius = (3.0, -1.0, 2.0), 1.5
    shape = Cylinder(centre[:2], radius) if upright else Sphere(centre, radius)
    points = np.random.default_rng(3).uniform(-3.0, 6.0, (1, 300, 3))
    points[0, 0], points[0, 1] = centre, (3.0, -1.0, 7.0)
    distance, normal = round_distance(points, np.array(centre), np.array(radius), np.array(upright))
    there, gradient, _ = ObstacleSet.from_shapes([shape]).nearest(points)
    np.testing.assert_allclose(distance, there, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(normal, gradient, rtol=0.0, atol=1e-9)


# ----------------------------------------------------------------------------------------- verdicts


def swept(moving: MovingObstacles, path: Array, step_s: float) -> MovingClearance:
    """Verdict on a single UAV's path (t, 3) at even steps from time 0 on."""
    judge = MovingClearance(moving, 1, 1)
    for i in range(len(path) - 1):
        judge.update(i * step_s, (i + 1) * step_s, path[None, i : i + 1], path[None, i + 1 : i + 2])
    return judge


@pytest.mark.parametrize("upright", [False, True])
def test_at_rest_the_verdict_is_that_of_an_obstacle_that_stands(upright: bool) -> None:
    centre, radius = (3.0, 0.2, 0.1), 0.7
    path = np.cumsum(np.random.default_rng(5).normal([0.02, 0.0, 0.0], 0.02, (400, 3)), axis=0)
    shape = Cylinder(centre[:2], radius) if upright else Sphere(centre, radius)
    static = SweptClearance(ObstacleSet.from_shapes([shape]), 1, 1)
    for start, stop in pairwise(path):
        static.update(start[None, None], stop[None, None])
    judge = swept(at_rest(centre, radius, upright), path, 0.02)
    np.testing.assert_allclose(judge.clearance, static.clearance, rtol=0.0, atol=1e-9)
    assert judge.index.tolist() == [[0]]


def test_moving_past_each_other_is_judged_by_the_relative_motion() -> None:
    """Head-on at 60 m/s and 2.5 m beside: clearance 2.5 - 1.0 m, reached between two samples."""
    ball = {
        "shape": "sphere",
        "start_m": (30.33, 2.5, 0.0),
        "velocity_mps": (-50.0, 0.0, 0.0),
        "radius_m": 1.0,
    }
    path = np.column_stack([10.0 * 0.02 * np.arange(60), np.zeros(60), np.zeros(60)])
    assert swept(built(ball), path, 0.02).clearance[0, 0] == pytest.approx(1.5, abs=1e-12)


def test_a_very_fast_obstacle_between_samples_is_seen() -> None:
    """A ball of 0.2 m at 100 m/s moves 2 m a step: through the UAV, never near it at a sample."""
    ball = {
        "shape": "sphere",
        "start_m": (5.0, 0.0, 0.0),
        "velocity_mps": (-100.0, 0.0, 0.0),
        "radius_m": 0.2,
    }
    path = np.zeros((20, 3))
    path[:, 0] = -2.0
    moving = built(ball)
    sampled = min(np.linalg.norm(moving.position(0.02 * i)[0, 0] - path[i]) for i in range(20))
    assert sampled > 0.9
    assert swept(moving, path, 0.02).clearance[0, 0] == pytest.approx(-0.2, abs=1e-12)


def test_flying_on_inside_an_obstacle_is_its_whole_radius_deep() -> None:
    ball = {"shape": "sphere", "start_m": (0.0, 0.0, 0.0), "velocity_mps": (2.0, 0.0, 0.0), "radius_m": 1.5}
    path = np.column_stack([2.0 * 0.02 * np.arange(10), np.zeros(10), np.zeros(10)])
    assert swept(built(ball), path, 0.02).clearance[0, 0] == pytest.approx(-1.5, abs=1e-9)


def test_over_a_ball_is_clear_over_a_cylinder_is_not() -> None:
    path = np.repeat([[0.0, 0.0, 50.0]], 3, axis=0)
    assert swept(at_rest((0.0, 0.0, 0.0), 2.0), path, 0.02).clearance[0, 0] == pytest.approx(48.0)
    assert swept(at_rest((0.0, 0.0, 0.0), 2.0, upright=True), path, 0.02).clearance[0, 0] == -2.0


def test_runs_that_do_not_fly_are_not_looked_at() -> None:
    moving = built(BALL, runs=range(2))
    judge = MovingClearance(moving, 2, 1)
    here = np.zeros((2, 1, 3))
    here[1] = np.nan
    judge.update(0.0, 0.02, here, here, np.array([True, False]))
    assert np.isfinite(judge.clearance[0, 0])
    assert judge.clearance[1, 0] == np.inf
    with pytest.raises(ValueError, match="not finite in run 1"):
        judge.update(0.0, 0.02, here, here)
    with pytest.raises(ValueError, match="of 2 runs, must be 3"):
        MovingClearance(moving, 3, 1)
