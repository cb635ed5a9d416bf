"""What drives the safety distance: k sigma, an overbound, or a protection level; in metres, and flown."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import MissionScore
from napf_mpc.navigation.fix import Fix
from napf_mpc.navigation.integrity.overbound import AxisOverbound, Overbound
from napf_mpc.navigation.recorded import ErrorLog
from napf_mpc.navigation.replay import flown_part
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem, Recorded
from napf_mpc.safety_distance import Inflation

EAST, NORTH, UP = np.eye(3)
OBLIQUE = np.array([0.6, 0.0, 0.8])
BOUND = Overbound(
    (
        AxisOverbound(0.6, 1.5, 100, 30.0),
        AxisOverbound(0.0, 2.0, 100, 30.0),
        AxisOverbound(0.0, 1.0, 100, 30.0),
    ),
    "a log",
)


def solution(**changes: Any) -> NavSolution:
    covariance = np.zeros((1, 2, 6, 6))
    covariance[..., :3, :3] = [[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1.0]]
    covariance[..., 3:, 3:] = 0.01 * np.eye(3)
    covariance[..., 0, 3] = covariance[..., 3, 0] = 0.05
    values: dict[str, Any] = {
        "time_s": 0.0,
        "available": np.ones((1, 2), dtype=bool),
        "position": np.array([[[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]]),
        "velocity": np.zeros((1, 2, 3)),
        "attitude": np.zeros((1, 2, 3)),
        "body_rates": np.zeros((1, 2, 3)),
        "covariance": covariance,
        "common_factor": np.tile(np.diag([1.0, 1.0, 0.0]), (1, 2, 1, 1)),
    }
    return NavSolution(**(values | changes))


def margin(inflation: Inflation, nav: NavSolution, normal: np.ndarray, uav: int = 0) -> float:
    covariance = inflation.informed(nav).position_covariance[0, uav]
    return float(inflation.margin(covariance, normal[None])[0])


def test_k_sigma_is_the_solution_itself() -> None:
    nav = solution(overbound=BOUND, protection=np.full((1, 2, 2), 30.0))
    assert Inflation(3.0).informed(nav) is nav
    for safety in ("overbound", "protection_level"):  # no margin at all asked for: APF
        assert Inflation(0.0, safety=safety).informed(solution()).covariance is not None
    assert margin(Inflation(3.0), nav, EAST) == pytest.approx(6.0)


def test_overbound_margins_are_shift_and_width_in_metres() -> None:
    nav, inflation = solution(overbound=BOUND), Inflation(3.0, safety="overbound")
    assert margin(inflation, nav, EAST) == pytest.approx((0.6 + 3.0 * 1.5) * 2.0)
    assert margin(inflation, nav, NORTH) == pytest.approx(3.0 * 2.0 * 3.0)
    assert margin(inflation, nav, UP) == pytest.approx(3.0)
    seen = inflation.informed(nav)
    # What two UAVs share grows with each of them, so their relative covariance stays one.
    np.testing.assert_allclose(
        np.sqrt(np.diag(seen.relative_covariance(0, 1)[0])),
        np.array([1.7, 2.0, 1.0]) * np.sqrt([2 * 4.0 - 2 * 1.0, 2 * 9.0 - 2 * 1.0, 2 * 1.0]),
    )
    assert seen.covariance[0, 0, 0, 3] == pytest.approx(1.7 * 0.05)
    assert seen.covariance[0, 0, 3, 3] == nav.covariance[0, 0, 3, 3]
    assert np.linalg.eigvalsh(seen.covariance[0, 0]).min() > 0.0


@pytest.mark.parametrize("k", [1.0, 3.0, 5.5])
def test_protection_level_is_the_margin_whatever_k_is(k: float) -> None:
    nav = solution(protection=np.array([[[7.0, 12.0], [20.0, 30.0]]]))
    inflation = Inflation(k, safety="protection_level")
    assert margin(inflation, nav, EAST) == pytest.approx(7.0)
    assert margin(inflation, nav, (EAST + NORTH) / np.sqrt(2.0)) == pytest.approx(7.0)
    assert margin(inflation, nav, UP, uav=1) == pytest.approx(30.0)
    assert margin(inflation, nav, OBLIQUE) == pytest.approx(np.hypot(0.6 * 7.0, 0.8 * 12.0))
    seen = inflation.informed(nav)
    assert seen.trusted().all()
    # Two levels are two bounds: nothing is taken off for what both share.
    assert k * np.sqrt(seen.relative_covariance(0, 1)[0, 0, 0]) == pytest.approx(np.hypot(7.0, 20.0))


@pytest.mark.parametrize("level", [np.nan, np.inf, 0.0, -1.0])
def test_without_a_protection_level_nothing_bounds_the_error(level: float) -> None:
    nav = solution(protection=np.array([[[7.0, level], [20.0, 30.0]]]))
    seen = Inflation(3.0, safety="protection_level").informed(nav)
    assert seen.available.tolist() == [[False, True]]
    assert np.isfinite(seen.covariance).all()


@pytest.mark.parametrize(
    ("safety", "way_out"),
    [("overbound", 'kind = "recorded" with part'), ("protection_level", 'kind = "gnss" with integrity')],
)
def test_navigation_that_does_not_tell_is_an_error(safety: Any, way_out: str) -> None:
    with pytest.raises(ProblemError, match=f'planner.safety: "{safety}" .*{way_out}.* or "k_sigma"'):
        Inflation(3.0, safety=safety).informed(solution())


# ------------------------------------------------------------------------------------------- in problems


def problem(tmp_path: Path, *settings: str, **sections: Any) -> Problem:
    from napf_mpc.problem_file import load_problem

    file = tmp_path / "problem.toml"
    file.write_text(
        """
