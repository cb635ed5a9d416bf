"""What a planner is told when it is stepped by hand: whatever does not fit is refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from napf_mpc import NavigationError, NavSolution, Problem, load_problem
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners.planner import Planner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import FormationMission
from napf_mpc.world.obstacles import ObstacleSet

PLANNERS = ("apf", "napf", "napf_guided", "qp")


@pytest.fixture(scope="module")
def problem() -> Problem:
    return load_problem("study_8s")


def solution(problem: Problem, runs: int = 1, time_s: float = 0.0) -> NavSolution:
    """Level flight in the slots."""
    assert isinstance(problem.mission, FormationMission)
    slots = PathFrame.of_mission(problem.mission).to_world(formation_offsets(problem.formation))
    position = np.repeat(slots[None], runs, axis=0)
    shape = position.shape[:2]
    covariance = np.zeros((*shape, 6, 6))
    covariance[:] = np.diag([0.25, 0.25, 0.25, 0.01, 0.01, 0.01])
    still = np.zeros((*shape, 3))
    return NavSolution(
        time_s,
        np.ones(shape, dtype=bool),
        position,
        still,
        still,
        still,
        covariance,
        np.zeros((*shape, 3, 1)),
    )


def ready(name: str, problem: Problem, runs: int = 1) -> Planner:
    planner = make_planner(name, problem)
    planner.reset(ObstacleSet.empty(), runs)
    return planner


@pytest.mark.parametrize("name", PLANNERS)
def test_a_solution_that_fits_is_flown(problem: Problem, name: str) -> None:
    command = ready(name, problem).step(solution(problem), 0.0)
    assert not command.holding.any()


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            lambda nav: {"position": nav.position[..., :2]},
            r"position has shape \(1, 4, 2\), must be \(1, 4, 3\)",
        ),
        (lambda nav: {"position": nav.position[0]}, r"position has shape \(4, 3\), must be \(1, 4, 3\)"),
        (
            lambda nav: {"covariance": nav.covariance[..., :3, :3]},
            r"covariance has shape \(1, 4, 3, 3\), must be \(1, 4, 6, 6\)",
        ),
        (
            lambda nav: {"common_factor": nav.common_factor[:, :3]},
            r"common_factor has shape \(1, 3, 3, 1\), must be \(1, 4, 3, 1\)",
        ),
        (
            lambda nav: {"common_factor": nav.common_factor[..., 0]},
            r"common_factor has shape \(1, 4, 3\), must be \(1, 4, 3, rank\)",
        ),
        (
            lambda nav: {"velocity": nav.velocity.tolist()},
            r"velocity is a list, must be an array \(1, 4, 3\)",
        ),
        (lambda nav: {"available": np.ones((1, 4))}, r"available has type float64, must be bool"),
        (lambda nav: {"airborne": np.ones((2, 4), dtype=bool)}, r"airborne has shape \(2, 4\)"),
        (
            lambda nav: {"lasting": np.zeros((1, 4, 3))},
            r"lasting has shape \(1, 4, 3\), must be \(1, 4, 3, 3\)",
        ),
    ],
)
def test_shapes_that_do_not_fit(
    problem: Problem, name: str, changes: Callable[[NavSolution], dict[str, object]], words: str
) -> None:
    nav = solution(problem)
    with pytest.raises(NavigationError, match=words):
        ready(name, problem).step(replace(nav, **changes(nav)), 0.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", PLANNERS)
def test_no_common_factor_at_all(problem: Problem, name: str) -> None:
    nav = replace(solution(problem), common_factor=None)  # type: ignore[arg-type]
    # None stands for what navigation does not tell, but what UAVs share it must.
    with pytest.raises(NavigationError, match="common_factor is a NoneType, must be an array"):
        ready(name, problem).step(nav, 0.0)


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize(("reset", "told"), [(1, 2), (3, 1)])
def test_other_runs_than_those_of_the_reset(problem: Problem, name: str, reset: int, told: int) -> None:
    words = rf"position has shape \({told}, 4, 3\), must be \({reset}, 4, 3\)"
    with pytest.raises(NavigationError, match=words):
        ready(name, problem, reset).step(solution(problem, told), 0.0)


@pytest.mark.parametrize("name", PLANNERS)
def test_a_step_before_any_reset_says_what_is_missing(problem: Problem, name: str) -> None:
    with pytest.raises(NavigationError, match=r"call the planner's reset\(obstacles, runs\) first"):
        make_planner(name, problem).step(solution(problem), 0.0)


@pytest.mark.parametrize("name", PLANNERS)
def test_time_goes_on(problem: Problem, name: str) -> None:
    planner = ready(name, problem)
    planner.step(solution(problem, time_s=2.0), 2.0)
    planner.step(solution(problem, time_s=2.0), 2.0)
    with pytest.raises(
        NavigationError, match=r"time_s = 1\.9, must be finite and not before the last step's 2"
    ):
        planner.step(solution(problem, time_s=1.9), 1.9)
    with pytest.raises(NavigationError, match="time_s = nan"):
        planner.step(solution(problem), float("nan"))
    planner.reset(ObstacleSet.empty(), 1)
    planner.step(solution(problem), 0.0)


@pytest.mark.parametrize("name", PLANNERS)
def test_a_reset_to_what_is_no_map(problem: Problem, name: str) -> None:
    planner = make_planner(name, problem)
    with pytest.raises(TypeError, match="obstacles is a list, must be an ObstacleSet"):
        planner.reset([], 1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="runs = -1, must be >= 0"):
        planner.reset(ObstacleSet.empty(), -1)


def ball(**changes: object) -> Tracks:
    """One ball, seen well."""
    given = {
        "position": np.zeros((1, 1, 3)),
        "velocity": np.zeros((1, 1, 3)),
        "covariance": np.tile(0.01 * np.eye(6), (1, 1, 1, 1)),
        "radius": np.ones(1),
        "upright": np.zeros(1, dtype=bool),
        "acceleration_sigma_mps2": 0.1,
    }
    return Tracks(**(given | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (ball(position=np.full((1, 1, 3), np.nan)), "tracks.position has an entry that is not finite"),
        (ball(radius=np.array([-1.0])), r"tracks.radius = \[-1.0\], must be > 0"),
        (ball(position=np.zeros((2, 1, 3))), r"tracks.position has shape \(2, 1, 3\), must be \(1, 1, 3\)"),
    ],
)
def test_a_lost_track_never_means_that_nothing_is_there(
    problem: Problem, name: str, tracks: Tracks, words: str
) -> None:
    nav = replace(solution(problem), tracks=tracks)
    with pytest.raises(NavigationError, match=words):
        ready(name, problem).step(nav, 0.0)


@pytest.mark.parametrize("name", PLANNERS)
def test_moving_obstacles_without_tracks(name: str) -> None:
    crossing = load_problem("crossing_traffic")
    with pytest.raises(NavigationError, match="tracks is None, but the problem has"):
        ready(name, crossing).step(solution(crossing), 0.0)


@pytest.mark.parametrize("factor", [np.nan, np.inf, 100.0])
def test_more_shared_than_there_is_is_not_trusted(problem: Problem, factor: float) -> None:
    nav = solution(problem)
    shared = np.zeros((1, 4, 3, 1))
    shared[0, :, :, 0] = 0.5  # all of it: the limit
    assert replace(nav, common_factor=shared).trusted().all()
    shared[0, 2, 1, 0] = factor
    np.testing.assert_array_equal(replace(nav, common_factor=shared).trusted()[0], [True, True, False, True])
