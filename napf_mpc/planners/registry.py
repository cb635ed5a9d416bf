"""Planners by name: what ``--planner`` and ``planner.kind`` choose from."""

from __future__ import annotations

from collections.abc import Callable

from napf_mpc.errors import ProblemError
from napf_mpc.planners.planner import Planner
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
from napf_mpc.problem import Problem

PLANNERS: dict[str, Callable[[Problem], Planner]] = {"apf": ApfPlanner, "napf": NapfPlanner}
"""Name -> factory."""


def make_planner(name: str, problem: Problem) -> Planner:
    """Planner of a name for a problem.

    Raises
    ------
    ProblemError
        If there is no planner of that name in this version.
    """
    if name not in PLANNERS:
        raise ProblemError("planner", [f'"{name}" is not built in this version; choose from {", ".join(PLANNERS)}'])
    return PLANNERS[name](problem)
