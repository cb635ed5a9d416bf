"""Random programs of the planner's family: all kinds of rows, prices over decades, some not to be kept."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from napf_mpc.constraints.constraint import LinearRows
from napf_mpc.problem import Vehicle
from napf_mpc.qp import HorizonModel, HorizonQp
from napf_mpc.vehicle.quadrotor import discretize, hover_input, linearize, mixer_inverse, rotor_limit

Array = NDArray[np.float64]
VEHICLE = Vehicle()
ROTORS = mixer_inverse(VEHICLE)
ROTOR_LOW = -ROTORS @ hover_input(VEHICLE)
ROTOR_HIGH = rotor_limit(VEHICLE) + ROTOR_LOW
GRID = (0.1, 0.1, 0.1, 0.2, 0.4, 0.6)
LONG_GRID = (0.1,) * 5 + (0.2,) * 5 + (0.4,) * 5 + (0.6,) * 5
INF = np.inf
MODELS: dict[str, tuple[tuple[float, ...], float]] = {
    "uneven": (GRID, 0.0),
    "planner": (LONG_GRID, 0.0),
    "turned": (GRID, 0.7),
    "even": ((0.1,) * 12, 0.0),
    "one_stage": ((0.5,), 0.0),
    "fine": ((0.05,) * 30, -2.0),
}
"""Name -> stage grid [s] and yaw [rad]."""


@functools.cache
def hover_model(grid: tuple[float, ...] = GRID, yaw_rad: float = 0.0) -> HorizonModel:
    """Hover model on a stage grid [s], at a yaw [rad], with a Riccati terminal weight."""
    step = np.array(grid)
    pairs = [discretize(*linearize(VEHICLE, yaw_rad), float(s)) for s in step]
    a, b = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    q = np.diag([1.0] * 7 + [0.2, 1.0, 0.2, 1.0, 0.2]) * step[:, None, None]
    r = np.diag([0.1, 20.0, 20.0, 20.0]) * step[:, None, None]
    q[-1] = solve_discrete_are(a[-1], b[-1], q[-1], r[-1])
    q[-1] = 0.5 * (q[-1] + q[-1].T)
    return HorizonModel(step, a, b, q, r)


def mixed(
    seed: int, runs: int = 2, uavs: int = 2, model: HorizonModel | None = None, far_m: float = 0.0
) -> HorizonQp:
    """All kinds of rows with random geometry and prices over four decades, some met, most not."""
    rng = np.random.default_rng(seed)
    model = hover_model() if model is None else model
    shape = (runs, uavs, model.stages)
    rough = rng.choice([0.1, 0.5, 2.0])
    initial = rough * rng.normal(size=(*shape[:2], 12)) * np.array([1, 1] * 3 + [0.1, 0.1] * 3)
    reference = np.zeros((*shape, 12))
    reference[..., 0] = 2.0 * model.times_s
    reference[..., 1] = 2.0
    reference[..., :6:2] += rough * rng.normal(size=(*shape[:2], 1, 3))
    initial[..., :6:2] += far_m
    reference[..., :6:2] += far_m

    def some(count: int, high: float = 3.0) -> Array:
        return np.asarray(10.0 ** rng.uniform(0.0, high, size=(*shape, count)))

    normal = rng.normal(size=(*shape, 4, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    gap = rng.uniform(-0.5, 3.0, size=(*shape, 4))
    near = (normal * reference[..., None, :6:2]).sum(-1) - gap
    near[rng.uniform(size=near.shape) < 0.4] = -INF
    apart = rng.normal(size=(*shape, 2, 3))
    keep = (apart * reference[..., None, :6:2]).sum(-1) - rng.uniform(0.0, 4.0, size=(*shape, 2))
    speed = np.broadcast_to(rng.normal(size=(5, 3)), (*shape, 5, 3))
    fast = np.full((*shape, 5), rng.uniform(1.0, 4.0))
    lean = np.full((*shape, 2), rng.uniform(0.05, 0.4))
    rows = (
        LinearRows("position", normal, lower=near, w1=some(1), w2=some(1), shared_slack=True),
        LinearRows("position", normal, lower=near + 1.5, w1=0.0 * some(4), w2=some(4, 2.0)),
        LinearRows(
            "position", apart, lower=keep, upper=keep + 9.0, w1=some(2), w2=some(2), shared_slack=False
        ),
        LinearRows("velocity", speed, -fast, fast, some(5), some(5)),
        LinearRows("attitude", np.broadcast_to(np.eye(3)[:2], (*shape, 2, 3)), -lean, lean, some(2), some(2)),
        LinearRows(
            "input",
            np.broadcast_to(ROTORS, (*shape, 4, 4)),
            np.broadcast_to(ROTOR_LOW, (*shape, 4)),
            np.broadcast_to(ROTOR_HIGH, (*shape, 4)),
        ),
    )
    horizon = HorizonQp(model, initial, reference, rows)
    horizon.check()
    return horizon
