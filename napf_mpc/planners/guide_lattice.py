"""Offset profiles by dynamic programming: on which side of what, over or under it.

Stations lie ahead of a UAV along the path; at each it may be in one of some lateral cells and vertical
layers. The cheapest profile is exact on that lattice, so there is no local minimum in which a wall, a U or
an obstacle met head-on could hold it.

It is found without looking at most of the lattice: a place is left out if what leads to it, and the least
that must follow, cost more than a profile that is known, or than a guess that is raised until one is found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_bare
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
    UP,
    Sight,
    is_round,
    shortfall,
)

Array = NDArray[np.float64]

HALO = 4
"""Cells on each side of a row of values that are never places: two for steps out, two for steps back in."""
LAYER_HALO = 2
NOWHERE = 1 << 30
"""First place of a row without any; its last is this, negative."""
FIRST_GUESS = 400.0
"""Price of a profile, per UAV, that the search first takes for an upper bound."""


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


class Prices(NamedTuple):
    """What a metre of path costs, all per metre along the path."""

    path: float  # squared offset from the lane [1/m^2]
    shape: float  # squared offset from the others' mean offset [1/m^2]
    far_m: float  # beyond this, offsets cost linearly: a long way round beats a squeeze
    slope: float  # squared slope
    steep: float  # slope from which that price rises with its fourth power,
    steep_far: float  # and the same to offsets aside of more than
    gentle_m: float
    bend: float  # squared change of slope [m^2]
    keep: float  # squared difference to the last profile [1/m^2], up to keep_m
    keep_m: float
    spare: float  # squared shortfall within the spare [1/m^2]
    breach: float  # shortfall beyond it [1/m], ten times that beyond the tolerance
    spare_m: float
    tolerance_m: float
    aside: float  # a metre aside on the spot
    start: float  # squared distance of the profile's start from the UAV, once, in tight places [1/m^2]
    apart: float  # squared lack of separation from another UAV [1/m^2]


@compiled_bare
def bent(square: float, far_m: float) -> float:
    """Square of an offset up to ``far_m``, beyond it the tangent (Huber)."""
    if square <= far_m * far_m:
        return square
    return far_m * (2.0 * math.sqrt(square) - far_m)


@compiled_bare
def steep(slope: float, limit: float) -> float:
    """Factor on the price of a slope: 1 up to a limit, beyond it the fourth power of the ratio."""
    square = max(1.0, slope / limit) ** 2
    return square * square


@compiled_bare
def steep_limit(left_m: float, prices: Prices) -> float:
    """Slope from which slopes cost more on the way to an offset."""
    return prices.steep_far if abs(left_m) > prices.gentle_m else prices.steep


@compiled_bare
def missing_price(missing: float, prices: Prices) -> float:
    """Price of a shortfall: soft within the spare, steep where the margin itself is breached."""
    if missing <= 0.0:
        return 0.0
    within = min(missing, prices.spare_m)
    beyond = max(0.0, missing - prices.spare_m)
    price = prices.spare * within * within + prices.breach * beyond
    return price + 9.0 * prices.breach * max(0.0, beyond - prices.tolerance_m)


class Query(NamedTuple):
    """Whose profile is sought, and what it is drawn to."""

    first: int  # UAVs first ... stop - 1 share it
    stop: int
    shape: float
    mean: Array  # (fine station, 2) of the others
    last: Array  # (uav, fine station, 2)
    chosen: Array  # (uav, station, 2) profiles of the UAVs before the first, to keep apart from
    separation: Array  # (uav, uav)
    crowded: bool  # whether any of those is near enough to matter
    aside: float  # price of a metre on the spot, negative if not possible


class Bench(NamedTuple):
    """Scratch of the search."""

    value: Array  # (station, layer and halo, cell and halo) price of getting to each place
    own: Array  # (layer, cell) places' own prices without what is in the way
    bend: Array  # (layer, cell) squared offsets, bent
    ahead: Array  # (station,) least price of what follows, per squared offset [1/m^2]
    # (2, layer and one on each side, 2) first and last place of each row that can be got to, at even and odd
    # stations.
    spans: NDArray[np.int64]


@compiled_bare
def list_here(sight: Sight, i: int, lattice: Lattice) -> None:
    """Note which of the solids that UAV i has found reach which stations."""
    near = sight.near
    for s in range(lattice.stations):
        sight.here_count[i, s] = 0
    for entry in range(sight.solid_count[i]):
        half_step = _half_step(near[i, entry, LOW], near[i, entry, HIGH], lattice.step_m)
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
def _half_step(low: float, high: float, step_m: float) -> float:
    """How far back and forth a place stands for its piece of the path, next to what reaches so far.

    Next to something thin the nearest point of half a step is taken, so that nothing is missed between
    stations.
    """
    return 0.5 * step_m if 0.5 * (high - low) < step_m else 0.0


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
            half_step = _half_step(near[i, entry, LOW], near[i, entry, HIGH], lattice.step_m)
            if half_step > 0.0:
                middle = 0.5 * (near[i, entry, LOW] + near[i, entry, HIGH])
                at = min(max(middle, station - half_step), station + half_step)
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
                            near[i, entry, TOUCHED], turned, near[i, entry, SIGMAS], need,
                        )  # fmt: skip
                continue
            for c in range(c0, c1 + 1):
                if k0 <= c <= k1:
                    continue
                place = lane + (c - half) * cell
                short = shortfall(solids, found[i, entry], frame, at, place, up, covariance[i], k, need)[0]
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
        short = need_m + k * math.sqrt(max(variance, 0.0)) - (math.sqrt(square) - radius)
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


@compiled_bare
def bend_offsets(lattice: Lattice, below: int, layers: int, prices: Prices, bend: Array) -> None:
    """Squared offsets (layer, cell) of all places, bent."""
    for v in range(layers):
        up = (v - below) * lattice.layer_m
        for c in range(2 * lattice.half + 1):
            left = (c - lattice.half) * lattice.cell_m
            bend[v, c] = bent(left * left + up * up, prices.far_m)


@compiled_bare
def price_ahead(lattice: Lattice, path: float, slope: float, ahead: Array) -> None:
    """Least price of all that follows a station, per squared offset (bent): back to the lane, nothing else.

    Offsets that follow cost a step's worth of ``path`` each, and slopes at least their square: the Riccati
    recursion of that problem. Steeper slopes cost more, and offsets far out no less than this makes of them.
    """
    ahead[lattice.stations - 1] = 0.0
    rise = slope / lattice.step_m
    for s in range(lattice.stations - 2, -1, -1):
        next_one = lattice.step_m * path + ahead[s + 1]
        ahead[s] = rise * next_one / (rise + next_one)


@compiled_bare
def _own_price(
    left: float, up: float, bend: float, mean: Array, last: Array, i: int, f: int, shape: float, keep: float,
    prices: Prices,
) -> float:  # fmt: skip
    """What one UAV pays a metre for being at a place: offset, shape and hysteresis."""
    price = prices.path * bend
    if shape > 0.0:
        price += shape * bent((left - mean[f, 0]) ** 2 + (up - mean[f, 1]) ** 2, prices.far_m)
    square = (left - last[i, f, 0]) ** 2 + (up - last[i, f, 1]) ** 2
    return float(price + keep * min(square, prices.keep_m * prices.keep_m))


@compiled_bare
def _apart_price(
    sight: Sight, lattice: Lattice, below: int, price: float, query: Query, s: int, v: int, c: int
) -> float:
    """Price of coming too near to the UAVs that have chosen already."""
    total = 0.0
    i = query.first
    for j in range(i):
        least = query.separation[i, j]
        along = sight.along[i] - sight.along[j]
        if abs(along) >= least:
            continue
        d0 = sight.lanes[i, 0] - sight.lanes[j, 0] + (c - lattice.half) * lattice.cell_m
        d1 = sight.lanes[i, 1] - sight.lanes[j, 1] + (v - below) * lattice.layer_m
        d0 -= query.chosen[j, s, 0]
        d1 -= query.chosen[j, s, 1]
        square = along * along + d0 * d0 + d1 * d1
        if square < least * least:
            total += lattice.step_m * price * (least - math.sqrt(square)) ** 2
    return total


@compiled_bare
def edge_prices(lattice: Lattice, prices: Prices, weight: float, edge: Array) -> None:
    """Prices (2, 3, 2) of steps of so many cells and layers from one station to the next.

    First to places near the lane, second to those far aside of it, see :func:`steep_limit`.
    """
    for far in range(2):
        for dc in range(3):
            for dv in range(2):
                square = (dc * lattice.cell_m) ** 2 + (dv * lattice.layer_m) ** 2
                limit = prices.steep_far if far else prices.steep
                factor = steep(math.sqrt(square) / lattice.step_m, limit)
                edge[far, dc, dv] = weight * prices.slope * factor * square / lattice.step_m


@compiled_bare
def _is_far(c: int, lattice: Lattice, prices: Prices) -> int:
    return 1 if abs(c - lattice.half) * lattice.cell_m > prices.gentle_m else 0


@compiled_bare
def price_of(
    sight: Sight,
    lattice: Lattice,
    below: int,
    layers: int,
    prices: Prices,
    query: Query,
    bends: Array,
    edge: Array,
    start_cell: int,
    start_layer: int,
    wanted: Array,
) -> float:
    """Price of the lattice's profile that follows a wanted one (fine station, 2) as steps allow."""
    mean, last = query.mean, query.last
    here_count, missing, known = sight.here_count, sight.missing, sight.known
    c = start_cell
    v = start_layer
    total = 0.0
    for s in range(lattice.stations):
        f = lattice.fine * s
        if s > 0:
            to_c = round(wanted[f, 0] / lattice.cell_m) + lattice.half
            to_v = round(wanted[f, 1] / lattice.layer_m) + below
            dc = min(max(min(max(to_c, 0), 2 * lattice.half) - c, -2), 2)
            dv = min(max(min(max(to_v, 0), layers - 1) - v, -1), 1)
            c += dc
            v += dv
            total += edge[_is_far(c, lattice, prices), abs(dc), abs(dv)]
        keep = prices.keep * (1.0 - s / lattice.stations)
        left = (c - lattice.half) * lattice.cell_m
        up = (v - below) * lattice.layer_m
        for i in range(query.first, query.stop):
            price = _own_price(left, up, bends[v, c], mean, last, i, f, query.shape, keep, prices)
            total += lattice.step_m * price
            if here_count[i, s] > 0:
                if c < known[i, s, v, 0] or c > known[i, s, v, 1]:
                    cover(sight, i, lattice, below, s, v, v, c, c)
                total += lattice.step_m * missing_price(missing[i, s, v, c], prices)
        if query.crowded and s > 0:
            total += _apart_price(sight, lattice, below, prices.apart, query, s, v, c)
    return total


