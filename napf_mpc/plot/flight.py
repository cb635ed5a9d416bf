"""Figures of one flight: paths, uncertainty, states, clearance, and a view in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.plot import scene
from napf_mpc.plot.space import space_figure
from napf_mpc.plot.states import attitude_figure, distance_figure, motion_figure
from napf_mpc.plot.style import (
    BLACK,
    GREY,
    PAGE_IN,
    Page,
    credit_of,
    house_style,
    planner_name,
    save,
    uav_colour,
)
from napf_mpc.plot.tracks import (
    Track,
    clearances,
    contacts,
    encounters,
    first_run,
    inflation_of,
    track,
)
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.simulate import formation_mission
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

LABELLED = 8
"""Formations up to this size get a label at every path."""
SHOWN_APART = 4
"""UAVs that get a panel of their own: those that came closest to an obstacle."""
ELLIPSE_EVERY_S = 8.0
"""Time between two ellipses."""


def run_figures(
    problem: Problem,
    name: str,
    trajectories: Mapping[str, NDArray[Any]],
    obstacles: ObstacleSet,
    planner_names: Sequence[str],
    out: Path,
) -> list[Path]:
    """Make the figures of one run: for each planner six figures, PNG and SVG.

    Parameters
    ----------
    problem : Problem
        Formation problem that was flown.
    name : str
        Its name, for the files' names.
    trajectories : mapping of str to array
        Recorded columns; the lowest run in it is drawn.
    obstacles : ObstacleSet
        Scene of that run.
    planner_names : sequence of str
        Planners to draw.
    out : Path
        Output folder.

    Returns
    -------
    list of Path
        ``<name>_<planner>_paths``, ``_uncertainty``, ``_motion``, ``_attitude``, ``_distances``, ``_space``.

    Raises
    ------
    DataError
        If the trajectories do not hold the flight.
    OutputError
        If the folder cannot be written.
    """
    run = first_run(trajectories)
    written = []
    with house_style():
        for planner in planner_names:
            flown = track(trajectories, planner, run)
            figures = {
                "paths": paths_figure(problem, flown, obstacles),
                "uncertainty": uncertainty_figure(problem, flown, obstacles),
                "motion": motion_figure(problem, flown),
                "attitude": attitude_figure(problem, flown),
                "distances": distance_figure(problem, flown, obstacles),
                "space": space_figure(problem, flown, obstacles),
            }
            for kind, figure in figures.items():
                written += save(figure, out, f"{name}_{planner}_{kind}")
    return written


def flight_title(problem: Problem, flown: Track) -> str:
    """Name of the planner and, where it inflates obstacles, by how much."""
    return planner_title(planner_name(flown.planner), inflation_of(problem, flown.planner))


def planner_title(name: str, inflation: Inflation) -> str:
    """``APF``, ``NAPF, k = 3``, or ``NAPF, range of influence + 3 sigma`` for the other reading."""
    if inflation.k == 0.0:
        return name
    return f"{name}, k = {inflation.k:.3g}" + ("" if inflation.mode == "shift" else " on the range of influence")


def paths_figure(problem: Problem, flown: Track, obstacles: ObstacleSet) -> Figure:
    """Paths of all UAVs from above and from the side, with every contact marked.

    A path that crosses an obstacle's outline in one view passes beside it in the other; only a mark is a
    contact.
    """
    frame = PathFrame.of_mission(formation_mission(problem))
    view = scene.view_of(flown.position, obstacles, pad_m=2.0, reach_m=12.0)
    few = flown.uavs <= LABELLED
    left, right, top = 0.5, 0.08, 0.28
    label_m = 0.075 * max(view.width, view.height) if few else 0.0
    view = scene.View((view.x[0], view.x[1] + label_m), view.y)
    along = frame.along_track(flown.position)
    span = (float(along.min()) - 2.0, float(along.max()) + 2.0 + label_m)
    heights = flown.position[..., 2]
    low, high = _height_span(heights, obstacles, view)
    wide = PAGE_IN - left - right
    scale = min(wide / view.width, 5.2 / view.height)
    plan_w, plan_h = scale * view.width, scale * view.height
    level = abs(frame.heading_rad) < 1e-9
    side_h = (plan_w / view.width if level else wide / (span[1] - span[0])) * (high - low)
    side_h = min(max(side_h, 0.6), 2.2)
    bottom = 0.38
    page = Page.of_size(PAGE_IN, bottom + side_h + 0.42 + plan_h + top, credit_of(problem))
    side = page.axes(left, bottom, plan_w if level else wide, side_h)
    plan = page.axes(left, bottom + side_h + 0.42, plan_w, plan_h)
    page.text(left, bottom + side_h + 0.42 + plan_h + top - 0.02, flight_title(problem, flown), va="top")

    plan.set(xlim=view.x, ylim=view.y, ylabel="North y (m)", xlabel="" if level else "East x (m)")
    side.set(ylim=(low, high), ylabel="Up z (m)")
    side.set(xlim=view.x if level else span, xlabel="East x (m)" if level else "Along the path (m)")
    if level:
        along = flown.position[..., 0]
    _whole_steps(plan, side)
    scene.draw_plan(plan, obstacles, view)
    scene.draw_side(side, obstacles, frame, view)
    _draw_paths(plan, flown.position[..., 0], flown.position[..., 1], few)
    _draw_paths(side, along, heights, few=False)
    found = contacts(flown, obstacles, problem.vehicle.radius_m)
    for contact in found:
        mark = {"marker": "X", "s": 34, "color": BLACK, "edgecolor": "white", "linewidth": 0.5, "zorder": 6}
        plan.scatter(contact.position[0], contact.position[1], **mark)
        place = contact.position[0] if level else float(frame.along_track(contact.position))
        side.scatter(place, contact.position[2], **mark)
    handles: list[Any] = [scene.start_mark(), scene.end_mark()]
    if len(obstacles):
        handles.append(scene.obstacle_mark())
    if found:
        handles.append(scene.contact_mark())
    page.legend(handles, bottom + side_h + 0.42 + plan_h + top - 0.02, x=left + 1.9)
    return page.figure


def _height_span(heights: Array, obstacles: ObstacleSet, view: scene.View) -> tuple[float, float]:
    """Heights to show: the paths and the balls beside them; tall obstacles are cut."""
    low, high = float(heights.min()), float(heights.max())
    if len(obstacles):
        lower, upper = obstacles.boxes
        close = view.shows(lower, upper) & (upper[:, 2] - lower[:, 2] < 20.0)
        if close.any():
            low, high = min(low, float(lower[close, 2].min())), max(high, float(upper[close, 2].max()))
    return low - 1.0, high + 1.0


def _whole_steps(*panels: Axes) -> None:
    for axes in panels:
        axes.locator_params(axis="y", nbins=5, steps=[1, 2, 5, 10])


def _draw_paths(axes: Axes, x: Array, y: Array, few: bool) -> None:
    """Path of every UAV with start and end, and labels beside the ends, spread so that none overlaps."""
    uavs = x.shape[1]
    for uav in range(uavs):
        colour = uav_colour(uav)
        axes.plot(x[:, uav], y[:, uav], color=colour, linewidth=1.1 if uavs <= LABELLED else 0.5, zorder=4)
        axes.plot(x[0, uav], y[0, uav], "o", markersize=3.5, mfc="white", mec=colour, mew=0.9, zorder=5)
        axes.plot(x[-1, uav], y[-1, uav], "s", markersize=3.2, color=colour, zorder=5)
    if not few:
        return
    for uav, height in enumerate(spread(y[-1], 0.135 * _metres_per_inch(axes))):
        axes.text(
            float(x[-1].max()) + 0.09 * _metres_per_inch(axes),
            height,
            f"UAV {uav + 1}",
            color=uav_colour(uav),
            va="center",
        )


def _metres_per_inch(axes: Axes) -> float:
    low, high = axes.get_ylim()
    figure = axes.get_figure(root=True)
    assert figure is not None
    return (high - low) / (float(axes.get_position().height) * float(figure.get_size_inches()[1]))


def spread(places: Array, gap: float) -> Array:
    """Places (n,) moved apart until neighbours are at least a gap apart, in the same order, around their middle."""
    order = np.argsort(places, kind="stable")
    out = np.array(places, dtype=float)
    groups: list[list[int]] = []
    for index in order.tolist():
        groups.append([index])
        # A group is laid out evenly around its mean; groups that run into each other become one.
        while len(groups) > 1:
            below, above = groups[-2], groups[-1]
            top = float(places[below].mean()) + gap * (len(below) - 1) / 2.0
            bottom = float(places[above].mean()) - gap * (len(above) - 1) / 2.0
            if bottom - top >= gap:
                break
            groups[-2:] = [below + above]
    for group in groups:
        middle = float(places[group].mean())
        out[group] = middle + gap * (np.arange(len(group)) - (len(group) - 1) / 2.0)
    return out


def uncertainty_figure(problem: Problem, flown: Track, obstacles: ObstacleSet) -> Figure:
    """What each UAV believed: its estimate, k-sigma ellipses, and the obstacles as inflated for it, beside its true path.

    Up to four UAVs, those that came closest to an obstacle. An obstacle is drawn inflated by the margin at
    the moment when the UAV believed itself closest to it.
    """
    inflation = inflation_of(problem, flown.planner)
    k = Inflation.of_planner(problem.planner).k or 3.0
    shown = _closest_uavs(flown, obstacles)
    every = max(1, round(ELLIPSE_EVERY_S / max(1e-9, float(np.diff(flown.time_s[:2]).sum()) or ELLIPSE_EVERY_S)))
    reach = flown.estimate[:, shown][::every]
    swell = np.where(np.isfinite(flown.sigma[:, shown][::every]), k * flown.sigma[:, shown][::every], 0.0)
    points = np.concatenate([flown.position[:, shown], reach - swell, reach + swell, flown.estimate[:, shown]])
    view = scene.view_of(points, obstacles, pad_m=1.0, reach_m=2.0)
    columns = 1 if len(shown) == 1 else 2
    rows = -(-len(shown) // columns)
    left, right, gap, bottom, top, title = 0.5, 0.08, 0.14, 0.38, 0.26, 0.2
    wide = (PAGE_IN - left - right - gap * (columns - 1)) / columns
    tall = min(wide * view.height / view.width, 3.2)
    wide = min(wide, tall * view.width / view.height)
    height = bottom + rows * (tall + title) + top
    page = Page.of_size(PAGE_IN, height, credit_of(problem))
    seen = encounters(problem, flown, obstacles, each_uav=True) if inflation.k > 0.0 else []
    shapes = obstacles.shapes() if len(obstacles) else []
    for place, uav in enumerate(shown):
        row, column = divmod(place, columns)
        axes = page.axes(
            left + column * (wide + gap), bottom + (rows - 1 - row) * (tall + title), wide, tall
        )
        axes.set(xlim=view.x, ylim=view.y)
        axes.set_title(f"UAV {uav + 1}", color=uav_colour(uav), pad=2.0)
        last_in_column = place + columns >= len(shown)
        axes.set_xlabel("East x (m)" if last_in_column else "")
        axes.set_ylabel("North y (m)" if column == 0 else "")
        axes.tick_params(labelbottom=last_in_column, labelleft=column == 0)
        scene.draw_plan(axes, obstacles, view)
        for encounter in seen:
            if encounter.uav == uav:
                scene.draw_inflated(
                    axes,
                    shapes[encounter.obstacle],
                    encounter.margin_m,
                    float(flown.estimate[encounter.sample, uav, 2]),
                )
        scene.draw_ellipses(axes, flown.estimate[::every, uav], flown.sigma[::every, uav], k, uav_colour(uav))
        axes.plot(*flown.estimate[:, uav, :2].T, color=uav_colour(uav), linewidth=0.5, zorder=3)
        axes.plot(*flown.position[:, uav, :2].T, color=BLACK, linewidth=1.2, zorder=4)
    page.text(left, height - 0.02, flight_title(problem, flown), va="top")
    handles: list[Any] = [
        Line2D([], [], color=BLACK, linewidth=1.2, label="true path"),
        Line2D([], [], color=GREY, linewidth=0.5, label="estimate"),
        _ellipse_mark(k),
    ]
    if seen:
        handles.append(scene.inflated_mark(k))
    page.legend(handles, height - 0.02, x=left + 1.3)
    return page.figure


def _ellipse_mark(k: float) -> Line2D:
    words = f"{k:.3g}\N{NO-BREAK SPACE}σ of the estimate, every {ELLIPSE_EVERY_S:.0f} s"
    return Line2D([], [], linestyle="", marker="o", markersize=6, mfc="#DDDDDD", mec=GREY, mew=0.5, label=words)


def _closest_uavs(flown: Track, obstacles: ObstacleSet) -> list[int]:
    nearest = clearances(flown, obstacles, 0.0).min(0)
    return sorted(np.argsort(nearest, kind="stable")[:SHOWN_APART].tolist())
