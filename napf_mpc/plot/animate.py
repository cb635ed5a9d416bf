"""A flight as a moving picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse
from matplotlib.text import Text
from numpy.typing import NDArray
from PIL import Image

from napf_mpc.closed_loop import formation_mission
from napf_mpc.errors import OutputError
from napf_mpc.formation import PathFrame
from napf_mpc.plot import scene
from napf_mpc.plot.style import (
    BLACK,
    GREY,
    PAGE_IN,
    Page,
    credit_of,
    house_style,
    planner_name,
    uav_colour,
)
from napf_mpc.plot.tracks import Track, acting, contacts, first_run, inflation_of, track
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.store import output_folder, write_bytes
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

FRAMES = 150
"""Frames at most."""
FRAMES_PER_S = 12.5
"""Frames shown a second (GIF times are whole hundredths of a second)."""
TAIL_S = 12.0
"""Length of the tails behind UAVs."""
GIF_DPI = 110
"""Dots per inch of the GIF."""
COLOURS = 128
"""Colours of the GIF."""
MOST_UAVS = 12
"""Larger formations are drawn without estimates and ellipses."""


def animation(
    problem: Problem,
    trajectories: Mapping[str, NDArray[Any]],
    obstacles: ObstacleSet,
    out_path: Path,
    planner: str | None = None,
    moving: MovingObstacles | None = None,
) -> Path:
    """Write a flight as an animated GIF: from above and from the side.

    Drawn are the UAVs with tails, their estimates with k-sigma ellipses, the obstacles, and each obstacle
    inflated by k sigma for as long as it acts on a UAV of a planner that inflates (dashed, in the UAV's
    colour).

    Parameters
    ----------
    problem : Problem
        Formation problem that was flown.
    trajectories : mapping of str to array
        Recorded columns; the lowest run in it is drawn.
    obstacles : ObstacleSet
        Scene of that run.
    out_path : Path
        File to write, ``.gif``.
    planner : str, optional
        Whose flight; the first in the table unless given.
    moving : MovingObstacles, optional
        What moved in that run, drawn from above.

    Returns
    -------
    Path
        ``out_path``.

    Raises
    ------
    DataError
        If the trajectories do not hold the flight.
    OutputError
        If the file cannot be written or is not called ``.gif``.
    """
    if out_path.suffix.lower() != ".gif":
        raise OutputError(f"{out_path}: an animation is written as .gif")
    run = first_run(trajectories)
    flown = track(trajectories, planner or str(trajectories["planner"][0]), run)
    output_folder(out_path.parent)
    with house_style():
        frames = _Film(problem, flown, obstacles, moving).frames()
    # One palette for all frames: what does not move is then the same and costs nothing.
    palette = _palette(frames[len(frames) // 2])
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    write_bytes(
        out_path,
        lambda file: indexed[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=indexed[1:],
            duration=round(1000.0 / FRAMES_PER_S),
            loop=0,
            optimize=False,
        ),
    )
    return out_path


def _palette(picture: Image.Image) -> Image.Image:
    """Colours for all frames, those of one of them; the background stays pure white."""
    palette = picture.quantize(COLOURS, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette(), dtype=int).reshape(-1, 3)
    colours[(colours > 245).all(1)] = 255
    palette.putpalette(colours.ravel().tolist())
    return palette


class _Film:
    """Everything that stands still is drawn once; frames restore it and draw what moves."""

    def __init__(
        self, problem: Problem, flown: Track, obstacles: ObstacleSet, moving: MovingObstacles | None
    ) -> None:
        self._moving = moving
        self._flown = flown
        self._inflation = inflation_of(problem, flown.planner)
        self._k = Inflation.of_problem(problem).k or 3.0
        self._shapes = obstacles.shapes() if len(obstacles) else []
        self._frame = PathFrame.of_mission(formation_mission(problem))
        self._level = abs(self._frame.heading_rad) < 1e-9
        self._small = flown.uavs <= MOST_UAVS
        self._contacts = contacts(flown, obstacles, problem.vehicle.radius_m, moving)
        inflates = self._small and self._inflation.k > 0.0 and self._inflation.mode == "shift"
        inflates = inflates and self._inflation.safety == "k_sigma"
        self._acting = acting(problem, flown, obstacles) if inflates and self._shapes else None
        self._canvas, self._plan, self._side, self._clock = self._still(problem, obstacles)

    def _still(self, problem: Problem, obstacles: ObstacleSet) -> tuple[Any, Axes, Axes, Text]:
        """Lay out the picture and draw what stands still."""
        position = self._flown.position
        view = scene.view_of(position, obstacles, pad_m=3.0, reach_m=10.0)
        along = self._horizontal(position)
        span = view.x if self._level else (float(along.min()) - 3.0, float(along.max()) + 3.0)
        low, high = float(position[..., 2].min()) - 3.0, float(position[..., 2].max()) + 3.0
        left, bottom, gap, top = 0.58, 0.4, 0.32, 0.28
        wide = PAGE_IN - left - 0.1
        scale = min(wide / view.width, 4.2 / view.height)
        side_w = scale * view.width if self._level else wide
        side_h = min(max(side_w / (span[1] - span[0]) * (high - low), 0.6), 2.4)
        height = bottom + side_h + gap + scale * view.height + top
        page = Page.of_size(PAGE_IN, height, credit_of(problem))
        canvas: Any = FigureCanvasAgg(page.figure)  # its drawing methods have no type information
        page.figure.set_dpi(GIF_DPI)
        side = page.axes(left, bottom, side_w, side_h)
        plan = page.axes(left, bottom + side_h + gap, scale * view.width, scale * view.height)
        plan.set(xlim=view.x, ylim=view.y, ylabel="North y (m)")
        side.set(xlim=span, ylim=(low, high), ylabel="Up z (m)")
        side.set_xlabel("East x (m)" if self._level else "Along the path (m)")
        for axes, width in ((plan, scale * view.width), (side, side_w)):
            axes.locator_params(axis="y", nbins=6, steps=[1, 2, 5, 10])
            axes.yaxis.set_label_coords(-0.42 / width, 0.5)
        scene.draw_plan(plan, obstacles, view)
        scene.draw_side(side, obstacles, self._frame, view, float(position[..., 2].max()))
        page.text(left, height - 0.02, planner_name(self._flown.planner), va="top")
        page.legend(self._handles(), height - 0.02, x=left + 0.7)
        clock = page.text(PAGE_IN - 0.1, height - 0.02, "", ha="right", va="top", animated=True)
        return canvas, plan, side, clock

    def _handles(self) -> list[Line2D]:
        dot: dict[str, Any] = {"linestyle": "", "color": GREY}
        handles = [Line2D([], [], marker="o", markersize=5, label="UAV", **dot)]
        if self._small:
            ellipse = {"mfc": "#DDDDDD", "mec": GREY, "mew": 0.5}
            handles += [
                Line2D([], [], marker="+", markersize=6, label="estimate", **dot),
                Line2D(
                    [], [], marker="o", markersize=8, label=f"{self._k:.3g}{scene.SIGMA}", **(dot | ellipse)
                ),
            ]
        if self._acting is not None:
            words = f"obstacle + {self._inflation.k:.3g}{scene.SIGMA}"
            handles.append(Line2D([], [], color=GREY, linewidth=0.8, linestyle=scene.DASHES, label=words))
        return handles

    def _horizontal(self, places: Array) -> Array:
        """Horizontal coordinate of the side view (...) of places (..., 3)."""
        return np.asarray(places[..., 0] if self._level else self._frame.along_track(places))

    def frames(self) -> list[Image.Image]:
        """All frames as pictures."""
        times = self._flown.time_s
        count = min(FRAMES, len(times))
        picks = np.unique(np.linspace(0, len(times) - 1, count).round().astype(int)).tolist()
        speed = float(times[-1] - times[0]) / max(1.0, len(picks) - 1.0) * FRAMES_PER_S
        self._canvas.draw()
        still = self._canvas.copy_from_bbox(self._canvas.figure.bbox)
        pictures = []
        for sample in picks:
            self._canvas.restore_region(still)
            self._draw(sample)
            self._clock.set_text(f"{times[sample]:.0f} s, {speed:.1f} times real time")
            self._canvas.figure.draw_artist(self._clock)
            pictures.append(Image.fromarray(np.asarray(self._canvas.buffer_rgba())[..., :3].copy()))
        return pictures

    def _draw(self, sample: int) -> None:
        flown = self._flown
        since = int(np.searchsorted(flown.time_s, flown.time_s[sample] - TAIL_S))
        if self._acting is not None:
            for entry in np.flatnonzero(self._acting.sample == sample).tolist():
                uav, shape = int(self._acting.uav[entry]), self._shapes[int(self._acting.obstacle[entry])]
                height, margin = float(flown.estimate[sample, uav, 2]), float(self._acting.margin_m[entry])
                artist = scene.draw_inflated(self._plan, shape, margin, height, uav_colour(uav, flown.uavs))
                self._plan.draw_artist(artist)
                artist.remove()
        if self._moving is not None:
            places = self._moving.position(float(flown.time_s[sample]))[0]
            for place, radius in zip(places, self._moving.radius.tolist(), strict=True):
                _once(self._plan, Circle((place[0], place[1]), radius, **scene.MOVING_STYLE))
        for uav in range(flown.uavs):
            colour = uav_colour(uav, flown.uavs)
            if self._small:
                self._draw_estimate(flown.estimate[sample, uav], flown.sigma[sample, uav], colour)
            tail = flown.position[since : sample + 1, uav]
            above = (self._plan, tail[:, 0], tail[:, 1])
            beside = (self._side, self._horizontal(tail), tail[:, 2])
            for axes, x, y in (above, beside):
                _once(axes, Line2D(x, y, color=colour, linewidth=1.0))
                _once(axes, Line2D(x[-1:], y[-1:], linestyle="", marker="o", markersize=5, color=colour))
        for contact in self._contacts:
            if contact.time_s <= flown.time_s[sample]:
                east, north, up = (float(value) for value in contact.position)
                cross: dict[str, Any] = {"marker": "X", "markersize": 7, "mfc": BLACK, "mec": "white"}
                _once(self._plan, Line2D([east], [north], linestyle="", **cross))
                along = float(self._horizontal(contact.position))
                _once(self._side, Line2D([along], [up], linestyle="", **cross))

    def _draw_estimate(self, estimate: Array, sigma: Array, colour: str) -> None:
        if not (np.isfinite(estimate).all() and np.isfinite(sigma).all()):
            return
        along = self._frame.along
        sigma_along = float(sigma[0]) if self._level else float(np.sqrt(((along * sigma) ** 2).sum()))
        for axes, x, y, size_x, size_y in (
            (self._plan, float(estimate[0]), float(estimate[1]), float(sigma[0]), float(sigma[1])),
            (self._side, float(self._horizontal(estimate)), float(estimate[2]), sigma_along, float(sigma[2])),
        ):
            width, height = 2.0 * self._k * size_x, 2.0 * self._k * size_y
            _once(axes, Ellipse((x, y), width, height, facecolor=colour, edgecolor="none", alpha=0.13))
            _once(axes, Line2D([x], [y], linestyle="", marker="+", markersize=6, color=colour))


def _once(axes: Axes, artist: Artist) -> None:
    """Draw an artist into the picture without keeping it."""
    axes.add_artist(artist)
    axes.draw_artist(artist)
    artist.remove()
