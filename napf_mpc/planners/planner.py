"""What a planner is: navigation solution in, command out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from napf_mpc.navigation.solution import NavSolution
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]


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
    """(run, uav): hovering because the planner has no navigation that it trusts, or no way."""
    feedforward: Array
    """(run, uav, 4) inputs about hover [N, N m]; zero where the planner leaves them to the feedback."""


class Planner(Protocol):
    """A planner flies all runs in lock-step and owns its memory between steps."""

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
