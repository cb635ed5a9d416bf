"""How often intervals that are looked at after every run ever miss the rate, and how many runs a claim takes.

Run ``python benchmarks/stopping.py``; the tables of ``docs/statistics.md``.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from napf_mpc.risk import wilson
from napf_mpc.stopping import ALPHA, StoppingRule, log_evidence

RATES = (0.002, 0.05, 0.3)
LIMITS = (0.05, 0.01, 0.002, 0.001)
CONTACTS = (0, 1, 2, 5)
Z = 1.959963984540054


def misses(rate: float, sequences: int, looks: int) -> tuple[int, int]:
    """Sequences in which the sequential interval, and the Wilson interval, ever miss the rate."""
    rng = np.random.default_rng(np.random.SeedSequence(5, spawn_key=(round(1e6 * rate),)))
    counts, runs = (rng.random((sequences, looks)) < rate).cumsum(axis=1), np.arange(1, looks + 1)
    sequential = log_evidence(counts, runs, rate) > -math.log(ALPHA)
    fixed = np.abs(counts / runs - rate) > Z * np.sqrt(rate * (1.0 - rate) / runs)
    return int(sequential.any(axis=1).sum()), int(fixed.any(axis=1).sum())


def fewest(limit: float, count: int, *, fixed: bool) -> int:
    """Runs with so many contacts that put the upper end of the interval below a limit."""
    rule = StoppingRule(upper=limit)
    low, high = count + 1, 10_000_000
    while high - low > 1:
        middle = (low + high) // 2
        met = wilson(count, middle).high < limit if fixed else rule.met(count, middle)
        low, high = (low, middle) if met else (middle, high)
    return high


def share(count: int, total: int) -> str:
    rate = wilson(count, total)
    return f"{100 * rate.value:.1f} [{100 * rate.low:.1f}, {100 * rate.high:.1f}]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=2000)
    parser.add_argument("--looks", type=int, default=5000)
    arguments = parser.parse_args()
    print("| true rate | sequential interval ever misses (%) | Wilson interval ever misses (%) |")
    print("| ---: | ---: | ---: |")
    for rate in RATES:
        missed = misses(rate, arguments.sequences, arguments.looks)
        cells = [share(count, arguments.sequences) for count in missed]
        print(f"| {rate:g} | {cells[0]} | {cells[1]} |")
    print(f"\nN = {arguments.sequences} sequences of {arguments.looks} runs each.\n")
    print("| claim | " + " | ".join(f"{count} contacts" for count in CONTACTS) + " | N fixed, 0 contacts |")
    print("| --- |" + " ---: |" * (len(CONTACTS) + 1))
    for limit in LIMITS:
        runs = [fewest(limit, count, fixed=False) for count in CONTACTS]
        runs.append(fewest(limit, 0, fixed=True))
        print(f"| risk below {100 * limit:g} % | " + " | ".join(f"{n:,}" for n in runs) + " |")


if __name__ == "__main__":
    main()
