"""The quadrotor's nonlinear model, its linearisation at hover, and its rotor mixer (Eq. 1-11).

World frame east-north-up, z up; body frame x forward, y left, z up, along the thrust. Attitude is yaw,
pitch, roll about z, y, x in this order. SI units and radians throughout.
"""

from __future__ import annotations

import math
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from napf_mpc.errors import ProblemError
from napf_mpc.problem import Vehicle

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81
"""Acceleration of gravity, along -z."""
STATE_NAMES = ("x", "vx", "y", "vy", "z", "vz", "roll", "roll_rate", "pitch", "pitch_rate", "yaw", "yaw_rate")
"""Order of the state (Eq. 1)."""
INPUT_NAMES = ("thrust", "roll_torque", "pitch_torque", "yaw_torque")
"""Order of the input (Eq. 2)."""
PARAMETER_NAMES = ("mass", "inertia_x", "inertia_y", "inertia_z")
"""Order of the parameters that :func:`derivative_function` takes."""
STATES, INPUTS, PARAMETERS = len(STATE_NAMES), len(INPUT_NAMES), len(PARAMETER_NAMES)
POSITION, VELOCITY = slice(0, 6, 2), slice(1, 6, 2)
"""Where x, y, z and their rates are in the state."""
ATTITUDE, RATES = slice(6, 12, 2), slice(7, 12, 2)
"""Where roll, pitch, yaw and their rates are in the state."""


@lru_cache(maxsize=1)
def derivative_function() -> ca.Function:
    r"""Return the state derivative of the nonlinear quadrotor (Eq. 5, as read: the equation is missing).

    Standard rigid body in z-up: ``a = R(roll, pitch, yaw) [0, 0, F / m] - [0, 0, g]`` with the full rotation
    matrix ``R = Rz(yaw) Ry(pitch) Rx(roll)``, and Euler's equations with the gyroscopic coupling,
    ``Ix p' = (Iy - Iz) q r + tau_roll`` and so on. As in the paper, whose state holds the rates of the Euler
    angles, body rates are taken equal to Euler rates (``roll' = p``, ``pitch' = q``, ``yaw' = r``): exact at
    hover, off by the order of tilt times rate away from it. No drag, no ground, no rotor lag.

    Returns
    -------
    casadi.Function
        ``(x (12,), u (4,), p (4,)) -> (12,)`` in the orders of :data:`STATE_NAMES`, :data:`INPUT_NAMES` and
        :data:`PARAMETER_NAMES` [SI]. The parameters are symbols: one expression serves every vehicle.
    """
    x, u, p = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS), ca.SX.sym("p", PARAMETERS)
    _, vx, _, vy, _, vz, roll, roll_rate, pitch, pitch_rate, yaw, yaw_rate = ca.vertsplit(x)
    thrust, roll_torque, pitch_torque, yaw_torque = ca.vertsplit(u)
    mass, ix, iy, iz = ca.vertsplit(p)
    lift = thrust / mass
    # Third column of Rz(yaw) Ry(pitch) Rx(roll): where the thrust points in the world.
    ahead = ca.cos(roll) * ca.sin(pitch)
    ax = lift * (ahead * ca.cos(yaw) + ca.sin(roll) * ca.sin(yaw))
    ay = lift * (ahead * ca.sin(yaw) - ca.sin(roll) * ca.cos(yaw))
    az = lift * ca.cos(roll) * ca.cos(pitch) - GRAVITY_MPS2
    roll_acceleration = ((iy - iz) * pitch_rate * yaw_rate + roll_torque) / ix
    pitch_acceleration = ((iz - ix) * roll_rate * yaw_rate + pitch_torque) / iy
    yaw_acceleration = ((ix - iy) * roll_rate * pitch_rate + yaw_torque) / iz
    rates = ca.vertcat(
        vx, ax, vy, ay, vz, az,
        roll_rate, roll_acceleration, pitch_rate, pitch_acceleration, yaw_rate, yaw_acceleration,
    )  # fmt: skip
    return ca.Function("derivative", [x, u, p], [rates], ["x", "u", "p"], ["dx"], {"cse": True})


@lru_cache(maxsize=1)
def _jacobians() -> ca.Function:
    x, u, p = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS), ca.SX.sym("p", PARAMETERS)
    rates = derivative_function()(x, u, p)
    return ca.Function("jacobians", [x, u, p], [ca.jacobian(rates, x), ca.jacobian(rates, u)])


def parameters(vehicle: Vehicle) -> Array:
    """Return mass [kg] and the three moments of inertia [kg m^2], shape (4,)."""
    return np.array([vehicle.mass_kg, *vehicle.inertia_kgm2])


def hover_input(vehicle: Vehicle) -> Array:
    """Return the input that holds the vehicle in the air, shape (4,): thrust m g [N], no torque (Eq. 8-9)."""
    return np.array([vehicle.mass_kg * GRAVITY_MPS2, 0.0, 0.0, 0.0])


