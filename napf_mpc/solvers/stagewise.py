"""The order in which a solver of optimal control problems wants variables and rows: stage by stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napf_mpc.qp import INPUTS, STATES, Index, Layout
from napf_mpc.quadratic_program import Sparsity


@dataclass(frozen=True, eq=False)
class Stages:
    """A program in stages j = 0 .. J: of each its states, then its controls; its dynamics, then its rows.

    The dynamics of a stage give the next one's states.
    """

    variables: Index
    """(n,) the program's variables in the new order."""
    rows: Index
    """(m,) the program's rows in the new order."""
    states: list[int]
    """(J + 1) states of each stage."""
    controls: list[int]
    """(J + 1) controls, slacks included; none in the last."""
    others: list[int]
    """(J + 1) rows that are not dynamics."""


def single_stage(sparsity: Sparsity) -> Stages:
    """A program without dynamics: all its variables are controls of the first of two stages."""
    n, m = sparsity.variables, sparsity.constraints
    return Stages(np.arange(n), np.arange(m), [0, 0], [n, 0], [m, 0])


def stagewise(layout: Layout) -> Stages:
    """Order of a horizon's program.

    Stage 0 has the first input and no state, since the state now is a number; stage j the state at its begin,
    the input during it, and the slacks of the rows on either. One empty stage more ends it: the last may have
    no controls, and the rows on the last state have slacks.

    Parameters
    ----------
    layout : Layout
        Where everything stands.

    Returns
    -------
    Stages
        With N + 2 stages.
    """
    stage = np.arange(layout.stages)
    whose = [np.repeat(stage + 1, STATES), np.repeat(stage, INPUTS)]
    control = [np.zeros(STATES * len(stage), dtype=bool), np.ones(INPUTS * len(stage), dtype=bool)]
    of_row = [np.repeat(stage, STATES)]
    for signal, count, slacks, has_lower, has_upper in layout.kinds:
        own = stage if signal == "input" else stage + 1
        of_row += [np.repeat(own, count)] * (has_lower + has_upper if slacks else 1)
        whose.append(np.repeat(own, slacks))
        of_row.append(whose[-1])
        control.append(np.ones(len(whose[-1]), dtype=bool))
    variable_stage, is_control, row_stage = map(np.concatenate, (whose, control, of_row))
    other = np.arange(len(row_stage)) >= STATES * len(stage)

    def counts(stages: Index) -> list[int]:
        return [int(count) for count in np.bincount(stages, minlength=layout.stages + 2)]

    return Stages(
        np.lexsort((is_control, variable_stage)), np.lexsort((other, row_stage)),
        counts(variable_stage[~is_control]), counts(variable_stage[is_control]), counts(row_stage[other]),
    )  # fmt: skip
