r"""Protection levels of many receivers at an epoch, with exclusion: the method of :mod:`.araim`, compiled.

A satellite left out changes the solution by rank one, so no hypothesis is solved anew. With
:math:`P = (H^T W H)^{-1}`, residuals r and their covariance :math:`V = W^{-1} - H P H^T`, leaving out a set F
moves the place along axis q by :math:`-A_{q,F} V_{FF}^{-1} r_F` and adds
:math:`\sigma_{ss,F,q}^2 = A_{q,F} V_{FF}^{-1} A_{q,F}^T` to its variance, A being the axes' part
of P H^T.

**Exclusion.** If a separation leaves its threshold, the satellite with the largest standardised residual is
left out and all is tested again, :data:`MOST_EXCLUDED` times at most. Which set of satellites j is believed
in the end depends on the errors, so

.. math:: P_{HMI} \le P_{unmonitored} + \sum_j P(|e_j| > L_j \text{ and } j \text{ is consistent}),

and each set has its share of the probability: half of it that of all in view, a quarter those without one
satellite, in equal parts, an eighth those without two, and so on. Half of each share is the height's, a
quarter that of each horizontal axis. Hypotheses are the same for all sets: what of one a set has left out
already makes no difference to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from napf_mpc.jit import compiled

__all__ = ["MOST_EXCLUDED", "LevelSettings", "Levels", "NoLevel", "protection_levels"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

MOST_EXCLUDED = 3
"""Satellites that alarms may exclude."""
_MOST_FAULTS = 3
_CLOCKS = 4
_UNKNOWNS = 3 + _CLOCKS
_MOST_IN_VIEW = 32
"""Of more satellites the likelier faulty ones are not used."""
_MOST_HYPOTHESES = 6000
_UNMONITORED = 0.1
"""Part of the probability that faults may have which no hypothesis covers."""
_UNIT = 2e-6
"""What the square of a unit vector's length may be off."""
_CLOSE_M = 0.01
"""A level is rounded up by this at most."""


class NoLevel(IntEnum):
    """Why there is none."""

    NONE = 0
    """There is one."""
    FEW = 1
    """Fewer satellites than clocks and four more, or they do not tell the position."""
    UNMONITORED = 2
    """Faults that no hypothesis covers are too likely."""
    ALARM = 3
    """Separations leave their thresholds, and exclusion does not help."""


@dataclass(frozen=True)
class LevelSettings:
    """What is asked of a level."""

    p_hmi: float = 1e-3
    """Probability that the error leaves HPL or VPL, without an alarm."""
    p_false_alarm: float = 1e-3
    """Probability of an alarm without a fault."""

    def __post_init__(self) -> None:
        for name in ("p_hmi", "p_false_alarm"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} = {getattr(self, name)!r} must be > 0 and < 1")


@dataclass(frozen=True)
class Levels:
    """Levels of receivers (...)."""

    level_m: Array
    """(..., 2) HPL and VPL [m]; infinite where there is none."""
    used: Mask
    """(..., sat) satellites whose solution with weights 1 / sigma^2 they bound."""
    excluded: NDArray[np.int64]
    """(...) number of satellites that alarms excluded."""
    why: NDArray[np.int8]
    """(...) codes of :class:`NoLevel`."""
    hypotheses: NDArray[np.int64]
    """(...) number of fault hypotheses."""


