"""Settings (--set key.path=value) laid over a problem file."""

from typing import Any

import numpy as np
import pytest

from napf_mpc.errors import ProblemError
from napf_mpc.overrides import apply_overrides, nested_deeper, parse_value
from napf_mpc.problem import Lanes, ObstacleList
from napf_mpc.problem_file import load_problem


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2), ("2.5", 2.5), ("true", True), ("[0.5, 2.0]", [0.5, 2.0]), ('"napf"', "napf"),
        ("{ a = 1 }", {"a": 1}), ("napf", "napf"), ("", ""), ("two words", "two words"), ("[1,", "[1,"),
        ("1\nother = 2", "1\nother = 2"), ("[" * 5000, "[" * 5000), ("9" * 5000, "9" * 5000),
    ],
)  # fmt: skip
def test_values_are_toml_or_bare_text(text: str, value: Any) -> None:
    assert parse_value(text) == value
    assert type(parse_value(text)) is type(value)


def test_places_in_tables_and_lists() -> None:
    data: dict[str, Any] = {"world": {"obstacles": [{"radius_m": 1.0}, {"radius_m": 1.0}]}}
    lines = ["world.obstacles[0].radius_m=2", "world.obstacles.1.radius_m = 3", "planner.k=1", "title=a = b"]
    result, faults = apply_overrides(data, lines)
    assert faults == []
    assert result["world"]["obstacles"] == [{"radius_m": 2}, {"radius_m": 3}]
    assert result["planner"] == {"k": 1}
    assert result["title"] == "a = b"
    assert data == {"world": {"obstacles": [{"radius_m": 1.0}, {"radius_m": 1.0}]}}  # left as it was


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("planner.k", "must be key.path=value"),
        ("=3", "must be key.path=value"),
        (".k=3", "must be key.path=value"),
        ("planner..k=3", "must be key.path=value"),
        ("planner.k.=3", "must be key.path=value"),
        ("[0].k=3", "must be key.path=value"),
        ("world.obstacles[-1].radius_m=3", "must be key.path=value"),
        ("world.obstacles[2].radius_m=3", "has 2 entries, counted from 0; there is no 2"),
        ("world.obstacles.radius_m=3", "has 2 entries, counted from 0; there is no radius_m"),
        ("world[0]=3", "world is not a list in the file"),
        ("world.kind.x=3", "world.kind is not a table or list in the file"),
    ],
)
def test_settings_that_fit_nowhere_say_why(line: str, words: str) -> None:
    data = {"world": {"kind": "list", "obstacles": [{}, {}]}}
    _, faults = apply_overrides(data, [line])
    assert len(faults) == 1
    assert words in faults[0]
    assert line.partition("=")[0] in faults[0]


def test_k_and_confidence_take_each_other_out() -> None:
    assert load_problem("table1_8").planner.k == 1.7
    planner = load_problem("table1_8", ["planner.confidence=0.99"]).planner
    assert (planner.k, planner.confidence) == (None, 0.99)
    planner = load_problem("table1_8", {"planner.k": "2"}).planner
    assert (planner.k, planner.confidence) == (2.0, None)
    with pytest.raises(ProblemError, match="exactly one of k and confidence"):
        load_problem("table1_8", ["planner.confidence=0.99", "planner.k=2"])


def test_settings_are_checked_like_the_file() -> None:
    problem = load_problem(
        "table1_8", {"world.count": "3", "world.radius_m": "[1, 1]", "planner.kind": "apf"}
    )
    assert isinstance(problem.world, Lanes)
    assert (problem.world.count, problem.world.radius_m, problem.planner.kind) == (3, (1.0, 1.0), "apf")
    problem = load_problem("square_8", "world.obstacles[7].radius_m=0.25")
    assert isinstance(problem.world, ObstacleList)
    assert problem.world.obstacles[7].radius_m == 0.25
    with pytest.raises(ProblemError) as caught:
        load_problem("table1_8", ["world.cont=3", "planner.k=-1"])
    assert caught.value.problems == [
        "world.cont: unknown key; did you mean world.count?",
        "planner.k = -1: must be >= 0 and <= 20",
    ]


def test_values_of_python_are_taken_as_they_are() -> None:
    problem = load_problem(
        "table1_8", {"planner.k": 2, "world.radius_m": (1.0, 1.5), "title": "3"} | {"title": '"3"'}
    )
    assert (problem.planner.k, problem.world.radius_m, problem.title) == (2.0, (1.0, 1.5), "3")


def test_values_of_numpy_are_taken_as_those_of_python() -> None:
    problem = load_problem(
        "table1_8",
        {
            "planner.horizon": np.int64(10),
            "planner.k": np.float32(2.0),
            "world.radius_m": np.array([1.0, 1.5]),
            "mission.initial_positions_m": np.arange(12.0).reshape(4, 3),
            "world.count": np.array(3),
            "mission": {"length_m": np.float64(90.0), "initial_velocities_mps": [np.zeros(3)] * 4},
        },
    )
    assert (problem.planner.horizon, problem.planner.k, problem.world.radius_m) == (10, 2.0, (1.0, 1.5))
    assert problem.world.count == 3
    assert problem.mission.length_m == 90.0
    assert problem.mission.initial_velocities_mps == ((0.0, 0.0, 0.0),) * 4
    with pytest.raises(ProblemError, match=r"planner\.horizon = 101: must be"):
        load_problem("table1_8", {"planner.horizon": np.int64(101)})


def test_depth_is_measured_without_recursion() -> None:
    deep: Any = 1
    for _ in range(100_000):
        deep = {"a": deep}
    assert nested_deeper(deep, 20)
    assert not nested_deeper({"a": [{"b": [1]}]}, 4)
    assert nested_deeper({"a": [{"b": [1]}]}, 3)
