"""House style of all figures: sizes, colours, pages laid out in inches, and files that are the same twice."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

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

# Okabe and Ito's palette, told apart with any common colour vision; their yellow is too pale for lines.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
UAV_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Colour of UAV 1, 2, ...; repeated for larger formations."""
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


def uav_colour(uav: int) -> str:
    """Colour of UAV ``uav``, counted from zero."""
    return UAV_COLOURS[uav % len(UAV_COLOURS)]


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
        """One legend for all panels, its upper edge at a height [in], outside every frame."""
        if not handles:
            return
        full_width = float(self.figure.get_size_inches()[0])
        place = self._fraction(full_width / 2.0 if x is None else x, y, 0.0, 0.0)
        self.figure.legend(
            handles=handles,
            loc="upper center" if x is None else "upper left",
            bbox_to_anchor=(place[0], place[1]),
            ncol=columns or len(handles),
            borderpad=0.0,
            handletextpad=0.5,
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
