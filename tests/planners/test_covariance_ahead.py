"""What the filter expects of its covariance, in the hands of the planners: margins, room, shared errors."""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.block import simulate
from napf_mpc.constraints.constraint import Horizon, LinearRows
from napf_mpc.constraints.limits import TiltLimit
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.guidance import guidance_covariance
from napf_mpc.planners.guide import Guide
from napf_mpc.planners.guided_field import GuidedNapfPlanner
from napf_mpc.planners.mpc import QpPlanner, default_constraints
from napf_mpc.planners.plan import stage_grid
from napf_mpc.planners.planner import Command
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem

Array = NDArray[np.float64]
ASKED = pytest.mark.parametrize("asked", ["held", "expected", "propagated"])


def problem(time_limit_s: float, kind: str = "qp", asked: str = "expected", share: float = 0.0) -> Problem:
    """The first seconds of study_8s behind the filter."""
    return load_problem(
        "study_8s",
        {
            "navigation.filter": "kalman",
            "navigation.common_mode_share": share,
            "planner.kind": kind,
            "planner.covariance": asked,
            "simulation.time_limit_s": time_limit_s,
        },
    )


class Watch:
    """Rows that are none of its own business, and a look at every horizon."""

    name = "watch"

    def __init__(self, look: Callable[[Horizon], None]) -> None:
        self.look = look

    def rows(self, horizon: Horizon) -> LinearRows:
        self.look(horizon)
        return TiltLimit(1.0).rows(horizon)


def watched(flown: Problem, look: Callable[[Horizon], None]) -> QpPlanner:
    return QpPlanner(flown, constraints=[*default_constraints(flown), Watch(look)])


@ASKED
def test_the_margin_of_a_stage_is_that_of_the_covariance_then(asked: str) -> None:
    """A flight of 5 s through the filter: 3 sigma 6.5 s ahead grow by 0.3 m if fixes cease."""
    flown = problem(5.0, asked=asked)
    seen: list[Horizon] = []
    simulate(flown, watched(flown, seen.append), seed=101, runs=2)
    sigma = np.sqrt(np.array([np.einsum("...ii->...i", horizon.covariance) for horizon in seen[10:]]))
    grown = 3.0 * (sigma - sigma[:, :, :, :1])
    assert sigma.shape[1:] == (2, 4, 20, 3)
    assert (np.diff(sigma, axis=3) >= -1e-3).all() == (asked != "expected")
    if asked == "held":
        np.testing.assert_array_equal(grown, 0.0)
    elif asked == "expected":
        # The filter's first five seconds: each fix makes it more certain.
        assert grown[..., -1, :].min() < -0.5
        assert grown.max() < 0.3
    else:
        assert 0.2 < np.median(grown[..., -1, :]) < 0.5


def overheard(
    flown: Problem, kind: str
) -> tuple[QpPlanner | GuidedNapfPlanner, list[Array], list[NavSolution]]:
    """A planner, and lists of what its guidance leaves room for and of what it is told, at each step."""
    planner = QpPlanner(flown) if kind == "qp" else GuidedNapfPlanner(flown)
    guidance = planner._guidance if isinstance(planner, QpPlanner) else planner.guidance
    assert guidance is not None
    room: list[Array] = []
    given: list[NavSolution] = []
    step, fly = guidance.step, planner.step

    def guided(position: Array, covariance: Array, *others: object, **named: object) -> Guide:
        room.append(covariance.copy())
        return step(position, covariance, *others, **named)  # type: ignore[arg-type]

    def flying(solution: NavSolution, time_s: float) -> Command:
        given.append(copy.deepcopy(solution))
        return fly(solution, time_s)

    guidance.step = guided  # type: ignore[method-assign, assignment]
    planner.step = flying  # type: ignore[method-assign]
    return planner, room, given


@ASKED
@pytest.mark.parametrize("kind", ["qp", "napf_guided"])
def test_guidance_leaves_room_for_the_sigma_that_is_expected_at_the_end_of_the_horizon(
    kind: str, asked: str
) -> None:
    """The filter's first half second: of its variance three quarters are to be left 6.5 s later."""
    flown = problem(0.5, kind, asked)
    planner, room, given = overheard(flown, kind)
    simulate(flown, planner, seed=101, runs=2)
    now = [np.einsum("...aa->...", nav.position_covariance) for nav in given]
    share = np.einsum("truaa->tru", np.array(room)) / now
    if asked == "expected":
        np.testing.assert_allclose(share, 0.76, atol=0.02)
    else:
        np.testing.assert_allclose(share, 1.0, rtol=1e-9)


