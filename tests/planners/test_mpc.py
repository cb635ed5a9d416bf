"""The QP planner keeps what it is asked to; whatever its solver does, what flies is sound and counted."""

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from napf_mpc.block import simulate
from napf_mpc.constraints.clearance import ObstacleContact, ObstacleInfluence
from napf_mpc.constraints.constraint import ConstraintError, Horizon, LinearRows
from napf_mpc.constraints.limits import AltitudeBand, TiltLimit
from napf_mpc.constraints.neighbours import NeighbourSeparation
from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.planners.guide_clearance import sphere_sigmas
from napf_mpc.planners.mpc import (
    CONTACT_PRICE,
    FAST_CONTACT_PRICE,
    FAST_RAW_CONTACT_PRICE,
    QpPlanner,
    contact_price,
    default_constraints,
)
from napf_mpc.planners.plan import standing_plan
from napf_mpc.planners.planner import Command, Reason
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.qp import HorizonQp
from napf_mpc.solvers.batch import STATUSES, BatchResult, BatchSolver, WarmStart, make_batch_solver
from napf_mpc.solvers.kernel import KernelSolver
from napf_mpc.solvers.solver import SolverError
from napf_mpc.vehicle.quadrotor import mixer_inverse, rotor_limit
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Sphere

SHORT = {"mission": {"length_m": 12.0}, "simulation": {"time_limit_s": 12.0}}


def problem(**changes: object) -> Problem:
    settings = {"planner": {"kind": "qp"}} | SHORT
    return load_problem("study_8s", settings | changes)


def nav(
    position: np.ndarray, velocity: np.ndarray | None = None, sigma_m: float = 0.3, time_s: float = 0.0
) -> NavSolution:
    shape = position.shape[:2]
    covariance = np.zeros((*shape, 6, 6))
    covariance[..., :3, :3] = sigma_m**2 * np.eye(3)
    return NavSolution(
        time_s=time_s,
        available=np.ones(shape, dtype=bool),
        position=position,
        velocity=np.zeros_like(position) if velocity is None else velocity,
        attitude=np.zeros((*shape, 3)),
        body_rates=np.zeros((*shape, 3)),
        covariance=covariance,
        common_factor=np.zeros((*shape, 3, 1)),
    )


def on_slots(planner: QpPlanner, along_m: float = 0.0) -> np.ndarray:
    return (
        planner._lanes + planner._slots.offsets[:, :1] * planner._frame.along + along_m * planner._frame.along
    )[None]


def cruising(planner: QpPlanner) -> np.ndarray:
    return np.broadcast_to(2.0 * planner._frame.along, (1, 4, 3)).copy()


def wall_beside(planner: QpPlanner, gap_m: float) -> tuple[float, int]:
    """Give a planner a long wall so far left of the left-most slot: its face [m], and the UAV there."""
    slots = on_slots(planner)
    at = int(slots[0, :, 1].argmax())
    face = float(slots[0, at, 1]) + gap_m
    wall = Box((50.0, face + 1.0, 0.0), (200.0, 2.0, 50.0), 0.0)
    planner.reset(ObstacleSet.from_shapes([wall]), 1)
    return face, at


def followed(solution: NavSolution, command: Command, time_s: float) -> NavSolution:
    """Where the plans say that UAVs are at a time."""
    assert command.plan is not None
    state, _ = command.plan.at(time_s)
    return replace(
        solution, time_s=time_s, position=state[..., 0:6:2], velocity=state[..., 1:6:2],
        attitude=state[..., 6:12:2], body_rates=state[..., 7:12:2],
    )  # fmt: skip


# ------------------------------------------------------------------------------------------ what it plans


def test_on_the_slots_in_free_air_the_plan_is_to_fly_straight_on_with_hover_thrust() -> None:
    planner = QpPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    command = planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
    assert command.plan is not None
    times = np.cumsum(command.plan.step_s)
    straight = on_slots(planner)[:, :, None] + 2.0 * times[:, None] * planner._frame.along
    np.testing.assert_allclose(command.plan.states[..., 0:6:2], straight, atol=1e-3)
    np.testing.assert_allclose(command.plan.inputs, 0.0, atol=1e-3)
    assert not command.holding.any()


@pytest.mark.parametrize("times", [0.5, 8.0])
def test_a_heavier_vehicle_with_the_thrust_for_it_plans_the_same_way(times: float) -> None:
    """Mass and inertia in one ratio: the same accelerations cost the same, but for weights that are given."""

    def planned(times: float, **weights: float) -> np.ndarray:
        inertia = tuple(times * moment for moment in (8.1e-3, 8.1e-3, 14.2e-3))
        vehicle = {"radius_m": 0.3, "mass_kg": times, "inertia_kgm2": inertia, "arm_m": 0.24 * times}
        planner = QpPlanner(problem(vehicle=vehicle, planner=weights))
        planner.reset(ObstacleSet.from_shapes([Sphere((20.0, 3.0, 0.0), 2.0)]), 1)
        states = on_slots(planner)
        states[..., :3] += np.array([0.0, 1.0, -1.0])
        plan = planner.step(nav(states), 0.0).plan
        assert plan is not None
        return plan.states

    usual = planned(1.0)
    np.testing.assert_allclose(planned(times), usual, atol=1e-5)
    given = planned(times, thrust_weight=60.0, torque_weight=600.0)
    assert np.abs(given - usual).max() > 0.05


def test_a_plan_keeps_k_sigma_and_its_radius_clear_of_a_wall_beside_the_lane() -> None:
    asked = problem(planner={"kind": "qp", "influence_scale": 1e-6, "guidance": "none", "cohesion": 0.0})
    planner = QpPlanner(asked)
    slots = on_slots(planner)
    # The face is 0.7 m inside the margin of 3 * 0.3 + 0.3 m and what is kept on top of it.
    face, at = wall_beside(planner, 0.7)
    solution = nav(slots, cruising(planner))
    for tick in range(80):
        solution = followed(solution, planner.step(solution, 0.1 * tick), 0.1 * (tick + 1))
    position = solution.position
    kept = 0.3 + (3.0 + asked.planner.contact_extra_sigmas) * 0.3
    assert face - position[0, at, 1] == pytest.approx(kept, abs=0.02)
    others = [uav for uav in range(4) if uav != at]
    np.testing.assert_allclose(position[0, others, 1], slots[0, others, 1], atol=0.35)


