"""Costs at growing sizes, and the power of the size that they follow."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats


@dataclass(frozen=True)
class Point:
    """The cost at one size."""

    study: str
    """Label of :data:`~.scaling.STUDIES`."""
    size: int
    """What grows."""
    uavs: int
    """In a call."""
    calls: int
    """Timed."""
    cost_us: float
    """Thread-CPU time of a call, median; of the study of missions processor time of them all."""
    mean_us: float
    """Mean: guidance plans in one step of four, which the median does not see."""
    p99_us: float
    """99th percentile; NaN of a single call."""


@dataclass(frozen=True)
class Study:
    """Something that grows, and how its cost is measured."""

    grows: str
    """What."""
    unit: str
    """What a cost is shared among: "UAV" for those of a call, or one of what grows."""
    sizes: tuple[int, ...]
    """Ascending."""
    costs: str
    """What is measured."""
    measure: Callable[[int, int], Point]
    """Of a size and a campaign seed."""

    def share_us(self, point: Point) -> float:
        """Cost a unit."""
        return point.cost_us / (point.uavs if self.unit == "UAV" else point.size)


@dataclass(frozen=True)
class Growth:
    """Cost proportional to a power of the size."""

    exponent: float
    """Slope of the logarithms, least squares over all sizes; NaN of fewer than three."""
    half_width: float
    """Half of its 95 % interval, Student's t."""
    level_us: float
    """Cost of the size 1 by the fit; NaN of fewer than three."""
    last: float
    """Slope from the last size but one to the last; NaN of one."""


def growth(points: Sequence[Point]) -> Growth:
    """Fit of a study's points."""
    size = np.log([point.size for point in points])
    cost = np.log([point.cost_us for point in points])
    last = float((cost[-1] - cost[-2]) / (size[-1] - size[-2])) if len(points) > 1 else math.nan
    if len(points) < 3:
        return Growth(math.nan, math.nan, math.nan, last)
    fit = stats.linregress(size, cost)
    half = float(stats.t.ppf(0.975, len(points) - 2) * fit.stderr)
    return Growth(float(fit.slope), half, math.exp(fit.intercept), last)
