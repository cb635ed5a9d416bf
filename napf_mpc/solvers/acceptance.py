"""Whether an answer may be flown: no status is trusted alone."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.qp import INPUTS, STATES, Array, HorizonModel, QpError, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult

PRIMAL_LIMIT = 0.01
"""Largest violation of a row [m, m/s, rad or N]: a centimetre is a thirtieth of a UAV's radius, a centimetre
per second a tenth of the error of a GNSS velocity."""
REFERENCE_SHIFT_M = 0.1
"""What the other residuals may amount to [m]: an answer with a gradient left over is the exact one for other
references, and this is how far those may be from the ones given."""
INPUT_TOLERANCE_N = 1e-3
"""How far a rotor thrust may lie outside its limits [N]: solvers meet hard rows to some digits, and the inner
loop clamps; on a vehicle of 1 kg it is a millimetre per second squared."""


class Refusal(IntEnum):
    """Why an answer may not be flown, the first that applies."""

    NONE = 0
    """It may."""
    SKIPPED = 1
    """The run is masked."""
    STATUS = 2
    """The solver does not claim to have solved it."""
    NOT_FINITE = 3
    """A number of the answer is not finite."""
    INPUT = 4
    """An input of the plan is outside the limits."""
    PRIMAL = 5
    """A row is violated, dynamics included."""
    DUAL = 6
    """The cost's gradient is not balanced by the rows: not the optimum."""
    COMPLEMENTARITY = 7
    """A row pushes without being touched: not the optimum."""


@dataclass(frozen=True, eq=False)
class AcceptanceLimits:
    """What an answer must keep to be flown."""

    input_matrix: Array
    """(k, 4) rows on the input about hover; the mixer's inverse gives rotor thrusts."""
    input_lower: Array
    """(k,) [N] for rotor thrusts."""
    input_upper: Array
    """(k,)."""
    primal: float
    """Largest row violation [m, m/s, rad or N]."""
    dual: float
    """Largest entry of the Lagrangian's gradient [cost per unit]."""
    complementarity: float
    """Largest multiplier times gap [cost]."""

    @classmethod
    def of(
        cls, model: HorizonModel, input_matrix: ArrayLike, input_lower: ArrayLike, input_upper: ArrayLike
    ) -> AcceptanceLimits:
        """Limits in the cost's own scale, taken from the model's position weights.

        A gradient of ``Q_k d`` at stage k is that of references shifted by d there; its limit is that of
        :data:`REFERENCE_SHIFT_M` at a stage of mean weight. Flying the whole horizon that far beside the
        references is the cost that one row's complementarity may amount to.

        Raises
        ------
        QpError
            If the input's limits do not fit or are not in order, or the position has no weight.
        """
        matrix = np.asarray(input_matrix, dtype=float)
        lower, upper = np.asarray(input_lower, dtype=float), np.asarray(input_upper, dtype=float)
        fits = matrix.ndim == 2 and matrix.shape[1] == INPUTS
        if not (fits and lower.shape == upper.shape == matrix.shape[:1]):
            raise QpError(f"input limits {lower.shape}, {upper.shape} do not fit rows {matrix.shape}")
        if not (np.isfinite(matrix).all() and (lower <= upper).all()):
            raise QpError("input limits must be finite rows with lower <= upper")
        # The terminal weight stands for all time after the horizon and would outweigh it.
        weights = model.q[:-1, 0, 0] if model.stages > 1 else model.q[:, 0, 0]
        dual = REFERENCE_SHIFT_M * float(weights.mean())
        cost = 0.5 * REFERENCE_SHIFT_M**2 * float(weights.sum())
        if not dual > 0.0:
            raise QpError("the position along x has no weight")
        return cls(matrix, lower, upper, PRIMAL_LIMIT, dual, cost)


def refusals(result: BatchResult, limits: AcceptanceLimits) -> NDArray[np.int8]:
    """Why each answer may not be flown.

    Parameters
    ----------
    result : BatchResult
        Answers of any solver.
    limits : AcceptanceLimits
        What they must keep.

    Returns
    -------
    array of int8, shape (run, uav)
        Codes of :class:`Refusal`.
    """
    thrusts = np.zeros((*result.inputs.shape[:-1], len(limits.input_lower)))
    for axis in range(INPUTS):
        thrusts += limits.input_matrix[:, axis] * result.inputs[..., axis, None]
    inside = (thrusts >= limits.input_lower - INPUT_TOLERANCE_N).all(axis=(2, 3))
    inside &= (thrusts <= limits.input_upper + INPUT_TOLERANCE_N).all(axis=(2, 3))
    finite = np.isfinite(result.states).all(axis=(2, 3)) & np.isfinite(result.inputs).all(axis=(2, 3))
    for slack in result.slacks:
        finite &= np.isfinite(slack).all(axis=(2, 3))
    # A row that is off by what a row may be off costs its multiplier times that.
    push = np.abs(result.y[..., result.states.shape[-2] * STATES :]).max(-1, initial=0.0)
    # Each test must hold to pass: NaN fails all of them.
    tests = (
        (Refusal.SKIPPED, result.status != STATUSES.index(QpStatus.SKIPPED)),
        (Refusal.STATUS, result.status == STATUSES.index(QpStatus.SOLVED)),
        (Refusal.NOT_FINITE, finite),
        (Refusal.INPUT, inside),
        (Refusal.PRIMAL, result.primal <= limits.primal),
        (Refusal.DUAL, result.dual <= limits.dual),
        (Refusal.COMPLEMENTARITY, result.complementarity <= limits.complementarity + PRIMAL_LIMIT * push),
    )
    why = np.full(result.status.shape, Refusal.NONE, dtype=np.int8)
    for refusal, passed in reversed(tests):
        why[~passed] = refusal
    return why


def accepted(result: BatchResult, limits: AcceptanceLimits) -> NDArray[np.bool_]:
    """Whether each answer (run, uav) may be flown.

    It was solved, all its numbers are finite, every input of the plan is inside the limits, and the residuals
    that we computed on unscaled data are under the limits.
    """
    return np.asarray(refusals(result, limits) == Refusal.NONE)
