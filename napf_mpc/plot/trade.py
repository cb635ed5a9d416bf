"""What safety costs: collision risk against formation error, of planners and of their k."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

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

METRICS = (("shape_rms_m", "Shape RMS (m)"), ("path_rms_m", "Path RMS (m)"))
"""Metrics that are set against the risk."""
K_MARKERS = "osD^vP*Xhp"
"""Marker of each k, the smallest first; repeated for more."""
FINISHED = 0.95
"""A planner of which fewer missions finish is drawn hollow: it may be safe because it stands still."""
LEFT_IN, GAP_IN, RIGHT_IN = 0.55, 0.25, 0.1
"""Margins of the two panels on a page [in]."""
NOTE_CHARACTERS_AN_INCH = 17
"""In a line of the note above the panels."""
NOTE_LINE_IN = 0.14
"""Height of such a line [in]."""

Part = Mapping[str, Any]
"""What a summary says of one planner."""


def trade_figure(summary: Mapping[str, Any], credit: str = "") -> Figure:
    """Collision risk with its 95 % interval against formation error, median and 5th to 95th percentile.

    A dashed line marks ``shape_floor_m``: the shape error that the navigation errors alone would cause if
    every UAV sat on its estimate's slot. A UAV too slow to follow its estimate can stay below. A lone UAV has
    no shape, and no panel for it.

    Parameters
    ----------
    summary : mapping
        As :func:`napf_mpc.campaign.run_campaign` returns it.
    credit : str
        Source and licence of shared data, printed below.
    """
    planners: Mapping[str, Part] = summary["planners"]
    lone = all(part.get("uavs") == 1 for part in planners.values())
    metrics = METRICS[1:] if lone else METRICS
    wide = COLUMN_IN if lone else PAGE_IN
    handles = [_planner_handle(name, marker="o") for name in planners]
    note = _note(planners.values(), metrics, wide)
    bottom, tall = 0.4, 2.0
    height = bottom + tall + _key_height_in(handles, note, wide)
    page = Page.of_size(wide, height, credit)
    for (metric, words), axes in zip(metrics, _panels(page, bottom, tall, len(metrics)), strict=True):
        for name, part in planners.items():
            _point(axes, part, metric, planner_colour(name))
        _scale(axes, planners.values(), metric)
        _floor(axes, planners.values(), metric)
        axes.set_xlabel(words)
    _key(page, height - 0.02, handles, note)
    return page.figure


def fronts_figure(
    fronts: Mapping[str, Mapping[str, Mapping[float, Part]]], credit: str = "", note: str = ""
) -> Figure:
    """One row a cell: how risk falls and formation error grows with k, a line for each planner.

    Parameters
    ----------
    fronts : mapping
        Label of a cell -> name of a planner -> k -> what a summary says of it.
    credit : str
        Source and licence of shared data, printed below.
    note : str
        Such as the number of runs and the seeds, printed below.

    Raises
    ------
    ValueError
        If there is nothing to draw.
    """
    planners = list(dict.fromkeys(name for cell in fronts.values() for name in cell))
    levels = sorted({k for cell in fronts.values() for front in cell.values() for k in front})
    if not levels:
        raise ValueError("fronts is empty: there is nothing to draw")
    markers = {k: K_MARKERS[i % len(K_MARKERS)] for i, k in enumerate(levels)}
    handles = [_planner_handle(name) for name in planners]
    handles += [
        Line2D([], [], color=GREY, linewidth=0.0, marker=markers[k], markersize=4.5, label=f"k = {k:g}")
        for k in levels
    ]
    every = [part for cell in fronts.values() for front in cell.values() for part in front.values()]
    above = _note(every, METRICS, PAGE_IN)
    tall, title, between, bottom = 1.45, 0.2, 0.3, 0.42
    row = tall + title + between
    height = bottom + row * len(fronts) - between + _key_height_in(handles, above, PAGE_IN) + 0.04
    page = Page.of_size(PAGE_IN, height, " ".join(words for words in (note, credit) if words))
    for place, (cell, of_planner) in enumerate(fronts.items()):
        base = bottom + row * (len(fronts) - 1 - place)
        parts = [part for front in of_planner.values() for part in front.values()]
        for side, axes in enumerate(_panels(page, base, tall)):
            metric, words = METRICS[side]
            for name, front in of_planner.items():
                colour = planner_colour(name)
                known = [(k, front[k]) for k in sorted(front) if front[k][metric]["median"] is not None]
                axes.plot(
                    [part[metric]["median"] for _, part in known],
                    [part["collision_risk"] for _, part in known],
                    color=colour,
                    linewidth=1.1,
                    clip_on=False,
                    zorder=3,
                )
                for k, part in known:
                    _point(axes, part, metric, colour, markers[k], thin=True)
            _scale(axes, parts, metric)
            _floor(axes, parts, metric)
            if place == len(fronts) - 1:
                axes.set_xlabel(words)
            if side == 0:
                axes.set_title(f"({chr(97 + place)}) {cell}", pad=5.0)
    _key(page, height - 0.06, handles, above)
    return page.figure


def draw_fronts(
    fronts: Mapping[str, Mapping[str, Mapping[float, Part]]],
    out: Path,
    stem: str,
    credit: str = "",
    note: str = "",
) -> list[Path]:
    """Write :func:`fronts_figure` as ``stem.png`` and ``stem.svg``.

    Raises
    ------
    ValueError
        If there is nothing to draw.
    OutputError
        If the folder cannot be written.
    """
    with house_style():
        return save(fronts_figure(fronts, credit, note), out, stem)


def round_up(share: float) -> float:
    """Upper end of an axis for shares up to this one."""
    for limit in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0):
        if share <= limit:
            return limit
    return 1.0


def _panels(page: Page, base_in: float, tall_in: float, count: int = 2) -> list[Axes]:
    """Panels side by side, the risk's axis named on the left one."""
    full = float(page.figure.get_size_inches()[0])
    wide = (full - LEFT_IN - (count - 1) * GAP_IN - RIGHT_IN) / count
    panels = [page.axes(LEFT_IN + side * (wide + GAP_IN), base_in, wide, tall_in) for side in range(count)]
    panels[0].set_ylabel("Collision risk (%)")
    for axes in panels[1:]:
        axes.tick_params(labelleft=False)
    return panels


