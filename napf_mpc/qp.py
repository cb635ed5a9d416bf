"""The quadratic programs of many UAVs over a horizon: model, references, rows -> matrices of a fixed layout.

The planner thinks in a :class:`HorizonQp`: model, references and rows on named signals, for every (run, UAV)
at once. A general solver sees one :class:`~napf_mpc.quadratic_program.QuadraticProgram` a UAV. A
:class:`Layout` says where each number of the one stands in the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from napf_mpc.constraints.constraint import SIGNALS, ConstraintError, LinearRows
from napf_mpc.jit import compiled
from napf_mpc.quadratic_program import (
    Array,
    Index,
    QpError,
    QpResult,
    QpStatus,
    QuadraticProgram,
    Residuals,
    Sparsity,
    Values,
)
from napf_mpc.vehicle.plant import plain

__all__ = [
    "INPUTS",
    "STATES",
    "Array",
    "HorizonModel",
    "HorizonQp",
    "Index",
    "Layout",
    "QpError",
    "QpResult",
    "QpStatus",
    "QuadraticProgram",
    "Residuals",
    "Sparsity",
    "Values",
]

STATES, INPUTS = 12, 4


@dataclass(frozen=True, eq=False)
class HorizonModel:
    """Linear model about hover and weights on a stage grid, shared by all runs and UAVs.

    Solvers keep what they compute of a model for as long as they are given this very object: for other
    numbers make another, and do not write into its arrays.
    """

    step_s: Array
    """(N,) length of each stage [s]."""
    a: Array
    """(N, 12, 12) exact zero-order hold of each stage."""
    b: Array
    """(N, 12, 4)."""
    q: Array
    """(N, 12, 12) weight of the state at the end of each stage; the last is the terminal weight."""
    r: Array
    """(N, 4, 4) weight of the input about hover during each stage."""

    @property
    def stages(self) -> int:
        """Number of stages N."""
        return len(self.step_s)

    @cached_property
    def times_s(self) -> Array:
        """(N,) time from now at the end of each stage [s]."""
        return np.cumsum(self.step_s)

    def check(self) -> None:
        """Refuse shapes that do not fit, numbers that are not finite, and weights that are not convex.

        Raises
        ------
        QpError
            Naming everything that is wrong.
        """
        n = self.stages
        want = {"a": (n, STATES, STATES), "b": (n, STATES, INPUTS), "q": (n, STATES, STATES)}
        want["r"] = (n, INPUTS, INPUTS)
        faults = [] if n else ["the horizon has no stages"]
        for name, shape in want.items():
            values = getattr(self, name)
            if values.shape != shape:
                faults.append(f"{name} has shape {values.shape}, must be {shape}")
            elif not np.isfinite(values).all():
                faults.append(f"{name} has an entry that is not finite")
            elif name in "qr" and n:
                size = 1e-9 * max(1.0, float(np.abs(values).max()))
                if np.abs(values - values.swapaxes(1, 2)).max() > size:
                    faults.append(f"{name} is not symmetric")
                elif np.linalg.eigvalsh(values).min() < -size:
                    faults.append(f"{name} has a negative eigenvalue")
        if not (np.isfinite(self.step_s).all() and (self.step_s > 0.0).all()):
            faults.append("a stage's length is not a positive number of seconds")
        if faults:
            raise QpError("; ".join(faults))


@dataclass(frozen=True, eq=False)
class HorizonQp:
    """The programs of all UAVs of all runs over one horizon."""

    model: HorizonModel
    """Dynamics and weights."""
    initial: Array
    """(run, uav, 12) state now."""
    reference: Array
    """(run, uav, N, 12) state to track at the end of each stage."""
    rows: tuple[LinearRows, ...]
    """Rows of all constraints, in a fixed order."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(run, uav, N)."""
        runs, uavs, stages = self.reference.shape[:3]
        return runs, uavs, stages

    def of_one(self, run: int, uav: int) -> HorizonQp:
        """The program of one UAV alone, as a horizon of one run and one UAV with its own arrays."""

        def own(values: Array) -> Array:
            return values[run : run + 1, uav : uav + 1].copy()

        def own_or_none(values: Array | None) -> Array | None:
            return None if values is None else own(values)

        rows = tuple(
            replace(
                block, jac=own(block.jac), lower=own_or_none(block.lower), upper=own_or_none(block.upper),
                w1=own_or_none(block.w1), w2=own_or_none(block.w2),
            )
            for block in self.rows
        )  # fmt: skip
        return HorizonQp(self.model, own(self.initial), own(self.reference), rows)

    def check(self) -> None:
        """Refuse a horizon whose parts do not fit or are not finite.

        Raises
        ------
        QpError
            Naming the part.
        """
        self.model.check()
        self.check_shapes()
        if not (np.isfinite(self.initial).all() and np.isfinite(self.reference).all()):
            raise QpError("initial state or reference is not finite")
        try:
            for rows in self.rows:
                rows.check(self.shape)
        except ConstraintError as error:
            raise QpError(str(error)) from error

    def check_shapes(self) -> None:
        """Refuse parts that do not fit, whatever their numbers.

        Raises
        ------
        QpError
            Naming the part.
        """
        if self.reference.ndim != 4 or self.reference.shape[3] != STATES:
            raise QpError(f"reference has shape {self.reference.shape}, must be (run, uav, N, {STATES})")
        runs, uavs, stages = self.shape
        if self.initial.shape != (runs, uavs, STATES):
            raise QpError(f"initial has shape {self.initial.shape}, must be {(runs, uavs, STATES)}")
        if stages != self.model.stages:
            raise QpError(f"reference has {stages} stages, the model has {self.model.stages}")
        for k, block in enumerate(self.rows):
            if block.signal not in SIGNALS:
                raise QpError(f"rows[{k}]: signal {block.signal!r} is not known")
            m, dim = block.count, len(SIGNALS[block.signal])
            slack = (runs, uavs, stages, block.slack_count)
            want = {"jac": (runs, uavs, stages, m, dim), "w1": slack, "w2": slack}
            want |= {"lower": (runs, uavs, stages, m), "upper": (runs, uavs, stages, m)}
            for name, shape in want.items():
                values = getattr(block, name)
                if values is not None and values.shape != shape:
                    raise QpError(f"rows[{k}].{name} has shape {values.shape}, must be {shape}")

    def assemble(self, run: int, uav: int) -> QuadraticProgram:
        """Matrices of one UAV's program: states, inputs about hover, then slacks (see :class:`Layout`)."""
        layout = Layout.of(self)
        return QuadraticProgram.of_values(layout.sparsity, layout.values(self).of(run, uav))


