"""Queries over sets of obstacles: right, ordered, padded, and the same bits in any batch."""

import numpy as np
import pytest

from napf_mpc.world.bounding_tree import plant
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Sphere


def mixed(rng, count, width=2000.0):
    """Shapes of all kinds, 0.1 to 500 m, crowded enough to overlap."""
    shapes = []
    for i in range(count):
        x, y = rng.uniform(0.0, width, 2)
        base = rng.uniform(-20.0, 80.0)
        size = np.exp(rng.uniform(np.log(0.1), np.log(500.0), 3))
        if i % 5 == 0:
            shapes.append(Sphere((x, y, base), 0.5 * size[0]))
        elif i % 5 == 1:
            shapes.append(Cylinder((x, y), 0.5 * size[0], base, base + size[2]))
        elif i % 5 == 2:
            shapes.append(Cylinder((x, y), 0.05 * size[0]))
        elif i % 5 == 3:
            shapes.append(Box((x, y, base), tuple(size), rng.uniform(-3.0, 3.0)))
        else:
            ring = np.array([(0.0, 0.0), (1.0, 0.2), (0.4, 0.4), (0.1, 1.0)]) * size[:2] + (x, y)
            shapes.append(Prism((ring,), base, base + size[2]))
    return shapes


def one_by_one(shapes, points):
    """Distances and gradients (point, shape): every obstacle looked at on its own."""
    answers = [ObstacleSet.from_shapes([shape]).nearest(points[None]) for shape in shapes]
    return np.stack([a[0][0] for a in answers], axis=1), np.stack([a[1][0] for a in answers], axis=1)


@pytest.mark.parametrize("count", [1, 3, 17, 64, 700])
def test_search_finds_what_looking_at_every_obstacle_finds(count):
    """Bit for bit: nearest, and all within a reach, near, inside and 100 km away."""
    rng = np.random.default_rng(count)
    shapes = mixed(rng, count)
    obstacles = ObstacleSet.from_shapes(shapes)
    points = rng.uniform((-500.0, -500.0, -50.0), (2500.0, 2500.0, 200.0), (300, 3))
    points = np.concatenate([points, 1e5 * rng.normal(size=(20, 3))])
    every, gradients = one_by_one(shapes, points)
    distance, gradient, index = obstacles.nearest(points[None])
    np.testing.assert_array_equal(distance[0], every.min(axis=1))
    np.testing.assert_array_equal(index[0], every.argmin(axis=1))
    np.testing.assert_array_equal(gradient[0], gradients[np.arange(len(points)), index[0]])
    np.testing.assert_array_equal(obstacles.signed_distance(points[None]), distance)
    reach = rng.uniform(0.0, 300.0, (1, len(points)))
    near = obstacles.near(points[None], reach)
    counts = (every < reach[0][:, None]).sum(axis=1)
    assert near.distance.shape == (1, len(points), counts.max())
    for k, n in enumerate(counts):
        best = np.argsort(every[k], kind="stable")[:n]
        np.testing.assert_array_equal(near.index[0, k, :n], best)
        np.testing.assert_array_equal(near.distance[0, k, :n], every[k, best])
        np.testing.assert_array_equal(near.gradient[0, k, :n], gradients[k, best])
        assert (near.index[0, k, n:] == -1).all()
        assert (near.distance[0, k, n:] == np.inf).all()
        assert (near.gradient[0, k, n:] == 0.0).all()
    few = obstacles.near(points[None], reach, limit=3)
    width = min(3, near.index.shape[2])
    assert few.index.shape == (1, len(points), 3)
    np.testing.assert_array_equal(few.index[..., :width], near.index[..., :width])
    np.testing.assert_array_equal(few.distance[..., :width], near.distance[..., :width])
    np.testing.assert_array_equal(few.gradient[..., :width, :], near.gradient[..., :width, :])


def test_equal_distances_are_ordered_by_index():
    """Thirty copies of one sphere and two mirror images: ties everywhere."""
    obstacles = ObstacleSet.from_shapes([Sphere((0.0, 10.0 * (-1.0) ** i, 0.0), 2.0) for i in range(30)])
    assert obstacles.nearest([[(0.0, 0.0, 0.0)]])[2] == 0
    np.testing.assert_array_equal(obstacles.near([[(0.0, 0.0, 0.0)]], 20.0).index[0, 0], np.arange(30))
    np.testing.assert_array_equal(
        obstacles.near([[(0.0, 0.0, 0.0)]], 20.0, limit=4).index[0, 0], np.arange(4)
    )


def test_reach_is_exclusive_and_may_be_endless_or_nothing():
    obstacles = ObstacleSet.from_shapes([Sphere((10.0, 0.0, 0.0), 2.0), Sphere((0.0, 50.0, 0.0), 1.0)])
    at = [[(0.0, 0.0, 0.0)]]
    assert obstacles.near(at, 8.0).index.shape == (1, 1, 0)
    assert obstacles.near(at, np.nextafter(8.0, 9.0)).index.tolist() == [[[0]]]
    assert obstacles.near(at, np.inf).index.tolist() == [[[0, 1]]]
    assert obstacles.near(at, -np.inf).index.shape == (1, 1, 0)
    assert obstacles.near(at, np.inf, limit=0).index.shape == (1, 1, 0)


