"""Obstacles, ellipses and marks as seen from above and from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse, Patch, PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.plot.style import BLACK, GREY, PALE, RULE
from napf_mpc.world.distance import BOX, PRISM
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Box, Cylinder, Prism, Shape, Sphere

Array = NDArray[np.float64]

HEIGHT_SHADES = Normalize(0.0, 150.0)
"""Heights over which the grey of buildings darkens [m]."""
SIGMA = "\N{NO-BREAK SPACE}\N{GREEK SMALL LETTER SIGMA}"
"""Goes after a number of sigmas."""
DASHES = (0.0, (3.0, 1.5))
"""Line style of inflated obstacles."""
MOVING_DASHES = (0.0, (1.0, 1.5))
"""Line style of the paths of moving obstacles."""
MOVING_STYLE: dict[str, Any] = {
    "facecolor": PALE, "edgecolor": RULE, "linewidth": 0.6, "linestyle": MOVING_DASHES, "zorder": 1.3
}  # fmt: skip
"""A moving obstacle at one moment."""
INFLATED_COLOUR = "#8A6D00"
"""Dashed outline of inflated obstacles: dark, and no UAV's colour."""


@dataclass(frozen=True)
class View:
    """Part of the ground plan that a figure shows."""

    x: tuple[float, float]
    """East [m]."""
    y: tuple[float, float]
    """North [m]."""

    def shows(self, lower: Array, upper: Array) -> NDArray[np.bool_]:
        """Whether boxes with corners (n, 3) reach into the view, (n,)."""
        in_x = (lower[:, 0] <= self.x[1]) & (upper[:, 0] >= self.x[0])
        return np.asarray(in_x & (lower[:, 1] <= self.y[1]) & (upper[:, 1] >= self.y[0]))

    @property
    def width(self) -> float:
        """East-west [m]."""
        return self.x[1] - self.x[0]

    @property
    def height(self) -> float:
        """North-south [m]."""
        return self.y[1] - self.y[0]


def view_of(points: Array, obstacles: ObstacleSet, pad_m: float, reach_m: float) -> View:
    """View that holds points (..., 3), and the obstacles whose box lies within a reach of them.

    Parameters
    ----------
    points : array, shape (..., 3)
        What has to be seen [m]; points that are not finite do not count.
    obstacles : ObstacleSet
        One scene.
    pad_m : float
        Space around [m].
    reach_m : float
        Obstacles farther than this beside the points do not widen the view [m].
    """
    places = points.reshape(-1, 3)
    places = places[np.isfinite(places).all(-1)]
    low, high = places.min(0), places.max(0)
    if len(obstacles):
        lower, upper = obstacles.boxes
        close = View((low[0], high[0]), (low[1] - reach_m, high[1] + reach_m)).shows(lower, upper)
        if close.any() and close.sum() <= 200:
            low = np.minimum(low, np.maximum(lower[close].min(0), low - reach_m))
            high = np.maximum(high, np.minimum(upper[close].max(0), high + reach_m))
    return View((low[0] - pad_m, high[0] + pad_m), (low[1] - pad_m, high[1] + pad_m))


def plan_outline(shape: Shape) -> Patch:
    """Outline of a shape from above, without colours."""
    match shape:
        case Sphere() | Cylinder():
            return Circle(shape.centre_m[:2], shape.radius_m)
        case Box():
            return PathPatch(_outline([_box_corners(shape)]))
        case Prism():
            return PathPatch(_outline(shape.rings))


def _box_corners(box: Box) -> Array:
    half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(box.size_m[:2])
    cos, sin = math.cos(box.heading_rad), math.sin(box.heading_rad)
    turned = np.column_stack([cos * half[:, 0] - sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]])
    return np.asarray(turned + np.array(box.centre_m[:2]))


def _outline(rings: Sequence[Array]) -> Outline:
    """Closed rings as one outline; holes run the other way round, so that filling leaves them open."""
    vertices = np.concatenate([np.concatenate([ring, ring[:1]]) for ring in rings])
    codes = np.full(len(vertices), Outline.LINETO, dtype=Outline.code_type)
    stops = np.cumsum([0, *(len(ring) + 1 for ring in rings)])
    for start, stop in pairwise(stops.tolist()):
        codes[start], codes[stop - 1] = Outline.MOVETO, Outline.CLOSEPOLY
    return Outline(vertices, codes)


