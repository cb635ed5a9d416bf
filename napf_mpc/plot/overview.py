"""Many missions beside each other: those that went well and those that went badly."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from numpy.typing import NDArray

from napf_mpc.plot import scene
from napf_mpc.plot.flight import draw_moving, draw_paths, mark_contacts
from napf_mpc.plot.states import BAR_HEIGHT_IN, MAX_LEGEND, draw_uav_bar, uav_handles
from napf_mpc.plot.style import (
    EDGE_IN,
    PAGE_IN,
    Page,
    credit_of,
    house_style,
    legend_height_in,
    planner_name,
    save,
)
from napf_mpc.plot.tracks import contacts, track
from napf_mpc.problem import Problem
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet


@dataclass(frozen=True)
class Mission:
    """One mission to show."""

    planner: str
    """Who planned."""
    run: int
    """Index of the run."""
    words: str = ""
    """How it went, for the panel's title."""


def pick_missions(rows: Mapping[str, NDArray[Any]], each: int = 1) -> list[Mission]:
    """Choose missions of each planner by a rule, not by eye: typical good ones and the worst.

    Good are the missions that reached their end without contact, those whose path RMS is nearest to the
    median of the good ones first; bad are the other missions, the least clearance first.

    Parameters
    ----------
    rows : mapping of str to array
        Columns of ``runs.parquet``.
    each : int
        Good and bad missions of each planner.

    Returns
    -------
    list of Mission
        By planner: good, then bad. Fewer if there are no more.
    """
    picked = []
    for planner in dict.fromkeys(str(name) for name in rows["planner"]):
        mine = {name: np.asarray(values)[rows["planner"] == planner] for name, values in rows.items()}
        reached = mine["outcome"] == "reached"
        path = np.asarray(mine["path_rms_m"], dtype=float)
        clearance = np.asarray(mine["min_clearance_m"], dtype=float)
        typical = float(np.nanmedian(path[reached])) if np.isfinite(path[reached]).any() else 0.0
        far = np.where(np.isfinite(path), np.abs(path - typical), np.inf)
        # A mission without a number (failed) is as bad as can be.
        tight = np.where(np.isfinite(clearance), clearance, -np.inf)
        good = [i for i in np.lexsort((mine["run"], far)).tolist() if reached[i]][:each]
        bad = [i for i in np.lexsort((mine["run"], tight)).tolist() if not reached[i]][:each]
        picked += [Mission(planner, int(mine["run"][i]), str(mine["outcome"][i])) for i in good + bad]
    return picked


def paths_overview(
    problem: Problem,
    name: str,
    trajectories: Mapping[str, NDArray[Any]],
    obstacles_of_run: Callable[[int], ObstacleSet],
    missions: Sequence[Mission],
    out: Path,
    moving_of_run: Callable[[int], MovingObstacles | None] = lambda run: None,
) -> list[Path]:
    """Make a page of top views, all to one scale, with every contact marked.

    Parameters
    ----------
    problem : Problem
        Formation problem that was flown.
    name : str
        Its name, for the files' names.
    trajectories : mapping of str to array
        Recorded columns of at least the missions shown.
    obstacles_of_run : callable
        Maps the index of a run to its scene.
    missions : sequence of Mission
        What to show, in this order; see :func:`pick_missions`.
    out : Path
        Output folder.
    moving_of_run : callable
        Maps the index of a run to what moved in it.

    Returns
    -------
    list of Path
        ``<name>_overview.png`` and ``.svg``.

    Raises
    ------
    DataError
        If the trajectories do not hold a mission.
    OutputError
        If the folder cannot be written.
    """
    with house_style():
        figure = overview_figure(problem, trajectories, obstacles_of_run, missions, moving_of_run)
        return save(figure, out, f"{name}_overview")


def overview_figure(
    problem: Problem,
    trajectories: Mapping[str, NDArray[Any]],
    obstacles_of_run: Callable[[int], ObstacleSet],
    missions: Sequence[Mission],
    moving_of_run: Callable[[int], MovingObstacles | None] = lambda run: None,
) -> Figure:
    """Top views of missions, all to one scale (see :func:`paths_overview`).

    Raises
    ------
    ValueError
        If there is no mission to show.
    """
    if not missions:
        raise ValueError("missions is empty: there is nothing to show")
    flights = [track(trajectories, mission.planner, mission.run) for mission in missions]
    scenes = {mission.run: obstacles_of_run(mission.run) for mission in missions}
    points = np.concatenate([flown.position.reshape(-1, 3) for flown in flights])
    long = float(np.ptp(points[:, :2], axis=0).max())
    view = scene.view_of(points, scenes[missions[0].run], pad_m=max(2.0, 0.03 * long), reach_m=0.08 * long)
    columns = min(len(missions), 2 if view.width > 1.2 * view.height else 3 if len(missions) % 3 == 0 else 2)
    rows = -(-len(missions) // columns)
    left, right, gap, bottom, title = 0.58, 0.1, 0.14, 0.4, 0.2
    wide = (PAGE_IN - left - right - gap * (columns - 1)) / columns
    tall = wide * view.height / view.width
    found = [
        contacts(flown, scenes[mission.run], problem.vehicle.radius_m, moving_of_run(mission.run))
        for mission, flown in zip(missions, flights, strict=True)
    ]
    uavs = flights[0].uavs
    handles: list[Any] = [*uav_handles(uavs), scene.start_mark(), scene.end_mark()]
    handles += [scene.moving_mark()] * bool(problem.world.moving)
    handles += [scene.contact_mark()] * any(found)
    marks_in = legend_height_in([str(handle.get_label()) for handle in handles], PAGE_IN - 2.0 * EDGE_IN)
    top = 0.06 + marks_in + BAR_HEIGHT_IN * (uavs > MAX_LEGEND)
    shaded = any(scene.shades_heights(obstacles) for obstacles in scenes.values())
    height = bottom + rows * (tall + title) + top + 0.5 * shaded
    page = Page.of_size(PAGE_IN, height, credit_of(problem))
    base = height - top - rows * (tall + title)
    for place, (mission, flown) in enumerate(zip(missions, flights, strict=True)):
        row, column = divmod(place, columns)
        axes = page.axes(left + column * (wide + gap), base + (rows - 1 - row) * (tall + title), wide, tall)
        axes.set(xlim=view.x, ylim=view.y)
        last = place + columns >= len(missions)
        axes.set_xlabel("East x (m)" if last else "")
        axes.set_ylabel("North y (m)" if column == 0 else "")
        axes.tick_params(labelbottom=last, labelleft=column == 0)
        scene.draw_plan(axes, scenes[mission.run], view)
        moving = moving_of_run(mission.run)
        if moving is not None:
            draw_moving(axes, flown, moving)
        draw_paths(axes, flown.position[..., 0], flown.position[..., 1], label=False)
        mark_contacts(axes, [(contact.position[0], contact.position[1]) for contact in found[place]])
        words = f": {mission.words}" if mission.words else ""
        axes.set_title(
            f"({chr(97 + place)}) {planner_name(mission.planner)}, run {mission.run}{words}", pad=3.0
        )
    if shaded:
        bar = page.figure.colorbar(
            ScalarMappable(scene.HEIGHT_SHADES, scene.height_colours()),
            cax=page.axes(left + 1.2, 0.36, 2.4, 0.09),
            orientation="horizontal",
            extend="max",
        )
        bar.ax.tick_params(length=2.0)
        bar.set_label("Height of roofs (m)")
    page.legend(handles, height - 0.02)
    if uavs > MAX_LEGEND:
        draw_uav_bar(page, uavs, height - 0.02 - marks_in)
    return page.figure
