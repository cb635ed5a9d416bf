"""Sensitivity of the collision risk to what the paper does not print: the table in ``docs/sensitivity.md``.

A sweep over scenes and planners; every cell flies the same seeds. Run
``python benchmarks/sensitivity.py --runs 1000 --out out/sensitivity``; repeating the command goes on where it
stopped.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from pathlib import Path

from napf_mpc.campaign import versions
from napf_mpc.problem_file import load_problem
from napf_mpc.sweep import Point, run_sweep

SCENES: dict[str, tuple[str, list[str]]] = {
    "8 spheres (`table1_8`)": ("table1_8", []),
    "40 spheres (`table1_40`)": ("table1_40", []),
    "8 cylinders (`table1_8c`)": ("table1_8c", []),
    "40 cylinders (`table1_40c`)": ("table1_40c", []),
    "8 spheres, white errors": ("table1_8", ["navigation.correlation_time_s=0"]),
    "8 spheres, correlation time 2 s": ("table1_8", ["navigation.correlation_time_s=2"]),
    "8 spheres, correlation time 50 s": ("table1_8", ["navigation.correlation_time_s=50"]),
    "8 spheres, correlation time 1e6 s": ("table1_8", ["navigation.correlation_time_s=1e6"]),
    "8 spheres, directional sigma": ("table1_8", ["planner.sigma=directional"]),
    "8 spheres, largest sigma": ("table1_8", ["planner.sigma=largest"]),
    "8 spheres, half the sigma reported": ("table1_8", ["navigation.reported_sigma_scale=0.5"]),
    "8 spheres, no errors": ("table1_8", ["navigation.error_scale=0"]),
}
"""What varies in the world: label -> shipped problem and its overrides."""

PLANNERS: dict[str, tuple[str, list[str]]] = {
    "APF": ("apf", []),
    "NAPF, range, k = 3": ("napf", ["planner.k=3", "planner.inflation=range"]),
    "NAPF, k = 1.5": ("napf", ["planner.k=1.5"]),
    "NAPF, k = 1.7": ("napf", ["planner.k=1.7"]),
    "NAPF, k = 2": ("napf", ["planner.k=2"]),
    "NAPF, k = 3": ("napf", ["planner.k=3"]),
}
"""What varies in the planner: label -> planner and its overrides."""


def rates(kind: str, runs: int, seed: int, out: Path, workers: int) -> dict[tuple[str, str], str]:
    """Cells of the columns of one kind of planner, by scene and column."""
    points = [
        Point({"scene": scene, "column": column}, load_problem(name, [*settings, *own]))
        for scene, (name, settings) in SCENES.items()
        for column, (of_kind, own) in PLANNERS.items()
        if of_kind == kind
    ]
    found = run_sweep(points, [kind], runs, seed, out / kind, name="sensitivity", workers=workers)
    cells = {}
    for i, point in enumerate(points):
        rate, low, high = (100 * float(found[f"collision_risk{end}"][i]) for end in ("", "_low", "_high"))
        unfinished = runs - round(float(found["finished"][i]) * runs)
        note = f", {unfinished} not finished" if unfinished else ""
        cells[point.settings["scene"], point.settings["column"]] = f"{rate:.1f} [{low:.1f}-{high:.1f}]{note}"
    return cells


def table(runs: int, seed: int, out: Path, workers: int) -> str:
    cells: dict[tuple[str, str], str] = {}
    for kind in dict.fromkeys(kind for kind, _ in PLANNERS.values()):
        cells |= rates(kind, runs, seed, out, workers)
    lines = ["| scene and errors | " + " | ".join(PLANNERS) + " |", "|---|" + "---:|" * len(PLANNERS)]
    for scene in SCENES:
        lines.append(f"| {scene} | " + " | ".join(cells[scene, column] for column in PLANNERS) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    began = time.perf_counter()
    rows = table(arguments.runs, arguments.seed, arguments.out, arguments.workers)
    print(rows)
    seconds = time.perf_counter() - began
    words = ", ".join(f"{name} {version}" for name, version in versions().items())
    text = (
        f"{rows}\n\nCollision risk in per cent of runs, [95 % Wilson interval]; N = {arguments.runs} runs "
        f"a cell, seed {arguments.seed}, the same scenes and errors in a row. {platform.machine()}, {words}. "
        f"Made by `python benchmarks/sensitivity.py --runs {arguments.runs} --seed {arguments.seed} "
        "--out DIR`.\n"
    )
    (arguments.out / "table.md").write_text(text, encoding="utf-8")
    print(f"\n{seconds:.0f} s with {arguments.workers} workers; table in {arguments.out / 'table.md'}")


if __name__ == "__main__":
    main()
