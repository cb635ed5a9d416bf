"""What a back-end is, solvers by name, and a solver of plain programs on top of any back-end.

A back-end is one small class in one file: made for a sparsity, it solves whatever numbers stand in it. All
checks live here, so that a library never sees what it would crash on or answer wrongly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol

import numpy as np

from napf_mpc.errors import NapfError
from napf_mpc.quadratic_program import (
    Array,
    QpError,
    QpResult,
    QpStatus,
    QuadraticProgram,
    Sparsity,
    Values,
    held,
)
from napf_mpc.words import shown_value

Warm = tuple[Array, Array]
"""Guess of z (n,) and y (m,)."""


class SolverError(NapfError, ValueError):
    """A solver cannot be made: its name is not known, its package is missing, a setting is wrong."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What a library said, in our vocabulary and signs but not yet checked."""

    status: QpStatus
    """Its status, translated."""
    z: Array
    """(n,) primal point."""
    y: Array
    """(m,) multipliers: positive at an upper, negative at a lower bound."""
    iterations: int = -1
    """Iterations, -1 if it does not say."""
    message: str = ""
    """Its own words when it did not solve."""

    @classmethod
    def none(cls, sparsity: Sparsity, status: QpStatus, message: str) -> Answer:
        """Answer without a point."""
        z, y = np.full(sparsity.variables, np.nan), np.full(sparsity.constraints, np.nan)
        return cls(status, z, y, -1, message)


class Backend(Protocol):
    """One program's home in a library; keeps its workspace between solves.

    It is given usable numbers only (:meth:`~napf_mpc.quadratic_program.Values.usable`, a convex P) and a
    finite guess or none. What it raises becomes :attr:`QpStatus.FAILED`, and it is then made anew, as it is
    after a point that is not finite.
    """

    def solve(self, values: Values, warm: Warm | None) -> Answer:
        """Solve the numbers (no leading axes) from a guess, or cold whatever was solved before."""
        ...


MakeBackend = Callable[[Sparsity], Backend]
"""Makes a back-end for programs of a sparsity."""

_FACTORIES: dict[str, Callable[..., MakeBackend]] = {}
_SHIPPED = {
    "osqp": ("napf_mpc.solvers.osqp_", "osqp"),
    "cvxpy": ("napf_mpc.solvers.cvxpy_", "napf-mpc[cvxpy]"),
    "piqp": ("napf_mpc.solvers.piqp_", "napf-mpc[solvers]"),
    **dict.fromkeys(("daqp", "clarabel", "highs"), ("napf_mpc.solvers.qpsolvers_", "napf-mpc[solvers]")),
    "proxqp": ("napf_mpc.solvers.qpsolvers_", "qpsolvers[proxqp]"),
    "quadprog": ("napf_mpc.solvers.qpsolvers_", "qpsolvers[quadprog]"),
    **dict.fromkeys(
        ("casadi-proxqp", "casadi-qpoases", "casadi-hpipm"), ("napf_mpc.solvers.casadi_", "casadi")
    ),
}
"""Name -> module, imported on use, and what to install for it."""
_NAMES = {*_SHIPPED, "kernel"}
"""Names that are taken, those of the shipped solvers of horizons among them."""


def register_solver(name: str, factory: Callable[..., MakeBackend]) -> None:
    """Add a solver of plain programs, for ``planner.solver`` and :func:`make_solver` alike.

    It holds for this process; workers of a campaign are sent the factory, as of a planner, see
    :func:`napf_mpc.planners.registry.register_planner`.

    Parameters
    ----------
    name : str
        Its name; a name that is taken is refused.
    factory : callable
        ``factory(**settings)`` returns a maker of back-ends; it raises ImportError if a package is missing
        and TypeError for a setting that it does not know.

    Raises
    ------
    SolverError
        If the name is taken or none.
    """
    take_name(name)
    _FACTORIES[name] = factory


def take_name(name: str) -> None:
    """Take a name for a solver, of plain programs or of horizons.

    Raises
    ------
    SolverError
        If it is taken, or none.
    """
    if not isinstance(name, str) or not name or name != name.strip() or not name.isprintable():
        raise SolverError(f"name = {shown_value(name)}: must be a text without blanks around it")
    if name in _NAMES:
        raise SolverError(f"a solver named {name!r} exists already")
    _NAMES.add(name)


def registered_solver(name: str) -> Callable[..., MakeBackend] | None:
    """Return the factory that was registered by a name, if any."""
    return _FACTORIES.get(name)


def lend_solver(name: str, factory: Callable[..., MakeBackend] | None) -> None:
    """Know a solver that another process registered, whatever had its name; None only takes the name."""
    _NAMES.add(name)
    _FACTORIES.pop(name, None)
    if factory is not None:
        _FACTORIES[name] = factory


def solver_names() -> tuple[str, ...]:
    """Names of all solvers, installed or not."""
    return (*_SHIPPED, *_FACTORIES)


def tried(make: MakeBackend, settings: Mapping[str, object]) -> MakeBackend:
    """Maker whose settings, if there are any, the library has taken for a program of one variable.

    For libraries that look at settings only when they solve.

    Raises
    ------
    TypeError
        Naming the settings, and what the library raised.
    """
    if settings:
        place, one = np.zeros(1, dtype=np.int64), np.ones(1)
        try:
            make(Sparsity(1, 1, place, place, place, place)).solve(Values(one, one, one, -one, one), None)
        except Exception as error:
            named = ", ".join(f"{name} = {value!r}" for name, value in settings.items())
            raise TypeError(f"{named}: {type(error).__name__}: {error}") from error
    return make


