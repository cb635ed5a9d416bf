"""OSQP, the reference: kept workspace, warm start, every row weighed by what it has to move.

ADMM converges at the pace of its row weights, and no one weight fits rows that are metres, radians and
newtons at prices from nothing to 1e5. Three things are done here before OSQP sees a program. Variables are
measured by their own curvature, ``P_jj ** -1/2``. Rows are measured by their *compliance*: how far a unit
force on the row moves it while the equality rows (the dynamics) hold, which depends on the model alone and is
computed once. And rows that the guess finds pushing weigh more. After each round of iterations all rows are
weighed anew, as the last round now is the guess. OSQP's own scaling and adaptive rho know none of this and
stay off, so that nothing but the guess carries over from one program to the next.

Slacks that the guess has at zero are left out first (see :mod:`napf_mpc.solvers.presolve`): most programs
then are a third smaller. An answer that does not hold for the whole program costs at most :data:`HARD`
iterations, and the whole one is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from napf_mpc.jit import compiled
from napf_mpc.quadratic_program import Array, Index, QpStatus, Sparsity, Values
from napf_mpc.solvers.presolve import Part, Slacks
from napf_mpc.solvers.solver import Answer, MakeBackend, Warm, tried

DEFAULTS: dict[str, Any] = {
    "eps_abs": 1e-5,
    "eps_rel": 0.0,
    "polishing": True,
    "alpha": 1.2,
    "check_termination": 3,
    "max_iter": 1000,
}
"""Over-relaxation leaves a stiff row ``alpha - 1`` of its last error: OSQP's own 1.6 is slow here."""
OURS: dict[str, Any] = {"scaling": 0, "verbose": False, "rho": 1.0, "adaptive_rho": 0}
"""Settings that are not to choose."""
COARSE, EXACT = 1e-2, 1e-7
"""ADMM need only find the active rows, polishing then solves them exactly: a first try stops at a residual of
COARSE, and iterations go on to the tolerance only if polishing it leaves more than EXACT (scaled)."""
ROUND, LONGER = 10, 1.5
"""Iterations of a round, and how much longer those of each cycle are than of the one before."""
EQUAL, LOOSE, PUSHING = 100.0, 0.015, 100.0
"""Weight times compliance of an equality row and of a row that does not push, and what one that pushes gets
on top. (OSQP itself puts 1000 on top of equality rows.)"""
STEEPER, CYCLE = 6.0, 8
"""How much more pushing and equality rows get each round, and rounds until that starts again. Where rows
contradict each other, multipliers climb to the price of a slack at the pace of the softest row among them,
the dynamics included; rows that come and go need little."""
HARD = 60
"""Iterations at most without the slacks that are expected at zero; most programs take nine."""
OFF, FAR = 1e-6, 1e20
"""Weight times compliance of a row without bounds, and the bound that OSQP is told instead (scaled): it would
factorise once more in each program in which a row loses or regains all its bounds."""
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
        For a setting that OSQP does not have, or that is ours, or a value that is none.
    """
    known = osqp.OSQP(algebra="builtin").ext.OSQPSettings.__dict__
    for key in settings:
        if key not in known or key in OURS:
            raise TypeError(f"setting {key!r} is not known")
    chosen = {**DEFAULTS, **settings, **OURS}
    compliances = Compliances()
    return tried(lambda sparsity: OsqpBackend(sparsity, chosen, compliances), settings)


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
        known = self._sparsity is sparsity and _same_model(
            values.p, values.a, values.lower, values.upper,
            self._equal, self._p_inner, self._p, self._a_inner, self._a,
        )  # fmt: skip
        if not known:
            self._learn(sparsity, values, values.lower == values.upper, own)
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


@dataclass(frozen=True, eq=False)
class _Outcome:
    """What OSQP said of a part of a program."""

    name: str
    """Its status by name."""
    said: str
    """The same in its words."""
    exact: bool
    """Whether polishing left an exact answer; what was not to be polished counts as exact."""
    z: Array
    """(n') point of the part, in the program's own measure."""
    y: Array
    """(m') multipliers."""
    iterations: int
    """Of all rounds."""


class OsqpBackend:
    """OSQP objects for programs of one sparsity: with all slacks, and without those expected at zero."""

    def __init__(self, sparsity: Sparsity, settings: dict[str, Any], compliances: Compliances) -> None:
        self._sparsity, self._settings, self._compliances = sparsity, settings, compliances
        self._diagonal = np.flatnonzero(sparsity.p_rows == sparsity.p_columns)
        self._slacks: Slacks | None = None
        self._most: _Workspace | None = None
        self._hard: _Workspace | None = None

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers from a guess, or from zero.

        Raises
        ------
        KeyboardInterrupt
            OSQP takes the interrupt for itself; this hands it on.
        """
        places, limit, used = self._sparsity, int(self._settings["max_iter"]), 0
        slacks = self._fitting_slacks(values)
        own = _free_compliances(values.p, places.p_rows, self._diagonal, places.variables)
        held = self._compliances.of(places, values, own)
        # Without a guess it would start from where the last solve ended, even if that was far out.
        z, y = (np.zeros(places.variables), np.zeros(places.constraints)) if warm is None else warm
        few = min(HARD, limit // 2)
        if warm is not None and few > 0 and slacks.hard is not None and slacks.expected_at_zero(values, z):
            self._hard = self._hard or _Workspace(slacks.hard, self._settings)
            outcome = self._hard.solve(values, own, held, *slacks.hard.guess(z, y), few)
            used = outcome.iterations
            if outcome.name == "OSQP_SOLVED" and outcome.exact:
                point, multipliers, paid = slacks.whole(slacks.hard, values, outcome.z, outcome.y)
                if paid:
                    return Answer(QpStatus.SOLVED, point, multipliers, used)
            elif outcome.name not in (*_UNFINISHED, "OSQP_SOLVED"):
                # Without slacks there may be no point at all, and what OSQP then holds may be no numbers.
                self._hard = None
        self._most = self._most or _Workspace(slacks.most, self._settings)
        outcome = self._most.solve(values, own, held, *slacks.most.guess(z, y), limit - used)
        point, multipliers, _ = slacks.whole(slacks.most, values, outcome.z, outcome.y)
        status = _STATUS.get(outcome.name, QpStatus.FAILED)
        message = "" if status is QpStatus.SOLVED else f"osqp: {outcome.said}"
        return Answer(status, point, multipliers, used + outcome.iterations, message)

    def _fitting_slacks(self, values: Values) -> Slacks:
        if self._slacks is None or not self._slacks.fit(values):
            before = None if self._slacks is None else self._slacks.priced
            self._slacks = Slacks.of(self._sparsity, values, before)
            self._most = self._hard = None
        return self._slacks


class _Workspace:
    """One OSQP object, for a part of programs."""

    def __init__(self, part: Part, settings: dict[str, Any]) -> None:
        self._part, self._settings = part, settings
        self._solver: Any = None
        self._limits: tuple[object, ...] = ()

    def solve(self, values: Values, own: Array, held: Array, z: Array, y: Array, most: int) -> _Outcome:
        """Solve the part of a program's numbers from a guess.

        Parameters
        ----------
        values : Values
            Of the whole program.
        own, held : array, shape (n,)
            Compliances of the whole program's variables, free and while the equality rows hold.
        z, y : array, shapes (n') and (m')
            Guess of the part; y is written to.
        most : int
            Iterations at most, > 0.
        """
        part, places, settings = self._part, self._part.sparsity, self._settings
        p, q, entries, low, high, own, held, d = _taken(
            values.p, values.q, values.a, values.lower, values.upper, own, held,
            part.p_at, places.p_rows, places.p_columns, part.columns, part.a_at, part.rows, part.above,
        )  # fmt: skip
        polishing = bool(settings["polishing"])
        coarse, exact = polishing and settings["eps_abs"] < COARSE, not polishing
        used, turn = 0, 0
        while True:
            steeper = STEEPER ** (turn % CYCLE)
            e, a, lower, upper = _weighed(
                entries, places.a_rows, places.a_columns, low, high, own, held, d, z, y,
                EQUAL * steeper, LOOSE, PUSHING * steeper,
            )  # fmt: skip
            if self._solver is None:
                self._setup(p, q, a, lower, upper)
            elif turn:
                self._solver.update(l=lower, u=upper, Ax=a)
            else:
                self._solver.update(q=q, l=lower, u=upper, Px=p, Ax=a)
            self._solver.warm_start(x=z / d, y=np.append(y, 0.0) / e)
            self._limit(min(int(ROUND * LONGER ** (turn // CYCLE)), most - used), coarse)
            result = self._solver.solve(raise_error=False)
            used, turn = used + int(result.info.iter), turn + 1
            name = osqp.SolverStatus(result.info.status_val).name
            if name == "OSQP_SIGINT":
                raise KeyboardInterrupt
            z, y = result.x * d, (result.y * e)[: places.constraints]
            if name == "OSQP_SOLVED":
                exact = not polishing or max(result.info.prim_res, result.info.dual_res) <= EXACT
                if exact or not coarse:
                    break
                coarse = False
            elif name not in _UNFINISHED:
                break
            if used >= most:
                break
        return _Outcome(name, str(result.info.status), exact, z, y, used)

    def _limit(self, iterations: int, coarse: bool) -> None:
        settings = self._settings
        eps_abs, eps_rel = (COARSE, 0.0) if coarse else (settings["eps_abs"], settings["eps_rel"])
        # Most programs begin as the last one ended, and OSQP checks all settings each time.
        if (iterations, eps_abs, eps_rel) != self._limits:
            self._solver.update_settings(max_iter=iterations, eps_abs=eps_abs, eps_rel=eps_rel)
            self._limits = (iterations, eps_abs, eps_rel)

    def _setup(self, p: Array, q: Array, a: Array, lower: Array, upper: Array) -> None:
        places, n = self._part.sparsity, self._part.sparsity.variables
        # MKL, if it were installed, would give other last bits.
        self._solver = osqp.OSQP(algebra="builtin")
        self._solver.setup(
            sparse.csc_matrix((p, places.p_rows, places.p_starts), shape=(n, n)),
            q,
            sparse.csc_matrix((a, places.a_rows, places.a_starts), shape=(len(lower), n)),
            lower,
            upper,
            **self._settings,
        )


@compiled
def _same_model(
    p: Array, a: Array, lower: Array, upper: Array,
    equal: NDArray[np.bool_], p_inner: Index, p_known: Array, a_inner: Index, a_known: Array,
) -> bool:  # fmt: skip
    """Whether the same rows are equalities, and their numbers and those of their cost are the known ones."""
    same = True
    for i in range(len(lower)):
        same = same and (lower[i] == upper[i]) == equal[i]
    for k in range(len(p_inner)):
        same = same and p[p_inner[k]] == p_known[k]
    for k in range(len(a_inner)):
        same = same and a[a_inner[k]] == a_known[k]
    return same


@compiled
def _free_compliances(p: Array, p_rows: Index, diagonal: Index, n: int) -> Array:
    """How far a unit force on each variable moves it without any rows."""
    own = np.full(n, FREE)
    for k in diagonal:
        own[p_rows[k]] = 1.0 / max(p[k], 1.0 / FREE)
    return own


@compiled
def _taken(
    p: Array, q: Array, a: Array, lower: Array, upper: Array, own: Array, held: Array,
    p_at: Index, p_rows: Index, p_columns: Index, columns: Index, a_at: Index, rows: Index, above: Index,
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Numbers of a part: cost in its variables' own measure, the rest as it is, and that measure."""
    n, m = len(columns), len(rows)
    own_part, held_part, d, pull = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    cost, entries, low, high = np.empty(len(p_at)), np.empty(len(a_at)), np.empty(m), np.empty(m)
    for j in range(n):
        own_part[j], held_part[j] = own[columns[j]], held[columns[j]]
        d[j] = np.sqrt(own_part[j])
        pull[j] = q[columns[j]] * d[j]
    for k in range(len(p_at)):
        cost[k] = p[p_at[k]] * d[p_rows[k]] * d[p_columns[k]]
    for k in range(len(a_at)):
        entries[k] = a[a_at[k]]
    for i in range(m):
        low[i], high[i] = lower[rows[i]], upper[above[i]]
    return cost, pull, entries, low, high, own_part, held_part, d


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
        if lower[i] == -np.inf and upper[i] == np.inf:
            # OSQP would factorise once more whenever a row loses or gains all its bounds.
            e[i] = np.sqrt(OFF * stiffness)
            low[i], high[i], y[i] = -FAR, np.inf, 0.0
            continue
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
