"""Factors k hold as many errors as promised, by the law of their tail."""

import math

import numpy as np
import pytest
from scipy import stats

from napf_mpc.navigation.integrity.tails import StudentTail, confidence_factor, fit_student, student_factor
from napf_mpc.streams import Stream, normals

DRAWS = normals(11, range(1), Stream.OWN_ERROR, 1, 7, 200_000)[0, 0]


@pytest.mark.parametrize("dimensions", [1, 2, 3])
@pytest.mark.parametrize("dof", [3.0, math.inf])
def test_k_holds_its_share_in_every_dimension(dimensions: int, dof: float) -> None:
    chi = np.sqrt((DRAWS[3:6] ** 2).sum(0) / 3.0) if dof == 3.0 else 1.0
    radius = np.sqrt(((DRAWS[:dimensions] / chi) ** 2).sum(0))
    for confidence in (0.5, 0.9, 0.99):
        k = student_factor(confidence, dof, dimensions)
        assert (radius <= k).mean() == pytest.approx(confidence, abs=0.003)


def test_k_of_known_laws() -> None:
    assert student_factor(0.9, 1.0) == pytest.approx(math.tan(math.pi * 0.45))  # Cauchy
    assert student_factor(0.9973, 1.0) == pytest.approx(235.8, abs=0.1)
    assert student_factor(0.95, math.inf, 2) == confidence_factor(0.95, 2) == pytest.approx(2.4477, abs=1e-4)
    assert student_factor(0.95, 1e7, 3) == pytest.approx(confidence_factor(0.95, 3), rel=1e-5)


@pytest.mark.parametrize(
    ("confidence", "dof", "dimensions"),
    [(0.0, 3.0, 1), (1.0, 3.0, 1), (0.9, 0.0, 1), (0.9, -math.inf, 1), (0.9, math.nan, 1), (0.9, 3.0, 0)],
)
def test_what_is_no_probability_or_no_law(confidence: float, dof: float, dimensions: int) -> None:
    with pytest.raises(ValueError, match=r"must be"):
        student_factor(confidence, dof, dimensions)


def test_fit_finds_the_law_that_was_drawn() -> None:
    chi = np.sqrt((DRAWS[3:7] ** 2).sum(0) / 4.0)
    found = fit_student(0.5 * DRAWS[0] / chi)
    assert found.degrees_of_freedom == pytest.approx(4.0, rel=0.05)
    assert found.scale == pytest.approx(0.5, rel=0.02)
    assert found.factor(0.99) == pytest.approx(0.5 * float(stats.t.ppf(0.995, 4.0)), rel=0.03)
    assert fit_student(DRAWS[0][:20_000]).degrees_of_freedom > 50.0  # normal
    assert StudentTail(4.0, 2.0).factor(0.9) == pytest.approx(2.0 * student_factor(0.9, 4.0))


@pytest.mark.parametrize("values", [np.ones(9), np.zeros(50), np.array([np.nan] * 50)])
def test_fit_refuses_what_is_no_sample(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="10 or more finite numbers"):
        fit_student(values)
