"""Whether a long campaign keeps its memory and its files: 20,000 short runs, looked at after every block.

Run ``python benchmarks/campaign_soak.py``; it prints resident memory of this process and of its workers and
the number of open files, then the slope of the memory per 1,000 runs: by least squares over what follows the
first quarter, in which compiled code is loaded and caches fill. Linux only.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napf_mpc.campaign import run_campaign, versions
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import processor

SHORT: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 2.0,
    "simulation.controller_rate_hz": 25.0,
    "planner.rate_hz": 5.0,
    "navigation.rate_hz": 5.0,
}
"""Settings that make table1_8 a flight of two seconds."""
MEGABYTE = 1e6


@dataclass(frozen=True)
class Sample:
    """What a campaign holds after some runs."""

    runs: int
    parent_mb: float
    workers_mb: float
    """Of all workers together."""
    files: int
    """Open in the parent."""


def short_problem() -> Problem:
    """Give table1_8 as a flight of two seconds."""
    return load_problem("table1_8", SHORT)


def soak(out: Path, runs: int, block: int, workers: int, planner: str = "apf") -> list[Sample]:
    """Fly a campaign and look after every block."""
    samples: list[Sample] = []

    def look(done: int) -> None:
        workers_mb = sum(resident_mb(pid) for pid in children(os.getpid()))
        samples.append(Sample(done, resident_mb(os.getpid()), workers_mb, len(os.listdir("/proc/self/fd"))))

    run_campaign(short_problem(), [planner], runs, 1, out, workers=workers, block_runs=block, progress=look)
    return samples


def resident_mb(pid: int) -> float:
    """Resident memory [MB]; 0 if the process is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / MEGABYTE


def children(parent: int) -> list[int]:
    """Processes that a process has started."""
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = place.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(words[1]) == parent:
            found.append(int(place.parent.name))
    return found


def slopes(samples: Sequence[Sample]) -> tuple[float, float]:
    """Memory [MB] of parent and of workers per 1,000 runs, after the first quarter of the runs."""
    late = [sample for sample in samples if sample.runs >= samples[-1].runs / 4]
    runs = [sample.runs / 1000.0 for sample in late]
    parent, workers = (
        float(np.polyfit(runs, [getattr(sample, name) for sample in late], 1)[0])
        for name in ("parent_mb", "workers_mb")
    )
    return parent, workers


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=20_000)
    parser.add_argument("--block", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--planner", default="apf")
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        samples = soak(Path(name), asked.runs, asked.block, asked.workers, asked.planner)
    print(f"{processor()}, {', '.join(f'{k} {v}' for k, v in versions().items())}")
    print(f"{asked.runs} runs of {asked.planner}, {asked.block} a block, {asked.workers} workers")
    print(f"{'runs':>8}{'parent [MB]':>14}{'workers [MB]':>14}{'files':>8}")
    for sample in [*samples[:: max(1, len(samples) // 12)], samples[-1]]:
        print(f"{sample.runs:>8}{sample.parent_mb:>14.1f}{sample.workers_mb:>14.1f}{sample.files:>8}")
    parent, workers = slopes(samples)
    print(f"slope per 1,000 runs: parent {parent:+.3f} MB, workers together {workers:+.3f} MB")
    half = samples[len(samples) // 4 :]
    print(f"open files after the first quarter: {min(s.files for s in half)} to {max(s.files for s in half)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
