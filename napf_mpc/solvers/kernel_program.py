"""One program of the kernel solver from its numbers to its answer and certificate; a loop over many."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_apart, compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array, Index
from napf_mpc.solvers.kernel_active_set import (
    LIMIT,
    OPTIMAL,
    STEPS,
    UNBOUNDED,
    WORKING,
    Program,
    WorkingSet,
    ascend,
    enter,
    look,
    lower_bound,
    mark_open,
    polish,
    reset,
    resume,
    row_value,
    sums,
)
from napf_mpc.solvers.kernel_contradiction import contradiction, room_for_sums
from napf_mpc.solvers.kernel_rows import HIGH, LOW, W1, W2, WIDTH, RowPlaces, RowTable
from napf_mpc.solvers.kernel_signals import SignalMaps
from napf_mpc.solvers.kernel_sweep import (
    Lanes,
    read_signals,
    stationarity,
    sweep,
    take,
    unload,
)

INFEASIBLE, ROUGH, UNUSABLE, STUCK, ALONE = 1, 3, 4, 5, 6
"""Further ends of a program: hard rows contradict each other, by a certificate; the KKT conditions are not
met; a number is not sound; rounding ends the method; it is to be solved alone."""
EXACT, PLAIN = 1e-9, 1e-10
"""Largest KKT residual of a solved program, over one or its own largest term; and of one that is solved
without corrections."""
ROUNDS = 4
"""Corrections of the signals by exact sweeps at most; one is the rule."""
CLOSE = 1e-12
"""A correction of the signals smaller than this, over one or the bound it moves against, ends the rounds."""
SOFTEST = 1e-3
"""A slack whose quadratic price is below this part of its rows' stiffness is solved by proximal steps."""
SOFTEST_ALONE = 1e-9
"""The same for a slack of one row without a linear price."""
SLOWEST = 0.01
"""No slack is given more of a quadratic price than this part of the stiffness of its softest row."""
MOST_GIVEN = 1e5
"""Nor more than this times its linear price, or one: a slack of one unit would drown in it."""
PROXIMAL_STEPS = 60
"""Proximal steps at most; each leaves at most a thousandth of the error if the rows that share a slack are
equally stiff, and at most half of it whatever they are."""
LOOK = 32
"""Guessed multipliers looked at together: most are zero."""
GUESSED = 1e-9
"""A guessed multiplier or slack above this means an active row or an open slack."""


class Room(NamedTuple):
    """Arrays that one program needs beside its working set and its lane."""

    base: Array
    """(13 N,) signals of the optimum without rows."""
    signals: Array
    """(13 N,) signals by the kernel."""
    plane: Array
    """(13, N) the same memory."""
    exact: Array
    """(13 N,) signals by the sweep."""
    exact_plane: Array
    """(13, N) the same memory."""
    certificate: Array
    """(6,) residual and largest term: primal, dual, complementarity."""
    previous: Array
    """(soft groups,) last slack of a group that needs proximal steps."""
    extra: Array
    """(soft groups,) what those add to its quadratic price; zero for all others."""
    give: Array
    """(soft groups,) largest Gram entry of its rows with bounds: -1 if none has any, -2 if not asked for."""
    was_open: NDArray[np.bool_]
    """(soft groups,) groups open before a proximal step."""
    row: Index
    """(capacity,) members before it."""
    side: Array
    """(capacity,) their sides."""
    sums: Array
    """(7, 16) for weighted sums of hard rows."""

    @classmethod
    def empty(cls, stages: int, soft: int, members: int) -> Room:
        """Room for programs of a size."""
        shape = (STATES + 1, stages)
        plane, exact = np.zeros(shape), np.zeros(shape)
        return cls(
            np.zeros(plane.size), plane.reshape(-1), plane, exact.reshape(-1), exact, np.zeros(6),
            np.zeros(soft), np.zeros(soft), np.zeros(soft), np.zeros(soft, dtype=np.bool_),
            np.zeros(members, dtype=np.int64), np.zeros(members), room_for_sums(),
        )  # fmt: skip