@compiled_bare
def _spread(
    value: Array,
    lowest: int,
    highest: int,
    cells: int,
    cell: int,
    layer: int,
    per_cell: float,
    per_layer: float,
) -> None:
    """Prices of getting to each place on the spot, from places' own: straight up or down first, then aside.

    Every place on the way is paid for, so that what stands beside a UAV is not stepped through.
    """
    h = HALO
    b = LAYER_HALO
    for v in range(layer + 1, highest + 1):
        value[b + v, h + cell] += value[b + v - 1, h + cell] + per_layer
    for v in range(layer - 1, lowest - 1, -1):
        value[b + v, h + cell] += value[b + v + 1, h + cell] + per_layer
    for v in range(lowest, highest + 1):
        for c in range(cell + 1, cells):
            value[b + v, h + c] += value[b + v, h + c - 1] + per_cell
        for c in range(cell - 1, -1, -1):
            value[b + v, h + c] += value[b + v, h + c + 1] + per_cell


@compiled_bare
def _relax(
    value: Array,
    bends: Array,
    s: int,
    v: int,
    low: int,
    high: int,
    edge: Array,
    least: float,
    limit: float,
) -> None:
    """Cheapest prices of getting to a row's cells low ... high from the station before, without their own.

    Infinite where that and ``least`` for the squared offset are beyond the limit.
    """
    e00 = edge[0, 0]
    e10 = edge[1, 0]
    e20 = edge[2, 0]
    e01 = edge[0, 1]
    e11 = edge[1, 1]
    e21 = edge[2, 1]
    # Unsigned, so that the compiler need not think of indices from the end, and vectorises.
    one = np.uint64(1)
    two = np.uint64(2)
    to = np.uint64(s)
    b = np.uint64(s - 1)
    level = np.uint64(LAYER_HALO + v)
    under = level - one
    over = level + one
    first = np.uint64(HALO + low)
    layer = np.uint64(v)
    column = np.uint64(low)
    for k in range(np.uint64(high - low + 1)):
        c = first + k
        p = c - one
        q = c + one
        x = value[b, level, c] + e00
        x = min(min(value[b, level, p], value[b, level, q]) + e10, x)
        x = min(min(value[b, under, c], value[b, over, c]) + e01, x)
        x = min(
            min(min(value[b, under, p], value[b, under, q]), min(value[b, over, p], value[b, over, q])) + e11,
            x,
        )
        p = c - two
        q = c + two
        x = min(min(value[b, level, p], value[b, level, q]) + e20, x)
        x = min(
            min(min(value[b, under, p], value[b, under, q]), min(value[b, over, p], value[b, over, q])) + e21,
            x,
        )
        value[to, level, c] = x if x + least * bends[layer, column + k] <= limit else np.inf


