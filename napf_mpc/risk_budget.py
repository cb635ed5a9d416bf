r"""A mission's risk of contact: what is asked, what the flight has used up, and what came of it.

No chance per step bounds a mission. Summed over all samples it is several times too careful, since correlated
errors come in clusters; over T / tau it is too bold. What counts is the first passage of the error over the
level k(t) = distance / sigma, see :mod:`napf_mpc.first_passage`. Before the flight :class:`RiskBudget` turns
the asked risk into k; in flight :class:`RiskLedger` adds up what the distances flown are worth:

    P(contact) <= sum over UAVs of 1 - exp(-H),   dH = rate(k) dt + (what k fell by, in entry(k)).

Obstacles only, as in every risk here; contacts between UAVs are counted apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from napf_mpc.first_passage import first_passage_probability, long_run, mission_k
from napf_mpc.jit import compiled
from napf_mpc.problem import ConstantBias, GaussMarkov, Gnss, Navigation, Problem, Recorded

__all__ = ["Allocation", "Certificate", "RiskBudget", "RiskLedger", "error_correlation_time"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

FILTERED_CORRELATION_TIME_S = 15.0
"""Correlation time taken for the navigation filter's error, in units of its own sigma [s].

Measured as the time whose Gauss-Markov process passes k = 2 to 3 in 15 s as often as the filter's error does:
14 to 18 s behind white fixes, 32 to 73 s behind correlated ones. The shorter is the more careful.
"""
_SPACING, _FARTHEST = 0.2, 8.0  # Of the tables in k; 8 sigmas are 6e-16.
_NONE = -1


def error_correlation_time(navigation: Navigation) -> float:
    r"""Correlation time of the reported position's error, in units of its sigma [s]; infinity for a constant.

    Behind the navigation filter :data:`FILTERED_CORRELATION_TIME_S`; without it the error model's own (of a
    log: what the filter would assume of it). Where sigma swings on each axis with a phase of its own, an
    error in an oblique direction is carried now by one axis, now by another, and forgets faster. With a
    relative amplitude a and a period P that is taken into account as

        1 / tau_eff = 1 / tau + a^2 / (1.4 P),

    fitted to the first passage along (1, 1, 0) and (1, 1, 1), a = 1/3 and 2/3; along an axis it is careful.
    """
    if navigation.filter != "none":
        return FILTERED_CORRELATION_TIME_S
    match navigation:
        case GaussMarkov():
            if navigation.correlation_time_s == 0.0:
                return 0.0
            low, high = navigation.sigma_min_m, navigation.sigma_max_m
            swing = ((high - low) / (high + low)) ** 2 / (1.4 * navigation.sigma_period_s)
            return 1.0 / (1.0 / navigation.correlation_time_s + swing)
        case ConstantBias():
            return math.inf
        case Recorded() | Gnss():
            return navigation.filter_correlation_time_s


@dataclass(frozen=True)
class Allocation:
    """A mission's risk divided by the time that obstacles are near."""

    k: float
    """Level that all pairs of UAV and obstacle are held at [sigmas]."""
    risk: Array
    """(uav, obstacle) share of the asked risk; zero for a pair that never meets."""


