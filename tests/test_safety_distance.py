"""Safety distance from the navigation variance: k, margins by hand, both readings in the force."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from napf_mpc import apf
from napf_mpc.problem import Planner
from napf_mpc.safety_distance import (
    Inflation,
    clearance_margin,
    confidence_factor,
    directional_sigma,
    largest_sigma,
    rms_sigma,
)

Array = NDArray[np.float64]

EAST = np.array([1.0, 0.0, 0.0])
# Standard deviations 3, 2, 1 m; the first two correlate.
TILTED = np.array([(9.0, 3.0, 0.0), (3.0, 4.0, 0.0), (0.0, 0.0, 1.0)])


def random_covariances(count: int, seed: int) -> Array:
    root = np.random.default_rng(seed).normal(0.0, 2.0, (count, 3, 3))
    return np.einsum("nij,nkj->nik", root, root)


def random_directions(count: int, seed: int) -> Array:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


# -------------------------------------------------------------------------------------------------- k


def test_k_of_the_papers_confidence() -> None:
    assert confidence_factor(0.9974) == pytest.approx(3.0115, abs=5e-5)
    assert confidence_factor(math.erf(3.0 / math.sqrt(2.0))) == pytest.approx(3.0, abs=1e-9)
    assert confidence_factor(0.9974, 3) == pytest.approx(3.773, abs=5e-4)


@given(confidence=st.floats(1e-6, 1.0 - 1e-9), dimensions=st.integers(1, 6))
def test_k_is_the_root_of_the_chi_square_quantile(confidence: float, dimensions: int) -> None:
    expected = math.sqrt(stats.chi2.ppf(confidence, dimensions))
    assert confidence_factor(confidence, dimensions) == pytest.approx(expected, rel=1e-6)


def test_k_sigma_holds_as_many_errors_as_promised() -> None:
    """100,000 errors in space: in one axis, and as a vector in the chi-square ellipsoid."""
    z = np.random.default_rng(1).standard_normal((100_000, 3))
    assert (np.abs(z[:, 0]) < confidence_factor(0.9)).mean() == pytest.approx(0.9, abs=0.004)
    inside = np.linalg.norm(z, axis=-1)
    assert (inside < confidence_factor(0.9, 3)).mean() == pytest.approx(0.9, abs=0.004)
    # The k of one axis is not enough in space: 97.1 % at k = 3.
    assert (inside < 3.0).mean() == pytest.approx(0.971, abs=0.003)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, 1.1, math.nan, math.inf])
def test_confidence_outside_zero_to_one_is_refused(confidence: float) -> None:
    with pytest.raises(ValueError, match="confidence = "):
        confidence_factor(confidence)
    with pytest.raises(ValueError, match="confidence = "):
        clearance_margin(np.eye(3), EAST, confidence)


@pytest.mark.parametrize("dimensions", [0, -1, 1.5, math.inf, math.nan])
def test_dimensions_are_whole(dimensions: Any) -> None:
    with pytest.raises(ValueError, match="dimensions = "):
        confidence_factor(0.9, dimensions)


# -------------------------------------------------------------------------------------------- margins


def test_margin_by_hand() -> None:
    """Sigma 3 m east and 2 m north, correlated: along the diagonal (9 + 2 * 3 + 4) / 2 = 9.5 m^2."""
    k = confidence_factor(0.9974)
    assert clearance_margin(TILTED, EAST, 0.9974) == pytest.approx(3.0 * k)
    diagonal = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
    assert clearance_margin(TILTED, diagonal, 0.9974) == pytest.approx(math.sqrt(9.5) * k)
    across = np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0)
    assert clearance_margin(TILTED, across, 0.9974) == pytest.approx(math.sqrt(3.5) * k)


def test_a_margin_has_two_sides() -> None:
    normals = random_directions(200, 2)
    covariances = random_covariances(200, 3)
    np.testing.assert_array_equal(
        clearance_margin(covariances, normals, 0.99), clearance_margin(covariances, -normals, 0.99)
    )


def test_margin_is_the_scatter_of_errors_along_the_normal() -> None:
    """Errors with that covariance: their standard deviation along n is the margin's sigma."""
    rng = np.random.default_rng(4)
    errors = rng.multivariate_normal(np.zeros(3), TILTED, 200_000)
    for normal in random_directions(5, 5):
        assert np.std(errors @ normal) == pytest.approx(float(directional_sigma(TILTED, normal)), rel=0.01)


