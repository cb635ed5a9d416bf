"""Bounds and prices of the two shells of :mod:`.clearance`, compiled: one pass over all points and rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare

Array = NDArray[np.float64]

NEWTON_STEPS = 6
"""Steps to the last digit from where :func:`.clearance.distance_of_force` starts."""


@compiled_bare
def _asked(extra_m: float, extra_sigmas: float, sigma: float) -> float:
    """Distance on top of a margin, see :func:`.clearance.extra_distance`; endless sigmas stand for none."""
    return extra_m if extra_sigmas == np.inf else min(extra_m, extra_sigmas * sigma)


@compiled_bare
def _level(normal: Array, p: int, j: int, position: Array, at: int) -> float:
    """Place of a position (point, 3) along a normal (point, m, 3)."""
    total = 0.0
    for axis in range(3):
        total += normal[p, j, axis] * position[at, axis]
    return total


@compiled_bare
def _shortfall_of(
    normal: Array, shifted: Array, sigma: Array, planned: Array, position: Array, extra_m: float,
    extra_sigmas: float, first: int, stop: int,
) -> float:  # fmt: skip
    """Most that the points first ... stop - 1 of a plan are inside a margin; NaN if one is not a number."""
    most, lost = 0.0, 0
    for p in range(first, stop):
        for j in range(shifted.shape[1]):
            moved = _level(normal, p, j, position, p) - _level(normal, p, j, planned, p)
            short = _asked(extra_m, extra_sigmas, sigma[p, j]) - (shifted[p, j] + moved)
            lost += short != short
            most = max(most, short)
    return most if lost == 0 else np.nan


@compiled
def shortfalls(
    normal: Array, shifted: Array, sigma: Array, planned: Array, position: Array, extra_m: float,
    extra_sigmas: float, most: Array,
) -> None:  # fmt: skip
    """Write by how much plans are inside a margin at most, with the rows that were made at others.

    Parameters
    ----------
    normal, shifted, sigma : array, shapes (run, uav, N, M, 3) and (run, uav, N, M)
        As in :class:`.clearance.Gaps`.
    planned, position : array, shape (run, uav, N, 3)
        Where the rows were made, and where the plans are [m].
    extra_m, extra_sigmas : float
        See :func:`_asked`.
    most : array, shape (run, uav)
        [m].
    """
    runs, uavs, stages, m = shifted.shape
    points = runs * uavs * stages
    n, r, s = normal.reshape(points, m, 3), shifted.reshape(points, m), sigma.reshape(points, m)
    here, there = planned.reshape(points, 3), position.reshape(points, 3)
    for run in range(runs):
        for uav in range(uavs):
            first = (run * uavs + uav) * stages
            most[run, uav] = _shortfall_of(n, r, s, here, there, extra_m, extra_sigmas, first, first + stages)


@compiled
def contact_rows(
    normal: Array, shifted: Array, sigma: Array, position: Array, extra_m: float, extra_sigmas: float,
    opening_mps: float, times_s: Array, lower: Array,
) -> None:  # fmt: skip
    """Write the bounds of :class:`.clearance.ObstacleContact`.

    Where a shifted distance is short now, seen along a row's own normal from the plan's first node, the row
    asks for it to open at a speed.

    Parameters
    ----------
    normal, shifted, sigma : array, shapes (run, uav, N, M, 3) and (run, uav, N, M)
        As in :class:`.clearance.Gaps`.
    position : array, shape (run, uav, N, 3)
        Last plans [m].
    extra_m, extra_sigmas : float
        See :func:`_asked`.
    opening_mps : float
        Speed; endless asks at once [m/s].
    times_s : array, shape (N,)
        Ends of the stages [s].
    lower : array, shape (run, uav, N, M)
        [m].
    """
    runs, uavs, stages, m = shifted.shape
    points = runs * uavs * stages
    n, place = normal.reshape(points, m, 3), position.reshape(points, 3)
    for run in range(runs):
        for uav in range(uavs):
            first = (run * uavs + uav) * stages
            for k in range(stages):
                for j in range(m):
                    rho = shifted[run, uav, k, j]
                    asked = _asked(extra_m, extra_sigmas, sigma[run, uav, k, j])
                    level = _level(n, first + k, j, place, first + k)
                    if opening_mps < np.inf:
                        here = rho + (_level(n, first + k, j, place, first) - level)
                        asked = min(asked, min(asked, here) + opening_mps * times_s[k])
                    lower[run, uav, k, j] = level + (asked - rho)


@compiled
def firm_prices(
    shifted: Array, margin: Array, shift: bool, w1: float, narrow_w1: float, narrow_m: float, price: Array
) -> None:
    """Write linear prices of contact slacks: by the least margin that a stage keeps.

    Parameters
    ----------
    shifted, margin : array, shape (run, uav, N, M)
        As in :class:`.clearance.Gaps`.
    shift : bool
        Whether margins are kept; one that widens the range only is none.
    w1, narrow_w1, narrow_m : float
        See :class:`.clearance.ObstacleContact`.
    price : array, shape (run, uav, N, 1)
        [1/(m s)].
    """
    for run in range(shifted.shape[0]):
        for uav in range(shifted.shape[1]):
            for k in range(shifted.shape[2]):
                least = np.inf
                for j in range(shifted.shape[3]):
                    if shifted[run, uav, k, j] < np.inf:
                        least = min(least, margin[run, uav, k, j] if shift else 0.0)
                price[run, uav, k, 0] = w1
                if least < narrow_m:
                    # The cube, for what is cut of a corner counts soon as margins shrink.
                    firm = w1 * (narrow_m / least) ** 3 if least > 0.0 else narrow_w1
                    price[run, uav, k, 0] = min(max(firm, w1), narrow_w1)


@compiled_bare
def held_distances(
    shifted: Array, influence: Array, least_m: float, ratio: float, root: float, held: Array
) -> None:
    """Write the distances at which the potential's model is made: not below the floor, nor beyond rho_0.

    Parameters
    ----------
    shifted, influence : array, shape (run, uav, N, M)
        rho_bar and rho_0 [m].
    least_m : float
        Least distance [m].
    ratio, root : float
        Largest force over gain, see :func:`.clearance.distance_of_force`, and its third root; endless if
        there is none.
    held : array, shape (run, uav, N, M)
        [m].
    """
    last, floor = np.nan, least_m
    for run in range(held.shape[0]):
        for uav in range(held.shape[1]):
            for k in range(held.shape[2]):
                for j in range(held.shape[3]):
                    rho_0 = influence[run, uav, k, j]
                    if rho_0 != last and ratio < np.inf:
                        floor, last = max(least_m, _distance_of_force(ratio, root, rho_0)), rho_0
                    held[run, uav, k, j] = min(max(shifted[run, uav, k, j], floor), rho_0)


@compiled_bare
def _distance_of_force(ratio: float, root: float, rho_0: float) -> float:
    """One number of :func:`.clearance.distance_of_force`; ``root`` is the third root of the ratio."""
    slope = 1.0 / rho_0
    x = slope + root
    for _ in range(NEWTON_STEPS):
        x -= (x * x * (x - slope) - ratio) / (x * (3.0 * x - 2.0 * slope))
    return 1.0 / x


@compiled_bare
def influence_rows(
    normal: Array, shifted: Array, influence: Array, position: Array, gain: float, per_speed: float,
    held: Array, fourth: Array, lower: Array, w2: Array,
) -> None:  # fmt: skip
    """Write bounds and prices of the influence shell: :func:`.clearance.influence_model` as rows.

    Parameters
    ----------
    normal, shifted, influence : array, shapes (run, uav, N, M, 3) and (run, uav, N, M)
        As in :class:`.clearance.Gaps`.
    position : array, shape (run, uav, N, 3)
        Last plans [m].
    gain, per_speed : float
        k_r, and the unit factor c.
    held, fourth : array, shape (run, uav, N, M)
        See :func:`held_distances` [m], and its fourth power [m^4].
    lower, w2 : array, shape (run, uav, N, M)
        [m], [1/(m^2 s)].
    """
    for run in range(held.shape[0]):
        for uav in range(held.shape[1]):
            for k in range(held.shape[2]):
                for j in range(held.shape[3]):
                    rho, rho_0, h = shifted[run, uav, k, j], influence[run, uav, k, j], held[run, uav, k, j]
                    bend = 3.0 - 2.0 * h / rho_0
                    price = per_speed * (gain * bend / fourth[run, uav, k, j])
                    target = rho + h * (1.0 - h / rho_0) / bend if rho < rho_0 else rho_0
                    total = 0.0
                    for axis in range(3):
                        total += normal[run, uav, k, j, axis] * position[run, uav, k, axis]
                    free = price <= 0.0
                    lower[run, uav, k, j] = -np.inf if free else total + (target - rho)
                    # A slack without a price would be undetermined; this one's row is switched off.
                    w2[run, uav, k, j] = 1.0 if free else price
