"""Rows of many programs gathered into one table: finite ones only, all kinds alike, slacks as groups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled
from napf_mpc.qp import Array, Index

WIDTH = 4
"""Signals that a row may use: positions, velocities and attitudes leave the last one empty."""


class RowTable(NamedTuple):
    """Rows ``low <= coef . signals[at] <= high`` of some programs, and the groups that share a slack."""

    coef: Array
    """(program, row, 4)."""
    at: Index
    """(program, row, 4) places in the signals."""
    low: Array
    """(program, row), -inf where there is none."""
    high: Array
    """(program, row)."""
    group: Index
    """(program, row) slack of the row; the last group of the table for hard rows."""
    y_low: Index
    """(program, row) where the multiplier of the lower bound goes."""
    y_high: Index
    """(program, row)."""
    w1: Array
    """(program, group) linear price over the stage; infinite for the group of hard rows."""
    w2: Array
    """(program, group) quadratic price."""
    slack_z: Index
    """(program, group) where the slack goes."""
    slack_y: Index
    """(program, group) where the multiplier of its sign goes."""
    rows: Index
    """(program,) rows in use."""
    groups: Index
    """(program,) groups in use, the hard one not counted."""
    usable: NDArray[np.bool_]
    """(program,) whether all numbers are sound."""

    @classmethod
    def empty(cls, programs: int, rows: int, groups: int) -> RowTable:
        """Room for a number of programs."""
        row, group = (programs, max(rows, 1)), (programs, groups + 1)
        floats, places = np.float64, np.int64
        return cls(
            np.empty((*row, WIDTH), floats), np.empty((*row, WIDTH), places),
            np.empty(row, floats), np.empty(row, floats),
            np.empty(row, places), np.empty(row, places), np.empty(row, places),
            np.empty(group, floats), np.empty(group, floats), np.empty(group, places), np.empty(group, places),
            np.empty(programs, places), np.empty(programs, places), np.empty(programs, np.bool_),
        )  # fmt: skip


@compiled
def gather(
    table: RowTable, programs: Index, places: Index, step_s: Array,
    jac: Array, lower: Array, upper: Array, w1: Array, w2: Array,
    has_lower: bool, has_upper: bool, z_at: int, y_lower: int, y_upper: int, y_slack: int, y: Array,
) -> None:  # fmt: skip
    """Append one block's rows to the table, and fill in the multipliers of slacks that stay at zero.

    Parameters
    ----------
    table : RowTable
        Where the rows go.
    programs : array of int, shape (programs of the table,)
        Their places in the batch.
    places : array of int, shape (4,)
        Places in the signals of this kind's axes at the first stage.
    step_s : array, shape (N,)
        Length of each stage [s].
    jac, lower, upper : array, shapes (batch, N, m, dim) and (batch, N, m)
        As in :class:`~napf_mpc.constraints.constraint.LinearRows`; a missing bound is an empty array.
    w1, w2 : array, shape (batch, N, slacks a stage)
        Prices; without slacks for hard rows.
    has_lower, has_upper : bool
        Which bounds there are.
    z_at, y_lower, y_upper, y_slack : int
        Where the block's slacks and multipliers start in the layout.
    y : array, shape (batch, multipliers)
        Multipliers of all rows.
    """
    stages, count, dim = jac.shape[1], jac.shape[2], jac.shape[3]
    per_stage = w1.shape[2]
    hard = table.w1.shape[1] - 1
    for u in range(len(programs)):
        i, row, group, sound = programs[u], table.rows[u], table.groups[u], True
        for k in range(stages):
            for s in range(per_stage):
                linear, square = w1[i, k, s], w2[i, k, s]
                # NaN fails every comparison.
                sound = sound and 0.0 <= linear < np.inf and 0.0 <= square < np.inf
                y[i, y_slack + k * per_stage + s] = -linear * step_s[k]
            shared = -1
            for j in range(count):
                low = lower[i, k, j] if has_lower else -np.inf
                high = upper[i, k, j] if has_upper else np.inf
                sound = sound and low < np.inf and high > -np.inf and (per_stage > 0 or low <= high)
                for d in range(dim):
                    sound = sound and np.isfinite(jac[i, k, j, d])
                if low == -np.inf and high == np.inf:
                    continue
                for d in range(WIDTH):
                    table.coef[u, row, d] = jac[i, k, j, d] if d < dim else 0.0
                    table.at[u, row, d] = places[d] + k if d < dim else 0
                table.low[u, row], table.high[u, row] = low, high
                table.y_low[u, row] = y_lower + k * count + j
                table.y_high[u, row] = y_upper + k * count + j
                if per_stage == 0:
                    table.group[u, row] = hard
                elif per_stage < count and shared >= 0:
                    table.group[u, row] = shared
                else:
                    slack = k * per_stage + (j if per_stage == count else 0)
                    price = (i, k, j if per_stage == count else 0)
                    table.w1[u, group], table.w2[u, group] = w1[price] * step_s[k], w2[price] * step_s[k]
                    table.slack_z[u, group], table.slack_y[u, group] = z_at + slack, y_slack + slack
                    table.group[u, row] = group
                    shared = group
                    group += 1
                row += 1
        table.rows[u], table.groups[u] = row, group
        table.usable[u] = table.usable[u] and sound