class Kept(NamedTuple):
    """Working sets of some programs while their plans are made side by side."""

    end: Index
    """(program,) how each ended so far, or :data:`ALONE`."""
    steps: Index
    """(program,)."""
    members: Index
    """(program,) how many."""
    row: Index
    """(program, capacity)."""
    side: Array
    """(program, capacity)."""
    mult: Array
    """(program, capacity)."""
    slack: Array
    """(program, soft group)."""
    total: Array
    """(program, soft group)."""
    is_open: NDArray[np.bool_]
    """(program, soft group)."""

    @classmethod
    def empty(cls, programs: int, soft: int, members: int) -> Kept:
        """Room for so many programs."""
        shape = (programs, members)
        return cls(
            np.zeros(programs, dtype=np.int64), np.zeros(programs, dtype=np.int64),
            np.zeros(programs, dtype=np.int64), np.zeros(shape, dtype=np.int64), np.zeros(shape),
            np.zeros(shape), np.zeros((programs, soft)), np.zeros((programs, soft)),
            np.zeros((programs, soft), dtype=np.bool_),
        )  # fmt: skip


@compiled_bare
def load(maps: SignalMaps, program: Program, work: WorkingSet, lanes: Lanes, lane: int) -> None:
    """Put the working set's forces into a lane without any."""
    for j in range(work.counter[WORKING]):
        row, weight = work.row[j], work.side[j] * work.mult[j]
        for d in range(WIDTH):
            i = program.places.signal[d, row]
            lanes.loads[maps.stage[i], maps.target[i], lane] += weight * program.number[program.u, d, row]


@compiled_apart
def under_load(maps: SignalMaps, program: Program, work: WorkingSet, room: Room, lanes: Lanes) -> None:
    """Plan and exact signals under the working set's multipliers, in the only lane."""
    unload(lanes)
    load(maps, program, work, lanes, 0)
    sweep(maps, lanes, True)
    read_signals(maps, lanes, 0, room.exact)


@compiled_bare
def correct(program: Program, work: WorkingSet, room: Room) -> bool:
    """Move the base by what the kernel's signals are off; return whether it mattered to any row."""
    matters = False
    for j in range(work.counter[WORKING]):
        row, side = work.row[j], work.side[j]
        bound = lower_bound(program, row, side)
        gap = bound - side * row_value(program, row, room.exact) - work.slack[program.places.group[row]]
        matters = matters or abs(gap) > CLOSE * max(1.0, abs(bound))
    for i in range(len(room.base)):
        shift = room.exact[i] - room.signals[i]
        matters = matters or abs(shift) > CLOSE * max(1.0, abs(room.exact[i]))
        room.base[i] += shift
    return matters


@compiled_apart
def solve_rows(
    maps: SignalMaps, program: Program, work: WorkingSet, room: Room, lanes: Lanes, limit: int
) -> int:
    """Optimum with rows from the working set as it is; the plan is in the only lane."""
    status = LIMIT
    for _ in range(ROUNDS):
        status = ascend(program, maps, work, room.base, room.signals, room.plane, limit)
        if status != OPTIMAL:
            return status
        under_load(maps, program, work, room, lanes)
        if not correct(program, work, room):
            break
        polish(program, work, room.exact)
    else:
        sums(program, work)
        under_load(maps, program, work, room, lanes)
    return status


@compiled_bare
def own_near(program: Program, maps: SignalMaps, table: RowTable, u: int, f: int) -> int:
    """How many rows of a family are stiff beside their slack by what their own signals give at most."""
    shelf, lonely, near = program.places.shelf[f], program.places.lonely[f], 0
    for k in range(table.plane.shape[3]):
        give = 0.0
        for d in range(WIDTH):
            coefficient = table.plane[u, d, f, k]
            give += coefficient * coefficient * maps.give[program.places.axis[f, d], k]
        alone = lonely & (table.shelves[u, W1, shelf, k] == 0.0)
        finite = (table.plane[u, LOW, f, k] > -np.inf) | (table.plane[u, HIGH, f, k] < np.inf)
        near += (table.shelves[u, W2, shelf, k] * give * WIDTH < SOFTEST) & finite & (not alone)
    return near