[formation]
shape = "square"
[mission]
length_m = 40.0
[world]
kind = "list"
obstacles = [{ shape = "cylinder", centre_m = [22.0, -3.4], radius_m = 1.0 }]
[navigation]
kind = "constant"
sigma_min_m = 0.1
sigma_max_m = 0.1
error_scale = 0.0
[simulation]
time_limit_s = 60.0
""",
        encoding="utf-8",
    )
    return load_problem(file, settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (['planner.safety="overbound"'], 'navigation.kind = "constant" has no log'),
        (
            ['planner.safety="protection_level"', 'navigation.filter="kalman"'],
            "bounds the error of fixes, not of a filter's estimate",
        ),
        (['planner.safety="protection_level"', "planner.risk_per_mission=0.1"], "leave risk_per_mission out"),
        (['planner.safety="sigma"'], "planner.safety"),
    ],
)
def test_what_cannot_be_asked_for(tmp_path: Path, settings: list[str], words: str) -> None:
    with pytest.raises(ProblemError) as caught:
        problem(tmp_path, *settings)
    assert words in str(caught.value)


def recorded(**changes: Any) -> Recorded:
    return Recorded.model_validate({"kind": "recorded", "file": "log.csv", "vertical": "recorded"} | changes)


def log_of_two_halves() -> ErrorLog:
    """First half within one sigma, second with errors up to four."""
    n = 400
    z = np.concatenate([np.linspace(-1.0, 1.0, 200), np.linspace(-4.0, 4.0, 200)])
    z = z[np.concatenate([np.arange(200) * 77 % 200, 200 + np.arange(200) * 77 % 200])]  # in no order
    return ErrorLog("log", np.arange(n, dtype=float), np.ones(n, dtype=bool), 2.0 * z[:, None] * np.ones(3),
                    np.tile(4.0 * np.eye(3), (n, 1, 1)))  # fmt: skip


def test_the_overbound_comes_from_the_half_that_is_not_flown() -> None:
    log = log_of_two_halves()
    flown, bound = flown_part(log, recorded(part="first_half"))
    assert np.abs(flown.error).max() == pytest.approx(2.0)
    assert bound is not None
    assert bound.source == "second half of log"
    assert bound.factors(3.0).min() > 1.3
    flown, bound = flown_part(log, recorded(part="second_half"))
    assert np.abs(flown.error).max() == pytest.approx(8.0)
    assert bound is not None
    np.testing.assert_array_equal(bound.factors(3.0), 1.0)
    assert flown_part(log, recorded())[1] is None


def test_a_barometer_grows_by_nothing_and_mixed_shifts_add_up() -> None:
    log = log_of_two_halves()
    shifted = replace(log, error=log.error + 1.0)
    plain = flown_part(shifted, recorded(part="first_half"))[1]
    mixed = flown_part(shifted, recorded(part="first_half", common_mode_share=0.5))[1]
    barometer = flown_part(shifted, recorded(part="first_half", vertical="barometer"))[1]
    assert plain is not None
    assert mixed is not None
    assert barometer is not None
    assert plain.axes[0].bias == pytest.approx(0.5, abs=0.05)  # 1 m of sigma 2 m
    assert mixed.axes[0].bias == pytest.approx(np.sqrt(2.0) * plain.axes[0].bias)
    assert barometer.factors(3.0)[2] == 1.0
    assert barometer.factors(3.0)[0] == plain.factors(3.0)[0]


# ------------------------------------------------------------------------------------------------ flown


@dataclass(frozen=True)
class LevelErrors:
    """A receiver of one's own: no error, and a protection level, lost by UAV 1 from some time on."""

    level_m: tuple[float, float]
    lost_from: int = 10**9
    lost_error_m: float = 0.0
    period_s: float = 0.1

    def fix(self, epoch: int) -> Fix:
        level = np.tile(np.array(self.level_m), (1, 4, 1))
        error = np.zeros((1, 4, 3))
        if epoch >= self.lost_from:
            level[:, 0] = np.nan
            error[:, 0, 2] = self.lost_error_m
        return Fix(
            error=error,
            covariance=np.tile(0.01 * np.eye(3), (1, 4, 1, 1)),
            common_factor=np.zeros((1, 4, 3, 1)),
            available=np.ones((1, 4), dtype=bool),
            protection=level,
        )