def test_what_is_reported_as_slack_is_how_far_the_plan_is_inside_a_margin() -> None:
    """Deep inside, where the rows ask for less than the margin: in metres, from the plan and the wall."""
    planner = QpPlanner(problem(), guided=False)
    face, at = wall_beside(planner, 0.4)
    command = planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
    assert command.plan is not None
    assert command.slack_m is not None
    kept = 0.3 + (3.0 + planner.problem.planner.contact_extra_sigmas) * 0.3
    inside = kept - (face - command.plan.states[0, :, :, 2])
    assert 0.9 < inside[at].max() < kept - 0.4
    np.testing.assert_allclose(command.slack_m[0], np.maximum(inside.max(-1), 0.0), atol=1e-9)
    assert planner.tally.largest_slack_m[0] == command.slack_m[0, at]


def test_the_repulsion_never_outbids_the_margin_it_is_for() -> None:
    """Deep inside, the force law of a wide scene would pull far harder than a metre of margin is worth."""
    wide = {"kind": "qp", "influence_m": 15.0, "repulsive_gain": 5600.0}
    planner = QpPlanner(problem(planner=wide), guided=False)
    _, at = wall_beside(planner, 0.4)
    planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
    horizon = planner._last_horizon
    assert horizon is not None
    (influence,) = (each for each in planner.constraints if isinstance(each, ObstacleInfluence))
    rows = influence.rows(horizon)
    assert rows.w2 is not None
    pull = (rows.w2 * rows.violation(horizon.position)).max(axis=(0, 2, 3))
    assert pull[at] == pytest.approx(0.5 * CONTACT_PRICE)
    free = replace(influence, most=np.inf).rows(horizon)
    assert free.w2 is not None
    assert (free.w2 * free.violation(horizon.position)).max() > 10.0 * pull[at]


@pytest.mark.parametrize(
    ("speed_mps", "asked", "price", "tilt"),
    [
        (2.0, {}, CONTACT_PRICE, False),
        (4.0, {}, CONTACT_PRICE, False),
        (4.5, {}, FAST_RAW_CONTACT_PRICE, True),
        (2.0, {"contact_price": 70.0, "tilt_thrust": True}, 70.0, True),
        (6.0, {"contact_price": 70.0, "tilt_thrust": False}, 70.0, False),
    ],
)
def test_fast_formations_have_firmer_margins_and_thrust_for_tilt_unless_asked_otherwise(
    speed_mps: float, asked: dict[str, Any], price: float, tilt: bool
) -> None:
    mission = {"kind": "formation", "length_m": 80.0, "speed_mps": speed_mps}
    planner = QpPlanner(problem(mission=mission, planner={"kind": "qp"} | asked), guided=False)
    planner.reset(ObstacleSet.empty(), 1)
    contact, apart = (
        next(each for each in planner.constraints if isinstance(each, kind))
        for kind in (ObstacleContact, NeighbourSeparation)
    )
    assert contact.w1 == apart.w1 == price
    command = planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
    assert command.tilt_thrust == tilt
    filtered = problem(mission=mission, planner={"kind": "qp"} | asked, navigation={"filter": "kalman"})
    assert contact_price(filtered) == (FAST_CONTACT_PRICE if price == FAST_RAW_CONTACT_PRICE else price)


@pytest.mark.parametrize(
    ("navigation", "planner", "sigma_m", "price"),
    [
        ("kalman", {}, 0.6, CONTACT_PRICE),
        ("kalman", {}, 0.05, FAST_CONTACT_PRICE),
        ("kalman", {}, 0.65 / 3.0, 8.0 * CONTACT_PRICE),
        ("none", {}, 0.05, FAST_RAW_CONTACT_PRICE),
        ("kalman", {"contact_price": 70.0}, 0.05, 70.0),
        ("kalman", {"inflation": "range"}, 0.6, FAST_CONTACT_PRICE),
    ],
)
def test_margins_of_centimetres_have_a_firm_price_at_any_speed(
    navigation: str, planner: dict[str, Any], sigma_m: float, price: float
) -> None:
    """A corner is cut by decimetres, whatever the margin is. The wall is 2 m beside one UAV."""
    made = QpPlanner(
        problem(planner={"kind": "qp", "k": 3.0} | planner, navigation={"filter": navigation}), guided=False
    )
    wall_beside(made, 2.0)
    contact = next(each for each in made.constraints if isinstance(each, ObstacleContact))
    seen: list[np.ndarray] = []
    rows_of = ObstacleContact.rows

    def rows(self: ObstacleContact, horizon: Horizon) -> LinearRows:
        made_rows = rows_of(self, horizon)
        assert made_rows.w1 is not None
        seen.append(np.where(np.isfinite(made_rows.lower).any(-1, keepdims=True), made_rows.w1, np.nan))
        return made_rows

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ObstacleContact, "rows", rows)
        made.step(nav(on_slots(made), cruising(made), sigma_m=sigma_m), 0.0)
    assert contact.w1 == min(price, CONTACT_PRICE)
    assert np.nanmax(seen[0]) == pytest.approx(price)


@pytest.mark.parametrize(("speed_mps", "deep_m"), [(2.0, 0.2), (4.0, 0.2), (4.0, 4.0), (8.0, 0.2)])
def test_with_errors_of_centimetres_a_wall_is_gone_round(speed_mps: float, deep_m: float) -> None:
    """From 8 m left to 16 m right: its ends were cut, and its middle was flown through or held before."""
    wall = {"shape": "box", "centre_m": (51.0, -4.0, 10.0), "size_m": (deep_m, 24.0, 60.0)}
    start = (0.0, 0.0, 10.0)
    mission = {"kind": "formation", "length_m": 110.0, "speed_mps": speed_mps, "start_m": start}
    given = {
        "formation": {"shape": "square"},
        "mission": mission,
        "world": {"kind": "list", "obstacles": (wall,)},
        "navigation": {"kind": "gauss_markov", "filter": "kalman", "sigma_min_m": 0.02, "sigma_max_m": 0.02},
    }
    flown = simulate(Problem.model_validate(given), "qp", seed=7710, runs=4)
    assert flown.score.finished.all()
    # The way round its far end is steep: one in a hundred still hits.
    assert flown.score.obstacle_contact.any(axis=1).sum() <= 1
    assert not flown.score.uav_contact.any()


