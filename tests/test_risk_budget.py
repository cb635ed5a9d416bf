"""The risk budget: k from a mission's risk, its division, and the account of what a flight has run up."""

import math

import numpy as np
import pytest
from scipy import stats

from napf_mpc.errors import ProblemError
from napf_mpc.first_passage import first_passage_probability, long_run, mission_k
from napf_mpc.navigation.processes import gauss_markov, swinging_sigma
from napf_mpc.problem import ConstantBias, GaussMarkov, Navigation, Problem, Recorded
from napf_mpc.problem_file import load_problem
from napf_mpc.risk_budget import (
    FILTERED_CORRELATION_TIME_S,
    RiskBudget,
    RiskLedger,
    error_correlation_time,
)
from napf_mpc.safety_distance import Inflation

ON = np.ones(1, dtype=bool)


def budget(asked: float = 0.05, tau: float = 10.0, uavs: int = 1) -> RiskBudget:
    return RiskBudget(asked, uavs, 15.0, tau, 0.1)


def flown(levels: np.ndarray, tau: float = 10.0, sigma: float = 2.0) -> float:
    """Bound of one UAV that passes one obstacle at the given distances in sigmas, step by step."""
    ledger = RiskLedger(budget(tau=tau), 1, 1, 1)
    for k in levels:
        ledger.spend(
            np.full((1, 1, 1), sigma * k), np.full((1, 1, 1), sigma), np.zeros((1, 1, 1), np.int64), 0.1, ON
        )
    return float(ledger.certificate().bound[0])


# ------------------------------------------------------------------------------------ before the flight


def test_each_uav_has_its_part_of_the_mission() -> None:
    assert budget(0.04, uavs=4).k == mission_k(0.01, 15.0, 10.0, 0.1)


def test_one_obstacle_a_uav_is_divided_like_the_budget() -> None:
    share = budget(0.04, uavs=4).allocate(np.full((4, 1), 15.0))
    assert share.k == pytest.approx(budget(0.04, uavs=4).k, abs=1e-6)
    assert share.risk == pytest.approx(np.full((4, 1), 0.01), rel=1e-6)


def test_risk_is_divided_by_time() -> None:
    times = np.array([[15.0, 0.0, 1500.0], [0.0, 0.0, 3000.0]])
    share = budget(0.05, uavs=2).allocate(times)
    assert share.risk.sum() == pytest.approx(0.05, rel=1e-6)
    assert (share.risk[times == 0.0] == 0.0).all()
    # In the long run in proportion to the time, a short meeting pays for its beginning on top.
    assert share.risk[1, 2] / share.risk[0, 2] == pytest.approx(2.0, rel=0.02)
    assert 0.01 < share.risk[0, 0] / share.risk[0, 2] < 0.02
    assert share.k > budget(0.05, uavs=2).k


def test_a_budget_that_is_never_used_up_asks_for_no_margin() -> None:
    share = RiskBudget(0.9, 1, 15.0, math.inf, 0.1).allocate(np.array([[15.0]]))
    assert share.k == 0.0
    assert share.risk[0, 0] == pytest.approx(0.5)


