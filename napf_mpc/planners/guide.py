"""What guidance asks of each UAV: a path beside its lane, and a pace."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Passage(IntEnum):
    """Why a UAV does not simply fly along its lane."""

    NONE = 0
    """It does."""
    DETOUR = 1
    """Its way bends around something."""
    WAIT = 2
    """It slows for a UAV that was left behind, or for what will cross its way."""
    SQUEEZE = 3
    """After a hold it goes through with less than the margin; ``breach_m`` says how much less."""
    HOLD = 4
    """It holds: at this confidence there is no way ahead now, but there may be one soon."""
    NO_PASSAGE = 5
    """It holds for good: no safe passage at this confidence."""


HOLD = int(Passage.HOLD)
"""The same as a plain number, for compiled loops."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Where the UAVs should go over the next metres, relative to their lanes."""

    ahead_m: Array
    """(K,) distances ahead of each UAV's own along-track place, evenly spaced from 0 [m]."""
    offset: Array
    """(run, uav, K, 2) offset from the lane at those places: left, up [m]."""
    pace: Array
    """(run, uav) factor 0 to 1 on the reference speed; 0 holds."""
    reason: NDArray[np.int8]
    """(run, uav) code of :class:`Passage`."""
    breach_m: Array
    """(run, uav) largest part of the margin r + k sigma that is missing on the way ahead; 0 for none [m]."""
    taut: Array | None = None
    """(run, uav, K, 2) the offset pulled taut, see :mod:`.taut`; by default as it is [m]."""
    loose: Array | None = None
    """(run, uav, K) part 0 to 1 of the way to the lane that is free, by default none."""
    room: Array | None = None
    """(run, uav, K) how far out from the lane the offset's direction is free, by default no farther than the
    way, see :mod:`.room` [m]."""

    def at(self, ahead_m: Array | float) -> Array:
        """Offsets at distances ahead, linear between the places and level beyond them [m].

        Parameters
        ----------
        ahead_m : array, shape (run, uav, N), or float
            One distance for all gives offsets (run, uav, 2), an array gives (run, uav, N, 2).
        """
        index, part = self._place(ahead_m)
        low = np.take_along_axis(self.offset, index[..., None], axis=2)
        high = np.take_along_axis(self.offset, index[..., None] + 1, axis=2)
        out = low + part[..., None] * (high - low)
        return np.asarray(out[:, :, 0] if np.ndim(ahead_m) == 0 else out)

    def slope(self, from_m: float, to_m: float) -> Array:
        """Mean slope (run, uav, 2) of the offset between two distances ahead."""
        return np.asarray((self.at(to_m) - self.at(from_m)) / (to_m - from_m))

    @property
    def _spacing(self) -> float:
        return float(self.ahead_m[1] - self.ahead_m[0])

    def _place(self, ahead_m: Array | float) -> tuple[NDArray[np.int64], Array]:
        ahead = np.full((*self.offset.shape[:2], 1), ahead_m) if np.ndim(ahead_m) == 0 else ahead_m
        place = np.clip(np.asarray(ahead) / self._spacing, 0.0, len(self.ahead_m) - 1.0)
        index = np.minimum(place.astype(np.int64), len(self.ahead_m) - 2)
        return index, place - index
