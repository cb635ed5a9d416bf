"""What flies when a solve is refused: the last plan's tail, then a hover, then a descent; each use counts."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from napf_mpc.planners.tally import Event

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Codes = NDArray[np.int8]

TAIL_S = 1.0
"""Oldest plan whose tail is flown: navigation and neighbours have moved on by then [s]."""
MOST_EVENTS = 1_000
"""Events of a run that are kept one by one; all uses are counted."""


class Action(IntEnum):
    """What a UAV does now; the ladder goes down as long as no plan is accepted."""

    PLAN = 0
    """Fly the plan accepted this step."""
    TAIL = 1
    """Fly on along the last accepted plan: it is young and still clear."""
    HOVER = 2
    """Brake and hold the place."""
    DESCEND = 3
    """Hold the place and go down, see :mod:`napf_mpc.planners.descent`."""


class Ladder:
    """Memory of the fall-backs of a block of missions.

    Parameters
    ----------
    runs, uavs : int
        Shape of the masks to come.
    """

    def __init__(self, runs: int, uavs: int) -> None:
        self.events: list[Event] = []
        """Every time that a UAV takes to an action other than a new plan."""
        self._kept = np.zeros(runs, dtype=np.int64)
        self._last: Codes = np.zeros((runs, uavs), dtype=np.int8)

    def all_accepted(self) -> Codes:
        """What :meth:`decide` says where every plan was accepted."""
        self._last = np.zeros(self._last.shape, dtype=np.int8)  # Action.PLAN
        return self._last

    def decide(
        self,
        time_s: float,
        accepted: Mask,
        age_s: Array,
        clear: Mask,
        causes: NDArray[np.object_],
        lower: Callable[[Mask], Mask] | None = None,
    ) -> Codes:
        """Choose what each UAV flies.

        Parameters
        ----------
        time_s : float
            Now [s].
        accepted : array of bool, shape (run, uav)
            Whether this step's plan passed the acceptance test.
        age_s : array, shape (run, uav)
            Age of the last accepted plan; infinite without one [s].
        clear : array of bool, shape (run, uav)
            Whether its tail keeps clear of all obstacles.
        causes : array of str, shape (run, uav)
            Why the plan was refused; an empty word is no event, for a UAV that does not fly.
        lower : callable, optional
            Tells who goes down (run, uav) of those that can only hover (run, uav); by default nobody does.

        Returns
        -------
        array of int8, shape (run, uav)
            Codes of :class:`Action`.
        """
        action: Codes = np.full(accepted.shape, Action.HOVER, dtype=np.int8)
        # A tail starts a plan's age too late to be rounded away by a clock of ten periods.
        action[(age_s <= TAIL_S + 1e-9) & clear] = Action.TAIL
        action[accepted] = Action.PLAN
        if lower is not None:
            action[lower(action == Action.HOVER)] = Action.DESCEND
        changed = (action != self._last) & (action != Action.PLAN) & (causes != "")
        for run, uav in np.argwhere(changed).tolist():
            if self._kept[run] < MOST_EVENTS:  # of a run, whatever else flies with it
                self._kept[run] += 1
                taken = Action(int(action[run, uav]))
                self.events.append(Event(time_s, run, uav, str(causes[run, uav]), taken.name.lower()))
        self._last = action
        return action
