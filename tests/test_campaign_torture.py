"""Disturbed campaigns are the undisturbed one in the end; ``benchmarks/campaign_torture.py`` in short."""

import io
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="signals, process groups and limits are POSIX")

from campaign_torture import KINDS, full_disk, good, torture_all

COUNTS = {
    "kill -9 of the group": 5,
    "kill -9 of the parent": 1,
    "Ctrl-C": 5,
    "SIGTERM": 1,
    "kill -9 of a worker": 5,
}


@pytest.mark.slow
def test_disturbed_campaigns_are_the_undisturbed_one_in_the_end(tmp_path: Path) -> None:
    counts = {**COUNTS, full_disk(tmp_path): 5}
    table = io.StringIO()
    tallies = torture_all(counts, tmp_path, 48, 2, 4, table)
    for kind, count in counts.items():
        assert tallies[kind].disturbed == count, kind
        assert tallies[kind].through >= 1, kind
        assert good(tallies[kind]), table.getvalue()


def test_every_kind_is_tried() -> None:
    assert {*COUNTS, "disk full", "file too large"} == set(KINDS)
