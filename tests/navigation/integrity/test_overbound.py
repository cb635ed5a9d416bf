"""Overbounds bound: the sample that they were fitted to, and one that they were not."""

import math
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from scipy import special

from napf_mpc.errors import DataError
from napf_mpc.navigation.integrity.overbound import (
    AxisOverbound,
    Overbound,
    effective_sample_size,
    fit_overbound,
    paired_overbound,
)
from napf_mpc.navigation.processes import gauss_markov
from napf_mpc.navigation.recorded import ErrorLog, halves, read_error_log_csv
from napf_mpc.streams import Stream, normals

DRAWS = normals(12, range(1), Stream.OWN_ERROR, 1, 6, 20_000)[0, 0]


def tails_held(z: np.ndarray, bound: AxisOverbound) -> bool:
    """Whether on both sides no quantile of the sample lies outside the bound's, from the middle outward."""
    n = len(z)
    for side in (np.sort(z), np.sort(-z)):
        for x, at_least in zip(side, np.arange(n, 0, -1) / n, strict=True):
            allowed = special.ndtr(-(x - bound.bias) / bound.sigma) if x > bound.bias else 1.0
            if at_least <= 0.25 and at_least > allowed * (1.0 + 1e-9):
                return False
    return True


LAWS = {
    "normal": DRAWS[0],
    "shifted": DRAWS[0] + 0.7,
    "heavy": DRAWS[0] / np.sqrt((DRAWS[1:4] ** 2).sum(0) / 3.0),
    "one side": np.where(DRAWS[0] > 1.0, 5.0 * DRAWS[0], DRAWS[0]),
    "narrow": 0.3 * DRAWS[0],
}


@pytest.mark.parametrize("law", LAWS)
def test_no_part_of_the_sample_is_outside(law: str) -> None:
    z = LAWS[law][:2000]
    bound = paired_overbound(z)
    assert tails_held(z, bound)
    assert not tails_held(z, AxisOverbound(bound.bias, 0.97 * bound.sigma, bound.n, bound.effective_n))
    assert not tails_held(1.05 * z, bound)


def test_a_normal_sample_is_left_as_it_is_and_a_shift_becomes_the_bias() -> None:
    normal, shifted = paired_overbound(LAWS["normal"]), paired_overbound(LAWS["shifted"])
    # b + 3 s: the price of the sample's largest of 20000 is some hundredths.
    assert normal.bias + 3.0 * normal.sigma == pytest.approx(3.0, abs=0.25)
    assert shifted.bias + 3.0 * shifted.sigma == pytest.approx(3.7, abs=0.25)
    assert shifted.bias == pytest.approx(0.7, abs=0.03)
    narrow = paired_overbound(LAWS["narrow"])
    assert narrow.sigma < 0.4
    assert narrow.factor(3.0) == 1.0  # never below what the receiver says


def test_a_few_large_errors_in_a_row_are_one_event() -> None:
    z = np.concatenate([LAWS["normal"][:400], np.full(4, 6.0)])
    alone, together = paired_overbound(z), paired_overbound(z, 40.0)
    assert pytest.approx(alone.bias - alone.sigma * special.ndtri(1.0 / 101.0), abs=0.02) == 6.0
    assert pytest.approx(together.bias - together.sigma * special.ndtri(1.0 / 40.0), abs=1e-6) == 6.0
    with pytest.raises(ValueError, match=r"effective_n = 4 must be >= 5"):
        paired_overbound(z, 4.0)


def test_factor_is_bias_and_width_at_k() -> None:
    bound = AxisOverbound(bias=0.6, sigma=1.5, n=100, effective_n=30.0)
    assert 3.0 * bound.factor(3.0) == pytest.approx(0.6 + 3.0 * 1.5)
    assert bound.factor(0.0) == 1.0
    # Thirty independent errors tell of a tail of 1 / 30, 1.83 sigma on one side, and of no more.
    assert bound.supported_k == pytest.approx(1.834, abs=1e-3)
    three = Overbound((bound, AxisOverbound(0.0, 2.0, 100, 30.0), AxisOverbound(0.0, 1.0, 100, 30.0)), "log")
    np.testing.assert_allclose(three.factors(3.0), [1.7, 2.0, 1.0])


