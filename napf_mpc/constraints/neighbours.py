r"""Keep UAVs apart by rows against each other's last shared plans.

Around each UAV stands an ellipsoid of half-axes (d, d, e d): d the least distance of two centres, e >= 1 the
stretch of its vertical axis for the downwash. Scaling the vertical by 1 / e turns it into a ball; across the
scaled line of centres lies a plane that touches it, whose unit normal in the world is n and whose distance
from the centre is d_n. Two UAVs that keep ``n^T (p_i - p_j) >= d_n + k sqrt(n^T C n)`` are apart, with
``C = Sigma_i + Sigma_j - Sigma_ij - Sigma_ij^T``: what two receivers have in common drops out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows, even_prices
from napf_mpc.constraints.probability import sigma_along
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.problem import Formation, FormationMission, Problem
from napf_mpc.safety_distance import Inflation, directional_sigma
from napf_mpc.vehicle.plant import plain

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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
    _kept: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)

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
        shape = (runs, uavs, stages, self.neighbours)
        jac, lower = np.empty((*shape, 3)), np.empty(shape)
        along_normal = inflation.reading in ("directional", "chi2")
        _separate(
            plain(horizon.position),
            plain(horizon.covariance),
            plain(horizon.common_factor),
            np.empty((0, 0, 0, 0)) if along_normal else self._even_margin(horizon, inflation),
            inflation.k,
            _distance(self.distance_m, horizon.problem),
            self.stretch,
            *self._pairs(horizon),
            np.inf if self.opening_mps is None else self.opening_mps,
            horizon.times_s,
            self.share,
            self.reach_m,
            jac,
            lower,
        )
        return LinearRows("position", jac, lower, None, *even_prices(shape, self.w1, self.w2))

    def _pairs(self, horizon: Horizon) -> tuple[Array, Array]:
        """Where to part, and most that is asked, of each pair; the same as long as problem and frame are."""
        known, problem, frame, uavs = self._kept, horizon.problem, horizon.frame, horizon.shape[1]
        if not (known and known[0] is problem and known[1] is frame and len(known[2]) == uavs):
            known[:] = [problem, frame, _aside(uavs, frame), self._most_by_slots(horizon)]
        aside: Array = known[2]
        most: Array = known[3]
        return aside, most

    def _even_margin(self, horizon: Horizon, inflation: Inflation) -> Array:
        """Margins (run, N, uav, neighbour) by readings that ask for the same in all directions [m]."""
        relative = relative_covariance(
            horizon.covariance.transpose(0, 2, 1, 3, 4), horizon.common_factor[:, None]
        )
        return plain(_margin(inflation, relative, np.broadcast_to(0.0, relative.shape[:-1])))

    def _most_by_slots(self, horizon: Horizon) -> Array:
        """Most that is asked of pairs (uav, neighbour) because of the distance of their slots [m]."""
        pairs = (horizon.shape[1],) * 2
        if self.slot_part is None:
            return np.full(pairs, np.inf)
        apart = slot_offsets(horizon.problem, horizon.frame)
        return plain(np.broadcast_to(self.slot_part * np.sqrt(_dot(apart, apart)), pairs))


@compiled
def _shared(factor: Array, cross: Array) -> None:
    """Write Sigma_ij + Sigma_ij^T = L_i L_j^T + L_j L_i^T of factors (run, uav, 3, rank) [m^2]."""
    one = np.empty((3, 3))
    for run in range(cross.shape[0]):
        for i in range(cross.shape[1]):
            for j in range(cross.shape[1]):
                one[:] = 0.0
                for c in range(factor.shape[3]):
                    for a in range(3):
                        for b in range(3):
                            one[a, b] += factor[run, i, a, c] * factor[run, j, b, c]
                for a in range(3):
                    for b in range(3):
                        cross[run, i, j, a, b] = one[a, b] + one[b, a]


@compiled_bare
def _plane(
    x: float, y: float, z: float, distance_m: float, stretch: float, aside: Array, normal: Array
) -> float:
    """Write the normal that :func:`tangent` returns of an offset (x, y, z), and return its reach [m]."""
    flattened = z / stretch**2
    if math.sqrt(x * x + y * y + z * z) < TOUCH_M:
        normal[0], normal[1], normal[2] = aside[0], aside[1], aside[2]
    else:
        length = math.sqrt(x * x + y * y + flattened * flattened)
        normal[0], normal[1], normal[2] = x / length, y / length, flattened / length
    level = normal[0] * normal[0] + normal[1] * normal[1]
    tall = stretch * normal[2]
    return distance_m * math.sqrt(level + tall * tall)


@compiled
def _separate(
    position: Array,
    covariance: Array,
    factor: Array,
    margin: Array,
    k: float,
    distance_m: float,
    stretch: float,
    aside: Array,
    most_by_slots: Array,
    opening_mps: float,
    times_s: Array,
    share: float,
    reach_m: float,
    jac: Array,
    lower: Array,
) -> None:
    """Write rows against the nearest neighbours of every stage.

    Parameters
    ----------
    position, covariance : array, shapes (run, uav, N, 3) and (run, uav, N, 3, 3)
        As planned, and their errors.
    factor : array, shape (run, uav, 3, rank)
        Of what errors have in common.
    margin : array, shape (run, N, uav, uav), or without entries
        Margins [m]; without, k sigma along the normal.
    aside : array, shape (uav, uav, 3)
        Normals of pairs in the same place.
    most_by_slots : array, shape (uav, uav)
        Most that is asked of each pair [m].
    times_s : array, shape (N,)
        Ends of the stages [s].
    jac, lower : array, shapes (run, uav, N, m, 3) and (run, uav, N, m)
        Rows, out.
    """
    runs, uavs, stages = position.shape[:3]
    jac[:], lower[:] = 0.0, -np.inf  # switched off
    cross = np.empty((runs, uavs, uavs, 3, 3))
    _shared(factor, cross)
    few = min(lower.shape[3], uavs)
    normal, spare = np.empty((uavs, uavs, 3)), np.full((uavs, uavs), np.inf)
    relative, nearest = np.empty((3, 3)), np.empty(uavs, dtype=np.int64)
    start = np.empty((uavs, uavs))
    for run in range(runs):
        for s in range(stages):
            for i in range(uavs):
                for j in range(i):
                    # Seen from j all is the same, with the normal turned round.
                    x = position[run, i, s, 0] - position[run, j, s, 0]
                    y = position[run, i, s, 1] - position[run, j, s, 1]
                    z = position[run, i, s, 2] - position[run, j, s, 2]
                    reach = _plane(x, y, z, distance_m, stretch, aside[i, j], normal[i, j])
                    nx, ny, nz = normal[i, j, 0], normal[i, j, 1], normal[i, j, 2]
                    normal[j, i, 0], normal[j, i, 1], normal[j, i, 2] = -nx, -ny, -nz
                    if s == 0:
                        start[i, j] = math.sqrt(x * x + y * y + z * z)
                    if margin.size > 0:
                        extra = margin[run, s, i, j]
                    else:
                        for a in range(3):
                            for b in range(3):
                                both = covariance[run, i, s, a, b] + covariance[run, j, s, a, b]
                                relative[a, b] = both - cross[run, i, j, a, b]
                        extra = k * sigma_along(relative, nx, ny, nz)
                    most = min(most_by_slots[i, j], start[i, j] + opening_mps * times_s[s])
                    required = max(reach, min(reach + extra, most))
                    left = (nx * x + ny * y + nz * z) - required
                    spare[i, j] = spare[j, i] = left if left < reach_m else np.inf
            for i in range(uavs):
                found = 0
                # The nearest, equals by index, ...
                for j in range(uavs):
                    if spare[i, j] == np.inf:
                        continue
                    at = min(found, few)
                    while at > 0 and spare[i, nearest[at - 1]] > spare[i, j]:
                        at -= 1
                    if at < few:
                        for later in range(min(found, few - 1), at, -1):
                            nearest[later] = nearest[later - 1]
                        nearest[at] = j
                    found = min(found + 1, few)
                # ... in the order of their indices: rows that keep their places from stage to stage and step
                # to step keep a warm start warm.
                for m in range(1, found):
                    j, at = nearest[m], m
                    while at > 0 and nearest[at - 1] > j:
                        nearest[at] = nearest[at - 1]
                        at -= 1
                    nearest[at] = j
                for m in range(found):
                    j = nearest[m]
                    at_rest = 0.0
                    for a in range(3):
                        jac[run, i, s, m, a] = normal[i, j, a]
                        at_rest += normal[i, j, a] * position[run, i, s, a]
                    lower[run, i, s, m] = at_rest - share * spare[i, j]


def slot_offsets(problem: Problem, frame: PathFrame) -> Array:
    """From each slot of the formation to each other one, (uav, uav, 3) in the world [m]."""
    slots = frame.to_world(_slots(problem.formation))
    return np.asarray(slots[:, None, :] - slots[None, :, :])


def margin_attainable(
    problem: Problem,
    covariance: Array,
    common_factor: Array,
    *,
    inflation: Inflation | None = None,
    distance_m: float | None = None,
    stretch: float = 1.0,
) -> Mask:
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
    distance_m = _distance(distance_m, problem)
    normal, room, reach = _between_slots(problem.formation, problem.mission, distance_m, stretch)
    inflation, uavs = inflation or Inflation.of_problem(problem), len(room)
    if inflation.reading not in ("directional", "chi2"):
        relative = relative_covariance(covariance, common_factor)
        margin = _margin(inflation, relative, np.broadcast_to(normal, relative.shape[:-1]))
        return np.asarray((room >= reach + margin) | np.eye(uavs, dtype=bool))
    lead = covariance.shape[:-3]
    kept = np.empty((math.prod(lead), uavs, uavs), dtype=np.bool_)
    factor = common_factor.reshape(len(kept), *common_factor.shape[-3:])
    _keep(
        plain(covariance.reshape(len(kept), uavs, 3, 3)),
        plain(factor),
        inflation.k,
        normal,
        room,
        reach,
        kept,
    )
    return kept.reshape(*lead, uavs, uavs)


@compiled
def _keep(
    covariance: Array, factor: Array, k: float, normal: Array, room: Array, reach: Array, kept: Mask
) -> None:
    """Write whether pairs have room (uav, uav) for their reach and k sigma along their normals."""
    cross, relative = np.empty((*kept.shape, 3, 3)), np.empty((3, 3))
    _shared(factor, cross)
    for run in range(kept.shape[0]):
        for i in range(kept.shape[1]):
            for j in range(kept.shape[1]):
                kept[run, i, j] = _keeps(covariance, cross, run, i, j, k, normal, room, reach, relative)


@compiled_bare
def _keeps(
    covariance: Array, cross: Array, run: int, i: int, j: int, k: float, normal: Array, room: Array,
    reach: Array, relative: Array,
) -> bool:  # fmt: skip
    """Whether one pair has; ``relative`` (3, 3) is room to work in."""
    for a in range(3):
        for b in range(3):
            both = covariance[run, i, a, b] + covariance[run, j, a, b]
            relative[a, b] = both - cross[run, i, j, a, b]
    margin = k * sigma_along(relative, normal[i, j, 0], normal[i, j, 1], normal[i, j, 2])
    return bool(i == j or room[i, j] >= reach[i, j] + margin)


class ShortMargins:
    """Who could not keep a margin to another UAV even where the formation itself is flown perfectly.

    Parameters
    ----------
    problem : Problem
        Formation, mission and vehicle.
    inflation : Inflation
        How k sigma enters.
    """

    def __init__(self, problem: Problem, inflation: Inflation) -> None:
        assert isinstance(problem.mission, FormationMission)
        self._problem, self._inflation = problem, inflation
        distance_m = _distance(None, problem)
        self._planes = _between_slots(problem.formation, problem.mission, distance_m, 1.0)

    def count(
        self, covariance: Array, common_factor: Array, trusted: Mask, counts: NDArray[np.int64]
    ) -> None:
        """Add the trusted UAVs of each run whose margin to another :func:`margin_attainable` calls short.

        Parameters
        ----------
        covariance, common_factor : array, shapes (run, uav, n, n) and (run, uav, 3, rank)
            As reported, the position first [m^2], [m]; of a UAV that is not trusted they count as zero.
        trusted : array of bool, shape (run, uav)
            Whose navigation is trusted.
        counts : array of int, shape (run,)
            Added to.
        """
        inflation = self._inflation
        if inflation.reading in ("directional", "chi2"):
            covariance, factor = plain(covariance), plain(common_factor)
            _count_short(covariance, factor, inflation.k, *self._planes, trusted, counts)
            return
        known = trusted[..., None, None]
        covariance = np.where(known, covariance[..., :3, :3], 0.0)
        common_factor = np.where(known, common_factor, 0.0)
        kept = margin_attainable(self._problem, covariance, common_factor, inflation=inflation)
        counts += (trusted & ~kept.all(-1)).sum(-1)


@compiled
def _count_short(
    covariance: Array, factor: Array, k: float, normal: Array, room: Array, reach: Array, trusted: Mask,
    counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Count trusted UAVs with a pair that :func:`_keeps` says has no room."""
    runs, uavs = trusted.shape
    known, shared = np.zeros((runs, uavs, 3, 3)), np.zeros(factor.shape)
    cross, relative = np.empty((runs, uavs, uavs, 3, 3)), np.empty((3, 3))
    for run in range(runs):
        for i in range(uavs):
            if trusted[run, i]:
                known[run, i] = covariance[run, i, :3, :3]
                shared[run, i] = factor[run, i]
    _shared(shared, cross)
    for run in range(runs):
        for i in range(uavs):
            short = 0
            for j in range(uavs):
                short += not _keeps(known, cross, run, i, j, k, normal, room, reach, relative)
            counts[run] += short > 0 and trusted[run, i]


@lru_cache(maxsize=16)
def _between_slots(
    formation: Formation, mission: FormationMission, distance_m: float, stretch: float
) -> tuple[Array, Array, Array]:
    """Planes between the slots of a formation: normals, the slots' distance along them, and reach."""
    frame = PathFrame.of_mission(mission)
    slots = frame.to_world(_slots(formation))
    offset = slots[:, None, :] - slots[None, :, :]
    normal, reach = tangent(offset, distance_m, stretch, _aside(len(offset), frame))
    return normal, _dot(normal, offset), reach


@lru_cache(maxsize=16)
def _slots(formation: Formation) -> Array:
    return formation_offsets(formation)


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
