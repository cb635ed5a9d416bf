"""OSQP, the default: kept workspace, programs scaled here, warm start, polished answers.

The scaling is OSQP's own idea (Ruiz equilibration) with two changes. It starts from the variables' own
curvature, ``P_jj ** -1/2``, so that metres, radians, newtons and slacks of any penalty begin alike; and it is
done here in compiled code, as OSQP redoes its own at every change of a matrix.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp
from scipy import sparse

from napf_mpc.jit import compiled
from napf_mpc.quadratic_program import Array, Index, QpStatus, Sparsity, Values
from napf_mpc.solvers.solver import Answer, MakeBackend, Warm

DEFAULTS: dict[str, Any] = {
    "eps_abs": 1e-4,
    "eps_rel": 1e-5,
    "polishing": True,
    "rho": 0.1,
    "adaptive_rho_tolerance": 2.0,
    "check_termination": 10,
    "max_iter": 2000,
}
"""The tolerance is for the few programs that polishing does not solve exactly, see :data:`COARSE`."""
COARSE, EXACT = 1e-2, 1e-7
"""ADMM need only find the active rows, polishing then solves them exactly: a first try stops at a residual of
COARSE, and iterations go on to the tolerance only if polishing it leaves more than EXACT (scaled)."""
PASSES = 5
"""Passes of equilibration."""

_STATUS = {
    "OSQP_SOLVED": QpStatus.SOLVED,
    "OSQP_SOLVED_INACCURATE": QpStatus.INACCURATE,
    "OSQP_PRIMAL_INFEASIBLE": QpStatus.PRIMAL_INFEASIBLE,
    "OSQP_PRIMAL_INFEASIBLE_INACCURATE": QpStatus.PRIMAL_INFEASIBLE,
    "OSQP_DUAL_INFEASIBLE": QpStatus.DUAL_INFEASIBLE,
    "OSQP_DUAL_INFEASIBLE_INACCURATE": QpStatus.DUAL_INFEASIBLE,
    "OSQP_MAX_ITER_REACHED": QpStatus.MAX_ITERATIONS,
    "OSQP_TIME_LIMIT_REACHED": QpStatus.MAX_ITERATIONS,
}


def maker(name: str, **settings: Any) -> MakeBackend:
    """Maker of OSQP back-ends; settings are OSQP's, on top of :data:`DEFAULTS`.

    Raises
    ------
    TypeError
        For a setting that OSQP does not have, or that is ours.
    """
    known = osqp.OSQP(algebra="builtin").ext.OSQPSettings.__dict__
    for key in settings:
        if key not in known or key in ("scaling", "verbose"):
            raise TypeError(f"setting {key!r} is not known")
    chosen = {**DEFAULTS, **settings, "scaling": 0, "verbose": False}
    return lambda sparsity: OsqpBackend(sparsity, chosen)


class OsqpBackend:
    """One OSQP object for programs of one sparsity."""

    def __init__(self, sparsity: Sparsity, settings: dict[str, Any]) -> None:
        self._sparsity, self._settings = sparsity, settings
        self._upper = np.flatnonzero(sparsity.p_rows <= sparsity.p_columns)
        self._p_rows, self._p_columns = sparsity.p_rows[self._upper], sparsity.p_columns[self._upper]
        self._solver: Any = None
        self._anchored = False

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers from a guess, or from zero.

        Raises
        ------
        KeyboardInterrupt
            OSQP takes the interrupt for itself; this hands it on.
        """
        places, p = self._sparsity, values.p[self._upper]
        d, e, c = _equilibrate(
            p, self._p_rows, self._p_columns, values.a, places.a_rows, places.a_columns, values.q,
            places.constraints, PASSES,
        )  # fmt: skip
        p = p * d[self._p_rows] * d[self._p_columns] * c
        a = values.a * e[places.a_rows] * d[places.a_columns]
        q, lower, upper = values.q * d * c, values.lower * e, values.upper * e
        # Without any active row OSQP does not polish, and prints so: an empty row 0 = 0 is always active.
        anchored = not (lower == upper).any()
        if anchored:
            e, lower, upper = np.append(e, 1.0), np.append(lower, 0.0), np.append(upper, 0.0)
        if self._solver is None or anchored != self._anchored:
            self._anchored = anchored
            self._setup(p, q, a, lower, upper)
        else:
            self._solver.update(q=q, l=lower, u=upper, Px=p, Ax=a)
        # Without a guess it would start from where the last solve ended, even if that was far out.
        z, y = np.zeros(len(d)), np.zeros(len(e))
        if warm is not None:
            z, y[: places.constraints] = warm[0] / d, warm[1] / e[: places.constraints] * c
        self._solver.warm_start(x=z, y=y)
        result, iterations = self._solve_to_tolerance()
        name = osqp.SolverStatus(result.info.status_val).name
        if name == "OSQP_SIGINT":
            raise KeyboardInterrupt
        status = _STATUS.get(name, QpStatus.FAILED)
        message = "" if status is QpStatus.SOLVED else f"osqp: {result.info.status}"
        y = (result.y * e / c)[: places.constraints]
        return Answer(status, result.x * d, y, iterations, message)

    def _solve_to_tolerance(self) -> tuple[Any, int]:
        """Result, and iterations of all tries."""
        fine = self._settings["eps_abs"], self._settings["eps_rel"]
        iterations = 0
        if self._settings["polishing"] and fine[0] < COARSE:
            self._solver.update_settings(eps_abs=COARSE, eps_rel=0.0)
            result = self._solver.solve(raise_error=False)
            iterations = int(result.info.iter)
            solved = result.info.status_val == osqp.SolverStatus.OSQP_SOLVED
            if not solved or max(result.info.prim_res, result.info.dual_res) <= EXACT:
                return result, iterations
            self._solver.update_settings(eps_abs=fine[0], eps_rel=fine[1])
        result = self._solver.solve(raise_error=False)
        return result, iterations + int(result.info.iter)

    def _setup(self, p: Array, q: Array, a: Array, lower: Array, upper: Array) -> None:
        places, n = self._sparsity, self._sparsity.variables
        p_starts = np.searchsorted(self._p_columns, np.arange(n + 1))
        # MKL, if it were installed, would give other last bits.
        self._solver = osqp.OSQP(algebra="builtin")
        self._solver.setup(
            sparse.csc_matrix((p, self._p_rows, p_starts), shape=(n, n)),
            q,
            sparse.csc_matrix((a, places.a_rows, places.a_starts), shape=(len(lower), n)),
            lower,
            upper,
            **self._settings,
        )


