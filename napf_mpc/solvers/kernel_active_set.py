r"""Dual active set of Goldfarb and Idnani (1983) on the signal kernel, with slacks that never are variables.

Start at the optimum without rows, add the most violated row, and move the multipliers of the working set so
that its rows stay met, until the new row is met too (a full step) or a multiplier reaches zero (a partial
one: its row is dropped). The Cholesky factor of the working set's Gram matrix is kept, not made anew.

A group of rows with the slack s, priced ``w1 s + w2 s^2 / 2``, is *closed* while the sum of its multipliers
is below w1: then s = 0. It is *open* beyond: then ``s = (sum - w1) / w2``, which adds ``1 / w2`` to the Gram
entries among its rows. In the method's own terms, a closed group is the row ``s >= 0`` in the working set
with the multiplier ``w1 - sum``; opening drops that row, closing adds it. A group with w1 <= 0 is always
open.

D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
Mathematical Programming 27 (1983).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_apart, compiled_bare
from napf_mpc.qp import STATES, Array, Index
from napf_mpc.solvers.kernel_rows import HIGH, LOW, WIDTH, RowPlaces
from napf_mpc.solvers.kernel_signals import SignalMaps

OPTIMAL, UNBOUNDED, LIMIT = 0, 1, 2
"""How the method ends; unbounded is the dual, if what the new multiplier does meets no end."""
DEPENDENT = 1e-11
"""A row of which less than this part is new to the working set depends on it."""
TOUCH = 1e-11
"""A row violated by less than this part of its bound, or of one unit, is met."""
NOISE = 1e-10
"""Relative change of a multiplier below which it is rounding."""
ROUNDING = 1e-12
"""Part of the forces on a row that may be rounding."""
SET_ASIDE = 4
"""Mark of a row that is met as well as rounding allows, beside those of its sides."""
WORKING, OPENED, FREE, STEPS, SUSPECTS = 0, 1, 2, 3, 4
"""Places of the counters of a :class:`WorkingSet`."""


class Program(NamedTuple):
    """Rows of one program of a :class:`~napf_mpc.solvers.kernel_rows.RowTable`."""

    number: Array
    plane: Array
    places: RowPlaces
    u: int


class WorkingSet(NamedTuple):
    """Working set of a program; room is shared by all programs that one thread solves."""

    row: Index
    """(capacity,) row of each member."""
    side: Array
    """(capacity,) 1.0 if it stands at its lower, -1.0 if at its upper bound."""
    slot: Index
    """(capacity,) where its column and its Gram entries are kept."""
    mult: Array
    """(capacity,) its multiplier."""
    step: Array
    """(capacity,) change of the multipliers for a unit of the new one, with the opposite sign."""
    part: Array
    """(capacity,) part of the new row that is not new, in the factor's own axes."""
    column: Array
    """(capacity, 13 N) by slot: what a unit of the multiplier does to the signals."""
    gram: Array
    """(capacity, capacity) by slots, without slacks."""
    factor: Array
    """(capacity, capacity) transpose of the Cholesky factor, slacks of open groups included."""
    free: Index
    """(capacity,) slots not in use."""
    member: NDArray[np.uint8]
    """(rows,) 1 if the row stands at its lower bound, 2 if at its upper, 3 if at both; see SET_ASIDE."""
    is_open: NDArray[np.bool_]
    """(groups,)."""
    slack: Array
    """(groups,)."""
    shelf: Array
    """(groups / N, N) the same memory."""
    total: Array
    """(groups,) sum of the multipliers."""
    rate: Array
    """(groups,) its change for a unit of the new multiplier."""
    w1: Array
    """(groups,)."""
    w2: Array
    """(groups,)."""
    opened: Index
    """(groups,) groups with w1 > 0 that are open."""
    counter: Index
    """(5,) members, opened groups, free slots, steps, suspects."""
    suspect: Index
    """(rows,) rows that were violated when all rows were last looked at."""
    miss: Array
    """(family, N) by how much each row was, less than zero if it was met."""
    value: Array
    """(family, N) values of the rows then."""

    @classmethod
    def empty(cls, families: int, shelves: int, stages: int, soft: int) -> WorkingSet:
        """Room for programs of a size; the last row of shelves is that of hard rows."""
        rows, groups = families * stages, shelves * stages
        n = capacity(stages, rows, soft)
        shelf = np.zeros((shelves, stages))
        whole = np.int64
        return cls(
            np.zeros(n, whole), np.zeros(n), np.zeros(n, whole), np.zeros(n), np.zeros(n), np.zeros(n),
            np.zeros((n, (STATES + 1) * stages)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n, whole),
            np.zeros(rows, np.uint8), np.zeros(groups, np.bool_), shelf.reshape(groups), shelf,
            np.zeros(groups), np.zeros(groups), np.zeros(groups), np.zeros(groups), np.zeros(groups, whole),
            np.zeros(5, whole), np.zeros(rows, whole), np.zeros((families, stages)),
            np.zeros((families, stages)),
        )  # fmt: skip


