"""Plans that pass an edge between two stages keep from the edge, in metres."""

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.constraints.edges import keep_edges
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

ROOF = Box((0.0, 0.0, 5.0), (10.0, 40.0, 10.0))
"""East wall at x = 5, roof at z = 10."""
OVER = np.array([(2.0, 0.0, 12.0), (4.5, 0.0, 11.5), (7.5, 0.0, 8.5), (9.0, 0.0, 6.0)])
"""Over the roof and down behind its east edge; the piece from x = 4.5 to 7.5 passes it."""


def planes(shapes: list[Shape], plan: Array) -> tuple[Array, Array, Array, Array]:
    """Distances (N, m) and normals (N, m, 3) as they are found, and with edges kept."""
    world = ObstacleSet.from_shapes(shapes)
    near = world.near(plan[None], np.full((1, len(plan)), 30.0), len(shapes), together=len(plan))
    distance, normal = near.distance.copy(), near.gradient.copy()
    keep_edges(world.solids, world.scene_start, plan[None], len(plan), distance, normal, near.index)
    return near.distance[0], near.gradient[0], distance[0], normal[0]


def test_both_ends_of_a_piece_round_an_edge_keep_from_the_edge() -> None:
    before, faces, distance, normal = planes([ROOF], OVER)
    edge = np.array([5.0, 0.0, 10.0])
    nearest = np.array([5.5, 0.0, 10.5])  # where the piece, at 45 degrees, is nearest to the edge
    out = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    np.testing.assert_array_equal(faces[1, 0], (0.0, 0.0, 1.0))
    np.testing.assert_array_equal(faces[2, 0], (1.0, 0.0, 0.0))
    for stage in (1, 2):
        np.testing.assert_allclose(normal[stage, 0], out, atol=5e-3)
        assert distance[stage, 0] == pytest.approx(np.linalg.norm(nearest - edge), abs=0.015)
    # Stages that no edge is between are as they were.
    np.testing.assert_array_equal(distance[[0, 3]], before[[0, 3]])
    np.testing.assert_array_equal(normal[[0, 3]], faces[[0, 3]])


def test_what_keeps_the_planes_keeps_the_piece_between() -> None:
    """With the faces' planes alone, a plan that meets them by a margin of 1 m may still cut the edge."""
    margin = 1.0
    cutting = np.array([(4.6, 0.0, 11.0), (6.0, 0.0, 8.0)])
    world = ObstacleSet.from_shapes([ROOF])
    at = np.linspace(0.0, 1.0, 301)[:, None]

    def least(plan: Array) -> float:
        return float(world.signed_distance((plan[0] + at * (plan[1] - plan[0]))[None]).min())

    assert world.signed_distance(cutting[None]).min() >= margin  # both stages are clear,
    assert least(cutting) < 0.5  # and what is between them is not
    _, _, distance, normal = planes([ROOF], cutting)
    moved = cutting + np.maximum(margin - distance, 0.0) * normal[:, 0]
    assert least(moved) >= margin - 0.015


def test_of_two_edges_a_stage_keeps_from_the_nearer_one() -> None:
    """A thin wall passed end on: down to its top and off again within two pieces."""
    wall = Box((0.0, 0.0, 5.0), (1.0, 40.0, 10.0))
    plan = np.array([(-2.0, 0.0, 9.0), (0.0, 0.0, 10.6), (3.0, 0.0, 9.8)])
    _, _, distance, normal = planes([wall], plan)
    world = ObstacleSet.from_shapes([wall])
    at = np.linspace(0.0, 1.0, 2001)[:, None]
    pieces = [plan[n] + at * (plan[n + 1] - plan[n]) for n in range(2)]
    nearest = [float(world.signed_distance(piece[None]).min()) for piece in pieces]
    assert nearest[0] < nearest[1]
    assert distance[1, 0] == pytest.approx(nearest[0], abs=0.015)
    assert normal[1, 0, 0] < -0.3  # of the edge on the near side
    assert np.linalg.norm(normal[1, 0]) == pytest.approx(1.0)


def test_lids_have_edges_and_round_sides_have_none() -> None:
    pillar = Cylinder((0.0, 0.0), 5.0, -50.0, 10.0)
    _, faces, _, normal = planes([pillar], OVER)
    assert not np.array_equal(faces[1:3], normal[1:3])
    round_it = np.array([(7.0, -4.0, 0.0), (8.0, 0.0, 0.0), (7.0, 4.0, 0.0)])
    beside: list[Shape] = [pillar, Sphere((20.0, 0.0, 0.0), 5.0)]
    before, faces, distance, normal = planes(beside, round_it)
    np.testing.assert_array_equal(before, distance)
    np.testing.assert_array_equal(faces, normal)


def test_the_corner_of_a_prism_is_kept_as_a_boxs() -> None:
    footprint = np.array([(-5.0, -20.0), (5.0, -20.0), (5.0, 20.0), (-5.0, 20.0)])
    plan = np.array([(-3.0, 21.5, 5.0), (3.5, 22.0, 5.0), (7.0, 18.5, 5.0), (6.5, 10.0, 5.0)])
    of_box, of_prism = planes([ROOF], plan), planes([Prism([footprint], 0.0, 10.0)], plan)
    for one, other in zip(of_box, of_prism, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    assert 0.3 < of_box[3][1, 0, 0] < 0.95
    assert of_box[3][1, 0, 2] == 0.0


def test_a_plan_inside_and_one_that_stands_are_left_alone() -> None:
    for plan in (
        np.array([(0.0, 0.0, 9.0), (4.5, 0.0, 9.0), (4.9, 0.0, 5.0)]),
        np.repeat([(4.5, 0.0, 11.0)], 3, axis=0),
    ):
        before, faces, distance, normal = planes([ROOF], plan)
        np.testing.assert_array_equal(before, distance)
        np.testing.assert_array_equal(faces, normal)