@compiled_bare
def proximal(
    program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room, strict: bool
) -> bool:
    """Give slacks with next to no quadratic price one of their own; return whether there are any.

    Next to none is measured by what the row's own signals give, if strict, and else by the softest signal of
    all, which nearly always does and leaves most programs without proximal steps.
    """
    soft, stages, any_soft = table.price.shape[2], table.plane.shape[3], False
    for g in range(soft):
        work.w1[g], work.w2[g] = table.price[u, W1, g], table.price[u, W2, g]
    for g in range(soft):
        room.previous[g], room.extra[g], room.give[g] = 0.0, 0.0, -2.0
    for f in range(len(program.places.wide)):
        shelf, lonely, near = program.places.shelf[f], program.places.lonely[f], 0
        if shelf == table.shelves.shape[2]:
            continue
        for k in range(stages):
            size = 0.0
            for d in range(WIDTH):
                size += table.plane[u, d, f, k] * table.plane[u, d, f, k]
            # A linear price, or a row that shares the slack, would drown in a slack so soft. A row alone
            # without one yields, that is all.
            alone = lonely & (table.shelves[u, W1, shelf, k] == 0.0)
            least = SOFTEST_ALONE if alone else SOFTEST
            finite = (table.plane[u, LOW, f, k] > -np.inf) | (table.plane[u, HIGH, f, k] < np.inf)
            # An upper bound of the row's own Gram entry first: it is cheap.
            near += (table.shelves[u, W2, shelf, k] * size * WIDTH * maps.softest < least) & finite
        if strict:
            near += own_near(program, maps, table, u, f)
        if near > 0:
            for k in range(stages):
                room.give[shelf * stages + k] = -1.0
    for f in range(len(program.places.wide)):
        shelf, lonely = program.places.shelf[f], program.places.lonely[f]
        # Softness is that of all rows which share a slack.
        if shelf == table.shelves.shape[2] or room.give[shelf * stages] < -1.0:
            continue
        for r in range(f * stages, f * stages + stages):
            g, give = program.places.group[r], 0.0
            alone = lonely & (table.price[u, W1, g] == 0.0)
            if table.number[u, LOW, r] == -np.inf and table.number[u, HIGH, r] == np.inf:
                continue
            for d in range(WIDTH):
                for e in range(WIDTH):
                    pair = maps.kernel[program.places.signal[d, r], program.places.signal[e, r]]
                    give += program.number[u, d, r] * program.number[u, e, r] * pair
            least = SOFTEST_ALONE if alone else SOFTEST
            room.give[g] = max(room.give[g], give)
            if give > 0.0:
                room.extra[g] = max(room.extra[g], least / give - table.price[u, W2, g])
    for g in range(soft):
        if room.give[g] > 0.0:
            most = MOST_GIVEN * max(1.0, table.price[u, W1, g])
            room.extra[g] = min(room.extra[g], min(SLOWEST / room.give[g], most))
        elif room.give[g] == 0.0:
            # Rows without coefficients have nothing that could drown: any price does.
            room.extra[g] = max(0.0, 1.0 - table.price[u, W2, g])
        any_soft = any_soft or room.extra[g] > 0.0
        work.w2[g] = table.price[u, W2, g] + room.extra[g]
    return any_soft


@compiled_bare
def join(program: Program, maps: SignalMaps, work: WorkingSet, row: int, side: float) -> None:
    """Make a row a member while there is room; the factor is not touched."""
    if work.counter[WORKING] < len(work.row) - 2:
        enter(program, maps, work, row, side)
        work.member[row] += 1 if side > 0.0 else 2
        work.counter[WORKING] += 1


