"""Evidence on sigmas of fixes with heavy tails: silent when they hold, found out when they do not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from napf_mpc.block import fly_block, simulate
from napf_mpc.errors import ProblemError
from napf_mpc.lanes import navigate
from napf_mpc.navigation.filter_model import FilterModel
from napf_mpc.navigation.point_mass_filter import PointMassFilter
from napf_mpc.navigation.scale_evidence import SCALES, ScaleEvidence
from napf_mpc.problem import GaussMarkov, Gnss
from napf_mpc.problem_file import load_problem

Array = NDArray[np.float64]
ALL = np.ones(3, dtype=bool)
WATCHED = 'navigation.monitor="innovations"'


def student(runs: int, epochs: int, seed: int, degrees: float = 3.0) -> Array:
    """Draw errors (epoch, run, uav 1, axis) of scale 1."""
    return np.random.default_rng(seed).standard_t(degrees, (epochs, runs, 1, 3))


def fed(evidence: ScaleEvidence, off: Array, weight: float = 1.0, variance: float = 0.0) -> Array:
    """Feed errors whose sigma is told to be 1; scales on sigma (epoch, run)."""
    scales, all_alike = [], np.full(off.shape[1:], weight)
    for epoch, values in enumerate(off):
        spread, sigma = np.full(values.shape, variance), np.ones(values.shape)
        evidence.observe(values, spread, sigma, all_alike, 0.1 * epoch)
        scales.append(np.sqrt(evidence.scale[:, 0, 0]))
    return np.array(scales)


def test_what_a_fix_says_is_the_ratio_of_two_densities() -> None:
    evidence = ScaleEvidence(3.0, ALL, 1, 1)
    off = np.array([[[4.0, np.nan, 0.1]]])
    evidence.observe(off, np.full((1, 1, 3), 2.0), np.full((1, 1, 3), 1.5), np.full((1, 1, 3), 0.25), 0.0)
    said = np.zeros(len(SCALES))
    for value in (4.0, 0.1):
        wide = stats.t.logpdf(value, 3.0, scale=np.sqrt((1.5 * SCALES) ** 2 + 2.0))
        said += 0.25 * (wide - stats.t.logpdf(value, 3.0, scale=np.sqrt(1.5**2 + 2.0)))
    np.testing.assert_allclose(evidence._odds[0, 0], np.maximum(said, 0.0), atol=1e-12)


def test_silent_when_sigmas_hold() -> None:
    """2000 receivers of 100 independent fixes each: fewer than one of a hundred raises an alarm."""
    evidence = ScaleEvidence(3.0, ALL, 2000, 1)
    fed(evidence, student(2000, 100, 1))
    assert (evidence.alarms > 0).mean() < 0.01


@pytest.mark.parametrize(("factor", "soon"), [(5.0, 8), (2.5, 25)])
def test_a_sigma_that_is_too_small_is_found_out(factor: float, soon: int) -> None:
    """8 independent fixes of three axes suffice for a factor of 5, in 19 of 20 cases; the factor is found."""
    evidence = ScaleEvidence(3.0, ALL, 500, 1)
    scales = fed(evidence, factor * student(500, 60, 2))
    assert (scales[soon - 1] > 1.0).mean() > 0.95
    assert np.median(scales[-1]) == pytest.approx(factor, rel=0.25)
    events = evidence.events
    assert {(event.run, event.axis) for event in events} == {(r, a) for r in range(500) for a in range(3)}
    assert all(event.sigma_scale > 1.0 for event in events)
    assert (evidence.largest >= scales[-1][:, None]).all()


def test_a_formation_finds_out_sooner() -> None:
    """Four receivers of one kind, a factor of 5: after two fixes in most cases, in few with one alone."""
    off = 5.0 * np.random.default_rng(14).standard_t(3.0, (2, 500, 4, 3))
    together, alone = ScaleEvidence(3.0, ALL, 500, 4), ScaleEvidence(3.0, ALL, 500, 1)
    fed(together, off)
    fed(alone, off[:, :, :1])
    assert (together.scale > 1.0).all(axis=(1, 2)).mean() > 0.9
    assert (alone.scale > 1.0).mean() < 0.6


@pytest.mark.parametrize("factor", [5.0, 100.0])
def test_a_fault_of_one_receiver_is_told_of_that_one(factor: float) -> None:
    evidence = ScaleEvidence(3.0, ALL, 500, 4)
    fed(
        evidence,
        np.array([1.0, factor, 1.0, 1.0])[:, None]
        * np.random.default_rng(15).standard_t(3.0, (60, 500, 4, 3)),
    )
    assert (evidence.scale[:, 1] > 1.0).all()
    assert (evidence.alarms[:, [0, 2, 3]] > 0).mean() < 0.01


def test_a_receiver_alone_has_nobody_to_ask() -> None:
    evidence = ScaleEvidence(3.0, ALL, 50, 1)
    fed(evidence, 5.0 * student(50, 30, 16))
    np.testing.assert_array_equal(evidence._without, 0.0)


def test_correlated_fixes_count_for_what_they_are_worth() -> None:
    """Each error ten times, at a tenth of the weight, says the same as once."""
    off = 5.0 * student(50, 3, 3)
    once, often = ScaleEvidence(3.0, ALL, 50, 1), ScaleEvidence(3.0, ALL, 50, 1)
    fed(once, off)
    fed(often, np.repeat(off, 10, axis=0), 0.1)
    np.testing.assert_allclose(often._odds, once._odds, atol=1e-9)
    assert once.alarms.sum() > 0
    assert (fed(ScaleEvidence(3.0, ALL, 50, 1), off, 0.01) == 1.0).all()


def test_an_uncertain_estimate_explains_what_is_off() -> None:
    evidence = ScaleEvidence(3.0, ALL, 200, 1)
    fed(evidence, 5.0 * student(200, 60, 4), variance=24.0)
    assert (evidence.alarms > 0).mean() < 0.02


def test_the_scale_goes_when_sigmas_hold_again_and_never_below_one() -> None:
    evidence = ScaleEvidence(3.0, ALL, 200, 1)
    off = np.concatenate([5.0 * student(200, 40, 5), student(200, 100, 6), 0.2 * student(200, 100, 7)])
    scales = fed(evidence, off)
    assert (scales[39] > 1.0).all()
    assert (scales[139] == 1.0).mean() > 0.97
    assert (scales[-1] == 1.0).mean() > 0.99
    assert scales.min() == 1.0


def test_a_factor_between_two_scales_is_not_an_alarm_again_and_again() -> None:
    evidence = ScaleEvidence(3.0, ALL, 100, 1)
    fed(evidence, 4.75 * student(100, 400, 13))
    assert (evidence.alarms >= 3).all()  # one an axis
    assert np.median(evidence.alarms) <= 9


def test_axes_of_another_sensor_are_left_alone() -> None:
    evidence = ScaleEvidence(3.0, np.array([True, True, False]), 20, 1)
    fed(evidence, 5.0 * student(20, 40, 8))
    assert (evidence.scale[..., :2] > 1.0).all()
    assert (evidence.scale[..., 2] == 1.0).all()
    assert {event.axis for event in evidence.events} == {0, 1}
    silent = ScaleEvidence(3.0, np.array([True, True, False]), 20, 1)
    fed(silent, student(20, 40, 9) * np.array([1.0, 1.0, 50.0]))
    assert silent.alarms.sum() == 0


def test_what_is_no_number_says_nothing() -> None:
    evidence = ScaleEvidence(3.0, ALL, 1, 1)
    nothing = np.full((1, 1, 3), np.nan)
    for sigma in (0.0, -1.0, np.nan, np.inf, 1.0):
        off = nothing if sigma == 1.0 else np.full((1, 1, 3), 9.0)
        evidence.observe(off, np.zeros((1, 1, 3)), np.full((1, 1, 3), sigma), np.ones((1, 1, 3)), 0.0)
    np.testing.assert_array_equal(evidence._odds, 0.0)


# ------------------------------------------------------------------------------------------- with its filter


def errors(scale: float, epochs: int, correlation: float, seed: int) -> Array:
    """Draw positions (epoch, run 100, uav 1, axis) of UAVs that stand, sigma told to be 3 m."""
    random, memory = np.random.default_rng(seed), np.exp(-0.1 / correlation) if correlation else 0.0
    out = np.empty((epochs, 100, 1, 3))
    out[0] = random.standard_normal(out[0].shape)
    for epoch in range(1, epochs):
        new = random.standard_normal(out[0].shape)
        out[epoch] = memory * out[epoch - 1] + np.sqrt(1.0 - memory**2) * new
    return 3.0 * scale * out


@pytest.mark.parametrize(("scale", "found"), [(1.0, False), (0.2, False), (5.0, True)])
def test_the_filter_is_told_and_tells(scale: float, found: bool) -> None:
    """A minute of fixes every 0.1 s that are correlated over 2 s, 3 m told: 3, 0.6 and 15 m in truth."""
    keys = {"filter": "point_mass", "filter_correlation_time_s": 2.0, "monitor": "innovations"}
    model = FilterModel.of_navigation(GaussMarkov.model_validate(keys), 0.1, 1)
    watched = PointMassFilter(model, 3.0, 100, 1)
    active, shape = np.ones(100, dtype=bool), (100, 1, 3)
    for epoch, position in enumerate(errors(scale, 600, 2.0, 12)):
        if epoch:
            watched.predict(np.zeros(shape), active)
        watched.correct(
            position, np.zeros(shape), np.tile(9.0 * np.eye(3), (100, 1, 1, 1)),
            np.ones((100, 1), dtype=bool), True, active,
        )  # fmt: skip
    assert watched.monitor is not None
    share = (watched.monitor.alarms > 0).mean()
    told = watched.solution(60.0, np.zeros(shape), np.zeros(shape))
    ratio = np.mean(told.position**2 / np.einsum("...aa->...a", told.position_covariance))
    if found:
        assert share > 0.97
        assert np.median(np.sqrt(watched.monitor.scale)) == pytest.approx(5.0, rel=0.3)
        assert 0.2 < ratio < 1.5
    else:
        assert share < 0.02


@pytest.mark.parametrize("grown", [4.0, 0.25])
def test_an_alarm_makes_uncertain_what_came_of_the_fixes(
    grown: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sigmas twice as large: so is the position, and what it has in common; half as large: nothing."""
    keys = {"kind": "gnss", "filter": "point_mass", "monitor": "innovations", "barometer": "offset"}
    watched = PointMassFilter(FilterModel.of_navigation(Gnss.model_validate(keys), 0.1, 1), 3.0, 1, 1)
    active, shape, there = np.ones(1, dtype=bool), (1, 1, 3), np.ones((1, 1), dtype=bool)
    for _ in range(30):
        watched.take_in_heights(np.zeros((1, 1)), active)
        watched.correct(np.zeros(shape), np.zeros(shape), 9.0 * np.eye(3)[None, None], there, True, active)
        watched.predict(np.zeros(shape), active)
    before, offset = watched._packed.copy(), watched._offset.copy()
    monkeypatch.setattr(ScaleEvidence, "observe", lambda self, *told: np.full(shape, grown))
    watched._watched(np.zeros(shape), np.ones(shape), np.ones(shape), there)
    root = max(np.sqrt(grown), 1.0)
    factors = np.ones(10)
    factors[[0, 1, 3]] = root**2, root, root
    np.testing.assert_allclose(watched._packed, before * factors, rtol=1e-12)
    c, rate = before[0, 0, 2], offset[0, 0, 1] / before[0, 0, 2, 0]
    more = [0.0, root**2 * offset[0, 0, 1] - offset[0, 0, 1], rate * (root - 1.0) * c[1], 0.0]
    more += [rate * (root - 1.0) * c[3], rate**2 * (root**2 - 1.0) * c[0]]
    np.testing.assert_allclose(watched._offset[0, 0], offset[0, 0] + more, rtol=1e-12, atol=1e-15)


