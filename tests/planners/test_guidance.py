"""Guidance stepped alone: where the virtual structure goes, in metres, and what it says when it cannot."""

import math
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.block import simulate
from napf_mpc.constraints.passage import passage_margins
from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame
from napf_mpc.planners.guidance import Guidance, _largest_sigma, _measure, _note
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.planners.guide_band import Band, solve_band, way_across
from napf_mpc.planners.guide_settings import GuidanceSettings
from napf_mpc.planners.guided_field import STRICT, GuidedNapfPlanner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.safety_distance import Inflation, directional_sigma, rms_sigma
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape, Sphere

Array = NDArray[np.float64]

SLOTS = np.array([(6.403, 3.0, 0.0), (-6.403, -3.0, 0.0), (3.0, -6.403, 0.0), (-3.0, 6.403, 0.0)])
RADIUS = 0.3
K_SIGMA = 1.5
"""k = 3 with a sigma of 0.5 m."""
SETTINGS = GuidanceSettings()
ENDLESS = 1000.0


def problem(**sections: Any) -> Problem:
    given: dict[str, Any] = {
        "vehicle": {"radius_m": RADIUS},
        "formation": {"shape": "square"},
        "mission": {"kind": "formation", "length_m": 150.0},
        "world": {"kind": "empty"},
    }
    return Problem.model_validate(given | sections)


def advanced(along_m: float) -> Array:
    """Places of UAVs in their slots, this far along the path."""
    return np.asarray(SLOTS + np.array([along_m, 0.0, 0.0]))


def isotropic(sigma: float, runs: int = 1) -> Array:
    return np.tile(np.eye(3) * sigma**2, (runs, 4, 1, 1))


def guidance(
    shapes: list[Shape], settings: GuidanceSettings = SETTINGS, k: float = 3.0, **sections: Any
) -> Guidance:
    made = Guidance(problem(**sections), Inflation(k), settings)
    made.reset(ObstacleSet.from_shapes(shapes), 1)
    return made


def follow(
    made: Guidance, *, until_m: float = 110.0, time_limit_s: float = 110.0, sigma: float = 0.5,
    measured: bool = False, origin: Array | float = 0.0,
) -> tuple[list[Array], list[Guide]]:  # fmt: skip
    """UAVs that follow the guide as well as a vehicle of 2 m/s can: places and guides every 0.1 s.

    Places are from the origin, where the mission starts.
    """
    place = advanced(8.0)
    covariance, trusted = isotropic(sigma), np.ones((1, 4), dtype=bool)
    places, guides = [], []
    for step in range(round(10 * time_limit_s)):
        guide = made.step((place + origin)[None], covariance, trusted, 0.1 * step, measured=measured)
        places.append(place)
        guides.append(guide)
        if place[:, 0].min() >= until_m or (guide.reason == Passage.NO_PASSAGE).all():
            break
        error = place[:, 0] - place[:, 0].mean() - SLOTS[:, 0]
        speed = guide.pace[0] * np.clip(2.0 - 0.5 * error, 0.4, 3.0)
        off = SLOTS[:, 1:] + guide.at(0.0)[0] - place[:, 1:]
        aside = speed[:, None] * guide.slope(0.0, 2.0)[0] + off
        aside *= np.minimum(1.0, 2.5 / np.maximum(np.hypot(*aside.T), 1e-9))[:, None]
        place = place + 0.1 * np.column_stack([speed, aside])
    return places, guides


def clearance(made: Guidance, places: list[Array]) -> float:
    """Least distance [m] from the hull of any UAV to any obstacle."""
    return float(made._obstacles.signed_distance(np.concatenate(places)[None]).min()) - RADIUS


def reasons(guides: list[Guide]) -> set[int]:
    return {int(code) for guide in guides for code in np.unique(guide.reason)}


# ------------------------------------------------------------------------------------- where it is free


def test_a_free_lane_is_left_alone_to_the_last_bit() -> None:
    made = guidance([Sphere((60.0, 40.0, 0.0), 2.0)])
    _, guides = follow(made, until_m=60.0)
    for guide in guides:
        assert (guide.offset == 0.0).all()
        assert (guide.pace == 1.0).all()
        assert (guide.reason == Passage.NONE).all()
        assert (guide.breach_m == 0.0).all()


