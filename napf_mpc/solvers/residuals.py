"""KKT residuals of many programs of one sparsity in one compiled loop, on unscaled data."""

from __future__ import annotations

import math

import numpy as np

from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.quadratic_program import Array, Index, Sparsity, Values

Listed = tuple[Index, Index, Index, Index, Array, Array, Array, Array, Array, Array, Array]


def _listed(sparsity: Sparsity, values: Values, z: Array, y: Array) -> Listed:
    """Pattern, numbers, points and multipliers of programs as one list, in the order of the loops below."""
    n, m = sparsity.variables, sparsity.constraints
    count = math.prod(z.shape[:-1])
    return (
        sparsity.p_starts, sparsity.p_rows, sparsity.a_starts, sparsity.a_rows,
        values.p.reshape(count, len(sparsity.p_rows)), values.q.reshape(count, n),
        values.a.reshape(count, len(sparsity.a_rows)), values.lower.reshape(count, m),
        values.upper.reshape(count, m), z.reshape(count, n), y.reshape(count, m),
    )  # fmt: skip


def kkt_residuals(sparsity: Sparsity, values: Values, z: Array, y: Array) -> tuple[Array, Array, Array]:
    """Residuals as :class:`~napf_mpc.quadratic_program.Residuals` defines them, of all programs.

    Parameters
    ----------
    sparsity : Sparsity
        Of all programs.
    values : Values
        Numbers (run, uav, ...).
    z, y : array, shapes (run, uav, n) and (run, uav, m)
        Points and multipliers; a program with a number that is not finite, there or among its own (but for
        bounds that do not exist), gets infinite residuals.

    Returns
    -------
    primal, dual, complementarity : array, shape (run, uav)
        Largest row violation, largest entry of ``P z + q + A' y``, largest multiplier times gap.
    """
    batch = z.shape[:-1]
    out = np.empty((math.prod(batch), 3))
    _residuals(*_listed(sparsity, values, z, y), out)
    primal, dual, complementarity = out.T.reshape(3, *batch)
    return primal, dual, complementarity


@compiled_bare
def _is_row(lower: float, value: float, upper: float) -> bool:
    """Whether a row has a value and bounds; these may be infinite."""
    return bool(np.isfinite(value)) and not (np.isnan(lower) or np.isnan(upper))


@compiled
def _residuals(
    p_starts: Index, p_rows: Index, a_starts: Index, a_rows: Index,
    p: Array, q: Array, a: Array, lower: Array, upper: Array, z: Array, y: Array, out: Array,
) -> None:  # fmt: skip
    n, m = z.shape[1], y.shape[1]
    rows = np.empty(m)
    for i in range(z.shape[0]):
        primal, dual, product, finite = 0.0, 0.0, 0.0, True
        rows[:] = 0.0
        for j in range(n):
            finite = finite and np.isfinite(z[i, j])
            gradient = q[i, j]
            # P is symmetric: its column is its row.
            for k in range(p_starts[j], p_starts[j + 1]):
                gradient += p[i, k] * z[i, p_rows[k]]
            for k in range(a_starts[j], a_starts[j + 1]):
                gradient += a[i, k] * y[i, a_rows[k]]
                rows[a_rows[k]] += a[i, k] * z[i, j]
            finite = finite and np.isfinite(gradient)
            dual = max(dual, abs(gradient))
        for r in range(m):
            multiplier = y[i, r]
            finite = finite and np.isfinite(multiplier) and _is_row(lower[i, r], rows[r], upper[i, r])
            over, under = rows[r] - upper[i, r], lower[i, r] - rows[r]
            primal = max(primal, over, under)
            gap = over if multiplier > 0.0 else under
            # A multiplier on a bound that does not exist is an error as large as the multiplier itself.
            product = max(product, abs(multiplier) * (abs(gap) if np.isfinite(gap) else 1.0))
        # NaN would lose every comparison above and pass for zero.
        out[i] = np.array([primal, dual, product]) if finite else np.full(3, np.inf)


def relative_residuals(sparsity: Sparsity, values: Values, z: Array, y: Array) -> Array:
    """Largest KKT residual of all programs, each over one or its own largest term.

    Parameters
    ----------
    sparsity : Sparsity
        Of all programs.
    values : Values
        Numbers (run, uav, ...).
    z, y : array, shapes (run, uav, n) and (run, uav, m)
        Points and multipliers; a program with a number that is not finite, there or among its own (but for
        bounds that do not exist), gets infinity.

    Returns
    -------
    array, shape (run, uav)
        No unit: 1e-9 means nine digits in every sum that ought to vanish.
    """
    batch = z.shape[:-1]
    out = np.empty(math.prod(batch))
    _relative(*_listed(sparsity, values, z, y), out)
    return out.reshape(batch)


@compiled
def _relative(
    p_starts: Index, p_rows: Index, a_starts: Index, a_rows: Index,
    p: Array, q: Array, a: Array, lower: Array, upper: Array, z: Array, y: Array, out: Array,
) -> None:  # fmt: skip
    n, m = z.shape[1], y.shape[1]
    rows, sizes = np.empty(m), np.empty(m)
    for i in range(z.shape[0]):
        rows[:], sizes[:] = 0.0, 0.0
        primal, dual, product, finite = 0.0, 0.0, 0.0, True
        # No bound counts as a term: a wide one would excuse a row that is far from it.
        primal_term, dual_term, product_term = 1.0, 1.0, 1.0
        for j in range(n):
            gradient = q[i, j]
            dual_term = max(dual_term, abs(gradient))
            for k in range(p_starts[j], p_starts[j + 1]):
                term = p[i, k] * z[i, p_rows[k]]
                gradient += term
                dual_term = max(dual_term, abs(term))
            for k in range(a_starts[j], a_starts[j + 1]):
                term = a[i, k] * y[i, a_rows[k]]
                gradient += term
                dual_term = max(dual_term, abs(term))
                value = a[i, k] * z[i, j]
                rows[a_rows[k]] += value
                sizes[a_rows[k]] += abs(value)
                primal_term = max(primal_term, abs(value))
            finite = finite and np.isfinite(gradient) and np.isfinite(z[i, j])
            dual = max(dual, abs(gradient))
        for r in range(m):
            multiplier = y[i, r]
            finite = finite and np.isfinite(multiplier) and _is_row(lower[i, r], rows[r], upper[i, r])
            low = abs(lower[i, r]) if np.isfinite(lower[i, r]) else 0.0
            high = abs(upper[i, r]) if np.isfinite(upper[i, r]) else 0.0
            over, under = rows[r] - upper[i, r], lower[i, r] - rows[r]
            primal = max(primal, over, under)
            gap = over if multiplier > 0.0 else under
            product = max(product, abs(multiplier) * (abs(gap) if np.isfinite(gap) else 1.0))
            product_term = max(product_term, abs(multiplier) * max(sizes[r], low, high))
        largest = max(primal / primal_term, dual / dual_term, product / product_term)
        out[i] = largest if finite else np.inf