@given(seed=st.integers(0, 10_000))
def test_no_direction_exceeds_the_largest_axis(seed: int) -> None:
    """Also where axes correlate: the diagonal's largest entry alone would not bound it."""
    covariance = random_covariances(20, seed)
    sigma = directional_sigma(covariance[:, None], random_directions(50, seed)[None])
    largest = largest_sigma(covariance)
    assert (sigma <= largest[:, None] * (1.0 + 1e-12)).all()
    axis = np.linalg.eigh(covariance)[1][..., -1]
    np.testing.assert_allclose(directional_sigma(covariance, axis), largest, rtol=1e-9)
    bound = Inflation(3.0).largest_margin(covariance)
    assert (3.0 * largest <= bound * (1.0 + 1e-12)).all()


def test_sigmas_of_uncorrelated_axes_are_the_axes() -> None:
    covariance = np.diag([1.0, 25.0, 4.0])
    assert largest_sigma(covariance) == pytest.approx(5.0)
    assert rms_sigma(covariance) == pytest.approx(math.sqrt(10.0))
    assert directional_sigma(covariance, EAST) == 1.0


@pytest.mark.parametrize(
    ("covariance", "normal", "words"),
    [
        (np.diag([1.0, np.nan, 1.0]), EAST, "finite"),
        (np.diag([1.0, np.inf, 1.0]), EAST, "finite"),
        (np.eye(3), np.array([np.nan, 0.0, 0.0]), "finite"),
        (np.diag([1.0, -1.0, 1.0]), EAST, "negative eigenvalue"),
        (np.ones(3), EAST, r"covariance has shape \(3,\), must be \(\.\.\., 3, 3\)"),
        (np.eye(2), EAST, r"covariance has shape \(2, 2\), must be \(\.\.\., 3, 3\)"),
        (np.eye(3), EAST[:2], r"normal has shape \(2,\), must be \(\.\.\., 3\)"),
        (np.zeros((4, 3, 3)), np.tile(EAST, (5, 1)), r"covariance has shape \(4, 3, 3\), normal \(5, 3\)"),
        (np.eye(3), 3.0 * EAST, "normal must be unit vectors, one has the length 3"),
        (np.eye(3), np.zeros(3), "normal must be unit vectors, one has the length 0"),
        (np.array([(1.0, 2.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 1.0)]), EAST, "negative eigenvalue"),
        (np.array([(1.0, 4.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]), EAST, "negative eigenvalue"),
    ],
)
def test_what_is_no_covariance_is_refused(covariance: Array, normal: Array, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        clearance_margin(covariance, normal, 0.99)


def test_a_flat_covariance_is_one() -> None:
    """No error in a direction (rounded to slightly less than none) is a margin of zero, not NaN."""
    flat = np.outer(EAST, EAST) * 4.0 - 1e-13 * np.eye(3)
    assert clearance_margin(flat, np.array([0.0, 1.0, 0.0]), 0.99) == 0.0
    assert clearance_margin(np.zeros((0, 3, 3)), np.zeros((0, 3)), 0.99).shape == (0,)


# ------------------------------------------------------------------------------- inflation in the field


@pytest.mark.parametrize(
    ("settings", "k", "mode", "reading"),
    [
        ({}, 3.0, "shift", "directional"),
        ({"k": 1.7, "sigma": "rms"}, 1.7, "shift", "rms"),
        ({"confidence": 0.9974}, 3.0115, "shift", "directional"),
        ({"confidence": 0.9974, "sigma": "chi2"}, 3.773, "shift", "chi2"),
        ({"k": 0.0, "inflation": "range"}, 0.0, "range", "directional"),
    ],
)
def test_inflation_is_what_the_problem_asks_for(
    settings: dict[str, Any], k: float, mode: str, reading: str
) -> None:
    inflation = Inflation.of_planner(Planner(**settings))
    assert (inflation.mode, inflation.reading) == (mode, reading)
    assert inflation.k == pytest.approx(k, abs=5e-4)


@pytest.mark.parametrize(
    ("reading", "sigma"),
    [
        ("directional", 3.0),
        ("chi2", 3.0),
        ("largest", math.sqrt(6.5 + math.sqrt(15.25))),
        ("rms", math.sqrt(14.0 / 3.0)),
    ],
)
def test_readings_of_sigma_by_hand(reading: Any, sigma: float) -> None:
    margin = Inflation(2.0, reading=reading).margin(TILTED[None], np.array([[EAST, -EAST]]))
    np.testing.assert_allclose(margin, [[2.0 * sigma, 2.0 * sigma]])


@pytest.mark.parametrize("sigma", [0.2, 0.7, 1.0, 1.4])
def test_shift_pushes_as_if_the_obstacle_were_larger(sigma: float) -> None:
    """5 m from the surface, k = 3, rho_0 = 3 m: the force is that at 5 - 3 sigma."""
    inflation = Inflation(3.0, "shift")
    margin = inflation.margin(np.diag([sigma**2] * 3)[None], EAST[None, None])
    rho, influence = inflation.apply(np.array([[5.0]]), margin, 3.0)
    force = apf.repulsion(rho, 15.0, influence, 0.1)[0, 0]
    left = 5.0 - 3.0 * sigma
    expected = 15.0 * (1.0 / left - 1.0 / 3.0) / left**2 if left < 3.0 else 0.0
    assert force == pytest.approx(expected, rel=1e-12)
    assert (force > 0.0) == (sigma > 2.0 / 3.0)


@pytest.mark.parametrize("sigma", [0.2, 0.7, 1.0, 1.4])
def test_range_pushes_earlier_but_never_harder_than_at_the_true_distance(sigma: float) -> None:
    """5 m from the surface: rho_0 = 3 + 3 sigma, the distance stays 5 m."""
    inflation = Inflation(3.0, "range")
    margin = inflation.margin(np.diag([sigma**2] * 3)[None], EAST[None, None])
    rho, influence = inflation.apply(np.array([[5.0]]), margin, 3.0)
    force = apf.repulsion(rho, 15.0, influence, 0.1)[0, 0]
    reach = 3.0 + 3.0 * sigma
    expected = 15.0 * (1.0 / 5.0 - 1.0 / reach) / 25.0 if reach > 5.0 else 0.0
    assert force == pytest.approx(expected, rel=1e-12)
    assert force < 15.0 / 125.0


@pytest.mark.parametrize("k", [math.nan, math.inf, -0.1])
def test_a_factor_that_is_no_factor_is_refused(k: float) -> None:
    """NaN would make every distance compare as "not near": no obstacle at all."""
    with pytest.raises(ValueError, match="k = "):
        Inflation(k)


def test_readings_that_do_not_exist_are_refused() -> None:
    wrong: Any = "shifted"
    with pytest.raises(ValueError, match="mode = 'shifted' must be one of shift, range"):
        Inflation(3.0, wrong)
    with pytest.raises(ValueError, match="reading = 'shifted' must be one of directional"):
        Inflation(3.0, "shift", wrong)


@pytest.mark.parametrize("reading", ["directional", "largest", "rms"])
def test_margins_are_the_same_bits_in_any_company(reading: Any) -> None:
    inflation = Inflation(1.7, reading=reading)
    covariance = random_covariances(24, 6).reshape(6, 4, 3, 3)
    normal = random_directions(72, 7).reshape(6, 4, 3, 3)
    together = inflation.margin(covariance, normal)
    for run in range(6):
        alone = inflation.margin(covariance[run : run + 1], normal[run : run + 1])
        np.testing.assert_array_equal(alone[0], together[run])
