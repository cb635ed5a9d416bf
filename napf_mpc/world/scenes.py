"""Scenes: the obstacles of each run, drawn from the run's own random stream or given for all runs.

Random scenes are maps from uniform numbers, so that a method for rare events can drive them; only
`build_scenes` draws. Random places are given along the path, to its left and up from it. The scenes of the
paper, ``lanes`` (8 obstacles) and ``scatter`` (40), follow a climbing path. What stands on the ground,
``forest`` and ``street_canyon``, is laid out on level ground under the path's heading. What would stand on
a UAV's initial place is drawn again, with further numbers of its own run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import SceneError
from napf_mpc.formation import PathFrame
from napf_mpc.problem import (
    BoxObstacle,
    City,
    CylinderObstacle,
    EmptyWorld,
    Forest,
    Lanes,
    ObstacleItem,
    ObstacleList,
    PrismObstacle,
    Scatter,
    SphereObstacle,
    StreetCanyon,
    World,
)
from napf_mpc.streams import Seed, Stream, generator
from napf_mpc.world.apart import MAX_TRIES, ApartRules, place_apart
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere
from napf_mpc.world.starts import Starts

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_OBSTACLES = 20_000_000
"""Obstacles of all scenes together: about two gigabytes."""

MAX_FRONTS = 100_000
"""Buildings on one side of a street."""


def build_scenes(
    world: World,
    frame: PathFrame,
    lateral_lanes: Array,
    seed: Seed,
    runs: range,
    data_folder: Path | None = None,
    starts: Starts | None = None,
) -> ObstacleSet:
    """Obstacles of some runs of a campaign.

    Parameters
    ----------
    world : World
        The problem's world.
    frame : PathFrame
        Frame of the path; random scenes are placed in it, listed obstacles and cities are not.
    lateral_lanes : array, shape (uav,)
        Lateral place of each UAV of the formation [m], for ``lanes``.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Indices of the runs. A scene depends on the seed and its run's index only.
    data_folder : Path, optional
        Where city files are looked for, see `napf_mpc.data_folder.find_data_file`.
    starts : Starts, optional
        Where UAVs start: random obstacles keep clear of it, listed obstacles and cities must not touch it.

    Returns
    -------
    ObstacleSet
        One scene for each run, or a single scene for all of them (empty, list, city).

    Raises
    ------
    SceneError
        If the obstacles do not fit, or a UAV would start in contact with one.
    DataError
        If a city file cannot be used.
    ValueError
        If there is no run or a lane is not finite.
    """
    lanes = np.asarray(lateral_lanes, dtype=np.float64)
    if len(runs) == 0:
        raise ValueError("runs is empty: a scene needs a run")
    if lanes.ndim != 1 or lanes.size == 0 or not np.isfinite(lanes).all():
        raise ValueError(f"lateral_lanes = {lanes.tolist()}, must be at least one finite number in a row")
    starts = Starts() if starts is None else starts
    match world:
        case EmptyWorld():
            return ObstacleSet.empty()
        case ObstacleList():
            listed = ObstacleSet.from_shapes(
                [_listed(f"world.obstacles[{i}]", item) for i, item in enumerate(world.obstacles)]
            )
            starts.refuse_contact(listed, lambda i: f"world.obstacles[{i}]")
            return listed
        case City():
            # Reading polygons costs an import that no other world needs.
            from napf_mpc.world.city import load_city

            city = load_city(world, data_folder)
            starts.refuse_contact(city, lambda _: f'a building of world.file = "{world.file}"')
            return city
        case StreetCanyon():
            return ObstacleSet.stack([_street(world, frame, seed, run, starts) for run in runs])
        case Lanes():
            _check_size(world.count, runs)
            drawn = [_lanes(world, frame, lanes, seed, run, starts) for run in runs]
            places, radii = (np.stack(rows) for rows in zip(*drawn, strict=True))
            return _round_scenes(world, frame, places, radii)
        case Scatter():
            placed = _draw_apart(scatter_rules(world, frame, starts), seed, runs)
            return _round_scenes(world, frame, placed[..., :3], placed[..., 3])
        case Forest():
            placed = _draw_apart(forest_rules(world, frame, starts), seed, runs)
            trunks = _on_ground(frame, placed[..., 0], placed[..., 1])
            top = world.ground_m + placed[..., 2]
            return ObstacleSet.from_cylinders(trunks, placed[..., 3], world.ground_m, top)


def lanes_from_uniforms(
    world: Lanes, lateral_lanes: Array, u: Array, strata: NDArray[np.int64] | None = None
) -> tuple[Array, Array]:
    """Map uniforms to the paper's obstacles on the lanes: one in each along-track stratum.

    Along track uniform in the obstacle's stratum; lateral place a random lane plus U(-jitter, jitter); height
    U(-jitter, jitter) about the path; radius uniform.

    Parameters
    ----------
    world : Lanes
        Number, ranges and jitters.
    lateral_lanes : array, shape (uav,)
        Lateral place of each UAV [m].
    u : array, shape (..., n, 5)
        Uniforms on [0, 1): place in the stratum, lane, lateral jitter, height, radius.
    strata : array of int, shape (n,), optional
        Stratum of each obstacle; by default those of all obstacles, in order.

    Returns
    -------
    places : array, shape (..., n, 3)
        Along, left, up [m].
    radii : array, shape (..., n)
        Radii [m].
    """
    strata = np.arange(world.count) if strata is None else strata
    low, high = world.along_range_m
    along = low + (strata + u[..., 0]) * ((high - low) / max(world.count, 1))
    lane = np.minimum((u[..., 1] * len(lateral_lanes)).astype(np.int64), len(lateral_lanes) - 1)
    lateral = lateral_lanes[lane] + (2.0 * u[..., 2] - 1.0) * world.lane_jitter_m
    height = (2.0 * u[..., 3] - 1.0) * world.height_jitter_m
    return np.stack([along, lateral, height], axis=-1), _between(world.radius_m, u[..., 4])


def scatter_rules(world: Scatter, frame: PathFrame, starts: Starts) -> ApartRules:
    """Rules for `place_apart` that make the paper's scattered obstacles.

    Spheres and cylinders share them, but for what they cover above and below.
    """
    onward = math.inf if world.shape == "cylinder" else 0.0
    return ApartRules(
        world.count,
        world.along_range_m,
        world.lateral_range_m,
        world.height_range_m,
        world.radius_m,
        world.min_gap_m,
        float(frame.along[2]),
        _level(frame, starts, float(frame.origin[2])),
        starts.reach_m,
        onward,
        onward,
    )


def forest_rules(world: Forest, frame: PathFrame, starts: Starts) -> ApartRules:
    """Rules for `place_apart` that make a forest; its height column is the height of the trees."""
    return ApartRules(
        world.count,
        world.along_range_m,
        world.lateral_range_m,
        world.tree_height_m,
        world.radius_m,
        world.min_gap_m,
        0.0,
        _level(frame, starts, world.ground_m),
        starts.reach_m,
        math.inf,
    )


def fronts_from_uniforms(world: StreetCanyon, u: Array) -> Array:
    """Map uniforms to the buildings on one side of a street, from its start to its end.

    The last front is cut at the street's end, or left out where the rest is shorter than the shortest front.

    Parameters
    ----------
    world : StreetCanyon
        The street.
    u : array, shape (row, 3)
        Uniforms on [0, 1): length, height, place of the front. Rows beyond the street's end are not used.

    Returns
    -------
    array, shape (building, 4)
        Start and length along the street, distance of the front from the street's middle, height [m].
    """
    low, high = world.along_range_m
    length = _between(world.building_length_m, u[:, 0])
    start = low + np.concatenate([[0.0], np.cumsum(length + world.gap_m)[:-1]])
    fits = high - start >= world.building_length_m[0]
    faces = _faces(world, u[:, 1:])
    return np.column_stack([start, np.minimum(length, high - start), faces])[fits]


def _faces(world: StreetCanyon, u: Array) -> Array:
    """Distance of the front and height (building, 2) [m] of uniforms (building, 2): height, place."""
    front = 0.5 * world.street_width_m - u[:, 1] * world.setback_m
    return np.column_stack([front, _between(world.building_height_m, u[:, 0])])


def masts_from_uniforms(world: StreetCanyon, u: Array) -> Array:
    """Map uniforms to masts in the strip of the street that no front reaches.

    Parameters
    ----------
    world : StreetCanyon
        The street.
    u : array, shape (mast, 4)
        Uniforms on [0, 1): along, lateral, radius, height.

    Returns
    -------
    array, shape (mast, 4)
        Along, lateral, radius, height [m].
    """
    radius = _between(world.mast_radius_m, u[:, 2])
    reach = np.maximum(0.5 * world.street_width_m - world.setback_m - radius, 0.0)
    lateral = (2.0 * u[:, 1] - 1.0) * reach
    height = _between(world.mast_height_m, u[:, 3])
    return np.stack([_between(world.along_range_m, u[:, 0]), lateral, radius, height], axis=-1)


def _street(world: StreetCanyon, frame: PathFrame, seed: Seed, run: int, starts: Starts) -> ObstacleSet:
    length = world.along_range_m[1] - world.along_range_m[0]
    shortest = world.building_length_m[0]
    if length < shortest:
        raise SceneError(
            f"world.along_range_m spans {length:g} m, less than the shortest front "
            f"world.building_length_m[0] = {shortest:g} m; lengthen the street or shorten the fronts"
        )
    if 2.0 * world.setback_m >= world.street_width_m:
        raise SceneError(
            f"world.setback_m = {world.setback_m:g} m on both sides closes the street of "
            f"world.street_width_m = {world.street_width_m:g} m; keep setback_m below half the width"
        )
    rows = int((length - shortest) / (shortest + world.gap_m)) + 2
    if rows > MAX_FRONTS:
        raise SceneError(
            f"up to {rows} buildings would fit on a side of the street, at most {MAX_FRONTS} are built; "
            "shorten world.along_range_m or raise world.building_length_m or world.gap_m"
        )
    left = _houses(world, frame, seed, run, starts, rows, axis=0, side=1.0)
    right = _houses(world, frame, seed, run, starts, rows, axis=1, side=-1.0)
    return ObstacleSet.from_shapes([*left, *right, *_masts(world, frame, seed, run, starts)])


def _houses(
    world: StreetCanyon,
    frame: PathFrame,
    seed: Seed,
    run: int,
    starts: Starts,
    rows: int,
    axis: int,
    side: float,
) -> list[Shape]:
    """Houses of one side of a street: those on a UAV's start get another front and height."""
    stream = generator(seed, run, Stream.SCENE, axis=axis)
    fronts = fronts_from_uniforms(world, stream.random((rows, 3)))
    depth = world.building_depth_m

    def houses(which: Index) -> list[Shape]:
        start, length, front, height = fronts[which].T
        middle = _on_ground(frame, start + 0.5 * length, side * (front + 0.5 * depth))
        return [
            Box((x, y, world.ground_m + 0.5 * high), (long, depth, high), frame.heading_rad)
            for (x, y), long, high in zip(middle.tolist(), length.tolist(), height.tolist(), strict=True)
        ]

    def again(which: Index) -> None:
        fronts[which, 2:] = _faces(world, stream.random((len(which), 2)))

    _draw_clear(
        len(fronts), lambda which: ObstacleSet.from_shapes(houses(which)), again, starts,
        f"world.street_width_m = {world.street_width_m:g} m: in run {run} a building stands on",
        "widen the street, shift world.along_range_m",
    )  # fmt: skip
    return houses(np.arange(len(fronts)))