@compiled_bare
def guess(
    program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, z: Array, y: Array, at: int
) -> bool:
    """Take the rows that push in a guess as members, and its slacks as open; return whether it is finite."""
    lost = 0
    for i in range(z.shape[1]):
        # NaN fails every comparison.
        lost += not abs(z[at, i]) < np.inf
    for i in range(y.shape[1]):
        lost += not abs(y[at, i]) < np.inf
    if lost > 0:
        return False
    for g in range(table.price.shape[2]):
        if work.w1[g] > 0.0 and z[at, program.places.slack_z[g]] > GUESSED:
            mark_open(work, g)
    spans = program.places.span
    for b in range(len(spans)):
        for first in range(spans[b, 0], spans[b, 1], LOOK):
            last, pushing = min(first + LOOK, spans[b, 1]), 0
            for m in range(max(first, 0), last):
                pushing += abs(y[at, m]) > GUESSED
            if pushing == 0:
                continue
            for m in range(max(first, 0), last):
                r = program.places.owner[m]
                if -y[at, m] > GUESSED and program.number[program.u, LOW, r] > -np.inf:
                    join(program, maps, work, r, 1.0)
                if y[at, m] > GUESSED and program.number[program.u, HIGH, r] < np.inf:
                    join(program, maps, work, r, -1.0)
    return True


@compiled_bare
def needed(program: Program, work: WorkingSet, group: int) -> float:
    """Slack that a group's rows need where the last look found them; no more than it has."""
    slack, stages, most = max(0.0, work.slack[group]), work.miss.shape[1], -np.inf
    for f in range(len(program.places.shelf)):
        if program.places.shelf[f] == group // stages:
            most = max(most, work.miss[f, group % stages])
    return float(max(0.0, slack + min(0.0, most)))


@compiled_apart
def again(program: Program, maps: SignalMaps, table: RowTable, u: int, work: WorkingSet, room: Room) -> bool:
    """Take a proximal step: prices from the slacks reached; return whether they had moved."""
    moved = False
    for g in range(table.price.shape[2]):
        if room.extra[g] > 0.0:
            # A slack beyond what its rows need would sink at the pace of its own price, next to nothing.
            reached = needed(program, work, g) if work.total[g] == 0.0 else max(0.0, work.slack[g])
            off = room.extra[g] * abs(reached - room.previous[g])
            moved = moved or off > CLOSE * max(1.0, table.price[u, W1, g])
            room.previous[g] = reached
    if not moved:
        return False
    count = work.counter[WORKING]
    for j in range(count):
        room.row[j], room.side[j] = work.row[j], work.side[j]
    for g in range(table.price.shape[2]):
        work.w1[g] = table.price[u, W1, g] - room.extra[g] * room.previous[g]
        room.was_open[g] = work.is_open[g]
    reset(work, table.price.shape[2])
    for g in range(table.price.shape[2]):
        if room.was_open[g] and not work.is_open[g]:
            mark_open(work, g)
    for j in range(count):
        join(program, maps, work, room.row[j], room.side[j])
    resume(program, work, room.base)
    return True


@compiled_bare
def certify(
    program: Program, table: RowTable, u: int, work: WorkingSet, room: Room, lanes: Lanes, lane: int,
    at: int, z: Array, y: Array,
) -> float:  # fmt: skip
    """Write plan, slacks, multipliers and residuals of the original program; return the largest relative one.

    The lane's plan must be in balance, see :func:`~napf_mpc.solvers.kernel_sweep.stationarity`, and its
    signals in the room.
    """
    out, n = room.certificate, lanes.states.shape[0]
    for e in range(6):
        out[e] = lanes.balance[e, lane]
    for i in range(y.shape[1]):
        y[at, i] = 0.0
    for k in range(n):
        for i in range(STATES):
            z[at, k * STATES + i] = lanes.states[k, i, lane]
            y[at, k * STATES + i] = -lanes.gradient[k, i, lane]
        for i in range(INPUTS):
            z[at, n * STATES + k * INPUTS + i] = lanes.inputs[k, i, lane]
    off, largest, product = out[2], out[3], out[4]
    for g in range(table.price.shape[2]):
        slack = max(0.0, work.slack[g])
        w1, w2, total = table.price[u, W1, g], table.price[u, W2, g], work.total[g]
        mult = 0.0 if work.is_open[g] and slack > 0.0 else max(0.0, w1 + w2 * slack - total)
        z[at, program.places.slack_z[g]], y[at, program.places.slack_y[g]] = slack, -mult
        if total != 0.0 or slack > 0.0:
            off = max(off, abs(w1 + w2 * slack - total - mult))
            largest = max(largest, max(w1, max(w2 * slack, total)))
            product = max(product, mult * slack)
        work.slack[g] = slack
    out[2], out[3] = off, largest
    missed, size, lost = out[0], out[1], lanes.lost[lane]
    for f in range(len(program.places.wide)):
        look(program, work, f, room.exact_plane)
        for k in range(n):
            miss, value = work.miss[f, k], abs(work.value[f, k])
            # NaN fails every comparison.
            lost += not value < np.inf
            missed, size = miss if miss > missed else missed, value if value > size else size
    out[0], out[1] = missed, size
    largest = out[5]
    for j in range(work.counter[WORKING]):
        row, side, mult = work.row[j], work.side[j], work.mult[j]
        bound = lower_bound(program, row, side)
        gap = bound - side * row_value(program, row, room.exact) - work.slack[program.places.group[row]]
        product, largest = max(product, mult * abs(gap)), max(largest, mult * abs(bound))
        if side > 0.0:
            y[at, program.places.y_low[row]] -= mult
        else:
            y[at, program.places.y_high[row]] += mult
    out[4], out[5] = product, largest
    worst = 0.0 if lost == 0 else np.inf
    for e in range(0, 6, 2):
        relative = out[e] / max(1.0, out[e + 1])
        worst = max(worst, relative) if relative < np.inf else np.inf
    return worst