def capacity(stages: int, rows: int, groups: int) -> int:
    """Members at most: each is new to the inputs or to the slack of an open group."""
    return min(2 * rows, 4 * stages + groups) + 2


@compiled_bare
def reset(work: WorkingSet, soft: int) -> None:
    """Forget all members; prices w1 and w2 of the soft groups must be set."""
    for j in range(len(work.free)):
        work.free[j] = j
    work.counter[WORKING], work.counter[OPENED] = 0, 0
    work.counter[FREE] = len(work.free)
    for r in range(len(work.member)):
        work.member[r] = 0
    for g in range(soft):
        work.total[g] = 0.0
        work.is_open[g] = work.w1[g] <= 0.0
        work.slack[g] = -work.w1[g] / work.w2[g] if work.is_open[g] else 0.0
    for g in range(max(soft, 0), len(work.w1)):
        work.w1[g], work.is_open[g], work.slack[g], work.total[g] = np.inf, False, 0.0, 0.0


@compiled_bare
def row_value(program: Program, row: int, signals: Array) -> float:
    """Value of a row, of signals or of a member's column."""
    total = 0.0
    for d in range(WIDTH):
        total += program.number[program.u, d, row] * signals[program.places.signal[d, row]]
    return total


@compiled_bare
def fill_column(program: Program, maps: SignalMaps, row: int, side: float, column: Array) -> None:
    """Write what a unit force along a row does to all signals."""
    for i in range(len(column)):
        column[i] = 0.0
    for d in range(WIDTH):
        weight = side * program.number[program.u, d, row]
        if weight != 0.0:
            signal = program.places.signal[d, row]
            # The compiler sees that no index is negative.
            for i in range(max(maps.begin[signal], 0), maps.end[signal]):
                column[i] += weight * maps.kernel[signal, i]


@compiled_bare
def bond(work: WorkingSet, one: int, other: int) -> float:
    """What two groups' slacks add to the Gram entry of their rows."""
    return 1.0 / work.w2[one] if one == other and work.is_open[one] else 0.0


@compiled_bare
def forward(work: WorkingSet, n: int, values: Array) -> None:
    """Solve with the Cholesky factor, in place."""
    for i in range(n):
        values[i] /= work.factor[i, i]
        known = values[i]
        for j in range(i + 1, n):
            values[j] -= work.factor[i, j] * known


@compiled_bare
def backward(work: WorkingSet, n: int, values: Array) -> None:
    """Solve with the transpose of the Cholesky factor, in place."""
    for i in range(n - 1, -1, -1):
        # Two sums need not wait for each other.
        even, odd = values[i], 0.0
        for j in range(i + 1, n - 1, 2):
            even -= work.factor[i, j] * values[j]
            odd -= work.factor[i, j + 1] * values[j + 1]
        if (n - i) % 2 == 0:
            even -= work.factor[i, n - 1] * values[n - 1]
        values[i] = (even + odd) / work.factor[i, i]


@compiled_bare
def widen(work: WorkingSet, first: int, n: int, extra: Array) -> None:
    """Factor of the Gram matrix plus ``extra extra'``, zero before the first member; spoils extra."""
    for k in range(first, n):
        old = work.factor[k, k]
        new = np.sqrt(old * old + extra[k] * extra[k])
        c, s = new / old, extra[k] / old
        work.factor[k, k] = new
        for i in range(k + 1, n):
            work.factor[k, i] = (work.factor[k, i] + s * extra[i]) / c
            extra[i] = c * extra[i] - s * work.factor[k, i]


