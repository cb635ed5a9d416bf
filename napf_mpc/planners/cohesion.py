"""Cohesion: when some UAVs leave their lanes, the others follow a part of the way, so that the shape is kept.

A UAV that passes an obstacle alone by d metres bends the shape; if all went along, all would leave their
paths. Between the two lies a compromise that needs no search: UAVs read each other's plans, and each is drawn
to its lane plus a share c of the mean m of what all plan to be off theirs. With one of n UAVs d metres off,
the others settle at ``d c / (n - c (n - 1))``, and since c < 1 a formation that has nothing to avoid returns
to its lanes.

A UAV that has to pass something has a way of its own. It is drawn by the part to which that way is loose; or,
where room has been looked for, goes along with those that are farther out in its direction as far as that is
free, and aside by a part, too: what is passed lies inwards.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.planners.references import LARGEST_PULL_M
from napf_mpc.planners.taut import SAME_M
from napf_mpc.vehicle.plant import plain

Array = NDArray[np.float64]
ASIDE_PART = 0.4
"""Of what is not loose: part by which a UAV with all the room that was looked for is drawn aside."""


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
        References; a plan more than ``LARGEST_PULL_M`` off, left or up, counts as this far.
    """
    out = reference.copy()
    shares = np.asarray(share, dtype=np.float64)
    if shares.shape != reference.shape[:3]:
        shares = np.broadcast_to(shares, reference.shape[:3])
    _draw(plain(plans), plain(free), counted, plain(frame.axes), plain(shares), out)
    return out


def gone_along(
    reference: Array,
    free: Array,
    plans: Array,
    counted: NDArray[np.bool_],
    share: float,
    frame: PathFrame,
    loose: Array,
    room: Array,
    room_m: float,
) -> Array:
    """References, moved sideways like those of :func:`drawn_together`, but outwards as far as there is room.

    With own the offset of the reference and m the mean, both across the path: in the direction of own a UAV
    goes to c m where that is farther out than own, up to its room, and beyond by its looseness; inwards it is
    drawn by its looseness, and not at all if c m is between its lane and own. Aside it is drawn by its
    looseness, and of the rest by ``ASIDE_PART``, in proportion to its room.

    Parameters
    ----------
    reference, free, plans, counted, frame
        As in :func:`drawn_together`.
    share : float
        c, 0 <= c < 1.
    loose : array, shape (run, uav, N)
        Part 0 to 1 of the way to the lane that is free.
    room : array, shape (run, uav, N)
        Distance from the lane up to which own's direction is free; less than own means none beyond it [m].
    room_m : float
        How far room was looked for [m].

    Returns
    -------
    array, shape (run, uav, N, 12)
        References.
    """
    out = reference.copy()
    _go(
        plain(plans), plain(free), counted, plain(frame.axes), share, plain(loose), plain(room), room_m,
        plain(reference), out,
    )  # fmt: skip
    return out


@compiled
def _go(
    plans: Array, free: Array, counted: NDArray[np.bool_], axes: Array, share: float, loose: Array,
    room: Array, room_m: float, reference: Array, out: Array,
) -> None:  # fmt: skip
    runs, uavs, stages = plans.shape[:3]
    off, one, own, way = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for run in range(runs):
        count = _followed(counted, run)
        if count == 0:
            continue
        for n in range(stages):
            _mean(plans, free, counted, axes, run, n, count, one, off)
            off *= share
            for uav in range(uavs):
                _aside(reference[run, uav, n], free[run, uav, n], axes, own)
                _along_with(off, own, loose[run, uav, n], room[run, uav, n], room_m, way)
                for b in range(3):
                    for rate in range(2):
                        moved = way[rate, 0] * axes[1, b] + way[rate, 1] * axes[2, b]
                        out[run, uav, n, 2 * b + rate] += moved


@compiled_bare
def _along_with(off: Array, own: Array, loose: float, room: float, room_m: float, way: Array) -> None:
    """Write what is added to an own way, places (row 0) and velocities, to go along with c m."""
    size = math.sqrt(own[0, 0] * own[0, 0] + own[0, 1] * own[0, 1])
    if size < SAME_M:
        for rate in range(2):
            for a in range(2):
                way[rate, a] = loose * off[rate, a]
        return
    x, y = own[0, 0] / size, own[0, 1] / size
    outward = x * off[0, 0] + y * off[0, 1]
    part = 0.0
    if outward > size:
        known = min(max(room, size), outward)
        part = (known - size + loose * (outward - known)) / (outward - size)
    spare = min(max(room - size, 0.0) / max(room_m - size, 0.1), 1.0)
    beside = loose + (1.0 - loose) * ASIDE_PART * spare
    for rate in range(2):
        theirs = x * off[rate, 0] + y * off[rate, 1]
        mine = x * own[rate, 0] + y * own[rate, 1]
        radial = loose * theirs if outward <= 0.0 else part * (theirs - mine)
        aside = beside * (x * off[rate, 1] - y * off[rate, 0])
        way[rate, 0] = radial * x - aside * y
        way[rate, 1] = radial * y + aside * x


@compiled_bare
def _aside(state: Array, lane: Array, axes: Array, aside: Array) -> None:
    """Write how far (row 0) and how fast (row 1) a state is off its lane, left and up."""
    for a in range(2):
        place = speed = 0.0
        for b in range(3):
            place += axes[1 + a, b] * (state[2 * b] - lane[2 * b])
            b1 = 2 * b + 1
            speed += axes[1 + a, b] * (state[b1] - lane[b1])
        aside[0, a], aside[1, a] = place, speed


@compiled_bare
def _followed(counted: NDArray[np.bool_], run: int) -> int:
    """Number of UAVs of a run whose plans count."""
    count = 0
    for uav in range(counted.shape[1]):
        count += counted[run, uav]
    return count


@compiled_bare
def _mean(
    plans: Array, free: Array, counted: NDArray[np.bool_], axes: Array, run: int, n: int, count: int,
    one: Array, off: Array,
) -> None:  # fmt: skip
    """Write the mean of how far and how fast the plans that count are off; ``one`` is to work in."""
    off[:] = 0.0
    for uav in range(plans.shape[1]):
        if not counted[run, uav]:
            continue
        _aside(plans[run, uav, n], free[run, uav, n], axes, one)
        for a in range(2):
            off[0, a] += min(max(one[0, a], -LARGEST_PULL_M), LARGEST_PULL_M) / count
            off[1, a] += one[1, a] / count


@compiled
def _draw(
    plans: Array, free: Array, counted: NDArray[np.bool_], axes: Array, share: Array, out: Array
) -> None:
    runs, uavs, stages = plans.shape[:3]
    off, one = np.empty((2, 2)), np.empty((2, 2))
    for run in range(runs):
        count = _followed(counted, run)
        if count == 0:
            continue
        for n in range(stages):
            _mean(plans, free, counted, axes, run, n, count, one, off)
            for uav in range(uavs):
                for b in range(3):
                    for rate in range(2):
                        way = off[rate, 0] * axes[1, b] + off[rate, 1] * axes[2, b]
                        out[run, uav, n, 2 * b + rate] += share[run, uav, n] * way