@compiled_bare
def _pay(
    sight: Sight,
    lattice: Lattice,
    below: int,
    prices: Prices,
    query: Query,
    bench: Bench,
    s: int,
    window: tuple[int, int, int, int],
    weight: float,
    limit: float,
) -> tuple[int, int, int, int]:
    """Add places' own prices to those of getting there; what then is beyond the limit becomes infinite.

    Returns the smallest window (first and last layer, first and last cell) around what is left.
    """
    value, owns, bends = bench.value, bench.own, bench.bend
    mean, last = query.mean, query.last
    here_count, missing, known = sight.here_count, sight.missing, sight.known
    ahead = weight * bench.ahead[s]
    step = lattice.step_m
    f = lattice.fine * s
    # What lies far ahead may be thought over again; what is near has been decided.
    keep = prices.keep * (1.0 - s / lattice.stations)
    spans, now = bench.spans, s % 2
    for v in range(window[0], window[1] + 1):
        up = (v - below) * lattice.layer_m
        first, last_one = NOWHERE, -NOWHERE
        for c in range(spans[now, v + 1, 0], spans[now, v + 1, 1] + 1):
            there = value[s, LAYER_HALO + v, HALO + c]
            if not there < np.inf:
                continue
            bend = bends[v, c]
            left = (c - lattice.half) * lattice.cell_m
            own = 0.0
            for i in range(query.first, query.stop):
                own += step * _own_price(left, up, bend, mean, last, i, f, query.shape, keep, prices)
            if there + own + ahead * bend > limit:
                value[s, LAYER_HALO + v, HALO + c] = np.inf
                continue
            owns[v, c] = own
            first, last_one = min(first, c), c
        spans[now, v + 1, 0], spans[now, v + 1, 1] = first, last_one
    anything = query.crowded and s > 0
    for i in range(query.first, query.stop):
        if here_count[i, s] == 0:
            continue
        anything = True
        for v in range(window[0], window[1] + 1):
            first, last_one = spans[now, v + 1, 0], spans[now, v + 1, 1]
            if first <= last_one and (first < known[i, s, v, 0] or last_one > known[i, s, v, 1]):
                cover(sight, i, lattice, below, s, v, v, first, last_one)
    for v in range(window[0], window[1] + 1):
        first, last_one = NOWHERE, -NOWHERE
        for c in range(spans[now, v + 1, 0], spans[now, v + 1, 1] + 1):
            there = value[s, LAYER_HALO + v, HALO + c]
            if not there < np.inf:
                continue
            own = owns[v, c]
            if anything:
                for i in range(query.first, query.stop):
                    if here_count[i, s] > 0 and missing[i, s, v, c] > 0.0:
                        own += step * missing_price(missing[i, s, v, c], prices)
            there += own
            rest = ahead * bends[v, c]
            if query.crowded and s > 0 and there + rest <= limit:
                there += _apart_price(sight, lattice, below, prices.apart, query, s, v, c)
            if there + rest > limit:
                value[s, LAYER_HALO + v, HALO + c] = np.inf
                continue
            value[s, LAYER_HALO + v, HALO + c] = there
            first, last_one = min(first, c), c
        spans[now, v + 1, 0], spans[now, v + 1, 1] = first, last_one
    return _around(spans, now, window)


