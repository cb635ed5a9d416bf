r"""Subset simulation: the probability of a rare event as a product of probabilities that are not rare.

A limit state g of standard-normal numbers u fails where g(u) <= 0. With thresholds b_1 > b_2 > ... > b_m = 0,

.. math:: P(g \le 0) = P(g \le b_1) \prod_{i=2}^{m} P(g \le b_i \mid g \le b_{i-1}),

and each threshold is put where a tenth of the samples of its level lie below (Au and Beck 2001). Samples
under a condition come from Markov chains that start at those of the level before which meet it. A step

.. math:: u' = \sqrt{1 - \sigma^2} \, u + \sigma \xi, \qquad \xi \sim N(0, I),

leaves the standard normal law as it is in any number of dimensions, and is refused where g(u') is above
the threshold: conditional sampling, with sigma adapted until 44 % of the steps are taken (Papaioannou, Betz,
Zwirglmaier and Straub 2015; elsewhere known as the preconditioned Crank-Nicolson proposal).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.streams import Stream, generator

Array = NDArray[np.float64]
LimitState = Callable[[Array], Array]

ACCEPTED = 0.44
"""Share of the steps that should be taken: the best for a chain in one dimension that counts."""
FIRST_SCALE = 0.6
"""Scale of the first step, sigma."""
MAX_LEVELS = 20


@dataclass(frozen=True)
class Level:
    """One factor of the product."""

    threshold: float
    """b: the limit state's value that this level leads to; 0 at the last."""
    probability: float
    """Share of the level's samples at or below the threshold."""
    cov: float
    """Coefficient of variation of this share, chains' correlation included."""
    accepted: float
    """Share of the chains' steps that were taken; NaN in the first level, which has none."""


@dataclass(frozen=True)
class SubsetResult:
    """Estimate of a small probability."""

    probability: float
    """P(g <= 0); 0 if it was not reached."""
    cov: float
    """Coefficient of variation, the standard error over the estimate, if levels were independent. Optimistic:
    levels share samples, and chains that start at one place are counted as if they did not."""
    cov_bound: float
    """The same if all levels erred together: the sum of their coefficients."""
    levels: tuple[Level, ...]
    """From the first, of plain Monte Carlo, to the last."""
    calls: int
    """Evaluations of the limit state."""
    reached: bool
    """Whether the thresholds came down to 0. If not, the probability is probably below ``below``."""
    below: float
    """Product of all levels' probabilities: the estimate, or what it lies below if 0 was not reached."""


def subset_simulation(
    limit_state: LimitState,
    dimension: int,
    *,
    seed: int = 0,
    samples: int = 1000,
    level_probability: float = 0.1,
    max_levels: int = MAX_LEVELS,
) -> SubsetResult:
    """Estimate the probability that a function of standard-normal numbers is not positive.

    Parameters
    ----------
    limit_state : callable
        Takes an array (n, dimension) of points, returns their values (n,); the event is a value <= 0. It must
        be a function of the point alone. Infinities are allowed, NaN is not. It is called with ``samples``
        points once, then always with ``samples * level_probability``.
    dimension : int
        Number of standard-normal numbers.
    seed : int
        Of all random numbers; the same seed gives the same result.
    samples : int
        Points a level.
    level_probability : float
        Share of a level's points that start the next; its inverse, the length of a chain, must be whole.
    max_levels : int
        Levels after which it gives up.

    Returns
    -------
    SubsetResult
        Estimate, its coefficient of variation, levels and number of calls.

    Raises
    ------
    ValueError
        If a setting is out of range, or the limit state returns something else than n numbers.
    """
    chain, chains = _shape(dimension, samples, level_probability, max_levels)
    u = generator(seed, 0, Stream.RARE_EVENT).standard_normal((samples, dimension))
    g = _values(limit_state, u)
    calls, scale, accepted = samples, FIRST_SCALE, math.nan
    levels: list[Level] = []
    length = 1
    while True:
        lowest = float(np.sort(g)[chains - 1])
        # Where nothing gets lower, a further level would be the same again.
        stuck = bool(levels) and lowest >= levels[-1].threshold
        last = lowest <= 0.0 or stuck or len(levels) + 1 == max_levels
        threshold = 0.0 if last else lowest
        below = g <= threshold
        share = float(below.mean())
        levels.append(Level(threshold, share, _cov(below, length), accepted))
        if last:
            break
        starts = np.flatnonzero(below)
        if len(starts) > chains:  # several lie on the threshold: which of all go on must not depend on g
            starts = generator(seed, len(levels), Stream.RARE_EVENT).permutation(starts)[:chains]
        u, g = u[starts], g[starts]
        u, g, scale, accepted = _chains(limit_state, u, g, threshold, chain, scale, seed, len(levels))
        calls += samples - chains
        length = chain
    return _result(levels, calls)


