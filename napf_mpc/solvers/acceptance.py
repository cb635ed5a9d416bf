"""Whether an answer may be flown: no status is trusted alone."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.qp import INPUTS, STATES, Array, HorizonModel, QpError, QpStatus
from napf_mpc.solvers.batch import STATUSES, BatchResult
from napf_mpc.vehicle.plant import plain

Mask = NDArray[np.bool_]

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
    finite = np.ones(result.status.shape, dtype=np.bool_)
    z = plain(result.z)
    for values in (result.states, result.inputs, *result.slacks):
        if values.size and not _is_part(values, result.z):
            _all_finite(values, finite)
    why = np.empty(result.status.shape, dtype=np.int8)
    _judge(
        np.ascontiguousarray(result.status), finite, z, plain(result.inputs), plain(result.y),
        result.states.shape[-2] * STATES, plain(result.primal), plain(result.dual),
        plain(result.complementarity), limits.input_matrix, limits.input_lower, limits.input_upper,
        limits.primal, limits.dual, limits.complementarity, why,
    )  # fmt: skip
    return why


def _is_part(values: Array, whole: Array) -> bool:
    """Whether an array is a view of another, or both of the same."""
    return values.base is whole or (whole.base is not None and values.base is whole.base)


# Codes as plain numbers, for the compiled loop.
_SKIPPED, _SOLVED = STATUSES.index(QpStatus.SKIPPED), STATUSES.index(QpStatus.SOLVED)
_NONE, _IS_SKIPPED, _BY_STATUS, _BY_NUMBERS, _BY_INPUT, _BY_PRIMAL, _BY_DUAL, _BY_PRODUCT = map(int, Refusal)


@compiled_bare
def _judge(
    status: NDArray[np.int8], finite: Mask, z: Array, inputs: Array, y: Array, first: int, primal: Array,
    dual: Array, complementarity: Array, matrix: Array, lower: Array, upper: Array, most_primal: float,
    most_dual: float, most_product: float, why: NDArray[np.int8],
) -> None:  # fmt: skip
    """Write the first test (run, uav) that fails; each must hold to pass, and NaN fails all of them.

    Multipliers of the rows begin at ``first``; a mark of what is finite says nothing yet of z.
    """
    for run in range(why.shape[0]):
        for uav in range(why.shape[1]):
            code = _NONE
            if status[run, uav] == _SKIPPED:
                code = _IS_SKIPPED
            elif status[run, uav] != _SOLVED:
                code = _BY_STATUS
            elif not (finite[run, uav] and _is_finite(z, run, uav)):
                code = _BY_NUMBERS
            elif not _inputs_inside(inputs, run, uav, matrix, lower, upper):
                code = _BY_INPUT
            elif not primal[run, uav] <= most_primal:
                code = _BY_PRIMAL
            elif not dual[run, uav] <= most_dual:
                code = _BY_DUAL
            elif not _balanced(y, run, uav, first, complementarity[run, uav], most_product):
                code = _BY_PRODUCT
            why[run, uav] = code


@compiled_bare
def _is_finite(z: Array, run: int, uav: int) -> bool:
    """Whether all numbers z[run, uav] are finite."""
    lost = 0
    for i in range(z.shape[2]):
        # NaN fails every comparison.
        lost += not abs(z[run, uav, i]) < np.inf
    return lost == 0


@compiled_bare
def _inputs_inside(inputs: Array, run: int, uav: int, matrix: Array, lower: Array, upper: Array) -> bool:
    """Whether all inputs [run, uav] (N, 4) keep rows within a tolerance of bounds; NaN does not."""
    keeps = True
    for k in range(inputs.shape[2]):
        for i in range(len(lower)):
            value = 0.0
            for axis in range(inputs.shape[3]):
                value += matrix[i, axis] * inputs[run, uav, k, axis]
            keeps = keeps and lower[i] - INPUT_TOLERANCE_N <= value <= upper[i] + INPUT_TOLERANCE_N
    return keeps


@compiled_bare
def _all_finite(values: Array, finite: Mask) -> None:
    """Clear ``finite`` (run, uav) where a number of values (run, uav, N, m) is not."""
    for run in range(values.shape[0]):
        for uav in range(values.shape[1]):
            for k in range(values.shape[2]):
                for i in range(values.shape[3]):
                    if not np.isfinite(values[run, uav, k, i]):
                        finite[run, uav] = False


@compiled_bare
def _balanced(y: Array, run: int, uav: int, first: int, complementarity: float, limit: float) -> bool:
    """Whether complementarity is small beside the multipliers y[run, uav] of the rows, which begin somewhere.

    A row that is off by what a row may be off costs its multiplier times that. NaN is never balanced.
    """
    missing = 0
    for i in range(first, y.shape[2]):
        missing += y[run, uav, i] != y[run, uav, i]
    push = 0.0
    if not complementarity <= limit:
        for i in range(first, y.shape[2]):
            push = max(push, abs(y[run, uav, i]))
    return missing == 0 and complementarity <= limit + PRIMAL_LIMIT * push


def accepted(result: BatchResult, limits: AcceptanceLimits) -> NDArray[np.bool_]:
    """Whether each answer (run, uav) may be flown.

    It was solved, all its numbers are finite, every input of the plan is inside the limits, and the residuals
    that we computed on unscaled data are under the limits.
    """
    return np.asarray(refusals(result, limits) == Refusal.NONE)
