"""Clearance of places on a guide: which solids matter, and how much of the margin is missing.

The shortfall of a place is ``r_uav + k sigma(n) + spare - d``: positive where the inflated UAV, with a little
to spare, does not fit. Places are given in path coordinates, solids and covariances in the world; what is
round is turned into path coordinates once a plan, since thousands of places are asked about.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.passage import PassageMargins, sigmas_beside, volume
from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled_bare
from napf_mpc.world.distance import BASE, CYLINDER, SPHERE, TOP, TOUCH_M, A, Solids, X, Y, signed_distance
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

LARGE_M = 8.0
"""Radius from which a sphere in the air is passed like a building: by a way under it, if one is found."""
TOUCHING_M = 2.0
"""A place where a UAV would touch counts as this short at least [m]. With errors of centimetres no place is
far inside the margin of a thin wall or a row of poles: the way through would be cheaper than that round."""
ENDLESS_M = 1e4
"""Heights beyond this count as this when a solid's box is turned into the path's frame."""


class Frame(NamedTuple):
    """The path's frame as compiled loops read it."""

    origin: Array  # (3,) [m]
    axes: Array  # (3, 3) rows along, left, up


class SolidBoxes(NamedTuple):
    """Boxes around all solids, in path coordinates."""

    low: Array  # (solid, 3) along, left, up [m]
    high: Array  # (solid, 3)
    order: NDArray[np.int64]  # (solid,) of each scene by low along, scene after scene
    longest: float  # of all boxes along [m]


def frame_of(path: PathFrame) -> Frame:
    """Frame for compiled loops."""
    return Frame(path.origin.copy(), path.axes)


def solid_boxes(obstacles: ObstacleSet, path: PathFrame) -> SolidBoxes:
    """Box around each solid in path coordinates, from the corners of its box in the world."""
    lower, upper = (np.clip(corner, -1e9, 1e9) for corner in obstacles.boxes)
    lower[:, 2] = np.maximum(lower[:, 2], -ENDLESS_M)
    upper[:, 2] = np.minimum(upper[:, 2], ENDLESS_M)
    corners = np.stack([path.to_path(np.where(np.array(pick), upper, lower)) for pick in np.ndindex(2, 2, 2)])
    low, high = np.ascontiguousarray(corners.min(0)), np.ascontiguousarray(corners.max(0))
    scene = np.repeat(np.arange(obstacles.n_scenes), np.diff(obstacles.scene_start))
    order = np.lexsort((low[:, 0], scene)).astype(np.int64)
    return SolidBoxes(low, high, order, float((high - low)[:, 0].max(initial=0.0)))


# Columns of `Sight.near`: where a solid is, the box in which it can matter, and what is round about it.
ALONG, LEFT, UP, RADIUS = 0, 1, 2, 3
ROUND = 4
"""1 a sphere, 0 a cylinder that stands upright in the path's frame, -1 anything else."""
OUTER2 = 5
"""Squared distance from centre or axis beyond which nothing is short; infinite if not round [m^2]."""
LOW, HIGH = 6, 9
"""First of three columns each: corners of the box with the reach all round."""
BOTTOM, LID = 12, 13
"""Base and top of a cylinder in the path's frame."""
TOUCHED = 14
"""Variance in the direction that counts as the gradient at the centre or on the axis [m^2]."""
SIGMAS = 15
"""How many sigmas to keep from what is round."""
COLUMNS = 16


class Sight(NamedTuple):
    """What each UAV of a run sees ahead, with scratch for what is short where."""

    solids: Solids
    frame: Frame
    margins: PassageMargins  # sigmas to keep from each solid
    radius_m: float
    need_m: float  # radius and spare
    along: Array  # (uav,)
    lanes: Array  # (uav, 2)
    covariance: Array  # (uav, 3, 3) in the world [m^2]
    turned: Array  # (uav, 3, 3) the same in path coordinates
    reach: Array  # (uav,)
    found: NDArray[np.int64]  # (uav, most) solids
    solid_count: NDArray[np.int64]  # (uav,) their number
    near: Array  # (uav, most, COLUMNS)
    here: NDArray[np.int64]  # (uav, station, most) which of the found ones reach a station
    here_count: NDArray[np.int64]  # (uav, station)
    missing: Array  # (uav, station, layer, cell) shortfalls, 0 where nothing is short, where known
    known: NDArray[np.int64]  # (uav, station, layer, 2) first and last cell known, of each layer
    has_sky: bool  # whether places have a price of their own, ...
    sky: Array  # (uav, station, layer, cell) ... this one a metre; else not written


