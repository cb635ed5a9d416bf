"""Faults injected into the fixes of one UAV: each is flagged by its declared rule, and flown through.

In short what ``benchmarks/navigation_faults.py`` measures at length.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from navigation_faults import FAULTS, Flown, flags, fly, median_interval
from numpy.typing import NDArray

from napf_mpc.closed_loop import build_scenario, closed_loop
from napf_mpc.navigation import filtered
from napf_mpc.navigation.fix import Fix
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem_file import load_problem

RUNS = 3
# Fault -> what must flag it in every run. Two need not be told by anything: a constant lag is an error like
# any other, and a drift shows only when it has outgrown what sigma allows.
RULES = {
    "nan": "gate",
    "zero": "gate",
    "negative": "gate",
    "asymmetric": "gate",
    "jump": "gate",
    "jump_stays": "gate",
    "stuck": "gate",
    "back": "gate",
    "slow": "missed",
    "outage_1": "missed",
    "outage_5": "missed",
    "outage_69": "unavailable",
}


@cache
def flown(kind: str) -> Flown:
    return fly(kind, "napf", 300, RUNS)


def test_every_fault_has_a_rule_or_a_reason() -> None:
    assert set(RULES) | {"none", "drift", "delayed"} == set(FAULTS)


@pytest.mark.parametrize("kind", RULES)
def test_it_is_flagged_by_its_rule(kind: str) -> None:
    assert flags(flown(kind), flown("none"))[RULES[kind]].all()


@pytest.mark.parametrize("kind", FAULTS)
def test_it_is_survived(kind: str) -> None:
    """Every number stays finite, no command or rotor leaves its limits, and the others never pay for it."""
    after = flown(kind)
    assert not after.watch.outside.any()
    assert not after.score.obstacle_contact.any()
    assert not after.score.uav_contact.any()
    assert np.isfinite(after.score.metrics["path_rms_m"]).all()
    if kind != "outage_69":  # a minute of dead reckoning
        # Of a jump of 10 m, or of 20 m that a UAV flies while its position is stuck, next to nothing.
        assert after.watch.largest_error_m.max() < 5.0
    if kind == "jump_stays":
        assert not after.score.finished.any()
        assert after.watch.unavailable.min() * after.watch.tick_s > 150.0  # of 200 s: it holds
    else:
        assert after.score.finished.all()


def test_without_a_fault_nothing_is_flagged() -> None:
    clean = flown("none")
    assert (clean.gated == 0).all()
    assert (clean.alarms == 0).all()
    assert (clean.missed == 0).all()
    assert (clean.watch.unavailable == 0).all()


def test_the_interval_of_a_median_is_that_of_order_statistics() -> None:
    middle, low, high = median_interval(np.arange(100.0))
    assert (middle, low, high) == (49.5, 39.0, 60.0)  # ranks 40 and 61 of 100


@pytest.mark.parametrize("kind", ["nan", "zero", "negative", "asymmetric"])
def test_a_fix_that_is_no_measurement_costs_what_an_outage_costs(kind: str) -> None:
    """It is refused and counted, and no reason to throw away what the filter knows."""
    np.testing.assert_array_equal(flown(kind).watch.largest_error_m, flown("outage_5").watch.largest_error_m)


@pytest.mark.parametrize("fault", ["nan", "zero", "negative", "asymmetric"])
def test_one_such_fix_of_a_receiver_whose_axes_are_correlated_is_forgotten(
    fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What axes have in common is carried on from fix to fix: one that is no number must not get into it."""
    problem = load_problem(
        "street_canyon_gnss", {"navigation.filter": "kalman", "simulation.time_limit_s": 4.0}
    )
    sources, trusted = filtered.fixes_of_flight, []

    class OneBad:
        def __init__(self, errors: Any) -> None:
            self._source = sources(errors)

        def fix(self, epoch: int, position: NDArray[np.float64]) -> Fix:
            fix = self._source.fix(epoch, position)
            covariance = fix.covariance.copy()
            if epoch == 10:
                covariance[:, 0] *= {"nan": np.nan, "zero": 0.0, "negative": -1.0}.get(fault, 1.0)
                covariance[:, 0, 0, 1] += 5.0 * (fault == "asymmetric")
            return replace(fix, covariance=covariance)

    class Look:
        def moved(self, *_: object) -> None:
            pass

        def ticked(self, time_s: float, state: object, nav: NavSolution, *_: object) -> None:
            trusted.append(nav.trusted())
            assert np.isfinite(nav.covariance).all()

    monkeypatch.setattr(filtered, "fixes_of_flight", OneBad)
    flight = closed_loop(
        problem, make_planner("napf", problem), build_scenario(problem, 300, range(2)), [Look()]
    )
    assert flight.gated_fixes is not None
    assert (flight.gated_fixes > 0).all()
    assert np.array(trusted).all()
