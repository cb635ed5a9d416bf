"""Which figures are drawn of what, and that stored results are drawn as they were flown."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from napf_mpc import figures, plot, store
from napf_mpc.campaign import run_campaign
from napf_mpc.errors import DataError, ProblemError
from napf_mpc.figures import draw_comparison, draw_mission, draw_problem, draw_stored
from napf_mpc.mission import fly_mission
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.world.obstacles import ObstacleSet

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 5.0,
}


def brief() -> Problem:
    return load_problem("table1_8", BRIEF)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a campaign of six runs; only to be read."""
    out = tmp_path_factory.mktemp("campaign") / "out"
    run_campaign(brief(), ["apf", "napf"], 6, 2, out, name="brief")
    return out


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a single mission; only to be read."""
    out = tmp_path_factory.mktemp("mission") / "out"
    fly_mission(brief(), "brief", "napf", seed=2, run=1, out=out)
    return out


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[Any, ...]]:
    """Instead of drawing: note what would be drawn."""
    asked: dict[str, tuple[Any, ...]] = {}
    for name in ("run_figures", "animation", "paper_figures", "compare_figures", "paths_overview"):

        def note(*given: Any, name: str = name) -> Any:
            asked[name] = given
            return Path("a.gif") if name == "animation" else [Path(f"{name}.png")]

        monkeypatch.setattr(plot, name, note)
    return asked


def test_a_campaign_is_drawn_with_missions_that_went_well_and_badly(campaign: Path, tmp_path: Path) -> None:
    written = draw_stored(campaign, tmp_path)
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()}
    assert {"compare_risk.png", "compare_trade.svg", "compare_clearance.png", "brief_overview.png"} <= {
        path.name for path in written
    }
    assert all(path.stat().st_size > 1000 for path in written)


def test_a_campaign_that_stopped_by_a_rule_is_drawn_with_the_interval_that_holds(
    campaign: Path, tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    rows, summary = store.read_table(campaign / "runs.parquet"), store.read_json(campaign / "summary.json")
    draw_comparison(brief(), summary, rows, tmp_path)
    assert asked["compare_figures"][0] == summary
    draw_comparison(brief(), summary | {"stopping": {}}, rows, tmp_path)
    for name, part in asked["compare_figures"][0]["planners"].items():
        assert part["collision_risk_high"] == summary["planners"][name]["collision_risk_sequential_high"]
        assert part["collision_risk_low"] == summary["planners"][name]["collision_risk_sequential_low"]


def test_a_mission_is_drawn_from_its_folder(mission: Path, tmp_path: Path) -> None:
    written = draw_stored(mission, tmp_path)
    assert {"brief_napf_paths.png", "brief_napf_uncertainty.svg", "brief_napf_space.png"} <= {
        path.name for path in written
    }


def test_missions_on_the_overview_are_flown_again_to_the_bit(
    campaign: Path, tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    rows, summary = store.read_table(campaign / "runs.parquet"), store.read_json(campaign / "summary.json")
    draw_comparison(brief(), summary, rows, tmp_path)
    _, name, tracks, obstacles_of, missions, _, moving_of = asked["paths_overview"]
    assert name == "brief"
    assert {mission.planner for mission in missions} == {"apf", "napf"}
    for shown in missions:
        ours = (tracks["planner"] == shown.planner) & (tracks["run"] == shown.run)
        flown = fly_mission(brief(), "brief", shown.planner, seed=2, run=shown.run)
        # Every tick was stored, the overview shows those at the planner's rate.
        shown_ticks = np.isin(flown.trajectories["t_s"], tracks["t_s"][ours])
        np.testing.assert_array_equal(tracks["x_m"][ours], flown.trajectories["x_m"][shown_ticks])
        assert obstacles_of(shown.run).shapes() == flown.obstacles.shapes()
        assert moving_of(shown.run) is None


def test_results_that_do_not_fly_as_they_did_are_not_drawn_as_if(
    campaign: Path, tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    rows, summary = store.read_table(campaign / "runs.parquet"), store.read_json(campaign / "summary.json")
    rows["control_effort"] = rows["control_effort"] * (1.0 + 1e-12)
    with pytest.raises(DataError, match=r"does not fly as it did: control_effort = "):
        draw_comparison(brief(), summary, rows, tmp_path)


def test_a_campaign_of_a_fixed_scene_with_trajectories_is_still_a_campaign(
    tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    problem = load_problem("square_8", {"simulation.time_limit_s": 1.0})
    run_campaign(problem, ["apf"], 3, 0, tmp_path / "out", record_every=5)
    draw_stored(tmp_path / "out", tmp_path / "figures")
    assert set(asked) == {"compare_figures", "paths_overview"}


def test_the_scene_that_was_flown_is_the_one_that_is_drawn(
    mission: Path, tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    draw_stored(mission, tmp_path)
    problem, name, tracks, obstacles, planners, _, moving = asked["run_figures"]
    flown = fly_mission(brief(), "brief", "napf", seed=2, run=1)
    assert (problem, name, planners) == (brief(), "brief", ["napf"])
    assert obstacles.shapes() == flown.obstacles.shapes()
    np.testing.assert_array_equal(tracks["x_m"], flown.trajectories["x_m"])
    assert moving is None
    assert "animation" not in asked


def test_an_animation_is_made_when_asked_for(
    mission: Path, tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    written = draw_stored(mission, tmp_path, animated=True)
    assert asked["animation"][3:] == (tmp_path / "brief_napf.gif", "napf", None)
    assert Path("a.gif") in written


def test_a_walk_is_drawn_among_the_obstacles_of_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = load_problem(
        "single_uav", {"world": {"kind": "scatter", "count": 3, "along_range_m": [3.0, 11.0]}}
    )
    flown = fly_mission(problem, "walk", "apf", seed=4, run=5, out=tmp_path / "out")
    drawn = []
    walk_figure = figures.walk_figure

    def noted(problem: Problem, obstacles: ObstacleSet) -> Any:
        drawn.append(obstacles)
        return walk_figure(problem, obstacles)

    monkeypatch.setattr(figures, "walk_figure", noted)
    written = draw_stored(tmp_path / "out", tmp_path / "figures")
    assert {path.name for path in written} == {
        "walk_potential.png", "walk_potential.svg", "walk_walk.png", "walk_walk.svg"
    }  # fmt: skip
    assert drawn[0].shapes() == flown.obstacles.shapes()


def test_a_problem_gets_the_figures_of_the_paper(tmp_path: Path, asked: dict[str, tuple[Any, ...]]) -> None:
    draw_problem(brief(), "brief", 3, tmp_path / "new")
    assert asked["paper_figures"][1:4] == ("brief", 3, tmp_path / "new")
    assert (tmp_path / "new").is_dir()
    with pytest.raises(ProblemError, match="seed = -1"):
        draw_problem(brief(), "brief", -1, tmp_path)
    unknown = load_problem("table1_8", BRIEF | {"planner.solver": "osqpp"})
    with pytest.raises(ProblemError, match=r"planner\.solver: solver 'osqpp' is not known"):
        draw_problem(unknown, "brief", 3, tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("summary.json", None, "holds no summary.json; give a folder that run, compare or montecarlo"),
        ("summary.json", "{", "not a readable JSON file"),
        ("summary.json", "{}", r"its files are not of this version \(no 'problem' in it\); draw it with"),
        ("summary.json", "[]", "its files are not of this version"),
        ("scenario.json", None, "holds no scenario.json, .* give a folder that run, compare or montecarlo"),
        ("scenario.json", '{"problem": {}}', "its files are not of this version"),
        ("runs.parquet", "PAR1", "not a readable Parquet file"),
        ("runs.parquet", None, "not a readable Parquet file"),
    ],
)
def test_a_folder_that_holds_no_results_is_named(
    name: str, text: str | None, told: str, campaign: Path, tmp_path: Path
) -> None:
    shutil.copytree(campaign, tmp_path / "copy")
    path = tmp_path / "copy" / name
    path.unlink()
    if text is not None:
        path.write_text(text)
    with pytest.raises(DataError, match=told) as caught:
        draw_stored(tmp_path / "copy", tmp_path / "figures")
    assert str(tmp_path / "copy") in str(caught.value)


def test_an_empty_table_of_planners_is_no_result(campaign: Path, tmp_path: Path) -> None:
    shutil.copytree(campaign, tmp_path / "copy")
    path = tmp_path / "copy" / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"planners": 3}))
    with pytest.raises(DataError, match="not of this version"):
        draw_stored(tmp_path / "copy", tmp_path / "figures")


def test_a_mission_of_two_planners_is_drawn_for_both(
    tmp_path: Path, asked: dict[str, tuple[Any, ...]]
) -> None:
    flown = fly_mission(brief(), "brief", "napf")
    draw_mission(brief(), "b", flown.trajectories, flown.obstacles, ("apf", "napf"), tmp_path, animated=True)
    assert asked["run_figures"][4] == ["apf", "napf"]
