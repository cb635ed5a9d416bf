"""One program of the kernel solver from its numbers to its answer and certificate; a loop over many."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.qp import INPUTS, STATES, Array, Index
from napf_mpc.solvers.kernel_active_set import (
    LIMIT,
    OPTIMAL,
    STEPS,
    WORKING,
    Program,
    WorkingSet,
    ascend,
    enter,
    lower_bound,
    mark_open,
    polish,
    reset,
    resume,
    row_value,
    sums,
    working_set,
)
from napf_mpc.solvers.kernel_rows import (
    GROUP,
    GROUPS,
    HIGH,
    LOW,
    ROWS,
    USABLE,
    WIDTH,
    Y_HIGH,
    Y_LOW,
    RowTable,
)
from napf_mpc.solvers.kernel_signals import Q, SignalMaps, read_signals, stationarity, sweep

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
    loads: Array
    """(N, 16)."""
    weighed: Array
    """(N, 16)."""
    carried: Array
    """(N, 16)."""
    certificate: Array
    """(6,) residual and largest term: primal, dual, complementarity."""
    previous: Array
    """(groups,) last slack of a group that needs proximal steps."""
    extra: Array
    """(groups,) what those add to its quadratic price; zero for all others."""


@compiled
def make_room(stages: int, groups: int) -> Room:
    """Room for programs of a size."""
    signals, both = (STATES + 1) * stages, STATES + INPUTS
    return Room(
        np.zeros((stages, STATES)), np.zeros((stages, STATES)), np.zeros((stages, INPUTS)),
        np.zeros((stages, INPUTS)), np.zeros((stages, STATES)), np.zeros((stages, STATES)),
        np.zeros((stages, INPUTS)), np.zeros((stages, STATES)),
        np.zeros(signals), np.zeros(signals), np.zeros(signals), np.zeros(signals),
        np.zeros((stages, both)), np.zeros((stages, both)), np.zeros((stages, both)),
        np.zeros(6), np.zeros(groups), np.zeros(groups),
    )  # fmt: skip


@compiled
def unconstrained(maps: SignalMaps, room: Room, starts: Array, references: Array, at: int) -> bool:
    """Signals of the optimum without rows; return whether they are finite."""
    n = len(room.states)
    for k in range(n):
        for i in range(STATES):
            room.linear[k, i] = 0.0
        for e in range(maps.begins[Q, k], maps.begins[Q, k + 1]):
            room.linear[k, maps.row[e]] -= maps.value[e] * references[at, k, maps.column[e]]
    sweep(maps, starts, at, room.linear, room.push, False, room.feed, room.cost, room.states, room.inputs)
    read_signals(maps, room.states, room.inputs, room.base)
    finite = True
    for i in range(len(room.base)):
        finite = finite and np.isfinite(room.base[i])
    for k in range(n):
        for i in range(STATES):
            finite = finite and np.isfinite(room.states[k, i])
    return finite


@compiled
def under_load(
    maps: SignalMaps, program: Program, work: WorkingSet, room: Room, starts: Array, at: int
) -> None:
    """States, inputs and exact signals under the working set's multipliers."""
    for i in range(len(room.force)):
        room.force[i] = 0.0
    for j in range(work.counter[WORKING]):
        row, weight = work.row[j], work.side[j] * work.mult[j]
        for d in range(WIDTH):
            room.force[program.place[program.u, row, d]] += weight * program.number[program.u, row, d]
    for k in range(len(room.pull)):
        for i in range(STATES):
            room.pull[k, i] = room.linear[k, i]
        for i in range(INPUTS):
            room.push[k, i] = 0.0
    for i in range(len(room.force)):
        k, target = maps.stage[i], maps.target[i]
        if target < STATES:
            room.pull[k, target] -= room.force[i]
        else:
            room.push[k, target - STATES] -= room.force[i]
    sweep(maps, starts, at, room.pull, room.push, True, room.feed, room.cost, room.states, room.inputs)
    read_signals(maps, room.states, room.inputs, room.exact)


@compiled
def correct(program: Program, work: WorkingSet, room: Room) -> bool:
    """Move the base by what the kernel's signals are off; return whether it mattered to any row."""
    matters = False
    for j in range(work.counter[WORKING]):
        row, side = work.row[j], work.side[j]
        bound = lower_bound(program, row, side)
        gap = (
            bound
            - side * row_value(program, row, room.exact)
            - work.slack[program.place[program.u, row, GROUP]]
        )
        matters = matters or abs(gap) > CLOSE * max(1.0, abs(bound))
    for i in range(len(room.base)):
        shift = room.exact[i] - room.signals[i]
        matters = matters or abs(shift) > CLOSE * max(1.0, abs(room.exact[i]))
        room.base[i] += shift
    return matters