@pytest.mark.parametrize("run", [4, 10])
def test_with_errors_of_centimetres_spheres_are_passed_without_giving_up(run: int) -> None:
    """Ways smoothed beside a small sphere lack decimetres of what they want: no reason to wait for ever."""
    errors = {"navigation.sigma_min_m": 0.02, "navigation.sigma_max_m": 0.06}
    flown = simulate(load_problem("study_40s", errors), "qp", seed=41, runs=range(run, run + 1))
    assert flown.score.finished.all()
    assert not flown.score.obstacle_contact.any()
    assert flown.score.metrics["min_clearance_m"].min() > 0.1


def test_a_sigma_of_tens_of_metres_makes_no_lunge() -> None:
    """A wall 5 m beside, and a margin that has grown to 60 m: it is left within the limits."""
    planner = QpPlanner(problem(planner={"kind": "qp", "leaving_mps": 2.0}), guided=False)
    _, at = wall_beside(planner, 5.0)
    command = planner.step(nav(on_slots(planner), cruising(planner), sigma_m=20.0), 0.0)
    assert command.plan is not None
    states = command.plan.states[0]
    assert states[at, -1, 2] < states[at, 0, 2] - 3.0  # away from the wall
    assert np.abs(states[..., 3]).max() < 3.0 + 1e-2
    assert np.abs(states[..., 6:10:2]).max() < math.radians(30.0) + 1e-3


@pytest.mark.parametrize(
    ("settings", "navigation", "speed_mps"),
    [
        ({}, "none", 0.3),
        ({}, "kalman", 2.0),
        ({"leaving_mps": 0.8}, "none", 0.8),
        ({"leaving_mps": 0.8}, "kalman", 0.8),
    ],
)
def test_a_margin_is_left_slowly_on_measurements_and_faster_on_estimates(
    settings: dict[str, float], navigation: str, speed_mps: float
) -> None:
    """The rows of a UAV that is 0.8 m inside the margin of a wall: where they let it be at each stage."""
    asked = problem(planner={"kind": "qp"} | settings, navigation={"filter": navigation})
    planner = QpPlanner(asked, guided=False)
    face, at = wall_beside(planner, 0.7)
    planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
    (contact,) = (each for each in planner.constraints if isinstance(each, ObstacleContact))
    horizon = planner._last_horizon
    assert horizon is not None
    rows = contact.rows(horizon)
    wall = int(np.argmax(rows.jac[0, at, 0, :, 1] < -0.99))
    lateral = -rows.lower[0, at, :, wall]  # -y >= lower
    whole = face - 0.3 - (3.0 + asked.planner.contact_extra_sigmas) * 0.3
    now = face - 0.7
    allowed = np.maximum(whole, now - speed_mps * horizon.times_s)
    np.testing.assert_allclose(lateral, allowed, atol=1e-9)


@pytest.mark.parametrize(("heading_deg", "axis"), [(0.0, 0), (90.0, 1), (30.0, None)])
def test_a_large_east_sigma_leaves_the_height_believed(heading_deg: float, axis: int | None) -> None:
    """Along, left and up of the path; a filter's estimate is believed but for what it will correct."""
    free = {"initial_positions_m": None, "initial_velocities_mps": None}
    planner = QpPlanner(problem(mission=SHORT["mission"] | free | {"heading_deg": heading_deg}), guided=False)
    planner.reset(ObstacleSet.empty(), 1)
    low = on_slots(planner) - np.array([0.0, 0.0, 1.0])
    solution = nav(low)
    covariance = solution.covariance.copy()
    covariance[..., :3, :3] = np.diag([10.0**2, 0.2**2, 0.1**2])
    solution = replace(solution, covariance=covariance)
    everybody = solution.trusted()
    sigma = planner._to_be_corrected(solution, everybody, planner._covariance(solution, everybody))
    assert sigma.shape == (1, 4, 3)
    if axis is None:
        turn = math.radians(heading_deg)
        wanted = [
            math.hypot(10.0 * math.cos(turn), 0.2 * math.sin(turn)),
            math.hypot(10.0 * math.sin(turn), 0.2 * math.cos(turn)),
            0.1,
        ]
    else:
        wanted = [0.2, 0.2, 0.1]
        wanted[axis] = 10.0
    np.testing.assert_allclose(sigma, np.broadcast_to(wanted, (1, 4, 3)), rtol=1e-9)
    estimate = replace(solution, filtered=True)
    covariance = planner._covariance(estimate, everybody)
    np.testing.assert_array_equal(planner._to_be_corrected(estimate, everybody, covariance), 0.0)
    # Three quarters of the variance, and so sqrt(3)/2 of sigma, are gone at the end of the horizon.
    covariance[:, :, -1] *= 0.25
    half = planner._to_be_corrected(estimate, everybody, covariance)
    np.testing.assert_allclose(half, math.sqrt(0.75) * sigma, rtol=1e-9)
    covariance[:, :, -1] *= 16.0
    np.testing.assert_array_equal(planner._to_be_corrected(estimate, everybody, covariance), 0.0)
    nobody = np.zeros_like(everybody)
    np.testing.assert_array_equal(planner._to_be_corrected(solution, nobody, covariance), 0.0)
    # Of the missing metre of height all but a hundredth is asked for, and so it is climbed.
    climbed = planner.build(solution, 0.0).reference[..., 4]
    np.testing.assert_allclose(climbed, 1.0 / 1.01, rtol=1e-9)
    climbed = planner.build(replace(solution, filtered=True), 0.0).reference[..., 4]
    np.testing.assert_allclose(climbed, 1.0, rtol=1e-9)


# ------------------------------------------------------------------------------------------ height band


