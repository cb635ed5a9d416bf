"""Guidance that prefers open sky: how far, in metres, it leaves its lanes for a better fix."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.constraints.passage import half_space_margins
from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame
from napf_mpc.navigation.sigma_map import SigmaMap
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners import guide_sky
from napf_mpc.planners.guidance import Guidance
from napf_mpc.planners.guide import Guide
from napf_mpc.planners.guide_settings import GuidanceSettings, search_of
from napf_mpc.planners.guide_sky import NO_FIX_M2, price_sky, sky_field, sky_price
from napf_mpc.planners.planner import Command
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape

Array = NDArray[np.float64]

LANES = np.array([(6.403, 3.0, 0.0), (-6.403, -3.0, 0.0), (3.0, -6.403, 0.0), (-3.0, 6.403, 0.0)])
RADIUS, SIGMA = 0.3, 0.5
SETTINGS = GuidanceSettings()
LEFTS = 2.5 * np.arange(33) - 40.0


def problem(weight: float = 0.0, **keys: Any) -> Problem:
    return load_problem(
        "street_canyon_gnss",
        {
            "planner.covariance": "mapped",
            "planner.open_sky_weight": weight,
            "mission.heading_deg": 0.0,
            **keys,
        },
    )


def sky(squares: Array, runs: int = 1, heading_deg: float = 0.0) -> SigmaMap:
    """Map of the squared errors (left,) of fixes at :data:`LEFTS`, the same all along and at every height."""
    given = problem(**{"mission.heading_deg": heading_deg}).mission
    assert isinstance(given, FormationMission)
    nodes = np.empty((runs, 91, len(LEFTS), 4, 6))
    nodes[:] = squares[:, None, None] / 6.0
    low = np.array([-20.0, LEFTS[0], -10.0])
    return SigmaMap(PathFrame.of_mission(given), low, np.array([2.5, 2.5, 10.0]), nodes)


HALVES = sky(np.clip(40.0 + 2.0 * LEFTS, 20.0, 60.0))
"""Dark on the left, open on the right; between them, over 20 m, 2 m^2 more for each metre to the left."""
EVEN = sky(np.full(len(LEFTS), 40.0))


def guidance(weight: float, shapes: list[Shape] | None = None, runs: int = 1, **keys: Any) -> Guidance:
    made = Guidance(problem(weight, **keys), Inflation(3.0))
    made.reset(ObstacleSet.from_shapes(shapes or []), runs)
    return made


def fly(
    made: Guidance, sigma_map: SigmaMap | None, until_m: float = 80.0, taut: bool = False
) -> tuple[list[Array], list[Guide]]:
    """UAVs at the guide, 2 m/s along and at most so fast aside: places (uav, 3) and guides every 0.1 s."""
    frame = PathFrame.of_mission(made_mission())
    place, guides, places = LANES.copy(), [], []
    for step in range(round(until_m / 0.2)):
        guide = made.step(
            frame.to_world(place)[None], np.tile(np.eye(3) * SIGMA**2, (1, 4, 1, 1)),
            np.ones((1, 4), dtype=bool), 0.1 * step, taut=taut, sigma_map=sigma_map,
        )  # fmt: skip
        places.append(place)
        guides.append(guide)
        offset = guide.at(0.0)[0]
        if taut:
            assert guide.taut is not None
            offset = guide.taut[0, :, 0]
        aside = np.clip(LANES[:, 1:] + offset - place[:, 1:], -0.2, 0.2)
        place = place + np.column_stack([np.full(4, 0.2 * guide.pace[0]), aside])
    return places, guides


def made_mission() -> FormationMission:
    mission = problem().mission
    assert isinstance(mission, FormationMission)
    return mission


def ends(weight: float, sigma_map: SigmaMap | None, **keys: Any) -> Array:
    """Offsets (uav, 2) from the lanes after 80 m."""
    places, _ = fly(guidance(weight, **keys), sigma_map)
    return np.asarray(places[-1][:, 1:] - LANES[:, 1:])


# ------------------------------------------------------------------------------------------ nobody asks


def test_without_a_weight_the_map_is_not_read_and_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes: list[Shape] = [Cylinder((30.0, 3.0), 1.5), Cylinder((45.0, -5.0), 1.5)]
    _, plain = fly(guidance(0.0, shapes), None, taut=True)

    def refuse(sigma_map: SigmaMap) -> None:
        raise AssertionError("looked up")

    monkeypatch.setattr("napf_mpc.planners.guidance.sky_field", refuse)
    _, mapped = fly(guidance(0.0, shapes), HALVES, taut=True)
    for one, other in zip(plain, mapped, strict=True):
        np.testing.assert_array_equal(one.offset, other.offset)
        np.testing.assert_array_equal(one.taut, other.taut)
        np.testing.assert_array_equal(one.pace, other.pace)
    with pytest.raises(AssertionError, match="looked up"):
        fly(guidance(1.0, shapes), HALVES, until_m=1.0)


def test_without_a_map_the_weight_changes_no_bit() -> None:
    shapes: list[Shape] = [Cylinder((30.0, 3.0), 1.5)]
    _, plain = fly(guidance(0.0, shapes), None, taut=True)
    _, weighted = fly(guidance(5.0, shapes), None, taut=True)
    for one, other in zip(plain, weighted, strict=True):
        np.testing.assert_array_equal(one.offset, other.offset)
        np.testing.assert_array_equal(one.taut, other.taut)


def test_under_an_even_sky_nobody_leaves_a_lane_to_the_last_bit() -> None:
    places, _ = fly(guidance(10.0), EVEN)
    for place in places:
        assert (place[:, 1:] == LANES[:, 1:]).all()


# ---------------------------------------------------------------------------------------------- it bends


def test_it_goes_to_the_open_side_and_the_farther_the_more_it_weighs() -> None:
    """Free of all else, weight w and a slope of 2 m^2/m make w metres: the price w 2 y is least with y^2.

    What is gained is bounded, so it becomes less than that.
    """
    means = []
    for weight in (0.5, 1.0, 2.0, 5.0, 10.0):
        offset = ends(weight, HALVES)
        assert (offset[:, 0] < 0.1).all()
        np.testing.assert_allclose(offset[:, 1], 0.0, atol=1e-9)  # there is nothing to fly over
        means.append(-offset[:, 0].mean())
        assert means[-1] < weight
        assert np.abs(offset).max() < 8.0
    assert (np.diff(means) > 0.05).all()
    assert means[0] == pytest.approx(0.45, abs=0.15)
    assert means[-1] > 2.0


def test_the_other_way_round_it_goes_the_other_way() -> None:
    mirrored = sky(np.clip(40.0 - 2.0 * LEFTS, 20.0, 60.0))
    swapped = np.array([1, 0, 3, 2])  # whose lane is on the other side; they fly elsewhere along the path
    right, left = ends(2.0, HALVES), ends(2.0, mirrored)
    np.testing.assert_allclose(left[:, 0].mean(), -right[:, 0].mean(), atol=0.1)
    np.testing.assert_allclose(left[:, 0], -right[swapped, 0], atol=0.3)


def test_one_way_for_all_keeps_the_shape() -> None:
    """An endless slope: everybody gains the same, and gaps between UAVs stay as they are."""
    offset = ends(4.0, sky(np.clip(60.0 + 1.0 * LEFTS, 20.0, 100.0)))
    assert offset[:, 0].max() < -1.0
    assert np.ptp(offset[:, 0]) < 0.1


def test_the_guide_bends_over_time_and_does_not_jump() -> None:
    """It starts where the last plan was, though the best place is metres aside, and once there it stays."""
    made = guidance(10.0)
    made.step(
        LANES[None], np.tile(np.eye(3), (1, 4, 1, 1)), np.ones((1, 4), dtype=bool), 0.0, sigma_map=HALVES
    )
    assert np.abs(made._profiles[0, :, 0]).max() < 0.1
    assert np.abs(made._profiles).max() > 2.0
    _, guides = fly(guidance(2.0), HALVES)
    here = np.array([guide.at(0.0)[0] for guide in guides])
    assert np.abs(np.diff(here, axis=0)).max() < 0.3
    assert max(np.abs(guide.slope(0.0, 2.0)).max() for guide in guides) < 0.6
    assert np.abs(here[-40:] - here[-1]).max() < 0.01


def test_a_taut_way_stays_where_the_sky_is_better_and_comes_back_under_an_even_one() -> None:
    places, guides = fly(guidance(4.0), HALVES, taut=True)
    last = guides[-1]
    assert last.taut is not None
    mean = last.taut[0, :, :10, 0].mean()
    assert mean == pytest.approx(last.offset[0, :, :10, 0].mean(), abs=0.6)
    assert mean < -1.0
    assert (places[-1][:, 1] - LANES[:, 1]).mean() < -1.0
    pillar: list[Shape] = [Cylinder((30.0, 3.0), 1.5)]
    _, under_even = fly(guidance(4.0, pillar), EVEN, until_m=30.0, taut=True)
    _, unasked = fly(guidance(0.0, pillar), None, until_m=30.0, taut=True)
    for one, other in zip(under_even, unasked, strict=True):
        np.testing.assert_allclose(one.taut, other.taut, atol=1e-9)


def test_its_lane_turned_in_the_world_the_guide_is_the_same() -> None:
    turned = {"mission.heading_deg": 70.0}
    made, straight = guidance(2.0, **turned), guidance(2.0)
    there = sky(np.clip(40.0 + 2.0 * LEFTS, 20.0, 60.0), heading_deg=70.0)
    frame, level = there.frame, HALVES.frame
    covariance, trusted = np.tile(np.eye(3) * SIGMA**2, (1, 4, 1, 1)), np.ones((1, 4), dtype=bool)
    one = made.step(frame.to_world(LANES)[None], covariance, trusted, 0.0, sigma_map=there)
    other = straight.step(level.to_world(LANES)[None], covariance, trusted, 0.0, sigma_map=HALVES)
    assert np.abs(one.offset).max() > 0.5
    np.testing.assert_allclose(one.offset, other.offset, atol=1e-6)


# ------------------------------------------------------------------------------------ what it must not do


@pytest.mark.parametrize("taut", [False, True])
@pytest.mark.parametrize("weight", [1.0, 10.0])
def test_a_pillar_on_the_open_side_is_not_hit(weight: float, taut: bool) -> None:
    shapes: list[Shape] = [Cylinder((35.0, -8.0), 1.5), Cylinder((50.0, 0.0), 1.0)]
    made = guidance(weight, shapes)
    places, _ = fly(made, HALVES, taut=taut)
    world = np.array([made._path.to_world(place) for place in places]).reshape(1, -1, 3)
    clearance = made._obstacles.signed_distance(world).min() - RADIUS
    assert clearance > 3.0 * SIGMA - SETTINGS.tolerance_m


def test_a_low_wall_is_climbed_as_without_a_price_and_farther_on_the_open_side() -> None:
    """30 m to both sides, its top 2 m above the lanes; higher up the sky is better, too."""
    wall: list[Shape] = [Box((40.0, 0.0, 11.0), (4.0, 60.0, 22.0))]
    nodes = HALVES.nodes * np.array([1.5, 1.0, 0.6, 0.4])[:, None]
    clearance, left = [], []
    for weight in (0.0, 10.0):
        made = guidance(weight, wall)
        places, _ = fly(made, replace(HALVES, nodes=nodes))
        world = np.array([made._path.to_world(place) for place in places]).reshape(1, -1, 3)
        clearance.append(made._obstacles.signed_distance(world).min() - RADIUS)
        left.append((places[-1][:, 1] - LANES[:, 1]).mean())
    assert clearance[1] > clearance[0] - 0.05 > 1.0
    assert left[1] < -2.0 < left[0]


def test_metre_for_metre_no_sky_outbids_a_breach_that_counts_as_blocked() -> None:
    """From no fix at all to the best fix there is: the price of 0.2 m of breach."""
    squares = np.where(LEFTS > 0.0, np.inf, np.where(LEFTS < 0.0, 0.0, 150.0))
    prices = prices_of(10.0)
    table = table_of(sky(squares), 10.0)
    assert table.min() == 0.0
    assert prices.breach * prices.tolerance_m >= table.max() > 0.8 * prices.breach * prices.tolerance_m


def test_where_there_is_no_fix_the_price_is_finite_and_drives_away() -> None:
    dark = sky(np.where(LEFTS > 1.0, np.inf, 30.0))
    offset = ends(2.0, dark)
    assert np.isfinite(offset).all()
    assert offset[0, 0] < -0.3  # its lane, 3 m to the left, has none
    assert np.abs(offset).max() < 8.0
    nowhere = sky(np.full(len(LEFTS), np.inf))
    assert (ends(2.0, nowhere) == 0.0).all()


def test_a_map_of_another_path_is_refused() -> None:
    with pytest.raises(AssertionError):
        fly(guidance(1.0), sky(np.ones(len(LEFTS)), heading_deg=30.0), until_m=1.0)


def test_a_run_does_not_depend_on_its_block() -> None:
    rng = np.random.default_rng(5)
    nodes = rng.uniform(2.0, 20.0, (3, 91, len(LEFTS), 4, 6))
    nodes[rng.random(nodes.shape[:4]) < 0.05] = np.inf
    shapes = [[Cylinder((20.0, float(rng.uniform(-8.0, 8.0))), 1.0)] for _ in range(3)]
    every = replace(EVEN, nodes=nodes)
    covariance, trusted = np.tile(np.eye(3) * SIGMA**2, (3, 4, 1, 1)), np.ones((3, 4), dtype=bool)
    start = np.repeat(EVEN.frame.to_world(LANES)[None], 3, axis=0)

    def planned(runs: list[int]) -> Array:
        made = Guidance(problem(3.0), Inflation(3.0))
        made.reset(ObstacleSet.stack([ObstacleSet.from_shapes(list(shapes[run])) for run in runs]), len(runs))
        some = replace(every, nodes=nodes[runs])
        for step in range(3):
            guide = made.step(
                start[runs] + np.array([0.8 * step, 0.0, 0.0]), covariance[runs], trusted[runs], 0.4 * step,
                sigma_map=some, taut=True,
            )  # fmt: skip
        assert guide.taut is not None
        return np.concatenate([guide.offset, guide.taut], axis=-1)

    together = planned([0, 1, 2])
    assert np.abs(together).max() > 0.5
    for run in range(3):
        np.testing.assert_array_equal(planned([run])[0], together[run])


# ---------------------------------------------------------------------------------------------- the table


def search(weight: float) -> Any:
    return search_of(SETTINGS, half_space_margins(3.0), RADIUS, weight)


def prices_of(weight: float) -> Any:
    return search(weight).prices


def table_of(sigma_map: SigmaMap, weight: float, lane: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Prices (station, layer, cell), 9 layers from 8 m below to 8 m above."""
    lattice = search(weight).lattice
    table = np.empty((lattice.stations, 9, 2 * lattice.half + 1))
    price_sky(sky_field(sigma_map), 0, 7.3, np.array(lane), lattice, 4, 9, prices_of(weight), table)
    return table


