"""Margins of a passage: against the law they tabulate, against errors that drift by, and in the rows."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from napf_mpc.constraints.clearance import Gaps, ObstacleContact
from napf_mpc.constraints.constraint import Horizon
from napf_mpc.constraints.contract import check_constraint, sample_horizons
from napf_mpc.constraints.passage import (
    half_space_margins,
    margins_beside,
    passage_margins,
    sigmas_beside,
    volume,
)
from napf_mpc.constraints.probability import (
    BALL,
    exact_margins,
    mission_share,
    reach_margin,
)
from napf_mpc.formation import PathFrame
from napf_mpc.navigation.processes import gauss_markov
from napf_mpc.problem import Problem
from napf_mpc.risk_budget import RiskBudget
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Shape, Sphere

Array = NDArray[np.float64]

K = 3.0
PASSAGE = passage_margins(Inflation(K))


def horizon(place: tuple[float, float, float], shapes: list[Shape], covariance: Array) -> Horizon:
    problem = Problem.model_validate(
        {
            "vehicle": {"radius_m": 0.3},
            "formation": {"shape": "line", "count": 1},
            "mission": {"kind": "formation", "length_m": 100.0},
            "world": {"kind": "empty"},
        }
    )
    return Horizon(
        time_s=0.0,
        step_s=np.array([0.1]),
        position=np.array(place).reshape(1, 1, 1, 3),
        velocity=np.zeros((1, 1, 1, 3)),
        covariance=covariance.reshape(1, 1, 1, 3, 3),
        common_factor=np.zeros((1, 1, 3, 1)),
        obstacles=ObstacleSet.from_shapes(shapes),
        frame=PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0),
        problem=problem,
    )


@given(radius=st.floats(0.03, 200.0), spread=st.floats(0.03, 30.0), sigma=st.floats(0.01, 20.0))
def test_the_table_is_its_law_to_a_hundredth_of_a_sigma(radius: float, spread: float, sigma: float) -> None:
    """Radius and spread across the normal in sigmas; what comes by for ever takes the chance's limit."""
    share = mission_share(BALL, radius, max(1.0, spread**2), K, 0.0, 1e12, 1.0, 1.0)
    law = reach_margin(BALL, radius, 1.0, spread**2, K, share)
    looked_up = sigmas_beside(PASSAGE, radius * sigma, sigma, (spread * sigma) ** 2)
    assert looked_up == pytest.approx(law, abs=0.01)
    assert 0.0 <= looked_up <= K


def test_what_is_large_is_a_wall_and_what_is_small_takes_less() -> None:
    """A ball of 2 m and an error of 5 m: less than four fifths of a wall's margin."""
    assert sigmas_beside(PASSAGE, 1e6, 1.0, 1.0) == pytest.approx(K, abs=1e-3)
    assert sigmas_beside(PASSAGE, 2.0, 5.0, 25.0) == pytest.approx(2.33, abs=0.03)
    sizes = [sigmas_beside(PASSAGE, radius, 1.0, 1.0) for radius in np.geomspace(0.1, 100.0, 40)]
    assert (np.diff(sizes) > 0.0).all()


def test_without_a_size_or_an_error_it_is_k_sigma() -> None:
    assert sigmas_beside(PASSAGE, 0.0, 1.0, 1.0) == K
    assert sigmas_beside(PASSAGE, 1.0, 0.0, 0.0) == K


def test_a_wall_everywhere_is_k_to_the_last_bit() -> None:
    wall = half_space_margins(2.3)
    rng = np.random.default_rng(4)
    for radius, sigma, g in np.exp(rng.uniform(-3.0, 3.0, (500, 3))):
        assert sigmas_beside(wall, radius, sigma, g) == 2.3


@pytest.mark.parametrize("radius", [0.8, 2.3, 6.0])
def test_an_error_that_drifts_by_hits_no_more_often_than_behind_a_wall(radius: float) -> None:
    """Two correlation times beside it, k = 2: at most the wall's chance, and not less than a quarter."""
    runs, sigma, k, tau = 4000, 3.0, 2.0, 10.0
    error = sigma * gauss_markov(np.random.default_rng(5).standard_normal((runs, 3, 200)), 0.1, tau)
    wall = float((error[:, 0] <= -k * sigma).any(-1).mean())
    error[:, 0] += radius + sigma * sigmas_beside(passage_margins(Inflation(k)), radius, sigma, sigma**2)
    achieved = float(((error**2).sum(1) <= radius**2).any(-1).mean())
    spread = 3.0 * math.sqrt(2.0 * wall / runs)
    assert wall > 0.1
    assert 0.25 * wall - spread <= achieved <= wall + spread


