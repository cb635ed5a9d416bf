"""Planners side by side on the study scenes: risk, formation, path, time and effort, on the same seeds.

Run ``python benchmarks/comparison.py --runs 1000 --out out/comparison``; repeating the command goes on where
it stopped. ``--block development`` flies the seeds on which settings were chosen, ``--block report`` (the
default) those that no choice has seen. ``--cells`` and ``--planners`` pick rows by name.

Below the table stand exact McNemar tests of the planners of a cell that have the same k, on the same runs,
corrected by Holm's method for the number of tests under the whole table.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc import store
from napf_mpc.campaign import run_campaign, versions
from napf_mpc.problem_file import load_problem
from napf_mpc.risk import Paired, holm, paired_tests

BLOCKS = {"development": 101, "report": 2036}
"""Campaign seeds: settings were chosen on the first, tables show the second (see docs/comparison.md)."""

FILTER = 'navigation.filter="kalman"'
CELLS: dict[str, tuple[str, list[str]]] = {
    "8S filter": ("study_8s", [FILTER]),
    "40S filter": ("study_40s", [FILTER]),
    "8C filter": ("study_8c", [FILTER]),
    "40C filter": ("study_40c", [FILTER]),
    "8S raw": ("study_8s", []),
    "40S raw": ("study_40s", []),
    "8C raw": ("study_8c", []),
    "40C raw": ("study_40c", []),
}
"""Scene and navigation: label -> shipped problem and its overrides."""
VARIATIONS = {
    "tau 2 s": ["navigation.correlation_time_s=2"],
    "tau 50 s": ["navigation.correlation_time_s=50"],
    "white": ["navigation.correlation_time_s=0"],
    "common share 0.5": ["navigation.common_mode_share=0.5"],
    "common share 0.9": ["navigation.common_mode_share=0.9"],
}
"""What else varies, in every cell: ``8S filter, tau 2 s``."""
CELLS |= {
    f"{cell}, {name}": (problem, [*settings, *changes])
    for name, changes in VARIATIONS.items()
    for cell, (problem, settings) in list(CELLS.items())[:8]
}

PLANNERS: dict[str, tuple[str, list[str]]] = {
    f"{label}, k = {k}": (name, [f"planner.k={k}"])
    for k in (3, 2, 1.7, 1)
    for label, name in (
        ("NAPF", "napf"),
        ("NAPF guided", "napf_guided"),
        ("QP", "qp"),
        ("QP unguided", "qp_unguided"),
    )
}
"""Label -> planner and its overrides."""
HEADLINE = [label for label in PLANNERS if label.endswith("k = 3")]

COLUMNS = (
    ("path RMS", "path_rms_m", "median"),
    ("shape RMS", "shape_rms_m", "median"),
    ("floor", "shape_floor_m", "median"),
    ("path ratio", "path_length_ratio", "median"),
    ("effort", "control_effort", "median"),
    ("finish s", "finish_time_s", "median"),
    ("re-formed s (95 %)", "reform_time_s", "p95"),
)


@dataclass(frozen=True)
class Flown:
    """What one planner did in one cell."""

    cell: str
    """Label of scene and navigation."""
    planner: str
    """Label of the planner."""
    result: dict[str, Any]
    """Its part of the summary."""
    hits: NDArray[np.bool_]
    """(run,) obstacle contact of each run."""


Fly = Callable[[str, str], Flown]
"""Maps the labels of a cell and a planner to what was flown."""


def fly(
    cell: str, kind: str, settings: Sequence[str], label: str, options: argparse.Namespace, workers: int
) -> Flown:
    """One planner in one cell, from its folder or flown now.

    Parameters
    ----------
    cell : str
        Label of :data:`CELLS`.
    kind : str
        Name of a planner.
    settings : sequence of str
        Its overrides.
    label : str
        What the table calls it.
    options : argparse.Namespace
        Of :func:`options_of`.
    workers : int
        Processes.
    """
    name, own = CELLS[cell]
    problem = load_problem(name, [*own, *settings, *options.set])
    folder = folder_of(options.out, cell, label)
    seed = BLOCKS[options.block]
    summary = run_campaign(problem, [kind], options.runs, seed, folder, name=name, workers=workers)
    rows = store.read_table(folder / "runs.parquet")
    hits = np.asarray(rows["obstacle_contact"], dtype=bool)[np.argsort(rows["run"])]
    return Flown(cell, label, summary["planners"][kind], hits)


def folder_of(out: Path, cell: str, label: str) -> Path:
    """Where what was flown in a cell under a label is kept."""
    return out / "".join(c if c.isalnum() else "_" for c in f"{cell}-{label}")


HEAD = [
    "cell",
    "planner",
    "obstacle contact",
    "UAV-UAV",
    "finished",
    "held / aborted / late / failed",
    *(label for label, _, _ in COLUMNS),
    "fall-back steps",
    "did not finish because",
]


def line(flown: Flown) -> str:
    """Row of the table."""
    result = flown.result
    runs = result["runs"]

    def rate(key: str) -> str:
        low, high = 100 * result[f"{key}_low"], 100 * result[f"{key}_high"]
        return f"{round(result[key] * runs)} = {100 * result[key]:.2f} % [{low:.2f}, {high:.2f}]"

    cells = [
        flown.cell,
        flown.planner,
        rate("collision_risk"),
        rate("uav_contact_risk"),
        f"{100 * result['finished']:.1f} %",
    ]
    cells.append(f"{result['held']} / {result['aborted']} / {result['timeout']} / {result['failed']}")
    for _, key, which in COLUMNS:
        value = result[key][which]
        cells.append("-" if value is None else f"{value:.2f}")
    solver = result["solver"]
    cells.append(f"{solver['fall_backs']}" if solver["status"] else "-")
    cells.append(reasons(result))
    return "| " + " | ".join(cells) + " |"


def reasons(result: dict[str, Any]) -> str:
    """Why runs did not finish, with counts: the planner's own words, or no more than that time was up."""
    words = [f"{count} {word}" for word, count in result["reasons"].items()]
    told = round(result["finished"] * result["runs"]) + sum(result["reasons"].values())
    # A run that failed has no numbers, and may not have a reason either: it is counted in its own column.
    silent = max(0, result["runs"] - told - result["failed"])
    return ", ".join([*words, *([f"{silent} on the way when time was up"] if silent else [])]) or "-"


