"""Clearance rows: the slack is the gap in metres, and the influence shell pulls as hard as NAPF."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from napf_mpc import apf
from napf_mpc.constraints.clearance import (
    Gaps,
    ObstacleContact,
    ObstacleInfluence,
    distance_of_force,
    influence_model,
)
from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows
from napf_mpc.constraints.contract import check_constraint, sample_horizon, sample_worlds
from napf_mpc.formation import PathFrame
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]


def problem(count: int = 1, radius_m: float = 0.0, **planner: Any) -> Problem:
    return Problem.model_validate(
        {
            "vehicle": {"radius_m": radius_m},
            "formation": {"shape": "line", "count": count},
            "mission": {"kind": "formation", "length_m": 100.0},
            "world": {"kind": "empty"},
            "planner": planner,
        }
    )


def hover_at(
    position: Array | tuple[float, float, float],
    world: ObstacleSet | list[Shape],
    *,
    sigma_m: float | tuple[float, float, float] = 0.5,
    step_s: float = 0.1,
    stages: int = 3,
    of: Problem | None = None,
) -> Horizon:
    """One UAV in one place, or in many runs if positions (run, 3) are given."""
    of = of or problem()
    places = np.atleast_2d(np.asarray(position, dtype=float))
    shape = (len(places), 1, stages)
    covariance = np.broadcast_to(np.diag(np.broadcast_to(np.square(sigma_m), 3)), (*shape, 3, 3)).copy()
    return Horizon(
        time_s=0.0,
        step_s=np.full(stages, step_s),
        position=np.broadcast_to(places[:, None, None], (*shape, 3)).copy(),
        velocity=np.zeros((*shape, 3)),
        covariance=covariance,
        common_factor=np.zeros((*shape[:2], 3, 1)),
        obstacles=ObstacleSet.from_shapes(world) if isinstance(world, list) else world,
        frame=PathFrame.from_angles((0.0, 0.0, 0.0), 0.0, 0.0),
        problem=of,
    )


def gap_m(rows: LinearRows, position: Array) -> Array:
    """How far positions (run, uav, N, 3) are inside the rows; +inf for rows switched off."""
    assert rows.lower is not None
    return rows.values(position) - rows.lower


EAST_SPHERE: list[Shape] = [Sphere((10.0, 0.0, 50.0), 2.0)]


@pytest.mark.parametrize("step_s", [0.02, 0.1, 1.0])
def test_the_gap_of_a_row_is_the_gap_in_metres(step_s: float) -> None:
    horizon = hover_at((5.0, 0.0, 50.0), EAST_SPHERE, step_s=step_s)
    rows = ObstacleContact(Inflation(3.0115)).rows(horizon)
    gap = gap_m(rows, horizon.position)
    assert gap[..., 0] == pytest.approx(5.0 - 2.0 - 3.0115 * 0.5, abs=1e-9)
    assert np.isinf(gap[..., 1:]).all()


@pytest.mark.parametrize("step_s", [0.02, 0.1, 1.0])
def test_the_slack_is_the_shortfall_in_metres(step_s: float) -> None:
    horizon = hover_at((7.5, 0.0, 50.0), EAST_SPHERE, step_s=step_s, of=problem(radius_m=0.3))
    rows = ObstacleContact(Inflation(3.0), extra_m=0.25).rows(horizon)
    # Surface at x = 8; 0.3 m of UAV, 1.5 m of margin and 0.25 m extra leave 1.55 m too little.
    assert rows.violation(horizon.position).max(-1) == pytest.approx(1.55, abs=1e-9)
    moved = horizon.position - np.array([1.55, 0.0, 0.0])
    assert rows.violation(moved).max() == pytest.approx(0.0, abs=1e-9)
    assert rows.shared_slack
    assert rows.slack_count == 1


@pytest.mark.parametrize(
    ("extra_sigmas", "kept"), [(None, 0.25), (0.4, 0.2), (0.5, 0.25), (2.0, 0.25), (0.0, 0.0)]
)
def test_the_extra_distance_is_metres_at_most_and_sigmas_up_to_there(
    extra_sigmas: float | None, kept: float
) -> None:
    """Sigma is 0.5 m, and what is kept on top of the margin does not depend on k."""
    horizon = hover_at((7.5, 0.0, 50.0), EAST_SPHERE, of=problem(radius_m=0.3))
    for k in (0.0, 1.0, 3.0):
        contact = ObstacleContact(Inflation(k), extra_m=0.25, extra_sigmas=extra_sigmas)
        rows = contact.rows(horizon)
        assert rows.violation(horizon.position).max(-1) == pytest.approx(
            max(0.3 + 0.5 * k + kept - 0.5, 0.0), abs=1e-9
        )
        assert contact.shortfall(horizon, horizon.position) == pytest.approx(
            max(0.3 + 0.5 * k + kept - 0.5, 0.0), abs=1e-9
        )
    with pytest.raises(ConstraintError, match="extra_sigmas = -1"):
        ObstacleContact(extra_sigmas=-1.0)
    for value in (math.nan, math.inf):
        with pytest.raises(ConstraintError, match=f"extra_sigmas = {value}"):
            ObstacleContact(extra_sigmas=value)
    for value in (math.nan, math.inf, -1.0):
        with pytest.raises(ConstraintError, match=f"extra_m = {value}"):
            ObstacleContact(extra_m=value)


WORLDS: dict[str, tuple[Shape, tuple[float, float, float], float, tuple[float, float, float]]] = {
    # obstacle, position, gap without margins [m], direction away from it
    "sphere": (Sphere((3.0, 4.0, 0.0), 1.0), (0.0, 0.0, 0.0), 4.0, (-0.6, -0.8, 0.0)),
    "cylinder": (Cylinder((0.0, 5.0), 2.0), (0.0, 0.0, 7.0), 3.0, (0.0, -1.0, 0.0)),
    "roof": (Cylinder((0.0, 0.0), 2.0, -5.0, 1.0), (0.5, 0.0, 3.0), 2.0, (0.0, 0.0, 1.0)),
    "box": (Box((6.0, 0.0, 0.0), (4.0, 2.0, 2.0)), (0.0, 0.5, 0.2), 4.0, (-1.0, 0.0, 0.0)),
    "box's edge": (Box((5.0, 6.0, 0.0), (4.0, 4.0, 2.0)), (0.0, 0.0, 0.0), 5.0, (-0.6, -0.8, 0.0)),
    "prism": (
        Prism((np.array([(2.0, -3.0), (8.0, -3.0), (8.0, 3.0), (2.0, 3.0)]),), -9.0, 9.0),
        (0.0, 0.0, 0.0),
        2.0,
        (-1.0, 0.0, 0.0),
    ),
    "inside a sphere": (Sphere((1.0, 0.0, 0.0), 3.0), (0.0, 0.0, 0.0), -2.0, (-1.0, 0.0, 0.0)),
    "at a sphere's centre": (Sphere((0.0, 0.0, 0.0), 3.0), (0.0, 0.0, 0.0), -3.0, (0.0, 0.0, 1.0)),
    "on a cylinder's axis": (Cylinder((0.0, 0.0), 2.0), (0.0, 0.0, 0.0), -2.0, (1.0, 0.0, 0.0)),
    "inside a box": (Box((0.0, 0.0, 0.0), (2.0, 4.0, 6.0)), (0.25, 0.0, 0.0), -0.75, (1.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("name", WORLDS)
def test_every_shape_gives_its_distance_its_direction_and_its_directional_margin(name: str) -> None:
    shape, position, gap, away = WORLDS[name]
    horizon = hover_at(position, [shape], sigma_m=(0.3, 0.2, 0.1), of=problem(radius_m=0.3))
    rows = ObstacleContact(Inflation(3.0)).rows(horizon)
    margin = 3.0 * np.sqrt(((np.array(away) * (0.3, 0.2, 0.1)) ** 2).sum())
    assert gap_m(rows, horizon.position)[..., 0] == pytest.approx(gap - 0.3 - margin, abs=1e-9)
    assert rows.jac[0, 0, :, 0] == pytest.approx(np.broadcast_to(away, (3, 3)), abs=1e-9)
    # A metre away along the normal is a metre more.
    assert gap_m(rows, horizon.position + np.array(away))[..., 0] == pytest.approx(
        gap - 0.3 - margin + 1.0, abs=1e-9
    )


def test_rows_that_are_kept_keep_clear_of_convex_obstacles_everywhere() -> None:
    rng = np.random.default_rng(3)
    horizon = sample_horizon(rng, sample_worlds()["all shapes"], runs=4, sigma_m=0.0)
    rows = ObstacleContact(obstacles=6, reach_m=1e3).rows(horizon)
    far = 20.0 * rng.normal(size=(400, *horizon.position.shape))
    outside = [
        (~rows.violation(at).any(-1), horizon.obstacles.signed_distance(at.reshape(4, -1, 3))) for at in far
    ]
    kept = np.stack([free.reshape(4, -1) for free, _ in outside])
    clearance = np.stack([distance for _, distance in outside])
    assert kept.sum() > 100
    assert (clearance[kept] >= horizon.problem.vehicle.radius_m - 1e-9).all()


def test_without_obstacles_every_row_is_off_and_every_slack_has_a_price() -> None:
    horizon = hover_at((0.0, 0.0, 0.0), ObstacleSet.empty())
    for constraint in (ObstacleContact(), ObstacleContact(margin="exact"), ObstacleInfluence()):
        rows = constraint.rows(horizon)
        rows.check(horizon.shape)
        assert rows.lower is not None
        assert (rows.lower == -np.inf).all()
        assert not rows.jac.any()
        assert rows.w1 is not None
        assert rows.w2 is not None
        assert (rows.w1 + rows.w2 > 0.0).all()


def test_obstacles_out_of_reach_are_off() -> None:
    horizon = hover_at((0.0, 0.0, 50.0), EAST_SPHERE, sigma_m=0.5)
    lower = {
        reach: ObstacleContact(Inflation(2.0), reach_m=reach).rows(horizon).lower for reach in (6.9, 7.1)
    }
    # 8 m to the surface less 1 m of margin.
    assert np.isinf(lower[6.9]).all()
    assert np.isfinite(lower[7.1][..., 0]).all()


def test_the_nearest_are_chosen_by_inflated_distance_and_keep_their_order() -> None:
    # Seen from the origin the second obstacle is farther off, but the error is large in its direction.
    world: list[Shape] = [Sphere((5.0, 0.0, 0.0), 1.0), Sphere((0.0, 6.0, 0.0), 1.0), Sphere((-9, 0, 0), 1.0)]
    horizon = hover_at((0.0, 0.0, 0.0), world, sigma_m=(0.1, 1.0, 0.1))
    inflation = Inflation(3.0)
    one = Gaps.of(horizon, inflation, 1, 50.0)
    assert one.shifted[0, 0, :, 0] == pytest.approx(5.0 - 3.0)
    two = Gaps.of(horizon, inflation, 2, 50.0)
    assert two.shifted[0, 0, 0] == pytest.approx([4.0 - 0.3, 2.0])
    assert two.distance[0, 0, 0] == pytest.approx([4.0, 5.0])


def random_states(count: int, mode: str, k: float) -> tuple[Horizon, Inflation]:
    rng = np.random.default_rng(11)
    of = problem(radius_m=0.3, influence_m=3.0, repulsive_gain=15.0, inflation=mode, k=k)
    horizon = hover_at(6.0 * rng.normal(size=(count, 3)), sample_worlds()["all shapes"], stages=1, of=of)
    root = 0.6 * rng.normal(size=(*horizon.shape, 3, 3))
    covariance = np.einsum("...ij,...kj->...ik", root, root)
    return replace(horizon, covariance=covariance), Inflation.of_planner(of.planner)


@pytest.mark.parametrize("mode", ["shift", "range"])
@pytest.mark.parametrize("per_speed", [1.0, 0.4])
def test_the_influence_rows_pull_with_napfs_force(mode: str, per_speed: float) -> None:
    """Minus the gradient of sum w2 s^2 / 2 by the position, on 1,000 random states, to 1e-9."""
    horizon, inflation = random_states(1000, mode, k=3.0)
    settings, radius = horizon.problem.planner, horizon.problem.vehicle.radius_m
    position = horizon.position[:, 0, 0]
    near = horizon.obstacles.near(position[:, None], np.inf)
    margin = inflation.margin(horizon.covariance[:, 0], near.gradient)
    rho, influence = inflation.apply(near.distance - radius, margin, settings.influence_m)
    force = apf.repulsive_force(
        rho, near.gradient, settings.repulsive_gain, influence, settings.min_distance_m
    )[:, 0]
    acting = (rho < influence).sum(-1)[:, 0]
    clamped = (rho < settings.min_distance_m).any(-1)[:, 0]
    assert (acting > 1).sum() > 100
    assert 50 < clamped.sum() < 900

    rows = ObstacleInfluence(obstacles=6, per_speed=per_speed).rows(horizon)
    rows.check(horizon.shape)
    assert rows.w1 is not None
    assert rows.w2 is not None
    assert not rows.w1.any()
    slack = rows.violation(horizon.position)
    pull = ((rows.w2 * slack)[..., None] * rows.jac).sum(-2)[:, 0, 0]
    scale = np.maximum(1.0, np.linalg.norm(force, axis=-1, keepdims=True))
    assert np.abs((pull - per_speed * force) / scale).max() < 1e-9

    def price(at: Array) -> Array:
        # The least cost of the slacks that a position needs: what the QP sees, priced by its own rows.
        assert rows.w2 is not None
        return 0.5 * (rows.w2 * rows.violation(at) ** 2).sum(-1)[:, 0, 0]

    step = 1e-4
    free = ~clamped
    for axis in range(3):
        aside = step * np.eye(3)[axis]
        slope = (price(horizon.position + aside) - price(horizon.position - aside)) / (2.0 * step)
        # Exact but for rounding where no row switches on within the step.
        assert -slope[free] == pytest.approx(per_speed * force[free, axis], rel=1e-4, abs=1e-3)


# ------------------------------------------------------------------ inside a margin, and how it is left


def moving(horizon: Horizon, *east_m: float) -> Horizon:
    """The same horizon with its plan at these places east, from now on."""
    position = horizon.position.copy()
    position[..., 0] = east_m
    return replace(horizon, position=position)


@pytest.mark.parametrize(("step_s", "asked_m"), [(0.1, [0.2, 0.4, 0.6]), (0.5, [1.0, 1.55, 1.55])])
def test_a_margin_is_left_at_the_opening_speed_and_no_farther_than_to_its_edge(
    step_s: float, asked_m: list[float]
) -> None:
    """1.55 m too little, as above; at 2 m/s a plan that stands lacks what it should have left by then."""
    horizon = hover_at((7.5, 0.0, 50.0), EAST_SPHERE, step_s=step_s, of=problem(radius_m=0.3))
    rows = ObstacleContact(Inflation(3.0), extra_m=0.25, opening_mps=2.0).rows(horizon)
    assert rows.violation(horizon.position).max(-1)[0, 0] == pytest.approx(asked_m, abs=1e-9)
    # A plan made linear on its way in or out is asked for the same places.
    for way in ((7.5, 7.0, 6.0), (7.5, 7.7, 7.9)):
        bent = moving(horizon, *way)
        rows = ObstacleContact(Inflation(3.0), extra_m=0.25, opening_mps=2.0).rows(bent)
        assert rows.violation(horizon.position).max(-1)[0, 0] == pytest.approx(asked_m, abs=1e-9)


def test_where_nothing_is_short_now_no_row_changes_however_the_plan_goes_on() -> None:
    horizon = moving(hover_at((5.0, 0.0, 50.0), EAST_SPHERE, of=problem(radius_m=0.3)), 5.0, 7.0, 9.0)
    at_once = ObstacleContact(Inflation(3.0), extra_m=0.25)
    bounded = replace(at_once, opening_mps=2.0)
    assert at_once.rows(horizon).violation(horizon.position).max() > 2.0
    for name in ("jac", "lower", "w1", "w2"):
        np.testing.assert_array_equal(
            getattr(bounded.rows(horizon), name), getattr(at_once.rows(replace(horizon)), name)
        )


def test_among_many_obstacles_only_the_rows_that_are_short_now_ask_for_less() -> None:
    drawn, inflation = random_states(300, "shift", k=3.0)
    repeated = {
        name: np.repeat(getattr(drawn, name), 3, axis=2) for name in ("position", "velocity", "covariance")
    }
    horizon = replace(drawn, step_s=np.full(3, 0.1), **repeated)
    gaps = Gaps.of(horizon, inflation, 4, 10.0)
    there = np.isfinite(gaps.shifted)
    at_once = ObstacleContact(inflation, extra_m=0.2).rows(horizon).lower
    bounded = ObstacleContact(inflation, extra_m=0.2, opening_mps=2.0).rows(horizon).lower
    assert at_once is not None
    assert bounded is not None
    short = there & (gaps.shifted < 0.2)
    assert 200 < short.sum() < there.sum() - 200
    np.testing.assert_array_equal(bounded[~short], at_once[~short])
    opened = 0.2 * np.arange(1.0, 4.0)[:, None]
    spared = np.where(short, np.maximum(0.2 - gaps.shifted - opened, 0.0), 0.0)
    np.testing.assert_allclose(at_once[short] - bounded[short], spared[short], atol=1e-9)


def test_the_shortfall_is_metres_inside_the_margin_and_not_the_slack() -> None:
    """A plan that leaves as fast as it is asked has no slack, and yet it is inside the margin."""
    horizon = hover_at((7.5, 0.0, 50.0), EAST_SPHERE, of=problem(radius_m=0.3))
    contact = ObstacleContact(Inflation(3.0), extra_m=0.25, opening_mps=2.0)
    plan = moving(horizon, 7.3, 7.1, 6.9).position
    assert contact.rows(horizon).violation(plan).max() == pytest.approx(0.0, abs=1e-9)
    assert contact.shortfall(horizon, plan) == pytest.approx(np.array([[1.35]]), abs=1e-9)
    for most_m, inside_m in ((5.95, 0.0), (6.5, 0.55)):
        plan = moving(horizon, 5.0, most_m, 5.9).position
        assert contact.shortfall(horizon, plan) == pytest.approx(inside_m, abs=1e-9)
    nothing = hover_at((7.5, 0.0, 50.0), ObstacleSet.empty())
    np.testing.assert_array_equal(contact.shortfall(nothing, nothing.position), 0.0)


@pytest.mark.parametrize("influence_m", [0.5, 3.0, 15.0, 40.0])
def test_the_distance_of_a_force_is_where_the_field_has_it(influence_m: float) -> None:
    ratio = np.geomspace(1e-9, 1e9, 37)
    for force in ratio:
        rho = distance_of_force(float(force), np.array([influence_m]))
        assert 0.0 < rho[0] < influence_m
        assert apf.repulsion(rho, 1.0, influence_m, 1e-9)[0] == pytest.approx(force, rel=1e-9)
    assert distance_of_force(0.0, np.array([influence_m]))[0] == pytest.approx(influence_m, rel=1e-12)


@pytest.mark.parametrize("mode", ["shift", "range"])
def test_napfs_pull_is_capped_and_below_the_cap_it_is_napfs(mode: str) -> None:
    horizon, _ = random_states(1000, mode, k=3.0)
    settings, most = horizon.problem.planner, 40.0
    constraint = ObstacleInfluence(obstacles=6, per_speed=0.4, most=most)
    rows = constraint.rows(horizon)
    gaps = constraint.gaps(horizon, settings.influence_m)
    force = 0.4 * apf.repulsion(
        gaps.shifted, settings.repulsive_gain, gaps.influence, settings.min_distance_m
    )
    assert rows.w2 is not None
    pull = rows.w2 * rows.violation(horizon.position)
    free, held = (force > 0.0) & (force < most), force > most
    assert free.sum() > 200
    assert held.sum() > 50
    np.testing.assert_allclose(pull[free], force[free], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(pull[held], most, rtol=1e-9)
    np.testing.assert_array_equal(pull[force == 0.0], 0.0)


def test_a_cap_above_what_napf_ever_pulls_changes_nothing() -> None:
    horizon, inflation = random_states(200, "shift", k=3.0)
    free = ObstacleInfluence(inflation, per_speed=0.01).rows(horizon)
    capped = ObstacleInfluence(inflation, per_speed=0.01, most=1e6).rows(horizon)
    for name in ("jac", "lower", "w2"):
        np.testing.assert_array_equal(getattr(capped, name), getattr(free, name))


def test_the_influence_is_the_force_and_its_slope_and_nothing_is_divided_by_zero() -> None:
    rho = np.array([-4.0, 0.0, 0.05, 0.1, 0.5, 2.999999, 3.0, 3.1, 50.0, np.inf])
    weight, target = influence_model(rho, 15.0, 3.0, 0.1)
    force = apf.repulsion(rho, 15.0, 3.0, 0.1)
    left = np.where(np.isfinite(rho), target - np.minimum(rho, target), 0.0)
    assert weight * left == pytest.approx(force, rel=1e-9, abs=1e-9)
    for at in (0.2, 0.5, 1.5, 2.9):
        slope = np.diff(apf.repulsion(at + np.array([-1e-5, 1e-5]), 15.0, 3.0, 0.1))[0] / 2e-5
        assert influence_model(np.array([at]), 15.0, 3.0, 0.1)[0][0] == pytest.approx(-slope, rel=1e-6)
    assert weight[6:] == pytest.approx(15.0 / 3.0**4)
    assert target[6:] == pytest.approx(3.0)
    at_floor, rest = influence_model(rho, 15.0, 3.0, 3.0)
    assert at_floor * (rest - np.minimum(rho, rest)) == pytest.approx(0.0, abs=1e-9, nan_ok=True)


def test_a_field_without_gain_switches_the_influence_off() -> None:
    horizon = hover_at((7.0, 0.0, 50.0), EAST_SPHERE, of=problem(repulsive_gain=0.0))
    rows = ObstacleInfluence().rows(horizon)
    rows.check(horizon.shape)
    assert rows.lower is not None
    assert (rows.lower == -np.inf).all()


def test_settings_come_from_the_problem_unless_given() -> None:
    horizon = hover_at((5.0, 0.0, 50.0), EAST_SPHERE, of=problem(k=1.5))
    assert gap_m(ObstacleContact().rows(horizon), horizon.position)[0, 0, 0, 0] == pytest.approx(3.0 - 0.75)
    fixed = ObstacleContact(Inflation(0.0)).rows(replace(horizon))
    assert gap_m(fixed, horizon.position)[0, 0, 0, 0] == pytest.approx(3.0)


def test_the_margin_grows_with_the_covariance_along_the_horizon() -> None:
    horizon = hover_at((5.0, 0.0, 50.0), EAST_SPHERE)
    grown = horizon.covariance * np.array([1.0, 4.0, 9.0])[:, None, None]
    rows = ObstacleContact(Inflation(2.0)).rows(replace(horizon, covariance=grown))
    assert gap_m(rows, horizon.position)[0, 0, :, 0] == pytest.approx([2.0, 1.0, 0.0])


@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
@pytest.mark.parametrize("radius", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("sigma", [(1.0, 1.0, 1.0), (1.5, 0.6, 1.0)])
def test_the_exact_margin_gives_the_chance_that_was_asked(
    shape: str, radius: float, sigma: tuple[float, float, float]
) -> None:
    """Errors drawn about a UAV on the row's bound; asked 5 % and 1 % one-sided."""
    solid: Shape = Sphere((0.0, 0.0, 0.0), radius) if shape == "sphere" else Cylinder((0.0, 0.0), radius)
    away = np.array([0.6, 0.8, 0.0])
    horizon = hover_at((radius + 4.0) * away, [solid], sigma_m=sigma, stages=1)
    draws = 200_000
    errors = np.random.default_rng(5).normal(size=(draws, 3)) * sigma
    # An error towards the obstacle comes with one along the row's plane: the riskiest place on the plane is
    # aside by as much the other way.
    towards = np.square(sigma) * away
    aside = towards / (towards @ away) - away
    for asked in (0.05, 0.01):
        inflation = Inflation(float(stats.norm.isf(asked)))
        rows = ObstacleContact(inflation, margin="exact").rows(replace(horizon))
        gap = float(gap_m(rows, horizon.position)[0, 0, 0, 0])
        wall = float(gap_m(ObstacleContact(inflation).rows(replace(horizon)), horizon.position)[0, 0, 0, 0])
        assert wall < gap <= 4.0
        edge = horizon.position[0, 0, 0] - gap * away
        hits = max(
            int((horizon.obstacles.signed_distance((edge + shift * aside + errors)[None])[0] < 0.0).sum())
            for shift in (np.linspace(0.0, 4.0, 9) if aside.any() else (0.0,))
        )
        low, high = stats.beta.ppf([0.0005, 0.9995], [hits, hits + 1], [draws - hits + 1, draws - hits])
        assert low <= asked
        assert high / asked > 0.3
        if len(set(sigma)) == 1 and gap < 4.0:
            assert low <= asked <= high


