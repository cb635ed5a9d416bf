"""Figure of a sweep: collision risk along one key, a panel for each combination of the others."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator, PercentFormatter
from numpy.typing import NDArray

from napf_mpc.plot.style import (
    COLUMN_IN,
    EDGE_IN,
    GREY,
    PAGE_IN,
    Page,
    house_style,
    legend_height_in,
    planner_colour,
    planner_name,
    save,
)
from napf_mpc.plot.trade import round_up

LEFT_IN, GAP_IN, RIGHT_IN, BOTTOM_IN, TALL_IN = 0.52, 0.2, 0.12, 0.42, 1.5
NOTE_IN = 0.2
"""Height of the note below the legend [in]."""
COLUMNS = 3
MARKERS = "osD^v"
TITLE_CHARACTERS = 34
"""In a line of a panel's title."""
WIDE_RANGE = 30.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""


def sweep_figure(columns: Mapping[str, NDArray[Any]], keys: Sequence[str], credit: str = "") -> Figure:
    """Collision risk of each planner with its 95 % interval along the last key, a panel for the others.

    Parameters
    ----------
    columns : mapping of str to array
        As :func:`napf_mpc.sweep.run_sweep` returns them.
    keys : sequence of str
        Keys that were varied.
    credit : str
        Source and licence of shared data, printed below.
    """
    *others, along = keys
    panels = list(dict.fromkeys(zip(*(columns[key].tolist() for key in others), strict=True))) or [()]
    planners = list(dict.fromkeys(columns["planner"].tolist()))
    wide = COLUMN_IN if len(panels) == 1 else PAGE_IN
    across = min(COLUMNS, len(panels))
    lines = max((len(_title(others, panel)) for panel in panels), default=0)
    head = 0.12 + 0.14 * lines
    row_in = TALL_IN + head + BOTTOM_IN
    down = -(-len(panels) // COLUMNS)
    key_in = legend_height_in([planner_name(planner) for planner in planners], wide - LEFT_IN - EDGE_IN)
    height = down * row_in + NOTE_IN + key_in
    page = Page.of_size(wide, height, credit)
    width = (wide - LEFT_IN - RIGHT_IN - (across - 1) * GAP_IN) / across
    highest = round_up(float(columns["collision_risk_high"].max()))
    values = list(dict.fromkeys(columns[along].tolist()))
    places, log = _places(values)
    for i, panel in enumerate(panels):
        row, column = divmod(i, COLUMNS)
        axes = page.axes(
            LEFT_IN + column * (width + GAP_IN), BOTTOM_IN + (down - 1 - row) * row_in, width, TALL_IN
        )
        here = np.ones(len(columns["planner"]), dtype=bool)
        for key, value in zip(others, panel, strict=True):
            here &= columns[key] == value
        for n, planner in enumerate(planners):
            mine = here & (columns["planner"] == planner)
            x = _beside(
                [places[value] for value in columns[along][mine].tolist()], n, len(planners), places, log
            )
            risk = columns["collision_risk"][mine]
            # Rounding may put an end a hair on the wrong side of the rate.
            bars = np.maximum(
                [risk - columns["collision_risk_low"][mine], columns["collision_risk_high"][mine] - risk], 0.0
            )
            axes.errorbar(
                x, risk, yerr=bars, fmt=f"{MARKERS[n % len(MARKERS)]}-", markersize=4.0, capsize=2.0,
                elinewidth=0.8, color=planner_colour(planner), clip_on=False, zorder=3,
            )  # fmt: skip
        _scale(axes, places, log, highest)
        axes.tick_params(labelleft=column == 0)
        if column == 0:
            axes.set_ylabel("Collision risk (%)")
        if i + COLUMNS >= len(panels):
            axes.set_xlabel(along)
        axes.set_title("\n".join(_title(others, panel)))
    drawn = [
        Line2D(
            [], [], color=planner_colour(planner), marker=MARKERS[n % len(MARKERS)], markersize=4.0,
            label=planner_name(planner),
        )
        for n, planner in enumerate(planners)
    ]  # fmt: skip
    page.legend(drawn, height - 0.04, x=LEFT_IN)
    note = f"bars: 95 % interval, N = {columns['runs'][0]}"
    page.text(LEFT_IN, height - 0.04 - key_in, note, ha="left", va="top", color=GREY)
    return page.figure


def draw_sweep(
    columns: Mapping[str, NDArray[Any]], keys: Sequence[str], out: Path, credit: str = ""
) -> list[Path]:
    """Write :func:`sweep_figure` as ``sweep.png`` and ``sweep.svg``.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    with house_style():
        return save(sweep_figure(columns, keys, credit), out, "sweep")


def _title(keys: Sequence[str], values: Sequence[str]) -> list[str]:
    words = ", ".join(f"{key} = {value}" for key, value in zip(keys, values, strict=True))
    return textwrap.wrap(words, TITLE_CHARACTERS)


def _places(values: Sequence[str]) -> tuple[dict[str, float], bool]:
    """Where each value stands on the axis, words in a row; and whether the axis is logarithmic."""
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        return {value: float(i) for i, value in enumerate(values)}, False
    if not np.isfinite(numbers).all():
        return {value: float(i) for i, value in enumerate(values)}, False
    log = min(numbers) > 0.0 and max(numbers) / min(numbers) >= WIDE_RANGE
    if not log and max(numbers) - min(numbers) > WIDE_RANGE * float(
        np.diff(np.sort(numbers)).min(initial=np.inf)
    ):
        # Among numbers this far apart the near ones would lie on each other: they stand in a row.
        return {value: float(i) for i, value in enumerate(values)}, False
    return dict(zip(values, numbers, strict=True)), log


def _beside(
    x: list[float], n: int, count: int, places: Mapping[str, float], log: bool
) -> NDArray[np.float64]:
    """Planners a little beside each other, so that their bars can be told apart."""
    spots = np.array(sorted(places.values()))
    shift = 0.03 * (n - 0.5 * (count - 1))
    if log:
        return np.asarray(np.array(x) * (spots[-1] / spots[0]) ** shift)
    return np.array(x) + shift * float(np.ptp(spots) or 1.0)


def _scale(axes: Axes, places: Mapping[str, float], log: bool, highest: float) -> None:
    spots = np.array(sorted(places.values()))
    labels = [next(value for value, place in places.items() if place == spot) for spot in spots]
    if log:
        axes.set_xscale("log")
        margin = (spots[-1] / spots[0]) ** 0.08
        axes.set_xlim(spots[0] / margin, spots[-1] * margin)
    else:
        margin = 0.08 * float(np.ptp(spots) or 5.0)
        axes.set_xlim(spots[0] - margin, spots[-1] + margin)
    axes.set_xticks(spots, labels)
    axes.xaxis.set_minor_locator(NullLocator())
    # A little below zero, so that points that never hit do not lie on the axis.
    axes.set_ylim(-0.04 * highest, highest)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol="", decimals=None))
