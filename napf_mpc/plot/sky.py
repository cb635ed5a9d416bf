"""The sky of an emulated receiver between buildings, and what it makes of positions over the ground."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from napf_mpc.closed_loop import build_scenario, formation_mission
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.gnss import GnssScene
from napf_mpc.navigation.gnss_fixes import GnssErrors
from napf_mpc.navigation.gnss_map import gnss_map
from napf_mpc.navigation.gnss_sigma import sigma_map
from napf_mpc.navigation.sky import azimuth_rad, elevation_rad
from napf_mpc.plot.scene import plan_outline
from napf_mpc.plot.style import (
    BLACK,
    BLUE,
    GREY,
    PAGE_IN,
    PALE,
    RULE,
    VERMILION,
    Page,
    credit_of,
    house_style,
    save,
)  # fmt: skip
from napf_mpc.problem import Gnss, Problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.sight import line_of_sight

Array = NDArray[np.float64]

_GPS_EPOCH = dt.datetime(1980, 1, 6)
_RINGS_DEG = (0, 30, 60)
_MARKS = ("o", "s", "^")  # by system
_STEP_DEG = 1.0
_MARGIN_M = 60.0
_MOST_DOP = 10.0
_MOST_SIGMA_M = 10.0


def sky_figure(problem: Problem, scene: GnssScene, places: Sequence[Array], titles: Sequence[str]) -> Figure:
    """Satellites and buildings above places, as seen from there looking up: north up, east to the right.

    Parameters
    ----------
    problem : Problem
        For the credit.
    scene : GnssScene
        Of its run 0.
    places : sequence of arrays, shape (3,)
        East, north, up [m].
    titles : sequence of str
        One a place.
    """
    size, gap = 2.0, 0.35
    page = Page.of_size(PAGE_IN, 2.95, credit_of(problem))
    left = 0.5 * (PAGE_IN - len(places) * size - (len(places) - 1) * gap)
    for n, (place, title) in enumerate(zip(places, titles, strict=True)):
        axes = page.axes(left + n * (size + gap), 0.42, size, size, projection="polar")
        _draw_sky(axes, scene, place)
        axes.set_title(title, loc="center", pad=12.0)
    handles = [
        Line2D([], [], linestyle="", marker="o", color=BLUE, label="in sight"),
        Line2D([], [], linestyle="", marker="o", color=VERMILION, label="received by reflection"),
        Line2D([], [], linestyle="", marker="o", markerfacecolor="none", color=RULE, label="not received"),
        Patch(facecolor=PALE, edgecolor="none", label="building"),
        Line2D([], [], linestyle="", marker="o", markerfacecolor="none", color=GREY, label="GPS"),
        Line2D([], [], linestyle="", marker="s", markerfacecolor="none", color=GREY, label="Galileo"),
        Line2D([], [], linestyle="", marker="^", markerfacecolor="none", color=GREY, label="QZSS"),
    ]
    page.legend(handles if any(name[0] == "J" for name in scene.names) else handles[:-1], 0.16)
    return page.figure


def _draw_sky(axes: Any, scene: GnssScene, place: Array) -> None:
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_rlim(0.0, 90.0)
    axes.set_rgrids([90.0 - ring for ring in _RINGS_DEG], labels=[])
    axes.set_thetagrids([0.0, 90.0, 180.0, 270.0], labels=["N", "E", "S", "W"])
    axes.tick_params(pad=-2.0)
    axes.grid(color=PALE, linewidth=0.4)
    axes.spines["polar"].set(linewidth=0.6, color=RULE)
    azimuth = np.radians(np.arange(0.0, 360.0 + _STEP_DEG, _STEP_DEG))
    elevation = np.radians(np.arange(0.5 * _STEP_DEG, 90.0, _STEP_DEG))
    middle = 0.5 * (azimuth[1:] + azimuth[:-1])
    unit = np.stack(
        [
            np.cos(elevation)[:, None] * np.sin(middle),
            np.cos(elevation)[:, None] * np.cos(middle),
            np.broadcast_to(np.sin(elevation)[:, None], (len(elevation), len(middle))),
        ],
        axis=-1,
    )
    free = line_of_sight(_run_0(scene), place[None, None], unit.reshape(1, -1, 3))[0, 0]
    hidden = np.ma.masked_where(free.reshape(unit.shape[:2]), np.ones(unit.shape[:2]))
    edges = 90.0 - np.arange(0.0, 90.0 + _STEP_DEG, _STEP_DEG)
    axes.pcolormesh(azimuth, edges, hidden, cmap=ListedColormap([PALE]), rasterized=True, zorder=0.5)
    axes.plot(
        azimuth, np.full(len(azimuth), 90.0 - scene.config.elevation_mask_deg), color=GREY,
        linewidth=0.8, linestyle="--",
    )  # fmt: skip
    one = scene.of_run(0, _run_0(scene))
    seen = one.observe(0.0, place[None, None], np.zeros((1, 1, len(scene.names))))
    around, height = azimuth_rad(seen.directions[0]), np.degrees(elevation_rad(seen.directions[0]))
    for s in np.flatnonzero(height >= scene.config.elevation_mask_deg):
        colour = RULE
        if seen.tracked[0, 0, s]:
            colour = BLUE if seen.in_sight[0, 0, s] else VERMILION
        letter = scene.names[s][0]
        axes.plot(
            around[s], 90.0 - height[s], _MARKS["GEJ".index(letter)], markersize=4.5, color=colour,
            markerfacecolor=colour if seen.tracked[0, 0, s] else "none", markeredgewidth=0.8, zorder=3.0,
        )  # fmt: skip


def dop_map_figure(problem: Problem, scene: GnssScene, height_m: float, cells: int = 120) -> Figure:
    """Satellites in sight and horizontal dilution of precision along the path, at one height and moment.

    Parameters
    ----------
    problem : Problem
        Formation problem: path, and the credit.
    scene : GnssScene
        Of its run 0.
    height_m : float
        Height of the map [m].
    cells : int
        Cells along the longer side.
    """
    mission = formation_mission(problem)
    frame = PathFrame.of_mission(mission)
    lanes = formation_offsets(problem.formation)[:, 1]
    ends = frame.to_world(
        np.array(
            [[along, lane, 0.0] for along in (0.0, mission.length_m) for lane in (lanes.min(), lanes.max())]
        )
    )
    low, high = ends[:, :2].min(0) - _MARGIN_M, ends[:, :2].max(0) + _MARGIN_M
    step = (high - low).max() / cells
    east = np.arange(low[0] + 0.5 * step, high[0], step)
    north = np.arange(low[1] + 0.5 * step, high[1], step)
    made = gnss_map(scene, 0, east, north, height_m)
    span = high - low
    width = 2.6
    tall = min(width * span[1] / span[0], 3.6)
    page = Page.of_size(PAGE_IN, tall + 0.95, credit_of(problem))
    moment = _GPS_EPOCH + dt.timedelta(seconds=float(scene.start_s[0]))
    most = max(4.0, float(np.nanmax(made.in_sight)))
    extent = (low[0], low[0] + step * len(east), low[1], low[1] + step * len(north))
    dop = np.where(np.isinf(made.hdop), _MOST_DOP, np.minimum(made.hdop, _MOST_DOP))
    panels: tuple[tuple[str, Array, str, Any], ...] = (
        ("Satellites in sight", made.in_sight, "viridis", Normalize(0.0, most)),
        (f"HDOP ({_MOST_DOP:g}: or more, or no position)", dop, "viridis_r", LogNorm(0.5, _MOST_DOP)),
    )
    for n, (title, values, colours, norm) in enumerate(panels):
        left = 0.55 + n * 3.45
        axes = page.axes(left, 0.45, width, tall)
        image = axes.imshow(
            values,
            origin="lower",
            extent=extent,
            cmap=colours,
            norm=norm,
            interpolation="nearest",
            zorder=0.0,
        )
        _draw_houses(axes, _run_0(scene), height_m)
        for lane in lanes:
            line = frame.to_world(np.array([[0.0, lane, 0.0], [mission.length_m, lane, 0.0]]))
            axes.plot(line[:, 0], line[:, 1], color=BLACK, linewidth=0.7, linestyle="--")
        axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="East (m)", aspect="equal")
        if n == 0:
            axes.set_ylabel("North (m)")
        axes.set_title(title)
        bar = page.figure.colorbar(image, cax=page.axes(left + width + 0.08, 0.45, 0.09, tall))
        bar.outline.set_linewidth(0.6)
        if n == 1:
            ticks = [0.5, 1.0, 2.0, 5.0, 10.0]
            bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
            bar.minorticks_off()
    page.text(
        0.55,
        tall + 0.78,
        f"{height_m:g} m above ground, {moment:%Y-%m-%d %H:%M} GPS time; dashed: lanes",
        color=GREY,
    )
    return page.figure


def sigma_map_figure(problem: Problem, scene: GnssScene) -> Figure:
    """Horizontal sigma of the fix to be expected along the path, a panel for each slice of the sigma map.

    Parameters
    ----------
    problem : Problem
        Formation problem: path, and the credit.
    scene : GnssScene
        Of its run 0.
    """
    mission = formation_mission(problem)
    made = sigma_map(problem, scene.of_run(0, _run_0(scene)))
    variance = made.nodes[0, ..., 0:2].sum(-1) + made.nodes[0, ..., 3:5].sum(-1)
    sigma = np.minimum(np.sqrt(variance), _MOST_SIGMA_M)
    low, high = made.low_m, made.low_m + made.cell_m * (np.array(sigma.shape) - 1)
    width = 5.9
    tall = width * (high[1] - low[1]) / (high[0] - low[0])
    slices = len(made.heights_m)
    page = Page.of_size(PAGE_IN, 0.42 + slices * (tall + 0.3), credit_of(problem))
    least, most = float(sigma.min()), float(sigma.max())
    norm = LogNorm(least, most)
    around = Affine2D().translate(*-made.frame.origin[:2]).rotate(-made.frame.heading_rad)
    lanes = formation_offsets(problem.formation)[:, 1]
    for n, above in enumerate(made.heights_m):
        height = float(made.frame.origin[2] + above)
        bottom = 0.42 + n * (tall + 0.3)
        axes = page.axes(0.55, bottom, width, tall)
        half = 0.5 * made.cell_m
        extent = (low[0] - half[0], high[0] + half[0], low[1] - half[1], high[1] + half[1])
        image = axes.imshow(
            sigma[:, :, n].T, origin="lower", extent=extent, cmap="viridis_r", norm=norm,
            interpolation="nearest", zorder=0.0,
        )  # fmt: skip
        _draw_houses(axes, _run_0(scene), height, around)
        for lane in lanes:
            axes.plot([0.0, mission.length_m], [lane, lane], color=BLACK, linewidth=0.7, linestyle="--")
        axes.set(xlim=extent[:2], ylim=extent[2:], ylabel="Left (m)", aspect="equal")
        axes.set_title(f"{height:.0f} m above ground")
        if n == 0:
            axes.set_xlabel("Along the path (m)")
        else:
            axes.tick_params(labelbottom=False)
    whole = slices * (tall + 0.3) - 0.3
    bar = page.figure.colorbar(image, cax=page.axes(0.55 + width + 0.1, 0.42, 0.09, whole))
    bar.outline.set_linewidth(0.6)
    ticks = [
        tick for tick in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, _MOST_SIGMA_M) if least <= tick <= most
    ]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    bar.set_label("Horizontal sigma (m)")
    return page.figure


def _draw_houses(axes: Axes, obstacles: ObstacleSet, height_m: float, around: Affine2D | None = None) -> None:
    """What reaches above a height, filled, and moved as asked; lower houses hide nothing there."""
    _, upper = obstacles.boxes
    for i, shape in enumerate(obstacles.shapes()):
        if upper[i, 2] > height_m:
            outline = plan_outline(shape)
            outline.set(facecolor=PALE, edgecolor=RULE, linewidth=0.4, zorder=1.0)
            if around is not None:
                outline.set_transform(around + axes.transData)
            axes.add_patch(outline)


def _run_0(scene: GnssScene) -> ObstacleSet:
    return scene.obstacles if scene.obstacles.n_scenes == 1 else scene.obstacles.scene(0)


def gnss_figures(
    problem: Problem, name: str, seed: int, out: Path, data_folder: Path | None = None
) -> list[Path]:
    """Draw the sky of run 0 at three places along the path, and the map of satellite geometry around it.

    Parameters
    ----------
    problem : Problem
        Formation problem with emulated receivers; any other gets no figure.
    name : str
        Its name, for the files' names.
    seed : int
        Campaign seed.
    out : Path
        Folder.
    data_folder : Path, optional
        Where data files lie.
    """
    if not isinstance(problem.navigation, Gnss):
        return []
    errors = build_scenario(problem, seed, range(1), data_folder).errors
    assert isinstance(errors, GnssErrors)
    mission = formation_mission(problem)
    frame = PathFrame.of_mission(mission)
    lane = formation_offsets(problem.formation)[0, 1]
    along = [0.0, 0.4 * mission.length_m, 0.7 * mission.length_m]
    places = [frame.to_world(np.array([[x, lane, 0.0]]))[0] for x in along]
    titles = [f"UAV 1 after {x:.0f} m" for x in along]
    with house_style():
        return [
            *save(sky_figure(problem, errors.scene, places, titles), out, f"{name}_sky"),
            *save(dop_map_figure(problem, errors.scene, float(places[0][2])), out, f"{name}_dop"),
        ]
