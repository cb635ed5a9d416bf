r"""What a poor sky costs on a guide: the squared error that a fix is expected to have at a place.

The squared distance of a UAV from its lane is that of its guide and the squared error of its position
together, so a variance is priced as a squared offset is, times a weight. What it has more or less than on the
lane counts in full while that is little and is bounded where it is large, :func:`bounded`: metre for metre no
sky outbids a margin, and what there is to gain beside the lane does not depend on what is far away. What all
of a station has in common cannot be chosen: its best place is free.

Prices are tables over the lattice of :mod:`.guide_lattice`, linear in between. Nothing in here is asked
without a weight.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.navigation.sigma_map import SigmaMap
from napf_mpc.planners.guide_lattice import Lattice
from napf_mpc.planners.guide_prices import Prices, bent

Array = NDArray[np.float64]

NO_FIX_M2 = 300.0
"""A place without a fix, or with a worse one, counts as one with this squared error: 10 m on each axis."""
SLIGHT_M = 0.5
"""What costs no more than this offset from the lane draws nobody off it."""
RAY = 8
"""Pieces into which the way back to the lane is cut."""


class SkyField(NamedTuple):
    """Squared errors to be expected of fixes, in path coordinates."""

    square: Array  # (run, along, left, up) sum of the axes' variances [m^2], never infinite
    low: Array  # (3,) lowest corner: along, left, up [m]
    cell: Array  # (3,) distance of nodes [m]


NO_SKY = SkyField(np.zeros((0, 2, 2, 2)), np.zeros(3), np.ones(3))
"""For those who do not ask."""


def sky_field(sigma_map: SigmaMap) -> SkyField:
    """Squared errors of a map's nodes, with a bound where there is no fix."""
    nodes = sigma_map.nodes
    square = nodes[..., 0].copy()
    for channel in range(1, nodes.shape[-1]):
        square += nodes[..., channel]
    return SkyField(np.minimum(square, NO_FIX_M2), sigma_map.low_m, sigma_map.cell_m)


@compiled_bare
def bounded(price: float, most: float) -> float:
    """Price that begins as it is and approaches ``most`` of either sign: a worse place always costs more."""
    return price * most / (abs(price) + most)


@compiled_bare
def _cell_of(at: float, low: float, cell: float, count: int) -> tuple[int, float]:
    """Node below a place, and the part of the way to the next; beyond the ends, that of the end."""
    place = min(max((at - low) / cell, 0.0), count - 1.0)
    lower = min(int(place), count - 2)
    return lower, place - lower


@compiled_bare
def price_sky(
    field: SkyField, run: int, along: float, lane: Array, lattice: Lattice, below: int, layers: int,
    prices: Prices, table: Array,
) -> float:  # fmt: skip
    """Write the prices (station, layer, cell) of a UAV's lattice per metre; returns its lane's largest.

    Parameters
    ----------
    field : SkyField
        Of all runs.
    run : int
        Which.
    along, lane : float, array of shape (2,)
        Where the UAV is on the path, and its lane: left and up [m].
    lattice, below, layers
        The lattice, its layers below the lane, and all its layers.
    prices : Prices
        Weights.
    table : array, shape (station, layer, cell)
        Written.
    """
    square = field.square
    cells = 2 * lattice.half + 1
    worst = 0.0
    for s in range(lattice.stations):
        x, px = _cell_of(along + s * lattice.step_m, field.low[0], field.cell[0], square.shape[1])
        least = np.inf
        for v in range(layers):
            up = lane[1] + (v - below) * lattice.layer_m
            z, pz = _cell_of(up, field.low[2], field.cell[2], square.shape[3])
            for c in range(cells):
                left = lane[0] + (c - lattice.half) * lattice.cell_m
                y, py = _cell_of(left, field.low[1], field.cell[1], square.shape[2])
                total = 0.0
                for a in range(2):
                    for b in range(2):
                        share = (px if a else 1.0 - px) * (py if b else 1.0 - py)
                        low = square[run, x + a, y + b, z]
                        total += share * (low + pz * (square[run, x + a, y + b, z + 1] - low))
                table[s, v, c] = total
        lane_square = table[s, below, lattice.half]
        for v in range(layers):
            for c in range(cells):
                table[s, v, c] = bounded(prices.sky * (table[s, v, c] - lane_square), prices.sky_most)
                least = min(least, table[s, v, c])
        for v in range(layers):
            for c in range(cells):
                table[s, v, c] -= least
        worst = max(worst, table[s, below, lattice.half])
    return worst


