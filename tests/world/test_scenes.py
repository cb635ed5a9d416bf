import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from napf_mpc.errors import SceneError
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.problem import (
    BoxObstacle,
    CylinderObstacle,
    EmptyWorld,
    Forest,
    Lanes,
    ObstacleList,
    PrismObstacle,
    Scatter,
    SphereObstacle,
    Square,
    StreetCanyon,
)
from napf_mpc.streams import Stream, generator
from napf_mpc.world.apart import ApartRules, place_apart
from napf_mpc.world.scenes import build_scenes, lanes_from_uniforms
from napf_mpc.world.shapes import Box, Cylinder, Prism, Sphere

LANES = formation_offsets(Square(shape="square"))[:, 1]
EAST = PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0)
NORTH = PathFrame.from_angles((0.0, 0.0, 0.0), math.pi / 2, 0.0)

RANDOM_WORLDS = [
    Lanes(kind="lanes"),
    Scatter(kind="scatter"),
    Forest(kind="forest"),
    StreetCanyon(kind="street_canyon"),
]
random_worlds = pytest.mark.parametrize("world", RANDOM_WORLDS, ids=lambda world: world.kind)


def build(world, runs=range(1), seed=7, frame=EAST):
    return build_scenes(world, frame, LANES, seed, runs)


def rows(obstacles, scene):
    """Shapes of a scene as plain rows: centre, size, heights."""
    out = []
    for shape in obstacles.shapes(scene):
        match shape:
            case Sphere():
                out.append((*shape.centre_m, shape.radius_m))
            case Cylinder():
                out.append((*shape.centre_m, shape.radius_m, shape.base_m, shape.top_m))
            case Box():
                out.append((*shape.centre_m, *shape.size_m, shape.heading_rad))
    return out


def spheres(world, runs, seed=7, frame=EAST):
    """Centres (run, n, 3) and radii (run, n)."""
    obstacles = build(world, runs, seed, frame)
    data = np.array([rows(obstacles, i) for i in range(len(runs))])
    return data[..., :3], data[..., 3]


def smallest_gaps(xy, radii):
    """Least surface gap of each scene in the horizontal plane, by brute force (run,)."""
    apart = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1) - radii[:, :, None] - radii[:, None]
    apart[:, np.arange(xy.shape[1]), np.arange(xy.shape[1])] = np.inf
    return apart.min(axis=(1, 2))


# ---------------------------------------------------------------------------------------------- lanes


def test_lanes_hold_one_obstacle_in_each_stratum_near_a_lane():
    centres, radii = spheres(Lanes(kind="lanes"), range(400))
    edges = 20.0 + 10.0 * np.arange(9)
    assert np.all(centres[..., 0] >= edges[:-1])
    assert np.all(centres[..., 0] <= edges[1:])
    off_lane = np.abs(centres[..., 1, None] - LANES)
    assert off_lane.min(axis=-1).max() <= 1.0
    assert np.abs(centres[..., 2]).max() <= 1.0
    assert radii.min() >= 0.5
    assert radii.max() <= 2.0
    # Uniform, not only bounded: mean and spread of 3200 numbers, five standard errors wide.
    for values, low, high in (
        (centres[..., 0] - edges[:-1], 0.0, 10.0),
        (centres[..., 2], -1.0, 1.0),
        (radii, 0.5, 2.0),
    ):
        sigma = (high - low) / math.sqrt(12.0)
        assert values.mean() == pytest.approx((low + high) / 2, abs=5 * sigma / math.sqrt(values.size))
        assert values.std() == pytest.approx(sigma, rel=0.05)
    share = np.bincount(off_lane.argmin(axis=-1).ravel(), minlength=4) / radii.size
    assert share == pytest.approx([0.25] * 4, abs=5 * math.sqrt(0.25 * 0.75 / radii.size))


def test_lanes_are_a_map_of_uniforms():
    world = Lanes(kind="lanes", count=2, along_range_m=(0.0, 20.0), radius_m=(1.0, 3.0))
    u = np.array([[0.5, 0.0, 0.5, 0.5, 0.0], [0.25, 0.999999, 1.0, 0.0, 0.5]])
    places, radii = lanes_from_uniforms(world, np.array([-6.0, 6.0]), u)
    assert places == pytest.approx(np.array([[5.0, -6.0, 0.0], [12.5, 7.0, -1.0]]))
    assert radii == pytest.approx([1.0, 2.0])
    # A uniform of one, which a quantile map may return, still names a lane.
    places, _ = lanes_from_uniforms(world, np.array([-6.0, 6.0]), np.ones((2, 5)))
    assert places[:, 1] == pytest.approx([7.0, 7.0])


