"""Many missions: the same seeds for every planner, in blocks over workers, nothing lost.

Each finished block is one file, so repeating the command goes on where it stopped. No result depends on
block size, order or worker; wall times are kept apart from results.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from napf_mpc import store
from napf_mpc.errors import OutputError, ProblemError
from napf_mpc.evaluate import METRICS, MissionScore, Outcome, Score
from napf_mpc.planners.planner import Planner
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import Problem
from napf_mpc.record import TrajectoryRecorder
from napf_mpc.risk import clustered_rate, paired_tests, quantiles, wilson
from napf_mpc.scenario_file import write_scenario
from napf_mpc.simulate import Scenario, build_scenario, closed_loop, initial_state

Columns = store.Columns

MAX_RUNS = 10_000_000
MAX_SEED = 2**63 - 1
BLOCK_UAVS = 1024
"""UAVs flown in lock-step by default: large enough to hide Python, small enough for the cache."""


@dataclass(frozen=True)
class Block:
    """Results of some runs of a campaign."""

    rows: Columns
    """One row a run and planner, metrics only."""
    timing: Columns
    """Wall time of each planner's flight of the block."""
    trajectories: Columns
    """Rows of the trajectories, empty if not asked for."""


@dataclass(frozen=True)
class Missions:
    """Missions flown in this process."""

    score: Score
    """Verdicts and metrics on the truth."""
    scenario: Scenario
    """What they flew through."""
    trajectories: Columns
    """Rows of the trajectories, empty if not asked for."""


def simulate(
    problem: Problem,
    planner: str | Planner = "napf",
    *,
    seed: int = 0,
    runs: int | range = 1,
    record_every: int = 0,
    data_folder: Path | None = None,
) -> Missions:
    """Fly missions in this process and judge them on the truth.

    Parameters
    ----------
    problem : Problem
        Formation problem, see :func:`napf_mpc.load_problem`.
    planner : str or Planner
        Name, or a planner of your own.
    seed : int
        Campaign seed.
    runs : int or range
        Number of runs, or their indices in the campaign of this seed.
    record_every : int
        Keep every n-th tick of the inner loop as trajectory; 0 for none.
    data_folder : Path, optional
        Where data files lie.

    Returns
    -------
    Missions
        Score, scenario and trajectories.

    Raises
    ------
    NapfError
        If a setting or the problem is not usable, or data are missing.
    """
    indices = range(runs) if isinstance(runs, int) else runs
    pilot = make_planner(planner, problem) if isinstance(planner, str) else planner
    check_campaign([pilot.name], indices.stop, seed, 1)
    scenario = build_scenario(problem, seed, indices, data_folder)
    score, trajectories = fly(problem, pilot, scenario, record_every)
    return Missions(score, scenario, trajectories)


def fly(
    problem: Problem, planner: Planner, scenario: Scenario, record_every: int = 0
) -> tuple[Score, Columns]:
    """Fly one planner through a scenario; return its score and its trajectories (empty if not asked for)."""
    judge = MissionScore(problem, scenario)
    if not record_every:
        return judge.score(closed_loop(problem, planner, scenario, (judge,))), {}
    recorder = TrajectoryRecorder(planner.name, scenario.runs, record_every)
    flight = closed_loop(problem, planner, scenario, (judge, recorder))
    return judge.score(flight), recorder.columns()


