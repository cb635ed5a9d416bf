"""What the linearisation costs: the same programs with the nonlinear quadrotor, their times and first inputs.

There is no certificate for these: another local optimum is another answer, and the quadratic program's
conditions are not theirs. What IPOPT claims is shown beside how well its point keeps rows and dynamics.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from napf_mpc.benchmark.contenders import CONTENDERS, OSQP, Scene
from napf_mpc.benchmark.nmpc import NonlinearProgram
from napf_mpc.benchmark.programs import Step, programs_of
from napf_mpc.benchmark.solvers import SOLVED, gain, input_span, timed
from napf_mpc.problem import Problem
from napf_mpc.qp import Array, HorizonQp, Layout
from napf_mpc.solvers.batch import make_batch_solver

KERNEL = "kernel"
NONLINEAR, NONLINEAR_COLD = "nonlinear, warm", "nonlinear, cold"
"""Labels: from the flight's own last answer, and from hover where the UAV is."""


@dataclass(frozen=True)
class NonlinearRow:
    """One contender on one program."""

    scene: str
    contender: str
    step: int
    """Which of the scene's."""
    run: int
    uav: int
    claimed: bool
    """The solver calls it solved."""
    iterations: int
    input_off: float
    """Largest difference of a first input to the quadratic program's, as part of its range."""
    violation: float
    """Largest violation of rows and nonlinear dynamics, see :meth:`~.nmpc.NonlinearProgram.violation`."""
    cpu_us: float
    """Thread-CPU time."""
    wall_us: float
    """Wall time."""


def measure_nonlinear(
    label: str, scene: Scene, *, missions: int, every: int, seed: int
) -> list[NonlinearRow]:
    """Quadratic and nonlinear contenders on programs of a scene, one program of each mission and step.

    Parameters
    ----------
    label : str
        Of the scene.
    scene : Scene
        What is flown, by the quadratic programs.
    missions, every, seed : int
        Of the flights, see :func:`~.programs.programs_of`.

    Returns
    -------
    list of NonlinearRow
        The first step is left out: it pays for what is done once.

    Raises
    ------
    ProblemError
        If the flights are too short to keep two steps.
    """
    problem, steps = programs_of(label, scene, missions=missions, every=every, seed=seed)
    return list(_of_scene(label, problem, steps))


def _of_scene(label: str, problem: Problem, steps: Sequence[Step]) -> Iterator[NonlinearRow]:
    span = input_span(problem.vehicle)
    program = NonlinearProgram(problem.vehicle, steps[0].horizon)
    solvers = {name: CONTENDERS[name].make() for name in (KERNEL, OSQP)}
    exact = make_batch_solver(KERNEL)
    order = [KERNEL, OSQP, NONLINEAR, NONLINEAR_COLD]
    for number, step in enumerate(steps):
        for run in np.flatnonzero(step.active).tolist():
            uav = (number + run) % step.horizon.shape[1]
            shown = step.of_one(run, uav)
            truth = exact.solve_batch(shown.horizon).inputs[0, 0, 0]
            order = order[1:] + order[:1]
            for name in order:
                if name in solvers:
                    solve = partial(solvers[name].solve_batch, shown.horizon, shown.warm)
                    answer, cpu, wall = timed(solve)
                    claimed, z = bool(answer.status[0, 0] == SOLVED), answer.z[0, 0]
                    iterations = int(answer.iterations[0, 0])
                else:
                    guess = None
                    if name == NONLINEAR and shown.warm is not None:
                        guess = shown.warm.z[0, 0], shown.warm.y[0, 0]
                    said, cpu, wall = timed(partial(program.solve, shown.horizon, guess))
                    claimed, z, iterations = said.solved, said.z, said.iterations
                if number > 0:
                    yield NonlinearRow(
                        label, name, number, run, uav, claimed, iterations,
                        _off(shown.horizon, z, truth, span), program.violation(shown.horizon, z), 1e6 * cpu,
                        1e6 * wall,
                    )  # fmt: skip


def _off(horizon: HorizonQp, z: Array, truth: Array, span: Array) -> float:
    """Largest difference of a first input, as part of its range; infinite without an answer."""
    off = np.abs(Layout.of(horizon).inputs(z)[0] - truth) / span
    return float(off.max()) if np.isfinite(off).all() else float("inf")


@dataclass(frozen=True)
class NonlinearSummary:
    """One contender in one scene."""

    scene: str
    contender: str
    programs: int
    claimed: int
    iterations: float
    """Median."""
    off_median: float
    """Difference of the first input to the quadratic program's, as part of its range: median, ..."""
    off_p95: float
    """... 95th percentile (a program's own value: there may be infinite ones) and ..."""
    off_max: float
    """... the largest."""
    violation: float
    """Median of the largest violations of a program."""
    median_us: float
    p95_us: float
    max_us: float
    gain: tuple[float, float, float]
    """Time of OSQP, warm, over this one's, program by program: median and its 95 % interval."""


def nonlinear_summaries(rows: Sequence[NonlinearRow]) -> list[NonlinearSummary]:
    """Per scene and contender, in the order of the labels; answers count whatever was claimed of them."""
    of: dict[tuple[str, str], list[NonlinearRow]] = {}
    for scene in dict.fromkeys(row.scene for row in rows):
        for name in (KERNEL, OSQP, NONLINEAR, NONLINEAR_COLD):
            of[scene, name] = [row for row in rows if (row.scene, row.contender) == (scene, name)]
    out = []
    for (scene, name), own in of.items():
        off, times = np.array([row.input_off for row in own]), np.array([row.cpu_us for row in own])
        out.append(
            NonlinearSummary(
                scene, name, len(own), sum(row.claimed for row in own),
                float(np.median([row.iterations for row in own])), float(np.median(off)),
                float(np.quantile(off, 0.95, method="higher")), float(off.max()),
                float(np.median([row.violation for row in own])), float(np.median(times)),
                float(np.quantile(times, 0.95)), float(times.max()),
                gain([row.cpu_us for row in of[scene, OSQP]], times.tolist()),
            )
        )  # fmt: skip
    return out