def shades_heights(obstacles: ObstacleSet) -> bool:
    """Whether greys stand for heights: in scenes with buildings."""
    return bool(np.isin(obstacles.solids.kind, (BOX, PRISM)).any())


def height_colours() -> ListedColormap:
    """Greys of buildings, from low to high."""
    return ListedColormap(colormaps["Greys"](np.linspace(0.08, 0.63, 128)))


def draw_plan(axes: Axes, obstacles: ObstacleSet, view: View) -> None:
    """Draw the obstacles in view from above; in scenes with buildings, the taller the darker."""
    if len(obstacles) == 0:
        return
    lower, upper = obstacles.boxes
    shown = np.flatnonzero(view.shows(lower, upper))
    shapes = obstacles.shapes()
    by_height = shades_heights(obstacles)
    collection = PatchCollection(
        [plan_outline(shapes[i]) for i in shown.tolist()],
        linewidths=0.4 if by_height else 0.6,
        edgecolors=RULE,
        facecolors=PALE,
        zorder=1.0,
    )
    if by_height:
        collection.set(array=np.minimum(upper[shown, 2], 1e6), cmap=height_colours(), norm=HEIGHT_SHADES)
    axes.add_collection(collection, autolim=False)


def draw_moving(axes: Axes, moving: MovingObstacles, time_s: Array, met_s: Array) -> None:
    """Draw what moves from above: its path over times (m,), and itself with its heading at times (n,)."""
    paths = np.stack([moving.position(time)[0, :, :2] for time in time_s.tolist()])
    for i, met in enumerate(met_s.tolist()):
        axes.plot(*paths[:, i].T, color=GREY, linewidth=0.7, linestyle=MOVING_DASHES, zorder=1.2)
        here, ahead = (moving.position(time)[0, i, :2] for time in (met, met + 1.0))
        axes.add_patch(Circle((here[0], here[1]), float(moving.radius[i]), **MOVING_STYLE))
        way = float(np.hypot(*(ahead - here)))
        if way > 0.0:
            tip = here + (ahead - here) * (float(moving.radius[i]) / way)
            arrow = {"arrowstyle": "->", "color": RULE, "linewidth": 0.7, "shrinkA": 0.0, "shrinkB": 0.0}
            axes.annotate(
                "", (tip[0], tip[1]), (here[0], here[1]), arrowprops=arrow, annotation_clip=True, zorder=1.4
            )


def draw_side(axes: Axes, obstacles: ObstacleSet, frame: PathFrame, view: View, ceiling_m: float) -> None:
    """Draw the obstacles in view from the side, along the path against height.

    Spheres, and others that end below the highest path: the rest would only hide the paths, which go round.
    """
    if len(obstacles) == 0:
        return
    lower, upper = obstacles.boxes
    shapes = obstacles.shapes()
    low_z, _ = axes.get_ylim()
    for i in np.flatnonzero(view.shows(lower, upper)).tolist():
        shape = shapes[i]
        if isinstance(shape, Sphere):
            along = float(frame.along_track(np.array(shape.centre_m)))
            axes.add_patch(Circle((along, shape.centre_m[2]), shape.radius_m, **_SOLID))
        elif low_z < upper[i, 2] < ceiling_m:
            along_all = frame.along_track(_ground_corners(shape, float(frame.origin[2])))
            span = (float(along_all.min()), float(along_all.max()))
            base = max(float(lower[i, 2]), low_z)
            axes.fill_between(
                span, base, float(upper[i, 2]), color=PALE, alpha=0.5, linewidth=0.0, zorder=1.0
            )


_SOLID: dict[str, Any] = {"facecolor": PALE, "edgecolor": RULE, "linewidth": 0.6, "zorder": 1.0}


def _ground_corners(shape: Box | Cylinder | Prism, height_m: float) -> Array:
    if isinstance(shape, Cylinder):
        angle = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
        plan = np.array(shape.centre_m) + shape.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    elif isinstance(shape, Box):
        plan = _box_corners(shape)
    else:
        plan = np.concatenate(shape.rings)
    return np.column_stack([plan, np.full(len(plan), height_m)])


