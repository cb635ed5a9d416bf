"""ProxQP, qpOASES and HPIPM through the plug-ins of CasADi's own wheel.

The plug-ins take no guess that helps, so that all of them start cold. ProxQP's makes its object anew at
every call. HPIPM's hands on a primal guess only, with which it takes as long as without. qpOASES's knows no
guess but its own last working set. Since the matrices are others at every step, nearly all of its time goes
into new factors, and an answer that depends on what was solved before is not worth the rest.

A. Bambade, S. El-Kazdadi, A. Taylor, J. Carpentier, "ProxQP: Yet another quadratic programming solver for
robotics and beyond", RSS 2022. H. J. Ferreau, C. Kirches, A. Potschka, H. G. Bock, M. Diehl, "qpOASES: a
parametric active-set algorithm for quadratic programming", Mathematical Programming Computation 6, 2014.
G. Frison, M. Diehl, "HPIPM: a high-performance quadratic programming framework for model predictive control",
IFAC World Congress 2020.
"""

from __future__ import annotations

import io
import re
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from typing import Any, TextIO

import casadi as ca
import numpy as np
from scipy import sparse

from napf_mpc.quadratic_program import Array, QpStatus, Sparsity, Values
from napf_mpc.solvers.batch import PerUavSolver
from napf_mpc.solvers.condensing import Condenser
from napf_mpc.solvers.solver import Answer, MakeBackend, SolverError, Warm
from napf_mpc.solvers.stagewise import Stages, single_stage, stagewise

DEFAULTS: dict[str, dict[str, Any]] = {
    # Its own limit is 10,000 iterations. In a program that it cannot solve one may take half a second, and no
    # signal is answered before the last.
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0, "max_iter": 100, "verbose": False},
    # Sparse products; its factors are dense all the same.
    "qpoases": {"printLevel": "none", "sparse": True},
    # A row's distance to a bound that it barely touches is the root of the last of the four residuals. The
    # smallest multiplier and distance that are allowed, 1e-16 unless set, would keep it from getting there.
    "hpipm": {
        "iter_max": 100, "res_g_max": 1e-9, "res_b_max": 1e-9, "res_d_max": 1e-9, "res_m_max": 1e-11,
        "lam_min": 1e-20, "t_min": 1e-20,
    },
}  # fmt: skip
"""Plug-in -> settings that it is given unless others are asked for."""
ROW_SCALE = 10.0
"""What ProxQP's rows are multiplied by. Its test for infeasibility is absolute, and the plug-in has no
setting for it: with rows as they are, it fails on 2 of 60 feasible programs such as ``tests/solvers`` has.
With 100 it fails on 2 of 104 programs of ``study_40c``, on one of them at half a second an iteration."""
UNBOUNDED = 1e6
"""What HPIPM takes for infinity. With CasADi's 1e8 it does not reach these tolerances."""
_STATUS = {
    "PROXQP_MAX_ITER_REACHED": QpStatus.MAX_ITERATIONS,
    "PROXQP_PRIMAL_INFEASIBLE": QpStatus.PRIMAL_INFEASIBLE,
    "PROXQP_DUAL_INFEASIBLE": QpStatus.DUAL_INFEASIBLE,
    "Initial QP could not be solved due to infeasibility!": QpStatus.PRIMAL_INFEASIBLE,
    "Initial QP could not be solved due to unboundedness!": QpStatus.DUAL_INFEASIBLE,
    "Maximum number of working set recalculations performed.": QpStatus.MAX_ITERATIONS,
    1: QpStatus.MAX_ITERATIONS,
}
"""What a plug-in says -> ours; anything else has failed."""
_CODES = {1: "all iterations used", 2: "the step became too short", 3: "a number is not finite"}
"""HPIPM's codes in words."""
PREFIX = "casadi-"


def maker(name: str, **settings: Any) -> MakeBackend:
    """Maker of back-ends; settings are the plug-in's own.

    Raises
    ------
    SolverError
        If CasADi was built without the plug-in.
    TypeError
        For a setting that it does not know, or a value that is none.
    """
    plugin = name.removeprefix(PREFIX)
    chosen = _checked(plugin, settings)
    if plugin == "proxqp":
        return lambda sparsity: ProxqpBackend(sparsity, chosen)
    if plugin == "qpoases":
        return lambda sparsity: QpoasesBackend(sparsity, chosen)
    return lambda sparsity: HpipmBackend(sparsity, single_stage(sparsity), chosen)