def over_a_wall(altitude_m: list[float] | None) -> np.ndarray:
    """Heights every 0.1 s of one UAV without errors whose lane leads 0.5 m above the top of a wall [m]."""
    given = {
        "formation": {"shape": "line", "count": 1},
        "mission": {"kind": "formation", "length_m": 24.0},
        "world": {
            "kind": "list",
            "obstacles": [{"shape": "box", "centre_m": [12.0, 0.0, -10.5], "size_m": [2.0, 60.0, 20.0]}],
        },
        "navigation": {
            "kind": "gauss_markov", "error_scale": 0.0, "sigma_min_m": 0.2, "sigma_max_m": 0.3,
        },
        "simulation": {"time_limit_s": 20.0},
        "planner": {"kind": "qp", "guidance": "none", "contact_extra_m": 0.2, "altitude_m": altitude_m},
    }  # fmt: skip
    missions = simulate(Problem.model_validate_json(json.dumps(given)), "qp", seed=1, runs=1, record_every=5)
    assert missions.score.finished.all()
    assert not missions.score.obstacle_contact.any()
    return np.asarray(missions.trajectories["z_m"])


def test_a_height_band_is_kept_in_flight() -> None:
    assert over_a_wall(None).max() > 0.8  # its margin lifts it so far
    low = over_a_wall([-5.0, 0.6])
    assert 0.5 < low.max() < 0.6 + 0.01


def test_a_height_band_is_rows_of_the_program_and_none_by_default() -> None:
    def bands(asked: Problem) -> list[tuple[float, float]]:
        made = default_constraints(asked)
        return [(each.min_m, each.max_m) for each in made if isinstance(each, AltitudeBand)]

    assert bands(problem()) == []
    assert bands(problem(planner={"kind": "qp", "altitude_m": (-2.0, 3.5)})) == [(-2.0, 3.5)]


@pytest.mark.parametrize(("margin", "share"), [("half_space", 1.0), ("passage", 0.79)])
def test_rows_and_guidance_keep_the_margin_that_the_problem_asks_for(margin: str, share: float) -> None:
    """A ball of 2 m and an error of 5 m: four fifths of a wall's margin for the one, all for the other."""
    asked = problem(planner={"kind": "qp", "k": 3.0, "margin": margin, "contact_extra_m": 0.0})
    made = default_constraints(asked)
    shells = [each for each in made if isinstance(each, (ObstacleContact, ObstacleInfluence))]
    assert [shell.margin for shell in shells] == [margin, margin]
    planner = QpPlanner(asked)
    planner.reset(ObstacleSet.from_shapes([Sphere((30.0, 3.0, 0.0), 2.0)]), 1)
    planner.step(nav(on_slots(planner), sigma_m=5.0), 0.0)
    assert planner._last_horizon is not None
    gaps = shells[0].gaps(planner._last_horizon)
    assert np.median(gaps.margin[np.isfinite(gaps.distance)]) == pytest.approx(15.0 * share, abs=0.3)
    assert planner._guidance is not None
    sigmas = sphere_sigmas(planner._guidance._search.margins, 2.3, 25.0 * np.eye(3))
    assert 5.0 * sigmas == pytest.approx(15.0 * share, abs=0.3)


# ------------------------------------------------------------------------------------ plans that stand


def test_a_plan_that_stands_though_its_guide_leads_on_is_taken_from_the_guide() -> None:
    planner = QpPlanner(problem(mission={"length_m": 60.0}))
    planner.reset(ObstacleSet.empty(), 1)
    slots = on_slots(planner)
    state = planner._state(nav(slots), np.ones((1, 4), dtype=bool))
    leads = planner._slots.over(slots, planner._model.times_s)
    ahead = leads[0, 0, -1, 0] - slots[0, 0, 0]
    assert ahead == pytest.approx(2.0 * planner._model.times_s[-1])  # some 13 m

    def guess(reference: np.ndarray, planned_m: float) -> np.ndarray:
        """Places of the guess of the first UAV, where its last plan went so far and the others' stood."""
        plan = standing_plan(
            planner.problem.vehicle, planner._yaw, 0.0, planner._model.step_s, state[..., 0:6:2]
        )
        plan.states[0, 0, :, 0] += planned_m * planner._model.times_s / planner._model.times_s[-1]
        planner._plan = plan
        return planner._guess(state, reference, planner._carried(state, 0.0), 0.0)[0][..., 0:6:2]

    np.testing.assert_array_equal(guess(leads, 0.0), leads[..., 0:6:2])
    # One that gets along by itself is left alone, and so are all where the guide holds as well.
    going = guess(leads, 0.35 * ahead)
    assert going[0, 0, -1, 0] - slots[0, 0, 0] == pytest.approx(0.35 * ahead)
    np.testing.assert_array_equal(going[0, 1:], leads[0, 1:, :, 0:6:2])
    holds = planner._slots.over(slots, planner._model.times_s)
    holds[..., 0:6:2] = slots[:, :, None] + np.array([1.9, 0.0, 0.0])
    np.testing.assert_allclose(
        guess(holds, 0.0), np.broadcast_to(slots[:, :, None], (1, 4, planner._model.stages, 3)), atol=1e-12
    )
    planner._guidance = None
    np.testing.assert_allclose(
        guess(leads, 0.0), np.broadcast_to(slots[:, :, None], (1, 4, planner._model.stages, 3)), atol=1e-12
    )


def test_rows_are_not_made_at_a_plan_that_leads_through_a_wall() -> None:
    """The first UAV's plan has been pressed through: its rows speak of its near side, all of them."""
    planner = QpPlanner(problem(mission={"length_m": 60.0}), guided=False)
    slots = on_slots(planner)
    face = float(slots[0, 0, 0]) + 4.0
    planner.reset(ObstacleSet.from_shapes([Box((face + 0.25, 3.0, 0.0), (0.5, 3.0, 50.0), 0.0)]), 1)
    plan = standing_plan(planner.problem.vehicle, planner._yaw, 0.0, planner._model.step_s, slots)
    plan.states[0, 0, :, 0] += 2.0 * planner._model.times_s
    planner._plan = plan
    planner.step(nav(slots), 0.0)
    horizon = planner._last_horizon
    assert horizon is not None
    assert face - 1.5 < horizon.position[0, 0, :, 0].max() < face
    normal = planner.constraints[0].rows(horizon).jac[0, 0, :, 0]
    near = np.linalg.norm(normal, axis=-1) > 0.0
    assert near.any()
    assert (normal[near, 0] < 0.0).all()