def protection_levels(
    directions: Array,
    clock: Index,
    ranges: Array,
    sigma: Array,
    p_fault: Array,
    usable: Mask,
    settings: LevelSettings,
) -> Levels:
    """Levels of receivers, each by itself.

    Parameters
    ----------
    directions : array, shape (receiver, sat, 3)
        Unit vectors to the satellites, east, north, up.
    clock : array of int, shape (sat,)
        Which clock, 0 to 3, a satellite is measured against.
    ranges : array, shape (receiver, sat)
        Pseudorange less the range expected at the approximate place [m].
    sigma : array, shape (receiver, sat)
        Of the fault-free error, an overbound without bias [m].
    p_fault : array, shape (receiver, sat)
        Prior probability that a signal is faulty: its satellite, or a reflection alone.
    usable : array of bool, shape (receiver, sat)
        Ranges to use.
    settings : LevelSettings
        Probabilities asked for.

    Raises
    ------
    ValueError
        If a shape or a type does not fit, a clock is not from 0 to 3, a usable number is not finite, a
        direction no unit vector, a sigma not positive, or a probability not in [0, 1).
    """
    directions, ranges, sigma, p_fault = (
        np.asarray(values, dtype=np.float64) for values in (directions, ranges, sigma, p_fault)
    )
    clock, usable = np.asarray(clock), np.asarray(usable)
    _check_fit(directions, clock, ranges, sigma, p_fault, usable)
    receivers = len(ranges)
    sound = np.isfinite(ranges) & np.isfinite(sigma) & (sigma > 0.0) & (p_fault >= 0.0) & (p_fault < 1.0)
    if not sound[usable].all():
        raise ValueError("ranges must be finite, sigma > 0 and 0 <= p_fault < 1 wherever a range is usable")
    lengths = np.einsum("...i,...i->...", directions, directions)
    if not (np.abs(lengths - 1.0) < _UNIT)[usable].all():
        raise ValueError("directions must be unit vectors wherever a range is usable")
    out = Levels(
        np.full((receivers, 2), np.inf),
        usable.copy(),
        np.zeros(receivers, dtype=np.int64),
        np.zeros(receivers, dtype=np.int8),
        np.zeros(receivers, dtype=np.int64),
    )
    _levels(
        np.ascontiguousarray(directions), clock.astype(np.int64, copy=False), ranges, sigma, p_fault,
        settings.p_hmi, _alarm_factors(settings.p_false_alarm), out.level_m, out.used, out.excluded, out.why,
        out.hypotheses,
    )  # fmt: skip
    return out


def _check_fit(
    directions: Array, clock: Index, ranges: Array, sigma: Array, p_fault: Array, usable: Mask
) -> None:
    """Refuse what compiled code, which checks no bounds, would read past the end of."""
    shape = ranges.shape
    if len(shape) != 2:
        raise ValueError(f"ranges has shape {shape}, must be (receiver, sat)")
    for name, given, needed in (
        ("directions", directions.shape, (*shape, 3)),
        ("clock", clock.shape, shape[1:]),
        ("sigma", sigma.shape, shape),
        ("p_fault", p_fault.shape, shape),
        ("usable", usable.shape, shape),
    ):
        if given != needed:
            raise ValueError(f"{name} has shape {given}, must be {needed}")
    if usable.dtype != np.bool_:
        raise ValueError(f"usable must be an array of bool, got {usable.dtype}")
    if clock.dtype.kind not in "iu":
        raise ValueError(f"clock must hold whole numbers from 0 to {_CLOCKS - 1}, got {clock.dtype}")
    if clock.size and not 0 <= clock.min() <= clock.max() < _CLOCKS:
        raise ValueError(
            f"clock must hold whole numbers from 0 to {_CLOCKS - 1}, got {clock.min()} to {clock.max()}"
        )


@cache
def _alarm_factors(p_false_alarm: float) -> Array:
    """K_FA (count, 2) by the number of hypotheses, of a horizontal axis and of height."""
    count = np.arange(1, _MOST_HYPOTHESES + 1)[:, None]
    share = p_false_alarm / 2.0 / np.array([4.0, 2.0]) / count
    return np.concatenate([np.full((1, 2), np.inf), -special.ndtri(share)])