# -------------------------------------------------------------------------------------------- scatter


def test_scatter_keeps_its_gap_and_its_box():
    centres, radii = spheres(Scatter(kind="scatter"), range(200))
    gaps = smallest_gaps(centres[..., :2], radii)
    assert gaps.min() >= 2.0 - 1e-9
    # And no more than asked: some pairs of 200 scenes come close to it.
    assert gaps.min() < 2.05
    low, high = centres.min(axis=(0, 1)), centres.max(axis=(0, 1))
    assert low == pytest.approx([20.0, -20.0, -3.0], abs=0.1)
    assert high == pytest.approx([110.0, 20.0, 3.0], abs=0.1)
    assert np.all(low >= [20.0, -20.0, -3.0])
    assert np.all(high <= [110.0, 20.0, 3.0])


@pytest.mark.parametrize("climb_deg", [-45.0, 20.0])
def test_scatter_keeps_its_gap_in_the_horizontal_plane_of_a_climbing_path(climb_deg):
    frame = PathFrame.from_angles((5.0, -3.0, 40.0), 1.0, math.radians(climb_deg))
    world = Scatter(kind="scatter", height_range_m=(-15.0, 15.0), lateral_range_m=(-40.0, 40.0))
    centres, radii = spheres(world, range(50), frame=frame)
    assert smallest_gaps(centres[..., :2], radii).min() >= 2.0 - 1e-9
    path = frame.to_path(centres)
    assert path[..., 0].min() >= 20.0 - 1e-9
    assert path[..., 0].max() <= 110.0 + 1e-9
    assert np.abs(path[..., 2]).max() <= 15.0 + 1e-9


def test_crowding_does_not_make_the_late_obstacles_small():
    world = Scatter(kind="scatter", along_range_m=(0.0, 60.0), lateral_range_m=(-20.0, 20.0), count=40)
    _, radii = spheres(world, range(600))
    late = radii[:, 30:]
    error = 1.5 / math.sqrt(12.0 * late.size)
    assert late.mean() == pytest.approx(1.25, abs=5 * error)


def plain_placement(u, rules):
    """The same rules without grid, chunks or compilation, as few lines as possible."""
    placed = []
    first = None
    for row in u:
        along = rules.along_m[0] + row[0] * (rules.along_m[1] - rules.along_m[0])
        lateral = rules.lateral_m[0] + row[1] * (rules.lateral_m[1] - rules.lateral_m[0])
        if first is None:
            first = (
                rules.height_m[0] + row[2] * (rules.height_m[1] - rules.height_m[0]),
                rules.radius_m[0] + row[3] * (rules.radius_m[1] - rules.radius_m[0]),
            )
        here = (along, lateral, *first)
        c, s = math.sqrt(1 - rules.climb_sine**2), rules.climb_sine
        if all(
            (c * (here[0] - p[0]) - s * (here[2] - p[2])) ** 2 + (here[1] - p[1]) ** 2
            >= (here[3] + p[3] + rules.min_gap_m) ** 2
            for p in placed
        ):
            placed.append(here)
            first = None
        if len(placed) == rules.count:
            break
    return np.array(placed)


@given(
    count=st.integers(1, 60),
    length=st.floats(0.0, 80.0),
    width=st.floats(0.0, 80.0),
    radius=st.floats(0.1, 4.0),
    gap=st.floats(0.0, 5.0),
    climb=st.floats(-0.7, 0.7),
    seed=st.integers(0, 1000),
)
def test_placement_agrees_with_a_plain_loop(count, length, width, radius, gap, climb, seed):
    rules = ApartRules(
        count, (5.0, 5.0 + length), (-3.0, width - 3.0), (-4.0, 4.0), (0.1, radius), gap, climb
    )
    u = np.random.default_rng(seed).random((300, 4))
    used = 0

    def stream(rows):
        nonlocal used
        used += rows
        return u[used - rows : used]

    placed = place_apart(stream, rules)
    expected = plain_placement(u, rules)
    assert placed == pytest.approx(expected.reshape(-1, 4), abs=1e-12)
    # Whatever did find its place cannot have been called impossible beforehand.
    if len(placed) == count:
        assert not rules.surely_too_many()


def test_area_bound_lets_the_densest_packing_pass():
    # Hexagonal rows of 20 discs of diameter 1 m: tighter than a square grid, and possible.
    row = math.sqrt(3.0) / 2.0
    rules = ApartRules(400, (0.0, 19.5), (0.0, 19 * row), (0.0, 0.0), (0.5, 0.5), 0.0)
    assert not rules.surely_too_many()
    assert ApartRules(500, (0.0, 19.5), (0.0, 19 * row), (0.0, 0.0), (0.5, 0.5), 0.0).surely_too_many()