def test_refused_fixes_do_not_count_for_more_than_others() -> None:
    """A reflection of 30 m for 2.9 s, on one axis, whose velocity is refused: few take it for a scale."""
    keys = {"filter": "point_mass", "filter_correlation_time_s": 2.0, "monitor": "innovations"}
    model = FilterModel.of_navigation(GaussMarkov.model_validate(keys), 0.1, 1)
    watched, active, shape = PointMassFilter(model, 3.0, 100, 1), np.ones(100, dtype=bool), (100, 1, 3)
    for epoch, position in enumerate(errors(1.0, 300, 2.0, 18)):
        if epoch:
            watched.predict(np.zeros(shape), active)
        wrong = 150 <= epoch < 179
        watched.correct(
            position + np.array([30.0, 0.0, 0.0]) * wrong, np.full(shape, 3.0 * wrong),
            np.tile(9.0 * np.eye(3), (100, 1, 1, 1)), np.ones((100, 1), dtype=bool), True, active,
        )  # fmt: skip
    assert watched.monitor is not None
    assert (watched.refused_fixes >= 29).all()
    assert (watched.monitor.alarms > 0).mean() < 0.05


def test_flagged_in_the_street_and_in_its_results() -> None:
    """A fifth of the sigma of emulated receivers: found by most within 55 s, and in full."""
    keys = ["navigation.reported_sigma_scale=0.2"]
    problem = load_problem("street_canyon_gnss", [*keys, WATCHED])
    block = fly_block(problem, ["napf"], 41, range(3, 9))
    first: dict[tuple[int, int], float] = {}
    for run, uav, time_s in zip(block.events["run"], block.events["uav"], block.events["t_s"], strict=True):
        first.setdefault((int(run), int(uav)), float(time_s))
    assert len(first) >= 21  # of 24
    assert np.quantile(list(first.values()), 0.9) < 55.0
    assert (block.rows["monitor_scale"] >= 2.0).all()
    watched, plain = (
        navigate(load_problem("street_canyon_gnss", [*keys, *more]), 41, range(3, 9))
        for more in ([WATCHED], [])
    )
    sigma = [np.sqrt(np.einsum("...aa->...a", told.covariance))[-10:] for told in (watched, plain)]
    assert np.median(sigma[0]) > 2.0 * np.median(sigma[1])
    inside = [
        np.mean(np.abs(told.error[-10:]) < 3.0 * s) for told, s in zip((watched, plain), sigma, strict=True)
    ]
    assert inside[0] > inside[1] + 0.1