def test_the_guide_starts_where_the_uav_is_and_looks_tens_of_metres_ahead() -> None:
    guide = guidance([]).step(SLOTS[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.0)
    assert guide.ahead_m[0] == 0.0
    assert 30.0 <= guide.ahead_m[-1] <= 60.0
    assert guide.offset.shape == (1, 4, len(guide.ahead_m), 2)


# --------------------------------------------------------------------------------------------- detours


@pytest.mark.parametrize(
    "shape",
    [Cylinder((50.0, 3.0), 1.5), Sphere((50.0, 3.0, 0.0), 1.5), Box((50.0, 3.0, 0.0), (3.0, 3.0, 90.0))],
)
def test_head_on_it_goes_round_one_side_with_its_margin_and_comes_back(shape: Shape) -> None:
    made = guidance([shape])
    places, guides = follow(made)
    assert clearance(made, places) > K_SIGMA - SETTINGS.tolerance_m
    assert np.abs(places[-1][:, 1:] - SLOTS[:, 1:]).max() < 0.2
    assert reasons(guides) == {Passage.NONE, Passage.DETOUR}
    # No farther than it needs: radius, k sigma, spare and some for the solid's own size.
    assert max(np.abs(place[0, 1:] - SLOTS[0, 1:]).max() for place in places) < 1.5 + RADIUS + K_SIGMA + 1.0


def test_measurements_that_were_worse_are_remembered_and_a_filters_forecast_is_believed() -> None:
    """Sigma 2 m for eight seconds, then 0.5 m: the detour is for a mean of 1.8 m, or for 0.5 m."""
    farthest = {}
    for measured in (True, False):
        made = guidance([Cylinder((40.0, 3.0), 1.0)])
        everybody = np.ones((1, 4), dtype=bool)
        for tick in range(21):
            sigma = 2.0 if tick < 20 else 0.5
            guide = made.step(SLOTS[None], isotropic(sigma), everybody, 0.4 * tick, measured=measured)
        farthest[measured] = float(np.abs(guide.offset[0, 0, :, 0]).max())
    mean = 2.0 - 1.5 * (1.0 - math.exp(-0.4 / SETTINGS.memory_s))
    assert farthest[False] == pytest.approx(1.0 + RADIUS + 1.5, abs=1.2)
    assert farthest[True] - farthest[False] == pytest.approx(3.0 * (mean - 0.5), abs=1.0)


@pytest.mark.parametrize("kind", ["qp", "napf_guided"])
def test_planners_remember_sigmas_of_measurements_only(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told, step = [], Guidance.step

    def heard(self: Guidance, *given: Any, measured: bool, **named: Any) -> Guide:
        told.append(measured)
        return step(self, *given, measured=measured, **named)

    monkeypatch.setattr(Guidance, "step", heard)
    for name in ("none", "kalman"):
        short = {"navigation": {"filter": name}, "simulation": {"time_limit_s": 0.5}}
        simulate(load_problem("study_8s", short), kind, seed=1, runs=1)
    assert told == sorted(told, reverse=True)  # first the mission on raw measurements
    assert 0 < sum(told) < len(told)


def test_margins_of_a_passage_let_it_pass_nearer_to_what_is_small_and_round() -> None:
    """An error of 2 m: three quarters of a wall's margin from a small ball, all of it from a post or box."""
    table = passage_margins(Inflation(3.0))
    shapes: list[Shape] = [
        Sphere((40.0, 3.0, 0.0), 0.5),
        Cylinder((40.0, 3.0), 0.5),
        Box((40.0, 3.0, 0.0), (1.0, 1.0, 90.0)),
    ]
    part = []
    for shape in shapes:
        farthest = []
        for margins in (None, table):
            made = Guidance(problem(), Inflation(3.0), margins=margins)
            made.reset(ObstacleSet.from_shapes([shape]), 1)
            guide = made.step(advanced(8.0)[None], isotropic(2.0), np.ones((1, 4), dtype=bool), 0.0)
            assert guide.breach_m.max() < SETTINGS.tolerance_m
            farthest.append(float(np.hypot(*guide.offset[0, 0].T).max()))
        part.append(farthest[1] / farthest[0])
    assert 0.65 < part[0] < 0.85
    assert part[1] == part[2] == 1.0


def test_one_obstacle_moves_one_uav_and_not_the_formation() -> None:
    made = guidance([Cylinder((50.0, 3.5), 1.5)])
    places, _ = follow(made)
    away = np.array([np.abs(place[:, 1] - SLOTS[:, 1]) for place in places]).max(0)
    assert away[0] > 2.0
    assert away[1:].max() < 0.5 * away[0]


def test_a_side_once_taken_is_kept() -> None:
    """An obstacle exactly on the lane, and estimates that shake about it."""
    made = guidance([Cylinder((60.0, 3.0), 1.5)])
    rng = np.random.default_rng(1)
    sides = []
    for step in range(100):
        shaken = advanced(8.0 + 0.4 * step) + rng.normal(0.0, 0.3, (4, 3))
        guide = made.step(shaken[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.4 * step)
        beside = round(60.0 - shaken[0, 0])
        if 3 <= beside < len(guide.ahead_m):
            sides.append(np.sign(guide.offset[0, 0, beside, 0]))
    assert len(sides) > 60
    assert len(set(sides)) == 1


def test_a_wide_wall_is_gone_round() -> None:
    made = guidance([Box((60.0, 0.0, 0.0), (2.0, 40.0, ENDLESS))])
    places, guides = follow(made)
    assert places[-1][:, 0].min() >= 110.0
    assert clearance(made, places) > K_SIGMA - SETTINGS.squeeze_m
    assert Passage.NO_PASSAGE not in reasons(guides)


@pytest.mark.parametrize(("width_m", "passed"), [(70.0, True), (96.0, True), (160.0, False)])
def test_a_tower_wider_than_the_usual_detour_is_gone_round(width_m: float, passed: bool) -> None:
    """Its sides are 35 m and more from the middle of the formation; ways lead 30 m aside, or 60 at most."""
    made = guidance([Box((80.0, 0.0, 0.0), (40.0, width_m, ENDLESS))])
    places, guides = follow(made, until_m=140.0, time_limit_s=160.0)
    assert (Passage.NO_PASSAGE in reasons(guides)) != passed
    assert (places[-1][:, 0].min() >= 140.0) == passed
    assert clearance(made, places) > K_SIGMA - SETTINGS.squeeze_m
    if passed:
        assert np.abs(places[-1][:, 1:] - SLOTS[:, 1:]).max() < 3.0


@pytest.mark.parametrize("width_m", [30.0, 40.0, 48.0])
def test_a_deep_block_is_gone_round_at_its_margin_without_a_hold(width_m: float) -> None:
    """Its corners push firmly: ways that cut them lacked up to a metre and more, and were held before."""
    made = guidance([Box((80.0, 0.0, 0.0), (40.0, width_m, ENDLESS))])
    places, guides = follow(made, until_m=140.0)
    assert places[-1][:, 0].min() >= 140.0
    assert Passage.HOLD not in reasons(guides)
    assert clearance(made, places) > 1.2
    assert max(guide.breach_m.max() for guide in guides) < 0.1


def test_a_small_margin_is_kept_between_two_stations_without_a_hold() -> None:
    """A block that begins between two of them, which are farther apart than 0.86 m reach: its corner was cut
    by 1 m, and the formation held before it with free space all round.
    """
    made = guidance([Box((61.0, -4.0, 0.0), (4.0, 24.0, ENDLESS))])
    places, guides = follow(made, until_m=100.0, sigma=0.02)
    assert places[-1][:, 0].min() >= 100.0
    assert Passage.HOLD not in reasons(guides)
    assert max(guide.breach_m.max() for guide in guides) < 0.1


def test_a_way_that_is_steep_where_the_uav_is_does_not_keep_it_waiting() -> None:
    """A UAV in a hold waits to be where its way is: its way beside it, not at the station behind it."""
    step_m, way = 1.0, np.zeros((1, 1, 6, 2))
    way[0, 0, :, 0] = 0.9 * np.arange(6.0)
    past, offset = np.array([[3.0]]), np.array([[[2.7, 0.0]]])
    found = np.empty((4, 1))
    none, ahead_m = np.array([np.inf]), step_m * np.arange(6.0)
    _measure(np.zeros((1, 1, 6)), way, past, offset, ahead_m, 0.5, none, none, 2, step_m, *found)
    assert found[2, 0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("past_m", [-1e14, 1e14, 1e300])
def test_a_place_beyond_all_measure_is_compared_with_an_end_of_the_way(past_m: float) -> None:
    """A fix of 1e30 m: its station is off by more than the way is long, and must not be looked up in it."""
    way, offset = np.zeros((1, 1, 6, 2)), np.zeros((1, 1, 2))
    way[0, 0, :, 0] = np.arange(6.0)
    found, none = np.empty((4, 1)), np.array([np.inf])
    _measure(
        np.zeros((1, 1, 6)),
        way,
        np.array([[past_m]]),
        offset,
        np.arange(6.0),
        0.5,
        none,
        none,
        2,
        1.0,
        *found,
    )
    assert found[2, 0] == (0.0 if past_m < 0.0 else 5.0)


def test_walls_that_would_be_touched_are_never_let_go_after_a_hold() -> None:
    """A gap of 0.3 m for UAVs of 0.6: with a sigma of 2 cm it lacks less than what is let go of a margin."""
    made = guidance(gap(0.3))
    places, guides = follow(made, sigma=0.02)
    assert (guides[-1].reason == Passage.NO_PASSAGE).all()
    assert places[-1][:, 0].max() < 60.0


def test_the_way_across_makes_up_for_what_a_corner_lacks() -> None:
    """Corner at the origin, places behind it and beside: exactly the distance that is kept, and no more."""
    for along, left in ((1.0, 0.8), (2.0, 0.9), (0.0, 1.0), (1.9, 1.2)):
        distance = math.hypot(along, left)
        moved = left + way_across(2.3 - distance, distance, left / distance)
        assert math.hypot(along, moved) == pytest.approx(2.3)
    assert way_across(1.5, -0.5, 0.5) == pytest.approx(3.0)  # inside nothing better is known


def test_a_row_of_small_things_takes_no_wide_detour() -> None:
    """The wide lattice is coarse: it is for what is large, and all else is planned as ever."""
    made = guidance([Cylinder((70.0, y), 3.0, -ENDLESS, ENDLESS) for y in np.arange(-50.0, 51.0, 5.0)])
    _, guides = follow(made)
    assert Passage.NO_PASSAGE in reasons(guides)
    assert max(np.abs(guide.offset[..., 0]).max() for guide in guides) <= SETTINGS.widest_m + 1.0


def test_a_low_wall_is_climbed() -> None:
    """Top 5 m above the lanes, far too wide to go round."""
    made = guidance([Box((60.0, 0.0, -45.0), (2.0, 400.0, 100.0))])
    places, _ = follow(made)
    over = min(place[i, 2] for place in places for i in range(4) if abs(place[i, 0] - 60.0) < 0.5)
    assert over > 5.0 + RADIUS + K_SIGMA - SETTINGS.squeeze_m
    assert over < 10.0
    assert clearance(made, places) > K_SIGMA - SETTINGS.squeeze_m


def test_nobody_dives_under_what_stands_on_the_ground() -> None:
    made = guidance([Box((60.0, 3.0, 52.0), (4.0, 4.0, 100.0))])  # its base 2 m above the lanes
    places, _ = follow(made)
    assert min(place[:, 2].min() for place in places) > -0.3


def test_a_dead_end_is_not_entered() -> None:
    walls: list[Shape] = [
        Box((70.0, 0.0, 0.0), (2.0, 30.0, ENDLESS)),
        Box((60.0, 14.0, 0.0), (20.0, 2.0, ENDLESS)),
        Box((60.0, -14.0, 0.0), (20.0, 2.0, ENDLESS)),
    ]
    made = guidance(walls)
    places, guides = follow(made)
    assert places[-1][:, 0].min() >= 110.0
    assert Passage.NO_PASSAGE not in reasons(guides)
    assert clearance(made, places) > K_SIGMA - SETTINGS.squeeze_m


# --------------------------------------------------------------------------------- what cannot be passed


def test_an_endless_wall_is_held_before_and_declared_impassable() -> None:
    made = guidance([Box((60.0, 0.0, 0.0), (2.0, 400.0, ENDLESS))])
    places, guides = follow(made)
    assert {Passage.HOLD, Passage.NO_PASSAGE} <= reasons(guides)
    assert (guides[-1].reason == Passage.NO_PASSAGE).all()
    assert (guides[-1].pace == 0.0).all()
    assert clearance(made, places) > K_SIGMA
    held = 0.1 * sum((guide.pace == 0.0).all() for guide in guides)
    assert held == pytest.approx(SETTINGS.hold_limit_s, abs=2.0)


def gap(width_m: float) -> list[Shape]:
    shift = 0.5 * width_m + 100.0
    return [Box((60.0, side * shift, 0.0), (2.0, 200.0, ENDLESS)) for side in (1.0, -1.0)]


def test_a_gap_with_room_is_flown_in_file() -> None:
    made = guidance(gap(2.0 * (RADIUS + K_SIGMA) + 1.0))
    places, guides = follow(made)
    assert clearance(made, places) > K_SIGMA - SETTINGS.tolerance_m - 0.2
    assert Passage.HOLD not in reasons(guides)
    apart = [np.linalg.norm(place[i] - place[j]) for place in places for i in range(4) for j in range(i)]
    assert min(apart) > 2.0


def test_a_gap_too_narrow_for_the_margin_is_refused_or_announced() -> None:
    narrow = gap(2.0 * (RADIUS + K_SIGMA) - 1.0)
    never = guidance(narrow, GuidanceSettings(squeeze_m=0.0))
    places, guides = follow(never)
    assert (guides[-1].reason == Passage.NO_PASSAGE).all()
    assert places[-1][:, 0].max() < 60.0

    after_a_hold = guidance(narrow)
    places, guides = follow(after_a_hold)
    assert places[-1][:, 0].min() >= 110.0
    assert {Passage.HOLD, Passage.SQUEEZE} <= reasons(guides)
    # What is planned is announced; how well it is flown is not guidance's.
    announced = max(float(guide.breach_m.max()) for guide in guides)
    assert announced == pytest.approx(0.5, abs=0.35)
    assert clearance(after_a_hold, places) > K_SIGMA - announced - 0.5


@pytest.mark.parametrize(
    ("settings", "k", "measured", "held"),
    [
        (SETTINGS, 1.0, False, True),
        (SETTINGS, 1.0, True, False),
        (SETTINGS, 3.0, False, False),
        (SETTINGS, 3.0, True, False),
        (STRICT, 1.0, True, True),
    ],
)
def test_a_small_k_makes_raw_measurements_no_steadier_for_the_qp(
    settings: GuidanceSettings, k: float, measured: bool, held: bool
) -> None:
    # 0.8 m too narrow on both sides: above the 0.28 m tolerated for 3 m, below the 2 m for 9 m.
    sigma = 3.0
    made = guidance(gap(2.0 * (RADIUS + k * sigma - 0.8)), settings, k)
    _, guides = follow(made, sigma=sigma, measured=measured)
    assert (Passage.HOLD in reasons(guides)) == held


@pytest.mark.parametrize(
    ("band", "climbs", "aside"),
    [
        (None, True, False),
        ((-20.0, 20.0), True, False),
        ((-20.0, 2.0), False, True),
        ((-1.0, 1.0), False, True),
    ],
)
def test_no_way_leads_out_of_the_altitude_band(
    band: tuple[float, float] | None, climbs: bool, aside: bool
) -> None:
    # A wall three metres above the lanes, with its end 12 m to the right of the rightmost.
    wall = Box((60.0, 30.0, -50.0), (2.0, 96.0, 106.0), 0.0)
    made = guidance([wall], planner={"altitude_m": band})
    places, guides = follow(made)
    offsets = np.concatenate([guide.offset[0].reshape(-1, 2) for guide in guides])
    assert (offsets[:, 1].max() > 3.0) == climbs
    assert (offsets[:, 0].min() < -12.0) == aside
    assert places[-1][:, 0].min() >= 110.0
    if band is not None:
        assert offsets[:, 1].max() <= band[1]
        assert offsets[:, 1].min() >= band[0]
    assert clearance(made, places) > 0.5 * K_SIGMA


def test_spheres_are_passed_above_where_the_band_leaves_no_room_below() -> None:
    made = guidance(
        [Sphere((60.0, y, 0.0), 4.0) for y in (-12.0, -4.0, 4.0, 12.0)], planner={"altitude_m": (0.0, 30.0)}
    )
    _, guides = follow(made)
    heights = np.concatenate([guide.offset[0, ..., 1].ravel() for guide in guides])
    assert heights.max() > 4.0
    assert heights.min() >= -0.1


SLAB = Box((60.0, 0.0, 30.0 - 2.0), (10.0, 400.0, 60.0))
"""Too wide to go round and too high to climb; its bottom is 2 m below a start at zero."""


@pytest.mark.parametrize(
    ("start_m", "band", "under"),
    [
        (12.0, None, True),  # ten metres of air below, by the heights themselves
        (5.0, None, False),  # 3 m of air: less than the margins to slab and ground
        (0.0, None, False),  # nothing says where the ground is
        (0.0, (-20.0, 20.0), True),
        (0.0, (-3.0, 20.0), False),
    ],
)
def test_what_hangs_in_the_air_is_passed_beneath_where_no_ground_is(
    start_m: float, band: tuple[float, float] | None, under: bool
) -> None:
    mission = {"kind": "formation", "length_m": 150.0, "start_m": (0.0, 0.0, start_m)}
    planner = {} if band is None else {"altitude_m": band}
    slab = Box((60.0, 0.0, SLAB.centre_m[2] + start_m), SLAB.size_m)
    made = guidance([slab], mission=mission, planner=planner)
    origin = np.array([0.0, 0.0, start_m])
    places, guides = follow(made, origin=origin)
    assert (places[-1][:, 0].min() >= 110.0) == under
    assert (Passage.NO_PASSAGE in reasons(guides)) != under
    assert clearance(made, [place + origin for place in places]) > K_SIGMA - SETTINGS.squeeze_m
    lowest = min(place[:, 2].min() for place in places)
    floor = -math.inf if band is None and start_m <= 0.0 else -start_m + K_SIGMA if band is None else band[0]
    assert lowest >= floor
    assert (lowest < SLAB.centre_m[2] - 30.0 - K_SIGMA + SETTINGS.squeeze_m) == under


def test_what_stands_is_not_passed_beneath_where_something_hangs() -> None:
    """A skyway between two towers: under it, and not through the ground under a tower."""
    ground = 30.0
    shapes: list[Shape] = [
        Box((60.0, 0.0, 48.0), (8.0, 60.0, 40.0)),  # its bottom 2 m below the lanes
        Box((60.0, 60.0, 30.0), (8.0, 60.0, 60.0)),
        Box((60.0, -60.0, 30.0), (8.0, 60.0, 60.0)),
    ]
    made = guidance(shapes, mission={"kind": "formation", "length_m": 150.0, "start_m": (0.0, 0.0, ground)})
    origin = np.array([0.0, 0.0, ground])
    places, _ = follow(made, origin=origin)
    assert places[-1][:, 0].min() >= 110.0
    beside = [place[i] for place in places for i in range(4) if abs(place[i, 0] - 60.0) < 4.0]
    assert max(abs(place[1]) for place in beside) < 28.0
    assert max(place[2] for place in beside) < -2.0 - RADIUS
    assert clearance(made, [place + origin for place in places]) > K_SIGMA - SETTINGS.squeeze_m


@pytest.mark.parametrize(("start_m", "dives"), [(0.0, True), (20.0, True), (4.0, False)])
def test_spheres_are_passed_above_where_the_ground_leaves_no_room_below(start_m: float, dives: bool) -> None:
    spheres: list[Shape] = [Sphere((60.0, y, start_m + 1.0), 4.0) for y in (-12.0, -4.0, 4.0, 12.0)]
    made = guidance(spheres, mission={"kind": "formation", "length_m": 150.0, "start_m": (0.0, 0.0, start_m)})
    origin = np.array([0.0, 0.0, start_m])
    places, _ = follow(made, origin=origin)
    assert places[-1][:, 0].min() >= 110.0
    assert (min(place[:, 2].min() for place in places) < -2.0) == dives
    assert clearance(made, [place + origin for place in places]) > K_SIGMA - SETTINGS.squeeze_m


@pytest.mark.parametrize(
    ("radius_m", "over_m"), [(15.0, 6.0), (18.0, 7.2), (18.0, 9.0), (22.0, 11.0), (22.0, -11.0)]
)
def test_a_sphere_too_large_to_dive_under_is_passed_beside(radius_m: float, over_m: float) -> None:
    """Its normal points down, but a way down there has not been looked for: who slides under it is stuck."""
    made = guidance([Sphere((60.0, 1.0, over_m), radius_m)])
    places, guides = follow(made)
    assert places[-1][:, 0].min() >= 110.0
    assert Passage.NO_PASSAGE not in reasons(guides)
    assert clearance(made, places) > K_SIGMA - SETTINGS.squeeze_m


def test_a_sphere_too_large_to_climb_over_is_passed_under_where_that_is_near() -> None:
    made = guidance([Sphere((60.0, 0.0, 16.0), 18.0)])  # 2 m of it under the lanes
    places, guides = follow(made)
    assert places[-1][:, 0].min() >= 110.0
    offsets = np.concatenate([guide.offset[0].reshape(-1, 2) for guide in guides])
    assert np.abs(offsets[:, 0]).max() < 3.0
    assert offsets[:, 1].min() == pytest.approx(-2.0 - RADIUS - K_SIGMA - SETTINGS.spare_m, abs=1.0)
    assert clearance(made, places) > K_SIGMA - SETTINGS.squeeze_m


def fast(speed_mps: float) -> Problem:
    """Four UAVs in a line across, 6 m apart, and a gap of 10 m in a wall before them."""
    walls = [
        {"shape": "box", "centre_m": (150.0, y, 0.0), "size_m": (2.0, 100.0, 100.0), "heading_deg": 0.0}
        for y in (-54.0, 56.0)
    ]
    return problem(
        formation={"shape": "line", "count": 4, "spacing_m": 6.0, "bearing_deg": 90.0},
        mission={"kind": "formation", "length_m": 300.0, "speed_mps": speed_mps},
        world={"kind": "list", "obstacles": tuple(walls)},
        navigation={
            "kind": "gauss_markov", "sigma_min_m": 0.3, "sigma_max_m": 1.0, "correlation_time_s": 10.0,
            "sigma_period_s": 20.0, "filter": "kalman",
        },
        simulation={"time_limit_s": 100.0},
    )  # fmt: skip


@pytest.mark.parametrize(("usual_mps", "most", "least"), [(SETTINGS.usual_mps, 0, 0), (math.inf, 10, 3)])
def test_who_is_faster_looks_farther_and_goes_aside_in_time(
    usual_mps: float, most: int, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the lengths of slower formations, whatever the speed, many hit the wall at 10 m/s."""
    monkeypatch.setattr("napf_mpc.planners.guidance.GuidanceSettings", partial(GuidanceSettings, usual_mps))
    flown = simulate(fast(10.0), "qp", seed=7600, runs=10).score
    assert least <= np.count_nonzero(flown.obstacle_contact.any(-1)) <= most
    assert flown.finished.all()


def test_lengths_along_the_path_grow_with_the_speed_beyond_the_usual() -> None:
    assert SETTINGS.at_speed(SETTINGS.usual_mps) is SETTINGS
    twice = SETTINGS.at_speed(2.0 * SETTINGS.usual_mps)
    assert (twice.ahead_m, twice.step_m, twice.stop_m) == (96.0, 4.0, 8.0)
    # One bend, flown by one and at twice the speed over twice the length, costs twice as much as all else.
    rise, length = 3.0, 10.0
    for price, power in ((lambda s: s.slope, 2), (lambda s: s.bend, 4)):
        one = price(SETTINGS) * (rise / length ** (power // 2)) ** 2 * length
        other = price(twice) * (rise / (2.0 * length) ** (power // 2)) ** 2 * 2.0 * length
        assert other == pytest.approx(2.0 * one)


def test_a_hold_ends_when_navigation_gets_better() -> None:
    made = guidance(gap(2.0 * (RADIUS + K_SIGMA) + 0.6), GuidanceSettings(squeeze_m=0.0))
    place = advanced(49.0)  # the first of them 3.6 m before the wall
    trusted = np.ones((1, 4), dtype=bool)
    for step in range(20):
        guide = made.step(place[None], isotropic(1.2), trusted, 0.4 * step)
    assert (guide.reason == Passage.HOLD).all()
    assert (guide.pace == 0.0).all()
    lanes = place[:, 1:].copy()
    for step in range(20, 30):
        guide = made.step(place[None], isotropic(0.5), trusted, 0.4 * step)
        # A UAV that has been sent aside is waited for: they follow.
        place[:, 1:] = lanes + guide.offset[0, :, 0]
    assert (guide.pace > 0.0).all()
    assert Passage.HOLD not in guide.reason


def test_the_others_slow_for_one_left_behind() -> None:
    made = guidance([])
    place = advanced(50.0)
    place[1, 0] -= 12.0
    guide = made.step(place[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.0)
    assert guide.pace[0, 1] == 1.0
    assert (guide.pace[0, [0, 2, 3]] < 0.7).all()
    assert guide.reason[0].tolist() == [Passage.WAIT, Passage.NONE, Passage.WAIT, Passage.WAIT]


# -------------------------------------------------------------------------- frames, trust, blocks of runs


def test_turning_the_world_turns_the_guide() -> None:
    shapes: list[Shape] = [Cylinder((40.0, 3.0), 1.5), Sphere((48.0, -6.0, 0.5), 1.0)]
    plain = guidance(shapes).step(advanced(10.0)[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.0)
    path = PathFrame.from_angles((5.0, -7.0, 2.0), math.pi / 2, 0.0)
    made = guidance(
        [Cylinder((5.0 - 3.0, -7.0 + 40.0), 1.5), Sphere((5.0 + 6.0, -7.0 + 48.0, 2.5), 1.0)],
        mission={"kind": "formation", "length_m": 150.0, "heading_deg": 90.0, "start_m": (5.0, -7.0, 2.0)},
    )
    turned = made.step(path.to_world(advanced(10.0))[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.0)
    np.testing.assert_allclose(turned.offset, plain.offset, atol=1e-6)
    assert np.abs(plain.offset).max() > 2.0


def test_between_plans_all_that_is_asked_moves_with_the_uav() -> None:
    """Offsets, taut ways and how loose they are belong to places in the world, not to distances ahead."""
    made = guidance([Cylinder((40.0, 3.0), 1.5)])
    trusted, flown = np.ones((1, 4), dtype=bool), 0.6
    place = advanced(20.0)
    place[:, 0] = 2.0 * np.round(0.5 * place[:, 0])  # on the stations, so that the first guide is the plan
    first = made.step(place[None], isotropic(0.5), trusted, 0.0, taut=True)
    place = place + np.array([flown, 0.0, 0.0])
    later = made.step(place[None], isotropic(0.5), trusted, 0.3, taut=True)
    ahead = first.ahead_m
    inside = ahead + flown <= ahead[-1]
    assert first.loose is not None
    assert first.taut is not None
    assert later.loose is not None
    assert later.taut is not None
    assert first.room is not None
    assert later.room is not None
    assert first.loose.min() < 0.9
    assert first.room.max() > 1.0
    pairs = [(first.loose, later.loose), (first.room, later.room)]
    pairs += [(first.taut[..., a], later.taut[..., a]) for a in range(2)]
    pairs += [(first.offset[..., a], later.offset[..., a]) for a in range(2)]
    for at_first, at_last in pairs:
        for uav in range(4):
            expected = np.interp(ahead[inside] + flown, ahead, at_first[0, uav])
            np.testing.assert_allclose(at_last[0, uav, inside], expected, atol=1e-9)


def test_taut_ways_are_made_only_where_they_are_asked_for() -> None:
    guide = guidance([]).step(SLOTS[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.0)
    assert guide.taut is None
    assert guide.loose is None


def test_settings_may_be_whole_numbers() -> None:
    """To the compiled search a whole number would be another type, and an error pages long."""
    made = guidance([Cylinder((40.0, 3.0), 1.5)], GuidanceSettings(path=9, keep=1))
    guide = made.step(advanced(20.0)[None], isotropic(0.5), np.ones((1, 4), dtype=bool), 0.0)
    assert np.abs(guide.offset).max() > 1.0


def test_what_is_not_trusted_does_not_reach_the_plan() -> None:
    made = guidance([Cylinder((40.0, 3.0), 1.5)])
    place, covariance = advanced(10.0)[None], isotropic(0.5)
    before = made.step(place, covariance, np.ones((1, 4), dtype=bool), 0.0, taut=True)
    place, covariance = place.copy(), covariance.copy()
    place[0, 2], covariance[0, 2] = np.nan, np.nan
    after = made.step(place, covariance, np.array([[True, True, False, True]]), 0.4, taut=True)
    for field in fields(Guide):
        assert np.isfinite(getattr(after, field.name)).all(), field.name
    np.testing.assert_allclose(after.offset, before.offset, atol=1.0)


def test_a_run_does_not_depend_on_its_block() -> None:
    scene = load_problem("study_40c")
    settings = {"navigation": scene.navigation.model_copy(update={"filter": "kalman"})}
    short = scene.simulation.model_copy(update={"time_limit_s": 25.0})
    case = scene.model_copy(update=settings | {"simulation": short})
    together = simulate(case, "napf_guided", seed=101, runs=range(3), record_every=10).trajectories
    alone = simulate(case, "napf_guided", seed=101, runs=range(1, 2), record_every=10).trajectories
    mine = together["run"] == 1
    assert mine.any()
    for name, column in alone.items():
        np.testing.assert_array_equal(together[name][mine], column, err_msg=name)


def test_a_run_that_has_landed_is_not_planned_for_and_changes_nothing_for_others() -> None:
    block = Guidance(problem(), Inflation(3.0), SETTINGS)
    alone = guidance([Sphere((30.0, 3.0, 0.0), 2.0)])
    block.reset(ObstacleSet.from_shapes([Sphere((30.0, 3.0, 0.0), 2.0)]), 2)
    place, trusted = np.stack([advanced(8.0)] * 2), np.ones((2, 4), dtype=bool)
    flying = np.array([False, True])
    for step in range(3):
        both = block.step(place, isotropic(0.5, 2), trusted, float(step), flying=flying)
        mine = alone.step(place[1:], isotropic(0.5), trusted[1:], float(step))
        np.testing.assert_array_equal(both.offset[1:], mine.offset)
        np.testing.assert_array_equal(both.pace[1:], mine.pace)
        assert np.abs(both.offset[1]).max() > 1.0, "the one that flies goes round"
        assert np.abs(both.offset[0]).max() == 0.0, "the one that has landed is left as it was"


def test_degenerate_starts_are_planned_with_finite_numbers() -> None:
    """On the axis of a cylinder, at the centre of a sphere, all UAVs in one place, far off the lattice."""
    made = guidance([Cylinder((10.0, 3.0), 1.5), Sphere((10.0, -3.0, 0.0), 1.0)])
    trusted = np.ones((1, 4), dtype=bool)
    for step, place in enumerate(
        [
            np.array([(10.0, 3.0, 0.0), (10.0, -3.0, 0.0), (10.0, 3.0, 0.0), (10.0, 3.0, 0.0)]),
            np.tile((10.0, 0.0, 0.0), (4, 1)),
            SLOTS + np.array([0.0, 500.0, -300.0]),
        ]
    ):
        guide = made.step(place[None], isotropic(0.5), trusted, 0.4 * step)
        assert np.isfinite(guide.offset).all()
        assert np.isfinite(guide.pace).all()


# ----------------------------------------------------------------------------------------- planner, parts


def test_the_guided_planner_flies_like_napf_where_nothing_is_in_the_way() -> None:
    case = problem(simulation={"time_limit_s": 20.0})
    flown = [
        simulate(case, name, seed=101, runs=1, record_every=10).trajectories
        for name in ("napf", "napf_guided")
    ]
    for axis in ("x_m", "y_m", "z_m"):
        np.testing.assert_allclose(flown[1][axis], flown[0][axis], atol=1e-9)


def test_the_registry_makes_the_guided_planner() -> None:
    planner = make_planner("napf_guided", problem())
    assert isinstance(planner, GuidedNapfPlanner)
    assert planner.name == "napf_guided"
    assert planner.guidance.settings == STRICT


def test_guidance_needs_a_formation() -> None:
    walk = Problem.model_construct(
        **(problem().__dict__ | {"mission": load_problem("single_uav").mission}),
    )
    with pytest.raises(ProblemError, match="formation"):
        Guidance(walk, Inflation(3.0))


def test_the_band_solver_solves() -> None:
    """Blocks of two, the station before and the one before that, against a dense solution."""
    rng = np.random.default_rng(3)
    stations = 14
    band = Band(*(np.zeros((stations, *width)) for width in ((3,), (), (), (2,), (3,), (4,))))
    band.own[:] = rng.uniform(0.5, 1.0, (stations, 3)) + np.array([10.0, 10.0, 0.0])
    band.one[1:] = rng.normal(size=stations - 1)
    band.two[2:] = rng.normal(size=stations - 2)
    band.right[:] = rng.normal(size=(stations, 2))
    full = np.zeros((2 * stations, 2 * stations))
    for s in range(stations):
        left, up, between = band.own[s]
        full[2 * s : 2 * s + 2, 2 * s : 2 * s + 2] = [[left, between], [between, up]]
        for back, coupling in ((1, band.one[s]), (2, band.two[s])):
            for a in range(2):
                if s >= back:
                    full[2 * s + a, 2 * (s - back) + a] = full[2 * (s - back) + a, 2 * s + a] = coupling
    wanted = np.linalg.solve(full, band.right.ravel())
    solve_band(band)
    np.testing.assert_allclose(band.right.ravel(), wanted, rtol=1e-9, atol=1e-12)


def test_what_is_decided_from_is_measured_as_arrays_would() -> None:
    """Ways with breaches here and there, of three runs; the last keeps all margins."""
    rng, runs, stations, step_m, bends = np.random.default_rng(3), 3, 12, 0.5, 5
    missing = np.maximum(rng.normal(0.0, 1.0, (runs, 4, stations)), 0.0)
    missing[2] = 0.05
    profiles, offset = rng.normal(size=(runs, 4, stations, 2)), rng.normal(size=(runs, 4, 2))
    ahead_m, few, many = step_m * np.arange(float(stations)), rng.uniform(0.1, 0.3, runs), np.full(runs, 1.0)
    past = rng.uniform(0.0, 4.0 * step_m, (runs, 4))
    there = np.array(
        [
            [
                [np.interp(past[run, uav], ahead_m, profiles[run, uav, :, a]) for a in range(2)]
                for uav in range(4)
            ]
            for run in range(runs)
        ]
    )
    breach = np.maximum(missing - 0.1, 0.0)
    worse = breach - np.maximum(breach[..., 0], breach[..., 1])[..., None]
    pieces = np.diff(profiles[:, :, :bends], axis=2) / step_m
    wanted = [
        *(np.where(worse > t[:, None, None], ahead_m, np.inf).min((-1, -2)) for t in (few, many)),
        np.abs(there - offset).max((-1, -2)),
        np.sqrt(pieces[..., 0] ** 2 + pieces[..., 1] ** 2).max((-1, -2)),
    ]
    found = np.empty((4, runs))
    _measure(missing, profiles, past, offset, ahead_m, 0.1, few, many, bends, step_m, *found)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert np.isinf(found[:2, 2]).all()
    assert np.isfinite(found[:2, :2]).all()


def test_the_largest_sigma_of_a_run_is_that_of_its_covariances() -> None:
    root = np.random.default_rng(4).normal(size=(5, 4, 3, 3))
    covariance, sigma = root @ root.swapaxes(-1, -2), np.empty(5)
    _largest_sigma(covariance, sigma)
    np.testing.assert_array_equal(sigma, rms_sigma(covariance).max(-1))


def test_what_is_trusted_is_noted_and_placed_on_the_path() -> None:
    path, rng = PathFrame.from_angles((1.0, 2.0, 3.0), 0.7, 0.1), np.random.default_rng(5)
    (position, known), root = rng.normal(size=(2, 2, 4, 3)), rng.normal(size=(2, 2, 4, 3, 3))
    covariance, known_covariance = root @ root.swapaxes(-1, -2)
    trusted = rng.random((2, 4)) < 0.5
    assert trusted.any()
    assert not trusted.all()
    wanted = np.where(trusted[..., None], position, known)
    certain = np.where(trusted[..., None, None], covariance, known_covariance)
    position[~trusted], covariance[~trusted] = np.nan, np.nan
    place, (along, sigma) = np.empty((2, 4, 3)), np.empty((2, 2, 4))
    _note(position, covariance, trusted, path.origin, path.axes, known, known_covariance, place, along, sigma)
    np.testing.assert_array_equal(known, wanted)
    np.testing.assert_array_equal(known_covariance, certain)
    np.testing.assert_array_equal(place, path.to_path(wanted))
    np.testing.assert_array_equal(along, place[..., 0])
    np.testing.assert_allclose(sigma, directional_sigma(certain, path.along), rtol=1e-12)
