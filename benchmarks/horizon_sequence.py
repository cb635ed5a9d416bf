"""Sequences of horizon programs without the planner, for benchmarks of solvers.

Rows and noise are made here from a few lines, so that solvers can be timed on programs of the planner's size
and kind without it; those of the planner's own flights are in :mod:`napf_mpc.benchmark.programs`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from napf_mpc.constraints.constraint import LinearRows
from napf_mpc.problem import Vehicle
from napf_mpc.qp import Array, HorizonModel, HorizonQp
from napf_mpc.vehicle.quadrotor import (
    ATTITUDE,
    POSITION,
    VELOCITY,
    discretize,
    hover_input,
    linearize,
    mixer_inverse,
    rotor_limit,
)

STEPS_S = (0.1,) * 5 + (0.2,) * 5 + (0.4,) * 5 + (0.6,) * 5
"""Stage lengths [s]: 6.5 s ahead."""
SPEED_MPS, MAX_SPEED_MPS, MAX_TILT_RAD, MAX_HEIGHT_M = 2.0, 3.0, 0.35, 5.0
INFLUENCE_M, MARGIN_M, GAIN = 3.0, 1.9, 15.0


@dataclass(frozen=True)
class Rotors:
    """Rotor limits about hover: ``lower <= matrix @ u <= upper`` [N]."""

    matrix: Array
    """(4, 4)."""
    lower: Array
    """(4,)."""
    upper: Array
    """(4,)."""


def rotors(vehicle: Vehicle) -> Rotors:
    """Return the limits of a vehicle's rotors."""
    matrix = mixer_inverse(vehicle)
    hover = matrix @ hover_input(vehicle)
    return Rotors(matrix, -hover, rotor_limit(vehicle) - hover)


def horizon_model(vehicle: Vehicle) -> HorizonModel:
    """Hover model on the stage grid: unit tracking weights, Riccati terminal weight."""
    step = np.array(STEPS_S)
    pairs = [discretize(*linearize(vehicle), s) for s in step]
    a, b = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    state = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.1, 1.0, 0.1, 1.0, 0.1])
    inputs = np.diag([0.1, 10.0, 10.0, 10.0])
    q = state * step[:, None, None]
    r = inputs * step[:, None, None]
    q[-1] = solve_discrete_are(a[-1], b[-1], q[-1], r[-1])
    q[-1] = 0.5 * (q[-1] + q[-1].T)
    return HorizonModel(step, a, b, q, r)


