"""PIQP through its own interface: the workspace is kept, and only what has changed is handed over.

R. Schwan, Y. Jiang, D. Kuhn, C. N. Jones, "PIQP: A proximal interior-point quadratic programming solver",
CDC 2023.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import piqp
from numpy.typing import NDArray
from scipy import sparse

from napf_mpc.quadratic_program import Array, Index, QpStatus, Sparsity, Values
from napf_mpc.solvers.solver import Answer, MakeBackend, Warm

Mask = NDArray[np.bool_]

DEFAULTS: dict[str, Any] = {"eps_abs": 1e-9, "eps_rel": 1e-9, "check_duality_gap": True}
"""Settings that differ from the solver's own defaults."""
_STATUS = {
    piqp.PIQP_SOLVED: QpStatus.SOLVED,
    piqp.PIQP_MAX_ITER_REACHED: QpStatus.MAX_ITERATIONS,
    piqp.PIQP_PRIMAL_INFEASIBLE: QpStatus.PRIMAL_INFEASIBLE,
    piqp.PIQP_DUAL_INFEASIBLE: QpStatus.DUAL_INFEASIBLE,
}
_UNBOUNDED = 1e30
"""PIQP's infinity."""


def maker(name: str, **settings: Any) -> MakeBackend:
    """Maker of back-ends; settings are the solver's own.

    Raises
    ------
    TypeError
        For a setting that it does not know.
    """
    known = piqp.SparseSolver().settings
    for setting in settings:
        if not hasattr(known, setting):
            raise TypeError(f"{name} has no setting {setting!r}")
    chosen = {**DEFAULTS, **settings}
    return lambda sparsity: PiqpBackend(sparsity, chosen)


class PiqpBackend:
    """A workspace for programs of one sparsity whose equalities stay equalities."""

    def __init__(self, sparsity: Sparsity, settings: dict[str, Any]) -> None:
        self._sparsity, self._settings = sparsity, settings
        self._p: Any = sparse.csc_matrix(
            (np.zeros(len(sparsity.p_rows)), sparsity.p_rows, sparsity.p_starts),
            shape=(sparsity.variables, sparsity.variables),
        )
        self._solver: Any = None
        self._equal = np.zeros(0, dtype=bool)

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers; the guess is not used."""
        equal = values.lower == values.upper
        fresh = self._solver is None or not np.array_equal(equal, self._equal)
        if fresh:
            self._start(equal)
        equalities, inequalities, solver = self._equalities, self._inequalities, self._solver
        self._p.data[:] = values.p
        # PIQP writes a complaint for every row without any bound. It gets an empty one instead.
        lower, upper = values.lower[~equal], values.upper[~equal]
        idle = np.isneginf(lower) & np.isposinf(upper)
        same_a = equalities.take(values.a, np.zeros(int(equal.sum()), dtype=bool)) and not fresh
        same_g = inequalities.take(values.a, idle) and not fresh
        given = (
            self._p, values.q, None if same_a else equalities.matrix, values.lower[equal],
            None if same_g else inequalities.matrix,
            np.where(idle, -1.0, np.maximum(lower, -_UNBOUNDED)),
            np.where(idle, 1.0, np.minimum(upper, _UNBOUNDED)),
        )  # fmt: skip
        (solver.setup if fresh else solver.update)(*given)
        status = solver.solve()
        found = solver.result
        if status != piqp.PIQP_SOLVED:
            said = _STATUS.get(status, QpStatus.FAILED)
            return Answer.none(self._sparsity, said, f"piqp: {str(status).rpartition('.')[2].lower()}")
        y = np.empty(self._sparsity.constraints)
        y[equal], y[~equal] = found.y, np.where(idle, 0.0, found.z_u - found.z_l)
        return Answer(QpStatus.SOLVED, np.array(found.x), y, int(found.info.iter))

    def _start(self, equal: Mask) -> None:
        self._equal = equal
        self._equalities = _Rows(self._sparsity, equal)
        self._inequalities = _Rows(self._sparsity, ~equal)
        self._solver = piqp.SparseSolver()
        for name, value in self._settings.items():
            setattr(self._solver.settings, name, value)


class _Rows:
    """Some rows of A as a matrix of their own."""

    def __init__(self, sparsity: Sparsity, kept: Mask) -> None:
        self._entries: Index = np.flatnonzero(kept[sparsity.a_rows])
        place = np.cumsum(kept) - 1
        columns = sparsity.a_columns[self._entries]
        starts = np.searchsorted(columns, np.arange(sparsity.variables + 1))
        self.matrix: Any = sparse.csc_matrix(
            (np.full(len(columns), np.nan), place[sparsity.a_rows[self._entries]], starts),
            shape=(int(kept.sum()), sparsity.variables),
        )

    def take(self, a: Array, idle: Mask) -> bool:
        """Take the entries of A, zero in idle rows; return whether they are those of before."""
        mine = np.where(idle[self.matrix.indices], 0.0, a[self._entries])
        same = np.array_equal(mine, self.matrix.data)
        self.matrix.data[:] = mine
        return same
