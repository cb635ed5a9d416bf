"""House style of all figures: sizes, colours, pages laid out in inches, and files that are the same twice."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from matplotlib.textpath import text_to_path

from napf_mpc.problem import Problem
from napf_mpc.store import output_folder, write_bytes

COLUMN_IN = 3.5
"""Width of a figure in one column of a journal page [in]."""
PAGE_IN = 7.2
"""Width of a figure over the whole page [in]."""
DPI = 200
"""Dots per inch of the PNG files."""
FONT_PT = 8.0
"""Size of all text but the credit line [pt]."""
CREDIT_PT = 7.0
"""Size of the credit line [pt]."""
EDGE_IN = 0.06
"""Least space between words and the edge of a page [in]."""
LEGEND_ROW_IN = 0.18
"""Height of a row of a legend [in]."""

# Okabe and Ito's palette, told apart with any common colour vision; their yellow is too pale for lines.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
UAV_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Colour of UAV 1, 2, ... in formations that are no larger than this."""
UAV_MAP, UAV_MAP_END = "plasma", 0.88
"""Colours of the UAVs of larger formations, but for those too pale for lines."""
PLANNER_COLOURS = {
    "apf": VERMILION,
    "napf": BLUE,
    "napf_guided": SKY,
    "qp": GREEN,
    "qp_unguided": PURPLE,
}
PLANNER_NAMES = {
    "apf": "APF",
    "napf": "NAPF",
    "napf_guided": "NAPF guided",
    "qp": "QP",
    "qp_unguided": "QP unguided",
}
HANDLE_PAD = 0.5
"""Space between line and words of a legend's entry, in sizes of the text."""
GREY, PALE, RULE = "#6E6E6E", "#C8C8C8", "#3C3C3C"
"""Notes, fills and thin rules."""

_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same on every machine
    "font.size": FONT_PT,
    "axes.titlesize": FONT_PT,
    "axes.labelsize": FONT_PT,
    "xtick.labelsize": FONT_PT,
    "ytick.labelsize": FONT_PT,
    "legend.fontsize": FONT_PT,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.labelpad": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
    "legend.borderaxespad": 0.0,
    "hatch.linewidth": 0.5,
    "savefig.dpi": DPI,
    "svg.hashsalt": "napf_mpc",  # without it every file gets random ids
    "svg.fonttype": "path",
}


@contextmanager
def house_style() -> Iterator[None]:
    """Set the style for figures made and saved inside; the caller's own settings come back afterwards."""
    with matplotlib.style.context(["default", _RC]):
        yield


def uav_colour(uav: int, uavs: int = len(UAV_COLOURS)) -> str:
    """Colour of UAV ``uav``, counted from zero, in a formation of ``uavs``."""
    if uavs <= len(UAV_COLOURS):
        return UAV_COLOURS[uav % len(UAV_COLOURS)]
    return to_hex(colormaps[UAV_MAP](UAV_MAP_END * uav / (uavs - 1)))


def planner_colour(planner: str) -> str:
    """Colour of a planner; grey for one that has none."""
    return PLANNER_COLOURS.get(planner, GREY)


def planner_name(planner: str) -> str:
    """Name of a planner as the paper writes it."""
    return PLANNER_NAMES.get(planner, planner)


def credit_of(problem: Problem) -> str:
    """Source and licence of the shared data behind a problem, empty if it uses none."""
    sources = [getattr(problem.world, "credit", ""), getattr(problem.navigation, "credit", "")]
    return ". ".join(dict.fromkeys(text.rstrip(".") for text in sources if text))


def text_width_in(words: str) -> float:
    """Width of one line of text of the usual size, dollar signs as they are [in]."""
    font = FontProperties(family=_RC["font.family"], size=FONT_PT)
    return float(text_to_path.get_text_width_height_descent(words, font, False)[0]) / 72.0


def entry_width_in(words: str) -> float:
    """Width of a legend's entry: a line, and words beside it [in]."""
    return text_width_in(words) + float(_RC["legend.handlelength"] + HANDLE_PAD) * FONT_PT / 72.0


