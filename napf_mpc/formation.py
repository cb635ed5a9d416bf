"""Virtual structure and motion synchronisation (section 2.2, Eq. 14-22), for any number of UAVs.

The formation is a set of slots that move along a straight path. UAV ``i`` has a lane (its lateral and
vertical place, fixed) and an along-track offset ``l_i`` from the formation's centre ``u_c``, the mean of
all along-track coordinates. A UAV ahead of its slot slows down (Eq. 18).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.problem import Circle, Formation, FormationMission, Line, Listed, Square, Vee

Array = NDArray[np.float64]

FEW = 8
"""NumPy adds up fewer numbers than these one after the other, and so can a loop, to the same last bit."""


@dataclass(frozen=True)
class PathFrame:
    """Right-handed frame of a straight path: along it, to its left (horizontal), up from it."""

    origin: Array
    """(3,) start of the path in the world [m]."""
    along: Array
    """(3,) unit vector n of the path's direction."""
    left: Array
    """(3,) horizontal unit vector to the left of the path."""
    up: Array
    """(3,) unit vector ``along x left``; vertical for a level path."""
    heading_rad: float
    """Direction of the path in the horizontal plane, counter-clockwise from east."""

    @classmethod
    def from_angles(
        cls, origin: tuple[float, float, float], heading_rad: float, climb_rad: float
    ) -> PathFrame:
        """Frame of a path with a heading (counter-clockwise from east) and a climb angle [rad].

        Raises
        ------
        ValueError
            If a number is not finite.
        """
        if not np.isfinite([*origin, heading_rad, climb_rad]).all():
            raise ValueError(
                f"origin = {origin}, heading_rad = {heading_rad!r}, climb_rad = {climb_rad!r} must be finite"
            )
        ch, sh = _cos_sin(heading_rad)
        cc, sc = _cos_sin(climb_rad)
        along = np.array([ch * cc, sh * cc, sc])
        left = np.array([-sh, ch, 0.0])
        return cls(np.asarray(origin, dtype=float), along, left, np.cross(along, left), heading_rad)

    @classmethod
    def of_mission(cls, mission: FormationMission) -> PathFrame:
        """Frame of a mission's path."""
        return cls.from_angles(
            mission.start_m, math.radians(mission.heading_deg), math.radians(mission.climb_deg)
        )

    @cached_property
    def axes(self) -> Array:
        """(3, 3) rows along, left, up."""
        return np.stack([self.along, self.left, self.up])

    def to_world(self, coordinates: Array) -> Array:
        """World positions (..., 3) of path coordinates (..., 3): along, left, up [m]."""
        return self.origin + self.directions_to_world(coordinates)

    def directions_to_world(self, coordinates: Array) -> Array:
        """World vectors (..., 3) of vectors in path coordinates (..., 3), without the origin."""
        a, b, c = coordinates[..., 0:1], coordinates[..., 1:2], coordinates[..., 2:3]
        return np.asarray(a * self.along + b * self.left + c * self.up)

    def to_path(self, positions: Array) -> Array:
        """Path coordinates (..., 3) of world positions (..., 3) [m]."""
        points, out = _points(positions), np.empty(np.shape(positions))
        _project(points, self.origin, self.axes, out.reshape(points.shape))
        return out

    def along_track(self, positions: Array) -> Array:
        """Along-track coordinate u_i = n^T (X_i - P) of Eq. 17 as read, (...) [m]."""
        points, out = _points(positions), np.empty(np.shape(positions)[:-1])
        _project(points, self.origin, self.axes[:1], out.reshape(len(points), 1))
        return out


def _points(positions: Array) -> Array:
    """Positions (..., 3) as one block of memory (point, 3), the only kind that is compiled for."""
    points = np.ascontiguousarray(positions, dtype=np.float64).reshape(-1, 3)
    return points if points.flags.writeable else points.copy()


@compiled_bare
def _project(points: Array, origin: Array, axes: Array, out: Array) -> None:
    """Write coordinates (point, axis) of points from an origin along some axes.

    Written out: a matrix product over a batch could differ in the last bit with the batch size.
    """
    for n in range(points.shape[0]):
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        for a in range(axes.shape[0]):
            out[n, a] = x * axes[a, 0] + y * axes[a, 1] + z * axes[a, 2]


def _cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine that are exact at quarter turns, so that a path to the north has no eastward part."""
    quarters = angle / (math.pi / 2.0)
    if abs(quarters - round(quarters)) < 1e-12:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(angle), math.sin(angle)


@dataclass(frozen=True)
class SquareGeometry:
    """The paper's turned square (Eq. 15, 17)."""

    alpha_rad: float
    """Angle between the diagonal of UAV 1 and 2 and the path."""
    beta_rad: float
    """45 degrees minus alpha."""
    lanes_m: Array
    """(4,) lateral places."""
    along_m: Array
    """(4,) signed along-track offsets l_i."""


