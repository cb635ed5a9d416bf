"""Line of sight: whether a straight ray from a point meets any solid of a scene, compiled over all rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.jit import compiled
from napf_mpc.world.bounding_tree import STACK, BoxTree
from napf_mpc.world.distance import BASE, BOX, COS, CYLINDER, SIN, SPHERE, TOP, A, B, Solids, X, Y
from napf_mpc.world.obstacles import ObstacleSet

__all__ = ["line_of_sight"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FAR_M = 1e7
"""Length of a ray [m]: what stands farther away hides nothing."""


def line_of_sight(
    obstacles: ObstacleSet, points: ArrayLike, directions: Array, wanted: Mask | None = None
) -> Mask:
    """Whether the ray from a point in a direction is free of obstacles.

    A ray that starts inside a solid is not free; one that touches a surface may be either.

    Parameters
    ----------
    obstacles : ObstacleSet
        One scene for each run, or one for all.
    points : array, shape (run, point, 3)
        East, north, up [m].
    directions : array, shape (run or 1, ray, 3)
        Unit vectors, east, north, up.
    wanted : array of bool, shape (run or 1, ray), optional
        Rays that are asked for; of others the answer is False. All by default.

    Returns
    -------
    array of bool, shape (run, point, ray)
        True where nothing is in the way.

    Raises
    ------
    ValueError
        If a point or direction is not finite or shapes do not fit.
    """
    array = obstacles.check_points("points", points)
    rays = np.ascontiguousarray(directions, dtype=np.float64)
    if rays.ndim != 3 or rays.shape[2] != 3 or rays.shape[0] not in (1, array.shape[0]):
        raise ValueError(f"directions has shape {rays.shape}, must be (1 or {array.shape[0]} runs, ray, 3)")
    if not np.isfinite(rays).all():
        raise ValueError("directions holds numbers that are not finite")
    asked = np.ones(rays.shape[:2], dtype=np.bool_) if wanted is None else np.ascontiguousarray(wanted)
    if asked.shape != rays.shape[:2]:
        raise ValueError(f"wanted has shape {asked.shape}, must be {rays.shape[:2]}, as directions")
    out = np.zeros((*array.shape[:2], rays.shape[1]), dtype=np.bool_)
    _see_all(obstacles.solids, obstacles.tree, obstacles.n_scenes, array, rays, asked, out)
    return out


@compiled
def _see_all(
    solids: Solids, tree: BoxTree, scenes: int, points: Array, rays: Array, asked: Mask, out: Mask
) -> None:
    nodes = np.empty(STACK, dtype=np.int64)
    for run in range(points.shape[0]):
        scene = run if scenes > 1 else 0
        block = run if rays.shape[0] > 1 else 0
        for point in range(points.shape[1]):
            p = points[run, point]
            for ray in range(rays.shape[1]):
                if asked[block, ray]:
                    out[run, point, ray] = not _blocked(solids, tree, scene, p, rays[block, ray], nodes)


@compiled
def _blocked(solids: Solids, tree: BoxTree, scene: int, p: Array, u: Array, nodes: NDArray[np.int64]) -> bool:
    """Whether any solid of a scene meets a ray."""
    depth = 0
    if tree.root[scene] >= 0:
        nodes[0] = tree.root[scene]
        depth = 1
    while depth > 0:
        depth -= 1
        node = nodes[depth]
        if not _meets_box(tree.box, node, p, u):
            continue
        if tree.right[node] >= 0:
            nodes[depth] = tree.right[node]
            nodes[depth + 1] = node + 1
            depth += 2
            continue
        for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
            if _meets_solid(solids, tree.order[entry], p, u):
                return True
    return False


@compiled
def _between(p: float, u: float, low: float, high: float, near: float, far: float) -> tuple[float, float]:
    """Part of near ... far of a ray that lies between two parallel planes; empty where far < near."""
    if u == 0.0:
        if p < low or p > high:
            return 1.0, 0.0
        return near, far
    a = (low - p) / u
    b = (high - p) / u
    return max(near, min(a, b)), min(far, max(a, b))


@compiled
def _meets_box(box: Array, node: int, p: Array, u: Array) -> bool:
    near, far = 0.0, FAR_M
    for axis in range(3):
        near, far = _between(p[axis], u[axis], box[node, axis], box[node, axis + 3], near, far)
        if near > far:
            return False
    return True


@compiled
def _meets_solid(solids: Solids, i: int, p: Array, u: Array) -> bool:
    kind = solids.kind[i]
    row = solids.parameters[i]
    dx, dy = p[0] - row[X], p[1] - row[Y]
    if kind == SPHERE:
        dz = p[2] - row[BASE]
        return _meets_ball(
            dx * u[0] + dy * u[1] + dz * u[2], dx * dx + dy * dy + dz * dz, 1.0, row[A], 0.0, FAR_M
        )
    near, far = _between(p[2], u[2], row[BASE], row[TOP], 0.0, FAR_M)
    if near > far:
        return False
    if kind == CYLINDER:
        return _meets_ball(
            dx * u[0] + dy * u[1], dx * dx + dy * dy, u[0] * u[0] + u[1] * u[1], row[A], near, far
        )
    if kind == BOX:
        x, y = row[COS] * dx + row[SIN] * dy, row[COS] * dy - row[SIN] * dx
        ux, uy = row[COS] * u[0] + row[SIN] * u[1], row[COS] * u[1] - row[SIN] * u[0]
        near, far = _between(x, ux, -row[A], row[A], near, far)
        near, far = _between(y, uy, -row[B], row[B], near, far)
        return near <= far
    return _meets_footprint(
        solids, i, p[0] + near * u[0], p[1] + near * u[1], (far - near) * u[0], (far - near) * u[1]
    )


@compiled
def _meets_ball(along: float, square: float, slope: float, radius: float, near: float, far: float) -> bool:
    """Whether |d + t u| <= radius for some t from near to far; along = d u, square = d d, slope = u u."""
    # The place nearest to the centre, kept between the ends; the distance is convex along the ray.
    t = near
    if slope > 0.0:
        t = min(max(-along / slope, near), far)
    return square + t * (2.0 * along + t * slope) <= radius * radius


@compiled
def _meets_footprint(solids: Solids, i: int, px: float, py: float, ex: float, ey: float) -> bool:
    """Whether the segment from p to p + e of the plane meets the footprint of prism i (even-odd rule)."""
    vertices = solids.vertices
    inside = False
    for ring in range(solids.rings[i, 0], solids.rings[i, 1]):
        a = solids.ring_start[ring + 1] - 1
        for b in range(solids.ring_start[ring], solids.ring_start[ring + 1]):
            ax = vertices[a, 0] - px
            ay = vertices[a, 1] - py
            bx = vertices[b, 0] - px
            by = vertices[b, 1] - py
            # Corners to the left or right of the segment, and its ends to either side of the edge.
            side_a = ex * ay - ey * ax
            side_b = ex * by - ey * bx
            if (side_a > 0.0) != (side_b > 0.0):
                start = ax * by - bx * ay
                end = (ax - ex) * (by - ey) - (bx - ex) * (ay - ey)
                if (start > 0.0) != (end > 0.0):
                    return True
            if (ay > 0.0) != (by > 0.0) and (ax * by - bx * ay > 0.0) == (by > ay):
                inside = not inside
            a = b
    return inside
