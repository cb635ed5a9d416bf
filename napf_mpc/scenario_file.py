"""Scenes as flown, as plain JSON, so that anyone can recompute every verdict with other tools."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc import store
from napf_mpc.closed_loop import formation_scenes, initial_state
from napf_mpc.errors import DataError
from napf_mpc.goal_walk import goal_scenes
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.world.moving import MovingObstacles, moving_obstacles
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

MAX_OBSTACLES = 400_000
"""Obstacles written to a file, about 40 MB; the scene of any further run follows from the seed."""
_BATCH = 256


def scenes_of(
    problem: Problem, seed: int = 0, runs: range = range(1), data_folder: Path | None = None
) -> ObstacleSet:
    """Obstacles of some runs of a campaign, for either kind of mission: one scene a run, or one for all.

    Raises
    ------
    NapfError
        If a scene cannot be built, the mission would start in contact, or data are missing.
    """
    if not isinstance(problem.mission, FormationMission):
        return goal_scenes(problem, seed, runs, data_folder)
    return formation_scenes(problem, seed, runs, data_folder)


def moving_of(problem: Problem, seed: int = 0, runs: range = range(1)) -> MovingObstacles | None:
    """Moving obstacles of some runs of a campaign, in truth; None in a world without any."""
    return moving_obstacles(problem.world, seed, runs, problem.simulation.time_limit_s)


def shape_to_json(shape: Shape) -> dict[str, Any]:
    """Obstacle as a table with the keys of ``world.obstacles``; an end at infinity is left out."""
    match shape:
        case Sphere():
            return {"shape": "sphere", "centre_m": list(shape.centre_m), "radius_m": shape.radius_m}
        case Cylinder():
            cylinder = {"shape": "cylinder", "centre_m": list(shape.centre_m), "radius_m": shape.radius_m}
            return cylinder | _ends(shape.base_m, shape.top_m)
        case Box():
            box = {"shape": "box", "centre_m": list(shape.centre_m), "size_m": list(shape.size_m)}
            return box | {"heading_deg": math.degrees(shape.heading_rad)}
        case Prism():
            rings = [np.asarray(ring).tolist() for ring in shape.rings]
            return {"shape": "prism", "rings_m": rings} | _ends(shape.base_m, shape.top_m)


def _ends(base: float, top: float) -> dict[str, float]:
    ends = {"base_m": base, "top_m": top}
    return {key: value for key, value in ends.items() if math.isfinite(value)}


def shape_from_json(table: dict[str, Any]) -> Shape:
    """Obstacle from a table that :func:`shape_to_json` made.

    Raises
    ------
    DataError
        If the table is not one of ours.
    """
    try:
        match table["shape"]:
            case "sphere":
                return Sphere(tuple(table["centre_m"]), table["radius_m"])
            case "cylinder":
                ends = table.get("base_m", -math.inf), table.get("top_m", math.inf)
                return Cylinder(tuple(table["centre_m"]), table["radius_m"], *ends)
            case "box":
                heading = math.radians(table["heading_deg"])
                return Box(tuple(table["centre_m"]), tuple(table["size_m"]), heading)
            case "prism":
                rings = tuple(np.array(ring, dtype=float) for ring in table["rings_m"])
                return Prism(rings, table.get("base_m", -math.inf), table.get("top_m", math.inf))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"scenario: not an obstacle of ours: {error!r} in {str(table)[:200]}") from error
    raise DataError(f"scenario: obstacle shape {table['shape']!r} is not known")


def write_scenario(
    path: Path, problem: Problem, seed: int, runs: range, data_folder: Path | None = None
) -> None:
    """Write problem, seed, initial state and the obstacles of every run, up to 400,000 obstacles.

    What moves is written with start, velocity and the acceleration of each second, by which its true place
    is known at any time (:mod:`napf_mpc.world.moving`); up to 400,000 of those accelerations.

    Parameters
    ----------
    path : Path
        File to write.
    problem : Problem
        What is flown; the file holds it with every default filled in.
    seed : int
        Campaign seed.
    runs : range
        Indices of the runs in their campaign.
    data_folder : Path, optional
        Where data files lie.

    Raises
    ------
    NapfError
        If a scene cannot be built, data are missing, or the file cannot be written.
    """
    table = {
        "problem": problem.model_dump(mode="json"),
        "seed": seed,
        "first_run": runs.start,
        "runs": len(runs),
        "initial_state": _start(problem).tolist(),
        "scenes": _scenes(problem, seed, runs, data_folder),
    }
    if problem.world.moving:
        table["moving"] = _moving(problem, seed, runs)
    store.write_json(path, table, indent=None)


def _start(problem: Problem) -> Array:
    """State at the start (uav, 12), the same for every run (Eq. 1); a walking point has a place only."""
    if isinstance(problem.mission, FormationMission):
        return initial_state(problem)
    return np.array([[*problem.mission.start_m, 0.0]])


def _scenes(problem: Problem, seed: int, runs: range, data_folder: Path | None) -> list[dict[str, Any]]:
    scenes: list[dict[str, Any]] = []
    written = 0
    for first in range(runs.start, runs.stop, _BATCH):
        batch = runs[first - runs.start : first - runs.start + _BATCH]
        obstacles = scenes_of(problem, seed, batch, data_folder)
        if obstacles.n_scenes == 1 and len(runs) > 1 and len(batch) > 1:
            return [{"run": None, "obstacles": _shapes(obstacles, 0)}]
        for i, run in enumerate(batch):
            scenes.append({"run": run, "obstacles": _shapes(obstacles, i)})
            written += len(scenes[-1]["obstacles"])
            if written >= MAX_OBSTACLES:
                return scenes
    return scenes


def _moving(problem: Problem, seed: int, runs: range) -> list[dict[str, Any]]:
    written, scenes = 0, []
    for run in runs:
        moving = moving_of(problem, seed, range(run, run + 1))
        assert moving is not None
        entry = {"run": run, "obstacles": moving_to_json(moving)}
        if moving.acceleration.shape[2] == 0 and len(runs) > 1:
            return [entry | {"run": None}]
        scenes.append(entry)
        written += moving.acceleration[0, :, :, 0].size
        if written >= MAX_OBSTACLES:
            break
    return scenes


def moving_to_json(moving: MovingObstacles) -> list[dict[str, Any]]:
    """Moving obstacles of a single run as tables: as in ``world.moving``, and ``accelerations_mps2``."""
    tables: list[dict[str, Any]] = []
    for i in range(moving.count):
        axes = 2 if moving.upright[i] else 3
        tables.append(
            {
                "shape": "cylinder" if moving.upright[i] else "sphere",
                "start_m": moving.start[i, :axes].tolist(),
                "velocity_mps": moving.velocity[i, :axes].tolist(),
                "radius_m": float(moving.radius[i]),
                "accelerations_mps2": moving.acceleration[0, i, :, :axes].tolist(),
            }
        )
    return tables


def moving_from_json(tables: list[dict[str, Any]]) -> MovingObstacles:
    """Moving obstacles of a single run from tables that :func:`moving_to_json` made.

    Raises
    ------
    DataError
        If a table is not one of ours.
    """
    try:
        upright = np.array([{"sphere": False, "cylinder": True}[table["shape"]] for table in tables])
        seconds = len(tables[0]["accelerations_mps2"])
        acceleration = np.zeros((1, len(tables), seconds, 3))
        for i, table in enumerate(tables):
            axes = 2 if upright[i] else 3
            held = np.array(table["accelerations_mps2"], dtype=float).reshape(-1, axes)
            acceleration[0, i, :, :axes] = held
        moving = MovingObstacles(
            radius=np.array([float(table["radius_m"]) for table in tables]),
            upright=upright,
            start=np.array([(*table["start_m"], 0.0)[:3] for table in tables], dtype=float),
            velocity=np.array([(*table["velocity_mps"], 0.0)[:3] for table in tables], dtype=float),
            acceleration=acceleration,
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DataError(f"scenario: not moving obstacles of ours: {error!r}") from error
    if moving.start.shape != (moving.count, 3) or moving.velocity.shape != (moving.count, 3):
        raise DataError(
            "scenario: not moving obstacles of ours: start_m and velocity_mps have 2 or 3 entries"
        )
    return moving


def read_moving(path: Path) -> dict[int | None, MovingObstacles]:
    """Moving obstacles by run, in truth; key None holds those that all runs share; empty without any.

    Raises
    ------
    DataError
        If the file is not a scenario of ours.
    """
    table = store.read_json(path)
    try:
        scenes = table.get("moving", [])
        return {scene["run"]: moving_from_json(scene["obstacles"]) for scene in scenes}
    except (AttributeError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a scenario of ours: {error!r}") from error


def _shapes(obstacles: ObstacleSet, scene: int) -> list[dict[str, Any]]:
    return [shape_to_json(shape) for shape in obstacles.shapes(scene)]


def read_scenes(path: Path) -> dict[int | None, list[Shape]]:
    """Obstacles by run; key None holds a scene that all runs share.

    Raises
    ------
    DataError
        If the file is not a scenario of ours.
    """
    table = store.read_json(path)
    try:
        return {
            scene["run"]: [shape_from_json(shape) for shape in scene["obstacles"]]
            for scene in table["scenes"]
        }
    except (KeyError, TypeError) as error:
        raise DataError(f"{path}: not a scenario of ours: {error!r}") from error
