"""Planners of one's own get a name, and what is no planner is refused in words."""

from typing import Any

import pytest

from napf_mpc.block import simulate
from napf_mpc.errors import ProblemError
from napf_mpc.planners import registry
from napf_mpc.planners.potential_field import ApfPlanner
from napf_mpc.planners.registry import make_planner, planner_names, register_planner
from napf_mpc.problem_file import load_problem

PROBLEM = load_problem("table1_8", ["simulation.time_limit_s=1"])


class Mine(ApfPlanner):
    """APF under a name of its own."""

    name = "mine"  # type: ignore[assignment]


class Stepless:
    name = "stepless"

    def reset(self, obstacles: Any, runs: int) -> None:
        pass


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_OWN", {})


def test_a_registered_planner_is_made_by_its_name_for_the_problem() -> None:
    register_planner("mine", Mine)
    planner = make_planner("mine", PROBLEM)
    assert isinstance(planner, Mine)
    assert planner_names() == (*registry.PLANNERS, "mine")
    assert simulate(PROBLEM, "mine", record_every=10).trajectories["planner"][0] == "mine"


@pytest.mark.parametrize("name", ["apf", "qp", "mine"])
def test_a_name_that_is_taken_is_refused(name: str) -> None:
    register_planner("mine", Mine)
    with pytest.raises(ProblemError, match=f'"{name}": a planner of this name exists already'):
        register_planner(name, Mine)


@pytest.mark.parametrize("name", ["", "a,b", " mine", 3, None, "new\nline"])
def test_what_is_no_name_is_refused(name: Any) -> None:
    with pytest.raises(ProblemError, match="must be a text without commas, blanks around it"):
        register_planner(name, Mine)


def test_a_planner_in_place_of_its_factory_is_refused() -> None:
    with pytest.raises(ProblemError, match=r'"mine": the factory is a Mine, must be a class or function'):
        register_planner("mine", Mine(PROBLEM))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (None, '"mine": what its factory makes is a NoneType: it has no name, reset, step'),
        (Stepless(), '"mine": what its factory makes is a Stepless: it has no step'),
        (Mine, '"mine": what its factory makes is the class Mine, not a planner of it: give Mine(problem)'),
    ],
)
def test_a_factory_that_makes_no_planner_is_refused(made: Any, told: str) -> None:
    register_planner("mine", lambda problem: made)
    with pytest.raises(ProblemError) as caught:
        make_planner("mine", PROBLEM)
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("planner", "told"),
    [
        (Mine, "is the class Mine, not a planner of it: give Mine(problem)"),
        (Stepless(), "is a Stepless: it has no step"),
        (None, "is a NoneType: it has no name, reset, step"),
        (["apf"], "is a list: it has no name, reset, step"),
    ],
)
def test_simulate_refuses_what_is_no_planner(planner: Any, told: str) -> None:
    with pytest.raises(ProblemError) as caught:
        simulate(PROBLEM, planner)
    assert told in str(caught.value)


def test_an_unknown_name_is_told_with_those_of_ones_own() -> None:
    register_planner("mine", Mine)
    with pytest.raises(ProblemError, match="qp_unguided, mine; did you mean mine"):
        make_planner("min", PROBLEM)
    with pytest.raises(ProblemError, match=r"planner is a Mine, not a name; .*register_planner"):
        make_planner(Mine(PROBLEM), PROBLEM)  # type: ignore[arg-type]
