"""Artificial potential field: forces against gradients, signs, limits of turn, and the walk of Fig. 4."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from napf_mpc import apf
from napf_mpc.goal_walk import walk_to_goal
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape, Sphere

Array = NDArray[np.float64]

NORTH_EAST = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
NORTH_WEST = np.array([-1.0, 1.0, 0.0]) / math.sqrt(2.0)

SCENE: list[Shape] = [
    Sphere((0.0, 0.0, 0.0), 1.0),
    Sphere((4.0, 1.0, 0.5), 1.5),
    Cylinder((-3.0, 2.0), 0.7, -1.0, 3.0),
    Box((1.0, -4.0, 0.0), (3.0, 1.0, 2.0), 0.4),
]


def potential(points: Array) -> Array:
    """Sum of the FIRAS potentials of the scene, (n, 3) -> (n,)."""
    near = ObstacleSet.from_shapes(SCENE).near(points[None], np.inf)
    return np.asarray(apf.repulsive_potential(near.distance[0], 15.0, 3.0).sum(-1))


def force(points: Array) -> Array:
    near = ObstacleSet.from_shapes(SCENE).near(points[None], np.inf)
    return apf.repulsive_force(near.distance, near.gradient, 15.0, 3.0, 0.1)[0]


# --------------------------------------------------------------------------------------- Eq. 23 to 28


def test_force_is_minus_the_gradient_of_the_potential_at_1000_places() -> None:
    """Eq. 28 against Eq. 23, with distances to surfaces; places on a kink of some distance are left out."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-7.0, 7.0, (6000, 3)) * (1.0, 1.0, 0.5)
    near = ObstacleSet.from_shapes(SCENE).near(points[None], np.inf)
    inside = (near.distance[0] > 0.3).all(-1) & (near.distance[0, :, 0] < 2.9)
    points = points[inside][:1000]
    assert len(points) == 1000
    step = 1e-5
    slopes = np.empty((1000, 3))
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slopes[:, axis] = (potential(points + shift) - potential(points - shift)) / (2.0 * step)
    here = force(points)
    error = np.linalg.norm(here + slopes, axis=-1) / np.maximum(np.linalg.norm(here, axis=-1), 0.1)
    # At the edge of some obstacle's range the slope itself has a kink of second order.
    assert np.median(error) < 1e-7
    assert (error < 1e-3).all()


@given(rho=st.floats(0.11, 2.999), gain=st.floats(0.1, 1e3))
def test_magnitude_is_the_slope_of_the_potential(rho: float, gain: float) -> None:
    step = 1e-6
    above, below = (apf.repulsive_potential(np.array(rho + s), gain, 3.0) for s in (step, -step))
    assert float(apf.repulsion(np.array(rho), gain, 3.0, 0.1)) == pytest.approx(
        -(above - below) / (2.0 * step), rel=1e-4, abs=1e-6 * gain
    )


