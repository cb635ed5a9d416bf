"""One program of the kernel solver from its numbers to its answer and certificate; a loop over many."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.qp import INPUTS, STATES, Array, Index
from napf_mpc.solvers.kernel_active_set import (
    DEPENDENT,
    LIMIT,
    OPENED,
    OPTIMAL,
    STEPS,
    TOUCH,
    WORKING,
    Program,
    WorkingSet,
    ascend,
    backward,
    enter,
    forward,
    lower_bound,
    mark_open,
    reset,
    respond,
    resume,
    row_value,
    sums,
)
from napf_mpc.solvers.kernel_rows import RowTable
from napf_mpc.solvers.kernel_signals import SignalMaps, read_signals, stationarity, sweep

ROUGH, UNUSABLE = 3, 4
"""Further ends of a program: the certificate is not met; a number is not sound."""
EXACT = 1e-9
"""Largest KKT residual of a solved program, over one or its own largest term."""
ROUNDS = 4
"""Corrections of the signals by exact sweeps at most; one is the rule."""
CLOSE = 1e-12
"""A correction of the signals smaller than this, over one or the bound it moves against, ends the rounds."""
SOFTEST = 1e-3
"""A slack whose quadratic price is below this part of its rows' stiffness is solved by proximal steps."""
PROXIMAL_STEPS = 60
"""Proximal steps at most; each leaves at most a thousandth of the error."""
GUESSED = 1e-9
"""A guessed multiplier or slack above this means an active row or an open slack."""


class Room(NamedTuple):
    """Arrays that one program needs beside its working set."""

    linear: Array
    """(N, 12) -Q ref."""
    pull: Array
    """(N, 12)."""
    push: Array
    """(N, 4)."""
    feed: Array
    """(N, 4)."""
    cost: Array
    """(N, 12)."""
    states: Array
    """(N, 12)."""
    inputs: Array
    """(N, 4)."""
    costates: Array
    """(N, 12)."""
    base: Array
    """(13 N,) signals of the optimum without rows."""
    signals: Array
    """(13 N,) signals by the kernel."""
    exact: Array
    """(13 N,) signals by the sweep."""
    force: Array
    """(13 N,)."""
    stages: Array
    """(3, N, 16)."""
    certificate: Array
    """(6,) residual and largest term: primal, dual, complementarity."""
    previous: Array
    """(groups,) last slack of a group that needs proximal steps."""
    extra: Array
    """(groups,) what those add to its quadratic price; zero for all others."""

    @classmethod
    def empty(cls, stages: int, groups: int) -> Room:
        """Room for programs of a size."""
        states, inputs, signals = (stages, STATES), (stages, INPUTS), (STATES + 1) * stages
        shapes: tuple[tuple[int, ...], ...] = (
            states, states, inputs, inputs, states, states, inputs, states,
            (signals,), (signals,), (signals,), (signals,), (3, stages, STATES + INPUTS), (6,),
            (groups + 1,), (groups + 1,),
        )  # fmt: skip
        return cls(*(np.zeros(shape) for shape in shapes))


@compiled
def unconstrained(maps: SignalMaps, room: Room, start: Array, reference: Array) -> bool:
    """Signals of the optimum without rows; return whether they are finite."""
    n = len(reference)
    for k in range(n):
        room.linear[k] = 0.0
        for j in range(STATES):
            for i in range(STATES):
                room.linear[k, i] -= maps.q[k, j, i] * reference[k, j]
    sweep(maps, start, room.linear, room.push, False, room.feed, room.cost, room.states, room.inputs)
    read_signals(maps, room.states, room.inputs, room.base)
    finite = True
    for i in range(len(room.base)):
        finite = finite and np.isfinite(room.base[i])
    for k in range(n):
        for i in range(STATES):
            finite = finite and np.isfinite(room.states[k, i])
    return finite


