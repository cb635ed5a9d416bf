"""A mission as a limit state: driven by numbers of one's own it flies as from a seed; nothing is lost."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri

from napf_mpc import store
from napf_mpc.block import simulate
from napf_mpc.campaign import run_campaign
from napf_mpc.closed_loop import Flight, closed_loop
from napf_mpc.errors import DataError, OutputError, ProblemError
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.rare_events import collision, estimate
from napf_mpc.rare_events.collision import LeastClearance
from napf_mpc.rare_events.estimate import estimate_collision_risk, log_normal_interval
from napf_mpc.rare_events.given import DrawnNumbers, GivenNumbers, Layout
from napf_mpc.report import rare_table
from napf_mpc.streams import Stream, generator

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 5.0,
    "simulation.controller_rate_hz": 25.0,
    "planner.rate_hz": 5.0,
    "navigation.rate_hz": 5.0,
}
RARE: dict[str, Any] = {"world.along_range_m": [9.0, 12.0], "world.count": 1, "world.radius_m": [0.3, 0.6]}
"""Settings that make a contact of the brief flight rare: one or two in a hundred."""
UNIFORM = {Stream.SCENE, Stream.SIGMA_PHASE, Stream.OUTAGE, Stream.RECORD_OFFSET}


def brief(**settings: Any) -> Problem:
    return load_problem("table1_8", BRIEF | settings)


def point_of(layout: Layout, seed: int, run: int) -> np.ndarray:
    """The standard-normal numbers that a run of a seed amounts to."""
    point = np.empty(layout.dimension)
    for (stream, uav, axis), place in layout.places.items():
        source, count = generator(seed, run, stream, uav, axis), place.stop - place.start
        point[place] = ndtri(source.random(count)) if stream in UNIFORM else source.standard_normal(count)
    return point


def draws(numbers: Any, run: int = 0) -> np.random.Generator:
    source: np.random.Generator = numbers.generator(run, Stream.OWN_ERROR, 1, 2)
    return source


# ---------------------------------------------------------------------------------------------- the numbers


def test_numbers_given_come_first_then_those_of_the_seed() -> None:
    layout = Layout({(Stream.OWN_ERROR, 1, 2): slice(2, 5)})
    points = np.arange(10.0).reshape(2, 5)
    beyond = generator(7, 0, Stream.OWN_ERROR, 1, 2).standard_normal(3)
    for run in range(2):
        drawn = draws(GivenNumbers(points, layout, 7), run).standard_normal(6)
        np.testing.assert_array_equal(drawn[:3], points[run, 2:])
        np.testing.assert_array_equal(drawn[3:], beyond)
    other = GivenNumbers(points, layout, 7).generator(0, Stream.SCENE, 0, 0).standard_normal(4)
    np.testing.assert_array_equal(other, generator(7, 0, Stream.SCENE).standard_normal(4))


def test_they_come_in_any_shape_and_as_uniform_numbers_below_1() -> None:
    layout = Layout({(Stream.OWN_ERROR, 1, 2): slice(0, 6)})
    numbers = GivenNumbers(np.array([[-1.0, 0.0, 1.0, 9.0, 2.0, 3.0]]), layout, 7)
    source = draws(numbers)
    assert source.random((1, 2)) == pytest.approx(np.array([[0.158655, 0.5]]), abs=1e-6)
    out = np.empty(2)
    source.random(out=out)
    assert out[1] < 1.0
    assert source.standard_normal() == 2.0
    assert source.standard_normal(1) == [3.0]


def test_a_seed_that_is_watched_gives_its_numbers() -> None:
    numbers = DrawnNumbers(7)
    drawn = draws(numbers).standard_normal(4)
    np.testing.assert_array_equal(drawn, generator(7, 0, Stream.OWN_ERROR, 1, 2).standard_normal(4))
    assert numbers.counts() == {(Stream.OWN_ERROR, 1, 2): 4}
    assert numbers.layout({(Stream.OWN_ERROR, 1, 2): 4}, 0.5).dimension == 4
    # In half of the time four more in flight: eight in all of it, and what is drawn ahead.
    assert numbers.layout({}, 0.5).dimension == 8 + 4


# ---------------------------------------------------------------------------------------------- the flights


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {
            "navigation.common_mode_share": 0.5,
            "navigation.outage_interval_s": 2,
            "navigation.outage_duration_s": 1,
        },
        {"navigation.filter": "kalman"},
        {
            "world.moving_rate_hz": 5.0,
            "world.moving": [
                {
                    "shape": "sphere", "start_m": [8.0, 0.0, 5.0], "velocity_mps": [-1.0, 0.0, 0.0],
                    "radius_m": 1.0, "acceleration_sigma_mps2": 0.2,
                }
            ]
        },
    ],
    ids=["plain", "outages", "filter", "moving"],
)  # fmt: skip
def test_the_numbers_of_a_run_give_the_flight_of_that_run(settings: dict[str, Any]) -> None:
    problem = brief(**settings)
    limit = LeastClearance(problem, "napf", seed=1)
    points = np.stack([point_of(limit.layout, 7, run) for run in range(3)])
    flown = simulate(problem, "napf", seed=7, runs=3).score.metrics["min_clearance_m"]
    np.testing.assert_allclose(limit(points), flown, atol=1e-6)


def test_a_clearance_depends_on_its_point_alone() -> None:
    limit = LeastClearance(brief(), "napf")
    points = generator(3, 0, Stream.RARE_EVENT).standard_normal((5, limit.dimension))
    together = limit(points)
    assert len(set(together.tolist())) == 5
    np.testing.assert_array_equal(limit(points[3:]), together[3:])


def test_a_failed_mission_is_not_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is lost has no clearance; NaN must not pass for a large one."""
    limit = LeastClearance(brief(), "napf")
    points = np.zeros((2, limit.dimension))
    assert np.isfinite(limit(points)).all()

    def losing(*given: Any) -> Flight:
        return replace(closed_loop(*given), failed=np.array([True, False]))

    monkeypatch.setattr(collision, "closed_loop", losing)
    assert limit(points).tolist() == [-np.inf, limit(points)[1]]
    assert np.isfinite(limit(points)[1])


