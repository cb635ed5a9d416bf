"""The covariance to come: what the filter says beforehand is what it reports then."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.navigation.filter import KalmanFilter
from napf_mpc.navigation.filter_model import FilterModel
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import ConstantBias, GaussMarkov, Navigation, Recorded

Array = NDArray[np.float64]

TICK_S, TICKS = 0.02, 5
RUNS, UAVS = 2, 3
SIGMA = np.array([1.5, 3.0, 0.7])
AHEAD_S = np.array([0.02, 0.06, 0.1, 0.3, 1.0, 2.5, 5.0, 6.5])
"""Between two epochs of fixes, at one, and many later."""


class Pilot:
    """Feeds a filter with any measurements: its covariance does not depend on them."""

    def __init__(self, navigation: Navigation, ticks_per_epoch: int = TICKS) -> None:
        model = FilterModel.of_navigation(navigation, TICK_S, ticks_per_epoch)
        self.filter = KalmanFilter(replace(model, gate=0.0), RUNS, UAVS)
        self.rng = np.random.default_rng(7)
        self.ticks_per_epoch = ticks_per_epoch
        self.tick = -1

    def fly(
        self,
        seconds: float,
        fixes: bool = True,
        new_every: int = 1,
        correlation: float = 0.0,
        sigma: Array = SIGMA,
    ) -> list[NavSolution]:
        """Solutions of each tick from the next on."""
        shape, active = (RUNS, UAVS, 3), np.ones(RUNS, dtype=bool)
        covariance = np.zeros((RUNS, UAVS, 3, 3))
        covariance[...] = np.diag(sigma**2)
        covariance[..., 0, 1] = covariance[..., 1, 0] = correlation * sigma[0] * sigma[1]
        solutions = []
        for _ in range(round(seconds / TICK_S)):
            self.tick += 1
            if self.tick:
                self.filter.predict(self.rng.normal(size=shape), active)
            if self.tick % self.ticks_per_epoch == 0:
                new = (self.tick // self.ticks_per_epoch) % new_every == 0
                there = np.full((RUNS, UAVS), fixes)
                position, velocity = self.rng.normal(size=(2, *shape))
                self.filter.correct(position, velocity, covariance, there, new, active)
            still = np.zeros(shape)
            solutions.append(self.filter.solution(self.tick * TICK_S, still, still))
        return solutions


def variances(solutions: list[NavSolution]) -> Array:
    """(run, uav, t, 3) as reported."""
    return np.stack([np.einsum("...ii->...i", nav.position_covariance) for nav in solutions], axis=2)


def then(solutions: list[NavSolution]) -> Array:
    """Reported variance (run, uav, N, 3) at AHEAD_S, from the solutions after now."""
    return variances([solutions[round(ahead / TICK_S) - 1] for ahead in AHEAD_S])


def recorded(vertical: str = "recorded") -> Recorded:
    return Recorded.model_validate({"kind": "recorded", "file": "a.csv", "vertical": vertical})


KINDS = [
    pytest.param(GaussMarkov(), 1, id="correlated"),
    pytest.param(GaussMarkov(correlation_time_s=0.0), 1, id="white"),
    pytest.param(GaussMarkov(accelerometer_bias_time_s=3.0, accelerometer_noise_mps_rts=0.2), 1, id="poor"),
    pytest.param(ConstantBias(kind="constant"), 1, id="constant"),
    pytest.param(recorded(), 1, id="log"),
    pytest.param(recorded("barometer"), 10, id="slow log with barometer"),
]


@pytest.mark.parametrize(("navigation", "new_every"), KINDS)
@pytest.mark.parametrize("begin_s", [2.02, 4.06])
def test_it_is_the_filters_own_covariance_then(
    navigation: Navigation, new_every: int, begin_s: float
) -> None:
    """To 1e-9 of it 0.02 to 6.5 s later, from an epoch and between two, with fixes and without any."""
    for fixes in (True, False):
        pilot = Pilot(navigation)
        forecast = pilot.fly(begin_s, new_every=new_every)[-1].forecast
        assert forecast is not None
        expected = forecast.variance(AHEAD_S, with_fixes=True)
        propagated = forecast.variance(AHEAD_S, with_fixes=False)
        reported = then(pilot.fly(6.6, fixes, new_every))
        if fixes:
            np.testing.assert_allclose(expected, reported, rtol=1e-9)
            continue
        # Without a fix a barometer goes on; a forecast without measurements does without it too.
        axes = ~pilot.filter._model.fixless_axis
        np.testing.assert_allclose(propagated[..., axes], reported[..., axes], rtol=1e-9)
        assert (propagated[..., ~axes] >= (1.0 - 1e-9) * reported[..., ~axes]).all()


def test_in_an_outage_no_fix_is_expected_but_the_barometer_is() -> None:
    pilot = Pilot(recorded("barometer"))
    pilot.fly(5.0)
    forecast = pilot.fly(2.0, fixes=False)[-1].forecast
    assert forecast is not None
    np.testing.assert_allclose(
        forecast.variance(AHEAD_S, with_fixes=True), then(pilot.fly(6.6, fixes=False)), rtol=1e-9
    )


def test_fixes_once_a_second_are_expected_once_a_second() -> None:
    """Epochs of 50 ticks; the sigma of white errors swings between two fixes."""
    pilot = Pilot(GaussMarkov(correlation_time_s=0.0, rate_hz=1.0), ticks_per_epoch=50)
    forecast = pilot.fly(10.3)[-1].forecast
    assert forecast is not None
    expected = forecast.variance(AHEAD_S, with_fixes=True)
    np.testing.assert_allclose(expected, then(pilot.fly(6.6)), rtol=1e-9)
    before, after = forecast.variance(np.array([0.7, 0.72]), with_fixes=True)[0, 0, :, 0]
    assert after < before


def test_without_fixes_the_place_is_lost_as_speed_and_bias_say() -> None:
    """5 s ahead: the error of the velocity and of the accelerometer's bias, and what they have in common."""
    pilot = Pilot(GaussMarkov(accelerometer_bias_time_s=1e6))
    nav = pilot.fly(30.0)[-1]
    assert nav.forecast is not None
    t = 5.0
    for axis in range(3):
        pp, pv, _, pb, vv, _, vb, _, _, bb = nav.forecast.packed[0, 0, axis]
        white = pilot.filter._model.velocity_change_noise / TICK_S
        # Of p + v t - b t^2 / 2, and of white acceleration.
        by_hand = 2 * t * pv - t**2 * pb + t**2 * vv - t**3 * vb + t**4 / 4 * bb + white * t**3 / 3
        forecast = nav.forecast.variance(np.array([t]), with_fixes=False)[0, 0, 0, axis]
        assert forecast - pp == pytest.approx(by_hand, rel=1e-4)
        assert 0.05 < np.sqrt(by_hand) < 1.0


