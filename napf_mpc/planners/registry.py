"""Planners by name: what ``--planner`` and ``planner.kind`` choose from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from napf_mpc.errors import ProblemError
from napf_mpc.planners.guided_field import GuidedNapfPlanner
from napf_mpc.planners.planner import Planner, planner_fault
from napf_mpc.planners.potential_field import ApfPlanner, NapfPlanner
from napf_mpc.problem import Problem
from napf_mpc.words import did_you_mean, shown_text, shown_value


def _qp(problem: Problem) -> Planner:
    from napf_mpc.planners.mpc import QpPlanner  # with a solver's start-up time

    return QpPlanner(problem)


def _qp_unguided(problem: Problem) -> Planner:
    from napf_mpc.planners.mpc import QpPlanner

    return QpPlanner(problem, name="qp_unguided", guided=False)


Factory = Callable[[Problem], Planner]
"""Makes a planner for a problem."""

PLANNERS: dict[str, Factory] = {
    "apf": ApfPlanner,
    "napf": NapfPlanner,
    "napf_guided": GuidedNapfPlanner,
    "qp": _qp,
    "qp_unguided": _qp_unguided,
}
"""Name -> factory of the shipped planners."""
_OWN: dict[str, Factory] = {}

NAME_IT = (
    "register_planner(name, factory) gives a planner of your own one, and simulate(problem, planner) flies "
    "it without"
)
"""The way out for who gives a planner where its name is asked for."""


def register_planner(name: str, factory: Callable[[Problem], Planner]) -> None:
    """Add a planner, for all that take planners by name: ``simulate``, ``compare``, ``run_campaign``.

    It holds for this process. Workers of a campaign are sent the factory: whole if a script, a notebook or a
    function defines it, else by the name of its module, which they must be able to import.

    Parameters
    ----------
    name : str
        Its name in tables and files; a name that is taken is refused.
    factory : callable
        ``factory(problem)`` returns a new :class:`~napf_mpc.planners.planner.Planner`; a class whose
        ``__init__`` takes a problem is one.

    Raises
    ------
    ProblemError
        If the name is taken or none, or the factory cannot be called.
    """
    if not isinstance(name, str) or not name or name != name.strip() or "," in name or not name.isprintable():
        shown = shown_value(name)
        raise ProblemError("planner", [f"name = {shown}: must be a text without commas, blanks around it"])
    if name in planner_names():
        raise ProblemError("planner", [f'"{shown_text(name)}": a planner of this name exists already'])
    if not callable(factory):
        kind = type(factory).__name__
        raise ProblemError(
            "planner",
            [f'"{name}": the factory is a {kind}, must be a class or function that takes a problem'],
        )
    _OWN[name] = factory


def planner_names() -> tuple[str, ...]:
    """Names of all planners, shipped and registered."""
    return (*PLANNERS, *_OWN)


def own_planners(names: Iterable[str]) -> dict[str, Factory]:
    """Those of some planners that were registered: name -> factory."""
    return {name: _OWN[name] for name in names if name in _OWN}


def make_planner(name: str, problem: Problem, own: Mapping[str, Factory] | None = None) -> Planner:
    """Planner of a name for a problem.

    Parameters
    ----------
    name : str
        One of :func:`planner_names`.
    problem : Problem
        What it is to fly.
    own : mapping of str to callable, optional
        Registered planners, instead of those of this process.

    Raises
    ------
    ProblemError
        If there is no planner of that name, or a factory makes none.
    """
    if not isinstance(name, str):
        raise ProblemError("planner", [f"planner is a {type(name).__name__}, not a name; {NAME_IT}"])
    if name in PLANNERS:
        return PLANNERS[name](problem)
    factory = (_OWN if own is None else own).get(name)
    if factory is None:
        known = planner_names()
        choice = f"choose from {', '.join(known)}{did_you_mean(name, known)}"
        raise ProblemError("planner", [f'"{shown_text(name)}" is not a planner; {choice}'])
    planner = factory(problem)
    if fault := planner_fault(planner):
        raise ProblemError("planner", [f'"{name}": what its factory makes {fault}'])
    return planner
