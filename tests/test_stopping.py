"""Sequential stopping: an interval that holds however often one looks, and a campaign that stops by it."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from napf_mpc import store
from napf_mpc.block import lost_block
from napf_mpc.campaign import run_campaign
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import Outcome
from napf_mpc.prefix import looks
from napf_mpc.problem_file import load_problem
from napf_mpc.report import comparison
from napf_mpc.risk import wilson
from napf_mpc.stopping import ALPHA, StoppingRule, log_evidence, sequential_interval

SEQUENCES, LOOKS = 2000, 5000

# ------------------------------------------------------------------------------------------- the interval


@given(total=st.integers(1, 100_000), share=st.floats(0.0, 1.0))
def test_the_ends_are_where_the_evidence_reaches_its_limit(total: int, share: float) -> None:
    count = round(share * total)
    low, high = sequential_interval(count, total)
    assert 0.0 <= low <= count / total <= high <= 1.0
    for end, at_edge in ((low, count == 0), (high, count == total)):
        if not at_edge:
            assert log_evidence(count, total, end) == pytest.approx(-np.log(ALPHA), abs=1e-6)


def test_the_evidence_is_the_mixed_likelihood() -> None:
    """3 of 10 at p = 0.2: the Beta(1/2, 1/2) integral by quadrature."""
    angle = (np.arange(200_000) + 0.5) * (np.pi / 2.0) / 200_000
    q = np.sin(angle) ** 2  # Beta(1/2, 1/2) is the law of sin^2 of an even angle
    mixed = np.mean(q**3 * (1.0 - q) ** 7) / (0.2**3 * 0.8**7)
    assert log_evidence(3, 10, 0.2) == pytest.approx(np.log(mixed), abs=1e-9)


@given(total=st.integers(1, 5000), share=st.floats(0.0, 1.0))
def test_looking_whenever_one_likes_costs_width(total: int, share: float) -> None:
    count = round(share * total)
    low, high = sequential_interval(count, total)
    fixed = wilson(count, total)
    assert high - low > fixed.high - fixed.low


@pytest.mark.parametrize(("count", "total"), [(0, 0), (-1, 10), (11, 10)])
def test_counts_that_cannot_be_are_refused(count: int, total: int) -> None:
    with pytest.raises(ValueError, match=f"count {count}, total {total}"):
        sequential_interval(count, total)


def sequences(rate: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(np.random.SeedSequence(5, spawn_key=(round(1e6 * rate),)))
    counts = (rng.random((SEQUENCES, LOOKS)) < rate).cumsum(axis=1)
    return counts, np.arange(1, LOOKS + 1)


@pytest.mark.parametrize("rate", [0.002, 0.05, 0.3])
def test_peeked_at_after_every_run_it_misses_in_5_per_cent_at_most(rate: float) -> None:
    counts, looks = sequences(rate)
    ever = (log_evidence(counts, looks, rate) > -np.log(ALPHA)).any(axis=1)
    assert wilson(int(ever.sum()), SEQUENCES).low <= 0.05


@pytest.mark.parametrize("rate", [0.002, 0.05, 0.3])
def test_a_wilson_interval_peeked_at_fails_the_same_check(rate: float) -> None:
    """The proof that the check can fail; a rate is in the Wilson interval if its score test says so."""
    counts, looks = sequences(rate)
    score = np.abs(counts / looks - rate) / np.sqrt(rate * (1.0 - rate) / looks)
    ever = (score > 1.959963984540054).any(axis=1)
    assert wilson(int(ever.sum()), SEQUENCES).low > 0.2


# ----------------------------------------------------------------------------------------------- the rule


def test_clean_runs_that_show_a_risk_of_two_in_a_thousand() -> None:
    """The figure in the documents: 3,844; fixed beforehand, the Wilson interval takes 1,917."""
    rule = StoppingRule(upper=0.002)
    assert not rule.met(0, 3843)
    assert rule.met(0, 3844)
    assert wilson(0, 1917).high < 0.002 < wilson(0, 1916).high


@given(total=st.integers(1, 20_000), share=st.floats(0.0, 1.0), limit=st.floats(0.001, 0.5))
def test_a_rule_is_what_the_interval_says(total: int, share: float, limit: float) -> None:
    count = round(share * total)
    low, high = sequential_interval(count, total)
    if abs(high - limit) > 1e-9:
        assert StoppingRule(upper=limit).met(count, total) == (high < limit)
    assert StoppingRule(width=limit).met(count, total) == (high - low < limit)
    both = StoppingRule(width=limit, upper=limit)
    assert both.met(count, total) == (high - low < limit or StoppingRule(upper=limit).met(count, total))


def test_every_planner_has_to_meet_it() -> None:
    rule = StoppingRule(width=0.2)
    clean, mixed = np.zeros(200, dtype=bool), np.arange(200) % 2 == 0
    name, outcome = np.repeat(["apf", "napf"], 200), np.full(400, Outcome.REACHED, dtype=object)
    assert rule({"planner": name[:200], "obstacle_contact": clean, "outcome": outcome[:200]})
    assert not rule({"planner": name, "obstacle_contact": np.concatenate([clean, mixed]), "outcome": outcome})
    assert rule({"planner": name, "obstacle_contact": np.concatenate([clean, clean]), "outcome": outcome})


def test_missions_that_failed_are_not_clean_ones() -> None:
    rule = StoppingRule(upper=0.05)
    for outcome in Outcome:
        rows = lost_block(["napf"], 0, range(200), 4, outcome, "").rows
        assert rule(rows) == (outcome is not Outcome.FAILED)


@pytest.mark.parametrize("limits", [{"width": 0.0}, {"upper": 1.0}, {"width": float("nan")}, {"upper": -0.1}])
def test_limits_that_are_no_rates_are_refused(limits: dict[str, float]) -> None:
    with pytest.raises(ProblemError, match=r"until-(width|upper) = .*: must be a rate above 0 and below 1"):
        StoppingRule(**limits)
    with pytest.raises(ProblemError, match="give until-width or until-upper"):
        StoppingRule()


# ------------------------------------------------------------------------------------------- the campaign

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 2.0,
    "simulation.controller_rate_hz": 25.0,
    "planner.rate_hz": 5.0,
    "navigation.rate_hz": 5.0,
}


def fly(out: Path, most: int, rule: StoppingRule | None, **options: Any) -> dict[str, Any]:
    return run_campaign(load_problem("table1_8", BRIEF), ["apf"], most, 7, out, enough=rule, **options)


def digest(out: Path) -> str:
    return hashlib.sha256((out / "runs.parquet").read_bytes()).hexdigest()


def test_a_campaign_stops_at_the_same_run_whatever_blocks_and_workers(tmp_path: Path) -> None:
    rule, most = StoppingRule(width=0.27), 200
    summary = fly(tmp_path / "a", most, rule, block_runs=10)
    runs = summary["planners"]["apf"]["runs"]
    assert 50 < runs < most
    contact = store.read_table(tmp_path / "a" / "runs.parquet")["obstacle_contact"]
    asked = [n for n in looks(most) if n <= runs]
    met = [rule.met(int(contact[:n].sum()), n) for n in asked]
    assert asked[-1] == runs
    assert met == [False] * (len(asked) - 1) + [True]
    fly(tmp_path / "b", most, rule, block_runs=64)
    fly(tmp_path / "c", most, rule, block_runs=16, workers=2)
    fly(tmp_path / "d", 30, None)
    fly(tmp_path / "d", most, rule, block_runs=70)  # goes on
    fly(tmp_path / "e", most, None)
    flown = sorted((tmp_path / "e" / "blocks").iterdir())
    fly(tmp_path / "e", most, rule)  # has flown enough already
    assert sorted((tmp_path / "e" / "blocks").iterdir()) == flown
    assert len({digest(tmp_path / name) for name in "abcde"}) == 1
    scenario = json.loads((tmp_path / "b" / "scenario.json").read_text())
    assert len(scenario["scenes"]) == runs


def test_it_says_whether_the_rule_was_met_and_which_interval_holds(tmp_path: Path) -> None:
    summary = fly(tmp_path / "out", 4, StoppingRule(upper=0.001))
    assert summary["stopping"] == {"rule": "until-upper 0.001", "met": False, "most_runs": 4}
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == summary
    planner = summary["planners"]["apf"]
    ends = (planner["collision_risk_sequential_low"], planner["collision_risk_sequential_high"])
    assert ends == sequential_interval(round(4 * planner["collision_risk"]), 4)
    text = comparison(summary).markdown()
    first, second = text.splitlines()[4:6]
    assert "sequential" in first
    assert f"{100 * ends[1]:.2f}" in first
    assert "Wilson, not valid here: N was not fixed" in second
    assert "Stopping rule until-upper 0.001: not met in 4 runs." in text
    del summary["stopping"]
    assert "sequential" not in comparison(summary).markdown()