@compiled_bare
def is_contradictory(
    program: Program, maps: SignalMaps, table: RowTable, work: WorkingSet, room: Room
) -> bool:  # fmt: skip
    """Whether the multipliers reached prove hard rows to contradict each other; spoils the working set."""
    return contradiction(program, maps, work, table.price.shape[2], room.base, room.signals, room.sums)


@compiled_apart
def solve_alone(
    maps: SignalMaps, program: Program, table: RowTable, u: int, work: WorkingSet, room: Room, lanes: Lanes,
    at: int, warm: bool, guess_z: Array, guess_y: Array, guess_at: int, limit: int, z: Array, y: Array,
) -> int:  # fmt: skip
    """Solve a program in the only lane, with corrections and proximal steps; return how it ended."""
    work.counter[STEPS] = 0
    status, strict = LIMIT, False
    for attempt in range(3):
        # The corrections of the first attempt go with its multipliers.
        sweep(maps, lanes, False)
        read_signals(maps, lanes, 0, room.base)
        softest = proximal(program, maps, table, u, work, room, strict)
        reset(work, table.price.shape[2])
        guessed = warm and attempt == 0 and guess(program, maps, table, u, work, guess_z, guess_y, guess_at)
        if guessed:
            resume(program, work, room.base)
        status = solve_rows(maps, program, work, room, lanes, limit)
        if softest:
            for _ in range(PROXIMAL_STEPS):
                if status != OPTIMAL or not again(program, maps, table, u, work, room):
                    break
                status = solve_rows(maps, program, work, room, lanes, limit)
        if status == OPTIMAL:
            stationarity(maps, lanes)
            if certify(program, table, u, work, room, lanes, 0, at, z, y) <= EXACT:
                return OPTIMAL
            status = ROUGH
        # Multipliers that grew without end tell the same as a direction in which they would.
        last = strict or status == LIMIT
        if last or status == UNBOUNDED:
            # Corrections under forces that large leave no digit of the optimum without rows.
            sweep(maps, lanes, False)
            read_signals(maps, lanes, 0, room.base)
            if is_contradictory(program, maps, table, work, room):
                return INFEASIBLE
        if status == UNBOUNDED:
            status = STUCK
        if last:
            return status
        strict = not guessed
    return status


@compiled_bare
def begin(
    maps: SignalMaps, program: Program, table: RowTable, u: int, work: WorkingSet, room: Room, lanes: Lanes,
    warm: bool, guess_z: Array, guess_y: Array, guess_at: int, limit: int,
) -> int:  # fmt: skip
    """Active set of a program by the kernel's signals; return how it ended, or that it wants more care."""
    work.counter[STEPS] = 0
    if proximal(program, maps, table, u, work, room, False):
        return ALONE
    read_signals(maps, lanes, u, room.base)
    reset(work, table.price.shape[2])
    guessed = warm and guess(program, maps, table, u, work, guess_z, guess_y, guess_at)
    if guessed:
        resume(program, work, room.base)
    status = ascend(program, maps, work, room.base, room.signals, room.plane, limit)
    if status == OPTIMAL:
        return status
    if is_contradictory(program, maps, table, work, room):
        return INFEASIBLE
    return ALONE if status == UNBOUNDED else status


