"""Scenes as flown, as plain JSON, so that anyone can recompute every verdict with other tools."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc import store
from napf_mpc.errors import DataError
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

MAX_SCENES = 10_000
"""Scenes written to a file; any further run's scene follows from the seed."""
_BATCH = 256


def shape_to_json(shape: Shape) -> dict[str, Any]:
    """Obstacle as a table with the keys of ``world.obstacles``; an end at infinity is left out."""
    match shape:
        case Sphere():
            return {"shape": "sphere", "centre_m": list(shape.centre_m), "radius_m": shape.radius_m}
        case Cylinder():
            out: dict[str, Any] = {
                "shape": "cylinder",
                "centre_m": list(shape.centre_m),
                "radius_m": shape.radius_m,
            }
            return out | _ends(shape.base_m, shape.top_m)
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
    path: Path,
    problem: dict[str, Any],
    seed: int,
    runs: range,
    initial_state: Array,
    obstacles_of: Callable[[range], ObstacleSet],
) -> None:
    """Write problem, seed, initial state and the obstacles of every run (the first 10,000).

    Parameters
    ----------
    path : Path
        File to write.
    problem : dict
        The resolved problem as plain data.
    seed : int
        Campaign seed.
    runs : range
        Indices of the runs in their campaign.
    initial_state : array, shape (uav, 12)
        State at the start, the same for every run (Eq. 1).
    obstacles_of : callable
        Maps a range of runs to their scenes: one a run, or one for all.
    """
    scenes: list[dict[str, Any]] = []
    shared = False
    kept = runs[:MAX_SCENES]
    for first in range(kept.start, kept.stop, _BATCH):
        batch = range(first, min(first + _BATCH, kept.stop))
        obstacles = obstacles_of(batch)
        shared = obstacles.n_scenes == 1 and len(batch) > 1
        if shared:
            scenes = [{"run": None, "obstacles": [shape_to_json(s) for s in obstacles.shapes(0)]}]
            break
        for i, run in enumerate(batch):
            scenes.append({"run": run, "obstacles": [shape_to_json(s) for s in obstacles.shapes(i)]})
    table = {
        "problem": problem,
        "seed": seed,
        "first_run": runs.start,
        "runs": len(runs),
        "initial_state": initial_state.tolist(),
        "scenes": scenes,
    }
    store.write_json(path, table, indent=None)


def read_scenes(path: Path) -> dict[int | None, list[Shape]]:
    """Obstacles by run; key None holds a scene that all runs share.

    Raises
    ------
    DataError
        If the file is not a scenario of ours.
    """
    table = store.read_json(path)
    try:
        scenes: Sequence[dict[str, Any]] = table["scenes"]
        return {scene["run"]: [shape_from_json(shape) for shape in scene["obstacles"]] for scene in scenes}
    except (KeyError, TypeError) as error:
        raise DataError(f"{path}: not a scenario of ours: {error!r}") from error