@compiled
def under_load(maps: SignalMaps, program: Program, work: WorkingSet, room: Room, start: Array) -> None:
    """States, inputs and exact signals under the working set's multipliers."""
    room.force[:] = 0.0
    for j in range(work.counter[WORKING]):
        row, weight = work.row[j], work.side[j] * work.mult[j]
        for d in range(4):
            room.force[program.at[row, d]] += weight * program.coef[row, d]
    room.pull[:] = room.linear
    room.push[:] = 0.0
    for i in range(len(room.force)):
        k, target = maps.stage[i], maps.target[i]
        if target < STATES:
            room.pull[k, target] -= room.force[i]
        else:
            room.push[k, target - STATES] -= room.force[i]
    sweep(maps, start, room.pull, room.push, True, room.feed, room.cost, room.states, room.inputs)
    read_signals(maps, room.states, room.inputs, room.exact)


@compiled
def correct(program: Program, work: WorkingSet, room: Room) -> bool:
    """Move the base by what the kernel's signals are off; return whether it mattered to any row."""
    matters = False
    for j in range(work.counter[WORKING]):
        row, side = work.row[j], work.side[j]
        bound = lower_bound(program, row, side)
        gap = bound - side * row_value(program, row, room.exact) - work.slack[program.group[row]]
        matters = matters or abs(gap) > CLOSE * max(1.0, abs(bound))
    for i in range(len(room.base)):
        shift = room.exact[i] - room.signals[i]
        matters = matters or abs(shift) > CLOSE * max(1.0, abs(room.exact[i]))
        room.base[i] += shift
    return matters


@compiled
def polish(program: Program, work: WorkingSet, room: Room) -> None:
    """Multipliers with which the members meet their bounds after the base has moved."""
    n = work.counter[WORKING]
    for j in range(n):
        row, side = work.row[j], work.side[j]
        bound = lower_bound(program, row, side) - work.slack[program.group[row]]
        work.step[j] = bound - side * row_value(program, row, room.exact)
    forward(work, n, work.step)
    backward(work, n, work.step)
    for j in range(n):
        work.mult[j] = max(0.0, work.mult[j] + work.step[j])


@compiled
def solve_rows(
    maps: SignalMaps, program: Program, work: WorkingSet, room: Room, start: Array, limit: int
) -> int:
    """Optimum with rows from the working set as it is; states and inputs are in the room."""
    status = LIMIT
    for _ in range(ROUNDS):
        status = ascend(program, maps, work, room.base, room.signals, limit)
        if status != OPTIMAL:
            return status
        under_load(maps, program, work, room, start)
        if not correct(program, work, room):
            break
        polish(program, work, room)
    else:
        sums(program, work)
        under_load(maps, program, work, room, start)
    return status


@compiled
def proximal(program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room) -> bool:
    """Give slacks with next to no quadratic price one of their own; return whether there are any."""
    any_soft, stiffest = False, 0.0
    for i in range(len(room.base)):
        stiffest = max(stiffest, maps.kernel[i, i])
    for g in range(table.groups[u]):
        room.previous[g], room.extra[g] = 0.0, 0.0
        work.w1[g], work.w2[g] = table.w1[u, g], table.w2[u, g]
    for r in range(program.count):
        g = program.group[r]
        if g == table.w1.shape[1] - 1:
            continue
        size = 0.0
        for d in range(4):
            size += program.coef[r, d] ** 2
        # An upper bound of the row's own Gram entry first: it is cheap.
        if table.w2[u, g] * size * 4.0 * stiffest < SOFTEST:
            give = 0.0
            for d in range(4):
                for e in range(4):
                    pair = maps.kernel[program.at[r, d], program.at[r, e]]
                    give += program.coef[r, d] * program.coef[r, e] * pair
            least = SOFTEST / give if give > 0.0 else 1.0
            room.extra[g] = max(room.extra[g], least - table.w2[u, g])
            any_soft = any_soft or room.extra[g] > 0.0
    for g in range(table.groups[u]):
        work.w2[g] = table.w2[u, g] + room.extra[g]
    return any_soft


