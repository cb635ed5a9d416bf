"""Sweeps along a horizon as a tape: one list of short sums for a model, played on many programs at once.

All numbers of the plans stand in one plane (place, lane), a program in each lane. A matrix of the model has
few entries, and a sweep is a chain of sums that wait for each other: on the tape it is a list of sums of up
to four products, in the order in which they can be made, and each is made for all lanes before the next. No
sum runs over lanes, so that a plan is the same to the last bit whatever stands beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array, Index

PIECE = 4
"""Products of a sum on the tape; rows with more are made in several."""
FREE, LOADED, BALANCE = 0, 1, 2
"""Parts of a tape: the sweep without loads, with loads, and from here on the balance of each stage."""

ZERO, START, REFERENCE, LINEAR, LOADS, COST, PLAN = range(7)
PUSH, GRADIENT, WEIGHED, PULLED, MOVED, LARGEST = range(7, 13)
"""Blocks of a plane: zero, of which two more rows take the first parts of long sums; the state now (12,) and
references (N, 12); -Q ref (N, 12); rows times their multipliers, by state and input (N, 16); linear part of
the optimal cost from the end of each stage on (N, 12); states (N, 12) and inputs (N, 4); the optimal cost's
gradient (N, 12); of one stage Q and R times states and inputs (16,), what the gradient beyond it pulls these
by (16,), and where the dynamics lead from its beginning (12,); room for largest numbers (6, 16)."""
TERMS = 6
"""Kinds of largest numbers."""
BOTH = STATES + INPUTS

Small = NDArray[np.uint32]
"""Places that are never negative: the compiled loops need not ask."""


def first_places(stages: int) -> Index:
    """Where each block of a plane begins (13,), and last how many places there are."""
    rows = [3, STATES]
    rows += [each * stages for each in (STATES, STATES, BOTH, STATES, STATES, INPUTS, STATES)]
    rows += [BOTH, BOTH, STATES, TERMS * BOTH]
    return np.cumsum([0, *rows])


class Tape(NamedTuple):
    """Sums ``plane[to] = plane[base] + value . plane[columns]``, in the order in which they are made."""

    first: Index
    """(14,) see :func:`first_places`."""
    begins: Index
    """(parts + 1,) where each part begins, see :data:`FREE`."""
    place: Small
    """(sums, 6) to, base and four columns."""
    value: Array
    """(sums, 4); a sum that has fewer products is filled up with zeros."""


class Matrices(NamedTuple):
    """Of each stage: the model's; A - B K, K, H^-1 B' and H^-1; the optimal cost from its end on."""

    a: Array
    """(N, 12, 12)."""
    b: Array
    """(N, 12, 4)."""
    q: Array
    """(N, 12, 12)."""
    r: Array
    """(N, 4, 4)."""
    closed: Array
    """(N, 12, 12)."""
    gain: Array
    """(N, 4, 12)."""
    pull: Array
    """(N, 4, 12)."""
    inverse: Array
    """(N, 4, 4)."""
    to_go: Array
    """(N, 12, 12)."""


Product = tuple[Array, int]
"""A matrix and the first place of what it is multiplied with."""


class _Writer:
    """A tape while it is written."""

    def __init__(self, stages: int) -> None:
        self._first = first_places(stages)
        self._begins = [0]
        self._place: list[list[int]] = []
        self._value: list[list[float]] = []

    def at(self, block: int, k: int = 0, each: int = STATES) -> int:
        """First place of a stage's rows in a block."""
        return int(self._first[block]) + each * k

    def rows(self, to: int, base: int | None, *products: Product) -> None:
        """Add sums: a base, or zero, and some products of matrices with as many rows."""
        for i in range(len(products[0][0]) if products else STATES):
            terms = [
                (float(matrix[i, j]), first + j)
                for matrix, first in products
                for j in np.flatnonzero(matrix[i]).tolist()
            ]
            self._sum(to + i, ZERO if base is None else base + i, terms)

    def _sum(self, to: int, base: int, terms: Sequence[tuple[float, int]]) -> None:
        for first in range(0, max(len(terms), 1), PIECE):
            piece = list(terms[first : first + PIECE])
            # Never onto its own base: lanes of places that overlap are not taken together.
            last = first + PIECE >= len(terms)
            goal = to if last else ZERO + 1 + (first // PIECE) % 2
            piece += [(0.0, ZERO)] * (PIECE - len(piece))
            self._place.append([goal, base, *(place for _, place in piece)])
            self._value.append([value for value, _ in piece])
            base = goal

    def end(self) -> None:
        """End a part."""
        self._begins.append(len(self._place))

    def tape(self) -> Tape:
        """What has been written."""
        begins, place = np.array(self._begins, dtype=np.int64), np.array(self._place, dtype=np.uint32)
        return Tape(self._first, begins, place, np.array(self._value))


def tape_of(m: Matrices) -> Tape:
    """Tape of a model.

    The sweeps make the optimal states and inputs for the model's cost and the references, under the loads or
    without. The balance of a stage makes what :func:`~napf_mpc.solvers.kernel_sweep.stationarity` compares,
    from the model's own matrices; stages are to be taken from the last to the first.
    """
    write = _Writer(len(m.a))
    for k in range(len(m.a)):
        write.rows(write.at(LINEAR, k), None, (-m.q[k], write.at(REFERENCE, k)))
    for loaded in (False, True):
        _sweep(write, m, loaded)
        write.end()
    for k in range(len(m.a)):
        _balance(write, m, k)
        write.end()
    return write.tape()


def _sweep(write: _Writer, m: Matrices, loaded: bool) -> None:
    n = len(m.a)
    for k in range(n - 1, -1, -1):
        terms = [(-np.eye(STATES), write.at(LOADS, k, BOTH))] if loaded else []
        if k + 1 < n:
            terms.append((m.closed[k + 1].T, write.at(COST, k + 1)))
            if loaded:
                terms.append((m.gain[k + 1].T, write.at(LOADS, k + 1, BOTH) + STATES))
        write.rows(write.at(COST, k), write.at(LINEAR, k), *terms)
    for k in range(n):
        before, inputs = _before(write, k), write.at(PUSH, k, INPUTS)
        terms = [(-m.pull[k], write.at(COST, k))]
        if loaded:
            terms.append((m.inverse[k], write.at(LOADS, k, BOTH) + STATES))
        write.rows(inputs, None, *terms, (-m.gain[k], before))
        write.rows(write.at(PLAN, k), None, (m.a[k], before), (m.b[k], inputs))


def _balance(write: _Writer, m: Matrices, k: int) -> None:
    plan, inputs, gradient = write.at(PLAN, k), write.at(PUSH, k, INPUTS), write.at(GRADIENT, k)
    write.rows(gradient, write.at(COST, k), (m.to_go[k], plan))
    write.rows(write.at(WEIGHED), None, (m.q[k], plan))
    write.rows(write.at(WEIGHED) + STATES, None, (m.r[k], inputs))
    beyond = m.a[k + 1].T if k + 1 < len(m.a) else np.zeros((STATES, STATES))
    write.rows(write.at(PULLED), None, (beyond, write.at(GRADIENT, k + 1)))
    write.rows(write.at(PULLED) + STATES, None, (m.b[k].T, gradient))
    # The other way round than in the sweep: the same sum twice would prove nothing.
    write.rows(write.at(MOVED), None, (m.b[k], inputs), (m.a[k], _before(write, k)))


def _before(write: _Writer, k: int) -> int:
    """Place of the state at the beginning of a stage."""
    return write.at(PLAN, k - 1) if k > 0 else write.at(START)


@compiled_bare
def play(tape: Tape, part: int, plane: Array) -> None:
    """Make the sums of one part of a tape, in all lanes of a plane."""
    for s in range(tape.begins[part], tape.begins[part + 1]):
        to, base = tape.place[s, 0], tape.place[s, 1]
        c0, c1, c2, c3 = tape.place[s, 2], tape.place[s, 3], tape.place[s, 4], tape.place[s, 5]
        v0, v1, v2, v3 = tape.value[s, 0], tape.value[s, 1], tape.value[s, 2], tape.value[s, 3]
        for lane in range(plane.shape[1]):
            total = plane[base, lane] + v0 * plane[c0, lane]
            total += v1 * plane[c1, lane]
            total += v2 * plane[c2, lane]
            plane[to, lane] = total + v3 * plane[c3, lane]
