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

from napf_mpc.closed_loop import formation_mission
from napf_mpc.formation import PathFrame
from napf_mpc.plot import scene
from napf_mpc.plot.space import space_figure
from napf_mpc.plot.states import (
    BAR_HEIGHT_IN,
    MAX_LEGEND,
    attitude_figure,
    distance_figure,
    draw_uav_bar,
    motion_figure,
)
from napf_mpc.plot.style import (
    BLACK,
    GREY,
    PAGE_IN,
    Page,
    credit_of,
    house_style,
    planner_name,
    save,
    text_width_in,
    uav_colour,
)
from napf_mpc.plot.tracks import (
    Track,
    acting,
    clearances,
    contacts,
    encounters,
    first_run,
    inflation_of,
    moving_distances,
    track,
)
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

SHOWN_APART = 4
"""UAVs that get a panel of their own: those that came closest to an obstacle."""
ELLIPSE_EVERY_S = 8.0
"""Time between two ellipses."""
MOST_INFLATED = 6
"""Inflated obstacles drawn for a UAV: those that it came closest to."""
_SHOWN_K = 3.0
"""Sigmas of the ellipses where no planner uses any."""


def run_figures(
    problem: Problem,
    name: str,
    trajectories: Mapping[str, NDArray[Any]],
    obstacles: ObstacleSet,
    planner_names: Sequence[str],
    out: Path,
    moving: MovingObstacles | None = None,
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
    moving : MovingObstacles, optional
        What moved in that run, in truth.

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
                "paths": paths_figure(problem, flown, obstacles, moving=moving),
                "uncertainty": uncertainty_figure(problem, flown, obstacles),
                "motion": motion_figure(problem, flown),
                "attitude": attitude_figure(problem, flown),
                "distances": distance_figure(problem, flown, obstacles, moving),
                "space": space_figure(problem, flown, obstacles),
            }
            for kind, figure in figures.items():
                written += save(figure, out, f"{name}_{planner}_{kind}")
    return written


def flight_title(problem: Problem, flown: Track) -> str:
    """``APF``, ``NAPF, k = 3``, or that k widens only the range of influence."""
    inflation = inflation_of(problem, flown.planner)
    name = planner_name(flown.planner)
    if inflation.k == 0.0:
        return name
    if inflation.safety == "protection_level":
        return f"{name}, protection level"
    bound = ", overbound" if inflation.safety == "overbound" else ""
    return f"{name}, k = {inflation.k:.3g}{bound}" + ("" if inflation.mode == "shift" else " (range)")


def paths_figure(
    problem: Problem,
    flown: Track,
    obstacles: ObstacleSet,
    beside: Sequence[Track] = (),
    moving: MovingObstacles | None = None,
) -> Figure:
    """Paths of all UAVs from above and from the side, with every contact marked.

    A path that crosses an obstacle's outline in one view passes beside it in the other; only a mark is a
    contact.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    flown : Track
        The flight.
    obstacles : ObstacleSet
        One scene.
    beside : sequence of Track
        Other flights of the same problem whose figures are to have the same scales.
    moving : MovingObstacles, optional
        What moved in that run: drawn from above, each with its path and where it was when it came closest.
    """
    frame = PathFrame.of_mission(formation_mission(problem))
    level = abs(frame.heading_rad) < 1e-9
    few = flown.uavs <= MAX_LEGEND
    seen = np.concatenate([each.position.reshape(-1, 3) for each in (flown, *beside)])
    view = scene.view_of(seen, obstacles, pad_m=2.0, reach_m=12.0)
    label_m = 0.075 * max(view.width, view.height) if few else 0.0
    westward = frame.along[0] < -0.5
    view = scene.View((view.x[0] - label_m * westward, view.x[1] + label_m * (not westward)), view.y)
    along = frame.along_track(seen)
    span = view.x if level else (float(along.min()) - 2.0, float(along.max()) + 2.0)
    left, right, bottom, gap, top = 0.58, 0.08, 0.4, 0.32, 0.28 if few else 0.28 + BAR_HEIGHT_IN
    wide = PAGE_IN - left - right
    scale = min(wide / view.width, 5.2 / view.height)
    plan_w, plan_h = scale * view.width, scale * view.height
    side_w = plan_w if level else wide
    metre = side_w / (span[1] - span[0])
    low, high = _height_span(seen[:, 2], obstacles, view, 0.7 / metre)
    side_h = min(metre * (high - low), 2.4)
    if not level:
        gap += 0.18  # the plan has a label of its own below
    height = bottom + side_h + gap + plan_h + top
    page = Page.of_size(PAGE_IN, height, credit_of(problem))
    side = page.axes(left, bottom, side_w, side_h)
    plan = page.axes(left, bottom + side_h + gap, plan_w, plan_h)
    plan.set(xlim=view.x, ylim=view.y, ylabel="North y (m)", xlabel="" if level else "East x (m)")
    side.set(xlim=span, ylim=(low, high), ylabel="Up z (m)")
    side.set_xlabel("East x (m)" if level else "Along the path (m)")
    for axes, width in ((plan, plan_w), (side, side_w)):
        axes.locator_params(axis="y", nbins=6, steps=[1, 2, 5, 10])
        axes.yaxis.set_label_coords(-0.42 / width, 0.5)
    scene.draw_plan(plan, obstacles, view)
    if moving is not None:
        draw_moving(plan, flown, moving)
    scene.draw_side(side, obstacles, frame, view, float(seen[:, 2].max()))
    draw_paths(plan, flown.position[..., 0], flown.position[..., 1], label=few)
    horizontal = flown.position[..., 0] if level else frame.along_track(flown.position)
    draw_paths(side, horizontal, flown.position[..., 2], label=False)
    found = contacts(flown, obstacles, problem.vehicle.radius_m, moving)
    mark_contacts(plan, [(each.position[0], each.position[1]) for each in found])
    across = [each.position[0] if level else float(frame.along_track(each.position)) for each in found]
    mark_contacts(side, [(place, each.position[2]) for place, each in zip(across, found, strict=True)])
    title = flight_title(problem, flown)
    page.text(left, height - 0.02, title, va="top")
    handles: list[Any] = [scene.start_mark(), scene.end_mark()]
    if len(obstacles):
        handles.append(scene.obstacle_mark(obstacles))
    if moving is not None:
        handles.append(scene.moving_mark())
    if found:
        handles.append(scene.contact_mark())
    marks = left + max(1.9, text_width_in(title) + 0.2)
    page.legend(handles, height - 0.02, x=marks)
    if not few:
        draw_uav_bar(page, flown.uavs, height - 0.2, x=marks)
    return page.figure


