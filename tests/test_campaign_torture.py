"""Disturbed campaigns are the undisturbed one in the end; ``benchmarks/campaign_torture.py`` in short."""

import io
import os
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="signals, process groups and limits are POSIX")

if not os.environ.get("NAPF_MPC_TORTURE"):
    pytest.skip("takes many minutes: set NAPF_MPC_TORTURE=1", allow_module_level=True)

from campaign_torture import KINDS, good, may_mount, torture_all

COUNTS = {"kill -9 of the group": 1, "Ctrl-C": 1, "kill -9 of a worker": 1}


def tormented(counts: dict[str, int], folder: Path) -> None:
    table = io.StringIO()
    tallies = torture_all(counts, folder, 64, 2, 4, table)
    print(table.getvalue(), file=sys.stderr)
    for kind, count in counts.items():
        assert tallies[kind].disturbed == count, kind
        assert tallies[kind].through >= 1, kind
        assert good(tallies[kind]), table.getvalue()


@pytest.mark.slow
def test_disturbed_campaigns_are_the_undisturbed_one_in_the_end(tmp_path: Path) -> None:
    tormented(COUNTS, tmp_path)


@pytest.mark.slow
def test_disks_that_were_full_lose_nothing(tmp_path: Path) -> None:
    if not may_mount(tmp_path):
        pytest.skip("this process may not mount a small disk")
    tormented({"disk full": 2}, tmp_path)


def test_every_kind_is_tried() -> None:
    assert set(COUNTS) | {"disk full"} == set(KINDS)
