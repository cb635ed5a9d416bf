"""Offset profiles by dynamic programming: on which side of what, over or under it.

Stations lie ahead of a UAV along the path; at each it may be in one of some lateral cells and vertical
layers. The cheapest profile is exact on that lattice, so there is no local minimum in which a wall, a U or
an obstacle met head-on could hold it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.planners.guide_clearance import Frame, SolidBoxes, shortfall
from napf_mpc.world.distance import Solids

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


class Prices(NamedTuple):
    """What a metre of path costs, all per metre along the path."""

    path: float  # squared offset from the lane [1/m^2]
    shape: float  # squared offset from the others' mean offset [1/m^2]
    far_m: float  # beyond this, offsets cost linearly: a long way round beats a squeeze
    slope: float  # squared slope
    steep: float  # slope from which that price rises with its fourth power
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


@compiled
def bent(square: float, far_m: float) -> float:
    """Square of an offset up to ``far_m``, beyond it the tangent (Huber)."""
    if square <= far_m * far_m:
        return square
    return far_m * (2.0 * math.sqrt(square) - far_m)


@compiled
def steep(slope: float, limit: float) -> float:
    """Factor on the price of a slope: 1 up to a limit, beyond it the fourth power of the ratio."""
    square = max(1.0, slope / limit) ** 2
    return square * square


@compiled
def missing_price(missing: float, prices: Prices) -> float:
    """Price of a shortfall: soft within the spare, steep where the margin itself is breached."""
    if missing <= 0.0:
        return 0.0
    within = min(missing, prices.spare_m)
    beyond = max(0.0, missing - prices.spare_m)
    price = prices.spare * within * within + prices.breach * beyond
    return price + 9.0 * prices.breach * max(0.0, beyond - prices.tolerance_m)


@compiled
def fill_missing(
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
    lattice: Lattice,
    below: int,
    missing: Array,
) -> bool:
    """Largest shortfall at every place (station, cell, layer), 0 where nothing is short, in place.

    Next to something thin a place stands for its piece of the path half a step back and forth, of which the
    nearest point is taken, so that nothing is missed between stations. Returns whether anything is short.
    """
    missing[:] = 0.0
    layers = missing.shape[2]
    any_short = False
    for entry in range(count):
        i = found[entry]
        middle = 0.5 * (boxes.low[i, 0] + boxes.high[i, 0])
        thin = boxes.high[i, 0] - middle + reach < lattice.step_m
        half_step = 0.5 * lattice.step_m if thin else 0.0
        for s in range(lattice.stations):
            at = along + s * lattice.step_m
            if at + half_step < boxes.low[i, 0] - reach or at - half_step > boxes.high[i, 0] + reach:
                continue
            at = min(max(middle, at - half_step), at + half_step)
            c0 = int(np.floor((boxes.low[i, 1] - reach - lane[0]) / lattice.cell_m)) + lattice.half
            c1 = int(np.ceil((boxes.high[i, 1] + reach - lane[0]) / lattice.cell_m)) + lattice.half
            for c in range(max(0, c0), min(2 * lattice.half, c1) + 1):
                left = lane[0] + (c - lattice.half) * lattice.cell_m
                for v in range(layers):
                    up = lane[1] + (v - below) * lattice.layer_m
                    if up < boxes.low[i, 2] - reach or up > boxes.high[i, 2] + reach:
                        continue
                    short = shortfall(solids, i, frame, at, left, up, covariance, k, need_m)[0]
                    if short > missing[s, c, v]:
                        missing[s, c, v] = short
                        any_short = True
    return any_short


@compiled
def node_prices(
    missing: Array,
    weight: float,
    mean: Array,
    last: Array,
    shape: float,
    lattice: Lattice,
    below: int,
    prices: Prices,
    node: Array,
) -> None:
    """Price of being at each place, a step's worth; ``weight`` UAVs pay for offset and hysteresis."""
    stations, cells, layers = missing.shape
    for s in range(stations):
        f = lattice.fine * s
        # What lies far ahead may be thought over again; what is near has been decided.
        keep = prices.keep * (1.0 - s / stations)
        for c in range(cells):
            left = (c - lattice.half) * lattice.cell_m
            for v in range(layers):
                up = (v - below) * lattice.layer_m
                price = prices.path * bent(left * left + up * up, prices.far_m)
                if shape > 0.0:
                    square = (left - mean[f, 0]) ** 2 + (up - mean[f, 1]) ** 2
                    price += shape * bent(square, prices.far_m)
                square = (left - last[f, 0]) ** 2 + (up - last[f, 1]) ** 2
                price += keep * min(square, prices.keep_m * prices.keep_m)
                node[s, c, v] += lattice.step_m * weight * price
                node[s, c, v] += lattice.step_m * missing_price(missing[s, c, v], prices)


