"""Replay of a log: where it starts, what two UAVs share, gaps, and the barometer."""

import math
from pathlib import Path

import numpy as np
import pytest

from napf_mpc.errors import DataError
from napf_mpc.navigation.error_models import position_errors
from napf_mpc.navigation.fix import COAST_SIGMA_MPS
from napf_mpc.navigation.recorded import ErrorLog, coverage
from napf_mpc.navigation.replay import RecordedErrors, load_error_log, replay
from napf_mpc.problem import Recorded
from napf_mpc.streams import Stream, uniforms

N = 10


def config(**changes: object) -> Recorded:
    return Recorded.model_validate({"kind": "recorded", "file": "log.csv", "vertical": "recorded"} | changes)


def staircase(available: list[int] | None = None, step_s: float = 1.0) -> ErrorLog:
    """Epoch k has the error (k + 1, 10 (k + 1), 100 (k + 1)) m: it can be told which epoch is replayed."""
    k = np.arange(1.0, N + 1.0)
    root = np.array([[2.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.3, -0.2, 3.0]])
    covariance = k[:, None, None] * (root @ root.T)
    has_fix = np.ones(N, dtype=bool) if available is None else np.array(available, dtype=bool)
    return ErrorLog("staircase", step_s * (k - 1.0), has_fix, k[:, None] * [1.0, 10.0, 100.0], covariance)


def flown(
    cfg: Recorded, log: ErrorLog, common: list[float], own: list[list[float]], epochs: int
) -> RecordedErrors:
    return replay(cfg, log, np.array(common), np.array(own), epochs, None)


def epochs_of(errors: RecordedErrors, uav: int, count: int) -> list[float]:
    """Which epochs of the staircase UAV ``uav`` sees (share 0 or 1)."""
    return [float(errors.fix(k).error[0, uav, 0]) - 1.0 for k in range(count)]