@compiled
def guess(
    program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, z: Array, y: Array
) -> bool:
    """Take the rows that push in a guess as members, and its slacks as open; return whether it is finite."""
    for i in range(len(z)):
        if not np.isfinite(z[i]):
            return False
    for i in range(len(y)):
        if not np.isfinite(y[i]):
            return False
    for g in range(table.groups[u]):
        if work.w1[g] > 0.0 and z[table.slack_z[u, g]] > GUESSED:
            mark_open(work, g)
    for r in range(program.count):
        for side in (1.0, -1.0):
            bound = lower_bound(program, r, side)
            pushing = -y[table.y_low[u, r]] if side > 0.0 else y[table.y_high[u, r]]
            if bound > -np.inf and pushing > GUESSED and work.counter[WORKING] < len(work.row) - 2:
                enter(program, maps, work, r, side)
                work.member[r] += 1 if side > 0.0 else 2
                work.counter[WORKING] += 1
    return True


@compiled
def again(program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room) -> bool:
    """Take a proximal step: prices from the slacks reached; return whether they had moved."""
    moved = False
    for g in range(table.groups[u]):
        if room.extra[g] > 0.0:
            reached = max(0.0, work.slack[g])
            off = room.extra[g] * abs(reached - room.previous[g])
            moved = moved or off > CLOSE * max(1.0, table.w1[u, g])
            room.previous[g] = reached
    if not moved:
        return False
    count = work.counter[WORKING]
    rows, sides = work.row[:count].copy(), work.side[:count].copy()
    was_open = work.is_open.copy()
    for g in range(table.groups[u]):
        work.w1[g] = table.w1[u, g] - room.extra[g] * room.previous[g]
    reset(work, program.count, table.groups[u])
    for g in range(table.groups[u]):
        if was_open[g] and not work.is_open[g]:
            mark_open(work, g)
    for j in range(count):
        enter(program, maps, work, rows[j], sides[j])
        work.member[rows[j]] += 1 if sides[j] > 0.0 else 2
        work.counter[WORKING] += 1
    resume(program, work, room.base)
    return True


@compiled
def certify(
    maps: SignalMaps, program: Program, table: RowTable, u: int, work: WorkingSet, room: Room,
    start: Array, z: Array, y: Array,
) -> float:  # fmt: skip
    """Write slacks and multipliers, and residuals of the original program; return the largest relative one."""
    out = room.certificate
    stationarity(
        maps, start, room.states, room.inputs, room.cost, room.linear, room.force,
        room.costates, room.stages, out,
    )  # fmt: skip
    n = len(room.states)
    for k in range(n):
        for i in range(STATES):
            z[k * STATES + i] = room.states[k, i]
            y[k * STATES + i] = room.costates[k, i]
        for i in range(INPUTS):
            z[n * STATES + k * INPUTS + i] = room.inputs[k, i]
    for g in range(table.groups[u]):
        slack = max(0.0, work.slack[g])
        w1, w2, total = table.w1[u, g], table.w2[u, g], work.total[g]
        mult = 0.0 if work.is_open[g] and slack > 0.0 else max(0.0, w1 + w2 * slack - total)
        z[table.slack_z[u, g]], y[table.slack_y[u, g]] = slack, -mult
        out[2] = max(out[2], abs(w1 + w2 * slack - total - mult))
        out[3] = max(out[3], w1, w2 * slack, total)
        out[4] = max(out[4], mult * slack)
        work.slack[g] = slack
    for r in range(program.count):
        value, slack = row_value(program, r, room.exact), work.slack[program.group[r]]
        low, high = program.low[r], program.high[r]
        out[0] = max(out[0], low - value - slack, value - high - slack)
        out[1] = max(out[1], abs(value))
    for j in range(work.counter[WORKING]):
        row, side, mult = work.row[j], work.side[j], work.mult[j]
        bound = lower_bound(program, row, side)
        gap = bound - side * row_value(program, row, room.exact) - work.slack[program.group[row]]
        out[4] = max(out[4], mult * abs(gap))
        out[5] = max(out[5], mult * abs(bound))
        if side > 0.0:
            y[table.y_low[u, row]] -= mult
        else:
            y[table.y_high[u, row]] += mult
    worst = 0.0
    for e in range(0, 6, 2):
        relative = out[e] / max(1.0, out[e + 1])
        # NaN would lose the comparison.
        worst = max(worst, relative) if relative < np.inf else np.inf
    return worst