def test_a_filtered_estimate_follows_the_taut_way_and_raw_measurements_the_guide_itself() -> None:
    planner = QpPlanner(problem(mission={"length_m": 60.0}))
    planner.reset(ObstacleSet.empty(), 1)
    slots = on_slots(planner)
    offset = np.full((1, 4, 49, 2), 2.0)
    guide = Guide(
        np.arange(49.0), offset, np.ones((1, 4)), np.full((1, 4), Passage.DETOUR, dtype=np.int8),
        np.zeros((1, 4)), 0.25 * offset, np.zeros((1, 4, 49)),
    )  # fmt: skip
    raw = nav(slots, sigma_m=0.0)
    everybody, asked = raw.trusted(), []
    for solution in (raw, replace(raw, filtered=True)):

        def step(
            *_: object,
            taut: bool,
            flying: np.ndarray,
            sigma_map: object,
            measured: bool,
            shown: Guide = guide,
        ) -> Guide:
            assert flying.all()
            assert sigma_map is None
            asked.append((taut, measured))
            return shown if taut else replace(shown, taut=None, loose=None)

        assert planner._guidance is not None
        planner._guidance.step = step  # type: ignore[method-assign, assignment]
        planner.step(solution, 0.0)
    assert asked == [(False, True), (True, False)]
    for given, expected in ((replace(guide, taut=None, loose=None), 2.0), (guide, 0.5)):
        state = planner._state(raw, everybody)
        covariance = planner._covariance(raw, everybody)
        reference, way = planner._references(state, None, raw, covariance, everybody, given)
        np.testing.assert_allclose(reference[0, :, :, 2] - slots[0, :, None, 1], expected, atol=1e-9)
        np.testing.assert_allclose(way[0, :, :, 2] - slots[0, :, None, 1], 2.0, atol=1e-9)


def test_from_standing_before_a_wall_a_uav_is_led_past_it() -> None:
    """12 m wide, at rest just outside its margin: rows made at a standing plan would hold it for good."""
    planner = QpPlanner(problem(mission={"length_m": 60.0}))
    slots = on_slots(planner)
    at = int(slots[0, :, 0].argmax())
    first = slots[0, at]
    wall = Box((first[0] + 0.3 + 0.9 + 0.2 + 1.0, first[1], 0.0), (2.0, 12.0, 200.0))
    planner.reset(ObstacleSet.from_shapes([wall]), 1)
    solution = nav(slots)
    nearest = np.inf
    for tick in range(150):
        solution = followed(solution, planner.step(solution, 0.1 * tick), 0.1 * (tick + 1))
        nearest = min(nearest, float(planner._obstacles.signed_distance(solution.position).min()) - 0.3)
    assert (solution.position[0, :, 0] - slots[0, :, 0]).min() > 10.0
    assert nearest > 0.9 - 0.4  # three sigma, less what a corner costs


def test_a_command_does_not_depend_on_which_other_runs_are_flown_with_it() -> None:
    flown = problem()
    alone = simulate(flown, "qp", seed=11, runs=range(1, 2), record_every=5)
    together = simulate(flown, "qp", seed=11, runs=range(0, 3), record_every=5)
    second = together.trajectories["run"] == 1
    for name in ("x_m", "y_m", "z_m", "thrust_n", "slack_m"):
        np.testing.assert_array_equal(alone.trajectories[name], together.trajectories[name][second])
    assert alone.tally.counts["iterations"][0] == together.tally.counts["iterations"][1]


def test_a_planner_flown_again_flies_the_same() -> None:
    planner = QpPlanner(problem())
    first, again = (simulate(problem(), planner, seed=11, runs=1, record_every=5) for _ in range(2))
    np.testing.assert_array_equal(first.trajectories["x_m"], again.trajectories["x_m"])


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 200.0])
def test_turning_the_world_turns_the_plan(heading_deg: float) -> None:
    level = problem(
        mission={
            "heading_deg": 0.0,
            "initial_positions_m": None,
            "initial_velocities_mps": None,
            "length_m": 12.0,
        }
    )
    turned = problem(
        mission={
            "heading_deg": heading_deg, "initial_positions_m": None, "initial_velocities_mps": None,
            "length_m": 12.0,
        }
    )  # fmt: skip
    plans = []
    for asked in (level, turned):
        planner = QpPlanner(asked, guided=False)
        frame = planner._frame
        ball = frame.to_world(np.array([[6.0, 3.5, 0.2]]))[0]
        planner.reset(ObstacleSet.from_shapes([Sphere(tuple(ball), 1.0)]), 1)
        start = nav(on_slots(planner, -3.0), cruising(planner))
        yawed = np.zeros((1, 4, 3))
        yawed[..., 2] = frame.heading_rad
        command = planner.step(replace(start, attitude=yawed), 0.0)
        assert command.plan is not None
        plans.append(frame.to_path(command.plan.states[..., 0:6:2]))
    np.testing.assert_allclose(plans[1], plans[0], atol=5e-3)


def test_more_passes_leave_less_between_the_rows_and_the_plan() -> None:
    """Rows are linear at the guess: after a second pass the guess is nearly the answer."""
    moved = []
    for passes in (1, 3):
        asked = problem(planner={"kind": "qp", "passes": passes})
        planner = QpPlanner(asked)
        ball = planner._frame.to_world(np.array([[9.0, 3.3, 0.2]]))[0]
        planner.reset(ObstacleSet.from_shapes([Sphere(tuple(ball), 1.5)]), 1)
        seen: list[Horizon] = []

        class Watch:
            name = "watch"

            def rows(self, horizon: Horizon, seen: list[Horizon] = seen) -> LinearRows:
                seen.append(horizon)
                return TiltLimit(1.0).rows(horizon)

        planner.constraints.append(Watch())
        command = planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
        assert command.plan is not None
        assert len(seen) == passes
        moved.append(np.abs(seen[-1].position - command.plan.states[..., 0:6:2]).max())
    assert moved[1] < 0.5 * moved[0]