def square_geometry(side_m: float, first_lane_m: float) -> SquareGeometry:
    r"""Lanes and offsets of the paper's square (Eq. 15 and 17, the latter as read: signed offsets).

    ``alpha = asin(sqrt(2) |p_1y| / s)``, ``beta = 45 deg - alpha``; lanes ``p_1y, -p_1y, -p_1y - s sin(beta),
    p_1y + s sin(beta)``; offsets ``(c, -c, d, -d)`` with ``c = s / sqrt(2) cos(alpha)`` and
    ``d = s / sqrt(2) sin(alpha)``. UAV 1-2 and 3-4 are the diagonals. A negative first lane gives the mirror
    image.

    Raises
    ------
    ValueError
        If the side is not a positive number, or the first lane lies outside the square's half diagonal.
    """
    half_diagonal = side_m / math.sqrt(2.0)
    if not (0.0 < side_m < math.inf and abs(first_lane_m) <= half_diagonal):
        raise ValueError(
            f"side_m = {side_m:g} must be > 0 and first_lane_m = {first_lane_m:g} within side_m / sqrt(2)"
        )
    alpha = math.asin(min(1.0, abs(first_lane_m) / half_diagonal))
    beta = math.pi / 4.0 - alpha
    c = half_diagonal * math.cos(alpha)
    d = half_diagonal * math.sin(alpha)
    outer = first_lane_m + math.copysign(side_m, first_lane_m) * math.sin(beta)
    return SquareGeometry(
        alpha, beta, np.array([first_lane_m, -first_lane_m, -outer, outer]), np.array([c, -c, d, -d])
    )


def formation_offsets(formation: Formation) -> Array:
    """Offsets of the slots from the formation's centre on its path.

    Returns
    -------
    array, shape (uav, 3)
        Along the path (l_i, mean zero, so that u_c is the mean of the along-track coordinates), to its
        left (lane), up [m].
    """
    match formation:
        case Square():
            geometry = square_geometry(formation.side_m, formation.first_lane_m)
            offsets = np.column_stack([geometry.along_m, geometry.lanes_m, np.zeros(4)])
        case Line():
            place = (np.arange(formation.count) - (formation.count - 1) / 2.0) * formation.spacing_m
            cos, sin = _cos_sin(math.radians(formation.bearing_deg))
            offsets = np.column_stack([place * cos, place * sin, np.zeros(formation.count)])
        case Vee():
            rank = (np.arange(formation.count) + 1) // 2
            side = np.where(np.arange(formation.count) % 2 == 1, 1.0, -1.0)
            cos, sin = _cos_sin(math.radians(formation.opening_deg) / 2.0)
            reach = rank * formation.spacing_m
            offsets = np.column_stack([-reach * cos, side * reach * sin, np.zeros(formation.count)])
        case Circle():
            turn = 2.0 * math.pi * np.arange(formation.count) / formation.count
            angle = turn + math.radians(formation.phase_deg)
            offsets = np.column_stack(
                [
                    formation.radius_m * np.cos(angle),
                    formation.radius_m * np.sin(angle),
                    np.zeros(formation.count),
                ]
            )
        case Listed():
            offsets = np.array(formation.offsets_m, dtype=float)
    offsets[:, 0] -= math.fsum(offsets[:, 0]) / len(offsets)
    return offsets


def synchronisation_error(along: Array, offsets: Array) -> Array:
    """Synchronisation errors ef_i = u_i - (u_c + l_i), u_c the mean of the u_i (Eq. 18).

    Parameters
    ----------
    along : array, shape (..., uav)
        Along-track coordinates u_i [m].
    offsets : array, shape (uav,)
        Signed along-track offsets l_i [m], mean zero.

    Returns
    -------
    array, shape (..., uav)
        Positive for a UAV ahead of its slot [m]; their sum is zero.
    """
    if along.ndim == 2 and along.shape[1] < FEW:
        error = np.empty(along.shape)
        _error(np.ascontiguousarray(along), np.ascontiguousarray(offsets), error)
        return error
    centre = np.ascontiguousarray(along).mean(axis=-1, keepdims=True)
    return np.asarray(along - (centre + offsets))


@compiled_bare
def _error(along: Array, offsets: Array, error: Array) -> None:
    """Write synchronisation errors (run, uav) of formations of fewer than :data:`FEW`."""
    uavs = along.shape[1]
    for run in range(along.shape[0]):
        total = 0.0
        for uav in range(uavs):
            total += along[run, uav]
        centre = total / uavs
        for uav in range(uavs):
            error[run, uav] = along[run, uav] - (centre + offsets[uav])


def reference_speed(
    speed_mps: float, sync_gain: float, error: Array, low_mps: float, high_mps: float
) -> Array:
    """Synchronised reference speeds V_ri = V_r + k_f ef_i (Eq. 18), held between two bounds [m/s]."""
    return np.clip(speed_mps + sync_gain * error, low_mps, high_mps)


def tracking_errors(
    position: Array, velocity: Array, path_point: Array, direction: Array, speed: Array
) -> tuple[Array, Array]:
    """Cross-track and velocity errors e_p = (I - n n^T)(X - P) and e_v = X' - n V (Eq. 14).

    Parameters
    ----------
    position, velocity, path_point, direction : array, shape (..., 3)
        X [m], X' [m/s], P [m] and the unit vector n.
    speed : array, shape (...)
        V [m/s].

    Returns
    -------
    tuple of array, shape (..., 3)
        e_p [m] and e_v [m/s].
    """
    offset = position - path_point
    cross = offset - direction * (offset * direction).sum(-1, keepdims=True)
    return cross, velocity - direction * speed[..., None]


def commanded_acceleration(
    position_error: Array, velocity_error: Array, position_gain: float, velocity_gain: float
) -> Array:
    """Control law f_i = -k_p e_p - k_v e_v (Eq. 20-22; the third line's sign as in the fourth).

    With e_v taken against n V_ri the term k_v k_f n ef_i of Eq. 22 is in it.

    Returns
    -------
    array, shape (..., 3)
        Commanded acceleration [m/s^2].
    """
    return -position_gain * position_error - velocity_gain * velocity_error