@compiled
def solve_rows(
    maps: SignalMaps, program: Program, work: WorkingSet, room: Room, starts: Array, at: int, limit: int
) -> int:
    """Optimum with rows from the working set as it is; states and inputs are in the room."""
    status = LIMIT
    for _ in range(ROUNDS):
        status = ascend(program, maps, work, room.base, room.signals, limit)
        if status != OPTIMAL:
            return status
        under_load(maps, program, work, room, starts, at)
        if not correct(program, work, room):
            break
        polish(program, work, room.exact)
    else:
        sums(program, work)
        under_load(maps, program, work, room, starts, at)
    return status


@compiled
def proximal(
    program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room
) -> bool:
    """Give slacks with next to no quadratic price one of their own; return whether there are any."""
    any_soft = False
    for g in range(table.size[u, GROUPS]):
        room.previous[g], room.extra[g] = 0.0, 0.0
        work.w1[g], work.w2[g] = table.price[u, g, 0], table.price[u, g, 1]
    for r in range(program.rows):
        g = program.place[program.u, r, GROUP]
        if g == table.price.shape[1] - 1:
            continue
        size = 0.0
        for d in range(WIDTH):
            size += program.number[program.u, r, d] ** 2
        # An upper bound of the row's own Gram entry first: it is cheap.
        if table.price[u, g, 1] * size * 4.0 * maps.softest < SOFTEST:
            give = 0.0
            for d in range(WIDTH):
                for e in range(WIDTH):
                    pair = maps.kernel[program.place[program.u, r, d], program.place[program.u, r, e]]
                    give += program.number[program.u, r, d] * program.number[program.u, r, e] * pair
            least = SOFTEST / give if give > 0.0 else 1.0
            room.extra[g] = max(room.extra[g], least - table.price[u, g, 1])
            any_soft = any_soft or room.extra[g] > 0.0
    for g in range(table.size[u, GROUPS]):
        work.w2[g] = table.price[u, g, 1] + room.extra[g]
    return any_soft


@compiled
def guess(
    program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, z: Array, y: Array, at: int
) -> bool:
    """Take the rows that push in a guess as members, and its slacks as open; return whether it is finite."""
    for i in range(z.shape[1]):
        if not np.isfinite(z[at, i]):
            return False
    for i in range(y.shape[1]):
        if not np.isfinite(y[at, i]):
            return False
    for g in range(table.size[u, GROUPS]):
        if work.w1[g] > 0.0 and z[at, table.put[u, g, 0]] > GUESSED:
            mark_open(work, g)
    for r in range(program.rows):
        for side in (1.0, -1.0):
            bound = lower_bound(program, r, side)
            pushing = -y[at, table.place[u, r, Y_LOW]] if side > 0.0 else y[at, table.place[u, r, Y_HIGH]]
            if bound > -np.inf and pushing > GUESSED and work.counter[WORKING] < len(work.row) - 2:
                enter(program, maps, work, r, side)
                work.member[r] += 1 if side > 0.0 else 2
                work.counter[WORKING] += 1
    return True


