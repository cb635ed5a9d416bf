"""Statistics of missions: intervals against published and hand-made figures, and their honesty."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from napf_mpc.risk import clustered_rate, holm, mcnemar, paired_tests, quantiles, wilson


def test_the_papers_thirty_runs() -> None:
    """22 of 30 and 5 of 30: thirty runs prove little."""
    fixed, napf = wilson(22, 30), wilson(5, 30)
    assert (fixed.value, napf.value) == (pytest.approx(0.7333, abs=5e-5), pytest.approx(0.1667, abs=5e-5))
    assert (fixed.low, fixed.high) == (pytest.approx(0.556, abs=5e-4), pytest.approx(0.858, abs=5e-4))
    assert (napf.low, napf.high) == (pytest.approx(0.073, abs=5e-4), pytest.approx(0.336, abs=5e-4))


def test_nothing_seen_is_not_nothing() -> None:
    """0 of 1000 is below 0.38 %, not 0; 1000 of 1000 mirrors it."""
    none, all_of_them = wilson(0, 1000), wilson(1000, 1000)
    assert none.low == 0.0
    assert none.high == pytest.approx(0.00383, abs=5e-6)
    assert all_of_them.high == 1.0
    assert all_of_them.low == pytest.approx(1.0 - none.high)


@given(total=st.integers(1, 10_000), share=st.floats(0.0, 1.0))
def test_wilson_is_its_formula(total: int, share: float) -> None:
    count = round(share * total)
    rate = wilson(count, total)
    z, p = 1.959963984540054, count / total
    centre = (p + z * z / (2 * total)) / (1 + z * z / total)
    half = z * math.sqrt(p * (1 - p) / total + z * z / (4 * total**2)) / (1 + z * z / total)
    assert rate.low == pytest.approx(max(0.0, centre - half), abs=1e-9)
    assert rate.high == pytest.approx(min(1.0, centre + half), abs=1e-9)
    assert 0.0 <= rate.low <= rate.value <= rate.high <= 1.0


def test_wilson_holds_the_truth_about_95_times_in_100() -> None:
    rng = np.random.default_rng(1)
    for p, n in ((0.02, 200), (0.17, 30), (0.75, 100)):
        held = [rate.low <= p <= rate.high for rate in (wilson(int(k), n) for k in rng.binomial(n, p, 500))]
        assert 0.91 <= np.mean(held) <= 0.99


@pytest.mark.parametrize(("count", "total"), [(0, 0), (-1, 10), (11, 10), (1, -1)])
def test_counts_that_cannot_be_are_refused(count: int, total: int) -> None:
    with pytest.raises(ValueError, match=f"count {count}, total {total}"):
        wilson(count, total)


# ------------------------------------------------------------------------------------ UAVs that share a fate


def test_uavs_that_share_their_fate_are_not_more_evidence() -> None:
    """30 of 100 runs, all four UAVs or none: the interval is that of 100 trials, not of 400."""
    hits = np.array([4] * 30 + [0] * 70)
    rate, naive = clustered_rate(hits, 4), wilson(120, 400)
    assert (rate.count, rate.total, rate.value) == (120, 400, 0.3)
    assert (rate.low, rate.high) == (
        pytest.approx(wilson(30, 100).low, abs=1e-3),
        pytest.approx(wilson(30, 100).high, abs=1e-3),
    )
    assert rate.high - rate.low > 1.8 * (naive.high - naive.low)


def test_independent_uavs_are_nearly_as_many_trials() -> None:
    hits = np.random.default_rng(2).binomial(4, 0.285, 2000)
    rate, naive = clustered_rate(hits, 4), wilson(int(hits.sum()), 8000)
    assert rate.low == pytest.approx(naive.low, abs=2e-3)
    assert rate.high == pytest.approx(naive.high, abs=2e-3)


@pytest.mark.parametrize("shared", [0.0, 0.5, 1.0])
def test_clustered_interval_holds_the_truth_about_95_times_in_100(shared: float) -> None:
    """A share of runs in which one draw decides for all four UAVs."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(400):
        own = rng.random((150, 4)) < 0.2
        common = (rng.random(150) < 0.2)[:, None].repeat(4, axis=1)
        hits = np.where((rng.random(150) < shared)[:, None], common, own).sum(axis=1)
        rate = clustered_rate(hits, 4)
        held += rate.low <= 0.2 <= rate.high
    assert 0.915 <= held / 400 <= 0.985