def test_how_many_metres_the_margin_grows_by() -> None:
    """k = 3 after a minute with 3 m of slow error: 0.26 m more 5 s ahead without fixes, 0.01 m with them.

    In the first second nothing is known of the velocity but GNSS's 0.1 m/s: there it is most. With fixes
    there is most to come then: 0.47 m less.
    """
    pilot = Pilot(GaussMarkov())
    early = pilot.fly(0.02)[-1]
    late = pilot.fly(60.0, sigma=np.full(3, 3.0))[-1]
    margins = []
    for nav in (early, late):
        for with_fixes in (False, True):
            ahead = nav.position_covariance_ahead(np.array([5.0]), with_fixes)[0, 0, 0, 0, 0]
            margins.append(3.0 * (np.sqrt(ahead) - np.sqrt(nav.position_covariance[0, 0, 0, 0])))
    assert margins[0] > 0.5
    assert margins[2] == pytest.approx(0.26, abs=0.02)
    assert margins[1] < -0.4
    assert 0.0 <= margins[3] < 0.02


@pytest.mark.parametrize("with_fixes", [True, False])
@pytest.mark.parametrize("begin_s", [0.02, 0.5, 20.0])
def test_correlations_are_held_and_variances_are_those_of_then(begin_s: float, with_fixes: bool) -> None:
    """Correlated axes, and fixes that have just become better."""
    pilot = Pilot(recorded())
    pilot.fly(begin_s, correlation=0.9)
    nav = pilot.fly(0.1, correlation=0.9, sigma=0.2 * SIGMA)[-1]
    ahead = nav.position_covariance_ahead(AHEAD_S, with_fixes)
    assert ahead.shape == (RUNS, UAVS, len(AHEAD_S), 3, 3)
    assert np.abs(nav.position_covariance[..., 0, 1]).min() > 0.0
    assert nav.forecast is not None
    variance = np.einsum("...ii->...i", ahead)
    np.testing.assert_allclose(variance, nav.forecast.variance(AHEAD_S, with_fixes), rtol=1e-9)
    assert (np.diff(variance, axis=2) < 0.0).any() == with_fixes

    def correlation(covariance: Array) -> Array:
        sigma = np.sqrt(np.einsum("...ii->...i", covariance))
        return np.asarray(covariance / sigma[..., :, None] / sigma[..., None, :])

    now = np.broadcast_to(correlation(nav.position_covariance)[:, :, None], ahead.shape)
    np.testing.assert_allclose(correlation(ahead), now, rtol=1e-9)
    np.testing.assert_array_equal(ahead, ahead.swapaxes(-1, -2))
    assert np.linalg.eigvalsh(ahead).min() >= 0.0


