"""Places that guidance may choose between, and what is short of its margin at each.

Stations lie ahead of a UAV along the path; at each it may be in one of some lateral cells and vertical
layers. What is in the way there is worked out only where a search asks.
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
    shortfall,
)

Array = NDArray[np.float64]


class Lattice(NamedTuple):
    """Places that the search knows."""

    stations: int
    step_m: float  # from station to station along the path
    fine: int  # stations of the band for one of the lattice
    half: int  # lateral cells on each side of the lane
    cell_m: float
    layer_m: float
    layers: int  # up past what stands on the ground; past spheres, half of ``sphere_layers`` each way
    sphere_layers: int
    under: int  # down past what hangs in the air


@compiled_bare
def list_here(sight: Sight, i: int, lattice: Lattice) -> None:
    """Note which of the solids that UAV i has found reach which stations."""
    near = sight.near
    for s in range(lattice.stations):
        sight.here_count[i, s] = 0
    for entry in range(sight.solid_count[i]):
        half_step = half_step_of(near[i, entry], sight.reach[i], lattice.step_m)
        low = near[i, entry, LOW] - half_step - sight.along[i]
        high = near[i, entry, HIGH] + half_step - sight.along[i]
        s0 = max(0, int(np.ceil(low / lattice.step_m)))
        s1 = min(lattice.stations - 1, int(np.floor(high / lattice.step_m)))
        for s in range(s0, s1 + 1):
            sight.here[i, s, sight.here_count[i, s]] = entry
            sight.here_count[i, s] += 1
    for s in range(lattice.stations):
        for v in range(sight.known.shape[2]):
            sight.known[i, s, v, 0] = 0
            sight.known[i, s, v, 1] = -1


@compiled_bare
def cover(
    sight: Sight, i: int, lattice: Lattice, below: int, s: int, v0: int, v1: int, low: int, high: int
) -> None:
    """Make sure that the shortfalls of UAV i in the cells low ... high of layers v0 ... v1 are known.

    Only where a solid's reach crosses a row they are worked out; the largest of all solids counts.
    """
    near, found, here, turned = sight.near, sight.found, sight.here, sight.turned
    missing, known = sight.missing, sight.known
    solids, frame, covariance = sight.solids, sight.frame, sight.covariance
    k, need = sight.margins.k, sight.need_m
    here_count = sight.here_count[i, s]
    lane = sight.lanes[i, 0]
    height = sight.lanes[i, 1]
    cell = lattice.cell_m
    half = lattice.half
    station = sight.along[i] + s * lattice.step_m
    for v in range(v0, v1 + 1):
        k0 = known[i, s, v, 0]
        k1 = known[i, s, v, 1]
        if k0 <= low and high <= k1:
            continue
        # What is known is one stretch of cells: it grows to the left, to the right or both.
        if k1 < k0:
            k0 = high + 1
            k1 = high
        first = min(low, k0)
        last = max(high, k1)
        known[i, s, v, 0] = first
        known[i, s, v, 1] = last
        for c in range(first, k0):
            missing[i, s, v, c] = 0.0
        for c in range(k1 + 1, last + 1):
            missing[i, s, v, c] = 0.0
        up = height + (v - below) * lattice.layer_m
        for n in range(here_count):
            entry = here[i, s, n]
            if up < near[i, entry, LOW + 2] or up > near[i, entry, HIGH + 2]:
                continue
            at = station
            half_step = half_step_of(near[i, entry], sight.reach[i], lattice.step_m)
            if half_step > 0.0:
                at = nearest_along(near[i, entry], sight.reach[i], station, half_step, lattice.step_m)
            x = at - near[i, entry, ALONG]
            z = near[i, entry, ROUND] * (up - near[i, entry, UP])
            if near[i, entry, ROUND] >= 0.0:
                across2 = near[i, entry, OUTER2] - x * x - z * z
                if across2 < 0.0:
                    continue
                across = math.sqrt(across2)
                left = near[i, entry, LEFT] - across
                right = near[i, entry, LEFT] + across
            else:
                left = near[i, entry, LOW + 1]
                right = near[i, entry, HIGH + 1]
            c0 = max(first, int(np.floor((left - lane) / cell)) + half)
            c1 = min(last, int(np.ceil((right - lane) / cell)) + half)
            if is_round(near, i, entry, up):
                y0 = lane - half * cell - near[i, entry, LEFT]
                for a, z1 in ((c0, min(c1, k0 - 1)), (max(c0, k1 + 1), c1)):
                    if a <= z1:
                        _fill_round(
                            missing, i, s, v, a, z1, y0, cell, x, z, near[i, entry, RADIUS],
                            near[i, entry, TOUCHED], turned, near[i, entry, SIGMAS], need, sight.radius_m,
                        )  # fmt: skip
                continue
            for c in range(c0, c1 + 1):
                if k0 <= c <= k1:
                    continue
                place = lane + (c - half) * cell
                short, _, _, distance = shortfall(
                    solids, found[i, entry], frame, at, place, up, covariance[i], k, need
                )
                if distance < sight.radius_m:
                    short = max(short, TOUCHING_M)
                missing[i, s, v, c] = max(missing[i, s, v, c], short)


@compiled_bare
def _fill_round(
    missing: Array,
    i: int,
    s: int,
    v: int,
    c0: int,
    c1: int,
    y0: float,
    cell_m: float,
    x: float,
    z: float,
    radius: float,
    touched: float,
    turned: Array,
    k: float,
    need_m: float,
    radius_m: float,
) -> None:
    """Take a round solid into the shortfalls of a row's cells c0 ... c1; the first is y0 + c0 cells away."""
    k0 = turned[i, 0, 0] * x * x + turned[i, 2, 2] * z * z + 2.0 * turned[i, 0, 2] * x * z
    k1 = 2.0 * (turned[i, 0, 1] * x + turned[i, 1, 2] * z)
    k2 = turned[i, 1, 1]
    flat = x * x + z * z
    # Unsigned, so that the compiler need not think of indices from the end, and vectorises.
    ui = np.uint64(i)
    us = np.uint64(s)
    uv = np.uint64(v)
    first = np.uint64(c0)
    for n in range(np.uint64(c1 - c0 + 1)):
        c = first + n
        y = y0 + cell_m * np.float64(np.int64(c))
        square = flat + y * y
        variance = (k0 + y * (k1 + y * k2)) / square if square > 1e-18 else touched
        distance = math.sqrt(square) - radius
        short = need_m + k * math.sqrt(max(variance, 0.0)) - distance
        if distance < radius_m:
            short = max(short, TOUCHING_M)
        missing[ui, us, uv, c] = max(missing[ui, us, uv, c], short)


@compiled_bare
def any_short(sight: Sight, i: int, lattice: Lattice, below: int, layers: int) -> bool:
    """Whether anything is short for UAV i anywhere on the lattice."""
    cells = 2 * lattice.half + 1
    near = sight.near
    count = sight.solid_count[i]
    # What is short anywhere is so next to the middle of a solid, most times: there first.
    for n in range(count + lattice.stations):
        s = n - count
        low = 0
        high = cells - 1
        if n < count:
            along = 0.5 * (near[i, n, LOW] + near[i, n, HIGH]) - sight.along[i]
            left = 0.5 * (near[i, n, LOW + 1] + near[i, n, HIGH + 1]) - sight.lanes[i, 0]
            s = min(max(round(along / lattice.step_m), 0), lattice.stations - 1)
            low = min(max(round(left / lattice.cell_m) + lattice.half, 0), cells - 1)
            high = low
        if sight.here_count[i, s] == 0:
            continue
        for v in range(layers):
            cover(sight, i, lattice, below, s, v, v, low, high)
            for c in range(low, high + 1):
                if sight.missing[i, s, v, c] > 0.0:
                    return True
    return False
