"""OSQP, the reference: kept workspace, warm start, every row weighed by what it has to move.

ADMM converges at the pace of its row weights, and no one weight fits rows that are metres, radians and
newtons at prices from nothing to 1e5. Three things are done here before OSQP sees a program. Variables are
measured by their own curvature, ``P_jj ** -1/2``. Rows are measured by their *compliance*: how far a unit
force on the row moves it while the equality rows (the dynamics) hold, which depends on the model alone and is
computed once. And rows that the guess finds pushing weigh more. After each round of iterations all rows are
weighed anew, as the last round now is the guess. OSQP's own scaling and adaptive rho know none of this and
stay off, so that nothing but the guess carries over from one program to the next.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from napf_mpc.jit import compiled
from napf_mpc.quadratic_program import Array, Index, QpStatus, Sparsity, Values
from napf_mpc.solvers.solver import Answer, MakeBackend, Warm

DEFAULTS: dict[str, Any] = {
    "eps_abs": 1e-5,
    "eps_rel": 0.0,
    "polishing": True,
    "alpha": 1.4,
    "check_termination": 5,
    "max_iter": 1000,
}
"""Over-relaxation leaves a stiff row ``alpha - 1`` of its last error: OSQP's own 1.6 is slow here."""
OURS: dict[str, Any] = {"scaling": 0, "verbose": False, "rho": 1.0, "adaptive_rho": 0}
"""Settings that are not to choose."""
COARSE, EXACT = 3e-4, 1e-7
"""ADMM need only find the active rows, polishing then solves them exactly: a first try stops at a residual of
COARSE, and iterations go on to the tolerance only if polishing it leaves more than EXACT (scaled)."""
ROUND, LONGER = 15, 1.5
"""Iterations of a round, and how much longer those of each cycle are than of the one before."""
EQUAL, LOOSE, PUSHING = 10.0, 0.07, 50.0
"""Weight times compliance of an equality row and of a row that does not push, and what one that pushes gets
on top. (OSQP itself puts 1000 on top of equality rows.)"""
STEEPER, CYCLE = 8.0, 6
"""How much more pushing and equality rows get each round, and rounds until that starts again. Where rows
contradict each other, multipliers climb to the price of a slack at the pace of the softest row among them,
the dynamics included; rows that come and go need little."""
FREE = 1e4
"""Largest compliance: that of a variable or row without a cost of its own."""
STIFF = 1e-4
"""Smallest compliance of a row."""

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
_UNFINISHED = ("OSQP_MAX_ITER_REACHED", "OSQP_SOLVED_INACCURATE")


def maker(name: str, **settings: Any) -> MakeBackend:
    """Maker of OSQP back-ends; settings are OSQP's, on top of :data:`DEFAULTS`.

    Raises
    ------
    TypeError
        For a setting that OSQP does not have, or that is ours.
    """
    known = osqp.OSQP(algebra="builtin").ext.OSQPSettings.__dict__
    for key in settings:
        if key not in known or key in OURS:
            raise TypeError(f"setting {key!r} is not known")
    chosen = {**DEFAULTS, **settings, **OURS}
    compliances = Compliances()
    return lambda sparsity: OsqpBackend(sparsity, chosen, compliances)


