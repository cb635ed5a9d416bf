"""What guidance remembers of the sigmas of measurements."""

from __future__ import annotations

import numpy as np
import pytest

from napf_mpc.planners.sigma_memory import SigmaMemory


def covariances(sigma: float | list[float]) -> np.ndarray:
    """One UAV with these sigmas along its axes [m]."""
    return np.asarray(np.diag(np.broadcast_to(np.square(sigma), 3)))[None, None]


def sigmas(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diagonal(covariance[0, 0]))


def test_what_is_reported_first_is_taken_as_it_is() -> None:
    assert sigmas(SigmaMemory(1, 1, 15.0).raised(covariances([1.0, 2.0, 3.0]), 0.0)) == pytest.approx(
        [1, 2, 3]
    )


def test_a_sigma_that_swings_is_at_least_its_mean_when_it_is_small() -> None:
    memory = SigmaMemory(1, 1, 15.0)
    told = []
    for tick in range(600):  # 3 + 2 sin, period 20 s, as in the study scenes
        sigma = 3.0 + 2.0 * np.sin(2.0 * np.pi * 0.4 * tick / 20.0)
        told.append((sigma, sigmas(memory.raised(covariances(sigma), 0.4 if tick else 0.0))[0]))
    now, raised = np.array(told)[250:].T
    assert np.all(raised >= now - 1e-12)
    # The amplitude of a mean that fades with 15 s is 2 / sqrt(1 + (15 * 2 pi / 20)^2) = 0.42 m.
    assert raised.min() == pytest.approx(3.0 - 0.42, abs=0.03)
    assert raised[now > 3.5] == pytest.approx(now[now > 3.5])


def test_a_wild_report_of_a_second_is_forgotten_soon() -> None:
    memory = SigmaMemory(1, 1, 15.0)
    for _ in range(100):
        memory.raised(covariances(3.0), 0.5)
    for _ in range(2):
        assert sigmas(memory.raised(covariances(57.0), 0.5)) == pytest.approx([57.0] * 3)
    after = sigmas(memory.raised(covariances(3.0), 0.5))[0]
    assert after == pytest.approx(3.0 + 54.0 * (1.0 - np.exp(-1.0 / 15.0)) * np.exp(-0.5 / 15.0))
    assert after < 6.5  # m; the largest value would still be 55


def test_axes_are_raised_by_themselves_and_correlations_stay() -> None:
    memory = SigmaMemory(2, 1, 10.0)
    first = np.diag([25.0, 1.0, 4.0])
    now = np.array([[4.0, 0.8, 0.0], [0.8, 1.0, 0.3], [0.0, 0.3, 4.0]])
    memory.raised(np.stack([first, now])[:, None], 0.0)
    out = memory.raised(np.stack([now, now])[:, None], 1.0)[:, 0]
    east = 5.0 + (1.0 - np.exp(-0.1)) * (2.0 - 5.0)
    assert np.sqrt(np.diagonal(out[0])) == pytest.approx([east, 1.0, 2.0])
    assert out[0, 0, 1] / np.sqrt(out[0, 0, 0] * out[0, 1, 1]) == pytest.approx(0.4)
    assert out[1] == pytest.approx(now)  # another run remembers nothing of it


def test_a_perfect_axis_stays_perfect() -> None:
    memory = SigmaMemory(1, 1, 10.0)
    memory.raised(covariances([5.0, 0.0, 5.0]), 0.0)
    out = memory.raised(covariances([1.0, 0.0, 0.0]), 0.4)
    assert np.isfinite(out).all()
    assert sigmas(out)[1:] == pytest.approx([0.0, 0.0])


def test_without_a_time_nothing_is_remembered() -> None:
    memory = SigmaMemory(1, 1, 0.0)
    memory.raised(covariances(5.0), 0.0)
    assert sigmas(memory.raised(covariances(1.0), 0.4)) == pytest.approx([1.0] * 3)
