"""Figures of a comparison of planners: collision risk, what it costs, and how close it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from napf_mpc.plot.style import (
    BLACK,
    COLUMN_IN,
    EDGE_IN,
    GREY,
    Page,
    entry_width_in,
    house_style,
    legend_height_in,
    planner_colour,
    planner_name,
    save,
    text_width_in,
)
from napf_mpc.plot.trade import round_up, trade_figure
from napf_mpc.problem import Reference
from napf_mpc.risk import Rate, wilson

LEAST_FRAME_IN = 1.4
"""Width of the risks' frame where labels are long [in]; the figure grows."""


def compare_figures(
    summary: Mapping[str, Any],
    rows: Mapping[str, NDArray[Any]],
    out: Path,
    reference: Reference | None = None,
    credit: str = "",
) -> list[Path]:
    """Make the three figures of a comparison, PNG and SVG.

    Parameters
    ----------
    summary : mapping
        As :func:`napf_mpc.campaign.run_campaign` returns it.
    rows : mapping of str to array
        Columns of ``runs.parquet``.
    out : Path
        Output folder.
    reference : Reference, optional
        Published figures to show beside ours.
    credit : str
        Source and licence of shared data, printed below each figure.

    Returns
    -------
    list of Path
        ``compare_risk``, ``compare_trade`` and ``compare_clearance``.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    with house_style():
        figures = {
            "compare_risk": risk_figure(summary, reference, credit),
            "compare_trade": trade_figure(summary, credit),
            "compare_clearance": clearance_figure(summary, rows, credit),
        }
        return [path for stem, figure in figures.items() for path in save(figure, out, stem)]


def published(reference: Reference) -> dict[str, Rate]:
    """Published collision risks with the 95 % Wilson intervals of their number of runs."""
    return {
        name: wilson(round(risk * reference.runs), reference.runs)
        for name, risk in reference.collision_risk.items()
    }


def risk_figure(summary: Mapping[str, Any], reference: Reference | None = None, credit: str = "") -> Figure:
    """Collision risk of each planner with its 95 % interval, and the published one below it with its own."""
    planners: Mapping[str, Any] = summary["planners"]
    theirs = published(reference) if reference is not None else {}
    lines: list[tuple[str, str, float, float, float, bool]] = []
    for name, part in planners.items():
        risk = (part["collision_risk"], part["collision_risk_low"], part["collision_risk_high"])
        lines.append((name, f"{planner_name(name)}, N = {part['runs']}", *risk, True))
        if name in theirs:
            paper = theirs[name]
            label = f"{planner_name(name)}, published, N = {paper.total}"
            lines.append((name, label, paper.value, paper.low, paper.high, False))
    row, bottom, top, right, pad_pt = 0.25, 0.42, 0.08, 0.18, 7.0
    left = EDGE_IN + max(text_width_in(line[1]) for line in lines) + pad_pt / 72.0
    wide = max(COLUMN_IN, left + LEAST_FRAME_IN + right)
    notes = [credit] if reference is None else [f"Published: {reference.source}.", reference.note, credit]
    page = Page.of_size(wide, bottom + row * len(lines) + top, " ".join(note for note in notes if note))
    axes = page.axes(left, bottom, wide - left - right, row * len(lines))
    for place, (name, _, value, low, high, ours) in enumerate(lines):
        height = len(lines) - 1 - place
        axes.errorbar(
            value,
            height,
            xerr=[[max(0.0, value - low)], [max(0.0, high - value)]],
            fmt="o",
            markersize=4.5,
            color=planner_colour(name),
            mfc=planner_colour(name) if ours else "white",
            capsize=2.5,
            elinewidth=1.0,
            clip_on=False,
            zorder=3,
        )
    axes.set_yticks(range(len(lines)), [line[1] for line in reversed(lines)])
    axes.set(ylim=(-0.6, len(lines) - 0.4), xlim=(0.0, round_up(max(line[4] for line in lines))))
    axes.set_xlabel("Collision risk (%), 95 % interval")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=""))
    axes.tick_params(axis="y", length=0.0, pad=pad_pt)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x", color="#E4E4E4", linewidth=0.5)
    axes.set_axisbelow(True)
    return page.figure


def clearance_figure(
    summary: Mapping[str, Any], rows: Mapping[str, NDArray[Any]], credit: str = ""
) -> Figure:
    """Distribution of the least clearance of a run from an obstacle; the collisions lie left of zero."""
    planners: Sequence[str] = list(summary["planners"])
    counts = {name: int(summary["planners"][name]["runs"]) for name in planners}
    labels = [f"{planner_name(name)}, N = {counts[name]}" for name in planners]
    bottom, tall = 0.42, 1.8
    wide = max(COLUMN_IN, 2.0 * EDGE_IN + max(entry_width_in(words) for words in labels))
    height = bottom + tall + 0.2 + legend_height_in(labels, wide - 2.0 * EDGE_IN)
    page = Page.of_size(wide, height, credit)
    axes = page.axes(0.5, bottom, wide - 0.5 - 0.12, tall)
    lowest, highest = -0.5, 0.5
    for name in planners:
        values = np.asarray(rows["min_clearance_m"], dtype=float)[rows["planner"] == name]
        x, y = ecdf(values)
        if len(x) == 0:
            continue
        lowest, highest = min(lowest, float(x[1])), max(highest, float(np.quantile(x[1:], 0.99)))
        # The steps go on to both sides, beyond every edge.
        x = np.concatenate([[x[1] - 1e3], x[1:], [x[-1] + 1e3]])
        axes.plot(x, [*y, 1.0], drawstyle="steps-post", color=planner_colour(name), linewidth=1.2)
    if np.isfinite(np.asarray(rows["min_clearance_m"], dtype=float)).any():
        axes.axvline(0.0, color=BLACK, linewidth=0.8, linestyle=(0, (4, 2)), zorder=2)
        axes.annotate("contact", (0.0, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 1),
                      textcoords="offset points", ha="center", va="bottom")  # fmt: skip
    else:
        axes.text(0.5, 0.5, "no obstacles", transform=axes.transAxes, ha="center", color=GREY)
    # Wide enough on the left for the word above the line.
    axes.set(xlim=(min(1.05 * lowest, -0.08 * highest), 1.02 * highest), ylim=(0.0, 1.0))
    axes.set_xlabel("Least clearance of a run (m)")
    axes.set_ylabel("Runs with less (%)")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=""))
    handles = [
        Line2D([], [], color=planner_colour(name), linewidth=1.2, label=words)
        for name, words in zip(planners, labels, strict=True)
    ]
    page.legend(handles, height - 0.04)
    return page.figure


def ecdf(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Empirical distribution: sorted values after a first -inf, and the share of runs at or below each.

    Runs without a value (no obstacle, failed) count in none of it.
    """
    known = np.sort(values[np.isfinite(values)])
    if len(known) == 0:
        return np.empty(0), np.empty(0)
    return np.concatenate([[-np.inf], known]), np.linspace(0.0, 1.0, len(known) + 1)
