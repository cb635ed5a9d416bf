"""Plans: states and inputs over a horizon, exact between the nodes, re-sampled as the next step's guess."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from napf_mpc.errors import ProblemError
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.problem import Vehicle
from napf_mpc.qp import INPUTS, STATES, HorizonModel
from napf_mpc.vehicle.plant import plain
from napf_mpc.vehicle.quadrotor import discretize, linearize

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_NOW = np.zeros(1)
"""A grid of a single time."""
LEAST_WEIGHT = 1e-6
"""Least weight of a state, per second, with which is worked out what is left to pay at the horizon's end."""


@lru_cache(maxsize=4096)
def _held(vehicle: Vehicle, yaw_rad: float, step_s: float) -> tuple[Array, Array]:
    """Exact zero-order hold (A, B) of the hover model over a time [s]."""
    return discretize(*linearize(vehicle, yaw_rad), step_s)


@lru_cache(maxsize=256)
def _maps(vehicle: Vehicle, yaw_rad: float, into_ns: bytes) -> tuple[Index, Array, Array]:
    """Transposed holds over times [ns], and which of them belongs to each time: -1 for a time of zero."""
    into_s = [round(1e-9 * into, 9) for into in np.frombuffer(into_ns, dtype=np.int64).tolist()]
    pairs = [_held(vehicle, yaw_rad, into) for into in into_s if into > 0.0]
    which = np.cumsum([into > 0.0 for into in into_s]) - 1
    which[[into == 0.0 for into in into_s]] = -1
    a = np.array([pair[0].T for pair in pairs]).reshape(len(pairs), STATES, STATES)
    b = np.array([pair[1].T for pair in pairs]).reshape(len(pairs), INPUTS, STATES)
    return which, a, b


@compiled_bare
def _stage_of(step_s: Array, age_s: float) -> tuple[int, float]:
    """Stage of an age, the last one endless, and how far into it that is [s]."""
    age, k, start = max(0.0, age_s), 0, 0.0
    # A node belongs to the stage that starts there; rounding of the clock must not look one stage back.
    while k < len(step_s) and start + step_s[k] <= age + 1e-9:
        start += step_s[k]
        k += 1
    return k, max(0.0, age - start)


_EARLY_S = 1e-6
"""Clocks that count ticks differ by rounding: this much before its beginning a plan is at its beginning."""


@compiled_bare
def _find(
    step_s: Array, made_s: float, time_s: float, grid_s: Array, stage: Index, into_ns: Index, during: Index
) -> None:
    """Find the ends of the stages of a grid that starts at a time in plans made at another.

    Parameters
    ----------
    step_s, grid_s : array, shapes (N,) and (time,)
        Lengths of the plans' stages, and of the grid's [s].
    made_s, time_s : float
        When plans and grid start [s].
    stage, into_ns : array of int, shape (time,)
        Out: stage of each end, and how far into it that is [ns].
    during : array of int, shape (time,)
        Out: stage of each beginning.
    """
    after = 0.0
    for n in range(len(grid_s)):
        after += grid_s[n]
        end = time_s + after
        during[n] = _stage_of(step_s, (end - grid_s[n]) - made_s)[0]
        k, into = _stage_of(step_s, end - made_s)
        stage[n], into_ns[n] = k, int(np.rint(1e9 * into)) if into >= 1e-9 else 0


@compiled
def _carry(
    initial: Array, states: Array, inputs: Array, stage: Index, during: Index, which: Index, a: Array,
    b: Array, out: Array, held: Array,
) -> None:  # fmt: skip
    """Write states at some times into out (run, uav, time, 12), and inputs into held (run, uav, time, 4).

    Parameters
    ----------
    initial, states, inputs : array, shapes (run, uav, 12), (run, uav, N, 12) and (run, uav, N, 4)
        Plans; after the last stage there is no input.
    stage, during, which : array, shape (time,)
        Stage of each time's state and of its input, and the map from where the stage starts to then; -1 for
        none.
    a, b : array, shapes (map, 12, 12) and (map, 4, 12)
        Maps of state and input, transposed.
    """
    pushed, rest = np.empty(STATES), np.zeros(INPUTS)
    last = inputs.shape[2]
    for run in range(states.shape[0]):
        for uav in range(states.shape[1]):
            for n in range(len(stage)):
                k, m, to = stage[n], which[n], out[run, uav, n]
                x = initial[run, uav] if k == 0 else states[run, uav, k - 1]
                u = inputs[run, uav, k] if k < last else rest
                kept = inputs[run, uav, during[n]] if during[n] < last else rest
                for j in range(INPUTS):
                    held[run, uav, n, j] = kept[j]
                if m < 0:
                    to[:] = x
                    continue
                to[:] = 0.0
                pushed[:] = 0.0
                for j in range(STATES):
                    for i in range(STATES):
                        to[i] += a[m, j, i] * x[j]
                for j in range(INPUTS):
                    for i in range(STATES):
                        pushed[i] += b[m, j, i] * u[j]
                for i in range(STATES):
                    to[i] += pushed[i]


