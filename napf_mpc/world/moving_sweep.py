"""Verdicts on truth against moving obstacles: the smallest distance during each physics step."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.jit import compiled
from napf_mpc.world.distance import length3
from napf_mpc.world.moving import MovingObstacles
from napf_mpc.world.sweep import check_steps


class MovingClearance:
    """Running minimum of the signed distance between each UAV and the moving obstacles of its run.

    During a step both move evenly and straight between where they truly are at its ends. With relative
    position w and relative displacement v the distance of centres is min over 0 <= t <= 1 of |w + t v|; an
    accelerating obstacle leaves its chord by a h^2 / 8 at most (0.05 mm at 1 m/s^2 and steps h of 0.02 s).

    Parameters
    ----------
    moving : MovingObstacles
        Of all runs.
    runs, uavs : int
        Shape of the positions to come.

    Attributes
    ----------
    clearance : array, shape (run, uav)
        Smallest signed distance so far; +inf before the first update [m].
    index : array, shape (run, uav)
        Obstacle that gave it; -1 for none.

    Raises
    ------
    ValueError
        If the runs do not fit.
    """

    def __init__(self, moving: MovingObstacles, runs: int, uavs: int) -> None:
        if moving.runs != runs:
            raise ValueError(f"moving obstacles are those of {moving.runs} runs, must be {runs}")
        self._moving = moving
        self.clearance = np.full((runs, uavs), np.inf)
        self.index = np.full((runs, uavs), -1, dtype=np.int64)

    def update(
        self, start_s: float, stop_s: float, p0: ArrayLike, p1: ArrayLike, active: ArrayLike | None = None
    ) -> None:
        """Take in one step of flight.

        Parameters
        ----------
        start_s, stop_s : float
            Times of its ends [s].
        p0, p1 : array, shape (run, uav, 3)
            True positions at its ends [m].
        active : array of bool, shape (run,), optional
            Runs that still fly; the positions of others are not looked at.

        Raises
        ------
        ValueError
            If a shape does not fit or a position of an active run is not finite.
        """
        start, stop, flying = check_steps(p0, p1, active, self.clearance.shape)
        _sweep(
            start,
            stop,
            self._moving.position(start_s),
            self._moving.position(stop_s),
            self._moving.radius,
            self._moving.upright,
            flying,
            self.clearance,
            self.index,
        )


@compiled
def _sweep(
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    from_: NDArray[np.float64],
    to: NDArray[np.float64],
    radius: NDArray[np.float64],
    upright: NDArray[np.bool_],
    flying: NDArray[np.bool_],
    clearance: NDArray[np.float64],
    index: NDArray[np.int64],
) -> None:
    for r in range(start.shape[0]):
        if not flying[r]:
            continue
        for u in range(start.shape[1]):
            for i in range(len(radius)):
                wx = start[r, u, 0] - from_[r, i, 0]
                wy = start[r, u, 1] - from_[r, i, 1]
                wz = start[r, u, 2] - from_[r, i, 2]
                vx = stop[r, u, 0] - to[r, i, 0] - wx
                vy = stop[r, u, 1] - to[r, i, 1] - wy
                vz = stop[r, u, 2] - to[r, i, 2] - wz
                if upright[i]:
                    wz = 0.0
                    vz = 0.0
                square = vx * vx + vy * vy + vz * vz
                t = 0.0
                if square > 0.0:
                    t = min(max(-(wx * vx + wy * vy + wz * vz) / square, 0.0), 1.0)
                d = length3(wx + t * vx, wy + t * vy, wz + t * vz) - radius[i]
                if d < clearance[r, u]:
                    clearance[r, u] = d
                    index[r, u] = i