Kind = tuple[str, int, int, bool, bool]
"""What the layout knows of a block: signal, rows and slacks a stage, whether it has lower, upper bounds."""
Places = tuple[Index, Index, Index]
"""Stage, row and column of the entries of a model's matrices that are not zero."""


class _Entries:
    """Places of a sparse matrix collected block by block, then brought into column-major order."""

    def __init__(self) -> None:
        self._rows: list[Index] = []
        self._columns: list[Index] = []

    def add(self, rows: Index, columns: Index) -> None:
        rows, columns = np.broadcast_arrays(rows, columns)
        self._rows.append(rows.ravel())
        self._columns.append(columns.ravel())

    def ordered(self) -> tuple[Index, Index, Index]:
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        order = np.lexsort((rows, columns))
        return rows[order], columns[order], order


@dataclass(frozen=True, eq=False)
class Layout:
    """Where everything stands in the matrices; fixed for a model and its kinds of rows.

    Variables: states x_1 .. x_N, inputs u_0 .. u_{N-1}, then for each soft block its slacks, stage by stage.
    Rows: dynamics, then for each block its lower side, its upper side (hard blocks: one row for both), and
    ``s >= 0`` of its slacks. Entries of the model that are zero at all stages have no place: the hover model
    falls into four chains, and a solver's factors shrink by half.
    """

    sparsity: Sparsity
    """Places of the entries."""
    slacks: tuple[slice, ...]
    """Columns of each block's slacks; empty for hard rows."""
    kinds: tuple[Kind, ...]
    """Of the blocks of rows."""
    stages: int
    """Number of stages N."""
    places: tuple[Places, Places, Places, Places]
    """Entries of the model's a (of x_1 onwards), b, q and r that are not zero."""
    p_order: Index
    """Column-major order of P's numbers as :meth:`values` collects them."""
    a_order: Index
    """The same for A."""

    @classmethod
    def of(cls, horizon: HorizonQp) -> Layout:
        """Layout of a horizon; depends on shapes, signals, kinds of slack and the model's zeros only."""
        stages, kinds = horizon.model.stages, tuple(_kind(block) for block in horizon.rows)
        places = _places(horizon.model)
        (ak, ai, aj), (bk, bi, bj), (qk, qi, qj), (rk, ri, rj) = places
        p, a = _Entries(), _Entries()
        stage = np.arange(stages)[:, None]
        state, at_input = STATES * stage, STATES * stages + INPUTS * stage
        p.add(STATES * qk + qi, STATES * qk + qj)
        p.add(STATES * stages + INPUTS * rk + ri, STATES * stages + INPUTS * rk + rj)
        # x_{k+1} - A x_k - B u_k = 0; A x_0 is on the right-hand side.
        every = np.arange(STATES * stages)
        a.add(every, every)
        a.add(STATES * (ak + 1) + ai, STATES * ak + aj)
        a.add(STATES * bk + bi, STATES * stages + INPUTS * bk + bj)
        columns, rows_so_far = (STATES + INPUTS) * stages, STATES * stages
        slacks: list[slice] = []
        for signal, count, per_stage, has_lower, has_upper in kinds:
            target = (at_input if signal == "input" else state)[:, :, None] + np.array(SIGNALS[signal])
            slack = columns + per_stage * stage + (np.arange(count) if per_stage == count else 0)
            for _ in range(has_lower + has_upper if per_stage else 1):
                row = rows_so_far + count * stage + np.arange(count)
                a.add(row[:, :, None], target)
                if per_stage:
                    a.add(row, slack)
                rows_so_far += count * stages
            size = per_stage * stages
            slacks.append(slice(columns, columns + size))
            own = np.arange(columns, columns + size)
            p.add(own, own)
            a.add(rows_so_far + np.arange(size), own)
            columns, rows_so_far = columns + size, rows_so_far + size
        p_rows, p_columns, p_order = p.ordered()
        a_rows, a_columns, a_order = a.ordered()
        sparsity = Sparsity(columns, rows_so_far, p_rows, p_columns, a_rows, a_columns)
        return cls(sparsity, tuple(slacks), kinds, stages, places, p_order, a_order)

    def same_rows(self, horizon: HorizonQp) -> bool:
        """Whether a horizon has the stages and kinds of rows of this layout."""
        return self.stages == horizon.model.stages and self.kinds == tuple(_kind(b) for b in horizon.rows)

    def fits(self, horizon: HorizonQp) -> bool:
        """Whether the programs of a horizon have this layout: rows, and zeros of the model."""
        return self.same_rows(horizon) and all(
            np.array_equal(mine, theirs)
            for pair, other in zip(self.places, _places(horizon.model), strict=True)
            for mine, theirs in zip(pair, other, strict=True)
        )

    def values(self, horizon: HorizonQp) -> Values:
        """Numbers of all programs of a horizon that has this layout."""
        runs, uavs, stages = horizon.shape
        model, batch = horizon.model, (runs, uavs)
        at_a, at_b, at_q, at_r = self.places
        n, m = self.sparsity.variables, self.sparsity.constraints
        p, a = _Line(batch, len(self.p_order)), _Line(batch, len(self.a_order))
        q, lower, upper = _Line(batch, n), _Line(batch, m), _Line(batch, m)
        pull, start = np.zeros((*batch, stages, STATES)), np.zeros((*batch, stages, STATES))
        _add_pull_and_start(
            plain(model.q), plain(model.a), plain(horizon.reference), plain(horizon.initial), pull, start
        )
        p.add(model.q[at_q])
        p.add(model.r[at_r])
        q.add(_flat(pull))
        q.repeat(0.0, INPUTS * stages)
        a.repeat(1.0, STATES * stages)
        a.add(-model.a[1:][at_a])
        a.add(-model.b[at_b])
        lower.add(_flat(start))
        upper.add(_flat(start))
        duration = model.step_s[:, None]
        for block in horizon.rows:
            jac, rows = _flat(block.jac), stages * block.count
            for low, high, sign in _sides(block):
                a.add(jac)
                if block.soft:
                    a.repeat(sign, rows)
                for line, values, missing in ((lower, low, -np.inf), (upper, high, np.inf)):
                    if values is None:
                        line.repeat(missing, rows)
                    else:
                        line.add(_flat(values))
            if block.w1 is not None and block.w2 is not None:
                size = block.slack_count * stages
                p.add(_flat(block.w2 * duration))
                q.add(_flat(block.w1 * duration))
                a.repeat(1.0, size)
                lower.repeat(0.0, size)
                upper.repeat(np.inf, size)
        return Values(
            _ordered(p.values, self.p_order), q.values, _ordered(a.values, self.a_order),
            lower.values, upper.values,
        )  # fmt: skip

    def states(self, z: Array) -> Array:
        """States (..., N, 12) of primal points (..., n)."""
        return z[..., : STATES * self.stages].reshape(*z.shape[:-1], self.stages, STATES)

    def inputs(self, z: Array) -> Array:
        """Inputs about hover (..., N, 4) of primal points (..., n)."""
        part = z[..., STATES * self.stages : (STATES + INPUTS) * self.stages]
        return part.reshape(*z.shape[:-1], self.stages, INPUTS)

    def block_slacks(self, z: Array) -> tuple[Array, ...]:
        """Slacks (..., N, slacks a stage) of each block of rows, of primal points (..., n)."""
        lead, slacks = z.shape[:-1], zip(self.slacks, self.kinds, strict=True)
        return tuple([z[..., part].reshape(*lead, self.stages, kind[2]) for part, kind in slacks])