def test_each_sample_is_held_and_the_log_wraps():
    errors = flown(config(rate_hz=2.0), staircase(), [0.0], [[0.0, 0.75]], 30)
    assert epochs_of(errors, 0, 30) == [k // 2 % N for k in range(30)]
    assert epochs_of(errors, 1, 30) == [(7 + k // 2) % N for k in range(30)]
    np.testing.assert_array_equal(errors.fix(5).covariance[0, 0], staircase().covariance[2])


@pytest.mark.parametrize("rate_hz", [10.0, 3.0, 50.0, 49.0])
def test_samples_change_on_the_second_at_any_rate(rate_hz: float):
    errors = flown(config(rate_hz=rate_hz), staircase(), [0.0], [[0.0]], round(9 * rate_hz) + 1)
    for second in range(1, 10):
        assert epochs_of(errors, 0, round(second * rate_hz) + 1)[-2:] == [second - 1.0, float(second)]


def test_a_faster_log_is_sampled():
    errors = flown(config(rate_hz=1.0), staircase(step_s=0.2), [0.0], [[0.0]], 5)
    assert epochs_of(errors, 0, 5) == [0, 5, 0, 5, 0]


def test_with_everything_in_common_all_uavs_have_one_error():
    errors = flown(config(common_mode_share=1.0, rate_hz=1.0), staircase(), [0.35], [[0.0, 0.5, 0.9]], 4)
    fix = errors.fix(2)
    assert epochs_of(errors, 2, 4) == [3, 4, 5, 6]
    np.testing.assert_array_equal(fix.error[0, 0], fix.error[0, 2])
    np.testing.assert_allclose(
        fix.common_factor[0, 0] @ fix.common_factor[0, 1].T, fix.covariance[0, 0], atol=1e-12
    )


def test_mixing_adds_errors_by_root_and_covariances_by_share():
    log, c = staircase(), 0.36
    fix = flown(config(common_mode_share=c, rate_hz=1.0), log, [0.2], [[0.5, 0.9]], 2).fix(1)
    common, own = 3, [6, 0]
    for uav in range(2):
        np.testing.assert_allclose(fix.error[0, uav], 0.6 * log.error[common] + 0.8 * log.error[own[uav]])
        np.testing.assert_allclose(
            fix.covariance[0, uav], c * log.covariance[common] + (1 - c) * log.covariance[own[uav]]
        )
    shared = fix.common_factor[0, 0] @ fix.common_factor[0, 1].T
    np.testing.assert_allclose(shared, c * log.covariance[common], atol=1e-12)


def test_gaps_are_closed_up():
    available = [1, 0, 0, 1, 1, 0, 1, 0, 0, 0]
    errors = flown(config(rate_hz=1.0), staircase(available), [0.0], [[0.0, 0.5]], 8)
    assert epochs_of(errors, 0, 8) == [0, 3, 4, 6, 0, 3, 4, 6]
    assert epochs_of(errors, 1, 8) == [4, 6, 0, 3, 4, 6, 0, 3]
    assert all(errors.fix(k).available.all() for k in range(8))


def test_gaps_are_replayed_as_outages():
    available = [1, 0, 0, 1, 1, 0, 1, 0, 0, 0]
    log = staircase(available)
    errors = flown(config(rate_hz=2.0, gaps="outage"), log, [0.0], [[0.0, 0.8]], 24)
    last = [0, 0, 0, 3, 4, 4, 6, 6, 6, 6, 0, 0]
    ages = [0, 1, 2, 0, 0, 1, 0, 1, 2, 3, 0, 1]
    assert epochs_of(errors, 0, 24) == [last[k // 2] for k in range(24)]
    for k in range(24):
        fix = errors.fix(k)
        assert fix.available[0, 0] == available[k // 2 % N]
        age = 0.0 if fix.available[0, 0] else ages[k // 2] + 0.5 * (k % 2)
        expected = log.covariance[last[k // 2]] + (COAST_SIGMA_MPS * age) ** 2 * np.eye(3)
        np.testing.assert_allclose(fix.covariance[0, 0], expected, rtol=1e-12)
    # UAV 1 starts two samples after the fix of sample 6: its error is the one of then, as old as it is
    fix = errors.fix(0)
    assert not fix.available[0, 1]
    assert epochs_of(errors, 1, 6) == [6, 6, 6, 6, 0, 0]
    np.testing.assert_allclose(
        fix.covariance[0, 1], log.covariance[6] + (COAST_SIGMA_MPS * 2.0) ** 2 * np.eye(3)
    )


def test_a_log_that_starts_in_a_gap_carries_on_from_its_end():
    log = staircase([0, 0, 1, 1, 1, 1, 1, 1, 1, 1])
    errors = flown(config(rate_hz=1.0, gaps="outage"), log, [0.0], [[0.1]], 3)
    assert epochs_of(errors, 0, 3) == [9, 2, 3]
    fix = errors.fix(0)  # sample 1, two seconds after the log's last
    np.testing.assert_allclose(
        fix.covariance[0, 0] - log.covariance[9], (COAST_SIGMA_MPS * 2.0) ** 2 * np.eye(3)
    )


def test_rows_left_out_of_a_log_are_gaps_as_well():
    full = staircase([1, 0, 0, 1, 1, 0, 1, 1, 1, 1])
    kept = full.available
    thin = ErrorLog("thin", full.time_s[kept], kept[kept], full.error[kept], full.covariance[kept])
    a = flown(config(rate_hz=1.0, gaps="outage"), full, [0.0], [[0.3]], 20)
    b = flown(config(rate_hz=1.0, gaps="outage"), thin, [0.0], [[0.3]], 20)
    for k in range(20):
        np.testing.assert_array_equal(a.fix(k).error, b.fix(k).error)
        np.testing.assert_array_equal(a.fix(k).available, b.fix(k).available)


def test_without_a_fix_in_either_part_there_is_none_and_nothing_is_shared():
    log = staircase([1, 1, 1, 1, 1, 1, 1, 0, 0, 1])
    cfg = config(rate_hz=1.0, gaps="outage", common_mode_share=0.5)
    errors = flown(cfg, log, [0.5], [[0.1, 0.4]], 6)  # common from 5, own from 1 and 4
    expected = [[1, 1], [1, 1], [0, 0], [0, 0], [1, 0], [1, 1]]
    assert [errors.fix(k).available[0].astype(int).tolist() for k in range(6)] == expected
    frozen = errors.fix(1).error[0]
    np.testing.assert_array_equal(errors.fix(3).error[0], frozen)
    assert (errors.fix(3).common_factor == 0.0).all()
    np.testing.assert_array_equal(errors.fix(4).error[0, 1], frozen[1])
    assert (errors.fix(4).common_factor[0, 1] == 0.0).all()
    assert (errors.fix(4).common_factor[0, 0] != 0.0).any()


def test_the_barometer_replaces_the_height_alone():
    z = np.random.default_rng(0).standard_normal((3, 2, 5))
    starts = np.random.default_rng(1).random((3, 2))
    cfg = config(rate_hz=1.0, common_mode_share=0.5)
    with_barometer = cfg.model_copy(update={"vertical": "barometer", "barometer_sigma_m": 0.7})
    log = staircase()
    gnss = replay(cfg, log, starts[:, 0], starts, 5, None)
    both = replay(with_barometer, log, starts[:, 0], starts, 5, z)
    for k in range(5):
        a, b = gnss.fix(k), both.fix(k)
        np.testing.assert_array_equal(b.error[..., :2], a.error[..., :2])
        np.testing.assert_allclose(b.covariance[..., :2, :2], a.covariance[..., :2, :2])
        np.testing.assert_array_equal(b.covariance[..., 2, :2], 0.0)
        np.testing.assert_array_equal(b.covariance[..., :2, 2], 0.0)
        np.testing.assert_allclose(b.covariance[..., 2, 2], 0.49)
        shared = b.common_factor @ b.common_factor.transpose(0, 1, 3, 2)
        full = a.common_factor @ a.common_factor.transpose(0, 1, 3, 2)
        np.testing.assert_allclose(shared[..., :2, :2], full[..., :2, :2], atol=1e-12)
        np.testing.assert_array_equal(shared[..., 2, :], 0.0)
    np.testing.assert_allclose(both.fix(0).error[..., 2], 0.7 * z[..., 0])


def test_a_barometer_needs_its_numbers():
    with pytest.raises(ValueError, match="barometer"):
        replay(config(vertical="barometer"), staircase(), np.zeros(1), np.zeros((1, 1)), 3, None)


def test_a_barometer_goes_on_through_outages():
    log = staircase([1, 0, 0, 0, 0, 0, 0, 0, 0, 1])
    z = np.random.default_rng(0).standard_normal((1, 1, 6))
    cfg = config(vertical="barometer", gaps="outage", rate_hz=1.0, barometer_correlation_time_s=0.0)
    errors = replay(cfg, log, np.zeros(1), np.zeros((1, 1)), 6, z)
    for k in range(1, 6):
        fix = errors.fix(k)
        assert not fix.available[0, 0]
        assert fix.error[0, 0, 0] == 1.0
        assert fix.error[0, 0, 2] == z[0, 0, k]
        assert fix.covariance[0, 0, 2, 2] == 1.0
        assert fix.covariance[0, 0, 0, 0] == pytest.approx(4.0 + (COAST_SIGMA_MPS * k) ** 2)


def test_the_barometer_has_its_sigma_and_correlation_time(tmp_path: Path):
    """2000 runs: standard deviation 1 m, correlation exp(-60/300) over a minute."""
    write_log(tmp_path)
    errors = position_errors(config(vertical="barometer", rate_hz=1.0), 3, range(2000), 1, 60.0, tmp_path)
    a, b = errors.fix(0).error[:, 0, 2], errors.fix(60).error[:, 0, 2]
    assert np.mean(a**2) == pytest.approx(1.0, abs=5 * math.sqrt(2 / 2000))
    assert np.mean(b**2) == pytest.approx(1.0, abs=5 * math.sqrt(2 / 2000))
    rho = math.exp(-0.2)
    assert np.mean(a * b) == pytest.approx(rho, abs=5 * math.sqrt((1 + rho**2) / 2000))


def write_log(folder: Path, name: str = "log.csv") -> None:
    head = "t_s,available,err_e_m,err_n_m,err_u_m,cov_ee_m2,cov_en_m2,cov_eu_m2,cov_nn_m2,cov_nu_m2,cov_uu_m2"
    rows = [f"{t},1,{t + 1},{10 * (t + 1)},{100 * (t + 1)},1,0,0,1,0,1" for t in range(N)]
    (folder / name).write_text("\n".join([head, *rows]))


def test_starts_come_from_their_own_streams(tmp_path: Path):
    """Common: run's stream, UAV 0, axis 0; own: each UAV's, axis 1. Every sample of the log is a start."""
    write_log(tmp_path)
    errors = position_errors(config(), 21, range(200), 3, 1.0, tmp_path)
    assert isinstance(errors, RecordedErrors)
    drawn = uniforms(21, range(200), Stream.RECORD_OFFSET, 3, 2, 1)
    np.testing.assert_array_equal(errors.own_start, (drawn[:, :, 1, 0] * N).astype(int))
    np.testing.assert_array_equal(errors.common_start[:, 0], (drawn[:, 0, 0, 0] * N).astype(int))
    assert set(errors.own_start.ravel()) == set(range(N))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"file": "log.txt"}, r"must be a \.csv file of errors, an RTKLIB \.pos"),
        ({"file": "log.pos"}, "truth_file"),
        ({"file": "log.csv", "truth_file": "truth.pos"}, "truth_file"),
        # Errors are no places: a .csv is not among what a truth may be.
        (
            {"file": "log.pos", "truth_file": "truth.csv"},
            r"truth_file = truth\.csv: must be an RTKLIB \.pos, NMEA",
        ),
        ({"file": "missing.csv"}, r"missing\.csv"),
        ({"file": "../log.csv"}, r"\.\."),
    ],
)
def test_what_cannot_be_replayed_says_why(tmp_path: Path, changes: dict[str, str], message: str):
    write_log(tmp_path)
    write_log(tmp_path, "log.pos")
    with pytest.raises(DataError, match=message):
        load_error_log(config(**changes), tmp_path)


def test_a_log_whose_gaps_would_fill_the_memory_is_refused():
    one = staircase()
    time = one.time_s.copy()
    time[-1] = 1e9
    with pytest.raises(DataError, match="steps of 1 s"):
        flown(
            config(gaps="outage"),
            ErrorLog("x", time, one.available, one.error, one.covariance),
            [0.0],
            [[0.0]],
            3,
        )


# --------------------------------------------------------------------------------------- measured data


def test_nagoya_replay_keeps_the_law_of_the_log_and_mixing_makes_it_more_normal(data_folder: Path):
    """East errors over their reported sigma, 400 runs. Mixing lowers kurtosis, not the share over 3."""
    kurtosis, beyond = {}, {}
    for share in (0.0, 0.5):
        cfg = config(file="gnss_nagoya_spp/nav_error_enu_1Hz.csv", common_mode_share=share, rate_hz=1.0)
        errors = position_errors(cfg, 1, range(400), 1, 549.0, data_folder)
        fixes = [errors.fix(k) for k in range(0, 550, 5)]
        unit = np.array([f.error[:, 0, 0] / np.sqrt(f.covariance[:, 0, 0, 0]) for f in fixes])
        beyond[share] = float(np.mean(np.abs(unit) > 3.0))
        kurtosis[share] = float(np.mean((unit - unit.mean()) ** 4) / unit.var() ** 2)
    alone = 1.0 - coverage(load_error_log(cfg, data_folder), 3.0).share[0]
    assert beyond[0.0] == pytest.approx(alone, abs=0.002)
    assert kurtosis[0.0] > 8.0  # 3 for a normal law
    assert kurtosis[0.5] < 6.0
    assert beyond[0.5] > 10 * 0.0027  # still far from a normal law


def test_nagoya_outages_are_as_frequent_as_in_the_log(data_folder: Path):
    cfg = config(
        file="gnss_nagoya_spp/rover_1Hz_spp.pos",
        truth_file="gnss_nagoya_spp/reference_1Hz.pos",
        gaps="outage",
        rate_hz=1.0,
    )
    errors = position_errors(cfg, 1, range(3), 2, 1230.0, data_folder)
    available = np.array([errors.fix(k).available for k in range(1231)])  # the whole ring once
    np.testing.assert_array_equal(available.sum(axis=0), 550)


def log_at(times: list[float]) -> ErrorLog:
    n = len(times)
    error = np.arange(1.0, n + 1.0)[:, None] * np.ones(3)
    return ErrorLog("made up", np.array(times), np.ones(n, dtype=bool), error, np.tile(np.eye(3), (n, 1, 1)))


@pytest.mark.parametrize(
    ("steps", "period_s", "gaps"),
    [
        ([2, 2, 3, 2, 4, 1, 2, 2, 3, 2, 2, 4, 2, 3, 2, 2, 2], 1.0, 23),  # seldom a fix a second after another
        (
            100 * [1, 1, 1.1, 0.9, 1, 1.04, 0.9, 1, 1.15, 1.05, 1, 1, 3, 1.06],
            1.0,
            200,
        ),  # jitter, and a true gap
        ([0.2, 0.3, 0.2, 0.2, 0.4, 0.2], 0.2, 2),
    ],
)
def test_no_fix_of_an_uneven_log_is_lost(steps: list[float], period_s: float, gaps: int):
    times = np.concatenate([[0.0], np.cumsum(steps)])
    errors = flown(config(gaps="outage", rate_hz=10.0), log_at(times.tolist()), [0.0], [[0.0]], 10)
    assert errors.table.period_s == pytest.approx(period_s)
    assert errors.table.available.sum() == len(times)
    assert (~errors.table.available).sum() == gaps
    replayed = errors.table.error[errors.table.available, 0]
    np.testing.assert_array_equal(replayed, np.arange(1.0, len(times) + 1.0))


def test_gaps_of_a_log_on_no_grid_are_not_guessed():
    times = np.cumsum([0.0, 1.0, 0.031, 1.7, 0.44, 0.05, 2.2, 0.6, 0.013, 1.1]).tolist()
    with pytest.raises(
        DataError, match=r'made up: .* 0\.013 to 2\.2 s apart.*set navigation\.gaps = "close"'
    ):
        flown(config(gaps="outage"), log_at(times), [0.0], [[0.0]], 10)
    closed = flown(config(gaps="close"), log_at(times), [0.0], [[0.0]], 10)
    assert closed.table.available.all()