@compiled_bare
def _around(
    spans: NDArray[np.int64], now: int, window: tuple[int, int, int, int]
) -> tuple[int, int, int, int]:
    """Smallest window around a window's spans; its first layer is past its last if all are empty."""
    v0, v1, c0, c1 = window[1] + 1, window[0] - 1, window[3] + 1, window[2] - 1
    for v in range(window[0], window[1] + 1):
        if spans[now, v + 1, 0] <= spans[now, v + 1, 1]:
            v0, v1 = min(v0, v), v
            c0, c1 = min(c0, spans[now, v + 1, 0]), max(c1, spans[now, v + 1, 1])
    return v0, v1, c0, c1


@compiled_bare
def _begin_spans(spans: NDArray[np.int64], window: tuple[int, int, int, int]) -> None:
    """Spans of the first station: the whole window."""
    for v in range(spans.shape[1]):
        for parity in range(2):
            spans[parity, v, 0], spans[parity, v, 1] = NOWHERE, -NOWHERE
    for v in range(window[0], window[1] + 1):
        spans[0, v + 1, 0], spans[0, v + 1, 1] = window[2], window[3]


@compiled_bare
def _step_spans(spans: NDArray[np.int64], now: int, window: tuple[int, int, int, int]) -> None:
    """Spans within a window that can be got to from those of the station before: a layer and two cells on."""
    before = 1 - now
    for v in range(spans.shape[1]):
        spans[now, v, 0], spans[now, v, 1] = NOWHERE, -NOWHERE
    for v in range(window[0] + 1, window[1] + 2):
        first = min(spans[before, v, 0], min(spans[before, v - 1, 0], spans[before, v + 1, 0]))
        last = max(spans[before, v, 1], max(spans[before, v - 1, 1], spans[before, v + 1, 1]))
        if first <= last:
            spans[now, v, 0], spans[now, v, 1] = max(window[2], first - 2), min(window[3], last + 2)


