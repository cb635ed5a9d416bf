"""How long one RK4 step of the plant takes per UAV: CasADi's batch map against the generated numba code.

Run ``python benchmarks/plant_speed.py``; it prints the machine, the versions and one row per method and
batch size. Both integrate the same model with the same steps, and their results are compared first.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

import casadi as ca
import numpy as np

from napf_mpc.problem import Vehicle
from napf_mpc.provenance import processor
from napf_mpc.vehicle.plant import advance
from napf_mpc.vehicle.quadrotor import ATTITUDE, POSITION, RATES, VELOCITY, derivative_function, hover_input
from napf_mpc.vehicle.quadrotor import parameters as vehicle_parameters
from napf_mpc.vehicle.tracking import Array, tracking_law

STEP_S = 0.02
UAVS = 4


def casadi_step(vehicle: Vehicle, count: int) -> Callable[[Array, Array], Array]:
    """Return one RK4 step as a CasADi map over columns: (count, 12), (count, 4) -> (count, 12)."""
    x, u = ca.SX.sym("x", 12), ca.SX.sym("u", 4)
    f, p = derivative_function(), ca.DM(vehicle_parameters(vehicle))
    k1 = f(x, u, p)
    k2 = f(x + STEP_S / 2 * k1, u, p)
    k3 = f(x + STEP_S / 2 * k2, u, p)
    k4 = f(x + STEP_S * k3, u, p)
    after = x + STEP_S / 6 * (k1 + 2 * (k2 + k3) + k4)
    mapped: Any = ca.Function("step", [x, u], [after], {"cse": True}).map(count)
    out = np.empty((count, 12))
    buffer, trigger = mapped.buffer()
    buffer.set_res(0, out.data)

    def step(states: Array, inputs: Array) -> Array:
        # Column-major matrices of columns are row-major arrays of rows: no copy in either direction.
        buffer.set_arg(0, states.data)
        buffer.set_arg(1, inputs.data)
        trigger()
        return out

    return step


def numba_step(vehicle: Vehicle, start: Array, inputs: Array) -> Callable[[], None]:
    """Return one RK4 step of the plant from ``start``, always the same (large angles slow sin down)."""
    state, p, active = start.copy(), vehicle_parameters(vehicle), np.ones(len(start), dtype=bool)

    def step() -> None:
        state[:] = start
        advance(state, inputs, p, STEP_S, 1, active)

    return step


def seconds(call: Callable[[], object], repeats: int) -> Array:
    """Time of each of many calls, after ten to warm up [s]."""
    for _ in range(10):
        call()
    taken = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter()
        call()
        taken[i] = time.perf_counter() - start
    return taken


def machine() -> str:
    """One line about where this runs."""
    return f"{processor()}, {os.cpu_count()} CPUs, {platform.system()} {platform.release()}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--runs", type=int, nargs="+", default=[1, 32, 1000], help="runs of four UAVs in a batch"
    )
    parser.add_argument("--repeats", type=int, default=300, help="timed calls of each")
    arguments = parser.parse_args()
    if min(arguments.runs) < 1 or arguments.repeats < 1:
        parser.error("runs and repeats must be 1 or more")

    print(machine())
    print(
        f"python {platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "casadi"))
    )
    print(f"one thread, {arguments.repeats} calls each; microseconds per UAV and {STEP_S:g} s step")
    print(f"{'method':<28}{'runs x UAVs':>13}{'median':>10}{'p99':>10}")
    vehicle = Vehicle()
    law, p = tracking_law(vehicle), vehicle_parameters(vehicle)
    rng = np.random.default_rng(0)
    for runs in arguments.runs:
        count = runs * UAVS
        state = 0.1 * rng.normal(size=(runs, UAVS, 12))
        inputs = hover_input(vehicle) + 0.01 * rng.normal(size=(runs, UAVS, 4))
        active = np.ones(runs, dtype=bool)
        flat_state, flat_inputs = state.reshape(count, 12).copy(), inputs.reshape(count, 4).copy()
        by_casadi = casadi_step(vehicle, count)
        stepped = state.copy()
        advance(stepped, inputs, p, STEP_S, 1, active)
        worst = np.abs(by_casadi(flat_state, flat_inputs) - stepped.reshape(count, 12)).max()
        if not worst < 1e-12:
            print(f"the two disagree by {worst:g}", file=sys.stderr)
            return 1
        at, moving, tilted, turning = (
            np.ascontiguousarray(state[..., part]) for part in (POSITION, VELOCITY, ATTITUDE, RATES)
        )
        zeros, yaw, extra = np.zeros((runs, UAVS, 3)), np.zeros((runs, UAVS)), np.zeros((runs, UAVS, 4))
        rows: list[tuple[str, Callable[[], object]]] = [
            ("RK4, casadi map", partial(by_casadi, flat_state, flat_inputs)),
            ("RK4, generated numba", numba_step(vehicle, state, inputs)),
            (
                "inner loop, numba",
                partial(law.inputs, at, moving, tilted, turning, zeros, zeros, zeros, yaw, extra, active),
            ),
        ]
        for name, call in rows:
            taken = seconds(call, arguments.repeats) / count * 1e6
            median, p99 = np.quantile(taken, [0.5, 0.99])
            print(f"{name:<28}{f'{runs} x {UAVS}':>13}{median:>10.3f}{p99:>10.3f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