def test_a_run_asks_its_own_scene_or_the_only_one():
    rng = np.random.default_rng(3)
    sets = [ObstacleSet.from_shapes(mixed(rng, n)) for n in (5, 0, 90, 1)]
    together = ObstacleSet.stack(sets)
    assert together.n_scenes == 4
    assert len(together) == 96
    assert together.counts().tolist() == [5, 0, 90, 1]
    points = rng.uniform(0.0, 2000.0, (4, 25, 3))
    distance, gradient, index = together.nearest(points)
    near = together.near(points, 400.0)
    for run, alone in enumerate(sets):
        for single in (alone, together.scene(run), ObstacleSet.from_shapes(together.shapes(run))):
            d, g, i = single.nearest(points[run : run + 1])
            np.testing.assert_allclose(d[0], distance[run], atol=1e-9)
            np.testing.assert_allclose(g[0], gradient[run], atol=1e-9)
            np.testing.assert_array_equal(i[0], index[run])
        few = alone.near(points[run : run + 1], 400.0)
        width = few.index.shape[2]
        np.testing.assert_array_equal(near.distance[run, :, :width], few.distance[0])
        np.testing.assert_array_equal(near.index[run, :, :width], few.index[0])
        assert (near.index[run, :, width:] == -1).all()
    assert (distance[1] == np.inf).all()
    assert (index[1] == -1).all()
    assert (gradient[1] == 0.0).all()
    with pytest.raises(ValueError, match="3 runs do not fit 4 scenes"):
        together.nearest(points[:3])
    with pytest.raises(ValueError, match="2 runs do not fit 4 scenes"):
        together.near(points[:2], 1.0)


@pytest.mark.parametrize("limit", [1, 4, 100])
@pytest.mark.parametrize("together", [2, 20, 1000])
def test_points_searched_together_have_the_answers_of_each_alone(limit: int, together: int):
    """Paths of 20 points, scenes too dense to list, an endless reach and none: the same bits."""
    rng = np.random.default_rng(limit + together)
    sets = [ObstacleSet.from_shapes(mixed(rng, n)) for n in (60, 0, 400, 1)]
    obstacles = ObstacleSet.stack(sets)
    start = rng.uniform(-100.0, 2100.0, (4, 10, 1, 3))
    way = np.cumsum(rng.normal((2.0, 1.0, 0.0), 2.0, (4, 10, 20, 3)), axis=2)
    points = (start + way).reshape(4, 200, 3)
    points[0, :20] = 1e9 + points[0, :20]
    reach = rng.uniform(0.0, 60.0, (4, 200))
    reach[2, ::7], reach[0, 60:80], reach[2, 100:103] = 300.0, -np.inf, np.inf
    alone = obstacles.near(points, reach, limit)
    near = obstacles.near(points, reach, limit, together=together)
    np.testing.assert_array_equal(near.index, alone.index)
    np.testing.assert_array_equal(near.distance, alone.distance)
    np.testing.assert_array_equal(near.gradient, alone.gradient)
    assert (near.index[2] >= 0).any()
    with pytest.raises(ValueError, match="together = 0, must be >= 1"):
        obstacles.near(points, reach, limit, together=0)


def test_equal_distances_searched_together_are_ordered_by_index():
    """Thirty copies of one sphere and two mirror images: ties everywhere."""
    obstacles = ObstacleSet.from_shapes([Sphere((0.0, 10.0 * (-1.0) ** i, 0.0), 2.0) for i in range(30)])
    near = obstacles.near(np.zeros((1, 3, 3)), 20.0, limit=4, together=3)
    np.testing.assert_array_equal(near.index[0], [np.arange(4)] * 3)


def test_answers_do_not_depend_on_the_batch():
    """A shared world asked by 50 runs at once, one at a time, and point by point: the same bits."""
    rng = np.random.default_rng(4)
    obstacles = ObstacleSet.from_shapes(mixed(rng, 200))
    points = rng.uniform(0.0, 2000.0, (50, 4, 3))
    whole = obstacles.nearest(points)
    near = obstacles.near(points, 200.0, limit=6)
    for run in range(50):
        part = obstacles.nearest(points[run : run + 1])
        few = obstacles.near(points[run : run + 1], 200.0, limit=6)
        for one, many in zip(
            (*part, few.distance, few.gradient, few.index),
            (*whole, near.distance, near.gradient, near.index),
            strict=True,
        ):
            assert one[0].tobytes() == many[run].tobytes()
    alone = obstacles.nearest(points.reshape(200, 1, 3))
    assert alone[0].tobytes() == whole[0].tobytes()