def stage_grid(period_s: float, stages: int, look_ahead_s: float) -> Array:
    """Lengths of the stages: a quarter at the planner's period, then growing evenly to the look-ahead.

    Parameters
    ----------
    period_s : float
        Planner's period [s].
    stages : int
        Number of stages N.
    look_ahead_s : float
        Time at the end of the last stage [s].

    Returns
    -------
    array, shape (N,)
        Multiples of the period, so that a plan re-sampled one period later meets its own nodes [s].
    """
    fine = max(1, stages // 4)
    total = max(stages, round(look_ahead_s / period_s))
    steps = np.ones(stages, dtype=np.int64)
    spare = total - stages
    weights = np.maximum(np.arange(stages) - fine + 1, 0).astype(float)
    if spare > 0 and weights.sum() > 0:
        share = np.floor(np.cumsum(weights) / weights.sum() * spare + 1e-9).astype(np.int64)
        steps += np.diff(share, prepend=0)
    return np.asarray(np.sort(steps) * period_s, dtype=np.float64)


def horizon_model(
    vehicle: Vehicle, yaw_rad: float, step_s: Array, state_weight: Array, input_weight: Array
) -> HorizonModel:
    """Hover model and weights on a stage grid.

    Weights are per second: ``Q dt_k`` and ``R dt_k``; the terminal weight is the discrete Riccati solution at
    the last stage's length with the same weights.

    Parameters
    ----------
    vehicle : Vehicle
        Mass and inertia.
    yaw_rad : float
        Yaw about which the model is linearised [rad].
    step_s : array, shape (N,)
        Lengths of the stages [s].
    state_weight, input_weight : array, shapes (12,) and (4,)
        Diagonals of Q and R per second; the horizontal weights must be equal along both axes, so that the
        Hessian does not depend on the heading.

    Raises
    ------
    ProblemError
        If the weights are too far apart for the Riccati equation to be solved.
    """
    held = [_held(vehicle, yaw_rad, float(step)) for step in step_s]
    a, b = np.stack([pair[0] for pair in held]), np.stack([pair[1] for pair in held])
    q = np.diag(state_weight)[None] * step_s[:, None, None]
    r = np.diag(input_weight)[None] * step_s[:, None, None]
    # What costs nothing on the way costs next to nothing after it: a yaw without a price would have no limit.
    after = np.maximum(state_weight, LEAST_WEIGHT)
    try:
        q[-1] = solve_discrete_are(a[-1], b[-1], np.diag(after) * step_s[-1], r[-1])
    except (np.linalg.LinAlgError, ValueError) as error:
        asked = ", ".join(f"{weight:g}" for weight in (*state_weight[[0, 1, 6]], *input_weight[:2]))
        names = "position_weight, velocity_weight, attitude_weight, thrust_weight and torque_weight"
        raise ProblemError(
            "planner",
            [
                f"{names} = {asked} with a last stage of {step_s[-1]:g} s: too far apart, what is left to "
                "pay at the horizon's end cannot be computed; choose them nearer to their defaults, or a "
                "shorter look_ahead_s"
            ],
        ) from error
    q[-1] = 0.5 * (q[-1] + q[-1].T)
    return HorizonModel(np.array(step_s, dtype=float), a, b, q, r)


@dataclass(frozen=True)
class Plan:
    """Plans of all UAVs of all runs, made at one time; inputs are held over each stage."""

    vehicle: Vehicle
    """Whose hover model connects the nodes."""
    yaw_rad: float
    """Yaw about which the model is linearised [rad]."""
    made_s: float
    """Time at which the plans start [s]."""
    step_s: Array
    """(N,) lengths of the stages [s]."""
    initial: Array
    """(run, uav, 12) state at the start."""
    states: Array
    """(run, uav, N, 12) state at the end of each stage."""
    inputs: Array
    """(run, uav, N, 4) inputs about hover during each stage."""

    def at(self, time_s: float) -> tuple[Array, Array]:
        """State (run, uav, 12) and input about hover (run, uav, 4) at a time, by exact zero-order hold.

        After the last stage the inputs are zero and the model runs on.

        Parameters
        ----------
        time_s : float
            On the clock that the planner was stepped by, as :attr:`made_s` is; not the age of the plan [s].

        Raises
        ------
        ValueError
            If the plan does not begin until later.
        """
        if not time_s >= self.made_s - _EARLY_S:
            raise ValueError(
                f"time_s = {time_s:g} is before the plan, which begins at made_s = {self.made_s:g}; give the "
                "time of now on the planner's clock, not the plan's age"
            )
        states, inputs = self.resampled(time_s, _NOW)
        return states.reshape(self.initial.shape), inputs.reshape(*self.initial.shape[:2], INPUTS)

    def resampled(self, time_s: float, step_s: Array) -> tuple[Array, Array]:
        """States (run, uav, N, 12) and inputs (run, uav, N, 4) of these plans on a grid that starts later."""
        places = np.empty((3, len(step_s)), dtype=np.int64)
        stage, into_ns, during = places
        _find(plain(self.step_s), self.made_s, time_s, plain(step_s), stage, into_ns, during)
        shape = (*self.initial.shape[:2], len(step_s))
        states, inputs = np.empty((*shape, STATES)), np.empty((*shape, INPUTS))
        _carry(
            plain(self.initial), plain(self.states), plain(self.inputs), stage, during,
            *_maps(self.vehicle, self.yaw_rad, into_ns.tobytes()), states, inputs,
        )  # fmt: skip
        return states, inputs

    def resumed(self, time_s: float, step_s: Array) -> Plan:
        """The same plans from a later time on, on a grid that starts there."""
        states, inputs = self.resampled(time_s, step_s)
        return Plan(self.vehicle, self.yaw_rad, time_s, step_s, self.at(time_s)[0], states, inputs)

    def where(self, mask: NDArray[np.bool_], other: Plan) -> Plan:
        """These plans where a mask (run, uav) is set, elsewhere others of the same time and grid."""
        m = mask[..., None]
        return Plan(
            self.vehicle, self.yaw_rad, self.made_s, self.step_s,
            np.where(m, self.initial, other.initial),
            np.where(m[..., None], self.states, other.states),
            np.where(m[..., None], self.inputs, other.inputs),
        )  # fmt: skip


def standing_plan(vehicle: Vehicle, yaw_rad: float, time_s: float, step_s: Array, position: Array) -> Plan:
    """Plan of UAVs that hover at positions (run, uav, 3)."""
    state = np.zeros((*position.shape[:2], STATES))
    state[..., 0:6:2] = position
    state[..., 10] = yaw_rad
    stages = len(step_s)
    states = np.repeat(state[:, :, None], stages, axis=2)
    inputs = np.zeros((*position.shape[:2], stages, INPUTS))
    return Plan(vehicle, yaw_rad, time_s, step_s, state, states, inputs)


def straight_plan(
    vehicle: Vehicle, yaw_rad: float, time_s: float, step_s: Array, initial: Array, velocity: Array
) -> Plan:
    """Plan of UAVs that fly on level and straight at a velocity (run, uav, 3): the first guess of all."""
    runs, uavs = initial.shape[:2]
    states = np.zeros((runs, uavs, len(step_s), STATES))
    times = np.cumsum(step_s)
    for axis in range(3):
        states[..., 2 * axis] = initial[..., None, 2 * axis] + velocity[..., None, axis] * times
        states[..., 2 * axis + 1] = velocity[..., None, axis]
    states[..., 10] = yaw_rad
    inputs = np.zeros((runs, uavs, len(step_s), INPUTS))
    return Plan(vehicle, yaw_rad, time_s, np.array(step_s, dtype=float), initial, states, inputs)