def test_correlated_samples_are_worth_less() -> None:
    white = DRAWS[0]
    time = np.arange(len(white), dtype=np.float64)
    assert effective_sample_size(time, white, 1.0) == pytest.approx(len(white), rel=0.05)
    # A Gauss-Markov process of correlation time 10 samples: (1 - phi) / (1 + phi) of its samples, 1 in 20.
    slow = gauss_markov(white[None], 1.0, 10.0)[0]
    expected = len(white) * math.tanh(1.0 / 20.0)
    assert effective_sample_size(time, slow, 1.0) == pytest.approx(expected, rel=0.15)
    # With every other sample missing the same holds per time.
    assert effective_sample_size(time[::2], slow[::2], 1.0) == pytest.approx(
        len(white) / 2 * math.tanh(2.0 / 20.0), rel=0.2
    )
    assert effective_sample_size(time[:50], np.ones(50), 1.0) == 50.0


SERIES = DRAWS[0][:30]
GRID = np.arange(30.0)


@pytest.mark.parametrize(
    ("time_s", "values", "period_s", "words"),
    [
        (GRID[::-1], SERIES, 1.0, r"time_s must ascend"),
        (np.where(GRID == 4, np.nan, GRID), SERIES, 1.0, r"time_s must ascend"),
        (np.append(GRID[:-1], np.inf), SERIES, 1.0, r"time_s must ascend"),
        (GRID, SERIES, 0.0, r"period_s = 0.0 must be a finite number > 0"),
        (GRID, SERIES, np.nan, r"period_s = nan must be a finite number > 0"),
        (GRID, SERIES[:-1], 1.0, r"time_s has shape \(30,\), values \(29,\)"),
        (GRID[:0], SERIES[:0], 1.0, r"time_s has shape \(0,\), values \(0,\)"),
        (GRID[:, None], SERIES[:, None], 1.0, r"time_s has shape \(30, 1\)"),
        (GRID, np.where(GRID == 4, np.nan, SERIES), 1.0, r"values must be finite"),
        (np.append(GRID[:-1], 1e12), SERIES, 1.0, r"time_s spans 1e\+12 periods, at most 1e\+07 are looked"),
    ],
)  # fmt: skip
def test_what_is_no_series(time_s: np.ndarray, values: np.ndarray, period_s: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        effective_sample_size(time_s, values, period_s)


def test_a_long_gap_takes_no_time() -> None:
    """Two flights of 15 fixes, a day of 10 Hz apart; nothing is correlated over what lies between."""
    time = np.where(GRID < 15, GRID, GRID + 864_000.0)
    values = np.where(GRID < 15, -1.0, 1.0) + 0.1 * SERIES
    began = perf_counter()
    assert effective_sample_size(time, values, 1.0) == pytest.approx(2.0, abs=0.3)  # two levels
    assert perf_counter() - began < 10.0


@pytest.mark.parametrize("values", [np.ones(19), np.array([np.inf] * 30)])
def test_too_little_to_bound(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="20 or more finite numbers"):
        paired_overbound(values)


def test_too_few_fixes_are_told() -> None:
    log = ErrorLog(
        "log.csv", np.arange(5.0), np.ones(5, dtype=bool), np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1))
    )
    with pytest.raises(DataError, match=r"log.csv: 5 fixes, at least 20"):
        fit_overbound(log)


def test_nagoya_second_half_by_the_first(data_folder: Path) -> None:
    log = read_error_log_csv(data_folder / "gnss_nagoya_spp" / "nav_error_enu_1Hz.csv")
    first, second = halves(log)
    assert first.available.sum() + second.available.sum() == 550
    bound = fit_overbound(first)
    sigma = np.sqrt(np.einsum("nii->ni", second.covariance[second.available]))
    z = np.abs(second.error[second.available]) / sigma
    before, after = (z <= 3.0).mean(0), (z <= 3.0 * bound.factors(3.0)).mean(0)
    assert (after >= before).all()
    assert before == pytest.approx([0.931, 0.953, 0.854], abs=0.001)
    assert after == pytest.approx([1.0, 1.0, 1.0], abs=0.001)
    # Correlated: hundreds of epochs are worth some tens.
    assert all(10.0 < axis.effective_n < 150.0 for axis in bound.axes)
