"""What dearer plans of the QP buy: a second pass, more stages, a longer look-ahead.

Run ``python benchmarks/planner_settings.py --block development --out DIR``: 15 rows of 500 missions, half an
hour on two cores. The same command with more runs goes on where it stopped. Printed are the tables of
``comparison.py`` and how far path and shape of each run differ from those of the shipped settings.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from comparison import Flown, fly, folder_of, options_of, print_tables
from numpy.typing import NDArray

from napf_mpc import store

Array = NDArray[np.float64]

SHIPPED = "as shipped"
SETTINGS = {
    SHIPPED: [],
    "two passes": ["planner.passes=2"],
    "30 stages": ["planner.horizon=30"],
    "9 s ahead": ["planner.look_ahead_s=9"],
    "30 stages, 9 s ahead": ["planner.horizon=30", "planner.look_ahead_s=9"],
}
"""Label -> overrides."""
METRICS = {"path RMS (m)": "path_rms_m", "shape RMS (m)": "shape_rms_m", "effort (N^2 s)": "control_effort"}
"""Column -> metric of a run."""


def mean_difference(ours: Array, theirs: Array) -> tuple[float, float]:
    """Mean of the differences (run,) of pairs and half its 95 % interval, of runs that have both numbers."""
    difference = ours - theirs
    difference = difference[np.isfinite(difference)]
    spread = float(difference.std(ddof=1)) / len(difference) ** 0.5
    return float(difference.mean()), 1.96 * spread


def metrics_of(out: Path, cell: str, label: str) -> dict[str, Array]:
    """Metrics (run,) of a row, by run."""
    rows = store.read_table(folder_of(out, cell, label) / "runs.parquet")
    order = np.argsort(rows["run"])
    return {column: np.asarray(rows[metric], dtype=float)[order] for column, metric in METRICS.items()}


def difference_table(out: Path, cells: Sequence[str]) -> list[str]:
    """Markdown: each setting less the shipped one on the same runs, with 95 % intervals of the mean."""
    lines = ["| " + " | ".join(["cell", "setting", *METRICS]) + " |", "|---|---|" + "---:|" * len(METRICS)]
    for cell in cells:
        shipped = metrics_of(out, cell, SHIPPED)
        for label in list(SETTINGS)[1:]:
            words = []
            for column, values in metrics_of(out, cell, label).items():
                mean, half = mean_difference(values, shipped[column])
                words.append(f"{mean:+.3f} [{mean - half:+.3f}, {mean + half:+.3f}]")
            lines.append("| " + " | ".join([cell, label, *words]) + " |")
    return lines


def main() -> None:
    """Fly what is missing and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options = options_of(parser, ["8S filter", "40S filter", "40C filter"], 500)

    def fly_one(cell: str, label: str) -> Flown:
        return fly(cell, "qp", SETTINGS[label], label, options, options.workers)

    def with_shipped(a: str, b: str) -> bool:
        return SHIPPED in (a, b)

    print_tables(options.cells, list(SETTINGS), options, fly_one, with_shipped)
    print("\nDifference to the shipped settings, mean of the pairs:\n")
    print("\n".join(difference_table(options.out, options.cells)))


if __name__ == "__main__":
    main()
