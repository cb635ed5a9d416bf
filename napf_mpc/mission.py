"""One mission of a campaign: flown, judged and stored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from napf_mpc import store
from napf_mpc.block import MAX_RUNS, Block, check_campaign, fly_block
from napf_mpc.campaign import check_flyable, check_solver
from napf_mpc.campaign_folder import taken
from napf_mpc.errors import DataError, ProblemError
from napf_mpc.evaluate import Outcome
from napf_mpc.goal_walk import walk_block
from napf_mpc.planners.registry import make_planner
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.provenance import data_digests, identity
from napf_mpc.scenario_file import moving_of, scenes_of, write_scenario
from napf_mpc.summary import summarise
from napf_mpc.words import shown_value
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet


@dataclass(frozen=True)
class FlownMission:
    """One mission and what became of it."""

    row: dict[str, Any]
    """Outcome and metrics, as its row in ``runs.parquet``."""
    summary: dict[str, Any]
    """As in ``summary.json``."""
    trajectories: store.Columns
    """Every tick of it."""
    obstacles: ObstacleSet
    """What it flew through."""
    moving: MovingObstacles | None = None
    """What moved there, in truth."""

    @property
    def reached(self) -> bool:
        """Whether the outcome is ``reached``."""
        return str(self.row["outcome"]) == str(Outcome.REACHED)


def check_mission(problem: Problem, data_folder: Path | None = None) -> str:
    """Build everything that flying a problem needs: what passes here also flies.

    Returns
    -------
    str
        Which data are missing, so that what depends on them could not be checked; empty if none.

    Raises
    ------
    NapfError
        If the problem cannot be flown: planner, scene, inner loop, or what is in its data files.
    """
    flies = isinstance(problem.mission, FormationMission)
    check_solver(problem)
    try:
        data_digests(problem, data_folder)
    except DataError as missing:
        if flies:
            make_planner(problem.planner.kind, problem)
        return str(missing)
    if flies:
        check_flyable(problem, [problem.planner.kind], data_folder=data_folder)
    else:
        scenes_of(problem, data_folder=data_folder)
    return ""


def fly_mission(
    problem: Problem,
    name: str,
    planner: str,
    *,
    seed: int = 0,
    run: int = 0,
    out: str | Path | None = None,
    data_folder: Path | None = None,
) -> FlownMission:
    """Fly one run of a campaign again, or for the first time: the same bits either way.

    Parameters
    ----------
    problem : Problem
        Formation problem, or a walk to a goal.
    name : str
        Its name in the summary.
    planner : str
        Name of the planner.
    seed, run : int
        Campaign seed, and which of its runs.
    out : str or Path, optional
        Folder for tables, summary, scenario and the trajectory of every tick; nothing is kept without.
    data_folder : Path, optional
        Where data files lie.

    Raises
    ------
    NapfError
        If a setting or the problem is not usable, data are missing, or the folder cannot be used.
    """
    check_campaign([planner], 1, seed)
    check_solver(problem)
    if not 0 <= run < MAX_RUNS:
        raise ProblemError(
            "campaign", [f"run-index = {shown_value(run)}: must be a whole number from 0 to {MAX_RUNS - 1}"]
        )
    run, seed = int(run), int(seed)  # JSON does not take those of NumPy
    origin = identity(problem, name, [planner], seed, data_folder) | {"run": run}
    obstacles = scenes_of(problem, seed, range(run, run + 1), data_folder)
    moving = moving_of(problem, seed, range(run, run + 1))
    if out is None:
        return _flown(_fly(problem, planner, seed, run, obstacles, data_folder), origin, obstacles, moving)
    with taken(out, origin) as out:
        block = _fly(problem, planner, seed, run, obstacles, data_folder)
        mission = _flown(block, origin, obstacles, moving)
        store.write_table(out / "runs.parquet", block.rows)
        store.write_table(out / "timing.parquet", block.timing)
        store.write_table(out / "events.parquet", block.events)
        store.write_table(out / "trajectories.parquet", block.trajectories)
        write_scenario(out / "scenario.json", problem, seed, range(run, run + 1), data_folder)
        store.write_json(out / "summary.json", mission.summary)
    return mission


def _fly(
    problem: Problem, planner: str, seed: int, run: int, obstacles: ObstacleSet, data_folder: Path | None
) -> Block:
    if isinstance(problem.mission, FormationMission):
        return fly_block(problem, [planner], seed, range(run, run + 1), data_folder, record_every=1)
    return walk_block(problem, planner, seed, run, obstacles)


def _flown(
    block: Block, origin: dict[str, Any], obstacles: ObstacleSet, moving: MovingObstacles | None
) -> FlownMission:
    row = {key: values[0].item() for key, values in block.rows.items()}
    summary = summarise(block.rows, origin) | {"run": origin["run"], "outcome": row["outcome"]}
    return FlownMission(row, summary, block.trajectories, obstacles, moving)
