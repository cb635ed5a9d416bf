"""A watched filter whose fixes contradict it: what is refused, when the UAV holds, and how it ends."""

from collections.abc import Callable

import numpy as np
import pytest

from napf_mpc.navigation.filter import CALM_S, KalmanFilter
from napf_mpc.navigation.filter_model import FilterModel
from napf_mpc.navigation.fix_record import GATE_PATIENCE_S
from napf_mpc.problem import GaussMarkov

PERIOD_S = 0.1
SPEED = np.array([2.0, 0.0, 0.0])
Offset = Callable[[float], np.ndarray]


def north(metres: float) -> np.ndarray:
    return np.array([0.0, metres, 0.0])


class Flown:
    """A UAV at 2 m/s whose fixes are true but for what is added; a step every 0.1 s, by default a fix too."""

    def __init__(
        self,
        seconds: float,
        position: Offset,
        velocity: Offset | None = None,
        monitor: str = "innovations",
        sigma_m: float = 1.0,
        limit_s: float | None = None,
        fix_every_s: float = PERIOD_S,
        outage_s: tuple[float, float] = (0.0, 0.0),
        **keys: float,
    ) -> None:
        navigation = GaussMarkov.model_validate(
            {"filter": "kalman", "monitor": monitor, "dispute_limit_s": limit_s} | keys
        )
        self.filter = KalmanFilter(FilterModel.of_navigation(navigation, PERIOD_S, 1), 1, 1)
        one, all_of = np.ones(1, dtype=bool), np.ones((1, 1), dtype=bool)
        self.time_s, self.error, self.sigma, self.available = [], [], [], []
        for n in range(round(seconds / PERIOD_S)):
            t = n * PERIOD_S
            if n:
                self.filter.predict(np.zeros((1, 1, 3)), one)
            place = (SPEED * t + position(t)).reshape(1, 1, 3)
            speed = (SPEED + (velocity(t) if velocity else 0.0)).reshape(1, 1, 3)
            new = n % round(fix_every_s / PERIOD_S) == 0
            if new:
                fix = place
            there = not outage_s[0] <= t < outage_s[1]
            self.filter.correct(fix, speed, sigma_m**2 * np.eye(3)[None, None], all_of & there, new, one)
            nav = self.filter.solution(t, np.zeros((1, 1, 3)), np.zeros((1, 1, 3)))
            self.time_s.append(t)
            self.error.append(float(np.linalg.norm(nav.position[0, 0] - SPEED * t)))
            self.sigma.append(float(np.sqrt(nav.covariance[0, 0, 1, 1])))
            self.available.append(bool(nav.available[0, 0]))

    def at(self, t: float) -> int:
        return round(t / PERIOD_S)

    @property
    def turns(self) -> list[tuple[float, str]]:
        assert self.filter.monitor is not None
        return [(round(event.time_s, 1), event.turn) for event in self.filter.monitor.doubts]


def jump(metres: float, begin_s: float = 10.0, end_s: float = 1e9) -> Offset:
    return lambda t: north(metres if begin_s <= t < end_s else 0.0)


@pytest.mark.parametrize("sigma_m", [1.0, 2.5])
def test_a_jump_is_held_out_and_the_uav_holds_until_it_is_undone(sigma_m: float) -> None:
    """Also where 10 m are a possible error, four sigmas: what counts is that it came at once."""
    flown = Flown(45.0, jump(10.0, 10.0, 30.0), sigma_m=sigma_m)
    assert max(flown.error) < 0.1  # none of the 10 m
    assert flown.turns == [(12.9, "begins"), (30.0, "ends")]
    held = [t for t, there in zip(flown.time_s, flown.available, strict=True) if not there]
    assert (held[0], held[-1]) == pytest.approx((12.9, 29.9))
    assert flown.filter.refused_fixes[0, 0] == 200
    assert flown.filter.monitor is not None
    assert flown.filter.monitor.alarms[0, 0] == 1  # the dispute itself: sigmas are not what is wrong


def test_a_receiver_slower_than_the_filter_is_held_out_as_well() -> None:
    """A fix a second: the next is compared with the refused one before it, not with that of the epoch."""
    flown = Flown(60.0, jump(10.0, 10.0, 40.0), sigma_m=2.5, fix_every_s=1.0)
    assert max(flown.error) < 0.3  # none of the 10 m
    (began, first), (ended, last) = flown.turns
    assert (first, last) == ("begins", "ends")
    assert (began, ended) == (pytest.approx(12.9, abs=0.1), pytest.approx(40.0, abs=0.1))
    assert not any(flown.available[flown.at(began) : flown.at(ended)])


