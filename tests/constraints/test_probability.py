"""Chances by half-space, ball and disc: against published numbers, scipy's laws and brute force."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from napf_mpc.constraints.probability import (
    BALL,
    DISC,
    HALF_SPACE,
    ellipsoid_half_space_bound,
    exact_margins,
    half_space_probability,
    mission_share,
    reach_margin,
    reach_probability,
    sigma_along,
)
from napf_mpc.first_passage import mission_k
from napf_mpc.navigation.processes import gauss_markov
from napf_mpc.safety_distance import directional_sigma

OFFSET = np.array([0.7, 0.7, 0.8])
COVARIANCE = np.diag([0.04, 0.04, 0.01])
HALF_AXES = np.array([0.6, 0.6, 2.2])


def test_the_half_space_bound_of_table_i_of_zhu_and_alonso_mora_2019() -> None:
    """Their bound 0.0171, their exact chance 0.0109."""
    bound = float(ellipsoid_half_space_bound(OFFSET, COVARIANCE, HALF_AXES))
    assert bound == pytest.approx(0.0171, abs=5e-5)
    draws = 2_000_000
    errors = np.random.default_rng(1).normal(size=(draws, 3)) * np.sqrt(np.diag(COVARIANCE))
    inside = (((OFFSET + errors) / HALF_AXES) ** 2).sum(-1) < 1.0
    assert inside.mean() == pytest.approx(0.0109, abs=4 * np.sqrt(0.0109 / draws))
    assert inside.mean() < bound


def test_the_bound_is_exact_for_a_huge_ball_and_turns_with_the_offset() -> None:
    radius, gap = 1e4, 2.0
    offset = (radius + gap) * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    bound = ellipsoid_half_space_bound(offset, np.diag([1.0, 4.0, 0.25]), np.full(3, radius))
    assert bound == pytest.approx(stats.norm.sf([2.0, 1.0, 4.0]), rel=1e-6)


def test_a_half_space_is_the_one_sided_normal_law() -> None:
    assert half_space_probability(3.0, 1.0) == pytest.approx(0.00134990, abs=1e-8)
    assert half_space_probability(np.array([0.0, -5.0]), 0.5) == pytest.approx([0.5, 1.0])


@given(
    kind=st.sampled_from([BALL, DISC]),
    radius=st.floats(0.3, 20.0),
    sigma=st.floats(0.05, 6.0),
    away=st.floats(0.0, 4.0),
)
def test_equal_errors_follow_the_non_central_chi_square_law(
    kind: int, radius: float, sigma: float, away: float
) -> None:
    distance = radius + away * sigma
    probability, slope = reach_probability(kind, radius, distance, sigma, sigma**2)
    law = stats.ncx2(3 if kind == BALL else 2, (distance / sigma) ** 2)
    exact = law.cdf((radius / sigma) ** 2)
    assert probability == pytest.approx(exact, rel=2e-3, abs=1e-12)
    farther = reach_probability(kind, radius, distance + 1e-4 * sigma, sigma, sigma**2)[0]
    assert (farther - probability) / (1e-4 * sigma) == pytest.approx(slope, rel=1e-2, abs=1e-9 / sigma)


@given(
    kind=st.sampled_from([BALL, DISC]),
    radius=st.floats(0.3, 20.0),
    sigma=st.floats(0.05, 6.0),
    spread=st.floats(0.1, 10.0),
    k=st.floats(0.1, 6.0),
)
def test_a_margin_meets_its_chance_or_is_zero_and_never_exceeds_k_sigma(
    kind: int, radius: float, sigma: float, spread: float, k: float
) -> None:
    g = (spread * sigma) ** 2
    margin = reach_margin(kind, radius, sigma, g, k)
    achieved = reach_probability(kind, radius, radius + margin, sigma, g)[0]
    assert 0.0 <= margin <= k * sigma
    if margin == 0.0:
        assert achieved <= stats.norm.sf(k) * (1.0 + 1e-9)
    elif margin < k * sigma:
        # From above: a margin is never short of its chance by more than rounding.
        assert achieved == pytest.approx(stats.norm.sf(k), rel=1e-4)
        assert achieved <= stats.norm.sf(k) * (1.0 + 1e-9)


def test_large_obstacles_are_walls_and_small_ones_nearly_nothing() -> None:
    for kind in (BALL, DISC):
        margins = [reach_margin(kind, radius, 1.0, 1.0, 3.0) for radius in (0.1, 0.5, 1.0, 4.0, 1e4)]
        assert margins == sorted(margins)
        assert margins[-1] == pytest.approx(3.0, abs=1e-3)
    assert reach_margin(BALL, 0.1, 1.0, 1.0, 3.0) == 0.0
    # A cylinder is hit more easily than a ball.
    assert reach_margin(DISC, 1.0, 1.0, 1.0, 3.0) > reach_margin(BALL, 1.0, 1.0, 1.0, 3.0) + 0.1


@pytest.mark.parametrize("sigma", [0.0, 1e-9])
def test_a_certain_position_needs_no_margin(sigma: float) -> None:
    assert reach_margin(BALL, 1.0, sigma, sigma**2, 3.0) == pytest.approx(0.0, abs=1e-8)


def test_an_error_along_one_line_makes_a_ball_a_wall() -> None:
    """Without an error across, whatever comes far enough hits."""
    normal = np.array([[[1.0, 0.0, 0.0]] * 4])
    covariance = np.array([np.diag([4.0, 0.0, 0.0])])
    margin = np.empty((1, 4))
    kinds = np.array([[HALF_SPACE, BALL, DISC, BALL]])
    exact_margins(kinds, np.array([[1.0, 40.0, 40.0, 1.0]]), normal, covariance, 2.0, margin)
    assert margin[0, :3] == pytest.approx(4.0, rel=1e-3)
    # Two metres thick and no error across: some jump over it.
    assert 2.5 < margin[0, 3] < 4.0


def test_the_bound_holds_for_any_covariance_and_anywhere_along_the_plane() -> None:
    rng = np.random.default_rng(8)
    normal = np.array([1.0, 0.0, 0.0])
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        covariance = root @ root.T
        radius = float(rng.uniform(0.4, 3.0))
        margin = np.empty((1, 1))
        exact_margins(
            np.array([[BALL]]), np.array([[radius]]), normal[None, None], covariance[None], 1.6, margin
        )
        errors = rng.normal(size=(40_000, 3)) @ root.T
        for aside in rng.normal(size=(5, 2)):
            at = np.array([radius + margin[0, 0], *aside])
            hits = int((((at + errors) ** 2).sum(-1) < radius**2).sum())
            assert stats.beta.ppf(1e-5, max(hits, 1), 40_001 - hits) <= stats.norm.sf(1.6)


@pytest.mark.parametrize("kind", [BALL, DISC])
def test_a_missions_share_is_one_where_a_solid_is_a_wall(kind: int) -> None:

    def share(radius: float, tau: float, risk: float = 0.05) -> float:
        k = mission_k(risk, 15.0, tau, 0.1)
        return mission_share(kind, radius, 9.0, k, risk, 15.0, tau, 0.1)

    assert share(1e4, 10.0) == pytest.approx(1.0, abs=1e-5)
    assert share(1.0, 0.0) == pytest.approx(1.0, abs=0.03)  # white: each fix anew
    assert share(1.0, math.inf) == 1.0  # constant: one draw
    small, large = share(0.5, 10.0), share(2.0, 10.0)
    assert 0.0 < small < large < 1.0


@pytest.mark.parametrize(("kind", "axes"), [(BALL, 3), (DISC, 2)])
@pytest.mark.parametrize("radius", [0.8, 2.3])
@pytest.mark.parametrize("tau", [2.0, 10.0, 50.0])
def test_a_mission_beside_a_small_solid_costs_a_third_to_the_whole_of_what_is_asked(
    kind: int, axes: int, radius: float, tau: float
) -> None:
    """With the exact margin of one moment a ball of 0.8 m costs three times what is asked."""
    runs, asked, sigma = 6000, 0.05, 3.0
    k = mission_k(asked, 15.0, tau, 0.1)
    margin = np.empty((1, 2))
    kinds, sizes = np.array([[kind, HALF_SPACE]]), np.full((1, 2), radius)
    normal, covariance = np.tile([1.0, 0.0, 0.0], (1, 2, 1)), sigma**2 * np.eye(3)[None]
    exact_margins(kinds, sizes, normal, covariance, k, margin, asked, 15.0, tau, 0.1)
    assert 0.0 <= margin[0, 0] <= margin[0, 1] == pytest.approx(k * sigma)
    error = sigma * gauss_markov(np.random.default_rng(6).standard_normal((runs, axes, 150)), 0.1, tau)
    error[:, 0] += radius + margin[0, 0]
    achieved = float(((error**2).sum(1) <= radius**2).any(-1).mean())
    spread = 3.0 * math.sqrt(asked / runs)
    assert 0.3 * asked - spread <= achieved <= asked + spread


def test_the_compiled_directional_sigma_is_the_plain_one_to_the_last_bit() -> None:
    rng = np.random.default_rng(8)
    root = rng.standard_normal((200, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    normal = rng.standard_normal((200, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    compiled = [sigma_along(c, *n) for c, n in zip(covariance, normal.tolist(), strict=True)]
    np.testing.assert_array_equal(compiled, directional_sigma(covariance, normal))
    assert sigma_along(np.zeros((3, 3)), 1.0, 0.0, 0.0) == 0.0
