"""PIQP through its own interface, its workspace kept from program to program.

A kept workspace and a fresh one give answers that differ by less than the tolerance, not to the last bit.

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
"""Settings that the solver is given unless others are asked for; the gap's tolerances follow the others'."""
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
        For a setting that it does not know, or a value that is none.
    """
    chosen = {**DEFAULTS, **settings}
    for kind in ("abs", "rel"):
        chosen.setdefault(f"eps_duality_gap_{kind}", chosen[f"eps_{kind}"])
    known = piqp.SparseSolver().settings
    for setting, value in chosen.items():
        if setting.startswith("_") or not hasattr(known, setting):
            raise TypeError(f"{name} has no setting {setting!r}")
        try:
            setattr(known, setting, value)
        except TypeError as error:
            raise TypeError(f"{setting} = {value!r} is not a value of it") from error
        if setting.startswith("eps") and not value >= 0.0:
            raise TypeError(f"{setting} = {value!r}, must be >= 0")
    if not chosen.get("max_iter", 1) > 0:
        raise TypeError(f"max_iter = {chosen['max_iter']!r}, must be > 0")
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
        solver, self._solver = self._solver, None  # kept only if nothing comes in between
        fresh = solver is None or not np.array_equal(equal, self._equal)
        if fresh:
            solver = self._start(equal)
        # PIQP writes a complaint for every row without any bound. It gets an empty one instead.
        lower, upper = values.lower[~equal], values.upper[~equal]
        idle = np.isneginf(lower) & np.isposinf(upper)
        self._p.data[:] = values.p
        given = (
            self._p, values.q,
            self._equalities.of(values.a, np.zeros(int(equal.sum()), dtype=bool)), values.lower[equal],
            self._inequalities.of(values.a, idle),
            np.where(idle, -1.0, np.maximum(lower, -_UNBOUNDED)),
            np.where(idle, 1.0, np.minimum(upper, _UNBOUNDED)),
        )  # fmt: skip
        (solver.setup if fresh else solver.update)(*given)
        status = solver.solve()
        found = solver.result
        self._solver = solver
        if status != piqp.PIQP_SOLVED:
            said = _STATUS.get(status, QpStatus.FAILED)
            return Answer.none(self._sparsity, said, f"piqp: {str(status).rpartition('.')[2].lower()}")
        y = np.empty(self._sparsity.constraints)
        y[equal], y[~equal] = found.y, np.where(idle, 0.0, found.z_u - found.z_l)
        return Answer(QpStatus.SOLVED, np.array(found.x), y, int(found.info.iter))

    def _start(self, equal: Mask) -> Any:
        """Solver without numbers for programs with these equalities."""
        self._equal = equal
        self._equalities = _Rows(self._sparsity, equal)
        self._inequalities = _Rows(self._sparsity, ~equal)
        solver = piqp.SparseSolver()
        for name, value in self._settings.items():
            setattr(solver.settings, name, value)
        return solver


class _Rows:
    """Some rows of A as a matrix of their own."""

    def __init__(self, sparsity: Sparsity, kept: Mask) -> None:
        self._entries: Index = np.flatnonzero(kept[sparsity.a_rows])
        place = np.cumsum(kept) - 1
        columns = sparsity.a_columns[self._entries]
        starts = np.searchsorted(columns, np.arange(sparsity.variables + 1))
        self._matrix: Any = sparse.csc_matrix(
            (np.zeros(len(columns)), place[sparsity.a_rows[self._entries]], starts),
            shape=(int(kept.sum()), sparsity.variables),
        )

    def of(self, a: Array, idle: Mask) -> Any:
        """Matrix with the entries of A, zero in idle rows."""
        self._matrix.data[:] = np.where(idle[self._matrix.indices], 0.0, a[self._entries])
        return self._matrix