@compiled_bare
def factorise(program: Program, work: WorkingSet, first: int, n: int) -> int:
    """Factor anew from a member on; return the first member that depends on those before, or n."""
    for i in range(max(first, 0), n):
        a, mine = work.slot[i], program.places.group[work.row[i]]
        for j in range(i, n):
            work.factor[i, j] = work.gram[a, work.slot[j]]
        if work.is_open[mine]:
            for j in range(i, n):
                work.factor[i, j] += bond(work, mine, program.places.group[work.row[j]])
        whole = work.factor[i, i]
        # Four rows at a time: most are short.
        for k in range(0, i - 3, 4):
            one, two, three, four = (
                work.factor[k, i],
                work.factor[k + 1, i],
                work.factor[k + 2, i],
                work.factor[k + 3, i],
            )
            for j in range(i, n):
                known = one * work.factor[k, j] + two * work.factor[k + 1, j]
                known += three * work.factor[k + 2, j] + four * work.factor[k + 3, j]
                work.factor[i, j] -= known
        for k in range(i - i % 4, i):
            known = work.factor[k, i]
            for j in range(i, n):
                work.factor[i, j] -= known * work.factor[k, j]
        if not work.factor[i, i] > DEPENDENT * whole:
            return i
        root = np.sqrt(work.factor[i, i])
        for j in range(i, n):
            work.factor[i, j] /= root
    return n


@compiled_bare
def enter(program: Program, maps: SignalMaps, work: WorkingSet, row: int, side: float) -> None:
    """Write a row behind the last member, with its column and Gram entries, without making it one."""
    n = work.counter[WORKING]
    work.counter[FREE] -= 1
    slot = work.free[work.counter[FREE]]
    work.row[n], work.side[n], work.slot[n], work.mult[n] = row, side, slot, 0.0
    column = work.column[slot]
    fill_column(program, maps, row, side, column)
    for j in range(n + 1):
        entry = work.side[j] * row_value(program, work.row[j], column)
        work.gram[slot, work.slot[j]] = entry
        work.gram[work.slot[j], slot] = entry


@compiled_bare
def release(program: Program, work: WorkingSet, j: int, count: int) -> None:
    """Take member j out of a list of so many; the factor is not touched."""
    row, side = work.row[j], work.side[j]
    work.free[work.counter[FREE]] = work.slot[j]
    work.counter[FREE] += 1
    work.member[row] -= 1 if side > 0.0 else 2
    group = program.places.group[row]
    work.total[group] = 0.0
    work.slack[group] = -work.w1[group] / work.w2[group] if work.is_open[group] else 0.0
    for i in range(j, count - 1):
        work.row[i], work.side[i] = work.row[i + 1], work.side[i + 1]
        work.slot[i], work.mult[i] = work.slot[i + 1], work.mult[i + 1]


@compiled_bare
def drop(program: Program, work: WorkingSet, j: int, waiting: int) -> None:
    """Take member j out of working set and factor; so many rows wait behind the last member."""
    n = work.counter[WORKING]
    for i in range(j + 1, n):
        work.part[i - 1] = work.factor[j, i]
    for k in range(j):
        for i in range(j, n - 1):
            work.factor[k, i] = work.factor[k, i + 1]
    for k in range(j, n - 1):
        for i in range(k, n - 1):
            work.factor[k, i] = work.factor[k + 1, i + 1]
    release(program, work, j, n + waiting)
    work.counter[WORKING] = n - 1
    widen(work, j, n - 1, work.part)


@compiled_bare
def open_group(program: Program, work: WorkingSet, group: int) -> None:
    """Let a group's slack go: its row ``s >= 0`` leaves the working set."""
    n = work.counter[WORKING]
    first, root = n, np.sqrt(1.0 / work.w2[group])
    for j in range(n - 1, -1, -1):
        inside = program.places.group[work.row[j]] == group
        work.part[j] = root if inside else 0.0
        first = j if inside else first
    widen(work, first, n, work.part)
    mark_open(work, group)


@compiled_bare
def mark_open(work: WorkingSet, group: int) -> None:
    """Note that a group is open; the factor is not touched."""
    work.is_open[group] = True
    work.opened[work.counter[OPENED]] = group
    work.counter[OPENED] += 1


@compiled_bare
def first_of(program: Program, work: WorkingSet, group: int) -> int:
    """First member of a group, or the number of members."""
    n = work.counter[WORKING]
    for j in range(n):
        if program.places.group[work.row[j]] == group:
            return int(j)
    return int(n)


@compiled_apart
def close_group(program: Program, work: WorkingSet, place: int) -> bool:
    """Hold an opened group's slack at zero; return whether the members stay independent."""
    group = work.opened[place]
    work.counter[OPENED] -= 1
    work.opened[place] = work.opened[work.counter[OPENED]]
    work.is_open[group], work.slack[group] = False, 0.0
    n = work.counter[WORKING]
    return bool(factorise(program, work, first_of(program, work, group), n) == n)


