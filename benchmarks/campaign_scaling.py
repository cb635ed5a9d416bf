"""What the campaign engine costs over the bare loop, and what more workers bring.

Run ``python benchmarks/campaign_scaling.py``. The same blocks are flown by the bare loop (``fly_block`` after
``fly_block``, nothing kept), by a campaign in this process, by one over two processes and, where distributed
is installed, by two dask workers of this machine; round after round, so that whatever else the machine does
meets all of them. Rates are missions per second of wall time, medians of the rounds; the overhead of the
first campaign over the bare loop is of processor time, which other programs hardly change.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from napf_mpc.block import fly_block
from napf_mpc.campaign import chunks, run_campaign, versions
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import processor

BARE, ONE, TWO, DASK = "bare loop", "campaign, 1 worker", "campaign, 2 workers", "campaign, 2 dask workers"


def ways(
    problem: Problem, planner: str, runs: int, block: int, folder: Path, address: str | None
) -> dict[str, Callable[[], object]]:
    """Name -> a call that flies all runs."""
    count = iter(range(1_000_000))

    def campaign(workers: int, cluster: str | None = None) -> None:
        out = folder / f"out{next(count)}"
        run_campaign(problem, [planner], runs, 1, out, workers=workers, block_runs=block, cluster=cluster)

    def bare() -> None:
        for chunk in chunks(range(runs), block):
            fly_block(problem, [planner], 1, chunk)

    table: dict[str, Callable[[], object]] = {BARE: bare, ONE: lambda: campaign(1), TWO: lambda: campaign(2)}
    if address is not None:
        table[DASK] = lambda: campaign(1, address)
    return table


def measure(table: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Wall time and processor time [s] of this process, for each way and round."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in table}
    for _ in range(rounds):
        for name, fly in table.items():
            wall, own = time.perf_counter(), time.process_time()
            fly()
            times[name].append((time.perf_counter() - wall, time.process_time() - own))
    return times


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--problem", default="table1_8")
    parser.add_argument("--planner", default="apf")
    parser.add_argument("--runs", type=int, default=1024)
    parser.add_argument("--block", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args(arguments)
    problem = load_problem(asked.problem)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="scaling-")))
        address = None
        if importlib.util.find_spec("distributed"):
            import distributed

            cluster = stack.enter_context(
                distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
            )
            address = cluster.scheduler_address
        table = ways(problem, asked.planner, asked.runs, asked.block, folder, address)
        for warm_up in ways(problem, asked.planner, 4, 1, folder / "warm", address).values():
            warm_up()
        times = measure(table, asked.rounds)
    print(f"{processor()}, {', '.join(f'{k} {v}' for k, v in versions().items())}")
    print(f"{asked.problem}, {asked.planner}, {asked.runs} missions, {asked.block} a block")
    print(f"{asked.rounds} rounds")
    bare = statistics.median(wall for wall, _ in times[BARE])
    print(f"{'':<28}{'missions/s':>12}{'of the bare loop':>18}")
    for name, rounds in times.items():
        wall = statistics.median(wall for wall, _ in rounds)
        print(f"{name:<28}{asked.runs / wall:>12.1f}{bare / wall:>18.3f}")
    shares = sorted(one / loop - 1.0 for (_, one), (_, loop) in zip(times[ONE], times[BARE], strict=True))
    print(
        f"overhead of a campaign in one process, of processor time: median {statistics.median(shares):+.2%} "
        f"({shares[0]:+.2%} to {shares[-1]:+.2%})"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
