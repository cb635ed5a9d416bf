"""States of a flight over time: position and velocity, attitude and rates, distances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from napf_mpc.plot.style import (
    BLACK,
    COLUMN_IN,
    EDGE_IN,
    GREY,
    PAGE_IN,
    UAV_COLOURS,
    Page,
    credit_of,
    legend_height_in,
    planner_name,
    text_width_in,
    uav_colour,
)
from napf_mpc.plot.tracks import Track, clearances, separations
from napf_mpc.problem import Problem
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

MAX_LEGEND = len(UAV_COLOURS)
"""Formations up to this size are named in legends, larger ones by a bar of colours."""
BAR_HEIGHT_IN = 0.3
"""Height of that bar with its numbers [in]."""
BAR_STEPS = (1, 5, 10, 20, 50, 100, 200, 500)
"""Every how manieth UAV has a number at the bar."""
FAR = 5.0
"""Distances above this many ranges of influence are cut off: they say nothing."""

_LEFT, _RIGHT, _BOTTOM, _ABOVE, _ROW_GAP = 0.58, 0.08, 0.4, 0.08, 0.14
_LABEL = 0.42
"""Distance of labels from their axis, so that they stand in line [in]."""

AXES = "xyz"
ANGLES = ("roll", "pitch", "yaw")


def uav_handles(uavs: int) -> list[Line2D]:
    """Legend entries of the UAVs; none for a formation too large to name (:func:`draw_uav_bar`)."""
    if uavs > MAX_LEGEND:
        return []
    return [Line2D([], [], color=uav_colour(uav), label=f"UAV {uav + 1}") for uav in range(uavs)]


def uav_key_height_in(uavs: int, width_in: float, x: float | None = None) -> float:
    """Height that the UAVs' legend or bar takes on a page of a width [in]."""
    if uavs > MAX_LEGEND:
        return BAR_HEIGHT_IN
    labels = [str(handle.get_label()) for handle in uav_handles(uavs)]
    return legend_height_in(labels, width_in - EDGE_IN - (EDGE_IN if x is None else x))


def name_uavs(page: Page, uavs: int, y: float, x: float | None = None) -> None:
    """Tell which colour is which UAV, below a height [in]: in a legend, of many UAVs in a bar of colours."""
    if uavs <= MAX_LEGEND:
        page.legend(uav_handles(uavs), y, x)
    else:
        draw_uav_bar(page, uavs, y, x)


def draw_uav_bar(page: Page, uavs: int, y: float, x: float | None = None) -> None:
    """Draw the colours of a large formation in a row, with numbers, below a height [in]."""
    full_in = float(page.figure.get_size_inches()[0])
    word_in = text_width_in("UAV") + 0.08
    room = full_in - word_in - (0.1 + x if x is not None else 2.0 * 0.1)
    wide = min(room, 3.2, 0.22 * uavs)
    left = (0.5 * (full_in - word_in - wide) if x is None else x) + word_in
    least = text_width_in(str(uavs)) + 0.05
    step = next((step for step in BAR_STEPS if step * wide / uavs >= least), uavs)
    colours = ListedColormap([uav_colour(uav, uavs) for uav in range(uavs)])
    bar = page.figure.colorbar(
        ScalarMappable(BoundaryNorm(np.arange(uavs + 1) + 0.5, uavs), colours),
        cax=page.axes(left, y - 0.12, wide, 0.09),
        orientation="horizontal",
        ticks=sorted({1, *range(step, uavs + 1, step)}),
    )
    bar.ax.tick_params(length=0.0, pad=2.0)
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    page.text(left - word_in, y - 0.075, "UAV", va="center")


def beside(left_in: float, title: str) -> float:
    """Where a legend begins beside a title [in]."""
    return left_in + max(0.9, text_width_in(title) + 0.2)


def draw_over_time(axes: Axes, time_s: Array, values: Array) -> None:
    """Draw one line a UAV of values (time, uav)."""
    for uav in range(values.shape[1]):
        axes.plot(time_s, values[:, uav], color=uav_colour(uav, values.shape[1]), linewidth=0.9)
    axes.set_xlim(0.0, max(float(time_s[-1]), 1e-6))
    axes.margins(y=0.06)
    axes.locator_params(axis="y", nbins=5)