def test_the_price_is_that_of_the_maps_own_variance() -> None:
    """Against :meth:`SigmaMap.variance`, which looks places up in the world."""
    rng = np.random.default_rng(2)
    made = replace(EVEN, nodes=rng.uniform(2.0, 20.0, (1, 91, len(LEFTS), 4, 6)))
    lane, weight = (3.0, -1.0), 0.4
    lattice, prices, table = search(weight).lattice, prices_of(weight), table_of(made, weight, lane)
    s, v, c = np.meshgrid(*(np.arange(n) for n in table.shape), indexing="ij")
    places = np.stack(
        [
            7.3 + s * lattice.step_m, lane[0] + (c - lattice.half) * lattice.cell_m,
            lane[1] + (v - 4) * lattice.layer_m,
        ], axis=-1,
    )  # fmt: skip
    own, lasting = made.variance(made.frame.to_world(places)[None])
    square = (own + lasting)[0].sum(-1)
    more = weight * SETTINGS.path * (square - square[:, 4:5, lattice.half : lattice.half + 1])
    most = prices.sky_most
    wanted = more * most / (np.abs(more) + most)
    wanted -= wanted.min((1, 2), keepdims=True)
    np.testing.assert_allclose(table, wanted, rtol=1e-9, atol=1e-9 * most)
    # In between it is linear, and at the places it is theirs.
    at = sky_price(table, lattice, 4, 9, 6, 2.0, -4.0)
    assert at == pytest.approx(table[3, 2, lattice.half + 2], rel=1e-12)
    between = sky_price(table, lattice, 4, 9, 7, 2.5, -3.0)
    corners = table[3:5, 2:4, lattice.half + 2 : lattice.half + 4]
    assert between == pytest.approx(corners.mean(), rel=1e-12)
    # Beyond its ends it goes on.
    assert sky_price(table, lattice, 4, 9, 48, 99.0, 99.0) == table[-1, -1, -1]


