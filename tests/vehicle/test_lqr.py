"""The paper's gains and poles, a second solver's opinion, refusals, and the sampled loop."""

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov

from napf_mpc.errors import ProblemError
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle.lqr import check_sampled_loop, hover_gain, lqr, sampled_spectral_radius
from napf_mpc.vehicle.quadrotor import INPUT_NAMES, STATE_NAMES, linearize

PAPER = Vehicle()
Q, R = 0.1 * np.eye(12), np.diag([0.1, 10.0, 100.0, 10.0])


@pytest.fixture(scope="module")
def paper():
    return hover_gain(PAPER)


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [
        ("thrust", "z", 1.0),
        ("roll_torque", "y", -0.1),
        ("pitch_torque", "x", 0.0316),
        ("thrust", "vz", math.sqrt(3.0)),  # double integrator by hand: k2 = sqrt(2 k1 / b + q / r)
        ("yaw_torque", "yaw", 0.1),
    ],
)
def test_gains_of_the_paper(paper, row, column, value):
    got = paper.gain[INPUT_NAMES.index(row), STATE_NAMES.index(column)]
    assert got == pytest.approx(value, abs=5e-5)


def test_axes_do_not_mix(paper):
    """At hover x goes with pitch, y with roll, z with thrust, yaw alone."""
    belongs = {
        "thrust": (4, 5),
        "roll_torque": (2, 3, 6, 7),
        "pitch_torque": (0, 1, 8, 9),
        "yaw_torque": (10, 11),
    }
    for row, name in enumerate(INPUT_NAMES):
        others = [j for j in range(12) if j not in belongs[name]]
        assert np.abs(paper.gain[row, others]).max() < 1e-12
        assert np.abs(paper.gain[row, list(belongs[name])]).min() > 1e-2


def test_poles_of_the_paper(paper):
    assert paper.poles[:2].real == pytest.approx([-0.87, -0.87], abs=0.005)
    assert sorted(paper.poles[:2].imag) == pytest.approx([-0.5, 0.5], abs=0.005)
    assert paper.poles[2] == pytest.approx(-1.0, abs=0.005)
    assert paper.poles[-1] == pytest.approx(-12.3, abs=0.05)
    assert (paper.poles.real < 0.0).all()


@pytest.mark.parametrize("yaw", [0.0, 1.0])
def test_gain_agrees_with_python_control(yaw):
    a, b = linearize(PAPER, yaw)
    ours = lqr(a, b, Q, R)
    gain, riccati, poles = control.lqr(a, b, Q, R, method="scipy")
    np.testing.assert_allclose(ours.gain, gain, atol=1e-9)
    np.testing.assert_allclose(ours.riccati, riccati, atol=1e-9)
    np.testing.assert_allclose(np.sort(ours.poles.real), np.sort(poles.real), atol=1e-8)


def test_riccati_solution_is_the_cost_to_go(paper):
    """Fly the linear closed loop and add the cost up: it must be x0^T P x0 (twice Eq. 12)."""
    a, b = linearize(PAPER)
    k = paper.gain
    x0 = np.array([3.0, 1.0, -2.0, 0.5, 1.0, -1.0, 0.1, 0.2, -0.1, 0.3, 0.5, -0.2])
    weight = Q + k.T @ R @ k

    def fly(_, s):
        return np.append((a - b @ k) @ s[:12], s[:12] @ weight @ s[:12])

    end = solve_ivp(fly, (0.0, 40.0), np.append(x0, 0.0), rtol=1e-10, atol=1e-12).y[:, -1]
    assert end[12] == pytest.approx(x0 @ paper.riccati @ x0, rel=1e-7)


def test_any_other_gain_costs_more(paper):
    """Direct check of optimality: perturbed gains have a larger cost matrix (Lyapunov equation)."""
    a, b = linearize(PAPER)
    rng = np.random.default_rng(0)
    for _ in range(10):
        k = paper.gain * (1.0 + 0.05 * rng.normal(size=(4, 12)))
        closed = a - b @ k
        cost = solve_continuous_lyapunov(closed.T, -(Q + k.T @ R @ k))
        assert np.linalg.eigvalsh(cost - paper.riccati).min() > -1e-9
        assert np.trace(cost) > np.trace(paper.riccati)


# -------------------------------------------------------------------------------------------- refusals

A, B = linearize(PAPER)
SKEW = np.eye(12)
SKEW[0, 1] = 0.5


