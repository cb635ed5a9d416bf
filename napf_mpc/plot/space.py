"""A flight seen in space."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from napf_mpc.plot import scene
from napf_mpc.plot.states import beside, name_uavs
from napf_mpc.plot.style import GREY, PAGE_IN, PALE, Page, credit_of, plain_panes, planner_name, uav_colour
from napf_mpc.plot.tracks import Track
from napf_mpc.problem import Problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

ELEVATION_DEG, AZIMUTH_DEG = 24.0, -68.0
"""Direction from which the scene is seen."""
MOST_SOLIDS = 250
"""Solids drawn at most, those nearest to the paths; more only hide each other."""


def space_figure(problem: Problem, flown: Track, obstacles: ObstacleSet) -> Figure:
    """Paths and obstacles in space, true to scale; solids without end are cut at the heights shown."""
    view = scene.view_of(flown.position, obstacles, pad_m=2.0, reach_m=12.0)
    heights = flown.position[..., 2]
    low, high = float(heights.min()) - 2.0, float(heights.max()) + 2.0
    shown: list[Shape] = []
    if len(obstacles):
        lower, upper = obstacles.boxes
        inside = np.flatnonzero(view.shows(lower, upper))
        if len(inside) > MOST_SOLIDS:
            # The distance between boxes is enough to choose what to draw.
            points = flown.position.reshape(-1, 3)[:: max(1, flown.position.size // 3000)]
            gap = np.maximum(np.maximum(lower[inside, None] - points, points - upper[inside, None]), 0.0)
            inside = inside[np.argsort((gap**2).sum(-1).min(1), kind="stable")[:MOST_SOLIDS]]
        shapes = obstacles.shapes()
        shown = [shapes[i] for i in inside.tolist()]
        ends = [float(value) for value in (*lower[inside, 2], *upper[inside, 2]) if math.isfinite(value)]
        low, high = min([low, *ends]), max([high, *ends])
    sides = (view.width, view.height, high - low)
    wide, tall = _seen_size(sides)
    scale = min((PAGE_IN - 1.5) / wide, 4.0 / tall)
    height = scale * tall + 0.85
    page = Page.of_size(PAGE_IN, height, credit_of(problem))
    # mplot3d has no type information.
    # Its axes are square and clip to the square: as wide as the page, they reach beyond its edges.
    low_edge = 0.45 + 0.5 * (scale * tall - PAGE_IN)
    axes = cast(Any, page.axes(0.0, low_edge, PAGE_IN, PAGE_IN, projection="3d", computed_zorder=False))
    for shape in shown:
        _draw_solid(axes, shape, low, high)
    for uav in range(flown.uavs):
        colour = uav_colour(uav, flown.uavs)
        x, y, z = flown.position[:, uav].T
        axes.plot(x, y, z, color=colour, linewidth=1.1, zorder=5)
        axes.plot(x, y, np.full_like(z, low), color=colour, linewidth=0.4, alpha=0.6, zorder=0.5)
        mark = {"s": 13, "edgecolor": colour, "linewidth": 0.9, "depthshade": False, "zorder": 6}
        axes.scatter(x[:1], y[:1], z[:1], marker="o", facecolor="white", **mark)
        axes.scatter(x[-1:], y[-1:], z[-1:], marker="s", facecolor=colour, **mark)
    axes.set(xlim=view.x, ylim=view.y, zlim=(low, high))
    axes.set_box_aspect(sides, zoom=scale / PAGE_IN)
    axes.view_init(elev=ELEVATION_DEG, azim=AZIMUTH_DEG)
    axes.locator_params(axis="y", nbins=4)
    axes.locator_params(axis="z", nbins=4)
    axes.set_xlabel("East x (m)", labelpad=12.0)
    axes.set_ylabel("North y (m)", labelpad=5.0)
    axes.set_zlabel("Up z (m)", labelpad=-2.0)
    axes.tick_params(pad=-1.0)
    plain_panes(axes)
    page.text(0.1, height - 0.02, planner_name(flown.planner), va="top")
    name_uavs(page, flown.uavs, height - 0.02, beside(0.1, planner_name(flown.planner)))
    return page.figure


def _seen_size(sides: tuple[float, float, float]) -> tuple[float, float]:
    """Width and height of a box of this shape as seen, in units of the side of square axes without zoom."""
    axes = cast(Any, Figure(figsize=(1.0, 1.0)).add_axes((0.0, 0.0, 1.0, 1.0), projection="3d"))
    axes.set_box_aspect(sides, zoom=1.0)
    axes.view_init(elev=ELEVATION_DEG, azim=AZIMUTH_DEG)
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), zlim=(0.0, 1.0))
    corners = np.array([[*pick, 1.0] for pick in np.ndindex(2, 2, 2)])
    seen = corners @ np.asarray(axes.get_proj()).T
    place = axes.transData.transform(seen[:, :2] / seen[:, 3:]) / axes.get_figure().dpi
    return float(np.ptp(place[:, 0])), float(np.ptp(place[:, 1]))


def _draw_solid(axes: Any, shape: Shape, low: float, high: float) -> None:
    if isinstance(shape, Sphere):
        polar, turn = np.meshgrid(np.linspace(0.0, math.pi, 13), np.linspace(0.0, 2.0 * math.pi, 21))
        around = np.sin(polar)
        x = shape.centre_m[0] + shape.radius_m * around * np.cos(turn)
        y = shape.centre_m[1] + shape.radius_m * around * np.sin(turn)
        z = shape.centre_m[2] + shape.radius_m * np.cos(polar)
        axes.plot_surface(x, y, z, alpha=0.75, rcount=13, ccount=21, **_FACE)
        return
    if isinstance(shape, Box):
        base, top = shape.centre_m[2] - 0.5 * shape.size_m[2], shape.centre_m[2] + 0.5 * shape.size_m[2]
    else:
        base, top = max(shape.base_m, low), min(shape.top_m, high)
    for ring in _rings(shape):
        closed = np.concatenate([ring, ring[:1]])
        walls = np.stack([np.full(len(closed), base), np.full(len(closed), top)])
        x, y = np.broadcast_to(closed.T[:, None], (2, 2, len(closed)))
        axes.plot_surface(x, y, walls, alpha=0.35, rcount=2, ccount=len(closed), **_FACE)
        axes.plot(*closed.T, np.full(len(closed), top), color=GREY, linewidth=0.4, zorder=3)


# Faces go into SVG files as pictures; as thousands of small polygons they would be large and slow.
_FACE: dict[str, Any] = {"color": PALE, "linewidth": 0.0, "zorder": 2, "rasterized": True}


def _rings(shape: Box | Cylinder | Prism) -> tuple[Array, ...]:
    if isinstance(shape, Prism):
        return shape.rings
    outline = scene.plan_outline(shape)
    polygon = outline.get_path().to_polygons(outline.get_patch_transform())
    return (np.asarray(polygon[0], dtype=float)[:-1],)
