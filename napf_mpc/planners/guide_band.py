"""Offset profiles as elastic bands: from the lattice's steps to a smooth profile that just clears the margin.

Each pass solves, UAV by UAV, the quadratic model of path, shape, effort and linearised shortfalls: a band
matrix over the stations, so a pass costs a few microseconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.planners.guide_clearance import Frame, SolidBoxes, shortfall
from napf_mpc.planners.guide_lattice import Prices, bent, missing_price, steep
from napf_mpc.world.distance import Solids

Array = NDArray[np.float64]

WIDTH = 6
"""Diagonal and five bands below it: three stations of two offsets."""
LEAST_ACROSS = 0.3
"""Part of a unit gradient that must lie across the path for a push along it."""


@compiled
def solve_band(matrix: Array, right: Array, n: int) -> None:
    """Solve a positive definite band system in place: ``matrix[j, d]`` holds row j, column j - d."""
    for j in range(n):
        first = max(0, j - WIDTH + 1)
        for c in range(first, j):
            total = matrix[j, j - c]
            for m in range(max(first, c - WIDTH + 1), c):
                total -= matrix[j, j - m] * matrix[c, c - m] * matrix[m, 0]
            matrix[j, j - c] = total / matrix[c, 0]
        for c in range(first, j):
            matrix[j, 0] -= matrix[j, j - c] * matrix[j, j - c] * matrix[c, 0]
        for c in range(first, j):
            right[j] -= matrix[j, j - c] * right[c]
    for j in range(n):
        right[j] /= matrix[j, 0]
    for j in range(n - 1, -1, -1):
        for c in range(j + 1, min(n, j + WIDTH)):
            right[j] -= matrix[c, c - j] * right[c]


@compiled
def smooth_terms(
    profile: Array, mean: Array, last: Array, step_m: float, prices: Prices, matrix: Array, right: Array
) -> None:
    """Band system of path, shape, slope, change of slope and hysteresis, written anew."""
    stations = profile.shape[0]
    matrix[:] = 0.0
    bend = prices.bend / step_m**3
    for s in range(stations):
        size = np.sqrt(profile[s, 0] ** 2 + profile[s, 1] ** 2)
        slope = prices.slope / step_m
        if s > 0:
            rise = np.sqrt(
                (profile[s, 0] - profile[s - 1, 0]) ** 2 + (profile[s, 1] - profile[s - 1, 1]) ** 2
            )
            slope *= steep(rise / step_m, prices.steep)
        path = prices.path * min(1.0, prices.far_m / max(size, 1e-9))
        for a in range(2):
            j = 2 * s + a
            matrix[j, 0] += step_m * (path + prices.shape + prices.keep)
            right[j] = step_m * (prices.shape * mean[s, a] + prices.keep * last[s, a])
            if s > 0:
                matrix[j, 0] += slope
                matrix[j - 2, 0] += slope
                matrix[j, 2] -= slope
            if s > 1:
                matrix[j, 0] += bend
                matrix[j - 2, 0] += 4.0 * bend
                matrix[j - 4, 0] += bend
                matrix[j, 2] -= 2.0 * bend
                matrix[j - 2, 2] -= 2.0 * bend
                matrix[j, 4] += bend


@compiled
def add_row(matrix: Array, right: Array, s: int, weight: float, g0: float, g1: float, wanted: float) -> None:
    """Add weight (wanted - g x_s)^2 of station s to a band system."""
    j = 2 * s
    matrix[j, 0] += weight * g0 * g0
    matrix[j + 1, 0] += weight * g1 * g1
    matrix[j + 1, 1] += weight * g0 * g1
    right[j] += weight * g0 * wanted
    right[j + 1] += weight * g1 * wanted


@compiled
def add_solids(
    solids: Solids,
    boxes: SolidBoxes,
    found: NDArray[np.int64],
    count: int,
    frame: Frame,
    along: float,
    lane: Array,
    covariance: Array,
    k: float,
    need_m: float,
    reach: float,
    step_m: float,
    weight: float,
    draft: Array,
    profile: Array,
    matrix: Array,
    right: Array,
) -> None:
    """Add the linearised shortfalls of a profile to its band system.

    Where the distance grows along the path only, as before a wall, its gradient does not tell which way to
    give: there the profile is drawn to its draft.
    """
    stations = profile.shape[0]
    for entry in range(count):
        i = found[entry]
        s0 = max(0, int(np.ceil((boxes.low[i, 0] - reach - along) / step_m)))
        s1 = min(stations - 1, int(np.floor((boxes.high[i, 0] + reach - along) / step_m)))
        for s in range(s0, s1 + 1):
            left = lane[0] + profile[s, 0]
            if left < boxes.low[i, 1] - reach or left > boxes.high[i, 1] + reach:
                continue
            up = lane[1] + profile[s, 1]
            if up < boxes.low[i, 2] - reach or up > boxes.high[i, 2] + reach:
                continue
            short, g0, g1 = shortfall(solids, i, frame, along + s * step_m, left, up, covariance, k, need_m)
            if short > 0.0 and g0 * g0 + g1 * g1 < LEAST_ACROSS**2:
                add_row(matrix, right, s, weight * step_m, 1.0, 0.0, draft[s, 0])
                add_row(matrix, right, s, weight * step_m, 0.0, 1.0, draft[s, 1])
            elif short > 0.0:
                wanted = short + g0 * profile[s, 0] + g1 * profile[s, 1]
                add_row(matrix, right, s, weight * step_m, g0, g1, wanted)


@compiled
def add_neighbour(
    along: float,
    lane: Array,
    separation: float,
    other: Array,
    step_m: float,
    weight: float,
    profile: Array,
    matrix: Array,
    right: Array,
) -> None:
    """Add the linearised lack of separation from another UAV's profile.

    ``along`` and ``lane`` (2,) are this UAV's place relative to the other's; each yields half.
    """
    for s in range(profile.shape[0]):
        d0 = lane[0] + profile[s, 0] - other[s, 0]
        d1 = lane[1] + profile[s, 1] - other[s, 1]
        distance = np.sqrt(along * along + d0 * d0 + d1 * d1)
        if distance >= separation:
            continue
        across = max(np.sqrt(d0 * d0 + d1 * d1), 1e-9)
        g0 = d0 / across
        g1 = d1 / across
        if d0 == 0.0 and d1 == 0.0:
            g0 = 1.0
        target = np.sqrt(max(separation * separation - along * along, 0.0)) - across
        wanted = 0.5 * target + g0 * profile[s, 0] + g1 * profile[s, 1]
        add_row(matrix, right, s, weight * step_m, g0, g1, wanted)


@compiled
def exact_missing(
    solids: Solids,
    boxes: SolidBoxes,
    found: NDArray[np.int64],
    count: int,
    frame: Frame,
    along: float,
    lane: Array,
    covariance: Array,
    k: float,
    need_m: float,
    reach: float,
    step_m: float,
    profile: Array,
    missing: Array,
) -> None:
    """Largest shortfall (station,) along a profile, 0 where nothing is short, in place."""
    missing[:] = 0.0
    stations = profile.shape[0]
    for entry in range(count):
        i = found[entry]
        s0 = max(0, int(np.ceil((boxes.low[i, 0] - reach - along) / step_m)))
        s1 = min(stations - 1, int(np.floor((boxes.high[i, 0] + reach - along) / step_m)))
        for s in range(s0, s1 + 1):
            short = shortfall(
                solids,
                i,
                frame,
                along + s * step_m,
                lane[0] + profile[s, 0],
                lane[1] + profile[s, 1],
                covariance,
                k,
                need_m,
            )[0]
            missing[s] = max(missing[s], short)


@compiled
def band_price(
    profiles: Array, mean: Array, last: Array, missing: Array, step_m: float, prices: Prices
) -> float:
    """Price of the profiles (uav, station, 2) of all UAVs with their shortfalls (uav, station)."""
    total = 0.0
    for i in range(profiles.shape[0]):
        for s in range(profiles.shape[1]):
            square = off = rise = kept = 0.0
            for a in range(2):
                square += profiles[i, s, a] ** 2
                off += (profiles[i, s, a] - mean[s, a]) ** 2
                kept += (profiles[i, s, a] - last[i, s, a]) ** 2
                if s > 0:
                    rise += (profiles[i, s, a] - profiles[i, s - 1, a]) ** 2
            total += step_m * (prices.path * bent(square, prices.far_m) + prices.shape * off)
            total += step_m * prices.keep * min(kept, prices.keep_m * prices.keep_m)
            total += prices.slope * steep(np.sqrt(rise) / step_m, prices.steep) * rise / step_m
            total += step_m * missing_price(missing[i, s], prices)
    return total