def test_many_scenes_at_once_are_the_same_as_shapes_one_by_one():
    rng = np.random.default_rng(6)
    centres, radii = rng.uniform(-50.0, 50.0, (7, 9, 3)), rng.uniform(0.5, 5.0, (7, 9))
    points = rng.uniform(-60.0, 60.0, (7, 20, 3))
    spheres = ObstacleSet.from_spheres(centres, radii)
    posts = ObstacleSet.from_cylinders(centres[..., :2], radii)
    stubs = ObstacleSet.from_cylinders(centres[..., :2], radii, base=-3.0, top=centres[..., 2] + 60.0)
    for run in range(7):
        one = [Sphere(tuple(c), r) for c, r in zip(centres[run], radii[run], strict=True)]
        two = [Cylinder(tuple(c[:2]), r) for c, r in zip(centres[run], radii[run], strict=True)]
        three = [
            Cylinder(tuple(c[:2]), r, -3.0, c[2] + 60.0)
            for c, r in zip(centres[run], radii[run], strict=True)
        ]
        for many, shapes in ((spheres, one), (posts, two), (stubs, three)):
            assert many.shapes(run) == shapes
            expected = ObstacleSet.from_shapes(shapes).nearest(points[run : run + 1])
            for a, b in zip(many.nearest(points), expected, strict=True):
                assert a[run].tobytes() == b[0].tobytes()


def test_an_empty_world_is_infinitely_far():
    for empty in (
        ObstacleSet.empty(),
        ObstacleSet.from_shapes([]),
        ObstacleSet.from_spheres(np.zeros((1, 0, 3)), 1.0),
    ):
        assert len(empty) == 0
        distance, gradient, index = empty.nearest(np.zeros((5, 2, 3)))
        assert (distance == np.inf).all()
        assert (gradient == 0.0).all()
        assert (index == -1).all()
        assert empty.near(np.zeros((5, 2, 3)), np.inf).index.shape == (5, 2, 0)
        assert (empty.near(np.zeros((5, 2, 3)), np.inf, limit=2).distance == np.inf).all()
        assert (empty.bounds()[0] == np.inf).all()
    assert ObstacleSet.empty(3).n_scenes == 3


def test_bounds_hold_every_obstacle_tightly():
    shapes = [
        Sphere((0.0, 0.0, 10.0), 2.0),
        Box((10.0, 0.0, 5.0), (2.0, 4.0, 10.0), np.pi / 2),
        Prism((np.array([(3.0, 3.0), (4.0, 3.0), (4.0, 9.0)]),), -1.0, 30.0),
    ]
    lower, upper = ObstacleSet.from_shapes(shapes).bounds()
    np.testing.assert_allclose(lower, (-2.0, -2.0, -1.0))
    np.testing.assert_allclose(upper, (12.0, 9.0, 30.0))
    assert ObstacleSet.from_shapes([*shapes, Cylinder((0, 0), 1.0)]).bounds()[1][2] == np.inf


def test_tree_holds_every_obstacle_once_however_they_lie():
    """Coinciding boxes, endless boxes and one point on a line: none may loop for ever or be lost."""
    n = 1000
    flat = np.zeros((n, 3))
    endless = np.full((n, 3), np.inf)
    row = np.arange(n, dtype=float)[:, None] * (1.0, 0.0, 0.0)
    for lower, upper in ((flat, flat), (-endless, endless), (row, row), (-row, row)):
        tree = plant(lower, upper, np.array([0, n]), 4)
        leaves = tree.right < 0
        assert tree.size[leaves].sum() == n
        assert tree.size[leaves].max() <= 4
        assert sorted(tree.order) == list(range(n))


def test_points_that_are_not_usable_are_named():
    obstacles = ObstacleSet.from_shapes([Sphere((0.0, 0.0, 0.0), 1.0)])
    for bad in (np.nan, np.inf):
        points = np.zeros((3, 2, 3))
        points[1, 1, 2] = bad
        for query in (obstacles.nearest, obstacles.signed_distance, lambda p: obstacles.near(p, 1.0)):
            with pytest.raises(ValueError, match=r"points\[1, 1\] = .*must be finite"):
                query(points)
    with pytest.raises(ValueError, match="three axes"):
        obstacles.nearest(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="reach holds NaN"):
        obstacles.near(np.zeros((1, 1, 3)), np.nan)
    with pytest.raises(ValueError, match="limit = -1"):
        obstacles.near(np.zeros((1, 1, 3)), 1.0, limit=-1)
    with pytest.raises(ValueError, match=r"radii\[0, 1\] = 0.0"):
        ObstacleSet.from_spheres(np.zeros((1, 2, 3)), [[1.0, 0.0]])
    with pytest.raises(ValueError, match="must broadcast"):
        ObstacleSet.from_spheres(np.zeros((1, 2, 3)), np.ones(3))
    with pytest.raises(ValueError, match=r"centres\[0, 0\]"):
        ObstacleSet.from_spheres(np.full((1, 2, 3), np.nan), 1.0)
    with pytest.raises(ValueError, match="top must be above base"):
        ObstacleSet.from_cylinders(np.zeros((1, 2, 2)), 1.0, 2.0, 1.0)
    with pytest.raises(TypeError, match=r"shapes\[0\] is of type str"):
        ObstacleSet.from_shapes(["sphere"])
    with pytest.raises(IndexError, match="scene 1 does not exist"):
        obstacles.scene(1)
    with pytest.raises(ValueError, match="at least one"):
        ObstacleSet.stack([])