def paired_table(rows: Sequence[Flown], compared: Callable[[str, str], bool]) -> list[str]:
    """Exact McNemar tests of obstacle contact on the same runs, as a Markdown table.

    Parameters
    ----------
    rows : sequence of Flown
        Rows of the table, in its order.
    compared : callable
        Whether two labels are to be compared.

    Returns
    -------
    list of str
        Lines; none if there is no pair.
    """
    pairs: list[tuple[str, Paired]] = []
    for cell in dict.fromkeys(row.cell for row in rows):
        mine = [row for row in rows if row.cell == cell]
        for a, b in combinations(mine, 2):
            if compared(a.planner, b.planner):
                pairs += [(cell, pair) for pair in paired_tests({a.planner: a.hits, b.planner: b.hits})]
    if not pairs:
        return []
    head = ["cell", "a", "b", "both hit", "only a", "only b", "neither", "p", f"p, Holm, {len(pairs)} tests"]
    lines = ["| " + " | ".join(head) + " |", "|---|---|---|" + "---:|" * 6]
    corrected = holm([pair.p_value for _, pair in pairs])
    for (cell, pair), p in zip(pairs, corrected, strict=True):
        counts = (pair.both, pair.only_a, pair.only_b, pair.neither)
        cells = [cell, pair.a, pair.b, *map(str, counts), _p(pair.p_value), _p(p)]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _p(value: float) -> str:
    # Smaller ones are zero in floating point, which no p-value is.
    return f"{value:.2g}" if value >= 1e-300 else "< 1e-300"


def same_k(a: str, b: str) -> bool:
    """Whether two labels end in the same k."""
    return a.rpartition("k = ")[2] == b.rpartition("k = ")[2]


def print_tables(
    cells: Sequence[str],
    planners: Sequence[str],
    options: argparse.Namespace,
    fly_one: Fly,
    compared: Callable[[str, str], bool] = same_k,
) -> list[Flown]:
    """Fly what is missing, print each row as it is there, then the paired tests and what it all rests on."""
    print("| " + " | ".join(HEAD) + " |\n|---|---|" + "---:|" * (len(HEAD) - 3) + "---|")
    began = time.perf_counter()
    rows = []
    for cell in cells:
        for planner in planners:
            rows.append(fly_one(cell, planner))
            print(line(rows[-1]), flush=True)
    seconds = time.perf_counter() - began
    words = ", ".join(f"{name} {version}" for name, version in versions().items())
    print(
        f"\nN = {options.runs} runs a row, {options.block} seeds ({BLOCKS[options.block]}), 95 % Wilson "
        f"intervals, metrics are medians of the runs, in metres, seconds and N^2 s. {seconds:.0f} s with "
        f"{options.workers} workers on {platform.machine()}; {words}."
    )
    tests = paired_table(rows, compared)
    if tests:
        print("\nObstacle contact on the same runs, exact McNemar tests:\n")
        print("\n".join(tests), flush=True)
    return rows


def options_of(parser: argparse.ArgumentParser, cells: Sequence[str], runs: int) -> argparse.Namespace:
    """Read the options that every table has; ``cells`` comes back as a list of labels.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        With a script's own options.
    cells : sequence of str
        Labels flown if none are named.
    runs : int
        Runs a row if no number is given.
    """
    parser.add_argument("--runs", type=int, default=runs)
    parser.add_argument("--block", choices=BLOCKS, default="report")
    parser.add_argument("--cells", default=";".join(cells), help="labels, separated by semicolons or commas")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override for all cells"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.cells = chosen(parser, "cells", options.cells, CELLS)
    return options


def chosen(parser: argparse.ArgumentParser, what: str, given: str, known: dict[str, Any]) -> list[str]:
    """Labels that a user gave, as they are known; ends with a message that names the others if one is not.

    Labels of variations and planners have commas of their own, so semicolons separate where there are any,
    and a single label is one whatever is in it.
    """
    separator = ";" if ";" in given or given.strip() in known else ","
    labels = [label.strip() for label in given.split(separator) if label.strip()]
    strange = [label for label in labels if label not in known]
    if strange or not labels:
        parser.error(f'--{what} {given}: "{"; ".join(strange)}" is not one of: {"; ".join(known)}')
    return labels


def main() -> None:
    """Fly what is missing and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planners", default=";".join(HEADLINE), help="labels, separated by semicolons")
    options = options_of(parser, list(CELLS)[:8], 1000)
    planners = chosen(parser, "planners", options.planners, PLANNERS)

    def fly_one(cell: str, planner: str) -> Flown:
        kind, settings = PLANNERS[planner]
        return fly(cell, kind, settings, planner, options, options.workers)

    print_tables(options.cells, planners, options, fly_one)


if __name__ == "__main__":
    main()