def test_impossible_scatter_says_what_to_change():
    for count in (60, 100_000):
        crowded = Scatter(kind="scatter", count=count, along_range_m=(0.0, 20.0), lateral_range_m=(0.0, 20.0))
        with pytest.raises(SceneError, match=r"world\.count = \d+ with world\.min_gap_m = 2 m.*lower.*widen"):
            build(crowded)
    point = Scatter(kind="scatter", count=2, along_range_m=(1.0, 1.0), lateral_range_m=(0.0, 0.0))
    with pytest.raises(SceneError, match=r"only 1 found a place"):
        build(point)
    with pytest.raises(SceneError, match=r"20000000 obstacles"):
        build(Scatter(kind="scatter", count=100_000), range(1000))


def test_jammed_and_large_scenes_do_not_hang():
    build(Scatter(kind="scatter", count=3))
    start = time.perf_counter()
    # More than random addition can pack, less than the area bound refuses.
    jammed = Scatter(
        kind="scatter", count=100_000, along_range_m=(0.0, 1300.0), lateral_range_m=(0.0, 1300.0)
    )
    with pytest.raises(SceneError, match="none in 10000 tries"):
        build(jammed)
    wide = Scatter(kind="scatter", count=100_000, along_range_m=(0.0, 1e5), lateral_range_m=(0.0, 50.0))
    assert len(build(wide)) == 100_000
    assert time.perf_counter() - start < 10.0


# ---------------------------------------------------------------------------------- spheres, cylinders


@pytest.mark.parametrize("kind", [Lanes, Scatter])
@pytest.mark.parametrize("climb_deg", [0.0, 10.0])
def test_cylinder_twin_stands_where_the_sphere_hangs(kind, climb_deg):
    frame = PathFrame.from_angles((5.0, -3.0, 40.0), 0.4, math.radians(climb_deg))
    name = kind.__name__.lower()
    balls = build(kind(kind=name), range(3), frame=frame)
    pillars = build(kind(kind=name, shape="cylinder"), range(3), frame=frame)
    for run in range(3):
        ball, pillar = np.array(rows(balls, run)), np.array(rows(pillars, run))
        assert np.array_equal(ball[:, [0, 1, 3]], pillar[:, :3])
        assert np.all(pillar[:, 3] == -np.inf)
        assert np.all(pillar[:, 4] == np.inf)


# ------------------------------------------------------------------------------------------- seeding


@random_worlds
def test_a_run_has_its_scene_whatever_the_other_runs(world):
    few, many = build(world, range(3)), build(world, range(6))
    assert [rows(few, i) for i in range(3)] == [rows(many, i) for i in range(3)]
    assert rows(build(world, range(4, 5)), 0) == rows(many, 4)
    assert rows(build(world, range(5, 1, -2)), 1) == rows(many, 3)


@random_worlds
def test_seeds_and_runs_share_no_scene(world):
    scenes = [row for seed in (0, 1, 2**63 - 1) for row in _first_rows(build(world, range(20), seed))]
    assert len(set(scenes)) == 60


def _first_rows(obstacles):
    return [rows(obstacles, i)[0] for i in range(obstacles.n_scenes)]


@pytest.mark.parametrize(
    ("few", "many"),
    [
        (Scatter(kind="scatter", count=12), Scatter(kind="scatter", count=40)),
        (Forest(kind="forest", count=12), Forest(kind="forest", count=120)),
    ],
    ids=["scatter", "forest"],
)
def test_first_obstacles_do_not_change_with_their_number(few, many):
    assert rows(build(few), 0) == rows(build(many), 0)[:12]


def test_masts_do_not_change_with_the_buildings():
    short = build(StreetCanyon(kind="street_canyon", building_length_m=(5.0, 6.0)))
    long = build(StreetCanyon(kind="street_canyon", mast_count=9))
    assert rows(short, 0)[-6:] == rows(long, 0)[-9:-3]


def test_the_scene_is_drawn_from_the_documented_stream():
    u = generator(11, 3, Stream.SCENE).random((8, 5))
    places, radii = lanes_from_uniforms(Lanes(kind="lanes"), LANES, u)
    centres, drawn = spheres(Lanes(kind="lanes"), range(3, 4), seed=11)
    assert np.array_equal(centres[0], places)
    assert np.array_equal(drawn[0], radii)