@compiled_bare
def sums(program: Program, work: WorkingSet) -> None:
    """Sum the multipliers of each group and set its slack."""
    n = work.counter[WORKING]
    for j in range(n):
        work.total[program.places.group[work.row[j]]] = 0.0
    for j in range(n):
        work.total[program.places.group[work.row[j]]] += work.mult[j]
    for j in range(n):
        group = program.places.group[work.row[j]]
        if work.is_open[group]:
            work.slack[group] = (work.total[group] - work.w1[group]) / work.w2[group]


@compiled_bare
def respond(work: WorkingSet, base: Array, signals: Array) -> None:
    """Signals under the working set's multipliers."""
    for i in range(len(base)):
        signals[i] = base[i]
    for j in range(work.counter[WORKING]):
        column, mult = work.column[work.slot[j]], work.mult[j]
        for i in range(len(signals)):
            signals[i] += mult * column[i]


@compiled_bare
def violation_of(program: Program, work: WorkingSet, row: int, signals: Array) -> tuple[float, float]:
    """By how much a row is violated, less than zero if it is met, and on which side."""
    value = row_value(program, row, signals)
    under, over = program.number[program.u, LOW, row] - value, value - program.number[program.u, HIGH, row]
    slack = work.slack[program.places.group[row]]
    return (under - slack, 1.0) if under >= over else (over - slack, -1.0)


@compiled_bare
def look(program: Program, work: WorkingSet, f: int, plane: Array) -> int:
    """Write values and violations of a family's rows for signals (13, N); return how many are violated."""
    places, u, hits = program.places, program.u, 0
    a, b, c, d = places.axis[f, 0], places.axis[f, 1], places.axis[f, 2], places.axis[f, 3]
    g = places.shelf[f]
    if places.wide[f] == 0:
        for k in range(plane.shape[1]):
            value = program.plane[u, 0, f, k] * plane[a, k]
            value += program.plane[u, 1, f, k] * plane[b, k]
            work.value[f, k] = value + program.plane[u, 2, f, k] * plane[c, k]
    else:
        for k in range(plane.shape[1]):
            value = program.plane[u, 0, f, k] * plane[a, k]
            value += program.plane[u, 1, f, k] * plane[b, k]
            value += program.plane[u, 2, f, k] * plane[c, k]
            work.value[f, k] = value + program.plane[u, 3, f, k] * plane[d, k]
    # A loop of its own: with more arrays in one, compilers do not look whether they overlap, and give up.
    for k in range(plane.shape[1]):
        value = work.value[f, k]
        under, over = program.plane[u, LOW, f, k] - value, value - program.plane[u, HIGH, f, k]
        miss = (under if under >= over else over) - work.shelf[g, k]
        work.miss[f, k] = miss
        hits += miss > TOUCH
    return hits


@compiled_bare
def find_suspects(program: Program, work: WorkingSet, plane: Array) -> None:
    """Look at all rows and note those that are violated."""
    stages, count = plane.shape[1], 0
    for f in range(len(program.places.wide)):
        if look(program, work, f, plane) > 0:
            for k in range(stages):
                if work.miss[f, k] > TOUCH:
                    work.suspect[count] = f * stages + k
                    count += 1
    work.counter[SUSPECTS] = count


@compiled_bare
def most_violated(
    program: Program, work: WorkingSet, signals: Array, floor: float
) -> tuple[int, float, float]:
    """Suspect (or -1 - place of an opened group) violated most, its side, by how much; zero for none."""
    found, where, most = 0, 1.0, floor
    for e in range(work.counter[SUSPECTS]):
        r = work.suspect[e]
        violation, side = violation_of(program, work, r, signals)
        if violation > most:
            bound = program.number[program.u, LOW, r] if side > 0.0 else program.number[program.u, HIGH, r]
            kept = SET_ASIDE | (1 if side > 0.0 else 2)
            if violation > TOUCH * max(1.0, abs(bound)) and not work.member[r] & kept:
                found, where, most = r, side, violation
    for e in range(work.counter[OPENED]):
        below = -work.slack[work.opened[e]]
        if below > most and below > TOUCH:
            found, where, most = -1 - e, 1.0, below
    return found, where, most if most > floor else 0.0


@compiled_bare
def lower_bound(program: Program, row: int, side: float) -> float:
    """Bound of a row on the side where it stands, as that of ``side * row >= bound``."""
    if side > 0.0:
        return float(program.number[program.u, LOW, row])
    return -float(program.number[program.u, HIGH, row])