def draw_inflated(
    axes: Axes, shape: Shape, margin_m: float, height_m: float, colour: str = INFLATED_COLOUR
) -> Artist:
    """Draw an obstacle inflated by a margin from above, dashed.

    A sphere or cylinder becomes a circle of radius + margin. Any other shape is drawn as the line on which
    the library's own distance at a height equals the margin.
    """
    if isinstance(shape, (Sphere, Cylinder)):
        radius = shape.radius_m + margin_m
        circle = Circle(
            shape.centre_m[:2], radius, fill=False, edgecolor=colour, linewidth=0.7, linestyle=DASHES
        )
        circle.set_zorder(1.5)
        return axes.add_patch(circle)
    alone = ObstacleSet.from_shapes([shape])
    lower, upper = alone.boxes
    reach = 1.05 * margin_m + 0.5
    x = np.linspace(lower[0, 0] - reach, upper[0, 0] + reach, 121)
    y = np.linspace(lower[0, 1] - reach, upper[0, 1] + reach, 121)
    grid = np.stack([*np.meshgrid(x, y), np.full((121, 121), height_m)], axis=-1)
    distance = alone.signed_distance(grid.reshape(1, -1, 3)).reshape(121, 121)
    # Far above a low roof there is no such line; contour would warn.
    level = max(margin_m, float(distance.min()))
    return axes.contour(
        x, y, distance, levels=[level], colors=colour, linewidths=0.7, linestyles=[DASHES], zorder=1.5
    )


def draw_ellipses(
    axes: Axes, centres: Array, sigma: Array, k: float, colour: str, alpha: float = 0.10
) -> list[Ellipse]:
    """Draw k-sigma ellipses of reported positions from above.

    Parameters
    ----------
    axes : Axes
        Ground plan.
    centres, sigma : array, shape (n, 3)
        Estimates and reported sigmas of the axes [m]; those that are not finite are left out.
    k : float
        Number of sigmas.
    colour : str
        Of the UAV.
    alpha : float
        Opacity of the filling.
    """
    drawn = []
    for centre, spread in zip(centres, sigma, strict=True):
        if not (np.isfinite(centre).all() and np.isfinite(spread).all()):
            continue
        width, height = 2.0 * k * float(spread[0]), 2.0 * k * float(spread[1])
        ellipse = Ellipse(
            (float(centre[0]), float(centre[1])), width, height, facecolor=colour, alpha=alpha, linewidth=0.0
        )
        edge = Ellipse(
            (float(centre[0]), float(centre[1])), width, height, fill=False, edgecolor=colour, linewidth=0.5
        )
        edge.set_alpha(0.6)
        axes.add_patch(ellipse)
        axes.add_patch(edge)
        drawn.append(ellipse)
    return drawn


def start_mark() -> Line2D:
    """Legend entry for the start of a path."""
    return Line2D([], [], linestyle="", marker="o", markersize=4, mfc="white", mec=GREY, label="start")


def end_mark() -> Line2D:
    """Legend entry for the end of a path."""
    return Line2D([], [], linestyle="", marker="s", markersize=4, mfc=GREY, mec=GREY, label="end")


def contact_mark() -> Line2D:
    """Legend entry for a contact."""
    return Line2D(
        [], [], label="contact", linestyle="", marker="X", markersize=6, mfc=BLACK, mec="white", mew=0.5
    )


def inflated_mark(k: float) -> Line2D:
    """Legend entry for inflated obstacles."""
    words = f"obstacle + {k:.3g}{SIGMA}"
    return Line2D([], [], color=INFLATED_COLOUR, linewidth=0.7, linestyle=DASHES, label=words)


def moving_mark() -> Patch:
    """Legend entry for moving obstacles."""
    return Patch(**MOVING_STYLE, label="moving obstacle when nearest")


def obstacle_mark(obstacles: ObstacleSet) -> Patch:
    """Legend entry for obstacles."""
    words = "obstacle (darker: taller)" if shades_heights(obstacles) else "obstacle"
    return Patch(facecolor=PALE, edgecolor=RULE, linewidth=0.6, label=words)