@compiled
def _levels(
    directions: Array,
    clock: Index,
    ranges: Array,
    sigma: Array,
    p_fault: Array,
    p_hmi: float,
    alarm_factors: Array,
    level: Array,
    used: Mask,
    excluded: Index,
    why: NDArray[np.int8],
    hypotheses: Index,
) -> None:
    members = np.empty((_MOST_HYPOTHESES, _MOST_FAULTS), dtype=np.int64)
    prior = np.empty(_MOST_HYPOTHESES)
    growth, apart = np.empty((_MOST_HYPOTHESES, 3)), np.empty((_MOST_HYPOTHESES, 3))
    place = np.empty((3, ranges.shape[1]))
    spread = np.empty((ranges.shape[1], ranges.shape[1]))
    left = np.empty(ranges.shape[1])
    own = np.empty(3)
    for k in range(ranges.shape[0]):
        _keep_likeliest(p_fault[k], used[k])
        count, unmonitored = _hypotheses(p_fault[k], used[k], _UNMONITORED * p_hmi, members, prior)
        hypotheses[k] = count
        if unmonitored >= p_hmi:
            why[k] = NoLevel.UNMONITORED.value
            continue
        ways = 1.0
        share = 0.5
        while True:
            n, clocks = _count(clock, used[k])
            if n < clocks + 4 or not _solve(
                directions[k], clock, ranges[k], sigma[k], used[k], place, spread, left, own
            ):
                why[k] = NoLevel.FEW.value
                break
            lost = _separations(members, count, used[k], sigma[k], place, spread, left, growth, apart)
            worth = share / ways
            spent = unmonitored
            for h in range(count):
                if lost[h]:
                    spent += prior[h]
            if spent >= p_hmi:
                why[k] = NoLevel.UNMONITORED.value
                break
            if not _alarm(growth, apart, lost, count, alarm_factors[count]):
                budget = worth * (p_hmi - spent)
                across = 0.0
                for q in range(3):
                    part = 0.5 if q == 2 else 0.25
                    factor = alarm_factors[count, 1 if q == 2 else 0]
                    found = _level(own[q], growth[:, q], prior, lost, count, factor, part * budget)
                    if q < 2:
                        across += found * found
                    else:
                        level[k, 1] = found
                level[k, 0] = math.sqrt(across)
                break
            worst = _worst(used[k], sigma[k], spread, left)
            if excluded[k] == MOST_EXCLUDED or worst < 0:
                why[k] = NoLevel.ALARM.value
                break
            excluded[k] += 1
            used[k, worst] = False
            # As many sets are without so many satellites; n is what was in view before this one went.
            ways *= n / excluded[k]
            share *= 0.5


@compiled
def _keep_likeliest(p_fault: Array, used: Mask) -> None:
    """Do without the likelier faulty ones of too many satellites."""
    while used.sum() > _MOST_IN_VIEW:
        worst = -1
        for s in range(len(used)):
            if used[s] and (worst < 0 or p_fault[s] > p_fault[worst]):
                worst = s
        used[worst] = False


@compiled
def _hypotheses(p_fault: Array, used: Mask, enough: float, members: Index, prior: Array) -> tuple[int, float]:
    """Write fault hypotheses, likeliest of each number of faults first; how many, and what they leave.

    Members are satellites, -1 for none.
    """
    none = 1.0
    for s in range(len(used)):
        if used[s]:
            none *= 1.0 - p_fault[s]
    left = 1.0 - none
    count = 0
    for faults in range(1, _MOST_FAULTS + 1):
        if left <= enough:
            break
        first = count
        for a in range(len(used)):
            if not used[a] or p_fault[a] == 0.0:
                continue
            odds = none * p_fault[a] / (1.0 - p_fault[a])
            if faults == 1:
                count = _add(members, prior, count, a, -1, -1, odds)
                continue
            for b in range(a):
                if not used[b] or p_fault[b] == 0.0:
                    continue
                both = odds * p_fault[b] / (1.0 - p_fault[b])
                if faults == 2:
                    count = _add(members, prior, count, b, a, -1, both)
                    continue
                for c in range(b):
                    if used[c] and p_fault[c] > 0.0:
                        count = _add(members, prior, count, c, b, a, both * p_fault[c] / (1.0 - p_fault[c]))
        order = np.argsort(-prior[first:count], kind="mergesort")
        sorted_members, sorted_prior = members[first:count][order], prior[first:count][order]
        kept = 0
        while kept < len(order) and left > enough:
            members[first + kept] = sorted_members[kept]
            prior[first + kept] = sorted_prior[kept]
            left -= sorted_prior[kept]
            kept += 1
        count = first + kept
    return count, max(left, 0.0)


