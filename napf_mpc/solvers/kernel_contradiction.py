r"""Whether hard rows contradict each other, checked by a certificate of Farkas.

Hard rows ``n_j' u >= b_j`` have no inputs u in common if weights ``d_j >= 0`` exist with ``sum d_j n_j = 0``
and ``sum d_j b_j > 0``. The dual active set meets such weights as a direction in which its multipliers may
grow without end, or as multipliers that have grown so. Soft rows carry no weight: their slacks have no bound.

In numbers the sum of the rows is a rest r, not zero, and it is measured in two ways from the optimum u0
without rows, both against ``bound = sum d_j (b_j - n_j' u0)``:

- Hard rows that bound all inputs bound ``r' (u - u0)`` as well. Below the bound, that is a proof to the
  digit, whatever the weights.
- Without them, plans that meet the rows lie at least ``bound / |r|`` beside u0 in the cost's own measure, in
  which a row alone is met from ``(b_j - n_j' u0) / |n_j|`` on. The rest must be rounding beside its terms,
  and the plans :data:`FAR` beyond the largest of these distances. What looks like a certificate without being
  one falls short by decades.
"""

from __future__ import annotations

import numpy as np

from napf_mpc.jit import compiled_apart, compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array
from napf_mpc.solvers.kernel_active_set import (
    WORKING,
    Program,
    WorkingSet,
    backward,
    factorise,
    forget,
    forward,
    lower_bound,
    row_value,
)
from napf_mpc.solvers.kernel_rows import HIGH, LOW, WIDTH
from napf_mpc.solvers.kernel_signals import FIRST, KINDS, SignalMaps

VANISHED = 1e-10
"""Part of its terms that may be left of a sum of rows that vanishes."""
POSITIVE = 1e-9
"""Part of its terms that the combined bound must be."""
FAR = 1e6
"""How many times as far as the farthest row alone a plan that meets all would have to go at least."""
REFINEMENTS = 3
"""Corrections of the weights at most: they stem from a system that may be conditioned like 1e11."""
FIRST_INPUT = int(FIRST[KINDS.index("input")])
"""Number of the first signal that is an input."""
INDEPENDENT = 1e-6
"""Part of its coefficients that a row on an input must have for itself among those that bound it."""


FORCE, EARLIER, FAMILY, AXES = 0, 1, 2, 3
"""Places in the room (7, 16): force on states and inputs of a stage; on the states a stage before; families
of the rows that bound the inputs of a stage; axes of these rows, each orthogonal to those before."""


def room_for_sums() -> Array:
    """Room for weighted sums of rows: one array, for each is handed over at every call."""
    return np.zeros((AXES + INPUTS, STATES + INPUTS))


@compiled_bare
def keep_hard_rows(program: Program, work: WorkingSet, soft: int) -> None:
    """Take the members that carry no weight in a certificate out of the working set."""
    for j in range(work.counter[WORKING] - 1, -1, -1):
        # NaN fails every comparison.
        if program.places.group[work.row[j]] < soft or not work.mult[j] > 0.0:
            forget(program, work, j)


@compiled_bare
def heaviest_last(work: WorkingSet) -> None:
    """Put the member that weighs most last."""
    last = work.counter[WORKING] - 1
    found, most = last, 0.0
    for j in range(last + 1):
        weight = work.mult[j] * np.sqrt(work.gram[work.slot[j], work.slot[j]])
        if weight > most:
            found, most = j, weight
    work.row[found], work.row[last] = work.row[last], work.row[found]
    work.side[found], work.side[last] = work.side[last], work.side[found]
    work.slot[found], work.slot[last] = work.slot[last], work.slot[found]
    work.mult[found], work.mult[last] = work.mult[last], work.mult[found]


@compiled_bare
def combine(work: WorkingSet, signals: Array) -> None:
    """Write what the weighted sum of the members does to all signals: nothing, if it vanishes."""
    for i in range(len(signals)):
        signals[i] = 0.0
    for j in range(work.counter[WORKING]):
        column, weight = work.column[work.slot[j]], work.mult[j]
        for i in range(len(signals)):
            signals[i] += weight * column[i]


