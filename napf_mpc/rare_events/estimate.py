"""Collision risk of a mission by subset simulation, into a folder, going on where an earlier call stopped.

Nothing of the chains is stored: they follow from the seed and the clearances of the missions flown so far.
Every finished block of missions leaves its clearances in ``calls/``; a later call goes the same way, reads
what is there instead of flying it, and flies on.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc import store
from napf_mpc.block import check_campaign
from napf_mpc.campaign import check_solver
from napf_mpc.campaign_folder import taken
from napf_mpc.errors import DataError, ProblemError
from napf_mpc.problem import Problem
from napf_mpc.provenance import identity
from napf_mpc.rare_events.collision import LeastClearance
from napf_mpc.rare_events.subset import SubsetResult, subset_simulation
from napf_mpc.words import shown_value

Array = NDArray[np.float64]

MAX_SAMPLES = 1_000_000
MAX_NUMBERS = 250_000_000
"""Random numbers of all samples of a level, at most: two gigabytes."""
CHAIN = 10
"""Length of a chain: a tenth of the samples of a level start the next."""


def estimate_collision_risk(
    problem: Problem,
    planner: str,
    out: Path,
    *,
    samples: int = 1000,
    seed: int = 0,
    name: str = "problem",
    data_folder: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Estimate the risk that any UAV of a mission touches an obstacle, however small.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planner : str
        Name of the planner.
    out : Path
        Output folder: ``calls.parquet`` and ``summary.json``.
    samples : int
        Missions a level, a multiple of 10. A risk of 1e-m takes about m levels; each after the first flies
        nine tenths of them anew.
    seed : int
        Seed, 0 <= seed < 2**63.
    name : str
        Problem's name in the summary.
    data_folder : Path, optional
        Where data files lie.
    progress : callable
        Told the number of missions finished so far.

    Returns
    -------
    dict
        The summary, as written to ``summary.json``.

    Raises
    ------
    NapfError
        If a setting or the problem is not usable, data are missing, or the folder cannot be used.
    """
    check_campaign([planner], 1, seed)
    check_solver(problem)
    check_samples(samples)
    limit = LeastClearance(problem, planner, seed, data_folder)
    if samples * limit.dimension > MAX_NUMBERS:
        raise ProblemError(
            "rare",
            [
                f"samples = {samples} of {limit.dimension} random numbers each are more than {MAX_NUMBERS}; "
                "lower --samples or simulation.time_limit_s"
            ],
        )
    origin = identity(problem, name, [planner], seed, data_folder) | {"rare": {"samples": samples}}
    with taken(out, origin) as out:
        calls = _Calls(limit, store.output_folder(out / "calls"), progress)
        store.remove_partial(calls.folder)
        result = subset_simulation(calls, limit.dimension, seed=seed, samples=samples)
        clearance = np.concatenate(calls.known)
        store.write_table(
            out / "calls.parquet", {"call": np.arange(len(clearance)), "clearance_m": clearance}
        )
        summary = _summary(origin, planner, result, clearance, limit.dimension)
        store.write_json(out / "summary.json", summary)
    return summary


def check_samples(samples: int) -> None:
    """Refuse a number of samples that cannot be used.

    Raises
    ------
    ProblemError
        Naming it.
    """
    if not 2 * CHAIN <= samples <= MAX_SAMPLES or samples % CHAIN:
        raise ProblemError(
            "rare",
            [
                f"samples = {shown_value(samples)}: must be a multiple of {CHAIN} from {2 * CHAIN} to "
                f"{MAX_SAMPLES}"
            ],
        )


def log_normal_interval(estimate: float, cov: float) -> tuple[float, float]:
    """95 % interval of a positive estimate whose logarithm is about normal.

    Parameters
    ----------
    estimate : float
        Above 0.
    cov : float
        Its coefficient of variation.
    """
    spread = math.exp(1.959963984540054 * math.sqrt(math.log1p(cov * cov)))
    return estimate / spread, min(1.0, estimate * spread)


def _summary(
    origin: dict[str, Any], planner: str, result: SubsetResult, clearance: Array, dimension: int
) -> dict[str, Any]:
    low, high = 0.0, None
    if result.reached:
        low, high = log_normal_interval(result.probability, result.cov_bound)
    return {
        **{key: origin[key] for key in ("problem", "problem_hash", "data", "seed", "versions")},
        "planner": planner,
        "method": "subset simulation",
        "samples": origin["rare"]["samples"],
        "dimension": dimension,
        "calls": result.calls,
        "failed": int(np.isneginf(clearance).sum()),
        "reached": result.reached,
        "collision_risk": result.probability,
        "collision_risk_low": low,
        "collision_risk_high": high,
        "cov": _plain(result.cov),
        "cov_bound": _plain(result.cov_bound),
        "below": result.below,
        "levels": [{key: _plain(value) for key, value in asdict(level).items()} for level in result.levels],
    }


def _plain(value: float) -> float | None:
    """JSON has no NaN and no infinity."""
    return value if math.isfinite(value) else None


@dataclass
class _Calls:
    """The limit state, with a memory on the disk."""

    limit: LeastClearance
    folder: Path
    progress: Callable[[int], None]
    known: list[Array] = field(default_factory=list)
    done: int = 0

    def __call__(self, points: Array) -> Array:
        step = self.limit.lock_step
        parts = [self._block(points[i : i + step]) for i in range(0, len(points), step)]
        return np.concatenate(parts)

    def _block(self, points: Array) -> Array:
        path = self.folder / f"calls_{self.done:08d}.parquet"
        labels = {"points": hashlib.sha256(points.tobytes()).hexdigest()}
        if path.exists():
            values = self._read(path, labels)
        else:
            values = self.limit.fly(points)
            store.write_table(path, {"clearance_m": values}, labels)
        self.known.append(values)
        self.done += len(points)
        self.progress(self.done)
        return values

    def _read(self, path: Path, labels: dict[str, str]) -> Array:
        way_out = "delete it and repeat the command: its missions are flown again"
        try:
            held = store.read_labels(path)
            values = np.asarray(store.read_table(path)["clearance_m"], dtype=np.float64)
        except (DataError, KeyError) as error:
            raise DataError(f"{path}: is damaged ({error}); {way_out}") from error
        if {key: held.get(key) for key in labels} != labels:
            raise DataError(f"{path}: holds missions of other random numbers; {way_out}")
        return values
