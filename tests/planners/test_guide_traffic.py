"""A formation slows for what will cross its way, in metres and seconds."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.block import simulate
from napf_mpc.formation import PathFrame
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners.guidance import Guidance
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.planners.guide_traffic import TrafficPace
from napf_mpc.problem import FormationMission
from napf_mpc.problem_file import load_problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

FRAME = PathFrame.of_mission(FormationMission(length_m=80.0))
SURE = 1e-4
"""Variance of a place that is as good as known [m^2]."""


def tracks(*moving: tuple[list[float], list[float], float], runs: int = 1, variance: float = SURE) -> Tracks:
    """Balls with centre, velocity and radius, the same in all runs."""
    position, velocity, radius = (np.array(part) for part in zip(*moving, strict=True))
    shape = (runs, len(radius))
    return Tracks(
        np.broadcast_to(position, (*shape, 3)),
        np.broadcast_to(velocity, (*shape, 3)),
        np.broadcast_to(variance * np.eye(6), (*shape, 6, 6)),
        radius,
        np.zeros(len(radius), dtype=bool),
        0.0,
    )


def straight(runs: int, uavs: int, offset_m: float = 0.0) -> Guide:
    ahead = np.arange(0.0, 49.0)
    offset = np.zeros((runs, uavs, len(ahead), 2))
    offset[..., ahead >= 4.0, 0] = offset_m
    none = np.zeros((runs, uavs))
    return Guide(ahead, offset, np.ones((runs, uavs)), none.astype(np.int8), none)


def chosen(
    seen: Tracks, guide: Guide | None = None, last: float = 1.0, k: float = 3.0, variance: float = SURE
) -> float:
    """Pace of one UAV at the origin that flies east at 2 m/s."""
    pace = TrafficPace(FRAME, 2.0, 0.3, Inflation(k))
    covariance = variance * np.eye(3)[None, None]
    one = straight(1, 1) if guide is None else guide
    return float(pace.pace(np.zeros((1, 1, 3)), covariance, one, seen, np.array([last]))[0])


def test_it_slows_for_a_ball_that_it_would_meet_and_not_for_one_that_has_passed() -> None:
    """A ball of 1.5 m comes across at 2 m/s: at the same place after 3 s, or there before, or 8 s away."""
    assert chosen(tracks(([6.0, -6.0, 0.0], [0.0, 2.0, 0.0], 1.5))) <= 0.6
    assert chosen(tracks(([6.0, 6.0, 0.0], [0.0, 2.0, 0.0], 1.5))) == 1.0
    assert chosen(tracks(([16.0, -16.0, 0.0], [0.0, 2.0, 0.0], 1.5))) == 1.0


def test_a_way_that_bends_clear_of_it_needs_no_slowing() -> None:
    ball = tracks(([6.0, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0))
    assert chosen(ball) < 1.0
    assert chosen(ball, straight(1, 1, offset_m=2.0)) == 1.0


def test_what_passes_clear_is_given_way_to_if_it_is_uncertain() -> None:
    """It crosses after 4 s, 2.2 m ahead; with a sigma of 2 m on either side k = 3 asks for 6 m."""
    passing = tracks(([11.0, -20.0, 0.0], [0.0, 5.0, 0.0], 0.5))
    unsure = np.zeros((1, 1, 6, 6))
    unsure[..., :3, :3] = 4.0 * np.eye(3)
    assert chosen(passing) == 1.0
    assert chosen(replace(passing, covariance=unsure)) < 1.0
    assert chosen(passing, variance=4.0) < 1.0
    assert chosen(replace(passing, covariance=unsure), variance=4.0, k=0.0) == 1.0


def test_it_never_stops_for_what_stays_in_the_way() -> None:
    assert chosen(tracks(([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], 3.0))) >= 0.2
    assert chosen(tracks(([5.0, 0.0, 0.0], [0.0, 0.0, 0.0], 3.0)), last=0.2) >= 0.2


def test_pace_is_regained() -> None:
    clear = tracks(([-30.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 1.0))
    assert chosen(clear, last=0.2) == 1.0


def test_a_pace_does_not_depend_on_the_other_runs() -> None:
    rng = np.random.default_rng(4)
    runs, uavs = 40, 4
    seen = tracks(
        *([(list(rng.normal(0, 8, 3)), list(rng.normal(0, 3, 3)), 1.0) for _ in range(3)]), runs=runs
    )
    seen = replace(seen, position=seen.position + rng.normal(0.0, 3.0, seen.position.shape))
    position, last = rng.normal(0.0, 6.0, (runs, uavs, 3)), np.ones(runs)
    covariance = np.broadcast_to(0.3 * np.eye(3), (runs, uavs, 3, 3))
    pace = TrafficPace(FRAME, 2.0, 0.3, Inflation(3.0))
    whole = pace.pace(position, covariance, straight(runs, uavs), seen, last)
    assert len(set(whole.tolist())) >= 2
    for run in range(runs):
        part = slice(run, run + 1)
        alone = pace.pace(position[part], covariance[part], straight(1, uavs), seen.of_run(run), last[part])
        assert alone[0] == whole[run]


def test_guidance_slows_all_uavs_alike_and_says_so() -> None:
    problem = load_problem("crossing_traffic")
    guidance = Guidance(problem, Inflation.of_problem(problem))
    guidance.reset(ObstacleSet.empty(), 1)
    slots = guidance._position
    ball = tracks((list(slots[0, 0] + [6.0, -6.0, 0.0]), [0.0, 2.0, 0.0], 1.5))
    covariance, trusted = np.broadcast_to(SURE * np.eye(3), (1, 4, 3, 3)), np.ones((1, 4), dtype=bool)
    free = guidance.step(slots, covariance, trusted, 0.0)
    np.testing.assert_array_equal(free.pace, 1.0)
    np.testing.assert_array_equal(free.reason, Passage.NONE)
    slow = guidance.step(slots, covariance, trusted, 0.4, ball)
    assert 0.2 <= slow.pace[0, 0] < 1.0
    assert len(set(slow.pace[0].tolist())) == 1
    np.testing.assert_array_equal(slow.reason, Passage.WAIT)
    # Between two plans the pace stays.
    np.testing.assert_array_equal(guidance.step(slots, covariance, trusted, 0.5, ball).pace, slow.pace)


@pytest.mark.parametrize("seed", [101, 102])
def test_the_field_alone_is_hit_where_the_guided_one_lets_pass(seed: int) -> None:
    """The vehicle of crossing_traffic at 4 m/s, 20 missions: most are hit, or none, with a metre to spare."""
    problem = load_problem("crossing_traffic", ["mission.length_m=60", "simulation.time_limit_s=50"])
    clear = {
        name: simulate(problem, name, seed=seed, runs=20).score.metrics["min_clearance_m"]
        for name in ("napf", "napf_guided")
    }
    assert (clear["napf"] < 0.0).sum() >= 5
    assert (clear["napf_guided"] > 0.0).all()
    assert np.median(clear["napf_guided"]) > 1.0