@compiled_bare
def largest_miss(program: Program, work: WorkingSet, signals: Array) -> float:
    """By how much the members miss their bounds at most."""
    most = 0.0
    for j in range(work.counter[WORKING]):
        row, side = work.row[j], work.side[j]
        miss = lower_bound(program, row, side) - side * row_value(program, row, signals)
        most = max(most, abs(miss - work.slack[program.places.group[row]]))
    return most


@compiled_bare
def polish(program: Program, work: WorkingSet, signals: Array) -> bool:
    """Correct the multipliers for what the members miss their bounds by; return whether it mattered."""
    n = work.counter[WORKING]
    matters = False
    for j in range(n):
        row, side = work.row[j], work.side[j]
        bound = lower_bound(program, row, side)
        work.step[j] = bound - side * row_value(program, row, signals)
        work.step[j] -= work.slack[program.places.group[row]]
        matters = matters or abs(work.step[j]) > 0.1 * TOUCH * max(1.0, abs(bound))
    if matters:
        forward(work, n, work.step)
        backward(work, n, work.step)
        for j in range(n):
            work.mult[j] = max(0.0, work.mult[j] + work.step[j])
    return matters


@compiled_bare
def rounding(program: Program, work: WorkingSet, n: int) -> float:
    """How exactly the row behind n members can be known under their multipliers."""
    total = 0.0
    for j in range(n):
        total += work.mult[j] * abs(work.gram[work.slot[n], work.slot[j]])
    return float(TOUCH + ROUNDING * total)


@compiled_apart
def point(work: WorkingSet, waiting: int) -> None:
    """Replace the multipliers by the direction in which they grow without end; a row that waits joins in."""
    n = work.counter[WORKING]
    for j in range(n):
        work.mult[j] = -work.step[j]
    if waiting > 0:
        work.mult[n] = 1.0
    work.counter[WORKING] = n + waiting


@compiled_bare
def ascend(
    program: Program, maps: SignalMaps, work: WorkingSet, base: Array, signals: Array, plane: Array,
    limit: int,
) -> int:  # fmt: skip
    """Go on from a working set whose multipliers are feasible to the optimum.

    Parameters
    ----------
    program : Program
        Rows.
    maps : SignalMaps
        Model.
    work : WorkingSet
        Members, their multipliers (>= 0, each closed group's sum at most w1) and factor.
    base : array, shape (13 N,)
        Signals of the optimum without rows.
    signals : array, shape (13 N,)
        Where the signals of the optimum go.
    plane : array, shape (13, N)
        The same memory.
    limit : int
        Steps at most, counted in the working set.

    Returns
    -------
    int
        :data:`OPTIMAL`, :data:`LIMIT`, or :data:`UNBOUNDED`: the members' multipliers then are a direction,
        which rounding alone may have made, see :mod:`~napf_mpc.solvers.kernel_contradiction`.
    """
    work.counter[SUSPECTS] = 0
    for r in range(len(work.member)):
        work.member[r] &= 3
    while True:
        sums(program, work)
        respond(work, base, signals)
        floor = 0.0
        if polish(program, work, signals):
            sums(program, work)
            respond(work, base, signals)
            # What is left is the rounding of large forces that cancel.
            floor = 4.0 * largest_miss(program, work, signals)
        found, side, violation = most_violated(program, work, signals, floor)
        if violation == 0.0:
            find_suspects(program, work, plane)
            found, side, violation = most_violated(program, work, signals, floor)
        if violation == 0.0:
            return OPTIMAL
        is_row = found >= 0
        if is_row:
            enter(program, maps, work, found, side)
            work.member[found] += 1 if side > 0.0 else 2
            group = program.places.group[found]
        else:
            group = work.opened[-1 - found]
        waiting = 1 if is_row else 0
        while True:
            if work.counter[STEPS] >= limit:
                # A row that waits has a multiplier, too.
                work.counter[WORKING] += waiting
                return LIMIT
            work.counter[STEPS] += 1
            n = work.counter[WORKING]
            # How much of the new row is new.
            for j in range(n):
                shared = bond(work, group, program.places.group[work.row[j]])
                work.part[j] = work.gram[work.slot[n], work.slot[j]] + shared if is_row else shared
            whole = bond(work, group, group)
            if is_row:
                whole += work.gram[work.slot[n], work.slot[n]]
            forward(work, n, work.part)
            fresh = whole
            for j in range(n):
                fresh -= work.part[j] * work.part[j]
                work.step[j] = work.part[j]
            backward(work, n, work.step)
            independent = fresh > DEPENDENT * whole
            length = violation / fresh if independent else np.inf
            blocking, opening = -1, -1
            # Without a full step to compare with, rounding must not pass for a multiplier that shrinks.
            noise, largest = 0.0 if independent else NOISE * np.sqrt(whole), 1.0
            for j in range(n):
                work.rate[program.places.group[work.row[j]]] = 0.0
                largest = max(largest, abs(work.step[j]))
                own = noise / np.sqrt(work.gram[work.slot[j], work.slot[j]]) if noise > 0.0 else 0.0
                if work.step[j] > own and work.mult[j] < length * work.step[j]:
                    length, blocking = work.mult[j] / work.step[j], j
            if is_row:
                work.rate[group] = 1.0
            for j in range(n):
                work.rate[program.places.group[work.row[j]]] -= work.step[j]
            noise = 0.0 if independent else NOISE * largest
            for j in range(n + waiting):
                other = program.places.group[work.row[j]]
                if not work.is_open[other] and work.rate[other] > noise:
                    room = max(0.0, work.w1[other] - work.total[other])
                    if room < length * work.rate[other]:
                        length, blocking, opening = room / work.rate[other], -1, other
            if length == np.inf:
                if not is_row or work.mult[n] > 0.0 or violation > rounding(program, work, n):
                    point(work, waiting)
                    return UNBOUNDED
                # It depends on the members, and misses its bound by no more than their own rounding.
                release(program, work, n, n + 1)
                work.member[found] |= SET_ASIDE
                break
            for j in range(n):
                work.mult[j] -= length * work.step[j]
            if is_row:
                work.mult[n] += length
            if independent:
                violation -= length * fresh
            if blocking >= 0:
                drop(program, work, blocking, waiting)
            elif opening >= 0:
                open_group(program, work, opening)
            else:
                break
            # Sums of the members and of the row that waits.
            work.counter[WORKING] += waiting
            sums(program, work)
            work.counter[WORKING] -= waiting
        if is_row and work.member[found] & SET_ASIDE:
            continue
        if is_row:
            work.factor[n, n] = np.sqrt(fresh)
            for j in range(n):
                work.factor[j, n] = work.part[j]
            work.counter[WORKING] = n + 1
        elif not close_group(program, work, -1 - found):
            return LIMIT


