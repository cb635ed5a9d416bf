"""Nonlinear MPC: the planner's programs with the quadrotor as it is instead of its linearisation at hover.

Everything but the dynamics stays: stages, references, weights, rows with their slacks and prices. The states
at the ends of the stages are variables (multiple shooting) that Runge-Kutta steps of the nonlinear model
join, and IPOPT solves it.

A. Waechter, L. T. Biegler, "On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming", Mathematical Programming 106, 2006.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from napf_mpc.problem import Vehicle
from napf_mpc.qp import INPUTS, STATES, Array, HorizonQp, Layout
from napf_mpc.solvers.solver import Warm
from napf_mpc.vehicle.quadrotor import STATE_NAMES, derivative_function, hover_input, parameters

LONGEST_STEP_S = 0.1
"""No Runge-Kutta step is longer [s]."""
OPTIONS: dict[str, Any] = {
    "print_time": False, "error_on_fail": False, "expand": True,
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 300},
}  # fmt: skip
"""Of IPOPT, from nothing."""
WARM_OPTIONS: dict[str, Any] = {
    "warm_start_init_point": "yes", "warm_start_bound_push": 1e-6, "warm_start_slack_bound_push": 1e-6,
    "warm_start_mult_bound_push": 1e-6, "mu_init": 1e-4,
}  # fmt: skip
"""Of IPOPT, from a guess: it stays where it is, near bounds too, and the barrier starts low."""


@dataclass(frozen=True, eq=False)
class NonlinearAnswer:
    """What IPOPT said to one program."""

    solved: bool
    """What it claims."""
    words: str
    """The same in its words."""
    z: Array
    """(n,) states, inputs about hover and slacks as a :class:`~napf_mpc.qp.Layout` orders them."""
    iterations: int


class NonlinearProgram:
    """The nonlinear programs of one vehicle and one layout.

    Parameters
    ----------
    vehicle : Vehicle
        Whose dynamics hold.
    horizon : HorizonQp
        Any of the horizons to solve: all must have its stages and kinds of rows.
    """

    def __init__(self, vehicle: Vehicle, horizon: HorizonQp) -> None:
        self._layout = layout = Layout.of(horizon)
        self._vehicle, self._step_s = vehicle, horizon.model.step_s
        places, n = layout.sparsity, layout.sparsity.variables
        self._kept = places.a_rows >= STATES * layout.stages
        rows = places.a_rows[self._kept] - STATES * layout.stages
        count = places.constraints - STATES * layout.stages
        hessian = ca.Sparsity(n, n, places.p_starts.tolist(), places.p_rows.tolist())
        starts = np.searchsorted(places.a_columns[self._kept], np.arange(n + 1))
        pattern = ca.Sparsity(count, n, starts.tolist(), rows.tolist())
        z, x0 = ca.SX.sym("z", n), ca.SX.sym("x0", STATES)
        q, p, a = ca.SX.sym("q", n), ca.SX.sym("p", hessian.nnz()), ca.SX.sym("a", pattern.nnz())
        cost = 0.5 * ca.bilin(ca.SX(hessian, p), z, z) + ca.dot(q, z)
        gaps = self._gaps(z, x0, LONGEST_STEP_S)
        given = ca.vertcat(gaps, ca.SX(pattern, a) @ z)
        nlp = {"x": z, "p": ca.vertcat(x0, q, p, a), "f": cost, "g": given}
        warm = {**OPTIONS, "ipopt": {**OPTIONS["ipopt"], **WARM_OPTIONS}}
        self._cold_solver = ca.nlpsol("cold", "ipopt", nlp, OPTIONS)
        self._warm_solver = ca.nlpsol("warm", "ipopt", nlp, warm)
        fine = ca.vertcat(self._gaps(z, x0, 0.25 * LONGEST_STEP_S), ca.SX(pattern, a) @ z)
        self._given = ca.Function("given", [z, nlp["p"]], [fine])

    def _gaps(self, z: Any, x0: Any, longest_s: float) -> Any:
        """Where each stage ends, by the model, less its state (12 N,)."""
        stages, model = self._layout.stages, derivative_function()
        states = ca.reshape(z[: STATES * stages], STATES, stages)
        inputs = ca.reshape(z[STATES * stages : (STATES + INPUTS) * stages], INPUTS, stages)
        hover, constants = ca.DM(hover_input(self._vehicle)), ca.DM(parameters(self._vehicle))
        gaps = []
        for k, step_s in enumerate(self._step_s.tolist()):
            turns = math.ceil(step_s / longest_s - 1e-9)
            h, u = step_s / turns, inputs[:, k] + hover
            x = x0 if k == 0 else states[:, k - 1]
            for _ in range(turns):
                k1 = model(x, u, constants)
                k2 = model(x + 0.5 * h * k1, u, constants)
                k3 = model(x + 0.5 * h * k2, u, constants)
                k4 = model(x + h * k3, u, constants)
                x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            gaps.append(states[:, k] - x)
        return ca.vertcat(*gaps)

    def solve(self, horizon: HorizonQp, warm: Warm | None) -> NonlinearAnswer:
        """Solve the program of a horizon of one run and one UAV.

        Parameters
        ----------
        horizon : HorizonQp
            Of the program's layout.
        warm : tuple of array, shapes (n,) and (m,), optional
            Guess of point and multipliers, such as the quadratic program's; hover where it is now without.

        Returns
        -------
        NonlinearAnswer
            Whatever IPOPT makes of it.

        Raises
        ------
        KeyboardInterrupt
            Also when IPOPT took the interrupt for itself.
        """
        numbers, lower, upper = self._numbers(horizon)
        bounds = {"p": numbers, "lbg": lower, "ubg": upper}
        if warm is not None and np.isfinite(warm[0]).all() and np.isfinite(warm[1]).all():
            solver, guess = self._warm_solver, {"x0": warm[0], "lam_g0": warm[1]}
        else:
            kept = [0, 2, 4, STATE_NAMES.index("yaw")]
            still = np.zeros(STATES)
            still[kept] = horizon.initial[0, 0, kept]
            z = np.zeros(self._layout.sparsity.variables)
            z[: STATES * self._layout.stages] = np.tile(still, self._layout.stages)
            solver, guess = self._cold_solver, {"x0": z}
        said = solver(**bounds, **guess)
        stats, z = solver.stats(), np.array(said["x"], dtype=float).ravel()
        if stats["return_status"] == "User_Requested_Stop":
            # Nobody else stops it: CasADi has told IPOPT of an interrupt and keeps it to itself.
            raise KeyboardInterrupt
        return NonlinearAnswer(
            bool(stats["success"]), str(stats["return_status"]), z, int(stats["iter_count"])
        )

    def violation(self, horizon: HorizonQp, z: Array) -> float:
        """How far a point is from keeping the rows and the nonlinear dynamics.

        Parameters
        ----------
        horizon : HorizonQp
            As for :meth:`solve`.
        z : array, shape (n,)
            Point, of IPOPT or of the quadratic program's solver.

        Returns
        -------
        float
            Largest violation of a row, or distance of a state from where the stage ends by Runge-Kutta steps
            a quarter as long as those that were solved with [m, m/s, rad, rad/s or N]; infinite for a point
            that is not finite.
        """
        numbers, lower, upper = self._numbers(horizon)
        rows = np.array(self._given(z, numbers), dtype=float).ravel()
        if not np.isfinite(rows).all():
            return float("inf")
        return float(np.maximum(rows - upper, lower - rows).max(initial=0.0))

    def _numbers(self, horizon: HorizonQp) -> tuple[Array, Array, Array]:
        """Parameters, and bounds of the gaps and rows."""
        values, first = self._layout.values(horizon).of(0, 0), STATES * self._layout.stages
        numbers = np.concatenate([horizon.initial[0, 0], values.q, values.p, values.a[self._kept]])
        lower, upper = values.lower.copy(), values.upper.copy()
        # The quadratic program has the state now on the right-hand side of its first stage.
        lower[:first] = upper[:first] = 0.0
        return numbers, lower, upper
