"""What a constraint is: one method that returns rows on a named signal, for all UAVs and stages at once."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import NapfError
from napf_mpc.formation import PathFrame
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.problem import Problem
from napf_mpc.vehicle.plant import plain
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

SIGNALS: dict[str, tuple[int, ...]] = {
    "position": (0, 2, 4),
    "velocity": (1, 3, 5),
    "attitude": (6, 8, 10),
    "input": (0, 1, 2, 3),
}
"""Name of a signal -> its places in the state (Eq. 1), or in the input about hover (Eq. 2)."""
_REAL = "biuf"
"""Kinds of entries that are real numbers."""


class ConstraintError(NapfError, ValueError):
    """Rows do not fit the horizon, or hold numbers that are not finite."""


@dataclass(frozen=True, eq=False)
class Horizon:
    """What a constraint may look at: the last plan, the reported covariance along it, the map.

    All numbers are finite: a planner stands in for a UAV whose navigation it does not trust before it asks
    for rows.
    """

    time_s: float
    """Time now [s]."""
    step_s: Array
    """(N,) length of each stage [s]."""
    position: Array
    """(run, uav, N, 3) positions at the end of each stage by the last plans: rows are linear there [m]."""
    velocity: Array
    """(run, uav, N, 3) velocities of the same plans [m/s]."""
    covariance: Array
    """(run, uav, N, 3, 3) reported position covariance, propagated to each stage [m^2]."""
    common_factor: Array
    """(run, uav, 3, rank) factor of the part of the covariance that UAVs share now [m]."""
    obstacles: ObstacleSet
    """One scene for all runs, or one a run."""
    frame: PathFrame
    """Frame of the mission's path."""
    problem: Problem
    """Sizes, speeds and settings."""
    tracks: Tracks | None = None
    """Moving obstacles as tracked now; None in a world without any."""
    memo: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)
    """Answers that several constraints share, such as the nearest obstacles; dies with the horizon."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(run, uav, N)."""
        runs, uavs, stages = self.position.shape[:3]
        return runs, uavs, stages

    @property
    def times_s(self) -> Array:
        """(N,) time from now at the end of each stage [s]."""
        if "times_s" not in self.memo:
            self.memo["times_s"] = np.cumsum(self.step_s)
        times: Array = self.memo["times_s"]
        return times

    def check(self) -> None:
        """Refuse a horizon whose arrays do not fit each other or are not finite.

        Raises
        ------
        ConstraintError
            Naming everything that is wrong.
        """
        faults = []
        shape = self.position.shape[:3]
        rank = self.common_factor.shape[-1] if self.common_factor.ndim else 0
        expected = {
            "step_s": shape[2:],
            "position": (*shape, 3),
            "velocity": (*shape, 3),
            "covariance": (*shape, 3, 3),
            "common_factor": (*shape[:2], 3, rank),
        }
        for name, want in expected.items():
            values = getattr(self, name)
            if values.shape != want:
                faults.append(f"{name} has shape {values.shape}, must be {want}")
            elif not np.isfinite(values).all():
                faults.append(f"{name} has an entry that is not finite")
        if self.tracks is not None:
            faults += self.tracks.faults(shape[0])
        if not faults and not (self.step_s > 0.0).all():
            faults.append("step_s must be > 0")
        if len(shape) == 3 and self.obstacles.n_scenes not in (1, shape[0]):
            faults.append(
                f"{shape[0]} runs do not fit {self.obstacles.n_scenes} scenes: one each, or one for all"
            )
        if faults:
            raise ConstraintError("horizon: " + "; ".join(faults))


def even_prices(shape: tuple[int, ...], w1: float, w2: float) -> tuple[Array, Array]:
    """Prices of slacks (run, uav, N, m), the same for all."""
    return np.full(shape, w1), np.full(shape, w2)


def along_rows(jac: Array, signal: Array) -> Array:
    """Return jac (run, uav, N, m, dim) . signal (run, uav, N or 1, dim), shape (run, uav, N, m)."""
    runs, uavs, stages, _, dim = jac.shape
    if signal.shape != (runs, uavs, 1, dim):
        signal = np.broadcast_to(signal, (runs, uavs, stages, dim))
    out = np.empty(jac.shape[:-1])
    _along_rows(plain(jac), plain(signal), out)
    return out


@compiled
def _along_rows(jac: Array, signal: Array, out: Array) -> None:
    runs, uavs, stages, count, dim = jac.shape
    for run in range(runs):
        for uav in range(uavs):
            for k in range(stages):
                x = signal[run, uav, k if signal.shape[2] > 1 else 0]
                for j in range(count):
                    # One axis after the other: a library's sum may differ in the last bit with the batch.
                    total = 0.0
                    for axis in range(dim):
                        total += jac[run, uav, k, j, axis] * x[axis]
                    out[run, uav, k, j] = total


