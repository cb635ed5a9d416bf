"""First passage of correlated errors: against closed forms, other integrals and simulation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from napf_mpc.first_passage import _CORRECTION, first_passage_probability, long_run, mission_k
from napf_mpc.navigation.processes import gauss_markov


def phi(k: float) -> float:
    return float(stats.norm.sf(k))


TRIAL = {
    2.0: {0.1: 2.76, 0.05: 3.03, 0.01: 3.56, 0.003: 3.92},
    10.0: {0.1: 2.26, 0.05: 2.57, 0.01: 3.18, 0.003: 3.53},
    50.0: {0.1: 1.79, 0.05: 2.14, 0.01: 2.81, 0.003: 3.17},
}


@pytest.mark.parametrize("tau", TRIAL)
def test_levels_of_an_independent_trial(tau: float) -> None:
    """Found there by simulation: where they differ, theirs have the noise of some hundred passages."""
    for risk, k in TRIAL[tau].items():
        assert mission_k(risk, 15.0, tau, 0.1) == pytest.approx(k, abs=0.012 if risk > 0.01 else 0.05)


@pytest.mark.parametrize("tau", [0.3, 2.0, 10.0, 50.0])
def test_agrees_with_simulation(tau: float) -> None:
    runs, samples = 60_000, 150
    z = np.random.default_rng(7).standard_normal((runs, samples))
    highest = gauss_markov(z, 0.1, tau).max(-1)
    for k in (2.0, 2.5, 3.2):
        p = first_passage_probability(k, 15.0, tau, 0.1)
        assert (highest > k).mean() == pytest.approx(p, abs=4.0 * math.sqrt(p / runs))


@pytest.mark.parametrize("k", [-1.0, 0.0, 1.5, 3.0])
@pytest.mark.parametrize("tau", [0.02, 1.0, 30.0])
def test_two_and_three_samples_are_normal_integrals(k: float, tau: float) -> None:
    rho = math.exp(-0.1 / tau)
    for n, tolerance in ((2, 1e-9), (3, 1e-6)):
        covariance = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        law = stats.multivariate_normal(np.zeros(n), covariance, abseps=1e-9, releps=1e-9)
        below = law.cdf(np.full(n, k))
        assert first_passage_probability(k, 0.1 * n, tau, 0.1) == pytest.approx(1.0 - below, abs=tolerance)


@pytest.mark.parametrize("ratio", [1e-4, 0.01, 0.3, 1.0, 5.0])
def test_level_zero_seen_at_all_times_has_a_closed_form(ratio: float) -> None:
    """A process stays below its mean with probability arcsin(exp(-T / tau)) / pi (Slepian 1962)."""
    expected = 1.0 - math.asin(math.exp(-ratio)) / math.pi
    assert first_passage_probability(0.0, 10.0 * ratio, 10.0, 0.0) == pytest.approx(expected, rel=1e-6)


def test_dense_samples_see_what_is_seen_at_all_times() -> None:
    for k, tau in ((0.5, 10.0), (3.0, 10.0), (3.0, 200.0)):
        continuous = first_passage_probability(k, 15.0, tau, 0.0)
        missed = [continuous - first_passage_probability(k, 15.0, tau, dt) for dt in (0.1, 0.05, 0.0125)]
        assert missed[0] > missed[1] > missed[2] > 0.0
        # What is missed goes with the root of the period, so its limit can be told from two.
        assert abs(2.0 * missed[2] - missed[1]) < 0.005 * continuous


def test_long_missions_with_dense_samples() -> None:
    """Beyond the largest matrix: on both sides of the change of method, and against the long run."""
    before = first_passage_probability(3.0, 440.0, 450.0, 0.1)
    after = first_passage_probability(3.0, 440.0, 450.0, 0.05)
    assert after == pytest.approx(before, rel=0.02)
    assert after > before
    entry, rate = long_run(3.0, 1000.0, 0.1)
    passed = first_passage_probability(3.0, 3600.0, 1000.0, 0.1)
    assert passed == pytest.approx(-math.expm1(-entry - 3600.0 * rate), rel=0.01)


def test_limits() -> None:
    assert first_passage_probability(2.0, 15.0, 0.0, 0.1) == pytest.approx(1.0 - (1.0 - phi(2.0)) ** 150)
    assert first_passage_probability(2.0, 15.0, math.inf, 0.1) == pytest.approx(phi(2.0))
    assert first_passage_probability(2.0, 15.0, 1e-3, 0.1) == pytest.approx(1.0 - (1.0 - phi(2.0)) ** 150)
    assert first_passage_probability(2.0, 15.0, 1e9, 0.1) == pytest.approx(phi(2.0), rel=2e-3)
    assert first_passage_probability(2.0, 0.0, 10.0, 0.1) == pytest.approx(phi(2.0))
    assert first_passage_probability(2.0, 0.0, 10.0, 0.0) == pytest.approx(phi(2.0))
    assert first_passage_probability(-30.0, 1.0, 10.0, 0.1) == pytest.approx(1.0)
    assert first_passage_probability(12.0, 15.0, 10.0, 0.1) < 1e-25


@settings(max_examples=25)
@given(k=st.floats(-1.0, 4.5), tau=st.floats(0.05, 100.0), samples=st.integers(1, 300))
def test_between_one_moment_and_independent_moments(k: float, tau: float, samples: int) -> None:
    p = first_passage_probability(k, 0.1 * samples, tau, 0.1)
    assert phi(k) * (1 - 1e-9) <= p <= -math.expm1(samples * math.log1p(-phi(k))) * (1 + 1e-9)
    assert first_passage_probability(k, 0.1 * samples + 0.1, tau, 0.1) >= p * (1 - 1e-9)
    assert first_passage_probability(k + 0.1, 0.1 * samples, tau, 0.1) <= p
    assert first_passage_probability(k, 0.1 * samples, 1.5 * tau, 0.1) <= p * (1 + 1e-9)


@settings(max_examples=30)
@given(risk=st.floats(1e-7, 0.5), tau=st.sampled_from([0.0, 2.0, 10.0, math.inf]))
def test_level_and_chance_are_inverse(risk: float, tau: float) -> None:
    k = mission_k(risk, 15.0, tau, 0.1)
    assert k == 0.0 or first_passage_probability(k, 15.0, tau, 0.1) == pytest.approx(risk, rel=1e-6)


def test_a_level_is_never_negative() -> None:
    assert mission_k(0.9, 15.0, math.inf, 0.1) == 0.0


@pytest.mark.parametrize("tau", [0.0, 0.5, 2.0, 10.0, 50.0, 300.0, math.inf])
@pytest.mark.parametrize("k", [0.5, 2.0, 3.0, 4.0])
def test_entry_and_rate_bound_every_duration(tau: float, k: float) -> None:
    entry, rate = long_run(k, tau, 0.1)
    for duration in (0.1, 1.5, 15.0, 150.0):
        exact = first_passage_probability(k, duration, tau, 0.1)
        bound = -math.expm1(-entry - rate * duration)
        assert exact * (1.0 - 5e-3) <= bound
        if duration >= 0.3 * tau or math.isinf(tau):
            assert bound <= 1.25 * exact


def test_long_run_is_exact_in_the_long_run() -> None:
    for k, tau in ((2.0, 2.0), (3.0, 10.0)):
        entry, rate = long_run(k, tau, 0.1)
        exact = first_passage_probability(k, 20.0 * tau, tau, 0.1)
        assert -math.expm1(-entry - rate * 20.0 * tau) == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: first_passage_probability(math.nan, 15.0, 10.0, 0.1), "k = nan"),
        (lambda: first_passage_probability(3.0, -1.0, 10.0, 0.1), "duration_s"),
        (lambda: first_passage_probability(3.0, math.inf, 10.0, 0.1), "duration_s"),
        (lambda: first_passage_probability(3.0, 15.0, math.nan, 0.1), "correlation_time_s"),
        (lambda: first_passage_probability(3.0, 15.0, 10.0, -0.1), "period_s"),
        (lambda: first_passage_probability(3.0, 15.0, 0.0, 0.0), "white noise"),
        (lambda: mission_k(0.0, 15.0, 10.0, 0.1), "risk = 0.0"),
        (lambda: mission_k(1.0, 15.0, 10.0, 0.1), "risk = 1.0"),
        (lambda: mission_k(math.nan, 15.0, 10.0, 0.1), "risk = nan"),
        (lambda: long_run(math.inf, 10.0, 0.1), "k = inf"),
    ],
)
def test_what_makes_no_sense_is_refused(call, words: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=words):
        call()


def test_the_correction_for_looking_at_intervals_is_chernoffs() -> None:
    """zeta(1/2) by Euler and Maclaurin: the sum of n^(-1/2) less its integral."""
    n = np.arange(1.0, 1_000_001.0)
    last = n[-1]
    zeta = math.fsum(n**-0.5) - 2.0 * math.sqrt(last) - 0.5 / math.sqrt(last)
    assert pytest.approx(-zeta / math.sqrt(2.0 * math.pi), abs=1e-9) == _CORRECTION
