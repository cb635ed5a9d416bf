"""Limits of the flight: speed, tilt, height, fence (all soft) and rotor thrust (hard).

Bounds on states are soft because navigation jumps by metres: a hard one would leave a third of the programs
without any solution. The prices are exact penalties, set to about ten times the largest multiplier seen with
weights of order 0.1 on errors of order 10 m over a horizon of 8 s (see `clearance.CONTACT_W1`), per unit of
the row; the quadratic part spreads what cannot be met.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.constraints.clearance import check_opening, opening_distance
from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows, even_prices
from napf_mpc.problem import FormationMission, Vehicle
from napf_mpc.safety_distance import Inflation
from napf_mpc.vehicle.quadrotor import hover_input, mixer_inverse, rotor_limit

Array = NDArray[np.float64]

SPEED_W1, SPEED_W2 = 100.0, 10.0
"""Prices of a speed slack [1/(m/s s)], [1/((m/s)^2 s)].

A slack of 1 m/s over one second is worth 1 m of position, hence a tenth of the price of a metre of clearance:
a UAV may be hurried out of an obstacle, but not to catch up with its slot.
"""
TILT_W1, TILT_W2 = 1e5, 1e4
"""Prices of a tilt slack [1/(rad s)], [1/(rad^2 s)].

A UAV that reports itself metres inside a margin gains by every radian: one radian for 0.1 s is 1 m/s, worth
some thousands over the next seconds. The model knows nothing of that, since it never tumbles.
"""
PLACE_W1, PLACE_W2 = 1000.0, 100.0
"""Prices of a height or fence slack [1/(m s)], [1/(m^2 s)]; as for obstacles."""


def _soft(horizon: Horizon, count: int, w1: float, w2: float) -> tuple[Array, Array]:
    return even_prices((*horizon.shape, count), w1, w2)


def _everywhere(horizon: Horizon, values: Array) -> Array:
    return np.array(np.broadcast_to(values, (*horizon.shape, *values.shape)))


def _along(jac: Array, horizon: Horizon) -> Array:
    """Values (run, uav, N, m) of rows of the position where plans begin [m]."""
    return np.asarray(np.einsum("ruknd,rud->rukn", jac, horizon.position[:, :, 0]))


class _Steady:
    """Rows that are the same every step: made once, and again when what they follow from is another."""

    def __init__(self) -> None:
        self._made: tuple[Hashable, LinearRows] | None = None

    def rows(self, follow_from: Hashable, make: Callable[[], LinearRows]) -> LinearRows:
        """Rows as they were made from the same; nobody may write into them."""
        if self._made is None or self._made[0] != follow_from:
            self._made = follow_from, make()
        return self._made[1]


def _positive(**values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ConstraintError(f"{name} = {value!r}, must be finite and > 0")


@dataclass(frozen=True)
class SpeedLimit:
    """Hold the horizontal speed inside a regular polygon, and the vertical one in a band; softly, in m/s.

    The polygon lies inside the circle of the largest speed and has a corner straight along the path.
    """

    max_mps: float | None = None
    """Largest horizontal speed; by default the mission's speed times max_speed_ratio [m/s]."""
    max_climb_mps: float | None = None
    """Largest vertical speed up and down; by default the same [m/s]."""
    directions: int = 4
    """Two-sided horizontal rows: 2 make a square, 4 an octagon."""
    w1: float = SPEED_W1
    """Linear price of a slack [1/(m/s s)]."""
    w2: float = SPEED_W2
    """Quadratic price of a slack [1/((m/s)^2 s)]."""
    _kept: _Steady = field(default_factory=_Steady, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _positive(max_mps=self.max_mps, max_climb_mps=self.max_climb_mps)
        if self.directions < 2:
            raise ConstraintError(f"directions = {self.directions!r}, must be >= 2")

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "speed"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``|d_i^T v| <= v_max cos(pi / 2n)`` of n directions and ``|v_z| <= climb`` [m/s]."""
        most = self.max_mps if self.max_mps is not None else _mission_speed(horizon)
        climb = most if self.max_climb_mps is None else self.max_climb_mps
        heading = horizon.frame.heading_rad
        return self._kept.rows(
            (horizon.shape, most, heading), lambda: self._rows(horizon, most, climb, heading)
        )

    def _rows(self, horizon: Horizon, most: float, climb: float, heading_rad: float) -> LinearRows:
        n = self.directions
        angle = heading_rad + (np.arange(n) + 0.5) * math.pi / n
        flat = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
        jac = np.vstack([flat, [0.0, 0.0, 1.0]])
        bound = _everywhere(horizon, np.array([most * math.cos(0.5 * math.pi / n)] * n + [climb]))
        weights = _soft(horizon, n + 1, self.w1, self.w2)
        return LinearRows("velocity", _everywhere(horizon, jac), -bound, bound, *weights, steady=True)


def _mission_speed(horizon: Horizon) -> float:
    mission, planner = horizon.problem.mission, horizon.problem.planner
    if not isinstance(mission, FormationMission):
        raise ConstraintError("max_mps: this mission names no speed, so give it")
    return mission.speed_mps * planner.max_speed_ratio


@dataclass(frozen=True)
class TiltLimit:
    """Hold roll and pitch within a band around hover, where the model is linear; softly, in radians."""

    max_rad: float = math.radians(30.0)
    """Largest roll and pitch, each [rad]."""
    w1: float = TILT_W1
    """Linear price of a slack [1/(rad s)]."""
    w2: float = TILT_W2
    """Quadratic price of a slack [1/(rad^2 s)]."""
    _kept: _Steady = field(default_factory=_Steady, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _positive(max_rad=self.max_rad)

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "tilt"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``|roll| <= max`` and ``|pitch| <= max`` [rad]."""
        return self._kept.rows(horizon.shape, lambda: self._rows(horizon))

    def _rows(self, horizon: Horizon) -> LinearRows:
        bound = np.full((*horizon.shape, 2), self.max_rad)
        jac = _everywhere(horizon, np.eye(3)[:2])
        return LinearRows("attitude", jac, -bound, bound, *_soft(horizon, 2, self.w1, self.w2), steady=True)


@dataclass(frozen=True)
class AltitudeBand:
    """Keep the UAV's centre between two heights, softly, in metres."""

    min_m: float = -math.inf
    """Least height z [m]."""
    max_m: float = math.inf
    """Largest height z [m]."""
    inflation: Inflation | None = None
    """Keep k sigma clear of both; None holds the estimate inside. A band narrower than twice the margin
    shrinks to its middle."""
    opening_mps: float | None = None
    """A UAV that is outside now is asked to come in at this speed, not at once: the price of tens of metres
    would buy a dash. None asks at once [m/s]."""
    w1: float = PLACE_W1
    """Linear price of a slack [1/(m s)]."""
    w2: float = PLACE_W2
    """Quadratic price of a slack [1/(m^2 s)]."""

    def __post_init__(self) -> None:
        if not self.min_m < self.max_m or self.min_m == math.inf or self.max_m == -math.inf:
            raise ConstraintError(f"min_m = {self.min_m!r} must be below max_m = {self.max_m!r}")
        if math.isinf(self.min_m) and math.isinf(self.max_m):
            raise ConstraintError("give min_m, max_m or both: a band without either is none")
        check_opening(self.opening_mps)

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "altitude"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Row ``min_m + margin <= z <= max_m - margin`` [m]."""
        jac = _everywhere(horizon, np.array([[0.0, 0.0, 1.0]]))
        margin = np.zeros((*horizon.shape, 1))
        if self.inflation is not None:
            margin = self.inflation.margin(horizon.covariance, jac)
        margin = np.minimum(margin, 0.5 * (self.max_m - self.min_m))
        lower, upper = self.min_m + margin, self.max_m - margin
        # A margin that fills the band may leave them a digit the wrong way round.
        lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
        here, times_s = _along(jac, horizon), np.cumsum(horizon.step_s)
        return LinearRows(
            "position",
            jac,
            opening_distance(lower, here, self.opening_mps, times_s) if math.isfinite(self.min_m) else None,
            -opening_distance(-upper, -here, self.opening_mps, times_s)
            if math.isfinite(self.max_m)
            else None,
            *_soft(horizon, 1, self.w1, self.w2),
        )


@dataclass(frozen=True)
class Geofence:
    """Keep the UAV inside a convex polygon in the plane, softly, in metres."""

    corners_m: tuple[tuple[float, float], ...]
    """Corners (east, north) in order, either way round [m]."""
    inflation: Inflation | None = None
    """Keep k sigma and the UAV's radius clear of the fence; None holds the estimate of the centre inside."""
    opening_mps: float | None = None
    """A UAV that is outside now is asked to come in at this speed, not at once: the price of tens of metres
    would buy a dash. None asks at once [m/s]."""
    w1: float = PLACE_W1
    """Linear price of a slack [1/(m s)]."""
    w2: float = PLACE_W2
    """Quadratic price of a slack [1/(m^2 s)]."""

    def __post_init__(self) -> None:
        inward_normals(self.corners_m)
        check_opening(self.opening_mps)

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "geofence"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``n_i^T p >= n_i^T corner_i + margin``, n_i the inward unit normals of the edges [m]."""
        normals, level = inward_normals(self.corners_m)
        jac = _everywhere(horizon, np.column_stack([normals, np.zeros(len(level))]))
        lower = _everywhere(horizon, level)
        if self.inflation is not None:
            radius = horizon.problem.vehicle.radius_m
            lower = lower + radius + self.inflation.margin(horizon.covariance, jac)
        here, times_s = _along(jac, horizon), np.cumsum(horizon.step_s)
        lower = opening_distance(lower, here, self.opening_mps, times_s)
        return LinearRows("position", jac, lower, None, *_soft(horizon, len(level), self.w1, self.w2))


def inward_normals(corners_m: ArrayLike) -> tuple[Array, Array]:
    """Inward unit normals (edge, 2) of a convex polygon, and each edge's level n^T corner (edge,) [m].

    Raises
    ------
    ConstraintError
        If there are fewer than three corners, a number is not finite, or the polygon is not convex.
    """
    corners = np.asarray(corners_m, dtype=float)
    if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3 or not np.isfinite(corners).all():
        raise ConstraintError(
            f"corners_m has shape {corners.shape}, must be at least three finite (east, north)"
        )
    edge = np.roll(corners, -1, axis=0) - corners
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    headings = np.unwrap(np.arctan2(edge[:, 1], edge[:, 0]), period=2.0 * math.pi)
    around = abs(headings[-1] - headings[0]) < 2.0 * math.pi
    if not ((turn > 0.0).all() or (turn < 0.0).all()) or not around:
        raise ConstraintError(
            "corners_m does not describe a convex polygon: give its corners in order, none repeated or on a "
            "line with its neighbours"
        )
    left = np.column_stack([-edge[:, 1], edge[:, 0]]) * np.sign(turn[0])
    normals = left / np.hypot(left[:, 0], left[:, 1])[:, None]
    return normals, normals[:, 0] * corners[:, 0] + normals[:, 1] * corners[:, 1]


@dataclass(frozen=True)
class RotorLimits:
    """Hold every rotor's thrust between zero and the most it can give; hard, in newtons."""

    reserve: float = 0.0
    """Part of the largest thrust, 0 to 0.2, that is left at both ends to the feedback that flies the plan."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.reserve <= 0.2:
            raise ConstraintError(f"reserve = {self.reserve!r}, must be 0 to 0.2")

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "rotors"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``0 <= F_i <= F_max`` of the four rotors, on the input about hover [N].

        Raises
        ------
        ConstraintError
            If the reserve leaves no room for hover itself.
        """
        vehicle = horizon.problem.vehicle
        inverse, most = mixer_inverse(vehicle), rotor_limit(vehicle)
        hover = inverse @ hover_input(vehicle)
        kept = self.reserve * most
        if not ((hover > kept) & (hover < most - kept)).all():
            raise ConstraintError(
                f"reserve = {self.reserve:g} leaves rotors {kept:.3g} to {most - kept:.3g} N, "
                f"and hover needs {hover.max():.3g} N"
            )
        return LinearRows(
            "input",
            _everywhere(horizon, inverse),
            _everywhere(horizon, kept - hover),
            _everywhere(horizon, most - kept - hover),
        )


@dataclass(frozen=True)
class InputBox:
    """Hold thrust and torques in a box inside what the rotors give; hard, in newtons and newton metres.

    Smaller than :class:`RotorLimits`: the linear model does not know that a vehicle turned over in a tenth of
    a second is no longer one near hover, and the box leaves the rotors' reserve to the feedback.
    """

    least_thrust: float = 0.4
    """Least thrust over that of hover."""
    most_thrust: float = 1.7
    """Largest thrust over that of hover."""
    turn_radps2: float = 25.0
    """Largest angular acceleration in roll and pitch [rad/s^2]."""
    yaw_radps2: float = 5.0
    """Largest angular acceleration in yaw [rad/s^2]."""
    _kept: _Steady = field(default_factory=_Steady, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _positive(turn_radps2=self.turn_radps2, yaw_radps2=self.yaw_radps2)
        if not 0.0 <= self.least_thrust < 1.0 < self.most_thrust:
            raise ConstraintError(
                f"least_thrust = {self.least_thrust!r}, most_thrust = {self.most_thrust!r}: hover, 1, must "
                "lie between them"
            )

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "inputs"

    def bounds(self, vehicle: Vehicle) -> tuple[Array, Array]:
        """Lower and upper bounds (4,) on the input about hover [N, N m].

        Where the rotors cannot give every input of the box, it shrinks about hover until they can.
        """
        hover, inertia = hover_input(vehicle), np.array(vehicle.inertia_kgm2)
        torque = inertia * np.array([self.turn_radps2, self.turn_radps2, self.yaw_radps2])
        lower = np.append((self.least_thrust - 1.0) * hover[0], -torque)
        upper = np.append((self.most_thrust - 1.0) * hover[0], torque)
        inverse, most = mixer_inverse(vehicle), rotor_limit(vehicle)
        rest = inverse @ hover
        highest = np.maximum(inverse * lower, inverse * upper).sum(1)
        lowest = np.minimum(inverse * lower, inverse * upper).sum(1)
        part = min(1.0, float(((most - rest) / highest).min()), float((rest / -lowest).min()))
        return part * lower, part * upper

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``lower <= u <= upper`` of the four inputs about hover [N, N m]."""
        vehicle = horizon.problem.vehicle
        return self._kept.rows((horizon.shape, vehicle), lambda: self._rows(horizon, vehicle))

    def _rows(self, horizon: Horizon, vehicle: Vehicle) -> LinearRows:
        lower, upper = self.bounds(vehicle)
        return LinearRows(
            "input",
            _everywhere(horizon, np.eye(4)),
            _everywhere(horizon, lower),
            _everywhere(horizon, upper),
            steady=True,
        )
