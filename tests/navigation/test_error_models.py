"""Position errors: their laws, what is reported about them, and that blocks and totals change nothing."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, norm

from napf_mpc.errors import DataError, ProblemError
from napf_mpc.navigation.error_models import gauss_markov_errors, position_errors
from napf_mpc.navigation.fix import COAST_SIGMA_MPS, Fix
from napf_mpc.navigation.processes import (
    gauss_markov,
    has_fix,
    last_fix,
    mixed,
    outage_starts,
    swinging_sigma,
)
from napf_mpc.problem import ConstantBias, GaussMarkov, Navigation, Recorded

SURE = (
    1.0 - 1e-6
)  # two-sided probability of the bounds below; seeds are fixed, so a test passes always or never
Z = float(norm.ppf(0.5 + SURE / 2))


@pytest.fixture(scope="session")
def log_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 40 s with gaps and correlated axes."""
    folder = tmp_path_factory.mktemp("log")
    rng = np.random.default_rng(7)
    names = (
        "t_s,available,err_e_m,err_n_m,err_u_m,cov_ee_m2,cov_en_m2,cov_eu_m2,cov_nn_m2,cov_nu_m2,cov_uu_m2"
    )
    lines = [names]
    for t in range(40):
        if t % 7 in (3, 4, 5):
            lines.append(f"{t}.0,0" + "," * 9)
            continue
        root = rng.normal(size=(3, 3)) + 2.0 * np.eye(3)
        c = root @ root.T
        values = [*(root @ rng.normal(size=3)), c[0, 0], c[0, 1], c[0, 2], c[1, 1], c[1, 2], c[2, 2]]
        lines.append(f"{t}.0,1," + ",".join(f"{v:.6f}" for v in values))
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return folder


def recorded(**changes: object) -> Recorded:
    return Recorded.model_validate({"kind": "recorded", "file": "log.csv"} | changes)


def sigma_of(fix: Fix) -> np.ndarray:
    return np.sqrt(np.einsum("ruii->rui", fix.covariance))