def _masts(world: StreetCanyon, frame: PathFrame, seed: Seed, run: int, starts: Starts) -> list[Shape]:
    """Masts of a street: those on a UAV's start are put elsewhere, with the radius and height they have."""
    stream = generator(seed, run, Stream.SCENE, axis=2)
    u = stream.random((world.mast_count, 4))

    def masts(which: Index) -> list[Shape]:
        drawn = masts_from_uniforms(world, u[which])
        feet = _on_ground(frame, drawn[:, 0], drawn[:, 1])
        return [
            Cylinder((x, y), radius, world.ground_m, world.ground_m + height)
            for (x, y), (_, _, radius, height) in zip(feet.tolist(), drawn.tolist(), strict=True)
        ]

    def again(which: Index) -> None:
        u[which, :2] = stream.random((len(which), 2))

    _draw_clear(
        len(u), lambda which: ObstacleSet.from_shapes(masts(which)), again, starts,
        f"world.mast_count = {world.mast_count}: in run {run} a mast stands on",
        "widen the street, shift world.along_range_m",
    )  # fmt: skip
    return masts(np.arange(len(u)))


def _lanes(
    world: Lanes, frame: PathFrame, lanes: Array, seed: Seed, run: int, starts: Starts
) -> tuple[Array, Array]:
    """Places (count, 3) and radii (count,) of a run: what is on a UAV's start moves, in its stratum."""
    stream = generator(seed, run, Stream.SCENE)
    u = stream.random((world.count, 5))

    def obstacles(which: Index) -> ObstacleSet:
        places, radii = lanes_from_uniforms(world, lanes, u[which], which)
        return _round_scenes(world, frame, places[None], radii[None])

    def again(which: Index) -> None:
        u[which, :3] = stream.random((len(which), 3))

    _draw_clear(
        len(u), obstacles, again, starts,
        f"world.along_range_m = {list(world.along_range_m)} m: in run {run} an obstacle stands on",
        "shift the range, raise world.lane_jitter_m",
    )  # fmt: skip
    return lanes_from_uniforms(world, lanes, u)


