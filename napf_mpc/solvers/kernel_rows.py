"""Rows of many programs gathered into one table: all kinds alike, stage after stage, slacks as groups.

A *family* is one row of a block at all stages. Its coefficients, bounds and signals stand stage by stage, so
that loops over the stages run over neighbours in memory; where everything stands is known from the layout.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.constraint import SIGNALS
from napf_mpc.jit import compiled
from napf_mpc.qp import STATES, Array, Index, Layout
from napf_mpc.solvers.kernel_signals import FIRST, KINDS
from napf_mpc.solvers.kernel_tape import Small

WIDTH = 4
"""Signals that a row may use: positions, velocities and attitudes leave the last one empty."""
LOW, HIGH = WIDTH, WIDTH + 1
"""Places of the bounds in a row's numbers, behind its coefficients."""
W1, W2 = 0, 1
"""Places of a group's prices."""


class RowPlaces(NamedTuple):
    """Where rows and slacks stand, for all programs of a layout; row ``f N + k`` is family f's at stage k."""

    signal: Small
    """(4, row) signals of each row; a coefficient is zero where there is none."""
    stage: Small
    """(row,)."""
    group: Small
    """(row,) group that shares a slack; hard rows are in the last N groups."""
    y_low: Small
    """(row,) where the multiplier of its lower bound goes."""
    y_high: Small
    """(row,)."""
    axis: Small
    """(family, 4) places of its signals, as rows of the signals (13, N)."""
    wide: Index
    """(family,) whether the last signal is used."""
    shelf: Small
    """(family,) its groups, as a row of the slacks (groups / N, N)."""
    slack_z: Small
    """(soft group,) where its slack goes."""
    slack_y: Small
    """(soft group,) where the multiplier of the slack's sign goes."""
    lonely: NDArray[np.bool_]
    """(family,) whether each row has a slack to itself."""
    owner: Small
    """(multipliers,) row of each multiplier."""
    span: Index
    """(2 x blocks, 2) where the multipliers of the rows of each block and side begin and end."""

    @classmethod
    def of(cls, layout: Layout, place: Index) -> RowPlaces:
        """Places for a layout; ``place`` (13,) is the order of the signals."""
        n = layout.stages
        stage = np.arange(n)
        axis, wide, shelf, shelves = [], [], [], 0
        y_low, y_high, slack_z, slack_y, lonely, span, y = [], [], [], [], [], [], STATES * n
        for (signal, count, per_stage, low, high), slacks in zip(layout.kinds, layout.slacks, strict=True):
            first, width = int(FIRST[KINDS.index(signal)]), len(SIGNALS[signal])
            copies = low + high if per_stage else 1
            upper = y + (copies - 1) * count * n
            for j in range(count):
                axis.append([*place[first : first + width], *[place[first]] * (WIDTH - width)])
                wide.append(width == WIDTH)
                lonely.append(per_stage == count)
                shelf.append(-1 if not per_stage else shelves + (j if per_stage == count else 0))
                y_low.append(y + stage * count + j)
                y_high.append(upper + stage * count + j)
            for _ in range(copies):
                span.append((y, y + count * n))
                y += count * n
            for s in range(per_stage):
                slack_z.append(slacks.start + stage * per_stage + s)
                slack_y.append(y + stage * per_stage + s)
            y, shelves = y + per_stage * n, shelves + per_stage
        axes = np.array(axis, dtype=np.int64).reshape(-1, WIDTH)
        rack = np.array(shelf, dtype=np.int64)
        rack[rack < 0] = shelves

        def small(values: object) -> Small:
            return np.ascontiguousarray(np.array(values).ravel(), dtype=np.uint32)

        owner = np.zeros(layout.sparsity.constraints, dtype=np.uint32)
        rows = np.arange(len(axes) * n)
        for places in (y_low, y_high):
            owner[np.array(places, dtype=np.int64).ravel()] = rows
        return cls(
            np.ascontiguousarray((axes.T[:, :, None] * n + stage).reshape(WIDTH, -1), dtype=np.uint32),
            small(np.tile(stage, len(axes))),
            small(rack[:, None] * n + stage),
            small(y_low), small(y_high),
            axes.astype(np.uint32), np.array(wide, dtype=np.int64), small(rack),
            small(slack_z), small(slack_y), np.array(lonely, dtype=np.bool_),
            owner, np.array(span, dtype=np.int64).reshape(-1, 2),
        )  # fmt: skip


