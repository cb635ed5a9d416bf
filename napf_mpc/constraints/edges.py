"""Edges that a plan passes between two of its stages.

A row speaks of the face of an obstacle that is nearest to a stage. A plan that passes an edge, over the end
of a roof or round a corner, has one face before it and another behind: both rows are kept, and the straight
piece between the stages may still cut the edge. So where the nearest face changes from one stage to the next,
both keep from the edge itself: from the plane through the point of the obstacle that is nearest to that
piece. A half-space that holds two places holds what is between them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.world.distance import CYLINDER, SPHERE, Solids, signed_distance

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ALIKE = 0.95
"""Normals with at least this cosine between them are of one face."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
SECTIONS = 12
"""Golden sections of a piece: it is searched to a three-hundredth of its length."""


@compiled_bare
def _turns(solids: Solids, i: int, before: Array, after: Array) -> bool:
    """Whether an edge of solid i lies between two of its unit normals (3,)."""
    kind = solids.kind[i]
    if kind == SPHERE:
        return False
    if kind == CYLINDER and (abs(before[2]) > 0.5) == (abs(after[2]) > 0.5):
        return False  # its side is round, only its lids have edges
    return bool(before[0] * after[0] + before[1] * after[1] + before[2] * after[2] < ALIKE)


@compiled_bare
def _distance_at(
    solids: Solids, i: int, start: Array, stop: Array, part: float
) -> tuple[float, float, float, float]:
    """Signed distance of solid i and its gradient at a part of the way between two places (3,)."""
    x = start[0] + part * (stop[0] - start[0])
    y = start[1] + part * (stop[1] - start[1])
    z = start[2] + part * (stop[2] - start[2])
    return signed_distance(solids, i, x, y, z)


@compiled_bare
def _nearest_part(solids: Solids, i: int, start: Array, stop: Array) -> float:
    """Part of the way between two places (3,) at which solid i is nearest; exact for what is convex."""
    low, high = 0.0, 1.0
    a, b = 1.0 - GOLDEN, GOLDEN
    at_a, at_b = _distance_at(solids, i, start, stop, a)[0], _distance_at(solids, i, start, stop, b)[0]
    for _ in range(SECTIONS):
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - GOLDEN * (high - low)
            at_a = _distance_at(solids, i, start, stop, a)[0]
        else:
            low, a, at_a = a, b, at_b
            b = low + GOLDEN * (high - low)
            at_b = _distance_at(solids, i, start, stop, b)[0]
    return 0.5 * (low + high)


@compiled
def keep_edges(
    solids: Solids, scene_start: Index, points: Array, together: int, distance: Array, normal: Array,
    index: Index,
) -> None:  # fmt: skip
    """Move the planes of faces to the edges between them, where plans pass an edge between two stages.

    Parameters
    ----------
    solids, scene_start
        The map: solids of scene r are ``scene_start[r]`` to ``scene_start[r + 1] - 1``, or of the only scene.
    points : array, shape (run, point, 3)
        Plans, one after the other [m].
    together : int
        Stages of a plan.
    distance, normal, index : array, shapes (run, point, m), (run, point, m, 3) and (run, point, m)
        Obstacles near each point as :meth:`~napf_mpc.world.obstacles.ObstacleSet.near` finds them. Distance
        and normal are written over: the point's distance from the edge's plane, and that plane's normal.
    """
    m = distance.shape[2]
    planes, found = np.empty((together, m, 4)), np.zeros((together, m), dtype=np.bool_)
    for r in range(points.shape[0]):
        first = scene_start[0] if len(scene_start) == 2 else scene_start[r]
        for begin in range(0, points.shape[1], together):
            found[:] = False
            for k in range(begin, begin + together - 1):
                for j in range(m):
                    i = index[r, k, j]
                    for h in range(m):
                        if i < 0 or index[r, k + 1, h] != i:
                            continue
                        if not _turns(solids, first + i, normal[r, k, j], normal[r, k + 1, h]):
                            continue
                        start, stop = points[r, k], points[r, k + 1]
                        part = _nearest_part(solids, first + i, start, stop)
                        d, nx, ny, nz = _distance_at(solids, first + i, start, stop, part)
                        # Nearest at an end, there is no edge between them; inside, nothing to keep from.
                        if d <= 0.0 or d >= min(distance[r, k, j], distance[r, k + 1, h]):
                            continue
                        along = (
                            nx * (stop[0] - start[0]) + ny * (stop[1] - start[1]) + nz * (stop[2] - start[2])
                        )
                        for stage, place, ahead in ((k, j, -part), (k + 1, h, 1.0 - part)):
                            s, here = stage - begin, d + ahead * along
                            if not found[s, place] or here < planes[s, place, 0]:
                                found[s, place] = True
                                planes[s, place, 0] = here
                                planes[s, place, 1], planes[s, place, 2], planes[s, place, 3] = nx, ny, nz
            for s in range(together):
                for j in range(m):
                    if found[s, j]:
                        distance[r, begin + s, j] = planes[s, j, 0]
                        for axis in range(3):
                            normal[r, begin + s, j, axis] = planes[s, j, 1 + axis]