def test_steps_of_a_slow_receiver_may_be_as_large_as_its_errors_make_them() -> None:
    """In a second an error of 2.5 m with a correlation time of 2 s moves by metres: still the same jump."""

    def wrong(t: float) -> np.ndarray:
        swing = 0.0 if t < 10.5 else 2.2 if round(t) % 2 else -2.2
        return north(11.5 + swing if t >= 10.0 else 0.0)

    flown = Flown(40.0, wrong, sigma_m=2.5, fix_every_s=1.0, correlation_time_s=2.0)
    assert [turn for _, turn in flown.turns] == ["begins"]
    assert max(flown.error) < 0.3


def test_without_a_witness_a_fix_is_not_used_for_being_no_farther_than_the_estimate_is_unsure() -> None:
    """12 m are two sigmas of 6 m: a dispute is not ended by forgetting."""
    flown = Flown(90.0, jump(12.0), gnss_velocity_sigma_mps=9.0)
    assert [turn for _, turn in flown.turns][:2] == ["begins", "given in"]
    assert flown.sigma[flown.at(flown.turns[1][0]) - 1] > 9.5


def test_unwatched_the_same_jump_is_believed_after_three_seconds() -> None:
    flown = Flown(20.0, jump(10.0), monitor="none")
    assert flown.error[flown.at(10.0 + GATE_PATIENCE_S - 0.2)] < 0.1
    assert flown.error[flown.at(10.0 + GATE_PATIENCE_S + 0.2)] > 9.9


def test_velocity_is_the_second_witness() -> None:
    """A minute without a position to believe: by its velocity the estimate is as good as before."""
    flown = Flown(75.0, jump(10.0))
    assert not flown.available[-1]
    assert flown.sigma[-1] < flown.sigma[flown.at(9.9)] + 0.05
    assert max(flown.error) < 0.1


def test_without_a_witness_the_estimate_is_given_up_when_it_is_worth_nothing() -> None:
    """Velocity wrong as well: sigma grows to 10 m, then the filter begins anew, as unsure as they differ."""
    flown = Flown(60.0, jump(30.0), lambda t: north(8.0 if t >= 10.0 else 0.0))
    assert [turn for _, turn in flown.turns][:2] == ["begins", "given in"]
    when = flown.turns[1][0]
    assert flown.sigma[flown.at(when) - 1] > 9.5
    assert flown.sigma[flown.at(when)] >= 29.0
    assert flown.filter.monitor is not None
    assert flown.filter.monitor.events[-1].axis == 1


def test_a_dispute_may_have_a_limit() -> None:
    """After 3 s of refused fixes and 8 s of dispute the fix is believed, and sigma covers both stories."""
    flown = Flown(40.0, jump(10.0), limit_s=8.0)
    assert flown.turns == [(12.9, "begins"), (21.0, "given in")]
    assert not any(flown.available[flown.at(13.0) : flown.at(20.9)])
    assert flown.available[flown.at(21.0)]
    assert flown.sigma[flown.at(21.0)] >= 10.0
    assert flown.error[-1] > 9.0


def test_fixes_that_stay_near_for_long_are_used_again() -> None:
    """A jump of 2.5 m is 6 sigmas of what is new in an error, but 2 of the error itself."""
    flown = Flown(60.0, jump(2.5))
    (began, first), (ended, last) = flown.turns
    assert (first, last) == ("begins", "ends")
    assert ended - began == pytest.approx(CALM_S, abs=0.3)
    assert flown.available[-1]
    assert flown.error[-1] < 2.5


def test_errors_that_hardly_change_are_forgotten_in_a_dispute() -> None:
    """Of an error that lasts for 1000 s much is known, and no other would ever fit; in doubt that is void."""
    flown = Flown(60.0, jump(2.5), correlation_time_s=1000.0)
    assert [turn for _, turn in flown.turns] == ["begins", "ends"]
    assert flown.turns[1][0] - flown.turns[0][0] == pytest.approx(CALM_S, abs=0.3)


def test_an_outage_calms_nothing() -> None:
    """Nearness counts from when fixes are back."""
    flown = Flown(70.0, jump(2.5), outage_s=(20.0, 28.0))
    assert [turn for _, turn in flown.turns] == ["begins", "ends"]
    assert flown.turns[1][0] == pytest.approx(28.0 + CALM_S, abs=0.3)


def test_a_position_that_stands_still_while_its_velocity_does_not_is_refused_at_once() -> None:
    flown = Flown(15.0, lambda t: np.minimum(0.0, SPEED * (10.0 - t)) if t < 13.0 else np.zeros(3))
    assert max(flown.error) < 0.1
    assert flown.filter.refused_fixes[0, 0] == 29  # from the second of thirty on
    # Who hovers may well repeat itself.
    hovering = Flown(15.0, lambda t: -SPEED * t, lambda t: -SPEED)
    assert hovering.filter.refused_fixes[0, 0] == 0