@compiled
def _add(members: Index, prior: Array, count: int, a: int, b: int, c: int, p: float) -> int:
    members[count, 0], members[count, 1], members[count, 2] = a, b, c
    prior[count] = p
    return count + 1


@compiled
def _count(clock: Index, used: Mask) -> tuple[int, int]:
    """Satellites and clocks in use."""
    n, clocks = 0, 0
    seen = np.zeros(_CLOCKS, dtype=np.bool_)
    for s in range(len(used)):
        if used[s]:
            n += 1
            if not seen[clock[s]]:
                seen[clock[s]] = True
                clocks += 1
    return n, clocks


@compiled
def _solve(
    directions: Array, clock: Index, ranges: Array, sigma: Array, used: Mask,
    place: Array, spread: Array, left: Array, own: Array,
) -> bool:  # fmt: skip
    """Write A (3, sat), V (sat, sat), residuals (sat,) and variances (3,); whether there is a solution."""
    column = np.full(_CLOCKS, -1, dtype=np.int64)
    unknowns = 3
    for s in range(len(used)):
        if used[s] and column[clock[s]] < 0:
            column[clock[s]] = unknowns
            unknowns += 1
    design = np.zeros((len(used), _UNKNOWNS))
    normal, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for s in range(len(used)):
        if not used[s]:
            continue
        for a in range(3):
            design[s, a] = -directions[s, a]
        design[s, column[clock[s]]] = 1.0
        weight = 1.0 / sigma[s] ** 2
        for a in range(unknowns):
            right[a] += design[s, a] * weight * ranges[s]
            for b in range(unknowns):
                normal[a, b] += design[s, a] * weight * design[s, b]
    low = np.zeros((unknowns, unknowns))
    for a in range(unknowns):
        for b in range(a + 1):
            total = normal[a, b]
            for c in range(b):
                total -= low[a, c] * low[b, c]
            if a == b:
                if not total > 1e-8 * normal[a, a]:
                    return False
                low[a, a] = math.sqrt(total)
            else:
                low[a, b] = total / low[b, b]
    # L^-1 H^T, column by column: P H^T and H P H^T follow.
    half = np.zeros((len(used), unknowns))
    for s in range(len(used)):
        if used[s]:
            for a in range(unknowns):
                total = design[s, a]
                for c in range(a):
                    total -= low[a, c] * half[s, c]
                half[s, a] = total / low[a, a]
    inverse = np.zeros((unknowns, unknowns))  # L^-1
    for b in range(unknowns):
        for a in range(b, unknowns):
            total = 1.0 if a == b else 0.0
            for c in range(b, a):
                total -= low[a, c] * inverse[c, b]
            inverse[a, b] = total / low[a, a]
    x = np.zeros(unknowns)
    for c in range(unknowns):
        part = 0.0
        for b in range(c + 1):
            part += inverse[c, b] * right[b]
        for a in range(c + 1):
            x[a] += inverse[c, a] * part
    for q in range(3):
        own[q] = 0.0
        for c in range(q, unknowns):
            own[q] += inverse[c, q] ** 2
    for s in range(len(used)):
        if not used[s]:
            continue
        left[s] = ranges[s]
        for a in range(unknowns):
            left[s] -= design[s, a] * x[a]
        for q in range(3):
            place[q, s] = 0.0
            for c in range(q, unknowns):
                place[q, s] += inverse[c, q] * half[s, c]
        for t in range(s + 1):
            if used[t]:
                total = 0.0
                for c in range(unknowns):
                    total += half[s, c] * half[t, c]
                spread[s, t] = (sigma[s] ** 2 if s == t else 0.0) - total
                spread[t, s] = spread[s, t]
    return True