def backend_maker(name: str, **settings: object) -> MakeBackend:
    """Maker of back-ends of a named solver.

    Raises
    ------
    SolverError
        If the name is not known, its package is not installed, or a setting is not known.
    """
    if name not in solver_names():
        raise SolverError(f"solver {name!r} is not known; choose from {', '.join(solver_names())}")
    module, package = _SHIPPED.get(name, ("", ""))
    try:
        maker = _FACTORIES[name](**settings) if not module else import_module(module).maker(name, **settings)
    except ImportError as error:
        hint = f"; install it with: pip install '{package}'" if package else ""
        raise SolverError(f"solver {name!r} needs a package that is not installed ({error}){hint}") from error
    except TypeError as error:
        raise SolverError(f"solver {name!r}: {error}") from error
    checked: MakeBackend = maker
    return checked


def make_solver(name: str, **settings: object) -> Solver:
    """Solver of plain programs.

    Parameters
    ----------
    name : str
        One of :func:`solver_names`.
    settings
        Settings of the library, under its own names.

    Raises
    ------
    SolverError
        As :func:`backend_maker`.
    """
    return Solver(backend_maker(name, **settings))


class Solver:
    """Solves plain programs of one sparsity again and again.

    Parameters
    ----------
    make : callable
        Maker of back-ends.
    """

    def __init__(self, make: MakeBackend) -> None:
        self._make = make
        self._program: QuadraticProgram | None = None
        self._sparsity: Sparsity | None = None
        self._values: Values | None = None
        self._backend: Backend | None = None

    def setup(self, program: QuadraticProgram) -> None:
        """Take a program of any sparsity and forget what was before.

        Raises
        ------
        QpError
            If P is not convex.
        """
        program.check_convex()
        self._program = program
        self._sparsity, self._values = program.split()
        self._backend = None

    def update(self, program: QuadraticProgram) -> None:
        """Take new numbers in the sparsity of :meth:`setup`; if refused, the old program stays.

        Raises
        ------
        QpError
            If nothing was set up, entries stand elsewhere, or P is not convex.
        """
        if self._sparsity is None or self._values is None:
            raise QpError("call setup before update")
        sparsity, values = program.split()
        if not sparsity.same_as(self._sparsity):
            raise QpError("the program has another size or entries elsewhere; call setup")
        if not np.array_equal(values.p, self._values.p):
            program.check_convex()
        self._program, self._values = program, values

    def solve(self, warm: Warm | None = None) -> QpResult:
        """Solve the program from a guess, or cold. A failed solve is a status, not an exception.

        Raises
        ------
        QpError
            If nothing was set up.
        KeyboardInterrupt
            Also when the library took the interrupt for itself.
        """
        if self._program is None or self._sparsity is None or self._values is None:
            raise QpError("call setup before solve")
        self._backend, answer = solve_safely(self._make, self._backend, self._sparsity, self._values, warm)
        return QpResult.of(
            self._program, answer.status, answer.z, answer.y, answer.iterations, answer.message
        )


def solve_safely(
    make: MakeBackend, backend: Backend | None, sparsity: Sparsity, values: Values, warm: Warm | None
) -> tuple[Backend | None, Answer]:
    """Solve usable numbers whatever the library does; return the back-end to keep, None if it is spoilt.

    Raises
    ------
    KeyboardInterrupt
        Also when the library took the interrupt for itself.
    """
    n, m = sparsity.variables, sparsity.constraints
    if warm is not None:
        z, y = held(warm[0], n), held(warm[1], m)
        # A guess that is not finite poisons OSQP for ever; no guess is the safe one.
        warm = (z, y) if np.isfinite(z).all() and np.isfinite(y).all() else None
    try:
        backend = make(sparsity) if backend is None else backend
        # Numbers of its own: what a back-end writes into them must not be what its answer is judged by.
        answer = _fitting(backend.solve(values.copy(), warm), n, m)
    except Exception as error:
        return None, Answer.none(sparsity, QpStatus.FAILED, f"{type(error).__name__}: {error}")
    healthy = bool(np.isfinite(answer.z).all() and np.isfinite(answer.y).all())
    if answer.status is QpStatus.SOLVED and not healthy:
        answer = Answer.none(sparsity, QpStatus.FAILED, "the solver claims success without a finite point")
    # After a failure a workspace holds iterates that say nothing of the next program.
    keep = healthy and answer.status in (QpStatus.SOLVED, QpStatus.INACCURATE, QpStatus.MAX_ITERATIONS)
    return (backend if keep else None), answer


def _fitting(answer: object, n: int, m: int) -> Answer:
    """The answer in our types.

    Raises
    ------
    TypeError, ValueError
        If it is none, or does not fit a program of n variables and m constraints.
    """
    if not isinstance(answer, Answer):
        raise TypeError(f"solve returned a {type(answer).__name__}, must return an Answer")
    z, y = np.asarray(answer.z, dtype=float), np.asarray(answer.y, dtype=float)
    for name, values, shape in (("z", z, (n,)), ("y", y, (m,))):
        if values.shape != shape:
            raise ValueError(f"{name} has shape {values.shape}, must be {shape}")
    return Answer(QpStatus(answer.status), z, y, int(answer.iterations), answer.message)
