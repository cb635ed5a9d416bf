"""Statistics of many missions: rates with intervals, quantiles, paired tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rate:
    """A fraction of missions with its 95 % Wilson interval."""

    count: int
    """Missions in which it happened."""
    total: int
    """All missions."""
    value: float
    """count / total."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of the 95 % interval."""


def wilson(count: int, total: int) -> Rate:
    """Fraction with its 95 % Wilson score interval; 22 of 30 gives 0.556 to 0.858.

    Raises
    ------
    ValueError
        If not 0 <= count <= total, or total is 0.
    """
    if total < 1 or not 0 <= count <= total:
        raise ValueError(f"need 0 <= count <= total and total >= 1, got count {count}, total {total}")
    from scipy import stats  # a quarter of the start of a process, and workers have no use for it

    interval = stats.binomtest(count, total).proportion_ci(method="wilson")
    return Rate(count, total, count / total, float(interval.low), float(interval.high))


def clustered_rate(hits: NDArray[np.int64], size: int) -> Rate:
    """Fraction of UAV-missions with a 95 % interval that allows for UAVs of one run sharing their fate.

    The Wilson interval is taken at the effective number of trials p (1 - p) / var(p), with the variance
    estimated between runs (Korn and Graubard 1998), and held between the number of runs and of UAV-missions.

    Parameters
    ----------
    hits : array of int, shape (run,)
        UAVs hit in each run.
    size : int
        UAVs a run.

    Raises
    ------
    ValueError
        If there are no runs or no UAVs, or more UAVs of a run are hit than it has.
    """
    runs = len(hits)
    if runs < 1 or size < 1:
        raise ValueError(f"{runs} runs of {size} UAVs: at least one of each is needed")
    if not 0 <= hits.min() <= hits.max() <= size:
        raise ValueError(f"hits must be from 0 to size = {size}, got {hits.min()} to {hits.max()}")
    total = runs * size
    count = int(hits.sum())
    value = count / total
    between = float(np.var(hits / size, ddof=1)) / runs if runs > 1 else 0.0
    effective = value * (1.0 - value) / between if between > 0.0 else float(runs)
    effective = min(max(effective, float(runs)), float(total))
    z = float(ndtri(0.975))
    centre = (value + z * z / (2.0 * effective)) / (1.0 + z * z / effective)
    spread = math.sqrt(value * (1.0 - value) / effective + z * z / (4.0 * effective**2))
    half = z * spread / (1.0 + z * z / effective)
    low = 0.0 if count == 0 else max(0.0, centre - half)
    high = 1.0 if count == total else min(1.0, centre + half)
    return Rate(count, total, value, low, high)


@dataclass(frozen=True)
class Paired:
    """Two planners on the same runs: who hit an obstacle where the other did not."""

    a: str
    """First planner."""
    b: str
    """Second planner."""
    both: int
    """Runs in which both hit."""
    only_a: int
    """Runs in which only a hit."""
    only_b: int
    """Runs in which only b hit."""
    neither: int
    """Runs in which neither hit."""
    p_value: float
    """Two-sided exact McNemar test of equal risk."""
    p_value_corrected: float
    """The same after Holm's correction for the number of pairs."""


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided exact McNemar p-value: a binomial test of the runs in which just one of two hit."""
    from scipy import stats  # as above

    discordant = only_a + only_b
    return 1.0 if discordant == 0 else float(stats.binomtest(only_a, discordant, 0.5).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: p-values that hold for the whole family of tests."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    corrected = [0.0] * len(p_values)
    running = 0.0
    for rank, i in enumerate(order):
        running = max(running, min(1.0, (len(p_values) - rank) * p_values[i]))
        corrected[i] = running
    return corrected


def paired_tests(hits: dict[str, NDArray[np.bool_]]) -> list[Paired]:
    """Compare all pairs of planners on the same runs.

    Parameters
    ----------
    hits : dict of str to array of bool, shape (run,)
        Obstacle collision of each run, same runs in the same order for every planner.

    Raises
    ------
    ValueError
        If planners have hits of different numbers of runs.
    """
    hits = {name: np.asarray(each, dtype=np.bool_) for name, each in hits.items()}
    names = list(hits)
    for name, each in hits.items():
        if each.ndim != 1:
            raise ValueError(f"{name} has hits of shape {each.shape}, must be (run,)")
        if each.shape != hits[names[0]].shape:
            raise ValueError(
                f"{names[0]} has hits of shape {hits[names[0]].shape}, {name} of {each.shape}; "
                "planners are paired on the same runs"
            )
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    tables = [
        (
            int((hits[a] & hits[b]).sum()),
            int((hits[a] & ~hits[b]).sum()),
            int((~hits[a] & hits[b]).sum()),
            int((~hits[a] & ~hits[b]).sum()),
        )
        for a, b in pairs
    ]
    p_values = [mcnemar(only_a, only_b) for _, only_a, only_b, _ in tables]
    corrected = holm(p_values)
    return [
        Paired(a, b, *table, p_value, p_corrected)
        for (a, b), table, p_value, p_corrected in zip(pairs, tables, p_values, corrected, strict=True)
    ]


def quantiles(values: Array) -> dict[str, float | int | None]:
    """Median, 5th and 95th percentile, mean and number of the defined values; NaN counts in none of them."""
    defined = values[np.isfinite(values)]
    if len(defined) == 0:
        return {"median": None, "p05": None, "p95": None, "mean": None, "n": 0}
    p05, median, p95 = (float(q) for q in np.quantile(defined, (0.05, 0.5, 0.95)))
    mean = math.fsum(defined.tolist()) / len(defined)
    return {"median": median, "p05": p05, "p95": p95, "mean": mean, "n": len(defined)}
