"""How often a solver or a planner is within a factor of the fastest, and how often within a time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from napf_mpc.plot.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PAGE_IN,
    PURPLE,
    SKY,
    VERMILION,
    Page,
    house_style,
    save,
)

Array = NDArray[np.float64]
COLOURS = (GREEN, BLUE, VERMILION, PURPLE, ORANGE, SKY, BLACK)
DASHES: tuple[Literal["-", "--", ":"], ...] = ("-", "--", ":")
"""Of the first so many solvers, of the next, and so on."""
LEFT_IN, GAP_IN, RIGHT_IN, BOTTOM_IN, TALL_IN = 0.62, 0.3, 0.12, 0.42, 2.1


def solvers_figure(
    times: Mapping[str, Array], correct: Mapping[str, NDArray[np.bool_]], period_s: float, note: str = ""
) -> Figure:
    """Performance profile (Dolan and More 2002) and distribution of times; an incorrect answer never arrives.

    Parameters
    ----------
    times : mapping of array, shape (P,)
        Label of a solver -> thread-CPU time of each of the same programs [us].
    correct : mapping of array of bool, shape (P,)
        Whether its answer was correct.
    period_s : float
        Of the planner, drawn as a line [s].
    note : str
        Printed below.
    """
    rows = -(-len(times) // 4)
    page = Page.of_size(PAGE_IN, BOTTOM_IN + TALL_IN + 0.16 * rows + 0.32, note)
    width = (PAGE_IN - LEFT_IN - RIGHT_IN - GAP_IN) / 2.0
    left = page.axes(LEFT_IN, BOTTOM_IN, width, TALL_IN)
    right = page.axes(LEFT_IN + width + GAP_IN, BOTTOM_IN, width, TALL_IN, sharey=left)
    arrived = {name: np.where(correct[name], values, np.inf) for name, values in times.items()}
    best = np.min(list(arrived.values()), axis=0)
    solvable = np.isfinite(best)
    handles = []
    for i, (name, values) in enumerate(arrived.items()):
        colour, dash = COLOURS[i % len(COLOURS)], DASHES[i // len(COLOURS) % len(DASHES)]
        _steps(left, values[solvable] / best[solvable], colour, dash)
        _steps(right, values, colour, dash)
        handles.append(Line2D([], [], label=name, color=colour, linestyle=dash))
    _period(right, period_s)
    for axes, words in ((left, "Time over the fastest solver's"), (right, "Time of a program (µs)")):
        axes.set_xscale("log")
        axes.set_xlabel(words)
        axes.set_ylim(0.0, 1.02)
    left.set_xlim(left=0.8)  # the fastest solver's line stands at 1, clear of the frame
    left.set_ylabel("Programs solved correctly")
    left.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    right.tick_params(labelleft=False)
    page.legend(handles, BOTTOM_IN + TALL_IN + 0.16 * rows + 0.28, columns=min(4, len(times)))
    return page.figure


def draw_solvers(
    times: Mapping[str, Array],
    correct: Mapping[str, NDArray[np.bool_]],
    period_s: float,
    out: Path,
    stem: str,
    note: str = "",
) -> list[Path]:
    """Write :func:`solvers_figure` as PNG and SVG into a folder."""
    with house_style():
        return save(solvers_figure(times, correct, period_s, note), out, stem)


def step_times_figure(times: Mapping[str, Array], period_s: float, note: str = "") -> Figure:
    """Distribution of the times of control steps.

    Parameters
    ----------
    times : mapping of array, shape (steps,)
        Label of a planner -> thread-CPU time of each of its steps [us].
    period_s : float
        Of the planner, drawn as a line [s].
    note : str
        Printed below.
    """
    width = 4.6
    rows = -(-len(times) // 3)
    page = Page.of_size(width, BOTTOM_IN + TALL_IN + 0.16 * rows + 0.32, note)
    axes = page.axes(LEFT_IN, BOTTOM_IN, width - LEFT_IN - RIGHT_IN, TALL_IN)
    handles = []
    for i, (name, values) in enumerate(times.items()):
        colour, dash = COLOURS[i % len(COLOURS)], DASHES[i // len(COLOURS) % len(DASHES)]
        _steps(axes, values, colour, dash)
        handles.append(Line2D([], [], label=name, color=colour, linestyle=dash))
    _period(axes, period_s)
    axes.set_xscale("log")
    axes.set_xlabel("Time of a control step of the formation (µs)")
    axes.set_ylim(0.0, 1.02)
    axes.set_ylabel("Steps")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    page.legend(handles, BOTTOM_IN + TALL_IN + 0.16 * rows + 0.28, columns=min(3, len(times)))
    return page.figure


def draw_step_times(
    times: Mapping[str, Array], period_s: float, out: Path, stem: str, note: str = ""
) -> list[Path]:
    """Write :func:`step_times_figure` as PNG and SVG into a folder."""
    with house_style():
        return save(step_times_figure(times, period_s, note), out, stem)


def _period(axes: Axes, period_s: float) -> None:
    """Line at the planner's period."""
    axes.axvline(1e6 * period_s, color=GREY, linewidth=0.8)
    axes.text(1e6 * period_s, 1.03, f"period {1e3 * period_s:.0f} ms", color=GREY, va="bottom", ha="right")


def _steps(axes: Axes, values: Array, colour: str, dash: Literal["-", "--", ":"]) -> None:
    """Part of all values that are at most x."""
    there = np.sort(values[np.isfinite(values)])
    if len(there):
        part = np.arange(len(there) + 1) / len(values)
        axes.step(np.append(there[0], there), part, where="post", color=colour, linestyle=dash)
