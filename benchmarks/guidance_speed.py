"""What guidance costs per plan of one formation, in the closed loop of the study scenes.

Run ``python benchmarks/guidance_speed.py``; it prints the machine, the versions and a row per scene. Missions
are flown one at a time with navigation filtered, so a call plans one formation; times are of this thread's
processor, so that other programs on the machine do not count. A formation of four UAVs plans every 0.4 s.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

import numpy as np

from napf_mpc import load_problem, simulate
from napf_mpc.planners import guidance
from napf_mpc.planners.guide_search import plan_all

SCENES = ("study_8s", "study_8c", "study_40s", "study_40c")


def machine() -> str:
    """One line about where this runs."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
        cpu = names[0] if names else cpu
    return f"{cpu}, {os.cpu_count()} CPUs, {platform.system()} {platform.release()}"


def plan_times(scene: str, planner: str, seed: int, missions: int) -> list[float]:
    """Times [ms] of all plans of some missions."""
    times: list[float] = []

    def timed(*arguments: object) -> None:
        start = time.thread_time_ns()
        plan_all(*arguments)  # type: ignore[arg-type]
        times.append((time.thread_time_ns() - start) * 1e-6)

    problem = load_problem(scene, ['navigation.filter="kalman"'])
    with patch.object(guidance, "plan_all", timed):
        for run in range(missions):
            simulate(problem, planner, seed=seed, runs=range(run, run + 1))
    return times


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", type=int, default=4, help="missions per scene")
    parser.add_argument("--planner", default="napf_guided", help="napf_guided or qp")
    parser.add_argument("--seed", type=int, default=101, help="campaign seed")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="problems")
    arguments = parser.parse_args()
    if arguments.missions < 1:
        parser.error("missions must be 1 or more")
    print(machine())
    print(f"python {platform.python_version()}, numpy {version('numpy')}, numba {version('numba')}")
    start = time.thread_time()
    plan_times(arguments.scenes[0], arguments.planner, arguments.seed, 1)
    print(f"first mission, compilation included unless cached: {time.thread_time() - start:.1f} s")
    print(f"{arguments.planner}, seed {arguments.seed}, {arguments.missions} missions a scene; ms per plan\n")
    print(f"{'scene':<12}{'N':>7}{'median':>9}{'mean':>9}{'p99':>9}{'largest':>9}")
    for scene in arguments.scenes:
        times = plan_times(scene, arguments.planner, arguments.seed, arguments.missions)
        median, p99 = np.quantile(times, (0.5, 0.99))
        print(
            f"{scene:<12}{len(times):>7}{median:>9.3f}{np.mean(times):>9.3f}{p99:>9.3f}{max(times):>9.3f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
