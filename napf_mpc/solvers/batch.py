"""Solving the programs of all UAVs of all runs: what goes in, what comes out, and the way over a back-end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare
from napf_mpc.qp import (
    INPUTS,
    STATES,
    Array,
    HorizonModel,
    HorizonQp,
    Layout,
    QpError,
    QpStatus,
    QuadraticProgram,
    Values,
)
from napf_mpc.solvers.residuals import kkt_residuals
from napf_mpc.solvers.solver import (
    Backend,
    MakeBackend,
    SolverError,
    Warm,
    backend_maker,
    lend_solver,
    registered_solver,
    solve_safely,
    solver_names,
    take_name,
)
from napf_mpc.vehicle.plant import plain

Mask = NDArray[np.bool_]
STATUSES = tuple(QpStatus)
"""Statuses in the order of their codes."""


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Guesses of all programs; a program whose guess is not finite starts cold."""

    z: Array
    """(run, uav, n) states, inputs and slacks as a :class:`~napf_mpc.qp.Layout` orders them."""
    y: Array
    """(run, uav, m) multipliers."""


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Answers for all programs of a horizon; judge them by :func:`~napf_mpc.solvers.acceptance.accepted`."""

    status: NDArray[np.int8]
    """(run, uav) codes: places in :data:`STATUSES`."""
    states: Array
    """(run, uav, N, 12) at the end of each stage; NaN where there is no answer."""
    inputs: Array
    """(run, uav, N, 4) about hover during each stage."""
    slacks: tuple[Array, ...]
    """Of each block of rows (run, uav, N, slacks a stage) in its unit; none for hard rows."""
    z: Array
    """(run, uav, n) all variables."""
    y: Array
    """(run, uav, m) multipliers."""
    primal: Array
    """(run, uav) largest row violation, computed here on unscaled data [m, m/s, rad or N, as the row]."""
    dual: Array
    """(run, uav) largest entry of the Lagrangian's gradient [cost per unit of the variable]."""
    complementarity: Array
    """(run, uav) largest multiplier times gap [cost]."""
    iterations: NDArray[np.int64]
    """(run, uav), -1 where the solver does not say."""
    messages: dict[tuple[int, int], str] = field(default_factory=dict)
    """(run, uav) -> why it failed, in the solver's words."""

    @classmethod
    def failed(cls, horizon: HorizonQp, message: str) -> BatchResult:
        """Result of a solver that answered nothing at all."""
        runs, uavs, _ = horizon.shape
        layout = Layout.of(horizon)
        n, m = layout.sparsity.variables, layout.sparsity.constraints
        z, infinite = np.full((runs, uavs, n), np.nan), np.full((runs, uavs), np.inf)
        return cls(
            np.full((runs, uavs), STATUSES.index(QpStatus.FAILED), dtype=np.int8),
            layout.states(z), layout.inputs(z), layout.block_slacks(z), z, np.full((runs, uavs, m), np.nan),
            infinite, infinite.copy(), infinite.copy(), np.full((runs, uavs), -1, dtype=np.int64),
            {(run, uav): message for run in range(runs) for uav in range(uavs)},
        )  # fmt: skip

    def counts(self) -> dict[str, int]:
        """How many programs had each status; skipped ones left out."""
        return {
            status.value: int((self.status == code).sum())
            for code, status in enumerate(STATUSES)
            if status is not QpStatus.SKIPPED
        }

    def warm_start(self, states: Array, inputs: Array) -> WarmStart:
        """Guess for the next step: this plan re-sampled, with this answer's slacks and multipliers.

        Parameters
        ----------
        states : array, shape (run, uav, N, 12)
            At the new stage times.
        inputs : array, shape (run, uav, N, 4)
            The same.

        Returns
        -------
        WarmStart
            Cold for programs that were not solved.
        """
        z = np.empty(self.z.shape)
        _guess(plain(states), plain(inputs), plain(self.z), self.status, z)
        return WarmStart(z, self.y)


_SOLVED = STATUSES.index(QpStatus.SOLVED)


@compiled_bare
def _guess(states: Array, inputs: Array, last: Array, status: NDArray[np.int8], z: Array) -> None:
    """Write guesses (run, uav, n) of a plan with the slacks of the last answers; NaN for those not solved."""
    stages = states.shape[2]
    first, n = stages * (STATES + INPUTS), z.shape[2]
    for run in range(z.shape[0]):
        for uav in range(z.shape[1]):
            if status[run, uav] != _SOLVED or not np.isfinite(last[run, uav, 0]):
                for i in range(n):
                    z[run, uav, i] = np.nan
                continue
            for k in range(stages):
                for i in range(STATES):
                    z[run, uav, k * STATES + i] = states[run, uav, k, i]
                for i in range(INPUTS):
                    z[run, uav, stages * STATES + k * INPUTS + i] = inputs[run, uav, k, i]
            for i in range(first, n):
                z[run, uav, i] = last[run, uav, i]


class BatchSolver(Protocol):
    """Solves horizons. It keeps a workspace for each (run, uav): call :meth:`reset` before other missions."""

    def reset(self) -> None:
        """Forget all workspaces, so that results do not depend on what was solved before."""
        ...

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        """Solve the programs of all active (run,) runs; one bad program never harms another."""
        ...


