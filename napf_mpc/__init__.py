"""UAV formation flight among obstacles with uncertain navigation: planners, closed loop, honest risk.

Importing this package loads nothing heavy; each public name loads its module when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napf_mpc.block import Missions, simulate
    from napf_mpc.campaign import compare, run_campaign
    from napf_mpc.constraints.constraint import Constraint, Horizon, LinearRows
    from napf_mpc.errors import DataError, NapfError, NavigationError, OutputError, ProblemError, SceneError
    from napf_mpc.navigation.solution import NavSolution
    from napf_mpc.planners.mpc import QpPlanner
    from napf_mpc.planners.planner import Command, Planner
    from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
    from napf_mpc.planners.registry import register_planner
    from napf_mpc.problem import Problem
    from napf_mpc.problem_file import load_problem
    from napf_mpc.safety_distance import clearance_margin
    from napf_mpc.solvers.solver import register_solver
    from napf_mpc.vehicle.lqr import lqr
    from napf_mpc.vehicle.quadrotor import linearize

__version__ = "0.1.0"

_HOMES = {
    "ApfPlanner": "planners.potential_field",
    "Command": "planners.planner",
    "Constraint": "constraints.constraint",
    "DataError": "errors",
    "Horizon": "constraints.constraint",
    "LinearRows": "constraints.constraint",
    "Missions": "block",
    "NapfError": "errors",
    "NapfPlanner": "planners.potential_field",
    "NavSolution": "navigation.solution",
    "NavigationError": "errors",
    "OutputError": "errors",
    "Planner": "planners.planner",
    "Problem": "problem",
    "ProblemError": "errors",
    "QpPlanner": "planners.mpc",
    "SceneError": "errors",
    "clearance_margin": "safety_distance",
    "compare": "campaign",
    "linearize": "vehicle.quadrotor",
    "load_problem": "problem_file",
    "lqr": "vehicle.lqr",
    "register_planner": "planners.registry",
    "register_solver": "solvers.solver",
    "run_campaign": "campaign",
    "simulate": "block",
}

__all__ = [
    "ApfPlanner",
    "Command",
    "Constraint",
    "DataError",
    "Horizon",
    "LinearRows",
    "Missions",
    "NapfError",
    "NapfPlanner",
    "NavSolution",
    "NavigationError",
    "OutputError",
    "Planner",
    "Problem",
    "ProblemError",
    "QpPlanner",
    "SceneError",
    "clearance_margin",
    "compare",
    "linearize",
    "load_problem",
    "lqr",
    "register_planner",
    "register_solver",
    "run_campaign",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(import_module(f"napf_mpc.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'napf_mpc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