def clearance(task: Problem, planner: str, errors: LevelErrors) -> tuple[float, bool]:
    scenario = replace(build_scenario(task, 0, range(1)), errors=errors)
    judge = MissionScore(task, scenario)
    flight = closed_loop(task, make_planner(planner, task), scenario, [judge])
    return float(judge.score(flight).metrics["min_clearance_m"][0]), bool(flight.holding[0])


@pytest.mark.parametrize("planner", ["napf", "napf_guided", "qp"])
def test_planners_keep_the_protection_level(tmp_path: Path, planner: str) -> None:
    plain = problem(tmp_path)
    levels = problem(tmp_path, 'planner.safety="protection_level"')
    near, _ = clearance(plain, planner, LevelErrors((3.0, 3.0)))
    far, held = clearance(levels, planner, LevelErrors((3.0, 3.0)))
    assert not held
    assert far > near + 0.8
    # Navigation is exact here, so what is kept is the level itself, but for what the field gives way.
    assert far > 2.0
    again, _ = clearance(
        problem(tmp_path, 'planner.safety="protection_level"', "planner.k=1.5"),
        planner,
        LevelErrors((3.0, 3.0)),
    )
    assert again > 2.0


@pytest.mark.parametrize("planner", ["napf", "qp"])
def test_a_uav_without_a_level_holds(tmp_path: Path, planner: str) -> None:
    levels = problem(tmp_path, 'planner.safety="protection_level"', "simulation.time_limit_s=12")
    _, held = clearance(levels, planner, LevelErrors((3.0, 3.0), lost_from=80))
    assert held


class Highest:
    """How far the first UAV leaves its height."""

    off_m = 0.0

    def moved(self, time_s: float, before: np.ndarray, after: np.ndarray, active: np.ndarray) -> None:
        self.off_m = max(self.off_m, float(np.abs(after[0, 0, 4] - before[0, 0, 4])), abs(after[0, 0, 4]))

    def ticked(self, *seen: object) -> None:
        pass


@pytest.mark.parametrize("planner", ["napf", "qp"])
def test_a_fix_without_a_level_does_not_move_a_uav_that_holds(tmp_path: Path, planner: str) -> None:
    """It jumps up by 20 m as the level is lost; holding the last place by it would go down as far."""
    task = problem(tmp_path, 'planner.safety="protection_level"', "simulation.time_limit_s=14")
    errors = LevelErrors((3.0, 3.0), lost_from=80, lost_error_m=20.0)
    seen = Highest()
    scenario = replace(build_scenario(task, 0, range(1)), errors=errors)
    closed_loop(task, make_planner(planner, task), scenario, [seen])
    assert seen.off_m < 4.0  # the height of the others' avoidance, not of the fix


def test_apf_flies_the_same_whatever_drives_the_others(tmp_path: Path) -> None:
    a = clearance(problem(tmp_path), "apf", LevelErrors((3.0, 3.0)))
    b = clearance(
        problem(tmp_path, 'planner.safety="protection_level"'), "apf", LevelErrors((3.0, 3.0), lost_from=0)
    )
    assert a == b
