"""The paper's planners: velocity-update APF and NAPF over formation motion (Eq. 14-39)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napf_mpc import apf
from napf_mpc.errors import ProblemError
from napf_mpc.formation import PathFrame, formation_offsets, reference_speed, synchronisation_error
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.navigation.tracks import Tracks
from napf_mpc.planners.descent import DESCENT_MPS, Descent
from napf_mpc.planners.planner import Command, Reason
from napf_mpc.planners.tally import Event, Tally
from napf_mpc.planners.told import check_map, check_told
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.moving import round_distance
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]


class PotentialFieldPlanner:
    """Formation flight with a potential field whose distances are inflated by the navigation margin.

    Outside the range of influence it is pure formation motion: lane, synchronised speed (Eq. 18). Inside,
    the repulsion adds to the reference velocity (Eq. 37), the direction is held within the largest turn
    (Eq. 39), and the path point follows the UAV, so that the lateral tracking does not fight the avoidance.
    UAVs do not repel each other. A moving obstacle repels from where it is tracked now, inflated by k sigma
    of its place relative to the UAV.

    Parameters
    ----------
    problem : Problem
        Formation, mission and planner settings.
    inflation : Inflation
        How k sigma enters the distance; k = 0 is the fixed safety distance.
    name : str
        Name in tables.
    """

    def __init__(self, problem: Problem, inflation: Inflation, name: str) -> None:
        if not isinstance(problem.mission, FormationMission):
            raise ProblemError("mission.kind", ['must be "formation" for this planner, not "goal"'])
        self.problem = problem
        self.inflation = inflation
        self._name = name
        self._frame = PathFrame.of_mission(problem.mission)
        self._offsets = formation_offsets(problem.formation)
        self._lanes = self._frame.to_world(self._offsets * np.array([0.0, 1.0, 1.0]))
        self._descent = Descent(problem)
        self._obstacles = ObstacleSet.empty()
        self._last_s = -math.inf
        self._anchor: Array = np.zeros((0, 0, 3))
        self._placed: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)
        self._down: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)
        self.tally = Tally.none(0)

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return self._name

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map and forget where UAVs have been."""
        check_map(obstacles, runs)
        self._obstacles = obstacles
        self._last_s = -math.inf
        uavs = len(self._offsets)
        self._anchor = np.repeat(self._lanes[None], runs, axis=0)
        self._placed = np.zeros((runs, uavs), dtype=bool)
        self._descent.reset(obstacles, runs, uavs)
        self._down = np.zeros((runs, uavs), dtype=bool)
        self.tally = Tally.none(runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Command of all UAVs from the reported solution and the map."""
        settings, mission = self.problem.planner, self.problem.mission
        assert isinstance(mission, FormationMission)
        nav = self._told(nav, time_s)
        position, covariance, trusted = self._estimates(nav, time_s)
        error = synchronisation_error(self._frame.along_track(position), self._offsets[:, 0])
        speed = reference_speed(
            mission.speed_mps,
            self.problem.formation.sync_gain,
            error,
            settings.min_speed_ratio * mission.speed_mps,
            settings.max_speed_ratio * mission.speed_mps,
        )
        reference = speed[..., None] * self._frame.along
        force, avoiding = self._repulsion(position, covariance)
        if nav.tracks is not None and nav.tracks.count:
            away, near = self._moving_repulsion(position, covariance, nav.tracks)
            force, avoiding = force + away, avoiding | near
        velocity = apf.velocity_update(reference, force, settings.max_speed_ratio * mission.speed_mps)
        direction = apf.limit_turn(
            velocity, self._frame.along, self._frame.left, math.radians(settings.max_turn_deg)
        )
        size = np.sqrt(velocity[..., 0] ** 2 + velocity[..., 1] ** 2 + velocity[..., 2] ** 2)
        command = Command(
            position=np.where(avoiding[..., None], position, self._lanes),
            velocity=direction * size[..., None],
            direction=direction,
            yaw=np.full(trusted.shape, self._frame.heading_rad),
            holding=~trusted,
            feedforward=np.zeros((*trusted.shape, 4)),
            reason=lost_reasons(trusted),
        )
        return self._hold(self._wait(command, nav), trusted)

    def _told(self, nav: NavSolution, time_s: float) -> NavSolution:
        """Solution that fits, with the covariance that the margins are made of."""
        check_told(nav, self.problem, len(self._anchor), time_s, self._last_s)
        self._last_s = time_s
        return self.inflation.informed(nav)

    def _estimates(self, nav: NavSolution, time_s: float) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Positions, their covariances and which of them are trusted; every number finite."""
        trusted = nav.trusted()
        self._move_anchors(nav, trusted)
        self._lower_anchors(nav, trusted, time_s)
        if trusted.all():
            return nav.position, nav.position_covariance, trusted
        # What is not trusted must not reach the arithmetic, where NaN would spread to all UAVs by u_c.
        # The others keep formation with the place where such a UAV holds.
        covariance = np.where(trusted[..., None, None], nav.position_covariance, np.eye(3))
        return self._anchor, covariance, trusted

    def _repulsion(self, position: Array, covariance: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Force on each UAV (run, uav, 3), and whether any obstacle is within its range (run, uav)."""
        settings = self.problem.planner
        reach = settings.influence_m + self.inflation.largest_margin(covariance)
        near = self._obstacles.near(position, reach + self.problem.vehicle.radius_m)
        margin = self.inflation.margin(covariance, near.gradient)
        return self._force(near.distance, near.gradient, margin)

    def _moving_repulsion(
        self, position: Array, covariance: Array, tracks: Tracks
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Force of the moving obstacles on each UAV (run, uav, 3), and whether any is within its range."""
        distance, gradient = round_distance(
            position[:, :, None], tracks.position[:, None], tracks.radius, tracks.upright
        )
        relative = covariance[:, :, None] + tracks.position_covariance[:, None]
        return self._force(
            distance, gradient, self.inflation.margin(relative, gradient[..., None, :])[..., 0]
        )

    def _force(self, distance: Array, gradient: Array, margin: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Sum of the forces of obstacles (run, uav, m), and whether any is within its range."""
        settings = self.problem.planner
        rho, influence = self.inflation.apply(
            distance - self.problem.vehicle.radius_m, margin, settings.influence_m
        )
        force = apf.repulsive_force(
            rho, gradient, settings.repulsive_gain, influence, settings.min_distance_m
        )
        return force, np.asarray((rho < influence).any(-1))

    def _move_anchors(self, nav: NavSolution, trusted: NDArray[np.bool_]) -> None:
        """Note the last trusted place of each UAV; until there is one, the first that is a number.

        A fix without a protection level may be any distance off, and a UAV that held its place by it would
        be moved by that: it follows the fix, and holds by its velocity.
        """
        follows = self.inflation.safety == "protection_level"
        known = trusted | ((~self._placed | follows) & np.isfinite(nav.position).all(-1))
        self._anchor = np.where(known[..., None], nav.position, self._anchor)
        self._placed |= known

    def _lower_anchors(self, nav: NavSolution, trusted: NDArray[np.bool_], time_s: float) -> None:
        """Lower the places of who has long been without navigation, and count it."""
        self._descent.note(nav, trusted)
        down = self._descent.lower(time_s, ~trusted, self._anchor)
        flown = down if nav.airborne is None else down & nav.airborne
        self.tally.counts["fall_back_descend"] += flown.sum(-1)
        self.tally.events.extend(
            Event(time_s, run, uav, "navigation", "descend")
            for run, uav in np.argwhere(flown & ~self._down).tolist()
        )
        self._down = down

    def _wait(self, command: Command, nav: NavSolution) -> Command:
        """Let a formation brake and wait for a UAV whose navigation is disputed.

        It holds where it is, between the lanes of others, and nothing here keeps UAVs that pass it away.
        """
        if nav.disputed is None or not nav.disputed.any():
            return command
        waits = np.broadcast_to(nav.disputed.any(-1, keepdims=True), nav.disputed.shape)
        stopped = waits[..., None]
        assert command.reason is not None
        return replace(
            command,
            position=np.where(stopped, self._anchor, command.position),
            velocity=np.where(stopped, 0.0, command.velocity),
            direction=np.where(stopped, 0.0, command.direction),
            holding=command.holding | waits,
            reason=np.maximum(command.reason, np.int8(Reason.WAITING) * waits),
        )

    def _hold(self, command: Command, trusted: NDArray[np.bool_]) -> Command:
        """Hover at the last trusted place, or go down, where navigation is not to be trusted.

        Never as if there were no obstacle.
        """
        if trusted.all():
            return command
        lost, down = ~trusted[..., None], np.zeros(command.velocity.shape)
        down[..., 2] = np.where(self._down, -1.0, 0.0)
        return replace(
            command,
            position=np.where(lost, self._anchor, command.position),
            velocity=np.where(lost, DESCENT_MPS * down, command.velocity),
            direction=np.where(lost, down, command.direction),
        )


def lost_reasons(trusted: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Codes of :class:`~napf_mpc.planners.planner.Reason` for UAVs whose navigation may not be trusted."""
    return np.where(trusted, Reason.NONE, Reason.NAVIGATION).astype(np.int8)


class ApfPlanner(PotentialFieldPlanner):
    """The paper's original APF: a fixed safety distance, whatever navigation reports."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, Inflation(0.0), "apf")


class NapfPlanner(PotentialFieldPlanner):
    """The paper's NAPF: the safety distance follows the reported navigation variance (section 3.2)."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, Inflation.of_problem(problem), "napf")