@compiled
def clear_multipliers(program: Program, table: RowTable, u: int, y: Array) -> None:
    """Zero the multipliers of all rows before they are written again."""
    for r in range(program.count):
        y[table.y_low[u, r]], y[table.y_high[u, r]] = 0.0, 0.0


@compiled
def solve_one(
    maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room, start: Array, reference: Array,
    warm: bool, guess_z: Array, guess_y: Array, limit: int, z: Array, y: Array,
) -> int:  # fmt: skip
    """Solve program u of a table; return how it ended."""
    if not table.usable[u] or not unconstrained(maps, room, start, reference):
        return UNUSABLE
    program = Program(
        table.coef[u], table.at[u], table.low[u], table.high[u], table.group[u], table.rows[u]
    )
    work.counter[STEPS] = 0
    for attempt in range(2):
        if attempt == 1:
            # The corrections of the first attempt go with its multipliers.
            unconstrained(maps, room, start, reference)
        softest = proximal(program, maps, table, u, work, room)
        reset(work, program.count, table.groups[u])
        guessed = warm and attempt == 0 and guess(program, maps, table, u, work, guess_z, guess_y)
        if guessed:
            resume(program, work, room.base)
        status = solve_rows(maps, program, work, room, start, limit)
        if softest:
            for _ in range(PROXIMAL_STEPS):
                if status != OPTIMAL or not again(program, maps, table, u, work, room):
                    break
                status = solve_rows(maps, program, work, room, start, limit)
        if status == OPTIMAL:
            if attempt == 1:
                clear_multipliers(program, table, u, y)
            if certify(maps, program, table, u, work, room, start, z, y) <= EXACT:
                return OPTIMAL
            status = ROUGH
        if not guessed or status == LIMIT:
            return status
    return status


@compiled
def solve_programs(
    maps: SignalMaps, table: RowTable, programs: Index, work: WorkingSet, room: Room,
    initial: Array, reference: Array, warm: bool, guess_z: Array, guess_y: Array, limit: int,
    z: Array, y: Array, residuals: Array, ends: NDArray[np.int64], steps: Index,
) -> None:  # fmt: skip
    """Solve all programs of a table, each by itself.

    Parameters
    ----------
    maps : SignalMaps
        Model.
    table : RowTable
        Rows of the programs.
    programs : array of int, shape (programs of the table,)
        Their places in the batch.
    work, room
        Room to work in.
    initial, reference : array, shapes (batch, 12) and (batch, N, 12)
        As in :class:`~napf_mpc.qp.HorizonQp`.
    warm : bool
        Whether there are guesses.
    guess_z, guess_y : array, shapes (batch, n) and (batch, m)
        Guesses.
    limit : int
        Steps of a program at most.
    z, y : array, shapes (batch, n) and (batch, m)
        Where answers go.
    residuals : array, shape (batch, 3)
        Primal, dual, complementarity.
    ends, steps : array of int, shape (batch,)
        How each program ended, and after how many steps.
    """
    for u in range(len(programs)):
        i = programs[u]
        g = i if warm else 0
        ends[i] = solve_one(
            maps, table, u, work, room, initial[i], reference[i], warm, guess_z[g], guess_y[g], limit, z[i], y[i]
        )
        if ends[i] != UNUSABLE:
            steps[i] = work.counter[STEPS]
        if ends[i] == OPTIMAL or ends[i] == ROUGH:
            for e in range(3):
                residuals[i, e] = room.certificate[2 * e]
        else:
            z[i], y[i] = np.nan, np.nan
