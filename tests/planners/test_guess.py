"""Plans are cut where they enter an obstacle, also one that is thinner than a step of theirs."""

import numpy as np
from numpy.typing import NDArray

from napf_mpc.planners.guess import cut_at_obstacles
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Shape, Sphere

Array = NDArray[np.float64]


def straight(start: float, step: float, stages: int = 10) -> Array:
    out = np.zeros((1, 1, stages, 3))
    out[..., 0] = start + step * np.arange(stages)
    return out


def cut(plan: Array, *shapes: Shape) -> Array:
    return cut_at_obstacles(plan[:, :, 0], plan, ObstacleSet.from_shapes(list(shapes)))[0, 0, :, 0]


def test_a_wall_thinner_than_a_step_stops_the_plan() -> None:
    plan = straight(0.0, 2.0)
    along = cut(plan, Box((9.0, 0.0, 0.0), (0.3, 10.0, 10.0)))
    np.testing.assert_array_equal(along, np.minimum(plan[0, 0, :, 0], 8.0))


def test_a_plan_beside_an_obstacle_or_without_any_stays_as_it_is() -> None:
    plan = straight(0.0, 2.0)
    np.testing.assert_array_equal(cut(plan, Sphere((9.0, 1.5, 0.0), 1.0)), plan[0, 0, :, 0])
    np.testing.assert_array_equal(cut(plan), plan[0, 0, :, 0])


def test_one_that_starts_inside_leads_out() -> None:
    plan = straight(0.0, 0.5)
    np.testing.assert_array_equal(cut(plan, Sphere((0.5, 0.0, 0.0), 2.0)), plan[0, 0, :, 0])


def test_one_that_starts_inside_or_behind_what_the_uav_is_outside_of_stays_where_that_is() -> None:
    """A way that begins in a wall, as a slot may in a hold, would lead out on any side of it."""
    wall = ObstacleSet.from_shapes([Box((9.0, 0.0, 0.0), (4.0, 10.0, 10.0))])
    here = np.array([[[6.0, 0.5, 0.0]]])
    for start in (8.0, 12.0):
        left = cut_at_obstacles(here, straight(start, 0.5), wall)
        np.testing.assert_array_equal(left, np.broadcast_to(here[:, :, None], left.shape))
    inside = np.array([[[8.5, 0.5, 0.0]]])  # who is inside keeps its plan, which leads out
    np.testing.assert_array_equal(cut_at_obstacles(inside, straight(8.0, 0.5), wall), straight(8.0, 0.5))


def test_against_dense_sampling() -> None:
    """Random plans among random spheres: no piece of what is left enters one, and what is cut would have."""
    rng = np.random.default_rng(3)
    cuts = 0
    for _ in range(60):
        shapes: list[Shape] = [
            Sphere(tuple(rng.uniform(-6.0, 6.0, 3)), float(rng.uniform(0.5, 2.0))) for _ in range(12)
        ]
        world = ObstacleSet.from_shapes(shapes)
        plan = np.cumsum(rng.normal(0.0, 1.0, (1, 1, 12, 3)), axis=2)
        if world.signed_distance(plan[:, 0, :1])[0, 0] <= 0.0:
            continue
        left = cut_at_obstacles(plan[:, :, 0], plan, world)[0, 0]
        kept = int((left == plan[0, 0]).all(-1).sum())
        at = np.linspace(0.0, 1.0, 400)[:, None]

        def least(a: Array, b: Array, world: ObstacleSet = world, at: Array = at) -> float:
            return float(world.signed_distance((a + at * (b - a))[None]).min())

        for n in range(kept - 1):
            assert least(plan[0, 0, n], plan[0, 0, n + 1]) > -0.06  # a chord of a tenth of a metre, at most
        if kept < len(left):
            cuts += 1
            np.testing.assert_array_equal(left[kept:], np.broadcast_to(left[kept - 1], left[kept:].shape))
            assert least(plan[0, 0, kept - 1], plan[0, 0, kept]) <= 1e-3
    assert cuts > 10
