"""Pulling a guide's way taut: as near to the lane as the margins of the obstacles let it come.

Guidance finds on which side to pass, with room to spare and on a coarse lattice; a UAV that follows it to the
letter flies farther out, and longer, than it has to. What the guide is needed for is the side. So each place
of the way is drawn straight towards the lane, up to the first place that is short of the margin: what lies
beyond an obstacle, or beyond a gap that is too narrow, is not reached, since a margin lies between. And a
place is drawn away from the way only so far that it leads back to it, at a slope that can be flown, where the
way must be kept: nobody flies into a dead end because its mouth is wide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.probability import sigma_along
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.planners.guide_clearance import Frame, world_place
from napf_mpc.world.bounding_tree import STACK, BoxTree
from napf_mpc.world.distance import Solids
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.queries import nearest_obstacle

Array = NDArray[np.float64]

STEPS = 5
"""Places looked at between the guide's way and the lane."""
SAME_M = 0.01
"""Offsets below this are none."""
ROUNDING_M = 1e-6
"""Bounds on distances are taken this much too wide."""
NEAR_M = 0.05
"""How near to the margin a place comes."""


class Clearance(NamedTuple):
    """What is kept between a UAV and an obstacle."""

    k: float
    """Sigmas."""
    radius_m: float
    """Of a UAV [m]."""
    extra_m: float
    """On top of the margin, at most [m]."""
    extra_sigmas: float
    """On top of the margin, in sigmas."""


def pulled_taut(
    profiles: Array,
    along: Array,
    step_m: float,
    lanes: Array,
    frame: Frame,
    obstacles: ObstacleSet,
    covariance: Array,
    clearance: Clearance,
    slope: float,
    stay: Array | None = None,
    farthest: Array | None = None,
) -> tuple[Array, Array]:
    """Offsets as near to the lanes as the margins allow, and how loose they are.

    Parameters
    ----------
    profiles : array, shape (run, uav, station, 2)
        Offsets from the lanes, left and up [m].
    along : array, shape (run, uav)
        Where the profiles start on the path [m].
    step_m : float
        From station to station [m].
    lanes : array, shape (uav, 2)
        Left and up [m].
    frame : Frame
        The path's frame.
    obstacles : ObstacleSet
        The map.
    covariance : array, shape (run, uav, 3, 3)
        Of the position, whose k sigma is the margin [m^2].
    clearance : Clearance
        Kept from obstacles.
    slope : float
        At which a place leads back to the way, per metre of path.
    stay : array, shape (run, uav, station), optional
        How far from the lane a place stays though nothing is in between, as where the sky is better [m].
    farthest : array, shape (run,), optional
        How far a place is drawn at most [m].

    Returns
    -------
    offsets : array, shape (run, uav, station, 2)
        [m].
    loose : array, shape (run, uav, station)
        Part of the way to the lane that was gone: 1 where nothing is in between.
    """
    out = profiles.copy()
    loose = np.ones(profiles.shape[:3])
    if stay is None:
        stay = np.zeros(profiles.shape[:3])
    if farthest is None:
        farthest = np.full(len(profiles), np.inf)
    _pull(
        obstacles.solids, obstacles.tree, obstacles.scene_start, along, step_m, lanes, frame, covariance,
        clearance, slope * step_m, stay, farthest, out, loose,
    )  # fmt: skip
    return out, loose


@compiled_bare
def distance_and_lack(
    solids: Solids,
    tree: BoxTree,
    scene: int,
    frame: Frame,
    along: float,
    left: float,
    up: float,
    covariance: Array,
    clearance: Clearance,
    nodes: NDArray[np.int64],
    bounds: Array,
) -> tuple[float, bool]:
    """Distance of a place in path coordinates to the nearest obstacle, and whether it lacks the margin."""
    px, py, pz = world_place(frame, along, left, up)
    d, gx, gy, gz, _ = nearest_obstacle(solids, tree, scene, px, py, pz, nodes, bounds)
    need = need_of(sigma_along(covariance, gx, gy, gz), clearance)
    return d, not need <= d  # what is not a number lacks it


@compiled_bare
def need_of(sigma: float, clearance: Clearance) -> float:
    """Distance to keep where the position has a sigma towards the obstacle [m]."""
    extra = min(clearance.extra_m, clearance.extra_sigmas * sigma)
    return clearance.radius_m + clearance.k * sigma + extra


@compiled_bare
def sigma_bounds(covariance: Array) -> tuple[float, float]:
    """Bounds on sigma over all directions (Gershgorin)."""
    least, most = np.inf, 0.0
    for a in range(3):
        beside = 0.0
        for b in range(3):
            beside += abs(covariance[a, b]) if b != a else 0.0
        least, most = min(least, covariance[a, a] - beside), max(most, covariance[a, a] + beside)
    return math.sqrt(max(least, 0.0)), math.sqrt(most)


@compiled
def _pull(
    solids: Solids,
    tree: BoxTree,
    scene_start: NDArray[np.int64],
    along: Array,
    step_m: float,
    lanes: Array,
    frame: Frame,
    covariance: Array,
    clearance: Clearance,
    most: float,
    stay: Array,
    farthest: Array,
    out: Array,
    loose: Array,
) -> None:
    """Pull out (run, uav, station, 2) taut in place; ``most`` is slope times the stations' distance [m]."""
    runs, uavs, stations = out.shape[:3]
    nodes, bounds = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    for run in range(runs):
        scene = 0 if len(scene_start) == 2 else run
        for uav in range(uavs):
            c, y, z = covariance[run, uav], lanes[uav, 0], lanes[uav, 1]
            sigmas = sigma_bounds(c)
            least = need_of(sigmas[0], clearance) - ROUNDING_M
            large = need_of(sigmas[1], clearance) + ROUNDING_M
            ahead = 0.0
            for s in range(stations - 1, -1, -1):
                left, up = out[run, uav, s]
                size = math.sqrt(left * left + up * up)
                # Backwards: from here, what lies ahead has to be reached at no more than the slope.
                limit = min(size - (ahead - most), size - stay[run, uav, s], farthest[run])
                ahead = size
                if size < SAME_M or limit <= 0.0:
                    loose[run, uav, s] = 1.0 if size < SAME_M else 0.0
                    continue
                place, pulled, blocked = along[run, uav] + s * step_m, 0.0, -1.0
                step = 1
                # A metre of way changes the distance by no more than a metre: places nearer than that to one
                # that was asked about need not be asked about.
                free, short = 0.0, np.inf
                while True:
                    if blocked >= 0.0:
                        # To the margin itself: what jumps by a step from plan to plan would be flown.
                        if blocked - pulled <= NEAR_M:
                            break
                        want = 0.5 * (pulled + blocked)
                    elif step <= STEPS:
                        want = limit * step / STEPS
                        step += 1
                    else:
                        break
                    lacks = want >= short
                    if not lacks and want > free:
                        kept = 1.0 - want / size
                        d, lacks = distance_and_lack(
                            solids, tree, scene, frame, place, y + kept * left, z + kept * up, c,
                            clearance, nodes, bounds,
                        )  # fmt: skip
                        if lacks:
                            short = want - max(0.0, least - d)
                        else:
                            free = want + max(0.0, d - large)
                    if lacks:
                        blocked = want
                    else:
                        pulled = want
                ahead = size - pulled
                loose[run, uav, s] = pulled / size
                out[run, uav, s, 0] = left * (1.0 - pulled / size)
                out[run, uav, s, 1] = up * (1.0 - pulled / size)
