"""Offset profiles by dynamic programming: on which side of what, over or under it.

The cheapest profile is exact on its lattice, so there is no local minimum in which a wall, a U or an obstacle
met head-on could hold it.

It is found without looking at most of the lattice: a place is left out if what leads to it, and the least
that must follow, cost more than a profile that is known, or than a guess that is raised until one is found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled, compiled_apart, compiled_bare
from napf_mpc.planners.guide_clearance import Sight
from napf_mpc.planners.guide_lattice import Lattice, cover
from napf_mpc.planners.guide_prices import (
    Prices,
    Query,
    apart_price,
    edge_prices,
    is_far,
    missing_price,
    own_price,
    price_of,
)

Array = NDArray[np.float64]

HALO = 4
"""Cells on each side of a row of values that are never places: two for steps out, two for steps back in."""
LAYER_HALO = 2
NOWHERE = 1 << 30
"""First place of a row without any; its last is this, negative."""
FIRST_GUESS, GUESS, RAISE = 400.0, 1.1, 2.0
"""What the search first takes for an upper bound: this price per UAV, or so many times what was paid last;
and by what it raises a bound that was too low."""


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
                own += step * own_price(left, up, bend, mean, last, i, f, query.shape, keep, prices)
                if sight.has_sky:
                    own += step * sight.sky[i, s, v, c]
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
                there += apart_price(sight, lattice, below, prices.apart, query, s, v, c)
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


@compiled_apart
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
        far = is_far(c, lattice, prices)
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
    paid: float,
    profile: Array,
) -> float:
    """Cheapest profile (station, 2) from where a UAV is, or the nearest place that the lattice knows.

    What was paid for the last one, zero if there was none, is a first guess at the price: it makes the search
    short and changes nothing else. Returns the price.
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
    limit = GUESS * paid + weight if paid > 0.0 else FIRST_GUESS * weight
    # On the lane's own layer alone if a guess was too low: it has few places, and lowers the bound.
    level = layers > 1 and v == below
    while True:
        final = not limit < known
        price = search_within(
            sight, lattice, below, 0, layers - 1, prices, query,
            bench, edge, c, v, known if final else limit, profile,
        )  # fmt: skip
        if final or price < np.inf:
            return price
        if level:
            level = False
            price = search_within(
                sight, lattice, below, below, below, prices, query,
                bench, edge, c, v, known, profile,
            )  # fmt: skip
            known = min(known, price + 1e-9 * price)
        limit *= RAISE
