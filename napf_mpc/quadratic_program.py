"""A quadratic program as plain matrices, checked when it is made, and an answer with its own KKT residuals.

Minimise ``z' P z / 2 + q' z`` subject to ``l <= A z <= u``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from napf_mpc.errors import NapfError

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class QpError(NapfError, ValueError):
    """A quadratic program is not one: shapes, numbers that are not finite, crossed bounds, P not convex."""


class QpStatus(StrEnum):
    """What became of a program, in one vocabulary for all solvers."""

    SOLVED = "solved"
    """Optimal within the solver's tolerance."""
    INACCURATE = "inaccurate"
    """Stopped near a solution, outside the tolerance."""
    MAX_ITERATIONS = "max_iterations"
    """Gave up at the limit of iterations or time."""
    PRIMAL_INFEASIBLE = "primal_infeasible"
    """No point satisfies the rows."""
    DUAL_INFEASIBLE = "dual_infeasible"
    """The objective has no lower bound."""
    FAILED = "failed"
    """Anything else: an exception of the solver, numbers that it must not be given."""
    SKIPPED = "skipped"
    """Not asked: the run is masked."""


@dataclass(frozen=True)
class Residuals:
    """KKT residuals on the program's own, unscaled data."""

    primal: float
    """Largest violation of ``l <= A z <= u``."""
    dual: float
    """Largest entry of ``P z + q + A' y``."""
    complementarity: float
    """Largest product of a multiplier and the distance to the bound that its sign names."""

    def within(self, primal: float, dual: float, complementarity: float = np.inf) -> bool:
        """Whether all residuals are numbers and within limits."""
        return bool(self.primal <= primal and self.dual <= dual and self.complementarity <= complementarity)


@dataclass(frozen=True, eq=False)
class Sparsity:
    """Where P and A have entries, in column-major order; a solver keeps its workspace while it stays."""

    variables: int
    """Number of variables n."""
    constraints: int
    """Number of rows m."""
    p_rows: Index
    """(nonzeros of P), both triangles."""
    p_columns: Index
    """(nonzeros of P), not decreasing."""
    a_rows: Index
    """(nonzeros of A)."""
    a_columns: Index
    """(nonzeros of A), not decreasing."""

    @cached_property
    def p_starts(self) -> Index:
        """(n + 1,) where each column of P starts."""
        return np.searchsorted(self.p_columns, np.arange(self.variables + 1))

    @cached_property
    def a_starts(self) -> Index:
        """(n + 1,) where each column of A starts."""
        return np.searchsorted(self.a_columns, np.arange(self.variables + 1))

    def same_as(self, other: Sparsity) -> bool:
        """Whether the other has the same shape and the same places."""
        return (self.variables, self.constraints) == (other.variables, other.constraints) and all(
            np.array_equal(mine, theirs)
            for mine, theirs in (
                (self.p_rows, other.p_rows),
                (self.p_columns, other.p_columns),
                (self.a_rows, other.a_rows),
                (self.a_columns, other.a_columns),
            )
        )