def test_a_constraint_of_ones_own_is_kept() -> None:
    class Ceiling:
        name = "ceiling"

        def rows(self, horizon: Horizon) -> LinearRows:
            shape = (*horizon.shape, 1)
            jac = np.zeros((*shape, 3))
            jac[..., 2] = 1.0
            price = np.full(shape, 1000.0)
            return LinearRows("position", jac, None, np.full(shape, -2.0), price, price)

    asked = problem()
    planner = QpPlanner(asked, constraints=[*default_constraints(asked), Ceiling()])
    planner.reset(ObstacleSet.empty(), 1)
    command = planner.step(nav(on_slots(planner), cruising(planner)), 0.0)
    assert command.plan is not None
    np.testing.assert_allclose(command.plan.states[..., -1, 4], -2.0, atol=0.02)


def test_unfiltered_covariance_is_held_whatever_is_asked() -> None:
    """No law says how a reported sigma goes on."""
    programs = []
    for asked in ("held", "expected", "propagated"):
        planner = QpPlanner(problem(planner={"kind": "qp", "covariance": asked}))
        planner.reset(ObstacleSet.empty(), 1)
        programs.append(planner.build(nav(on_slots(planner), cruising(planner)), 0.0))
    for changed in programs[1:]:
        for one, other in zip(programs[0].rows, changed.rows, strict=True):
            np.testing.assert_array_equal(one.jac, other.jac)
            np.testing.assert_array_equal(one.lower, other.lower)


def test_rows_that_do_not_fit_are_an_error_and_not_a_fall_back() -> None:
    class Wrong:
        name = "wrong"

        def rows(self, horizon: Horizon) -> LinearRows:
            return LinearRows("position", np.zeros((1, 1, 1, 1, 3)), np.zeros((1, 1, 1, 1)))

    planner = QpPlanner(problem(), constraints=[Wrong()])
    planner.reset(ObstacleSet.empty(), 1)
    with pytest.raises(NapfError, match="constraint 'wrong': jac has shape"):
        planner.step(nav(on_slots(planner)), 0.0)


def test_rows_that_fit_at_first_and_then_no_more_are_an_error_too() -> None:
    class Shrinks:
        name, steps = "shrinks", 0

        def rows(self, horizon: Horizon) -> LinearRows:
            self.steps += 1
            stages = horizon.shape[2] - (self.steps > 2)
            shape = (*horizon.shape[:2], stages, 1)
            return LinearRows("position", np.zeros((*shape, 3)), np.full(shape, -np.inf))

    planner = QpPlanner(problem(), constraints=[Shrinks()])
    planner.reset(ObstacleSet.empty(), 1)
    for time_s in (0.0, 0.1):
        planner.step(nav(on_slots(planner)), time_s)
    with pytest.raises(NapfError, match="constraint 'shrinks': jac has shape"):
        planner.step(nav(on_slots(planner)), 0.2)


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (None, "rows.. returned a NoneType, must return LinearRows"),
        ([], "rows.. returned a list, must return LinearRows"),
        (LinearRows("position", np.zeros((1, 4, 20, 1, 3)), -7.0, 7.0, 300.0, 300.0),  # type: ignore[arg-type]
         r"lower is a float, must be an array \(run, uav, N, m\) = \(1, 4, 20, 1\)"),
        (LinearRows("position", [[0.0, 0.0, 1.0]]), "jac is a list, must be an array"),  # type: ignore[arg-type]
    ],
)  # fmt: skip
def test_what_are_no_rows_is_an_error_that_names_the_constraint(returned: object, told: str) -> None:
    class Own:
        name = "own"

        def rows(self, horizon: Horizon) -> Any:
            return returned

    planner = QpPlanner(problem(), constraints=[Own()])
    planner.reset(ObstacleSet.empty(), 1)
    with pytest.raises(ConstraintError, match=f"constraint 'own': {told}"):
        planner.step(nav(on_slots(planner)), 0.0)


@pytest.mark.parametrize(
    ("constraints", "told"),
    [
        ([TiltLimit], r"TiltLimit: is a class, give an instance of it: TiltLimit\(...\)"),
        ([object()], "object: name must be a text"),
        (TiltLimit(), "constraints is a TiltLimit, must be a list of constraints"),
    ],
)
def test_what_is_no_constraint_is_refused_when_the_planner_is_made(constraints: Any, told: str) -> None:
    with pytest.raises(ConstraintError, match=told):
        QpPlanner(problem(), constraints=constraints)


@pytest.mark.parametrize("passes", [1, 2])
@pytest.mark.parametrize("solver", ["kernel", "osqp"])
def test_a_count_of_rows_that_changes_is_flown_from_a_cold_start(solver: str, passes: int) -> None:
    class Growing:
        """A ceiling 2 m below the lanes, told once in the first step, twice in the second, then once."""

        name, asked = "growing", 0

        def rows(self, horizon: Horizon) -> LinearRows:
            self.asked += 1
            shape = (*horizon.shape, 2 if self.asked in (2, 3) else 1)
            jac = np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3))
            price = np.full(shape, 1000.0)
            return LinearRows("position", jac, None, np.full(shape, -2.0), price, price)

    asked = problem(planner={"kind": "qp", "passes": passes})
    planner = QpPlanner(asked, [*default_constraints(asked), Growing()], solver)
    planner.reset(ObstacleSet.empty(), 1)
    solution = nav(on_slots(planner), cruising(planner))
    for step in range(4):
        command = planner.step(solution, 0.1 * step)
        assert command.plan is not None
        assert command.planned is not None
        assert command.planned.all()
        np.testing.assert_allclose(command.plan.states[..., -1, 4], -2.0, atol=0.02)
        solution = followed(solution, command, 0.1 * (step + 1))


def test_a_walk_to_a_goal_is_not_flown() -> None:
    with pytest.raises(ProblemError, match="formation"):
        QpPlanner(load_problem("single_uav"))


# -------------------------------------------------------------------------------- when something fails


