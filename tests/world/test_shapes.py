"""Distances and gradients of single solids against shapely, FCL and first principles."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from napf_mpc.world.audit import audit_clearance
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Sphere

UNIT_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
ELL = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 8.0), (9.0, 8.0), (9.0, 15.0), (0.0, 15.0)])
COURT = [np.array([(0.0, 0.0), (30.0, 0.0), (30.0, 20.0), (0.0, 20.0)]), UNIT_SQUARE * 6.0 + (5.0, 8.0)]


def star(rng, corners=9):
    """Ring of a star-shaped polygon, mostly not convex, 2 to 20 m across, anywhere within 200 m."""
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, corners)) + np.linspace(0.0, 0.1, corners)
    radius = rng.uniform(0.3, 1.0, corners) * rng.uniform(2.0, 20.0)
    return rng.uniform(-200.0, 200.0, 2) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def random_shape(rng, kind):
    x, y, z = rng.uniform(-200.0, 200.0, 3)
    low, high = np.sort(rng.uniform(-100.0, 100.0, 2)) + np.array([0.0, 0.1])
    size = np.exp(rng.uniform(np.log(0.1), np.log(50.0), 3))
    if kind == "sphere":
        return Sphere((x, y, z), size[0])
    if kind == "cylinder":
        return Cylinder((x, y), size[0], low, high)
    if kind == "box":
        return Box((x, y, z), tuple(size), rng.uniform(-7.0, 7.0))
    return Prism((star(rng),), low, high)


def look(shape, points):
    """Distances and gradients of one shape at points (k, 3)."""
    distance, gradient, _ = ObstacleSet.from_shapes([shape]).nearest(np.asarray(points, dtype=float)[None])
    return distance[0], gradient[0]


def points_about(rng, shape, count):
    """Points in and about a shape, most of them within a few sizes."""
    lower, upper = ObstacleSet.from_shapes([shape]).bounds()
    lower, upper = np.clip(lower, -300.0, 300.0), np.clip(upper, -300.0, 300.0)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    return middle + half * rng.normal(0.0, 1.5, (count, 3))


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "box", "prism"])
def test_distance_agrees_with_fcl_on_1000_random_cases_of_each_kind(kind):
    """An independent library finds the same clearance, contact included, to a nanometre."""
    rng = np.random.default_rng(["sphere", "cylinder", "box", "prism"].index(kind))
    touching = 0
    for _ in range(100):
        shape = random_shape(rng, kind)
        points = points_about(rng, shape, 10)
        expected = audit_clearance([shape], points, 0.2)
        found = np.maximum(look(shape, points)[0] - 0.2, 0.0)
        touching += int((found == 0.0).sum())
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert touching > 30


@pytest.mark.parametrize("kind", ["cylinder", "box", "prism", "court", "parts"])
def test_footprint_distance_and_gradient_agree_with_shapely(kind):
    """In the plane: distance to shapely's outline, sign by its contains, gradient to its nearest point."""
    rng = np.random.default_rng(5)
    checked = 0
    for _ in range(24):
        rings = [star(rng)]
        corner = rng.uniform(-99.0, 99.0, 2)
        if kind == "box":
            box = Box(
                (*rng.uniform(-99.0, 99.0, 2), 0.0), (*rng.uniform(0.5, 30.0, 2), 1e6), rng.uniform(-7, 7)
            )
            turn = np.array(
                [
                    [math.cos(box.heading_rad), -math.sin(box.heading_rad)],
                    [math.sin(box.heading_rad), math.cos(box.heading_rad)],
                ]
            )
            rings = [box.centre_m[:2] + (UNIT_SQUARE - 0.5) * box.size_m[:2] @ turn.T]
            shape = box
        elif kind == "cylinder":
            shape = Cylinder(tuple(rng.uniform(-99.0, 99.0, 2)), rng.uniform(0.5, 20.0))
        elif kind == "court":
            rings = [ring + corner for ring in COURT]
            shape = Prism(tuple(rings))
        elif kind == "parts":
            rings = [rings[0], star(rng) + np.array([1000.0, 0.0])]
            shape = Prism(tuple(rings))
        else:
            shape = Prism(tuple(rings))
        points = points_about(rng, shape, 50)
        distance, gradient = look(shape, points)
        if kind == "cylinder":
            # shapely has no circles: the point's distance to the centre is its whole knowledge of them.
            axis = shapely.Point(shape.centre_m)
            outside = shapely.distance(axis, shapely.points(points[:, :2])) - shape.radius_m
            np.testing.assert_allclose(distance, outside, atol=1e-10)
        else:
            area = shapely.Polygon(rings[0])
            for ring in rings[1:]:
                area = area.symmetric_difference(shapely.Polygon(ring))
            marks = shapely.points(points[:, :2])
            inside = shapely.contains_xy(area, points[:, 0], points[:, 1])
            sign = np.where(inside, -1.0, 1.0)
            np.testing.assert_allclose(distance, sign * shapely.distance(area.boundary, marks), atol=1e-10)
            # Along the gradient lies the nearest point of the outline.
            foot = points[:, :2] - distance[:, None] * gradient[:, :2]
            assert shapely.distance(area.boundary, shapely.points(foot)).max() < 1e-9
        np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
        np.testing.assert_array_equal(gradient[:, 2], 0.0)
        checked += len(points)
    assert checked == 1200


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "box", "prism"])
def test_gradient_is_the_slope_of_the_distance(kind):
    """Central differences, except where the nearest face changes within the step."""
    rng = np.random.default_rng(11)
    step = 1e-5
    smooth = 0
    for _ in range(40):
        shape = random_shape(rng, kind)
        points = points_about(rng, shape, 20)
        _, gradient = look(shape, points)
        slope = np.empty_like(gradient)
        bend = np.zeros(len(points), dtype=bool)
        for axis in range(3):
            shift = np.eye(3)[axis] * step
            (ahead, g_ahead), (behind, g_behind) = look(shape, points + shift), look(shape, points - shift)
            slope[:, axis] = (ahead - behind) / (2.0 * step)
            bend |= np.linalg.norm(g_ahead - g_behind, axis=1) > 0.01
        smooth += int((~bend).sum())
        np.testing.assert_allclose(gradient[~bend], slope[~bend], atol=2e-4)
    assert smooth > 700


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "box", "prism"])
def test_distance_never_changes_faster_than_one_moves(kind):
    rng = np.random.default_rng(13)
    for _ in range(40):
        shape = random_shape(rng, kind)
        a, b = points_about(rng, shape, 50), points_about(rng, shape, 50)
        moved = np.linalg.norm(a - b, axis=1)
        assert (np.abs(look(shape, a)[0] - look(shape, b)[0]) <= moved + 1e-9).all()


