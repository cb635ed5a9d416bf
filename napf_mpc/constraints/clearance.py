r"""NAPF's repulsion as rows of a QP: keep clear of obstacles, inflated by the navigation error (section 3.2).

Around the last plan's position p_lin of a stage the shifted distance to an obstacle,

    rho_bar(p) = d(p_lin) + n^T (p - p_lin) - r_uav - k sqrt(n^T Sigma n),

is linear in p: d the signed distance to the surface and n its unit gradient. Outside a convex obstacle the
half-space holds none of it, so a row that is kept is never a mistake; for a prism with a courtyard it speaks
of the nearest wall. Where a plan passes an edge between two stages, the half-space is that of the edge, see
:mod:`.edges`. Two shells of rows are made of it: contact, ``rho_bar >= 0``, whose penalty is exact, and
influence, ``rho_bar >= rho_0``, whose penalty pulls like NAPF.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.clearance_rows import (
    NEWTON_STEPS,
    contact_rows,
    firm_prices,
    held_distances,
    influence_rows,
    shortfalls,
)
from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows, even_prices
from napf_mpc.constraints.edges import keep_edges
from napf_mpc.constraints.passage import margins_beside, passage_margins
from napf_mpc.constraints.probability import BALL, DISC, HALF_SPACE, exact_margins, sigma_along
from napf_mpc.jit import compiled
from napf_mpc.safety_distance import Inflation
from napf_mpc.vehicle.plant import plain
from napf_mpc.world.bounding_tree import BoxTree
from napf_mpc.world.distance import CYLINDER, SPHERE, A, Solids
from napf_mpc.world.queries import near_all

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Margin = Literal["half_space", "exact", "passage"]

CONTACT_W1 = 1000.0
"""Linear price of a contact slack [1/(m s)].

It has to beat the multiplier of the row, or the plan buys its way in. A row that holds a UAV e metres off a
slot for T seconds with a position weight q carries at most q e T in all; spent on a single stage of h
seconds that is a price of q e T / h per second. With q = 0.1, e = 12 m, T = 8 s and h = 0.1 s: about 100. Ten
times that leaves room for other weights, and is still an order below what spoils OSQP's convergence.
"""
CONTACT_W2 = 100.0
"""Quadratic price of a contact slack [1/(m^2 s)]: spreads what cannot be met over the stages."""
NARROW_M = 1.3
"""Margin below which the linear price may rise, see :class:`ObstacleContact` [m]."""


@dataclass(frozen=True, eq=False)
class Gaps:
    """The M obstacles of each stage that are nearest by shifted distance, in the order of their indices."""

    distance: Array
    """(run, uav, N, M) from surface to surface: signed distance less the UAV's radius; +inf without [m]."""
    normal: Array
    """(run, uav, N, M, 3) unit gradient of the distance; zero without."""
    margin: Array
    """(run, uav, N, M) k sigma, or the margin of a sphere or cylinder [m]."""
    sigma: Array
    """(run, uav, N, M) standard deviation of the position as the inflation reads it [m]."""
    shifted: Array
    """(run, uav, N, M) distance that enters the potential field, rho_bar; +inf without [m]."""
    influence: Array
    """(run, uav, N, M) range of influence rho_0, widened if the inflation asks for that [m]."""

    @classmethod
    def of(
        cls, horizon: Horizon, inflation: Inflation, count: int, reach_m: float, margin: Margin = "half_space"
    ) -> Gaps:
        """Gaps along the last plans.

        Parameters
        ----------
        horizon : Horizon
            Plans, covariance and map.
        inflation : Inflation
            How k sigma enters.
        count : int
            M.
        reach_m : float
            Obstacles with a shifted distance of this or more count as none [m].
        margin : "half_space", "exact" or "passage"
            Margin against a flat wall, or against the sphere or cylinder that is there, see
            :class:`ObstacleContact`.
        """
        runs, uavs, stages = horizon.shape
        radius, rho_0 = horizon.problem.vehicle.radius_m, horizon.problem.planner.influence_m
        kept = (runs, uavs, stages, count)
        distance, *rest = np.empty((5, *kept))
        gaps, shift = cls(distance, np.empty((*kept, 3)), *rest), inflation.mode == "shift"
        place = horizon.position.reshape(runs, uavs * stages, 3)
        if margin == "half_space" and inflation.reading in ("directional", "chi2"):
            world = horizon.obstacles
            _find_and_choose(
                world.solids, world.tree, world.scene_start, plain(world.check_points("points", place)),
                plain(horizon.covariance), reach_m + radius, radius, reach_m,
                inflation.k * math.sqrt(3.0), inflation.k, shift, rho_0,
                gaps.distance, gaps.normal, gaps.margin, gaps.sigma, gaps.shifted, gaps.influence,
            )  # fmt: skip
            return gaps
        reach = reach_m + radius + inflation.largest_margin(horizon.covariance)
        # An obstacle a little farther off may act more where the error is larger in its direction.
        world = horizon.obstacles
        near = world.near(place, reach.reshape(runs, uavs * stages), 2 * count, together=stages)
        far, normal, index = near.distance.copy(), near.gradient.copy(), near.index
        keep_edges(world.solids, world.scene_start, plain(place), stages, far, normal, index)
        shape, points = (runs, uavs, stages, 2 * count), runs * uavs * stages
        normal, index = normal.reshape(*shape, 3), index.reshape(shape)
        sigma = _sigma(horizon.covariance, normal, inflation)
        if margin == "half_space":
            size = inflation.k * sigma
        else:
            size = (_exact if margin == "exact" else _passage)(horizon, index, normal, inflation)
        _choose(
            far.reshape(points, 2 * count),
            normal.reshape(points, 2 * count, 3),
            index.reshape(points, 2 * count),
            size.reshape(points, 2 * count),
            sigma.reshape(points, 2 * count),
            radius,
            reach_m,
            shift,
            rho_0,
            gaps.distance,
            gaps.normal,
            gaps.margin,
            gaps.sigma,
            gaps.shifted,
            gaps.influence,
        )
        return gaps