def legend_columns(labels: Sequence[str], room_in: float) -> int:
    """Most columns of a legend, filled column by column, that stand in a room; at least one."""
    em_in = FONT_PT / 72.0
    widths = [entry_width_in(words) for words in labels]
    for columns in range(len(labels), 1, -1):
        needed = sum(max(part) for part in np.array_split(widths, columns))
        if needed + (columns - 1) * _RC["legend.columnspacing"] * em_in <= room_in:
            return columns
    return 1


def legend_height_in(labels: Sequence[str], room_in: float) -> float:
    """Height of the rows of a legend that stands in a room of this width [in]."""
    return LEGEND_ROW_IN * -(-len(labels) // legend_columns(labels, room_in))


@dataclass(frozen=True)
class Page:
    """Figure laid out in inches from the lower left corner of its drawing area, a credit line below."""

    figure: Figure
    """The figure."""
    footer_in: float
    """Height of the credit line under the drawing area [in]."""

    @classmethod
    def of_size(cls, width_in: float, height_in: float, credit: str = "") -> Page:
        """Page with a drawing area of a size, and a credit line that makes the figure so much taller."""
        lines = textwrap.wrap(credit, max(20, int(width_in / 0.062)))
        footer = 0.13 * len(lines) + 0.05 if lines else 0.0
        figure = Figure(figsize=(width_in, height_in + footer))
        if lines:
            y = (footer - 0.02) / (height_in + footer)
            words = "\n".join(lines)
            # A file's own words: dollar signs are prices, not formulas.
            figure.text(
                0.06 / width_in, y, words, fontsize=CREDIT_PT, color=GREY, va="top", linespacing=1.15,
                parse_math=False,
            )  # fmt: skip
        return cls(figure, footer)

    def _fraction(
        self, left: float, bottom: float, width: float, height: float
    ) -> tuple[float, float, float, float]:
        full_width, full_height = self.figure.get_size_inches()
        return (
            left / full_width,
            (bottom + self.footer_in) / full_height,
            width / full_width,
            height / full_height,
        )

    def axes(self, left: float, bottom: float, width: float, height: float, **options: Any) -> Axes:
        """Axes whose inner frame lies at the given place [in]."""
        left, bottom, width, height = self._fraction(left, bottom, width, height)
        return self.figure.add_axes((left, bottom, width, height), **options)

    def text(self, x: float, y: float, words: str, **options: Any) -> Text:
        """Text at a place [in], as it is: dollar signs make no formula."""
        x, y, _, _ = self._fraction(x, y, 0.0, 0.0)
        return self.figure.text(x, y, words, parse_math=False, **options)

    def legend(self, handles: Sequence[Any], y: float, x: float | None = None, columns: int = 0) -> None:
        """One legend for all panels, its upper edge at a height [in], outside every frame.

        It is centred, or begins at ``x``. Without a number of columns it has as many as the page is wide.
        """
        if not handles:
            return
        full_width = float(self.figure.get_size_inches()[0])
        room = full_width - EDGE_IN - (EDGE_IN if x is None else x)
        place = self._fraction(full_width / 2.0 if x is None else x, y, 0.0, 0.0)
        self.figure.legend(
            handles=handles,
            loc="upper center" if x is None else "upper left",
            bbox_to_anchor=(place[0], place[1]),
            ncol=columns or legend_columns([str(handle.get_label()) for handle in handles], room),
            borderpad=0.0,
            handletextpad=HANDLE_PAD,
        )


def plain_panes(axes: Any) -> None:
    """Give axes in space white walls with a pale grid (mplot3d has no type information)."""
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis._axinfo["grid"].update(color="#E4E4E4", linewidth=0.4)


def save(figure: Figure, out: Path, stem: str) -> list[Path]:
    """Write a figure as ``stem.png`` and ``stem.svg``, without dates: the same figure is the same file.

    Raises
    ------
    OutputError
        If the folder cannot be made or written.
    """
    folder = output_folder(out)
    png, svg = folder / f"{stem}.png", folder / f"{stem}.svg"
    none: dict[str, Any] = {"Date": None, "Creator": None}
    write_bytes(png, lambda file: figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None}))
    write_bytes(svg, lambda file: figure.savefig(file, format="svg", dpi=DPI, metadata=none))
    return [png, svg]