@given(
    angle=st.floats(-7.0, 7.0),
    shift=st.tuples(*[st.floats(-1000.0, 1000.0)] * 3),
    seed=st.integers(0, 1000),
)
def test_turning_and_shifting_the_world_changes_nothing(angle, shift, seed):
    """Distance stays, gradient turns along."""
    rng = np.random.default_rng(seed)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def moved(p):
        return turn @ np.asarray(p) + shift

    sphere = Sphere(tuple(rng.uniform(-9, 9, 3)), 2.0)
    box = Box(tuple(rng.uniform(-9, 9, 3)), (3.0, 5.0, 8.0), 0.4)
    ring = star(rng)
    pairs = [
        (sphere, Sphere(tuple(moved(sphere.centre_m)), 2.0)),
        (
            Cylinder((3.0, 4.0), 2.0, -1.0, 5.0),
            Cylinder(tuple(moved((3, 4, 0))[:2]), 2.0, shift[2] - 1, shift[2] + 5),
        ),
        (box, Box(tuple(moved(box.centre_m)), box.size_m, 0.4 + angle)),
        (
            Prism((ring,), 0.0, 9.0),
            Prism((ring @ turn[:2, :2].T + np.array(shift[:2]),), shift[2], shift[2] + 9.0),
        ),
    ]
    for before, after in pairs:
        points = points_about(rng, before, 20)
        d0, g0 = look(before, points)
        d1, g1 = look(after, points @ turn.T + np.array(shift))
        np.testing.assert_allclose(d1, d0, atol=1e-9)
        # Within rounding of a tie between two faces either of them may win.
        same = np.linalg.norm(g1 - g0 @ turn.T, axis=1) < 1e-5
        assert same.sum() >= 19