def test_the_half_space_is_exact_for_a_flat_wall_and_careful_for_a_ball() -> None:
    draws = 400_000
    errors = np.random.default_rng(6).normal(size=(draws, 3))
    away = np.array([-1.0, 0.0, 0.0])
    solids: dict[str, Shape] = {
        "wall": Box((50.0, 0.0, 0.0), (100.0, 1e3, 1e3)),
        "ball": Sphere((1.0, 0.0, 0.0), 1.0),
    }
    achieved = {}
    for name, solid in solids.items():
        horizon = hover_at((-5.0, 0.0, 0.0), [solid], sigma_m=1.0, stages=1)
        rows = ObstacleContact(Inflation(float(stats.norm.isf(0.02)))).rows(horizon)
        edge = horizon.position[0, 0, 0] - gap_m(rows, horizon.position)[0, 0, 0, 0] * away
        achieved[name] = (horizon.obstacles.signed_distance((edge + errors)[None])[0] < 0.0).mean()
    assert achieved["wall"] == pytest.approx(0.02, abs=0.001)
    assert achieved["ball"] < 0.3 * 0.02


def test_walls_and_roofs_have_the_margin_of_a_wall() -> None:
    for solid, position in (
        (Box((6.0, 0.0, 0.0), (4.0, 2.0, 2.0)), (0.0, 0.0, 0.0)),
        (Cylinder((0.0, 0.0), 2.0, -5.0, 1.0), (0.5, 0.0, 6.0)),
    ):
        gaps = [
            gap_m(ObstacleContact(Inflation(3.0), margin=margin).rows(horizon), horizon.position)
            for margin in ("half_space", "exact")
            for horizon in [hover_at(position, [solid])]
        ]
        assert gaps[0] == pytest.approx(gaps[1], abs=1e-12)