def linearize(vehicle: Vehicle, yaw_rad: float = 0.0) -> tuple[Array, Array]:
    """Linearise the nonlinear model at hover by algorithmic differentiation (Eq. 6-11).

    Parameters
    ----------
    vehicle : Vehicle
        The vehicle.
    yaw_rad : float
        Yaw at which it hovers [rad].

    Returns
    -------
    a : array, shape (12, 12)
        Derivative of the state's rate by the state.
    b : array, shape (12, 4)
        Derivative of the state's rate by the input.

    Raises
    ------
    ProblemError
        ``yaw_rad`` is not finite.
    """
    if not math.isfinite(yaw_rad):
        raise ProblemError("linearize", [f"yaw_rad = {yaw_rad!r} must be a finite number of radians"])
    hover = np.zeros(STATES)
    hover[STATE_NAMES.index("yaw")] = yaw_rad
    a, b = _jacobians()(hover, hover_input(vehicle), parameters(vehicle))
    return np.array(a), np.array(b)


def discretize(a: ArrayLike, b: ArrayLike, step_s: float) -> tuple[Array, Array]:
    """Return the exact zero-order-hold model ``x+ = ad x + bd u`` of ``x' = a x + b u``.

    Parameters
    ----------
    a, b : array, shapes (n, n) and (n, m)
        Continuous-time model.
    step_s : float
        Time for which the input is held [s], positive.

    Returns
    -------
    ad, bd : array, shapes (n, n) and (n, m)
        From one matrix exponential: ``exp([[a, b], [0, 0]] step_s)``.

    Raises
    ------
    ProblemError
        Shapes do not fit, a number is not finite, or ``step_s`` is not positive.
    """
    a, b = model_matrices(a, b, "discretize")
    if not (math.isfinite(step_s) and step_s > 0.0):
        raise ProblemError("discretize", [f"step_s = {step_s!r} must be a finite positive time in seconds"])
    n, m = b.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = a, b
    whole = expm(block * step_s)
    return whole[:n, :n].copy(), whole[:n, n:].copy()


def model_matrices(a: ArrayLike, b: ArrayLike, source: str) -> tuple[Array, Array]:
    """Check a continuous-time model's shapes and that all its numbers are finite; return it as float arrays.

    Raises
    ------
    ProblemError
        Named after ``source``: shapes do not fit or a number is not finite.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.ndim != 2 or b.ndim != 2 or a.shape[0] != a.shape[1] or b.shape[0] != a.shape[0] or b.size == 0:
        raise ProblemError(source, [f"a {a.shape} and b {b.shape} must have shapes (n, n) and (n, m)"])
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ProblemError(source, ["a and b must hold finite numbers only"])
    return a, b


def mixer(vehicle: Vehicle) -> Array:
    """Return the matrix from the four rotor thrusts to the input, shape (4, 4), invertible (Eq. 3, 4, 8).

    As read, in z-up with the signs of Eq. 4 everywhere: rotor 1 is at -x, 2 at -y, 3 at +x, 4 at +y, each
    ``arm_m`` from the centre; total thrust is positive upwards; the drag torque of rotors 1 and 3 turns the
    body to +yaw, that of 2 and 4 to -yaw, each ``drag / lift`` times the rotor's thrust.
    """
    arm = vehicle.arm_m
    drag = vehicle.drag_coefficient / vehicle.lift_coefficient
    return np.array(
        [
            [1.0, 1.0, 1.0, 1.0],
            [0.0, -arm, 0.0, arm],
            [arm, 0.0, -arm, 0.0],
            [drag, -drag, drag, -drag],
        ]
    )


def mixer_inverse(vehicle: Vehicle) -> Array:
    """Return the matrix from the input to the four rotor thrusts, shape (4, 4): the closed-form inverse."""
    lever = 0.5 / vehicle.arm_m
    turn = 0.25 * vehicle.lift_coefficient / vehicle.drag_coefficient
    return np.array(
        [
            [0.25, 0.0, lever, turn],
            [0.25, -lever, 0.0, -turn],
            [0.25, 0.0, -lever, turn],
            [0.25, lever, 0.0, -turn],
        ]
    )


def rotor_limit(vehicle: Vehicle) -> float:
    """Return the largest thrust of one rotor [N]: a quarter of ``thrust_to_weight`` times the weight."""
    return vehicle.thrust_to_weight * vehicle.mass_kg * GRAVITY_MPS2 / 4.0


def rotor_speeds(vehicle: Vehicle, inputs: ArrayLike) -> Array:
    """Return the rotor speeds that give an input: ``F_i = b Omega_i^2`` (Eq. 3).

    Parameters
    ----------
    vehicle : Vehicle
        The vehicle.
    inputs : array, shape (..., 4)
        Thrust [N] and torques [N m].

    Returns
    -------
    array, shape (..., 4)
        Speed of rotors 1 to 4 [rad/s].

    Raises
    ------
    ProblemError
        An input is not finite, or needs a rotor to pull downwards.
    """
    u = np.asarray(inputs, dtype=np.float64)
    if u.shape[-1:] != (INPUTS,) or not np.isfinite(u).all():
        raise ProblemError("rotor_speeds", [f"inputs must be finite, shape (..., 4), got shape {u.shape}"])
    thrusts = np.einsum("ij,...j->...i", mixer_inverse(vehicle), u)
    # An input clipped at zero thrust comes back from the mixer a rounding error below zero.
    tolerance = 1e-9 * rotor_limit(vehicle)
    if thrusts.size and thrusts.min() < -tolerance:
        lowest = thrusts.min()
        raise ProblemError(
            "rotor_speeds", [f"an input needs {lowest:.3g} N of a rotor, which no speed gives: clip it first"]
        )
    speeds: Array = np.sqrt(np.maximum(thrusts, 0.0) / vehicle.lift_coefficient)
    return speeds
