"""Navigation by itself: places are given, errors are those of a campaign's runs."""

from __future__ import annotations

import numpy as np
import pytest

from napf_mpc.closed_loop import build_scenario
from napf_mpc.lanes import navigate
from napf_mpc.problem_file import load_problem


def test_without_a_filter_it_tells_the_fixes() -> None:
    problem = load_problem("study_8s")
    told = navigate(problem, 5, range(3, 6), seconds=20.0)
    errors = build_scenario(problem, 5, range(3, 6)).errors
    np.testing.assert_allclose(told.time_s, np.arange(20.0), atol=1e-9)
    for moment in (0, 7, 19):
        fix = errors.fix(10 * moment)  # type: ignore[union-attr]
        np.testing.assert_array_equal(told.error[moment], fix.error)
        np.testing.assert_array_equal(told.covariance[moment], fix.covariance)
    assert told.gated_fixes.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("name", "rms_m", "consistency"),
    [("kalman", (0.4, 0.8), (0.75, 1.35)), ("point_mass", (0.9, 1.6), (0.35, 1.0))],
)
def test_a_filter_is_as_right_as_it_says(
    name: str, rms_m: tuple[float, float], consistency: tuple[float, float]
) -> None:
    """Normal errors of 1 to 5 m, from 30 s on: the Kalman filter is exact, the other allows for tails."""
    told = navigate(load_problem("study_8s", {"navigation.filter": name}), 300, range(20))
    error, covariance = told.error[30:], told.covariance[30:]
    nees = np.einsum("...a,...ab,...b->...", error, np.linalg.inv(covariance), error) / 3.0
    assert consistency[0] < nees.mean() < consistency[1]
    assert rms_m[0] < np.sqrt((error**2).mean()) < rms_m[1]


def test_emulated_receivers_are_asked_where_the_uavs_are() -> None:
    """The whole path in the street, or one place in it: other satellites, so other sigmas."""
    problem = load_problem("street_canyon_gnss", {"navigation.filter": "none", "navigation.rate_hz": 1})
    moving = navigate(problem, 2, range(2), seconds=40.0)
    standing = navigate(problem, 2, range(2), seconds=40.0, stand_m=0.0)
    np.testing.assert_array_equal(moving.error[0], standing.error[0])
    change = [np.abs(np.diff(told.covariance[..., 0, 0], axis=0)).mean() for told in (moving, standing)]
    assert change[0] > 2.0 * change[1]


@pytest.mark.parametrize(
    "asked", [{"seconds": 0.0}, {"seconds": 111.0}, {"seconds": float("nan")}, {"every_s": 0.0}]
)
def test_it_says_what_it_cannot_do(asked: dict[str, float]) -> None:
    problem = load_problem("study_8s", {"simulation.time_limit_s": 110.0})
    with pytest.raises(ValueError, match=r"0 < seconds <= simulation\.time_limit_s = 110"):
        navigate(problem, 1, range(1), **asked)  # type: ignore[arg-type]


def test_an_outage_is_one_of_all_receivers_and_of_its_time() -> None:
    """From 5 to 8 s nobody has a fix: the filter's sigmas grow until then and fall again."""
    problem = load_problem("study_8s", {"navigation.filter": "kalman"})
    told, whole = (
        navigate(problem, 5, range(2), seconds=12.0, outage_s=outage) for outage in ((5.0, 8.0), None)
    )
    np.testing.assert_array_equal(told.error[:5], whole.error[:5])
    variance, usual = (np.einsum("t...aa->t...a", flown.covariance) for flown in (told, whole))
    assert (variance[7] > usual[7]).all()
    # Its last epoch lost, and the next taken.
    assert (variance[8] < variance[7]).mean() > 0.9


@pytest.mark.parametrize(
    ("outage", "name"), [((8.0, 5.0), "kalman"), ((float("nan"), 5.0), "kalman"), ((5.0, 8.0), "none")]
)
def test_an_outage_that_is_none_is_refused(outage: tuple[float, float], name: str) -> None:
    with pytest.raises(ValueError, match=r"outage_s = .*need 0 <= first < last, and a filter"):
        navigate(load_problem("study_8s", {"navigation.filter": name}), 5, range(1), outage_s=outage)
