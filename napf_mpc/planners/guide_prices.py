"""What an offset profile costs: offset, shape, slope, hysteresis, lack of margin and of separation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.planners.guide_clearance import Sight
from napf_mpc.planners.guide_lattice import Lattice, cover

Array = NDArray[np.float64]


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
    sky: float  # squared error of a fix, over that on the lane [1/m^2], ...
    sky_most: float  # ... and what that approaches, of either sign, where it is large


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
def own_price(
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
def apart_price(
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
def is_far(c: int, lattice: Lattice, prices: Prices) -> int:
    """Which of :func:`edge_prices` a cell's steps cost: 1 far aside of the lane, 0 near it."""
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
            total += edge[is_far(c, lattice, prices), abs(dc), abs(dv)]
        keep = prices.keep * (1.0 - s / lattice.stations)
        left = (c - lattice.half) * lattice.cell_m
        up = (v - below) * lattice.layer_m
        for i in range(query.first, query.stop):
            price = own_price(left, up, bends[v, c], mean, last, i, f, query.shape, keep, prices)
            total += lattice.step_m * price
            if sight.has_sky:
                total += lattice.step_m * sight.sky[i, s, v, c]
            if here_count[i, s] > 0:
                if c < known[i, s, v, 0] or c > known[i, s, v, 1]:
                    cover(sight, i, lattice, below, s, v, v, c, c)
                total += lattice.step_m * missing_price(missing[i, s, v, c], prices)
        if query.crowded and s > 0:
            total += apart_price(sight, lattice, below, prices.apart, query, s, v, c)
    return total
