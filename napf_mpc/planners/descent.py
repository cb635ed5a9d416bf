"""No fix: grow, hold, descend. Who holds its place for long goes down, and stops above what may be below."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc.formation import PathFrame, formation_offsets
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.problem import City, Forest, FormationMission, Problem, StreetCanyon
from napf_mpc.safety_distance import Inflation
from napf_mpc.vehicle.plant import plain
from napf_mpc.world.distance import BASE, TOP, Solids, signed_distance
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DESCENT_MPS = 0.5
"""Speed of a descent [m/s]."""


class Descent:
    """Memory of who holds its place since when, and how certain navigation was of it.

    After ``planner.descend_after_s`` of holding, the place that a UAV holds goes down at
    :data:`DESCENT_MPS`, until it is radius + k sigma_up above the ground, or above the top of anything that
    is within radius + k sigma of it in the plane and reaches below it: also above what stands beside it. It
    stops at ``planner.altitude_m[0]`` too, and in a world without ground at the lowest height of the
    mission's lanes. Stopped, it hovers until the hold is over.

    A sigma is that of the last solution that was trusted, or the one reported since if that is larger. Where
    none ever was trusted, nothing says what is below, and nobody goes down; so it is with margins from
    protection levels where there is no level, since the place that is held then follows the fix. k is the
    problem's, also for ``apf``: its fixed safety distance is for UAVs that know where they are.

    Parameters
    ----------
    problem : Problem
        Formation mission, world and planner settings.
    """

    def __init__(self, problem: Problem) -> None:
        mission, settings = problem.mission, problem.planner
        assert isinstance(mission, FormationMission)
        after_s = settings.descend_after_s
        self._after_s = math.inf if after_s is None else after_s
        self._step_m = DESCENT_MPS / settings.rate_hz
        self._k = Inflation.of_problem(problem).k
        self._radius_m = problem.vehicle.radius_m
        self._by_levels = settings.safety == "protection_level"
        self._ground_m = ground_m(problem)
        self._floor_m = -math.inf if settings.altitude_m is None else settings.altitude_m[0]
        if self._ground_m == -math.inf:
            frame = PathFrame.of_mission(mission)
            lanes = frame.to_world(formation_offsets(problem.formation) * np.array([0.0, 1.0, 1.0]))
            lowest = float(lanes[:, 2].min()) + min(0.0, mission.length_m * float(frame.along[2]))
            self._floor_m = max(self._floor_m, lowest)
        self.reset(ObstacleSet.empty(), 0, 0)

    def reset(self, obstacles: ObstacleSet, runs: int, uavs: int) -> None:
        """Take a new map and forget all holds."""
        self._obstacles = obstacles
        # NaN for who does not hold, infinity for whose descent has ended.
        self._since_s: Array = np.full((runs, uavs), np.nan)
        self._sigma: Array = np.full((runs, uavs, 2), np.inf)

    def note(self, nav: NavSolution, trusted: Mask) -> None:
        """Note sigmas in the plane and up; without trust (run, uav) they never shrink."""
        _note(plain(nav.covariance), trusted, self._sigma)
        if self._by_levels:
            self._sigma[~trusted] = np.inf

    def release(self) -> None:
        """Nobody holds any more."""
        self._since_s.fill(np.nan)

    def lower(self, time_s: float, holding: Mask, place: Array) -> Mask:
        """Lower the places of who has held for long.

        Parameters
        ----------
        time_s : float
            Now [s].
        holding : array of bool, shape (run, uav)
            Who holds its place.
        place : array, shape (run, uav, 3)
            Places held; heights are overwritten [m].

        Returns
        -------
        array of bool, shape (run, uav)
            Who goes down.
        """
        down = np.zeros(holding.shape, dtype=np.bool_)
        if not holding.any():
            self.release()
            return down
        lowest, highest = self._obstacles.boxes
        _lower(
            time_s, holding, self._after_s, self._sigma, self._k, self._radius_m, self._ground_m,
            self._floor_m, self._step_m, self._obstacles.solids, self._obstacles.scene_start, lowest, highest,
            self._since_s, place, down,
        )  # fmt: skip
        return down


def ground_m(problem: Problem) -> float:
    """Height of the ground of a problem's world; -infinity where it has none [m]."""
    match problem.world:
        case Forest() | StreetCanyon():
            return problem.world.ground_m
        case City():
            return 0.0  # all heights of its buildings are above ground
        case _:
            return -math.inf


@compiled_bare
def _note(covariance: Array, trusted: Mask, sigma: Array) -> None:
    """Write sigmas (run, uav, 2) of covariances (run, uav, 6, 6): largest in the plane, and up."""
    for run in range(sigma.shape[0]):
        for uav in range(sigma.shape[1]):
            c = covariance[run, uav]
            skew, both = 0.5 * (c[0, 0] - c[1, 1]), 0.5 * (c[0, 1] + c[1, 0])
            plane = 0.5 * (c[0, 0] + c[1, 1]) + math.sqrt(skew * skew + both * both)
            for n in range(2):
                variance = plane if n == 0 else c[2, 2]
                if math.isinf(c[0, 0]) or math.isinf(c[1, 1]):
                    variance = c[2, 2] if n == 1 else math.inf
                # What is no variance, NaN included, is not larger than what was known.
                found = math.sqrt(variance) if variance > 0.0 else 0.0
                if trusted[run, uav] or found > sigma[run, uav, n]:
                    sigma[run, uav, n] = found


@compiled
def _lower(
    time_s: float, holding: Mask, after_s: float, sigma: Array, k: float, radius_m: float, ground: float,
    floor: float, step_m: float, solids: Solids, scene_start: NDArray[np.int64], lowest: Array,
    highest: Array, since_s: Array, place: Array, down: Mask,
) -> None:  # fmt: skip
    """Write since when UAVs (run, uav) hold, their places (run, uav, 3), and who goes down.

    Boxes of all solids are given by their corners (solid, 3).
    """
    shared = len(scene_start) == 2
    for run in range(holding.shape[0]):
        scene = 0 if shared else run
        for uav in range(holding.shape[1]):
            if not holding[run, uav]:
                since_s[run, uav] = np.nan
                continue
            if np.isnan(since_s[run, uav]):
                since_s[run, uav] = time_s
            if not time_s - since_s[run, uav] >= after_s:
                continue
            x, y, z = place[run, uav]
            aside = radius_m + k * sigma[run, uav, 0]
            above = radius_m + k * sigma[run, uav, 1]
            stop = max(floor, ground + above) if aside < np.inf and above < np.inf else np.inf
            for i in range(scene_start[scene], scene_start[scene + 1]):
                if highest[i, 2] + above <= stop or lowest[i, 2] >= z + above:
                    continue
                # From between floor and roof, or a ball's middle, the distance is that in the plane.
                height = min(max(z, solids.parameters[i, BASE]), solids.parameters[i, TOP])
                if signed_distance(solids, i, x, y, height)[0] <= aside:
                    stop = highest[i, 2] + above
            if z > stop:
                place[run, uav, 2] = max(z - step_m, stop)
                down[run, uav] = True
            elif stop < np.inf:
                since_s[run, uav] = np.inf