@compiled_bare
def search_within(
    sight: Sight,
    lattice: Lattice,
    below: int,
    lowest: int,
    highest: int,
    prices: Prices,
    query: Query,
    bench: Bench,
    edge: Array,
    start_cell: int,
    start_layer: int,
    limit: float,
    profile: Array,
) -> float:
    """Cheapest profile from a place at station 0 if it costs no more than a limit, else infinity.

    It keeps to the layers lowest ... highest. Steps of up to two cells and one layer a station; on the spot
    any number if ``query.aside`` is not negative. The profile (station, 2) gets offsets to the left and up
    [m]. Returns its price.
    """
    cells = 2 * lattice.half + 1
    weight = float(query.stop - query.first)
    value = bench.value
    window = (start_layer, start_layer, start_cell, start_cell)
    near = int(np.floor(prices.gentle_m / lattice.cell_m))
    first, last = max(0, lattice.half - near), min(cells - 1, lattice.half + near)
    if query.aside >= 0.0:
        window = (lowest, highest, 0, cells - 1)
    spans = bench.spans
    _begin_spans(spans, window)
    for s in range(lattice.stations):
        if s > 0:
            window = (
                max(lowest, window[0] - 1), min(highest, window[1] + 1),
                max(0, window[2] - 2), min(cells - 1, window[3] + 2),
            )  # fmt: skip
            _step_spans(spans, s % 2, window)
        _clear(value, s, window)
        least = weight * (lattice.step_m * prices.path + bench.ahead[s])
        for v in range(window[0], window[1] + 1):
            if s > 0:
                # Near the lane, and far aside of it on both sides.
                for far, c0, c1 in ((1, 0, first - 1), (0, first, last), (1, last + 1, cells - 1)):
                    low, high = max(spans[s % 2, v + 1, 0], c0), min(spans[s % 2, v + 1, 1], c1)
                    if low <= high:
                        _relax(value, bench.bend, s, v, low, high, edge[far], least, limit)
            else:
                value[0, LAYER_HALO + v, HALO + window[2] : HALO + window[3] + 1] = 0.0
        window = _pay(
            sight, lattice, below, prices, query, bench, s, window, weight, limit if s > 0 else np.inf
        )
        if s == 0 and query.aside >= 0.0:
            _spread(
                value[0], lowest, highest, cells, start_cell, start_layer,
                weight * query.aside * lattice.cell_m, weight * query.aside * lattice.layer_m,
            )  # fmt: skip
        if window[1] < window[0]:
            return np.inf
    best = np.inf
    c_end = start_cell
    v_end = start_layer
    for c in range(window[2], window[3] + 1):
        for v in range(window[0], window[1] + 1):
            if value[lattice.stations - 1, LAYER_HALO + v, HALO + c] < best:
                best = value[lattice.stations - 1, LAYER_HALO + v, HALO + c]
                c_end = c
                v_end = v
    if best < np.inf:
        _trace(value, lattice, prices, below, edge, c_end, v_end, profile)
    return best


