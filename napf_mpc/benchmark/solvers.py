"""Solvers on the same programs: time, what they claim, and what of it is true.

A program is shown to all contenders one after the other, in an order that moves on from program to program,
so that whatever else the machine does falls on all alike. Time is that of a whole call: assembly, checks,
solve, residuals. *Alone* is a call for one program; *together* one for all of a step, over their number.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from scipy.stats import binom

from napf_mpc.benchmark.contenders import (
    OSQP,
    REFERENCE,
    REFERENCE_SETTINGS,
    Contender,
    Scene,
    present,
)
from napf_mpc.benchmark.programs import Step, programs_of
from napf_mpc.problem import Problem, Vehicle
from napf_mpc.qp import Array, HorizonQp, Layout, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult, BatchSolver, make_batch_solver
from napf_mpc.solvers.residuals import relative_residuals
from napf_mpc.vehicle.quadrotor import mixer, rotor_limit

T = TypeVar("T")

SOLVED = STATUSES.index(QpStatus.SOLVED)
CORRECT = 1e-3
"""A first input is correct if it is no farther than this part of its range from the reference."""
ALONE, TOGETHER = "alone", "together"


@dataclass(frozen=True)
class Row:
    """One contender on one program, or on all programs of a step."""

    scene: str
    contender: str
    calls: str
    """:data:`ALONE` or :data:`TOGETHER`."""
    step: int
    """Which of the scene's."""
    run: int
    """Whose program; -1 for all."""
    uav: int
    """The same."""
    programs: int
    """In the call."""
    claimed: int
    """Programs that the solver calls solved."""
    correct: int
    """Programs whose first input is that of the reference, whatever the solver says."""
    residual: float
    """Largest KKT residual, each over one or its largest term."""
    input_error: float
    """Largest difference of a first input to the reference, as part of its range."""
    cpu_us: float
    """Thread-CPU time a program."""
    wall_us: float
    """Wall time a program."""


def installed(contenders: Mapping[str, Contender], tell: Callable[[str], None]) -> dict[str, Contender]:
    """Contenders whose packages are there; ``tell`` is told of the others.

    Raises
    ------
    SolverError
        If none is there, or the reference is not.
    """
    make_batch_solver(REFERENCE, **REFERENCE_SETTINGS)
    return present(contenders, Contender.make, tell)


def measure(
    label: str, scene: Scene, contenders: Mapping[str, Contender], *, missions: int, every: int, seed: int
) -> list[Row]:
    """All contenders on the programs of a scene.

    Parameters
    ----------
    label : str
        Of the scene, such as in :data:`~.contenders.SCENES`.
    scene : Scene
        What is flown.
    contenders : mapping
        By label, such as :data:`~.contenders.CONTENDERS`; all installed.
    missions, every, seed : int
        Of the flights, see :func:`~.programs.programs_of`.

    Returns
    -------
    list of Row
        The first step is left out: it pays for what is done once.

    Raises
    ------
    ProblemError
        If the flights are too short to keep two steps.
    """
    problem, steps = programs_of(label, scene, missions=missions, every=every, seed=seed)
    reference = make_batch_solver(REFERENCE, **REFERENCE_SETTINGS)
    return list(_of_scene(label, problem, steps, contenders, reference))


def _of_scene(
    label: str,
    problem: Problem,
    steps: Sequence[Step],
    contenders: Mapping[str, Contender],
    reference: BatchSolver,
) -> Iterator[Row]:
    span = input_span(problem.vehicle)
    solvers = {name: {ALONE: c.make(), TOGETHER: c.make()} for name, c in contenders.items()}
    names = order = list(contenders)
    for number, step in enumerate(steps):
        uavs = step.horizon.shape[1]
        whose = [(run, (number + run) % uavs) for run in np.flatnonzero(step.active).tolist()]
        shows = [(ALONE, at, step.of_one(*at)) for at in whose] + [(TOGETHER, (-1, -1), step)]
        for calls, at, shown in shows:
            truth = reference.solve_batch(shown.horizon, None, shown.active)
            rows = {}
            order = order[1:] + order[:1]
            for name in order:
                contender = contenders[name]
                solver = solvers[name][calls]
                if not contender.keep:
                    solver.reset()
                warm = shown.warm if contender.warm else None
                answer, cpu, wall = timed(partial(solver.solve_batch, shown.horizon, warm, shown.active))
                off = _input_error(answer, truth, span)[shown.active]
                rows[name] = Row(
                    label, name, calls, number, *at, shown.programs,
                    int((answer.status[shown.active] == SOLVED).sum()), int((off <= CORRECT).sum()),
                    float(_residual(shown.horizon, answer)[shown.active].max()), float(off.max()),
                    1e6 * cpu / shown.programs, 1e6 * wall / shown.programs,
                )  # fmt: skip
            if number > 0:
                yield from (rows[name] for name in names)