def _shifted(jac: Array, origin: Array, bound: Array) -> Array:
    """Bounds (run, uav, N, m) of rows for a signal measured from an origin (run, uav, dim)."""
    if bound.shape != jac.shape[:-1]:
        raise ConstraintError(f"a bound has shape {bound.shape}, and the rows {jac.shape}")
    out = np.empty(bound.shape)
    _shift(jac, origin, plain(bound), out)
    return out


@compiled_bare
def _shift(jac: Array, origin: Array, bound: Array, moved: Array) -> None:
    """Write what :func:`_shifted` returns."""
    runs, uavs, stages, count, dim = jac.shape
    for run in range(runs):
        for uav in range(uavs):
            for k in range(stages):
                for j in range(count):
                    offset = 0.0
                    for axis in range(dim):
                        offset += jac[run, uav, k, j, axis] * origin[run, uav, axis]
                    moved[run, uav, k, j] = bound[run, uav, k, j] - offset


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Rows ``lower <= jac . signal <= upper`` of every run, UAV and stage, hard or soft.

    A soft row may be violated by a slack s >= 0 in its own unit at the price of
    ``w1 s + w2 s^2 / 2`` per second. The number of rows is to be the same every step (one that changes costs
    the solver its guess); an inactive row carries infinite bounds.
    """

    signal: str
    """A name of :data:`SIGNALS`: states at the end of a stage, inputs during it."""
    jac: Array
    """(run, uav, N, m, dim) coefficients on the signal."""
    lower: Array | None = None
    """(run, uav, N, m) in the unit of jac . signal; None if no row of this kind has a lower bound."""
    upper: Array | None = None
    """(run, uav, N, m); None if no row of this kind has an upper bound."""
    w1: Array | None = None
    """(run, uav, N, m) linear slack penalty per unit and second; None for hard rows."""
    w2: Array | None = None
    """(run, uav, N, m) quadratic slack penalty per unit squared and second; None for hard rows."""
    shared_slack: bool = False
    """Whether the rows of a stage share one slack; w1 and w2 are then (run, uav, N, 1)."""
    steady: bool = False
    """Promise that these arrays are the same for every run and UAV, and that nobody writes into them again: a
    solver that is given this very object step after step need not read it anew."""

    @property
    def soft(self) -> bool:
        """Whether the rows may be violated at a price."""
        return self.w1 is not None

    @property
    def count(self) -> int:
        """Rows of each stage m."""
        return int(self.jac.shape[3])

    @property
    def slack_count(self) -> int:
        """Slacks of each stage."""
        return 0 if not self.soft else 1 if self.shared_slack else self.count

    def values(self, signal: Array) -> Array:
        """Return jac . signal of a signal (run, uav, N, dim), shape (run, uav, N, m)."""
        return along_rows(self.jac, signal)

    def violation(self, signal: Array) -> Array:
        """Return how far a signal (run, uav, N, dim) is outside each row's bounds, >= 0, (run, uav, N, m)."""
        values = self.values(signal)
        over = np.zeros_like(values)
        if self.lower is not None:
            over = np.maximum(over, self.lower - values)
        if self.upper is not None:
            over = np.maximum(over, values - self.upper)
        return over

    def shifted(self, origin: Array) -> LinearRows:
        """Return the rows for a signal measured from an origin (run, uav, dim).

        Raises
        ------
        ConstraintError
            If the origin does not fit the rows.
        """
        jac, place = plain(self.jac), plain(origin)
        if place.shape != (*jac.shape[:2], jac.shape[-1]):
            raise ConstraintError(f"origin has shape {place.shape}, and the rows {jac.shape}")
        lower = None if self.lower is None else _shifted(jac, place, self.lower)
        upper = None if self.upper is None else _shifted(jac, place, self.upper)
        return LinearRows(self.signal, self.jac, lower, upper, self.w1, self.w2, self.shared_slack)

    def check(self, shape: tuple[int, int, int]) -> None:
        """Refuse rows that do not fit a horizon of shape (run, uav, N).

        Raises
        ------
        ConstraintError
            Naming everything that is wrong.
        """
        self.check_shapes(shape)
        faults = [*self._value_faults()]
        if faults:
            raise ConstraintError("; ".join(faults))

    def check_shapes(self, shape: tuple[int, int, int]) -> None:
        """Refuse rows whose arrays do not fit a horizon of shape (run, uav, N), without a look into them.

        Raises
        ------
        ConstraintError
            Naming everything that does not fit.
        """
        faults = [*self._shape_faults(shape)]
        if faults:
            raise ConstraintError("; ".join(faults))

    def outline(self) -> Hashable:
        """All that shapes and kind of the rows are."""
        return (
            self.signal, self.shared_slack, self.jac.shape,
            None if self.lower is None else self.lower.shape,
            None if self.upper is None else self.upper.shape,
            None if self.w1 is None else self.w1.shape,
            None if self.w2 is None else self.w2.shape,
        )  # fmt: skip

    def _shape_faults(self, shape: tuple[int, int, int]) -> Iterator[str]:
        if not (isinstance(self.signal, str) and self.signal in SIGNALS):
            yield f"signal {self.signal!r} is not known; choose from {', '.join(SIGNALS)}"
            return
        if not isinstance(self.jac, np.ndarray):
            yield f"jac is a {type(self.jac).__name__}, must be an array (run, uav, N, m, dim)"
            return
        if self.jac.dtype.kind not in _REAL:
            yield f"jac holds entries of type {self.jac.dtype}, must hold real numbers"
        want = (*shape, self.jac.shape[3] if self.jac.ndim == 5 else -1)
        if self.jac.shape != (*want, len(SIGNALS[self.signal])):
            dims = (*shape, "m", len(SIGNALS[self.signal]))
            yield f"jac has shape {self.jac.shape}, must be (run, uav, N, m, dim) = {dims}"
        slack = (*shape, 1) if self.shared_slack else want
        arrays = (
            ("lower", self.lower, want),
            ("upper", self.upper, want),
            ("w1", self.w1, slack),
            ("w2", self.w2, slack),
        )
        for name, values, expected in arrays:
            if values is None:
                continue
            if not isinstance(values, np.ndarray):
                yield f"{name} is a {type(values).__name__}, must be an array (run, uav, N, m) = {expected}"
            elif values.shape != expected:
                yield f"{name} has shape {values.shape}, must be {expected}"
            elif values.dtype.kind not in _REAL:
                yield f"{name} holds entries of type {values.dtype}, must hold real numbers"
        if (self.w1 is None) != (self.w2 is None):
            yield "give both of w1 and w2 (soft rows) or neither (hard rows)"
        if self.shared_slack and not self.soft:
            yield "hard rows share no slack: give w1 and w2, or drop shared_slack"
        if self.lower is None and self.upper is None:
            yield "give lower, upper or both"

    def _value_faults(self) -> Iterator[str]:
        if not np.isfinite(self.jac).all():
            yield "jac has an entry that is not finite"
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            if bound is not None and np.isnan(bound).any():
                yield f"{name} has a NaN"
        if self.lower is not None and (self.lower == np.inf).any():
            yield "lower has +inf"
        if self.upper is not None and (self.upper == -np.inf).any():
            yield "upper has -inf"
        if self.lower is not None and self.upper is not None and (self.lower > self.upper).any():
            yield "lower > upper somewhere"
        for name, weights in (("w1", self.w1), ("w2", self.w2)):
            if weights is not None and not ((weights >= 0.0) & np.isfinite(weights)).all():
                yield f"{name} has an entry that is negative or not finite"
        if self.w1 is not None and self.w2 is not None and not (self.w1 + self.w2 > 0.0).all():
            yield "a slack is free of charge: w1 + w2 must be > 0, of inactive rows too"


