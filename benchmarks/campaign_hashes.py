"""Whether a campaign is the same to the bit however it is flown: blocks, workers, engines, stops, order.

Run ``python benchmarks/campaign_hashes.py``; it prints the SHA-256 of ``runs.parquet`` for every way, each
flown twice, then whether the first runs are those of a shorter campaign and whether another seed shares any
run. It exits with 1 if anything differs. The dask rows need distributed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from campaign_soak import short_problem
from campaign_torture import digest

from napf_mpc import store
from napf_mpc.campaign import run_campaign, versions
from napf_mpc.provenance import processor

BLOCKS = (1, 7, 64)
METRICS = ("path_length_ratio", "min_clearance_m", "control_effort")
"""Numbers that two different runs do not have in common."""


def shared_runs(a: Path, b: Path) -> int:
    """Count numbers that the runs of two campaigns have in common."""
    ours, theirs = (store.read_table(out / "runs.parquet") for out in (a, b))
    return sum(len(np.intersect1d(ours[name], theirs[name])) for name in METRICS)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--planners", nargs="+", default=["apf", "napf", "qp"])
    parser.add_argument("--runs", type=int, default=120)
    asked = parser.parse_args(arguments)
    problem = short_problem()
    half = asked.runs // 2
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hashes-")))
        engines: dict[str, tuple[int, str | None]] = {"1 worker": (1, None), "2 workers": (2, None)}
        if importlib.util.find_spec("distributed"):
            import distributed

            cluster = stack.enter_context(
                distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
            )
            engines["2 dask workers"] = (1, cluster.scheduler_address)
        count = iter(range(1_000_000))

        def fly(engine: str, block: int, runs: Sequence[int] = (asked.runs,), seed: int = 7) -> Path:
            """Fly a campaign of so many runs, and go on to so many, and so on."""
            out = folder / f"out{next(count)}"
            workers, address = engines[engine]
            for number in runs:
                run_campaign(
                    problem,
                    asked.planners,
                    number,
                    seed,
                    out,
                    workers=workers,
                    block_runs=block,
                    cluster=address,
                )
            return out

        print(f"{processor()}, {', '.join(f'{k} {v}' for k, v in versions().items())}")
        print(f"table1_8, its first two seconds, {', '.join(asked.planners)}, {asked.runs} runs, seed 7")
        hashes = []
        for engine in engines:
            for block in BLOCKS:
                for what, runs in (("", [asked.runs]), ("resumed", [half, asked.runs])):
                    for _ in range(2):
                        hashes.append(digest(fly(engine, block, runs)))
                        print(f"{engine:<16}{block:>4} a block  {what:<9}{hashes[-1]}", flush=True)
        same = len(set(hashes)) == 1
        long, short = fly("1 worker", 64), fly("1 worker", 7, [half])
        fly_on_shorter = fly("1 worker", 64, [asked.runs, half])
        first = digest(fly_on_shorter) == digest(short)
        shared = shared_runs(long, fly("1 worker", 64, seed=8))
    print(f"{len(hashes)} campaigns: {'all the same' if same else 'NOT the same'}")
    print(f"first {half} of {asked.runs} are a campaign of {half}: {first}")
    print(f"numbers that runs of seed 8 share with runs of seed 7: {shared}")
    return 0 if same and first and not shared else 1


if __name__ == "__main__":
    raise SystemExit(main())
