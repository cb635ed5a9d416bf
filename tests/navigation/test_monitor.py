"""The monitor of innovations: silent when sigmas hold, soon loud when they do not, and what it does then."""

import numpy as np
import pytest
from scipy import stats

from napf_mpc.block import fly_block, simulate
from napf_mpc.errors import ProblemError
from napf_mpc.navigation.kalman import rescale
from napf_mpc.navigation.monitor import ALARM_HITS, HIT, MEDIAN, WINDOW, InnovationMonitor
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.streams import Stream, normals


def run(monitor: InnovationMonitor, squared: np.ndarray) -> list[float]:
    """Feed squared innovations (epoch, run, uav, 3), each over the scale of that moment; times of alarms."""
    for epoch, values in enumerate(squared):
        monitor.observe(values / monitor.scale, 0.1 * epoch)
    return [event.time_s for event in monitor.events]


def innovations(runs: int, epochs: int, sigma: float, seed: int = 31) -> np.ndarray:
    return np.moveaxis((sigma * normals(seed, range(runs), Stream.OWN_ERROR, 1, 3, epochs)) ** 2, -1, 0)


def test_numbers_are_those_of_the_chi_square_law() -> None:
    assert pytest.approx(stats.chi2.median(1), abs=1e-12) == MEDIAN
    share = stats.chi2.sf(HIT, 1)
    assert share == pytest.approx(0.0455, abs=1e-4)
    assert stats.binom.sf(ALARM_HITS - 1, WINDOW, share) == pytest.approx(5e-7, rel=0.05)


def test_silent_when_sigmas_hold() -> None:
    monitor = InnovationMonitor(200, 1)
    assert run(monitor, innovations(200, 1000, 1.0)) == []  # 600000 windows of chance 5e-7 that overlap
    assert (monitor.scale == 1.0).all()


@pytest.mark.parametrize(("factor", "soon_s"), [(5.0, 3.0), (3.0, 8.0)])
def test_loud_within_a_declared_time(factor: float, soon_s: float) -> None:
    """Sigma reported a fifth: all 300 axes alarm within 30 fixes, and the scale that it takes is found."""
    monitor = InnovationMonitor(100, 1)
    run(monitor, innovations(100, round(10 * soon_s), factor))
    assert (monitor.alarms > 0).all()
    first = {(event.run, event.axis) for event in monitor.events}
    assert len(first) == 300
    more = InnovationMonitor(100, 1)
    run(more, innovations(100, 400, factor))
    assert np.median(np.sqrt(more.scale)) == pytest.approx(factor, rel=0.25)


def test_one_wild_fix_or_two_are_not_its_affair() -> None:
    squared = innovations(1, 200, 1.0)
    squared[50:54] = 400.0
    squared[120] = np.nan  # no fix, no opinion
    assert run(InnovationMonitor(1, 1), squared) == []


def test_the_scale_falls_when_sigmas_hold_again_but_never_below_one() -> None:
    monitor = InnovationMonitor(50, 1)
    run(monitor, np.concatenate([innovations(50, 60, 5.0), innovations(50, 600, 1.0, seed=32)]))
    assert monitor.largest.min() > 2.0
    assert np.median(monitor.scale) < 3.0
    assert monitor.scale.min() == 1.0


def test_rescaling_keeps_the_error_and_a_covariance() -> None:
    mean = np.array([[[[1.0, 2.0, 0.8, 0.1]] * 3]])
    root = np.tril(np.arange(1.0, 17.0).reshape(4, 4)) / 10.0
    full = root @ root.T
    packed = np.tile(full[np.triu_indices(4)], (1, 1, 3, 1))
    change = np.array([[[4.0, 0.25, 100.0]]])
    rescale(mean, packed, change)
    sigma = np.sqrt(change[0, 0])  # of the fixes, in units of the old
    np.testing.assert_allclose(sigma * mean[0, 0, :, 2], 0.8)
    for axis, grown in enumerate((4.0, 1.0, 100.0)):
        out = np.zeros((4, 4))
        out[np.triu_indices(4)] = packed[0, 0, axis]
        out = np.triu(out) + np.triu(out, 1).T
        assert out[0, 0] == pytest.approx(grown * full[0, 0])
        assert np.linalg.eigvalsh(out).min() > 0.0


