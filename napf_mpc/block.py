"""A block of runs in this process: every planner flown in lock-step through the same scenes and errors."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from napf_mpc import store
from napf_mpc.closed_loop import Scenario, build_scenario, closed_loop
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import METRICS, MissionScore, Outcome, Score
from napf_mpc.navigation.monitor import DoubtEvent, MonitorEvent
from napf_mpc.own_parts import OwnParts
from napf_mpc.planners.planner import Planner, planner_fault, tally_of
from napf_mpc.planners.registry import NAME_IT, make_planner
from napf_mpc.planners.tally import Event, Tally
from napf_mpc.problem import Problem
from napf_mpc.record import TrajectoryRecorder
from napf_mpc.words import shown_value

MAX_RUNS = 10_000_000
MAX_SEED = 2**63 - 1
MAX_WORKERS = 1024
MAX_TICKS = 2**31 - 1


@dataclass(frozen=True)
class Block:
    """Results of some runs of a campaign."""

    rows: store.Columns
    """One row a planner and run: outcome and metrics."""
    timing: store.Columns
    """One row a planner: wall time of the block, kept apart from results."""
    trajectories: store.Columns
    """Rows by planner, run, time and UAV; no columns if not asked for."""
    events: store.Columns
    """One row a fall-back that a planner took to: planner, run, time, UAV, cause, action."""


@dataclass(frozen=True)
class Missions:
    """Missions of one planner, flown in this process."""

    score: Score
    """Verdicts and metrics on the truth."""
    scenario: Scenario
    """What they flew through."""
    trajectories: store.Columns
    """Rows by run, time and UAV; no columns if not asked for."""
    tally: Tally
    """What the planner's solver did."""


def simulate(
    problem: Problem,
    planner: str | Planner = "napf",
    *,
    seed: int = 0,
    runs: int | range = 1,
    record_every: int = 0,
    data_folder: Path | None = None,
) -> Missions:
    """Fly missions in this process, all in lock-step, and judge them on the truth.

    Thousands of runs at once take memory; :func:`napf_mpc.compare` and :func:`napf_mpc.run_campaign` cut
    theirs into blocks.

    Parameters
    ----------
    problem : Problem
        Formation problem, see :func:`napf_mpc.load_problem`.
    planner : str or Planner
        Name, shipped or of :func:`napf_mpc.register_planner`, or a planner of your own.
    seed : int
        Campaign seed, 0 <= seed < 2**63.
    runs : int or range
        Number of runs, or their indices in the campaign of this seed.
    record_every : int
        Keep every n-th tick of the inner loop as trajectory; 0 for none.
    data_folder : Path, optional
        Where data files lie.

    Returns
    -------
    Missions
        Score, scenario and trajectories.

    Raises
    ------
    NapfError
        If a setting or the problem is not usable, or data are missing.
    """
    indices = runs if isinstance(runs, range) else range(_checked_count(runs))
    if indices.step != 1 or indices.start < 0 or len(indices) == 0:
        raise ProblemError("simulate", [f"runs = {indices}: must be one or more indices >= 0 without gaps"])
    pilot = make_planner(planner, problem) if isinstance(planner, str) else planner
    if fault := planner_fault(pilot):
        raise ProblemError("planner", [fault])
    name = planner if isinstance(planner, str) else pilot.name
    check_campaign([name], indices.stop, seed, record_every=record_every)
    scenario = build_scenario(problem, seed, indices, data_folder)
    return _fly(problem, name, pilot, scenario, record_every)


def _checked_count(runs: int) -> int:
    check_campaign(["any"], runs, 0)
    return runs


def fly_block(
    problem: Problem,
    planners: Sequence[str],
    seed: int,
    runs: range,
    data_folder: Path | None = None,
    record_every: int = 0,
    own: OwnParts | None = None,
) -> Block:
    """Fly some runs of a campaign with every planner, on the same scenes and errors.

    Parameters
    ----------
    problem : Problem
        Formation problem.
    planners : sequence of str
        Names of planners.
    seed : int
        Campaign seed.
    runs : range
        Indices of the runs.
    data_folder : Path, optional
        Where data files lie.
    record_every : int
        Keep every n-th tick of the trajectories; 0 for none.
    own : OwnParts, optional
        Planners and a solver that were registered in another process.

    Returns
    -------
    Block
        Rows ordered by planner, then run. No row depends on which others are in the block.

    Raises
    ------
    NapfError
        If the problem cannot be flown or data are missing.
    """
    if own is not None:
        own.lend()
    # More threads than one would make workers fight for the cores, and win nothing on small matrices.
    with threadpool_limits(1):
        scenario = build_scenario(problem, seed, runs, data_folder)
        rows, timing, trajectories, events = [], [], [], []
        factories = None if own is None else own.planners
        for name in planners:
            began = time.perf_counter()
            flown = _fly(problem, name, make_planner(name, problem, factories), scenario, record_every)
            timing.append(timing_row(name, runs, time.perf_counter() - began))
            rows.append(score_rows(name, seed, flown.score, flown.tally))
            events.append(flown.tally.event_columns(name, runs.start))
            if flown.trajectories:
                trajectories.append(flown.trajectories)
    return Block(store.stack(rows), store.stack(timing), store.stack(trajectories), store.stack(events))