def _scale(axes: Axes, parts: Iterable[Part], metric: str) -> None:
    """From zero to the end of the widest bar, so that nothing looks farther away than it is."""
    known = [part for part in parts if part[metric]["median"] is not None]
    ends = [part[metric]["p95"] for part in known]
    floors = [part["shape_floor_m"]["median"] or 0.0 for part in known] if metric == "shape_rms_m" else []
    reach = max([*ends, *floors], default=0.0)
    highest = round_up(max((part["collision_risk_high"] for part in known), default=1.0))
    # A little below zero, so that points and bars of planners that never hit do not lie on the axis.
    axes.set(xlim=(0.0, 1.06 * reach or 1.0), ylim=(-0.04 * highest, highest))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=""))


def _floor(axes: Axes, parts: Iterable[Part], metric: str) -> None:
    """Mark what the navigation errors alone do to the shape."""
    known = [part["shape_floor_m"]["median"] for part in parts if part["shape_floor_m"]["median"] is not None]
    if metric == "shape_rms_m" and known:
        axes.axvline(float(np.median(known)), color=GREY, linewidth=0.8, linestyle=(0, (4, 2)), zorder=1)


def _point(
    axes: Axes, part: Part, metric: str, colour: str, marker: str = "o", *, thin: bool = False
) -> None:
    """Risk against a metric, with both bars; hollow if many missions did not finish."""
    spread, risk = part[metric], part["collision_risk"]
    if spread["median"] is None:
        return
    axes.errorbar(
        spread["median"],
        risk,
        xerr=[[spread["median"] - spread["p05"]], [spread["p95"] - spread["median"]]],
        yerr=[
            [max(0.0, risk - part["collision_risk_low"])],
            [max(0.0, part["collision_risk_high"] - risk)],
        ],
        fmt=marker,
        markersize=5,
        capsize=0.0 if thin else 2.5,
        elinewidth=0.6 if thin else 1.0,
        color=colour,
        mfc=colour if _finishes(part) else "white",
        zorder=4,
        clip_on=False,
    )


def _finishes(part: Part) -> bool:
    return bool(part["finished"] >= FINISHED)


def _planner_handle(name: str, marker: str = "") -> Line2D:
    return Line2D(
        [], [], color=planner_colour(name), marker=marker or None, markersize=4.5, label=planner_name(name)
    )


def _note(parts: Iterable[Part], metrics: Sequence[tuple[str, str]], wide_in: float) -> str:
    """What bars, the dashed line and hollow points mean, in lines that stand on a page of a width."""
    every = list(parts)
    words = ["bars: 5th to 95th percentile of runs, and 95 % interval of the risk"]
    if any(metric == "shape_rms_m" for metric, _ in metrics) and any(
        part["shape_floor_m"]["median"] is not None for part in every
    ):
        words.append("dashed: shape error from navigation errors alone")
    if not all(_finishes(part) for part in every):
        words.append(f"hollow: fewer than {100 * FINISHED:g} % of the missions finished")
    return "\n".join(textwrap.wrap("; ".join(words), int(NOTE_CHARACTERS_AN_INCH * (wide_in - LEFT_IN))))


def _key_height_in(handles: Sequence[Line2D], note: str, wide_in: float) -> float:
    """Height of legend and note with the space around them [in]."""
    labels = [str(handle.get_label()) for handle in handles]
    rows_in = legend_height_in(labels, wide_in - LEFT_IN - EDGE_IN)
    return rows_in + NOTE_LINE_IN * (note.count("\n") + 1) + 0.1


def _key(page: Page, edge_in: float, handles: Sequence[Line2D], note: str) -> None:
    """Legend, and below it what bars and hollow points mean."""
    page.legend(handles, edge_in, x=LEFT_IN)
    labels = [str(handle.get_label()) for handle in handles]
    wide_in = float(page.figure.get_size_inches()[0])
    below = edge_in - legend_height_in(labels, wide_in - LEFT_IN - EDGE_IN)
    page.text(LEFT_IN, below, note, ha="left", va="top", color=GREY, linespacing=1.15)
