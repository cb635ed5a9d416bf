"""The separation rows' half-space against the published point of Zhu and Alonso-Mora (2019), Table I.

An ellipsoid of half-axes (0.6, 0.6, 2.2) m, an offset of (0.7, 0.7, 0.8) m, a relative covariance of
diag(0.04, 0.04, 0.01) m^2: the bound they print is 0.0171 and the exact chance 0.0109. Quadrature gives
0.011009 for the latter (and 1e8 draws 0.01101 with a standard error of 0.00001), a per cent above the print.
"""

import numpy as np
import pytest
from scipy import integrate, stats

from napf_mpc.constraints.neighbours import tangent
from napf_mpc.constraints.probability import ellipsoid_half_space_bound, half_space_probability
from napf_mpc.safety_distance import directional_sigma

OFFSET = np.array([0.7, 0.7, 0.8])
VARIANCES = np.array([0.04, 0.04, 0.01])
COVARIANCE = np.diag(VARIANCES)
DISTANCE_M, HEIGHT_M = 0.6, 2.2
STRETCH = HEIGHT_M / DISTANCE_M
ASIDE = np.array([0.0, 1.0, 0.0])


def exact_risk() -> float:
    """Chance that the offset with its error lies in the ellipsoid, by quadrature.

    At each height the ellipsoid is a disc, and a horizontal error equal in all directions is in it by the
    non-central chi-square law of two degrees of freedom.
    """
    flat, up = np.sqrt(VARIANCES[0]), np.sqrt(VARIANCES[2])
    square = (OFFSET[0] ** 2 + OFFSET[1] ** 2) / flat**2

    def density(z: float) -> float:
        radius = DISTANCE_M * np.sqrt(1.0 - (z / HEIGHT_M) ** 2)
        return float(stats.ncx2.cdf((radius / flat) ** 2, 2, square) * stats.norm.pdf(z, OFFSET[2], up))

    low, high = OFFSET[2] - 8.0 * up, OFFSET[2] + 8.0 * up
    chance, error = integrate.quad(density, low, high, epsabs=1e-10)
    assert error < 1e-8
    return float(chance)


def separation_bound(offset: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Chance of an error beyond the plane that the separation rows keep."""
    normal, reach = tangent(offset, DISTANCE_M, STRETCH, ASIDE)
    gap = (normal * offset).sum(-1) - reach
    return half_space_probability(gap, directional_sigma(covariance, normal))


def test_the_plane_of_the_separation_rows_has_the_published_chance() -> None:
    bound = separation_bound(OFFSET, COVARIANCE)
    assert bound == pytest.approx(0.0171, abs=5e-5)
    axes = np.array([DISTANCE_M, DISTANCE_M, HEIGHT_M])
    assert bound == pytest.approx(float(ellipsoid_half_space_bound(OFFSET, COVARIANCE, axes)), rel=1e-12)


def test_the_exact_chance_is_the_published_one_and_less_than_the_bound() -> None:
    exact = exact_risk()
    assert exact == pytest.approx(0.011009, abs=1e-6)
    assert exact == pytest.approx(0.0109, rel=0.011)
    draws = 1_000_000
    errors = np.random.default_rng(7).normal(size=(draws, 3)) * np.sqrt(VARIANCES)
    inside = (((OFFSET + errors) / [DISTANCE_M, DISTANCE_M, HEIGHT_M]) ** 2).sum(-1) < 1.0
    assert inside.mean() == pytest.approx(exact, abs=4.0 * np.sqrt(exact / draws))
    assert exact < separation_bound(OFFSET, COVARIANCE)


def test_the_ellipsoid_lies_behind_the_plane_and_touches_it() -> None:
    """Whence the bound: whoever is in the ellipsoid is beyond the plane, wherever the other UAV is."""
    rng = np.random.default_rng(3)
    offset = rng.normal(size=(200, 3)) * [2.0, 2.0, 4.0]
    normal, reach = tangent(offset, DISTANCE_M, STRETCH, ASIDE)
    ball = rng.normal(size=(5000, 3))
    surface = ball / np.linalg.norm(ball, axis=1)[:, None] * [DISTANCE_M, DISTANCE_M, HEIGHT_M]
    farthest = (normal @ surface.T).max(-1)
    assert (farthest <= reach + 1e-12).all()
    np.testing.assert_allclose(farthest, reach, rtol=5e-3)


def test_the_bound_never_undercuts_the_chance() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        root = 0.3 * rng.normal(size=(3, 3))
        offset = rng.normal(size=3)
        offset *= rng.uniform(1.0, 2.0) / np.linalg.norm(offset / [DISTANCE_M, DISTANCE_M, HEIGHT_M])
        errors = rng.normal(size=(20_000, 3)) @ root.T
        inside = (((offset + errors) / [DISTANCE_M, DISTANCE_M, HEIGHT_M]) ** 2).sum(-1) < 1.0
        hits = int(inside.sum())
        least = stats.beta.ppf(1e-6, hits, 20_001 - hits) if hits else 0.0
        assert least <= separation_bound(offset, root @ root.T)