class HpipmSolver(PerUavSolver):
    """HPIPM on horizons: it is shown the stages.

    Parameters
    ----------
    settings
        HPIPM's own.

    Raises
    ------
    SolverError
        If CasADi was built without the plug-in.
    TypeError
        For a setting that it does not know, or a value that is none.
    """

    def __init__(self, **settings: Any) -> None:
        self._settings = _checked("hpipm", settings)
        super().__init__(self._of_stages)

    def _of_stages(self, sparsity: Sparsity) -> HpipmBackend:
        stages = single_stage(sparsity) if self._layout is None else stagewise(self._layout)
        return HpipmBackend(sparsity, stages, self._settings)


class ProxqpBackend:
    """ProxQP on the sparse program."""

    def __init__(self, sparsity: Sparsity, settings: Mapping[str, Any]) -> None:
        self._sparsity = sparsity
        self._conic = _Conic("proxqp", {"proxqp": settings})

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers; the guess is not used."""
        p, a = _matrices(self._sparsity, values)
        said = self._conic.solve(
            p, values.q, ROW_SCALE * a, ROW_SCALE * values.lower, ROW_SCALE * values.upper
        )
        return said.answer(self._sparsity, lambda: (said.z, ROW_SCALE * said.y))


class QpoasesBackend:
    """The solver qpOASES on the condensed program, rows with one variable as bounds; made anew each time."""

    def __init__(self, sparsity: Sparsity, settings: Mapping[str, Any]) -> None:
        self._sparsity, self._settings = sparsity, settings
        self._condenser = Condenser(sparsity)

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers; the guess is not used."""
        program = self._condenser.condense(values)
        rows = program.rows.tocsr()
        rows.eliminate_zeros()
        bounded, variable, factor = _single(rows)
        box_lower, box_upper = np.full(rows.shape[1], -np.inf), np.full(rows.shape[1], np.inf)
        low, high = program.lower[bounded] / factor, program.upper[bounded] / factor
        box_lower[variable], box_upper[variable] = np.minimum(low, high), np.maximum(low, high)
        idle = np.isneginf(program.lower) & np.isposinf(program.upper)
        idle[bounded] = True
        shown = np.flatnonzero(~idle)
        # Without rows the plug-in overlooks bounds, and says that it succeeded: there is always an empty one.
        shown_rows = sparse.vstack([rows[shown], sparse.csr_matrix((1, rows.shape[1]))], format="csc")
        said = _Conic("qpoases", self._settings).solve(
            program.hessian.tocsc(), program.gradient, shown_rows, np.append(program.lower[shown], -np.inf),
            np.append(program.upper[shown], np.inf), box_lower, box_upper,
        )  # fmt: skip

        def expanded() -> Warm:
            y = np.zeros(len(idle))
            y[shown], y[bounded] = said.y[:-1], said.y_box[variable] / factor
            return program.expand(said.z, y)

        return said.answer(self._sparsity, expanded)


class HpipmBackend:
    """HPIPM on a program in stages.

    CasADi hands on none of HPIPM's soft rows: slacks are controls of their stage.
    """

    def __init__(self, sparsity: Sparsity, stages: Stages, settings: Mapping[str, Any]) -> None:
        self._sparsity, self._stages = sparsity, stages
        counts = {"nx": stages.states, "nu": stages.controls, "ng": stages.others}
        options = {"N": len(stages.states) - 1, **counts, "inf": UNBOUNDED, "hpipm": settings}
        self._conic = _Conic("hpipm", options)

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers; the guess is not used."""
        columns, order = self._stages.variables, self._stages.rows
        p, a = _matrices(self._sparsity, values)
        lower, upper = values.lower[order], values.upper[order]
        said = self._conic.solve(
            p[columns][:, columns].tocsc(), values.q[columns], a[order][:, columns].tocsc(), lower, upper
        )
        # There are no bounds on variables: what pushes there, or at a row's missing bound, is its infinity.
        leans = max(
            float(np.abs(said.y_box).max(initial=0.0)),
            float(said.y[np.isposinf(upper)].max(initial=0.0)),
            float((-said.y[np.isneginf(lower)]).max(initial=0.0)),
        )
        if said.solved and leans > 1e-6:
            words = f"hpipm: the answer leans on {UNBOUNDED:g}, which stands for infinity"
            return Answer.none(self._sparsity, QpStatus.FAILED, words)

        def in_place() -> Warm:
            z, y = np.empty(len(columns)), np.empty(len(order))
            z[columns], y[order] = said.z, said.y
            return z, y

        return said.answer(self._sparsity, in_place)


@dataclass(frozen=True, eq=False)
class _Said:
    """What a plug-in said, in the order in which it was asked."""

    plugin: str
    solved: bool
    words: Any
    z: Array
    y: Array
    y_box: Array
    iterations: int

    def answer(self, sparsity: Sparsity, point: Callable[[], Warm]) -> Answer:
        """Answer with the point in the program's own order, if it was solved."""
        if not self.solved:
            status = _STATUS.get(self.words, QpStatus.FAILED)
            words = f"{self.plugin}: {_CODES.get(self.words, self.words)}"
            return Answer.none(sparsity, status, words)
        return Answer(QpStatus.SOLVED, *point(), self.iterations)


