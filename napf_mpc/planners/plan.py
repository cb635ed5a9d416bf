"""Plans: states and inputs over a horizon, exact between the nodes, re-sampled as the next step's guess."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from napf_mpc.jit import compiled
from napf_mpc.problem import Vehicle
from napf_mpc.qp import INPUTS, STATES, HorizonModel
from napf_mpc.vehicle.quadrotor import discretize, linearize

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@lru_cache(maxsize=4096)
def _held(vehicle: Vehicle, yaw_rad: float, step_s: float) -> tuple[Array, Array]:
    """Exact zero-order hold (A, B) of the hover model over a time [s]."""
    return discretize(*linearize(vehicle, yaw_rad), step_s)


@lru_cache(maxsize=256)
def _maps(vehicle: Vehicle, yaw_rad: float, into_s: tuple[float, ...]) -> tuple[Index, Array, Array]:
    """Transposed holds over times [s], and which of them belongs to each time: -1 for a time of zero."""
    pairs = [_held(vehicle, yaw_rad, into) for into in into_s if into > 0.0]
    which = np.cumsum([into > 0.0 for into in into_s]) - 1
    which[[into == 0.0 for into in into_s]] = -1
    a = np.array([pair[0].T for pair in pairs]).reshape(len(pairs), STATES, STATES)
    b = np.array([pair[1].T for pair in pairs]).reshape(len(pairs), INPUTS, STATES)
    return which, a, b


@compiled
def _find(starts_s: Array, made_s: float, times_s: Array, stage: Index, into_s: Array) -> None:
    """Write the stage of each time, the last one endless, and how far into it the time is [s]."""
    for n in range(len(times_s)):
        age = max(0.0, times_s[n] - made_s)
        k = 0
        # A node belongs to the stage that starts there; rounding of the clock must not look one stage back.
        while k + 1 < len(starts_s) and starts_s[k + 1] <= age + 1e-9:
            k += 1
        stage[n], into_s[n] = k, max(0.0, age - starts_s[k])


@compiled
def _carry(nodes: Array, held: Array, stage: Index, which: Index, a: Array, b: Array, out: Array) -> None:
    """Write states at some times into out (run, uav, time, 12).

    Parameters
    ----------
    nodes, held : array, shapes (run, uav, N + 1, 12) and (run, uav, N + 1, 4)
        States where each stage starts, and inputs during it; the last stage is endless.
    stage, which : array, shape (time,)
        Stage of each time, and the map from where it starts to then; -1 for none.
    a, b : array, shapes (map, 12, 12) and (map, 4, 12)
        Maps of state and input, transposed.
    """
    pushed = np.empty(STATES)
    for run in range(nodes.shape[0]):
        for uav in range(nodes.shape[1]):
            for n in range(len(stage)):
                x, u, to = nodes[run, uav, stage[n]], held[run, uav, stage[n]], out[run, uav, n]
                m = which[n]
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
    """
    held = [_held(vehicle, yaw_rad, float(step)) for step in step_s]
    a, b = np.stack([pair[0] for pair in held]), np.stack([pair[1] for pair in held])
    q = np.diag(state_weight)[None] * step_s[:, None, None]
    r = np.diag(input_weight)[None] * step_s[:, None, None]
    q[-1] = solve_discrete_are(a[-1], b[-1], np.diag(state_weight) * step_s[-1], r[-1])
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

    @cached_property
    def _starts(self) -> Array:
        """(N + 1,) times from the plan's start at which its stages start; the last one is endless [s]."""
        return np.append(0.0, np.cumsum(self.step_s))

    @cached_property
    def _nodes(self) -> Array:
        """(run, uav, N + 1, 12) states where the stages start."""
        return np.concatenate([self.initial[:, :, None], self.states], axis=2)

    @cached_property
    def _inputs(self) -> Array:
        """(run, uav, N + 1, 4) inputs during the stages."""
        return np.concatenate([self.inputs, np.zeros((*self.initial.shape[:2], 1, INPUTS))], axis=2)

    def at(self, time_s: float) -> tuple[Array, Array]:
        """State (run, uav, 12) and input about hover (run, uav, 4) at a time, by exact zero-order hold.

        After the last stage the inputs are zero and the model runs on.
        """
        stage, into = self._stages(np.array([time_s]))
        state = self._states_at(stage, into).reshape(self.initial.shape)
        return state, np.ascontiguousarray(self._inputs[:, :, stage[0]])

    def resampled(self, time_s: float, step_s: Array) -> tuple[Array, Array]:
        """States (run, uav, N, 12) and inputs (run, uav, N, 4) of these plans on a grid that starts later."""
        times = time_s + np.cumsum(step_s)
        during, _ = self._stages(times - step_s)
        return self._states_at(*self._stages(times)), self._inputs.take(during, axis=2)

    def _stages(self, times_s: Array) -> tuple[Index, Array]:
        """Stages at times (n,), and how far into them the times are [s]."""
        stage, into = np.empty(len(times_s), dtype=np.int64), np.empty(len(times_s))
        _find(self._starts, self.made_s, times_s, stage, into)
        return stage, into

    def _states_at(self, stage: Index, into_s: Array) -> Array:
        """States (run, uav, n, 12) in stages, some time after their starts, both (n,)."""
        rounded = tuple([round(time, 9) if time >= 1e-9 else 0.0 for time in into_s.tolist()])
        out = np.empty((*self.initial.shape[:2], len(rounded), STATES))
        _carry(self._nodes, self._inputs, stage, *_maps(self.vehicle, self.yaw_rad, rounded), out)
        return out

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