class PerUavSolver:
    """Batch solver over any back-end: numbers of all programs at once, then one solve a UAV.

    One object belongs to one thread: libraries answer wrongly when two share a workspace.

    Parameters
    ----------
    make : callable
        Maker of back-ends.
    """

    def __init__(self, make: MakeBackend) -> None:
        self._make = make
        self._layout: Layout | None = None
        self._model: HorizonModel | None = None
        self._backends: dict[tuple[int, int], Backend | None] = {}

    def __getstate__(self) -> dict[str, Any]:
        """What a copy takes along: no workspaces, which are the libraries' own."""
        return vars(self) | {"_backends": {}}

    def reset(self) -> None:
        """Forget all workspaces."""
        self._backends.clear()

    def solve_batch(
        self, horizon: HorizonQp, warm: WarmStart | None = None, active: Mask | None = None
    ) -> BatchResult:
        """Solve the programs of a horizon.

        Parameters
        ----------
        horizon : HorizonQp
            Programs of all (run, uav). Numbers that are not finite, crossed bounds and negative penalties
            make their own program fail, with a message, and no other.
        warm : WarmStart, optional
            Guesses; cold without.
        active : array of bool, shape (run,), optional
            Runs to solve; the others are skipped, whatever they hold.

        Returns
        -------
        BatchResult
            Answers.

        Raises
        ------
        QpError
            If shapes do not fit or the model is not sound: that is wrong for all programs.
        KeyboardInterrupt
            Also when the library took the interrupt for itself.
        """
        horizon.check_shapes()
        layout = self._fitting_layout(horizon)
        with np.errstate(invalid="ignore", over="ignore"):
            values = layout.values(horizon)
        runs, uavs, _ = horizon.shape
        n, m = layout.sparsity.variables, layout.sparsity.constraints
        asked = np.ones(runs, dtype=bool) if active is None else np.asarray(active, dtype=bool)
        if asked.shape != (runs,):
            raise QpError(f"active has shape {asked.shape}, must be ({runs},)")
        guesses = checked_guess(warm, (runs, uavs, n), (runs, uavs, m))
        usable = values.usable() & _penalties_convex(horizon)
        status = np.full((runs, uavs), STATUSES.index(QpStatus.SKIPPED), dtype=np.int8)
        z, y = np.full((runs, uavs, n), np.nan), np.full((runs, uavs, m), np.nan)
        iterations, messages = np.full((runs, uavs), -1, dtype=np.int64), {}
        for run in np.flatnonzero(asked).tolist():
            for uav in range(uavs):
                at = (run, uav)
                if not usable[at]:
                    status[at] = STATUSES.index(QpStatus.FAILED)
                    messages[at] = _why(layout, values.of(*at))
                    continue
                guess: Warm | None = None if guesses is None else (guesses.z[at], guesses.y[at])
                self._backends[at], answer = solve_safely(
                    self._make, self._backends.get(at), layout.sparsity, values.of(*at), guess
                )
                status[at], iterations[at] = STATUSES.index(answer.status), answer.iterations
                z[at], y[at] = answer.z, answer.y
                if answer.message:
                    messages[at] = answer.message
        primal, dual, complementarity = kkt_residuals(layout.sparsity, values, z, y)
        return BatchResult(
            status, layout.states(z), layout.inputs(z), layout.block_slacks(z), z, y,
            primal, dual, complementarity, iterations, messages,
        )  # fmt: skip

    def _fitting_layout(self, horizon: HorizonQp) -> Layout:
        if self._layout is not None and self._model is horizon.model and self._layout.same_rows(horizon):
            return self._layout
        horizon.model.check()
        if self._layout is None or not self._layout.fits(horizon):
            self._layout = Layout.of(horizon)
            self._backends.clear()
        self._model = horizon.model
        return self._layout


def judges_itself(solver: BatchSolver) -> bool:
    """Whether the residuals of a solver's answers are this library's: it is a solver of ours."""
    return type(solver).__module__.startswith("napf_mpc.")


def judged(layout: Layout, horizon: HorizonQp, answer: object) -> BatchResult:
    """An answer of any solver, with plans and residuals computed here from its points and multipliers.

    Parameters
    ----------
    layout : Layout
        Of the horizon.
    horizon : HorizonQp
        What was to be solved.
    answer : BatchResult
        What the solver made of it.

    Raises
    ------
    SolverError
        If it is none, or does not fit the horizon.
    """
    if not isinstance(answer, BatchResult):
        raise SolverError(f"solve_batch returned a {type(answer).__name__}, must return a BatchResult")
    (runs, uavs, _), sizes = horizon.shape, layout.sparsity
    want: dict[str, tuple[int, ...]] = {"status": (runs, uavs), "iterations": (runs, uavs)}
    want |= {"z": (runs, uavs, sizes.variables), "y": (runs, uavs, sizes.constraints)}
    for name, shape in want.items():
        if getattr(answer, name).shape != shape:
            raise SolverError(f"solve_batch: {name} has shape {getattr(answer, name).shape}, must be {shape}")
    z, y = plain(answer.z), plain(answer.y)
    with np.errstate(invalid="ignore", over="ignore"):
        values = layout.values(horizon)
    primal, dual, complementarity = kkt_residuals(layout.sparsity, values, z, y)
    return replace(
        answer, states=layout.states(z), inputs=layout.inputs(z), slacks=layout.block_slacks(z), z=z, y=y,
        primal=primal, dual=dual, complementarity=complementarity,
    )  # fmt: skip


