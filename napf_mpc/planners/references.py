"""Where each UAV ought to be along the horizon: its synchronised slot, bent by guidance (Eq. 14-19)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame, formation_offsets, synchronisation_error
from napf_mpc.planners.guide import Guide
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.qp import STATES

Array = NDArray[np.float64]
POSITION, VELOCITY = slice(0, 6, 2), slice(1, 6, 2)

LARGEST_PULL_M = 3.0
"""A slot farther than this counts as this far: the UAV comes back at its speed limit, without a lunge."""


@dataclass(frozen=True, eq=False)
class SlotReference:
    """References to the slots of a formation."""

    frame: PathFrame
    """Of the mission's path."""
    offsets: Array
    """(uav, 3) slots from the formation's centre: along, left, up [m]."""
    speed_mps: float
    """V_r."""

    @classmethod
    def of_problem(cls, problem: Problem, mission: FormationMission) -> SlotReference:
        """References of a problem's formation."""
        return cls(PathFrame.of_mission(mission), formation_offsets(problem.formation), mission.speed_mps)

    def over(
        self, position: Array, times_s: Array, sigma_m: Array | float = 0.0, guide: Guide | None = None
    ) -> Array:
        """States to track (run, uav, N, 12).

        The slots move at V_r from where the formation is now: its centre u_c is the mean of the reported
        along-track places, so that UAVs ahead of their slot are asked to drop back, and the others to catch
        up (Eq. 18).

        Parameters
        ----------
        position : array, shape (run, uav, 3)
            As reported [m].
        times_s : array, shape (N,)
            From now [s].
        sigma_m : array, shape (run, uav)
            Reported standard deviation of the position [m]. A distance e to the slot is believed, and so
            asked for, by the part ``e^2 / (e^2 + sigma^2)``: below sigma it is mostly navigation error, and
            chasing that would move the truth off the slot.
        guide : Guide, optional
            Offsets from the lanes, and pace.
        """
        place = self.frame.to_path(position)
        ahead = synchronisation_error(place[..., 0], self.offsets[:, 0])
        behind = _believed(ahead, sigma_m) * np.clip(-ahead, -LARGEST_PULL_M, LARGEST_PULL_M)
        pace = np.ones(ahead.shape) if guide is None else guide.pace
        speed = np.repeat((self.speed_mps * pace)[..., None], len(times_s), axis=-1)
        along = behind[..., None] + speed * times_s
        bend = np.zeros((*along.shape, 2)) if guide is None else guide.at(along)
        slope = np.zeros(bend.shape) if guide is None else guide.slope_at(along)
        here = np.zeros((*ahead.shape, 2)) if guide is None else guide.at(behind[..., None])[:, :, 0]
        away = self.offsets[:, 1:] + here - place[..., 1:]
        size = np.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2)
        pull = _believed(size, sigma_m) * LARGEST_PULL_M / np.maximum(size, LARGEST_PULL_M)
        across = (away * pull[..., None] - here)[:, :, None] + bend
        out = np.zeros((*along.shape, STATES))
        to_slot = np.concatenate([along[..., None], across], axis=-1)
        out[..., POSITION] = position[:, :, None] + self.frame.directions_to_world(to_slot)
        velocity = np.concatenate([speed[..., None], speed[..., None] * slope], axis=-1)
        out[..., VELOCITY] = self.frame.directions_to_world(velocity)
        out[..., 10] = self.frame.heading_rad
        return out


def _believed(distance_m: Array, sigma_m: Array | float) -> Array:
    """Part of a distance that is not put down to navigation errors."""
    square = distance_m**2
    return np.asarray(square / np.maximum(square + np.asarray(sigma_m) ** 2, 1e-12))
