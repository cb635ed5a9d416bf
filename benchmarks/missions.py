"""How many missions a core flies: in lock-step against one at a time, and where the time goes.

Run ``python benchmarks/missions.py --missions 10000`` (about two minutes on one core).
"""

from __future__ import annotations

import argparse
import cProfile
import io
import pstats
import statistics
import time

from napf_mpc.campaign import fly_block, versions
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import processor


def seconds(problem: Problem, planner: str, runs: range) -> float:
    began = time.process_time()
    fly_block(problem, [planner], 1, runs)
    return time.process_time() - began


def profile(problem: Problem, planner: str, runs: int) -> str:
    profiler = cProfile.Profile()
    profiler.enable()
    fly_block(problem, [planner], 1, range(runs))
    profiler.disable()
    text = io.StringIO()
    pstats.Stats(profiler, stream=text).strip_dirs().sort_stats("tottime").print_stats(14)
    return "\n".join(line for line in text.getvalue().splitlines() if line.strip())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", default="table1_8")
    parser.add_argument("--planner", default="apf")
    parser.add_argument("--missions", type=int, default=10_000)
    parser.add_argument("--block", type=int, default=256)
    parser.add_argument("--alone", type=int, default=10, help="missions flown one at a time")
    arguments = parser.parse_args()
    problem = load_problem(arguments.problem)
    seconds(problem, arguments.planner, range(2))  # compile or load the compiled code

    alone = [seconds(problem, arguments.planner, range(i, i + 1)) for i in range(arguments.alone)]
    starts = range(0, arguments.missions, arguments.block)
    blocks = [
        seconds(problem, arguments.planner, range(i, min(i + arguments.block, arguments.missions)))
        for i in starts
    ]
    one, total = statistics.median(alone), sum(blocks)
    print(f"{processor()}, {', '.join(f'{k} {v}' for k, v in versions().items())}")
    print(f"{arguments.problem}, planner {arguments.planner}, one core, processor time")
    print(f"{arguments.missions} missions in blocks of {arguments.block}: {total:.1f} s")
    print(f"in lock-step: {arguments.missions / total:.1f} missions/s")
    print(f"one at a time: {1 / one:.2f} missions/s (median of {arguments.alone})")
    print(f"ratio: {arguments.missions / total * one:.0f}")
    print(profile(problem, arguments.planner, arguments.block))


if __name__ == "__main__":
    main()
