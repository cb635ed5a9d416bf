"""Solvers that qpsolvers knows and that are installed, through its one interface."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np
import qpsolvers
from scipy import sparse

from napf_mpc.quadratic_program import QpStatus, Sparsity, Values
from napf_mpc.solvers.solver import Answer, MakeBackend, Warm, tried

DENSE = ("daqp", "quadprog")
"""Solvers that take dense matrices only."""
DEFAULTS: dict[str, dict[str, Any]] = {
    "clarabel": {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10},
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0},
    # It solves semi-definite programs by proximal steps only.
    "daqp": {"eps_prox": 1e-6},
    # On badly scaled programs it goes round for ever, and Ctrl-C does not reach it. (One program of the
    # benchmark took it 5.2 s.)
    "highs": {"time_limit": 10.0},
}
"""Settings that differ from the solver's own defaults."""
_WORDS = (
    ("primal_infeasible", QpStatus.PRIMAL_INFEASIBLE),
    ("primalinfeasible", QpStatus.PRIMAL_INFEASIBLE),
    ("dual_infeasible", QpStatus.DUAL_INFEASIBLE),
    ("dualinfeasible", QpStatus.DUAL_INFEASIBLE),
    ("max_iter", QpStatus.MAX_ITERATIONS),
    ("maxiter", QpStatus.MAX_ITERATIONS),
)
"""What a solver's own status contains -> ours."""


def maker(name: str, **settings: Any) -> MakeBackend:
    """Maker of back-ends of a solver; settings are the solver's own.

    Raises
    ------
    ImportError
        If the solver itself is not installed.
    TypeError
        For a setting that it does not know, or a value that is none.
    """
    if name not in qpsolvers.available_solvers:
        raise ImportError(f"qpsolvers finds no {name}")
    if name == "highs":
        _swallow_banner()
        _refuse_unknown_options(settings)
    chosen = {**DEFAULTS.get(name, {}), **settings}
    return tried(lambda sparsity: QpsolversBackend(name, sparsity, chosen), settings)


class QpsolversBackend:
    """Splits the rows into equalities and one-sided inequalities, each time anew."""

    def __init__(self, name: str, sparsity: Sparsity, settings: dict[str, Any]) -> None:
        self._name, self._sparsity, self._settings = name, sparsity, settings

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers; the guess is not used."""
        places, n, m = self._sparsity, self._sparsity.variables, self._sparsity.constraints
        p: Any = sparse.csc_matrix((values.p, places.p_rows, places.p_starts), shape=(n, n))
        rows = sparse.csc_matrix((values.a, places.a_rows, places.a_starts), shape=(m, n))
        equal = values.lower == values.upper
        above = np.flatnonzero(~equal & np.isfinite(values.lower))
        below = np.flatnonzero(~equal & np.isfinite(values.upper))
        equal = np.flatnonzero(equal)
        g: Any = sparse.vstack([rows[below], -rows[above]], format="csc")
        h = np.concatenate([values.upper[below], -values.lower[above]])
        a: Any = rows[equal]
        b = values.lower[equal]
        if self._name in DENSE:
            p, g, a = p.toarray(), g.toarray(), a.toarray()
        inequalities = (g, h) if len(h) else (None, None)
        equalities = (a, b) if len(b) else (None, None)
        problem = qpsolvers.Problem(p, values.q, *inequalities, *equalities)
        with warnings.catch_warnings():
            # It warns of every status but success; the status is read below.
            warnings.simplefilter("ignore")
            solution = qpsolvers.solve_problem(problem, self._name, **self._settings)
        said = _own_status(solution)
        limit_s = self._settings.get("time_limit", np.inf) if self._name == "highs" else np.inf
        if not solution.found and solution.solve_time is not None and solution.solve_time >= limit_s:
            # The adapter hands no status on, but the time.
            message = f"{self._name}: no solution found in {limit_s:g} s"
            return Answer.none(places, QpStatus.MAX_ITERATIONS, message)
        if not solution.found or solution.x is None:
            return Answer.none(places, _translated(said), f"{self._name}: {said or 'no solution found'}")
        y = np.zeros(m)
        if len(h):
            z = np.asarray(solution.z, dtype=float)
            y[below] += z[: len(below)]
            y[above] -= z[len(below) :]
        if len(b):
            y[equal] = solution.y
        return Answer(QpStatus.SOLVED, np.asarray(solution.x, dtype=float), y)


@cache
def _swallow_banner() -> None:
    """Let HiGHS write its banner to nowhere.

    From 1.16 on, whatever first enables the callbacks of an instance writes it, once a process, and the
    constructor enables them before anybody can turn the console off.
    """
    import highspy

    highs: Any = highspy.Highs

    def enable_mute(instance: Any) -> None:
        instance.setOptionValue("log_to_console", False)
        highs.enableCallbacks(instance)

    type("Mute", (highs,), {"enableCallbacks": enable_mute})()


def _refuse_unknown_options(settings: dict[str, Any]) -> None:
    """Refuse options that HiGHS would pass over without a word."""
    import highspy

    highs: Any = highspy.Highs
    solver = highs()
    solver.setOptionValue("log_to_console", False)
    for name, value in settings.items():
        # ``verbose`` is of qpsolvers.
        if name != "verbose" and solver.setOptionValue(name, value) != highspy.HighsStatus.kOk:
            raise TypeError(f"{name} = {value!r}: is not an option of HiGHS, or not a value of it")


def _own_status(solution: Any) -> str:
    """Status in the solver's words; empty for one whose adapter does not hand it on."""
    extras = solution.extras or {}
    said = extras.get("status", getattr(extras.get("info"), "status", ""))
    return str(said)


def _translated(said: str) -> QpStatus:
    lowered = said.lower()
    return next((status for word, status in _WORDS if word in lowered), QpStatus.FAILED)