@dataclass(frozen=True, eq=False)
class Values:
    """The numbers of programs of one sparsity; leading axes (run, uav), or none for a single program."""

    p: Array
    """(..., nonzeros of P)."""
    q: Array
    """(..., n)."""
    a: Array
    """(..., nonzeros of A)."""
    lower: Array
    """(..., m)."""
    upper: Array
    """(..., m)."""

    def of(self, run: int, uav: int) -> Values:
        """Numbers of one UAV's program."""
        at = (run, uav)
        return Values(self.p[at], self.q[at], self.a[at], self.lower[at], self.upper[at])

    def copy(self) -> Values:
        """The same numbers in arrays of their own."""
        return Values(self.p.copy(), self.q.copy(), self.a.copy(), self.lower.copy(), self.upper.copy())

    def usable(self) -> NDArray[np.bool_]:
        """Whether each program (...) may be shown to a solver: finite numbers, bounds in order."""
        finite = np.isfinite(self.p).all(-1) & np.isfinite(self.q).all(-1) & np.isfinite(self.a).all(-1)
        # NaN fails every comparison.
        ordered = (self.lower <= self.upper).all(-1)
        sides = (self.lower < np.inf).all(-1) & (self.upper > -np.inf).all(-1)
        return np.asarray(finite & ordered & sides)


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """Minimise ``z' P z / 2 + q' z`` subject to ``l <= A z <= u``; checked when it is made.

    Matrices may come dense or in any sparse form, vectors as lists: they are kept as the fields say.

    Raises
    ------
    QpError
        Naming everything that is wrong.
    """

    p: sparse.csc_array
    """(n, n) symmetric, both triangles given, positive semi-definite."""
    q: Array
    """(n,) linear cost, n > 0."""
    a: sparse.csc_array
    """(m, n) rows; m may be 0."""
    lower: Array
    """(m,) bounds, -inf where there is none; equal to the upper one for an equality."""
    upper: Array
    """(m,) bounds, +inf where there is none."""

    def __post_init__(self) -> None:
        faults: list[str] = []
        for field, name, formed in (
            ("p", "P", _matrix), ("q", "q", _vector), ("a", "A", _matrix), ("lower", "l", _vector),
            ("upper", "u", _vector),
        ):  # fmt: skip
            try:
                object.__setattr__(self, field, formed(getattr(self, field)))
            except (TypeError, ValueError) as error:
                faults.append(f"{name} {error}")
        faults = faults or self._shape_faults() or self._value_faults()
        if faults:
            raise QpError("; ".join(faults))

    @classmethod
    def of_values(cls, sparsity: Sparsity, values: Values) -> QuadraticProgram:
        """Program of numbers (no leading axes) in their places."""
        n, m = sparsity.variables, sparsity.constraints
        return cls(
            p=sparse.csc_array((values.p, sparsity.p_rows, sparsity.p_starts), shape=(n, n)),
            q=values.q,
            a=sparse.csc_array((values.a, sparsity.a_rows, sparsity.a_starts), shape=(m, n)),
            lower=values.lower,
            upper=values.upper,
        )

    def split(self) -> tuple[Sparsity, Values]:
        """Places and numbers, each place once and in column-major order."""
        p, a = self.p.copy(), self.a.copy()
        for matrix in (p, a):
            matrix.sum_duplicates()
        (n, m), columns = (len(self.q), len(self.lower)), np.arange(len(self.q))
        sparsity = Sparsity(
            n,
            m,
            p.indices.astype(np.int64),
            np.repeat(columns, np.diff(p.indptr)),
            a.indices.astype(np.int64),
            np.repeat(columns, np.diff(a.indptr)),
        )
        numbers = [np.asarray(v, dtype=float) for v in (p.data, self.q, a.data, self.lower, self.upper)]
        return sparsity, Values(*numbers)

    def _shape_faults(self) -> list[str]:
        faults = [
            f"{name} has {values.ndim} axes, must have 1"
            for name, values in (("q", self.q), ("l", self.lower), ("u", self.upper))
            if values.ndim != 1
        ]
        if faults:
            return faults
        n, m = len(self.q), len(self.lower)
        if n == 0:
            return ["there are no variables"]
        shapes = (("P", self.p.shape, (n, n)), ("A", self.a.shape, (m, n)), ("u", self.upper.shape, (m,)))
        faults = [f"{name} has shape {got}, must be {want}" for name, got, want in shapes if got != want]
        return faults

    def _value_faults(self) -> list[str]:
        numbers = (("P", self.p.data), ("q", self.q), ("A", self.a.data))
        faults = [
            f"{name} has an entry that is not finite" for name, v in numbers if not np.isfinite(v).all()
        ]
        if np.isnan(self.lower).any() or np.isnan(self.upper).any():
            faults.append("a bound is NaN")
        if (self.lower == np.inf).any() or (self.upper == -np.inf).any():
            faults.append("a lower bound is +inf or an upper bound -inf")
        crossed = np.flatnonzero(self.lower > self.upper)
        if len(crossed):
            i = crossed[0]
            faults.append(f"l[{i}] = {self.lower[i]:g} > u[{i}] = {self.upper[i]:g}")
        if not faults:
            asymmetry = abs(self.p - self.p.T)
            if asymmetry.nnz and asymmetry.max() > 1e-9 * max(1.0, abs(self.p).max()):
                faults.append("P is not symmetric; give both triangles")
        return faults

    def check_convex(self) -> None:
        """Refuse a P with a negative eigenvalue (dense: for programs of up to some hundred variables).

        Raises
        ------
        QpError
            Naming the eigenvalue.
        """
        lowest = float(np.linalg.eigvalsh(self.p.toarray()).min())
        if lowest < -1e-9 * max(1.0, float(abs(self.p).max())):
            raise QpError(f"P has the negative eigenvalue {lowest:g}: the program is not convex")

    def objective(self, z: Array) -> float:
        """Value of ``z' P z / 2 + q' z``."""
        return float(0.5 * z @ (self.p @ z) + self.q @ z)

    def residuals(self, z: Array, y: Array) -> Residuals:
        """KKT residuals of a point and multipliers (positive at upper, negative at lower bounds)."""
        if not (np.isfinite(z).all() and np.isfinite(y).all()):
            return Residuals(np.inf, np.inf, np.inf)
        rows = self.a @ z
        over, under = rows - self.upper, self.lower - rows
        dual = np.abs(self.p @ z + self.q + self.a.T @ y)
        # A multiplier on a bound that does not exist is an error as large as the multiplier itself.
        up = np.where(np.isfinite(self.upper), np.abs(over), 1.0) * np.maximum(y, 0.0)
        down = np.where(np.isfinite(self.lower), np.abs(under), 1.0) * np.maximum(-y, 0.0)
        return Residuals(_largest(over, under), _largest(dual), _largest(up, down))


