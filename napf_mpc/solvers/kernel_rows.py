"""Rows of many programs gathered into one table: finite ones only, all kinds alike, slacks as groups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from napf_mpc.jit import compiled
from napf_mpc.qp import Array, Index
from napf_mpc.solvers.kernel_signals import Small

WIDTH = 4
"""Signals that a row may use: positions, velocities and attitudes leave the last one empty."""
LOW, HIGH = WIDTH, WIDTH + 1
"""Places of the bounds in a row's numbers, behind its coefficients."""
GROUP, Y_LOW, Y_HIGH = WIDTH, WIDTH + 1, WIDTH + 2
"""Places in a row's places, behind those of its signals."""
W1, W2 = 0, 1
"""Places of the prices over a stage."""
SLACK_Z, SLACK_Y = 0, 1
"""Where a slack and the multiplier of its sign go."""
ROWS, GROUPS, USABLE = 0, 1, 2
"""Places of a program's counts."""


class RowTable(NamedTuple):
    """Rows ``low <= coef . signals[at] <= high`` of some programs, and the groups that share a slack."""

    number: Array
    """(program, row, 6) coefficients and bounds; a bound that is missing is infinite."""
    place: Small
    """(program, row, 7) signals, group, and where the multipliers of the bounds go; hard rows are in the last
    group of the table."""
    price: Array
    """(program, group, 2) linear and quadratic price of each slack over its stage."""
    put: Index
    """(program, group, 2) where each slack and the multiplier of its sign go."""
    size: Index
    """(program, 3) rows and groups in use, and whether all numbers are sound."""

    @classmethod
    def empty(cls, programs: int, rows: int, groups: int) -> RowTable:
        """Room for a number of programs."""
        # One to spare: a row is written before it is known to have no finite bound.
        rows += 1
        return cls(
            np.empty((programs, rows, HIGH + 1)),
            np.empty((programs, rows, Y_HIGH + 1), dtype=np.uint32),
            np.empty((programs, groups + 1, 2)),
            np.empty((programs, groups + 1, 2), dtype=np.int64),
            np.empty((programs, 3), dtype=np.int64),
        )


class Block(NamedTuple):
    """Arrays of one block of rows, see :class:`~napf_mpc.constraints.constraint.LinearRows`."""

    jac: Array
    """(run, uav, N, m, dim)."""
    lower: Array
    """(run, uav, N, m), or without entries if there is none."""
    upper: Array
    """(run, uav, N, m), or without entries if there is none."""
    w1: Array
    """(run, uav, N, slacks a stage), or without entries for hard rows."""
    w2: Array
    """The same."""


@compiled
def gather(
    table: RowTable, programs: Index, signals: Index, starts: Index, step_s: Array,
    blocks: tuple[Block, ...], y: Array,
) -> None:  # fmt: skip
    """Write the finite rows of some programs, and the multipliers of slacks that stay at zero.

    Parameters
    ----------
    table : RowTable
        Where the rows go.
    programs : array of int, shape (programs of the table,)
        Their places in the batch.
    signals : array of int, shape (block, 4)
        Places in the signals of each block's axes at the first stage.
    starts : array of int, shape (block, 4)
        Where each block's slacks and lower, upper and slack multipliers start in the layout.
    step_s : array, shape (N,)
        Length of each stage [s].
    blocks : tuple of Block
        Rows of all programs.
    y : array, shape (batch, multipliers)
        Multipliers of all rows.
    """
    for u in range(len(programs)):
        for e in range(2):
            table.size[u, e] = 0
        table.size[u, USABLE] = 1
    for b in range(len(blocks)):
        block = blocks[b]
        for u in range(len(programs)):
            gather_block(table, u, programs[u], signals, starts, b, step_s, block, y)


@compiled
def gather_block(
    table: RowTable, u: int, i: int, signals: Index, starts: Index, b: int, step_s: Array,
    block: Block, y: Array,
) -> None:  # fmt: skip
    """Append one block's rows of program i of the batch to place u of the table."""
    stages, count, dim = block.jac.shape[2], block.jac.shape[3], block.jac.shape[4]
    run, uav = i // block.jac.shape[1], i % block.jac.shape[1]
    has_lower, has_upper, per_stage = block.lower.size > 0, block.upper.size > 0, block.w1.shape[3]
    hard = table.price.shape[1] - 1
    row, group, sound = table.size[u, ROWS], table.size[u, GROUPS], True
    for k in range(stages):
        for s in range(per_stage):
            linear, square = block.w1[run, uav, k, s], block.w2[run, uav, k, s]
            # NaN fails every comparison.
            sound = sound and 0.0 <= linear < np.inf and 0.0 <= square < np.inf
            y[i, starts[b, 3] + k * per_stage + s] = -linear * step_s[k]
        shared = -1
        for j in range(count):
            low = block.lower[run, uav, k, j] if has_lower else -np.inf
            high = block.upper[run, uav, k, j] if has_upper else np.inf
            sound = sound and low < np.inf and high > -np.inf and (per_stage > 0 or low <= high)
            for d in range(dim):
                coefficient = block.jac[run, uav, k, j, d]
                sound = sound and -np.inf < coefficient < np.inf
                table.number[u, row, d] = coefficient
                table.place[u, row, d] = signals[b, d] + k
            if low == -np.inf and high == np.inf:
                continue
            for d in range(dim, WIDTH):
                table.number[u, row, d], table.place[u, row, d] = 0.0, 0
            table.number[u, row, LOW], table.number[u, row, HIGH] = low, high
            table.place[u, row, Y_LOW] = starts[b, 1] + k * count + j
            table.place[u, row, Y_HIGH] = starts[b, 2] + k * count + j
            if per_stage == 0:
                table.place[u, row, GROUP] = hard
            elif per_stage < count and shared >= 0:
                table.place[u, row, GROUP] = shared
            else:
                own = j if per_stage == count else 0
                table.price[u, group, W1] = block.w1[run, uav, k, own] * step_s[k]
                table.price[u, group, W2] = block.w2[run, uav, k, own] * step_s[k]
                table.put[u, group, SLACK_Z] = starts[b, 0] + k * per_stage + own
                table.put[u, group, SLACK_Y] = starts[b, 3] + k * per_stage + own
                table.place[u, row, GROUP] = group
                shared = group
                group += 1
            row += 1
    table.size[u, ROWS], table.size[u, GROUPS] = row, group
    if not sound:
        table.size[u, USABLE] = 0
