"""Measured pseudoranges of a drive through Berlin: what the data say comes out, and what helps."""

from pathlib import Path

import berlin_pseudoranges as berlin
import numpy as np
import pytest

from napf_mpc.navigation.pseudorange_solution import SolverSettings

PLAIN = SolverSettings("plain", exclude=False, max_pdop=1e6)


def across(error: np.ndarray) -> list[float]:
    return [float(q) for q in np.quantile(np.hypot(error[:, 0], error[:, 1]), [0.5, 0.95])]


def test_plain_least_squares_is_that_of_the_datas_readme(data_folder: Path) -> None:
    """27.8 / 62.0 m over 1372 epochs, +60.6 m up, 38.9 % in 3 drms; the earth turns by 21 m meanwhile."""
    ranges, truth = berlin.read(data_folder)
    error, covariance, _ = berlin.errors(ranges, truth, berlin.ALL, PLAIN)
    assert len(error) == 1372
    assert across(error) == pytest.approx([27.8, 62.0], abs=0.1)
    assert error[:, 2].mean() == pytest.approx(60.6, abs=0.1)
    drms = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    assert np.mean(np.hypot(error[:, 0], error[:, 1]) < 3.0 * drms) == pytest.approx(0.389, abs=0.002)
    still, _, _ = berlin.errors(ranges, truth, berlin.ALL, PLAIN, turns=False)
    assert (still - error)[:, 0].mean() == pytest.approx(21.0, abs=1.0)


def test_masks_exclusion_and_weights_lower_the_median(data_folder: Path) -> None:
    ranges, truth = berlin.read(data_folder)
    best, _, check = berlin.errors(ranges, truth, berlin.STRONGER, SolverSettings("cauchy", max_pdop=1e6))
    assert across(best)[0] < 17.0
    assert len(best) > 1340
    assert (check > 0).all()
