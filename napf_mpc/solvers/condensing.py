"""Condensing: variables that leading equalities give one after the other are eliminated.

In a program of a horizon these are the states, which the dynamics give as functions of the inputs. Inputs and
slacks are left: what a solver with dense factors wants to see.

H. G. Bock, K. J. Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", IFAC
World Congress 1984.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular

from napf_mpc.quadratic_program import Array, Sparsity, Values


@dataclass(frozen=True, eq=False)
class Condensed:
    """Program in the variables w that are left: minimise ``w' H w / 2 + g' w`` with ``l <= R w <= u``.

    The k variables that are gone are ``x = gain w + offset``.
    """

    hessian: Any
    """(v, v) sparse H."""
    gradient: Array
    """(v,) g."""
    rows: Any
    """(m - k, v) sparse R."""
    lower: Array
    """(m - k,) l."""
    upper: Array
    """(m - k,) u."""
    gain: Any
    """(k, v) sparse."""
    offset: Array
    """(k,)."""
    _p: Any
    _q: Array
    _a: Any
    _unit: Array

    def expand(self, w: Array, y: Array) -> tuple[Array, Array]:
        """Point and multipliers of the whole program.

        Parameters
        ----------
        w : array, shape (v,)
            Point of the condensed program.
        y : array, shape (m - k,)
            Multipliers of its rows.

        Returns
        -------
        z : array, shape (n,)
            With the variables that were gone.
        y : array, shape (m,)
            With the multipliers of the equalities, from the gradient of the Lagrangian in those variables.
        """
        k = len(self.offset)
        z = np.concatenate([self.gain @ w + self.offset, w])
        slope = (self._p @ z + self._q)[:k] + self._a[k:, :k].T @ y
        given = solve_triangular(self._unit, -slope, trans="T", lower=True, unit_diagonal=True)
        return z, np.concatenate([given, y])


def determined(sparsity: Sparsity, values: Values) -> int:
    """How many leading variables the leading rows give one after the other.

    Parameters
    ----------
    sparsity : Sparsity
        Of the program.
    values : Values
        Its numbers (no leading axes).

    Returns
    -------
    int
        Largest k, smaller than the number of variables, so that the first k rows are equalities and a unit
        lower triangular matrix in the first k variables. In a horizon of N stages at least ``12 N``.
    """
    rows, columns = sparsity.a_rows, sparsity.a_columns
    unit = np.zeros(sparsity.constraints, dtype=bool)
    on_diagonal = rows == columns
    unit[rows[on_diagonal]] = values.a[on_diagonal] == 1.0
    unit &= values.lower == values.upper
    leading = len(unit) if unit.all() else int(np.argmin(unit))
    # A row may hold later variables, but none of the k.
    first_later = np.full(sparsity.constraints, sparsity.variables)
    later = columns > rows
    np.minimum.at(first_later, rows[later], columns[later])
    fits = np.arange(1, leading + 1) <= np.minimum.accumulate(first_later)[:leading]
    return min(int(fits.sum()), sparsity.variables - 1)


class Condenser:
    """Condenses programs of one sparsity; keeps what depends on the equalities' matrix alone."""

    def __init__(self, sparsity: Sparsity) -> None:
        self._sparsity = sparsity
        self._count = -1
        self._dynamics: Any = None
        self._unit = np.zeros((0, 0))
        self._gain: Any = None

    def condense(self, values: Values) -> Condensed:
        """Program without the variables that are :func:`determined`.

        Parameters
        ----------
        values : Values
            Numbers of a program (no leading axes), usable.

        Returns
        -------
        Condensed
            With the same optimum, and the same multipliers of the rows that are left.
        """
        places, n, m = self._sparsity, self._sparsity.variables, self._sparsity.constraints
        k = determined(places, values)
        p: Any = sparse.csr_matrix((values.p, (places.p_rows, places.p_columns)), shape=(n, n))
        a: Any = sparse.csr_matrix((values.a, (places.a_rows, places.a_columns)), shape=(m, n))
        dynamics = a[:k]
        if k != self._count or not np.array_equal(dynamics.data, self._dynamics.data):
            self._count, self._dynamics = k, dynamics
            self._unit = dynamics[:, :k].toarray()
            self._gain = sparse.csr_matrix(self._forward(-dynamics[:, k:].toarray()))
        gain, offset = self._gain, self._forward(values.lower[:k])
        coupling = p[k:, :k] @ gain
        rest = a[k:]
        shift = rest[:, :k] @ offset
        return Condensed(
            hessian=p[k:, k:] + coupling + coupling.T + gain.T @ p[:k, :k] @ gain,
            gradient=values.q[k:] + p[k:, :k] @ offset + gain.T @ (values.q[:k] + p[:k, :k] @ offset),
            rows=rest[:, k:] + rest[:, :k] @ gain,
            lower=values.lower[k:] - shift,
            upper=values.upper[k:] - shift,
            gain=gain, offset=offset, _p=p, _q=values.q, _a=a, _unit=self._unit,
        )  # fmt: skip

    def _forward(self, right: Array) -> Array:
        solved: Array = solve_triangular(self._unit, right, lower=True, unit_diagonal=True)
        return solved