@compiled_bare
def push_of_stage(program: Program, maps: SignalMaps, work: WorkingSet, k: int, sums: Array) -> None:
    """Write the weighted sum's force on the inputs of a stage, adding to that on the states at its end."""
    force = sums[FORCE]
    for i in range(INPUTS):
        force[STATES + i] = 0.0
    for j in range(work.counter[WORKING]):
        row, weight = work.row[j], work.side[j] * work.mult[j]
        if program.places.stage[row] == k:
            for d in range(WIDTH):
                target = maps.target[program.places.signal[d, row]]
                force[target] += weight * program.number[program.u, d, row]
    for i in range(INPUTS):
        for s in range(STATES):
            force[STATES + i] += maps.dynamics[k, s, STATES + i] * force[s]


@compiled_bare
def pull_back(maps: SignalMaps, k: int, sums: Array) -> None:
    """Move the force on the states from the end of a stage to its beginning."""
    for i in range(STATES):
        sums[EARLIER, i] = 0.0
        for s in range(STATES):
            sums[EARLIER, i] += maps.dynamics[k, s, i] * sums[FORCE, s]
    for i in range(STATES):
        sums[FORCE, i] = sums[EARLIER, i]


@compiled_bare
def find_box(program: Program, soft: int, k: int, sums: Array) -> bool:
    """Find four independent hard rows that bound the inputs of a stage from both sides; whether there are."""
    stages, found = program.plane.shape[3], 0
    box = sums[AXES:]
    for f in range(len(program.places.wide)):
        # Rows on inputs are those with four signals.
        if program.places.wide[f] == 0 or program.places.shelf[f] * stages < soft:
            continue
        low, high = program.plane[program.u, LOW, f, k], program.plane[program.u, HIGH, f, k]
        if not (low > -np.inf and high < np.inf):
            continue
        size = 0.0
        for d in range(INPUTS):
            box[found, d] = program.plane[program.u, d, f, k]
            size += box[found, d] * box[found, d]
        for _ in range(2):
            # Twice is enough for any rounding.
            for e in range(found):
                shared = 0.0
                for d in range(INPUTS):
                    shared += box[e, d] * box[found, d]
                for d in range(INPUTS):
                    box[found, d] -= shared * box[e, d]
        own = 0.0
        for d in range(INPUTS):
            own += box[found, d] * box[found, d]
        if own > INDEPENDENT * INDEPENDENT * size:
            for d in range(INPUTS):
                box[found, d] /= np.sqrt(own)
            sums[FAMILY, found] = f
            found += 1
            if found == INPUTS:
                return True
    return False


@compiled_bare
def gain_of_stage(program: Program, k: int, base: Array, sums: Array) -> tuple[float, float]:
    """Most that the inputs of a stage can give along the force on them, from those at hand; its terms."""
    box, force = sums[AXES:], sums[FORCE]
    gain, terms = 0.0, 0.0
    # The last row alone has a part along the last axis, and so on backwards.
    for e in range(INPUTS - 1, -1, -1):
        f = int(sums[FAMILY, e])
        along, own = 0.0, 0.0
        for d in range(INPUTS):
            along += box[e, d] * force[STATES + d]
            own += box[e, d] * program.plane[program.u, d, f, k]
        weight = along / own
        value, size = 0.0, 0.0
        for d in range(INPUTS):
            coefficient = program.plane[program.u, d, f, k]
            force[STATES + d] -= weight * coefficient
            term = coefficient * base[program.places.axis[f, d] * program.plane.shape[3] + k]
            value, size = value + term, size + abs(term)
        bound = program.plane[program.u, HIGH if weight > 0.0 else LOW, f, k]
        gain += weight * (bound - value)
        terms += abs(weight) * (abs(bound) + size)
    return gain, terms


@compiled_bare
def size_of_sum(maps: SignalMaps, signals: Array) -> float:
    """Size of a sum of rows in the cost's measure by what it does to each signal: at most the size itself."""
    size = 0.0
    for i in range(len(signals)):
        give = maps.kernel[i, i]
        if give > 0.0:
            part = abs(signals[i]) / np.sqrt(give)
            # NaN fails every comparison.
            size = size if part <= size else part if part < np.inf else np.inf
    return size


