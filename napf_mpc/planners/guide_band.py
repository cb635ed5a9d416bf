"""Offset profiles as elastic bands: from the lattice's steps to a smooth profile that just clears the margin.

Each pass solves, UAV by UAV, the quadratic model of path, shape, effort and linearised shortfalls: a band
matrix over the stations, so a pass costs a few microseconds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.planners.guide_clearance import (
    ALONG,
    HIGH,
    LARGE_M,
    LEFT,
    LOW,
    OUTER2,
    RADIUS,
    ROUND,
    SIGMAS,
    TOUCHED,
    TOUCHING_M,
    UP,
    Sight,
    half_step_of,
    is_round,
    nearest_along,
    round_shortfall,
    shortfall,
)
from napf_mpc.planners.guide_prices import Prices, bent, missing_price, steep, steep_limit

Array = NDArray[np.float64]

LEAST_ACROSS = 0.3
"""Part of a unit gradient that must lie across the path for a push along it."""
EDGE_PUSH = 10.0
"""How much firmer edges push than what is round: a way round a corner is steep on both sides of it, and what
steepness costs far out would outbid the margin."""


class Band(NamedTuple):
    """Positive definite system over stations of two offsets, each coupled with the two before."""

    own: Array  # (station, 3) of a station's block: left, up, between them
    one: Array  # (station,) to the station before, the same for left and up
    two: Array  # (station,) to the one before that
    right: Array  # (station, 2) right-hand side; the solution when solved
    inverse: Array  # (station, 3) scratch: inverses of the factor's diagonal blocks
    lower: Array  # (station, 4) scratch: the factor's blocks below them, row by row


@compiled_bare
def solve_band(band: Band) -> None:
    """Solve a band system in place, by the block LDL^T factors."""
    own, one, two, right, inverse, lower = band
    stations = len(one)
    # Blocks of station s - 2 and s - 1: inverse diagonal p and q, the factor's block between them l.
    p0 = p1 = px = q0 = q1 = qx = 0.0
    l00 = l01 = l10 = l11 = 0.0
    y0 = y1 = z0 = z1 = 0.0
    for s in range(stations):
        f = two[s]
        # Row s of L D: f I two back, and this one back.
        w00 = one[s] - f * l00
        w01 = -f * l10
        w10 = -f * l01
        w11 = one[s] - f * l11
        l00 = w00 * q0 + w01 * qx
        l01 = w00 * qx + w01 * q1
        l10 = w10 * q0 + w11 * qx
        l11 = w10 * qx + w11 * q1
        d0 = own[s, 0] - f * f * p0 - (w00 * l00 + w01 * l01)
        d1 = own[s, 1] - f * f * p1 - (w10 * l10 + w11 * l11)
        dx = own[s, 2] - f * f * px - (w00 * l10 + w01 * l11)
        r0 = right[s, 0] - f * (p0 * y0 + px * y1) - (l00 * z0 + l01 * z1)
        r1 = right[s, 1] - f * (px * y0 + p1 * y1) - (l10 * z0 + l11 * z1)
        p0 = q0
        p1 = q1
        px = qx
        scale = 1.0 / (d0 * d1 - dx * dx)
        q0 = d1 * scale
        q1 = d0 * scale
        qx = -dx * scale
        y0 = z0
        y1 = z1
        z0 = r0
        z1 = r1
        right[s, 0] = r0
        right[s, 1] = r1
        inverse[s, 0] = q0
        inverse[s, 1] = q1
        inverse[s, 2] = qx
        lower[s, 0] = l00
        lower[s, 1] = l01
        lower[s, 2] = l10
        lower[s, 3] = l11
    # L^T x = D^-1 y, from the end: u one station on, v two.
    u0 = u1 = v0 = v1 = 0.0
    for s in range(stations - 1, -1, -1):
        t0 = right[s, 0]
        t1 = right[s, 1]
        if s + 2 < stations:
            t0 -= two[s + 2] * v0
            t1 -= two[s + 2] * v1
        x0 = inverse[s, 0] * t0 + inverse[s, 2] * t1
        x1 = inverse[s, 2] * t0 + inverse[s, 1] * t1
        if s + 1 < stations:
            x0 -= lower[s + 1, 0] * u0 + lower[s + 1, 2] * u1
            x1 -= lower[s + 1, 1] * u0 + lower[s + 1, 3] * u1
        right[s, 0] = x0
        right[s, 1] = x1
        v0 = u0
        v1 = u1
        u0 = x0
        u1 = x1


@compiled_bare
def smooth_terms(profile: Array, mean: Array, last: Array, step_m: float, prices: Prices, band: Band) -> None:
    """Band system of path, shape, slope, change of slope and hysteresis, written anew."""
    own, one, two, right, _, _ = band
    stations = profile.shape[0]
    bend = prices.bend / step_m**3
    flat = prices.slope / step_m
    gentle = (min(prices.steep, prices.steep_far) * step_m) ** 2
    near = prices.far_m**2
    drawn = step_m * (prices.shape + prices.keep)
    for s in range(stations):
        size = profile[s, 0] ** 2 + profile[s, 1] ** 2
        path = step_m * prices.path
        if size > near:
            path *= prices.far_m / math.sqrt(size)
        own[s, 0] = path + drawn
        two[s] = 0.0
        one[s] = 0.0
        for a in range(2):
            right[s, a] = step_m * (prices.shape * mean[s, a] + prices.keep * last[s, a])
        if s > 0:
            rise = (profile[s, 0] - profile[s - 1, 0]) ** 2 + (profile[s, 1] - profile[s - 1, 1]) ** 2
            slope = flat
            if rise > gentle:
                slope *= steep(math.sqrt(rise) / step_m, steep_limit(profile[s, 0], prices))
            own[s, 0] += slope
            own[s - 1, 0] += slope
            one[s] -= slope
        if s > 1:
            own[s, 0] += bend
            own[s - 1, 0] += 4.0 * bend
            own[s - 2, 0] += bend
            one[s] -= 2.0 * bend
            one[s - 1] -= 2.0 * bend
            two[s] = bend
    for s in range(stations):
        own[s, 1] = own[s, 0]
        own[s, 2] = 0.0


@compiled_bare
def add_row(own: Array, right: Array, s: int, weight: float, g0: float, g1: float, wanted: float) -> None:
    """Add weight (wanted - g x_s)^2 of station s to a band system."""
    own[s, 0] += weight * g0 * g0
    own[s, 1] += weight * g1 * g1
    own[s, 2] += weight * g0 * g1
    right[s, 0] += weight * g0 * wanted
    right[s, 1] += weight * g1 * wanted


@compiled_bare
def way_across(short: float, distance: float, across: float) -> float:
    """How far to go across the path to make up for a shortfall beside an edge [m].

    The nearest point of a corner stays where it is: what is missing is made up for across the path alone, and
    that is more than the shortfall, where the corner is mostly ahead or behind.

    Parameters
    ----------
    short, distance : float
        Shortfall and distance [m].
    across : float
        Part of the unit gradient across the path, > 0.
    """
    if distance <= 0.0:
        return short / across
    along = (1.0 - across * across) * distance * distance
    return math.sqrt((short + distance) ** 2 - along) - across * distance


@compiled_bare
def touches(sight: Sight, i: int, step_m: float, along: float, left: float, up: float) -> bool:
    """Whether a UAV would touch something at a place, or within half a step of it where that is thin."""
    near = sight.near
    for entry in range(sight.solid_count[i]):
        half_step = half_step_of(near[i, entry], np.inf, step_m)
        if along < near[i, entry, LOW] - half_step or along > near[i, entry, HIGH] + half_step:
            continue
        if left < near[i, entry, LOW + 1] or left > near[i, entry, HIGH + 1]:
            continue
        if up < near[i, entry, LOW + 2] or up > near[i, entry, HIGH + 2]:
            continue
        at = along
        if half_step > 0.0:
            at = nearest_along(near[i, entry], sight.reach[i], along, half_step, step_m)
        distance = shortfall(
            sight.solids, sight.found[i, entry], sight.frame, at, left, up, sight.covariance[i], 0.0, 0.0
        )[3]
        if distance < sight.radius_m:
            return True
    return False


@compiled_bare
def mend(sight: Sight, i: int, coarse: Array, every: int, step_m: float, fine: Array) -> None:
    """Lead a draft round the corners that it cuts between two stations of the lattice, in place.

    The search asks at its stations alone. Where a place in between would touch, and one of the two that it
    lies between would not if it were kept up to there, that is taken.

    Parameters
    ----------
    sight, i : Sight, int
        What UAV i sees.
    coarse, fine : array, shapes (station, 2) and (fine station, 2)
        The search's profile and the draft [m].
    every : int
        Stations of the draft for one of the search.
    step_m : float
        From one of the draft's to the next [m].
    """
    lane, height = sight.lanes[i, 0], sight.lanes[i, 1]
    for s in range(fine.shape[0]):
        if s % every == 0:
            continue
        along = sight.along[i] + s * step_m
        if not touches(sight, i, step_m, along, lane + fine[s, 0], height + fine[s, 1]):
            continue
        # The nearer one first.
        before, after = s // every, min(s // every + 1, coarse.shape[0] - 1)
        first, second = (before, after) if 2 * (s % every) < every else (after, before)
        for n in (first, second):
            if not touches(sight, i, step_m, along, lane + coarse[n, 0], height + coarse[n, 1]):
                fine[s, 0], fine[s, 1] = coarse[n, 0], coarse[n, 1]
                break


@compiled_bare
def take_solids(
    sight: Sight,
    i: int,
    step_m: float,
    weight: float,
    level: bool,
    draft: Array,
    profile: Array,
    band: Band,
    missing: Array,
) -> None:
    """Largest shortfall (station,) along a profile, 0 where nothing is short, in place.

    With a positive weight, linearised shortfalls are added to the profile's band system too. Where the
    distance grows along the path only, as before a wall, its gradient does not tell which way to give: there
    the profile is drawn to its draft. Where drafts are level, a large sphere pushes nobody up or down: along
    its surface it would push a way past its side under itself, where no way has been looked for.
    """
    missing[:] = 0.0
    own, right = band.own, band.right
    near, found = sight.near, sight.found
    solids, frame, turned, covariance = sight.solids, sight.frame, sight.turned[i], sight.covariance[i]
    k, need = sight.margins.k, sight.need_m
    lane, height, start = sight.lanes[i, 0], sight.lanes[i, 1], sight.along[i]
    stations = profile.shape[0]
    lowest = highest = profile[0, 0]
    for s in range(1, stations):
        lowest = min(lowest, profile[s, 0])
        highest = max(highest, profile[s, 0])
    lowest += lane
    highest += lane
    for entry in range(sight.solid_count[i]):
        if lowest > near[i, entry, HIGH + 1] or highest < near[i, entry, LOW + 1]:
            continue
        half_step = half_step_of(near[i, entry], np.inf, step_m)
        s0 = max(0, int(np.ceil((near[i, entry, LOW] - half_step - start) / step_m)))
        s1 = min(stations - 1, int(np.floor((near[i, entry, HIGH] + half_step - start) / step_m)))
        ball = near[i, entry, ROUND]
        for s in range(s0, s1 + 1):
            along = start + s * step_m
            if half_step > 0.0:
                along = nearest_along(near[i, entry], sight.reach[i], along, half_step, step_m)
            left = lane + profile[s, 0]
            up = height + profile[s, 1]
            if left < near[i, entry, LOW + 1] or left > near[i, entry, HIGH + 1]:
                continue
            if up < near[i, entry, LOW + 2] or up > near[i, entry, HIGH + 2]:
                continue
            x = along - near[i, entry, ALONG]
            y = left - near[i, entry, LEFT]
            z = ball * (up - near[i, entry, UP])
            if ball >= 0.0 and x * x + y * y + z * z > near[i, entry, OUTER2]:
                continue
            even = is_round(near, i, entry, up)
            distance = 0.0
            if even:
                short, g0, g1 = round_shortfall(
                    x,
                    y,
                    z,
                    near[i, entry, RADIUS],
                    near[i, entry, TOUCHED],
                    turned,
                    near[i, entry, SIGMAS],
                    need,
                )
            else:
                short, g0, g1, distance = shortfall(
                    solids, found[i, entry], frame, along, left, up, covariance, k, need
                )
            missing[s] = max(missing[s], short)
            if not even and short > 0.0 and distance < sight.radius_m:
                # Round solids are cut by decimetres in smoothing; plans give way there all the same.
                missing[s] = max(missing[s], TOUCHING_M)
            if weight <= 0.0 or short <= 0.0:
                continue
            if level and near[i, entry, ROUND] > 0.0 and near[i, entry, RADIUS] >= LARGE_M:
                g1 = 0.0
            across = math.sqrt(g0 * g0 + g1 * g1)
            if across < LEAST_ACROSS:
                add_row(own, right, s, weight * step_m, 1.0, 0.0, draft[s, 0])
                add_row(own, right, s, weight * step_m, 0.0, 1.0, draft[s, 1])
                continue
            firm = weight
            if not even:
                g0, g1, short = g0 / across, g1 / across, way_across(short, distance, across)
                firm = EDGE_PUSH * weight
            wanted = short + g0 * profile[s, 0] + g1 * profile[s, 1]
            add_row(own, right, s, firm * step_m, g0, g1, wanted)


@compiled_bare
def add_neighbour(
    along: float,
    lane: Array,
    separation: float,
    other: Array,
    step_m: float,
    weight: float,
    profile: Array,
    band: Band,
) -> None:
    """Add the linearised lack of separation from another UAV's profile.

    ``along`` and ``lane`` (2,) are this UAV's place relative to the other's; each yields half.
    """
    own, right = band.own, band.right
    for s in range(profile.shape[0]):
        d0 = lane[0] + profile[s, 0] - other[s, 0]
        d1 = lane[1] + profile[s, 1] - other[s, 1]
        if along * along + d0 * d0 + d1 * d1 >= separation * separation:
            continue
        across = max(math.sqrt(d0 * d0 + d1 * d1), 1e-9)
        g0 = d0 / across
        g1 = d1 / across
        if d0 == 0.0 and d1 == 0.0:
            g0 = 1.0
        target = math.sqrt(max(separation * separation - along * along, 0.0)) - across
        wanted = 0.5 * target + g0 * profile[s, 0] + g1 * profile[s, 1]
        add_row(own, right, s, weight * step_m, g0, g1, wanted)


@compiled_bare
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
            limit = steep_limit(profiles[i, s, 0], prices)
            total += prices.slope * steep(np.sqrt(rise) / step_m, limit) * rise / step_m
            total += step_m * missing_price(missing[i, s], prices)
    return total