@pytest.mark.parametrize("kind", ["qp", "napf_guided"])
def test_with_a_sigma_map_guidance_leaves_room_for_the_place_at_the_end_of_the_planned_way(
    kind: str,
) -> None:
    """Into the street: the walls ahead take satellites, and the room is for what they leave, in metres."""
    flown = load_problem(
        "street_canyon_gnss",
        {"planner.covariance": "mapped", "planner.kind": kind, "simulation.time_limit_s": 4.0},
    )
    planner, room, given = overheard(flown, kind)
    simulate(flown, planner, seed=3, runs=2)
    # The first step has no plan yet: straight ahead at 2 m/s for 6.5 s, fixes with the sigmas on the way.
    nav, times = given[0], np.cumsum(stage_grid(0.1, 20, 6.5))
    assert nav.sigma_map is not None
    heading = np.radians(30.0)
    way = 2.0 * times[:, None] * np.array([np.cos(heading), np.sin(heading), 0.0])
    ahead = nav.position_covariance_ahead(times, True, nav.position[:, :, None] + way)
    np.testing.assert_allclose(room[0], ahead[:, :, -1], rtol=1e-9)
    share = np.einsum("truaa->tru", np.array(room)) / [
        np.einsum("...aa->...", nav.position_covariance) for nav in given
    ]
    sigma = np.sqrt(share)
    assert sigma.max() > 1.1  # somebody is to lose satellites
    assert sigma.min() > 0.4


def test_the_horizons_covariance_is_that_of_the_planned_places_on_the_map() -> None:
    flown = load_problem(
        "street_canyon_gnss", {"planner.covariance": "mapped", "simulation.time_limit_s": 4.0}
    )
    seen: list[Horizon] = []
    planner = watched(flown, seen.append)
    given: list[NavSolution] = []
    fly = planner.step

    def flying(solution: NavSolution, time_s: float) -> Command:
        given.append(solution)
        return fly(solution, time_s)

    planner.step = flying  # type: ignore[method-assign]
    simulate(flown, planner, seed=3, runs=2)
    times = np.cumsum(seen[-1].step_s)
    without = given[-1].position_covariance_ahead(times, True)
    at_places = given[-1].position_covariance_ahead(times, True, seen[-1].position)
    np.testing.assert_allclose(seen[-1].covariance, at_places, rtol=0.05)
    apart = np.sqrt(np.einsum("...aa->...a", seen[-1].covariance / without))
    assert np.abs(apart - 1.0).max() > 0.05


def test_in_an_outage_guidance_leaves_room_for_the_sigma_now() -> None:
    """What is expected then is what no fix ever leads to, and one refused fix is no reason for a detour."""
    flown = problem(0.3)
    planner = QpPlanner(flown)
    given: list[NavSolution] = []
    fly = planner.step

    def flying(solution: NavSolution, time_s: float) -> Command:
        given.append(solution)
        return fly(solution, time_s)

    planner.step = flying  # type: ignore[method-assign]
    simulate(flown, planner, seed=101, runs=2)
    solution = given[-1]
    assert solution.forecast is not None
    everybody = solution.trusted()
    ahead = 0.5 * solution.position_covariance
    used = np.zeros_like(everybody)
    used[0] = True
    lost = replace(solution, forecast=replace(solution.forecast, fixes=used))
    room = guidance_covariance(lost, everybody, ahead)
    np.testing.assert_array_equal(room[0], ahead[0])
    np.testing.assert_array_equal(room[1], solution.position_covariance[1])
    held = guidance_covariance(lost, everybody, None)
    np.testing.assert_array_equal(held, solution.position_covariance)
    nobody = np.zeros_like(everybody)
    np.testing.assert_array_equal(guidance_covariance(lost, nobody, ahead)[0, 0], np.eye(3))


@ASKED
@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_a_shared_error_makes_no_relative_position_more_certain_than_it_is(share: float, asked: str) -> None:
    """Along the horizon the shared part shrinks with the whole: what is left of two UAVs is a covariance."""
    flown = problem(4.0, asked=asked, share=share)
    least: list[float] = []
    largest: list[float] = []

    def look(horizon: Horizon) -> None:
        factor = horizon.common_factor
        assert factor.any()
        cross = factor[:, 0] @ factor[:, 1].transpose(0, 2, 1)
        both = horizon.covariance[:, 0] + horizon.covariance[:, 1]
        relative = both - (cross + cross.transpose(0, 2, 1))[:, None]
        least.append(np.linalg.eigvalsh(relative).min())
        largest.append(np.linalg.eigvalsh(both).max())

    simulate(flown, watched(flown, look), seed=101, runs=2)
    assert len(least) == 40
    assert (np.array(least) >= -1e-9 * np.array(largest)).all()
