r"""Position from pseudoranges: weighted least squares, its covariance, robust weights, fault exclusion.

A pseudorange less the range that is expected at an approximate place is, to first order,

.. math:: y = -u^T x + c_{sys} + \varepsilon,

with u the unit vector to the satellite, x the place sought from the approximate one and c the receiver's
clock against the satellite's system. With rows h = (-u, 0..1..0), weights W and
:math:`S = (H^T W H)^{-1} H^T W`, the solution is S y, and its covariance S C S^T with C that of the errors;
it is :math:`(H^T W H)^{-1}` only if W is the inverse of C. Errors that two receivers share satellite by
satellite, of covariance C_shared, give the covariance S_i C_shared S_j^T between their positions.

Residual-based fault detection (Parkinson and Axelrad 1988): without faults, the weighted sum of squared
residuals follows a chi-square law with n - 3 - m degrees of freedom, n satellites and m clocks. One degree is
needed to detect (n >= m + 4), two to tell which satellite it was (n >= m + 5): the one with the largest
standardised residual (Baarda 1968) is left out, and the test is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from napf_mpc.jit import compiled

__all__ = ["Check", "PseudorangeSolution", "SolverSettings", "design_matrix", "solve"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

MAX_CLOCKS = 4
_UNKNOWNS = 3 + MAX_CLOCKS
_STEPS = 10
"""Re-weightings at most; they end earlier once the place moves by less than a millimetre."""
_MAX_SATELLITES = 256
HUBER = 1.345
"""Residual in sigmas above which Huber's weight falls as its inverse: 95 % efficient for a normal law."""
CAUCHY = 2.385
"""Scale of Cauchy's weight in sigmas: 95 % efficient for a normal law."""
_WEIGHTINGS = ("plain", "huber", "cauchy")


class Check(IntEnum):
    """What the residuals say of a position."""

    NONE = 0
    """There is no position: too few satellites, or they stand too badly."""
    UNCHECKED = 1
    """A position without integrity: no satellite more than the position needs (n < m + 4)."""
    PASSED = 2
    """The residuals fit the errors that are expected."""
    FAULTY = 3
    """They do not, and no satellite is left that could be excluded (n < m + 5)."""


@dataclass(frozen=True)
class SolverSettings:
    """How positions are computed."""

    weighting: Literal["plain", "huber", "cauchy"] = "huber"
    """Weights: 1 / sigma^2, or those times Huber's or Cauchy's factor."""
    exclude: bool = True
    """Whether the residual test is made, and satellites are excluded."""
    false_alarm: float = 1e-3
    """Probability of each test to fail without a fault."""
    max_pdop: float = 20.0
    """Position dilution of precision above which there is no position."""


@dataclass(frozen=True)
class PseudorangeSolution:
    """Positions of many receivers, arrays (..., ) over receivers; zero where there is none."""

    offset: Array
    """(..., 3) place from the approximate one, east, north, up [m]."""
    clock: Array
    """(..., clock) receiver's clock against each system [m]; NaN where no satellite of it is used."""
    covariance: Array
    """(..., 3, 3) S C S^T of the place [m^2]."""
    gain: Array
    """(..., 3, sat) S: how an error of a range enters the place."""
    used: Mask
    """(..., sat) satellites in the solution."""
    check: NDArray[np.int8]
    """(...) codes of :class:`Check`."""
    dop: Array
    """(..., 3) HDOP, VDOP, PDOP; infinite where there is no position."""
    excess: Array
    """(...) weighted sum of squared residuals over its degrees of freedom; NaN without any."""


def design_matrix(directions: Array, clock: Index, used: Mask) -> Array:
    """Rows (-u, 1 at the system's clock) of the satellites that are used, clocks that none has left out.

    Parameters
    ----------
    directions : array, shape (sat, 3)
        Unit vectors to the satellites, east, north, up.
    clock : array of int, shape (sat,)
        Which clock a satellite is measured against.
    used : array of bool, shape (sat,)
        Which satellites.

    Returns
    -------
    array, shape (n, 3 + m)
        H of a linearised position.
    """
    clocks = np.unique(clock[used])
    return np.hstack([-directions[used], (clock[used][:, None] == clocks).astype(np.float64)])


