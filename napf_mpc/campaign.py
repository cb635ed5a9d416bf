"""Many missions: the same seeds for every planner, in blocks over workers, nothing lost.

Each finished block is kept at once, so repeating the command goes on where it stopped. No result depends on
block size, order, worker or machine; wall times are kept apart from results.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from napf_mpc import store
from napf_mpc.block import Block, Missions, check_campaign, fly_block, lost_block, simulate
from napf_mpc.campaign_folder import Blocks, conclude, taken
from napf_mpc.closed_loop import Scenario, build_scenario
from napf_mpc.cluster import connected
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import Outcome
from napf_mpc.own_parts import OwnParts
from napf_mpc.planners.registry import make_planner
from napf_mpc.prefix import Prefix
from napf_mpc.problem import Problem
from napf_mpc.provenance import identity, versions
from napf_mpc.scenario_file import write_scenario
from napf_mpc.solvers.batch import check_solver_name
from napf_mpc.solvers.solver import SolverError
from napf_mpc.summary import summarise
from napf_mpc.words import shown_value
from napf_mpc.workers import Lost, in_pool, in_workers

__all__ = [
    "Block",
    "Missions",
    "check_flyable",
    "check_solver",
    "compare",
    "fly_block",
    "run_campaign",
    "simulate",
    "versions",
]

BLOCK_UAVS = 1024
"""UAVs flown in lock-step, at most: enough to hide Python, few enough for the processor's cache."""
BLOCK_FIXES = 4_000_000
"""Position fixes drawn at a time, at most: about half a gigabyte."""
BLOCK_OBSTACLES = 1_000_000
"""Obstacles of all runs of a block, at most."""
BLOCK_MOVING = 20_000
"""Moving obstacles of all runs of a block, at most: each has noise and accelerations of its own."""
BLOCK_SAMPLES = 200_000
"""Rows of trajectories of a block, at most: about 60 megabytes."""
WORTH_A_WORKER = 32
"""Runs below which another process costs more than it gains."""


def compare(
    problem: Problem,
    planners: Sequence[str] = ("apf", "napf"),
    *,
    runs: int = 30,
    seed: int = 0,
    data_folder: Path | None = None,
) -> dict[str, Any]:
    """Fly planners on the same seeds in this process and summarise (the paper's Table 1 for any problem).

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planners : sequence of str
        Names of planners, shipped or registered.
    runs, seed : int
        Number of runs and campaign seed.
    data_folder : Path, optional
        Where data files lie.

    Returns
    -------
    dict
        Summary with rates, intervals and paired tests; the layout of ``summary.json``.

    Raises
    ------
    NapfError
        If a setting or the problem is not usable, or data are missing.
    """
    check_campaign(planners, runs, seed)
    scenario = check_flyable(problem, planners, seed, data_folder)
    size = block_size(problem, scenario, runs)
    flown = [fly_block(problem, planners, seed, runs, data_folder) for runs in chunks(range(runs), size)]
    rows = store.stack([block.rows for block in flown])
    return summarise(rows, identity(problem, problem.title, planners, seed, data_folder))


