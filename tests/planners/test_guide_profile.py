"""The lattice's search leaves places out: it must find what a search of every place finds."""

import math
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.constraints.passage import half_space_margins
from napf_mpc.formation import PathFrame
from napf_mpc.planners.guide_clearance import (
    TOUCHING_M,
    Sight,
    frame_of,
    gather,
    largest_reach,
    look,
    shortfall,
    solid_boxes,
)
from napf_mpc.planners.guide_lattice import cover, list_here
from napf_mpc.planners.guide_prices import (
    Prices,
    Query,
    bend_offsets,
    bent,
    missing_price,
    price_ahead,
    steep,
    steep_limit,
)
from napf_mpc.planners.guide_profile import Bench, cheapest_profile
from napf_mpc.planners.guide_search import make_scratch
from napf_mpc.planners.guide_settings import GuidanceSettings, search_of
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape, Sphere

Array = NDArray[np.float64]

SEARCH = search_of(GuidanceSettings(widest_m=10.0, ahead_m=40.0), half_space_margins(3.0), 0.3)
LATTICE, PRICES = SEARCH.lattice, SEARCH.prices
GENTLE = PRICES._replace(path=1.5, slope=16.0, steep=0.7, steep_far=0.7, far_m=8.0)
"""Prices for which the way back to the lane is nowhere steep, which :func:`price_ahead` leaves out."""
BELOW, LAYERS, CELLS = 4, 9, 2 * LATTICE.half + 1
LANE = np.array([3.0, 0.5])
LEVEL = PathFrame.from_angles((5.0, -7.0, 2.0), 0.7, 0.0)
CLIMBING = PathFrame.from_angles((5.0, -7.0, 2.0), 0.7, 0.3)


def scene(seed: int, path: PathFrame, count: int) -> list[Shape]:
    """Solids of all kinds about the lanes, one sphere right on a place of the lattice."""
    rng = np.random.default_rng(seed)
    shapes: list[Shape] = [Sphere(tuple(path.to_world(np.array([12.0, *LANE]))), 1.0)]
    for _ in range(count):
        x, y, z = path.to_world(rng.uniform((4.0, -9.0, -3.0), (38.0, 12.0, 3.0)))
        radius = rng.uniform(0.5, 2.0)
        shapes.append(Sphere((x, y, z), radius))
        if rng.random() < 0.4:
            shapes.append(Cylinder((x, y), radius, z - 3.0, z + rng.uniform(0.5, 4.0)))
        if rng.random() < 0.3:
            shapes.append(Box((x, y, z), (2.0, 3.0, 4.0)))
    return shapes


def seen(shapes: list[Shape], path: PathFrame, covariance: Array, sky: Array | None = None) -> Sight:
    """What two UAVs see that fly 4 m behind each other on the same lane, perhaps with prices of the sky."""
    obstacles = ObstacleSet.from_shapes(shapes)
    solids, boxes = obstacles.solids, solid_boxes(obstacles, path)
    scratch = make_scratch(2, 2 * LATTICE.stations - 1, len(shapes), SEARCH)
    need = SEARCH.radius_m + PRICES.spare_m
    sight = Sight(
        solids, frame_of(path), SEARCH.margins, SEARCH.radius_m, need, np.array([0.0, -4.0]),
        np.tile(LANE, (2, 1)), np.tile(covariance, (2, 1, 1)), scratch.turned, scratch.reach,
        scratch.found, scratch.solid_count,
        scratch.near, scratch.here, scratch.here_count, scratch.missing, scratch.known,
        sky is not None, scratch.sky,
    )  # fmt: skip
    if sky is not None:
        sight.sky[:, : LATTICE.stations, :LAYERS, :CELLS] = sky
    for i in range(2):
        sight.reach[i] = largest_reach(covariance, SEARCH.margins.k, need)
        sight.solid_count[i] = gather(
            boxes, 0, len(shapes), -10.0, 50.0, -30.0, 30.0, sight.reach[i], sight.found[i]
        )
        look(sight, boxes, i)
        list_here(sight, i, LATTICE)
    return sight