@compiled_bare
def keep(work: WorkingSet, kept: Kept, u: int) -> None:
    """Note a program's working set."""
    kept.members[u], kept.steps[u] = work.counter[WORKING], work.counter[STEPS]
    for j in range(work.counter[WORKING]):
        kept.row[u, j], kept.side[u, j], kept.mult[u, j] = work.row[j], work.side[j], work.mult[j]
    for g in range(kept.slack.shape[1]):
        kept.slack[u, g], kept.total[u, g] = work.slack[g], work.total[g]
    for g in range(kept.slack.shape[1]):
        kept.is_open[u, g] = work.is_open[g]


@compiled_bare
def recall(work: WorkingSet, kept: Kept, u: int) -> None:
    """Take up a program's working set again, as far as its certificate needs it."""
    work.counter[WORKING], work.counter[STEPS] = kept.members[u], kept.steps[u]
    for j in range(kept.members[u]):
        work.row[j], work.side[j], work.mult[j] = kept.row[u, j], kept.side[u, j], kept.mult[u, j]
    for g in range(kept.slack.shape[1]):
        work.slack[g], work.total[g] = kept.slack[u, g], kept.total[u, g]
    for g in range(kept.slack.shape[1]):
        work.is_open[g] = kept.is_open[u, g]


@compiled_bare
def solve_programs(
    maps: SignalMaps, places: RowPlaces, table: RowTable, programs: Index, work: WorkingSet, room: Room,
    kept: Kept, lanes: Lanes, single: Lanes, initial: Array, reference: Array, warm: bool,
    guess_z: Array, guess_y: Array, limit: int, z: Array, y: Array, residuals: Array,
    ends: NDArray[np.int64], steps: Index,
) -> None:  # fmt: skip
    """Solve all programs of a table: side by side, then those alone that want more care.

    Parameters
    ----------
    maps : SignalMaps
        Model.
    places : RowPlaces
        Where their rows stand.
    table : RowTable
        Rows of the programs.
    programs : array of int, shape (programs of the table,)
        Their places in the batch.
    work, room, kept, lanes, single : WorkingSet, Room, Kept and two Lanes
        Room to work in; lanes are as many as programs, and a single one.
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
        take(lanes, u, initial, reference, programs[u])
    sweep(maps, lanes, False)
    unload(lanes)
    for u in range(len(programs)):
        if table.sound[u] == 0 or lanes.lost[u] > 0:
            kept.end[u] = UNUSABLE
            continue
        program = Program(table.number, table.plane, places, u)
        g = programs[u] if warm else 0
        kept.end[u] = begin(maps, program, table, u, work, room, lanes, warm, guess_z, guess_y, g, limit)
        keep(work, kept, u)
        if kept.end[u] == OPTIMAL:
            load(maps, program, work, lanes, u)
    sweep(maps, lanes, True)
    stationarity(maps, lanes)
    for u in range(len(programs)):
        i, end = programs[u], kept.end[u]
        program = Program(table.number, table.plane, places, u)
        if end == OPTIMAL:
            recall(work, kept, u)
            read_signals(maps, lanes, u, room.exact)
            if not certify(program, table, u, work, room, lanes, u, i, z, y) <= PLAIN:
                end = ALONE
        if end == ALONE:
            take(single, 0, initial, reference, i)
            g = i if warm else 0
            end = solve_alone(
                maps, program, table, u, work, room, single, i, warm, guess_z, guess_y, g, limit, z, y
            )
            kept.steps[u] = work.counter[STEPS]
        ends[i] = end
        if end != UNUSABLE:
            steps[i] = kept.steps[u]
        if end in (OPTIMAL, ROUGH):
            for e in range(3):
                residuals[i, e] = room.certificate[2 * e]
        else:
            for e in range(z.shape[1]):
                z[i, e] = np.nan
            for e in range(y.shape[1]):
                y[i, e] = np.nan