@pytest.mark.parametrize(
    "constraint",
    [
        ObstacleContact(),
        ObstacleContact(Inflation(3.0, "range"), obstacles=2),
        ObstacleContact(Inflation(3.0, reading="largest")),
        ObstacleContact(margin="exact"),
        ObstacleContact(extra_m=0.2, opening_mps=2.0),
        ObstacleContact(extra_m=0.2, extra_sigmas=0.3),
        ObstacleInfluence(),
        ObstacleInfluence(most=5.0),
        ObstacleInfluence(Inflation(1.0, reading="rms"), obstacles=8),
        ObstacleInfluence(margin="exact"),
    ],
    ids=lambda constraint: f"{constraint.name} {constraint.margin} {constraint.obstacles}",
)
def test_contract(constraint: ObstacleContact | ObstacleInfluence) -> None:
    check_constraint(constraint)


def test_scenes_go_with_their_runs() -> None:
    scenes: list[list[Shape]] = [
        [Box((0.0, 30.0, 50.0), (1.0, 1.0, 1.0)), Cylinder((9.0, 0.0), 1.0)],
        [],
        EAST_SPHERE,
        [Sphere((5.0, 8.0, 50.0), 5.0)],
    ]
    worlds = ObstacleSet.stack([ObstacleSet.from_shapes(scene) for scene in scenes])
    horizon = hover_at(np.broadcast_to([5.0, 0.0, 50.0], (4, 3)), worlds)
    gap = gap_m(ObstacleContact(Inflation(0.0)).rows(horizon), horizon.position)[:, 0, 0, 0]
    assert gap == pytest.approx([3.0, np.inf, 3.0, 3.0])
    check_constraint(ObstacleContact(Inflation(3.0)), [horizon])
    check_constraint(ObstacleContact(Inflation(3.0), margin="exact"), [horizon])