@compiled
def _choose(
    distance: Array,
    normal: Array,
    index: Index,
    size: Array,
    sigma: Array,
    radius: float,
    reach_m: float,
    shift: bool,
    rho_0: float,
    out_distance: Array,
    out_normal: Array,
    out_size: Array,
    out_sigma: Array,
    out_shifted: Array,
    out_influence: Array,
) -> None:
    """Keep the few obstacles of each point that are nearest by shifted distance, as :class:`Gaps` holds them.

    Parameters
    ----------
    distance, normal, index : array, shapes (point, m), (point, m, 3) and (point, m)
        As the map answers, nearest first.
    size, sigma : array, shape (point, m)
        Margins and standard deviations [m].
    radius, reach_m : float
        Of the UAV, and the shifted distance from which on an obstacle counts as none [m].
    shift : bool
        Whether the margin shifts the distance; otherwise it widens the range.
    rho_0 : float
        Range of influence [m].
    out_distance ... out_influence : array, shapes (run, uav, N, few) and, of the normals, (..., few, 3)
        Out.
    """
    points, m = distance.shape
    few = out_distance.shape[3]
    to_distance, to_normal = out_distance.reshape(points, few), out_normal.reshape(points, few, 3)
    to_size, to_sigma = out_size.reshape(points, few), out_sigma.reshape(points, few)
    to_shifted, to_influence = out_shifted.reshape(points, few), out_influence.reshape(points, few)
    rank, place = np.empty(m), np.empty(m, dtype=np.int64)
    for p in range(points):
        for j in range(m):
            by = distance[p, j] - radius - size[p, j]
            rank[j] = by if by < reach_m else np.inf
        # By rank, equals as they came, ...
        for j in range(m):
            at = j
            while at > 0 and rank[place[at - 1]] > rank[j]:
                place[at] = place[at - 1]
                at -= 1
            place[at] = j
        # ... then the chosen by index: rows that keep their places from stage to stage and step to step keep
        # a warm start warm. Those that count as none come last.
        for j in range(1, few):
            mine, at = place[j], j
            if rank[mine] == np.inf:
                break
            while at > 0 and index[p, place[at - 1]] > index[p, mine]:
                place[at] = place[at - 1]
                at -= 1
            place[at] = mine
        for j in range(few):
            i = place[j]
            none = rank[i] == np.inf
            gap = distance[p, i] - radius
            to_size[p, j], to_sigma[p, j] = size[p, i], sigma[p, i]
            to_distance[p, j] = np.inf if none else gap
            to_shifted[p, j] = np.inf if none else gap - size[p, i] if shift else gap
            to_influence[p, j] = rho_0 if shift else rho_0 + size[p, i]
            for axis in range(3):
                to_normal[p, j, axis] = 0.0 if none else normal[p, i, axis]