def test_a_prism_and_a_box_of_the_same_form_agree():
    rng = np.random.default_rng(17)
    box = Box((3.0, -2.0, 5.0), (4.0, 6.0, 10.0))
    prism = Prism((np.array([(1.0, -5.0), (5.0, -5.0), (5.0, 1.0), (1.0, 1.0)]),), 0.0, 10.0)
    points = points_about(rng, box, 500)
    (d0, g0), (d1, g1) = look(box, points), look(prism, points)
    np.testing.assert_allclose(d1, d0, atol=1e-12)
    np.testing.assert_allclose(g1, g0, atol=1e-9)


DEGENERATE = [
    ("centre of a sphere", Sphere((1.0, 2.0, 3.0), 2.0), (1.0, 2.0, 3.0), -2.0, (0.0, 0.0, 1.0)),
    ("top of a sphere", Sphere((1.0, 2.0, 3.0), 2.0), (1.0, 2.0, 5.0), 0.0, (0.0, 0.0, 1.0)),
    ("axis of a cylinder", Cylinder((0.0, 0.0), 2.0), (0.0, 0.0, 7.0), -2.0, (1.0, 0.0, 0.0)),
    ("axis above a cylinder", Cylinder((0.0, 0.0), 2.0, 0.0, 5.0), (0.0, 0.0, 7.0), 2.0, (0.0, 0.0, 1.0)),
    ("rim of a cylinder", Cylinder((0.0, 0.0), 2.0, 0.0, 5.0), (2.0, 0.0, 5.0), 0.0, (1.0, 0.0, 0.0)),
    (
        "roof and wall equally near",
        Cylinder((0.0, 0.0), 2.0, 0.0, 9.0),
        (1.0, 0.0, 8.0),
        -1.0,
        (1.0, 0.0, 0.0),
    ),
    (
        "roof and floor equally near",
        Cylinder((0.0, 0.0), 9.0, 0.0, 2.0),
        (1.0, 0.0, 1.0),
        -1.0,
        (0.0, 0.0, 1.0),
    ),
    ("centre of a cube", Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)), (0.0, 0.0, 0.0), -1.0, (1.0, 0.0, 0.0)),
    ("face of a box", Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)), (0.3, -1.0, 0.2), 0.0, (0.0, -1.0, 0.0)),
    ("upright edge of a box", Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)), (-1.0, 1.0, 0.0), 0.0, (-1.0, 0.0, 0.0)),
    ("corner of a box", Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)), (1.0, 1.0, 1.0), 0.0, (1.0, 0.0, 0.0)),
    ("wall of a prism", Prism((UNIT_SQUARE,), 0.0, 9.0), (0.5, 0.0, 4.0), 0.0, (0.0, -1.0, 0.0)),
    (
        "wall of a prism given clockwise",
        Prism((UNIT_SQUARE[::-1],), 0.0, 9.0),
        (1.0, 0.5, 4.0),
        0.0,
        (1.0, 0.0, 0.0),
    ),
    ("roof edge of a prism", Prism((UNIT_SQUARE,), 0.0, 9.0), (0.5, 0.0, 9.0), 0.0, (0.0, -1.0, 0.0)),
    ("first of four equal walls", Prism((UNIT_SQUARE,), 0.0, 9.0), (0.5, 0.5, 4.0), -0.5, (-1.0, 0.0, 0.0)),
    ("wall of a courtyard", Prism(tuple(COURT)), (11.0, 9.0, 4.0), 0.0, (-1.0, 0.0, 0.0)),
]


@pytest.mark.parametrize(
    ("where", "shape", "point", "distance", "gradient"), DEGENERATE, ids=[d[0] for d in DEGENERATE]
)
def test_degenerate_points_have_the_documented_answer(where, shape, point, distance, gradient):
    d, g = look(shape, [point])
    assert d[0] == pytest.approx(distance, abs=1e-12)
    np.testing.assert_allclose(g[0], gradient, atol=1e-12)


def test_corner_of_a_prism_gets_the_normal_of_one_of_its_walls():
    for corner in ELL:
        _, g = look(Prism((ELL,), 0.0, 9.0), [(*corner, 4.0)])
        assert sorted(np.abs(g[0])) == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "box", "prism"])