@pytest.mark.parametrize("room", [400, 3, 1])
def test_solids_in_a_window_are_found_without_looking_at_all(room: int) -> None:
    """Two scenes of 400, one of them with a wall 60 m long; with too little room, those of smallest index."""
    rng = np.random.default_rng(3)
    scenes: list[list[Shape]] = [
        [Sphere(tuple(rng.uniform(-200.0, 200.0, 3)), rng.uniform(0.5, 6.0)) for _ in range(400)]
        for _ in range(2)
    ]
    scenes[1][211] = Box((30.0, 5.0, 0.0), (60.0, 1.0, 4.0))
    obstacles = ObstacleSet.stack([ObstacleSet.from_shapes(scene) for scene in scenes])
    path = PathFrame.from_angles((3.0, 2.0, 1.0), 0.4, 0.1)
    boxes, starts = solid_boxes(obstacles, path), obstacles.scene_start
    found = np.empty(room, dtype=np.int64)
    for scene, _ in product(range(2), range(40)):
        along, left = rng.uniform(-220.0, 220.0, 2)
        reach = rng.uniform(0.0, 9.0)
        inside = (
            (boxes.high[:, 0] >= along - reach) & (boxes.low[:, 0] <= along + 48.0 + reach)
            & (boxes.high[:, 1] >= left - 30.0 - reach) & (boxes.low[:, 1] <= left + 30.0 + reach)
        )  # fmt: skip
        wanted = np.flatnonzero(inside)
        wanted = wanted[(wanted >= starts[scene]) & (wanted < starts[scene + 1])][:room]
        count = gather(
            boxes,
            starts[scene],
            starts[scene + 1],
            along,
            along + 48.0,
            left - 30.0,
            left + 30.0,
            reach,
            found,
        )
        np.testing.assert_array_equal(found[:count], wanted)


def all_missing(sight: Sight, shapes: list[Shape], path: PathFrame, i: int) -> Array:
    """Shortfalls (station, layer, cell) from every solid at every place."""
    boxes = solid_boxes(ObstacleSet.from_shapes(shapes), path)
    out = np.zeros((LATTICE.stations, LAYERS, CELLS))
    for solid, s in product(range(len(shapes)), range(LATTICE.stations)):
        middle = 0.5 * (boxes.low[solid, 0] + boxes.high[solid, 0])
        at = sight.along[i] + s * LATTICE.step_m
        if boxes.high[solid, 0] - middle + sight.reach[i] < LATTICE.step_m:
            at = np.clip(middle, at - 0.5 * LATTICE.step_m, at + 0.5 * LATTICE.step_m)
        elif isinstance(shapes[solid], Box):
            # Beside an edge a place stands for what is between it and the next, unless its reach is a step.
            part = min(0.5 * LATTICE.step_m, max(LATTICE.step_m - sight.reach[i], 0.0))
            nearest = np.clip(at, boxes.low[solid, 0], boxes.high[solid, 0])
            at = np.clip(nearest, at - part, at + part)
        for v, c in product(range(LAYERS), range(CELLS)):
            left = LANE[0] + (c - LATTICE.half) * LATTICE.cell_m
            up = LANE[1] + (v - BELOW) * LATTICE.layer_m
            short, _, _, distance = shortfall(
                sight.solids,
                solid,
                sight.frame,
                at,
                left,
                up,
                sight.covariance[i],
                sight.margins.k,
                sight.need_m,
            )
            if distance < sight.radius_m:
                short = max(short, TOUCHING_M)
            out[s, v, c] = max(out[s, v, c], short)
    return out