class Compliances:
    """Compliances of the variables of the program seen last: one model serves all UAVs and steps."""

    def __init__(self) -> None:
        self._sparsity: Sparsity | None = None
        self._equal = np.zeros(0, dtype=bool)
        self._p_inner = self._a_inner = np.zeros(0, dtype=bool)
        self._p = self._a = np.zeros(0)
        self._held = np.zeros(0)
        self._inner = np.zeros(0, dtype=bool)

    def of(self, sparsity: Sparsity, values: Values, own: Array) -> Array:
        """How far a unit force on each variable moves it while the equality rows hold, (n,).

        Parameters
        ----------
        sparsity, values
            The program.
        own : array, shape (n,)
            The same without any rows.
        """
        equal = values.lower == values.upper
        known = self._sparsity is sparsity and np.array_equal(equal, self._equal)
        if known:
            p, a = values.p[self._p_inner], values.a[self._a_inner]
            known = np.array_equal(p, self._p) and np.array_equal(a, self._a)
        if not known:
            self._learn(sparsity, values, equal, own)
        return np.where(self._inner, self._held, own)

    def _learn(self, sparsity: Sparsity, values: Values, equal: NDArray[np.bool_], own: Array) -> None:
        n = sparsity.variables
        self._sparsity, self._equal = sparsity, equal
        self._a_inner = np.flatnonzero(equal[sparsity.a_rows])
        self._inner = np.zeros(n, dtype=bool)
        self._inner[sparsity.a_columns[self._a_inner]] = True
        self._p_inner = np.flatnonzero(self._inner[sparsity.p_rows] & self._inner[sparsity.p_columns])
        self._p, self._a = values.p[self._p_inner], values.a[self._a_inner]
        self._held = np.zeros(n)
        count, rows = int(self._inner.sum()), int(equal.sum())
        if not count:
            return
        place, row = np.cumsum(self._inner) - 1, np.cumsum(equal) - 1
        p_rows, p_columns = place[sparsity.p_rows[self._p_inner]], place[sparsity.p_columns[self._p_inner]]
        a_rows, a_columns = row[sparsity.a_rows[self._a_inner]], place[sparsity.a_columns[self._a_inner]]
        # A little of everything on the diagonal: rows may repeat each other, variables may cost nothing.
        little = np.concatenate([1e-6 / own[self._inner], np.full(rows, -1e-9)])
        every = np.arange(count + rows)
        entries = np.concatenate([self._p, self._a, self._a, little])
        at = (
            np.concatenate([p_rows, count + a_rows, a_columns, every]),
            np.concatenate([p_columns, a_columns, count + a_rows, every]),
        )
        kkt = sparse.csc_array((entries, at), shape=(count + rows, count + rows))
        # Symmetric and in this order: 30 times as fast as by default. The last bits of a dense inverse, as
        # fast, would change with the number of threads.
        factors = splu(kkt, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        self._held[self._inner] = factors.solve(np.eye(count + rows, count))[:count].diagonal()


class OsqpBackend:
    """One OSQP object for programs of one sparsity."""

    def __init__(self, sparsity: Sparsity, settings: dict[str, Any], compliances: Compliances) -> None:
        self._sparsity, self._settings, self._compliances = sparsity, settings, compliances
        self._upper = np.flatnonzero(sparsity.p_rows <= sparsity.p_columns)
        self._p_rows, self._p_columns = sparsity.p_rows[self._upper], sparsity.p_columns[self._upper]
        self._diagonal = np.flatnonzero(sparsity.p_rows == sparsity.p_columns)
        self._solver: Any = None

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers from a guess, or from zero.

        Raises
        ------
        KeyboardInterrupt
            OSQP takes the interrupt for itself; this hands it on.
        """
        places, settings = self._sparsity, self._settings
        own = np.full(places.variables, FREE)
        own[places.p_rows[self._diagonal]] = 1.0 / np.maximum(values.p[self._diagonal], 1.0 / FREE)
        held = self._compliances.of(places, values, own)
        d = np.sqrt(own)
        p, q = values.p[self._upper] * d[self._p_rows] * d[self._p_columns], values.q * d
        # Without a guess it would start from where the last solve ended, even if that was far out.
        z, y = (np.zeros(places.variables), np.zeros(places.constraints)) if warm is None else warm
        coarse = bool(settings["polishing"]) and settings["eps_abs"] < COARSE
        most, used, turn = int(settings["max_iter"]), 0, 0
        while True:
            steeper = STEEPER ** (turn % CYCLE)
            e, a, lower, upper = _weighed(
                values.a, places.a_rows, places.a_columns, values.lower, values.upper, own, held, d, z, y,
                EQUAL * steeper, LOOSE, PUSHING * steeper,
            )  # fmt: skip
            if self._solver is None:
                self._setup(p, q, a, lower, upper)
            elif turn:
                self._solver.update(l=lower, u=upper, Ax=a)
            else:
                self._solver.update(q=q, l=lower, u=upper, Px=p, Ax=a)
            self._solver.warm_start(x=z / d, y=np.append(y, 0.0) / e)
            self._solver.update_settings(
                max_iter=min(int(ROUND * LONGER ** (turn // CYCLE)), most - used),
                eps_abs=COARSE if coarse else settings["eps_abs"],
                eps_rel=0.0 if coarse else settings["eps_rel"],
            )
            result = self._solver.solve(raise_error=False)
            used, turn = used + int(result.info.iter), turn + 1
            name = osqp.SolverStatus(result.info.status_val).name
            if name == "OSQP_SIGINT":
                raise KeyboardInterrupt
            z, y = result.x * d, (result.y * e)[: places.constraints]
            if used >= most or name not in (*_UNFINISHED, "OSQP_SOLVED"):
                break
            if name == "OSQP_SOLVED":
                if not coarse or max(result.info.prim_res, result.info.dual_res) <= EXACT:
                    break
                coarse = False
        status = _STATUS.get(name, QpStatus.FAILED)
        message = "" if status is QpStatus.SOLVED else f"osqp: {result.info.status}"
        return Answer(status, z, y, used, message)

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
def _weighed(
    a: Array, a_rows: Index, a_columns: Index, lower: Array, upper: Array, own: Array, held: Array, d: Array,
    z: Array, y: Array, equal: float, loose: float, pushing: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Roots (m + 1,) of the rows' weights at a guess, and the rows scaled by them: entries and bounds.

    The last row is an empty one, 0 = 0: without any active row OSQP does not polish, and prints so.
    """
    m = len(lower)
    e, scaled, low, high = np.ones(m + 1), np.empty(len(a)), np.zeros(m + 1), np.zeros(m + 1)
    compliance, reach = np.zeros(m), np.zeros(m)
    for k in range(len(a)):
        i, j = a_rows[k], a_columns[k]
        compliance[i] += a[k] * a[k] * (own[j] if lower[i] == upper[i] else held[j])
        reach[i] += a[k] * z[j]
    for i in range(m):
        stiffness = 1.0 / min(max(compliance[i], STIFF), FREE)
        if lower[i] == upper[i]:
            weight = equal * stiffness
        else:
            weight = loose * stiffness
            if weight * (lower[i] - reach[i]) > y[i] or weight * (reach[i] - upper[i]) > -y[i]:
                weight *= pushing
        e[i] = np.sqrt(weight)
        low[i], high[i] = lower[i] * e[i], upper[i] * e[i]
    for k in range(len(a)):
        scaled[k] = a[k] * e[a_rows[k]] * d[a_columns[k]]
    return e, scaled, low, high
