"""What is said of a table of runs: rates with intervals, quantiles, paired tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.evaluate import METRICS, Outcome
from napf_mpc.planners.tally import COLUMNS, COUNTED, FALL_BACKS
from napf_mpc.risk import Rate, clustered_rate, paired_tests, quantiles, wilson
from napf_mpc.stopping import sequential_interval

Columns = dict[str, NDArray[Any]]


def summarise(rows: Columns, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise a table of runs: the layout of ``summary.json``.

    Parameters
    ----------
    rows : dict of str to array
        Columns of :func:`napf_mpc.block.score_rows`; every planner has the same runs in the same order.
    identity : mapping
        Of :func:`napf_mpc.provenance.identity`.

    Returns
    -------
    dict
        Identity, then per planner counts, rates with 95 % intervals and quantiles, then paired tests.
    """
    parts = {
        name: {key: values[rows["planner"] == name] for key, values in rows.items()}
        for name in identity["planners"]
    }
    hits = {name: np.asarray(part["obstacle_contact"], dtype=bool) for name, part in parts.items()}
    return {
        **{key: identity[key] for key in ("problem", "problem_hash", "data", "seed", "versions")},
        "planners": {name: _planner_summary(part) for name, part in parts.items()},
        "paired": [asdict(pair) for pair in paired_tests(hits)],
    }


def _planner_summary(part: Columns) -> dict[str, Any]:
    runs, contacts = len(part["run"]), int(part["obstacle_contact"].sum())
    low, high = sequential_interval(contacts, runs)
    outcomes = {str(outcome): int((part["outcome"] == str(outcome)).sum()) for outcome in Outcome}
    return {
        "runs": runs,
        "uavs": int(part["uavs"][0]),
        **outcomes,
        **_bounds("collision_risk", wilson(contacts, runs)),
        "collision_risk_sequential_low": low,
        "collision_risk_sequential_high": high,
        **_bounds("uav_collision_risk", clustered_rate(part["uavs_hit"], int(part["uavs"][0]))),
        **_bounds("uav_contact_risk", wilson(int(part["uav_contact"].sum()), runs)),
        "finished": int(part["finished"].sum()) / runs,
        "joint_success": int(part["joint_success"].sum()) / runs,
        **{name: quantiles(np.asarray(part[name], dtype=float)) for name in METRICS},
        "reasons": {
            str(word): int((part["reason"] == word).sum()) for word in np.unique(part["reason"]) if word
        },
        "solver": _solver_summary(part),
    }


def _solver_summary(part: Columns) -> dict[str, Any]:
    """Counts of all runs; a planner without a solver has none."""
    total = {name: int(part[name].sum()) for name in COLUMNS}
    status = {s.value: total[f"solves_{s.value}"] for s in COUNTED if total[f"solves_{s.value}"]}
    fall_backs = {name: total[f"fall_back_{name}"] for name in FALL_BACKS}
    return {
        "status": status,
        "iterations": total["iterations"] if status else None,
        "refused": total["answers_refused"],
        "fall_backs": sum(fall_backs.values()),
        "fall_back_steps": fall_backs,
        "margin_short": total["margin_short"],
        "largest_slack_m": quantiles(np.asarray(part["largest_slack_m"], dtype=float)),
    }


def _bounds(name: str, rate: Rate) -> dict[str, float]:
    return {name: rate.value, f"{name}_low": rate.low, f"{name}_high": rate.high}