def _fly(problem: Problem, name: str, planner: Planner, scenario: Scenario, record_every: int) -> Missions:
    judge = MissionScore(problem, scenario)
    recorder = TrajectoryRecorder(name, scenario.runs, record_every) if record_every else None
    flight = closed_loop(problem, planner, scenario, (judge,) if recorder is None else (judge, recorder))
    track = {} if recorder is None else recorder.columns()
    tally = tally_of(planner, len(scenario.runs))
    if flight.monitor is not None:
        # A copy: the planner keeps its own list.
        told = [*map(_event, flight.monitor.events), *map(_doubt, flight.monitor.doubts)]
        tally = replace(tally, events=[*tally.events, *told])
    return Missions(judge.score(flight), scenario, track, tally)


def _event(alarm: MonitorEvent) -> Event:
    axis = ("east", "north", "up")[alarm.axis]
    return Event(
        alarm.time_s,
        alarm.run,
        alarm.uav,
        f"reported sigma {axis} too small for its innovations",
        f"sigma {axis} x {alarm.sigma_scale:.3g}",
    )


_TURNS = {
    "begins": ("fixes disagree with the estimate", "hold"),
    "ends": ("fixes agree with the estimate again", "fly on"),
    "given in": ("fixes disagree for too long", "begin anew with the fix"),
}


def _doubt(doubt: DoubtEvent) -> Event:
    return Event(doubt.time_s, doubt.run, doubt.uav, *_TURNS[doubt.turn])


def score_rows(planner: str, seed: int, score: Score, tally: Tally | None = None) -> store.Columns:
    """Return one row a run: who, which run, how it ended, its metrics, and what the solver did."""
    runs = len(score.runs)
    return {
        "planner": np.full(runs, planner),
        "run": score.runs,
        "seed": np.full(runs, seed, dtype=np.int64),
        "outcome": np.array([str(outcome) for outcome in score.outcome]),
        "finished": score.finished,
        "obstacle_contact": score.obstacle_contact.any(-1),
        "uav_contact": score.uav_contact,
        "uavs_hit": score.obstacle_contact.sum(-1).astype(np.int64),
        "uavs": np.full(runs, score.obstacle_contact.shape[1], dtype=np.int64),
        "joint_success": score.joint_success,
        "reason": np.array(score.reason, dtype=np.str_),
        **score.metrics,
        **(tally or Tally.none(runs)).columns(),
    }


def lost_block(
    planners: Sequence[str], seed: int, runs: range, uavs: int, outcome: Outcome, reason: str
) -> Block:
    """Return rows for runs that could not be flown: their seeds, an outcome and why, and no metrics."""
    count = len(runs)
    no = np.zeros(count, dtype=bool)
    score = Score(
        runs=np.arange(runs.start, runs.stop, dtype=np.int64),
        outcome=(outcome,) * count,
        obstacle_contact=np.zeros((count, uavs), dtype=bool),
        uav_contact=no,
        joint_success=no,
        finished=no,
        reason=(reason,) * count,
        metrics={name: np.full(count, np.nan) for name in METRICS},
    )
    none = Tally.none(count)
    return Block(
        rows=store.stack([score_rows(name, seed, score) for name in planners]),
        timing={name: values[:0] for name, values in timing_row(planners[0], runs, 0.0).items()},
        trajectories={},
        events=store.stack([none.event_columns(name, runs.start) for name in planners]),
    )


def timing_row(planner: str, runs: range, seconds: float) -> store.Columns:
    """Wall time that a planner's flight of some runs took."""
    return {
        "planner": np.array([planner]),
        "first_run": np.array([runs.start]),
        "runs": np.array([len(runs)]),
        "wall_s": np.array([seconds]),
    }


def check_campaign(
    planners: Sequence[str], runs: int, seed: int, workers: int = 1, record_every: int = 0
) -> None:
    """Refuse campaign settings that cannot be meant.

    Raises
    ------
    ProblemError
        Naming every setting that is out of range.
    """
    faults = []
    for name, value, low, high in (
        ("runs", runs, 1, MAX_RUNS),
        ("seed", seed, 0, MAX_SEED),
        ("workers", workers, 1, MAX_WORKERS),
        ("record_every", record_every, 0, MAX_TICKS),
    ):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
            most = "2**63 - 1" if high == MAX_SEED else f"{high}"
            faults.append(f"{name} = {shown_value(value)}: must be a whole number from {low} to {most}")
    if isinstance(planners, str):
        faults.append("planners: give a list of at least one name")
    elif not isinstance(planners, Collection):
        faults.append(f"planners is {_described(planners)}, not a list of names: {NAME_IT}")
    elif not len(planners):
        faults.append("planners: give a list of at least one name")
    elif others := [(i, planner) for i, planner in enumerate(planners) if not isinstance(planner, str)]:
        faults += [f"planners[{i}] is {_described(other)}, not a name: {NAME_IT}" for i, other in others]
    elif len(set(planners)) != len(planners):
        faults.append(f"planners = {','.join(planners)[:200]}: each may be named once")
    if faults:
        raise ProblemError("campaign", faults)


def _described(thing: object) -> str:
    return f"the class {thing.__name__}" if isinstance(thing, type) else f"a {type(thing).__name__}"