def _result(levels: list[Level], calls: int) -> SubsetResult:
    shares = [level.probability for level in levels]
    reached = shares[-1] > 0.0
    covs = [level.cov for level in levels if level.probability > 0.0]
    estimate = math.prod(shares)
    return SubsetResult(
        probability=estimate,
        cov=math.sqrt(math.fsum(cov**2 for cov in covs)) if reached else math.nan,
        cov_bound=math.fsum(covs) if reached else math.nan,
        levels=tuple(levels),
        calls=calls,
        reached=reached,
        below=estimate if reached else math.prod(shares[:-1]),
    )


def _shape(dimension: int, samples: int, level_probability: float, max_levels: int) -> tuple[int, int]:
    """Length of a chain, and number of chains."""
    if dimension < 1 or max_levels < 1:
        raise ValueError(f"dimension = {dimension} and max_levels = {max_levels} must be at least 1")
    if not 0.0 < level_probability <= 0.5 or abs(1.0 / level_probability % 1.0 - 0.5) < 0.5 - 1e-9:
        raise ValueError(f"level_probability = {level_probability}: must be 1/2, 1/3, ...")
    chain = round(1.0 / level_probability)
    if samples < 2 * chain or samples % chain:
        raise ValueError(f"samples = {samples}: must be a multiple of {chain}, at least {2 * chain}")
    return chain, samples // chain


def _values(limit_state: LimitState, u: Array) -> Array:
    values = np.asarray(limit_state(u), dtype=np.float64)
    if values.shape != (len(u),):
        raise ValueError(
            f"limit_state returned shape {values.shape} for {len(u)} points, must be ({len(u)},)"
        )
    if np.isnan(values).any():
        raise ValueError("limit_state returned NaN: say what such a point is, failed or not")
    return values


def _chains(
    limit_state: LimitState,
    u: Array,
    g: Array,
    threshold: float,
    chain: int,
    scale: float,
    seed: int,
    level: int,
) -> tuple[Array, Array, float, float]:
    """Grow chains under a condition, all in lock-step; samples by step, then by chain."""
    # One sigma for all numbers. One for each, from the spread of the chains' starts, would depend on the very
    # points it moves: with more numbers than chains the estimate comes out wrong to one side.
    states, values, taken = np.empty((chain, *u.shape)), np.empty((chain, len(g))), []
    states[0], values[0] = u, g
    for step in range(1, chain):
        sigma = min(scale, 1.0)
        xi = generator(seed, level, Stream.RARE_EVENT, step).standard_normal(u.shape)
        proposal = math.sqrt(1.0 - sigma * sigma) * u + sigma * xi
        value = _values(limit_state, proposal)
        inside = value <= threshold
        u = np.where(inside[:, None], proposal, u)
        g = np.where(inside, value, g)
        states[step], values[step] = u, g
        taken.append(float(inside.mean()))
        scale = min(scale * math.exp((taken[-1] - ACCEPTED) / math.sqrt(step)), 10.0)
    return states.reshape(-1, u.shape[1]), values.ravel(), scale, float(np.mean(taken))


def _cov(below: NDArray[np.bool_], length: int) -> float:
    r"""Coefficient of variation of a level's share, from the correlation along its chains.

    delta^2 = (1 - p) / (p N) (1 + gamma), gamma = 2 sum_k (1 - k / L) R(k) / R(0) over the lags k of a chain
    of length L (Au and Beck 2001).
    """
    share = float(below.mean())
    if share in (0.0, 1.0):
        return 0.0
    along = below.reshape(length, -1) - share
    gamma = 0.0
    for lag in range(1, length):
        correlation = float((along[:-lag] * along[lag:]).mean()) / (share * (1.0 - share))
        gamma += 2.0 * (1.0 - lag / length) * correlation
    return math.sqrt((1.0 - share) / (share * below.size) * max(1.0 + gamma, 1.0))
