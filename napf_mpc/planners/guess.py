"""Plans at which rows are made linear must not lead through an obstacle.

Rows speak of the side of an obstacle on which a plan is. A plan that was pressed into a wall, and far enough,
has its later places on the other side; rows made there would help it through. So a plan is cut where it
enters an obstacle: the places after that count as the last one before. A way of guidance's may begin in an
obstacle, or behind it; that counts as entered, too.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.world.bounding_tree import STACK, BoxTree
from napf_mpc.world.distance import Solids
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.queries import nearest_obstacle

Array = NDArray[np.float64]

FINEST_M = 0.1
"""Steps between places are halved down to this length to find what stands between them."""


OWN_M = 1.0
"""A plan that begins farther from the UAV than this is a way of guidance's, and looked at from the UAV on."""


def cut_at_obstacles(here: Array, position: Array, obstacles: ObstacleSet) -> Array:
    """Places that stay where they are before they enter an obstacle.

    Parameters
    ----------
    here : array, shape (run, uav, 3)
        Where UAVs are reported to be [m].
    position : array, shape (run, uav, N, 3)
        Their plans [m].
    obstacles : ObstacleSet
        The map.

    Returns
    -------
    array, shape (run, uav, N, 3)
        Plans [m]. One of a UAV inside an obstacle that starts inside is left as it is: its rows lead out.
    """
    out = position.copy()
    if len(obstacles):
        _cut(obstacles.solids, obstacles.tree, obstacles.scene_start, here, out)
    return out


@compiled
def _cut(solids: Solids, tree: BoxTree, scene_start: NDArray[np.int64], here: Array, out: Array) -> None:
    nodes, bounds = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    for run in range(out.shape[0]):
        scene = 0 if len(scene_start) == 2 else run
        for uav in range(out.shape[1]):
            before, first = here[run, uav], out[run, uav, 0]
            room = nearest_obstacle(solids, tree, scene, before[0], before[1], before[2], nodes, bounds)[0]
            away = _length(before, first)
            if (
                away > OWN_M
                and 0.0 < room <= away
                and not _free(solids, tree, scene, before, first, room, away, nodes, bounds)
            ):
                for n in range(out.shape[2]):
                    out[run, uav, n] = before
                continue
            before = first
            room = nearest_obstacle(solids, tree, scene, before[0], before[1], before[2], nodes, bounds)[0]
            if room <= 0.0:
                continue
            for n in range(1, out.shape[2]):
                place = out[run, uav, n]
                away = _length(before, place)
                # Nothing is nearer than the room around the place before, most times.
                if away >= room:
                    if not _free(solids, tree, scene, before, place, room, away, nodes, bounds):
                        for rest in range(n, out.shape[2]):
                            out[run, uav, rest] = before
                        break
                    room = nearest_obstacle(solids, tree, scene, place[0], place[1], place[2], nodes, bounds)[
                        0
                    ]
                else:
                    room -= away
                before = place


@compiled_bare
def _length(a: Array, b: Array) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@compiled_bare
def _free(
    solids: Solids, tree: BoxTree, scene: int, start: Array, stop: Array, room: float, away: float,
    nodes: NDArray[np.int64], bounds: Array,
) -> bool:  # fmt: skip
    """Whether a straight piece stays outside of all obstacles: walked in steps of the room there is."""
    at = 0.0
    while True:
        at += max(room, FINEST_M)
        if at > away:
            at = away
        part = at / away
        room = nearest_obstacle(
            solids, tree, scene, start[0] + part * (stop[0] - start[0]),
            start[1] + part * (stop[1] - start[1]), start[2] + part * (stop[2] - start[2]), nodes, bounds,
        )[0]  # fmt: skip
        if room <= 0.0:
            return False
        if at >= away:
            return True
