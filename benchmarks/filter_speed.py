"""What the navigation filter costs per UAV and tick of the inner loop, part by part and as flown.

Run ``python benchmarks/filter_speed.py``; it prints the machine, the versions and one table per batch size.
Times are of this thread's processor, so that other programs on the machine do not count. Fixes come at 10 Hz
and ticks at 50 Hz, as by default; "as flown" is the mean over ticks with and without a fix, sensors included.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

from napf_mpc.navigation.error_models import position_errors
from napf_mpc.navigation.filter import KalmanFilter
from napf_mpc.navigation.filter_model import FilterModel
from napf_mpc.navigation.filtered import FilteredNavigation
from napf_mpc.navigation.point_mass_filter import PointMassFilter
from napf_mpc.navigation.sensors import Sensors
from napf_mpc.problem import GaussMarkov

UAVS, TICK_S, TICKS_PER_FIX = 4, 0.02, 5


def machine() -> str:
    """One line about where this runs."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
        cpu = names[0] if names else cpu
    return f"{cpu}, {os.cpu_count()} CPUs, {platform.system()} {platform.release()}"


def microseconds(step: Callable[[int], object], ticks: int, uavs: int) -> float:
    """Mean time of a call per UAV [us], over calls with the numbers 0, 1, 2, ... after 20 to warm up."""
    for tick in range(20):
        step(tick)
    start = time.thread_time()
    for tick in range(20, 20 + ticks):
        step(tick)
    return (time.thread_time() - start) / ticks / uavs * 1e6


def table(navigation: GaussMarkov, runs: int, ticks: int) -> list[tuple[str, float]]:
    """Rows of name and microseconds."""
    rng = np.random.default_rng(0)
    shape, uavs = (runs, UAVS, 3), runs * UAVS
    block, active = range(runs), np.ones(runs, dtype=bool)
    position, velocity, still = rng.normal(size=shape), rng.normal(size=shape), np.zeros(shape)
    errors = position_errors(navigation, 0, block, UAVS, (ticks + 20) * TICK_S, None)
    model = FilterModel.of_navigation(navigation, TICK_S, TICKS_PER_FIX)
    kalman, point_mass = KalmanFilter(model, runs, UAVS), PointMassFilter(model, 3.0, runs, UAVS)
    fix = errors.fix(0)
    sensors = Sensors(navigation, 0, block, UAVS, TICK_S, velocity)
    flown = FilteredNavigation(navigation, errors, 0, block, TICK_S, TICKS_PER_FIX, velocity)

    def correct(_: int) -> None:
        kalman.correct(position, velocity, fix.covariance, fix.available, True, active)

    def correct_density(_: int) -> None:
        point_mass.correct(position, velocity, fix.covariance, fix.available, True, active)

    def solve(tick: int) -> None:
        flown.solution(tick, tick * TICK_S, position, velocity, still, still, active)

    return [
        ("take in a fix (a fifth of it per tick)", microseconds(correct, ticks // 5, uavs) / TICKS_PER_FIX),
        (
            "the same, point-mass filter",
            microseconds(correct_density, ticks // 5, uavs) / TICKS_PER_FIX,
        ),
        ("carry over a tick", microseconds(lambda _: kalman.predict(still, active), ticks, uavs)),
        ("issue the solution", microseconds(lambda _: kalman.solution(0.0, still, still), ticks, uavs)),
        ("draw accelerometers", microseconds(lambda _: sensors.velocity_change(velocity), ticks, uavs)),
        ("as flown", microseconds(solve, ticks, uavs)),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--runs", type=int, nargs="+", default=[1, 32, 256, 1000], help="runs of four UAVs in a batch"
    )
    parser.add_argument("--ticks", type=int, default=1500, help="timed ticks")
    arguments = parser.parse_args()
    if min(arguments.runs) < 1 or arguments.ticks < 5:
        parser.error("runs must be 1 or more, ticks 5 or more")
    print(machine())
    print(f"python {platform.python_version()}, numpy {version('numpy')}, numba {version('numba')}")
    print(f"one thread; microseconds per UAV and tick of {TICK_S:g} s, mean of {arguments.ticks} ticks")
    for share in (0.0, 0.5):
        navigation = GaussMarkov(filter="kalman", common_mode_share=share)
        columns = [table(navigation, runs, arguments.ticks) for runs in arguments.runs]
        print(f"\ncommon-mode share {share:g}; runs x UAVs")
        print(f"{'':<40}" + "".join(f"{f'{runs} x {UAVS}':>11}" for runs in arguments.runs))
        for rows in zip(*columns, strict=True):
            print(f"{rows[0][0]:<40}" + "".join(f"{value:>11.3f}" for _, value in rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