class _Conic:
    """A plug-in, made when it first sees a program and kept for that sparsity."""

    def __init__(self, plugin: str, options: Mapping[str, Any]) -> None:
        self._plugin, self._options = plugin, {**options, "error_on_fail": False}
        self._function: Any = None

    def solve(
        self, p: Any, q: Array, a: Any, lower: Array, upper: Array,
        box_lower: Array | float = -np.inf, box_upper: Array | float = np.inf,
    ) -> _Said:  # fmt: skip
        """Ask for the optimum of a program with csc matrices of always the same pattern."""
        if self._function is None:
            self._pattern_p, self._pattern_a = _pattern(p), _pattern(a)
            with _muted():
                self._function = ca.conic(
                    "program", self._plugin, {"h": self._pattern_p, "a": self._pattern_a}, self._options
                )
        said = self._function(
            h=ca.DM(self._pattern_p, p.data), a=ca.DM(self._pattern_a, a.data), g=q, lba=lower, uba=upper,
            lbx=box_lower, ubx=box_upper,
        )  # fmt: skip
        stats = self._function.stats()
        z, y, y_box = (np.array(said[key], dtype=float).ravel() for key in ("x", "lam_a", "lam_x"))
        solved, iterations = bool(stats["success"]), int(stats["iter_count"])
        return _Said(self._plugin, solved, stats["return_status"], z, y, y_box, iterations)


def _checked(plugin: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with the defaults, tried on a program of one variable and one row."""
    if not ca.has_conic(plugin):
        built = f"CasADi {ca.CasadiMeta.version()} was built without its plug-in {plugin}"
        raise SolverError(f"{built}; the wheels of the package index have it: pip install casadi")
    chosen = {**DEFAULTS[plugin], **settings}
    options = dict(chosen) if plugin == "qpoases" else {plugin: chosen}
    if plugin == "hpipm":
        options |= {"N": 1, "nx": [0, 0], "nu": [1, 0], "ng": [1, 0]}
    one = ca.Sparsity.dense(1, 1)
    try:
        with _muted():
            ca.conic("settings", plugin, {"h": one, "a": one}, options)
    except RuntimeError as error:
        fault = re.split(r"\S+\.cpp:\d+: ", str(error))[-1].split("\n\n")[0]
        raise TypeError(f"{' '.join(fault.split())} (settings {settings})") from error
    return chosen


def _matrices(sparsity: Sparsity, values: Values) -> tuple[Any, Any]:
    """P and A in column-major order with an entry wherever the sparsity has one."""
    n, m = sparsity.variables, sparsity.constraints
    return (
        sparse.csc_matrix((values.p, sparsity.p_rows, sparsity.p_starts), shape=(n, n)),
        sparse.csc_matrix((values.a, sparsity.a_rows, sparsity.a_starts), shape=(m, n)),
    )


def _pattern(matrix: Any) -> Any:
    """CasADi's pattern of a csc matrix; sorts the matrix."""
    matrix.sort_indices()
    rows, columns = matrix.shape
    return ca.Sparsity(rows, columns, matrix.indptr.tolist(), matrix.indices.tolist())


def _single(rows: Any) -> tuple[Any, Any, Array]:
    """Rows of a csr matrix with one entry, its variable and number; of several on a variable the first."""
    alone = np.flatnonzero(np.diff(rows.indptr) == 1)
    variable = rows.indices[rows.indptr[alone]]
    _, first = np.unique(variable, return_index=True)
    return alone[first], variable[first], rows.data[rows.indptr[alone]][first]


_MUTING = threading.Lock()


class _Deaf(io.TextIOBase):
    """Standard output that leaves out what one thread writes."""

    def __init__(self, out: TextIO) -> None:
        self._out, self._thread = out, threading.get_ident()

    def write(self, text: str) -> int:
        """Write the text of the others."""
        return len(text) if threading.get_ident() == self._thread else self._out.write(text)

    def flush(self) -> None:
        """Flush what is underneath."""
        self._out.flush()


@contextmanager
def _muted() -> Iterator[None]:
    """Keep quiet while a plug-in is made: qpOASES writes its banner before it can be told not to."""
    with _MUTING, redirect_stdout(_Deaf(sys.stdout)):
        yield
