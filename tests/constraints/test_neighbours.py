"""Rows between UAVs: who yields how much, shared errors, downwash, and what a formation can keep."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from napf_mpc.constraints.constraint import ConstraintError, Horizon
from napf_mpc.constraints.contract import check_constraint, sample_horizon, sample_horizons
from napf_mpc.constraints.neighbours import (
    NeighbourSeparation,
    ShortMargins,
    margin_attainable,
    relative_covariance,
    slot_offsets,
    tangent,
)
from napf_mpc.constraints.probability import ellipsoid_half_space_bound
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation, directional_sigma
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
CERTAIN = Inflation(0.0)


def problem(count: int = 2, **formation: Any) -> Problem:
    shape = formation or {"shape": "line", "count": count}
    return Problem.model_validate(
        {
            "vehicle": {"min_separation_m": 0.6},
            "formation": shape,
            "mission": {"kind": "formation", "length_m": 100.0},
            "world": {"kind": "empty"},
        }
    )


def together(*places: tuple[float, float, float], sigma_m: float = 0.0, stages: int = 2) -> Horizon:
    """UAVs that hover in the given places."""
    horizon = sample_horizon(
        np.random.default_rng(0), ObstacleSet.empty(), problem=problem(len(places)), runs=1, stages=stages
    )
    shape = horizon.shape
    return replace(
        horizon,
        position=np.broadcast_to(np.array(places, dtype=float)[:, None], (*shape, 3)).copy(),
        covariance=np.broadcast_to(sigma_m**2 * np.eye(3), (*shape, 3, 3)).copy(),
        common_factor=np.zeros((*shape[:2], 3, 1)),
    )


def gaps(constraint: NeighbourSeparation, horizon: Horizon, position: Array | None = None) -> Array:
    rows = constraint.rows(horizon)
    assert rows.lower is not None
    return rows.values(horizon.position if position is None else position) - rows.lower


def test_each_takes_half_of_the_room_or_all_of_it_against_one_that_does_not_yield() -> None:
    horizon = together((0.0, 0.0, 10.0), (3.0, 4.0, 10.0))
    halves = gaps(NeighbourSeparation(1, 2.0, inflation=CERTAIN), horizon)
    assert halves == pytest.approx(np.full((1, 2, 2, 1), 0.5 * (5.0 - 2.0)))
    alone = gaps(NeighbourSeparation(1, 2.0, share=1.0, inflation=CERTAIN), horizon)
    assert alone == pytest.approx(np.full((1, 2, 2, 1), 3.0))


def test_two_that_keep_their_rows_are_apart_whatever_else_they_do() -> None:
    rng = np.random.default_rng(4)
    horizon = together((0.0, 0.0, 10.0), (0.7, -0.2, 10.4))
    constraint = NeighbourSeparation(1, 1.5, stretch=2.0, inflation=CERTAIN)
    rows = constraint.rows(horizon)
    kept, least = 0, np.inf
    for _ in range(4000):
        position = horizon.position + 2.0 * rng.normal(size=horizon.position.shape)
        free = rows.violation(position).max(-1)[0].max(0) <= 0.0
        offset = (position[0, 0] - position[0, 1]) * np.array([1.0, 1.0, 0.5])
        apart = np.sqrt((offset**2).sum(-1))[free]
        kept += int(free.sum())
        least = min(least, float(apart.min(initial=np.inf)))
    assert kept > 300
    assert 1.5 <= least < 1.9


def test_a_shortfall_is_shared_in_metres() -> None:
    horizon = together((0.0, 0.0, 10.0), (1.0, 0.0, 10.0), sigma_m=0.5)
    gap = gaps(NeighbourSeparation(1, inflation=Inflation(3.0)), horizon)
    # 0.6 m apart and three sigma of the difference of two independent errors.
    assert gap == pytest.approx(0.5 * (1.0 - 0.6 - 3.0 * 0.5 * np.sqrt(2.0)))


def test_a_shared_error_drops_out() -> None:
    horizon = together((0.0, 0.0, 10.0), (5.0, 0.0, 10.0), sigma_m=1.0)
    factor = np.broadcast_to(np.sqrt(0.9) * np.eye(3), (1, 2, 3, 3)).copy()
    gap = gaps(NeighbourSeparation(1, inflation=Inflation(3.0)), replace(horizon, common_factor=factor))
    assert gap == pytest.approx(0.5 * (5.0 - 0.6 - 3.0 * np.sqrt(0.2)))


def test_the_relative_covariance_is_the_one_of_the_navigation_solution() -> None:
    horizon = sample_horizon(np.random.default_rng(2), ObstacleSet.empty(), stages=1)
    covariance = np.zeros((*horizon.shape[:2], 6, 6))
    covariance[..., :3, :3] = horizon.covariance[:, :, 0]
    none = np.zeros((*horizon.shape[:2], 3))
    nav = NavSolution(
        0.0, np.ones(none.shape[:2], bool), none, none, none, none, covariance, horizon.common_factor
    )
    relative = relative_covariance(horizon.covariance[:, :, 0], horizon.common_factor)
    assert relative[:, 1, 3] == pytest.approx(nav.relative_covariance(1, 3))
    assert relative[:, 3, 1] == pytest.approx(relative[:, 1, 3])


def test_the_margin_is_the_half_space_bound_of_the_ellipsoid() -> None:
    """A UAV on its row's bound has the chance of Zhu and Alonso-Mora's bound, one-sided k sigma."""
    offset, half_axes = np.array([0.9, 0.4, 1.5]), np.array([0.6, 0.6, 1.5])
    normal, reach = tangent(offset, 0.6, 2.5, np.zeros(3))
    covariance = np.array([(0.09, 0.02, 0.0), (0.02, 0.04, 0.01), (0.0, 0.01, 0.16)])
    sigma = np.sqrt(normal @ covariance @ normal)
    k = (normal @ offset - reach) / sigma
    bound = ellipsoid_half_space_bound(offset, covariance, half_axes)
    assert bound == pytest.approx(0.5 * math.erfc(k / math.sqrt(2.0)))


def test_downwash_asks_for_more_room_above_than_beside() -> None:
    constraint = NeighbourSeparation(1, 1.0, stretch=3.0, inflation=CERTAIN)
    beside = gaps(constraint, together((0.0, 0.0, 10.0), (2.0, 0.0, 10.0)))
    above = gaps(constraint, together((0.0, 0.0, 10.0), (0.0, 0.0, 12.0)))
    assert beside == pytest.approx(0.5 * (2.0 - 1.0))
    assert above == pytest.approx(0.5 * (2.0 - 3.0))


def test_uavs_in_one_place_part_sideways_by_their_order() -> None:
    horizon = together((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), (1.0, 2.0, 3.0))
    rows = NeighbourSeparation(2, 1.0, inflation=CERTAIN).rows(horizon)
    rows.check(horizon.shape)
    left = horizon.frame.left
    sides = rows.jac[0, :, 0] @ left
    assert sides == pytest.approx(np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]))
    assert rows.violation(horizon.position) == pytest.approx(0.5)
    apart = horizon.position[:, :2] + np.stack([0.5 * left, -0.5 * left])[:, None]
    two = together((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))
    assert NeighbourSeparation(1, 1.0, inflation=CERTAIN).rows(two).violation(apart).max() <= 1e-12


def test_only_the_nearest_and_only_within_reach() -> None:
    horizon = together((0.0, 0.0, 10.0), (3.0, 0.0, 10.0), (0.0, 5.0, 10.0), (90.0, 0.0, 10.0))
    rows = NeighbourSeparation(2, 1.0, inflation=CERTAIN).rows(horizon)
    assert rows.jac[0, 0, 0] == pytest.approx(np.array([(-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)]))
    assert rows.lower is not None
    assert np.isinf(rows.lower[0, 3]).all()
    lone = NeighbourSeparation(3).rows(together((0.0, 0.0, 10.0)))
    lone.check((1, 1, 2))
    assert lone.count == 3
    assert lone.lower is not None
    assert np.isinf(lone.lower).all()


@pytest.mark.parametrize(
    "constraint",
    [
        NeighbourSeparation(),
        NeighbourSeparation(1, 2.0, stretch=2.0, share=1.0),
        NeighbourSeparation(7, inflation=Inflation(2.0, reading="largest")),
        NeighbourSeparation(inflation=Inflation(2.0, reading="rms")),
    ],
    ids=["default", "fixed plans", "more than there are", "rms"],
)
def test_contract(constraint: NeighbourSeparation) -> None:
    check_constraint(constraint, couples_uavs=True)
    if constraint.neighbours == 3:
        check_constraint(constraint, sample_horizons(problem=problem(1)), couples_uavs=True)
        with pytest.raises(ConstraintError, match="UAV 0 alone"):
            check_constraint(constraint)


def test_three_sigma_of_5_m_do_not_fit_into_a_square_of_10_m() -> None:
    square = problem(shape="square", side_m=10.0)

    def fits(sigma_m: float, common: float = 0.0, **settings: Any) -> Array:
        covariance = np.broadcast_to(sigma_m**2 * np.eye(3), (4, 3, 3))
        factor = np.broadcast_to(np.sqrt(common) * sigma_m * np.eye(3), (4, 3, 3))
        return margin_attainable(square, covariance, factor, inflation=Inflation(3.0), **settings)

    pairs = ~np.eye(4, dtype=bool)
    assert not fits(5.0)[pairs].any()
    assert fits(5.0).diagonal().all()
    # Sides of 10 m, diagonals of 14.142 m (UAV 1-2 and 3-4): 3 sqrt(2) 2.5 + 0.6 = 11.2 m fits the latter.
    assert fits(2.5)[pairs].sum() == 4
    assert fits(2.5)[0, 1]
    assert fits(2.5)[2, 3]
    assert fits(2.0).all()
    assert fits(5.0, common=0.9).all()
    assert not fits(2.0, distance_m=2.0)[0, 2]
    wide = problem(shape="square", side_m=25.0, first_lane_m=8.0)
    sigma = np.broadcast_to(25.0 * np.eye(3), (7, 4, 3, 3))
    attainable = margin_attainable(wide, sigma, np.zeros((7, 4, 3, 1)), inflation=Inflation(3.0))
    assert attainable.shape == (7, 4, 4)
    assert attainable.all()


@pytest.mark.parametrize("reading", ["directional", "rms", "chi2", "largest"])
def test_short_margins_are_those_that_a_pair_of_slots_has_no_room_for(reading: Any) -> None:
    """Sigmas of 0.5 to 4.5 m in a square of 10 m; a UAV without trust does not count, and takes less room."""
    square, inflation = (
        problem(shape="square", side_m=10.0, first_lane_m=7.0),
        Inflation(3.0, reading=reading),
    )
    rng = np.random.default_rng(5)
    axes = rng.uniform(0.5, 4.5, (40, 4, 3))
    covariance, factor = axes[..., None] ** 2 * np.eye(3), 0.5 * axes[..., None] * np.eye(3)
    trusted = rng.random((40, 4)) < 0.8
    known = trusted[..., None, None]
    kept = margin_attainable(
        square, np.where(known, covariance, 0.0), np.where(known, factor, 0.0), inflation=inflation
    )
    wanted = (trusted & ~kept.all(-1)).sum(-1)
    counts = np.full(40, 7, dtype=np.int64)
    ShortMargins(square, inflation).count(covariance, factor, trusted, counts)
    np.testing.assert_array_equal(counts, 7 + wanted)
    assert 0 < wanted.sum() < trusted.sum()


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"neighbours": 0}, "neighbours"),
        ({"stretch": 0.5}, "stretch"),
        ({"share": 0.4}, "share"),
        ({"share": np.nan}, "share"),
        ({"distance_m": -1.0}, "distance_m"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, Any], name: str) -> None:
    with pytest.raises(ConstraintError, match=name):
        NeighbourSeparation(**settings)


def test_what_is_asked_of_a_pair_is_no_more_than_its_slots_allow() -> None:
    horizon = together((0.0, 0.0, 10.0), (4.0, 0.0, 10.0), sigma_m=5.0)
    apart = np.linalg.norm(slot_offsets(horizon.problem, horizon.frame)[0, 1])
    asked = 0.6 + 3.0 * 5.0 * np.sqrt(2.0)
    assert asked > 2.0 * apart > 4.0
    free = gaps(NeighbourSeparation(1, inflation=Inflation(3.0)), horizon)
    capped = gaps(NeighbourSeparation(1, inflation=Inflation(3.0), slot_part=2.0), horizon)
    assert free == pytest.approx(0.5 * (4.0 - asked))
    assert capped == pytest.approx(0.5 * (4.0 - 2.0 * apart))


def test_a_short_gap_is_asked_to_open_at_a_speed_and_never_to_less_than_the_bare_distance() -> None:
    horizon = together((0.0, 0.0, 10.0), (2.0, 0.0, 10.0), sigma_m=5.0)
    opened = gaps(NeighbourSeparation(1, inflation=Inflation(3.0), opening_mps=0.5), horizon)
    wanted = 2.0 + 0.5 * np.cumsum(horizon.step_s)
    assert opened[0, 0] == pytest.approx(0.5 * (2.0 - wanted)[:, None])
    close = together((0.0, 0.0, 10.0), (0.2, 0.0, 10.0), sigma_m=5.0)
    bare = gaps(NeighbourSeparation(1, inflation=Inflation(3.0), opening_mps=0.0), close)
    assert bare == pytest.approx(0.5 * (0.2 - 0.6))


@pytest.mark.parametrize(("name", "value"), [("slot_part", -0.1), ("opening_mps", math.nan)])
def test_caps_that_mean_nothing_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConstraintError, match=f"{name} = "):
        NeighbourSeparation(1, **{name: value})


def test_rows_are_made_of_the_tangent_and_the_relative_covariance() -> None:
    """The compiled loop against the plain functions: all pairs of four UAVs, correlated errors, a stretch."""
    rng = np.random.default_rng(11)
    horizon = sample_horizon(rng, ObstacleSet.empty(), runs=3)
    inflation = Inflation(2.0)
    rows = NeighbourSeparation(3, 1.2, stretch=2.5, share=1.0, inflation=inflation, reach_m=1e6).rows(horizon)
    position = horizon.position.transpose(0, 2, 1, 3)
    offset = position[:, :, :, None] - position[:, :, None]
    normal, reach = tangent(offset, 1.2, 2.5, np.array([0.0, 1.0, 0.0]))
    relative = relative_covariance(
        horizon.covariance.transpose(0, 2, 1, 3, 4), horizon.common_factor[:, None]
    )
    required = reach + inflation.k * directional_sigma(relative, normal)
    assert rows.lower is not None
    for uav in range(4):
        others = [other for other in range(4) if other != uav]
        np.testing.assert_array_equal(rows.jac[:, uav], normal[:, :, uav, others])
        level = (normal[:, :, uav, others] * position[:, :, others]).sum(-1) + required[:, :, uav, others]
        np.testing.assert_allclose(rows.lower[:, uav], level, atol=1e-9)