@compiled_bare
def round_shortfall(
    x: float, y: float, z: float, radius: float, touched: float, covariance: Array, k: float, need_m: float
) -> tuple[float, float, float]:
    """Missing clearance [m] to a sphere, or with z = 0 an upright cylinder, and the gradient left and up.

    x, y, z lead from the centre or axis; ``covariance`` is in the same axes, ``touched`` the variance in the
    direction that is taken at the centre itself.
    """
    c = covariance
    square = x * x + y * y + z * z
    form = c[0, 0] * x * x + c[1, 1] * y * y + c[2, 2] * z * z
    form += 2.0 * (c[0, 1] * x * y + c[0, 2] * x * z + c[1, 2] * y * z)
    off = square > TOUCH_M * TOUCH_M
    variance = form / square if off else touched
    radial = math.sqrt(square)
    scale = 1.0 / radial if off else 0.0
    return need_m + k * math.sqrt(max(variance, 0.0)) - (radial - radius), y * scale, z * scale


@compiled_bare
def is_round(near: Array, i: int, entry: int, up: float) -> bool:
    """Whether only the distance from a centre or axis counts at a height: a sphere, or well below a lid."""
    if near[i, entry, ROUND] != 0.0:
        return bool(near[i, entry, ROUND] > 0.0)
    return bool(min(near[i, entry, LID] - up, up - near[i, entry, BOTTOM]) >= near[i, entry, RADIUS])


@compiled_bare
def half_step_of(row: Array, reach: float, step_m: float) -> float:
    """How far back and forth a place stands for its piece of the path, next to a solid of `Sight.near`.

    Next to something thin the nearest point of half a step is taken, so that nothing is missed between
    stations. So it is next to an edge, as far as the reach is less than a step: a way that is aside one
    station later than a face begins would cut the corner in between.
    """
    if 0.5 * (row[HIGH] - row[LOW]) < step_m:
        return 0.5 * step_m
    return min(0.5 * step_m, max(step_m - reach, 0.0)) if row[ROUND] < 0.0 else 0.0


@compiled_bare
def nearest_along(row: Array, reach: float, station: float, half_step: float, step_m: float) -> float:
    """Place along the path, within half a step of a station, that is nearest to a solid."""
    low, high = row[LOW] + reach, row[HIGH] - reach
    if 0.5 * (row[HIGH] - row[LOW]) < step_m:
        low = high = 0.5 * (row[LOW] + row[HIGH])
    nearest = min(max(station, low), high)
    return float(min(max(nearest, station - half_step), station + half_step))


@compiled_bare
def look(sight: Sight, boxes: SolidBoxes, i: int) -> None:
    """Fill in the table of what UAV i has found, and its covariance in path coordinates."""
    ax = sight.frame.axes
    c = sight.covariance[i]
    for a in range(3):
        for b in range(3):
            total = 0.0
            for p in range(3):
                for q in range(3):
                    total += ax[a, p] * c[p, q] * ax[b, q]
            sight.turned[i, a, b] = total
    level = ax[0, 2] == 0.0 and ax[1, 2] == 0.0 and ax[2, 2] > 0.0
    reach = sight.reach[i]
    for entry in range(sight.solid_count[i]):
        solid = sight.found[i, entry]
        row = sight.near[i, entry]
        given = sight.solids.parameters[solid]
        for a in range(3):
            row[LOW + a] = boxes.low[solid, a] - reach
            row[HIGH + a] = boxes.high[solid, a] + reach
            row[a] = 0.5 * (boxes.low[solid, a] + boxes.high[solid, a])
        row[ROUND] = -1.0
        row[RADIUS] = 0.0
        row[OUTER2] = np.inf
        kind = sight.solids.kind[solid]
        if kind == SPHERE or (kind == CYLINDER and level):
            row[ROUND] = 1.0 if kind == SPHERE else 0.0
            row[RADIUS] = given[A]
            row[TOUCHED] = c[2, 2] if kind == SPHERE else c[0, 0]
            row[OUTER2] = (given[A] + reach) ** 2
            row[SIGMAS] = sight.margins.k
            if kind == SPHERE:
                row[SIGMAS] = sphere_sigmas(sight.margins, given[A] + sight.radius_m, c)
            x = given[X] - sight.frame.origin[0]
            y = given[Y] - sight.frame.origin[1]
            z = given[BASE] - sight.frame.origin[2]
            if kind == CYLINDER:
                row[BOTTOM] = z * ax[2, 2]
                row[LID] = (given[TOP] - sight.frame.origin[2]) * ax[2, 2]
                z = 0.0
            for a in range(3 if kind == SPHERE else 2):
                row[a] = x * ax[a, 0] + y * ax[a, 1] + z * ax[a, 2]


@compiled_bare
def sphere_sigmas(margins: PassageMargins, radius: float, covariance: Array) -> float:
    """Sigmas to keep from a sphere: as with an error of the same volume, equal in all directions."""
    sigma = volume(covariance) ** (1.0 / 3.0)
    return sigmas_beside(margins, radius, sigma, sigma * sigma)


