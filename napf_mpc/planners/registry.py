"""Planners by name: what ``--planner`` and ``planner.kind`` choose from."""

from __future__ import annotations

from collections.abc import Callable

from napf_mpc.errors import ProblemError
from napf_mpc.planners.guided_field import GuidedNapfPlanner
from napf_mpc.planners.planner import Planner
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
from napf_mpc.problem import Problem
from napf_mpc.words import did_you_mean, shown_text


def _qp(problem: Problem) -> Planner:
    from napf_mpc.planners.mpc import QpPlanner  # with a solver's start-up time

    return QpPlanner(problem)


def _qp_unguided(problem: Problem) -> Planner:
    from napf_mpc.planners.mpc import QpPlanner

    return QpPlanner(problem, name="qp_unguided", guided=False)


PLANNERS: dict[str, Callable[[Problem], Planner]] = {
    "apf": ApfPlanner,
    "napf": NapfPlanner,
    "napf_guided": GuidedNapfPlanner,
    "qp": _qp,
    "qp_unguided": _qp_unguided,
}
"""Name -> factory."""


def make_planner(name: str, problem: Problem) -> Planner:
    """Planner of a name for a problem.

    Raises
    ------
    ProblemError
        If there is no planner of that name.
    """
    if name not in PLANNERS:
        choice = f"choose from {', '.join(PLANNERS)}{did_you_mean(name, PLANNERS)}"
        raise ProblemError("planner", [f'"{shown_text(name)}" is not a planner; {choice}'])
    return PLANNERS[name](problem)