@compiled
def _equilibrate(
    p: Array, p_rows: Index, p_columns: Index, a: Array, a_rows: Index, a_columns: Index, q: Array,
    constraints: int, passes: int,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Scales d of the variables, e of the rows, c of the cost that bring all norms of the KKT matrix to one.

    Each pass divides by the square roots of the largest entries of the columns (Ruiz 2001), then scales the
    cost by the mean of P's columns or the largest entry of q, whichever is larger (as OSQP does).
    """
    n = len(q)
    d, e, c = np.ones(n), np.ones(constraints), 1.0
    for k in range(len(p)):
        if p_rows[k] == p_columns[k] and p[k] > 0.0:
            d[p_rows[k]] = min(max(1.0 / np.sqrt(p[k]), 1e-3), 1e3)
    column, row = np.empty(n), np.empty(constraints)
    for _ in range(passes):
        column[:] = 0.0
        row[:] = 0.0
        for k in range(len(p)):
            i, j = p_rows[k], p_columns[k]
            size = abs(p[k]) * d[i] * d[j] * c
            column[i], column[j] = max(column[i], size), max(column[j], size)
        for k in range(len(a)):
            i, j = a_rows[k], a_columns[k]
            size = abs(a[k]) * e[i] * d[j]
            row[i], column[j] = max(row[i], size), max(column[j], size)
        for j in range(n):
            d[j] /= _bounded_root(column[j])
        for i in range(constraints):
            e[i] /= _bounded_root(row[i])
        column[:] = 0.0
        for k in range(len(p)):
            i, j = p_rows[k], p_columns[k]
            size = abs(p[k]) * d[i] * d[j] * c
            column[i], column[j] = max(column[i], size), max(column[j], size)
        total, largest = 0.0, 0.0
        for j in range(n):
            total += column[j]
            largest = max(largest, abs(q[j]) * d[j] * c)
        cost = max(total / n, largest)
        c /= 1.0 if cost < 1e-4 else min(cost, 1e4)
    return d, e, c


@compiled
def _bounded_root(size: float) -> float:
    """Root of a norm; an empty row or column is left as it is."""
    return float(np.sqrt(1.0 if size < 1e-4 else min(size, 1e4)))
