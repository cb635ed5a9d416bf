"""One mission flown, judged, stored and drawn; and the figures of stored results."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from napf_mpc import store
from napf_mpc.campaign import (
    Block,
    check_campaign,
    fly_block,
    score_rows,
    summarise,
)
from napf_mpc.errors import DataError, OutputError, ProblemError
from napf_mpc.evaluate import METRICS, Outcome, Score
from napf_mpc.goal_walk import goal_mission, goal_scene, walk_to_goal
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.report import Rows, mission_table
from napf_mpc.scenario_file import read_scenes, write_scenario
from napf_mpc.simulate import build_scenario, initial_state
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.sweep import SweptClearance


@dataclass(frozen=True)
class FlownMission:
    """One mission and what is to be said of it."""

    reached: bool
    """Whether the outcome is ``reached``."""
    summary: dict[str, Any]
    """As in ``summary.json``."""
    table: Rows
    """For the terminal."""


def fly_one(
    problem: Problem,
    name: str,
    planner: str,
    seed: int,
    run: int,
    out: Path | None,
    data_folder: Path | None = None,
) -> FlownMission:
    """Fly one run of a campaign; with a folder, store it with its trajectories and figures.

    Raises
    ------
    NapfError
        If a setting or the problem is not usable, data are missing, or the folder cannot be used.
    """
    check_campaign([planner], 1, seed, 1)
    if not 0 <= run < 2**31:
        raise ProblemError("campaign", [f"--run-index = {run}: must be >= 0 and < 2**31"])
    identity = {
        "kind": "run",
        "problem": name,
        "problem_hash": problem.digest(),
        "seed": seed,
        "planners": [planner],
        "version": metadata.version("napf-mpc"),
    }
    if out is not None:
        _claim(out, identity)
    formation = isinstance(problem.mission, FormationMission)
    if formation:
        block = fly_block(problem, [planner], seed, range(run, run + 1), data_folder, record_every=1)
        obstacles = build_scenario(problem, seed, range(run, run + 1), data_folder).obstacles
    else:
        obstacles = goal_scene(problem, seed, run, data_folder)
        block = _walk(problem, planner, seed, run, obstacles)
    summary = summarise(block.rows, identity)
    row = {key: values[0] for key, values in block.rows.items()}
    if out is not None:
        _store(problem, block, summary, seed, run, obstacles, out)
        _draw_mission(problem, name, block.trajectories, obstacles, [planner], out)
    return FlownMission(row["outcome"] == str(Outcome.REACHED), summary, mission_table(row, name))


def _claim(out: Path, identity: dict[str, Any]) -> None:
    """Take a folder that is empty or holds an earlier single run; anything else is somebody's."""
    store.output_folder(out)
    marker = out / "campaign.json"
    if any(out.iterdir()):
        held = store.read_json(marker) if marker.is_file() else None
        if not (isinstance(held, dict) and held.get("kind") == "run"):
            raise OutputError(f"{out}: is not empty and holds no single run of ours; choose another --out")
    store.write_json(marker, identity)


def _store(
    problem: Problem,
    block: Block,
    summary: dict[str, Any],
    seed: int,
    run: int,
    obstacles: ObstacleSet,
    out: Path,
) -> None:
    store.write_table(out / "runs.parquet", block.rows)
    store.write_table(out / "timing.parquet", block.timing)
    store.write_table(out / "trajectories.parquet", block.trajectories)
    start = (
        initial_state(problem)
        if isinstance(problem.mission, FormationMission)
        else np.array([[*problem.mission.start_m, 0.0]])
    )
    write_scenario(
        out / "scenario.json",
        problem.model_dump(mode="json"),
        seed,
        range(run, run + 1),
        start,
        lambda _: obstacles,
    )
    store.write_json(out / "summary.json", summary)