def test_clustered_rate_at_its_ends() -> None:
    none, every, one_run = (clustered_rate(np.array(hits), 4) for hits in ([0] * 50, [4] * 50, [1]))
    assert (none.value, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(wilson(0, 50).high)
    assert (every.value, every.high) == (1.0, 1.0)
    assert every.low == pytest.approx(wilson(50, 50).low)
    assert 0.0 <= one_run.low <= 0.25 <= one_run.high <= 1.0
    assert (clustered_rate(np.array([1] * 100), 1).low) == pytest.approx(wilson(100, 100).low)
    # Of one UAV a run, runs are all there is: no wider than Wilson.
    alone = clustered_rate(np.array([1] * 3 + [0] * 7), 1)
    assert (alone.low, alone.high) == pytest.approx((wilson(3, 10).low, wilson(3, 10).high), rel=1e-12)


@given(hits=st.lists(st.integers(0, 5), min_size=1, max_size=40))
def test_clustered_rate_is_an_interval_no_narrower_than_wilson(hits: list[int]) -> None:
    rate = clustered_rate(np.array(hits), 5)
    naive = wilson(sum(hits), 5 * len(hits))
    assert 0.0 <= rate.low <= rate.value <= rate.high <= 1.0
    assert rate.high - rate.low >= naive.high - naive.low - 1e-9


@pytest.mark.parametrize(
    ("hits", "size", "words"),
    [
        ([], 4, "0 runs of 4 UAVs"),
        ([0, 0], 0, "2 runs of 0 UAVs"),
        ([0, 5], 4, "hits must be from 0 to size = 4, got 0 to 5"),
        ([0, -1], 4, "hits must be from 0 to size = 4, got -1 to 0"),
    ],
)
def test_runs_that_cannot_be_are_refused(hits: list[int], size: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        clustered_rate(np.array(hits, dtype=np.int64), size)


# --------------------------------------------------------------------------------------------- paired tests


def test_mcnemar_by_hand() -> None:
    """9 against 1: 2 (1 + 10) / 2^10; nothing that differs proves nothing."""
    assert mcnemar(9, 1) == pytest.approx(22 / 1024)
    assert mcnemar(1, 9) == pytest.approx(22 / 1024)
    assert mcnemar(0, 5) == pytest.approx(2 / 32)
    assert mcnemar(4, 4) == 1.0
    assert mcnemar(0, 0) == 1.0


def test_holm_by_hand() -> None:
    """0.01, 0.04, 0.03 of three: 3 * 0.01, then 2 * 0.03, and the last never below it."""
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(holm([0.6, 0.5]), [1.0, 1.0])
    assert holm([]) == []
    assert holm([0.2]) == [0.2]


@given(values=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8))
def test_holm_lies_between_nothing_and_bonferroni(values: list[float]) -> None:
    corrected = holm(values)
    for p, c in zip(values, corrected, strict=True):
        assert p <= c <= min(1.0, len(values) * p) + 1e-15
    order = sorted(range(len(values)), key=values.__getitem__)
    assert [corrected[i] for i in order] == sorted(corrected)


def test_pairs_are_counted_on_the_same_runs() -> None:
    a = np.array([True, True, True, True, False, False])
    b = np.array([True, False, False, False, True, False])
    c = np.array([False] * 6)
    ab, ac, bc = paired_tests({"apf": a, "napf": b, "none": c})
    assert (ab.a, ab.b, ab.both, ab.only_a, ab.only_b, ab.neither) == ("apf", "napf", 1, 3, 1, 1)
    assert ab.p_value == mcnemar(3, 1) == pytest.approx(0.625)
    assert (ac.both, ac.only_a, ac.only_b, ac.neither) == (0, 4, 0, 2)
    assert (bc.only_a, bc.only_b) == (2, 0)
    assert [pair.p_value_corrected for pair in (ab, ac, bc)] == holm([ab.p_value, ac.p_value, bc.p_value])
    assert paired_tests({"apf": a}) == []


def test_noughts_and_ones_are_hits_too() -> None:
    """Inverted bit by bit, integers would count neither = -4."""
    pair = paired_tests({"a": np.array([1, 1, 0, 0]), "b": np.array([1, 0, 1, 0])})[0]
    assert (pair.both, pair.only_a, pair.only_b, pair.neither) == (1, 1, 1, 1)


def test_planners_must_have_flown_the_same_runs() -> None:
    one, two = np.array([True]), np.array([True, False])
    with pytest.raises(ValueError, match=r"a has hits of shape \(2,\), b of \(1,\); .* the same runs"):
        paired_tests({"a": two, "b": one})
    with pytest.raises(ValueError, match=r"a has hits of shape \(1, 2\), must be \(run,\)"):
        paired_tests({"a": two[None], "b": two[None]})


def test_a_paired_test_sees_what_two_rates_do_not() -> None:
    """60 and 50 of 100, but never the other way round: the intervals overlap, the pairs do not."""
    a, b = np.arange(100) < 60, np.arange(100) < 50
    assert wilson(60, 100).low < wilson(50, 100).high
    assert paired_tests({"a": a, "b": b})[0].p_value < 0.002


# ------------------------------------------------------------------------------------------------ quantiles


def test_what_is_not_defined_is_in_no_quantile() -> None:
    values = np.array([np.nan, 3.0, 1.0, np.nan, 2.0, 4.0, 5.0, np.inf])
    assert quantiles(values) == {"median": 3.0, "p05": 1.2, "p95": pytest.approx(4.8), "mean": 3.0, "n": 5}


@pytest.mark.parametrize("values", [[], [math.nan], [math.nan, math.inf]])
def test_nothing_defined_is_null_and_not_zero(values: list[float]) -> None:
    assert quantiles(np.array(values)) == {"median": None, "p05": None, "p95": None, "mean": None, "n": 0}


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50))
def test_quantiles_do_not_depend_on_the_order(values: list[float]) -> None:
    assert quantiles(np.array(values)) == quantiles(np.array(values[::-1]))
    result = quantiles(np.array(values))
    assert min(values) <= result["p05"] <= result["median"] <= result["p95"] <= max(values)
