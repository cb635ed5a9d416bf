"""Compiled passes over the UAVs of a control step: each replaces a chain of small array operations.

A formation of four is so few numbers that every array operation costs more than its arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.planners.descent import DESCENT_MPS
from napf_mpc.planners.fallback import Action
from napf_mpc.planners.planner import Reason
from napf_mpc.qp import STATES
from napf_mpc.solvers.acceptance import Refusal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Codes = NDArray[np.int8]

# Codes as plain numbers, for the compiled loops.
_ACCEPTED, _PLAN = int(Refusal.NONE), int(Action.PLAN)
_TAIL, _DESCEND = int(Action.TAIL), int(Action.DESCEND)
_NO_REASON, _NAVIGATION, _SOLVER = int(Reason.NONE), int(Reason.NAVIGATION), int(Reason.SOLVER)


@compiled_bare
def everybody(mask: Mask) -> bool:
    """Whether a mask (run, uav) is set for all."""
    for run in range(mask.shape[0]):
        for uav in range(mask.shape[1]):
            if not mask[run, uav]:
                return False
    return True


@compiled_bare
def anybody(mask: Mask, some: Mask) -> None:
    """Write whether a mask (run, uav) is set for any UAV of each run (run,)."""
    for run in range(mask.shape[0]):
        found = False
        for uav in range(mask.shape[1]):
            found = found or mask[run, uav]
        some[run] = found


@compiled_bare
def keep_place(position: Array, placed: Mask, anchor: Array) -> None:
    """Write positions (run, uav, 3) over the last known ones, where there is a place."""
    for run in range(anchor.shape[0]):
        for uav in range(anchor.shape[1]):
            if placed[run, uav]:
                for a in range(3):
                    anchor[run, uav, a] = position[run, uav, a]


@compiled_bare
def report(
    position: Array, velocity: Array, attitude: Array, rates: Array, trusted: Mask, anchor: Array,
    yaw_rad: float, state: Array,
) -> None:  # fmt: skip
    """Write states (run, uav, 12) as reported (run, uav, 3); who is not trusted stands at its anchor."""
    for run in range(state.shape[0]):
        for uav in range(state.shape[1]):
            for a in range(3):
                known = trusted[run, uav]
                state[run, uav, 2 * a] = position[run, uav, a] if known else anchor[run, uav, a]
                state[run, uav, 2 * a + 1] = velocity[run, uav, a] if known else 0.0
                state[run, uav, 6 + 2 * a] = attitude[run, uav, a] if known else (yaw_rad if a == 2 else 0.0)
                state[run, uav, 7 + 2 * a] = rates[run, uav, a] if known else 0.0


@compiled_bare
def follow(states: Array, now: Array, moved: Array) -> None:
    """Write plans (run, uav, N, 12) moved to where UAVs are now (run, uav, 12).

    The first of the states (run, uav, N + 1, 12) is where each plan meant to be now.
    """
    for run in range(moved.shape[0]):
        for uav in range(moved.shape[1]):
            for k in range(moved.shape[2]):
                for i in range(STATES):
                    moved[run, uav, k, i] = states[run, uav, 1 + k, i]
                for i in range(0, 6, 2):
                    moved[run, uav, k, i] += now[run, uav, i] - states[run, uav, 0, i]


@compiled_bare
def move(states: Array, by: Array, sign: float, out: Array) -> None:
    """Write states (run, uav, N, 12) with positions moved there or back, by (run, uav, 3) at all stages."""
    for run in range(states.shape[0]):
        for uav in range(states.shape[1]):
            for k in range(states.shape[2]):
                for i in range(STATES):
                    out[run, uav, k, i] = states[run, uav, k, i]
                for axis in range(3):
                    out[run, uav, k, 2 * axis] += sign * by[run, uav, axis]


@compiled_bare
def take_way(
    states: Array, way: Array, now: Array, origin: Array, along: Array, least_m: float, part: float,
    out: Array,
) -> None:  # fmt: skip
    """Write plans (run, uav, N, 12), or the guide's way for those that are stuck.

    Parameters
    ----------
    states, way : array, shape (run, uav, N, 12)
        Last plans, and where the guide leads.
    now : array, shape (run, uav, 12)
        States now.
    origin, along : array, shape (3,)
        Of the path.
    least_m, part : float
        A plan that gets less than this part of its way, if that is farther than this, is stuck.
    out : array, shape (run, uav, N, 12)
        Out.
    """
    last = states.shape[2] - 1
    for run in range(out.shape[0]):
        for uav in range(out.shape[1]):
            here = _along(now[run, uav], origin, along)
            asked = _along(way[run, uav, last], origin, along) - here
            planned = _along(states[run, uav, last], origin, along) - here
            stuck = asked > least_m and planned < part * asked
            for k in range(last + 1):
                for i in range(STATES):
                    out[run, uav, k, i] = way[run, uav, k, i] if stuck else states[run, uav, k, i]


@compiled_bare
def _along(state: Array, origin: Array, along: Array) -> float:
    """Along-track coordinate of a state (12,) [m]."""
    x, y, z = state[0] - origin[0], state[2] - origin[1], state[4] - origin[2]
    return float(x * along[0] + y * along[1] + z * along[2])


@compiled_bare
def share(factor: Array, now: Array, ahead: Array, trusted: Mask, shared: Array) -> None:
    """Write what is left of factors (run, uav, 3, rank) where an axis' variance is least; 0 without trust.

    Covariances come as (run, uav, 6, 6) of now and (run, uav, N, 3, 3) of a plan's stages.
    """
    for run in range(shared.shape[0]):
        for uav in range(shared.shape[1]):
            for a in range(3):
                least, variance, part = np.inf, now[run, uav, a, a], 0.0
                for k in range(ahead.shape[2]):
                    least = min(least, ahead[run, uav, k, a, a])
                if trusted[run, uav] and variance > 0.0:
                    part = math.sqrt(min(max(least / variance, 0.0), 1.0))
                for c in range(shared.shape[3]):
                    shared[run, uav, a, c] = factor[run, uav, a, c] * part if trusted[run, uav] else 0.0


@compiled_bare
def places(states: Array, position: Array, velocity: Array) -> None:
    """Write positions and velocities (run, uav, N, 3) of states (run, uav, N, 12)."""
    for run in range(states.shape[0]):
        for uav in range(states.shape[1]):
            for k in range(states.shape[2]):
                for a in range(3):
                    position[run, uav, k, a] = states[run, uav, k, 2 * a]
                    velocity[run, uav, k, a] = states[run, uav, k, 2 * a + 1]


@compiled_bare
def accept(
    refused: Codes, state: Array, trusted: Mask, late: bool, upset_rad: float, upset: Mask, accepted: Mask
) -> bool:
    """Write who is upset, and whose answer is flown; return whether all are."""
    everybody = True
    for run in range(accepted.shape[0]):
        for uav in range(accepted.shape[1]):
            roll, pitch = abs(state[run, uav, 6]), abs(state[run, uav, 8])
            fallen = roll > upset_rad or pitch > upset_rad
            flown = refused[run, uav] == _ACCEPTED and trusted[run, uav] and not fallen and not late
            upset[run, uav], accepted[run, uav] = fallen, flown
            everybody = everybody and flown
    return everybody


@compiled_bare
def command(
    action: Codes, trusted: Mask, initial: Array, anchor: Array, waiting: Codes, vectors: Array,
    planned: Mask, holding: Mask, reason: Codes,
) -> None:  # fmt: skip
    """Write position, velocity and direction (3, run, uav, 3), who follows a plan, who holds, and why.

    Why a guide lets UAVs wait comes as codes (run, uav); the larger code tells.
    """
    for run in range(action.shape[0]):
        for uav in range(action.shape[1]):
            code = action[run, uav]
            follows = code <= _TAIL
            planned[run, uav] = follows
            own = _NO_REASON if follows else _SOLVER if trusted[run, uav] else _NAVIGATION
            reason[run, uav] = max(own, waiting[run, uav])
            holding[run, uav] = reason[run, uav] > _NO_REASON
            for a in range(3):
                down = -DESCENT_MPS if code == _DESCEND and a == 2 else 0.0
                vectors[0, run, uav, a] = initial[run, uav, 2 * a] if follows else anchor[run, uav, a]
                vectors[1, run, uav, a] = initial[run, uav, 2 * a + 1] if follows else down
                vectors[2, run, uav, a] = 0.0 if follows else down


@compiled_bare
def count_solves(
    status: Codes, column: NDArray[np.int64], iterations: NDArray[np.int64], trusted: Mask, first: int,
    counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Add the answers of a solver to the counts (column, run) of a tally; parameters as in :func:`count`."""
    for run in range(status.shape[0]):
        for uav in range(status.shape[1]):
            if trusted[run, uav]:
                where = column[status[run, uav]]
                if where >= 0:
                    counts[where, run] += 1
                counts[first, run] += max(iterations[run, uav], 0)