def _walk(problem: Problem, planner: str, seed: int, run: int, obstacles: ObstacleSet) -> Block:
    """Walk of a point as a block of one run, with the columns of a flight."""
    if planner != "apf":
        raise ProblemError(
            "planner", [f'"{planner}" cannot walk to a goal; missions of kind goal are for "apf"']
        )
    mission = goal_mission(problem)
    began = time.perf_counter()
    walk = walk_to_goal(problem, obstacles)
    elapsed = time.perf_counter() - began
    points = np.column_stack([walk.positions, np.zeros(len(walk.positions))])
    swept = SweptClearance(obstacles, 1, 1)
    for p0, p1 in pairwise(points):
        swept.update(p0[None, None], p1[None, None])
    contact = swept.contact(0.0)
    # A walk has no clock; one step counts as gamma metres at the default speed of 1 m/s.
    length = mission.step_m * (len(points) - 1)
    progress = float(np.hypot(*(np.subtract(mission.goal_m, mission.start_m))))
    metrics = {key: np.array([np.nan]) for key in METRICS}
    if walk.arrived and progress > 0.0:
        metrics["path_length_ratio"] = np.array([length / progress])
    if np.isfinite(swept.clearance).all():
        metrics["min_clearance_m"] = swept.clearance[:, 0].copy()
    outcome = Outcome.COLLIDED if contact.any() else Outcome.REACHED if walk.arrived else Outcome.TIMEOUT
    score = Score(
        np.array([run]),
        (outcome,),
        contact,
        np.array([False]),
        np.array([outcome is Outcome.REACHED]),
        np.array([walk.arrived]),
        metrics,
    )
    steps = np.arange(len(points))
    trajectories = {
        "run": np.full(len(points), run),
        "planner": np.full(len(points), planner),
        "t_s": steps * mission.step_m,
        "uav": np.zeros(len(points), dtype=np.int64),
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "z_m": points[:, 2],
    }
    timing = {
        "planner": np.array([planner]),
        "first_run": np.array([run]),
        "runs": np.array([1]),
        "wall_s": np.array([elapsed]),
    }
    return Block(score_rows(planner, seed, score), timing, trajectories)


def _draw_mission(
    problem: Problem,
    name: str,
    trajectories: store.Columns,
    obstacles: ObstacleSet,
    planners: Sequence[str],
    out: Path,
) -> list[Path]:
    from napf_mpc import plot  # only here: matplotlib costs start-up time

    if isinstance(problem.mission, FormationMission):
        return plot.run_figures(problem, name, trajectories, obstacles, list(planners), out)
    return plot.paper_figures(problem, name, 0, out, None)


def draw_problem(problem: Problem, name: str, seed: int, out: Path, data_folder: Path | None) -> list[Path]:
    """Draw the paper's figures for a problem."""
    from napf_mpc import plot

    check_campaign(["apf"], 1, seed, 1)
    return plot.paper_figures(problem, name, seed, store.output_folder(out), data_folder)


def draw_comparison(summary: dict[str, Any], folder: Path, problem: Problem) -> list[Path]:
    """Draw the figures of a comparison into its own folder."""
    from napf_mpc import plot

    rows = store.read_table(folder / "runs.parquet")
    return plot.compare_figures(summary, rows, folder, problem.reference)


def draw_stored(folder: Path, out: Path) -> list[Path]:
    """Draw the figures of stored results: of a single run its flight, of a campaign its comparison.

    Raises
    ------
    DataError
        If the folder holds no results of ours.
    """
    from napf_mpc import plot

    if not (folder / "summary.json").is_file():
        raise DataError(f"{folder}: holds no summary.json; give a folder that `run` or `compare` has written")
    summary = store.read_json(folder / "summary.json")
    scenario = store.read_json(folder / "scenario.json")
    try:
        problem = Problem.model_validate_json(store.to_json(scenario["problem"]))
        planners = list(summary["planners"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{folder}: its files are not of this version: {error}") from error
    store.output_folder(out)
    if (folder / "trajectories.parquet").is_file() and len(read_scenes(folder / "scenario.json")) == 1:
        trajectories = store.read_table(folder / "trajectories.parquet")
        shapes = next(iter(read_scenes(folder / "scenario.json").values()))
        obstacles = ObstacleSet.from_shapes(shapes)
        return _draw_mission(problem, str(summary["problem"]), trajectories, obstacles, planners, out)
    rows = store.read_table(folder / "runs.parquet")
    return plot.compare_figures(summary, rows, out, problem.reference)