@compiled_bare
def world_place(frame: Frame, along: float, left: float, up: float) -> tuple[float, float, float]:
    """Place in the world of path coordinates [m]."""
    ax = frame.axes
    return (
        frame.origin[0] + along * ax[0, 0] + left * ax[1, 0] + up * ax[2, 0],
        frame.origin[1] + along * ax[0, 1] + left * ax[1, 1] + up * ax[2, 1],
        frame.origin[2] + along * ax[0, 2] + left * ax[1, 2] + up * ax[2, 2],
    )


@compiled_bare
def shortfall(
    solids: Solids,
    i: int,
    frame: Frame,
    along: float,
    left: float,
    up: float,
    covariance: Array,
    k: float,
    need_m: float,
) -> tuple[float, float, float, float]:
    """Missing clearance to solid i at a place in path coordinates, the distance's gradient there, and itself.

    Parameters
    ----------
    solids, i
        The solid.
    frame : Frame
        The path's frame.
    along, left, up : float
        The place [m].
    covariance : array, shape (3, 3)
        Of the position, in the world [m^2].
    k : float
        Sigmas.
    need_m : float
        Radius and spare [m].

    Returns
    -------
    tuple of float
        Shortfall [m], the gradient's parts to the left and up, and the distance [m].
    """
    ax = frame.axes
    px, py, pz = world_place(frame, along, left, up)
    d, gx, gy, gz = signed_distance(solids, i, px, py, pz)
    c = covariance
    variance = c[0, 0] * gx * gx + c[1, 1] * gy * gy + c[2, 2] * gz * gz
    variance += 2.0 * (c[0, 1] * gx * gy + c[0, 2] * gx * gz + c[1, 2] * gy * gz)
    missing = need_m + k * math.sqrt(max(variance, 0.0)) - d
    return (
        missing,
        gx * ax[1, 0] + gy * ax[1, 1] + gz * ax[1, 2],
        gx * ax[2, 0] + gy * ax[2, 1] + gz * ax[2, 2],
        d,
    )


@compiled_bare
def largest_reach(covariance: Array, k: float, need_m: float) -> float:
    """Bound [m] on radius, spare and k sigma over all directions (rows' absolute sums, Gershgorin)."""
    largest = 0.0
    for a in range(3):
        total = 0.0
        for b in range(3):
            total += abs(covariance[a, b])
        largest = max(largest, total)
    return need_m + k * math.sqrt(largest)


@compiled_bare
def gather(
    boxes: SolidBoxes,
    first: int,
    stop: int,
    along_low: float,
    along_high: float,
    left_low: float,
    left_high: float,
    reach: float,
    found: NDArray[np.int64],
) -> int:
    """Note the solids first ... stop - 1 that reach into a window of the plane; returns their number.

    They come in the order of their indices, and if there is no room for all, those of the smallest.
    """
    count = 0
    begin, end = first, stop
    while begin < end:
        middle = (begin + end) // 2
        if boxes.low[boxes.order[middle], 0] < along_low - reach - boxes.longest:
            begin = middle + 1
        else:
            end = middle
    for place in range(begin, stop):
        i = boxes.order[place]
        if boxes.low[i, 0] > along_high + reach:
            break
        if boxes.high[i, 0] < along_low - reach:
            continue
        if boxes.high[i, 1] < left_low - reach or boxes.low[i, 1] > left_high + reach:
            continue
        at = count
        if count < len(found):
            count += 1
        elif i < found[count - 1]:
            at = count - 1
        else:
            continue
        while at > 0 and found[at - 1] > i:
            found[at] = found[at - 1]
            at -= 1
        found[at] = i
    return count


@compiled_bare
def vertical_room(
    solids: Solids,
    boxes: SolidBoxes,
    found: NDArray[np.int64],
    count: int,
    lane_up: float,
    reach: float,
    most_up: float,
) -> tuple[bool, bool, float]:
    """Whether it makes sense to go up past what was found, whether all are spheres, and how far down to go.

    Up: something has a top that can be passed within ``most_up`` metres. Down is to where the first of them
    can be passed beneath [m], endless if nothing was found; small spheres that cannot be passed above are
    passed at the side.
    """
    upwards = False
    spheres = True
    down = np.inf
    for entry in range(count):
        i = found[entry]
        small = solids.kind[i] == SPHERE and solids.parameters[i, A] < LARGE_M
        spheres = spheres and solids.kind[i] == SPHERE
        upwards = upwards or boxes.high[i, 2] + reach - lane_up <= most_up
        if not small:
            down = min(down, lane_up + reach - boxes.low[i, 2])
    return upwards, spheres, down