@compiled_bare
def count(
    status: Codes, column: NDArray[np.int64], iterations: NDArray[np.int64], action: Codes, accepted: Mask,
    trusted: Mask, airborne: Mask, slack: Array, first: int, counts: NDArray[np.int64], largest: Array,
) -> None:  # fmt: skip
    """Add a step to the counts (column, run) of a tally, and to its largest slacks (run,).

    Parameters
    ----------
    status, action : array of int8, shape (run, uav)
        Of the solver, and what is flown.
    column : array of int, shape (status,)
        Column of each status; -1 for one that does not count.
    iterations : array of int, shape (run, uav)
        Of the solver.
    accepted, trusted, airborne : array of bool, shape (run, uav)
        Whose answer is flown, whose navigation is trusted, who flies.
    slack : array, shape (run, uav)
        NaN for none [m].
    first : int
        Column of the iterations, before those of refused answers and of the rungs of the ladder.
    """
    count_solves(status, column, iterations, trusted, first, counts)
    for run in range(status.shape[0]):
        for uav in range(status.shape[1]):
            code = action[run, uav]
            if trusted[run, uav]:
                counts[first + 1, run] += not accepted[run, uav]
            if airborne[run, uav] and code > _PLAN:
                counts[first + 1 + code, run] += 1
            if not slack[run, uav] <= largest[run] and slack[run, uav] == slack[run, uav]:
                largest[run] = slack[run, uav]