def test_without_navigation_a_uav_holds_where_it_was_and_the_others_fly_on() -> None:
    planner = QpPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    good = nav(on_slots(planner), cruising(planner))
    planner.step(good, 0.0)
    lost = good.position.copy()
    lost[0, 2] = np.nan
    for tick in range(1, 4):
        command = planner.step(replace(good, position=lost), 0.1 * tick)
    np.testing.assert_array_equal(command.holding, [[False, False, True, False]])
    np.testing.assert_array_equal(command.position[0, 2], good.position[0, 2])
    np.testing.assert_array_equal(command.velocity[0, 2], 0.0)
    assert command.reason is not None
    np.testing.assert_array_equal(command.reason[0], [0, 0, Reason.NAVIGATION, 0])
    assert planner.tally.counts["fall_back_hover"][0] == 3
    assert {(e.uav, e.cause, e.action) for e in planner.ladder.events} == {(2, "navigation", "hover")}


class Faulty:
    """A solver that answers rubbish now and then: to some UAVs, or to nobody."""

    KINDS = ("huge", "nan", "zeros", "old", "raises", "late")

    def __init__(self, solver: BatchSolver, share: float, advance: Callable[[float], None]) -> None:
        self.solver, self.share, self.advance = solver, share, advance
        self.rng = np.random.default_rng(5)
        self.spoilt = 0
        self.old: BatchResult | None = None

    def reset(self) -> None:
        self.solver.reset()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: np.ndarray | None = None
    ) -> BatchResult:
        kind = self.KINDS[self.rng.integers(len(self.KINDS))] if self.rng.random() < self.share else ""
        good = self.solver.solve_batch(horizon, warm, active)
        old, self.old = self.old, good
        if not kind:
            return good
        self.spoilt += 1
        if kind == "raises":
            raise RuntimeError("the library has had enough")
        if kind == "late":
            self.advance(10.0)
            return good
        if kind == "old" and old is not None:
            # Yesterday's answer with today's claim: only residuals on today's numbers can tell.
            return replace(self.judged(horizon, old.z, old.y), messages={})
        value = {"huge": 2.1e9, "nan": np.nan}.get(kind, 0.0)
        return self.judged(horizon, np.full_like(good.z, value), np.zeros_like(good.y))

    def judged(self, horizon: HorizonQp, z: np.ndarray, y: np.ndarray) -> BatchResult:
        """What our own solver loop makes of a library that claims success with these numbers."""
        from napf_mpc.qp import Layout
        from napf_mpc.solvers.residuals import kkt_residuals

        layout = Layout.of(horizon)
        with np.errstate(all="ignore"):
            primal, dual, product = kkt_residuals(layout.sparsity, layout.values(horizon), z, y)
        solved = np.full(z.shape[:2], STATUSES.index("solved"), dtype=np.int8)
        return BatchResult(
            solved, layout.states(z), layout.inputs(z), layout.block_slacks(z), z, y, primal, dual, product,
            np.zeros(z.shape[:2], dtype=np.int64),
        )  # fmt: skip


class Finite:
    """Passes commands on and checks each of them."""

    def __init__(self, planner: QpPlanner) -> None:
        self.planner, self.name = planner, planner.name
        vehicle = planner.problem.vehicle
        self.inverse, self.most = mixer_inverse(vehicle), rotor_limit(vehicle)
        self.hover = np.array([self.most * 4 / 2.2, 0.0, 0.0, 0.0])
        self.steps = 0

    @property
    def tally(self) -> object:
        return self.planner.tally

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        self.planner.reset(obstacles, runs)

    def step(self, solution: NavSolution, time_s: float) -> Command:
        command = self.planner.step(solution, time_s)
        assert command.plan is not None
        for values in (command.position, command.velocity, command.direction, command.plan.states):
            assert np.isfinite(values).all()
        thrusts = np.einsum("ij,ruki->rukj", self.inverse.T, command.plan.inputs + self.hover)
        assert (thrusts > -2e-3).all()
        assert (thrusts < self.most + 2e-3).all()
        self.steps += command.holding.size
        return command


def test_whatever_the_solver_returns_commands_are_sound_and_every_fall_back_is_counted() -> None:
    now = itertools.count()
    moment = [0.0]

    def advance(seconds: float) -> None:
        moment[0] += seconds

    def clock() -> float:
        next(now)
        return moment[0]

    # 15 s at full speed; every spoilt answer costs some of it.
    flown = problem(
        navigation={"filter": "kalman"}, mission={"length_m": 30.0}, simulation={"time_limit_s": 40.0}
    )
    faulty = Faulty(make_batch_solver("osqp"), 0.1, advance)
    pilot = Finite(QpPlanner(flown, solver=faulty, clock=clock))
    missions = simulate(flown, pilot, seed=103, runs=2)
    counts = missions.tally.counts
    assert faulty.spoilt > 10
    # Every spoilt step refused the plans of all UAVs that flew, and each of these flew something else.
    fallen = sum(counts[f"fall_back_{name}"].sum() for name in ("tail", "hover", "descend"))
    assert counts["answers_refused"].sum() == fallen
    assert fallen >= 4 * faulty.spoilt
    causes = {event.cause.split(":")[0] for event in missions.tally.events}
    assert causes >= {"late", "status", "not_finite"}
    assert not missions.score.obstacle_contact.any()
    assert missions.score.finished.all()


class Lies:
    """Yesterday's plan, or none that is the program's, with residuals that are said to be zero."""

    def __init__(self, lie: Callable[[BatchResult], object]) -> None:
        self.solver, self.lie = make_batch_solver("kernel"), lie

    def reset(self) -> None:
        self.solver.reset()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: np.ndarray | None = None
    ) -> Any:
        return self.lie(self.solver.solve_batch(horizon, warm, active))


def stepped(lie: Callable[[BatchResult], object]) -> Command:
    planner = QpPlanner(problem(), solver=Lies(lie))
    planner.reset(ObstacleSet.empty(), 1)
    return planner.step(nav(on_slots(planner), cruising(planner)), 0.0)


def test_residuals_of_a_solver_of_ones_own_are_not_believed_either() -> None:
    flown = stepped(lambda answer: answer)
    assert flown.plan is not None
    assert not flown.holding.any()
    assert stepped(lambda answer: replace(answer, z=0.5 * answer.z)).holding.all()
    assert stepped(lambda answer: replace(answer, y=0.5 * answer.y + 1.0)).holding.all()
    # What flies is the point that was judged.
    beside = stepped(lambda answer: replace(answer, inputs=answer.inputs + 0.1, states=2.0 * answer.states))
    assert beside.plan is not None
    np.testing.assert_array_equal(beside.plan.inputs, flown.plan.inputs)
    np.testing.assert_array_equal(beside.plan.states, flown.plan.states)