def test_force_by_hand() -> None:
    """15 (1/1 - 1/3) / 1^2 = 10 one metre from the surface, none at and beyond rho_0 = 3 m."""
    rho = np.array([0.5, 1.0, 2.0, 3.0, 3.5, np.inf])
    expected = [100.0, 10.0, 0.625, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(apf.repulsion(rho, 15.0, 3.0, 0.1), expected, atol=1e-12)
    np.testing.assert_allclose(
        apf.repulsive_potential(rho[:3], 15.0, 3.0), [125.0 / 6.0, 10.0 / 3.0, 5.0 / 24.0]
    )


def test_force_and_potential_start_at_zero() -> None:
    """Both are continuous where the obstacle comes into range."""
    rho = 3.0 + np.array([-1e-6, -1e-9, 0.0, 1e-9])
    assert apf.repulsion(rho, 15.0, 3.0, 0.1) == pytest.approx(0.0, abs=1e-6)
    assert apf.repulsive_potential(rho, 15.0, 3.0) == pytest.approx(0.0, abs=1e-11)


@pytest.mark.parametrize("rho", [0.1, 0.0, -0.0, -0.5, -1e9, -np.inf, 1e-320])
def test_at_contact_and_inside_the_force_is_finite_and_largest(rho: float) -> None:
    assert apf.repulsion(np.array(rho), 15.0, 3.0, 0.1) == pytest.approx(15.0 * (10.0 - 1.0 / 3.0) * 100.0)
    assert apf.repulsive_potential(np.array(rho), 15.0, 3.0) == pytest.approx(7.5 * (10.0 - 1.0 / 3.0) ** 2)


@given(
    centre=arrays(float, 3, elements=st.floats(-50.0, 50.0)),
    offset=arrays(float, 3, elements=st.floats(-3.0, 3.0)),
    radius=st.floats(0.1, 5.0),
)
def test_repulsion_points_away_from_the_obstacle(centre: Array, offset: Array, radius: float) -> None:
    """F . (X - X_o) > 0: with Eq. 33's printed angle the obstacle would attract."""
    obstacles = ObstacleSet.from_spheres(centre[None, None], [[radius]])
    position = centre + offset
    near = obstacles.near(position[None, None], 3.0)
    if near.distance.size == 0:
        return
    push = apf.repulsive_force(near.distance, near.gradient, 15.0, 3.0, 0.1)[0, 0]
    assert np.isfinite(push).all()
    if np.linalg.norm(offset) > 1e-9:
        assert push @ offset > 0.0
        np.testing.assert_allclose(np.cross(push, offset), 0.0, atol=1e-6 * np.linalg.norm(push))
    else:  # concentric: any direction will do, but there is one
        assert np.linalg.norm(push) > 0.0


def test_obstacles_add_up_and_padding_adds_nothing() -> None:
    rho = np.array([[1.0, 2.0, np.inf]])
    gradient = np.array([[(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)]])
    np.testing.assert_allclose(
        apf.repulsive_force(rho, gradient, 15.0, 3.0, 0.1), [[10.0, 0.0, -0.625]], atol=1e-12
    )
    wide = np.concatenate([rho, np.full((1, 9), np.inf)], axis=1)
    padded = np.concatenate([gradient, np.zeros((1, 9, 3))], axis=1)
    np.testing.assert_array_equal(
        apf.repulsive_force(wide, padded, 15.0, 3.0, 0.1), apf.repulsive_force(rho, gradient, 15.0, 3.0, 0.1)
    )
    assert apf.repulsive_force(np.zeros((2, 0)), np.zeros((2, 0, 3)), 15.0, 3.0, 0.1).shape == (2, 3)


@given(
    position=arrays(float, (4, 3), elements=st.floats(-100.0, 100.0)),
    goal=arrays(float, 3, elements=st.floats(-100.0, 100.0)),
)
def test_attraction_is_minus_the_gradient_and_points_to_the_goal(position: Array, goal: Array) -> None:
    pull = apf.attractive_force(position, goal, 2.5)
    for axis in range(3):
        shift = 1e-3 * np.eye(3)[axis]
        above, below = (apf.attractive_potential(position + s * shift, goal, 2.5) for s in (1, -1))
        np.testing.assert_allclose(pull[:, axis], -(above - below) / 2e-3, atol=1e-5)
    np.testing.assert_allclose(pull, 2.5 * (goal - position))


# --------------------------------------------------------------------------------------- Eq. 37 to 39


@given(velocity=arrays(float, (6, 3), elements=st.floats(-1e3, 1e3)))
def test_speed_is_capped_and_direction_kept(velocity: Array) -> None:
    capped = apf.velocity_update(velocity, np.zeros((6, 3)), 3.0)
    speed, was = np.linalg.norm(capped, axis=-1), np.linalg.norm(velocity, axis=-1)
    np.testing.assert_allclose(speed, np.minimum(was, 3.0), rtol=1e-12)
    np.testing.assert_allclose(capped * was[:, None], velocity * speed[:, None], atol=1e-9)
    np.testing.assert_array_equal(capped[was < 3.0], velocity[was < 3.0])


def test_force_adds_to_the_reference_velocity() -> None:
    reference, push = np.array([[2.0, 0.0, 0.0]]), np.array([[-1.5, 0.5, 0.25]])
    np.testing.assert_array_equal(apf.velocity_update(reference, push, 3.0), [[0.5, 0.5, 0.25]])


def test_heading_and_climb_by_hand() -> None:
    """Eq. 38 as read; the printed arctan(V_y / V_z) knows neither quadrant nor level flight."""
    velocity = np.array([(1.0, 1.0, 0.0), (-1.0, 0.0, 1.0), (0.0, -2.0, -2.0), (0.0, 0.0, 0.0)])
    heading, climb = apf.heading_and_climb(velocity)
    np.testing.assert_allclose(np.degrees(heading), [45.0, 180.0, -90.0, 0.0])
    np.testing.assert_allclose(np.degrees(climb), [0.0, 45.0, -45.0, 0.0])


@given(
    velocity=arrays(float, 3, elements=st.floats(-1e3, 1e3)),
    limit_deg=st.floats(0.0, 90.0),
    heading=st.floats(-math.pi, math.pi),
    climb=st.floats(-0.7, 0.7),
)
def test_direction_turns_by_no_more_than_the_limit(
    velocity: Array, limit_deg: float, heading: float, climb: float
) -> None:
    path = np.array(
        [math.cos(heading) * math.cos(climb), math.sin(heading) * math.cos(climb), math.sin(climb)]
    )
    left = np.array([-math.sin(heading), math.cos(heading), 0.0])
    limit = math.radians(limit_deg)
    direction = apf.limit_turn(velocity[None], path, left, limit)[0]
    assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-7)
    turn = math.atan2(np.linalg.norm(np.cross(direction, path)), direction @ path)
    assert turn <= limit + 1e-7
    size = float(np.linalg.norm(velocity))
    if size > 1e-6:
        asked = math.atan2(np.linalg.norm(np.cross(velocity, path)), velocity @ path)
        assert turn == pytest.approx(min(asked, limit), abs=1e-6)
        if asked <= limit:
            np.testing.assert_allclose(direction, velocity / size, atol=1e-7)
        # It turns in the plane of path and velocity, towards the velocity.
        if asked < math.pi - 1e-6:
            assert abs(np.cross(path, velocity / size) @ direction) < 1e-6
            assert direction @ (velocity - (velocity @ path) * path) >= -1e-6 * size