def _draw_clear(
    count: int,
    obstacles: Callable[[Index], ObstacleSet],
    again: Callable[[Index], None],
    starts: Starts,
    asked: str,
    way_out: str,
) -> None:
    """Draw again those of a run's obstacles that stand on a UAV's start, until none does.

    Parameters
    ----------
    count : int
        Number of obstacles.
    obstacles, again : callable
        ``obstacles(which)`` makes some of them, ``again(which)`` draws their places anew.
    starts : Starts
        What to stay clear of.
    asked, way_out : str
        Words for what cannot be.
    """
    which = np.arange(count)
    for _ in range(MAX_TRIES):
        which = which[starts.too_near(obstacles(which))]
        if not len(which):
            return
        again(which)
    raise SceneError(
        f"{asked} a UAV's initial place, nearer than {starts.reach_m:g} m, wherever it is put in {MAX_TRIES} "
        f"tries; {way_out}, or move the UAVs ({starts.keys})"
    )


def _draw_apart(rules: ApartRules, seed: Seed, runs: range) -> Array:
    """Place the obstacles of each run, shape (run, count, 4), or say what is asked too much."""
    _check_size(rules.count, runs)
    way_out = (
        "lower world.count, world.min_gap_m or world.radius_m, or widen world.along_range_m or "
        "world.lateral_range_m"
    )
    taken = ", clear of the UAVs' initial places" if rules.starts_m else ""
    asked = f"world.count = {rules.count} with world.min_gap_m = {rules.min_gap_m:g} m"
    if rules.surely_too_many():
        raise SceneError(f"{asked} need more area than there is; {way_out}")
    out = np.empty((len(runs), rules.count, 4))
    for r, run in enumerate(runs):
        placed = place_apart(_rows_of_four(generator(seed, run, Stream.SCENE)), rules)
        if len(placed) < rules.count:
            raise SceneError(
                f"{asked}: in run {run} only {len(placed)} found a place{taken}, the next one none in "
                f"{MAX_TRIES} tries; {way_out}"
            )
        out[r] = placed
    return out


