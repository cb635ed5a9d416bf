"""Faults injected into the fixes of one UAV: each is flagged by its declared rule, and flown through.

In short what ``benchmarks/navigation_faults.py`` measures at length.
"""

from functools import cache

import numpy as np
import pytest
from navigation_faults import FAULTS, Flown, flags, fly, median_interval

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