class Constraint(Protocol):
    """A block of rows. Its author never sees a column index.

    Hold a new one against :func:`napf_mpc.constraints.contract.check_constraint`.
    """

    @property
    def name(self) -> str:
        """Name in results and errors."""
        ...

    def rows(self, horizon: Horizon) -> LinearRows:
        """Rows of all runs, UAVs and stages; called once a step. Signal, shapes and kind never change."""
        ...


def checked_constraints(constraints: object) -> list[Constraint]:
    """List of constraints.

    Raises
    ------
    ConstraintError
        Naming what is none.
    """
    if not isinstance(constraints, Iterable):
        raise ConstraintError(f"constraints is a {type(constraints).__name__}, must be a list of constraints")
    held = list(constraints)
    faults = [fault for constraint in held for fault in _constraint_faults(constraint)]
    if faults:
        raise ConstraintError("\n".join(faults))
    return held


def _constraint_faults(constraint: object) -> Iterator[str]:
    if isinstance(constraint, type):
        yield f"{constraint.__name__}: is a class, give an instance of it: {constraint.__name__}(...)"
        return
    kind, name = type(constraint).__name__, getattr(constraint, "name", None)
    if not (isinstance(name, str) and name):
        yield f"{kind}: name must be a text that is not empty"
    if not callable(getattr(constraint, "rows", None)):
        yield f"{kind}: rows must be a method that takes a horizon"


def checked_rows(rows: object) -> LinearRows:
    """What rows() of a constraint has returned.

    Raises
    ------
    ConstraintError
        If it is something else.
    """
    if not isinstance(rows, LinearRows):
        raise ConstraintError(f"rows() returned a {type(rows).__name__}, must return LinearRows")
    return rows


def check_outlines(
    constraints: Iterable[Constraint], blocks: Iterable[object], shape: tuple[int, int, int]
) -> None:
    """Refuse rows of constraints whose arrays do not fit a horizon of shape (run, uav, N).

    Raises
    ------
    ConstraintError
        Naming the constraint and everything that does not fit.
    """
    for constraint, block in zip(constraints, blocks, strict=True):
        try:
            checked_rows(block).check_shapes(shape)
        except ConstraintError as error:
            raise ConstraintError(f"constraint {constraint.name!r}: {error}") from error