def test_a_wide_field_reaches_beyond_the_contact_rows() -> None:
    wide = problem(influence_m=40.0, k=1.0)
    horizon = hover_at((0.0, 0.0, 50.0), [Sphere((30.0, 0.0, 50.0), 2.0)], of=wide)
    rows = ObstacleInfluence(reach_m=5.0).rows(horizon)
    assert rows.violation(horizon.position)[0, 0, 0, 0] == pytest.approx(
        27.5 * (1.0 - 27.5 / 40.0) / (3.0 - 55.0 / 40.0)  # force over slope
    )


@pytest.mark.parametrize(
    "settings",
    [{"obstacles": 0}, {"reach_m": 0.0}, {"reach_m": np.nan}, {"margin": "guess"}],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConstraintError, match=next(iter(settings))):
        ObstacleContact(**settings)
    with pytest.raises(ConstraintError, match="per_speed"):
        ObstacleInfluence(per_speed=np.nan)
    for speed in (0.0, -1.0, np.nan):
        with pytest.raises(ConstraintError, match="opening_mps"):
            ObstacleContact(opening_mps=speed)
    for most in (0.0, -1.0, np.nan):
        with pytest.raises(ConstraintError, match="most"):
            ObstacleInfluence(most=most)


def test_the_exact_margin_does_not_go_with_a_sigma_without_direction() -> None:
    horizon = hover_at((5.0, 0.0, 50.0), EAST_SPHERE)
    with pytest.raises(ConstraintError, match="rms"):
        ObstacleContact(Inflation(3.0, reading="rms"), margin="exact").rows(horizon)
