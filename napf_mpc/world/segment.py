"""Smallest signed distance between a solid and a straight flight segment, within `TOLERANCE_M`.

Spheres and endless cylinders have a closed form. The signed distance to any convex solid is convex along a
line, so for boxes and cylinders tangents bound it from below and close in on the minimum. A prism is treated
outside as its walls, each of them convex (its roof needs no look of its own: over it the distance is linear),
and inside by branch and bound, where minus the distance to one wall is concave and thus above its chord.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.world.distance import (
    BASE,
    CYLINDER,
    PRISM,
    SPHERE,
    TOP,
    TOUCH_M,
    A,
    Solids,
    X,
    Y,
    length3,
    signed_distance,
)

TOLERANCE_M = 1e-7
"""How far above the true minimum of a segment the value found may be [m]."""

TANGENTS = 80
"""Most evaluations along one segment for a convex solid; about 15 are needed for a curve of 10 m radius."""

BRANCHES = 4000
"""Most evaluations of how deep a segment is within a prism; contact itself never depends on it."""


@compiled
def segment_distance(
    solids: Solids, i: int, start: NDArray[np.float64], stop: NDArray[np.float64], cap: float
) -> float:
    """Smallest signed distance [m] of solid i along a segment.

    The value is the distance at some point of the segment. It is within `TOLERANCE_M` of the minimum if the
    minimum is below `cap`; otherwise it may be any value from `cap` - `TOLERANCE_M` on.
    """
    length = length3(stop[0] - start[0], stop[1] - start[1], stop[2] - start[2])
    row = solids.parameters[i]
    radius: float = row[A]
    if solids.kind[i] == SPHERE:
        return _to_point(start, stop, row[X], row[Y], row[BASE], 1.0) - radius
    if solids.kind[i] == CYLINDER and row[BASE] == -np.inf and row[TOP] == np.inf:
        return _to_point(start, stop, row[X], row[Y], 0.0, 0.0) - radius
    if solids.kind[i] != PRISM:
        return _convex(solids, i, -1, -1, start, stop, length, cap)
    return _prism(solids, i, start, stop, length, cap)


@compiled_bare
def _to_point(
    start: NDArray[np.float64], stop: NDArray[np.float64], x: float, y: float, z: float, vertical: float
) -> float:
    """Smallest distance of a segment to a point, or with vertical = 0 to the vertical line through it."""
    wx = start[0] - x
    wy = start[1] - y
    wz = vertical * (start[2] - z)
    vx = stop[0] - start[0]
    vy = stop[1] - start[1]
    vz = vertical * (stop[2] - start[2])
    square = vx * vx + vy * vy + vz * vz
    t = 0.0
    if square > 0.0:
        t = min(max(-(wx * vx + wy * vy + wz * vz) / square, 0.0), 1.0)
    # The end itself rather than start + (stop - start), so that the next segment begins with the same value.
    if t == 1.0:
        return length3(stop[0] - x, stop[1] - y, vertical * (stop[2] - z))
    return length3(wx + t * vx, wy + t * vy, wz + t * vz)


@compiled_bare
def _wall(
    solids: Solids, i: int, v: int, w: int, px: float, py: float, pz: float
) -> tuple[float, float, float, float]:
    """Distance and gradient of the wall of prism i between vertices v and w; 0 and no gradient on it."""
    ax = solids.vertices[v, 0] - px
    ay = solids.vertices[v, 1] - py
    ex = solids.vertices[w, 0] - solids.vertices[v, 0]
    ey = solids.vertices[w, 1] - solids.vertices[v, 1]
    t = min(max(-(ax * ex + ay * ey) / (ex * ex + ey * ey), 0.0), 1.0)
    x = -(ax + t * ex)
    y = -(ay + t * ey)
    z = min(pz - solids.parameters[i, BASE], 0.0) + max(pz - solids.parameters[i, TOP], 0.0)
    d = length3(x, y, z)
    if d < TOUCH_M:
        return 0.0, 0.0, 0.0, 0.0
    return d, x / d, y / d, z / d


@compiled_bare
def _probe(
    solids: Solids,
    i: int,
    v: int,
    w: int,
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    length: float,
    s: float,
) -> tuple[float, float]:
    """Distance to solid i (or, with v >= 0, to one wall of it) s metres along a segment, and its slope."""
    t = s / length if length > 0.0 else 0.0
    vx = stop[0] - start[0]
    vy = stop[1] - start[1]
    vz = stop[2] - start[2]
    px = start[0] + t * vx if t < 1.0 else stop[0]
    py = start[1] + t * vy if t < 1.0 else stop[1]
    pz = start[2] + t * vz if t < 1.0 else stop[2]
    if v >= 0:
        d, gx, gy, gz = _wall(solids, i, v, w, px, py, pz)
    else:
        d, gx, gy, gz = signed_distance(solids, i, px, py, pz)
    return d, (gx * vx + gy * vy + gz * vz) / length if length > 0.0 else 0.0


@compiled
def _convex(
    solids: Solids,
    i: int,
    v: int,
    w: int,
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    length: float,
    cap: float,
) -> float:
    """Smallest distance of a convex solid, or of one wall, along a segment, by tangents."""
    low = 0.0
    d_low, slope_low = _probe(solids, i, v, w, start, stop, length, low)
    if slope_low >= 0.0:
        return d_low
    high = length
    d_high, slope_high = _probe(solids, i, v, w, start, stop, length, high)
    if slope_high <= 0.0:
        return d_high
    best = min(d_low, d_high)
    for step in range(TANGENTS):
        s = (d_high - d_low + slope_low * low - slope_high * high) / (slope_low - slope_high)
        if d_low + slope_low * (s - low) >= min(best, cap) - TOLERANCE_M:
            break
        # Tangents meet on a kink at once but may creep, halving does neither.
        if step % 3 == 2 or not low < s < high:
            s = 0.5 * (low + high)
        d, slope = _probe(solids, i, v, w, start, stop, length, s)
        best = min(best, d)
        if slope < 0.0:
            low = s
            d_low = d
            slope_low = slope
        elif slope > 0.0:
            high = s
            d_high = d
            slope_high = slope
        else:
            break
    return best


@compiled
def _prism(
    solids: Solids,
    i: int,
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    length: float,
    cap: float,
) -> float:
    """Smallest signed distance of prism i along a segment."""
    best = _probe(solids, i, -1, -1, start, stop, length, 0.0)[0]
    best = min(best, _probe(solids, i, -1, -1, start, stop, length, length)[0])
    rise = stop[2] - start[2]
    for level in (solids.parameters[i, BASE], solids.parameters[i, TOP]):
        # A thin slab may be pierced from roof to floor, past all walls.
        if (start[2] < level) != (stop[2] < level):
            s = length * min(max((level - start[2]) / rise, 0.0), 1.0)
            best = min(best, _probe(solids, i, -1, -1, start, stop, length, s)[0])
    for ring in range(solids.rings[i, 0], solids.rings[i, 1]):
        v = solids.ring_start[ring + 1] - 1
        for w in range(solids.ring_start[ring], solids.ring_start[ring + 1]):
            if best <= 0.0:
                break
            middle = _probe(solids, i, v, w, start, stop, length, 0.5 * length)[0]
            if middle - 0.5 * length < min(best, cap):
                best = min(best, _convex(solids, i, v, w, start, stop, length, min(best, cap)))
            v = w
    if best <= 2.0 * TOLERANCE_M and cap > best - length:
        return _depth(solids, i, start, stop, length, best, cap)
    return best


@compiled
def _depth(
    solids: Solids,
    i: int,
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    length: float,
    best: float,
    cap: float,
) -> float:
    """Smallest signed distance of prism i along a segment that touches it, by branch and bound."""
    spans = np.empty((128, 4))
    spans[0] = (
        0.0,
        length,
        _probe(solids, i, -1, -1, start, stop, length, 0.0)[0],
        _probe(solids, i, -1, -1, start, stop, length, length)[0],
    )
    depth = 1
    for _ in range(BRANCHES):
        if depth == 0:
            break
        depth -= 1
        low, high, d_low, d_high = spans[depth]
        limit = min(best, cap) - TOLERANCE_M
        if 0.5 * (d_low + d_high - (high - low)) >= limit:
            continue
        if _inner_bound(solids, i, start, stop, length, low, high) >= limit:
            continue
        middle = 0.5 * (low + high)
        d = _probe(solids, i, -1, -1, start, stop, length, middle)[0]
        best = min(best, d)
        if depth + 2 > len(spans):
            continue
        spans[depth] = low, middle, d_low, d
        spans[depth + 1] = middle, high, d, d_high
        depth += 2
    return best


@compiled
def _inner_bound(
    solids: Solids,
    i: int,
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    length: float,
    low: float,
    high: float,
) -> float:
    """Lower bound of the signed distance between two places: that of the best single wall, roof or floor."""
    ax = start[0] + low / length * (stop[0] - start[0])
    ay = start[1] + low / length * (stop[1] - start[1])
    az = start[2] + low / length * (stop[2] - start[2])
    bx = start[0] + high / length * (stop[0] - start[0])
    by = start[1] + high / length * (stop[1] - start[1])
    bz = start[2] + high / length * (stop[2] - start[2])
    bound: float = max(solids.parameters[i, BASE] - max(az, bz), min(az, bz) - solids.parameters[i, TOP])
    for ring in range(solids.rings[i, 0], solids.rings[i, 1]):
        v = solids.ring_start[ring + 1] - 1
        for w in range(solids.ring_start[ring], solids.ring_start[ring + 1]):
            farther = max(_edge(solids, v, w, ax, ay), _edge(solids, v, w, bx, by))
            bound = max(bound, -farther)
            v = w
    return bound


@compiled_bare
def _edge(solids: Solids, v: int, w: int, px: float, py: float) -> float:
    """Distance in the plane to the edge between vertices v and w."""
    ax = solids.vertices[v, 0] - px
    ay = solids.vertices[v, 1] - py
    ex = solids.vertices[w, 0] - solids.vertices[v, 0]
    ey = solids.vertices[w, 1] - solids.vertices[v, 1]
    t = min(max(-(ax * ex + ay * ey) / (ex * ex + ey * ey), 0.0), 1.0)
    return math.hypot(ax + t * ex, ay + t * ey)
