"""What a planner receives: trust in a solution, and the covariance between two UAVs."""

import numpy as np
import pytest

from napf_mpc.navigation.solution import NavSolution

RUNS, UAVS = 2, 3


def solution(**changes: np.ndarray) -> NavSolution:
    arrays = {
        "available": np.ones((RUNS, UAVS), dtype=bool),
        "position": np.zeros((RUNS, UAVS, 3)),
        "velocity": np.zeros((RUNS, UAVS, 3)),
        "attitude": np.zeros((RUNS, UAVS, 3)),
        "body_rates": np.zeros((RUNS, UAVS, 3)),
        "covariance": np.tile(np.diag([9.0, 4.0, 1.0, 0.0, 0.0, 0.0]), (RUNS, UAVS, 1, 1)),
        "common_factor": np.zeros((RUNS, UAVS, 3, 3)),
    }
    return NavSolution(time_s=0.0, **(arrays | changes))


def test_a_complete_solution_is_trusted():
    assert solution().trusted().all()


@pytest.mark.parametrize("name", ["position", "velocity", "attitude", "body_rates", "covariance"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_not_trusted_and_harms_no_other_uav(name: str, value: float):
    nav = solution()
    getattr(nav, name)[1, 2].flat[-1] = value
    expected = np.ones((RUNS, UAVS), dtype=bool)
    expected[1, 2] = False
    np.testing.assert_array_equal(nav.trusted(), expected)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("variance", [0.0, -1.0, np.nan])
def test_zero_or_negative_variance_is_unknown_not_certain(axis: int, variance: float):
    nav = solution()
    nav.covariance[0, 1, axis, axis] = variance
    assert not nav.trusted()[0, 1]
    assert nav.trusted().sum() == RUNS * UAVS - 1


@pytest.mark.parametrize(
    "block",
    [
        [[1.0, 5.0, 0.0], [5.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1e-6, 2e-6], [0.0, 2e-6, 1e-6]],
        [[1.0, 0.9, 0.9], [0.9, 1.0, 0.0], [0.9, 0.0, 1.0]],  # only the determinant shows it
    ],
)
def test_a_covariance_with_a_negative_eigenvalue_is_unknown_not_certain(block: list[list[float]]):
    """Along some direction it would claim a sigma of zero or less."""
    assert np.linalg.eigvalsh(np.array(block)).min() < 0.0
    covariance = np.tile(np.eye(6), (RUNS, UAVS, 1, 1))
    covariance[0, 0, :3, :3] = block
    trusted = solution(covariance=covariance).trusted()
    assert not trusted[0, 0]
    assert trusted.sum() == RUNS * UAVS - 1


def test_a_covariance_without_spread_in_one_direction_is_trusted():
    """A singular matrix is no fault: two axes may be wholly correlated."""
    covariance = np.tile(np.eye(6), (RUNS, UAVS, 1, 1))
    covariance[0, 0, :3, :3] = np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    assert solution(covariance=covariance).trusted().all()


def test_a_matrix_that_is_not_symmetric_is_no_covariance():
    covariance = np.tile(np.eye(6), (RUNS, UAVS, 1, 1))
    covariance[..., 0, 1] = covariance[..., 1, 0] = 0.5
    covariance[0, 1, 0, 1] = 0.4
    covariance[1, 0, 0, 1] += 1e-9  # rounding
    trusted = solution(covariance=covariance).trusted()
    assert not trusted[0, 1]
    assert trusted.sum() == RUNS * UAVS - 1


def test_velocity_may_be_error_free():
    """Zero velocity variance is what a model with true velocities reports; only position is inflated."""
    assert (solution().covariance[..., 3:, 3:] == 0.0).all()
    assert solution().trusted().all()


def test_without_a_fix_a_solution_is_not_trusted():
    available = np.ones((RUNS, UAVS), dtype=bool)
    available[0, 0] = False
    np.testing.assert_array_equal(solution(available=available).trusted(), available)


def test_position_covariance_is_the_upper_block():
    np.testing.assert_array_equal(solution().position_covariance[1, 2], np.diag([9.0, 4.0, 1.0]))


def test_independent_uavs_add_their_covariances():
    np.testing.assert_array_equal(
        solution().relative_covariance(0, 1), np.tile(np.diag([18.0, 8.0, 2.0]), (RUNS, 1, 1))
    )


def test_a_wholly_shared_error_drops_out_of_the_relative_position():
    factor = np.tile(np.diag([3.0, 2.0, 1.0]), (RUNS, UAVS, 1, 1))
    np.testing.assert_allclose(solution(common_factor=factor).relative_covariance(0, 2), 0.0, atol=1e-12)


def test_relative_covariance_is_what_the_joint_covariance_says():
    """Var(e_i - e_j) from the full joint covariance of both UAVs, axes correlated, factors unequal."""
    rng = np.random.default_rng(1)
    factor = rng.normal(size=(RUNS, UAVS, 3, 2))
    own = rng.normal(size=(RUNS, UAVS, 3, 3))
    covariance = np.zeros((RUNS, UAVS, 6, 6))
    covariance[..., :3, :3] = factor @ factor.transpose(0, 1, 3, 2) + own @ own.transpose(0, 1, 3, 2)
    nav = solution(covariance=covariance, common_factor=factor)
    for run in range(RUNS):
        joint = np.block(
            [
                [covariance[run, 0, :3, :3], factor[run, 0] @ factor[run, 2].T],
                [factor[run, 2] @ factor[run, 0].T, covariance[run, 2, :3, :3]],
            ]
        )
        difference = np.hstack([np.eye(3), -np.eye(3)])
        np.testing.assert_allclose(
            nav.relative_covariance(0, 2)[run], difference @ joint @ difference.T, atol=1e-12
        )
    np.testing.assert_allclose(nav.relative_covariance(0, 2), nav.relative_covariance(2, 0), atol=1e-12)
