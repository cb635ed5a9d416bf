"""Two checkouts of the library beside each other: control steps, missions, and whether bits are the same.

Run ``python benchmarks/two_trees.py BEFORE AFTER``, both folders that hold ``napf_mpc``. Each round flies one
after the other, in a process of its own, in an order that turns round from round to round, so that whatever
else the machine does falls on both alike; ratios are taken round by round. Times are thread-CPU times. A
*step* plans for the UAVs of one mission; a *mission* is the share of one in a block flown in lock-step, with
its verdict. The digest is that of every outcome, metric and sample of the trajectories.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from plant_speed import machine


def fly(arguments: argparse.Namespace) -> dict[str, Any]:
    """Fly both workloads with the library that is on the path."""
    from napf_mpc.benchmark.steps import step_times
    from napf_mpc.block import fly_block
    from napf_mpc.closed_loop import build_scenario
    from napf_mpc.planners.registry import make_planner
    from napf_mpc.problem_file import load_problem

    problem = load_problem(arguments.problem, arguments.set)
    seed, name = arguments.seed, arguments.planner
    fly_block(problem, [name], seed, range(1))  # compile, or load what is compiled
    scenario = build_scenario(problem, seed, range(1))
    steps = [time.cpu_us for time in step_times(problem, make_planner(name, problem), scenario, 3)]
    began = time.thread_time()
    block = fly_block(problem, [name], seed, range(arguments.missions), record_every=50)
    seconds = time.thread_time() - began
    digest = hashlib.sha256()
    for columns in (block.rows, block.trajectories, block.events):
        for key in sorted(columns):
            values = columns[key].astype(str) if columns[key].dtype == object else columns[key]
            digest.update(key.encode() + np.ascontiguousarray(values).tobytes())
    median, p99 = np.quantile(steps, (0.5, 0.99))
    return {
        "step median [us]": median,
        "step mean [us]": float(np.mean(steps)),
        "step p99 [us]": p99,
        "mission [ms]": 1e3 * seconds / arguments.missions,
        "digest": digest.hexdigest()[:16],
    }


def asked(tree: Path) -> dict[str, Any]:
    """Let a process fly with the library of a tree."""
    threads = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = os.environ | threads | {"PYTHONPATH": str(tree)}
    told = subprocess.run(
        [sys.executable, __file__, "--alone", *sys.argv[1:]],
        env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    answer: dict[str, Any] = json.loads(told.stdout.splitlines()[-1])
    return answer


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--problem", default="study_40s")
    parser.add_argument("--planner", default="qp")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of napf-mpc run")
    parser.add_argument("--missions", type=int, default=16, help="missions in lock-step")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=7501)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.missions < 1 or arguments.rounds < 1:
        parser.error("missions and rounds must be 1 or more")
    if arguments.alone:
        print(json.dumps(fly(arguments)))
        return 0
    trees = (arguments.before.resolve(), arguments.after.resolve())
    for tree in trees:
        if not (tree / "napf_mpc").is_dir():
            parser.error(f"{tree}: holds no napf_mpc")
        asked(tree)  # compile
    told: tuple[list[dict[str, Any]], list[dict[str, Any]]] = ([], [])
    for turn in range(arguments.rounds):
        for which in ((0, 1), (1, 0))[turn % 2]:
            told[which].append(asked(trees[which]))
    print(
        f"{machine()}, python {platform.python_version()}, numpy {version('numpy')}, numba {version('numba')}"
    )
    print(
        f"{arguments.problem}, {arguments.planner}, {' '.join(arguments.set)}, seed {arguments.seed}, "
        f"{arguments.missions} missions in lock-step, {arguments.rounds} rounds; medians over the rounds\n"
    )
    print("| | before | after | after / before | smallest | largest |\n|---|" + "---:|" * 5)
    for key in told[0][0]:
        if key == "digest":
            continue
        before, after = (np.array([row[key] for row in rows]) for rows in told)
        ratio = after / before
        cells = [f"{np.median(before):.0f}", f"{np.median(after):.0f}"]
        cells += [f"{value:.2f}" for value in (np.median(ratio), ratio.min(), ratio.max())]
        print(f"| {key} | {' | '.join(cells)} |")
    digests = {row["digest"] for rows in told for row in rows}
    print(f"\nthe same bits: {'yes' if len(digests) == 1 else 'NO'} ({', '.join(sorted(digests))})")
    return 0 if len(digests) == 1 else 1


if __name__ == "__main__":
    raise SystemExit(main())
