"""Which figures belong to what: a mission, a comparison, a problem, stored results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from napf_mpc import plot, store
from napf_mpc.block import check_campaign, fly_block
from napf_mpc.campaign import check_solver
from napf_mpc.errors import DataError
from napf_mpc.plot.field import surface_figure, walk_figure
from napf_mpc.plot.style import credit_of, house_style, save
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.scenario_file import moving_of, read_moving, read_scenes, scenes_of
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet

SHOWN_EACH = 1
"""Missions of each planner that went well, and that went badly, on the overview of a comparison."""


def draw_mission(
    problem: Problem,
    name: str,
    trajectories: store.Columns,
    obstacles: ObstacleSet,
    planners: Sequence[str],
    out: Path,
    animated: bool = False,
    moving: MovingObstacles | None = None,
) -> list[Path]:
    """Draw one mission, or a point's walk to its goal.

    Parameters
    ----------
    problem : Problem
        What was flown.
    name : str
        Its name, for the files' names.
    trajectories : mapping of str to array
        Every tick of it.
    obstacles : ObstacleSet
        What it flew through.
    planners : sequence of str
        Who flew.
    out : Path
        Folder.
    animated : bool
        Whether to make an animation too (some ten seconds).
    moving : MovingObstacles, optional
        What moved there, in truth.
    """
    if not isinstance(problem.mission, FormationMission):
        with house_style():
            return [
                *save(surface_figure(problem, obstacles), out, f"{name}_potential"),
                *save(walk_figure(problem, obstacles), out, f"{name}_walk"),
            ]
    written = plot.run_figures(problem, name, trajectories, obstacles, list(planners), out, moving)
    if animated:
        for planner in planners:
            path = out / f"{name}_{planner}.gif"
            written.append(plot.animation(problem, trajectories, obstacles, path, planner, moving))
    return written


def draw_problem(
    problem: Problem, name: str, seed: int, out: Path, data_folder: Path | None = None
) -> list[Path]:
    """Fly run 0 of a seed and draw the paper's figures for a problem."""
    check_campaign(["apf"], 1, seed)
    check_solver(problem)
    return plot.paper_figures(problem, name, seed, store.output_folder(out), data_folder)


def draw_comparison(
    problem: Problem,
    summary: dict[str, Any],
    rows: store.Columns,
    out: Path,
    data_folder: Path | None = None,
) -> list[Path]:
    """Draw risks, costs and clearances of a campaign, and some of its missions that went well and badly.

    The missions are flown again from their seeds.

    Raises
    ------
    DataError
        If they do not fly as they did, as with another version.
    """
    written = plot.compare_figures(
        _with_valid_ends(summary), rows, out, problem.reference, credit_of(problem)
    )
    missions = plot.pick_missions(rows, SHOWN_EACH)
    tracks = []
    for mission in missions:
        block = fly_block(
            problem,
            [mission.planner],
            summary["seed"],
            range(mission.run, mission.run + 1),
            data_folder,
            record_every=_planner_ticks(problem),
        )
        stored = (rows["planner"] == mission.planner) & (rows["run"] == mission.run)
        for key, values in block.rows.items():
            if not np.array_equal(values, rows[key][stored], equal_nan=values.dtype.kind == "f"):
                raise DataError(
                    f"run {mission.run} of {mission.planner} does not fly as it did: {key} = {values[0]}, "
                    f"stored {rows[key][stored][0]}; results of another version cannot be drawn in full"
                )
        tracks.append(block.trajectories)

    def obstacles_of(run: int) -> ObstacleSet:
        return scenes_of(problem, summary["seed"], range(run, run + 1), data_folder)

    def moving_in(run: int) -> MovingObstacles | None:
        return moving_of(problem, summary["seed"], range(run, run + 1))

    name, flown = str(summary["problem"]), store.stack(tracks)
    return written + plot.paths_overview(problem, name, flown, obstacles_of, missions, out, moving_in)


def _with_valid_ends(summary: dict[str, Any]) -> dict[str, Any]:
    """Put the sequential interval of the risk in place of Wilson's where the number of runs was not fixed."""
    if "stopping" not in summary:
        return summary
    ends = {end: f"collision_risk_sequential_{end}" for end in ("low", "high")}
    planners = {
        name: part | {f"collision_risk_{end}": part[key] for end, key in ends.items()}
        for name, part in summary["planners"].items()
    }
    return summary | {"planners": planners}


def _planner_ticks(problem: Problem) -> int:
    return round(problem.simulation.controller_rate_hz / problem.planner.rate_hz)


def draw_stored(
    folder: Path, out: Path, data_folder: Path | None = None, animated: bool = False
) -> list[Path]:
    """Draw stored results: of a single run its mission, of a campaign its comparison.

    Raises
    ------
    DataError
        If the folder holds no results of ours.
    """
    if not (folder / "summary.json").is_file():
        raise DataError(
            f"{folder}: holds no summary.json; give a folder that run, compare or montecarlo has written"
        )
    if not (folder / "scenario.json").is_file():
        raise DataError(
            f"{folder}: holds no scenario.json, without which nothing can be drawn; give a folder that run, "
            "compare or montecarlo has written (rare keeps no missions)"
        )
    summary = store.read_json(folder / "summary.json")
    scenario = store.read_json(folder / "scenario.json")
    try:
        problem = Problem.model_validate_json(store.to_json(scenario["problem"]))
        name, planners = str(summary["problem"]), list(summary["planners"])
    except (KeyError, TypeError, ValueError) as error:
        what = f"no {error} in it" if isinstance(error, KeyError) else str(error)[:300]
        raise DataError(
            f"{folder}: its files are not of this version ({what}); "
            "draw it with the version that wrote it, or fly it again"
        ) from error
    store.output_folder(out)
    if "run" in summary:
        trajectories = store.read_table(folder / "trajectories.parquet")
        (shapes,) = read_scenes(folder / "scenario.json").values()
        moving = next(iter(read_moving(folder / "scenario.json").values()), None)
        obstacles = ObstacleSet.from_shapes(shapes)
        return draw_mission(problem, name, trajectories, obstacles, planners, out, animated, moving)
    return draw_comparison(problem, summary, store.read_table(folder / "runs.parquet"), out, data_folder)