@compiled_bare
def draws(price: float, prices: Prices) -> bool:
    """Whether a lane's price is more than that of an offset that is worth a search."""
    return price > prices.path * SLIGHT_M**2


@compiled_bare
def sky_price(
    table: Array, lattice: Lattice, below: int, layers: int, f: int, left: float, up: float
) -> float:
    """Price per metre at a fine station ``f`` and an offset from the lane, linear between places."""
    cells = 2 * lattice.half + 1
    c, pc = _cell_of(left, -lattice.half * lattice.cell_m, lattice.cell_m, cells)
    v = 0
    pv = 0.0
    if layers > 1:
        v, pv = _cell_of(up, -below * lattice.layer_m, lattice.layer_m, layers)
    s = f // lattice.fine
    ps = (f - s * lattice.fine) / lattice.fine
    price = 0.0
    for a in range(2):
        for b in range(2):
            share = (ps if a else 1.0 - ps) * (pv if b else 1.0 - pv)
            # Also keeps within the table at its last station and only layer.
            if share > 0.0:
                low = table[s + a, v + b, c]
                price += share * (low + pc * (table[s + a, v + b, c + 1] - low))
    return price


@compiled_bare
def add_sky(
    table: Array, lattice: Lattice, below: int, layers: int, step_m: float, profile: Array, own: Array,
    right: Array,
) -> None:  # fmt: skip
    """Add the prices along a profile (fine station, 2) to its band system.

    That is the parabola through the price there and a cell, or layer, to both sides: between nodes the price
    has no curvature, at nodes any, and steps that saw only one of them would swing about the best place. A
    parabola that opens downwards has its slope only.
    """
    for f in range(profile.shape[0]):
        left, up = profile[f, 0], profile[f, 1]
        here = sky_price(table, lattice, below, layers, f, left, up)
        for a in range(2 if layers > 1 else 1):
            d = lattice.layer_m if a else lattice.cell_m
            dl = 0.0 if a else d
            du = d if a else 0.0
            more = sky_price(table, lattice, below, layers, f, left + dl, up + du)
            less = sky_price(table, lattice, below, layers, f, left - dl, up - du)
            slope = (more - less) / (2.0 * d)
            curve = max((more - 2.0 * here + less) / (d * d), 0.0)
            # Half of each: rows of the band are weights of squares.
            own[f, a] += 0.5 * step_m * curve
            right[f, a] += 0.5 * step_m * (curve * profile[f, a] - slope)


@compiled_bare
def keep_for_sky(
    table: Array, lattice: Lattice, below: int, layers: int, prices: Prices, profile: Array, kept: Array
) -> None:
    """Write the offsets (fine station,) [m] at which ways straight back to the lane have the best of both.

    That is where the price of the offset and of the sky together is least; nothing is kept of a way back
    under an even sky.
    """
    for f in range(profile.shape[0]):
        left, up = profile[f, 0], profile[f, 1]
        size = math.sqrt(left * left + up * up)
        kept[f] = 0.0
        if size <= 0.0:
            continue
        best = np.inf
        at = 0
        before = here = after = last = 0.0
        for n in range(RAY + 1):
            part = n / RAY
            price = sky_price(table, lattice, below, layers, f, part * left, part * up)
            price += prices.path * bent((part * size) ** 2, prices.far_m)
            if n == at + 1:
                after = price
            if price < best:
                best = here = price
                before = last
                at = n
            last = price
        part = float(at)
        # Between the places looked at, by their parabola: else the answer would jump from plan to plan.
        if 0 < at < RAY:
            part += 0.5 * (before - after) / max(before - 2.0 * here + after, 1e-12)
        kept[f] = size * part / RAY