def fly_block(
    problem: Problem,
    planners: Sequence[str],
    seed: int,
    runs: range,
    data_folder: Path | None = None,
    record_every: int = 0,
) -> Block:
    """Fly some runs of a campaign with every planner, on the same scenes and errors.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planners : sequence of str
        Names of planners.
    seed : int
        Campaign seed.
    runs : range
        Indices of the runs.
    data_folder : Path, optional
        Where data files lie.
    record_every : int
        Keep every n-th tick of the trajectories; 0 for none.

    Returns
    -------
    Block
        Rows ordered by planner, then run.
    """
    # More threads than one would make workers fight for the cores, and win nothing on small matrices.
    with threadpool_limits(1):
        scenario = build_scenario(problem, seed, runs, data_folder)
        rows, timing, trajectories = [], [], []
        for name in planners:
            began = time.perf_counter()
            score, track = fly(problem, make_planner(name, problem), scenario, record_every)
            timing.append(_timing_row(name, runs, time.perf_counter() - began))
            rows.append(score_rows(name, seed, score))
            if track:
                trajectories.append(track)
    return Block(store.stack(rows), store.stack(timing), store.stack(trajectories) if trajectories else {})


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
        Names of planners.
    runs, seed : int
        Number of runs and campaign seed.
    data_folder : Path, optional
        Where data files lie.

    Returns
    -------
    dict
        Summary with rates, intervals and paired tests; the layout of ``summary.json``.
    """
    check_campaign(planners, runs, seed, 1)
    blocks = _chunks(list(range(runs)), _block_runs(problem, runs, 1))
    rows = store.stack([fly_block(problem, planners, seed, block, data_folder).rows for block in blocks])
    identity = {
        "problem": problem.title, "problem_hash": problem.digest(), "seed": seed, "planners": list(planners)
    }  # fmt: skip
    return summarise(_ordered(rows, list(planners), runs), identity)


def _timing_row(planner: str, runs: range, seconds: float) -> Columns:
    return {
        "planner": np.array([planner]),
        "first_run": np.array([runs.start]),
        "runs": np.array([len(runs)]),
        "wall_s": np.array([seconds]),
    }


def score_rows(planner: str, seed: int, score: Score) -> Columns:
    """Return one row a run: who, which run, how it ended, and its metrics."""
    runs = len(score.runs)
    return {
        "planner": np.full(runs, planner),
        "run": score.runs,
        "seed": np.full(runs, seed, dtype=np.int64),
        "outcome": np.array([str(outcome) for outcome in score.outcome]),
        "finished": score.finished,
        "obstacle_contact": score.obstacle_contact.any(-1),
        "uav_contact": score.uav_contact,
        "uavs_hit": score.obstacle_contact.sum(-1).astype(np.int64),
        "uavs": np.full(runs, score.obstacle_contact.shape[1], dtype=np.int64),
        "joint_success": score.joint_success,
        **score.metrics,
    }


def versions() -> dict[str, str]:
    """Versions of what decides a result."""
    packages = ("napf-mpc", "numpy", "scipy", "numba", "casadi", "pyarrow")
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in packages}


def check_campaign(planners: Sequence[str], runs: int, seed: int, workers: int) -> None:
    """Refuse campaign settings that cannot be meant.

    Raises
    ------
    ProblemError
        Naming every setting that is out of range.
    """
    faults = []
    if not 1 <= runs <= MAX_RUNS:
        faults.append(f"--runs = {runs}: must be >= 1 and <= {MAX_RUNS}")
    if not 0 <= seed <= MAX_SEED:
        faults.append(f"--seed = {seed}: must be >= 0 and < 2**63")
    if not 1 <= workers <= 1024:
        faults.append(f"--workers = {workers}: must be >= 1 and <= 1024")
    if not planners:
        faults.append("--planners: name at least one")
    if len(set(planners)) != len(planners):
        faults.append(f"--planners = {','.join(planners)}: each may be named once")
    if faults:
        raise ProblemError("campaign", faults)


def check_flyable(
    problem: Problem, planners: Sequence[str], seed: int = 0, data_folder: Path | None = None
) -> None:
    """Build everything that a flight needs, so that what cannot fly fails here, once, and not in a worker.

    Raises
    ------
    NapfError
        If a planner is not built, the scene cannot be built, data are missing, or the inner loop is unstable.
    """
    for planner in planners:
        make_planner(planner, problem)
    build_scenario(problem, seed, range(1), data_folder)


def run_campaign(
    problem: Problem,
    planners: Sequence[str],
    runs: int,
    seed: int,
    out: Path,
    *,
    name: str = "problem",
    workers: int = 1,
    block_runs: int | None = None,
    data_folder: Path | None = None,
    record_every: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Fly a campaign into a folder, going on where an earlier call of the same campaign stopped.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planners : sequence of str
        Names of planners; all fly the same seeds.
    runs, seed : int
        Number of runs and campaign seed.
    out : Path
        Output folder; holds ``blocks/`` while flying, then ``runs.parquet``, ``timing.parquet`` and
        ``summary.json``.
    name : str
        Problem's name in the summary.
    workers : int
        Processes.
    block_runs : int, optional
        Runs flown in lock-step; does not change any result.
    data_folder : Path, optional
        Where data files lie.
    record_every : int
        Keep every n-th tick in ``trajectories.parquet``; 0 for none.
    progress : callable
        Told the number of runs finished so far.

    Returns
    -------
    dict
        The summary, as written to ``summary.json``.

    Raises
    ------
    ProblemError
        If a setting or the problem is not usable.
    OutputError
        If the folder holds another campaign, or cannot be written.
    """
    check_campaign(planners, runs, seed, workers)
    check_flyable(problem, planners, seed, data_folder)
    store.output_folder(out)
    identity = {
        "problem": name,
        "problem_hash": problem.digest(),
        "seed": seed,
        "planners": list(planners),
        "record_every": record_every,
        "version": metadata.version("napf-mpc"),
    }
    blocks = _open_blocks(out, identity)
    done = {run for block in blocks for run in range(*_range_of(block))} & set(range(runs))
    progress(len(done))
    size = block_runs or _block_runs(problem, runs - len(done), workers)
    todo = _chunks([run for run in range(runs) if run not in done], size)
    for block_range, block in _fly_all(problem, planners, seed, todo, workers, data_folder, record_every):
        _write_block(out, block_range, block)
        done |= set(block_range)
        progress(len(done))
    summary = conclude(out, identity, runs)
    write_scenario(
        out / "scenario.json",
        problem.model_dump(mode="json"),
        seed,
        range(runs),
        initial_state(problem),
        lambda block: build_scenario(problem, seed, block, data_folder).obstacles,
    )
    return summary


