"""Verdicts on truth between samples: clearance of the flown path, separation of UAVs during a step.

Sampling the distance misses contacts: closing at 20 m/s with a summed radius of 0.5 m, a sample every 0.1 s
misses most of them. Here a path is the straight segments between successive true positions, and its clearance
is the smallest signed distance to the exact solids anywhere on it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.jit import compiled
from napf_mpc.world.bounding_tree import STACK, BoxTree, box_distance
from napf_mpc.world.distance import Solids, length3, signed_distance
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.queries import two_nearest
from napf_mpc.world.segment import segment_distance


class SweptClearance:
    """Running minimum of the signed distance between each UAV's path and the obstacles.

    Parameters
    ----------
    obstacles : ObstacleSet
        One scene a run, or one for all.
    runs, uavs : int
        Shape of the positions to come.

    Attributes
    ----------
    clearance : array, shape (run, uav)
        Smallest signed distance so far, at most 1e-7 m above the exact one; +inf before the first update and
        in an empty scene [m].
    index : array, shape (run, uav)
        Obstacle, within its scene, that gave the clearance; -1 for none.

    Raises
    ------
    ValueError
        If the runs do not fit the scenes.
    """

    def __init__(self, obstacles: ObstacleSet, runs: int, uavs: int) -> None:
        obstacles.check_runs(runs)
        self.obstacles = obstacles
        self.clearance = np.full((runs, uavs), np.inf)
        self.index = np.full((runs, uavs), -1, dtype=np.int64)
        # Obstacle nearest at the last look, and lower bounds of the distance to it and to all others now.
        self._nearest = np.full((runs, uavs), -1, dtype=np.int64)
        self._reserve = np.full((runs, uavs, 2), -np.inf)
        self._last = np.full((runs, uavs, 3), np.nan)

    def update(self, p0: ArrayLike, p1: ArrayLike, active: ArrayLike | None = None) -> None:
        """Take in one step of flight.

        Only obstacles that can beat the running minimum are looked at: a UAV that has flown less than its
        distance at the last look exceeds the minimum costs a few additions.

        Parameters
        ----------
        p0, p1 : array, shape (run, uav, 3)
            True positions at the start and end of the step [m]. A gap to the end of the previous step is not
            swept.
        active : array of bool, shape (run,), optional
            Runs that still fly; the positions of others are not looked at.

        Raises
        ------
        ValueError
            If a shape does not fit or a position of an active run is not finite.
        """
        self.take_in(*check_steps(p0, p1, active, self.clearance.shape))

    def take_in(
        self, start: NDArray[np.float64], stop: NDArray[np.float64], flying: NDArray[np.bool_]
    ) -> None:
        """Take in one step whose numbers :func:`check_steps` gave."""
        _update(
            self.obstacles.solids,
            self.obstacles.tree,
            self.obstacles.scene_start,
            start,
            stop,
            flying,
            self.clearance,
            self.index,
            self._nearest,
            self._reserve,
            self._last,
        )

    def contact(self, radius_m: ArrayLike = 0.0) -> NDArray[np.bool_]:
        """Whether each UAV has touched an obstacle: clearance <= radius, so an exact touch counts.

        Parameters
        ----------
        radius_m : float or array, broadcast to shape (run, uav)
            Radius of the UAV, >= 0 [m].

        Returns
        -------
        array of bool, shape (run, uav)
            False before the first update.

        Raises
        ------
        ValueError
            If a radius is negative or not finite.
        """
        radius = np.asarray(radius_m, dtype=np.float64)
        if not (np.isfinite(radius) & (radius >= 0.0)).all():
            raise ValueError(f"radius_m = {radius_m!r}, must be finite and >= 0")
        return np.broadcast_to(self.clearance <= radius, self.clearance.shape).copy()


def swept_separation(p0: ArrayLike, p1: ArrayLike, active: ArrayLike | None = None) -> NDArray[np.float64]:
    """Smallest distance of each UAV to any other of its run during a step, all moving evenly and straight.

    For two UAVs with relative position w and relative displacement v it is min over 0 <= t <= 1 of |w + t v|,
    reached at t = -w.v / v.v, clamped.

    Parameters
    ----------
    p0, p1 : array, shape (run, uav, 3)
        Positions at the start and end of the step [m].
    active : array of bool, shape (run,), optional
        Runs that still fly; the positions of others are not looked at.

    Returns
    -------
    array, shape (run, uav)
        Distance between centres; +inf for a UAV alone and in a run that is not active [m].

    Raises
    ------
    ValueError
        If a shape does not fit or a position of an active run is not finite.
    """
    start, stop, flying = check_steps(p0, p1, active, np.shape(p0)[:2])
    separation = np.full(start.shape[:2], np.inf)
    separate(start, stop, flying, separation)
    return separation


def check_steps(
    p0: ArrayLike, p1: ArrayLike, active: ArrayLike | None, shape: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Give positions at both ends of a step and the runs that fly, checked against a shape (run, uav)."""
    start = np.ascontiguousarray(p0, dtype=np.float64)
    stop = np.ascontiguousarray(p1, dtype=np.float64)
    for name, points in (("p0", start), ("p1", stop)):
        if points.ndim != 3 or points.shape != (*shape, 3):
            raise ValueError(f"{name} has shape {points.shape}, must be (run, uav, 3) = {(*shape, 3)}")
    flying = np.ones(shape[0], dtype=np.bool_) if active is None else np.ascontiguousarray(active)
    if flying.shape != shape[:1] or flying.dtype != np.bool_:
        raise ValueError(
            f"active has shape {flying.shape} and type {flying.dtype}, must be bool of shape {shape[:1]}"
        )
    for name, points in (("p0", start), ("p1", stop)):
        bad = _first_not_finite(points, flying)
        if bad >= 0:
            raise ValueError(f"{name} is not finite in run {bad}; mask such runs with active")
    return start, stop, flying