@compiled
def again(program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room) -> bool:
    """Take a proximal step: prices from the slacks reached; return whether they had moved."""
    moved = False
    for g in range(table.size[u, GROUPS]):
        if room.extra[g] > 0.0:
            reached = max(0.0, work.slack[g])
            off = room.extra[g] * abs(reached - room.previous[g])
            moved = moved or off > CLOSE * max(1.0, table.price[u, g, 0])
            room.previous[g] = reached
    if not moved:
        return False
    count = work.counter[WORKING]
    rows, sides = work.row[:count].copy(), work.side[:count].copy()
    was_open = work.is_open.copy()
    for g in range(table.size[u, GROUPS]):
        work.w1[g] = table.price[u, g, 0] - room.extra[g] * room.previous[g]
    reset(work, program.rows, table.size[u, GROUPS])
    for g in range(table.size[u, GROUPS]):
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
    starts: Array, at: int, z: Array, y: Array,
) -> float:  # fmt: skip
    """Write slacks, multipliers and residuals of the original program; return the largest relative one."""
    out = room.certificate
    stationarity(
        maps, starts, at, room.states, room.inputs, room.cost, room.linear, room.force,
        room.costates, room.loads, room.weighed, room.carried, out,
    )  # fmt: skip
    n = len(room.states)
    for k in range(n):
        for i in range(STATES):
            z[at, k * STATES + i] = room.states[k, i]
            y[at, k * STATES + i] = room.costates[k, i]
        for i in range(INPUTS):
            z[at, n * STATES + k * INPUTS + i] = room.inputs[k, i]
    for g in range(table.size[u, GROUPS]):
        slack = max(0.0, work.slack[g])
        w1, w2, total = table.price[u, g, 0], table.price[u, g, 1], work.total[g]
        mult = 0.0 if work.is_open[g] and slack > 0.0 else max(0.0, w1 + w2 * slack - total)
        z[at, table.put[u, g, 0]], y[at, table.put[u, g, 1]] = slack, -mult
        out[2] = max(out[2], abs(w1 + w2 * slack - total - mult))
        out[3] = max(out[3], w1, w2 * slack, total)
        out[4] = max(out[4], mult * slack)
        work.slack[g] = slack
    for r in range(program.rows):
        value, slack = row_value(program, r, room.exact), work.slack[program.place[program.u, r, GROUP]]
        low, high = program.number[program.u, r, LOW], program.number[program.u, r, HIGH]
        out[0] = max(out[0], low - value - slack, value - high - slack)
        out[1] = max(out[1], abs(value))
    for j in range(work.counter[WORKING]):
        row, side, mult = work.row[j], work.side[j], work.mult[j]
        bound = lower_bound(program, row, side)
        gap = (
            bound
            - side * row_value(program, row, room.exact)
            - work.slack[program.place[program.u, row, GROUP]]
        )
        out[4] = max(out[4], mult * abs(gap))
        out[5] = max(out[5], mult * abs(bound))
        if side > 0.0:
            y[at, table.place[u, row, Y_LOW]] -= mult
        else:
            y[at, table.place[u, row, Y_HIGH]] += mult
    worst = 0.0
    for e in range(0, 6, 2):
        relative = out[e] / max(1.0, out[e + 1])
        # NaN would lose the comparison.
        worst = max(worst, relative) if relative < np.inf else np.inf
    return worst


@compiled
def clear_multipliers(program: Program, table: RowTable, u: int, y: Array, at: int) -> None:
    """Zero the multipliers of all rows before they are written again."""
    for r in range(program.rows):
        y[at, table.place[u, r, Y_LOW]], y[at, table.place[u, r, Y_HIGH]] = 0.0, 0.0


@compiled
def solve_one(
    maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room, starts: Array,
    references: Array, at: int, warm: bool, guess_z: Array, guess_y: Array, guess_at: int,
    limit: int, z: Array, y: Array,
) -> int:  # fmt: skip
    """Solve program u of a table; return how it ended."""
    if table.size[u, USABLE] == 0 or not unconstrained(maps, room, starts, references, at):
        return UNUSABLE
    program = Program(table.number, table.place, u, table.size[u, ROWS])
    work.counter[STEPS] = 0
    for attempt in range(2):
        if attempt == 1:
            # The corrections of the first attempt go with its multipliers.
            unconstrained(maps, room, starts, references, at)
        softest = proximal(program, maps, table, u, work, room)
        reset(work, program.rows, table.size[u, GROUPS])
        guessed = warm and attempt == 0 and guess(program, maps, table, u, work, guess_z, guess_y, guess_at)
        if guessed:
            resume(program, work, room.base)
        status = solve_rows(maps, program, work, room, starts, at, limit)
        if softest:
            for _ in range(PROXIMAL_STEPS):
                if status != OPTIMAL or not again(program, maps, table, u, work, room):
                    break
                status = solve_rows(maps, program, work, room, starts, at, limit)
        if status == OPTIMAL:
            if attempt == 1:
                clear_multipliers(program, table, u, y, at)
            if certify(maps, program, table, u, work, room, starts, at, z, y) <= EXACT:
                return OPTIMAL
            status = ROUGH
        if not guessed or status == LIMIT:
            return status
    return status


@compiled
def solve_programs(
    maps: SignalMaps, table: RowTable, programs: Index, column: Array, gram: Array, factor: Array,
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
    column, gram, factor : array, shapes (capacity, 13 N) and (capacity, capacity)
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
    groups = table.price.shape[1]
    work = working_set(column, gram, factor, table.number.shape[1], groups)
    room = make_room(reference.shape[1], groups)
    for u in range(len(programs)):
        i = programs[u]
        g = i if warm else 0
        ends[i] = solve_one(
            maps, table, u, work, room, initial, reference, i, warm, guess_z, guess_y, g, limit, z, y
        )
        if ends[i] != UNUSABLE:
            steps[i] = work.counter[STEPS]
        if ends[i] == OPTIMAL or ends[i] == ROUGH:
            for e in range(3):
                residuals[i, e] = room.certificate[2 * e]
        else:
            for e in range(z.shape[1]):
                z[i, e] = np.nan
            for e in range(y.shape[1]):
                y[i, e] = np.nan