# -------------------------------------------------------------------------------------------- turning


@random_worlds
def test_turning_the_path_to_the_north_turns_the_scene_exactly(world):
    for plain, turned in zip(build(world).shapes(0), build(world, frame=NORTH).shapes(0), strict=True):
        assert turned.centre_m[:2] == (-plain.centre_m[1], plain.centre_m[0])
        if isinstance(plain, Box):
            assert turned.centre_m[2] == plain.centre_m[2]
            assert turned.size_m == plain.size_m
            assert turned.heading_rad - plain.heading_rad == pytest.approx(math.pi / 2)
        else:
            assert turned.radius_m == plain.radius_m


@given(heading=st.floats(-6.3, 6.3), east=st.floats(-1e3, 1e3), height=st.floats(-50.0, 50.0))
def test_scene_and_path_move_as_one(heading, east, height):
    frame = PathFrame.from_angles((east, 20.0, height), heading, 0.0)
    probe = np.array([[[30.0, 2.0, 1.0], [60.0, -7.0, 3.0], [100.0, 0.0, -1.0]]])
    for world in RANDOM_WORLDS:
        on_ground = isinstance(world, Forest | StreetCanyon)
        there = frame.to_world(probe)
        # What stands on the ground does not rise with the path.
        there[..., 2] -= height if on_ground else 0.0
        moved = build(world, frame=frame).signed_distance(there)
        assert moved == pytest.approx(build(world).signed_distance(probe), abs=1e-8)


# ------------------------------------------------------------------------------------ forest and street


def test_forest_stands_on_its_ground():
    world = Forest(kind="forest", ground_m=12.0)
    frame = PathFrame.from_angles((0.0, 0.0, 30.0), 0.0, math.radians(15.0))
    obstacles = build(world, range(20), frame=frame)
    data = np.array([rows(obstacles, i) for i in range(20)])
    assert data.shape == (20, 120, 5)
    xy, radius, base, top = data[..., :2], data[..., 2], data[..., 3], data[..., 4]
    assert np.all(base == 12.0)
    assert top.min() >= 20.0
    assert top.max() <= 32.0
    assert radius.min() >= 0.2
    assert radius.max() <= 0.6
    # Laid out on level ground: the climb does not pull the trees together.
    assert smallest_gaps(xy, radius).min() >= 3.0 - 1e-9
    assert xy[..., 0].min() >= 20.0
    assert xy[..., 0].max() == pytest.approx(110.0, abs=0.5)
    assert np.abs(xy[..., 1]).max() <= 30.0


def test_street_has_buildings_on_both_sides_and_a_free_middle():
    world = StreetCanyon(kind="street_canyon", ground_m=-5.0)
    obstacles = build(world, range(50))
    for run in range(50):
        shapes = obstacles.shapes(run)
        houses = [shape for shape in shapes if isinstance(shape, Box)]
        masts = [shape for shape in shapes if isinstance(shape, Cylinder)]
        assert len(masts) == 6
        for side in (1.0, -1.0):
            row = [house for house in houses if side * house.centre_m[1] > 0]
            starts = np.array([house.centre_m[0] - house.size_m[0] / 2 for house in row])
            ends = np.array([house.centre_m[0] + house.size_m[0] / 2 for house in row])
            fronts = np.array([side * house.centre_m[1] - house.size_m[1] / 2 for house in row])
            heights = np.array([house.size_m[2] for house in row])
            assert starts[0] == pytest.approx(15.0)
            assert starts[1:] - ends[:-1] == pytest.approx([4.0] * (len(row) - 1))
            # Cut at the end, and no front shorter than the shortest or longer than the longest.
            assert ends[-1] <= 115.0 + 1e-9
            assert ends[-1] > 115.0 - 4.0 - 15.0
            assert (ends - starts).min() >= 15.0 - 1e-9
            assert (ends - starts).max() <= 40.0 + 1e-9
            assert fronts.min() >= 14.0 - 1e-9
            assert fronts.max() <= 20.0 + 1e-9
            assert heights.min() >= 15.0
            assert heights.max() <= 60.0
            assert all(house.centre_m[2] - house.size_m[2] / 2 == pytest.approx(-5.0) for house in row)
        for mast in masts:
            assert 15.0 <= mast.centre_m[0] <= 115.0
            assert abs(mast.centre_m[1]) + mast.radius_m <= 14.0 + 1e-9
            assert mast.base_m == -5.0
            assert 25.0 <= mast.top_m <= 55.0
            assert 0.2 <= mast.radius_m <= 0.5