@compiled
def node_neighbour(
    along: float,
    lane: Array,
    separation: float,
    other: Array,
    lattice: Lattice,
    below: int,
    price: float,
    node: Array,
) -> None:
    """Add the price of coming too near to the profile of a UAV that has chosen already."""
    stations, cells, layers = node.shape
    if abs(along) >= separation:
        return
    for s in range(1, stations):
        for c in range(cells):
            d0 = lane[0] + (c - lattice.half) * lattice.cell_m - other[s, 0]
            if abs(d0) >= separation:
                continue
            for v in range(layers):
                d1 = lane[1] + (v - below) * lattice.layer_m - other[s, 1]
                distance = np.sqrt(along * along + d0 * d0 + d1 * d1)
                if distance < separation:
                    node[s, c, v] += lattice.step_m * price * (separation - distance) ** 2


@compiled
def _spread(place: Array, cell: int, layer: int, per_cell: float, per_layer: float, value: Array) -> None:
    """Prices (cell, layer) of getting to each place on the spot: straight up or down first, then aside.

    Every place on the way is paid for, so that what stands beside a UAV is not stepped through.
    """
    cells, layers = place.shape
    for v in range(layer + 1, layers):
        value[cell, v] = value[cell, v - 1] + per_layer + place[cell, v]
    for v in range(layer - 1, -1, -1):
        value[cell, v] = value[cell, v + 1] + per_layer + place[cell, v]
    for v in range(layers):
        for c in range(cell + 1, cells):
            value[c, v] = value[c - 1, v] + per_cell + place[c, v]
        for c in range(cell - 1, -1, -1):
            value[c, v] = value[c + 1, v] + per_cell + place[c, v]


@compiled
def cheapest_profile(
    node: Array,
    start_cell: int,
    start_layer: int,
    lattice: Lattice,
    below: int,
    slope_price: float,
    steep_slope: float,
    aside: float,
    value: Array,
    back: NDArray[np.int8],
    profile: Array,
) -> float:
    """Cheapest profile through node prices (station, cell, layer) from a place at station 0.

    Steps of up to two cells and one layer a station; on the spot any number if ``aside`` is not negative,
    which is their price per metre. Scratch: ``value`` (2, cell, layer), ``back`` as the node prices. The
    profile (station, 2) gets offsets to the left and up [m]. Returns its price.
    """
    stations, cells, layers = node.shape
    value[:] = np.inf
    value[0, start_cell, start_layer] = node[0, start_cell, start_layer]
    low_c = high_c = start_cell
    now = 0
    if aside >= 0.0:
        _spread(node[0], start_cell, start_layer, aside * lattice.cell_m, aside * lattice.layer_m, value[0])
        low_c = 0
        high_c = cells - 1
    edge = np.empty((5, 3))
    for dc in range(-2, 3):
        for dv in range(-1, 2):
            square = (dc * lattice.cell_m) ** 2 + (dv * lattice.layer_m) ** 2
            factor = steep(np.sqrt(square) / lattice.step_m, steep_slope)
            edge[dc + 2, dv + 1] = slope_price * factor * square / lattice.step_m
    for s in range(1, stations):
        low_c = max(0, low_c - 2)
        high_c = min(cells - 1, high_c + 2)
        for c in range(low_c, high_c + 1):
            for v in range(layers):
                best = np.inf
                way = 7
                for dc in range(max(-2, c - cells + 1), min(2, c) + 1):
                    for dv in range(max(-1, v - layers + 1), min(1, v) + 1):
                        price = value[now, c - dc, v - dv] + edge[dc + 2, dv + 1]
                        if price < best:
                            best = price
                            way = 3 * (dc + 2) + dv + 1
                value[1 - now, c, v] = best + node[s, c, v]
                back[s, c, v] = way
        now = 1 - now
    best = np.inf
    c_end = start_cell
    v_end = start_layer
    for c in range(low_c, high_c + 1):
        for v in range(layers):
            if value[now, c, v] < best:
                best = value[now, c, v]
                c_end = c
                v_end = v
    c = c_end
    v = v_end
    for s in range(stations - 1, -1, -1):
        profile[s, 0] = (c - lattice.half) * lattice.cell_m
        profile[s, 1] = (v - below) * lattice.layer_m
        if s > 0:
            way = back[s, c, v]
            c -= way // 3 - 2
            v -= way % 3 - 1
    return best
