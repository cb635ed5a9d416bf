"""What a planner may rely on: a map and solutions that fit its problem, and a time that goes on.

The compiled passes ask for no shape, and a planner that is told of a lost track by numbers that are none
would fly as if nothing were there. So what does not fit is refused before anything is made of it.
"""

from __future__ import annotations

import operator

from napf_mpc.errors import NavigationError
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import Problem
from napf_mpc.world.obstacles import ObstacleSet


def check_map(obstacles: ObstacleSet, runs: int) -> None:
    """Raise unless a planner can be reset to a map and a number of runs.

    Raises
    ------
    TypeError
        If the map is not an ObstacleSet, or the number not whole.
    ValueError
        If it is negative, or does not fit the map's scenes.
    """
    if not isinstance(obstacles, ObstacleSet):
        raise TypeError(f"obstacles is a {type(obstacles).__name__}, must be an ObstacleSet")
    if operator.index(runs) < 0:
        raise ValueError(f"runs = {runs}, must be >= 0")
    if runs:
        obstacles.check_runs(runs)


def check_told(nav: NavSolution, problem: Problem, runs: int, time_s: float, last_s: float) -> None:
    """Raise unless a solution fits a problem and the runs of the last reset, and time goes on.

    Parameters
    ----------
    nav : NavSolution
        As given to ``step``.
    problem : Problem
        Of the planner.
    runs : int
        Of its last reset.
    time_s, last_s : float
        Of this step and the last one, minus infinity before the first [s].

    Raises
    ------
    NavigationError
        If shapes differ, a moving obstacle of the problem has no track or one that is not finite, or time is
        not finite or goes back.
    """
    nav.check(runs, problem.uav_count)
    if not last_s <= time_s < float("inf"):
        raise NavigationError(
            f"time_s = {time_s}, must be finite and not before the last step's {last_s:g}; "
            "for another flight call reset"
        )
    moving = len(problem.world.moving)
    if nav.tracks is None:
        if moving:
            raise NavigationError(
                f"tracks is None, but the problem has {moving} moving obstacles: give their tracks, "
                "a lost one by its last place with a covariance that has grown"
            )
        return
    faults = nav.tracks.faults(runs)
    if faults:
        raise NavigationError("; ".join(faults))
