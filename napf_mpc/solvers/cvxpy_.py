"""cvxpy as a readable second opinion: slow, for tests and for reading what the other solvers are given."""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from napf_mpc.quadratic_program import QpStatus, QuadraticProgram, Sparsity, Values
from napf_mpc.solvers.solver import Answer, MakeBackend, Warm, tried

DEFAULTS = {"solver": "CLARABEL", "tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
"""Tight, as a second opinion should be."""

_STATUS = {
    cp.OPTIMAL: QpStatus.SOLVED,
    cp.OPTIMAL_INACCURATE: QpStatus.INACCURATE,
    cp.INFEASIBLE: QpStatus.PRIMAL_INFEASIBLE,
    cp.INFEASIBLE_INACCURATE: QpStatus.PRIMAL_INFEASIBLE,
    cp.UNBOUNDED: QpStatus.DUAL_INFEASIBLE,
    cp.UNBOUNDED_INACCURATE: QpStatus.DUAL_INFEASIBLE,
    cp.USER_LIMIT: QpStatus.MAX_ITERATIONS,
}


def maker(name: str, **settings: Any) -> MakeBackend:
    """Maker of cvxpy back-ends; settings are those of ``cvxpy.Problem.solve``, Clarabel by default.

    Raises
    ------
    TypeError
        For a setting that cvxpy's solver does not know, or a value that is none.
    """
    chosen = settings if "solver" in settings else {**DEFAULTS, **settings}
    return tried(lambda sparsity: CvxpyBackend(sparsity, chosen), settings)


class CvxpyBackend:
    """Writes the program as on paper, each time anew."""

    def __init__(self, sparsity: Sparsity, settings: dict[str, Any]) -> None:
        self._sparsity, self._settings = sparsity, settings

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers; the guess is not used."""
        program = QuadraticProgram.of_values(self._sparsity, values)
        a, lower, upper = program.a, program.lower, program.upper
        equal = lower == upper
        above = ~equal & np.isfinite(lower)
        below = ~equal & np.isfinite(upper)
        z = cp.Variable(len(program.q))
        cost = 0.5 * cp.quad_form(z, cp.psd_wrap(program.p)) + program.q @ z
        given: list[tuple[NDArray[np.bool_], float, Any]] = []
        if equal.any():
            given.append((equal, 1.0, a[equal] @ z == lower[equal]))
        if above.any():
            given.append((above, -1.0, a[above] @ z >= lower[above]))
        if below.any():
            given.append((below, 1.0, a[below] @ z <= upper[below]))
        problem = cp.Problem(cp.Minimize(cost), [constraint for _, _, constraint in given])
        problem.solve(**self._settings)
        status = _STATUS.get(problem.status, QpStatus.FAILED)
        if z.value is None:
            return Answer.none(self._sparsity, status, f"cvxpy: {problem.status}")
        y = np.zeros(len(lower))
        for rows, sign, constraint in given:
            y[rows] += sign * constraint.dual_value
        message = "" if status is QpStatus.SOLVED else f"cvxpy: {problem.status}"
        return Answer(status, np.asarray(z.value, dtype=float), y, message=message)