def _grid(
    rows: int, columns: int, width: float, row_in: float, gap: float, credit: str, head: float
) -> tuple[Page, list[list[Axes]], float]:
    """Rows of panels that share the time axis, [row][column] from the top; and the page's height."""
    height = _BOTTOM + rows * row_in + (rows - 1) * _ROW_GAP + _ABOVE + head
    page = Page.of_size(width, height, credit)
    wide = (width - _LEFT - _RIGHT - (columns - 1) * gap) / columns
    panels = []
    for row in range(rows):
        bottom = _BOTTOM + (rows - 1 - row) * (row_in + _ROW_GAP)
        panels.append([page.axes(_LEFT + c * (wide + gap), bottom, wide, row_in) for c in range(columns)])
    for row, line in enumerate(panels):
        for axes in line:
            axes.tick_params(labelbottom=row == rows - 1)
            axes.yaxis.set_label_coords(-_LABEL / wide, 0.5)
            if row == rows - 1:
                axes.set_xlabel("Time (s)")
    return page, panels, height


def motion_figure(problem: Problem, flown: Track) -> Figure:
    """Position and velocity of every UAV along each axis over time (truth)."""
    page, panels, height = _states_grid(problem, flown)
    for axis, (left, right) in enumerate(panels):
        draw_over_time(left, flown.time_s, flown.position[..., axis])
        draw_over_time(right, flown.time_s, flown.velocity[..., axis])
        left.set_ylabel(f"{AXES[axis]} (m)")
        right.set_ylabel(f"$v_{AXES[axis]}$ (m/s)")
    _heading(page, height, flown)
    return page.figure


def attitude_figure(problem: Problem, flown: Track) -> Figure:
    """Roll, pitch and yaw of every UAV with their rates over time (truth)."""
    page, panels, height = _states_grid(problem, flown)
    for axis, (left, right) in enumerate(panels):
        _draw_angle(left, right, flown, axis)
        left.set_ylabel(f"{ANGLES[axis].capitalize()} (°)")
        right.set_ylabel(f"{ANGLES[axis].capitalize()} rate (°/s)")
    _heading(page, height, flown)
    return page.figure


def _draw_angle(angle: Axes, rate: Axes, flown: Track, axis: int) -> None:
    draw_over_time(angle, flown.time_s, np.degrees(flown.attitude[..., axis]))
    draw_over_time(rate, flown.time_s, np.degrees(flown.rates[..., axis]))
    for axes, least in ((angle, 0.5), (rate, 0.5)):
        # A yaw that rests at zero must not be blown up to rounding noise.
        low, high = axes.get_ylim()
        if high - low < 2.0 * least:
            axes.set_ylim(min(low, -least), max(high, least))


def _states_grid(problem: Problem, flown: Track) -> tuple[Page, list[list[Axes]], float]:
    """Three rows of two panels below the planner's name and the UAVs."""
    head = uav_key_height_in(flown.uavs, PAGE_IN, beside(_LEFT, planner_name(flown.planner)))
    return _grid(3, 2, PAGE_IN, 1.15, 0.66, credit_of(problem), head)


def _heading(page: Page, height: float, flown: Track) -> None:
    title = planner_name(flown.planner)
    page.text(_LEFT, height - 0.02, title, va="top")
    name_uavs(page, flown.uavs, height - 0.02, beside(_LEFT, title))


def axis_figure(problem: Problem, flights: Sequence[Track], axis: int) -> Figure:
    """Position above velocity along one axis, one column a flight (Fig. 6-8, 13-15, 18-20, 23-25)."""
    page, panels, height = _pair(problem, flights)
    for column, flown in enumerate(flights):
        draw_over_time(panels[0][column], flown.time_s, flown.position[..., axis])
        draw_over_time(panels[1][column], flown.time_s, flown.velocity[..., axis])
    _share(panels)
    panels[0][0].set_ylabel(f"{AXES[axis]} (m)")
    panels[1][0].set_ylabel(f"$v_{AXES[axis]}$ (m/s)")
    name_uavs(page, flights[0].uavs, height - 0.02)
    return page.figure