@compiled
def _first_not_finite(points: NDArray[np.float64], flying: NDArray[np.bool_]) -> int:
    """First flying run whose points (run, uav, 3) are not finite, or -1."""
    for r in range(points.shape[0]):
        if not flying[r]:
            continue
        for u in range(points.shape[1]):
            for axis in range(3):
                if not np.isfinite(points[r, u, axis]):
                    return r
    return -1


@compiled
def _update(
    solids: Solids,
    tree: BoxTree,
    scene_start: NDArray[np.int64],
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    flying: NDArray[np.bool_],
    clearance: NDArray[np.float64],
    index: NDArray[np.int64],
    nearest: NDArray[np.int64],
    reserve: NDArray[np.float64],
    last: NDArray[np.float64],
) -> None:
    nodes = np.empty(STACK, dtype=np.int64)
    shared = len(scene_start) == 2
    for r in range(start.shape[0]):
        if not flying[r]:
            continue
        scene = 0 if shared else r
        for u in range(start.shape[1]):
            a = start[r, u]
            b = stop[r, u]
            before = last[r, u]
            # The distance changes by at most the way gone, jumps between steps included.
            way = length3(b[0] - a[0], b[1] - a[1], b[2] - a[2])
            if not np.isnan(before[0]):
                way += length3(a[0] - before[0], a[1] - before[1], a[2] - before[2])
            for axis in range(3):
                before[axis] = b[axis]
            reserve[r, u, 0] -= way
            reserve[r, u, 1] -= way
            if reserve[r, u, 0] < clearance[r, u] and nearest[r, u] >= 0:
                i = nearest[r, u]
                d = segment_distance(solids, i, a, b, clearance[r, u])
                if d < clearance[r, u]:
                    clearance[r, u] = d
                    index[r, u] = i - scene_start[scene]
                reserve[r, u, 0] = signed_distance(solids, i, b[0], b[1], b[2])[0]
            if reserve[r, u, 1] < clearance[r, u]:
                d, i = _swept(solids, tree, scene, a, b, clearance[r, u], nodes)
                if i >= 0:
                    clearance[r, u] = d
                    index[r, u] = i - scene_start[scene]
                d, second, i = two_nearest(solids, tree, scene, b[0], b[1], b[2], nodes)
                nearest[r, u] = i
                reserve[r, u, 0] = d
                reserve[r, u, 1] = second


@compiled
def _swept(
    solids: Solids,
    tree: BoxTree,
    scene: int,
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    cap: float,
    nodes: NDArray[np.int64],
) -> tuple[float, int]:
    """Smallest signed distance below `cap` along a segment and its obstacle, or (cap, -1)."""
    half = 0.5 * length3(b[0] - a[0], b[1] - a[1], b[2] - a[2])
    mx = a[0] + 0.5 * (b[0] - a[0])
    my = a[1] + 0.5 * (b[1] - a[1])
    mz = a[2] + 0.5 * (b[2] - a[2])
    index = -1
    depth = 0
    if tree.root[scene] >= 0:
        nodes[0] = tree.root[scene]
        depth = 1
    while depth > 0:
        depth -= 1
        node = nodes[depth]
        if box_distance(tree.box, node, mx, my, mz) - half >= cap:
            continue
        if tree.right[node] >= 0:
            near = node + 1
            far = tree.right[node]
            if box_distance(tree.box, far, mx, my, mz) < box_distance(tree.box, near, mx, my, mz):
                near, far = far, near
            nodes[depth] = far
            nodes[depth + 1] = near
            depth += 2
            continue
        for entry in range(tree.first[node], tree.first[node] + tree.size[node]):
            i = tree.order[entry]
            if signed_distance(solids, i, mx, my, mz)[0] - half < cap:
                d = segment_distance(solids, i, a, b, cap)
                if d < cap:
                    cap = d
                    index = i
    return cap, index


@compiled
def separate(
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    flying: NDArray[np.bool_],
    separation: NDArray[np.float64],
) -> None:
    """Lower running minima (run, uav) of :func:`swept_separation` by a step that :func:`check_steps` gave."""
    for r in range(start.shape[0]):
        if not flying[r]:
            continue
        for i in range(start.shape[1]):
            for j in range(i):
                wx = start[r, i, 0] - start[r, j, 0]
                wy = start[r, i, 1] - start[r, j, 1]
                wz = start[r, i, 2] - start[r, j, 2]
                vx = stop[r, i, 0] - stop[r, j, 0] - wx
                vy = stop[r, i, 1] - stop[r, j, 1] - wy
                vz = stop[r, i, 2] - stop[r, j, 2] - wz
                square = vx * vx + vy * vy + vz * vz
                t = 0.0
                if square > 0.0:
                    t = min(max(-(wx * vx + wy * vy + wz * vz) / square, 0.0), 1.0)
                d = length3(wx + t * vx, wy + t * vy, wz + t * vz)
                separation[r, i] = min(separation[r, i], d)
                separation[r, j] = min(separation[r, j], d)