def exhaustive(
    node: Array, start: tuple[int, int], weight: float, aside: float, prices: Prices = PRICES
) -> float:
    """Least price through node prices (station, layer, cell), every place and step tried."""
    step, cell, layer = LATTICE.step_m, LATTICE.cell_m, LATTICE.layer_m
    value = np.full(node.shape[1:], np.inf)
    value[start] = node[0][start]
    if aside >= 0.0:
        v0, c0 = start
        for v, c in product(range(LAYERS), range(CELLS)):
            column = node[0, min(v0, v) : max(v0, v) + 1, c0].sum()
            row = node[0, v, min(c0, c) : max(c0, c) + 1].sum() - node[0, v, c0]
            value[v, c] = column + row + weight * aside * (abs(v - v0) * layer + abs(c - c0) * cell)
    for s in range(1, LATTICE.stations):
        padded = np.pad(value, ((1, 1), (2, 2)), constant_values=np.inf)
        best = np.full_like(value, np.inf)
        for dv, dc in product(range(-1, 2), range(-2, 3)):
            square = (dc * cell) ** 2 + (dv * layer) ** 2
            aside = cell * np.abs(np.arange(CELLS) - LATTICE.half)  # of the place that the step leads to
            limits = np.where(aside > prices.far_m, prices.steep_far, prices.steep)
            factor = np.array([steep(math.sqrt(square) / step, float(limit)) for limit in limits])
            edge = weight * prices.slope * factor * square / step
            best = np.minimum(best, padded[1 - dv : 1 - dv + LAYERS, 2 - dc : 2 - dc + CELLS] + edge)
        value = best + node[s]
    return float(value.min())


def node_prices(sight: Sight, query: Query, missing: list[Array]) -> Array:
    out = np.zeros((LATTICE.stations, LAYERS, CELLS))
    for s, v, c in product(range(LATTICE.stations), range(LAYERS), range(CELLS)):
        place = np.array([(c - LATTICE.half) * LATTICE.cell_m, (v - BELOW) * LATTICE.layer_m])
        keep = PRICES.keep * (1.0 - s / LATTICE.stations)
        f = LATTICE.fine * s
        for i in range(query.first, query.stop):
            price = PRICES.path * bent(float(place @ place), PRICES.far_m)
            price += query.shape * bent(float(((place - query.mean[f]) ** 2).sum()), PRICES.far_m)
            price += keep * min(float(((place - query.last[i, f]) ** 2).sum()), PRICES.keep_m**2)
            price += missing_price(float(missing[i][s, v, c]), PRICES)
            if sight.has_sky:
                price += float(sight.sky[i, s, v, c])
            if s > 0 and query.stop - query.first == 1:
                for j in range(i):
                    gap = np.array([sight.along[i] - sight.along[j], *(place - query.chosen[j, s])])
                    lack = max(0.0, query.separation[i, j] - float(np.linalg.norm(gap)))
                    price += PRICES.apart * lack**2
            out[s, v, c] += LATTICE.step_m * price
    return out


def bench(prices: Prices = PRICES) -> Bench:
    made = make_scratch(2, 2 * LATTICE.stations - 1, 4, SEARCH).bench
    bend_offsets(LATTICE, BELOW, LAYERS, prices, made.bend)
    price_ahead(LATTICE, prices.path, prices.slope, made.ahead)
    return made


@pytest.mark.parametrize("path", [LEVEL, CLIMBING])
def test_shortfalls_are_those_of_every_solid_in_whatever_order_they_are_asked_for(path: PathFrame) -> None:
    shapes = scene(1, path, 8)
    root = np.array([[0.5, 0.1, 0.0], [0.0, 0.7, 0.2], [0.0, 0.0, 0.9]])
    sight = seen(shapes, path, root @ root.T)
    wanted = all_missing(sight, shapes, path, 0)
    assert (wanted > 0.0).sum() > 500
    for s, v in product(range(LATTICE.stations), range(LAYERS)):
        for low, high in ((9, 10), (14, 15), (3, 12), (0, CELLS - 1)):
            cover(sight, 0, LATTICE, BELOW, s, v, v, low, high)
    got = sight.missing[0, : LATTICE.stations, :LAYERS, :CELLS]
    np.testing.assert_allclose(got, wanted, atol=1e-9)