@pytest.mark.parametrize(
    ("a", "b", "q", "r", "says"),
    [
        (A, B, -np.eye(12), R, "q must be positive semi-definite"),
        (A, B, Q, -R, "r must be positive definite"),
        (A, B, Q, np.diag([1.0, 1.0, 1.0, 0.0]), "r must be positive definite"),
        (A, B, SKEW, R, "q must be symmetric"),
        (A, B, np.eye(11), R, r"q must be finite with shape \(12, 12\)"),
        (A, B, Q, np.eye(3), r"r must be finite with shape \(4, 4\)"),
        (A, B, Q * math.nan, R, "q must be finite"),
        (A, B, Q, np.diag([math.inf, 1.0, 1.0, 1.0]), "r must be finite"),
        (A[:3], B, Q, R, "shapes"),
        (A * math.nan, B, Q, R, "finite numbers"),
        (A, B * 0.0, Q, R, "no stable regulator"),  # nothing steers it
        (A, B, Q * 0.0, R, "no stable regulator"),  # nothing is asked of it
        (A, B, np.diag([0.0] + [0.1] * 11), R, "no stable regulator"),  # x may drift for ever
    ],
)
def test_what_has_no_regulator_is_refused(a, b, q, r, says):
    with pytest.raises(ProblemError, match=says):
        lqr(a, b, q, r)


def test_a_vehicle_without_a_regulator_names_its_keys():
    with pytest.raises(ProblemError, match=r"vehicle\.lqr_q_diagonal") as caught:
        hover_gain(Vehicle(lqr_q_diagonal=(0.0,) * 12))
    assert isinstance(caught.value, ValueError)


@given(
    q=st.lists(st.sampled_from([0.0, 1e-6, 1e-3, 1.0, 1e3, 1e6]), min_size=12, max_size=12),
    r=st.lists(st.sampled_from([1e-6, 1e-2, 1.0, 1e2, 1e6]), min_size=4, max_size=4),
    mass=st.floats(0.01, 1000.0),
    inertia=st.lists(st.floats(1e-6, 1e3), min_size=3, max_size=3),
)
@settings(max_examples=150)
def test_every_vehicle_has_a_stable_gain_or_a_clear_error(q, r, mass, inertia):
    vehicle = Vehicle(
        mass_kg=mass, inertia_kgm2=tuple(inertia), lqr_q_diagonal=tuple(q), lqr_r_diagonal=tuple(r)
    )
    try:
        result = hover_gain(vehicle)
    except ProblemError:
        return
    a, b = linearize(vehicle)
    assert np.linalg.eigvals(a - b @ result.gain).real.max() < 0.0


# --------------------------------------------------------------------------------------------- sampled


def test_sampled_loop_is_stable_at_a_tenth_and_not_at_three_twentieths_of_a_second(paper):
    assert sampled_spectral_radius(PAPER, paper, 0.02) < 0.985
    assert sampled_spectral_radius(PAPER, paper, 0.10) < 0.95
    assert sampled_spectral_radius(PAPER, paper, 0.12) > 1.05
    assert sampled_spectral_radius(PAPER, paper, 0.15) > 1.5


def test_fast_sampling_approaches_the_continuous_loop(paper):
    slowest = paper.poles[0].real
    assert sampled_spectral_radius(PAPER, paper, 1e-3) == pytest.approx(math.exp(slowest * 1e-3), abs=1e-6)


def test_a_slow_controller_is_refused_with_a_rate_that_works():
    check_sampled_loop(PAPER, 0.02)
    check_sampled_loop(PAPER, 0.1)
    with pytest.raises(ProblemError, match=r"simulation\.controller_rate_hz: 6\.66667 .* use 10 or more"):
        check_sampled_loop(PAPER, 0.15)
    # Heavier weights need a faster loop; the rate that is advised must itself pass.
    nimble = Vehicle(lqr_r_diagonal=(0.1,) * 4)
    with pytest.raises(
        ProblemError, match=r"controller_rate_hz: 50 .* use 100 or more.*step_s at most 0\.01"
    ):
        check_sampled_loop(nimble, 0.02)
    check_sampled_loop(nimble, 0.01)


def test_a_vehicle_that_no_rate_steadies_is_told_to_soften():
    wild = Vehicle(lqr_q_diagonal=(100.0,) * 12, lqr_r_diagonal=(0.1,) * 4)
    with pytest.raises(ProblemError, match="soften the LQR"):
        check_sampled_loop(wild, 0.02)