def input_span(vehicle: Vehicle) -> Array:
    """Range (4,) of each input that the rotors allow [N, N m]."""
    return np.asarray(np.abs(mixer(vehicle)).sum(1) * rotor_limit(vehicle))


def timed(call: Callable[[], T]) -> tuple[T, float, float]:
    """Answer of a call, its thread-CPU and wall time [s]; collecting garbage is nobody's part."""
    collects = gc.isenabled()
    gc.disable()
    try:
        wall, cpu = time.perf_counter(), time.thread_time()
        answer = call()
        return answer, time.thread_time() - cpu, time.perf_counter() - wall
    finally:
        if collects:
            gc.enable()


def _input_error(answer: BatchResult, truth: BatchResult, span: Array) -> Array:
    """(run, uav) of first inputs, as part of their range; infinite without an answer."""
    off = np.abs(answer.inputs[:, :, 0] - truth.inputs[:, :, 0]) / span
    return np.asarray(np.where(np.isfinite(off), off, np.inf).max(-1))


def _residual(horizon: HorizonQp, answer: BatchResult) -> Array:
    layout = Layout.of(horizon)
    return relative_residuals(layout.sparsity, layout.values(horizon), answer.z, answer.y)


@dataclass(frozen=True)
class Summary:
    """One contender in one scene: calls for single programs, and its time in a batch."""

    scene: str
    contender: str
    calls: int
    """For single programs: the quantiles are of these."""
    programs: int
    """In all calls."""
    claimed: int
    correct: int
    residual: float
    input_error: float
    median_us: float
    p95_us: float
    p99_us: float
    max_us: float
    together_us: float
    """Median over steps."""
    alone_gain: tuple[float, float, float]
    """OSQP's time over this one's, program by program: median and its 95 % interval."""
    together_gain: tuple[float, float, float]
    """The same, step by step."""


def summaries(rows: Sequence[Row]) -> list[Summary]:
    """Per scene and contender; thread-CPU times. Failed answers count with the time they took."""
    of: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        of.setdefault((row.scene, row.contender, row.calls), []).append(row)
    out = []
    for (scene, contender, calls), alone in of.items():
        if calls != ALONE:
            continue
        batch = of[scene, contender, TOGETHER]
        everything = [*alone, *batch]
        times = np.array([row.cpu_us for row in alone])
        median, p95, p99, most = np.quantile(times, [0.5, 0.95, 0.99, 1.0]).tolist()
        out.append(
            Summary(
                scene,
                contender,
                len(alone),
                sum(row.programs for row in everything),
                sum(row.claimed for row in everything),
                sum(row.correct for row in everything),
                max(row.residual for row in everything),
                max(row.input_error for row in everything),
                median,
                p95,
                p99,
                most,
                float(np.median([row.cpu_us for row in batch])),
                gain(_times(of.get((scene, OSQP, ALONE), ())), _times(alone)),
                gain(_times(of.get((scene, OSQP, TOGETHER), ())), _times(batch)),
            )
        )
    return out


def _times(rows: Sequence[Row]) -> list[float]:
    return [row.cpu_us for row in rows]


def gain(rival: Sequence[float], mine: Sequence[float]) -> tuple[float, float, float]:
    """Median of a rival's times over mine, call by call, with the 95 % interval of its order statistics.

    Without a rival there is none; of fewer than six calls no interval holds the median with 95 %.
    """
    if not rival:
        return np.nan, np.nan, np.nan
    ratio = np.sort(np.array(rival) / np.array(mine))
    rank = int(binom.ppf(0.025, len(ratio), 0.5))
    if rank < 1:
        return float(np.median(ratio)), np.nan, np.nan
    return float(np.median(ratio)), float(ratio[rank - 1]), float(ratio[-rank])
