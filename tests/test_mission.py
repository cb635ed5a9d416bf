"""One mission: the same bits as in its campaign, and stored so that anyone can judge it."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from napf_mpc import store
from napf_mpc.campaign import run_campaign
from napf_mpc.errors import OutputError, ProblemError
from napf_mpc.mission import fly_mission
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import read_scenes
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.sweep import SweptClearance

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 5.0,
}


def brief() -> Problem:
    return load_problem("table1_8", BRIEF)


@pytest.mark.parametrize(("planner", "run"), [("apf", 0), ("napf", 6), ("apf", 9)])
def test_a_mission_is_its_row_of_the_campaign_to_the_last_bit(planner: str, run: int, tmp_path: Path) -> None:
    run_campaign(brief(), ["apf", "napf"], 10, 4, tmp_path / "all")
    rows = store.read_table(tmp_path / "all" / "runs.parquet")
    place = (rows["planner"] == planner) & (rows["run"] == run)
    flown = fly_mission(brief(), "brief", planner, seed=4, run=run)
    for name, value in flown.row.items():
        np.testing.assert_array_equal(value, rows[name][place][0], err_msg=name)
    assert flown.summary["run"] == run
    assert flown.summary["planners"][planner]["runs"] == 1
    assert flown.reached == (flown.row["outcome"] == "reached")


def test_a_mission_of_the_qp_planner_is_its_row_of_the_campaign_to_the_last_bit(tmp_path: Path) -> None:
    problem = load_problem("table1_8", BRIEF | {"simulation.time_limit_s": 2.0})
    run_campaign(problem, ["qp"], 3, 4, tmp_path, block_runs=3)
    rows = store.read_table(tmp_path / "runs.parquet")
    flown = fly_mission(problem, "brief", "qp", seed=4, run=1)
    assert flown.row["solves_solved"] > 50
    for name, value in flown.row.items():
        np.testing.assert_array_equal(value, rows[name][1], err_msg=name)


def test_the_verdict_follows_from_the_stored_files_alone(tmp_path: Path) -> None:
    """Every physics step is a tick here, so the stored track is the path that was judged."""
    out = tmp_path / "out"
    flown = fly_mission(brief(), "brief", "apf", seed=4, run=3, out=out)
    track = store.read_table(out / "trajectories.parquet")
    ((run, shapes),) = read_scenes(out / "scenario.json").items()
    assert run == 3
    places = np.stack([track["x_m"], track["y_m"], track["z_m"]], axis=-1).reshape(-1, 1, 4, 3)
    swept = SweptClearance(ObstacleSet.from_shapes(shapes), 1, 4)
    for before, after in pairwise(places):
        swept.update(before, after)
    radius = brief().vehicle.radius_m
    assert int(swept.contact(radius).sum()) == flown.row["uavs_hit"]
    # The flight goes on for one step after the last stored tick.
    assert swept.clearance.min() - radius == pytest.approx(flown.row["min_clearance_m"], abs=0.05)


def test_what_is_stored_is_what_is_returned(tmp_path: Path) -> None:
    flown = fly_mission(brief(), "brief", "napf", out=tmp_path)
    rows = store.read_table(tmp_path / "runs.parquet")
    assert {name: values[0] for name, values in rows.items() if name != "reform_time_s"} == pytest.approx(
        {name: value for name, value in flown.row.items() if name != "reform_time_s"}, nan_ok=True
    )
    assert json.loads((tmp_path / "summary.json").read_text()) == flown.summary
    track = store.read_table(tmp_path / "trajectories.parquet")
    np.testing.assert_array_equal(track["x_m"], flown.trajectories["x_m"])
    assert len(read_scenes(tmp_path / "scenario.json")[0]) == len(flown.obstacles) == 4


def test_a_walk_is_a_mission_too(tmp_path: Path) -> None:
    flown = fly_mission(load_problem("single_uav"), "walk", "apf", out=tmp_path)
    assert flown.reached
    assert flown.summary["planners"]["apf"]["finish_time_s"]["n"] == 0
    assert len(flown.obstacles) == 3
    with pytest.raises(ProblemError, match="cannot walk"):
        fly_mission(load_problem("single_uav"), "walk", "napf")


def test_another_mission_does_not_overwrite_a_stored_one(tmp_path: Path) -> None:
    fly_mission(brief(), "brief", "apf", out=tmp_path)
    before = (tmp_path / "runs.parquet").read_bytes()
    for change, told in (({"run": 1}, "run = 0, not 1"), ({"seed": 1}, "seed = 0, not 1")):
        with pytest.raises(OutputError, match=told):
            fly_mission(brief(), "brief", "apf", out=tmp_path, **change)
    with pytest.raises(OutputError, match="planners = apf, not napf"):
        fly_mission(brief(), "brief", "napf", out=tmp_path)
    assert (tmp_path / "runs.parquet").read_bytes() == before
    fly_mission(brief(), "brief", "apf", out=tmp_path)
    assert (tmp_path / "runs.parquet").read_bytes() == before


@pytest.mark.parametrize("run", [-1, 10_000_000, 2**70])
def test_runs_that_no_campaign_has_are_refused(run: int) -> None:
    with pytest.raises(ProblemError, match="run-index = "):
        fly_mission(brief(), "brief", "apf", run=run)