def solve(
    directions: Array,
    clock: Index,
    ranges: Array,
    sigma: Array,
    tracked: Mask,
    settings: SolverSettings,
) -> PseudorangeSolution:
    """Positions of receivers from their ranges, each by itself.

    Parameters
    ----------
    directions : array, shape (receiver, sat, 3)
        Unit vectors to the satellites, east, north, up.
    clock : array of int, shape (sat,)
        Which clock, 0 to 3, a satellite is measured against.
    ranges : array, shape (receiver, sat)
        Pseudorange less the range expected at the approximate place [m].
    sigma : array, shape (receiver, sat)
        Of the error of each range, as the receiver believes [m]; C = diag(sigma^2).
    tracked : array of bool, shape (receiver, sat)
        Ranges that there are.
    settings : SolverSettings
        How.

    Returns
    -------
    PseudorangeSolution
        Per receiver.

    Raises
    ------
    ValueError
        If a used number is not finite, a sigma is not positive or a clock is out of range.
    """
    receivers, sats = ranges.shape
    if not (np.isfinite(ranges) & np.isfinite(sigma) & (sigma > 0.0))[tracked].all():
        raise ValueError("ranges and sigma must be finite and sigma > 0 wherever a satellite is tracked")
    if sats > _MAX_SATELLITES or clock.min(initial=0) < 0 or clock.max(initial=0) >= MAX_CLOCKS:
        raise ValueError(f"at most {_MAX_SATELLITES} satellites and {MAX_CLOCKS} clocks, got {sats}, {clock}")
    out = PseudorangeSolution(
        offset=np.zeros((receivers, 3)),
        clock=np.full((receivers, MAX_CLOCKS), np.nan),
        covariance=np.zeros((receivers, 3, 3)),
        gain=np.zeros((receivers, 3, sats)),
        used=np.zeros((receivers, sats), dtype=np.bool_),
        check=np.zeros(receivers, dtype=np.int8),
        dop=np.full((receivers, 3), np.inf),
        excess=np.full(receivers, np.nan),
    )
    _solve_all(
        np.ascontiguousarray(directions), clock, ranges, sigma, tracked,
        _WEIGHTINGS.index(settings.weighting), settings.exclude, _thresholds(settings.false_alarm),
        settings.max_pdop, out.offset, out.clock, out.covariance, out.gain, out.used, out.check, out.dop,
        out.excess,
    )  # fmt: skip
    return out


@cache
def _thresholds(false_alarm: float) -> Array:
    """Quantiles of the chi-square laws: by degrees of freedom, what is exceeded that rarely."""
    degrees = np.arange(1, _MAX_SATELLITES + 1)
    return np.concatenate([[np.inf], chdtri(degrees, false_alarm)])


