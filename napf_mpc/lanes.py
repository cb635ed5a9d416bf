"""Navigation by itself: UAVs in their slots, nobody plans, and what navigation makes of the errors there.

It tells filters and receivers apart without the planners that react to them, and in a fraction of the time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.closed_loop import build_scenario, formation_mission
from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.navigation.filtered import FilteredNavigation
from napf_mpc.navigation.fix import Fix, FixSource, fixes_of_flight
from napf_mpc.problem import Problem
from napf_mpc.streams import Seed

__all__ = ["LaneNavigation", "navigate"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LaneNavigation:
    """What navigation told of UAVs whose places are given."""

    time_s: Array
    """(t,) [s]."""
    error: Array
    """(t, run, uav, 3) told position less the true one, east, north, up [m]."""
    covariance: Array
    """(t, run, uav, 3, 3) as reported [m^2]."""
    gated_fixes: NDArray[np.int64]
    """(run,) fixes refused or outvoted, of all UAVs; zeros without a filter."""


class _Interrupted:
    """Fixes of a flight, and none for a while."""

    def __init__(self, fixes: FixSource, none: range) -> None:
        self._fixes, self._none = fixes, none

    def fix(self, epoch: int, position: Array) -> Fix:
        """Fix of an epoch at true places, not available in the outage."""
        found = self._fixes.fix(epoch, position)
        return replace(found, available=np.zeros_like(found.available)) if epoch in self._none else found


def navigate(
    problem: Problem,
    seed: Seed,
    runs: range,
    *,
    stand_m: float | None = None,
    seconds: float | None = None,
    every_s: float = 1.0,
    outage_s: tuple[float, float] | None = None,
    data_folder: Path | None = None,
) -> LaneNavigation:
    """Carry UAVs along their lanes at the reference speed, and keep what navigation tells.

    Parameters
    ----------
    problem : Problem
        Its formation, mission, world and navigation; a mission of kind "formation".
    seed : int or Numbers
        Campaign seed, or what stands for it: scenes and errors are those of a campaign's runs.
    runs : range
        Runs of the campaign.
    stand_m : float, optional
        Stand in the slots so far along the path instead [m].
    seconds : float, optional
        How long; by default what the path takes, or a minute for who stands [s].
    every_s : float
        Time between two moments that are kept, at least a tick of the inner loop [s].
    outage_s : (float, float), optional
        From when to when nobody has a fix, behind a filter, which begins by the one carried on to t = 0 all
        the same [s].
    data_folder : path, optional
        Of real data.

    Returns
    -------
    LaneNavigation
        From the first fix on.

    Raises
    ------
    NapfError
        If the scene cannot be built or a data file is missing.
    ValueError
        If ``seconds`` is not above 0 and within ``simulation.time_limit_s``, ``every_s`` not above 0, or
        ``outage_s`` no time, or of navigation without a filter.
    """
    mission = formation_mission(problem)
    frame, offsets = PathFrame.of_mission(mission), formation_offsets(problem.formation)
    errors = build_scenario(problem, seed, runs, data_folder).errors
    tick_s = 1.0 / problem.simulation.controller_rate_hz
    ticks_per_fix = round(errors.period_s / tick_s)
    pace, start = (mission.speed_mps, 0.0) if stand_m is None else (0.0, stand_m)
    if seconds is None:
        seconds = mission.length_m / mission.speed_mps if stand_m is None else 60.0
    limit_s = problem.simulation.time_limit_s
    if not (0.0 < seconds <= limit_s and every_s > 0.0):
        raise ValueError(
            f"seconds = {seconds:g}, every_s = {every_s:g}: need 0 < seconds <= simulation.time_limit_s = "
            f"{limit_s:g}, as far as errors are drawn, and every_s > 0"
        )
    settings = problem.navigation
    if outage_s is not None and not (0.0 <= outage_s[0] < outage_s[1] and settings.filter != "none"):
        raise ValueError(
            f"outage_s = {outage_s[0]:g}, {outage_s[1]:g} behind navigation.filter = "
            f'"{settings.filter}": need 0 <= first < last, and a filter, which is what goes on without fixes'
        )
    ahead = frame.to_world(np.array([[1.0, 0.0, 0.0]])) - frame.to_world(np.zeros((1, 3)))
    velocity = np.broadcast_to(pace * ahead, (len(runs), len(offsets), 3))
    still, active = np.zeros(velocity.shape), np.ones(len(runs), dtype=np.bool_)
    fixes: FixSource = fixes_of_flight(errors)
    if outage_s is not None:
        first, last = (round(moment / errors.period_s) for moment in outage_s)
        fixes = _Interrupted(fixes, range(first, last))
    filtered = None
    if settings.filter != "none":
        filtered = FilteredNavigation(settings, errors, seed, runs, tick_s, ticks_per_fix, velocity, fixes)
    time, error, covariance = [], [], []
    kept_ticks = max(1, round(every_s / tick_s))
    for tick in range(round(seconds / tick_s)):
        slots = offsets + np.array([start + pace * tick * tick_s, 0.0, 0.0])
        position = np.repeat(frame.to_world(slots)[None], len(runs), axis=0)
        if filtered is not None:
            told = filtered.solution(tick, tick * tick_s, position, velocity, still, still, active)
            off, spread = told.position - position, told.position_covariance
        elif tick % ticks_per_fix == 0:
            fix = fixes.fix(tick // ticks_per_fix, position)
            off, spread = fix.error, fix.covariance
        if tick % kept_ticks == 0:
            time.append(tick * tick_s)
            error.append(off.copy())
            covariance.append(spread.copy())
    gated = np.zeros(len(runs), dtype=np.int64) if filtered is None else filtered.gated_fixes
    return LaneNavigation(np.array(time), np.array(error), np.array(covariance), gated)
