"""ORCA (van den Berg et al. 2011) by the package ``pyrvo`` as a planner of formations, for benchmarks.

ORCA chooses a velocity for each UAV in the horizontal plane, the nearest to a preferred one that keeps it
apart from obstacles and from UAVs that choose alike. What the method leaves open is chosen here:

- The preferred velocity is NAPF's outside the range of obstacles: along the lane at the synchronised speed,
  and back to the lane.
- The package is planar. Every obstacle is an upright cylinder with the radius of the sphere or cylinder,
  endless, and a UAV keeps the height of its slot; so ORCA never flies over a sphere, as others may.
- The package knows polygons only: the circle is enclosed in a regular one with a side towards the UAV, so
  that ahead of it the polygon is exactly as near as the circle.
- Obstacles inflated by k sigma, or not at all. A UAV whose estimate is inside an inflated obstacle would not
  be stopped by it, as the package takes a polygon's inside for free; the polygon then ends at the UAV.
- UAVs are not inflated, as NAPF's are not. Each decides by its own estimate and those of the others.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame, formation_offsets, reference_speed, synchronisation_error
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.planner import Command
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.shapes import Cylinder, Sphere

Array = NDArray[np.float64]

HORIZON_S = 3.0
"""How far ahead ORCA looks, for obstacles and UAVs alike."""
CORNERS = 12
"""Of a polygon around a circle: 3.5 % farther out at its corners."""
PULL_PER_S = 0.5
"""Preferred velocity back to the lane, over the distance from it ..."""
MOST_PULL_MPS = 1.0
"""... but no faster than this."""
SHUT_M = 0.01
"""A polygon stays at least this far from the estimate that it would enclose."""


def package() -> Any:
    """The package, or the way to it.

    Raises
    ------
    SystemExit
        If it is not installed.
    """
    try:
        return import_module("pyrvo")
    except ImportError:
        raise SystemExit("ORCA needs the package pyrvo: pip install --no-deps pyrvo") from None


class OrcaPlanner:
    """Formation flight by optimal reciprocal collision avoidance.

    Parameters
    ----------
    problem : Problem
        Formation, mission and speeds.
    inflation : Inflation
        How far obstacles grow with the reported covariance; k = 0 for not at all.
    name : str
        Name in tables.

    Raises
    ------
    ProblemError
        If the mission is no formation's.
    """

    def __init__(self, problem: Problem, inflation: Inflation, name: str) -> None:
        if not isinstance(problem.mission, FormationMission):
            raise ProblemError("mission.kind", ['must be "formation" for this planner, not "goal"'])
        self._rvo = package()
        self._problem, self._mission = problem, problem.mission
        self._inflation, self._name = inflation, name
        self._frame = PathFrame.of_mission(problem.mission)
        self._offsets = formation_offsets(problem.formation)
        self._lanes = self._frame.to_world(self._offsets * np.array([0.0, 1.0, 1.0]))
        self._fastest = problem.planner.max_speed_ratio * problem.mission.speed_mps
        # Two UAVs are too close at the least separation, a UAV touches an obstacle at its own radius.
        self._radius = max(problem.vehicle.radius_m, 0.5 * problem.vehicle.min_separation_m)
        self._circles: list[Array] = []
        self._anchor: Array = np.zeros((0, 0, 3))

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self._name

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map."""
        scenes = [_circles(obstacles, i) for i in range(obstacles.n_scenes)]
        self._circles = scenes * runs if len(scenes) == 1 else scenes
        self._anchor = np.repeat(self._lanes[None], runs, axis=0)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Command of all UAVs from the reported solution and the map."""
        trusted = nav.trusted()
        self._anchor = np.where(trusted[..., None], nav.position, self._anchor)
        position, settings = self._anchor, self._problem.planner
        place = self._frame.to_path(position)
        speed = reference_speed(
            self._mission.speed_mps,
            self._problem.formation.sync_gain,
            synchronisation_error(place[..., 0], self._offsets[:, 0]),
            settings.min_speed_ratio * self._mission.speed_mps,
            self._fastest,
        )
        along = speed[..., None] * self._frame.along
        off = PULL_PER_S * (self._offsets[:, 1] - place[..., 1])
        across = np.clip(off, -MOST_PULL_MPS, MOST_PULL_MPS)[..., None] * self._frame.left
        preferred = along + across
        covariance = np.where(trusted[..., None, None], nav.position_covariance, np.eye(3))
        chosen = np.zeros_like(position)
        airborne = trusted if nav.airborne is None else trusted & nav.airborne
        for run, uav in np.argwhere(airborne):
            chosen[run, uav, :2] = self._velocity(
                run, uav, position[run], nav.velocity[run], preferred[run], covariance[run, uav]
            )
        size = np.sqrt(chosen[..., 0] ** 2 + chosen[..., 1] ** 2)[..., None]
        direction = chosen / np.maximum(size, 1e-9)
        # Left to itself a UAV flies its lane, as with NAPF; in avoidance its lane does not draw it.
        free = np.all(np.abs(chosen - preferred)[..., :2] < 1e-4, axis=-1, keepdims=True)
        follow = np.concatenate(
            [position[..., :2], np.broadcast_to(self._lanes[:, 2:], (*free.shape[:2], 1))], axis=-1
        )
        moving = free & airborne[..., None]
        return Command(
            position=np.where(moving, self._lanes, np.where(trusted[..., None], follow, self._anchor)),
            velocity=np.where(moving, along, chosen),
            direction=np.where(moving, self._frame.along, direction),
            yaw=np.full(trusted.shape, self._frame.heading_rad),
            holding=~trusted,
            feedforward=np.zeros((*trusted.shape, 4)),
        )

    def _velocity(
        self, run: int, uav: int, position: Array, velocity: Array, preferred: Array, covariance: Array
    ) -> tuple[float, float]:
        """ORCA's choice for one UAV [m/s]."""
        simulator = self._rvo.RVOSimulator()
        simulator.set_time_step(1.0 / self._problem.planner.rate_hz)
        reach = 2.0 * HORIZON_S * self._fastest + 2.0 * self._radius
        simulator.set_agent_defaults(reach, len(position), HORIZON_S, HORIZON_S, self._radius, self._fastest)
        for polygon in self._polygons(run, position[uav], covariance):
            simulator.add_obstacle(polygon)
        simulator.process_obstacles()
        # This UAV first: the package numbers agents as they come.
        for other in (uav, *(i for i in range(len(position)) if i != uav)):
            agent = simulator.add_agent(_pair(position[other]))
            simulator.set_agent_velocity(agent, _pair(velocity[other]))
            simulator.set_agent_pref_velocity(agent, _pair(preferred[other]))
        simulator.do_step()
        answer = simulator.get_agent_velocity(0)
        return float(answer.x), float(answer.y)

    def _polygons(self, run: int, position: Array, covariance: Array) -> list[list[tuple[float, float]]]:
        """Polygons around the obstacles near a UAV, anticlockwise: their insides are solid."""
        circles = self._circles[run]
        away = position[:2] - circles[:, :2]
        distance = np.sqrt(away[:, 0] ** 2 + away[:, 1] ** 2)
        normal = np.zeros((len(circles), 3))
        normal[:, :2] = away / np.maximum(distance, 1e-9)[:, None]
        grown = circles[:, 2] + self._inflation.margin(covariance, normal)
        near = distance < grown + HORIZON_S * self._fastest + 2.0 * self._radius
        inner = np.minimum(grown, distance - SHUT_M)
        near &= inner > SHUT_M
        turn = (2.0 * np.arange(CORNERS) - 1.0) * math.pi / CORNERS
        polygons = []
        for (x, y, _), (east, north, _), side in zip(circles[near], normal[near], inner[near], strict=True):
            angles = math.atan2(north, east) + turn
            corner = side / math.cos(math.pi / CORNERS)
            xs, ys = x + corner * np.cos(angles), y + corner * np.sin(angles)
            polygons.append(list(zip(xs.tolist(), ys.tolist(), strict=True)))
        return polygons


def _pair(vector: Array) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])


def _circles(obstacles: ObstacleSet, scene: int) -> Array:
    """East and north of the axis, and radius, of each obstacle of a scene (obstacle, 3) [m].

    Raises
    ------
    ProblemError
        If one is neither a sphere nor a cylinder.
    """
    shapes = obstacles.shapes(scene)
    for shape in shapes:
        if not isinstance(shape, Sphere | Cylinder):
            raise ProblemError("world", [f"holds a {type(shape).__name__}: ORCA here knows round ones only"])
    round_ones = [shape for shape in shapes if isinstance(shape, Sphere | Cylinder)]
    return np.array([[*shape.centre_m[:2], shape.radius_m] for shape in round_ones]).reshape(-1, 3)