@compiled_bare
def forget(program: Program, work: WorkingSet, j: int) -> None:
    """Take member j out of the working set; the factor then holds for the members before it only."""
    n = work.counter[WORKING]
    for k in range(j):
        for i in range(j, n - 1):
            work.factor[k, i] = work.factor[k, i + 1]
    release(program, work, j, n)
    work.counter[WORKING] = n - 1


@compiled_bare
def resume(program: Program, work: WorkingSet, base: Array) -> None:
    """Multipliers of a working set guessed, less what cannot be: dependent rows, multipliers below zero.

    Members, columns, Gram entries and open groups must be set; the result is a state from which
    :func:`ascend` goes on.
    """
    first = 0
    while True:
        n = work.counter[WORKING]
        bad = factorise(program, work, first, n)
        while bad < n:
            forget(program, work, bad)
            n -= 1
            bad = factorise(program, work, bad, n)
        first = n
        for j in range(n):
            row, side = work.row[j], work.side[j]
            group = program.places.group[row]
            work.mult[j] = lower_bound(program, row, side) - side * row_value(program, row, base)
            if work.is_open[group]:
                work.mult[j] += work.w1[group] / work.w2[group]
        forward(work, n, work.mult)
        backward(work, n, work.mult)
        sound = True
        for j in range(n - 1, -1, -1):
            if not work.mult[j] > 0.0:
                forget(program, work, j)
                first, sound = j, False
        n = work.counter[WORKING]
        if sound:
            sums(program, work)
            for j in range(n):
                group = program.places.group[work.row[j]]
                if not work.is_open[group] and work.total[group] > work.w1[group]:
                    mark_open(work, group)
                    first, sound = min(first, first_of(program, work, group)), False
        work.counter[STEPS] += 1
        if sound:
            break
    for e in range(work.counter[OPENED] - 1, -1, -1):
        group = work.opened[e]
        if work.total[group] == 0.0:
            work.counter[OPENED] -= 1
            work.opened[e] = work.opened[work.counter[OPENED]]
            work.is_open[group], work.slack[group] = False, 0.0
