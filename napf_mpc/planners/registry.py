"""Planners by name: what ``--planner`` and ``planner.kind`` choose from."""

from __future__ import annotations

from collections.abc import Callable

from napf_mpc.errors import ProblemError
from napf_mpc.planners.guided_field import GuidedNapfPlanner
from napf_mpc.planners.planner import Planner
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
from napf_mpc.problem import Problem
from napf_mpc.words import did_you_mean, shown_text

PLANNERS: dict[str, Callable[[Problem], Planner]] = {
    "apf": ApfPlanner,
    "napf": NapfPlanner,
    "napf_guided": GuidedNapfPlanner,
}
"""Name -> factory."""
ANNOUNCED = ("qp",)
"""Names that problem files may hold, but that this version cannot fly."""


def make_planner(name: str, problem: Problem) -> Planner:
    """Planner of a name for a problem.

    Raises
    ------
    ProblemError
        If there is no planner of that name in this version.
    """
    if name not in PLANNERS:
        reason = "is not built in this version" if name in ANNOUNCED else "is not a planner"
        choice = f"choose from {', '.join(PLANNERS)}{did_you_mean(name, PLANNERS)}"
        raise ProblemError("planner", [f'"{shown_text(name)}" {reason}; {choice}'])
    return PLANNERS[name](problem)
