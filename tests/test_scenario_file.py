"""Scenes as flown come back from their file as the same solids."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from napf_mpc import scenario_file
from napf_mpc.closed_loop import build_scenario, initial_state
from napf_mpc.errors import DataError
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.scenario_file import read_scenes, scenes_of, shape_from_json, shape_to_json, write_scenario
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

RING = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
HOLE = np.array([[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]])
SHAPES: list[Shape] = [
    Sphere((1.0, -2.0, 3.5), 0.7),
    Cylinder((1.0, 2.0), 0.5, -1.0, 4.0),
    Cylinder((1.0, 2.0), 0.5, -math.inf, math.inf),
    Cylinder((1.0, 2.0), 0.5, -math.inf, 4.0),
    Box((1.0, 2.0, 3.0), (2.0, 1.0, 4.0), math.radians(30.0)),
    Prism((RING,), 0.0, 5.0),
    Prism((RING, HOLE), 0.0, math.inf),
]
POINTS = np.random.default_rng(2).uniform(-6.0, 6.0, (1, 200, 3))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_solid_comes_back_with_the_same_distances(shape: Shape) -> None:
    text = json.dumps(shape_to_json(shape), allow_nan=False)
    back = ObstacleSet.from_shapes([shape_from_json(json.loads(text))])
    there = ObstacleSet.from_shapes([shape]).signed_distance(POINTS)
    np.testing.assert_allclose(back.signed_distance(POINTS), there, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    "table",
    [
        {},
        {"shape": "torus"},
        {"shape": "sphere"},
        {"shape": "sphere", "centre_m": 3, "radius_m": 1.0},
        {"shape": "sphere", "centre_m": [0.0, 0.0, 0.0], "radius_m": -1.0},
        {"shape": "box", "centre_m": [0.0, 0.0, 0.0], "size_m": [1.0, 1.0, 1.0], "heading_deg": "east"},
        {"shape": "prism", "rings_m": [[[0.0, 0.0]]]},
    ],
)
def test_what_is_no_solid_of_ours_is_refused(table: dict[str, object]) -> None:
    with pytest.raises(DataError, match="scenario: "):
        shape_from_json(table)


def flown(problem: Problem, seed: int, runs: range) -> ObstacleSet:
    return build_scenario(problem, seed, runs).obstacles


@pytest.mark.parametrize("name", ["table1_8", "table1_40c", "street_canyon"])
def test_random_scenes_are_written_run_by_run_as_they_are_flown(name: str, tmp_path: Path) -> None:
    problem, runs = load_problem(name), range(3, 8)
    write_scenario(tmp_path / "scenario.json", problem, 5, runs)
    scenes = read_scenes(tmp_path / "scenario.json")
    assert list(scenes) == list(runs)
    obstacles = flown(problem, 5, runs)
    points = np.random.default_rng(1).uniform((0, -20, -3), (110, 20, 3), (5, 50, 3))
    distances = obstacles.signed_distance(points)
    for i, run in enumerate(runs):
        written = ObstacleSet.from_shapes(scenes[run]).signed_distance(points[i : i + 1])
        np.testing.assert_allclose(written[0], distances[i], rtol=0.0, atol=1e-9)


def test_the_file_says_how_the_flight_starts(tmp_path: Path) -> None:
    problem = load_problem("table1_8")
    write_scenario(tmp_path / "scenario.json", problem, 5, range(2))
    table = json.loads((tmp_path / "scenario.json").read_text())
    assert (table["seed"], table["first_run"], table["runs"]) == (5, 0, 2)
    np.testing.assert_array_equal(table["initial_state"], initial_state(problem))
    assert Problem.model_validate_json(json.dumps(table["problem"])) == problem


def test_a_fixed_scene_is_written_once_for_all_runs(tmp_path: Path) -> None:
    write_scenario(tmp_path / "all.json", load_problem("square_8"), 5, range(300))
    scenes = read_scenes(tmp_path / "all.json")
    assert list(scenes) == [None]
    assert len(scenes[None]) == 8
    write_scenario(tmp_path / "one.json", load_problem("square_8"), 5, range(4, 5))
    assert list(read_scenes(tmp_path / "one.json")) == [4]


def test_a_walk_starts_at_its_place_among_its_obstacles(tmp_path: Path) -> None:
    write_scenario(tmp_path / "walk.json", load_problem("single_uav"), 0, range(1))
    assert json.loads((tmp_path / "walk.json").read_text())["initial_state"] == [[0.0, 0.0, 0.0]]
    assert len(read_scenes(tmp_path / "walk.json")[0]) == 3


def test_large_campaigns_write_their_first_scenes_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenario_file, "MAX_OBSTACLES", 20)
    monkeypatch.setattr(scenario_file, "_BATCH", 4)
    write_scenario(tmp_path / "scenario.json", load_problem("table1_8"), 5, range(1000))
    assert list(read_scenes(tmp_path / "scenario.json")) == [0, 1, 2]
    assert json.loads((tmp_path / "scenario.json").read_text())["runs"] == 1000


def test_scenes_do_not_depend_on_their_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = load_problem("table1_40")
    write_scenario(tmp_path / "a.json", problem, 5, range(9))
    monkeypatch.setattr(scenario_file, "_BATCH", 2)
    write_scenario(tmp_path / "b.json", problem, 5, range(9))
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_scenes_of_a_mission_are_those_that_it_flies_through() -> None:
    problem = load_problem("table1_8")
    ours, theirs = scenes_of(problem, 4, range(2, 4)), flown(problem, 4, range(2, 4))
    for scene in range(2):
        assert ours.shapes(scene) == theirs.shapes(scene)


@pytest.mark.parametrize("text", ["[]", "{}", '{"scenes": 3}', '{"scenes": [{"run": 0}]}'])
def test_a_file_that_is_no_scenario_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "scenario.json").write_text(text)
    with pytest.raises(DataError, match=r"scenario\.json: not a scenario of ours"):
        read_scenes(tmp_path / "scenario.json")