class RowTable(NamedTuple):
    """Rows ``low <= coef . signals <= high`` of some programs, and prices of their slacks."""

    number: Array
    """(program, 6, row) coefficients and bounds; a bound that is missing is infinite."""
    plane: Array
    """(program, 6, family, N) the same memory."""
    price: Array
    """(program, 2, soft group) linear and quadratic price of each slack over its stage."""
    shelves: Array
    """(program, 2, soft group / N, N) the same memory."""
    sound: Index
    """(program,) whether all its numbers are."""

    @classmethod
    def empty(cls, programs: int, families: int, shelves: int, stages: int) -> RowTable:
        """Room for a number of programs."""
        plane = np.zeros((programs, HIGH + 1, families, stages))
        prices = np.zeros((programs, 2, shelves, stages))
        return cls(
            plane.reshape(programs, HIGH + 1, families * stages), plane,
            prices.reshape(programs, 2, shelves * stages), prices, np.ones(programs, dtype=np.int64),
        )  # fmt: skip


@compiled
def gather(
    table: RowTable, programs: Index, family: int, shelf: int, step_s: Array,
    jac: Array, lower: Array, upper: Array, w1: Array, w2: Array,
) -> None:  # fmt: skip
    """Write one block's rows of some programs, see :class:`~napf_mpc.constraints.constraint.LinearRows`.

    Parameters
    ----------
    table : RowTable
        Where the rows go; the programs' marks of soundness must be set.
    programs : array of int, shape (programs,)
        Their places in the batch.
    family, shelf : int
        The block's first family, and its first row of the slacks (groups / N, N).
    step_s : array, shape (N,)
        Length of each stage [s].
    jac : array, shape (run, uav, N, m, dim)
        Coefficients.
    lower, upper : array, shape (run, uav, N, m)
        Bounds, or without entries if there are none.
    w1, w2 : array, shape (run, uav, N, slacks a stage)
        Prices, or without entries for hard rows.
    """
    uavs, stages, count, dim = jac.shape[1], jac.shape[2], jac.shape[3], jac.shape[4]
    has_lower, has_upper, per_stage = lower.size > 0, upper.size > 0, w1.shape[3]
    for u in range(len(programs)):
        run, uav, faults = programs[u] // uavs, programs[u] % uavs, 0
        # In the order of memory: what is read comes from afar, what is written stays near.
        for k in range(stages):
            for j in range(count):
                f = max(family, 0) + j
                for d in range(dim):
                    coefficient = jac[run, uav, k, j, d]
                    # NaN fails every comparison.
                    faults += not abs(coefficient) < np.inf
                    table.plane[u, d, f, k] = coefficient
        for k in range(stages):
            for j in range(count):
                f = max(family, 0) + j
                low = lower[run, uav, k, j] if has_lower else -np.inf
                high = upper[run, uav, k, j] if has_upper else np.inf
                faults += not (low < np.inf and high > -np.inf and (per_stage > 0 or low <= high))
                table.plane[u, LOW, f, k], table.plane[u, HIGH, f, k] = low, high
        for s in range(per_stage):
            g = max(shelf, 0) + s
            for k in range(stages):
                linear, square = w1[run, uav, k, s], w2[run, uav, k, s]
                faults += not (0.0 <= linear < np.inf and 0.0 <= square < np.inf)
                table.shelves[u, W1, g, k] = linear * step_s[k]
                table.shelves[u, W2, g, k] = square * step_s[k]
        if faults > 0:
            table.sound[u] = 0
