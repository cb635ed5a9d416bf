"""NAPF along a guide: the potential field acts on UAVs whose lanes bend around what they cannot pass."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from napf_mpc import apf
from napf_mpc.formation import reference_speed, synchronisation_error
from napf_mpc.navigation.solution import NavSolution
from napf_mpc.planners.guidance import Guidance, guidance_covariance
from napf_mpc.planners.guide import Guide, Passage
from napf_mpc.planners.guide_settings import GuidanceSettings
from napf_mpc.planners.plan import stage_grid
from napf_mpc.planners.planner import Command, Reason
from napf_mpc.planners.potential_field import PotentialFieldPlanner, lost_reasons
from napf_mpc.problem import FormationMission, Problem
from napf_mpc.safety_distance import Inflation
from napf_mpc.world.obstacles import ObstacleSet

Array = NDArray[np.float64]

TANGENT_M = 2.0
"""The reference direction is the guide's mean slope over this distance ahead."""
PULL_PER_S = 0.5
"""An avoiding UAV, which does not track its lane, is drawn to the guide at this rate ..."""
MOST_PULL_MPS = 1.0
"""... but no faster than this."""
STRICT = GuidanceSettings(measured_k=0.0)
"""Repulsion keeps no distance in a gap that lacks some: NAPF is led into none that its own k calls closed."""


class GuidedNapfPlanner(PotentialFieldPlanner):
    """NAPF that follows formation guidance: lane plus offset, and the guide's tangent as direction.

    Moving obstacles repel as in NAPF, and guidance slows where they will cross the way.

    Away from obstacles it flies like :class:`~napf_mpc.planners.potential_field.NapfPlanner`, but that who is
    ahead slows for a UAV left far behind.

    Parameters
    ----------
    problem : Problem
        Formation, mission and planner settings.
    settings : GuidanceSettings, optional
        Of the guidance.
    """

    def __init__(self, problem: Problem, settings: GuidanceSettings = STRICT) -> None:
        super().__init__(problem, Inflation.of_problem(problem), "napf_guided")
        self.guidance = Guidance(problem, self.inflation, settings)
        self.guide: Guide | None = None
        planner = problem.planner
        grid = stage_grid(1.0 / planner.rate_hz, planner.horizon, planner.look_ahead_s)
        # Of the QP planner: both leave the same room.
        self._horizon_s = np.array([grid.sum()])
        self._times_s = np.cumsum(grid)

    def reset(self, obstacles: ObstacleSet, runs: int) -> None:
        """Take a new map and forget all plans."""
        super().reset(obstacles, runs)
        self.guidance.reset(obstacles, runs)

    def step(self, nav: NavSolution, time_s: float) -> Command:
        """Command of all UAVs from the reported solution, the map and the guide."""
        settings, mission = self.problem.planner, self.problem.mission
        assert isinstance(mission, FormationMission)
        nav = self._told(nav, time_s)
        position, covariance, trusted = self._estimates(nav, time_s)
        ahead = None
        if settings.covariance == "expected":
            ahead = nav.position_covariance_ahead(self._horizon_s, with_fixes=True)[:, :, 0]
        elif settings.covariance == "mapped":
            way = mission.speed_mps * self._times_s[:, None] * self._frame.along
            ahead = nav.position_covariance_ahead(self._times_s, True, position[:, :, None] + way)[:, :, -1]
        room = guidance_covariance(nav, trusted, ahead)
        flying = None if nav.airborne is None else np.asarray(nav.airborne.any(-1))
        guide = self.guidance.step(
            position, room, trusted, time_s, nav.tracks, flying=flying, sigma_map=nav.sigma_map,
            measured=not nav.filtered,
        )  # fmt: skip
        self.guide = guide
        place = self._frame.to_path(position)
        error = synchronisation_error(place[..., 0], self._offsets[:, 0])
        speed = guide.pace * reference_speed(
            mission.speed_mps,
            self.problem.formation.sync_gain,
            error,
            settings.min_speed_ratio * mission.speed_mps,
            settings.max_speed_ratio * mission.speed_mps,
        )
        force, avoiding = self._repulsion(position, covariance)
        if nav.tracks is not None and nav.tracks.count:
            away, near = self._moving_repulsion(position, covariance, nav.tracks)
            force, avoiding = force + away, avoiding | near
        lane = self._offsets[:, 1:] + guide.at(0.0)
        off = lane - place[..., 1:]
        slope = guide.slope(0.0, TANGENT_M)
        sideways = speed[..., None] * slope
        held = guide.pace <= 0.0
        drawn = avoiding | held
        sideways = sideways + np.where(drawn[..., None], _limited(PULL_PER_S * off, MOST_PULL_MPS), 0.0)
        reference = self._frame.directions_to_world(np.concatenate([speed[..., None], sideways], axis=-1))
        velocity = apf.velocity_update(reference, force, settings.max_speed_ratio * mission.speed_mps)
        turned = apf.limit_turn(
            velocity, self._frame.along, self._frame.left, math.radians(settings.max_turn_deg)
        )
        size = np.sqrt(velocity[..., 0] ** 2 + velocity[..., 1] ** 2 + velocity[..., 2] ** 2)
        point = self._frame.to_world(np.concatenate([place[..., :1], lane], axis=-1))
        # Held, a UAV may give way in any direction: it has none of its own.
        command = Command(
            position=np.where(drawn[..., None], position, point),
            velocity=np.where(held[..., None], velocity, turned * size[..., None]),
            direction=np.where(held[..., None], 0.0, turned),
            yaw=np.full(trusted.shape, self._frame.heading_rad),
            holding=~trusted | held,
            feedforward=np.zeros((*trusted.shape, 4)),
            reason=np.maximum(waiting_reasons(guide), lost_reasons(trusted)),
        )
        return self._hold(self._wait(command, nav), trusted)


def waiting_reasons(guide: Guide) -> NDArray[np.int8]:
    """Codes of :class:`~napf_mpc.planners.planner.Reason` for UAVs that guidance holds."""
    return _HELD.take(guide.reason)


_HELD = np.zeros(len(Passage), dtype=np.int8)
"""Code of a reason for each passage."""
_HELD[Passage.HOLD], _HELD[Passage.NO_PASSAGE] = Reason.WAITING, Reason.NO_PASSAGE


def _limited(vectors: Array, most: float) -> Array:
    size = np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)
    return np.asarray(vectors * (most / np.maximum(size, most))[..., None])
