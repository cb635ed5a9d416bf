"""Planners and a solver of the user's own in a campaign: digests of their sources, and how they travel."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from napf_mpc.planners.registry import Factory, own_planners
from napf_mpc.problem import Problem
from napf_mpc.solvers.batch import OwnSolver, own_solver


@dataclass(frozen=True)
class OwnParts:
    """What was registered in this process and flies in a campaign; it can be sent to another process."""

    planners: Mapping[str, Factory]
    """Name -> factory, of :func:`napf_mpc.planners.registry.register_planner`."""
    solver: OwnSolver | None
    """The problem's ``planner.solver``, if it was registered."""

    @classmethod
    def of(cls, problem: Problem, planners: Sequence[str]) -> OwnParts:
        """Those of a problem and of the planners that fly it."""
        return cls(own_planners(planners), own_solver(problem.planner.solver))

    def __bool__(self) -> bool:
        return bool(self.planners) or self.solver is not None

    def digests(self) -> dict[str, dict[str, str]]:
        """Digests of their sources, as entries of a campaign's origin; none for what there is none of."""
        planners = {name: source_digest(factory) for name, factory in self.planners.items()}
        solver = {} if self.solver is None else {self.solver.name: source_digest(self.solver.factory)}
        return {key: of for key, of in (("own_planners", planners), ("own_solver", solver)) if of}

    def lend(self) -> None:
        """Let this process know the solver, whatever it knew by that name; planners are handed over."""
        if self.solver is not None:
            self.solver.lend()


def source_digest(factory: object) -> str:
    """Digest of the source of a registered planner or solver, ``unknown`` if there is none to read.

    Of the whole module that defines it; of a script or a notebook only its own lines, since the rest of those
    says what to fly. What the module imports does not count.
    """
    whole = getattr(factory, "__module__", None) != "__main__"
    try:
        source = inspect.getsource(sys.modules[factory.__module__] if whole else factory)  # type: ignore[arg-type]
    except (AttributeError, KeyError, TypeError, OSError):
        return "unknown"
    return hashlib.sha256(source.encode()).hexdigest()[:16]