@compiled_bare
def _clear(value: Array, s: int, window: tuple[int, int, int, int]) -> None:
    """Make a window and its surroundings infinite."""
    v0, v1, c0, c1 = window
    to = np.uint64(s)
    first = np.uint64(c0)
    for v in range(v0, v1 + 2 * LAYER_HALO + 1):
        row = np.uint64(v)
        for c in range(np.uint64(c1 - c0 + 2 * HALO + 1)):
            value[to, row, first + c] = np.inf


@compiled_bare
def _trace(
    value: Array,
    lattice: Lattice,
    prices: Prices,
    below: int,
    edge: Array,
    cell: int,
    layer: int,
    profile: Array,
) -> None:
    """Write the profile that ends in a place: back from station to station the way that was cheapest."""
    c = cell
    v = layer
    for s in range(lattice.stations - 1, -1, -1):
        profile[s, 0] = (c - lattice.half) * lattice.cell_m
        profile[s, 1] = (v - below) * lattice.layer_m
        if s == 0:
            return
        far = _is_far(c, lattice, prices)
        best = np.inf
        from_c = c
        from_v = v
        for dc in range(-2, 3):
            for dv in range(-1, 2):
                price = value[s - 1, LAYER_HALO + v - dv, HALO + c - dc] + edge[far, abs(dc), abs(dv)]
                if price < best:
                    best = price
                    from_c = c - dc
                    from_v = v - dv
        c = from_c
        v = from_v


@compiled
def cheapest_profile(
    sight: Sight,
    lattice: Lattice,
    below: int,
    layers: int,
    prices: Prices,
    query: Query,
    bench: Bench,
    offset: Array,
    profile: Array,
) -> float:
    """Cheapest profile (station, 2) from where a UAV is, or the nearest place that the lattice knows.

    Returns its price.
    """
    weight = float(query.stop - query.first)
    c = min(max(round(offset[0] / lattice.cell_m) + lattice.half, 0), 2 * lattice.half)
    v = min(max(round(offset[1] / lattice.layer_m) + below, 0), layers - 1)
    edge = np.empty((2, 3, 2))
    edge_prices(lattice, prices, weight, edge)
    # What was flown last is a way as well, or near to one.
    wanted = query.last[query.first] if query.stop - query.first == 1 else query.mean
    known = price_of(sight, lattice, below, layers, prices, query, bench.bend, edge, c, v, wanted)
    # Sums are rounded: a little above the price of a profile that is there.
    known += 1e-9 * known + 1e-9
    guess = FIRST_GUESS * weight
    limit = guess if layers > 1 else known
    # On the lane's own layer first, if that may lower the bound: it has few places.
    level = layers > 1 and v == below and known > guess
    while True:
        final = not level and not limit < 0.5 * known
        price = search_within(
            sight, lattice, below, below if level else 0, below if level else layers - 1, prices, query,
            bench, edge, c, v, known if level or final else limit, profile,
        )  # fmt: skip
        if level:
            level = False
            known = min(known, price + 1e-9 * price)
        elif final or price < np.inf:
            return price
        else:
            limit *= 4.0
