"""Barometers: an offset that is learnt from the receiver's heights, and holds the height without a fix."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.block import fly_block
from napf_mpc.errors import ProblemError
from napf_mpc.lanes import navigate
from napf_mpc.navigation import height_offset, kalman
from napf_mpc.navigation.filter import KalmanFilter
from napf_mpc.navigation.filter_model import BarometerModel, FilterModel
from napf_mpc.navigation.point_mass_filter import PointMassFilter
from napf_mpc.navigation.sensors import Barometers
from napf_mpc.problem import Gnss
from napf_mpc.problem_file import load_problem

Array = NDArray[np.float64]
EPOCH_S = 0.1
ACTIVE = np.ones(1, dtype=bool)
OPEN = {"innovation_gate_sigma": 0.0}
NAMES = ("kalman", "point_mass")


def receiver(**keys: Any) -> Gnss:
    """Receiver with a barometer."""
    settings: dict[str, Any] = {"kind": "gnss", "filter": "kalman", "barometer": "offset"}
    # To the point-mass filter, too, the error is one of time: these UAVs stand.
    settings |= {"filter_correlation_time_s": 2.0, "filter_standing_time_s": 2.0}
    return Gnss.model_validate(settings | keys)


def model(**keys: Any) -> FilterModel:
    """Of a receiver whose epochs are its ticks."""
    return FilterModel.of_navigation(receiver(**keys), EPOCH_S, 1)


def filter_of(
    name: str, of: FilterModel, uavs: int = 1, degrees: float = 3.0
) -> KalmanFilter | PointMassFilter:
    """Filter of one run."""
    return KalmanFilter(of, 1, uavs) if name == "kalman" else PointMassFilter(of, degrees, 1, uavs)


class Flight:
    """UAVs that stand at height 0, with the numbers of a true world drawn about them."""

    def __init__(self, name: str, of: FilterModel, uavs: int, seed: int, degrees: float = 1e6) -> None:
        self.filter, self.of, self.uavs = filter_of(name, of, uavs, degrees), of, uavs
        self._random = np.random.default_rng(seed)
        assert of.barometer is not None
        self._begun = False
        self.bias = np.sqrt(of.bias_sigma_mps2**2) * self._random.standard_normal((1, uavs, 3))
        self.offset = np.sqrt(of.barometer.offset) * self._random.standard_normal((1, uavs))
        self.error = self._random.standard_normal((1, uavs, 3))

    def epoch(
        self,
        sigma_m: float,
        available: bool = True,
        leap_m: float = 0.0,
        scale: float = 1.0,
        high_m: float = 0.0,
    ) -> Array:
        """Fly one epoch; error of the heights (uav,) and their variance (uav,)."""
        of, random, shape = self.of, self._random, (1, self.uavs, 3)
        barometer = of.barometer
        assert barometer is not None
        if self._begun:
            noise = np.sqrt(of.velocity_change_noise) * random.standard_normal(shape)
            self.filter.predict(EPOCH_S * self.bias + noise, ACTIVE)
            self.bias = of.bias_memory * self.bias + np.sqrt(of.bias_noise) * random.standard_normal(shape)
            self.offset = self.offset + np.sqrt(barometer.drift) * random.standard_normal((1, self.uavs))
            self.error = of.error_memory * self.error + np.sqrt(of.error_noise) * random.standard_normal(
                shape
            )
        self._begun = True
        height = self.offset + leap_m + np.sqrt(barometer.noise) * random.standard_normal((1, self.uavs))
        self.filter.take_in_heights(height, ACTIVE)
        covariance = np.broadcast_to(sigma_m**2 * np.eye(3), (*shape, 3))
        position = scale * sigma_m * self.error + np.array([0.0, 0.0, high_m])
        velocity = of.velocity_sigma_mps * random.standard_normal(shape)
        there = np.full((1, self.uavs), available)
        self.filter.correct(position, velocity, covariance, there, True, ACTIVE)
        told = self.filter.solution(0.0, np.zeros(shape), np.zeros(shape))
        return np.stack([told.position[0, :, 2], told.covariance[0, :, 2, 2]])


class Dense:
    """The vertical axis of the Kalman filter with five states, written down as matrices."""

    def __init__(self, of: FilterModel, place: float, speed: float, sigma: float) -> None:
        self.of = of
        assert of.barometer is not None
        self.x = np.array([place, speed, 0.0, 0.0, 0.0])
        self.p = np.diag([sigma**2 + 1e-6, of.velocity_sigma_mps**2, 1.0, of.bias_sigma_mps2**2, 0.0])
        self.p[0, 2] = self.p[2, 0] = -sigma
        self.p[4, 4] = of.barometer.offset

    def predict(self, change: float) -> None:
        """One tick."""
        of, dt = self.of, EPOCH_S
        assert of.barometer is not None
        f = np.eye(5)
        f[0, 1], f[0, 3], f[1, 3], f[3, 3] = dt, -0.5 * dt * dt, -dt, of.bias_memory
        drive = np.array([0.5 * dt, 1.0, 0.0, 0.0, 0.0])
        self.x = f @ self.x + drive * change
        noise = of.velocity_change_noise * np.outer(drive, drive)
        noise[3, 3], noise[4, 4] = of.bias_noise, of.barometer.drift
        self.p = f @ self.p @ f.T + noise

    def forget(self) -> None:
        """To the next epoch of fixes."""
        g = np.diag([1.0, 1.0, self.of.error_memory[2], 1.0, 1.0])
        self.x = g @ self.x
        self.p = g @ self.p @ g.T
        self.p[2, 2] += self.of.error_noise[2]

    def measure(self, value: float, h: list[float], noise: float) -> None:
        """One scalar measurement."""
        row = np.array(h)
        spread = row @ self.p @ row + noise
        k = self.p @ row / spread
        self.x = self.x + k * (value - row @ self.x)
        self.p = self.p - np.outer(k, k) * spread


def test_the_kalman_filter_with_an_offset_is_one_of_five_states() -> None:
    """Fixes, heights and an outage of random numbers: estimate, offset and all variances to nine digits."""
    of, random = model(**OPEN), np.random.default_rng(5)
    assert of.barometer is not None
    mine = KalmanFilter(of, 1, 1)
    dense: Dense | None = None
    for epoch in range(120):
        change, place, speed, height = random.standard_normal(4) * np.array([0.1, 4.0, 0.1, 5.0])
        sigma, fix = 2.0 + np.sin(0.1 * epoch), not 40 <= epoch < 70
        if dense is not None:
            mine.predict(np.full((1, 1, 3), change), ACTIVE)
            dense.predict(change)
            dense.measure(height, [1.0, 0.0, 0.0, 0.0, 1.0], of.barometer.noise)
        mine.take_in_heights(np.full((1, 1), height), ACTIVE)
        mine.correct(
            np.full((1, 1, 3), place), np.full((1, 1, 3), speed), sigma**2 * np.eye(3)[None, None],
            np.full((1, 1), fix), True, ACTIVE,
        )  # fmt: skip
        if dense is None:
            dense = Dense(of, place, speed, sigma)
            continue
        dense.forget()
        if fix:
            dense.measure(place, [1.0, 0.0, sigma, 0.0, 0.0], 1e-6)
            dense.measure(speed, [0.0, 1.0, 0.0, 0.0, 0.0], of.velocity_sigma_mps**2)
        full = np.empty((4, 4))
        kalman.unpack(mine._packed[0, 0, 2], full)
        np.testing.assert_allclose(full, dense.p[:4, :4], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mine._mean[0, 0, 2], dense.x[:4], rtol=1e-9, atol=1e-9)
        offset = mine._offset[0, 0]
        np.testing.assert_allclose(offset[1:], [*dense.p[4, :4], dense.p[4, 4]], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(offset[0], dense.x[4], rtol=1e-9, atol=1e-9)
    assert dense is not None
    assert dense.p[4, 4] < 0.2 * of.barometer.offset  # it did learn


@pytest.mark.parametrize("name", NAMES)
def test_the_covariance_stays_one_for_long(name: str) -> None:
    """Half an hour of epochs, sigmas of fixes from a millimetre to 50 m, outages of minutes: five by five."""
    of, random = model(**OPEN), np.random.default_rng(21)
    mine, lowest = filter_of(name, of, 1, 3.0), np.inf
    upper, full = np.triu_indices(4), np.empty((5, 5))
    for epoch in range(20_000):
        if epoch:
            mine.predict(np.zeros((1, 1, 3)), ACTIVE)
        mine.take_in_heights(0.1 * random.standard_normal((1, 1)), ACTIVE)
        sigma = 10.0 ** random.uniform(-3.0, 1.7)
        mine.correct(
            sigma * random.standard_normal((1, 1, 3)), 0.1 * random.standard_normal((1, 1, 3)),
            sigma**2 * np.eye(3)[None, None], np.array([[epoch % 4000 < 3000]]), True, ACTIVE,
        )  # fmt: skip
        full[upper] = full.T[upper] = mine._packed[0, 0, 2]
        full[4, :4] = full[:4, 4] = mine._offset[0, 0, 1:5]
        full[4, 4] = mine._offset[0, 0, 5]
        kept = [0, 1, 2, 3, 4] if name == "kalman" else [0, 1, 3, 4]  # the point-mass filter has no state g
        part = full[np.ix_(kept, kept)]
        scale = np.sqrt(np.diag(part))
        assert (scale > 0.0).all(), epoch
        lowest = min(lowest, np.linalg.eigvalsh(part / np.outer(scale, scale)).min())
    assert lowest > -1e-12


def test_an_alarm_is_a_transformation_of_all_five_errors() -> None:
    """The position's error grows by the root, and the offset's by its part in that, in any covariance."""
    random = np.random.default_rng(22)
    packed, offset, root = np.empty((2, 3, 3, 10)), np.empty((2, 3, 6)), random.uniform(1.5, 6.0, (2, 3))
    root[1, 2] = 1.0
    upper, expected = np.triu_indices(4), np.empty((2, 3, 5))
    for at in np.ndindex(2, 3):
        half = random.standard_normal((5, 7))
        p = half @ half.T
        packed[at] = p[upper]
        offset[at] = random.standard_normal(), *p[4]
        t = np.eye(5)
        t[0, 0] = root[at]
        t[4, 0] = p[4, 0] / p[0, 0] * (root[at] - 1.0)
        expected[at] = (t @ p @ t.T)[4]
    means = offset[..., 0].copy()
    height_offset.follow_alarm(packed, offset, root)
    np.testing.assert_allclose(offset[..., 1:], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(offset[..., 0], means)


@pytest.mark.parametrize("name", NAMES)
def test_heights_are_as_certain_as_told_with_fixes_and_without(name: str) -> None:
    """400 UAVs in a world of the assumed laws: a minute of fixes, a minute without, ten seconds of fixes."""
    flight = Flight(name, model(**OPEN), 400, 7)
    told = []
    for epoch in range(1300):
        told.append(flight.epoch(4.0, available=not 600 <= epoch < 1200))
        if epoch not in (300, 590, 700, 900, 1190, 1290):
            continue
        offset = flight.filter._offset[0]
        off = np.stack([told[-1][0], offset[:, 0] - flight.offset[0]])
        # 400 squared normal numbers: 1 +- 0.07; a filter that weighs correlated fixes may claim less.
        ratio = np.mean(off**2 / np.stack([told[-1][1], offset[:, 5]]), axis=1)
        assert ((ratio > 0.6) & (ratio < 1.25)).all(), (epoch, ratio)
    before, after = np.sqrt(told[590][1].mean()), np.sqrt(told[1190][1].mean())
    assert before < 1.5
    # The offset wanders by 0.9 m in a minute; by accelerometers alone the height is lost by tens of metres.
    assert after < np.hypot(before, 1.2)
    without = Flight(name, model(**OPEN), 4, 7)
    for epoch in range(1200):
        without.filter.take_in_heights = lambda height, active: None  # type: ignore[method-assign]
        lost = without.epoch(4.0, available=epoch < 600)
    assert np.sqrt(lost[1].mean()) > 20.0


@pytest.mark.parametrize("name", NAMES)
def test_an_alarm_is_one_of_the_offset_too(name: str) -> None:
    """Sigmas that are right for 40 s, and then a fifth of the truth: heights are as uncertain as they are."""
    flight = Flight(name, model(monitor="innovations"), 200, 17, degrees=3.0)
    for _ in range(400):
        flight.epoch(3.0)
    for seconds in range(30):
        for _ in range(10):
            error, variance = flight.epoch(3.0, scale=5.0)
        # Until the monitor knows, nobody does.
        assert seconds < 5 or np.mean(error**2 / variance) < 1.6, seconds
    assert flight.filter.monitor is not None
    assert (flight.filter.monitor.alarms > 0).all()


@pytest.mark.parametrize("name", ["point_mass"])
def test_a_wrong_start_is_left_with_a_barometer_as_without(name: str) -> None:
    """Fixes of the first two seconds are 30 m too high: a barometer must not hold on to that."""
    flight = Flight(name, model(), 200, 18, degrees=3.0)
    for _ in range(20):
        flight.epoch(3.0, high_m=30.0)
    for seconds in range(40):
        for _ in range(10):
            error, variance = flight.epoch(3.0)
        assert seconds < 9 or np.mean(error**2 / variance) < 1.3, seconds
    assert np.sqrt(np.mean(error**2)) < 1.5


@pytest.mark.parametrize("name", NAMES)
def test_leaps_tell_nothing_of_the_height(name: str) -> None:
    """An outage in which the barometer leaps every second: the height is no more certain for it."""
    flight = Flight(name, model(), 3, 19)
    for _ in range(300):
        before = flight.epoch(3.0)
    for second in range(30):
        for _ in range(10):
            now = flight.epoch(3.0, available=False, leap_m=100.0 * (second % 2 + 1))
        assert (now[1] > 0.99 * before[1]).all()
        before = now


@pytest.mark.parametrize("name", NAMES)
def test_height_and_plan_have_nothing_in_common(name: str) -> None:
    """Fixes whose errors up go with those east: with a barometer that is not told, without one it is."""
    told = {}
    for barometer in ("none", "offset"):
        mine = filter_of(name, model(barometer=barometer), 1, 3.0)
        covariance = np.array([[9.0, 0.0, 6.0], [0.0, 9.0, 0.0], [6.0, 0.0, 9.0]])[None, None]
        for epoch in range(30):
            if epoch:
                mine.predict(np.zeros((1, 1, 3)), ACTIVE)
            if barometer == "offset":
                mine.take_in_heights(np.zeros((1, 1)), ACTIVE)
            there = np.ones((1, 1), dtype=bool)
            mine.correct(np.zeros((1, 1, 3)), np.zeros((1, 1, 3)), covariance, there, True, ACTIVE)
        told[barometer] = mine.solution(0.0, np.zeros((1, 1, 3)), np.zeros((1, 1, 3))).covariance[0, 0]
    assert told["offset"][0, 2] == told["offset"][2, 0] == told["offset"][3, 2] == 0.0
    assert (told["none"][0, 2] > 0.5) == (name == "kalman")


@pytest.mark.parametrize("name", NAMES)
def test_a_height_that_leaps_has_a_new_offset(name: str) -> None:
    """A barometer that leaps by 30 m, or by 500, moves no height, and is believed again."""
    flight = Flight(name, model(), 50, 8)
    for _ in range(600):
        before = flight.epoch(3.0)
    for leap in (30.0, 500.0):
        for epoch in range(20):
            now = flight.epoch(3.0, leap_m=leap)
            assert np.abs(now[0] - before[0]).max() < 1.0, (leap, epoch)
        for _ in range(300):
            before = flight.epoch(3.0, leap_m=leap)
        for _ in range(300):
            now = flight.epoch(3.0, available=False, leap_m=leap)
        assert np.abs(now[0] - before[0]).max() < 3.5
        for _ in range(300):
            before = flight.epoch(3.0, leap_m=leap)


def test_where_the_estimate_goes_elsewhere_the_offset_is_learnt_anew() -> None:
    """Fixes that agree on a place 300 m up: a barometer that saw no climb must not pull the estimate back."""
    mine = PointMassFilter(model(**OPEN), 3.0, 1, 1)
    there = np.ones((1, 1), dtype=bool)
    for epoch in range(400):
        if epoch:
            mine.predict(np.zeros((1, 1, 3)), ACTIVE)
        mine.take_in_heights(np.zeros((1, 1)), ACTIVE)
        place = np.zeros((1, 1, 3)) if epoch < 100 else np.array([[[0.0, 0.0, 300.0]]])
        mine.correct(place, np.zeros((1, 1, 3)), np.eye(3)[None, None], there, True, ACTIVE)
        told = mine.solution(0.0, np.zeros((1, 1, 3)), np.zeros((1, 1, 3))).position[0, 0, 2]
        assert abs(told) < 1.0 or abs(told - 300.0) < 1.0, epoch
    assert told > 299.0
    assert mine._offset[0, 0, 0] < -290.0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("height", [np.nan, np.inf])
def test_what_is_no_height_says_nothing(name: str, height: float) -> None:
    one, other = (Flight(name, model(), 3, 9) for _ in range(2))
    other.filter.take_in_heights = lambda given, active: None  # type: ignore[method-assign]
    real = one.filter.take_in_heights
    one.filter.take_in_heights = lambda given, active: real(np.full_like(given, height), active)  # type: ignore[method-assign]
    for _ in range(50):
        np.testing.assert_array_equal(one.epoch(3.0), other.epoch(3.0))


def test_before_the_first_fix_a_height_says_nothing() -> None:
    of = model()
    mine = KalmanFilter(of, 1, 1)
    mine.take_in_heights(np.full((1, 1), 50.0), ACTIVE)
    assert np.isnan(mine._mean).all()
    assert len(KalmanFilter(replace(of, barometer=None), 1, 1)._offset) == 0


@pytest.mark.parametrize("name", NAMES)
def test_of_two_runs_the_one_that_stands_still_keeps_its_offset(name: str) -> None:
    of = model()
    both = KalmanFilter(of, 2, 1) if name == "kalman" else PointMassFilter(of, 3.0, 2, 1)
    for active in (np.ones(2, dtype=bool), np.ones(2, dtype=bool), np.array([True, False])):
        kept = both._offset.copy()
        both.predict(np.zeros((2, 1, 3)), active)
        both.take_in_heights(np.full((2, 1), 3.0), active)
        both.correct(
            np.ones((2, 1, 3)), np.zeros((2, 1, 3)), np.tile(np.eye(3), (2, 1, 1, 1)),
            np.ones((2, 1), dtype=bool), True, active,
        )  # fmt: skip
    np.testing.assert_array_equal(both._offset[1], kept[1])
    assert both._offset[0, 0, 0] != kept[0, 0, 0]


def test_weather_is_common_and_drift_is_not() -> None:
    """Sigmas of 8 m and 1 m over 400 runs of 3 UAVs, and how they change in five minutes."""
    settings = receiver(barometer_noise_m=0.5)
    sensor = Barometers(settings, 11, range(400), 3, 10.0)
    heights = np.array([sensor.height(np.full((400, 3), 100.0)) for _ in range(31)]) - 100.0
    first = heights[0]
    common = first.mean(-1)
    assert common.std() == pytest.approx(8.0, rel=0.1)
    assert (first - common[:, None]).std() == pytest.approx(np.hypot(1.0, 0.5) * np.sqrt(2 / 3), rel=0.1)
    change = heights[30] - heights[0]
    weather = 8.0 * np.sqrt(2.0 * (1.0 - np.exp(-300.0 / 10_800.0)))
    own = np.sqrt(2.0 * (1.0 - np.exp(-1.0)) + 2.0 * 0.5**2)
    assert change.mean(-1).std() == pytest.approx(np.hypot(weather, own / np.sqrt(3.0)), rel=0.1)
    assert (change - change.mean(-1, keepdims=True)).std() == pytest.approx(own * np.sqrt(2 / 3), rel=0.1)
    silent = Barometers(settings.model_copy(update={"error_scale": 0.0}), 11, range(2), 3, 10.0)
    np.testing.assert_array_equal(silent.height(np.full((2, 3), 100.0)), 100.0)


def test_the_offset_wanders_as_assumed() -> None:
    """Over ten seconds, weather and drift together, to the first order."""
    of = BarometerModel.of_receiver(receiver(), EPOCH_S)
    assert of.offset == pytest.approx(65.0)
    drift = 8.0**2 * -np.expm1(-10.0 / 10_800.0) + -np.expm1(-10.0 / 300.0)
    assert 100 * of.drift == pytest.approx(2.0 * drift, rel=0.02)


def test_it_takes_a_filter() -> None:
    with pytest.raises(ProblemError, match='barometer = "offset", but filter = "none"'):
        load_problem("street_canyon_gnss", ["navigation.barometer=offset", "navigation.filter=none"])
    with pytest.raises(ProblemError, match="barometer"):
        load_problem("study_8s", ["navigation.barometer=offset"])


@pytest.mark.parametrize("name", NAMES)
def test_without_fixes_the_height_is_held(name: str) -> None:
    """The street, 20 s of fixes and 40 s of none: the height stays, and is lost without a barometer."""
    error, sigma = {}, {}
    for barometer in ("none", "offset"):
        keys = [f"navigation.filter={name}", f"navigation.barometer={barometer}"]
        problem = load_problem("street_canyon_gnss", keys)
        flown = navigate(problem, 300, range(12), seconds=60.0, outage_s=(20.0, 60.0))
        error[barometer] = flown.error[..., 2]
        sigma[barometer] = np.sqrt(flown.covariance[..., 2, 2])
        # The receiver's own errors have tails that no sigma tells, and the offset was learnt from them.
        assert np.mean(np.abs(error[barometer][20:]) < 3.0 * sigma[barometer][20:]) > 0.97
    assert np.median(np.abs(error["offset"][59] - error["offset"][19])) < 1.5
    assert np.median(np.abs(error["none"][59] - error["none"][19])) > 6.0
    assert np.median(sigma["offset"][59]) < 1.2 * np.median(sigma["offset"][19])
    assert np.median(sigma["none"][59]) > 12.0


def test_missions_do_not_depend_on_the_block_and_do_on_the_barometer() -> None:
    keys = ["simulation.time_limit_s=4", "navigation.barometer=offset"]
    problem = load_problem("street_canyon_gnss", keys)
    whole = fly_block(problem, ["napf"], 3, range(4)).rows
    parts = [fly_block(problem, ["napf"], 3, range(a, a + 2)).rows for a in (0, 2)]
    for name in ("min_clearance_m", "nees"):
        np.testing.assert_array_equal(whole[name], np.concatenate([part[name] for part in parts]))
    without = fly_block(load_problem("street_canyon_gnss", keys[:1]), ["napf"], 3, range(4)).rows
    assert (without["nees"] != whole["nees"]).all()
