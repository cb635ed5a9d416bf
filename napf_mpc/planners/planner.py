"""What a planner is: navigation solution in, command out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.plan import Plan
from napf_mpc.planners.tally import Tally
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]


class Reason(IntEnum):
    """Why a UAV waits; what is written of a run is that of its UAV with the largest code."""

    NONE = 0
    """It does not."""
    WAITING = 1
    """There is no way now; errors or others may clear it."""
    NAVIGATION = 2
    """Its navigation is not to be trusted."""
    SOLVER = 3
    """No answer of the solver can be flown, nor the rest of the last plan."""
    NO_PASSAGE = 4
    """There is no safe passage at this confidence."""


REASON_WORDS = {
    Reason.NONE: "",
    Reason.WAITING: "waits for a safe passage",
    Reason.NAVIGATION: "navigation not to be trusted",
    Reason.SOLVER: "no plan accepted",
    Reason.NO_PASSAGE: "no safe passage at this confidence",
}


@dataclass(frozen=True)
class Command:
    """Reference for the inner loop of every UAV of every run, valid until the next one."""

    position: Array
    """(run, uav, 3) path point P_i [m]."""
    velocity: Array
    """(run, uav, 3) reference velocity n_i V_i [m/s]."""
    direction: Array
    """(run, uav, 3) unit track n_i: position errors along it do not count; zero to hold the point."""
    yaw: Array
    """(run, uav) reference yaw [rad]."""
    holding: NDArray[np.bool_]
    """(run, uav): hovering because the planner has no navigation that it trusts, no plan, or no way."""
    feedforward: Array
    """(run, uav, 4) inputs about hover [N, N m]; zero where the planner leaves them to the feedback."""
    plan: Plan | None = None
    """Plans over time: the inner loop then flies ``u_plan(t) - K (x_nav - x_plan(t))``."""
    planned: NDArray[np.bool_] | None = None
    """(run, uav): whose plan is to be flown; the others follow path point, velocity and direction."""
    reason: NDArray[np.int8] | None = None
    """(run, uav) codes of :class:`Reason`: why a UAV does not fly on as asked."""
    slack_m: Array | None = None
    """(run, uav) most that the flown plan is inside an obstacle's margin [m]."""
    solver_status: NDArray[np.str_] | None = None
    """(run, uav) word of the solver for this step's program."""
    tilt_thrust: bool = False
    """Whether a plan's thrust is what holds against gravity, to be given in full at any tilt."""


_FIELDS = (
    *((name, (3,)) for name in ("position", "velocity", "direction")),
    *((name, ()) for name in ("yaw", "holding")),
    ("feedforward", (4,)),
)
"""Arrays of a command and their axes after (run, uav)."""
_OPTIONAL = ("planned", "reason", "slack_m", "solver_status")
"""Arrays (run, uav) of a command that may be None."""


def check_command(command: Command, planner: str, shape: tuple[int, int]) -> None:
    """Refuse what is no command for UAVs of shape (run, uav).

    Raises
    ------
    ProblemError
        Naming the planner and every field that does not fit.
    """
    try:
        vector = (*shape, 3)
        if (
            command.position.shape == vector
            and command.velocity.shape == vector
            and command.direction.shape == vector
            and command.yaw.shape == shape
            and command.holding.shape == shape
            and command.feedforward.shape == (*shape, 4)
            and (command.planned is None or command.planned.shape == shape)
            and (command.reason is None or command.reason.shape == shape)
            and (command.slack_m is None or command.slack_m.shape == shape)
            and (command.solver_status is None or command.solver_status.shape == shape)
            and (command.plan is None or command.plan.initial.shape[:2] == shape)
        ):
            return
    except AttributeError:
        pass  # of something that is no array: it is named below
    raise ProblemError(f'planner "{planner}"', [*_command_faults(command, shape)])


def _command_faults(command: Command, shape: tuple[int, int]) -> Iterator[str]:
    if not isinstance(command, Command):
        yield f"step() returned a {type(command).__name__}, must return a Command"
        return
    optional = [(name, ()) for name in _OPTIONAL if getattr(command, name) is not None]
    for name, axes in (*_FIELDS, *optional):
        values, want = getattr(command, name), (*shape, *axes)
        words = f"(run, uav{''.join(f', {n}' for n in axes)}) = {want}"
        if not isinstance(values, np.ndarray):
            yield f"{name} is a {type(values).__name__}, must be an array {words}"
        elif values.shape != want:
            yield f"{name} has shape {values.shape}, must be {words}"
    plan = command.plan
    if plan is not None and not (isinstance(plan, Plan) and plan.initial.shape[:2] == shape):
        yield f"plan is a {type(plan).__name__}, must be a Plan of (run, uav) = {shape}"


class Planner(Protocol):
    """A planner flies all runs in lock-step and owns its memory between steps.

    One with a solver, or that counts its descents, also has an attribute ``tally``, a
    :class:`~napf_mpc.planners.tally.Tally`.
    """

    @property
    def name(self) -> str:
        """Name in tables and files."""
        ...

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Forget everything and take a new map.

        Parameters
        ----------
        obstacles : ObstacleSet
            One scene for all runs, or one scene a run.
        runs : int
            Number of runs that the next steps are for.
        """
        ...

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Command from what navigation reports; called at the planner's rate."""
        ...


def planner_fault(planner: object) -> str:
    """Why something is no planner, in words; empty if it is one."""
    if isinstance(planner, type):
        return f"is the class {planner.__name__}, not a planner of it: give {planner.__name__}(problem)"
    kind = type(planner).__name__
    missing = [name for name in ("name", "reset", "step") if not hasattr(planner, name)]
    if missing:
        return f"is a {kind}: it has no {', '.join(missing)}"
    name = planner.name  # type: ignore[attr-defined]
    return "" if isinstance(name, str) and name else f"is a {kind}: its name must be a text that is not empty"


def tally_of(planner: Planner, runs: int) -> Tally:
    """What a planner counted in each run; zeros for one that counts nothing."""
    tally = getattr(planner, "tally", None)
    return tally if isinstance(tally, Tally) else Tally.none(runs)
