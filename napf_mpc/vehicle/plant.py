"""The plant: the nonlinear quadrotor integrated with classical Runge-Kutta, every UAV of every run alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.jit import compiled
from napf_mpc.vehicle.derivative_generated import derivative
from napf_mpc.vehicle.quadrotor import INPUTS, PARAMETERS, STATES

Array = NDArray[np.float64]
_DOUBLE = np.dtype(np.float64)


def advance(
    state: Array, inputs: Array, parameters: Array, step_s: float, steps: int, active: NDArray[np.bool_]
) -> None:
    """Advance the state in place by ``steps`` RK4 steps under held inputs.

    Each UAV is integrated by scalar code of its own, so its result does not depend, to the last bit, on how
    many others are in the arrays. A state or input that is not finite makes that UAV's state not finite and
    no other's: the caller decides what such a run counts as.

    Parameters
    ----------
    state : array, shape (run, uav, 12)
        State in the order of Eq. 1 [m, m/s, rad, rad/s], C-contiguous float64; overwritten.
    inputs : array, shape (run, uav, 4)
        Thrust [N] and torques [N m], held for the whole time.
    parameters : array, shape (4,)
        Mass and inertias, from :func:`napf_mpc.vehicle.quadrotor.parameters`.
    step_s : float
        Length of one step [s], positive.
    steps : int
        Number of steps, 0 or more.
    active : array of bool, shape (run,)
        Runs to advance; the others keep their state.

    Raises
    ------
    ProblemError
        A shape does not fit, ``state`` cannot be written in place, or a setting is not finite and positive.
    """
    faults = []
    runs, uavs = state.shape[:2] if state.ndim == 3 else (-1, -1)
    if runs < 0 or state.shape[2] != STATES:
        faults.append(f"state must have shape (run, uav, {STATES}), got {state.shape}")
    if state.dtype != np.float64 or not (state.flags.c_contiguous and state.flags.writeable):
        faults.append("state must be a writeable C-contiguous float64 array: it is advanced in place")
    if inputs.shape != (runs, uavs, INPUTS):
        faults.append(f"inputs must have shape {(runs, uavs, INPUTS)}, got {inputs.shape}")
    if active.shape != (runs,):
        faults.append(f"active must have shape ({runs},), got {active.shape}")
    if parameters.shape != (PARAMETERS,) or not all(0.0 < float(p) < math.inf for p in parameters):
        faults.append(f"parameters must be {PARAMETERS} finite positive numbers, got {parameters!r}")
    if not 0.0 < step_s < math.inf:
        faults.append(f"step_s = {step_s!r} must be a finite positive time in seconds")
    if steps < 0:
        faults.append(f"steps = {steps!r} must be 0 or more")
    if faults:
        raise ProblemError("advance", faults)
    _advance(state, plain(inputs), plain(parameters), float(step_s), int(steps), active.astype(np.bool_))


def plain(array: NDArray[np.generic]) -> Array:
    """Return the array as writeable C-contiguous float64, a copy only if it is not: one compiled variant."""
    if array.flags.carray and array.dtype == _DOUBLE:
        return array  # type: ignore[return-value]
    return np.array(array, dtype=np.float64, order="C")


@compiled
def _advance(
    state: Array, inputs: Array, parameters: Array, step_s: float, steps: int, active: NDArray[np.bool_]
) -> None:
    k1, k2, k3, k4 = np.empty(12), np.empty(12), np.empty(12), np.empty(12)
    trial = np.empty(12)
    half, sixth = 0.5 * step_s, step_s / 6.0
    for run in range(state.shape[0]):
        if not active[run]:
            continue
        for uav in range(state.shape[1]):
            x, u = state[run, uav], inputs[run, uav]
            for _ in range(steps):
                derivative(x, u, parameters, k1)
                for i in range(12):
                    trial[i] = x[i] + half * k1[i]
                derivative(trial, u, parameters, k2)
                for i in range(12):
                    trial[i] = x[i] + half * k2[i]
                derivative(trial, u, parameters, k3)
                for i in range(12):
                    trial[i] = x[i] + step_s * k3[i]
                derivative(trial, u, parameters, k4)
                for i in range(12):
                    x[i] += sixth * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