def test_a_fix_that_was_refused_and_is_begun_with_is_as_uncertain_as_it_is_far() -> None:
    monitor = InnovationMonitor(1, 2)
    squared = np.full((1, 2, 3), np.nan)
    squared[0, 1] = [25.0, 0.5, 4.0]  # 5, 0.7 and 2 sigmas from the estimate
    monitor.disagree(squared, 7.0)
    assert np.sqrt(monitor.scale[0]).tolist() == [[1.0, 1.0, 1.0], [5.0, 1.0, 2.0]]
    assert [(event.uav, event.axis, event.sigma_scale, event.time_s) for event in monitor.events] == [
        (1, 0, 5.0, 7.0),
        (1, 2, 2.0, 7.0),
    ]


# ------------------------------------------------------------------------------------------------ flown


def study(*settings: str) -> Problem:
    return load_problem("study_8s", ['navigation.filter="kalman"', "simulation.time_limit_s=30", *settings])


WATCHED = 'navigation.monitor="innovations"'


def test_a_consistent_flight_is_the_same_to_the_last_bit() -> None:
    plain = simulate(study(), "napf", seed=41, runs=4, record_every=25)
    watched = simulate(study(WATCHED), "napf", seed=41, runs=4, record_every=25)
    assert (watched.score.metrics["monitor_alarms"] == 0.0).all()
    assert (watched.score.metrics["monitor_scale"] == 1.0).all()
    assert np.isnan(plain.score.metrics["monitor_alarms"]).all()
    for name in ("x_m", "est_x_m", "sigma_x_m", "ref_x_m"):
        np.testing.assert_array_equal(plain.trajectories[name], watched.trajectories[name])


def test_a_fifth_of_the_sigma_is_flagged_in_time_and_in_the_results() -> None:
    block = fly_block(study(WATCHED, "navigation.reported_sigma_scale=0.2"), ["napf"], 41, range(3, 7))
    events = block.events
    assert (block.rows["monitor_alarms"] >= 12).all()  # four UAVs of three axes
    assert (block.rows["monitor_scale"] > 3.0).all()
    first: dict[tuple[int, int, str], float] = {}
    for run_index, uav, cause, time_s in zip(
        events["run"], events["uav"], events["cause"], events["t_s"], strict=True
    ):
        if "fixes" in str(cause):  # a dispute begins or ends
            continue
        first.setdefault((int(run_index), int(uav), str(cause)), float(time_s))
    assert {key[0] for key in first} == {3, 4, 5, 6}
    assert len(first) == 4 * 4 * 3
    assert max(first.values()) <= 3.0  # 30 fixes at 10 Hz
    assert all("too small for its innovations" in cause for _, _, cause in first)
    assert set(events["action"][0].split(" x ")[0].split()) <= {"sigma", "east", "north", "up"}


def test_disputes_are_told_among_the_events() -> None:
    """Between houses positions jump: who holds when, and until when, stands in the results."""
    settings = ['navigation.filter="kalman"', WATCHED, "simulation.time_limit_s=60"]
    street = load_problem("street_canyon_gnss", settings)
    events = fly_block(street, ["napf"], 301, range(4)).events
    disputes = ["fixes" in str(cause) for cause in events["cause"]]
    turns = list(zip(events["run"], events["uav"], events["t_s"], events["action"], strict=True))
    begun = [turn for turn, is_one in zip(turns, disputes, strict=True) if is_one and turn[3] == "hold"]
    ended = [turn for turn, is_one in zip(turns, disputes, strict=True) if is_one and turn[3] == "fly on"]
    assert begun
    assert ended
    for run, uav, time_s, _ in ended:
        assert any(one[:2] == (run, uav) and one[2] < time_s for one in begun)


def test_alarms_do_not_depend_on_the_block() -> None:
    problem = study(WATCHED, "navigation.reported_sigma_scale=0.3", "simulation.time_limit_s=10")
    together = fly_block(problem, ["napf"], 41, range(3))
    alone = fly_block(problem, ["napf"], 41, range(2, 3))
    for name in ("monitor_alarms", "monitor_scale", "min_clearance_m"):
        assert together.rows[name][2] == alone.rows[name][0]


def test_the_filter_says_more_of_what_it_is_worth() -> None:
    low = "navigation.reported_sigma_scale=0.2"
    plain = simulate(study(low), "napf", seed=41, runs=6).score.metrics["nees_position"]
    watched = simulate(study(low, WATCHED), "napf", seed=41, runs=6).score.metrics["nees_position"]
    assert np.median(plain) > 15.0
    assert np.median(watched) < 6.0


def test_without_a_filter_there_is_nothing_to_watch() -> None:
    with pytest.raises(ProblemError, match="watches a filter's innovations"):
        load_problem("study_8s", [WATCHED])
