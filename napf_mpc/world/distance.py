"""Exact signed distance and gradient of solids in flat arrays: sphere, cylinder, box, vertical prism.

The distance is Euclidean and three-dimensional, positive outside and negative inside, and the gradient is a
unit vector that points away from the solid. Cylinder, box and prism are vertical extrusions of a footprint,
so with d2 the signed distance to the footprint in the plane and dz = max(base - z, z - top),

    d = hypot(max(d2, 0), max(dz, 0))   outside,        d = max(d2, dz)   inside.

Where the distance has no gradient a fixed direction is returned, never NaN: up at the centre of a sphere,
east on the axis of a cylinder; between equally near faces the side wins over roof and floor, the roof over
the floor, a box's local x face over its y face and a prism's first edge over later ones. Within `TOUCH_M` of
an edge or corner the outward normal of one of its faces is returned. The rule is purely geometric: deep
inside a low building, the nearest face may well be the floor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare

SPHERE = 0
CYLINDER = 1
BOX = 2
PRISM = 3

# Columns of `Solids.parameters`. A sphere keeps its height in both BASE and TOP.
X, Y, A, B, COS, SIN, BASE, TOP = range(8)

TOUCH_M = 1e-9
"""Closer than this to an edge, corner, centre or axis [m], a rule decides the direction, not rounding."""


class Solids(NamedTuple):
    """Solids as flat arrays, the form that compiled loops read."""

    kind: NDArray[np.int64]  # (solid,) SPHERE, CYLINDER, BOX or PRISM
    parameters: NDArray[np.float64]  # (solid, 8) columns X, Y, A, B, COS, SIN, BASE, TOP
    rings: NDArray[np.int64]  # (solid, 2) first ring and the one after the last, prisms only
    ring_start: NDArray[np.int64]  # (ring + 1,) first vertex of each ring
    vertices: NDArray[np.float64]  # (vertex, 2) [m]


@compiled_bare
def length3(x: float, y: float, z: float) -> float:
    """Euclidean length that neither overflows nor, beyond rounding, differs from sqrt(x^2 + y^2 + z^2)."""
    square = x * x + y * y + z * z
    if square < 1e300:
        return math.sqrt(square)
    return math.hypot(math.hypot(x, y), z)


@compiled_bare
def ball_distance(dx: float, dy: float, dz: float, radius: float) -> tuple[float, float, float, float]:
    """Signed distance [m] of a ball about the origin, and its gradient (d, gx, gy, gz)."""
    radial = length3(dx, dy, dz)
    if radial < TOUCH_M:
        return radial - radius, 0.0, 0.0, 1.0
    return radial - radius, dx / radial, dy / radial, dz / radial


@compiled_bare
def signed_distance(
    solids: Solids, i: int, px: float, py: float, pz: float
) -> tuple[float, float, float, float]:
    """Signed distance [m] from a finite point to solid i, and its gradient (d, gx, gy, gz)."""
    kind = solids.kind[i]
    row = solids.parameters
    dx = px - row[i, X]
    dy = py - row[i, Y]
    if kind == SPHERE:
        return ball_distance(dx, dy, pz - row[i, BASE], row[i, A])
    if kind == CYLINDER:
        d2, gx, gy = _disc(dx, dy, row[i, A])
    elif kind == BOX:
        d2, gx, gy = _rectangle(dx, dy, row[i, A], row[i, B], row[i, COS], row[i, SIN])
    else:
        d2, gx, gy = _polygon(solids, i, px, py)
    below = row[i, BASE] - pz
    above = pz - row[i, TOP]
    up = 1.0 if above >= below else -1.0
    height = max(above, below)
    if d2 > 0.0 and height > 0.0:
        d = length3(d2, height, 0.0)
        if d >= TOUCH_M:
            return d, gx * (d2 / d), gy * (d2 / d), up * (height / d)
    if d2 >= height:
        return d2, gx, gy, 0.0
    return height, 0.0, 0.0, up


@compiled_bare
def _disc(dx: float, dy: float, radius: float) -> tuple[float, float, float]:
    """Signed distance and gradient of a disc about the origin."""
    radial = length3(dx, dy, 0.0)
    if radial < TOUCH_M:
        return radial - radius, 1.0, 0.0
    return radial - radius, dx / radial, dy / radial


@compiled_bare
def _rectangle(
    dx: float, dy: float, half_x: float, half_y: float, cos: float, sin: float
) -> tuple[float, float, float]:
    """Signed distance and gradient of a turned rectangle about the origin."""
    x = cos * dx + sin * dy
    y = cos * dy - sin * dx
    over_x = abs(x) - half_x
    over_y = abs(y) - half_y
    side_x = 1.0 if x >= 0.0 else -1.0
    side_y = 1.0 if y >= 0.0 else -1.0
    if over_x > 0.0 and over_y > 0.0:
        d = length3(over_x, over_y, 0.0)
        if d >= TOUCH_M:
            nx = side_x * (over_x / d)
            ny = side_y * (over_y / d)
            return d, cos * nx - sin * ny, sin * nx + cos * ny
    if over_x >= over_y:
        return over_x, cos * side_x, sin * side_x
    return over_y, -sin * side_y, cos * side_y


@compiled_bare
def _polygon(solids: Solids, i: int, px: float, py: float) -> tuple[float, float, float]:
    """Signed distance and gradient of the footprint of prism i (even-odd rule)."""
    vertices = solids.vertices
    inside = False
    nearest = math.inf
    at_a = at_b = -1
    at_t = 0.0
    for ring in range(solids.rings[i, 0], solids.rings[i, 1]):
        a = solids.ring_start[ring + 1] - 1
        for b in range(solids.ring_start[ring], solids.ring_start[ring + 1]):
            ax = vertices[a, 0] - px
            ay = vertices[a, 1] - py
            bx = vertices[b, 0] - px
            by = vertices[b, 1] - py
            ex = bx - ax
            ey = by - ay
            if (ay > 0.0) != (by > 0.0) and (ax * by - bx * ay > 0.0) == (ey > 0.0):
                inside = not inside
            t = min(max(-(ax * ex + ay * ey) / (ex * ex + ey * ey), 0.0), 1.0)
            qx = ax + t * ex
            qy = ay + t * ey
            square = qx * qx + qy * qy
            if square < nearest or at_a < 0:
                nearest = square
                at_a = a
                at_b = b
                at_t = t
            a = b
    ax = vertices[at_a, 0] - px
    ay = vertices[at_a, 1] - py
    ex = vertices[at_b, 0] - vertices[at_a, 0]
    ey = vertices[at_b, 1] - vertices[at_a, 1]
    edge = length3(ex, ey, 0.0)
    # The solid is on the left, so this is the outward normal.
    nx = ey / edge
    ny = -ex / edge
    sign = -1.0 if inside else 1.0
    if 0.0 < at_t < 1.0:
        # From the normal, not from p - q, which loses its digits next to the wall.
        offset = -(ax * nx + ay * ny)
        d = abs(offset)
        if d >= TOUCH_M and (offset < 0.0) != inside:
            # Only a ring that crosses itself has its solid on the right somewhere.
            return sign * d, -nx, -ny
        return sign * d, nx, ny
    qx = ax + at_t * ex
    qy = ay + at_t * ey
    d = length3(qx, qy, 0.0)
    if d < TOUCH_M:
        return sign * d, nx, ny
    return sign * d, -sign * (qx / d), -sign * (qy / d)


@compiled_bare
def inside_rings(
    vertices: NDArray[np.float64], ring_start: NDArray[np.int64], first: int, stop: int, px: float, py: float
) -> bool:
    """Whether a point of the plane is within an odd number of the rings first ... stop - 1."""
    inside = False
    for ring in range(first, stop):
        a = ring_start[ring + 1] - 1
        for b in range(ring_start[ring], ring_start[ring + 1]):
            ax = vertices[a, 0] - px
            ay = vertices[a, 1] - py
            bx = vertices[b, 0] - px
            by = vertices[b, 1] - py
            if (ay > 0.0) != (by > 0.0) and (ax * by - bx * ay > 0.0) == (by > ay):
                inside = not inside
            a = b
    return inside


@compiled_bare
def solid_on_left(vertices: NDArray[np.float64], ring_start: NDArray[np.int64], ring: int) -> bool:
    """Whether the solid of the even-odd rule lies to the left of a ring, judged at its longest edge."""
    stop = ring_start[ring + 1]
    longest = 0.0
    left = True
    a = stop - 1
    for b in range(ring_start[ring], stop):
        ex = vertices[b, 0] - vertices[a, 0]
        ey = vertices[b, 1] - vertices[a, 1]
        if math.hypot(ex, ey) > longest:
            mx = 0.5 * (vertices[a, 0] + vertices[b, 0])
            my = 0.5 * (vertices[a, 1] + vertices[b, 1])
            rings = len(ring_start) - 1
            on_left = inside_rings(vertices, ring_start, 0, rings, mx - 1e-7 * ey, my + 1e-7 * ex)
            on_right = inside_rings(vertices, ring_start, 0, rings, mx + 1e-7 * ey, my - 1e-7 * ex)
            # Equal on both sides: another edge lies on this one, which then bounds nothing.
            if on_left != on_right:
                longest = math.hypot(ex, ey)
                left = on_left
        a = b
    return left


@compiled
def solid_bounds(solids: Solids) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis-aligned box of each solid: lower and upper corners, shape (solid, 3) [m]."""
    n = len(solids.kind)
    lower = np.empty((n, 3))
    upper = np.empty((n, 3))
    for i in range(n):
        row = solids.parameters[i]
        lower[i, 2] = row[BASE]
        upper[i, 2] = row[TOP]
        if solids.kind[i] == PRISM:
            first = solids.ring_start[solids.rings[i, 0]]
            lower[i, :2] = solids.vertices[first]
            upper[i, :2] = solids.vertices[first]
            for v in range(first, solids.ring_start[solids.rings[i, 1]]):
                for axis in range(2):
                    lower[i, axis] = min(lower[i, axis], solids.vertices[v, axis])
                    upper[i, axis] = max(upper[i, axis], solids.vertices[v, axis])
            continue
        half_x = half_y = row[A]
        if solids.kind[i] == BOX:
            half_x = row[A] * abs(row[COS]) + row[B] * abs(row[SIN])
            half_y = row[A] * abs(row[SIN]) + row[B] * abs(row[COS])
        elif solids.kind[i] == SPHERE:
            lower[i, 2] -= row[A]
            upper[i, 2] += row[A]
        lower[i, 0] = row[X] - half_x
        upper[i, 0] = row[X] + half_x
        lower[i, 1] = row[Y] - half_y
        upper[i, 1] = row[Y] + half_y
    return lower, upper
