r"""Margins beside spheres, looked up: as likely a hit while a UAV passes as behind a wall.

At one moment an error reaches a small ball less often than what lies behind a wall at the same distance
(:func:`~napf_mpc.constraints.probability.reach_probability`), but a correlated error comes by it more often,
and stays for less long: see :func:`~napf_mpc.constraints.probability.mission_share`. The margin here makes
both good. With sigma along the normal and the generalised variance g across it, the margin over sigma
depends on R / sigma and g / sigma^2 alone, for a given k: a table. All else is taken for a wall: an error has
one way only past a mast, and a tenth less of margin would be all there is to gain.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.probability import BALL, mission_share, reach_margin, sigma_along
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.distance import SPHERE, A, Solids

Array = NDArray[np.float64]
Index = NDArray[np.int64]

RADII = (0.02, 1e4, 64)
"""Least and largest R / sigma of the table, and how many; those beyond count as these."""
ACROSS = (1e-3, 1e3, 33)
"""The same of g / sigma^2."""
FOR_EVER = 1e12
"""Correlation times at the margin, where nobody says how many: what comes by counts, not where it starts."""


class PassageMargins(NamedTuple):
    """Margins of one k, over sigma."""

    k: float
    """Sigmas behind a wall."""
    sigmas: Array
    """(R / sigma, g / sigma^2) at logarithmic distances."""


@lru_cache(maxsize=64)
def half_space_margins(k: float) -> PassageMargins:
    """Margins that take everything for a wall."""
    return PassageMargins(float(k), np.full((RADII[2], ACROSS[2]), float(k)))


def passage_margins(inflation: Inflation) -> PassageMargins:
    """Margins of an inflation's k: of a passage, or, if it has a budget, of the mission it speaks of."""
    budget = inflation.budget
    if budget is None:
        return _margins(inflation.k, 0.0, FOR_EVER, 1.0, 1.0)
    return _margins(
        inflation.k, budget.risk_per_uav, budget.active_s, budget.correlation_time_s, budget.period_s
    )


@lru_cache(maxsize=64)
def _margins(
    k: float, risk: float, active_s: float, correlation_time_s: float, period_s: float
) -> PassageMargins:
    sigmas = np.empty((RADII[2], ACROSS[2]))
    radii, across = np.geomspace(*RADII), np.geomspace(*ACROSS)
    _fill(radii, across, k, risk, active_s, correlation_time_s, period_s, sigmas)
    return PassageMargins(float(k), sigmas)


@compiled
def _fill(
    radii: Array, across: Array, k: float, risk: float, active_s: float, correlation_time_s: float,
    period_s: float, out: Array,
) -> None:  # fmt: skip
    for i in range(len(radii)):
        for j in range(len(across)):
            largest = max(1.0, across[j])
            share = mission_share(BALL, radii[i], largest, k, risk, active_s, correlation_time_s, period_s)
            out[i, j] = reach_margin(BALL, radii[i], 1.0, across[j], k, share)


@compiled_bare
def _place(value: float, low: float, high: float, count: int) -> tuple[int, float]:
    """Interval of a logarithmic axis in which a value > 0 lies, and how far in it."""
    at = np.log(min(max(value, low), high) / low) / np.log(high / low) * (count - 1)
    index = min(int(at), count - 2)
    return index, at - index


@compiled_bare
def sigmas_beside(margins: PassageMargins, radius: float, sigma: float, g: float) -> float:
    """Sigmas to keep from a ball.

    Parameters
    ----------
    margins : PassageMargins
        Table.
    radius : float
        Of the ball, the UAV's included [m].
    sigma : float
        Standard deviation along the normal [m].
    g : float
        Generalised variance across it [m^2].
    """
    if not sigma > 0.0 or not radius > 0.0:
        return margins.k
    i, a = _place(radius / sigma, RADII[0], RADII[1], RADII[2])
    j, b = _place(g / (sigma * sigma), ACROSS[0], ACROSS[1], ACROSS[2])
    table = margins.sigmas
    # In this form a table of one number gives that number, to the last bit.
    near = table[i, j] + b * (table[i, j + 1] - table[i, j])
    far = table[i + 1, j] + b * (table[i + 1, j + 1] - table[i + 1, j])
    return float(near + a * (far - near))


@compiled_bare
def volume(covariance: Array) -> float:
    """Root of a covariance's determinant [m^3]."""
    c = covariance
    plane = c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0]
    space = (
        c[2, 2] * plane
        - c[1, 2] * (c[0, 0] * c[2, 1] - c[0, 1] * c[2, 0])
        + c[0, 2] * (c[1, 0] * c[2, 1] - c[1, 1] * c[2, 0])
    )
    return float(np.sqrt(max(space, 0.0)))


@compiled
def margins_beside(
    margins: PassageMargins, solids: Solids, first: Index, runs: int, index: Index, normal: Array,
    covariance: Array, radius_m: float, out: Array,
) -> None:  # fmt: skip
    """Write margins (point, m) beside the obstacles of points, run after run.

    Parameters
    ----------
    margins : PassageMargins
        Table.
    solids : Solids
        The map.
    first : array of int, shape (scene,)
        First solid of each scene: one for all runs, or one a run.
    runs : int
        Number of runs.
    index : array of int, shape (point, m)
        Obstacles in their scene, -1 for none.
    normal : array, shape (point, m, 3)
        Unit vectors from obstacle to UAV; zero for none.
    covariance : array, shape (point, 3, 3)
        [m^2].
    radius_m : float
        Of a UAV [m].
    out : array, shape (point, m)
        [m].
    """
    points, few = index.shape
    for p in range(points):
        start = first[0] if len(first) == 1 else first[p * runs // points]
        for j in range(few):
            x, y, z = normal[p, j, 0], normal[p, j, 1], normal[p, j, 2]
            if index[p, j] < 0 or (x == 0.0 and y == 0.0 and z == 0.0):
                out[p, j] = 0.0
                continue
            sigma = sigma_along(covariance[p], x, y, z)
            solid, sigmas = start + index[p, j], margins.k
            if solids.kind[solid] == SPHERE and sigma > 0.0:
                reach = solids.parameters[solid, A] + radius_m
                sigmas = sigmas_beside(margins, reach, sigma, volume(covariance[p]) / sigma)
            out[p, j] = sigma * sigmas