@dataclass(frozen=True)
class RiskBudget:
    """What a mission may cost, and the navigation error that it is spent on."""

    asked: float
    """Probability in (0, 1) that any UAV touches an obstacle."""
    uavs: int
    """UAVs of the formation."""
    active_s: float
    """Time for which each UAV has an obstacle at its margin, all obstacles together [s]."""
    correlation_time_s: float
    """Of the error in units of its sigma; 0 for white, infinity for constant [s]."""
    period_s: float
    """Time between two position fixes; the error is held between [s]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.asked < 1.0:
            raise ValueError(f"asked = {self.asked!r} must be > 0 and < 1")
        if self.uavs < 1:
            raise ValueError(f"uavs = {self.uavs!r} must be >= 1")
        for name, value in (("active_s", self.active_s), ("period_s", self.period_s)):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value!r} must be a finite number > 0")
        if not self.correlation_time_s >= 0.0:
            raise ValueError(f"correlation_time_s = {self.correlation_time_s!r} must be a number >= 0")

    @classmethod
    def of_problem(cls, problem: Problem) -> RiskBudget:
        """Budget as a problem's ``planner.risk_per_mission`` asks for it.

        Raises
        ------
        ValueError
            If the problem asks for none.
        """
        planner, navigation = problem.planner, problem.navigation
        if planner.risk_per_mission is None:
            raise ValueError("planner.risk_per_mission is not given")
        time = planner.risk_correlation_time_s
        return cls(
            planner.risk_per_mission,
            problem.uav_count,
            planner.active_time_s,
            error_correlation_time(navigation) if time is None else time,
            1.0 / navigation.rate_hz,
        )

    @property
    def risk_per_uav(self) -> float:
        """Equal part of each UAV: asked / uavs, which holds however their errors depend on each other."""
        return self.asked / self.uavs

    @property
    def k(self) -> float:
        """Sigmas at which every UAV may stay for the active time."""
        return mission_k(self.risk_per_uav, self.active_s, self.correlation_time_s, self.period_s)

    def allocate(self, active_s: Array) -> Allocation:
        """Divide the risk over pairs of UAV and obstacle so that one level k serves all of them.

        A pair's part is the first-passage chance of its own time at this level: in the long run in
        proportion to the time. One level for all is what takes the least room in all.

        Parameters
        ----------
        active_s : array, shape (uav, obstacle)
            Time for which the obstacle is at the UAV's margin [s]; zero for never.

        Raises
        ------
        ValueError
            If a time is negative or not finite, or all are zero.
        """
        times = np.asarray(active_s, dtype=np.float64)
        if not (np.isfinite(times).all() and (times >= 0.0).all() and (times > 0.0).any()):
            raise ValueError("active_s must hold finite times >= 0 of which one or more is > 0")

        def parts(k: float) -> Array:
            risk = np.zeros(times.shape)
            for pair in zip(*np.nonzero(times), strict=True):
                time_s = float(times[pair])
                risk[pair] = first_passage_probability(k, time_s, self.correlation_time_s, self.period_s)
            return risk

        def excess(k: float) -> float:
            return math.log(math.fsum(parts(k).ravel().tolist()) / self.asked)

        if excess(0.0) <= 0.0:
            return Allocation(0.0, parts(0.0))
        high = 1.0
        while excess(high) > 0.0:
            high += 1.0
        k = float(optimize.brentq(excess, high - 1.0, high, xtol=1e-8))
        return Allocation(k, parts(k))


@dataclass(frozen=True)
class Certificate:
    """Risk of each run of a block: asked, bounded, and, after the flight, what came of it."""

    asked: float
    """Budget of a mission."""
    bound: Array
    """(run,) bound on the chance of contact of any UAV with any obstacle, as flown."""
    per_uav: Array
    """(run, uav) the same of each UAV."""
    contact: Mask | None = None
    """(run,) whether there was one; None before anybody looked at the truth."""

    @property
    def announced(self) -> Mask:
        """Runs (run,) whose bound went above the budget."""
        return self.bound > self.asked

    @property
    def unannounced(self) -> Mask:
        """Runs (run,) in contact although the bound stayed within the budget.

        A budget of p allows for them in p of all runs at most; more mean that an assumption does not hold.

        Raises
        ------
        ValueError
            If there is no verdict yet.
        """
        if self.contact is None:
            raise ValueError("contact is not known yet: judge the flight first")
        return np.asarray(self.contact & ~self.announced)


class RiskLedger:
    r"""Account of the risk that each UAV of each run has run up.

    Each obstacle has a level k(t), its distance in sigmas. A new one costs entry(k), every second costs
    rate(k), and a fall from k_1 to k_2 costs entry(k_2) - entry(k_1): the chance that the error lies between.
    At a constant level the sum is a bound (:func:`napf_mpc.first_passage.long_run`). The level that is
    charged follows k(t) down at once and up with the correlation time, because an error that was cut off
    below comes back no faster; it is never above k(t). A distance that trembles is then not charged for every
    tremble.

    Taken for granted: sigma is the true one; the error along the line to the obstacle is Gauss-Markov with
    the budget's correlation time; distances do not depend on the error, as for a UAV that keeps its estimate
    where it wants it. Obstacles count one by one (their chances are added).

    Parameters
    ----------
    budget : RiskBudget
        Asked risk and error process.
    runs, uavs, rows : int
        Shape of what is reported each step; rows are obstacles near a UAV.
    """

    def __init__(self, budget: RiskBudget, runs: int, uavs: int, rows: int) -> None:
        if min(runs, uavs, rows) < 1:
            raise ValueError(f"runs, uavs, rows = {runs}, {uavs}, {rows}: each must be >= 1")
        self._budget = budget
        self._entry, self._rate = _tables(budget.correlation_time_s, budget.period_s)
        self._spent = np.zeros((runs, uavs))
        self._obstacle = np.full((runs, uavs, rows), _NONE, dtype=np.int64)
        self._level = np.full((runs, uavs, rows), np.inf)

    def spend(self, distance: Array, sigma: Array, obstacle: Index, dt_s: float, active: Mask) -> None:
        """Charge one step.

        Parameters
        ----------
        distance : array, shape (run, uav, row)
            Planned distance from the UAV's surface to the obstacle's, no margin taken off; infinity for no
            obstacle [m].
        sigma : array, shape (run, uav, row)
            Standard deviation of the position towards the obstacle [m].
        obstacle : int array, shape (run, uav, row)
            Which obstacle; any number >= 0 that stays the same from step to step. Negative for none.
        dt_s : float
            Length of the step [s].
        active : bool array, shape (run,)
            Runs that still fly; the others are charged nothing.

        Raises
        ------
        ValueError
            If a shape differs, a distance is NaN, or a sigma is negative or not finite.
        """
        shape = self._level.shape
        for name, given in (("distance", distance), ("sigma", sigma), ("obstacle", obstacle)):
            if given.shape != shape:
                raise ValueError(f"{name} has shape {given.shape}, must be {shape}")
        if not (math.isfinite(dt_s) and dt_s > 0.0):
            raise ValueError(f"dt_s = {dt_s!r} must be a finite number > 0")
        real = obstacle >= 0
        if np.isnan(distance[real]).any():
            raise ValueError("distance holds NaN")
        if not (np.isfinite(sigma[real]).all() and (sigma[real] >= 0.0).all()):
            raise ValueError("sigma must hold finite numbers >= 0")
        time = self._budget.correlation_time_s
        _charge(
            np.ascontiguousarray(distance, dtype=np.float64),
            np.ascontiguousarray(sigma, dtype=np.float64),
            np.ascontiguousarray(obstacle, dtype=np.int64),
            np.ascontiguousarray(active, dtype=np.bool_),
            dt_s,
            -math.expm1(-dt_s / time) if time > 0.0 else 1.0,
            self._entry,
            self._rate,
            self._obstacle,
            self._level,
            self._spent,
        )

    def certificate(self, contact: Mask | None = None) -> Certificate:
        """Account so far, with the verdict on the truth where there is one.

        Parameters
        ----------
        contact : bool array, shape (run,), optional
            Whether any UAV touched an obstacle.
        """
        per_uav = -np.expm1(-self._spent)
        bound = np.zeros(len(per_uav))
        for uav in range(per_uav.shape[1]):
            bound += per_uav[:, uav]
        return Certificate(self._budget.asked, np.minimum(bound, 1.0), per_uav, contact)


@lru_cache(maxsize=16)
def _tables(correlation_time_s: float, period_s: float) -> tuple[Array, Array]:
    """Return entry and rate at k = 0, 0.2, ..., 8."""
    levels = _SPACING * np.arange(round(_FARTHEST / _SPACING) + 1)
    rows = np.array([long_run(float(k), correlation_time_s, period_s) for k in levels])
    return np.ascontiguousarray(rows[:, 0]), np.ascontiguousarray(rows[:, 1])


@compiled
def _looked_up(table: Array, k: float) -> float:
    """Value at a level between 0 and 8, by a parabola of its logarithm."""
    if k >= _FARTHEST:
        return 0.0
    i = min(int(k / _SPACING), len(table) - 3)
    low, mid, high = table[i], table[i + 1], table[i + 2]
    if not (low > 0.0 and mid > 0.0 and high > 0.0):
        return float(low)
    t = k / _SPACING - i
    first = math.log(mid / low)
    bend = math.log(high / mid) - first
    return float(low * math.exp(t * first + 0.5 * t * (t - 1.0) * bend))


@compiled
def _level(distance: float, sigma: float) -> float:
    if distance < 0.0:
        return -1.0  # All levels below zero mean the same; a finite one keeps what follows it finite.
    return distance / sigma if sigma > 0.0 else np.inf


@compiled
def _charge(
    distance: Array,
    sigma: Array,
    obstacle: Index,
    active: Mask,
    dt_s: float,
    relaxed: float,
    entry: Array,
    rate: Array,
    kept_obstacle: Index,
    kept_level: Array,
    spent: Array,
) -> None:
    runs, uavs, rows = distance.shape
    now_obstacle = np.empty(rows, np.int64)
    now_level = np.empty(rows)
    for r in range(runs):
        if not active[r]:
            continue
        for i in range(uavs):
            for j in range(rows):
                now_obstacle[j] = -1
                now_level[j] = np.inf
                if obstacle[r, i, j] < 0 or distance[r, i, j] == np.inf:
                    continue
                k = _level(distance[r, i, j], sigma[r, i, j])
                before = np.inf
                for m in range(rows):
                    if kept_obstacle[r, i, m] == obstacle[r, i, j]:
                        before = kept_level[r, i, m]
                if before < k:
                    k = min(k, before + relaxed * (min(k, _FARTHEST) - before))
                if k >= _FARTHEST:
                    continue
                now_obstacle[j] = obstacle[r, i, j]
                now_level[j] = k
                if k < 0.0:
                    # Where the UAV should be is in contact: nothing is left to bound.
                    spent[r, i] = np.inf
                    continue
                fallen = _looked_up(entry, k)
                if before < np.inf:
                    fallen -= _looked_up(entry, before)
                spent[r, i] += max(fallen, 0.0) + _looked_up(rate, k) * dt_s
            for j in range(rows):
                kept_obstacle[r, i, j] = now_obstacle[j]
                kept_level[r, i, j] = now_level[j]
