"""Room outwards: how much farther from its lane than its way a UAV could pass what it passes.

Pulling a way taut asks how near to the lane it may come. This is the other side: in the direction of its
offset, how far out is there still nothing in the way? A UAV that knows can go along with others that are
farther out than it has to be, see :mod:`.cohesion`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.planners.guide_clearance import Frame
from napf_mpc.planners.taut import SAME_M, Clearance, distance_and_lack, need_of, sigma_bounds
from napf_mpc.world.bounding_tree import STACK, BoxTree
from napf_mpc.world.distance import Solids
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

STEP_M = 0.5
"""Distance between places that are looked at, at least: what is thinner than this may be overlooked."""


def room_outwards(
    profiles: Array,
    along: Array,
    step_m: float,
    lanes: Array,
    frame: Frame,
    obstacles: ObstacleSet,
    covariance: Array,
    clearance: Clearance,
    most_m: float,
) -> Array:
    """Distance from the lane (run, uav, station) up to which the offset's direction is free [m].

    At least the offset itself, and ``most_m`` at most, if the offset is not more. Where there is no offset
    there is no direction, and the answer is 0.

    Parameters
    ----------
    profiles : array, shape (run, uav, station, 2)
        Offsets from the lanes, left and up [m].
    along, step_m, lanes, frame, obstacles, covariance, clearance
        As :func:`.taut.pulled_taut` takes them.
    most_m : float
        How far from the lane is looked [m].
    """
    room = np.zeros(profiles.shape[:3])
    _look(
        obstacles.solids, obstacles.tree, obstacles.scene_start, along, step_m, lanes, frame, covariance,
        clearance, most_m, profiles, room,
    )  # fmt: skip
    return room


@compiled
def _look(
    solids: Solids,
    tree: BoxTree,
    scene_start: NDArray[np.int64],
    along: Array,
    step_m: float,
    lanes: Array,
    frame: Frame,
    covariance: Array,
    clearance: Clearance,
    most_m: float,
    profiles: Array,
    room: Array,
) -> None:
    nodes, bounds = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    for run in range(room.shape[0]):
        scene = 0 if len(scene_start) == 2 else run
        for uav in range(room.shape[1]):
            c, y, z = covariance[run, uav], lanes[uav, 0], lanes[uav, 1]
            large = need_of(sigma_bounds(c)[1], clearance)
            for s in range(room.shape[2]):
                left, up = profiles[run, uav, s]
                size = math.sqrt(left * left + up * up)
                if size < SAME_M:
                    continue
                free = size
                while free < most_m:
                    want = min(free + STEP_M, most_m)
                    d, lacks = distance_and_lack(
                        solids, tree, scene, frame, along[run, uav] + s * step_m, y + want * left / size,
                        z + want * up / size, c, clearance, nodes, bounds,
                    )  # fmt: skip
                    if lacks:
                        break
                    # A metre of way changes the distance by no more than a metre.
                    free = min(want + max(0.0, d - large), most_m)
                room[run, uav, s] = free