def test_where_there_is_no_factor_the_variance_is_held() -> None:
    """A variance of zero has none to that of later, nor has one to what is not above zero."""
    nav = Pilot(GaussMarkov()).fly(1.0)[-1]
    assert nav.forecast is not None
    certain = replace(nav.forecast, packed=np.zeros_like(nav.forecast.packed))
    np.testing.assert_array_equal(certain.change(AHEAD_S, with_fixes=True), 1.0)
    for value in (-1e-3, np.nan):
        spoilt = replace(nav.forecast, packed=np.where(np.arange(10) == 4, value, nav.forecast.packed))
        factor = spoilt.change(np.array([0.02, 100.0]), with_fixes=False)
        assert np.isfinite(factor).all()
        assert (factor > 0.0).all()


def test_without_a_law_the_report_is_held() -> None:
    nav = replace(Pilot(GaussMarkov()).fly(1.0)[-1], forecast=None)
    ahead = nav.position_covariance_ahead(AHEAD_S, with_fixes=False)
    np.testing.assert_array_equal(ahead, np.repeat(nav.position_covariance[:, :, None], len(AHEAD_S), axis=2))


def test_a_solution_keeps_its_forecast_while_the_filter_goes_on() -> None:
    pilot = Pilot(GaussMarkov())
    forecast = pilot.fly(3.0)[-1].forecast
    assert forecast is not None
    before = forecast.variance(AHEAD_S, with_fixes=True)
    pilot.fly(3.0, fixes=False, sigma=5.0 * SIGMA)
    np.testing.assert_array_equal(forecast.variance(AHEAD_S, with_fixes=True), before)


def test_a_sigma_that_says_nothing_measures_nothing() -> None:
    pilot = Pilot(GaussMarkov())
    forecast = pilot.fly(3.0)[-1].forecast
    assert forecast is not None
    blind = [replace(forecast, sigma=np.full_like(forecast.sigma, value)) for value in (0.0, np.nan, np.inf)]
    for each in blind:
        np.testing.assert_array_equal(
            each.variance(AHEAD_S, with_fixes=True), forecast.variance(AHEAD_S, with_fixes=False)
        )


def test_a_forecast_does_not_depend_on_who_stands_beside() -> None:
    """UAVs with certainties, sigmas and outages of their own, all at once and one by one, to the last bit."""
    forecast = Pilot(GaussMarkov()).fly(3.0)[-1].forecast
    assert forecast is not None
    rng = np.random.default_rng(3)
    mixed = replace(
        forecast,
        packed=forecast.packed * rng.uniform(1.0, 4.0, (RUNS, UAVS, 3, 1)),
        sigma=np.where(rng.random((RUNS, UAVS, 3)) < 0.2, np.inf, rng.uniform(0.5, 5.0, (RUNS, UAVS, 3))),
        fixes=np.array([[True, False, True], [False, True, True]]),
    )
    together = mixed.variance(AHEAD_S, with_fixes=True)
    assert len(np.unique(together[:, :, -1])) == RUNS * UAVS * 3
    for run in range(RUNS):
        for uav in range(UAVS):
            at = slice(run, run + 1), slice(uav, uav + 1)
            noise = np.broadcast_to(mixed.model.error_noise, mixed.sigma.shape)[at]
            alone = replace(
                mixed,
                model=replace(mixed.model, error_noise=noise),
                packed=mixed.packed[at].copy(),
                sigma=mixed.sigma[at],
                fixes=mixed.fixes[at],
            )
            np.testing.assert_array_equal(alone.variance(AHEAD_S, with_fixes=True), together[at])


def test_before_the_first_fix_nothing_is_known() -> None:
    model = FilterModel.of_navigation(GaussMarkov(), TICK_S, TICKS)
    still = np.zeros((RUNS, UAVS, 3))
    nav = KalmanFilter(model, RUNS, UAVS).solution(0.0, still, still)
    assert np.isnan(nav.position_covariance_ahead(AHEAD_S, with_fixes=False)).any()
    assert not nav.trusted().any()
