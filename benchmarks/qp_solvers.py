"""How long the solvers take for the program of one UAV, and how exact their first input is.

Run ``python benchmarks/qp_solvers.py``; it prints the machine, the versions, and a row per scene and solver.
Times are thread-CPU times of a whole step (assembly, checks, solve, residuals), its mean over the UAVs: the
worst single UAV is slower than the worst step. All solvers get the same programs, made by a flight on exact
answers; warm starts are the solver's own last answer, re-sampled.

Programs of the planner's own missions, with more contenders, are timed by ``napf-mpc benchmark solvers``.
"""

from __future__ import annotations

import argparse
import gc
import platform
import time
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from horizon_sequence import fly, horizon_model, resampled, rotors
from plant_speed import machine

from napf_mpc.problem import Vehicle
from napf_mpc.qp import Array, HorizonQp
from napf_mpc.solvers.acceptance import AcceptanceLimits, accepted
from napf_mpc.solvers.batch import BatchResult, BatchSolver, WarmStart, make_batch_solver
from napf_mpc.solvers.solver import SolverError

EXACT = "piqp"
"""The solver whose answers count as true, at :data:`EXACT_SETTINGS`."""
EXACT_SETTINGS = {"eps_abs": 1e-10, "eps_rel": 1e-10, "check_duality_gap": True}
SCENES = (("8 spheres, filter", 8, 0.05), ("40 spheres, filter", 40, 0.05), ("40 spheres, raw", 40, 0.6))
"""Name, obstacles in 100 m, navigation jump a step and axis [m]."""
UAVS = 4


@dataclass(frozen=True)
class Way:
    """A way to solve the sequence."""

    name: str
    solver: str
    keep: bool = True
    """Keep workspaces from step to step."""
    warm: bool = True
    """Start from the last answer."""


WAYS = (
    Way("kernel", "kernel"),
    Way("osqp, kept and warm", "osqp"),
    Way("osqp, kept, cold", "osqp", warm=False),
    Way("osqp, setup each step", "osqp", keep=False, warm=False),
    Way("piqp", "piqp", warm=False),
    Way("daqp", "daqp", warm=False),
    Way("clarabel", "clarabel", warm=False),
)


def exact_flight(
    obstacles: int, jump_m: float, count: int, seed: int
) -> tuple[list[HorizonQp], list[BatchResult]]:
    """Programs of a flight and their exact answers."""
    solver, answers = make_batch_solver(EXACT, **EXACT_SETTINGS), []

    def solve(horizon: HorizonQp) -> Array:
        answers.append(solver.solve_batch(horizon))
        return np.concatenate([answers[-1].states, answers[-1].inputs], axis=-1)

    return fly(solve, count=count, uavs=UAVS, obstacles=obstacles, jump_m=jump_m, seed=seed), answers


def timed(way: Way, horizons: list[HorizonQp]) -> tuple[Array, list[BatchResult]]:
    """Thread-CPU seconds per UAV of every step after the first, and all answers."""
    solver: BatchSolver = make_batch_solver(way.solver)
    seconds, answers = [], []
    warm: WarmStart | None = None
    for horizon in horizons:
        start = time.thread_time()
        answer = solver.solve_batch(horizon, warm)
        seconds.append((time.thread_time() - start) / UAVS)
        answers.append(answer)
        if way.warm:
            warm = answer.warm_start(*resampled(answer.states, answer.inputs, horizon))
        if not way.keep:
            solver.reset()
    return np.array(seconds[1:]), answers


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=150, help="steps of 0.1 s in each scene")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.steps < 2:
        parser.error("steps must be 2 or more")

    print(machine())
    packages = ("numpy", "osqp", "qpsolvers", "piqp", "daqp", "clarabel")
    print(f"python {platform.python_version()}, " + ", ".join(f"{name} {version(name)}" for name in packages))
    limit = rotors(Vehicle())
    limits = AcceptanceLimits.of(horizon_model(Vehicle()), limit.matrix, limit.lower, limit.upper)
    print(
        f"\n{UAVS} UAVs, {arguments.steps} steps; thread-CPU milliseconds per UAV and step, thrust error [N]"
    )
    print(
        f"{'scene':<20}{'solver':<24}{'median':>8}{'p99':>8}{'max':>8}{'iterations':>12}"
        f"{'p99':>6}{'error p50':>11}{'p99':>9}{'max':>9}{'refused':>9}"
    )
    for scene, obstacles, jump_m in SCENES:
        horizons, exact = exact_flight(obstacles, jump_m, arguments.steps, arguments.seed)
        for way in WAYS:
            try:
                timed(way, horizons[:3])
            except SolverError as error:
                print(f"{scene:<20}{way.name:<24}{error}")
                continue
            gc.collect()
            seconds, answers = timed(way, horizons)
            median, p99, worst = np.quantile(seconds * 1e3, [0.5, 0.99, 1.0])
            iterations = np.array([answer.iterations for answer in answers[1:]])
            pairs = list(zip(answers, exact, strict=True))[1:]
            off = np.array([np.abs(mine.inputs - best.inputs)[:, :, 0, 0] for mine, best in pairs])
            errors = np.nanquantile(off, [0.5, 0.99, 1.0])
            refused = sum(int((~accepted(answer, limits)).sum()) for answer in answers)
            print(
                f"{scene:<20}{way.name:<24}{median:>8.2f}{p99:>8.2f}{worst:>8.2f}"
                f"{np.median(iterations):>12.0f}{np.quantile(iterations, 0.99):>6.0f}"
                f"{errors[0]:>11.1e}{errors[1]:>9.1e}{errors[2]:>9.1e}"
                f"{f'{refused}/{len(answers) * UAVS}':>9}"
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
