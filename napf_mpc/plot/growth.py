"""Cost curves: how a time grows with a size, on logarithmic axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from napf_mpc.benchmark.growth import Point, Study, growth
from napf_mpc.plot.style import BLUE, GREY, PAGE_IN, Page, house_style, save

LEFT_IN, GAP_IN, RIGHT_IN, BOTTOM_IN, TALL_IN, HEAD_IN = 0.6, 0.66, 0.12, 0.42, 1.5, 0.32
COLUMNS = 3


def growth_figure(
    points: Mapping[str, Sequence[Point]], studies: Mapping[str, Study], note: str = ""
) -> Figure:
    """One panel a study: medians, 99th percentiles, and the fitted power of the size.

    Parameters
    ----------
    points : mapping of sequence of Point
        Label of a study -> its sizes, at least one.
    studies : mapping of Study
        By the same labels.
    note : str
        Printed below.
    """
    rows = -(-len(points) // COLUMNS)
    page = Page.of_size(PAGE_IN, rows * (BOTTOM_IN + TALL_IN + HEAD_IN) + 0.2, note)
    width = (PAGE_IN - LEFT_IN - RIGHT_IN - (COLUMNS - 1) * GAP_IN) / COLUMNS
    for i, (label, own) in enumerate(points.items()):
        row, column = divmod(i, COLUMNS)
        bottom = (rows - 1 - row) * (BOTTOM_IN + TALL_IN + HEAD_IN) + BOTTOM_IN
        axes = page.axes(LEFT_IN + column * (width + GAP_IN), bottom, width, TALL_IN)
        study = studies[label]
        size, median = [point.size for point in own], [1e-3 * point.cost_us for point in own]
        axes.plot(size, median, "o-", color=BLUE, markersize=3.5)
        axes.plot(size, [1e-3 * point.p99_us for point in own], "_", color=GREY, markersize=6.0)
        fit = growth(own)
        if fit.level_us > 0.0:
            ends = [size[0], size[-1]]
            line = [1e-3 * fit.level_us * end**fit.exponent for end in ends]
            axes.plot(ends, line, color=GREY, linewidth=0.8, linestyle="--")
            words = f"fit: size$^{{{fit.exponent:.2f}}}$"
            axes.text(0.97, 0.05, words, color=GREY, ha="right", transform=axes.transAxes)
        for axis, log in ((axes.xaxis, axes.set_xscale), (axes.yaxis, axes.set_yscale)):
            log("log")
            axis.set_minor_formatter(NullFormatter())
        _whole_decades(axes)
        axes.set_xlabel(study.grows[:1].upper() + study.grows[1:])
        axes.set_ylabel("Time (ms)")
        axes.set_title(label[:1].upper() + label[1:])
    drawn = [
        Line2D([], [], color=BLUE, marker="o", markersize=3.5, label="median"),
        Line2D([], [], color=GREY, marker="_", linestyle="", label="99th percentile"),
        Line2D([], [], color=GREY, linestyle="--", linewidth=0.8, label="fitted power of the size"),
    ]
    page.legend(drawn, rows * (BOTTOM_IN + TALL_IN + HEAD_IN) + 0.12)
    return page.figure


def draw_growth(
    points: Mapping[str, Sequence[Point]], studies: Mapping[str, Study], out: Path, stem: str, note: str = ""
) -> list[Path]:
    """Write :func:`growth_figure` as PNG and SVG into a folder."""
    with house_style():
        return save(growth_figure(points, studies, note), out, stem)


def _whole_decades(axes: Axes) -> None:
    """Widen axes to powers of ten, so that each has labels."""
    for low_high, limits in ((axes.get_xlim(), axes.set_xlim), (axes.get_ylim(), axes.set_ylim)):
        low, high = math.log10(low_high[0]), math.log10(low_high[1])
        limits(10.0 ** math.floor(low), 10.0 ** max(math.ceil(high), math.floor(low) + 1))
