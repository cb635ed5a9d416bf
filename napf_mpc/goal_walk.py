"""Mission of kind goal: one point walks to a goal by the traditional potential field (Fig. 3 and 4)."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.apf import Walk, angle_step_walk
from napf_mpc.block import Block, score_rows, timing_row
from napf_mpc.errors import ProblemError
from napf_mpc.evaluate import METRICS, Outcome, Score
from napf_mpc.formation import PathFrame
from napf_mpc.planners.tally import Tally
from napf_mpc.problem import GoalMission, Problem
from napf_mpc.store import Columns
from napf_mpc.words import shown_text
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.scenes import build_scenes
from napf_mpc.world.starts import Starts
from napf_mpc.world.sweep import SweptClearance

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


def goal_scenes(
    problem: Problem, seed: int = 0, runs: range = range(1), data_folder: Path | None = None
) -> ObstacleSet:
    """Obstacles of some runs; a random world is laid out along the line from start to goal."""
    mission = goal_mission(problem)
    offset = np.subtract(mission.goal_m, mission.start_m)
    heading = float(np.arctan2(offset[1], offset[0]))
    frame = PathFrame.from_angles((*mission.start_m, 0.0), heading, 0.0)
    starts = Starts(frame.origin[None], problem.vehicle.radius_m)
    return build_scenes(problem.world, frame, np.zeros(1), seed, runs, data_folder, starts)


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


def walk_block(problem: Problem, planner: str, seed: int, run: int, obstacles: ObstacleSet) -> Block:
    """Walk of the point as a block of one run, with the columns of a flight as far as a point has them.

    Raises
    ------
    ProblemError
        If the mission is not a walk to a goal, or the planner cannot walk.
    """
    goal_mission(problem)
    if planner != "apf":
        raise ProblemError("planner", [f'"{shown_text(planner)}" cannot walk to a goal; only "apf" can'])
    began = time.perf_counter()
    walk = walk_to_goal(problem, obstacles)
    timing = timing_row(planner, range(run, run + 1), time.perf_counter() - began)
    points = np.column_stack([walk.positions, np.zeros(len(walk.positions))])
    rows = score_rows(planner, seed, _score(problem, run, walk.arrived, points, obstacles))
    no_events = Tally.none(1).event_columns(planner, run)
    return Block(rows, timing, _trajectory(planner, run, points), no_events)


def _score(problem: Problem, run: int, arrived: bool, points: Array, obstacles: ObstacleSet) -> Score:
    mission = goal_mission(problem)
    swept = SweptClearance(obstacles, 1, 1)
    swept.update(points[None, :1], points[None, :1])
    for before, after in pairwise(points):
        swept.update(before[None, None], after[None, None])
    clearance = float(swept.clearance[0, 0]) - problem.vehicle.radius_m
    contact = swept.contact(problem.vehicle.radius_m)
    metrics = {name: np.array([np.nan]) for name in METRICS}
    progress = float(np.hypot(*np.subtract(mission.goal_m, mission.start_m)))
    if arrived and progress > 0.0:
        metrics["path_length_ratio"][0] = mission.step_m * (len(points) - 1) / progress
    if np.isfinite(clearance):
        metrics["min_clearance_m"][0] = clearance
    outcome = Outcome.COLLIDED if contact.any() else Outcome.REACHED if arrived else Outcome.TIMEOUT
    return Score(
        runs=np.array([run]),
        outcome=(outcome,),
        obstacle_contact=contact,
        uav_contact=np.array([False]),
        joint_success=np.array([outcome is Outcome.REACHED]),
        finished=np.array([arrived]),
        reason=("",),
        metrics=metrics,
    )


def _trajectory(planner: str, run: int, points: Array) -> Columns:
    """Places step by step; a walk has no clock, so its time is not defined."""
    steps = len(points)
    return {
        "run": np.full(steps, run),
        "planner": np.full(steps, planner),
        "t_s": np.full(steps, np.nan),
        "uav": np.zeros(steps, dtype=np.int64),
        "step": np.arange(steps),
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "z_m": points[:, 2],
    }
