"""How exact the kernel solver is: random programs of the planner's family by the hundred thousand.

Run ``python benchmarks/exactness.py --programs 1000000``. Programs are those of random_programs.py: rows on
position, velocity, attitude and inputs, soft ones with prices over decades, many that contradict each other.
Every answer is certified from the program's plain matrices: each KKT residual over one or its largest term.
The first ``--compared`` of every stage grid are solved by PIQP at 1e-12 as well, and the first ``--plain`` by
the method written down in plain NumPy: first inputs are compared as parts of their range, and objectives
relative to one or their own size. An answer of PIQP whose own certificate is worse than 1e-9 compares
nothing; it is counted apart.

The exit code is 1 if any program failed or was less exact than the limits printed.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass, field

import numpy as np
from plain_active_set import PlainActiveSet
from plant_speed import machine
from random_programs import MODELS, ROTOR_HIGH, ROTOR_LOW, ROTORS, Array, hover_model, mixed

from napf_mpc.campaign import versions
from napf_mpc.qp import HorizonQp, Layout, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult, BatchSolver, make_batch_solver
from napf_mpc.solvers.residuals import relative_residuals

SOLVED = STATUSES.index(QpStatus.SOLVED)
EXACT = {"eps_abs": 1e-12, "eps_rel": 1e-12, "check_duality_gap": True}
RUNS, UAVS = 64, 4
RESIDUAL, INPUT, OBJECTIVE = 1e-9, 1e-6, 1e-8
INPUT_RANGE = np.abs(np.linalg.inv(ROTORS)) @ (ROTOR_HIGH - ROTOR_LOW)
"""(4,) widest span of each input [N, N m]."""


def certified(horizon: HorizonQp, result: BatchResult) -> Array:
    """(run, uav) largest relative KKT residual of the answers, from the plain matrices."""
    layout = Layout.of(horizon)
    return relative_residuals(layout.sparsity, layout.values(horizon), result.z, result.y)


@dataclass
class Compared:
    """Differences to another method's answers."""

    count: int = 0
    unusable: int = 0
    """Answers of the other that prove nothing."""
    first_input: float = 0.0
    """Largest difference over the input's range."""
    objective: float = 0.0
    """Largest relative difference by which the kernel's objective is the worse one."""

    def add(self, mine: Array, theirs: Array) -> None:
        """First inputs (4,)."""
        self.count += 1
        self.first_input = max(self.first_input, float((np.abs(mine - theirs) / INPUT_RANGE).max()))


@dataclass
class Findings:
    """Of one stage grid."""

    programs: int = 0
    failed: int = 0
    worst: float = 0.0
    """Largest relative KKT residual of those solved."""
    short: int = 0
    """Solved, and above the limit."""
    cpu_s: float = 0.0
    """Thread-CPU time of the solver."""
    piqp: Compared = field(default_factory=Compared)
    plain: Compared = field(default_factory=Compared)

    @property
    def sound(self) -> bool:
        """Whether all limits were kept."""
        near = all(c.first_input <= INPUT and c.objective <= OBJECTIVE for c in (self.piqp, self.plain))
        return self.failed == 0 and self.short == 0 and near


def compare(horizon: HorizonQp, mine: BatchResult, other: BatchSolver, count: int, found: Compared) -> None:
    """Show the first ``count`` programs to PIQP too."""
    theirs = other.solve_batch(horizon)
    residual = certified(horizon, theirs)
    for run, uav in list(np.ndindex(*mine.status.shape))[:count]:
        if mine.status[run, uav] != SOLVED:
            continue  # counted as failed
        if theirs.status[run, uav] != SOLVED or not residual[run, uav] <= RESIDUAL:
            found.unusable += 1
            continue
        program = horizon.assemble(run, uav)
        ours, best = (program.objective(r.z[run, uav]) for r in (mine, theirs))
        found.objective = max(found.objective, (ours - best) / max(1.0, abs(best)))
        found.add(mine.inputs[run, uav, 0], theirs.inputs[run, uav, 0])


def examine(grid: str, programs: int, compared: int, plain: int, seed: int) -> Findings:
    """Solve programs of one stage grid and certify all answers."""
    model, found = hover_model(*MODELS[grid]), Findings()
    solver = make_batch_solver("kernel")
    piqp = make_batch_solver("piqp", **EXACT) if compared else None
    while found.programs < programs:
        horizon = mixed(seed, RUNS, UAVS, model)
        began = time.thread_time()
        result = solver.solve_batch(horizon)
        found.cpu_s += time.thread_time() - began
        solved = result.status == SOLVED
        residual = certified(horizon, result)[solved]
        done = found.programs
        found.programs += solved.size
        found.failed += int((~solved).sum())
        found.short += int((~(residual <= RESIDUAL)).sum())
        found.worst = max(found.worst, float(residual.max(initial=0.0)))
        if piqp is not None and done < compared:
            compare(horizon, result, piqp, compared - done, found.piqp)
        for run, uav in list(np.ndindex(*solved.shape))[: max(0, plain - done)]:
            if not solved[run, uav]:
                continue
            status, inputs = PlainActiveSet(horizon, run, uav).solve()
            if status is QpStatus.SOLVED:
                found.plain.add(result.inputs[run, uav, 0], inputs[:4])
            else:
                found.plain.unusable += 1
        seed += 1
    return found


def main() -> int:
    """Examine all stage grids and print a row for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--programs", type=int, default=60_000, help="in all")
    parser.add_argument("--compared", type=int, default=200, help="of each grid, with PIQP")
    parser.add_argument("--plain", type=int, default=200, help="of each grid, with plain NumPy")
    parser.add_argument("--seed", type=int, default=10_000)
    options = parser.parse_args()
    print(machine(), platform.python_version(), versions())
    print(f"limits: residual {RESIDUAL:g}, first input {INPUT:g} of its range, objective {OBJECTIVE:g}")
    print("| grid | stages | programs | failed | above the limit | worst residual | us each, cold ", end="")
    print("| PIQP: compared (unusable) | input | objective | plain NumPy: compared (unusable) | input |")
    print("|" + "---|" * 12)
    sound, total = True, 0
    for n, grid in enumerate(MODELS):
        # Programs of different grids do not share their random numbers either.
        found = examine(
            grid, -(-options.programs // len(MODELS)), options.compared, options.plain,
            options.seed + 1_000_000 * n,
        )  # fmt: skip
        print(
            f"| {grid} | {len(MODELS[grid][0])} | {found.programs} | {found.failed} | {found.short} "
            f"| {found.worst:.1e} | {1e6 * found.cpu_s / found.programs:.0f} "
            f"| {found.piqp.count} ({found.piqp.unusable}) | {found.piqp.first_input:.1e} "
            f"| {found.piqp.objective:.1e} | {found.plain.count} ({found.plain.unusable}) "
            f"| {found.plain.first_input:.1e} |",
            flush=True,
        )
        sound &= found.sound
        total += found.programs
    print(f"{total} programs: " + ("all limits kept" if sound else "LIMITS NOT KEPT"))
    return 0 if sound else 1


if __name__ == "__main__":
    raise SystemExit(main())
