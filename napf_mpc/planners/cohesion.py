"""Cohesion: when some UAVs leave their lanes, the others follow a part of the way, so that the shape is kept.

A UAV that passes an obstacle alone by d metres bends the shape; if all went along, all would leave their
paths. Between the two lies a compromise that needs no search: UAVs read each other's plans, and each is drawn
to its lane plus a share c of the mean m of what all plan to be off theirs. With one of n UAVs d metres off,
the others settle at ``d c / (n - c (n - 1))``, and since c < 1 a formation that has nothing to avoid returns
to its lanes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled
from napf_mpc.planners.references import LARGEST_PULL_M
from napf_mpc.vehicle.plant import plain

Array = NDArray[np.float64]


def drawn_together(
    reference: Array,
    free: Array,
    plans: Array,
    counted: NDArray[np.bool_],
    share: Array | float,
    frame: PathFrame,
) -> Array:
    """References, each moved sideways by a share of the mean that the plans are off their lanes.

    Parameters
    ----------
    reference, free, plans : array, shape (run, uav, N, 12)
        States to track; those on the lanes; and the last plans on the same grid.
    counted : array of bool, shape (run, uav)
        Whose plans count in the mean: those that are followed.
    share : array, shape (run, uav, N), or float
        c, 0 <= c < 1.
    frame : PathFrame
        Of the path.

    Returns
    -------
    array, shape (run, uav, N, 12)
        References; a UAV more than ``LARGEST_PULL_M`` off counts as this far.
    """
    out = reference.copy()
    shares = np.asarray(share, dtype=np.float64)
    if shares.shape != reference.shape[:3]:
        shares = np.broadcast_to(shares, reference.shape[:3])
    _draw(plain(plans), plain(free), counted, plain(frame.axes), plain(shares), out)
    return out


@compiled
def _draw(
    plans: Array, free: Array, counted: NDArray[np.bool_], axes: Array, share: Array, out: Array
) -> None:
    runs, uavs, stages = plans.shape[:3]
    off = np.empty((2, 2))
    for run in range(runs):
        count = 0
        for uav in range(uavs):
            count += counted[run, uav]
        if count == 0:
            continue
        for n in range(stages):
            off[:] = 0.0
            for uav in range(uavs):
                if not counted[run, uav]:
                    continue
                for a in range(2):
                    place = speed = 0.0
                    for b in range(3):
                        place += axes[1 + a, b] * (plans[run, uav, n, 2 * b] - free[run, uav, n, 2 * b])
                        b1 = 2 * b + 1
                        speed += axes[1 + a, b] * (plans[run, uav, n, b1] - free[run, uav, n, b1])
                    off[0, a] += min(max(place, -LARGEST_PULL_M), LARGEST_PULL_M) / count
                    off[1, a] += speed / count
            for uav in range(uavs):
                for b in range(3):
                    for rate in range(2):
                        way = off[rate, 0] * axes[1, b] + off[rate, 1] * axes[2, b]
                        out[run, uav, n, 2 * b + rate] += share[run, uav, n] * way