def assert_same(a: Fix, b: Fix) -> None:
    for name in ("error", "covariance", "common_factor", "available"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def part(fix: Fix, runs: slice, uavs: slice) -> Fix:
    return Fix(*(getattr(fix, n)[runs, uavs] for n in ("error", "covariance", "common_factor", "available")))


# ----------------------------------------------------------------------------------------- pure maps


@pytest.mark.parametrize("tau_s", [0.0, 0.05, 2.0, 10.0, 50.0])
def test_lag_correlation_is_exp_of_lag_over_tau(tau_s: float):
    """20 000 independent series: pairs of samples one, five and twenty periods apart, from the first on."""
    n = 20_000
    g = gauss_markov(np.random.default_rng(3).standard_normal((n, 21)), 0.1, tau_s)
    for lag in (1, 5, 20):
        expected = math.exp(-0.1 * lag / tau_s) if tau_s else 0.0
        found = float(np.mean(g[:, 0] * g[:, lag]))
        assert abs(found - expected) < Z * math.sqrt((1.0 + expected**2) / n)
        # sharper than the line above where the correlation is near 1
        increment = float(np.mean((g[:, lag] - expected * g[:, 0]) ** 2))
        innovation = 1.0 - expected**2
        assert abs(increment - innovation) < Z * innovation * math.sqrt(2.0 / n)
    for epoch in (0, 1, 20):  # stationary from the first sample
        assert abs(float(np.mean(g[:, epoch] ** 2)) - 1.0) < Z * math.sqrt(2.0 / n)


def test_no_correlation_time_is_white_and_an_endless_one_is_constant():
    z = np.random.default_rng(0).standard_normal((2, 3, 9))
    np.testing.assert_array_equal(gauss_markov(z, 0.1, 0.0), z)
    np.testing.assert_array_equal(gauss_markov(z, 0.1, math.inf), np.broadcast_to(z[..., :1], z.shape))


@given(tau_s=st.floats(0.0, 1e6), period_s=st.floats(0.01, 10.0), n=st.integers(1, 30))
def test_each_series_is_the_same_bits_alone_and_in_company(tau_s: float, period_s: float, n: int):
    z = np.random.default_rng(5).standard_normal((3, 2, 31))
    whole = gauss_markov(z, period_s, tau_s)
    np.testing.assert_array_equal(gauss_markov(z[1, 1, :n], period_s, tau_s), whole[1, 1, :n])
    assert np.isfinite(whole).all()


def test_the_input_is_left_as_it_was():
    z = np.ones((2, 4))
    gauss_markov(z, 0.1, 1.0)
    np.testing.assert_array_equal(z, 1.0)


@pytest.mark.parametrize(
    ("z", "period_s", "tau_s"),
    [
        ([1.0, np.nan], 0.1, 1.0),
        ([1.0, np.inf], 0.1, 1.0),
        ([1.0], 0.0, 1.0),
        ([1.0], math.nan, 1.0),
        ([1.0], 0.1, -1.0),
        ([1.0], 0.1, math.nan),
    ],
)
def test_unusable_numbers_are_refused(z: list[float], period_s: float, tau_s: float):
    with pytest.raises(ValueError, match=r"z|period_s|correlation_time_s"):
        gauss_markov(np.array(z), period_s, tau_s)


def test_sigma_swings_between_its_bounds():
    """Paper's 1-5 m: mean, top, mean, bottom, mean in quarters of a period."""
    np.testing.assert_allclose(
        swinging_sigma([0.0, 5.0, 10.0, 15.0, 20.0], 1.0, 5.0, 20.0, 0.0),
        [3.0, 5.0, 3.0, 1.0, 3.0],
        atol=1e-12,
    )
    assert swinging_sigma(0.0, 1.0, 5.0, 20.0, math.pi / 2) == pytest.approx(5.0)
    np.testing.assert_array_equal(swinging_sigma(np.arange(9.0), 2.0, 2.0, 20.0, 0.3), 2.0)


@pytest.mark.parametrize("share", [-0.1, 1.1, math.nan])
def test_a_share_outside_zero_to_one_is_refused(share: float):
    with pytest.raises(ValueError, match="share"):
        mixed(np.zeros(3), np.zeros(3), share)


def test_outages_start_and_end_where_they_should():
    # u = 1 - exp(-x): with a mean of 2 s the times with fixes are 2 x seconds
    starts = outage_starts(-np.expm1(-np.array([1.0, 0.5])), 2.0, 3.0)
    np.testing.assert_allclose(starts, [2.0, 6.0])
    time = np.array([0.0, 1.9, 2.0 + 1e-9, 4.9, 5.1, 5.9, 6.0 + 1e-9, 8.9, 9.1])
    fixes = has_fix(starts, 3.0, time)
    np.testing.assert_array_equal(fixes, [True, True, False, False, True, True, False, False, True])
    np.testing.assert_array_equal(last_fix(fixes), [0, 1, 1, 1, 4, 5, 5, 5, 8])


@pytest.mark.parametrize("u", [1.0, -0.1, np.nan])
def test_what_is_no_uniform_number_makes_no_outages(u: float):
    with pytest.raises(ValueError, match="u must"):
        outage_starts(np.array([0.5, u]), 1.0, 1.0)


# ---------------------------------------------------------------------------- laws of the drawn errors


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("tau_s", [0.0, 10.0])
def test_errors_stay_within_k_sigma_as_often_as_a_normal_law_says(tau_s: float, share: float):
    """At fixed times, one UAV and axis of 4000 runs (independent trials), sigma being that of the moment."""
    n = 4000
    errors = position_errors(
        GaussMarkov(correlation_time_s=tau_s, common_mode_share=share, rate_hz=1.0),
        11,
        range(n),
        1,
        7.0,
        None,
    )
    for epoch in (0, 3, 7):
        fix = errors.fix(epoch)
        sigma = sigma_of(fix)
        assert (sigma >= 1.0).all()
        assert (sigma <= 5.0).all()
        for k in (0.5, 1.0, 2.0, 3.0):
            low, high = binom.interval(SURE, n, math.erf(k / math.sqrt(2.0)))
            for axis in range(3):
                inside = np.count_nonzero(np.abs(fix.error[:, 0, axis]) < k * sigma[:, 0, axis])
                assert low <= inside <= high, (epoch, k, axis, inside, n)


def test_sigma_swings_with_a_random_phase_on_each_uav_and_axis():
    errors = position_errors(GaussMarkov(), 2, range(5), 2, 40.0, None)
    sigma = np.array([sigma_of(errors.fix(k)) for k in range(401)])
    np.testing.assert_allclose(sigma[:201], sigma[200:], atol=1e-9)  # period 20 s
    np.testing.assert_allclose(sigma.min(axis=0), 1.0, atol=1e-3)
    np.testing.assert_allclose(sigma.max(axis=0), 5.0, atol=1e-3)
    assert len(np.unique(sigma[0])) == sigma[0].size


@pytest.mark.parametrize("kind", [GaussMarkov, ConstantBias])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_uavs_correlate_by_the_common_mode_share(kind: type, share: float):
    """2000 runs x 3 axes = 6000 independent pairs."""
    name = "constant" if kind is ConstantBias else "gauss_markov"
    errors = position_errors(kind(kind=name, common_mode_share=share), 5, range(2000), 2, 0.3, None)
    fix = errors.fix(3)
    g = fix.error / sigma_of(fix)
    a, b = g[:, 0].ravel(), g[:, 1].ravel()
    if share == 1.0:
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert abs(np.mean(a * b) - share) < Z * math.sqrt((1.0 + share**2) / a.size)
    spread = 1.0 - share
    assert np.mean((a - b) ** 2) == pytest.approx(
        2.0 * spread, abs=2.0 * spread * Z * math.sqrt(2.0 / a.size) + 1e-12
    )


@pytest.mark.parametrize("config", [
    GaussMarkov(common_mode_share=0.8),
    ConstantBias(kind="constant", common_mode_share=0.5),
])  # fmt: skip
def test_the_common_factor_gives_the_relative_covariance_that_errors_have(config: Navigation):
    """Difference of two UAVs over its reported sigma: unit variance (3000 runs x 3 axes)."""
    fix = position_errors(config, 8, range(3000), 2, 1.0, None).fix(10)
    cross = np.einsum("rak,rbk->rab", fix.common_factor[:, 0], fix.common_factor[:, 1])
    relative = fix.covariance[:, 0] + fix.covariance[:, 1] - cross - cross.transpose(0, 2, 1)
    variances = np.einsum("rii->ri", relative)
    unit = (fix.error[:, 0] - fix.error[:, 1]) / np.sqrt(variances)
    assert abs(np.mean(unit**2) - 1.0) < Z * math.sqrt(2.0 / unit.size)
    assert np.mean(variances) < np.mean(np.einsum("rii->ri", fix.covariance[:, 0] + fix.covariance[:, 1]))


def test_a_constant_error_stays_and_its_sigma_is_uniform():
    errors = position_errors(ConstantBias(kind="constant"), 3, range(500), 4, 20.0, None)
    assert_same(errors.fix(0), errors.fix(200))
    sigma = sigma_of(errors.fix(0)).ravel()
    assert 1.0 <= sigma.min() < 1.05
    assert 4.95 < sigma.max() <= 5.0
    assert abs(sigma.mean() - 3.0) < Z * (4.0 / math.sqrt(12.0)) / math.sqrt(sigma.size)


# ----------------------------------------------------------------------------- what the settings touch

EVERY = [
    GaussMarkov(common_mode_share=0.4),
    GaussMarkov(common_mode_share=0.4, outage_interval_s=10.0, correlation_time_s=0.0),
    GaussMarkov(outage_interval_s=15.0, outage_duration_s=3.0, common_mode_share=0.7),
    ConstantBias(kind="constant", common_mode_share=0.4),
    recorded(common_mode_share=0.4),
    recorded(),
    recorded(gaps="outage", common_mode_share=0.4, vertical="recorded"),
    recorded(gaps="outage", rate_hz=4.0),
]
EVERY_NAME = ["gm", "gm-white-outages", "gm-outages", "constant", "log", "log-own", "log-outages", "log-4hz"]
every = pytest.mark.parametrize("config", EVERY, ids=EVERY_NAME)


@every
def test_error_scale_touches_only_errors(config: Navigation, log_folder: Path):
    def errors(scale: float):
        return position_errors(
            config.model_copy(update={"error_scale": scale}), 1, range(3), 2, 30.0, log_folder
        )

    for epoch in (0, 57, 120):
        plain, none, five = (errors(scale).fix(epoch) for scale in (1.0, 0.0, 5.0))
        np.testing.assert_array_equal(none.error, 0.0)
        np.testing.assert_allclose(five.error, 5.0 * plain.error, rtol=1e-15)
        for other in (none, five):
            np.testing.assert_array_equal(other.covariance, plain.covariance)
            np.testing.assert_array_equal(other.common_factor, plain.common_factor)
            np.testing.assert_array_equal(other.available, plain.available)
        assert np.abs(plain.error).min() > 0.0


@every
def test_reported_sigma_scale_touches_only_the_report(config: Navigation, log_folder: Path):
    def errors(scale: float):
        return position_errors(
            config.model_copy(update={"reported_sigma_scale": scale}), 1, range(3), 2, 30.0, log_folder
        )

    for epoch in (0, 57, 120):
        plain, half = errors(1.0).fix(epoch), errors(0.5).fix(epoch)
        np.testing.assert_array_equal(half.error, plain.error)
        np.testing.assert_allclose(half.covariance, 0.25 * plain.covariance, rtol=1e-14)
        np.testing.assert_allclose(half.common_factor, 0.5 * plain.common_factor, rtol=1e-14)


@every
def test_first_epochs_runs_and_uavs_never_change_with_the_total(config: Navigation, log_folder: Path):
    short = position_errors(config, 9, range(6), 3, 60.0, log_folder)
    longer = position_errors(config, 9, range(6), 3, 110.0, log_folder)
    block = position_errors(config, 9, range(2, 5), 3, 60.0, log_folder)
    one = position_errors(config, 9, range(4, 5), 3, 60.0, log_folder)
    more = position_errors(config, 9, range(11), 5, 60.0, log_folder)
    every_uav, three = slice(None), slice(0, 3)
    for epoch in range(0, round(60.0 * config.rate_hz) + 1, 7):
        fix = short.fix(epoch)
        assert_same(longer.fix(epoch), fix)
        assert_same(block.fix(epoch), part(fix, slice(2, 5), every_uav))
        assert_same(one.fix(epoch), part(fix, slice(4, 5), every_uav))
        assert_same(part(more.fix(epoch), slice(0, 6), three), fix)


@every
def test_seeds_runs_uavs_and_axes_differ(config: Navigation, log_folder: Path):
    first = position_errors(config, 9, range(3), 2, 30.0, log_folder).fix(5).error
    second = position_errors(config, 10, range(3), 2, 30.0, log_folder).fix(5).error
    assert not np.isclose(first, second).all()
    assert not np.isclose(first[0], first[1]).all()
    assert not np.isclose(first[:, 0], first[:, 1]).all()
    assert not np.isclose(first[..., 0], first[..., 1]).any()


@every
def test_every_fix_is_finite_of_the_right_shape_and_a_covariance(config: Navigation, log_folder: Path):
    errors = position_errors(config, 4, range(4), 3, 50.0, log_folder)
    assert errors.period_s == 1.0 / config.rate_hz
    for epoch in range(0, round(50.0 * config.rate_hz) + 1, 3):
        fix = errors.fix(epoch)
        assert fix.error.shape == (4, 3, 3)
        assert fix.covariance.shape == (4, 3, 3, 3)
        assert fix.common_factor.shape[:3] == (4, 3, 3)
        assert fix.available.shape == (4, 3)
        assert fix.available.dtype == np.bool_
        assert np.isfinite(fix.error).all()
        np.testing.assert_array_equal(fix.covariance, fix.covariance.transpose(0, 1, 3, 2))
        # the part that is not shared must be a covariance as well: the joint matrix of all UAVs is then PSD
        own = fix.covariance - fix.common_factor @ fix.common_factor.transpose(0, 1, 3, 2)
        assert np.linalg.eigvalsh(own).min() > -1e-9
        assert np.linalg.eigvalsh(fix.covariance).min() > 0.0


@every
def test_epochs_that_were_not_drawn_are_refused(config: Navigation, log_folder: Path):
    errors = position_errors(config, 4, range(1), 1, 2.0, log_folder)
    errors.fix(round(2.0 * config.rate_hz))
    for epoch in (-1, round(2.0 * config.rate_hz) + 1):
        with pytest.raises(IndexError, match="epoch"):
            errors.fix(epoch)


@every
def test_fixes_cannot_be_changed_by_who_reads_them(config: Navigation, log_folder: Path):
    fix = position_errors(config, 4, range(2), 2, 2.0, log_folder).fix(3)
    for array in (fix.error, fix.covariance, fix.common_factor, fix.available):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


# -------------------------------------------------------------------------------------------- outages


def test_the_share_of_outages_is_duration_over_interval_and_duration():
    """Mean 20 s with fixes, 5 s without: 20 % in the long run (160 UAVs, 2000 s, 12 800 cycles)."""
    config = GaussMarkov(outage_interval_s=20.0, outage_duration_s=5.0, rate_hz=1.0)
    errors = position_errors(config, 6, range(40), 4, 2000.0, None)
    available = np.array([errors.fix(k).available for k in range(2001)])
    assert available[0].all()
    assert np.mean(~available[200:]) == pytest.approx(0.2, abs=0.01)
    # without end effects: the steady state is forgotten within a few cycles, the mean over UAVs is steady
    assert np.mean(~available[1000]) == pytest.approx(0.2, abs=Z * math.sqrt(0.2 * 0.8 / 160))


def test_in_an_outage_the_error_is_frozen_and_the_report_grows():
    config = GaussMarkov(
        outage_interval_s=8.0, outage_duration_s=4.0, common_mode_share=0.5, correlation_time_s=10.0
    )
    errors = position_errors(config, 6, range(20), 2, 60.0, None)
    plain = position_errors(config.model_copy(update={"outage_interval_s": 0.0}), 6, range(20), 2, 60.0, None)
    last = errors.fix(0)
    error, variance, factor = last.error.copy(), last.covariance.copy(), last.common_factor.copy()
    age = np.zeros((20, 2))
    longest = 0.0
    for epoch in range(601):
        fix, free = errors.fix(epoch), plain.fix(epoch)
        here = fix.available
        age = np.where(here, 0.0, age + 0.1)
        error[here], variance[here], factor[here] = (
            free.error[here],
            free.covariance[here],
            free.common_factor[here],
        )
        np.testing.assert_array_equal(fix.error, error)
        growth = (COAST_SIGMA_MPS * age) ** 2
        np.testing.assert_allclose(fix.covariance, variance + growth[..., None, None] * np.eye(3), rtol=1e-9)
        np.testing.assert_allclose(
            fix.common_factor, factor * np.exp(-age / 10.0)[..., None, None], rtol=1e-9
        )
        longest = max(longest, float(age.max()))
    # each outage ends after 4 s, though one may follow so soon that there is no fix between
    assert longest > 3.8


@pytest.mark.parametrize("tau_s", [0.0, 5.0])
def test_what_a_frozen_error_still_shares_is_what_is_reported(tau_s: float):
    """UAV 0 without a fix for 4 s, UAV 1 with: covariance of their errors (4000 runs x 3 axes)."""
    runs, epochs = 4000, 41
    config = GaussMarkov(common_mode_share=0.8, correlation_time_s=tau_s)
    rng = np.random.default_rng(12)
    available = np.ones((epochs, runs, 2), dtype=bool)
    available[1:, :, 0] = False
    errors = gauss_markov_errors(
        config,
        rng.standard_normal((runs, 2, 3, epochs)),
        rng.standard_normal((runs, 1, 3, epochs)),
        rng.random((runs, 2, 3)),
        available,
    )
    fix = errors.fix(epochs - 1)
    factor = np.einsum("ruii->rui", fix.common_factor)
    sigma = np.sqrt(np.einsum("ruii->rui", fix.covariance) - [[[(COAST_SIGMA_MPS * 4.0) ** 2], [0.0]]])
    claimed = np.mean(factor.prod(axis=1) / sigma.prod(axis=1))
    expected = 0.8 * math.exp(-4.0 / tau_s) if tau_s else 0.0
    assert claimed == pytest.approx(expected, abs=1e-12)
    found = np.mean(fix.error.prod(axis=1) / sigma.prod(axis=1))
    assert abs(found - expected) < Z * math.sqrt((1.0 + expected**2) / (3 * runs))


def test_two_frozen_errors_never_share_less_than_is_reported():
    """Both without a fix since the same moment: what is claimed as shared is on the safe side."""
    runs, epochs = 4000, 31
    rng = np.random.default_rng(13)
    available = np.ones((epochs, runs, 2), dtype=bool)
    available[1:] = False
    errors = gauss_markov_errors(
        GaussMarkov(common_mode_share=0.8),
        rng.standard_normal((runs, 2, 3, epochs)),
        rng.standard_normal((runs, 1, 3, epochs)),
        rng.random((runs, 2, 3)),
        available,
    )
    fix = errors.fix(epochs - 1)
    cross = np.einsum("rak,rbk->rab", fix.common_factor[:, 0], fix.common_factor[:, 1])
    relative = fix.covariance[:, 0] + fix.covariance[:, 1] - cross - cross.transpose(0, 2, 1)
    unit = (fix.error[:, 0] - fix.error[:, 1]) / np.sqrt(np.einsum("rii->ri", relative))
    assert np.mean(unit**2) < 1.0


def test_an_outage_interval_shorter_than_a_fix_period_is_refused():
    with pytest.raises(ProblemError, match="outage_interval_s"):
        position_errors(GaussMarkov(outage_interval_s=1e-9), 1, range(1), 1, 1.0, None)


def test_an_outage_of_no_length_is_none():
    errors = position_errors(
        GaussMarkov(outage_interval_s=1.0, outage_duration_s=0.0), 1, range(2), 2, 9.0, None
    )
    assert all(errors.fix(k).available.all() for k in range(91))


# ------------------------------------------------------------------------------------------- the rest


@pytest.mark.parametrize("duration_s", [-1.0, math.nan, math.inf])
def test_a_duration_must_be_finite(duration_s: float):
    with pytest.raises(ValueError, match="duration_s"):
        position_errors(GaussMarkov(), 1, range(1), 1, duration_s, None)


def test_a_missing_log_names_file_folder_and_way_out(tmp_path: Path):
    config = recorded(file="gnss_nagoya_spp/nav_error_enu_1Hz.csv")
    with pytest.raises(DataError, match=r"nav_error_enu_1Hz\.csv") as caught:
        position_errors(config, 1, range(1), 1, 1.0, tmp_path)
    for word in (str(tmp_path), "--data", "NAPF_MPC_DATA", "taroz/MatRTKLIB"):
        assert word in str(caught.value)
