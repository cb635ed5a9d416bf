"""Who takes part in the solver benchmark, and on which programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from napf_mpc.solvers.batch import BatchSolver, make_batch_solver, own_solver_names
from napf_mpc.solvers.solver import SolverError

T = TypeVar("T")

REFERENCE, REFERENCE_SETTINGS = "piqp", {"eps_abs": 1e-10, "eps_rel": 1e-10, "check_duality_gap": True}
"""The solver whose first inputs count as true."""
OSQP = "osqp, warm"
"""Label of the contender that all times are set in relation to."""


@dataclass(frozen=True)
class Contender:
    """A solver and how it is used."""

    solver: str
    """Name of a solver, see :func:`napf_mpc.solvers.batch.make_batch_solver`."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """The solver's own."""
    keep: bool = True
    """Keep the workspace from program to program; otherwise each is set up anew."""
    warm: bool = True
    """Start from the flight's own last answer."""

    def make(self) -> BatchSolver:
        """Solver with fresh workspaces.

        Raises
        ------
        SolverError
            If its package is not installed.
        """
        return make_batch_solver(self.solver, **self.settings)


def present(known: Mapping[str, T], make: Callable[[T], object], tell: Callable[[str], None]) -> dict[str, T]:
    """Those that can be made; ``tell`` is told of the others.

    Raises
    ------
    SolverError
        If none can.
    """
    found = {}
    for label, one in known.items():
        try:
            make(one)
            found[label] = one
        except SolverError as error:
            tell(f"{label} is left out: {error}")
    if not found:
        raise SolverError(f"none of these is installed: {'; '.join(known)}")
    return found


CONTENDERS: dict[str, Contender] = {
    "kernel": Contender("kernel"),
    "kernel, cold": Contender("kernel", warm=False),
    OSQP: Contender("osqp", {"eps_abs": 1e-4}),
    "osqp, warm, 1e-6": Contender("osqp", {"eps_abs": 1e-6}),
    "osqp, cold": Contender("osqp", {"eps_abs": 1e-4}, warm=False),
    "osqp, setup": Contender("osqp", {"eps_abs": 1e-4}, keep=False, warm=False),
    "piqp": Contender("piqp", warm=False),
    "proxqp": Contender("proxqp", warm=False),
    "proxqp (CasADi)": Contender("casadi-proxqp", warm=False),
    "qpoases (CasADi)": Contender("casadi-qpoases", warm=False),
    "hpipm (CasADi)": Contender("casadi-hpipm", warm=False),
    "daqp": Contender("daqp", warm=False),
    "clarabel": Contender("clarabel", warm=False),
    "highs": Contender("highs", warm=False),
    "cvxpy": Contender("cvxpy", warm=False),
}
"""Label -> contender. Only OSQP and the kernel make use of a guess."""


def contenders() -> dict[str, Contender]:
    """Label -> contender: solvers that were registered, by their names, behind the shipped ones."""
    own = {name: Contender(name) for name in own_solver_names()}
    return CONTENDERS | {name: one for name, one in own.items() if name not in CONTENDERS}


@dataclass(frozen=True)
class Scene:
    """Programs of one kind."""

    problem: str
    """Shipped problem, flown behind the navigation filter."""
    overrides: Mapping[str, object] = field(default_factory=dict)
    """Of the problem."""


SCENES: dict[str, Scene] = {
    "no obstacles": Scene("study_8s", {"world.count": 0}),
    "8 spheres": Scene("study_8s"),
    "40 spheres": Scene("study_40s"),
    "40 cylinders": Scene("study_40c"),
    "40 spheres, N = 30": Scene("study_40s", {"planner.horizon": 30}),
    "40 spheres, N = 50": Scene("study_40s", {"planner.horizon": 50}),
    "40 spheres, 4 rows": Scene("study_40s", {"planner.obstacle_rows": 2}),
    "40 spheres, 16 rows": Scene("study_40s", {"planner.obstacle_rows": 8}),
}
"""Label -> scene. Without more words N = 20 stages and 8 obstacle rows a stage (4 obstacles, 2 shells)."""