def test_limit_of_sixty_degrees_by_hand() -> None:
    east, north, up = np.eye(3)
    velocity = np.array(
        [
            (1.0, 1.0, 0.0),  # 45 degrees: free
            (0.0, 1.0, 0.0),  # 90 degrees to the left
            (0.0, -3.0, 0.0),
            (-1.0, 0.0, 1.0),  # backwards and up
            (0.0, 0.0, 0.0),  # no velocity: the path
            (-2.0, 0.0, 0.0),  # straight back: to the left, by the whole limit
            (5.0, 0.0, 0.0),
        ]
    )
    c, s = 0.5, math.sqrt(0.75)
    expected = [
        (math.sqrt(0.5), math.sqrt(0.5), 0.0),
        c * east + s * north,
        c * east - s * north,
        c * east + s * up,
        east,
        c * east + s * north,
        east,
    ]
    np.testing.assert_allclose(
        apf.limit_turn(velocity, east, north, math.radians(60.0)), expected, atol=1e-12
    )


@pytest.mark.parametrize("sideways", [0.0, 1e-300, 1e-13, 1e-11, 1e-9])
def test_straight_back_up_to_rounding_still_gives_a_direction(sideways: float) -> None:
    velocity = -2.0 * NORTH_EAST + sideways * NORTH_WEST
    direction = apf.limit_turn(velocity[None], NORTH_EAST, NORTH_WEST, math.radians(60.0))[0]
    np.testing.assert_allclose(direction, 0.5 * NORTH_EAST + math.sqrt(0.75) * NORTH_WEST, atol=1e-6)


@given(velocity=arrays(float, (8, 3), elements=st.floats(-10.0, 10.0)))
def test_turning_the_world_by_ninety_degrees_turns_the_answer(velocity: Array) -> None:
    """Eq. 39 as printed, arctan(V_x / V_y), would not."""
    quarter = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    east, north, _ = np.eye(3)
    here = apf.limit_turn(velocity, east, north, math.radians(60.0))
    there = apf.limit_turn(velocity @ quarter.T, quarter @ east, quarter @ north, math.radians(60.0))
    np.testing.assert_array_equal(there, here @ quarter.T)


# --------------------------------------------------------------------------------------------- Fig. 4


