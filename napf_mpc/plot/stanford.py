"""Stanford diagrams: protection levels against the errors that they were to bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from napf_mpc.navigation.integrity.stanford import Integrity, classify, count_classes
from napf_mpc.plot.style import BLUE, GREY, ORANGE, PAGE_IN, RULE, VERMILION, Page, house_style, save

Array = NDArray[np.float64]

LEFT_IN, GAP_IN, RIGHT_IN, BOTTOM_IN, HEAD_IN, KEY_IN = 0.5, 0.5, 0.1, 0.4, 0.56, 0.36
COLUMNS = 2
LOW_M = 0.5
"""Smaller ones are drawn here: the axes are logarithmic."""
_COLOURS = {
    Integrity.NOMINAL: BLUE,
    Integrity.MISLEADING: ORANGE,
    Integrity.HAZARDOUS: VERMILION,
    Integrity.UNAVAILABLE: GREY,
    Integrity.UNAVAILABLE_MISLEADING: "#8A4B08",
}
_WORDS = {
    Integrity.NOMINAL: "error ≤ PL ≤ AL",
    Integrity.MISLEADING: "misleading, PL < error ≤ AL",
    Integrity.HAZARDOUS: "hazardously misleading, PL ≤ AL < error",
    Integrity.UNAVAILABLE: "not available, AL < PL",
    Integrity.UNAVAILABLE_MISLEADING: "not available, and error > PL",
}


@dataclass(frozen=True)
class StanfordPanel:
    """Epochs of one diagram."""

    title: str
    """Above the panel."""
    error_m: Array
    """(n,) size of the position errors [m]."""
    level_m: Array
    """(n,) protection levels [m]; not finite where there is none."""
    alert_limit_m: float
    """Alert limit [m]."""


def stanford_figure(panels: Sequence[StanfordPanel], credit: str = "") -> Figure:
    """One diagram a panel, two in a row, with the count of each class.

    Parameters
    ----------
    panels : sequence of StanfordPanel
        At least one.
    credit : str
        Source and licence of shared data, printed below.
    """
    rows = -(-len(panels) // COLUMNS)
    side = (PAGE_IN - LEFT_IN - RIGHT_IN - (COLUMNS - 1) * GAP_IN) / COLUMNS
    tall = 0.66 * side
    height = rows * (BOTTOM_IN + tall + HEAD_IN) + KEY_IN
    page = Page.of_size(PAGE_IN, height, credit)
    high = 1.3 * max(float(np.nanmax(np.append(p.error_m, _finite(p.level_m)))) for p in panels)
    for place, panel in enumerate(panels):
        row, column = divmod(place, COLUMNS)
        bottom = (rows - 1 - row) * (BOTTOM_IN + tall + HEAD_IN) + BOTTOM_IN
        axes = page.axes(LEFT_IN + column * (side + GAP_IN), bottom, side, tall)
        _panel(axes, panel, max(high, 2.0 * panel.alert_limit_m))
        axes.set_xlabel("Position error (m)" if row == rows - 1 else "")
        axes.set_ylabel("Protection level (m)" if column == 0 else "")
    handles = [
        Line2D([], [], color=_COLOURS[kind], marker="o", markersize=3.5, linestyle="", label=_WORDS[kind])
        for kind in _COLOURS
    ]
    page.legend(handles, height - 0.02, columns=3)
    return page.figure


def _finite(values: Array) -> Array:
    return np.asarray(values[np.isfinite(values)])


def _panel(axes: Axes, panel: StanfordPanel, high: float) -> None:
    limit = panel.alert_limit_m
    codes = classify(panel.error_m, panel.level_m, limit)
    counts = count_classes(codes)
    for corners, colour in (
        ([(LOW_M, LOW_M), (limit, LOW_M), (limit, limit)], ORANGE),
        ([(limit, LOW_M), (high, LOW_M), (high, limit), (limit, limit)], VERMILION),
        ([(LOW_M, limit), (high, limit), (high, high), (LOW_M, high)], GREY),
    ):
        axes.add_patch(Polygon(corners, closed=True, facecolor=colour, alpha=0.13, linewidth=0.0, zorder=0))
    axes.plot([LOW_M, high], [LOW_M, high], color=RULE, linewidth=0.8, zorder=1)
    axes.axhline(limit, color=RULE, linewidth=0.6, linestyle="--", zorder=1)
    axes.plot([limit, limit], [LOW_M, limit], color=RULE, linewidth=0.6, linestyle="--", zorder=1)
    error, level = np.maximum(np.abs(panel.error_m), LOW_M), np.maximum(panel.level_m, LOW_M)
    for kind, colour in _COLOURS.items():
        mine = codes == kind
        axes.plot(error[mine], level[mine], "o", color=colour, markersize=2.0, mew=0.0, alpha=0.8)
    axes.set(xscale="log", yscale="log", xlim=(LOW_M, high), ylim=(LOW_M, high))
    for scale in (axes.xaxis, axes.yaxis):
        scale.set_major_formatter(lambda value, _: f"{value:g}")
        scale.set_minor_formatter(lambda *_: "")
    place: dict[str, Any] = {
        "transform": axes.get_yaxis_transform(),
        "ha": "right",
        "va": "top",
        "fontsize": 7.0,
    }
    axes.text(0.98, limit / 1.05, f"AL = {limit:g} m", color=RULE, **place)
    of = counts.by_class
    false = of[Integrity.UNAVAILABLE_MISLEADING]
    axes.set_title(
        f"{panel.title}, N = {counts.total}\n{of[Integrity.NOMINAL]} nominal, "
        f"{of[Integrity.MISLEADING]} misleading, {of[Integrity.HAZARDOUS]} hazardously;\n"
        f"{of[Integrity.UNAVAILABLE] + false} not available, {false} of them misleading",
        linespacing=1.25,
    )


def draw_stanford(panels: Sequence[StanfordPanel], out: Path, stem: str, credit: str = "") -> list[Path]:
    """Write :func:`stanford_figure` as PNG and SVG into a folder."""
    with house_style():
        return save(stanford_figure(panels, credit), out, stem)
