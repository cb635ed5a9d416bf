"""The model against independent mechanics, its linearisation by hand, the mixer's signs."""

import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle.quadrotor import (
    ATTITUDE,
    GRAVITY_MPS2,
    INPUT_NAMES,
    POSITION,
    RATES,
    STATE_NAMES,
    VELOCITY,
    derivative_function,
    discretize,
    hover_input,
    linearize,
    mixer,
    mixer_inverse,
    parameters,
    rotor_limit,
    rotor_speeds,
)

PAPER = Vehicle()
LOPSIDED = Vehicle(mass_kg=2.5, inertia_kgm2=(0.01, 0.02, 0.025), arm_m=0.4)
VX, VY, VZ = 1, 3, 5
ROLL, ROLL_RATE, PITCH, PITCH_RATE, YAW, YAW_RATE = range(6, 12)


def rate(vehicle, x, u):
    return np.array(derivative_function()(x, u, parameters(vehicle))).ravel()


def hand_derived(vehicle, yaw):
    """A and B at hover, by hand: small tilts push along the heading and to its side."""
    ix, iy, iz = vehicle.inertia_kgm2
    g, c, s = GRAVITY_MPS2, math.cos(yaw), math.sin(yaw)
    a, b = np.zeros((12, 12)), np.zeros((12, 4))
    for i in range(0, 12, 2):
        a[i, i + 1] = 1.0
    a[VX, PITCH], a[VX, ROLL] = g * c, g * s
    a[VY, PITCH], a[VY, ROLL] = g * s, -g * c
    b[VZ, 0] = 1.0 / vehicle.mass_kg
    b[ROLL_RATE, 1], b[PITCH_RATE, 2], b[YAW_RATE, 3] = 1.0 / ix, 1.0 / iy, 1.0 / iz
    return a, b


def test_orders_are_those_of_the_paper():
    assert STATE_NAMES[POSITION] == ("x", "y", "z")
    assert STATE_NAMES[VELOCITY] == ("vx", "vy", "vz")
    assert STATE_NAMES[ATTITUDE] == ("roll", "pitch", "yaw")
    assert STATE_NAMES[RATES] == ("roll_rate", "pitch_rate", "yaw_rate")
    assert INPUT_NAMES == ("thrust", "roll_torque", "pitch_torque", "yaw_torque")


@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi, -2.5])
@pytest.mark.parametrize("vehicle", [PAPER, LOPSIDED])
def test_hover_is_an_equilibrium_at_any_yaw(vehicle, yaw):
    x = np.zeros(12)
    x[YAW] = yaw
    x[POSITION] = 10.0, -20.0, 30.0
    assert hover_input(vehicle)[0] == vehicle.mass_kg * 9.81
    np.testing.assert_allclose(rate(vehicle, x, hover_input(vehicle)), 0.0, atol=1e-14)


def test_without_thrust_it_falls_with_g_whatever_its_attitude():
    x = np.zeros(12)
    x[ATTITUDE] = 0.4, -1.1, 2.0
    dx = rate(PAPER, x, np.zeros(4))
    assert dx[VELOCITY].tolist() == [0.0, 0.0, -9.81]


def test_tilt_pushes_where_a_pilot_expects():
    """Pitch forward pushes to +x, roll to the right to -y; turned by 90 degrees, to +y and +x."""
    for tilt, yaw, expected in [
        (PITCH, 0.0, (1, 0)),
        (ROLL, 0.0, (0, -1)),
        (PITCH, 90.0, (0, 1)),
        (ROLL, 90.0, (1, 0)),
    ]:
        x = np.zeros(12)
        x[tilt], x[YAW] = 0.1, math.radians(yaw)
        push = rate(PAPER, x, hover_input(PAPER))[VELOCITY][:2]
        np.testing.assert_allclose(push, 9.81 * math.sin(0.1) * np.array(expected), atol=1e-14)


