r"""Keep UAVs apart by rows against each other's last shared plans.

Around each UAV stands an ellipsoid of half-axes (d, d, e d): d the least distance of two centres, e >= 1 the
stretch of its vertical axis for the downwash. Scaling the vertical by 1 / e turns it into a ball; across the
scaled line of centres lies a plane that touches it, whose unit normal in the world is n and whose distance
from the centre is d_n. Two UAVs that keep ``n^T (p_i - p_j) >= d_n + k sqrt(n^T C n)`` are apart, with
``C = Sigma_i + Sigma_j - Sigma_ij - Sigma_ij^T``: what two receivers have in common drops out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.safety_distance import Inflation, directional_sigma

Array = NDArray[np.float64]

SEPARATION_W1 = 1000.0
"""Linear price of a separation slack [1/(m s)]; as for obstacles, a hit is a hit."""
SEPARATION_W2 = 100.0
"""Quadratic price of a separation slack [1/(m^2 s)]."""
TOUCH_M = 1e-9
"""UAVs planned closer than this [m] have no line of centres: the lower index goes to the left of the path."""


def relative_covariance(covariance: Array, common_factor: Array) -> Array:
    """Covariance of the position of each UAV relative to each other one: Sigma_i + Sigma_j - Sigma_ij - Sigma_ij^T.

    Parameters
    ----------
    covariance : array, shape (..., uav, 3, 3)
        Of each position [m^2].
    common_factor : array, shape (..., uav, 3, rank)
        Factor of what they share, Sigma_ij = L_i L_j^T [m].

    Returns
    -------
    array, shape (..., uav, uav, 3, 3)
        [m^2].
    """  # noqa: E501
    factor = common_factor
    uavs = covariance.shape[-3]
    cross = np.zeros((*factor.shape[:-3], uavs, uavs, 3, 3))
    for c in range(factor.shape[-1]):
        own = factor[..., c]
        cross += own[..., :, None, :, None] * own[..., None, :, None, :]
    both = covariance[..., :, None, :, :] + covariance[..., None, :, :, :]
    return np.asarray(both - (cross + np.swapaxes(cross, -1, -2)))


def tangent(offset: Array, distance_m: float, stretch: float, fallback: Array) -> tuple[Array, Array]:
    """Plane between two UAVs: its unit normal, and its distance from the centre of the ellipsoid it touches.

    Parameters
    ----------
    offset : array, shape (..., 3)
        From the neighbour to the UAV [m].
    distance_m : float
        Horizontal half-axis d [m].
    stretch : float
        e: the vertical half-axis over the horizontal one.
    fallback : array, broadcast to shape (..., 3)
        Unit normal for UAVs in the same place; horizontal.

    Returns
    -------
    normal : array, shape (..., 3)
        Unit vector.
    reach : array, shape (...)
        d_n = d sqrt(n_x^2 + n_y^2 + e^2 n_z^2) [m].
    """
    # The normal of the plane across D^-1 r is D^-1 (D^-1 r), D = diag(1, 1, e).
    x, y, z = offset[..., 0], offset[..., 1], offset[..., 2] / stretch**2
    length = np.sqrt(x * x + y * y + z * z)
    same = np.sqrt(x * x + y * y + offset[..., 2] ** 2) < TOUCH_M
    normal = np.stack([x, y, z], axis=-1) / np.where(same, 1.0, length)[..., None]
    normal = np.where(same[..., None], fallback, normal)
    flat = normal[..., 0] ** 2 + normal[..., 1] ** 2
    return normal, distance_m * np.sqrt(flat + (stretch * normal[..., 2]) ** 2)


@dataclass(frozen=True)
class NeighbourSeparation:
    """Stay apart from the nearest other UAVs, softly.

    Each pair shares out what it has to yield, or may use up: against the plane between their last plans,
    UAV i keeps ``n^T p_i >= n^T p_i,lin + share (required - gap) - s``. With half each, two UAVs that both
    keep their rows are apart whatever else they do; with ``share = 1`` a UAV takes the neighbour's plan as
    fixed, for a neighbour that does not yield. The choice of the nearest is each UAV's own, so let
    ``neighbours`` cover all that can come close.
    """

    neighbours: int = 3
    """Rows of each stage M; a formation of fewer leaves some switched off."""
    distance_m: float | None = None
    """Least distance of two centres d; by default the vehicle's min_separation_m [m]."""
    stretch: float = 1.0
    """e >= 1: how much farther UAVs stay apart vertically, because of the downwash."""
    share: float = 0.5
    """Part of the correction that each UAV of a pair takes, 0.5 to 1."""
    inflation: Inflation | None = None
    """How k sigma enters; by default as the problem's planner section says."""
    slot_part: float | None = None
    """The distance asked of a pair is at most this part of the distance of their slots (but never less than
    d_n): a margin that the formation itself cannot keep would push all UAVs off their slots for good, see
    :func:`margin_attainable`. None asks for all of it."""
    opening_mps: float | None = None
    """A gap that is short now is asked to open at this speed, not at once: UAVs that take off side by side
    part calmly. None asks at once [m/s]."""
    reach_m: float = 20.0
    """Neighbours whose gap beyond the required distance is this or more are left out [m]."""
    w1: float = SEPARATION_W1
    """Linear price of a slack [1/(m s)]."""
    w2: float = SEPARATION_W2
    """Quadratic price of a slack [1/(m^2 s)]."""

    def __post_init__(self) -> None:
        if self.neighbours < 1 or not self.stretch >= 1.0 or not 0.5 <= self.share <= 1.0:
            raise ConstraintError(
                f"neighbours = {self.neighbours!r}, stretch = {self.stretch!r}, share = {self.share!r}: "
                "must be >= 1, >= 1 and 0.5 to 1"
            )
        if self.distance_m is not None and not self.distance_m >= 0.0:
            raise ConstraintError(f"distance_m = {self.distance_m!r}, must be >= 0")
        for name, value in (("slot_part", self.slot_part), ("opening_mps", self.opening_mps)):
            if value is not None and not value >= 0.0:
                raise ConstraintError(f"{name} = {value!r}, must be >= 0, or None")

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "neighbours"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows on the position, one for each of the nearest neighbours of each stage [m]."""
        runs, uavs, stages = horizon.shape
        inflation = self.inflation or Inflation.of_problem(horizon.problem)
        distance_m = _distance(self.distance_m, horizon.problem)
        # Axes (run, stage, uav, neighbour): a plan against all others at the same stage.
        position = horizon.position.transpose(0, 2, 1, 3)
        offset = position[:, :, :, None, :] - position[:, :, None, :, :]
        normal, reach = tangent(offset, distance_m, self.stretch, _aside(uavs, horizon.frame))
        relative = relative_covariance(
            horizon.covariance.transpose(0, 2, 1, 3, 4), horizon.common_factor[:, None]
        )
        required = reach + _margin(inflation, relative, normal)
        required = np.maximum(reach, np.minimum(required, self._largest(horizon, offset[:, :1])))
        gap = _dot(normal, offset)
        spare = gap - required
        spare[..., np.arange(uavs), np.arange(uavs)] = np.inf
        spare = np.where(spare < self.reach_m, spare, np.inf)

        chosen = np.argsort(spare, axis=-1, kind="stable")[..., : self.neighbours]
        # Rows that keep their places from stage to stage and step to step keep a warm start warm.
        taken = np.take_along_axis(spare, chosen, -1)
        order = np.argsort(np.where(np.isfinite(taken), chosen, uavs), axis=-1, kind="stable")
        chosen, spare = np.take_along_axis(chosen, order, -1), np.take_along_axis(taken, order, -1)
        active = np.isfinite(spare)
        jac = np.where(active[..., None], np.take_along_axis(normal, chosen[..., None], -2), 0.0)
        lower = np.where(active, _dot(jac, position[..., None, :]) - self.share * spare, -np.inf)

        shape = (runs, uavs, stages, self.neighbours)
        found = jac.shape[-2]
        padded_jac, padded_lower = np.zeros((*shape, 3)), np.full(shape, -np.inf)
        padded_jac[..., :found, :] = jac.transpose(0, 2, 1, 3, 4)
        padded_lower[..., :found] = lower.transpose(0, 2, 1, 3)
        return LinearRows(
            "position", padded_jac, padded_lower, None, np.full(shape, self.w1), np.full(shape, self.w2)
        )

    def _largest(self, horizon: Horizon, offset: Array) -> Array:
        """Most that is asked of pairs (run, N, uav, neighbour), whose offset now is (run, 1, uav, uav, 3)."""
        most = np.full((1, 1, 1, 1), np.inf)
        if self.slot_part is not None:
            apart = slot_offsets(horizon.problem, horizon.frame)
            most = self.slot_part * np.sqrt(_dot(apart, apart))
        if self.opening_mps is not None:
            now = np.sqrt(_dot(offset, offset))
            most = np.minimum(most, now + self.opening_mps * np.cumsum(horizon.step_s)[:, None, None])
        return most


def slot_offsets(problem: Problem, frame: PathFrame) -> Array:
    """From each slot of the formation to each other one, (uav, uav, 3) in the world [m]."""
    slots = frame.to_world(formation_offsets(problem.formation))
    return np.asarray(slots[:, None, :] - slots[None, :, :])


def margin_attainable(
    problem: Problem,
    covariance: Array,
    common_factor: Array,
    *,
    inflation: Inflation | None = None,
    distance_m: float | None = None,
    stretch: float = 1.0,
) -> NDArray[np.bool_]:
    """Whether UAVs that sit on their slots are as far apart as the margins ask (three sigma of 5 m are not, in a 10 m square).

    Where it is False, the separation rows will always ask for slack: widen the formation, lower the
    confidence, or navigate better.

    Parameters
    ----------
    problem : Problem
        Formation, mission and vehicle.
    covariance : array, shape (..., uav, 3, 3)
        Of each position [m^2].
    common_factor : array, shape (..., uav, 3, rank)
        Factor of what they share [m].
    inflation, distance_m, stretch
        As in :class:`NeighbourSeparation`.

    Returns
    -------
    array, shape (..., uav, uav)
        Of each pair; True on the diagonal.
    """  # noqa: E501
    if not isinstance(problem.mission, FormationMission):
        raise ConstraintError('mission.kind must be "formation": a lone point has no neighbours')
    frame = PathFrame.of_mission(problem.mission)
    offset = slot_offsets(problem, frame)
    uavs = len(offset)
    normal, reach = tangent(offset, _distance(distance_m, problem), stretch, _aside(uavs, frame))
    relative = relative_covariance(covariance, common_factor)
    margin = _margin(
        inflation or Inflation.of_problem(problem),
        relative,
        np.broadcast_to(normal, relative.shape[:-1]),
    )
    return np.asarray((_dot(normal, offset) >= reach + margin) | np.eye(uavs, dtype=bool))


def _distance(distance_m: float | None, problem: Problem) -> float:
    return problem.vehicle.min_separation_m if distance_m is None else distance_m


def _aside(uavs: int, frame: PathFrame) -> Array:
    """(uav, neighbour, 3) where to part from a neighbour in the same place: the lower index to the left."""
    index = np.arange(uavs)
    side = np.where(index[:, None] < index[None, :], 1.0, -1.0)
    return np.asarray(side[..., None] * frame.left)


def _margin(inflation: Inflation, relative: Array, normal: Array) -> Array:
    """Return k sigma (...) of the relative position (..., 3, 3) along normals (..., 3) [m]."""
    if inflation.reading in ("directional", "chi2"):
        return inflation.k * directional_sigma(relative, normal)
    return inflation.margin(relative, normal[..., None, :])[..., 0]


def _dot(left: Array, right: Array) -> Array:
    return np.asarray(
        left[..., 0] * right[..., 0] + left[..., 1] * right[..., 1] + left[..., 2] * right[..., 2]
    )