@pytest.mark.parametrize("most_sky", [0.0, 40.0, 1300.0])
@pytest.mark.parametrize("aside", [-1.0, PRICES.aside])
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_what_is_left_out_was_not_cheaper(seed: int, aside: float, most_sky: float) -> None:
    rng = np.random.default_rng(seed)
    shapes = scene(seed, LEVEL, 4 * seed)
    sky = np.random.default_rng(90 + seed).uniform(0.0, most_sky, (2, LATTICE.stations, LAYERS, CELLS))
    sight = seen(shapes, LEVEL, np.eye(3) * 0.3**2, sky if most_sky > 0.0 else None)
    missing = [all_missing(sight, shapes, LEVEL, i) for i in range(2)]
    fine = 2 * LATTICE.stations - 1
    last = np.cumsum(rng.normal(0.0, 0.3, (2, fine, 2)), axis=1)
    chosen = np.zeros((2, LATTICE.stations, 2))
    offset = rng.uniform(-3.0, 3.0, 2)
    start = (round(offset[1] / LATTICE.layer_m) + BELOW, round(offset[0] / LATTICE.cell_m) + LATTICE.half)
    separation = np.full((2, 2), 5.0)
    mean = last.mean(0)
    for query in (
        Query(0, 1, PRICES.shape, mean, last, chosen, separation, False, aside),
        Query(1, 2, PRICES.shape, mean, last, chosen, separation, True, aside),
        Query(0, 2, 0.0, mean, last, chosen, separation, False, aside),
    ):
        profile = np.empty((LATTICE.stations, 2))
        price = cheapest_profile(sight, LATTICE, BELOW, LAYERS, PRICES, query, bench(), offset, 0.0, profile)
        node = node_prices(sight, query, missing)
        assert price == pytest.approx(exhaustive(node, start, query.stop - query.first, aside), rel=1e-9)
        for paid in (1e-12, 0.2 * price, 0.9 * price, price, 3.0 * price, 1e9):
            # A guess at the price, too low, right or too high, changes nothing.
            same = np.empty((LATTICE.stations, 2))
            found = cheapest_profile(
                sight, LATTICE, BELOW, LAYERS, PRICES, query, bench(), offset, paid, same
            )  # fmt: skip
            assert found == price
            np.testing.assert_array_equal(same, profile)
        if query.first == 0 and query.stop == 1:
            chosen[0] = profile


@pytest.mark.parametrize(("prices", "part"), [(GENTLE, 0.3), (PRICES, 0.08)])
def test_nothing_costs_less_than_the_price_ahead_says(prices: Prices, part: float) -> None:
    """Where nothing is in the way: bound and least price, from every offset."""
    made = bench(prices)
    own = LATTICE.step_m * prices.path * made.bend[:LAYERS, :CELLS]
    node = np.concatenate([np.zeros((1, LAYERS, CELLS)), np.tile(own, (LATTICE.stations - 1, 1, 1))])
    for cell in range(0, CELLS, 3):
        least = exhaustive(node, (BELOW, cell), 1.0, -1.0, prices)
        assert part * least < made.ahead[0] * made.bend[BELOW, cell] + 1e-9 <= least + 2e-9


def test_the_wide_lattice_has_the_same_shapes_and_twice_as_large() -> None:
    """A profile of twice the size costs four times as much a metre there, in slopes and bends.

    They have to grow alike, or a wide margin would be passed in a sharper turn than a narrow one. Offsets
    have a price of their own there.
    """
    one, two, wide = SEARCH.prices, SEARCH.wide_prices, SEARCH.wide
    assert wide.step_m == pytest.approx(2.0 * LATTICE.step_m)
    assert wide.cell_m == pytest.approx(2.0 * LATTICE.cell_m)
    rng = np.random.default_rng(4)
    for _ in range(20):
        offset = np.cumsum(rng.normal(0.0, 1.5, (12, 2)), axis=0)
        offset[0] *= 20.0 * rng.random()  # some far out

        def price(profile: Array, step: float, by: Prices) -> Array:
            """Offsets, slopes and bends, each per metre and summed over the stations (3,)."""
            slope = np.diff(profile, axis=0) / step
            bend = np.diff(slope, axis=0) / step
            size = np.linalg.norm(slope, axis=-1)
            return step * np.array(
                [
                    sum(by.path * bent(float(at @ at), by.far_m) for at in profile),
                    sum(
                        by.slope * steep(float(each), steep_limit(float(at[0]), by)) * each**2
                        for each, at in zip(size, profile[1:], strict=True)
                    ),
                    by.bend * (bend**2).sum(),
                ]
            )

        narrow = price(offset, LATTICE.step_m, one)
        assert (narrow > 0.0).all()
        dearer = np.array([two.path / one.path, 1.0, 1.0])
        np.testing.assert_allclose(price(2.0 * offset, wide.step_m, two), 8.0 * dearer * narrow, rtol=1e-12)