@pytest.mark.parametrize(
    ("lie", "words"),
    [
        (lambda answer: None, "returned a NoneType, must return a BatchResult"),
        (lambda answer: replace(answer, y=answer.y[..., 1:]), "y has shape"),
        (lambda answer: replace(answer, status=answer.status[:, :1]), "status has shape"),
    ],
)
def test_an_answer_that_does_not_fit_is_an_error_and_not_a_fall_back(
    lie: Callable[[BatchResult], object], words: str
) -> None:
    with pytest.raises(SolverError, match=words):
        stepped(lie)


def test_late_answers_are_only_known_where_there_is_a_clock() -> None:
    planner = QpPlanner(problem(), clock=iter([0.0, 10.0, 20.0, 20.01]).__next__)
    planner.reset(ObstacleSet.empty(), 1)
    solution = nav(on_slots(planner), cruising(planner))
    assert planner.step(solution, 0.0).holding.all()
    assert not planner.step(solution, 0.1).holding.any()
    assert [event.cause for event in planner.ladder.events] == ["late"] * 4


def test_an_upset_uav_is_levelled_before_it_plans_again() -> None:
    planner = QpPlanner(problem())
    planner.reset(ObstacleSet.empty(), 1)
    good = nav(on_slots(planner), cruising(planner))
    planner.step(good, 0.0)
    tilted = np.zeros((1, 4, 3))
    tilted[0, 1, 0] = 1.2
    command = planner.step(replace(good, attitude=tilted), 0.1)
    np.testing.assert_array_equal(command.holding[0], [False, True, False, False])
    assert [(e.uav, e.cause, e.action) for e in planner.ladder.events] == [(1, "upset", "hover")]


def test_a_uav_that_finds_itself_deep_inside_a_margin_does_not_tumble() -> None:
    """At the start errors of 10 m put the estimate into an obstacle: no plan may turn the vehicle over."""
    flown = load_problem(
        "study_8c",
        {"navigation": {"filter": "kalman"}, "simulation": {"time_limit_s": 8.0}, "planner": {"kind": "qp"}},
    )
    track = simulate(flown, "qp", seed=101, runs=range(10, 11), record_every=5).trajectories
    assert np.abs(track["roll_rad"]).max() < 0.9
    assert np.abs(track["pitch_rad"]).max() < 0.9
    assert np.abs(track["z_m"]).max() < 15.0


def test_planners_by_name_fly_with_and_without_guidance() -> None:
    asked = problem()
    assert make_planner("qp", asked)._guidance is not None
    assert make_planner("qp_unguided", asked)._guidance is None
    assert make_planner("qp", problem(planner={"guidance": "none"}))._guidance is None
    assert make_planner("qp_unguided", asked).name == "qp_unguided"


def test_with_room_for_cohesion_a_formation_keeps_its_shape_better() -> None:
    """Eight missions among eight spheres, by default with room: centimetres of shape, paid with path."""
    shape, path = [], []
    for asked in (["planner.cohesion_room_m=0"], []):
        settings = ['navigation.filter="kalman"', *asked]
        flown = simulate(load_problem("study_8s", settings), "qp", seed=101, runs=8)
        assert flown.score.finished.all()
        shape.append(flown.score.metrics["shape_rms_m"])
        path.append(flown.score.metrics["path_rms_m"])
    assert np.mean(shape[0] - shape[1]) > 0.01  # m; 0.027 when it was written
    assert 0.0 < np.mean(path[1] - path[0]) < 0.15  # m; 0.076


@pytest.mark.parametrize(
    "settings",
    [
        {"planner.altitude_m": [30.0, 60.0]},
        {"planner.altitude_m": [-60.0, -30.0]},
        {
            "world": {
                "kind": "empty",
                "moving_sigma_m": 20.0,
                "moving": [
                    {
                        "shape": "sphere",
                        "start_m": [20.0, 3.0, 0.0],
                        "velocity_mps": [0.0] * 3,
                        "radius_m": 1.5,
                    }
                ],
            }
        },
    ],
    ids=["far below a band", "far above a band", "a track that knows next to nothing"],
)
def test_no_margin_buys_a_dash(settings: dict[str, Any]) -> None:
    """Speeds stay near their bound of 3 m/s, however many metres a UAV is inside what it is to leave."""
    given = load_problem("study_8s", {"navigation.filter": "kalman", "simulation.time_limit_s": 12.0})
    data = json.loads(given.model_dump_json())
    data["planner"]["altitude_m"] = settings.get("planner.altitude_m")
    data["world"] = settings.get("world", data["world"])
    track = simulate(
        Problem.model_validate_json(json.dumps(data)), "qp", seed=3, runs=1, record_every=5
    ).trajectories
    # Take-off is a step of the references, with places that are too close to each other.
    flying = track["t_s"] > 4.0
    assert np.hypot(track["vx_mps"], track["vy_mps"])[flying].max() < 4.8
    assert np.abs(track["vz_mps"])[flying].max() < 3.5


def test_every_pass_is_counted() -> None:
    """What the solver did and what the tally says are the same numbers, however often a step is solved."""

    class Counting(KernelSolver):
        programs, changes = 0, 0

        def solve_batch(
            self, horizon: HorizonQp, warm: WarmStart | None = None, active: Any = None
        ) -> BatchResult:
            answer = super().solve_batch(horizon, warm, active)
            self.programs += answer.counts()["solved"]
            self.changes += int(answer.iterations[answer.iterations >= 0].sum())
            return answer

    given = load_problem("study_8s", {"planner.passes": 3, "simulation.time_limit_s": 5.0})
    solver = Counting()
    missions = simulate(given, QpPlanner(given, solver=solver), seed=1, runs=1)
    counts = missions.tally.counts
    assert counts["solves_solved"].sum() == solver.programs == 3 * 4 * 50
    assert counts["iterations"].sum() == solver.changes > 0