@compiled
def _solve_all(
    directions: Array,
    clock: Index,
    ranges: Array,
    sigma: Array,
    tracked: Mask,
    weighting: int,
    exclude: bool,
    thresholds: Array,
    max_pdop: float,
    offset: Array,
    clocks: Array,
    covariance: Array,
    gain: Array,
    used: Mask,
    check: NDArray[np.int8],
    dop: Array,
    excess: Array,
) -> None:
    sats = ranges.shape[1]
    design = np.zeros((sats, _UNKNOWNS))
    weight = np.empty(sats)
    inverse = np.empty((_UNKNOWNS, _UNKNOWNS))
    column = np.empty(MAX_CLOCKS, dtype=np.int64)
    x = np.empty(_UNKNOWNS)
    for k in range(ranges.shape[0]):
        for s in range(sats):
            used[k, s] = tracked[k, s]
        while True:
            n, unknowns = _rows(directions[k], clock, used[k], design, column)
            for s in range(sats):
                weight[s] = 1.0 / sigma[k, s] ** 2
            solved = n >= unknowns and _estimate(design, used[k], weight, ranges[k], unknowns, inverse, x)
            if not solved:
                check[k] = Check.NONE.value
                break
            degrees = n - unknowns
            misfit = _misfit(design, used[k], weight, ranges[k], unknowns, x)
            if degrees > 0:
                excess[k] = misfit / degrees
            check[k] = Check.PASSED.value if degrees >= 1 else Check.UNCHECKED.value
            if not exclude or degrees < 1 or misfit <= thresholds[degrees]:
                break
            check[k] = Check.FAULTY.value
            if degrees < 2:
                break
            worst = _worst(design, used[k], weight, ranges[k], unknowns, inverse, x)
            if worst < 0:
                break
            used[k, worst] = False
        if check[k] != Check.NONE.value and weighting > 0:
            _reweight(design, used[k], sigma[k], weight, ranges[k], unknowns, inverse, x, weighting)
        if check[k] != Check.NONE.value:
            _dilution(design, used[k], unknowns, dop[k])
        if check[k] == Check.NONE.value or not dop[k, 2] <= max_pdop:
            check[k] = Check.NONE.value
            excess[k] = np.nan
            used[k, :] = False
            continue
        for a in range(3):
            offset[k, a] = x[a]
        for c in range(MAX_CLOCKS):
            if column[c] >= 0:
                clocks[k, c] = x[column[c]]
        _gain(design, used[k], weight, unknowns, inverse, gain[k])
        for a in range(3):
            for b in range(3):
                total = 0.0
                for s in range(sats):
                    if used[k, s]:
                        total += gain[k, a, s] * gain[k, b, s] * sigma[k, s] ** 2
                covariance[k, a, b] = total


@compiled
def _rows(directions: Array, clock: Index, used: Mask, design: Array, column: Index) -> tuple[int, int]:
    """Write the rows of H and the columns of the clocks (-1 for none); number of rows and of unknowns."""
    n = 0
    column[:] = -1
    for s in range(len(used)):
        if used[s]:
            n += 1
            column[clock[s]] = 0
    unknowns = 3
    for c in range(MAX_CLOCKS):
        if column[c] == 0:
            column[c] = unknowns
            unknowns += 1
    for s in range(len(used)):
        design[s] = 0.0
        if used[s]:
            for a in range(3):
                design[s, a] = -directions[s, a]
            design[s, column[clock[s]]] = 1.0
    return n, unknowns


@compiled
def _estimate(
    design: Array, used: Mask, weight: Array, ranges: Array, unknowns: int, inverse: Array, x: Array
) -> bool:
    """Write (H^T W H)^-1 and the solution; whether the matrix can be inverted."""
    normal = np.zeros((_UNKNOWNS, _UNKNOWNS))
    right = np.zeros(_UNKNOWNS)
    for s in range(len(used)):
        if not used[s]:
            continue
        for a in range(unknowns):
            right[a] += design[s, a] * weight[s] * ranges[s]
            for b in range(a + 1):
                normal[a, b] += design[s, a] * weight[s] * design[s, b]
    if not _invert(normal, unknowns, inverse):
        return False
    for a in range(unknowns):
        x[a] = 0.0
        for b in range(unknowns):
            x[a] += inverse[a, b] * right[b]
    return True


@compiled
def _invert(matrix: Array, n: int, inverse: Array) -> bool:
    """Invert the leading n x n of a symmetric matrix (lower triangle given) by Cholesky's factor."""
    low = np.zeros((n, n))
    for a in range(n):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= low[a, c] * low[b, c]
            if a == b:
                # Against its own size: satellites in one plane or on one cone leave rounding only.
                if not total > 1e-10 * matrix[a, a]:
                    return False
                low[a, a] = np.sqrt(total)
            else:
                low[a, b] = total / low[b, b]
    for column in range(n):
        for a in range(n):
            total = 1.0 if a == column else 0.0
            for c in range(a):
                total -= low[a, c] * inverse[c, column]
            inverse[a, column] = total / low[a, a]
        for a in range(n - 1, -1, -1):
            total = inverse[a, column]
            for c in range(a + 1, n):
                total -= low[c, a] * inverse[c, column]
            inverse[a, column] = total / low[a, a]
    return True


