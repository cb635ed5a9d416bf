"""The kernel solver's method once more in plain NumPy, to read and to check against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import nnls

from napf_mpc.constraints.constraint import SIGNALS, LinearRows
from napf_mpc.qp import HorizonModel, HorizonQp, QpStatus

Array = NDArray[np.float64]
INF = np.inf
FAR = 1e6
"""How many times as far as the farthest hard row alone plans must lie that are taken for none."""


class PlainActiveSet:
    """Goldfarb and Idnani on the condensed program of one UAV, with a dense solve for every step.

    Rows are ``n' u + s >= bound``; a group's slack is zero while the group is closed.
    """

    def __init__(self, horizon: HorizonQp, run: int, uav: int) -> None:
        model, stages = horizon.model, horizon.model.stages
        moved, drift = np.zeros((stages, 12, 4 * stages)), np.zeros((stages, 12))
        state, free = np.zeros((12, 4 * stages)), horizon.initial[run, uav]
        for k in range(stages):
            state, free = model.a[k] @ state, model.a[k] @ free
            state[:, 4 * k : 4 * k + 4] += model.b[k]
            moved[k], drift[k] = state, free
        flat = moved.reshape(-1, 4 * stages)
        hessian = flat.T @ block_diag(*model.q) @ flat + block_diag(*model.r)
        pull = flat.T @ block_diag(*model.q) @ (drift - horizon.reference[run, uav]).ravel()
        self.hessian, self.free = hessian, -np.linalg.solve(hessian, pull)
        self.moved, self.drift = moved, drift
        self.normals: list[Array] = []
        self.bounds: list[float] = []
        self.groups: list[int] = []
        self.prices: list[tuple[float, float]] = []
        for block in horizon.rows:
            self._add(block, model, run, uav)

    def _add(self, block: LinearRows, model: HorizonModel, run: int, uav: int) -> None:
        places = np.array(SIGNALS[block.signal])
        for k in range(model.stages):
            signal = (
                np.eye(4 * model.stages)[4 * k + places] if block.signal == "input" else self.moved[k, places]
            )
            offset = np.zeros(len(places)) if block.signal == "input" else self.drift[k, places]
            first = len(self.prices)
            if block.w1 is not None and block.w2 is not None:
                both = zip(block.w1[run, uav, k], block.w2[run, uav, k], strict=True)
                self.prices += [(w1 * model.step_s[k], w2 * model.step_s[k]) for w1, w2 in both]
            for j, jac in enumerate(block.jac[run, uav, k]):
                for sign, bound in ((1.0, block.lower), (-1.0, block.upper)):
                    if bound is not None and np.isfinite(bound[run, uav, k, j]):
                        self.normals.append(sign * jac @ signal)
                        self.bounds.append(sign * (bound[run, uav, k, j] - jac @ offset))
                        self.groups.append(
                            -1 if not block.soft else first if block.shared_slack else first + j
                        )

    def contradictory(self) -> bool:
        """Whether no plan within reach meets all hard rows.

        In the cost's measure, with the farthest row alone at a distance of one, the nearest plan that meets
        ``N u >= m`` lies at ``rho``, and ``1 / (1 + rho^2)`` is the least ``|N' d|^2 + (m' d - 1)^2`` over
        ``d >= 0``: at zero the weights d are a certificate of Farkas.
        """
        hard = np.flatnonzero(np.array(self.groups) < 0)
        if not hard.size:
            return False
        normals, bounds = np.array(self.normals)[hard], np.array(self.bounds)[hard]
        rows = solve_triangular(np.linalg.cholesky(self.hessian), normals.T, lower=True).T
        miss, length = bounds - normals @ self.free, np.linalg.norm(rows, axis=1)
        moves = length > 0.0
        if (miss[~moves] > 0.0).any():
            return True
        rows, miss = rows[moves] / length[moves, None], miss[moves] / length[moves]
        if not (miss > 0.0).any():
            return False
        both = np.vstack([rows.T, miss / np.abs(miss).max()])
        return bool(nnls(both, np.eye(len(both))[-1], maxiter=30 * both.shape[1])[1] < 1.0 / FAR)

    def solve(self) -> tuple[QpStatus, Array]:
        """Status and inputs (4 N,); inaccurate if rounding alone says that rows contradict each other."""
        if not self.normals:
            return QpStatus.SOLVED, self.free
        normals, bounds, groups = np.array(self.normals), np.array(self.bounds), np.array(self.groups)
        response = np.linalg.solve(self.hessian, normals.T)
        gram = normals @ response
        w1 = np.array([w for w, _ in self.prices] + [INF])
        w2 = np.array([w for _, w in self.prices] + [1.0])
        is_open, mult = w1 <= 0.0, np.zeros(len(bounds))
        members: list[int] = []
        for _ in range(2000):
            total = np.bincount(groups % len(w1), mult, len(w1))
            slack = np.where(is_open, (total - np.where(is_open, w1, 0.0)) / w2, 0.0)
            violation = bounds - normals @ self.free - gram @ mult - slack[groups]
            violation[members] = 0.0
            row, group = int(violation.argmax()), int(slack.argmin())
            if max(violation[row], -slack[group]) < 1e-10:
                return QpStatus.SOLVED, self.free + response @ mult
            closing = -slack[group] > violation[row]
            group = group if closing else int(groups[row])
            left = -slack[group] if closing else violation[row]
            while True:
                tie = (groups[:, None] == groups) * np.where(is_open, 1.0 / w2, 0.0)[groups]
                whole = gram + tie
                new = (groups[members] == group) / w2[group] if closing else whole[members, row]
                size = 1.0 / w2[group] if closing else whole[row, row]
                step = np.linalg.solve(whole[np.ix_(members, members)], new)
                fresh = size - new @ step
                change = np.zeros(len(bounds))
                change[members] = -step
                if not closing:
                    change[row] = 1.0
                rate = np.bincount(groups % len(w1), change, len(w1))
                total = np.bincount(groups % len(w1), mult, len(w1))
                lengths = [(left / fresh if fresh > 1e-10 * size else INF, "full", 0)]
                lengths += [(mult[j] / -change[j], "drop", j) for j in members if change[j] < 0.0]
                lengths += [
                    ((w1[g] - total[g]) / rate[g], "open", int(g))
                    for g in np.flatnonzero(~is_open & (rate > 0.0))
                ]
                length, event, which = min(lengths)
                if length == INF:
                    none = self.contradictory()
                    return QpStatus.PRIMAL_INFEASIBLE if none else QpStatus.INACCURATE, self.free * np.nan
                mult += length * change
                left -= length * fresh
                if event == "drop":
                    members.remove(which)
                    mult[which] = 0.0
                elif event == "open":
                    is_open[which] = True
                else:
                    break
            if closing:
                is_open[group] = False
            else:
                members.append(row)
        none = self.contradictory()
        return QpStatus.PRIMAL_INFEASIBLE if none else QpStatus.MAX_ITERATIONS, self.free * np.nan