def _matrix(given: Any) -> sparse.csc_array:
    """Matrix by columns, itself if it is one."""
    is_sparse: bool = sparse.issparse(given)
    if is_sparse:
        if hasattr(given, "check_format"):
            try:
                # An index outside makes C code read stray memory, that of a conversion, too.
                given.check_format(full_check=True)
            except ValueError as error:
                raise ValueError(f"is not a valid sparse matrix: {error}") from error
        if given.dtype.kind == "c":
            raise TypeError("does not hold real numbers: they are complex")
        if isinstance(given, sparse.csc_array) and given.dtype == np.float64:
            return given
    else:
        given = _vector(given)
    if given.ndim != 2:
        raise ValueError(f"has {given.ndim} axes, must have 2")
    return sparse.csc_array(given, dtype=np.float64)


def _vector(given: Any) -> Array:
    """Array of numbers, itself if it is one."""
    try:
        if np.iscomplexobj(given):
            raise TypeError("they are complex")
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"does not hold real numbers: {error}") from error


def _largest(*arrays: Array) -> float:
    """Largest entry, at least zero."""
    return max(0.0, *(float(values.max(initial=0.0)) for values in arrays))


@dataclass(frozen=True, eq=False)
class QpResult:
    """What a solver returned for a program, with residuals that are ours."""

    status: QpStatus
    """The solver's word, never trusted alone."""
    z: Array
    """(n,) primal point; NaN where the solver gave none."""
    y: Array
    """(m,) multipliers: positive at an upper, negative at a lower bound."""
    iterations: int
    """Iterations, -1 where the solver does not say."""
    residuals: Residuals
    """KKT residuals on the program's own data."""
    message: str = ""
    """Why it failed, in the solver's words."""

    @classmethod
    def of(
        cls,
        program: QuadraticProgram,
        status: QpStatus,
        z: Array,
        y: Array,
        iterations: int,
        message: str = "",
    ) -> QpResult:
        """Result with its residuals computed here; an array of the wrong shape counts as none."""
        n, m = program.q.shape[0], program.lower.shape[0]
        z, y = held(z, n), held(y, m)
        return cls(status, z, y, iterations, program.residuals(z, y), message)


def held(values: Array, length: int) -> Array:
    """Copy of a solver's vector, or NaN if it does not have the length that it must have."""
    if np.shape(values) != (length,):
        return np.full(length, np.nan)
    return np.array(values, dtype=float)
