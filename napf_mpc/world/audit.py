"""Independent audit of clearances with FCL, a collision library that shares no code with our distances.

It knows contact but not depth, is slow from Python, and crashes or hangs on input that it does not check, so
everything is checked here first, only unsigned distances are asked for and it is never part of the loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce

import fcl
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

BEYOND_M = 10.0
"""Length of an endless solid beyond the points asked about [m]; its nearest surface is level with them."""


def audit_clearance(shapes: Sequence[Shape], points: ArrayLike, radius_m: float) -> NDArray[np.float64]:
    """Distance between balls and the nearest of some shapes, by FCL.

    Endless cylinders and prisms are cut beyond the highest and lowest point. A prism becomes a triangle mesh,
    which is only a surface: whether a centre is within the prism is decided by shapely, even-odd rule.

    Parameters
    ----------
    shapes : sequence of Shape
        Obstacles of one scene.
    points : array, shape (point, 3)
        Centres of the balls [m].
    radius_m : float
        Radius of the balls, > 0: FCL has no points; audit those with a ball of a millimetre [m].

    Returns
    -------
    array, shape (point,)
        Distance from the ball's surface, 0.0 for contact or overlap of any depth, +inf without shapes [m].

    Raises
    ------
    ValueError
        If a point is not finite or the radius is not finite and positive.
    """
    centres = np.ascontiguousarray(points, dtype=np.float64)
    if centres.ndim != 2 or centres.shape[1] != 3 or not np.isfinite(centres).all():
        raise ValueError(f"points has shape {centres.shape}, must be (point, 3) and finite")
    if not (math.isfinite(radius_m) and radius_m > 0.0):
        raise ValueError(f"radius_m = {radius_m!r}, must be finite and > 0")
    result = np.full(len(centres), np.inf)
    # An empty manager answers 1.8e308 and min() of no heights fails: no question, no call.
    if len(shapes) == 0 or len(centres) == 0:
        return result
    low = float(centres[:, 2].min()) - BEYOND_M
    high = float(centres[:, 2].max()) + BEYOND_M
    manager = fcl.DynamicAABBTreeCollisionManager()
    manager.registerObjects([_fcl_object(shape, low, high) for shape in shapes])
    manager.setup()
    ball = fcl.Sphere(radius_m)
    for k, centre in enumerate(centres):
        # A used result keeps the smallest old distance, a moved object its old box: both are made afresh.
        data = fcl.DistanceData(request=fcl.DistanceRequest(enable_signed_distance=False))
        manager.distance(fcl.CollisionObject(ball, fcl.Transform(centre)), data, fcl.defaultDistanceCallback)
        result[k] = max(data.result.min_distance, 0.0)
    for shape in shapes:
        if isinstance(shape, Prism):
            within = (centres[:, 2] >= shape.base_m) & (centres[:, 2] <= shape.top_m)
            within &= shapely.intersects_xy(_footprint(shape), centres[:, 0], centres[:, 1])
            result[within] = 0.0
    return result


def _fcl_object(shape: Shape, low: float, high: float) -> fcl.CollisionObject:
    """Object for the broad phase; endless ends are cut at `low` and `high`, or past the other end."""
    if isinstance(shape, Sphere):
        return fcl.CollisionObject(fcl.Sphere(shape.radius_m), fcl.Transform(np.array(shape.centre_m)))
    if isinstance(shape, Box):
        cos, sin = math.cos(shape.heading_rad), math.sin(shape.heading_rad)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return fcl.CollisionObject(fcl.Box(*shape.size_m), fcl.Transform(turn, np.array(shape.centre_m)))
    base, top = shape.base_m, shape.top_m
    if base == -math.inf:
        base = min(low, top - BEYOND_M)
    if top == math.inf:
        top = max(high, base + BEYOND_M)
    if isinstance(shape, Cylinder):
        middle = np.array([*shape.centre_m, 0.5 * (base + top)])
        return fcl.CollisionObject(fcl.Cylinder(shape.radius_m, top - base), fcl.Transform(middle))
    return fcl.CollisionObject(_mesh(shape, base, top), fcl.Transform())


def _footprint(prism: Prism) -> shapely.Geometry:
    """Polygon of the rings by the even-odd rule."""
    areas = [shapely.make_valid(shapely.Polygon(ring)) for ring in prism.rings]
    return reduce(shapely.symmetric_difference, areas)


def _mesh(prism: Prism, base: float, top: float) -> fcl.BVHModel:
    """Closed surface of a prism: two triangles a wall, and the triangulated footprint as floor and roof."""
    triangles = []
    for ring in prism.rings:
        for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            triangles.append([(ax, ay, base), (bx, by, base), (bx, by, top)])
            triangles.append([(ax, ay, base), (bx, by, top), (ax, ay, top)])
    for piece in shapely.constrained_delaunay_triangles(_footprint(prism)).geoms:
        corners = np.asarray(piece.exterior.coords)[:3, :2]
        for height in (base, top):
            triangles.append([(x, y, height) for x, y in corners])
    corners = np.array(triangles, dtype=np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # A triangle without area would crash FCL, and bounds nothing.
    corners = corners[np.einsum("ti,ti->t", normal, normal) > 0.0]
    model = fcl.BVHModel()
    model.beginModel(len(corners) * 3, len(corners))
    model.addSubModel(corners.reshape(-1, 3), np.arange(len(corners) * 3).reshape(-1, 3))
    model.endModel()
    return model
