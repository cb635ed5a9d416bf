"""The program of one UAV in the hands of general tools, for benchmarks: cvxpy, CVXPYgen and do-mpc.

All are made once for a horizon's shapes and solve new numbers at each step, as their manuals advise (cvxpy
by its parameters, CVXPYgen by C code that it generates for the same parameters and compiles). These two are
given the very program of the planner. do-mpc knows one length of stage only: its program has the size and the
kinds of rows of the planner's, on a grid of even stages, with linear prices of slacks only, and is solved by
IPOPT as any of its programs.
"""

from __future__ import annotations

import contextlib
import io
import sys
from importlib import import_module
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from napf_mpc.constraints.constraint import SIGNALS, LinearRows
from napf_mpc.qp import INPUTS, STATES, HorizonQp

Array = NDArray[np.float64]

OSQP_SETTINGS: dict[str, Any] = {"eps_abs": 1e-4, "eps_rel": 1e-5, "polishing": True}
FAR = 1e4
"""Stands for a bound that is not there: both tools refuse an infinite parameter."""


def finite(bounds: Array) -> Array:
    """Bounds with +-FAR in place of infinity."""
    return np.clip(bounds, -FAR, FAR)


class CvxpyController:
    """The planner's program with cvxpy parameters, solved by OSQP.

    Parameters
    ----------
    horizon : HorizonQp
        Shapes, model and rows that do not change.
    """

    name = "cvxpy, parameters"

    def __init__(self, horizon: HorizonQp) -> None:
        import cvxpy as cp

        self._cp: Any = cp
        model, n = horizon.model, horizon.model.stages
        self._x, self._u = cp.Variable(n * STATES), cp.Variable(n * INPUTS)
        self._initial, self._pull = cp.Parameter(STATES), cp.Parameter(n * STATES)
        roots_q: Any = sparse.block_diag([_root(q) for q in model.q])
        roots_r: Any = sparse.block_diag([_root(r) for r in model.r])
        cost = 0.5 * cp.sum_squares(roots_q @ self._x) + 0.5 * cp.sum_squares(roots_r @ self._u)
        cost = cost - self._pull @ self._x
        carried = sparse.block_diag(list(model.a[1:]))
        empty = sparse.csr_array((STATES, n * STATES))
        below = sparse.hstack([carried, sparse.csr_array(((n - 1) * STATES, STATES))])
        moved = sparse.eye_array(n * STATES) - sparse.vstack([empty, below])
        start = sparse.vstack([sparse.csr_array(model.a[0]), sparse.csr_array(((n - 1) * STATES, STATES))])
        rows = [moved @ self._x - sparse.block_diag(list(model.b)) @ self._u == start @ self._initial]
        self._jac: list[list[Any]] = []
        self._bounds: list[tuple[Any, Any]] = []
        self._stiffness: list[Any] = []
        self._steps = model.step_s
        for block in horizon.rows:
            added, price = self._block(block)
            rows += added
            cost = cost + price
        self._problem = cp.Problem(cp.Minimize(cost), rows)
        self.solved = False
        """Whether it calls its last answer optimal."""

    def _block(self, block: LinearRows) -> tuple[list[Any], Any]:
        """Rows of a block, and what its slacks cost."""
        cp, n, m = self._cp, len(self._steps), block.count
        targets = SIGNALS[block.signal]
        signal, width = (self._u, INPUTS) if block.signal == "input" else (self._x, STATES)
        value, parameters = 0.0, []
        for axis, target in enumerate(targets):
            place = np.repeat(np.arange(n) * width + target, m)
            pick = sparse.csr_array((np.ones(n * m), (np.arange(n * m), place)), shape=(n * m, n * width))
            if block.signal == "position":
                parameters.append(cp.Parameter(n * m))
                value = value + cp.multiply(parameters[-1], pick @ signal)
            else:
                value = value + (sparse.diags_array(block.jac[0, 0, ..., axis].ravel()) @ pick) @ signal
        slack: Any = 0.0
        price: Any = 0.0
        stiffness = None
        if block.w1 is not None:
            per_stage = block.slack_count
            own = cp.Variable(n * per_stage, nonneg=True)
            spread = np.arange(n * m) if per_stage == m else np.repeat(np.arange(n), m)
            slack = (
                sparse.csr_array((np.ones(n * m), (np.arange(n * m), spread)), shape=(n * m, n * per_stage))
                @ own
            )
            stiffness = cp.Parameter(n * per_stage, nonneg=True)
            linear = (block.w1[0, 0] * self._steps[:, None]).ravel()
            price = linear @ own + 0.5 * cp.sum_squares(cp.multiply(stiffness, own))
        self._stiffness.append(stiffness)
        lower = None if block.lower is None else cp.Parameter(n * m)
        upper = None if block.upper is None else cp.Parameter(n * m)
        rows = [] if lower is None else [value + slack >= lower]
        rows += [] if upper is None else [value - slack <= upper]
        self._jac.append(parameters)
        self._bounds.append((lower, upper))
        return rows, price

    def solve(self, horizon: HorizonQp) -> Array:
        """Return the first input (4,) of the first UAV of the first run."""
        at = (0, 0)
        self._initial.value = horizon.initial[at]
        self._pull.value = np.einsum("nij,nj->ni", horizon.model.q, horizon.reference[at]).ravel()
        for block, parameters, bounds, stiffness in zip(
            horizon.rows, self._jac, self._bounds, self._stiffness, strict=True
        ):
            for axis, parameter in enumerate(parameters):
                parameter.value = block.jac[at][..., axis].ravel()
            for parameter, values in zip(bounds, (block.lower, block.upper), strict=True):
                if parameter is not None and values is not None:
                    parameter.value = finite(values[at]).ravel()
            if stiffness is not None and block.w2 is not None:
                stiffness.value = np.sqrt(block.w2[at] * self._steps[:, None]).ravel()
        self._optimise()
        # CVXPYgen says it in OSQP's words.
        self.solved = self._problem.status in (self._cp.OPTIMAL, "solved")
        return np.asarray(self._u.value[:INPUTS], dtype=float)

    def _optimise(self) -> None:
        """Solve the program for the parameters as they stand."""
        self._problem.solve(solver="OSQP", warm_start=True, max_iter=20000, **OSQP_SETTINGS)