def run_campaign(
    problem: Problem,
    planners: Sequence[str],
    runs: int,
    seed: int,
    out: str | Path,
    *,
    name: str = "problem",
    workers: int = 1,
    block_runs: int | None = None,
    data_folder: Path | None = None,
    record_every: int = 0,
    cluster: str | None = None,
    block_limit_s: float | None = None,
    enough: Callable[[store.Columns], bool] | None = None,
    progress: Callable[[int], None] = lambda done: None,
    warn: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Fly a campaign into a folder, going on where an earlier call of the same campaign stopped.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planners : sequence of str
        Names of planners, shipped or registered; all fly the same seeds.
    runs, seed : int
        Number of runs and campaign seed. A later call with more runs flies the missing ones only.
    out : str or Path
        Output folder, see :mod:`napf_mpc.campaign_folder`.
    name : str
        Problem's name in the summary.
    workers : int
        Processes; they are sent planners and a solver that were registered in this one.
    block_runs : int, optional
        Runs flown in lock-step; changes no result.
    data_folder : Path, optional
        Where data files lie.
    record_every : int
        Keep every n-th tick in ``trajectories.parquet``; 0 for none.
    cluster : str, optional
        Address of a running ``dask.distributed`` scheduler that flies the blocks instead of our own workers.
    block_limit_s : float, optional
        Time [s] after which a worker counts as hung with its block; see :func:`napf_mpc.workers.in_pool`.
    enough : callable, optional
        Stopping rule, asked about the rows of the first runs whenever those of the next one of
        :func:`napf_mpc.prefix.looks` are all there. If it says yes, the campaign has that many runs.
    progress : callable
        Told the number of runs finished so far.
    warn : callable
        Told about every block that was lost twice and filed.

    Returns
    -------
    dict
        The summary, as written to ``summary.json``.

    Raises
    ------
    ProblemError
        If a setting or the problem is not usable.
    DataError
        If data are missing, or a finished block is damaged.
    OutputError
        If the folder holds other results, is in use, or cannot be written.
    """
    check_campaign(planners, runs, seed, workers, record_every)
    # JSON does not take those of NumPy.
    runs, seed, record_every = int(runs), int(seed), int(record_every)
    if block_limit_s is not None and not 0.0 < block_limit_s < float("inf"):
        raise ProblemError("campaign", [f"block-limit = {shown_value(block_limit_s)}: must be > 0 seconds"])
    scenario = check_flyable(problem, planners, seed, data_folder)
    origin = identity(problem, name, planners, seed, data_folder) | {"record_every": record_every}
    own = OwnParts.of(problem, planners)
    fly = partial(
        fly_block, problem, tuple(planners), seed, data_folder=data_folder, record_every=record_every, own=own
    )
    with contextlib.ExitStack() as stack:
        pool = None
        if cluster is not None:
            pool = stack.enter_context(connected(cluster, origin, problem, data_folder, own)).flying(fly)
        out = stack.enter_context(taken(out, origin))
        blocks = Blocks.of(out, origin)
        blocks.forget_lost()
        finished = [block for block in blocks.finished() if block.start < runs]
        done = {run for block in finished for run in block if run < runs}
        left = [run for run in range(runs) if run not in done]
        prefix = None if enough is None else Prefix(enough, planners, runs)
        if prefix is not None:
            for block in finished:
                prefix.add(block, blocks.table("rows", block))
            if prefix.answer is not None:
                left = []
        slots = workers if pool is None else max(1, pool.slots())
        cut = chunks(left, block_runs or block_size(problem, scenario, len(left), slots, record_every))
        flown: Generator[tuple[range, Block | Lost], None, None] = (
            in_workers(fly, cut, workers, block_limit_s)
            if pool is None
            else in_pool(pool, cut, block_limit_s)
        )
        count = len(done)
        progress(count)
        with contextlib.closing(flown):
            for chunk, result in flown:
                kept = _kept(blocks, chunk, result, problem.uav_count, warn)
                count += len(chunk)
                progress(count)
                if prefix is not None and kept is not None:
                    prefix.add(chunk, kept.rows)
                    if prefix.answer is not None:
                        break
        most = runs
        if prefix is not None and prefix.answer is not None:
            runs = prefix.answer
        summary = conclude(out, blocks, runs)
        if prefix is not None:
            summary["stopping"] = {"rule": str(enough), "met": prefix.answer is not None, "most_runs": most}
            store.write_json(out / "summary.json", summary)
        write_scenario(out / "scenario.json", problem, seed, range(runs), data_folder)
    return summary


def _kept(
    blocks: Blocks, runs: range, result: Block | Lost, uavs: int, warn: Callable[[str], None]
) -> Block | None:
    """Keep a finished block; file a lost one, which no stopping rule must take for safe runs."""
    if not isinstance(result, Lost):
        blocks.add(runs, result)
        return result
    planners, seed = blocks.identity["planners"], blocks.identity["seed"]
    filed = lost_block(planners, seed, runs, uavs, Outcome(result.outcome), result.reason)
    blocks.add(runs, filed, lost=True)
    warn(
        f"runs {runs.start} to {runs.stop - 1} were lost twice and are filed as {result.outcome}: "
        f"{result.reason}; repeat the command to fly them again"
    )
    return None


def check_solver(problem: Problem) -> None:
    """Refuse a solver that nobody has registered, whether the planner that flies has one or not.

    Raises
    ------
    ProblemError
        If ``planner.solver`` is not known.
    """
    try:
        check_solver_name(problem.planner.solver)
    except SolverError as error:
        raise ProblemError("planner.solver", [str(error)]) from error


def check_flyable(
    problem: Problem, planners: Sequence[str], seed: int = 0, data_folder: Path | None = None
) -> Scenario:
    """Build everything that a flight needs, so that what cannot fly fails here, once, and not in a worker.

    Returns
    -------
    Scenario
        Of run 0.

    Raises
    ------
    NapfError
        If the solver is not known, a planner is not built, the scene cannot be built, data are missing, or
        the inner loop is unstable.
    """
    check_solver(problem)
    for planner in planners:
        make_planner(planner, problem)
    return build_scenario(problem, seed, range(1), data_folder)


def block_size(
    problem: Problem, scenario: Scenario, runs: int, workers: int = 1, record_every: int = 0
) -> int:
    """Runs to fly in lock-step: as many as pay, fit into memory and leave every worker its share.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    scenario : Scenario
        Of one run, for the number of obstacles.
    runs, workers : int
        Runs to fly, and processes.
    record_every : int
        Ticks from one sample of the trajectories to the next; 0 for none.
    """
    uavs, limit_s = problem.uav_count, problem.simulation.time_limit_s
    sizes = [
        BLOCK_UAVS // uavs,
        int(BLOCK_FIXES / (uavs * (limit_s * problem.navigation.rate_hz + 1.0))),
        BLOCK_OBSTACLES // max(1, len(scenario.obstacles.solids.kind)),
        BLOCK_MOVING // max(1, len(problem.world.moving)),
        max(WORTH_A_WORKER, -(-runs // workers)),
    ]
    if record_every:
        samples = limit_s * problem.simulation.controller_rate_hz / record_every
        sizes.append(int(BLOCK_SAMPLES / (uavs * samples)))
    return max(1, min(sizes))


def chunks(runs: Sequence[int], size: int) -> list[range]:
    """Cut ascending runs into ranges without gaps, none longer than a size."""
    cut: list[range] = []
    for run in runs:
        if cut and cut[-1].stop == run and len(cut[-1]) < size:
            cut[-1] = range(cut[-1].start, run + 1)
        else:
            cut.append(range(run, run + 1))
    return cut