def angle_figure(problem: Problem, flights: Sequence[Track], axis: int) -> Figure:
    """One angle above its rate, one column a flight (Fig. 9-11)."""
    page, panels, height = _pair(problem, flights)
    for column, flown in enumerate(flights):
        _draw_angle(panels[0][column], panels[1][column], flown, axis)
    _share(panels)
    panels[0][0].set_ylabel(f"{ANGLES[axis].capitalize()} (°)")
    panels[1][0].set_ylabel(f"{ANGLES[axis].capitalize()} rate (°/s)")
    name_uavs(page, flights[0].uavs, height - 0.02)
    return page.figure


def _pair(problem: Problem, flights: Sequence[Track]) -> tuple[Page, list[list[Axes]], float]:
    several = len(flights) > 1
    width = PAGE_IN if several else COLUMN_IN
    head = uav_key_height_in(flights[0].uavs, width) + (0.17 if several else 0.0)
    page, panels, height = _grid(2, len(flights), width, 1.15, 0.2, credit_of(problem), head)
    if several:
        for column, flown in enumerate(flights):
            panels[0][column].set_title(planner_name(flown.planner), pad=3.0)
    return page, panels, height


def _share(panels: list[list[Axes]]) -> None:
    """Give the panels of a row one scale, so that flights can be compared by eye."""
    for line in panels:
        low = min(axes.get_ylim()[0] for axes in line)
        high = max(axes.get_ylim()[1] for axes in line)
        end = max(axes.get_xlim()[1] for axes in line)
        for column, axes in enumerate(line):
            axes.set(ylim=(low, high), xlim=(0.0, end))
            axes.tick_params(labelleft=column == 0)


def distance_figure(
    problem: Problem, flown: Track, obstacles: ObstacleSet, moving: MovingObstacles | None = None
) -> Figure:
    """Clearance from the nearest obstacle and separation from the nearest UAV, with the lines of contact."""
    lone = flown.uavs == 1
    rows = 1 if lone else 2
    head = uav_key_height_in(flown.uavs, COLUMN_IN)
    page, panels, height = _grid(rows, 1, COLUMN_IN, 1.3, 0.0, credit_of(problem), head)
    vehicle = problem.vehicle
    clearance = clearances(flown, obstacles, vehicle.radius_m, moving)
    axes = panels[0][0]
    far = FAR * problem.planner.influence_m
    _draw_distance(axes, flown.time_s, clearance, 0.0, far, "obstacle touched")
    axes.set_ylabel("Clearance (m)")
    if not np.isfinite(clearance).any():
        axes.text(0.5, 0.5, "no obstacles", transform=axes.transAxes, ha="center", color=GREY)
    if not lone:
        axes, least = panels[1][0], vehicle.min_separation_m
        _draw_distance(axes, flown.time_s, separations(flown), least, far, f"UAVs in contact: {least:g} m")
        axes.set_ylabel("Separation (m)")
    name_uavs(page, flown.uavs, height - 0.02)
    return page.figure


def _draw_distance(axes: Axes, time_s: Array, values: Array, limit: float, far_m: float, words: str) -> None:
    finite = values[np.isfinite(values)]
    draw_over_time(axes, time_s, np.where(np.isfinite(values), values, np.nan))
    high = max(limit + 1.0, min(far_m, float(finite.max()) if len(finite) else 1.0))
    low = min(limit, float(finite.min()) if len(finite) else limit)
    axes.set_ylim(low - 0.17 * (high - low), high)
    style: dict[str, Any] = {"color": BLACK, "linewidth": 0.8, "linestyle": (0, (4, 2)), "zorder": 5}
    axes.axhline(limit, **style)
    axes.annotate(
        words,
        (1.0, limit),
        xycoords=("axes fraction", "data"),
        xytext=(-2, -2),
        textcoords="offset points",
        ha="right",
        va="top",
    )
