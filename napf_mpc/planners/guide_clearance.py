"""Clearance of places on a guide: which solids matter, and how much of the margin is missing.

The shortfall of a place is ``r_uav + k sigma(n) + spare - d``: positive where the inflated UAV, with a little
to spare, does not fit. Places are given in path coordinates, solids and covariances in the world.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled
from napf_mpc.world.distance import SPHERE, Solids, signed_distance
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

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


def frame_of(path: PathFrame) -> Frame:
    """Frame for compiled loops."""
    return Frame(path.origin.copy(), path.axes)


def solid_boxes(obstacles: ObstacleSet, path: PathFrame) -> SolidBoxes:
    """Box around each solid in path coordinates, from the corners of its box in the world."""
    lower, upper = (np.clip(corner, -1e9, 1e9) for corner in obstacles.boxes)
    lower[:, 2] = np.maximum(lower[:, 2], -ENDLESS_M)
    upper[:, 2] = np.minimum(upper[:, 2], ENDLESS_M)
    corners = np.stack([path.to_path(np.where(np.array(pick), upper, lower)) for pick in np.ndindex(2, 2, 2)])
    return SolidBoxes(np.ascontiguousarray(corners.min(0)), np.ascontiguousarray(corners.max(0)))


@compiled
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
) -> tuple[float, float, float]:
    """Missing clearance [m] to solid i at a place in path coordinates, and the distance's gradient there.

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
        Shortfall [m], and the gradient's parts to the left and up.
    """
    ax = frame.axes
    px = frame.origin[0] + along * ax[0, 0] + left * ax[1, 0] + up * ax[2, 0]
    py = frame.origin[1] + along * ax[0, 1] + left * ax[1, 1] + up * ax[2, 1]
    pz = frame.origin[2] + along * ax[0, 2] + left * ax[1, 2] + up * ax[2, 2]
    d, gx, gy, gz = signed_distance(solids, i, px, py, pz)
    c = covariance
    variance = c[0, 0] * gx * gx + c[1, 1] * gy * gy + c[2, 2] * gz * gz
    variance += 2.0 * (c[0, 1] * gx * gy + c[0, 2] * gx * gz + c[1, 2] * gy * gz)
    missing = need_m + k * math.sqrt(max(variance, 0.0)) - d
    return (
        missing,
        gx * ax[1, 0] + gy * ax[1, 1] + gz * ax[1, 2],
        gx * ax[2, 0] + gy * ax[2, 1] + gz * ax[2, 2],
    )


@compiled
def largest_reach(covariance: Array, k: float, need_m: float) -> float:
    """Bound [m] on radius, spare and k sigma over all directions (rows' absolute sums, Gershgorin)."""
    largest = 0.0
    for a in range(3):
        total = 0.0
        for b in range(3):
            total += abs(covariance[a, b])
        largest = max(largest, total)
    return need_m + k * math.sqrt(largest)


@compiled
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
    """Note the solids first ... stop - 1 that reach into a window of the plane; returns their number."""
    count = 0
    for i in range(first, stop):
        if boxes.high[i, 0] < along_low - reach or boxes.low[i, 0] > along_high + reach:
            continue
        if boxes.high[i, 1] < left_low - reach or boxes.low[i, 1] > left_high + reach:
            continue
        if count < len(found):
            found[count] = i
        count += 1
    return min(count, len(found))


@compiled
def vertical_room(
    solids: Solids,
    boxes: SolidBoxes,
    found: NDArray[np.int64],
    count: int,
    lane_up: float,
    reach: float,
    most: float,
) -> tuple[bool, bool]:
    """Whether it makes sense to go up, and down, past what was found.

    Up: something has a top that can be passed within ``most`` metres. Down only past spheres: what stands on
    the ground has ground under it.
    """
    upwards = False
    downwards = True
    for entry in range(count):
        i = found[entry]
        if solids.kind[i] != SPHERE:
            downwards = False
        if boxes.high[i, 2] + reach - lane_up <= most:
            upwards = True
    return upwards, downwards and upwards
