"""Copies of planners under way, as for what-if flights: they go on as the original."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from napf_mpc import NavSolution, Problem, load_problem
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.planners.mpc import QpPlanner
from napf_mpc.planners.planner import Planner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import FormationMission
from napf_mpc.solvers.batch import make_batch_solver
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Sphere


@pytest.fixture(scope="module")
def problem() -> Problem:
    return load_problem("study_8s", {"planner.k": 2.0})


def told(problem: Problem, step: int) -> NavSolution:
    """Cruise along the lanes, towards the sphere of :func:`under_way`."""
    assert isinstance(problem.mission, FormationMission)
    frame = PathFrame.of_mission(problem.mission)
    along = np.array([8.0 + 0.2 * step, 0.0, 0.0])
    position = frame.to_world(formation_offsets(problem.formation) + along)[None]
    covariance = np.zeros((1, len(position[0]), 6, 6))
    covariance[:] = np.diag([0.25, 0.25, 0.25, 0.01, 0.01, 0.01])
    still = np.zeros(position.shape)
    cruise = still + np.array([2.0, 0.0, 0.0])
    return NavSolution(
        0.1 * step, np.ones(position.shape[:2], dtype=bool), position, cruise, still, still,
        covariance, np.zeros((*position.shape, 1)),
    )  # fmt: skip


def under_way(planner: Planner, problem: Problem) -> Planner:
    planner.reset(ObstacleSet.from_shapes([Sphere((20.0, 3.0, 0.3), 1.0)]), 1)
    for step in range(5):
        planner.step(told(problem, step), 0.1 * step)
    return planner


@pytest.mark.parametrize("name", ["apf", "napf", "napf_guided", "qp", "qp_unguided"])
def test_a_copy_goes_on_as_the_original(problem: Problem, name: str) -> None:
    original = under_way(make_planner(name, problem), problem)
    twin = copy.deepcopy(original)
    for step in range(5, 8):
        one, other = (planner.step(told(problem, step), 0.1 * step) for planner in (original, twin))
        np.testing.assert_array_equal(one.velocity, other.velocity)
        assert (one.plan is None) == (other.plan is None)
        if one.plan is not None and other.plan is not None:
            np.testing.assert_array_equal(one.plan.states, other.plan.states)


@pytest.mark.parametrize("solver", ["kernel", "osqp"])
def test_an_own_solver_is_copied_along(problem: Problem, solver: str) -> None:
    original = QpPlanner(problem, solver=make_batch_solver(solver))
    under_way(original, problem)
    twin = copy.deepcopy(original)
    for step in range(5, 8):
        one, other = (planner.step(told(problem, step), 0.1 * step) for planner in (original, twin))
        assert one.plan is not None
        assert other.plan is not None
        np.testing.assert_array_equal(one.plan.states, other.plan.states)


def test_a_copy_counts_for_itself(problem: Problem) -> None:
    original = QpPlanner(problem, solver="osqp")
    under_way(original, problem)
    twin = copy.deepcopy(original)
    assert isinstance(twin, QpPlanner)
    twin.step(told(problem, 5), 0.5)
    assert (original.tally.counts["solves_solved"].sum(), twin.tally.counts["solves_solved"].sum()) == (
        20,
        24,
    )
