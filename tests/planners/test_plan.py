"""Plans: exact between their nodes, the same path when re-sampled, grids that end where they should."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from napf_mpc.errors import ProblemError
from napf_mpc.planners.plan import Plan, horizon_model, stage_grid, standing_plan, straight_plan
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle.quadrotor import linearize

VEHICLE = Vehicle()
STEP = np.array([0.1, 0.1, 0.3, 0.5])


def plan(seed: int = 0) -> Plan:
    """Two runs of three UAVs whose nodes are those that the model reaches from the start."""
    rng = np.random.default_rng(seed)
    initial = 0.1 * rng.standard_normal((2, 3, 12))
    inputs = rng.standard_normal((2, 3, len(STEP), 4)) * np.array([1.0, 0.01, 0.01, 0.01])
    model = horizon_model(VEHICLE, 0.4, STEP, np.ones(12), np.ones(4))
    states, state = [], initial
    for k in range(len(STEP)):
        state = state @ model.a[k].T + inputs[:, :, k] @ model.b[k].T
        states.append(state)
    return Plan(VEHICLE, 0.4, 7.0, STEP, initial, np.stack(states, axis=2), inputs)


@pytest.mark.parametrize("age", [0.0, 0.05, 0.1, 0.35, 0.5, 0.95, 1.0])
def test_between_nodes_a_plan_is_the_models_own_motion(age: float) -> None:
    flown = plan()
    a, b = linearize(VEHICLE, 0.4)
    ends = np.cumsum(STEP)

    def motion(t: float, x: np.ndarray) -> np.ndarray:
        k = min(int(np.searchsorted(ends, t, side="right")), len(STEP) - 1)
        return a @ x + b @ flown.inputs[1, 2, k]

    x, t = flown.initial[1, 2], 0.0
    for end in [*ends[ends < age], age]:
        if end > t:
            x = solve_ivp(motion, (t, end - 1e-12), x, rtol=1e-10, atol=1e-12).y[:, -1]
        t = end
    np.testing.assert_allclose(flown.at(7.0 + age)[0][1, 2], x, atol=1e-7)


def test_a_node_is_met_exactly_and_its_input_is_that_of_the_stage_it_starts() -> None:
    flown = plan()
    for k, end in enumerate(np.cumsum(STEP)[:-1]):
        state, held = flown.at(7.0 + float(end))
        np.testing.assert_array_equal(state, flown.states[:, :, k])
        np.testing.assert_array_equal(held, flown.inputs[:, :, k + 1])


def test_the_age_of_a_plan_is_not_its_time() -> None:
    """Whoever asks by age would be shown the beginning for ever, and fly slower without a word."""
    flown = plan()
    np.testing.assert_array_equal(flown.at(7.0 - 1e-9)[0], flown.initial)
    for age_s in (0.1, 6.99, float("nan")):
        with pytest.raises(ValueError, match="is before the plan, which begins at made_s = 7;"):
            flown.at(age_s)


def test_resumed_on_its_own_grid_is_the_same_motion() -> None:
    flown = plan()
    later = flown.resumed(7.1, np.array([0.1, 0.3, 0.5]))
    for t in (7.1, 7.15, 7.2, 7.4, 7.9, 8.0):
        np.testing.assert_allclose(later.at(t)[0], flown.at(t)[0], atol=1e-12)


def test_after_its_end_a_plan_runs_on_without_input() -> None:
    flown = plan()
    state, held = flown.at(9.0)
    assert not held.any()
    # Without torque and thrust about hover, roll keeps turning at its last rate.
    end = flown.states[:, :, -1]
    np.testing.assert_allclose(state[..., 6], end[..., 6] + 1.0 * end[..., 7], atol=1e-9)


def test_plans_are_chosen_uav_by_uav() -> None:
    flown, still = plan(), standing_plan(VEHICLE, 0.4, 7.0, STEP, np.full((2, 3, 3), 5.0))
    mask = np.array([[True, False, True], [False, True, False]])
    mixed = flown.where(mask, still)
    np.testing.assert_array_equal(mixed.states[mask], flown.states[mask])
    np.testing.assert_array_equal(mixed.states[~mask][..., 0:6:2], 5.0)
    np.testing.assert_array_equal(mixed.inputs[~mask], 0.0)


def test_a_standing_plan_stays_and_a_straight_one_flies_on() -> None:
    still = standing_plan(VEHICLE, 0.4, 7.0, STEP, np.full((1, 1, 3), 5.0))
    np.testing.assert_allclose(still.at(7.77)[0], still.initial, atol=1e-12)
    velocity = np.array([[[2.0, -1.0, 0.5]]])
    straight = straight_plan(VEHICLE, 0.4, 7.0, STEP, np.zeros((1, 1, 12)), velocity)
    np.testing.assert_allclose(straight.states[0, 0, :, 0:6:2], np.cumsum(STEP)[:, None] * velocity[0])


@pytest.mark.parametrize(
    ("period", "stages", "look_ahead"), [(0.1, 20, 6.5), (0.05, 20, 6.5), (0.1, 50, 6.4), (0.5, 4, 8.0)]
)
def test_a_grid_starts_at_the_period_never_shrinks_and_ends_at_the_look_ahead(
    period: float, stages: int, look_ahead: float
) -> None:
    grid = stage_grid(period, stages, look_ahead)
    assert len(grid) == stages
    np.testing.assert_allclose(grid[: stages // 4], period)
    assert (np.diff(grid) >= -1e-12).all()
    assert grid.sum() == pytest.approx(look_ahead, abs=period)
    np.testing.assert_allclose(grid / period, np.round(grid / period), atol=1e-9)


def test_a_grid_is_no_shorter_than_its_stages() -> None:
    np.testing.assert_allclose(stage_grid(0.1, 20, 0.5), 0.1)


def test_the_terminal_weight_is_what_is_left_to_pay() -> None:
    """A regulator flown for ever from the end of the horizon costs x' P x in the same weights."""
    step, q, r = np.array([0.1, 0.2]), np.linspace(0.5, 2.0, 12), np.array([0.1, 5.0, 5.0, 5.0])
    model = horizon_model(VEHICLE, 0.0, step, q, r)
    a, b, p = model.a[-1], model.b[-1], model.q[-1]
    gain = np.linalg.solve(model.r[-1] + b.T @ p @ b, b.T @ p @ a)
    x = np.random.default_rng(3).standard_normal(12)
    start, cost = x.copy(), 0.0
    for _ in range(2000):
        u = -gain @ x
        cost += 0.2 * (x @ (q * x) + u @ (r * u))
        x = a @ x + b @ u
    assert start @ p @ start == pytest.approx(cost, rel=1e-9)


def test_a_state_without_a_price_has_a_terminal_weight_all_the_same() -> None:
    """``planner.attitude_weight = 0`` is allowed: a yaw that costs nothing has nothing left to pay."""
    q = np.where(np.arange(12) < 6, 5.0, 0.0)
    model = horizon_model(VEHICLE, 0.0, STEP, q, np.array([60.0, 600.0, 600.0, 600.0]))
    assert np.linalg.eigvalsh(model.q[-1]).min() > -1e-9
    assert model.q[-1][0, 0] > 1.0
    assert model.q[-1][10, 10] < 0.1


def test_weights_too_far_apart_are_named() -> None:
    weight = np.full(12, 1e-6)
    weight[1:6:2], weight[6:] = 0.0, 1e6
    with pytest.raises(ProblemError, match=r"_weight = 1e-06, 0, 1e\+06, .*too far apart"):
        horizon_model(Vehicle(mass_kg=0.01, inertia_kgm2=(1e-6, 1e-6, 1e-6)), 0.0, STEP, weight, np.ones(4))
