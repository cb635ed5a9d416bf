"""Where each UAV ought to be along the horizon: its synchronised slot, bent by guidance (Eq. 14-19)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame, formation_offsets, synchronisation_error
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.planners.guide import HOLD, Guide
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.qp import STATES
from napf_mpc.vehicle.plant import plain

Array = NDArray[np.float64]
LARGEST_PULL_M = 4.0
"""A slot farther than this counts as this far: the UAV comes back at its speed limit, without a lunge."""


class Here(NamedTuple):
    """Where the UAVs are now, as their references start from it."""

    position: Array
    """(run, uav, 3) in the world [m]."""
    place: Array
    """(run, uav, 3) on the path [m]."""
    sigma: Array
    """(run, uav, 3) of what will prove to have been error, along, left and up [m]."""
    behind: Array
    """(run, uav) how far the slot is ahead, as far as believed [m]."""


class Ways(NamedTuple):
    """States (run, uav, N, 12) along which a guide leads from where the UAVs are."""

    way: Array
    """As guidance has found it."""
    pulled: Array
    """Pulled taut; what to track."""
    free: Array
    """On the lanes."""
    loose: Array
    """(run, uav, N) part 0 to 1 of the way to the lane that is free."""
    room: Array
    """(run, uav, N) how far out from the lane the offset's direction is free [m]."""


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
        sigma_m : array, shape (run, uav, 3), or float
            Of what will prove to have been error, along, left and up [m]: all of a *measurement's* error. A
            distance e to the slot is believed, and so asked for, by the part ``e^2 / (e^2 + sigma^2)`` of
            each axis: below sigma it is mostly navigation error, and chasing that would move the truth off
            the slot. The error of a filter's estimate does not depend on the estimate: there it is what the
            filter expects to correct, and in the long run nothing.
        guide : Guide, optional
            Offsets from the lanes, and pace.
        """
        return self.over_from(self.here(position, sigma_m), times_s, guide)

    def here(self, position: Array, sigma_m: Array | float = 0.0) -> Here:
        """Where references start; parameters are those of :meth:`over`."""
        place, behind = self.frame.to_path(position), np.empty(position.shape[:2])
        sigma = np.asarray(sigma_m, dtype=np.float64)
        if sigma.shape != place.shape:
            sigma = np.broadcast_to(sigma, place.shape)
        here = Here(plain(position), place, plain(sigma), behind)
        _believe(synchronisation_error(place[..., 0], self.offsets[:, 0]), here.sigma, behind)
        return here

    def over_from(self, here: Here, times_s: Array, guide: Guide | None = None) -> Array:
        """States to track (run, uav, N, 12), as :meth:`over` makes them."""
        runs, uavs = here.behind.shape
        out = np.zeros((runs, uavs, len(times_s), STATES))
        _write(
            here.position, here.place, plain(self.offsets), here.sigma, here.behind, self.speed_mps,
            np.ones((runs, uavs)) if guide is None else plain(guide.pace),
            _NO_BEND if guide is None else plain(guide.ahead_m),
            np.empty((runs, uavs, 0, 2)) if guide is None else plain(guide.offset),
            plain(times_s), self.frame.axes, self.frame.heading_rad, out,
        )  # fmt: skip
        return out

    def ways_from(self, here: Here, times_s: Array, guide: Guide) -> Ways:
        """The guide's way, its taut one and the lanes, as :meth:`over_from` makes each of them.

        Parameters
        ----------
        here, times_s
            As in :meth:`over_from`.
        guide : Guide
            With a taut way.
        """
        assert guide.taut is not None
        assert guide.loose is not None
        room = np.zeros_like(guide.loose) if guide.room is None else guide.room
        shape = (*here.behind.shape, len(times_s))
        ways = Ways(*np.zeros((3, *shape, STATES)), *np.empty((2, *shape)))
        _write_ways(
            *here, plain(self.offsets), self.speed_mps, plain(guide.pace), plain(guide.ahead_m),
            plain(guide.offset), plain(guide.taut), plain(guide.loose), plain(room), guide.reason,
            plain(times_s), self.frame.origin, self.frame.axes, self.frame.heading_rad, *ways,
        )  # fmt: skip
        return ways


_NO_BEND = np.empty(0)


@compiled
def _write(
    position: Array, place: Array, slots: Array, sigma_m: Array, behind: Array, speed_mps: float, pace: Array,
    ahead_m: Array, bend: Array, times_s: Array, axes: Array, heading_rad: float, out: Array,
) -> None:  # fmt: skip
    """Write states to track into out (run, uav, N, 12), which comes as zeros.

    Parameters
    ----------
    position, place : array, shape (run, uav, 3)
        In the world and on the path [m].
    slots : array, shape (uav, 3)
        From the formation's centre [m].
    sigma_m : array, shape (run, uav, 3)
        Of measurements along, left and up [m].
    behind, pace : array, shape (run, uav)
        How far the slot is ahead, as far as believed [m], and the factor on the speed.
    ahead_m, bend : array, shapes (K,) and (run, uav, K, 2), without entries if K is 0
        A guide's distances, and offsets there [m].
    axes : array, shape (3, 3)
        Rows along, left, up.
    """
    room = np.zeros((5, 2))
    for run in range(out.shape[0]):
        for uav in range(out.shape[1]):
            _write_one(
                position[run, uav], place[run, uav], slots[uav], sigma_m[run, uav], behind[run, uav],
                speed_mps * pace[run, uav], ahead_m, bend[run, uav], times_s, axes, heading_rad, room,
                out[run, uav],
            )  # fmt: skip


@compiled_bare
def _write_one(
    position: Array, place: Array, slot: Array, sigma_m: Array, behind: float, speed: float, ahead_m: Array,
    bend: Array, times_s: Array, axes: Array, heading_rad: float, room: Array, out: Array,
) -> None:  # fmt: skip
    """Write the states (N, 12) of one UAV; ``room`` (5, 2) is to work in, zeros if there is no guide."""
    guided = len(ahead_m) > 0
    here, there, slope, across, start = room[0], room[1], room[2], room[3], room[4]
    if guided:
        _bend(ahead_m, bend, behind, here, slope)
    for a in range(2):
        across[a] = slot[1 + a] + here[a] - place[1 + a]
    size = math.sqrt(across[0] * across[0] + across[1] * across[1])
    for a in range(2):
        square, noise = across[a] * across[a], sigma_m[1 + a] * sigma_m[1 + a]
        believed = square / max(square + noise, 1e-12)
        start[a] = across[a] * believed * LARGEST_PULL_M / max(size, LARGEST_PULL_M) - here[a]
    for n in range(len(times_s)):
        along = behind + speed * times_s[n]
        if guided:
            _bend(ahead_m, bend, along, there, slope)
        left, up = start[0] + there[0], start[1] + there[1]
        for a in range(3):
            way = along * axes[0, a] + left * axes[1, a] + up * axes[2, a]
            out[n, 2 * a] = position[a] + way
            out[n, 2 * a + 1] = (
                speed * axes[0, a] + speed * slope[0] * axes[1, a] + speed * slope[1] * axes[2, a]
            )
        out[n, 10] = heading_rad


@compiled
def _write_ways(
    position: Array, place: Array, sigma_m: Array, behind: Array, slots: Array, speed_mps: float, pace: Array,
    ahead_m: Array, bend: Array, taut: Array, loose: Array, room_m: Array, reason: NDArray[np.int8],
    times_s: Array, origin: Array, axes: Array, heading_rad: float, way: Array, pulled: Array, free: Array,
    loosely: Array, outwards: Array,
) -> None:  # fmt: skip
    """Write the :class:`Ways` of a guide from :class:`Here`; arrays of states come as zeros.

    UAVs that hold have no taut way: theirs is the guide's, and none of it is loose.
    """
    room, level = np.zeros((5, 2)), np.zeros((len(ahead_m), 2))
    spacing, last = ahead_m[1] - ahead_m[0], len(ahead_m) - 1
    for run in range(pace.shape[0]):
        for uav in range(pace.shape[1]):
            at, on, sigma = position[run, uav], place[run, uav], sigma_m[run, uav]
            late, speed = behind[run, uav], speed_mps * pace[run, uav]
            holds = reason[run, uav] >= HOLD
            found, lane = bend[run, uav], free[run, uav]
            _write_one(
                at, on, slots[uav], sigma, late, speed, ahead_m, found, times_s, axes, heading_rad, room,
                way[run, uav],
            )  # fmt: skip
            _write_one(
                at, on, slots[uav], sigma, late, speed, ahead_m, found if holds else taut[run, uav], times_s,
                axes, heading_rad, room, pulled[run, uav],
            )  # fmt: skip
            _write_one(
                at, on, slots[uav], sigma, late, speed, ahead_m, level, times_s, axes, heading_rad, room,
                lane,
            )  # fmt: skip
            for n in range(len(times_s)):
                x, y, z = lane[n, 0] - origin[0], lane[n, 2] - origin[1], lane[n, 4] - origin[2]
                along = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]
                ahead = min(max((along - on[0]) / spacing, 0.0), float(last))
                station = min(int(ahead), last - 1)
                loosely[run, uav, n] = 0.0 if holds else loose[run, uav, station]
                nearby = min(room_m[run, uav, station], room_m[run, uav, station + 1])
                outwards[run, uav, n] = 0.0 if holds else nearby


@compiled_bare
def _bend(ahead_m: Array, bend: Array, along: float, offset: Array, slope: Array) -> None:
    """Write a guide's offset and slope at a distance ahead, as :class:`~.guide.Guide` reads them."""
    spacing, last = ahead_m[1] - ahead_m[0], len(ahead_m) - 1
    place = along / spacing
    if not place > 0.0:  # what is not a number would not be a place
        place = 0.0
    elif place > last:
        place = float(last)
    index = min(int(place), last - 1)
    part = place - index
    inside = 0.0 <= along < ahead_m[last]
    for a in range(2):
        low, high = bend[index, a], bend[index + 1, a]
        offset[a] = low + part * (high - low)
        slope[a] = (high - low) / spacing if inside else 0.0


@compiled
def _believe(ahead: Array, sigma: Array, behind: Array) -> None:
    """Write the part of how far UAVs are behind (run, uav) that is not put down to navigation errors."""
    for run in range(behind.shape[0]):
        for uav in range(behind.shape[1]):
            square, noise = ahead[run, uav] * ahead[run, uav], sigma[run, uav, 0] * sigma[run, uav, 0]
            pull = min(max(-ahead[run, uav], -LARGEST_PULL_M), LARGEST_PULL_M)
            behind[run, uav] = square / max(square + noise, 1e-12) * pull