def walk(
    *obstacles: tuple[float, float], start: tuple[float, float] = (0.0, 0.0), step_m: float = 0.02
) -> tuple[apf.Walk, Callable[[Array], Array]]:
    """Walk of the paper's single UAV to (10, 10) past obstacles of radius 1, and their clearance."""
    problem = load_problem("single_uav", {"mission.step_m": step_m, "mission.start_m": list(start)})
    scene = ObstacleSet.from_shapes([Sphere((*centre, 0.0), 1.0) for centre in obstacles])

    def clearance(points: Array) -> Array:
        return scene.signed_distance(np.column_stack([points, np.zeros(len(points))])[None])[0]

    return walk_to_goal(problem, scene), clearance


def test_walk_arrives_smoothly_past_an_obstacle_slightly_off_the_line() -> None:
    result, clearance = walk((5.0, 5.8))
    assert result.arrived
    assert not result.stuck
    assert math.dist(result.positions[-1], (10.0, 10.0)) <= 0.1
    assert clearance(result.positions).min() > 0.3
    steps = np.diff(result.positions, axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 0.02, rtol=1e-9)
    # Smooth: no step turns by more than 15 degrees against the one before.
    cosine = (steps[1:] * steps[:-1]).sum(-1) / 0.02**2
    assert cosine.min() > math.cos(math.radians(15.0))
    assert len(steps) * 0.02 < 1.2 * math.hypot(10.0, 10.0)


def test_walk_of_the_shipped_problem_arrives_without_contact() -> None:
    result, clearance = walk((2.5, 3.3), (5.2, 4.4), (7.2, 8.1))
    assert result.arrived
    assert clearance(result.positions).min() > 0.0


def test_free_walk_is_a_straight_line() -> None:
    result, _ = walk()
    assert result.arrived
    np.testing.assert_allclose(result.positions[:, 0], result.positions[:, 1], atol=1e-9)
    assert len(result.positions) == math.ceil((math.hypot(10.0, 10.0) - 0.1) / 0.02) + 1


def test_an_obstacle_exactly_on_the_line_stops_the_walk_for_good() -> None:
    """The forces cancel in front of it: a limit of the method, reported as stuck and never as arrived."""
    result, clearance = walk((5.0, 5.0))
    assert result.stuck
    assert not result.arrived
    assert math.dist(result.positions[-1], (10.0, 10.0)) > 5.0
    assert clearance(result.positions).min() > 0.0


def test_an_obstacle_near_the_goal_is_never_passed() -> None:
    """Centre 1.5 m from the goal: its repulsion there is stronger than the goal's attraction."""
    result, _ = walk((10.0 - 1.5 / math.sqrt(2.0), 10.0 - 1.5 / math.sqrt(2.0) + 0.05))
    assert not result.arrived
    assert result.stuck


def test_walk_that_starts_on_the_goal_has_arrived() -> None:
    result, _ = walk((10.0, 11.5), start=(10.0, 10.0))
    assert result.arrived
    assert len(result.positions) == 1


@pytest.mark.parametrize(
    "start", [(5.0, 5.0), (5.0, 5.5), (6.0, 5.0)], ids=["concentric", "inside", "touching"]
)
def test_walk_that_starts_in_an_obstacle_leaves_it_and_stays_finite(start: tuple[float, float]) -> None:
    result, clearance = walk((5.0, 5.0), start=start)
    assert np.isfinite(result.positions).all()
    assert clearance(result.positions)[0] <= 1e-12
    assert clearance(result.positions)[-1] > 0.5


def test_walk_without_any_force_is_stuck_and_not_arrived() -> None:
    result = apf.angle_step_walk(
        np.zeros(2),
        np.array([1.0, 0.0]),
        lambda _: (np.zeros(0), np.zeros((0, 2))),
        attractive_gain=0.0,
        repulsive_gain=1.0,
        influence_m=1.0,
        floor_m=0.1,
        step_m=0.1,
        arrival_m=0.1,
        max_steps=100,
    )
    assert result.stuck
    assert not result.arrived


def test_walk_ends_after_its_steps() -> None:
    result = apf.angle_step_walk(
        np.zeros(2),
        np.array([100.0, 0.0]),
        lambda _: (np.zeros(0), np.zeros((0, 2))),
        attractive_gain=1.0,
        repulsive_gain=1.0,
        influence_m=1.0,
        floor_m=0.1,
        step_m=0.1,
        arrival_m=0.1,
        max_steps=50,
    )
    assert (result.arrived, result.stuck) == (False, False)
    assert len(result.positions) == 51
    assert result.positions[-1, 0] == pytest.approx(5.0)