def fly(
    solve: Callable[[HorizonQp], Array], *, count: int, uavs: int, obstacles: int, jump_m: float, seed: int
) -> list[HorizonQp]:
    """Horizon programs (run = 1) of a flight of ``count`` steps of 0.1 s.

    Parameters
    ----------
    solve : callable
        Horizon -> inputs and states of its solution, (1, uav, N, 16) with states first.
    count, uavs, obstacles : int
        Steps, UAVs and spheres within 100 m of lane.
    jump_m : float
        Standard deviation of the navigation jump of each step and axis [m].
    seed : int
        Of everything random.
    """
    rng = np.random.default_rng(seed)
    vehicle = Vehicle()
    model, limit = horizon_model(vehicle), rotors(vehicle)
    lanes = np.array([[-8.0 * (i // 2), (-1.0) ** i * 3.0, 0.0] for i in range(uavs)])
    centre = np.stack(
        [
            rng.uniform(8.0, 108.0, obstacles),
            rng.uniform(-20.0, 20.0, obstacles),
            rng.uniform(-1.0, 1.0, obstacles),
        ],
        1,
    )
    radius = rng.uniform(0.5, 2.0, obstacles)
    state = np.zeros((1, uavs, 12))
    state[..., POSITION], state[..., VELOCITY] = lanes, (SPEED_MPS, 0.0, 0.0)
    state[..., POSITION] += rng.normal(size=(uavs, 3)) * 0.5
    plan = _cruise(state[..., POSITION], model)
    out = []
    for step in range(count):
        reference = np.zeros((1, uavs, model.stages, 12))
        ahead = SPEED_MPS * (0.1 * step + model.times_s)
        reference[..., POSITION] = lanes[:, None, :] + ahead[:, None] * np.array([1.0, 0.0, 0.0])
        reference[..., VELOCITY] = (SPEED_MPS, 0.0, 0.0)
        rows = _rows(plan, model, centre, radius, limit)
        horizon = HorizonQp(model, state.copy(), reference, rows)
        out.append(horizon)
        answer = solve(horizon)
        states, _ = resampled(answer[..., :12], answer[..., 12:], horizon)
        plan = states[..., POSITION]
        state = answer[:, :, 0, :12].copy()
        state[..., POSITION] += rng.normal(size=(1, uavs, 3)) * jump_m
        state[..., VELOCITY] += rng.normal(size=(1, uavs, 3)) * 0.02
        state[..., ATTITUDE] += rng.normal(size=(1, uavs, 3)) * 0.005
    return out


def resampled(states: Array, inputs: Array, horizon: HorizonQp) -> tuple[Array, Array]:
    """Plan as seen one period later, linear between its nodes: good enough for a guess, not to fly."""
    model = horizon.model
    nodes = np.concatenate([[0.0], model.times_s])
    path = np.concatenate([horizon.initial[:, :, None], states], axis=2)
    later = np.minimum(model.times_s + 0.1, nodes[-1])
    at = np.clip(np.searchsorted(nodes, later, side="right") - 1, 0, model.stages - 1)
    part = ((later - nodes[at]) / (nodes[at + 1] - nodes[at]))[:, None]
    # The input of a stage is that of the old stage that holds its middle.
    middle = np.searchsorted(model.times_s, model.times_s - 0.5 * model.step_s + 0.1)
    moved = path[:, :, at] * (1.0 - part) + path[:, :, at + 1] * part
    return moved, inputs[:, :, np.minimum(middle, model.stages - 1)]


def _cruise(position: Array, model: HorizonModel) -> Array:
    ahead: Array = SPEED_MPS * model.times_s[:, None] * np.array([1.0, 0.0, 0.0])
    return position[:, :, None] + ahead


def _rows(
    plan: Array, model: HorizonModel, centre: Array, radius: Array, limit: Rotors
) -> tuple[LinearRows, ...]:
    runs, uavs, stages = plan.shape[:3]
    shape = (runs, uavs, stages)
    offset = plan[:, :, :, None] - centre
    distance = np.linalg.norm(offset, axis=-1)
    nearest = np.argsort(distance - radius, axis=-1)[..., :4]
    normal = np.take_along_axis(offset / distance[..., None], nearest[..., None], axis=3)
    rho = np.take_along_axis(distance - radius, nearest, axis=3) - 0.3 - MARGIN_M
    bound = (normal * plan[:, :, :, None]).sum(-1) - rho
    near = rho < 10.0
    contact = np.where(near, bound, -np.inf)
    shell = np.where(near, bound + INFLUENCE_M, -np.inf)
    weight = GAIN / (INFLUENCE_M * np.maximum(rho, 0.3) ** 3)
    one, two, three = (np.ones((*shape, m)) for m in (1, 2, 3))
    other = plan[:, (np.arange(uavs)[:, None] + 1 + np.arange(3)) % uavs].transpose(0, 1, 3, 2, 4)
    apart = plan[:, :, :, None] - other
    gap = np.maximum(np.linalg.norm(apart, axis=-1), 1e-3)
    away = apart / gap[..., None]
    keep = np.where(gap < 10.0, (away * plan[:, :, :, None]).sum(-1) - gap + 2.0, -np.inf)
    axes = [np.broadcast_to(np.eye(3)[rows], (*shape, len(rows), 3)) for rows in ([0, 1, 2], [0, 1], [2])]
    speed, tilt, height = MAX_SPEED_MPS * three, MAX_TILT_RAD * two, MAX_HEIGHT_M * one
    return (
        LinearRows("position", normal, lower=contact, w1=100.0 * one, w2=50.0 * one, shared_slack=True),
        LinearRows("position", normal, lower=shell, w1=0.0 * weight, w2=weight),
        LinearRows("position", away, lower=keep, w1=100.0 * one, w2=50.0 * one, shared_slack=True),
        LinearRows("velocity", axes[0], lower=-speed, upper=speed, w1=50.0 * three, w2=10.0 * three),
        LinearRows("attitude", axes[1], lower=-tilt, upper=tilt, w1=50.0 * two, w2=10.0 * two),
        LinearRows("position", axes[2], lower=-height, upper=height, w1=50.0 * one, w2=10.0 * one),
        LinearRows(
            "input",
            np.broadcast_to(limit.matrix, (*shape, 4, 4)),
            lower=np.broadcast_to(limit.lower, (*shape, 4)),
            upper=np.broadcast_to(limit.upper, (*shape, 4)),
        ),
    )