def test_without_obstacles_there_is_nothing_to_estimate() -> None:
    problem = load_problem("table1_8", {"world": {"kind": "empty"}, "simulation.time_limit_s": 1.0})
    with pytest.raises(ProblemError, match="has no obstacle"):
        _ = LeastClearance(problem, "napf").layout


# --------------------------------------------------------------------------------------------- the estimate


def test_it_agrees_with_counting(tmp_path: Path) -> None:
    """NAPF at k = 1 in the brief flight; both intervals hold what both estimate."""
    problem = brief(**RARE | {"planner.k": 1.0})
    counted = run_campaign(problem, ["napf"], 1500, 1, tmp_path / "counted")["planners"]["napf"]
    found = estimate_collision_risk(problem, "napf", tmp_path / "rare", samples=300, seed=2)
    assert 0.002 < counted["collision_risk"] < 0.05
    assert len(found["levels"]) > 1
    assert found["collision_risk_low"] < counted["collision_risk_high"]
    assert found["collision_risk_high"] > counted["collision_risk_low"]
    assert 0.5 < found["collision_risk"] / counted["collision_risk"] < 2.0


def few(out: Path, seed: int = 2, **settings: Any) -> dict[str, Any]:
    return estimate_collision_risk(brief(**RARE | settings), "napf", out, samples=40, seed=seed)


def test_it_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = few(tmp_path / "whole")
    stored = [file.read_bytes() for file in sorted((tmp_path / "whole" / "calls").iterdir())]

    class Stop(Exception):
        pass

    fly = LeastClearance.fly
    left = [3]

    def until(limit: LeastClearance, points: np.ndarray) -> np.ndarray:
        left[0] -= 1
        if left[0] < 0:
            raise Stop
        return fly(limit, points)

    monkeypatch.setattr(LeastClearance, "fly", until)
    with pytest.raises(Stop):
        few(tmp_path / "out")
    assert len(list((tmp_path / "out" / "calls").iterdir())) == 3
    left[0] = len(stored) - 3  # not one block is flown twice
    assert few(tmp_path / "out") == whole
    assert [file.read_bytes() for file in sorted((tmp_path / "out" / "calls").iterdir())] == stored
    left[0] = 0
    assert few(tmp_path / "out") == whole
    assert store.read_json(tmp_path / "out" / "summary.json") == whole
    assert len(store.read_table(tmp_path / "out" / "calls.parquet")["call"]) == whole["calls"]


def test_another_problem_seed_or_a_damaged_block_is_refused(tmp_path: Path) -> None:
    few(tmp_path)
    with pytest.raises(OutputError, match="seed = 2, not 3"):
        few(tmp_path, seed=3)
    with pytest.raises(OutputError, match="problem_hash"):
        few(tmp_path, **{"planner.k": 1.0})
    block = tmp_path / "calls" / "calls_00000000.parquet"
    other = tmp_path / "calls" / "calls_00000040.parquet"
    good = block.read_bytes()
    block.write_bytes(good[:100])
    with pytest.raises(DataError, match=r"calls_00000000.parquet: is damaged .* delete it and repeat"):
        few(tmp_path)
    block.write_bytes(other.read_bytes())
    with pytest.raises(DataError, match=r"calls_00000000.parquet: holds missions of other random numbers"):
        few(tmp_path)


def test_more_numbers_than_memory_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "MAX_NUMBERS", 1000)
    with pytest.raises(ProblemError, match="lower --samples or simulation"):
        few(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_table_says_when_nothing_was_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LeastClearance, "fly", lambda limit, points: np.maximum(points[:, 0], 0.0) + 1.0)
    summary = few(tmp_path)
    assert (summary["reached"], summary["collision_risk"], summary["collision_risk_high"]) == (
        False,
        0.0,
        None,
    )
    assert "not reached; below about" in rare_table(summary).markdown()


def test_the_interval_is_that_of_a_log_normal_law() -> None:
    low, high = log_normal_interval(1e-3, 0.5)
    draws = np.random.default_rng(1).lognormal(np.log(1e-3), np.sqrt(np.log(1.25)), 200_000)
    assert np.quantile(draws, [0.025, 0.975]) == pytest.approx([low, high], rel=0.02)
    assert log_normal_interval(0.9, 1.0)[1] == 1.0