def _block_runs(problem: Problem, runs: int, workers: int) -> int:
    lockstep = max(1, BLOCK_UAVS // problem.uav_count)
    return max(1, min(lockstep, -(-runs // workers)))


def _chunks(runs: list[int], size: int) -> list[range]:
    """Missing runs as ranges without gaps, none longer than a block."""
    chunks: list[range] = []
    for run in runs:
        if chunks and chunks[-1].stop == run and len(chunks[-1]) < size:
            chunks[-1] = range(chunks[-1].start, run + 1)
        else:
            chunks.append(range(run, run + 1))
    return chunks


def _fly_all(
    problem: Problem,
    planners: Sequence[str],
    seed: int,
    todo: list[range],
    workers: int,
    data_folder: Path | None,
    record_every: int,
) -> Iterator[tuple[range, Block]]:
    if workers == 1 or len(todo) <= 1:
        for block in todo:
            yield block, fly_block(problem, planners, seed, block, data_folder, record_every)
        return
    import joblib  # only here: it costs start-up time that a single process need not pay

    parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)
    yield from parallel(
        joblib.delayed(_fly_numbered)(problem, planners, seed, block, data_folder, record_every)
        for block in todo
    )


def _fly_numbered(
    problem: Problem,
    planners: Sequence[str],
    seed: int,
    runs: range,
    data_folder: Path | None,
    record_every: int,
) -> tuple[range, Block]:
    return runs, fly_block(problem, planners, seed, runs, data_folder, record_every)


def _open_blocks(out: Path, identity: dict[str, Any]) -> list[Path]:
    """Finished blocks of this very campaign; a folder with another one is refused."""
    marker = out / "campaign.json"
    if marker.exists():
        held = store.read_json(marker)
        if held != identity:
            different = [
                key for key in identity if not isinstance(held, dict) or held.get(key) != identity[key]
            ]
            theirs = {key: held.get(key) for key in different} if isinstance(held, dict) else held
            ours = {key: identity[key] for key in different}
            raise OutputError(f"{out}: holds another campaign: {theirs}, not {ours}; choose another --out")
    else:
        if any(out.iterdir()):
            raise OutputError(f"{out}: is not empty and holds no campaign of ours; choose another --out")
        store.write_json(marker, identity)
    folder = store.output_folder(out / "blocks")
    return sorted(folder.glob("rows_*.parquet"))


def _range_of(block: Path) -> tuple[int, int]:
    first, stop = block.stem.split("_")[1:3]
    return int(first), int(stop)


def _write_block(out: Path, runs: range, block: Block) -> None:
    tag = f"{runs.start:08d}_{runs.stop:08d}"
    folder = out / "blocks"
    store.write_table(folder / f"timing_{tag}.parquet", block.timing)
    if block.trajectories:
        store.write_table(folder / f"trajectories_{tag}.parquet", block.trajectories)
    # Last: a block counts as finished once its rows are there.
    store.write_table(folder / f"rows_{tag}.parquet", block.rows)


def conclude(out: Path, identity: dict[str, Any], runs: int) -> dict[str, Any]:
    """Derive tables and summary from the finished blocks; can be repeated at any time.

    Returns
    -------
    dict
        The summary.
    """
    planners = identity["planners"]
    rows = _ordered(_collect(out, "rows"), planners, runs)
    store.write_table(out / "runs.parquet", rows)
    store.write_table(out / "timing.parquet", _collect(out, "timing"))
    if identity["record_every"]:
        store.write_table(
            out / "trajectories.parquet", _ordered(_collect(out, "trajectories"), planners, runs)
        )
    summary = summarise(rows, identity)
    store.write_json(out / "summary.json", summary)
    return summary


def _collect(out: Path, kind: str) -> Columns:
    return store.stack(
        [store.read_table(path) for path in sorted((out / "blocks").glob(f"{kind}_*.parquet"))]
    )


def _ordered(table: Columns, planners: Sequence[str], runs: int) -> Columns:
    """Rows of the first runs by planner, then run (stable, so that trajectories keep their time order)."""
    rank = np.array([planners.index(str(name)) for name in table["planner"]])
    order = np.lexsort((table["run"], rank))
    order = order[table["run"][order] < runs]
    return {name: values[order] for name, values in table.items()}


def summarise(rows: Columns, identity: dict[str, Any]) -> dict[str, Any]:
    """Per planner the counts, rates with intervals and quantiles of a table of runs; then paired tests."""
    planners: list[str] = identity["planners"]
    parts = {name: {k: v[rows["planner"] == name] for k, v in rows.items()} for name in planners}
    hits: dict[str, NDArray[np.bool_]] = {
        name: np.asarray(part["obstacle_contact"], dtype=bool) for name, part in parts.items()
    }
    return {
        "problem": identity["problem"],
        "problem_hash": identity["problem_hash"],
        "seed": identity["seed"],
        "versions": versions(),
        "planners": {name: _planner_summary(part) for name, part in parts.items()},
        "paired": [asdict(pair) for pair in paired_tests(hits)],
    }


def _planner_summary(part: Columns) -> dict[str, Any]:
    runs = len(part["run"])
    risk = wilson(int(part["obstacle_contact"].sum()), runs)
    uav_risk = clustered_rate(part["uavs_hit"], int(part["uavs"][0]))
    apart = wilson(int(part["uav_contact"].sum()), runs)
    counts = {str(o): int((part["outcome"] == str(o)).sum()) for o in Outcome}
    return {
        "runs": runs,
        **counts,
        "collision_risk": risk.value,
        "collision_risk_low": risk.low,
        "collision_risk_high": risk.high,
        "uav_collision_risk": uav_risk.value,
        "uav_collision_risk_low": uav_risk.low,
        "uav_collision_risk_high": uav_risk.high,
        "uav_contact_risk": apart.value,
        "uav_contact_risk_low": apart.low,
        "uav_contact_risk_high": apart.high,
        "finished": int(part["finished"].sum()) / runs,
        "joint_success": int(part["joint_success"].sum()) / runs,
        **{name: quantiles(np.asarray(part[name], dtype=float)) for name in METRICS},
        "solver": {"status": {}, "iterations": None, "fall_backs": 0},
    }
