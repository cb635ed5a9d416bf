"""A flight as a moving picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from numpy.typing import NDArray
from PIL import Image

from napf_mpc.errors import OutputError
from napf_mpc.formation import PathFrame
from napf_mpc.navigation.fix import diagonal
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
from napf_mpc.plot.tracks import Track, contacts, first_run, inflation_of, track
from napf_mpc.problem import Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.simulate import formation_mission
from napf_mpc.store import output_folder, write_bytes
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Sphere

Array = NDArray[np.float64]

FRAMES = 150
"""Frames at most."""
FRAMES_PER_S = 12.5
"""Frames shown a second (GIF times are whole hundredths of a second)."""
TAIL_S = 12.0
"""Length of the tails behind UAVs."""
GIF_DPI = 110
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
        frames = _Film(problem, flown, obstacles).frames()
    # One palette for all frames: what does not move is then the same and costs nothing.
    palette = frames[len(frames) // 2].quantize(COLOURS, dither=Image.Dither.NONE)
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


class _Film:
    """Everything that stands still is drawn once; frames restore it and draw what moves."""

    def __init__(self, problem: Problem, flown: Track, obstacles: ObstacleSet) -> None:
        self._problem, self._flown, self._obstacles = problem, flown, obstacles
        self._inflation = inflation_of(problem, flown.planner)
        self._k = Inflation.of_planner(problem.planner).k or 3.0
        self._shapes = obstacles.shapes() if len(obstacles) else []
        self._frame = PathFrame.of_mission(formation_mission(problem))
        self._small = flown.uavs <= MOST_UAVS
        self._contacts = contacts(flown, obstacles, problem.vehicle.radius_m)
        view = scene.view_of(flown.position, obstacles, pad_m=3.0, reach_m=10.0)
        along = self._frame.along_track(flown.position)
        level = abs(self._frame.heading_rad) < 1e-9
        self._along = flown.position[..., 0] if level else along
        span = view.x if level else (float(along.min()) - 3.0, float(along.max()) + 3.0)
        heights = flown.position[..., 2]
        low, high = float(heights.min()) - 3.0, float(heights.max()) + 3.0
        left, bottom, gap, top = 0.58, 0.4, 0.32, 0.28
        wide = PAGE_IN - left - 0.1
        scale = min(wide / view.width, 4.2 / view.height)
        plan_h = scale * view.height
        side_h = min(max((scale if level else wide / (span[1] - span[0])) * (high - low), 0.6), 1.6)
        # Whole pixels, and the same number in every frame.
        height = round((bottom + side_h + gap + plan_h + top) * GIF_DPI) / GIF_DPI
        page = Page.of_size(PAGE_IN, height, credit_of(problem))
        self._canvas = FigureCanvasAgg(page.figure)
        page.figure.set_dpi(GIF_DPI)
        self._side = page.axes(left, bottom, scale * view.width if level else wide, side_h)
        self._plan = page.axes(left, bottom + side_h + gap, scale * view.width, plan_h)
        self._plan.set(xlim=view.x, ylim=view.y, ylabel="North y (m)")
        self._side.set(
            xlim=span, ylim=(low, high), ylabel="Up z (m)", xlabel="East x (m)" if level else "Along the path (m)"
        )
        for axes in (self._plan, self._side):
            axes.locator_params(axis="y", nbins=5, steps=[1, 2, 5, 10])
            axes.yaxis.set_label_coords(-0.42 / (axes.get_position().width * PAGE_IN), 0.5)
        scene.draw_plan(self._plan, obstacles, view)
        scene.draw_side(self._side, obstacles, self._frame, view)
        page.text(left, height - 0.02, planner_name(flown.planner), va="top")
        handles: list[Any] = []
        if self._small:
            handles = [
                Line2D([], [], linestyle="", marker="o", markersize=5, color=GREY, label="UAV"),
                Line2D([], [], linestyle="", marker="+", markersize=5, color=GREY, label="its estimate"),
                Line2D([], [], linestyle="", marker="o", markersize=8, mfc="#DDDDDD", mec=GREY, mew=0.5,
                       label=f"{self._k:.3g}{scene.SIGMA}"),
            ]  # fmt: skip
        if self._inflation.k > 0.0:
            handles.append(
                Line2D([], [], color=GREY, linewidth=0.8, linestyle=(0, (3, 1.5)),
                       label=f"obstacle + {self._inflation.k:.3g}{scene.SIGMA}")
            )  # fmt: skip
        page.legend(handles, height - 0.02, x=left + 0.7)
        self._clock = page.figure.text(
            1.0 - 0.1 / PAGE_IN, 1.0 - 0.02 / float(page.figure.get_size_inches()[1]), "", ha="right", va="top",
            animated=True,
        )  # fmt: skip

    def frames(self) -> list[Image.Image]:
        """All frames as pictures."""
        times = self._flown.time_s
        picks = np.unique(np.linspace(0, len(times) - 1, min(FRAMES, len(times))).round().astype(int)).tolist()
        speed = (float(times[-1]) - float(times[0])) / max(1.0, (len(picks) - 1) / FRAMES_PER_S)
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
        for uav in range(flown.uavs):
            colour = uav_colour(uav)
            x, y, z = flown.position[since : sample + 1, uav].T
            along = self._along[since : sample + 1, uav]
            self._show(self._plan, x, y, colour)
            self._show(self._side, along, z, colour)
            estimate, sigma = flown.estimate[sample, uav], flown.sigma[sample, uav]
            if self._small and np.isfinite(estimate).all() and np.isfinite(sigma).all():
                self._show_estimate(estimate, sigma, colour)
        if self._inflation.k > 0.0 and self._small:
            self._show_inflated(sample)
        for contact in self._contacts:
            if contact.time_s <= flown.time_s[sample]:
                place = contact.position
                along_there = place[0] if self._along is not None else 0.0
                self._mark(self._plan, float(place[0]), float(place[1]))
                self._mark(self._side, float(along_there), float(place[2]))

    def _show(self, axes: Axes, x: Array, y: Array, colour: str) -> None:
        _once(axes, Line2D(x, y, color=colour, linewidth=1.0))
        _once(axes, Line2D(x[-1:], y[-1:], linestyle="", marker="o", markersize=5, color=colour))

    def _show_estimate(self, estimate: Array, sigma: Array, colour: str) -> None:
        along = float(self._frame.along_track(estimate))
        level = self._side.get_xlabel().startswith("East")
        across = (float(estimate[0]) if level else along, float(estimate[2]))
        spread_along = float(sigma[0]) if level else float(np.sqrt(((self._frame.along * sigma) ** 2).sum()))
        for axes, centre, size in (
            (self._plan, (float(estimate[0]), float(estimate[1])), (float(sigma[0]), float(sigma[1]))),
            (self._side, across, (spread_along, float(sigma[2]))),
        ):
            _once(
                axes,
                Ellipse(
                    centre, 2.0 * self._k * size[0], 2.0 * self._k * size[1],
                    facecolor=colour, edgecolor="none", alpha=0.13,
                ),
            )  # fmt: skip
            _once(axes, Line2D([centre[0]], [centre[1]], linestyle="", marker="+", markersize=5, color=colour))

    def _show_inflated(self, sample: int) -> None:
        pass

    def _mark(self, axes: Axes, x: float, y: float) -> None:
        _once(
            axes,
            Line2D([x], [y], linestyle="", marker="X", markersize=7, mfc=BLACK, mec="white", mew=0.5),
        )


def _once(axes: Axes, artist: Any) -> None:
    """Draw an artist into the picture without keeping it."""
    axes.add_artist(artist)
    artist.set_clip_path(axes.patch)
    axes.draw_artist(artist)
    artist.remove()