@compiled
def _find_and_choose(
    solids: Solids, tree: BoxTree, scene_start: Index, points: Array, covariance: Array, least_m: float,
    radius: float, reach_m: float, sigmas: float, k: float, shift: bool, rho_0: float, out_distance: Array,
    out_normal: Array, out_size: Array, out_sigma: Array, out_shifted: Array, out_influence: Array,
) -> None:  # fmt: skip
    """Find twice as many obstacles as are kept, with margins of k sigma along their normals, and choose.

    An obstacle a little farther off may act more where the error is larger in its direction.

    Parameters
    ----------
    points, covariance : array, shapes (run, uav x N, 3) and (run, uav, N, 3, 3)
        Where [m], and how certain [m^2].
    least_m, sigmas : float
        Obstacles are looked for within this distance and so many root mean square sigmas.
    """
    runs, each, together, m = points.shape[0], points.shape[1], covariance.shape[2], 2 * out_distance.shape[3]
    total = runs * each
    certain, reach = covariance.reshape(total, 3, 3), np.empty((runs, each))
    for p in range(total):
        trace = certain[p, 0, 0] + certain[p, 1, 1] + certain[p, 2, 2]
        reach[p // each, p % each] = least_m + sigmas * math.sqrt(max(trace, 0.0) / 3.0)
    distance, normal = np.empty((runs, each, m)), np.empty((runs, each, m, 3))
    index = np.empty((runs, each, m), dtype=np.int64)
    near_all(solids, tree, scene_start, points, reach, together, distance, normal, index)
    keep_edges(solids, scene_start, points, together, distance, normal, index)
    flat, size, sigma = normal.reshape(total, m, 3), np.empty((total, m)), np.empty((total, m))
    _directional(certain, flat, sigma)
    for p in range(total):
        for j in range(m):
            size[p, j] = k * sigma[p, j]
    _choose(
        distance.reshape(total, m), flat, index.reshape(total, m), size, sigma, radius, reach_m, shift, rho_0,
        out_distance, out_normal, out_size, out_sigma, out_shifted, out_influence,
    )  # fmt: skip


def _sigma(covariance: Array, normal: Array, inflation: Inflation) -> Array:
    """Sigmas (run, uav, N, m) as the inflation reads them: k of them are the margin of a flat wall."""
    if inflation.reading not in ("directional", "chi2"):
        return plain(replace(inflation, k=1.0).margin(covariance, normal))
    points, m = math.prod(normal.shape[:-2]), normal.shape[-2]
    sigma = np.empty(normal.shape[:-1])
    _directional(
        plain(covariance).reshape(points, 3, 3), normal.reshape(points, m, 3), sigma.reshape(points, m)
    )
    return sigma


@compiled
def _directional(covariance: Array, normal: Array, sigma: Array) -> None:
    """Write sigma along normals: covariance (point, 3, 3), normal (point, m, 3), sigma (point, m)."""
    for p in range(normal.shape[0]):
        for j in range(normal.shape[1]):
            x, y, z = normal[p, j, 0], normal[p, j, 1], normal[p, j, 2]
            none = x == 0.0 and y == 0.0 and z == 0.0
            sigma[p, j] = 0.0 if none else sigma_along(covariance[p], x, y, z)


def _exact(horizon: Horizon, index: Index, normal: Array, inflation: Inflation) -> Array:
    """Margins (run, uav, N, m) against the spheres and cylinders that are there."""
    world = horizon.obstacles
    if len(world) == 0:
        return np.zeros(index.shape)
    first = world.scene_start[:-1] if world.n_scenes > 1 else world.scene_start[:1]
    place = np.where(index >= 0, index + first[:, None, None, None], 0)
    solids, shape = world.solids.kind[place], world.solids.parameters[place]
    # Beside its wall a cylinder is taken for an endless one; near its roof it is a wall like any other.
    beside = (solids == CYLINDER) & (normal[..., 2] == 0.0)
    kind = np.where(solids == SPHERE, BALL, np.where(beside, DISC, HALF_SPACE))
    margin = np.empty(index.shape)
    points, m = index[..., 0].size, index.shape[-1]
    exact_margins(
        kind.reshape(points, m),
        (shape[..., A] + horizon.problem.vehicle.radius_m).reshape(points, m),
        plain(normal).reshape(points, m, 3),
        plain(horizon.covariance).reshape(points, 3, 3),
        inflation.k,
        margin.reshape(points, m),
        *_mission(inflation),
    )
    return margin


def _passage(horizon: Horizon, index: Index, normal: Array, inflation: Inflation) -> Array:
    """Margins (run, uav, N, m) of a passage beside the spheres that are there."""
    world, margin = horizon.obstacles, np.empty(index.shape)
    points, m = index[..., 0].size, index.shape[-1]
    margins_beside(
        passage_margins(inflation),
        world.solids,
        world.scene_start[:-1],
        index.shape[0],
        np.ascontiguousarray(index).reshape(points, m),
        plain(normal).reshape(points, m, 3),
        plain(inflation.margin_covariance(horizon.covariance)).reshape(points, 3, 3),
        horizon.problem.vehicle.radius_m,
        margin.reshape(points, m),
    )
    return margin


def _mission(inflation: Inflation) -> tuple[float, float, float, float]:
    """Risk, active time, correlation time and period of the budget that k comes from; no risk without."""
    budget = inflation.budget
    if budget is None:
        return 0.0, 0.0, 0.0, 1.0
    return budget.risk_per_uav, budget.active_s, budget.correlation_time_s, budget.period_s


@dataclass(frozen=True)
class _Shell:
    inflation: Inflation | None = None
    """How k sigma enters; by default as the problem's planner section says."""
    obstacles: int = 4
    """Rows of each stage M."""
    reach_m: float = 10.0
    """Obstacles with a shifted distance of this or more are left out [m]."""
    margin: Margin = "half_space"
    """``half_space`` is exact for a wall and careful elsewhere; ``exact`` asks for the same chance of a hit
    of the sphere or cylinder itself: at each time and obstacle, or, with ``planner.risk_per_mission``, in a
    mission. Small obstacles then take less room, and use up the whole of what is asked: bound the mission's
    risk with it, not the step's. ``passage`` asks for the same chance while the UAV passes a sphere, see
    :mod:`.passage`; all else is a wall to it."""

    def __post_init__(self) -> None:
        if self.obstacles < 1 or not self.reach_m > 0.0:
            raise ConstraintError(
                f"obstacles = {self.obstacles!r} and reach_m = {self.reach_m!r}: must be >= 1 and > 0"
            )
        if self.margin not in get_args(Margin):
            raise ConstraintError(f"margin = {self.margin!r}, must be one of {', '.join(get_args(Margin))}")

    def gaps(self, horizon: Horizon, least_reach_m: float = 0.0) -> Gaps:
        """Nearest obstacles of each stage."""
        inflation = self.inflation or Inflation.of_problem(horizon.problem)
        if self.margin == "exact" and inflation.reading not in ("directional", "chi2"):
            raise ConstraintError(
                f'margin = "exact" uses the whole covariance; inflation.reading = "{inflation.reading}" '
                'does not go with it, choose "directional" or "chi2"'
            )
        asked = (inflation, self.obstacles, max(self.reach_m, least_reach_m), self.margin)
        gaps: Gaps | None = horizon.memo.get(asked)
        if gaps is None:
            gaps = horizon.memo[asked] = Gaps.of(horizon, *asked)
        return gaps


def check_extra(extra_m: float, extra_sigmas: float | None) -> None:
    """Raise ConstraintError unless a distance on top of the margin is one, see :func:`extra_distance`."""
    if not (math.isfinite(extra_m) and extra_m >= 0.0):
        raise ConstraintError(f"extra_m = {extra_m!r}, must be >= 0")
    if extra_sigmas is not None and not (math.isfinite(extra_sigmas) and extra_sigmas >= 0.0):
        raise ConstraintError(f"extra_sigmas = {extra_sigmas!r}, must be >= 0, or None")


def extra_distance(extra_m: float, extra_sigmas: float | None, sigma: Array) -> Array | float:
    """Distance on top of the margin: so many sigmas, at most so many metres; without sigmas those [m]."""
    return extra_m if extra_sigmas is None else np.minimum(extra_m, extra_sigmas * sigma)


def check_opening(opening_mps: float | None) -> None:
    """Raise ConstraintError unless a speed at which something is left is one, or None."""
    if opening_mps is not None and not opening_mps > 0.0:
        raise ConstraintError(f"opening_mps = {opening_mps!r}, must be > 0, or None")


def opening_distance(asked: Array, here: Array, opening_mps: float | None, times_s: Array) -> Array:
    """Distances asked for, or what opens at a speed until then, where the distance now is short.

    Parameters
    ----------
    asked, here : array, shapes (run, uav, N, m)
        Distance asked for, and from where the plan begins [m].
    opening_mps : float or None
        Speed; None asks at once [m/s].
    times_s : array, shape (N,)
        Ends of the stages [s].

    Returns
    -------
    array, shape (run, uav, N, m)
        [m].
    """
    if opening_mps is None:
        return asked
    return np.asarray(np.minimum(asked, np.minimum(asked, here) + opening_mps * times_s[:, None]))


@dataclass(frozen=True)
class ObstacleContact(_Shell):
    """Contact shell: stay k sigma clear of the surface, ``rho_bar >= extra``.

    Soft with an exact penalty: kept to the last micrometre where that can be done, and broken by as little as
    possible where it cannot. The rows of one UAV and stage share one slack, in metres: the largest shortfall.
    """

    extra_m: float = 0.0
    """Distance kept on top of the margin [m], ..."""
    extra_sigmas: float | None = None
    """... or this many sigmas, if that is less: what an error drifts by while the UAV answers is in
    proportion to it. None keeps ``extra_m`` whatever sigma is."""
    opening_mps: float | None = None
    """A UAV that is inside a margin now is asked to leave it at this speed, not at once: a sigma that jumps
    by tens of metres must not make it lunge. None asks at once [m/s]."""
    w1: float = CONTACT_W1
    """Linear price of the slack [1/(m s)]."""
    w2: float = CONTACT_W2
    """Quadratic price of the slack [1/(m^2 s)]."""
    narrow_w1: float = 0.0
    """Linear price up to which ``w1`` rises where the margin is less than ``narrow_m``, with the inverse cube
    of it [1/(m s)]. A plan that gains by cutting a corner cuts it by decimetres, whatever the margin is: that
    is a part of one of metres, and a contact with one of centimetres."""
    narrow_m: float = NARROW_M
    """See there [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_extra(self.extra_m, self.extra_sigmas)
        check_opening(self.opening_mps)
        for name in ("narrow_w1", "narrow_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ConstraintError(f"{name} = {getattr(self, name)!r}, must be >= 0")

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "obstacle contact"

    def shortfall(self, horizon: Horizon, position: Array) -> Array:
        """Most that plans (run, uav, N, 3) are inside the margin of an obstacle of their rows [m]."""
        gaps, most = self.gaps(horizon, self.extra_m), np.empty(horizon.shape[:2])
        shortfalls(
            gaps.normal,
            gaps.shifted,
            gaps.sigma,
            plain(horizon.position),
            plain(position),
            *self._extra(),
            most,
        )
        return most

    def _extra(self) -> tuple[float, float]:
        """Distance on top of the margin at most [m], and sigmas of it, endless without."""
        return self.extra_m, math.inf if self.extra_sigmas is None else self.extra_sigmas

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``n^T p >= n^T p_lin - rho_bar(p_lin) + extra - s`` [m]."""
        gaps = self.gaps(horizon, self.extra_m)
        lower = np.empty(gaps.shifted.shape)
        opening = math.inf if self.opening_mps is None else self.opening_mps
        contact_rows(
            gaps.normal, gaps.shifted, gaps.sigma, plain(horizon.position), *self._extra(), opening,
            horizon.times_s, lower,
        )  # fmt: skip
        w1, w2 = even_prices((*horizon.shape, 1), self.w1, self.w2)
        if self.narrow_w1 > self.w1:
            shift = (self.inflation or Inflation.of_problem(horizon.problem)).mode == "shift"
            firm_prices(gaps.shifted, gaps.margin, shift, self.w1, self.narrow_w1, self.narrow_m, w1)
        return LinearRows("position", gaps.normal, lower, None, w1, w2, shared_slack=True)


@dataclass(frozen=True)
class ObstacleInfluence(_Shell):
    r"""Influence shell: NAPF's repulsion inside rho_0, as a quadratic penalty on ``rho_bar >= rho_t - s``.

    NAPF's potential is convex in rho_bar. The row is its second-order model at the last plan: with the force
    F of Eq. 28 there and its slope F', the weight is ``w2 = c |F'|`` and the target ``rho_t = rho_bar +
    F / |F'|``, so that minus the gradient of w2 s^2 / 2 by the position is c times NAPF's force along n: its
    magnitude (Eq. 28), its direction (Eq. 29) and, over the rows, its sum (Eq. 36). A weight of F over the
    whole distance left to rho_0 has the same force but too small a slope, by 3 rho_0 / rho_bar - 2: the plan
    then leaps between contact and rho_0 from step to step. Beyond rho_0, where NAPF does nothing, the target
    is rho_0 and the weight the slope there: it counts only once a plan comes nearer.
    """

    per_speed: float = 1.0
    """Unit factor c: price per metre and second for each m/s of NAPF's velocity [1/(m s) per m/s]."""
    most: float = math.inf
    """Pull of a row at most [1/(m s)]: nearer than where NAPF pulls as much, it is held. Without a bound, a
    force law for wide scenes outbids the limits of speed and tilt deep inside a margin."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.most > 0.0:
            raise ConstraintError(f"most = {self.most!r}, must be > 0")
        if not (math.isfinite(self.per_speed) and self.per_speed > 0.0):
            raise ConstraintError(f"per_speed = {self.per_speed!r}, must be > 0")

    @property
    def name(self) -> str:
        """Name in results and errors."""
        return "obstacle influence"

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows ``n^T p >= n^T p_lin + rho_t - rho_bar(p_lin) - s`` [m], each with a slack of its own."""
        settings = horizon.problem.planner
        gaps, gain = self.gaps(horizon, settings.influence_m), settings.repulsive_gain
        held, ratio = np.empty(gaps.shifted.shape), math.inf
        if math.isfinite(self.most) and gain > 0.0:
            ratio = self.most / (self.per_speed * gain)
        held_distances(
            gaps.shifted, gaps.influence, settings.min_distance_m, ratio, ratio ** (1.0 / 3.0), held
        )
        lower, w2 = np.empty(held.shape), np.empty(held.shape)
        influence_rows(
            gaps.normal, gaps.shifted, gaps.influence, plain(horizon.position), gain, self.per_speed, held,
            # NumPy's own power, whose last bit is not everybody's.
            held**4, lower, w2,
        )  # fmt: skip
        return LinearRows("position", gaps.normal, lower, None, np.zeros(w2.shape), w2)


def distance_of_force(ratio: float, influence_m: Array) -> Array:
    """Distance rho at which Eq. 28 over its gain, ``(1/rho - 1/rho_0) / rho^2``, has a value [m].

    Parameters
    ----------
    ratio : float
        Force over gain, >= 0 [1/m^3].
    influence_m : array, shape (...)
        rho_0 [m].
    """
    slope = 1.0 / influence_m
    # x^2 (x - 1/rho_0) of x = 1/rho is convex and rising beyond 1/rho_0: Newton's steps from above stay.
    x = slope + ratio ** (1.0 / 3.0)
    for _ in range(NEWTON_STEPS):
        x -= (x * x * (x - slope) - ratio) / (x * (3.0 * x - 2.0 * slope))
    return np.asarray(1.0 / x)


def influence_model(
    rho: Array, gain: float, influence_m: Array | float, floor_m: Array | float
) -> tuple[Array, Array]:
    """Second-order model of the repulsive potential: stiffness, and the distance at which it is at rest.

    Parameters
    ----------
    rho : array, shape (...)
        Shifted distance rho_bar [m].
    gain : float
        k_r.
    influence_m : array or float, shape (...)
        rho_0 [m].
    floor_m : array or float, shape (...)
        Least distance [m].

    Returns
    -------
    weight : array, shape (...)
        Slope of Eq. 28 at rho, at least the least distance and at most rho_0.
    target : array, shape (...)
        rho plus force over slope inside rho_0, rho_0 outside [m].
    """
    held = np.clip(rho, floor_m, influence_m)
    weight = gain * (3.0 - 2.0 * held / influence_m) / held**4
    ahead = held * (1.0 - held / influence_m) / (3.0 - 2.0 * held / influence_m)
    inside = np.where(rho < influence_m, rho, 0.0) + ahead
    return np.asarray(weight), np.asarray(np.where(rho < influence_m, inside, influence_m))
