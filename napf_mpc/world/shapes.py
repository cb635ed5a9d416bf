"""Shapes that describe the world: sphere, cylinder, box and vertical prism, checked when they are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.world.distance import (
    BASE,
    BOX,
    CYLINDER,
    PRISM,
    SPHERE,
    TOP,
    TOUCH_M,
    A,
    Solids,
    X,
    Y,
    solid_on_left,
)


@dataclass(frozen=True)
class Sphere:
    """Ball.

    Parameters
    ----------
    centre_m : (x, y, z)
        Centre, east-north-up [m].
    radius_m : float
        Radius, > 0 [m].

    Raises
    ------
    ValueError
        If a number is not finite or the radius is not positive.
    """

    centre_m: tuple[float, float, float]
    radius_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_m", _numbers("Sphere.centre_m", self.centre_m, 3))
        object.__setattr__(self, "radius_m", _positive("Sphere.radius_m", self.radius_m))


@dataclass(frozen=True)
class Cylinder:
    """Vertical cylinder, endless by default.

    Parameters
    ----------
    centre_m : (x, y)
        Position of the axis [m].
    radius_m : float
        Radius, > 0 [m].
    base_m, top_m : float
        Heights of floor and roof, top above base; may be -inf and +inf [m].

    Raises
    ------
    ValueError
        If a number is not usable.
    """

    centre_m: tuple[float, float]
    radius_m: float
    base_m: float = -math.inf
    top_m: float = math.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_m", _numbers("Cylinder.centre_m", self.centre_m, 2))
        object.__setattr__(self, "radius_m", _positive("Cylinder.radius_m", self.radius_m))
        _set_heights(self, "Cylinder", self.base_m, self.top_m)


@dataclass(frozen=True)
class Box:
    """Upright box, turned about the vertical.

    Parameters
    ----------
    centre_m : (x, y, z)
        Centre [m].
    size_m : (lx, ly, lz)
        Full lengths along the box's own axes, > 0 [m].
    heading_rad : float
        Angle from east to the box's x axis, anticlockwise [rad].

    Raises
    ------
    ValueError
        If a number is not finite or a length is not positive.
    """

    centre_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    heading_rad: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_m", _numbers("Box.centre_m", self.centre_m, 3))
        size = _numbers("Box.size_m", self.size_m, 3)
        object.__setattr__(self, "size_m", tuple(_positive("Box.size_m", length) for length in size))
        object.__setattr__(self, "heading_rad", _numbers("Box.heading_rad", (self.heading_rad,), 1)[0])


@dataclass(frozen=True, eq=False)
class Prism:
    """Vertical prism over a polygon, such as a building.

    Parameters
    ----------
    rings : sequence of arrays, shape (vertex, 2)
        Outer ring and holes in any order and direction, closed or not; a point is inside when it is within an
        odd number of rings (even-odd rule), so one prism may also have several parts [m]. Stored without
        repeated vertices and directed so that the solid lies to the left of each edge. Where two parts share
        a wall, that wall still counts as surface; join the parts first if this matters.
    base_m, top_m : float
        Heights of floor and roof, top above base; may be -inf and +inf [m].

    Raises
    ------
    ValueError
        If a number is not usable, or a ring has fewer than three distinct vertices or no area.
    """

    rings: tuple[NDArray[np.float64], ...]
    base_m: float = -math.inf
    top_m: float = math.inf

    def __post_init__(self) -> None:
        if len(self.rings) == 0:
            raise ValueError("Prism.rings is empty: a prism needs at least one ring")
        rings = [_clean_ring(f"Prism.rings[{i}]", ring) for i, ring in enumerate(self.rings)]
        starts = np.cumsum([0, *map(len, rings)])
        vertices = np.concatenate(rings)
        for i, ring in enumerate(rings):
            if not solid_on_left(vertices, starts, i):
                rings[i] = np.ascontiguousarray(ring[::-1])
            rings[i].setflags(write=False)
        object.__setattr__(self, "rings", tuple(rings))
        _set_heights(self, "Prism", self.base_m, self.top_m)


Shape: TypeAlias = Sphere | Cylinder | Box | Prism


def pack(shapes: Sequence[Shape]) -> Solids:
    """Turn shapes into flat arrays, in order."""
    kind = np.zeros(len(shapes), dtype=np.int64)
    parameters = np.zeros((len(shapes), 8))
    rings = np.zeros((len(shapes), 2), dtype=np.int64)
    loops: list[NDArray[np.float64]] = []
    for i, shape in enumerate(shapes):
        row = parameters[i]
        if isinstance(shape, Sphere):
            kind[i] = SPHERE
            row[[X, Y, BASE, TOP, A]] = *shape.centre_m, shape.centre_m[2], shape.radius_m
        elif isinstance(shape, Cylinder):
            kind[i] = CYLINDER
            row[[X, Y, A, BASE, TOP]] = *shape.centre_m, shape.radius_m, shape.base_m, shape.top_m
        elif isinstance(shape, Box):
            kind[i] = BOX
            x, y, z = shape.centre_m
            lx, ly, lz = (0.5 * length for length in shape.size_m)
            row[:] = x, y, lx, ly, math.cos(shape.heading_rad), math.sin(shape.heading_rad), z - lz, z + lz
        elif isinstance(shape, Prism):
            kind[i] = PRISM
            row[[BASE, TOP]] = shape.base_m, shape.top_m
            rings[i] = len(loops), len(loops) + len(shape.rings)
            loops.extend(shape.rings)
        else:
            raise TypeError(f"shapes[{i}] is of type {type(shape).__name__}, not a Shape")
    ring_start = np.cumsum([0, *map(len, loops)], dtype=np.int64)
    vertices = np.concatenate(loops) if loops else np.zeros((0, 2))
    return Solids(kind, parameters, rings, ring_start, np.ascontiguousarray(vertices))


def unpack(solids: Solids, i: int) -> Shape:
    """Return solid i as a shape again (a box with its heading in (-pi, pi])."""
    x, y, a, b, cos, sin, base, top = (float(value) for value in solids.parameters[i])
    if solids.kind[i] == SPHERE:
        return Sphere((x, y, base), a)
    if solids.kind[i] == CYLINDER:
        return Cylinder((x, y), a, base, top)
    if solids.kind[i] == BOX:
        return Box((x, y, 0.5 * (base + top)), (2.0 * a, 2.0 * b, top - base), math.atan2(sin, cos))
    bounds = solids.ring_start[solids.rings[i, 0] : solids.rings[i, 1] + 1]
    return Prism(tuple(solids.vertices[s:e] for s, e in pairwise(bounds)), base, top)


def _numbers(name: str, values: ArrayLike, count: int) -> tuple[float, ...]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ValueError(f"{name} = {values!r}, must be {count} finite number{'s' if count > 1 else ''}")
    return tuple(float(value) for value in array)


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} = {value!r}, must be finite and > 0")
    return float(value)


def _set_heights(shape: object, name: str, base: float, top: float) -> None:
    if not base < top:
        raise ValueError(f"{name}.base_m = {base!r} and top_m = {top!r}, top must be above base")
    if base == math.inf or top == -math.inf:
        raise ValueError(f"{name}.base_m = {base!r} and top_m = {top!r} leave nothing between them")
    object.__setattr__(shape, "base_m", float(base))
    object.__setattr__(shape, "top_m", float(top))


def _clean_ring(name: str, ring: ArrayLike) -> NDArray[np.float64]:
    array = np.array(ring, dtype=np.float64, order="C")
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} has shape {array.shape}, must be (vertex, 2)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a vertex that is not finite")
    step = array - np.roll(array, -1, axis=0)
    array = array[np.hypot(step[:, 0], step[:, 1]) > TOUCH_M]
    if len(array) < 3:
        raise ValueError(f"{name} has {len(array)} distinct vertices, must have at least 3")
    x, y = (array - array[0]).T
    doubled = abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
    if doubled <= 1e-12 * float(np.ptp(x) + np.ptp(y)) ** 2:
        raise ValueError(f"{name} has no area: its vertices lie on one line, or its parts cancel")
    return array