def _rows_of_four(stream: np.random.Generator) -> Callable[[int], Array]:
    return partial(_next_rows, stream)


def _next_rows(stream: np.random.Generator, rows: int) -> Array:
    return stream.random((rows, 4))


def _check_size(count: int, runs: range) -> None:
    if count * len(runs) > MAX_OBSTACLES:
        raise SceneError(
            f"world.count = {count} in {len(runs)} runs at once is more than {MAX_OBSTACLES} obstacles; "
            "lower world.count or fly fewer runs"
        )


def _round_scenes(world: Lanes | Scatter, frame: PathFrame, places: Array, radii: Array) -> ObstacleSet:
    centres = frame.to_world(places)
    if world.shape == "sphere":
        return ObstacleSet.from_spheres(centres, radii)
    return ObstacleSet.from_cylinders(centres[..., :2], radii)


def _on_ground(frame: PathFrame, along: Array, lateral: Array) -> Array:
    """World (..., 2) of distances along the path's heading and to its left, both horizontal [m]."""
    ahead = np.array([frame.left[1], -frame.left[0]])
    return np.asarray(frame.origin[:2] + along[..., None] * ahead + lateral[..., None] * frame.left[:2])


def _level(frame: PathFrame, starts: Starts, zero_m: float) -> tuple[tuple[float, float, float], ...]:
    """Starts ahead and left of the path's origin in the horizontal plane, and up from a height [m]."""
    ahead = np.array([frame.left[1], -frame.left[0]])
    return tuple(
        (float(offset @ ahead), float(offset @ frame.left[:2]), float(height) - zero_m)
        for offset, height in zip(
            starts.positions[:, :2] - frame.origin[:2], starts.positions[:, 2], strict=True
        )
    )


def _between(low_high: tuple[float, float], u: Array) -> Array:
    return low_high[0] + u * (low_high[1] - low_high[0])


def _listed(name: str, item: ObstacleItem) -> Shape:
    try:
        match item:
            case SphereObstacle():
                return Sphere(item.centre_m, item.radius_m)
            case CylinderObstacle():
                base = -math.inf if item.base_m is None else item.base_m
                top = math.inf if item.top_m is None else item.top_m
                return Cylinder(item.centre_m, item.radius_m, base, top)
            case BoxObstacle():
                return Box(item.centre_m, item.size_m, math.radians(item.heading_deg))
            case PrismObstacle():
                return Prism((np.array(item.footprint_m),), item.base_m, item.top_m)
    except ValueError as error:
        raise SceneError(f"{name}: {error}") from error