@pytest.mark.parametrize("times", [[[0.0]], [[-1.0]], [[math.nan]], [[math.inf]]])
def test_times_that_cannot_be_divided_by(times: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="active_s"):
        budget().allocate(np.array(times))


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ((0.0, 1, 15.0, 10.0, 0.1), "asked"),
        ((math.nan, 1, 15.0, 10.0, 0.1), "asked"),
        ((0.1, 0, 15.0, 10.0, 0.1), "uavs"),
        ((0.1, 1, 0.0, 10.0, 0.1), "active_s"),
        ((0.1, 1, 15.0, -1.0, 0.1), "correlation_time_s"),
        ((0.1, 1, 15.0, 10.0, math.nan), "period_s"),
    ],
)
def test_budgets_that_make_no_sense(values: tuple[float, int, float, float, float], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        RiskBudget(*values)


# -------------------------------------------------------------------------------------------- in flight


@pytest.mark.parametrize("tau", [0.0, 2.0, 10.0, 50.0])
@pytest.mark.parametrize("risk", [0.1, 0.01])
def test_a_mission_at_its_level_is_charged_what_was_asked(tau: float, risk: float) -> None:
    """Neither below what was asked, nor nine times above it like a sum over samples."""
    bound = flown(np.full(150, mission_k(risk, 15.0, tau, 0.1)), tau)
    assert risk * 0.995 <= bound <= 1.2 * risk


def test_charge_is_entry_and_rate() -> None:
    for k in (0.03, 1.234, 2.718, 4.04):
        entry, rate = long_run(k, 10.0, 0.1)
        assert flown(np.full(20, k)) == pytest.approx(-math.expm1(-entry - 2.0 * rate), rel=2e-3)


def test_of_a_constant_error_only_the_nearest_point_counts() -> None:
    levels = 2.5 + np.sin(np.linspace(0.0, 20.0, 300))
    assert flown(levels, math.inf) == pytest.approx(stats.norm.sf(levels.min()), rel=2e-3)


@pytest.mark.parametrize("tau", [2.0, 10.0, 50.0])
@pytest.mark.parametrize("kind", ["pass", "swing", "step", "tremble"])
def test_bounds_what_simulation_finds_at_moving_levels(tau: float, kind: str) -> None:
    t = 0.1 * np.arange(150)
    levels = {
        "pass": 2.0 + 0.3 * np.abs(t - 7.5),
        "swing": 2.8 + 0.8 * np.sin(2.0 * np.pi * t / 5.0),
        "step": np.where(t < 7.0, 3.5, 2.0),
        "tremble": 2.6 + 0.2 * np.random.default_rng(3).standard_normal(150),
    }[kind]
    runs = 60_000
    g = gauss_markov(np.random.default_rng(11).standard_normal((runs, 150)), 0.1, tau)
    achieved = float((g > levels).any(-1).mean())
    bound = flown(levels, tau)
    assert achieved <= bound + 3.0 * math.sqrt(bound / runs)
    assert bound <= 3.0 * achieved


def test_trembling_is_not_charged_each_time() -> None:
    """A distance that shakes by a tenth of a sigma costs little more than the least of it throughout."""
    shaken = 3.0 + 0.1 * np.tile([1.0, -1.0], 75)
    assert flown(np.full(150, 2.9)) * 0.9 < flown(shaken) <= flown(np.full(150, 2.9)) * 1.1


def test_obstacles_and_uavs_add_up_and_order_does_not_matter() -> None:
    distance = np.array([[[6.0, 5.0, np.inf], [5.5, np.inf, np.inf]]])
    number = np.array([[[4, 9, -1], [4, -1, -1]]])
    sigma = np.full(distance.shape, 2.0)
    plain, shuffled = (RiskLedger(budget(uavs=2), 1, 2, 3) for _ in range(2))
    for step in range(30):
        plain.spend(distance, sigma, number, 0.1, ON)
        turn = [(0, 1, 2), (2, 0, 1), (1, 2, 0)][step % 3]
        shuffled.spend(distance[..., turn], sigma[..., turn], number[..., turn], 0.1, ON)
    found = plain.certificate()
    single = [flown(np.full(30, k)) for k in (3.0, 2.5, 2.75)]
    assert found.per_uav[0, 0] == pytest.approx(1.0 - (1.0 - single[0]) * (1.0 - single[1]), rel=1e-9)
    assert found.per_uav[0, 1] == pytest.approx(single[2], rel=1e-9)
    assert found.bound[0] == pytest.approx(found.per_uav.sum(), rel=1e-12)
    assert shuffled.certificate().bound[0] == pytest.approx(found.bound[0], rel=1e-12)


def test_runs_do_not_depend_on_their_block_and_those_that_ended_pay_nothing() -> None:
    rng = np.random.default_rng(0)
    steps = 4.0 + rng.standard_normal((40, 5, 2, 3))
    number = np.broadcast_to(np.arange(3), (5, 2, 3))
    sigma = np.full((5, 2, 3), 1.5)
    block = RiskLedger(budget(uavs=2), 5, 2, 3)
    active = np.array([True, True, False, True, True])
    for distance in steps:
        block.spend(distance, sigma, number, 0.1, active)
    together = block.certificate().bound
    assert together[2] == 0.0
    alone = RiskLedger(budget(uavs=2), 1, 2, 3)
    for distance in steps:
        alone.spend(distance[3:4], sigma[:1], number[:1], 0.1, ON)
    assert alone.certificate().bound[0] == together[3] > 0.0


def test_far_obstacles_cost_nothing_and_contact_costs_everything() -> None:
    assert flown(np.full(100, 9.0)) == 0.0
    assert flown(np.array([3.0, -0.01, 3.0])) == 1.0
    assert flown(np.array([3.0, -np.inf, np.inf, 3.0])) == 1.0
    ledger = RiskLedger(budget(uavs=2), 1, 2, 1)
    ledger.spend(np.full((1, 2, 1), -1.0), np.ones((1, 2, 1)), np.zeros((1, 2, 1), np.int64), 0.1, ON)
    assert ledger.certificate().bound[0] == 1.0  # clipped: two UAVs in contact


def test_without_an_error_a_gap_is_a_gap() -> None:
    ledger = RiskLedger(budget(), 1, 1, 1)
    ledger.spend(np.full((1, 1, 1), 0.01), np.zeros((1, 1, 1)), np.zeros((1, 1, 1), np.int64), 0.1, ON)
    assert ledger.certificate().bound[0] == 0.0


@pytest.mark.parametrize(
    ("distance", "sigma", "dt", "word"),
    [
        (math.nan, 1.0, 0.1, "distance"),
        (1.0, math.nan, 0.1, "sigma"),
        (1.0, -1.0, 0.1, "sigma"),
        (1.0, math.inf, 0.1, "sigma"),
        (1.0, 1.0, 0.0, "dt_s"),
        (1.0, 1.0, math.nan, "dt_s"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(distance: float, sigma: float, dt: float, word: str) -> None:
    """NaN would compare as "far enough"."""
    ledger = RiskLedger(budget(), 1, 1, 1)
    one = np.ones((1, 1, 1))
    with pytest.raises(ValueError, match=word):
        ledger.spend(distance * one, sigma * one, np.zeros((1, 1, 1), np.int64), dt, ON)
    ledger.spend(distance * one, sigma * one, np.full((1, 1, 1), -1), 0.1, ON)  # no obstacle: nobody asks
    assert ledger.certificate().bound[0] == 0.0


def test_shapes_are_checked() -> None:
    ledger = RiskLedger(budget(), 1, 1, 2)
    with pytest.raises(ValueError, match="distance has shape"):
        ledger.spend(np.ones((1, 1, 1)), np.ones((1, 1, 2)), np.zeros((1, 1, 2), np.int64), 0.1, ON)
    with pytest.raises(ValueError, match="runs, uavs, rows"):
        RiskLedger(budget(), 1, 0, 2)


# ---------------------------------------------------------------------------------------- after the flight


def held_at_the_level(claimed: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds and contacts of 4000 missions at the level of 5 %, sigma claimed so many times the true one."""
    runs, asked = 4000, 0.05
    k = budget(asked).k
    g = gauss_markov(np.random.default_rng(2).standard_normal((runs, 150)), 0.1, 10.0)
    ledger = RiskLedger(budget(1.2 * asked), runs, 1, 1)
    shape = (runs, 1, 1)
    for _ in range(150):
        ledger.spend(np.full(shape, k * claimed), np.full(shape, claimed), np.zeros(shape, np.int64), 0.1,
                     np.ones(runs, dtype=bool))  # fmt: skip
    certificate = ledger.certificate((g > k * claimed).any(-1))
    return certificate.bound, certificate.unannounced


def test_unannounced_contacts_are_as_rare_as_the_budget() -> None:
    bound, unannounced = held_at_the_level(1.0)
    assert unannounced.mean() == pytest.approx(0.05, abs=0.011)
    assert unannounced.mean() <= bound.mean()


def test_a_false_sigma_shows_as_unannounced_contacts() -> None:
    bound, unannounced = held_at_the_level(0.5)
    assert unannounced.mean() > 5.0 * bound.mean()


def test_a_certificate_needs_a_verdict_before_it_is_judged() -> None:
    certificate = RiskLedger(budget(), 1, 1, 1).certificate()
    assert not certificate.announced[0]
    with pytest.raises(ValueError, match="judge the flight"):
        _ = certificate.unannounced


# ------------------------------------------------------------------------------------------ problem keys


def problem(*settings: str) -> Problem:
    return load_problem("study_8s", settings)


def test_k_follows_from_the_risk_of_the_mission() -> None:
    asked = problem("planner.risk_per_mission=0.04", "planner.active_time_s=20")
    assert Inflation.of_problem(asked).k == mission_k(
        0.01, 20.0, error_correlation_time(asked.navigation), 0.1
    )
    assert Inflation.of_problem(problem()) == Inflation.of_planner(problem().planner)
    assert Inflation.of_problem(problem()).k == 3.0
    with pytest.raises(ValueError, match="of_problem"):
        Inflation.of_planner(asked.planner)
    with pytest.raises(ValueError, match="risk_per_mission"):
        RiskBudget.of_problem(problem())


@pytest.mark.parametrize(
    ("navigation", "expected"),
    [
        (GaussMarkov(sigma_min_m=3.0, sigma_max_m=3.0), 10.0),
        (GaussMarkov(), 1.0 / (0.1 + (2.0 / 3.0) ** 2 / 28.0)),
        (GaussMarkov(correlation_time_s=0.0), 0.0),
        (GaussMarkov(filter="kalman"), FILTERED_CORRELATION_TIME_S),
        (ConstantBias(kind="constant"), math.inf),
        (Recorded(kind="recorded", file="log.csv", filter_correlation_time_s=7.0), 7.0),
    ],
)
def test_correlation_time_is_navigations(navigation: Navigation, expected: float) -> None:
    assert error_correlation_time(navigation) == pytest.approx(expected)


def test_correlation_time_can_be_given() -> None:
    asked = ("planner.risk_per_mission=0.1", "navigation.filter=kalman", "planner.risk_correlation_time_s=4")
    assert RiskBudget.of_problem(problem(*asked)).correlation_time_s == 4.0
    assert RiskBudget.of_problem(problem(*asked[:2])).correlation_time_s == FILTERED_CORRELATION_TIME_S


@pytest.mark.parametrize("tau", [2.0, 10.0, 50.0])
@pytest.mark.parametrize("normal", [(1, 0, 0), (1, 1, 0), (1, 1, 1)])
def test_mission_risk_holds_in_all_directions_while_sigma_swings(
    tau: float, normal: tuple[int, int, int]
) -> None:
    """Taken for what it is along an axis, an error of 50 s would pass 1.3 times as often along (1, 1, 1)."""
    runs, asked = 20_000, 0.05
    navigation = GaussMarkov(correlation_time_s=tau)
    rng = np.random.default_rng(4)
    g = gauss_markov(rng.standard_normal((runs, 3, 150)), 0.1, tau)
    phase = rng.uniform(0.0, 2.0 * np.pi, (runs, 3, 1))
    sigma = swinging_sigma(0.1 * np.arange(150), 1.0, 5.0, 20.0, phase) * np.array(normal)[:, None]
    unit = (sigma * g).sum(1) / np.sqrt((sigma**2).sum(1))
    k = RiskBudget(asked, 1, 15.0, error_correlation_time(navigation), 0.1).k
    achieved = (unit > k).any(-1).mean()
    assert asked / 2.0 <= achieved <= asked + 3.0 * math.sqrt(asked / runs)


@pytest.mark.parametrize("rival", ["k=3.0", "confidence=0.99"])
def test_one_of_k_confidence_and_risk(rival: str) -> None:
    name = rival.partition("=")[0]
    with pytest.raises(ProblemError, match=f"exactly one of {name} and risk_per_mission"):
        problem(f"planner.{rival}", "planner.risk_per_mission=0.1")
    # One of them laid over the file takes the others out.
    asked = problem("planner.risk_per_mission=0.1")
    assert (asked.planner.k, asked.planner.risk_per_mission) == (None, 0.1)


@pytest.mark.parametrize("value", ["0", "1", "-0.1", "nan", "true", '"0.1"'])
def test_risks_that_are_none(value: str) -> None:
    with pytest.raises(ProblemError, match="risk_per_mission"):
        problem(f"planner.risk_per_mission={value}")


def test_a_smaller_risk_flies_farther_off() -> None:
    risks, tau = (0.1, 0.01, 0.001), "planner.risk_correlation_time_s=10"
    levels = [Inflation.of_problem(problem(f"planner.risk_per_mission={p}", tau)).k for p in risks]
    assert levels == sorted(levels)
    each = [first_passage_probability(k, 15.0, 10.0, 0.1) for k in levels]
    assert each == pytest.approx([0.025, 0.0025, 0.00025], rel=1e-5)
