"""The replayed logs fly: with their gaps, their halves and their credit."""

from pathlib import Path

import numpy as np
import pytest

from napf_mpc import simulate
from napf_mpc.navigation.error_models import position_errors
from napf_mpc.navigation.replay import RecordedErrors
from napf_mpc.plot.style import credit_of
from napf_mpc.problem_file import load_problem


def errors_of(name: str, data_folder: Path, *settings: str) -> RecordedErrors:
    problem = load_problem(name, list(settings))
    errors = position_errors(problem.navigation, 1, range(20), 4, 100.0, data_folder)
    assert isinstance(errors, RecordedErrors)
    return errors


@pytest.mark.parametrize(
    ("name", "median_m", "longest_m", "claimed_m"),
    [("nagoya_replay", (2.0, 5.0), 100.0, (5.0, 8.0)), ("berlin_replay", (15.0, 40.0), 250.0, (4.0, 6.0))],
)
def test_errors_are_those_of_the_log(
    name: str,
    median_m: tuple[float, float],
    longest_m: float,
    claimed_m: tuple[float, float],
    data_folder: Path,
) -> None:
    """Of one receiver, without mixing: what the READMEs of the data say of them."""
    errors = errors_of(name, data_folder, "navigation.common_mode_share=0")
    across = np.hypot(errors.table.error[:, 0], errors.table.error[:, 1])
    assert median_m[0] < np.median(across) < median_m[1]
    assert across.max() < longest_m
    sigma = np.sqrt(errors.table.covariance[:, 0, 0])
    assert claimed_m[0] < np.median(sigma) < claimed_m[1]


def test_nagoya_has_the_gaps_of_its_second_half(data_folder: Path) -> None:
    errors = errors_of("nagoya_replay", data_folder)
    assert errors.table.available.sum() == 233
    assert errors.table.available.mean() == pytest.approx(0.38, abs=0.02)
    assert errors.overbound is not None
    assert errors.overbound.source.startswith("first half of ")
    east, north, up = errors.overbound.factors(3.0)
    # b counts sqrt(2)-fold for mixed errors: (0.27 sqrt(2) + 3 * 1.85) / 3, and the barometer is no log.
    assert (east, north, up) == pytest.approx((1.98, 2.88, 1.0), abs=0.02)


@pytest.mark.parametrize("name", ["nagoya_replay", "berlin_replay"])
@pytest.mark.parametrize("safety", ["k_sigma", "overbound"])
def test_they_fly(name: str, safety: str, data_folder: Path) -> None:
    problem = load_problem(name, [f'planner.safety="{safety}"', "simulation.time_limit_s=40"])
    flown = simulate(problem, "napf", seed=1, runs=2, data_folder=data_folder).score
    assert np.isfinite(flown.metrics["path_rms_m"]).all()
    assert (flown.metrics["missed_fixes"] > 0.0).all()


def test_their_credit_names_the_authors() -> None:
    assert "T. Suzuki, MatRTKLIB, MIT" in credit_of(load_problem("nagoya_replay"))
    credit = credit_of(load_problem("berlin_replay"))
    for part in ("Reisdorf", "Lange", "smartLoc", "CC BY-SA 4.0"):
        assert part in credit
