"""Tails of normalised errors: how often an error leaves k reported sigmas, and what is said to bound it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from scipy import special

from napf_mpc.navigation.integrity.overbound import AxisOverbound
from napf_mpc.plot.style import BLUE, GREY, PAGE_IN, RULE, VERMILION, Page, house_style, save

Array = NDArray[np.float64]

LEFT_IN, GAP_IN, RIGHT_IN, BOTTOM_IN, TALL_IN, HEAD_IN = 0.55, 0.2, 0.1, 0.4, 1.8, 0.5
LARGEST_K = 10.0


@dataclass(frozen=True)
class TailPanel:
    """Errors of one axis."""

    title: str
    """Above the panel."""
    normalised: Array
    """(n,) errors over reported sigmas that the bound was not fitted to."""
    bound: AxisOverbound
    """Fitted to others."""


def tail_figure(panels: Sequence[TailPanel], credit: str = "") -> Figure:
    """Share of errors beyond k sigmas on a logarithmic axis, beside the normal law and the overbound.

    The overbound is dashed where the sample that it was fitted to says nothing any more. Its line is what
    both sides together allow.

    Parameters
    ----------
    panels : sequence of TailPanel
        At least one, drawn in a row.
    credit : str
        Source and licence of shared data, printed below.
    """
    page = Page.of_size(PAGE_IN, BOTTOM_IN + TALL_IN + HEAD_IN, credit)
    width = (PAGE_IN - LEFT_IN - RIGHT_IN - (len(panels) - 1) * GAP_IN) / len(panels)
    k = np.linspace(0.0, LARGEST_K, 401)
    for place, panel in enumerate(panels):
        axes = page.axes(LEFT_IN + place * (width + GAP_IN), BOTTOM_IN, width, TALL_IN)
        size = np.sort(np.abs(panel.normalised))
        beyond = np.arange(len(size), 0, -1) / len(size)
        axes.step(size, beyond, where="pre", color=BLUE, linewidth=1.2)
        axes.plot(k, 2.0 * special.ndtr(-k), color=GREY, linewidth=0.8)
        bound = panel.bound
        allowed = np.minimum(1.0, 2.0 * special.ndtr(-(k - bound.bias) / bound.sigma))
        supported = bound.bias + bound.sigma * bound.supported_k
        told = k <= supported
        axes.plot(k[told], allowed[told], color=VERMILION)
        axes.plot(k[~told], allowed[~told], color=VERMILION, linestyle="--")
        axes.set(yscale="log", xlim=(0.0, LARGEST_K), ylim=(1e-3, 1.2), xticks=range(0, 10, 2))
        axes.axvline(3.0, color=RULE, linewidth=0.5, linestyle=":")
        axes.set_xlabel("k (reported sigmas)")
        axes.set_ylabel("Share of errors beyond k sigma" if place == 0 else "")
        axes.tick_params(labelleft=place == 0)
        axes.set_title(panel.title)
    handles = [
        Line2D([], [], color=BLUE, linewidth=1.2, label="measured"),
        Line2D([], [], color=GREY, linewidth=0.8, label="normal law"),
        Line2D([], [], color=VERMILION, label="overbound of the other half"),
        Line2D([], [], color=VERMILION, linestyle="--", label="beyond what that half can tell"),
    ]
    page.legend(handles, BOTTOM_IN + TALL_IN + HEAD_IN - 0.02)
    return page.figure


def draw_tails(panels: Sequence[TailPanel], out: Path, stem: str, credit: str = "") -> list[Path]:
    """Write :func:`tail_figure` as PNG and SVG into a folder."""
    with house_style():
        return save(tail_figure(panels, credit), out, stem)