@compiled
def _separations(
    members: Index, count: int, used: Mask, sigma: Array, place: Array, spread: Array, left: Array,
    growth: Array, apart: Array,
) -> Mask:  # fmt: skip
    """Write what each hypothesis adds to the variances and moves the place; which cannot be looked at."""
    lost = np.zeros(count, dtype=np.bool_)
    at = np.empty(_MOST_FAULTS, dtype=np.int64)
    low = np.empty((_MOST_FAULTS, _MOST_FAULTS))
    y, z = np.empty(_MOST_FAULTS), np.empty(_MOST_FAULTS)
    for h in range(count):
        size = 0
        for m in range(_MOST_FAULTS):
            s = members[h, m]
            if s >= 0 and used[s]:
                at[size] = s
                size += 1
        for i in range(size):
            for j in range(i + 1):
                total = spread[at[i], at[j]]
                for c in range(j):
                    total -= low[i, c] * low[j, c]
                if i == j:
                    # Without them nothing is left that would tell the position.
                    if not total > 1e-6 * sigma[at[i]] ** 2:
                        lost[h] = True
                        total = 1.0
                    low[i, i] = math.sqrt(total)
                else:
                    low[i, j] = total / low[j, j]
            y[i] = left[at[i]]
            for c in range(i):
                y[i] -= low[i, c] * y[c]
            y[i] /= low[i, i]
        for q in range(3):
            growth[h, q], apart[h, q] = 0.0, 0.0
            for i in range(size):
                z[i] = place[q, at[i]]
                for c in range(i):
                    z[i] -= low[i, c] * z[c]
                z[i] /= low[i, i]
                growth[h, q] += z[i] * z[i]
                apart[h, q] += z[i] * y[i]
    return lost


@compiled
def _alarm(growth: Array, apart: Array, lost: Mask, count: int, factors: Array) -> bool:
    for h in range(count):
        if lost[h]:
            continue
        for q in range(3):
            factor = factors[1 if q == 2 else 0]
            if apart[h, q] ** 2 > factor * factor * growth[h, q]:
                return True
    return False


@compiled
def _worst(used: Mask, sigma: Array, spread: Array, left: Array) -> int:
    """Satellite with the largest standardised residual; -1 if none has one to speak of."""
    worst, largest = -1, 0.0
    for s in range(len(used)):
        if used[s] and spread[s, s] > 1e-6 * sigma[s] ** 2:
            size = left[s] ** 2 / spread[s, s]
            if size > largest:
                worst, largest = s, size
    return worst


@compiled
def _level(
    own: float, growth: Array, prior: Array, lost: Mask, count: int, factor: float, budget: float
) -> float:
    """Least level of one axis, to :data:`_CLOSE_M` above."""
    low, high = 0.0, 9.0 * math.sqrt(own)
    while _excess(high, own, growth, prior, lost, count, factor, budget):
        low, high = high, 2.0 * high
    while high - low > _CLOSE_M:
        middle = 0.5 * (low + high)
        if _excess(middle, own, growth, prior, lost, count, factor, budget):
            low = middle
        else:
            high = middle
    return high


@compiled
def _excess(
    level: float,
    own: float,
    growth: Array,
    prior: Array,
    lost: Mask,
    count: int,
    factor: float,
    budget: float,
) -> bool:
    """Whether the probability of an error beyond a level is more than the budget."""
    total = math.erfc(level / math.sqrt(2.0 * own))
    for h in range(count):
        if total > budget:
            return True
        if not lost[h]:
            room = level - factor * math.sqrt(growth[h])
            total += 0.5 * prior[h] * math.erfc(room / math.sqrt(2.0 * (own + growth[h])))
    return total > budget
