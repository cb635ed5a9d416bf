"""Line of sight: each kind of solid by hand, and all of them against the signed distance along the ray."""

import numpy as np
import pytest

from napf_mpc.streams import Stream, generator
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere
from napf_mpc.world.sight import line_of_sight

EAST, UP = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
YARD = Prism(
    (
        np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]]),
        np.array([[8.0, 8.0], [12.0, 8.0], [12.0, 12.0], [8.0, 12.0]]),
    ),
    0.0,
    30.0,
)


def at_degrees(elevation: float) -> list[float]:
    """Eastward ray."""
    return [np.cos(np.radians(elevation)), 0.0, np.sin(np.radians(elevation))]


def free(shapes: list[Shape], point: list[float], ray: list[float]) -> bool:
    unit = np.array(ray) / np.linalg.norm(ray)
    return bool(line_of_sight(ObstacleSet.from_shapes(shapes), [[point]], unit[None, None])[0, 0, 0])


@pytest.mark.parametrize(
    ("shape", "roof_m"),
    [
        (Box((20.0, 0.0, 15.0), (10.0, 40.0, 30.0)), 30.0),
        (Box((20.0, 0.0, 15.0), (40.0, 10.0, 30.0), np.pi / 2.0), 30.0),
        (Prism((np.array([[15.0, -20.0], [25.0, -20.0], [25.0, 20.0], [15.0, 20.0]]),), 0.0, 30.0), 30.0),
    ],
)
def test_a_wall_15_m_away_hides_what_is_lower_than_its_edge(shape: Shape, roof_m: float) -> None:
    edge = np.degrees(np.arctan2(roof_m - 2.0, 15.0))  # 61.8 degrees from 2 m over the ground
    assert not free([shape], [0.0, 0.0, 2.0], at_degrees(edge - 0.1))
    assert free([shape], [0.0, 0.0, 2.0], at_degrees(edge + 0.1))
    assert free([shape], [0.0, 0.0, 2.0], [-1.0, 0.0, 0.1])
    assert free([shape], [0.0, 0.0, 31.0], EAST)


def test_a_ball_and_a_mast_hide_their_own_width() -> None:
    ball, mast = Sphere((100.0, 0.0, 0.0), 10.0), Cylinder((100.0, 0.0), 10.0, 0.0, 50.0)
    half = np.degrees(np.arcsin(0.1))
    for inside, shape in ((True, ball), (True, mast)):
        for angle in (half - 0.05, half + 0.05):
            ray = [np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0]
            assert free([shape], [0.0, 0.0, 0.0], ray) != (inside and angle < half)
    assert free([mast], [0.0, 0.0, 60.0], EAST)
    # Down onto the roof from beyond its edge, and past it.
    assert not free([mast], [80.0, 0.0, 60.0], [15.0, 0.0, -10.0])
    assert free([mast], [80.0, 0.0, 60.0], [3.0, 0.0, -30.0])
    assert not free([Cylinder((5.0, 0.0), 1.0)], [0.0, 0.0, 1e5], at_degrees(80.0))  # it has no end


def test_from_a_courtyard_one_sees_the_zenith_only() -> None:
    assert free([YARD], [10.0, 10.0, 1.0], UP)
    assert not free([YARD], [10.0, 10.0, 1.0], at_degrees(60.0))
    assert free([YARD], [10.0, 10.0, 29.0], at_degrees(60.0))
    assert not free([YARD], [4.0, 4.0, 1.0], UP)  # in the house itself
    assert free([YARD], [4.0, 4.0, 30.5], UP)


def test_inside_a_solid_nothing_is_in_sight() -> None:
    for shape in (
        Sphere((0.0, 0.0, 0.0), 2.0),
        Cylinder((0.0, 0.0), 2.0),
        Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)),
    ):
        assert not free([shape], [0.5, 0.0, 0.0], at_degrees(50.0))


def test_nothing_stands_in_the_way_of_an_empty_scene_and_unwanted_rays_are_not_free() -> None:
    rays = np.array([[EAST, UP]])
    wanted = np.array([[True, False]])
    seen = line_of_sight(ObstacleSet.empty(), np.zeros((3, 2, 3)), rays, wanted)
    assert seen.shape == (3, 2, 2)
    assert seen[..., 0].all()
    assert not seen[..., 1].any()


def test_each_run_looks_at_its_own_scene() -> None:
    wall = ObstacleSet.from_shapes([Box((20.0, 0.0, 15.0), (10.0, 40.0, 30.0))])
    both = ObstacleSet.stack([wall, ObstacleSet.empty()])
    seen = line_of_sight(both, np.full((2, 1, 3), [0.0, 0.0, 2.0]), np.array([[EAST]]))
    assert seen.ravel().tolist() == [False, True]


def test_it_is_what_the_signed_distance_says_along_the_ray() -> None:
    stream = generator(1, 0, Stream.SCENE)
    shapes: list[Shape] = []
    for _ in range(15):
        x, y = stream.uniform(-60.0, 60.0, 2)
        size = stream.uniform(3.0, 12.0)
        corners = np.sort(stream.uniform(0.0, 2.0 * np.pi, 7))
        star = size * stream.uniform(0.3, 1.0, (7, 1)) * np.stack([np.cos(corners), np.sin(corners)], -1)
        shapes += [
            Sphere((x, y, stream.uniform(0.0, 30.0)), size),
            Cylinder((y, x), 0.4 * size, 0.0, 3.0 * size),
            Box((-x, y, size), (size, 2.0 * size, 2.0 * size), stream.uniform(0.0, 3.0)),
            Prism((star - np.array([y, x]),), 0.0, 2.5 * size),
        ]
    scene = ObstacleSet.from_shapes(shapes)
    points = np.concatenate([stream.uniform(-60.0, 60.0, (40, 2)), stream.uniform(0.5, 25.0, (40, 1))], -1)
    rays = stream.standard_normal((12, 3))
    rays[:, 2] = np.abs(rays[:, 2])
    rays /= np.linalg.norm(rays, axis=-1)[:, None]
    seen = line_of_sight(scene, points[None], rays[None])[0]
    along = np.arange(0.0, 250.0, 0.05)[:, None]
    for i, point in enumerate(points):
        for k, ray in enumerate(rays):
            nearest = scene.signed_distance((point + along * ray)[None])[0].min()
            if abs(nearest) > 0.05:  # a sample every 5 cm may pass an edge by
                assert seen[i, k] == (nearest > 0.0), f"point {i}, ray {k}: {nearest:.3f} m"
    assert 0.2 < seen.mean() < 0.8


@pytest.mark.parametrize(
    ("points", "rays", "words"),
    [
        (np.zeros((1, 1, 3)), np.zeros((2, 3)), "directions has shape"),
        (np.zeros((1, 1, 3)), np.full((1, 1, 3), np.nan), "directions holds"),
        (np.full((1, 1, 3), np.inf), np.zeros((1, 1, 3)), "points"),
        (np.zeros((3, 1, 3)), np.zeros((2, 1, 3)), "directions has shape"),
    ],
)
def test_what_cannot_be_looked_at_is_named(points: np.ndarray, rays: np.ndarray, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        line_of_sight(ObstacleSet.empty(), points, rays)