def test_a_budget_is_that_of_the_exact_margin() -> None:
    """With a risk for the mission table and exact margin are one law."""
    budget = RiskBudget(0.01, 4, 15.0, 10.0, 0.1)
    inflation = Inflation(budget.k, budget=budget)
    table, sigma, radius = passage_margins(inflation), 2.0, 1.5
    margin = np.empty((1, 1))
    exact_margins(
        np.array([[BALL]]), np.full((1, 1), radius), np.array([[[1.0, 0.0, 0.0]]]), 4.0 * np.eye(3)[None],
        inflation.k, margin, budget.risk_per_uav, 15.0, 10.0, 0.1,
    )  # fmt: skip
    assert sigma * sigmas_beside(table, radius, sigma, 4.0) == pytest.approx(margin[0, 0], abs=0.02)
    assert table.sigmas.max() <= table.k == inflation.k


def test_the_variance_across_is_that_of_the_conditional_law() -> None:
    """Volume over the standard deviation along a normal, whatever the normal."""
    root = np.random.default_rng(2).normal(size=(3, 3))
    covariance = root @ root.T
    normal = np.array([0.6, -0.8, 0.0])
    along = float(normal @ covariance @ normal)
    conditional = covariance - np.outer(covariance @ normal, covariance @ normal) / along
    across = np.linalg.svd(conditional, compute_uv=False)
    assert volume(covariance) / math.sqrt(along) == pytest.approx(math.sqrt(across[0] * across[1]))


SIGMA = 4.0
COVARIANCE = SIGMA**2 * np.eye(3)


@pytest.mark.parametrize(
    ("shape", "sigmas"),
    [
        (Sphere((20.0, 0.0, 0.0), 2.0), sigmas_beside(PASSAGE, 2.3, SIGMA, SIGMA**2)),
        (Cylinder((20.0, 0.0), 2.0), K),
        (Box((20.0, 0.0, 0.0), (4.0, 4.0, 4.0)), K),
    ],
    ids=["sphere", "cylinder", "box"],
)
def test_rows_keep_what_their_obstacle_asks_for(shape: Shape, sigmas: float) -> None:
    here = horizon((0.0, 0.0, 0.0), [Sphere((0.0, 80.0, 0.0), 1.0), shape], COVARIANCE)
    gaps = Gaps.of(here, Inflation(K), 1, 30.0, "passage")
    assert gaps.margin[0, 0, 0, 0] == pytest.approx(sigmas * SIGMA, abs=1e-12)
    assert gaps.shifted[0, 0, 0, 0] == pytest.approx(gaps.distance[0, 0, 0, 0] - sigmas * SIGMA, abs=1e-9)
    assert gaps.sigma[0, 0, 0, 0] == pytest.approx(SIGMA)


def test_every_run_reads_its_own_scene() -> None:
    """Balls of another size in each run; places of both runs in one call."""
    radii = np.array([[0.5], [3.0]])
    world = ObstacleSet.stack(
        [ObstacleSet.from_shapes([Sphere((20.0, 0.0, 0.0), float(radius))]) for radius in radii[:, 0]]
    )
    out = np.empty((4, 1))
    margins_beside(
        PASSAGE, world.solids, world.scene_start[:-1], 2, np.zeros((4, 1), dtype=np.int64),
        np.tile([-1.0, 0.0, 0.0], (4, 1, 1)), np.tile(COVARIANCE, (4, 1, 1)), 0.3, out,
    )  # fmt: skip
    want = [SIGMA * sigmas_beside(PASSAGE, r + 0.3, SIGMA, SIGMA**2) for r in (0.5, 0.5, 3.0, 3.0)]
    np.testing.assert_allclose(out[:, 0], want, rtol=1e-12)


@pytest.mark.parametrize("reading", ["directional", "largest", "rms"])
def test_it_goes_with_every_reading_of_sigma(reading: str) -> None:
    """A reading without direction takes the error for equal in all of them."""
    covariance = np.diag([1.0, 4.0, 9.0])
    here = horizon((0.0, 0.0, 0.0), [Sphere((12.0, 0.0, 0.0), 2.0)], covariance)
    inflation = Inflation(K, reading=reading)  # type: ignore[arg-type]
    gaps = Gaps.of(here, inflation, 1, 30.0, "passage")
    sigma = {"directional": 1.0, "largest": 3.0, "rms": math.sqrt(14.0 / 3.0)}[reading]
    across = 6.0 if reading == "directional" else sigma**2
    assert gaps.margin[0, 0, 0, 0] == pytest.approx(
        sigma * sigmas_beside(PASSAGE, 2.3, sigma, across), rel=1e-9
    )


def test_rows_meet_the_contract_of_constraints() -> None:
    check_constraint(ObstacleContact(Inflation(K), margin="passage"), sample_horizons())


def test_a_world_without_obstacles_asks_for_nothing() -> None:
    rows = ObstacleContact(Inflation(K), margin="passage").rows(horizon((0.0, 0.0, 0.0), [], COVARIANCE))
    assert rows.lower is not None
    assert (rows.lower == -np.inf).all()
