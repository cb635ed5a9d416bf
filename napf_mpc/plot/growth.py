"""Cost curves: how a time grows with a size, on logarithmic axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from napf_mpc.plot.style import BLUE, GREY, PAGE_IN, Page, house_style, save

LEFT_IN, GAP_IN, RIGHT_IN, BOTTOM_IN, TALL_IN, HEAD_IN = 0.6, 0.66, 0.12, 0.42, 1.5, 0.32
COLUMNS = 3


@dataclass(frozen=True)
class Curve:
    """Times at growing sizes."""

    grows: str
    """What grows."""
    size: Sequence[float]
    """Ascending, at least one."""
    median_ms: Sequence[float]
    """Time of each."""
    p99_ms: Sequence[float]
    """99th percentile; NaN for none."""
    exponent: float
    """Of the fitted power of the size, and ..."""
    level_ms: float
    """... its time at the size 1; NaN for no fit."""


def growth_figure(curves: Mapping[str, Curve], note: str = "") -> Figure:
    """One panel a curve: medians, 99th percentiles, and the fitted power of the size.

    Parameters
    ----------
    curves : mapping of Curve
        By their titles.
    note : str
        Printed below.
    """
    rows = -(-len(curves) // COLUMNS)
    page = Page.of_size(PAGE_IN, rows * (BOTTOM_IN + TALL_IN + HEAD_IN) + 0.2, note)
    width = (PAGE_IN - LEFT_IN - RIGHT_IN - (COLUMNS - 1) * GAP_IN) / COLUMNS
    for i, (label, curve) in enumerate(curves.items()):
        row, column = divmod(i, COLUMNS)
        bottom = (rows - 1 - row) * (BOTTOM_IN + TALL_IN + HEAD_IN) + BOTTOM_IN
        axes = page.axes(LEFT_IN + column * (width + GAP_IN), bottom, width, TALL_IN)
        axes.plot(curve.size, curve.median_ms, "o-", color=BLUE, markersize=3.5)
        axes.plot(curve.size, curve.p99_ms, "_", color=GREY, markersize=6.0)
        if curve.level_ms > 0.0:
            ends = [curve.size[0], curve.size[-1]]
            line = [curve.level_ms * end**curve.exponent for end in ends]
            axes.plot(ends, line, color=GREY, linewidth=0.8, linestyle="--")
            words = f"fit: size$^{{{curve.exponent:.2f}}}$"
            axes.text(0.04, 0.95, words, color=GREY, va="top", transform=axes.transAxes)
        for axis, log in ((axes.xaxis, axes.set_xscale), (axes.yaxis, axes.set_yscale)):
            log("log")
            axis.set_minor_formatter(NullFormatter())
        _whole_decades(axes)
        axes.set_xlabel(curve.grows[:1].upper() + curve.grows[1:])
        axes.set_ylabel("Time (ms)")
        axes.set_title(label[:1].upper() + label[1:])
    drawn = [
        Line2D([], [], color=BLUE, marker="o", markersize=3.5, label="median"),
        Line2D([], [], color=GREY, marker="_", linestyle="", label="99th percentile"),
        Line2D([], [], color=GREY, linestyle="--", linewidth=0.8, label="fitted power of the size"),
    ]
    page.legend(drawn, rows * (BOTTOM_IN + TALL_IN + HEAD_IN) + 0.12)
    return page.figure


def draw_growth(curves: Mapping[str, Curve], out: Path, stem: str, note: str = "") -> list[Path]:
    """Write :func:`growth_figure` as PNG and SVG into a folder."""
    with house_style():
        return save(growth_figure(curves, note), out, stem)


def _whole_decades(axes: Axes) -> None:
    """Widen axes to powers of ten, so that each has labels."""
    for low_high, limits in ((axes.get_xlim(), axes.set_xlim), (axes.get_ylim(), axes.set_ylim)):
        low, high = math.log10(low_high[0]), math.log10(low_high[1])
        limits(10.0 ** math.floor(low), 10.0 ** max(math.ceil(high), math.floor(low) + 1))
