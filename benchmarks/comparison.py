"""Planners side by side on the study scenes: risk, formation, path, time and effort, on the same seeds.

Run ``python benchmarks/comparison.py --runs 1000 --out out/comparison``; repeating the command goes on where
it stopped. ``--block development`` flies the seeds on which settings were chosen, ``--block report`` (the
default) those that no choice has seen. ``--cells`` and ``--planners`` pick rows by name.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from pathlib import Path
from typing import Any

from napf_mpc.campaign import run_campaign, versions
from napf_mpc.problem_file import load_problem

BLOCKS = {"development": 101, "report": 2026}
"""Campaign seeds: settings were chosen on the first, and on no other; tables show the second."""

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


def flown(
    cell: str, planner: str, runs: int, seed: int, out: Path, workers: int, extra: list[str]
) -> dict[str, Any]:
    """Summary of one cell and planner, from its folder or flown now."""
    name, settings = CELLS[cell]
    kind, own = PLANNERS[planner]
    folder = out / "".join(c if c.isalnum() else "_" for c in f"{cell}-{planner}")
    problem = load_problem(name, [*settings, *own, *extra])
    summary = run_campaign(problem, [kind], runs, seed, folder, name=name, workers=workers)
    result: dict[str, Any] = summary["planners"][kind]
    return result


def line(cell: str, planner: str, result: dict[str, Any]) -> str:
    """Row of the table."""
    runs = result["runs"]

    def rate(key: str) -> str:
        low, high = 100 * result[f"{key}_low"], 100 * result[f"{key}_high"]
        return f"{round(result[key] * runs)} = {100 * result[key]:.2f} % [{low:.2f}, {high:.2f}]"

    cells = [
        cell,
        planner,
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
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Fly what is missing and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--block", choices=BLOCKS, default="report")
    parser.add_argument(
        "--cells", default=",".join(list(CELLS)[:8]), help="names, separated by semicolons or commas"
    )
    parser.add_argument("--planners", default=";".join(HEADLINE), help="labels, separated by semicolons")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override for all cells"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    separator = ";" if ";" in arguments.cells else ","
    cells = [name.strip() for name in arguments.cells.split(separator)]
    planners = [name.strip() for name in arguments.planners.split(";")]
    seed = BLOCKS[arguments.block]
    head = ["cell", "planner", "obstacle contact", "UAV-UAV", "finished", "held / aborted / late / failed"]
    head += [label for label, _, _ in COLUMNS] + ["fall-back steps"]
    print("| " + " | ".join(head) + " |\n|---|---|" + "---:|" * (len(head) - 2))
    began = time.perf_counter()
    for cell in cells:
        for planner in planners:
            result = flown(
                cell, planner, arguments.runs, seed, arguments.out, arguments.workers, arguments.set
            )
            print(line(cell, planner, result), flush=True)
    seconds = time.perf_counter() - began
    words = ", ".join(f"{name} {version}" for name, version in versions().items())
    print(
        f"\nN = {arguments.runs} runs a row, {arguments.block} seeds ({seed}), 95 % Wilson intervals, "
        f"metrics are medians of the runs, in metres, seconds and N^2 s. {seconds:.0f} s with "
        f"{arguments.workers} workers on {platform.machine()}; {words}."
    )


if __name__ == "__main__":
    main()