def checked_guess(warm: WarmStart | None, z: tuple[int, ...], y: tuple[int, ...]) -> WarmStart | None:
    """Guesses as they are.

    Raises
    ------
    QpError
        If they do not have the shapes that z and y must have.
    """
    if warm is not None and (warm.z.shape != z or warm.y.shape != y):
        raise QpError(f"warm start has shapes {warm.z.shape} and {warm.y.shape}, must be {z} and {y}")
    return warm


def _penalties_convex(horizon: HorizonQp) -> Mask:
    """Whether no slack of each program (run, uav) has a negative penalty."""
    runs, uavs, _ = horizon.shape
    convex = np.ones((runs, uavs), dtype=bool)
    for block in horizon.rows:
        for weights in (block.w1, block.w2):
            if weights is not None:
                convex &= (weights >= 0.0).all(axis=(2, 3))
    return convex


def why_unusable(layout: Layout, horizon: HorizonQp, run: int, uav: int) -> str:
    """Why a program is not shown to a solver, in words."""
    with np.errstate(invalid="ignore", over="ignore"):
        return _why(layout, layout.values(horizon.of_one(run, uav)).of(0, 0))


def _why(layout: Layout, values: Values) -> str:
    try:
        QuadraticProgram.of_values(layout.sparsity, values)
    except QpError as error:
        return f"not shown to the solver: {error}"
    return "not shown to the solver: a slack has a negative penalty"


_BATCH_SHIPPED = {
    "kernel": ("napf_mpc.solvers.kernel", "KernelSolver"),
    "casadi-hpipm": ("napf_mpc.solvers.casadi_", "HpipmSolver"),
}
"""Name -> module, imported on use, and class."""
_BATCH_FACTORIES: dict[str, Callable[..., BatchSolver]] = {}


def register_batch_solver(name: str, factory: Callable[..., BatchSolver]) -> None:
    """Add a solver that takes horizons as they are; ``factory(**settings)`` makes one.

    It holds for this process, and travels to workers of a campaign as plain solvers do.

    Raises
    ------
    SolverError
        If the name is taken or none.
    """
    take_name(name)
    _BATCH_FACTORIES[name] = factory


@dataclass(frozen=True)
class OwnSolver:
    """A solver that was registered, as another process can be sent it."""

    name: str
    factory: Callable[..., Any]
    of_horizons: bool
    """Whether it takes horizons, or plain programs."""

    def lend(self) -> None:
        """Make it known to this process, in place of another that was registered by its name."""
        _BATCH_FACTORIES.pop(self.name, None)
        lend_solver(self.name, None if self.of_horizons else self.factory)
        if self.of_horizons:
            _BATCH_FACTORIES[self.name] = self.factory


def own_solver(name: str) -> OwnSolver | None:
    """Return the registered solver of a name; None if it is a shipped one, or not known."""
    if name in _BATCH_FACTORIES:
        return OwnSolver(name, _BATCH_FACTORIES[name], True)
    factory = registered_solver(name)
    return None if factory is None else OwnSolver(name, factory, False)


def own_solver_names() -> tuple[str, ...]:
    """Names of the solvers that were registered."""
    return tuple(name for name in batch_solver_names() if own_solver(name) is not None)


def batch_solver_names() -> tuple[str, ...]:
    """Names that :func:`make_batch_solver` takes, installed or not."""
    return tuple(dict.fromkeys((*solver_names(), *_BATCH_SHIPPED, *_BATCH_FACTORIES)))


def check_solver_name(name: str) -> None:
    """Raise SolverError unless :func:`make_batch_solver` knows a name, its package installed or not."""
    if name not in batch_solver_names():
        raise SolverError(f"solver {name!r} is not known; choose from {', '.join(batch_solver_names())}")


def _shipped(name: str) -> Callable[..., BatchSolver]:
    module, maker = _BATCH_SHIPPED[name]
    factory: Callable[..., BatchSolver] = getattr(import_module(module), maker)
    return factory


def make_batch_solver(name: str, **settings: object) -> BatchSolver:
    """Solver of horizons: a structured one, or any solver of plain programs, one program a UAV.

    Raises
    ------
    SolverError
        If the name is not known, its package is not installed, or a setting is not known.
    """
    check_solver_name(name)
    if name in _BATCH_SHIPPED or name in _BATCH_FACTORIES:
        factory = _BATCH_FACTORIES[name] if name in _BATCH_FACTORIES else _shipped(name)
        try:
            return factory(**settings)
        except TypeError as error:
            raise SolverError(f"solver {name!r}: {error}") from error
    return PerUavSolver(backend_maker(name, **settings))