def test_without_an_alarm_a_flight_is_the_same_to_the_last_bit() -> None:
    keys = ["simulation.time_limit_s=10", "navigation.reported_sigma_scale=5"]
    flights = [
        simulate(load_problem("street_canyon_gnss", [*keys, *more]), "napf", seed=41, runs=3, record_every=25)
        for more in ([], [WATCHED])
    ]
    assert (flights[1].score.metrics["monitor_alarms"] == 0.0).all()
    for name in ("x_m", "est_x_m", "sigma_x_m"):
        np.testing.assert_array_equal(flights[0].trajectories[name], flights[1].trajectories[name])


def test_no_mission_depends_on_its_block() -> None:
    keys = ["simulation.time_limit_s=40", "navigation.reported_sigma_scale=0.2", WATCHED]
    problem = load_problem("street_canyon_gnss", keys)
    whole = fly_block(problem, ["napf"], 3, range(5)).rows
    parts = [fly_block(problem, ["napf"], 3, range(a, b)).rows for a, b in pairwise((0, 1, 5))]
    assert (whole["monitor_alarms"] > 0).any()
    for name in ("monitor_scale", "nees", "min_clearance_m"):
        np.testing.assert_array_equal(whole[name], np.concatenate([part[name] for part in parts]))


def test_it_takes_a_filter() -> None:
    with pytest.raises(ProblemError, match=r'watches a filter.s innovations, and navigation.filter = "none"'):
        load_problem("street_canyon_gnss", ["navigation.filter=none", WATCHED])