def _height_span(
    heights: Array, obstacles: ObstacleSet, view: scene.View, least_m: float
) -> tuple[float, float]:
    """Heights to show: the paths and the low obstacles among them; tall obstacles are cut."""
    low, high = float(heights.min()), float(heights.max())
    if len(obstacles):
        lower, upper = obstacles.boxes
        close = view.shows(lower, upper) & (upper[:, 2] - lower[:, 2] < 20.0)
        if close.any():
            low, high = min(low, float(lower[close, 2].min())), max(high, float(upper[close, 2].max()))
    pad = max(1.0, 0.5 * (least_m - (high - low)))
    return low - pad, high + pad


def draw_paths(axes: Axes, x: Array, y: Array, label: bool) -> None:
    """Draw the path of every UAV, (time, uav), with start and end, and on request a label beside each end."""
    uavs = x.shape[1]
    for uav in range(uavs):
        colour = uav_colour(uav, uavs)
        thick = 1.1 if uavs <= MAX_LEGEND else 0.8
        axes.plot(x[:, uav], y[:, uav], color=colour, linewidth=thick, zorder=4)
        axes.plot(x[0, uav], y[0, uav], "o", markersize=3.5, mfc="white", mec=colour, mew=0.9, zorder=5)
        axes.plot(x[-1, uav], y[-1, uav], "s", markersize=3.2, color=colour, zorder=5)
    if not label:
        return
    inch = _metres_per_inch(axes)
    westward = float(x[-1].mean()) < float(x[0].mean())
    place = float(x[-1].min()) - 0.09 * inch if westward else float(x[-1].max()) + 0.09 * inch
    for uav, height in enumerate(spread(y[-1], 0.135 * inch).tolist()):
        side = "right" if westward else "left"
        words = axes.text(place, height, f"UAV {uav + 1}", color=uav_colour(uav, uavs), va="center", ha=side)
        words.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.75})


def draw_moving(axes: Axes, flown: Track, moving: MovingObstacles) -> None:
    """Draw what moved from above, each where it was when it came closest to a UAV."""
    nearest = moving_distances(flown.time_s, flown.position, moving).min(axis=1).argmin(axis=0)
    scene.draw_moving(axes, moving, flown.time_s, flown.time_s[nearest])


def mark_contacts(axes: Axes, places: Sequence[tuple[float, float]]) -> None:
    """Draw a cross at each contact."""
    for x, y in places:
        axes.plot(x, y, "X", markersize=6, mfc=BLACK, mec="white", mew=0.5, zorder=6)


def _metres_per_inch(axes: Axes) -> float:
    low, high = axes.get_ylim()
    figure = axes.get_figure(root=True)
    assert figure is not None
    return (high - low) / (float(axes.get_position().height) * float(figure.get_size_inches()[1]))


