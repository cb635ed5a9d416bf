"""The numbers of docs/integrity.md about the Nagoya log are what its benchmark prints."""

from pathlib import Path

import numpy as np
import pytest
from integrity_nagoya import coverage_table, levels, read, stanford_panels, stanford_table

PAGE = Path(__file__).parents[1] / "docs" / "integrity.md"


def test_levels_of_a_known_covariance() -> None:
    covariance = np.diag([4.0, 9.0, 1.0])[None]
    found = levels(covariance, np.array([1.0, 2.0, 3.0]))
    assert found["horizontal"][0] == pytest.approx(3.4394 * 6.0, abs=1e-3)  # chi-square of two, 99.73 %
    assert found["vertical"][0] == pytest.approx(9.0)


def test_the_page_has_the_benchmarks_tables(data_folder: Path) -> None:
    text = PAGE.read_text(encoding="utf-8")
    parts = read(data_folder)
    for line in (*coverage_table(parts), *stanford_table(stanford_panels(parts))):
        assert line.replace(" | ", "|") in text.replace(" | ", "|"), line


def test_halves_are_bounded_by_each_other(data_folder: Path) -> None:
    first, second = read(data_folder)
    assert first.bound.source.startswith("second half of")
    assert second.bound.source.startswith("first half of")
    assert (len(first.error), len(second.error)) == (317, 233)