class CvxpygenController(CvxpyController):
    """The same program as C code with OSQP inside, generated and compiled once: a minute, and a C compiler.

    Parameters
    ----------
    horizon : HorizonQp
        Shapes, model and rows that do not change.
    """

    name = "CVXPYgen, OSQP"

    def __init__(self, horizon: HorizonQp) -> None:
        super().__init__(horizon)
        cpg: Any = import_module("cvxpygen.cpg")
        self._folder = TemporaryDirectory()
        sys.path.insert(0, self._folder.name)
        try:
            # It imports what it has compiled, by the name of the folder, and registers it as "CPG".
            with contextlib.chdir(self._folder.name), contextlib.redirect_stdout(io.StringIO()):
                cpg.generate_code(
                    self._problem, code_dir=f"generated_{id(self)}", solver="OSQP",
                    solver_opts={"max_iter": 20000}, enable_settings=["polishing"],
                )  # fmt: skip
        finally:
            sys.path.remove(self._folder.name)

    def _optimise(self) -> None:
        self._problem.solve(method="CPG", **OSQP_SETTINGS)


class DoMpcController:
    """A program of the planner's size with do-mpc, on even stages, solved by IPOPT.

    Parameters
    ----------
    horizon : HorizonQp
        Shapes, weights, and rows that do not change.
    a, b : array, shapes (12, 12) and (12, 4)
        Exact hold of the hover model over one stage.
    step_s : float
        Its length [s].
    """

    name = "do-mpc, IPOPT"

    def __init__(self, horizon: HorizonQp, a: Array, b: Array, step_s: float) -> None:
        import casadi as ca

        do_mpc: Any = import_module("do_mpc")

        model: Any = do_mpc.model.Model("discrete", "SX")
        x = model.set_variable("_x", "x", shape=(STATES, 1))
        u = model.set_variable("_u", "u", shape=(INPUTS, 1))
        reference = model.set_variable("_tvp", "reference", shape=(STATES, 1))
        moving = [k for k, block in enumerate(horizon.rows) if block.signal == "position"]
        rows = {
            k: (
                model.set_variable("_tvp", f"normal{k}", shape=(horizon.rows[k].count, 3)),
                model.set_variable("_tvp", f"bound{k}", shape=(horizon.rows[k].count, 1)),
            )
            for k in moving
        }
        model.set_rhs("x", ca.DM(a) @ x + ca.DM(b) @ u)
        model.setup()
        mpc: Any = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step = horizon.model.stages, step_s
        mpc.settings.store_full_solution = False
        mpc.settings.nlpsol_opts.update({"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0})
        away = x - reference
        weights = horizon.model.q[0] / horizon.model.step_s[0] * step_s
        effort = ca.DM(horizon.model.r[0] / horizon.model.step_s[0] * step_s)
        mpc.set_objective(
            lterm=0.5 * away.T @ ca.DM(weights) @ away + 0.5 * u.T @ effort @ u,
            mterm=0.5 * away.T @ ca.DM(horizon.model.q[-1]) @ away,
        )
        mpc.set_rterm(u=1e-6)
        for k, block in enumerate(horizon.rows):
            targets = list(SIGNALS[block.signal])
            if k in rows:
                normal, bound = rows[k]
                short = bound - normal @ x[targets]
                mpc.set_nl_cons(f"rows{k}", short, ub=0.0, soft_constraint=True, penalty_term_cons=300.0)
                continue
            value = ca.DM(block.jac[0, 0, 0]) @ (u if block.signal == "input" else x)[targets]
            for sign, values in ((-1.0, block.lower), (1.0, block.upper)):
                if values is not None:
                    over = sign * (value - ca.DM(values[0, 0, 0]))
                    soft = {"soft_constraint": True, "penalty_term_cons": 300.0} if block.soft else {}
                    mpc.set_nl_cons(f"rows{k}{'+-'[sign < 0]}", over, ub=0.0, **soft)
        self._template = mpc.get_tvp_template()
        self._moving = moving
        mpc.set_tvp_fun(lambda _: self._template)
        mpc.setup()
        self._mpc = mpc
        self._started = False
        self.solved = False
        """Whether it calls its last answer optimal."""

    def solve(self, horizon: HorizonQp) -> Array:
        """Return the first input (4,) of the first UAV of the first run."""
        at, stages = (0, 0), horizon.model.stages
        for k in range(stages + 1):
            stage = min(k, stages - 1)
            self._template["_tvp", k, "reference"] = horizon.reference[at][stage]
            for row in self._moving:
                block = horizon.rows[row]
                assert block.lower is not None
                self._template["_tvp", k, f"normal{row}"] = block.jac[at][stage]
                self._template["_tvp", k, f"bound{row}"] = finite(block.lower[at][stage])
        if not self._started:
            self._mpc.x0 = horizon.initial[at]
            self._mpc.set_initial_guess()
            self._started = True
        inputs = self._mpc.make_step(horizon.initial[at][:, None])
        self.solved = bool(self._mpc.solver_stats["success"])
        return np.asarray(inputs, dtype=float)[:, 0]


def _root(weight: Array) -> Array:
    """Matrix R with R'R = weight, which may have zero eigenvalues."""
    values, vectors = np.linalg.eigh(weight)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
