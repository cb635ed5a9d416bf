"""A long campaign keeps its files; ``benchmarks/campaign_soak.py`` in short."""

import sys
from pathlib import Path

import numpy as np
import pytest
from campaign_soak import Sample, slopes, soak

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="open files are counted in /proc")


def test_open_files_are_constant_from_block_to_block(tmp_path: Path) -> None:
    samples = soak(tmp_path, 120, 10, 1)
    assert [sample.runs for sample in samples] == list(range(0, 121, 10))
    assert len({sample.files for sample in samples[1:]}) == 1
    assert all(sample.parent_mb > 10.0 for sample in samples)
    assert np.isfinite(slopes(samples)).all()


def test_slopes_are_per_thousand_runs_and_leave_out_the_first_quarter() -> None:
    samples = [
        Sample(runs, 500.0 if runs < 1000 else 100.0 + runs / 500.0, 7.0, 9) for runs in range(0, 4001, 200)
    ]
    assert slopes(samples) == pytest.approx((2.0, 0.0))