def spread(places: Array, gap: float) -> Array:
    """Move places (n,) apart, in the same order and around their middle, until no gap is smaller than one."""
    out = np.array(places, dtype=float)
    groups: list[list[int]] = []
    for index in np.argsort(places, kind="stable").tolist():
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
        out[group] = float(places[group].mean()) + gap * (np.arange(len(group)) - (len(group) - 1) / 2.0)
    return out


def uncertainty_figure(problem: Problem, flown: Track, obstacles: ObstacleSet) -> Figure:
    """What each UAV believed beside its true path: estimate, k-sigma ellipses, obstacles as inflated for it.

    Up to four UAVs, those that came closest to an obstacle, and for each the six obstacles that it believed
    itself closest to, inflated by the margin of that moment. Seen from above, a path through a dashed
    circle passes over or under it.
    """
    inflation = inflation_of(problem, flown.planner)
    k = Inflation.of_problem(problem).k or _SHOWN_K
    shown = _closest_uavs(flown, obstacles)
    picks = _every(flown.time_s, ELLIPSE_EVERY_S)
    centre, swell = flown.estimate[picks][:, shown], k * flown.sigma[picks][:, shown]
    points = [flown.position[:, shown], centre - swell, centre + swell, flown.estimate[:, shown]]
    view = scene.view_of(np.concatenate(points), obstacles, pad_m=1.0, reach_m=2.0)
    columns = 1 if len(shown) == 1 else 2
    rows = -(-len(shown) // columns)
    left, right, gap, bottom, top, over = 0.58, 0.08, 0.14, 0.4, 0.24, 0.2
    wide = (PAGE_IN - left - right - gap * (columns - 1)) / columns
    scale = min(wide / view.width, 3.2 / view.height)
    wide, tall = scale * view.width, scale * view.height
    height = bottom + rows * (tall + over) + top
    page = Page.of_size(PAGE_IN, height, credit_of(problem))
    # Recorded are the reported sigmas: they do not tell other margins.
    inflates = inflation.k > 0.0 and inflation.mode == "shift" and inflation.safety == "k_sigma"
    inflates = inflates and len(obstacles) > 0
    seen = acting(problem, flown, obstacles) if inflates else None
    shapes = obstacles.shapes() if inflates else []
    for place, uav in enumerate(shown):
        row, column = divmod(place, columns)
        axes = page.axes(left + column * (wide + gap), bottom + (rows - 1 - row) * (tall + over), wide, tall)
        axes.set(xlim=view.x, ylim=view.y)
        colour = uav_colour(uav, flown.uavs)
        axes.set_title(f"UAV {uav + 1}", color=colour, pad=2.0)
        last_in_column = place + columns >= len(shown)
        axes.set_xlabel("East x (m)" if last_in_column else "")
        axes.set_ylabel("North y (m)" if column == 0 else "")
        axes.tick_params(labelbottom=last_in_column, labelleft=column == 0)
        scene.draw_plan(axes, obstacles, view)
        if seen is not None:
            for entry in encounters(seen, uav, MOST_INFLATED):
                flight_height = float(flown.estimate[seen.sample[entry], uav, 2])
                shape, margin = shapes[int(seen.obstacle[entry])], float(seen.margin_m[entry])
                scene.draw_inflated(axes, shape, margin, flight_height)
        scene.draw_ellipses(axes, flown.estimate[picks, uav], flown.sigma[picks, uav], k, colour)
        axes.plot(*flown.estimate[:, uav, :2].T, color=colour, linewidth=0.5, zorder=3)
        axes.plot(*flown.position[:, uav, :2].T, color=BLACK, linewidth=1.2, zorder=4)
    title = flight_title(problem, flown)
    page.text(left, height - 0.02, title, va="top")
    handles: list[Any] = [
        Line2D([], [], color=BLACK, linewidth=1.2, label="true path"),
        Line2D([], [], color=GREY, linewidth=0.5, label="estimate"),
        Line2D([], [], linestyle="", marker="o", markersize=6, mfc="#DDDDDD", mec=GREY, mew=0.5,
               label=f"{k:.3g}{scene.SIGMA} of the estimate, every {ELLIPSE_EVERY_S:.0f} s"),
    ]  # fmt: skip
    if inflates:
        handles.append(scene.inflated_mark(k))
    page.legend(handles, height - 0.02, x=left + max(1.1, text_width_in(title) + 0.2))
    return page.figure


def _every(time_s: Array, period_s: float) -> NDArray[np.int64]:
    """Indices of the first sample of each period."""
    _, first = np.unique(np.floor((time_s - time_s[0]) / period_s + 1e-9), return_index=True)
    return np.asarray(first, dtype=np.int64)


def _closest_uavs(flown: Track, obstacles: ObstacleSet) -> list[int]:
    nearest = clearances(flown, obstacles, 0.0).min(0)
    return sorted(np.argsort(nearest, kind="stable")[:SHOWN_APART].tolist())