@compiled
def _residual(design: Array, s: int, ranges: Array, unknowns: int, x: Array) -> float:
    left: float = ranges[s]
    for a in range(unknowns):
        left -= design[s, a] * x[a]
    return left


@compiled
def _misfit(design: Array, used: Mask, weight: Array, ranges: Array, unknowns: int, x: Array) -> float:
    total = 0.0
    for s in range(len(used)):
        if used[s]:
            total += weight[s] * _residual(design, s, ranges, unknowns, x) ** 2
    return total


@compiled
def _worst(
    design: Array, used: Mask, weight: Array, ranges: Array, unknowns: int, inverse: Array, x: Array
) -> int:
    """Satellite with the largest residual over its own sigma; -1 if no residual can show a fault."""
    worst = -1
    largest = 0.0
    for s in range(len(used)):
        if not used[s]:
            continue
        variance = 1.0 / weight[s]
        for a in range(unknowns):
            for b in range(unknowns):
                variance -= design[s, a] * inverse[a, b] * design[s, b]
        # A satellite that alone holds an unknown (a system's only one) has no residual to speak of.
        if variance * weight[s] > 1e-6:
            size = _residual(design, s, ranges, unknowns, x) ** 2 / variance
            if size > largest:
                largest = size
                worst = s
    return worst


@compiled
def _reweight(
    design: Array,
    used: Mask,
    sigma: Array,
    weight: Array,
    ranges: Array,
    unknowns: int,
    inverse: Array,
    x: Array,
    weighting: int,
) -> None:
    """Repeat the estimate with weights that fall with the residual, in place."""
    before = np.empty(_UNKNOWNS)
    for _ in range(_STEPS):
        for s in range(len(used)):
            if used[s]:
                size = abs(_residual(design, s, ranges, unknowns, x)) / sigma[s]
                if weighting == 1:
                    factor = 1.0 if size <= HUBER else HUBER / size
                else:
                    factor = 1.0 / (1.0 + (size / CAUCHY) ** 2)
                weight[s] = factor / sigma[s] ** 2
        before[:] = x
        if not _estimate(design, used, weight, ranges, unknowns, inverse, x):
            # Weights of nearly nothing: what stood before is kept, and weights that belong to it.
            for s in range(len(used)):
                weight[s] = 1.0 / sigma[s] ** 2
            _estimate(design, used, weight, ranges, unknowns, inverse, x)
            return
        moved = 0.0
        for a in range(3):
            moved = max(moved, abs(x[a] - before[a]))
        if moved < 1e-3:
            return


@compiled
def _dilution(design: Array, used: Mask, unknowns: int, dop: Array) -> None:
    """Write HDOP, VDOP and PDOP of the satellites used, all weights one; they stay where it fails."""
    normal = np.zeros((_UNKNOWNS, _UNKNOWNS))
    inverse = np.empty((_UNKNOWNS, _UNKNOWNS))
    for s in range(len(used)):
        if used[s]:
            for a in range(unknowns):
                for b in range(a + 1):
                    normal[a, b] += design[s, a] * design[s, b]
    if _invert(normal, unknowns, inverse):
        dop[0] = np.sqrt(inverse[0, 0] + inverse[1, 1])
        dop[1] = np.sqrt(inverse[2, 2])
        dop[2] = np.sqrt(inverse[0, 0] + inverse[1, 1] + inverse[2, 2])


@compiled
def _gain(design: Array, used: Mask, weight: Array, unknowns: int, inverse: Array, gain: Array) -> None:
    for s in range(len(used)):
        if used[s]:
            for a in range(3):
                total = 0.0
                for b in range(unknowns):
                    total += inverse[a, b] * design[s, b]
                gain[a, s] = total * weight[s]
