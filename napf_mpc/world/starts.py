"""Where UAVs start: random obstacles keep clear of it, and whatever else covers it is refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import SceneError
from napf_mpc.jit import compiled
from napf_mpc.world.distance import Solids, signed_distance
from napf_mpc.world.moving import MovingObstacles, round_distance
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

CLEAR_M = 0.5
"""Gap that random obstacles leave to a UAV at its start [m]. No planner's margin, so that every planner and
setting of a comparison flies through the same scenes."""


@dataclass(frozen=True, eq=False)
class Starts:
    """Initial places of the UAVs, the same in every run; without arguments, of nobody."""

    positions: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(uav, 3) [m]."""
    radius_m: float = 0.0
    """Radius of a UAV."""
    keys: str = "mission.start_m"
    """Keys that move them, for messages."""

    @property
    def reach_m(self) -> float:
        """Distance of its centre that random obstacles keep from a UAV."""
        return self.radius_m + CLEAR_M

    def too_near(self, obstacles: ObstacleSet) -> NDArray[np.bool_]:
        """Which of the obstacles, shape (obstacle,), reach into the gap about a UAV."""
        near = np.zeros(len(obstacles), dtype=np.bool_)
        _mark_near(obstacles.solids, self.positions, self.reach_m, near)
        return near

    def refuse_contact(self, obstacles: ObstacleSet, name: Callable[[int], str]) -> None:
        """Refuse a scene in which a UAV starts in contact; an exact touch counts, as it does in flight.

        Parameters
        ----------
        obstacles : ObstacleSet
            A single scene.
        name : callable
            Words for an obstacle, given its index.

        Raises
        ------
        SceneError
            If a UAV touches an obstacle; the deepest contact is named.
        """
        if len(self.positions):
            distance, _, index = obstacles.nearest(self.positions[None])
            self._refuse(distance[0], lambda uav: name(int(index[0, uav])))

    def refuse_moving(self, moving: MovingObstacles) -> None:
        """Refuse moving obstacles that start in contact with a UAV, as :meth:`refuse_contact` does.

        Raises
        ------
        SceneError
            If a UAV touches one.
        """
        distance, _ = round_distance(
            self.positions[:, None], moving.start[None], moving.radius[None], moving.upright[None]
        )
        nearest = distance.argmin(axis=1)
        self._refuse(distance.min(axis=1), lambda uav: f"world.moving[{nearest[uav]}]")

    def _refuse(self, distance: Array, name: Callable[[int], str]) -> None:
        """Raise for the deepest of the contacts, by the distance (uav,) of each to its nearest obstacle."""
        contacts = int(np.count_nonzero(distance <= self.radius_m))
        if not contacts:
            return
        uav = int(distance.argmin())
        others = f" (and {contacts - 1} more of the UAVs start in contact)" if contacts > 1 else ""
        overlap_m = self.radius_m - float(distance[uav])
        raise SceneError(
            f"UAV {uav + 1} starts at {self.positions[uav].tolist()} m in contact with {name(uav)}: with its "
            f"radius of {self.radius_m:g} m it overlaps by {overlap_m:.3g} m{others}; move the obstacle, or "
            f"the UAV ({self.keys})"
        )


@compiled
def _mark_near(solids: Solids, places: Array, reach: float, near: NDArray[np.bool_]) -> None:
    """Mark solids nearer than a reach to any place (place, 3)."""
    for i in range(len(near)):
        for place in range(places.shape[0]):
            if signed_distance(solids, i, places[place, 0], places[place, 1], places[place, 2])[0] <= reach:
                near[i] = True
                break