@given(seed=st.integers(0, 2**32 - 1))
def test_forces_and_torques_obey_newton_and_euler(seed):
    """Thrust along the third column of an independent rotation matrix; I w' + w x I w = torque."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=12) * 3.0, rng.normal(size=4) * 5.0
    dx = rate(LOPSIDED, x, u)
    roll, pitch, yaw = x[ATTITUDE]
    up = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()[:, 2]
    force = u[0] * up - np.array([0.0, 0.0, LOPSIDED.mass_kg * 9.81])
    np.testing.assert_allclose(LOPSIDED.mass_kg * dx[VELOCITY], force, atol=1e-12)
    inertia = np.array(LOPSIDED.inertia_kgm2)
    w, w_dot = x[RATES], dx[RATES]
    np.testing.assert_allclose(inertia * w_dot + np.cross(w, inertia * w), u[1:], atol=1e-12)
    assert (dx[POSITION] == x[VELOCITY]).all()
    assert (dx[ATTITUDE] == x[RATES]).all()


@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi / 2, -2.5])
@pytest.mark.parametrize("vehicle", [PAPER, LOPSIDED])
def test_linearisation_equals_the_hand_derived_matrices(vehicle, yaw):
    a, b = linearize(vehicle, yaw)
    a_hand, b_hand = hand_derived(vehicle, yaw)
    np.testing.assert_allclose(a, a_hand, rtol=0, atol=1e-14)
    np.testing.assert_allclose(b, b_hand, rtol=1e-15, atol=0)


def test_linearisation_predicts_small_motions_of_the_nonlinear_model():
    rng = np.random.default_rng(0)
    a, b = linearize(LOPSIDED, 1.2)
    hover = np.zeros(12)
    hover[YAW] = 1.2
    for size in (1e-3, 1e-4):
        dx, du = size * rng.normal(size=12), size * rng.normal(size=4)
        error = rate(LOPSIDED, hover + dx, hover_input(LOPSIDED) + du) - a @ dx - b @ du
        assert np.abs(error).max() < 200.0 * size**2, "what is left must be of second order"


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_linearise_refuses_a_yaw_that_is_no_number(bad):
    with pytest.raises(ProblemError, match="yaw_rad"):
        linearize(PAPER, bad)


# ------------------------------------------------------------------------------------------- sampling


@pytest.mark.parametrize("step", [0.001, 0.02, 0.1, 1.0])
def test_zero_order_hold_agrees_with_python_control(step):
    a, b = linearize(PAPER, 0.3)
    ad, bd = discretize(a, b, step)
    other = control.sample_system(control.ss(a, b, np.eye(12), 0), step, method="zoh")
    np.testing.assert_allclose(ad, other.A, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(bd, other.B, rtol=1e-12, atol=1e-14)


def test_two_half_steps_are_one_step():
    a, b = linearize(PAPER)
    ad, bd = discretize(a, b, 0.1)
    half_ad, half_bd = discretize(a, b, 0.05)
    np.testing.assert_allclose(half_ad @ half_ad, ad, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(half_ad @ half_bd + half_bd, bd, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("step", [0.0, -0.1, math.nan, math.inf])
def test_sampling_refuses_a_step_without_length(step):
    with pytest.raises(ProblemError, match="step_s"):
        discretize(*linearize(PAPER), step)


def test_sampling_refuses_models_that_do_not_fit():
    a, b = linearize(PAPER)
    with pytest.raises(ProblemError, match="shapes"):
        discretize(a[:11], b, 0.1)
    with pytest.raises(ProblemError, match="shapes"):
        discretize(a, b[:11], 0.1)
    a[0, 0] = math.nan
    with pytest.raises(NapfError, match="finite"):
        discretize(a, b, 0.1)


# ---------------------------------------------------------------------------------------------- rotors


def test_mixer_gives_the_moments_of_forces_at_the_rotors_places():
    """Rotor 1 at -x, 2 at -y, 3 at +x, 4 at +y: torque = place x force, drag turns 1 and 3 to +yaw."""
    arm = LOPSIDED.arm_m
    places = np.array([[-arm, 0, 0], [0, -arm, 0], [arm, 0, 0], [0, arm, 0]])
    spin = np.array([1.0, -1.0, 1.0, -1.0])
    thrusts = np.array([1.0, 2.0, 3.5, 0.25])
    forces = thrusts[:, None] * np.array([0.0, 0.0, 1.0])
    torque = np.cross(places, forces).sum(axis=0)
    speeds_squared = thrusts / LOPSIDED.lift_coefficient
    torque[2] += (spin * LOPSIDED.drag_coefficient * speeds_squared).sum()
    np.testing.assert_allclose(mixer(LOPSIDED) @ thrusts, [thrusts.sum(), *torque], rtol=1e-13)


@pytest.mark.parametrize(
    ("rotor", "name", "sign"),
    [(1, "pitch_torque", 1), (2, "roll_torque", -1), (3, "pitch_torque", -1), (4, "roll_torque", 1)],
)
def test_a_faster_rotor_lifts_its_side(rotor, name, sign):
    column = mixer(PAPER)[:, rotor - 1]
    assert column[INPUT_NAMES.index(name)] * sign == pytest.approx(0.24)
    assert column[0] == 1.0
    assert np.sign(column[3]) == (1 if rotor in (1, 3) else -1)
    # The raised side lets the thrust point to the other one: rotor 1 at -x drives towards +x.
    x = np.zeros(12)
    x[PITCH], x[ROLL] = 1e-3 * column[2], 1e-3 * column[1]
    push = rate(PAPER, x, hover_input(PAPER))[VELOCITY][:2]
    place = {1: (-1, 0), 2: (0, -1), 3: (1, 0), 4: (0, 1)}[rotor]
    assert np.dot(push, place) < 0.0


@pytest.mark.parametrize("vehicle", [PAPER, LOPSIDED, Vehicle(drag_coefficient=1e-10, lift_coefficient=1.0)])
def test_mixer_is_invertible_and_the_closed_form_is_its_inverse(vehicle):
    np.testing.assert_allclose(mixer_inverse(vehicle) @ mixer(vehicle), np.eye(4), atol=1e-15)
    np.testing.assert_allclose(mixer_inverse(vehicle), np.linalg.inv(mixer(vehicle)), rtol=1e-9, atol=1e-12)


def test_hover_needs_four_equal_rotors():
    speeds = rotor_speeds(PAPER, hover_input(PAPER))
    np.testing.assert_allclose(speeds, math.sqrt(9.81 / 4 / 54.2e-6))
    assert speeds[0] == pytest.approx(212.7, abs=0.05)


@given(thrusts=st.lists(st.floats(0.0, 20.0), min_size=4, max_size=4))
def test_rotor_speeds_give_back_their_thrusts(thrusts):
    u = mixer(PAPER) @ np.array(thrusts)
    speeds = rotor_speeds(PAPER, u[None, None])
    assert speeds.shape == (1, 1, 4)
    np.testing.assert_allclose(PAPER.lift_coefficient * speeds[0, 0] ** 2, thrusts, atol=1e-8)


@pytest.mark.parametrize("u", [[-1.0, 0, 0, 0], [9.81, 5.0, 0, 0], [math.nan, 0, 0, 0], [9.81, 0, 0]])
def test_rotor_speeds_refuse_what_no_rotor_gives(u):
    with pytest.raises(ProblemError, match="rotor_speeds"):
        rotor_speeds(PAPER, u)


def test_rotor_limit_is_a_quarter_of_the_largest_thrust():
    assert rotor_limit(PAPER) == pytest.approx(2.2 * 9.81 / 4)
    assert rotor_limit(Vehicle(mass_kg=3.0, thrust_to_weight=1.5)) == pytest.approx(3.0 * 1.5 * 9.81 / 4)
