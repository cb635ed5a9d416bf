"""Stanford diagrams and tails show the classes, counts and shares that they are given."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from scipy import special

from napf_mpc.navigation.integrity.overbound import AxisOverbound
from napf_mpc.plot.stanford import StanfordPanel, draw_stanford, stanford_figure
from napf_mpc.plot.style import BLUE, ORANGE, VERMILION, house_style
from napf_mpc.plot.tails import TailPanel, draw_tails, tail_figure


@pytest.fixture(autouse=True)
def in_house_style() -> Iterator[None]:
    with house_style():
        yield


PANEL = StanfordPanel(
    "Vertical",
    error_m=np.array([1.0, 2.0, 6.0, 30.0, 3.0, 40.0, 0.01]),
    level_m=np.array([5.0, 5.0, 5.0, 5.0, 25.0, 25.0, 5.0]),
    alert_limit_m=10.0,
)


def test_every_epoch_stands_in_the_colour_of_its_class() -> None:
    figure = stanford_figure([PANEL])
    (axes,) = figure.axes
    drawn = {
        to_hex(line.get_color()): np.asarray(line.get_xdata()).tolist()
        for line in axes.lines
        if line.get_marker() == "o"
    }
    assert drawn[BLUE.lower()] == [1.0, 2.0, 0.5]  # the smallest at the axis' end
    assert drawn[ORANGE.lower()] == [6.0]
    assert drawn[VERMILION.lower()] == [30.0]
    title = axes.get_title(loc="left")
    assert "N = 7\n3 nominal, 1 misleading, 1 hazardously;\n2 not available, 1 of them misleading" in title
    assert max(axes.get_xlim()) > 40.0


def test_the_tail_is_the_share_beyond_k() -> None:
    z = np.array([-4.0, -1.0, 0.5, 1.5, 2.5])
    bound = AxisOverbound(bias=0.5, sigma=2.0, n=100, effective_n=50.0)
    (axes,) = tail_figure([TailPanel("East", z, bound)]).axes
    measured, normal, told, beyond, _ = axes.lines
    np.testing.assert_allclose(measured.get_xdata(), [0.5, 1.0, 1.5, 2.5, 4.0])
    np.testing.assert_allclose(measured.get_ydata(), [1.0, 0.8, 0.6, 0.4, 0.2])
    k = np.asarray(normal.get_xdata())
    np.testing.assert_allclose(normal.get_ydata(), 2.0 * special.ndtr(-k))
    # Fifty independent errors tell of one in fifty: 2.05 widths beyond the shift.
    assert np.asarray(told.get_xdata()).max() == pytest.approx(0.5 + 2.0 * 2.054, abs=0.03)
    assert np.asarray(beyond.get_xdata()).min() > np.asarray(told.get_xdata()).max()


def test_the_same_figure_is_the_same_file(tmp_path: Path) -> None:
    tail = TailPanel("East", np.linspace(-3.0, 3.0, 50), AxisOverbound(0.1, 1.2, 50, 20.0))
    for out in (tmp_path / "a", tmp_path / "b"):
        draw_stanford([PANEL, PANEL], out, "stanford", "Somebody, CC BY 4.0")
        draw_tails([tail] * 3, out, "tails", "Somebody, CC BY 4.0")
    for file in sorted((tmp_path / "a").iterdir()):
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()