def test_without_a_fix_a_place_counts_as_ten_metres_on_each_axis() -> None:
    assert pytest.approx(10.0) == math.sqrt(NO_FIX_M2 / 3.0)
    assert sky_field(sky(np.full(len(LEFTS), np.inf))).square.max() == NO_FIX_M2
    assert guide_sky.bounded(0.0, 5.0) == 0.0
    assert guide_sky.bounded(-1e12, 5.0) == pytest.approx(-5.0)


# ------------------------------------------------------------------------------------------------ the key


def test_the_key_is_refused_where_nobody_could_pay_it() -> None:
    with pytest.raises(ProblemError, match=r'open_sky_weight = 0.5 reads a sigma map.*"expected" has none'):
        load_problem("street_canyon_gnss", {"planner.open_sky_weight": 0.5})
    with pytest.raises(ProblemError, match=r'navigation.kind = "gnss"'):
        load_problem("study_8s", {"planner.open_sky_weight": 0.5, "planner.covariance": "mapped"})
    with pytest.raises(ProblemError, match=r'open_sky_weight = 0.5 is a price that guidance pays.*"blended"'):
        problem(0.5, **{"planner.guidance": "none"})
    with pytest.raises(ProblemError, match=r"open_sky_weight = -1"):
        problem(-1.0)
    assert problem(0.5, **{"planner.guidance": "none", "planner.kind": "napf_guided"})


@dataclass
class Seen:
    """Keeps where UAVs are."""

    places: list[Array]

    def moved(self, time_s: float, before: Array, after: Array, active: Any) -> None:
        """Nothing is kept of the plant's steps."""

    def ticked(
        self, time_s: float, state: Array, nav: NavSolution, command: Command, inputs: Array, active: Any
    ) -> None:
        """Keep the places (run, uav, 3) [m]."""
        self.places.append(state[..., 0:6:2].copy())


@pytest.mark.parametrize("kind", ["qp", "napf_guided"])
def test_both_planners_that_follow_guidance_pay_it(kind: str) -> None:
    flown = []
    for weight in (0.0, 10.0):
        given = problem(weight, **{"planner.kind": kind, "simulation.time_limit_s": 8.0})
        scenario = build_scenario(given, 3, range(1))
        seen = Seen([])
        closed_loop(given, make_planner(kind, given), scenario, (seen,))
        flown.append(np.array(seen.places))
    assert np.abs(flown[0][-1] - flown[1][-1]).max() > 0.1