def test_never_nan_however_near_or_far(kind):
    """From a nanometre of every vertex to distances whose square overflows."""
    rng = np.random.default_rng(19)
    for _ in range(20):
        shape = random_shape(rng, kind)
        lower, upper = ObstacleSet.from_shapes([shape]).bounds()
        spots = [lower, upper, 0.5 * (lower + upper), np.array([*lower[:2], upper[2]])]
        if kind == "prism":
            spots += [
                np.array([*vertex, z]) for vertex in shape.rings[0] for z in (shape.base_m, shape.top_m)
            ]
        points = [
            spot + scale * rng.normal(size=3) for spot in spots for scale in (0, 1e-15, 1e-12, 1e-9, 1e-6)
        ]
        points += [scale * rng.normal(size=3) for scale in (1e6, 1e12, 1e200)]
        d, g = look(shape, points)
        assert np.isfinite(d).all()
        np.testing.assert_allclose(np.linalg.norm(g, axis=1), 1.0, atol=1e-9)


def test_a_ring_that_crosses_itself_follows_the_even_odd_rule():
    """Pentagram: the points are solid, the middle is a hole."""
    angle = np.pi / 2 + np.arange(5) * 4 * np.pi / 5
    shape = Prism((np.stack([np.cos(angle), np.sin(angle)], axis=-1),))
    d, g = look(shape, [(0.0, 0.01, 0.0), (0.0, 0.9, 0.0), (0.0, 1.1, 0.0)])
    assert d[0] == pytest.approx(math.cos(math.radians(72.0)) - 0.01)
    assert d[1] < -0.01
    assert d[2] == pytest.approx(0.1)
    np.testing.assert_allclose(g[2], (0.0, 1.0, 0.0), atol=1e-9)
    ahead = look(shape, [(0.0, 0.01, 0.0) + 1e-4 * g[0], (0.0, 0.9, 0.0) + 1e-4 * g[1]])[0]
    assert ahead[0] > d[0]
    assert ahead[1] > d[1]


NAN, INF = math.nan, math.inf
BAD = [
    (lambda: Sphere((0, 0, NAN), 1.0), r"Sphere\.centre_m"),
    (lambda: Sphere((0, 0), 1.0), r"Sphere\.centre_m .* 3 finite"),
    (lambda: Sphere((0, 0, 0), 0.0), r"Sphere\.radius_m = 0\.0, must be finite and > 0"),
    (lambda: Sphere((0, 0, 0), INF), r"Sphere\.radius_m = inf"),
    (lambda: Cylinder((0, 0), -1.0), r"Cylinder\.radius_m = -1\.0"),
    (lambda: Cylinder((0, 0), 1.0, 5.0, 5.0), "top must be above base"),
    (lambda: Cylinder((0, 0), 1.0, NAN, 5.0), "top must be above base"),
    (lambda: Box((0, 0, 0), (1.0, 0.0, 1.0)), r"Box\.size_m = 0\.0"),
    (lambda: Box((0, 0, 0), (1.0, 1.0, 1.0), NAN), r"Box\.heading_rad"),
    (lambda: Prism(()), "at least one ring"),
    (lambda: Prism((UNIT_SQUARE[:2],)), r"Prism\.rings\[0\] has 2 distinct"),
    (lambda: Prism((UNIT_SQUARE[[0, 1, 1, 0]],)), r"Prism\.rings\[0\] has 2 distinct"),
    (lambda: Prism((UNIT_SQUARE, [(0, 0), (1, 1), (2, 2)])), r"Prism\.rings\[1\] has no area"),
    (lambda: Prism((UNIT_SQUARE * NAN,)), "not finite"),
    (lambda: Prism((np.zeros((4, 3)),)), r"must be \(vertex, 2\)"),
    (lambda: Prism((UNIT_SQUARE,), 3.0, 2.0), "top must be above base"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_shapes_that_cannot_be_are_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_closed_ring_is_the_same_prism():
    closed = Prism((np.vstack([ELL, ELL[:1]]),), 0.0, 9.0)
    np.testing.assert_array_equal(closed.rings[0], Prism((ELL,), 0.0, 9.0).rings[0])