@compiled_bare
def along_inputs(
    program: Program, maps: SignalMaps, work: WorkingSet, soft: int, base: Array, signals: Array, sums: Array
) -> tuple[float, float, float]:
    """Most that inputs can give along the weighted sum from those at hand, its terms, and the sum's size.

    The gain is infinite if hard rows do not bound all inputs; the sum's signals must be known.
    """
    gain, terms, square, stages = 0.0, 0.0, 0.0, program.plane.shape[3]
    for i in range(STATES):
        sums[FORCE, i] = 0.0
    for k in range(stages - 1, -1, -1):
        push_of_stage(program, maps, work, k, sums)
        for i in range(INPUTS):
            square += sums[FORCE, STATES + i] * signals[maps.place[FIRST_INPUT + i] * stages + k]
        if gain < np.inf and find_box(program, soft, k, sums):
            more, size = gain_of_stage(program, k, base, sums)
            gain, terms = gain + more, terms + size
        else:
            gain = np.inf
        pull_back(maps, k, sums)
    return gain, terms, np.sqrt(abs(square))


@compiled_apart
def is_certificate(
    program: Program, maps: SignalMaps, work: WorkingSet, soft: int, base: Array, signals: Array, sums: Array
) -> bool:
    """Whether no plan meets all members, by their weights."""
    length, bound, terms, alone = 0.0, 0.0, 0.0, 0.0
    for j in range(work.counter[WORKING]):
        row, side, weight = work.row[j], work.side[j], work.mult[j]
        own = np.sqrt(work.gram[work.slot[j], work.slot[j]])
        low = lower_bound(program, row, side)
        miss = low - side * row_value(program, row, base)
        size = abs(low)
        for d in range(WIDTH):
            size += abs(program.number[program.u, d, row] * base[program.places.signal[d, row]])
        length, bound, terms = length + weight * own, bound + weight * miss, terms + weight * size
        if own > 0.0:
            alone = max(alone, abs(miss) / own)
    # NaN fails every comparison.
    if not bound > POSITIVE * terms:
        return False
    combine(work, signals)
    gain, more, rest = along_inputs(program, maps, work, soft, base, signals, sums)
    if bound - gain > POSITIVE * (terms + more):
        return True
    rest = max(rest, size_of_sum(maps, signals))
    return bool(rest <= VANISHED * length and bound > FAR * rest * alone)


@compiled_bare
def refined(
    program: Program, maps: SignalMaps, work: WorkingSet, soft: int, base: Array, signals: Array, sums: Array
) -> bool:
    """Correct the weights of all members but the last for what is left of their sum, until they prove it."""
    last = work.counter[WORKING] - 1
    if factorise(program, work, 0, last) < last:
        return False
    for _ in range(REFINEMENTS):
        combine(work, signals)
        for j in range(last):
            work.step[j] = work.side[j] * row_value(program, work.row[j], signals)
        forward(work, last, work.step)
        backward(work, last, work.step)
        for j in range(last):
            work.mult[j] = max(0.0, work.mult[j] - work.step[j])
        if is_certificate(program, maps, work, soft, base, signals, sums):
            return True
    return False


@compiled_bare
def by_one_row(
    program: Program, maps: SignalMaps, work: WorkingSet, soft: int, base: Array, signals: Array, sums: Array
) -> bool:
    """Whether a member alone cannot be met, whatever its weight beside others has become."""
    n = work.counter[WORKING]
    for j in range(n):
        work.mult[j] = 0.0
    for j in range(n):
        work.mult[j] = 1.0
        if is_certificate(program, maps, work, soft, base, signals, sums):
            return True
        work.mult[j] = 0.0
    return False


@compiled_apart
def contradiction(
    program: Program, maps: SignalMaps, work: WorkingSet, soft: int, base: Array, signals: Array, sums: Array
) -> bool:
    """Whether hard rows contradict each other, by the multipliers of the members; spoils the working set.

    Parameters
    ----------
    program : Program
        Rows.
    maps : SignalMaps
        Model.
    work : WorkingSet
        Members; their multipliers are the weights, as far as they are hard rows.
    soft : int
        Soft groups.
    base : array, shape (13 N,)
        Signals of the optimum without rows.
    signals : array, shape (13 N,)
        Room for what a weighted sum does to all signals.
    sums : array, shape (7, 16)
        Room of :func:`room_for_sums`.

    Returns
    -------
    bool
        Whether the weights, corrected, are a certificate.
    """
    keep_hard_rows(program, work, soft)
    if work.counter[WORKING] == 0:
        return False
    heaviest_last(work)
    if is_certificate(program, maps, work, soft, base, signals, sums):
        return True
    return refined(program, maps, work, soft, base, signals, sums) or by_one_row(
        program, maps, work, soft, base, signals, sums
    )