def _kind(block: LinearRows) -> Kind:
    return block.signal, block.count, block.slack_count, block.lower is not None, block.upper is not None


def _places(model: HorizonModel) -> tuple[Places, Places, Places, Places]:
    def some(matrices: Array) -> Places:
        stage, row, column = np.nonzero(matrices)
        return stage, row, column

    return some(model.a[1:]), some(model.b), some(model.q), some(model.r)


def _flat(values: Array) -> Array:
    """All axes after (run, uav) as one."""
    return values.reshape(*values.shape[:2], math.prod(values.shape[2:]))


class _Line:
    """Numbers (run, uav, k) of all programs, filled from left to right."""

    def __init__(self, batch: tuple[int, int], size: int) -> None:
        self.values = np.empty((*batch, size))
        self._end = 0

    def add(self, values: Array) -> None:
        """Go on with numbers (run, uav, k), or (k,) of all programs."""
        begin, self._end = self._end, self._end + values.shape[-1]
        self.values[..., begin : self._end] = values

    def repeat(self, value: float, count: int) -> None:
        """Go on with a number again and again."""
        begin, self._end = self._end, self._end + count
        self.values[..., begin : self._end] = value


@compiled
def _add_pull_and_start(
    q: Array, a: Array, reference: Array, initial: Array, pull: Array, start: Array
) -> None:
    """Subtract Q times the references (run, uav, N, 12) from pull; add A x_0 to the first stage of start.

    One state after the other: a library product may group its terms by the length of the batch.
    """
    for run in range(pull.shape[0]):
        for uav in range(pull.shape[1]):
            for k in range(pull.shape[2]):
                for i in range(STATES):
                    for j in range(STATES):
                        pull[run, uav, k, i] -= q[k, i, j] * reference[run, uav, k, j]
            for i in range(STATES):
                for j in range(STATES):
                    start[run, uav, 0, i] += a[0, i, j] * initial[run, uav, j]


def _ordered(values: Array, order: Index) -> Array:
    """Numbers (run, uav, k) brought into another order, the same for all."""
    out = np.empty(values.shape)
    _take(values, order, out)
    return out


@compiled
def _take(values: Array, order: Index, out: Array) -> None:
    for run in range(out.shape[0]):
        for uav in range(out.shape[1]):
            for k in range(len(order)):
                out[run, uav, k] = values[run, uav, order[k]]


def _sides(block: LinearRows) -> list[tuple[Array | None, Array | None, float]]:
    """Bounds of each copy of a block's rows in A, and the sign of the slack in it."""
    if not block.soft:
        return [(block.lower, block.upper, 0.0)]
    sides: list[tuple[Array | None, Array | None, float]] = []
    if block.lower is not None:
        sides.append((block.lower, None, 1.0))
    if block.upper is not None:
        sides.append((None, block.upper, -1.0))
    return sides
