"""Mission of kind goal: one point walks to a goal by the traditional potential field (Fig. 3 and 4)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.apf import Walk, angle_step_walk
from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame
from napf_mpc.problem import GoalMission, Problem
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.scenes import build_scenes

Array = NDArray[np.float64]


def goal_mission(problem: Problem) -> GoalMission:
    """Return the problem's mission if it is a walk to a goal.

    Raises
    ------
    ProblemError
        If a formation has to fly it.
    """
    if not isinstance(problem.mission, GoalMission):
        raise ProblemError("mission.kind", ['is "formation", not "goal"'])
    return problem.mission


def goal_scene(problem: Problem, seed: int = 0, run: int = 0, data_folder: Path | None = None) -> ObstacleSet:
    """Obstacles of one run; a random world is laid out along the line from start to goal."""
    mission = goal_mission(problem)
    offset = np.subtract(mission.goal_m, mission.start_m)
    heading = float(np.arctan2(offset[1], offset[0]))
    frame = PathFrame.from_angles((*mission.start_m, 0.0), heading, 0.0)
    return build_scenes(problem.world, frame, np.zeros(1), seed, range(run, run + 1), data_folder)


def planar_distances(obstacles: ObstacleSet, influence_m: float, position: Array) -> tuple[Array, Array]:
    """Distances (m,) [m] and horizontal gradients (m, 2) of the obstacles in range, at height 0."""
    point = np.array([[[position[0], position[1], 0.0]]])
    near = obstacles.near(point, influence_m)
    return near.distance[0, 0], near.gradient[0, 0, :, :2]


def walk_to_goal(problem: Problem, obstacles: ObstacleSet) -> Walk:
    """Walk of the point from start to goal (Eq. 29-35).

    Raises
    ------
    ProblemError
        If the mission is not a walk to a goal.
    """
    mission, settings = goal_mission(problem), problem.planner
    return angle_step_walk(
        np.array(mission.start_m),
        np.array(mission.goal_m),
        lambda position: planar_distances(obstacles, settings.influence_m, position),
        attractive_gain=mission.attractive_gain,
        repulsive_gain=settings.repulsive_gain,
        influence_m=settings.influence_m,
        floor_m=settings.min_distance_m,
        step_m=mission.step_m,
        arrival_m=mission.arrival_m,
        max_steps=mission.max_steps,
    )