def test_street_that_cannot_be_built_says_so():
    for changes, named in (
        ({"along_range_m": (0.0, 10.0)}, r"along_range_m spans 10 m.*building_length_m\[0\] = 15 m"),
        ({"setback_m": 20.0}, r"setback_m = 20 m.*closes the street.*street_width_m = 40 m"),
        ({"along_range_m": (0.0, 1e6), "building_length_m": (0.01, 1.0), "gap_m": 0.0}, "at most 100000"),
    ):
        with pytest.raises(SceneError, match=named):
            build(StreetCanyon(kind="street_canyon", **changes))


# ----------------------------------------------------------------------------------------- fixed worlds


def test_empty_and_listed_worlds_are_one_scene_for_all_runs():
    empty = build(EmptyWorld(kind="empty"), range(5))
    assert (empty.n_scenes, len(empty)) == (1, 0)
    world = ObstacleList(
        kind="list",
        obstacles=(
            SphereObstacle(shape="sphere", centre_m=(1.0, 2.0, 3.0), radius_m=4.0),
            CylinderObstacle(shape="cylinder", centre_m=(1.0, 2.0), radius_m=0.5),
            CylinderObstacle(shape="cylinder", centre_m=(1.0, 2.0), radius_m=0.5, base_m=-1.0, top_m=6.0),
            BoxObstacle(shape="box", centre_m=(9.0, 8.0, 7.0), size_m=(3.0, 2.0, 1.0), heading_deg=30.0),
            PrismObstacle(shape="prism", footprint_m=((0.0, 0.0), (4.0, 0.0), (0.0, 3.0)), top_m=5.0),
        ),
    )
    # Listed obstacles are where they are: the path's frame does not move them.
    obstacles = build(world, range(5), frame=NORTH)
    assert obstacles.n_scenes == 1
    ball, endless, pillar, box, prism = obstacles.shapes(0)
    assert ball == Sphere((1.0, 2.0, 3.0), 4.0)
    assert endless == Cylinder((1.0, 2.0), 0.5, -math.inf, math.inf)
    assert pillar == Cylinder((1.0, 2.0), 0.5, -1.0, 6.0)
    assert box.heading_rad == pytest.approx(math.radians(30.0))
    assert isinstance(prism, Prism)
    assert (prism.base_m, prism.top_m) == (0.0, 5.0)
    assert {tuple(corner) for corner in prism.rings[0].tolist()} == {(0.0, 0.0), (4.0, 0.0), (0.0, 3.0)}


def test_a_listed_prism_that_is_no_solid_is_named():
    # Corners so flat that the problem's own check, in absolute numbers, lets them pass.
    corners = ((0.0, 0.0), (1e6, 0.0), (5e5, 1e-8))
    bad = PrismObstacle(shape="prism", footprint_m=corners, top_m=5.0)
    good = SphereObstacle(shape="sphere", centre_m=(0.0, 0.0, 0.0), radius_m=1.0)
    with pytest.raises(SceneError, match=r"world\.obstacles\[1\]"):
        build(ObstacleList(kind="list", obstacles=(good, bad)))


@pytest.mark.parametrize(
    "world",
    [
        Lanes(kind="lanes", count=0),
        Scatter(kind="scatter", count=0),
        Scatter(kind="scatter", count=0, shape="cylinder"),
        Forest(kind="forest", count=0),
        ObstacleList(kind="list", obstacles=()),
    ],
    ids=["lanes", "scatter", "cylinders", "forest", "list"],
)
def test_no_obstacles_is_a_world_too(world):
    obstacles = build(world, range(4))
    assert len(obstacles) == 0
    assert np.all(obstacles.signed_distance(np.zeros((4, 2, 3))) == np.inf)


def test_ranges_may_be_a_point():
    world = Scatter(
        kind="scatter",
        count=1,
        along_range_m=(3.0, 3.0),
        lateral_range_m=(2.0, 2.0),
        height_range_m=(1.0, 1.0),
    )
    centres, _ = spheres(world, range(2))
    assert centres == pytest.approx(np.broadcast_to([3.0, 2.0, 1.0], (2, 1, 3)))
    centres, _ = spheres(Lanes(kind="lanes", along_range_m=(50.0, 50.0)), range(2))
    assert np.all(centres[..., 0] == 50.0)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="runs is empty"):
        build(Lanes(kind="lanes"), range(0))
    for lanes in (np.array([1.0, np.nan]), np.array([]), np.zeros((2, 2))):
        with pytest.raises(ValueError, match="lateral_lanes"):
            build_scenes(Lanes(kind="lanes"), EAST, lanes, 0, range(1))
