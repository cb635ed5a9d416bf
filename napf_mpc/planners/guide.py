"""What guidance asks of each UAV: a path beside its lane, and a pace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Guide:
    """Paths ahead of all UAVs of all runs, as offsets from their lanes."""

    ahead_m: Array
    """(K,) distances ahead of each UAV's own along-track place, evenly spaced from 0 [m]."""
    offset: Array
    """(run, uav, K, 2) to the left of the lane and up from it, at those places [m]."""
    pace: Array
    """(run, uav) factor 0 to 1 on the reference speed; 0 holds."""
    reason: NDArray[np.int8]
    """(run, uav) codes of :class:`napf_mpc.planners.guidance.Reason`."""

    def at(self, ahead_m: Array) -> Array:
        """Offsets (run, uav, N, 2) at distances ahead (run, uav, N), linear between the places [m]."""
        index, part = self._place(ahead_m)
        low = np.take_along_axis(self.offset, index[..., None], axis=2)
        high = np.take_along_axis(self.offset, index[..., None] + 1, axis=2)
        return np.asarray(low + part[..., None] * (high - low))

    def slope_at(self, ahead_m: Array) -> Array:
        """Offset per metre flown (run, uav, N, 2) at distances ahead (run, uav, N); 0 past the last place."""
        index, _ = self._place(ahead_m)
        low = np.take_along_axis(self.offset, index[..., None], axis=2)
        high = np.take_along_axis(self.offset, index[..., None] + 1, axis=2)
        inside = (ahead_m >= 0.0) & (ahead_m < self.ahead_m[-1])
        return np.asarray(np.where(inside[..., None], (high - low) / self._spacing, 0.0))

    @property
    def _spacing(self) -> float:
        return float(self.ahead_m[1] - self.ahead_m[0])

    def _place(self, ahead_m: Array) -> tuple[NDArray[np.int64], Array]:
        place = np.clip(ahead_m / self._spacing, 0.0, len(self.ahead_m) - 1.0)
        index = np.minimum(place.astype(np.int64), len(self.ahead_m) - 2)
        return index, place - index
